"""A description's text that MuJoCo compiles to a given model, or a refusal by name.

MuJoCo's compiler changes what is written: by total masses, frames with a scale, damping ratios, degrees. So the text is
compiled, what differs from the given model is written, and so on until nothing differs.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import ModelError
from diransac.model.robots.compiled import compiled_file, mujoco_module
from diransac.model.robots.document import Document, Element, attributes, numbers
from diransac.model.robots.fields import (
    ACTUATORS,
    ARRAYS,
    FIELDS,
    INERTIALS,
    OF_ALL_ACTUATORS,
    RAW,
    Field,
    fields_of,
    names_of,
    places_of,
)

_ROUNDS = 6
"""Compilations of the text; each undoes one more effect of the compiler, of which few act on one number."""
_SAME, _SAME_DERIVED = 1e-9, 1e-5
"""Relative differences of what is the same: of what attributes hold; of what MuJoCo derives, such as principal axes, of
which versions before 4 find six digits."""
_OF_INERTIALS = ("settotalmass", "boundmass", "boundinertia", "balanceinertia")
"""Attributes of the compiler that change inertials."""
_URDF = {"damping": "damping", "frictionloss": "friction"}
"""Attributes of the dynamics of a joint in a URDF, by those of a joint in an MJCF."""
_COMMON = (
    "name", "class", "group", "cranklength", "joint", "jointinparent", "tendon", "slidersite", "cranksite", "site",
    "refsite", "body", "user", "actdim", "nsample", "interp", "delay", "input", "velrange", "ffrange",
)  # fmt: skip
"""Attributes that a general actuator takes over as they are; it has the others by their values."""

Entry = tuple[str, tuple[int, ...]]
"""Array of a compiled model, and index in it."""


def refresh(compiled: Any) -> None:
    """Bring what MuJoCo derives up to date after entries of a compiled model were written.

    It takes no shortcuts through inertias that are aligned, as those of the file may be.
    """
    compiled.body_sameframe[:], compiled.body_simple[:], compiled.dof_simplenum[:] = 0, 0, 0
    mujoco_module().mj_setConst(compiled, mujoco_module().MjData(compiled))


def differences(meant: Any, found: Any) -> dict[Entry, tuple[float, float]]:
    """Entries of two compiled models that differ, with the values of both.

    All arrays of real numbers are compared, and of those of integers the types of elements: other integers number and
    order elements, which the text does not change.  An inertia is compared in the axes of the body's frame, entries
    xx yy zz xy xz yz of ``body_inertia``, because principal axes have no order; bounding volumes, which are in these
    axes, are left out.

    Parameters
    ----------
    meant, found : mujoco.MjModel

    Raises
    ------
    ValueError
        An array has another shape.
    """
    off, theirs = dict[Entry, tuple[float, float]](), _arrays(found)
    for name, own in _arrays(meant).items():
        other = theirs[name]
        if own.shape != other.shape:
            raise ValueError(f"{name} has the shape {other.shape} in place of {own.shape}")
        size = np.abs(own) + np.abs(other) + 1e-9 * np.abs(own).max(initial=0.0)
        if name == "body_inertia":  # entries beside the diagonal are as exact as those on it
            size = size.max(axis=1, keepdims=True)
        same = _SAME if name in ARRAYS - {"body_inertia"} else _SAME_DERIVED
        for at in np.argwhere(~((np.abs(own - other) <= same * size) | (own == other))):
            index = tuple(at.tolist())
            off[name, index] = float(own[index]), float(other[index])
    return off


def _arrays(compiled: Any) -> dict[str, FloatArray]:
    """Arrays that are compared."""
    found = dict[str, FloatArray]()
    for name in dir(compiled):
        values = None if name.startswith(("_", "bvh_")) else getattr(compiled, name)
        if isinstance(values, np.ndarray) and (values.dtype.kind == "f" or name.endswith("type")):
            found[name] = values.astype(float)
    del found["body_iquat"]
    found["body_inertia"] = np.array([_tensor(compiled, k) for k in range(compiled.nbody)])
    return found


def _tensor(compiled: Any, k: int) -> FloatArray:
    """Inertia of a body about its centre of mass, xx yy zz xy xz yz in the axes of its frame."""
    turn = np.empty(9)
    mujoco_module().mju_quat2Mat(turn, compiled.body_iquat[k])
    axes = turn.reshape(3, 3)
    inertia = axes * compiled.body_inertia[k] @ axes.T
    return np.array([*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]])


def written(
    path: str | Path, document: Document, meant: Any, *, bare: bool = False, repaired: Collection[int] = ()
) -> str:
    """Text of a description that MuJoCo compiles to a model.

    Parameters
    ----------
    path : str or Path
        Of the description, in whose folder other files are found.
    document : Document
        Its text; it is changed.
    meant : mujoco.MjModel
        What `compiled_file` makes of the description, with other values; `refresh` was called.
    bare : bool, optional
        Without shapes, as in `compiled_file`.
    repaired : collection of int, optional
        Indices of bodies whose inertia in the file is impossible, in MuJoCo's order; theirs are written.

    Raises
    ------
    ModelError
        An element is in another file; or the text compiles to other values whatever is written: it names the first.
    """
    writer = _Writer(document, meant)
    for k in repaired:
        writer.write_inertial(k, meant)
    for _ in range(_ROUNDS):
        text = document.text()
        found = compiled_file(path, text, bare=bare)
        refresh(found)
        try:
            off = differences(meant, found)
        except ValueError as error:
            raise ModelError(f"{document.label} with the estimates in it has other elements: {error}") from error
        if not off:
            return text
        writer.write(off, found)
    raise writer.refusal(off)


def with_inertials(document: Document, compiled: Any) -> str:
    """Text of a description with the inertials of its compiled model in it, which its compiler does not change."""
    writer = _Writer(document, compiled)
    writer.release_inertials()
    for k in writer.massive:
        writer.write_inertial(k, compiled)
    return document.text()


class _Writer:
    """Changes of a text, by entries of the model that it is to compile to.

    Parameters
    ----------
    document : Document
    meant : mujoco.MjModel
    """

    def __init__(self, document: Document, meant: Any) -> None:
        self.document, self.meant = document, meant
        self.names = {kind: names_of(meant, kind) for kind in (*FIELDS, "actuator")}
        self.massive = [k for k in range(1, meant.nbody) if meant.body_mass[k] > 0.0]
        self.numbers = dict[tuple[str, int, str], list[FloatArray]]()  # so far, by kind, index and attribute

    def write(self, off: Collection[Entry], found: Any) -> None:
        """Write what differs, and take out what undoes it.  Raises ModelError: an element is not in the text."""
        bodies = sorted({at[0] for array, at in off if array in INERTIALS})
        if any(("body", k, "inertial") in self.numbers for k in bodies) and self.release_inertials():
            bodies = self.massive
        for k in bodies:
            self.write_inertial(k, found)
        for kind, k, own in self._elements(off):
            fields = self._fields(kind, k)
            chosen = [name for name, x in fields.items() if own & self._entries(kind, k, x)]
            if kind == "actuator" and not self._takes(k, own, [fields[name] for name in chosen]):
                self._write_general(k)
                continue
            self._write_fields(kind, k, chosen, found)

    def refusal(self, off: Mapping[Entry, tuple[float, float]]) -> ModelError:
        """Error that names the first difference, of what is written if there is one."""
        entry = next((x for x in off if x[0] in ARRAYS), next(iter(off)))
        meant, found = off[entry]
        return ModelError(
            f"{self.document.label}: {self._said(entry)} is to be {meant:.6g}, but MuJoCo compiles what is written to "
            f"{found:.6g}, as a frame or an attribute of its compiler has it; leave that out"
        )

    def _said(self, entry: Entry) -> str:
        """Field and element of an entry."""
        if entry[0] in INERTIALS:
            return f'{entry[0].removeprefix("body_")} of body "{self.names["body"][entry[1][0]] or entry[1][0]}"'
        for kind, k, _ in self._elements([entry]):
            fields = fields_of(self.meant, kind, k)
            name = next((n for n, x in fields.items() if entry in self._entries(kind, k, x)), entry[0])
            return f'{name} of {kind} "{self.names[kind][k] or k}"'
        return f"{entry[0]}[{', '.join(map(str, entry[1]))}]"

    # ------------------------------------------------------------------ elements

    def _elements(self, off: Collection[Entry]) -> Iterator[tuple[str, int, set[Entry]]]:
        """Elements that have entries in attributes, with these entries."""
        for kind, names in self.names.items():
            arrays = {x for x in ARRAYS if x.startswith("actuator_") == (kind == "actuator")}
            own = {x for x in off if x[0] in arrays}
            for k in range(len(names)) if own else ():
                fields = fields_of(self.meant, kind, k).values()
                if mine := own & {x for field in fields for x in self._entries(kind, k, field)}:
                    yield kind, k, mine

    def _entries(self, kind: str, k: int, field: Field) -> set[Entry]:
        """Entries that an attribute of an element holds."""
        every = (*field.numbers, *field.tail)
        return {(x.array, x.index) for number in every for x in places_of(self.meant, kind, k, number)}

    def _element(self, kind: str, k: int) -> Element:
        return self.document.element(kind, k, self.names[kind][k], len(self.names[kind]))

    def _fields(self, kind: str, k: int) -> Mapping[str, Field]:
        """Attributes that an element of the text may have."""
        if kind != "actuator":
            return {n: x for n, x in FIELDS[kind].items() if not x.arrays & INERTIALS}
        tag = self._element(kind, k).tag
        return {**ACTUATORS.get(tag, {}), **OF_ALL_ACTUATORS, **(RAW if tag == "general" else {})}

    # ------------------------------------------------------------------ attributes

    def _write_fields(self, kind: str, k: int, chosen: Collection[str], found: Any) -> None:
        """Write attributes, and with them those that stand in place of the same other one."""
        element, fields = self._element(kind, k), self._fields(kind, k)
        for other in {fields[name].replaces for name in chosen} - {""}:
            if other in element.attributes or (other == "springdamper" and other.encode() in self.document.source):
                element.changes[other] = "0 0" if other == "springdamper" else None  # a class may have it
                chosen = [n for n, x in fields.items() if n in chosen or x.replaces == other]
        for name in chosen:
            meant, compiled = (self._values(x, kind, k, fields[name]) for x in (self.meant, found))
            new = self._next((kind, k, name), meant, compiled).tolist()
            while len(new) > len(fields[name].numbers) and new[-1] == 0.0:
                new.pop()
            if not self.document.is_urdf:
                element.changes[name] = numbers(new)
            elif name in _URDF:
                element.child("dynamics").changes[_URDF[name]] = numbers(new)
            else:
                raise ModelError(f"{self.document.label} is a URDF, which has no place for {name} of a {kind}")

    def _values(self, compiled: Any, kind: str, k: int, field: Field) -> FloatArray:
        """Numbers of an attribute."""
        found = list[float]()
        for number in (*field.numbers, *field.tail):
            places = places_of(self.meant, kind, k, number)
            found += [float(getattr(compiled, x.array)[x.index]) / x.factor for x in places[:1]]
            found += [0.0] if number.instead else []
        return np.array(found)

    def _next(self, key: tuple[str, int, str], meant: FloatArray, found: FloatArray) -> FloatArray:
        """Numbers to write: those that are meant, and then times what compiling divides them by."""
        before = self.numbers.setdefault(key, [])
        new = meant
        if before:
            new = before[-1] * np.divide(meant, found, out=np.ones_like(meant), where=found != 0.0)
        before.append(new)
        return new

    # ------------------------------------------------------------------ inertials

    def write_inertial(self, k: int, found: Any) -> None:
        """Write the inertial of a body."""
        element, meant = self._element("body", k), _inertial_numbers(self.meant, k)
        mass, centre, inertia = np.split(
            self._next(("body", k, "inertial"), meant, _inertial_numbers(found, k)), [1, 4]
        )
        if self.document.is_urdf:
            element.child("inertial").replacement = _urdf_inertial(mass, centre, _tensor(self.meant, k))
            return
        turned = not np.allclose(self.meant.body_iquat[k], [1.0, 0.0, 0.0, 0.0], rtol=0.0, atol=1e-12)
        texts = {"pos": numbers(centre)} | ({"quat": numbers(self.meant.body_iquat[k])} if turned else {})
        texts |= {"mass": numbers(mass), "diaginertia": numbers(inertia)}
        element.child("inertial").replacement = f"<inertial {attributes(texts)}/>"

    def release_inertials(self) -> bool:
        """Take out what changes inertials as they are compiled; return whether there was such a thing."""
        changes = dict[str, str | None].fromkeys(_OF_INERTIALS) | {"inertiafromgeom": "auto"}
        released = False
        for element in self.document.tagged("compiler"):
            own = {key: text for key, text in changes.items() if key in element.attributes}
            released |= bool(own) and not element.changes
            element.changes |= own
        if released:
            self.numbers = {key: x for key, x in self.numbers.items() if key[0] != "body"}
        return released

    # ------------------------------------------------------------------ actuators

    def _takes(self, k: int, own: set[Entry], fields: Collection[Field]) -> bool:
        """True if attributes of an actuator have entries to themselves, and hold those that differ."""
        held = {x for field in fields for x in self._entries("actuator", k, field)}
        if self._element("actuator", k).replacement is not None or not own <= held:
            return False
        for number in (x for field in fields for x in field.numbers):
            places = places_of(self.meant, "actuator", k, number)
            if len({float(getattr(self.meant, x.array)[x.index]) / x.factor for x in places}) > 1:
                return False
        return True

    def _write_general(self, k: int) -> None:
        """Write an actuator of any kind as a general one with all that MuJoCo has made of it."""
        mujoco, compiled, element = mujoco_module(), self.meant, self._element("actuator", k)
        texts = {key: text for key, text in element.attributes.items() if key in _COMMON}
        for name, field in OF_ALL_ACTUATORS.items():
            values = self._values(compiled, "actuator", k, field)
            if values.any() or name in element.attributes:
                texts[name] = numbers(values)
        if compiled.actuator_actearly[k]:
            texts["actearly"] = "true"
        for key, enum in (("dyn", mujoco.mjtDyn), ("gain", mujoco.mjtGain), ("bias", mujoco.mjtBias)):
            kind = enum(int(getattr(compiled, f"actuator_{key}type")[k])).name.rpartition("_")[2].lower()
            texts |= {f"{key}type": kind, f"{key}prm": numbers(getattr(compiled, f"actuator_{key}prm")[k])}
        for key in ("ctrl", "force", "act"):
            limited, limits = (np.ravel(getattr(compiled.actuator(k), f"{key}{x}")) for x in ("limited", "range"))
            texts[f"{key}limited"] = str(bool(limited[0])).lower()
            texts |= {f"{key}range": numbers(limits[:2])} if limited[0] else {}
        element.replacement = f"<general {attributes(texts)}/>"


def _inertial_numbers(compiled: Any, k: int) -> FloatArray:
    """Mass, centre, and principal inertias of a body ``(7,)``."""
    return np.array([compiled.body_mass[k], *compiled.body_ipos[k], *compiled.body_inertia[k]])


def _urdf_inertial(mass: FloatArray, centre: FloatArray, inertia: FloatArray) -> str:
    """Element of a link, with the inertia about the centre of mass, xx yy zz xy xz yz."""
    entries = zip(("ixx", "iyy", "izz", "ixy", "ixz", "iyz"), inertia.tolist(), strict=True)
    return (
        f'<inertial><origin xyz="{numbers(centre)}" rpy="0 0 0"/><mass value="{numbers(mass)}"/>'
        f"<inertia {attributes({key: repr(x) for key, x in entries})}/></inertial>"
    )
