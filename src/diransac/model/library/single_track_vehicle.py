"""Single-track vehicle with linear tyres (bicycle model)."""

from diransac.model.derivation import Symbols
from diransac.model.model import Model
from diransac.model.parameter import Parameter
from diransac.model.sensors import Sensor

__all__ = ["single_track_vehicle"]


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
