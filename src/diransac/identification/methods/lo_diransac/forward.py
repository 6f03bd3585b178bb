"""Open-loop prediction of blocks of the logs by estimates that were not made from them.

Every estimate predicts the same segments.  The samples at the beginning of a segment determine its initial state; those
after it are predicted, with the parameters as they are without the blocks that count.  The error of a signal counts in
units of its spread, by the logarithm of one plus its square: a segment in which a prediction is lost counts little more
than one in which it is no better than a constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from diransac.arrays import BoolArray, FloatArray, IntArray, size_or_one
from diransac.identification.core.noise import lower_scale
from diransac.identification.methods.lo_diransac.segments import (
    OUTLYING,
    ActingInputs,
    Segments,
    prior_states,
    stretches,
    whole_stretches,
)

if TYPE_CHECKING:
    from diransac.identification.core.windows import Windows
    from diransac.identification.methods.lo_diransac.smoothing import Motion
    from diransac.identification.methods.lo_diransac.sources import Blocks, Candidate

_SEGMENTS_PER_BLOCK = 20
_LONGEST = 200_000
"""Rows of a log that is simulated at once, at most: once for each block."""
_MOST_ROWS = 100_000
"""Rows that are compared, at most: the errors of all candidates are in memory together."""

Prediction = tuple[FloatArray, FloatArray]
"""Errors ``(n_horizons,)`` over those of the better trivial prediction, and losses ``(n_horizons, n_blocks)``."""


@dataclass(frozen=True, eq=False, repr=False)
class Reference:
    """Measurements that predictions start from and are compared with.

    Parameters
    ----------
    intervals : Windows
        The logs, as recorded.
    motion : Motion
        Smoothed without the model; states start from it that nothing measures.
    blocks : Blocks
    inlying : (N, n_signals) bool array
        Samples that a fit takes for no outliers; they count before a prediction.
    noise : (n_signals,) array
        Standard deviation of each signal, by which samples before a prediction are weighted.
    """

    intervals: Windows
    motion: Motion
    blocks: Blocks
    inlying: BoolArray
    noise: FloatArray


def horizons_of(intervals: Windows, horizon: float | None) -> list[int]:
    """Horizons in rows, the shortest first: the user's, s, or multiples of the time scale of the measured states.

    The scale is the median over the states of the time in which they change by half of what they ever do.
    """
    if horizon is not None:
        return [max(1, round(horizon / intervals.dt))]
    n_x, parts = intervals.model.n_q + intervals.model.n_v, stretches(intervals)
    lags = np.unique(np.geomspace(1, max(_longest(parts) // 4, 1), 40).astype(int))
    times = []
    for j in np.flatnonzero(intervals.known[:, :n_x].any(axis=0)):
        y = np.where(intervals.known[:, j], intervals.measured[:, j], np.nan)
        apart = (np.concatenate([np.abs(y[x][lag:] - y[x][:-lag]) for x in parts]) for lag in lags)
        changes = np.array([np.nanmedian(x) if np.isfinite(x).any() else np.nan for x in apart])
        squares = np.square(changes[seen := np.isfinite(changes)])
        if (squares := squares - squares[:1]).any():
            times.append(lags[seen][int(np.argmax(squares >= 0.25 * squares.max()))])
    scale = float(np.median(times)) if times else 10.0
    return sorted({max(4, round(x * scale)) for x in (0.125, 0.5, 2.0, 8.0)})


def _longest(parts: Sequence[slice]) -> int:
    return max((x.stop - x.start for x in parts), default=0)


def _placed(intervals: Windows, blocks: Blocks, n_before: int, n_after: int) -> tuple[IntArray, IntArray]:
    """First rows of segments within a stretch, spread over the blocks, and the block of the middle of each."""
    placed = []
    for part in stretches(intervals):
        first = np.arange(part.start, part.stop - n_before - n_after + 1)
        block = blocks.of_row[first + n_before + n_after // 2]
        for k in np.unique(block):
            rows = first[block == k]
            spread = np.linspace(0, len(rows) - 1, min(_SEGMENTS_PER_BLOCK, len(rows))).astype(int)
            placed += [(row, k) for row in rows[np.unique(spread)]]
    starts, block = np.array(placed, int).reshape(-1, 2).T
    return starts, block


def forward_predictions(reference: Reference, horizon: float | None) -> list[Forward]:
    """Predictions of segments over the time scales of the motion, or a horizon (s), and of whole logs.

    Each block of a whole log is predicted by the estimate without it, in one simulation from the beginning of the log,
    unless a horizon is given.  Predictions for which the logs are too short, or of which no sample is known, are left
    out.
    """
    intervals, blocks, predictions = reference.intervals, reference.blocks, []
    parts, whole = stretches(intervals), whole_stretches(intervals)
    longest = _longest(parts) // 3
    n_before = min(intervals.length, longest // 2)
    steps = sorted({min(x, longest - n_before) for x in horizons_of(intervals, horizon)})
    acting = ActingInputs.recorded(intervals, "zero-order")  # a candidate has its own
    if n_before >= 1 and steps[0] >= 1:
        starts, block = _placed(intervals, blocks, n_before, steps[-1])
        segments = Segments(intervals, acting, starts, n_before + steps[-1])
        left_out = np.array([(blocks.of_row[segments.rows] == k).any(axis=1) for k in range(blocks.n)]).T
        predictions.append(Forward(reference, segments, block, left_out, n_before, tuple(steps)))
    n_before, n_rows = intervals.length, min((x.stop - x.start for x in whole), default=0)
    if horizon is None and 2 * n_before <= n_rows <= _LONGEST:
        pairs = [(x.start, k) for x in whole for k in np.unique(blocks.of_row[x.start + n_before : x.start + n_rows])]
        starts, block = np.array(pairs).T
        left_out, segments = block[:, None] == np.arange(blocks.n), Segments(intervals, acting, starts, n_rows)
        predictions.append(Forward(reference, segments, block, left_out, n_before, (n_rows - n_before,)))
    return [x for x in predictions if x._known.any()]


@dataclass(frozen=True, eq=False, repr=False)
class Forward:
    """Segments of the logs that every candidate predicts.

    Parameters
    ----------
    reference : Reference
    segments : Segments
        Of rows before and after the beginning of a prediction.
    block : (K,) int array
        Block of the middle of the predicted rows.
    left_out : (K, n_blocks) bool array
        Blocks without which estimates predict a segment, and whose rows count in it.
    n_before : int
        Rows that determine the initial state of a segment.
    steps : tuple of int
        Horizons, rows.
    lost : (n_s, K, n_after) bool array, optional
        Samples of the predicted signals that do not count; None before candidates are compared.
    """

    reference: Reference
    segments: Segments
    block: IntArray
    left_out: BoolArray
    n_before: int
    steps: tuple[int, ...]
    lost: BoolArray | None = None

    @cached_property
    def _every(self) -> int:
        """Distance of the rows that are compared."""
        return max(1, -(-self.steps[-1] * len(self.segments) // _MOST_ROWS))

    @cached_property
    def _places(self) -> IntArray:
        """Places ``(n_s,)`` of the predicted signals among those that are compared: states and sensors, if any."""
        model, columns = self.reference.intervals.model, self.segments.columns
        predicted = np.isin(columns, [model.signals.index(n) for n in (*model.state, *model.sensors)])
        return np.flatnonzero(predicted if predicted.any() else ~predicted)

    def _predicted(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values ``(n_s, K, n_after)`` of the predicted samples, from those of all samples ``(N, n_signals)``."""
        return values.T[self.segments.columns[self._places]][:, self.segments.rows[:, self.n_before :: self._every]]

    @cached_property
    def _known(self) -> BoolArray:
        """Mask ``(n_s, K, n_after)`` of the predicted samples that count: of blocks that an estimate is without."""
        of_row = self.reference.blocks.of_row[self.segments.rows[:, self.n_before :: self._every]]
        known = self._predicted(self.reference.intervals.sampled) & np.take_along_axis(self.left_out, of_row, axis=1)
        return known if self.lost is None else known & ~self.lost

    @cached_property
    def outliers_of_fit(self) -> BoolArray:
        """Mask ``(n_s, K, n_after)`` of the predicted samples that a fit takes for outliers."""
        return ~self._predicted(self.reference.inlying)

    @cached_property
    def _measured(self) -> FloatArray:
        """Predicted samples ``(n_s, K, n_after)``; NaN where they do not count."""
        return np.where(self._known, self._predicted(self.reference.intervals.measured), np.nan)

    @cached_property
    def _spread(self) -> FloatArray:
        """Spread ``(n_s,)`` of what counts."""
        flat = self._measured.reshape(len(self._measured), -1)
        return size_or_one(np.sqrt(means_of_known(np.square(flat - _medians(flat)[:, None]))))

    def _by_horizon(self, values: FloatArray) -> list[FloatArray]:
        """Values ``(n_s, K, n)`` of the rows of each horizon."""
        return [values[:, :, : -(-n // self._every)] for n in self.steps]

    @cached_property
    def _trivial(self) -> list[FloatArray]:
        """RMS errors ``(n_s,)`` of the better one of two predictions: nothing changes, and the median; by horizon."""
        before = self.segments.rows[:, max(0, self.n_before - 3) : self.n_before]
        intervals = self.reference.intervals
        samples = np.where(intervals.sampled & self.reference.inlying, intervals.measured, np.nan)
        last = _medians(samples.T[self.segments.columns[self._places]][:, before])
        apart = np.square(self._measured - last[:, :, None])
        sizes = [np.sqrt(means_of_known(x.reshape(len(x), -1))) for x in self._by_horizon(apart)]
        return [np.where(x > 0.0, np.fmin(x, self._spread), self._spread) for x in sizes]

    def compared(self, candidates: Sequence[Candidate]) -> list[Prediction]:
        """Predictions of all candidates, without the samples that no good one predicts."""
        errors = self._errors(candidates)
        fair = self.without_lost(errors)
        return [fair._scores(x) for x in errors]

    def without_lost(self, errors: Sequence[FloatArray]) -> Forward:
        """The predictions without the samples that no good candidate predicts, from the errors of each.

        The good candidates of a block are those whose robust errors there are at most ten times the least.  A sample
        is lost if all of them miss it by six times what they leave of the others, and if the fit takes it for an
        outlier, or the spread of its signal is less: a fit that is wrong may take anything for an outlier or a motion.
        """
        scales = np.array([self._block_scales(x) for x in errors])
        nearest = np.full(self._known.shape, np.inf)
        for good, e in zip(scales <= 10.0 * np.fmin.reduce(scales), errors, strict=True):
            np.minimum(nearest, np.abs(e), out=nearest, where=good[self.block][:, None])
        scale = np.nan_to_num(_scale(nearest, self._known), nan=np.inf)
        far = self._known & (nearest > OUTLYING * scale[:, None, None])
        fair, n_lost = self, 0
        while (lost := far & (self.outliers_of_fit | (nearest > fair._spread[:, None, None]))).sum() > n_lost:
            fair, n_lost = replace(self, lost=lost), lost.sum()
        return fair

    def scores(self, candidate: Candidate) -> Prediction:
        """Errors and losses of a candidate, each segment by its estimate without the blocks that count."""
        return self._scores(self._errors([candidate])[0])

    def _scores(self, errors: FloatArray) -> Prediction:
        """Errors and losses ``log(1 + mse / spread^2)``, the mean over signals, of errors ``(n_s, K, n_after)``."""
        squares = self._by_horizon(np.where(self._known, np.square(errors), np.nan))
        mse = np.array([means_of_known(x) for x in squares])
        losses = means_of_known(np.log1p(np.minimum(mse.swapaxes(1, 2) / np.square(self._spread), 1e4)))
        of_blocks = [means_of_known(losses[:, self.block == k]) for k in range(self.left_out.shape[1])]
        relative = _medians(mse / np.square(self._trivial)[:, :, None])
        return np.sqrt(means_of_known(relative)), np.array(of_blocks).T

    def _block_scales(self, errors: FloatArray) -> FloatArray:
        """Geometric means over the signals of robust scales ``(n_blocks,)`` of errors in each block; NaN if unknown."""
        blocks = [self.block == k for k in range(self.left_out.shape[1])]
        scales = np.array([_scale(errors[:, x], self._known[:, x]) for x in blocks])
        return np.exp(means_of_known(np.log(scales + np.finfo(float).tiny)))

    def _errors(self, candidates: Sequence[Candidate]) -> list[FloatArray]:
        """Errors ``(n_s, K, n_after)`` of the predicted samples, of each candidate; those of like inputs together."""
        errors, motion = dict[int, FloatArray](), self.reference.motion
        inlying, noise = self.reference.inlying, self.reference.noise
        for acting, intervals in dict.fromkeys((x.acting, x.intervals) for x in candidates):
            alike = [k for k, x in enumerate(candidates) if (x.acting, x.intervals) == (acting, intervals)]
            segments = replace(self.segments, acting=acting, intervals=intervals)
            lanes = np.array([candidates[k].without_blocks(self.left_out) for k in alike])
            weights = (intervals.sampled & inlying)[:, segments.columns] / np.square(noise[segments.columns])
            mean, spread = prior_states(intervals, motion, inlying, segments.starts)
            before, states = replace(segments, n_rows=self.n_before), np.repeat(mean[None], len(lanes), axis=0)
            states = before.estimated_states(lanes, states, spread, weights)
            for k, p, x in zip(alike, lanes, states, strict=True):
                after = segments.errors(p[None], x[None])[0][:, self.n_before :: self._every]
                errors[k] = np.ascontiguousarray(after.transpose(2, 0, 1)[self._places])
        return [errors[k] for k in range(len(candidates))]


def _scale(errors: FloatArray, known: BoolArray) -> FloatArray:
    """Robust scale ``(n_s,)`` of errors ``(n_s, K, n)``; NaN of signals of which few samples are known."""
    return lower_scale(errors.reshape(len(errors), -1).T, known.reshape(len(known), -1).T)


def means_of_known(values: FloatArray) -> FloatArray:
    """Means of the finite numbers along the last axis; NaN where there are none."""
    known = np.isfinite(values)
    count = known.sum(axis=-1)
    return np.where(count > 0, np.where(known, values, 0.0).sum(axis=-1) / np.maximum(count, 1), np.nan)


def _medians(values: FloatArray) -> FloatArray:
    """Medians of the finite numbers along the last axis; NaN where there are none."""
    known = np.isfinite(values)
    ordered, count = np.sort(np.where(known, values, np.nan)), known.sum(axis=-1, keepdims=True)
    pair = (np.take_along_axis(ordered, np.maximum(k, 0), -1) for k in ((count - 1) // 2, count // 2))
    return np.where(count > 0, 0.5 * sum(pair), np.nan)[..., 0]
