"""A quadrotor as its instruments see it: a rigid body in rotation matrices, integrated apart from the package.

Motor commands, gyroscope and accelerometer at 500 Hz, each with biases, and motion capture of the pose at 100 Hz, which
is recorded late.  Rotors follow their commands with a lag.  One reading in twenty is an outlier.  The sign of each
quaternion is arbitrary.
"""

from dataclasses import dataclass

import numpy as np

import diransac as dr

Array = np.ndarray
Curve = tuple[Array, Array, Array]
"""Amplitude, m, angular frequency, rad/s, and phase of each coordinate."""

G, ARM = 9.81, 0.12
STEP, CONTROL, RATE, POSE_RATE = 5e-4, 4, 500, 100
DIRECTIONS = np.array([1.0, 1.0, -1.0, -1.0])
PLACES = ARM / np.sqrt(2.0) * np.array([[1, -1], [-1, 1], [1, 1], [-1, -1]], float)
NOISE = {"position": 1e-3, "attitude": 2e-3, "gyro": 0.02, "acc": 0.3}
OUTLIER = {"position": 1.0, "attitude": 0.5, "gyro": 6.0, "acc": 20.0}
POSITION, ATTITUDE = ("x", "y", "z"), ("qw", "qx", "qy", "qz")
GYRO, ACC = ("gyro_x", "gyro_y", "gyro_z"), ("acc_x", "acc_y", "acc_z")
COMMANDS = ("motor1", "motor2", "motor3", "motor4")


@dataclass(frozen=True)
class Flight:
    """A log and what made it.

    Parameters
    ----------
    log : Log
    truth : dict of str to float
        Parameters of the built-in model.
    late : float
        Delay of the motion capture, s.
    """

    log: dr.Log
    truth: dict[str, float]
    late: float


def fly(seed: int, duration: float, late: float = 0.015, outliers: float = 0.05) -> Flight:
    """One flight of a quadrotor whose parameters, path and biases differ from seed to seed."""
    rng = np.random.default_rng([seed, 77])
    truth = airframe(rng)
    time, states, commands, slopes = _flown(truth, rng, duration)
    every = round(1.0 / RATE / STEP)
    rows = np.arange(0, len(time), every)
    columns = dict(zip(COMMANDS, commands[rows].T, strict=True))
    R = states[rows, 6:15].reshape(-1, 3, 3)
    readings = np.einsum("nji,nj->ni", R, slopes[rows, 3:6] + [0.0, 0.0, G])
    for names, kind, values in ((GYRO, "gyro", states[rows, 15:18]), (ACC, "acc", readings)):
        for name, value in zip(names, values.T, strict=True):
            columns[name] = _read(value + truth[bias(name)], kind, rng, outliers)
    seen = np.clip(rows - round(late / STEP), 0, None)
    poses = states[seen]
    attitudes = quaternions(poses[:, 6:15].reshape(-1, 3, 3)) * rng.choice([-1.0, 1.0], (len(rows), 1))
    apart = RATE // POSE_RATE
    for names, kind, values in ((POSITION, "position", poses[:, :3]), (ATTITUDE, "attitude", attitudes)):
        for name, value in zip(names, values.T, strict=True):
            columns[name] = np.where(np.arange(len(rows)) % apart == 0, _read(value, kind, rng, outliers), np.nan)
    return Flight(dr.Log.from_arrays(time[rows], columns), truth, late)


def bias(reading: str) -> str:
    """Name of the parameter that is the bias of a reading."""
    sensor, axis = reading.split("_")
    return f"{sensor}_bias_{axis}"


def _read(values: Array, kind: str, rng: np.random.Generator, outliers: float) -> Array:
    """The values with noise and outliers."""
    hit = rng.random(len(values)) < outliers
    noisy = values + rng.normal(0.0, NOISE[kind], len(values))
    return noisy + hit * rng.uniform(-OUTLIER[kind], OUTLIER[kind], len(values))


def airframe(rng: np.random.Generator) -> dict[str, float]:
    """Parameters of a small racing quadrotor, each within 15 %, and biases."""
    base = {
        "mass": 0.95,
        "inertia_x": 0.0061,
        "inertia_y": 0.0066,
        "inertia_z": 0.0107,
        "thrust_coefficient": 1.5e-6,
        "torque_coefficient": 2.1e-8,
        "drag": 0.25,
        "motor_time_constant": 0.04,
    }
    drawn = {name: value * rng.uniform(0.85, 1.15) for name, value in base.items()}
    drawn |= {bias(name): rng.normal(0.0, 0.03) for name in GYRO}
    return drawn | {bias(name): rng.normal(0.0, 0.2) for name in ACC}


def slope(x: Array, command: Array, p: dict[str, float]) -> Array:
    """Derivative of position, velocity, rotation matrix, angular velocity and speeds of the rotors."""
    v, R, w, speeds = x[3:6], x[6:15].reshape(3, 3), x[15:18], x[18:]
    thrusts = p["thrust_coefficient"] * speeds**2
    in_body = R.T @ v
    force = R @ np.array([-p["drag"] * in_body[0], -p["drag"] * in_body[1], thrusts.sum()])
    yaw = -p["torque_coefficient"] * (DIRECTIONS * speeds**2).sum()
    moments = np.array([PLACES[:, 1] @ thrusts, -PLACES[:, 0] @ thrusts, yaw])
    J = np.array([p["inertia_x"], p["inertia_y"], p["inertia_z"]])
    turning = (moments - np.cross(w, J * w)) / J
    W = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    lag = (command - speeds) / p["motor_time_constant"]
    return np.concatenate([v, force / p["mass"] - [0.0, 0.0, G], (R @ W).ravel(), turning, lag])


def _flown(p: dict[str, float], rng: np.random.Generator, duration: float) -> tuple[Array, Array, Array, Array]:
    """Time, states, commands and their derivatives at every step."""
    curve = path(rng)
    x, n = beginning(p, curve), round(duration / STEP)
    states, commands, slopes = np.empty((n, 22)), np.empty((n, 4)), np.empty((n, 22))
    for k in range(n):
        if k % CONTROL == 0:
            command = pilot(k * STEP, x, p, curve)
        first = slope(x, command, p)
        states[k], commands[k], slopes[k] = x, command, first
        second = slope(x + 0.5 * STEP * first, command, p)
        third = slope(x + 0.5 * STEP * second, command, p)
        fourth = slope(x + STEP * third, command, p)
        x = x + STEP / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
    return STEP * np.arange(n), states, commands, slopes


def path(rng: np.random.Generator) -> Curve:
    """A random curve."""
    size = np.array([1.2, 1.2, 0.6]) * rng.uniform(0.7, 1.2, 3)
    rate = np.array([1.7, 1.9, 1.5]) * rng.uniform(0.8, 1.2, 3)
    return size, rate, rng.uniform(0.0, 6.28, 3)


def beginning(p: dict[str, float], curve: Curve) -> Array:
    """State (22,) at rest on a curve, the rotors at the speed of hover."""
    size, _, phase = curve
    hover = np.full(4, np.sqrt(p["mass"] * G / 4.0 / p["thrust_coefficient"]))
    return np.concatenate([size * np.sin(phase), np.zeros(3), np.eye(3).ravel(), np.zeros(3), hover])


def pilot(t: float, x: Array, p: dict[str, float], curve: Curve) -> Array:
    """Commands of the motors that follow a curve with a swinging heading."""
    size, rate, phase = curve
    R, w = x[6:15].reshape(3, 3), x[15:18]
    aim, speed = size * np.sin(rate * t + phase), size * rate * np.cos(rate * t + phase)
    wanted = 6.0 * (aim - x[:3]) + 4.0 * (speed - x[3:6]) - size * rate**2 * np.sin(rate * t + phase) + [0.0, 0.0, G]
    up, heading = wanted / np.linalg.norm(wanted), 0.8 * np.sin(0.7 * t + phase[0])
    left = np.cross(up, [np.cos(heading), np.sin(heading), 0.0])
    left /= np.linalg.norm(left)
    E = np.column_stack([np.cross(left, up), left, up]).T @ R
    tilt = 0.5 * np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]])
    J = np.array([p["inertia_x"], p["inertia_y"], p["inertia_z"]])
    moments = -J * (np.array([150.0, 150.0, 40.0]) * tilt + np.array([22.0, 22.0, 10.0]) * w) + np.cross(w, J * w)
    ratio = p["torque_coefficient"] / p["thrust_coefficient"]
    mixer = np.vstack([np.ones(4), PLACES[:, 1], -PLACES[:, 0], -DIRECTIONS * ratio])
    thrusts = np.linalg.solve(mixer, [p["mass"] * wanted @ R[:, 2], *moments])
    return np.sqrt(np.clip(thrusts, 0.05, 6.0) / p["thrust_coefficient"])


def quaternions(R: Array) -> Array:
    """Unit quaternions (n, 4), scalar part first, by the largest component of each."""
    trace = np.trace(R, axis1=1, axis2=2)
    squares = 0.25 * np.column_stack([1.0 + trace, *(1.0 - trace + 2.0 * R[:, i, i] for i in range(3))])
    products = np.empty((len(R), 4, 4))
    products[:, range(4), range(4)] = squares
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        products[:, 0, i + 1] = products[:, i + 1, 0] = 0.25 * (R[:, k, j] - R[:, j, k])
        products[:, j + 1, k + 1] = products[:, k + 1, j + 1] = 0.25 * (R[:, k, j] + R[:, j, k])
    largest = squares.argmax(axis=1)
    rows = np.arange(len(R))
    return products[rows, largest] / np.sqrt(squares[rows, largest])[:, None]
