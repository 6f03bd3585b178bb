"""`Settings` of the RANSAC methods and of the evaluation, with the paper's symbols."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from diransac.errors import SettingsError
from diransac.simulation import INTEGRATORS

MOST_SUBSTEPS = 10_000
"""Integration steps per sample, at most: more are a slip of the pen, and take hours."""

JUDGING = ("inlier_thresholds", "min_inlier_signals", "error_weights")
"""Settings of the fit error and the inliers, which every method's evaluation has."""

SIMULATION = ("integrator", "substeps", "initial_state")
"""Settings of the simulation that is evaluated."""

EXECUTION = ("threads", "batch_size")
"""Settings on which results do not depend; every method accepts them."""


@dataclass(frozen=True)
class Settings:
    """Settings of the RANSAC methods; ``Settings()`` works for any model, ``Settings.table_iv()`` is the paper's.

    Parameters
    ----------
    sample_size : int, optional
        Smallest number of observations in a sample (the paper's s).
    max_iterations : int, optional
        Largest number of samples, k_m.
    stop_inlier_fraction : float, optional
        Fraction of inliers of the stored model that ends the search, f_I,t; None forces all iterations.
    inlier_thresholds : mapping of str to float, optional
        Threshold epsilon of each signal in its unit; an error strictly below it is an inlier's.  A signal that is not
        named has 0, which switches it off.  None: a fifth of each signal's spread in the log.
    min_inlier_signals : int, optional
        Number of signals of an observation that must be inliers, xi; None: half of those with a threshold.
    error_weights : mapping of str to float, optional
        Weight w of each signal in eq. (2), one over its unit; a signal that is not named has 0.  None: 1 over the
        spread for velocities, 0.1 over it for accelerations (Table IV's ratio), coordinates only where their velocity
        is not measured.
    acceptance_weights : (float, float), optional
        Weights nu = (nu_e, nu_f) of eq. (3).
    refit : str, optional
        Refit of improving hypotheses: to their "inliers" (Algorithm 1, lines 25-31) or "none".
    integrator : str, optional
        "rk4", "euler" or "semi-implicit-euler".
    substeps : int, optional
        Integration steps per sample.
    initial_state : str or mapping of str to float, optional
        Rule of the initial state Y_0: "first" (the paper's: the first row), "robust" (the first row, in which a sample
        far from the line through the first seven is replaced by the line's value), or values by name, which replace
        those of the first row.
    threads : int, optional
        Number of threads of the simulation; None: one per core, one in a worker process
        (`simulation.default_threads`).  Results do not depend on it.
    batch_size : int, optional
        Number of hypotheses simulated at once.  Results do not depend on it.

    Raises
    ------
    SettingsError
        A value is out of range, or of another type.

    References
    ----------
    Dimmig et al. 2023, Algorithm 1 and Table IV.
    """

    sample_size: int = 75
    max_iterations: int = 1000
    stop_inlier_fraction: float | None = 0.85
    inlier_thresholds: Mapping[str, float] | None = None
    min_inlier_signals: int | None = None
    error_weights: Mapping[str, float] | None = None
    acceptance_weights: tuple[float, float] = (1.0, 0.06)
    refit: str = "inliers"
    integrator: str = "rk4"
    substeps: int = 1
    initial_state: str | Mapping[str, float] = "first"
    threads: int | None = None
    batch_size: int = 256

    def __post_init__(self) -> None:
        for name in ("sample_size", "max_iterations", "substeps", "batch_size"):
            object.__setattr__(self, name, _positive_integer(name, getattr(self, name)))
        for name in ("min_inlier_signals", "threads"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _positive_integer(name, getattr(self, name)))
        check_substeps(self.substeps)
        if self.stop_inlier_fraction is not None:
            fraction = _fraction("stop_inlier_fraction", self.stop_inlier_fraction)
            object.__setattr__(self, "stop_inlier_fraction", fraction)
        for name in ("inlier_thresholds", "error_weights"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _by_name(name, getattr(self, name), 0.0))
        self._check_acceptance()
        _one_of("refit", self.refit, ("inliers", "none"))
        _one_of("integrator", self.integrator, tuple(INTEGRATORS))
        if isinstance(self.initial_state, Mapping):
            object.__setattr__(self, "initial_state", _by_name("initial_state", self.initial_state, -np.inf))
        else:
            _one_of("initial_state", self.initial_state, ("first", "robust"))

    def _check_acceptance(self) -> None:
        try:
            weights = tuple(float(x) for x in self.acceptance_weights)
        except (TypeError, ValueError) as error:
            raise SettingsError(f"acceptance_weights is {self.acceptance_weights!r}; give (nu_e, nu_f)") from error
        if len(weights) != 2 or not all(0.0 <= x < np.inf for x in weights) or not any(weights):
            raise SettingsError(
                f"acceptance_weights is {self.acceptance_weights!r}; give (nu_e, nu_f), none negative, not both zero"
            )
        object.__setattr__(self, "acceptance_weights", weights)

    @classmethod
    def table_iv(cls) -> Settings:
        """Table IV of the paper, for the planar rotorcraft."""
        rates, accelerations = ("x_dot", "z_dot", "theta_dot"), ("x_ddot", "z_ddot", "theta_ddot")
        return cls(
            sample_size=75,
            max_iterations=1000,
            stop_inlier_fraction=0.85,
            inlier_thresholds=dict.fromkeys((*rates, *accelerations), 0.5),
            min_inlier_signals=3,
            error_weights={**dict.fromkeys(rates, 1.0), **dict.fromkeys(accelerations, 0.1)},
            acceptance_weights=(1.0, 0.06),
        )

    def changed(self) -> tuple[str, ...]:
        """Names of the settings that differ from their defaults."""
        default = Settings()
        return tuple(f.name for f in dataclasses.fields(self) if getattr(self, f.name) != getattr(default, f.name))

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Settings:
        """Settings from a mapping, such as a TOML table or `to_dict`'s.

        Parameters
        ----------
        data : mapping of str to object
            Settings by name.

        Returns
        -------
        Settings

        Raises
        ------
        SettingsError
            A name is unknown; the message has the nearest.  A value is out of range.
        """
        known = [f.name for f in dataclasses.fields(cls)]
        unknown = [name for name in data if name not in known]
        if unknown:
            raise SettingsError(f'there is no setting "{unknown[0]}"; {nearest_names(unknown[0], known)}')
        return cls(**data)

    def to_dict(self) -> dict[str, Any]:
        """Every setting by name, ready for JSON."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in dataclasses.asdict(self).items()}


def nearest_names(name: str, known: Sequence[str]) -> str:
    """Clause that follows an unknown name: ``did you mean substeps?``, or all known names where none is close.

    Parameters
    ----------
    name : str
    known : sequence of str

    Returns
    -------
    str
    """
    from difflib import get_close_matches

    nearest = get_close_matches(name, known, cutoff=0.75)
    return f"did you mean {' or '.join(nearest)}?" if nearest else f"there are {', '.join(known)}"


def check_used(settings: Settings, used: Collection[str], method: str) -> None:
    """Raise for settings that a method does not use.

    Parameters
    ----------
    settings : Settings
    used : collection of str
        Names of the settings that the method uses.
    method : str
        Name of the method in the message.

    Raises
    ------
    SettingsError
        A setting that is not in ``used`` differs from its default; the message names it.
    """
    unused = [name for name in settings.changed() if name not in (*used, *EXECUTION)]
    if unused:
        raise SettingsError(
            f'method "{method}" has no use for the setting {unused[0]} = {getattr(settings, unused[0])!r}; leave it out'
            f" (it uses {', '.join(used)})"
        )


def _positive_integer(name: str, value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise SettingsError(f"{name} is {value!r}; give a whole number of at least 1")
    return int(value)


def check_substeps(substeps: int) -> None:
    """Raise SettingsError: there are more integration steps per sample than any machine needs."""
    if substeps > MOST_SUBSTEPS:
        raise SettingsError(f"substeps is {substeps!s:.20}; give up to {MOST_SUBSTEPS} integration steps per sample")


def _fraction(name: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not 0.0 < value <= 1.0:
        raise SettingsError(f"{name} is {value!r}; give a number above 0 and up to 1, or None")
    return float(value)


def _one_of(name: str, value: object, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise SettingsError(f"{name} is {value!r}; choose {', '.join(choices)}")


def _by_name(name: str, values: object, lower: float) -> dict[str, float]:
    """A plain dict of finite numbers, none below ``lower``."""
    if not isinstance(values, Mapping):
        raise SettingsError(f"{name} is {values!r}; give a mapping from signal to number")
    try:
        numbers = {str(k): float(v) for k, v in values.items()}
    except (TypeError, ValueError) as error:
        raise SettingsError(f"{name} is {dict(values)!r}; give a number for each signal") from error
    for signal, x in numbers.items():
        if not np.isfinite(x) or x < lower:
            raise SettingsError(
                f"{name}: {signal} is {x}; give a finite number" + (" of at least 0" if lower == 0.0 else "")
            )
    return numbers


def finite_number(what: str, value: object) -> float:
    """The number itself.  Raises SettingsError: it is none, or not finite."""
    is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not is_number or not np.isfinite(value):  # type: ignore[call-overload]  # a number
        raise SettingsError(f"{what} is {value!r:.60}; give a finite number")
    return float(value)  # type: ignore[arg-type]
