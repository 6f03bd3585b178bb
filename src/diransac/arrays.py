"""The array types of every signature, whose shapes are in the docstrings, and the robust scale of arrays."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

MAD_TO_STD = 1.4826
"""Standard deviation of a normal variable over its median absolute deviation."""


def robust_std(deviations: FloatArray, axis: int | None = None) -> FloatArray:
    """Standard deviation of normal deviations from zero, by the median of their sizes: up to half may be outliers."""
    return np.asarray(MAD_TO_STD * np.median(np.abs(deviations), axis=axis))
