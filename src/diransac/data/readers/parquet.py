"""Parquet: one column per signal."""

from __future__ import annotations

import io
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.files import KEY
from diransac.data.readers.table import Table, check_size, check_unique, with_metadata
from diransac.data.units import split_unit
from diransac.errors import LogError
from diransac.user_files import silenced

if TYPE_CHECKING:
    from collections.abc import Iterator

    import polars as pl

_MAGIC = b"PAR1"


def read_parquet(data: bytes, source: str) -> Table:
    """Table of a Parquet file.

    Raises LogError: the data are no Parquet file, are cut off, or are damaged.
    """
    import polars as pl
    from polars.selectors import by_name  # of which "*" and "^...$" are names as others

    with scanned(data, source) as (lazy, schema):
        numeric = [name for name, kind in schema.items() if is_numeric(kind)]
        frame = lazy.select(by_name(*numeric)).collect()
        # Texts and lists may be of any size: only few rows of columns without numbers are looked at.
        few = lazy.drop(by_name(*numeric)).head(1000).collect() if len(numeric) < len(schema) else frame.clear()
        dated = [name for name, kind in schema.items() if kind in (pl.Datetime, pl.Duration)]
        times = {name: _seconds(series) for name, series in lazy.select(by_name(*dated)).collect().to_dict().items()}
        metadata = pl.read_parquet_metadata(io.BytesIO(data)).get(KEY)
    named = [split_unit(header) for header in schema]
    check_unique([name for name, _ in named], source)
    numbers = {header: numbers_of(frame.drop_in_place(header)) for header in numeric}
    columns = {
        name: numbers[header] if header in numbers else _first(few[header])
        for (name, _), header in zip(named, schema, strict=True)
    }
    index = {"__index_level_0__": "timestamp"}  # how pandas calls its index, which is that of the rows
    named_times = {index.get(name, name): x for name, x in times.items() if x is not None}
    units = {name: unit for name, unit in named if unit is not None}
    table = Table({index.get(name, name): x for name, x in columns.items()}, units, times=named_times)
    return table if metadata is None else with_metadata(table, metadata, source)


@contextmanager
def scanned(data: bytes, source: str) -> Iterator[tuple[pl.LazyFrame, pl.Schema]]:
    """Context with the table of a Parquet file that is still to be read, and the types of its columns.

    Raises LogError: as `read_parquet`, also for what the block reads; the table is larger than a log may be.
    """
    import polars as pl

    if data[:4] != _MAGIC or data[-4:] != _MAGIC or len(data) < 12:
        what = "is cut off" if data[:4] == _MAGIC else "is not a Parquet file"
        raise LogError(f"{source}: it {what} (no {_MAGIC.decode()} mark at its {'end' if 'cut' in what else 'start'})")
    try:
        with silenced():  # Polars prints where it panics
            lazy = pl.scan_parquet(io.BytesIO(data))
            schema = lazy.collect_schema()
            numbers = sum(_declared(data, source)) if any(kind.is_nested() for kind in schema.values()) else None
            check_size(source, lazy.select(pl.len()).collect().item(), len(schema), numbers)
            yield lazy, schema
    except pl.exceptions.PanicException as error:
        raise LogError(f"{source}: the Parquet data are damaged; write the file again") from error
    except (pl.exceptions.PolarsError, OSError, MemoryError) as error:
        reason = f"{error!s:.200}".partition("\n")[0]
        raise LogError(f"{source}: the Parquet data are damaged ({reason})") from error


def is_numeric(kind: pl.DataType) -> bool:
    """True for a type of numbers or flags."""
    import polars as pl

    return kind.is_numeric() or kind in (pl.Boolean, pl.Null)


def numbers_of(series: pl.Series) -> FloatArray:
    """Numbers of a column, null as NaN; read-only, so that a log takes them as they are."""
    import polars as pl

    numbers = np.concatenate([part.to_numpy() for part in series.cast(pl.Float64).fill_null(np.nan).get_chunks()])
    numbers.flags.writeable = False
    return numbers


def _seconds(series: pl.Series) -> FloatArray | None:
    """Seconds (n,) since the first of times of the calendar, or seconds of durations; None where one is missing."""
    import polars as pl

    if series.null_count() or not len(series):
        return None
    since = series if series.dtype == pl.Duration else series - series[0]
    return np.asarray(since.dt.total_nanoseconds().to_numpy() / 1e9)


def _first(series: pl.Series) -> str:
    """The first value of a column without numbers."""
    row = series.is_not_null().arg_max() or 0
    value = " ".join(str(series[row]).split())
    return f"is not numeric: row {row} holds {value:.60} ({series.dtype})"


# ---------------------------------------------------------------------- footer


def _declared(data: bytes, source: str) -> list[int]:
    """Numbers of values in the parts of a file, by its footer: a row of a list may have any number of them.

    Raises LogError: it cannot be read.

    References: Apache Parquet, parquet.thrift; Apache Thrift, "Thrift Compact protocol".
    """
    size = int.from_bytes(data[-8:-4], "little")
    row_groups, chunks, about, n_values = 4, 1, 3, 5
    try:
        footer = _Compact(data[max(4, len(data) - 8 - size) : -8]).structure(0)
        return [int(x[about][n_values]) for group in footer[row_groups] for x in group[chunks]]
    except (IndexError, KeyError, TypeError, ValueError) as error:
        raise LogError(f"{source}: the Parquet data are damaged (its footer cannot be read)") from error


class _Compact:
    """Values in Thrift's compact encoding."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def structure(self, depth: int) -> dict[int, Any]:
        """Fields of a structure by their numbers.  Raises ValueError and the like: it is damaged."""
        fields: dict[int, Any] = {}
        number = 0
        while head := self._byte():
            number = number + (head >> 4) if head >> 4 else self._integer()
            fields[number] = self._value(head & 15, depth)
        return fields

    def _value(self, kind: int, depth: int) -> Any:
        if kind in (1, 2):
            return kind == 1
        if kind in (4, 5, 6):
            return self._integer()
        if kind in (9, 10):
            head = self._byte()
            n = head >> 4 if head >> 4 < 15 else self._natural()
            return [self._byte() if head & 15 in (1, 2) else self._value(head & 15, depth) for _ in range(n)]
        if kind == 12 and depth < 16:
            return self.structure(depth + 1)
        length = self._natural() if kind == 8 else {3: 1, 7: 8}[kind]
        self.at += length
        if self.at > len(self.data):
            raise ValueError("a value is longer than the footer")
        return None

    def _byte(self) -> int:
        self.at += 1
        return self.data[self.at - 1]

    def _natural(self) -> int:
        value, shift = 0, 0
        while (byte := self._byte()) & 128:
            value, shift = value | (byte & 127) << shift, shift + 7
            if shift > 63:
                raise ValueError("a number is too long")
        return value | byte << shift

    def _integer(self) -> int:
        value = self._natural()
        return value >> 1 ^ -(value & 1)
