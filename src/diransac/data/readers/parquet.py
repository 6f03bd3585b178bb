"""Parquet: one column per signal."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.files import KEY
from diransac.data.readers.table import LARGEST, Table, check_unique, with_metadata
from diransac.data.units import split_unit
from diransac.errors import LogError
from diransac.user_files import silenced

if TYPE_CHECKING:
    import polars as pl

__all__ = ["read_parquet"]

_MAGIC = b"PAR1"
_NUMBER = 8
"""Bytes of a number."""


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
            n_columns, n_rows = len(lazy.collect_schema()), lazy.select(pl.len()).collect().item()
            if n_columns * n_rows * _NUMBER > LARGEST:
                raise LogError(f"{source}: its columns are larger than 2 GiB together; split it")
            frame = pl.read_parquet(io.BytesIO(data))
            metadata = pl.read_parquet_metadata(io.BytesIO(data)).get(KEY)
    except pl.exceptions.PanicException as error:
        raise LogError(f"{source}: the Parquet data are damaged; write the file again") from error
    except (pl.exceptions.PolarsError, OSError, MemoryError) as error:
        reason = f"{error!s:.200}".partition("\n")[0]
        raise LogError(f"{source}: the Parquet data are damaged ({reason})") from error
    named = [split_unit(header) for header in frame.columns]
    check_unique([name for name, _ in named], source)
    columns = {name: _numbers(series) for (name, _), series in zip(named, frame.get_columns(), strict=True)}
    table = Table(columns, {name: unit for name, unit in named if unit is not None})
    return table if metadata is None else with_metadata(table, metadata, source)


def _numbers(series: pl.Series) -> FloatArray | str:
    """Numbers of a column, null as NaN, or its first value, which is no number."""
    import polars as pl

    if series.dtype.is_numeric() or series.dtype in (pl.Boolean, pl.Null):
        return series.cast(pl.Float64).fill_null(np.nan).to_numpy().astype(np.float64)
    row = series.is_not_null().arg_max() or 0
    return f"is not numeric: row {row} holds {series[row]!s:.60} ({series.dtype})"
