"""Logs of instruments on machines that are simulated by SciPy, apart from the package.

The planar rotorcraft hovers and turns under a lively control law; motion capture sees its pose, and an accelerometer
with a lever arm and a gyroscope see what a strapped-down instrument would.
"""

from collections.abc import Mapping

import numpy as np
from scipy.integrate import odeint

GRAVITY, ARM = 9.81, 0.177
TRUTH = {"mass": 0.25, "inertia": 0.0041, "drag": 0.012}
INSTRUMENTS = {
    "acc_arm_x": 0.06,
    "acc_arm_z": -0.04,
    "acc_bias_x": 0.35,
    "acc_bias_z": -0.22,
    "gyro_bias": 0.08,
    "gyro_scale": 1.06,
}
POSE_NOISE, ACC_NOISE, GYRO_NOISE = 0.002, 0.15, 0.01


def flight(seed: int = 0, duration: float = 10.0, dt: float = 0.01, **changes: float) -> dict[str, np.ndarray]:
    """Columns of a flight: time, inputs, pose, its derivatives and the readings, all without noise."""
    p = {**TRUTH, **INSTRUMENTS, **changes}
    rng = np.random.default_rng(seed)
    t = dt * np.arange(round(duration / dt) + 1)
    waves = [(rng.uniform(0.3, 1.6), rng.uniform(0.0, 6.28)) for _ in range(6)]
    aims = [sum(np.sin(2 * np.pi * f * t + phase) for f, phase in waves[k::3]) for k in range(3)]
    x, states, inputs = np.array([0.0, 0.0, 0.1, 0.2, -0.1, 0.0]), [], []
    for k in range(len(t)):
        lean = 0.12 * aims[0][k] - 0.05 * x[0] - 0.12 * x[3]
        thrust = p["mass"] * (GRAVITY + 1.5 * aims[1][k] - 1.0 * x[1] - 1.0 * x[4])
        moment = p["inertia"] / ARM * (30.0 * (-lean - x[2]) - 8.0 * x[5] + 6.0 * aims[2][k])
        states.append(x)
        inputs.append((thrust, moment))
        x = odeint(motion, x, [0.0, dt], (inputs[-1], p), tfirst=True, rtol=1e-10, atol=1e-12)[-1]
    q, u = np.array(states), np.array(inputs)
    a = np.array([motion(0.0, *row, p)[3:] for row in zip(q, u, strict=True)])
    names = [f"{n}{end}" for end in ("", "_dot", "_ddot") for n in ("x", "z", "theta")]
    columns = dict(zip(names, np.hstack([q, a]).T, strict=True))
    return {"t": t, "thrust": u[:, 0], "moment": u[:, 1], **columns, **readings(columns, p)}


def motion(_t: float, x: np.ndarray, u: tuple[float, float], p: Mapping[str, float]) -> list[float]:
    """State equation of the planar rotorcraft, Dimmig et al. 2023, eq. (4)."""
    s, c = np.sin(x[2]), np.cos(x[2])
    pull = p["drag"] * abs(u[0])
    return [
        *x[3:],
        (-u[0] * s - pull * x[3] * c) / p["mass"],
        (u[0] * c - pull * x[4] * s) / p["mass"] - GRAVITY,
        ARM * u[1] / p["inertia"],
    ]


def readings(of: Mapping[str, np.ndarray], p: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Readings of an accelerometer at a place of the body, whose path is differentiated twice, and of a gyroscope."""
    s, c, w, alpha = np.sin(of["theta"]), np.cos(of["theta"]), of["theta_dot"], of["theta_ddot"]
    x, z = p["acc_arm_x"], p["acc_arm_z"]
    # The place is (x c - z s, x s + z c) in the world, beside the centre of gravity.
    ax = of["x_ddot"] + alpha * (-x * s - z * c) + w**2 * (-x * c + z * s)
    az = of["z_ddot"] + alpha * (x * c - z * s) + w**2 * (-x * s - z * c)
    return {
        "acc_x": c * ax + s * (az + GRAVITY) + p["acc_bias_x"],
        "acc_z": -s * ax + c * (az + GRAVITY) + p["acc_bias_z"],
        "gyro": p["gyro_scale"] * w + p["gyro_bias"],
    }


def recorded(
    columns: Mapping[str, np.ndarray], seed: int = 0, outliers: float = 0.0, signals: tuple[str, ...] = ()
) -> dict[str, np.ndarray]:
    """Pose and readings with noise; outliers, of 10 m/s^2 and 3 rad/s, in the readings; further signals as they are."""
    rng, n = np.random.default_rng([seed, 1]), len(columns["t"])
    noise = {
        **dict.fromkeys(("x", "z", "theta"), POSE_NOISE),
        "acc_x": ACC_NOISE,
        "acc_z": ACC_NOISE,
        "gyro": GYRO_NOISE,
    }
    log = {name: columns[name] for name in ("t", "thrust", "moment", *signals)}
    log |= {name: columns[name] + rng.normal(0.0, std, n) for name, std in noise.items()}
    for name in ("acc_x", "acc_z", "gyro"):
        hit = rng.random(n) < outliers
        log[name] = log[name] + hit * rng.normal(0.0, 3.0 if name == "gyro" else 10.0, n)
    return log
