"""Elementary functions on vectors: stage 1, each lane through the C library."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from diransac.kernel.vectors import Value, Vectors


def sign(v: Vectors, x: Value) -> Value:
    """Return -1, 1, or x where that is zero or NaN."""
    zero = v.number(0.0)
    negative = v.select(v.compare("<", x, zero), v.number(-1.0), x)
    return v.select(v.compare(">", x, zero), v.number(1.0), negative)


def smaller(v: Vectors, x: Value, y: Value) -> Value:
    """Return the smaller operand; the other one where one is NaN."""
    return v.select(v.either(v.compare("<", x, y), v.is_nan(y)), x, y)


def larger(v: Vectors, x: Value, y: Value) -> Value:
    """Return the larger operand; the other one where one is NaN."""
    return v.select(v.either(v.compare(">", x, y), v.is_nan(y)), x, y)


def hypot(v: Vectors, x: Value, y: Value) -> Value:
    """Return sqrt(x x + y y) without overflow."""
    return v.libm("hypot", x, y)


def exp(v: Vectors, x: Value) -> Value:
    """Return exp of every lane."""
    return v.libm("exp", x)


def expm1(v: Vectors, x: Value) -> Value:
    """Return expm1 of every lane."""
    return v.libm("expm1", x)


def log(v: Vectors, x: Value) -> Value:
    """Return log of every lane."""
    return v.libm("log", x)


def log1p(v: Vectors, x: Value) -> Value:
    """Return log1p of every lane."""
    return v.libm("log1p", x)


def power(v: Vectors, x: Value, y: Value) -> Value:
    """Return power of every lane."""
    return v.libm("pow", x, y)


def sinh(v: Vectors, x: Value) -> Value:
    """Return sinh of every lane."""
    return v.libm("sinh", x)


def cosh(v: Vectors, x: Value) -> Value:
    """Return cosh of every lane."""
    return v.libm("cosh", x)


def tanh(v: Vectors, x: Value) -> Value:
    """Return tanh of every lane."""
    return v.libm("tanh", x)


def asinh(v: Vectors, x: Value) -> Value:
    """Return asinh of every lane."""
    return v.libm("asinh", x)


def acosh(v: Vectors, x: Value) -> Value:
    """Return acosh of every lane."""
    return v.libm("acosh", x)


def atanh(v: Vectors, x: Value) -> Value:
    """Return atanh of every lane."""
    return v.libm("atanh", x)


def erfinv(v: Vectors, x: Value) -> Value:
    """Return erfinv of every lane."""
    return v.libm("erf", x)


def sin(v: Vectors, x: Value) -> Value:
    """Return sin of every lane."""
    return v.libm("sin", x)


def cos(v: Vectors, x: Value) -> Value:
    """Return cos of every lane."""
    return v.libm("cos", x)


def tan(v: Vectors, x: Value) -> Value:
    """Return tan of every lane."""
    return v.libm("tan", x)


def asin(v: Vectors, x: Value) -> Value:
    """Return asin of every lane."""
    return v.libm("asin", x)


def acos(v: Vectors, x: Value) -> Value:
    """Return acos of every lane."""
    return v.libm("acos", x)


def atan(v: Vectors, x: Value) -> Value:
    """Return atan of every lane."""
    return v.libm("atan", x)


def atan2(v: Vectors, x: Value, y: Value) -> Value:
    """Return atan2 of every lane."""
    return v.libm("atan2", x, y)
