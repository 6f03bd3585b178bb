"""Symmetric positive definite block-tridiagonal systems: solutions, and the inverse where the system is not zero.

| D_0  E_0'          |
| E_0  D_1  E_1'     |
|      E_1  D_2  ... |
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from diransac.arrays import FloatArray
from diransac.simulation.compiler.machine_code import LANES, MachineCode, compile_function, signature

if TYPE_CHECKING:
    from collections.abc import Sequence

    from diransac.simulation.compiler.vectors import Value


class BlockSolution(NamedTuple):
    """Solution of a block-tridiagonal system ``A``.

    Attributes
    ----------
    solved : (n, k, c) ``A^-1 R``
    inverse : (n, k, k) diagonal blocks of ``A^-1``
    inverse_below : (n - 1, k, k) blocks of ``A^-1`` below the diagonal
    log_det : logarithm of the determinant of ``A``
    """

    solved: FloatArray
    inverse: FloatArray
    inverse_below: FloatArray
    log_det: float


def solve_blocks(
    diagonal: FloatArray, below: FloatArray, right: Sequence[FloatArray], shift: FloatArray
) -> BlockSolution:
    """Solution of a positive definite system, whatever the scales of its unknowns.

    Parameters
    ----------
    diagonal : (n, k, k) symmetric blocks
    below : (n - 1, k, k) blocks below the diagonal
    right : (n, k, c_i) arrays of right-hand sides, c columns in all
    shift : (n, k), addition to the diagonal
    """
    n, k = shift.shape
    padded_k, padded_c = (-(-size // LANES) * LANES for size in (k, sum(x.shape[2] for x in right)))
    blocks, c = np.zeros((n, k, 2 * padded_k + padded_c)), 2 * padded_k
    blocks[:, :, :k] = diagonal
    own = np.einsum("wii->wi", blocks[:, :, :k])
    own += shift
    blocks[:-1, :, padded_k : padded_k + k] = below.swapaxes(1, 2)
    for columns in right:
        blocks[:, :, c : c + columns.shape[2]] = columns
        c += columns.shape[2]
    # Part of its diagonal that a pivot is at least: what rounding leaves where a system is singular.
    coupling, pivots = np.ascontiguousarray(below, np.float64), 1e-16 * own
    inverse_below = np.zeros((n - 1, padded_k, padded_k))
    addresses = [array.ctypes.data for array in (blocks, coupling, inverse_below, pivots)]
    _code().call(*addresses, n, k, padded_k, padded_c)
    inverse_below = inverse_below[:, :k, :k].copy()
    solved, inverse = blocks[:, :, 2 * padded_k : c].copy(), blocks[:, :, :k].copy()
    return BlockSolution(solved, inverse, inverse_below, float(np.log(pivots).sum()))


@cache
def _code() -> MachineCode:
    """Machine code for systems of any size."""

    def emit() -> Value:
        from diransac.simulation.compiler.block_elimination import emit_block_elimination

        return emit_block_elimination()

    return compile_function(emit, (), "solve_blocks", signature(4, 4))
