"""Writing a log's columns, whole or not at all, so that every number reads back exactly."""

from __future__ import annotations

import gzip
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.atomic import write_with
from diransac.errors import LogError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

__all__ = ["ENDINGS", "write_columns"]


def write_columns(path: Path, columns: Mapping[str, FloatArray]) -> None:
    """Write columns to ``.csv``, ``.csv.gz``, ``.parquet`` or ``.npz``.

    Raises LogError: another ending, or the file cannot be written; an existing file is then untouched.
    """
    endings = [ending for ending in _WRITERS if path.name.lower().endswith(ending)]
    if not endings:
        raise LogError(f'cannot write "{path}": its ending is not known; use one of {", ".join(_WRITERS)}')
    try:
        write_with(path, lambda file: _WRITERS[endings[0]](columns, file))
    except OSError as error:
        raise LogError(f'cannot write "{path}": {error.strerror or error}') from error


def _write_csv(columns: Mapping[str, FloatArray], file: Path) -> None:
    import polars as pl

    pl.DataFrame(dict(columns)).write_csv(file)


def _write_csv_gz(columns: Mapping[str, FloatArray], file: Path) -> None:
    import polars as pl

    with (
        file.open("wb") as packed,
        gzip.GzipFile(fileobj=packed, mode="wb", filename="", mtime=0, compresslevel=6) as unpacked,
    ):
        unpacked.write(pl.DataFrame(dict(columns)).write_csv().encode())


def _write_parquet(columns: Mapping[str, FloatArray], file: Path) -> None:
    import polars as pl

    pl.DataFrame(dict(columns)).write_parquet(file)


def _write_npz(columns: Mapping[str, FloatArray], file: Path) -> None:
    import zipfile

    with zipfile.ZipFile(file, "w") as archive:
        for name, values in columns.items():
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, values, allow_pickle=False)


_WRITERS = {".csv": _write_csv, ".csv.gz": _write_csv_gz, ".parquet": _write_parquet, ".npz": _write_npz}
ENDINGS = tuple(_WRITERS)
"""Endings of the files that `write_columns` writes."""
