"""Elementary functions of eight numbers at a time: angles, lengths, exponentials, logarithms and powers.

Each is a polynomial that the compiler can inline, good to a few units in the last place over the whole range of
float64, and agrees with C on infinities, NaN and the signs of zeros. There are no tables, and no branches except in the
sine and cosine of arguments beyond 2**40, where the result still depends on a lane's own argument alone.

References
----------
W. J. Cody and W. Waite, Software Manual for the Elementary Functions, 1980, for the reduction of arguments, which fused
multiply-adds make exact with fewer parts. The coefficients of sine and cosine are those of Moshier's Cephes, of the arc
tangent and the logarithm those of Sun's fdlibm.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from diransac.simulation.compiler.vectors import Value, Vectors

ROUND = 1.5 * 2.0**52
"""Adding it rounds to an integer, which then stands in the low bits; subtracting it leaves the integer."""
ROUND_BITS = 0x4338000000000000
SIGN_BIT = -(2**63)
EXPONENT_SHIFT = 52
MANTISSA_BITS = 2**52 - 1

HALF_PI = (1.5707963267948966, 6.123233995736765e-17, 1.082856673921914e-32)  # all positive: sin(-0) is -0
MOST_QUARTERS = 2.0**40
SINE = (
    1.58962301576546568060e-10,
    -2.50507477628578072866e-8,
    2.75573136213857245213e-6,
    -1.98412698295895385996e-4,
    8.33333333332211858878e-3,
    -1.66666666666666307295e-1,
    1.0,
)
COSINE = (
    -1.13585365213876817300e-11,
    2.08757008419747316778e-9,
    -2.75573141792967388112e-7,
    2.48015872888517045348e-5,
    -1.38888888888730564116e-3,
    4.16666666666665929218e-2,
    -0.5,
    1.0,
)

QUARTER_PI = (0.7853981633974483, 3.061616997868383e-17)
TAN_EIGHTH_PI = 0.41421356237309503
ARC_TANGENT = (
    1.62858201153657823623e-02,
    -3.65315727442169155270e-02,
    4.97687799461593236017e-02,
    -5.83357013379057348645e-02,
    6.66107313738753120669e-02,
    -7.69187620504482999495e-02,
    9.09088713343650656196e-02,
    -1.11111104054623557880e-01,
    1.42857142725034663711e-01,
    -1.99999999998764832476e-01,
    3.33333333333329318027e-01,
)

LOG2_E = 1.4426950408889634
LN_2 = (0.6931471805599453, 2.3190468138462996e-17)
LN_2_SHORT = (6.93147180369123816490e-01, 1.90821492927058770002e-10)  # the first has 21 zero bits at its end
SMALLEST_EXP, LARGEST_EXP = -746.0, 710.0
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


# Angles and lengths --------------------------------------------------------------------------------------------------
def sin(v: Vectors, x: Value) -> Value:
    """Return the sine; cos of the same argument shares its work."""
    return _sin_cos(v, x)[0]


def cos(v: Vectors, x: Value) -> Value:
    """Return the cosine; sin of the same argument shares its work."""
    return _sin_cos(v, x)[1]


def tan(v: Vectors, x: Value) -> Value:
    """Return the tangent."""
    return v.div(*_sin_cos(v, x))


def _sin_cos(v: Vectors, x: Value) -> tuple[Value, Value]:
    """Sine and cosine, the C library's where an argument is huge."""

    def emit() -> tuple[Value, Value]:
        sine, cosine, suspect = _fast_sin_cos(v, x)
        variables = {"sin": v.variable(sine), "cos": v.variable(cosine)}
        with v.builder.if_then(v.any_lane(suspect), likely=False):
            for name, variable in variables.items():
                v.set(variable, v.call_aside(f"{name}_of_huge", _replaced_where_huge(name), x, v.get(variable)))
        return v.get(variables["sin"]), v.get(variables["cos"])

    pair: tuple[Value, Value] = v.once("sin_cos", x, emit)
    return pair


def _fast_sin_cos(v: Vectors, x: Value) -> tuple[Value, Value, Value]:
    """Sine and cosine by polynomials on the nearest quarter turn, and where they may be wrong: k >= 2**40, NaN.

    x = k pi/2 + r, |r| <= pi/4. The first product is exact, so r is good to its last place but one even where x is all
    but a multiple of pi/2.
    """
    rounded = v.fma(x, v.number(2.0 / math.pi), v.number(ROUND + MOST_QUARTERS))
    k = v.sub(rounded, v.number(ROUND + MOST_QUARTERS))
    r = x
    for part in HALF_PI:
        r = v.fma(k, v.number(-part), r)
    z = v.mul(r, r)
    sine = v.mul(r, v.polynomial(z, SINE))
    cosine = v.polynomial(z, COSINE)
    quarters = v.bits(rounded)
    after = v.add_integers(quarters, v.integer(1 - ROUND_BITS))  # k + 1 + 2**40, and a number below 2**42 if k is fit
    odd = v.lowest_bit(quarters)
    return (
        _flipped(v, v.select(odd, cosine, sine), quarters),
        _flipped(v, v.select(odd, sine, cosine), after),
        v.has_bits(after, -(2**42)),
    )


def _replaced_where_huge(name: str) -> Callable[[Vectors, Value, Value], Value]:
    """Emitter of the C library's value in the lanes whose argument is too large for the polynomial, if any is."""

    def emit(v: Vectors, x: Value, fast: Value) -> Value:
        size = v.absolute(x)
        huge = v.both(v.compare(">", size, v.number(MOST_QUARTERS)), v.compare("<", size, v.number(math.inf)))
        variable = v.variable(fast)
        with v.builder.if_then(v.any_lane(huge)):
            v.set(variable, v.select(huge, v.libm(name, x), fast))
        return v.get(variable)

    return emit


def _flipped(v: Vectors, x: Value, quarters: Value) -> Value:
    """Change the sign where bit 1 of the number of quarter turns is set."""
    return v.from_bits(v.exclusive_or(v.bits(x), v.both(v.shift_left(quarters, 62), v.integer(SIGN_BIT))))


def asin(v: Vectors, x: Value) -> Value:
    """Return the arc sine."""
    return atan2(v, x, _other_leg(v, x))


def acos(v: Vectors, x: Value) -> Value:
    """Return the arc cosine."""
    return atan2(v, _other_leg(v, x), x)


def _other_leg(v: Vectors, x: Value) -> Value:
    """sqrt(1 - x x), without cancellation."""
    one = v.number(1.0)
    return v.intrinsic("sqrt", v.mul(v.sub(one, x), v.add(one, x)))


def atan(v: Vectors, x: Value) -> Value:
    """Return the arc tangent."""
    return atan2(v, x, v.number(1.0))


def atan2(v: Vectors, y: Value, x: Value) -> Value:
    """Return the angle of (x, y), by the arc tangent of |t| <= tan(pi/8) added to or taken from eighths of a turn."""
    ax, ay = v.absolute(x), v.absolute(y)
    steep = v.compare(">", ay, ax)
    long, short = _safe_ratio(v, v.select(steep, ay, ax), v.select(steep, ax, ay))
    wide = v.compare(">", short, v.mul(long, v.number(TAN_EIGHTH_PI)))
    t = v.div(v.select(wide, v.sub(short, long), short), v.select(wide, v.add(short, long), long))
    z = v.mul(t, t)
    angle = v.fma(v.neg(t), v.mul(z, v.polynomial(z, ARC_TANGENT)), t)
    eighths = v.select(wide, v.number(1.0), v.number(0.0))
    behind = v.sign_bit(x)
    for turned, total in ((steep, 2.0), (behind, 4.0)):
        eighths = v.select(turned, v.sub(v.number(total), eighths), eighths)
        angle = v.select(turned, v.neg(angle), angle)
    high, low = (v.number(part) for part in QUARTER_PI)
    result = v.intrinsic("copysign", v.fma(eighths, high, v.fma(eighths, low, angle)), y)
    return v.select(v.either(v.is_nan(x), v.is_nan(y)), v.add(x, y), result)


def _safe_ratio(v: Vectors, long: Value, short: Value) -> tuple[Value, Value]:
    """Two lengths of the same ratio whose sum is finite and the first of which is not zero."""
    one, zero, infinity = v.number(1.0), v.number(0.0), v.number(math.inf)
    scale = v.select(v.compare(">", long, v.number(2.0**1000)), v.number(2.0**-60), one)
    endless = v.compare("==", long, infinity)
    corner = v.select(v.compare("==", short, infinity), one, zero)
    short = v.select(endless, corner, v.mul(short, scale))
    long = v.select(v.either(endless, v.compare("==", long, zero)), one, v.mul(long, scale))
    return long, short


def hypot(v: Vectors, x: Value, y: Value) -> Value:
    """Return sqrt(x x + y y) without over- or underflow; infinite if either is."""
    ax, ay = v.absolute(x), v.absolute(y)
    largest = v.larger(ax, ay)
    scale = v.select(v.compare(">", largest, v.number(2.0**500)), v.number(2.0**-600), v.number(1.0))
    scale = v.select(v.compare("<", largest, v.number(2.0**-400)), v.number(2.0**600), scale)
    a, b = v.mul(ax, scale), v.mul(ay, scale)
    length = v.div(v.intrinsic("sqrt", v.fma(a, a, v.mul(b, b))), scale)
    return v.select(v.compare("==", largest, v.number(math.inf)), largest, length)


# Exponentials --------------------------------------------------------------------------------------------------------
def exp(v: Vectors, x: Value) -> Value:
    """Return e**x."""
    return _scaled_exp(v, v.clamped(x, SMALLEST_EXP, LARGEST_EXP), v.number(0.0), 0)


def expm1(v: Vectors, x: Value) -> Value:
    """Return e**x - 1, accurate near zero."""
    half = _scaled_expm1(v, v.clamped(x, -50.0, LARGEST_EXP), -1)
    return _identity_where_tiny(v, x, v.add(half, half))


def tanh(v: Vectors, x: Value) -> Value:
    """Return the hyperbolic tangent, E / (E + 2) with E = e**2x - 1."""
    size = v.clamped(v.absolute(x), 0.0, 20.0)
    half = _scaled_expm1(v, v.add(size, size), -1)
    return _identity_where_tiny(v, x, v.intrinsic("copysign", v.div(half, v.add(half, v.number(1.0))), x))


def _scaled_exp(v: Vectors, x: Value, low: Value, exponent: int) -> Value:
    """2**exponent e**(x + low), |low| << |x|: the power of two is applied in two halves, so that neither overflows."""
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
    """The pair (k, r) of x = k ln(2) + r, |r| <= ln(2) / 2."""
    k = v.sub(v.fma(x, v.number(LOG2_E), v.number(ROUND)), v.number(ROUND))
    return k, v.fma(k, v.number(-LN_2[1]), v.fma(k, v.number(-LN_2[0]), x))


def _power_of_two(v: Vectors, k: Value) -> Value:
    """2**k for integers -1023 < k < 1024, by writing the exponent."""
    return v.from_bits(v.shift_left(v.bits(v.add(k, v.number(ROUND + 1023.0))), EXPONENT_SHIFT))


def _identity_where_tiny(v: Vectors, x: Value, value: Value) -> Value:
    """The argument itself where it is so small that f(x) = x + O(x**2) rounds to it."""
    return v.select(v.compare("<", v.absolute(x), v.number(2.0**-54)), x, value)


# Logarithms ----------------------------------------------------------------------------------------------------------
def log(v: Vectors, x: Value) -> Value:
    """Return the natural logarithm."""
    k, m = _exponent_and_mantissa(v, x)
    value = _log(v, k, v.sub(m, v.number(1.0)), v.number(0.0))
    return _with_log_edges(v, x, value)


def _exponent_and_mantissa(v: Vectors, x: Value) -> tuple[Value, Value]:
    """The pair (k, m) of x = m 2**k with sqrt(1/2) <= m < sqrt(2), of positive finite numbers."""
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
    """The logarithm where x is not positive and finite: -infinity of 0, NaN below, x itself where infinite or NaN."""
    zero = v.number(0.0)
    value = v.select(v.compare("<", x, v.number(math.inf)), value, x)
    edge = v.select(v.compare("==", x, zero), v.number(-math.inf), v.number(math.nan))
    return v.select(v.compare("<=", x, zero), edge, value)


# Powers --------------------------------------------------------------------------------------------------------------
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
    """(m - 1) / (m + 1), sqrt(1/2) <= m < sqrt(2), as a quotient and the remainder of the division over m + 1."""
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


# Inverse error function ----------------------------------------------------------------------------------------------
def erfinv(v: Vectors, x: Value) -> Value:
    """Return the inverse of the error function: Winitzki's guess and four Newton steps, on erfc near one."""
    size, one = v.absolute(x), v.number(1.0)
    gap, central = v.sub(one, size), v.compare("<", size, v.number(0.7))
    logarithm = log(v, v.mul(gap, v.add(one, size)))
    t = v.fma(logarithm, v.number(0.5), v.number(2.0 / (math.pi * 0.147)))
    root = v.intrinsic("sqrt", v.fma(t, t, v.mul(logarithm, v.number(-1.0 / 0.147))))
    y = v.intrinsic("sqrt", v.sub(root, t))
    for _ in range(4):
        error = v.select(central, v.sub(v.libm("erf", y), size), v.sub(gap, v.libm("erfc", y)))
        slope = v.mul(v.number(2.0 / math.sqrt(math.pi)), exp(v, v.neg(v.mul(y, y))))
        y = v.sub(y, v.div(error, slope))
    y = v.select(v.compare("==", size, one), v.number(math.inf), y)
    return v.intrinsic("copysign", y, x)
