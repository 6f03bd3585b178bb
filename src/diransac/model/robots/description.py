"""A robot's bodies, joints and couplings, read from its MJCF or URDF file by MuJoCo.

MuJoCo's compiler resolves frames, default classes, units and inertials, so that nothing of either format is parsed
here.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import ModelError
from diransac.limits import MOST_JOINTS, beyond
from diransac.model.robots.compiled import (
    compiled,
    drive_limits,
    drop_shapes,
    further_states,
    mujoco_module,
    parsed,
    unreadable,
)
from diransac.model.robots.inertias import Flaw, without_placeholders


@dataclass(frozen=True)
class Joint:
    """Joint with one degree of freedom.

    Parameters
    ----------
    name : str
        Name in the file.
    turns : bool
        Whether it is a hinge, in rad and N m; else a slide, in m and N.
    axis, anchor : (3,) arrays
        Unit axis, and a point of it, m, in the frame of the moved body.
    reference : float
        Position in which the moved body has the pose of the file.
    armature : float
        Inertia of the rotor behind the gear, kg m^2 or kg.
    damping, stiffness : tuple of float
        Coefficients of ``d_0 v + d_1 |v| v + d_2 v^3`` and of ``k_0 x + k_1 x^2 + k_2 x^3``: in MuJoCo, the polynomial
        of damping alone is odd.
    drive_armature, drive_damping : float
        What the file's actuators have of the armature, and of the first coefficient of the damping.
    compensated_by_drive : bool
        Whether the drive's force has the gravity compensation of the bodies in it.
    friction : float
        Coulomb friction, N m or N.
    spring_reference : float
        Position in which the spring is relaxed.
    position_limits, force_limits : (float, float)
        Smallest and largest position, and force of its drives, N m or N; infinite where the file has none.
    """

    name: str
    turns: bool
    axis: FloatArray
    anchor: FloatArray
    reference: float
    armature: float
    damping: tuple[float, ...]
    drive_armature: float
    drive_damping: float
    compensated_by_drive: bool
    friction: float
    stiffness: tuple[float, ...]
    spring_reference: float
    position_limits: tuple[float, float]
    force_limits: tuple[float, float]


@dataclass(frozen=True)
class Body:
    """Rigid body.

    Parameters
    ----------
    name : str
        Name in the file.
    parent : int
        Index of the body on which it is mounted, smaller than its own; -1: the world.
    rotation, position : (3, 3) and (3,) arrays
        Pose in the frame of the parent, with all joints in their reference positions; m.
    joints : tuple of int
        Indices of the joints between it and its parent, in their order.
    inertial : (4, 4) array
        Pseudo-inertia about the origin of the body frame, ``[[S, h], [h', m]]`` with the first moments h, kg m, and
        ``S = tr(I) / 2 - I``, kg m^2.
    gravity_compensation : float
        Fraction of the weight that the robot compensates by itself.
    """

    name: str
    parent: int
    rotation: FloatArray
    position: FloatArray
    joints: tuple[int, ...]
    inertial: FloatArray
    gravity_compensation: float


@dataclass(frozen=True)
class Coupling:
    """Position of a joint as a polynomial of another's: ``y = y_0 + sum c_k (x - x_0)^k``.

    Parameters
    ----------
    follower : int
        Index of the joint y.
    leader : int or None
        Index of the joint x; None: y is constant.
    coefficients : tuple of float
        c_0, c_1, ...
    """

    follower: int
    leader: int | None
    coefficients: tuple[float, ...]


@dataclass(frozen=True)
class Description:
    """Fixed-base tree of bodies.

    Parameters
    ----------
    name : str
        Name of the robot.
    bodies : tuple of Body
        Parents before their children.
    joints : tuple of Joint
    couplings : tuple of Coupling
    gravity : (3,) array
        In the world frame, m/s^2.
    compiled : mujoco.MjModel
        MuJoCo's model of the same tree, without meshes.
    base : int, optional
        Index of a body whose motion is measured; by default no body of those on the world moves by itself.
    flaws : mapping of int to Flaw, optional
        What the file lacks of the inertias of bodies, by index.
    velocity_limits : mapping of str to float, optional
        Largest speeds of joints by name, rad/s or m/s.
    """

    name: str
    bodies: tuple[Body, ...]
    joints: tuple[Joint, ...]
    couplings: tuple[Coupling, ...]
    gravity: FloatArray
    compiled: Any = field(compare=False, repr=False)
    base: int | None = None
    flaws: Mapping[int, Flaw] = field(default_factory=dict)
    velocity_limits: Mapping[str, float] = field(default_factory=dict)


def read_description(path: str | Path, base: str | None = None) -> Description:
    """Bodies, joints and couplings of a robot's description.

    Parameters
    ----------
    path : str or Path
        MJCF or URDF.
    base : str, optional
        A body with a free joint: "held" in the pose of the file, or "measured", so that its motion is known. None:
        there is none.

    Raises
    ------
    ModelError
        The file cannot be read; or it has a free joint whose base is neither, a ball joint, a closed loop, or springs
        or constraints of other kinds than those of joints.
    """
    try:
        return _description(path, base)
    except UnicodeDecodeError as error:  # a name in another encoding, or none
        raise unreadable(path, error) from error


def _description(path: str | Path, base: str | None) -> Description:
    """As `read_description`.  Raises UnicodeDecodeError: a name is not UTF-8."""
    label, file = f'robot description "{path}"', parsed(path)
    spec = file.spec
    drives = drive_limits(spec)
    drop_shapes(spec)
    model = compiled(path, spec)
    if model.njnt > MOST_JOINTS:
        raise ModelError(f"{label}: it has {beyond(MOST_JOINTS, 'joints', model.njnt)}; split the robot")
    _check_supported(label, model, base)
    found = described(label, model, drives, re.sub(r"\W+", "-", spec.modelname) or Path(path).stem)
    if not found.joints:
        raise ModelError(f"{label}: there are no joints, and nothing can move")
    flaws = {body.id - 1: flaw for body, flaw in file.flaws}
    return replace(
        found,
        bodies=without_placeholders(found.bodies, flaws),
        base=_measured_base(label, found) if base == "measured" else None,
        flaws=flaws,
        velocity_limits=file.outline.velocity_limits,
    )


def described(label: str, model: Any, drives: Mapping[str, tuple[float, float]], name: str) -> Description:
    """Tree of a compiled model, in which free joints hold their bodies in the pose of the file.

    Parameters
    ----------
    label : str
        Of the file in messages.
    model : mujoco.MjModel
    drives : mapping of str to (float, float)
        Range of the forces of a joint's drives, by its name.
    name : str
        Of the robot.

    Raises
    ------
    ModelError
        An equality constraint closes a loop.
    """
    bits, flags = mujoco_module().mjtDisableBit.__members__.values(), int(model.opt.disableflags)
    without = {bit.name.removeprefix("mjDSBL_").lower() for bit in bits if flags & bit.value}
    moved = moved_joints(model)
    joints = tuple(_joint(model, k, drives, without) for k in moved)
    bodies = tuple(_body(model, i, moved, without) for i in range(1, model.nbody))
    couplings = () if without & {"constraint", "equality"} else tuple(_couplings(label, model, moved))
    gravity = np.zeros(3) if "gravity" in without else np.array(model.opt.gravity)
    return Description(name, bodies, joints, couplings, gravity, model)


def moved_joints(model: Any) -> list[int]:
    """Indices of the joints of a compiled model that are not free, in the order in which a description has them."""
    return np.flatnonzero(model.jnt_type != int(mujoco_module().mjtJoint.mjJNT_FREE)).tolist()


def _measured_base(label: str, description: Description) -> int:
    """Index of the body with a free joint.  Raises ModelError: there is not one, or weights are compensated."""
    model = description.compiled
    free = np.flatnonzero(model.jnt_type == int(mujoco_module().mjtJoint.mjJNT_FREE))
    if len(free) != 1:
        raise ModelError(f"{label}: {len(free)} bodies have a free joint; a measured base takes one")
    if any(body.gravity_compensation for body in description.bodies):
        raise ModelError(f"{label}: gravity compensation on a base whose attitude is not known is not modelled")
    return int(model.jnt_bodyid[free[0]]) - 1


_CONSTRAINTS = ("EQUALITY", "FRICTION_DOF", "LIMIT", "CONTACT")
"""Beginnings of the names of MuJoCo's constraints that are couplings, friction of joints, or no part of the model."""


def _check_supported(label: str, model: Any, base: str | None) -> None:
    """Raises ModelError: the robot has parts for which there are no equations here, or numbers that overflow."""
    mujoco = mujoco_module()
    of_bodies = (model.body_mass, model.body_inertia, model.body_ipos, model.body_pos)
    of_joints = (model.dof_armature, model.dof_damping, model.dof_frictionloss, model.jnt_stiffness, model.jnt_pos)
    largest = 1e50  # products of several of them do not overflow
    if not all(np.all(np.abs(x) < largest) for x in (*of_bodies, *of_joints)):
        raise ModelError(f"{label}: a mass, inertia, position or coefficient is {largest:g} or more; correct it")
    for k in range(model.njnt):
        name = model.joint(k).name
        if model.jnt_type[k] == mujoco.mjtJoint.mjJNT_FREE and base is None:
            raise ModelError(
                f'{label}: the base floats (free joint "{name}"); give base="held" if it was held while the '
                'log was recorded, or base="measured" if its motion was'
            )
        if model.jnt_type[k] == mujoco.mjtJoint.mjJNT_BALL:
            raise ModelError(f'{label}: joint "{name}" is a ball joint; replace it by three hinges')
    if found := further_states(model, {"HISTORY"}):  # drives' delays are those of their forces
        raise ModelError(f"{label} has {', '.join(found)}, for which there are no equations here; leave them out")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for row in data.efc_type[: data.nefc]:
        kind = mujoco.mjtConstraint(int(row)).name.removeprefix("mjCNSTR_")
        if not kind.startswith(_CONSTRAINTS):
            words = " of a ".join(kind.lower().split("_"))
            raise ModelError(f"{label}: the {words} is not modelled; leave it out (of joints, it is modelled)")


def _couplings(label: str, model: Any, moved: list[int]) -> Iterator[Coupling]:
    """Active equality constraints.  Raises ModelError: one is not between joints, which closes a kinematic loop."""
    mujoco = mujoco_module()
    for k in np.flatnonzero(model.eq_active0):
        if model.eq_type[k] != mujoco.mjtEq.mjEQ_JOINT:
            kind = mujoco.mjtEq(model.eq_type[k]).name.removeprefix("mjEQ_").lower()
            what = "closes a kinematic loop, but chains and trees alone are modelled; cut it, or couple joints"
            ends = (model.eq_obj1id[k], model.eq_obj2id[k]) if model.eq_objtype[k] == mujoco.mjtObj.mjOBJ_BODY else ()
            if moved_by_user := [model.body(i).name for i in ends if model.body_mocapid[i] >= 0]:
                what = f'ties the robot to "{moved_by_user[0]}", a mocap body that a user moves; leave it out'
            raise ModelError(f'{label}: the equality constraint "{model.equality(k).name or k}" ({kind}) {what}')
        follower, leader = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
        own = None if leader < 0 else moved.index(leader)
        yield Coupling(moved.index(follower), own, tuple(model.eq_data[k, :5].tolist()))


def _joint(model: Any, k: int, drives: Mapping[str, tuple[float, float]], without: Collection[str]) -> Joint:
    """Joint of an index; ``without`` names the flags by which the file disables springs, dampers, constraints."""
    dof, name, unlimited = model.jnt_dofadr[k], model.joint(k).name, (-np.inf, np.inf)
    low, high = drives.get(name, unlimited)
    if model.jnt_actfrclimited[k]:
        low, high = max(low, float(model.jnt_actfrcrange[k][0])), min(high, float(model.jnt_actfrcrange[k][1]))
    rotor, drag = _of_drives(model, k)
    own = _coefficients(model, "dof_damping", dof)
    return Joint(
        name=name or f"joint{k}",
        turns=bool(model.jnt_type[k] == mujoco_module().mjtJoint.mjJNT_HINGE),
        axis=_snapped(model.jnt_axis[k]),
        anchor=np.array(model.jnt_pos[k]),
        reference=float(model.qpos0[model.jnt_qposadr[k]]),
        armature=float(model.dof_armature[dof]) + rotor,
        damping=(0.0,) if "damper" in without else _trimmed(own + drag),
        drive_armature=rotor,
        drive_damping=0.0 if "damper" in without else float(drag[0]),
        compensated_by_drive=bool(model.jnt_actgravcomp[k]),
        friction=0.0 if {"constraint", "frictionloss"} & set(without) else float(model.dof_frictionloss[dof]),
        stiffness=(0.0,) if "spring" in without else _trimmed(_coefficients(model, "jnt_stiffness", k)),
        spring_reference=float(model.qpos_spring[model.jnt_qposadr[k]]),
        position_limits=tuple(model.jnt_range[k].tolist()) if model.jnt_limited[k] else unlimited,
        force_limits=(low, high),
    )


def _of_drives(model: Any, k: int) -> tuple[float, FloatArray]:
    """Armature and coefficients of damping that the file's actuators give a joint, by the square of the gear."""
    rotor, drag = 0.0, np.zeros(3)
    if not hasattr(model, "actuator_armature"):  # before MuJoCo 3.7
        return rotor, drag
    of_joints = [int(getattr(mujoco_module().mjtTrn, f"mjTRN_{x}")) for x in ("JOINT", "JOINTINPARENT")]
    for i in np.flatnonzero(model.actuator_trnid[:, 0] == k).tolist():
        if model.actuator_trntype[i] in of_joints:
            gear = float(model.actuator_gear[i, 0])
            rotor += gear**2 * float(model.actuator_armature[i])
            drag += gear**2 * _coefficients(model, "actuator_damping", i)
    return rotor, drag


def _coefficients(model: Any, array: str, k: int) -> FloatArray:
    """The three coefficients of a polynomial force; versions of MuJoCo before 3.7 have the first alone."""
    others = getattr(model, f"{array}poly", None)
    return np.array([getattr(model, array)[k], *([0.0, 0.0] if others is None else others[k])], float)


def _trimmed(coefficients: FloatArray) -> tuple[float, ...]:
    """Coefficients without zeros at the end."""
    found = coefficients.tolist()
    while len(found) > 1 and found[-1] == 0.0:
        found.pop()
    return tuple(found)


def _body(model: Any, i: int, moved: list[int], without: Collection[str]) -> Body:
    """Body of an index; ``without`` as in `_joint`: without springs and dampers, MuJoCo has no passive force at all."""
    centre, mass = np.array(model.body_ipos[i]), float(model.body_mass[i])
    axes = _rotation(model.body_iquat[i])
    about_centre = axes @ np.diag(0.5 * model.body_inertia[i].sum() - model.body_inertia[i]) @ axes.T
    second, first_moments = about_centre + mass * np.outer(centre, centre), (mass * centre)[:, None]
    inertial = np.block([[second, first_moments], [first_moments.T, np.array([[mass]])]])
    return Body(
        name=model.body(i).name or f"body{i}",
        parent=int(model.body_parentid[i]) - 1,
        rotation=_rotation(model.body_quat[i]),
        position=np.array(model.body_pos[i]),
        joints=tuple(j for j, k in enumerate(moved) if model.jnt_bodyid[k] == i),
        inertial=inertial,
        gravity_compensation=0.0 if {"spring", "damper"} <= set(without) else float(model.body_gravcomp[i]),
    )


def _rotation(quaternion: FloatArray) -> FloatArray:
    """Rotation matrix of a unit quaternion, w first."""
    matrix = np.zeros(9)
    mujoco_module().mju_quat2Mat(matrix, np.array(quaternion))
    return _snapped(matrix.reshape(3, 3))


def _snapped(values: FloatArray) -> FloatArray:
    """Values with those that are 0, 1 or -1 but for rounding exactly so, for which expressions have no terms."""
    whole = np.round(values)
    # Entries of rotations that differ from 0, 1 or -1 by less are these: rounding of quarter turns' quaternions.
    return np.where(np.abs(values - whole) < 1e-15, whole, values)
