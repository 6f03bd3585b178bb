"""The uniform grid on which a log was sampled, from the stamps of a clock with hiccups.

Stamps are points on a line of samples.  Their fractional part, the phase, is a point on a circle, and varies slowly
where a machine samples evenly, whatever rows are lost: its running mean on the circle, continued over whole turns, is
the grid.  A row belongs to the sample nearest to its stamp.  Samples without a row are missing (NaN); no sample is
invented or moved to another value.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.data import checks
from diransac.errors import LogError


@dataclass(frozen=True)
class Aligned:
    """Columns on one clock.

    Parameters
    ----------
    time : (n,) array
    signals : mapping of str to (n,) array
        NaN where no row belongs to a sample.
    recorded : (n,) bool array, optional
        Samples that have a row; None: all.
    steps : tuple of dict
        Of the history; empty where the time was even.
    notes : tuple of str
        Sentences on what was done, if anything was.
    """

    time: FloatArray
    signals: Mapping[str, FloatArray]
    recorded: BoolArray | None = None
    steps: tuple[dict[str, Any], ...] = ()
    notes: tuple[str, ...] = ()


def in_order(time: FloatArray, source: str) -> IntArray | slice:
    """Rows in the order of their stamps ``(N,)``, of several with one stamp the first; all as they are by a slice.

    Raises LogError: stamps are not finite, or more than a few are repeated or run backwards.
    """
    n = len(time)
    if n < 2 or not np.isfinite(time).all():
        checks.check_time_order(time, source)
    shortest, _ = checks.shortest_and_longest(time)
    if shortest > 0.0:
        checks.check_time_order(time, source)
        return slice(None)
    rows = np.argsort(time, kind="stable")
    rows = rows[np.r_[True, np.diff(time[rows]) > 0.0]]
    usual = float(np.median(np.diff(time[rows]))) if len(rows) > 1 else 0.0
    if len(rows) < 2 or shortest < -3.5 * usual or checks.are_many(n - len(rows), n):
        checks.check_time_order(time, source)
    return rows


def on_own_grid(time: FloatArray, signals: Mapping[str, FloatArray], source: str) -> Aligned:
    """Columns of a log on the uniform grid on which it was sampled; as they are where the time is even.

    Parameters
    ----------
    time : (N,) array
        Stamps as recorded, s.
    signals : mapping of str to (N,) array
    source : str

    Raises
    ------
    LogError
        There is no such grid: as `in_order`; or intervals have any length.
    """
    if is_even(time):
        return Aligned(time, signals)
    rows: IntArray = np.arange(len(time))[in_order(time, source)]
    dt = float(np.median(np.diff(time[rows])))
    with np.errstate(over="ignore"):
        n_new = float(time[rows[-1]] - time[rows[0]]) / dt
    if checks.is_implausible(n_new, len(time)):
        checks.check_even(time[rows], source)
    dt = _interval(time[rows], _places(time[rows], dt)[0])
    places, off = _places(time[rows], dt)
    kept = _kept(places, off)
    n, n_gaps = int(places[kept].max()) + 1, int((np.diff(places[kept]) > 1).sum())
    n_repeated = len(time) - int(kept.sum())
    # Jitter may be a third of a sample; the phase of the grid is uncertain by the rest.
    is_grid = (np.abs(off) > 0.4).mean() <= 0.02 and n_gaps <= 0.25 * len(rows)
    if not is_grid or checks.are_many(n_repeated, len(time)):
        checks.check_even(time[rows], source)
        raise LogError(f"{source}: {n_repeated} of {len(time)} rows repeat a time; remove them")
    rows, at = rows[kept], places[kept]
    dt = _interval(time[rows], at)
    grid: FloatArray = float(np.median(time[rows] - dt * at)) + dt * np.arange(n, dtype=np.float64)
    recorded = np.zeros(n, bool)
    recorded[at] = True
    on_grid = {name: np.full(n, np.nan) for name in signals}
    for name, values in signals.items():
        on_grid[name][at] = values[rows]
    step = {"step": "grid", "rate": 1.0 / dt, "rows": [len(time), n], "missing": int((~recorded).sum())}
    step |= {"repeated": n_repeated, "swapped": int((np.diff(time) < 0.0).sum())}
    said = _sentence(step, time[rows], at, float(np.quantile(np.abs(off), 0.95)))
    return Aligned(grid, on_grid, recorded, (step,), (said,))


def is_even(time: FloatArray) -> bool:
    """True for stamps ``(N,)`` that increase evenly enough for each row to be a sample."""
    try:
        checks.check_time_order(time, "")
        checks.check_even(time, "")
    except LogError:
        return False
    return True


def runs_freely(time: FloatArray) -> bool:
    """True for increasing stamps ``(N,)`` of a loop without a grid, nearly all of whose intervals are about as long."""
    steps = np.diff(time) / np.median(np.diff(time))
    return bool(((steps >= 0.5) & (steps <= 2.5)).mean() >= 0.95)


def _places(time: FloatArray, dt: float) -> tuple[IntArray, FloatArray]:
    """Sample ``(N,)`` that is nearest to each stamp, from 0 on, and how much later the stamp is, in samples."""
    at = (time - time[0]) / dt
    sums = np.concatenate([[0.0], np.cumsum(np.exp(2j * np.pi * at))])
    rows = np.arange(len(at))
    mean = sums[np.minimum(rows + 13, len(at))] - sums[np.maximum(rows - 12, 0)]  # of 25 rows
    relative = at - np.unwrap(np.angle(mean)) / (2.0 * np.pi)
    places = np.round(relative)
    return (places - places[0]).astype(np.int64), relative - places


def _interval(time: FloatArray, places: IntArray) -> float:
    """Median interval from sample to sample over many of them, which single hiccups do not change."""
    ahead = max(1, min(len(time) // 4, 1000))
    passed = np.maximum(places[ahead:] - places[:-ahead], 1)
    return float(np.median((time[ahead:] - time[:-ahead]) / passed))


def _kept(places: IntArray, off: FloatArray) -> BoolArray:
    """Rows ``(N,)`` that have a sample of their own: of several with one, the nearest.

    A late stamp, which comes before that of its sample, is first moved to the free sample before: places change.
    """
    for i in np.flatnonzero((np.diff(places) == 0) & (off[:-1] < -0.1)).tolist():
        if i == 0 or places[i - 1] < places[i] - 1:
            places[i] -= 1
    places -= places.min()
    order = np.lexsort((np.abs(off), places))
    kept = np.zeros(len(places), bool)
    kept[order[np.r_[True, np.diff(places[order]) > 0]]] = True
    return kept


def _sentence(step: Mapping[str, Any], time: FloatArray, places: IntArray, jitter: float) -> str:
    """A sentence on what was odd about a clock."""
    apart = np.diff(places)
    row, n_gaps = int(np.argmax(apart)), int((apart > 1).sum())
    parts = [f"95% of the stamps are within {jitter:.0%} of a sample"] if jitter >= 0.01 else []
    if n_gaps:
        longest = f"the longest {time[row + 1] - time[row]:.4g} s after t = {time[row]:.6g} s"
        missing = f"{step['missing']} row{'s are' if step['missing'] > 1 else ' is'} missing"
        parts.append(f"{missing} in {n_gaps} gap{'s' * (n_gaps > 1)}, {longest}")
    repeated, swapped = step["repeated"], step["swapped"]
    parts += [f"{repeated} row{'s' * (repeated > 1)} without a place left out"] if repeated else []
    parts += [f"{swapped} row{'s' * (swapped > 1)} put in the order of time"] if swapped else []
    about = f": {', '.join(parts)}" if parts else ""
    return f"time is read onto its own grid of {step['rate']:.6g} Hz{about}"
