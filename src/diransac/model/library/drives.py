"""Drives: a linear servo axis, a direct-current motor, and a motor behind a spring."""

from casadi import sign, sin

from diransac.model.derivation import Symbols
from diransac.model.model import Model
from diransac.model.parameter import Parameter


def servo_axis() -> Model:
    """Model ``M q'' + Fv q' + Fc sign(q') + F0 = F`` of a linear axis with viscous and dry friction.

    Returns
    -------
    Model
        Coordinate position q (m), input force F (N). Parameters mass M (kg), viscous friction Fv (N s/m), dry (Coulomb)
        friction Fc (N) and offset F0 (N: gravity, cable pull, amplifier offset).

    References
    ----------
    Janot, Gautier, Brunot 2019, "Data set and reference models of EMPS", eq. (1).
    """

    def equations(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        friction = p.viscous_friction * v.position + p.dry_friction * sign(v.position)
        return [p.mass * a.position + friction + p.offset - u.force]

    return Model(
        name="servo-axis",
        description="a linear axis with viscous and dry friction and a constant offset force",
        coordinates={"position": "m"},
        inputs={"force": "N"},
        parameters={
            "mass": Parameter("kg", positive=True),
            "viscous_friction": Parameter("N s/m", lower=0.0),
            "dry_friction": Parameter("N", lower=0.0),
            "offset": Parameter("N"),
        },
        equations=equations,
    )


def dc_motor(neglect_inductance: bool = False) -> Model:
    """Model of a permanent-magnet direct-current motor driven by its voltage.

    ``J theta'' + b theta' = k i``
    ``L i' + R i + k theta' = V``

    Without inductance, ``i = (V - k theta') / R``, and two combinations remain identifiable from angle and voltage:
    ``tau theta'' + theta' = K V``, ``K = k / (k^2 + b R)``, ``tau = J R / (k^2 + b R)``.

    Parameters
    ----------
    neglect_inductance : bool
        The model without current, for an electrical time constant L / R that is short compared with the sample time.

    Returns
    -------
    Model
        Coordinate angle theta (rad), state of first order current i (A), input voltage V (V). Parameters inertia J
        (kg m^2), viscous_friction b (N m s/rad), torque_constant k (N m/A, equal to the back-EMF constant in V s/rad),
        resistance R (ohm), inductance L (H). Where the current is not measured, two of the five must be fixed, such
        as resistance and inductance. Without inductance: parameters gain K (rad/(V s)) and time_constant tau (s).

    References
    ----------
    Franklin, Powell, Emami-Naeini, "Feedback Control of Dynamic Systems", section 2.3 (electromechanical systems).
    """
    if neglect_inductance:
        return _first_order_in_speed()

    def equations(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        return [
            p.inertia * a.angle + p.viscous_friction * v.angle - p.torque_constant * v.current,
            p.inductance * a.current + p.resistance * v.current + p.torque_constant * v.angle - u.voltage,
        ]

    return Model(
        name="dc-motor",
        description="a permanent-magnet direct-current motor with inductance and viscous friction",
        coordinates={"angle": "rad"},
        first_order={"current": "A"},
        inputs={"voltage": "V"},
        parameters={
            "inertia": Parameter("kg m^2", positive=True),
            "viscous_friction": Parameter("N m s/rad", lower=0.0),
            "torque_constant": Parameter("N m/A", positive=True),
            "resistance": Parameter("ohm", positive=True),
            "inductance": Parameter("H", positive=True),
        },
        equations=equations,
    )


def _first_order_in_speed() -> Model:
    """Motor without inductance: ``tau theta'' + theta' = K V``."""

    def equations(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        return [p.time_constant * a.angle + v.angle - p.gain * u.voltage]

    return Model(
        name="dc-motor",
        description="a permanent-magnet direct-current motor without inductance",
        coordinates={"angle": "rad"},
        inputs={"voltage": "V"},
        parameters={
            "gain": Parameter("rad/(V s)", positive=True),
            "time_constant": Parameter("s", positive=True),
        },
        equations=equations,
    )


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
