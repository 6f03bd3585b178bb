"""The quadratic model of all intervals together: measurements, continuity, and priors.

Unknowns are those that all intervals share (parameters, discrepancies), and at the start of each interval w the
state x_w and an unmodelled acceleration d_w that acts over the interval.  With ``F`` the rollout of an interval,
``kappa`` the standard deviation of continuity and m the prior means of the shared unknowns (zero for
discrepancies), twice the cost is

    sum W |y - y(x_w, s, d_w)|^2 + sum |x_{w+1} - F(x_w, s, d_w)|^2 / kappa^2 + sum |e_w|^2 / tau^2
        + |s - m|^2 / prior^2 + sum |x_w - m_w|^2 / s_w^2

and where a fit begins with a window of a log, that of its `BoundaryPrior`, which includes ``e_0``.  The second sum
is over neighbours within one log.  Unmodelled accelerations are a first-order Gauss-Markov process:
``e_w`` is ``(d_w - rho d_{w-1}) / sqrt(1 - rho^2)``, and ``d_w`` where a log begins.

References
----------
Bock 1987 (multiple shooting); Tremolet 2006 (weak-constraint 4D-Var).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.identification.methods.lo_diransac.arrowhead import Arrowhead

if TYPE_CHECKING:
    from collections.abc import Sequence

    from diransac.identification.methods.lo_diransac.boundary import BoundaryPrior
    from diransac.identification.methods.lo_diransac.mixture import Mixture
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals

# A prior may alone determine a parameter, with less than the ridge's part of the precision of continuity.
_FINE_RIDGE = 1e-15


@dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """A motion with its parameters, and the scales of every term of the cost.

    Parameters
    ----------
    shared : (n_s,) array
        Parameters and discrepancies.
    x : (W, n_x) array
        States at the intervals' starts.
    d : (W, n_v) array
        Unmodelled accelerations.
    residuals : (N, n_signals) array
        Simulated less measured signals.
    ends : (W, n_x) array
        States in which the intervals end.
    noise : Mixture
        Noise of each signal.
    tau : (n_v,) array
        Size of the unmodelled accelerations.
    rho : (n_v,) array
        Their correlation from interval to interval.
    continuity_std : (n_x,) array
        Size of the jumps from interval to interval.
    prior : (n_s,) array
        Size of the discrepancies; prior standard deviation of the parameters, infinite without one.
    prior_mean : (n_s,) array
        Prior means of the parameters; zero for the others.
    boundary : BoundaryPrior, optional
        What is known from before the first interval; None where nothing is.
    x_mean : (W, n_x) or (1, n_x) array
    x_std : (n_x,) array
        Gaussian prior of the states; infinite deviations without one.
    """

    shared: FloatArray
    x: FloatArray
    d: FloatArray
    residuals: FloatArray
    ends: FloatArray
    noise: Mixture
    tau: FloatArray
    rho: FloatArray
    continuity_std: FloatArray
    prior: FloatArray
    prior_mean: FloatArray
    boundary: BoundaryPrior | None = None
    x_mean: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))
    x_std: FloatArray = field(default_factory=lambda: np.full(1, np.inf))

    @property
    def at_boundary(self) -> FloatArray:
        """State and unmodelled accelerations at the start, and the shared unknowns, as one vector ``(n,)``."""
        return np.concatenate([self.x[0], self.d[0], self.shared])

    def jumps(self, intervals: ShootingIntervals) -> FloatArray:
        """States at the intervals' starts less the ends of the intervals before, (W - 1, n_x); 0 where unlinked."""
        return np.where(intervals.linked[:, None], self.x[1:] - self.ends[:-1], 0.0)


@dataclass(frozen=True, eq=False, repr=False)
class NormalEquations:
    """Gauss-Newton system at a fit.

    Parameters
    ----------
    weights : (N, n_signals) array
        Weights of the measurements, one over each signal's unit squared.
    system : Arrowhead
    right_z : (W, n_x + n_v) array
    right_s : (n_s,) array
        Right-hand side, minus the gradient: of states and unmodelled accelerations, and of the shared unknowns.
    data_z : (W, n_x + n_v) array
    data_s : (W, n_s) array
        The part of each interval's measurements in it.
    jumps : (W - 1, n_x) array
        States at the intervals' starts less the ends of the intervals before; 0 where a log or a gap ends.
    slopes : (W - 1, n_x, n) array
        Derivatives of the ends, with respect to the states and unmodelled accelerations of the interval, and to the
        shared unknowns of its log.
    precision : (W - 1, n_x) array
        Of the jumps.
    corners, rights : (W, n, n) and (W, n) array
        Information and right-hand side of the shared unknowns of each interval's log, from its measurements and its
        end.
    along : (W, n_directions, 1 + n) array
        Weighted products of changes of the residuals with these, and with their derivatives.
    """

    weights: FloatArray
    system: Arrowhead
    right_z: FloatArray
    right_s: FloatArray
    data_z: FloatArray
    data_s: FloatArray
    jumps: FloatArray
    slopes: FloatArray
    precision: FloatArray
    corners: FloatArray
    rights: FloatArray
    along: FloatArray

    def excess(self, intervals: ShootingIntervals, fit: Fit, moved: Fit) -> FloatArray:
        """Jumps ``(W - 1, n_x)`` after a step, less those that these equations expect, from the step of a fit alone.

        Parameters
        ----------
        intervals : ShootingIntervals
        fit : Fit
            Of these equations.
        moved : Fit
            After the step; not finite where a rollout diverges.
        """
        n_x = fit.x.shape[1]
        z = np.hstack([moved.x - fit.x, moved.d - fit.d])
        s = of_logs(intervals, moved.shared - fit.shared)
        linear = self.jumps + z[1:, :n_x] - np.einsum("wij,wj->wi", self.slopes, np.hstack([z, s])[:-1])
        return np.asarray(moved.jumps(intervals) - linear)

    def by_residuals(self, intervals: ShootingIntervals, along: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Change of the gradient by larger residuals.

        Parameters
        ----------
        intervals : ShootingIntervals
        along : (W, 1 + n) array
            Of a change of the residuals.

        Returns
        -------
        (W, k) array, (n_s,) array
        """
        k = self.right_z.shape[1]
        return along[:, 1 : 1 + k], sum_in_places(intervals, along[:, 1 + k :])

    def by_jumps(self, intervals: ShootingIntervals, more: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Change of the gradient by larger jumps.

        Parameters
        ----------
        intervals : ShootingIntervals
        more : (W - 1, n_x, ...) array
            0 is taken where a log or a gap ends.

        Returns
        -------
        (W, k, ...) array, (n_s, ...) array
        """
        n_x, k = more.shape[1], self.right_z.shape[1]
        along = (slice(None), slice(None), *(None,) * (more.ndim - 2))
        force = self.precision[along] * np.where(intervals.linked[:, None][along], more, 0.0)
        of_z = np.zeros((*self.right_z.shape, *more.shape[2:]))
        of_z[:-1] -= np.einsum("wij,wi...->wj...", self.slopes[:, :, :k], force, optimize=True)
        of_z[1:, :n_x] += force
        return of_z, -sum_of_products(intervals, self.slopes[:, :, k:].swapaxes(1, 2), force)


def with_residuals(intervals: ShootingIntervals, fit: Fit) -> Fit:
    """The fit with its residuals and ends over the given intervals.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit

    Returns
    -------
    Fit
    """
    residuals, ends = intervals.simulated(fit.shared, fit.x, fit.d)
    return replace(fit, residuals=residuals, ends=ends)


def split(intervals: ShootingIntervals, fit: Fit, parts: int) -> tuple[ShootingIntervals, Fit]:
    """The same motion in shorter intervals, whose unmodelled accelerations vary as much, and as slowly.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
    parts : int
        Of each interval.

    Returns
    -------
    ShootingIntervals, Fit
    """
    # The sum of correlations over time, (1 + rho) / (1 - rho) intervals, stays.
    slow = parts * (1.0 + fit.rho)
    fit = replace(fit, rho=(slow - 1.0 + fit.rho) / (slow + 1.0 - fit.rho))
    if parts == 1:
        return intervals, fit
    finer, n_x = intervals.split(parts), fit.x.shape[1]
    series = intervals.rollouts.trajectories(intervals.batch(fit.shared, fit.x, fit.d))
    x = series[:, :: finer.length, :n_x].reshape(-1, n_x).copy()  # a view would keep all rows
    return finer, with_residuals(finer, replace(fit, x=x, d=np.repeat(fit.d, parts, axis=0)))


def linearize(
    intervals: ShootingIntervals, fit: Fit, weights: FloatArray, directions: Sequence[FloatArray] = ()
) -> NormalEquations:
    """Gauss-Newton normal equations of the cost at a fit.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
    weights : (N, n_signals) array
        Weights of the measurements, one over each signal's unit squared.
    directions : sequence of (N, n_signals) array, optional
        Changes of the residuals, along which the gradient is wanted, too.

    Returns
    -------
    NormalEquations
    """
    n_x, k = fit.x.shape[1], fit.x.shape[1] + fit.d.shape[1]
    sums = intervals.gauss_newton(fit.shared, fit.x, fit.d, weights, directions=directions)
    H, g = sums.normal_matrix, -sums.gradient
    data_z, data_s = g[:, :k].copy(), _in_places(intervals, g[:, k:])
    F = sums.final_slopes[:-1]
    linked = intervals.linked
    jumps = fit.jumps(intervals)
    np.einsum("wii->wi", H)[:, :n_x] += fit.x_std**-2.0
    g[:, :n_x] -= (fit.x - fit.x_mean) * fit.x_std**-2.0
    F = F if linked.all() else np.where(linked[:, None, None], F, 0.0)
    precision = linked[:, None] / np.square(fit.continuity_std)
    FP = F.swapaxes(1, 2) * precision[:, None, :]
    H[:-1] += FP @ F
    g[:-1] += np.einsum("wij,wj->wi", FP, jumps)
    own_diagonal = np.einsum("wii->wi", H)
    own_diagonal[1:, :n_x] += precision
    H[1:, :n_x, k:] -= precision[:, :, None] * F[:, :, k:]
    g[1:, :n_x] -= precision * jumps
    E = np.zeros((len(H) - 1, k, k))
    np.multiply(-precision[:, :, None], F[:, :, :k], out=E[:, :n_x])
    follows, own = intervals.following[:, None], 1.0 / innovation_std(intervals, fit)
    rho = np.where(follows[1:], fit.rho, 0.0)
    deviation = own * innovations(intervals, fit)
    own_diagonal[:, n_x:k] += np.square(own)
    own_diagonal[:-1, n_x:k] += np.square(rho * own[1:])
    np.einsum("wii->wi", E)[:, n_x:] -= rho * np.square(own[1:])
    g[:, n_x:k] -= deviation
    g[:-1, n_x:k] += rho * deviation[1:]
    beforehand = 1.0 / np.square(fit.prior)
    corners, rights = H[:, k:, k:], g[:, k:]
    border, corner, right = _shared_blocks(intervals, H[:, :k, k:], corners, rights)
    corner = corner + np.diag(beforehand)
    right = right - beforehand * (fit.shared - fit.prior_mean)
    if fit.boundary is not None:
        known, pull = fit.boundary.information, fit.boundary.right(fit.at_boundary)
        H[0, :k, :k] += known[:k, :k]
        border[0] += known[:k, k:]
        corner += known[k:, k:]
        g[0, :k] += pull[:k]
        right += pull[k:]
    blocks = (H[:, :k, :k], E, border, corner)
    has_prior = fit.boundary is not None or len(intervals.layout.with_prior)
    system = Arrowhead(*blocks, _FINE_RIDGE) if has_prior else Arrowhead(*blocks)
    of_jumps = jumps, F, precision
    return NormalEquations(weights, system, g[:, :k], right, data_z, data_s, *of_jumps, corners, rights, sums.along)


def without_windows(intervals: ShootingIntervals, fit: Fit, at: NormalEquations) -> tuple[FloatArray, FloatArray]:
    """Normal equations of the shared unknowns, the right-hand side last, when windows that nothing ties are eliminated.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
    at : NormalEquations

    Returns
    -------
    (W, n_s, n_s + 1) array
        Of each window.
    (n_s, n_s + 1) array
        Of the priors.
    """
    right = np.concatenate([at.system.border, at.right_z[:, :, None]], axis=2)
    solved = np.linalg.solve(at.system.ridged, right)
    parts = -at.system.border.swapaxes(1, 2) @ solved
    n, places = np.arange(len(parts)), _places(intervals)[intervals.log_of]
    own = np.concatenate([at.corners, at.rights[:, :, None]], axis=2)
    columns = np.concatenate([places, np.full((len(n), 1), intervals.n_shared)], axis=1)
    parts[n[:, None, None], places[:, :, None], columns[:, None, :]] += own
    precision = np.square(fit.prior) ** -1.0
    return parts, np.column_stack([np.diag(precision), -precision * (fit.shared - fit.prior_mean)])


def variances_of_intervals(
    intervals: ShootingIntervals, fit: Fit, weights: FloatArray, z: FloatArray, s: FloatArray
) -> FloatArray:
    """Variances of functions of a fit by the noise of each interval's measurements alone, of inputs if they are noisy.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
    weights : (N, n_signals) array
        Weights of the measurements, one over the variance of each.
    z, s : (W, k, n) and (n_s, n) array
        Result of `Arrowhead.functional` for the functions' gradients.

    Returns
    -------
    (W, n, n) array
    """
    sums = intervals.gauss_newton(fit.shared, fit.x, fit.d, weights)
    own = np.concatenate([z, of_logs(intervals, s)], axis=1)
    found = own.swapaxes(1, 2) @ sums.normal_matrix @ own
    if intervals.noisy:
        by_errors = z[:, fit.x.shape[1] :] / fit.tau[:, None]
        found += by_errors.swapaxes(1, 2) @ by_errors
    return np.asarray(found)


def _places(intervals: ShootingIntervals) -> IntArray:
    """Places of the shared unknowns of each log, (n_logs, n)."""
    rest = np.arange(intervals.n_p, intervals.n_shared)
    return np.hstack([intervals.layout.index, np.broadcast_to(rest, (intervals.layout.n_logs, len(rest)))])


def of_logs(intervals: ShootingIntervals, values: FloatArray, part: slice = slice(None)) -> FloatArray:
    """Values of the shared unknowns of each interval's own log.

    Parameters
    ----------
    intervals : ShootingIntervals
    values : (n_s, ...) array
    part : slice, optional
        Intervals; all where none are given.

    Returns
    -------
    (W, n_own, ...) array
    """
    logs = intervals.log_of[part]
    if intervals.layout.is_shared:
        return np.broadcast_to(values, (len(logs), *values.shape))
    return np.asarray(values[_places(intervals)[logs]])


def _in_places(intervals: ShootingIntervals, values: FloatArray) -> FloatArray:
    """Values ``(n, ...)`` of the first intervals' own shared unknowns in the places of their logs, (n, n_s)."""
    if intervals.layout.is_shared:
        return values.copy()
    wide = np.zeros((len(values), intervals.n_shared))
    np.put_along_axis(wide, _places(intervals)[intervals.log_of[: len(values)]], values, axis=1)
    return wide


def sum_of_products(
    intervals: ShootingIntervals, a: FloatArray, b: FloatArray, part: slice = slice(None)
) -> FloatArray:
    """Sums ``(n_s, ...)`` over intervals of ``a @ b``, in the places of their logs.

    Parameters
    ----------
    intervals : ShootingIntervals
    a : (n, n_own, m) array
        Of the shared unknowns of the first intervals' own logs.
    b : (n, m, ...) array
    part : slice, optional
        Intervals, of which those are the first.
    """
    if intervals.layout.is_shared:
        return np.asarray(np.tensordot(a, b, ([0, 2], [0, 1])))
    found, logs = np.zeros((intervals.n_shared, *b.shape[2:])), intervals.log_of[part][: len(a)]
    for i, at in enumerate(_places(intervals)):
        found[at] += np.tensordot(a[logs == i], b[logs == i], ([0, 2], [0, 1]))
    return found


def sum_in_places(intervals: ShootingIntervals, values: FloatArray) -> FloatArray:
    """Sums over intervals, in the places of their logs.

    Parameters
    ----------
    intervals : ShootingIntervals
    values : (n, n_own, ...) array
        Of the shared unknowns of the first intervals' own logs.

    Returns
    -------
    (n_s, ...) array
    """
    if intervals.layout.is_shared:
        return np.asarray(values.sum(axis=0))
    found = np.zeros((intervals.n_shared, *values.shape[2:]))
    for i, at in enumerate(_places(intervals)):
        found[at] += values[intervals.log_of[: len(values)] == i].sum(axis=0)
    return found


def innovation_std(intervals: ShootingIntervals, fit: Fit) -> FloatArray:
    """Standard deviation ``(W, n_v)`` of the unmodelled accelerations, given those of the interval before.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit

    Returns
    -------
    (W, n_v) array
        Infinite of those whose prior is that of the boundary.
    """
    std = np.where(intervals.following[:, None], fit.tau * np.sqrt(1.0 - np.square(fit.rho)), fit.tau)
    if fit.boundary is not None:
        std[0] = np.inf
    return std


def innovations(intervals: ShootingIntervals, fit: Fit) -> FloatArray:
    """Unmodelled accelerations less those expected from the interval before, over their standard deviation.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit

    Returns
    -------
    (W, n_v) array
    """
    found = fit.d.copy()
    found[1:] -= np.where(intervals.linked[:, None], fit.rho, 0.0) * found[:-1]
    return np.asarray(found / innovation_std(intervals, fit))


def _shared_blocks(
    intervals: ShootingIntervals, border: FloatArray, corner: FloatArray, right: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Border ``(W, k, n_s)``, sums of corner ``(n_s, n_s)`` and right side ``(n_s,)`` in the places of each log."""
    if intervals.layout.is_shared:
        return border, corner.sum(axis=0), right.sum(axis=0)
    n_s = intervals.n_shared
    wide, whole, total = np.zeros((*border.shape[:2], n_s)), np.zeros((n_s, n_s)), np.zeros(n_s)
    for i, at in enumerate(_places(intervals)):
        own = np.flatnonzero(intervals.log_of == i)
        wide[own[:, None, None], np.arange(border.shape[1])[None, :, None], at] = border[own]
        whole[np.ix_(at, at)] += corner[own].sum(axis=0)
        total[at] += right[own].sum(axis=0)
    return wide, whole, total


def cost(intervals: ShootingIntervals, fit: Fit, weights: FloatArray) -> float:
    """Twice the cost of a fit with fixed weights.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
    weights : (N, n_signals) array
        Weights of the measurements, one over each signal's unit squared.

    Returns
    -------
    float
        Infinite where a rollout diverges.
    """
    terms = (
        np.einsum("ns,ns,ns->", weights, fit.residuals, fit.residuals),
        np.square(fit.jumps(intervals) / fit.continuity_std).sum(),
        np.square(innovations(intervals, fit)).sum(),
        np.square((fit.shared - fit.prior_mean) / fit.prior).sum(),
        np.square((fit.x - fit.x_mean) / fit.x_std).sum(),
        0.0 if fit.boundary is None else fit.boundary.cost(fit.at_boundary),
    )
    total = float(sum(terms))
    return total if np.isfinite(total) else np.inf


def weights_of(intervals: ShootingIntervals, fit: Fit) -> FloatArray:
    """Weight of each measurement: the probability that it is not an outlier, over its variance.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit

    Returns
    -------
    (N, n_signals) array
    """
    found = fit.noise.inlying(fit.residuals, intervals.known)
    found /= np.square(fit.noise.sigma)
    return found
