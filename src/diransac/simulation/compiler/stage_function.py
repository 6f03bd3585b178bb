"""A graph of the state, inputs and parameters of a stage as one function, emitted once and called in every stage.

All its arguments are arrays of vectors of eight lanes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING

from diransac.simulation.compiler.machine_code import signature
from diransac.simulation.compiler.operations import evaluate_into
from diransac.simulation.compiler.vectors import Value, Vectors, new_function

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from diransac.simulation.compiler.graph import Graph


@dataclass(frozen=True)
class StageFunction:
    """Function of (state and inputs, constants) that writes results; constants are what parameters alone determine.

    Attributes
    ----------
    name : of the function in its module
    graph : of (x, u, p), with the parameters as invariants
    results : instructions whose results are written, in this order
    n_states, n_inputs : sizes of x and u
    """

    name: str
    graph: Graph
    results: tuple[int, ...]
    n_states: int
    n_inputs: int

    @cached_property
    def constants(self) -> list[int]:
        """Instructions that depend on the parameters alone and whose results the function takes."""
        graph = self.graph
        needed = graph.needed(self.results)
        operands = set(chain(*(graph.instructions[k].operands for k in needed if not graph.invariant[k])))
        return sorted(
            k for k in operands | set(self.results) if graph.invariant[k] and graph.instructions[k].operation != "CONST"
        )

    def declare(self, module: Value = None) -> Value:
        """Function of a module, a new one by default, without its body."""
        return new_function(self.name, signature(3, 0), module)

    def emit(self, function: Value) -> None:
        """Emit the body of a declared function."""
        point, constants, results = function.args
        v = Vectors(function)
        v.align_frame()
        values = [v.pick(point, k) for k in range(self.n_states + self.n_inputs)]
        sources = values[: self.n_states], values[self.n_states :]
        known = {k: v.pick(constants, i) for i, k in enumerate(self.constants)}
        evaluate_into(v, results, self.graph, self.results, lambda argument, k: sources[argument][k], known)
        v.builder.ret_void()


class StageCalls:
    """Emitter of the calls of a function by the stages of a sub-step.

    Attributes
    ----------
    results : array of the results in each stage
    """

    def __init__(self, v: Vectors, stage: StageFunction, function: Value, n_stages: int) -> None:
        """`function` is the stage's own in the module, declared."""
        self._v, self._stage, self._function = v, stage, function
        self._constants = v.array(len(stage.constants))
        self.results = [v.array(len(stage.results)) for _ in range(n_stages)]

    def start(self, load: Callable[[int, int], Value]) -> None:
        """Emit what the parameters of a block's lanes determine."""
        evaluate_into(self._v, self._constants, self._stage.graph, self._stage.constants, load)

    def at(self, stage: int, point: Sequence[Value]) -> None:
        """Emit the call of a stage, at a state and inputs."""
        array = self._v.array(len(point))
        for k, value in enumerate(point):
            self._v.put(value, array, k)
        self._v.builder.call(self._function, [array, self._constants, self.results[stage]])

    def result(self, element: int) -> Value:
        """Emit the load of an element of all stages' results."""
        stage, place = divmod(element, len(self._stage.results))
        return self._v.pick(self.results[stage], place)


def stage_module(stage: StageFunction) -> Value:
    """LLVM module with a stage's function alone."""
    function = stage.declare()
    stage.emit(function)
    return function.module
