"""A robot's bodies, joints and couplings, read from its MJCF or URDF file by MuJoCo.

MuJoCo's compiler resolves frames, default classes, units and inertials, so that nothing of either format is parsed
here.
"""

from __future__ import annotations

import re
import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import ModelError
from diransac.limits import MOST_JOINTS, beyond
from diransac.model.robots.formats import Outline, check_format, outline, text_for_mujoco
from diransac.model.robots.inertias import THIN, Flaw, gives_inertia, repair, without_placeholders
from diransac.model.robots.sizes import check_description
from diransac.process import module_path_safe

_ALONE = threading.Lock()
"""Held while warnings are dropped, which all threads share."""
_FAILURES = (ValueError, RuntimeError, MemoryError)
"""Errors of MuJoCo's reader and compiler."""


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
        Coefficients of ``d_0 v + d_1 |v| v + ...`` and of ``k_0 x + k_1 |x| x + ...``.
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
    base: int | None = None
    flaws: Mapping[int, Flaw] = field(default_factory=dict)
    velocity_limits: Mapping[str, float] = field(default_factory=dict)


def mujoco_module() -> ModuleType:
    """The package `mujoco`, which is imported here alone.

    Raises
    ------
    ModelError
        It is not installed.
    """
    try:
        with module_path_safe():  # glfw, which it imports, starts a process
            import mujoco
    except ImportError as error:
        raise ModelError(
            "descriptions of robots are read by MuJoCo, which is not installed: pip install 'diransac[robots]'"
        ) from error
    return mujoco  # type: ignore[no-any-return]  # without annotations


@dataclass(frozen=True)
class Parsed:
    """A file before it is compiled.

    Parameters
    ----------
    spec : MjSpec
        MuJoCo's editable form, in which all inertias are possible.
    flaws : list of (body of the spec, Flaw)
        Inertias that are not those of the file.
    outline : Outline
        Of the file's text.
    """

    spec: Any
    flaws: list[tuple[Any, Flaw]]
    outline: Outline


def parsed(path: str | Path, thin: float = THIN) -> Parsed:
    """A description file in MuJoCo's editable form.

    Parameters
    ----------
    path : str or Path
        MJCF or URDF.
    thin : float, optional
        Least second moment of a body over the largest, as of `repair`.

    Raises
    ------
    ModelError
        There is no such file, or it is neither MJCF nor URDF.
    """
    mujoco, label = mujoco_module(), f'robot description "{path}"'
    if not Path(path).is_file():
        raise ModelError(f"{label} does not exist; give an MJCF (.xml) or URDF file")
    check_description(Path(path), label)
    text = outline(path)
    check_format(text, path, label)
    try:
        with without_warnings():
            content = text_for_mujoco(text, path)
            spec = mujoco.MjSpec.from_file(str(path)) if content is None else mujoco.MjSpec.from_string(content)
            if content is not None:
                spec.modelfiledir = str(Path(path).parent)
    except _FAILURES as error:
        raise _unreadable(path, error) from error
    return Parsed(spec, repair(spec, is_urdf=text.root == "robot", thin=thin), text)


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
        The file cannot be read; or it has a free joint whose base is neither, a ball joint, a closed loop, a tendon
        that exerts forces, or a surrounding fluid.
    """
    try:
        return _description(path, base)
    except UnicodeDecodeError as error:  # a name in another encoding, or none
        raise _unreadable(path, error) from error


def _description(path: str | Path, base: str | None) -> Description:
    """As `read_description`.  Raises UnicodeDecodeError: a name is not UTF-8."""
    file = parsed(path)
    spec = file.spec
    floating = [x for x in spec.joints if x.type == mujoco_module().mjtJoint.mjJNT_FREE] if base else []
    names = [joint.parent.name for joint in floating]
    for joint in floating:
        spec.delete(joint)
    drives = _drive_limits(spec)
    _drop_shapes(spec)
    try:
        spec.compiler.fusestatic = False
        with without_warnings():
            model = spec.compile()
    except _FAILURES as error:
        raise _missing_mesh(path, spec, error) or _unreadable(path, error) from error
    label = f'robot description "{path}"'
    _check_supported(label, model)
    if model.njnt > MOST_JOINTS:
        raise ModelError(f"{label}: it has {beyond(MOST_JOINTS, 'joints', model.njnt)}; split the robot")
    joints = tuple(_joint(model, k, drives) for k in range(model.njnt))
    if not joints:
        raise ModelError(f"{label}: there are no joints, and nothing can move")
    flaws = {body.id - 1: flaw for body, flaw in file.flaws}
    bodies = without_placeholders(tuple(_body(model, i) for i in range(1, model.nbody)), flaws)
    name = re.sub(r"\W+", "-", spec.modelname) or Path(path).stem
    measured = _measured_base(label, bodies, names) if base == "measured" else None
    couplings, gravity = tuple(_couplings(label, model)), np.array(model.opt.gravity)
    return Description(name, bodies, joints, couplings, gravity, measured, flaws, file.outline.velocity_limits)


@contextmanager
def without_warnings() -> Iterator[None]:
    """Context of one thread at a time in which MuJoCo warns of nothing, neither here nor in MUJOCO_LOG.TXT.

    It warns of what is left out, such as cloth.
    """
    mujoco = mujoco_module()
    with _ALONE, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        before = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(lambda _: None)
        try:
            yield
        finally:
            mujoco.set_mju_user_warning(before)


def _measured_base(label: str, bodies: Sequence[Body], floating: Sequence[str]) -> int:
    """Index of the body with a free joint.  Raises ModelError: there is not one, or weights are compensated."""
    if len(floating) != 1:
        raise ModelError(f"{label}: {len(floating)} bodies have a free joint; a measured base takes one")
    if any(body.gravity_compensation for body in bodies):
        raise ModelError(f"{label}: gravity compensation on a base whose attitude is not known is not modelled")
    return [body.name for body in bodies].index(floating[0])


def _unreadable(path: str | Path, error: Exception) -> ModelError:
    return ModelError(f'robot description "{path}" cannot be read: {" ".join(str(error).split())}')


def _missing_mesh(path: str | Path, spec: Any, error: Exception) -> ModelError | None:
    """The error of a file of a mesh that is not there and gives a body its inertia; None for another error."""
    missing = re.search(r"opening file '(.*?)'", str(error))
    if missing is None:
        return None
    bodies = list(dict.fromkeys(shape.parent.name or "without a name" for shape in spec.geoms if shape.meshname))
    named = ", ".join(bodies[:5]) + (f" and {len(bodies) - 5} more" if len(bodies) > 5 else "")
    return ModelError(
        f'robot description "{path}": the mesh file "{missing[1]}" does not exist, and bodies without an inertial have '
        f"that of their meshes ({named}); give each an inertial in the description, or the file"
    )


def _drop_shapes(spec: Any) -> None:
    """Remove shapes that give no inertia, and what refers to shapes: files of meshes need not be there."""
    mujoco = mujoco_module()
    by_shapes = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    wrapped = (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CYLINDER) if list(spec.tendons) else ()
    for referring in (spec.pairs, spec.sensors, spec.actuators, spec.keys, spec.skins, spec.lights):
        for element in list(referring):
            spec.delete(element)
    for shape in (x for x in spec.geoms if x.type not in wrapped):
        own = shape.parent
        counts = _moves(own) or spec.compiler.settotalmass > 0.0  # which scales all masses
        if not (counts and gives_inertia(spec, shape)) or (own.explicitinertial and not by_shapes):
            spec.delete(shape)
    for shape in (*spec.geoms, *spec.sites, *spec.tendons):
        shape.material = ""
    needed = {name for shape in spec.geoms for name in (shape.meshname, shape.hfieldname)}
    for mesh in (x for x in (*spec.meshes, *spec.hfields) if x.name not in needed):
        spec.delete(mesh)
    for unused in (*spec.materials, *spec.textures):
        spec.delete(unused)


def _moves(body: Any) -> bool:
    """Whether joints move a body of MuJoCo's editable form."""
    return body.parent is not None and (bool(list(body.joints)) or _moves(body.parent))


def _check_supported(label: str, model: Any) -> None:
    """Raises ModelError: the robot has parts for which there are no equations here, or numbers that overflow."""
    of_bodies = (model.body_mass, model.body_inertia, model.body_ipos, model.body_pos)
    of_joints = (model.dof_armature, model.dof_damping, model.dof_frictionloss, model.jnt_stiffness, model.jnt_pos)
    largest = 1e50  # products of several of them do not overflow
    if not all(np.all(np.abs(x) < largest) for x in (*of_bodies, *of_joints)):
        raise ModelError(f"{label}: a mass, inertia, position or coefficient is {largest:g} or more; correct it")
    kinds = mujoco_module().mjtJoint
    for k in range(model.njnt):
        name = model.joint(k).name
        if model.jnt_type[k] == kinds.mjJNT_FREE:
            raise ModelError(
                f'{label}: the base floats (free joint "{name}"); give base="held" if it was held while the '
                'log was recorded, or base="measured" if its motion was'
            )
        if model.jnt_type[k] == kinds.mjJNT_BALL:
            raise ModelError(f'{label}: joint "{name}" is a ball joint; replace it by three hinges')
    forces = (model.tendon_stiffness, model.tendon_damping, model.tendon_frictionloss)
    if model.ntendon and any(np.any(x) for x in (*forces, getattr(model, "tendon_armature", 0.0))):
        raise ModelError(
            f"{label}: tendons with stiffness, damping, friction or armature are not modelled; remove them"
        )
    if model.opt.density or model.opt.viscosity:
        raise ModelError(f"{label}: forces of a surrounding fluid are not modelled; remove density and viscosity")


def _couplings(label: str, model: Any) -> Iterator[Coupling]:
    """Active equality constraints.  Raises ModelError: one is not between joints, which closes a kinematic loop."""
    mujoco = mujoco_module()
    for k in np.flatnonzero(model.eq_active0):
        if model.eq_type[k] != mujoco.mjtEq.mjEQ_JOINT:
            kind = mujoco.mjtEq(model.eq_type[k]).name.removeprefix("mjEQ_").lower()
            raise ModelError(
                f'{label}: the equality constraint "{model.equality(k).name or k}" ({kind}) closes a kinematic loop, '
                "and only chains and trees are modelled; cut the loop, or couple its joints by polynomials"
            )
        leader = int(model.eq_obj2id[k])
        yield Coupling(int(model.eq_obj1id[k]), None if leader < 0 else leader, tuple(model.eq_data[k, :5].tolist()))


def _drive_limits(spec: Any) -> dict[str, tuple[float, float]]:
    """Range of the force that the actuators of a joint exert, by its name."""
    mujoco = mujoco_module()
    found: dict[str, tuple[float, float]] = {}
    for drive in spec.actuators:
        if drive.trntype != mujoco.mjtTrn.mjTRN_JOINT:
            continue
        ranges = [np.array(drive.forcerange)]
        if drive.gaintype == mujoco.mjtGain.mjGAIN_FIXED and drive.biastype == mujoco.mjtBias.mjBIAS_NONE:
            ranges.append(np.array(drive.ctrlrange) * drive.gainprm[0])
        for force in (np.sort(x * drive.gear[0]) for x in ranges if np.ptp(x) > 0.0):
            low, high = found.get(drive.target, (-np.inf, np.inf))
            found[drive.target] = max(low, float(force[0])), min(high, float(force[1]))
    return found


def _joint(model: Any, k: int, drives: Mapping[str, tuple[float, float]]) -> Joint:
    dof, name, unlimited = model.jnt_dofadr[k], model.joint(k).name, (-np.inf, np.inf)
    low, high = drives.get(name, unlimited)
    if model.jnt_actfrclimited[k]:
        low, high = max(low, float(model.jnt_actfrcrange[k][0])), min(high, float(model.jnt_actfrcrange[k][1]))
    return Joint(
        name=name or f"joint{k}",
        turns=bool(model.jnt_type[k] == mujoco_module().mjtJoint.mjJNT_HINGE),
        axis=_snapped(model.jnt_axis[k]),
        anchor=np.array(model.jnt_pos[k]),
        reference=float(model.qpos0[model.jnt_qposadr[k]]),
        armature=float(model.dof_armature[dof]),
        damping=_polynomial(model.dof_damping[dof], getattr(model, "dof_dampingpoly", None), dof),
        friction=float(model.dof_frictionloss[dof]),
        stiffness=_polynomial(model.jnt_stiffness[k], getattr(model, "jnt_stiffnesspoly", None), k),
        spring_reference=float(model.qpos_spring[model.jnt_qposadr[k]]),
        position_limits=tuple(model.jnt_range[k].tolist()) if model.jnt_limited[k] else unlimited,
        force_limits=(low, high),
    )


def _polynomial(first: float, others: FloatArray | None, k: int) -> tuple[float, ...]:
    """Coefficients without zeros at the end; versions of MuJoCo before 3.5 have the first alone."""
    found = [float(first), *([] if others is None else others[k].tolist())]
    while len(found) > 1 and found[-1] == 0.0:
        found.pop()
    return tuple(found)


def _body(model: Any, i: int) -> Body:
    centre, mass = np.array(model.body_ipos[i]), float(model.body_mass[i])
    axes = _rotation(model.body_iquat[i])
    about_centre = axes @ np.diag(0.5 * model.body_inertia[i].sum() - model.body_inertia[i]) @ axes.T
    second, first_moments = about_centre + mass * np.outer(centre, centre), (mass * centre)[:, None]
    inertial = np.block([[second, first_moments], [first_moments.T, np.array([[mass]])]])
    first = int(model.body_jntadr[i])
    return Body(
        name=model.body(i).name or f"body{i}",
        parent=int(model.body_parentid[i]) - 1,
        rotation=_rotation(model.body_quat[i]),
        position=np.array(model.body_pos[i]),
        joints=tuple(range(first, first + int(model.body_jntnum[i]))),
        inertial=inertial,
        gravity_compensation=float(model.body_gravcomp[i]),
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
