"""Eight float64 lanes at a time: llvmlite's IR builder with vector types.

Every method emits instructions whose lanes are independent and correctly rounded (no fast-math flags), so the bits of a
lane depend neither on its neighbours nor on the width of the registers.
"""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, TypeAlias

from llvmlite import ir

from diransac.simulation.compiler.machine_code import LANES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

Value: TypeAlias = Any
"""An LLVM value: a vector of numbers, of 64-bit integers or of conditions, or a scalar (llvmlite has no types)."""

DOUBLE = ir.DoubleType()
INTEGER = ir.IntType(64)
BYTE = ir.IntType(8)  # and a bit for each lane
POINTER = ir.PointerType()
NUMBERS = ir.VectorType(DOUBLE, LANES)
INTEGERS = ir.VectorType(INTEGER, LANES)
CONDITIONS = ir.VectorType(ir.IntType(1), LANES)


@dataclass(frozen=True)
class Variable:
    """A mutable variable of the emitted code; LLVM keeps it in a register."""

    address: Value
    type: Value


@dataclass(frozen=True)
class Loop:
    """A loop being emitted: its counter, and the block to branch to in order to leave it."""

    index: Value
    leave: Value


@lru_cache(maxsize=4096)
def integer(value: int) -> Value:
    """64-bit integer constant, a scalar; one object for a value, as it keeps its text."""
    return ir.Constant(INTEGER, value)


@lru_cache(maxsize=4096)
def _number(digits: str) -> Value:
    """Vector of a constant, by its digits, which tell 0 from -0; one object for a value, as it keeps its text."""
    return ir.Constant(NUMBERS, [ir.Constant(DOUBLE, float.fromhex(digits))] * LANES)


def new_function(name: str, signature: Iterable[str], module: Value = None) -> Value:
    """Function without a body in a module, a new one by default.  Its arrays do not overlap.

    Parameters
    ----------
    signature : kind of each argument, as of `compile_function`
    """
    types = {"pointer": POINTER, "integer": INTEGER, "number": DOUBLE}
    kind = ir.FunctionType(ir.VoidType(), [types[one] for one in signature])
    function = ir.Function(module or ir.Module("diransac"), kind, name)
    for argument in function.args:
        if argument.type == POINTER:
            argument.add_attribute("noalias")
    return function


class Vectors:
    """Emitter of arithmetic on vectors of eight lanes, into a new function.

    `add`, `sub`, `mul`, `div` and `neg` are of numbers, `add_integers` and `exclusive_or` of integers; `both`, `either`
    and `negate` of conditions or, bit by bit, of integers; ``select(condition, x, y)`` is x where it holds, else y.
    """

    def __init__(self, function: Value) -> None:
        self.builder = emit = ir.IRBuilder(function.append_basic_block("entry"))
        self.add, self.sub, self.mul, self.div, self.neg = emit.fadd, emit.fsub, emit.fmul, emit.fdiv, emit.fneg
        self.add_integers, self.exclusive_or = emit.add, emit.xor
        self.both, self.either, self.negate, self.select = emit.and_, emit.or_, emit.not_, emit.select
        self._memory: dict[tuple[str, Value], Value] = {}

    def align_frame(self) -> None:
        """Align the function's stack frame to a vector, so that no value that LLVM spills straddles two cache lines.

        LLVM lays out the frame before it knows that it must spill, and would leave it at 16 bytes. An assembler
        statement without code keeps the vector that asks for more.
        """
        kept = ir.FunctionType(ir.VoidType(), [POINTER])
        self.builder.call(ir.InlineAsm(kept, "", "r", side_effect=True), [self.array(1)])

    def once(self, name: str, operand: Value, emit: Callable[[], Value]) -> Value:
        """`emit()`, or its earlier value for the same name and operand: sin and cos share their work."""
        key = (name, operand)
        if key not in self._memory:
            self._memory[key] = emit()
        return self._memory[key]

    # Constants -----------------------------------------------------------------------------------------------------
    def number(self, value: float) -> Value:
        """Return the constant in every lane."""
        return _number(float(value).hex())

    def integer(self, value: int) -> Value:
        """Return the 64-bit integer constant in every lane."""
        return ir.Constant(INTEGERS, [ir.Constant(INTEGER, value)] * LANES)

    # Arithmetic ----------------------------------------------------------------------------------------------------
    def fma(self, x: Value, y: Value, z: Value) -> Value:
        """Return x y + z, rounded once."""
        return self.intrinsic("fma", x, y, z)

    def absolute(self, x: Value) -> Value:
        """Return |x|."""
        return self.intrinsic("fabs", x)

    def polynomial(self, x: Value, coefficients: Sequence[float]) -> Value:
        """Return a polynomial by Horner's rule, its highest power first."""
        result = self.number(coefficients[0])
        for coefficient in coefficients[1:]:
            result = self.fma(result, x, self.number(coefficient))
        return result

    def sign(self, x: Value) -> Value:
        """Return -1, 1, or x where that is zero or NaN."""
        zero = self.number(0.0)
        negative = self.select(self.compare("<", x, zero), self.number(-1.0), x)
        return self.select(self.compare(">", x, zero), self.number(1.0), negative)

    def smaller(self, x: Value, y: Value) -> Value:
        """Return the smaller operand; the other one where one is NaN."""
        return self.select(self.either(self.compare("<", x, y), self.is_nan(y)), x, y)

    def larger(self, x: Value, y: Value) -> Value:
        """Return the larger operand; the other one where one is NaN."""
        return self.select(self.either(self.compare(">", x, y), self.is_nan(y)), x, y)

    def clamped(self, x: Value, lowest: float, highest: float) -> Value:
        """Return x within bounds; NaN stays."""
        x = self.select(self.compare("<", x, self.number(lowest)), self.number(lowest), x)
        return self.select(self.compare(">", x, self.number(highest)), self.number(highest), x)

    def intrinsic(self, name: str, *operands: Value) -> Value:
        """Return LLVM's `llvm.<name>` of vectors."""
        return self.builder.call(self._declared(f"llvm.{name}.v{LANES}f64", NUMBERS, len(operands)), operands)

    def libm(self, name: str, *operands: Value) -> Value:
        """Return the C library's function of every lane, one lane after the other."""
        function = self._declared(name, DOUBLE, len(operands))
        result = ir.Constant(NUMBERS, ir.Undefined)
        for lane in range(LANES):
            scalars = [self.lane(operand, lane) for operand in operands]
            result = self.with_lane(result, self.builder.call(function, scalars), lane)
        return result

    def _declared(self, name: str, kind: Value, n_operands: int) -> Value:
        """Return a function from elsewhere, declared once in the module."""
        module = self.builder.module
        known = module.globals.get(name)
        return known or ir.Function(module, ir.FunctionType(kind, [kind] * n_operands), name)

    # Conditions ----------------------------------------------------------------------------------------------------
    def compare(self, relation: str, x: Value, y: Value) -> Value:
        """Return `x relation y`, false where either is NaN, except that NaN differs from everything."""
        emit = self.builder.fcmp_unordered if relation == "!=" else self.builder.fcmp_ordered
        return emit(relation, x, y)

    def is_condition(self, x: Value) -> bool:
        """True for a vector of conditions, false for one of numbers."""
        return bool(x.type == CONDITIONS)

    def is_nan(self, x: Value) -> Value:
        """Return where x is NaN."""
        return self.builder.fcmp_unordered("uno", x, x)

    def count(self, total: Value, condition: Value) -> Value:
        """Return integers that grow by one where the condition holds."""
        return self.builder.sub(total, self.builder.sext(condition, INTEGERS))

    def any_lane(self, condition: Value) -> Value:
        """Return one bit, set if the condition holds in some lane."""
        return self.builder.icmp_unsigned("!=", self.builder.bitcast(condition, BYTE), ir.Constant(BYTE, 0))

    def turned_towards(
        self, values: Sequence[Value], targets: Sequence[Value], places: Sequence[int]
    ) -> tuple[list[Value], Value]:
        """Return the values, those at `places` with the common sign that is nearer to the targets; where it changed."""
        dot, turned = self.number(0.0), list(values)
        for k in places:
            dot = self.fma(values[k], targets[k], dot)
        opposite = self.compare("<", dot, self.number(0.0))
        for k in places:
            turned[k] = self.select(opposite, self.neg(values[k]), values[k])
        return turned, opposite

    # Bits ----------------------------------------------------------------------------------------------------------
    def bits(self, x: Value) -> Value:
        """Return the 64 bits of each number as an integer."""
        return self.builder.bitcast(x, INTEGERS)

    def from_bits(self, x: Value) -> Value:
        """Return the numbers whose bits these integers are."""
        return self.builder.bitcast(x, NUMBERS)

    def lowest_bit(self, x: Value) -> Value:
        """Return the condition that an integer is odd."""
        return self.builder.trunc(x, CONDITIONS)

    def has_bits(self, x: Value, mask: int) -> Value:
        """Return where an integer shares a bit with the mask."""
        return self.builder.icmp_unsigned("!=", self.both(x, self.integer(mask)), self.integer(0))

    def sign_bit(self, x: Value) -> Value:
        """Return where the sign of x is minus, zeros included."""
        return self.builder.icmp_signed("<", self.bits(x), self.integer(0))

    def shift_left(self, x: Value, places: int) -> Value:
        """Return x 2**places, modulo 2**64."""
        return self.builder.shl(x, self.integer(places))

    def shift_right(self, x: Value, places: int) -> Value:
        """Return x / 2**places of integers without sign, rounded down."""
        return self.builder.lshr(x, self.integer(places))

    # Lanes and memory ----------------------------------------------------------------------------------------------
    def lane(self, x: Value, lane: int) -> Value:
        """Return one lane as a scalar."""
        return self.builder.extract_element(x, integer(lane))

    def with_lane(self, x: Value, scalar: Value, lane: int) -> Value:
        """Return the vector with one lane replaced."""
        return self.builder.insert_element(x, scalar, integer(lane))

    def join(self, scalars: list[Value]) -> Value:
        """Return the vector of these eight scalars."""
        result = ir.Constant(ir.VectorType(scalars[0].type, LANES), ir.Undefined)
        for lane, scalar in enumerate(scalars):
            result = self.with_lane(result, scalar, lane)
        return result

    def splat(self, scalar: Value) -> Value:
        """Return the scalar in every lane."""
        kind = ir.VectorType(scalar.type, LANES)
        undefined = ir.Constant(kind, ir.Undefined)
        first = self.with_lane(undefined, scalar, 0)
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        return self.builder.shuffle_vector(first, undefined, zeros)

    def lanes_from(self, first: Value, n: Value) -> list[Value]:
        """Return the numbers of eight lanes from the first on, those past the end of n being the last."""
        builder = self.builder
        last = builder.sub(n, integer(1))
        lanes = [builder.add(first, integer(lane)) for lane in range(LANES)]
        return [builder.select(builder.icmp_signed("<", lane, last), lane, last) for lane in lanes]

    def load(self, base: Value, index: Value, kind: Value) -> Value:
        """Load a scalar, or a vector that starts, at element `index` of an array."""
        element = kind.element if isinstance(kind, ir.VectorType) else kind
        address = self.builder.gep(base, [index], source_etype=element)
        return self.builder.load(address, typ=kind, align=1 if element == BYTE else 8)

    def row(self, base: Value, row: Value, width: int, kind: Value) -> Value:
        """Address of a row of a matrix of scalars."""
        return self.builder.gep(base, [self.builder.mul(row, integer(width))], source_etype=kind)

    def store(self, value: Value, base: Value, index: Value) -> None:
        """Store a scalar or a vector at element `index` of an array of float64 or int64."""
        address = self.builder.gep(base, [index], source_etype=INTEGER)
        self.builder.store(value, address, align=8)

    def store_bits(self, condition: Value, base: Value, index: Value) -> None:
        """Store a condition at element `index` of an array of bytes, the first lane in the lowest bit."""
        self.builder.store(self.builder.bitcast(condition, BYTE), self.builder.gep(base, [index], source_etype=BYTE))

    def array(self, size: int) -> Value:
        """Return a new array of vectors, on the stack."""
        with self.builder.goto_entry_block():
            place = self.builder.alloca(NUMBERS, size=max(size, 1))
            place.align = 8 * LANES
            return self.builder.bitcast(place, POINTER)

    def pick(self, array: Value, index: Value | int) -> Value:
        """Load vector `index` of an array of vectors."""
        return self.builder.load(self._vector(array, index), typ=NUMBERS, align=8 * LANES)

    def put(self, value: Value, array: Value, index: Value | int) -> None:
        """Store vector `index` of an array of vectors."""
        self.builder.store(value, self._vector(array, index), align=8 * LANES)

    def _vector(self, array: Value, index: Value | int) -> Value:
        """Address of vector `index` of an array of vectors."""
        at = integer(index) if isinstance(index, int) else index
        return self.builder.gep(array, [at], source_etype=NUMBERS)

    def affine(self, index: Value | int, factor: int, offset: Value | int = 0) -> Value | int:
        """Return `index * factor + offset`, a number if both are numbers."""
        if isinstance(index, int):
            product: Value | int = index * factor
        else:
            product = index if factor == 1 else self.builder.mul(index, integer(factor))
        if isinstance(product, int) and isinstance(offset, int):
            return product + offset
        if isinstance(offset, int) and not offset:
            return product
        terms = (integer(term) if isinstance(term, int) else term for term in (product, offset))
        return self.builder.add(*terms)

    def each(self, first: Value | int, end: Value | int, emit: Callable[[Value | int], None]) -> None:
        """Emit `emit(index)` in a loop over every index from `first` to before `end`; without a loop if it is one."""
        if isinstance(first, int) and isinstance(end, int) and end - first == 1:
            emit(first)
            return
        ends = (integer(x) if isinstance(x, int) else x for x in (first, end))
        with self.repeat(*ends) as loop:
            emit(loop.index)

    # Control -------------------------------------------------------------------------------------------------------
    def variable(self, value: Value) -> Variable:
        """Return a new variable that holds the value."""
        with self.builder.goto_entry_block():
            address = self.builder.alloca(value.type)
        self.builder.store(value, address)
        return Variable(address, value.type)

    def get(self, variable: Variable) -> Value:
        """Return the value of a variable."""
        return self.builder.load(variable.address, typ=variable.type)

    def set(self, variable: Variable, value: Value) -> None:
        """Set a variable."""
        self.builder.store(value, variable.address)

    def call_aside(self, name: str, emit: Callable[..., Value], *operands: Value) -> Value:
        """Return `emit(vectors, *operands)`, as a separate function, once per module: for rare cases.

        Parameters
        ----------
        name : of the function; the same name means the same `emit`
        """
        function = self.builder.module.globals.get(name)
        if function is None:
            function = ir.Function(self.builder.module, ir.FunctionType(NUMBERS, [NUMBERS] * len(operands)), name)
            function.linkage = "internal"
            for attribute in ("noinline", "cold"):
                function.attributes.add(attribute)
            aside = Vectors(function)
            aside.builder.ret(emit(aside, *function.args))
        return self.builder.call(function, operands)

    @contextmanager
    def repeat(self, first: Value, end: Value) -> Iterator[Loop]:
        """Emit a loop over every index from `first` to before `end`; the context is its body."""
        builder = self.builder
        index = self.variable(first)
        test, body, leave = (builder.append_basic_block(name) for name in ("test", "body", "leave"))
        builder.branch(test)
        builder.position_at_end(test)
        counter = self.get(index)
        builder.cbranch(builder.icmp_signed("<", counter, end), body, leave)
        builder.position_at_end(body)
        yield Loop(counter, leave)
        self.set(index, builder.add(counter, integer(1)))
        builder.branch(test)
        builder.position_at_end(leave)
