"""Ten real records, one of them with two models, each split into what is identified from and what is held out.

None is part of the project.  Where their folder is missing, every test of them is skipped, and its reason names the
folder.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

import diransac as dr
from acceptance.cases import Array, Case
from acceptance.judges import Acting, Windows, rolled, slopes, torque_error

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


# ---------------------------------------------------------------------- a servo axis, an oscillator


def emps(data: Path) -> Case:
    """Servo axis at 1 kHz under feedback: the second half, predicted over .1, .3 and 1 s."""
    model = dr.models.servo_axis()
    log = dr.read_log(data / "emps" / "DATA_EMPS.csv", rename={"t": "t_s", "position": "q_m", "force": "force_N"})
    first, second = log.split(0.5)

    def rates(x: Array, u: Array, p: Array) -> Array:
        return np.stack([x[1], (u[0] - p[1] * x[1] - p[2] * np.tanh(x[1] / 1e-3) - p[3]) / p[0]])

    return Case(model, (first,), Windows(model, rates, (second,), (0.1, 0.3, 1.0), 41))


def silverbox(data: Path) -> Case:
    """Electronic oscillator with nine samples a period: RMSE of the simulated arrow, rows 1,000 to 38,999, mV."""
    u, y = np.loadtxt(data / "silverbox" / "SNLS80mV.csv", delimiter=",", skiprows=1, usecols=(0, 1)).T
    dt, part = 1.0 / 610.35, slice(45_000, 53_000)
    model = dr.Model(
        "silverbox", {"y": "V"}, {"u": "V"}, {name: dr.Parameter(positive=True) for name in ("m", "d", "k1", "k3")},
        lambda q, v, a, u, p: [p.m * a.y + p.d * v.y + p.k1 * q.y + p.k3 * q.y**3 - u.u],
    )  # fmt: skip

    def rates(x: Array, u: Array, p: Array) -> Array:
        return np.stack([x[1], (u[0] - p[1] * x[1] - p[2] * x[0] - p[3] * x[0] ** 3) / p[0]])

    def error(result: dr.Result) -> float:
        """Chunks of 1,000 rows, each after 1,000 from rest, far longer than the oscillator rings."""
        begins, p = np.arange(0, 38_000, 1_000), np.array([result.parameters[name] for name in model.parameters])
        stages = Acting.of(result, u[:39_001, None], dt).stages(3)
        x = rolled(rates, p, np.zeros((2, len(begins))), stages, begins, 1_999, dt)[1_000:, 0]
        off = np.clip(x - y[begins + np.arange(1_000, 2_000)[:, None]], -10.0, 10.0)
        return 1e3 * float(np.sqrt(np.mean(off**2)))

    return Case(model, (dr.Log.from_arrays(dt * np.arange(8_000), {"y": y[part], "u": u[part]}),), error)


# ---------------------------------------------------------------------- rotors of a nanodrone

MOTORS = tuple(f"m{k}" for k in range(1, 5))


def crazyflie(data: Path) -> Case:
    """Thrust of four rotors behind a lag, by an accelerometer in flight: another flight, in standard deviations."""
    model = dr.Model(
        "crazyflie-thrust", {}, dict.fromkeys(MOTORS, "1"),
        {"k1": dr.Parameter("N"), "k2": dr.Parameter("N"), "lag": dr.Parameter("s", positive=True)},
        lambda q, v, a, u, p: [p.lag * a.thrust + v.thrust - sum(p.k1 * w + p.k2 * w**2 for w in u)],
        first_order={"thrust": "N"}, sensors={"acc": dr.Sensor("m/s^2", lambda q, v, a, u, p: v.thrust / 0.027)},
    )  # fmt: skip
    train, held = (_flight(data / "crazyflie_arpl" / f"{name}.parquet") for name in ("log15", "log16"))
    spread = float(np.nanstd(np.concatenate([train["acc"], held["acc"]])))

    def error(result: dr.Result) -> float:
        k1, k2, lag = (result.parameters[name] for name in ("k1", "k2", "lag"))
        w = Acting.of(result, np.column_stack([held[name] for name in MOTORS]), held.dt).stages(2)[:, 0]
        thrust = np.sum(k1 * w + k2 * w**2, axis=1)
        followed = Acting(np.append(thrust, thrust[-1:])[:, None], held.dt, lag=lag).stages(2)[:, 0, 0]
        off = (np.append(followed, followed[-1]) / 0.027 - held["acc"])[np.isfinite(held["acc"])] / spread
        return float(np.sqrt(np.mean(np.sort(off**2)[: int(np.ceil(0.95 * len(off)))])))

    return Case(model, (train,), error)


def _flight(file: Path) -> dr.Log:
    """Accelerometer along z, while the mean command is above .3, at 100 Hz."""
    commands = {name: f"motor.{name}" for name in MOTORS}
    scale = {"t": 0.001, "acc": 9.81, **dict.fromkeys(MOTORS, 1 / 65536)}
    raw = dr.read_log(file, rename={"t": "t_ms", "acc": "acc.z", **commands}, scale=scale, resample=100.0)
    w = {name: raw[name] for name in MOTORS}
    flying = np.mean(list(w.values()), axis=0) > 0.3
    return dr.Log.from_arrays(raw.time, {"acc": np.where(flying, raw["acc"], np.nan), **w})


# ---------------------------------------------------------------------- double pendulums


def pendulum(data: Path, folder: str, upper: float, runs: Sequence[int]) -> Case:
    """Double pendulum at 500 Hz: the runs that are left, predicted over .1, .25 and .5 s."""
    columns = {"t": "time"}
    for i in "12":
        columns |= {f"q{i}": f"pos_meas{i}", f"q{i}_dot": f"vel_meas{i}", f"torque{i}": f"tau_meas{i}"}
    logs = [dr.read_log(file, rename=columns, resample=500.0) for file in sorted((data / folder).glob("*.parquet"))]
    model = dr.models.double_pendulum(upper_length=upper)

    def rates(x: Array, u: Array, p: Array) -> Array:
        q1, q2, v1, v2 = x
        inertia1, moment1, inertia2, moment2, rotor, b1, c1, b2, c2 = p
        coupling, s2 = upper * moment2 * np.cos(q2), upper * moment2 * np.sin(q2)
        m11, m12 = inertia1 + inertia2 + 2.0 * coupling + 37.0 * rotor, inertia2 + coupling - 6.0 * rotor
        m22, g2 = inertia2 + 36.0 * rotor, 9.81 * moment2 * np.sin(q1 + q2)
        f1 = u[0] + s2 * (2.0 * v1 + v2) * v2 - 9.81 * moment1 * np.sin(q1) - g2 - b1 * v1 - c1 * np.arctan(100.0 * v1)
        f2 = u[1] - s2 * v1**2 - g2 - b2 * v2 - c2 * np.arctan(100.0 * v2)
        d = m11 * m22 - m12**2
        return np.stack([v1, v2, (m22 * f1 - m12 * f2) / d, (m11 * f2 - m12 * f1) / d])

    train, held = [logs[k] for k in runs], [log for k, log in enumerate(logs) if k not in runs]
    return Case(model, train, Windows(model, rates, held, (0.1, 0.25, 0.5), 21))


# ---------------------------------------------------------------------- a leg in the air

KP, KD, PARTS = 20.0, 1.5, ("hip", "thigh", "calf")
"""Gains of the position control, N m/rad and N m s/rad."""


def leg(data: Path, name: str) -> Case:
    """Armature, damping and friction of a leg's joints: the second half, predicted in MuJoCo over .1, .3 and 1 s."""
    import mujoco

    file = data / "unitree_go2" / "go2.xml"
    joints = {f"{name}_{part}": f"{name}_{part}_joint" for part in PARTS}
    control = dr.PositionControl(kp=KP, kd=KD, target="des_{}")
    model = dr.models.robot(file, joints=joints, unknown=("armature", "damping", "friction"), actuation=control)
    first, second = dr.read_log(data / "unitree_go2" / "traj_0.parquet", rename={"t": "time"}).split(0.5)
    q, targets = (np.column_stack([second[f"{x}{joint}"] for joint in joints]) for x in ("", "des_"))
    spec = mujoco.MjSpec.from_file(str(file))
    for other in {"FL", "FR", "RL", "RR"} - {name}:
        spec.delete(spec.body(f"{other}_hip"))
    spec.option.timestep = second.dt / 5
    machine, (smooth, velocity) = spec.compile(), slopes(q, second.dt, 9)
    begins = np.arange(9, len(q) - 209, 60)

    def predicted(acting: Array, begin: int) -> Array:
        state, rows = mujoco.MjData(machine), []
        state.qpos[:], state.qvel[:] = smooth[begin], velocity[begin]
        for k in range(200):
            for target in acting[begin + k, :10:2]:
                state.qfrc_applied[:] = KP * (target - state.qpos) - KD * state.qvel
                mujoco.mj_step(machine, state)
            rows.append(state.qpos.copy())
        return np.array(rows)

    def error(result: dr.Result) -> float:
        """Friction in MuJoCo as sharp as the model's; negative values, which MuJoCo lacks, count as zero."""
        values = np.maximum([result.parameters[n] for n in model.parameters], 0.0).reshape(3, 3)
        machine.dof_armature[:], machine.dof_damping[:], machine.dof_frictionloss[:] = values.T
        machine.dof_solref[:, 0] = 2.0 * machine.opt.timestep
        acting = Acting.of(result, targets, second.dt).stages(5)
        off = np.array([predicted(acting, k) - q[k + 1 : k + 201] for k in begins]) / np.std(q, axis=0)
        squares = np.minimum(np.abs(off), 10.0) ** 2
        return float(np.sqrt(np.mean([squares[:, :n].mean() for n in (20, 60, 200)])))

    return Case(model, (first,), error)


# ---------------------------------------------------------------------- a six-axis arm, two tanks


def six_axes(data: Path) -> Case:
    """Fifty-eight parameters of an arm: error of the torques on two held-out runs, %."""
    train, *held = (
        dr.read_log(data / "ur10e" / f"{name}.parquet") for name in ("train_50s", "held_30s", "held_points")
    )
    unknown = ("armature", "damping", "friction", "offset")
    file = data / "ur10e" / "ur10e.urdf"
    model = dr.models.robot(file, unknown=unknown, bodies="all", actuation=dr.JointTorques())
    return Case(model, (train,), lambda result: torque_error(result, held, 21))


def tanks(data: Path, inflow: bool) -> Case:
    """Two tanks, the upper level unmeasured: RMSE, V, of one simulation of the validation record."""
    own, other = (
        dr.read_log(data / "cascaded_tanks" / f"{name}.csv", scale={"t": 1.0}) for name in ("estimation", "validation")
    )
    names = [f"k{k}" for k in range(1, 6 if inflow else 5)]

    def equations(q: Any, v: Any, a: Any, u: Any, p: Any) -> list[Any]:
        upper, lower = (ca.sqrt(ca.fmax(x, 1e-6)) for x in (v.h1, v.h2))
        extra = p.k5 if inflow else 0.0
        return [a.h1 + p.k1 * upper - p.k4 * u.pump - extra, a.h2 - p.k2 * upper + p.k3 * lower]

    parameters = {name: dr.Parameter(positive=True) for name in names[:4]} | {n: dr.Parameter() for n in names[4:]}
    model = dr.Model("tanks", {}, {"pump": "V"}, parameters, equations, first_order={"h1": "V", "h2": "V"})

    def rates(x: Array, u: Array, p: Array) -> Array:
        upper, lower = np.sqrt(np.maximum(x, 1e-6))
        extra = p[4] if inflow else 0.0
        return np.stack([-p[0] * upper + p[3] * u[0] + extra, p[1] * upper - p[2] * lower])

    def error(result: dr.Result) -> float:
        """The first upper level is the likeliest of a hundred, from none to five times that of an even flow."""
        p = np.array([result.parameters[name] for name in names])
        even = (p[2] / p[1]) ** 2 * other["h2"][0]
        start = np.stack([np.linspace(0.0, 5.0, 100) * even, np.full(100, other["h2"][0])])
        stages = Acting.of(result, other["pump"][:, None], other.dt).stages(4)
        x = rolled(rates, p, start, stages, np.zeros(100, int), len(other) - 1, other.dt)[:, 1]
        return float(np.sqrt(np.mean(np.minimum(np.abs(x - other["h2"][:, None]), 10.0) ** 2, axis=0).min()))

    return Case(model, (own,), error)


# ---------------------------------------------------------------------- autopilots


def autopilot(data: Path, file: str, rate: float | None, **fixed: float) -> Case:
    """Instruments of an autopilot, for a quadrotor of which nothing, or little, was excited."""
    model = dr.models.quadrotor("x", arm_length=0.25, speed_unit="1", imu=True)
    log = dr.read_log(data / file, mapping="px4-multirotor", resample=rate)

    def identified(method: str) -> dr.Result:
        return dr.identify(model, log, method, differentiate=True, fixed=fixed or None)

    return Case(model, (log,), lambda result: 0.0, identified=identified)


RECORDS: dict[str, Callable[[Path], Case]] = {
    "emps": emps,
    "silverbox": silverbox,
    "crazyflie": crazyflie,
    "pendulum A0": lambda data: pendulum(data, "dfki_double_pendulum", 0.3, (0, 1, 2)),
    "pendulum C0": lambda data: pendulum(data, "dfki_double_pendulum_c0", 0.2, (0, 1, 2)),
    "leg": lambda data: leg(data, "RR"),
    "six axes": six_axes,
    "tanks": lambda data: tanks(data, False),
    "tanks with an inflow": lambda data: tanks(data, True),
    "autopilot at rest": lambda data: autopilot(data, "px4_ulog/sample_log_small.ulg", None),
    "hover": lambda data: autopilot(data, "px4_hover/sample_px4_events.ulg", 10.0, mass=1.5),
}
