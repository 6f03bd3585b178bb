"""A first guess of a mapping: which fields of a log are which signals of a model, by their names."""

from __future__ import annotations

import math
import re
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from diransac.data.mapping import Condition, MappedSignals
from diransac.data.mapping_file import BUILT_IN, load_mapping
from diransac.data.readers.recording import shortened
from diransac.data.units import conversion
from diransac.errors import LogError
from diransac.plain_data import toml_text
from diransac.plain_text import comment, literal, one_line
from diransac.text_table import some

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from diransac.model import Model

_STATES = frozenset(
    {"mode", "state", "status", "armed", "airborne", "landed", "flying", "enabled", "contact", "battery"}
)
"""Words of fields that may say when a stretch of a log counts."""
_WORD = re.compile(r"[a-z]+|\d+")
_ALIKE = {
    **dict.fromkeys(("pos", "position", "q", "angle", "pose"), "position"),
    **dict.fromkeys(("vel", "velocity", "dot", "speed", "rate", "v"), "velocity"),
    **dict.fromkeys(("acc", "accel", "acceleration", "accelerometer", "ddot"), "acceleration"),
    **dict.fromkeys(("torque", "effort", "tau", "moment"), "torque"),
    **dict.fromkeys(("gyro", "gyroscope", "angular"), "gyro"),
    **dict.fromkeys(("motor", "m", "rotor", "control"), "motor"),
    **dict.fromkeys(("force", "thrust", "f"), "force"),
}
_IGNORED = frozenset({"meas", "measured", "state", "msg", "vehicle", "s", "rad", "data"})


@dataclass(frozen=True)
class Coverage:
    """Sources of a model's signals in a log, returned by `suggest_mapping`; printed as lines.

    Parameters
    ----------
    model : str
        Name of the model.
    source : str
        Name of the log.
    entries : mapping of str to MappedSignals
        Signal -> the entry that would serve it.
    derivable : mapping of str to str
        Signal that the log lacks -> the signal that it is the derivative of.
    missing : mapping of str to tuple of str
        Signal -> fields whose names are the nearest, at most three.
    units : mapping of str to str
        Unit of each signal of the model.
    built_in : str, optional
        Built-in mapping that serves most of the signals.
    clock : str
        Line of the mapping file about the time.
    unused : mapping of str to tuple of str
        Topic -> its fields that serve no signal.
    """

    model: str
    source: str
    entries: Mapping[str, MappedSignals]
    derivable: Mapping[str, str]
    missing: Mapping[str, tuple[str, ...]]
    units: Mapping[str, str]
    built_in: str | None = None
    clock: str = ""
    unused: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Everything, ready for JSON."""
        sources = {name: _origin(entry, name) for name, entry in self.entries.items()}
        missing = {name: list(near) for name, near in self.missing.items()}
        about = {"model": self.model, "mapping": self.built_in}
        return {**about, "mapped": sources, "derivable": dict(self.derivable), "missing": missing}

    def __str__(self) -> str:
        by = f" (--mapping {self.built_in})" if self.built_in else ""
        lines = [f"for {self.model}{by}:"]
        lines += [f"  {name}: {_origin(entry, name)}" for name, entry in self.entries.items()]
        lines += [f"  {name}: from {source} with --differentiate" for name, source in self.derivable.items()]
        for name, near in self.missing.items():
            lines.append(f"  {name}: missing" + (f"; the nearest names are {', '.join(near)}" if near else ""))
        return "\n".join(map(one_line, lines))

    def toml(self) -> str:
        """The mapping as a commented file."""
        about = comment(f'A first guess for the model "{self.model}" from {self.source}, by the names of its fields.')
        start = f"# {about}\n"
        start += "# Check topics, units, signs and frames: value = sign * scale * field + offset.\n"
        start += self.clock
        start += '# resample = "median" # or a rate in Hz; without it the rows are those of the fastest topic\n'
        derived = ", ".join(self.derivable)
        start += f"differentiate = true # derives {derived}\n" if derived else ""
        parts = [start]
        parts += [_toml(entry, self.units) for entry in dict.fromkeys(self.entries.values())]
        for name, near in self.missing.items():
            listed = f"; the nearest names are {', '.join(near)}" if near else ""
            unit = self.units.get(name, "?")
            parts.append(
                f"# {comment(f'No field was found for {name} [{unit}]{listed}.')}\n"
                f'# [[signals]]\n# name = {literal(name)}\n# topic = ""\n# field = ""\n# unit = {literal(unit)}\n'
            )
        parts += self._event()
        if self.missing:
            rest = {topic: shortened(labels) for topic, labels in self.unused.items()}
            others = (f"Other fields{f' of {t}' * bool(t)}: {some(x, 60)}" for t, x in rest.items() if x)
            parts.append("".join(f"# {comment(line)}\n" for line in others))
        return "\n".join(part for part in parts if part)

    def _event(self) -> list[str]:
        """A commented event of the first field whose name is that of a state; none where there is no such field."""
        for topic, labels in self.unused.items():
            for label in labels:
                if _STATES & set(_WORD.findall(label.lower())):
                    place = f"# topic = {literal(topic)}\n" if topic else ""
                    return [
                        "# Stretches that count, by a field of the log; with while, all others are left out.\n"
                        f'# while = ["running"] # above [[signals]]\n# [[events]]\n# name = "running"\n{place}'
                        f"# where = {{ field = {literal(label)}, equals = 1 }}\n"
                    ]
        return []


def suggest_mapping(
    fields: Mapping[str, Sequence[str]], elements: Mapping[str, Sequence[str]], model: Model, source: str
) -> Coverage:
    """Sources of a model's signals among the fields of a log's topics.

    Parameters
    ----------
    fields : mapping of str to sequence of str
        Topic -> its fields; the topic of a table is empty.
    elements : mapping of str to sequence of str
        Topic -> names of the elements of its arrays, such as joints.
    model : Model
    source : str
        Name of the log.

    Returns
    -------
    Coverage

    Notes
    -----
    The built-in mapping that serves most of the signals is taken where it serves half of them.  Other signals are
    looked for by their names.
    """
    needed = _needed(model)
    built_in, entries = _built_in(fields, elements, needed)
    for name in needed:
        if name in entries:
            continue
        near = _nearest(name, fields)
        if near and near[0][0] >= 0.5 and near[0][1] not in _used(entries):
            entries[name] = _entry(name, *near[0][1], model.units.get(name, "?"))
    derivable, missing = dict[str, str](), dict[str, tuple[str, ...]]()
    for name in needed:
        if name in entries:
            continue
        parent = next((chain[chain.index(name) - 1] for chain in model.chains if name in chain[1:]), None)
        if parent is not None and (parent in entries or parent in derivable or parent in missing):
            derivable[name] = parent
        elif name not in model.accelerations:
            near = [x for x in _nearest(name, fields) if x[0] > 0.0][:3]
            missing[name] = tuple(f"{topic}.{label}" if topic else label for _, (topic, label) in near)
    ordered = {name: entries[name] for name in needed if name in entries}
    used = _used(ordered)
    unused = {topic: tuple(label for label in labels if (topic, label) not in used) for topic, labels in fields.items()}
    return Coverage(model.name, source, ordered, derivable, missing, model.units, built_in, _clock(fields), unused)


def _clock(fields: Mapping[str, Sequence[str]]) -> str:
    """Line about the time: the likeliest column of a table, or the choice that a recording has."""
    if list(fields) != [""]:
        return 'time = "header" # time of the sample; "message" for that of its recording\n'
    likely = next((x for x in fields[""] if x.lower().startswith(("t_", "time", "stamp"))), None)
    if likely is None:
        return '# time = { column = "t_ms", scale = 0.001 } # where it is not the column t, in seconds\n'
    factor = 0.001 if likely.lower().endswith(("_ms", "millis")) else 1.0
    return f"time = {{ column = {literal(likely)}, scale = {factor:g} }} # to seconds\n"


def _needed(model: Model) -> list[str]:
    """Signals and inputs of a model, accelerations last: they are seldom recorded."""
    unmeasured = set(model.first_order) - set(model.required_signals)
    state = [name for name in (*model.coordinates, *model.velocities) if name not in unmeasured]
    state = [name for name in state if name not in model.first_order]
    accelerations = [n for n in model.accelerations if n in model.required_signals and n[:-4] not in model.first_order]
    return [*state, *model.inputs, *model.sensors, *accelerations]


def _built_in(
    fields: Mapping[str, Sequence[str]], elements: Mapping[str, Sequence[str]], needed: Sequence[str]
) -> tuple[str | None, dict[str, MappedSignals]]:
    """The built-in mapping that serves most signals, and its entries; neither where it serves less than half."""
    best: tuple[str | None, dict[str, MappedSignals]] = (None, {})
    for name in BUILT_IN:
        with suppress(LogError):
            entries, _ = load_mapping(name).chosen(fields, elements, "log")
            served = {name: entry for entry in entries for name in entry.names if name in needed}
            best = (name, served) if len(served) > len(best[1]) else best
    return best if 2 * len(best[1]) >= len(needed) else (None, {})


def _entry(name: str, topic: str, label: str, unit: str) -> MappedSignals:
    """Entry of a field; in the model's unit where the field's name ends in a unit, as ``position_mm`` does."""
    factor = conversion(label.rsplit("_", 1)[1], unit) if "_" in label else None
    if factor is None:
        return MappedSignals((name,), (label,), topic)
    return MappedSignals((name,), (label,), topic, (unit,), (factor,))


def _used(entries: Mapping[str, MappedSignals]) -> set[tuple[str, str]]:
    """Topic and field of each source of some entries."""
    return {(entry.topic, label) for entry in entries.values() for label in entry.fields}


def _nearest(name: str, fields: Mapping[str, Sequence[str]]) -> list[tuple[float, tuple[str, str]]]:
    """Likeness, topic and field, the likeliest first."""
    wanted = _words(name)
    rated = []
    for topic, labels in fields.items():
        around = _words(topic)
        for label in labels:
            if label == name:
                rated.append((1.0, (topic, label)))
                continue
            own = _words(label)
            common = len(wanted & own) + 0.5 * len(wanted & around - own)
            rated.append((common / max(len(wanted | own), 1), (topic, label)))
    return sorted(rated, key=lambda x: (-x[0], len(x[1][1])))


def _words(text: str) -> frozenset[str]:
    """Words of a name, equal ones for what is called alike."""
    words = _WORD.findall(re.sub(r"([a-z])([A-Z])", r"\1_\2", text).lower())
    return frozenset(_ALIKE.get(word, word) for word in words if word not in _IGNORED)


def _origin(entry: MappedSignals, name: str) -> str:
    label = entry.fields[entry.names.index(name)]
    frame = f", {entry.frame}" if entry.frame else ""
    return (f"{entry.topic}.{label}" if entry.topic else label) + frame


def _toml_of_condition(condition: Condition) -> str:
    """A condition as TOML, without the limits that it does not have."""
    known = {key: x for key, x in vars(condition).items() if x not in (None, math.inf, -math.inf)}
    return "{ " + ", ".join(f"{key} = {toml_text(x)}" for key, x in known.items()) + " }"


def _toml(entry: MappedSignals, units: Mapping[str, str]) -> str:
    """One entry as TOML."""
    several = len(entry.names) > 1
    pick = list if several else next
    lines = ["[[signals]]", f"name = {toml_text(pick(iter(entry.names)))}"]
    lines += [f"topic = {literal(entry.topic)}"] if entry.topic else []
    lines.append(f"field = {toml_text(pick(iter(entry.fields)))}")
    for key, numbers, neutral in (("scale", entry.factors, 1.0), ("offset", entry.offsets, 0.0)):
        if any(x != neutral for x in numbers):
            lines.append(f"{key} = {toml_text(numbers[0] if len(set(numbers)) == 1 else list(numbers))}")
    if entry.frame is not None:
        lines += ['order = "wxyz"'] if len(entry.names) == 4 else []
        lines.append(f"frame = {literal(entry.frame)}")
    if entry.where:
        lines.append(f"where = [{', '.join(map(_toml_of_condition, entry.where))}]")
    known = entry.known_units()
    if known:
        lines.append(f"unit = {literal(next(iter(known.values())))}")
    else:
        unit = units.get(entry.names[0], "?")
        lines.append(f"unit = {literal(unit)} # what the model has; is it that of the log?")
    return "\n".join(lines) + "\n"
