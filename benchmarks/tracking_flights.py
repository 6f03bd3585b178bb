"""Flights of machines that change, for `tracking`: a planar rotorcraft at 100 Hz and a quadrotor at 250 Hz with an IMU.

The plants are plain NumPy: the rotorcraft of ``tests/simulated.py``, the quadrotor of `quadrotor_flights`.  Sensors of
the rotorcraft are motion capture (x, z, theta) and a gyroscope (theta_dot), those of the quadrotor an IMU at 250 Hz and
motion capture at 50 Hz.  A loss of thrust acts on every rotor; since the commands are known and the forces are not,
mass, inertias and the drag of the quadrotor seem to grow by the same factor.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
import quadrotor
import quadrotor_flights as quad

import diransac as dr
from simulated import ROTORCRAFT

Array = np.ndarray
Gust = Callable[[int], Array]

CHANGE = 30.0
"""Time of a step, s: late enough that every method has converged."""
LOSS_DURATION, LOSS = 300.0, 0.1
"""Of the slow loss of thrust, s, and its fraction."""
STEP_FACTOR = {"mass": 0.7, "inertia": 1.3}
"""A payload that is dropped; rotors or a load that move outwards."""
OUTLIERS = 0.1
GAPS = ((20.0, 21.0), (40.0, 43.0))
DROPPED = 0.05
"""Stretches without any row, s, and the fraction of rows that is lost besides."""


@dataclass(frozen=True)
class Scenario:
    """What happens in a flight.

    Parameters
    ----------
    duration : float
        s
    steps : tuple of str
        ``mass`` or ``inertia`` (every inertia of the machine), which change at `CHANGE`.
    loss, outliers, gusts, gaps : bool
    """

    duration: float = 60.0
    steps: tuple[str, ...] = ()
    loss: bool = False
    outliers: bool = False
    gusts: bool = False
    gaps: bool = False

    def factor(self, name: str, t: Array, growing: Collection[str] = ()) -> Array:
        """Value of a parameter, over that at the beginning, at times (n,); some seem to grow as thrust is lost."""
        kind = "inertia" if name.startswith("inertia") else name
        found = np.where(t >= CHANGE, STEP_FACTOR[kind], 1.0) if kind in self.steps else np.ones_like(t)
        if not self.loss or name not in growing:
            return found
        return found / (1.0 - LOSS * np.clip((t - CHANGE) / LOSS_DURATION, 0.0, 1.0))


SCENARIOS = {
    "nominal": Scenario(),
    "10 % outliers": Scenario(outliers=True),
    "gusts": Scenario(gusts=True),
    "mass step": Scenario(steps=("mass",)),
    "inertia step": Scenario(steps=("inertia",)),
    "thrust loss": Scenario(CHANGE + LOSS_DURATION + 30.0, loss=True),
    "gaps": Scenario(gaps=True),
    "combined": Scenario(120.0, ("mass",), loss=True, outliers=True, gusts=True, gaps=True),
}


@dataclass(frozen=True)
class Flight:
    """Rows of a flight, and what made them.

    Parameters
    ----------
    columns : mapping of str to (n,) array
        ``t`` in seconds, signals and inputs; NaN where a sensor has no sample.
    truth : mapping of str to (n,) array
        Parameters at the rows.
    model : dr.Model
        Whose parameters are those of ``truth``.
    start : mapping of str to float
        Values that are known beforehand, about a tenth off.
    known : mapping of str to float
        Constants of the model that a bench has measured.
    """

    columns: Mapping[str, Array]
    truth: Mapping[str, Array]
    model: dr.Model
    start: Mapping[str, float]
    known: Mapping[str, float]

    def rows(self, chosen: Array | slice) -> dict[str, Array]:
        """Columns of some rows."""
        return {name: x[chosen] for name, x in self.columns.items()}


@dataclass(frozen=True)
class Machine:
    """A kind of flight.

    Parameters
    ----------
    fly : (scenario, seed) -> Flight
    rate : float
        Of its rows, Hz.
    judged : tuple of str
        Parameters that its sensors determine within seconds.
    """

    fly: Callable[[Scenario, int], Flight]
    rate: float
    judged: tuple[str, ...] = field(default=())


# ---------------------------------------------------------------------- what both have


def _gust(rng: np.random.Generator, n: int, dt: float, sizes: Array, *, on: bool) -> Array:
    """Accelerations (n, k): first-order Gauss-Markov of one second, of the sizes (k,)."""
    found = np.zeros((n, len(sizes)))
    if on:
        keep = np.exp(-dt)
        shocks = rng.normal(size=found.shape) * sizes * np.sqrt(1.0 - keep**2)
        for k in range(1, n):
            found[k] = keep * found[k - 1] + shocks[k]
    return found


def _read(values: Array, noise: float, outlier: float, rng: np.random.Generator, *, hit: bool) -> Array:
    """Values with noise, and outliers where there are some."""
    noisy = values + rng.normal(0.0, noise, len(values))
    struck = rng.random(len(values)) < OUTLIERS * hit
    return noisy + struck * rng.uniform(-outlier, outlier, len(values))


def _flight(
    scenario: Scenario,
    rng: np.random.Generator,
    columns: Mapping[str, Array],
    beginning: Mapping[str, float],
    model: dr.Model,
    known: Mapping[str, float],
    growing: Collection[str],
) -> Flight:
    """The flight of complete rows, less those in gaps."""
    t = columns["t"]
    kept = np.ones(len(t), bool)
    if scenario.gaps:
        kept = rng.random(len(t)) >= DROPPED
        for first, last in GAPS:
            kept &= (t < first) | (t >= last)
    truth = {name: value * scenario.factor(name, t[kept], growing) for name, value in beginning.items()}
    off = {name: value * (1.0 + rng.choice([-0.1, 0.1])) for name, value in beginning.items() if "bias" not in name}
    start = {name: off.get(name, 0.0) for name in beginning}
    rows = {name: x[kept] for name, x in columns.items()}
    return Flight(rows, truth, model.with_fixed(known), start, known)


# ---------------------------------------------------------------------- planar rotorcraft
PLANAR_NOISE = {"x": 2e-3, "z": 2e-3, "theta": 3e-3, "theta_dot": 0.02}
PLANAR_OUTLIER = {"x": 1.0, "z": 1.0, "theta": 1.0, "theta_dot": 6.0}
PLANAR_GROWING = ("mass", "inertia")
"""Its drag is in proportion to the commanded thrust."""
PLANAR_GUST = np.array([0.5, 0.5, 1.0])
"""Standard deviations, m/s^2 and rad/s^2."""


def fly_planar(scenario: Scenario, seed: int) -> Flight:
    """One flight of the rotorcraft, whose parameters are those of the paper within a tenth."""
    rng, dt = np.random.default_rng([seed, 36]), 0.01
    beginning = {name: value * rng.uniform(0.9, 1.1) for name, value in ROTORCRAFT.truth.items()}
    t = dt * np.arange(round(scenario.duration / dt))
    factors = np.column_stack([scenario.factor(name, t, PLANAR_GROWING) for name in beginning])
    values = factors * list(beginning.values())
    gusts = _gust(rng, len(t), dt, PLANAR_GUST, on=scenario.gusts)
    states, inputs = _planar_motion(t, values, gusts, rng.uniform(0.0, 100.0))
    columns = {"t": t, **dict(zip(ROTORCRAFT.inputs, inputs.T, strict=True))}
    for name, place in zip(PLANAR_NOISE, (0, 1, 2, 5), strict=True):
        columns[name] = _read(states[:, place], PLANAR_NOISE[name], PLANAR_OUTLIER[name], rng, hit=scenario.outliers)
    return _flight(scenario, rng, columns, beginning, dr.models.planar_rotorcraft(), {}, PLANAR_GROWING)


def _planar_motion(t: Array, values: Array, gusts: Array, phase: float) -> tuple[Array, Array]:
    """States (n, 6) and inputs (n, 2) under the law, by a Runge-Kutta step a row; the gust is held between rows."""
    dt, x = t[1] - t[0], np.array(ROTORCRAFT.start)
    states, inputs = np.empty((len(t), 6)), np.empty((len(t), 2))
    for k in range(len(t)):
        u = ROTORCRAFT.law(t[k] + phase, x[:3], x[3:])
        states[k], inputs[k] = x, u

        def slope(y: Array, u: tuple[float, ...] = u, k: int = k) -> Array:
            return np.concatenate([y[3:], ROTORCRAFT.acceleration(y[:3], y[3:], u, values[k]) + gusts[k]])

        x = _runge_kutta(slope, x, dt)
    return states, inputs


def _runge_kutta(slope: Callable[[Array], Array], x: Array, dt: float) -> Array:
    """One classical Runge-Kutta step."""
    first = slope(x)
    second = slope(x + 0.5 * dt * first)
    third = slope(x + 0.5 * dt * second)
    return x + dt / 6.0 * (first + 2.0 * second + 2.0 * third + slope(x + dt * third))


# ---------------------------------------------------------------------- quadrotor
QUAD_RATE, QUAD_POSE_EVERY, QUAD_STEP = 250, 5, 2e-3
"""Hz; rows from a pose to the next; step of the simulation, s, a twentieth of the lag of the motors."""
QUAD_GROWING = ("mass", "inertia_x", "inertia_y", "inertia_z", "drag")
QUAD_GUST = np.array([0.5, 0.5, 0.5, 1.0, 1.0, 0.5])
WEIGHT = np.array([0.0, 0.0, quad.G])
KNOWN = "thrust_coefficient"
"""Parameter that a bench has measured: mass, inertias and coefficients are only determined up to a factor."""


def fly_quadrotor(scenario: Scenario, seed: int) -> Flight:
    """One flight of a quadrotor of `quadrotor_flights`, whose motion capture is not late."""
    rng = np.random.default_rng([seed, 37])
    airframe = quad.airframe(rng)
    every = round(1.0 / QUAD_RATE / QUAD_STEP)
    fine = QUAD_STEP * np.arange(round(scenario.duration / QUAD_STEP))
    values = {name: value * scenario.factor(name, fine, QUAD_GROWING) for name, value in airframe.items()}
    gusts = _gust(rng, len(fine), QUAD_STEP, QUAD_GUST, on=scenario.gusts)
    states, commands, forces = _quadrotor_motion(fine, values, gusts, rng)
    columns = {"t": fine[::every], **dict(zip(quad.COMMANDS, commands[::every].T, strict=True))}
    columns |= _quadrotor_readings(states[::every], forces[::every], airframe, rng, hit=scenario.outliers)
    beginning = {name: x for name, x in airframe.items() if name != KNOWN}
    return _flight(scenario, rng, columns, beginning, quadrotor.model(), {KNOWN: airframe[KNOWN]}, QUAD_GROWING)


def _quadrotor_motion(
    t: Array, values: Mapping[str, Array], gusts: Array, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """States (n, 22), commands (n, 4), and specific forces without gravity (n, 3) in the world frame."""
    path = quad.path(rng)
    p = {name: float(x[0]) for name, x in values.items()}
    x, first = quad.beginning(p, path), dict(p)
    states, commands, forces = np.empty((len(t), 22)), np.empty((len(t), 4)), np.empty((len(t), 3))
    for k in range(len(t)):
        p = {name: float(x[k]) for name, x in values.items()}
        if k % round(1.0 / QUAD_RATE / QUAD_STEP) == 0:
            command = quad.pilot(t[k], x, first, path)

        def slope(y: Array, p: dict[str, float] = p, command: Array = command, k: int = k) -> Array:
            found = quad.slope(y, command, p)
            found[3:6] += gusts[k, :3]
            found[15:18] += gusts[k, 3:]
            return found

        states[k], commands[k], forces[k] = x, command, slope(x)[3:6] + WEIGHT
        x = _runge_kutta(slope, x, QUAD_STEP)
    return states, commands, forces


def _quadrotor_readings(
    states: Array, forces: Array, airframe: Mapping[str, float], rng: np.random.Generator, *, hit: bool
) -> dict[str, Array]:
    """Columns of the sensors."""
    R = states[:, 6:15].reshape(-1, 3, 3)
    attitudes = quad.quaternions(R) * rng.choice([-1.0, 1.0], (len(states), 1))
    seen = np.arange(len(states)) % QUAD_POSE_EVERY == 0
    groups = (
        (quad.GYRO, "gyro", states[:, 15:18]),
        (quad.ACC, "acc", np.einsum("nji,nj->ni", R, forces)),
        (quad.POSITION, "position", states[:, :3]),
        (quad.ATTITUDE, "attitude", attitudes),
    )
    columns = {}
    for names, kind, of_group in groups:
        for name, value in zip(names, of_group.T, strict=True):
            biased = value + airframe.get(quad.bias(name), 0.0) if kind in ("gyro", "acc") else value
            read = _read(biased, quad.NOISE[kind], quad.OUTLIER[kind], rng, hit=hit)
            columns[name] = read if kind in ("gyro", "acc") else np.where(seen, read, np.nan)
    return columns


MACHINES = {
    "planar": Machine(fly_planar, 100.0, ("mass", "inertia", "drag")),
    "quadrotor": Machine(fly_quadrotor, QUAD_RATE, ("mass", "inertia_x", "inertia_y", "drag")),
}
