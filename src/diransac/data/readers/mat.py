"""MATLAB's MAT files up to version 7."""

from __future__ import annotations

import io
import struct
import zlib

from diransac.data.readers.table import Table, check_unique, table_of_arrays
from diransac.errors import LogError

__all__ = ["read_mat"]

_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_DAMAGED = (
    *(ValueError, TypeError, KeyError, IndexError, AttributeError, NotImplementedError, OverflowError, MemoryError),
    *(OSError, EOFError, struct.error, zlib.error),
)


def read_mat(data: bytes, source: str) -> Table:
    """Table of the arrays in a MAT file.

    Raises LogError: the data are of version 7.3 (HDF5), are no MAT file, or are damaged.
    """
    from scipy.io import loadmat, whosmat
    from scipy.io.matlab import MatReadError

    if data.startswith(b"MATLAB 7.3") or _HDF5_MAGIC in data[:1024]:
        raise LogError(f"{source}: MAT files of version 7.3 (HDF5) are not read; save it in MATLAB with -v7")
    try:
        check_unique([name for name, *_ in whosmat(io.BytesIO(data))], source)
        arrays = loadmat(io.BytesIO(data))
    except (*_DAMAGED, MatReadError) as error:
        raise LogError(f"{source}: it is not a MAT file, or is damaged ({type(error).__name__}: {error})") from error
    return table_of_arrays({name: x for name, x in arrays.items() if not name.startswith("__")}, source)
