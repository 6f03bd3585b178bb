"""Open-loop prediction of blocks of the logs by estimates that were not made from them.

Every estimate predicts the same segments.  The samples at the beginning of a segment determine its initial state; those
after it are predicted, with the parameters as they are without the blocks that count.  The error of a signal counts in
units of its spread, by the logarithm of one plus its square: a segment in which a prediction is lost counts little more
than one in which it is no better than a constant.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from diransac.arrays import BoolArray, FloatArray, IntArray, size_or_one
from diransac.identification.core.noise import lower_scale
from diransac.identification.methods.lo_diransac.segments import (
    OUTLYING,
    Segments,
    prior_states,
    stretches,
    whole_stretches,
)

if TYPE_CHECKING:
    from diransac.identification.core.windows import ShootingIntervals
    from diransac.identification.methods.lo_diransac.segments import ActingInputs
    from diransac.identification.methods.lo_diransac.smoothing import Motion
    from diransac.identification.methods.lo_diransac.sources import Blocks, Candidate

_SEGMENTS_PER_BLOCK = 20
_SCALES = (0.125, 0.5, 2.0, 8.0)
"""Horizons over the time in which signals change by half of what they ever do."""
_FEWEST_ROWS, _PART = 4, 3
"""Rows of the shortest horizon, and stretches over segments at least."""
_LOST, _TINY = 1e4, 1e-300
_GOOD = 10.0
"""Factor of the least error in a block up to which a candidate is good there."""
_MOST_ROWS = 100_000
"""Rows that are compared, at most: the errors of all candidates are in memory together."""
_LONGEST = 200_000
"""Rows of a log that is simulated at once, at most: once for each block."""


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
    """First rows of segments within a stretch, spread over the blocks, and the block of the middle of each."""
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


Prediction = tuple[FloatArray, FloatArray]
"""Errors ``(n_horizons,)`` over those of the better trivial prediction, and losses ``(n_horizons, n_blocks)``."""


@dataclass(frozen=True, eq=False, repr=False)
class Forward:
    """Segments of the logs that every candidate predicts.

    Parameters
    ----------
    segments : Segments
        Of rows before and after the beginning of a prediction; inputs as any candidate's.
    block : (K,) int array
        Block of the middle of the predicted rows.
    left_out : (K, n_blocks) bool array
        Blocks without which estimates predict a segment, and whose rows count in it.
    blocks : Blocks
    n_before : int
        Rows that determine the initial state of a segment.
    steps : tuple of int
        Horizons, rows.
    motion : Motion
        From which states start that nothing measures.
    inlying : (N, n_signals) bool array
        Samples that a fit takes for no outliers; they count before a prediction.
    noise : (n_signals,) array
        Standard deviation of each signal, by which samples before a prediction are weighted.
    lost : (n_s, K, n_after) bool array, optional
        Samples of the predicted signals that do not count; None before candidates are compared.
    """

    segments: Segments
    block: IntArray
    left_out: BoolArray
    blocks: Blocks
    n_before: int
    steps: tuple[int, ...]
    motion: Motion
    inlying: BoolArray
    noise: FloatArray
    lost: BoolArray | None = None

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
    ) -> Forward | None:
        """Segments over the blocks; None where the logs are too short, or no predicted sample is known.

        ``horizon`` is in s; None: several, from the time scales of the motion.
        """
        longest = max((x.stop - x.start for x in stretches(intervals)), default=0) // _PART
        n_before = min(intervals.length, longest // 2)
        steps = sorted({min(x, longest - n_before) for x in horizons_of(intervals, horizon)})
        if n_before < 1 or steps[0] < 1:
            return None
        starts, block = _placed(intervals, blocks, n_before, steps[-1])
        segments = Segments(intervals, acting, starts, n_before + steps[-1])
        left_out = np.array([(blocks.of_row[segments.rows] == k).any(axis=1) for k in range(blocks.n)]).T
        found = cls(segments, block, left_out, blocks, n_before, tuple(steps), motion, inlying, noise)
        return found if found._known.any() else None

    @classmethod
    def of_whole_logs(
        cls,
        acting: ActingInputs,
        intervals: ShootingIntervals,
        motion: Motion,
        inlying: BoolArray,
        noise: FloatArray,
        blocks: Blocks,
    ) -> Forward | None:
        """Each block within one simulation from the beginning of its log, by the estimate without it.

        None where the logs are too short, or too long, or no predicted sample is known.
        """
        whole, n_before = whole_stretches(intervals), intervals.length
        n_rows = min((x.stop - x.start for x in whole), default=0)
        if not 2 * n_before <= n_rows <= _LONGEST:
            return None
        pairs = [(x.start, k) for x in whole for k in np.unique(blocks.of_row[x.start + n_before : x.start + n_rows])]
        starts, block = np.array(pairs).T
        segments, left_out = Segments(intervals, acting, starts, n_rows), block[:, None] == np.arange(blocks.n)
        found = cls(segments, block, left_out, blocks, n_before, (n_rows - n_before,), motion, inlying, noise)
        return found if found._known.any() else None

    @property
    def horizons(self) -> tuple[float, ...]:
        """Horizons, s."""
        return tuple(float(n * self.segments.intervals.dt) for n in self.steps)

    @cached_property
    def _after(self) -> slice:
        """Rows of a segment that are predicted and compared."""
        return slice(self.n_before, None, max(1, -(-self.steps[-1] * len(self.segments) // _MOST_ROWS)))

    @cached_property
    def _n_rows(self) -> list[int]:
        """Numbers of these rows, by horizon."""
        return [-(-n // self._after.step) for n in self.steps]

    @cached_property
    def _places(self) -> IntArray:
        """Places ``(n_s,)`` of the predicted signals among those that are compared: states and sensors, if any."""
        model, columns = self.segments.intervals.model, self.segments.columns
        names = [model.signals[k] for k in columns]
        found = np.flatnonzero([n in model.state or n in model.sensors for n in names])
        return found if len(found) else np.arange(len(columns))

    def _predicted(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values ``(n_s, K, n_after)`` of the predicted samples, from those of all samples ``(N, n_signals)``."""
        return values.T[self.segments.columns[self._places]][:, self.segments.rows[:, self._after]]

    @cached_property
    def _known(self) -> BoolArray:
        """Mask ``(n_s, K, n_after)`` of the predicted samples that count: of blocks that an estimate is without."""
        of_row = self.blocks.of_row[self.segments.rows[:, self._after]]
        sampled = self._predicted(self.segments.intervals.sampled) & np.take_along_axis(self.left_out, of_row, axis=1)
        return sampled if self.lost is None else sampled & ~self.lost

    @cached_property
    def _counts(self) -> list[IntArray]:
        """Numbers ``(n_s, K)`` of the predicted samples that count, by horizon."""
        return [np.count_nonzero(self._known[:, :, :n], axis=2) for n in self._n_rows]

    @cached_property
    def outliers_of_fit(self) -> BoolArray:
        """Mask ``(n_s, K, n_after)`` of the predicted samples that a fit takes for outliers."""
        return ~self._predicted(self.inlying)

    @cached_property
    def _measured(self) -> FloatArray:
        """Predicted samples ``(n_s, K, n_after)``; NaN where they do not count."""
        return np.where(self._known, self._predicted(self.segments.intervals.measured), np.nan)

    @cached_property
    def _spread(self) -> FloatArray:
        """Spread ``(n_s,)`` of what counts."""
        flat = self._measured.reshape(len(self._measured), -1)
        return size_or_one(_root_mean_squares(flat - _medians(flat)[:, None]))

    @cached_property
    def _trivial(self) -> list[FloatArray]:
        """RMS errors ``(n_s,)`` of the better one of two predictions: nothing changes, and the median; by horizon."""
        one, few, y = self.segments, max(1, min(3, self.n_before)), self._measured
        before, columns = one.rows[:, self.n_before - few : self.n_before], one.columns[self._places]
        measured, seen = one.intervals.measured, one.intervals.sampled & self.inlying
        apart = y - _medians(np.where(seen, measured, np.nan).T[columns][:, before])[:, :, None]
        sizes = [_root_mean_squares(apart[:, :, :n].reshape(len(y), -1)) for n in self._n_rows]
        return [np.where(size > 0.0, np.fmin(size, self._spread), self._spread) for size in sizes]

    def compared(self, candidates: Sequence[Candidate]) -> tuple[Forward, list[Prediction]]:
        """The predictions without the samples that no good candidate predicts, and its scores of all candidates.

        The good candidates of a block are those whose robust errors there are at most ten times the least.  A sample
        is lost if all of them miss it by six times what they leave of the others, and if the fit takes it for an
        outlier, or the spread of its signal is less: a fit that is wrong may take anything for an outlier or a motion.

        Parameters
        ----------
        candidates : sequence of Candidate

        Returns
        -------
        Forward, list of Prediction
        """
        errors = self._errors(candidates)
        scales = np.array([self._block_scales(x) for x in errors])
        nearest = np.full(self._known.shape, np.inf)
        for good, e in zip(scales <= _GOOD * np.fmin.reduce(scales), errors, strict=True):
            np.minimum(nearest, np.abs(e), out=nearest, where=good[self.block][:, None])
        scale = np.nan_to_num(_scale(nearest, self._known), nan=np.inf)
        far = self._known & (nearest > OUTLYING * scale[:, None, None])
        fair, n_lost = self, 0
        while (lost := far & (self.outliers_of_fit | (nearest > fair._spread[:, None, None]))).sum() > n_lost:
            fair, n_lost = replace(self, lost=lost), lost.sum()
        return fair, [fair._scores(x) for x in errors]

    def scores(self, candidate: Candidate) -> Prediction:
        """Errors and losses of a candidate, each segment by its estimate without the blocks that count.

        The loss of a signal over a horizon is ``log(1 + mse / spread^2)``.
        """
        return self._scores(self._errors([candidate])[0])

    def _scores(self, errors: FloatArray) -> Prediction:
        """Errors and losses by horizon, of errors ``(n_s, K, n_after)``."""
        losses, found = list[FloatArray](), list[FloatArray]()
        squares = np.where(self._known, np.square(errors), 0.0)
        for n, count, size in zip(self._n_rows, self._counts, self._trivial, strict=True):
            mse = np.where(count > 0, squares[:, :, :n].sum(axis=2) / np.maximum(count, 1), np.nan)
            losses.append(np.log1p(np.minimum(mse.T / np.square(self._spread), _LOST)))
            found.append(_medians(mse / np.square(size)[:, None]))
        by_horizon = means_of_known(np.array(losses))
        of_blocks = np.array([means_of_known(by_horizon[:, self.block == k]) for k in range(self.left_out.shape[1])]).T
        return np.sqrt(means_of_known(np.array(found))), of_blocks

    def _block_scales(self, errors: FloatArray) -> FloatArray:
        """Geometric means over the signals of robust scales ``(n_blocks,)`` of errors in each block; NaN if unknown."""
        blocks = [self.block == k for k in range(self.left_out.shape[1])]
        return np.exp(
            means_of_known(np.log(np.array([_scale(errors[:, x], self._known[:, x]) for x in blocks]) + _TINY))
        )

    def _errors(self, candidates: Sequence[Candidate]) -> list[FloatArray]:
        """Errors ``(n_s, K, n_after)`` of the predicted samples, of each candidate."""
        found = dict[int, FloatArray]()
        for alike in {(x.acting, x.intervals): None for x in candidates}:
            some = [k for k, x in enumerate(candidates) if (x.acting, x.intervals) == alike]
            found |= zip(some, self._errors_with(*alike, [candidates[k] for k in some]), strict=True)
        return [found[k] for k in range(len(candidates))]

    def _errors_with(
        self, acting: ActingInputs, intervals: ShootingIntervals, candidates: Sequence[Candidate]
    ) -> Iterator[FloatArray]:
        """Errors of the predicted samples, of candidates with the same inputs and logs."""
        segments = replace(self.segments, acting=acting, intervals=intervals)
        lanes = np.array([x.without_blocks(self.left_out) for x in candidates])
        weights = (intervals.sampled & self.inlying)[:, segments.columns] / np.square(self.noise[segments.columns])
        states, spread = prior_states(intervals, self.motion, self.inlying, segments.starts)
        before = replace(segments, n_rows=self.n_before)
        states = before.estimated_states(lanes, np.repeat(states[None], len(lanes), axis=0), spread, weights)
        for own, x in zip(lanes, states, strict=True):
            after = segments.errors(own[None], x[None])[0][:, self._after]
            yield np.ascontiguousarray(after.transpose(2, 0, 1)[self._places])


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


def _root_mean_squares(values: FloatArray) -> FloatArray:
    """Root mean squares of the finite numbers along the last axis; NaN where there are none."""
    return np.asarray(np.sqrt(means_of_known(np.square(values))))
