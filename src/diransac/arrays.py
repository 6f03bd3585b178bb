"""The array types of every signature, whose shapes are in the docstrings; robust scales, sizes, and runs in masks."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

MAD_TO_STD = 1.4826
"""Standard deviation of a normal variable over its median absolute deviation."""

_ROWS_AT_A_TIME = 65_536


def row_blocks(n_rows: int, at_a_time: int = _ROWS_AT_A_TIME) -> Iterator[slice]:
    """Blocks of rows in which long arrays are visited, in order, so that intermediate results take little memory."""
    return (slice(k, k + at_a_time) for k in range(0, max(n_rows, 1), at_a_time))


def robust_std(deviations: FloatArray, axis: int | None = None) -> FloatArray:
    """Standard deviation of normal deviations from zero, by the median of their sizes: up to half may be outliers."""
    return np.asarray(MAD_TO_STD * np.median(np.abs(deviations), axis=axis))


def bulk_range(values: FloatArray) -> tuple[float, float]:
    """Range of the values no further from the central 80 % than its width; (0, 0) without finite values."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, 0.0
    low, high = np.quantile(finite, [0.1, 0.9])
    width = high - low
    kept = finite[(finite >= low - width) & (finite <= high + width)]
    return float(kept.min()), float(kept.max())


def size_or_one(sizes: FloatArray) -> FloatArray:
    """Sizes by which arrays are divided: 1 in place of those that are not positive."""
    return np.where(sizes > 0.0, sizes, 1.0)


def interpolated(columns: FloatArray) -> FloatArray:
    """Columns ``(N, n)`` with missing samples interpolated, and held at both ends; 0 without any sample."""
    filled, rows = columns.copy(), np.arange(len(columns))
    for column in filled.T:
        known = np.isfinite(column)
        if not known.all():
            column[:] = np.interp(rows, rows[known], column[known]) if known.any() else 0.0
    return filled


def runs(mask: BoolArray) -> list[slice]:
    """Runs of the elements of a mask ``(N,)`` that are True.

    Parameters
    ----------
    mask : (N,) bool array

    Returns
    -------
    list of slice
    """
    edges = np.flatnonzero(np.diff(np.r_[False, mask, False]))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def long_runs(mask: BoolArray, least: int) -> BoolArray:
    """Elements of a mask ``(N,)`` in runs of ``least`` or more.

    Parameters
    ----------
    mask : (N,) bool array
    least : int

    Returns
    -------
    (N,) bool array
    """
    kept = np.zeros(len(mask), bool)
    for rows in runs(mask):
        kept[rows] = rows.stop - rows.start >= least
    return kept
