"""Quadrotor, or any other multirotor with parallel rotors, in six degrees of freedom."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite, sqrt

from casadi import SX

from diransac.errors import ModelError
from diransac.model.derivation import Symbols
from diransac.model.model import Model
from diransac.model.parameter import Parameter
from diransac.model.sensors import accelerometer, gyroscope

Rotor = tuple[float, float, int]

_AXES, _ATTITUDE = ("x", "y", "z"), ("qw", "qx", "qy", "qz")
_VELOCITY, _RATES = ("vx", "vy", "vz"), ("wx", "wy", "wz")


def quadrotor(
    rotors: str | Sequence[Rotor] = "x",
    arm_length: float = 0.12,
    *,
    speed_unit: str = "rad/s",
    motor_lag: bool = False,
    imu: bool = False,
    gravity: float = 9.81,
) -> Model:
    """Model of a rigid body with rotors along its z axis, with rotor drag, and optionally motor lag and an IMU.

    ``m (v' + g e_z) = T e_B - d (v - (v . e_B) e_B)``, ``T = k_T sum(n_i^2)``
    ``J w' + w x J w = sum([y_i k_T n_i^2, -x_i k_T n_i^2, -s_i k_Q n_i^2])``
    ``tau n_i' + n_i = u_i``; without lag ``n_i = u_i``

    Parameters
    ----------
    rotors : "x", "+" or sequence of (x_i, y_i, s_i)
        Layout. A sequence has each rotor's position in the body frame (x forward, y left) from the centre of gravity,
        m, and its direction: 1 counterclockwise, -1 clockwise, seen from above. The order of the two named layouts is
        PX4's: "x" front right (1), rear left (1), front left (-1), rear right (-1); "+" right (1), left (1), front
        (-1), rear (-1).
    arm_length : float
        Distance of the rotors of a named layout from the centre of gravity, m.
    speed_unit : str
        Unit of the inputs, which are proportional to the speeds of the rotors: "rad/s", "rpm", or "1" for a throttle.
    motor_lag : bool
        Whether the speeds follow the inputs with a common time constant, as states of first order.
    imu : bool
        Whether columns acc_x, acc_y, acc_z (m/s^2) and gyro_x, gyro_y, gyro_z (rad/s) of a log are those of an
        accelerometer in the centre of gravity and of a gyroscope, along the axes of the body, each with a bias.
    gravity : float
        g, m/s^2.

    Returns
    -------
    Model
        Coordinates x, y, z (m, world frame, z up) and the unit quaternion qw, qx, qy, qz from body to world frame;
        velocities vx, vy, vz (m/s, world frame) and wx, wy, wz (rad/s, body frame). Inputs motor1, motor2, ...: speeds
        of the rotors, or with lag their commands, and states of first order speed1, speed2, ... Parameters mass m (kg),
        inertia_x, inertia_y, inertia_z (kg m^2, principal axes), thrust_coefficient k_T and torque_coefficient k_Q
        (N and N m per square of the speed), drag d of the rotors in their plane (N s/m), motor_time_constant tau (s),
        acc_bias_x, ..., gyro_bias_x, ... of the IMU. Mass, inertias, coefficients and drag are proportional, and only
        their ratios are identifiable: fix one, such as the mass.

    Raises
    ------
    ModelError
        There is no such layout, or a rotor has no finite position or no direction.

    References
    ----------
    Mahony, Kumar, Corke 2012, "Multirotor aerial vehicles", IEEE Robotics and Automation Magazine 19(3), equations of
    motion; Faessler, Franchi, Scaramuzza 2018, "Differential flatness of quadrotor dynamics subject to rotor drag",
    IEEE Robotics and Automation Letters 3(2), rotor drag.
    """
    layout = _layout(rotors, arm_length)
    names = [f"motor{i + 1}" for i in range(len(layout))]
    states = [f"speed{i + 1}" for i in range(len(layout))] if motor_lag else []

    down = (0.0, 0.0, -gravity)
    imu_sensors = (
        accelerometer(_VELOCITY, _ATTITUDE, gravity=down, axes=_AXES) | gyroscope(_RATES, axes=_AXES) if imu else None
    )

    def equations(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        squares = [v[n] ** 2 for n in states] if motor_lag else [u[n] ** 2 for n in names]
        lag = [p.motor_time_constant * a[n] + v[n] - u[command] for n, command in zip(states, names, strict=False)]
        return [*_forces(q, v, a, p, squares, gravity), *_moments(v, a, p, squares, layout), *lag]

    return Model(
        name="quadrotor",
        description="a rigid body with parallel rotors, as a unit quaternion, with rotor drag",
        coordinates={**dict.fromkeys(_AXES, "m"), **dict.fromkeys(_ATTITUDE, "1")},
        velocities={**dict.fromkeys(_VELOCITY, "m/s"), **dict.fromkeys(_RATES, "rad/s")},
        kinematics=_kinematics,
        first_order=dict.fromkeys(states, speed_unit),
        inputs=dict.fromkeys(names, speed_unit),
        parameters=_parameters(speed_unit, motor_lag),
        equations=equations,
        sensors=imu_sensors,
    )


def _layout(rotors: str | Sequence[Rotor], arm_length: float) -> tuple[Rotor, ...]:
    """Position, m, and direction of each rotor."""
    if isinstance(rotors, str):
        if rotors not in ("x", "+"):
            raise ModelError(f'rotors = {rotors!r}; choose "x", "+", or a sequence of (x, y, direction)')
        # In PX4's order of motors.
        corners, arms = ((1, -1), (-1, 1), (1, 1), (-1, -1)), ((0, -1), (0, 1), (1, 0), (-1, 0))
        places, scale = (corners, 1.0 / sqrt(2.0)) if rotors == "x" else (arms, 1.0)
        return tuple(
            (arm_length * (scale * x), arm_length * (scale * y), spin)
            for (x, y), spin in zip(places, (1, 1, -1, -1), strict=True)
        )
    for rotor in rotors:
        x, y, spin = rotor
        if not (isfinite(x) and isfinite(y)) or spin not in (1, -1):
            raise ModelError(
                f"rotor {rotor!r}; give its position x, y in m and its direction, 1 counterclockwise or -1 clockwise "
                "seen from above"
            )
    return tuple(rotors)


def _parameters(speed_unit: str, motor_lag: bool) -> dict[str, Parameter]:
    """Parameters by name."""
    squared = "" if speed_unit == "1" else f"/({speed_unit})^2"
    positive = {"mass": "kg", **dict.fromkeys(("inertia_x", "inertia_y", "inertia_z"), "kg m^2")}
    positive |= {"thrust_coefficient": f"N{squared}", "torque_coefficient": f"N m{squared}"}
    positive |= {"motor_time_constant": "s"} if motor_lag else {}
    return {n: Parameter(unit, positive=True) for n, unit in positive.items()} | {"drag": Parameter("N s/m", lower=0.0)}


def _kinematics(q: Symbols, v: Symbols) -> list[object]:
    """Velocity, and ``q' = q o (0, w) / 2`` with w in the body frame."""
    return [
        v.vx,
        v.vy,
        v.vz,
        0.5 * (-q.qx * v.wx - q.qy * v.wy - q.qz * v.wz),
        0.5 * (q.qw * v.wx + q.qy * v.wz - q.qz * v.wy),
        0.5 * (q.qw * v.wy - q.qx * v.wz + q.qz * v.wx),
        0.5 * (q.qw * v.wz + q.qx * v.wy - q.qy * v.wx),
    ]


def _forces(q: Symbols, v: Symbols, a: Symbols, p: Symbols, squares: list[SX], gravity: float) -> list[object]:
    """Balance of forces in the world frame, from the squared speeds of the rotors."""
    up = 2 * (q.qx * q.qz + q.qw * q.qy), 2 * (q.qy * q.qz - q.qw * q.qx), 1 - 2 * (q.qx**2 + q.qy**2)
    velocity = (v.vx, v.vy, v.vz)
    along = sum(e * x for e, x in zip(up, velocity, strict=True))
    thrust = p.thrust_coefficient * sum(squares)
    return [
        p.mass * (acceleration + g) - thrust * e + p.drag * (x - along * e)
        for acceleration, g, e, x in zip((a.vx, a.vy, a.vz), (0.0, 0.0, gravity), up, velocity, strict=True)
    ]


def _moments(v: Symbols, a: Symbols, p: Symbols, squares: list[SX], layout: tuple[Rotor, ...]) -> list[object]:
    """Balance of moments in the body frame (Euler), from the squared speeds of the rotors."""
    x, y, spin = (sum(rotor[i] * n for rotor, n in zip(layout, squares, strict=True)) for i in range(3))
    return [
        p.inertia_x * a.wx + (p.inertia_z - p.inertia_y) * v.wy * v.wz - p.thrust_coefficient * y,
        p.inertia_y * a.wy + (p.inertia_x - p.inertia_z) * v.wz * v.wx + p.thrust_coefficient * x,
        p.inertia_z * a.wz + (p.inertia_y - p.inertia_x) * v.wx * v.wy + p.torque_coefficient * spin,
    ]
