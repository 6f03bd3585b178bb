"""Optimisation of a periodic motion within limits: its nonlinear program, and an interior-point method for it.

The program has a hundred unknowns, thousands of limits and a dense Jacobian. IPOPT and a sequential quadratic program
factor the large system that is eliminated here. On a leg of three joints (`benchmarks/design.py`), mean standard errors
over those of a multisine, and times:

===================================================  ======  =======
this method                                          0.745   1.1 s
IPOPT, exact second derivatives                      0.766   16 s
IPOPT, second derivatives by BFGS                    0.807   60 s, the limit
sequential quadratic programs with DAQP, BFGS        0.751   13 s
===================================================  ======  =======

On an arm of two joints all find the same within 2 %, within a second.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.flight.planning.excitation import FourierSeries, Limited, Observed, grid, motion_of

_FRACTION = 0.99
"""Of the way to a limit that a step may take."""


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
    last = 1e-4  # barrier parameter: the change of the objective per active limit
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
            search.converged = mu <= last
            mu, merit = max(last, 0.3 * mu), np.inf
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
