"""Crazyflie's micro SD logs (versions 1 and 2): topics of packed binary events.

A header has ``0xbc``, the version, and for each event its name and its variables with their types.  Events follow:
number, time, values; and last, in some files, a CRC-32 of four bytes.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from diransac.data.checks import as_doubles
from diransac.data.readers.recording import Recording, Samples, Stamps
from diransac.data.readers.table import undamaged
from diransac.errors import LogError

MAGIC = b"\xbc"
_STAMPS = {1: ("<u4", 1e-3), 2: ("<u8", 1e-6)}


class CrazyflieRecording(Recording):
    """Events of a micro SD log.

    Raises LogError: the data are no such log, or hold no event.
    """

    def __init__(self, data: bytes, source: str) -> None:
        super().__init__(source)
        with undamaged(f"{source}: it is not a Crazyflie log, or its header is damaged"):
            version, number = struct.unpack_from("<HH", data, 1)
            if version not in _STAMPS or number > 256:  # more events than a log has
                raise ValueError(f"version {version}, {number} events")
            self._stamp, self._tick = _STAMPS[version]
            self._kinds, at = self._events(data, number)
        self._records = self._walk(data, at)
        if not self._records:
            raise LogError(f"{source}: it holds no event; it is cut off or damaged")
        self._start = min(float(x["t"][0]) for x in self._records.values())

    def _events(self, data: bytes, number: int) -> tuple[dict[int, tuple[str, np.dtype[Any]]], int]:
        """Name and record of each event by its number, and the place of the first event."""
        kinds: dict[int, tuple[str, np.dtype[Any]]] = {}
        at = 5
        for _ in range(number):
            (event,) = struct.unpack_from("<H", data, at)
            name, at = _text(data, at + 2)
            (n,) = struct.unpack_from("<H", data, at)
            at += 2
            fields = []
            for _ in range(min(n, 1024)):  # and variables than an event has
                text, at = _text(data, at)
                match = re.fullmatch(r"(.+)\(([bBhHiIqQfd?])\)", text)
                if match is None:
                    raise ValueError(f'"{text}" names no type')
                fields.append((match[1], np.dtype(f"<{match[2]}")))
            kinds[event] = name, np.dtype([("event", "<u2"), ("t", self._stamp), *fields])
        return kinds, at

    def _walk(self, data: bytes, at: int) -> dict[str, npt.NDArray[Any]]:
        """Records of each event.  A log of one event is read as one array."""
        places: dict[int, list[int]] = {event: [] for event in self._kinds}
        while at + 2 <= len(data):
            event = int.from_bytes(data[at : at + 2], "little")
            kind = self._kinds.get(event)
            if kind is None or at + kind[1].itemsize > len(data):
                break
            places[event].append(at)
            at += kind[1].itemsize
        rest = len(data) - at
        if not (rest == 0 or (rest == 4 and zlib.crc32(data[:at]) == int.from_bytes(data[at:], "little"))):
            self.found.append(f"the file is cut off or damaged: its last {rest} bytes are left out")
        bytes_ = np.frombuffer(data, dtype=np.uint8)
        return {
            self._kinds[event][0]: bytes_[np.array(found)[:, None] + np.arange(size)].view(self._kinds[event][1])[:, 0]
            for event, found in places.items()
            if found and (size := self._kinds[event][1].itemsize)
        }

    @property
    def fields(self) -> dict[str, tuple[str, ...]]:
        """Variables of each event."""
        return {name: tuple(x.dtype.names or ())[2:] for name, x in self._records.items()}

    def read(self, wanted: Mapping[str, Sequence[str]], stamps: Stamps) -> dict[str, Samples]:
        """Samples of some variables.  Raises LogError: there is no such event or variable."""
        samples = {}
        for name, fields in wanted.items():
            self.check(name, fields)
            records = self._records[name]
            time = (records["t"].astype(np.float64) - self._start) * self._tick
            samples[name] = Samples(time, {label: as_doubles(records[label]) for label in fields})
        return samples


def _text(data: bytes, at: int) -> tuple[str, int]:
    """Text that ends in a zero byte, and the place after it."""
    end = data.index(b"\0", at, at + 256)
    return data[at:end].decode(), end + 1
