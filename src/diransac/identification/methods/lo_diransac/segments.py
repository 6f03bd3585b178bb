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
from diransac.identification.core.noise import lower_scale
from diransac.identification.core.windows import DIVERGED
from diransac.identification.regression.multistart import least_squares
from diransac.simulation import Measurements, RolloutBatch, rollouts

if TYPE_CHECKING:
    from diransac.identification.core.windows import Windows
    from diransac.identification.methods.lo_diransac.smoothing import Motion
    from diransac.simulation import GaussNewtonBatch, Simulator

_STATE_STEPS = 15
OUTLYING = 6.0
"""Robust standard deviations from which on a sample is far from a motion."""


@dataclass(frozen=True, eq=False, repr=False)
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

    def shifted(self, intervals: Windows, rows: int) -> ActingInputs:
        """Inputs that act some rows later, or earlier; those at the ends of a log are held."""
        every = np.arange(len(self.values))
        at = [np.clip(every[x] - rows, x.start, x.stop - 1) for x in intervals.rows_of_logs]
        return replace(self, values=self.values[np.concatenate(at)])

    @classmethod
    def recorded(cls, intervals: Windows, hold: str) -> ActingInputs:
        """Inputs that act as they were recorded."""
        return cls(intervals.recorded, hold, InputTiming())


@dataclass(frozen=True, eq=False, repr=False)
class Segments:
    """Segments of equal length of the rows of all logs.

    Parameters
    ----------
    intervals : Windows
        Logs, model and sub-steps; its own division is not used.
    acting : ActingInputs
    starts : (K,) int array
        First row of each segment.
    n_rows : int
        Rows of a segment.
    """

    intervals: Windows
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
        n = len(states) * len(self)
        return self._lanes(parameters.reshape(n, -1), states.reshape(n, -1), np.arange(n))

    def _lanes(self, parameters: FloatArray, states: FloatArray, lanes: IntArray) -> RolloutBatch:
        """Some lanes of a batch, each with its own parameters and state."""
        x, starts = self.intervals, self.starts[lanes % len(self)]
        if not x.layout.is_shared:
            parameters = np.take_along_axis(parameters, x.layout.index[x.log_of_row[starts]], axis=1)
        return RolloutBatch(parameters, states, self.acting.values, x.dt, starts, self.n_rows, x.first_of_log)

    def errors(self, parameters: FloatArray, states: FloatArray) -> FloatArray:
        """Simulated less measured signals ``(m, K, n_rows, n_s)``, huge from a divergence on; arguments as `batch`."""
        found = self._simulator.errors(
            self.batch(parameters, states), self.measurements, threads=self.intervals.threads
        )
        with np.errstate(over="ignore", invalid="ignore"):
            total = found.sum()
        if not np.isfinite(total):  # one pass instead of many
            found = np.nan_to_num(found, nan=DIVERGED, posinf=DIVERGED, neginf=-DIVERGED)
        return found.reshape(*states.shape[:2], self.n_rows, -1)

    def trajectories(self, parameters: FloatArray, states: FloatArray) -> FloatArray:
        """All signals of the model ``(m, K, n_rows, n_signals)``; arguments as `batch`."""
        found = self._simulator.trajectories(self.batch(parameters, states), threads=self.intervals.threads)
        return found.reshape(*states.shape[:2], self.n_rows, -1)

    def gauss_newton(
        self, parameters: FloatArray, states: FloatArray, weights: FloatArray, lanes: IntArray | None = None
    ) -> GaussNewtonBatch:
        """Least-squares sums of each lane with respect to its state, and then its parameters; or of some, to the state.

        Parameters
        ----------
        parameters, states : array
            As `batch`; with ``lanes``, ``(k, n)`` and ``(k, n_x)``.
        weights : (N, n_s) array
            Of the compared signals in all rows.
        lanes : (k,) int array, optional
            Lanes of a batch whose parameters are known.

        Returns
        -------
        GaussNewtonBatch
        """
        model = self.intervals.model
        if lanes is None:
            batch, unknowns = self.batch(parameters, states), (*model.state, *model.parameters)
        else:
            batch, unknowns = self._lanes(parameters, states, lanes), tuple(model.state)
        return self._simulator.gauss_newton(
            batch, self.measurements, weights, unknowns=unknowns, threads=self.intervals.threads
        )

    def estimated_states(
        self, parameters: FloatArray, states: FloatArray, spread: FloatArray, weights: FloatArray
    ) -> FloatArray:
        """Initial states ``(m, K, n_x)`` by weighted least squares of each segment's samples, and of the states' prior.

        Parameters
        ----------
        parameters : (m, K, n) array
        states, spread : (m, K, n_x) and (n_x,) array
            Means of the prior, from which the search starts, and its standard deviations.
        weights : (N, n_s) array
            Of the compared signals in all rows.

        Returns
        -------
        (m, K, n_x) array
        """
        flat, n = states.reshape(-1, states.shape[2]), parameters.shape[2]
        problem = _States(self, parameters.reshape(-1, n), flat, spread, weights)
        found, _ = least_squares(problem, flat, _STATE_STEPS)
        return found.reshape(states.shape)


@dataclass(frozen=True, eq=False, repr=False)
class _States:
    """Initial states of segments with given parameters, with a Gaussian prior: few samples may not determine them."""

    segments: Segments
    parameters: FloatArray
    mean: FloatArray
    spread: FloatArray
    weights: FloatArray

    def moved(self, now: FloatArray, step: FloatArray) -> FloatArray:
        return now + step

    def linearized(self, z: FloatArray, lanes: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        found = self.segments.gauss_newton(self.parameters[lanes], z, self.weights, lanes)
        away = (z - self.mean[lanes]) / self.spread
        cost, matrix = found.cost + np.square(away).sum(axis=1), found.normal_matrix + np.diag(self.spread**-2.0)
        return cost, found.gradient + away / self.spread, matrix


def stretches(intervals: Windows) -> list[slice]:
    """Rows of the logs between gaps.

    Parameters
    ----------
    intervals : Windows

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


def whole_stretches(intervals: Windows) -> list[slice]:
    """Stretches that are at least half as long as the longest: whole logs, but for pieces between gaps.

    Parameters
    ----------
    intervals : Windows
    """
    parts = stretches(intervals)
    longest = max((x.stop - x.start for x in parts), default=0)
    return [x for x in parts if 2 * (x.stop - x.start) >= longest]


def inlying_samples(intervals: Windows, motion: Motion) -> BoolArray:
    """Mask ``(N, n_signals)`` of the samples that are not far from a smoothed motion, in units of what it leaves.

    Parameters
    ----------
    intervals : Windows
    motion : Motion

    Returns
    -------
    (N, n_signals) bool array
        True where nothing is measured.
    """
    apart = np.where(intervals.known, np.nan_to_num(intervals.measured - motion.signals), 0.0)
    return np.asarray(~(np.abs(apart) > OUTLYING * lower_scale(apart, intervals.known)))


def prior_states(
    intervals: Windows, motion: Motion, inlying: BoolArray, rows: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Means ``(K, n_x)`` and standard deviations ``(n_x,)`` of states before their segments are known.

    The means are measured where a sample is no outlier, else those of a motion, else zero; the deviations are the
    spread of the motion, infinite for states of which it tells nothing.

    Parameters
    ----------
    intervals : Windows
    motion : Motion
    inlying : (N, n_signals) bool array
        Samples that are no outliers.
    rows : (K,) int array

    Returns
    -------
    (K, n_x) array, (n_x,) array
    """
    n_x = intervals.model.n_q + intervals.model.n_v
    smooth, known = motion.signals[:, :n_x], (intervals.known & inlying)[rows, :n_x]
    means = np.where(known, intervals.measured[rows, :n_x], np.nan_to_num(smooth[rows]))
    return means, np.where(np.ptp(smooth, axis=0) > 0.0, motion.spread[:n_x], np.inf)
