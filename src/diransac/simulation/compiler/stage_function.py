"""A graph of the state, inputs and parameters of a stage as one function, emitted once and called in every stage.

All its arguments are arrays of vectors of eight lanes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING

from llvmlite import ir

from diransac.simulation.compiler.operations import evaluate, numbers
from diransac.simulation.compiler.vectors import POINTER, Value, Vectors

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from diransac.simulation.compiler.graph import Graph

__all__ = ["StageFunction", "stage_module"]

_POINT, _INPUT, _PARAMETER = range(3)


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

    def declare(self, module: Value) -> Value:
        """Function of a module, without its body."""
        function = ir.Function(module, ir.FunctionType(ir.VoidType(), [POINTER] * 3), self.name)
        for argument in function.args:
            argument.add_attribute("noalias")
        return function

    def emit(self, function: Value) -> None:
        """Emit the body of a declared function."""
        point, constants, results = function.args
        v = Vectors(ir.IRBuilder(function.append_basic_block("entry")))
        v.align_frame()
        values = [v.pick(point, k) for k in range(self.n_states + self.n_inputs)]
        sources = {_POINT: values[: self.n_states], _INPUT: values[self.n_states :]}
        known = {k: v.pick(constants, i) for i, k in enumerate(self.constants)}
        found = evaluate(v, self.graph, self.results, lambda argument, k: sources[argument][k], known)
        for k, value in enumerate(numbers(v, found, self.results)):
            v.put(value, results, k)
        v.builder.ret_void()

    def put_constants(self, v: Vectors, parameter: Callable[[int], Value], array: Value) -> None:
        """Emit the computation of the constants into an array, from the elements of the parameters."""
        found = evaluate(v, self.graph, self.constants, lambda _argument, element: parameter(element))
        for k, value in enumerate(numbers(v, found, self.constants)):
            v.put(value, array, k)

    def call(self, v: Vectors, function: Value, point: Sequence[Value], constants: Value, results: Value) -> None:
        """Emit a call at a state and inputs."""
        array = v.array(len(point))
        for k, value in enumerate(point):
            v.put(value, array, k)
        v.builder.call(function, [array, constants, results])


def stage_module(stage: StageFunction) -> Value:
    """LLVM module with a stage's function alone."""
    module = ir.Module("diransac")
    stage.emit(stage.declare(module))
    return module
