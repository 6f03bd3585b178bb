"""The steps that need a log alone: names, factors, rates, delays, spikes and wrapped angles."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt

from diransac.arrays import BoolArray, FloatArray
from diransac.data.units import conversion
from diransac.errors import LogError, SettingsError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from diransac.data.log import Log

__all__ = [
    "check_factor",
    "despike",
    "hampel",
    "origins_of",
    "rename",
    "rename_columns",
    "resample",
    "resample_columns",
    "running_deviation",
    "scale",
    "shift",
    "unwrap",
    "window_deviation",
]

Column = TypeVar("Column")

_BRIDGED_INTERVALS = 3.5
_MOST_ROWS = 10_000_000
_ROUNDING = 1e-6
_MAD_TO_STD, _MEAN_TO_STD = 1.4826, 1.2533
_COUNT_ROUNDING, _USUAL = 1e-3, 0.01
_WRAPPING = 0.75
_FOLDING = 0.9


# ---------------------------------------------------------------------- names and factors


def rename(log: Log, names: Mapping[str, str]) -> Log:
    """The log with signals under other names; ``names`` maps a new name to the name that the log has.

    Raises LogError: the log has no such signal, or has the new name already.
    """
    signals = rename_columns(log.signals, names, log.source)
    origins = origins_of(log.signals, names)
    units = {new: log.units[old] for new, old in origins.items() if old in log.units}
    renamed = log.with_step({"step": "rename", "names": dict(names)}, signals=signals, units=units)
    return renamed if log.filter is None else replace(renamed, filter=log.filter.renamed(origins))


def rename_columns(columns: Mapping[str, Column], names: Mapping[str, str], source: str) -> dict[str, Column]:
    """The columns under their new names, ``names`` mapping new to old ones; others keep theirs.

    Raises LogError: an old name is missing, or a new one belongs to another column.
    """
    for new, old in names.items():
        if old not in columns:
            raise LogError(f'{source}: there is no column "{old}" to call "{new}"; found {", ".join(columns)}')
        if new in columns and new not in names.values():
            raise LogError(
                f'{source}: "{old}" cannot be called "{new}", there is a column of that name; '
                f"give that one another name, too (--map {new}={old},{new}_other={new})"
            )
    return {new: columns[old] for new, old in origins_of(columns, names).items()}


def origins_of(columns: Mapping[str, Any], names: Mapping[str, str]) -> dict[str, str]:
    """New name -> old name of every column, in the columns' order; a column may be given several names."""
    origins: dict[str, str] = {}
    for column in columns:
        news = [new for new, old in names.items() if old == column]
        origins.update(dict.fromkeys(news or [column], column))
    return origins


def scale(log: Log, factors: Mapping[str, float]) -> Log:
    """The log with signals multiplied by factors; a signal whose size changes loses its unit, for it no longer holds.

    Raises LogError: the log has no such signal.  SettingsError: a factor is zero or not finite.
    """
    for name, factor in factors.items():
        check_factor(name, factor)
    signals = {**log.signals, **{name: log[name] * factor for name, factor in factors.items()}}
    units = {name: unit for name, unit in log.units.items() if abs(factors.get(name, 1.0)) == 1.0}
    step = {"step": "scale", "factors": {name: float(factor) for name, factor in factors.items()}}
    return log.with_step(step, signals=signals, units=units)


def check_factor(name: str, factor: float) -> None:
    """Raise SettingsError where a factor would wipe a signal out."""
    if not math.isfinite(factor) or factor == 0.0:
        raise SettingsError(f'the scale of "{name}" is {factor}; give a finite factor other than 0')


# ---------------------------------------------------------------------- time


def resample(log: Log, rate: float | str = "median") -> Log:
    """The log at a uniform rate, interpolated linearly.

    Parameters
    ----------
    rate : Hz, or ``"median"`` for one sample per median interval

    A signal is NaN where its samples are, and in gaps of the clock.  Nothing is filtered: at a lower rate, what moves
    faster than half of it is folded to lower frequencies, and said.
    Raises SettingsError: the rate has no meaning.  LogError: fewer than 2 samples are left, or
    more than ten million are made.
    """
    time, signals, step, notes = resample_columns(log.time, log.signals, rate, log.source)
    return log.with_step(step, time=time, signals=signals, notes=notes)


def resample_columns(
    time: FloatArray, signals: Mapping[str, FloatArray], rate: float | str, source: str
) -> tuple[FloatArray, dict[str, FloatArray], dict[str, Any], list[str]]:
    """Columns at a uniform rate, with the step for the history and what is to be said; ``time`` (N,) increases.

    An interval of more than three and a half usual ones (and more than one new sample) is a gap: no sample is made up
    in it.
    """
    steps = np.diff(time)
    usual = float(np.median(steps))
    hertz = _rate(rate, usual)
    n = _new_rows(float(time[-1] - time[0]), hertz, source)
    grid = time[0] + np.arange(n) / hertz
    left = np.clip(np.searchsorted(time, grid, side="right") - 1, 0, len(time) - 2)
    weight = np.clip((grid - time[left]) / steps[left], 0.0, 1.0)
    gaps = steps > max(_BRIDGED_INTERVALS * usual, 1.0 / hertz)
    blank = gaps[left] & (weight > _ROUNDING) & (weight < 1.0 - _ROUNDING)
    resampled = {name: np.where(blank, np.nan, _between(values, left, weight)) for name, values in signals.items()}
    step = {"step": "resample", "rate": hertz, "method": "linear", "rows": [len(time), n], "gaps": int(gaps.sum())}
    return grid, resampled, step, _resampling_notes(time, gaps, blank, hertz)


def _rate(rate: float | str, usual: float) -> float:
    if rate == "median":
        return 1.0 / usual
    if isinstance(rate, str) or not 0.0 < rate < math.inf:
        raise SettingsError(f'resampling to {rate!r} has no meaning; give a rate in Hz, or "median"')
    return float(rate)


def _new_rows(seconds: float, hertz: float, source: str) -> int:
    """How many rows a rate makes.  Raises LogError: fewer than 2, or more than `_MOST_ROWS`."""
    rows = seconds * hertz * (1.0 + 1e-12) + 1e-9
    if rows < 1.0:
        raise LogError(f"{source}: resampling at {hertz:.6g} Hz leaves 1 row of {seconds:.6g} s")
    if rows >= _MOST_ROWS:
        raise LogError(
            f"{source}: resampling {seconds:.6g} s at {hertz:.6g} Hz would make {rows:.4g} rows; at most "
            f"{_MOST_ROWS:,} are made: give a lower rate, or --scale t=FACTOR if t is not in seconds"
        )
    return math.floor(rows) + 1


def _between(values: FloatArray, left: npt.NDArray[np.intp], weight: FloatArray) -> FloatArray:
    """Linear interpolation that looks at a neighbour only where it has weight, so that NaN does not spread."""
    mixed = (1.0 - weight) * values[left] + weight * values[left + 1]
    return np.where(weight < _ROUNDING, values[left], np.where(weight > 1.0 - _ROUNDING, values[left + 1], mixed))


def _resampling_notes(
    time: FloatArray, gaps: npt.NDArray[np.bool_], blank: npt.NDArray[np.bool_], hertz: float
) -> list[str]:
    notes = [f"resampled from {len(time)} to {len(blank)} rows at {hertz:.6g} Hz, by linear interpolation"]
    if hertz * np.median(np.diff(time)) < _FOLDING:
        notes.append(f"no filter went before it: motion and noise above {hertz / 2.0:.4g} Hz now appear below")
    if gaps.any():
        steps = np.where(gaps, np.diff(time), 0.0)
        row = int(steps.argmax())
        notes.append(
            f"{gaps.sum()} gap{'s' * bool(gaps.sum() > 1)} in time, the longest {steps[row]:.4g} s after "
            f"t = {time[row]:.6g} s: {blank.sum()} rows are NaN"
        )
    return notes


def shift(log: Log, delays: Mapping[str, float]) -> Log:
    """The log with signals moved later in time: the new signal at ``t`` is the old one at ``t - delay``.

    Parameters
    ----------
    delays : name -> seconds; positive for a command that acts late, negative for a measurement that arrived late

    Fractions of a sample are interpolated linearly; rows at both ends that a moved signal no longer covers are cut.
    Raises LogError: there is no such signal, or nothing is left.
    """
    n = np.arange(len(log), dtype=float)
    signals, covered = dict(log.signals), np.ones(len(log), dtype=bool)
    for name, delay in delays.items():
        if not math.isfinite(delay):
            raise SettingsError(f'the delay of "{name}" is {delay}; give seconds')
        rows = n - delay / log.dt
        covered &= (rows >= -_ROUNDING) & (rows <= n[-1] + _ROUNDING)
        rows = np.clip(rows, 0.0, n[-1])
        left = np.minimum(rows.astype(np.intp), len(log) - 2)
        signals[name] = _between(log[name], left, rows - left)
    if covered.sum() < 2:
        raise LogError(f"{log.source}: delays of {dict(delays)} s leave no row of {len(log) * log.dt:.6g} s")
    step = {"step": "shift", "delays": {name: float(delay) for name, delay in delays.items()}}
    note = f"{(~covered).sum()} rows cut at the ends, which delayed signals do not cover"
    kept = {name: values[covered] for name, values in signals.items()}
    return log.with_step(step, time=log.time[covered], signals=kept, notes=[note] if not covered.all() else [])


# ---------------------------------------------------------------------- spikes and angles


def despike(log: Log, signals: Sequence[str] | None = None, window: int = 15, threshold: float = 8.0) -> Log:
    """The log with isolated spikes replaced by the median around them (a Hampel filter).

    Parameters
    ----------
    signals : names; None for all
    window, threshold : as in `hampel`

    Raises LogError: there is no such signal.  SettingsError: the window or the threshold has no meaning.
    """
    cleaned, replaced = dict(log.signals), {}
    for name in log.names if signals is None else signals:
        found, median = hampel(log[name], window, threshold)
        replaced[name] = int(found.sum())
        cleaned[name] = np.where(found, median, log[name])
    step = {"step": "despike", "window": window, "threshold": float(threshold), "replaced": replaced}
    notes = [f'{n} of {len(log)} samples of "{name}" were spikes and are replaced' for name, n in replaced.items() if n]
    return log.with_step(step, signals=cleaned, notes=notes)


def hampel(
    values: FloatArray,
    window: int = 15,
    threshold: float = 8.0,
    scale: Callable[[FloatArray, FloatArray, int], FloatArray] | None = None,
) -> tuple[BoolArray, FloatArray]:
    """Outliers from the running median, ``|x - median| > threshold * scale``, and that median.

    Parameters
    ----------
    values : (N, ...) array
        Filtered along the first axis, mirrored at both ends.  Samples that are not finite have no part in a median.
    window : int
        Samples around each that give its median, odd.
    threshold : float
        In standard deviations.
    scale : callable, optional
        ``scale(values, median, window) -> (N, ...)`` standard deviation around each sample.  None: `window_deviation`,
        for a signal ``(N,)`` of any kind, as in `despike`; the method ``lo-diransac`` screens inputs ``(N, n_u)`` with
        `running_deviation`.

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
    median = _running_median(values, window)
    deviation = (scale or window_deviation)(values, median, window)
    with np.errstate(invalid="ignore"):
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
    scale = _MAD_TO_STD * _of_finite(_middle, off)
    scale = np.where(scale > 0.0, scale, _MEAN_TO_STD * _of_finite(np.mean, off))
    return np.maximum(scale, np.apply_along_axis(_count, 0, values))


def running_deviation(values: FloatArray, median: FloatArray, window: int) -> FloatArray:
    """Standard deviation ``(N, ...)`` from the running median of ``|x - median|``, at least that of the whole signal.

    Changes of the size that is usual over the whole signal, such as a controller's steps, are then no outliers.
    """
    whole = np.median(np.abs(values - np.median(values, axis=0)), axis=0)
    return np.maximum(_MAD_TO_STD * _running_median(np.abs(values - median), window), _MAD_TO_STD * whole)


def _running_median(values: FloatArray, window: int) -> FloatArray:
    """Median ``(N, ...)`` of the finite samples in each window."""
    return _of_finite(_middle, _windows(values, window))


def _windows(values: FloatArray, window: int) -> FloatArray:
    """The samples ``(N, ..., window)`` around each, mirrored at the ends."""
    reach = min(window // 2, len(values) - 1)
    padded = np.pad(values, [(reach, reach), *[(0, 0)] * (values.ndim - 1)], mode="reflect")
    return np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=0)


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
    """One count of an encoder: the smallest change of the signal, if that is a usual one; 0 otherwise."""
    changes = np.abs(np.diff(values))
    changes = changes[np.isfinite(changes) & (changes > 0.0)]
    if not len(changes):
        return 0.0
    smallest = float(changes.min())
    usual = np.isclose(changes, smallest, rtol=_COUNT_ROUNDING).sum() > _USUAL * len(values)
    return smallest if usual else 0.0


def unwrap(log: Log, names: Sequence[str]) -> Log:
    """The log with the jumps by a turn taken out of the angles that are wrapped.

    An angle is wrapped if it lies within one turn and jumps by more than half of it, most often by three quarters and
    more: outliers leave that range, or jump by less, and such a signal is left alone.  The turn is 360 for a signal in
    degrees, 2 pi otherwise.
    Raises LogError: there is no such signal.
    """
    wrapped = {name: jumps for name in names if (jumps := _jumps(log[name], _turn(log, name)))}
    if not wrapped:
        return log
    signals = {**log.signals, **{name: _unwrapped(log[name], _turn(log, name)) for name in wrapped}}
    notes = [f'"{name}" was wrapped to one turn; {n} jumps are taken out' for name, n in wrapped.items()]
    return log.with_step({"step": "unwrap", "jumps": wrapped}, signals=signals, notes=notes)


def _turn(log: Log, name: str) -> float:
    factor = conversion(log.units.get(name, "rad"), "rad")
    return 2.0 * math.pi / (1.0 if factor is None else factor)


def _jumps(values: FloatArray, turn: float) -> int:
    """How often an angle that lies within one turn jumps by more than half of it, as wrapping does: mostly by all."""
    finite = values[np.isfinite(values)]
    if len(finite) < 2 or np.ptp(finite) > turn * (1.0 + _ROUNDING):
        return 0
    jumps = np.abs(np.diff(finite))
    jumps = jumps[jumps > 0.5 * turn]
    return len(jumps) if len(jumps) and np.median(jumps) > _WRAPPING * turn else 0


def _unwrapped(values: FloatArray, turn: float) -> FloatArray:
    finite = np.isfinite(values)
    result = values.copy()
    result[finite] = np.unwrap(values[finite], period=turn)
    return result
