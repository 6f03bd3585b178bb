"""Models of any MJCF that MuJoCo simulates: masks, rollouts, identification, files, refusals."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import diransac as dr
from command_line import run
from diransac.errors import ModelError, ResultError, TimeLimitError
from diransac.identification.estimate import TIME_LIMIT
from diransac.identification.methods.lo_diransac import prediction_error, without_equations
from diransac.identification.methods.lo_diransac.interval_filter import IntervalFilter
from diransac.identification.methods.lo_diransac.prediction_error import Minimum, minimised
from diransac.model.mjcf import MujocoModel, calibrated_text
from diransac.model.mjcf.model import write
from diransac.simulation import Measurements, RolloutBatch, rollouts

mujoco = pytest.importorskip("mujoco", reason="MODELS OF MUJOCO NOT CHECKED: mujoco is missing")

# A body on a spring-loaded foot: a free base, contacts, an IMU, a payload that is nowhere measured.
HOPPER = """<mujoco><option timestep="0.002"/><worldbody>
  <!-- kept --><geom name="floor" type="plane" size="5 5 .1"/>
  <body name="trunk" pos="0 0 .32"><freejoint name="base"/>
    <inertial pos="0 0 0" mass="3" diaginertia=".03 .03 .03"/><site name="imu" pos=".02 0 0"/>
    <body name="payload"><inertial pos="{x} 0 .02" mass="{m}" diaginertia="1e-3 1e-3 1e-3"/></body>
    {legs}
  </body></worldbody>
  <actuator>{motors}</actuator>
  <keyframe><key name="home" qpos="0 0 .32 1 0 0 0 0 0 0 0"/></keyframe>
  <sensor><accelerometer name="acc" site="imu"/><gyro name="gyro" site="imu"/></sensor></mujoco>"""
LEG = """<body name="leg{k}" pos="{x} {y} 0"><inertial pos="0 0 -.15" mass=".3" diaginertia="2e-3 2e-3 1e-4"/>
      <joint name="slide{k}" type="slide" axis="0 0 1" damping="{d}" armature=".1"/>
      <geom name="foot{k}" type="sphere" size=".02" pos="0 0 -.3" friction="{f}"/></body>"""
CORNERS = ((0.15, 0.1), (0.15, -0.1), (-0.15, 0.1), (-0.15, -0.1))
SERVO = '<position name="slide{k}" joint="slide{k}" kp="2000" kv="60"/>'

POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
FOUR_BAR = """<mujoco><option timestep="0.002"/><worldbody>
  <body name="crank"><joint name="crank" axis="0 1 0" armature="{a}" damping=".02"/>
    <inertial pos=".04 0 0" mass=".2" diaginertia="1e-4 2e-4 2e-4"/>
    <body name="coupler" pos=".08 0 0"><joint name="coupler" axis="0 1 0" damping=".01"/>
      <inertial pos=".1 0 0" mass="{m}" diaginertia="2e-4 1.5e-3 1.5e-3"/><site name="end" pos=".2 0 0"/></body></body>
  <body name="rocker" pos=".2 0 0"><joint name="rocker" axis="0 1 0" damping=".01"/>
    <inertial pos="0 0 .08" mass=".3" diaginertia="8e-4 8e-4 1e-4"/><site name="tip" pos="0 0 .16"/></body></worldbody>
  <equality><connect site1="end" site2="tip"/></equality><actuator><motor name="drive" joint="crank"/></actuator>
  <keyframe><key qpos="-.7853981 -.2 .6"/></keyframe></mujoco>"""


def hopper(payload: float, x: float, friction: float, damping: float) -> str:
    """MJCF of the hopper."""
    legs = "".join(LEG.format(k=k, x=a, y=b, d=damping, f=friction) for k, (a, b) in enumerate(CORNERS))
    return HOPPER.format(m=payload, x=x, legs=legs, motors="".join(SERVO.format(k=k) for k in range(4)))


def recorded(text: str, control: Callable[[float], Any], seconds: float, names: dict[str, Any], seed: int) -> dr.Log:
    """Log of a simulation with noise and 5 % outliers; names map columns to (function of data, noise)."""
    model = mujoco.MjModel.from_xml_string(text)
    data, n, rng = mujoco.MjData(model), round(seconds / 0.002), np.random.default_rng(seed)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    drives = [model.actuator(k).name for k in range(model.nu)]
    drives = [f"{name}_ctrl" if name in names else name for name in drives]
    rows: dict[str, list[float]] = {name: [] for name in (*names, *drives)}
    for k in range(-200, n):
        data.ctrl[:] = control(0.002 * k)
        state = {name: float(of(data)) for name, (of, _) in names.items() if not name.startswith(("acc", "gyro"))}
        inputs = dict(zip(drives, data.ctrl.tolist(), strict=True))
        mujoco.mj_step(model, data)
        if k >= 0:
            state |= {name: float(of(data)) for name, (of, _) in names.items() if name not in state}
            for name, value in (state | inputs).items():
                rows[name].append(value)
    columns = {name: np.array(x) for name, x in rows.items()}
    for name, (_, noise) in names.items():
        wrong = rng.random(n) < 0.05
        columns[name] = columns[name] + noise * rng.standard_normal(n) + 100.0 * noise * rng.uniform(-1, 1, n) * wrong
    return dr.Log.from_arrays(0.002 * np.arange(n), columns)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("mujoco")


@pytest.fixture(scope="module")
def hopper_file(folder: Path) -> Path:
    path = folder / "hopper.xml"
    path.write_text(hopper(0.5, 0.0, 0.8, 20.0))
    return path


@pytest.fixture(scope="module")
def four_bar(folder: Path) -> tuple[Path, dr.Log]:
    """Nominal file of a linkage, and a log of another one."""
    path = folder / "four-bar.xml"
    path.write_text(FOUR_BAR.format(a=0.01, m=0.3))
    joints = {"crank": 0, "coupler": 1, "rocker": 2}
    names = {n: (lambda d, k=k: d.qpos[k], 5e-4) for n, k in joints.items()}
    names |= {f"{n}_dot": (lambda d, k=k: d.qvel[k], 0.02) for n, k in joints.items()}
    log = recorded(
        FOUR_BAR.format(a=0.006, m=0.5), lambda t: 0.6 * np.sin(5.0 * t) + 0.4 * np.sin(11.0 * t), 2.0, names, 1
    )
    return path, log


@pytest.fixture(scope="module")
def linkage(four_bar: tuple[Path, dr.Log]) -> tuple[MujocoModel, dr.Result]:
    """Model of the linkage, and its identification."""
    model = dr.models.mujoco(four_bar[0], unknown=["joint/crank.armature", "body/coupler.mass"])
    return model, dr.identify(model, four_bar[1])


# ---------------------------------------------------------------------- names and masks


def test_signals_are_named_as_the_file_names_them(hopper_file: Path) -> None:
    model = dr.models.mujoco(hopper_file, unknown=["body/payload.mass", "sensor/acc.bias"])
    assert list(model.coordinates)[:8] == [*(f"base_{x}" for x in ("x", "y", "z", "qw", "qx", "qy", "qz")), "slide0"]
    assert list(model.velocities)[3:7] == ["base_wx", "base_wy", "base_wz", "slide0_dot"]
    assert list(model.sensors) == ["acc_x", "acc_y", "acc_z", "gyro_x", "gyro_y", "gyro_z"]
    assert list(model.inputs) == [f"slide{k}_ctrl" for k in range(4)]
    assert list(model.parameters) == ["body/payload.mass", *(f"sensor/acc.bias[{k}]" for k in range(3))]
    assert model.parameters["body/payload.mass"].value == 0.5
    assert (model.units["acc_x"], model.units["slide0_ddot"], model.units["base_wx_dot"]) == (
        "m/s^2",
        "m/s^2",
        "rad/s^2",
    )


def test_a_mask_is_one_parameter_and_each_one_per_match(hopper_file: Path) -> None:
    masks = ["geom/foot*.friction[0]", "each:joint/slide*.damping", "body/payload.ipos"]
    model = dr.models.mujoco(hopper_file, unknown=masks)
    damping = [f"joint/slide{k}.damping" for k in range(4)]
    positions = [f"body/payload.ipos[{k}]" for k in range(3)]
    assert list(model.parameters) == ["geom/foot*.friction[0]", *damping, *positions]
    assert len(model.unknowns[0].places) == 4
    assert model.parameters["joint/slide0.damping"].unit == "N s/m"


@pytest.mark.parametrize(
    ("masks", "said"),
    [
        (["body/tail.mass"], "matches nothing; body names are trunk, payload"),
        (["body/trunk.weight"], "there is no body.weight; choose from mass"),
        (["wheel/*.mass"], "choose from body, joint"),
        (["trunk"], 'give masks such as "body/trunk.mass"'),
        (["geom/foot0.friction[7]"], "friction has 3 entries"),
        (["body/trunk.mass", "body/t*.mass"], "are the same; give one of them"),
        (["joint/base.damping"], "matches nothing"),
        ([], "nothing is unknown"),
    ],
)
def test_a_mask_that_names_nothing_is_refused(hopper_file: Path, masks: list[str], said: str) -> None:
    with pytest.raises(ModelError) as error:
        dr.models.mujoco(hopper_file, unknown=masks)
    assert said in str(error.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<mujoco><worldbody/></mujoco>", "has no joint"),
        ("<mujoco><worldbody><body><joint/></body></worldbody></mujoco>", "carries has a mass"),
        (
            '<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody><actuator>'
            '<motor name="slow" joint="j" delay="0.01" nsample="6"/></actuator></mujoco>',
            "has states of delays (delay, nsample), which are not simulated",
        ),
        (
            '<mujoco><worldbody><body><joint name="j" stiffness="5" springyield=".2"/><geom size=".1"/></body>'
            "</worldbody></mujoco>",
            "has states of springs that yield (springyield)",
        ),
    ],
)
def test_what_is_not_simulated_is_refused_by_name(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "a.xml").write_text(text)
    with pytest.raises(ModelError) as error:
        dr.models.mujoco(tmp_path / "a.xml", unknown=["joint/j.damping"])
    assert said in str(error.value)


# ---------------------------------------------------------------------- rollouts


def test_rollouts_are_those_of_a_recompiled_file(hopper_file: Path) -> None:
    masks = ["body/payload.mass", "body/payload.ipos[0]", "geom/foot*.friction[0]", "joint/slide*.damping"]
    model = dr.models.mujoco(hopper_file, unknown=masks)
    values = (1.4, 0.05, 0.5, 33.0)
    u = 0.02 * np.sin(0.05 * np.arange(150))[:, None] * np.ones(4)
    batch = RolloutBatch(np.array([values]), model.home, u, 0.002)
    simulator = rollouts(model)
    found = simulator.trajectories(batch)[0]
    true = mujoco.MjModel.from_xml_string(hopper(1.4, 0.05, 0.5, 33.0))
    data = mujoco.MjData(true)
    mujoco.mj_resetDataKeyframe(true, data, 0)
    for k in range(len(u)):
        np.testing.assert_allclose(found[k, :11], data.qpos, atol=2e-6)
        data.ctrl[:] = u[k]
        mujoco.mj_step(true, data)
    np.testing.assert_allclose(found[-1, -6:], data.sensordata, atol=5e-3)


def test_a_lane_depends_on_nothing_but_its_own_data(hopper_file: Path) -> None:
    model = dr.models.mujoco(hopper_file, unknown=["body/payload.mass", "sensor/gyro.bias"])
    rng = np.random.default_rng(0)
    p = np.column_stack([rng.uniform(0.3, 2.0, 9), 0.01 * rng.standard_normal((9, 3))])
    u, starts = 0.02 * rng.standard_normal((60, 4)), np.arange(9)
    simulator = rollouts(model)
    every = RolloutBatch(p, np.tile(model.home, (9, 1)), u, 0.002, starts, 40)
    together = simulator.trajectories(every, threads=2)
    for k in (0, 4, 8):
        alone = RolloutBatch(p[k : k + 1], model.home, u, 0.002, starts[k : k + 1], 40)
        assert np.array_equal(simulator.trajectories(alone, threads=1)[0], together[k])


def test_slopes_are_differences_of_rollouts(four_bar: tuple[Path, dr.Log]) -> None:
    model = dr.models.mujoco(four_bar[0], unknown=["joint/crank.armature", "body/coupler.mass", "joint/*.damping"])
    p, n = np.array([x.value for x in model.parameters.values()]), 20
    batch = RolloutBatch(p[None], model.home, np.full((n, 1), 0.4), 0.002)
    nothing = Measurements(np.zeros((n, len(model.signals))), np.ones(n, bool))
    simulator = rollouts(model)
    found = simulator.linearized_errors(batch, nothing)
    d = np.linspace(-1.0, 1.0, n * len(model.signals)).reshape(n, 1, -1)
    sums = simulator.gauss_newton(batch, nothing, np.ones(len(model.signals)), directions=d)
    J = found.jacobian.reshape(-1, len(found.unknowns))
    np.testing.assert_allclose(sums.normal_matrix[0], J.T @ J, rtol=1e-9)
    np.testing.assert_allclose(sums.gradient[0], J.T @ found.errors.ravel(), rtol=1e-9)
    np.testing.assert_allclose(sums.along[0, 0, 1:], J.T @ d.ravel(), rtol=1e-9)
    for j in range(len(p)):
        step = 1e-4 * p[j] * np.eye(len(p))[j]
        both = RolloutBatch(np.array([p + step, p - step]), model.home, batch.inputs, 0.002)
        after, before = simulator.trajectories(both)[..., : len(model.state)]
        slope = (after - before) / (2e-4 * p[j])
        np.testing.assert_allclose(found.jacobian[0, :, :6, j], slope, atol=2e-3 * np.abs(slope).max())


# ---------------------------------------------------------------------- identification


def test_a_closed_loop_is_identified_with_outliers(linkage: tuple[MujocoModel, dr.Result]) -> None:
    _, result = linkage
    assert result.parameters["joint/crank.armature"] == pytest.approx(0.006, rel=0.01)
    assert result.parameters["body/coupler.mass"] == pytest.approx(0.5, rel=0.01)
    for name, truth in (("joint/crank.armature", 0.006), ("body/coupler.mass", 0.5)):
        assert abs(result.parameters[name] - truth) < 4.0 * result.standard_errors[name]
    assert result.verdict != "do not rely on this"
    assert result.diagnosis is not None
    assert result.diagnosis.outlier_fraction["crank"] == pytest.approx(0.05, abs=0.02)
    assert np.isfinite(result.fit_error)


def test_a_base_that_nothing_measures_is_followed(hopper_file: Path) -> None:
    names: dict[str, Any] = {f"slide{k}": (lambda d, k=k: d.qpos[7 + k], 2e-4) for k in range(4)}
    names |= {f"slide{k}_dot": (lambda d, k=k: d.qvel[6 + k], 5e-3) for k in range(4)}
    names |= {f"acc_{x}": (lambda d, k=k: d.sensordata[k], 0.1) for k, x in enumerate("xyz")}
    names |= {f"gyro_{x}": (lambda d, k=k: d.sensordata[3 + k], 5e-3) for k, x in enumerate("xyz")}
    phases = np.array([0.0, 1.5, 2.5, 4.0])
    log = recorded(hopper(1.2, 0.04, 0.8, 20.0), lambda t: 0.02 * np.sin(9.0 * t + phases), 3.0, names, 2)
    model = dr.models.mujoco(hopper_file, unknown=["body/payload.mass", "body/payload.ipos[0]"])
    result = dr.identify(model, log)
    assert result.parameters["body/payload.mass"] == pytest.approx(1.2, rel=0.02)
    assert result.parameters["body/payload.ipos[0]"] == pytest.approx(0.04, abs=0.005)


TRAY = """<mujoco><option timestep="0.002"/><worldbody><geom name="floor" type="plane" size="0 0 1"/>
  <body name="box" pos="0 0 .05"><freejoint name="box"/><inertial pos="0 0 0" mass="{m}" diaginertia="2e-3 2e-3 3e-3"/>
    <geom name="box" type="box" size=".08 .1 .05" friction="{f}" priority="1"/></body>
  <body name="tray" pos="0 0 .05"><joint name="tray" type="slide" axis="1 0 0" damping="{d}" stiffness="300"/>
    <inertial pos="0 0 0" mass=".8" diaginertia="1e-3 1e-3 1e-3"/>
    <geom type="box" size=".01 .06 .02" pos="-.11 0 0"/><geom type="box" size=".01 .06 .02" pos=".11 0 0"/>
  </body></worldbody><actuator><motor name="push" joint="tray"/></actuator></mujoco>"""


def test_contacts_that_chatter_are_told_by_slopes_over_the_spread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A box rattles in a tray: its samples are likelier, and its parameters are within their intervals."""
    truth = {"geom/box.friction[0]": 0.45, "body/box.mass": 1.0, "joint/tray.damping": 4.0}
    names: dict[str, Any] = {f"box_{x}": (lambda d, k=k: d.qpos[k], 1e-3) for k, x in enumerate(POSE)}
    names |= {"tray": (lambda d: d.qpos[7], 1e-4), "tray_dot": (lambda d: d.qvel[6], 5e-3)}
    text = TRAY.format(f=0.45, m=1.0, d=4.0)
    log = recorded(text, lambda t: 14.0 * np.sin(7.0 * t) + 10.0 * np.sin(4.3 * t + 1.0), 4.0, names, 7)
    (tmp_path / "tray.xml").write_text(TRAY.format(f=0.7, m=0.7, d=2.0))
    ends: list[tuple[Minimum, Minimum]] = []

    def over_spread(found: Minimum, **options: Any) -> Minimum:
        ends.append((found, prediction_error.over_spread(found, **options)))
        return ends[-1][1]

    monkeypatch.setattr(without_equations, "over_spread", over_spread)
    result = dr.identify(dr.models.mujoco(tmp_path / "tray.xml", unknown=list(truth)), log)
    ((local, spread),) = ends
    assert spread.last.losses.sum() < local.last.losses.sum() - 100.0
    assert (np.diag(spread.covariance) >= np.diag(local.covariance)).all()
    at_end = spread.kalman.over_logs(spread.parameters).losses.sum()
    assert at_end == pytest.approx(spread.last.losses.sum(), rel=1e-9)
    for name, (low, high) in result.intervals(0.95).items():
        assert low <= truth[name] <= high
        assert high - low < 0.4 * truth[name]
    assert result.verdict != "do not rely on this"


@pytest.mark.parametrize("damping", [2.0, 0.0])
def test_slopes_over_the_spread_are_local_ones_of_a_linear_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damping: float
) -> None:
    """At a bound, as a damping of 0, too: points beyond it are at it."""
    ends: list[Minimum] = []

    def over_spread(found: Minimum, **options: Any) -> Minimum:
        ends.append(found)
        return prediction_error.over_spread(found, **options)

    monkeypatch.setattr(without_equations, "over_spread", over_spread)
    log = log_of_carts(carts(1.0, damping=damping), (20.0 * np.sin(6.0 * TIME) + 15.0 * np.sin(23.0 * TIME))[:400], 0)
    (tmp_path / "carts.xml").write_text(carts(1.5, damping=1.0))
    names = ["body/cart0.mass", "joint/x0.damping"]
    result = dr.identify(dr.models.mujoco(tmp_path / "carts.xml", unknown=names), log)
    at = np.array([1.0, damping])
    wide = prediction_error.with_widths(ends[0].covariance, np.full(3, 0.01))
    over = replace(ends[0].kalman, spread=wide).over_logs(at)
    local = ends[0].kalman.over_logs(at)
    total, of_local = (x.information.sum(axis=0)[:2, :2] for x in (over, local))
    np.testing.assert_allclose(total, of_local, rtol=0.02)
    assert over.losses.sum() == pytest.approx(local.losses.sum(), abs=1.0)
    assert result.parameters["body/cart0.mass"] == pytest.approx(1.0, rel=1e-3)
    noise = replace(ends[0].kalman.noise, pi=np.zeros_like(ends[0].kalman.noise.pi))
    told = [
        replace(ends[0].kalman, noise=replace(noise, sigma=noise.sigma / k)).over_logs(at).information[:, 0, 0].sum()
        for k in (1.0, 3.0)
    ]
    assert 0.2 * told[0] < told[1] < 5.0 * told[0]  # not nine times as much: all samples are wrong


@pytest.mark.parametrize("column", ["x0", "x0_dot"])
def test_a_column_of_noise_does_not_begin_the_motion_anew(tmp_path: Path, column: str) -> None:
    log = log_of_carts(carts(1.0, damping=2.0), 20.0 * np.sin(6.0 * TIME) + 15.0 * np.sin(23.0 * TIME), 0)
    columns = {name: log[name] for name in log.names}
    columns[column] = np.random.default_rng(0).uniform(-1.0, 1.0, len(log))
    (tmp_path / "carts.xml").write_text(carts(1.5, damping=1.0))
    model = dr.models.mujoco(tmp_path / "carts.xml", unknown=["body/cart0.mass", "joint/x0.damping"])
    result = dr.identify(model, dr.Log.from_arrays(log.time, columns))
    assert result.parameters["body/cart0.mass"] == pytest.approx(1.0, rel=0.01)
    assert result.parameters["joint/x0.damping"] == pytest.approx(2.0, rel=0.02)


CART = """<body name="cart{k}"><joint name="x{k}" type="slide" axis="1 0 0" damping="{d}"/>
    <inertial pos="0 0 0" mass="{m}" diaginertia="1 1 1"/></body>"""


def carts(*masses: float, damping: float, drive: str = "motor") -> str:
    """MJCF of carts on rails, each with a drive."""
    bodies = "".join(CART.format(k=k, m=m, d=damping) for k, m in enumerate(masses))
    drives = "".join(f'<{drive} name="push{k}" joint="x{k}"/>' for k in range(len(masses)))
    return f'<mujoco><option timestep="0.002"/><worldbody>{bodies}</worldbody><actuator>{drives}</actuator></mujoco>'


def log_of_carts(text: str, u: Any, seed: int, late: int = 0) -> dr.Log:
    """Log of carts that have one input, which is recorded so many samples late."""
    machine = mujoco.MjModel.from_xml_string(text)
    data, n = mujoco.MjData(machine), machine.nq
    motion = np.empty((len(u), 2 * n))
    for k, value in enumerate(u):
        motion[k] = *data.qpos, *data.qvel
        data.ctrl[:] = value
        mujoco.mj_step(machine, data)
    motion += np.random.default_rng(seed).normal(size=motion.shape) * np.repeat([1e-4, 1e-3], n)
    columns = {f"x{k}": motion[:, k] for k in range(n)} | {f"x{k}_dot": motion[:, n + k] for k in range(n)}
    return dr.Log.from_arrays(0.002 * np.arange(len(u)), columns | {f"push{k}": np.roll(u, late) for k in range(n)})


TIME = 0.002 * np.arange(1000)


@pytest.mark.parametrize(("mass", "late"), [(30.0, 0), (0.5, -3)])
def test_a_file_that_is_far_off_does_not_lose_the_motion(tmp_path: Path, mass: float, late: int) -> None:
    u = 20.0 * np.sin(6.0 * TIME) + 15.0 * np.sin(23.0 * TIME)
    log = log_of_carts(carts(1.0, damping=2.0), u, 0, late)
    (tmp_path / "carts.xml").write_text(carts(mass, damping=0.1))
    model = dr.models.mujoco(tmp_path / "carts.xml", unknown=["body/cart0.mass", "joint/x*.damping"])
    result = dr.identify(model, log)
    assert dict(result.parameters) == pytest.approx({"body/cart0.mass": 1.0, "joint/x*.damping": 2.0}, rel=1e-3)
    assert result.estimate.resolution.timing.delay == pytest.approx(-0.002 * late, abs=5e-5)
    assert str(result.verdict) == ("usable with care" if late else "usable")


@pytest.mark.parametrize(("failing", "lacks", "outliers"), [(1, 0.5, 0.1), (1, 0.0, 0.9), (9, 0.5, 0.1)])
def test_a_fit_that_does_not_follow_the_motion_begins_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: int, lacks: float, outliers: float
) -> None:
    starts = list[Any]()

    def fitted(kalman: IntervalFilter, start: Any, **options: Any) -> Minimum:
        starts.append(start)
        found = minimised(kalman, start, **options)
        if len(starts) > failing:
            return found
        noise = replace(found.kalman.noise, pi=np.full(len(found.kalman.noise.pi), outliers))
        last = replace(found.last, losses=found.last.losses + 1.0)
        return replace(found, kalman=replace(found.kalman, lack=lacks, noise=noise), last=last)

    monkeypatch.setattr(without_equations, "minimised", fitted)
    u = (20.0 * np.sin(6.0 * TIME) + 15.0 * np.sin(23.0 * TIME))[:400]
    log = log_of_carts(carts(1.0, damping=2.0), u, 0)
    (tmp_path / "carts.xml").write_text(carts(1.5, damping=2.0))
    model = dr.models.mujoco(tmp_path / "carts.xml", unknown=["body/cart0.mass"])
    result = dr.identify(model, log, seed=-1)
    assert len(set(np.ravel(starts))) == len(starts) == min(failing + 1, 4)
    assert ("lacks 50 % of each change of velocity" in str(result)) == (failing == 9)
    assert (str(result.verdict) == "do not rely on this") == (failing == 9)


def check_a_cart_at_the_time_limit(tmp_path: Path) -> None:
    """Check that a mass is found, and that the time limit is said."""
    log = log_of_carts(carts(1.0, damping=2.0), (20.0 * np.sin(6.0 * TIME) + 15.0 * np.sin(23.0 * TIME))[:400], 0)
    (tmp_path / "carts.xml").write_text(carts(1.5, damping=2.0))
    result = dr.identify(dr.models.mujoco(tmp_path / "carts.xml", unknown=["body/cart0.mass"]), log)
    assert result.stop_reason == TIME_LIMIT
    assert result.parameters["body/cart0.mass"] == pytest.approx(1.0, rel=1e-3)


def test_a_time_limit_during_a_further_start_is_said_and_the_best_so_far_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    starts = list[Any]()

    def fitted(kalman: IntervalFilter, start: Any, **options: Any) -> Minimum:
        starts.append(start)
        found = minimised(kalman, start, **options)
        if len(starts) == 1:
            last = replace(found.last, losses=found.last.losses + 1.0)
            return replace(found, kalman=replace(found.kalman, lack=0.5), parameters=start, last=last)
        raise TimeLimitError

    monkeypatch.setattr(without_equations, "minimised", fitted)
    check_a_cart_at_the_time_limit(tmp_path)


def test_a_time_limit_during_passes_over_the_spread_keeps_the_local_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def over_spread(found: Minimum, **_: Any) -> Minimum:
        raise TimeLimitError

    monkeypatch.setattr(without_equations, "over_spread", over_spread)
    check_a_cart_at_the_time_limit(tmp_path)


def test_parameters_are_those_without_a_delay_that_is_not_significant(tmp_path: Path) -> None:
    drive = 'position kp="200" kv="10"'
    u = 0.2 * np.sin(6.0 * TIME) + 0.1 * np.sin(13.0 * TIME)
    log = log_of_carts(carts(1.0, damping=2.0, drive=drive), u, 1)
    (tmp_path / "carts.xml").write_text(carts(1.5, damping=1.0, drive=drive))
    model = dr.models.mujoco(tmp_path / "carts.xml", unknown=["body/cart0.mass", "joint/x0.damping"])
    result, known = (dr.identify(model, log, method=dr.LoDiransac(input_delay=x)) for x in (None, False))
    assert result.diagnosis is not None
    assert abs(result.diagnosis.input_delay) > result.diagnosis.input_delay_error
    for name, value in known.parameters.items():
        assert abs(result.parameters[name] - value) < 0.2 * known.standard_errors[name]
        assert result.standard_errors[name] > known.standard_errors[name]


def test_a_drive_with_a_lag_has_a_state_and_its_time_constant_is_found(tmp_path: Path) -> None:
    drive = 'general dyntype="filter" dynprm="{}" gainprm="{}"'
    u = np.cumsum(np.random.default_rng(1).standard_normal(1500)) / 20.0
    log = log_of_carts(carts(1.0, damping=2.0, drive=drive.format(0.13, 26.0)), u, 1)
    (tmp_path / "carts.xml").write_text(carts(1.0, damping=1.0, drive=drive.format(0.08, 20.0)))
    unknown = ["actuator/push0.dynprm[0]", "actuator/push0.gainprm[0]", "joint/x0.damping"]
    model = dr.models.mujoco(tmp_path / "carts.xml", unknown=unknown)
    assert model.state == ("x0", "x0_dot", "push0_activation")
    result = dr.identify(model, log)
    for (name, found), true in zip(result.parameters.items(), (0.13, 26.0, 2.0), strict=True):
        low, high = result.intervals(0.95)[name]
        assert found == pytest.approx(true, rel=0.02)
        assert low < true < high


def test_a_machine_at_rest_with_a_drive_that_holds_it_stays(tmp_path: Path) -> None:
    (tmp_path / "carts.xml").write_text(carts(1.0, damping=2.0, drive='position kp="10" timeconst="0.1"'))
    plant = dr.Plant(dr.models.mujoco(tmp_path / "carts.xml", unknown=["joint/x0.damping"]), {"joint/x0.damping": 2.0})
    log = dr.Log.from_arrays(0.002 * np.arange(500), {"push0": np.full(500, 0.5)})
    start = {"x0": 0.5, "x0_dot": 0.0, "push0_activation": 0.5}
    assert np.ptp(dr.simulate(plant, log, initial_state=start)["x0"]) < 1e-9


def test_inertias_of_shapes_that_are_only_looked_at_are_kept(tmp_path: Path) -> None:
    inertia = '<inertial pos="0 0 0" mass="9" diaginertia="1 1 1"/>'
    shape = '<geom size="0.1" mass="2" contype="0" conaffinity="0"/>'
    bare = f'<body name="bare"><joint name="turn of bare"/>{inertia}</body>'
    body = f'<body name="b"><joint name="turn"/>{inertia}{shape}</body>{bare}'
    text = f'<mujoco><compiler inertiafromgeom="true"/><worldbody>{body}</worldbody></mujoco>'
    (tmp_path / "b.xml").write_text(text)
    made = dr.models.mujoco(tmp_path / "b.xml", unknown=["body/b.mass"])
    assert made.parameters["body/b.mass"].value == 2.0
    np.testing.assert_allclose(made.compiled.body_inertia, mujoco.MjModel.from_xml_string(text).body_inertia)


@pytest.mark.parametrize(
    "option", [{"horizon": 0.5}, {"with_suggestions": True}, {"method": dr.LoDiransac(substeps=9)}]
)
def test_an_option_that_belongs_to_equations_is_refused(
    four_bar: tuple[Path, dr.Log], linkage: tuple[MujocoModel, dr.Result], option: dict[str, Any]
) -> None:
    with pytest.raises(dr.SettingsError, match="equations"):
        dr.identify(linkage[0], four_bar[1], **option)


def test_what_no_contact_shows_is_named(hopper_file: Path) -> None:
    names: dict[str, Any] = {f"slide{k}": (lambda d, k=k: d.qpos[7 + k], 2e-4) for k in range(4)}
    log = recorded(hopper(0.5, 0.0, 0.8, 20.0), lambda t: np.full(4, 0.002 * np.sin(9.0 * t)), 1.0, names, 2)
    model = dr.models.mujoco(hopper_file, unknown=["joint/slide*.damping", "geom/foot*.friction[1]"])
    result = dr.identify(model, log)
    assert "geom/foot*.friction[1]" in result.unidentifiable
    assert "no such contact slips" in str(result)


# ---------------------------------------------------------------------- files


def test_results_and_descriptions_are_written_and_read(
    four_bar: tuple[Path, dr.Log], linkage: tuple[MujocoModel, dr.Result], tmp_path: Path
) -> None:
    path, log = four_bar
    model, result = linkage
    result.save(tmp_path / "a.json")
    loaded = dr.Result.load(tmp_path / "a.json")
    assert loaded.parameters == result.parameters
    assert loaded.model == model
    assert pickle.loads(pickle.dumps(model)) == model
    assert np.array_equal(dr.simulate(loaded, log)["crank"], dr.simulate(result, log)["crank"])
    assert dr.validate(loaded, log).rmse["crank"] > 0.0
    assert result.export(tmp_path / "calibrated.xml", into=path) == ()
    again = dr.models.mujoco(tmp_path / "calibrated.xml", unknown=[x.name for x in model.unknowns])
    for name, parameter in again.parameters.items():
        assert parameter.value == pytest.approx(result.parameters[name], rel=1e-5)
    dr.write_report(result, log, tmp_path / "a.html")
    assert "MuJoCo" in (tmp_path / "a.html").read_text()
    assert set(result.sample(5)) == set(model.parameters)


def test_drives_of_the_user_leave_those_of_the_file_as_they_are(tmp_path: Path) -> None:
    path = tmp_path / "carts.xml"
    path.write_text(carts(1.5, damping=1.0, drive='position kp="30" dampratio="1"').replace(' name="push0"', ""))
    for actuation in (None, dr.PositionControl(kp=20.0, kd=0.5)):
        model = dr.models.mujoco(path, unknown=["body/cart0.mass"], actuation=actuation)
        text, _ = calibrated_text(path, model, {"body/cart0.mass": 2.0}, np.eye(1))
        assert '<position kp="30"' in text  # without its damping ratio, of which MuJoCo makes more for more mass
        found, nominal = mujoco.MjModel.from_xml_string(text), mujoco.MjModel.from_xml_path(str(path))
        assert found.body_mass[1] == 2.0
        assert np.array_equal(found.actuator_biasprm, nominal.actuator_biasprm)


def test_an_inertia_that_is_impossible_by_its_errors_is_the_nearest_possible_one(tmp_path: Path) -> None:
    path = tmp_path / "carts.xml"
    path.write_text(carts(1.0, damping=2.0))
    model = dr.models.mujoco(path, unknown=["body/cart0.inertia"])
    estimates = dict(zip(model.parameters, (1.0, 1.0, 2.05), strict=True))
    path.write_text(calibrated_text(path, model, estimates, 0.05**2 * np.eye(3))[0])
    found = mujoco.MjModel.from_xml_path(str(path)).body_inertia[1]  # the compiler refuses impossible ones
    assert np.abs(found - [1.0, 1.0, 2.05]).max() < 0.1
    with pytest.raises(ModelError, match="impossible inertia"):
        calibrated_text(path, model, estimates, 1e-6 * np.eye(3))


@pytest.mark.parametrize(
    ("drive", "fields"),
    [
        ('motor gear="3"', ["gainprm[0]", "gear[0]"]),
        ('position kp="30" kv="4" timeconst="0.05"', ["kp", "dynprm[0]", "kv"]),
        ('position kp="30" dampratio="1" forcerange="-2 2" inheritrange="0.5"', ["kp"]),
        ('position kp="30" dampratio="1" user="3"', ["gear[0]"]),
        ('velocity kv="4"', ["kv"]),
        ('muscle range="0.6 1.2" force="40" lengthrange="0 1" ctrlrange="0 1"', ["dynprm[1]", "gainprm[2]"]),
    ],
)
def test_a_description_with_estimates_has_these_in_drives_of_any_kind(
    tmp_path: Path, drive: str, fields: list[str]
) -> None:
    path = tmp_path / "carts.xml"
    path.write_text(carts(1.5, damping=1.0, drive=drive).replace('type="slide"', 'type="slide" range="0 1"'))
    model = dr.models.mujoco(path, unknown=[f"actuator/*.{x}" for x in fields])
    values = {name: 7.0 + k for k, name in enumerate(model.parameters)}
    path.write_text(calibrated_text(path, model, values, np.eye(len(values)))[0])
    for unknown in model.unknowns:
        write(model.compiled, unknown.places, values[unknown.name])
    again, expected = mujoco.MjModel.from_xml_path(str(path)), model.compiled
    model.complete(expected, mujoco.MjData(expected))
    names = {x for x in dir(expected) if x.startswith("actuator_")}
    for array in names - {"actuator_ctrlspec"}:  # what the control is called
        own, other = (getattr(x, array) for x in (again, expected))
        assert np.allclose(own, other, rtol=1e-5), array


@pytest.mark.parametrize("inside", ['<asset><mesh file="/etc/passwd"/></asset>', '<include file="a.xml"/>'])
def test_a_stored_model_that_names_files_is_refused(linkage: tuple[MujocoModel, dr.Result], inside: str) -> None:
    from diransac.model.model import _checksum

    data = linkage[0].to_dict()
    data["mjcf"] = data["mjcf"].replace("<worldbody>", f"{inside}<worldbody>", 1)
    data["checksum"] = _checksum({k: x for k, x in data.items() if k != "checksum"})
    with pytest.raises(ResultError, match="needs other files"):
        MujocoModel.from_dict(json.loads(json.dumps(data)))


def test_the_command_line_gives_the_same_numbers(
    four_bar: tuple[Path, dr.Log], linkage: tuple[MujocoModel, dr.Result], tmp_path: Path
) -> None:
    path, log = four_bar
    log.write(tmp_path / "log.csv")
    arguments = ["--model", str(path), "--simulator", "mujoco", "--unknown", "joint/crank.armature,body/coupler.mass"]
    done = run("identify", str(tmp_path / "log.csv"), *arguments, "-o", str(tmp_path / "a.json"), "--json")
    assert done.exit_code == 0, done.stderr
    assert json.loads(done.stdout)["parameters"] == linkage[1].parameters  # it is the same seed, too
    for more, said in ((["--simulator", "gazebo"], "there is mujoco"), (["--simulator", "mujoco"], "needs --unknown")):
        refused = run("identify", str(tmp_path / "log.csv"), "--model", str(path), *more)
        assert refused.exit_code == 2
        assert said in refused.stderr


@pytest.mark.parametrize(
    "asked",
    [
        lambda model, result, log: dr.identify(model, log, method="ols"),
        lambda model, result, log: result.export("/tmp/never.c"),
        lambda model, result, log: dr.plan(
            result, waypoints=[dict(zip(model.state, model.home, strict=True))] * 2, times=[0.0, 1.0]
        ),
    ],
)
def test_what_needs_equations_says_so(
    four_bar: tuple[Path, dr.Log], linkage: tuple[MujocoModel, dr.Result], asked: Callable[..., object]
) -> None:
    with pytest.raises(ModelError) as error:
        asked(*linkage, four_bar[1])
    assert "equations" in str(error.value)
