"""Order statistics by bisection, emitted.

Numbers that are not negative are in the order of their bits.  Those of the number sought are found from the highest on:
each is 1 if too few numbers have a 0 there, and what was found before it.  Counting is the quickest thing that vectors
do, and no number is moved.  The search ends when one number is left.
"""

from __future__ import annotations

from diransac.simulation.compiler.machine_code import LANES, signature
from diransac.simulation.compiler.vectors import INTEGER, INTEGERS, Value, Vectors, integer, new_function


def emit_bisection() -> Value:
    """LLVM module with one function, `order_statistics`.

    Its arguments are the arrays `values` (n_rows, width), `places` (n_rows,) and `found` (n_rows,), and the sizes
    n_rows and width, which is a multiple of eight.
    """
    function = new_function("order_statistics", signature(3, 2))
    values, places, found, n_rows, width = function.args
    v = Vectors(function)
    with v.repeat(integer(0), n_rows) as row:
        numbers = v.builder.gep(values, [v.builder.mul(row.index, width)], source_etype=INTEGER)
        least = _lower_bound(v, numbers, v.load(places, row.index, INTEGER), width)
        v.store(_smallest_from(v, numbers, least, width), found, row.index)
    v.builder.ret_void()
    return function.module


def _lower_bound(v: Vectors, numbers: Value, place: Value, width: Value) -> Value:
    """Bits that are at most those of the number sought, and more than those of the number before it."""
    b = v.builder
    least, n_below, n_up_to = v.variable(integer(0)), v.variable(integer(0)), v.variable(width)
    with v.repeat(integer(0), integer(63)) as step:  # without the sign
        bit = b.shl(integer(1), b.sub(integer(62), step.index))
        low = v.get(least)
        count = _count_up_to(v, numbers, b.or_(low, b.sub(bit, integer(1))), width)
        is_higher = b.icmp_signed("<=", count, place)
        v.set(least, b.select(is_higher, b.or_(low, bit), low))
        v.set(n_below, b.select(is_higher, count, v.get(n_below)))
        v.set(n_up_to, b.select(is_higher, v.get(n_up_to), count))
        with b.if_then(b.icmp_signed("==", b.sub(v.get(n_up_to), v.get(n_below)), integer(1))):
            b.branch(step.leave)
    return v.get(least)


def _count_up_to(v: Vectors, numbers: Value, most: Value, width: Value) -> Value:
    """Number of the numbers whose bits are at most so many."""
    b, bound, total = v.builder, v.splat(most), v.variable(v.integer(0))
    with v.repeat(integer(0), b.sdiv(width, integer(LANES))) as loop:
        some = v.load(numbers, b.mul(loop.index, integer(LANES)), INTEGERS)
        v.set(total, v.count(v.get(total), b.icmp_signed("<=", some, bound)))
    counts, found = v.get(total), integer(0)
    for lane in range(LANES):
        found = b.add(found, v.lane(counts, lane))
    return found


def _smallest_from(v: Vectors, numbers: Value, least: Value, width: Value) -> Value:
    """Bits of the smallest number whose bits are at least so many."""
    b, bound, largest = v.builder, v.splat(least), integer(2**63 - 1)
    smallest = v.variable(v.splat(largest))
    with v.repeat(integer(0), b.sdiv(width, integer(LANES))) as loop:
        some = v.load(numbers, b.mul(loop.index, integer(LANES)), INTEGERS)
        is_next = b.and_(b.icmp_signed(">=", some, bound), b.icmp_signed("<", some, v.get(smallest)))
        v.set(smallest, v.select(is_next, some, v.get(smallest)))
    lanes, found = v.get(smallest), largest
    for lane in range(LANES):
        one = v.lane(lanes, lane)
        found = b.select(b.icmp_signed("<", one, found), one, found)
    return found
