"""Differential drive: a mobile robot on two driven wheels."""

from casadi import SX, cos, sign, sin

from diransac.errors import ModelError
from diransac.model.derivation import Symbols
from diransac.model.model import Model
from diransac.model.parameter import Parameter
from diransac.model.sensors import Sensor

__all__ = ["differential_drive"]

_SIDES = {"left": -1, "right": 1}
_UNITS = {"torque": "N m", "voltage": "V"}


def differential_drive(wheel_radius: float = 0.05, track: float = 0.3, drive: str = "torque") -> Model:
    """Model of a mobile robot on two driven wheels that roll without slip.

    ``R (m s' - h r^2) = T_left + T_right``
    ``R (J r' + h s r) = (B / 2) (T_right - T_left)``
    ``T_i = k u_i - b w_i - c sign(w_i)``, ``w_i = (s -+ B r / 2) / R``

    Parameters
    ----------
    wheel_radius : float
        R, m.
    track : float
        B, distance between the wheels, m.
    drive : {"torque", "voltage"}
        Inputs u_i: torques of the wheels (N m), k = 1; or voltages of their motors (V), with the parameter k and the
        back EMF in the viscous friction. All other parameters are then proportional to k: fix one, such as the mass.

    Returns
    -------
    Model
        Coordinates x, y (m, midpoint of the axle in the world frame) and yaw (rad); velocities speed s (m/s, forward)
        and yaw_rate r (rad/s). Inputs left_torque and right_torque, or left_voltage and right_voltage. Sensors
        left_wheel and right_wheel, the wheels' angular velocities w_i (rad/s). Parameters mass
        m of the robot with ``2 I_w / R^2`` of its wheels (kg), inertia J about the midpoint of the axle, with
        ``B^2 I_w / (2 R^2)`` of the wheels' rotation about their axle (kg m^2), moment h (kg m), the mass times the
        distance by which its centre is ahead of the axle, viscous_friction b (N m s/rad) and dry_friction c (N m) of
        each wheel, motor_gain k (N m/V).

    Raises
    ------
    ModelError
        There is no such drive.

    References
    ----------
    Dhaouadi and Abu Hatab 2013, "Dynamic Modelling of Differential-Drive Mobile Robots using Lagrange and Newton-Euler
    Methodologies", Advances in Robotics and Automation 2:107, with friction.
    """
    if drive not in _UNITS:
        raise ModelError(f"drive is {drive!r}; choose {' or '.join(_UNITS)}")

    def rate_of(side: str, v: Symbols) -> SX:
        return (v.speed + _SIDES[side] * track / 2 * v.yaw_rate) / wheel_radius

    def equations(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        gain = p.motor_gain if drive == "voltage" else 1.0
        left, right = (
            gain * u[f"{side}_{drive}"]
            - p.viscous_friction * rate_of(side, v)
            - p.dry_friction * sign(rate_of(side, v))
            for side in _SIDES
        )
        return [
            p.mass * a.speed - p.moment * v.yaw_rate**2 - (left + right) / wheel_radius,
            p.inertia * a.yaw_rate + p.moment * v.speed * v.yaw_rate - track / 2 * (right - left) / wheel_radius,
        ]

    gain = {"motor_gain": Parameter("N m/V", positive=True)} if drive == "voltage" else {}
    return Model(
        name="differential-drive",
        description="a mobile robot on two driven wheels without slip, with viscous and dry friction",
        coordinates={"x": "m", "y": "m", "yaw": "rad"},
        velocities={"speed": "m/s", "yaw_rate": "rad/s"},
        kinematics=lambda q, v: [v.speed * cos(q.yaw), v.speed * sin(q.yaw), v.yaw_rate],
        inputs={f"{side}_{drive}": _UNITS[drive] for side in _SIDES},
        parameters={
            "mass": Parameter("kg", positive=True),
            "inertia": Parameter("kg m^2", positive=True),
            "moment": Parameter("kg m"),
            "viscous_friction": Parameter("N m s/rad", lower=0.0),
            "dry_friction": Parameter("N m", lower=0.0),
            **gain,
        },
        equations=equations,
        sensors={
            f"{side}_wheel": Sensor("rad/s", lambda q, v, a, u, p, side=side: rate_of(side, v)) for side in _SIDES
        },
    )
