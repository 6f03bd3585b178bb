"""Set-points as instruments: parameters that feedback does not bias, and a test of whether it biases least squares.

A controller answers disturbances.  Where it does not cancel them, the motion is correlated with the forces that the
model lacks, and least squares attributes a part of these to the parameters (Forssell, Ljung 1999).  Set-points are not:
what a linear filter predicts of the motion from them alone is a motion without disturbances.  The regressors on that
motion are the instruments, so that those of a nonlinear term are functions of the predicted motion rather than linear
predictions of the term (Kelejian 1971).

The filter is a sum of first-order lags whose time constants are powers of two, fitted to each signal of the motion by
ridge regression.  A tenth of each log is predicted by the filter of the other nine.  Predictions of a filter that was
fitted to the same rows would contain a part of the disturbances, and bias the estimate towards least squares (Angrist,
Imbens, Krueger 1999).

The instrumented estimate has a larger variance, and replaces least squares only where Hausman's test rejects that both
have the same expectation.  Where it is significant alone, their difference widens the interval.  Parameters whose
regressor the set-points hardly predict are not tested, nor are those that share an equation with one.  An instrumented
estimate that bounds cut off is not taken: what it moves to the other parameters is no estimate of them.

References
----------
Hausman 1978; Söderström, Stoica 1983; Gilson, Van den Hof 2005 (instruments in closed loop); Staiger, Stock 1997 (weak
instruments).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.data.input_timing import acting_inputs
from diransac.errors import SettingsError
from diransac.identification.diagnosis import HausmanTest, Outcome
from diransac.identification.finding import Finding
from diransac.identification.methods.lo_diransac.projection import (
    Instruments,
    estimate_parameters,
    instrumented_contrast,
    mean_regressors,
    residuals_of_motion,
)
from diransac.text_table import listed, number

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset
    from diransac.identification.methods.lo_diransac.normal_equations import Fit
    from diransac.identification.methods.lo_diransac.projection import Contrast, ProjectedEstimate
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals

__all__ = ["Instrumented", "check_set_points", "instrumented_estimate"]

# First-stage F below which instruments are weak (Staiger, Stock 1997); levels of Hausman's test from which on the
# estimate is the instrumented one, and from which on the difference widens the interval.
_STRONG, _REJECTED, _SIGNIFICANT = 10.0, 1e-3, 0.05
# Difference of two estimates over the parameter that is none; divisor in place of 0.
_NEGLIGIBLE, _TINY = 1e-3, 1e-300
# Folds of a cross-fit; shortest time constant of the filter, samples, and longest, over the log.
_FOLDS, _SHORTEST, _LONGEST = 10, 2.0, 0.1
# Ridges of the filter, over the largest squared singular value of its columns.
_RIDGES = 10.0 ** np.arange(-14.0, 1.0)


@dataclass(frozen=True)
class Instrumented:
    """Outcome of set-points as instruments.

    Parameters
    ----------
    result : ProjectedEstimate
        The plain one where Hausman's test does not reject it.
    ambiguity : (n,) array
        Difference of both estimates, where it is significant and the plain one stays; 0 elsewhere.
    tests : tuple of HausmanTest, optional
        One per parameter that the equations of motion depend on, and that is not on a bound.
    findings : tuple of Finding, optional
    """

    result: ProjectedEstimate
    ambiguity: FloatArray
    tests: tuple[HausmanTest, ...] = ()
    findings: tuple[Finding, ...] = ()


def check_set_points(dataset: Dataset, names: Sequence[str]) -> None:
    """Refuse set-points that cannot be instruments.

    Parameters
    ----------
    dataset : Dataset
    names : sequence of str
        Columns of the logs: set-points, or inputs that answer nothing.

    Raises
    ------
    SettingsError
        A log lacks a column, or samples of it; it is a measured signal; all columns are constant in all logs.
    """
    for name in names:
        if name in dataset.model.signals:
            raise SettingsError(f'set_points names "{name}", which is measured and answers disturbances')
        for one in dataset.segments:
            if name not in one.log:
                found = ", ".join(one.log.names)
                raise SettingsError(f'set_points names "{name}", which {one.log.source} lacks; it has {found}')
            missing = int((~np.isfinite(one.log[name][one.offset :])).sum())
            if missing:
                where = f"{missing} rows of {one.log.source}"
                raise SettingsError(
                    f'set_points names "{name}", which has no value in {where}; give it, or leave it out'
                )
    if names and not any(np.ptp(x, axis=0).any() for x in _columns(dataset, names)):
        raise SettingsError(f"set_points names {listed(names)}: constant in {dataset.source}; leave set_points out")


def instrumented_estimate(
    intervals: ShootingIntervals,
    fit: Fit,
    plain: ProjectedEstimate,
    dataset: Dataset,
    names: Sequence[str],
) -> Instrumented:
    """Estimate with set-points as instruments where Hausman's test rejects the plain one.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
        Most probable motion, with unmodelled accelerations.
    plain : ProjectedEstimate
        Least squares on that motion.
    dataset : Dataset
    names : sequence of str
        Set-points, as `check_set_points` admits them.

    Returns
    -------
    Instrumented
    """
    motion, *_ = residuals_of_motion(intervals, fit, fit.shared[: intervals.n_p])
    predicted = _predicted(intervals, motion[:4], _columns(dataset, names))
    means = mean_regressors(intervals, predicted, fit.shared[: intervals.n_p])
    contrast = instrumented_contrast(intervals, fit, Instruments(means, np.ones(intervals.n_p, bool)))
    tests = _tests(intervals.layout.names, contrast)
    rejected = np.array([x.outcome == "rejected" for x in tests])
    differs = rejected | np.array([x.outcome == "differs" for x in tests])
    replaced: BoolArray = np.asarray(contrast.together[rejected].any(axis=0))
    result = plain
    if rejected.any():
        found = estimate_parameters(intervals, fit, Instruments(means, replaced))
        stopped = intervals.layout.on_bounds(found.parameters)[replaced].any()
        result = plain if stopped or intervals.layout.violations(found.parameters) else found
    if result is plain:
        replaced = np.zeros(len(tests), bool)
    left = np.where(differs & ~replaced, contrast.instrumented - contrast.plain, 0.0)
    findings = tuple(_findings(tests, names, replaced))
    return Instrumented(result, left, tuple(x for x in tests if x.outcome != "untested"), findings)


def _columns(dataset: Dataset, names: Sequence[str]) -> list[FloatArray]:
    """Columns ``(N, k)`` of each log, over the rows of its segment."""
    return [
        np.column_stack([one.log[name] for name in names])[one.offset : one.offset + len(one)]
        for one in dataset.segments
    ]


# ---------------------------------------------------------------------- the motion that set-points predict


def _predicted(
    intervals: ShootingIntervals, motion: Sequence[FloatArray], set_points: Sequence[FloatArray]
) -> list[FloatArray]:
    """Predictions of q, v, a and u from set-points, each (N, n), where rows count."""
    counted = intervals.counted
    longest = max(len(x) for x in set_points)
    n_times = max(1, int(np.log2(_LONGEST * longest / _SHORTEST)) + 1)
    times: FloatArray = _SHORTEST * np.exp2(np.arange(n_times, dtype=float))
    columns, folds = list[FloatArray](), list[IntArray]()
    for rows, own in zip(intervals.rows_of_logs, set_points, strict=True):
        n = rows.stop - rows.start
        lagged = _lagged(own, times)
        columns.append(lagged[np.minimum(np.arange(n), len(own) - 1)])
        folds.append(np.arange(n) * _FOLDS // n)
    signals = np.hstack(list(motion))
    signals[counted] = _cross_fitted(np.concatenate(columns)[counted], signals[counted], np.concatenate(folds)[counted])
    return np.split(signals, np.cumsum([x.shape[1] for x in motion])[:-1], axis=1)


def _lagged(set_points: FloatArray, times: FloatArray) -> FloatArray:
    """Set-points (N, k), and behind lags of time constants in samples, (N, k (1 + n_times))."""
    none = np.zeros(set_points.shape[1])
    return np.hstack([set_points, *(acting_inputs(set_points, none, none + time, none) for time in times)])


def _cross_fitted(
    columns: FloatArray, signals: FloatArray, folds: IntArray, ridges: FloatArray = _RIDGES
) -> FloatArray:
    """Predictions of signals (N, m) from columns (N, k), each fold from the others.

    Of each signal, the ridge is the one that predicts it best.
    """
    found = np.zeros((len(ridges), *signals.shape))
    for fold in np.unique(folds):
        others = folds != fold
        centre, mean, scale = columns[others].mean(axis=0), signals[others].mean(axis=0), columns[others].std(axis=0)
        normal = (columns - centre) / np.where(scale > 0.0, scale, 1.0)
        U, S, Vt = np.linalg.svd(normal[others], full_matrices=False)
        scores, slopes = normal[~others] @ Vt.T, U.T @ (signals[others] - mean)
        for predicted, ridge in zip(found, ridges, strict=True):
            gains = S / np.maximum(S**2 + ridge * S[0] ** 2, _TINY)  # 0 where the set-points are constant
            predicted[~others] = mean + scores @ (gains[:, None] * slopes)
    best = np.square(found - signals).sum(axis=1).argmin(axis=0)
    return np.stack([found[k, :, j] for j, k in enumerate(best)], axis=1)


# ---------------------------------------------------------------------- the test


def _tests(names: Sequence[str], contrast: Contrast) -> list[HausmanTest]:
    """Hausman's test of each parameter; those that are tested share the levels (Bonferroni)."""
    known = np.isfinite(contrast.strength)
    weak: BoolArray = known & contrast.together[contrast.strength < _STRONG].any(axis=0)
    tested = known & ~weak
    error = np.sqrt(np.diag(contrast.covariance))
    clear, significant = (contrast.critical(level / max(1, int(tested.sum()))) for level in (_REJECTED, _SIGNIFICANT))
    found = list[HausmanTest]()
    for k, name in enumerate(names):
        plain, instrumented = float(contrast.plain[k]), float(contrast.instrumented[k])
        apart = abs(instrumented - plain)
        ratio = apart / max(error[k], _TINY) if apart > _NEGLIGIBLE * abs(plain) else 0.0
        outcome: Outcome = "rejected" if ratio > clear else "differs" if ratio > significant else "passed"
        if not tested[k]:
            outcome = "weak" if weak[k] else "untested"
        found.append(HausmanTest(name, plain, instrumented, float(error[k]), float(contrast.strength[k]), outcome))
    return found


def _findings(tests: Sequence[HausmanTest], names: Sequence[str], replaced: BoolArray) -> Iterator[Finding]:
    """Outcomes of the tests in words."""
    by = f"with the set-points {listed(names)} as instruments"
    for one, taken in zip(tests, replaced, strict=True):
        if one.outcome in ("rejected", "differs"):
            values = (
                f"{one.parameter} is {number(one.instrumented, 3)} {by} and {number(one.plain, 3)} by least squares"
            )
            use = "the estimate is the first" if taken else "the interval includes the difference"
            text = (
                f"Unmodelled forces are correlated with the motion: {values}, {number(one.distance, 2)} standard errors"
            )
            if one.outcome == "rejected":
                yield Finding(
                    "care", f"{text} apart; {use}", "record the motion again without the feedback, if you can"
                )
            else:
                yield Finding("note", f"{text} apart; {use}.")
    passed = [x.parameter for x in tests if x.outcome == "passed"]
    if passed:
        yield Finding("note", f"Hausman's test {by} finds no bias of least squares by feedback in {listed(passed)}.")
    weak = [x for x in tests if x.outcome == "weak"]
    if weak:
        least = number(min(x.strength for x in weak), 2)
        text = f"Set-points are weak instruments for {listed([x.parameter for x in weak])}"
        yield Finding("note", f"{text} (F = {least}, {_STRONG:.0f} are needed): whether feedback biases them is open.")
