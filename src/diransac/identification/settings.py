"""`Settings` of the RANSAC methods and of the evaluation, with the paper's symbols."""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Callable, Collection, Mapping, Sequence
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
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if value is not None or "None" not in str(field.type):
                object.__setattr__(self, field.name, _checked(field.name, value))
        check_substeps(self.substeps)

    @classmethod
    def table_iv(cls) -> Settings:
        """Table IV of the paper, for the planar rotorcraft."""
        rates, accelerations = ("x_dot", "z_dot", "theta_dot"), ("x_ddot", "z_ddot", "theta_ddot")
        return cls(
            inlier_thresholds=dict.fromkeys((*rates, *accelerations), 0.5),
            min_inlier_signals=3,
            error_weights={**dict.fromkeys(rates, 1.0), **dict.fromkeys(accelerations, 0.1)},
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


def check_substeps(substeps: int) -> None:
    """Raise SettingsError: there are more integration steps per sample than any machine needs."""
    if substeps > MOST_SUBSTEPS:
        raise SettingsError(f"substeps is {substeps!s:.20}; give up to {MOST_SUBSTEPS} integration steps per sample")


def _checked(name: str, value: object) -> object:
    """The value of a setting in its plain type.  Raises SettingsError: it has no meaning."""
    signals = "a mapping from signal to finite number"
    sizes = (f"{signals}, none negative", _numbers, lambda x: min(x.values(), default=0.0) >= 0.0)
    rules: dict[str, tuple[str, Callable[[Any], Any], Callable[[Any], bool]]] = {
        "stop_inlier_fraction": ("a number above 0 and up to 1, or None", lambda x: float(x / 1), lambda x: 0 < x <= 1),
        "inlier_thresholds": sizes,
        "error_weights": sizes,
        "acceptance_weights": (
            "(nu_e, nu_f), none negative, not both zero",
            lambda x: tuple(float(weight) for weight in x),
            lambda x: len(x) == 2 and all(0.0 <= weight < np.inf for weight in x) and any(x),
        ),
        "refit": ("inliers or none", str, ("inliers", "none").__contains__),
        "integrator": (" or ".join(INTEGRATORS), str, INTEGRATORS.__contains__),
        "initial_state": (
            f"first, robust, or {signals}",
            lambda x: x if x in ("first", "robust") else _numbers(x),
            lambda _: True,
        ),
    }
    wanted, plain, holds = rules.get(name, ("a whole number of at least 1", operator.index, lambda x: x >= 1))
    try:
        found = plain(value)
    except (TypeError, ValueError, AttributeError):
        found = None
    if found is None or isinstance(value, bool) or not holds(found):
        raise SettingsError(f"{name} is {value!r}; give {wanted}")
    return found


def _numbers(values: Mapping[str, Any]) -> dict[str, float]:
    """A plain dict of finite numbers.  Raises ValueError: one is none."""
    numbers = {str(name): float(x) for name, x in values.items()}
    if not np.isfinite(list(numbers.values())).all():
        raise ValueError
    return numbers


def finite_number(what: str, value: object) -> float:
    """The number itself.  Raises SettingsError: it is none, or not finite."""
    is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not is_number or not np.isfinite(value):  # type: ignore[call-overload]  # a number
        raise SettingsError(f"{what} is {value!r:.60}; give a finite number")
    return float(value)  # type: ignore[arg-type]
