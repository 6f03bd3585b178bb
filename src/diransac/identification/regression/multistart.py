"""Least squares from many starts, which are lanes of one batch (Levenberg and Marquardt).

References
----------
Levenberg 1944; Marquardt 1963; Boender, Rinnooy Kan 1987 (random starts).
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from diransac.arrays import FloatArray
from diransac.time_limit import check_time

__all__ = ["LeastSquaresProblem", "least_squares"]


class LeastSquaresProblem(Protocol):
    """Sums of squares of many lanes."""

    def moved(self, now: FloatArray, step: FloatArray) -> FloatArray:
        """Unknowns (n_lanes, n) after a step, within their bounds."""

    def linearized(self, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Cost (n_lanes,), infinite after a divergence, its gradient / 2 (n_lanes, n), and the normal matrix."""


def least_squares(problem: LeastSquaresProblem, z: FloatArray, n_steps: int) -> tuple[FloatArray, FloatArray]:
    """Unknowns and their costs after steps of Levenberg and Marquardt from every start.

    Parameters
    ----------
    problem : LeastSquaresProblem
    z : (n_starts, n) array
        Unknowns to start from.
    n_steps : int
        Largest number of steps.

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
    (cost, gradient, matrix), damping = problem.linearized(z), np.full(len(z), 1e-2)
    for _ in range(n_steps):
        check_time()
        scale = np.sqrt(np.einsum("kii->ki", matrix)) + 1e-300
        scaled = matrix / scale[:, :, None] / scale[:, None, :] + damping[:, None, None] * np.eye(z.shape[1])
        step = -np.linalg.solve(scaled, (gradient / scale)[:, :, None])[:, :, 0] / scale
        trial = problem.moved(z, step)
        then = problem.linearized(trial)
        better = then[0] < cost
        settled = better & (then[0] > (1.0 - 1e-9) * cost) | (damping >= 1e9)
        z = np.where(better[:, None], trial, z)
        cost, gradient, matrix = (
            np.where(better.reshape(-1, *(1,) * (x.ndim - 1)), y, x)
            for x, y in zip((cost, gradient, matrix), then, strict=True)
        )
        damping = np.clip(np.where(better, 0.2, 6.0) * damping, 1e-9, 1e9)
        if settled.all():
            break
    return z, cost
