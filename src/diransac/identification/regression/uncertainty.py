"""Standard errors from the log itself: a delete-a-block jackknife in time."""

from __future__ import annotations

import math
from functools import cache, lru_cache
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.errors import ResultError, SettingsError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from diransac.identification.regression.estimators import BoundEstimator
    from diransac.model import Parameter

# Few and long: intervals have their nominal coverage while residuals are correlated over up to an eighth of a stretch
# (tests/test_uncertainty.py), 0.3 s of a log of 25 s; with 30 stretches it would be 0.1 s.
N_BLOCKS = 10
CLEAR = 3.0
"""Standard errors from which on a difference is no chance."""
# Draws at a time.
_N_DRAWS = 1000


def jackknife_covariance(
    estimator: BoundEstimator, rows: IntArray, log_sizes: Sequence[int] | None = None
) -> FloatArray:
    """Covariance ``(n_p, n_p)`` of an estimate from ``rows``, by leaving out 10 stretches of time in turn.

    Residuals of real machines are correlated over many samples, for which the textbook formula is too optimistic; a
    stretch that is left out contains its correlations.  A bias that all stretches share, such as that of noise in the
    regressors, is not included.

    Parameters
    ----------
    estimator : BoundEstimator
    rows : (n,) int array
        Usable rows that the estimate was fitted to, ascending.
    log_sizes : sequence of int, optional
        Usable rows of each log, where logs have parameters of their own: a stretch is then a tenth of every log, so
        that no log is left out.  None: rows are taken as one log.

    Returns
    -------
    (n_p, n_p) array
        Infinite where a parameter is not identifiable without one of the stretches.

    References
    ----------
    Künsch 1989, "The jackknife and the bootstrap for general stationary observations"; Busing, Meijer, van der Leeden
    1999, "Delete-m jackknife for unequal m".
    """
    logs = np.split(rows, np.searchsorted(rows, np.cumsum(log_sizes or [estimator.n_rows])[:-1]))
    stretches = [np.array_split(log, min(N_BLOCKS, len(rows))) for log in logs]
    groups = [g for parts in zip(*stretches, strict=True) if len(g := np.concatenate(parts))]
    fits = estimator.fit_without(groups, rows)
    n = len(fits)
    determined = estimator.select([rows_without(rows, group) for group in groups]).well_defined()
    if n < 2 or not determined.all() or not np.isfinite(fits).all():
        return np.full((fits.shape[1], fits.shape[1]), np.inf)
    deviations = fits - fits.mean(axis=0)
    covariance: FloatArray = np.einsum("ni,nj->ij", deviations, deviations) * (n - 1) / n
    return covariance


def rows_without(rows: IntArray, group: IntArray) -> IntArray:
    """Rows ``(n,)``, ascending, without those of a group, which are among them."""
    left = np.ones(len(rows), bool)
    left[np.searchsorted(rows, group)] = False
    return rows[left]


def score_inflation(scores: FloatArray, information: FloatArray, variance: float) -> float:
    """Variance of sums of scores over 10 stretches of time, over that of white residuals; one at least.

    Rows with correlated residuals determine the parameters as so many times fewer rows with white ones would.

    Parameters
    ----------
    scores : (N, n) array
        Product of the regressors and the residuals of each row, at the least squares of all.
    information : (n, n) array
        Sum of the products of the regressors.
    variance : float
        Of the residuals.

    Returns
    -------
    float
        Mean over the directions of the parameters.

    References
    ----------
    White 1982 (the sandwich); Kish 1965 (design effect).
    """
    n_blocks, n = min(N_BLOCKS, len(scores)), scores.shape[1]
    sums = np.add.reduceat(scores, np.linspace(0, len(scores), n_blocks, endpoint=False).astype(int))
    # A ridge makes the information of an undetermined parameter definite.
    definite = information + 1e-10 * len(scores) * np.eye(n)
    observed = (sums * np.linalg.solve(definite, sums.T).T).sum() * n_blocks / max(1, n_blocks - 1)
    ratio = observed / (n * variance) if variance > 0.0 else 1.0
    return max(1.0, float(ratio)) if np.isfinite(ratio) else 1.0


def combined(
    p: FloatArray, covariance: FloatArray, places: IntArray, mean: FloatArray, variance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Gaussian estimate combined with independent Gaussian knowledge of some parameters.

    ``p + K (m - H p)`` and ``C - K H C`` with ``K = C H' (H C H' + S)^-1``, where H selects the parameters.

    Parameters
    ----------
    p : (n,) array
    covariance : (n, n) array
        C; parameters of infinite variance are left as they are.
    places : (k,) int array
        Positions of the parameters that are known.
    mean, variance : (k,) array
        m and the diagonal of S.

    Returns
    -------
    (n,) array, (n, n) array
    """
    finite = np.isfinite(np.diag(covariance))
    among = finite[places]
    places, mean, variance = places[among], mean[among], variance[among]
    C = np.where(np.outer(finite, finite), covariance, 0.0)
    scale = np.sqrt(np.diag(C)[places] + variance)
    inner = (C[np.ix_(places, places)] + np.diag(variance)) / np.outer(scale, scale)
    K = np.linalg.solve(inner, C[places] / scale[:, None]).T / scale
    less = C - K @ C[places]
    return p + K @ (mean - p[places]), np.where(np.outer(finite, finite), 0.5 * (less + less.T), covariance)


def students_draws(
    mean: FloatArray, covariance: FloatArray, degrees_of_freedom: int, bounds: Sequence[Parameter], n: int, seed: int
) -> FloatArray:
    """Draws ``(n_p, n)`` from Student's t within bounds, the first of which do not depend on their number.

    Parameters
    ----------
    mean : (n_p,) array
    covariance : (n_p, n_p) array
        Of the estimate, finite: the squared scale of the distribution.
    degrees_of_freedom : int
    bounds : sequence of Parameter
    n, seed : int

    Returns
    -------
    (n_p, n) array

    Raises
    ------
    ResultError
        Next to no draws are within the bounds, or the covariance is none.
    """
    rng, kept, n_drawn = np.random.default_rng(seed), np.zeros((len(mean), 0)), 0
    while kept.shape[1] < n:
        try:
            normal = rng.multivariate_normal(np.zeros(len(mean)), covariance, _N_DRAWS, "ignore", method="eigh").T
        except np.linalg.LinAlgError as error:
            raise ResultError(
                "the covariance has no eigenvalues in floating point; identify from other data"
            ) from error
        draws = mean[:, None] + normal / np.sqrt(rng.chisquare(degrees_of_freedom, _N_DRAWS) / degrees_of_freedom)
        inside = np.all([x.admits(own) for x, own in zip(bounds, draws, strict=True)], axis=0)
        kept, n_drawn = np.hstack([kept, draws[:, inside]]), n_drawn + _N_DRAWS
        if kept.shape[1] < 1e-3 * n_drawn:
            raise ResultError(
                f"{kept.shape[1]} of {n_drawn} draws are within the bounds of the parameters; identify from more data, "
                "or fix the parameters that are uncertain"
            )
    return kept[:, :n]


def two_sided(
    level: float, quantile: Callable[[float], float], values: Mapping[str, float], errors: Mapping[str, float]
) -> dict[str, tuple[float, float]]:
    """Interval of each value at a level.  Raises SettingsError: the level is not between 0 and 1."""
    if not 0.0 < level < 1.0:
        raise SettingsError(f"level is {level}; give a number between 0 and 1, such as 0.95")
    width = quantile(0.5 + level / 2.0)
    return {n: (x - width * errors[n], x + width * errors[n]) for n, x in values.items()}


@lru_cache(maxsize=256)
def student_quantile(degrees_of_freedom: float, probability: float) -> float:
    """Quantile of Student's t distribution, accurate to about twelve digits.

    The density of ``theta = atan(t / sqrt(n))`` is proportional to ``cos(theta)^(n - 1)``.  Newton's method inverts its
    integral, which is concave from 0 on, so that steps from there never pass the solution.  `scipy.special` gives the
    same, but its import takes as long as an identification.

    Parameters
    ----------
    degrees_of_freedom : float
        n, at least 1.
    probability : float
        From 0.5 to below 1.

    Returns
    -------
    float
    """
    n, (points, weights) = degrees_of_freedom, _quadrature()

    def density(theta: FloatArray | float) -> FloatArray:
        return np.asarray(np.exp(0.5 * (n - 1.0) * np.log1p(-np.square(np.sin(theta)))))

    def integral(theta: float) -> float:
        return 0.5 * theta * float(weights @ density(0.5 * theta * (points + 1.0)))

    # Beyond nine standard deviations a normal distribution has nothing, to rounding errors.
    whole, theta = integral(min(0.5 * math.pi, 9.0 / math.sqrt(n))), 0.0
    for _ in range(100):
        step = ((2.0 * probability - 1.0) * whole - integral(theta)) / float(density(theta))
        theta += step
        if step <= 1e-15 * theta:
            break
    return math.sqrt(n) * math.tan(theta)


@cache
def _quadrature() -> tuple[FloatArray, FloatArray]:
    """Points and weights of Gauss-Legendre quadrature on [-1, 1]."""
    return np.polynomial.legendre.leggauss(100)
