"""Keyed permutations by Feistel networks, emitted.

A network permutes the numbers of ``2 half`` bits.  One that it takes out of the range sought is permuted again until it
is back (cycle walking), which permutes that range.  Lanes that are back wait for the others.
"""

from __future__ import annotations

from functools import reduce
from typing import TYPE_CHECKING

from llvmlite import ir

from diransac.simulation.compiler.machine_code import LANES
from diransac.simulation.compiler.vectors import BIT, CONDITIONS, INTEGER, INTEGERS, POINTER, Value, Vectors, integer

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["emit_permutations"]

_GOLDEN = 0x9E3779B97F4A7C15
_ENDLESS = 2**62


def emit_permutations(name: str, most_rounds: int, at_a_time: int) -> Value:
    """LLVM module with one function.

    Its arguments are the arrays `iterations` (n,) and `found` (n, width), the seed, and the sizes n, n_rows, start,
    stop, width, half and n_rounds.  Row i of `found` begins with positions start to stop of the permutation of n_rows
    numbers whose key is (seed, iterations[i]).
    """
    module = ir.Module(name)
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [POINTER] * 2 + [INTEGER] * 8), name)
    iterations, found, seed, n, n_rows, start, stop, width, half, n_rounds = function.args
    v = Vectors(ir.IRBuilder(function.append_basic_block("entry")))
    b, firsts = v.builder, range(0, at_a_time, LANES)
    network = _Network(v, half, n_rounds, most_rounds)
    of_seed, last, end = _mixed(v, v.splat(seed)), v.splat(b.sub(stop, integer(1))), v.splat(n_rows)
    places = [ir.Constant(INTEGERS, [ir.Constant(INTEGER, k + lane) for lane in range(LANES)]) for k in firsts]
    with v.repeat(integer(0), n) as sample:
        network.set_key(b.add(of_seed, v.splat(v.load(iterations, sample.index, INTEGER))))
        with v.repeat(integer(0), b.sdiv(width, integer(at_a_time))) as part:
            first = b.mul(part.index, integer(at_a_time))
            positions = [b.add(v.splat(b.add(start, first)), own) for own in places]
            rows = network.walked([v.select(b.icmp_signed("<", x, last), x, last) for x in positions], end)
            at = b.add(b.mul(sample.index, width), first)
            for k, some in zip(firsts, rows, strict=True):
                v.store(some, found, b.add(at, integer(k)))
    b.ret_void()
    return module


class _Network:
    """Emitter of a network whose rounds add mixed bits of one half of a number to the other half."""

    def __init__(self, v: Vectors, half: Value, n_rounds: Value, most_rounds: int) -> None:
        self._v, self._half, self._n_rounds, self._keys = v, v.splat(half), n_rounds, v.array(most_rounds)
        b = v.builder
        self._low = v.splat(b.sub(b.shl(integer(1), half), integer(1)))

    def set_key(self, key: Value) -> None:
        """Emit the keys of the rounds."""
        v, b, mixed = self._v, self._v.builder, _mixed(self._v, key)
        with v.repeat(integer(0), self._n_rounds) as rounds:
            step = v.splat(b.mul(b.add(rounds.index, integer(1)), integer(_GOLDEN)))
            v.put(v.from_bits(_mixed(v, b.add(mixed, step))), self._keys, rounds.index)

    def walked(self, positions: Sequence[Value], end: Value) -> list[Value]:
        """Emit the permutation of positions below an end to numbers below it."""
        v, b = self._v, self._v.builder
        found = [v.variable(x) for x in positions]
        outside = [v.variable(ir.Constant(CONDITIONS, [ir.Constant(BIT, 1)] * LANES)) for _ in positions]
        with v.repeat(integer(0), integer(_ENDLESS)) as walk:
            permuted = self._permuted([v.get(x) for x in found])
            for number, mask, x in zip(found, outside, permuted, strict=True):
                v.set(number, v.select(v.get(mask), x, v.get(number)))
                v.set(mask, b.icmp_unsigned(">=", v.get(number), end))
            is_left = reduce(v.either, [v.get(mask) for mask in outside])
            with b.if_then(b.not_(v.any_lane(is_left))):
                b.branch(walk.leave)
        return [v.get(number) for number in found]

    def _permuted(self, numbers: Sequence[Value]) -> list[Value]:
        """Emit the permutation of numbers of 2 half bits."""
        v, b = self._v, self._v.builder
        halves = [(v.variable(b.lshr(x, self._half)), v.variable(v.both(x, self._low))) for x in numbers]
        with v.repeat(integer(0), self._n_rounds) as rounds:
            key = v.bits(v.pick(self._keys, rounds.index))
            for left, right in halves:
                kept = v.get(right)
                mixed = v.both(_mixed(v, v.add_integers(kept, key)), self._low)
                v.set(right, v.exclusive_or(v.get(left), mixed))
                v.set(left, kept)
        return [v.either(b.shl(v.get(left), self._half), v.get(right)) for left, right in halves]


def _mixed(v: Vectors, x: Value) -> Value:
    """SplitMix64's finalizer, a bijection of 64-bit words."""
    for places, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        x = v.builder.mul(v.exclusive_or(x, v.shift_right(x, places)), v.integer(factor))
    return v.exclusive_or(x, v.shift_right(x, 31))
