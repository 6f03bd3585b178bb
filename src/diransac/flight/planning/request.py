"""What a plan is asked to do: a user's arguments, checked and turned into arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import SettingsError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from diransac.model import Model


__all__ = ["Limits", "Reference", "Waypoint", "limits_of", "named_values", "rows_of", "waypoints_of", "weights_of"]

_UNIT_LENGTH = 1e-3
"""How far a quaternion's length may be from one where a user writes it."""

Signal = Callable[["FloatArray"], "ArrayLike"]


@dataclass(frozen=True)
class Waypoint:
    """States that are fixed at one moment.

    Parameters
    ----------
    states : indices of the states, increasing
    values : (n,)   of these states
    """

    states: tuple[int, ...]
    values: FloatArray

    def text(self, names: Sequence[str]) -> str:
        """What it fixes away from zero, or all of it."""
        shown = [(names[j], v) for j, v in zip(self.states, self.values, strict=True) if v != 0.0]
        return ", ".join(f"{n} = {v:g}" for n, v in shown) or "all zero"


@dataclass(frozen=True)
class Limits:
    """Smallest and largest values (n,) of the inputs or the states; infinite where there are none."""

    lower: FloatArray
    upper: FloatArray

    def around(self, trim: FloatArray, share: float) -> Limits:
        """Limits that leave this share of the way from trim (n,) to each limit; a trim beyond a limit is left alone."""
        lower, upper = (trim + share * (limit - trim) for limit in (self.lower, self.upper))
        return Limits(np.maximum(self.lower, lower), np.minimum(self.upper, upper))

    @property
    def half_ranges(self) -> FloatArray:
        """(n,)   1 where there is no range, or none that has two ends."""
        half = 0.5 * (self.upper - self.lower)
        return np.where(np.isfinite(half) & (half > 0.0), half, 1.0)

    def by_name(self, names: Iterable[str]) -> dict[str, tuple[float, float]]:
        """Name -> (lowest, highest)."""
        return {n: (float(a), float(b)) for n, a, b in zip(names, self.lower, self.upper, strict=True)}


@dataclass(frozen=True)
class Reference:
    """What is to be followed.

    Parameters
    ----------
    signals : state -> function of time in s, or samples evenly spread from the start to the end
    """

    signals: Mapping[str, Signal | ArrayLike]

    def at(self, time: FloatArray) -> dict[str, FloatArray]:
        """Values (n_times,) by state; time starts at 0 and ends with the plan.

        Raises SettingsError: a function gives something else than a number for each time.
        """
        return {name: _sampled(name, signal, time) for name, signal in self.signals.items()}


def _sampled(name: str, signal: Signal | ArrayLike, time: FloatArray) -> FloatArray:
    if callable(signal):
        values = np.asarray(signal(time), np.float64)
    else:
        samples = np.asarray(signal, np.float64)
        if samples.ndim != 1 or len(samples) < 2:
            raise SettingsError(
                f'the reference of "{name}" must be a function of time, or at least 2 samples (n,); '
                f"found an array of shape {samples.shape}"
            )
        values = np.interp(time, np.linspace(time[0], time[-1], len(samples)), samples)
    if values.shape not in ((), time.shape) or not np.isfinite(values).all():
        raise SettingsError(
            f'the reference of "{name}" must give a finite number for each of {len(time)} times; '
            f"found shape {values.shape}{'' if np.isfinite(values).all() else ' with a NaN or an infinity'}"
        )
    return np.broadcast_to(values, time.shape).astype(np.float64)


def waypoints_of(
    model: Model, waypoints: Sequence[Mapping[str, float]], start_end_at_rest: bool
) -> tuple[Waypoint, ...]:
    """Checked waypoints; with `start_end_at_rest`, what the first and the last don't name is zero.

    Raises SettingsError: fewer than two, an unknown state, a value that isn't finite, a quaternion that isn't one.
    """
    if len(waypoints) < 2:
        raise SettingsError(f"a plan needs at least 2 waypoints, a start and an end; found {len(waypoints)}")
    found = []
    for k, waypoint in enumerate(waypoints):
        at_end = k in (0, len(waypoints) - 1)
        values = named_values(f"waypoint {k}", "state", waypoint, model.state)
        _check_quaternions(model, k, values, start_end_at_rest and at_end)
        if start_end_at_rest and at_end:
            values = dict.fromkeys(model.state, 0.0) | values
        states = tuple(j for j, name in enumerate(model.state) if name in values)
        found.append(Waypoint(states, _normalised(model, states, values)))
    return tuple(found)


def _check_quaternions(model: Model, k: int, values: Mapping[str, float], all_fixed: bool) -> None:
    for four in model.quaternions:
        names = [model.state[j] for j in four]
        given = [values[n] for n in names if n in values]
        if all_fixed and len(given) < 4:
            raise SettingsError(
                f"waypoint {k} must say which way the plant points: name {', '.join(names)}, "
                "or pass start_end_at_rest=False"
            )
        if len(given) == 4 and abs(np.linalg.norm(given) - 1.0) > _UNIT_LENGTH:
            raise SettingsError(
                f"waypoint {k}: {', '.join(names)} are a quaternion; its length is {np.linalg.norm(given):.4g}, not 1"
            )


def _normalised(model: Model, states: tuple[int, ...], values: Mapping[str, float]) -> FloatArray:
    """Values in the model's order, whole quaternions with length one: nothing else can be reached."""
    array = np.array([values[model.state[j]] for j in states])
    for four in model.quaternions:
        if set(four) <= set(states):
            rows = [states.index(j) for j in four]
            array[rows] /= np.linalg.norm(array[rows])
    return array


def limits_of(what: str, limits: Mapping[str, tuple[float, float]] | None, names: Sequence[str]) -> Limits:
    """Limits (n,) by name; none where none is given.

    Raises SettingsError: an unknown name, no pair of numbers, no room between them.
    """
    lower, upper = np.full(len(names), -np.inf), np.full(len(names), np.inf)
    for name, pair in (limits or {}).items():
        _check_known(f"{what}_limits", what, name, names)
        if np.shape(pair) != (2,) or not pair[0] <= pair[1]:
            raise SettingsError(f'{what}_limits of "{name}" must be (lowest, highest); found {pair!r}')
        lower[names.index(name)], upper[names.index(name)] = pair
    return Limits(lower, upper)


def weights_of(
    what: str, kind: str, weights: Mapping[str, float] | None, names: Sequence[str], default: FloatArray
) -> FloatArray:
    """Weights (n,) by name.

    Raises SettingsError: an unknown name, or a weight that is negative or not finite.
    """
    values = default.copy()
    for name, weight in named_values(what, kind, weights or {}, names).items():
        if weight < 0.0:
            raise SettingsError(f'{what} of "{name}" is {weight:g}; a weight is at least 0')
        values[names.index(name)] = weight
    return values


def rows_of(times: Sequence[float], n_waypoints: int, dt: float) -> tuple[int, ...]:
    """Rows of each segment's duration: the times rounded to the time step.

    Raises SettingsError: not a time for each waypoint, times that don't increase, or by less than a time step.
    """
    array = np.asarray(times, np.float64)
    if array.shape != (n_waypoints,) or not np.isfinite(array).all():
        raise SettingsError(
            f"times must be a finite number of seconds for each of the {n_waypoints} waypoints; found {list(times)}"
        )
    steps = np.diff(np.rint((array - array[0]) / dt).astype(int))
    if (steps < 1).any():
        k = int(np.argmax(steps < 1))
        raise SettingsError(
            f"times must increase by at least {dt:g} s from waypoint to waypoint; "
            f"found {array[k]:g} s for waypoint {k} and {array[k + 1]:g} s for waypoint {k + 1}"
        )
    return tuple(int(n) for n in steps)


def named_values(what: str, kind: str, values: Mapping[str, float], names: Sequence[str]) -> dict[str, float]:
    """The same as finite floats.

    Raises SettingsError: an unknown name, or a value that is no finite number.
    """
    found = {}
    for name, value in values.items():
        _check_known(what, kind, name, names)
        number = np.asarray(value)
        if number.shape != () or number.dtype.kind not in "fiu" or not np.isfinite(number):
            raise SettingsError(f'{what}: "{name}" is {value!r}; give a finite number')
        found[name] = float(number)
    return found


def _check_known(what: str, kind: str, name: str, names: Sequence[str]) -> None:
    if name not in names:
        raise SettingsError(f'{what}: there is no {kind} "{name}"; there are {", ".join(names)}')
