"""Results simulated over the logs of a page: the numbers behind every section."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.data import preprocessing
from diransac.data.dataset import Dataset
from diransac.data.log import Log
from diransac.data.segment import Segment
from diransac.errors import LogError, ResultError, SettingsError
from diransac.identification.estimate import Diagnosis, LogSummary
from diransac.identification.evaluation import Scoring, Simulation, as_estimated, choose_scoring, judged_signals
from diransac.identification.result import Result
from diransac.identification.validation import Validation, validate
from diransac.model import Plant
from diransac.report.rendering import numbered
from diransac.simulation import inlier_mask

__all__ = [
    "Entry",
    "LogView",
    "Run",
    "bulk_range",
    "log_view",
    "simulate_all",
    "simulate_on",
    "summaries",
]

_MET = 0.5
_N_RESTARTS = 12
_MEDIAN = 0.6745  # of the absolute value of Gaussian noise, in standard deviations


# ---------------------------------------------------------------------- a result restricted to one log


@dataclass(frozen=True)
class LogView:
    """A result restricted to one log: every attribute that differs between logs.

    Parameters
    ----------
    index : number of the log among the result's logs; None for a held-out log
    parameters : name -> value that holds in this log
    per_log : the parameters among these that have one value per log
    inliers : (N,)   over the rows of the log; None for a held-out log
    preparation : preprocessing steps of the log, in order; of a held-out log, those to repeat
    diagnosis : restricted to the rows and windows of this log; None if there is none, and for a held-out log
    fit_error : of this log; NaN for a held-out log
    remark : disagreement with the other logs, empty if there is none
    """

    index: int | None
    parameters: Mapping[str, float]
    per_log: tuple[str, ...]
    inliers: BoolArray | None
    preparation: Sequence[Mapping[str, Any]]
    diagnosis: Diagnosis | None
    fit_error: float
    remark: str

    @property
    def held_out(self) -> bool:
        """True if the result was identified from other logs."""
        return self.index is None


def summaries(result: Result) -> tuple[LogSummary, ...]:
    """Summary of every log that the result was identified from."""
    return result.logs


def log_view(result: Result, log: Log) -> LogView:
    """The part of a result that belongs to one log.

    This function and `summaries` alone read the attributes of a result that have one entry per log.
    """
    own = (i for i, summary in enumerate(result.logs) if summary.fingerprint == log.fingerprint)
    index = next(own, None)
    if index is None:
        return LogView(None, result.parameters, (), None, result.logs[0].preparation, None, np.nan, "")
    summary, rows = result.logs[index], result.log_rows(index)
    parameters = result.parameters_in(log)
    diagnosis = None if result.diagnosis is None else _restricted(result.diagnosis, rows, index)
    inliers = result.inliers[rows]
    steps = summary.preparation
    return LogView(
        index, parameters, tuple(result.per_log), inliers, steps, diagnosis, summary.fit_error, summary.remark
    )


def _restricted(diagnosis: Diagnosis, rows: slice, log: int) -> Diagnosis:
    """The diagnosis of one log, whose rows are given."""
    windows = diagnosis.windows_of(log)
    return replace(
        diagnosis,
        outliers={name: mask[rows] for name, mask in diagnosis.outliers.items()},
        window_log=np.zeros_like(windows),
        unmodelled_time=diagnosis.unmodelled_time[windows],
        unmodelled_accelerations={n: x[windows] for n, x in diagnosis.unmodelled_accelerations.items()},
        unmodelled_forces={n: x[windows] for n, x in diagnosis.unmodelled_forces.items()},
        smoothed_time=diagnosis.smoothed_time[windows],
        smoothed_states={n: x[windows] for n, x in diagnosis.smoothed_states.items()},
    )


# ---------------------------------------------------------------------- runs


@dataclass(frozen=True)
class Run:
    """One result simulated over one log.

    Parameters
    ----------
    label : name of the result on the page
    log_name : name of the log on the page
    result : the result
    view : the result restricted to this log
    observations : the model over the log, ``N`` rows
    first_row : row of the log that is row 0 here
    diagnosis : of this log, from whichever result of the page has one; None if none has
    restart_period : s   time after which the simulation restarts from the smoothed state; infinite without a diagnosis
    simulated : (N, n_s)   the observations' signals, NaN after a divergence
    errors : (N, n_s)   simulated minus measured, NaN where either is missing
    open_loop : (N, n_s)   simulated through the whole log from its first row; the inliers are defined by it
    accelerations : acceleration -> (N,)   simulated, measured or not
    thresholds : (n_s,)   inlier thresholds; 0 for a signal without one
    inliers : (N,)   rows that agree with the open-loop simulation
    validation : open-loop scores at several horizons, or the reason why there are none
    """

    label: str
    log_name: str
    result: Result
    view: LogView
    observations: Segment
    first_row: int
    diagnosis: Diagnosis | None
    restart_period: float
    simulated: FloatArray
    errors: FloatArray
    open_loop: FloatArray
    accelerations: Mapping[str, FloatArray]
    thresholds: FloatArray
    inliers: BoolArray
    validation: Validation | str

    @property
    def held_out(self) -> bool:
        """True if the result was identified from other logs."""
        return self.view.held_out

    @property
    def rows(self) -> IntArray:
        """Rows of the log (N,)."""
        return np.arange(self.first_row, self.first_row + len(self.observations))

    @property
    def inlier_fraction(self) -> float:
        """Inliers over the valid rows."""
        return float(self.inliers.sum() / self.observations.n_rows)

    @property
    def n_excluded(self) -> int:
        """Number of rows in which a required signal is missing."""
        return len(self.observations) - self.observations.n_rows + self.observations.offset

    @property
    def divergence(self) -> float | None:
        """Log time at which the simulation becomes infinite, s; None if it stays finite."""
        lost = ~np.isfinite(self.simulated).all(axis=1)
        return float(self.observations.log.time[self.observations.offset + np.argmax(lost)]) if lost.any() else None

    @cached_property
    def outliers(self) -> dict[str, BoolArray]:
        """Diagnosed outliers (N,) of each signal."""
        known = {} if self.diagnosis is None else self.diagnosis.outliers
        none = np.zeros(len(self.observations), dtype=bool)
        return {n: known[n][self.rows] if n in known else none for n in self.observations.signals}

    @cached_property
    def regular_errors(self) -> dict[str, FloatArray]:
        """Absolute errors of each signal over valid rows without outliers; infinite after a divergence."""
        error = np.where(np.isnan(self.simulated), np.inf, np.abs(self.errors))
        columns = zip(self.outliers.items(), error.T, strict=True)
        return {n: x[self.observations.valid & ~outliers & ~np.isnan(x)] for (n, outliers), x in columns}

    @cached_property
    def median_errors(self) -> dict[str, float]:
        """Median of the regular errors of each signal, in its unit; NaN without samples."""
        return {n: float(np.median(x)) if len(x) else np.nan for n, x in self.regular_errors.items()}

    @cached_property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Range of each measured signal: of its bulk, and of samples close to the simulation."""
        found = {}
        for name, measured, error in zip(
            self.observations.signals, self.observations.measured.T, self.errors.T, strict=True
        ):
            low, high = bulk_range(measured)
            met = measured[np.abs(error) <= _MET * (high - low)]
            found[name] = float(met.min(initial=low)), float(met.max(initial=high))
        return found

    @property
    def relative_errors(self) -> dict[str, float]:
        """Median error of each signal with a threshold, minus the noise's if known, over the signal's range."""
        widths = {n: high - low for n, (low, high) in self.ranges.items()}
        scored = [n for n, x in zip(self.observations.signals, self.thresholds, strict=True) if x > 0.0]
        noise = {} if self.diagnosis is None else self.diagnosis.noise_std
        excess = {n: max(0.0, self.median_errors[n] - _MEDIAN * noise.get(n, 0.0)) for n in scored}
        return {n: excess[n] / widths[n] for n in scored if widths[n] > 0.0}

    @property
    def unmodelled_fraction(self) -> dict[str, float]:
        """RMS unmodelled acceleration over RMS modelled acceleration, of each coordinate; empty if unknown."""
        if self.view.diagnosis is None:
            return {}
        unmodelled = {n: _rms(x) for n, x in self.view.diagnosis.unmodelled_accelerations.items()}
        modelled = {n: _rms(x[np.isfinite(x)]) for n, x in self.accelerations.items()}
        return {n: x / modelled[n] for n, x in unmodelled.items() if modelled[n] > 0.0}


@dataclass(frozen=True)
class Entry:
    """One result of the page and its simulations, one run per log."""

    label: str
    result: Result
    runs: tuple[Run, ...]

    def identifies(self, name: str) -> bool:
        """True if the result has the parameter and the parameter is identifiable."""
        return name in self.result.parameters and name not in self.result.unidentifiable


def bulk_range(values: FloatArray) -> tuple[float, float]:
    """Range of the values no further from the central 80 % than its width; (0, 0) without finite values."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, 0.0
    low, high = np.quantile(finite, [0.1, 0.9])
    width = high - low
    kept = finite[(finite >= low - width) & (finite <= high + width)]
    return float(kept.min()), float(kept.max())


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0


# ---------------------------------------------------------------------- simulations


def simulate_all(results: Mapping[str, Result], logs: Sequence[Log]) -> list[Entry]:
    """Every result simulated over every log.

    A diagnosis is a property of the log and the machine: the first one of a log restarts the simulations of every
    result over that log.

    Raises ResultError: a log cannot be simulated by a model.
    """
    names = numbered(log.source for log in logs)
    diagnoses = [_diagnosis_of(results, log) for log in logs]
    return [
        Entry(
            label, result, tuple(simulate_on(label, result, *one) for one in zip(logs, diagnoses, names, strict=True))
        )
        for label, result in results.items()
    ]


def _diagnosis_of(results: Mapping[str, Result], log: Log) -> Diagnosis | None:
    """First diagnosis of the log among the results."""
    own = (log_view(result, log).diagnosis for result in results.values())
    return next((diagnosis for diagnosis in own if diagnosis is not None), None)


def simulate_on(
    label: str, result: Result, log: Log, diagnosis: Diagnosis | None = None, log_name: str | None = None
) -> Run:
    """A result simulated over a log, which is preprocessed as the result's own was.

    Parameters
    ----------
    label : name of the result on the page
    result : the result
    log : the log
    diagnosis : of this log; with it, the simulation restarts periodically from the smoothed state, so that the effect
        of unmodelled forces does not accumulate
    log_name : name of the log on the page; its source by default

    Raises
    ------
    ResultError
        The log cannot be simulated by the model; the message says why.
    """
    view = log_view(result, log)
    try:
        run = _simulate(result, view, log, diagnosis)
    except (LogError, SettingsError) as error:
        raise ResultError(f'no report: model "{result.model.name}" cannot be simulated on this log: {error}') from error
    return replace(run, label=label, log_name=log.source if log_name is None else log_name)


def _simulate(result: Result, view: LogView, given: Log, diagnosis: Diagnosis | None) -> Run:
    """The run, without names."""
    settings, model, log = result.settings, result.model, _prepared(result, view, given)
    dataset = _dataset(result, log, given)
    scoring = choose_scoring(dataset, settings)
    dataset, rules = as_estimated(dataset, view.diagnosis, settings)
    simulation = Simulation(dataset, resolution=result.estimate.resolution, rules=rules, threads=1)
    observations = dataset.segments[0]
    first_row = round(float(log.time[observations.offset] - given.time[0]) / given.dt)
    parameters = model.parameter_vector(view.parameters)
    open_loop, errors = _simulated(simulation, parameters, observations, simulation.starts[0][None], len(observations))
    inliers = view.inliers
    if inliers is None:
        inliers = _close_rows(errors, observations, scoring)
    else:
        inliers = inliers[first_row : first_row + len(observations)]
    simulated, period = open_loop, np.inf
    if diagnosis is not None and set(model.state) <= set(diagnosis.smoothed_states):
        states, n_rows = _restarts(diagnosis, observations)
        simulated, errors = _simulated(simulation, parameters, observations, states, n_rows)
        period = n_rows * log.dt
    columns = [model.signals.index(name) for name in observations.signals]
    return Run(
        label="",
        log_name="",
        result=result,
        view=view,
        observations=observations,
        first_row=first_row,
        diagnosis=diagnosis,
        restart_period=period,
        simulated=simulated[:, columns],
        errors=errors,
        open_loop=open_loop[:, columns],
        accelerations=dict(zip(model.accelerations, simulated[:, len(model.state) :].T, strict=True)),
        thresholds=_thresholds(result, view, dataset, scoring),
        inliers=inliers,
        validation=_validation(result, view, log),
    )


def _thresholds(result: Result, view: LogView, dataset: Dataset, scoring: Scoring) -> FloatArray:
    """Inlier thresholds (n_s,): the result's own in a log that it was identified from."""
    own = result.evaluation.thresholds
    return scoring.thresholds if view.held_out else np.array([own.get(name, 0.0) for name in dataset.signals])


def _close_rows(errors: FloatArray, observations: Segment, scoring: Scoring) -> BoolArray:
    """Inliers (N,) of a held-out log by the thresholds of its scoring."""
    finite = np.where(np.isnan(errors), np.inf, errors)
    return inlier_mask(finite, observations.valid, scoring.thresholds, scoring.min_inlier_signals)


def _prepared(result: Result, view: LogView, log: Log) -> Log:
    """The log with derived velocities and accelerations, if the result's log had them and this one does not."""
    derived = _last_step(view.preparation)
    if derived.get("step") != "differentiate" or _last_step(log.history).get("step") == "differentiate":
        return log
    return preprocessing.differentiate(log, result.model, float(derived["bandwidth"]))


def _last_step(history: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    return history[-1] if history else {}


def _restarts(diagnosis: Diagnosis, observations: Segment) -> tuple[FloatArray, int]:
    """Smoothed states (K, n_x) at which the simulation restarts, and the number of rows between them."""
    time, names = diagnosis.smoothed_time, observations.model.state
    every = max(1, round(len(time) / _N_RESTARTS))
    dt, start = observations.log.dt, observations.log.time[observations.offset]
    n_rows = max(1, every * round(float(time[1] - time[0]) / dt)) if len(time) > 1 else len(observations)
    at = start + dt * np.arange(0, len(observations), n_rows)
    return np.column_stack([np.interp(at, time, diagnosis.smoothed_states[n]) for n in names]), n_rows


def _simulated(
    simulation: Simulation, parameters: FloatArray, observations: Segment, states: FloatArray, n_rows: int
) -> tuple[FloatArray, FloatArray]:
    """All signals (N, n) simulated from each state for ``n_rows`` rows, and their errors (N, n_s)."""
    n, starts = len(observations), n_rows * np.arange(len(states))
    signals = simulation.trajectories(0, parameters, states, starts, n_rows)
    errors = simulation.errors(0, parameters, states, starts, n_rows)
    signals, errors = (x.reshape(-1, x.shape[2])[:n] for x in (signals, errors))
    return signals, np.where(np.isfinite(observations.measured), errors, np.nan)


def _dataset(result: Result, log: Log, given: Log) -> Dataset:
    """The dataset as `identify` makes it; of a held-out log without all signals, with those that a simulation needs."""
    try:
        return Dataset.of(result.model, log, judged_signals(result.model, [log], result.settings), given=[given])
    except LogError:
        return Dataset.of(result.model, log, pointwise=False, given=[given])


def _validation(result: Result, view: LogView, log: Log) -> Validation | str:
    """Open-loop scores, or the reason why there are none."""
    fitted = result.estimate.resolution
    try:
        plant = Plant(result.model, view.parameters)
        return validate(plant, log, integrator=fitted.integrator, substeps=fitted.substeps, input_hold=fitted.hold)
    except (LogError, SettingsError) as error:
        return str(error)
