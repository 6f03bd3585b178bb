"""Parquet: one column per signal."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.files import KEY
from diransac.data.readers.table import Table, check_size, check_unique, with_metadata
from diransac.data.units import split_unit
from diransac.errors import LogError
from diransac.user_files import silenced

if TYPE_CHECKING:
    import polars as pl

__all__ = ["read_parquet"]

_MAGIC = b"PAR1"
_FEW = 1000
"""Rows of a column without numbers that are looked at: texts and lists may be of any size."""


def read_parquet(data: bytes, source: str) -> Table:
    """Table of a Parquet file.

    Raises LogError: the data are no Parquet file, are cut off, or are damaged.
    """
    import polars as pl

    if data[:4] != _MAGIC or data[-4:] != _MAGIC or len(data) < 12:
        what = "is cut off" if data[:4] == _MAGIC else "is not a Parquet file"
        raise LogError(f"{source}: it {what} (no {_MAGIC.decode()} mark at its {'end' if 'cut' in what else 'start'})")
    try:
        with silenced():  # Polars prints where it panics
            lazy = pl.scan_parquet(io.BytesIO(data))
            schema = lazy.collect_schema()
            check_size(source, lazy.select(pl.len()).collect().item(), len(schema))
            numeric = [name for name, kind in schema.items() if _is_numeric(kind)]
            frame = pl.read_parquet(io.BytesIO(data), columns=numeric)
            few = lazy.drop(numeric).head(_FEW).collect() if len(numeric) < len(schema) else frame.clear()
            metadata = pl.read_parquet_metadata(io.BytesIO(data)).get(KEY)
    except pl.exceptions.PanicException as error:
        raise LogError(f"{source}: the Parquet data are damaged; write the file again") from error
    except (pl.exceptions.PolarsError, OSError, MemoryError) as error:
        reason = f"{error!s:.200}".partition("\n")[0]
        raise LogError(f"{source}: the Parquet data are damaged ({reason})") from error
    named = [split_unit(header) for header in schema]
    check_unique([name for name, _ in named], source)
    numbers = {header: _numbers(frame.drop_in_place(header)) for header in numeric}
    columns = {
        name: numbers[header] if header in numbers else _first(few[header])
        for (name, _), header in zip(named, schema, strict=True)
    }
    table = Table(columns, {name: unit for name, unit in named if unit is not None})
    return table if metadata is None else with_metadata(table, metadata, source)


def _is_numeric(kind: pl.DataType) -> bool:
    import polars as pl

    return kind.is_numeric() or kind in (pl.Boolean, pl.Null)


def _numbers(series: pl.Series) -> FloatArray:
    """Numbers of a column, null as NaN."""
    import polars as pl

    return series.cast(pl.Float64).fill_null(np.nan).to_numpy().astype(np.float64)


def _first(series: pl.Series) -> str:
    """The first value of a column without numbers."""
    row = series.is_not_null().arg_max() or 0
    value = " ".join(str(series[row]).split())
    return f"is not numeric: row {row} holds {value:.60} ({series.dtype})"
