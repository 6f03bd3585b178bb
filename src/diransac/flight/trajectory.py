"""`Trajectory`: reference states over time and the inputs that produce them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import SettingsError

InputLimits: TypeAlias = Mapping[str, tuple[float, float]]
"""Smallest and largest value by name."""


def half_ranges(lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Half the range between limits (n,); 1 where it is zero or infinite."""
    half = 0.5 * (upper - lower)
    return np.where(np.isfinite(half) & (half > 0.0), half, 1.0)


def is_even(time: FloatArray) -> bool:
    """True for times (K,) that increase evenly, 2 at least."""
    steps = np.diff(time)
    return bool(len(steps) and (steps > 0.0).all() and np.ptp(steps) <= 1e-6 * steps.mean())


@dataclass(frozen=True, eq=False)
class Trajectory:
    """States and inputs over time; each input is held from its row to the next.

    Parameters
    ----------
    time : (K,) array
        s, evenly spaced, at least 2 rows.
    states : (K, n_x) array
        Coordinates, then velocities, each in its unit.
    inputs : (K, n_u) array
        Each in its unit.
    state_names, input_names : tuple of str
        Names of the columns.
    input_limits : mapping of str to (float, float)
        Limits of the inputs, which a controller applies too.
    cost : float, optional
        Minimum found by the planner; None without a planner.

    Raises
    ------
    SettingsError
        Arrays that do not fit together, a time that is not evenly spaced, or a number that is not finite.

    Notes
    -----
    The arrays are copies and read-only.
    """

    time: FloatArray
    states: FloatArray
    inputs: FloatArray
    state_names: tuple[str, ...] = ()
    input_names: tuple[str, ...] = ()
    input_limits: InputLimits = field(default_factory=dict)
    cost: float | None = None

    def __post_init__(self) -> None:
        for name in ("time", "states", "inputs"):
            array = np.array(getattr(self, name), np.float64)
            if array.ndim != (1 if name == "time" else 2) or len(array) != len(self.time) or len(array) < 2:
                raise SettingsError(
                    "a trajectory needs time (K,), states (K, n_x) and inputs (K, n_u) with K of at least 2; "
                    f"found {', '.join(str(np.shape(a)) for a in (self.time, self.states, self.inputs))}"
                )
            if not np.isfinite(array).all():
                raise SettingsError(f"the trajectory's {name} hold a NaN or an infinity")
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        if not is_even(self.time):
            raise SettingsError("the trajectory's time must increase evenly; resample it")
        for name, names, array in (("state", self.state_names, self.states), ("input", self.input_names, self.inputs)):
            if names and len(names) != array.shape[1]:
                raise SettingsError(f"the trajectory has {array.shape[1]} {name}s and {len(names)} {name}_names")
        object.__setattr__(self, "state_names", tuple(self.state_names))
        object.__setattr__(self, "input_names", tuple(self.input_names))
        for name, value in self._values():
            if isinstance(value, Mapping):
                object.__setattr__(self, name, MappingProxyType(dict(value)))

    @property
    def dt(self) -> float:
        """Time from row to row, seconds."""
        return float((self.time[-1] - self.time[0]) / (len(self.time) - 1))

    def __len__(self) -> int:
        return len(self.time)

    def columns(self, names: Sequence[str]) -> FloatArray:
        """States or inputs ``(K, len(names))`` by name.

        Raises SettingsError: there is none of that name.
        """
        known = {**dict(zip(self.input_names, self.inputs.T, strict=False))}
        known |= dict(zip(self.state_names, self.states.T, strict=False))
        missing = [name for name in names if name not in known]
        if missing:
            raise SettingsError(
                f'the trajectory has no "{missing[0]}"; it has {", ".join(known) or "columns without names"}'
            )
        return np.column_stack([known[name] for name in names])

    def __getitem__(self, name: str) -> FloatArray:
        """A state or input ``(K,)`` by name.

        Raises SettingsError: there is none of that name.
        """
        return self.columns([name])[:, 0]

    def __reduce__(self) -> tuple[object, ...]:
        return (type(self), tuple(dict(x) if isinstance(x, Mapping) else x for _, x in self._values()))

    def _values(self) -> list[tuple[str, Any]]:
        """Name and value of each field."""
        return [(x.name, getattr(self, x.name)) for x in fields(self)]
