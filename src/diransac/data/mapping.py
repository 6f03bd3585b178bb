"""Mappings: which field of which topic is which signal of a model, in which unit and frame."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.errors import LogError
from diransac.text_table import some

TextArray = np.ndarray[Any, np.dtype[np.object_]]


@dataclass(frozen=True)
class Condition:
    """Samples count where a field of the same topic is above, below, both, or equal; others are missing."""

    field: str
    above: float = -math.inf
    below: float = math.inf
    equals: float | str | None = None

    def holds(self, values: FloatArray | TextArray) -> BoolArray:
        """Flags (n,); False for NaN, and for texts where numbers are compared, or the reverse."""
        if (values.dtype == np.object_) != isinstance(self.equals, str):
            return np.zeros(len(values), np.bool_)
        if self.equals is not None:
            return np.asarray(values == self.equals, np.bool_)
        return np.asarray((values > self.above) & (values < self.below))

    def __str__(self) -> str:
        if self.equals is not None:
            return json.dumps(self.equals) if isinstance(self.equals, str) else f"{self.equals:g}"
        limits = [f"above {self.above:g}"] if self.above > -math.inf else []
        return " and ".join([*limits, *([f"below {self.below:g}"] if self.below < math.inf else [])])


def _other_attitude(q: Sequence[FloatArray]) -> list[FloatArray]:
    """Attitude ``r o q o s`` of a body with axes FLU in ENU, from that of FRD in NED, or the reverse.

    ``r`` turns NED into ENU, half a turn about north-east, and ``s`` half a turn about the body's x axis.
    """
    w, x, y, z = q
    half = math.sqrt(0.5)
    return [half * (w + z), half * (x + y), half * (x - y), half * (w - z)]


AXES = {
    **dict.fromkeys(("ned-to-enu", "enu-to-ned"), lambda v: [v[1], v[0], -v[2]]),
    **dict.fromkeys(("frd-to-flu", "flu-to-frd"), lambda v: [v[0], -v[1], -v[2]]),
}
"""Changes of frame of a vector."""
ATTITUDES = dict.fromkeys(("ned-frd-to-enu-flu", "enu-flu-to-ned-frd"), _other_attitude)
"""Changes of frame of a quaternion."""


@dataclass(frozen=True)
class MappedSignals:
    """One signal, or the components of one vector or quaternion, and their source.

    Parameters
    ----------
    names : tuple of str
        Names of the signals; of a quaternion in the order w, x, y, z.
    fields : tuple of str
        Fields of the topic, as many.
    topic : str
        Empty for a table, and for a recording of one topic.
    units : tuple of str or None
    factors, offsets : tuple of float
        ``value = factor * field + offset``, before the change of frame.
    frame : str, optional
        Change of frame, a key of `AXES` or of `ATTITUDES`.
    optional : bool
        True if a log may lack the topic or the field.
    where : tuple of Condition
        All of them must hold.
    """

    names: tuple[str, ...]
    fields: tuple[str, ...]
    topic: str = ""
    units: tuple[str | None, ...] = ()
    factors: tuple[float, ...] = ()
    offsets: tuple[float, ...] = ()
    frame: str | None = None
    optional: bool = False
    where: tuple[Condition, ...] = ()

    @property
    def needs(self) -> tuple[str, ...]:
        """Fields that must be read."""
        return tuple(dict.fromkeys((*self.fields, *(x.field for x in self.where))))

    def apply(self, columns: Mapping[str, Any]) -> dict[str, FloatArray]:
        """Signals (n,) of the columns of the topic."""
        rows = [columns[name] for name in self.fields]
        if self.factors or self.offsets:
            factors, offsets = self.factors or (1.0,) * len(rows), self.offsets or (0.0,) * len(rows)
            rows = [x if f == 1.0 and b == 0.0 else f * x + b for x, f, b in zip(rows, factors, offsets, strict=True)]
        if self.frame is not None:
            rows = {**AXES, **ATTITUDES}[self.frame](rows)
        if self.where:
            valid = np.logical_and.reduce([x.holds(columns[x.field]) for x in self.where])
            rows = [np.where(valid, x, np.nan) for x in rows]
        return dict(zip(self.names, rows, strict=True))

    def invalid(self, columns: Mapping[str, Any]) -> str:
        """Reason why no sample of the topic counts; empty where one does."""
        for x in self.where:
            if not x.holds(columns[x.field]).any():
                return f"has no valid sample: {x.field} is never {x}"
        return ""

    def known_units(self) -> dict[str, str]:
        """Units of the signals that have one."""
        return {name: unit for name, unit in zip(self.names, self.units, strict=False) if unit is not None}


@dataclass(frozen=True)
class Event:
    """A state of the machine that holds or does not, such as airborne.

    Parameters
    ----------
    name : str
    topic : str
        Empty for a table.
    where : tuple of Condition
        All of them must hold.
    """

    name: str
    topic: str
    where: tuple[Condition, ...]

    @property
    def needs(self) -> tuple[str, ...]:
        """Fields that must be read."""
        return tuple(dict.fromkeys(x.field for x in self.where))

    def flags(self, columns: Mapping[str, Any]) -> FloatArray:
        """1 for each sample (n,) of the topic at which it holds, else 0."""
        holds = np.logical_and.reduce([x.holds(columns[x.field]) for x in self.where])
        return np.asarray(holds, np.float64)


def held(time: FloatArray, flags: FloatArray, rows: FloatArray) -> FloatArray:
    """Flag that was last known at each of the rows (N,), s; NaN before the first."""
    if not len(time):
        return np.full(len(rows), np.nan)
    order = np.argsort(time, kind="stable")
    last = np.searchsorted(time[order], rows, side="right") - 1
    return np.asarray(np.where(last < 0, np.nan, flags[order][np.maximum(last, 0)]))


@dataclass(frozen=True)
class LogMapping:
    """A mapping file.

    Parameters
    ----------
    source : str
        Name in messages, such as ``mapping "rover.toml"``.
    signals : tuple of MappedSignals
        Of several entries for one signal, the first whose topic and fields a log has is used.
    events : tuple of Event
        Of several for one name, the first whose topic and fields a log has is used; a log may lack any.
    time : str
        ``"header"`` or ``"message"``: time at which a message was sampled, or recorded.
    time_column : str, optional
        Column of the time of a table, times ``time_scale`` in seconds.
    preparation : mapping
        ``resample``, ``repair``, ``from``, ``until``, ``while``, ``unwrap``, ``despike``, ``shift``, which `read_log`
        does, and ``differentiate``, ``bandwidth``, which the command line does.
    text : str
        The file, in TOML.
    """

    source: str
    signals: tuple[MappedSignals, ...] = ()
    events: tuple[Event, ...] = ()
    time: str = "header"
    time_column: str | None = None
    time_scale: float = 1.0
    preparation: Mapping[str, Any] = field(default_factory=dict)
    text: str = ""

    def option(self, name: str) -> Any:
        """A step of the preparation, or None."""
        return self.preparation.get(name)

    def events_in(self, fields: Mapping[str, Sequence[str]]) -> list[Event]:
        """Events whose topic and fields a log has."""
        found: dict[str, Event] = {}
        for event in self.events:
            topic = event.topic if event.topic in fields else f"{event.topic}_0"
            if set(event.needs) <= set(fields.get(topic, ())):
                found.setdefault(event.name, replace(event, topic=topic if event.topic else ""))
        return list(found.values())

    def chosen(
        self, fields: Mapping[str, Sequence[str]], elements: Mapping[str, Sequence[str]], source: str
    ) -> tuple[list[MappedSignals], list[str]]:
        """Entries that a log can serve, and notes about signals that it lacks.

        Parameters
        ----------
        fields : mapping of str to sequence of str
            Fields of each topic of the log.
        elements : mapping of str to sequence of str
            Names of the elements of arrays, such as joints, of the topics that have some; ``{joint}`` stands for each.
        source : str

        Raises
        ------
        LogError
            An entry that is not optional has no topic or field; no entry has.
        """
        found: dict[str, MappedSignals] = {}
        lacking: dict[str, tuple[str, bool]] = {}
        only = next(iter(fields)) if len(fields) == 1 else ""
        for entry in [one for whole in self.signals for one in _of_elements(whole, elements.get(whole.topic or only))]:
            topic = entry.topic or only
            why = _why_not(entry, topic, fields, elements.get(topic, ()))
            if why is None:
                for name in entry.names:
                    found.setdefault(name, replace(entry, topic=topic))
            else:
                for name in entry.names:
                    lacking.setdefault(name, (why, entry.optional))
        absent = {name: why for name, (why, _) in lacking.items() if name not in found}
        for name, why in absent.items():
            if not lacking[name][1]:
                raise LogError(f'{source}: {self.source} has "{name}" from {why}; remove it, or say optional = true')
        if not found:
            what, there = ("columns", fields[""]) if set(fields) == {""} else ("topics", list(fields))
            raise LogError(f"{source}: {self.source} fits none of its {what}; found {some(there)}")
        reasons = dict.fromkeys(absent.values())
        notes = [f"{self.source}: no {', '.join(n for n in absent if absent[n] == why)}: {why}" for why in reasons]
        entries = list(dict.fromkeys(found.values()))
        for entry in entries:
            other = next((name for name in entry.names if found[name] != entry), None)
            if other is not None:
                listed = ", ".join(entry.names)
                raise LogError(
                    f'{self.source}: two entries have "{other}", one of them {listed}; give both all of these'
                )
        return entries, notes


def _of_elements(entry: MappedSignals, elements: Sequence[str] | None) -> list[MappedSignals]:
    """The entry, once for each element where it has the placeholder ``{joint}`` and the topic has elements."""
    if not elements or not any("{joint}" in text for text in (*entry.names, *entry.fields)):
        return [entry]

    def of(element: str, texts: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(x.replace("{joint}", element) for x in texts)

    return [replace(entry, names=of(x, entry.names), fields=of(x, entry.fields)) for x in elements]


def _why_not(
    entry: MappedSignals, topic: str, fields: Mapping[str, Sequence[str]], elements: Sequence[str]
) -> str | None:
    """Reason why a log cannot serve an entry, or None."""
    known = fields.get(topic, fields.get(f"{topic}_0"))
    if known is None:
        return f'topic "{topic}", which the log has not'
    indices = {f"[{element}]": f"[{k}]" for k, element in enumerate(elements)}
    for path in entry.needs:
        start = path.find("[")
        listed = path[:start] + indices.get(path[start:], path[start:]) if start >= 0 else path
        if listed not in known:
            return f'field "{path}" of topic "{topic}", which has {some(known)}'
    return None
