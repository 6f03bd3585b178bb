"""Symmetric positive definite systems that are block-tridiagonal with a border: windows in a row, parameters shared.

    | D_0  E_0'           B_0 |
    | E_0  D_1  E_1'      B_1 |
    |      E_1  D_2  ...  B_2 |
    | B_0' B_1' B_2' ...   C  |

Each window is coupled to its neighbours and to the parameters only, so that a solution and the required blocks of the
inverse cost O(W).  Blocks are eliminated by cyclic reduction: all odd ones at once, then every other one of what is
left, so that each of the log2(W) levels is a handful of operations on stacks of small matrices.

References
----------
Hockney 1965 and Heller 1976 (cyclic reduction); Takahashi, Fagan, Chen 1973 (selected inverse).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from diransac.arrays import FloatArray

__all__ = ["Arrowhead", "Factored"]

# Below what rounding leaves of a diagonal of one; keeps what no measurement shows (a heading that nothing depends on).
_RIDGE = 1e-13


@dataclass(frozen=True)
class Factored:
    """Solution of an arrowhead system, and blocks of its inverse.

    Parameters
    ----------
    step_z : (W, k) array
        Solution of each window.
    step_p : (m,) array
        Solution of the shared unknowns.
    var_z : (W, k, k) array
        Diagonal blocks of the inverse.
    var_below : (W - 1, k, k) array
        Blocks of the inverse below the diagonal.
    var_p : (m, m) array
        Corner of the inverse.
    gain : (W, k, m) array
        ``A^-1 B``: a shift of p moves z by ``-gain`` times the shift.
    log_det : float
        Logarithm of the determinant of the whole system.
    """

    step_z: FloatArray
    step_p: FloatArray
    var_z: FloatArray
    var_below: FloatArray
    var_p: FloatArray
    gain: FloatArray
    log_det: float


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
        """Solution for one right-hand side.

        Parameters
        ----------
        right_z : (W, k) array
        right_p : (m,) array
        damping : float, optional
            The diagonal is multiplied by ``1 + damping``.

        Returns
        -------
        Factored
        """
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
        """Solutions ``(W, k, c)`` and ``(m, c)`` for as many right-hand sides.

        Unknowns are scaled to a diagonal of one first: metres and radians per second squared differ by decades.
        """
        sz, sp = _scale(np.einsum("wii->wi", self.diagonal)), _scale(np.diag(self.corner))
        k, m = self.border.shape[1:]
        D = self.diagonal * sz[:, :, None] * sz[:, None, :] + (damping + self.ridge) * np.eye(k)
        E = self.below * sz[1:, :, None] * sz[:-1, None, :]
        B = self.border * sz[:, :, None] * sp
        C = self.corner * sp[:, None] * sp + (damping + self.ridge) * np.eye(m)
        solved, var, below, log_det = _reduce(D, E, np.concatenate([B, right_z * sz[:, :, None]], axis=2))
        gain, alone = solved[:, :, :m], solved[:, :, m:]
        left = C - np.einsum("wki,wkj->ij", B, gain)
        var_p = _inverse(left)
        p = var_p @ (right_p * sp[:, None] - np.einsum("wki,wkc->ic", B, alone))
        z = alone - gain @ p
        var = var + gain @ var_p @ gain.swapaxes(1, 2)
        below = below + gain[1:] @ var_p @ gain[:-1].swapaxes(1, 2)
        return Factored(
            z * sz[:, :, None],
            p * sp[:, None],
            var * sz[:, :, None] * sz[:, None, :],
            below * sz[1:, :, None] * sz[:-1, None, :],
            var_p * sp[:, None] * sp,
            gain * sz[:, :, None] / sp,
            float(log_det + _log_det(left) - 2.0 * (np.log(sz).sum() + np.log(sp).sum())),
        )


def _scale(diagonal: FloatArray) -> FloatArray:
    """Scale of unknowns; 1 where an unknown has no effect and the ridge alone determines it."""
    return np.asarray(1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)))


def _inverse(A: FloatArray) -> FloatArray:
    """Inverse of a symmetric matrix; singular directions have a large variance instead of an error."""
    values, vectors = np.linalg.eigh(0.5 * (A + A.T))
    return np.asarray((vectors / np.maximum(values, 1e-15)) @ vectors.T)


def _log_det(A: FloatArray) -> float:
    """Logarithm of the determinants of positive definite matrices, all together."""
    return float(np.linalg.slogdet(A)[1].sum())


def _reduce(D: FloatArray, E: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """``A^-1 R (W, k, c)``; of ``A^-1`` the diagonal blocks (W, k, k) and those below (W-1, k, k); ``log det A``."""
    n, k, c = R.shape
    if n == 1:
        inverse = np.asarray(np.linalg.inv(D))
        return inverse @ R, np.asarray(inverse, np.float64), E, _log_det(D)
    n_odd, n_even = n // 2, n - n // 2
    has_right = n_even > n_odd  # whether the last odd block has a neighbour on its right, too
    left = E[0::2]
    right = np.zeros_like(left)
    right[: len(E[1::2])] = E[1::2].swapaxes(1, 2)
    eye = np.broadcast_to(np.eye(k), (n_odd, k, k))
    solved = np.linalg.solve(D[1::2], np.concatenate([left, right, R[1::2], eye], axis=2))
    Fl, Fr, Ro, Io = np.split(solved, [k, 2 * k, 2 * k + c], axis=2)
    De, Re = D[0::2].copy(), R[0::2].copy()
    lt, rt = left.swapaxes(1, 2), right.swapaxes(1, 2)
    De[:n_odd] -= lt @ Fl
    Re[:n_odd] -= lt @ Ro
    m = n_even - 1
    De[1:] -= (rt @ Fr)[:m]
    Re[1:] -= (rt @ Ro)[:m]
    Xe, Se, Te, log_det = _reduce(De, -(rt @ Fl)[:m], Re)
    if not has_right:  # a neighbour that isn't there: couples to nothing
        Xe_r = np.concatenate([Xe[1:], np.zeros_like(Xe[:1])])
        Se_r = np.concatenate([Se[1:], np.zeros_like(Se[:1])])
        T = np.concatenate([Te, np.zeros_like(Se[:1])])
    else:
        Xe_r, Se_r, T = Xe[1:], Se[1:], Te
    Xl, Sl = Xe[:n_odd], Se[:n_odd]
    X, S, off = np.empty_like(R), np.empty_like(D), np.empty_like(E)
    to_left = -(Fl @ Sl + Fr @ T)
    to_right = -(Fl @ T.swapaxes(1, 2) + Fr @ Se_r)
    X[0::2], S[0::2] = Xe, Se
    X[1::2] = Ro - Fl @ Xl - Fr @ Xe_r
    S[1::2] = Io - to_left @ Fl.swapaxes(1, 2) - to_right @ Fr.swapaxes(1, 2)
    off[0::2] = to_left
    off[1::2] = to_right.swapaxes(1, 2)[: len(off[1::2])]
    return X, S, off, log_det + _log_det(D[1::2])
