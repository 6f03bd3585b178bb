"""Recordings for the Rerun viewer: measured and predicted signals, outliers, inputs and unmodelled forces over time.

========================  ====================================================================================
entity                    contents
========================  ====================================================================================
``/x/measured``           samples of the signal ``x``; a line that ends at gaps
``/x/predicted``          the simulation that a report shows: restarted where the motion is known; nothing in gaps
``/x/outliers``           samples that are outliers, as points
``/inputs/thrust``        an input
``/unmodelled/x``         unmodelled force, or acceleration, means over windows; of logs of the identification
``/replay/measured/b``    body ``b`` of a machine that MuJoCo simulates, in logs of the identification: in the motion
                          that follows the samples from interval to interval
``/replay/predicted/b``   body ``b`` in the simulation that restarts where a report's does
========================  ====================================================================================

Entities of several logs stand below the name of their log. Bodies have the shapes of their geoms; hulls of meshes are
not simplified, and planes and height fields are left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray, runs
from diransac.atomic import write_with
from diransac.data.checks import rows_per_sample
from diransac.data.log import Log
from diransac.errors import ResultError
from diransac.identification.assessment.open_loop import simulate
from diransac.identification.result import Result
from diransac.model.mjcf import MujocoModel
from diransac.model.robots.compiled import mujoco_module
from diransac.plain_text import one_line
from diransac.report.rendering import encodable
from diransac.report.runs import Entry, Run, simulate_all

_MEASURED, _PREDICTED, _OUTLIERS, _OTHER = (120, 120, 120), (31, 119, 180), (214, 39, 40), (44, 160, 44)
"""Colours, red, green and blue."""


def write_recording(result: Result, logs: Sequence[Log], path: str | Path) -> list[str]:
    """Write an ``.rrd`` file for the Rerun viewer about a result and one or several logs, with the layout of the views.

    Parameters
    ----------
    result : Result
    logs : sequence of Log
        Those that were given to `identify`, or others.
    path : str or Path
        Written whole or not at all.

    Returns
    -------
    list of str
        Sentences on what the file lacks.

    Raises
    ------
    ResultError
        The package rerun-sdk is missing, a log cannot be simulated by the model, or the file cannot be written.
    """
    rerun = _rerun()
    (entry,) = simulate_all({result.method: result}, logs)
    try:
        write_with(path, lambda draft: _write(rerun, entry, draft))
    except OSError as error:
        raise ResultError(f"{path}: cannot be written: {error.strerror or error}") from error
    unknown = [run.log_name for run in entry.runs if run.view.diagnosis is None]
    return [f"{name}: unmodelled forces are unknown; lo-diransac estimates them in its own logs" for name in unknown]


def _rerun() -> Any:
    """The library.  Raises ResultError: it is missing."""
    try:
        import rerun
        import rerun.blueprint
    except ImportError as error:
        raise ResultError(
            'recordings for Rerun need the package rerun-sdk; install it with pip install "diransac[rerun]"'
        ) from error
    return rerun


# ---------------------------------------------------------------------- contents


@dataclass(frozen=True)
class _Series:
    """Samples over time, under the parts of an entity's path; NaN is no sample."""

    path: tuple[str, str]
    name: str
    time: FloatArray
    values: FloatArray
    colour: tuple[int, int, int]
    is_points: bool = False


def _series(run: Run) -> Iterator[_Series]:
    """All series of a log."""
    observations, model = run.observations, run.result.model
    time = observations.log.time[observations.offset :]
    for k, name in enumerate(observations.signals):
        unit, measured = model.units[name], observations.column(name)
        outliers = _outliers(run, name)
        yield _Series((name, "measured"), f"measured, {unit}", time, measured, _MEASURED)
        yield _Series((name, "predicted"), f"predicted, {unit}", time, run.simulated[:, k], _PREDICTED)
        yield _Series((name, "outliers"), "outliers", time[outliers], measured[outliers], _OUTLIERS, is_points=True)
    for name, unit in model.inputs.items():
        recorded = observations.log[name][observations.offset :]
        yield _Series(("inputs", name), f"{name}, {unit}", time, recorded, _OTHER)
    found = run.view.diagnosis
    if found is not None:
        series = found.unmodelled_forces or found.unmodelled_accelerations
        end = float(time[-1]) + observations.log.dt
        stamps = np.column_stack([found.smoothed_time, np.append(found.smoothed_time[1:], end) - observations.log.dt])
        for (name, values), rate in zip(series.items(), model.rate_names, strict=True):
            label = f"unmodelled force on {rate}" if found.unmodelled_forces else f"unmodelled {name}"
            yield _Series(("unmodelled", rate), label, stamps.ravel(), np.repeat(values, 2), _OTHER)


def _outliers(run: Run, name: str) -> BoolArray:
    """Samples (N,) of a signal that are outliers, or whose row disagrees where the noise is unknown."""
    measured = np.isfinite(run.observations.column(name))
    apart = run.outliers[name] if run.screened else run.observations.valid & ~run.inliers
    return np.asarray(apart & measured)


# ---------------------------------------------------------------------- file


def _write(rerun: Any, entry: Entry, file: Path) -> None:
    """Write every log, and a view for the bodies, each signal, the inputs and the unmodelled forces."""
    layout, several = rerun.blueprint, len(entry.runs) > 1
    tabs = []
    recording = rerun.RecordingStream("diransac")
    recording.send_recording_name(_text(f"{entry.result.model.name}: {entry.result.method}"))
    for run in entry.runs:
        above, series = ([_text(run.log_name)] if several else []), list(_series(run))
        for one in series:
            _send(rerun, recording, rerun.new_entity_path([*above, *map(_text, one.path)]), one)
        views = [
            layout.TimeSeriesView(origin=rerun.new_entity_path([*above, _text(group)]), name=_text(group))
            for group in dict.fromkeys(one.path[0] for one in series)
        ]
        if isinstance(run.result.model, MujocoModel) and run.view.diagnosis is not None:
            _send_replay(rerun, recording, above, run)
            views.insert(0, layout.Spatial3DView(origin=rerun.new_entity_path([*above, "replay"]), name="replay"))
        tabs.append(layout.Grid(*views, name=_text(run.log_name)))
    whole = layout.Tabs(*tabs) if several else tabs[0]
    recording.save(file, default_blueprint=layout.Blueprint(whole))
    recording.flush()
    recording.disconnect()


def _send(rerun: Any, recording: Any, path: str, series: _Series) -> None:
    """Send the look of a series, and its samples; at the begin of a gap an empty entry, at which a line ends."""
    look = rerun.SeriesPoints if series.is_points else rerun.SeriesLines
    recording.log(path, look(names=_text(series.name), colors=[series.colour]), static=True)
    known = np.isfinite(series.values)
    sent, usual = known.copy(), rows_per_sample(known)
    sent[[rows.start for rows in runs(~known) if rows.stop - rows.start >= usual]] = True
    if sent.any():
        columns = rerun.Scalars.columns(scalars=series.values[known]).partition(known[sent].astype(np.int64))
        recording.send_columns(path, [rerun.TimeColumn("time", duration=series.time[sent])], columns)


def _text(text: str) -> str:
    """Text of one line in Unicode."""
    return encodable(one_line(text))


# ---------------------------------------------------------------------- bodies


def _send_replay(rerun: Any, recording: Any, above: list[str], run: Run) -> None:
    """Send the bodies' shapes, and at most 50 of their poses a second, below parts of a path."""
    found, log = run.view.diagnosis, run.observations.log
    assert found is not None
    interval = float(np.median(np.diff(found.smoothed_time)))
    for kind, horizon, colour in (("measured", interval, _MEASURED), ("predicted", run.restart_period, _PREDICTED)):
        simulated = simulate(run.result, log, horizon=max(horizon, interval) if np.isfinite(horizon) else None)
        q = np.column_stack([simulated[name] for name in run.result.model.coordinates])
        every = max(1, round(1.0 / (50.0 * simulated.dt)))
        q, time = q[::every], simulated.time[::every]
        known = np.isfinite(q).all(axis=1)
        for body, (places, rotations) in _poses(run, q[known]).items():
            path = rerun.new_entity_path([*above, "replay", kind, body])
            poses = rerun.Transform3D.columns(translation=places, quaternion=rotations)
            recording.send_columns(path, [rerun.TimeColumn("time", duration=time[known])], poses)
        for body, k, shape in _shapes(rerun, run, colour):
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
