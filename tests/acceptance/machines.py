"""The ten simulated logs: models as users write them, and machines that are simulated in NumPy here.

Every machine has its equations twice: for the package, as a user would write them, and solved by hand for the
simulation.  Only contacts are MuJoCo's in both places.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

import diransac as dr
from acceptance.cases import Array, Case, worst_of
from acceptance.integration import coloured, multisine, simulated

G = 9.81
"""Gravity, m/s^2."""


def case(model: dr.Model, truth: Mapping[str, float], *logs: dr.Log, left_out: tuple[str, ...] = ()) -> Case:
    """A case that is judged by its parameters."""
    return Case(model, logs, worst_of(truth, *left_out), truth)


def positive(**units: str) -> dict[str, dr.Parameter]:
    """Parameters above zero."""
    return {name: dr.Parameter(unit, positive=True) for name, unit in units.items()}


def spikes(rng: np.random.Generator, x: Array, share: float, size: float) -> Array:
    """A column of which a share of samples is off by up to a size."""
    return x + size * rng.uniform(-1.0, 1.0, len(x)) * (rng.random(len(x)) < share)


# ---------------------------------------------------------------------- exact: an arm with dry friction

ARM = {"a1": 0.62, "a2": 0.21, "h1": 1.5, "h2": 0.47, "fv1": 0.9, "fc1": 0.7, "fv2": 0.25, "fc2": 0.4}
REACH = 0.4
"""Length of the upper link, m."""


def arm(_: Path) -> Case:
    """Two joints under feedback, 100 Hz, encoders alone."""

    def equations(q: Any, v: Any, a: Any, u: Any, p: Any) -> list[Any]:
        h, s, c = REACH * p.h2, ca.sin(q.q2), ca.cos(q.q2)
        outer = G * p.h2 * ca.sin(q.q1 + q.q2)
        return [
            (p.a1 + p.a2 + 2 * h * c) * a.q1 + (p.a2 + h * c) * a.q2 - h * s * (2 * v.q1 + v.q2) * v.q2
            + G * p.h1 * ca.sin(q.q1) + outer + p.fv1 * v.q1 + p.fc1 * ca.tanh(v.q1 / 0.01) - u.t1,
            (p.a2 + h * c) * a.q1 + p.a2 * a.q2 + h * s * v.q1**2
            + outer + p.fv2 * v.q2 + p.fc2 * ca.tanh(v.q2 / 0.01) - u.t2,
        ]  # fmt: skip

    units = {"a1": "kg m^2", "a2": "kg m^2", "h1": "kg m", "h2": "kg m"}
    friction = {"fv1": "N m s/rad", "fc1": "N m", "fv2": "N m s/rad", "fc2": "N m"}
    known = positive(**units) | {name: dr.Parameter(unit, lower=0.0) for name, unit in friction.items()}
    model = dr.Model("arm", {"q1": "rad", "q2": "rad"}, {"t1": "N m", "t2": "N m"}, known, equations)
    rng = np.random.default_rng(58_001)
    first, second = multisine(rng, 0.7, 0.1, 1.0), multisine(rng, 0.7, 0.1, 1.0)

    def rates(_: float, x: Array, u: Array) -> Array:
        q1, q2, v1, v2 = x
        a1, a2, h1, h2, fv1, fc1, fv2, fc2 = ARM.values()
        h, outer = REACH * h2, G * h2 * np.sin(q1 + q2)
        m11, m12 = a1 + a2 + 2 * h * np.cos(q2), a2 + h * np.cos(q2)
        f1 = u[0] + h * np.sin(q2) * (2 * v1 + v2) * v2 - G * h1 * np.sin(q1) - outer
        f1 -= fv1 * v1 + fc1 * np.tanh(v1 / 0.01)
        f2 = u[1] - h * np.sin(q2) * v1**2 - outer - fv2 * v2 - fc2 * np.tanh(v2 / 0.01)
        d = m11 * a2 - m12**2
        return np.array([v1, v2, (a2 * f1 - m12 * f2) / d, (m11 * f2 - m12 * f1) / d])

    def control(t: float, x: Array) -> list[float]:
        return [80 * (first(t) - x[0]) - 8 * x[2] + 6, 25 * (second(t) - x[1]) - 2 * x[3] + 1]

    t, x, u = simulated(rates, (0, 0, 0, 0), control, 1200, 0.01, 20)
    q = x[:, :2] + 1e-4 * rng.standard_normal((1200, 2))
    return case(model, ARM, dr.Log.from_arrays(t, {"q1": q[:, 0], "q2": q[:, 1], "t1": u[:, 0], "t2": u[:, 1]}))


# ---------------------------------------------------------------------- not exact: a boat in gusts

BOAT = {"mass": 55.0, "linear_drag": 14.0, "quadratic_drag": 31.0, "bias": 2.5}


def boat(_: Path) -> Case:
    """Surge of a boat with gusts of 2 N, which last for 2 s and which nothing measures; their mean is in the bias."""
    known = positive(mass="kg") | {
        "linear_drag": dr.Parameter("N s/m", lower=0.0),
        "quadratic_drag": dr.Parameter("N s^2/m^2", lower=0.0),
        "bias": dr.Parameter("N"),
    }
    model = dr.Model(
        "boat", {"x": "m"}, {"thrust": "N"}, known,
        lambda q, v, a, u, p: [
            p.mass * a.x + p.linear_drag * v.x + p.quadratic_drag * ca.fabs(v.x) * v.x + p.bias - u.thrust
        ],
    )  # fmt: skip
    rng = np.random.default_rng(58_002)
    push, gust = multisine(rng, 25.0, 0.02, 0.4, 8), coloured(rng, 2.0, 2.0, 2001, 0.05)

    def rates(t: float, x: Array, u: Array) -> Array:
        mass, linear, quadratic, bias = BOAT.values()
        wind = gust[int(t / 0.05 + 1e-6)]
        return np.array([x[1], (u[0] + wind - linear * x[1] - quadratic * abs(x[1]) * x[1] - bias) / mass])

    t, x, u = simulated(rates, (0, 0), lambda t, _: [push(t)], 2000, 0.05, 4)
    noise = rng.standard_normal((2000, 2)) * (0.02, 0.01)
    columns = {"x": x[:, 0] + noise[:, 0], "x_dot": x[:, 1] + noise[:, 1], "thrust": u[:, 0]}
    return case(model, BOAT, dr.Log.from_arrays(t, columns), left_out=("bias",))


# ---------------------------------------------------------------------- not exact: dry friction that the model lacks

PENDULUM = {"J": 0.09, "b": 0.05, "mgl": 2.1}
DRY = 0.12
"""Dry friction that the model lacks, N m."""


def pendulum_model(**sensors: dr.Sensor) -> dr.Model:
    """Pendulum under torque."""
    known = positive(J="kg m^2", mgl="N m") | {"b": dr.Parameter("N m s/rad", lower=0.0)}
    return dr.Model(
        "pendulum", {"q": "rad"}, {"torque": "N m"}, {name: known[name] for name in PENDULUM},
        lambda q, v, a, u, p: [p.J * a.q + p.b * v.q + p.mgl * ca.sin(q.q) - u.torque], sensors=sensors,
    )  # fmt: skip


def pendulum_rates(dry: float) -> Callable[[float, Array, Array], Array]:
    """Angle and its rate."""

    def rates(_: float, x: Array, u: Array) -> Array:
        force = u[0] - PENDULUM["b"] * x[1] - dry * np.tanh(x[1] / 0.005) - PENDULUM["mgl"] * np.sin(x[0])
        return np.array([x[1], force / PENDULUM["J"]])

    return rates


def dry_pendulum(_: Path) -> Case:
    """Pendulum with dry friction, identified without it; its damping takes friction up, and is not judged."""
    rng = np.random.default_rng(58_003)
    push = multisine(rng, 0.6, 0.1, 1.5, 7)
    t, x, u = simulated(pendulum_rates(DRY), (0, 0), lambda t, _: [push(t)], 1500, 0.01, 20)
    log = dr.Log.from_arrays(t, {"q": x[:, 0] + 4e-4 * rng.standard_normal(1500), "torque": u[:, 0]})
    return case(pendulum_model(), PENDULUM, log, left_out=("b",))


# ---------------------------------------------------------------------- exact: three logs

AXIS = {"mass": 31.0, "viscous": 95.0, "dry": 9.0}
OFFSETS = (1.2, -2.4, 4.1)


def three_logs(_: Path) -> Case:
    """Linear axis on three days, an offset of its force on each."""
    known = positive(mass="kg") | {
        "viscous": dr.Parameter("N s/m", lower=0.0),
        "dry": dr.Parameter("N", lower=0.0),
        "offset": dr.Parameter("N", per_log=True),
    }
    model = dr.Model(
        "axis", {"s": "m"}, {"force": "N"}, known,
        lambda q, v, a, u, p: [
            p.mass * a.s + p.viscous * v.s + p.dry * ca.tanh(v.s / 0.004) + p.offset - u.force
        ],
    )  # fmt: skip
    rng, logs = np.random.default_rng(58_004), []
    for offset in OFFSETS:
        target = multisine(rng, 0.09, 0.1, 0.9, 5)

        def rates(_: float, x: Array, u: Array, offset: float = offset) -> Array:
            mass, viscous, dry = AXIS.values()
            return np.array([x[1], (u[0] - viscous * x[1] - dry * np.tanh(x[1] / 0.004) - offset) / mass])

        def control(t: float, x: Array, target: Callable[[float], float] = target) -> list[float]:
            return [2500 * (target(t) - x[0]) - 250 * x[1]]

        t, x, u = simulated(rates, (0, 0), control, 600, 0.01, 20)
        logs.append(dr.Log.from_arrays(t, {"s": x[:, 0] + 3e-5 * rng.standard_normal(600), "force": u[:, 0]}))
    each = worst_of(AXIS | {f"offset[{k}]": x for k, x in enumerate(OFFSETS)})
    return Case(model, logs, each, AXIS | {"offset": float(np.mean(OFFSETS))})


# ---------------------------------------------------------------------- exact: an IMU in place of an encoder

RADIUS, DRIFT = 0.3, 0.04
"""Distance of the IMU from the axis, m; bias of its gyroscope, rad/s."""


def imu(_: Path) -> Case:
    """Pendulum of which an IMU alone is recorded: rate of turn with a bias, and two specific forces."""
    model = dr.Model(
        "pendulum-imu", {"q": "rad"}, {"torque": "N m"},
        {**pendulum_model().parameters, "drift": dr.Parameter("rad/s")},
        lambda q, v, a, u, p: [p.J * a.q + p.b * v.q + p.mgl * ca.sin(q.q) - u.torque],
        sensors={
            "gyro": dr.Sensor("rad/s", lambda q, v, a, u, p: v.q + p.drift),
            "along": dr.Sensor("m/s^2", lambda q, v, a, u, p: RADIUS * a.q + G * ca.sin(q.q)),
            "inward": dr.Sensor("m/s^2", lambda q, v, a, u, p: RADIUS * v.q**2 + G * ca.cos(q.q)),
        },
    )  # fmt: skip
    rng = np.random.default_rng(58_005)
    push, rates = multisine(rng, 0.6, 0.1, 1.5, 7), pendulum_rates(0.0)
    t, x, u = simulated(rates, (0.2, 0), lambda t, _: [push(t)], 1500, 0.01, 20)
    turning = np.array([rates(0.0, *row)[1] for row in zip(x, u, strict=True)])
    columns = {
        "gyro": x[:, 1] + DRIFT + 0.01 * rng.standard_normal(1500),
        "along": RADIUS * turning + G * np.sin(x[:, 0]) + 0.1 * rng.standard_normal(1500),
        "inward": RADIUS * x[:, 1] ** 2 + G * np.cos(x[:, 0]) + 0.1 * rng.standard_normal(1500),
        "torque": u[:, 0],
    }
    return case(model, PENDULUM | {"drift": DRIFT}, dr.Log.from_arrays(t, columns), left_out=("drift",))


# ---------------------------------------------------------------------- exact: a state that nothing measures

LIFT, MASS = {"gain": 9.0, "tau": 0.12, "drag": 0.35}, 0.5


def hidden_thrust(_: Path) -> Case:
    """Vertical rotorcraft of known mass whose thrust follows the command with a lag; height alone is measured."""
    model = dr.Model(
        "lift", {"z": "m"}, {"command": "1"},
        positive(gain="N", tau="s") | {"drag": dr.Parameter("N s/m", lower=0.0)},
        lambda q, v, a, u, p: [
            MASS * (a.z + G) + p.drag * v.z - v.thrust, p.tau * a.thrust + v.thrust - p.gain * u.command
        ],
        first_order={"thrust": "N"},
    )  # fmt: skip
    rng = np.random.default_rng(58_006)
    target = multisine(rng, 0.5, 0.05, 0.7, 6)

    def rates(_: float, x: Array, u: Array) -> Array:
        gain, tau, drag = LIFT.values()
        return np.array([x[1], (x[2] - drag * x[1]) / MASS - G, (gain * u[0] - x[2]) / tau])

    def control(t: float, x: Array) -> list[float]:
        return [(MASS * (G + 9.0 * (target(t) - x[0]) - 3.0 * x[1])) / LIFT["gain"]]

    t, x, u = simulated(rates, (0, 0, MASS * G), control, 1500, 0.01, 10)
    log = dr.Log.from_arrays(t, {"z": x[:, 0] + 2e-3 * rng.standard_normal(1500), "command": u[:, 0]})
    return case(model, LIFT, log)


# ---------------------------------------------------------------------- exact but for a delay

LATE = 0.013
"""After which torque acts, s; the log's rows are 10 ms apart."""


def late_torque(_: Path) -> Case:
    """Pendulum whose torque acts later than it is recorded; the delay is judged beside the parameters."""
    rng = np.random.default_rng(58_007)
    push = multisine(rng, 0.6, 0.1, 2.5, 8)
    t, x, u = simulated(pendulum_rates(0.0), (0, 0), lambda t, _: [push(t)], 1500, 0.01, 20, delay=LATE)
    log = dr.Log.from_arrays(t, {"q": x[:, 0] + 4e-4 * rng.standard_normal(1500), "torque": u[:, 0]})
    worst = worst_of(PENDULUM)

    def error(result: dr.Result) -> float:
        found = result.diagnosis.input_delay if result.diagnosis is not None else 0.0
        return max(worst(result), 100.0 * abs(found / LATE - 1.0))

    return Case(pendulum_model(), (log,), error, PENDULUM)


# ---------------------------------------------------------------------- exact: a robot from its file

ROBOT = """<mujoco><compiler angle="radian"/><worldbody><body name="upper">
  <joint name="shoulder" axis="0 1 0"/><inertial pos="0 0 -.15" mass="1.4" diaginertia=".012 .012 .001"/>
  <body name="fore" pos="0 0 -.3"><joint name="elbow" axis="0 1 0"/>
    <inertial pos="0 0 -.12" mass=".8" diaginertia=".005 .005 .0006"/></body></body></worldbody></mujoco>"""
JOINTS = {
    "armature_shoulder": 0.035, "armature_elbow": 0.018, "damping_shoulder": 0.22, "damping_elbow": 0.15,
    "friction_shoulder": 0.45, "friction_elbow": 0.28,
}  # fmt: skip
SMOOTH = 0.05
"""Speed of the robots' friction, rad/s, which their documentation states."""


def robot(folder: Path) -> Case:
    """Two joints of known bodies: what the drives add is unknown.  Masses and lengths are those of the file."""
    path = folder / "arm.xml"
    path.write_text(ROBOT)
    unknown = ("armature", "damping", "friction")
    model = dr.models.robot(path, unknown=unknown, actuation=dr.JointTorques())
    rng = np.random.default_rng(58_008)
    first, second = multisine(rng, 0.7, 0.1, 1.2), multisine(rng, 0.8, 0.1, 1.5)
    hanging, outer, l = 1.4 * 0.15 + 0.8 * 0.3, 0.8 * 0.12, 0.3

    def rates(_: float, x: Array, u: Array) -> Array:
        q1, q2, v1, v2 = x
        a1, a2, d1, d2, f1, f2 = JOINTS.values()
        second_inertia = 0.005 + 0.8 * 0.12**2
        h = outer * l * np.cos(q2)
        m11 = 0.012 + 1.4 * 0.15**2 + 0.8 * l**2 + second_inertia + 2 * h + a1
        m12, m22 = second_inertia + h, second_inertia + a2
        s, pull = outer * l * np.sin(q2), G * outer * np.sin(q1 + q2)
        e1 = u[0] + s * (2 * v1 + v2) * v2 - G * hanging * np.sin(q1) - pull - d1 * v1 - f1 * np.tanh(v1 / SMOOTH)
        e2 = u[1] - s * v1**2 - pull - d2 * v2 - f2 * np.tanh(v2 / SMOOTH)
        d = m11 * m22 - m12**2
        return np.array([v1, v2, (m22 * e1 - m12 * e2) / d, (m11 * e2 - m12 * e1) / d])

    def control(t: float, x: Array) -> list[float]:
        return [25 * (first(t) - x[0]) - 2 * x[2], 10 * (second(t) - x[1]) - 0.6 * x[3]]

    t, x, u = simulated(rates, (0, 0, 0, 0), control, 1200, 0.005, 10)
    q = x[:, :2] + 1e-4 * rng.standard_normal((1200, 2))
    columns = {"shoulder": q[:, 0], "elbow": q[:, 1], "shoulder_torque": u[:, 0], "elbow_torque": u[:, 1]}
    return case(model, JOINTS, dr.Log.from_arrays(t, columns))


# ---------------------------------------------------------------------- contacts

BOX = """<mujoco><option timestep="0.002"/><worldbody><geom name="floor" type="plane" size="0 0 1"/>
  <body name="box" pos=".15 0 .05"><freejoint name="box"/>
    <inertial pos="0 0 0" mass="{mass}" diaginertia="2.5e-3 2.5e-3 4e-3"/>
    <geom name="box" type="box" size=".08 .1 .05" friction="{friction}" priority="1"/></body>
  <body name="pusher" pos="0 0 .05"><joint name="pusher" type="slide" axis="1 0 0" damping="1"/>
    <inertial pos="0 0 0" mass=".8" diaginertia="1e-3 1e-3 1e-3"/>
    <geom name="plate" type="box" size=".01 .06 .02"/></body></worldbody>
  <actuator><motor name="push" joint="pusher"/></actuator></mujoco>"""
PUSHED = {"body/box.mass": 0.62, "geom/box.friction[0]": 0.55}
POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")


def contacts(folder: Path) -> Case:
    """A box that is pushed over the floor: its mass and friction are not those of the file."""
    import mujoco

    path = folder / "box.xml"
    path.write_text(BOX.format(mass=0.5, friction=0.8))
    model = dr.models.mujoco(path, unknown=list(PUSHED))
    machine = mujoco.MjModel.from_xml_string(BOX.format(mass=0.62, friction=0.55))
    data, rng, rows = mujoco.MjData(machine), np.random.default_rng(58_009), []
    for k in range(1000):
        target = 0.08 + 0.16 * k / 1000 + 0.03 * np.sin(14 * 0.002 * k)
        data.ctrl[0] = 400 * (target - data.qpos[7]) - 12 * data.qvel[6]
        rows.append([*data.qpos, data.qvel[6], data.ctrl[0]])
        mujoco.mj_step(machine, data)
    found = np.array(rows)
    names = [*(f"box_{x}" for x in POSE), "pusher", "pusher_dot"]
    noise = dict.fromkeys(names, 5e-4) | {"pusher_dot": 5e-3}
    columns = {name: found[:, k] + noise[name] * rng.standard_normal(1000) for k, name in enumerate(names)}
    length = np.sqrt(sum(columns[f"box_{x}"] ** 2 for x in POSE[3:]))
    columns |= {f"box_{x}": columns[f"box_{x}"] / length for x in POSE[3:]}
    return case(model, PUSHED, dr.Log.from_arrays(0.002 * np.arange(1000), {**columns, "push": found[:, -1]}))


# ---------------------------------------------------------------------- gaps, outliers, and a user's own file

STAGE_FILE = '''"""A stage on a hardening spring."""
import diransac as dr

model = dr.Model(
    name="stage", coordinates={"s": "m"}, inputs={"force": "N"},
    parameters={
        "mass": dr.Parameter("kg", positive=True), "damping": dr.Parameter("N s/m", lower=0.0),
        "stiffness": dr.Parameter("N/m", positive=True), "hardening": dr.Parameter("N/m^3", lower=0.0),
    },
    equations=lambda q, v, a, u, p: [
        p.mass * a.s + p.damping * v.s + p.stiffness * q.s + p.hardening * q.s**3 - u.force
    ],
)
'''
STAGE = {"mass": 1.6, "damping": 3.0, "stiffness": 180.0, "hardening": 9000.0}


def stage(folder: Path) -> Case:
    """Stage with one sample in twenty off by up to 5 cm, and .5 s missing twice, by the command line and its JSON."""
    rng = np.random.default_rng(58_010)
    push = multisine(rng, 9.0, 0.2, 4.0, 8)

    def rates(_: float, x: Array, u: Array) -> Array:
        mass, damping, stiffness, hardening = STAGE.values()
        return np.array([x[1], (u[0] - damping * x[1] - stiffness * x[0] - hardening * x[0] ** 3) / mass])

    t, x, u = simulated(rates, (0, 0), lambda t, _: [push(t)], 1500, 0.01, 20)
    s = spikes(rng, x[:, 0] + 1e-4 * rng.standard_normal(1500), 0.05, 0.05)
    kept = ~(((t > 4.0) & (t < 4.5)) | ((t > 10.0) & (t < 10.5)))
    (folder / "stage.py").write_text(STAGE_FILE)
    rows = np.column_stack([t, s, u[:, 0]])[kept]
    np.savetxt(folder / "stage.csv", rows, delimiter=",", header="t,s,force", comments="")

    def identified(method: str) -> dr.Result:
        words = ["identify", "stage.csv", "--model", "stage.py", "--method", method, "--differentiate", "--json"]
        command = [sys.executable, "-m", "diransac", *words, "--output", f"{method}.json"]
        done = subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True, timeout=300)
        result = dr.Result.load(folder / f"{method}.json")
        assert json.loads(done.stdout)["parameters"] == dict(result.parameters)
        return result

    log = dr.read_log(folder / "stage.csv")
    return Case(pendulum_model(), (log,), worst_of(STAGE), STAGE, identified)


MACHINES: dict[str, Callable[[Path], Case]] = {
    "arm": arm,
    "boat in gusts": boat,
    "pendulum without its friction": dry_pendulum,
    "three logs": three_logs,
    "IMU alone": imu,
    "hidden thrust": hidden_thrust,
    "late torque": late_torque,
    "robot from a file": robot,
    "contacts": contacts,
    "own model, gaps, outliers": stage,
}
