"""MATLAB's MAT files; those of version 7.3 are HDF5."""

from __future__ import annotations

import io
import struct
import zlib
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from diransac.data.readers import hdf5
from diransac.data.readers.table import Table, check_unique, table_of_arrays
from diransac.errors import LogError

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["read_mat"]

_DEEPEST = 8
_DAMAGED = (
    *(ValueError, TypeError, KeyError, IndexError, AttributeError, NotImplementedError, OverflowError, MemoryError),
    *(OSError, EOFError, struct.error, zlib.error),
)


def read_mat(data: bytes, source: str) -> Table:
    """Table of the arrays in a MAT file; a field ``q`` of a structure ``arm`` is ``arm.q``.

    Raises LogError: the data are no MAT file, or are damaged; h5py is missing for those of version 7.3.
    """
    from scipy.io import loadmat, whosmat
    from scipy.io.matlab import MatReadError

    if data.startswith(b"MATLAB 7.3") or hdf5.MAGIC in data[:1024]:
        return hdf5.read_hdf5(data, source, transposed=True)
    try:
        check_unique([name for name, *_ in whosmat(io.BytesIO(data))], source)
        arrays = loadmat(io.BytesIO(data))
    except (*_DAMAGED, MatReadError) as error:
        raise LogError(f"{source}: it is not a MAT file, or is damaged ({type(error).__name__}: {error})") from error
    named = [(name, x) for name, x in arrays.items() if not name.startswith("__")]
    return table_of_arrays(dict(piece for name, x in named for piece in _flat(name, x, 0)), source)


def _flat(name: str, value: npt.NDArray[Any], depth: int) -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """Arrays of a structure by dotted names; an array itself."""
    if value.dtype.names is None or value.size != 1 or depth > _DEEPEST:
        yield name, value
        return
    for inner in value.dtype.names:
        held = value.flat[0][inner]
        yield from _flat(f"{name}.{inner}", np.asarray(held), depth + 1)
