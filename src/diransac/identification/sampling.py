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

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from diransac.arrays import IntArray

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["sample_rows"]

_Words = npt.NDArray[np.uint64]

# Six rounds pass a chi-square test of pairs of positions from 30 rows on; fewer rows need twelve.
_ROUNDS, _ROUNDS_OF_FEW, _FEW_BITS = 6, 12, 3
_GOLDEN = 0x9E3779B97F4A7C15


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
    k = np.atleast_1d(np.asarray(iterations, dtype=np.uint64))
    half = np.uint64(max(1, -(-(n_rows - 1).bit_length() // 2)))
    n_rounds = _ROUNDS_OF_FEW if half <= _FEW_BITS else _ROUNDS
    key = _mix(_mix(np.array([int(seed) % 2**64], dtype=np.uint64)) + k)
    round_keys = [_mix(key + np.uint64(r * _GOLDEN % 2**64))[:, None] for r in range(1, n_rounds + 1)]
    values = np.broadcast_to(np.arange(start, stop, dtype=np.uint64), (len(k), stop - start))
    permuted = _feistel(values, round_keys, half)
    outside = np.nonzero(permuted >= n_rows)
    while len(outside[0]):
        walked = _feistel(permuted[outside], [x[outside[0], 0] for x in round_keys], half)
        permuted[outside] = walked
        outside = tuple(index[walked >= n_rows] for index in outside)
    return permuted.astype(np.int64)


def _feistel(values: _Words, round_keys: Sequence[_Words], half: np.uint64) -> _Words:
    """A keyed permutation of ``range(2^(2 half))``, element by element."""
    low = np.uint64((1 << int(half)) - 1)
    left, right = values >> half, values & low
    for key in round_keys:
        mixed = _mix(right + key)
        mixed &= low
        left ^= mixed
        left, right = right, left
    left <<= half
    left |= right
    return left


def _mix(x: _Words) -> _Words:
    """SplitMix64's finalizer, a bijection of 64-bit words, in place of its argument: copies take half the time."""
    shifted = np.empty_like(x)
    for places, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        x ^= np.right_shift(x, np.uint64(places), out=shifted)
        x *= np.uint64(factor)
    x ^= np.right_shift(x, np.uint64(31), out=shifted)
    return x
