"""How a simulated hypothesis is judged: eq. (2), the inlier fraction, eq. (3), and where the two variants differ."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from diransac.arrays import FloatArray

__all__ = ["Diransac", "InlierBiasedDiransac", "Score", "Variant", "mean_squared_error", "rms_error"]


@dataclass(frozen=True)
class Score:
    """A hypothesis' ``error`` (eq. (2) or its square sibling; infinite where it diverged) and ``inlier_fraction``."""

    error: float = np.inf
    inlier_fraction: float = 0.0


def rms_error(sum_squares: FloatArray, n_rows: int, weights: FloatArray) -> FloatArray:
    """``e = sum_i w_i sqrt(sum_j err_ij^2 / N)``, the weighted RMS model-fit error of every hypothesis, eq. (2).

    Parameters
    ----------
    sum_squares : (n_hypotheses, n_signals)   sum over time of squared errors, infinite where a rollout diverged
    n_rows : N, observations in that sum
    weights : (n_signals,)   w

    Returns (n_hypotheses,).  Signals of zero weight are left out, so they add no 0 times infinity.
    References: Dimmig et al. 2023, eq. (2).
    """
    return _weighted_sum(np.sqrt(sum_squares / n_rows), weights)


def mean_squared_error(sum_squares: FloatArray, n_rows: int, weights: FloatArray) -> FloatArray:
    """``e = sum_i w_i sum_j err_ij^2 / N``: DIRANSAC's error, eq. (2) without the root; shapes as in `rms_error`."""
    return _weighted_sum(sum_squares / n_rows, weights)


def _weighted_sum(errors: FloatArray, weights: FloatArray) -> FloatArray:
    """A sum over signals in their order: its rounding depends on no shape."""
    total = np.zeros(len(errors))
    for i in np.flatnonzero(weights > 0.0):
        total += weights[i] * errors[:, i]
    return total


class Variant(Protocol):
    """The parts in which DIRANSAC and I-DIRANSAC differ."""

    @property
    def name(self) -> str:
        """What users call it."""

    def errors(self, sum_squares: FloatArray, n_rows: int, weights: FloatArray) -> FloatArray:
        """Model-fit error of every hypothesis."""

    def improves(self, new: Score, best: Score) -> bool:
        """Whether a hypothesis is worth more than a look (Algorithm 1, line 19)."""

    def accepts(self, new: Score, best: Score) -> bool:
        """Whether an improving hypothesis is stored (line 20)."""

    def refits(self, *, stored: bool) -> bool:
        """Whether an improving hypothesis hands its inliers to the next one (lines 25-31)."""

    def is_finished(self, best: Score, stop_inlier_fraction: float | None) -> bool:
        """Whether the stored model ends the search early (line 3)."""


@dataclass(frozen=True)
class InlierBiasedDiransac:
    """I-DIRANSAC: RMS error, eq. (3), a refit of the inliers of every improving hypothesis, a stop by inlier fraction.

    Parameters
    ----------
    acceptance_weights : nu = (nu_e, nu_f) of eq. (3)
    """

    acceptance_weights: tuple[float, float] = (1.0, 0.06)
    name: str = "i-diransac"

    def errors(self, sum_squares: FloatArray, n_rows: int, weights: FloatArray) -> FloatArray:
        """Eq. (2)."""
        return rms_error(sum_squares, n_rows, weights)

    def improves(self, new: Score, best: Score) -> bool:
        """More inliers or less error."""
        return new.inlier_fraction > best.inlier_fraction or new.error < best.error

    def accepts(self, new: Score, best: Score) -> bool:
        """``nu_e e^2 + nu_f / f^2`` is less, eq. (3); a term of zero weight is left out."""
        if self.acceptance_weights[1] > 0.0 and new.inlier_fraction == 0.0:
            return False
        return self._cost(new) < self._cost(best)

    def _cost(self, score: Score) -> float:
        for_error, for_inliers = self.acceptance_weights
        # A product overflows to infinity, where a power of a Python float raises.
        cost = for_error * (score.error * score.error) if for_error > 0.0 else 0.0
        if for_inliers > 0.0:
            cost += for_inliers * (1.0 / score.inlier_fraction) ** 2 if score.inlier_fraction > 0.0 else np.inf
        return cost

    def refits(self, *, stored: bool) -> bool:
        """Near misses, too."""
        return True

    def is_finished(self, best: Score, stop_inlier_fraction: float | None) -> bool:
        """The stored fraction of inliers has reached the threshold."""
        return stop_inlier_fraction is not None and best.inlier_fraction >= stop_inlier_fraction


@dataclass(frozen=True)
class Diransac:
    """DIRANSAC, the predecessor: mean squared error, the smallest is stored and refitted, the cap alone ends it.

    References: Dimmig et al. 2023, section III, on its reference [22].
    """

    name: str = "diransac"

    def errors(self, sum_squares: FloatArray, n_rows: int, weights: FloatArray) -> FloatArray:
        """Eq. (2) without the root."""
        return mean_squared_error(sum_squares, n_rows, weights)

    def improves(self, new: Score, best: Score) -> bool:
        """Less error; inliers play no part."""
        return new.error < best.error

    def accepts(self, new: Score, best: Score) -> bool:
        """Whatever improves is stored."""
        return True

    def refits(self, *, stored: bool) -> bool:
        """Only what was stored."""
        return stored

    def is_finished(self, best: Score, stop_inlier_fraction: float | None) -> bool:
        """Never early."""
        return False
