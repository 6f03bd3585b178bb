"""MATLAB's MAT files of versions 4 to 7.3.

Those of version 5 (saved with ``-v6`` or ``-v7``) are read here: SciPy's reader ends the process on some damaged ones.
Those of version 7.3 are HDF5.

References: MathWorks, MAT-File Format, "Level 5 MAT-File Format".
"""

from __future__ import annotations

import io
import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from diransac.data.readers import hdf5
from diransac.data.readers.table import Table, check_unique, table_of_arrays, undamaged
from diransac.limits import LARGEST_LOG, MOST_COLUMNS, beyond

_MATRIX, _COMPRESSED = 14, 15
_CODES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CLASSES = {1: "a cell", 3: "an object", 4: "a text", 5: "a sparse matrix", 16: "a function", 17: "an object"}


def read_mat(data: bytes, source: str) -> Table:
    """Table of the arrays in a MAT file; a field ``q`` of a structure ``arm`` is ``arm.q``.

    Raises LogError: the data are no MAT file, or are damaged; h5py is missing for those of version 7.3.
    """
    if data.startswith(b"MATLAB 7.3") or hdf5.MAGIC in data[:1024]:
        return hdf5.read_hdf5(data, source, transposed=True)
    with undamaged(f"{source}: it is not a MAT file, or is damaged"):
        named = list(_level_5(data)) if data[126:128] in (b"IM", b"MI") else _level_4(data)
    check_unique([name for name, _ in named], source)
    return table_of_arrays(dict(named), source)


def _level_4(data: bytes) -> list[tuple[str, npt.NDArray[Any]]]:
    """Arrays of a file of version 4 by name.  Raises ValueError and the like: it is none, or damaged."""
    from scipy.io import loadmat, whosmat
    from scipy.io.matlab import MatReadError

    try:
        if sum(math.prod(shape) for _, shape, _ in whosmat(io.BytesIO(data))) > len(data):
            raise ValueError("its arrays would be larger than the file")
        arrays = loadmat(io.BytesIO(data))
    except MatReadError as error:
        raise ValueError(str(error)) from error
    return [(name, np.asarray(x)) for name, x in arrays.items() if not name.startswith("__")]


# ---------------------------------------------------------------------- version 5


@dataclass
class _Elements:
    """Data elements in a part of a file, one after the other."""

    data: memoryview
    order: str
    at: int = 0

    def __bool__(self) -> bool:
        return self.at + 8 <= len(self.data)

    def take(self) -> tuple[int, memoryview]:
        """Type and content of the next element.  Raises ValueError: it is longer than what is left."""
        first, size = struct.unpack_from(f"{self.order}II", self.data, self.at)
        if first >> 16:  # a small element has its content in the tag
            kind, size, start, after = first & 0xFFFF, first >> 16, self.at + 4, self.at + 8
        else:
            kind, start = first, self.at + 8
            after = start + size + (0 if kind == _COMPRESSED else -size % 8)
        if start + size > len(self.data):
            raise ValueError("it is cut off")
        self.at = after
        return kind, self.data[start : start + size]

    def numbers(self) -> npt.NDArray[Any]:
        """Numbers of the next element."""
        kind, content = self.take()
        return np.frombuffer(content, dtype=f"{self.order}{_CODES[kind]}")


def _level_5(data: bytes) -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """Arrays of a file of version 5, those of structures by dotted names."""
    order = "<" if data[126:128] == b"IM" else ">"
    elements = _Elements(memoryview(data)[128:], order)
    budget = LARGEST_LOG
    while elements:
        kind, content = elements.take()
        if kind == _COMPRESSED:
            unpacker = zlib.decompressobj()
            unpacked = unpacker.decompress(content, budget)
            if not unpacker.eof:
                raise ValueError(f"a variable is cut off, or the arrays have {beyond(LARGEST_LOG, 'bytes')}")
            budget -= len(unpacked)
            kind, content = _Elements(memoryview(unpacked), order).take()
        if kind == _MATRIX:
            yield from _arrays(content, order, "", 0)


def _arrays(content: memoryview, order: str, name: str, depth: int) -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """Arrays of a matrix under a name, or under its own; what holds no numbers is a text that says what it is."""
    if not content:
        yield name, np.zeros(0)
        return
    elements = _Elements(content, order)
    flags = int(elements.numbers()[0])
    kind, is_complex = flags & 0xFF, bool(flags & 0x0800)
    if kind == 17:  # MATLAB's own objects, without dimensions
        yield name or "object", np.array(_CLASSES[kind])
        return
    shape = tuple(int(n) for n in elements.numbers())
    own = elements.take()[1].tobytes().decode(errors="replace")
    name = name or own
    if kind in range(6, 16) and not is_complex:
        values = elements.numbers()
        if min(shape, default=-1) < 0 or math.prod(shape) != len(values):
            raise ValueError(f'"{name}" has {len(values)} numbers for the size {shape}')
        yield name, values.reshape(shape, order="F")
    elif kind == 2 and math.prod(shape) == 1 and depth < 8:  # a structure
        yield from _fields(elements, order, name, depth)
    else:
        yield name, np.array(_CLASSES.get(kind, "an array of structures or of complex numbers"))


def _fields(elements: _Elements, order: str, name: str, depth: int) -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """Arrays of the fields of a structure."""
    width = int(elements.numbers()[0])
    text = elements.take()[1].tobytes()
    if width < 1 or len(text) // width > MOST_COLUMNS:
        raise ValueError(f'the fields of "{name}" cannot be read')
    for start in range(0, len(text), width):
        kind, inner = elements.take()
        if kind != _MATRIX:
            raise ValueError(f'a field of "{name}" is no array')
        label = text[start : start + width].split(b"\0")[0].decode(errors="replace")
        yield from _arrays(inner, order, f"{name}.{label}", depth + 1)
