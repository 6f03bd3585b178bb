"""The time loop of a simulation, as machine code: eight rollouts to a vector.

A lane is one rollout: its parameters, its initial state, its rows of the log. Its arithmetic is the same in every
variant of the loop; variants differ in their output (`outputs.py`) and in the source of the inputs.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, TypeAlias, TypeVar

from diransac.simulation.compiler.lanes import ARGUMENTS
from diransac.simulation.compiler.machine_code import LANES
from diransac.simulation.compiler.operations import evaluate, numbers
from diransac.simulation.compiler.sensitivities import Columns
from diransac.simulation.compiler.stage_function import StageCalls
from diransac.simulation.compiler.vectors import (
    DOUBLE,
    INTEGERS,
    NUMBERS,
    Loop,
    Value,
    Variable,
    Vectors,
    integer,
    new_function,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from diransac.simulation.compiler.graph import Graph
    from diransac.simulation.compiler.outputs import Output
    from diransac.simulation.compiler.sensitivities import DerivativeSpecification
    from diransac.simulation.compiler.stage_function import StageFunction

T = TypeVar("T")

PARAMETER, STEP, RESULT = 2, 3, 4
"""Arguments of a step after the state and the inputs; those of a stage end with the parameters."""


@dataclass(frozen=True)
class LoopSpecification:
    """Expressions and sizes of a time loop.

    Attributes
    ----------
    step : graph of (x, u, p, h) -> (x after one sub-step, signals before it); where derivatives are simulated, or the
        dynamics are called, it also returns the states and inputs of each stage, and the components of the quaternions
        before they are scaled.  Where the dynamics are called, it has a further argument, their results in each stage
    divided : True if a row may take several sub-steps, whose number is an argument of the loop
    n_states, n_inputs, n_signals : sizes of x, u, and all signals
    n_changes : number of trailing elements of u that the leading ones change by with each sub-step: those are the
        differences of the inputs of one order after the other, as in Newton's interpolation
    scored : positions of the scored signals among all signals
    quaternions : positions of whole quaternions among the scored signals; their sign is arbitrary
    state_quaternions : positions of all quaternions in x
    derivatives : expressions of the derivatives of x, if they are simulated
    dynamics : function that the stages call for (dx/dt, accelerations), in a module of its own; None where the step
        holds their expressions
    """

    step: Graph
    divided: bool
    n_states: int
    n_inputs: int
    n_signals: int
    scored: tuple[int, ...]
    quaternions: tuple[tuple[int, ...], ...]
    state_quaternions: tuple[tuple[int, ...], ...]
    n_changes: int = 0
    derivatives: DerivativeSpecification | None = None
    dynamics: StageFunction | None = None


@dataclass(frozen=True)
class Block:
    """Values of the eight lanes of a block.

    Attributes
    ----------
    first : position of the first lane among the padded ones
    starts : per lane, row of the log at which it starts; empty if all start at the first
    step : invariant results of the graph
    """

    first: Value
    starts: list[Value]
    step: dict[int, Value]


@dataclass(frozen=True)
class LoopRow:
    """One row of a block's rollouts.

    Attributes
    ----------
    index : row of the rollout
    inputs : inputs from this row to the next
    signals : states and accelerations at this row
    alive : lanes in which every signal has been finite in all rows so far
    """

    index: Value
    inputs: list[Value]
    signals: list[Value]
    alive: Value


InputSource: TypeAlias = "Callable[[TimeLoop, Block, Value], list[Value]]"
"""Emits the inputs of a block's lanes at a row."""


def emit_time_loop(
    specification: LoopSpecification, output: type[Output], inputs: InputSource, *, windows: bool
) -> Value:
    """LLVM module with one function, `time_loop`, that takes `ARGUMENTS`."""
    function = new_function("time_loop", ARGUMENTS.values())
    TimeLoop(specification, windows, function).emit(output, inputs)
    return function.module


class TimeLoop:
    """Emitter of the function: blocks of lanes, and in them rows; gives outputs access to the log."""

    def __init__(self, specification: LoopSpecification, windows: bool, function: Value) -> None:
        self.specification, self.windows = specification, windows
        self.arguments = dict(zip(ARGUMENTS, function.args, strict=True))
        self.v = Vectors(function)
        self.builder = self.v.builder
        self.v.align_frame()
        self.state: list[Variable] = [self.v.variable(self.v.number(0.0)) for _ in range(specification.n_states)]
        self.guard = self.v.variable(self.v.number(0.0))
        """Zero as long as every signal has been finite."""
        self.columns: Columns | None = None
        """Derivatives of the state, if they are simulated."""
        if specification.derivatives is not None:
            sizes = specification.n_states, specification.n_inputs - specification.n_changes
            n_quaternions = 4 * len(specification.state_quaternions)
            self.columns = Columns(self.v, specification.derivatives, self.arguments["step"], sizes, n_quaternions)
        self._called: StageCalls | None = None
        """The dynamics, if stages call them."""
        if specification.dynamics is not None:
            n_stages = len(specification.step.outputs[2]) // specification.n_states
            function = specification.dynamics.declare(self.v.builder.module)
            self._called = StageCalls(self.v, specification.dynamics, function, n_stages)

    def emit(self, variant: type[Output], inputs: InputSource) -> None:
        """Emit the whole function."""
        output, v = variant(self), self.v
        with v.repeat(self.arguments["first_block"], self.arguments["end_block"]) as blocks:
            block = self._start(blocks.index)
            output.start(block)
            with v.repeat(integer(0), self.arguments["n_rows"]) as rows:
                u = inputs(self, block, rows.index)
                self._row(output, block, rows, u)
            output.end(block)
        self.builder.ret_void()

    def _start(self, index: Value) -> Block:
        """Load the initial values of a block of lanes, and compute the invariants of its rows."""
        v, specification = self.v, self.specification
        first = self.builder.mul(index, integer(LANES))
        for k, variable in enumerate(self.state):
            v.set(variable, self._lane_vector("initial_states", k, first))
        v.set(self.guard, v.number(0.0))

        def load(argument: int, element: int) -> Value:
            if argument == PARAMETER:
                return self._lane_vector("parameters", element, first)
            return v.splat(self.arguments["step"])

        if self.columns is not None:
            self.columns.start(load)
        if self._called is not None:
            self._called.start(load)
        graph = specification.step
        constant = [k for k in graph.needed(chain(*graph.outputs)) if graph.invariant[k]]
        starts = self.whole_numbers("start_rows", first) if self.windows else []
        return Block(first, starts, evaluate(v, graph, constant, load))

    def whole_numbers(self, name: str, first: Value) -> list[Value]:
        """Return the eight integers of a block's lanes in an array that holds one for every lane."""
        vector = self.v.load(self.arguments[name], first, INTEGERS)
        return [self.v.lane(vector, lane) for lane in range(LANES)]

    def _row(self, output: Output, block: Block, rows: Loop, u: list[Value]) -> None:
        """Emit one row: its sub-steps share their code, and the first one has the output."""
        if not self.specification.divided:
            signals, after = self._substep(block, u)
            self._output(output, block, rows, u, signals)
            self._set_state(after)
            return
        with self.v.repeat(integer(0), self.arguments["substeps"]) as steps:
            signals, after = self._substep(block, self._changed(u, steps.index))
            with self.builder.if_then(self.builder.icmp_signed("==", steps.index, integer(0))):
                self._output(output, block, rows, u, signals)
            self._set_state(after)

    def _substep(self, block: Block, u: list[Value]) -> tuple[list[Value], list[Value]]:
        """Signals before a sub-step, and the state after it; derivatives are advanced in their arrays."""
        specification, graph = self.specification, self.specification.step
        known = block.step if self._called is None else self._call(self._called, u, block.step)
        results = self._evaluate(graph, chain(*graph.outputs), u, known)
        after, signals, *points = (numbers(self.v, results, positions) for positions in graph.outputs)
        if self.columns is not None:
            states, inputs, quaternions = points
            n_stages = len(states) // specification.n_states
            at_stages = zip(_split(states, n_stages), _split(inputs, n_stages), strict=True)
            self.columns.advance([x + u for x, u in at_stages], quaternions)
        return signals, after

    def _call(self, called: StageCalls, u: list[Value], known: dict[int, Value]) -> dict[int, Value]:
        """Emit the calls of the dynamics, each at a point that depends on the results before; what is known then."""
        graph, n_stages = self.specification.step, len(called.results)
        states, inputs = (_split(graph.outputs[k], n_stages) for k in (2, 3))
        for stage, point in enumerate(zip(states, inputs, strict=True)):
            wanted = list(chain(*point))
            known = self._evaluate(graph, wanted, u, known)
            called.at(stage, numbers(self.v, known, wanted))
        return known

    def _output(self, output: Output, block: Block, rows: Loop, u: list[Value], signals: list[Value]) -> None:
        """Emit the output of one row."""
        alive = self._still_finite(signals)
        output.row(block, LoopRow(rows.index, u, signals, alive))
        if output.ends_early:
            with self.builder.if_then(self.builder.not_(self.v.any_lane(alive))):
                self.builder.branch(rows.leave)

    def _changed(self, u: list[Value], steps: Value) -> list[Value]:
        """Inputs a number of sub-steps after their row."""
        v, n_changes = self.v, self.specification.n_changes
        if not n_changes:
            return u
        n_u = len(u) - n_changes
        elapsed = v.splat(self.builder.sitofp(steps, DOUBLE))
        orders = [u[k : k + n_u] for k in range(0, len(u), n_u)]
        return [x for k in range(len(orders)) for x in self._interpolated(orders[k:], elapsed)]

    def _interpolated(self, orders: list[list[Value]], elapsed: Value) -> list[Value]:
        """Newton's interpolation from differences of every order."""
        v, found = self.v, orders[-1]
        for order, lower in reversed(list(enumerate(orders[:-1]))):
            if order:
                later = v.sub(elapsed, v.splat(DOUBLE(order)))
                factor = v.mul(later, v.splat(DOUBLE(1.0 / (order + 1))))
            else:
                factor = elapsed
            found = [v.fma(factor, x, y) for x, y in zip(found, lower, strict=True)]
        return found

    def _set_state(self, after: list[Value]) -> None:
        """Set the state."""
        for variable, value in zip(self.state, after, strict=True):
            self.v.set(variable, value)

    def _evaluate(
        self, graph: Graph, wanted: Iterable[int], u: list[Value], known: dict[int, Value]
    ) -> dict[int, Value]:
        """Evaluate a graph at the current state, where its stages have been called as far as it needs them."""
        x = [self.v.get(variable) for variable in self.state]

        def load(argument: int, element: int) -> Value:
            if argument == RESULT and self._called is not None:
                return self._called.result(element)
            return (x, u)[argument][element]

        return evaluate(self.v, graph, list(wanted), load, known)

    def _still_finite(self, signals: list[Value]) -> Value:
        """Lanes in which every signal has been finite in all rows so far: zero times it stays zero."""
        v = self.v
        guard = v.get(self.guard)
        for signal in signals:
            guard = v.fma(signal, v.number(0.0), guard)
        v.set(self.guard, guard)
        return v.compare("==", guard, v.number(0.0))

    def logged(self, name: str, width: int, block: Block, row: Value, kind: Value = DOUBLE) -> list[Value]:
        """Return the columns of a logged array at a row."""
        return self.columns_at(name, width, self.rows_at(block, row), kind)

    def rows_at(self, block: Block, row: Value) -> list[Value]:
        """Rows of the log of all lanes; one if they share it."""
        return [self.builder.add(start, row) for start in block.starts] or [row]

    def columns_at(self, name: str, width: int, at: list[Value], kind: Value = DOUBLE) -> list[Value]:
        """Return the columns of an array at a row of each lane; one load for all lanes if they share it."""
        v = self.v
        rows = [v.row(self.arguments[name], place, width, kind) for place in at]
        columns = [[v.load(place, integer(k), kind) for place in rows] for k in range(width)]
        return [v.join(column) if self.windows else v.splat(*column) for column in columns]

    def _lane_vector(self, name: str, element: int, first: Value) -> Value:
        """One element of an array that holds a value for every lane."""
        index = self.builder.add(self.builder.mul(self.arguments["n_padded"], integer(element)), first)
        return self.v.load(self.arguments[name], index, NUMBERS)


def _split(values: Sequence[T], n: int) -> list[list[T]]:
    """Consecutive parts of equal size."""
    size = len(values) // n
    return [list(values[k * size : (k + 1) * size]) for k in range(n)]


# Sources of the inputs ------------------------------------------------------------------------------------------------
def inputs_from_log(loop: TimeLoop, block: Block, row: Value) -> list[Value]:
    """Emit the log's inputs at a row."""
    return loop.logged("inputs", loop.specification.n_inputs, block, row)


def inputs_by_feedback(loop: TimeLoop, block: Block, row: Value) -> list[Value]:
    """Emit the inputs by each lane's own feedback law."""
    rows = [loop.builder.add(start, row) for start in loop.whole_numbers("feedback_starts", block.first)]
    return _feedback_inputs(loop, [loop.v.join(column) for column in _columns(loop, rows)])


def inputs_by_shared_feedback(loop: TimeLoop, _block: Block, row: Value) -> list[Value]:
    """Emit the inputs by one feedback law, at the same row for all lanes."""
    return _feedback_inputs(loop, [loop.v.splat(*column) for column in _columns(loop, [row])])


def _columns(loop: TimeLoop, rows: list[Value]) -> list[list[Value]]:
    """Numbers of the feedback's rows, column by column: u_ref, x_ref, and the gains row by row."""
    n_u, n_x = loop.specification.n_inputs, loop.specification.n_states
    width = n_u + n_x + n_u * n_x
    laws = [loop.v.row(loop.arguments["feedback"], at, width, DOUBLE) for at in rows]
    return [[loop.v.load(law, integer(k), DOUBLE) for law in laws] for k in range(width)]


def _feedback_inputs(loop: TimeLoop, law: list[Value]) -> list[Value]:
    """clip(u_ref - K (x - x_ref)); the state's quaternions first take the sign nearer to the reference's."""
    v, n_u, n_x = loop.v, loop.specification.n_inputs, loop.specification.n_states
    u_ref, x_ref, gains = law[:n_u], law[n_u : n_u + n_x], law[n_u + n_x :]
    x = [v.get(variable) for variable in loop.state]
    for four in loop.specification.state_quaternions:
        x, _ = v.turned_towards(x, x_ref, four)
    errors = [v.sub(a, b) for a, b in zip(x, x_ref, strict=True)]
    inputs = []
    for k, u in enumerate(u_ref):
        for gain, error in zip(gains[k * n_x : (k + 1) * n_x], errors, strict=True):
            u = v.fma(v.neg(gain), error, u)
        lowest, highest = (v.splat(v.load(loop.arguments["limits"], integer(k + at), DOUBLE)) for at in (0, n_u))
        inputs.append(v.smaller(v.larger(u, lowest), highest))
    return inputs
