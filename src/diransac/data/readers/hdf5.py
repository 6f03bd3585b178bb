"""HDF5 files, and MATLAB's MAT files of version 7.3, which are HDF5."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from diransac.data.readers.table import LARGEST, Table, table_of_arrays
from diransac.errors import LogError

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["MAGIC", "read_hdf5"]

MAGIC = b"\x89HDF\r\n\x1a\n"
_MOST = 10_000
_DAMAGED = (OSError, ValueError, TypeError, KeyError, RuntimeError, MemoryError, OverflowError, AttributeError)


def read_hdf5(data: bytes, source: str, *, transposed: bool = False) -> Table:
    """Table of the datasets in a file; a dataset ``q`` of a group ``arm`` is ``arm.q``.

    Parameters
    ----------
    data : bytes
    source : str
    transposed : bool
        True for MATLAB's files, whose matrices stand with their columns first.

    Raises LogError: h5py is missing; the file is damaged, or its arrays are larger than 2 GiB together.
    """
    try:
        import h5py
    except ImportError as error:
        raise LogError(
            f'{source}: HDF5 needs the package h5py; install it with pip install "diransac[logs]"'
        ) from error
    arrays: dict[str, npt.NDArray[Any]] = {}
    total = 0
    try:
        with h5py.File(io.BytesIO(data), "r") as file:
            for name, dataset in _datasets(file, ""):
                total += dataset.size * dataset.dtype.itemsize
                if total > LARGEST or len(arrays) >= _MOST:
                    raise LogError(f"{source}: its arrays are larger than 2 GiB together, or too many")
                values = np.asarray(dataset[()])
                arrays[name] = values.T if transposed else values
    except _DAMAGED as error:
        why = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise LogError(f"{source}: it is not an HDF5 file, or is damaged ({why:.120})") from error
    return table_of_arrays(arrays, source)


def _datasets(group: Any, prefix: str, depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Numeric datasets below a group, by dotted names; what MATLAB keeps for itself, ``#refs#``, is left out."""
    import h5py

    for name in group if depth < 16 else ():
        if name.startswith("#") or not isinstance(group.get(name, getlink=True), h5py.HardLink):
            continue
        item = group[name]
        if isinstance(item, h5py.Group):
            yield from _datasets(item, f"{prefix}{name}.", depth + 1)
        elif isinstance(item, h5py.Dataset) and item.dtype.kind in "biuf" and item.shape is not None:
            yield f"{prefix}{name}", item
