"""Expression graph of a CasADi SX function, as a list of instructions.

Equal sub-expressions are one instruction. Products are fused into the sums and differences that use them; instructions
that depend on invariant inputs only are marked, to be computed once instead of in every step. Both decisions depend on
an instruction's operands, never on its users, so an expression has the same bits whatever else is computed.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import casadi as ca

from diransac.errors import ModelError
from diransac.model.expressions import steps

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable


@dataclass(frozen=True, slots=True)
class Instruction:
    """One operation on the results of earlier instructions.

    Attributes
    ----------
    operation : CasADi's name without `OP_`, or one of `FMA` x y + z, `FMS` x y - z, `FNMA` z - x y
    operands : positions of the instructions whose results it takes
    constant : the bits of a CONST
    source : of an INPUT, the argument of the function and the element of it, column by column, zeros included
    """

    operation: str
    operands: tuple[int, ...] = ()
    constant: bytes = b""
    source: tuple[int, int] = (-1, -1)

    @property
    def value(self) -> float:
        """Number that a CONST stands for."""
        return float(struct.unpack("<d", self.constant)[0])


@dataclass(frozen=True)
class Graph:
    """Instructions in an order in which they can run.

    Attributes
    ----------
    instructions : each refers to earlier ones only
    outputs : for each output of the function, the instruction that gives each of its elements, column by column
    invariant : true for each instruction that depends on constants and invariant inputs only
    """

    instructions: tuple[Instruction, ...]
    outputs: tuple[tuple[int, ...], ...]
    invariant: tuple[bool, ...]

    def needed(self, wanted: Iterable[int], known: Collection[int] = ()) -> frozenset[int]:
        """Return the wanted instructions and all that they depend on, without those that are known."""
        alive = set(wanted).difference(known)
        for position in range(len(self.instructions) - 1, -1, -1):
            if position in alive:
                alive.update(k for k in self.instructions[position].operands if k not in known)
        return frozenset(alive)


@dataclass
class _Builder:
    """Collector of instructions; an equal one is used again."""

    instructions: list[Instruction] = field(default_factory=list)
    positions: dict[Instruction, int] = field(default_factory=dict)

    def add(self, instruction: Instruction) -> int:
        """Return the position of the instruction."""
        position = self.positions.setdefault(instruction, len(self.instructions))
        if position == len(self.instructions):
            self.instructions.append(instruction)
        return position

    def constant(self, value: float) -> int:
        """Return the position of a constant."""
        return self.add(Instruction("CONST", constant=struct.pack("<d", value)))

    def operation(self, name: str, operands: tuple[int, ...]) -> int:
        """Return the position of an operation; a square, double or reciprocal is the product or ratio that it is."""
        if name == "SQ":
            return self.add(Instruction("MUL", operands * 2))
        if name == "TWICE":
            return self.add(Instruction("MUL", (self.constant(2.0), *operands)))
        if name == "INV":
            return self.add(Instruction("DIV", (self.constant(1.0), *operands)))
        return self.add(Instruction(name, operands))


def check_compilable(function: ca.Function) -> None:
    """Raises ModelError: a function is not of SX symbols, or has an operation without a vector form."""
    if not function.is_a("SXFunction"):
        raise ModelError(
            f"function {function.name()!r} cannot be compiled: it is a {function.class_name()}, "
            "not an expression of SX symbols; expand it: Function.expand()."
        )
    operations = {function.instruction_id(k) for k in range(function.n_instructions())}
    if ca.OP_CALL in operations:
        raise ModelError(
            f"function {function.name()!r} cannot be compiled: it calls another function (operation CALL), an "
            "interpolant for example; write it as an expression, or expand it: Function.expand()."
        )
    if ca.OP_PARAMETER in operations:
        free = ", ".join(str(symbol) for symbol in function.free_sx())
        raise ModelError(
            f"function {function.name()!r} cannot be compiled: {free} is a symbol that is none of its arguments "
            "(operation PARAMETER); make it an argument or a number."
        )


def read_graph(function: ca.Function, invariant_inputs: Collection[int] = (), *, reciprocals: bool = False) -> Graph:
    """Expression graph of an SX function, with products fused into sums.

    Parameters
    ----------
    function : CasADi SX function
    invariant_inputs : arguments that are constant over all steps or rows of a call
    reciprocals : divide by an invariant as `x * (1 / p)`, so that the loop only multiplies. The quotient may differ in
        its last two bits, and where `|p|` lies outside 2**-1022 .. 2**1022 its reciprocal over- or underflows

    Raises ModelError: as `check_compilable`.
    """
    check_compilable(function)
    instructions, outputs = _read(function)
    graph = _marked(instructions, outputs, frozenset(invariant_inputs))
    if reciprocals:
        graph = _with_reciprocals(graph, frozenset(invariant_inputs))
    return _fused(graph, frozenset(invariant_inputs))


def _read(function: ca.Function) -> tuple[list[Instruction], list[list[int]]]:
    """Instructions of a function, each value once, and the dense outputs."""
    builder = _Builder()
    elements_in = [_dense_elements(function.sparsity_in(k)) for k in range(function.n_in())]
    elements_out = [_dense_elements(function.sparsity_out(k)) for k in range(function.n_out())]
    zero = builder.constant(0.0)
    outputs = [[zero] * function.numel_out(k) for k in range(function.n_out())]
    moved: list[int] = []
    for step in steps(function):
        number, place = step.place
        if step.operation == "output":
            moved.append(moved[step.operands[0]])
            outputs[number][elements_out[number][place]] = moved[-1]
        elif step.operation == "input":
            moved.append(builder.add(Instruction("INPUT", source=(number, elements_in[number][place]))))
        elif step.operation == "const":
            moved.append(builder.constant(step.constant))
        else:
            moved.append(builder.operation(step.operation.upper(), tuple(moved[k] for k in step.operands)))
    return builder.instructions, outputs


def _dense_elements(sparsity: ca.Sparsity) -> list[int]:
    """Position of each structural non-zero in the dense matrix, column by column."""
    rows, columns = sparsity.get_triplet()
    return [row + column * sparsity.size1() for row, column in zip(rows, columns, strict=True)]


def _marked(instructions: list[Instruction], outputs: Iterable[Iterable[int]], inputs: frozenset[int]) -> Graph:
    """Graph with the instructions marked that depend on invariant inputs only."""
    invariant: list[bool] = []
    for instruction in instructions:
        fixed = instruction.source[0] in inputs if instruction.operation == "INPUT" else True
        invariant.append(fixed and all(invariant[k] for k in instruction.operands))
    return Graph(tuple(instructions), tuple(tuple(row) for row in outputs), tuple(invariant))


def _with_reciprocals(graph: Graph, inputs: frozenset[int]) -> Graph:
    """Graph whose divisions by an invariant are products with its reciprocal."""
    builder = _Builder()
    moved: list[int] = []
    for instruction in graph.instructions:
        operands = tuple(moved[k] for k in instruction.operands)
        copy = replace(instruction, operands=operands)
        if instruction.operation == "DIV":
            dividend, divisor = instruction.operands
            if graph.invariant[divisor] and not graph.invariant[dividend]:
                reciprocal = builder.operation("INV", (operands[1],))
                copy = Instruction("MUL", (operands[0], reciprocal))
        moved.append(builder.add(copy))
    return _marked(builder.instructions, [[moved[k] for k in row] for row in graph.outputs], inputs)


def _fused(graph: Graph, inputs: frozenset[int]) -> Graph:
    """Graph with products fused into the sums that add them: one rounding and one operation less."""
    fused = [_fuse(graph, position) for position in range(len(graph.instructions))]
    return _marked(fused, graph.outputs, inputs)


def _fuse(graph: Graph, position: int) -> Instruction:
    """Fuse a sum or difference with its first operand, else its second, if that is a product.

    Other users of the product do not matter: a sum has the same bits whatever else is computed.
    """
    instruction = graph.instructions[position]
    if instruction.operation not in ("ADD", "SUB"):
        return instruction
    names = {"ADD": ("FMA", "FMA"), "SUB": ("FMS", "FNMA")}[instruction.operation]
    for side, name in enumerate(names):
        factor = instruction.operands[side]
        product = graph.instructions[factor]
        # An invariant product costs nothing inside the loop: fusing it would only occupy one more register.
        hoisted = graph.invariant[factor] and not graph.invariant[position]
        if product.operation == "MUL" and not hoisted:
            return Instruction(name, (*product.operands, instruction.operands[1 - side]))
    return instruction
