"""Requirements of a log: real numbers under valid names, and a time that increases evenly."""

from __future__ import annotations

import re
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from diransac.arrays import FloatArray
from diransac.errors import LogError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from diransac.model import Model

ROUNDING = 1e-6
"""Part of a sample that rounding may make of equal times."""
_SHORTEST_ABBREVIATION, _LONGEST_NAME = 3, 100
"""Letters of a name that are compared."""


# ---------------------------------------------------------------------- columns


def as_doubles(values: npt.NDArray[Any]) -> FloatArray:
    """Copy of an array of numbers as float64, without warning of the signalling NaNs that damaged bytes may hold."""
    with np.errstate(invalid="ignore", over="ignore"):
        return values.astype(np.float64)


def as_numbers(values: npt.NDArray[Any]) -> FloatArray | str:
    """Copy of an array as float64, or the reason why it has none: ``is not numeric: row 3 holds 'takeoff'``."""
    if values.dtype.kind in "biuf":
        return as_doubles(values)
    if values.dtype.kind != "O":
        return f"is not numeric: row 0 holds {values.ravel()[0]!s:.60}" if values.size else "is empty"
    numbers = np.full(values.shape, np.nan)
    for row, value in enumerate(values.ravel()):
        if isinstance(value, (bool, int, float, np.number, np.bool_)) and not isinstance(value, np.complexfloating):
            numbers.flat[row] = value
        elif value is not None and str(value) not in ("<NA>", "NaT"):
            return f"is not numeric: row {row} holds {value!r:.60}"
    return numbers


def numeric_columns(columns: Mapping[str, npt.NDArray[Any]]) -> tuple[dict[str, FloatArray], dict[str, str]]:
    """Columns that hold numbers, and for each of the others the reason why it does not."""
    converted = {name: as_numbers(values) for name, values in columns.items()}
    numbers = {name: values for name, values in converted.items() if not isinstance(values, str)}
    return numbers, {name: why for name, why in converted.items() if isinstance(why, str)}


def as_column(values: npt.ArrayLike, name: str, source: str) -> FloatArray:
    """Read-only copy ``(N,)``, or such a copy itself.  Raises LogError: they are not one column of real numbers."""
    array = np.asarray(values)
    if array.dtype == np.float64 and array.ndim == 1 and array.flags.owndata and not array.flags.writeable:
        return array
    numbers = as_numbers(array)
    if isinstance(numbers, str):
        raise LogError(f'{source}: signal "{name}" {numbers}')
    if numbers.ndim != 1:
        raise LogError(f'{source}: signal "{name}" has shape {numbers.shape}; give one number per row, (N,)')
    numbers.flags.writeable = False
    return numbers


def check_names(names: Iterable[object], source: str) -> None:
    """Raise LogError for a name that no signal can have."""
    for name in names:
        if not isinstance(name, str) or not name or name != name.strip():
            raise LogError(f"{source}: {name!r} cannot name a signal; use a text that has no spaces around it")
        if name == "t":
            raise LogError(f'{source}: "t" is the time; give the signal another name')


def alike(name: str, others: Iterable[str]) -> str | None:
    """The other name that is likely to be the same one in another spelling; None without one.

    Parameters
    ----------
    name : str
    others : iterable of str
        Names that nothing uses.

    Examples
    --------
    >>> alike("theta", ["x", "thteta"]), alike("theta", ["Theta", "teta"]), alike("q1", ["q2"]), alike("x", ["z"])
    ('thteta', 'Theta', None, None)
    """
    from difflib import SequenceMatcher

    letters, digits = _letters_and_digits(name)
    likeness: dict[str, float] = {}
    for other in islice(others, 1000):
        own, its_digits = _letters_and_digits(other)
        if own and its_digits == digits:
            likeness[other] = 0.9 if _abbreviates(other, name) else SequenceMatcher(None, letters, own).ratio()
    nearest = max(likeness, key=lambda other: likeness[other], default=name)
    return nearest if likeness.get(nearest, 0.0) >= 0.8 else None


def _abbreviates(short: str, name: str) -> bool:
    """True for ``x_pos`` of ``x_position``, whose words it begins, and for ``arm.force`` of ``force``."""
    if len(name) >= _SHORTEST_ABBREVIATION and short.rpartition(".")[2].lower() == name.lower():
        return True
    words, whole = (re.findall(r"[a-z]+|\d+", x[:_LONGEST_NAME].lower()) for x in (short, name))
    begins = len(words) == len(whole) > 0 and all(b.startswith(a) for a, b in zip(words, whole, strict=True))
    return begins and len(words[-1]) >= _SHORTEST_ABBREVIATION


def other_spelling(name: str, signals: Iterable[str], model: Model) -> str | None:
    """Signal of a log that its model does not have and that is likely to be the named one; None without one."""
    known = {*model.signals, *model.inputs}
    return alike(name, [x for x in signals if x not in known])


def _letters_and_digits(name: str) -> tuple[str, str]:
    """Small letters and digits of a name, and its digits alone."""
    plain = "".join(x for x in name.lower() if x.isalnum())[:_LONGEST_NAME]
    return plain, "".join(x for x in plain if x.isdigit())


def rows_per_sample(known: npt.NDArray[np.bool_]) -> int:
    """Median number of rows from one sample of a signal to the next; 1 for a signal with a sample in most rows."""
    if known.all():
        return 1
    rows = np.flatnonzero(known)
    # Samples of a signal from which its rate is taken.
    return int(np.median(np.diff(rows))) if len(rows) >= 5 else 1


def describe_gaps(time: FloatArray, signals: Mapping[str, FloatArray]) -> list[str]:
    """Sentences about slow signals, and about missing and infinite samples: signals, number, and time of the first."""
    missing = {name: np.isnan(values) for name, values in signals.items()}
    slow = {name: n for name, x in missing.items() if (n := rows_per_sample(~x)) > 1}
    rate = (len(time) - 1) / (time[-1] - time[0])
    sentences = [
        f"{_quoted([name for name, x in slow.items() if x == n])} sampled at {rate / n:.4g} Hz, one row in {n}"
        for n in dict.fromkeys(slow.values())
    ]
    missing = {name: x for name, x in missing.items() if name not in slow}
    infinite = {name: np.isinf(values) for name, values in signals.items()}
    return [*sentences, *_where("NaN", missing, time), *_where("infinite", infinite, time)]


def _quoted(names: list[str]) -> str:
    """Subject of a sentence with its verb: ``"x", "z" are``."""
    return ", ".join(f'"{name}"' for name in names) + (" is" if len(names) == 1 else " are")


def _where(word: str, flags: Mapping[str, npt.NDArray[np.bool_]], time: FloatArray) -> list[str]:
    """Sentences such as ``"x", "z" are NaN in 3 of 100 rows``, one for all signals with the same rows."""
    groups: dict[bytes, list[str]] = {}
    for name, flag in flags.items():
        if flag.any():
            groups.setdefault(flag.tobytes(), []).append(name)
    sentences = []
    for names in groups.values():
        flag = flags[names[0]]
        first = time[int(flag.argmax())]
        sentences.append(f"{_quoted(names)} {word} in {flag.sum()} of {len(flag)} rows, first at t = {first:.6g} s")
    return sentences


# ---------------------------------------------------------------------- time


def shortest_and_longest(time: FloatArray) -> tuple[float, float]:
    """Intervals of stamps ``(N,)``, s."""
    n = 1 << 15  # stamps whose intervals stay in a processor's cache
    parts = (np.diff(time[k : k + n + 1]) for k in range(0, len(time) - 1, n))
    shortest, longest = zip(*((float(x.min()), float(x.max())) for x in parts), strict=True)
    return min(shortest), max(longest)


def check_time_order(time: FloatArray, source: str) -> None:
    """Raise LogError if time ``(N,)`` has fewer than 2 rows, is not finite, repeats, runs backwards or stands still."""
    if len(time) < 2:
        raise LogError(f"{source}: a log has at least 2 rows; found {len(time)}")
    if not np.isfinite(time).all():
        row = int(np.argmin(np.isfinite(time)))
        raise LogError(f"{source}: time is {time[row]} at row {row}; give every row a time in seconds")
    if shortest_and_longest(time)[0] > 0.0:
        if time[-1] - time[0] < 1e-12 * (len(time) - 1):
            raise LogError(
                f"{source}: rows are {float(np.median(np.diff(time))):.4g} s apart, which no clock resolves; "
                "pass --scale t=FACTOR if the time is not in seconds"
            )
        return
    steps = np.diff(time)
    row, n = int(np.argmax(steps <= 0.0)), int((steps <= 0.0).sum())
    more = f" (and {n - 1} more like it)" if n > 1 else ""
    if steps[row] == 0.0:
        raise LogError(f"{source}: time {time[row]:.9g} s repeats at row {row + 1}{more}; remove the duplicate rows")
    raise LogError(
        f"{source}: time runs backwards at row {row + 1}: {time[row + 1]:.9g} s follows {time[row]:.9g} s{more}; "
        "sort the rows by time, or split the file there"
    )


def check_even(time: FloatArray, source: str) -> None:
    """Raise LogError if an interval differs from the mean one by more than a fifth.

    Every row is taken to last ``dt``, so that single intervals matter, and the drift of the clock does not.
    """
    (shortest, longest), dt = shortest_and_longest(time), float(time[-1] - time[0]) / (len(time) - 1)
    if max(longest - dt, dt - shortest) <= (0.2 + ROUNDING) * dt:
        return
    steps = np.diff(time)
    usual = float(np.median(steps))
    row, gaps = int(np.argmax(np.abs(steps - usual))), steps > 1.5 * usual
    n_gaps = int(gaps.sum())
    what = f"{n_gaps} gap{'s' * (n_gaps > 1)}, the longest" if gaps[row] else "the most uneven interval"
    raise LogError(
        f"{source}: time is not uniform: {what} after t = {time[row]:.6g} s (row {row}) is {steps[row]:.4g} s long, "
        f"the usual interval {usual:.4g} s; resample it: --resample {1.0 / usual:.4g}, or read_log(..., resample=...)"
    )


def are_many(n_bad: int, n: int) -> bool:
    """True for more than 1 in 100, and more than one, of ``n`` rows, lines or fields: these are not left out."""
    return n_bad > max(1, n // 100)


def is_implausible(n_new: float, n: int) -> bool:
    """True for a number of new rows of ``n`` old ones that only a damaged time leads to."""
    return not n_new <= max(100_000, 1000 * n)


def check_clock(time: FloatArray, source: str, *, in_file: bool = False) -> list[str]:
    """Sentence about a median interval that suggests another unit than seconds, with the factor to seconds.

    Parameters
    ----------
    time : (N,) array
    source : str
    in_file : bool
        True for the time of a file that does not say its unit.

    Raises LogError: the interval is longer than 1000 s; of a file, than 1 s.
    """
    shortest, longest = shortest_and_longest(time)
    if shortest >= 1e-7 and longest <= 1.0:  # and so is the median
        return []
    dt = float(np.median(np.diff(time)))
    apart = f"rows are {dt:.4g} s apart"
    if dt < 1e-7:
        return [f"{apart}: check the unit of t, and pass --scale t=FACTOR if it is not in seconds"]
    # The interval from which on these clocks, with their ticks, are more likely than the next.
    clocks = (("nanoseconds", 1e-9, 2e5), ("microseconds", 1e-6, 500.0), ("milliseconds", 1e-3, 1.0 + ROUNDING))
    unit, tick = next(((unit, tick) for unit, tick, least in clocks if dt > least), ("seconds", 1.0))
    if unit == "seconds":
        return []
    finding = f"{apart}: if t is in {unit}, pass --scale t={tick:g}"
    if dt > 1e3 or in_file:
        seconds = "" if dt > 1e3 else "; if it is in seconds, --scale t=1"
        raise LogError(f"{source}: {finding}, or read_log(..., scale={{'t': {tick:g}}}){seconds}")
    return [finding]


def describe_jitter(time: FloatArray) -> list[str]:
    """Sentence about the largest deviation from an even clock, if it exceeds 0.1 % of a sample."""
    (shortest, longest), dt = shortest_and_longest(time), (time[-1] - time[0]) / (len(time) - 1)
    if max(longest - dt, dt - shortest) <= 1e-3 * dt:
        return []
    jitter = np.abs(np.diff(time) / dt - 1.0)
    return [f"time is uneven by up to {jitter.max():.1%} of a sample (at t = {time[int(jitter.argmax())]:.6g} s)"]
