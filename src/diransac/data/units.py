"""Units of measurement: equality of units in different spellings, and factors between units.

A text such as ``m/s^2``, ``m s^-2``, ``m·s⁻²`` or ``m/s**2`` is a product of powers of named units.  It is read from
left to right (``N s/m`` is ``(N s)/m``) into a factor and powers of the SI base units.  An angle is dimensionless:
``rad`` and ``1`` are the same unit, but ``Hz`` and ``rad/s`` are not, for a factor of 2 pi may lie between them.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field

_SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
_TOKEN = re.compile(r"\s*([*/^()]|[+-]?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?|[^\W\d_]+|[°%])")
_HEADER = re.compile(r"^(?P<name>.*\S)\s*\[\s*(?P<unit>[^\[\]]*[^\W\d_°%][^\[\]]*|°|%)\s*\]$")
_IN_PARENTHESES = re.compile(r"^(?P<name>.*\S)\s*\((?P<unit>.*[^\W\d_].*|°|%)\)$")


@dataclass(frozen=True)
class _Unit:
    """``factor`` times the product of ``base ** power``."""

    factor: float = 1.0
    powers: Mapping[str, float] = field(default_factory=dict)

    def __mul__(self, other: _Unit) -> _Unit:
        names = {*self.powers, *other.powers}
        summed = {n: self.powers.get(n, 0.0) + other.powers.get(n, 0.0) for n in names}
        return _Unit(self.factor * other.factor, {n: x for n, x in summed.items() if x})

    def __pow__(self, power: float) -> _Unit:
        return _Unit(self.factor**power, {n: x * power for n, x in self.powers.items()})

    @property
    def dimension(self) -> dict[str, float]:
        """Powers of the base units that carry a dimension."""
        return {n: x for n, x in self.powers.items() if n not in ("rad", "cycle")}


def _si(text: str, factor: float = 1.0) -> _Unit:
    """``factor`` times a product such as ``kg m s-2`` of base units."""
    parts = (re.fullmatch(r"([a-zA-Z]+)(-?\d*)", part) for part in text.split())
    return _Unit(factor, {m[1]: float(m[2] or 1) for m in parts if m})


_PREFIXES = {"n": 1e-9, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "m": 1e-3, "c": 1e-2, "d": 1e-1, "k": 1e3, "M": 1e6, "G": 1e9}
_PREFIXABLE = {
    "m": _si("m"),
    "s": _si("s"),
    "g": _si("kg", 1e-3),
    "A": _si("A"),
    "K": _si("K"),
    "rad": _si("rad"),
    "Hz": _si("cycle s-1"),
    "N": _si("kg m s-2"),
    "Nm": _si("kg m2 s-2"),
    "Pa": _si("kg m-1 s-2"),
    "J": _si("kg m2 s-2"),
    "W": _si("kg m2 s-3"),
    "V": _si("kg m2 s-3 A-1"),
    "C": _si("A s"),
    "F": _si("kg-1 m-2 s4 A2"),
    "T": _si("kg s-2 A-1"),
    "H": _si("kg m2 s-2 A-2"),
    "ohm": _si("kg m2 s-3 A-2"),
    "Ω": _si("kg m2 s-3 A-2"),
}
_NAMED = {
    **dict.fromkeys(("deg", "degree", "degrees", "°"), _si("rad", math.pi / 180.0)),
    **dict.fromkeys(("rev", "turn", "turns"), _si("rad", 2.0 * math.pi)),
    "rpm": _si("rad s-1", 2.0 * math.pi / 60.0),
    "min": _si("s", 60.0),
    "h": _si("s", 3600.0),
    "sec": _si("s"),
    "radian": _si("rad"),
    "radians": _si("rad"),
    "in": _si("m", 0.0254),
    "ft": _si("m", 0.3048),
    "bar": _si("kg m-1 s-2", 1e5),
    "lbf": _si("kg m s-2", 4.4482216152605),
    "%": _Unit(0.01),
}


def split_unit(header: str) -> tuple[str, str | None]:
    """Name and unit of a column's header: ``theta [deg]`` is ``("theta", "deg")``, ``q[0]`` is ``("q[0]", None)``.

    Parentheses are read alike where they hold a known unit: ``theta (deg)``, but not ``theta (raw)``.
    """
    match = _HEADER.match(header.strip())
    if match is None:
        match = _IN_PARENTHESES.match(header.strip())
        if match is None or _parse(match["unit"]) is None:
            return header.strip(), None
    return match["name"], match["unit"].strip()


def same_unit(a: str, b: str) -> bool:
    """True for two spellings of one unit, such as ``m/s^2`` and ``m s^-2``; unknown units match literally."""
    factor = conversion(a, b)
    return factor is not None and math.isclose(factor, 1.0, rel_tol=1e-9)


@functools.lru_cache(maxsize=4096)
def conversion(a: str, b: str) -> float | None:
    """Factor from unit ``a`` to unit ``b``; None for units of different dimensions and for unknown units.

    ``g`` alone is a gram or the standard gravity, whichever fits the other unit.
    """
    if a.split() == b.split():
        return 1.0
    factors = {x for x in (_factor(p, q) for p in _meanings(a) for q in _meanings(b)) if x is not None}
    return factors.pop() if len(factors) == 1 else None


def one_turn(unit: str) -> float | None:
    """One turn in a unit of angles: 2 pi for ``rad``, 360 for ``deg``; None for other units, ``1`` among them."""
    found = _parse(unit)
    return 2.0 * math.pi / found.factor if found is not None and found.powers == {"rad": 1.0} else None


def _factor(a: _Unit, b: _Unit) -> float | None:
    """The factor between two units of one dimension."""
    if a.dimension != b.dimension or {"rad", "cycle"} <= {*a.powers, *b.powers}:
        return None
    return a.factor / b.factor


def _meanings(text: str) -> list[_Unit]:
    """Units that a text can mean; none if it cannot be read."""
    units = [] if (unit := _parse(text)) is None else [unit]
    if text.strip() == "g":
        units.append(_si("m s-2", 9.80665))
    return units


@functools.lru_cache(maxsize=4096)
def _parse(text: str) -> _Unit | None:
    """Unit of a text, or None."""
    tokens = _tokens(text.translate(_SUPERSCRIPTS))
    if tokens is None:
        return None
    try:
        unit, end = _product(tokens, 0)
    except (ValueError, OverflowError, ZeroDivisionError):
        return None
    return unit if end == len(tokens) else None


def _tokens(text: str) -> list[str] | None:
    """Tokens of a text, every sign of multiplication as ``*``; None if a part is unknown."""
    text = re.sub(r"[·×⋅.](?!\d)", "*", text.replace("**", "^")).strip()
    tokens, end = [], 0
    while end < len(text):
        match = _TOKEN.match(text, end)
        if match is None:
            return None
        tokens.append(match[1])
        end = match.end()
    return tokens


def _product(tokens: list[str], at: int) -> tuple[_Unit, int]:
    """Product of the factors that start at a token, and the index of its end."""
    unit, power = _Unit(), 1.0
    while at < len(tokens) and tokens[at] != ")":
        if tokens[at] in ("*", "/"):
            power = -1.0 if tokens[at] == "/" else 1.0
            at += 1
        factor, at = _power(tokens, at)
        unit, power = unit * factor**power, 1.0
    return unit, at


def _power(tokens: list[str], at: int) -> tuple[_Unit, int]:
    """A unit with its exponent, if it has one: ``s^2``, ``s2`` or ``s-2``."""
    unit, at = _atom(tokens, at)
    if at < len(tokens) and tokens[at] == "^":
        exponent, at = _exponent(tokens, at + 1)
        return unit**exponent, at
    if at < len(tokens) and unit.powers and re.fullmatch(r"[+-]?\d", tokens[at]):
        return unit ** float(tokens[at]), at + 1
    return unit, at


def _exponent(tokens: list[str], at: int) -> tuple[float, int]:
    bracketed = at < len(tokens) and tokens[at] == "("
    at += bracketed
    if at >= len(tokens):
        raise ValueError("an exponent is missing")
    return float(tokens[at]), at + 1 + bracketed


def _atom(tokens: list[str], at: int) -> tuple[_Unit, int]:
    """A number, a symbol or a product in brackets."""
    if at >= len(tokens):
        raise ValueError("a unit is missing")
    if tokens[at] != "(":
        return _symbol(tokens[at]), at + 1
    unit, end = _product(tokens, at + 1)
    if end >= len(tokens):
        raise ValueError("a bracket is open")
    return unit, end + 1


def _symbol(text: str) -> _Unit:
    """Unit of a symbol, whole names before prefixes, or of a positive number."""
    if text in _PREFIXABLE:
        return _PREFIXABLE[text]
    if text in _NAMED:
        return _NAMED[text]
    if text[:1] in _PREFIXES and text[1:] in _PREFIXABLE:
        return _Unit(_PREFIXES[text[0]]) * _PREFIXABLE[text[1:]]
    factor = float(text)
    if not 0.0 < factor < math.inf:
        raise ValueError("a unit is a positive number")
    return _Unit(factor)
