"""Logs of known machines, by plain NumPy: the equations are written by hand and stepped by a plain Runge-Kutta loop.

Nothing is shared with the package but `Log`, so that these logs, and the rollouts behind them, may judge it.

Observation ``j`` is the state at ``t_j``; then ``u_j`` is held to ``t_{j+1}``; the acceleration at ``t_j`` is the one
under ``u_j``.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from diransac.data.log import Log

GRAVITY = 9.81
ARM_LENGTH = 0.177


@dataclass(frozen=True, eq=False)
class Machine:
    """A plant written by hand; equal to itself alone.

    Parameters
    ----------
    coordinates, inputs : names
    truth : name -> value that logs are made with, SI
    acceleration : ``(q, v, u, p) -> a``
    regressor : ``(q, v, a, u) -> W (r, n_p), b (r)``
    start : q and v at row 0
    law : ``(t, q, v) -> u``, a lively input with some feedback
    """

    coordinates: tuple[str, ...]
    inputs: tuple[str, ...]
    truth: Mapping[str, float]
    acceleration: Callable[..., Sequence[float]]
    regressor: Callable[..., tuple[list[list[float]], list[float]]]
    start: tuple[float, ...]
    law: Callable[..., tuple[float, ...]]

    @property
    def signals(self) -> tuple[str, ...]:
        """Coordinates, velocities, accelerations, in the package's names."""
        endings = ("", "_dot", "_ddot")
        return tuple(f"{name}{ending}" for ending in endings for name in self.coordinates)

    def rows(self, signals: np.ndarray, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``W (N, r, n_p)`` and ``b (N, r)`` of every row."""
        n = len(self.coordinates)
        parts = [(y[:n], y[n : 2 * n], y[2 * n :], u) for y, u in zip(signals, inputs, strict=True)]
        W, b = zip(*(self.regressor(*part) for part in parts), strict=True)
        return np.array(W, dtype=float), np.array(b, dtype=float)


# ---------------------------------------------------------------------- the machines


def rotorcraft_acceleration(q, v, u, p):
    """Dimmig et al. 2023, eq. (4)."""
    (_, _, theta), (vx, vz, _), (thrust, moment), (mass, inertia, drag) = q, v, u, p
    s, c = np.sin(theta), np.cos(theta)
    return (
        -thrust * s / mass - drag / mass * abs(thrust) * vx * c,
        thrust * c / mass - GRAVITY - drag / mass * abs(thrust) * vz * s,
        ARM_LENGTH / inertia * moment,
    )


def rotorcraft_regressor(q, v, a, u):
    """Dimmig et al. 2023, eq. (5)."""
    s, c = np.sin(q[2]), np.cos(q[2])
    thrust, moment = u
    W = [
        [a[0], 0.0, abs(thrust) * v[0] * c],
        [a[1] + GRAVITY, 0.0, abs(thrust) * v[1] * s],
        [0.0, a[2], 0.0],
    ]
    return W, [-thrust * s, thrust * c, moment * ARM_LENGTH]


def rotorcraft_law(t, q, v):
    """Chase a point on a wide, ever-changing curve, with the motors never quite at rest."""
    (x, z, theta), (vx, vz, omega) = q, v
    x_aim = 2.5 * np.sin(0.9 * t) + 1.0 * np.sin(2.3 * t + 1.0)
    z_aim = 1.2 * np.sin(1.3 * t + 0.4) + 0.5 * np.sin(3.1 * t)
    theta_aim = np.clip(-0.5 * (x_aim - x) + 0.35 * vx, -0.7, 0.7)
    lift = GRAVITY + 4.0 * (z_aim - z) - 2.5 * vz + 1.0 * np.sin(7.0 * t)
    thrust = 0.249 * np.clip(lift, 2.0, 20.0) / np.cos(np.clip(theta, -1.0, 1.0))
    moment = 0.004 / ARM_LENGTH * (40.0 * (theta_aim - theta) - 9.0 * omega + 6.0 * np.sin(11.0 * t))
    return thrust, moment


ROTORCRAFT = Machine(
    ("x", "z", "theta"),
    ("thrust", "moment"),
    {"mass": 0.249, "inertia": 0.004, "drag": 0.025},
    rotorcraft_acceleration,
    rotorcraft_regressor,
    (0.3, 0.1, 0.05, 0.0, 0.0, 0.1),
    rotorcraft_law,
)


def servo_acceleration(q, v, u, p):
    """``M q'' + Fv q' + Fc sign(q') + F0 = F``."""
    mass, viscous, dry, offset = p
    return ((u[0] - viscous * v[0] - dry * np.sign(v[0]) - offset) / mass,)


def servo_regressor(q, v, a, u):
    """Rows of the same equation."""
    return [[a[0], v[0], np.sign(v[0]), 1.0]], [u[0]]


def servo_law(t, q, v):
    """Follow a sum of sines."""
    aim = 0.1 * np.sin(2.0 * t) + 0.05 * np.sin(5.3 * t + 0.7)
    return (4000.0 * (aim - q[0]) - 600.0 * v[0],)


SERVO = Machine(
    ("position",),
    ("force",),
    {"mass": 95.11, "viscous_friction": 203.5, "dry_friction": 20.39, "offset": -3.16},
    servo_acceleration,
    servo_regressor,
    (0.0, 0.05),
    servo_law,
)


def vehicle_acceleration(q, v, u, p):
    """``m x'' + d1 x' + d2 |x'| x' + b = T``."""
    mass, linear, quadratic, bias = p
    return ((u[0] - linear * v[0] - quadratic * abs(v[0]) * v[0] - bias) / mass,)


def vehicle_regressor(q, v, a, u):
    """Rows of the same equation."""
    return [[a[0], v[0], abs(v[0]) * v[0], 1.0]], [u[0]]


def vehicle_law(t, q, v):
    """Thrust that swings, and never repeats."""
    return (120.0 * np.sin(0.7 * t) + 80.0 * np.sin(1.9 * t + 0.3) + 30.0 * np.sin(5.1 * t),)


VEHICLE = Machine(
    ("x",),
    ("thrust",),
    {"mass": 60.0, "linear_drag": 35.0, "quadratic_drag": 55.0, "bias": 4.0},
    vehicle_acceleration,
    vehicle_regressor,
    (0.0, 0.2),
    vehicle_law,
)

UPPER_LENGTH, GEAR_RATIO, STEEPNESS = 0.3, 6.0, 100.0


def pendulum_rows(q, v, a):
    """Rows ``W (2, 9)`` with ``W p = tau`` of the double pendulum (Wiebe et al. 2022)."""
    (q1, q2), (v1, v2), (a1, a2), n = q, v, a, GEAR_RATIO
    c2, s2 = UPPER_LENGTH * np.cos(q2), UPPER_LENGTH * np.sin(q2)
    g1, g12 = GRAVITY * np.sin(q1), GRAVITY * np.sin(q1 + q2)
    upper = [a1, g1, a1 + a2, c2 * (2 * a1 + a2) - s2 * (2 * v1 * v2 + v2**2) + g12, (n**2 + 1) * a1 - n * a2]
    lower = [0.0, 0.0, a1 + a2, c2 * a1 + s2 * v1**2 + g12, n**2 * a2 - n * a1]
    upper += [v1, np.arctan(STEEPNESS * v1), 0.0, 0.0]
    lower += [0.0, 0.0, v2, np.arctan(STEEPNESS * v2)]
    return np.array([upper, lower])


def pendulum_acceleration(q, v, u, p):
    """Two linear equations in two accelerations."""
    rest, along1, along2 = (pendulum_rows(q, v, a) @ p for a in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)))
    (m11, m21), (m12, m22) = along1 - rest, along2 - rest
    r1, r2 = u - rest
    determinant = m11 * m22 - m12 * m21
    return (m22 * r1 - m12 * r2) / determinant, (m11 * r2 - m21 * r1) / determinant


def pendulum_regressor(q, v, a, u):
    """Rows of the same equation."""
    return pendulum_rows(q, v, a).tolist(), list(u)


def pendulum_law(t, q, v):
    """Two torques that never repeat."""
    return (
        1.5 * np.sin(3.1 * t) + 1.2 * np.sin(7.3 * t + 0.5) + 0.5 * np.sin(17.0 * t),
        0.6 * np.sin(4.7 * t + 1.0) + 0.5 * np.sin(9.1 * t) + 0.3 * np.sin(19.0 * t),
    )


PENDULUM = Machine(
    ("q1", "q2"),
    ("torque1", "torque2"),
    {
        "inertia1": 0.09,
        "moment1": 0.3,
        "inertia2": 0.025,
        "moment2": 0.12,
        "rotor_inertia": 6e-5,
        "viscous_friction1": 0.01,
        "dry_friction1": 0.03,
        "viscous_friction2": 0.02,
        "dry_friction2": 0.02,
    },
    pendulum_acceleration,
    pendulum_regressor,
    (0.4, -0.3, 0.0, 0.5),
    pendulum_law,
)

MACHINES = {
    "planar-rotorcraft": ROTORCRAFT,
    "servo-axis": SERVO,
    "underwater-vehicle": VEHICLE,
    "double-pendulum": PENDULUM,
}


# ---------------------------------------------------------------------- their motion


def slope(machine, x, u, p):
    """``dx/dt`` of the state ``x = [q; v]`` as ``(v, a)``."""
    n = len(machine.coordinates)
    q, v = x[:n], x[n:]
    return np.concatenate([v, machine.acceleration(q, v, u, p)])


def runge_kutta_step(machine, x, u, p, dt):
    """One classical Runge-Kutta step with the input held."""
    k1 = slope(machine, x, u, p)
    k2 = slope(machine, x + dt / 2 * k1, u, p)
    k3 = slope(machine, x + dt / 2 * k2, u, p)
    k4 = slope(machine, x + dt * k3, u, p)
    return k1, x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def rollout(machine, parameters, start, inputs, dt, substeps=1):
    """All signals ``(N, n_signals)`` under recorded inputs; NaN from the row on at which one is no longer finite."""
    n = len(machine.coordinates)
    x, p = np.array(start, dtype=float), np.asarray(parameters, dtype=float)
    signals = np.full((len(inputs), 3 * n), np.nan)
    with np.errstate(all="ignore"):
        for row, u in enumerate(inputs):
            now = np.concatenate([x, slope(machine, x, u, p)[n:]])
            if not np.isfinite(now).all():
                break
            signals[row] = now
            for _ in range(substeps):
                x = runge_kutta_step(machine, x, u, p, dt / substeps)[1]
    return signals


def flight(machine, n_rows, dt, truth=None, substeps=1):
    """Signals ``(N, n_signals)`` and inputs ``(N, n_u)`` of the machine under its law, held between rows."""
    signals, inputs = _flown(machine, n_rows, dt, tuple((truth or machine.truth).values()), substeps)
    return signals.copy(), inputs.copy()


@cache
def _flown(machine, n_rows, dt, truth, substeps):
    """The same; a flight that many tests ask for is simulated once."""
    n, p, x = len(machine.coordinates), np.array(truth), np.array(machine.start)
    signals, inputs = np.empty((n_rows, 3 * n)), np.empty((n_rows, len(machine.inputs)))
    for row in range(n_rows):
        inputs[row] = machine.law(row * dt, x[:n], x[n:])
        signals[row] = np.concatenate([x, slope(machine, x, inputs[row], p)[n:]])
        for _ in range(substeps):
            x = runge_kutta_step(machine, x, inputs[row], p, dt / substeps)[1]
    return signals, inputs


def with_outliers(signals, probability, magnitude, seed, *, first_row="clean"):
    """Signals with uniform(-magnitude, magnitude) added to each sample independently with the given probability."""
    rng = np.random.default_rng(seed)
    hit = rng.random(signals.shape) < probability
    if first_row == "clean":
        hit[0] = False
    return signals + hit * rng.uniform(-magnitude, magnitude, signals.shape)


def as_log(machine, signals, inputs, dt, units=None):
    """The same as a `Log`."""
    columns = dict(zip(machine.signals, signals.T, strict=True)) | dict(zip(machine.inputs, inputs.T, strict=True))
    return Log.from_arrays(np.arange(len(signals)) * dt, columns, units, source="simulated log")
