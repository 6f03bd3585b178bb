"""Pendulums: on a cart, and of two links with a motor at each joint."""

from casadi import atan, cos, sin

from diransac.model.derivation import Symbols
from diransac.model.model import Model
from diransac.model.parameter import Parameter


def cart_pole(gravity: float = 9.81, upright: bool = False) -> Model:
    """Model of a pole that swings freely on a driven cart, in five base parameters.

    ``m x'' + h (theta'' cos(theta) - theta'^2 sin(theta)) + b x' = F``
    ``J theta'' + h (x'' cos(theta) + g sin(theta)) + c theta' = 0``

    Parameters
    ----------
    gravity : float
        g, m/s^2.
    upright : bool
        The angle is zero where the pole stands upright, instead of where it hangs: cos and sin change sign.

    Returns
    -------
    Model
        Coordinates x (m) of the cart and theta (rad) of the pole, counterclockwise where x points to the right. Input
        force F on the cart, N. Parameters mass m of cart and pole (kg), moment h = m_pole l (kg m), inertia
        J = I_pole + m_pole l^2 about the pivot (kg m^2), cart_friction b (N s/m), pole_friction c (N m s/rad), with the
        distance l from the pivot to the pole's centre of gravity. The masses and l are not identifiable separately.

    References
    ----------
    Åström and Murray 2008, "Feedback Systems", Example 2.1 (balance systems), with the angle from upright.
    """
    sense = -1.0 if upright else 1.0

    def equations(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        hc, hs = sense * p.moment * cos(q.theta), sense * p.moment * sin(q.theta)
        return [
            p.mass * a.x + hc * a.theta - hs * v.theta**2 + p.cart_friction * v.x - u.force,
            p.inertia * a.theta + hc * a.x + gravity * hs + p.pole_friction * v.theta,
        ]

    return Model(
        name="cart-pole",
        description="a pole that swings freely on a driven cart, with viscous friction of both",
        coordinates={"x": "m", "theta": "rad"},
        inputs={"force": "N"},
        parameters={
            "mass": Parameter("kg", positive=True),
            "moment": Parameter("kg m", positive=True),
            "inertia": Parameter("kg m^2", positive=True),
            "cart_friction": Parameter("N s/m", lower=0.0),
            "pole_friction": Parameter("N m s/rad", lower=0.0),
        },
        equations=equations,
    )


def double_pendulum(
    upper_length: float = 0.3, gravity: float = 9.81, gear_ratio: float = 6.0, friction_steepness: float = 100.0
) -> Model:
    """Model ``M(q) q'' + c(q, q') + g(q) + f(q') = tau`` in nine base parameters.

    ``M11 = J1 + I2 + 2 l1 h2 cos q2 + (n^2 + 1) Ir``, ``M12 = I2 + l1 h2 cos q2 - n Ir``, ``M22 = I2 + n^2 Ir``
    ``M11 q1'' + M12 q2'' - l1 h2 sin q2 (2 q1' + q2') q2' + g h1 sin q1 + g h2 sin(q1 + q2) + f1 = tau1``
    ``M12 q1'' + M22 q2'' + l1 h2 sin q2 q1'^2 + g h2 sin(q1 + q2) + f2 = tau2``
    ``fi = bi qi' + cfi atan(k qi')``

    Parameters
    ----------
    upper_length : float
        l1, length of the upper link, m.
    gravity : float
        g, m/s^2.
    gear_ratio : float
        n; the rotor inertia Ir acts n^2-fold at its own joint and, through the belt, across both.
    friction_steepness : float
        k, s/rad, of the dry friction ``cf atan(k q')``.

    Returns
    -------
    Model
        Coordinates q1 (0 hanging) and q2 (relative to the upper link), rad. Inputs torque1, torque2 at the joints, N m.
        Parameters inertia1 J1 = I1 + m2 l1^2, moment1 h1 = m1 r1 + m2 l1, inertia2 I2, moment2 h2 = m2 r2,
        rotor_inertia Ir, viscous friction b1, b2 (N m s/rad) and dry friction cf1, cf2 (N m). Masses and I1 are not
        identifiable separately.

    References
    ----------
    Wiebe et al. 2022, "Torque-limited simple/double pendulum: an open source reference platform" (DFKI), equations of
    motion; Gautier and Khalil 1990 for base parameters.
    """

    def equations(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        coupling = upper_length * p.moment2 * cos(q.q2)
        centrifugal = upper_length * p.moment2 * sin(q.q2)
        M11 = p.inertia1 + p.inertia2 + 2 * coupling + (gear_ratio**2 + 1) * p.rotor_inertia
        M12 = p.inertia2 + coupling - gear_ratio * p.rotor_inertia
        M22 = p.inertia2 + gear_ratio**2 * p.rotor_inertia
        g2 = gravity * p.moment2 * sin(q.q1 + q.q2)
        g1 = gravity * p.moment1 * sin(q.q1) + g2
        c1 = -centrifugal * (2 * v.q1 + v.q2) * v.q2
        f1 = p.viscous_friction1 * v.q1 + p.dry_friction1 * atan(friction_steepness * v.q1)
        f2 = p.viscous_friction2 * v.q2 + p.dry_friction2 * atan(friction_steepness * v.q2)
        return [
            M11 * a.q1 + M12 * a.q2 + c1 + g1 + f1 - u.torque1,
            M12 * a.q1 + M22 * a.q2 + centrifugal * v.q1**2 + g2 + f2 - u.torque2,
        ]

    return Model(
        name="double-pendulum",
        description="two links with a motor at each joint, viscous and dry friction",
        coordinates={"q1": "rad", "q2": "rad"},
        inputs={"torque1": "N m", "torque2": "N m"},
        parameters={
            "inertia1": Parameter("kg m^2", positive=True),
            "moment1": Parameter("kg m", positive=True),
            "inertia2": Parameter("kg m^2", positive=True),
            "moment2": Parameter("kg m", positive=True),
            "rotor_inertia": Parameter("kg m^2", lower=0.0),
            "viscous_friction1": Parameter("N m s/rad", lower=0.0),
            "dry_friction1": Parameter("N m", lower=0.0),
            "viscous_friction2": Parameter("N m s/rad", lower=0.0),
            "dry_friction2": Parameter("N m", lower=0.0),
        },
        equations=equations,
    )
