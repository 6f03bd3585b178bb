"""`Log`: named, uniformly sampled signals of one machine, with units and the story of how they came about."""

from __future__ import annotations

import gzip
import hashlib
import zipfile
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol, overload

import numpy as np
import numpy.typing as npt

from diransac.atomic import write_with
from diransac.errors import LogError
from diransac.units import split_unit

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

__all__ = ["Log", "as_numbers", "check_names", "check_time_order"]

FloatArray = npt.NDArray[np.float64]

SILENT_JITTER = 1e-3
TOLERATED_JITTER = 0.2
GAP = 1.5
_LARGEST = 1e150
_JITTER_ROUNDING = 1e-6


class Frame(Protocol):
    """What polars and pandas data frames share."""

    @property
    def columns(self) -> Iterable[str]:
        """The columns' names."""

    def __getitem__(self, column: str, /) -> Series:
        """A column by name."""


class Series(Protocol):
    """What their columns share."""

    def to_numpy(self) -> npt.NDArray[Any]:
        """The column as an array (N,)."""


@dataclass(frozen=True, eq=False, repr=False)
class Log:
    """Named signals of one machine, sampled at one uniform rate.

    Parameters
    ----------
    time : (N,)   seconds, strictly increasing, even to within 20 % of a sample
    signals : name -> (N,) numbers; NaN is a missing sample
    units : name -> unit, of those that are known
    source : how messages name the log, such as ``log "flight.csv"``
    history : preparation steps in order, each a mapping that JSON can hold
    notes : what was found when the log was made, a sentence each
    unusable : name -> why a column of the file is not among the signals

    The arrays are copies and read-only.  Rows count from 0.

    Raises LogError: fewer than 2 rows, unequal lengths, a time that is not finite, increasing and even.
    """

    time: FloatArray
    signals: Mapping[str, FloatArray]
    units: Mapping[str, str] = field(default_factory=dict)
    source: str = "log"
    history: tuple[dict[str, Any], ...] = ()
    notes: tuple[str, ...] = ()
    unusable: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_names(self.signals, self.source)
        time = _column(self.time, "t", self.source)
        signals = {name: _column(values, name, self.source) for name, values in self.signals.items()}
        for name, values in signals.items():
            if len(values) != len(time):
                raise LogError(f'{self.source}: signal "{name}" has {len(values)} rows, the time has {len(time)}')
        check_time_order(time, self.source)
        _check_even(time, self.source)
        units = {name: unit for name, unit in self.units.items() if name in signals}
        for key, value in (("time", time), ("signals", signals), ("units", units), ("unusable", dict(self.unusable))):
            object.__setattr__(self, key, MappingProxyType(value) if isinstance(value, dict) else value)
        object.__setattr__(self, "history", tuple(self.history))
        object.__setattr__(self, "notes", tuple(self.notes))

    # ------------------------------------------------------------------ making one

    @classmethod
    def from_arrays(
        cls,
        time: npt.ArrayLike,
        signals: Mapping[str, npt.ArrayLike],
        units: Mapping[str, str] | None = None,
        source: str = "log",
    ) -> Log:
        """A log of arrays ``(N,)`` in memory; ``time`` in seconds.

        Raises LogError: as `Log`; a column that does not hold real numbers; a unit for a signal that is not there.
        """
        columns = {name: np.asarray(values) for name, values in signals.items()}
        return cls._from_columns(np.asarray(time), columns, units or {}, source)

    @classmethod
    def from_frame(
        cls, frame: Frame, units: Mapping[str, str] | None = None, time: str = "t", source: str = "log"
    ) -> Log:
        """A log of a polars or pandas data frame: ``time`` names the column of seconds, every other one is a signal.

        A column ``theta [deg]`` is the signal ``theta`` in degrees; one that does not hold numbers is left out, and
        said in the notes.
        Raises LogError: as `Log`; there is no such time column.
        """
        headers = [split_unit(str(column)) for column in frame.columns]
        columns = {name: frame[column].to_numpy() for (name, _), column in zip(headers, frame.columns, strict=True)}
        if len(columns) < len(headers):
            raise LogError(f"{source}: two columns have one name; found {', '.join(name for name, _ in headers)}")
        if time not in columns:
            raise LogError(
                f'{source}: there is no time column "{time}"; found {", ".join(columns)}. Name it with time='
            )
        numbers, unusable = _numeric_columns({name: values for name, values in columns.items() if name != time})
        known = {name: unit for name, unit in headers if unit is not None} | dict(units or {})
        known.pop(time, None)
        return cls._from_columns(columns[time], numbers, known, source, unusable)

    @classmethod
    def _from_columns(
        cls,
        time: npt.NDArray[Any],
        columns: Mapping[str, npt.NDArray[Any]],
        units: Mapping[str, str],
        source: str,
        unusable: Mapping[str, str] | None = None,
    ) -> Log:
        unknown = [name for name in units if name not in columns and name not in (unusable or {})]
        if unknown:
            raise LogError(f'{source}: a unit is given for "{unknown[0]}"; found {", ".join(columns)}')
        log = cls(time, columns, units, source, unusable=unusable or {})
        return replace(log, notes=log.findings())

    def findings(self) -> tuple[str, ...]:
        """What is worth saying: columns left out, an uneven clock, missing values, infinities; a sentence each."""
        notes = [f'column "{name}" is left out: it {why}' for name, why in self.unusable.items()]
        jitter = np.abs(np.diff(self.time) / self.dt - 1.0)
        if jitter.max() > SILENT_JITTER:
            at = self.time[int(jitter.argmax())]
            notes.append(f"time is uneven by up to {jitter.max():.1%} of a sample (at t = {at:.6g} s)")
        for word, test in (("NaN", np.isnan), ("infinite", np.isinf)):
            notes += _where(word, {name: test(values) for name, values in self.signals.items()}, self.time)
        return tuple(notes)

    # ------------------------------------------------------------------ looking at it

    def __len__(self) -> int:
        return len(self.time)

    def __contains__(self, name: object) -> bool:
        return name in self.signals

    def __repr__(self) -> str:
        return f"Log({self.source}: {len(self)} rows at {1.0 / self.dt:.6g} Hz, {', '.join(self._found)})"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the signals, without the time ``t``."""
        return tuple(self.signals)

    @property
    def _found(self) -> tuple[str, ...]:
        return ("t", *self.names)

    @property
    def dt(self) -> float:
        """Time from one sample to the next, seconds."""
        return float((self.time[-1] - self.time[0]) / (len(self.time) - 1))

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 over names, time and samples, whatever the columns' order."""
        digest = hashlib.sha256()
        for name, values in [("t", self.time), *sorted(self.signals.items())]:
            digest.update(f"{name}\0{len(values)}\0".encode())
            digest.update(np.where(np.isnan(values), np.nan, values).astype("<f8").tobytes())
        return digest.hexdigest()

    def check(self, names: Sequence[str]) -> None:
        """Raise LogError where a signal is missing, all NaN, infinite, or too large for its square."""
        for name in names:
            values = self[name]
            if np.isnan(values).all():
                raise LogError(f'{self.source}: signal "{name}" is NaN in every row; leave it out, or give its samples')
            row = int(np.argmax(np.abs(np.nan_to_num(values, nan=0.0, posinf=np.inf, neginf=-np.inf))))
            where = f"row {row} (t = {self.time[row]:.6g} s)"
            if np.isinf(values[row]):
                raise LogError(f'{self.source}: signal "{name}" is infinite at {where}; give NaN for a missing sample')
            if np.abs(values[row]) > _LARGEST:
                raise LogError(f'{self.source}: signal "{name}" is {values[row]:.3g} at {where}: its square overflows')

    # ------------------------------------------------------------------ parts of it

    @overload
    def __getitem__(self, key: str) -> FloatArray: ...
    @overload
    def __getitem__(self, key: slice) -> Log: ...
    def __getitem__(self, key: str | slice) -> FloatArray | Log:
        """A signal ``(N,)`` by name (``"t"`` is the time), or the log of a range of rows.

        Raises LogError: there is no such signal; fewer than 2 rows are left.
        """
        if isinstance(key, slice):
            return self._cut(key)
        if key in self.signals:
            return self.signals[key]
        if key == "t":
            return self.time
        if key in self.unusable:
            raise LogError(f'{self.source}: signal "{key}" {self.unusable[key]}')
        raise LogError(f'{self.source}: signal "{key}" is missing; found {", ".join(self._found)}')

    def _cut(self, rows: slice) -> Log:
        time = self.time[rows]
        if len(time) < 2:
            raise LogError(
                f"{self.source}: a log has at least 2 rows; rows {rows.start} to {rows.stop} leave {len(time)}"
            )
        step = {"step": "cut", "start": float(time[0]), "end": float(time[-1]), "rows": len(time)}
        signals = {name: values[rows] for name, values in self.signals.items()}
        return replace(self, time=time, signals=signals, history=(*self.history, step))

    def between(self, start: float, end: float) -> Log:
        """The rows with ``start <= t <= end``, seconds.

        Raises LogError: fewer than 2 rows lie there.
        """
        slack = _JITTER_ROUNDING * self.dt
        first, last = np.searchsorted(self.time, [start - slack, end + slack])
        if last - first < 2:
            raise LogError(
                f"{self.source}: fewer than 2 rows lie between {start} and {end} s; "
                f"the log runs from {self.time[0]:.6g} to {self.time[-1]:.6g} s"
            )
        return self[int(first) : int(last)]

    def split(self, fraction: float) -> tuple[Log, Log]:
        """The log's first ``fraction`` of rows and the rest, such as for identifying and validating.

        Raises LogError: either part would have fewer than 2 rows.
        """
        row = round(fraction * len(self))
        return self[:row], self[row:]

    def with_step(
        self,
        step: Mapping[str, Any],
        *,
        time: FloatArray | None = None,
        signals: Mapping[str, FloatArray] | None = None,
        units: Mapping[str, str] | None = None,
        notes: Sequence[str] = (),
    ) -> Log:
        """The log with other contents, where they are given, and one more step in its history."""
        return replace(
            self,
            time=self.time if time is None else time,
            signals=self.signals if signals is None else signals,
            units=self.units if units is None else units,
            history=(*self.history, dict(step)),
            notes=(*self.notes, *notes),
        )

    # ------------------------------------------------------------------ files and processes

    def __reduce__(self) -> tuple[Any, ...]:
        state = (self.time, dict(self.signals), dict(self.units), self.source, self.history, self.notes)
        return (Log, (*state, dict(self.unusable)))

    def write(self, path: str | Path) -> None:
        """Write time and signals to ``.csv``, ``.csv.gz``, ``.parquet`` or ``.npz``; every number reads back exactly.

        The file appears whole or not at all.  Units, history and notes are not written.
        Raises LogError: another ending, or the file cannot be written.
        """
        path = Path(path)
        endings = [ending for ending in _WRITERS if path.name.lower().endswith(ending)]
        if not endings:
            raise LogError(f'cannot write "{path}": its ending is not known; use one of {", ".join(_WRITERS)}')
        try:
            write_with(path, lambda file: _WRITERS[endings[0]]({"t": self.time, **self.signals}, file))
        except OSError as error:
            raise LogError(f'cannot write "{path}": {error.strerror or error}') from error


# ---------------------------------------------------------------------- columns


def as_numbers(values: npt.NDArray[Any]) -> FloatArray | str:
    """A copy of an array as float64, or why there is none: ``is not numeric: row 3 holds 'takeoff'``."""
    if values.dtype.kind in "biuf":
        return values.astype(np.float64)
    if values.dtype.kind != "O":
        return f"is not numeric: row 0 holds {values.ravel()[0]!s:.60}" if values.size else "is empty"
    numbers = np.full(values.shape, np.nan)
    for row, value in enumerate(values.ravel()):
        if isinstance(value, (bool, int, float, np.number, np.bool_)) and not isinstance(value, np.complexfloating):
            numbers.flat[row] = value
        elif value is not None and str(value) not in ("<NA>", "NaT"):
            return f"is not numeric: row {row} holds {value!r:.60}"
    return numbers


def _numeric_columns(columns: Mapping[str, npt.NDArray[Any]]) -> tuple[dict[str, FloatArray], dict[str, str]]:
    """The columns that hold numbers, and why each of the others does not."""
    converted = {name: as_numbers(values) for name, values in columns.items()}
    numbers = {name: values for name, values in converted.items() if not isinstance(values, str)}
    return numbers, {name: why for name, why in converted.items() if isinstance(why, str)}


def _where(word: str, flags: Mapping[str, npt.NDArray[np.bool_]], time: FloatArray) -> list[str]:
    """Sentences such as ``"x", "z" are NaN in 3 of 100 rows``, one for all signals that are so in the same rows."""
    groups: dict[bytes, list[str]] = {}
    for name, flag in flags.items():
        if flag.any():
            groups.setdefault(flag.tobytes(), []).append(name)
    sentences = []
    for names in groups.values():
        flag = flags[names[0]]
        subject = ", ".join(f'"{name}"' for name in names) + (" is" if len(names) == 1 else " are")
        first = time[int(flag.argmax())]
        sentences.append(f"{subject} {word} in {flag.sum()} of {len(flag)} rows, first at t = {first:.6g} s")
    return sentences


def _column(values: npt.ArrayLike, name: str, source: str) -> FloatArray:
    """A read-only copy ``(N,)``.  Raises LogError: it is not one column of real numbers."""
    array = np.asarray(values)
    numbers = as_numbers(array)
    if isinstance(numbers, str):
        raise LogError(f'{source}: signal "{name}" {numbers}')
    if numbers.ndim != 1:
        raise LogError(f'{source}: signal "{name}" has shape {numbers.shape}; give one number a row, (N,)')
    numbers.flags.writeable = False
    return numbers


def check_names(names: Iterable[object], source: str) -> None:
    """Raise LogError where a name cannot stand for a signal."""
    for name in names:
        if not isinstance(name, str) or not name or name != name.strip():
            raise LogError(f"{source}: {name!r} cannot name a signal; use a text that has no spaces around it")
        if name == "t":
            raise LogError(f'{source}: "t" is the time; give the signal another name')


# ---------------------------------------------------------------------- time


def check_time_order(time: FloatArray, source: str) -> None:
    """Raise LogError where time ``(N,)`` has fewer than 2 rows, is not finite, repeats or runs backwards."""
    if len(time) < 2:
        raise LogError(f"{source}: a log has at least 2 rows; found {len(time)}")
    if not np.isfinite(time).all():
        row = int(np.argmin(np.isfinite(time)))
        raise LogError(f"{source}: time is {time[row]} at row {row}; give every row a time in seconds")
    steps = np.diff(time)
    if steps.min() > 0.0:
        return
    row, n = int(np.argmax(steps <= 0.0)), int((steps <= 0.0).sum())
    more = f" (and {n - 1} more rows like it)" if n > 1 else ""
    if steps[row] == 0.0:
        raise LogError(f"{source}: time {time[row]:.9g} s repeats at row {row + 1}{more}; remove the duplicate rows")
    raise LogError(
        f"{source}: time runs backwards at row {row + 1}: {time[row + 1]:.9g} s follows {time[row]:.9g} s{more}; "
        "sort the rows by time, or split the file there"
    )


def _check_even(time: FloatArray, source: str) -> None:
    """Raise LogError where an interval differs from the mean one by more than a fifth, and say how large a gap is.

    Every row is taken to last ``dt``: what counts is how far one interval is off, not how far the clock drifts.
    """
    steps = np.diff(time)
    dt, usual = float(np.mean(steps)), float(np.median(steps))
    off = np.abs(steps - dt)
    if off.max() <= (TOLERATED_JITTER + _JITTER_ROUNDING) * dt:
        return
    row = int(np.argmax(np.abs(steps - usual)))
    n_gaps = int((steps > GAP * usual).sum())
    what = f"{n_gaps} gap{'s' * (n_gaps > 1)}, the longest" if steps[row] > GAP * usual else "the most uneven interval"
    raise LogError(
        f"{source}: time is not uniform: {what} after t = {time[row]:.6g} s (row {row}) is {steps[row]:.4g} s long, "
        f"the usual interval {usual:.4g} s; resample it: --resample {1.0 / usual:.4g}, or read_log(..., resample=...)"
    )


# ---------------------------------------------------------------------- writing


def _write_csv(columns: Mapping[str, FloatArray], file: Path) -> None:
    import polars as pl

    pl.DataFrame(dict(columns)).write_csv(file)


def _write_csv_gz(columns: Mapping[str, FloatArray], file: Path) -> None:
    import polars as pl

    with file.open("wb") as packed, gzip.GzipFile(fileobj=packed, mode="wb", filename="", mtime=0) as unpacked:
        unpacked.write(pl.DataFrame(dict(columns)).write_csv().encode())


def _write_parquet(columns: Mapping[str, FloatArray], file: Path) -> None:
    import polars as pl

    pl.DataFrame(dict(columns)).write_parquet(file)


def _write_npz(columns: Mapping[str, FloatArray], file: Path) -> None:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, values in columns.items():
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, values, allow_pickle=False)


_WRITERS = {".csv": _write_csv, ".csv.gz": _write_csv_gz, ".parquet": _write_parquet, ".npz": _write_npz}
