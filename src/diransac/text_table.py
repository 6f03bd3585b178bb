"""Plain text in columns, and numbers as text: the same on a terminal, in a file, in a notebook and on a page."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from diransac.plain_text import one_line


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows of cells as lines, each column as wide as its widest cell; line breaks within cells are no lines."""
    lines = [[one_line(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines]


def telling_digits(low: float, high: float) -> int:
    """Number of significant digits in which the ends of an interval differ, at least 5."""
    size, width = max(abs(low), abs(high)), high - low
    return 5 if not 0.0 < width < size else min(12, max(5, 2 + math.ceil(math.log10(size / width))))


def number(x: float, digits: int = 4) -> str:
    """A number to significant digits: ``−1.5``, ``1.2×10⁻⁶``, ``∞``, ``–`` for NaN."""
    if math.isnan(x):
        return "–"
    if math.isinf(x):
        return "∞" if x > 0 else "−∞"
    mantissa, _, exponent = f"{x:.{digits}g}".partition("e")
    power = f"×10{superscript(int(exponent))}" if exponent else ""
    return mantissa.replace("-", "−") + power


def superscript(exponent: int | str) -> str:
    """A whole number as an exponent: ``⁻³``."""
    return str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def duration(seconds: float) -> str:
    """A time to three digits in a fitting unit: ``12 µs``, ``9.38 ms``, ``905 s``."""
    unit, size = ("µs", 1e-6) if abs(seconds) < 1e-4 else ("ms", 1e-3) if abs(seconds) < 1.0 else ("s", 1.0)
    return f"{number(seconds / size, 3)} {unit}"


def percent(fraction: float) -> str:
    """A fraction in percent to about two digits: ``0.42 %``, ``13 %``, ``< 0.01 %``."""
    x = 100.0 * fraction
    if 0.0 < abs(x) < 0.01:
        return f"{'< ' if x > 0.0 else '> −'}0.01 %"
    if 99.0 < x < 100.0:
        return f"{min(x, 99.9):.1f} %"
    rounded = f"{x:.0f}" if math.isfinite(x) and 10.0 <= abs(x) < 1e5 else number(x, 2)
    return f"{rounded.replace('-', '−')} %"


def share(x: float, whole: str) -> str:
    """A ratio to a whole: ``2 % of its range``, ``19 times its range``."""
    if math.isfinite(x) and x >= 3.0:
        return f"{number(x, 2)} times {whole}"
    return f"{percent(x)} of {whole}"


def listed(names: Sequence[str]) -> str:
    """Names in a sentence: ``x``, ``x and z``, ``x, y and z``."""
    return " and ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))


def some(names: Iterable[str], most: int = 25) -> str:
    """Names with commas, those beyond a number counted: ``x, y and 3 more``."""
    whole = list(names)
    return ", ".join(whole[:most]) + (f" and {len(whole) - most} more" if len(whole) > most else "")


def plural(count: int, noun: str) -> str:
    """A count with its noun: ``1 row``, ``2,501 rows``."""
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"
