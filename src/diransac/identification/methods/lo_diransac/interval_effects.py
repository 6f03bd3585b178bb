"""Effects of each interval's measurements on parameters, and their sums over neighbouring intervals."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray, IntArray, size_or_one
from diransac.identification.core.equations import linearize
from diransac.identification.core.fit import weights_of
from diransac.identification.regression.uncertainty import student_quantile

if TYPE_CHECKING:
    from diransac.identification.core.fit import Fit
    from diransac.identification.core.windows import Windows

# Fewest batches of correlated intervals.
_BATCHES = 4
# Level of the quantile by which sums of few batches count as sums of many.
_LEVEL = 0.975


@dataclass(frozen=True, eq=False, repr=False)
class EffectOfIntervals:
    """Change of a fit's parameters by each interval's measurements, of its inputs if these are noisy, to first order.

    Parameters
    ----------
    steps : (W, n) array
        Changes; zero in sum at the optimum, without priors.
    covariance : (n, n) array
        Of the parameters by white noise.
    z, s : (W, k, n) and (n_s, n) array
        Result of `Arrowhead.functional` for the parameters.
    """

    steps: FloatArray
    covariance: FloatArray
    z: FloatArray
    s: FloatArray


def effect_of_intervals(intervals: Windows, fit: Fit) -> EffectOfIntervals:
    """Effect of each interval's measurements on the parameters of a fit at its optimum."""
    n_p, n_s, k = intervals.n_p, len(fit.shared), fit.x.shape[1] + fit.d.shape[1]
    at = linearize(intervals, fit, weights_of(intervals, fit))
    z, s = at.system.functional(np.zeros((len(intervals), k, n_p)), np.eye(n_s, n_p))
    steps = np.einsum("wkp,wk->wp", z, at.data_z) + at.data_s @ s
    if intervals.noisy:
        steps -= np.einsum("wep,we->wp", z[:, fit.x.shape[1] :], fit.d / np.square(fit.tau))
    return EffectOfIntervals(steps, s[:n_p], z, s)


def batch_sums(values: FloatArray, usual: int | None = None) -> FloatArray:
    """Sums ``(n_batches, n)`` over neighbouring intervals, whose squares count what neighbours have in common.

    A batch has about sqrt(W) intervals, or as many as a first-order autoregression of a column asks for (Andrews 1991,
    Bartlett's kernel), but a quarter of them at most: a slow current pushes one way for a third of a log.  Sums are
    scaled by Student's t for their number, so that 95 % intervals keep their level with few batches.

    Parameters
    ----------
    values : (W, n) array
        Contributions of the intervals to the error of an estimate.
    usual : int, optional
        Number of rows of a batch, where these are sums over several intervals.
    """
    usual = usual or round(np.sqrt(len(values)))
    sums = _sums_of_batches(values, usual)
    for j, length in enumerate(_correlated(values)):
        if length > usual:
            few = _sums_of_batches(values[:, j], length)
            variance = np.square(few).sum() * len(few) / (len(few) - 1)
            sums[:, j] *= np.sqrt(max(variance / size_or_one(np.square(sums[:, j]).sum()), 1.0))
    return sums


def _sums_of_batches(values: FloatArray, length: int) -> FloatArray:
    """Sums over ``length`` intervals each, increased for their number."""
    sums = np.add.reduceat(values, np.arange(0, len(values), length), axis=0)
    return np.asarray(sums * student_quantile(max(len(sums) - 1, 1), _LEVEL) / NormalDist().inv_cdf(_LEVEL))


def _correlated(values: FloatArray) -> IntArray:
    """Intervals ``(n,)`` that a batch of each column takes by its correlation with the next interval."""
    power = size_or_one(np.square(values).sum(axis=0))
    rho = np.clip((values[1:] * values[:-1]).sum(axis=0) / power, 0.0, 1.0 - 1.0 / len(values))
    alpha = np.square(2.0 * rho / ((1.0 - rho) * (1.0 + rho)))
    wanted = np.ceil(1.1447 * np.cbrt(alpha * len(values)))
    return np.asarray(np.minimum(wanted, len(values) // _BATCHES), int)
