"""Forces of a description's equations against MuJoCo's inverse dynamics: they are equal, or the description is refused.

Whatever of a file acts on its joints and is not in the equations makes a difference, whether its attribute is known
here or belongs to a later version of MuJoCo.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import ModelError
from diransac.model.robots.compiled import mujoco_module
from diransac.model.robots.description import Description, described, moved_joints
from diransac.model.robots.mechanism import Mechanism

_KINDS = {"jnt": "joint", "dof": "joint", "body": "body", "tendon": "tendon", "actuator": "actuator"}
"""Kinds of elements by the beginnings of the names of arrays in MuJoCo's model."""
_SKELETON = (
    "body_pos", "body_quat", "body_ipos", "body_iquat", "body_mass", "body_inertia", "jnt_pos", "jnt_axis",
    "actuator_gear", "gravity",
)  # fmt: skip
"""Fields that bear on the effect of every other."""


def check_forces(label: str, description: Description) -> None:
    """Raise ModelError where forces of a description differ from those of MuJoCo, with the attributes that act.

    Contacts, limits of joints, dry friction and drives are in neither.

    Parameters
    ----------
    label : str
        Subject of the message.
    description : Description
    """
    errors, largest = _differences(description)
    excess = float(np.abs(errors).max())
    if excess <= 1e-9 * largest:  # rounding
        return
    acting = ", ".join(_unmodelled(description, errors))
    raise ModelError(
        f"{label}: {acting or 'an attribute'} acts on its joints, by up to {excess:.2g} N m or N, and has no "
        "equations here; leave it out, or have MuJoCo simulate the file (--simulator mujoco, dr.models.mujoco)"
    )


def _differences(description: Description) -> tuple[FloatArray, float]:
    """Differences of forces from MuJoCo's, over random motions, and the largest force."""
    module, machine = mujoco_module(), copy.copy(description.compiled)
    machine.opt.gravity[:] = description.gravity
    massless = [i + 1 for i, flaw in description.flaws.items() if flaw.kind == "massless"]
    machine.body_mass[massless] = 0.0  # a placeholder, without which MuJoCo does not compile
    machine.body_inertia[massless] = np.where(machine.body_inertia[massless] > 1e-13, machine.body_inertia[massless], 0)
    machine.opt.disableflags &= ~int(module.mjtDisableBit.mjDSBL_GRAVITY)
    machine.opt.disableflags |= int(module.mjtDisableBit.mjDSBL_CONSTRAINT)
    machine.opt.enableflags &= ~int(module.mjtEnableBit.mjENBL_INVDISCRETE)  # of its integrator, not of the forces
    data, forces, differences, largest = module.MjData(machine), _forces(description), list[FloatArray](), 0.0
    at, dof = machine.jnt_qposadr[moved_joints(machine)], machine.jnt_dofadr[moved_joints(machine)]
    for motion in np.random.default_rng(0).uniform(-1.0, 1.0, (8, 3, forces.size1_in(0))):
        own, data.qpos[at], data.qvel[dof], data.qacc[dof], slopes = (x.full().T for x in forces(*motion))
        module.mj_inverse(machine, data)
        expected = slopes @ data.qfrc_inverse[dof]
        differences.append(own[0] - expected)
        largest = max(largest, float(np.abs(expected).max()))
    return np.array(differences), largest


def _forces(description: Description) -> ca.Function:
    """Forces without friction of the joints that follow no other; motion of all joints, and its slopes."""
    followers = {x.follower for x in description.couplings}
    coordinates = {f"q{k}": k for k in range(len(description.joints)) if k not in followers}
    smooth = replace(description, joints=tuple(replace(x, friction=0.0) for x in description.joints))
    mechanism = Mechanism("", smooth, coordinates, (), (), (1.0, 1.0))
    symbols = [ca.SX.sym(x, len(coordinates)) for x in "qva"]
    q, v, a = (dict(zip(coordinates, ca.vertsplit(x), strict=True)) for x in symbols)
    turned = np.eye(3) if description.base is None else description.bodies[description.base].rotation
    at_rest = [ca.SX(3, 1), ca.SX(3, 1), ca.SX(-turned.T @ description.gravity)]
    forces = mechanism.forces(q, v, a, {}, at_rest)
    every = [(ca.SX(x.q), ca.SX(x.v), ca.SX(x.a)) for x in mechanism.motions(q, v, a)]
    motions = [ca.vertcat(*x) for x in zip(*every, strict=True)]
    outputs = [ca.vertcat(*forces.values()), *motions, ca.jacobian(motions[1], symbols[1])]
    return ca.Function("forces", symbols, [ca.densify(x) for x in outputs])


def _unmodelled(description: Description, errors: FloatArray) -> Iterator[str]:
    """Attributes without which, in MuJoCo's model and in the equations, forces differ otherwise."""
    model = description.compiled
    of_elements = [x for x in dir(model) if x.partition("_")[0] in _KINDS and x not in _SKELETON]
    of_options = [x for x in dir(model.opt) if not x.startswith("_") and x not in _SKELETON]
    for field in (*of_elements, *of_options):
        changed = copy.copy(model)
        target = changed if field in of_elements else changed.opt
        values = np.array(getattr(target, field))
        if values.dtype != float or not values.any():
            continue
        setattr(target, field, np.zeros(values.shape) if values.ndim else 0.0)
        without = replace(described("", changed, {}, ""), gravity=description.gravity, base=description.base)
        if np.abs(_differences(without)[0] - errors).max() > 1e-3 * np.abs(errors).max():
            yield _named(model, field, values) if field in of_elements else field


def _named(model: Any, field: str, values: FloatArray) -> str:
    """An attribute in the words of MJCF, with the elements that have it."""
    prefix, _, attribute = field.partition("_")
    rows = np.flatnonzero(values.reshape(len(values), -1).any(axis=1))
    rows = np.unique(model.dof_jntid[rows]) if prefix == "dof" else rows
    names = [getattr(model, _KINDS[prefix])(int(k)).name or str(k) for k in rows]
    return f'{attribute.replace("poly", " (polynomial)")} of {_KINDS[prefix]} "{", ".join(names[:3])}"'
