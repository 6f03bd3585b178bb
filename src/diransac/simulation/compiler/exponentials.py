"""Exponentials, logarithms and powers, eight at a time: polynomials that the compiler can inline.

Each is good to a few units in the last place over the whole range of float64, and agrees with C on infinities, NaN and
the signs of zeros. Nothing is looked up and nothing branches.

References: Cody and Waite, Software Manual for the Elementary Functions, 1980, for the reduction of arguments. The
coefficients of the logarithm are those of Sun's fdlibm.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from diransac.simulation.compiler.vectors import Value, Vectors

ROUND = 1.5 * 2.0**52
"""Adding it rounds to an integer, which then stands in the low bits; taking it away again leaves the integer."""
EXPONENT_SHIFT = 52
MANTISSA_BITS = 2**52 - 1

LOG2_E = 1.4426950408889634
LN_2 = (0.6931471805599453, 2.3190468138462996e-17)
LN_2_SHORT = (6.93147180369123816490e-01, 1.90821492927058770002e-10)  # the first has 21 zero bits at its end
SMALLEST_EXP, LARGEST_EXP = -746.0, 710.0
LARGEST_SINH = 710.6
EXPONENTIAL = tuple(1.0 / math.factorial(k) for k in range(13, 1, -1))  # remainder below 5e-18 for |r| <= ln(2) / 2

SMALLEST_NORMAL = 2.0**-1022
HALF_ROOT_BITS = 0x3FE6A09E667F3BCD  # of sqrt(1/2)
ONE_BITS = 0x3FF0000000000000
LOGARITHM = (
    1.479819860511658591e-01,
    1.531383769920937332e-01,
    1.818357216161805012e-01,
    2.222219843214978396e-01,
    2.857142874366239149e-01,
    3.999999999940941908e-01,
    6.666666666666735130e-01,
)

ARC_HYPERBOLIC_TANGENT = tuple(2.0 / k for k in range(27, 3, -2))
TWO_THIRDS = (0.6666666666666666, 3.700743415417188e-17)


def exp(v: Vectors, x: Value) -> Value:
    """Return e**x."""
    return _scaled_exp(v, v.clamped(x, SMALLEST_EXP, LARGEST_EXP), v.number(0.0), 0)


def expm1(v: Vectors, x: Value) -> Value:
    """Return e**x - 1, accurate near zero."""
    half = _scaled_expm1(v, v.clamped(x, -50.0, LARGEST_EXP), -1)
    return _kept_where_tiny(v, x, v.add(half, half))


def sinh(v: Vectors, x: Value) -> Value:
    """Return the hyperbolic sine, (E + E / (E + 1)) / 2 with E = e**x - 1."""
    quarter = _scaled_expm1(v, v.clamped(v.absolute(x), 0.0, LARGEST_SINH), -2)
    other = v.div(quarter, v.fma(quarter, v.number(4.0), v.number(1.0)))
    size = v.mul(v.number(2.0), v.add(quarter, other))
    return _kept_where_tiny(v, x, v.intrinsic("copysign", size, x))


def cosh(v: Vectors, x: Value) -> Value:
    """Return the hyperbolic cosine, (e**x + e**-x) / 2."""
    quarter = _scaled_exp(v, v.clamped(v.absolute(x), 0.0, LARGEST_SINH), v.number(0.0), -2)
    return v.mul(v.number(2.0), v.add(quarter, v.div(v.number(0.0625), quarter)))


def tanh(v: Vectors, x: Value) -> Value:
    """Return the hyperbolic tangent, E / (E + 2) with E = e**2x - 1."""
    size = v.clamped(v.absolute(x), 0.0, 20.0)
    half = _scaled_expm1(v, v.add(size, size), -1)
    return _kept_where_tiny(v, x, v.intrinsic("copysign", v.div(half, v.add(half, v.number(1.0))), x))


def _scaled_exp(v: Vectors, x: Value, low: Value, exponent: int) -> Value:
    """2**exponent e**(x + low), |low| << |x|: the power of two is applied in two halves, lest either overflow."""
    k, r = _reduced(v, x)
    r = v.add(r, low)
    k = v.add(k, v.number(exponent))
    first = v.sub(v.fma(k, v.number(0.5), v.number(ROUND)), v.number(ROUND))
    value = v.add(v.fma(v.mul(r, r), v.polynomial(r, EXPONENTIAL), r), v.number(1.0))
    return v.mul(v.mul(value, _power_of_two(v, first)), _power_of_two(v, v.sub(k, first)))


def _scaled_expm1(v: Vectors, x: Value, exponent: int) -> Value:
    """2**exponent (e**x - 1) as 2**k (e**r - 1) + (2**k - 1)."""
    k, r = _reduced(v, x)
    power = _power_of_two(v, v.add(k, v.number(exponent)))
    value = v.fma(v.mul(r, r), v.polynomial(r, EXPONENTIAL), r)
    return v.fma(power, value, v.sub(power, v.number(2.0**exponent)))


def _reduced(v: Vectors, x: Value) -> tuple[Value, Value]:
    """K, r of x = k ln(2) + r, |r| <= ln(2) / 2."""
    k = v.sub(v.fma(x, v.number(LOG2_E), v.number(ROUND)), v.number(ROUND))
    return k, v.fma(k, v.number(-LN_2[1]), v.fma(k, v.number(-LN_2[0]), x))


def _power_of_two(v: Vectors, k: Value) -> Value:
    """2**k for integers -1023 < k < 1024, by writing the exponent."""
    return v.from_bits(v.shift_left(v.bits(v.add(k, v.number(ROUND + 1023.0))), EXPONENT_SHIFT))


def log(v: Vectors, x: Value) -> Value:
    """Return the natural logarithm."""
    k, m = _exponent_and_mantissa(v, x)
    value = _log(v, k, v.sub(m, v.number(1.0)), v.number(0.0))
    return _with_log_edges(v, x, value)


def log1p(v: Vectors, x: Value) -> Value:
    """Return log(1 + x), accurate near zero."""
    one = v.number(1.0)
    total = v.add(x, one)
    part = v.sub(total, one)
    lost = v.add(v.sub(x, part), v.sub(one, v.sub(total, part)))
    k, m = _exponent_and_mantissa(v, total)
    plain = v.compare("==", k, v.number(0.0))
    f = v.select(plain, x, v.sub(m, one))
    correction = v.select(plain, v.number(0.0), v.div(lost, total))
    return _kept_where_tiny(v, x, _with_log_edges(v, total, _log(v, k, f, correction)))


def asinh(v: Vectors, x: Value) -> Value:
    """Return the inverse hyperbolic sine."""
    size = v.absolute(x)
    root = v.intrinsic("sqrt", v.fma(size, size, v.number(1.0)))
    inside = v.add(size, v.div(v.mul(size, size), v.add(root, v.number(1.0))))
    return v.intrinsic("copysign", _log1p_or_log_twice(v, size, inside), x)


def acosh(v: Vectors, x: Value) -> Value:
    """Return the inverse hyperbolic cosine."""
    t = v.sub(x, v.number(1.0))
    inside = v.add(t, v.intrinsic("sqrt", v.mul(t, v.add(t, v.number(2.0)))))
    inside = v.select(v.compare("<", t, v.number(0.0)), v.number(math.nan), inside)
    return _log1p_or_log_twice(v, x, inside)


def atanh(v: Vectors, x: Value) -> Value:
    """Return the inverse hyperbolic tangent, log1p(2x / (1 - x)) / 2."""
    size = v.absolute(x)
    ratio = v.div(v.add(size, size), v.sub(v.number(1.0), size))
    return v.intrinsic("copysign", v.mul(v.number(0.5), log1p(v, ratio)), x)


def _log1p_or_log_twice(v: Vectors, size: Value, inside: Value) -> Value:
    """log(1 + inside), or log(2 size) where the size is so large that `inside` may overflow."""
    large = v.compare(">", size, v.number(2.0**60))
    value = log1p(v, v.select(large, size, inside))
    return v.add(value, v.select(large, v.number(LN_2[0]), v.number(0.0)))


def _exponent_and_mantissa(v: Vectors, x: Value) -> tuple[Value, Value]:
    """K, m of x = m 2**k with sqrt(1/2) <= m < sqrt(2), of positive finite numbers."""
    small = v.compare("<", x, v.number(SMALLEST_NORMAL))
    bits = v.bits(v.select(small, v.mul(x, v.number(2.0**54)), x))
    shifted = v.add_integers(bits, v.integer(ONE_BITS - HALF_ROOT_BITS))
    mantissa = v.add_integers(v.both(shifted, v.integer(MANTISSA_BITS)), v.integer(HALF_ROOT_BITS))
    # The biased exponent becomes a float by being the low bits of 2**52 + exponent.
    biased = v.from_bits(v.either(v.shift_right(shifted, EXPONENT_SHIFT), v.bits(v.number(2.0**52))))
    offset = v.select(small, v.number(2.0**52 + 1023.0 + 54.0), v.number(2.0**52 + 1023.0))
    return v.sub(biased, offset), v.from_bits(mantissa)


def _log(v: Vectors, k: Value, f: Value, correction: Value) -> Value:
    """K ln(2) + log(1 + f) + correction, for a correction far below f's last place."""
    high, low = (v.number(part) for part in LN_2_SHORT)
    s = v.div(f, v.add(f, v.number(2.0)))
    z = v.mul(s, s)
    half_square = v.mul(v.number(0.5), v.mul(f, f))
    series = v.mul(s, v.fma(z, v.polynomial(z, LOGARITHM), half_square))
    rest = v.add(series, v.fma(k, low, correction))
    return v.fma(k, high, v.add(v.sub(rest, half_square), f))


def _with_log_edges(v: Vectors, x: Value, value: Value) -> Value:
    """The logarithm where x isn't positive and finite: -infinity of 0, NaN below, x itself where infinite or NaN."""
    zero = v.number(0.0)
    value = v.select(v.compare("<", x, v.number(math.inf)), value, x)
    edge = v.select(v.compare("==", x, zero), v.number(-math.inf), v.number(math.nan))
    return v.select(v.compare("<=", x, zero), edge, value)


def power(v: Vectors, x: Value, y: Value) -> Value:
    """Return x**y as e**(y log|x|), the logarithm in two parts, with the signs and edges of C's pow."""
    one = v.number(1.0)
    size = v.absolute(x)
    high, low = _log_in_two_parts(v, size)
    factor = v.select(v.compare("==", size, one), v.number(0.0), y)
    exponent = v.mul(factor, high)
    rest = v.fma(factor, low, v.fma(factor, high, v.neg(exponent)))
    moderate = v.compare("<", v.absolute(exponent), v.number(1000.0))
    rest = v.select(moderate, rest, v.number(0.0))
    value = _scaled_exp(v, v.clamped(exponent, SMALLEST_EXP, LARGEST_EXP), rest, 0)
    value = _signed_power(v, x, y, value)
    value = v.select(v.either(v.is_nan(x), v.is_nan(y)), v.number(math.nan), value)
    certain = v.either(v.compare("==", y, v.number(0.0)), v.compare("==", x, one))
    return v.select(certain, one, value)


def _signed_power(v: Vectors, x: Value, y: Value, value: Value) -> Value:
    """Value of |x|**y with the sign that x**y has: NaN for a root of a negative number."""
    whole = v.compare("==", v.intrinsic("floor", y), y)
    half = v.mul(y, v.number(0.5))
    odd = v.both(whole, v.compare("!=", v.intrinsic("floor", half), half))
    flipped = v.select(v.both(odd, v.sign_bit(x)), v.neg(value), value)
    below = v.both(v.compare("<", x, v.number(0.0)), v.compare(">", x, v.number(-math.inf)))
    return v.select(v.both(below, v.negate(whole)), v.number(math.nan), flipped)


def _log_in_two_parts(v: Vectors, x: Value) -> tuple[Value, Value]:
    """log(x) as a sum of two numbers, good to 2**-64 of itself: 2 artanh(s), s = (m - 1) / (m + 1).

    The series' leading terms, 2s and 2/3 s**3, are carried in two parts each.
    """
    k, m = _exponent_and_mantissa(v, x)
    s, s_low = _ratio_in_two_parts(v, m)
    z = v.mul(s, s)
    z_low = v.fma(v.add(s, s), s_low, v.fma(s, s, v.neg(z)))
    tail = v.mul(z, v.polynomial(z, ARC_HYPERBOLIC_TANGENT))
    c = v.add(v.number(TWO_THIRDS[0]), tail)
    c_low = v.add(v.add(v.sub(v.number(TWO_THIRDS[0]), c), tail), v.number(TWO_THIRDS[1]))
    cube, cube_low = _product_in_two_parts(v, (s, s_low), (z, z_low))
    w, w_low = _product_in_two_parts(v, (cube, cube_low), (c, c_low))
    whole = v.mul(k, v.number(LN_2_SHORT[0]))
    double = v.add(s, s)
    first = v.add(whole, double)
    second = v.add(first, w)
    low = v.add(v.add(v.sub(whole, first), double), v.add(v.sub(first, second), w))
    small = v.fma(k, v.number(LN_2_SHORT[1]), v.fma(v.number(2.0), s_low, w_low))
    low = v.add(low, small)
    high = v.add(second, low)
    return _edges_in_two_parts(v, x, high, v.add(v.sub(second, high), low))


def _ratio_in_two_parts(v: Vectors, m: Value) -> tuple[Value, Value]:
    """(m - 1) / (m + 1), sqrt(1/2) <= m < sqrt(2), as a quotient and what the division left over."""
    one = v.number(1.0)
    f, d = v.sub(m, one), v.add(m, one)
    d_low = v.sub(m, v.sub(d, one))
    s = v.div(f, d)
    left = v.fma(v.neg(s), d_low, v.fma(v.neg(s), d, f))
    return s, v.div(left, d)


def _product_in_two_parts(v: Vectors, x: tuple[Value, Value], y: tuple[Value, Value]) -> tuple[Value, Value]:
    """Product of two sums of two parts."""
    product = v.mul(x[0], y[0])
    rest = v.fma(x[0], y[0], v.neg(product))
    return product, v.fma(x[0], y[1], v.fma(x[1], y[0], rest))


def _edges_in_two_parts(v: Vectors, x: Value, high: Value, low: Value) -> tuple[Value, Value]:
    """The logarithm of 0, infinity and NaN."""
    zero = v.number(0.0)
    finite = v.both(v.compare("<", x, v.number(math.inf)), v.compare(">", x, zero))
    edge = v.select(v.compare("==", x, zero), v.number(-math.inf), x)
    return v.select(finite, high, edge), v.select(finite, low, zero)


def erfinv(v: Vectors, x: Value) -> Value:
    """Return the inverse of the error function: a rational guess and three Newton steps, on erfc near one."""
    size = v.absolute(x)
    gap = v.sub(v.number(1.0), size)
    central = v.compare("<", size, v.number(0.7))
    y = v.select(central, _central_erfinv(v, size), _outer_erfinv(v, gap))
    for _ in range(3):
        error = v.select(central, v.sub(v.libm("erf", y), size), v.sub(gap, v.libm("erfc", y)))
        slope = v.mul(v.number(2.0 / math.sqrt(math.pi)), exp(v, v.neg(v.mul(y, y))))
        y = v.sub(y, v.div(error, slope))
    y = v.select(v.compare("==", size, v.number(1.0)), v.number(math.inf), y)
    return v.intrinsic("copysign", y, x)


def _central_erfinv(v: Vectors, x: Value) -> Value:
    """First guess for x < 0.7, good to 1e-3."""
    z = v.mul(x, x)
    above = v.polynomial(z, (-0.140543331, 0.914624893, -1.645349621, 0.886226899))
    below = v.polynomial(z, (0.012229801, -0.329097515, 1.442710462, -2.118377725, 1.0))
    return v.div(v.mul(x, above), below)


def _outer_erfinv(v: Vectors, gap: Value) -> Value:
    """First guess for 1 - x = gap <= 0.3, good to 1e-3."""
    z = v.intrinsic("sqrt", v.neg(log(v, v.mul(gap, v.number(0.5)))))
    above = v.polynomial(z, (1.641345311, 3.429567803, -1.624906493, -1.970840454))
    return v.div(above, v.polynomial(z, (1.637067800, 3.543889200, 1.0)))


def _kept_where_tiny(v: Vectors, x: Value, value: Value) -> Value:
    """X itself where it is so small that f(x) = x + O(x**2) rounds to it."""
    return v.select(v.compare("<", v.absolute(x), v.number(2.0**-54)), x, value)
