"""PX4's ULog: topics of binary records, after https://docs.px4.io/main/en/dev_log/ulog_file_format.html.

The file is mapped into memory and walked once, message by message, for the places of the records; only the fields that
are asked for are copied.  A file that is cut off or damaged is read as far as its records are whole.
"""

from __future__ import annotations

import mmap
import re
import struct
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from diransac.data.checks import as_doubles
from diransac.data.readers.recording import Recording, Samples, Stamps, seconds_since
from diransac.errors import LogError

_HEADER = struct.Struct("<HB")
_KNOWN = frozenset(b"FDIMPQARSOLCB")
_TYPES = {
    **{f"{'u' * (kind == 'u')}int{8 * n}_t": f"<{kind}{n}" for kind in "iu" for n in (1, 2, 4, 8)},
    "float": "<f4",
    "double": "<f8",
    "bool": "<u1",
    "char": "<u1",
}
_LARGEST_RECORD, _MOST_TEXTS = 0xFFFF, 1000


@dataclass
class _Topic:
    """A subscription: the format of its records and the places in the file of those that are whole."""

    name: str
    instance: int
    layout: Mapping[str, tuple[str, int]]
    size: int
    places: array[int] = field(default_factory=lambda: array("Q"))


class UlogRecording(Recording):
    """Topics of a ULog file.

    Raises LogError: the file is no ULog, or is cut off before its first record.

    Notes
    -----
    A topic with several instances is ``sensor_accel_0``, ``sensor_accel_1``, ...; ``sensor_accel`` is the first one.
    Nested and repeated fields are ``esc[0].esc_rpm`` and ``q[3]``.  The time ``"header"`` is ``timestamp_sample``
    where a topic has it, ``timestamp`` otherwise.
    """

    def __init__(self, path: Path, source: str) -> None:
        super().__init__(source)
        self.metadata = {"information": {}, "parameters": {}, "messages": [], "dropouts": []}
        self._formats: dict[str, str] = {}
        self._subscriptions: dict[int, _Topic] = {}
        self._found: list[_Topic] = []
        self._skipped = 0
        self._last: _Topic | None = None
        with path.open("rb") as file:
            head = file.read(16)
            if head[:7] != b"ULog\x01\x12\x35":
                raise LogError(f"{source}: it is not a ULog file (its first bytes are {head[:7].hex(' ')})")
            if len(head) < 16:
                raise LogError(f"{source}: it is cut off in its header")
            self._data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self._start = int.from_bytes(head[8:], "little")
        for kind, at, size in self._messages():
            self._take(kind, at, size)
        self._topics = self._named()
        if not self._topics:
            raise LogError(f"{source}: it holds no record of any topic; it is cut off or damaged")
        self._start = self._first_time()
        self._say_what_is_missing()

    # ------------------------------------------------------------------ the file

    def _messages(self) -> Iterator[tuple[int, int, int]]:
        """Type, place and size of every message's content; what is damaged is stepped over, and counted."""
        data, end, at, damages = self._data, len(self._data), 16, 0
        appended: list[int] = []
        while at + 3 <= end:
            size, kind = _HEADER.unpack_from(data, at)
            after = at + 3 + size
            if appended and after > appended[0]:  # a section was appended here, later, in the middle of a message
                at = appended.pop(0)
                continue
            if kind not in _KNOWN or (kind == ord("D") and not self._fits(at + 3, size)):
                damages += 1
                self._doubt_last()
                at = self._resume(at + 1)
                if damages > 100 or at < 0:  # the rest is no ULog
                    return
                continue
            if after > end:
                break
            if kind == ord("B") and size >= 40:
                offsets = struct.unpack_from("<3Q", data, at + 19)
                appended = sorted(x for x in offsets if after < x < end)
            yield kind, at + 3, size
            at = after
        if at < end:
            self.found.append(f"the file is cut off in the middle of a message: {end - at} bytes left out")

    def _doubt_last(self) -> None:
        """Leave out the record before a damage, in which the damage may have begun."""
        if self._last is not None:
            self._last.places.pop()
            self._last = None

    def _fits(self, at: int, size: int) -> bool:
        """True for a record of a known topic and of that topic's size."""
        if size < 2 or at + 2 > len(self._data):
            return False
        topic = self._subscriptions.get(int.from_bytes(self._data[at : at + 2], "little"))
        return topic is None or topic.size <= size - 2

    def _resume(self, at: int) -> int:
        """Place of the next mark or message that is plausible, -1 where there is none."""
        data, end = self._data, len(self._data)
        mark = data.find(b"\x08\x00S\x2f\x73\x13\x20\x25\x0c\xbb\x12", at)
        last = min(end, at + (1 << 20)) if mark < 0 else mark  # without a mark, a megabyte is searched
        for place in range(at, last - 5):
            if data[place + 2] == ord("D"):
                size, _ = _HEADER.unpack_from(data, place)
                after = place + 3 + size
                known = int.from_bytes(data[place + 3 : place + 5], "little") in self._subscriptions
                if known and self._fits(place + 3, size) and after + 3 <= end and data[after + 2] in _KNOWN:
                    self._skipped += place - at + 1
                    return place
        self._skipped += (mark if mark >= 0 else end) - at + 1
        return mark

    def _take(self, kind: int, at: int, size: int) -> None:
        """Remember a message.  What cannot be read is damaged, and counts as left out."""
        if kind == ord("D"):
            topic = self._subscriptions.get(int.from_bytes(self._data[at : at + 2], "little"))
            if topic is not None:
                topic.places.append(at + 2)
                self._last = topic
            return
        content = self._data[at : at + size]
        try:
            _TAKERS[kind](self, content)
        except KeyError:
            return
        except (ValueError, IndexError, struct.error, UnicodeDecodeError):
            self._skipped += size

    def _take_format(self, content: bytes) -> None:
        name, fields = content.decode().split(":", 1)
        self._formats[name] = fields

    def _take_subscription(self, content: bytes) -> None:
        instance, number = struct.unpack_from("<BH", content)
        name = content[3:].decode()
        if number in self._subscriptions:
            return
        layout, size = self._layout(name)
        names = list(layout)
        while names and names[-1].startswith("_padding"):  # trailing padding is not written
            size = layout.pop(names.pop())[1]
        if layout.get("timestamp", ("", 0))[0] != "<u8":
            raise ValueError("no timestamp")
        self._subscriptions[number] = _Topic(name, instance, layout, size)
        self._found.append(self._subscriptions[number])

    def _layout(self, name: str, depth: int = 0) -> tuple[dict[str, tuple[str, int]], int]:
        """Type and offset of every field of a format, nested ones by dotted names, and the size of a record."""
        if name not in self._formats or depth > 8:
            raise ValueError("there is no such format, or formats contain each other")
        layout: dict[str, tuple[str, int]] = {}
        size = 0
        for text in filter(None, self._formats[name].split(";")):
            match = re.fullmatch(r"(\w+)(?:\[(\d{1,5})\])? (\w+)", text)
            if match is None:
                raise ValueError(text)
            kind, count, label = match.groups()
            if kind in _TYPES:
                inner, step = {"": (_TYPES[kind], 0)}, int(_TYPES[kind][2])
            else:
                inner, step = self._layout(kind, depth + 1)
            repeats = int(count or 1)
            if size + repeats * step > _LARGEST_RECORD or repeats * len(inner) > _LARGEST_RECORD:
                raise ValueError("a record is too large")
            for k in range(repeats):
                prefix = f"{label}[{k}]" if count else label
                for rest, (code, offset) in inner.items():
                    layout[f"{prefix}.{rest}" if rest else prefix] = (code, size + offset)
                size += step
        return layout, size

    def _take_information(self, content: bytes) -> None:
        kind, name, value = _keyed(content)
        if kind.startswith("char[") and len(self.metadata["information"]) < _MOST_TEXTS:
            self.metadata["information"][name] = value.decode(errors="replace").rstrip("\0")

    def _take_parameter(self, content: bytes) -> None:
        kind, name, value = _keyed(content)
        if kind in ("int32_t", "float"):
            (number,) = struct.unpack("<i" if kind == "int32_t" else "<f", value)
            self.metadata["parameters"][name] = number

    def _take_text(self, content: bytes, at: int = 1) -> None:
        (stamp,) = struct.unpack_from("<Q", content, at)
        if len(self.metadata["messages"]) < _MOST_TEXTS:
            self.metadata["messages"].append([stamp / 1e6, content[at + 8 :].decode(errors="replace")])

    def _take_dropout(self, content: bytes) -> None:
        self.metadata["dropouts"].append(struct.unpack("<H", content)[0] / 1e3)

    # ------------------------------------------------------------------ topics

    def _named(self) -> dict[str, _Topic]:
        """Topics with a record, by name; the instance is part of it where there are several."""
        written = [topic for topic in self._found if topic.places]
        several = {t.name for t in written for other in written if t is not other and t.name == other.name}
        named: dict[str, _Topic] = {}
        for topic in sorted(written, key=lambda t: (t.name, t.instance)):
            named.setdefault(f"{topic.name}_{topic.instance}" if topic.name in several else topic.name, topic)
        return named

    def _first_time(self) -> int:
        """Start of the log, µs: the header's, or that of most topics if that is not in the minute after it."""
        firsts = [int(self._column(topic, "timestamp", topic.places[:1])[0]) for topic in self._topics.values()]
        usual = sorted(firsts)[len(firsts) // 2]
        return self._start if 0 <= usual - self._start < 60_000_000 else usual

    def _say_what_is_missing(self) -> None:
        dropouts = self.metadata["dropouts"]
        if dropouts:
            n = len(dropouts)
            self.found.append(f"{n} dropout{'s' * (n > 1)} of the logger, {sum(dropouts):.3g} s in all")
        if self._skipped:
            self.found.append(f"the file is damaged: {self._skipped} bytes left out")

    @property
    def fields(self) -> dict[str, tuple[str, ...]]:
        """Fields of each topic."""
        return {name: tuple(topic.layout) for name, topic in self._topics.items()}

    def read(self, wanted: Mapping[str, Sequence[str]], stamps: Stamps) -> dict[str, Samples]:
        """Samples of some fields.  Raises LogError: there is no such topic or field."""
        return {name: self._samples(name, fields, stamps) for name, fields in wanted.items()}

    def _samples(self, name: str, fields: Sequence[str], stamps: Stamps) -> Samples:
        first = f"{name}_0"
        known = first if name not in self._topics and first in self._topics else name
        self.check(known, fields)
        topic = self._topics[known]
        clock = "timestamp_sample" if stamps == "header" and "timestamp_sample" in topic.layout else "timestamp"
        times = self._column(topic, clock, topic.places)
        if clock != "timestamp" and not times.all():  # some publishers leave it zero
            times = self._column(topic, "timestamp", topic.places)
        latest = 1 << 53
        since = np.minimum(times, np.uint64(latest)).astype(np.int64) - min(self._start, latest)
        columns = {label: as_doubles(self._column(topic, label, topic.places)) for label in fields}
        return Samples(seconds_since(0, 1000 * since), columns)

    def _column(self, topic: _Topic, label: str, places: array[int]) -> npt.NDArray[Any]:
        """One field (n,) of the records at some places."""
        code, offset = topic.layout[label]
        kind = np.dtype(code)
        data = np.frombuffer(self._data, dtype=np.uint8)
        at = np.frombuffer(places, dtype=np.uint64).astype(np.int64) + offset
        column = np.empty(len(at), dtype=kind)
        for first in range(0, len(at), 1 << 16):  # their places take eight times the memory of the bytes
            part = slice(first, first + (1 << 16))
            column[part] = data[at[part, None] + np.arange(kind.itemsize)].view(kind)[:, 0]
        return column


def _keyed(content: bytes) -> tuple[str, str, bytes]:
    """Type, name and value of a message ``length, "type name", value``."""
    length = content[0]
    kind, name = content[1 : 1 + length].decode().split(" ", 1)
    return kind, name, content[1 + length :]


_TAKERS = {
    ord("F"): UlogRecording._take_format,
    ord("A"): UlogRecording._take_subscription,
    ord("I"): UlogRecording._take_information,
    ord("P"): UlogRecording._take_parameter,
    ord("L"): UlogRecording._take_text,
    ord("C"): lambda log, content: log._take_text(content, 3),  # which has a tag
    ord("O"): UlogRecording._take_dropout,
}
