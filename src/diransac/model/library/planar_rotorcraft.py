"""Planar rotorcraft: two rotors in the vertical plane, Dimmig et al. 2023, eq. (4)."""

from casadi import cos, fabs, sin

from diransac.model.derivation import Symbols
from diransac.model.model import Model
from diransac.model.parameter import Parameter

__all__ = ["planar_rotorcraft"]


def planar_rotorcraft(arm_length: float = 0.177, gravity: float = 9.81) -> Model:
    """Model of two rotors in the vertical plane, with induced drag.

    ``m x'' = -T sin(theta) - C |T| x' cos(theta)``
    ``m (z'' + g) = T cos(theta) - C |T| z' sin(theta)``
    ``I theta'' = L M``

    Parameters
    ----------
    arm_length : float
        L, distance of each rotor from the centre of gravity, m (Table I).
    gravity : float
        g, m/s^2.

    Returns
    -------
    Model
        Coordinates x, z (world frame, m) and theta (rad). Inputs thrust T (N, along the body's z axis) and moment M
        (the paper's u_2, multiplied by L in eq. (4): N). Parameters mass m, inertia I, drag C (induced drag, s/m).

    References
    ----------
    Dimmig et al. 2023, eqs. (4) and (5), Table I.
    """

    def equations(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        drag = p.drag * fabs(u.thrust)
        return [
            p.mass * a.x + u.thrust * sin(q.theta) + drag * v.x * cos(q.theta),
            p.mass * (a.z + gravity) - u.thrust * cos(q.theta) + drag * v.z * sin(q.theta),
            p.inertia * a.theta - arm_length * u.moment,
        ]

    return Model(
        name="planar-rotorcraft",
        description="two rotors in the vertical plane with induced drag (Dimmig et al. 2023, eq. (4))",
        coordinates={"x": "m", "z": "m", "theta": "rad"},
        inputs={"thrust": "N", "moment": "N"},
        parameters={
            "mass": Parameter("kg", positive=True),
            "inertia": Parameter("kg m^2", positive=True),
            "drag": Parameter("s/m", lower=0.0),
        },
        equations=equations,
    )
