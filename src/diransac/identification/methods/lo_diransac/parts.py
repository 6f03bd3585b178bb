"""Parameters of parts of the logs, compared with each other: findings where they differ by more than chance.

Parts are compared without another fit.  Where the model is not exact, parameters are projected again from halves and
fifths of the intervals, and the other intervals are predicted with them.  Where it is exact, each interval has a
contribution to the parameters and an information, so that those of tenths follow from sums: Cochran's test of
homogeneity.

References
----------
Chow 1960 (parameters of parts of a sample); Cochran 1954 (homogeneity of estimates).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray, IntArray, size_or_one
from diransac.identification.core.equations import variances_of_intervals
from diransac.identification.core.fit import weights_of
from diransac.identification.core.rows import Rows, solve
from diransac.identification.estimate import Disagreement
from diransac.identification.finding import Finding
from diransac.identification.methods.lo_diransac.interval_effects import batch_sums, effect_of_intervals
from diransac.identification.methods.lo_diransac.motion_equations import means_of_intervals, residuals_of_motion
from diransac.identification.methods.lo_diransac.projection import means_of_windows
from diransac.identification.methods.lo_diransac.term_regression import ROUNDING
from diransac.text_table import number, percent

if TYPE_CHECKING:
    from diransac.identification.core.fit import Fit
    from diransac.identification.core.windows import Windows
    from diransac.identification.methods.lo_diransac.local_search import Explanation
    from diransac.identification.methods.lo_diransac.projection import ProjectedEstimate

# Windows of half the logs from which parameters and their scatter are estimated, at least.
_FEWEST = 9
# Standard errors of a difference of halves that is no chance, by itself.
_CLEAR = 4.0
# Probability of a difference by chance, where held-out parts show that parameters change.
_UNLIKELY = 0.05
# Difference of halves over the parameter, at least.
_DIFFERENT = 0.03
# Parts that are predicted by the others.
_FIFTHS = 5
# Mean square of what the model leaves of held-out parts over its expectation, from which on parameters change.
_WORSE = 1.25
# Parts whose parameters an exact model must have in common.
_TENTHS = 10
# Normal deviation of a scatter that is no chance, of a probability of 1e-4.
_BY_CHANCE = 3.72
# Relative change of a parameter without a part that is no matter.
_NEGLIGIBLE = 2e-4


@dataclass(frozen=True, eq=False)
class Parts:
    """Parameters of parts of the logs.

    Parameters
    ----------
    variances : (n,) array
        Variances of parameters that change during the logs, as if uniformly; 0 for the others.
    findings : tuple of Finding, optional
        Of parts that the others do not predict, or whose parameters scatter more than by noise.
    disagreements : tuple of Disagreement, optional
        Parameters that change during the logs.
    """

    variances: FloatArray
    findings: tuple[Finding, ...] = ()
    disagreements: tuple[Disagreement, ...] = ()


def compared_parts(found: Explanation, result: ProjectedEstimate) -> Parts:
    """Parameters of parts of the logs, compared with each other: halves and fifths, or tenths if the model is exact."""
    intervals, fit = found.intervals, found.refinement.fit
    place = np.arange(len(intervals)) - np.searchsorted(intervals.log_of, intervals.log_of)
    share = place / np.bincount(intervals.log_of)[intervals.log_of]
    if found.exact:
        deviation = _deviation(intervals, fit, result, (_TENTHS * share).astype(int))
        return Parts(np.zeros(len(result.parameters)), deviation)
    return _changing(intervals, fit, result, share[result.windows])


def _changing(intervals: Windows, fit: Fit, result: ProjectedEstimate, share: FloatArray) -> Parts:
    """Halves and held-out fifths of the logs, where the model is not exact."""
    names, first, n = intervals.layout.names, share < 0.5, len(result.parameters)
    if min(first.sum(), (~first).sum()) < _FEWEST:
        return Parts(np.zeros(n))
    W, residuals = _equations(intervals, fit, result)
    (before, of_first), (after, of_second) = (_change(W[half], residuals[half]) for half in (first, ~first))
    apart = np.abs(after - before) / np.sqrt(size_or_one(of_first + of_second))
    apart[np.isinf(np.diag(result.covariance))] = 0.0
    least, findings = np.full(n, _CLEAR), tuple[Finding, ...]()
    worse = _held_out(W, residuals, (_FIFTHS * share).astype(int))
    if worse > _WORSE:
        # Some parameter has changed: the clearest one is likely, any other that would not differ so by chance.
        tested = np.where(apart == apart.max(), 1, n)
        least = np.minimum([NormalDist().inv_cdf(1.0 - 0.5 * _UNLIKELY / m) for m in tested.tolist()], _CLEAR)
        text = f"Fifths of the log that are held out have {percent(np.sqrt(worse) - 1.0)} more unmodelled force (RMS)"
        text = f"{text} than in the fit of all, so that what is estimated from one part fails in another."
        findings = (Finding("note", text),)
    halves = result.parameters + np.array([before, after])
    difference, size = halves[1] - halves[0], 0.5 * np.abs(halves).sum(axis=0)
    changed = (apart > least) & (np.abs(difference) > _DIFFERENT * size)
    disagreements = tuple(_disagreement(names, halves, result.parameters, k) for k in np.flatnonzero(changed).tolist())
    # Of a parameter that changes uniformly, with these means over its halves.
    return Parts(np.where(changed, np.square(difference) / 3.0, 0.0), findings, disagreements)


def _disagreement(names: Sequence[str], halves: FloatArray, parameters: FloatArray, k: int) -> Disagreement:
    """The k-th parameter changes, as do the parameters of both halves ``(2, n)``."""
    first, second = (number(x, 3) for x in halves[:, k].tolist())
    text = f"{names[k]} changes during the log, from {first} in its first half to {second} in its second"
    half = halves[int(np.argmax(np.abs(halves[:, k] - parameters[k])))]
    return Disagreement(
        f"{text}, as by a payload, a drifting gain or another regime",
        "identify stretches of the log one by one, with --from and --until",
        names[k],
        dict(zip(names, half.tolist(), strict=True)),
    )


def _equations(intervals: Windows, fit: Fit, result: ProjectedEstimate) -> tuple[FloatArray, FloatArray]:
    """Regressors (W, n_v, n) and residuals (W, n_v) of the fitted motion, in the mean over each window."""
    _, rows, regressors, _ = residuals_of_motion(intervals, fit, result.parameters)
    W = means_of_intervals(intervals, regressors * intervals.counted[:, None, None])
    residuals = means_of_intervals(intervals, rows * intervals.counted[:, None])
    return means_of_windows(W, result.windows), means_of_windows(residuals, result.windows)


def _held_out(W: FloatArray, residuals: FloatArray, part: IntArray) -> float:
    """Mean square of the residuals of each part with the parameters of the others, over that with those of all.

    Of n parameters that do not change, fitted to N residuals, that of all is ``1 - n/N`` times that of the noise, and
    that of a part ``1 + n/N'``, with N' residuals of the others.  The ratio of these two counts as 1.
    """
    scale = _scales(residuals)
    fitted, left = residuals + W @ _change(W, residuals)[0], np.zeros_like(residuals)
    for k in np.unique(part):
        held = part == k
        left[held] = residuals[held] + W[held] @ _change(W[~held], residuals[~held])[0]
    usual = (1.0 + (1.0 - _free(W)) * _FIFTHS / (_FIFTHS - 1.0)) / _free(W)
    return float(np.square(left / scale).sum() / size_or_one(np.square(fitted / scale).sum() * usual))


def _deviation(intervals: Windows, fit: Fit, result: ProjectedEstimate, part: IntArray) -> tuple[Finding, ...]:
    """The part that agrees least with the others, where the model is exact; none if all agree, or if it is no matter.

    The measurements of part k change the parameters by ``u_k``, of variance ``V_k`` if the model is exact and the noise
    white.  ``sum u_k V_k^-1 u_k`` then has a chi-squared distribution.
    """
    names, n = intervals.layout.names, len(result.parameters)
    effect = effect_of_intervals(intervals, fit)
    variances = variances_of_intervals(intervals, fit, weights_of(intervals, fit), effect.z, effect.s)
    if not (np.isfinite(variances).all() and np.isfinite(effect.steps).all()):  # LAPACK would raise
        return ()
    unit = size_or_one(np.sqrt(np.diag(effect.covariance)))
    u = np.array([effect.steps[part == k].sum(axis=0) for k in range(_TENTHS)]) / unit
    V = np.array([variances[part == k].sum(axis=0) for k in range(_TENTHS)]) / np.outer(unit, unit)
    information = np.linalg.pinv(V, ROUNDING, hermitian=True)
    distances = np.einsum("ki,kij,kj->k", u, information, u)
    freedom = round(np.einsum("kij,kji->", information, V)) - n
    if freedom < 1 or not _is_no_chance(float(distances.sum()), freedom):
        return ()
    k, scatter = int(np.argmax(distances)), float(np.sqrt(distances.sum() / freedom))
    R = effect.covariance / np.outer(unit, unit)
    without = R @ np.linalg.lstsq(R - V[k], -u[k], rcond=None)[0]
    changes = np.abs(without) * unit / size_or_one(np.abs(result.parameters))
    worst = int(np.argmax(changes))
    if changes[worst] <= _NEGLIGIBLE:
        return ()
    text = f"Parts of the log disagree on the parameters {number(scatter, 2)} times as much as by noise"
    where = f"most between {percent(k / _TENTHS)} and {percent((k + 1) / _TENTHS)} of its duration"
    effects = f"without that part {names[worst]} changes by {percent(float(changes[worst]))}"
    claim = f"{text}, {where}, so that {effects}; intervals are too narrow, or the model lacks an effect"
    return (Finding("care", claim, "look at that part, or leave it out with --leave-out"),)


def _is_no_chance(distance: float, freedom: int) -> bool:
    """True if chi squared is hardly ever as large, by its cube root, which is nearly normal (Wilson, Hilferty 1931)."""
    spread = 2.0 / (9.0 * freedom)
    return bool(np.cbrt(distance / freedom) - (1.0 - spread) > _BY_CHANCE * np.sqrt(spread))


def _change(W: FloatArray, residuals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Change ``(n,)`` of parameters by least squares of some rows, and its variance by batches of them."""
    solution = solve(Rows(W, -residuals), 1.0 / _scales(residuals))
    sums = batch_sums(np.einsum("pwi,wi->wp", solution.gains, solution.rows.residuals(solution.p)))
    return solution.p, np.square(sums).sum(axis=0) / _free(W)


def _free(W: FloatArray) -> float:
    """Fraction of the mean square of N residuals that n fitted parameters leave on average, ``1 - n / N``."""
    n_rows = W.shape[0] * W.shape[1]
    return float(max(1.0 - W.any(axis=(0, 1)).sum() / n_rows, 1.0 / n_rows))


def _scales(residuals: FloatArray) -> FloatArray:
    """Size ``(n_v,)`` of the residuals of each equation."""
    scale = np.sqrt(np.square(residuals).mean(axis=0))
    return size_or_one(np.maximum(scale, np.sqrt(ROUNDING) * scale.max()))
