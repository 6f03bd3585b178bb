"""Results simulated over the logs of a page: the numbers behind every section."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray, bulk_range
from diransac.data import preprocessing
from diransac.data.dataset import Dataset
from diransac.data.log import Log
from diransac.data.segment import Segment
from diransac.errors import LogError, ResultError, SettingsError
from diransac.identification.assessment.validation import Validation, validated
from diransac.identification.diagnosis import Departure, Diagnosis, departures
from diransac.identification.estimate import LogSummary
from diransac.identification.evaluation.scoring import choose_scoring, judged_signals
from diransac.identification.prediction.open_loop import derived_velocities
from diransac.identification.result import Result
from diransac.report.rendering import numbered
from diransac.simulation import inlier_mask

# ---------------------------------------------------------------------- a result restricted to one log


@dataclass(frozen=True)
class LogView:
    """A result restricted to one log: every attribute that differs between logs.

    Parameters
    ----------
    summary : of the log in the identification; None for a held-out log
    parameters : name -> value that holds in this log
    inliers : (N,)   over the rows of the log; None for a held-out log
    preparation : preprocessing steps of the log, in order; of a held-out log, those to repeat
    diagnosis : restricted to the rows and windows of this log; None if there is none, and for a held-out log
    departures : stretches of this log in which the model does not hold
    """

    summary: LogSummary | None
    parameters: Mapping[str, float]
    inliers: BoolArray | None
    preparation: Sequence[Mapping[str, Any]]
    diagnosis: Diagnosis | None = None
    departures: Sequence[Departure] = ()


def log_view(result: Result, log: Log) -> LogView:
    """The part of a result that belongs to one log."""
    own = (i for i, summary in enumerate(result.logs) if summary.fingerprint == log.fingerprint)
    index = next(own, None)
    if index is None:
        return LogView(None, result.parameters, None, result.logs[0].preparation)
    summary, rows = result.logs[index], result.log_rows(index)
    view = LogView(summary, result.parameters_in(log), result.inliers[rows], summary.preparation)
    if result.diagnosis is None:
        return view
    departing = departures(result.diagnosis, index, summary.prediction.unexplained if summary.prediction else {})
    return replace(view, diagnosis=result.diagnosis.of_log(index, rows), departures=departing)


# ---------------------------------------------------------------------- runs


@dataclass(frozen=True, kw_only=True)
class Run:
    """One result simulated over one log.

    Parameters
    ----------
    label : name of the result on the page
    log_name : name of the log on the page
    result : the result
    view : the result restricted to this log
    observations : the model over the log, N rows of n_s signals: measured ones, and states that nothing measures
    first_row : row of the log that is row 0 here
    simulated : (N, n_s)   simulated from the states of `validate`, again after each judged horizon; NaN in gaps
    open_loop : (N, n_s)   simulated through the whole log
    thresholds : inlier threshold of each signal that has one
    inliers : (N,)   rows that agree with one simulation of the whole log, in the identification; those of a held-out
        log with the restarted simulation
    noise : standard deviation of the noise of each signal, as far as it is known
    outliers : (N,) samples of each signal that are outliers
    validation : open-loop scores at several horizons
    screened : True if the result separates outliers, or the log is held out: they are known
    """

    label: str
    log_name: str
    result: Result
    view: LogView
    observations: Segment
    first_row: int
    simulated: FloatArray
    open_loop: FloatArray
    thresholds: Mapping[str, float]
    inliers: BoolArray
    noise: Mapping[str, float]
    outliers: Mapping[str, BoolArray]
    validation: Validation
    screened: bool

    @property
    def held_out(self) -> bool:
        """True if the result was identified from other logs."""
        return self.view.summary is None

    @property
    def restart_period(self) -> float:
        """Time after which the simulation restarts, s: the judged horizon; infinite: never."""
        return self.validation.judged.horizon

    @property
    def rows(self) -> IntArray:
        """Rows of the log (N,)."""
        return np.arange(self.first_row, self.first_row + len(self.observations))

    @cached_property
    def errors(self) -> FloatArray:
        """Simulated less measured signals ``(N, n_s)``, NaN where either is missing."""
        return _errors(self.simulated, self.observations)

    @property
    def inlier_fraction(self) -> float:
        """Inliers over the rows that count."""
        known = self.view.summary
        return float(self.inliers.sum() / self.observations.n_rows) if known is None else known.inlier_fraction

    @cached_property
    def median_errors(self) -> dict[str, float]:
        """Median size of the errors of each signal without outliers, in its unit; infinite after a divergence."""
        found = {}
        for name, error, y in zip(self.observations.signals, self.errors.T, self.observations.measured.T, strict=True):
            counted = self.observations.valid & np.isfinite(y) & ~self.outliers[name]
            sizes = np.where(np.isnan(error), np.inf, np.abs(error))[counted]
            found[name] = float(np.median(sizes)) if len(sizes) else np.nan
        return found

    @cached_property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Range of the bulk of each signal's samples and of those close to the simulation; else of the simulation."""
        found = {}
        for k, name in enumerate(self.observations.signals):
            measured, error = self.observations.measured[:, k], self.errors[:, k]
            shown = measured if np.isfinite(measured).any() else self.simulated[:, k]
            low, high = bulk_range(shown)
            met = measured[np.abs(error) <= 0.5 * (high - low)]
            found[name] = float(met.min(initial=low)), float(met.max(initial=high))
        return found


def _errors(simulated: FloatArray, observations: Segment) -> FloatArray:
    """Simulated less measured signals ``(N, n_s)``; a quaternion that is measured whole has the sign that is nearer."""
    model, signed = observations.model, simulated.copy()
    for four in model.quaternions:
        names = [model.signals[k] for k in four]
        if set(names) <= set(observations.signals):
            columns = [observations.signals.index(n) for n in names]
            nearness = np.nansum(simulated[:, columns] * observations.measured[:, columns], axis=1, keepdims=True)
            signed[:, columns] *= np.where(nearness < 0.0, -1.0, 1.0)
    return signed - observations.measured


@dataclass(frozen=True)
class Entry:
    """One result of the page and its simulations, one run per log."""

    label: str
    result: Result
    runs: tuple[Run, ...]

    def identifies(self, name: str) -> bool:
        """True if the result has the parameter and the parameter is identifiable."""
        return name in self.result.parameters and name not in self.result.unidentifiable


# ---------------------------------------------------------------------- simulations


def simulate_all(results: Mapping[str, Result], logs: Sequence[Log], horizon: float | None = None) -> list[Entry]:
    """Every result simulated over every log, and validated at a horizon, s; None: at those that suit the log.

    Raises ResultError: a log cannot be simulated by a model.
    """
    names = numbered(log.source for log in logs)
    return [
        Entry(
            label,
            result,
            tuple(simulate_on(label, result, log, name, horizon) for log, name in zip(logs, names, strict=True)),
        )
        for label, result in results.items()
    ]


def simulate_on(label: str, result: Result, log: Log, log_name: str | None = None, horizon: float | None = None) -> Run:
    """A result simulated over a log, which is preprocessed as the result's own was.

    Parameters
    ----------
    label : name of the result on the page
    result : the result
    log : the log
    log_name : name of the log on the page; its source by default
    horizon : of `validate`, s

    Raises
    ------
    ResultError
        The log cannot be simulated by the model; the message says why.
    """
    view = log_view(result, log)
    try:
        return _simulate(result, view, log, horizon, label=label, log_name=log_name or log.source)
    except (LogError, SettingsError) as error:
        raise ResultError(f'no report: model "{result.model.name}" cannot be simulated on this log: {error}') from error


def _simulate(result: Result, view: LogView, given: Log, horizon: float | None, **names: Any) -> Run:
    """The run of a result over a log."""
    dataset = _dataset(result, _prepared(result, view, given), given)
    scoring = choose_scoring(dataset, result.settings)
    validation, (loop,) = validated(result, given, horizon, result.estimate.resolution)
    observed = dataset.segments[0]
    acting = result.model.states_behind(observed.present)
    hidden = set(acting) - {*observed.signals, *derived_velocities(observed, acting)}
    observations = observed.with_signals((*observed.signals, *(n for n in result.model.state if n in hidden)))
    rows = slice(observed.first_row_in(given), observed.first_row_in(given) + len(observed))
    columns = [result.model.signals.index(n) for n in observations.signals]
    first, n_rows = loop.segment.first_row_in(given), len(given)
    restarted, whole = (
        _in_rows(loop.simulated(h)[1], first, n_rows)[rows][:, columns] for h in (validation.judged.horizon, np.inf)
    )
    outliers = dict(zip(loop.segment.signals, _in_rows(loop.outliers, first, n_rows)[rows].T == 1.0, strict=True))
    none = np.zeros(len(observed), bool)
    thresholds = dict(zip(dataset.signals, scoring.thresholds.tolist(), strict=True))
    if view.inliers is None:
        errors = _errors(restarted, observations)[:, : len(observed.signals)]
        finite = np.where(np.isnan(errors), np.inf, errors)
        inliers = inlier_mask(finite, observed.valid, scoring.thresholds, scoring.min_inlier_signals)
    else:
        inliers, thresholds = view.inliers[rows], dict(result.evaluation.thresholds)
    return Run(
        **names,
        result=result,
        view=view,
        observations=observations,
        first_row=rows.start,
        simulated=restarted,
        open_loop=whole,
        thresholds=thresholds,
        inliers=inliers,
        noise=dict(zip(loop.segment.signals, loop.noise.tolist(), strict=True)),
        outliers={n: outliers.get(n, none) for n in observations.signals},
        validation=validation,
        screened=loop.smoothed is not None and (view.summary is None or view.diagnosis is not None),
    )


def _in_rows(values: FloatArray | BoolArray, first: int, n_rows: int) -> FloatArray:
    """Rows ``(n_rows, n)`` of a log, of which these are known from the first on; NaN in the others."""
    found = np.full((n_rows, values.shape[1]), np.nan)
    found[first : first + len(values)] = values
    return found


def _prepared(result: Result, view: LogView, log: Log) -> Log:
    """The log with derived velocities and accelerations, if the result's log had them and this one does not."""
    derived = _last_step(view.preparation)
    if derived.get("step") != "differentiate" or _last_step(log.history).get("step") == "differentiate":
        return log
    return preprocessing.differentiate(log, result.model, float(derived["bandwidth"]))


def _last_step(history: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    return history[-1] if history else {}


def _dataset(result: Result, log: Log, given: Log) -> Dataset:
    """The dataset as `identify` makes it; of a held-out log without all signals, with those that a simulation needs."""
    log = log if result.diagnosis is None else log.measured
    try:
        return Dataset.of(result.model, log, judged_signals(result.model, [log], result.settings), given=[given])
    except LogError:
        return Dataset.of(result.model, log, pointwise=False, given=[given])
