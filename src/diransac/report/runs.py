"""Results simulated over the logs of a page: the numbers behind every section."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.data import preprocessing
from diransac.data.dataset import Dataset
from diransac.data.log import Log
from diransac.data.segment import Segment
from diransac.errors import LogError, ResultError, SettingsError
from diransac.identification.assessment.validation import Validation, validate
from diransac.identification.diagnosis import Departure, Diagnosis, departures
from diransac.identification.estimate import LogSummary
from diransac.identification.evaluation.prediction import (
    Restarts,
    SimulatedLog,
    diagnosed_parts,
    restarts_of,
    simulated_parts,
    simulated_rows,
    unexplained,
)
from diransac.identification.evaluation.scoring import Scoring, as_estimated, choose_scoring, judged_signals
from diransac.identification.evaluation.simulation import Simulation
from diransac.identification.prediction.open_loop import OpenLoop
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
class Run(SimulatedLog):
    """One result simulated over one log.

    Parameters
    ----------
    label : name of the result on the page
    log_name : name of the log on the page
    result : the result
    view : the result restricted to this log
    first_row : row of the log that is row 0 here
    open_loop : (N, n_s)   simulated through the whole log from its first row; inliers are defined by it, those of a
        held-out log by the restarted simulation
    validation : open-loop scores at several horizons, or the reason why there are none
    screened : True if the noise and the outliers of the log are known
    """

    label: str
    log_name: str
    result: Result
    view: LogView
    first_row: int
    open_loop: FloatArray
    validation: Validation | str
    screened: bool

    @property
    def held_out(self) -> bool:
        """True if the result was identified from other logs."""
        return self.view.summary is None

    @property
    def restart_state(self) -> str:
        """Kind of the states from which the simulation restarts."""
        return "smoothed" if self.screened else "measured"

    @property
    def restarts_within(self) -> bool:
        """True if the simulation restarts before the end of the log."""
        return bool(self.restart_period < (len(self.observations) - 1) * self.observations.log.dt)

    @property
    def rows(self) -> IntArray:
        """Rows of the log (N,)."""
        return np.arange(self.first_row, self.first_row + len(self.observations))

    @property
    def unexplained(self) -> dict[str, float]:
        """Share of each acceleration that the model leaves unexplained; empty if unknown."""
        return {} if self.view.diagnosis is None else unexplained(self.view.diagnosis, self)


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

    A diagnosis is a property of the log and the machine: the first one of a log restarts the simulations of every
    result over that log.

    Raises ResultError: a log cannot be simulated by a model.
    """
    names = numbered(log.source for log in logs)
    diagnoses = [_diagnosis_of(results, log) for log in logs]
    return [
        Entry(
            label,
            result,
            tuple(simulate_on(label, result, *one, horizon) for one in zip(logs, diagnoses, names, strict=True)),
        )
        for label, result in results.items()
    ]


def _diagnosis_of(results: Mapping[str, Result], log: Log) -> Diagnosis | None:
    """First diagnosis of the log among the results."""
    own = (log_view(result, log).diagnosis for result in results.values())
    return next((diagnosis for diagnosis in own if diagnosis is not None), None)


def simulate_on(
    label: str,
    result: Result,
    log: Log,
    diagnosis: Diagnosis | None = None,
    log_name: str | None = None,
    horizon: float | None = None,
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
    horizon : of `validate`, s

    Raises
    ------
    ResultError
        The log cannot be simulated by the model; the message says why.
    """
    view = log_view(result, log)
    try:
        return _simulate(result, view, log, diagnosis, horizon, label=label, log_name=log_name or log.source)
    except (LogError, SettingsError) as error:
        raise ResultError(f'no report: model "{result.model.name}" cannot be simulated on this log: {error}') from error


def _simulate(
    result: Result, view: LogView, given: Log, diagnosis: Diagnosis | None, horizon: float | None, **names: Any
) -> Run:
    """The run of a result over a log."""
    log = _prepared(result, view, given)
    dataset = _dataset(result, log, given)
    scoring = choose_scoring(dataset, result.settings)
    dataset, stretches = as_estimated(dataset, view.diagnosis, result.settings)
    simulation = Simulation(dataset, scoring.judged, result.estimate.resolution, stretches, threads=1)
    observations, parameters = dataset.segments[0], result.model.parameter_vector(view.parameters)
    first_row = observations.first_row_in(given)
    validation = _validation(result, given, horizon)
    held_out = OpenLoop(dataset, 0, view.parameters, result.estimate.resolution) if view.summary is None else None
    begin = None if held_out is None else _estimated_starts(held_out, len(observations))
    whole = simulated_rows(simulation, 0, parameters, observations, begin)
    restarts = _restarts(observations, diagnosis, held_out, validation)
    series = whole if restarts is None else simulated_rows(simulation, 0, parameters, observations, restarts)
    open_loop = simulated_parts(observations, whole, None)["simulated"]
    found = diagnosed_parts(observations, diagnosis, first_row)
    screened = diagnosis is not None
    if held_out is not None and held_out.smoothed is not None:
        screened = True
        found["noise"] = dict(zip(observations.signals, held_out.noise.tolist(), strict=True))
        found["outliers"] = dict(zip(observations.signals, held_out.outliers.T, strict=True))
    run = Run(
        **simulated_parts(observations, series, restarts),
        **found,
        thresholds=_thresholds(result, view, dataset, scoring),
        inliers=np.zeros(len(observations), bool),
        **names,
        result=result,
        view=view,
        first_row=first_row,
        open_loop=open_loop,
        validation=validation,
        screened=screened,
    )
    return replace(run, inliers=_inliers(run, scoring))


def _restarts(
    observations: Segment, diagnosis: Diagnosis | None, held_out: OpenLoop | None, validation: Validation | str
) -> Restarts | None:
    """States at which the simulation restarts; of a held-out log, those of its validation, at the judged horizon."""
    if diagnosis is not None:
        return restarts_of(diagnosis, observations)
    if held_out is None:
        return None
    horizon = np.inf if isinstance(validation, str) else validation.judged.horizon
    n_rows = len(observations) if np.isinf(horizon) else max(1, round(horizon / observations.log.dt))
    return _estimated_starts(held_out, n_rows)


def _estimated_starts(held_out: OpenLoop, n_rows: int) -> Restarts:
    """Initial states of windows of so many rows."""
    rows = held_out.window_rows(n_rows)
    return Restarts(rows, held_out.starts(rows)[0], n_rows)


def _inliers(run: Run, scoring: Scoring) -> BoolArray:
    """Inliers (N,): the result's own, or those of a held-out log by the thresholds of its scoring."""
    if run.view.inliers is not None:
        return run.view.inliers[run.rows]
    finite = np.where(np.isnan(run.errors), np.inf, run.errors)
    return inlier_mask(finite, run.observations.valid, scoring.thresholds, scoring.min_inlier_signals)


def _thresholds(result: Result, view: LogView, dataset: Dataset, scoring: Scoring) -> FloatArray:
    """Inlier thresholds (n_s,): the result's own in a log that it was identified from."""
    own = result.evaluation.thresholds
    return scoring.thresholds if view.summary is None else np.array([own.get(name, 0.0) for name in dataset.signals])


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


def _validation(result: Result, log: Log, horizon: float | None) -> Validation | str:
    """Open-loop scores, or the reason why there are none."""
    try:
        return validate(result, log, horizon)
    except (LogError, SettingsError) as error:
        return str(error)
