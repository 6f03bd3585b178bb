"""`Logs`: logs that the page shows, read once, and their signals thinned out by minimum and maximum."""

from __future__ import annotations

import json
import threading
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.data import preprocessing
from diransac.data.log import Log
from diransac.data.readers import episodes_of, read_log, read_topics
from diransac.errors import LogError

if TYPE_CHECKING:
    from diransac.data.readers.topics import TopicTable

_BLOCK = 256
"""Rows whose extremes are computed once."""


@dataclass
class Shown:
    """A log with what has been computed of it.

    Parameters
    ----------
    log : Log
    raw : str
        Reason why its signals are those of the file, not of the model; empty where they are mapped.
    fields : tuple of str
        Columns of the file, or fields of its topics.
    """

    log: Log
    raw: str = ""
    fields: tuple[str, ...] = ()
    _blocks: dict[str, tuple[FloatArray, FloatArray]] = field(default_factory=dict)
    _outliers: dict[str, IntArray] = field(default_factory=dict)
    _continuous: Mapping[str, FloatArray] = field(default_factory=dict)
    _alone: threading.Lock = field(default_factory=threading.Lock)

    def facts(self) -> dict[str, Any]:
        """Names, units, rows, clock, and findings of the reader."""
        log = self.log
        missing = {name: int(np.isnan(log[name]).sum()) for name in log.names}
        return {
            "source": log.source,
            "rows": len(log),
            "start": float(log.time[0]),
            "dt": log.dt,
            "signals": [{"name": n, "unit": log.units.get(n), "missing": missing[n]} for n in log.names],
            "notes": list(log.notes),
            "raw": self.raw,
            "fields": list(self.fields),
        }

    def window(self, name: str, begin: float, end: float, width: int) -> tuple[float, float, FloatArray, FloatArray]:
        """First time and spacing, s, and the least and largest sample of every cell between two moments.

        Parameters
        ----------
        name : str
            Signal.
        begin, end : float
            Moments, s.
        width : int
            Number of cells at most, about.

        Returns
        -------
        start, step : float
        low, high : (n,) arrays
            Equal where a cell is a row; NaN where it has no sample.
        """
        log, values = self.log, self.log[name]
        first = max(0, min(int((begin - log.time[0]) / log.dt) - 1, len(log) - 2))
        last = min(len(log), max(int((end - log.time[0]) / log.dt) + 2, first + 2))
        size = (last - first) // max(1, width)
        if size <= 2:
            part = values[first:last]
            return float(log.time[first]), log.dt, part, part
        if size < 2 * _BLOCK:
            low, high = _extremes(values[first:last], size)
        else:
            blocks = self._blocks_of(name)
            size, begin_block = size // _BLOCK, first // _BLOCK
            first, ends = begin_block * _BLOCK, -(-last // _BLOCK)
            low, high = (_extremes(x[begin_block:ends], size)[k] for k, x in enumerate(blocks))
            size *= _BLOCK
        return float(log.time[first] + 0.5 * (size - 1) * log.dt), size * log.dt, low, high

    def outliers(self, name: str, begin: float, end: float) -> tuple[FloatArray, FloatArray, int]:
        """Times and values of samples that a Hampel filter would replace, thinned out, and their number in the log.

        The number is -1 for a log of too many rows to be searched.
        """
        log = self.log
        if len(log) > 4_000_000:
            return np.zeros(0), np.zeros(0), -1
        with self._alone:  # a view that moves on asks again while the first search goes on
            if name not in self._outliers:
                self._continuous = self._continuous or preprocessing.unwrap(log).signals
                known = np.flatnonzero(np.isfinite(self._continuous[name]))
                with np.errstate(over="ignore", invalid="ignore"):
                    marked = preprocessing.hampel(self._continuous[name][known])[0] if len(known) > 3 else known < 0
                self._outliers[name] = known[marked]
        rows = self._outliers[name]
        inside = rows[(log.time[rows] >= begin) & (log.time[rows] <= end)]
        thinned = inside[:: 1 + len(inside) // 3000]
        return log.time[thinned], log[name][thinned], len(rows)

    def _blocks_of(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Least and largest sample of every block of rows."""
        if name not in self._blocks:
            self._blocks[name] = _extremes(self.log[name], _BLOCK)
        return self._blocks[name]


def _extremes(values: FloatArray, size: int) -> tuple[FloatArray, FloatArray]:
    """Least and largest of every ``size`` values; NaN where there is none."""
    whole = len(values) // size * size
    cells, rest = values[:whole].reshape(-1, size), values[whole:]
    low, high = np.fmin.reduce(cells, axis=1), np.fmax.reduce(cells, axis=1)
    if len(rest):
        low, high = np.append(low, np.fmin.reduce(rest)), np.append(high, np.fmax.reduce(rest))
    return low, high


class Logs:
    """Logs that were read, the latest first; older ones are dropped where they fill the memory."""

    def __init__(self) -> None:
        self._known, self._alone = OrderedDict[str, Shown](), threading.Lock()

    def read(self, path: Path, reading: Mapping[str, Any]) -> Shown:
        """A log by its file and arguments of `read_log`; its own fields where these do not fit.

        Raises LogError: it cannot be read at all.
        """
        about = path.stat()
        key = json.dumps([str(path), about.st_mtime_ns, about.st_size, dict(reading)], sort_keys=True)
        with self._alone:  # two tabs that want one log read it once
            if key not in self._known:
                self._known[key] = _shown(path, reading)
            self._known.move_to_end(key)
            while len(self._known) > 1 and sum(map(_size, self._known.values())) > 150_000_000:
                self._known.popitem(last=False)
            return self._known[key]


def _size(shown: Shown) -> int:
    """Numbers that a log keeps in memory."""
    return len(shown.log) * (1 + len(shown.log.names))


def _shown(path: Path, reading: Mapping[str, Any]) -> Shown:
    plain = {key: reading[key] for key in ("columns", "rate", "repair") if key in reading}
    topics = read_topics(path)
    labels = () if topics is None else tuple(_labels(topics))
    if topics is None or reading.get("mapping") or reading.get("rename"):
        try:
            log = _read(path, reading)
            return Shown(log, "", labels or _columns(log, reading.get("rename", {})))
        except LogError as error:
            if plain == reading:
                raise
            why = str(error)
    else:
        why = "no topic is mapped to a signal yet"
    log = _read(path, plain) if topics is None else _read_fields(path, list(labels[:40]))
    return Shown(log, why, labels or _columns(log, {}))


def _labels(topics: TopicTable) -> Iterator[str]:
    """Fields of the topics as ``--map`` takes them, elements of arrays by their names where they have some."""
    for topic, fields in topics.fields.items():
        named = {f"[{k}]": f"[{name}]" for k, name in enumerate(topics.elements.get(topic, ()))}
        for one in fields:
            start = one.find("[")
            yield f"{topic}.{one if start < 0 else one[:start] + named.get(one[start:], one[start:])}"


def _columns(log: Log, renamed: Mapping[str, str]) -> tuple[str, ...]:
    """Columns of a table, by their names in the file."""
    return tuple(dict.fromkeys(renamed.get(name, name) for name in log.names))


def _read_fields(path: Path, labels: list[str]) -> Log:
    """A recording's fields under their own names; those that are no numbers are left out."""
    try:
        return _read(path, {"rename": {label: label for label in labels}})
    except LogError as first:
        able = list[str]()
        for label in labels:
            try:
                _read(path, {"rename": {label: label}})
            except LogError:
                continue
            able.append(label)
        if not able:
            raise first
        return _read(path, {"rename": {label: label for label in able}})


def _read(path: Path, reading: Mapping[str, Any]) -> Log:
    """A log; the first of several episodes, and resampled where it is uneven, with a note."""
    episodes = episodes_of(path)
    first = episodes[0] if episodes else None
    said = [f"the first of {len(episodes)} episodes is shown"] if len(episodes) > 1 else []
    try:
        log = read_log(path, episode=first, **reading)
    except LogError as error:
        if "resample" in reading:
            raise
        log = read_log(path, episode=first, **reading, resample="median")
        said.append(f"resampled, because: {error}")
    return replace(log, notes=(*said, *log.notes)) if said else log
