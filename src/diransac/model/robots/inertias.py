"""Inertias of descriptions that no body can have, and the nearest ones that a body can have.

A body is possible if its mass is positive and the second moments ``S = tr(I) / 2 - I`` of its mass about its centre are
positive semidefinite: its principal inertias are then positive and satisfy the triangle inequality.  Descriptions have
others, of frames without a mass, of rounding and of placeholders, which MuJoCo does not compile.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import ModelError

if TYPE_CHECKING:
    from diransac.model.robots.description import Body, Description

Kind = Literal["impossible", "massless", "shapes"]

THIN = 1e-10
"""Least second moment over the largest, which MuJoCo compiles whatever its rounding."""
THIN_IN_TEXT = 3e-5
"""The same of a body that is written with six digits, as MuJoCo writes, and compiled again."""
_LEAST = 1e-14
"""Least second moment, kg m^2; MuJoCo compiles no moving body with an inertia below 1e-15."""
_ROUNDING = 1e-9
"""Negative second moment over the largest of a thin body that was rounded."""
_NO_MASS = 1e-12
"""Mass, kg, that stands for none while MuJoCo compiles a body that moves."""
_REPLACED = "impossible inertias in the file were replaced by the nearest possible ones: {}"
_DENSITY = 1000.0
"""Of the ball for which a body is taken whose inertia is unknown, kg/m^3; MuJoCo's of shapes."""


@dataclass(frozen=True)
class Flaw:
    """Defect of the inertia of a body in a file.

    Parameters
    ----------
    kind : {"impossible", "massless", "shapes"}
        No body has this inertia; the body moves without a mass; or the inertia is that of shapes, in a URDF.
    reason : str, optional
        Why the inertia is impossible.
    """

    kind: Kind
    reason: str = ""


# ---------------------------------------------------------------------- before MuJoCo compiles


def repair(spec: Any, *, is_urdf: bool, thin: float = THIN) -> list[tuple[Any, Flaw]]:
    """Replace inertias that MuJoCo does not compile by the nearest possible ones, in its editable form (``MjSpec``).

    A body that moves without a mass, itself or by bodies welded to it, gets one that `without_placeholders` removes.

    Parameters
    ----------
    spec : MjSpec
    is_urdf : bool
        Whether the file is a URDF, in which a body without an inertial has no mass.
    thin : float, optional
        Least second moment over the largest of a body.

    Returns
    -------
    list of (body of the spec, Flaw)
    """
    flaws = []
    for body in list(spec.bodies)[1:]:
        by_shapes = _is_of_shapes(spec, body)
        if body.explicitinertial and not by_shapes and (reason := _made_possible(spec, body, thin)):
            flaws.append((body, Flaw("impossible", reason)))
        if list(body.joints) and not _carries_mass(spec, body):
            body.mass, body.explicitinertial = _NO_MASS, True
            body.ipos = np.nan_to_num(body.ipos)
            _made_possible(spec, body, thin)
            flaws.append((body, Flaw("massless")))
        if by_shapes and is_urdf:
            flaws.append((body, Flaw("shapes")))
    return flaws


def gives_inertia(spec: Any, shape: Any) -> bool:
    """True if a shape has a mass, which a body without an inertial takes over."""
    low, high = spec.compiler.inertiagrouprange
    is_flat = shape.type.name in ("mjGEOM_PLANE", "mjGEOM_HFIELD")
    mass = shape.density if np.isnan(shape.mass) else shape.mass
    return bool(low <= shape.group <= high and not is_flat and mass > 0.0)


def _is_of_shapes(spec: Any, body: Any) -> bool:
    """True if MuJoCo infers the inertia of a body from its shapes."""
    rule = spec.compiler.inertiafromgeom.name.removeprefix("mjINERTIAFROMGEOM_")
    infers = rule == "TRUE" or (rule == "AUTO" and not body.explicitinertial)
    return infers and any(gives_inertia(spec, shape) for shape in body.geoms)


def _carries_mass(spec: Any, body: Any) -> bool:
    """True if a body, or one that is welded to it, has a mass."""
    has_own = _is_of_shapes(spec, body) or (body.explicitinertial and body.mass > 0.0) or spec.compiler.boundmass > 0.0
    return has_own or any(_carries_mass(spec, x) for x in body.bodies if not list(x.joints))


def _made_possible(spec: Any, body: Any, thin: float) -> str:
    """Give a body the possible inertia that is nearest to its own in the Frobenius norm of S; why it was impossible.

    Numbers that are not finite stay: they are refused once they are compiled.
    """
    if body.mass < 0.0:
        body.mass, body.inertia, body.fullinertia = 0.0, np.zeros(3), [np.nan, 0.0, 0.0, 0.0, 0.0, 0.0]
        return "its mass is negative"
    I, compiler = _inertia(body), spec.compiler
    if not np.isfinite(I).all():
        return ""
    moments, axes = np.linalg.eigh(I)
    if moments[0] > 0.0 or np.isnan(body.fullinertia[0]):  # else MuJoCo refuses before it looks at these
        moments = np.maximum(moments, compiler.boundinertia)
        if compiler.balanceinertia:
            return ""
    second = 0.5 * moments.sum() - moments
    least = max(thin * second.max(), _LEAST)
    if second.min() >= least:
        return ""
    is_zero = np.abs(second).max() <= _LEAST
    nearest = np.zeros(3) if is_zero and body.mass == 0.0 else np.maximum(second, least)
    _set_inertia(body, axes @ np.diag(nearest.sum() - nearest) @ axes.T)
    if is_zero:
        return "" if body.mass <= _NO_MASS else "it is zero"
    if moments.min() < -_ROUNDING * np.abs(moments).max():
        return "it is not positive definite"
    return "A + B < C" if second.min() < -_ROUNDING * second.max() else ""


def _inertia(body: Any) -> FloatArray:
    """Inertia in the frame in which a file describes it."""
    if np.isnan(body.fullinertia[0]):
        return np.diag(body.inertia)
    xx, yy, zz, xy, xz, yz = body.fullinertia
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _set_inertia(body: Any, I: FloatArray) -> None:
    """Replace what `_inertia` returns."""
    if np.isnan(body.fullinertia[0]) or not I.any():
        body.inertia, body.fullinertia = np.diag(I), [np.nan, 0.0, 0.0, 0.0, 0.0, 0.0]
    else:
        body.fullinertia = I[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


# ---------------------------------------------------------------------- in a description


def without_placeholders(bodies: tuple[Body, ...], flaws: Mapping[int, Flaw]) -> tuple[Body, ...]:
    """The bodies, of which those that move without a mass have none again; an inertia remains."""

    def without_mass(J: FloatArray) -> FloatArray:
        second = J - np.outer(J[:, 3], J[:, 3]) / J[3, 3]
        return np.where(np.abs(second) > 2.0 * _LEAST, second, 0.0)

    is_massless = [i in flaws and flaws[i].kind == "massless" for i in range(len(bodies))]
    zipped = zip(bodies, is_massless, strict=True)
    return tuple(replace(x, inertial=without_mass(x.inertial)) if massless else x for x, massless in zipped)


def with_unknown(description: Description, unknown: Collection[int]) -> Description:
    """The description with balls in place of bodies of which inertial parameters are unknown and flawed.

    Parameters
    ----------
    description : Description
    unknown : collection of int
        Indices of bodies.
    """
    flawed = {i for i in unknown if i in description.flaws and description.flaws[i].kind != "shapes"}
    bodies = (replace(x, inertial=_ball(x.inertial)) if i in flawed else x for i, x in enumerate(description.bodies))
    return replace(description, bodies=tuple(bodies))


def _ball(inertial: FloatArray) -> FloatArray:
    """Pseudo-inertia of a ball of the same mass, or of 1 kg if there is none, about the same centre."""
    mass = float(inertial[3, 3]) or 1.0
    point = np.array([*(inertial[:3, 3] / mass), 1.0])
    second = 0.2 * mass * (0.75 * mass / (np.pi * _DENSITY)) ** (2 / 3)
    return mass * np.outer(point, point) + np.diag([second, second, second, 0.0])


def moving_bodies(description: Description, moved: Collection[int]) -> tuple[int, ...]:
    """Indices of the bodies with one of some joints between them and the world."""
    moving = set[int]()
    for i, body in enumerate(description.bodies):
        if body.parent in moving or set(body.joints) & set(moved):
            moving.add(i)
    return tuple(sorted(moving))


def notes_on_inertias(
    label: str, description: Description, moved: Collection[int], unknown: Collection[int], *, strict: bool
) -> tuple[str, ...]:
    """Sentences on flawed inertias and what becomes of them.

    Parameters
    ----------
    label : str
        Subject of messages.
    description : Description
    moved, unknown : collection of int
        Indices of joints that move, and of bodies of which inertial parameters are unknown.
    strict : bool
        Whether flaws of bodies that move and are not unknown are refused.

    Raises
    ------
    ModelError
        One is refused; or nothing that a joint moves has a mass.
    """
    moving = moving_bodies(description, moved)
    matters = {i: flaw for i, flaw in description.flaws.items() if i in moving and i not in unknown}
    _check_masses(label, description, moved, unknown)
    if strict and matters:
        named = _listed(_named(description, matters))
        raise ModelError(
            f"{label}: inertias of bodies that move are impossible or absent in the file: {named}; correct them, name "
            'the bodies in bodies, lock their joints, or give inertia="nearest"'
        )
    irrelevant = {i: flaw for i, flaw in description.flaws.items() if i not in moving and flaw.kind == "impossible"}
    replaced = {i: flaw for i, flaw in description.flaws.items() if i in unknown and flaw.kind != "shapes"}
    sentences = {
        "impossible inertias in the file have no effect, since these bodies do not move: {}": irrelevant,
        "impossible inertias in the file are unknown here, with nominal values of balls: {}": replaced,
        f"{_REPLACED}; correct them, or name the bodies in bodies": _of_kind(matters, "impossible"),
        "bodies that move have no mass in the file, and add none: {}": _of_kind(matters, "massless"),
        "the mass of bodies without an inertial is that of their shapes, of 1000 kg/m^3: {}": _of_kind(
            matters, "shapes"
        ),
    }
    return tuple(text.format(_listed(_named(description, own))) for text, own in sentences.items() if own)


def notes_on_simulated(label: str, compiled: Any, flaws: Sequence[tuple[Any, Flaw]]) -> tuple[str, ...]:
    """A sentence on inertias that `repair` replaced, of a model of MuJoCo that it compiled.

    Raises
    ------
    ModelError
        Nothing that a joint moves has a mass.
    """
    for body, flaw in flaws:
        if flaw.kind == "massless" and compiled.body_subtreemass[body.id] <= _NO_MASS * compiled.nbody:
            name = body.name or f"body{body.id}"
            raise ModelError(f'{label}: nothing that body "{name}" carries has a mass; give it one in the file')
    named = {body.name: flaw for body, flaw in flaws if flaw.kind == "impossible" and compiled.body_weldid[body.id]}
    return (_REPLACED.format(_listed(named)),) if named else ()


def _of_kind(flaws: Mapping[int, Flaw], kind: Kind) -> dict[int, Flaw]:
    return {i: flaw for i, flaw in flaws.items() if flaw.kind == kind}


def _named(description: Description, flaws: Mapping[int, Flaw]) -> dict[str, Flaw]:
    return {description.bodies[i].name: flaw for i, flaw in flaws.items()}


def _listed(flaws: Mapping[str, Flaw]) -> str:
    """Names of bodies with reasons, five at most."""
    named = [name + (f" ({x.reason})" if x.reason else "") for name, x in flaws.items()]
    return ", ".join(named[:5]) + (f" and {len(named) - 5} more" if len(named) > 5 else "")


def _check_masses(label: str, description: Description, moved: Collection[int], unknown: Collection[int]) -> None:
    """Raise ModelError where nothing that a joint moves has a mass or an inertia."""
    carries = [bool(x.inertial.any()) or i in unknown for i, x in enumerate(description.bodies)]
    for i, body in reversed(list(enumerate(description.bodies))):
        carries[body.parent] |= body.parent >= 0 and carries[i]
    for i, body in enumerate(description.bodies):
        if not carries[i] and set(body.joints) & set(moved):
            raise ModelError(
                f'{label}: nothing that joint "{description.joints[body.joints[0]].name}" moves has a mass; give body '
                f'"{body.name}" an inertial in the file, name it in bodies, or leave the joint out of joints'
            )
