"""Choice among estimates by predictions of blocks of the logs that they were not estimated from, in both directions.

Forward, an estimate predicts the motion from the inputs (`forward`); inversely, the force that the measured motion
needs (`inverse`).  Open loop alone does not judge a machine that is unstable or stuck in friction: a joint that is
locked stays as well as the right one does, and needs a force that is not there.  Equations alone do not judge either:
noise of a derivative attenuates what fits them best.

References
----------
Shao 1993 (choice by cross-validation); Burman, Chow, Nolan 1994 (blocks of dependent data).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.identification.methods.lo_diransac.forward import Forward, Prediction, means_of_known
from diransac.identification.methods.lo_diransac.inverse import Inverse
from diransac.identification.regression.uncertainty import student_quantile

if TYPE_CHECKING:
    from diransac.identification.core.windows import ShootingIntervals
    from diransac.identification.methods.lo_diransac.segments import ActingInputs
    from diransac.identification.methods.lo_diransac.smoothing import Motion
    from diransac.identification.methods.lo_diransac.sources import Blocks, Candidate

_CLEARLY = 0.5
"""Error of the best estimate over that of a trivial prediction, below which a horizon tells estimates apart."""
_EXPLAINED = 0.25
"""RMS of the force that the best estimate leaves over that of the force, below which an equation does: what fits noisy
derivatives best is attenuated, and more noise would decide between estimates by that."""
_ABSURD = 3.0
"""Factor of the least force that is left, from which on an estimate fails absurdly that leaves more than the force."""
_AS_WELL = 0.02
"""Difference of the logarithms of losses that does not count."""
_NEGLIGIBLE, _ROUNDING = 1e-5, 1e-12
"""Loss in comparison with which all are equal: three thousandths of the motion."""


@dataclass(frozen=True, eq=False, repr=False)
class Scores:
    """Predictions of one candidate.

    Parameters
    ----------
    errors : (n_horizons,) array
        Root mean square error of the predicted samples over that of the better trivial prediction.
    losses : (n_horizons, n_blocks) array
        Mean loss of each block; NaN where it has no segment with a sample.
    forces : (n_equations, n_blocks) array
        Mean square of the force that is left of an equation in each block over that of the force; no row for an
        equation that cannot be compared.
    """

    errors: FloatArray
    losses: FloatArray
    forces: FloatArray


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """Candidates in comparison, block by block, by the logarithm of their losses: no block decides alone.

    The loss of a block is the geometric mean of those of both directions, as far as they tell candidates apart.

    Parameters
    ----------
    best : int
        Index of the winner: the first candidate that the best one does not beat by more than the noise of the
        comparison, nor by more than a fiftieth of its loss.
    weights : (n_candidates,) array
        exp(-z^2 / 4) of the difference from the winner beyond a fiftieth of its loss, z in standard errors; 0 for those
        that fail absurdly.  The difference in another log as long has twice the variance of the mean difference
        in this one.
    as_good : (n_candidates,) bool array
        Candidates that predict as well, within the noise of the comparison.
    losses : (n_candidates,) array
        Geometric mean of the losses over the blocks; infinite for a candidate that fails absurdly.
    """

    best: int
    weights: FloatArray
    as_good: BoolArray
    losses: FloatArray

    @classmethod
    def of(cls, scores: Sequence[Scores]) -> Comparison:
        """Comparison of candidates."""
        forces = np.array([x.forces for x in scores])
        logs = _log_losses(scores, forces)
        absurd = _fails_absurdly(forces)
        logs[absurd & ~absurd.all()] = np.inf
        first = int(np.argmin(_overall(logs)))
        difference, error = _differences(logs, first)
        quantile = student_quantile(max(int(np.isfinite(logs).sum(axis=1).max()) - 1, 1), 0.975)
        as_well = difference <= np.minimum(quantile * error, _AS_WELL) + _ROUNDING
        best = int(np.argmax(as_well | (np.arange(len(logs)) == first)))
        difference, error = _differences(logs, best)
        z = np.nan_to_num(np.maximum(difference - _AS_WELL, 0.0) / (error + _ROUNDING), nan=np.inf)
        return cls(best, np.exp(-0.25 * np.square(z)), np.asarray(z <= quantile), np.exp(_overall(logs)))


def _log_losses(scores: Sequence[Scores], forces: FloatArray) -> FloatArray:
    """Logarithms ``(n, n_blocks)`` of the losses of both directions, as far as they tell candidates apart.

    Over other horizons an unstable machine is lost, and estimates that respond less to their inputs have the smaller
    errors.  Where no horizon tells them apart, all of them count.  Where all of the motion is predicted, forces do not
    count: their errors are those of smoothing.
    """
    least = np.fmin.reduce([x.errors for x in scores])
    told = least < _CLEARLY if (least < _CLEARLY).any() else least < np.inf
    logs = _log_means(np.array([x.losses[told] for x in scores]))
    telling = np.fmin.reduce(means_of_known(forces)) < _EXPLAINED**2
    if not telling.any() or np.exp(_overall(logs)).min() < 2.0 * _NEGLIGIBLE:
        return logs
    inverse = _log_means(np.log1p(forces[:, telling]))
    return np.asarray(0.5 * (logs + np.where(np.isfinite(inverse), inverse, logs)))


def _log_means(losses: FloatArray) -> FloatArray:
    """Logarithms ``(n, n_blocks)`` of mean losses ``(n, k, n_blocks)`` over k horizons or equations."""
    return np.asarray(np.log(means_of_known(losses.swapaxes(1, 2)) + _NEGLIGIBLE))


def _fails_absurdly(forces: FloatArray) -> BoolArray:
    """Mask ``(n,)`` of the candidates that need far more force in an equation than there is, and than another one."""
    left = np.sqrt(means_of_known(forces))
    return np.asarray((left > np.maximum(_ABSURD * np.fmin.reduce(left), 1.0)).any(axis=1))


def _overall(logs: FloatArray) -> FloatArray:
    """Mean over the blocks that are known; infinite where a candidate has none, or fails."""
    return np.asarray(np.where(np.isinf(logs).any(axis=1), np.inf, np.nan_to_num(means_of_known(logs), nan=np.inf)))


def _differences(scores: FloatArray, reference: int) -> tuple[FloatArray, FloatArray]:
    """Mean difference ``(n,)`` of the losses from those of one candidate, and its standard error, by blocks."""
    apart = scores - scores[reference]
    n, mean = np.isfinite(apart).sum(axis=1), means_of_known(apart)
    return mean, np.sqrt(means_of_known(np.square(apart - mean[:, None])) / np.maximum(n - 1, 1))


@dataclass(frozen=True, eq=False, repr=False)
class Judge:
    """Both directions of prediction, of the same blocks.

    Parameters
    ----------
    forward : tuple of Forward
        Segments over the time scales of the motion, and whole logs where they can be simulated at once.
    inverse : Inverse
    """

    forward: tuple[Forward, ...]
    inverse: Inverse

    @classmethod
    def of(
        cls,
        acting: ActingInputs,
        intervals: ShootingIntervals,
        motion: Motion,
        inlying: BoolArray,
        noise: FloatArray,
        blocks: Blocks,
        horizon: float | None,
    ) -> Judge | None:
        """The judge of some logs; None where these are too short, or no predicted sample is known.

        ``horizon`` is in s; None: several, from the time scales of the motion up to a whole log.
        """
        given = acting, intervals, motion, inlying, noise, blocks
        found = [Forward.of(*given, horizon)]
        if horizon is None:
            found.append(Forward.of_whole_logs(*given))
        known = tuple(x for x in found if x is not None)
        return cls(known, Inverse.of(intervals, motion, blocks)) if known else None

    @property
    def horizons(self) -> tuple[float, ...]:
        """Horizons of the predictions, s."""
        return tuple(h for one in self.forward for h in one.horizons)

    @property
    def steps(self) -> tuple[int, ...]:
        """Horizons of the predictions, rows."""
        return tuple(n for one in self.forward for n in one.steps)

    def compared(self, candidates: Sequence[Candidate]) -> tuple[Judge, list[Scores]]:
        """The judge without the samples that no good candidate predicts, and its scores of all candidates."""
        pairs = [one.compared(candidates) for one in self.forward]
        fair = Judge(tuple(x for x, _ in pairs), self.inverse)
        forces = self.inverse.forces_left(candidates)
        predicted = zip(*(x for _, x in pairs), strict=True)
        return fair, [_joined(*some) for some in zip(predicted, forces, strict=True)]

    def scores(self, candidate: Candidate) -> Scores:
        """Predictions of a candidate, each segment by its estimate without the blocks of the segment."""
        return _joined([one.scores(candidate) for one in self.forward], self.inverse.forces_left([candidate])[0])


def _joined(predicted: Sequence[Prediction], forces: FloatArray) -> Scores:
    """Scores from errors and losses by horizon of each kind of prediction, and the forces that are left."""
    errors, losses = zip(*predicted, strict=True)
    return Scores(np.concatenate(errors), np.concatenate(losses), forces)
