"""Sparse nonlinear program of a plan, by direct transcription.

    minimise  sum_k cost(x_k, u_k)   over  x_0, ..., x_N, u_0, ..., u_(N-1), and durations of segments if time is free
    such that  x_(k+1) = integral of the dynamics over interval k from x_k with u_k held,
               the states that a waypoint names have its values at its knot,
               inputs and states keep to their limits.

A state that a waypoint fixes has its value for both limits. Functions and exact derivatives are flat arrays of entries;
entries of one place are summed.

References: Betts 2010, "Practical Methods for Optimal Control", chapter 4 (direct transcription).
"""

from __future__ import annotations

from functools import cached_property
from typing import TypeAlias

import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.flight.planning.stage import Costs, Stages, stage_of
from diransac.flight.planning.task import TIME_STEP, Task, sampled
from diransac.flight.trajectory import Trajectory

Guess: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]
"""Times (K,), s from the start; states (K, n_x) at them; inputs (K, n_u), held from each time on."""

INTERVAL_STEPS = 10
"""Integration steps of a full interval, over which inputs are held."""

FREE_INTERVALS = 20
"""Intervals of a segment of free duration; even, so that an input may switch in the middle."""


class Program:
    """Values and exact derivatives of the nonlinear program of a task.

    Solvers evaluate every function at the same point: costs and intervals are computed once per point.

    Parameters
    ----------
    task : the task
    rows : of each segment, an integration step from row to row; None: the durations of the segments are unknowns
    relaxed : whether waypoints but the first are approached at a cost instead of reached
    """

    def __init__(self, task: Task, rows: tuple[int, ...] | None, *, relaxed: bool = False) -> None:
        model = task.model
        self.task, self.free_time = task, rows is None
        n_segments, n_x = len(task.waypoints) - 1, len(model.state)
        if rows is None:
            self.intervals = (FREE_INTERVALS,) * n_segments
            shape = (sum(self.intervals), INTERVAL_STEPS)
            self.steps = np.full(shape, 1.0 / (FREE_INTERVALS * INTERVAL_STEPS))
        else:
            self.intervals = tuple(-(-n // INTERVAL_STEPS) for n in rows)
            counts = np.concatenate([_spread(n, k) for n, k in zip(rows, self.intervals, strict=True)])
            self.steps = np.where(np.arange(INTERVAL_STEPS) < counts[:, None], TIME_STEP, 0.0)
        self.knots = np.concatenate([[0], np.cumsum(self.intervals)])
        self.segments = np.repeat(np.arange(n_segments), self.intervals)
        n_stages, n_free = len(self.segments), n_segments * self.free_time
        self.states = np.arange((n_stages + 1) * n_x).reshape(n_stages + 1, n_x)
        self.inputs = self.states.size + np.arange(n_stages * model.n_u).reshape(n_stages, model.n_u)
        self.durations = self.states.size + self.inputs.size + np.arange(n_free)
        self.n_unknowns, self.n_constraints = self.states.size + self.inputs.size + n_free, n_stages * n_x
        self.lower, self.upper = self._limits(relaxed)
        self._stage = stage_of(model, self.free_time)
        self._stages = Stages(self._stage, task.parameters, self.steps, self._objective(relaxed))
        self._at = b""
        self._costs: tuple[FloatArray, FloatArray, FloatArray] | None = None
        self._intervals: tuple[FloatArray, FloatArray, FloatArray] | None = None

    def _limits(self, relaxed: bool) -> tuple[FloatArray, FloatArray]:
        """Limits (n_unknowns,) of the unknowns."""
        task = self.task
        lower, upper = np.full(self.n_unknowns, TIME_STEP), np.full(self.n_unknowns, np.inf)  # those of durations
        lower[self.states], upper[self.states] = task.states.lower, task.states.upper
        lower[self.inputs], upper[self.inputs] = task.inputs.lower, task.inputs.upper
        for knot, waypoint in zip(self.knots, task.waypoints[:1] if relaxed else task.waypoints, strict=False):
            fixed = self.states[knot, list(waypoint.states)]
            lower[fixed] = upper[fixed] = waypoint.values
        return lower, upper

    def _objective(self, relaxed: bool) -> Costs:
        """Cost of the knots and intervals."""
        task, lengths = self.task, self.steps.sum(axis=1)
        reference, weights = (np.zeros(self.states.shape) for _ in range(2))
        if relaxed:
            for knot, waypoint in zip(self.knots[1:], task.waypoints[1:], strict=True):
                states = list(waypoint.states)
                # Penalty on the distance from a waypoint, one over the state's unit squared.
                reference[knot, states], weights[knot, states] = waypoint.values, 1e4
        elif not self.free_time:
            for name, values in sampled(task.reference, np.concatenate([[0.0], np.cumsum(lengths)])).items():
                reference[:, task.model.state.index(name)] = values
            weights = np.outer(np.append(lengths, 0.0) + np.append(0.0, lengths), 0.5 * task.state_weights)
        return Costs(reference, weights, task.input_weights, task.trim, task.time_weight)

    # ------------------------------------------------------------------ values

    def objective(self, unknowns: FloatArray) -> float:
        """Cost of all knots and intervals."""
        return float(self._cost(unknowns)[0].sum())

    def gradient(self, unknowns: FloatArray) -> FloatArray:
        """Gradient (n_unknowns,) of the objective."""
        whole = np.zeros(self.n_unknowns)
        np.add.at(whole, self._of_stages, self._cost(unknowns)[1][:-1])
        n_s = self._of_knots.shape[1]
        np.add.at(whole, self._of_knots[-1], self._cost(unknowns)[1][-1, :n_s])
        return whole

    def constraints(self, unknowns: FloatArray) -> FloatArray:
        """Defects (n_constraints,) of the intervals, all zero in a solution."""
        after = self._integrated(unknowns)[1][:, : self.states.shape[1]]
        return np.asarray(unknowns[self.states[1:]] - after).ravel()

    # ------------------------------------------------------------------ derivatives

    @cached_property
    def jacobian_entries(self) -> tuple[IntArray, IntArray]:
        """Row and column of every entry of the constraints' Jacobian, in the order of `jacobian`."""
        defects = np.arange(self.n_constraints).reshape(-1, self.states.shape[1])
        shape = (*self._of_stages.shape, defects.shape[1])
        rows = np.broadcast_to(defects[:, None, :], shape), defects
        columns = np.broadcast_to(self._of_stages[:, :, None], shape), self.states[1:]
        return np.concatenate([a.ravel() for a in rows]), np.concatenate([a.ravel() for a in columns])

    def jacobian(self, unknowns: FloatArray) -> FloatArray:
        """Jacobian of the constraints."""
        blocks = -self._integrated(unknowns)[2][:, :, : self.states.shape[1]]
        return np.concatenate([blocks.ravel(), np.ones(self.n_constraints)])

    @cached_property
    def hessian_entries(self) -> tuple[IntArray, IntArray]:
        """Row and column of every entry of the Lagrangian's Hessian, its upper triangle, in the order of `hessian`."""
        (rows, columns), last = self._stage.triangle, self._of_knots[-1]
        n = len(last) * (len(last) + 1) // 2
        pairs = (
            np.concatenate([self._of_stages[:, rows].ravel(), last[rows[:n]]]),
            np.concatenate([self._of_stages[:, columns].ravel(), last[columns[:n]]]),
        )
        return np.minimum(*pairs), np.maximum(*pairs)

    def hessian(self, unknowns: FloatArray, objective_factor: float, multipliers: FloatArray) -> FloatArray:
        """Upper triangle of the Hessian of ``objective_factor * objective + multipliers . constraints``."""
        n_x, n_s = self.states.shape[1], self._of_knots.shape[1]
        weights = np.zeros((len(self._of_stages), n_s))
        weights[:, :n_x] = -multipliers.reshape(-1, n_x)
        entries = (objective_factor * self._cost(unknowns)[2]).ravel()
        self._integrated(unknowns)
        curved = self._stages.curvature(weights)
        entries[: curved.size] += curved.ravel()
        return entries[: curved.size + n_s * (n_s + 1) // 2]

    # ------------------------------------------------------------------ parts

    @cached_property
    def _of_knots(self) -> IntArray:
        """Unknowns (N + 1, n_s) of the state of each stage: of a knot, and with free time of the segment's duration."""
        if not self.free_time:
            return self.states
        return np.column_stack([self.states, self.durations[np.append(self.segments, self.segments[-1])]])

    @cached_property
    def _of_stages(self) -> IntArray:
        """Unknowns (N, n_z) of the state and input of each stage."""
        return np.hstack([self._of_knots[:-1], self.inputs])

    def _cost(self, unknowns: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Cost of every knot and its derivatives."""
        self._move(unknowns)
        if self._costs is None:
            self._costs = self._stages.cost()
        return self._costs

    def _integrated(self, unknowns: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """States before each step, and states and their derivatives after the intervals."""
        self._move(unknowns)
        if self._intervals is None:
            self._intervals = self._stages.integrate()
        return self._intervals

    def _move(self, unknowns: FloatArray) -> None:
        """Move to a point, unless this is it."""
        if self._at != (at := unknowns.tobytes()):
            self._costs = self._intervals = None
            self._stages.move(unknowns[self._of_knots], unknowns[self.inputs])
            self._at = at

    # ------------------------------------------------------------------ guesses and trajectories

    def unknowns_of(self, guess: Guess, durations: FloatArray | None = None) -> FloatArray:
        """Unknowns along a guess, clipped to the limits; with free time also the durations of the segments, s."""
        unknowns, lengths = np.zeros(self.n_unknowns), self.steps.sum(axis=1)
        if durations is not None:
            unknowns[self.durations] = durations
            lengths = lengths * durations[self.segments]
        time, (known, states, inputs) = np.concatenate([[0.0], np.cumsum(lengths)]), guess
        held = np.clip(np.searchsorted(known, time[:-1] + 1e-9, side="right") - 1, 0, len(known) - 1)
        unknowns[self.states] = np.column_stack([np.interp(time, known, column) for column in states.T])
        unknowns[self.inputs] = inputs[held]
        return np.clip(unknowns, self.lower, self.upper)

    def stretched(self, unknowns: FloatArray, durations: FloatArray) -> Guess:
        """Guess from a solution, with its segments stretched to other durations."""
        lengths = (durations / np.array(self.intervals))[self.segments]
        inputs = unknowns[self.inputs]
        return np.concatenate([[0.0], np.cumsum(lengths)]), unknowns[self.states], np.vstack([inputs, inputs[-1:]])

    def trajectory(self, unknowns: FloatArray) -> Trajectory:
        """Trajectory of a solution at fixed times, integrated from knot to knot; the last input is repeated."""
        task, unknowns = self.task, np.clip(unknowns, self.lower, self.upper)
        inputs, used = unknowns[self.inputs], self.steps > 0.0
        rows = np.concatenate([self._integrated(unknowns)[0][used], unknowns[self.states[-1:]]])
        return Trajectory(
            task.start + TIME_STEP * np.arange(len(rows), dtype=np.float64),
            rows,
            np.concatenate([np.repeat(inputs, used.sum(axis=1), axis=0), inputs[-1:]]),
            task.model.state,
            tuple(task.model.inputs),
            task.input_limits,
            cost=self.objective(unknowns),
        )


def _spread(total: int, parts: int) -> IntArray:
    """Whole numbers with this sum that differ by 1 at most."""
    return np.diff(np.arange(parts + 1) * total // parts)
