"""Replay of a machine that MuJoCo simulates: its bodies as the log shows them, and as the model predicts them.

========================  ====================================================================================
entity                    contents
========================  ====================================================================================
``/replay/measured/b``    body ``b`` in the motion that follows the samples from interval to interval
``/replay/predicted/b``   body ``b`` in the simulation that restarts where a report's does
========================  ====================================================================================

Bodies have the shapes of their geoms; hulls of meshes are not simplified, and planes and height fields are left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.assessment.open_loop import simulate
from diransac.model.mjcf import MujocoModel
from diransac.model.robots.description import mujoco_module
from diransac.report.runs import Run

_RATE = 50.0
"""Poses per second at most."""


def can_replay(run: Run) -> bool:
    """True if there are bodies, and the motion of the log is known."""
    return isinstance(run.result.model, MujocoModel) and run.view.diagnosis is not None


def send_replay(
    rerun: Any, recording: Any, above: list[str], run: Run, colours: Mapping[str, tuple[int, int, int]]
) -> None:
    """Send the bodies' shapes, and their poses over time.

    Parameters
    ----------
    rerun : module
    recording : rerun.RecordingStream
    above : list of str
        Parts of the path above the entities.
    run : Run
        For which `can_replay` is true.
    colours : mapping of str to (red, green, blue)
        Of ``measured`` and ``predicted``.
    """
    found, log = run.view.diagnosis, run.observations.log
    assert found is not None
    interval = float(np.median(np.diff(found.smoothed_time)))
    for kind, horizon in (("measured", interval), ("predicted", run.restart_period)):
        simulated = simulate(run.result, log, horizon=max(horizon, interval))
        q = np.column_stack([simulated[name] for name in run.result.model.coordinates])
        every = max(1, round(1.0 / (_RATE * simulated.dt)))
        q, time = q[::every], simulated.time[::every]
        known = np.isfinite(q).all(axis=1)
        for body, (places, rotations) in _poses(run, q[known]).items():
            path = rerun.new_entity_path([*above, "replay", kind, body])
            poses = rerun.Transform3D.columns(translation=places, quaternion=rotations)
            recording.send_columns(path, [rerun.TimeColumn("time", duration=time[known])], poses)
        for body, k, shape in _shapes(rerun, run, colours[kind]):
            recording.log(rerun.new_entity_path([*above, "replay", kind, body, str(k)]), shape, static=True)


def _poses(run: Run, q: FloatArray) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Places ``(N, 3)`` and quaternions ``(N, 4)``, the real part last, of all bodies with geoms, by name."""
    module, compiled = mujoco_module(), _compiled(run)
    data = module.MjData(compiled)
    places, rotations = np.empty((len(q), compiled.nbody, 3)), np.empty((len(q), compiled.nbody, 4))
    for k, one in enumerate(q):
        data.qpos[:] = one
        module.mj_kinematics(compiled, data)
        places[k], rotations[k] = data.xpos, data.xquat[:, [1, 2, 3, 0]]
    return {_name(compiled, b): (places[:, b], rotations[:, b]) for b in sorted({*compiled.geom_bodyid.tolist()} - {0})}


def _shapes(rerun: Any, run: Run, colour: tuple[int, int, int]) -> Iterator[tuple[str, int, Any]]:
    """Name of the body, number, and shape of each geom that moves."""
    compiled = _compiled(run)
    kinds = mujoco_module().mjtGeom
    for k in range(compiled.ngeom):
        body, size = int(compiled.geom_bodyid[k]), compiled.geom_size[k]
        if body == 0:
            continue
        places, rotations = [compiled.geom_pos[k]], [compiled.geom_quat[k][[1, 2, 3, 0]]]
        pose = {"centers": places, "quaternions": rotations, "colors": [colour]}
        kind, shape = kinds(int(compiled.geom_type[k])), None
        if kind == kinds.mjGEOM_BOX:
            shape = rerun.Boxes3D(half_sizes=[size], **pose)
        elif kind in (kinds.mjGEOM_SPHERE, kinds.mjGEOM_ELLIPSOID):
            sizes = np.full(3, size[0]) if kind == kinds.mjGEOM_SPHERE else size
            shape = rerun.Ellipsoids3D(half_sizes=[sizes], **pose)
        elif kind == kinds.mjGEOM_CYLINDER:
            shape = rerun.Cylinders3D(lengths=[2.0 * size[1]], radii=[size[0]], **pose)
        elif kind == kinds.mjGEOM_CAPSULE:
            shape = _capsule(rerun, compiled, k, colour)
        elif kind == kinds.mjGEOM_MESH:
            shape = _mesh(rerun, compiled, k, colour)
        if shape is not None:
            yield _name(compiled, body), k, shape


def _capsule(rerun: Any, compiled: Any, geom: int, colour: tuple[int, int, int]) -> Any:
    """A geom's capsule, which the viewer counts from one of its ends, in the frame of its body."""
    radius, half = compiled.geom_size[geom][:2]
    axis = np.empty(3)
    mujoco_module().mju_rotVecQuat(axis, np.array([0.0, 0.0, half]), compiled.geom_quat[geom])
    return rerun.Capsules3D(
        lengths=[2.0 * half],
        radii=[radius],
        translations=[compiled.geom_pos[geom] - axis],
        quaternions=[compiled.geom_quat[geom][[1, 2, 3, 0]]],
        colors=[colour],
    )


def _mesh(rerun: Any, compiled: Any, geom: int, colour: tuple[int, int, int]) -> Any:
    """Triangles of a geom, in the frame of its body."""
    mesh = int(compiled.geom_dataid[geom])
    first, n = compiled.mesh_vertadr[mesh], compiled.mesh_vertnum[mesh]
    face, m = compiled.mesh_faceadr[mesh], compiled.mesh_facenum[mesh]
    rotation = np.empty(9)
    mujoco_module().mju_quat2Mat(rotation, compiled.geom_quat[geom])
    vertices = compiled.mesh_vert[first : first + n] @ rotation.reshape(3, 3).T + compiled.geom_pos[geom]
    triangles = compiled.mesh_face[face : face + m]
    return rerun.Mesh3D(vertex_positions=vertices, triangle_indices=triangles, albedo_factor=colour)


def _compiled(run: Run) -> Any:
    model = run.result.model
    assert isinstance(model, MujocoModel)
    return model.compiled


def _name(compiled: Any, body: int) -> str:
    return compiled.body(body).name or f"body {body}"
