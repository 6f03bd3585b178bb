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

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.identification.methods.lo_diransac.hypotheses import WeakForm
from diransac.identification.methods.lo_diransac.normal_equations import linearize, weights_of
from diransac.identification.methods.lo_diransac.recording_errors import effect_on
from diransac.identification.methods.lo_diransac.smoothing import split_signals
from diransac.identification.methods.lo_diransac.unmeasured import unmeasured_states
from diransac.identification.regression.uncertainty import combined, student_quantile
from diransac.simulation.compiler import compile_map

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.normal_equations import Fit
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
    from diransac.identification.methods.lo_diransac.smoothing import Motion
    from diransac.model import Model
    from diransac.simulation.compiler import Map

__all__ = [
    "EffectOfIntervals",
    "ProjectedEstimate",
    "batch_sums",
    "discrepancy_units",
    "effect_of_intervals",
    "equations_of_rows",
    "estimate_parameters",
    "fitted_parameters",
    "inertia_slopes",
    "inertial_forces",
    "least_squares_gains",
    "means_of_intervals",
    "means_of_windows",
    "parameter_units",
    "projected_candidates",
    "projected_parameters",
    "residuals_of_motion",
    "unexplained",
    "with_parameters",
]


_TINY, _UPPER, _NORMAL_UPPER = 1e-300, 0.975, 1.959963984540054
# Relative change of a parameter for derivatives of the inertia, and the smallest parameter of which it is one.
_DIFFERENCE = 1e-4
# Factor of the standard deviations of priors in the covariance that is combined with them.
_WIDER = 100.0
# Equations per parameter in the longest windows.
_EQUATIONS = 8
# Steps of reweighting, the width of Cauchy's loss in standard deviations, and what is rounding of an equation's scale.
_REWEIGHTED, _CAUCHY, _ROUNDING = 4, 2.385, 1e-9
# Fewest batches of correlated intervals.
_BATCHES = 4


@dataclass(frozen=True)
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


def estimate_parameters(intervals: ShootingIntervals, fit: Fit) -> ProjectedEstimate:
    """Parameters that solve the equations on the fitted motion by least squares, and their covariance.

    Parameters
    ----------
    intervals : ShootingIntervals
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
    intervals: ShootingIntervals, fit: Fit
) -> Iterator[tuple[float, Callable[[], ProjectedEstimate], FloatArray, FloatArray]]:
    """Least squares on the fitted motion over windows of one interval, of two, of four, ..., while equations are many.

    Parameters
    ----------
    intervals : ShootingIntervals
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
        p, gains, stuck = _bounded_projection(intervals, now, rows, windows, _REWEIGHTED)
        seconds = intervals.duration * float(np.diff(windows, append=len(intervals)).max())
        yield (
            seconds,
            partial(_completed, intervals, fit, rows, windows, p, gains, stuck),
            p,
            _parts(intervals, rows, gains),
        )


def _completed(
    intervals: ShootingIntervals,
    fit: Fit,
    rows: _Rows,
    windows: IntArray,
    p: FloatArray,
    gains: tuple[FloatArray, FloatArray],
    stuck: BoolArray,
) -> ProjectedEstimate:
    """The estimate over some windows with its covariance, and with priors."""
    found = _solution(intervals, _with_wide_priors(intervals, fit), rows, windows, p, gains, stuck)
    return _combined_with_priors(intervals, fit, found) if len(intervals.layout.with_prior) else found


def _windows(intervals: ShootingIntervals, n: int, n_v: int) -> Iterator[IntArray]:
    """First intervals of windows of one interval, of two, of four, ..., as long as equations are many."""
    place = np.arange(len(intervals)) - np.searchsorted(intervals.log_of, intervals.log_of)
    size = 1
    while True:
        windows = np.flatnonzero(place % size == 0)
        if size > 1 and len(windows) * n_v < _EQUATIONS * n:
            return
        yield windows
        size *= 2


def projected_parameters(intervals: ShootingIntervals, fit: Fit) -> FloatArray:
    """Parameters ``(n,)`` that solve the equations on the fitted motion by least squares, without priors.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
        Most probable motion.

    Returns
    -------
    (n,) array
        Within the inclusive bounds.
    """
    now, rows = fit.shared[: intervals.n_p], _Rows.of(intervals, fit)
    return _bounded_projection(intervals, now, rows, np.arange(len(intervals)), _REWEIGHTED)[0]


def fitted_parameters(intervals: ShootingIntervals, fit: Fit) -> ProjectedEstimate:
    """The parameters of the fit, and their covariance.

    The covariance of the fit assumes white noise.  It is increased where the scores of neighbouring intervals, which
    the noise of a sensor correlates, scatter more (the sandwich of Huber 1967, by batches).

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit

    Returns
    -------
    ProjectedEstimate
    """
    effect = effect_of_intervals(intervals, fit)
    scatter = np.square(batch_sums(effect.steps)).sum(axis=0)
    more = np.sqrt(np.maximum(1.0, scatter / (np.diag(effect.covariance) + _TINY)))
    p = fit.shared[: intervals.n_p]
    covariance = effect.covariance * np.outer(more, more) + effect_on(intervals, fit, effect.z, effect.s)
    left, windows = unexplained(intervals, fit, p), np.arange(len(intervals))
    return ProjectedEstimate(p, covariance, left, windows, np.zeros_like(effect.z), np.eye(*effect.s.shape), p)


@dataclass(frozen=True)
class EffectOfIntervals:
    """Change of a fit's parameters by each interval's measurements, to first order.

    Parameters
    ----------
    steps : (W, n) array
        Changes; zero in sum at the optimum, without priors.
    covariance : (n, n) array
        Of the parameters by white noise.
    z, s : (W, k, n) and (n_s, n) array
        Result of `Arrowhead.functional` for the parameters.
    """

    steps: FloatArray
    covariance: FloatArray
    z: FloatArray
    s: FloatArray


def effect_of_intervals(intervals: ShootingIntervals, fit: Fit) -> EffectOfIntervals:
    """Effect of each interval's measurements on the parameters of a fit.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
        At its optimum.

    Returns
    -------
    EffectOfIntervals
    """
    n_p, n_s, k = intervals.n_p, len(fit.shared), fit.x.shape[1] + fit.d.shape[1]
    at = linearize(intervals, fit, weights_of(intervals, fit))
    z, s = at.system.functional(np.zeros((len(intervals), k, n_p)), np.eye(n_s, n_p))
    steps = np.einsum("wkp,wk->wp", z, at.data_z) + at.data_s @ s
    return EffectOfIntervals(steps, s[:n_p], z, s)


def _with_wide_priors(intervals: ShootingIntervals, fit: Fit) -> Fit:
    """The fit with priors of the parameters that hardly count, but keep its equations definite."""
    factor = np.where(np.arange(len(fit.prior)) < intervals.n_p, _WIDER, 1.0)
    return replace(fit, prior=factor * fit.prior)


def _combined_with_priors(intervals: ShootingIntervals, fit: Fit, found: ProjectedEstimate) -> ProjectedEstimate:
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
    intervals: ShootingIntervals, fit: Fit, found: ProjectedEstimate, parameters: FloatArray
) -> ProjectedEstimate:
    """The estimate with other parameters, and what these leave unexplained of the fitted motion.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
    found : ProjectedEstimate
    parameters : (n,) array

    Returns
    -------
    ProjectedEstimate
    """
    left = _over_windows(unexplained(intervals, fit, parameters), found.windows)
    return replace(found, parameters=parameters, unexplained=left)


@dataclass(frozen=True)
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
    def of(cls, intervals: ShootingIntervals, fit: Fit) -> _Rows:
        """Equations of the logged rows."""
        evaluate, motion = _residual_map(intervals.model), _motion(intervals, fit)
        logged = intervals.counted[:, None]
        push, W, M = (x * logged for x in evaluate(*motion, _row_parameters(intervals, fit.shared)))
        W, M = _regressors(intervals, W), _matrices(M, intervals.model.n_v)
        push = push - np.einsum("nij,nj->ni", M, np.repeat(fit.d, intervals.length, axis=0))
        M = means_of_intervals(intervals, M)
        inertial = np.einsum("wij,wj->wi", M, means_of_intervals(intervals, motion[2]))
        latent, hidden = np.einsum("wij,wj->wi", M, fit.d), unmeasured_states(intervals)
        attributed = np.array([name not in hidden for name in intervals.model.velocities])
        return cls(W, push, means_of_intervals(intervals, W), M, latent, attributed, inertial)


def _solution(
    intervals: ShootingIntervals,
    fit: Fit,
    rows: _Rows,
    windows: IntArray,
    p: FloatArray,
    gains: tuple[FloatArray, FloatArray],
    stuck: BoolArray,
) -> ProjectedEstimate:
    """Parameters, and the first two parts of their covariance.

    The component of the discrepancies and of the unmodelled accelerations in the regressor's column space is attributed
    to the parameters: of the discrepancies row by row; of the accelerations, which are constant over an interval, by
    interval means.
    """
    plain = _bounded_projection(intervals, fit.shared[: intervals.n_p], rows, windows, 0)[0]
    slopes = _slopes(intervals, fit, rows, gains)
    covariance = _covariance_of_fit(intervals, fit, *slopes)
    sums = batch_sums(_parts(intervals, rows, gains))
    covariance = covariance + sums.T @ sums + np.outer(plain - p, plain - p)
    covariance[stuck] = covariance[:, stuck] = 0.0
    covariance[stuck, stuck] = np.inf
    left = _over_windows(unexplained(intervals, fit, p), windows)
    return ProjectedEstimate(p, covariance, left, windows, slopes[0] * ~stuck, slopes[1] * ~stuck, p)


def _slopes(
    intervals: ShootingIntervals, fit: Fit, rows: _Rows, gains: tuple[FloatArray, FloatArray]
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


def _covariance_of_fit(intervals: ShootingIntervals, fit: Fit, of_z: FloatArray, of_s: FloatArray) -> FloatArray:
    """Covariance (n, n) of the fit and of the errors of its sensors, propagated through the projection."""
    at = linearize(intervals, fit, weights_of(intervals, fit))
    z, s = at.system.functional(of_z, of_s)
    return np.asarray(np.einsum("wkc,wkd->cd", of_z, z) + of_s.T @ s + effect_on(intervals, fit, z, s))


def _parts(intervals: ShootingIntervals, rows: _Rows, gains: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Contributions of each interval's unmodelled forces to the error of the parameters, (W, n)."""
    by_rows, by_means = gains
    unmade = rows.latent - rows.means @ np.einsum("pwi,wi->p", by_means, rows.latent)
    unpushed = rows.push - rows.W @ np.einsum("pni,ni->p", by_rows, rows.push)
    of_rows = np.einsum("pni,ni->np", by_rows, unpushed).reshape(len(intervals), intervals.length, -1).sum(axis=1)
    return np.asarray(np.einsum("pwi,wi->wp", by_means, unmade) + of_rows)


def _bounded_projection(
    intervals: ShootingIntervals, now: FloatArray, rows: _Rows, windows: IntArray, reweighted: int
) -> tuple[FloatArray, tuple[FloatArray, FloatArray], BoolArray]:
    """Parameters within inclusive bounds, gains of rows (n, N, n_v) and of means (n, W, n_v), and those on a bound.

    Arguments are the parameters of the fit, the equations on its motion, the first intervals of the windows over which
    these are averaged, and the number of steps of reweighting.
    """
    lower = np.array([-np.inf if x.positive else x.lower for x in intervals.layout.bounds])
    upper = np.array([x.upper for x in intervals.layout.bounds])
    stuck, p = np.zeros(len(now), bool), now
    for _ in range(len(now) + 1):
        free = ~stuck
        left = rows.latent * rows.attributed + rows.means[:, :, stuck] @ (p - now)[stuck]
        known = rows.means[:, :, free] @ now[free] - left - means_of_intervals(intervals, rows.push)
        gains = tuple(np.zeros((len(now), *x.shape[:2])) for x in (rows.W, rows.means))
        for gain, one in zip(gains, _gains(intervals, rows, free, known, windows, reweighted), strict=True):
            gain[free] = one
        found = now - np.einsum("pni,ni->p", gains[0], rows.push) - np.einsum("pwi,wi->p", gains[1], left)
        p = np.where(stuck, p, found)
        outside = (p < lower) | (p > upper)
        if not outside.any():
            break
        p, stuck = np.clip(p, lower, upper), stuck | outside
    return p, (gains[0], gains[1]), stuck


def _gains(
    intervals: ShootingIntervals, rows: _Rows, free: BoolArray, known: FloatArray, windows: IntArray, reweighted: int
) -> tuple[FloatArray, FloatArray]:
    """Effects on the free parameters of every row (n, N, n_v), and of every interval (n, W, n_v).

    Equations of intervals have the known sides ``known (W, n_v)``.
    """
    if len(windows) == len(intervals):
        weak = WeakForm(rows.means[:, :, free], known)
        weights = _robust_weights(weak, intervals.occupied, _rms(rows.inertial), reweighted)
        every = np.repeat(weights, intervals.length, axis=0)
        return least_squares_gains(rows.W[:, :, free], every), least_squares_gains(weak.W, weights)
    W, b, inertial = (means_of_windows(x, windows) for x in (rows.means[:, :, free], known, rows.inertial))
    sizes = np.diff(windows, append=len(intervals))
    occupied = np.logical_or.reduceat(intervals.occupied, windows)
    gains = least_squares_gains(W, _robust_weights(WeakForm(W, b), occupied, _rms(inertial), reweighted))
    of_intervals = np.repeat(gains / sizes[:, None], sizes, axis=1)
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


def _rms(inertial: FloatArray) -> FloatArray:
    """Inertial force of each equation; 1 for one without."""
    scale = np.sqrt(np.square(inertial).mean(axis=0))
    return np.where(scale > 0.0, scale, 1.0)


def _robust_weights(rows: WeakForm, occupied: BoolArray, scale: FloatArray, steps: int) -> FloatArray:
    """Square roots of the weights ``(W, n_v)``: of the equations by their scales, and of intervals by Cauchy's loss.

    Scales are inertial forces, so that unmodelled accelerations count by their share of the motion: an equation that is
    wrong throughout, as by the gain of its input, has its say on the parameters that it shares with others.  A gust of
    a second, or friction where it changes sign, is no reason to change the parameters of the whole motion.
    """
    loss = np.ones(rows.b.shape)
    for _ in range(steps):
        gains = least_squares_gains(rows.W, loss / scale)
        left = rows.b - rows.W @ np.einsum("pwi,wi->p", gains, rows.b)
        spread = 1.4826 * np.median(np.abs(left[occupied]), axis=0)
        loss = 1.0 / np.sqrt(1.0 + np.square(left / (_CAUCHY * np.maximum(spread, _ROUNDING * scale))))
    return np.asarray(loss / scale)


def least_squares_gains(W: FloatArray, weights: FloatArray) -> FloatArray:
    """``(W'VW)^-1 W'V`` of stacked matrices: the effect of each row of each equation on the parameters.

    Parameters
    ----------
    W : (N, r, n) array
    weights : (N, r) or (r,) array
        Square roots of the diagonal of V.

    Returns
    -------
    (n, N, r) array
    """
    weights = np.broadcast_to(weights, W.shape[:2])
    rows = (W * weights[:, :, None]).reshape(W.shape[0] * W.shape[1], W.shape[2])
    scale = np.linalg.norm(rows, axis=0)
    scale[scale == 0.0] = 1.0
    rows = rows / scale
    normal = rows.T @ rows
    if not np.isfinite(normal).all():  # LAPACK would print to the terminal
        raise np.linalg.LinAlgError("the regressors of the fitted motion are not finite")
    inverse = np.linalg.lstsq(normal, np.eye(len(normal)), rcond=None)[0]
    solved = (inverse / scale[:, None]) @ rows.T
    return np.asarray(solved.reshape(-1, *W.shape[:2]) * weights)


def batch_sums(values: FloatArray) -> FloatArray:
    """Sums over neighbouring intervals: their squares count what neighbours have in common.

    A batch has about sqrt(W) intervals, or as many as a first-order autoregression of a column asks for (Andrews 1991,
    Bartlett's kernel), but a quarter of them at most: a slow current pushes one way for a third of a log.  Sums are
    increased by Student's t for their number, so that a normal interval has its level, and long ones by what an
    estimate takes from so few.

    Parameters
    ----------
    values : (W, n) array
        Contributions of the intervals to the error of an estimate.

    Returns
    -------
    (n_batches, n) array
    """
    usual = round(np.sqrt(len(values)))
    sums = _sums_of_batches(values, usual)
    for j, length in enumerate(_correlated(values)):
        if length > usual:
            few = _sums_of_batches(values[:, j], length)
            variance = np.square(few).sum() * len(few) / (len(few) - 1)
            sums[:, j] *= np.sqrt(max(variance / (np.square(sums[:, j]).sum() + _TINY), 1.0))
    return sums


def _sums_of_batches(values: FloatArray, length: int) -> FloatArray:
    """Sums over ``length`` intervals each, increased for their number."""
    sums = np.add.reduceat(values, np.arange(0, len(values), length), axis=0)
    return np.asarray(sums * student_quantile(max(len(sums) - 1, 1), _UPPER) / _NORMAL_UPPER)


def _correlated(values: FloatArray) -> IntArray:
    """Intervals ``(n,)`` that a batch of each column takes by its correlation with the next interval."""
    power = np.square(values).sum(axis=0) + _TINY
    rho = np.clip((values[1:] * values[:-1]).sum(axis=0) / power, 0.0, 1.0 - 1.0 / len(values))
    alpha = np.square(2.0 * rho / ((1.0 - rho) * (1.0 + rho)))
    wanted = np.ceil(1.1447 * np.cbrt(alpha * len(values)))
    return np.asarray(np.minimum(wanted, len(values) // _BATCHES), int)


def unexplained(intervals: ShootingIntervals, fit: Fit, parameters: FloatArray) -> FloatArray:
    """``M^-1 r``: mean over each interval of the fitted accelerations that the model does not explain.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
    parameters : (n,) array

    Returns
    -------
    (W, n_v) array
        0 where an interval has no row that counts.
    """
    p = _row_parameters(intervals, parameters)
    residuals, _, M = _residual_map(intervals.model)(*_motion(intervals, fit), p)
    left = np.linalg.solve(_matrices(M, intervals.model.n_v), residuals[:, :, None])[:, :, 0]
    logged = intervals.counted[:, None].astype(float)
    return means_of_intervals(intervals, left * logged) / np.maximum(means_of_intervals(intervals, logged), _TINY)


def residuals_of_motion(
    intervals: ShootingIntervals, fit: Fit, parameters: FloatArray
) -> tuple[tuple[FloatArray, ...], FloatArray, FloatArray, FloatArray]:
    """Residuals of the equations on the fitted motion, and their derivatives.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
    parameters : (n,) array

    Returns
    -------
    tuple of (N, ...) array
        q, v, a, the inputs as they act, and the model's parameters in every row.
    (N, n_v) array
        Residuals r.
    (N, n_v, n) array
        dr/dp, columns in the places of each log's parameters.
    (N, n_v, n_v) array
        M = dr/da.
    """
    model, motion, p = intervals.model, _motion(intervals, fit), _row_parameters(intervals, parameters)
    r, W, M = _residual_map(model)(*motion, p)
    rows = np.broadcast_to(p, (len(r), model.n_p))
    return (*motion, rows), r, _regressors(intervals, W), _matrices(M, model.n_v)


def equations_of_rows(
    model: Model, q: FloatArray, v: FloatArray, u: FloatArray, p: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Accelerations of the model at any states and inputs, and its regressors there.

    Parameters
    ----------
    model : Model
    q, v, u, p : (N, n) array
        In every row.

    Returns
    -------
    (N, n_v) array, (N, n_v, n_p) array
        Not finite where the model has no acceleration.
    """
    r, _, M = _residual_map(model)(q, v, np.zeros((len(q), model.n_v)), u, p)
    M = _matrices(M, model.n_v)
    usable = np.flatnonzero(np.isfinite(M).all(axis=(1, 2)) & np.isfinite(r).all(axis=1))
    usable = usable[np.linalg.matrix_rank(M[usable]) == model.n_v]
    a: FloatArray = np.full((len(q), model.n_v), np.nan)
    a[usable] = -np.linalg.solve(M[usable], r[usable, :, None])[:, :, 0]
    return a, np.asarray(_matrices(_residual_map(model)(q, v, a, u, p)[1], model.n_p))


def inertia_slopes(intervals: ShootingIntervals, motion: Sequence[FloatArray], rows: IntArray) -> FloatArray:
    """Derivatives of ``M = dr/da`` with respect to the parameters in some rows, by differences.

    Parameters
    ----------
    intervals : ShootingIntervals
    motion : sequence of (N, ...) array
        q, v, a, the inputs as they act, and the model's parameters in every row.
    rows : (R,) int array

    Returns
    -------
    (R, n_v, n_v, n) array
        Columns in the places of each log's parameters.
    """
    model, (*at, p) = intervals.model, (x[rows] for x in motion)

    def inertia(changed: FloatArray) -> FloatArray:
        return _residual_map(model)(*at, changed)[2]

    before, columns = inertia(p), []
    for j in range(model.n_p):
        changed = p.copy()
        changed[:, j] += _DIFFERENCE * np.maximum(np.abs(p[:, j]), _DIFFERENCE)
        columns.append((inertia(changed) - before) / (changed - p)[:, j : j + 1])
    slopes = _by_log(intervals, np.stack(columns, axis=2), intervals.log_of_row[rows])
    return np.asarray(slopes.reshape(len(rows), model.n_v, model.n_v, -1).swapaxes(1, 2))


def discrepancy_units(intervals: ShootingIntervals, motion: Motion, p: FloatArray) -> FloatArray:
    """Discrepancies that equal the inertial force of their equation.

    Parameters
    ----------
    intervals : ShootingIntervals
    motion : Motion
        Smoothed motion over the rows of the intervals.
    p : (n,) array
        Parameters of a hypothesis.

    Returns
    -------
    (n_shared,) array
        Infinite for parameters.
    """
    force = inertial_forces(intervals, motion, p)
    force[force == 0.0] = 1.0  # nor do discrepancies of what is at rest
    level = np.append(1.0, np.sqrt(np.square(intervals.inputs).mean(axis=0)))
    level[level == 0.0] = 1.0  # the gain of an input that never acts stays at its prior
    return np.concatenate([np.full(intervals.n_p, np.inf), (force[:, None] / level).ravel()])


def parameter_units(intervals: ShootingIntervals, motion: Motion, p: FloatArray) -> FloatArray:
    """Change of each parameter that equals the inertial force of an equation, or the spread of a sensor.

    Parameters
    ----------
    intervals : ShootingIntervals
    motion : Motion
        Smoothed motion over the rows of the intervals.
    p : (n,) array
        Parameters of a hypothesis.

    Returns
    -------
    (n,) array
        The smallest over equations and sensors, each in its parameter's unit; 0 where a parameter never acts.
    """
    model = intervals.model
    W = _residual_map(intervals.model)(*_smoothed(intervals, motion), _row_parameters(intervals, p, logged=True))[1]
    logs = intervals.log_of_row[intervals.counted]
    W, aims = _matrices(W, model.n_p), inertial_forces(intervals, motion, p)
    if model.measurement is not None:
        S = _sensor_slopes(model)(*_smoothed(intervals, motion), _row_parameters(intervals, p, logged=True))[0]
        W = np.concatenate([W, _matrices(S, model.n_p)], axis=1)
        aims = np.concatenate([aims, motion.spread[-len(model.sensors) :]])
    sizes = np.sqrt(np.square(_by_log(intervals, W, logs)).mean(axis=0)).T
    smallest = (aims / np.maximum(sizes, _TINY)).min(axis=1)
    return np.asarray(np.where(sizes.any(axis=1), smallest, 0.0))


def inertial_forces(intervals: ShootingIntervals, motion: Motion, p: FloatArray) -> FloatArray:
    """RMS of ``M a`` of each equation.

    Parameters
    ----------
    intervals : ShootingIntervals
    motion : Motion
        Smoothed motion over the rows of the intervals.
    p : (n,) array
        Parameters of a hypothesis.

    Returns
    -------
    (n_v,) array
    """
    q, v, a, u = _smoothed(intervals, motion)
    n_v = intervals.model.n_v
    own = _row_parameters(intervals, p, logged=True)
    M = _residual_map(intervals.model)(q, v, a, u, own)[2].reshape(len(a), n_v, n_v)
    return np.asarray(np.sqrt(np.square(np.einsum("nji,nj->ni", M, a)).mean(axis=0)))


def _smoothed(intervals: ShootingIntervals, motion: Motion) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Smoothed coordinates, velocities, accelerations and the inputs of all logged rows."""
    model, logged = intervals.model, intervals.counted
    q, v, a, _ = motion.parts(model, logged)
    return q, v, a, intervals.inputs[logged]


def _motion(intervals: ShootingIntervals, fit: Fit) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Fitted coordinates, velocities and accelerations, and the inputs as they act, each (N, n)."""
    model = intervals.model
    series = intervals.rollouts.trajectories(intervals.batch(fit.shared, fit.x, fit.d))
    q, v, a, _ = split_signals(model, series.reshape(len(intervals.measured), -1))
    return q, v, a, intervals.inputs


def _row_parameters(intervals: ShootingIntervals, values: FloatArray, *, logged: bool = False) -> FloatArray:
    """Parameters of the model: one vector for all rows, or (N, n_p) where logs differ; of logged rows, or all."""
    logs = intervals.log_of_row[intervals.counted] if logged else intervals.log_of_row
    return intervals.parameters_of(values[: intervals.n_p], logs)


def _regressors(intervals: ShootingIntervals, columns: FloatArray) -> FloatArray:
    """Regressors (N, r, n) from matrices that were stored column by column; zero in other logs' parameters."""
    return _by_log(intervals, _matrices(columns, intervals.model.n_p), intervals.log_of_row)


def _by_log(intervals: ShootingIntervals, W: FloatArray, logs: IntArray) -> FloatArray:
    """Regressors (N, r, n_p) of rows with their columns in the places of their logs (N, r, n)."""
    if intervals.layout.is_shared:
        return W
    full = np.zeros((*W.shape[:2], intervals.n_p))
    np.put_along_axis(full, np.broadcast_to(intervals.layout.index[logs][:, None, :], W.shape), W, axis=2)
    return full


@lru_cache(maxsize=64)
def _residual_map(model: Model) -> Map:
    """Residuals, and their derivatives with respect to parameters and accelerations, column by column."""
    q, v, a, u, p = (ca.SX.sym(n, model.residual.size1_in(i)) for i, n in enumerate("qvaup"))
    r = model.residual(q, v, a, u, p)
    slopes = [ca.densify(ca.jacobian(r, x)) for x in (p, a)]
    return compile_map(ca.Function("residuals", [q, v, a, u, p], [ca.densify(r), *slopes]))


@lru_cache(maxsize=64)
def _sensor_slopes(model: Model) -> Map:
    """Derivatives of the sensors with respect to parameters, column by column."""
    assert model.measurement is not None
    q, v, a, u, p = (ca.SX.sym(n, model.residual.size1_in(i)) for i, n in enumerate("qvaup"))
    S = ca.densify(ca.jacobian(model.measurement(q, v, a, u, p), p))
    return compile_map(ca.Function("sensor_slopes", [q, v, a, u, p], [S]))


def means_of_intervals(intervals: ShootingIntervals, rows: FloatArray) -> FloatArray:
    """Mean of each interval.

    Parameters
    ----------
    intervals : ShootingIntervals
    rows : (N, ...) array

    Returns
    -------
    (W, ...) array
    """
    return np.asarray(rows.reshape(len(intervals), intervals.length, *rows.shape[1:]).mean(axis=1))


def _matrices(columns: FloatArray, n_columns: int) -> FloatArray:
    """Matrices (N, r, n_columns) that were stored column by column."""
    return columns.reshape(len(columns), n_columns, -1).swapaxes(1, 2)
