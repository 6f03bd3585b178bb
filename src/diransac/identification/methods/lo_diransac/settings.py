"""Settings of lo-diransac, checked."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.errors import SettingsError
from diransac.identification.settings import JUDGING, Settings, check_substeps, check_used

if TYPE_CHECKING:
    from diransac.arrays import FloatArray
    from diransac.data.dataset import ParameterLayout
    from diransac.identification.structure.candidate_terms import TermLibrary
    from diransac.model import Model


@dataclass(frozen=True)
class LoDiransacSettings:
    """Fields of `LoDiransac`, which documents them."""

    criteria: Settings = field(default_factory=Settings)
    smoothing_half_width: float = 0.25
    n_samples: int = 200
    input_delay: bool | None = None
    input_lag: bool | None = None
    sensor_delays: tuple[str, ...] | None = None
    sensor_biases: tuple[str, ...] | None = None
    gain_drifts: tuple[str, ...] | None = None
    substeps: int = 5
    max_steps: int = 60
    outliers: bool = True
    model_error: bool = True
    prior_model_error: float = 1e-3
    prior_discrepancy: float = 0.1
    start: Mapping[str, float] | None = None
    horizon: float | None = None
    suggestions: bool = True
    candidate_terms: TermLibrary | None = None

    name = "lo-diransac"
    needs_all_signals = False
    uses = (*JUDGING, "initial_state")

    def __post_init__(self) -> None:
        check_used(self.criteria, self.uses, self.name)
        for f in dataclasses.fields(self):
            value = getattr(self, f.name)
            if f.name in _SWITCHES and not (value is None or isinstance(value, bool)):
                raise SettingsError(f"{f.name} is {value!r}; give True, False, or None for the choice by evidence")
            if f.name in _NAMES:
                object.__setattr__(self, f.name, _checked_names(f.name, value))
            elif f.name not in (*_OBJECTS, *_SWITCHES):
                object.__setattr__(self, f.name, _checked(f.name, value, f.default))
        check_substeps(self.substeps)
        if self.horizon is not None:
            object.__setattr__(self, "horizon", _checked("horizon", self.horizon, 1.0))
        _check_start(self.start)
        if self.candidate_terms is not None and not callable(self.candidate_terms):
            raise SettingsError(
                f"candidate_terms is {self.candidate_terms!r}; give a function of (q, v, u) that returns expressions "
                "by name"
            )
        if self.input_delay and self.input_lag:
            raise SettingsError("input_delay and input_lag are both True; inputs act after a delay or after a lag")

    @property
    def forces_timing(self) -> bool:
        """True if a delay or a lag of the inputs is estimated in any case."""
        return bool(self.input_delay or self.input_lag)

    def start_of(self, layout: ParameterLayout) -> FloatArray | None:
        """The user's start ``(n,)``, means of priors, and nominal values, in this order; one where there is none.

        None where there is none of any parameter.
        """
        found, start = [], self.start or {}
        given = zip(layout.owners, layout.bounds, layout.prior_mean, layout.prior_std, strict=True)
        for name, bound, mean, std in given:
            nominal = mean if np.isfinite(std) else bound.value
            found.append(start.get(name, nominal))
        known = [x for x in found if x is not None]
        return np.array([1.0 if x is None else x for x in found], float) if known else None

    def regresses(self, model: Model) -> bool:
        """False: sensors are compared with simulations."""
        return False

    def options(self) -> Mapping[str, Any]:
        """All settings but the criteria and the user's candidate terms."""
        left_out = ("criteria", "candidate_terms")
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name not in left_out}
        plain = {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}
        return {**plain, "start": None if self.start is None else dict(self.start)}


def _check_start(start: object) -> None:
    """Raises SettingsError: no mapping from names to numbers."""
    numbers = isinstance(start, Mapping) and all(
        isinstance(x, int | float | np.number) and not isinstance(x, bool) and np.isfinite(x) for x in start.values()
    )
    if start is not None and not numbers:
        raise SettingsError(f"start is {start!r}; give a number for each parameter that it names, such as mass=0.3")


_OBJECTS = ("criteria", "candidate_terms", "start", "horizon")
_SWITCHES = ("input_delay", "input_lag")
_NAMES = ("sensor_delays", "sensor_biases", "gain_drifts")
_MAY_BE_ZERO = (
    "n_samples",
    "max_steps",
    "prior_model_error",
    "prior_discrepancy",
)


def _checked(name: str, value: Any, default: Any) -> Any:
    """The value as the kind of its default.  Raises SettingsError: it is none, or out of range."""
    least = "at least 0" if name in _MAY_BE_ZERO else "above 0"
    if isinstance(default, bool):
        if not isinstance(value, bool):
            raise SettingsError(f"{name} is {value!r}; give True or False")
        return value
    kinds = (int, np.integer) if isinstance(default, int) else (int, float, np.number)
    if isinstance(value, bool) or not isinstance(value, kinds) or not np.isfinite(value):
        raise SettingsError(f"{name} is {value!r}; give a {'whole ' if isinstance(default, int) else ''}number {least}")
    if value < 0 or (value == 0 and name not in _MAY_BE_ZERO):
        raise SettingsError(f"{name} is {value!r}; give a number {least}")
    return type(default)(value)


def _checked_names(name: str, value: Any) -> tuple[str, ...] | None:
    """Names of signals or inputs; one name stands for itself.  Raises SettingsError: a value is no name."""
    names = (value,) if isinstance(value, str) else value
    if names is None:
        return None
    if not isinstance(names, list | tuple) or not all(isinstance(x, str) for x in names):
        wanted = "signals, () for none, or None for the clear ones"
        raise SettingsError(f"{name} is {value!r}; give names of {wanted}")
    return tuple(names)
