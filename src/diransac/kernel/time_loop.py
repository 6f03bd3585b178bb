"""The time loop of a simulation, as machine code: eight rollouts to a vector, scored on the way.

A lane is one rollout: its parameters, its initial state, its window of rows. States, sums and counts stay in registers
for the whole loop. What a lane computes is the same in every variant of the loop; variants differ in what they keep.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from itertools import chain
from typing import TYPE_CHECKING

from llvmlite import ir

from diransac.kernel.machine_code import LANES
from diransac.kernel.operations import evaluate, numbers
from diransac.kernel.vectors import BYTE, DOUBLE, INTEGER, INTEGERS, NUMBERS, POINTER, Cell, Loop, Value, Vectors

if TYPE_CHECKING:
    from collections.abc import Iterable

    from diransac.kernel.graph import Graph

__all__ = ["ARGUMENTS", "Keep", "Plan", "emit_time_loop"]

ARGUMENTS = {
    "parameters": "pointer",  # (n_p, n_padded) float64
    "initial_states": "pointer",  # (n_x, n_padded) float64
    "inputs": "pointer",  # (n_log, n_u) float64
    "measured": "pointer",  # (n_log, n_s) float64
    "valid": "pointer",  # (n_log,) bytes, 0 or 1
    "squared_thresholds": "pointer",  # (n_s,) float64
    "start_rows": "pointer",  # (n_padded,) int64, read where lanes have windows of their own
    "sums": "pointer",  # (n_s, n_padded) float64, written by Keep.SCORES
    "counts": "pointer",  # (2, n_padded) int64, written by Keep.SCORES: inliers, and 1 where the lane diverged
    "series": "pointer",  # (n_lanes, n_rows, n_s or n_signals) float64, written by the others
    "step": "number",  # seconds, of one sub-step
    "min_inlier_signals": "integer",
    "n_lanes": "integer",
    "n_padded": "integer",  # n_lanes rounded up to whole vectors; the last lane is repeated
    "n_rows": "integer",
    "first_block": "integer",  # vectors of lanes to run: first_block .. end_block - 1
    "end_block": "integer",
}
"""Arguments of the compiled time loop, in order, and their kinds."""

STATE, INPUT, PARAMETER, STEP = range(4)


class Keep(Enum):
    """What a time loop keeps."""

    SCORES = "sums of squared errors and inlier counts"
    ERRORS = "errors of the scored signals, row by row"
    SIGNALS = "all signals, row by row"


@dataclass(frozen=True)
class Plan:
    """What a time loop computes.

    Attributes
    ----------
    step : graph of (x, u, p, h) -> (x after one sub-step, signals before it)
    further_step : graph of (x, u, p, h) -> (x after one sub-step,), for the sub-steps after the first
    substeps : sub-steps a row
    n_states, n_inputs, n_signals : sizes of x, u and all signals
    scored : positions among all signals of those that are compared with measurements
    quaternions : positions among the scored ones; four that have an arbitrary common sign
    """

    step: Graph
    further_step: Graph
    substeps: int
    n_states: int
    n_inputs: int
    n_signals: int
    scored: tuple[int, ...]
    quaternions: tuple[tuple[int, ...], ...]


def emit_time_loop(plan: Plan, keep: Keep, *, windows: bool) -> Value:
    """LLVM module with one function, `time_loop`, that takes `ARGUMENTS`.

    Parameters
    ----------
    plan : what to compute
    keep : what to keep of it
    windows : every lane starts at its own row of the log, not all at its first
    """
    module = ir.Module("diransac")
    kinds = {"pointer": POINTER, "integer": INTEGER, "number": DOUBLE}
    signature = ir.FunctionType(ir.VoidType(), [kinds[kind] for kind in ARGUMENTS.values()])
    function = ir.Function(module, signature, "time_loop")
    for argument, (name, kind) in zip(function.args, ARGUMENTS.items(), strict=True):
        argument.name = name
        if kind == "pointer":
            argument.add_attribute("noalias")
    _TimeLoop(plan, keep, windows, function).emit()
    return module


@dataclass
class _Lanes:
    """What belongs to the eight lanes of a block.

    Attributes
    ----------
    first : position of the first lane among the padded ones
    rows : per lane, row of the log at which it starts; empty if all start at the first
    places : per lane, position of its first value in the series; empty if none is kept
    step, further_step : results of the graphs that hold for the whole rollout
    """

    first: Value
    rows: list[Value]
    places: list[Value]
    step: dict[int, Value]
    further_step: dict[int, Value]


class _TimeLoop:
    """Emits the function: blocks of lanes, and in them rows."""

    def __init__(self, plan: Plan, keep: Keep, windows: bool, function: Value) -> None:
        self.plan, self.keep, self.windows = plan, keep, windows
        self.arguments = {argument.name: argument for argument in function.args}
        self.v = Vectors(ir.IRBuilder(function.append_basic_block("entry")))
        self.builder = self.v.builder
        self.state: list[Cell] = []
        self.sums: list[Cell] = []

    def emit(self) -> None:
        """Emit the whole function."""
        v, arguments = self.v, self.arguments
        zero = v.number(0.0)
        self.state = [v.cell(zero) for _ in range(self.plan.n_states)]
        self.sums = [v.cell(zero) for _ in self.plan.scored]
        self.inliers = v.cell(v.integer(0))
        self.guard = v.cell(zero)
        with v.repeat(arguments["first_block"], arguments["end_block"]) as blocks:
            lanes = self._start(blocks.index)
            with v.repeat(_integer(0), arguments["n_rows"]) as rows:
                self._row(lanes, rows)
            if self.keep is Keep.SCORES:
                self._store_scores(lanes)
        self.builder.ret_void()

    def _start(self, block: Value) -> _Lanes:
        """Load what a block of lanes starts from, and compute what holds for all its rows."""
        v, plan = self.v, self.plan
        first = self.builder.mul(block, _integer(LANES))
        for k, cell in enumerate(self.state):
            v.set(cell, self._lane_vector("initial_states", k, first))
        for cell in (*self.sums, self.guard):
            v.set(cell, v.number(0.0))
        v.set(self.inliers, v.integer(0))

        def load(argument: int, element: int) -> Value:
            if argument == PARAMETER:
                return self._lane_vector("parameters", element, first)
            return v.splat(self.arguments["step"])

        constant = [
            evaluate(v, graph, [k for k in graph.needed(chain(*graph.outputs)) if graph.invariant[k]], load)
            for graph in (plan.step, plan.further_step)
        ]
        return _Lanes(first, self._start_rows(first), self._places(first), *constant)

    def _start_rows(self, first: Value) -> list[Value]:
        """Row at which each lane starts."""
        if not self.windows:
            return []
        rows = self.v.load(self.arguments["start_rows"], first, INTEGERS)
        return [self.v.lane(rows, lane) for lane in range(LANES)]

    def _places(self, first: Value) -> list[Value]:
        """Position of each lane's first value in the series; lanes past the last repeat it, in its place."""
        if self.keep is Keep.SCORES:
            return []
        builder, arguments = self.builder, self.arguments
        width = len(self.plan.scored) if self.keep is Keep.ERRORS else self.plan.n_signals
        size = builder.mul(arguments["n_rows"], _integer(width))
        last = builder.sub(arguments["n_lanes"], _integer(1))
        lanes = [builder.add(first, _integer(lane)) for lane in range(LANES)]
        clamped = [builder.select(builder.icmp_signed("<", lane, last), lane, last) for lane in lanes]
        return [builder.mul(lane, size) for lane in clamped]

    def _row(self, lanes: _Lanes, rows: Loop) -> None:
        """Compare the signals of one row with what was measured, then step to the next."""
        v, plan = self.v, self.plan
        u = [self._logged("inputs", plan.n_inputs, k, lanes, rows.index) for k in range(plan.n_inputs)]
        after, signals = plan.step.outputs
        results = self._evaluate(plan.step, (*after, *signals), u, lanes.step)
        simulated = numbers(v, results, signals)
        alive = self._still_finite(simulated)
        if self.keep is Keep.SCORES:
            self._score(simulated, alive, lanes, rows.index)
            with self.builder.if_then(self.builder.not_(v.any_lane(alive))):
                self.builder.branch(rows.leave)
        else:
            kept = simulated if self.keep is Keep.SIGNALS else self._errors(simulated, lanes, rows.index)
            self._store_row(kept, alive, lanes, rows.index)
        for cell, value in zip(self.state, numbers(v, results, after), strict=True):
            v.set(cell, value)
        if plan.substeps > 1:
            self._further_steps(u, lanes)

    def _further_steps(self, u: list[Value], lanes: _Lanes) -> None:
        """Take the sub-steps after the first."""
        plan = self.plan
        (after,) = plan.further_step.outputs
        with self.v.repeat(_integer(1), _integer(plan.substeps)):
            results = self._evaluate(plan.further_step, after, u, lanes.further_step)
            for cell, value in zip(self.state, numbers(self.v, results, after), strict=True):
                self.v.set(cell, value)

    def _evaluate(
        self, graph: Graph, wanted: Iterable[int], u: list[Value], known: dict[int, Value]
    ) -> dict[int, Value]:
        """Evaluate a graph at the current state."""
        x = [self.v.get(cell) for cell in self.state]
        return evaluate(self.v, graph, list(wanted), lambda argument, k: (x if argument == STATE else u)[k], known)

    def _still_finite(self, signals: list[Value]) -> Value:
        """Whether every signal has been finite in all rows so far: zero times it stays zero."""
        v = self.v
        guard = v.get(self.guard)
        for signal in signals:
            guard = v.fma(signal, v.number(0.0), guard)
        v.set(self.guard, guard)
        return v.compare("==", guard, v.number(0.0))

    def _errors(self, simulated: list[Value], lanes: _Lanes, row: Value) -> list[Value]:
        """Simulated less measured; a quaternion first takes the sign that is nearer to the measured one."""
        v, plan = self.v, self.plan
        predicted = [simulated[k] for k in plan.scored]
        n_scored = len(plan.scored)
        measured = [self._logged("measured", n_scored, k, lanes, row) for k in range(n_scored)]
        for quaternion in plan.quaternions:
            dot = v.number(0.0)
            for k in quaternion:
                dot = v.fma(predicted[k], measured[k], dot)
            opposite = v.compare("<", dot, v.number(0.0))
            for k in quaternion:
                predicted[k] = v.select(opposite, v.neg(predicted[k]), predicted[k])
        return [v.sub(x, y) for x, y in zip(predicted, measured, strict=True)]

    def _score(self, simulated: list[Value], alive: Value, lanes: _Lanes, row: Value) -> None:
        """Add a row's squared errors to the sums, and the row to the inliers if it is one."""
        v = self.v
        valid = self._valid(lanes, row)
        n_inside = v.integer(0)
        for k, (error, total) in enumerate(zip(self._errors(simulated, lanes, row), self.sums, strict=True)):
            counted = v.select(valid, error, v.number(0.0))
            square = v.mul(counted, counted)
            v.set(total, v.add(v.get(total), square))
            bound = v.splat(v.load(self.arguments["squared_thresholds"], _integer(k), DOUBLE))
            n_inside = v.count(n_inside, v.compare("<", square, bound))
        enough = self.builder.icmp_signed(">=", n_inside, v.splat(self.arguments["min_inlier_signals"]))
        inlier = v.both(v.both(enough, valid), alive)
        v.set(self.inliers, v.count(v.get(self.inliers), inlier))

    def _valid(self, lanes: _Lanes, row: Value) -> Value:
        """Whether the row counts, in each lane."""
        flags = self._logged("valid", 1, 0, lanes, row, BYTE)
        return self.builder.icmp_unsigned("!=", flags, ir.Constant(flags.type, [ir.Constant(BYTE, 0)] * LANES))

    def _logged(self, name: str, width: int, column: int, lanes: _Lanes, row: Value, kind: Value = DOUBLE) -> Value:
        """One column of a logged array at the current row; one load for all lanes if they share their row."""
        builder = self.builder

        def element(at: Value) -> Value:
            index = builder.add(builder.mul(at, _integer(width)), _integer(column))
            return self.v.load(self.arguments[name], index, kind)

        if not self.windows:
            return self.v.splat(element(row))
        return self.v.join([element(builder.add(start, row)) for start in lanes.rows])

    def _lane_vector(self, name: str, element: int, first: Value) -> Value:
        """One element of an array that holds a value for every lane."""
        index = self.builder.add(self.builder.mul(self.arguments["n_padded"], _integer(element)), first)
        return self.v.load(self.arguments[name], index, NUMBERS)

    def _store_scores(self, lanes: _Lanes) -> None:
        """Write a block's sums and counts; where a lane diverged, its sums are infinite."""
        v, builder, n_padded = self.v, self.builder, self.arguments["n_padded"]
        diverged = v.is_nan(v.get(self.guard))
        for k, total in enumerate(self.sums):
            index = builder.add(builder.mul(n_padded, _integer(k)), lanes.first)
            v.store(v.select(diverged, v.number(float("inf")), v.get(total)), self.arguments["sums"], index)
        v.store(v.get(self.inliers), self.arguments["counts"], lanes.first)
        flag = v.count(v.integer(0), diverged)
        v.store(flag, self.arguments["counts"], builder.add(n_padded, lanes.first))

    def _store_row(self, values: list[Value], alive: Value, lanes: _Lanes, row: Value) -> None:
        """Write a row of every lane's series, NaN from its divergence on."""
        v, builder = self.v, self.builder
        offset = builder.mul(row, _integer(len(values)))
        for k, value in enumerate(values):
            shown = v.select(alive, value, v.number(float("nan")))
            for lane, place in enumerate(lanes.places):
                index = builder.add(builder.add(place, offset), _integer(k))
                v.store(v.lane(shown, lane), self.arguments["series"], index)


def _integer(value: int) -> Value:
    """64-bit integer constant."""
    return ir.Constant(INTEGER, value)
