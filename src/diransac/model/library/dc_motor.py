"""Permanent-magnet direct-current motor."""

from diransac.model.derivation import Symbols
from diransac.model.model import Model
from diransac.model.parameter import Parameter

__all__ = ["dc_motor"]


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
