"""Comparison of estimates by prediction of blocks of the logs that they were not estimated from.

Every estimate predicts the same segments, open loop.  The samples at the beginning of a segment determine its initial
state; the samples after them are predicted, with the parameters as they are without the block.  The error of a signal
counts in units of its spread, by the logarithm of one plus its square: a segment in which a prediction is lost counts
little more than one in which it is no better than a constant.

References
----------
Shao 1993 (choice by cross-validation); Burman, Chow, Nolan 1994 (blocks of dependent data); Yao et al. 2018 (stacking).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from diransac.arrays import BoolArray, FloatArray, IntArray, size_or_one
from diransac.identification.methods.lo_diransac.mixture import lower_scale
from diransac.identification.methods.lo_diransac.segments import OUTLYING, Segments, prior_states, stretches
from diransac.identification.regression.uncertainty import student_quantile

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.segments import ActingInputs
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
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
_AS_WELL = 0.02
"""Difference of the logarithms of losses that does not count."""
_NEGLIGIBLE, _ROUNDING = 1e-6, 1e-12
"""Loss in comparison with which all are equal: a thousandth of the motion."""


@dataclass(frozen=True, eq=False, repr=False)
class Scores:
    """Predictions of one candidate.

    Parameters
    ----------
    errors : (n_horizons,) array
        Root mean square error of the predicted samples over that of the prediction that nothing changes.
    losses : (n_horizons, n_blocks) array
        Mean loss of each block; NaN where it has no segment with a sample.
    """

    errors: FloatArray
    losses: FloatArray


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """Candidates in comparison, block by block, by the logarithm of their losses: no block decides alone.

    Parameters
    ----------
    best : int
        Index of the winner: the first candidate that the best one does not beat by more than the noise of the
        comparison, nor by more than a fiftieth of its loss.
    weights : (n_candidates,) array
        exp(-z^2 / 4) of the difference from the winner, z in standard errors; 1 for those that predict better.  The
        difference in another log as long has twice the variance of the mean difference in this one.  That of a winner
        whose loss is negligible is the only one.
    as_good : (n_candidates,) bool array
        Candidates that predict as well, within the noise of the comparison.
    losses : (n_candidates,) array
        Mean losses over the blocks and the horizons that count.
    """

    best: int
    weights: FloatArray
    as_good: BoolArray
    losses: FloatArray

    @classmethod
    def of(cls, scores: Sequence[Scores]) -> Comparison:
        """Comparison of candidates.

        Horizons over which no candidate predicts better than that nothing changes do not count: there, an unstable
        machine is lost, and estimates that respond less to their inputs have the smaller errors.
        """
        told = np.fmin.reduce([x.errors for x in scores]) < 1.0
        told = told if told.any() else np.ones_like(told)
        losses = _means(np.array([x.losses[told] for x in scores]).swapaxes(1, 2))
        logs = np.log(losses + _NEGLIGIBLE)
        first = int(np.nanargmin(_means(logs)))
        difference, error = _differences(logs, first)
        quantile = student_quantile(max(int(np.isfinite(logs).sum(axis=1).max()) - 1, 1), 0.975)
        best = int(np.flatnonzero(difference <= np.minimum(quantile * error, _AS_WELL) + _ROUNDING)[0])
        difference, error = _differences(logs, best)
        z = np.nan_to_num(np.maximum(difference, 0.0) / (error + _ROUNDING), nan=np.inf)
        alone = _means(losses[best]) < _NEGLIGIBLE
        weights = np.where(alone & (np.arange(len(z)) != best), 0.0, np.exp(-0.25 * np.square(z)))
        return cls(best, weights, np.asarray(z <= quantile), _means(losses))


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


@dataclass(frozen=True, eq=False, repr=False)
class Arbiter:
    """Segments of the logs that every candidate predicts.

    Parameters
    ----------
    segments : Segments
        Of rows before and after the beginning of a prediction; inputs as any candidate's.
    block : (K,) int array
        Block of the middle of the predicted rows.
    left_out : (K, n_blocks) bool array
        Blocks of which a segment has rows, without which estimates predict it.
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
    ) -> Arbiter | None:
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
        found = cls(segments, block, left_out, n_before, tuple(steps), motion, inlying, noise)
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
        """Mask ``(n_s, K, n_after)`` of the predicted samples that count."""
        sampled = self._predicted(self.segments.intervals.sampled)
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
    def _no_change(self) -> list[FloatArray]:
        """RMS errors ``(n_s,)`` of the prediction that nothing changes, by horizon."""
        one, few, y = self.segments, max(1, min(3, self.n_before)), self._measured
        before, columns = one.rows[:, self.n_before - few : self.n_before], one.columns[self._places]
        measured, seen = one.intervals.measured, one.intervals.sampled & self.inlying
        apart = y - _medians(np.where(seen, measured, np.nan).T[columns][:, before])[:, :, None]
        sizes = [_root_mean_squares(apart[:, :, :n].reshape(len(y), -1)) for n in self._n_rows]
        return [np.where(size > 0.0, size, self._spread) for size in sizes]

    def compared(self, candidates: Sequence[Candidate]) -> tuple[Arbiter, list[Scores]]:
        """The arbiter without the samples that no good candidate predicts, and its scores of all candidates.

        The good candidates of a block are those whose robust errors there are at most ten times the least.  A sample
        is lost if all of them miss it by six times what they leave of the others, and if the fit takes it for an
        outlier, or the spread of its signal is less: a fit that is wrong may take anything for an outlier or a motion.

        Parameters
        ----------
        candidates : sequence of Candidate

        Returns
        -------
        Arbiter, list of Scores
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

    def scores(self, candidate: Candidate) -> Scores:
        """Predictions of a candidate, each segment by its estimate without the blocks of the segment.

        The loss of a signal over a horizon is ``log(1 + mse / spread^2)``.
        """
        return self._scores(self._errors([candidate])[0])

    def _scores(self, errors: FloatArray) -> Scores:
        """Scores of errors ``(n_s, K, n_after)``."""
        losses, found = list[FloatArray](), list[FloatArray]()
        squares = np.where(self._known, np.square(errors), 0.0)
        for n, count, size in zip(self._n_rows, self._counts, self._no_change, strict=True):
            mse = np.where(count > 0, squares[:, :, :n].sum(axis=2) / np.maximum(count, 1), np.nan)
            losses.append(np.log1p(np.minimum(mse.T / np.square(self._spread), _LOST)))
            found.append(_medians(mse / np.square(size)[:, None]))
        by_horizon = _means(np.array(losses))
        of_blocks = np.array([_means(by_horizon[:, self.block == k]) for k in range(self.left_out.shape[1])]).T
        return Scores(np.sqrt(_means(np.array(found))), of_blocks)

    def _block_scales(self, errors: FloatArray) -> FloatArray:
        """Geometric means over the signals of robust scales ``(n_blocks,)`` of errors in each block; NaN if unknown."""
        blocks = [self.block == k for k in range(self.left_out.shape[1])]
        return np.exp(_means(np.log(np.array([_scale(errors[:, x], self._known[:, x]) for x in blocks]) + _TINY)))

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


def _means(values: FloatArray) -> FloatArray:
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
    return np.asarray(np.sqrt(_means(np.square(values))))


def _differences(scores: FloatArray, reference: int) -> tuple[FloatArray, FloatArray]:
    """Mean difference ``(n,)`` of the losses from those of one candidate, and its standard error, by blocks."""
    apart = scores - scores[reference]
    n, mean = np.isfinite(apart).sum(axis=1), _means(apart)
    return mean, np.sqrt(_means(np.square(apart - mean[:, None])) / np.maximum(n - 1, 1))
