"""Hampel filter: outliers from the running median of a signal."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import MAD_TO_STD, BoolArray, FloatArray
from diransac.data.filters import median_filter, mirrored_windows
from diransac.data.preprocessing.continuity import unwrap
from diransac.errors import SettingsError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from diransac.data.log import Log


def despike(log: Log, signals: Sequence[str] | None = None, window: int = 15, threshold: float = 8.0) -> Log:
    """Log with isolated spikes replaced by the median around them (a Hampel filter), and angles unwrapped before.

    Parameters
    ----------
    log : Log
    signals : sequence of str, optional
        None: all.
    window, threshold : int, float
        As in `hampel`.

    Raises
    ------
    LogError
        There is no such signal.
    SettingsError
        The window is even or below 3, or the threshold is not above 0.
    """
    log = unwrap(log)
    cleaned, replaced = dict(log.signals), {}
    for name in log.names if signals is None else signals:
        found, median = hampel(log[name], window, threshold)
        replaced[name] = int(found.sum())
        cleaned[name] = np.where(found, median, log[name])
    step = {"step": "despike", "window": window, "threshold": float(threshold), "replaced": replaced}
    notes = [f'{n} of {len(log)} samples of "{name}" were spikes and are replaced' for name, n in replaced.items() if n]
    return log.with_step(step, signals=cleaned, notes=notes)


def hampel(values: FloatArray, window: int = 15, threshold: float = 8.0) -> tuple[BoolArray, FloatArray]:
    """Outliers from the running median, ``|x - median| > threshold * scale``, and that median.

    Parameters
    ----------
    values : (N, ...) array
        Filtered along the first axis, mirrored at both ends.  Samples that are not finite have no part in a median.
    window : int
        Samples around each that give its median, odd.
    threshold : float
        In standard deviations, by `window_deviation`.

    Returns
    -------
    mask : (N, ...) bool array
    median : (N, ...) array

    Raises
    ------
    SettingsError
        The window is even or below 3, or the threshold is not above 0.

    References
    ----------
    Hampel 1974, "The influence curve and its role in robust estimation".
    """
    if window < 3 or window % 2 == 0 or not threshold > 0.0:
        raise SettingsError(
            f"window = {window}, threshold = {threshold}: give an odd window from 3, a threshold above 0"
        )
    with np.errstate(invalid="ignore", over="ignore"):
        median = _running_median(values, window)
        deviation = window_deviation(values, median, window)
        return np.asarray(np.abs(values - median) > threshold * deviation), median


def window_deviation(values: FloatArray, median: FloatArray, window: int) -> FloatArray:
    """Standard deviation ``(N, ...)`` in each window, from the median absolute deviation about the window's median.

    Where more than half of a window is constant, it comes from the mean absolute deviation instead, and it is at least
    one count of an encoder: a signal at rest has no median deviation.

    References
    ----------
    Iglewicz and Hoaglin 1993, "How to detect and handle outliers", for the mean absolute deviation.
    """
    off = np.abs(_windows(values, window) - median[..., None])
    scale = MAD_TO_STD * _of_finite(_middle, off)
    scale = np.where(scale > 0.0, scale, 1.2533 * _of_finite(np.mean, off))
    return np.asarray(np.maximum(scale, np.apply_along_axis(_count, 0, values)))


def _running_median(values: FloatArray, window: int) -> FloatArray:
    """Median ``(N, ...)`` of the finite samples in each window."""
    if window // 2 < len(values) and np.isfinite(values).all():
        return np.asarray(median_filter(values, window))
    return _of_finite(_middle, _windows(values, window))


def _windows(values: FloatArray, window: int) -> FloatArray:
    """The samples ``(N, ..., window)`` around each, mirrored at the ends; fewer where there are fewer."""
    return np.asarray(mirrored_windows(values, min(window // 2, len(values) - 1)))


def _middle(values: FloatArray, axis: int = -1) -> FloatArray:
    """The median over the last axis; an odd number of samples needs no sorting, which is five times as fast."""
    n = values.shape[axis]
    return np.asarray(np.partition(values, n // 2)[..., n // 2] if n % 2 else np.median(values, axis))


def _of_finite(statistic: Callable[..., Any], windows: FloatArray) -> FloatArray:
    """A statistic ``(N, ...)`` of the finite numbers in each of ``(N, ..., window)``; NaN where there is none."""
    missing = ~np.isfinite(windows)
    with np.errstate(invalid="ignore"):
        result = np.asarray(statistic(windows, axis=-1), dtype=float)
    for at in zip(*np.nonzero(missing.any(axis=-1)), strict=True) if missing.any() else ():
        finite = windows[at][~missing[at]]
        result[at] = statistic(finite, axis=-1) if len(finite) else np.nan
    return result


def _count(values: FloatArray) -> float:
    """One count of an encoder: the smallest change of the signal, if it occurs often; 0 otherwise."""
    changes = np.abs(np.diff(values))
    changes = changes[np.isfinite(changes) & (changes > 0.0)]
    if not len(changes):
        return 0.0
    smallest = float(changes.min())
    often = np.isclose(changes, smallest, rtol=1e-3).sum() > 0.01 * len(values)
    return smallest if often else 0.0
