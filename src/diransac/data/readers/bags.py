"""MCAP files, and bags of ROS 2 and ROS 1: topics of messages whose definitions are in the file.

A file is read from its start to its end, one chunk at a time, and only the fields that are asked for are kept.  Nested
fields have dotted names, ``pose.pose.position.x``; elements have an index, ``position[2]``, or, in a message with an
array ``name``, the name of a joint: ``position[elbow]``.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import re
import sys
from array import array
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from diransac.data.readers.recording import Recording, Samples, Stamps, seconds_since
from diransac.data.readers.table import DAMAGE, installed, undamaged
from diransac.errors import LogError

LARGEST_CHUNK, MAGIC = 1 << 29, b"\x89MCAP0\r\n"
"""Bytes of a chunk at most; what stands at the start and at the end of an MCAP file."""
_MOST_FIELDS, _MOST_ELEMENTS = 2000, 64
_LATEST = 1 << 62
_NUMBERS = (bool, int, float, np.number, np.bool_)


class Raw(NamedTuple):
    """One message as it was recorded; ``decode()`` returns it as an object or mapping."""

    topic: str
    time: int
    decode: Callable[[], Any]


class BagRecording(Recording):
    """Topics of a file of messages.

    Parameters
    ----------
    source : str
        Name in messages.
    file : McapFile or RosBag
        Yields the messages of some topics, or of all for None; its ``notes`` say where it ended early.
    """

    def __init__(self, source: str, file: McapFile | RosBag) -> None:
        super().__init__(source)
        self._file, self.found = file, file.notes
        self._fields: dict[str, tuple[str, ...]] = {}
        self._origin: int | None = None
        for raw in file.messages(None):
            self._origin = raw.time if self._origin is None else min(raw.time, self._origin)
            if raw.topic not in self._fields:
                message = _decoded(raw, source)
                self._fields[raw.topic] = _field_names(message, _NUMBERS)
                if texts := _field_names(message, (str,)):
                    self.texts[raw.topic] = texts
                names = _member(message, "name")
                if isinstance(names, (list, np.ndarray)):
                    self.elements[raw.topic] = tuple(str(name) for name in names[:_MOST_ELEMENTS])
            if file.topics is not None and len(self._fields) == len(file.topics):
                break
        if self._origin is None:
            raise LogError(f"{source}: it holds no message{''.join(f'; {note}' for note in file.notes)}")

    @property
    def fields(self) -> dict[str, tuple[str, ...]]:
        """Numeric fields of the first message of each topic."""
        return self._fields

    def read(self, wanted: Mapping[str, Sequence[str]], stamps: Stamps) -> dict[str, Samples]:
        """Samples of some fields.

        Raises LogError: there is no such topic or field; the times in the messages have another origin than those of
        topics without any.
        """
        columns = {topic: _Columns.of(fields) for topic, fields in wanted.items()}
        for topic in wanted:
            self.check(topic)
        for raw in self._file.messages(set(wanted)):
            into = columns[raw.topic]
            message = _decoded(raw, self.source) if into.values or stamps == "header" else None
            into.add(raw.time, message, stamps)
        origin = self._origin_of(columns)
        return {topic: self._samples(topic, found, origin) for topic, found in columns.items()}

    def _origin_of(self, columns: Mapping[str, _Columns]) -> int:
        """Origin of the times, ns: the recorder's first, or the messages' own where theirs is another clock.

        Raises LogError: some topics have times of another clock, and others have not.
        """
        origin = self._origin or 0
        hour = 3600 * 10**9  # later than any message is recorded
        far = {n: x for n, x in columns.items() if x.is_stamped and abs(x.stamps[0] - x.times[0]) > hour}
        near = [name for name, x in columns.items() if name not in far and x.times]
        if far and near:
            topic, found = next(iter(far.items()))
            late = abs(found.stamps[0] - found.times[0]) / 1e9
            raise LogError(
                f'{self.source}: messages of "{topic}" have times of another clock ({late:.3g} s from the recorder\'s) '
                f'and those of "{near[0]}" have not; take the recorder\'s: time = "message"'
            )
        return min((min(x.stamps) for x in far.values()), default=origin)

    def _samples(self, topic: str, found: _Columns, origin: int) -> Samples:
        for label, values in found.values.items():
            if label in found.missing and label not in found.texts and np.isnan(np.frombuffer(values)).all():
                raise self.lacking(topic, label)
        times = np.frombuffer(found.stamps if found.is_stamped else found.times, dtype=np.int64)
        columns = {label: np.frombuffer(x, dtype=np.float64) for label, x in found.values.items()}
        texts = {label: np.array(x, dtype=np.object_) for label, x in found.texts.items()}
        return Samples(seconds_since(origin, times), columns, dict.fromkeys(texts, "is not numeric"), texts)


@dataclass
class _Columns:
    """Growing columns of one topic."""

    paths: Mapping[str, list[str | int]]
    values: Mapping[str, array[float]]
    times: array[int] = field(default_factory=lambda: array("q"))
    stamps: array[int] = field(default_factory=lambda: array("q"))
    missing: set[str] = field(default_factory=set)
    texts: dict[str, list[str]] = field(default_factory=dict)

    @classmethod
    def of(cls, fields: Sequence[str]) -> _Columns:
        return cls({label: _steps(label) for label in fields}, {label: array("d") for label in fields})

    @property
    def is_stamped(self) -> bool:
        """True where every message has a time of its own."""
        return len(self.times) == len(self.stamps) > 0

    def add(self, time: int, message: Any, stamps: Stamps) -> None:
        """Append a message."""
        self.times.append(min(time, _LATEST))
        if stamps == "header":
            stamp = _stamp(message)
            if stamp:
                self.stamps.append(stamp)
        for label, steps in self.paths.items():
            value = _follow(message, steps)
            number = np.nan
            if value is None:
                self.missing.add(label)
            elif isinstance(value, _NUMBERS):
                number = float(value)
            else:
                self.missing.add(label)
                self.texts.setdefault(label, [""] * len(self.values[label]))
            self.values[label].append(number)
            if label in self.texts:
                self.texts[label].append(sys.intern(value) if isinstance(value, str) else "")


def _decoded(raw: Raw, source: str) -> Any:
    """The message.  Raises LogError: it does not follow its definition."""
    # Decoders raise errors of all kinds on damaged messages.
    with undamaged(f'{source}: a message of "{raw.topic}" cannot be decoded', (Exception,)):
        return raw.decode()


# ---------------------------------------------------------------------- fields


def _steps(path: str) -> list[str | int]:
    """``a.b[2]`` as names and indices; an element's name stays a text, ``[elbow]``."""
    found: list[str | int] = []
    for name, index in re.findall(r"([^.\[\]]+)|\[([^\]]*)\]", path):
        found.append(name or (int(index) if index.isdecimal() and len(index) < 10 else f"[{index}]"))
    return found


def _member(message: Any, name: str) -> Any:
    return message.get(name) if isinstance(message, dict) else getattr(message, name, None)


def _follow(message: Any, steps: Sequence[str | int]) -> Any:
    """The value at the end of a path; None where there is none."""
    owner, value = message, message
    for step in steps:
        if isinstance(step, str) and step.startswith("["):
            names = _member(owner, "name")
            step = list(names).index(step[1:-1]) if names is not None and step[1:-1] in names else -1
        if isinstance(step, str):
            owner, value = value, _member(value, step)
        else:
            value = value[step] if isinstance(value, (list, np.ndarray)) and 0 <= step < len(value) else None
        if value is None:
            return None
    return value


def _stamp(message: Any) -> int:
    """Nanoseconds of ``header.stamp`` or ``stamp``; 0 where there is none."""
    header = _member(message, "header")
    stamp = _member(header if header is not None else message, "stamp")
    if stamp is None:
        return 0
    seconds = _member(stamp, "sec")
    fraction = _member(stamp, "nanosec")
    fraction = _member(stamp, "nsec") if fraction is None else fraction
    if not isinstance(seconds, (int, np.integer)) or not isinstance(fraction, (int, np.integer)):
        return 0
    nanoseconds = int(seconds) * 1_000_000_000 + int(fraction)
    return nanoseconds if abs(nanoseconds) < _LATEST else 0


def _field_names(message: Any, kinds: tuple[type, ...]) -> tuple[str, ...]:
    """Dotted names of the values of some types in a message, in its order; long arrays are cut."""
    names: list[str] = []
    _collect(message, "", names, kinds, 0)
    return tuple(names[:_MOST_FIELDS])


def _collect(value: Any, prefix: str, names: list[str], kinds: tuple[type, ...], depth: int) -> None:
    if len(names) >= _MOST_FIELDS or depth > 12:
        return
    if isinstance(value, kinds):
        names.append(prefix)
    elif isinstance(value, (list, np.ndarray)):
        for k, element in enumerate(value[:_MOST_ELEMENTS]):
            _collect(element, f"{prefix}[{k}]", names, kinds, depth + 1)
    elif not isinstance(value, (str, bytes)):
        members = value if isinstance(value, dict) else getattr(value, "__dict__", {})
        for name, member in members.items():
            if not name.startswith("_"):
                _collect(member, f"{prefix}.{name}" if prefix else name, names, kinds, depth + 1)


# ---------------------------------------------------------------------- MCAP


def open_mcap(path: Path, source: str) -> BagRecording:
    """Recording of an MCAP file.  Raises LogError: as `McapFile`."""
    return BagRecording(source, McapFile(path, source))


class McapFile:
    """Messages of an MCAP file, with ROS definitions or as JSON.

    Raises LogError: the package that reads it is missing.
    """

    def __init__(self, path: Path, source: str) -> None:
        with installed(f"{source}: MCAP needs the packages mcap and rosbags"):
            import rosbags.typesys  # noqa: F401  # which decodes messages
            from mcap.reader import make_reader
        self.notes: list[str] = []
        self.topics: Collection[str] | None = None
        self._path, self._source = path, source
        self._decoders: dict[tuple[str, str], Callable[[bytes], Any] | None] = {}
        self._schemas: dict[int, Any] = {}
        self._channels: dict[int, Any] = {}
        self._chunks: dict[int, Collection[int]] = {}
        with path.open("rb") as file, contextlib.suppress(*damages()):
            summary = make_reader(file).get_summary()
            if summary is not None and summary.statistics is not None:
                self._schemas, self._channels = dict(summary.schemas), dict(summary.channels)
                counts = summary.statistics.channel_message_counts
                self.topics = {x.topic for x in self._channels.values() if counts.get(x.id)}
                self._chunks = {
                    x.chunk_start_offset + x.chunk_length: x.message_index_offsets for x in summary.chunk_indexes
                }

    def messages(self, wanted: Collection[str] | None) -> Iterator[Raw]:
        """Messages of some topics, in the file's order; the file is read up to where it is cut off or damaged."""
        from mcap import records

        for record in self._records(wanted):
            if isinstance(record, records.Schema):
                self._schemas.setdefault(record.id, record)
            elif isinstance(record, records.Channel):
                self._channels.setdefault(record.id, record)
            elif isinstance(record, records.Message):
                channel = self._channels.get(record.channel_id)
                if channel is None or (wanted is not None and channel.topic not in wanted):
                    continue
                decode = self._decoder(channel)
                if decode is not None:
                    yield Raw(channel.topic, record.log_time, partial(decode, record.data))

    def _records(self, wanted: Collection[str] | None) -> Iterator[Any]:
        """Records of the data section; chunks without a wanted topic, by the file's own index, stay packed."""
        from mcap import records
        from mcap.stream_reader import StreamReader, breakup_chunk

        with self._path.open("rb") as file:
            reader = StreamReader(file, emit_chunks=True, record_size_limit=LARGEST_CHUNK)
            try:
                for record in reader.records:
                    if isinstance(record, (records.DataEnd, records.Footer)):
                        return
                    if not isinstance(record, records.Chunk):
                        yield record
                    elif wanted is None or self._may_hold(file.tell(), wanted):
                        yield from breakup_chunk(unpacked(record))
            except damages() as error:
                if file.tell() <= len(MAGIC):
                    raise LogError(f"{self._source}: it is not an MCAP file") from error
                what = f"{type(error).__name__}: {' '.join(str(error).split())}"
                note = f"the file is cut off or damaged at byte {file.tell()} ({what:.80}); what follows is left out"
                if note not in self.notes:
                    self.notes.append(note)

    def _may_hold(self, end: int, wanted: Collection[str]) -> bool:
        """False for a chunk that, by the file's index, has no message of the topics; ``end`` is its place."""
        held = self._chunks.get(end)
        return not held or any(i not in self._channels or self._channels[i].topic in wanted for i in held)

    def _decoder(self, channel: Any) -> Callable[[bytes], Any] | None:
        """Decoder of a channel's messages; None, with a note, for an encoding that is not read."""
        of_ros = {("cdr", "ros2msg"), ("cdr", "ros2idl"), ("ros1", "ros1msg")}
        schema = self._schemas.get(channel.schema_id)
        key = (channel.message_encoding, schema.name if schema is not None else "")
        if key not in self._decoders:
            if channel.message_encoding == "json":
                self._decoders[key] = json.loads
            elif schema is not None and (channel.message_encoding, schema.encoding) in of_ros:
                self._decoders[key] = _ros_decoder(schema, channel.message_encoding, self._source)
            else:
                encoding = channel.message_encoding
                self.notes.append(f'topic "{channel.topic}" is left out: its encoding "{encoding:.40}" is not read')
                self._decoders[key] = None
        return self._decoders[key]


def damages() -> tuple[type[Exception], ...]:
    """Errors that a damaged MCAP file leads to."""
    import zstandard
    from mcap.exceptions import McapError

    return (McapError, zstandard.ZstdError, *DAMAGE)


def unpacked(chunk: Any) -> Any:
    """The chunk with its records unpacked.  Raises ValueError: they are not as long as it says, or too long."""
    size = chunk.uncompressed_size
    if size > LARGEST_CHUNK:
        raise ValueError(f"a chunk of {size} bytes is longer than is read")
    data = chunk.data
    if chunk.compression == "zstd":
        import zstandard

        with zstandard.ZstdDecompressor().stream_reader(chunk.data, read_across_frames=True) as stream:
            data = stream.read(size + 1)
    elif chunk.compression == "lz4":
        import lz4.frame

        data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    if len(data) != size:
        raise ValueError(f"a chunk has not its {size} bytes")
    return dataclasses.replace(chunk, compression="", data=data)


def _ros_decoder(schema: Any, encoding: str, source: str) -> Callable[[bytes], Any]:
    """Decoder of the messages of a ROS definition.  Raises LogError: it cannot be read."""
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
    from rosbags.typesys.base import TypesysError

    text = schema.data.decode(errors="replace")
    errors: tuple[type[Exception], ...] = (TypesysError, SyntaxError, *DAMAGE)
    with undamaged(f'{source}: the definition of "{schema.name}" cannot be read', errors):
        types: dict[str, Any] = {}
        if schema.encoding == "ros2idl":
            for part in text.split("=" * 80 + "\n"):
                if part.strip():
                    types.update(get_types_from_idl(part.split("\n", 1)[1] if part.startswith("IDL: ") else part))
        else:
            types.update(get_types_from_msg(text, schema.name))
        store = get_typestore(Stores.EMPTY)
        store.register(types)
        kind = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/", 1)
    if encoding == "ros1":
        return lambda data: store.deserialize_ros1(data, kind)
    return lambda data: store.deserialize_cdr(data, kind)


# ---------------------------------------------------------------------- bags


def open_bag(path: Path, source: str) -> BagRecording:
    """Recording of a ROS 1 bag, or of the folder of a ROS 2 bag.  Raises LogError: as `RosBag`."""
    return BagRecording(source, RosBag(path, source))


class RosBag:
    """Messages of a bag, read by rosbags.

    Raises LogError: the package is missing; the bag is damaged, or not indexed.
    """

    def __init__(self, path: Path, source: str) -> None:
        with installed(f"{source}: bags need the package rosbags"):
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        self.notes: list[str] = []
        self._source = source
        self._open = partial(AnyReader, [path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        # The library raises errors of all kinds on damaged bags, here and when messages are read.
        with undamaged(f"{source}: it is not a bag, or is damaged", (Exception,)), self._open() as reader:
            self.topics: Collection[str] | None = {x.topic for x in reader.connections if x.msgcount}

    def messages(self, wanted: Collection[str] | None) -> Iterator[Raw]:
        """Messages of some topics, in the order of their recording."""
        with self._open() as reader:
            chosen = [x for x in reader.connections if wanted is None or x.topic in wanted]
            messages = reader.messages(chosen) if chosen else iter(())
            while True:
                with undamaged(f"{self._source}: it is not a bag, or is damaged", (Exception,)):
                    found = next(messages, None)
                if found is None:
                    return
                connection, time, data = found
                yield Raw(connection.topic, time, partial(reader.deserialize, data, connection.msgtype))
