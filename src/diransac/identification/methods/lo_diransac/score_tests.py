"""Score tests at a fit: of effects that are not in it, given all else that is estimated.

An effect of size theta changes the residuals, and the jumps from interval to interval.  From the derivatives of the
cost and of its gradient follow the information of theta, the estimate after one Newton step of all unknowns together,
and the change of all other unknowns with theta.  No fit is repeated.

References
----------
Rao 1948 (score test).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.methods.lo_diransac.normal_equations import sum_in_places

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.normal_equations import Fit, NormalEquations
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals

__all__ = ["ScoreTests", "Slopes", "scores_tested", "slopes_of_accelerations"]

_TINY = 1e-300


@dataclass(frozen=True)
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


@dataclass(frozen=True)
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
    z, s : (W, k, K) and (n_s, K) array
        Minus the change of the unknowns of the fit per unit of an effect.
    """

    direct: FloatArray
    information: FloatArray
    score: FloatArray
    scores: FloatArray
    z: FloatArray
    s: FloatArray


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
    return ScoreTests(slopes.direct, information, score, scores, z, s)


def slopes_of_accelerations(
    intervals: ShootingIntervals, fit: Fit, at: NormalEquations, accelerations: FloatArray
) -> Slopes:
    """Slopes of effects that accelerate the model, constantly over each interval.

    They act as the unmodelled accelerations do, whose derivatives the normal equations have, but without their prior.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
    at : NormalEquations
        At the fit, with any priors.
    accelerations : (W, n_v, K) array
        Per unit of each effect.

    Returns
    -------
    Slopes
    """
    n_x, c = fit.x.shape[1], accelerations
    k = n_x + fit.d.shape[1]
    H = intervals.gauss_newton(fit.shared, fit.x, fit.d, at.weights).normal_matrix
    of_z, of_s = H[:, :k, n_x:k] @ c, sum_in_places(intervals, H[:, k:, n_x:k] @ c)
    jumps = -at.slopes[:, :, n_x:k] @ c[:-1]
    more_z, more_s = at.by_jumps(intervals, jumps)
    pulled = at.precision[:, :, None] * jumps
    return Slopes(
        share=(c * of_z[:, n_x:]).sum(axis=1),
        rows=-np.einsum("wi,wik->wk", at.data_z[:, n_x:], c),
        of_z=of_z + more_z,
        of_s=of_s + more_s,
        by_jumps=(pulled * jumps).sum(axis=(0, 1)),
        score_of_jumps=(pulled * at.jumps[:, :, None]).sum(axis=(0, 1)),
    )
