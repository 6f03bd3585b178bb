"""Vector form of every operation that CasADi's SX knows, in one table, and the emission of a graph by it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from diransac.errors import ModelError
from diransac.simulation.compiler import angles, exponentials

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping

    from diransac.simulation.compiler.graph import Graph
    from diransac.simulation.compiler.vectors import Value, Vectors

__all__ = ["OPERATIONS", "Operation", "evaluate", "numbers"]


@dataclass(frozen=True)
class Operation:
    """Vector form of an operation.

    Attributes
    ----------
    emit : called with the vectors and one value for each operand; returns the result
    takes : kind of each operand, `n` a number, `c` a condition
    gives : kind of the result
    """

    emit: Callable[..., Value]
    takes: str = "n"
    gives: str = "n"


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
    "HYPOT": Operation(angles.hypot, "nn"),
    # conditions
    "LT": Operation(lambda v, x, y: v.compare("<", x, y), "nn", "c"),
    "LE": Operation(lambda v, x, y: v.compare("<=", x, y), "nn", "c"),
    "EQ": Operation(lambda v, x, y: v.compare("==", x, y), "nn", "c"),
    "NE": Operation(lambda v, x, y: v.compare("!=", x, y), "nn", "c"),
    "NOT": Operation(lambda v, x: v.negate(x), "c", "c"),
    "AND": Operation(lambda v, x, y: v.both(x, y), "cc", "c"),
    "OR": Operation(lambda v, x, y: v.either(x, y), "cc", "c"),
    "IF_ELSE_ZERO": Operation(lambda v, c, x: v.select(c, x, v.number(0.0)), "cn"),
    # exponentials
    "EXP": Operation(exponentials.exp),
    "EXPM1": Operation(exponentials.expm1),
    "LOG": Operation(exponentials.log),
    "LOG1P": Operation(exponentials.log1p),
    "POW": Operation(exponentials.power, "nn"),
    "CONSTPOW": Operation(exponentials.power, "nn"),
    "SINH": Operation(exponentials.sinh),
    "COSH": Operation(exponentials.cosh),
    "TANH": Operation(exponentials.tanh),
    "ASINH": Operation(exponentials.asinh),
    "ACOSH": Operation(exponentials.acosh),
    "ATANH": Operation(exponentials.atanh),
    "ERF": Operation(lambda v, x: v.libm("erf", x)),
    "ERFINV": Operation(exponentials.erfinv),
    # angles
    "SIN": Operation(angles.sin),
    "COS": Operation(angles.cos),
    "TAN": Operation(angles.tan),
    "ASIN": Operation(angles.asin),
    "ACOS": Operation(angles.acos),
    "ATAN": Operation(angles.atan),
    "ATAN2": Operation(angles.atan2, "nn"),
}
"""Vector form of every operation of an expression graph, by CasADi's name for it; FMA, FMS and FNMA are ours."""


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
    wanted : instructions whose results are wanted; what they need is emitted too
    load : gives an element of an input, by argument and element
    known : results that are there already

    Returns
    -------
    the results by instruction, those of `known` included

    Raises ModelError: an operation that is not in `OPERATIONS`.
    """
    values: dict[int, Value] = dict(known or {})
    for position in sorted(graph.needed(wanted, values)):
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
