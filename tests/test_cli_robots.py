"""Command line with descriptions of robots: limbs side by side, options, calibrated files."""

import json

import numpy as np
import pytest

import diransac as dr
import robots
from command_line import run

pytest.importorskip("mujoco", reason="ROBOTS ON THE COMMAND LINE NOT CHECKED: mujoco is missing")

CONTROL = ["--control", "kp=20,kd=1.5,target=des_{}"]
ROBOT = ["--model", "dog.xml", "--joints", "{}_joint", *CONTROL]
LEGS = ["FL", "RR"]
TRUTH = {"armature": 0.03, "damping": 0.4, "friction": 0.2}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Working directory with ``dog.xml`` and ``run.csv``, an exact motion under position control with other joints."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dog.xml").write_text(robots.quadruped(legs=LEGS))
    model = dr.models.robot("dog.xml", joints="{}_joint", actuation=dr.JointTorques())
    rng, t = np.random.default_rng(0), np.arange(0.0, 3.0, 0.01)
    w, phase = rng.uniform(2.0, 8.0, 6), rng.uniform(0.0, 6.0, 6)
    q, v, a = (x(t[:, None] * w + phase) for x in (np.sin, np.cos, np.sin))
    v, a = w * v, -(w**2) * a
    p = [TRUTH[n.partition("_")[0]] for n in model.parameters]
    tau = np.array(model.residual(q.T, v.T, a.T, np.zeros((6, len(t))), np.tile(p, (len(t), 1)).T)).T
    columns = {"t": t}
    for k, n in enumerate(model.coordinates):
        columns |= {
            n: q[:, k],
            f"{n}_dot": v[:, k],
            f"{n}_ddot": a[:, k],
            f"des_{n}": q[:, k] + (tau + 1.5 * v)[:, k] / 20,
        }
    np.savetxt("run.csv", np.column_stack(list(columns.values())), delimiter=",", header=",".join(columns), comments="")
    return tmp_path


@pytest.mark.slow
def test_limbs_are_identified_side_by_side_and_written_into_the_description(folder):
    done = run("identify", "run.csv", *ROBOT, "--method", "ols", "-o", "dog.json", "--report", "dog.html")
    assert done.exit_code == 0, done.stderr
    header, first = done.stdout.splitlines()[:2]
    assert header.split() == ["parameter", "±", "95", "%", *LEGS, "unit"]
    assert first.split()[0] == "armature_hip"
    assert {x.name for x in folder.glob("dog-*")} == {f"dog-{x}.{y}" for x in LEGS for y in ("json", "html")}
    for leg in LEGS:
        found = dr.Result.load(f"dog-{leg}.json").parameters
        assert found == pytest.approx({n: TRUTH[n.partition("_")[0]] for n in found}, rel=1e-6)
    done = run("export", *sorted(folder.glob("dog-*.json")), "--into", "dog.xml", "-o", "calibrated.xml")
    assert (done.exit_code, done.stdout) == (0, "wrote calibrated.xml\n")
    values = {n: x.value for n, x in dr.models.robot("calibrated.xml").parameters.items()}
    assert values == pytest.approx({n: TRUTH[n.partition("_")[0]] for n in values}, rel=1e-6)


def test_chosen_joints_and_unknowns_are_one_result(folder):
    words = ["--model", "dog.xml", "--joints", "FL_thigh=FL_thigh_joint", *CONTROL, "--unknown", "damping,torque_gain"]
    shown = json.loads(run("models", "dog.xml", *words[2:], "--json").stdout)
    assert list(shown["parameters"]) == ["damping_FL_thigh", "torque_gain_FL_thigh"]
    assert run("identify", "run.csv", *words, "--method", "ols").exit_code == 0
    both = run("compare", "run.csv", *words, "--methods", "ols,tls")
    assert both.exit_code == 0, both.stderr


def test_json_has_every_limb(folder):
    done = run("identify", "run.csv", *ROBOT, "--method", "ols", "--json")
    assert list(json.loads(done.stdout)["limbs"]) == LEGS


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--model", "underwater-vehicle", "--unknown", "damping"], "--unknown is for the description of a robot"),
        (["--model", "dog.xml", "--control", "kd=3"], "--control: kp is missing"),
        (["--model", "dog.xml", "--motor", "gear=3"], "or, if unknown, --motor constant=1 --unknown armature,damping,"),
        (["--model", "dog.xml", "--control", "kp=3,ki=4"], "--control: there is no 'ki'"),
        (["--model", "dog.xml", "--motor", "constant=much"], "--motor: could not convert"),
        (["--model", "dog.xml", "--motor", "constant=1", "--control", "kp=2"], "give one"),
    ],
)
def test_options_without_meaning_are_wrong_usage(folder, words, message):
    done = run("identify", "run.csv", *words)
    assert done.exit_code == 2
    assert message in done.stderr


@pytest.mark.parametrize(
    ("column", "words", "advice"),
    [
        ("target", [], "--control kp=NUMBER,kd=NUMBER (dr.PositionControl)"),
        ("current", [], "--motor constant=NUMBER,gear=NUMBER (dr.MotorCurrents)"),
        ("torque", ["--control", "kp=20"], "dr.JointTorques, the default: leave out --control and --motor"),
        ("voltage", [], None),
    ],
)
def test_the_drive_of_the_columns_of_a_log_is_named(folder, column, words, advice):
    t = 0.01 * np.arange(300)
    columns = {f"{leg}_{n}": np.sin(t + k) for leg in LEGS for k, n in enumerate(("hip", "thigh", "calf"))}
    columns |= {f"{n}_{column}": x for n, x in columns.items()}
    dr.Log.from_arrays(t, columns).write("other.csv")
    command = ("other.csv", "--model", "dog.xml", "--joints", "{}_joint", *words)
    refused, shown = run("identify", *command), run("inspect", *command)
    assert refused.exit_code == 1
    for text in (refused.stderr, shown.stdout):
        assert (f'"FL_hip_{column}" is the column of another drive: {advice}' in text) == (advice is not None)
        assert "is missing" in text or "missing: " in text


def test_joints_without_a_drive_are_named(folder):
    shown = json.loads(
        run("models", "dog.xml", "--joints", "{}_joint", "--passive", "FL_calf, RR_calf", "--json").stdout
    )
    assert list(shown["inputs"]) == [f"{leg}_{n}_torque" for leg in LEGS for n in ("hip", "thigh")]
    mask = ("--simulator", "mujoco", "--unknown", "joint/*.damping")
    refused = run("models", "dog.xml", *mask, "--passive", "FL_calf_joint")
    assert "--passive belongs to equations" in refused.stderr


def test_a_description_is_never_overwritten(folder):
    before = (folder / "dog.xml").read_bytes()
    done = run("identify", "run.csv", *ROBOT, "-o", "dog.json", "--joints", "FL_hip_joint", "--report", "dog.xml")
    assert done.exit_code == 1
    assert "is a file that this command reads" in done.stderr
    assert (folder / "dog.xml").read_bytes() == before


# ---------------------------------------------------------------------- designed excitation

PAIR = """<mujoco><compiler angle="radian"/><worldbody>
  <body name="FL"><joint name="FL_hip" axis="0 1 0" range="-0.6 0.4" actuatorfrcrange="-9 9"/>
    <geom size="0.1" pos="0 0 -0.3"/></body>
  <body name="FR"><joint name="FR_hip" axis="0 1 0" range="-0.6 0.4"/><geom size="0.1" pos="0 0 -0.3"/></body>
</worldbody><actuator><motor joint="FR_hip" gear="2" ctrlrange="-20 15"/></actuator></mujoco>"""
DESIGN = ["design", "pair.xml", "--control", "kp=200,kd=1,limit=25", "--duration", "4", "--time-limit", "30"]


def test_limits_of_a_robot_are_those_of_its_file_and_of_its_drives(tmp_path):
    (tmp_path / "pair.xml").write_text(PAIR)
    found = dr.models.robot_limits(tmp_path / "pair.xml")
    ranges = {"FL_hip": (-0.6, 0.4), "FR_hip": (-0.6, 0.4)}
    assert found == ranges | {"FL_hip_torque": (-9.0, 9.0), "FR_hip_torque": (-40.0, 30.0)}
    control = dr.PositionControl(kp=1.0, limit={"FL_hip": 12.0, "FR_hip": 35.0})
    found = dr.models.robot_limits(tmp_path / "pair.xml", actuation=control)
    assert found == ranges | {"FL_hip_torque": (-9.0, 9.0), "FR_hip_torque": (-35.0, 30.0)}


def test_experiments_of_limbs_are_one_log_of_targets_within_the_limits_of_the_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pair.xml").write_text(PAIR)
    done = run(*DESIGN, "--limit", "{}_dot=3,FR_hip_torque=18", "-o", "design.csv", "--json")
    assert done.exit_code == 0, done.stderr
    shown, log = json.loads(done.stdout)["limbs"], dr.read_log("design.csv")
    assert set(log.names) == {f"{n}{x}" for n in ("FL_hip", "FR_hip") for x in ("", "_dot", "_target")}
    for leg, torque in (("FL", 9.0), ("FR", 18.0)):
        assert -0.6 <= log[f"{leg}_hip"].min() <= log[f"{leg}_hip"].max() <= 0.4
        assert np.abs(log[f"{leg}_hip_dot"]).max() <= 3.0
        assert shown[leg]["limits"][f"{leg}_hip_torque"]["limits"] == [-torque, torque]
        control = 200.0 * (log[f"{leg}_hip_target"] - log[f"{leg}_hip"]) - log[f"{leg}_hip_dot"]
        assert np.abs(control).max() <= torque + 1.0  # targets are those of the middle between two rows
        assert shown[leg]["parameters"][f"armature_{leg}_hip"]["ratio"] < 1.0


def test_a_workspace_is_a_limit_on_the_place_of_a_body(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    leg = """<body name="foot" pos="0 0 -0.3"><joint name="knee" axis="0 1 0" range="-1 1"/>
      <geom size="0.05" pos="0 0 -0.2"/><body name="toe" pos="0.1 0 -0.2"/></body>"""
    legs = PAIR.replace("</body>", leg + "</body>", 1)
    (tmp_path / "pair.xml").write_text(legs)
    words = ["--frequency", "1", "--limit", "toe_x=-0.05:0.12,foot_x=0.15"]
    done = run(*DESIGN, *words, "-o", "design.csv", "--json")
    assert done.exit_code == 0, done.stderr
    log, limbs = dr.read_log("design.csv"), json.loads(done.stdout)["limbs"]
    hip, knee = log["FL_hip"], log["knee"]
    toe = -0.3 * np.sin(hip) + 0.1 * np.cos(hip + knee) - 0.2 * np.sin(hip + knee)
    assert -0.05 - 1e-6 <= toe.min() <= toe.max() <= 0.12 + 1e-6
    assert np.abs(0.3 * np.sin(hip)).max() <= 0.15
    assert [limb for limb, x in limbs.items() if "toe_x" in x["limits"]] == [next(iter(limbs))]


def test_a_body_that_several_limbs_move_has_no_workspace(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    axes = """<mujoco><worldbody><body name="bridge"><joint name="x" type="slide" axis="1 0 0" range="-1 1"/>
      <geom size="0.1"/><body name="tool"><joint name="y" type="slide" axis="0 1 0" range="-1 1"/><geom size="0.1"/>
      </body></body></worldbody></mujoco>"""
    (tmp_path / "pair.xml").write_text(axes)
    done = run(*DESIGN, "--limit", "tool_y=0.5", "-o", "design.csv")
    assert done.exit_code == 2
    assert "--limit: x, y move tool, which are designed apart; limit these instead of tool_y" in " ".join(
        done.stderr.split()
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--limit", "FL_hip=far"], "--limit: FL_hip='far' is neither a number nor LOW:HIGH"),
        (["--limit", "{}_{dot}=2"], 'limits: there is no quantity "FL_hip_{dot}"'),
        (["--limit", "knee=2"], 'limits: there is no quantity "knee"'),
        (["--parameter", "armature=2"], "--parameter: there is no 'armature'"),
    ],
)
def test_a_design_that_is_refused_leaves_no_file(tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pair.xml").write_text(PAIR)
    done = run(*DESIGN, *words, "-o", "design.csv")
    assert done.exit_code in (1, 2)
    assert message in done.stderr
    assert [x.name for x in tmp_path.iterdir()] == ["pair.xml"]
