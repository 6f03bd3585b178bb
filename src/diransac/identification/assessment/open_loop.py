"""`simulate`: a model over the inputs of a log, from given states or from those of the log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from diransac.arrays import FloatArray
from diransac.data import preprocessing
from diransac.data.dataset import Dataset, as_logs
from diransac.data.log import Log
from diransac.data.segment import Segment
from diransac.errors import LogError, ResultError, SettingsError, check_known
from diransac.identification.diagnosis import Resolution
from diransac.identification.identify import checked_hold
from diransac.identification.prediction.open_loop import OpenLoop, StartRule
from diransac.identification.result import Result
from diransac.identification.settings import finite_number
from diransac.model import Model
from diransac.model.plant import ModelWithParameters, as_plant


def simulate(
    plant: ModelWithParameters,
    log: Log,
    *,
    initial_state: Mapping[str, float] | None = None,
    horizon: float | None = None,
    integrator: str | None = None,
    substeps: int | None = None,
    input_hold: str | None = None,
) -> Log:
    """Simulation of a model, driven by the inputs of a log.

    The simulation starts from the first state of the log, from a given one, or again every ``horizon`` seconds from the
    states of the log, which are estimated with the model from the samples before, as in `validate`.  After a gap the
    simulation begins again.

    Parameters
    ----------
    plant : Result or Plant
        Model with parameters; disturbances of a plant are not simulated.
    log : Log
        Inputs, and states to start from; with ``initial_state``, inputs are enough.
    initial_state : mapping of str to float, optional
        Initial value of states in their units; those that are not named are the log's.
    horizon : float, optional
        Time after which the simulation restarts, s; None: never.
    integrator, substeps, input_hold : optional
        As in `validate`: by default those of the identification, whose delays and lag of the inputs are applied too.

    Returns
    -------
    Log
        Simulated signals of the model, NaN in gaps, and the inputs as recorded, at the times of the log from the first
        row with all inputs; with a note on starts and inputs.

    Raises
    ------
    LogError
        The log lacks an input, or an initial value.
    SettingsError
        An argument is of another type, unknown or out of range.
    ResultError
        The simulation diverges; the message names the time.
    """
    known = as_plant(plant)
    if initial_state is not None and horizon is not None:
        raise SettingsError("initial_state and horizon are given; a restart takes the states of the log: give one")
    (given,) = as_logs([log])
    recorded = preprocessing.in_units(given, known.model)
    if horizon is not None and not finite_number("horizon", horizon) > 0.5 * recorded.dt:
        raise SettingsError(f"horizon is {horizon!r:.60}; give seconds, at least one sample, {recorded.dt:g} s")
    driven = recorded if initial_state is None else _with_start(recorded, known.model, initial_state)
    dataset = Dataset.of(known.model, driven, pointwise=False)
    resolution, noise = resolution_of(plant, integrator, substeps, input_hold), None
    parameters = plant.parameters_in(given) if isinstance(plant, Result) else known.parameters
    if isinstance(plant, Result) and plant.diagnosis is not None:
        noise = plant.diagnosis.noise_std
    start: StartRule = "smoothed" if initial_state is None else "measured"
    loop = OpenLoop(dataset, 0, parameters, resolution, start, noise)
    starts, series = loop.simulated(np.inf if horizon is None else horizon)
    _check_finite(series, loop.segment)
    note = _note(len(starts), horizon, resolution)
    return _as_log(known.model, recorded, loop.segment, series, [*dataset.notes, note])


def resolution_of(
    plant: ModelWithParameters, integrator: str | None = None, substeps: int | None = None, hold: str | None = None
) -> Resolution:
    """Resolution of a result's identification, or the default one, with those parts replaced that are given."""
    fitted = plant.estimate.resolution if isinstance(plant, Result) else Resolution()
    own_hold = checked_hold(hold) or fitted.hold
    own_integrator = fitted.integrator if integrator is None else integrator
    own_substeps = fitted.substeps if substeps is None else substeps
    return Resolution(own_integrator, own_substeps, own_hold, fitted.timing)


# ---------------------------------------------------------------------- starts


def _with_start(log: Log, model: Model, given: Mapping[str, float]) -> Log:
    """A log of the inputs and of constant states: the given ones, elsewhere the log's first samples."""
    check_known(given, model.state, "initial_state names", "the state is")
    known = {name: finite_number(f"initial_state: {name}", value) for name, value in given.items()}
    start = {name: known[name] if name in known else _first(log, name) for name in model.state}
    absent = [name for name, value in start.items() if not np.isfinite(value)]
    if absent:
        raise LogError(f"{log.source}: there is no initial value of {', '.join(absent)}; give it in initial_state")
    inputs = {name: log[name] for name in model.inputs}
    constant = {name: np.full(len(log), value) for name, value in start.items()}
    units = {name: unit for name, unit in log.units.items() if name in inputs}
    return replace(log, signals={**inputs, **constant}, units=units, notes=())


def _first(log: Log, name: str) -> float:
    """First sample of a signal; NaN without one."""
    samples = log[name] if name in log else np.empty(0)
    return float(next((x for x in samples if np.isfinite(x)), np.nan))


# ---------------------------------------------------------------------- the simulation as a log


def _check_finite(series: FloatArray, observations: Segment) -> None:
    """Raise ResultError where the simulation diverges."""
    lost = ~observations.gaps & ~np.isfinite(series[:, : len(observations.model.state)]).all(axis=1)
    if lost.any():
        time = float(observations.log.time[observations.offset + int(np.argmax(lost))])
        raise ResultError(
            f"{observations.log.source}: the simulation diverges at t = {time:.6g} s; "
            "restart it from the states of the log with a horizon, or end the log before"
        )


def _as_log(model: Model, recorded: Log, observations: Segment, series: FloatArray, notes: Sequence[str]) -> Log:
    """Log of simulated signals and recorded inputs."""
    rows = slice(observations.offset, None)
    signals = dict(zip(model.signals, series.T, strict=True))
    signals |= {name: recorded[name][rows] for name in model.inputs}
    step = {"step": "simulate", "model": model.name, "log": recorded.source}
    time, source = observations.log.time[rows], f"simulation of {recorded.source}"
    return Log(time, signals, model.units, source, (step,), tuple(notes))


def _note(n_starts: int, horizon: float | None, resolution: Resolution) -> str:
    """Sentence on the starts of the simulation and on its inputs."""
    starts = f"{n_starts} start{'s' * (n_starts > 1)}" + (f", every {horizon:g} s" if horizon is not None else "")
    timing = resolution.timing
    delays, lags = (", ".join(f"{1e3 * x:.3g}" for x in times) for times in (timing.delays, timing.lags))
    late = f"delayed by {delays} ms" if any(timing.delays) else ""
    lag = f"after a lag of {lags} ms" if any(timing.lags) else ""
    how = ", ".join(x for x in (resolution.interpolation or "inputs held", late, lag) if x)
    return f"simulated from {starts}, {how}"
