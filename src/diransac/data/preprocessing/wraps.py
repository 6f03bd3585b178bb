"""Periods of columns that wrap: counters of a number of bits, angles whose turn has another unit.

A wrapped coordinate lies within one period, leaps by nearly that period from one of its ends to the other alone, and
goes on at the rate that it had.
"""

from __future__ import annotations

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.data.filters import median_filter

COUNTER_BITS = (8, 12, 16, 24, 32)
"""Bits of counters of encoders and timers."""
# Samples of the running median that takes out outliers, and of those on either side of a leap that give its rate.
_WINDOW, _BESIDE = 3, 12
# Shares of the range: of a leap at least, and of any other step at most.
_LEAP, _STEP = 0.6, 0.25
# Shares of the steps that may be larger, beside outliers, and of the leaps that are wraps at least.
_ODD_STEPS, _MOST = 0.01, 0.8
# Relative error of a resolution by rounding, and of a period that is one of a counter or a turn.
_ROUNDING, _SAME = 1e-9, 0.01
# Rate over the usual one with which a column passes its ends, at least.
_FAST = 0.1
# Smallest steps that tell the resolution.
_SMALL = 100


def wrap_period(values: FloatArray, turns: tuple[float, ...] = ()) -> float | None:
    """Period of a wrapped column, in its unit; None of one that does not wrap.

    Parameters
    ----------
    values : (N,) array
        NaN where a sample is missing.
    turns : tuple of float, optional
        Periods that are likelier than others, in the unit of the column.

    Returns
    -------
    float or None
        One of ``turns``, or a power of two of the resolution, if the leaps are equal to it; else the size of leaps of
        which there are several.
    """
    known = values[np.isfinite(values)]
    if len(known) < 4 * _BESIDE or np.abs(np.diff(known)).max() < _STEP * np.ptp(known):
        return None
    usual_values = median_filter(known, _WINDOW)
    span = float(np.ptp(usual_values))
    y = known[np.abs(known - usual_values) <= _STEP * span]
    steps = np.diff(y)
    leaps = np.abs(steps) > _LEAP * span
    if not leaps.any() or np.mean(np.abs(steps[~leaps]) > _STEP * span) > _ODD_STEPS:
        return None
    at = np.flatnonzero(leaps)
    rates = _rates(steps, leaps, at)
    sizes = np.abs(steps[at] - rates.mean(axis=1))
    period, usual = float(np.median(sizes)), float(np.median(np.abs(steps[~leaps])))
    resolution = _resolution(known)
    speed = float(np.sqrt(np.square(steps[~leaps]).mean()))
    least = max(_FAST * speed, 1.5 * resolution / _BESIDE)
    slack = np.abs(rates).max(axis=1) + usual + resolution
    ends = np.sort([y[at], y[at + 1]], axis=0)
    wraps = (ends[0] - y.min() <= 2.0 * slack) & (y.max() - ends[1] <= 2.0 * slack)
    wraps &= np.abs(sizes - period) <= 2.0 * slack
    if wraps.mean() < _MOST or not _goes_on(steps[at[wraps]], rates[wraps], least):
        return None
    tolerance = max(float(np.median(slack)), _ROUNDING * period)
    named = [*turns, *(2.0**bits * resolution for bits in COUNTER_BITS)]
    near = [x for x in named if abs(x - period) <= min(2.0 * tolerance, _SAME * period)]
    if near:
        return float(min(near, key=lambda x: abs(x - period)))
    return resolution * round(period / resolution) if len(at) > 1 else None


def _rates(steps: FloatArray, leaps: BoolArray, at: np.typing.NDArray[np.intp]) -> FloatArray:
    """Steps ``(n, 2)`` per sample before and after each leap; NaN-free means of the few samples beside it."""
    quiet = np.where(leaps, np.nan, steps)
    padded = np.pad(quiet, _BESIDE, constant_values=np.nan)
    sides = np.stack([[padded[i : i + _BESIDE], padded[i + _BESIDE + 1 : i + 2 * _BESIDE + 1]] for i in at])
    with np.errstate(invalid="ignore"):
        n = np.isfinite(sides).sum(axis=2)
        return np.asarray(np.nansum(sides, axis=2) / np.maximum(n, 1))


def _goes_on(leaps: FloatArray, rates: FloatArray, least: float) -> bool:
    """True if leaps are against the motion, which has one rate on both sides, wherever it is fast enough to tell.

    Runs that start and end at rest, one after another, leap where nothing moves.
    """
    sizes = np.abs(rates)
    fast = sizes.min(axis=1) > np.maximum(0.25 * sizes.max(axis=1), least)
    against = (np.sign(rates) == -np.sign(leaps)[:, None]).all(axis=1)
    return bool(fast.any() and against[fast].mean() >= _MOST)


def _resolution(values: FloatArray) -> float:
    """Smallest step of a column, or difference of steps, that is no rounding error, refined by all small ones."""
    steps, rounding = np.abs(np.diff(values)), _ROUNDING * float(np.abs(values).max())
    small = np.unique(steps[steps > rounding])[:_SMALL]
    apart = np.diff(small)
    least = float(min(small[0], apart[apart > rounding].min(initial=np.inf)))
    counts = np.round(small / least)
    return float(small @ counts / (counts @ counts))
