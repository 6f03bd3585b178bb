"""HDF5 files, and MATLAB's MAT files of version 7.3, which are HDF5."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from itertools import count
from typing import Any

import numpy as np
import numpy.typing as npt

from diransac.data.readers.table import Table, check_shapes, installed, table_of_arrays, undamaged
from diransac.errors import LogError
from diransac.limits import LARGEST_LOG, MOST_COLUMNS, beyond

MAGIC = b"\x89HDF\r\n\x1a\n"
_MOST_LINKS = 2 * MOST_COLUMNS
_MOST_CHUNKS = 200_000
"""HDF5 takes 4 kB and 10 microseconds for each, also for those that are missing."""


def read_hdf5(data: bytes, source: str, *, transposed: bool = False) -> Table:
    """Table of the datasets in a file; a dataset ``q`` of a group ``arm`` is ``arm.q``.

    Parameters
    ----------
    data : bytes
    source : str
    transposed : bool
        True for MATLAB's files, whose matrices stand with their columns first.

    Raises LogError: h5py is missing; the file is damaged, larger than a log may be, or refers to other files.
    """
    with installed(f"{source}: HDF5 needs the package h5py"):
        import h5py
    arrays: dict[str, npt.NDArray[Any]] = {}
    with undamaged(f"{source}: it is not an HDF5 file, or is damaged"), h5py.File(io.BytesIO(data), "r") as file:
        found = dict(_datasets(file, "", (), source, count(1)))
        check_shapes([dataset.shape[::-1] if transposed else dataset.shape for dataset in found.values()], source)
        n_chunks = sum(_n_chunks(dataset) for dataset in found.values())
        if n_chunks > _MOST_CHUNKS:
            raise LogError(f"{source}: it has {beyond(_MOST_CHUNKS, 'chunks', n_chunks)}; write it in larger ones")
        for name, dataset in found.items():
            _check_storage(dataset, f'{source}: dataset "{name}"')
            values = np.asarray(dataset[()])
            arrays[name] = values.T if transposed else values
    return table_of_arrays(arrays, source)


def _datasets(
    group: Any, prefix: str, above: tuple[Any, ...], source: str, n_links: count[int]
) -> Iterator[tuple[str, Any]]:
    """Numeric datasets below a group, by dotted names; what MATLAB keeps for itself, ``#refs#``, is left out.

    Raises LogError: the paths to them have too many links, of which a few may make endless paths.
    """
    import h5py

    if group in above or len(above) >= 16:
        return
    for name in group:
        if next(n_links) > _MOST_LINKS:
            raise LogError(f"{source}: it has {beyond(_MOST_LINKS, 'links')}; write its datasets alone")
        if name.startswith("#") or not isinstance(group.get(name, getlink=True), h5py.HardLink):
            continue
        item = group[name]
        if isinstance(item, h5py.Group):
            yield from _datasets(item, f"{prefix}{name}.", (*above, group), source, n_links)
        elif isinstance(item, h5py.Dataset) and item.dtype.kind in "biuf" and item.shape is not None:
            yield f"{prefix}{name}", item


def _n_chunks(dataset: Any) -> int:
    """Number of parts in which a dataset is declared to be stored."""
    if dataset.chunks is None:
        return 1
    return math.prod(-(-length // size) for length, size in zip(dataset.shape, dataset.chunks, strict=True))


def _check_storage(dataset: Any, what: str) -> None:
    """Raise LogError for values that stand in other datasets or files, or in chunks of any size."""
    if dataset.is_virtual or dataset.external:
        raise LogError(f"{what} takes its values from other datasets or files; write the values themselves")
    size = math.prod(dataset.chunks or ()) * dataset.dtype.itemsize
    if size > LARGEST_LOG:
        raise LogError(f"{what} is stored in chunks of {beyond(LARGEST_LOG, 'bytes', size)}; write it anew")
