"""Constants of a model, with units and bounds."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from diransac.errors import ModelError
from diransac.plain_text import is_one_line


def parameter_of(name: str, parameters: Collection[str]) -> str:
    """Parameter of a model that a value is of: ``bias`` of ``bias[0]``, its value in the first of several logs.

    Parameters
    ----------
    name : str
    parameters : collection of str
        Names of the model's parameters.
    """
    return name if name in parameters else name.rpartition("[")[0]


@dataclass(frozen=True)
class Parameter:
    """Constant of a model that is to be identified, with its physical bounds.

    Parameters
    ----------
    unit : str
        Its unit, such as ``"kg m^2"``.
    lower, upper : float
        Inclusive bounds in that unit.
    positive : bool
        Adds a strict lower bound of zero, for a mass and the like.
    per_log : bool
        One value per log (the bias of a sensor, a payload) where several logs are identified together.
    value : float, optional
        Nominal value in that unit, at which ``identify(..., fixed=["mass"])`` fixes the parameter.
    combination : tuple of (str, float), optional
        Quantities of a robot's description, with weights, of whose sum the parameter is the value: one, such as
        ``"armature elbow"``, or those of which motions show the sum alone.

    Raises
    ------
    ModelError
        The unit is not a text of one line, no value is within the bounds, one is NaN, or the nominal value is outside
        of them.
    """

    unit: str = "1"
    lower: float = -np.inf
    upper: float = np.inf
    positive: bool = False
    per_log: bool = False
    value: float | None = None
    combination: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        if not is_one_line(self.unit):
            raise ModelError(f'the unit of a parameter is {self.unit!r:.60}; give a text of one line, such as "kg"')
        if not self.lower <= self.upper or (self.positive and self.upper <= 0.0):
            raise ModelError(
                f"parameter bounds leave no room: lower {self.lower}, upper {self.upper}, positive {self.positive}; "
                "give lower <= upper"
            )
        if self.value is not None and not self.admits(self.value):
            raise ModelError(
                f"nominal value {self.value} of a parameter is outside its bounds: lower {self.lower}, upper "
                f"{self.upper}, positive {self.positive}; give a finite value within them"
            )

    def admits(self, values: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Mask of the values that are finite and within the bounds (``PreliminaryTest`` of Algorithm 1, line 15)."""
        x = np.asarray(values, dtype=float)
        inside = np.isfinite(x) & (x >= self.lower) & (x <= self.upper)
        return np.asarray(inside & (x > 0.0) if self.positive else inside)

    def to_dict(self) -> dict[str, Any]:
        """The fields as JSON data, which `from_dict` reads; those with defaults that came later only if they differ."""

        def finite(x: float) -> float | None:
            return float(x) if np.isfinite(x) else None

        stored = {
            "unit": self.unit,
            "lower": finite(self.lower),
            "upper": finite(self.upper),
            "positive": self.positive,
        }
        own_values = {"per_log": True} if self.per_log else {}
        nominal = {} if self.value is None else {"value": float(self.value)}
        combination = {"combination": [list(x) for x in self.combination]} if self.combination else {}
        return {**stored, **own_values, **nominal, **combination}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Parameter:
        """Raises KeyError, TypeError, ValueError, ModelError: the data are not those of a parameter."""
        unit, positive, own_values = data["unit"], data["positive"], data.get("per_log", False)
        if not isinstance(unit, str) or not isinstance(positive, bool) or not isinstance(own_values, bool):
            raise TypeError(f"parameter {data!r:.60}")
        lower = -np.inf if data["lower"] is None else float(data["lower"])
        upper = np.inf if data["upper"] is None else float(data["upper"])
        value = None if data.get("value") is None else float(data["value"])
        combination = tuple((str(name), float(weight)) for name, weight in data.get("combination", ()))
        return cls(unit, lower, upper, positive, own_values, value, combination)
