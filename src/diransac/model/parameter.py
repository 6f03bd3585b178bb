"""`Parameter`: a constant of a model, with its unit and bounds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from diransac.errors import ModelError

__all__ = ["Parameter"]


@dataclass(frozen=True)
class Parameter:
    """A constant of the model that is to be identified, with the bounds that make it physical.

    Parameters
    ----------
    unit : its unit, such as ``"kg m^2"``
    lower, upper : inclusive bounds in that unit
    positive : a strict lower bound of zero, for what cannot vanish (a mass)
    per_log : one value per log (the bias of a sensor, a payload) where several logs are identified together

    Raises ModelError: the bounds leave no room, or are NaN.
    """

    unit: str = "1"
    lower: float = -np.inf
    upper: float = np.inf
    positive: bool = False
    per_log: bool = False

    def __post_init__(self) -> None:
        if not self.lower <= self.upper or (self.positive and self.upper <= 0.0):
            raise ModelError(
                f"parameter bounds leave no room: lower {self.lower}, upper {self.upper}, positive {self.positive}; "
                "give lower <= upper"
            )

    def admits(self, values: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Whether each value is finite and within the bounds (``PreliminaryTest`` of Algorithm 1, line 15)."""
        x = np.asarray(values, dtype=float)
        inside = np.isfinite(x) & (x >= self.lower) & (x <= self.upper)
        return np.asarray(inside & (x > 0.0) if self.positive else inside)
