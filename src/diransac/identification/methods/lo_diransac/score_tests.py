"""Score tests at a fit: of effects that are not in it, given all else that is estimated.

An effect of size theta changes the residuals, and the jumps from interval to interval.  From the derivatives of the
cost and of its gradient follow the information of theta, and the estimate after one Newton step of all unknowns
together.  No fit is repeated.

References
----------
Rao 1948 (score test).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.normal_equations import NormalEquations

_TINY = 1e-300


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
