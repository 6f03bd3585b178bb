"""Cart-pole: a pole that swings freely on a driven cart."""

from casadi import cos, sin

from diransac.model.derivation import Symbols
from diransac.model.model import Model
from diransac.model.parameter import Parameter

__all__ = ["cart_pole"]


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
