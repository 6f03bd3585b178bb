"""Gaussian noise of a machine's signals, and what integrates from it; `Noise` has the formulas."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.units import conversion
from diransac.errors import LogError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from diransac.data.log import Log
    from diransac.flight.corruption.draws import Draws
    from diransac.flight.corruption.specification import Noise

__all__ = ["gaussian_errors"]


def gaussian_errors(log: Log, names: Iterable[str], noise: Noise, draws: Draws) -> dict[str, FloatArray]:
    """The errors (N,) of each signal, in its unit; empty where there is no Gaussian noise.

    Raises LogError: a signal's unit is not known, or is none of a second-order machine's.
    """
    if not (noise.acceleration_std or noise.rate_std or noise.angular_acceleration_std):
        return {}
    return {name: _error(name, _kind(log, name), log, noise, draws) for name in names}


def _error(name: str, kind: str, log: Log, noise: Noise, draws: Draws) -> FloatArray:
    std, order = _measured(noise, log.dt)[kind]
    in_its_unit = std * (conversion(kind, log.units[name]) or 0.0)
    if noise.integrated == "white" or kind == "rad/s^2":
        return np.asarray(in_its_unit * _held(order, log.dt) * draws.normal("gaussian", name))
    # Every order of one motion integrates the same errors: those of its acceleration, or of its angular velocity.
    return in_its_unit * _integrated(draws.normal("gaussian", _stem(name)), order, log.dt)


def _measured(noise: Noise, dt: float) -> dict[str, tuple[float, int]]:
    """Kind of signal -> standard deviation that it comes from, and how many integrations away from it."""
    angular = noise.angular_acceleration_std
    return {
        "m/s^2": (noise.acceleration_std, 0),
        "m/s": (noise.acceleration_std, 1),
        "m": (noise.acceleration_std, 2),
        "rad/s^2": (noise.rate_std / dt if angular is None else angular, 0),
        "rad/s": (noise.rate_std, 0),
        "rad": (noise.rate_std, 1),
    }


def _kind(log: Log, name: str) -> str:
    unit = log.units.get(name)
    kinds = [kind for kind in ("m/s^2", "m/s", "m", "rad/s^2", "rad/s", "rad") if unit and conversion(unit, kind)]
    if not kinds:
        found = f'has the unit "{unit}"' if unit else "has no unit"
        raise LogError(
            f'{log.source}: signal "{name}" {found}, and the unit tells which Gaussian noise it gets: a power of m or '
            "rad over s; give units with dataclasses.replace(log, units=model.units), or choose others with signals="
        )
    return kinds[0]


def _held(order: int, dt: float) -> float:
    """What an error of 1, held for one sample, becomes after so many integrations: dt^n / n!."""
    return (1.0, dt, dt**2 / 2.0)[order]


def _integrated(errors: FloatArray, order: int, dt: float) -> FloatArray:
    """Errors, each held for one sample, integrated from zero at the first row."""
    if order == 0:
        return errors
    first = _sum_before(errors) * dt
    return first if order == 1 else _sum_before(first + dt / 2.0 * errors) * dt


def _sum_before(values: FloatArray) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum(values[:-1])])


def _stem(name: str) -> str:
    return name.removesuffix("_ddot").removesuffix("_dot")
