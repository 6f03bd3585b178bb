"""Angles and lengths, eight at a time: polynomials that the compiler can inline.

Each is good to a few units in the last place over the whole range of float64, and agrees with C on infinities, NaN and
the signs of zeros. Nothing is looked up, and nothing branches but the sine and cosine of arguments beyond 2**40, where
what happens depends on a lane's own argument alone.

References: Cody and Waite, Software Manual for the Elementary Functions, 1980, for the reduction of arguments, which
fused multiply-adds make exact with fewer parts. The coefficients of sine and cosine are those of Moshier's Cephes, of
the arc tangent those of Sun's fdlibm.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from diransac.simulation.compiler.vectors import Value, Vectors

ROUND = 1.5 * 2.0**52
"""Adding it rounds to an integer, which then stands in the low bits; taking it away again leaves the integer."""
ROUND_BITS = 0x4338000000000000
SIGN_BIT = -(2**63)

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
        cells = {"sin": v.cell(sine), "cos": v.cell(cosine)}
        with v.builder.if_then(v.any_lane(suspect), likely=False):
            for name, cell in cells.items():
                v.set(cell, v.call_aside(f"{name}_of_huge", _replaced_where_huge(name), x, v.get(cell)))
        return v.get(cells["sin"]), v.get(cells["cos"])

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
    """How to take the C library's value in the lanes whose argument is too large for the polynomial, if any is."""

    def emit(v: Vectors, x: Value, fast: Value) -> Value:
        size = v.absolute(x)
        huge = v.both(v.compare(">", size, v.number(MOST_QUARTERS)), v.compare("<", size, v.number(math.inf)))
        cell = v.cell(fast)
        with v.builder.if_then(v.any_lane(huge)):
            v.set(cell, v.select(huge, v.libm(name, x), fast))
        return v.get(cell)

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
    """Two lengths of the same ratio whose sum is finite and the first of which isn't zero."""
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
