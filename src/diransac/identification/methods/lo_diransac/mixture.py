"""Noise of each signal: a Gaussian, and a uniform of outliers over the signal's range.

References
----------
Torr and Zisserman 2000, "MLESAC"; Dempster, Laird, Rubin 1977 (EM).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diransac.arrays import BoolArray, FloatArray

__all__ = ["BREAKDOWN", "Mixture", "lower_scale"]


# A scale that holds while fewer than 65 % of the residuals are outliers: the 35 % quantile of |r|, and what it is of a
# standard normal variable.
BREAKDOWN, _OF_NORMAL = 0.35, 0.4538
_FEWEST = 5
_SHRINK = 0.4
_FRACTION = (0.002, 0.95)
# Sigmas from which on exp(-x^2 / 2) is 0 in double precision.
_FAR = 40.0


@dataclass(frozen=True)
class Mixture:
    """Scale ``sigma``, outlier fraction ``pi``, range ``span`` and smallest scale ``floor`` of each signal, (n_s,)."""

    sigma: FloatArray
    pi: FloatArray
    span: FloatArray
    floor: FloatArray

    def inlying(self, residuals: FloatArray, known: BoolArray) -> FloatArray:
        """Probability ``(N, n_s)`` that each sample is no outlier; 0 where there is none (the E step)."""
        core = self._core(residuals)
        return np.where(known, core / (core + self.pi / (2.0 * self.span)), 0.0)

    def negative_log_likelihood(self, residuals: FloatArray, known: BoolArray) -> FloatArray:
        """Of each sample, ``(N, n_s)``; 0 where there is none."""
        return np.where(known, -np.log(self._core(residuals) + self.pi / (2.0 * self.span)), 0.0)

    def _core(self, residuals: FloatArray) -> FloatArray:
        """Density of the Gaussian with its share; exactly 0 beyond 40 sigma, whose squares might overflow."""
        distance = np.minimum(np.abs(residuals) / self.sigma, _FAR)
        return np.asarray(np.exp(-0.5 * np.square(distance)) * (1.0 - self.pi) / (self.sigma * np.sqrt(2.0 * np.pi)))

    def updated(
        self, residuals: FloatArray, known: BoolArray, inlying: FloatArray, *, outliers: bool = True
    ) -> Mixture:
        """The M step; a scale shrinks to 0.4 of itself at most, so that large residuals keep some weight at first.

        Parameters
        ----------
        outliers : bool, optional
            Whether the fraction of outliers is estimated; it stays as it is without.
        """
        weight = inlying.sum(axis=0)
        squares = (inlying * np.square(residuals)).sum(axis=0)
        sigma = np.sqrt(squares / np.maximum(weight, 1e-9))
        sigma = np.maximum(np.maximum(sigma, _SHRINK * self.sigma), self.floor)
        count = known.sum(axis=0)
        pi = np.clip(1.0 - weight / np.maximum(count, 1), *_FRACTION)
        seen = count >= _FEWEST
        pi = np.where(seen & outliers, pi, self.pi)
        return Mixture(np.where(seen, sigma, self.sigma), pi, self.span, self.floor)


def lower_scale(residuals: FloatArray, known: BoolArray) -> FloatArray:
    """Robust scale of each column ``(..., n_s)`` of residuals ``(..., N, n_s)``; NaN where there are too few."""
    size = np.where(known, np.abs(residuals), np.inf)
    count = known.sum(axis=-2)
    place = np.maximum((BREAKDOWN * count).astype(int), 0)
    ordered = np.partition(size, np.unique(place), axis=-2)
    found = np.take_along_axis(ordered, place[..., None, :], axis=-2)[..., 0, :]
    return np.where(count >= _FEWEST, found / _OF_NORMAL, np.nan)
