"""Vector form of every operation of CasADi's SX, and the emission of graphs: once, or as a loop over rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from diransac.errors import ModelError
from diransac.limits import MOST_COMPILED, beyond
from diransac.simulation.compiler import elementary
from diransac.simulation.compiler.machine_code import LANES, signature
from diransac.simulation.compiler.vectors import DOUBLE, Value, Vectors, integer, new_function

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

    from diransac.simulation.compiler.graph import Graph


@dataclass(frozen=True)
class Operation:
    """Vector form of an operation.

    Attributes
    ----------
    emit : called with the vectors and one value for each operand; returns the result
    takes : kind of each operand, `n` a number, `c` a condition
    """

    emit: Callable[..., Value]
    takes: str = "n"


def _same(_v: Vectors, x: Value, *_: Value) -> Value:
    """Return the first operand: an assignment, or a message that compiled code does not print."""
    return x


OPERATIONS: dict[str, Operation] = {
    "ASSIGN": Operation(_same),
    "LIFT": Operation(_same, "nn"),
    "PRINTME": Operation(_same, "nn"),
    # arithmetic
    "ADD": Operation(lambda v, x, y: v.add(x, y), "nn"),
    "SUB": Operation(lambda v, x, y: v.sub(x, y), "nn"),
    "MUL": Operation(lambda v, x, y: v.mul(x, y), "nn"),
    "DIV": Operation(lambda v, x, y: v.div(x, y), "nn"),
    "FMA": Operation(lambda v, x, y, z: v.fma(x, y, z), "nnn"),
    "FMS": Operation(lambda v, x, y, z: v.fma(x, y, v.neg(z)), "nnn"),
    "FNMA": Operation(lambda v, x, y, z: v.fma(v.neg(x), y, z), "nnn"),
    "NEG": Operation(lambda v, x: v.neg(x)),
    "SQRT": Operation(lambda v, x: v.intrinsic("sqrt", x)),
    "FABS": Operation(lambda v, x: v.absolute(x)),
    "FLOOR": Operation(lambda v, x: v.intrinsic("floor", x)),
    "CEIL": Operation(lambda v, x: v.intrinsic("ceil", x)),
    "SIGN": Operation(lambda v, x: v.sign(x)),
    "COPYSIGN": Operation(lambda v, x, y: v.intrinsic("copysign", x, y), "nn"),
    "FMIN": Operation(lambda v, x, y: v.smaller(x, y), "nn"),
    "FMAX": Operation(lambda v, x, y: v.larger(x, y), "nn"),
    "FMOD": Operation(lambda v, x, y: v.libm("fmod", x, y), "nn"),
    "REMAINDER": Operation(lambda v, x, y: v.libm("remainder", x, y), "nn"),
    "HYPOT": Operation(elementary.hypot, "nn"),
    # conditions
    "LT": Operation(lambda v, x, y: v.compare("<", x, y), "nn"),
    "LE": Operation(lambda v, x, y: v.compare("<=", x, y), "nn"),
    "EQ": Operation(lambda v, x, y: v.compare("==", x, y), "nn"),
    "NE": Operation(lambda v, x, y: v.compare("!=", x, y), "nn"),
    "NOT": Operation(lambda v, x: v.negate(x), "c"),
    "AND": Operation(lambda v, x, y: v.both(x, y), "cc"),
    "OR": Operation(lambda v, x, y: v.either(x, y), "cc"),
    "IF_ELSE_ZERO": Operation(lambda v, c, x: v.select(c, x, v.number(0.0)), "cn"),
    # exponentials
    "EXP": Operation(elementary.exp),
    "EXPM1": Operation(elementary.expm1),
    "LOG": Operation(elementary.log),
    "LOG1P": Operation(lambda v, x: v.libm("log1p", x)),
    "POW": Operation(elementary.power, "nn"),
    "CONSTPOW": Operation(elementary.power, "nn"),
    "SINH": Operation(lambda v, x: v.libm("sinh", x)),
    "COSH": Operation(lambda v, x: v.libm("cosh", x)),
    "TANH": Operation(elementary.tanh),
    "ASINH": Operation(lambda v, x: v.libm("asinh", x)),
    "ACOSH": Operation(lambda v, x: v.libm("acosh", x)),
    "ATANH": Operation(lambda v, x: v.libm("atanh", x)),
    "ERF": Operation(lambda v, x: v.libm("erf", x)),
    "ERFINV": Operation(elementary.erfinv),
    # angles
    "SIN": Operation(elementary.sin),
    "COS": Operation(elementary.cos),
    "TAN": Operation(elementary.tan),
    "ASIN": Operation(elementary.asin),
    "ACOS": Operation(elementary.acos),
    "ATAN": Operation(elementary.atan),
    "ATAN2": Operation(elementary.atan2, "nn"),
}
"""Vector form of every operation of an expression graph, by CasADi's name for it; FMA, FMS and FNMA are ours."""

_LONG = frozenset(name for name, operation in OPERATIONS.items() if operation.emit.__module__ == elementary.__name__)
"""Operations that are written out as some hundred instructions."""

_LENGTH = 15


def _check_length(graph: Graph, positions: Collection[int]) -> None:
    """Raise ModelError: compilation, whose time grows with the square of the length, would take minutes."""
    length = sum(_LENGTH if graph.instructions[k].operation in _LONG else 1 for k in positions)
    if length > MOST_COMPILED:
        raise ModelError(
            f"simulation of the equations takes {beyond(MOST_COMPILED, 'operations', length)}, a sine and the like "
            f"counted as {_LENGTH}; simplify them, or split the machine into independent parts"
        )


def evaluate(
    v: Vectors,
    graph: Graph,
    wanted: Collection[int],
    load: Callable[[int, int], Value],
    known: Mapping[int, Value] | None = None,
) -> dict[int, Value]:
    """Emit some of a graph's instructions.

    Parameters
    ----------
    v : emits at the end of the current block
    graph : what to evaluate
    wanted : instructions whose results are wanted; their operands are emitted, too
    load : returns an element of an input, by argument and element
    known : results that are known already

    Returns
    -------
    the results by instruction, those of `known` included

    Raises ModelError: an operation that is not in `OPERATIONS`; there are too many.
    """
    values: dict[int, Value] = dict(known or {})
    positions = sorted(graph.needed(wanted, values))
    _check_length(graph, positions)
    for position in positions:
        instruction = graph.instructions[position]
        if instruction.operation == "CONST":
            values[position] = v.number(instruction.value)
        elif instruction.operation == "INPUT":
            values[position] = load(*instruction.source)
        else:
            operation = _vector_form(instruction.operation)
            operands = [
                _as_kind(v, values[k], kind) for k, kind in zip(instruction.operands, operation.takes, strict=True)
            ]
            values[position] = operation.emit(v, *operands)
    return values


def numbers(v: Vectors, values: Mapping[int, Value], positions: Collection[int]) -> list[Value]:
    """Results of instructions as numbers: a condition counts as 1 or 0."""
    return [_as_kind(v, values[position], "n") for position in positions]


def evaluate_into(
    v: Vectors,
    array: Value,
    graph: Graph,
    wanted: Collection[int],
    load: Callable[[int, int], Value],
    known: Mapping[int, Value] | None = None,
) -> None:
    """Emit instructions as `evaluate` does, and their results as the vectors of an array."""
    for k, value in enumerate(numbers(v, evaluate(v, graph, wanted, load, known), wanted)):
        v.put(value, array, k)


def _vector_form(name: str) -> Operation:
    """Entry of the table."""
    if name not in OPERATIONS:
        raise ModelError(f"operation {name} has no vector form; expand the function: Function.expand().")
    return OPERATIONS[name]


def _as_kind(v: Vectors, value: Value, kind: str) -> Value:
    """Turn a number into a condition (it is not zero) or a condition into a number (1 or 0)."""
    is_condition = v.is_condition(value)
    if kind == "n" and is_condition:
        return v.select(value, v.number(1.0), v.number(0.0))
    if kind == "c" and not is_condition:
        return v.compare("!=", value, v.number(0.0))
    return value


# A loop over rows ----------------------------------------------------------------------------------------------------
def emit_map_loop(graph: Graph, widths_in: Sequence[int]) -> Value:
    """LLVM module with one function, `map_loop`, of the inputs, the outputs, n_rows, first_block and end_block.

    Parameters
    ----------
    graph : of the function, with the inputs that all rows share as invariants
    widths_in : elements of each input, whose array is (n_rows, width) or, shared, (width,)

    The outputs' arrays are (n_rows, width).
    """
    function = new_function("map_loop", signature(len(widths_in) + len(graph.outputs), 3))
    *arrays, n_rows, first_block, end_block = function.args
    v = Vectors(function)

    def shared(argument: int, element: int) -> Value:
        return v.splat(v.load(arrays[argument], integer(element), DOUBLE))

    wanted = [k for row in graph.outputs for k in row]
    known = evaluate(v, graph, [k for k in graph.needed(wanted) if graph.invariant[k]], shared)
    with v.repeat(first_block, end_block) as blocks:
        rows = v.lanes_from(v.builder.mul(blocks.index, integer(LANES)), n_rows)
        values = evaluate(v, graph, wanted, _row_loader(v, arrays, widths_in, rows), known)
        for array, positions in zip(arrays[len(widths_in) :], graph.outputs, strict=True):
            _store(v, array, rows, numbers(v, values, positions))
    v.builder.ret_void()
    return function.module


def _row_loader(
    v: Vectors, arrays: Sequence[Value], widths: Sequence[int], rows: Sequence[Value]
) -> Callable[[int, int], Value]:
    """Loader of elements of some rows."""

    def load(argument: int, element: int) -> Value:
        return v.join([v.load(arrays[argument], _place(v, row, widths[argument], element), DOUBLE) for row in rows])

    return load


def _place(v: Vectors, row: Value, width: int, element: int) -> Value:
    """Position of an element of a row."""
    return v.builder.add(v.builder.mul(row, integer(width)), integer(element))


def _store(v: Vectors, array: Value, rows: Sequence[Value], values: Sequence[Value]) -> None:
    """Write one output's elements of some rows."""
    for lane, row in enumerate(rows):
        for element, value in enumerate(values):
            v.store(v.lane(value, lane), array, _place(v, row, len(values), element))
