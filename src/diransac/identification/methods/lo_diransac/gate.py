"""What is not to be used at all: sensors that stand still, and inputs that leap for a moment."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from diransac.arrays import BoolArray, FloatArray

__all__ = ["mended_inputs", "stuck_rows"]


_REACH, _FAR = 15, 8.0


def stuck_rows(measured: FloatArray) -> BoolArray:
    """Rows ``(N,)`` that repeat the row before exactly, in every signal: nothing new was measured."""
    stuck = np.zeros(len(measured), bool)
    stuck[1:] = np.all(measured[1:] == measured[:-1], axis=1)
    return stuck


def mended_inputs(inputs: FloatArray) -> tuple[FloatArray, int]:
    """Inputs whose momentary leaps are replaced by the running median, and how many there were (Hampel's filter).

    A simulation goes on from a wrong input with a wrong state, so inputs cannot be left to the noise model.
    """
    N = len(inputs)
    if N < _REACH or not inputs.shape[1]:
        return inputs, 0
    median = median_filter(inputs, size=(_REACH, 1), mode="mirror")
    distance = np.abs(inputs - median)
    scale = 1.4826 * median_filter(distance, size=(_REACH, 1), mode="mirror")
    typical = 1.4826 * np.median(np.abs(inputs - np.median(inputs, axis=0)), axis=0)
    leaps = distance > _FAR * np.maximum(scale, typical)
    return np.where(leaps, median, inputs), int(leaps.any(axis=1).sum())
