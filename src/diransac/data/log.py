"""`Log`: named, uniformly sampled signals of one machine, with units, filters and the history of their preparation."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, overload

import numpy as np
import numpy.typing as npt

from diransac.arrays import BoolArray, FloatArray
from diransac.data import checks
from diransac.data.checks import as_column, numeric_columns
from diransac.data.clock import on_own_grid
from diransac.data.files import Metadata, write_columns
from diransac.data.filters import FilterSpecification
from diransac.data.units import split_unit
from diransac.errors import LogError


class Frame(Protocol):
    """Common interface of polars and pandas data frames."""

    @property
    def columns(self) -> Iterable[str]:
        """Names of the columns."""

    def __getitem__(self, column: str, /) -> Series:
        """A column by name."""


class Series(Protocol):
    """Common interface of their columns."""

    def to_numpy(self) -> npt.NDArray[Any]:
        """The column as an array (N,)."""


@dataclass(frozen=True, eq=False, repr=False)
class Log:
    """Named signals of one machine, sampled at one uniform rate.

    Parameters
    ----------
    time : (N,) array
        Seconds, strictly increasing, even to within 20 % of a sample.
    signals : mapping of str to (N,) array
        NaN is a missing sample.
    units : mapping of str to str
        Units of the signals whose unit is known.
    source : str
        Name of the log in messages, such as ``log "flight.csv"``.
    history : tuple of dict
        Preparation steps in order, each a mapping that JSON can hold.
    notes : tuple of str
        Findings about the samples and changes to them, a sentence each.
    unusable : mapping of str to str
        Columns of the file that are not among the signals, and why: ``is not numeric: row 0 holds 'a'``.
    filter : FilterSpecification, optional
        Filters that the signals have passed and that a regression needs; None for signals as they were recorded.

    Raises
    ------
    LogError
        Fewer than 2 rows; unequal lengths; a time that is not finite, increasing and even; a filter whose bandwidth is
        less than 4e-7 of the rate.

    Notes
    -----
    The arrays are copies and read-only.  Rows count from 0.
    """

    time: FloatArray
    signals: Mapping[str, FloatArray]
    units: Mapping[str, str] = field(default_factory=dict)
    source: str = "log"
    history: tuple[dict[str, Any], ...] = ()
    notes: tuple[str, ...] = ()
    unusable: Mapping[str, str] = field(default_factory=dict)
    filter: FilterSpecification | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.source, str):
            raise LogError(f"the source of a log is {self.source!r:.60}; give a text")
        checks.check_names(self.signals, self.source)
        time = as_column(self.time, "t", self.source)
        signals = {name: as_column(values, name, self.source) for name, values in self.signals.items()}
        for name, values in signals.items():
            if len(values) != len(time):
                raise LogError(f'{self.source}: signal "{name}" has {len(values)} rows, the time has {len(time)}')
        checks.check_time_order(time, self.source)
        checks.check_even(time, self.source)
        if self.filter is not None and self.filter.bandwidth * np.mean(np.diff(time)) < 4e-7:
            raise LogError(f"{self.source}: a filter of {self.filter.bandwidth:.3g} Hz is too long for its rate")
        units = {name: unit for name, unit in self.units.items() if name in signals}
        for key, value in (("time", time), ("signals", signals), ("units", units), ("unusable", dict(self.unusable))):
            object.__setattr__(self, key, MappingProxyType(value) if isinstance(value, dict) else value)
        object.__setattr__(self, "history", tuple(self.history))
        object.__setattr__(self, "notes", tuple(self.notes))

    # ------------------------------------------------------------------ construction

    @classmethod
    def from_arrays(
        cls,
        time: npt.ArrayLike,
        signals: Mapping[str, npt.ArrayLike],
        units: Mapping[str, str] | None = None,
        source: str = "log",
    ) -> Log:
        """Log of arrays in memory.

        Parameters
        ----------
        time : (N,) array_like
            Seconds.
        signals : mapping of str to (N,) array_like
        units : mapping of str to str, optional
        source : str
            Name of the log in messages.

        Raises
        ------
        LogError
            As `Log`; a column does not hold real numbers; a unit is given for no signal; rows are so far apart that the
            time cannot be in seconds.
        """
        columns = {name: np.asarray(values) for name, values in signals.items()}
        return cls._from_columns(np.asarray(time), columns, units or {}, source)

    @classmethod
    def from_frame(
        cls, frame: Frame, units: Mapping[str, str] | None = None, time: str = "t", source: str = "log"
    ) -> Log:
        """Log of a polars or pandas data frame.

        Parameters
        ----------
        frame : polars.DataFrame or pandas.DataFrame
            A column ``theta [deg]`` is the signal ``theta`` in degrees; a column that does not hold numbers is left
            out, with a note.
        units : mapping of str to str, optional
        time : str
            Name of the column of seconds; every other column is a signal.
        source : str
            Name of the log in messages.

        Raises
        ------
        LogError
            As `Log`; ``frame`` is no data frame; there is no such time column.
        """
        if not hasattr(frame, "columns"):
            raise LogError(f"{source}: frame is a {type(frame).__name__}; give a polars or pandas data frame")
        headers = [split_unit(str(column)) for column in frame.columns]
        columns = {name: frame[column].to_numpy() for (name, _), column in zip(headers, frame.columns, strict=True)}
        if len(columns) < len(headers):
            raise LogError(f"{source}: two columns have one name; found {', '.join(name for name, _ in headers)}")
        if time not in columns:
            raise LogError(
                f'{source}: there is no time column "{time}"; found {", ".join(columns)}. Name it with time='
            )
        numbers, unusable = numeric_columns({name: values for name, values in columns.items() if name != time})
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
        stamps = as_column(time, "t", source)
        signals = {name: as_column(values, name, source) for name, values in columns.items()}
        if any(len(x) != len(stamps) for x in signals.values()):
            return cls(stamps, signals, units, source)  # which raises
        found = on_own_grid(stamps, signals, source)
        log = cls(found.time, found.signals, units, source, found.steps, unusable=unusable or {})
        notes = (*found.notes, *checks.check_clock(log.time, source), *log.findings(found.recorded))
        return replace(log, notes=notes)

    def findings(self, recorded: BoolArray | None = None) -> tuple[str, ...]:
        """Sentences about columns that are left out, an uneven clock, and samples that are missing or infinite.

        Parameters
        ----------
        recorded : (N,) bool array, optional
            Rows that were recorded: those of which the missing samples are named.  None: all.
        """
        left_out = [f'column "{name}" is left out: it {why}' for name, why in self.unusable.items()]
        rows = slice(None) if recorded is None or recorded.all() else recorded  # a view where none is missing
        gaps = checks.describe_gaps(self.time[rows], {name: x[rows] for name, x in self.signals.items()})
        return (*left_out, *checks.describe_jitter(self.time), *gaps)

    # ------------------------------------------------------------------ contents

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
    def measured(self) -> Log:
        """The log without the signals that were derived from others, which are no measurements; itself without any."""
        derived = {} if self.filter is None else self.filter.derived
        if self.filter is None or not set(derived) & set(self.signals):
            return self
        signals = {name: values for name, values in self.signals.items() if name not in derived}
        specification = replace(self.filter, derived={})
        return replace(self, signals=signals, filter=specification)

    @property
    def dt(self) -> float:
        """Mean time from each sample to the next, seconds."""
        return float((self.time[-1] - self.time[0]) / (len(self.time) - 1))

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of names, time and samples, independent of the columns' order."""
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
            if np.abs(values[row]) > 1e150:
                raise LogError(f'{self.source}: signal "{name}" is {values[row]:.3g} at {where}: its square overflows')

    # ------------------------------------------------------------------ parts

    @overload
    def __getitem__(self, key: str) -> FloatArray: ...
    @overload
    def __getitem__(self, key: slice) -> Log: ...
    def __getitem__(self, key: str | slice) -> FloatArray | Log:
        """Signal ``(N,)`` of a name (``"t"`` is the time), or log of a range of rows.

        Raises
        ------
        LogError
            There is no such signal; fewer than 2 rows are left.
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
        """Log of the rows with ``start <= t <= end``, seconds.

        Raises
        ------
        LogError
            Fewer than 2 rows lie there.
        """
        slack = checks.ROUNDING * self.dt
        first, last = np.searchsorted(self.time, [start - slack, end + slack])
        if last - first < 2:
            raise LogError(
                f"{self.source}: fewer than 2 rows lie between {start} and {end} s; "
                f"the log runs from {self.time[0]:.6g} to {self.time[-1]:.6g} s"
            )
        return self[int(first) : int(last)]

    def split(self, fraction: float) -> tuple[Log, Log]:
        """Logs of the first ``fraction`` of the rows and of the rest, such as for identification and validation.

        Raises
        ------
        LogError
            The fraction is not between 0 and 1, or either part would have fewer than 2 rows.
        """
        if not 0.0 < fraction < 1.0:
            raise LogError(f"{self.source}: fraction is {fraction}; give a number between 0 and 1")
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
        """Log with one more step in its history, and with those contents replaced that are given."""
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
        return (Log, (*state, dict(self.unusable), self.filter))

    def write(self, path: str | Path) -> None:
        """Write the log to a file from which `read_log` returns an equal log, to the last bit.

        Parameters
        ----------
        path : str or Path
            Its ending is ``.csv``, ``.csv.gz``, ``.parquet`` or ``.npz``.

        Raises
        ------
        LogError
            Another ending; the file cannot be written; the history holds values that JSON cannot.

        Notes
        -----
        The columns are the time ``t`` and the signals.  Units, filter, history, notes and the reasons for unusable
        columns are metadata: of CSV text in the file ``NAME.csv-metadata.json`` beside it (CSV on the Web), which is to
        be moved with it; a key of a Parquet file; or a member of an NPZ archive.  The file is written whole or not at
        all.
        """
        facts = Metadata(self.units, self.filter, self.history, self.notes, self.unusable)
        write_columns(Path(path), {"t": self.time, **self.signals}, facts)
