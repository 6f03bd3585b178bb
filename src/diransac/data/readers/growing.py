"""Files that grow while they are read: what is new in them since the last look.

A reader is asked again and again, ``reader.new()``, and returns the columns of the rows that are complete since then,
None where there is none.  It neither waits nor blocks, except for a pipe, whose writer decides.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.mapping import MappedSignals
from diransac.data.readers.bags import LARGEST_CHUNK, MAGIC, BagRecording, McapFile, damages, unpacked
from diransac.data.readers.comma_separated import fields_of, head_of, read_csv
from diransac.data.readers.recording import Samples, nearest
from diransac.data.readers.repair import Repairs
from diransac.data.readers.table import Table, readable, undamaged
from diransac.data.readers.topics import entries_of, is_one_table, signals_of, wanted_by
from diransac.errors import LogError
from diransac.limits import check_ordinary
from diransac.plain_text import one_line

if TYPE_CHECKING:
    from diransac.data.readers.reading import Reading

Part = tuple[dict[str, FloatArray], dict[str, str]]
"""Columns of some rows, with the time ``t`` in seconds, and the units that are known."""

_TEXTS = (".csv", ".tsv", ".txt")
_BLOCK = 1 << 20
"""Bytes that are read at once: a tenth of a second of parsing."""


class Growing:
    """A log that grows.

    Parameters
    ----------
    source : str
        Name in messages.
    """

    def __init__(self, source: str) -> None:
        self.source, self._notes = source, list[str]()

    @property
    def ended(self) -> bool:
        """True where nothing more will come."""
        raise NotImplementedError

    def new(self) -> Part | None:
        """Rows that are complete since the last call; None without any.  Raises LogError: they cannot be read."""
        raise NotImplementedError

    def taken_notes(self) -> list[str]:
        """Findings since the last call, a sentence each."""
        notes, self._notes = self._notes, []
        return notes

    def close(self) -> None:
        """Close what is open."""


def growing(path: Path, reading: Reading, like: Sequence[Mapping[str, Any]] = ()) -> Growing:
    """Reader of a file that grows, by its ending.

    Parameters
    ----------
    path : Path
    reading : Reading
        Names, factors and mapping.
    like : sequence of dict
        History of a log of the same recorder, as in `read_log`.

    Raises
    ------
    LogError
        The file cannot be read, or its format is not written row by row.
    """
    source, ending = one_line(f'log "{path}"'), path.suffix.lower()
    if ending in _TEXTS:
        return GrowingCsv(FileEnd(path, source), source, reading, like)
    if ending == ".mcap":
        return GrowingMcap(path, source, reading, like)
    raise LogError(
        f'{source}: a file that ends in "{ending}" is not read while it grows; {", ".join(_TEXTS)} and .mcap are'
    )


# ---------------------------------------------------------------------- bytes


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
        self._path = path
        with readable(source):
            check_ordinary(path)
            self._file = path.open("rb")

    def new(self) -> tuple[bytes, str]:
        """Bytes since the last call, a block at most, and why they are the beginning of another file; else empty."""
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

    def close(self) -> None:
        """Close the file."""
        self._file.close()

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
    stream : buffered binary stream
        Whose ``read1`` returns what is there.
    """

    def __init__(self, stream: Any) -> None:
        self._stream, self.ended = stream, False

    def new(self) -> tuple[bytes, str]:
        """As `FileEnd.new`."""
        data: bytes = self._stream.read1(_BLOCK)
        self.ended = not data
        return data, ""

    def close(self) -> None:
        """Do nothing: the stream belongs to the process."""


# ---------------------------------------------------------------------- CSV


class GrowingCsv(Growing):
    """CSV text that grows by lines; the last line counts when its line break is there.

    A line with another number of fields than the header, as after a break of power, is left out and said.  A field that
    is no number is a missing sample where the first row has a number.

    Parameters
    ----------
    data : FileEnd or Pipe
    source : str
    reading : Reading
        Names, factors and mapping.
    like : sequence of dict
        History of a log of the same recorder, as in `read_log`.
    """

    def __init__(
        self, data: FileEnd | Pipe, source: str, reading: Reading, like: Sequence[Mapping[str, Any]] = ()
    ) -> None:
        super().__init__(source)
        self._data, self._reading, self._like = data, reading, like
        self._rest, self._waiting, self._head = b"", list[str](), list[str]()
        self._has_head, self._numeric, self._ready = False, set[str](), list[Table]()

    @property
    def ended(self) -> bool:
        """As `Growing.ended`."""
        return self._data.ended and not self._ready

    def close(self) -> None:
        """As `Growing.close`."""
        self._data.close()

    def new(self) -> Part | None:
        """As `Growing.new`."""
        if not self._ready:
            rows = self._rows()
            self._ready = self._tables(rows) if rows else []
        return self._reading.part(self._ready.pop(0), self.source, self._like) if self._ready else None

    def _rows(self) -> list[str]:
        """Lines that are complete and hold a row."""
        data, why = self._data.new()
        if why:
            self._notes.append(why)
            self._rest, self._waiting, self._has_head = b"", [], False
        *lines, self._rest = (self._rest + data).split(b"\n")
        self._waiting += [x.decode("utf-8-sig", errors="replace").rstrip("\r") for x in lines if x.strip()]
        return self._complete_rows() if self._has_head or self._begin() else []

    def _tables(self, rows: list[str]) -> list[Table]:
        """Tables of some rows, one after the other; halves of them where a field is no number."""
        text = "\n".join([*self._head, *rows]).encode()
        table = read_csv(text, self.source, self._reading.columns, Repairs())
        bad = [name for name in self._numeric if isinstance(table.columns.get(name), str)]
        if not bad:
            return [table]
        if len(rows) == 1:
            return [replace(table, columns={**table.columns, **dict.fromkeys(bad, np.array([np.nan]))})]
        half = len(rows) // 2
        return [*self._tables(rows[:half]), *self._tables(rows[half:])]

    def _begin(self) -> bool:
        """Take the lines above the first row, where it is there; False where it is not."""
        n = head_of(self._waiting) if self._reading.columns is None else 0
        if n is None or n == len(self._waiting):
            return False
        self._head, self._waiting, self._has_head = self._waiting[:n], self._waiting[n:], True
        (first,) = self._tables(self._waiting[:1])
        self._numeric = set(first.numbers)
        return True

    def _complete_rows(self) -> list[str]:
        """The waiting lines that are rows; others are left out, and said."""
        lines, self._waiting = self._waiting, []
        names = self._reading.columns
        expected = len(fields_of(self._head[-1])) if names is None else len(names)
        rows = [x for x in lines if len(fields_of(x)) == expected]
        if len(rows) < len(lines):
            left = len(lines) - len(rows)
            self._notes.append(f"{left} line{'s' * (left > 1)} without {expected} fields left out")
        return rows


# ---------------------------------------------------------------------- MCAP


class _McapEnd(McapFile):
    """Messages that an MCAP file has gained since the last call of `messages`."""

    def __init__(self, path: Path, source: str) -> None:
        super().__init__(path, source)
        self.offset = len(MAGIC)

    def is_read(self) -> bool:
        """True where its writer has closed the file, and all of it was read."""
        with self._path.open("rb") as file:
            file.seek(self.offset)
            return file.read() == MAGIC

    def _records(self, wanted: Any) -> Iterator[Any]:
        """Records that are complete, those of chunks unpacked."""
        from mcap.records import Chunk
        from mcap.stream_reader import StreamReader, breakup_chunk

        with self._path.open("rb") as file:
            file.seek(self.offset)
            data = file.read(LARGEST_CHUNK)
        n = _complete(data)
        self.offset += n
        stream = BytesIO(data[:n])
        found = StreamReader(stream, skip_magic=True, emit_chunks=True, record_size_limit=LARGEST_CHUNK).records
        with undamaged(f"{self._source}: it is damaged before byte {self.offset}", damages()):
            while stream.tell() < n:
                record = next(found)
                if isinstance(record, Chunk):
                    yield from breakup_chunk(unpacked(record))
                else:
                    yield record


def _complete(data: bytes) -> int:
    """Number of the bytes of complete records."""
    n, head = 0, 9  # of a record: its kind and length
    while n + head <= len(data):
        end = n + head + int(struct.unpack_from("<Q", data, n + 1)[0])
        if end > len(data):
            break
        n = end
    return n


class _Topics(BagRecording):
    """Topics of a file that grows, whose times have one origin."""

    _zero: int | None = None

    def _origin_of(self, columns: Any) -> int:
        """The origin of the first messages that were read."""
        if self._zero is None:
            self._zero = super()._origin_of(columns)
        return self._zero


class GrowingMcap(Growing):
    """Recording in MCAP that grows by messages, or by chunks as its writer closes them.

    The rows are those of the topic that is fastest at the beginning.  A sample of another topic stands at the time of
    the nearest of these, so that a tracker, which fills rows, has them together.

    Parameters
    ----------
    path : Path
    source : str
    reading : Reading
        Mapping and names.
    like : sequence of dict
        History of a log of the same recorder, as in `read_log`.

    Raises
    ------
    LogError
        The packages that read it are missing.
    """

    def __init__(self, path: Path, source: str, reading: Reading, like: Sequence[Mapping[str, Any]] = ()) -> None:
        super().__init__(source)
        self._path = path
        self._mapping, self._rename = reading.topics(like)
        self._file = _McapEnd(path, source)
        self._recording: _Topics | None = None
        self._entries: list[MappedSignals] = []
        self._waits: LogError | None = None
        self._fastest, self._stamps = "", np.empty(0)
        self._ahead: dict[str, Samples] = {}

    @property
    def ended(self) -> bool:
        """As `Growing.ended`.  Raises LogError: what is wanted of it never came."""
        is_read = self._file.is_read()
        if is_read and self._waits is not None:
            raise self._waits
        return is_read

    def new(self) -> Part | None:
        """As `Growing.new`."""
        if self._is_cut_off():
            self._notes.append("the file was cut off or replaced, and is read from its beginning")
            self._recording, self._fastest, self._stamps, self._ahead = None, "", np.empty(0), {}
        if self._recording is None and not self._begin():
            return None
        assert self._recording is not None
        read = self._recording.read(wanted_by(self._entries), "header" if self._mapping is None else self._mapping.time)
        parts = {n: signals_of(n, x, self._entries, Repairs(), self.source) for n, x in read.items()}
        self._fastest = self._fastest or max(parts, key=lambda name: len(parts[name].time))
        units = {name: unit for entry in self._entries for name, unit in entry.known_units().items()}
        columns = self._rows(parts)
        return None if columns is None else (columns, units)

    def _is_cut_off(self) -> bool:
        """True where the file is shorter than what was read of it.  Raises LogError: it cannot be read."""
        with readable(self.source):
            return check_ordinary(self._path).st_size < self._file.offset and self._recording is not None

    def _begin(self) -> bool:
        """Find the signals among the topics; False while they are not there."""
        file = _McapEnd(self._path, self.source)
        try:
            recording = _Topics(self.source, file)
            self._entries, notes = self._wanted(recording)
        except LogError as error:
            self._waits, self._file = error, file
            return False
        file.offset = len(MAGIC)
        self._file, self._recording, self._waits = file, recording, None
        self._notes += notes
        return True

    def _wanted(self, recording: _Topics) -> tuple[list[MappedSignals], list[str]]:
        """Signals that are taken from the topics, and notes."""
        if self._mapping is not None or not is_one_table(recording, self._rename):
            return entries_of(recording, self._mapping, self._rename)
        ((topic, fields),) = recording.fields.items()
        new = {old: name for name, old in self._rename.items()}
        return [MappedSignals((new.get(x, x),), (x,), topic) for x in fields], []

    def _rows(self, parts: Mapping[str, Samples]) -> dict[str, FloatArray] | None:
        """Rows of all topics, one after the other, on the stamps of the fastest; samples ahead of these wait."""
        parts = {name: _joined(self._ahead.pop(name), x) if name in self._ahead else x for name, x in parts.items()}
        # Samples of other topics may belong to the last thousand: seconds, at any rate that is tracked.
        self._stamps = np.concatenate([self._stamps, parts[self._fastest].time])[-1000:]
        if len(self._stamps) < 2:
            self._ahead = dict(parts)
            self._stamps = np.empty(0)
            return None
        apart = float(np.median(np.diff(self._stamps)))
        found = []
        for name, samples in parts.items():
            is_ahead = samples.time > self._stamps[-1] + 0.5 * apart
            if is_ahead.any():
                self._ahead[name] = samples.select(is_ahead)
            found.append(self._placed(samples.select(~is_ahead), apart))
        n, names = sum(len(x.time) for x in found), dict.fromkeys(name for x in found for name in x.columns)
        if not n:
            return None
        columns = {name: [x.columns.get(name, np.full(len(x.time), np.nan)) for x in found] for name in names}
        time = np.concatenate([x.time for x in found])
        order = np.argsort(time, kind="stable")
        return {"t": time[order], **{name: np.concatenate(x)[order] for name, x in columns.items()}}

    def _placed(self, samples: Samples, apart: float) -> Samples:
        """Samples at the nearest stamp of the fastest topic, where one is near."""
        stamps = self._stamps[nearest(self._stamps, samples.time)]
        near = np.abs(stamps - samples.time) <= 0.5 * apart
        return Samples(np.where(near, stamps, samples.time), samples.columns)


def _joined(before: Samples, samples: Samples) -> Samples:
    """Samples after others of the same topic."""
    if not len(samples.time):
        return before
    names = samples.columns
    columns = {name: np.concatenate([before.columns[name], samples.columns[name]]) for name in names}
    return Samples(np.concatenate([before.time, samples.time]), columns)
