"""Weights and thresholds of a dataset's signals, the errors of eq. (2), and the evaluation of an estimate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray, runs
from diransac.data.dataset import Dataset
from diransac.data.log import Log
from diransac.data.segment import Segment
from diransac.errors import LogError, SettingsError
from diransac.identification.diagnosis import Diagnosis
from diransac.identification.estimate import Estimate, Evaluation
from diransac.identification.evaluation.simulation import Scores, Simulation, Start, starts_of
from diransac.identification.settings import Settings
from diransac.model import Model

# ---------------------------------------------------------------------- weights and thresholds


@dataclass(frozen=True, eq=False, repr=False)
class Scoring:
    """Error weights and inlier thresholds of a dataset's signals.

    Parameters
    ----------
    weights : (n_s,) array
        Weights of eq. (2), one over each signal's unit.
    thresholds : (n_s,) array
        Errors below which a signal is an inlier, each signal's unit; 0 switches a signal off.
    min_inlier_signals : int
        Number of signals of a row that must be inliers for the row to be one.
    notes : tuple of str, optional
        Findings, a sentence each.
    """

    weights: FloatArray
    thresholds: FloatArray
    min_inlier_signals: int
    notes: tuple[str, ...] = ()

    @property
    def judged(self) -> BoolArray:
        """Signals ``(n_s,)`` that have a weight or a threshold."""
        return np.asarray((self.weights > 0.0) | (self.thresholds > 0.0))


def judged_signals(model: Model, logs: Sequence[Log], settings: Settings) -> tuple[str, ...]:
    """Names of the signals that are compared with their simulation: those in the settings, or the default ones.

    Parameters
    ----------
    model : Model
    logs : sequence of Log
    settings : Settings
        Weights and thresholds; where either is None, the default signals are compared: velocities and accelerations,
        coordinates whose velocity is not measured, and sensors, as far as every log has them.

    Returns
    -------
    tuple of str
    """
    named = {**(settings.error_weights or {}), **(settings.inlier_thresholds or {})}
    chosen = {n for n, x in named.items() if x > 0.0}
    if settings.error_weights is None or settings.inlier_thresholds is None:
        chosen.update(_judged_by_default(model, [n for n in model.signals if all(n in log for log in logs)]))
    return tuple(n for n in model.signals if n in chosen)


def _judged_by_default(model: Model, measured: Sequence[str]) -> tuple[str, ...]:
    rates = [n for n in (*model.velocities, *model.accelerations, *model.sensors) if n in measured]
    if model.kinematics is not None:
        bare = [] if any(n in measured for n in model.velocities) else [q for q in model.coordinates if q in measured]
    else:
        bare = [q for q, v, *_ in model.chains if q in model.coordinates and q in measured and v not in measured]
    return (*bare, *rates)


def choose_scoring(dataset: Dataset, settings: Settings) -> Scoring:
    """Weights and thresholds from the settings, or from each signal's spread in the dataset where they are None.

    Parameters
    ----------
    dataset : Dataset
    settings : Settings

    Returns
    -------
    Scoring

    Raises
    ------
    SettingsError
        The settings name a signal that a log lacks, or every weight is zero, or there are too few thresholds.
    LogError
        Every signal is constant.
    """
    by_default = _judged_by_default(dataset.model, dataset.common_signals)
    if not by_default and (settings.error_weights is None or settings.inlier_thresholds is None):
        raise LogError(
            f"{dataset.source}: no signal that could be scored is in every log; give one that all logs "
            "have, or name signals in error_weights and inlier_thresholds"
        )
    scales = {n: dataset.scales[n] for n in by_default}
    constant = [n for n, scale in scales.items() if scale == 0.0]
    weights, thresholds = settings.error_weights, settings.inlier_thresholds
    if weights is None or thresholds is None:
        if len(constant) == len(scales):
            raise LogError(
                f"{dataset.source}: {', '.join(scales)} are constant; nothing moves in this log. Record a motion"
            )
        moving = {n: scale for n, scale in scales.items() if scale > 0.0}
        model = dataset.model
        sensors = [n for n, used in model.sensor_arguments.items() if not set(used).isdisjoint(model.accelerations)]
        slow = (*model.accelerations, *sensors)
        if weights is None:
            weights = {n: (0.1 if n in slow else 1.0) / x for n, x in moving.items()}
        if thresholds is None:
            thresholds = {n: 0.2 * x for n, x in moving.items()}
    w, eps = dataset.by_signal(weights), dataset.by_signal(thresholds)
    if not (w > 0.0).any():
        raise SettingsError("every error weight is zero; give one signal a positive weight")
    n_signals = int((eps > 0.0).sum())
    needed = settings.min_inlier_signals or max(1, -(-n_signals // 2))
    if needed > n_signals:
        raise SettingsError(
            f"min_inlier_signals = {needed}, but {n_signals} signals have an inlier threshold; lower it, or give more "
            "thresholds"
        )
    compared = ", ".join(n for n, x in zip(dataset.signals, eps, strict=True) if x > 0.0)
    notes = [f"{n} is constant and is not compared" for n in constant]
    notes.append(f"a row is an inlier if {needed} of {n_signals} signals are within their thresholds: {compared}")
    return Scoring(w, eps, needed, tuple(notes))


# ---------------------------------------------------------------------- simulation


def evaluate(estimate: Estimate, dataset: Dataset, scoring: Scoring, settings: Settings) -> Evaluation:
    """Evaluation of an estimate on the logs that it was made from.

    The simulation has the resolution, timing of the inputs and initial states of the fit.  Rows of gaps do not count.

    Parameters
    ----------
    estimate : Estimate
    dataset : Dataset
    scoring : Scoring
        Weights and thresholds.
    settings : Settings
        Rule of the initial states, and threads.

    Returns
    -------
    Evaluation
        The fit error is NaN, and there are no inliers, where a log lacks its initial state.
    """
    acting, judged = as_estimated(dataset, estimate.diagnosis), scoring.judged
    thresholds = {n: float(x) for n, x in zip(dataset.signals, scoring.thresholds, strict=True) if x > 0.0}
    rows = np.cumsum([0, *map(len, dataset.given)])
    try:
        starts = [
            _starts(one, i, int(rows[i]) + one.offset, estimate.diagnosis, settings.initial_state)
            for i, one in enumerate(acting.segments)
        ]
    except LogError:
        nothing = acting.on_given_logs([np.zeros(len(one), dtype=bool) for one in acting.segments])
        unknown = np.full(len(acting.segments), np.nan)
        return Evaluation(np.nan, np.nan, nothing, unknown, unknown, thresholds)
    scores = Simulation(acting, judged, estimate.resolution, settings.threads).score(
        starts, estimate.values[None], scoring.thresholds[judged], scoring.min_inlier_signals
    )

    def error_of(x: Scores, n_rows: int) -> float:
        error = mean_squared_error if estimate.squared_error else rms_error
        return float(error(x.sum_squares, n_rows, scoring.weights[judged])[0])

    counts = [one.n_rows for one in acting.segments]
    parts = [(scores.of_log(i), n) for i, n in enumerate(counts)]
    return Evaluation(
        fit_error=error_of(scores, acting.n_rows),
        inlier_fraction=float(scores.inlier_count[0] / acting.n_rows),
        inliers=acting.on_given_logs(scores.inlier_masks(0)),
        fit_errors=np.array([error_of(x, n) for x, n in parts]),
        inlier_fractions=np.array([x.inlier_count[0] / n for x, n in parts]),
        thresholds=thresholds,
    )


def as_estimated(dataset: Dataset, found: Diagnosis | None) -> Dataset:
    """The dataset, in which rows from a gap to the first smoothed state after it count as those of the gap."""
    if found is None:
        return dataset
    segments = list(dataset.segments)
    for i, one in enumerate(dataset.segments):
        gaps, (rows, _) = one.gaps.copy(), _smoothed(one, i, found)
        for x in runs(~one.gaps)[1:]:
            after = rows[(rows >= x.start) & (rows < x.stop)]
            gaps[x.start : int(after[0]) if len(after) else x.stop] = True
        segments[i] = replace(one, gaps=gaps, valid=one.valid & ~gaps)
    return replace(dataset, segments=tuple(segments))


def _starts(one: Segment, log: int, row: int, found: Diagnosis | None, rule: str | Mapping[str, float]) -> list[Start]:
    """Simulations of a log as an estimate has it: after a gap, with a diagnosis, from the first smoothed state.

    At the first row, which is ``row`` of all logs, a smoothed state is in place of a sample that is missing or an
    outlier.
    """
    if found is None:
        return starts_of(one, rule)
    rows, smoothed = _smoothed(one, log, found)
    parts = runs(~one.gaps)
    states = [{n: float(x[k]) for n, x in smoothed.items()} for k in np.searchsorted(rows, [x.start for x in parts])]
    for name in set(states[0]) & set(one.present) & set(found.outliers):
        if np.isfinite(one.column(name)[0]) and not found.outliers[name][row]:
            states[0][name] = float(one.column(name)[0])
    first = states[0] | (dict(rule) if isinstance(rule, Mapping) else {})
    rules = [rule if rule == "robust" else first, *states[1:]]
    return [(x, one.part(x).initial_state(y)) for x, y in zip(parts, rules, strict=True)]


def _smoothed(one: Segment, log: int, found: Diagnosis) -> tuple[IntArray, dict[str, FloatArray]]:
    """Rows of a log that have a smoothed state, and these."""
    windows = found.windows_of(log)
    rows = np.round((found.smoothed_time[windows] - one.log.time[one.offset]) / one.log.dt).astype(int)
    return rows, {n: x[windows] for n, x in found.smoothed_states.items()}


# ---------------------------------------------------------------------- errors


def rms_error(sum_squares: FloatArray, n_rows: int, weights: FloatArray) -> FloatArray:
    """``e = sum_i w_i sqrt(sum_j err_ij^2 / N)``, the weighted RMS model-fit error of every hypothesis, eq. (2).

    Parameters
    ----------
    sum_squares : (n_hypotheses, n_signals) array
        Squared errors summed over time, each signal's unit squared; infinite where a rollout diverged.
    n_rows : int
        Number of observations N in the sum.
    weights : (n_signals,) array
        Weights w, one over each signal's unit.

    Returns
    -------
    (n_hypotheses,) array
        Signals of zero weight are left out, so that no 0 is multiplied by infinity.

    References
    ----------
    Dimmig et al. 2023, eq. (2).
    """
    return _weighted_sum(np.sqrt(sum_squares / n_rows), weights)


def mean_squared_error(sum_squares: FloatArray, n_rows: int, weights: FloatArray) -> FloatArray:
    """``e = sum_i w_i sum_j err_ij^2 / N``, DIRANSAC's error: eq. (2) without the root.

    Parameters
    ----------
    sum_squares : (n_hypotheses, n_signals) array
    n_rows : int
    weights : (n_signals,) array
        As in `rms_error`.

    Returns
    -------
    (n_hypotheses,) array
    """
    return _weighted_sum(sum_squares / n_rows, weights)


def _weighted_sum(errors: FloatArray, weights: FloatArray) -> FloatArray:
    """Weighted sum over signals in their order, so that rounding does not depend on shapes."""
    total = np.zeros(len(errors))
    for i in np.flatnonzero(weights > 0.0):
        total += weights[i] * errors[:, i]
    return total
