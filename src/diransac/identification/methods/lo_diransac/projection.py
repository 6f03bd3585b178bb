"""Parameters of the whole motion by projection of what the model does not explain, and their covariance.

Where the model is exact, the parameters of the fit are the estimate.  Where it is not, the log is explained by
parameters and discrepancies together, in proportions that depend on the noise.  The estimate is then that of least
squares on noise-free data: ``W p = b`` is solved again on the fitted motion, so that the component of the discrepancies
in the regressor's column space is attributed to the parameters.  Equations are weighted by their inertial forces.

Noise hardly biases the slopes of a regression on the fitted accelerations: these are posterior means, whose errors are
uncorrelated with themselves (Berkson 1950).  Where it is not white they follow it, and means over windows of several
intervals have less of it and less information: estimates over windows of each length compete (`competition`).  The
motion of a state that nothing measures follows from the equations and from its unmodelled accelerations: a regression
on it would attenuate its parameters, and these accelerations are not attributed to them.

The covariance has four parts: that of the fit and of the errors of its sensors, propagated through the projection;
that of the unmodelled forces outside the regressor's column space, as a sample of forces that differ from log to log;
and, because a constant deviation from the model is not averaged out, the changes under a tenfold wider prior on model
error and under least squares without a robust loss.

A Gaussian prior of a parameter is a term of the fit, so that the parameters of an exact model have it already.  The
projection is a regression on the motion, which leaves priors out: its result and covariance are combined with them as
two independent Gaussian estimates, which is exact where the model is affine in its parameters and the errors are
Gaussian.  So that no prior counts twice, the covariance of the fit is taken with priors that are a hundred times as
wide, and the combination has what is left of their precision.

References
----------
Plumlee 2017 (discrepancies orthogonal to the model); White 1982 (inference under a wrong model).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray, size_or_one
from diransac.identification.core.equations import effect_on, linearize
from diransac.identification.core.fit import weights_of
from diransac.identification.core.rows import CAUCHY, Loss, Rows, inclusive_bounds, solve
from diransac.identification.methods.lo_diransac.interval_effects import batch_sums, effect_of_intervals
from diransac.identification.methods.lo_diransac.motion_equations import (
    means_of_intervals,
    residuals_of_motion,
    unexplained,
)
from diransac.identification.methods.lo_diransac.unmeasured import unmeasured_states
from diransac.identification.regression.uncertainty import combined

if TYPE_CHECKING:
    from diransac.identification.core.fit import Fit
    from diransac.identification.core.windows import Windows

_WIDER = 100.0
"""Factor of the standard deviations of priors in the covariance that is combined with them."""
_EQUATIONS = 8
"""Equations per parameter in the longest windows."""


@dataclass(frozen=True, eq=False, repr=False)
class ProjectedEstimate:
    """Parameters that hold for the whole motion.

    Parameters
    ----------
    parameters : (n,) array
        Each in its unit, per-log parameters of every log included.
    covariance : (n, n) array
    unexplained : (W, n_v) array
        Mean over each window of the accelerations that the model with these parameters does not explain; 0 where an
        interval has no row that counts.
    windows : (n_windows,) int array
        First intervals of the windows over which the equations were averaged.
    of_z, of_s : (W, k, n) and (n_s, n) array
        Derivatives of the parameters that were read from a fit with respect to its unknowns.
    of_fit : (n,) array
        Those parameters, of which the estimate may be a mean with others, or to which it was preferred.
    """

    parameters: FloatArray
    covariance: FloatArray
    unexplained: FloatArray
    windows: IntArray
    of_z: FloatArray
    of_s: FloatArray
    of_fit: FloatArray


def estimate_parameters(intervals: Windows, fit: Fit) -> ProjectedEstimate:
    """Parameters that solve the equations on the fitted motion by least squares, and their covariance.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
        Most probable motion.

    Returns
    -------
    ProjectedEstimate
        Within the inclusive bounds; parameters on them have an infinite variance.
    """
    _, estimate, _, _ = next(projected_candidates(intervals, fit))
    return estimate()


def projected_candidates(
    intervals: Windows, fit: Fit
) -> Iterator[tuple[float, Callable[[], ProjectedEstimate], FloatArray, FloatArray]]:
    """Least squares on the fitted motion over windows of one interval, of two, of four, ..., while equations are many.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
        Most probable motion.

    Yields
    ------
    float
        Length of the windows, s.
    callable
        The estimate with its covariance.
    (n,) array
        Parameters.
    (W, n) array
        Contributions of the intervals to their error.
    """
    wide = _with_wide_priors(intervals, fit)
    now, rows = wide.shared[: intervals.n_p], _Rows.of(intervals, wide)
    for windows in _windows(intervals, len(now), rows.latent.shape[1]):
        p, gains, _ = _bounded_projection(intervals, now, rows, windows, CAUCHY)
        seconds = intervals.duration * float(np.diff(windows, append=len(intervals)).max())
        parts = _parts(intervals, rows, gains)
        del gains  # of every row: found again for an estimate that is asked for
        yield seconds, partial(_completed, intervals, fit, rows, windows), p, parts


def _completed(intervals: Windows, fit: Fit, rows: _Rows, windows: IntArray) -> ProjectedEstimate:
    """The estimate over some windows with its covariance, and with priors."""
    found = _solution(intervals, _with_wide_priors(intervals, fit), rows, windows)
    return _combined_with_priors(intervals, fit, found) if len(intervals.layout.with_prior) else found


def _windows(intervals: Windows, n: int, n_v: int) -> Iterator[IntArray]:
    """First intervals of windows of one interval, of two, of four, ..., as long as equations are many."""
    place = np.arange(len(intervals)) - np.searchsorted(intervals.log_of, intervals.log_of)
    size = 1
    while True:
        windows = np.flatnonzero(place % size == 0)
        if size > 1 and len(windows) * n_v < _EQUATIONS * n:
            return
        yield windows
        size *= 2


def projected_parameters(intervals: Windows, fit: Fit) -> FloatArray:
    """Parameters ``(n,)`` that solve the equations on the fitted motion by least squares, without priors.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
        Most probable motion.

    Returns
    -------
    (n,) array
        Within the inclusive bounds.
    """
    now, rows = fit.shared[: intervals.n_p], _Rows.of(intervals, fit)
    return _bounded_projection(intervals, now, rows, np.arange(len(intervals)), CAUCHY)[0]


def fitted_parameters(intervals: Windows, fit: Fit) -> ProjectedEstimate:
    """The parameters of the fit, and their covariance.

    The covariance of the fit assumes white noise.  It is increased where the scores of neighbouring intervals, which
    the noise of a sensor correlates, scatter more (the sandwich of Huber 1967, by batches).

    Parameters
    ----------
    intervals : Windows
    fit : Fit

    Returns
    -------
    ProjectedEstimate
    """
    effect = effect_of_intervals(intervals, fit)
    scatter = np.square(batch_sums(effect.steps)).sum(axis=0)
    more = np.sqrt(np.maximum(1.0, scatter / (np.diag(effect.covariance) + np.finfo(float).tiny)))
    p = fit.shared[: intervals.n_p]
    covariance = effect.covariance * np.outer(more, more) + effect_on(intervals, fit, effect.z, effect.s)
    left, windows = unexplained(intervals, fit, p), np.arange(len(intervals))
    return ProjectedEstimate(p, covariance, left, windows, np.zeros_like(effect.z), np.eye(*effect.s.shape), p)


def _with_wide_priors(intervals: Windows, fit: Fit) -> Fit:
    """The fit with priors of the parameters that hardly count, but keep its equations definite."""
    factor = np.where(np.arange(len(fit.prior)) < intervals.n_p, _WIDER, 1.0)
    return replace(fit, prior=factor * fit.prior)


def _combined_with_priors(intervals: Windows, fit: Fit, found: ProjectedEstimate) -> ProjectedEstimate:
    """The estimate combined with what its covariance lacks of the priors.  Parameters on a bound stay there."""
    layout = intervals.layout
    variance = np.square(layout.prior_std[layout.with_prior]) / (1.0 - _WIDER**-2)
    mean = layout.prior_mean[layout.with_prior]
    p, covariance = combined(found.parameters, found.covariance, layout.with_prior, mean, variance)
    unit, none = np.eye(len(p)), np.zeros(len(mean))
    shrunk = np.stack([combined(x, found.covariance, layout.with_prior, none, variance)[0] for x in unit])
    found = replace(found, of_z=found.of_z @ shrunk, of_s=found.of_s @ shrunk, of_fit=p, covariance=covariance)
    return with_parameters(intervals, fit, found, p)


def with_parameters(
    intervals: Windows, fit: Fit, found: ProjectedEstimate, parameters: FloatArray
) -> ProjectedEstimate:
    """The estimate with other parameters, and what these leave unexplained of the fitted motion.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
    found : ProjectedEstimate
    parameters : (n,) array

    Returns
    -------
    ProjectedEstimate
    """
    left = _over_windows(unexplained(intervals, fit, parameters), found.windows)
    return replace(found, parameters=parameters, unexplained=left)


@dataclass(frozen=True, eq=False, repr=False)
class _Rows:
    """Equations on the fitted motion, ``r(p) = g + M d`` with discrepancies g and unmodelled accelerations d.

    Parameters
    ----------
    W : (N, n_v, n) array
    push : (N, n_v) array
        g in every row.
    means : (W, n_v, n) array
        W in the mean over each interval.
    M : (W, n_v, n_v) array
    latent : (W, n_v) array
        ``M d``.
    attributed : (n_v,) bool array
        Equations of which ``M d`` is attributed to the parameters: those of measured motion.
    inertial : (W, n_v) array
        Mean inertial force of each equation.
    """

    W: FloatArray
    push: FloatArray
    means: FloatArray
    M: FloatArray
    latent: FloatArray
    attributed: BoolArray
    inertial: FloatArray

    @classmethod
    def of(cls, intervals: Windows, fit: Fit) -> _Rows:
        """Equations of the logged rows."""
        motion, push, W, M = residuals_of_motion(intervals, fit, fit.shared)
        logged = intervals.counted[:, None]
        push, W, M = push * logged, W * logged[:, :, None], M * logged[:, :, None]
        push = push - np.einsum("nij,nj->ni", M, np.repeat(fit.d, intervals.length, axis=0))
        M = means_of_intervals(intervals, M)
        inertial = np.einsum("wij,wj->wi", M, means_of_intervals(intervals, motion[2]))
        latent, hidden = np.einsum("wij,wj->wi", M, fit.d), unmeasured_states(intervals)
        attributed = np.array([name not in hidden for name in intervals.model.velocities])
        return cls(W, push, means_of_intervals(intervals, W), M, latent, attributed, inertial)


def _solution(intervals: Windows, fit: Fit, rows: _Rows, windows: IntArray) -> ProjectedEstimate:
    """Parameters, and the first two parts of their covariance.

    The component of the discrepancies and of the unmodelled accelerations in the regressor's column space is attributed
    to the parameters: of the discrepancies row by row; of the accelerations, which are constant over an interval, by
    interval means.
    """
    now = fit.shared[: intervals.n_p]
    p, gains, stuck = _bounded_projection(intervals, now, rows, windows, CAUCHY)
    plain = _bounded_projection(intervals, now, rows, windows, None)[0]
    slopes = _slopes(intervals, fit, rows, gains)
    covariance = _covariance_of_fit(intervals, fit, *slopes)
    sums = batch_sums(_parts(intervals, rows, gains))
    covariance = covariance + sums.T @ sums + np.outer(plain - p, plain - p)
    covariance[stuck] = covariance[:, stuck] = 0.0
    covariance[stuck, stuck] = np.inf
    left = _over_windows(unexplained(intervals, fit, p), windows)
    return ProjectedEstimate(p, covariance, left, windows, slopes[0] * ~stuck, slopes[1] * ~stuck, p)


def _slopes(
    intervals: Windows, fit: Fit, rows: _Rows, gains: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Derivatives (W, k, n) and (n_s, n) of projected parameters with respect to the unknowns of the fit."""
    n_p, n_s, n_x = intervals.n_p, len(fit.shared), fit.x.shape[1]
    by_rows, by_means = gains
    of_s, of_z = np.zeros((n_s, n_p)), np.zeros((len(intervals), n_x + fit.d.shape[1], n_p))
    level = np.hstack([np.ones((len(rows.push), 1)), intervals.inputs])
    of_s[:n_p] = np.eye(n_p)
    of_s[n_p:] = -np.einsum("pni,nk->ikp", by_rows, level).reshape(-1, n_p)
    of_z[:, n_x:] = -np.einsum("pwi,wij->wjp", by_means * rows.attributed, rows.M)
    return of_z, of_s


def _covariance_of_fit(intervals: Windows, fit: Fit, of_z: FloatArray, of_s: FloatArray) -> FloatArray:
    """Covariance (n, n) of the fit and of the errors of its sensors, propagated through the projection."""
    at = linearize(intervals, fit, weights_of(intervals, fit))
    z, s = at.system.functional(of_z, of_s)
    return np.asarray(np.einsum("wkc,wkd->cd", of_z, z) + of_s.T @ s + effect_on(intervals, fit, z, s))


def _parts(intervals: Windows, rows: _Rows, gains: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Contributions of each interval's unmodelled forces to the error of the parameters, (W, n)."""
    by_rows, by_means = gains
    unmade = rows.latent - rows.means @ np.einsum("pwi,wi->p", by_means, rows.latent)
    unpushed = rows.push - rows.W @ np.einsum("pni,ni->p", by_rows, rows.push)
    of_rows = np.einsum("pni,ni->np", by_rows, unpushed).reshape(len(intervals), intervals.length, -1).sum(axis=1)
    return np.asarray(np.einsum("pwi,wi->wp", by_means, unmade) + of_rows)


def _bounded_projection(
    intervals: Windows, now: FloatArray, rows: _Rows, windows: IntArray, loss: Loss | None
) -> tuple[FloatArray, tuple[FloatArray, FloatArray], BoolArray]:
    """Parameters within inclusive bounds, gains of rows (n, N, n_v) and of means (n, W, n_v), and those on a bound.

    Arguments are the parameters of the fit, the equations on its motion, the first intervals of the windows over which
    these are averaged, and a loss.
    """
    lower, upper = inclusive_bounds(intervals.layout.bounds)
    stuck, p = np.zeros(len(now), bool), now
    for _ in range(len(now) + 1):
        free = ~stuck
        left = rows.latent * rows.attributed + rows.means[:, :, stuck] @ (p - now)[stuck]
        known = rows.means[:, :, free] @ now[free] - left - means_of_intervals(intervals, rows.push)
        gains = tuple(np.zeros((len(now), *x.shape[:2])) for x in (rows.W, rows.means))
        for gain, one in zip(gains, _gains(intervals, rows, free, known, windows, loss), strict=True):
            gain[free] = one
        found = now - np.einsum("pni,ni->p", gains[0], rows.push) - np.einsum("pwi,wi->p", gains[1], left)
        p = np.where(stuck, p, found)
        outside = (p < lower) | (p > upper)
        if not outside.any():
            break
        p, stuck = np.clip(p, lower, upper), stuck | outside
    return p, (gains[0], gains[1]), stuck


def _gains(
    intervals: Windows, rows: _Rows, free: BoolArray, known: FloatArray, windows: IntArray, loss: Loss | None
) -> tuple[FloatArray, FloatArray]:
    """Effects on the free parameters of every row (n, N, n_v), and of every interval (n, W, n_v).

    Equations of intervals have the known sides ``known (W, n_v)``.  Scales are inertial forces, so that unmodelled
    accelerations count by their share of the motion: an equation that is wrong throughout, as by the gain of its input,
    has its say on the parameters that it shares with others.  A gust of a second, or friction where it changes sign, is
    no reason to change the parameters of the whole motion.
    """
    W, b, inertial = (means_of_windows(x, windows) for x in (rows.means[:, :, free], known, rows.inertial))
    occupied = np.logical_or.reduceat(intervals.occupied, windows)
    weights = occupied[:, None] / size_or_one(np.sqrt(np.square(inertial).mean(axis=0)))
    solution = solve(Rows(W, b), weights, loss=loss)
    if len(windows) == len(intervals):
        every = np.repeat(solution.weights, intervals.length, axis=0)
        return solve(Rows(rows.W[:, :, free], rows.push), every).gains, solution.gains
    sizes = np.diff(windows, append=len(intervals))
    of_intervals = np.repeat(solution.gains / sizes[:, None], sizes, axis=1)
    return np.repeat(of_intervals / intervals.length, intervals.length, axis=1), of_intervals


def means_of_windows(values: FloatArray, windows: IntArray) -> FloatArray:
    """Means over windows of intervals.

    Parameters
    ----------
    values : (W, ...) array
        Of each interval.
    windows : (n_windows,) int array
        First interval of each window.

    Returns
    -------
    (n_windows, ...) array
    """
    sizes = np.diff(windows, append=len(values)).reshape(-1, *(1,) * (values.ndim - 1))
    return np.asarray(np.add.reduceat(values, windows, axis=0) / sizes)


def _over_windows(values: FloatArray, windows: IntArray) -> FloatArray:
    """The mean of its window in every interval (W, n)."""
    return np.repeat(means_of_windows(values, windows), np.diff(windows, append=len(values)), axis=0)
