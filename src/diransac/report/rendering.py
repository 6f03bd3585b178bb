"""Jinja templates of the pages."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from diransac.identification import result_files
from diransac.text_table import number, percent, plural

if TYPE_CHECKING:
    from jinja2 import Environment


@dataclass(frozen=True)
class Table:
    """A table of text; the first cell of each row is its heading."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str


Block: TypeAlias = "str | Table | list[str] | Mapping[str, Table]"
"""Paragraph or embedded figure, table, list of sentences, or tables that a reader unfolds by their names."""


@dataclass(frozen=True)
class Section:
    """A heading, empty for none, and what stands below it."""

    heading: str
    blocks: Sequence[Block]


def embedded(figure: str) -> str:
    """A figure of Matplotlib as markup, with style rules that are limited to figures."""
    from markupsafe import Markup

    return Markup(figure.replace("*{stroke-linejoin", "svg *{stroke-linejoin"))


# ---------------------------------------------------------------------- pages


@cache
def environment() -> Environment:
    """Template environment: every value is escaped, and an undefined name is an error.

    Jinja is imported here, when the first page is written.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("diransac.report")
    found = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    found.filters.update(number=number, percent=percent, plural=plural)
    return found


def write_page(path: str | Path, template: str, *, style: str = "", script: str = "", **content: Any) -> None:
    """Write a template as one self-contained page, whole or not at all.

    Parameters
    ----------
    path : file of the page
    template : name of the template
    style, script : names of a second style sheet and of the only script that a browser may run
    content : values of the template

    Raises
    ------
    ResultError
        The file cannot be written.
    """
    rules, code = _asset("page.css") + (_asset(style) if style else ""), _asset(script) if script else ""
    text = environment().get_template(template).render(style=rules, script=code, policy=_policy(code), **content)
    result_files.write(path, f"{encodable(text)}\n")


def encodable(text: str) -> str:
    """Text with every character that is not Unicode (from undecodable file names) replaced by ``?``."""
    return text.encode(errors="replace").decode()


def _asset(name: str) -> str:
    """Text of a style sheet or script beside the templates."""
    return (Path(__file__).parent / "templates" / name).read_text(encoding="utf-8")


def _policy(script: str) -> str:
    """Content security policy: inline styles and this one script; nothing is loaded.

    Pages without a script have Matplotlib's figures, whose clouds of points are images within the page.
    """
    allowed = "default-src 'none'; style-src 'unsafe-inline'"
    if not script:
        return f"{allowed}; img-src data:"
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return f"{allowed}; script-src 'sha256-{digest}'"


def script_policy(script: str) -> str:
    """Content security policy of pages with a script, by its name, for those who serve them."""
    return _policy(_asset(script))


# ---------------------------------------------------------------------- names


def numbered(names: Iterable[str]) -> list[str]:
    """Unique names: the second and later occurrences get a number."""
    found: list[str] = []
    for name in names:
        repeats = sum(other.split(" #")[0] == name for other in found)
        found.append(f"{name} #{repeats + 1}" if repeats else name)
    return found
