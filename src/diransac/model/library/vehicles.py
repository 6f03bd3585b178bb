"""Vehicles: under water, a car on linear tyres, and a robot on two driven wheels."""

from casadi import SX, cos, fabs, sign, sin

from diransac.errors import ModelError
from diransac.model.derivation import Symbols
from diransac.model.model import Model
from diransac.model.parameter import Parameter
from diransac.model.sensors import Sensor


def underwater_vehicle() -> Model:
    """Model ``m x'' + d1 x' + d2 |x'| x' + b = T`` of an underwater vehicle in decoupled motion along one axis.

    Returns
    -------
    Model
        Coordinate x (m), input thrust T (N). Parameters effective mass m (rigid body and added mass, kg), linear drag
        d1 (N s/m), quadratic drag d2 (N s^2/m^2) and bias b (N: net buoyancy, tether, thruster offset).

    References
    ----------
    Fossen 2011, "Handbook of Marine Craft Hydrodynamics and Motion Control", section 7.5.
    """

    def equations(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        drag = p.linear_drag * v.x + p.quadratic_drag * fabs(v.x) * v.x
        return [p.mass * a.x + drag + p.bias - u.thrust]

    return Model(
        name="underwater-vehicle",
        description="an underwater vehicle in one degree of freedom with linear and quadratic drag",
        coordinates={"x": "m"},
        inputs={"thrust": "N"},
        parameters={
            "mass": Parameter("kg", positive=True),
            "linear_drag": Parameter("N s/m", lower=0.0),
            "quadratic_drag": Parameter("N s^2/m^2", lower=0.0),
            "bias": Parameter("N"),
        },
        equations=equations,
    )


def single_track_vehicle(front_length: float = 1.2, rear_length: float = 1.5) -> Model:
    """Lateral and yaw dynamics of a car with linear tyres, at a measured speed U (bicycle model).

    ``m (v' + U r) = F_f + F_r``, ``F_f = C_f (delta - (v + l_f r) / U)``
    ``J r' = l_f F_f - l_r F_r``, ``F_r = -C_r (v - l_r r) / U``

    Parameters
    ----------
    front_length, rear_length : float
        l_f and l_r, distances of the axles from the centre of gravity, m.

    Returns
    -------
    Model
        Coordinate yaw (rad, r = yaw_dot); state of first order lateral_velocity v (m/s, of the centre of gravity, to
        the left). Inputs steering delta (rad, of the front wheels, to the left) and speed U (m/s, forward, positive).
        Sensor lateral_acceleration ``v' + U r`` (m/s^2). Parameters mass m (kg), inertia J about the vertical axis
        (kg m^2), front_stiffness C_f and rear_stiffness C_r (cornering stiffnesses of the axles, N/rad). All four are
        proportional: without a measured force only their ratios are identifiable; fix one, such as the mass.

    References
    ----------
    Pacejka 2012, "Tire and Vehicle Dynamics", section 1.3.2; Rajamani 2012, "Vehicle Dynamics and Control", section
    2.3, where stiffnesses are those of a single tyre.
    """

    def equations(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        front = p.front_stiffness * (u.steering - (v.lateral_velocity + front_length * v.yaw) / u.speed)
        rear = -p.rear_stiffness * (v.lateral_velocity - rear_length * v.yaw) / u.speed
        return [
            p.inertia * a.yaw - front_length * front + rear_length * rear,
            p.mass * (a.lateral_velocity + u.speed * v.yaw) - front - rear,
        ]

    return Model(
        name="single-track-vehicle",
        description="lateral and yaw dynamics of a car with linear tyres at a measured speed (bicycle model)",
        coordinates={"yaw": "rad"},
        first_order={"lateral_velocity": "m/s"},
        inputs={"steering": "rad", "speed": "m/s"},
        parameters={
            "mass": Parameter("kg", positive=True),
            "inertia": Parameter("kg m^2", positive=True),
            "front_stiffness": Parameter("N/rad", positive=True),
            "rear_stiffness": Parameter("N/rad", positive=True),
        },
        equations=equations,
        sensors={
            "lateral_acceleration": Sensor("m/s^2", lambda q, v, a, u, p: a.lateral_velocity + u.speed * v.yaw),
        },
    )


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
    sides, units = {"left": -1, "right": 1}, {"torque": "N m", "voltage": "V"}
    if drive not in units:
        raise ModelError(f"drive is {drive!r}; choose {' or '.join(units)}")

    def rate_of(side: str, v: Symbols) -> SX:
        return (v.speed + sides[side] * track / 2 * v.yaw_rate) / wheel_radius

    def equations(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        gain = p.motor_gain if drive == "voltage" else 1.0
        left, right = (
            gain * u[f"{side}_{drive}"]
            - p.viscous_friction * rate_of(side, v)
            - p.dry_friction * sign(rate_of(side, v))
            for side in sides
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
        inputs={f"{side}_{drive}": units[drive] for side in sides},
        parameters={
            "mass": Parameter("kg", positive=True),
            "inertia": Parameter("kg m^2", positive=True),
            "moment": Parameter("kg m"),
            "viscous_friction": Parameter("N m s/rad", lower=0.0),
            "dry_friction": Parameter("N m", lower=0.0),
            **gain,
        },
        equations=equations,
        sensors={f"{side}_wheel": Sensor("rad/s", lambda q, v, a, u, p, side=side: rate_of(side, v)) for side in sides},
    )
