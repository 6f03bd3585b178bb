"""Files that grow while they are read: what is new in them since the last look.

A reader is asked again and again, ``reader.new()``, and returns the columns of the rows that are complete since then,
None where there is none.  It neither waits nor blocks, except for a pipe, whose writer decides.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Protocol

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.mapping import MappedSignals
from diransac.data.readers.bags import BagRecording, McapFile
from diransac.data.readers.comma_separated import head_of, read_csv
from diransac.data.readers.recording import Samples
from diransac.data.readers.repair import Repairs
from diransac.data.readers.topics import entries_of, is_one_table, signals_of, wanted_by
from diransac.errors import LogError
from diransac.limits import check_ordinary

if TYPE_CHECKING:
    from diransac.data.readers.reading import Reading

__all__ = ["FileEnd", "Growing", "GrowingCsv", "GrowingMcap", "Pipe", "Part"]

Part = tuple[dict[str, FloatArray], dict[str, str]]
"""Columns of some rows, with the time ``t`` in seconds, and the units that are known."""

_BLOCK = 1 << 20
"""Bytes that are read at once: a tenth of a second of parsing."""
_MAGIC, _HEAD = 8, 9
"""Bytes before the first record of an MCAP file, and of the kind and length of a record."""
_LARGEST_RECORD = 1 << 29
_RECENT = 1000
"""Stamps of the fastest topic to which samples of others may belong: seconds, at any rate that is tracked."""


class Growing(Protocol):
    """A log that grows."""

    source: str
    """Name in messages."""

    @property
    def ended(self) -> bool:
        """True where nothing more will come."""

    def new(self) -> Part | None:
        """Rows that are complete since the last call; None without any.  Raises LogError: they cannot be read."""

    def taken_notes(self) -> list[str]:
        """Findings since the last call, a sentence each."""


# ---------------------------------------------------------------------- bytes


class Bytes(Protocol):
    """Where bytes come from."""

    ended: bool

    def new(self) -> tuple[bytes, str]:
        """Bytes since the last call, and why they are the beginning of another file; empty where they are not."""


class FileEnd:
    """The end of a file that another program writes, also where it is cut off or replaced.

    Parameters
    ----------
    path : Path
    source : str
        Name in messages.

    Raises
    ------
    LogError
        It cannot be read.
    """

    ended = False

    def __init__(self, path: Path, source: str) -> None:
        self._path, self._source = path, source
        try:
            check_ordinary(path)
            self._file = path.open("rb")
        except FileNotFoundError as error:
            raise LogError(f"{source}: there is no such file") from error
        except OSError as error:
            raise LogError(f"{source}: it cannot be read: {error.strerror}") from error

    def new(self) -> tuple[bytes, str]:
        """As `Bytes.new`, a block at most."""
        own = os.fstat(self._file.fileno())
        if own.st_size < self._file.tell():
            self._file.seek(0)
            return self._file.read(_BLOCK), "the file was cut off, and is read from its beginning"
        data = self._file.read(_BLOCK)
        if not data and self._is_replaced(own):
            self._file.close()
            self._file = self._path.open("rb")
            return self._file.read(_BLOCK), "the file was replaced, and the new one is read"
        return data, ""

    def _is_replaced(self, own: os.stat_result) -> bool:
        """True where another file has the name; while none has it, the old one is awaited."""
        try:
            there = self._path.stat()
        except FileNotFoundError:
            return False
        return (there.st_dev, there.st_ino) != (own.st_dev, own.st_ino)


class Pipe:
    """A stream of bytes, such as standard input; asking it waits until it has some.

    Parameters
    ----------
    stream : binary stream
        With a file descriptor.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        self._descriptor, self.ended = stream.fileno(), False

    def new(self) -> tuple[bytes, str]:
        """As `Bytes.new`."""
        data = os.read(self._descriptor, _BLOCK)
        self.ended = not data
        return data, ""


# ---------------------------------------------------------------------- CSV


class GrowingCsv:
    """CSV text that grows by lines; the last line counts when its line break is there.

    A line with another number of fields than the header, as after a break of power, is left out and said.  A field that
    is no number is a missing sample.

    Parameters
    ----------
    data : Bytes
    source : str
    reading : Reading
        Names, factors and mapping.
    like : sequence of dict
        History of a log of the same recorder, as in `read_log`.
    """

    def __init__(self, data: Bytes, source: str, reading: Reading, like: Sequence[Mapping[str, Any]] = ()) -> None:
        self.source, self._data, self._reading, self._like = source, data, reading, like
        self._rest, self._waiting, self._head = b"", list[str](), list[str]()
        self._has_head, self._notes = False, list[str]()

    @property
    def ended(self) -> bool:
        """As `Growing.ended`."""
        return self._data.ended

    def taken_notes(self) -> list[str]:
        """As `Growing.taken_notes`."""
        notes, self._notes = self._notes, []
        return notes

    def new(self) -> Part | None:
        """As `Growing.new`."""
        data, why = self._data.new()
        if why:
            self._notes.append(why)
            self._rest, self._waiting, self._has_head = b"", [], False
        *lines, self._rest = (self._rest + data).split(b"\n")
        self._waiting += [x.decode("utf-8-sig", errors="replace").rstrip("\r") for x in lines if x.strip()]
        if not self._has_head and not self._begin():
            return None
        rows = self._complete_rows()
        if not rows:
            return None
        names = self._reading.columns
        table = read_csv("\n".join([*self._head, *rows]).encode(), self.source, names, Repairs())
        return self._reading.part(table, self.source, self._like)

    def _begin(self) -> bool:
        """Take the lines above the first row, where it is there; False where it is not."""
        if self._reading.columns is not None:
            self._head, self._has_head = [], True
            return True
        n = head_of(self._waiting, self.source)
        if n is not None:
            self._head, self._waiting, self._has_head = self._waiting[:n], self._waiting[n:], True
        return self._has_head

    def _complete_rows(self) -> list[str]:
        """The waiting lines that are rows; others are left out, and said."""
        lines, self._waiting = self._waiting, []
        if not lines:
            return []
        separators = [lines[0].count(x) for x in ",;\t"] if not self._head else [self._head[-1].count(x) for x in ",;\t"]
        rows = [x for x in lines if [x.count(y) for y in ",;\t"][np.argmax(separators)] == max(separators)]
        if len(rows) < len(lines):
            left = len(lines) - len(rows)
            self._notes.append(f"{left} line{'s' * (left > 1)} without as many fields as the header left out")
        return rows


# ---------------------------------------------------------------------- MCAP


class _McapEnd(McapFile):
    """Messages that an MCAP file has gained."""

    def __init__(self, path: Path, source: str) -> None:
        super().__init__(path, source)
        self.offset, self.is_closed = _MAGIC, False

    def _records(self, wanted: Any) -> Iterator[Any]:
        """Records that are complete since the last call, chunks unpacked."""
        from mcap import records
        from mcap.stream_reader import StreamReader, breakup_chunk

        with self._path.open("rb") as file:
            file.seek(self.offset)
            data = file.read(_LARGEST_RECORD)
        n = _complete(data, self._source, self.offset)
        self.offset += n
        reader = StreamReader(BytesIO(data[:n]), skip_magic=True, emit_chunks=True, record_size_limit=_LARGEST_RECORD)
        for record in reader.records:
            if isinstance(record, (records.DataEnd, records.Footer)):
                self.is_closed = True
                return
            if isinstance(record, records.Chunk):
                yield from breakup_chunk(self.unpacked(record))
            else:
                yield record
