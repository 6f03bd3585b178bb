"""Zero-phase low-pass filters of finite length, and the derivatives of what they let through.

The filter is a windowed sinc, ``h(t) = 2 B sinc(2 B t) w(t)`` with Kaiser's window ``w`` over ``|t| <= 2.5 / B``.  It
passes half at the bandwidth B, all but 1e-4 below B / 2, and 1e-4 above 3 B / 2.  As it is symmetric, it shifts no
phase; as it is finite, a filtered sample depends on what lies within 2.5 / B of it and on nothing else.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["REACH", "convolve", "half_length", "kernels"]

FloatArray = npt.NDArray[np.float64]

REACH = 2.5
_KAISER_BETA = 7.857


def half_length(bandwidth: float, dt: float) -> int:
    """Samples that the filter looks at to either side."""
    return max(1, int(np.ceil(REACH / (bandwidth * dt))))


def kernels(bandwidth: float, dt: float) -> FloatArray:
    """Impulse responses (3, 2 L + 1) of the filter and of its first and second derivatives, in 1, 1/s and 1/s^2.

    They are exact for a constant, a ramp and a parabola.
    """
    L = half_length(bandwidth, dt)
    t = np.arange(-L, L + 1) * dt
    smooth = np.sinc(2.0 * bandwidth * t) * np.kaiser(2 * L + 1, _KAISER_BETA)
    smooth /= smooth.sum()
    f = np.fft.rfftfreq(8 * L, dt)
    H = np.fft.rfft(np.roll(np.pad(smooth, (0, 8 * L - len(smooth))), -L))
    w = 2.0 * np.pi * f
    first = np.roll(np.fft.irfft(1j * w * H, 8 * L), L)[: 2 * L + 1]
    second = np.roll(np.fft.irfft(-(w**2) * H, 8 * L), L)[: 2 * L + 1]
    first = 0.5 * (first - first[::-1])
    first /= -(t * first).sum()
    second = 0.5 * (second + second[::-1])
    second -= smooth * second.sum()
    second /= 0.5 * (t**2 * second).sum() - 0.0
    return np.stack([smooth, first, second])


def convolve(values: FloatArray, kernel: FloatArray) -> FloatArray:
    """``values (N, ...)`` filtered along the first axis, taken as zero outside; as many rows."""
    N, L = len(values), len(kernel) // 2
    n = 1 << (N + 2 * L).bit_length()
    shape = (-1,) + (1,) * (values.ndim - 1)
    spectrum = np.fft.rfft(values, n, axis=0) * np.fft.rfft(kernel, n).reshape(shape)
    return np.asarray(np.fft.irfft(spectrum, n, axis=0)[L : L + N])
