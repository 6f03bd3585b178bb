"""Recordings of several topics, each with a clock of its own, and the one table of signals that a log is made of."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from diransac.arrays import FloatArray, IntArray
from diransac.data.checks import ROUNDING, check_time_order
from diransac.data.clock import Aligned
from diransac.data.preprocessing.steps import describe_resampling, interpolate_at, resampling_grid
from diransac.errors import LogError
from diransac.text_table import some

Stamps = str
"""``"header"``: time at which a message says it was sampled; ``"message"``: time at which it was recorded."""


@dataclass(frozen=True)
class Samples:
    """Samples of a topic.

    Parameters
    ----------
    time : (n,) array
        Seconds since the start of the recording.
    columns : mapping of str to (n,) array
        Samples of each field that was asked for; NaN where a message lacks it.
    unusable : mapping of str to str
        Fields that hold no numbers, and why.
    texts : mapping of str to (n,) array of str
        Samples of those that hold texts; empty where a message lacks it.
    """

    time: FloatArray
    columns: Mapping[str, FloatArray]
    unusable: Mapping[str, str] = field(default_factory=dict)
    texts: Mapping[str, npt.NDArray[np.object_]] = field(default_factory=dict)

    @property
    def interval(self) -> float:
        """Median time from a sample to the next, s; infinite for fewer than two samples."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else np.inf

    def select(self, rows: npt.NDArray[Any]) -> Samples:
        """Samples of some rows."""
        return Samples(self.time[rows], {name: x[rows] for name, x in self.columns.items()}, self.unusable)


class Recording:
    """An opened file with one or more topics; `read` may be called again.

    Parameters
    ----------
    source : str
        Name in messages, such as ``log "flight.ulg"``.

    Attributes
    ----------
    metadata : dict
        Facts beside the samples, that JSON can hold: the machine, its parameters, messages in words.
    elements : dict of str to tuple of str
        Names of the elements of arrays, such as joints, of the topics that have some.
    texts : dict of str to tuple of str
        Names of the fields that hold texts, such as a mode, of the topics that have some.
    found : list of str
        Findings about the file; complete after a `read`.
    """

    def __init__(self, source: str) -> None:
        self.source = source
        self.metadata: dict[str, Any] = {}
        self.elements: dict[str, tuple[str, ...]] = {}
        self.texts: dict[str, tuple[str, ...]] = {}
        self.found: list[str] = []

    @property
    def notes(self) -> tuple[str, ...]:
        """Findings about the file, a sentence each."""
        return tuple(dict.fromkeys(self.found))

    @property
    def fields(self) -> Mapping[str, tuple[str, ...]]:
        """Names of the fields of each topic."""
        raise NotImplementedError

    def read(self, wanted: Mapping[str, Sequence[str]], stamps: Stamps) -> dict[str, Samples]:
        """Samples of some fields of some topics.  Raises LogError: there is no such topic or field, or damage."""
        raise NotImplementedError

    def check(self, topic: str, fields: Sequence[str] = ()) -> None:
        """Raise LogError: there is no such topic, or it has no such field."""
        if topic not in self.fields:
            raise LogError(f'{self.source}: there is no topic "{topic}"; found {", ".join(self.fields)}')
        for label in fields:
            if label not in self.fields[topic]:
                raise self.lacking(topic, label)

    def lacking(self, topic: str, label: str) -> LogError:
        """Error of a topic that has no such field."""
        return LogError(
            f'{self.source}: topic "{topic}" has no field "{label}"; it has {", ".join(self.fields[topic])}'
        )


def seconds_since(origin: int, nanoseconds: npt.NDArray[np.int64]) -> FloatArray:
    """Seconds (n,) from an origin, correctly rounded: 30,000,000 ns is the number that ``0.03`` is read as."""
    return np.asarray((nanoseconds - np.int64(origin)) / 1e9)


def find_field(path: str, fields: Mapping[str, Iterable[str]], source: str) -> tuple[str, str]:
    """Topic and field of ``topic.field``; the topic may be left out where there is only one.

    Raises LogError: there is no such topic, or it has no such field; the message lists what is there.
    """
    topics = [topic for topic in fields if path.startswith(f"{topic}.")]
    if topics:
        topic = max(topics, key=len)
        return topic, path[len(topic) + 1 :]
    if len(fields) == 1:
        return next(iter(fields)), path
    raise LogError(f'{source}: "{path}" names no topic; found {some(fields, 40)}. Name it as topic.field')


def shortened(fields: Iterable[str]) -> list[str]:
    """Names of fields for a listing: ``covariance[0..8]`` and ``rate.{x, y, z}`` in one, those of a header left out.

    Notes
    -----
    Fields that stand side by side are put together; the order is kept.
    """
    found: list[tuple[str, str, list[str]]] = []
    for name in fields:
        if name.startswith("header."):
            continue
        whole, kind, part = _last_part(name)
        if found and found[-1][:2] == (whole, kind) and kind:
            found[-1][2].append(part)
        else:
            found.append((whole, kind, [part]))
    return [_together(*one) for one in found]


def _last_part(name: str) -> tuple[str, str, str]:
    """Name without its last index or member, ``[`` or ``.``, and that; the name itself where it has neither."""
    if name.endswith("]"):
        whole, _, index = name[:-1].rpartition("[")
        return whole, "[", index
    whole, point, member = name.rpartition(".")
    return (whole, point, member) if point else (name, "", "")


def _together(whole: str, kind: str, parts: list[str]) -> str:
    if not kind:
        return whole
    if kind == "[":
        return f"{whole}[{parts[0]}..{parts[-1]}]" if len(parts) > 1 else f"{whole}[{parts[0]}]"
    return f"{whole}.{{{', '.join(parts)}}}" if len(parts) > 1 else f"{whole}.{parts[0]}"


# ---------------------------------------------------------------------- one clock


def align(parts: Mapping[str, Samples], rate: float | str | None, source: str) -> Aligned:
    """Signals of several topics on the clock of one; no sample is invented.

    Parameters
    ----------
    parts : mapping of str to Samples
        Topic -> its signals, under their final names.
    rate : float, "median" or None
        Hz of a uniform clock; ``"median"`` for that of the fastest topic.  None: the rows are those of the fastest
        topic.
    source : str

    Returns
    -------
    Aligned

    Raises
    ------
    LogError
        The time of a topic repeats or runs backwards; no two rows are left.

    Notes
    -----
    At a given rate, a topic at least about as fast is interpolated linearly.  Each sample of every other topic stands,
    unchanged, in the row nearest to it, and the rows between are NaN.
    """
    for topic, samples in parts.items():
        check_time_order(samples.time, f'{source}, topic "{topic}"' if topic else source)
    fastest = min(parts, key=lambda topic: parts[topic].interval)
    reference = parts[fastest]
    signals: dict[str, FloatArray] = {}
    if rate is None:
        time, steps, hertz = reference.time, list[dict[str, Any]](), None
        notes = [f'rows are those of topic "{fastest}"']
    else:
        time, hertz = resampling_grid(reference.time, rate, source)
        step, notes = describe_resampling(reference.time, time, hertz)
        steps = [step]
        notes.insert(0, ", ".join(f'"{topic}" at {1.0 / x.interval:.4g} Hz' for topic, x in parts.items()))
    for topic, samples in parts.items():
        columns, said = _on_rows(samples, time, hertz, topic)
        signals |= columns
        notes += said
    return Aligned(time, signals, steps=tuple(steps), notes=tuple(notes))


def _on_rows(
    samples: Samples, time: FloatArray, hertz: float | None, topic: str
) -> tuple[dict[str, FloatArray], list[str]]:
    """Columns of a topic on the rows of the log, and sentences about samples that moved or found no row."""
    if samples.time is time or np.array_equal(samples.time, time):
        return dict(samples.columns), []
    if hertz is not None and samples.interval <= 1.5 / hertz:  # about as fast
        return interpolate_at(samples.time, samples.columns, time, hertz), []
    return _nearest_rows(samples, time, float(np.median(np.diff(time))), topic)


def nearest(time: FloatArray, stamps: FloatArray) -> IntArray:
    """Index (n,) of the nearest of two or more ascending times for each stamp; of two that are as near, the first."""
    after = np.clip(np.searchsorted(time, stamps), 1, len(time) - 1)
    return np.where(stamps - time[after - 1] <= time[after] - stamps, after - 1, after)


def _nearest_rows(samples: Samples, time: FloatArray, dt: float, topic: str) -> tuple[dict[str, FloatArray], list[str]]:
    """Columns with each sample in the nearest row; of two samples of one row, the nearer; NaN elsewhere."""
    row = nearest(time, samples.time)
    moved = np.abs(time[row] - samples.time)
    inside = moved <= dt * (0.5 + ROUNDING)
    order = np.lexsort((moved, row))
    first = order[np.r_[True, np.diff(row[order]) > 0]]
    kept = np.sort(first[inside[first]])
    columns = {}
    for name, values in samples.columns.items():
        columns[name] = np.full(len(time), np.nan)
        columns[name][row[kept]] = values[kept]
    notes = []
    if len(kept) and moved[kept].max() > 1e-3 * dt:
        notes.append(f'samples of "{topic}" stand in the nearest row, up to {1e3 * moved[kept].max():.3g} ms away')
    if len(kept) < len(samples.time):
        n = len(samples.time) - len(kept)
        notes.append(f'{n} of {len(samples.time)} samples of "{topic}" are left out: they have no row of their own')
    return columns, notes
