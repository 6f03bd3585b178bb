"""Unknown parameters of an MJCF by mask, ``kind/name.field[index]``: places in MuJoCo's compiled model."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.errors import ModelError
from diransac.model.parameter import Parameter

if TYPE_CHECKING:
    from diransac.model.mjcf.description import SensorColumns


@dataclass(frozen=True)
class Field:
    """Field of an element, as masks name it.

    Parameters
    ----------
    arrays : tuple of (str, int, float)
        Arrays of MuJoCo's compiled model that hold it, each with the column of the first entry and a factor.
    unit : str
        Of a hinge where a slide has another.
    sign : str
        "positive", "non-negative", or "any".
    size : int, optional
        Number of entries that an index chooses from.
    of_slide : str, optional
        Unit where the joint is a slide.
    """

    arrays: tuple[tuple[str, int, float], ...]
    unit: str
    sign: str = "any"
    size: int = 1
    of_slide: str = ""


def _own(array: str, unit: str, sign: str = "any", size: int = 1, of_slide: str = "") -> Field:
    return Field(((array, 0, 1.0),), unit, sign, size, of_slide)


_CONTACT = {"solref": (2, "any"), "solimp": (5, "non-negative")}
FIELDS: dict[str, dict[str, Field]] = {
    "body": {
        "mass": _own("body_mass", "kg", "positive"),
        "ipos": _own("body_ipos", "m", size=3),
        "inertia": _own("body_inertia", "kg m^2", "positive", 3),
        "pos": _own("body_pos", "m", size=3),
        "gravcomp": _own("body_gravcomp", "1"),
    },
    "joint": {
        "armature": _own("dof_armature", "kg m^2", "non-negative", of_slide="kg"),
        "damping": _own("dof_damping", "N m s/rad", "non-negative", of_slide="N s/m"),
        "frictionloss": _own("dof_frictionloss", "N m", "non-negative", of_slide="N"),
        "stiffness": _own("jnt_stiffness", "N m/rad", "non-negative", of_slide="N/m"),
        "springref": _own("qpos_spring", "rad", of_slide="m"),
    },
    "geom": {
        "friction": _own("geom_friction", "1", "non-negative", 3),
        **{n: _own(f"geom_{n}", "1", sign, size) for n, (size, sign) in _CONTACT.items()},
    },
    "pair": {
        "friction": _own("pair_friction", "1", "non-negative", 5),
        **{n: _own(f"pair_{n}", "1", sign, size) for n, (size, sign) in _CONTACT.items()},
    },
    "actuator": {
        "gainprm": _own("actuator_gainprm", "1", size=10),
        "biasprm": _own("actuator_biasprm", "1", size=10),
        "dynprm": _own("actuator_dynprm", "1", "non-negative", size=10),
        "gear": _own("actuator_gear", "1", size=6),
        "kp": Field((("actuator_gainprm", 0, 1.0), ("actuator_biasprm", 1, -1.0)), "N m/rad", "non-negative"),
        "kv": Field((("actuator_biasprm", 2, -1.0),), "N m s/rad", "non-negative"),
    },
    "tendon": {
        "stiffness": _own("tendon_stiffness", "N/m", "non-negative"),
        "damping": _own("tendon_damping", "N s/m", "non-negative"),
        "frictionloss": _own("tendon_frictionloss", "N", "non-negative"),
    },
    "equality": {n: _own(f"eq_{n}", "1", sign, size) for n, (size, sign) in _CONTACT.items()},
    "site": {"pos": _own("site_pos", "m", size=3)},
    "sensor": {"bias": Field((), "")},
}
"""Fields that masks may name, by kind of element."""

ARRAYS = frozenset(array for fields in FIELDS.values() for x in fields.values() for array, _, _ in x.arrays)
"""Arrays of MuJoCo's compiled model that parameters may be entries of."""

_MASK = re.compile(r"(?P<each>each:)?(?P<kind>\w+)/(?P<name>[^\[\]]+)\.(?P<field>\w+)(?:\[(?P<index>\d+)\])?")


@dataclass(frozen=True)
class Place:
    """Entry of an array of MuJoCo's compiled model, which is a factor times the parameter.

    Parameters
    ----------
    array : str
    index : tuple of int
    factor : float, optional
    """

    array: str
    index: tuple[int, ...]
    factor: float = 1.0


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
    parts = _MASK.fullmatch(str(mask))
    if parts is None:
        raise ModelError(f'{label}: unknown names {mask!r:.60}; give masks such as "body/trunk.mass"')
    kind, pattern, each = parts["kind"], parts["name"], parts["each"] is not None
    fields = FIELDS.get(kind)
    if fields is None or parts["field"] not in fields:
        known = ", ".join(FIELDS if fields is None else fields)
        raise ModelError(f'{label}: "{mask}": there is no {kind}.{parts["field"]}; choose from {known}')
    field = fields[parts["field"]]
    if kind == "sensor":
        yield from _biases(label, sensors, mask, pattern)
        return
    names, array = _names(compiled, kind), field.arrays[0][0]
    own = [k for k in range(len(names)) if _rows(compiled, kind, array, k)]
    matches = [k for k in own if fnmatchcase(names[k], pattern)]
    if not matches:
        raise ModelError(
            f'{label}: "{mask}" matches nothing; {kind} names are {_listed([names[k] for k in own]) or "none"}'
        )
    index = None if parts["index"] is None else int(parts["index"])
    if index is not None and index >= field.size:
        raise ModelError(f'{label}: "{mask}" has the index {index}, but {parts["field"]} has {field.size} entries')
    for group in [[k] for k in matches] if each else [matches]:
        named = names[group[0]] if each else pattern
        for entry in range(field.size) if index is None else [index]:
            at = f"[{entry}]" if field.size > 1 else ""
            yield _unknown(compiled, (kind, f"{kind}/{named}.{parts['field']}{at}"), field, group, entry)


def _unknown(compiled: Any, named: tuple[str, str], field: Field, group: list[int], entry: int) -> Unknown:
    """The parameter of some elements of a kind, one entry of a field of theirs."""
    (kind, name), places = named, list[Place]()
    for array, column, factor in field.arrays:
        values = getattr(compiled, array)
        for k in group:
            for row in _rows(compiled, kind, array, k):
                at = (row,) if values.ndim == 1 else (row, column + entry)
                places.append(Place(array, at, factor))
    first = places[0]
    value = float(
        np.median([getattr(compiled, x.array)[x.index] / x.factor for x in places if x.factor == first.factor])
    )
    slides = kind == "joint" and all(compiled.jnt_type[k] == 2 for k in group)
    unit = field.of_slide if slides and field.of_slide else field.unit
    nominal = None if field.sign == "positive" and value <= 0.0 else value
    bounds = {"lower": 0.0} if field.sign == "non-negative" else {"positive": True} if field.sign == "positive" else {}
    elements = tuple((kind, _names(compiled, kind)[k]) for k in group)
    return Unknown(name, Parameter(unit, value=nominal, **bounds), tuple(places), elements)


def _rows(compiled: Any, kind: str, array: str, k: int) -> list[int]:
    """Rows of an array that belong to an element; several of a ball joint, none of a free joint and of the world."""
    if kind == "body" and k == 0:
        return []
    if kind != "joint" or array.startswith("jnt_"):
        return [k]
    n_dof = {0: 6, 1: 3}.get(int(compiled.jnt_type[k]), 1)
    if array == "qpos_spring":
        return [int(compiled.jnt_qposadr[k])] if n_dof == 1 else []
    first = int(compiled.jnt_dofadr[k])
    return list(range(first, first + n_dof)) if n_dof < 6 else []


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


def _names(compiled: Any, kind: str) -> list[str]:
    """Names of all elements of a kind."""
    counts = {"geom": "ngeom", "joint": "njnt", "body": "nbody", "actuator": "nactuator", "tendon": "ntendon"}
    counts |= {"pair": "npair", "equality": "neq", "site": "nsite"}
    if not hasattr(compiled, counts[kind]):  # before MuJoCo 4
        counts["actuator"] = "nu"
    return [getattr(compiled, kind)(k).name for k in range(getattr(compiled, counts[kind]))]


def _listed(names: Collection[str]) -> str:
    """The first few names."""
    some = [x for x in names if x]
    return ", ".join(some[:12]) + (", ..." if len(some) > 12 else "")
