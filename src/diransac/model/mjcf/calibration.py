"""Estimates in the text of an MJCF: the same text but for the values that were identified."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.errors import ModelError
from diransac.model.mjcf.masks import FIELDS
from diransac.model.mjcf.model import write
from diransac.model.robots.calibration import Document, numbers
from diransac.model.robots.sizes import check_description

if TYPE_CHECKING:
    from diransac.model.mjcf.masks import Unknown
    from diransac.model.mjcf.model import MujocoModel


def calibrated_text(path: str | Path, model: MujocoModel, values: Mapping[str, float]) -> tuple[str, tuple[str, ...]]:
    """Text of an MJCF with estimates in it, and the parameters that are not in it.

    Parameters
    ----------
    path : str or Path
        File from which `mujoco` made the model.
    model : MujocoModel
    values : mapping of str to float
        Estimate of each parameter; NaN where there is none.

    Returns
    -------
    text : str
        The file's, comments and layout included.
    left_out : tuple of str
        Parameters without an estimate, biases of sensors, and those of actuators that the file does not have.

    Raises
    ------
    ModelError
        The file cannot be read, is a URDF, or has an element in another file.
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
    for unknown in model.unknowns:
        if not unknown.places or not np.isfinite(values[unknown.name]):
            left_out.append(unknown.name)
            continue
        for kind, name in unknown.elements:
            _set(document, compiled, unknown, kind, name)
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
    own = next(x for x in unknown.places if x.array == array and _belongs(compiled, kind, x.array, x.index[0], index))
    row = np.atleast_1d(getattr(compiled, array)[own.index[0]])[first : first + size] / factor
    document.rewrite(element, {field: numbers(row)})


def _belongs(compiled: Any, kind: str, array: str, row: int, index: int) -> bool:
    """True if a row of an array is that of an element."""
    if kind != "joint":
        return row == index
    joints = {"dof_": compiled.dof_jntid, "jnt_": np.arange(compiled.njnt)}.get(array[:4])
    return bool(compiled.jnt_qposadr[index] == row if joints is None else joints[row] == index)


def _inertial(compiled: Any, name: str) -> str:
    """Element of a body with its mass and inertia."""
    body = compiled.body(name)
    inertia = np.ravel(body.inertia)
    if not (inertia.sum() - 2.0 * inertia >= -1e-9 * inertia.sum()).all():
        raise ModelError(f'body "{name}" would have the impossible inertia {numbers(inertia)}; fix one of its entries')
    turned = not np.allclose(body.iquat, [1.0, 0.0, 0.0, 0.0])
    quat = f' quat="{numbers(body.iquat)}"' if turned else ""
    return f'<inertial pos="{numbers(body.ipos)}"{quat} mass="{numbers(body.mass)}" diaginertia="{numbers(inertia)}"/>'
