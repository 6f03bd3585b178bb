"""Findings of a fit on itself: errors of sensors, parameters that change, methods that disagree."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.identification.estimate import Finding
from diransac.identification.methods.lo_diransac.hypotheses import robust_scores, weak_form
from diransac.identification.methods.lo_diransac.projection import (
    batch_sums,
    least_squares_gains,
    means_of_intervals,
    means_of_windows,
    residuals_of_motion,
)
from diransac.identification.methods.lo_diransac.recording_errors import delays_of_inputs
from diransac.text_table import number, percent

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.local_search import Explanation
    from diransac.identification.methods.lo_diransac.normal_equations import Fit
    from diransac.identification.methods.lo_diransac.projection import ProjectedEstimate
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
    from diransac.identification.methods.lo_diransac.smoothing import Motion

__all__ = ["Change", "changes_between_halves", "findings_of_fit"]

# A difference of parameters: so many standard errors, and this part of the parameter; from the second on it is serious.
_CLEAR, _DIFFERENT, _SERIOUS = 4.0, 0.03, 0.05
# Delay of an input that is worth a sentence, samples.
_SMALL_DELAY = 0.1
# Residual of an equation over that of the worst, at least.
_SMALLEST = 1e-6
_TINY = 1e-300
# Log residual of each signal that is as small.
_AS_WELL = 0.03
# Intervals of half the logs from which parameters and their scatter are estimated, at least.
_FEWEST_INTERVALS = 9


@dataclass(frozen=True)
class Change:
    """A parameter that differs between the halves of the logs: a payload, a battery, a machine that wears.

    Parameters
    ----------
    index : int
        Of the parameter.
    first, second : float
        Its value in each half, its unit.
    """

    index: int
    first: float
    second: float

    @property
    def apart(self) -> float:
        """Difference over the mean of both."""
        return abs(self.first - self.second) / max(0.5 * (abs(self.first) + abs(self.second)), _TINY)

    @property
    def variance(self) -> float:
        """Variance over the log of a parameter that changes uniformly, with these means over its halves."""
        return (self.first - self.second) ** 2 / 3.0


def findings_of_fit(
    found: Explanation, motion: Motion, result: ProjectedEstimate, changes: Sequence[Change]
) -> Iterator[Finding]:
    """Findings for and against an estimate.

    Parameters
    ----------
    found : Explanation
    motion : Motion
        Smoothed motion over the rows of the intervals.
    result : ProjectedEstimate
    changes : sequence of Change
        Result of `changes_between_halves`.

    Returns
    -------
    iterator of Finding
    """
    if found.intervals.hold != "zero-order" and not found.intervals.lag:
        how = {"linear": "linearly", "smooth": "smoothly"}[found.intervals.hold]
        yield Finding("note", f"Inputs that vary {how} between samples explain this log better than held ones.")
    yield from _of_recordings(found.intervals, found.refinement.fit)
    yield from (_of_change(found.intervals.layout.names[x.index], x) for x in changes)
    if not found.exact:
        yield from _of_plain_least_squares(found.intervals, motion, result)


def _of_recordings(intervals: ShootingIntervals, fit: Fit) -> Iterator[Finding]:
    """Delays and biases of sensors, own delays of inputs, and drifts of their gains."""
    errors = intervals.all_errors
    signals = np.array(intervals.model.signals)
    for delay in dict.fromkeys(errors.delay[errors.delay != 0.0].tolist()):
        late = signals[errors.delay == delay]
        names = f"{', '.join(late[:-1])} and {late[-1]} are" if len(late) > 1 else f"{late[0]} is"
        time, sense = number(1e3 * abs(delay) * intervals.dt, 3), "late" if delay > 0.0 else "early"
        text = f"{names} recorded {time} ms {sense} with respect to the other signals"
        yield Finding("care", f"{text}, a sensor delay that the estimate includes.")
    for name, bias in zip(signals, errors.bias, strict=True):
        if bias:
            size, unit = number(bias, 3), intervals.model.units[name]
            yield Finding("care", f"{name} has a sensor bias of {size} {unit}, which the estimate includes.")
    own = delays_of_inputs(intervals, fit) if errors.input_delay.any() else np.zeros(len(intervals.model.inputs))
    for name, delay, drift in zip(intervals.model.inputs, own, errors.gain_drift, strict=True):
        if abs(delay) > _SMALL_DELAY:
            time, sense = number(1e3 * abs(delay) * intervals.dt, 3), "later" if delay > 0.0 else "earlier"
            yield Finding("care", f"{name} acts {time} ms {sense} than recorded, a delay that the estimate includes.")
        if drift:
            moves = f"{'rises' if drift > 0.0 else 'falls'} by {percent(abs(drift))} during the log"
            holds = "the estimate includes this drift, and its parameters are those of the beginning"
            yield Finding("care", f"The gain of {name} {moves}, as with a battery that sags: {holds}.")


def _of_change(name: str, change: Change) -> Finding:
    first, second = number(change.first, 3), number(change.second, 3)
    text = f"{name} changes during the log, from {first} in its first half to {second} in its second"
    advice = "a payload, a drifting gain or another regime; identify stretches of the log one by one"
    return Finding("bad" if change.apart > _SERIOUS else "care", f"{text}: {advice}.")


def changes_between_halves(found: Explanation, result: ProjectedEstimate) -> list[Change]:
    """Parameters that clearly differ between the halves of the logs.

    Parameters
    ----------
    found : Explanation
    result : ProjectedEstimate

    Returns
    -------
    list of Change
        Empty where the model is exact.
    """
    intervals = found.intervals
    place = np.arange(len(intervals)) - np.searchsorted(intervals.log_of, intervals.log_of)
    first = (place < 0.5 * np.bincount(intervals.log_of)[intervals.log_of])[result.windows]
    if found.exact or min(first.sum(), (~first).sum()) < _FEWEST_INTERVALS:
        return []
    _, rows, regressors, _ = residuals_of_motion(intervals, found.refinement.fit, result.parameters)
    W = means_of_intervals(intervals, regressors * intervals.counted[:, None, None])
    residuals = means_of_intervals(intervals, rows * intervals.counted[:, None])
    W, residuals = (means_of_windows(x, result.windows) for x in (W, residuals))
    moved, variances = zip(*(_change(W[half], residuals[half]) for half in (first, ~first)), strict=True)
    halves, errors = result.parameters[None] + np.array(moved), np.sqrt(sum(variances))
    both = [Change(k, *x) for k, x in enumerate(halves.T.tolist())]
    determined = np.isfinite(np.diag(result.covariance))
    return [
        x
        for x, s, ok in zip(both, errors, determined, strict=True)
        if ok and abs(x.first - x.second) > _CLEAR * s and x.apart > _DIFFERENT
    ]


def _change(W: FloatArray, residuals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Change ``(n,)`` of parameters by least squares of some rows, and its variance by batches of them."""
    scale = np.sqrt(np.square(residuals).mean(axis=0))
    gains = least_squares_gains(W, 1.0 / np.maximum(scale, _SMALLEST * scale.max() + 1e-300))
    change = -np.einsum("pwi,wi->p", gains, residuals)
    left = residuals + W @ change
    sums = batch_sums(np.einsum("pwi,wi->wp", gains, left))
    return change, np.square(sums).sum(axis=0)


def _of_plain_least_squares(
    intervals: ShootingIntervals, motion: Motion, result: ProjectedEstimate
) -> Iterator[Finding]:
    """Parameters of plain least squares of the smoothed motion that lie far outside their intervals.

    They are no alarm where simulations with them agree less with the log.
    """
    if intervals.model.nonlinear_parameters:
        return
    weak = weak_form(intervals, motion)
    everything: BoolArray = np.ones((1, *weak.b.shape), bool)
    plain = weak.solve(everything)[0]
    both, seen = np.array([plain, result.parameters]), intervals.known.any(axis=0)
    worse, own = robust_scores(intervals, motion, both, np.arange(len(intervals)))
    if not worse < own + _AS_WELL * seen.sum():
        return
    _, variance = _change(weak.W, weak.W @ plain - weak.b)
    error = np.sqrt(variance + np.diag(result.covariance))
    solved: BoolArray = np.asarray(weak.W.any(axis=(0, 1)))
    for name, a, b, s, ok in zip(intervals.layout.names, plain, result.parameters, error, solved, strict=True):
        apart, size = abs(a - b), abs(b)
        if ok and np.isfinite(s) and apart > _CLEAR * s and apart > _SERIOUS * size:
            text = (
                f"Plain least squares explains the log as well, with {name} = {number(a, 3)} far outside the interval"
            )
            yield Finding("care", f"{text}: noise of the smoothed motion, or a term that the model lacks.")
