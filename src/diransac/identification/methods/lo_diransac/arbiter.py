"""Comparison of estimates by prediction of blocks of the logs that they were not estimated from.

Every estimate predicts the same segments, open loop.  The samples at the beginning of a segment determine its initial
state; the samples after them are predicted, with the parameters as they are without the block.  The error of a signal
at a horizon counts in units of that of the prediction that nothing changes, by the logarithm of one plus its square:
a segment in which a prediction is lost counts little more than one in which it is no better than that.

References
----------
Shao 1993 (choice by cross-validation); Burman, Chow, Nolan 1994 (blocks of dependent data); Yao et al. 2018 (stacking).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.identification.methods.lo_diransac.segments import Segments, first_states, stretches
from diransac.identification.uncertainty import student_quantile

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
    from diransac.identification.methods.lo_diransac.smoothing import Motion
    from diransac.identification.methods.lo_diransac.sources import Blocks, Candidate

__all__ = ["Comparison", "compared", "horizons_of"]

_SEGMENTS_PER_BLOCK = 20
_SCALES = (0.125, 0.5, 2.0, 8.0)
"""Horizons over the time in which signals change by half of what they ever do."""
_FEWEST_ROWS, _PART = 4, 3
"""Rows of the shortest horizon, and stretches over segments at least."""
_LOST = 1e4
_AS_WELL = 0.02


@dataclass(frozen=True)
class Comparison:
    """Predictions of each candidate.

    Parameters
    ----------
    horizons : tuple of float
        s.
    errors : (n_candidates, n_horizons) array
        Root mean square error of the predicted samples over that of the prediction that nothing changes.
    scores : (n_candidates, n_blocks) array
        Mean loss of each block; NaN where it has no segment with a sample.
    best : int
        Index of the winner.
    as_good : (n_candidates,) bool array
        Candidates that predict as well, within the noise of the comparison.
    weights : (n_candidates,) array
        Weight of each in the uncertainty of the result: exp(-z^2 / 2) of its difference from the winner, z in standard
        errors, and 1 for those that predict better.
    """

    horizons: tuple[float, ...]
    errors: FloatArray
    scores: FloatArray
    best: int
    as_good: BoolArray
    weights: FloatArray

    @property
    def means(self) -> FloatArray:
        """Mean loss of each candidate over the blocks."""
        return _means(self.scores)


def horizons_of(intervals: ShootingIntervals, horizon: float | None) -> list[int]:
    """Horizons in rows, the shortest first: the user's, or multiples of the time scale of the measured states."""
    dt = intervals.dt
    if horizon is not None:
        return [max(1, round(horizon / dt))]
    n_x = intervals.model.n_q + intervals.model.n_v
    longest = max((x.stop - x.start for x in stretches(intervals)), default=1)
    lags = np.unique(np.geomspace(1, max(longest // 4, 1), 40).astype(int))
    times = []
    for j in np.flatnonzero(intervals.known[:, :n_x].any(axis=0)):
        y = np.where(intervals.known[:, j], intervals.measured[:, j], np.nan)
        changes = []
        for lag in lags:
            apart = np.concatenate([np.abs(y[x][lag:] - y[x][:-lag]) for x in stretches(intervals)])
            changes.append(np.nanmedian(apart) if np.isfinite(apart).any() else np.nan)
        seen = np.isfinite(changes)
        squares = np.square(np.array(changes)[seen])
        squares = squares - squares[:1]
        if squares.any():
            times.append(lags[seen][int(np.argmax(squares >= 0.25 * squares.max()))])
    scale = float(np.median(times)) if times else 10.0
    return sorted({int(max(_FEWEST_ROWS, round(s * scale))) for s in _SCALES})


def _placed(intervals: ShootingIntervals, blocks: Blocks, n_before: int, n_after: int) -> tuple[IntArray, IntArray]:
    """First rows of segments within a stretch, spread over the blocks, and the block that each has no part in.

    That is the block of the middle of the predicted rows: long predictions are of others in part, but few parameters
    are determined by many rows.
    """
    n_rows, starts, left_out = n_before + n_after, [], []
    for part in stretches(intervals):
        own = blocks.of_row[part]
        first = np.arange(part.start, part.stop - n_rows + 1)
        block = own[: len(first) + n_before + n_after // 2][n_before + n_after // 2 :]
        for k in np.unique(block):
            rows = first[block == k]
            some = rows[np.unique(np.linspace(0, len(rows) - 1, min(_SEGMENTS_PER_BLOCK, len(rows))).astype(int))]
            starts.append(some)
            left_out.append(np.full(len(some), k))
    if not starts:
        return np.arange(0), np.arange(0)
    return np.concatenate(starts), np.concatenate(left_out)


def compared(
    candidates: Sequence[Candidate],
    intervals: ShootingIntervals,
    motion: Motion,
    inlying: BoolArray,
    noise: FloatArray,
    blocks: Blocks,
    horizon: float | None,
    n_before: int,
) -> Comparison | None:
    """Comparison of candidates by prediction.

    Parameters
    ----------
    candidates : sequence of Candidate
        Of those that are as good, the first is preferred.
    intervals : ShootingIntervals
    motion : Motion
        From which states start that nothing measures.
    inlying : (N, n_signals) bool array
        Samples that are no outliers.
    noise : (n_signals,) array
        Standard deviation of each signal, by which samples before a prediction are weighted.
    blocks : Blocks
    horizon : float, optional
        s; None: several, from the time scales of the motion.
    n_before : int
        Rows that determine the initial state of a segment.

    Returns
    -------
    Comparison or None
        None where the logs are too short, or no predicted sample is known.
    """
    longest = max((x.stop - x.start for x in stretches(intervals)), default=0) // _PART
    n_before = min(n_before, longest // 2)
    steps = sorted({min(x, longest - n_before) for x in horizons_of(intervals, horizon)})
    if n_before < 1 or steps[0] < 1:
        return None
    starts, block = _placed(intervals, blocks, n_before, steps[-1])
    one = Segments(intervals, candidates[0].acting, starts, n_before + steps[-1])
    columns = _predicted(one)
    known = (intervals.sampled & inlying)[one.rows][:, n_before:][:, :, one.columns]
    trivial = _of_no_change(one, inlying, n_before, steps)
    losses, errors = [], []
    for candidate in candidates:
        segments = replace(one, acting=candidate.acting, intervals=candidate.intervals)
        predicted = _prediction_errors(segments, candidate, block, motion, inlying, noise, n_before)
        own, squares = [], []
        for k, n in enumerate(steps):
            e, ok = predicted[:, :n], known[:, :n]
            count = ok.sum(axis=1)
            mse = np.where(ok, np.square(e), 0.0).sum(axis=1) / np.maximum(count, 1) / np.square(trivial[k])
            mse = np.where((count > 0) & columns, np.minimum(mse, _LOST), np.nan)
            own.append(np.log1p(mse))
            squares.append(_medians(mse))
        losses.append(_means(np.concatenate(own, axis=1)))
        errors.append(np.sqrt(_means(np.array(squares))))
    scores = np.array([[_means(x[block == k]) for k in range(blocks.n)] for x in losses])
    if not np.isfinite(scores).any():
        return None
    return Comparison(tuple(float(n * intervals.dt) for n in steps), np.array(errors), scores, *_choice(scores))


def _means(values: FloatArray) -> FloatArray:
    """Means of the finite numbers along the last axis; NaN where there are none."""
    known = np.isfinite(values)
    count = known.sum(axis=-1)
    return np.where(count > 0, np.where(known, values, 0.0).sum(axis=-1) / np.maximum(count, 1), np.nan)


def _medians(values: FloatArray) -> FloatArray:
    """Medians ``(n,)`` of the finite numbers of each column; NaN where there are none."""
    known = np.isfinite(values)
    return np.array([np.median(x[k]) if k.any() else np.nan for x, k in zip(values.T, known.T, strict=True)])


def _predicted(segments: Segments) -> BoolArray:
    """Mask of the compared signals whose prediction counts: states and sensors; without these, all."""
    model = segments.intervals.model
    names = [model.signals[k] for k in segments.columns]
    found = np.array([n in model.state or n in model.sensors for n in names])
    return found if found.any() else np.ones(len(names), bool)


def _of_no_change(segments: Segments, inlying: BoolArray, n_before: int, steps: Sequence[int]) -> list[FloatArray]:
    """Root mean square error of the prediction that nothing changes at each horizon, (n_s,) each."""
    intervals, rows = segments.intervals, segments.rows
    y = np.where(intervals.sampled & inlying, intervals.measured, np.nan)[:, segments.columns][rows]
    few = max(1, min(3, n_before))
    last = np.stack([_medians(x) for x in y[:, n_before - few : n_before]])[:, None]
    flat = y.reshape(-1, y.shape[2])
    whole = _sizes(flat - _medians(flat))
    found = [_sizes((y[:, n_before : n_before + n] - last).reshape(-1, y.shape[2])) for n in steps]
    return [np.where(size > 0.0, size, np.where(whole > 0.0, whole, 1.0)) for size in found]


def _sizes(values: FloatArray) -> FloatArray:
    """Root mean squares ``(n,)`` of the finite numbers of each column; NaN where there are none."""
    return np.asarray(np.sqrt(_means(np.square(values).T)))


def _prediction_errors(
    segments: Segments,
    candidate: Candidate,
    block: IntArray,
    motion: Motion,
    inlying: BoolArray,
    noise: FloatArray,
    n_before: int,
) -> FloatArray:
    """Errors ``(K, n_after, n_s)`` of the predicted rows."""
    intervals = segments.intervals
    lanes = candidate.without[block][None]
    weights = (intervals.sampled & inlying)[:, segments.columns] / np.square(noise[segments.columns])
    states = first_states(intervals, motion.signals, inlying, segments.starts)[None]
    before = segments.cut(n_before)
    states = before.estimated_states(lanes, states, weights)
    return np.asarray(segments.errors(lanes, states)[0][:, n_before:])


def _choice(scores: FloatArray) -> tuple[int, BoolArray, FloatArray]:
    """The winner, the mask of the candidates that predict as well, and their weights.

    The winner is the first candidate that the best one does not beat by more than the noise of the comparison, nor by
    more than a fiftieth of its loss.
    """
    means = _means(scores)
    first = int(np.nanargmin(means))
    difference, error = _differences(scores, first)
    n = np.isfinite(scores).sum(axis=1)
    quantile = student_quantile(max(int(n.max()) - 1, 1), 0.975)
    near = np.minimum(quantile * error, _AS_WELL * max(means[first], 0.0))
    best = int(np.flatnonzero(difference <= near + 1e-12)[0])
    from_best, error_of_best = _differences(scores, best)
    z = np.maximum(from_best, 0.0) / np.maximum(error_of_best, 1e-300)
    return best, np.asarray(difference <= quantile * error), np.where(np.isfinite(z), np.exp(-0.5 * np.square(z)), 0.0)


def _differences(scores: FloatArray, reference: int) -> tuple[FloatArray, FloatArray]:
    """Mean difference ``(n,)`` of the losses from those of one candidate, and its standard error, by blocks."""
    apart = scores - scores[reference]
    n, mean = np.isfinite(apart).sum(axis=1), _means(apart)
    return mean, np.sqrt(_means(np.square(apart - mean[:, None])) / np.maximum(n - 1, 1))
