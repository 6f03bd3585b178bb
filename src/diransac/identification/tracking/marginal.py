"""Marginalisation of the first intervals of a window: what remains of them is a `BoundaryPrior` of the rest."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.methods.lo_diransac.boundary import BoundaryPrior
from diransac.identification.methods.lo_diransac.normal_equations import innovation_std, innovations

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.normal_equations import Fit, NormalEquations
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals

__all__ = ["marginal"]

# Addition to a diagonal of one that keeps an unknown which nothing determines.
_RIDGE = 1e-13


def marginal(at: NormalEquations, intervals: ShootingIntervals, fit: Fit, n: int) -> BoundaryPrior:
    """Information of the first intervals of a fit, and its boundary, on the unknowns at the start of the next one.

    Parameters
    ----------
    at : NormalEquations
    intervals : ShootingIntervals
        All with the same parameters.
    fit : Fit
        Of these equations.
    n : int
        Number of intervals that are marginalised, fewer than there are.

    Returns
    -------
    BoundaryPrior
        At the start of interval ``n``, linearised at the fit.
    """
    own = 1.0 / innovation_std(intervals, fit)
    pull = -own * innovations(intervals, fit)
    information, right = _beforehand(fit, own[0], pull[0])
    k, n_x = at.right_z.shape[1], fit.x.shape[1]
    known, known_right = information, right  # of interval w in its block of the equations
    for w in range(n):
        P, F = at.precision[w], at.slopes[w]
        H, g = np.zeros((2 * k + len(right) - k,) * 2), np.zeros(2 * k + len(right) - k)
        z, then, s = slice(0, k), slice(k, 2 * k), slice(2 * k, None)
        H[z, z] = at.system.diagonal[w] + information[:k, :k] - known[:k, :k]
        H[z, s] = at.system.border[w] + information[:k, k:] - known[:k, k:]
        H[s, s] = at.corners[w] + information[k:, k:]
        H[then, z] = at.system.below[w]
        g[z], g[s] = at.right_z[w] + right[:k] - known_right[:k], at.rights[w] + right[k:]
        known, known_right = np.zeros_like(information), np.zeros_like(right)
        known[:n_x, :n_x], known[n_x:k, n_x:k] = np.diag(P), np.diag(np.square(own[w + 1]))
        known[:n_x, k:] = -P[:, None] * F[:, k:]
        known_right[:k] = np.concatenate([-P * at.jumps[w], pull[w + 1]])
        H[then, then], H[then, s], g[then] = known[:k, :k], known[:k, k:], known_right[:k]
        information, right = _eliminated(H, g, k)
    point = np.concatenate([fit.x[n], fit.d[n], fit.shared])
    return BoundaryPrior.of_information(point, information, right)


def _beforehand(fit: Fit, own: FloatArray, pull: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Information and right-hand side of the first interval's unknowns before its measurements."""
    if fit.boundary is not None:
        return fit.boundary.information, fit.boundary.right(fit)
    n_x = fit.x.shape[1]
    k = n_x + len(own)
    information, right = np.zeros((k + len(fit.shared),) * 2), np.zeros(k + len(fit.shared))
    information[n_x:k, n_x:k], right[n_x:k] = np.diag(np.square(own)), pull
    return information, right


def _eliminated(H: FloatArray, g: FloatArray, k: int) -> tuple[FloatArray, FloatArray]:
    """Schur complement of the first k unknowns, and its right side.

    Couplings of these to the next k are below the diagonal, all others above.
    """
    n = len(g) - k
    coupling = np.concatenate([H[k : 2 * k, :k], H[:k, 2 * k :].T])
    rest = np.triu(H[k:, k:]) + np.triu(H[k:, k:], 1).T
    own = np.diag(H)[:k]
    scale = 1.0 / np.sqrt(np.where(own > 0.0, own, 1.0))
    scaled = H[:k, :k] * np.outer(scale, scale) + _RIDGE * np.eye(k)
    solved = np.linalg.solve(scaled, scale[:, None] * np.column_stack([coupling.T, g[:k]]))
    taken = (coupling * scale) @ solved
    return rest - taken[:, :n], g[k:] - taken[:, n]
