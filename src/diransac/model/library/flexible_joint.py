"""Flexible joint: a motor that drives a load through a spring."""

from casadi import sin

from diransac.model.derivation import Symbols
from diransac.model.model import Model
from diransac.model.parameter import Parameter

__all__ = ["flexible_joint"]


def flexible_joint(gravity: float = 0.0) -> Model:
    """Model of a motor that drives a load through an elastic transmission.

    ``J_m q_m'' + b_m q_m' + k (q_m - q_l) + d (q_m' - q_l') = T``
    ``J_l q_l'' + b_l q_l' + g h sin(q_l) = k (q_m - q_l) + d (q_m' - q_l')``

    Parameters
    ----------
    gravity : float
        g, m/s^2; 0 for a load that is balanced or turns about a vertical axis, whose h is no parameter.

    Returns
    -------
    Model
        Coordinates motor q_m and load q_l (rad, both behind the gear; with gravity, 0 hanging). Input torque T (N m,
        behind the gear). Parameters motor_inertia J_m and load_inertia J_l (kg m^2), stiffness k (N m/rad), damping d
        of the transmission, motor_friction b_m and load_friction b_l (N m s/rad), and with gravity the load's moment
        h (mass times distance to its centre, kg m).

    References
    ----------
    Spong 1987, "Modeling and control of elastic joint robots", Journal of Dynamic Systems, Measurement, and Control
    109(4), the single link, with damping and friction.
    """

    def equations(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        spring = p.stiffness * (q.motor - q.load) + p.damping * (v.motor - v.load)
        weight = gravity * p.moment * sin(q.load) if gravity else 0.0
        return [
            p.motor_inertia * a.motor + p.motor_friction * v.motor + spring - u.torque,
            p.load_inertia * a.load + p.load_friction * v.load + weight - spring,
        ]

    moment = {"moment": Parameter("kg m", positive=True)} if gravity else {}
    return Model(
        name="flexible-joint",
        description="a motor that drives a load through a spring with damping, with viscous friction of both",
        coordinates={"motor": "rad", "load": "rad"},
        inputs={"torque": "N m"},
        parameters={
            "motor_inertia": Parameter("kg m^2", positive=True),
            "load_inertia": Parameter("kg m^2", positive=True),
            "stiffness": Parameter("N m/rad", positive=True),
            "damping": Parameter("N m s/rad", lower=0.0),
            "motor_friction": Parameter("N m s/rad", lower=0.0),
            "load_friction": Parameter("N m s/rad", lower=0.0),
            **moment,
        },
        equations=equations,
    )
