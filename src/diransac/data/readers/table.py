"""`Table`: the contents of a file before they are checked as a log."""

from __future__ import annotations

import math
import re
import struct
import zipfile
import zlib
from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy.typing as npt

from diransac.arrays import FloatArray
from diransac.data.checks import as_numbers
from diransac.data.files import decode_metadata
from diransac.data.filters import FilterSpecification
from diransac.data.units import conversion, split_unit
from diransac.errors import LogError
from diransac.limits import MOST_COLUMNS, MOST_NUMBERS, MOST_ROWS, SizeError, beyond
from diransac.plain_text import one_line

DAMAGE: tuple[type[Exception], ...] = (
    *(ValueError, TypeError, LookupError, AttributeError, ArithmeticError, AssertionError, NotImplementedError),
    *(OSError, EOFError, MemoryError, RuntimeError, struct.error, zlib.error, zipfile.BadZipFile),
)
"""Errors that damaged files lead to in the libraries that read them, and here."""


@contextmanager
def undamaged(what: str, errors: tuple[type[Exception], ...] = DAMAGE) -> Iterator[None]:
    """Context in which a file is read.  Raises LogError: it is damaged; the message begins with a clause on it."""
    try:
        yield
    except LogError:
        raise
    except errors as error:
        why = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise LogError(f"{what} ({why:.150})") from error


@contextmanager
def installed(what: str) -> Iterator[None]:
    """Context of imports from packages of the extra logs.  Raises LogError: one is missing; ``what`` needs it."""
    try:
        yield
    except ImportError as error:
        raise LogError(f'{what}; pip install "diransac[logs]"') from error


@contextmanager
def readable(source: str) -> Iterator[None]:
    """Context in which a file is opened and read.  Raises LogError: there is none, it is too large, or unreadable."""
    try:
        yield
    except SizeError as error:
        raise LogError(f"{source}: {error}; split it") from error
    except ValueError as error:  # a path with a null byte
        raise LogError(f"{source}: it cannot be read: {error}") from error
    except FileNotFoundError as error:
        raise LogError(f"{source}: there is no such file") from error
    except OSError as error:
        raise LogError(f"{source}: it cannot be read: {error.strerror}") from error


@dataclass(frozen=True)
class Table:
    """Columns of a file; all of its texts become texts of one line.

    Parameters
    ----------
    columns : mapping of str to (n,) array or str
        Numbers, or the reason why a column has none, such as ``is not numeric: line 3 holds "takeoff"``.
    units : mapping of str to str
        Units in headers and metadata.
    notes : tuple of str
        Findings of the reader, a sentence each.
    history, filter
        Those of the log that was written to the file, as in `Log`.
    is_described : bool
        True with the metadata of a log.
    times : mapping of str to (n,) array
        Seconds since the first, of columns that hold times of the calendar.
    elements : tuple of str
        Names, such as those of joints, for which ``{joint}`` in a mapping stands.
    """

    columns: Mapping[str, FloatArray | str]
    units: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    history: tuple[dict[str, Any], ...] = ()
    filter: FilterSpecification | None = None
    is_described: bool = False
    times: Mapping[str, FloatArray] = field(default_factory=dict)
    elements: tuple[str, ...] = ()

    @property
    def numbers(self) -> dict[str, FloatArray]:
        """Columns that hold numbers."""
        return {name: x for name, x in self.columns.items() if not isinstance(x, str)}

    @property
    def n_rows(self) -> int:
        """Length of the longest column of numbers."""
        return max(map(len, self.numbers.values()), default=0)

    def with_step(self, step: Mapping[str, Any]) -> Table:
        """The table with one more step in its history."""
        return replace(self, history=(*self.history, dict(step)))

    def scaled(self, factors: Mapping[str, float]) -> Table:
        """The table with columns times factors, the time then in seconds; no unit where the magnitude changes."""
        if not factors:
            return self
        columns = {**self.columns, **{name: x * factors[name] for name, x in self.numbers.items() if name in factors}}
        before = {name: self.units[name] for name in factors if name in self.units}
        units = {name: unit for name, unit in self.units.items() if abs(factors.get(name, 1.0)) == 1.0}
        units |= {"t": "s"} if "t" in factors else {}
        step = {"step": "scale", "factors": dict(factors), **({"units": before} if before else {})}
        return replace(self, columns=columns, units=units).with_step(step)

    def with_time_of(self, name: str) -> Table:
        """The table in which a column with times of the calendar is seconds since the first."""
        if name not in self.times:
            return self
        note = f'"{name}" holds times, of which the first is zero'
        columns = {**self.columns, name: self.times[name]}
        return replace(self, columns=columns, units={**self.units, name: "s"}, notes=(*self.notes, note), times={})

    def __post_init__(self) -> None:
        columns = {one_line(name): one_line(x) if isinstance(x, str) else x for name, x in self.columns.items()}
        units = {one_line(name): one_line(unit) for name, unit in self.units.items()}
        times = {one_line(name): x for name, x in self.times.items()}
        notes = tuple(map(one_line, self.notes))
        for key, value in (("columns", columns), ("units", units), ("notes", notes), ("times", times)):
            object.__setattr__(self, key, value)


def with_metadata(table: Table, text: str | bytes, source: str, remedy: str = "write the log again") -> Table:
    """Table completed by the metadata of its file; units in headers, which an editor may have changed, prevail.

    Raises LogError: the metadata are damaged.
    """
    facts = decode_metadata(text, source, remedy)
    return replace(
        table,
        columns={**table.columns, **{name: why for name, why in facts.unusable.items() if name not in table.columns}},
        units={**facts.units, **table.units},
        notes=(*facts.notes, *table.notes),
        history=facts.history,
        filter=facts.filter,
        is_described=True,
    )


def check_size(source: str, rows: int, columns: int, numbers: int | None = None) -> None:
    """Raise LogError for more rows, columns or numbers than a log may have.

    Parameters
    ----------
    source : str
    rows, columns : int
    numbers : int, optional
        In all columns; by default rows times columns.
    """
    numbers = rows * columns if numbers is None else numbers
    of_log = ((columns, MOST_COLUMNS, "columns"), (rows, MOST_ROWS, "rows"), (numbers, MOST_NUMBERS, "numbers"))
    for found, most, what in of_log:
        if found > most:
            raise LogError(f"{source}: it has {beyond(most, what, found)}; split it, or leave some out")


def check_unique(names: Sequence[str], source: str) -> None:
    """Raise LogError if two columns have one name."""
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        raise LogError(
            f'{source}: {names.count(repeated[0])} columns are called "{repeated[0]}"; give each its own name'
        )


def check_shapes(shapes: Sequence[tuple[int, ...]], source: str) -> None:
    """Raise LogError where arrays of these shapes make a table that is larger than a log may be."""
    matrices = [shape for shape in shapes if _is_matrix(shape)]
    others = [math.prod(shape) for shape in shapes if not _is_matrix(shape)]
    check_size(
        source,
        max((*others, *(rows for rows, _ in matrices)), default=0),
        len(others) + sum(columns for _, columns in matrices),
        sum(others) + sum(math.prod(shape) for shape in matrices),
    )


def _is_matrix(shape: tuple[int, ...]) -> bool:
    """True for an array that is a column of each of its own."""
    return len(shape) == 2 and 1 not in shape


def table_of_arrays(arrays: Mapping[str, npt.NDArray[Any]], source: str) -> Table:
    """Table of named arrays: a vector is one column, a matrix ``q (n, k)`` the columns ``q_1`` to ``q_k``.

    Raises LogError: two columns would have one name; the table is larger than a log may be.
    """
    check_shapes([x.shape for x in arrays.values()], source)
    headers = [split_unit(name) for name in arrays]
    pieces = [piece for (name, _), x in zip(headers, arrays.values(), strict=True) for piece in _pieces(name, x)]
    check_unique([name for name, _ in pieces], source)
    return Table(dict(pieces), {name: unit for name, unit in headers if unit is not None})


def _pieces(name: str, array: npt.NDArray[Any]) -> list[tuple[str, FloatArray | str]]:
    if _is_matrix(array.shape):
        return [(f"{name}_{k + 1}", as_numbers(array[:, k])) for k in range(array.shape[1])]
    if array.ndim > 2:
        return [(name, f"has {array.ndim} dimensions: {array.shape}")]
    return [(name, as_numbers(array.ravel()))]


# The time -------------------------------------------------------------------------------------------------------------
_UNIT_OF_ENDING = {
    **dict.fromkeys(("s", "sec", "secs", "seconds"), "s"),
    **dict.fromkeys(("ms", "msec", "millis", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "usec", "micros", "microseconds"), "us"),
    **dict.fromkeys(("ns", "nsec", "nanos", "nanoseconds"), "ns"),
}
_NAME = re.compile(
    rf"(?:t[ _.-]|(?i:time|time[ _.-]?stamps?|stamp)[ _.-]?)(?P<unit>(?i:{'|'.join(_UNIT_OF_ENDING)}))"
    r"|(?i:time|time[ _]?stamps?|stamp)"
)


def time_column(table: Table, taken: Container[str]) -> str | None:
    """Name of the one column that a table can have as its time; None without one, and where it has ``t``.

    Parameters
    ----------
    table : Table
    taken : container of str
        Columns that are something else.
    """
    if "t" in table.columns:
        return None
    for kind in (table.numbers, table.times):
        found = [name for name in kind if _NAME.fullmatch(name) and name not in taken]
        if found:
            return found[0] if len(found) == 1 else None
    return None


def unit_of_name(name: str) -> str | None:
    """Unit at the end of the name of a time column, such as that of ``t_ms``; None without one."""
    match = _NAME.fullmatch(name)
    return _UNIT_OF_ENDING[match["unit"].lower()] if match and match["unit"] else None


def seconds(table: Table, source: str) -> tuple[FloatArray, str]:
    """Column ``t`` (N,) of a table in seconds, and a sentence on a conversion from its unit, empty without one.

    Raises LogError: there is no such column, or it holds no numbers.
    """
    if "t" not in table.columns:
        found = ", ".join(table.columns)
        rate = "" if any(map(_NAME.fullmatch, table.columns)) else ", or give the rate of a log without one: --rate HZ"
        raise LogError(f'{source}: there is no time column "t"; found {found}. Say which one it is: --map t=NAME{rate}')
    time = table.columns["t"]
    if isinstance(time, str):
        raise LogError(f'{source}: the time column "t" {time}')
    unit = table.units.get("t", "s")
    factor = conversion(unit, "s")
    if factor in (None, 1.0):
        return time, ""
    return time * factor, f"the time is converted from {unit} to s"
