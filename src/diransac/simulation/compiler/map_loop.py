"""One function over many rows, as machine code: eight rows to a vector."""

from __future__ import annotations

from typing import TYPE_CHECKING

from llvmlite import ir

from diransac.simulation.compiler.machine_code import LANES
from diransac.simulation.compiler.operations import evaluate, numbers
from diransac.simulation.compiler.vectors import DOUBLE, INTEGER, POINTER, Value, Vectors

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from diransac.simulation.compiler.graph import Graph

__all__ = ["emit_map_loop", "map_signature"]


def map_signature(n_arrays: int) -> list[str]:
    """Kinds of the compiled function's arguments: inputs and outputs, n_rows, first_block, end_block."""
    return ["pointer"] * n_arrays + ["integer"] * 3


def emit_map_loop(graph: Graph, widths_in: Sequence[int]) -> Value:
    """LLVM module with one function, `map_loop`, that takes `map_signature`.

    Parameters
    ----------
    graph : of the function; its invariant inputs are those that all rows share
    widths_in : elements of each input, whose array is (n_rows, width) or, shared, (width,)

    The outputs' arrays are (n_rows, width).
    """
    module = ir.Module("diransac")
    kinds = {"pointer": POINTER, "integer": INTEGER}
    signature = map_signature(len(widths_in) + len(graph.outputs))
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [kinds[k] for k in signature]), "map_loop")
    arrays, (n_rows, first_block, end_block) = function.args[:-3], function.args[-3:]
    for array in arrays:
        array.add_attribute("noalias")
    v = Vectors(ir.IRBuilder(function.append_basic_block("entry")))
    load_shared = _shared_loader(v, arrays)
    wanted = [k for row in graph.outputs for k in row]
    known = evaluate(v, graph, [k for k in graph.needed(wanted) if graph.invariant[k]], load_shared)
    with v.repeat(first_block, end_block) as blocks:
        rows = _rows(v, blocks.index, n_rows)
        values = evaluate(v, graph, wanted, _row_loader(v, arrays, widths_in, rows), known)
        for array, positions in zip(arrays[len(widths_in) :], graph.outputs, strict=True):
            _store(v, array, rows, numbers(v, values, positions))
    v.builder.ret_void()
    return module


def _shared_loader(v: Vectors, arrays: Sequence[Value]) -> Callable[[int, int], Value]:
    """How to load an element that all rows share."""
    return lambda argument, element: v.splat(v.load(arrays[argument], ir.Constant(INTEGER, element), DOUBLE))


def _row_loader(
    v: Vectors, arrays: Sequence[Value], widths: Sequence[int], rows: Sequence[Value]
) -> Callable[[int, int], Value]:
    """How to load an element of the rows at hand."""

    def load(argument: int, element: int) -> Value:
        return v.join([v.load(arrays[argument], _place(v, row, widths[argument], element), DOUBLE) for row in rows])

    return load


def _rows(v: Vectors, block: Value, n_rows: Value) -> list[Value]:
    """Rows of a block; those past the end are the last one."""
    builder = v.builder
    last = builder.sub(n_rows, ir.Constant(INTEGER, 1))
    first = builder.mul(block, ir.Constant(INTEGER, LANES))
    rows = [builder.add(first, ir.Constant(INTEGER, lane)) for lane in range(LANES)]
    return [builder.select(builder.icmp_signed("<", row, last), row, last) for row in rows]


def _place(v: Vectors, row: Value, width: int, element: int) -> Value:
    """Position of an element of a row."""
    return v.builder.add(v.builder.mul(row, ir.Constant(INTEGER, width)), ir.Constant(INTEGER, element))


def _store(v: Vectors, array: Value, rows: Sequence[Value], values: Sequence[Value]) -> None:
    """Write one output's elements of the rows at hand."""
    for lane, row in enumerate(rows):
        for element, value in enumerate(values):
            v.store(v.lane(value, lane), array, _place(v, row, len(values), element))
