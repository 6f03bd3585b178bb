"""Periodic motions that excite a machine within limits: Fourier series, information on parameters, its optimisation.

References
----------
Swevers et al. 1997, "Optimal robot excitation and identification", IEEE Trans. Robotics and Automation 13(5): Fourier
series, D-optimality. Park 2006, "Fourier-based optimal excitation trajectories for the dynamic identification of
robots", Robotica 24(5): series at rest at their ends.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray

__all__ = [
    "DesignProblem",
    "FourierSeries",
    "Limited",
    "Observed",
    "Search",
    "best_motion",
    "drawn_motion",
    "grid",
    "motion_of",
    "resting_pose",
]


_LAST_BARRIER, _BARRIER_FACTOR = 1e-4, 0.3
"""Last barrier parameter, and what it is reduced by: it is the change of the objective per active limit."""


_FRACTION = 0.99
"""Of the way to a limit that a step may take."""


@dataclass(frozen=True)
class FourierSeries:
    """Functions of time with a period, at whose ends velocity and acceleration are zero.

    ``c + sum_l s_l sin(l w t) + c_l cos(l w t)`` with ``sum_l l s_l = 0`` and ``sum_l l^2 c_l = 0``: the coefficients
    are those of an orthonormal basis of the sines and cosines that satisfy both, followed by the constant.

    Parameters
    ----------
    period : float
        s.
    n_harmonics : int
        At least 2.
    """

    period: float
    n_harmonics: int

    @property
    def n_coefficients(self) -> int:
        """Coefficients of a function."""
        return 2 * self.n_harmonics - 1

    @property
    def highest(self) -> float:
        """Angular frequency of the fastest sine, rad/s."""
        return 2.0 * np.pi * self.n_harmonics / self.period

    @cached_property
    def _bases(self) -> tuple[FloatArray, FloatArray]:
        """Bases of sines and cosines, each ``(n_harmonics, n_harmonics - 1)``."""
        harmonics = np.arange(1.0, self.n_harmonics + 1.0)
        return _complement(harmonics), _complement(harmonics**2)

    def basis(self, t: FloatArray) -> FloatArray:
        """Values of the basis functions and their two derivatives ``(3, K, n_coefficients)`` at times (K,)."""
        w = 2.0 * np.pi / self.period * np.arange(1.0, self.n_harmonics + 1.0)
        sines, cosines = self._bases
        found = np.zeros((3, len(t), self.n_coefficients))
        for k, derivative in enumerate(found):
            angle = np.outer(t, w) + k * np.pi / 2.0
            derivative[:, :-1] = np.hstack([(w**k * np.sin(angle)) @ sines, (w**k * np.cos(angle)) @ cosines])
        found[0, :, -1] = 1.0
        return found

    def drawn(self, rng: np.random.Generator) -> FloatArray:
        """Coefficients (n_coefficients,) of a sum of sines with random amplitudes and phases about zero."""
        # Range of the amplitudes of a drawn motion, as of `multisine`.
        size = rng.uniform(0.2, 0.6, self.n_harmonics)
        phase = rng.uniform(0.0, 2.0 * np.pi, self.n_harmonics)
        sines, cosines = self._bases
        return np.concatenate([sines.T @ (size * np.cos(phase)), cosines.T @ (size * np.sin(phase)), [0.0]])


def _complement(w: FloatArray) -> FloatArray:
    """Orthonormal basis ``(n, n - 1)`` of the vectors orthogonal to one with a positive first element (Householder)."""
    u = w / np.linalg.norm(w)
    u[0] += 1.0
    reflection: FloatArray = np.eye(len(w)) - 2.0 * np.outer(u, u) / (u @ u)
    return reflection[:, 1:]


def motion_of(z: FloatArray, basis: FloatArray) -> FloatArray:
    """Positions, velocities and accelerations ``(3 n, K)`` of coefficients (n_coefficients, n)."""
    values: FloatArray = np.einsum("dkb,bn->dnk", basis, z).reshape(-1, basis.shape[1])
    return values


# Limits --------------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Limited:
    """Quantities of a motion with limits.

    Parameters
    ----------
    names : tuple of str
    function : casadi.Function
        ``(3 n) -> (m)`` from positions, velocities and accelerations.
    lower, upper : (m,) arrays
        Each in the quantity's unit; one of both may be infinite.
    """

    names: tuple[str, ...]
    function: ca.Function
    lower: FloatArray
    upper: FloatArray

    @cached_property
    def scale(self) -> FloatArray:
        """Half the range of each quantity (m,), or the size of its only limit."""
        one_sided = np.where(np.isfinite(self.upper), self.upper, self.lower)
        half = 0.5 * (self.upper - self.lower)
        return np.where(np.isfinite(half), half, np.maximum(np.abs(one_sided), 1e-12))

    def distances(self, x: FloatArray) -> FloatArray:
        """Distance to the nearer limit (m, K) in the rows of a motion (3 n, K), 1 in the middle, negative beyond."""
        values, scale = np.array(self.function(x)), self.scale[:, None]
        return np.minimum(self.upper[:, None] - values, values - self.lower[:, None]) / scale

    def margin(self, x: FloatArray) -> FloatArray:
        """Least distance to a limit (m,) over the rows of a motion (3 n, K)."""
        return np.asarray(self.distances(x).min(axis=1))

    def extremes(self, x: FloatArray) -> dict[str, tuple[float, float]]:
        """Smallest and largest value of each quantity over the rows of a motion (3 n, K)."""
        values = np.array(self.function(x))
        pairs = zip(values.min(axis=1).tolist(), values.max(axis=1).tolist(), strict=True)
        return dict(zip(self.names, pairs, strict=True))

    def shrunk(self, z: FloatArray, pose: FloatArray, basis: FloatArray, narrowed: float) -> FloatArray:
        """Coefficients between those of rest in a pose (n,) and the given ones, as near to these as limits allow.

        Parameters
        ----------
        z : (n_coefficients, n) array
        pose : (n,) array
        basis : (3, K, n_coefficients) array
            Of the rows in which the limits hold.
        narrowed : float
            What limits are narrowed by, over their scales.
        """
        rest = np.zeros_like(z)
        rest[-1] = pose

        def scaled(share: float) -> FloatArray:
            return np.asarray(rest + share * (z - rest))

        def fits(share: float) -> bool:
            return bool((self.margin(motion_of(scaled(share), basis)) >= narrowed).all())

        tried = 1.0
        if fits(tried):
            return scaled(tried)
        # Shares one after the other, not by bisection alone: limits of forces may hold, fail and hold again.
        for share in (*(1.0 - 0.002 * 2.0 ** np.arange(9.0)), *0.25 ** np.arange(1.0, 5.0), 0.0):
            if fits(share):
                break
            tried = share
        for _ in range(6):
            middle = 0.5 * (share + tried)
            share, tried = (middle, tried) if fits(middle) else (share, middle)
        return scaled(share)


def resting_pose(limited: Limited, lower: FloatArray, upper: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Pose (n,) whose distance from all limits at rest is largest, of the middle one and random ones.

    Parameters
    ----------
    limited : Limited
    lower, upper : (n,) arrays
        Limits of the coordinates; where they are infinite, the pose is zero.
    rng : Generator
    """
    bounded = np.isfinite(upper - lower)
    middle, half = np.zeros(len(lower)), np.zeros(len(lower))
    middle[bounded] = 0.5 * (lower + upper)[bounded]
    # Fraction of the ranges of the coordinates in which poses are drawn.
    half[bounded] = 0.5 * 0.8 * (upper - lower)[bounded]
    poses = np.vstack([middle, middle + half * rng.uniform(-1.0, 1.0, (200, len(middle)))])
    rest = np.zeros((3 * len(middle), 1))
    margins = np.empty(len(poses))
    for k, pose in enumerate(poses):
        rest[: len(pose), 0] = pose
        margins[k] = limited.margin(rest).min()
    return np.asarray(poses[np.argmax(margins)])


def drawn_motion(
    series: FourierSeries, limited: Limited, pose: FloatArray, sizes: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Coefficients (n_coefficients, n) of a plain multisine about a pose, as large as the limits allow.

    Each coordinate alone is as large as the limits allow, then all are reduced in proportion.

    Parameters
    ----------
    series : FourierSeries
    limited : Limited
    pose : (n,) array
        Within the limits at rest.
    sizes : (n,) array
        Amplitude of each coordinate, at most, in its unit.
    rng : Generator
    """
    basis, whole = series.basis(grid(series)), np.zeros((series.n_coefficients, len(pose)))
    for j, size in enumerate(sizes):
        alone = np.zeros_like(whole)
        alone[-1] = pose
        alone[:-1, j] = size * series.drawn(rng)[:-1]
        whole[:, j] = limited.shrunk(alone, pose, basis, 0.0)[:, j]
    return limited.shrunk(whole, pose, basis, 0.0)


def grid(series: FourierSeries, density: int = 1) -> FloatArray:
    """Times of a period at which the optimisation evaluates a motion, s; as many times denser."""
    # Rows per period of the fastest sine in which the optimisation evaluates the information. Limits hold in
    # twice as many: forces have products of sines, of twice the frequency.
    n = density * 12 * series.n_harmonics
    return np.linspace(0.0, series.period, n, endpoint=False)


# Information ---------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Observed:
    """Equations of motion as observations of the parameters: their derivatives, with noise of unit variance.

    Parameters
    ----------
    function : casadi.Function
        ``(3 n) -> (n_p, n_v)``, the transposed derivatives over the noise, from positions, velocities, accelerations.
    directions : (n_p, n_r) array
        Basis of the directions of the parameters that motions show, scaled by the size of their columns.
    identifiable : (n_p,) bool array
        Parameters that lie in these directions.
    """

    function: ca.Function
    directions: FloatArray
    identifiable: BoolArray

    @classmethod
    def of(cls, function: ca.Function, motions: FloatArray) -> Observed:
        """Observations with the directions that random motions (3 n, K) show."""
        J = np.array(function(motions)).T
        sizes = np.linalg.norm(J, axis=0)
        sizes[sizes == 0.0] = 1.0
        _, strengths, axes = np.linalg.svd(J / sizes, full_matrices=True)
        # Size of a direction, relative to the largest, below which no motion shows it; columns have unit
        # length.
        n_shown = int((strengths > 1e-6 * max(strengths[0], 1e-300)).sum())
        hidden = np.linalg.norm(axes[n_shown:], axis=0)
        # Share of a parameter in such directions above which it is not identifiable.
        return cls(function, axes[:n_shown].T / sizes[:, None], hidden < 1e-3)

    def information(self, x: FloatArray) -> FloatArray:
        """Fisher information (n_r, n_r) of the directions over the rows of a motion (3 n, K)."""
        M = self.directions.T @ np.array(self.function(x))
        return np.asarray(M @ M.T)

    def log_determinant(self, x: FloatArray) -> float:
        """Logarithm of the determinant of the information; minus infinity where it is singular."""
        sign, value = np.linalg.slogdet(self.information(x))
        return float(value) if sign > 0.0 else -np.inf

    def standard_errors(self, x: FloatArray) -> FloatArray:
        """Standard errors (n_p,) of least squares from the rows of a motion (3 n, K); infinite if not identifiable."""
        information = self.information(x)
        whole = np.full(len(self.identifiable), np.inf)
        if np.linalg.cond(information) < 1.0 / np.finfo(float).eps:
            variances = np.einsum("ij,jk,ik->i", self.directions, np.linalg.inv(information), self.directions)
            whole[self.identifiable] = np.sqrt(variances[self.identifiable])
        return whole


# Optimisation --------------------------------------------------------------------------------------------------------
@dataclass
class Search:
    """Limits of an optimisation, and what it has taken.

    Parameters
    ----------
    iterations : int
        At most.
    deadline : float
        By the monotonic clock, s.
    progress : callable, optional
        Called with the stage and the done fraction.
    """

    iterations: int
    deadline: float
    progress: Callable[[str, float], None] | None = None
    taken: int = 0
    out_of_time: bool = False
    converged: bool = False

    @property
    def reason(self) -> str:
        """Reason for the end of the search."""
        if self.out_of_time:
            return f"the time limit was reached after {self.taken} iterations"
        return f"converged after {self.taken} iterations" if self.converged else f"{self.taken} iterations, the limit"

    def goes_on(self) -> bool:
        """Count an iteration; False if there is none left."""
        self.out_of_time = time.monotonic() > self.deadline
        if self.out_of_time or self.converged or self.taken >= self.iterations:
            return False
        self.taken += 1
        if self.progress is not None:
            self.progress(f"iteration {self.taken}", self.taken / self.iterations)
        return True


class _Point(NamedTuple):
    """A motion's coefficients over sizes x (n,), objective f, distances from limits c (m,), and derivatives."""

    x: FloatArray
    f: float
    c: FloatArray
    gradient: FloatArray
    jacobian: FloatArray


class DesignProblem:
    """Nonlinear program: minimise the mean logarithm of standard errors with distances ``c(x) > 0`` from the limits.

    Parameters
    ----------
    series : FourierSeries
    limited : Limited
    observed : Observed
        Observations in the rows of the grid.
    sizes : (n,) array
        Scale of each coordinate.
    free : (n_coefficients, n) bool array
        Coefficients that are unknowns.
    start : (n_coefficients, n) array
        Within the narrowed limits; the objective is zero there.
    limit_times : (K,) array
        Times of a period at which the limits hold, s.
    narrowed : float
        What the limits are narrowed by, over their scales.
    """

    def __init__(
        self,
        series: FourierSeries,
        limited: Limited,
        observed: Observed,
        sizes: FloatArray,
        free: BoolArray,
        start: FloatArray,
        limit_times: FloatArray,
        narrowed: float,
    ) -> None:
        self._basis, self._limit_basis = series.basis(grid(series)), series.basis(limit_times)
        self._sizes, self._free, self._start = sizes, free, start
        self._limited, self._observed, self._narrowed = limited, observed, narrowed
        x = ca.SX.sym("x", 3 * len(sizes))
        slopes = ca.jacobian(limited.function(x) / ca.DM(limited.scale), x)
        self._slopes = ca.Function("slopes", [x], [ca.densify(slopes)])
        self._adjoint = observed.function.reverse(1)
        self._finite = np.concatenate([np.isfinite(limited.lower), np.isfinite(limited.upper)])
        # In these directions the information of the start is the identity.
        root = np.linalg.cholesky(observed.information(motion_of(start, self._basis)))
        self._directions = np.linalg.solve(root, observed.directions.T)

    def coefficients(self, x: FloatArray) -> FloatArray:
        """Coefficients (n_coefficients, n) of unknowns."""
        z = self._start / self._sizes
        z[self._free] = x
        return z * self._sizes

    def unknowns(self) -> FloatArray:
        """Unknowns of the start."""
        return np.asarray((self._start / self._sizes)[self._free])

    def values(self, x: FloatArray) -> tuple[float, FloatArray]:
        """Objective and distances from the limits (m,) over their scales."""
        z = self.coefficients(x)
        M = self._directions @ np.array(self._observed.function(motion_of(z, self._basis)))
        sign, logarithm = np.linalg.slogdet(M @ M.T)
        f = -0.5 * logarithm / len(M) if sign > 0.0 else np.inf
        limited, values = self._limited, np.array(self._limited.function(motion_of(z, self._limit_basis)))
        both = np.vstack([values - limited.lower[:, None], limited.upper[:, None] - values])
        scaled = both / np.tile(limited.scale, 2)[:, None] - self._narrowed
        return float(f), scaled[self._finite].ravel()

    def point(self, x: FloatArray) -> _Point:
        """Values and derivatives."""
        f, c = self.values(x)
        z, n = self.coefficients(x), len(self._sizes)
        motion = motion_of(z, self._basis)
        whole = self._observed.function(motion)
        M = self._directions @ np.array(whole)
        seeds = -self._directions.T @ np.linalg.solve(M @ M.T, M) / len(M)
        by_motion = np.array(self._adjoint(motion, whole, seeds)).reshape(3, n, -1)
        gradient = np.einsum("dnk,dkb->bn", by_motion, self._basis) * self._sizes
        slopes = np.array(self._slopes(motion_of(z, self._limit_basis)))
        by_row = slopes.reshape(len(self._limited.names), -1, 3, n)
        jacobian = np.einsum("mkdn,dkb->mkbn", by_row, self._limit_basis) * self._sizes
        both = np.concatenate([jacobian, -jacobian])[self._finite][:, :, self._free]
        return _Point(x, f, c, gradient[self._free], both.reshape(len(c), -1))


def best_motion(problem: DesignProblem, search: Search, barrier: float) -> FloatArray:
    """Coefficients (n_coefficients, n) of a motion with a locally least objective.

    A primal-dual interior-point method with a damped BFGS approximation of the Lagrangian's Hessian. There are few
    unknowns and many limits, so that it eliminates the multipliers; all iterates keep the limits.

    Parameters
    ----------
    problem : DesignProblem
    search : Search
        Limits; it counts the iterations.
    barrier : float
        First barrier parameter; a small one stays near the start.

    References
    ----------
    Nocedal and Wright 2006, "Numerical Optimization", chapter 19 and procedure 18.2.
    """
    at, mu = problem.point(problem.unknowns()), barrier
    multipliers, hessian, before = mu / at.c, np.eye(len(at.x)), np.inf
    search.converged = False
    while search.goes_on():
        scaled = at.jacobian * (multipliers / at.c)[:, None]
        pull = at.jacobian.T @ (mu / at.c) - at.gradient
        step = np.asarray(np.linalg.solve(hessian + at.jacobian.T @ scaled, pull), np.float64)
        change = (mu - multipliers * (at.jacobian @ step)) / at.c - multipliers
        after = _along(problem, at, step, mu)
        multipliers = multipliers + _share_inside(multipliers, change) * change
        hessian = _updated(hessian, after, at, multipliers)
        at = after
        merit = at.f - mu * np.log(at.c).sum()
        # Decrease of the barrier function per unknown, over the barrier parameter, below which that is
        # reduced.
        if before - merit < 1e-2 * mu * len(at.x):
            search.converged = mu <= _LAST_BARRIER
            mu, merit = max(_LAST_BARRIER, _BARRIER_FACTOR * mu), np.inf
        before = merit
    return problem.coefficients(at.x)


def _share_inside(values: FloatArray, change: FloatArray) -> float:
    """Largest step, 1 at most, that leaves positive values a small fraction of themselves."""
    shrinking = change < 0.0
    return min(1.0, float((-_FRACTION * values[shrinking] / change[shrinking]).min(initial=1.0)))


def _along(problem: DesignProblem, at: _Point, step: FloatArray, mu: float) -> _Point:
    """Point on the way of a step, by backtracking on the barrier function; the point itself if none is better."""
    merit = at.f - mu * np.log(at.c).sum()
    slope = at.gradient @ step - mu * ((at.jacobian @ step) / at.c).sum()
    share = _share_inside(at.c, at.jacobian @ step)
    for _ in range(12):
        f, c = problem.values(at.x + share * step)
        if (c > (1.0 - _FRACTION) * at.c).all() and f - mu * np.log(c).sum() <= merit + 1e-4 * share * slope:
            return problem.point(at.x + share * step)
        share *= 0.5
    return at


def _updated(hessian: FloatArray, after: _Point, before: _Point, multipliers: FloatArray) -> FloatArray:
    """Damped BFGS update (Powell) of the Lagrangian's Hessian; the identity after a step of no length."""
    s = after.x - before.x
    if not s.any():
        return np.eye(len(s))
    y = after.gradient - before.gradient - (after.jacobian - before.jacobian).T @ multipliers
    Hs = hessian @ s
    curvature, found = float(s @ Hs), float(s @ y)
    theta = 1.0 if found >= 0.2 * curvature else 0.8 * curvature / (curvature - found)
    r = theta * y + (1.0 - theta) * Hs
    return np.asarray(hessian - np.outer(Hs, Hs) / curvature + np.outer(r, r) / (s @ r))
