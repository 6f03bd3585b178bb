"""Choice among estimates by predictions of blocks of the logs that they were not estimated from, in both directions.

Forward, an estimate predicts the motion from the inputs (`forward`); inversely, the force that the measured motion
needs: residuals of the equations at the motion that is smoothed without the model, averaged under bumps of a window's
length, as rows of the weak form are.  Open loop alone does not judge a machine that is unstable or stuck in friction: a
joint that is locked stays as well as the right one does, and needs a force that is not there.  Equations alone do not
judge either: noise of a derivative attenuates what fits them best.

References
----------
Shao 1993 (choice by cross-validation); Burman, Chow, Nolan 1994 (blocks of dependent data).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.identification.estimate import predicts
from diransac.identification.methods.lo_diransac.forward import forward_predictions, means_of_known
from diransac.identification.methods.lo_diransac.hypotheses import bump_of, firsts_of
from diransac.identification.methods.lo_diransac.motion_equations import residuals_of_rows
from diransac.identification.methods.lo_diransac.unmeasured import unmeasured_states
from diransac.identification.regression.uncertainty import student_quantile

if TYPE_CHECKING:
    from diransac.identification.core.windows import Windows
    from diransac.identification.methods.lo_diransac.forward import Reference
    from diransac.identification.methods.lo_diransac.segments import ActingInputs
    from diransac.identification.methods.lo_diransac.sources import Candidate

_EXPLAINED = 0.25
"""RMS of the force that the best estimate leaves over that of the force, below which an equation tells estimates apart:
what fits noisy derivatives best is attenuated, and more noise would decide between estimates by that."""
_AS_WELL = 0.02
"""Difference of the logarithms of losses that does not count."""
_NEGLIGIBLE = 1e-5
"""Loss in comparison with which all are equal: three thousandths of the motion."""
_ROUNDING = 1e-12
"""Difference of the logarithms of losses that is rounding."""


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
class Selection:
    """Candidates in comparison, block by block, by the logarithm of their losses: no block decides alone.

    The loss of a block is the geometric mean of those of both directions, as far as they tell candidates apart.

    Parameters
    ----------
    scores : sequence of Scores
    steps : tuple of int
        Horizons, rows.
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

    scores: Sequence[Scores]
    steps: tuple[int, ...]
    best: int
    weights: FloatArray
    as_good: BoolArray
    losses: FloatArray

    @classmethod
    def of(cls, scores: Sequence[Scores], steps: tuple[int, ...] = ()) -> Selection:
        """The comparison of candidates."""
        logs = _log_losses(scores)
        likeliest = int(np.argmin(_overall(logs)))
        difference, error = _differences(logs, likeliest)
        quantile = student_quantile(max(int(np.isfinite(logs).sum(axis=1).max()) - 1, 1), 0.975)
        as_well = difference <= np.minimum(quantile * error, _AS_WELL) + _ROUNDING
        best = int(np.argmax(as_well | (np.arange(len(logs)) == likeliest)))
        difference, error = _differences(logs, best)
        z = np.nan_to_num(np.maximum(difference - _AS_WELL, 0.0) / (error + _ROUNDING), nan=np.inf)
        weights, as_good = np.exp(-0.25 * np.square(z)), np.asarray(z <= quantile)
        return cls(scores, steps, best, weights, as_good, np.exp(_overall(logs)))


def judge(reference: Reference, candidates: Sequence[Candidate], horizon: float | None = None) -> Selection | None:
    """Comparison of candidates; None where the logs are too short for one, or nothing is predicted.

    ``horizon`` is in s; None: several, from the time scales of the motion up to a whole log.
    """
    predictions = forward_predictions(reference, horizon)
    if not (candidates and predictions):
        return None
    scores, forces = [], forces_left(reference, candidates)
    for parts, left in zip(zip(*(x.compared(candidates) for x in predictions), strict=True), forces, strict=True):
        errors, losses = map(np.concatenate, zip(*parts, strict=True))
        scores.append(Scores(errors, losses, left))
    if not any(np.isfinite(x.losses).any() for x in scores):
        return None
    return Selection.of(scores, tuple(n for x in predictions for n in x.steps))


def _log_losses(scores: Sequence[Scores]) -> FloatArray:
    """Logarithms ``(n, n_blocks)`` of the losses of both directions, as far as they tell candidates apart.

    Over other horizons an unstable machine is lost, and estimates that respond less to their inputs have the smaller
    errors.  Where no horizon tells them apart, all of them count.  Where all of the motion is predicted, forces do not
    count: their errors are those of smoothing.  The losses are infinite of candidates that fail absurdly: that need far
    more force in an equation than there is, and than another one.
    """
    errors, forces = np.fmin.reduce([x.errors for x in scores]), np.array([x.forces for x in scores])
    horizons = [bool(predicts([x])) for x in errors] if predicts(errors) else errors < np.inf
    logs = _log_means(np.array([x.losses[horizons] for x in scores]))
    left = np.sqrt(means_of_known(forces))
    least = np.fmin.reduce(left)
    equations = least < _EXPLAINED
    if equations.any() and np.exp(_overall(logs)).min() >= 2.0 * _NEGLIGIBLE:
        inverse = _log_means(np.log1p(forces[:, equations]))
        logs = 0.5 * (logs + np.where(np.isfinite(inverse), inverse, logs))
    absurd = (left > np.maximum(3.0 * least, 1.0)).any(axis=1)
    logs[absurd & ~absurd.all()] = np.inf
    return logs


def _log_means(losses: FloatArray) -> FloatArray:
    """Logarithms ``(n, n_blocks)`` of mean losses ``(n, k, n_blocks)`` over k horizons or equations."""
    return np.asarray(np.log(means_of_known(losses.swapaxes(1, 2)) + _NEGLIGIBLE))


def _overall(logs: FloatArray) -> FloatArray:
    """Mean over the blocks that are known; infinite where a candidate has none, or fails."""
    return np.asarray(np.where(np.isinf(logs).any(axis=1), np.inf, np.nan_to_num(means_of_known(logs), nan=np.inf)))


def _differences(logs: FloatArray, reference: int) -> tuple[FloatArray, FloatArray]:
    """Mean difference ``(n,)`` of the losses from those of one candidate, and its standard error, by blocks."""
    apart = logs - logs[reference]
    n, mean = np.isfinite(apart).sum(axis=1), means_of_known(apart)
    return mean, np.sqrt(means_of_known(np.square(apart - mean[:, None])) / np.maximum(n - 1, 1))


# ---------------------------------------------------------------------- forces


def forces_left(reference: Reference, candidates: Sequence[Candidate]) -> list[FloatArray]:
    """Mean squares ``(n_equations, n_blocks)`` of the force that the equations leave in each block, over the force.

    Each by the candidate's estimate without the block.  The force of an equation is the larger one of inertial force
    and force of the inputs, as the middle of the candidates has it; an equation without any is left out.
    """
    intervals, blocks = reference.intervals, reference.blocks
    equations = equations_of_measured_states(intervals)
    firsts = np.concatenate([firsts_of(intervals, x) for x in intervals.rows_of_logs])
    if not (len(equations) and len(firsts)):
        return [np.empty((0, blocks.n))] * len(candidates)
    block, left, sizes = blocks.of_row[firsts + intervals.length // 2], [], []
    for candidate in candidates:
        with np.errstate(all="ignore"):
            means = _mean_residuals(reference, candidate, firsts, equations)
            sizes.append(np.var([means[0] - means[1], means[0] - means[2]], axis=1).max(axis=0))
            parts = [np.square(means[0, block == k]) for k in range(blocks.n)]
            squares = np.array([x.mean(axis=0) if len(x) else np.full(len(equations), np.nan) for x in parts]).T
        left.append(np.nan_to_num(squares, nan=np.nan, posinf=1e200))
    size = np.median(sizes, axis=0)
    used = np.isfinite(size) & (size > 0.0)
    return [x[used] / size[used, None] for x in left]


def _mean_residuals(reference: Reference, candidate: Candidate, firsts: IntArray, equations: IntArray) -> FloatArray:
    """Means ``(3, K, n_equations)`` of residuals under bumps: as they are, without inertia, and without inputs."""
    intervals, model, u = reference.intervals, reference.intervals.model, _between(candidate.acting)
    q, v, a, _ = reference.motion.parts(model, slice(None))
    p = candidate.without[reference.blocks.of_row]
    if not intervals.layout.is_shared:
        p = np.take_along_axis(p, intervals.layout.index[intervals.log_of_row], axis=1)
    forces = ((a, u), (np.zeros_like(a), u), (a, np.zeros_like(u)))
    rows = np.array([residuals_of_rows(model, q, v, x, w, p)[:, equations] for x, w in forces])
    windows = np.lib.stride_tricks.sliding_window_view(rows, intervals.length, axis=1)
    return np.asarray(windows[:, firsts] @ bump_of(intervals.length))


def _between(acting: ActingInputs) -> FloatArray:
    """Inputs ``(N, n_u)`` around the instant of each row, at which accelerations are those between two held inputs."""
    u = acting.values
    return 0.5 * (u + np.concatenate([u[:1], u[:-1]])) if acting.hold == "zero-order" else u


def equations_of_measured_states(intervals: Windows) -> IntArray:
    """Equations in which no unmeasured state enters, nor a derivative of it."""
    model, unmeasured = intervals.model, unmeasured_states(intervals)
    hidden = [name for chain in model.chains if not set(unmeasured).isdisjoint(chain) for name in chain]
    names = (*model.coordinates, *model.velocities, *model.accelerations)
    enters = np.hstack([np.array(ca.DM(model.residual.sparsity_jac(k, 0), 1)) != 0.0 for k in range(3)])
    return np.flatnonzero(~enters[:, np.isin(names, hidden)].any(axis=1))
