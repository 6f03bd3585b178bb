"""One verdict: `identify`, `validate` on the same log, the page and the JSON say the same, over every horizon."""

import json
import re
import sys
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import diransac as dr
from test_verdict import inverted, sledge, slide

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
import gimbal_log

ARM = """<mujoco><option timestep="0.001" integrator="RK4"/><compiler angle="radian"/><worldbody>
<body name="upper"><joint name="sh" axis="0 1 0" armature=".02" damping=".2"/>
<inertial mass="1.2" pos="0 0 -.15" diaginertia=".01 .01 .002"/>
<body name="fore" pos="0 0 -.3"><joint name="el" axis="0 1 0" armature=".01" damping=".15"/>
<inertial mass="{mass}" pos="0 0 -.12" diaginertia=".004 .004 .001"/></body></body></worldbody>
<actuator><motor joint="sh"/><motor joint="el"/></actuator></mujoco>"""


@cache
def arm(path):
    """A model from a file with a forearm of 0.5 kg, and a log of an arm with one of 0.8 kg, simulated by MuJoCo."""
    mujoco = pytest.importorskip("mujoco")
    path.write_text(ARM.format(mass=0.5))
    machine = mujoco.MjModel.from_xml_string(ARM.format(mass=0.8))
    state, t, rng = mujoco.MjData(machine), 0.005 * np.arange(2000), np.random.default_rng(0)
    q, u = np.zeros((2, len(t), 2))
    for k, now in enumerate(t):
        q[k] = state.qpos
        goal = (
            0.8 * np.sin(1.3 * now) + 0.4 * np.sin(3.1 * now),
            0.9 * np.sin(1.9 * now + 1.0) + 0.4 * np.sin(4.3 * now),
        )
        u[k] = state.ctrl[:] = (20.0, 8.0) * (np.array(goal) - q[k]) - (1.5, 0.5) * state.qvel
        mujoco.mj_step(machine, state, 5)
    q += 2e-4 * rng.normal(size=q.shape)
    columns = {"sh": q[:, 0], "el": q[:, 1], "sh_torque": u[:, 0], "el_torque": u[:, 1]}
    return dr.models.robot(path), dr.Log.from_arrays(t, columns, source="arm")


def axis(dry=8.0, drag=0.0, outliers=0.0):
    """A model of an axis with dry friction, and a log of its positions; quadratic drag is not in the model."""
    rng, dt, t = np.random.default_rng(0), 0.01, 0.01 * np.arange(1500)
    force = 30.0 * np.sin(1.3 * t) + 25.0 * np.sin(3.7 * t + 0.4) + 12.0 * np.sin(8.1 * t)
    x, now = np.zeros(len(t)), (0.0, 0.0)
    for k, f in enumerate(force):
        x[k] = now[0]
        for _ in range(50):
            a = (f - 80.0 * now[1] - dry * np.tanh(now[1] / 0.005) - drag * now[1] * abs(now[1])) / 20.0
            now = now[0] + dt / 50 * now[1], now[1] + dt / 50 * a
    x += 2e-5 * rng.normal(size=len(t))
    hit = rng.random(len(t)) < outliers
    x[hit] += rng.normal(0.0, 0.1, hit.sum())
    model = dr.Model(
        "axis",
        {"x": "m"},
        {"f": "N"},
        {
            "mass": dr.Parameter("kg", positive=True),
            "viscous": dr.Parameter("N s/m", lower=0.0),
            "dry": dr.Parameter("N", lower=0.0),
        },
        lambda q, v, a, u, p: [p.mass * a.x + p.viscous * v.x + p.dry * ca.tanh(v.x / 0.005) - u.f],
    )
    return model, dr.Log.from_arrays(t, {"x": x, "f": force}, source="axis")


def gimbal(seed=1):
    """The gimbal of the tutorial under its drives, with its cable: a log of currents and noisy angles."""
    motion, rng = gimbal_log.simulated(8.0, [], seed), np.random.default_rng(seed)
    rows = slice(0, None, 20)
    angles = motion.angles[rows] + 3e-4 * rng.normal(size=motion.angles[rows].shape)
    torques = gimbal_log.TORQUE_CONSTANT * motion.currents[rows]
    columns = {"pan": angles[:, 0], "tilt": angles[:, 1], "pan_torque": torques[:, 0], "tilt_torque": torques[:, 1]}
    return GIMBAL, dr.Log.from_arrays(motion.time[rows], columns, source=f"gimbal {seed}")


def equations(q, v, a, u, p):
    """Torques on pan and tilt of a camera whose centre of mass is off its axis."""
    turn = p.camera_inertia * ca.sin(2.0 * q.tilt) * v.pan
    inertia = p.base_inertia + p.camera_inertia * ca.cos(q.tilt) ** 2
    on_pan = p.pan_viscous * v.pan + p.pan_dry * ca.tanh(v.pan / 0.01) + p.cable * q.pan - turn * v.tilt
    on_tilt = p.tilt_viscous * v.tilt + p.tilt_dry * ca.tanh(v.tilt / 0.01) + p.unbalance * ca.cos(q.tilt)
    return [
        inertia * a.pan + on_pan - u.pan_torque,
        p.tilt_inertia * a.tilt + on_tilt + 0.5 * turn * v.pan - u.tilt_torque,
    ]


GIMBAL = dr.Model(
    "gimbal",
    {"pan": "rad", "tilt": "rad"},
    {"pan_torque": "N m", "tilt_torque": "N m"},
    {
        **{n: dr.Parameter("kg m^2", positive=True) for n in ("base_inertia", "camera_inertia", "tilt_inertia")},
        **{n: dr.Parameter("N m s/rad", lower=0.0) for n in ("pan_viscous", "tilt_viscous")},
        **{n: dr.Parameter("N m", lower=0.0) for n in ("pan_dry", "tilt_dry")},
        "unbalance": dr.Parameter("N m"),
        "cable": dr.Parameter("N m/rad"),
    },
    equations,
)
MACHINES = {
    "exact": lambda _: (sledge(), slide(noise=0.002)),
    "a push": lambda _: (sledge(), slide(push=1.0, noise=0.002)),
    "a drift": lambda _: (sledge(), slide(drift=0.3, noise=0.002)),
    "unstable": lambda _: inverted(3),
    "dry friction": lambda _: axis(),
    "outliers": lambda _: axis(outliers=0.05),
    "a lacking drag": lambda _: axis(drag=100.0),
    "a heavy forearm": lambda folder: arm(folder / "arm.xml"),
    "gimbal": lambda _: gimbal(),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("verdicts")


@pytest.fixture(scope="module")
def identified(folder):
    """Model, log and result of a machine by its name."""

    @cache
    def found(name):
        model, log = MACHINES[name](folder)
        return log, dr.identify(model, log, differentiate=True)

    return found


@pytest.mark.parametrize("name", MACHINES)
def test_identify_validate_page_and_json_have_one_verdict(identified, name, tmp_path):
    log, result = identified(name)
    validation = dr.validate(result, log)
    assert validation.predictions == result.predictions
    assert validation.verdict == result.verdict
    assert {x for x in validation.findings if x.level != "note"} == {x for x in result.findings if x.level != "note"}
    assert json.loads(json.dumps(result.to_dict()))["verdict"] == result.verdict
    dr.write_report(result, log, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert re.search(r'<span class="method">.*?</span> (.*?)</h3>', page).group(1) == result.verdict


@pytest.mark.parametrize(
    ("name", "verdicts"),
    [
        ("exact", {"usable"}),
        ("dry friction", {"usable"}),
        ("outliers", {"usable"}),
        ("gimbal", {"usable", "usable with care"}),
        ("a heavy forearm", {"do not rely on this"}),
    ],
)
def test_a_verdict_does_not_flip_with_the_horizon(identified, name, verdicts):
    log, result = identified(name)
    horizons = (0.3, 0.5, 0.7, 1.0)
    assert {dr.validate(result, log, x).verdict for x in (*horizons, None)} <= verdicts


def test_a_held_out_log_of_dry_friction_is_predicted_from_starts_that_no_reversal_spoils(identified):
    """Smoothed without the model, windows that begin at a reversal were off by a third of the motion."""
    _, result = identified("gimbal")
    _, friday = gimbal(2)
    for horizon in (0.2, 0.3, 0.5, 0.7):
        assert dr.validate(result, friday, horizon).judged.relative_error["tilt"] < 0.1


def test_a_forearm_that_is_heavier_than_its_file_is_named_with_the_option_that_frees_it(identified):
    _, result = identified("a heavy forearm")
    first = result.suggestions[0]
    assert first.name == "mass of fore"
    assert abs(first.value - 0.3) < 4.0 * first.standard_error
    assert first.option == "--bodies fore"
    assert any("identify again with --bodies fore" in x for x in result.findings)
    assert not any("--fix armature_sh=0" in x for x in result.findings)  # which would leave everything as it is


def test_a_mass_that_a_file_holds_is_found_with_suggestions(folder):
    model, log = arm(folder / "arm.xml")
    found = dr.identify(model, log, with_suggestions=True)
    assert found.parameters["mass_change_fore"] == pytest.approx(0.3, rel=0.01)
    assert found.parameters["armature_sh"] == pytest.approx(0.02, rel=0.02)


def test_terms_that_do_not_improve_predictions_are_not_added(identified, monkeypatch):
    """As if the fit with the drag had ended at another optimum."""
    from diransac.identification import identify as module

    log, result = identified("a lacking drag")
    with_terms = module.with_terms
    spoilt = dict.fromkeys(result.parameters, 1.0)

    def worse(model, chosen):
        return with_terms(model, chosen).with_fixed(spoilt)

    monkeypatch.setattr(module, "with_terms", worse)
    found = dr.identify(axis()[0], log, differentiate=True, with_suggestions=True)
    assert found.parameters == result.parameters
    assert "were not added" in found.notes[0]


def test_friction_in_proportion_to_the_load_is_named():
    """A gear: a tenth of the drive's torque is lost, whichever way it turns."""
    rng, dt, t = np.random.default_rng(0), 0.01, 0.01 * np.arange(3000)
    load = 4.0 * np.sin(0.9 * t) + 3.0 * np.sin(2.3 * t) + 1.5 * np.sin(5.7 * t)
    q, now = np.zeros(len(t)), (0.0, 0.0)
    for k, f in enumerate(load):
        q[k] = now[0]
        for _ in range(20):
            a = (f - 0.2 * abs(f) * np.tanh(now[1] / 0.005) - 3.0 * now[1]) / 0.5
            now = now[0] + dt / 20 * now[1], now[1] + dt / 20 * a
    model = dr.Model(
        "gear",
        {"q": "rad"},
        {"torque": "N m"},
        {"inertia": dr.Parameter("kg m^2", positive=True), "viscous": dr.Parameter("N m s/rad", lower=0.0)},
        lambda q, v, a, u, p: [p.inertia * a.q + p.viscous * v.q - u.torque],
    )
    log = dr.Log.from_arrays(t, {"q": q + 1e-4 * rng.normal(size=len(t)), "torque": load})
    first = dr.identify(model, log, differentiate=True).suggestions[0]
    assert first.kind == "load-dependent friction"
    assert first.value == pytest.approx(0.2, abs=0.03)


def other_timing(late):
    """A log of the sledge whose inputs act some samples later."""
    return slide(noise=0.002, late=late, seed=late, source=f"late {late}")


def test_a_disagreement_that_no_prediction_shows_is_no_reason_against_a_result():
    """Two logs whose delays differ by a fifth of a millisecond; and by 60 ms, which predictions show."""
    shifted = slide(noise=0.0, seed=1, source="shifted")
    shifted = dr.Log.from_arrays(shifted.time + 0.0002, dict(shifted.signals), source="shifted")
    alike = dr.identify(sledge(), [slide(noise=0.0), shifted])
    assert alike.verdict == "usable", alike.findings
    apart = dr.identify(sledge(), [other_timing(0), other_timing(6)])
    assert any("delay" in x for x in apart.findings)
    assert apart.verdict != "usable"


def test_a_friction_that_is_zero_is_no_contradiction(folder):
    model, log = axis(dry=0.0)
    result = dr.identify(model, log, differentiate=True)
    assert result.parameters["viscous"] == pytest.approx(80.0, rel=0.01)
    assert result.verdict != "do not rely on this", result.findings
