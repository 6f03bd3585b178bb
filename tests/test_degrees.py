"""Columns of joints in degrees that do not say so, told by the ranges of a description, in every way of reading."""

import json

import numpy as np
import pytest

import diransac as dr
from command_line import run
from diransac.data.preprocessing import in_degrees, in_units
from diransac.identification.assessment.inspection import inspect

DEGREE = np.pi / 180.0
ARM = """<mujoco model="arm"><compiler angle="radian"/><worldbody>
  <body pos="0 0 1"><joint name="shoulder" axis="0 1 0" range="{shoulder}"/>
    <inertial pos="0 0 -0.15" mass="1.2" diaginertia="0.012 0.012 0.001"/>
    <body pos="0 0 -0.3"><joint name="elbow" axis="0 1 0" range="{elbow}"/>
      <inertial pos="0 0 -0.12" mass="0.6" diaginertia="0.005 0.005 0.0005"/>
      <body pos="0 0 -0.2"><joint name="slide" type="slide" axis="0 0 1" range="-0.1 0.1"/>
        <inertial pos="0 0 0" mass="0.2" diaginertia="1e-4 1e-4 1e-4"/></body></body></body>
</worldbody></mujoco>"""
JOINTS = ("shoulder", "elbow")


@pytest.fixture
def arm(tmp_path):
    def write(shoulder="-1.7 1.7", elbow="-2.6 2.6"):
        path = tmp_path / "arm.xml"
        path.write_text(ARM.format(shoulder=shoulder, elbow=elbow))
        return path

    return write


def columns(seed=0, amplitude=0.8, outliers=0.02):
    """Time, and positions, velocities, targets and torques of a motion in rad, with outliers of hundreds."""
    rng, t = np.random.default_rng(seed), 0.005 * np.arange(2400)
    found = {}
    for name in (*JOINTS, "slide"):
        size = amplitude * rng.uniform(0.6, 1.0) * (0.05 if name == "slide" else 1.0)
        w, phase = rng.uniform(1.0, 5.0), rng.uniform(0.0, 6.0)
        found[name], found[f"{name}_dot"] = size * np.sin(w * t + phase), size * w * np.cos(w * t + phase)
        found[f"{name}_target"] = size * np.sin(w * (t + 0.05) + phase)
        found[f"{name}_torque"] = -2.0 * found[name]
        found[name] = found[name] + 300.0 * (rng.random(len(t)) < outliers)
    return t, found


def log_of(degrees=(), drop=(), units=None, **options):
    """A log with some columns in degrees."""
    t, found = columns(**options)
    kept = {n: x / DEGREE if n in degrees else x for n, x in found.items() if n not in drop}
    return dr.Log.from_arrays(t, kept, units), {n: x for n, x in found.items() if n not in drop}


def controlled(path, **options):
    return dr.models.robot(path, actuation=dr.PositionControl(kp=20.0, kd=0.8, **options))


@pytest.mark.parametrize("seed", range(20, 26))
@pytest.mark.parametrize(
    "degrees",
    [
        JOINTS,
        (*JOINTS, "shoulder_target", "elbow_target"),
        ("shoulder_target", "elbow_target"),
        (*JOINTS, "shoulder_dot", "elbow_dot"),
        ("elbow",),
        ("elbow_target", "elbow"),
        (),
    ],
)
def test_columns_in_degrees_become_rad_each_kind_for_itself(arm, degrees, seed):
    log, truth = log_of(degrees, seed=seed)
    found = in_units(log, controlled(arm()))
    for name, values in truth.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-12, err_msg=name)
    assert [("read as degrees" in x) for x in found.notes[-2:-1]] == [True] * bool(degrees)
    assert degrees or found is log
    again = in_units(found, controlled(arm()))
    assert again is found


def test_a_joint_that_is_held_follows_the_others_of_its_kind(arm):
    log, truth = log_of((*JOINTS, "elbow_target", "shoulder_target"), drop=("elbow", "elbow_dot", "elbow_target"))
    held = 0.3 * DEGREE * np.sin(log.time)
    still = log.with_step({}, signals={**log.signals, "elbow": held / DEGREE, "elbow_target": held / DEGREE})
    found = in_units(still, controlled(arm()))
    np.testing.assert_allclose(found["elbow"], held)
    np.testing.assert_allclose(found["shoulder"], truth["shoulder"])


def test_a_joint_without_a_range_follows_the_others_and_alone_is_in_rad(arm):
    path = arm()
    path.write_text(path.read_text().replace(' range="-1.7 1.7"', ""))
    log, truth = log_of(JOINTS)
    found = in_units(log, dr.models.robot(path))
    np.testing.assert_allclose(found["shoulder"], truth["shoulder"])
    assert "elbow goes from" in found.notes[-2]
    alone = dr.models.robot(path, joints=["shoulder", "slide"])
    assert in_units(log, alone) is log


def test_targets_of_velocities_follow_their_targets(arm):
    model = controlled(arm(), velocity="{}_speed")
    log, truth = log_of((*JOINTS, "shoulder_target", "elbow_target"))
    rates = {f"{n}_speed": np.gradient(log[f"{n}_target"], log.dt) for n in JOINTS}
    for factor in (1.0, DEGREE):
        given = log.with_step({}, signals={**log.signals, **{n: factor * x for n, x in rates.items()}})
        found = in_units(given, model)
        for n in JOINTS:
            np.testing.assert_allclose(found[f"{n}_target"], truth[f"{n}_target"])
            np.testing.assert_allclose(found[f"{n}_speed"], DEGREE * rates[f"{n}_speed"])


def test_a_unit_that_is_stated_and_a_factor_that_is_given_hold(arm):
    model = dr.models.robot(arm())
    log, _ = log_of(JOINTS, units=dict.fromkeys(JOINTS, "rad"))
    assert in_units(log, model) is log
    log, _ = log_of(JOINTS)
    note = in_degrees(log, model).notes[-1]
    assert "beyond the range of shoulder, −1.7 to 1.7 rad, and within it in degrees" in note
    option = note.rpartition("--scale ")[2]
    assert option == "shoulder=1,elbow=1"
    kept = dr.scale(log, {x.split("=")[0]: float(x.split("=")[1]) for x in option.split(",")})
    assert in_units(kept, model) is kept
    turned = dr.scale(log, {"shoulder": -1.0})
    assert in_degrees(turned, model).units["shoulder"] == "deg"


@pytest.mark.parametrize("ranges", [{"shoulder": "0 0", "elbow": "0 0"}, {"shoulder": "-1.7 1.7", "elbow": "-2 2"}])
def test_nothing_is_guessed_without_ranges_or_beyond_them_in_degrees_too(arm, ranges):
    counts, _ = log_of(JOINTS if ranges["elbow"] == "0 0" else ())
    if ranges["elbow"] != "0 0":
        counts = dr.scale(counts, dict.fromkeys(JOINTS, 4096.0))
        counts = counts.with_step({}, signals=counts.signals)
        counts = dr.Log.from_arrays(counts.time, counts.signals)
    model = dr.models.robot(arm(**ranges))
    assert in_units(counts, model) is counts


@pytest.mark.parametrize("seed", range(30, 40))
def test_a_motion_slightly_beyond_a_range_or_some_turns_off_is_in_rad(arm, seed):
    model = dr.models.robot(arm(shoulder="-0.6 0.6", elbow="-0.7 0.7"))
    log, _ = log_of(seed=seed, amplitude=1.0)
    assert in_units(log, model) is log
    turned = log.with_step({}, signals={**log.signals, "elbow": log["elbow"] + 4.0 * np.pi})
    assert in_units(turned, dr.models.robot(arm())) is turned


def test_ranges_belong_to_stored_models_and_to_those_of_mujoco(arm):
    model = controlled(arm())
    assert model.ranges == {"shoulder": (-1.7, 1.7), "elbow": (-2.6, 2.6), "slide": (-0.1, 0.1)}
    assert model.targets == {f"{n}_target": n for n in (*JOINTS, "slide")}
    assert dr.Model.from_dict(json.loads(json.dumps(model.to_dict()))).ranges == model.ranges
    fixed = model.with_fixed({"armature_elbow": 0.1})
    assert (fixed.ranges, fixed.targets) == (model.ranges, model.targets)
    simulated = dr.models.mujoco(arm(), unknown=["joint/*.damping"], actuation=dr.PositionControl(kp=20.0))
    assert (simulated.ranges, simulated.targets) == (model.ranges, model.targets)
    log, truth = log_of((*JOINTS, "shoulder_target", "elbow_target"))
    found = in_units(log, simulated)
    np.testing.assert_allclose(found["elbow_target"], truth["elbow_target"])


def test_servos_of_a_file_have_targets(arm):
    path = arm()
    servos = '<actuator><position name="pan" joint="shoulder" kp="5"/><motor name="pull" joint="elbow"/></actuator>'
    path.write_text(path.read_text().replace("</mujoco>", f"{servos}</mujoco>"))
    model = dr.models.mujoco(path, unknown=["joint/*.damping"])
    assert model.targets == {"pan": "shoulder"}
    log, truth = log_of((*JOINTS, "shoulder_target"))
    given = log.with_step({}, signals={**log.signals, "pan": log["shoulder_target"], "pull": log["elbow_torque"]})
    found = in_units(given, model)
    np.testing.assert_allclose(found["pan"], truth["shoulder_target"])
    np.testing.assert_array_equal(found["pull"], truth["elbow_torque"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"ranges": {"z": (0.0, 1.0)}}, "ranges: there is no 'z'; found x"),
        ({"ranges": {"x": (1.0, 1.0)}}, "the range of x is 1 to 1; give low < high"),
        ({"targets": {"g": "x"}}, "targets: there is no 'g'; found f"),
        ({"targets": {"f": "z"}}, "targets: there is no 'z'; found x"),
    ],
)
def test_ranges_without_meaning_are_refused(arguments, message):
    with pytest.raises(dr.ModelError, match=message):
        dr.Model(
            "axis",
            {"x": "rad"},
            {"f": "N m"},
            {"J": dr.Parameter("kg m^2")},
            lambda q, v, a, u, p: [p.J * a.x - u.f],
            **arguments,
        )


# ---------------------------------------------------------------------- every way of reading


@pytest.fixture(scope="module")
def swung(tmp_path_factory):
    """A pendulum's file, and a log of its motion in degrees with torques in N m, in which nothing states a unit."""
    folder = tmp_path_factory.mktemp("swung")
    (folder / "pendulum.xml").write_text(
        '<mujoco model="pendulum"><compiler angle="radian"/><worldbody><body><joint name="hinge" axis="0 1 0" '
        'range="-2 2"/><inertial pos="0 0 -0.2" mass="1" diaginertia="0.01 0.01 0.001"/></body></worldbody></mujoco>'
    )
    t, dt = 0.01 * np.arange(1500), 0.01
    drive = 1.2 * np.sin(2.0 * t) + 0.9 * np.sin(5.3 * t)
    q, v, rows = 0.0, 0.0, []
    for force in drive:
        rows.append(q)
        for _ in range(20):
            a = (force - 0.2 * v - 0.2 * 9.81 * np.sin(q) - 0.1 * np.tanh(v / 0.05)) / (0.01 + 0.04 + 0.02)
            v += dt / 20 * a
            q += dt / 20 * v
    q = np.array(rows) + np.random.default_rng(1).normal(0.0, 2e-4, len(t))
    dr.Log.from_arrays(t, {"hinge": q / DEGREE, "hinge_torque": drive}).write(folder / "a.csv")
    (folder / "a.csv-metadata.json").unlink(missing_ok=True)
    return folder


NOTE = "hinge is read as degrees"


def test_the_api_reads_degrees(swung):
    model = dr.models.robot(swung / "pendulum.xml")
    log = dr.read_log(swung / "a.csv")
    found = dr.identify(model, log, method="ols", differentiate=True)
    assert found.parameters["armature_hinge"] == pytest.approx(0.02, abs=0.002)
    assert any(NOTE in x for x in found.notes)
    assert any(NOTE in x for x in inspect(log, model).notes)
    scored = dr.validate(found, log, horizon=0.5)
    assert max(scored.force_error_percent.values()) < 20.0
    assert max(abs(dr.simulate(found, log, horizon=0.5)["hinge"])) < 2.0
    last = list(dr.track(model, log, window=5.0))[-1]
    assert last.parameters["armature_hinge"] == pytest.approx(0.02, abs=0.004)


def test_the_command_line_reads_degrees(swung):
    log, model, result = (str(swung / x) for x in ("a.csv", "pendulum.xml", "a.json"))
    shown = run("inspect", log, "--model", model)
    assert shown.exit_code == 0
    assert NOTE in shown.stdout
    command = ("identify", log, "--model", model, "--method", "ols", "--differentiate", "-o", result)
    found = run(*command)
    assert found.exit_code == 0, found.stderr
    assert NOTE in found.stdout
    assert json.loads((swung / "a.json").read_text())["parameters"]["armature_hinge"] == pytest.approx(0.02, abs=0.002)
    scored = json.loads(run("validate", result, log, "--json").stdout)
    assert scored["rmse"]["hinge"] < 0.05
    assert any(NOTE in x for x in scored["notes"])
    kept = run(*command[:-2], "--scale", "hinge=1")
    assert NOTE not in kept.stdout
