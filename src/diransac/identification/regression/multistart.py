"""Least squares from many starts, which are lanes of one batch (Levenberg and Marquardt).

References
----------
Levenberg 1944; Marquardt 1963; Transtrum and Sethna 2012 (damping); Boender, Rinnooy Kan 1987 (random starts).
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.identification.regression.estimators import solve_definite
from diransac.time_limit import check_time

LARGEST_DAMPING = 1e9
"""Marquardt's damping, over the scaled normal matrix, with which a step moves nothing; the least is its inverse."""


class LeastSquaresProblem(Protocol):
    """Sums of squares of many lanes."""

    def moved(self, now: FloatArray, step: FloatArray) -> FloatArray:
        """Unknowns (n_lanes, n) after a step, within their bounds."""

    def linearized(self, z: FloatArray, lanes: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Cost (k,) of some lanes, infinite after a divergence, its gradient / 2 (k, n), and the normal matrix."""


def least_squares(
    problem: LeastSquaresProblem, z: FloatArray, n_steps: int, tolerance: float = 1e-9
) -> tuple[FloatArray, FloatArray]:
    """Unknowns and their costs after steps of Levenberg and Marquardt from every start.

    Parameters
    ----------
    problem : LeastSquaresProblem
    z : (n_starts, n) array
        Unknowns to start from.
    n_steps : int
        Largest number of steps.
    tolerance : float, optional
        Relative decrease of its cost, or promise of one, at which a lane has converged.

    Returns
    -------
    z : (n_starts, n) array
    cost : (n_starts,) array
        Infinite where every simulation diverges.

    Raises
    ------
    TimeLimitError
        The time limit was reached.
    """
    z, damping = z.copy(), np.full(len(z), 1e-2)
    cost, gradient, matrix = problem.linearized(z, np.arange(len(z)))
    active = np.flatnonzero(np.isfinite(cost))
    for _ in range(n_steps):
        check_time()
        H, g = matrix[active], gradient[active]
        scale = np.sqrt(np.einsum("kii->ki", H)) + 1e-300
        scaled = H / scale[:, :, None] / scale[:, None, :] + damping[active, None, None] * np.eye(z.shape[1])
        back = solve_definite(scaled, g / scale) / scale
        # At a minimum, rounding decides whether a cost falls.  A damped step promises less.
        promises = (1.0 + damping[active]) * (g * back).sum(axis=1)
        promising = ~(2.0 * promises <= tolerance * cost[active])
        active = active[promising]
        if not len(active):
            break
        trial = problem.moved(z[active], -np.nan_to_num(back[promising]))
        then = problem.linearized(trial, active)
        better = then[0] < cost[active]
        settled = better & (then[0] > (1.0 - tolerance) * cost[active]) | (damping[active] >= LARGEST_DAMPING)
        to = active[better]
        z[to], cost[to], gradient[to], matrix[to] = (x[better] for x in (trial, *then))
        damping[active] = np.clip(np.where(better, 0.2, 6.0) * damping[active], 1.0 / LARGEST_DAMPING, LARGEST_DAMPING)
        active = active[~settled]
    return z, cost
