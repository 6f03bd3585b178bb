"""Recordings for the Rerun viewer, read back with its own library."""

import sys
from importlib.util import find_spec

import numpy as np
import pytest

import diransac as dr
from command_line import MODEL, contents, run, swim, working_folder
from diransac.report.runs import simulate_all
from diransac.report.viewer import write_recording

T = 0.02 * np.arange(800)
OUTLIERS = np.arange(50, 760, 60)
GAP = slice(300, 340)


needs_rerun = pytest.mark.skipif(find_spec("rerun") is None, reason="NOT CHECKED: rerun-sdk is missing")


def swum(frequency: float = 1.3) -> dr.Log:
    """A vehicle whose velocity has outliers, and whose log has a gap."""
    columns = swim(T, frequency)
    columns["thrust"] = columns["thrust"] + 8.0 * np.sin(0.4 * T)  # an unmodelled force
    rng = np.random.default_rng(1)
    columns = {name: columns[name] for name in ("x", "x_dot", "thrust")}
    columns["x_dot"] = columns["x_dot"] + 1e-3 * rng.normal(size=len(T))
    columns["x_dot"][OUTLIERS] += 5.0
    for values in columns.values():
        values[GAP] = np.nan
    return dr.Log.from_arrays(T, columns, source=f'log "{frequency}/\n\ud800.csv"')


@pytest.fixture(scope="module")
def identified():
    log = swum()
    return dr.identify(dr.models.underwater_vehicle(), log), log


def read(path):
    """Times, s, and values, an empty list where there is none, by entity; properties of each entity; views."""
    from rerun import chunk as chunks

    series: dict[str, tuple[list[float], list[list[float]]]] = {}
    looks: dict[str, set[str]] = {}
    reader = chunks.RrdReader(path)
    (recording,), (_,) = reader.recordings(), reader.blueprints()
    assert recording.application_id == "diransac"
    for chunk in reader.stream():
        batch = chunk.to_record_batch()
        if chunk.is_static:
            looks.setdefault(chunk.entity_path, set()).update(batch.schema.names)
            continue
        assert chunk.timeline_names == ["time"]
        times, values = series.setdefault(chunk.entity_path, ([], []))
        times += [x.value / 1e9 for x in batch.column("time")]
        values += batch.column("Scalars:scalars").to_pylist()
    return series, looks


def rows_of(series):
    """Rows of the log, and samples, NaN for an empty entry."""
    times, values = series
    rows = np.rint(np.array(times) / 0.02).astype(int)
    np.testing.assert_allclose(times, T[rows], atol=1e-9)
    return rows.tolist(), np.array([x[0] if x else np.nan for x in values])


@needs_rerun
def test_a_slow_signal_is_a_line_through_its_samples(tmp_path):
    columns = swim(T)
    columns["x"] = np.where(np.arange(800) % 5 == 0, columns["x"], np.nan)
    columns["x"][200:300] = np.nan
    log = dr.Log.from_arrays(T, {name: columns[name] for name in ("x", "x_dot", "x_ddot", "thrust")})
    write_recording(dr.identify(dr.models.underwater_vehicle(), log), [log], tmp_path / "c.rrd")
    rows, values = rows_of(read(tmp_path / "c.rrd")[0]["/x/measured"])
    assert rows == sorted([*np.flatnonzero(np.isfinite(columns["x"])), 196])
    assert np.isnan(values[rows.index(196)])


@needs_rerun
def test_signals_predictions_outliers_inputs_and_forces_are_read_back(identified, tmp_path):
    result, log = identified
    assert write_recording(result, [log], tmp_path / "a.rrd") == []
    series, looks = read(tmp_path / "a.rrd")
    ((run_of_log,),) = (entry.runs for entry in simulate_all({"": result}, [log]))
    signals = run_of_log.observations.signals
    assert set(series) == {
        *(f"/{name}/{what}" for name in signals for what in ("measured", "predicted")),
        "/x_dot/outliers",
        "/inputs/thrust",
        "/unmodelled/x",
    }
    for k, name in enumerate(signals):
        for what, expected in (("measured", log[name]), ("predicted", run_of_log.simulated[:, k])):
            rows, values = rows_of(series[f"/{name}/{what}"])
            known = np.isfinite(expected)
            assert rows == sorted([*np.flatnonzero(known), *np.flatnonzero(np.diff(known.astype(int)) < 0) + 1])
            np.testing.assert_array_equal(values, expected[rows])
    times, values = series["/x_dot/outliers"]
    np.testing.assert_allclose(times, T[OUTLIERS], atol=1e-9)
    np.testing.assert_array_equal(np.ravel(values), log["x_dot"][OUTLIERS])
    assert any("SeriesPoints" in name for name in looks["/x_dot/outliers"])
    assert any("SeriesLines" in name for name in looks["/x_dot/predicted"])
    assert rows_of(series["/inputs/thrust"])[0] == [*range(301), *range(340, 800)]
    forces = np.ravel(series["/unmodelled/x"][1])
    np.testing.assert_array_equal(np.unique(forces), np.unique(result.diagnosis.unmodelled_forces["x_ddot"]))
    assert np.ptp(forces) > 4.0


@needs_rerun
def test_bodies_are_replayed_as_measured_and_as_predicted(tmp_path):
    mujoco = pytest.importorskip("mujoco")
    text = """<mujoco><option timestep="0.01"/><worldbody><geom type="plane" size="1 1 1"/><body name="arm" pos="0 0 1">
      <joint name="hinge" axis="0 1 0" damping="{d}"/><geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass="1"/>
      <geom type="box" size=".05 .05 .05" pos="0 0 -.4" mass=".5"/><geom size=".06" mass="0"/></body></worldbody>
      <actuator><motor name="drive" joint="hinge"/></actuator></mujoco>"""
    machine = mujoco.MjModel.from_xml_string(text.format(d=0.3))
    data, time, rng = mujoco.MjData(machine), 0.01 * np.arange(600), np.random.default_rng(0)
    drive, angle = 2.0 * np.sin(3.0 * time) + np.sin(7.0 * time), np.empty(600)
    for k, torque in enumerate(drive):
        angle[k], data.ctrl[0] = data.qpos[0], torque
        mujoco.mj_step(machine, data)
    (tmp_path / "arm.xml").write_text(text.format(d=0.1))
    log = dr.Log.from_arrays(time, {"hinge": angle + 1e-3 * rng.normal(size=600), "drive": drive})
    model = dr.models.mujoco(tmp_path / "arm.xml", unknown=["joint/hinge.damping"])
    result = dr.identify(model, log)
    assert result.parameters["joint/hinge.damping"] == pytest.approx(0.3, rel=0.02)
    write_recording(result, [log], tmp_path / "arm.rrd")

    from rerun import chunk as chunks

    poses, shapes = {}, set()
    for chunk in chunks.RrdReader(tmp_path / "arm.rrd").stream():
        if not chunk.entity_path.startswith("/replay/"):
            continue
        batch = chunk.to_record_batch()
        if chunk.is_static:
            shapes.add(chunk.entity_path)
        else:
            turned = np.array([x[0] for x in batch.column("Transform3D:quaternion").to_pylist()])
            seconds = np.array([x.value / 1e9 for x in batch.column("time")])
            poses[chunk.entity_path] = (seconds, 2.0 * np.arctan2(turned[:, 1], turned[:, 3]))
    assert set(poses) == {"/replay/measured/arm", "/replay/predicted/arm"}
    assert shapes == {f"{body}/{geom}" for body in poses for geom in (1, 2, 3)}
    for seconds, angles in poses.values():
        assert len(seconds) == 300
        np.testing.assert_allclose(angles, angle[np.rint(seconds / 0.01).astype(int)], atol=5e-3)


@needs_rerun
def test_several_logs_stand_below_their_names(identified, tmp_path):
    result, log = identified
    lacking = write_recording(result, [log, swum(0.9)], tmp_path / "b.rrd")
    assert [text.partition(": ")[2] for text in lacking] == [
        "unmodelled forces are unknown; lo-diransac estimates them in its own logs"
    ]
    series, _ = read(tmp_path / "b.rrd")
    logs = {path.rpartition("/x/measured")[0] for path in series if path.endswith("/x/measured")}
    assert len(logs) == 2
    assert all("\n" not in path for path in series)


@needs_rerun
def test_the_command_writes_beside_the_model_unless_told(tmp_path, monkeypatch):
    working_folder(tmp_path, monkeypatch)
    run("identify", "swim.csv", *MODEL, "--method", "ols", "-o", "m.json")
    done = run("view", "m.json", "swim.csv")
    assert (done.exit_code, done.stderr) == (0, "")
    assert "wrote m.rrd; look at it with: rerun m.rrd" in done.stdout
    assert run("view", "m.json", "swim.csv", "-o", "n.rrd").exit_code == 0
    assert set(read("m.rrd")[0]) == set(read("n.rrd")[0])
    refused = run("view", "m.json", "swim.csv", "-o", "n.csv")
    assert (refused.exit_code, "does not end in .rrd" in refused.stderr) == (1, True)


def test_without_the_library_the_extra_is_named_and_nothing_is_changed(tmp_path, monkeypatch):
    working_folder(tmp_path, monkeypatch)
    run("identify", "swim.csv", *MODEL, "--method", "ols", "-o", "m.json")
    (tmp_path / "m.rrd").write_text("old")
    before = contents(tmp_path)
    monkeypatch.setitem(sys.modules, "rerun", None)
    refused = run("view", "m.json", "swim.csv")
    assert refused.exit_code == 1
    assert 'need the package rerun-sdk; install it with pip install "diransac[rerun]"' in refused.stderr
    assert contents(tmp_path) == before
