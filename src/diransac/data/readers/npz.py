"""NPZ: NumPy arrays by name.  Pickled objects are never loaded."""

from __future__ import annotations

import io
import zipfile
import zlib
from typing import Any

import numpy as np

from diransac.data.files import MEMBER
from diransac.data.readers.table import LARGEST, Table, check_unique, table_of_arrays, with_metadata
from diransac.errors import LogError

__all__ = ["read_npz"]

_DAMAGED = (ValueError, EOFError, OSError, KeyError, NotImplementedError, RuntimeError, MemoryError, zlib.error)


def read_npz(data: bytes, source: str) -> Table:
    """Table of an NPZ file.

    Raises LogError: the data are no NPZ file, are cut off, or hold pickled objects.
    """
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
    except (zipfile.BadZipFile, NotImplementedError) as error:
        raise LogError(f"{source}: it is not an NPZ file, or is cut off ({error})") from error
    check_unique(archive.namelist(), source)
    if sum(entry.file_size for entry in archive.infolist()) > LARGEST:
        raise LogError(f"{source}: its arrays are larger than 2 GiB together; split it")
    arrays: dict[str, Any] = {}
    metadata = None
    for entry in archive.namelist():
        name = entry.removesuffix(".npy")
        try:
            with archive.open(entry) as file:
                if entry == MEMBER:
                    metadata = file.read()
                    continue
                arrays[name] = np.lib.format.read_array(file, allow_pickle=False)
        except (*_DAMAGED, zipfile.BadZipFile) as error:
            raise LogError(f'{source}: array "{name}" cannot be read ({error})') from error
    table = table_of_arrays(arrays, source)
    return table if metadata is None else with_metadata(table, metadata, source)
