"""Linear servo axis with viscous and dry friction."""

from casadi import sign

from diransac.model.derivation import Symbols
from diransac.model.model import Model
from diransac.model.parameter import Parameter

__all__ = ["servo_axis"]


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
