"""Sparse nonlinear program of a plan, by direct transcription.

    minimise  sum_k cost(s_k, u_k)   over  s_0, u_0, s_1, u_1, ..., s_N
    such that  s_(k+1) = integral of the dynamics over interval k from s_k with u_k held,
               the states that a waypoint names have its values at its knot,
               inputs and states keep to their limits.

With free time the duration of a segment is a state of every stage: constant within the segment, and set for the next
one by an input of the segment's last stage. Unknowns and constraints are ordered stage by stage, defects before
waypoints: the structure that solvers for optimal control detect.

References: Betts 2010, "Practical Methods for Optimal Control", chapter 4 (direct transcription).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.flight.planning.stage import Costs, Interval, Stage

__all__ = ["Layout", "Numbers", "Program"]


@dataclass(frozen=True)
class Layout:
    """Index of each unknown and each constraint of a plan.

    Parameters
    ----------
    n_x, n_u : states and inputs of the model
    intervals : number of intervals of each segment
    pinned : of each waypoint, the indices of the states that it fixes
    free_time : whether the durations of the segments are unknowns
    """

    n_x: int
    n_u: int
    intervals: tuple[int, ...]
    pinned: tuple[tuple[int, ...], ...]
    free_time: bool

    @property
    def n_s(self) -> int:
        """Number of states of a stage."""
        return self.n_x + self.free_time

    @property
    def n_stages(self) -> int:
        """Number of intervals of all segments; there is one knot more."""
        return sum(self.intervals)

    @cached_property
    def waypoint_knots(self) -> IntArray:
        """Knot of each waypoint."""
        return np.concatenate([[0], np.cumsum(self.intervals)])

    @cached_property
    def segment_of(self) -> IntArray:
        """Segment of each stage (N,)."""
        return np.repeat(np.arange(len(self.intervals)), self.intervals)

    @cached_property
    def ends_segment(self) -> BoolArray:
        """Mask (N,) of the stages after which a segment with another duration begins."""
        ends = np.zeros(self.n_stages, bool)
        ends[self.waypoint_knots[1:-1] - 1] = self.free_time
        return ends

    @cached_property
    def _stage_starts(self) -> IntArray:
        sizes = self.n_s + self.n_u + self.ends_segment
        return np.concatenate([[0], np.cumsum(sizes)])

    @cached_property
    def states(self) -> IntArray:
        """Indices (N + 1, n_s) of the states of each knot among the unknowns."""
        return self._stage_starts[:, None] + np.arange(self.n_s)

    @cached_property
    def inputs(self) -> IntArray:
        """Indices (N, n_u) of the inputs of each stage among the unknowns."""
        return self._stage_starts[:-1, None] + self.n_s + np.arange(self.n_u)

    @cached_property
    def next_durations(self) -> IntArray:
        """Indices of the inputs that set the duration of the next segment among the unknowns."""
        return self._stage_starts[:-1][self.ends_segment] + self.n_s + self.n_u

    @property
    def n_unknowns(self) -> int:
        """Length of the vector of unknowns."""
        return int(self._stage_starts[-1]) + self.n_s

    @cached_property
    def pins(self) -> IntArray:
        """Knot and state (n_pins, 2) of every value that a waypoint fixes."""
        knots = self.waypoint_knots
        pins = [(k, j) for k, names in zip(knots, self.pinned, strict=True) for j in names]
        return np.array(pins, np.int64).reshape(-1, 2)

    @cached_property
    def pinned_unknowns(self) -> IntArray:
        """Index of each pin among the unknowns."""
        knots, states = self.pins.T
        unknowns: IntArray = self.states[knots, states]
        return unknowns

    @cached_property
    def pin_rows(self) -> IntArray:
        """Index of each pin among the constraints: after the defects of its stage."""
        before = np.minimum(self.pins[:, 0] + 1, self.n_stages)
        return self.n_s * before + np.arange(len(self.pins))

    @cached_property
    def defects(self) -> IntArray:
        """Indices (N, n_s) of the defects of each stage among the constraints."""
        pins_before = np.searchsorted(self.pins[:, 0], np.arange(self.n_stages))
        starts = self.n_s * np.arange(self.n_stages) + pins_before
        return starts[:, None] + np.arange(self.n_s)

    @property
    def n_constraints(self) -> int:
        """Number of constraints, all of them equalities to zero."""
        return self.n_stages * self.n_s + len(self.pins)


@dataclass(frozen=True)
class Numbers:
    """Values of one problem among those of a layout.

    Parameters
    ----------
    parameters : (n_p,)   each parameter's unit
    steps : (N, M)   integration steps of each interval: s, or shares of its segment's duration where time is free
    pin_values : (n_pins,)   values that waypoints fix, in the order of `Layout.pins`
    costs : the objective
    lower, upper : (n_unknowns,)   limits of the unknowns
    """

    parameters: FloatArray
    steps: FloatArray
    pin_values: FloatArray
    costs: Costs
    lower: FloatArray
    upper: FloatArray


class Program:
    """Values and exact derivatives of one nonlinear program, as flat arrays in the order of its sparsity."""

    def __init__(self, stage: Stage, layout: Layout, numbers: Numbers) -> None:
        self.stage, self.layout, self.numbers = stage, layout, numbers
        self._at = np.zeros(0)
        self._interval: Interval | None = None

    # ------------------------------------------------------------------ values

    def split(self, unknowns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """States (N + 1, n_s) and inputs (N, n_u)."""
        return unknowns[self.layout.states], unknowns[self.layout.inputs]

    def advance(self, unknowns: FloatArray) -> FloatArray:
        """States (M + 1, N, n_s) before each integration step of every interval, and after the last."""
        states, inputs = self.split(unknowns)
        return self.stage.advance(states[:-1], inputs, self.numbers.parameters, self.numbers.steps)

    def objective(self, unknowns: FloatArray) -> float:
        """Cost of all knots and intervals."""
        return float(self._cost(unknowns)[0].sum())

    def gradient(self, unknowns: FloatArray) -> FloatArray:
        """Gradient (n_unknowns,) of the objective."""
        gradients, layout = self._cost(unknowns)[1], self.layout
        whole = np.zeros(layout.n_unknowns)
        whole[layout.states] = gradients[:, : layout.n_s]
        whole[layout.inputs] = gradients[:-1, layout.n_s :]
        return whole

    def constraints(self, unknowns: FloatArray) -> FloatArray:
        """Defects and distances from the waypoints (n_constraints,), all zero in a solution."""
        layout, known = self.layout, self._known(unknowns)
        after = (self.advance(unknowns) if known is None else known.states)[-1].copy()
        after[layout.ends_segment, layout.n_x :] = unknowns[layout.next_durations][:, None]
        values = np.empty(layout.n_constraints)
        values[layout.defects] = unknowns[layout.states[1:]] - after
        values[layout.pin_rows] = unknowns[layout.pinned_unknowns] - self.numbers.pin_values
        return values

    # ------------------------------------------------------------------ derivatives

    @cached_property
    def jacobian_entries(self) -> tuple[IntArray, IntArray]:
        """Row and column of every entry of the constraints' Jacobian, in the order of `jacobian`."""
        layout = self.layout
        shape = (layout.n_stages, self.stage.n_z, layout.n_s)
        rows = [np.broadcast_to(layout.defects[:, None, :], shape), layout.defects]
        columns = [np.broadcast_to(self._stage_unknowns[:, :, None], shape), layout.states[1:]]
        rows += [layout.pin_rows, layout.defects[layout.ends_segment, layout.n_x :]]
        columns += [layout.pinned_unknowns, layout.next_durations]
        return np.concatenate([a.ravel() for a in rows]), np.concatenate([a.ravel() for a in columns])

    def jacobian(self, unknowns: FloatArray) -> FloatArray:
        """Jacobian of the constraints."""
        layout = self.layout
        blocks = -self._linearized(unknowns).transitions[-1]
        blocks[layout.ends_segment, :, layout.n_x :] = 0.0
        others = np.ones(layout.defects.size + len(layout.pins) + len(layout.next_durations))
        others[len(others) - len(layout.next_durations) :] = -1.0
        return np.concatenate([blocks.ravel(), others])

    @cached_property
    def hessian_entries(self) -> tuple[IntArray, IntArray]:
        """Row and column of every entry of the Lagrangian's Hessian, both triangles, in the order of `hessian`."""
        layout, n_z = self.layout, self.stage.n_z
        rows = [np.repeat(self._stage_unknowns, n_z, axis=1), np.repeat(layout.states[-1], layout.n_s)]
        columns = [np.tile(self._stage_unknowns, (1, n_z)), np.tile(layout.states[-1], layout.n_s)]
        return np.concatenate([a.ravel() for a in rows]), np.concatenate([a.ravel() for a in columns])

    def hessian(self, unknowns: FloatArray, objective_factor: float, multipliers: FloatArray) -> FloatArray:
        """Hessian of ``objective_factor * objective + multipliers . constraints``."""
        layout, numbers = self.layout, self.numbers
        costs = objective_factor * self._cost(unknowns)[2]
        # The duration after a segment's end belongs to the next segment: it has no curvature here.
        weights = -multipliers[layout.defects]
        weights[layout.ends_segment, layout.n_x :] = 0.0
        _, inputs = self.split(unknowns)
        interval = self._linearized(unknowns)
        blocks = costs[:-1] + self.stage.curvature(interval, inputs, numbers.parameters, numbers.steps, weights)
        return np.concatenate([blocks.ravel(), costs[-1, : layout.n_s, : layout.n_s].ravel()])

    # ------------------------------------------------------------------ parts

    @cached_property
    def _stage_unknowns(self) -> IntArray:
        """Unknowns (N, n_z) of the state and input of each stage."""
        return np.hstack([self.layout.states[:-1], self.layout.inputs])

    def _cost(self, unknowns: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Cost of every knot and its derivatives; after the last there is no interval."""
        states, inputs = self.split(unknowns)
        lengths = np.append(self.numbers.steps.sum(axis=1), 0.0)
        last = self.numbers.costs.trim[None]
        return self.stage.cost(states, np.concatenate([inputs, last]), lengths, self.numbers.costs)

    def _linearized(self, unknowns: FloatArray) -> Interval:
        """Intervals with derivatives, cached: solvers evaluate Jacobian and Hessian at the same point."""
        interval = self._known(unknowns)
        if interval is None:
            (states, inputs), numbers = self.split(unknowns), self.numbers
            interval = self.stage.linearize(states[:-1], inputs, numbers.parameters, numbers.steps)
            self._at, self._interval = unknowns.copy(), interval
        return interval

    def _known(self, unknowns: FloatArray) -> Interval | None:
        """Cached intervals of these unknowns; None for others."""
        return self._interval if np.array_equal(self._at, unknowns) else None
