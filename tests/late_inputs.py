"""Logs of machines of which one input acts late, and the model is exact otherwise; by plain NumPy.

The equations are written by hand, and stepped by a plain Runge-Kutta loop in two steps per sample.
"""

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

import diransac as dr

STEPS = 2


@dataclass(frozen=True)
class LateMachine:
    """A machine with several inputs.

    ``rate`` is ``(x, u) -> dx/dt``; ``logged`` has the place of each signal in the state, and the noise of its sensor;
    ``command`` has the mean, RMS, and the slowest and fastest angular frequency, rad/s, of each input.
    """

    model: dr.Model
    truth: dict[str, float]
    rate: Callable[[np.ndarray, np.ndarray], np.ndarray]
    start: tuple[float, ...]
    logged: dict[str, tuple[int, float]]
    command: dict[str, tuple[float, float, float, float]]
    dt: float
    duration: float

    def log(self, seed: int, late: dict[str, int] | None = None) -> dr.Log:
        """A log of one seed; ``late`` has the samples after which some of the inputs, which are held, act."""
        rng, n_rows = np.random.default_rng([seed, 77]), round(self.duration / self.dt)
        time, inputs = self.dt * np.arange(n_rows), {}
        for name, (mean, size, slow, fast) in self.command.items():
            speeds, phases = np.geomspace(slow, fast, 6) * rng.uniform(0.9, 1.1, 6), rng.uniform(0.0, 6.28, 6)
            inputs[name] = mean + size / np.sqrt(3.0) * np.sin(np.outer(time, speeds) + phases).sum(axis=1)
        shifts = late or {}
        acting = [np.r_[np.repeat(u[:1], shifts.get(n, 0)), u][:n_rows] for n, u in inputs.items()]
        x, h, states = np.array(self.start, float), self.dt / STEPS, []
        for u in np.stack(acting, axis=1):
            states.append(x)
            for _ in range(STEPS):
                k1 = self.rate(x, u)
                k2 = self.rate(x + 0.5 * h * k1, u)
                k3 = self.rate(x + 0.5 * h * k2, u)
                x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + self.rate(x + h * k3, u))
        y = np.stack(states)
        columns = {n: y[:, k] + std * rng.standard_normal(n_rows) for n, (k, std) in self.logged.items()}
        return dr.Log.from_arrays(time, columns | inputs, source=f"{self.model.name} {seed}")


WING = {"drag": 0.045, "lift": 2.2, "pitch": 14.0, "damping": 3.0, "stiffness": 9.0}
_WEIGHT, _SPEED_OF_TRIM = 9.81, 14.0


def _wing_model() -> dr.Model:
    """Speed, climb angle and pitch of a wing of one kilogram: thrust, N, and elevator, rad."""

    def equations(q, v, a, u, p):
        aloft = v.speed / _SPEED_OF_TRIM
        attack = q.theta - v.climb
        return [
            a.theta + p.damping * aloft * v.theta + p.stiffness * aloft**2 * attack - p.pitch * aloft**2 * u.elevator,
            a.speed + p.drag * v.speed**2 / 10.0 + _WEIGHT * ca.sin(v.climb) - u.thrust,
            v.speed * a.climb - p.lift * aloft**2 * _WEIGHT * (0.45 + attack) + _WEIGHT * ca.cos(v.climb),
        ]

    parameters = {"drag": "1/m", "lift": "", "pitch": "1/s^2", "damping": "1/s", "stiffness": "1/s^2"}
    return dr.Model(
        "wing", {"theta": "rad"}, {"thrust": "m/s^2", "elevator": "rad"},
        {n: dr.Parameter(unit) for n, unit in parameters.items()}, equations,
        first_order={"speed": "m/s", "climb": "rad"},
    )  # fmt: skip


def _wing_rate(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    p, (theta, turn, speed, climb), (thrust, elevator) = WING, x, u
    aloft, attack = speed / _SPEED_OF_TRIM, theta - climb
    pitching = (p["pitch"] * elevator - p["stiffness"] * attack) * aloft**2 - p["damping"] * aloft * turn
    faster = thrust - p["drag"] * speed**2 / 10.0 - _WEIGHT * np.sin(climb)
    higher = _WEIGHT * (p["lift"] * aloft**2 * (0.45 + attack) - np.cos(climb)) / speed
    return np.array([turn, pitching, faster, higher])


CYLINDER = {"mass": 80.0, "friction": 900.0, "spring": 4.0e3, "gain": 40.0, "leak": 6.0}
_AREA, _STIFFNESS = 1.0e-3, 2.0e3
"""Of the piston, m^2; of the oil, 1/m."""


def _cylinder_model() -> dr.Model:
    """A piston, its pressure in bar, a valve and a load in N."""
    area = 1e5 * _AREA

    def equations(q, v, a, u, p):
        return [
            p.mass * a.x + p.friction * v.x + p.spring * q.x - area * v.pressure + u.load,
            a.pressure + _STIFFNESS * v.x + p.leak * v.pressure - 10.0 * p.gain * u.valve,
        ]

    units = {"mass": "kg", "friction": "N s/m", "spring": "N/m", "gain": "bar/s", "leak": "1/s"}
    return dr.Model(
        "cylinder", {"x": "m"}, {"valve": "", "load": "N"}, {n: dr.Parameter(unit) for n, unit in units.items()},
        equations, first_order={"pressure": "bar"},
    )  # fmt: skip


def _cylinder_rate(y: np.ndarray, u: np.ndarray) -> np.ndarray:
    p, (x, speed, pressure), (valve, load) = CYLINDER, y, u
    force = 1e5 * _AREA * pressure - load - p["friction"] * speed - p["spring"] * x
    flow = 10.0 * p["gain"] * valve - _STIFFNESS * speed - p["leak"] * pressure
    return np.array([speed, force / p["mass"], flow])


MACHINES = {
    "wing": LateMachine(
        _wing_model(), WING, _wing_rate, (0.05, 0.0, 14.0, 0.0),
        {"theta": (0, 2e-3), "theta_dot": (1, 5e-3), "speed": (2, 0.05), "climb": (3, 3e-3)},
        {"thrust": (0.9, 1.2, 0.4, 6.0), "elevator": (0.0, 0.05, 0.8, 9.0)}, 0.02, 20.0,
    ),
    "cylinder": LateMachine(
        _cylinder_model(), CYLINDER, _cylinder_rate, (0.0, 0.0, 0.0),
        {"x": (0, 2e-5), "x_dot": (1, 5e-4), "pressure": (2, 0.05)},
        {"valve": (0.0, 0.4, 3.0, 60.0), "load": (100.0, 150.0, 3.0, 60.0)}, 0.002, 3.0,
    ),
}  # fmt: skip
