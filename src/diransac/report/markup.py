"""HTML that cannot be broken by what is put into it: every text is escaped that is not markup already."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable

__all__ = ["Html", "join", "number", "percent", "plural", "share", "table", "tag"]

_LEAST_PERCENT = 0.01
_TIMES = 3.0
_VOID = {"input", "link", "meta"}
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


class Html(str):
    """Markup, to be put into a page as it is."""

    __slots__ = ()


def _escaped(text: str) -> str:
    return text if isinstance(text, Html) else html.escape(_encodable(text))


def _encodable(text: str) -> str:
    """The text with what is no Unicode (an undecodable file name) replaced."""
    return text.encode(errors="replace").decode()


def join(parts: Iterable[str]) -> Html:
    """The parts one after another, those escaped that are not markup."""
    return Html("".join(_escaped(part) for part in parts))


def tag(name: str, /, *children: str, **attributes: str | float | bool | None) -> Html:
    """``<name attributes>children</name>``, everything escaped that is not markup.

    ``class_`` is ``class`` and ``data_x`` is ``data-x``; True gives a bare attribute, None and False give none.
    """
    given = [(key.rstrip("_").replace("_", "-"), value) for key, value in attributes.items()]
    text = "".join(
        f" {key}" if value is True else f' {key}="{_escaped(str(value))}"'
        for key, value in given
        if value is not None and value is not False
    )
    return Html(f"<{name}{text}>" if name in _VOID else f"<{name}{text}>{join(children)}</{name}>")


def table(header: Iterable[str], rows: Iterable[Iterable[str]], caption: str) -> Html:
    """A table whose rows begin with what they are about; on a narrow screen it scrolls by itself."""
    head = tag("tr", *(tag("th", cell, scope="col") for cell in header))
    body = [tag("tr", *_row(list(row))) for row in rows]
    inner = tag("table", tag("caption", caption), tag("thead", head), tag("tbody", *body))
    return tag("div", inner, class_="scroll")


def _row(cells: list[str]) -> list[Html]:
    return [tag("th", cells[0], scope="row"), *(tag("td", cell) for cell in cells[1:])]


def number(x: float, digits: int = 4) -> str:
    """A number to so many digits, as it is printed: ``−1.5``, ``1.2×10⁻⁶``, ``∞``, ``–`` for NaN."""
    if math.isnan(x):
        return "–"
    if math.isinf(x):
        return "∞" if x > 0 else "−∞"
    mantissa, _, exponent = f"{x:.{digits}g}".partition("e")
    power = f"×10{str(int(exponent)).translate(_SUPERSCRIPTS)}" if exponent else ""
    return mantissa.replace("-", "−") + power


def percent(fraction: float) -> str:
    """A fraction in percent to about two digits, ``0.42 %``, ``13 %``, ``< 0.01 %``."""
    x = 100.0 * fraction
    if 0.0 < abs(x) < _LEAST_PERCENT:
        return f"{'< ' if x > 0.0 else '> −'}{_LEAST_PERCENT} %"
    if 99.0 < x < 100.0:
        return f"{min(x, 99.9):.1f} %"
    rounded = f"{x:.0f}" if math.isfinite(x) and 10.0 <= abs(x) < 1e5 else number(x, 2)
    return f"{rounded.replace('-', '−')} %"


def share(x: float, whole: str) -> str:
    """A part of something in the words that suit its size: ``2 % of its range``, ``19 times its range``."""
    if math.isfinite(x) and x >= _TIMES:
        return f"{number(x, 2)} times {whole}"
    return f"{percent(x)} of {whole}"


def plural(count: int, noun: str) -> str:
    """``1 row``, ``2,501 rows``."""
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"
