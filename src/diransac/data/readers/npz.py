"""NPZ: NumPy arrays by name.  Pickled objects are never loaded."""

from __future__ import annotations

import io
import math
import zipfile
from typing import IO, Any

import numpy as np

from diransac.data.files import MEMBER
from diransac.data.readers.table import (
    Table,
    check_shapes,
    check_size,
    check_unique,
    table_of_arrays,
    undamaged,
    with_metadata,
)
from diransac.errors import LogError
from diransac.limits import LARGEST_LOG, beyond


def read_npz(data: bytes, source: str) -> Table:
    """Table of an NPZ file.

    Raises LogError: the data are no NPZ file, are cut off, hold pickled objects, or are larger than a log may be.
    """
    with undamaged(f"{source}: it is not an NPZ file, or is cut off"):
        archive = zipfile.ZipFile(io.BytesIO(data))
    names = archive.namelist()
    check_unique(names, source)
    check_size(source, 0, len(names))
    size = sum(entry.file_size for entry in archive.infolist())
    if size > LARGEST_LOG:
        raise LogError(f"{source}: its arrays have {beyond(LARGEST_LOG, 'bytes', size)}; split it")
    arrays: dict[str, Any] = {}
    shapes: list[tuple[int, ...]] = []
    metadata = None
    for entry in names:
        name = entry.removesuffix(".npy")
        with undamaged(f'{source}: array "{name}" cannot be read'), archive.open(entry) as file:
            if entry == MEMBER:
                metadata = file.read()
                continue
            shapes.append(_shape(file))
            check_shapes(shapes, source)
            file.seek(0)
            arrays[name] = np.lib.format.read_array(file, allow_pickle=False)
    table = table_of_arrays(arrays, source)
    return table if metadata is None else with_metadata(table, metadata, source)


def _shape(file: IO[bytes]) -> tuple[int, ...]:
    """Shape in the header of an array.  Raises ValueError and the like: it is none, or one item is enormous."""
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, kind = read(file)
    if kind.itemsize * math.prod(shape) > LARGEST_LOG:
        raise ValueError(f"it has {beyond(LARGEST_LOG, 'bytes', kind.itemsize * math.prod(shape))}")
    return shape
