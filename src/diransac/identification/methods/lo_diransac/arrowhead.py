"""Symmetric positive definite systems that are block-tridiagonal with a border: windows in a row, parameters shared.

    | D_0  E_0'           B_0 |
    | E_0  D_1  E_1'      B_1 |
    |      E_1  D_2  ...  B_2 |
    | B_0' B_1' B_2' ...   C  |

Each window is coupled to its neighbours and to the parameters only, so that a solution and the required blocks of the
inverse cost O(W).  Windows are eliminated by compiled code, for the border as further right-hand sides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from diransac.arrays import FloatArray
from diransac.simulation.compiler import solve_blocks

# Below what rounding leaves of a diagonal of one; keeps what no measurement shows (a heading that nothing depends on).
_RIDGE = 1e-13


@dataclass(frozen=True)
class Factored:
    """Solution of an arrowhead system, and blocks of its inverse.

    Parameters
    ----------
    step_z : (W, k) or (W, k, c) array
        Solution of each window.
    step_p : (m,) or (m, c) array
        Solution of the shared unknowns.
    alone : (W, k, k) array
        Diagonal blocks of ``A^-1``, the inverse without the shared unknowns: covariances where these are given.
    alone_below : (W - 1, k, k) array
        Blocks of ``A^-1`` below the diagonal.
    var_p : (m, m) array
        Corner of the inverse.
    gain : (W, k, m) array
        ``A^-1 B``: a shift of p moves z by ``-gain`` times the shift.
    log_det : float
        Logarithm of the determinant of the whole system.
    """

    step_z: FloatArray
    step_p: FloatArray
    alone: FloatArray
    alone_below: FloatArray
    var_p: FloatArray
    gain: FloatArray
    log_det: float

    @cached_property
    def var_z(self) -> FloatArray:
        """Diagonal ``(W, k)`` of the inverse: variances."""
        return np.asarray(np.einsum("wii->wi", self.alone) + np.einsum("wim,wim->wi", self._moved, self.gain))

    @cached_property
    def var_below(self) -> FloatArray:
        """Diagonals ``(W - 1, k)`` of the inverse's blocks below the diagonal: covariances with the window before."""
        own = np.einsum("wii->wi", self.alone_below)
        return np.asarray(own + np.einsum("wim,wim->wi", self._moved[1:], self.gain[:-1]))

    @cached_property
    def _moved(self) -> FloatArray:
        """Covariances ``(W, k, m)`` with the shared unknowns, but for their sign."""
        W, k, m = self.gain.shape
        return (self.gain.reshape(W * k, m) @ self.var_p).reshape(W, k, m)


@dataclass(frozen=True)
class Arrowhead:
    """Blocks of a symmetric positive definite system.

    Parameters
    ----------
    diagonal : (W, k, k) array
        D.
    below : (W - 1, k, k) array
        E, below the diagonal.
    border : (W, k, m) array
        B.
    corner : (m, m) array
        C.
    ridge : float, optional
        Addition to a diagonal of one.
    """

    diagonal: FloatArray
    below: FloatArray
    border: FloatArray
    corner: FloatArray
    ridge: float = _RIDGE

    def solve(self, right_z: FloatArray, right_p: FloatArray, damping: float = 0.0) -> Factored:
        """Solution for one right-hand side, or for c.

        Parameters
        ----------
        right_z : (W, k) or (W, k, c) array
        right_p : (m,) or (m, c) array
        damping : float, optional
            The diagonal is multiplied by ``1 + damping``.

        Returns
        -------
        Factored
        """
        if right_z.ndim > 2:
            return self._solved(right_z, right_p, damping)
        found = self._solved(right_z[:, :, None], right_p[:, None], damping)
        return replace(found, step_z=found.step_z[:, :, 0], step_p=found.step_p[:, 0])

    def functional(self, of_z: FloatArray, of_p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Inverse times columns: the gradient of c linear functionals of the solution.

        Parameters
        ----------
        of_z : (W, k, c) array
        of_p : (m, c) array

        Returns
        -------
        (W, k, c) array, (m, c) array
        """
        found = self._solved(of_z, of_p, 0.0)
        return found.step_z, found.step_p

    def _solved(self, right_z: FloatArray, right_p: FloatArray, damping: float) -> Factored:
        """Solutions ``(W, k, c)`` and ``(m, c)`` for as many right-hand sides."""
        W, k, m = self.border.shape
        more = damping + self.ridge
        border, own = np.ascontiguousarray(self.border), np.diag(self.corner)
        shift = more * _size(np.einsum("wii->wi", self.diagonal))
        solved, inverse, below, log_det = solve_blocks(self.diagonal, self.below, (border, right_z), shift)
        flat = solved.reshape(W * k, -1)
        common = border.reshape(W * k, m).T @ flat
        # Metres and radians per second squared differ by decades: shared unknowns are scaled to a diagonal of one.
        scale = 1.0 / np.sqrt(_size(own))
        scales = np.outer(scale, scale)
        left = (self.corner - common[:, :m]) * scales + more * np.eye(m)
        var_p = _inverse(left) * scales
        p = var_p @ (right_p - common[:, m:])
        z = solved[:, :, m:] - (flat[:, :m] @ p).reshape(W, k, -1)
        log_det += float(np.linalg.slogdet(left)[1] - 2.0 * np.log(scale).sum())
        return Factored(z, p, inverse, below, var_p, solved[:, :, :m], log_det)


def _size(diagonal: FloatArray) -> FloatArray:
    """The diagonal; 1 where an unknown has no effect and the ridge alone determines it."""
    return np.where(diagonal > 0.0, diagonal, 1.0)


def _inverse(A: FloatArray) -> FloatArray:
    """Inverse of a symmetric matrix; singular directions have a large variance instead of an error.

    Raises LinAlgError: a number overflowed, which LAPACK would report on the terminal.
    """
    if not np.isfinite(A).all():
        raise np.linalg.LinAlgError("a number overflows")
    values, vectors = np.linalg.eigh(0.5 * (A + A.T))
    return np.asarray((vectors / np.maximum(values, 1e-15)) @ vectors.T)
