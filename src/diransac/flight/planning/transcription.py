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
from diransac.flight.planning.stage import Costs, Stage, Stages

__all__ = ["Layout", "Numbers", "Program"]


@dataclass(frozen=True)
class Layout:
    """Index of each unknown and each constraint of a plan."""

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
    """Values and exact derivatives of one nonlinear program, as flat arrays in the order of its sparsity.

    Solvers evaluate every function at the same point: costs and intervals are computed once per point.
    """

    def __init__(self, stage: Stage, layout: Layout, numbers: Numbers) -> None:
        self.stage, self.layout, self.numbers = stage, layout, numbers
        self._stages = Stages(stage, numbers.parameters, numbers.steps, numbers.costs)
        self._at = np.zeros(0)
        self._costs: tuple[FloatArray, FloatArray, FloatArray] | None = None
        self._intervals: tuple[FloatArray, FloatArray, FloatArray] | None = None

    # ------------------------------------------------------------------ values

    def split(self, unknowns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """States (N + 1, n_s) and inputs (N, n_u)."""
        return unknowns[self.layout.states], unknowns[self.layout.inputs]

    def steps(self, unknowns: FloatArray) -> FloatArray:
        """States (N, M, n_s) before each integration step of every interval."""
        return self._integrated(unknowns)[0]

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
        layout, after = self.layout, self._integrated(unknowns)[1].copy()
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
        blocks = -self._integrated(unknowns)[2]
        blocks[layout.ends_segment, :, layout.n_x :] = 0.0
        return np.concatenate([blocks.ravel(), self._constant_entries])

    @cached_property
    def hessian_entries(self) -> tuple[IntArray, IntArray]:
        """Row and column of every entry of the Lagrangian's Hessian, its upper triangle, in the order of `hessian`."""
        layout, (rows, columns) = self.layout, self.stage.triangle
        stages, last = self._stage_unknowns, layout.states[-1]
        n = layout.n_s * (layout.n_s + 1) // 2
        return (
            np.concatenate([stages[:, rows].ravel(), last[rows[:n]]]),
            np.concatenate([stages[:, columns].ravel(), last[columns[:n]]]),
        )

    def hessian(self, unknowns: FloatArray, objective_factor: float, multipliers: FloatArray) -> FloatArray:
        """Upper triangle of the Hessian of ``objective_factor * objective + multipliers . constraints``."""
        layout = self.layout
        # The duration after a segment's end belongs to the next segment: it has no curvature here.
        weights = -multipliers[layout.defects]
        weights[layout.ends_segment, layout.n_x :] = 0.0
        entries = (objective_factor * self._cost(unknowns)[2]).ravel()
        self._integrated(unknowns)
        curved = self._stages.curvature(weights)
        entries[: curved.size] += curved.ravel()
        return entries[: curved.size + layout.n_s * (layout.n_s + 1) // 2]

    # ------------------------------------------------------------------ parts

    @cached_property
    def _stage_unknowns(self) -> IntArray:
        """Unknowns (N, n_z) of the state and input of each stage."""
        return np.hstack([self.layout.states[:-1], self.layout.inputs])

    @cached_property
    def _constant_entries(self) -> FloatArray:
        """Entries of the Jacobian after those of the transitions."""
        layout = self.layout
        return np.repeat([1.0, -1.0], [layout.defects.size + len(layout.pins), len(layout.next_durations)])

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
        if not np.array_equal(self._at, unknowns):
            self._costs = self._intervals = None
            self._stages.move(*self.split(unknowns))
            self._at = unknowns.copy()
