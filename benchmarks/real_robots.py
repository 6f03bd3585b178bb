"""Records of `real.py` that no window of RK4 judges: a nanodrone's rotors, a quadruped's legs, an autopilot on a bench.

Nothing happens when this file is run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from real_records import Found, Record, Score, rms
from real_simulation import CAP, KEPT, STARTS, Array, Inputs, overall, robust_errors
from scipy.optimize import least_squares
from scipy.signal import lfilter, savgol_filter

import diransac as dr

MASS, FLYING, RATE = 0.027, 0.3, 100.0
"""Of the Crazyflie, kg; mean command above which it flies; Hz."""
MOTORS = tuple(f"m{i}" for i in range(1, 5))
HORIZONS, WIDTH = (0.1, 0.3, 1.0), 9


# ---------------------------------------------------------------------- Crazyflie


def thrust_model() -> dr.Model:
    """Thrust that follows ``k1 w + k2 w^2`` of four rotors with a lag, as `examples/crazyflie_thrust.py` has it."""
    return dr.Model(
        name="crazyflie-thrust",
        coordinates={},
        first_order={"thrust": "N"},
        inputs=dict.fromkeys(MOTORS, "1"),
        parameters={"k1": dr.Parameter("N"), "k2": dr.Parameter("N"), "lag": dr.Parameter("s", positive=True)},
        equations=lambda q, v, a, u, p: [p.lag * a.thrust + v.thrust - sum(p.k1 * w + p.k2 * w**2 for w in u)],
        sensors={"acc": dr.Sensor("m/s^2", lambda q, v, a, u, p: v.thrust / MASS)},
    )


def rotors(data: Path, log: str) -> dr.Log:
    """Accelerometer along z in flight, NaN elsewhere, and commands 0 to 1."""
    commands = {f"m{i}": f"motor.m{i}" for i in range(1, 5)}
    raw = dr.read_log(
        data / "crazyflie_arpl" / f"{log}.parquet",
        rename={"t": "t_ms", "acc": "acc.z", **commands},
        scale={"t": 0.001, "acc": 9.81, **dict.fromkeys(commands, 1 / 65536)},
        resample=RATE,
    )
    w = {name: raw[name] for name in MOTORS}
    flying = np.mean(list(w.values()), axis=0) > FLYING
    return dr.Log.from_arrays(raw.time, {"acc": np.where(flying, raw["acc"], np.nan), **w})


def reading(log: dr.Log, k1: float, k2: float, lag: float, inputs: Inputs) -> Array:
    """Accelerometer that the commands of a whole log give, m/s^2."""
    w = inputs.between(np.column_stack([log[name] for name in MOTORS]), log.dt, 2)[:, 0]
    w = np.append(w, w[-1:], axis=0)
    thrust = np.sum(k1 * w + k2 * w**2, axis=1)
    left = float(np.exp(-log.dt / max(lag, 1e-6)))
    return lfilter([0.0, 1.0 - left], [1.0, -left], thrust, zi=thrust[:1])[0] / MASS


def crazyflie(data: Path, halves: bool) -> Record:
    """Rotors' thrust and lag; robust RMSE of the accelerometer in flight, over its standard deviation in both parts."""
    whole = rotors(data, "log15")
    train, held = whole.split(0.5) if halves else (whole, rotors(data, "log16"))
    spread = float(np.nanstd(np.concatenate([train["acc"], held["acc"]])))

    def errors(log: dr.Log, p: Sequence[float], inputs: Inputs) -> Array:
        found = reading(log, *p, inputs) - log["acc"]
        return found[np.isfinite(log["acc"])] / spread

    def judge(parameters: Mapping[str, float], inputs: Inputs) -> Score:
        return Score(kept(errors(held, [parameters[n] for n in ("k1", "k2", "lag")], inputs)), {})

    def output_error() -> Found:
        rng, size = np.random.default_rng(0), np.array([0.1, 0.1, 0.05])
        fits = [
            least_squares(
                lambda z: errors(train, z * size, Inputs()), start, loss="soft_l1", f_scale=0.3,
                bounds=([-np.inf, -np.inf, 1e-3], np.inf), x_scale="jac",
            )
            for start in 10.0 ** rng.uniform(-1.0, 1.0, (STARTS, 3))
        ]  # fmt: skip
        best = min(fits, key=lambda fit: fit.cost).x * size
        return dict(zip(("k1", "k2", "lag"), best.tolist(), strict=True)), Inputs()

    def without_lag() -> Found:
        w, seen = np.column_stack([train[name] for name in MOTORS]), np.isfinite(train["acc"])
        columns = np.column_stack([w.sum(axis=1), (w**2).sum(axis=1)])[seen] / MASS
        (k1, k2), *_ = np.linalg.lstsq(columns, train["acc"][seen], rcond=None)
        return {"k1": float(k1), "k2": float(k2), "lag": 0.0}, Inputs()

    constant = kept((held["acc"][np.isfinite(held["acc"])] - float(np.nanmedian(train["acc"]))) / spread)
    return Record(
        f"crazyflie{'-log15' if halves else ''}", thrust_model(), [train], judge, Score(constant, {}),
        baselines={"output error": output_error, "without lag": without_lag},
    )  # fmt: skip


def kept(errors: Array) -> float:
    """Robust RMSE: the worst samples are left out."""
    squares = np.sort(np.minimum(np.abs(np.nan_to_num(errors, nan=CAP)), CAP) ** 2)
    return float(np.sqrt(np.mean(squares[: int(np.ceil(KEPT * len(squares)))])))


# ---------------------------------------------------------------------- legs of a quadruped


def leg(data: Path, name: str) -> Record:
    """Three joints under position control: armature, damping, friction; predicted in MuJoCo."""
    import go2

    go2.DATA = data / "unitree_go2"
    log = go2.read()
    first, second = log.split(0.5)
    model, joints = go2.model_of(name), [f"{name}_{part}" for part in go2.PARTS]
    q, targets = (np.column_stack([second[f"{x}{joint}"] for joint in joints]) for x in ("", "des_"))
    spread = np.std(np.column_stack([log[joint] for joint in joints]), axis=0)
    velocity = savgol_filter(q, WIDTH, 3, deriv=1, delta=second.dt, axis=0)
    position = savgol_filter(q, WIDTH, 3, axis=0)
    steps = round(HORIZONS[-1] / second.dt)
    begins = np.arange(WIDTH, len(q) - steps - WIDTH, round(HORIZONS[0] / second.dt))
    measured = q[begins + np.arange(steps + 1)[:, None]].transpose(0, 2, 1)

    def scored(predicted: Array) -> Score:
        rows = {h: round(h / second.dt) + 1 for h in HORIZONS}
        by_horizon = {h: robust_errors((predicted - measured)[1:n], spread) for h, n in rows.items()}
        return Score(overall(by_horizon), {f"{h:g} s": rms(x) for h, x in by_horizon.items()})

    def judge(parameters: Mapping[str, float], inputs: Inputs) -> Score:
        """Better of sharp dry friction and MuJoCo's softer one; negative values, which it lacks, count as zero."""
        values = np.maximum([parameters[n] for n in model.parameters], 0.0)
        stages = inputs.between(targets, second.dt, go2.STEPS)[:, : 2 * go2.STEPS : 2]
        found = [
            driven(go2.alone(name).compile(), values, position, velocity, stages, begins, steps, s)
            for s in (True, False)
        ]
        return min(map(scored, found), key=lambda score: score.error)

    def sysid() -> Found:
        with redirect_stdout(StringIO()):  # its solver prints every iteration
            found, _, _ = go2.sysid(name, first)
        return dict(zip(model.parameters, found.tolist(), strict=True)), Inputs()

    still = np.repeat(measured[:1], steps + 1, axis=0)
    return Record(f"go2-{name}", model, [first], judge, scored(still), baselines={"mujoco.sysid": sysid})


def driven(
    model: Any,
    values: Array,
    position: Array,
    velocity: Array,
    stages: Array,
    begins: Array,
    steps: int,
    sharp: bool,
) -> Array:
    """Joints ``(steps + 1, 3, windows)`` under targets ``(rows, steps of MuJoCo, 3)``.

    Sharp dry friction is that of the package's models; otherwise MuJoCo's default holds, with which its own tool fits.
    """
    import go2
    import mujoco

    model.dof_armature[:], model.dof_damping[:], model.dof_frictionloss[:] = values.reshape(3, 3).T
    if sharp:
        model.dof_solref[:, 0] = 2.0 * model.opt.timestep
    found = np.empty((steps + 1, 3, len(begins)))
    for i, begin in enumerate(begins):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = position[begin], velocity[begin]
        for k in range(steps):
            found[k, :, i] = data.qpos
            for target in stages[begin + k]:
                data.qfrc_applied[:] = go2.KP * (target - data.qpos) - go2.KD * data.qvel
                mujoco.mj_step(model, data)
        found[steps, :, i] = data.qpos
    return found


# ---------------------------------------------------------------------- autopilot on a bench


def px4(data: Path, file: str) -> Record:
    """Instruments of an autopilot whose motors stand still."""
    log = dr.read_log(data / "px4_ulog" / f"{file}.ulg", mapping="px4-multirotor")
    return Record(f"px4-{file.removeprefix('sample_')}", dr.models.quadrotor(speed_unit="1", imu=True), [log])


def px4_roll(data: Path) -> Record:
    """Rate of roll of the same, at 50 Hz, as if a force of the motors turned it; nothing is excited."""
    raw = dr.read_log(data / "px4_ulog" / "sample_appended_multiple.ulg", mapping="px4-multirotor")
    rate = raw["gyro_x"] if np.isfinite(raw["gyro_x"]).any() else raw["wx"]
    seen, t = np.isfinite(rate), np.arange(raw.time[0] + 0.1, raw.time[-1] - 0.1, 0.02)
    commands = np.stack([raw[f"motor{i}"] for i in range(1, 5)])
    roll = np.nan_to_num(commands[1] + commands[2] - commands[0] - commands[3])
    columns = {"w": np.interp(t, raw.time[seen], rate[seen]), "roll": np.interp(t, raw.time, roll)}
    model = dr.Model(
        name="roll",
        coordinates={},
        first_order={"w": "rad/s"},
        inputs={"roll": "1"},
        parameters={"inertia": dr.Parameter(positive=True), "drag": dr.Parameter(lower=0.0)},
        equations=lambda q, v, a, u, p: [p.inertia * a.w + p.drag * v.w - u.roll],
    )
    return Record("px4-roll", model, [dr.Log.from_arrays(t, columns)])


RECORDS: dict[str, Callable[[Path], Record]] = {
    "crazyflie": lambda data: crazyflie(data, False),
    "crazyflie-log15": lambda data: crazyflie(data, True),
    **{f"go2-{name}": lambda data, name=name: leg(data, name) for name in ("FL", "FR", "RL", "RR")},
    "px4-log_small": lambda data: px4(data, "sample_log_small"),
    "px4-appended_multiple": lambda data: px4(data, "sample_appended_multiple"),
    "px4-roll": px4_roll,
}
