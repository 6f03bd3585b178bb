"""How far up a log's motion stands out of its noise.

Whatever noise a position carries, differentiation makes it grow with frequency, while a body that is moved by limited
forces moves the less the higher the frequency.  So the power spectrum of the acceleration falls, and rises again where
noise takes over.  The lowest value that it has at or above a frequency is an upper bound of the noise there,

    N(f) = min over f' >= f of A(f'),

which asks nothing about the noise's colour (an encoder's counts, a resolver, a filtered tachometer).  The bandwidth is
chosen as the B that maximises the sum of ``A(f) - 10 N(f)`` over ``f <= B``: beyond it, the motion is no longer ten
times as strong as the noise may be.  Ten, where least error in the acceleration itself would ask for two: noise in a
regressor pulls its parameter towards zero by the ratio of powers, the more so where regressors resemble each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diransac.arrays import FloatArray

__all__ = ["HIGHEST", "LONGEST", "Bandwidth", "choose_bandwidth"]


# Bandwidth times sample interval, and bandwidth times duration, that are chosen at most and at least.
HIGHEST, LONGEST = 0.1, 10.0
_SIGNAL_TO_NOISE = 10.0
_SEGMENTS, _SMALLEST_SEGMENT = 8, 32
_SMOOTHING = 1.2


@dataclass(frozen=True)
class Bandwidth:
    """A bandwidth, Hz, and the share of noise in the acceleration's power below it, at most."""

    value: float
    noise_share: float


def choose_bandwidth(motions: list[tuple[FloatArray, int]], dt: float) -> Bandwidth:
    """The lowest bandwidth among a log's motions, for the rows of a regression mix them all.

    Parameters
    ----------
    motions : each a signal (N,) and how often it is to be differentiated until it is an acceleration
    dt : seconds

    A signal that does not stand out of its noise has no say; where none does, the highest bandwidth is chosen.
    """
    found = [x for values, order in motions if (x := _of_one_motion(values, order, dt)) is not None]
    chosen = min(found, key=lambda x: x.value, default=Bandwidth(HIGHEST / dt, 1.0))
    n = max((len(values) for values, _ in motions), default=0)
    lowest = min(LONGEST / max(n * dt, dt), HIGHEST / dt)
    return Bandwidth(float(np.clip(chosen.value, lowest, HIGHEST / dt)), chosen.noise_share)


def _of_one_motion(values: FloatArray, order: int, dt: float) -> Bandwidth | None:
    f, A = _acceleration_spectrum(values, order, dt)
    if not len(f) or not A.all():
        return None
    noise = np.minimum.accumulate(A[::-1])[::-1]
    gain = np.cumsum(A - _SIGNAL_TO_NOISE * noise)
    best = int(gain.argmax())
    if gain[best] <= 0.0:
        return None
    return Bandwidth(float(f[best]), float(noise[: best + 1].sum() / A[: best + 1].sum()))


def _acceleration_spectrum(values: FloatArray, order: int, dt: float) -> tuple[FloatArray, FloatArray]:
    """Frequencies, Hz, and power density of the acceleration, up to twice the highest bandwidth; lines smoothed away.

    Welch's average over segments of the differences, which are nearly white, so that little leaks from low
    frequencies to high ones; then a geometric mean over a fifth of the frequency to either side.
    """
    differences = np.diff(values - values.mean(), order) / dt**order
    n = min(len(differences), max(_SMALLEST_SEGMENT, 2 * len(differences) // (_SEGMENTS + 1)))
    segments = np.lib.stride_tricks.sliding_window_view(differences, n)[:: max(1, n // 2)]
    spectra = np.abs(np.fft.rfft(np.hanning(n + 1)[:n] * segments, axis=1)) ** 2
    f = np.fft.rfftfreq(n, dt).astype(np.float64)
    inside = (f > 0.0) & (f <= 2.0 * HIGHEST / dt)
    f, power = f[inside], spectra.mean(axis=0)[inside]
    response = (np.pi * f * dt / np.sin(np.pi * f * dt)) ** (2 * order)
    return f, _smooth(f, power * response)


def _smooth(f: FloatArray, power: FloatArray) -> FloatArray:
    """The geometric mean of the power at ``f / 1.2`` to ``1.2 f``; 0 where there is none."""
    low, high = np.searchsorted(f, f / _SMOOTHING, side="left"), np.searchsorted(f, f * _SMOOTHING, side="right")
    with np.errstate(divide="ignore", invalid="ignore"):
        total = np.concatenate([[0.0], np.cumsum(np.log(power))])
        mean = np.exp((total[high] - total[low]) / (high - low))
    return np.where(np.isfinite(mean), mean, 0.0)
