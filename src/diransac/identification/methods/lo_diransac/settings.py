"""`LoDiransac`: the settings of the default method."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.blas import single_threaded
from diransac.errors import SettingsError
from diransac.identification.settings import JUDGING, Settings, check_used

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset
    from diransac.identification.estimate import Estimate
    from diransac.identification.method import Callback

__all__ = ["LoDiransac", "configured"]


@dataclass(frozen=True)
class LoDiransac:
    """Locally optimised DIRANSAC: random samples, consensus by simulation, one weak-constraint fit of all logs.

    Every default works for any model and any subset of signals.  Windows have at least 5 samples.

    Parameters
    ----------
    criteria : Settings, optional
        Settings of the evaluation: weights, thresholds and initial state, threads.
    stuck_rows : bool, optional
        Whether rows that repeat the row before in every signal are taken as missing.
    input_window : float, optional
        Window of the Hampel filter that replaces momentary leaps of inputs, s; at most 15 samples.
    input_threshold : float, optional
        Threshold of the Hampel filter, in local standard deviations.
    median_window : float, optional
        Window of the running median from which smoothing starts, s; at most 31 samples.
    smoothing_half_width : float, optional
        Smallest half width of the smoothing polynomials and length of the shooting intervals, s; at most 25 samples.
        Cross-validation chooses between it and three, nine, ... times its value.
    n_samples, n_nonlinear_samples : int, optional
        Number of random samples of a model that is affine in its parameters, and of others.
    largest_sample : int, optional
        Largest number of rows of each equation in a sample, over the number of parameters.
    n_screening_intervals, n_finalists : int, optional
        Number of intervals on which all hypotheses are scored; number of hypotheses that are scored on all intervals.
    delay_range : (float, float), optional
        Smallest and largest delay of the inputs, s, tried in whole samples before local optimisation.
    max_delay_shifts : int, optional
        Largest number of shifts of the inputs by whole samples after local optimisation.
    substeps : int, optional
        Integration steps per sample; one step is inaccurate by a percent where dry friction changes sign between
        samples or links are light.
    max_starts, max_fits : int, optional
        Largest number of hypotheses that are optimised, and of local optimisations.
    max_steps : int, optional
        Largest number of Gauss-Newton steps of a local optimisation; 0: the best hypothesis is the estimate.
    outliers : bool, optional
        Whether the noise of each signal has outliers; otherwise it is Gaussian.
    neighbouring_starts : bool, optional
        Whether initial states are propagated from neighbouring intervals where that has a higher likelihood.
    gradual_continuity : bool, optional
        Whether the motion is made continuous gradually rather than from the start.
    robust_model_error : bool, optional
        Whether the size of unmodelled accelerations follows the median interval until the first convergence.
    model_error : bool, optional
        Whether the size of unmodelled accelerations is estimated; otherwise they vanish.
    prior_model_error : float, optional
        Prior size of the unmodelled accelerations, over the spread of the accelerations.
    prior_discrepancy, initial_discrepancy : float, optional
        Prior size of input gain and bias discrepancies, over that which equals an equation's inertial force: after, and
        until the first convergence.
    prior_delay : float, optional
        Prior standard deviation of the input delay, s.
    instrumental_variables : bool, optional
        Whether parameters are estimated from the fitted motion by instrumental variables; otherwise they are those of
        the fit.
    prior_inflation : float, optional
        Factor of the prior on model error whose effect on the parameters is added to their covariance.

    Raises
    ------
    SettingsError
        A value is out of range, or of another type.
    """

    criteria: Settings = field(default_factory=Settings)
    stuck_rows: bool = True
    input_window: float = 0.15
    input_threshold: float = 8.0
    median_window: float = 0.31
    smoothing_half_width: float = 0.25
    n_samples: int = 200
    n_nonlinear_samples: int = 100
    largest_sample: int = 4
    n_screening_intervals: int = 12
    n_finalists: int = 12
    delay_range: tuple[float, float] = (-0.03, 0.08)
    max_delay_shifts: int = 3
    substeps: int = 5
    max_starts: int = 5
    max_fits: int = 8
    max_steps: int = 60
    outliers: bool = True
    neighbouring_starts: bool = True
    gradual_continuity: bool = True
    robust_model_error: bool = True
    model_error: bool = True
    prior_model_error: float = 1e-3
    prior_discrepancy: float = 0.1
    initial_discrepancy: float = 0.01
    prior_delay: float = 3e-4
    instrumental_variables: bool = True
    prior_inflation: float = 10.0

    name = "lo-diransac"
    needs_all_signals = False
    uses = (*JUDGING, "initial_state")

    def __post_init__(self) -> None:
        check_used(self.criteria, self.uses, self.name)
        for f in dataclasses.fields(self):
            value = getattr(self, f.name)
            if f.name != "criteria":
                object.__setattr__(self, f.name, _checked(f.name, value, f.default))
        if not self.delay_range[0] <= 0.0 <= self.delay_range[1]:
            raise SettingsError(f"delay_range is {self.delay_range}; give (earliest, latest) in s, with 0 between them")

    def options(self) -> Mapping[str, Any]:
        """All settings but the criteria."""
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "criteria"}
        return {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}

    def fit(self, dataset: Dataset, seed: int, callback: Callback | None = None) -> Estimate:
        """Parameters of the model from the logs, without starting values or thresholds.

        Parameters
        ----------
        dataset : Dataset
        seed : int
            Seed of all random samples.
        callback : callable, optional
            Called with a `Progress` at every stage.

        Returns
        -------
        Estimate

        Raises
        ------
        LogError
            The logs are too short, or sampled at different rates.
        IdentificationError
            No sample gives parameters within their bounds.
        """
        from diransac.identification.methods.lo_diransac.method import estimate

        with single_threaded():  # matrices are small: more threads would only add waiting
            return estimate(self, dataset, int(seed), callback)


def configured(settings: Settings, **options: Any) -> LoDiransac:
    """The method with its own options, and criteria of the evaluation.

    Parameters
    ----------
    settings : Settings
        Criteria.
    options : object
        Other fields of `LoDiransac`.

    Returns
    -------
    LoDiransac
    """
    return LoDiransac(settings, **options)


_MAY_BE_ZERO = ("n_samples", "max_delay_shifts", "max_steps", "prior_model_error", "prior_discrepancy", "prior_delay")


def _checked(name: str, value: Any, default: Any) -> Any:
    """The value as the kind of its default.  Raises SettingsError: it is none, or out of range."""
    least = "at least 0" if name in _MAY_BE_ZERO else "above 0"
    if isinstance(default, bool):
        if not isinstance(value, bool):
            raise SettingsError(f"{name} is {value!r}; give True or False")
        return value
    if isinstance(default, tuple):
        try:
            low, high = (float(x) for x in value)
        except (TypeError, ValueError) as error:
            raise SettingsError(f"{name} is {value!r}; give two numbers") from error
        return low, high
    kinds = (int, np.integer) if isinstance(default, int) else (int, float, np.number)
    if isinstance(value, bool) or not isinstance(value, kinds) or not np.isfinite(value):
        raise SettingsError(f"{name} is {value!r}; give a {'whole ' if isinstance(default, int) else ''}number {least}")
    if value < 0 or (value == 0 and name not in _MAY_BE_ZERO):
        raise SettingsError(f"{name} is {value!r}; give a number {least}")
    return type(default)(value)
