"""Fields of a description's elements: which entries of MuJoCo's compiled model their attributes hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from diransac.model.robots.compiled import mujoco_module


@dataclass(frozen=True)
class Number:
    """A number of an attribute.

    Parameters
    ----------
    places : tuple of (str, int, float)
        Arrays of MuJoCo's compiled model that hold it, each with the column and a factor.
    unit : str
        Of a hinge where a slide has another.
    sign : str
        "positive", "non-negative", or "any".
    of_slide : str, optional
        Unit where the joint is a slide.
    switch : tuple of (str, int), optional
        Array and column that are zero where the file leaves this number's effect out, so that no value of it has any.
    instead : str, optional
        What holds its effect, where no entry is proportional to it.
    """

    places: tuple[tuple[str, int, float], ...]
    unit: str = "1"
    sign: str = "any"
    of_slide: str = ""
    switch: tuple[str, int] | None = None
    instead: str = ""


@dataclass(frozen=True)
class Place:
    """Number of an array of MuJoCo's compiled model, which is a factor times the number.

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
class Field:
    """An attribute.

    Parameters
    ----------
    numbers : tuple of Number
        Its numbers, as masks choose them.
    tail : tuple of Number, optional
        Further numbers of it, as of a polynomial.
    replaces : str, optional
        Another attribute from which the compiler makes the same entries.
    """

    numbers: tuple[Number, ...]
    tail: tuple[Number, ...] = ()
    replaces: str = ""

    @property
    def arrays(self) -> frozenset[str]:
        """Arrays that hold it."""
        return frozenset(array for x in (*self.numbers, *self.tail) for array, _, _ in x.places)


def own(array: str, unit: str, sign: str = "any", size: int = 1, of_slide: str = "") -> Field:
    """Field that is the first entries of a row of an array."""
    return Field(tuple(Number(((array, k, 1.0),), unit, sign, of_slide) for k in range(size)))


def polynomial(array: str, unit: str, of_slide: str = "", replaces: str = "") -> Field:
    """Field that is the first coefficient of a polynomial, with the others behind it (MuJoCo 3.7)."""
    first = Number(((array, 0, 1.0),), unit, "non-negative", of_slide)
    return Field((first,), tuple(Number(((f"{array}poly", k, 1.0),)) for k in range(2)), replaces)


_CONTACT = {"solref": (2, "any"), "solimp": (5, "non-negative")}
FIELDS: Mapping[str, Mapping[str, Field]] = {
    "body": {
        "mass": own("body_mass", "kg", "positive"),
        "ipos": own("body_ipos", "m", size=3),
        "inertia": own("body_inertia", "kg m^2", "positive", 3),
        "pos": own("body_pos", "m", size=3),
        "gravcomp": own("body_gravcomp", "1"),
    },
    "joint": {
        "armature": own("dof_armature", "kg m^2", "non-negative", of_slide="kg"),
        "damping": polynomial("dof_damping", "N m s/rad", "N s/m", "springdamper"),
        "frictionloss": own("dof_frictionloss", "N m", "non-negative", of_slide="N"),
        "stiffness": polynomial("jnt_stiffness", "N m/rad", "N/m", "springdamper"),
        "springref": own("qpos_spring", "rad", of_slide="m"),
    },
    "geom": {
        "friction": own("geom_friction", "1", "non-negative", 3),
        **{n: own(f"geom_{n}", "1", sign, size) for n, (size, sign) in _CONTACT.items()},
    },
    "pair": {
        "friction": own("pair_friction", "1", "non-negative", 5),
        **{n: own(f"pair_{n}", "1", sign, size) for n, (size, sign) in _CONTACT.items()},
    },
    "tendon": {
        "stiffness": polynomial("tendon_stiffness", "N/m"),
        "damping": polynomial("tendon_damping", "N s/m"),
        "frictionloss": own("tendon_frictionloss", "N", "non-negative"),
    },
    "equality": {n: own(f"eq_{n}", "1", sign, size) for n, (size, sign) in _CONTACT.items()},
    "site": {"pos": own("site_pos", "m", size=3)},
}
"""Fields by kind of element, of actuators besides."""


# ---------------------------------------------------------------------- actuators


def _parameters(array: str, column: int, unit: str, sign: str = "non-negative", **more: Any) -> Number:
    return Number(((f"actuator_{array}prm", column, 1.0),), unit, sign, **more)


def _damping_of_drive(column: int = 2) -> Number:
    return Number((("actuator_biasprm", column, -1.0),), "N m s/rad", "non-negative")


_KV = Field((_damping_of_drive(),), replaces="dampratio")
_STIFFNESS = Field((Number((("actuator_gainprm", 0, 1.0), ("actuator_biasprm", 1, -1.0)), "N m/rad", "non-negative"),))
_TIME = Field((_parameters("dyn", 0, "s", switch=("actuator_dyntype", 0)),))
_MUSCLE = {"force": "N", "scale": "N m/s^2", "lmin": "1", "lmax": "1", "vmax": "1/s", "fpmax": "1", "fvmax": "1"}


def _of_muscle(column: int, unit: str) -> Number:
    return Number((("actuator_gainprm", column, 1.0), ("actuator_biasprm", column, 1.0)), unit)


_BRISTLES = ("actuator_dynprm", 5)
_WINDING = ("actuator_dynprm", 2)
ACTUATORS: Mapping[str, Mapping[str, Field]] = {
    "general": {},
    "motor": {},
    "position": {"kp": _STIFFNESS, "kv": _KV, "timeconst": _TIME},
    "intvelocity": {"kp": _STIFFNESS, "kv": _KV},
    "orientation": {"kp": _STIFFNESS, "kv": _KV},
    "velocity": {
        "kv": Field(
            (Number((("actuator_gainprm", 0, 1.0), ("actuator_biasprm", 2, -1.0)), "N m s/rad", "non-negative"),)
        ),
    },
    "damper": {"kv": Field((Number((("actuator_gainprm", 2, -1.0),), "N m s/rad", "non-negative"),))},
    "cylinder": {
        "timeconst": _TIME,
        "area": Field((_parameters("gain", 0, "m^2"),), replaces="diameter"),
        "bias": own("actuator_biasprm", "1", size=3),
    },
    "adhesion": {"gain": Field((_parameters("gain", 0, "N"),))},
    "muscle": {
        "timeconst": Field(tuple(_parameters("dyn", k, "s") for k in range(2))),
        "tausmooth": Field((_parameters("dyn", 2, "1"),)),
        "range": Field(tuple(_of_muscle(k, "1") for k in range(2))),
        **{name: Field((_of_muscle(2 + k, unit),)) for k, (name, unit) in enumerate(_MUSCLE.items())},
    },
    "pid": {
        "kp": Field((Number((("actuator_biasprm", 1, -1.0),), "N m/rad", "non-negative"),)),
        "kv": _KV,
        "ki": Field((_parameters("gain", 0, "N m/(rad s)", switch=("actuator_gainprm", 0)),)),
        "imax": Field((_parameters("dyn", 0, "rad s", switch=("actuator_gainprm", 0)),)),
        "slewmax": Field((_parameters("dyn", 1, "rad/s", switch=("actuator_dynprm", 1)),)),
    },
    "dcmotor": {
        "motorconst": Field((_parameters("gain", 1, "N m/A"),), replaces="nominal"),
        "resistance": Field((_parameters("gain", 0, "Ohm", "positive"),), replaces="nominal"),
        "inductance": Field(
            (
                Number((), instead="inductance[1], its time constant"),
                _parameters("dyn", 0, "s", "positive", switch=("actuator_dynprm", 0)),
            )
        ),
        "thermal": Field(
            (
                _parameters("dyn", 2, "K/W", "positive", switch=_WINDING),
                _parameters("dyn", 3, "J/K", "positive", switch=_WINDING),
                Number((), instead="thermal[0] and thermal[1], whose product it is"),
                _parameters("gain", 2, "1/K", "any", switch=_WINDING),
                _parameters("gain", 3, "degC", "any", switch=_WINDING),
                _parameters("dyn", 4, "degC", "any", switch=_WINDING),
            )
        ),
        "saturation": Field(
            (
                Number(
                    (("actuator_forcerange", 1, 1.0), ("actuator_forcerange", 0, -1.0)),
                    "N m",
                    "positive",
                    switch=("actuator_forcelimited", 0),
                ),
                Number((), instead="saturation[0], its torque"),
                _parameters("dyn", 1, "A/s", switch=("actuator_dynprm", 1)),
            )
        ),
        "cogging": Field(
            (_parameters("bias", 0, "N m", "any"), _parameters("bias", 1, "1"), _parameters("bias", 2, "rad", "any"))
        ),
        "lugre": Field(
            (
                _parameters("dyn", 5, "N m/rad", "positive", switch=_BRISTLES),
                _parameters("dyn", 6, "N m s/rad", switch=_BRISTLES),
                _parameters("bias", 3, "N m", switch=_BRISTLES),
                _parameters("bias", 4, "N m", switch=_BRISTLES),
                _parameters("bias", 5, "rad/s", "positive", switch=_BRISTLES),
            )
        ),
        "controller": Field(
            (
                _parameters("gain", 4, "N m/rad"),
                _parameters("gain", 5, "N m/(rad s)", switch=("actuator_gainprm", 5)),
                _parameters("gain", 6, "N m s/rad"),
                _parameters("dyn", 7, "rad/s", switch=("actuator_dynprm", 7)),
                _parameters("dyn", 8, "rad s", switch=("actuator_gainprm", 5)),
                _parameters("gain", 7, "V"),
            )
        ),
    },
}
"""Attributes of each kind of actuator besides those of all kinds."""
OF_ALL_ACTUATORS: Mapping[str, Field] = {
    "gear": own("actuator_gear", "1", size=6),
    "armature": own("actuator_armature", "kg m^2", "non-negative"),
    "damping": polynomial("actuator_damping", "N m s/rad"),
    "lengthrange": own("actuator_lengthrange", "m", size=2),
}
"""Attributes of all kinds; armature and damping are behind the gear, by its square, since MuJoCo 3.7."""
RAW: Mapping[str, Field] = {
    "gainprm": own("actuator_gainprm", "1", size=10),
    "biasprm": own("actuator_biasprm", "1", size=10),
    "dynprm": own("actuator_dynprm", "1", "non-negative", size=10),
}
"""Entries of MuJoCo's compiled model as they are, which a general actuator has as attributes."""
REPLACED = {
    "dampratio": "kv, which MuJoCo's compiler makes of it and of the masses",
    "nominal": "motorconst and resistance, which MuJoCo's compiler makes of it",
    "diameter": "area, which MuJoCo's compiler makes of it",
}
"""Attributes of actuators to which no entry is proportional, and the names to give in their place."""

ARRAYS = frozenset(
    array
    for fields in (*FIELDS.values(), *ACTUATORS.values(), OF_ALL_ACTUATORS, RAW)
    for x in fields.values()
    for array in x.arrays
)
"""Arrays of MuJoCo's compiled model that parameters may be entries of."""

INERTIALS = frozenset({"body_mass", "body_ipos", "body_inertia"})
"""Arrays that the inertial of a body gives."""


def kind_of_actuator(compiled: Any, k: int) -> str:
    """Kind of an actuator by what MuJoCo has made of it: that of the file, or of a general actuator that equals it."""
    mujoco = mujoco_module()
    gain, bias, dynamics = (
        enum(int(getattr(compiled, f"actuator_{part}type")[k])).name.rpartition("_")[2]
        for part, enum in (("gain", mujoco.mjtGain), ("bias", mujoco.mjtBias), ("dyn", mujoco.mjtDyn))
    )
    if own_kind := {"DCMOTOR": "dcmotor", "PID": "pid", "SO3": "orientation", "MUSCLE": "muscle"}.get(gain):
        return own_kind
    factor, force = compiled.actuator_gainprm[k], compiled.actuator_biasprm[k]
    if gain == "AFFINE" and bias == "NONE" and not factor[:2].any():
        return "damper"
    if gain == "FIXED" and bias == "NONE":
        is_adhesion = compiled.actuator_trntype[k] == mujoco.mjtTrn.mjTRN_BODY
        return "adhesion" if is_adhesion else "motor" if dynamics == "NONE" else "general"
    if gain != "FIXED" or bias != "AFFINE":
        return "general"
    if dynamics == "NONE" and not force[:2].any() and factor[0] == -force[2] != 0.0:
        return "velocity"
    if force[0] == 0.0 and factor[0] == -force[1]:
        return "intvelocity" if dynamics == "INTEGRATOR" else "position"
    return "cylinder" if dynamics == "FILTER" else "general"


def fields_of(compiled: Any, kind: str, k: int) -> dict[str, Field]:
    """Fields of an element that this version of MuJoCo has.

    Parameters
    ----------
    compiled : mujoco.MjModel
    kind : str
    k : int
        Index of the element among those of its kind.
    """
    fields: dict[str, Field] = dict(FIELDS.get(kind, {}))
    if kind == "actuator":
        fields = {**ACTUATORS[kind_of_actuator(compiled, k)], **OF_ALL_ACTUATORS, **RAW}
    return {n: x for n, x in fields.items() if hasattr(compiled, next(iter(x.numbers[-1].places))[0])}


def rows(compiled: Any, kind: str, array: str, k: int) -> list[int]:
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


def places_of(compiled: Any, kind: str, k: int, number: Number) -> list[Place]:
    """Places of an entry of an element; several of a ball joint, none where this version of MuJoCo lacks it."""
    found = list[Place]()
    for array, column, factor in number.places:
        if hasattr(compiled, array):
            at = () if getattr(compiled, array).ndim == 1 else (column,)
            found += [Place(array, (row, *at), factor) for row in rows(compiled, kind, array, k)]
    return found


def names_of(compiled: Any, kind: str) -> list[str]:
    """Names of all elements of a kind."""
    counts = {"geom": "ngeom", "joint": "njnt", "body": "nbody", "actuator": "nactuator", "tendon": "ntendon"}
    counts |= {"pair": "npair", "equality": "neq", "site": "nsite"}
    if not hasattr(compiled, counts[kind]):  # before MuJoCo 4
        counts["actuator"] = "nu"
    return [getattr(compiled, kind)(k).name for k in range(getattr(compiled, counts[kind]))]
