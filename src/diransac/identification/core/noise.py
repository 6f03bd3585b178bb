"""Noise of each signal: a Gaussian, and a uniform of outliers over the signal's range.

References
----------
Torr and Zisserman 2000, "MLESAC"; Dempster, Laird, Rubin 1977 (EM).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from diransac.arrays import BoolArray, FloatArray, row_blocks
from diransac.simulation.compiler import order_statistics, padded_rows

_BREAKDOWN = 0.35
"""Quantile of the sizes of residuals that is a scale while fewer than 65 % of them are outliers."""
_OF_NORMAL = 0.4538
"""That quantile of a standard normal variable."""
_FEWEST = 5
"""Samples of which a scale is estimated at least."""
_SHRINK = 0.4
"""Least factor of a scale in a step, so that large residuals keep some weight at first."""
_FRACTION = (0.002, 0.95)
"""Least and largest fraction of outliers."""
_ROWS_AT_A_TIME = 4096
"""Rows of which densities are computed at a time: they stay in the cache."""
_FAR = 40.0
"""Standard deviations from which on ``exp(-x^2 / 2)`` is 0 in double precision."""


@dataclass(frozen=True, eq=False, repr=False)
class NoiseSums:
    """Sufficient statistics of the noise of each signal; those of disjoint samples add.

    Parameters
    ----------
    weight : (n_s,) array
        Sum of the probabilities that a sample is not an outlier.
    squares : (n_s,) array
        Sum of the squared residuals with these weights, each signal's unit squared.
    count : (n_s,) array
        Number of samples.
    """

    weight: FloatArray
    squares: FloatArray
    count: FloatArray

    @classmethod
    def of(cls, residuals: FloatArray, known: BoolArray, inlying: FloatArray) -> NoiseSums:
        """Sums over samples.

        Parameters
        ----------
        residuals : (N, n_s) array
        known : (N, n_s) bool array
            Samples that are measured.
        inlying : (N, n_s) array
            Result of `Mixture.inlying`.
        """
        weight = np.einsum("ni->i", inlying)
        return cls(weight, np.einsum("ni,ni,ni->i", inlying, residuals, residuals), known.sum(axis=0).astype(float))

    def plus(self, other: NoiseSums, weight: float = 1.0) -> NoiseSums:
        """These sums and others, with a weight of the latter."""
        return NoiseSums(
            self.weight + weight * other.weight,
            self.squares + weight * other.squares,
            self.count + weight * other.count,
        )


@dataclass(frozen=True, eq=False, repr=False)
class Mixture:
    """``(1 - pi) N(0, sigma^2) + pi U(span)``: density of the residuals of each signal.

    Parameters
    ----------
    sigma : (n_s,) array
        Standard deviation of the Gaussian, each signal's unit.
    pi : (n_s,) array
        Fraction of outliers.
    span : (n_s,) array
        Half width of the uniform density, each signal's unit.
    floor : (n_s,) array
        Smallest admissible sigma.
    quaternions : sequence of (int, int, int, int), optional
        Columns of unit quaternions.  Their errors are in the tangent space, which has three dimensions, and isotropic
        there: the four components have one sigma.
    """

    sigma: FloatArray
    pi: FloatArray
    span: FloatArray
    floor: FloatArray
    quaternions: Sequence[tuple[int, int, int, int]] = ()

    @property
    def has_outliers(self) -> BoolArray:
        """Signals ``(n_s,)`` whose fraction of outliers is more than the least that is assumed."""
        return np.asarray(self.pi > _FRACTION[0])

    def inlying(self, residuals: FloatArray, known: BoolArray) -> FloatArray:
        """Probability ``(N, n_s)`` that each sample is not an outlier; 0 where it is missing (the E step)."""
        found = np.empty(residuals.shape)
        for rows in row_blocks(len(residuals), _ROWS_AT_A_TIME):
            core = self._core(residuals[rows], found[rows])
            self._inlying(core, core + self._uniform, known[rows])
        return found

    @property
    def _uniform(self) -> FloatArray:
        """Density ``(n_s,)`` of outliers with their share."""
        return self.pi / (2.0 * self.span)

    def _inlying(self, core: FloatArray, total: FloatArray, known: BoolArray) -> None:
        """Turn the density of the Gaussian into the result of `inlying`."""
        if (self._uniform > 0.0).all():
            core /= total
        else:
            is_possible = total > 0.0
            np.divide(core, total, out=core, where=is_possible)
            core[~is_possible] = 1.0
        if not known.all():
            core *= known

    def negative_log_likelihood(self, residuals: FloatArray, known: BoolArray) -> FloatArray:
        """Negative log-likelihood ``(N, n_s)`` of each sample; 0 where it is missing."""
        found = np.empty(residuals.shape)
        for rows in row_blocks(len(residuals), _ROWS_AT_A_TIME):
            total = self._core(residuals[rows], found[rows])
            total += self._uniform
            self._losses(total, residuals[rows], known[rows])
        return found

    def losses_and_inlying(self, residuals: FloatArray, known: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Results of `negative_log_likelihood` and `inlying`, from the same densities."""
        losses, inlying = np.empty(residuals.shape), np.empty(residuals.shape)
        for rows in row_blocks(len(residuals), _ROWS_AT_A_TIME):
            core = self._core(residuals[rows], inlying[rows])
            total = np.add(core, self._uniform, out=losses[rows])
            self._inlying(core, total, known[rows])
            self._losses(total, residuals[rows], known[rows])
        return losses, inlying

    def loss(self, residuals: FloatArray, known: BoolArray) -> float:
        """Sum of `negative_log_likelihood`."""
        parts = (self.negative_log_likelihood(residuals[k], known[k]).sum() for k in row_blocks(len(residuals)))
        return float(sum(parts))

    def _losses(self, total: FloatArray, residuals: FloatArray, known: BoolArray) -> None:
        """Turn densities into the result of `negative_log_likelihood`."""
        if (self._uniform > 0.0).all():
            np.negative(np.log(total, out=total), out=total)
        else:
            with np.errstate(over="ignore"):
                gaussian = 0.5 * np.square(residuals / self.sigma) + np.log(self.sigma * np.sqrt(2.0 * np.pi))
            total[...] = -np.log(total, out=-gaussian, where=total > 0.0)
        if not known.all():
            total[~known] = 0.0

    def _core(self, residuals: FloatArray, out: FloatArray) -> FloatArray:
        """Density of the Gaussian with its share; exactly 0 beyond 40 sigma, whose squares might overflow."""
        density = np.divide(residuals, self.sigma, out=out)
        np.clip(density, -_FAR, _FAR, out=density)
        np.square(density, out=density)
        density *= -0.5
        np.exp(density, out=density)
        density *= (1.0 - self.pi) / (self.sigma * np.sqrt(2.0 * np.pi))
        return density

    def updated(self, residuals: FloatArray, known: BoolArray, *, outliers: bool = True) -> Mixture:
        """The mixture after an E and an M step.

        A scale shrinks to 0.4 of itself at most, so that large residuals keep some weight at first.

        Parameters
        ----------
        residuals : (N, n_s) array
        known : (N, n_s) bool array
            Samples that are measured.
        outliers : bool, optional
            Whether the fraction of outliers is estimated; otherwise it remains unchanged.

        Returns
        -------
        Mixture
        """
        parts = ((residuals[rows], known[rows]) for rows in row_blocks(len(residuals)))
        sums = (NoiseSums.of(*x, self.inlying(*x)) for x in parts)
        return self.of_sums(reduce(NoiseSums.plus, sums), outliers=outliers)

    def of_sums(self, sums: NoiseSums, *, outliers: bool = True) -> Mixture:
        """The M step from sufficient statistics; see `updated`.

        Parameters
        ----------
        sums : NoiseSums
        outliers : bool, optional

        Returns
        -------
        Mixture
        """
        variance = sums.squares / np.maximum(sums.weight, 1e-9)
        for four in self.quaternions:
            columns = list(four)
            variance[columns] = 4.0 / 3.0 * sums.squares[columns].sum() / max(sums.weight[columns].sum(), 1e-9)
        sigma = np.sqrt(variance)
        sigma = np.maximum(np.maximum(sigma, _SHRINK * self.sigma), self.floor)
        pi = np.clip(1.0 - sums.weight / np.maximum(sums.count, 1), *_FRACTION)
        seen = sums.count >= _FEWEST
        pi = np.where(seen & outliers, pi, self.pi)
        return replace(self, sigma=np.where(seen, sigma, self.sigma), pi=pi)


def lower_scale(residuals: FloatArray, known: BoolArray) -> FloatArray:
    """Robust standard deviation of each column: the 35 % quantile of ``|residual|`` over that of a standard normal.

    Parameters
    ----------
    residuals : (..., N, n_s) array
    known : (N, n_s) or (..., N, n_s) bool array
        Samples that are measured.

    Returns
    -------
    (..., n_s) array
        NaN where fewer than 5 samples are known.
    """
    n = residuals.shape[-2]
    sizes = padded_rows((*residuals.shape[:-2], residuals.shape[-1], n))
    of_rows = sizes[..., :n]
    np.abs(residuals.swapaxes(-1, -2), out=of_rows)
    count = np.array(n)
    if not known.all():
        np.copyto(of_rows, np.inf, where=~known.swapaxes(-1, -2))
        count = np.count_nonzero(known, axis=-2)
    found = order_statistics(sizes, (_BREAKDOWN * count).astype(np.int64))
    return np.where(count >= _FEWEST, found / _OF_NORMAL, np.nan)
