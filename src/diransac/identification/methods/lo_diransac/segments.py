"""Simulations of segments of the logs, each with an initial state of its own.

They need neither derivatives nor smoothing: measured samples alone determine the initial states, and, where these are
unknown, too, the parameters (output error).  The same segments score predictions: the samples at their beginning
determine the state, and those after it are predicted.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.data.input_timing import InputTiming
from diransac.identification.multistart import least_squares
from diransac.simulation import Measurements, RolloutBatch, rollouts

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.normal_equations import Fit
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
    from diransac.simulation import GaussNewtonBatch, Simulator

__all__ = ["ActingInputs", "Segments", "first_states", "stretches"]

_DIVERGED = 1e6
_STATE_STEPS = 15


@dataclass(frozen=True)
class ActingInputs:
    """Inputs as they act.

    Parameters
    ----------
    values : (N, n_u) array
        In all rows of all logs.
    hold : str
        From row to row, one of `HOLDS`.
    timing : InputTiming
        Of the recorded inputs.
    fitted : bool, optional
        Whether a fit has changed them, by their timing or by what it left out of them.
    """

    values: FloatArray
    hold: str
    timing: InputTiming
    fitted: bool = False

    @property
    def sentence(self) -> str:
        """Hold in words, and whether they are those of a fit."""
        how = {"zero-order": "held", "linear": "linear", "smooth": "smooth"}[self.hold]
        return f"{how} inputs" + (" as in the fit" if self.fitted else "")

    def differs(self, others: Iterable[ActingInputs]) -> bool:
        """True if no other has the same values, held alike."""
        return not any(self.hold == x.hold and np.array_equal(self.values, x.values) for x in others)

    def shifted(self, intervals: ShootingIntervals, rows: int) -> ActingInputs:
        """Inputs that act some rows later, or earlier; those at the ends of a log are held."""
        every = np.arange(len(self.values))
        at = [np.clip(every[x] - rows, x.start, x.stop - 1) for x in intervals.rows_of_logs]
        return replace(self, values=self.values[np.concatenate(at)])

    @classmethod
    def recorded(cls, intervals: ShootingIntervals, hold: str) -> ActingInputs:
        """Inputs that act as they were recorded."""
        return cls(intervals.recorded, hold, InputTiming())

    @classmethod
    def of_fit(cls, intervals: ShootingIntervals, fit: Fit, timing: InputTiming) -> ActingInputs:
        """Inputs with the timing of a fit, significant or not, which is named by ``timing``."""
        values = intervals.inputs + fit.shared[-1] * intervals.moving_inputs[:, intervals.model.n_u :]
        return cls(values, intervals.hold, timing, fitted=True)


@dataclass(frozen=True)
class Segments:
    """Segments of equal length of the rows of all logs.

    Parameters
    ----------
    intervals : ShootingIntervals
        Logs, model and sub-steps; its own division is not used.
    acting : ActingInputs
    starts : (K,) int array
        First row of each segment.
    n_rows : int
        Rows of a segment.
    """

    intervals: ShootingIntervals
    acting: ActingInputs
    starts: IntArray
    n_rows: int

    def __len__(self) -> int:
        return len(self.starts)

    @cached_property
    def columns(self) -> IntArray:
        """Columns of the signals that are compared: measured ones, quaternions as a whole."""
        seen = np.array(self.intervals.sampled.any(axis=0))
        for four in self.intervals.model.quaternions:
            seen[list(four)] = seen[list(four)].any()
        return np.flatnonzero(seen)

    @cached_property
    def rows(self) -> IntArray:
        """Rows ``(K, n_rows)`` of each segment."""
        return np.asarray(self.starts[:, None] + np.arange(self.n_rows))

    @cached_property
    def known(self) -> BoolArray:
        """Measured samples ``(K, n_rows, n_s)`` of the compared signals."""
        return self.intervals.sampled[self.rows][:, :, self.columns]

    def weights(self, values: FloatArray) -> FloatArray:
        """Weights ``(N, n_s)`` of the compared signals in all rows from those of the segments ``(K, n_rows, n_s)``."""
        found = np.zeros((len(self.intervals.measured), len(self.columns)))
        found[self.rows.ravel()] = values.reshape(-1, len(self.columns))
        return found

    @cached_property
    def measurements(self) -> Measurements:
        """Compared signals in all rows."""
        values = np.ascontiguousarray(self.intervals.measured[:, self.columns])
        return Measurements(values, np.ones(len(values), bool))

    @cached_property
    def _simulator(self) -> Simulator:
        model = self.intervals.model
        names = [model.signals[k] for k in self.columns]
        return rollouts(model, names, substeps=self.intervals.substeps, hold=self.acting.hold)

    def batch(self, parameters: FloatArray, states: FloatArray) -> RolloutBatch:
        """Lanes of all segments, repeated for each set of parameters.

        Parameters
        ----------
        parameters : (m, K, n) array
            All parameters, each segment's own.
        states : (m, K, n_x) array

        Returns
        -------
        RolloutBatch
        """
        x, m = self.intervals, len(states)
        logs = np.tile(x.log_of_row[self.starts], m)
        own = parameters.reshape(m * len(self), -1)
        if not x.layout.is_shared:
            own = np.take_along_axis(own, x.layout.index[logs], axis=1)
        starts = np.tile(self.starts, m)
        flat = states.reshape(m * len(self), -1)
        return RolloutBatch(own, flat, self.acting.values, x.dt, starts, self.n_rows, x.first_of_log)

    def errors(self, parameters: FloatArray, states: FloatArray) -> FloatArray:
        """Simulated less measured signals ``(m, K, n_rows, n_s)``, huge from a divergence on; arguments as `batch`."""
        found = self._simulator.errors(
            self.batch(parameters, states), self.measurements, threads=self.intervals.threads
        )
        found = np.nan_to_num(found, nan=_DIVERGED, posinf=_DIVERGED, neginf=-_DIVERGED)
        return found.reshape(*states.shape[:2], self.n_rows, -1)

    def trajectories(self, parameters: FloatArray, states: FloatArray) -> FloatArray:
        """All signals of the model ``(m, K, n_rows, n_signals)``; arguments as `batch`."""
        found = self._simulator.trajectories(self.batch(parameters, states), threads=self.intervals.threads)
        return found.reshape(*states.shape[:2], self.n_rows, -1)

    def gauss_newton(
        self, parameters: FloatArray, states: FloatArray, weights: FloatArray, *, parameters_too: bool
    ) -> GaussNewtonBatch:
        """Least-squares sums of each lane with respect to its state, and then its parameters.

        Parameters
        ----------
        parameters, states : array
            As `batch`.
        weights : (N, n_s) array
            Of the compared signals in all rows.
        parameters_too : bool

        Returns
        -------
        GaussNewtonBatch
        """
        model = self.intervals.model
        unknowns = (*model.state, *model.parameters) if parameters_too else tuple(model.state)
        batch = self.batch(parameters, states)
        return self._simulator.gauss_newton(
            batch, self.measurements, weights, unknowns=unknowns, threads=self.intervals.threads
        )

    def estimated_states(self, parameters: FloatArray, states: FloatArray, weights: FloatArray) -> FloatArray:
        """Initial states ``(m, K, n_x)`` by weighted least squares of each segment's samples.

        Parameters
        ----------
        parameters : (m, K, n) array
        states : (m, K, n_x) array
            To start from.
        weights : (N, n_s) array
            Of the compared signals in all rows.

        Returns
        -------
        (m, K, n_x) array
        """
        problem = _States(self, parameters, weights)
        found, _ = least_squares(problem, states.reshape(-1, states.shape[2]), _STATE_STEPS)
        return found.reshape(states.shape)

    def cut(self, n_rows: int) -> Segments:
        """The beginnings of the segments."""
        return replace(self, n_rows=n_rows)


@dataclass(frozen=True)
class _States:
    """Initial states of segments with given parameters."""

    segments: Segments
    parameters: FloatArray
    weights: FloatArray

    def moved(self, now: FloatArray, step: FloatArray) -> FloatArray:
        return now + step

    def linearized(self, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        states = z.reshape(*self.parameters.shape[:2], -1)
        found = self.segments.gauss_newton(self.parameters, states, self.weights, parameters_too=False)
        return found.cost, found.gradient, found.normal_matrix


def stretches(intervals: ShootingIntervals) -> list[slice]:
    """Rows of the logs between gaps.

    Parameters
    ----------
    intervals : ShootingIntervals

    Returns
    -------
    list of slice
    """
    usable = intervals.is_logged & ~intervals.gaps
    edges = np.zeros(len(usable) + 1, bool)
    edges[intervals.first_of_log] = True
    begins = usable & (~np.concatenate([[False], usable[:-1]]) | edges[:-1])
    ends = usable & (~np.concatenate([usable[1:], [False]]) | edges[1:])
    return [slice(a, b + 1) for a, b in zip(np.flatnonzero(begins), np.flatnonzero(ends), strict=True)]


def first_states(intervals: ShootingIntervals, signals: FloatArray, inlying: BoolArray, rows: IntArray) -> FloatArray:
    """States ``(K, n_x)`` to start from: measured where a sample is no outlier, else those of a motion, else zero.

    Parameters
    ----------
    intervals : ShootingIntervals
    signals : (N, n_signals) array
        A motion.
    inlying : (N, n_signals) bool array
        Samples that are no outliers.
    rows : (K,) int array

    Returns
    -------
    (K, n_x) array
    """
    n_x = intervals.model.n_q + intervals.model.n_v
    known = (intervals.known & inlying)[rows, :n_x]
    return np.where(known, intervals.measured[rows, :n_x], np.nan_to_num(signals[rows, :n_x]))
