"""`simulate`: a model over the inputs of a log, from given states or from those of the log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.data import preprocessing
from diransac.data.dataset import Dataset, as_logs
from diransac.data.log import Log
from diransac.data.segment import Segment
from diransac.errors import LogError, ResultError, SettingsError, check_known
from diransac.identification.diagnosis import Diagnosis, Resolution
from diransac.identification.evaluation.prediction import Restarts, restart_rows, simulated_rows
from diransac.identification.evaluation.simulation import Simulation
from diransac.identification.identify import checked_hold
from diransac.identification.prediction.open_loop import derived_velocities
from diransac.identification.prediction.starts import smoothed_log
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
    states of the log.  These are the smoothed ones of a log from which lo-diransac identified, elsewhere measured ones,
    of which outliers are replaced.  After a gap the simulation begins again.

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
    driven = recorded if initial_state is None else _with_start(recorded, known.model, initial_state)
    dataset = Dataset.of(known.model, driven, pointwise=False)
    observations = _with_velocities(dataset)
    parameters = plant.parameters_in(given) if isinstance(plant, Result) else known.parameters
    resolution = resolution_of(plant, integrator, substeps, input_hold)
    simulation, values = Simulation(dataset, resolution=resolution), known.model.parameter_vector(parameters)
    restarts = _starts(_diagnosis_of(plant, given), simulation, values, observations, horizon)
    series = simulated_rows(simulation, 0, values, observations, restarts)
    _check_finite(series, observations, restarts)
    return _as_log(known.model, recorded, observations, series, [*dataset.notes, _note(restarts, horizon, resolution)])


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


def _starts(
    diagnosis: Diagnosis | None,
    simulation: Simulation,
    parameters: FloatArray,
    observations: Segment,
    horizon: float | None,
) -> Restarts:
    """Rows from which the simulation starts, and its states there; the diagnosis is of this log."""
    if horizon is None:
        rows = np.array([part.start for part in observations.stretches])
        return _measured_starts(observations, rows, len(observations))
    dt = observations.log.dt
    if not finite_number("horizon", horizon) > 0.5 * dt:
        raise SettingsError(f"horizon is {horizon!r:.60}; give seconds, at least one sample, {dt:g} s")
    n_rows = round(horizon / dt)
    if diagnosis is not None and set(observations.model.state) <= set(diagnosis.smoothed_states):
        return _smoothed_starts(diagnosis, simulation, parameters, observations, n_rows)
    rows = restart_rows(observations, n_rows, np.flatnonzero(observations.valid))
    return _measured_starts(observations, rows, n_rows)


def _diagnosis_of(plant: ModelWithParameters, log: Log) -> Diagnosis | None:
    """Diagnosis of a log from which lo-diransac identified."""
    if not isinstance(plant, Result) or plant.diagnosis is None:
        return None
    index = plant.index_of(log)
    return None if index is None else plant.diagnosis.of_log(index, plant.log_rows(index))


def _smoothed_starts(
    diagnosis: Diagnosis, simulation: Simulation, parameters: FloatArray, observations: Segment, n_rows: int
) -> Restarts:
    """Smoothed states of a log every ``n_rows`` rows, and after gaps.

    Between two smoothed states the simulation from the first is interpolated to the second: its difference there is
    added in proportion to time.
    """
    begin, dt = observations.log.time[observations.offset], observations.log.dt
    at = np.round((diagnosis.smoothed_time - begin) / dt).astype(int)
    smoothed = np.column_stack([diagnosis.smoothed_states[n] for n in observations.model.state])
    rows = restart_rows(observations, n_rows, at)
    widths, passed = np.diff(at, append=len(observations)), np.cumsum(observations.gaps)
    found = simulation.trajectories(0, parameters, smoothed, at, int(widths.max()) + 1)
    found = found[:, :, : smoothed.shape[1]]
    tied = np.append(passed[at[1:]] == passed[at[:-1]], False)
    differences = np.zeros_like(smoothed)
    differences[tied] = smoothed[1:][tied[:-1]] - found[tied, widths[tied]]
    of_row = np.maximum(np.searchsorted(at, rows, side="right") - 1, 0)
    elapsed = np.maximum(rows - at[of_row], 0)
    states = found[of_row, elapsed] + (elapsed / widths[of_row])[:, None] * differences[of_row]
    return Restarts(rows, states, n_rows)


def _with_velocities(dataset: Dataset) -> Segment:
    """The only log of a dataset with the velocities that it lacks, from its motion as it is smoothed without the model.

    These are velocities that are no derivatives of coordinates; others are those of the line through the first samples.
    """
    (one,), model = dataset.segments, dataset.model
    lacking = derived_velocities(one, model.states_behind(one.present)) if model.kinematics is not None else ()
    smoothed = smoothed_log(dataset) if lacking else None
    if smoothed is None:
        return one
    signals = tuple(n for n in model.signals if n in one.signals or n in lacking)
    columns = [smoothed.signals[:, model.signals.index(n)] if n in lacking else one.column(n) for n in signals]
    return replace(one, signals=signals, measured=np.column_stack(columns))


def _measured_starts(observations: Segment, rows: IntArray, n_rows: int) -> Restarts:
    """States of a log at some rows, without outliers; a state that nothing measures is that of the first row."""
    ends = [
        next((x.stop for x in observations.stretches if x.start <= row < x.stop), len(observations)) for row in rows
    ]
    parts = [observations.part(slice(int(row), end)) for row, end in zip(rows, ends, strict=True)]
    return Restarts(rows, np.array([one.initial_state("robust") for one in parts]), n_rows)


# ---------------------------------------------------------------------- the simulation as a log


def _check_finite(series: FloatArray, observations: Segment, restarts: Restarts) -> None:
    """Raise ResultError where the simulation diverges."""
    lost = _covered(observations, restarts.rows) & ~np.isfinite(series[:, : len(observations.model.state)]).all(axis=1)
    if lost.any():
        time = float(observations.log.time[observations.offset + int(np.argmax(lost))])
        raise ResultError(
            f"{observations.log.source}: the simulation diverges at t = {time:.6g} s; "
            "restart it from the states of the log with a horizon, or end the log before"
        )


def _covered(observations: Segment, starts: IntArray) -> BoolArray:
    """Rows ``(N,)`` that a simulation from these rows reaches: there is no gap in between."""
    rows, passed = np.arange(len(observations)), np.cumsum(observations.gaps)
    latest = np.searchsorted(starts, rows, side="right") - 1
    begun = starts[np.maximum(latest, 0)]
    return np.asarray((latest >= 0) & ~observations.gaps & (passed == passed[begun]))


def _as_log(model: Model, recorded: Log, observations: Segment, series: FloatArray, notes: Sequence[str]) -> Log:
    """Log of simulated signals and recorded inputs."""
    rows = slice(observations.offset, None)
    signals = dict(zip(model.signals, series.T, strict=True))
    signals |= {name: recorded[name][rows] for name in model.inputs}
    step = {"step": "simulate", "model": model.name, "log": recorded.source}
    time, source = observations.log.time[rows], f"simulation of {recorded.source}"
    return Log(time, signals, model.units, source, (step,), tuple(notes))


def _note(restarts: Restarts, horizon: float | None, resolution: Resolution) -> str:
    """Sentence on the starts of the simulation and on its inputs."""
    n = len(restarts.rows)
    starts = f"{n} start{'s' * (n > 1)}" + (f", every {horizon:g} s" if horizon is not None else "")
    timing = resolution.timing
    delays, lags = (", ".join(f"{1e3 * x:.3g}" for x in times) for times in (timing.delays, timing.lags))
    late = f"delayed by {delays} ms" if any(timing.delays) else ""
    lag = f"after a lag of {lags} ms" if any(timing.lags) else ""
    how = ", ".join(x for x in (resolution.interpolation or "inputs held", late, lag) if x)
    return f"simulated from {starts}, {how}"
