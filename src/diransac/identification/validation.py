"""How well a plant predicts a log that it was not identified from: open-loop simulation at several horizons."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.data.dataset import Observations, observe
from diransac.data.log import Log
from diransac.errors import LogError, SettingsError
from diransac.model.plant import ModelWithParameters, as_plant
from diransac.simulation import Measurements, RolloutBatch, Rollouts, rollouts
from diransac.text_table import aligned

__all__ = ["Scores", "Validation", "validate"]


_NICE = (1.0, 2.0, 5.0)


@dataclass(frozen=True)
class Scores:
    """Open-loop prediction at one horizon, by signal.

    Parameters
    ----------
    horizon : s after which the simulation restarts from the measured state; infinite: never
    windows : simulations that were scored
    diverged : of them, those that became infinite; they leave every score infinitely bad
    rmse : root of the mean squared error, the signal's unit
    fit_percent : ``100 (1 - |y - y_sim| / |y - mean(y)|)``
    r_squared : ``1 - sum (y - y_sim)^2 / sum (y - mean(y))^2``
    """

    horizon: float
    windows: int
    diverged: int
    rmse: Mapping[str, float]
    fit_percent: Mapping[str, float]
    r_squared: Mapping[str, float]


@dataclass(frozen=True)
class Validation:
    """Scores at several horizons, shortest first; ``rmse`` and the like are those of the horizon that was asked for.

    Parameters
    ----------
    source : how messages name the log
    units : unit of each signal
    asked : index of the horizon that was asked for; the whole log if none was
    notes : what was found in the log
    """

    source: str
    units: Mapping[str, str]
    horizons: tuple[Scores, ...]
    asked: int
    notes: tuple[str, ...] = ()

    @property
    def rmse(self) -> Mapping[str, float]:
        """Root mean squared error of each signal, in its unit."""
        return self.horizons[self.asked].rmse

    @property
    def fit_percent(self) -> Mapping[str, float]:
        """``100 (1 - |y - y_sim| / |y - mean(y)|)`` of each signal."""
        return self.horizons[self.asked].fit_percent

    @property
    def r_squared(self) -> Mapping[str, float]:
        """Coefficient of determination of each signal."""
        return self.horizons[self.asked].r_squared

    def to_dict(self) -> dict[str, Any]:
        """Everything, ready for JSON (a figure that is not finite becomes null)."""
        rows = [{k: _finite(x) for k, x in vars(scores).items()} for scores in self.horizons]
        top = {k: rows[self.asked][k] for k in ("horizon", "rmse", "fit_percent", "r_squared")}
        return {"log": self.source, **top, "units": dict(self.units), "horizons": rows, "notes": list(self.notes)}

    def __str__(self) -> str:
        header = ["signal", "unit"]
        for scores in self.horizons:
            label = "whole log" if np.isinf(scores.horizon) else f"{scores.horizon:g} s"
            header += [f"RMSE {label}", "fit %", "R^2"]
        rows = [header]
        for name in self.rmse:
            row = [name, self.units[name]]
            for s in self.horizons:
                row += [f"{s.rmse[name]:.4g}", f"{s.fit_percent[name]:.1f}", f"{s.r_squared[name]:.4f}"]
            rows.append(row)
        return "\n".join(aligned(rows))


def validate(
    plant: ModelWithParameters, log: Log, horizon: float | None = None, *, integrator: str = "rk4", substeps: int = 1
) -> Validation:
    """Open-loop prediction of a log by a plant (a `Plant`, or a `Result`), as far as its model knows it.

    Parameters
    ----------
    horizon : s; the simulation restarts from the measured state after each.  None: two that suit the log's length.  The
        whole log from its first complete state on is always scored, too
    integrator, substeps : as in `Settings`

    The first row of a window, where the state is the measured one, is not scored.
    Raises LogError: the log lacks an input or an initial state; SettingsError: an argument is of another kind, a
    horizon shorter than a sample.
    """
    _check_arguments(log, horizon)
    plant = as_plant(plant)
    observations = observe(plant.model, log, pointwise=False)
    parameters = plant.model.parameter_vector(plant.parameters)
    engine = rollouts(plant.model, observations.signals, integrator=integrator, substeps=substeps)
    states = _states(observations)
    n_steps = len(states) - 1 - int(np.argmax(_complete(states)))
    if horizon is not None and not horizon > 0.5 * log.dt:
        raise SettingsError(f"horizon is {horizon} s; give at least one sample, {log.dt:g} s")
    span = n_steps * log.dt
    wanted = [horizon] if horizon is not None else sorted({_nice(span / 50.0), _nice(span / 10.0)})
    lengths = [round(h / log.dt) for h in wanted if h < span and round(h / log.dt) >= 1]
    scores = [_score(engine, observations, states, parameters, n * log.dt, n) for n in lengths]
    scores.append(_score(engine, observations, states, parameters, np.inf, n_steps))
    asked = 0 if horizon is not None else len(scores) - 1
    units = {n: plant.model.units[n] for n in observations.signals}
    return Validation(log.source, units, tuple(scores), asked, observations.notes)


def _check_arguments(log: object, horizon: object) -> None:
    if not isinstance(log, Log):
        raise SettingsError(f"log is a {type(log).__name__}; give a dr.Log, such as dr.read_log(path)")
    if horizon is not None and not isinstance(horizon, (int, float, np.number)):
        raise SettingsError(f"horizon is {horizon!r:.60}; give seconds")


def _score(
    engine: Rollouts,
    observations: Observations,
    states: FloatArray,
    parameters: FloatArray,
    horizon: float,
    steps: int,
) -> Scores:
    """Scores of windows of so many steps, one after another; one that starts at an incomplete state is left out."""
    complete = _complete(states)
    starts = np.arange(int(np.argmax(complete)), len(states) - steps, steps)
    starts = starts[complete[starts]]
    batch = RolloutBatch(
        np.tile(parameters, (len(starts), 1)),
        states[starts],
        observations.inputs,
        observations.log.dt,
        start_rows=starts,
        n_rows=steps + 1,
    )
    measurements = Measurements(np.nan_to_num(observations.measured), np.ones_like(observations.valid))
    errors = engine.errors(batch, measurements)[:, 1:]
    rows = starts[:, None] + np.arange(1, steps + 1)
    measured = observations.measured[rows]
    present = np.isfinite(measured)
    diverged = (~np.isfinite(errors) & present).any(axis=(1, 2))
    with np.errstate(over="ignore"):
        squares = np.where(np.isfinite(errors), np.square(errors), np.inf)
        squared = np.where(present, squares, 0.0).sum(axis=(0, 1))
    count = present.sum(axis=(0, 1))
    mean = np.where(present, measured, 0.0).sum(axis=(0, 1)) / np.maximum(count, 1)
    spread = np.where(present, np.square(measured - mean), 0.0).sum(axis=(0, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        rmse, ratio = np.sqrt(squared / count), squared / spread
    by_name = (
        dict(zip(observations.signals, x.tolist(), strict=True))
        for x in (rmse, 100.0 * (1.0 - np.sqrt(ratio)), 1.0 - ratio)
    )
    return Scores(horizon, len(starts), int(diverged.sum()), *by_name)


def _states(observations: Observations) -> FloatArray:
    """The measured state ``(N, n_x)`` at every row, NaN where it is incomplete; 0 where nothing measured depends on it.

    Raises LogError: no row has a complete state.
    """
    model = observations.model
    states = np.tile(observations.initial_state("first"), (len(observations), 1))
    matter = model.states_behind(observations.signals)
    for i, name in enumerate(model.state):
        if name in observations.signals and name in matter:
            states[:, i] = observations.column(name)
    if not _complete(states)[:-1].any():
        raise LogError(f"{observations.log.source}: no row has a complete state ({', '.join(matter)}) to start from")
    return states


def _complete(states: FloatArray) -> BoolArray:
    return np.asarray(np.isfinite(states).all(axis=1))


def _nice(seconds: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above ``seconds``."""
    decade = 10.0 ** np.floor(np.log10(seconds))
    return float(max(x * decade for x in _NICE if x * decade <= seconds * (1.0 + 1e-9)))


def _finite(x: object) -> object:
    if isinstance(x, Mapping):
        return {k: _finite(v) for k, v in x.items()}
    return x if not isinstance(x, float) or np.isfinite(x) else None
