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

Start = tuple[slice, FloatArray]
"""Rows of a log that one simulation covers, without a gap, and the state ``(n_x,)`` at the first."""


@dataclass(frozen=True, eq=False, repr=False)
class Scores:
    """Agreement of hypotheses with a dataset; each hypothesis is a lane.

    Parameters
    ----------
    n_rows : tuple of int
        Rows of each log.
    simulations : sequence of (int, slice, ScoreBatch)
        Index of the log, rows and scores of each simulation.
    """

    n_rows: tuple[int, ...]
    simulations: Sequence[tuple[int, slice, ScoreBatch]]

    @cached_property
    def sum_squares(self) -> FloatArray:
        """Squared errors ``(n_lanes, n_s)`` over the rows that count; infinite where a rollout diverged."""
        return np.asarray(np.sum([x.sum_squares for _, _, x in self.simulations], axis=0))

    @cached_property
    def inlier_count(self) -> IntArray:
        """Number of inliers ``(n_lanes,)``."""
        return np.asarray(np.sum([x.inlier_count for _, _, x in self.simulations], axis=0))

    def of_log(self, i: int) -> Scores:
        """The scores of one log."""
        return replace(self, simulations=[x for x in self.simulations if x[0] == i])

    def inlier_masks(self, lane: int) -> list[BoolArray]:
        """Inliers ``(N,)`` of one hypothesis over all rows of each log; False in rows that do not count."""
        masks = [np.zeros(n, bool) for n in self.n_rows]
        for log, rows, scores in self.simulations:
            masks[log][rows] = scores.inliers(lane)
        return masks


def starts_of(one: Segment, rule: str | Mapping[str, float]) -> list[Start]:
    """Simulations of a log between its gaps, whose initial states follow a rule of ``Settings.initial_state``.

    After a gap, where given values do not hold, the rule is "robust" in their place.

    Raises
    ------
    LogError
        The log lacks a state on which a measured signal depends.
    """
    later = rule if isinstance(rule, str) else "robust"
    rules = [rule, *(later for _ in one.stretches[1:])]
    return [(rows, one.part(rows).initial_state(x)) for rows, x in zip(one.stretches, rules, strict=True)]


class Simulation:
    """Simulations of the logs of a dataset, driven by their inputs.

    Parameters
    ----------
    dataset : Dataset
    signals : (n_s,) bool array, optional
        Signals of the dataset that are compared with the measured ones; None: all.
    resolution : Resolution, optional
        Integrator, steps per sample, hold and timing of the inputs.
    threads : int, optional
        Number of threads; None: one per core.
    """

    def __init__(
        self,
        dataset: Dataset,
        signals: BoolArray | None = None,
        resolution: Resolution | None = None,
        threads: int | None = None,
    ) -> None:
        compared = np.ones(len(dataset.signals), bool) if signals is None else signals
        resolution = resolution or Resolution()
        names = [n for n, j in zip(dataset.signals, compared, strict=True) if j]
        self.segments, self._layout = dataset.segments, dataset.layout
        self._threads = threads or default_threads()
        self._simulator: Simulator = rollouts(
            dataset.model, names, integrator=resolution.integrator, substeps=resolution.substeps, hold=resolution.hold
        )
        self._measured = [np.ascontiguousarray(one.measured[:, compared]) for one in dataset.segments]
        self._inputs = [resolution.timing.acting(one.inputs, one.log.dt, resolution.hold) for one in dataset.segments]

    def score(
        self,
        starts: Sequence[Sequence[Start]],
        parameters: FloatArray,
        thresholds: FloatArray,
        min_inlier_signals: int,
    ) -> Scores:
        """Sums of squared errors and inliers of every hypothesis over all logs.

        Parameters
        ----------
        starts : sequence of sequence of Start
            Simulations of each log.
        parameters : (n_lanes, n) array
            Hypotheses, each parameter in its unit.
        thresholds : (n_s,) array
            Inlier thresholds of the compared signals.
        min_inlier_signals : int
            Number of signals of a row that must be below their thresholds.
        """
        simulations = []
        for i, (one, values) in enumerate(zip(self.segments, self._measured, strict=True)):
            own = self._layout.of_log(parameters, i)
            for rows, state in starts[i]:
                lanes = RolloutBatch(own, state, self._inputs[i][rows], one.log.dt)
                measured = Measurements(values[rows], one.valid[rows])
                if np.isnan(measured.values[measured.valid]).any():
                    scores = _incomplete_scores(self._simulator, lanes, measured, thresholds, min_inlier_signals)
                else:
                    scores = self._simulator.score(
                        lanes, measured, thresholds, min_inlier_signals, threads=self._threads
                    )
                simulations.append((i, rows, scores))
        return Scores(tuple(map(len, self.segments)), simulations)

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
        batch = self._restarted(log, parameters, states, start_rows, n_rows)
        measured = np.nan_to_num(self._measured[log])
        measured = np.pad(measured, ((0, len(batch.inputs) - len(measured)), (0, 0)), mode="edge")
        return self._simulator.errors(batch, Measurements(measured, np.ones(len(measured), bool)))

    def trajectories(
        self, log: int, parameters: FloatArray, states: FloatArray, start_rows: IntArray, n_rows: int
    ) -> FloatArray:
        """All signals of the model ``(K, n_rows, n_signals)``; parameters as those of `errors`."""
        return self._simulator.trajectories(self._restarted(log, parameters, states, start_rows, n_rows))

    def _restarted(
        self, log: int, parameters: FloatArray, states: FloatArray, start_rows: IntArray, n_rows: int
    ) -> RolloutBatch:
        one, inputs = self.segments[log], self._inputs[log]
        inputs = np.pad(inputs, ((0, max(0, int(start_rows.max()) + n_rows - len(one))), (0, 0)), mode="edge")
        return RolloutBatch(np.tile(parameters, (len(states), 1)), states, inputs, one.log.dt, start_rows, n_rows)


def _incomplete_scores(
    simulator: Simulator, lanes: RolloutBatch, measured: Measurements, thresholds: FloatArray, min_inlier_signals: int
) -> ScoreBatch:
    """Scores of a log with slow signals, or sensors, each of which is compared where it has samples.

    The mean square of a signal is that of its samples, and counts for all rows that count.  Of the signals that a row
    lacks, none need be an inlier: a row needs the same fraction of its own.
    """
    known = np.isfinite(measured.values) & measured.valid[:, None]
    errors = simulator.errors(lanes, replace(measured, values=np.nan_to_num(measured.values)))
    sizes = np.where(known, np.abs(np.nan_to_num(errors, nan=np.inf)), 0.0)
    squares = np.square(sizes).sum(axis=1) * measured.valid.sum() / np.maximum(known.sum(axis=0), 1)
    judged = thresholds > 0.0
    needed = np.ceil(min_inlier_signals * (known & judged).sum(axis=1) / max(1, judged.sum()))
    inliers = ((known & (sizes < thresholds)).sum(axis=2) >= np.maximum(needed, 1.0)) & measured.valid
    bits = np.packbits(inliers, axis=0, bitorder="little")
    return ScoreBatch(lanes, squares, inliers.sum(axis=1), ~np.isfinite(squares).all(axis=1), bits)
