"""Mapping files: which field of which topic is which signal of a model, in which unit and frame.

A mapping is TOML.  Built-in ones, in ``mappings/``, are named without an ending: ``px4-multirotor``.

::

    time = "header"                   # or "message"; for a table: { column = "t_ms", scale = 0.001 }
    resample = 100.0                  # Hz, or "median"; without it the rows are those of the fastest topic

    [[signals]]
    name = "x"                        # or several: ["x", "y", "z"]
    topic = "vehicle_local_position"  # not for a table
    field = "x"                       # as many as names
    scale = 1.0                       # value = sign * scale * field + offset
    unit = "m"

A list of ``names`` may have one ``scale``, ``sign`` or ``offset`` for each.  ``frame`` then changes the axes of three
components, or of the four of a quaternion whose ``order`` in the file is given.  ``where`` leaves samples out.

::

    while = ["airborne"]              # above the signals: rows where it does not hold are left out

    [[events]]
    name = "airborne"                 # a signal that is 1 where the conditions held last, else 0
    topic = "vehicle_land_detected"
    where = { field = "landed", below = 0.5 } # above, below, or equals: a number or a text
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import LogError
from diransac.limits import LARGEST_TABLE
from diransac.plain_data import read_text, toml_table

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = ["BUILT_IN", "Condition", "Event", "LogMapping", "MappedSignals", "held", "load_mapping", "parse_mapping"]

TextArray = np.ndarray[Any, np.dtype[np.object_]]

_HALF = math.sqrt(0.5)
_AXES: dict[str, FloatArray] = {
    **dict.fromkeys(("ned-to-enu", "enu-to-ned"), np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])),
    **dict.fromkeys(("frd-to-flu", "flu-to-frd"), np.diag([1.0, -1.0, -1.0])),
}
"""Matrices of the changes of frame of a vector."""
_ATTITUDES = ("ned-frd-to-enu-flu", "enu-flu-to-ned-frd")
_ORDERS = ("wxyz", "xyzw")

_KEYS = {"name", "topic", "field", "unit", "scale", "sign", "offset", "frame", "order", "optional", "where"}
_STEPS = {"resample", "repair", "from", "until", "while", "despike", "shift", "differentiate", "bandwidth"}
_TOP = {"description", "time", "signals", "events", *_STEPS}
_ANY = "{joint}"
_FOLDER = Path(__file__).parent / "mappings"

BUILT_IN = ("px4-multirotor", "crazyflie", "ros-joint-states", "ros-odometry-imu", "lerobot")
"""Names of the mappings that come with the package."""


@dataclass(frozen=True)
class Condition:
    """Samples count where a field of the same topic is above, below, both, or equal; others are missing."""

    field: str
    above: float = -math.inf
    below: float = math.inf
    equals: float | str | None = None

    def holds(self, values: FloatArray | TextArray) -> np.ndarray[Any, np.dtype[np.bool_]]:
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
        Change of frame, a key of `_AXES` or one of `_ATTITUDES`.
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
        if self.frame in _AXES:
            rows = _signed_permutation(_AXES[self.frame], rows)
        elif self.frame is not None:
            rows = _other_attitude(rows)
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


def _signed_permutation(matrix: FloatArray, rows: Sequence[FloatArray]) -> list[FloatArray]:
    """Rows under a matrix of which each row has one entry, 1 or -1; their numbers keep their bits."""
    sources = np.abs(matrix).argmax(axis=1)
    return [rows[j] if matrix[i, j] > 0.0 else -rows[j] for i, j in enumerate(sources)]


def _other_attitude(q: Sequence[FloatArray]) -> list[FloatArray]:
    """Attitude ``r o q o s`` of a body with axes FLU in ENU, from that of FRD in NED, or the reverse.

    ``r`` turns NED into ENU, half a turn about north-east, and ``s`` half a turn about the body's x axis.
    """
    w, x, y, z = q
    return [_HALF * (w + z), _HALF * (x + y), _HALF * (x - y), _HALF * (w - z)]


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
        ``resample``, ``repair``, ``from``, ``until``, ``while``, ``despike``, ``shift``, which `read_log` does, and
        ``differentiate``, ``bandwidth``, which the command line does.
    text : str
        The file, in TOML.
    """

    source: str
    signals: tuple[MappedSignals, ...] = ()
    events: tuple[Event, ...] = ()
    time: str = "header"
    time_column: str | None = None
    time_scale: float = 1.0
    preparation: Mapping[str, Any] | None = None
    text: str = ""

    def option(self, name: str) -> Any:
        """A step of the preparation, or None."""
        return (self.preparation or {}).get(name)

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
        lacking: dict[str, str] = {}
        only = next(iter(fields)) if len(fields) == 1 else ""
        for entry in [one for whole in self.signals for one in _of_elements(whole, elements.get(whole.topic or only))]:
            topic = entry.topic or only
            why = _why_not(entry, topic, fields, elements.get(topic, ()))
            if why is None:
                for name in entry.names:
                    found.setdefault(name, replace(entry, topic=topic))
            else:
                for name in entry.names:
                    lacking.setdefault(name, why if entry.optional else f"!{why}")
        absent = {name: why for name, why in lacking.items() if name not in found}
        for name, why in absent.items():
            if why.startswith("!"):
                raise LogError(
                    f'{source}: {self.source} has "{name}" from {why[1:]}; remove it, or say optional = true'
                )
        if not found:
            what, there = ("columns", fields[""]) if set(fields) == {""} else ("topics", list(fields))
            raise LogError(f"{source}: {self.source} fits none of its {what}; found {_some(there)}")
        notes = [f"{self.source}: no {', '.join(n for n in absent if absent[n] == w)}: {w}" for w in _unique(absent)]
        entries = list(dict.fromkeys(found.values()))
        for entry in entries:
            other = next((name for name in entry.names if found[name] != entry), None)
            if other is not None:
                listed = ", ".join(entry.names)
                raise LogError(
                    f'{self.source}: two entries have "{other}", one of them {listed}; give both all of these'
                )
        return entries, notes


def _unique(absent: Mapping[str, str]) -> list[str]:
    return list(dict.fromkeys(absent.values()))


def _of_elements(entry: MappedSignals, elements: Sequence[str] | None) -> list[MappedSignals]:
    """The entry, once for each element where it has the placeholder ``{joint}`` and the topic has elements."""
    if not elements or not any(_ANY in text for text in (*entry.names, *entry.fields)):
        return [entry]
    return [
        replace(
            entry,
            names=tuple(x.replace(_ANY, element) for x in entry.names),
            fields=tuple(x.replace(_ANY, element) for x in entry.fields),
        )
        for element in elements
    ]


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
            return f'field "{path}" of topic "{topic}", which has {_some(known)}'
    return None


def _some(names: Sequence[str] | Mapping[str, Any], most: int = 25) -> str:
    listed = list(names)
    return ", ".join(listed[:most]) + (f" and {len(listed) - most} more" if len(listed) > most else "")


# ---------------------------------------------------------------------- reading


def load_mapping(mapping: str | Path) -> LogMapping:
    """Mapping of a built-in name or of a file.

    Raises
    ------
    LogError
        There is no such file, or it is no valid mapping; the sentence names the entry and what it may be.
    """
    if isinstance(mapping, str) and mapping in BUILT_IN:
        source = f'mapping "{mapping}"'
        text = (_FOLDER / f"{mapping}.toml").read_text(encoding="utf-8")
    else:
        path = Path(mapping)
        source = f'mapping "{path}"'
        text = _text(path, source)
    return parse_mapping(text, source)


def parse_mapping(text: str, source: str) -> LogMapping:
    """Mapping of TOML text, by its name in messages.  Raises LogError: as `load_mapping`."""
    try:
        content = toml_table(text)
    except ValueError as error:
        raise LogError(f"{source}: it is not TOML ({' '.join(str(error).split()):.120})") from error
    return replace(_parse(content, source), text=text)


def _text(path: Path, source: str) -> str:
    try:
        return read_text(path, LARGEST_TABLE)
    except FileNotFoundError as error:
        built_in = ", ".join(BUILT_IN)
        raise LogError(f"{source}: there is no such file; built in are {built_in}") from error
    except OSError as error:
        raise LogError(f"{source}: it cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise LogError(f"{source}: {error}") from error


def _parse(content: Mapping[str, Any], source: str) -> LogMapping:
    _check_keys(content, _TOP, source)
    entries = content.get("signals", [])
    if not isinstance(entries, list) or not all(isinstance(x, dict) for x in entries):
        raise LogError(f"{source}: signals must be tables; write [[signals]] before each")
    if not entries:
        raise LogError(f"{source}: it maps no signal; write [[signals]] with name, topic and field")
    time = content.get("time", "header")
    column, scale = None, 1.0
    if isinstance(time, dict):
        _check_keys(time, {"column", "scale"}, f"{source}: time")
        column = _string(time, "column", f"{source}: time")
        scale = _number(time.get("scale", 1.0), "scale", f"{source}: time")
        if scale == 0.0 or column is None:
            raise LogError(f"{source}: time needs a column, and a scale other than 0")
        time = "header"
    if time not in ("header", "message"):
        raise LogError(
            f'{source}: time is {time!r}; write "header", "message", or {{ column = "t_ms", scale = 0.001 }}'
        )
    preparation = {name: content[name] for name in sorted(_STEPS) if name in content}
    _check_preparation(preparation, source)
    return LogMapping(
        source,
        tuple(_entry(x, f"{source}: signal {k + 1}") for k, x in enumerate(entries)),
        _events(content.get("events", []), source),
        time,
        column,
        scale,
        preparation,
    )


def _check_keys(table: Mapping[str, Any], known: set[str], source: str) -> None:
    unknown = [key for key in table if key not in known]
    if unknown:
        raise LogError(f'{source} has "{unknown[0]}", which is not known; it may have {", ".join(sorted(known))}')


def _check_preparation(steps: Mapping[str, Any], source: str) -> None:
    if not isinstance(steps.get("differentiate", False), bool):
        raise LogError(f"{source}: differentiate is {steps['differentiate']!r:.60}; it is true or false")
    for name in ("from", "until", "bandwidth"):
        if name in steps:
            _number(steps[name], name, source)
    if "resample" in steps and steps["resample"] != "median":
        _number(steps["resample"], "resample", source)
    if not isinstance(steps.get("shift", {}), dict):
        raise LogError(f"{source}: shift must be a table of seconds: shift = {{ thrust = 0.02 }}")
    for name, delay in steps.get("shift", {}).items():
        _number(delay, f"shift of {name}", source)
    if "despike" in steps and steps["despike"] != "all":
        _strings(steps["despike"], "despike", source)
    if "while" in steps:
        _strings(steps["while"], "while", source)
    if "repair" in steps and not isinstance(steps["repair"], bool):
        _strings(steps["repair"], "repair", source)


def _entry(table: Mapping[str, Any], source: str) -> MappedSignals:
    _check_keys(table, _KEYS, source)
    names = _strings(table.get("name"), "name", source)
    source = f'{source} ("{names[0]}")'
    fields = _strings(table.get("field"), "field", source)
    if len(fields) != len(names):
        raise LogError(f"{source} has {len(names)} names and {len(fields)} fields; give as many")
    if "t" in names:
        raise LogError(f'{source}: "t" is the time of every log; it needs no entry')
    if len(set(names)) < len(names):
        raise LogError(f"{source} names a signal twice")
    fields, frame = _ordered(table, fields, source)
    units = table.get("unit")
    factors = _numbers(table.get("scale"), "scale", len(names), source, 1.0)
    signs = _numbers(table.get("sign"), "sign", len(names), source, 1.0)
    if any(abs(x) != 1.0 for x in signs):
        raise LogError(f"{source}: sign is {table['sign']}; it is 1 or -1")
    if 0.0 in factors:
        raise LogError(f"{source}: scale is {table['scale']}; give a factor other than 0")
    optional = table.get("optional", False)
    if not isinstance(optional, bool):
        raise LogError(f"{source}: optional is {optional!r}; it is true or false")
    return MappedSignals(
        names=names,
        fields=fields,
        topic=_string(table, "topic", source) or "",
        units=() if units is None else _units(units, len(names), source),
        factors=tuple(f * s for f, s in zip(factors, signs, strict=True)),
        offsets=_numbers(table.get("offset"), "offset", len(names), source, 0.0),
        frame=frame,
        optional=optional,
        where=_conditions(table.get("where", []), source),
    )


def _events(tables: Any, source: str) -> tuple[Event, ...]:
    if not isinstance(tables, list) or not all(isinstance(x, dict) for x in tables):
        raise LogError(f"{source}: events must be tables; write [[events]] before each")
    found = []
    for table in tables:
        _check_keys(table, {"name", "topic", "where"}, f"{source}: events")
        name = _string(table, "name", f"{source}: events")
        where = _conditions(table.get("where", []), f'{source}: event "{name}"')
        if name in (None, "t") or not where:
            raise LogError(f'{source}: an event needs a name, and where = {{ field = "landed", below = 0.5 }}')
        found.append(Event(name or "", _string(table, "topic", source) or "", where))
    return tuple(found)


def _ordered(table: Mapping[str, Any], fields: tuple[str, ...], source: str) -> tuple[tuple[str, ...], str | None]:
    """Fields in the order of the names, and the change of frame."""
    frame, order = _string(table, "frame", source), _string(table, "order", source)
    if frame is not None and frame not in (*_AXES, *_ATTITUDES):
        raise LogError(f'{source}: frame "{frame}" is not known; use one of {", ".join((*_AXES, *_ATTITUDES))}')
    if order is not None and (order not in _ORDERS or len(fields) != 4):
        raise LogError(
            f'{source}: order is "{order}", of {len(fields)} fields; a quaternion has 4, in "wxyz" or "xyzw"'
        )
    if frame in _AXES and len(fields) != 3:
        raise LogError(
            f'{source}: frame "{frame}" changes the 3 components of a vector; there are {len(fields)} fields'
        )
    if frame in _ATTITUDES and order is None:
        raise LogError(f'{source}: frame "{frame}" is that of a quaternion; give its order, "wxyz" or "xyzw"')
    if order == "xyzw":
        fields = (fields[3], *fields[:3])
    return fields, frame


def _conditions(tables: Any, source: str) -> tuple[Condition, ...]:
    if isinstance(tables, dict):
        tables = [tables]
    if not isinstance(tables, list) or not all(isinstance(x, dict) for x in tables):
        raise LogError(f'{source}: where must be a table: where = {{ field = "xy_valid", above = 0.5 }}')
    conditions = []
    for table in tables:
        _check_keys(table, {"field", "above", "below", "equals"}, f"{source}: where")
        name, given = _string(table, "field", f"{source}: where"), {"above", "below", "equals"} & set(table)
        if name is None or not given or ("equals" in given and len(given) > 1):
            raise LogError(f"{source}: where needs a field, and above, below or both, or equals")
        limits = {key: _number(table[key], key, f"{source}: where") for key in ("above", "below") if key in table}
        equals = table.get("equals")
        if isinstance(equals, bool):
            equals = float(equals)
        if equals is not None and not (isinstance(equals, str) and equals):
            equals = _number(equals, "equals", f"{source}: where")
        conditions.append(Condition(name, **limits, equals=equals))
    return tuple(conditions)


def _units(value: Any, n: int, source: str) -> tuple[str, ...]:
    units = _strings(value, "unit", source)
    if len(units) not in (1, n):
        raise LogError(f"{source} has {n} names and {len(units)} units; give one, or as many")
    return units * n if len(units) == 1 else units


def _string(table: Mapping[str, Any], key: str, source: str) -> str | None:
    value = table.get(key)
    if value is not None and (not isinstance(value, str) or not value.strip()):
        raise LogError(f"{source}: {key} is {value!r:.60}; write a text")
    return value


def _strings(value: Any, key: str, source: str) -> tuple[str, ...]:
    listed = [value] if isinstance(value, str) else value
    if not isinstance(listed, list) or not listed or not all(isinstance(x, str) and x.strip() for x in listed):
        what = "is missing" if value is None else f"is {value!r:.60}"
        raise LogError(f'{source}: {key} {what}; write a text, or a list of texts: {key} = "x" or ["x", "y"]')
    return tuple(listed)


def _number(value: Any, key: str, source: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise LogError(f"{source}: {key} is {value!r:.60}; write a finite number")
    return float(value)


def _numbers(value: Any, key: str, n: int, source: str, default: float) -> tuple[float, ...]:
    if value is None:
        return (default,) * n
    listed = value if isinstance(value, list) else [value] * n
    if len(listed) != n:
        raise LogError(f"{source} has {n} names and {len(listed)} of {key}; give one, or as many")
    return tuple(_number(x, key, source) for x in listed)
