"""Estimates in the text of an MJCF: the same text but for the values that were identified."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import ModelError
from diransac.model.mjcf.masks import FIELDS, Place
from diransac.model.mjcf.model import write
from diransac.model.robots.calibration import Document, Element, attributes, numbers
from diransac.model.robots.consistency import consistent_parameters
from diransac.model.robots.description import mujoco_module
from diransac.model.robots.sizes import check_description

if TYPE_CHECKING:
    from diransac.model.mjcf.masks import Unknown
    from diransac.model.mjcf.model import MujocoModel

_COMMON = (
    "name", "class", "group", "cranklength", "joint", "jointinparent", "tendon", "slidersite", "cranksite", "site",
    "refsite", "body", "damping", "armature", "user", "actdim", "nsample", "interp", "delay",
)  # fmt: skip
"""Attributes that actuators of all kinds have, but for limits."""
_FAR, _FIXED = 3.0, 1e-3
"""Change to a possible inertia that errors explain, standard errors; change of a given one, of its size."""


def calibrated_text(
    path: str | Path, model: MujocoModel, values: Mapping[str, float], covariance: FloatArray
) -> tuple[str, tuple[str, ...]]:
    """Text of an MJCF with estimates in it, and the parameters that are not in it.

    Inertias that are impossible by their errors are the nearest possible ones (`consistent_parameters`).

    Parameters
    ----------
    path : str or Path
        File from which `mujoco` made the model.
    model : MujocoModel
    values : mapping of str to float
        Estimate of each parameter; NaN where there is none.
    covariance : (n_p, n_p) array

    Returns
    -------
    text : str
        The file's, comments and layout included.
    left_out : tuple of str
        Parameters without an estimate, biases of sensors, and those of actuators that the file does not have.

    Raises
    ------
    ModelError
        The file cannot be read, is a URDF, or has an element in another file; an inertia is impossible beyond its
        errors.
    """
    label = f'robot description "{path}"'
    if not Path(path).is_file():
        raise ModelError(f"{label} does not exist; give the MJCF from which the model was made")
    check_description(Path(path), label)
    document = Document(Path(path).read_bytes(), label)
    if document.is_urdf:
        raise ModelError(f"{label} is a URDF, which has no place for values of MuJoCo; give an MJCF")
    compiled, left_out = copy.copy(model.compiled), list[str]()
    for unknown in model.unknowns:
        if np.isfinite(values[unknown.name]):
            write(compiled, unknown.places, values[unknown.name])
    for body in {x.index[0] for unknown in model.unknowns for x in unknown.places if x.array == "body_inertia"}:
        compiled.body_inertia[body] = _possible_inertia(model, compiled, body, covariance)
    for unknown in model.unknowns:
        if not unknown.places or not np.isfinite(values[unknown.name]):
            left_out.append(unknown.name)
            continue
        for kind, name in unknown.elements:
            _set(document, compiled, unknown, kind, name)
    _settle_dampings(document, compiled)
    return document.text(), tuple(left_out)


def _set(document: Document, compiled: Any, unknown: Unknown, kind: str, name: str) -> None:
    """Write the field of an element."""
    field = unknown.field
    sections = {"actuator": "actuator", "tendon": "tendon", "equality": "equality", "pair": "contact"}
    element = document.named(kind, name, sections.get(kind, "worldbody"))
    if kind == "body" and field in ("mass", "ipos", "inertia"):
        inertial = _inertial(compiled, name)
        if old := [x for x in element.children if x.tag == "inertial"]:
            document.changes[old[0].begin, old[0].end] = inertial
        else:
            document.insert(element, inertial)
        return
    (array, first, factor), size = FIELDS[kind][field].arrays[0], FIELDS[kind][field].size
    index = getattr(compiled, kind)(name).id
    if kind == "actuator" and not _takes(document, element, field):
        _replace_drive(document, compiled, element)
        return
    own = next(x for x in unknown.places if x.array == array and _belongs(compiled, kind, x.array, x.index[0], index))
    row = np.atleast_1d(getattr(compiled, array)[own.index[0]])[first : first + size] / factor
    document.rewrite(element, {field: numbers(row)})


def _takes(document: Document, element: Element, field: str) -> bool:
    """True if an actuator has a field as an attribute, on which nothing else depends."""
    if document.changes.get((element.begin, element.end), element.tag).startswith("<general"):
        return False
    if field in ("kp", "kv"):
        return element.tag == "position"
    return (field == "gear" and element.tag != "muscle") or element.tag == "general"


def _settle_dampings(document: Document, compiled: Any) -> None:
    """Write servos as general actuators if any has a damping ratio, of which MuJoCo makes less with another mass."""
    if b"dampratio" not in document.source:
        return
    names = {compiled.actuator(k).name for k in range(compiled.nu)} - {""}
    for element in (x for section in document.root.children if section.tag == "actuator" for x in section.children):
        if element.tag == "position" and element.attributes.get("name") in names:
            _replace_drive(document, compiled, element)


def _replace_drive(document: Document, compiled: Any, element: Element) -> None:
    """Write an actuator as a general one."""
    document.changes.pop((element.begin, element.inside), None)
    document.changes[element.begin, element.end] = _general(compiled, element)


def _general(compiled: Any, element: Element) -> str:
    """Element of an actuator of any kind with all that MuJoCo has made of it."""
    mujoco, actuator = mujoco_module(), compiled.actuator(element.attributes["name"])
    texts = {key: text for key, text in element.attributes.items() if key in _COMMON}
    texts["gear"] = numbers(actuator.gear)
    if actuator.lengthrange.any():
        texts["lengthrange"] = numbers(actuator.lengthrange)
    if compiled.actuator_actearly[actuator.id]:
        texts["actearly"] = "true"
    for key, enum in (("dyn", mujoco.mjtDyn), ("gain", mujoco.mjtGain), ("bias", mujoco.mjtBias)):
        kind = enum(int(np.ravel(getattr(actuator, f"{key}type"))[0])).name
        texts |= {f"{key}type": kind.rpartition("_")[2].lower(), f"{key}prm": numbers(getattr(actuator, f"{key}prm"))}
    for key in ("ctrl", "force", "act"):
        limited = bool(np.ravel(getattr(actuator, f"{key}limited"))[0])
        texts |= {f"{key}limited": str(limited).lower()}
        texts |= {f"{key}range": numbers(getattr(actuator, f"{key}range"))} if limited else {}
    return f"<general {attributes(texts)}/>"


def _belongs(compiled: Any, kind: str, array: str, row: int, index: int) -> bool:
    """True if a row of an array is that of an element."""
    if kind != "joint":
        return row == index
    joints = {"dof_": compiled.dof_jntid, "jnt_": np.arange(compiled.njnt)}.get(array[:4])
    return bool(compiled.jnt_qposadr[index] == row if joints is None else joints[row] == index)


def _possible_inertia(model: MujocoModel, compiled: Any, body: int, covariance: FloatArray) -> FloatArray:
    """Principal inertias ``(3,)`` of a body, kg m^2, moved by their errors to where the triangle inequality holds."""
    inertia: FloatArray = compiled.body_inertia[body].copy()
    if (inertia.sum() - 2.0 * inertia >= -1e-9 * inertia.sum()).all():
        return inertia
    places = [Place("body_inertia", (body, axis)) for axis in range(3)]
    entries = np.array([[x in unknown.places for unknown in model.unknowns] for x in places], float)
    errors = entries @ np.where(np.isfinite(covariance), covariance, 0.0) @ entries.T
    described = np.array([[compiled.body_mass[body], 0.0, 0.0, 0.0, *model.compiled.body_inertia[body], 0.0, 0.0, 0.0]])
    found = consistent_parameters(described, np.zeros(0), np.eye(10)[4:7], inertia, errors)[0][0, 4:7]
    if (np.abs(found - inertia) > _FAR * np.sqrt(np.diag(errors)) + _FIXED * inertia).any():
        name = compiled.body(body).name
        raise ModelError(f'body "{name}" would have the impossible inertia {numbers(inertia)}; fix one of its entries')
    return found


def _inertial(compiled: Any, name: str) -> str:
    """Element of a body with its mass and inertia."""
    body = compiled.body(name)
    turned = not np.allclose(body.iquat, [1.0, 0.0, 0.0, 0.0])
    quat = f' quat="{numbers(body.iquat)}"' if turned else ""
    inertia = numbers(np.ravel(body.inertia))
    return f'<inertial pos="{numbers(body.ipos)}"{quat} mass="{numbers(body.mass)}" diaginertia="{inertia}"/>'
