"""An MJCF or URDF as MuJoCo compiles it, without what is only looked at, and the names of its signals."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.errors import ModelError
from diransac.model.robots.actuation import JointTorques, MotorCurrents, PositionControl
from diransac.model.robots.compiled import further_states, mujoco_module, parsed, without_warnings
from diransac.model.robots.document import Document
from diransac.model.robots.inertias import THIN_IN_TEXT, notes_on_simulated
from diransac.model.robots.mechanism import identifier
from diransac.model.robots.written import with_inertials

if TYPE_CHECKING:
    from pathlib import Path

    from diransac.model.robots.actuation import Actuation


@dataclass(frozen=True)
class JointColumns:
    """Columns of the state that a joint has: coordinates and velocities with units by name, names of accelerations."""

    coordinates: dict[str, str]
    velocities: dict[str, str]
    accelerations: tuple[str, ...]


@dataclass(frozen=True)
class SensorColumns:
    """Readings of a sensor.

    Parameters
    ----------
    name : str
    columns : tuple of str
    unit : str
    first : int
        Place of the first reading in MuJoCo's ``sensordata``.
    of_forces : bool
        Whether accelerations or forces act on it.
    """

    name: str
    columns: tuple[str, ...]
    unit: str
    first: int
    of_forces: bool


def compiled_text(path: str | Path, actuation: Actuation | None) -> tuple[str, dict[str, str] | None, tuple[str, ...]]:
    """A description as one text that MuJoCo reads, without visual shapes and other files; and the drives' inputs.

    Parameters
    ----------
    path : str or Path
        MJCF or URDF.
    actuation : Actuation, optional
        Drives in place of the file's actuators; None: those.

    Returns
    -------
    str
    dict of str to str, or None
        Unit of each input, in the order of MuJoCo's controls; None: the file's actuators.
    tuple of str
        Notes on inertias that are not the file's.

    Raises
    ------
    ModelError
        The file cannot be read, or has what is not simulated here: plugins, soft bodies, delays; or the drives are none
        that MuJoCo has; or nothing that a joint moves has a mass.
    """
    label, file = f'robot description "{path}"', parsed(path, thin=THIN_IN_TEXT)
    spec = file.spec
    for what, elements in (("plugins", spec.plugins), ("soft bodies (flex)", spec.flexes)):
        if len(list(elements)):
            raise ModelError(f"{label} has {what}, which are not simulated here; leave them out")
    spec.compiler.discardvisual, spec.compiler.fusestatic = True, False
    if spec.compiler.inertiafromgeom == mujoco_module().mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        _forget_inertias(spec)  # visual shapes have a part in those that MuJoCo infers
    for element in (*spec.skins, *spec.lights, *spec.cameras):
        spec.delete(element)
    drives = None if actuation is None else _with_drives(label, spec, actuation)
    home = compiled_of(label, spec)
    pose = {"qpos": home.key_qpos[0].copy(), "act": home.key_act[0].copy()} if home.nkey else {}
    for element in list(spec.keys):
        spec.delete(element)
    if pose:
        spec.add_key(name="home", **pose)
    compiled = compiled_of(label, spec)
    _check_state(label, compiled)
    notes = notes_on_simulated(label, compiled, file.flaws)
    for mesh in list(spec.meshes):
        _embed(mesh, compiled)
    compiled = compiled_of(label, spec)
    with without_warnings():
        text = str(spec.to_xml())
    own = spec.compiler  # whose bounds would act again, on what is scaled
    if own.settotalmass > 0.0 or own.boundmass or own.boundinertia or own.balanceinertia:
        text = with_inertials(Document(text.encode(), label), compiled)
    return text, drives, notes


def compiled_of(label: str, source: Any) -> Any:
    """MuJoCo's model of a text, or of its editable form.  Raises ModelError: MuJoCo finds an error."""
    mujoco = mujoco_module()
    try:
        with without_warnings():
            return mujoco.MjModel.from_xml_string(source) if isinstance(source, str) else source.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise ModelError(f"{label} cannot be compiled: {' '.join(str(error).split()):.300}") from error


def _forget_inertias(spec: Any) -> None:
    """Have MuJoCo infer the inertia of each body from its shapes before it discards those that are only looked at."""
    low, high = spec.compiler.inertiagrouprange
    for body in spec.bodies:
        if any(low <= shape.group <= high for shape in body.geoms):
            body.ipos, body.explicitinertial = [np.nan] * 3, False
    spec.compiler.inertiafromgeom = mujoco_module().mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO


def _check_state(label: str, compiled: Any) -> None:
    """Raise ModelError where the state is more than positions, velocities and activations."""
    if found := further_states(compiled):
        raise ModelError(f"{label} has states of {', '.join(found)}, which are not simulated here; leave these out")
    if not compiled.nv:
        raise ModelError(f"{label} has no joint: nothing in it moves")


def _embed(mesh: Any, compiled: Any) -> None:
    """Give a mesh that a file describes its vertices and faces in the text."""
    k = compiled.mesh(mesh.name).id
    vertices = slice(compiled.mesh_vertadr[k], compiled.mesh_vertadr[k] + compiled.mesh_vertnum[k])
    faces = slice(compiled.mesh_faceadr[k], compiled.mesh_faceadr[k] + compiled.mesh_facenum[k])
    turn = np.empty(9)
    mujoco_module().mju_quat2Mat(turn, compiled.mesh_quat[k])
    points = compiled.mesh_vert[vertices] @ turn.reshape(3, 3).T + compiled.mesh_pos[k]
    mesh.file, mesh.scale, mesh.refpos, mesh.refquat = "", [1, 1, 1], [0, 0, 0], [1, 0, 0, 0]
    mesh.uservert, mesh.userface = points.ravel(), compiled.mesh_face[faces].ravel()
    mesh.usernormal, mesh.usertexcoord = [], []


# ---------------------------------------------------------------------- drives


def _with_drives(label: str, spec: Any, actuation: Actuation) -> dict[str, str]:
    """Replace the actuators of a description, and return the inputs of the new ones, with units."""
    mujoco = mujoco_module()
    is_joint = [x for x in spec.actuators if x.trntype == mujoco.mjtTrn.mjTRN_JOINT]
    driven = {x.target for x in is_joint}
    for element in [*spec.sensors, *spec.actuators]:
        if element in list(spec.actuators) or element.objtype == mujoco.mjtObj.mjOBJ_ACTUATOR:
            spec.delete(element)
    for key in spec.keys:
        key.ctrl, key.act = [], []
    turn_or_slide = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    moved = [x for x in spec.joints if x.type in turn_or_slide and (not driven or x.name in driven)]
    if not moved:
        raise ModelError(f"{label}: no hinge or slide has a drive; leave actuation out")
    inputs = dict[str, str]()
    for joint in moved:
        name = identifier(joint.name)
        is_slide = joint.type == mujoco.mjtJoint.mjJNT_SLIDE
        units = ("m", "N") if is_slide else ("rad", "N m")
        limit = actuation.largest_force(name)
        if np.isfinite(limit):
            joint.actfrclimited, joint.actfrcrange = True, [-limit, limit]
        own = actuation.inputs(name, units)
        for column, (gain, bias) in zip(own, _gains(label, actuation, name), strict=True):
            new = spec.add_actuator(name=column, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            new.gainprm[0], new.biastype = gain, mujoco.mjtBias.mjBIAS_AFFINE
            new.biasprm[1:3] = bias
        inputs |= own
    return inputs


def _gains(label: str, actuation: Actuation, joint: str) -> list[tuple[float, tuple[float, float]]]:
    """Gain and bias (of position, of velocity) of MuJoCo's actuators for each input of a joint's drive."""
    if isinstance(actuation, JointTorques):
        return [(1.0, (0.0, 0.0))]
    if isinstance(actuation, MotorCurrents):
        return [(actuation.force_per_current(joint), (0.0, 0.0))]
    if not isinstance(actuation, PositionControl):
        raise ModelError(
            f"{label}: actuation is {actuation!r:.60}; give dr.JointTorques, dr.PositionControl or dr.MotorCurrents"
        )
    kp, kd = actuation.gains(joint)
    found = [(kp, (-kp, 0.0 if actuation.velocity else -kd))]
    found += [(kd, (0.0, -kd))] if actuation.velocity else []
    return [*found, (1.0, (0.0, 0.0))] if actuation.feedforward else found


def file_drives(compiled: Any, taken: Collection[str]) -> dict[str, str]:
    """Inputs of the actuators of the file, named after them; one that another signal has is ``<name>_ctrl``."""
    inputs = dict[str, str]()
    for k in range(len(compiled.actuator_trntype)):
        name = identifier(compiled.actuator(k).name or f"actuator_{k}")
        n = int(compiled.actuator_ctrlnum[k]) if hasattr(compiled, "actuator_ctrlnum") else 1
        name = f"{name}_ctrl" if name in taken else name
        inputs |= {name if n == 1 else f"{name}_{i}": "1" for i in range(n)}
    return inputs


def position_targets(compiled: Any, inputs: Sequence[str]) -> dict[str, str]:
    """Coordinate by the name of each input that is the target of its position: ``force = kp (target - q) - ...``.

    Parameters
    ----------
    compiled : mujoco.MjModel
    inputs : sequence of str
        Names in the order of MuJoCo's controls.
    """
    on_joint, found = mujoco_module().mjtTrn.mjTRN_JOINT, dict[str, str]()
    if len(compiled.actuator_trntype) != len(inputs):  # an actuator has several controls
        return found
    for k in range(len(inputs)):
        kp, kq = compiled.actuator_gainprm[k][0], compiled.actuator_biasprm[k][1]
        if compiled.actuator_trntype[k] == on_joint and compiled.actuator_gear[k][0] == 1.0 and kp == -kq > 0.0:
            found[inputs[k]] = identifier(compiled.joint(compiled.actuator_trnid[k][0]).name)
    return found


def joint_ranges(compiled: Any) -> dict[str, tuple[float, float]]:
    """Range of each hinge and slide that the file limits, in rad or m."""
    kinds = mujoco_module().mjtJoint
    one_axis = np.isin(compiled.jnt_type, [kinds.mjJNT_HINGE, kinds.mjJNT_SLIDE])
    limited = np.flatnonzero(one_axis & (compiled.jnt_limited != 0) & (np.ptp(compiled.jnt_range, axis=1) > 0.0))
    return {
        identifier(compiled.joint(k).name or f"joint_{k}"): tuple(compiled.jnt_range[k].tolist())
        for k in limited.tolist()
    }


def activations(compiled: Any, taken: Collection[str]) -> dict[str, str]:
    """States of actuators that have dynamics, ``<name>_activation``, with units."""
    states = dict[str, str]()
    for k in np.flatnonzero(compiled.actuator_actnum):
        name, n = identifier(compiled.actuator(k).name or f"actuator_{k}"), int(compiled.actuator_actnum[k])
        name = f"{name}_state" if f"{name}_activation" in taken else f"{name}_activation"
        states |= {name if n == 1 else f"{name}_{i}": "1" for i in range(n)}
    return states


# ---------------------------------------------------------------------- names


def joint_columns(compiled: Any) -> Iterator[JointColumns]:
    """Coordinates, velocities and accelerations of each joint, in MuJoCo's order."""
    kinds = mujoco_module().mjtJoint
    for k in range(compiled.njnt):
        kind, joint = kinds(int(compiled.jnt_type[k])), compiled.joint(k)
        if kind == kinds.mjJNT_FREE:
            name = identifier(joint.name or compiled.body(compiled.jnt_bodyid[k]).name or f"base_{k}")
            position = {f"{name}_{x}": "m" for x in "xyz"} | {f"{name}_q{x}": "1" for x in "wxyz"}
            velocity = {f"{name}_v{x}": "m/s" for x in "xyz"} | {f"{name}_w{x}": "rad/s" for x in "xyz"}
        elif kind == kinds.mjJNT_BALL:
            name = identifier(joint.name or f"joint_{k}")
            position = {f"{name}_q{x}": "1" for x in "wxyz"}
            velocity = {f"{name}_w{x}": "rad/s" for x in "xyz"}
        else:
            name = identifier(joint.name or f"joint_{k}")
            unit = "m" if kind == kinds.mjJNT_SLIDE else "rad"
            yield JointColumns({name: unit}, {f"{name}_dot": f"{unit}/s"}, (f"{name}_ddot",))
            continue
        yield JointColumns(position, velocity, tuple(f"{x}_dot" for x in velocity))


_UNITS = {
    "ACCELEROMETER": "m/s^2", "GYRO": "rad/s", "VELOCIMETER": "m/s", "FORCE": "N", "TORQUE": "N m", "TOUCH": "N",
    "RANGEFINDER": "m", "TENDONPOS": "m", "TENDONVEL": "m/s", "BALLANGVEL": "rad/s", "FRAMEPOS": "m",
    "FRAMELINVEL": "m/s", "FRAMEANGVEL": "rad/s", "FRAMELINACC": "m/s^2", "FRAMEANGACC": "rad/s^2",
    "SUBTREECOM": "m", "SUBTREELINVEL": "m/s",
}  # fmt: skip


def sensor_columns(compiled: Any, states: Collection[str]) -> Iterator[SensorColumns]:
    """Readings of the sensors of the file; without positions and velocities of joints, which are states.

    A reading that is named as a state is ``<name>_sensor``.
    """
    kinds = mujoco_module().mjtSensor
    of_states = {kinds.mjSENS_JOINTPOS, kinds.mjSENS_JOINTVEL, kinds.mjSENS_CLOCK}
    for k in range(compiled.nsensor):
        kind = kinds(int(compiled.sensor_type[k]))
        if kind in of_states or int(compiled.sensor_datatype[k]) == 4:  # numbers of other kinds, of a user
            continue
        name, size = identifier(compiled.sensor(k).name or f"sensor_{k}"), int(compiled.sensor_dim[k])
        name = f"{name}_sensor" if name in states else name
        ends = {1: [""], 3: ["_x", "_y", "_z"], 4: ["_qw", "_qx", "_qy", "_qz"]}.get(
            size, [f"_{i}" for i in range(size)]
        )
        unit = _UNITS.get(kind.name.removeprefix("mjSENS_"), "1")
        of_forces = int(compiled.sensor_needstage[k]) == 3
        yield SensorColumns(name, tuple(name + x for x in ends), unit, int(compiled.sensor_adr[k]), of_forces)
