"""Unknown parameters of an MJCF by mask, ``kind/name.field[index]``: places in MuJoCo's compiled model."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.errors import ModelError
from diransac.model.parameter import Parameter
from diransac.model.robots.fields import FIELDS, REPLACED, fields_of, kind_of_actuator, names_of, places_of, rows

if TYPE_CHECKING:
    from diransac.model.mjcf.description import SensorColumns
    from diransac.model.robots.fields import Field, Number, Place


_MASK = re.compile(r"(?P<each>each:)?(?P<kind>\w+)/(?P<name>[^\[\]]+)\.(?P<field>\w+)(?:\[(?P<index>\d+)\])?")


@dataclass(frozen=True)
class Unknown:
    """A parameter of an MJCF.

    Parameters
    ----------
    name : str
        Its mask; of one of several matches or entries, with the element's own name and the index.
    parameter : Parameter
        Unit, bounds, and the file's value.
    places : tuple of Place, optional
        Entries that have its value.
    elements : tuple of (str, str), optional
        Kind and name of the elements.
    columns : tuple of str, optional
        Readings of sensors of which it is the bias.
    """

    name: str
    parameter: Parameter
    places: tuple[Place, ...] = ()
    elements: tuple[tuple[str, str], ...] = ()
    columns: tuple[str, ...] = ()

    @property
    def field(self) -> str:
        """Field that it is an entry of."""
        found = _MASK.fullmatch(self.name)
        assert found is not None
        return found["field"]

    @property
    def index(self) -> int:
        """Index of it in the field."""
        found = _MASK.fullmatch(self.name)
        assert found is not None
        return int(found["index"] or 0)


def unknowns_of(
    label: str, compiled: Any, sensors: Collection[SensorColumns], masks: Collection[str]
) -> tuple[Unknown, ...]:
    """Parameters that masks name.

    Parameters
    ----------
    label : str
        Of the model in messages.
    compiled : mujoco.MjModel
    sensors : collection of SensorColumns
        Sensors that have readings.
    masks : collection of str

    Raises
    ------
    ModelError
        A mask is none, its kind or field is unknown, nothing in the file has such a name, or two masks name one entry.
    """
    found = [x for mask in masks for x in _of_mask(label, compiled, sensors, mask)]
    if not found:
        raise ModelError(f'{label}: nothing is unknown; give unknown=["body/trunk.mass", "joint/*.damping"]')
    taken = dict[object, str]()
    for one in found:
        for place in (*((x.array, x.index) for x in one.places), *one.columns):
            if place in taken:
                raise ModelError(f'{label}: "{one.name}" and "{taken[place]}" are the same; give one of them')
            taken[place] = one.name
    return tuple(found)


def _of_mask(label: str, compiled: Any, sensors: Collection[SensorColumns], mask: str) -> Iterator[Unknown]:
    """Parameters of one mask."""
    parts, said = _MASK.fullmatch(str(mask)), f'{label}: "{mask}"'
    if parts is None:
        raise ModelError(f'{label}: unknown names {mask!r:.60}; give masks such as "body/trunk.mass"')
    kind, pattern, name, each = parts["kind"], parts["name"], parts["field"], parts["each"] is not None
    if kind == "sensor" and name == "bias":
        yield from _biases(label, sensors, mask, pattern)
        return
    fields = _fields(said, compiled, kind, pattern, name)
    size = max(len(x.numbers) for x in fields.values())
    indices = range(size) if parts["index"] is None else [int(parts["index"])]
    if indices[-1] >= size:
        raise ModelError(f"{said} has the index {indices[-1]}, but {name} has {size} entries")
    reasons = list[str]()
    for index in indices:
        held = {k: x.numbers[index] for k, x in fields.items() if index < len(x.numbers)}
        reasons += [_absence(compiled, k, x) for k, x in held.items()]
        present = {k: x for k, x in held.items() if not _absence(compiled, k, x)}
        for group in [{k: x} for k, x in present.items()] if each else [present] if present else []:
            named = names_of(compiled, kind)[next(iter(group))] if each else pattern
            at = f"[{index}]" if size > 1 else ""
            yield _unknown(compiled, kind, f"{kind}/{named}.{name}{at}", group)
    if all(reasons):
        raise ModelError(f"{said}: {reasons[0]}")


def _fields(said: str, compiled: Any, kind: str, pattern: str, name: str) -> dict[int, Field]:
    """A field of the elements that a pattern matches, by index.  Raises ModelError: there is none."""
    kinds = (*FIELDS, "actuator", "sensor")
    if kind not in kinds or (kind != "actuator" and name not in FIELDS.get(kind, ())):
        choice = ", ".join(FIELDS.get(kind, ["bias"]) if kind in kinds else kinds)
        raise ModelError(f"{said}: there is no {kind}.{name}; choose from {choice}")
    names = names_of(compiled, kind)
    every = {k: fields_of(compiled, kind, k) for k in range(len(names))}
    if kind != "actuator":
        (array, *_), *_ = FIELDS[kind][name].numbers[0].places
        every = {k: x for k, x in every.items() if rows(compiled, kind, array, k)}
    matches = {k: x for k, x in every.items() if fnmatchcase(names[k], pattern)}
    if not matches:
        raise ModelError(f"{said} matches nothing; {kind} names are {_listed([names[k] for k in every]) or 'none'}")
    if found := {k: x[name] for k, x in matches.items() if name in x}:
        return found
    k, fields = next(iter(matches.items()))
    choice = ", ".join(n for n, x in fields.items() if not all(_absence(compiled, k, e) for e in x.numbers))
    advice = f"give {REPLACED[name]}" if name in REPLACED else f"choose from {choice}"
    its_kind = kind_of_actuator(compiled, k)
    raise ModelError(f'{said}: there is no {kind}.{name} of "{names[k]}", of the kind {its_kind}; {advice}')


def _absence(compiled: Any, k: int, number: Number) -> str:
    """Reason why a number of an element cannot be identified; empty where it can."""
    if number.instead:
        return f"the compiled model has no such entry; give {number.instead}"
    if number.switch is not None:
        array, column = number.switch
        if not np.atleast_1d(getattr(compiled, array)[k])[column]:
            return "the file has 0 there, by which MuJoCo leaves it out; give it a first value in the file"
    return ""


def _unknown(compiled: Any, kind: str, name: str, group: Mapping[int, Number]) -> Unknown:
    """The parameter of some elements of a kind, an entry of a field of each."""
    number, places = next(iter(group.values())), [x for k, n in group.items() for x in places_of(compiled, kind, k, n)]
    value = float(np.median([getattr(compiled, x.array)[x.index] / x.factor for x in places]))
    slides = kind == "joint" and all(compiled.jnt_type[k] == 2 for k in group)
    unit = number.of_slide if slides and number.of_slide else number.unit
    nominal = None if number.sign == "positive" and value <= 0.0 else value
    bounds = (
        {"lower": 0.0} if number.sign == "non-negative" else {"positive": True} if number.sign == "positive" else {}
    )
    elements = tuple((kind, names_of(compiled, kind)[k]) for k in group)
    return Unknown(name, Parameter(unit, value=nominal, **bounds), tuple(places), elements)


def _biases(label: str, sensors: Collection[SensorColumns], mask: str, pattern: str) -> Iterator[Unknown]:
    """Constant errors of readings, one for each axis of a sensor."""
    found = [x for x in sensors if fnmatchcase(x.name, pattern)]
    if not found:
        names = _listed([x.name for x in sensors])
        raise ModelError(f'{label}: "{mask}" matches nothing; sensors with readings of their own are {names or "none"}')
    for one in found:
        for k, column in enumerate(one.columns):
            at = f"[{k}]" if len(one.columns) > 1 else ""
            name = f"sensor/{one.name}.bias{at}"
            yield Unknown(name, Parameter(one.unit, value=0.0), (), (("sensor", one.name),), (column,))


def _listed(names: Collection[str]) -> str:
    """The first few names."""
    some = [x for x in names if x]
    return ", ".join(some[:12]) + (", ..." if len(some) > 12 else "")
