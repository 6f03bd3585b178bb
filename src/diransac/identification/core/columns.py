"""Columns of effects in the equations of a fit, and score tests of effects that it lacks.

An effect of size theta changes the residuals, and the jumps from window to window: a delay of a sensor in
proportion to the signal's rate, a bias by a constant, an error of an input as simulations with it differ.  From the
derivatives of the cost and of its gradient follow the information of theta, and the estimate after one Newton step of
all unknowns together.  No fit is repeated.

References
----------
Rao 1948 (score test); Furgale, Rehder, Siegwart 2013 (delays of sensors).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.core.fit import Fit, with_residuals
from diransac.identification.core.theta import EffectKind
from diransac.identification.core.windows import Windows

if TYPE_CHECKING:
    from diransac.identification.core.equations import NormalEquations

_STEPS = {"delay": 0.5, "lag": 0.5, "drift": 0.01}
"""Errors of inputs by which simulations are compared: samples, samples, relative change of a gain."""
_ROUNDING = 1e-9
"""Change of a signal over its size that is a rounding error."""
_TINY = 1e-300


@dataclass(frozen=True, eq=False, repr=False)
class Columns:
    """Derivatives with respect to errors of recordings.

    Parameters
    ----------
    residuals : list of (N, n_s) array
    jumps : (W - 1, n_x, E) array
        Of the jumps from interval to interval.
    of_z, of_s : (W, k, E) and (n_s, E) array
        Of the gradient of the fit.
    rows : (W, E) array
        Of the cost of each interval's measurements.
    of_jumps : (E,) array
        Of the cost of the jumps.
    """

    residuals: list[FloatArray]
    jumps: FloatArray
    of_z: FloatArray
    of_s: FloatArray
    rows: FloatArray
    of_jumps: FloatArray

    @classmethod
    def of(cls, intervals: Windows, at: NormalEquations, changes: Sequence[Change], along: FloatArray) -> Columns:
        """Derivatives from those of residuals and jumps, and the products ``along (W, E, 1 + n)`` of the residuals."""
        jumps = np.stack([x for _, x in changes], axis=-1) if changes else np.zeros((*at.jumps.shape, 0))
        of_z, of_s = at.by_jumps(intervals, jumps)
        by_residuals = [at.by_residuals(intervals, along[:, i]) for i in range(len(changes))]
        for i, (z, s) in enumerate(by_residuals):
            of_z[:, :, i] += z
            of_s[:, i] += s
        of_jumps = np.einsum("wi,wie,wi->e", at.precision, jumps, at.jumps)
        return cls([x for x, _ in changes], jumps, of_z, of_s, along[:, :, 0], of_jumps)

    def slopes(self, at: NormalEquations) -> Slopes:
        """The derivatives, as a score test takes them."""
        n = len(at.right_z)
        shares = [(at.weights * np.square(x)).sum(axis=1).reshape(n, -1).sum(axis=1) for x in self.residuals]
        by_jumps = np.einsum("wi,wie,wie->e", at.precision, self.jumps, self.jumps)
        return Slopes(np.stack(shares, axis=1), self.rows, self.of_z, self.of_s, by_jumps, self.of_jumps)

    def information(self, at: NormalEquations) -> FloatArray:
        """Information ``(E, E)`` of the errors, if all else were known."""
        own = [[(at.weights * x * y).sum() for y in self.residuals] for x in self.residuals]
        by_jumps = np.einsum("wi,wie,wif->ef", at.precision, self.jumps, self.jumps)
        return np.asarray(np.array(own).reshape(by_jumps.shape) + by_jumps)


Change = tuple[FloatArray, FloatArray]
"""Derivatives of residuals (N, n_s) and of jumps (W - 1, n_x) with respect to an error."""


def changes_by(intervals: Windows, fit: Fit, kinds: Sequence[EffectKind], rates: FloatArray) -> list[Change]:
    """Derivatives with respect to errors; those of inputs by the difference of simulations."""
    changes = []
    for kind in kinds:
        if kind.of_inputs:
            step = _STEPS[kind.what]
            moved = intervals.with_input_error(kind, step)
            late = with_residuals(moved, fit)
            own = np.where(intervals.known, (late.residuals - fit.residuals) / step, 0.0)
            jumps = (late.jumps(moved) - fit.jumps(intervals)) / step
        else:
            columns, own = list(kind.columns), np.zeros_like(intervals.measured)
            own[:, columns] = -rates[:, columns] if kind.what == "delay" else 1.0
            jumps = np.zeros((len(intervals) - 1, fit.x.shape[1]))
        changes.append((own, jumps))
    return changes


def recorrected(intervals: Windows, fit: Fit) -> tuple[Windows, Fit, FloatArray]:
    """Recordings whose fractions of a sample are corrected by the rates of this fit, which these are; the last result.

    A step is compared with no step then.
    """
    rates = signal_rates(intervals, fit)
    if not intervals.all_errors.delay.any():
        return intervals, fit, rates
    corrected = intervals.corrected({}, rates)
    return corrected, replace(fit, residuals=fit.residuals + intervals.measured - corrected.measured), rates


def signal_rates(intervals: Windows, fit: Fit) -> FloatArray:
    """Change of each simulated signal per sample; none where it is a rounding error.

    Parameters
    ----------
    intervals : Windows
    fit : Fit

    Returns
    -------
    (N, n_s) array
    """
    series = intervals.rollouts.trajectories(intervals.batch(fit.shared, fit.x, fit.d))
    signals = series.reshape(intervals.measured.shape)
    rates = np.zeros_like(signals)
    for rows in intervals.rows_of_logs:
        if rows.stop - rows.start > 1:
            rates[rows] = np.gradient(signals[rows], axis=0)
    rates, signals = (np.nan_to_num(x, nan=0.0, posinf=0.0, neginf=0.0) for x in (rates, signals))
    return np.where(np.abs(rates).max(axis=0) > _ROUNDING * np.abs(signals).max(axis=0), rates, 0.0)


@dataclass(frozen=True, eq=False, repr=False)
class Slopes:
    """Derivatives of the cost, and of its gradient, with respect to K effects.

    Parameters
    ----------
    share : (W, K) array
        Information of each interval's measurements, if all else were known.
    rows : (W, K) array
        Score of each interval's measurements.
    of_z, of_s : (W, k, K) and (n_s, K) array
        Of the gradient of the fit.
    by_jumps, score_of_jumps : (K,) array
        Information and score of the jumps.
    """

    share: FloatArray
    rows: FloatArray
    of_z: FloatArray
    of_s: FloatArray
    by_jumps: FloatArray
    score_of_jumps: FloatArray

    @property
    def score(self) -> FloatArray:
        """Derivatives ``(K,)`` of the cost."""
        return np.asarray(self.rows.sum(axis=0) + self.score_of_jumps)

    @property
    def direct(self) -> FloatArray:
        """Information ``(K,)``, if all else were known."""
        return np.asarray(self.share.sum(axis=0) + self.by_jumps)


@dataclass(frozen=True, eq=False, repr=False)
class ScoreTests:
    """Score tests of K effects one by one.

    Parameters
    ----------
    direct, information : (K,) array
        Information of each effect, if all else were known, and given that all else is estimated.
    score : (K,) array
        Derivative of the cost after a step of all else: what an unfinished fit, or one whose priors have become
        narrower, gives up is the effect's.
    scores : (W, K) array
        Score of each interval's measurements, less that of the effect itself: what scatters.
    """

    direct: FloatArray
    information: FloatArray
    score: FloatArray
    scores: FloatArray


def scores_tested(at: NormalEquations, slopes: Slopes) -> ScoreTests:
    """Score tests at a fit.

    Parameters
    ----------
    at : NormalEquations
    slopes : Slopes

    Returns
    -------
    ScoreTests
    """
    z, s = at.system.functional(slopes.of_z, slopes.of_s)
    information = slopes.direct - (slopes.of_z * z).sum(axis=(0, 1)) - (slopes.of_s * s).sum(axis=0)
    score = slopes.score + np.einsum("wk,wke->e", at.right_z, z) + at.right_s @ s
    scores = slopes.rows + np.einsum("wk,wke->we", at.data_z, z) + at.data_s @ s
    # An effect that is there has a score of one sign in each batch; only the rest of the scores scatters.
    scores = scores - slopes.score * slopes.share / np.maximum(slopes.share.sum(axis=0), _TINY)
    return ScoreTests(slopes.direct, information, score, scores)
