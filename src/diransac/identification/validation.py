"""Validation: open-loop prediction of logs by a plant at several horizons; leave-one-log-out cross-validation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.data import preprocessing
from diransac.data.dataset import Dataset, ParameterLayout, as_logs, distinct_logs
from diransac.data.log import Log
from diransac.data.segment import Segment, runs
from diransac.errors import DiransacError, LogError, SettingsError
from diransac.identification.driven_states import DrivenStates, least_squares
from diransac.identification.estimate import Resolution
from diransac.identification.evaluation import Simulation
from diransac.identification.identify import identify
from diransac.identification.method import Callback, Method, within
from diransac.identification.methods import DEFAULT
from diransac.identification.open_loop import resolution_of
from diransac.identification.result import Result
from diransac.model.plant import ModelWithParameters, as_plant
from diransac.text_table import aligned
from diransac.time_limit import check_time, time_limited

if TYPE_CHECKING:
    from diransac.model import Model

__all__ = ["CrossValidation", "HorizonScores", "Validation", "cross_validate", "validate"]

_NICE = (1.0, 2.0, 5.0)
# Memory of the observers that find unmeasured initial states, over the duration of the log; steps of their search.
_MEMORY, _N_STEPS = 0.05, 20


@dataclass(frozen=True)
class HorizonScores:
    """Open-loop prediction at one horizon, by signal.

    Parameters
    ----------
    horizon : float
        Time after which the simulation restarts from the measured state, s; infinite: never.
    windows : int
        Number of simulations that were scored.
    diverged : int
        Number of simulations that became infinite, which makes the scores infinite.
    rmse : mapping of str to float
        Root mean squared error of each signal, its unit.
    fit_percent : mapping of str to float
        ``100 (1 - |y - y_sim| / |y - mean(y)|)``.
    r_squared : mapping of str to float
        ``1 - sum (y - y_sim)^2 / sum (y - mean(y))^2``.
    """

    horizon: float
    windows: int
    diverged: int
    rmse: Mapping[str, float]
    fit_percent: Mapping[str, float]
    r_squared: Mapping[str, float]


@dataclass(frozen=True)
class Validation:
    """Scores at several horizons, shortest first; `rmse`, `fit_percent` and `r_squared` are those of the requested one.

    Parameters
    ----------
    source : str
        Names of the logs in messages.
    units : mapping of str to str
        Unit of each signal.
    horizons : tuple of HorizonScores
        Scores of each horizon.
    asked : int
        Index of the requested horizon; of the whole log if none was requested.
    notes : tuple of str, optional
        Findings in the logs, a sentence each.
    force_error_percent : mapping of str to float, optional
        Relative error of the force of the inputs in the equation of each coordinate or velocity, as inverse dynamics
        predict it from the smoothed motion: RMS error over the RMS of the force, %.  The force of a target under
        position control is stiffness times target less position.
    """

    source: str
    units: Mapping[str, str]
    horizons: tuple[HorizonScores, ...]
    asked: int
    notes: tuple[str, ...] = ()
    force_error_percent: Mapping[str, float] = field(default_factory=dict)

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
        forces = {n: x if np.isfinite(x) else None for n, x in self.force_error_percent.items()}
        return {
            "log": self.source,
            **top,
            "units": dict(self.units),
            "horizons": rows,
            "force_error_percent": forces,
            "notes": list(self.notes),
        }

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
        forces = [["force of the inputs", "relative error %"]]
        forces += [[n, f"{x:.1f}"] for n, x in self.force_error_percent.items()]
        return "\n".join(aligned(rows) + (["", *aligned(forces)] if self.force_error_percent else []))


def validate(
    plant: ModelWithParameters,
    logs: Log | Iterable[Log],
    horizon: float | None = None,
    *,
    integrator: str | None = None,
    substeps: int | None = None,
    input_hold: str | None = None,
) -> Validation:
    """Scores of the open-loop prediction of logs by a plant.

    Parameters
    ----------
    plant : Plant or Result
        Model with its parameters.
    logs : Log or iterable of Log
        One log, or several, whose errors are pooled.  A per-log parameter takes its own value in a log that the result
        was identified from, and the mean of these in others.
    horizon : float, optional
        Time after which the simulation restarts from the measured state, s.  None: two that suit the length of the
        logs.  The whole of each log from its first complete state on is always scored, too.  No window passes through a
        gap: windows end there, and begin again at the next complete state.
    integrator : str, optional
    substeps : int, optional
    input_hold : str, optional
        As in `Settings` and `identify`; None: those of the identification of a result, else "rk4", 1 and "zero-order".
        A result's inputs act after the delay or lag that was identified.

    Returns
    -------
    Validation
        Scores by signal.  The first row of a window, whose state is measured, is not scored.

    Raises
    ------
    LogError
        A log lacks an input or an initial state.
    SettingsError
        An argument is of another type, or unknown, or a horizon is shorter than a sample.
    """
    several = as_logs(logs)
    if horizon is not None and not isinstance(horizon, (int, float, np.number)):
        raise SettingsError(f"horizon is {horizon!r:.60}; give seconds")
    known = as_plant(plant)
    resolution = resolution_of(plant, integrator, substeps, input_hold)
    dataset = Dataset.of(known.model, several, pointwise=False)
    own = [plant.parameters_in(log) if isinstance(plant, Result) else known.parameters for log in several]
    predictions = [_OpenLoop(dataset, i, parameters, resolution) for i, parameters in enumerate(own)]
    dt = max(log.dt for log in several)
    if horizon is not None and not horizon > 0.5 * dt:
        raise SettingsError(f"horizon is {horizon} s; give at least one sample, {dt:g} s")
    span = max(one.duration for one in predictions)
    wanted = [horizon] if horizon is not None else sorted({_nice(span / 50.0), _nice(span / 10.0)})
    horizons = [h for h in wanted if any(one.steps(h) for one in predictions)]
    scores = [_pooled(dataset.signals, h, predictions) for h in (*horizons, np.inf)]
    asked = 0 if horizon is not None else len(scores) - 1
    units = {n: known.model.units[n] for n in dataset.signals}
    from diransac.identification.inverse_dynamics import force_errors  # which needs all of lo-diransac

    forces = force_errors(dataset, own, resolution)
    return Validation(dataset.source, units, tuple(scores), asked, dataset.notes, forces)


class _OpenLoop:
    """Predictions of one log: its complete states, and simulations that restart from them."""

    def __init__(self, dataset: Dataset, log: int, parameters: Mapping[str, float], resolution: Resolution) -> None:
        self._log, self._segment = log, dataset.segments[log]
        self._simulation = Simulation(dataset, resolution=resolution)
        self._parameters = dataset.model.parameter_vector(parameters)
        self._states = _states(self._segment, dataset.layout, self._parameters)
        self._complete: BoolArray = np.asarray(np.isfinite(self._states).all(axis=1))
        stretches = [x for x in runs(~self._segment.gaps) if self._complete[x.start : x.stop - 1].any()]
        self._stretches = [slice(x.start + int(np.argmax(self._complete[x])), x.stop) for x in stretches]
        if not stretches:
            needed = ", ".join(dataset.model.states_behind(self._segment.present))
            raise LogError(f"{self._segment.log.source}: no row has a complete state ({needed}) to start from")

    @property
    def duration(self) -> float:
        """From the first complete state to the end, or to a gap, the longest, s."""
        return max(self._steps(x, np.inf) for x in self._stretches) * self._segment.log.dt

    def _steps(self, rows: slice, horizon: float) -> int:
        """Samples of a horizon; 0 where the stretch is not longer than that."""
        longest = int(rows.stop - rows.start) - 1
        if np.isinf(horizon):
            return longest
        return round(horizon / self._segment.log.dt) if horizon < longest * self._segment.log.dt else 0

    def steps(self, horizon: float) -> int:
        """Samples of a horizon; 0 where no stretch of the log is longer than that."""
        return max(self._steps(x, horizon) for x in self._stretches)

    def sums(self, horizon: float) -> _Sums:
        """Sums over the windows of one horizon in all stretches between gaps."""
        first, *others = (self._sums(rows, self._steps(rows, horizon)) for rows in self._stretches)
        for other in others:
            first = first.with_those_of(other)
        return first

    def _sums(self, rows: slice, steps: int) -> _Sums:
        """Sums over windows, one after another; one that starts at an incomplete state is left out."""
        starts = np.arange(rows.start, rows.stop - steps, steps) if steps else np.arange(0)
        starts = starts[self._complete[starts]]
        if not len(starts):
            nothing = np.zeros(self._segment.measured.shape[1])
            return _Sums(0, 0, nothing, nothing, np.empty((0, len(nothing))))
        errors = self._simulation.errors(self._log, self._parameters, self._states[starts], starts, steps + 1)[:, 1:]
        measured = self._segment.measured[starts[:, None] + np.arange(1, steps + 1)]
        present = np.isfinite(measured)
        diverged = (~np.isfinite(errors) & present).any(axis=(1, 2))
        with np.errstate(over="ignore"):
            squares = np.where(np.isfinite(errors), np.square(errors), np.inf)
            squared = np.where(present, squares, 0.0).sum(axis=(0, 1))
        return _Sums(
            len(starts), int(diverged.sum()), squared, present.sum(axis=(0, 1)), measured.reshape(-1, measured.shape[2])
        )


@dataclass(frozen=True)
class _Sums:
    """Windows, diverged ones, squared errors and samples ``(n_s,)``, and the samples themselves ``(n, n_s)``."""

    windows: int
    diverged: int
    squared: FloatArray
    count: FloatArray
    measured: FloatArray

    def with_those_of(self, other: _Sums) -> _Sums:
        """The sums over the windows of both."""
        return _Sums(
            self.windows + other.windows,
            self.diverged + other.diverged,
            self.squared + other.squared,
            self.count + other.count,
            np.concatenate([self.measured, other.measured]),
        )


def _pooled(signals: Sequence[str], horizon: float, predictions: Sequence[_OpenLoop]) -> HorizonScores:
    """Scores of one horizon over all logs; the spread of a signal is about its mean in each log."""
    parts = [one.sums(horizon) for one in predictions]
    squared, count = (sum((getattr(x, n) for x in parts), np.zeros(len(signals))) for n in ("squared", "count"))
    spread = sum((_spread(x.measured) for x in parts), np.zeros(len(signals)))
    with np.errstate(divide="ignore", invalid="ignore"):
        rmse, ratio = np.sqrt(squared / count), squared / spread
    by_name = (dict(zip(signals, x.tolist(), strict=True)) for x in (rmse, 100.0 * (1.0 - np.sqrt(ratio)), 1.0 - ratio))
    return HorizonScores(horizon, sum(x.windows for x in parts), sum(x.diverged for x in parts), *by_name)


def _spread(measured: FloatArray) -> FloatArray:
    """Sum of squares ``(n_s,)`` about the mean of the samples that are there."""
    present = np.isfinite(measured)
    mean = np.where(present, measured, 0.0).sum(axis=0) / np.maximum(present.sum(axis=0), 1)
    return np.asarray(np.where(present, np.square(measured - mean), 0.0).sum(axis=0))


def _states(segment: Segment, layout: ParameterLayout, parameters: FloatArray) -> FloatArray:
    """The measured state ``(N, n_x)`` at every row, NaN where it is incomplete; 0 where nothing measured depends on it.

    States of first order that the log lacks are simulated, driven by the others.

    Raises LogError: the log lacks another state on which a measured signal depends.
    """
    model, matter = segment.model, segment.model.states_behind(segment.present)
    hidden = tuple(n for n in model.first_order if n in matter and n not in segment.present)
    states = np.tile(segment.initial_state(dict.fromkeys(hidden, 0.0) or "first"), (len(segment), 1))
    for i, name in enumerate(model.state):
        if name in segment.present and name in matter:
            states[:, i] = segment.column(name)
    if hidden:
        states[:, [model.state.index(n) for n in hidden]] = _unmeasured(segment, layout, parameters, states, hidden)
    return states


def _unmeasured(
    segment: Segment, layout: ParameterLayout, parameters: FloatArray, states: FloatArray, hidden: tuple[str, ...]
) -> FloatArray:
    """States ``(N, n)`` that the log lacks, whose initial values agree best with the other velocities and sensors."""
    model, rows = segment.model, np.arange(len(segment))
    known = np.column_stack([np.interp(rows, rows[np.isfinite(x)], x[np.isfinite(x)]) for x in states.T])
    observed = [i for i, n in enumerate(model.state) if n in model.velocities and n not in hidden]
    absent = np.full(len(segment), np.nan)
    sensors = [segment.column(n) if n in segment.present else absent for n in model.sensors]
    compared = np.column_stack([states[:, observed], *sensors])
    seen = np.isfinite(compared)
    spread = np.array([x[ok].std() if ok.any() else 0.0 for x, ok in zip(compared.T, seen.T, strict=True)])
    weights = np.where(seen, 1.0 / np.square(np.where(spread > 0.0, spread, 1.0)), 0.0)
    readings = np.nan_to_num(compared[:, len(observed) :])
    bandwidth = 1.0 / (_MEMORY * len(segment) * segment.log.dt)
    whole, alone = [slice(0, len(segment))], ParameterLayout(layout.parameters)
    problem = DrivenStates(
        model, alone, hidden, known, segment.inputs, readings, weights, whole, segment.log.dt, bandwidth, parameters
    )
    found = problem.trajectories(least_squares(problem, problem.starts(), _N_STEPS)[0][0])
    return np.column_stack([found[n] for n in hidden])


def _nice(seconds: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above ``seconds``."""
    decade = 10.0 ** np.floor(np.log10(seconds))
    return float(max(x * decade for x in _NICE if x * decade <= seconds * (1.0 + 1e-9)))


def _finite(x: object) -> object:
    if isinstance(x, Mapping):
        return {k: _finite(v) for k, v in x.items()}
    return x if not isinstance(x, float) or np.isfinite(x) else None


@dataclass(frozen=True)
class CrossValidation:
    """Leave-one-log-out cross-validation: each log predicted by the model of the others.

    Parameters
    ----------
    sources : tuple of str
        Name of each log in messages.
    results : tuple of Result or str
        Result of all logs but that one; or the reason why there is none.
    validations : tuple of Validation or str
        Validation with that log; or the reason why there is none.
    """

    sources: tuple[str, ...]
    results: tuple[Result | str, ...]
    validations: tuple[Validation | str, ...]

    @property
    def rmse(self) -> dict[str, float]:
        """Median over the logs of each signal's root mean squared error; infinite where a log has none."""
        names = dict.fromkeys(n for one in self.validations if isinstance(one, Validation) for n in one.rmse)
        found = {
            n: [one.rmse.get(n, np.inf) if isinstance(one, Validation) else np.inf for one in self.validations]
            for n in names
        }
        return {n: float(np.median(x)) for n, x in found.items()}

    def to_dict(self) -> dict[str, Any]:
        """Everything, ready for JSON."""
        folds = [
            {
                "log": source,
                "parameters": result if isinstance(result, str) else result.parameters,
                "validation": found if isinstance(found, str) else found.to_dict(),
            }
            for source, result, found in zip(self.sources, self.results, self.validations, strict=True)
        ]
        return {"folds": folds, "rmse": {n: _finite(x) for n, x in self.rmse.items()}}

    def __str__(self) -> str:
        signals = list(self.rmse)
        parameters = next((list(x.parameters) for x in self.results if not isinstance(x, str)), [])
        rows = [["log left out", *parameters, *(f"RMSE {n}" for n in signals)]]
        remarks = []
        for source, result, found in zip(self.sources, self.results, self.validations, strict=True):
            estimates = ["" if isinstance(result, str) else f"{result.parameters[n]:.5g}" for n in parameters]
            errors = ["" if isinstance(found, str) else f"{found.rmse.get(n, np.nan):.4g}" for n in signals]
            rows.append([source, *estimates, *errors])
            remarks += [x if x.startswith(source) else f"{source}: {x}" for x in (result, found) if isinstance(x, str)]
        return "\n".join([*aligned(rows), *remarks])


def cross_validate(
    model: Model,
    logs: Iterable[Log],
    method: str | Method = DEFAULT,
    *,
    horizon: float | None = None,
    time_limit: float | None = None,
    progress: Callback | None = None,
    **arguments: Any,
) -> CrossValidation:
    """Leave-one-log-out cross-validation: prediction of each log by the model identified from the others.

    A per-log parameter of the log that is left out is the mean over the others.

    Parameters
    ----------
    model : Model
    logs : iterable of Log
        Two or more.
    method : str or Method, optional
        As in `identify`.
    horizon : float, optional
        As in `validate`, s.
    time_limit : float, optional
        Time after which no further log is left out, s; those that are not say so.
    progress : callable, optional
        Called with a `Progress` at every stage.
    arguments : object
        Other arguments of `identify`.

    Returns
    -------
    CrossValidation

    Raises
    ------
    SettingsError
        There are fewer than two logs, or an argument is out of range.
    LogError
        A log is given twice.
    """
    several = distinct_logs(logs)
    if len(several) < 2:
        raise SettingsError("cross-validation leaves one log out; give at least two logs")
    arguments = {"compare_logs": False, **arguments}
    with time_limited(time_limit):
        folds = [_fold(model, several, i, method, horizon, progress, arguments) for i in range(len(several))]
    results, validations = zip(*folds, strict=True)
    return CrossValidation(tuple(x.source for x in several), results, validations)


def _fold(
    model: Model,
    logs: Sequence[Log],
    i: int,
    method: str | Method,
    horizon: float | None,
    progress: Callback | None,
    arguments: Mapping[str, Any],
) -> tuple[Result | str, Validation | str]:
    """The result of all logs but the i-th and its validation with that log; reasons where there are none.

    Raises SettingsError: an argument is out of range.
    """
    left_out, others = logs[i], [*logs[:i], *logs[i + 1 :]]
    part = within(progress, i / len(logs), (i + 1) / len(logs), f"without log {i + 1}: ")
    try:
        result = identify(model, others, method, progress=part, **arguments)
        check_time()
    except SettingsError:
        raise
    except DiransacError as error:
        return str(error), "no model of the other logs"
    try:
        if arguments.get("differentiate"):
            left_out = preprocessing.differentiate(left_out, model, arguments.get("bandwidth"))
        return result, validate(result, left_out, horizon)
    except DiransacError as error:
        return result, str(error)
