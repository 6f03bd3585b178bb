"""Equations of the machines of `tracking_flights` in plain NumPy, over batches, for the baselines of `tracking`.

A state is an array (m, n_x); its errors are tangent vectors (m, n_t), three for an attitude.  Parameters are columns by
name, (m,) each.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
import quadrotor_flights as quad

from simulated import ARM_LENGTH, GRAVITY

Array = np.ndarray
Columns = Mapping[str, Array]


class Body(Protocol):
    """Equations of a machine and its sensors."""

    parameters: tuple[str, ...]
    signals: tuple[str, ...]
    inputs: tuple[str, ...]
    noise: Array
    """Standard deviation of each signal."""
    first_std: Array
    """Of the errors of the first state, (n_t,)."""
    pushed: Array
    """Density of the random accelerations that a filter assumes, (n_t,), relative to its tuning."""

    def first(self, rows: Columns) -> Array:
        """State (n_x,) at the last of some rows, from robust lines through them."""

    def slope(self, x: Array, p: Columns, u: Array) -> Array:
        """Time derivatives (m, n_x) of states (m, n_x)."""

    def readings(self, x: Array, p: Columns, u: Array) -> Array:
        """What the sensors read, (m, n_y)."""

    def moved(self, x: Array, error: Array) -> Array:
        """States (m, n_x) with errors (m, n_t)."""

    def apart(self, x: Array, y: Array) -> Array:
        """Errors (m, n_t) of states against one state (n_x,)."""

    def aligned(self, y: Array, predicted: Array) -> Array:
        """A sample (n_y,) in the form of its prediction."""


def advanced(body: Body, x: Array, p: Columns, u: Array, dt: float) -> Array:
    """States after a Runge-Kutta step."""
    first = body.slope(x, p, u)
    second = body.slope(x + 0.5 * dt * first, p, u)
    third = body.slope(x + 0.5 * dt * second, p, u)
    return x + dt / 6.0 * (first + 2.0 * second + 2.0 * third + body.slope(x + dt * third, p, u))


def _lines(rows: Columns, names: Sequence[str]) -> tuple[Array, Array]:
    """Values at the last row and slopes of the lines of Theil and Sen through some columns."""
    found = []
    for name in names:
        seen = np.isfinite(rows[name])
        t, y = rows["t"][seen] - rows["t"][-1], rows[name][seen]
        i, j = np.triu_indices(len(t), 1)
        slope = np.median((y[j] - y[i]) / (t[j] - t[i]))
        found.append((np.median(y - slope * t), slope))
    values, slopes = np.array(found).T
    return values, slopes


class Planar:
    """Planar rotorcraft: x, z, theta and their derivatives (Dimmig et al. 2023, eq. (4))."""

    parameters = ("mass", "inertia", "drag")
    signals = ("x", "z", "theta", "theta_dot")
    inputs = ("thrust", "moment")
    noise = np.array([2e-3, 2e-3, 3e-3, 0.02])
    first_std = np.array([0.02, 0.02, 0.02, 0.5, 0.5, 0.1])
    pushed = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 2.0])

    def first(self, rows: Columns) -> Array:
        """Pose and rate, and slopes of the position."""
        (x, z, theta, rate), (x_dot, z_dot, *_) = _lines(rows, self.signals)
        return np.array([x, z, theta, x_dot, z_dot, rate])

    def slope(self, x: Array, p: Columns, u: Array) -> Array:
        """Of position, then of velocity."""
        thrust, moment = u
        s, c, drag = np.sin(x[:, 2]), np.cos(x[:, 2]), p["drag"] * abs(thrust)
        ax = (-thrust * s - drag * x[:, 3] * c) / p["mass"]
        az = (thrust * c - drag * x[:, 4] * s) / p["mass"] - GRAVITY
        return np.column_stack([x[:, 3:], ax, az, ARM_LENGTH * moment / p["inertia"]])

    def readings(self, x: Array, p: Columns, u: Array) -> Array:
        """Pose and rate."""
        return x[:, [0, 1, 2, 5]]

    def moved(self, x: Array, error: Array) -> Array:
        """Sum."""
        return x + error

    def apart(self, x: Array, y: Array) -> Array:
        """Difference."""
        return x - y

    def aligned(self, y: Array, predicted: Array) -> Array:
        """Itself."""
        return y


class Quadrotor:
    """Position, velocity, unit quaternion, angular velocity, and speeds of the rotors (see `quadrotor_flights`).

    Parameters
    ----------
    thrust_coefficient : float
        Known from a bench.
    """

    parameters = (
        *("mass", "inertia_x", "inertia_y", "inertia_z", "torque_coefficient", "drag", "motor_time_constant"),
        *(quad.bias(name) for name in (*quad.GYRO, *quad.ACC)),
    )
    signals = (*quad.GYRO, *quad.ACC, *quad.POSITION, *quad.ATTITUDE)
    inputs = quad.COMMANDS
    noise = np.repeat([quad.NOISE[kind] for kind in ("gyro", "acc", "position", "attitude")], (3, 3, 3, 4))
    first_std = np.repeat([0.02, 0.5, 0.05, 0.2, 200.0], (3, 3, 3, 3, 4))
    pushed = np.repeat([0.0, 1.0, 0.0, 2.0, 0.0], (3, 3, 3, 3, 4))

    def __init__(self, thrust_coefficient: float) -> None:
        self.thrust_coefficient = thrust_coefficient

    def first(self, rows: Columns) -> Array:
        """Pose and rates, slopes of the position, the speeds at the commands."""
        found = np.zeros(17)
        found[:3], found[3:6] = _lines(rows, quad.POSITION)
        attitudes = np.column_stack([rows[name] for name in quad.ATTITUDE])
        signs = np.sign(attitudes @ np.nan_to_num(attitudes[np.isfinite(attitudes).all(axis=1)][0]))
        turned = {"t": rows["t"], **dict(zip(quad.ATTITUDE, (attitudes * signs[:, None]).T, strict=True))}
        attitude, _ = _lines(turned, quad.ATTITUDE)
        found[6:10] = attitude / np.linalg.norm(attitude)
        found[10:13], _ = _lines(rows, quad.GYRO)
        found[13:] = [rows[name][-1] for name in quad.COMMANDS]
        return found

    def slope(self, x: Array, p: Columns, u: Array) -> Array:
        """Newton's and Euler's equations, and the lag of the motors."""
        q, w, speeds = x[:, 6:10], x[:, 10:13], x[:, 13:]
        turned = 0.5 * _product(q, np.column_stack([np.zeros(len(x)), w]))
        force = rotated(q, self._specific_force(x, p)) - [0.0, 0.0, quad.G]
        thrusts = self.thrust_coefficient * speeds**2
        yaw = -p["torque_coefficient"] * (speeds**2 @ quad.DIRECTIONS)
        J = np.column_stack([p[f"inertia_{axis}"] for axis in "xyz"])
        moments = np.column_stack([thrusts @ quad.PLACES[:, 1], -(thrusts @ quad.PLACES[:, 0]), yaw])
        lag = (u - speeds) / p["motor_time_constant"][:, None]
        return np.hstack([x[:, 3:6], force, turned, (moments - _cross(w, J * w)) / J, lag])

    def _specific_force(self, x: Array, p: Columns) -> Array:
        """Force of rotors and drag over the mass, in the frame of the body."""
        velocity = rotated(x[:, 6:10] * [1.0, -1.0, -1.0, -1.0], x[:, 3:6])
        thrust = self.thrust_coefficient * (x[:, 13:] ** 2).sum(axis=1)
        force = np.column_stack([-p["drag"] * velocity[:, 0], -p["drag"] * velocity[:, 1], thrust])
        return force / p["mass"][:, None]

    def readings(self, x: Array, p: Columns, u: Array) -> Array:
        """IMU with its biases, and pose."""
        gyro = x[:, 10:13] + np.column_stack([p[quad.bias(name)] for name in quad.GYRO])
        acc = self._specific_force(x, p) + np.column_stack([p[quad.bias(name)] for name in quad.ACC])
        return np.hstack([gyro, acc, x[:, :3], x[:, 6:10]])

    def moved(self, x: Array, error: Array) -> Array:
        """Sum, and for the attitude a rotation in the frame of the body."""
        found = x + np.insert(error, 6, 0.0, axis=1)
        half = 0.5 * error[:, 6:9]
        q = _product(np.broadcast_to(x[..., 6:10], (len(error), 4)), np.column_stack([np.ones(len(error)), half]))
        found[:, 6:10] = q / np.linalg.norm(q, axis=1, keepdims=True)
        return found

    def apart(self, x: Array, y: Array) -> Array:
        """Difference, and for the attitude a small rotation."""
        turned = _product(np.broadcast_to(y[6:10] * [1.0, -1.0, -1.0, -1.0], (len(x), 4)), x[:, 6:10])
        rotation = 2.0 * turned[:, 1:] / turned[:, :1]
        return np.hstack([x[:, :6] - y[:6], rotation, x[:, 10:] - y[10:]])

    def aligned(self, y: Array, predicted: Array) -> Array:
        """The quaternion with the sign of the prediction."""
        sign = -1.0 if np.nansum(y[9:] * predicted[9:]) < 0.0 else 1.0
        return np.concatenate([y[:9], sign * y[9:]])


def _product(a: Array, b: Array) -> Array:
    """Products of quaternions (m, 4), scalar part first."""
    return np.column_stack(
        [
            a[:, 0] * b[:, 0] - (a[:, 1:] * b[:, 1:]).sum(axis=1),
            *(a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + _cross(a[:, 1:], b[:, 1:])).T,
        ]
    )


def rotated(q: Array, v: Array) -> Array:
    """Vectors (m, 3) from the frame of the body into the world's."""
    t = 2.0 * _cross(q[:, 1:], v)
    return v + q[:, :1] * t + _cross(q[:, 1:], t)


def _cross(a: Array, b: Array) -> Array:
    """Cross products (m, 3); several times as fast as NumPy's on short arrays."""
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]
