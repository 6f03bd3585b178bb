"""Rates at which parameters drift, from how much windows differ from what was known before them.

A parameter that drifts is a random walk whose variance grows by q per second.  The estimate of a window alone differs
from that of everything before by more than their variances then.  The rate is the likeliest of a grid, with 0 as long
as another is not clearly likelier.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from diransac.arrays import BoolArray, FloatArray

__all__ = ["Drift"]

# Standard deviations of the changes in a second, over the size of a parameter.
_RATES = np.concatenate([[0.0], np.logspace(-6.0, -1.0, 16)])
# Gain of the log-likelihood from which on a parameter drifts, and time over which it is remembered, s.
_CLEAR, _MEMORY = 3.0, 60.0
# Degrees of freedom of the differences: one window that differs by very much is no drift.
_TAIL = 4.0
# Part of the variance of a difference that is no drift at least.
_LEAST = 0.05


class Drift:
    """Random walks of the parameters.

    Parameters
    ----------
    names : tuple of str
    given : mapping of str to float
        Standard deviations of the changes in a second, of parameters whose drift is not estimated.
    """

    def __init__(self, names: tuple[str, ...], given: Mapping[str, float]) -> None:
        self.given = np.array([given.get(name, np.nan) for name in names])
        self.likelihood = np.zeros((len(names), len(_RATES)))
        self.rate = np.nan_to_num(np.square(self.given))

    def learn(
        self, values: FloatArray, size: FloatArray, information: FloatArray, window: float, weight: float
    ) -> None:
        """Update the rates by the difference of a window from what was known before it.

        Parameters
        ----------
        values : (n,) array
            Parameters.
        size, information : (n,) array
            Differences, and their inverse variances; 0 of those that are not determined or not to be counted.
        window : float
            Duration of the window, s.
        weight : float
            Part of the window that is new.
        """
        known = information > 0.0
        variance = 1.0 / np.where(known, information, 1.0)
        rates = np.square(np.abs(values)[:, None] * _RATES)
        more = (rates - self.rate[:, None]) * window
        total = np.maximum(variance[:, None] + more, _LEAST * variance[:, None])
        gain = -0.5 * (np.log(total) + (_TAIL + 1.0) * np.log1p(np.square(size)[:, None] / (_TAIL * total)))
        self.likelihood *= np.exp(-weight * window / _MEMORY)
        self.likelihood[known] += weight * gain[known]
        best = np.argmax(self.likelihood, axis=1)
        clear = self.likelihood.max(axis=1) > self.likelihood[:, 0] + _CLEAR
        own = np.arange(len(best))
        estimated = np.where(clear, rates[own, best], 0.0)
        self.rate = np.where(np.isnan(self.given), estimated, np.square(self.given))

    @property
    def drifting(self) -> BoolArray:
        """Parameters ``(n,)`` that drift."""
        return np.asarray(self.rate > 0.0)
