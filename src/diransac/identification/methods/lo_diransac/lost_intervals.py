"""Intervals that a fit has lost: many samples of a signal pass for outliers there, because the initial state is wrong.

Of a state that nothing measures, a likelihood with outliers has more than one optimum, as where a thrust is the same
for either sense of rotation.  The state of such an interval is estimated again, from that of unmeasured states in the
interval after it, by gradually decreasing scales (graduated non-convexity).

References
----------
Blake, Zisserman 1987, "Visual reconstruction".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.identification.methods.lo_diransac.normal_equations import with_residuals
from diransac.identification.methods.lo_diransac.unmeasured import unmeasured_states

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.normal_equations import Fit
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals

__all__ = ["with_lost_intervals_restarted"]

# Outliers of a signal in an interval that is lost: so many standard deviations more than there are elsewhere, and this
# share of its samples, and so many of them.
_UNUSUAL, _LOST, _FEWEST = 5.0, 0.2, 5
# Scales of the noise, over its own, and steps at each; damping of a step, over the diagonal.
_SCALES, _STEPS, _DAMPING = (30.0, 10.0, 3.0, 1.0), 4, 1e-3
# Log likelihood of the samples of an interval by which another optimum is likelier.
_LIKELIER = 5.0
_TINY = 1e-300


def with_lost_intervals_restarted(intervals: ShootingIntervals, fit: Fit) -> Fit | None:
    """The fit with other initial states of lost intervals, where their samples are likelier.

    The intervals beside them are to follow: jumps are left to the steps that come after.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit

    Returns
    -------
    Fit or None
        None where no interval is lost, or no other state is likelier.
    """
    hidden = [intervals.model.state.index(name) for name in unmeasured_states(intervals)]
    if not hidden:
        return None
    lost = _in_doubt(intervals, fit)
    begin = fit.x[lost]
    begin[:, hidden] = fit.x[np.minimum(lost + 1, len(fit.x) - 1)][:, hidden]
    own, found = (
        _estimated(intervals, fit, x, lost, scales) for x, scales in ((fit.x[lost], _SCALES[-1:]), (begin, _SCALES))
    )
    better = _losses(intervals, fit, found, lost) < _losses(intervals, fit, own, lost) - _LIKELIER
    if not better.any():
        return None
    x = fit.x.copy()
    x[lost[better]] = found[better]
    return with_residuals(intervals, replace(fit, x=x))


def _in_doubt(intervals: ShootingIntervals, fit: Fit) -> IntArray:
    """Intervals that follow none, to which no state leads, and those with unusually many outliers of a signal."""
    outlying = intervals.known & (fit.noise.inlying(fit.residuals, intervals.known) < 0.5)
    n_outliers, n = (z.reshape(len(intervals), intervals.length, -1).sum(axis=1) for z in (outlying, intervals.known))
    share = n_outliers.sum(axis=0) / np.maximum(n.sum(axis=0), 1)
    unusual = n_outliers > share * n + _UNUSUAL * np.sqrt(share * (1.0 - share) * n)
    lost = (unusual & (n_outliers >= np.maximum(_LOST * n, _FEWEST))).any(axis=1)
    return np.flatnonzero(lost | ~intervals.following)


def _estimated(
    intervals: ShootingIntervals, fit: Fit, begin: FloatArray, lost: IntArray, scales: Sequence[float]
) -> FloatArray:
    """Initial states (n, n_x) of these intervals by robust least squares of their own samples, at scales of noise."""
    x, n_x, rows = fit.x.copy(), fit.x.shape[1], intervals.rows_of(lost)
    x[lost] = begin
    weights, diagonal = np.zeros_like(intervals.measured), np.arange(n_x)
    for scale in np.repeat(scales, _STEPS):
        noise = replace(fit.noise, sigma=scale * fit.noise.sigma)
        residuals, _ = intervals.simulated(fit.shared, x, fit.d, lost)
        weights[rows] = noise.inlying(residuals, intervals.known[rows]) / np.square(noise.sigma)
        sums = intervals.gauss_newton(fit.shared, x, fit.d, weights, chosen=lost)
        H = sums.normal_matrix[:, :n_x, :n_x].copy()
        H[:, diagonal, diagonal] = (1.0 + _DAMPING) * H[:, diagonal, diagonal] + _TINY
        x[lost] -= np.linalg.solve(H, sums.gradient[:, :n_x, None])[:, :, 0]
    return x[lost]


def _losses(intervals: ShootingIntervals, fit: Fit, x: FloatArray, lost: IntArray) -> FloatArray:
    """Negative log-likelihood (n,) of the samples of the lost intervals from initial states (n, n_x)."""
    states = fit.x.copy()
    states[lost] = x
    residuals, _ = intervals.simulated(fit.shared, states, fit.d, lost)
    known = intervals.known[intervals.rows_of(lost)]
    losses = fit.noise.negative_log_likelihood(residuals, known).reshape(len(lost), -1).sum(axis=1)
    return np.asarray(np.nan_to_num(losses, nan=np.inf))
