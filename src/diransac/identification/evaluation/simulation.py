"""Simulations of the logs of a dataset: scores of hypotheses, errors in windows, trajectories."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.data.dataset import Dataset
from diransac.data.segment import Segment
from diransac.identification.diagnosis import Resolution
from diransac.simulation import Measurements, RolloutBatch, ScoreBatch, Simulator, default_threads, rollouts


@dataclass(frozen=True, eq=False, repr=False)
class Scores:
    """Agreement of hypotheses with a dataset; each hypothesis is a lane.

    Parameters
    ----------
    sum_squares : (n_lanes, n_s) array
        Squared errors summed over the rows that count, each signal's unit squared; infinite where a rollout diverged.
    inlier_count : (n_lanes,) int array
        Number of inliers.
    logs : tuple of LogScores
        Scores of each log.
    """

    sum_squares: FloatArray
    inlier_count: IntArray
    logs: tuple[LogScores, ...]

    def inlier_masks(self, lane: int) -> list[BoolArray]:
        """Inliers ``(N,)`` of one hypothesis over all rows of each log; False in rows that do not count."""
        return [one.inliers(lane) for one in self.logs]


@dataclass(frozen=True)
class LogScores:
    """Agreement of hypotheses with one log.

    Parameters
    ----------
    n_rows : int
        Number of rows of the log.
    stretches : tuple of (slice, ScoreBatch)
        Rows of each simulation, and its scores.
    """

    n_rows: int
    stretches: tuple[tuple[slice, ScoreBatch], ...]

    @property
    def sum_squares(self) -> FloatArray:
        """Squared errors summed over the rows that count, (n_lanes, n_s)."""
        first, *others = (batch.sum_squares for _, batch in self.stretches)
        return sum(others, first)

    @property
    def inlier_count(self) -> IntArray:
        """Number of inliers, (n_lanes,)."""
        first, *others = (batch.inlier_count for _, batch in self.stretches)
        return sum(others, first)

    def inliers(self, lane: int) -> BoolArray:
        """Inliers ``(n_rows,)`` of one hypothesis."""
        found = np.zeros(self.n_rows, bool)
        for rows, batch in self.stretches:
            found[rows] = batch.inliers(lane)
        return found


@dataclass(frozen=True)
class Stretch:
    """Rows of a log that one simulation covers.

    Parameters
    ----------
    rows : slice
        Rows without a gap.
    rule : str or mapping of str to float
        Rule of the initial state, as ``Settings.initial_state``.
    """

    rows: slice
    rule: str | Mapping[str, float]


def stretches_of(one: Segment, rule: str | Mapping[str, float]) -> tuple[Stretch, ...]:
    """Stretches of a log between its gaps.

    Parameters
    ----------
    one : Segment
    rule : str or mapping of str to float
        Of the first row.  After a gap, where given values do not hold, it is "robust" in their place.

    Returns
    -------
    tuple of Stretch
    """
    first, *others = one.stretches
    later = rule if isinstance(rule, str) else "robust"
    return (Stretch(first, rule), *(Stretch(rows, later) for rows in others))


@dataclass(frozen=True, eq=False, repr=False)
class _Run:
    """Data of the simulation of a stretch: all but its parameters.

    Parameters
    ----------
    rows : slice
        Rows of the log.
    state : (n_x,) array
        State at the first row.
    inputs : (N, n_u) array
    measured : Measurements
    is_complete : bool
        True if no signal is missing in a row that counts.
    """

    rows: slice
    state: FloatArray
    inputs: FloatArray
    measured: Measurements
    is_complete: bool

    @classmethod
    def of(cls, rows: slice, state: FloatArray, inputs: FloatArray, measured: Measurements) -> _Run:
        """Run over some rows of a log."""
        own = Measurements(measured.values[rows], measured.valid[rows])
        return cls(rows, state, inputs[rows], own, not np.isnan(own.values[own.valid]).any())


class Simulation:
    """Simulations of the logs of a dataset, driven by their inputs.

    No simulation passes through a gap: it ends there, and another one begins after it.

    Parameters
    ----------
    dataset : Dataset
    signals : (n_s,) bool array, optional
        Signals of the dataset that are compared with the measured ones; None: all.
    resolution : Resolution, optional
        Integrator, steps per sample, hold and timing of the inputs.
    stretches : sequence of tuple of Stretch, optional
        Simulations of each log in `score`; None: from the first samples, and those after each gap.
    threads : int, optional
        Number of threads; None: one per core.
    """

    def __init__(
        self,
        dataset: Dataset,
        signals: BoolArray | None = None,
        resolution: Resolution | None = None,
        stretches: Sequence[tuple[Stretch, ...]] | None = None,
        threads: int | None = None,
    ) -> None:
        compared = np.ones(len(dataset.signals), bool) if signals is None else signals
        resolution = resolution or Resolution()
        names = [n for n, j in zip(dataset.signals, compared, strict=True) if j]
        self.segments, self._layout = dataset.segments, dataset.layout
        self._stretches = [stretches_of(one, "first") for one in dataset.segments] if stretches is None else stretches
        self._threads = threads or default_threads()
        self._simulator: Simulator = rollouts(
            dataset.model, names, integrator=resolution.integrator, substeps=resolution.substeps, hold=resolution.hold
        )
        self._measured = [
            Measurements(np.ascontiguousarray(one.measured[:, compared]), one.valid) for one in dataset.segments
        ]
        self._inputs = [resolution.timing.acting(one.inputs, one.log.dt, resolution.hold) for one in dataset.segments]

    @cached_property
    def starts(self) -> list[list[tuple[slice, FloatArray]]]:
        """Rows of each simulation of each log, and its initial state ``(n_x,)``.

        Raises
        ------
        LogError
            A log lacks a state on which a measured signal depends.
        """
        pairs = zip(self.segments, self._stretches, strict=True)
        return [[(x.rows, one.part(x.rows).initial_state(x.rule)) for x in stretches] for one, stretches in pairs]

    def score(self, parameters: FloatArray, thresholds: FloatArray, min_inlier_signals: int) -> Scores:
        """Sums of squared errors and inliers of every hypothesis over all logs.

        Parameters
        ----------
        parameters : (n_lanes, n) array
            Hypotheses, each parameter in its unit.
        thresholds : (n_s,) array
            Inlier thresholds of the compared signals.
        min_inlier_signals : int
            Number of signals of a row that must be below their thresholds.

        Returns
        -------
        Scores
        """
        logs = []
        for i, (one, runs_of_log) in enumerate(zip(self.segments, self._runs, strict=True)):
            own, found = self._layout.of_log(parameters, i), []
            for run in runs_of_log:
                lanes = RolloutBatch(own, run.state, run.inputs, one.log.dt)
                found.append((run.rows, self._score(lanes, run, thresholds, min_inlier_signals)))
            logs.append(LogScores(len(one), tuple(found)))
        sums, counts = logs[0].sum_squares, logs[0].inlier_count
        for other in logs[1:]:
            sums, counts = sums + other.sum_squares, counts + other.inlier_count
        return Scores(sums, counts, tuple(logs))

    @cached_property
    def _runs(self) -> list[list[_Run]]:
        """Simulations of each log; see `starts`."""
        parts = zip(self.starts, self._inputs, self._measured, strict=True)
        return [[_Run.of(*start, inputs, measured) for start in starts] for starts, inputs, measured in parts]

    def _score(self, lanes: RolloutBatch, run: _Run, thresholds: FloatArray, min_inlier_signals: int) -> ScoreBatch:
        """Scores of a stretch."""
        if not run.is_complete:
            return _incomplete_scores(self._simulator, lanes, run.measured, thresholds, min_inlier_signals)
        return self._simulator.score(lanes, run.measured, thresholds, min_inlier_signals, threads=self._threads)

    def errors(
        self, log: int, parameters: FloatArray, states: FloatArray, start_rows: IntArray, n_rows: int
    ) -> FloatArray:
        """Simulated less measured signals of one log in windows that start from given states.

        Parameters
        ----------
        log : int
            Index of the log.
        parameters : (n_p,) array
            Parameters of the model.
        states : (K, n_x) array
            Initial state of each window.
        start_rows : (K,) int array
            First row of each window; rows past the end of the log repeat its last one.
        n_rows : int
            Number of rows of a window.

        Returns
        -------
        (K, n_rows, n_s) array
            NaN from a divergence on; a missing sample counts as measured 0.
        """
        batch, measured = self._restarted(log, parameters, states, start_rows, n_rows)
        return self._simulator.errors(batch, measured)

    def trajectories(
        self, log: int, parameters: FloatArray, states: FloatArray, start_rows: IntArray, n_rows: int
    ) -> FloatArray:
        """All signals of the model ``(K, n_rows, n_signals)``; parameters as those of `errors`."""
        return self._simulator.trajectories(self._restarted(log, parameters, states, start_rows, n_rows)[0])

    def _restarted(
        self, log: int, parameters: FloatArray, states: FloatArray, start_rows: IntArray, n_rows: int
    ) -> tuple[RolloutBatch, Measurements]:
        one, measured = self.segments[log], np.nan_to_num(self._measured[log].values)
        more = ((0, max(0, int(start_rows.max()) + n_rows - len(one))), (0, 0))
        inputs, measured = (np.pad(x, more, mode="edge") for x in (self._inputs[log], measured))
        lanes = np.tile(parameters, (len(states), 1))
        batch = RolloutBatch(lanes, states, inputs, one.log.dt, start_rows, n_rows)
        return batch, Measurements(measured, np.ones(len(measured), bool))


def _incomplete_scores(
    simulator: Simulator, lanes: RolloutBatch, measured: Measurements, thresholds: FloatArray, min_inlier_signals: int
) -> ScoreBatch:
    """Scores of a log with slow signals, or sensors, each of which is compared where it has samples.

    The mean square of a signal is that of its samples, and counts for all rows that count.  Of the signals that a row
    lacks, none need be an inlier: a row needs the same fraction of its own.
    """
    known = np.isfinite(measured.values) & measured.valid[:, None]
    errors = simulator.errors(lanes, replace(measured, values=np.nan_to_num(measured.values)))
    weight = measured.valid.sum() / np.maximum(known.sum(axis=0), 1)
    squares = np.where(known, np.square(np.nan_to_num(errors, nan=np.inf)), 0.0).sum(axis=1) * weight
    judged = thresholds > 0.0
    needed = np.ceil(min_inlier_signals * (known & judged).sum(axis=1) / max(1, judged.sum()))
    near = (known & (np.abs(np.nan_to_num(errors, nan=np.inf)) < thresholds)).sum(axis=2)
    inliers = (near >= np.maximum(needed, 1.0)) & measured.valid
    diverged = ~np.isfinite(squares).all(axis=1)
    bits = np.packbits(inliers, axis=0, bitorder="little")
    return ScoreBatch(lanes, squares, inliers.sum(axis=1), diverged, bits)
