"""Initial states of predictions, estimated with the model from the samples before each; outliers of a log.

The motion of a log is smoothed first without the equations of motion, as lo-diransac begins.  It gives the noise of
each signal, and first states.  The state of a prediction is the one from which the simulation of the rows before agrees
best with their samples (`Segments.estimated_states`).  An outlier is far from the smoothed motion and from simulations
that are fitted so: a reversal of dry friction is within a sample, and no polynomial follows it.

References
----------
Gasser, Sroka, Jennen-Steinmetz 1986 (noise by pseudo-residuals); Ljung 1999, "System identification", section 16.4
(initial states of a validation).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray, robust_std, runs, size_or_one
from diransac.data.checks import rows_per_sample
from diransac.data.dataset import Dataset
from diransac.data.segment import Segment
from diransac.errors import LogError
from diransac.identification.core.noise import lower_scale
from diransac.identification.core.windows import Windows
from diransac.identification.diagnosis import Resolution
from diransac.identification.methods.lo_diransac.method import LoDiransac
from diransac.identification.methods.lo_diransac.preparation import prepared
from diransac.identification.methods.lo_diransac.segments import ActingInputs, Segments
from diransac.identification.methods.lo_diransac.unmeasured import unmeasured_states
from diransac.identification.methods.lo_diransac.without_equations import followed


@dataclass(frozen=True, eq=False, repr=False)
class SmoothedLog:
    """Motion of one log, smoothed without the equations of motion, and its samples about it.

    Parameters
    ----------
    signals : (N, n_signals) array
        All signals of the model; NaN where a state is unmeasured.
    noise : (n_s,) array
        Robust standard deviation of each signal of the dataset about the motion, its unit.  A motion that is smoothed
        over few samples follows their noise: then about the line between neighbours, which adds its curvature.
    outliers : (N, n_s) bool array
        Samples of the dataset's signals that are far from the motion.
    intervals : Windows or None
        The log in shooting intervals, of a model with equations.
    """

    signals: FloatArray
    noise: FloatArray
    outliers: BoolArray
    intervals: Windows | None = None


def smoothed_log(dataset: Dataset) -> SmoothedLog | None:
    """Smoothed motion of the only log of a dataset; None where the log is too short to be smoothed.

    Parameters
    ----------
    dataset : Dataset
        With one log.
    """
    try:
        intervals, motion, _ = prepared(LoDiransac(), dataset)
    except LogError:
        return None
    (one,), model = dataset.segments, dataset.model
    signals = motion.signals[: len(one)].copy()
    signals[:, [model.signals.index(n) for n in unmeasured_states(intervals)]] = np.nan
    columns = [model.signals.index(n) for n in one.signals]
    distances = one.measured - signals[:, columns]
    known: BoolArray = np.isfinite(distances)
    samples = known.mean(axis=0) * min(2 * intervals.length + 1, len(one))
    of_motion = lower_scale(np.where(known, distances, 0.0), known)
    # Smoothing over 20 samples leaves their noise.
    noise = np.where(samples < 20.0, _of_pseudo_residuals(one.measured), np.nan_to_num(of_motion))
    # Smaller distances are errors of the smoothed motion.
    least = 1e-3 * motion.spread[columns]
    # Outliers are six standard deviations of the noise from the motion.
    outliers = known & (np.abs(np.where(known, distances, 0.0)) > 6.0 * np.maximum(noise, least))
    return SmoothedLog(signals, noise, outliers, intervals)


def followed_log(dataset: Dataset, parameters: FloatArray, resolution: Resolution) -> SmoothedLog | None:
    """Motion of the only log of a dataset as a model without equations follows it; None where the log is too short.

    Parameters
    ----------
    dataset : Dataset
        With one log.
    parameters : (n_p,) array
    resolution : Resolution
        With the timing of the inputs.
    """
    try:
        found = followed(LoDiransac(), dataset, parameters, resolution)
    except LogError:
        return None
    (one,), model = dataset.segments, dataset.model
    columns = [model.signals.index(n) for n in one.signals]
    signals = found.signals[: len(one)].copy()
    signals[one.gaps] = np.nan
    return SmoothedLog(signals, found.noise[columns], found.outliers[: len(one), columns])


def _of_pseudo_residuals(samples: FloatArray) -> FloatArray:
    """Robust noise ``(n_s,)`` of samples about the line between their neighbours; of two, their own deviation."""
    found = []
    for y in samples.T:
        rows = np.flatnonzero(np.isfinite(y))
        if len(rows) < 3:
            found.append(float(np.std(y[rows])) if len(rows) else 0.0)
            continue
        later = (rows[1:-1] - rows[:-2]) / (rows[2:] - rows[:-2])
        known = y[rows]
        residuals = known[1:-1] - (1.0 - later) * known[:-2] - later * known[2:]
        scaled = residuals / np.sqrt(1.0 + np.square(later) + np.square(1.0 - later))
        found.append(float(robust_std(scaled)))
    return np.array(found)


@dataclass(frozen=True, eq=False, repr=False)
class StartEstimator:
    """Estimates of states of one log, each from the samples of the rows before it.

    Parameters
    ----------
    intervals : Windows
        The log.
    acting : ActingInputs
    parameters : (n_p,) array
    states : (N, n_x) array
        States at every row, without the model: means of a prior, whose standard deviations are their spread.
    columns : (n_s,) int array
        Places of the segment's signals among the model's.
    finest : (n_s,) array
        Least standard deviation of each signal: that of one without noise.
    noise : (n_s,) array
        Standard deviation of each signal, its unit.
    scale : (n_s,) array
        By which samples are weighted: of what the model leaves of each signal.
    outliers : (N, n_s) bool array
        Samples that do not count.
    n_before : int
        Rows before a state whose samples determine it.
    """

    intervals: Windows
    acting: ActingInputs
    parameters: FloatArray
    states: FloatArray
    columns: IntArray
    finest: FloatArray
    noise: FloatArray
    scale: FloatArray
    outliers: BoolArray
    n_before: int

    @classmethod
    def of(
        cls, smoothed: SmoothedLog, segment: Segment, parameters: FloatArray, resolution: Resolution, states: FloatArray
    ) -> StartEstimator:
        """Estimates of states of a smoothed log.

        Parameters
        ----------
        smoothed : SmoothedLog
            With intervals.
        segment : Segment
        parameters : (n_p,) array
        resolution : Resolution
            With the timing of the inputs.
        states : (N, n_x) array
            States at every row, without the model.
        """
        assert smoothed.intervals is not None
        intervals = replace(smoothed.intervals, substeps=resolution.substeps)
        acting = resolution.timing.acting(segment.inputs, segment.log.dt, resolution.hold)
        values = np.pad(acting, ((0, len(intervals.measured) - len(acting)), (0, 0)), mode="edge")
        columns = np.array([intervals.model.signals.index(n) for n in segment.signals])
        # Samples without noise have the weight of noise of a millionth of their range.
        finest = 1e-6 * _width_of_bulk(segment.measured)
        noise = np.maximum(smoothed.noise, finest)
        longest = max((x.stop - x.start for x in runs(~segment.gaps)), default=0)
        n_before = max(1, min(intervals.length, longest // 2))
        inputs = ActingInputs(values, resolution.hold, resolution.timing)
        return cls(intervals, inputs, parameters, states, columns, finest, noise, noise, smoothed.outliers, n_before)

    def shorter(self) -> list[StartEstimator]:
        """The same, and those that use a half and a quarter of the rows, of five samples at least."""
        fewest = 5 * rows_per_sample(np.asarray(self.intervals.sampled.any(axis=1)))
        rows = {n for n in (self.n_before, self.n_before // 2, self.n_before // 4) if n >= min(fewest, self.n_before)}
        return [replace(self, n_before=n) for n in sorted(rows, reverse=True)]

    def refined(self, noise: FloatArray, scale: FloatArray, outliers: BoolArray) -> StartEstimator:
        """The same with other noise, scales, where they are finite, and outliers."""
        noise = np.maximum(noise, self.finest)
        scale = np.where(np.isfinite(scale), np.maximum(scale, noise), self.scale)
        return replace(self, noise=noise, scale=scale, outliers=outliers)

    def at(self, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """States at some rows, and how uncertain they are.

        Parameters
        ----------
        rows : (K,) int array
            Each with ``n_before`` rows before it that are in no gap.

        Returns
        -------
        (K, n_x) array
            Where a simulation diverges, the state without the model.
        (K, n_x, n_x) array
            Independent errors of each state, of one standard deviation, a row each.
        """
        segments, lanes = self._segments(rows - self.n_before), np.tile(self.parameters, (len(rows), 1))
        found = segments.gauss_newton(
            lanes, self._fitted(segments), self._weights(segments, self.noise), np.arange(len(rows))
        )
        information = found.normal_matrix * np.outer(self._spread, self._spread) + np.eye(len(self._spread))
        values, vectors = np.linalg.eigh(information)
        roots = (vectors / np.sqrt(np.maximum(values, 1.0))[:, None, :]).swapaxes(1, 2) * self._spread
        finite: BoolArray = np.asarray(np.isfinite(found.final_states).all(axis=1))
        states = np.where(finite[:, None], found.final_states, self.states[rows])
        return states, roots @ np.nan_to_num(found.final_slopes).swapaxes(1, 2)

    def drawn(self, rows: IntArray, firsts: IntArray) -> FloatArray:
        """States ``(K, n_x)`` at any rows, of simulations that follow the rows before, or the first ones of a stretch.

        Parameters
        ----------
        rows : (K,) int array
        firsts : (K,) int array
            First row of the stretch of each, which has ``n_before`` rows at least.
        """
        begins = np.maximum(rows - self.n_before, firsts)
        segments, lanes = self._segments(begins), np.tile(self.parameters, (1, len(rows), 1))
        longer = replace(segments, n_rows=self.n_before + 1)
        series = longer.trajectories(lanes, self._fitted(segments)[None])[0]
        states = series[np.arange(len(rows)), rows - begins, : self.states.shape[1]]
        return np.where(np.isfinite(states).all(axis=1, keepdims=True), states, self.states[rows])

    def errors(self, rows: IntArray, *, fitted: bool) -> FloatArray:
        """Simulated less measured signals ``(K, n_before, n_s)`` before some rows; NaN where unknown.

        Simulations are fitted to the samples, or start from the states without the model.
        """
        segments = self._segments(rows - self.n_before)
        found = np.full((len(rows), segments.n_rows, len(self.intervals.model.signals)), np.nan)
        states = self._fitted(segments) if fitted else self.states[segments.starts]
        errors = segments.errors(np.tile(self.parameters, (1, len(rows), 1)), states[None])[0]
        found[:, :, segments.columns] = np.where(segments.known, errors, np.nan)
        return found[:, :, self.columns]

    def _segments(self, begins: IntArray) -> Segments:
        """Segments of ``n_before`` rows."""
        return Segments(self.intervals, self.acting, begins, self.n_before)

    def _fitted(self, segments: Segments) -> FloatArray:
        """States ``(K, n_x)`` at the first row of each segment by the samples in it."""
        first, lanes = self.states[segments.starts][None], np.tile(self.parameters, (1, len(segments), 1))
        weights = self._weights(segments, self.scale)
        found: FloatArray = segments.estimated_states(lanes, first, self._spread, weights)[0]
        return found

    def _weights(self, segments: Segments, scale: FloatArray) -> FloatArray:
        """Weights of the compared signals in all rows, of scales ``(n_s,)``."""
        weights = np.zeros(self.intervals.sampled.shape)
        weights[: len(self.outliers), self.columns] = ~self.outliers / np.square(scale)
        return np.where(self.intervals.sampled, weights, 0.0)[:, segments.columns]

    @cached_property
    def _spread(self) -> FloatArray:
        """Standard deviation ``(n_x,)`` of the states' prior."""
        return size_or_one(np.std(self.states, axis=0))


def _width_of_bulk(values: FloatArray) -> FloatArray:
    """Range ``(n,)`` of the central 80 % of each column's finite values; 1 where it is 0."""
    found = [np.ptp(np.quantile(x[np.isfinite(x)], [0.1, 0.9])) if np.isfinite(x).any() else 0.0 for x in values.T]
    return size_or_one(np.array(found))
