"""`Scenes`: shapes of a machine and their places over time, measured and predicted, for the view in three dimensions.

MuJoCo reads descriptions and places bodies, in a process of its own, so that no file can end that of the page.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import re
import tomllib
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import ModelError
from diransac.process import end_with_parent

if TYPE_CHECKING:
    from diransac.data.log import Log


class Scenes:
    """Process that makes scenes; it is started with the first one."""

    def __init__(self) -> None:
        self._pool: ProcessPoolExecutor | None = None

    def content(
        self, model: str, path: str | None, roots: Sequence[str], measured: Log | None, predicted: Log | None
    ) -> bytes:
        """A header in JSON with its length before it, and numbers of 32 bits: corners of shapes, then their places.

        Parameters
        ----------
        model : str
            Name of a built-in model, unless there is a file.
        path : str, optional
            The description of a robot.
        roots : sequence of str
            Folders from which a description may take meshes.
        measured, predicted : Log, optional
            Coordinates over time.

        Raises
        ------
        ModelError
            There is no drawing of the model, or the description cannot be drawn.
        """
        if self._pool is None:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(1, mp_context=context, initializer=end_with_parent)
        time = _moments(measured)
        columns = [_at(log, time) for log in (measured, predicted)]
        try:
            return self._pool.submit(_content, model, path, list(roots), time, columns).result(timeout=30.0)
        except (BrokenProcessPool, TimeoutError) as error:
            self.close()
            raise ModelError("the description cannot be drawn: MuJoCo ended, or took too long") from error

    def close(self) -> None:
        """End the process."""
        if self._pool is not None:
            for process in list(getattr(self._pool, "_processes", {}).values()):
                process.kill()
            self._pool.shutdown(wait=False, cancel_futures=True)
            self._pool = None


def _moments(log: Log | None) -> FloatArray:
    """Times of at most 500 frames, s."""
    if log is None:
        return np.zeros(1)
    return np.asarray(log.time[np.unique(np.linspace(0, len(log) - 1, 500).astype(np.int64))])


def _at(log: Log | None, time: FloatArray) -> dict[str, FloatArray]:
    """The signals of a log at some moments: the last known sample of each."""
    if log is None:
        return {}
    rows = np.clip(np.rint((time - log.time[0]) / log.dt).astype(np.int64), 0, len(log) - 1)
    found = {}
    for name in log.names:
        known = np.where(np.isfinite(log[name]), np.arange(len(log)), 0)
        found[name] = np.nan_to_num(log[name][np.maximum.accumulate(known)[rows]])
    return found


# ---------------------------------------------------------------------- in the other process


def _content(
    model: str, path: str | None, roots: list[str], time: FloatArray, columns: list[dict[str, FloatArray]]
) -> bytes:
    """As `Scenes.content`.  Raises ModelError: as there."""
    try:
        compiled = _compiled(model, path, roots)
    except (ValueError, RuntimeError, MemoryError) as error:
        raise ModelError(f"the description cannot be drawn: {' '.join(str(error).split())}") from error
    chosen = _shown_geoms(compiled)
    corners = [_corners(compiled, k) for k in chosen]
    if sum(map(np.size, corners)) > 30_000_000:  # coordinates
        raise ModelError("the description cannot be drawn: its meshes have too many corners")
    places = [_places(compiled, chosen, values, len(time)) for values in columns if values] or [
        _places(compiled, chosen, {}, 1)
    ]
    shapes = [
        {"count": len(found) // 2, "color": compiled.geom_rgba[k, :3].tolist(), "moves": bool(compiled.geom_bodyid[k])}
        for k, found in zip(chosen, corners, strict=True)
    ]
    head = {"shapes": shapes, "time": time[: len(places[0])].tolist(), "motions": len(places)}
    text = json.dumps(head).encode()
    text += b" " * (-len(text) % 4)
    body = [np.asarray(x, np.float32).ravel() for x in (*corners, *places)]
    return len(text).to_bytes(4, "little") + text + np.concatenate(body).tobytes()


def _compiled(model: str, path: str | None, roots: list[str]) -> Any:
    """MuJoCo's model, with visual shapes; bodies without any are drawn as links."""
    from diransac.model.robots.compiled import mujoco_module, parsed

    mujoco = mujoco_module()
    if path is None:
        known = tomllib.loads((Path(__file__).parent / "machines.toml").read_text(encoding="utf-8"))
        if model.replace("_", "-") not in known:
            raise ModelError("there is no drawing of this model")
        return mujoco.MjSpec.from_string(known[model.replace("_", "-")]).compile()
    spec = _with_visuals(mujoco, path, parsed(path).spec)
    for unused in (spec.materials, spec.textures, spec.skins, spec.keys):
        for element in list(unused):
            spec.delete(element)
    for shape in spec.geoms:
        shape.material = ""
    _find_meshes(spec, path, roots)
    if not [x for x in spec.geoms if x.type != mujoco.mjtGeom.mjGEOM_PLANE]:
        _draw_links(mujoco, spec)
    return spec.compile()


def _find_meshes(spec: Any, path: str, roots: list[str]) -> None:
    """Take meshes from below the folders alone; shapes of others are left out."""
    spec.strippath = False
    strange = set()
    for mesh in list(spec.meshes):
        file = _mesh_file(path, spec.meshdir, mesh.file, roots) if mesh.file else ""
        if file is None:
            strange.add(mesh.name)
            spec.delete(mesh)
        elif file:
            mesh.file = file
    for shape in [shape for shape in spec.geoms if shape.meshname in strange]:
        spec.delete(shape)


def _draw_links(mujoco: Any, spec: Any) -> None:
    """Add a ball for each body, and a line from the one that bears it."""
    for body in [body for body in spec.bodies if body.name != "world"]:
        ends = [0.0, 0.0, 0.0, *body.pos]
        if np.linalg.norm(body.pos) > 1e-3:
            body.parent.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=ends, size=[0.02, 0, 0], mass=0)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.035, 0, 0], mass=0)


def _with_visuals(mujoco: Any, path: str, spec: Any) -> Any:
    """The description with the visual shapes of a URDF file, which MuJoCo drops unless the file says otherwise."""
    from diransac.model.robots.inertias import repair

    text = Path(path).read_text(encoding="utf-8", errors="replace")
    if not re.search(r"<robot\b", text):
        return spec
    wanted = '<compiler discardvisual="false"'
    if re.search(r"<compiler\b", text):
        text = re.sub(r"<compiler\b(?:\s+discardvisual=\"\w*\")?", wanted, text, count=1)
    else:
        text = re.sub(r"(<robot\b[^>]*>)", rf"\1<mujoco>{wanted}/></mujoco>", text, count=1)
    try:
        found = mujoco.MjSpec.from_string(text)
    except (ValueError, RuntimeError):
        return spec
    found.modelfiledir = str(Path(path).parent)
    repair(found, is_urdf=True)
    return found


def _mesh_file(path: str, folder: str, file: str, roots: list[str]) -> str | None:
    """A mesh below the folders: beside the description, or in the package of ``package://``; None for any other."""
    within = re.sub(r"^package:/+[^/]*/", "", file)
    for place in Path(path).parents:
        real = Path(os.path.realpath(place / folder / within))
        if not any(real.is_relative_to(root) for root in roots):
            break
        if real.is_file():
            return str(real)
    return None


def _shown_geoms(compiled: Any) -> list[int]:
    """Shapes that are drawn: visual ones where there are any; no planes and fields of heights."""
    kinds = np.asarray(compiled.geom_type)
    solid = [k for k in range(compiled.ngeom) if kinds[k] >= 2 and kinds[k] <= 7]
    visual = [k for k in solid if not (compiled.geom_contype[k] or compiled.geom_conaffinity[k])]
    return visual or solid


def _places(compiled: Any, chosen: list[int], values: Mapping[str, FloatArray], n: int) -> FloatArray:
    """Rotation matrices and positions ``(n, n_shapes, 12)``."""
    from diransac.model.robots.compiled import mujoco_module

    mujoco = mujoco_module()
    data, found = mujoco.MjData(compiled), np.empty((n, len(chosen), 12))
    columns = list(_columns(compiled, values))
    for i in range(n):
        for k, column in columns:
            data.qpos[k] = column[i]
        mujoco.mj_kinematics(compiled, data)
        found[i, :, :9], found[i, :, 9:] = data.geom_xmat[chosen], data.geom_xpos[chosen]
    return found


def _columns(compiled: Any, values: Mapping[str, FloatArray]) -> Any:
    """Places of ``qpos`` and their values over time."""
    from diransac.model.robots.mechanism import identifier

    for k in range(compiled.njnt):
        name, place = compiled.joint(k).name or f"joint{k}", int(compiled.jnt_qposadr[k])
        short = next(
            (x for x in (name, identifier(name), identifier(name.removesuffix("_joint"))) if x in values), None
        )
        if compiled.jnt_type[k] >= 2 and short is not None:
            yield place, values[short]
        elif compiled.jnt_type[k] == 1:
            for i, part in enumerate("wxyz"):
                if f"{name}{part}" in values:
                    yield place + i, values[f"{name}{part}"]


# ---------------------------------------------------------------------- shapes as triangles


def _corners(compiled: Any, k: int) -> FloatArray:
    """Corners and normals ``(2 n, 3)`` of the triangles of a shape, in turn."""
    kind, size = int(compiled.geom_type[k]), np.asarray(compiled.geom_size[k])
    if kind == 7:
        return _of_mesh(compiled, int(compiled.geom_dataid[k]))
    if kind == 6:
        return _flat(_box() * size)
    profile = _profile(kind, size)
    angles = np.linspace(0.0, 2.0 * np.pi, 25)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = np.concatenate(
        [profile[:, None, :1] * ring, np.repeat(profile[:, None, 1:], len(ring), axis=1)], axis=2
    )  # (n, m, 3)
    points = points * [1.0, size[1] / size[0], 1.0] if kind == 4 else points
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    return _flat(np.stack([a, d, c, a, c, b], axis=2).reshape(-1, 3))


def _profile(kind: int, size: FloatArray) -> FloatArray:
    """Radius and height ``(n, 2)`` of a solid of revolution, from below: sphere, capsule, ellipsoid, cylinder."""
    turn = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 12)
    if kind == 5:
        return np.array([[0, -size[1]], [size[0], -size[1]], [size[0], size[1]], [0, size[1]]])
    height = size[2] if kind == 4 else size[0]
    along = np.where(turn < 0.0, -size[1], size[1]) if kind == 3 else 0.0
    return np.column_stack([size[0] * np.cos(turn), height * np.sin(turn) + along])


def _box() -> FloatArray:
    """Corners (36, 3) of the triangles of a cube from -1 to 1."""
    face = np.array([[1, -1, -1], [1, 1, -1], [1, 1, 1], [1, -1, -1], [1, 1, 1], [1, -1, 1]], float)
    turned = [np.roll(face, shift, axis=1) for shift in range(3)]
    return np.concatenate([*turned, *(-x[::-1] for x in turned)])


def _of_mesh(compiled: Any, mesh: int) -> FloatArray:
    first, n = compiled.mesh_faceadr[mesh], compiled.mesh_facenum[mesh]
    begin = compiled.mesh_vertadr[mesh]
    vertices = np.asarray(compiled.mesh_vert[begin : begin + compiled.mesh_vertnum[mesh]])
    return _flat(vertices[compiled.mesh_face[first : first + n]].reshape(-1, 3))


def _flat(points: FloatArray) -> FloatArray:
    """Corners with the normals of their triangles ``(2 n, 3)``."""
    triangles = points.reshape(-1, 3, 3)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    found = np.empty((len(points), 2, 3))
    found[:, 0], found[:, 1] = points, np.repeat(normals, 3, axis=0)
    return found.reshape(-1, 3)
