"""Machines of studies, with effects that their models leave out: periodic forces of drives, gusts, waves and currents.

Each effect is a sum of sines, whose phases the seed of a flight draws.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import pi, sqrt
from types import MappingProxyType
from typing import Any

from casadi import cos, fabs, sin

from diransac.model import Model, Parameter
from diransac.model.derivation import Symbols
from diransac.model.library import TABLE_I, builtin
from diransac.model.plant import Disturbance, Plant

PARAMETERS: Mapping[str, Mapping[str, float]] = MappingProxyType({
    # kg, N s/m, N, N: an axis of the size of EMPS.
    "servo axis": {"mass": 95.0, "viscous_friction": 200.0, "dry_friction": 20.0, "offset": -12.0},
    # kg m^2, kg m, N m s/rad and N m: a desktop machine.
    "double pendulum": {
        "inertia1": 0.09, "moment1": 0.3, "inertia2": 0.025, "moment2": 0.12, "rotor_inertia": 6e-5,
        "viscous_friction1": 0.02, "dry_friction1": 0.08, "viscous_friction2": 0.02, "dry_friction2": 0.05,
    },
    # kg, m, N m s/rad.
    "pendulum": {"mass": 0.5, "length": 0.6, "friction": 0.05},
    # kg, N s/m, N s^2/m^2, N: a vehicle that a person can carry.
    "underwater vehicle": {"mass": 42.0, "linear_drag": 11.0, "quadratic_drag": 38.0, "bias": 1.6},
})  # fmt: skip
"""Default parameters of the machines."""


def servo_axis(cogging: float = 0.0, parameters: Mapping[str, float] = PARAMETERS["servo axis"]) -> Plant:
    """`models.servo_axis` with a cogging force of amplitude `cogging`, N, and a period of 24 mm."""
    model = builtin("servo-axis")

    def magnets(q: Symbols, _v: Symbols, _u: Symbols, _p: Symbols, d: Symbols) -> dict[str, Any]:
        # m, period of the cogging force.
        return {"position": d.cogging * cos(2 * pi * q.position / 0.024 + d.phase)}

    cogs = Disturbance(
        model,
        "magnets",
        forces=magnets,
        constants={"cogging": cogging},
        highest_frequency=40.0,
        **_phases({"phase": 0.0}),
    )
    return Plant(model, parameters, (cogs,))


def double_pendulum(ripple: float = 0.0, parameters: Mapping[str, float] = PARAMETERS["double pendulum"]) -> Plant:
    """`models.double_pendulum` with a torque ripple of amplitude `ripple`, N m, 126 periods per turn, at each joint."""
    model = builtin("double-pendulum")

    def motors(q: Symbols, _v: Symbols, _u: Symbols, _p: Symbols, d: Symbols) -> dict[str, Any]:
        return {f"q{i}": _ripple(d, q[f"q{i}"], d[f"phase_{i}"]) for i in (1, 2)}

    ripples = _rippled(model, "motors", ripple, ("phase_1", "phase_2"), forces=motors)
    return Plant(model, parameters, (ripples,))


def pendulum(ripple: float = 0.0, parameters: Mapping[str, float] = PARAMETERS["pendulum"]) -> Plant:
    """``a = -g/l sin(q) + (torque - c v) / (m l^2)``: a mass on a rod of unknown length, with a torque ripple, N m.

    The length enters as 1/l and 1/l^2: the model is not affine in its parameters.
    """

    def equations(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        torque = u.torque - p.friction * v.angle
        return [a.angle + 9.81 / p.length * sin(q.angle) - torque / (p.mass * p.length**2)]

    def motor(q: Symbols, _v: Symbols, _u: Symbols, p: Symbols, d: Symbols) -> dict[str, Any]:
        return {"angle": _ripple(d, q.angle, d.phase) / (p.mass * p.length**2)}

    model = Model(
        "pendulum",
        coordinates={"angle": "rad"},
        inputs={"torque": "N m"},
        parameters={
            "mass": Parameter("kg", positive=True),
            "length": Parameter("m", positive=True),
            "friction": Parameter("N m s/rad", lower=0.0),
        },
        equations=equations,
    )
    ripples = _rippled(model, "motor", ripple, ("phase",), accelerations=motor)
    return Plant(model, parameters, (ripples,))


def _ripple(d: Symbols, angle: Any, phase: Any) -> Any:
    """Torque of a motor with 126 periods per turn of its joint: 21 pole pairs behind a gear of 6."""
    return d.ripple * cos(126 * angle + phase)


def _rippled(model: Model, name: str, ripple: float, phases: Sequence[str], **effect: Any) -> Disturbance:
    """Torque ripple, which integration steps resolve up to joint velocities of 10 rad/s, 200 Hz."""
    states = _phases(dict.fromkeys(phases, 0.0))
    return Disturbance(model, name, **effect, constants={"ripple": ripple}, highest_frequency=200.0, **states)


def rotorcraft_in_gusts(
    gusts: float = 0.0, moment_gusts: float = 0.0, parameters: Mapping[str, float] = TABLE_I
) -> Plant:
    """The planar rotorcraft in gusts of 0.1 to 2.6 Hz."""
    model = builtin("planar-rotorcraft")
    rates = (0.11, 0.23, 0.54, 1.2, 2.6)  # Hz, up to the bandwidth of an attitude controller

    def air(_q: Symbols, _v: Symbols, _u: Symbols, _p: Symbols, d: Symbols) -> dict[str, Any]:
        sizes = {"x": d.gusts, "z": d.gusts, "theta": d.moment_gusts}
        return {name: size * _sines(d, f"phase_{name}", rates) for name, size in sizes.items()}

    air_in_motion = Disturbance(
        model,
        "air",
        forces=air,
        constants={"gusts": gusts, "moment_gusts": moment_gusts},
        highest_frequency=max(rates),
        **_turning({f"phase_{name}": rates for name in model.coordinates}),
    )
    return Plant(model, parameters, (air_in_motion,))


def underwater_vehicle(
    waves: float = 0.0, current: float = 0.0, parameters: Mapping[str, float] = PARAMETERS["underwater vehicle"]
) -> Plant:
    """`models.underwater_vehicle` in waves and in a slow current, whose drag is that of the motion through the water.

    Parameters
    ----------
    waves : RMS of their force, N, at 0.12 to 0.27 Hz
    current : RMS of its velocity, m/s, at 0.02 Hz
    parameters : of the model
    """
    model = builtin("underwater-vehicle")
    of_waves, of_current = (0.12, 0.19, 0.27), (0.02,)  # Hz: waves of a lake, a tide in the time of a dive

    def water(_q: Symbols, v: Symbols, _u: Symbols, p: Symbols, d: Symbols) -> dict[str, Any]:
        def drag(speed: Any) -> Any:
            return p.linear_drag * speed + p.quadratic_drag * fabs(speed) * speed

        through_water = v.x - d.current * _sines(d, "phase_current", of_current)
        return {"x": drag(v.x) - drag(through_water) + d.waves * _sines(d, "phase_waves", of_waves)}

    water_in_motion = Disturbance(
        model,
        "water",
        forces=water,
        constants={"waves": waves, "current": current},
        highest_frequency=max(of_waves),
        **_turning({"phase_waves": of_waves, "phase_current": of_current}),
    )
    return Plant(model, parameters, (water_in_motion,))


def _sines(d: Symbols, name: str, frequencies: Sequence[float]) -> Any:
    """Sum of sines, of RMS 1, with the states of `_turning`."""
    return sqrt(2.0 / len(frequencies)) * sum(sin(d[f"{name}_{i}"]) for i in range(len(frequencies)))


def _turning(groups: Mapping[str, Sequence[float]]) -> dict[str, Any]:
    """States ``name_i`` of a disturbance, the phases of sines with these frequencies, Hz."""
    return _phases({f"{name}_{i}": 2 * pi * rate for name, some in groups.items() for i, rate in enumerate(some)})


def _phases(rates: Mapping[str, float]) -> dict[str, Any]:
    """States of a disturbance by their constant rates, rad/s; the seed of a flight draws each in a turn."""
    return {
        "states": dict.fromkeys(rates, "rad"),
        "rates": lambda *_: dict(rates),
        "start": dict.fromkeys(rates, (0.0, 2 * pi)),
    }
