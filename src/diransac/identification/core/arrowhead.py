"""Symmetric positive definite systems that are block-tridiagonal with a border: windows in a row, parameters shared.

    | D_0  E_0'           B_0 |
    | E_0  D_1  E_1'      B_1 |
    |      E_1  D_2  ...  B_2 |
    | B_0' B_1' B_2' ...   C  |

Each window is coupled to its neighbours and to the parameters only, so that a solution and the required blocks of the
inverse cost O(W).  Windows are eliminated by compiled code, for the border as further right-hand sides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.simulation.compiler import solve_blocks

if TYPE_CHECKING:
    from diransac.simulation.compiler import BlockSolution

# Below what rounding leaves of a diagonal of one; keeps what no measurement shows (a heading that nothing depends on).
_RIDGE = 1e-13


@dataclass(frozen=True, eq=False, repr=False)
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


@dataclass(frozen=True, eq=False, repr=False)
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

    @property
    def ridged(self) -> FloatArray:
        """D ``(W, k, k)`` with the ridge."""
        own = np.einsum("wii->wi", self.diagonal)
        return self.diagonal + (self.ridge * _size(own))[:, :, None] * np.eye(own.shape[1])

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

    def functional_in_sections(
        self, of_z: Callable[[slice], FloatArray], of_p: FloatArray, sections: Sequence[slice]
    ) -> tuple[Iterator[FloatArray], FloatArray]:
        """Inverse times columns, as `functional`, of which no more than a section's are held at a time.

        A section is solved with what the windows before it leave of its first one when they are eliminated, and with
        the solution of the window after it: once for the shared unknowns, and again when its own are asked for.

        Parameters
        ----------
        of_z : callable
            ``(n, k, c)`` columns of consecutive windows.
        of_p : (m, c) array
        sections : sequence of slice
            In their order, all windows together.

        Returns
        -------
        iterator of (n, k, c) array
            Of each section, in their order.
        (m, c) array
        """
        m, shift = len(self.corner), self.ridge * _size(np.einsum("wii->wi", self.diagonal))

        def solved(part: slice, before: Sequence[FloatArray] = (), after: FloatArray | None = None) -> BlockSolution:
            diagonal, columns = self.diagonal[part], np.concatenate([self.border[part], of_z(part)], axis=2)
            if before:
                diagonal = np.concatenate([[diagonal[0] - before[0]], diagonal[1:]])
                columns[0] -= before[1]
            if after is not None:
                columns[-1] -= self.below[part.stop - 1].T @ after
            return solve_blocks(diagonal, self.below[part.start : part.stop - 1], (columns,), shift[part])

        left: list[Sequence[FloatArray]] = [()]
        for part in sections[:-1]:
            found, link = solved(part, left[-1]), self.below[part.stop - 1]
            left.append((link @ found.inverse[-1] @ link.T, link @ found.solved[-1]))
            del found
        common, ends, after = np.zeros((m, m + of_p.shape[1])), list[FloatArray | None](), None
        for part, before in zip(reversed(sections), reversed(left), strict=True):
            ends.append(after)
            last = solved(part, before, after).solved
            common += self.border[part].reshape(-1, m).T @ last.reshape(-1, last.shape[2])
            after = last[0].copy()
        p, _, _ = _solve_shared(self.corner, common, of_p, self.ridge)

        def own(x: FloatArray) -> FloatArray:
            return x[:, :, m:] - (x[:, :, :m].reshape(-1, m) @ p).reshape(*x.shape[:2], -1)

        again = (solved(*x).solved for x in zip(sections, left, reversed(ends), strict=True))
        return map(own, again if len(sections) > 1 else [last]), p

    def eliminated(self, right_z: FloatArray, right_p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Information and right-hand side of the last window and the shared unknowns, without the windows before it.

        Parameters
        ----------
        right_z : (W, k) array
        right_p : (m,) array

        Returns
        -------
        (k + m, k + m) array, (k + m,) array
        """
        _, k, m = self.border.shape
        columns = np.concatenate([np.zeros((len(self.border) - 1, k, k)), self.border[:-1], right_z[:-1, :, None]], 2)
        columns[-1, :, :k] = self.below[-1].T
        shift = self.ridge * _size(np.einsum("wii->wi", self.diagonal[:-1]))
        solved = solve_blocks(self.diagonal[:-1], self.below[:-1], (columns,), shift).solved
        taken = columns[:, :, :-1].reshape(-1, k + m).T @ solved.reshape(-1, k + m + 1)
        own = np.block([[self.diagonal[-1], self.border[-1]], [self.border[-1].T, self.corner]])
        return own - taken[:, :-1], np.concatenate([right_z[-1], right_p]) - taken[:, -1]

    def _solved(self, right_z: FloatArray, right_p: FloatArray, damping: float) -> Factored:
        """Solutions ``(W, k, c)`` and ``(m, c)`` for as many right-hand sides."""
        W, k, m = self.border.shape
        more = damping + self.ridge
        shift = more * _size(np.einsum("wii->wi", self.diagonal))
        solved, inverse, below, log_det = solve_blocks(self.diagonal, self.below, (self.border, right_z), shift)
        flat = solved.reshape(W * k, -1)
        p, var_p, of_shared = _solve_shared(self.corner, self.border.reshape(W * k, m).T @ flat, right_p, more)
        z = solved[:, :, m:] - (flat[:, :m] @ p).reshape(W, k, -1)
        return Factored(z, p, inverse, below, var_p, solved[:, :, :m], log_det + of_shared)


def _solve_shared(
    corner: FloatArray, common: FloatArray, right_p: FloatArray, ridge: float
) -> tuple[FloatArray, FloatArray, float]:
    """Solution (m, c) of the shared unknowns, their inverse (m, m), and the logarithm of its inverse's determinant.

    ``common (m, m + c)`` is what the eliminated windows take from the corner and its right-hand sides.
    """
    m = len(corner)
    # Metres and radians per second squared differ by decades: shared unknowns are scaled to a diagonal of one.
    scale = 1.0 / np.sqrt(_size(np.diag(corner)))
    scales = np.outer(scale, scale)
    left = (corner - common[:, :m]) * scales + ridge * np.eye(m)
    var_p = _inverse(left) * scales
    log_det = float(np.linalg.slogdet(left)[1] - 2.0 * np.log(scale).sum())
    return var_p @ (right_p - common[:, m:]), var_p, log_det


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
