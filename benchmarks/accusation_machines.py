"""Machines of the table of accusations: a model as a user writes it, and an independent NumPy plant.

Each has fixed scales inside nonlinear terms where such machines have them.  Nothing happens when this file is run.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

import diransac as dr

Array = np.ndarray[Any, Any]
G = 9.81
"""Gravity, m/s^2."""


@dataclass(frozen=True)
class Machine:
    """A machine, how it is moved, and what measures it.

    Parameters
    ----------
    model : what a user would identify
    base : by parameter, the middle of what is drawn
    rates : ``(x, u, p, t) -> dx/dt`` of the plant's state; the coordinates come first
    steer : ``(t, x, reference) -> u``; the reference is a sum of sines per input, of size 1
    noise : by measured coordinate or state, the noise's standard deviation, its unit
    start : of the state
    dt, duration : of the log, s
    low, high : frequencies of the reference, Hz
    resolution : of the encoder of each coordinate that has one
    """

    model: dr.Model
    base: Mapping[str, float]
    rates: Callable[..., Array]
    steer: Callable[..., Array]
    noise: Mapping[str, float]
    start: tuple[float, ...]
    dt: float = 0.01
    duration: float = 20.0
    low: float = 0.1
    high: float = 1.5
    resolution: Mapping[str, float] = field(default_factory=dict)


def _known(units: Mapping[str, str], positive: str) -> dict[str, dr.Parameter]:
    above = positive.split()
    return {n: dr.Parameter(u, positive=True) if n in above else dr.Parameter(u, lower=0.0) for n, u in units.items()}


# ---------------------------------------------------------------------- an unbalanced turret with dry friction

_SLIP = 0.05
"""Width of the dry friction of the turret, rad/s."""


def turret(slip: float = _SLIP, *, gravity: bool = True) -> dr.Model:
    """The model of the turret, with another width of its friction or without its imbalance."""
    units = {"J": "kg m^2", "b": "N m s/rad", "fc": "N m"} | ({"mgl": "N m"} if gravity else {})
    return dr.Model(
        "turret", {"yaw": "rad"}, {"motor": "N m"}, _known(units, "J"),
        lambda q, v, a, u, p: [
            p.J * a.yaw + p.b * v.yaw + p.fc * ca.tanh(v.yaw / slip)
            + (p.mgl * ca.sin(q.yaw) if gravity else 0.0) - u.motor
        ],
    )  # fmt: skip


def _turret_rates(x: Array, u: Array, p: Any, t: float) -> Array:  # noqa: ARG001
    q, v = x
    return np.array([v, (u[0] - p.b * v - p.fc * np.tanh(v / _SLIP) - p.mgl * np.sin(q)) / p.J])


TURRET = Machine(
    turret(), {"J": 0.08, "b": 0.12, "fc": 0.15, "mgl": 0.9}, _turret_rates,
    lambda t, x, r: np.array([1.6 * r(t, 0) + 1.5 * (0.9 * r(0.7 * t, 1) - x[0]) - 0.25 * x[1]]),
    {"yaw": 4e-4}, (0.1, 0.0), resolution={"yaw": 2.0 * np.pi / 4096},
)  # fmt: skip

# ---------------------------------------------------------------------- a gantry with a swinging load

_LOAD, _ROPE = 4.0, 0.9
"""Known mass of the load, kg, and length of the rope, m."""


def gantry(slip: float = 0.02) -> dr.Model:
    """The model of the gantry, with a width of the dry friction of its rail, m/s."""
    units = {"cart": "kg", "drag": "N s/m", "rail": "N", "pivot": "N m s/rad"}
    return dr.Model(
        "gantry", {"x": "m", "sway": "rad"}, {"force": "N"}, _known(units, "cart"),
        lambda q, v, a, u, p: [
            (p.cart + _LOAD) * a.x + _LOAD * _ROPE * (ca.cos(q.sway) * a.sway - ca.sin(q.sway) * v.sway**2)
            + p.drag * v.x + p.rail * ca.tanh(v.x / slip) - u.force,
            _LOAD * _ROPE * (_ROPE * a.sway + ca.cos(q.sway) * a.x + G * ca.sin(q.sway)) + p.pivot * v.sway,
        ],
    )  # fmt: skip


def _gantry_rates(x: Array, u: Array, p: Any, t: float) -> Array:  # noqa: ARG001
    _, sway, v, w = x
    c, s = np.cos(sway), np.sin(sway)
    mass = np.array([[p.cart + _LOAD, _LOAD * _ROPE * c], [_LOAD * _ROPE * c, _LOAD * _ROPE**2]])
    push = u[0] + _LOAD * _ROPE * s * w * w - p.drag * v - p.rail * np.tanh(v / 0.02)
    a = np.linalg.solve(mass, [push, -_LOAD * _ROPE * G * s - p.pivot * w])
    return np.array([v, w, a[0], a[1]])


GANTRY = Machine(
    gantry(), {"cart": 9.0, "drag": 6.0, "rail": 3.0, "pivot": 0.08}, _gantry_rates,
    lambda t, x, r: np.array([30.0 * r(t, 0) - 40.0 * x[0] - 8.0 * x[2]]),
    {"x": 2e-4, "sway": 5e-4}, (0.0, 0.1, 0.0, 0.0), high=1.0, resolution={"x": 2e-4, "sway": 2.0 * np.pi / 8192},
)  # fmt: skip

# ---------------------------------------------------------------------- a horizontal arm of two links

_L1, _L2 = 0.4, 0.3
"""Lengths of the links, m."""


def _scara() -> dr.Model:
    units = {"I1": "kg m^2", "I2": "kg m^2", "h": "kg m", "b1": "N m s/rad", "b2": "N m s/rad"}
    return dr.Model(
        "scara", {"q1": "rad", "q2": "rad"}, {"t1": "N m", "t2": "N m"}, _known(units, "I1 I2 h"),
        lambda q, v, a, u, p: [
            (p.I1 + p.I2 + 2.0 * p.h * _L1 * ca.cos(q.q2)) * a.q1 + (p.I2 + p.h * _L1 * ca.cos(q.q2)) * a.q2
            - p.h * _L1 * ca.sin(q.q2) * (2.0 * v.q1 + v.q2) * v.q2 + p.b1 * v.q1 - u.t1,
            (p.I2 + p.h * _L1 * ca.cos(q.q2)) * a.q1 + p.I2 * a.q2
            + p.h * _L1 * ca.sin(q.q2) * v.q1**2 + p.b2 * v.q2 - u.t2,
        ],
    )  # fmt: skip


def _scara_rates(x: Array, u: Array, p: Any, t: float) -> Array:  # noqa: ARG001
    _, q2, v1, v2 = x
    c, s = p.h * _L1 * np.cos(q2), p.h * _L1 * np.sin(q2)
    mass = np.array([[p.I1 + p.I2 + 2.0 * c, p.I2 + c], [p.I2 + c, p.I2]])
    push = np.array([u[0] + s * (2.0 * v1 + v2) * v2 - p.b1 * v1, u[1] - s * v1 * v1 - p.b2 * v2])
    return np.concatenate([[v1, v2], np.linalg.solve(mass, push)])


SCARA = Machine(
    _scara(), {"I1": 0.35, "I2": 0.09, "h": 0.25, "b1": 0.8, "b2": 0.25}, _scara_rates,
    lambda t, x, r: np.array([3.5 * r(t, 0) - 3.0 * x[0] - 0.3 * x[2], 1.4 * r(t, 1) - 1.2 * x[1] - 0.1 * x[3]]),
    {"q1": 3e-4, "q2": 3e-4}, (0.0, 0.4, 0.0, 0.0), resolution={"q1": 2.0 * np.pi / 8192, "q2": 2.0 * np.pi / 8192},
)  # fmt: skip

# ---------------------------------------------------------------------- a float in a magnetic field

_GAP = 0.012
"""Gap to which the force of the coil refers, m."""


def _levitator() -> dr.Model:
    known = {"k": dr.Parameter("N/A^2", positive=True), "c": dr.Parameter("N s/m", lower=0.0)}
    return dr.Model(
        "levitator", {"gap": "m"}, {"current": "A"}, known,
        lambda q, v, a, u, p: [
            0.068 * (a.gap - G) + p.c * v.gap + p.k * u.current**2 / (1.0 + q.gap / _GAP) ** 2
        ],
    )  # fmt: skip


def _levitator_rates(x: Array, u: Array, p: Any, t: float) -> Array:  # noqa: ARG001
    return np.array([x[1], G - (p.c * x[1] + p.k * u[0] ** 2 / (1.0 + x[0] / _GAP) ** 2) / 0.068])


def _levitator_steer(t: float, x: Array, r: Callable[..., float]) -> Array:
    wanted = 0.010 + 0.004 * r(t, 0)
    push = np.clip(0.068 * (G + 900.0 * (x[0] - wanted) + 50.0 * x[1]), 0.05, 3.0)
    return np.array([np.sqrt(push / 2.2) * (1.0 + x[0] / _GAP)])


LEVITATOR = Machine(
    _levitator(), {"k": 2.2, "c": 0.15}, _levitator_rates, _levitator_steer, {"gap": 3e-6}, (0.010, 0.0),
    dt=0.002, duration=6.0, low=0.5, high=5.0,
)  # fmt: skip

# ---------------------------------------------------------------------- a ball on a beam that a motor tilts


def _beam() -> dr.Model:
    units = {"J": "kg m^2", "m": "kg", "b": "N m s/rad", "roll": "1/s"}
    return dr.Model(
        "ball and beam", {"r": "m", "tilt": "rad"}, {"torque": "N m"}, _known(units, "J m"),
        lambda q, v, a, u, p: [
            1.4 * a.r + p.roll * v.r + G * ca.sin(q.tilt) - q.r * v.tilt**2,
            p.J * a.tilt + p.m * (q.r**2 * a.tilt + 2.0 * q.r * v.r * v.tilt + G * q.r * ca.cos(q.tilt))
            + p.b * v.tilt - u.torque,
        ],
    )  # fmt: skip


def _beam_rates(x: Array, u: Array, p: Any, t: float) -> Array:  # noqa: ARG001
    r, tilt, v, w = x
    of_r = (r * w * w - G * np.sin(tilt) - p.roll * v) / 1.4
    push = u[0] - p.m * (2.0 * r * v * w + G * r * np.cos(tilt)) - p.b * w
    return np.array([v, w, of_r, push / (p.J + p.m * r * r)])


def _beam_steer(t: float, x: Array, r: Callable[..., float]) -> Array:
    wanted = np.clip(0.9 * (x[0] - 0.25 * r(t, 0)) + 0.7 * x[2], -0.5, 0.5)
    return np.array([1.1 * x[0] + 3.0 * (wanted - x[1]) - 0.5 * x[3]])


BEAM = Machine(
    _beam(), {"J": 0.05, "m": 0.11, "b": 0.06, "roll": 0.1}, _beam_rates, _beam_steer,
    {"r": 2e-4, "tilt": 3e-4}, (0.1, 0.0, 0.0, 0.0), low=0.05, high=0.4,
    resolution={"r": 2e-4, "tilt": 2.0 * np.pi / 8192},
)  # fmt: skip

# ---------------------------------------------------------------------- a boat with two thrusters

_UNITS = {"m": "kg", "I": "kg m^2", "Xu": "N s/m", "Yv": "N s/m", "Nr": "N m s/rad", "gain": "N"}


def _boat() -> dr.Model:
    def kinematics(q: Any, v: Any) -> list[Any]:
        c, s = ca.cos(q.heading), ca.sin(q.heading)
        return [c * v.surge - s * v.sway, s * v.surge + c * v.sway, v.yaw]

    known = _known(_UNITS, "I Xu Yv Nr gain")
    del known["m"]
    return dr.Model(
        "boat", {"north": "m", "east": "m", "heading": "rad"}, {"port": "1", "starboard": "1"}, known,
        lambda q, v, a, u, p: [
            60.0 * (a.surge - v.sway * v.yaw) + p.Xu * v.surge - p.gain * (u.port + u.starboard),
            60.0 * (a.sway + v.surge * v.yaw) + p.Yv * v.sway,
            p.I * a.yaw + p.Nr * v.yaw - 0.4 * p.gain * (u.port - u.starboard),
        ],
        velocities={"surge": "m/s", "sway": "m/s", "yaw": "rad/s"}, kinematics=kinematics,
    )  # fmt: skip


def _boat_rates(x: Array, u: Array, p: Any, t: float) -> Array:  # noqa: ARG001
    _, _, psi, surge, sway, yaw = x
    c, s = np.cos(psi), np.sin(psi)
    return np.array(
        [
            c * surge - s * sway,
            s * surge + c * sway,
            yaw,
            sway * yaw + (p.gain * (u[0] + u[1]) - p.Xu * surge) / 60.0,
            -surge * yaw - p.Yv * sway / 60.0,
            (0.4 * p.gain * (u[0] - u[1]) - p.Nr * yaw) / p.I,
        ]
    )


BOAT = Machine(
    _boat(), {"I": 12.0, "Xu": 22.0, "Yv": 60.0, "Nr": 18.0, "gain": 30.0}, _boat_rates,
    lambda t, x, r: np.array([0.45 + 0.5 * r(t, 0), 0.35 + 0.5 * r(t, 1)]),
    {"north": 0.01, "east": 0.01, "heading": 0.003}, (0.0,) * 6, dt=0.05, duration=80.0, low=0.03, high=0.3,
)  # fmt: skip

# ---------------------------------------------------------------------- a cart between progressive springs

_CORNER, _WAVE = 0.05, 0.08
"""Length at which the spring softens, and that of a wave of the rail, m."""


def slider(corner: float = _CORNER, wave: float = _WAVE) -> dr.Model:
    """The model of the cart, with other lengths inside of its nonlinear terms."""
    units = {"mass": "kg", "spring": "N", "detent": "N", "damper": "N s/m"}
    return dr.Model(
        "slider", {"s": "m"}, {"push": "N"}, _known(units, "mass"),
        lambda q, v, a, u, p: [
            p.mass * a.s + p.damper * v.s + p.spring * ca.atan(q.s / corner) + p.detent * ca.sin(q.s / wave) - u.push
        ],
    )  # fmt: skip


def _slider_rates(x: Array, u: Array, p: Any, t: float) -> Array:  # noqa: ARG001
    s, v = x
    force = u[0] - p.damper * v - p.spring * np.arctan(s / _CORNER) - p.detent * np.sin(s / _WAVE)
    return np.array([v, force / p.mass])


SLIDER = Machine(
    slider(), {"mass": 2.5, "spring": 12.0, "detent": 3.0, "damper": 4.0}, _slider_rates,
    lambda t, x, r: np.array([22.0 * r(t, 0) - 15.0 * x[0]]), {"s": 5e-5}, (0.0, 0.0), resolution={"s": 1e-4},
)  # fmt: skip
