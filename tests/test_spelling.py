"""A signal that is misspelt in a log or a mapping is no unmeasured one."""

import json
from pathlib import Path

import numpy as np
import pytest
from faulty_pairs import MODEL

import diransac as dr
from command_line import run
from diransac.data.checks import alike
from diransac.data.dataset import bind_log

T = 0.01 * np.arange(300.0)


@pytest.mark.parametrize(
    ("name", "columns", "near"),
    [
        ("theta", ["x", "thteta"], "thteta"),
        ("theta", ["Theta"], "Theta"),
        ("theta", ["theta_m", "thetas"], "theta_m"),
        ("elbow_flex", ["elbow flex"], "elbow flex"),
        ("position", ["postion", "velocity"], "postion"),
        ("angle", ["angel"], "angel"),
        ("position", ["axis.position"], "axis.position"),
        ("force", ["axis.force"], "axis.force"),
        ("x", ["imu.x"], None),
        ("position", ["Pos", "po", "post"], "Pos"),
        ("x_position", ["x_pos", "y_pos"], "x_pos"),
        ("x", ["X"], "X"),
        ("x", ["z", "y", "xx", "x_ref", "x2"], None),
        ("theta", ["beta", "eta", "zeta", "theta2", "phi"], None),
        ("FL_hip_joint_torque", ["FL_hip", "des_FL_hip"], None),
        ("q1", ["q2", "q11", "q"], None),
        ("angle_1", ["angle_2"], None),
        ("left", ["right", "height"], None),
        ("position", ["velocity", "position_reference"], None),
        ("theta", ["", "_"], None),
    ],
)
def test_names_are_alike_that_differ_by_a_slip(name, columns, near):
    assert alike(name, columns) == near


def crane(**columns):
    swung = {"x": np.sin(T), "angle": 0.1 * np.sin(2.0 * T), "force": np.cos(T)}
    return dr.Log.from_arrays(T, swung | columns)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    from diransac.cli.arguments import load_model

    file = tmp_path_factory.mktemp("model") / "model.py"
    file.write_text(MODEL)
    return load_model(str(file))


def test_a_coordinate_under_another_spelling_is_refused_with_both_remedies(model):
    log = dr.rename(crane(), {"anlge": "angle"})
    with pytest.raises(dr.LogError) as refused:
        bind_log(model, log, pointwise=False)
    assert str(refused.value) == (
        'log: "angle" is not in it, but "anlge" is, which the model has not. If it is the same, pass --map '
        "angle=anlge; if angle is unmeasured, pass --unmeasured angle, or leave the column out"
    )
    for call in (dr.identify, lambda *both: dr.validate(dr.Plant(*both[:1], TRUTH), both[1])):
        with pytest.raises(dr.LogError, match='"anlge" is, which the model has not'):
            call(model, log)


TRUTH = {"cart_mass": 1.2, "pole_mass": 0.3, "friction": 0.8, "damping": 0.004}


def test_other_columns_do_not_disturb_what_is_measured(model):
    assert bind_log(model, crane(anlge=T, angle_m=T, Force=T), pointwise=False).signals == ("x", "angle")


def test_an_unmeasured_coordinate_without_such_a_column_stays_one(model):
    log = crane(tilt=T, x_reference=T)
    log = dr.Log.from_arrays(T, {name: log[name] for name in log.names if name != "angle"})
    segment = bind_log(model, log, pointwise=False)
    assert any('"angle" is not in the log, and counts as unmeasured' in note for note in segment.notes)


def test_an_input_under_another_spelling_is_named(model):
    with pytest.raises(dr.LogError, match=r'"force" is missing; .*; by their names, --map force=Force_N\.$'):
        bind_log(model, dr.rename(crane(), {"Force_N": "force"}), pointwise=False)


def test_all_columns_that_are_named_otherwise_are_named_at_once(model):
    log = dr.rename(crane(), {"Force": "force", "Angle": "angle", "X": "x"})
    with pytest.raises(dr.LogError, match="by their names, --map force=Force,x=X,angle=Angle"):
        bind_log(model, log, pointwise=False)


def test_a_rate_under_another_spelling_is_noted(model):
    segment = bind_log(model, crane(xdot=np.cos(T)), pointwise=False)
    assert '"xdot" is not used; if it is x_dot, pass --map x_dot=xdot' in segment.notes


def test_the_statement_that_it_is_unmeasured_lasts(model, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("model.py").write_text(MODEL)
    crane(angel=T).write("whole.csv")
    dr.rename(crane(), {"angel": "angle"}).write("log.csv")
    refused = run("identify", "log.csv", "--model", "model.py", "--method", "ols", "--differentiate")
    assert (refused.exit_code, "--map angle=angel" in refused.stderr) == (1, True)
    assert '"angel" is not used; if it is angle' in run("inspect", "log.csv", "--model", "model.py").stdout
    log = dr.read_log("log.csv", unmeasured=["angle"])
    assert log.history[-1] == {"step": "unmeasured", "signals": ["angle"]}
    assert bind_log(model, log, pointwise=False).signals == ("x",)
    assert bind_log(model, dr.read_log("log.csv", like=log.history), pointwise=False).signals == ("x",)
    options = ["--model", "model.py", "--unmeasured", "angle", "--time-limit", "20", "-o", "r.json", "--json"]
    prior = [word for name in ("pole_mass", "damping") for word in ("--fix", f"{name}={TRUTH[name]}")]
    found = json.loads(run("identify", "log.csv", *options, *prior).stdout)
    assert found["logs"][0]["preparation"][-1]["step"] == "unmeasured"
    assert "which the model has not" not in run("validate", "r.json", "log.csv").stderr


@pytest.mark.parametrize("signals", [3, "angle", None, [["angle"]], {"angle": 1}])
def test_a_damaged_statement_is_none(model, signals):
    log = dr.rename(crane(), {"angel": "angle"})
    damaged = dr.Log(log.time, log.signals, history=({"step": "unmeasured", "signals": signals},))
    with pytest.raises(dr.LogError, match="is, which the model has not"):
        bind_log(model, damaged, pointwise=False)
