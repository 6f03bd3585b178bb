"""Underwater vehicle in one degree of freedom, the first application of DIRANSAC."""

from casadi import fabs

from diransac.model.derivation import Symbols
from diransac.model.model import Model
from diransac.model.parameter import Parameter

__all__ = ["underwater_vehicle"]


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
