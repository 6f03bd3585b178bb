"""Machines of the regimes: a model as a user writes it, an independent NumPy plant, a controller, sensors.

Plants share no code with the package: accelerations are solved by hand, lanes (one per seed) are the last axis, and
parameters are drawn per seed within 30 % of a base.  Nothing happens when this file is run.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

import diransac as dr

Array = np.ndarray[Any, Any]
G = 9.81
"""Gravity, m/s^2."""
SPREAD = 1.3
"""Largest ratio of a machine's parameter and its base, either way."""


class Multisine:
    """Sums of sines with random phases, log-uniform frequencies, and RMS `rms` each: (n, L) at time t, L the seeds."""

    def __init__(
        self, rngs: Sequence[np.random.Generator], rms: Sequence[float], low: float, high: float, n: int = 6
    ) -> None:
        shape = (n, len(rms))
        self._rate = _lanes(rngs, lambda rng: 2.0 * np.pi * np.exp(rng.uniform(np.log(low), np.log(high), shape)))
        self._phase = _lanes(rngs, lambda rng: rng.uniform(0.0, 2.0 * np.pi, shape))
        self._amplitude = np.sqrt(2.0 / n) * np.asarray(rms, dtype=float)[:, None]

    def __call__(self, t: float, derivative: int = 0) -> Array:
        """Values, or time derivatives, at one time."""
        angle = self._rate * t + self._phase + derivative * np.pi / 2.0
        return self._amplitude * (self._rate**derivative * np.sin(angle)).sum(axis=0)


def _lanes(rngs: Sequence[np.random.Generator], drawn: Callable[[np.random.Generator], Array]) -> Array:
    return np.stack([drawn(rng) for rng in rngs], axis=-1)


@dataclass(frozen=True)
class Machine:
    """A machine, what flies it, and what measures it.

    Parameters
    ----------
    name : of the machine; machines of a name have the same parameters and reference at the same seed
    model : what a user would identify
    base : by parameter, the middle of what is drawn
    accelerations : ``(q, v, u, p, f) -> (n_v, L)``, with generalised forces f (n_v, L) that the model lacks
    reference : ``rngs -> Multisine``
    control : ``(t, q, v, r, p) -> u (n_u, L)``, with the reference r
    noise : by measured signal, the noise's standard deviation, the signal's unit
    dt, duration : of the log, s
    substeps : RK4 steps a sample
    bandwidth : of the baselines' filter, Hz; about the best for ordinary least squares at seeds from 1000 on
    kinematics : ``(q, v) -> dq/dt``; None: v
    on_reference : ``r -> (q, v)`` at the start; None: at rest in 0
    modelled : accelerations as the model has them; None: those of the plant
    n_plant : coordinates of a plant that has more than the model, the model's first; None: as many
    """

    name: str
    model: dr.Model
    base: Mapping[str, float]
    accelerations: Callable[..., Array]
    reference: Callable[[Sequence[np.random.Generator]], Multisine]
    control: Callable[..., Array]
    noise: Mapping[str, float]
    dt: float
    duration: float
    substeps: int
    bandwidth: float
    kinematics: Callable[[Array, Array], Array] | None = None
    on_reference: Callable[[Multisine], tuple[Array, Array]] | None = None
    modelled: Callable[..., Array] | None = None
    n_plant: int | None = None

    @property
    def n_q(self) -> int:
        """Coordinates of the plant."""
        return self.n_plant or self.model.n_q

    @property
    def n_v(self) -> int:
        """Velocities of the plant."""
        return self.n_plant or self.model.n_v

    def drawn(self, rngs: Sequence[np.random.Generator]) -> SimpleNamespace:
        """Parameters of each seed, (L,) each."""
        width = np.log(SPREAD)
        factors = _lanes(rngs, lambda rng: np.exp(rng.uniform(-width, width, len(self.base))))
        return SimpleNamespace(**{name: x * factors[i] for i, (name, x) in enumerate(self.base.items())})


def _unknown(units: Mapping[str, str], positive: str) -> dict[str, dr.Parameter]:
    """Parameters, those of `positive` above 0, the others not below."""
    above = positive.split()
    return {
        name: dr.Parameter(unit, positive=True) if name in above else dr.Parameter(unit, lower=0.0)
        for name, unit in units.items()
    }


def _solved(m11: Array, m12: Array, m22: Array, f1: Array, f2: Array) -> Array:
    """Accelerations of two coordinates from a symmetric mass matrix and forces."""
    determinant = m11 * m22 - m12 * m12
    return np.stack([(m22 * f1 - m12 * f2) / determinant, (m11 * f2 - m12 * f1) / determinant])


# ---------------------------------------------------------------------- planar rotorcraft

_ARM = 0.21


def _rotor_accelerations(q: Array, v: Array, u: Array, p: SimpleNamespace, f: Array) -> Array:
    (_, _, theta), (vx, vz, _), (thrust, moment) = q, v, u
    sin, cos, drag = np.sin(theta), np.cos(theta), p.drag * np.abs(thrust)
    return np.stack(
        [
            (-thrust * sin - drag * vx * cos + f[0]) / p.mass,
            (thrust * cos - drag * vz * sin + f[1]) / p.mass - G,
            (_ARM * moment + f[2]) / p.inertia,
        ]
    )


def _rotor_control(t: float, q: Array, v: Array, r: Multisine, p: SimpleNamespace) -> Array:
    wanted = r(t, 2) + 4.0 * (r(t) - q[:2]) + 3.2 * (r(t, 1) - v[:2])
    ax, az = np.clip(wanted[0], -6.0, 6.0), np.clip(wanted[1], -6.0, 8.0) + G
    tilt = np.clip(np.arctan2(-ax, az) - q[2], -1.0, 1.0)
    moment = p.inertia / _ARM * (35.0 * tilt - 9.5 * v[2])
    return np.stack([np.clip(p.mass * np.hypot(ax, az), 0.5, 40.0), np.clip(moment, -4.0, 4.0)])


ROTOR = Machine(
    "rotorcraft",
    dr.models.planar_rotorcraft(arm_length=_ARM),
    {"mass": 0.92, "inertia": 0.0085, "drag": 0.055},
    _rotor_accelerations,
    lambda rngs: Multisine(rngs, (0.9, 0.6), 0.08, 0.5, 5),
    _rotor_control,
    {"x": 0.002, "z": 0.002, "theta": 0.005, "theta_dot": 0.02, "x_ddot": 0.25, "z_ddot": 0.25},
    dt=0.01, duration=20.0, substeps=5, bandwidth=5.0,
    on_reference=lambda r: (np.concatenate([r(0.0), 0.0 * r(0.0)[:1]]), np.concatenate([r(0.0, 1), 0.0 * r(0.0)[:1]])),
)  # fmt: skip


# ---------------------------------------------------------------------- quadrotor in Euler angles


def _rotation(m: Any, phi: Any, theta: Any, psi: Any) -> list[list[Any]]:
    """Rows of the body-to-world matrix ``Rz Ry Rx``; m is numpy or casadi."""
    cf, sf, ct, st, cp, sp = m.cos(phi), m.sin(phi), m.cos(theta), m.sin(theta), m.cos(psi), m.sin(psi)
    return [
        [cp * ct, cp * st * sf - sp * cf, cp * st * cf + sp * sf],
        [sp * ct, sp * st * sf + cp * cf, sp * st * cf - cp * sf],
        [-st, ct * sf, ct * cf],
    ]


def _euler_rates(m: Any, phi: Any, theta: Any, wx: Any, wy: Any, wz: Any) -> list[Any]:
    turning = m.sin(phi) * wy + m.cos(phi) * wz
    return [wx + turning * m.tan(theta), m.cos(phi) * wy - m.sin(phi) * wz, turning / m.cos(theta)]


def _aerodynamic_force(rows: list[list[Any]], velocity: list[Any], thrust: Any, p: Any) -> list[Any]:
    """Thrust and linear drag, body axes with coefficients dxy and dz, in the world frame."""
    in_body = [sum(rows[i][j] * velocity[i] for i in range(3)) for j in range(3)]
    force = [-p.dxy * in_body[0], -p.dxy * in_body[1], thrust - p.dz * in_body[2]]
    return [sum(rows[i][j] * force[j] for j in range(3)) for i in range(3)]


def _quad_model() -> dr.Model:
    def equations(q: Any, v: Any, a: Any, u: Any, p: Any) -> list[Any]:
        F = _aerodynamic_force(_rotation(ca, q.phi, q.theta, q.psi), [v.vx, v.vy, v.vz], u.thrust, p)
        return [
            p.m * a.vx - F[0],
            p.m * a.vy - F[1],
            p.m * (a.vz + G) - F[2],
            p.Jx * a.wx + (p.Jz - p.Jy) * v.wy * v.wz - u.tx,
            p.Jy * a.wy + (p.Jx - p.Jz) * v.wx * v.wz - u.ty,
            p.Jz * a.wz + (p.Jy - p.Jx) * v.wx * v.wy - u.tz,
        ]

    return dr.Model(
        "quadrotor",
        {"x": "m", "y": "m", "z": "m", "phi": "rad", "theta": "rad", "psi": "rad"},
        {"thrust": "N", "tx": "N m", "ty": "N m", "tz": "N m"},
        _unknown(
            {"m": "kg", "Jx": "kg m^2", "Jy": "kg m^2", "Jz": "kg m^2", "dxy": "N s/m", "dz": "N s/m"}, "m Jx Jy Jz"
        ),
        equations,
        velocities={"vx": "m/s", "vy": "m/s", "vz": "m/s", "wx": "rad/s", "wy": "rad/s", "wz": "rad/s"},
        kinematics=lambda q, v: [v.vx, v.vy, v.vz, *_euler_rates(ca, q.phi, q.theta, v.wx, v.wy, v.wz)],
    )


def _quad_accelerations(q: Array, v: Array, u: Array, p: SimpleNamespace, f: Array) -> Array:
    (wx, wy, wz), (thrust, tx, ty, tz) = v[3:], u
    F = _aerodynamic_force(_rotation(np, *q[3:]), list(v[:3]), thrust, p)
    return np.stack(
        [
            (F[0] + f[0]) / p.m,
            (F[1] + f[1]) / p.m,
            (F[2] + f[2]) / p.m - G,
            (tx - (p.Jz - p.Jy) * wy * wz + f[3]) / p.Jx,
            (ty - (p.Jx - p.Jz) * wx * wz + f[4]) / p.Jy,
            (tz - (p.Jy - p.Jx) * wx * wy + f[5]) / p.Jz,
        ]
    )


def _quad_control(t: float, q: Array, v: Array, r: Multisine, p: SimpleNamespace) -> Array:
    position, speed, wanted = r(t)[:3], r(t, 1)[:3], r(t, 2)[:3]
    wanted = np.clip(wanted + 4.5 * (position - q[:3]) + 3.4 * (speed - v[:3]), -5.0, 5.0)
    wanted[2] += G
    size = np.linalg.norm(wanted, axis=0)
    cos, sin = np.cos(q[5]), np.sin(q[5])
    forward, left = cos * wanted[0] + sin * wanted[1], -sin * wanted[0] + cos * wanted[1]
    theta, phi = np.arctan2(forward, wanted[2]), np.arctan2(-left, np.hypot(forward, wanted[2]))
    tx, ty = p.Jx * (60.0 * (phi - q[3]) - 12.0 * v[3]), p.Jy * (60.0 * (theta - q[4]) - 12.0 * v[4])
    return np.stack([p.m * size, tx, ty, p.Jz * (12.0 * (r(t)[3] - q[5]) - 5.0 * v[5])])


def _quad_start(r: Multisine) -> tuple[Array, Array]:
    zero = 0.0 * r(0.0)[:3]
    return np.concatenate([r(0.0)[:3], zero]), np.concatenate([r(0.0, 1)[:3], zero])


QUAD = Machine(
    "quadrotor",
    _quad_model(),
    {"m": 1.45, "Jx": 0.015, "Jy": 0.018, "Jz": 0.03, "dxy": 0.32, "dz": 0.5},
    _quad_accelerations,
    lambda rngs: Multisine(rngs, (1.1, 1.1, 0.5, 0.5), 0.08, 0.45, 5),
    _quad_control,
    {**dict.fromkeys(("x", "y", "z"), 0.002), **dict.fromkeys(("phi", "theta", "psi"), 0.005)}
    | dict.fromkeys(("vx", "vy", "vz", "wx", "wy", "wz"), 0.02),
    dt=0.01, duration=20.0, substeps=4, bandwidth=5.0,
    kinematics=lambda q, v: np.concatenate([v[:3], np.stack(_euler_rates(np, q[3], q[4], *v[3:]))]),
    on_reference=_quad_start,
)  # fmt: skip


# ---------------------------------------------------------------------- single-track car

_CAR_MASS, _FRONT, _REAR = 1280.0, 1.05, 1.42


def _car_model() -> dr.Model:
    def equations(q: Any, v: Any, a: Any, u: Any, p: Any) -> list[Any]:  # noqa: ARG001
        front = p.Cf * (u.steering - (v.lateral + _FRONT * v.yaw) / u.speed)
        rear = -p.Cr * (v.lateral - _REAR * v.yaw) / u.speed
        return [
            _CAR_MASS * (a.lateral + u.speed * v.yaw) - front - rear,
            p.Iz * a.yaw - _FRONT * front + _REAR * rear,
        ]

    units = {"Iz": "kg m^2", "Cf": "N/rad", "Cr": "N/rad"}
    inputs = {"steering": "rad", "speed": "m/s"}
    return dr.Model("car", {"lateral": "m", "yaw": "rad"}, inputs, _unknown(units, "Iz Cf Cr"), equations)


def _car_accelerations(q: Array, v: Array, u: Array, p: SimpleNamespace, f: Array) -> Array:  # noqa: ARG001
    front = p.Cf * (u[0] - (v[0] + _FRONT * v[1]) / u[1])
    rear = -p.Cr * (v[0] - _REAR * v[1]) / u[1]
    return np.stack([(front + rear + f[0]) / _CAR_MASS - u[1] * v[1], (_FRONT * front - _REAR * rear + f[1]) / p.Iz])


def _car_control(t: float, q: Array, v: Array, r: Multisine, p: SimpleNamespace) -> Array:  # noqa: ARG001
    steering, speed = r(t)
    return np.stack([steering, 19.0 + 2.0 * np.tanh(speed)])


CAR = Machine(
    "car",
    _car_model(),
    {"Iz": 2000.0, "Cf": 70e3, "Cr": 92e3},
    _car_accelerations,
    lambda rngs: Multisine(rngs, (0.02, 1.0), 0.1, 1.2, 7),
    _car_control,
    {"yaw": 0.003, "yaw_dot": 0.005, "lateral_dot": 0.02, "lateral_ddot": 0.1},
    dt=0.02, duration=25.0, substeps=4, bandwidth=2.5,
)  # fmt: skip


# ---------------------------------------------------------------------- flexible joint


def _joint_model() -> dr.Model:
    def equations(q: Any, v: Any, a: Any, u: Any, p: Any) -> list[Any]:
        spring = p.k * (q.motor - q.load) + p.d * (v.motor - v.load)
        return [p.Jm * a.motor + p.bm * v.motor + spring - u.torque, p.Jl * a.load + p.bl * v.load - spring]

    units = {"Jm": "kg m^2", "Jl": "kg m^2", "k": "N m/rad", "d": "N m s/rad", "bm": "N m s/rad", "bl": "N m s/rad"}
    coordinates = {"motor": "rad", "load": "rad"}
    return dr.Model("flexible-joint", coordinates, {"torque": "N m"}, _unknown(units, "Jm Jl k"), equations)


def _joint_accelerations(q: Array, v: Array, u: Array, p: SimpleNamespace, f: Array) -> Array:
    spring = p.k * (q[0] - q[1]) + p.d * (v[0] - v[1])
    return np.stack([(u[0] - p.bm * v[0] - spring + f[0]) / p.Jm, (spring - p.bl * v[1] + f[1]) / p.Jl])


def _joint_control(t: float, q: Array, v: Array, r: Multisine, p: SimpleNamespace) -> Array:  # noqa: ARG001
    return r(t) - 0.8 * q[:1] - 0.15 * v[:1]


JOINT = Machine(
    "flexible joint",
    _joint_model(),
    {"Jm": 0.016, "Jl": 0.085, "k": 75.0, "d": 0.06, "bm": 0.06, "bl": 0.12},
    _joint_accelerations,
    lambda rngs: Multisine(rngs, (0.9,), 0.3, 9.0, 14),
    _joint_control,
    {"motor": 5e-4, "load": 5e-4},
    dt=0.005, duration=10.0, substeps=4, bandwidth=18.0,
)  # fmt: skip


# ---------------------------------------------------------------------- cart-pole, hanging


def _cart_model() -> dr.Model:
    def equations(q: Any, v: Any, a: Any, u: Any, p: Any) -> list[Any]:
        ml = p.m * p.l
        swing = ml * (a.theta * ca.cos(q.theta) - v.theta**2 * ca.sin(q.theta))
        pole = ml * (p.l * a.theta + a.x * ca.cos(q.theta) + G * ca.sin(q.theta))
        return [(p.M + p.m) * a.x + swing + p.b * v.x - u.force, pole + p.c * v.theta]

    units = {"M": "kg", "m": "kg", "l": "m", "b": "N s/m", "c": "N m s/rad"}
    return dr.Model("cart-pole", {"x": "m", "theta": "rad"}, {"force": "N"}, _unknown(units, "M m l"), equations)


def _cart_accelerations(q: Array, v: Array, u: Array, p: SimpleNamespace, f: Array) -> Array:
    return _cart(q, v, u, f, p.M + p.m, p.m * p.l, p.m * p.l**2, p)


def _cart(q: Array, v: Array, u: Array, f: Array, mass: Array, ml: Array, inertia: Array, p: SimpleNamespace) -> Array:
    sin, cos = np.sin(q[1]), np.cos(q[1])
    along = u[0] + ml * v[1] ** 2 * sin - p.b * v[0] + f[0]
    return _solved(mass, ml * cos, inertia, along, -G * ml * sin - p.c * v[1] + f[1])


def _cart_control(t: float, q: Array, v: Array, r: Multisine, p: SimpleNamespace) -> Array:  # noqa: ARG001
    return r(t) - 4.0 * q[:1] - 1.0 * v[:1]


CART = Machine(
    "cart-pole",
    _cart_model(),
    {"M": 1.5, "m": 0.33, "l": 0.5, "b": 1.1, "c": 0.008},
    _cart_accelerations,
    lambda rngs: Multisine(rngs, (4.0,), 0.2, 2.5, 8),
    _cart_control,
    {"x": 5e-4, "theta": 0.0015},
    dt=0.025, duration=20.0, substeps=10, bandwidth=4.0,
)  # fmt: skip


def _viscous_cart_model() -> dr.Model:
    def equations(q: Any, v: Any, a: Any, u: Any, p: Any) -> list[Any]:
        sin, cos = ca.sin(q.theta), ca.cos(q.theta)
        return [
            p.M * a.x + p.ml * (a.theta * cos - v.theta**2 * sin) + p.b * v.x - u.force,
            p.J * a.theta + p.ml * (a.x * cos + G * sin) + p.c * v.theta,
        ]

    units = {"M": "kg", "ml": "kg m", "J": "kg m^2", "b": "N s/m", "c": "N m s/rad"}
    return dr.Model("viscous-cart", {"x": "m", "theta": "rad"}, {"force": "N"}, _unknown(units, "M ml J"), equations)


def _viscous_cart_accelerations(q: Array, v: Array, u: Array, p: SimpleNamespace, f: Array) -> Array:
    return _cart(q, v, u, f, p.M, p.ml, p.J, p)


def steps(t: float, q: Array, v: Array, r: Multisine, p: SimpleNamespace) -> Array:  # noqa: ARG001
    """Steps of 5 N at the reference's changes of sign."""
    return 5.0 * np.sign(r(t))


VISCOUS_CART = Machine(
    "viscous cart-pole",
    _viscous_cart_model(),
    {"M": 1.6, "ml": 0.11, "J": 0.055, "b": 3.6, "c": 0.006},
    _viscous_cart_accelerations,
    lambda rngs: Multisine(rngs, (4.5,), 0.15, 1.0, 5),
    lambda t, q, v, r, p: r(t),
    {"x": 1e-4, "theta": 1e-3},
    dt=0.01, duration=20.0, substeps=4, bandwidth=6.0,
)  # fmt: skip


# ---------------------------------------------------------------------- differential drive with slip

_DRIVE_MASS, _RADIUS, _HALF_TRACK = 9.5, 0.07, 0.17


def _drive_model() -> dr.Model:
    def equations(q: Any, v: Any, a: Any, u: Any, p: Any) -> list[Any]:  # noqa: ARG001
        left = p.ks * (_RADIUS * v.wl - (v.u - _HALF_TRACK * v.r))
        right = p.ks * (_RADIUS * v.wr - (v.u + _HALF_TRACK * v.r))
        return [
            _DRIVE_MASS * a.u - left - right,
            p.Iz * a.r - _HALF_TRACK * (right - left),
            p.Jw * a.wl - p.km * u.Vl + p.f * v.wl + _RADIUS * left,
            p.Jw * a.wr - p.km * u.Vr + p.f * v.wr + _RADIUS * right,
        ]

    return dr.Model(
        "differential-drive",
        {"x": "m", "y": "m", "yaw": "rad"},
        {"Vl": "V", "Vr": "V"},
        _unknown({"Iz": "kg m^2", "ks": "N s/m", "Jw": "kg m^2", "km": "N m/V", "f": "N m s/rad"}, "Iz ks Jw km"),
        equations,
        velocities={"u": "m/s", "r": "rad/s", "wl": "rad/s", "wr": "rad/s"},
        kinematics=lambda q, v: [v.u * ca.cos(q.yaw), v.u * ca.sin(q.yaw), v.r],
    )


def _drive_accelerations(q: Array, v: Array, u: Array, p: SimpleNamespace, f: Array) -> Array:  # noqa: ARG001
    speed, turning, wl, wr = v
    left = p.ks * (_RADIUS * wl - speed + _HALF_TRACK * turning)
    right = p.ks * (_RADIUS * wr - speed - _HALF_TRACK * turning)
    return np.stack(
        [
            (left + right + f[0]) / _DRIVE_MASS,
            (_HALF_TRACK * (right - left) + f[1]) / p.Iz,
            (p.km * u[0] - p.f * wl - _RADIUS * left + f[2]) / p.Jw,
            (p.km * u[1] - p.f * wr - _RADIUS * right + f[3]) / p.Jw,
        ]
    )


DRIVE = Machine(
    "differential drive",
    _drive_model(),
    {"Iz": 0.28, "ks": 50.0, "Jw": 0.016, "km": 0.7, "f": 0.4},
    _drive_accelerations,
    lambda rngs: Multisine(rngs, (3.5, 3.5), 0.05, 1.5, 7),
    lambda t, q, v, r, p: 4.0 + r(t),
    {"x": 0.002, "y": 0.002, "yaw": 0.004, "u": 0.02, "r": 0.02, "wl": 0.1, "wr": 0.1},
    dt=0.02, duration=25.0, substeps=8, bandwidth=3.0,
    kinematics=lambda q, v: np.stack([v[0] * np.cos(q[2]), v[0] * np.sin(q[2]), v[1]]),
)  # fmt: skip


# ---------------------------------------------------------------------- underwater vehicle


def _underwater_accelerations(q: Array, v: Array, u: Array, p: SimpleNamespace, f: Array) -> Array:  # noqa: ARG001
    return (u - p.linear_drag * v - p.quadratic_drag * np.abs(v) * v - p.bias + f) / p.mass


UNDERWATER = Machine(
    "underwater vehicle",
    dr.models.underwater_vehicle(),
    {"mass": 42.0, "linear_drag": 11.0, "quadratic_drag": 38.0, "bias": 1.6},
    _underwater_accelerations,
    lambda rngs: Multisine(rngs, (24.0,), 0.015, 0.3, 8),
    lambda t, q, v, r, p: r(t),
    {"x": 0.02, "x_dot": 0.01},
    dt=0.05, duration=75.0, substeps=2, bandwidth=1.0,
)  # fmt: skip


# ---------------------------------------------------------------------- pendulum, motor, servo axis


def _pendulum_accelerations(q: Array, v: Array, u: Array, p: SimpleNamespace, f: Array) -> Array:
    return (u - p.b * v - p.mgl * np.sin(q) + f) / p.J


PENDULUM = Machine(
    "pendulum",
    dr.Model(
        "pendulum",
        {"q": "rad"},
        {"torque": "N m"},
        _unknown({"J": "kg m^2", "b": "N m s/rad", "mgl": "N m"}, "J mgl"),
        lambda q, v, a, u, p: [p.J * a.q + p.b * v.q + p.mgl * ca.sin(q.q) - u.torque],
    ),
    {"J": 0.08, "b": 0.045, "mgl": 1.9},
    _pendulum_accelerations,
    lambda rngs: Multisine(rngs, (0.4,), 0.1, 2.0, 7),
    lambda t, q, v, r, p: r(t),
    {"q": 2 * np.pi / 4096 / np.sqrt(12.0)},
    dt=0.01, duration=20.0, substeps=6, bandwidth=6.0,
)  # fmt: skip


def _motor_accelerations(q: Array, v: Array, u: Array, p: SimpleNamespace, f: Array) -> Array:  # noqa: ARG001
    return (u - p.b * v - p.fc * np.tanh(v / 0.02) + f) / p.J


def _motor_control(t: float, q: Array, v: Array, r: Multisine, p: SimpleNamespace) -> Array:  # noqa: ARG001
    return 6.0 * (r(t) - q[:1]) + 0.6 * (r(t, 1) - v[:1])


MOTOR = Machine(
    "motor",
    dr.Model(
        "motor",
        {"q": "rad"},
        {"torque": "N m"},
        _unknown({"J": "kg m^2", "b": "N m s/rad", "fc": "N m"}, "J"),
        lambda q, v, a, u, p: [p.J * a.q + p.b * v.q + p.fc * ca.tanh(v.q / 0.02) - u.torque],
    ),
    {"J": 0.042, "b": 0.11, "fc": 0.14},
    _motor_accelerations,
    lambda rngs: Multisine(rngs, (1.0,), 0.1, 2.0, 6),
    _motor_control,
    {"q": 3e-4},
    dt=0.005, duration=12.0, substeps=20, bandwidth=15.0,
)  # fmt: skip

BACKLASH = 0.010
"""Width of the gap between motor and load, rad."""


def _geared_accelerations(q: Array, v: Array, u: Array, p: SimpleNamespace, f: Array) -> Array:  # noqa: ARG001
    """Motor and load of a third and two thirds of inertia and damping, with stiff contact outside of the gap."""
    between = q[0] - q[1]
    depth = np.maximum(np.abs(between) - BACKLASH / 2.0, 0.0)
    contact = np.where(depth > 0.0, 500.0 * depth * np.sign(between) + 0.5 * (v[0] - v[1]), 0.0)
    friction = p.fc * np.tanh(v[0] / 0.02)
    return np.stack(
        [
            (u[0] - p.b / 3.0 * v[0] - friction - contact) / (p.J / 3.0),
            (contact - 2.0 * p.b / 3.0 * v[1]) / (2.0 * p.J / 3.0),
        ]
    )


GEARED_MOTOR = replace(
    MOTOR, accelerations=_geared_accelerations, modelled=_motor_accelerations, substeps=40, n_plant=2
)
"""The motor with its load behind backlash: the model has the motor's angle alone."""


def _servo_model() -> dr.Model:
    def equations(q: Any, v: Any, a: Any, u: Any, p: Any) -> list[Any]:  # noqa: ARG001
        return [p.mass * a.s + p.viscous * v.s + p.dry * ca.tanh(v.s / 0.003) + p.offset - u.force]

    known = _unknown({"mass": "kg", "viscous": "N s/m", "dry": "N"}, "mass")
    return dr.Model("servo", {"s": "m"}, {"force": "N"}, known | {"offset": dr.Parameter("N")}, equations)


def _servo_accelerations(q: Array, v: Array, u: Array, p: SimpleNamespace, f: Array) -> Array:  # noqa: ARG001
    return (u - p.viscous * v - p.dry * np.tanh(v / 0.003) - p.offset + f) / p.mass


def _servo_control(t: float, q: Array, v: Array, r: Multisine, p: SimpleNamespace) -> Array:
    return p.mass * (r(t, 2) + 100.0 * (r(t) - q) + 20.0 * (r(t, 1) - v))


SERVO = Machine(
    "servo axis",
    _servo_model(),
    {"mass": 70.0, "viscous": 150.0, "dry": 16.0, "offset": -4.0},
    _servo_accelerations,
    lambda rngs: Multisine(rngs, (0.08,), 0.1, 0.8, 5),
    _servo_control,
    {"s": 2e-5},
    dt=0.01, duration=20.0, substeps=6, bandwidth=6.0,
    on_reference=lambda r: (r(0.0), r(0.0, 1)),
)  # fmt: skip


# ---------------------------------------------------------------------- two-link arm

_LINK = 0.4


def _arm_model() -> dr.Model:
    def equations(q: Any, v: Any, a: Any, u: Any, p: Any) -> list[Any]:
        h, sin, cos = _LINK * p.h2, ca.sin(q.q2), ca.cos(q.q2)
        coupling, outer = p.a2 + h * cos, G * p.h2 * ca.sin(q.q1 + q.q2)
        return [
            (p.a1 + p.a2 + 2.0 * h * cos) * a.q1 + coupling * a.q2 - h * sin * (2.0 * v.q1 + v.q2) * v.q2
            + G * p.h1 * ca.sin(q.q1) + outer + p.fv1 * v.q1 + p.fc1 * ca.tanh(v.q1 / 0.01) - u.t1,
            coupling * a.q1 + p.a2 * a.q2 + h * sin * v.q1**2
            + outer + p.fv2 * v.q2 + p.fc2 * ca.tanh(v.q2 / 0.01) - u.t2,
        ]  # fmt: skip

    units = {"a1": "kg m^2", "a2": "kg m^2", "h1": "kg m", "h2": "kg m"}
    friction = {"fv1": "N m s/rad", "fc1": "N m", "fv2": "N m s/rad", "fc2": "N m"}
    known = _unknown(units | friction, "a1 a2 h1 h2")
    return dr.Model("arm", {"q1": "rad", "q2": "rad"}, {"t1": "N m", "t2": "N m"}, known, equations)


def _arm_accelerations(q: Array, v: Array, u: Array, p: SimpleNamespace, f: Array) -> Array:
    h, sin, cos = _LINK * p.h2, np.sin(q[1]), np.cos(q[1])
    outer = G * p.h2 * np.sin(q[0] + q[1])
    first = u[0] + h * sin * (2.0 * v[0] + v[1]) * v[1] - G * p.h1 * np.sin(q[0]) - outer
    second = u[1] - h * sin * v[0] ** 2 - outer
    first = first - p.fv1 * v[0] - p.fc1 * np.tanh(v[0] / 0.01) + f[0]
    second = second - p.fv2 * v[1] - p.fc2 * np.tanh(v[1] / 0.01) + f[1]
    return _solved(p.a1 + p.a2 + 2.0 * h * cos, p.a2 + h * cos, p.a2, first, second)


def _arm_control(t: float, q: Array, v: Array, r: Multisine, p: SimpleNamespace) -> Array:
    outer = G * p.h2 * np.sin(q[0] + q[1])
    gravity = np.stack([G * p.h1 * np.sin(q[0]) + outer, outer])
    gain = np.stack([p.a1 + p.a2, p.a2])
    return gravity + gain * (120.0 * (r(t) - q) + 18.0 * (r(t, 1) - v))


ARM = Machine(
    "arm",
    _arm_model(),
    {"a1": 0.55, "a2": 0.19, "h1": 1.7, "h2": 0.42, "fv1": 0.75, "fc1": 0.8, "fv2": 0.3, "fc2": 0.35},
    _arm_accelerations,
    lambda rngs: Multisine(rngs, (0.6, 0.6), 0.1, 1.0, 5),
    _arm_control,
    {"q1": 1e-4, "q2": 1e-4},
    dt=0.005, duration=12.5, substeps=10, bandwidth=10.0,
    on_reference=lambda r: (r(0.0), r(0.0, 1)),
)  # fmt: skip
