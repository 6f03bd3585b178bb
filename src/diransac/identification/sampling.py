"""Samples without replacement, in which sample ``k`` depends on ``(seed, k)`` alone.

Sample ``k`` is the beginning of a pseudo-random permutation of the rows whose key is ``(seed, k)``.  No state is
carried from one sample to the next, a sample is extended by reading on, and all arithmetic is integer, so that samples
are the same on every machine.

References
----------
Luby and Rackoff 1988 (a Feistel network of random round functions is a random permutation); Black and Rogaway 2002
(cycle walking to a domain of any size); Steele, Lea, Flood 2014 (the SplitMix64 mixer); Salmon et al. 2011 (counter-
based random numbers).
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from diransac.arrays import IntArray
from diransac.simulation.compiler.machine_code import LANES, MachineCode, compile_function

if TYPE_CHECKING:
    from diransac.simulation.compiler.vectors import Value

__all__ = ["sample_rows"]

# Six rounds pass a chi-square test of pairs of positions from 30 rows on; fewer rows need twelve.
_ROUNDS, _ROUNDS_OF_FEW, _FEW_BITS = 6, 12, 3
# Positions that are permuted at a time: the instructions of two vectors overlap.
_AT_A_TIME = 2 * LANES
_SIGNATURE = {
    **dict.fromkeys(("iterations", "found"), "pointer"),
    **dict.fromkeys(("seed", "n", "n_rows", "start", "stop", "width", "half", "n_rounds"), "integer"),
}


def sample_rows(seed: int, iterations: npt.ArrayLike, n_rows: int, start: int, stop: int) -> IntArray:
    """Positions ``start`` to ``stop`` of the keyed permutations of ``range(n_rows)``.

    Parameters
    ----------
    seed : int
        Any integer.
    iterations : (n,) array_like
        Index k of each sample.
    n_rows : int
        Length of the permutation.
    start, stop : int
        Positions that are read, ``0 <= start <= stop <= n_rows``.

    Returns
    -------
    (n, stop - start) int array
        Distinct rows of the log for each sample; other positions of the same permutation do not repeat them.
    """
    k = np.ascontiguousarray(iterations, dtype=np.uint64)
    half = max(1, -(-(n_rows - 1).bit_length() // 2))
    n_rounds = _ROUNDS_OF_FEW if half <= _FEW_BITS else _ROUNDS
    found = np.empty((len(k), -(-(stop - start) // _AT_A_TIME) * _AT_A_TIME), np.int64)
    sizes = (len(k), n_rows, start, stop, found.shape[1], half, n_rounds)
    _code().call(k.ctypes.data, found.ctypes.data, int(seed) % 2**64, *sizes)
    return found[:, : stop - start]


@cache
def _code() -> MachineCode:
    """Machine code for samples of any size."""

    def emit() -> Value:
        from diransac.simulation.compiler.feistel import emit_permutations

        return emit_permutations("permutations", _ROUNDS_OF_FEW, _AT_A_TIME)

    return compile_function(emit, (repr((_ROUNDS_OF_FEW, _AT_A_TIME)),), "permutations", _SIGNATURE.values())
