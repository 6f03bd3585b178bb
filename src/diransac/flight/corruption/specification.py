"""What is wrong with a recording: the noise of the paper's Table III, and what else real logs have."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from diransac.errors import SettingsError

__all__ = ["Noise"]

FIRST_ROWS = ("clean", "corrupted")
INTEGRATED = ("white", "random-walk")


@dataclass(frozen=True)
class Noise:
    """What `corrupt` does to a log; ``Noise()`` does nothing.

    Parameters
    ----------
    outlier_probability : pi_o, that a sample is an outlier, each signal of each row on its own
    outlier_magnitude : a_o, each signal's unit; an outlier adds uniform(-a_o, a_o)
    acceleration_std : sigma of x_ddot and z_ddot, m/s^2; of every signal that is a linear acceleration
    rate_std : sigma of theta_dot, rad/s; of every signal that is an angular velocity
    angular_acceleration_std : rad/s^2; None: ``rate_std / dt``, see below.  0 for none
    integrated : "white" or "random-walk", what the Gaussian noise of lower orders is, see below
    first_row : "clean" spares the first row, which simulations start from, Gaussian noise and faults (the paper's
        studies); "corrupted" spares no row
    burst_probability : that a run of consecutive outliers starts, per sample
    burst_length : mean length of such runs, samples
    stuck_probability, stuck_length : the same, of runs that repeat the sample before them
    dropout_probability, dropout_length : the same, of runs that are NaN
    correlated : True: bursts, stuck runs and dropouts occur in the same rows of all signals; False: in rows of
        their own for each signal
    leverage_probability : that a sample gets a one-sided offset, in the rows where ``leverage_signal`` is largest
    leverage_offset : such a sample gets uniform(0, leverage_offset), each signal's unit, either sign
    leverage_signal : the signal or input that decides, such as ``"thrust"``
    leverage_quantile : a row counts if its ``|leverage_signal|`` is above this quantile of the log's
    delay : the signals lag behind the inputs by so many seconds
    quantisation : name -> step, each signal's unit; or one number for all, the step as a fraction of the signal's range

    **Gaussian noise** is drawn with standard deviations, as Table III's units make its "covariances".  With ``dt`` the
    sampling time, a signal's unit decides (deg, rpm and other units are converted; what has no dimension is an angle):

    ===========================================  ==================================================
    m/s^2, m/s, m                                ``sigma, sigma dt, sigma dt^2 / 2`` of acceleration_std
    rad/s, rad                                   ``sigma, sigma dt`` of rate_std
    rad/s^2                                      angular_acceleration_std, or ``rate_std / dt``
    ===========================================  ==================================================

    The paper says that "the covariance was integrated for the lower order terms".  With ``integrated="white"`` that is
    what happens: an error that is held for one sample moves what is integrated from it by ``sigma dt^n / n!`` after
    ``n`` integrations, and each sample of each signal is drawn on its own with that standard deviation: a state
    estimate, which something else keeps from drifting.  With ``"random-walk"`` the errors themselves are integrated
    from the first row on, ``e_v[k+1] = e_v[k] + dt e_a[k]`` and ``e_x[k+1] = e_x[k] + dt e_v[k] + dt^2/2 e_a[k]``:
    dead reckoning, whose velocity is off by ``sigma dt sqrt(k)`` after ``k`` samples.  (Integrating the variance over
    one sample, ``sigma^2 dt``, would need a spectral density, which Table III's units are not.)  The paper gives
    nothing for theta_ddot: the same rule run the other way has ``sigma = rate_std / dt``, the angular acceleration
    that moves the rate by rate_std within one sample.  That is large (at 100 Hz, a hundred times rate_std), and it is
    what decides how well an inertia is identified; ``angular_acceleration_std=0`` takes the paper by its word.

    ============================  ==================================  =================
    Table III                     here                                its range
    ============================  ==================================  =================
    sigma of theta_dot            rate_std                            0.003 to 1.0 rad/s
    sigma of x_ddot, z_ddot       acceleration_std                    0.04 to 2.5 m/s^2
    a_o                           outlier_magnitude                   0 to 100
    pi_o                          outlier_probability                 0.05 to 0.5
    ============================  ==================================  =================

    Raises SettingsError: a value has no meaning.
    References: Dimmig et al. 2023, section IV-E and Table III.
    """

    outlier_probability: float = 0.0
    outlier_magnitude: float = 0.0
    acceleration_std: float = 0.0
    rate_std: float = 0.0
    angular_acceleration_std: float | None = None
    integrated: str = "white"
    first_row: str = "clean"
    burst_probability: float = 0.0
    burst_length: float = 10.0
    stuck_probability: float = 0.0
    stuck_length: float = 10.0
    dropout_probability: float = 0.0
    dropout_length: float = 10.0
    correlated: bool = False
    leverage_probability: float = 0.0
    leverage_offset: float = 0.0
    leverage_signal: str | None = None
    leverage_quantile: float = 0.7
    delay: float = 0.0
    quantisation: Mapping[str, float] | float = 0.0

    def __post_init__(self) -> None:
        fractions = [f.name for f in fields(self) if f.name.endswith(("_probability", "_quantile"))]
        self._check(fractions, 0.0, 1.0, "a number from 0 to 1")
        self._check(
            ["burst_length", "stuck_length", "dropout_length"], 1.0, math.inf, "a finite number from 1, samples"
        )
        self._check(["leverage_offset"], -math.inf, math.inf, "a finite number")
        sizes = ["outlier_magnitude", "acceleration_std", "rate_std", "delay"]
        if self.angular_acceleration_std is not None:
            sizes.append("angular_acceleration_std")
        if not isinstance(self.quantisation, Mapping):
            sizes.append("quantisation")
        self._check(sizes, 0.0, math.inf, "a finite number from 0")
        for name, choices in (("integrated", INTEGRATED), ("first_row", FIRST_ROWS)):
            if getattr(self, name) not in choices:
                raise SettingsError(f"{name} is {getattr(self, name)!r}; choose {' or '.join(map(repr, choices))}")
        if not isinstance(self.correlated, bool):
            raise SettingsError(f"correlated is {self.correlated!r:.60}; give True or False")
        self._check_leverage_signal()
        if isinstance(self.quantisation, Mapping):
            steps = {str(name): _number(f"quantisation of {name!r}", x) for name, x in self.quantisation.items()}
            object.__setattr__(self, "quantisation", steps)

    def _check(self, names: list[str], low: float, high: float, wanted: str) -> None:
        for name in names:
            object.__setattr__(self, name, _number(name, getattr(self, name), low, high, wanted))

    def _check_leverage_signal(self) -> None:
        if self.leverage_signal is None and self.leverage_probability > 0.0:
            raise SettingsError(
                f"leverage_probability is {self.leverage_probability} and no leverage_signal is named; "
                "name the signal or input in whose largest rows the offsets strike"
            )
        if self.leverage_signal is not None and not isinstance(self.leverage_signal, str):
            raise SettingsError(f"leverage_signal is {self.leverage_signal!r}; give a signal's name")

    @property
    def changed(self) -> dict[str, Any]:
        """What differs from ``Noise()``, by name, ready for JSON."""
        return {f.name: value for f in fields(self) if (value := getattr(self, f.name)) != f.default}


def _number(
    name: str, value: object, low: float = 0.0, high: float = math.inf, wanted: str = "a finite number from 0"
) -> float:
    real = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    # An integer that no float holds is compared as it is: it is not converted before it is known to be small.
    if not real or not (low <= value <= high and abs(value) <= sys.float_info.max):  # type: ignore[operator, arg-type]
        raise SettingsError(f"{name} is {value!r:.60}; give {wanted}")
    return float(value)  # type: ignore[arg-type]
