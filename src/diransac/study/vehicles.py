"""Plants of studies beside the rotorcraft: machines whose drives pull to and fro as their models do not know.

Each gives a `Plant` whose disturbance starts at a phase that a flight's seed draws, and is 0 by default.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import pi
from types import MappingProxyType
from typing import Any

from casadi import cos, sin

from diransac.model import Model, Parameter
from diransac.model.derivation import Symbols
from diransac.model.library import builtin
from diransac.model.plant import Disturbance, Plant

__all__ = ["double_pendulum", "pendulum", "servo_axis"]

SERVO_AXIS: Mapping[str, float] = MappingProxyType(
    {"mass": 95.0, "viscous_friction": 200.0, "dry_friction": 20.0, "offset": -12.0}
)
"""kg, N s/m, N, N: an axis of the size of EMPS."""

DOUBLE_PENDULUM: Mapping[str, float] = MappingProxyType(
    {
        "inertia1": 0.09,
        "moment1": 0.3,
        "inertia2": 0.025,
        "moment2": 0.12,
        "rotor_inertia": 6e-5,
        "viscous_friction1": 0.02,
        "dry_friction1": 0.08,
        "viscous_friction2": 0.02,
        "dry_friction2": 0.05,
    }
)
"""kg m^2, kg m, N m s/rad and N m: a desktop machine."""

PENDULUM: Mapping[str, float] = MappingProxyType({"mass": 0.5, "length": 0.6, "friction": 0.05})
"""kg, m, N m s/rad."""

MAGNET_PITCH = 0.024
"""m, from one cogging position to the next."""

RIPPLES = 126
"""Of a motor's torque in a turn of its joint: 21 pairs of poles behind a gear of 6."""

_RIPPLE_FREQUENCY = 200.0
"""Hz, of a joint that turns at 10 rad/s; steps of integration resolve it."""


def servo_axis(cogging: float = 0.0, parameters: Mapping[str, float] = SERVO_AXIS) -> Plant:
    """`models.servo_axis` whose magnets pull it by `cogging` (N) to and fro, once every 24 mm."""
    model = builtin("servo-axis")

    def magnets(q: Symbols, _v: Symbols, _u: Symbols, _p: Symbols, d: Symbols) -> dict[str, Any]:
        return {"position": d.cogging * cos(2 * pi * q.position / MAGNET_PITCH + d.phase)}

    cogs = Disturbance(
        model, "magnets", forces=magnets, constants={"cogging": cogging}, highest_frequency=40.0, **_anywhere("phase")
    )
    return Plant(model, parameters, (cogs,))


def double_pendulum(ripple: float = 0.0, parameters: Mapping[str, float] = DOUBLE_PENDULUM) -> Plant:
    """`models.double_pendulum` whose motors' torques ripple by so many N m, 126 times a turn."""
    model = builtin("double-pendulum")

    def motors(q: Symbols, _v: Symbols, _u: Symbols, _p: Symbols, d: Symbols) -> dict[str, Any]:
        return {f"q{i}": d.ripple * cos(RIPPLES * q[f"q{i}"] + d[f"phase_{i}"]) for i in (1, 2)}

    ripples = Disturbance(
        model,
        "motors",
        forces=motors,
        constants={"ripple": ripple},
        highest_frequency=_RIPPLE_FREQUENCY,
        **_anywhere("phase_1", "phase_2"),
    )
    return Plant(model, parameters, (ripples,))


def pendulum(ripple: float = 0.0, parameters: Mapping[str, float] = PENDULUM) -> Plant:
    """``a = -g/l sin(q) + (torque - c v) / (m l^2)``: a mass on a rod of unknown length; its motor ripples (N m).

    The length enters as 1/l and 1/l^2: the model is not affine in its parameters.
    """

    def equations(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        torque = u.torque - p.friction * v.angle
        return [a.angle + 9.81 / p.length * sin(q.angle) - torque / (p.mass * p.length**2)]

    def motor(q: Symbols, _v: Symbols, _u: Symbols, p: Symbols, d: Symbols) -> dict[str, Any]:
        return {"angle": d.ripple * cos(RIPPLES * q.angle + d.phase) / (p.mass * p.length**2)}

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
    ripples = Disturbance(
        model,
        "motor",
        accelerations=motor,
        constants={"ripple": ripple},
        highest_frequency=_RIPPLE_FREQUENCY,
        **_anywhere("phase"),
    )
    return Plant(model, parameters, (ripples,))


def _anywhere(*phases: str) -> dict[str, Any]:
    """States of a disturbance that stay where the flight's seed puts them."""
    return {
        "states": dict.fromkeys(phases, "rad"),
        "rates": lambda *_: dict.fromkeys(phases, 0.0),
        "start": dict.fromkeys(phases, (0.0, 2 * pi)),
    }
