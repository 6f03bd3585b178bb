"""Parameters of parts of the logs, compared with each other: of halves and tenths of their time, and of every log.

Parts are compared without another fit.  Where the model is not exact, parameters are projected again from a part of the
intervals, and the others are predicted with them.  Where it is exact, each interval has a contribution to the
parameters and an information, so that those of a part follow from sums: Cochran's test of homogeneity.

References
----------
Chow 1960 (parameters of parts of a sample); Cochran 1954 (homogeneity of estimates).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.identification.core.equations import variances_of_intervals
from diransac.identification.core.fit import weights_of
from diransac.identification.methods.lo_diransac.interval_effects import batch_sums, effect_of_intervals
from diransac.identification.methods.lo_diransac.motion_equations import means_of_intervals, residuals_of_motion
from diransac.identification.methods.lo_diransac.projection import least_squares_gains, means_of_windows

if TYPE_CHECKING:
    from diransac.identification.core.fit import Fit
    from diransac.identification.core.windows import ShootingIntervals
    from diransac.identification.methods.lo_diransac.local_search import Explanation
    from diransac.identification.methods.lo_diransac.projection import ProjectedEstimate

# A difference of parameters: so many standard errors, and this part of the parameter.
_CLEAR, _DIFFERENT = 4.0, 0.03
# Parts of the logs that are predicted by the rest; mean square of what the model leaves of them, over what it is for
# parameters that do not change, from which on it is no chance; standard errors by which the parameter that changed most
# differs then, and probability that any of the others differs as much by chance.
_HELD_OUT, _WORSE, _LIKELY, _UNLIKELY = 5, 1.25, 2.0, 0.05
# Parts whose parameters an exact model must have in common; normal deviation of a difference that is no chance, of a
# probability of 1e-4; part of a parameter that is negligible; information about a direction of the parameters, over the
# largest, that is rounding.
_STRETCHES, _BY_CHANCE, _NEGLIGIBLE, _ROUNDING = 10, 3.72, 2e-4, 1e-9
# Residual of an equation over that of the worst, at least.
_SMALLEST = 1e-6
_TINY = 1e-300
# Intervals of half the logs from which parameters and their scatter are estimated, at least.
_FEWEST_INTERVALS = 9


@dataclass(frozen=True, eq=False)
class Change:
    """A parameter that differs between the halves of the logs: a payload, a battery, a machine that wears.

    Parameters
    ----------
    index : int
        Of the parameter.
    halves : (2, n) array
        All parameters of each half.
    """

    index: int
    halves: FloatArray

    @property
    def first(self) -> float:
        """Its value in the first half, its unit."""
        return float(self.halves[0, self.index])

    @property
    def second(self) -> float:
        """Its value in the second half, its unit."""
        return float(self.halves[1, self.index])

    @property
    def apart(self) -> float:
        """Difference over the mean of both."""
        return abs(self.first - self.second) / max(0.5 * (abs(self.first) + abs(self.second)), _TINY)

    @property
    def variance(self) -> float:
        """Variance over the log of a parameter that changes uniformly, with these means over its halves."""
        return (self.first - self.second) ** 2 / 3.0


@dataclass(frozen=True)
class Deviation:
    """The part of the logs that agrees least with the others, where the model is exact.

    Parameters
    ----------
    begin, end : float
        The part, over the duration of each log.
    scatter : float
        Scatter of the parameters of all parts, over that by noise (RMS).
    index : int
        Parameter that changes most, over its value, if this part is left out.
    change : float
        That change.
    """

    begin: float
    end: float
    scatter: float
    index: int
    change: float


@dataclass(frozen=True)
class Parts:
    """Parameters that are estimated again from parts of the logs.

    Parameters
    ----------
    changes : sequence of Change, optional
        Parameters that clearly differ between the halves; none where the model is exact.
    held_out : float, optional
        Mean square of what the model leaves of fifths of the logs whose parameters are those of the rest, over that of
        the fit, and over what this is on average for parameters that do not change.
    deviation : Deviation, optional
        Of the part that deviates most from an exact model, if parts differ by more than noise explains.
    """

    changes: Sequence[Change] = ()
    held_out: float = 1.0
    deviation: Deviation | None = None

    @property
    def fail_elsewhere(self) -> bool:
        """True if parameters of some parts predict others clearly worse than chance allows."""
        return self.held_out > _WORSE


def compared_parts(found: Explanation, result: ProjectedEstimate) -> Parts:
    """Parameters of parts of the logs, compared with each other.

    Parameters
    ----------
    found : Explanation
    result : ProjectedEstimate

    Returns
    -------
    Parts
    """
    intervals, fit = found.intervals, found.refinement.fit
    place = np.arange(len(intervals)) - np.searchsorted(intervals.log_of, intervals.log_of)
    share = place / np.bincount(intervals.log_of)[intervals.log_of]
    if found.exact:
        return _deviating(intervals, fit, result, share)
    return _changing(intervals, fit, result, share)


def _changing(intervals: ShootingIntervals, fit: Fit, result: ProjectedEstimate, share: FloatArray) -> Parts:
    """Halves and held-out fifths of the logs, where the model is not exact."""
    share = share[result.windows]
    first = share < 0.5
    if min(first.sum(), (~first).sum()) < _FEWEST_INTERVALS:
        return Parts()
    equations = _equations(intervals, fit, result)
    held_out = _held_out(*equations, (_HELD_OUT * share).astype(int))
    moved, apart = _of_halves(*equations, first)
    apart[np.isinf(np.diag(result.covariance))] = 0.0
    changed = np.abs(apart) > _clear(apart, held_out)
    halves = result.parameters + moved
    both = [Change(int(k), halves) for k in np.flatnonzero(changed)]
    return Parts([x for x in both if x.apart > _DIFFERENT], held_out)


def _clear(apart: FloatArray, held_out: float) -> FloatArray:
    """Standard errors ``(n,)`` beyond which a difference of parameters, so many standard errors, is no chance."""
    if held_out <= _WORSE:
        return np.full(len(apart), _CLEAR)
    from statistics import NormalDist

    of_any = NormalDist().inv_cdf(1.0 - 0.5 * _UNLIKELY / len(apart))
    return np.where(np.abs(apart) == np.abs(apart).max(), _LIKELY, min(of_any, _CLEAR))


def _equations(intervals: ShootingIntervals, fit: Fit, result: ProjectedEstimate) -> tuple[FloatArray, FloatArray]:
    """Regressors (W, n_v, n) and residuals (W, n_v) of the fitted motion, in the mean over each window."""
    _, rows, regressors, _ = residuals_of_motion(intervals, fit, result.parameters)
    W = means_of_intervals(intervals, regressors * intervals.counted[:, None, None])
    residuals = means_of_intervals(intervals, rows * intervals.counted[:, None])
    return means_of_windows(W, result.windows), means_of_windows(residuals, result.windows)


def _of_halves(W: FloatArray, residuals: FloatArray, first: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Changes (2, n) of the parameters in the first and the second half; their difference (n,), in standard errors."""
    moved, variances = zip(*(_change(W[half], residuals[half]) for half in (first, ~first)), strict=True)
    return np.array(moved), (moved[1] - moved[0]) / np.sqrt(np.maximum(np.sum(variances, axis=0), _TINY))


def _held_out(W: FloatArray, residuals: FloatArray, part: IntArray) -> float:
    """Mean square of the residuals of each part with the parameters of the others, over that with those of all.

    Of n parameters that do not change, fitted to N residuals, that of all is ``1 - n/N`` times that of the noise, and
    that of a part ``1 + n/N'``, with N' residuals of the others.  The ratio of these two counts as 1.
    """
    scale = _scales(residuals)
    fitted = residuals + W @ _change(W, residuals)[0]
    left = np.zeros_like(residuals)
    for k in np.unique(part):
        held = part == k
        left[held] = residuals[held] + W[held] @ _change(W[~held], residuals[~held])[0]
    taken = _n_estimated(W) / residuals.size
    usual = (1.0 + taken * _HELD_OUT / (_HELD_OUT - 1.0)) / max(1.0 - taken, _TINY)
    return float(np.square(left / scale).sum() / max(np.square(fitted / scale).sum() * usual, _TINY))


def _deviating(intervals: ShootingIntervals, fit: Fit, result: ProjectedEstimate, share: FloatArray) -> Parts:
    """Tenths of the logs, where the model is exact; no deviation if all agree, or if its effect is negligible.

    The measurements of part k change the parameters by ``u_k``, of variance ``V_k`` if the model is exact and the noise
    white.  ``sum u_k V_k^-1 u_k`` then has a chi-squared distribution.
    """
    n, part = len(result.parameters), (_STRETCHES * share).astype(int)
    effect = effect_of_intervals(intervals, fit)
    variances = variances_of_intervals(intervals, fit, weights_of(intervals, fit), effect.z, effect.s)
    unit = np.sqrt(np.diag(effect.covariance)) + _TINY
    if not (np.isfinite(variances).all() and np.isfinite(effect.steps).all()):  # LAPACK would raise
        return Parts()
    u = np.array([effect.steps[part == k].sum(axis=0) for k in range(_STRETCHES)]) / unit
    V = np.array([variances[part == k].sum(axis=0) for k in range(_STRETCHES)]) / np.outer(unit, unit)
    sizes, axes = np.linalg.eigh(V)
    informed = sizes > _ROUNDING * sizes[:, -1:]
    along = np.einsum("kij,ki->kj", axes, u)
    distances = np.divide(np.square(along), sizes, out=np.zeros_like(sizes), where=informed).sum(axis=1)
    freedom = int(informed.sum()) - n
    if freedom < 1 or not _is_no_chance(float(distances.sum()), freedom):
        return Parts()
    k, scatter = int(np.argmax(distances)), float(np.sqrt(distances.sum() / freedom))
    R = effect.covariance / np.outer(unit, unit)
    without = R @ np.linalg.lstsq(R - V[k], -u[k], rcond=None)[0]
    changes = np.abs(without) * unit / np.maximum(np.abs(result.parameters), _TINY)
    worst, edges = int(np.argmax(changes)), (k / _STRETCHES, (k + 1) / _STRETCHES)
    most = Deviation(*edges, scatter, worst, float(changes[worst]))
    return Parts(deviation=most if most.change > _NEGLIGIBLE else None)


def _is_no_chance(distance: float, freedom: int) -> bool:
    """True if chi squared is hardly ever as large, by its cube root, which is nearly normal (Wilson, Hilferty 1931)."""
    spread = 2.0 / (9.0 * freedom)
    return bool(np.cbrt(distance / freedom) - (1.0 - spread) > _BY_CHANCE * np.sqrt(spread))


def _change(W: FloatArray, residuals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Change ``(n,)`` of parameters by least squares of some rows, and its variance by batches of them.

    What is left of N residuals is too small by what n parameters have taken of them, ``1 - n/N`` on average.
    """
    gains = least_squares_gains(W, 1.0 / _scales(residuals))
    change = -np.einsum("pwi,wi->p", gains, residuals)
    left = residuals + W @ change
    sums = batch_sums(np.einsum("pwi,wi->wp", gains, left))
    return change, np.square(sums).sum(axis=0) / max(1.0 - _n_estimated(W) / residuals.size, _TINY)


def _n_estimated(W: FloatArray) -> int:
    """Number of parameters that have a part in the regressors."""
    return int(W.any(axis=(0, 1)).sum())


def _scales(residuals: FloatArray) -> FloatArray:
    """Size ``(n_v,)`` of the residuals of each equation."""
    scale = np.sqrt(np.square(residuals).mean(axis=0))
    return np.asarray(np.maximum(scale, _SMALLEST * scale.max() + _TINY))
