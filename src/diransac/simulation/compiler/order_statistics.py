"""Order statistics of rows of numbers that are not negative."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.simulation.compiler.machine_code import LANES, MachineCode, compile_function, signature

if TYPE_CHECKING:
    from diransac.simulation.compiler.vectors import Value


def padded_rows(shape: tuple[int, ...]) -> FloatArray:
    """New array whose last axis holds whole vectors: that of the shape, not set, and infinity behind it.

    Parameters
    ----------
    shape : (..., n)

    Returns
    -------
    (..., n or a few more)
    """
    n = shape[-1]
    found = np.empty((*shape[:-1], -(-n // LANES) * LANES))
    found[..., n:] = np.inf
    return found


def order_statistics(values: FloatArray, places: IntArray) -> FloatArray:
    """The number that has a place when a row is sorted, of every row.

    Parameters
    ----------
    values : (..., n) from `padded_rows`, not negative; NaN is larger than infinity
    places : (...,), from 0

    Returns
    -------
    (...,)
    """
    shape, width = values.shape[:-1], values.shape[-1]
    wanted, found = np.ascontiguousarray(np.broadcast_to(places, shape), np.int64), np.empty(shape)
    _code().call(values.ctypes.data, wanted.ctypes.data, found.ctypes.data, found.size, width)
    return found


@cache
def _code() -> MachineCode:
    """Machine code for rows of any length."""

    def emit() -> Value:
        from diransac.simulation.compiler.bisection import emit_bisection

        return emit_bisection()

    return compile_function(emit, (), "order_statistics", signature(3, 2))
