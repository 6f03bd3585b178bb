"""Zero-phase low-pass filters of finite length, and the derivatives of what they let through.

The filter is a windowed sinc, ``h(t) = 2 B sinc(2 B t) w(t)`` with Kaiser's window ``w`` over ``|t| <= 2.5 / B``.  It
passes half at the bandwidth B, all but 1e-4 below B / 2, and 1e-4 above 3 B / 2.  As it is symmetric, it shifts no
phase; as it is finite, a filtered sample depends on what lies within 2.5 / B of it and on nothing else.
"""

from __future__ import annotations

import numpy as np

from diransac.arrays import FloatArray

__all__ = ["REACH", "convolve", "half_length", "kernels"]


REACH = 2.5
_KAISER_BETA = 7.857


def half_length(bandwidth: float, dt: float) -> int:
    """Samples that the filter looks at to either side."""
    return max(1, int(np.ceil(REACH / (bandwidth * dt))))


def kernels(bandwidth: float, dt: float) -> FloatArray:
    """Impulse responses (3, 2 L + 1) of the filter and of its first and second derivatives, in 1, 1/s and 1/s^2.

    The filter leaves a ramp as it is, the first derivative is exact for a parabola, the second for a cubic.
    """
    L = half_length(bandwidth, dt)
    t = np.arange(-L, L + 1) * dt
    smooth = np.sinc(2.0 * bandwidth * t) * np.kaiser(2 * L + 1, _KAISER_BETA)
    smooth /= smooth.sum()
    first, second = (_derivative(smooth, order, dt) for order in (1, 2))
    first = first - first[::-1]
    second = second + second[::-1]
    second -= second.sum() * smooth
    return np.stack([smooth, -first / (t * first).sum(), 2.0 * second / (t**2 * second).sum()])


def _derivative(kernel: FloatArray, order: int, dt: float) -> FloatArray:
    """The derivative of the band-limited function that runs through a kernel, at the kernel's samples."""
    n = 4 * len(kernel)
    spectrum = np.fft.rfft(kernel, n) * (2j * np.pi * np.fft.rfftfreq(n, dt)) ** order
    return np.asarray(np.fft.irfft(spectrum, n)[: len(kernel)])


def convolve(values: FloatArray, kernel: FloatArray) -> FloatArray:
    """``values (N, ...)`` filtered along the first axis, taken as zero outside; as many rows."""
    N, L = len(values), len(kernel) // 2
    n = 1 << (N + 2 * L).bit_length()
    response = np.fft.rfft(kernel, n).reshape(-1, *(1,) * (values.ndim - 1))
    return np.asarray(np.fft.irfft(np.fft.rfft(values, n, axis=0) * response, n, axis=0)[L : L + N])
