"""Text from anyone, made harmless where it is shown or written: names, units, descriptions, file names, errors.

| function | place of the text |
|---|---|
| `printable` | terminal, and JSON, of which the values stay the same |
| `one_line` | part of a printed line |
| `comment` | comment of C, Python, YAML or TOML |
| `literal` | string of Python, YAML or TOML, which reads back |
| `identifier` | name of a function of C or CasADi |
| `cell` | cell of a table that may be opened as a spreadsheet |
"""

from __future__ import annotations

import keyword
import re
from collections.abc import Callable

_RESERVED = {
    *re.findall(
        r"\w+",
        "alignas alignof and and_eq asm auto bitand bitor bool break case catch char class compl concept const "
        "const_cast constexpr continue decltype default delete do double dynamic_cast else enum explicit export "
        "extern false float for friend goto hess if inline int jac long main mutable namespace new noexcept not "
        "not_eq null nullptr operator or or_eq private protected public register reinterpret_cast requires restrict "
        "return short signed sizeof static static_assert static_cast struct switch template this thread_local throw "
        "true try typedef typeid typename union unsigned using virtual void volatile wchar_t while xor xor_eq",
    ),
    *map(str.lower, keyword.kwlist),
}
"""Words of C, C++, Python and CasADi, in lower case."""


def printable(text: str) -> str:
    r"""Text without control characters, for a terminal: each is written as ``\u001b``; line breaks stay.

    Control characters are also those that reorder, hide or join what stands beside them, and halves of characters.
    The form is that of JSON.

    Examples
    --------
    >>> printable("a\x1b[2Jb\x9b\u202e")
    'a\\u001b[2Jb\\u009b\\u202e'
    """
    return "\n".join(line if line.isprintable() else _escaped(line, _in_json) for line in text.split("\n"))


def is_one_line(value: object) -> bool:
    """True for a text without line breaks."""
    return isinstance(value, str) and "\n" not in value


def one_line(text: str) -> str:
    r"""Text for a part of a printed line, which it cannot end: a line break is written as ``\u000a``.

    Examples
    --------
    >>> one_line("m" + chr(10) + "verdict: usable") == r"m\u000averdict: usable"
    True
    """
    return text.replace("\n", r"\u000a")


def comment(text: str) -> str:
    r"""One line of a comment: what could end or continue it is split or replaced by ``_``, a long text is cut.

    Examples
    --------
    >>> comment("N*m/rad ??/ 2*/ end\\")
    'N*m/rad ? ?/ 2* / end_'
    """
    if len(text) > 2000:
        text = f"{text[:2000]} ..."
    plain = text if text.isprintable() else _escaped(text, lambda _: "_")
    # Texts that continue a line of C, end its comment, or end a docstring, and what is written for them.
    for harmful, harmless in (("\\", "_"), ("??", "? ?"), ("*/", "* /"), ("/*", "/ *"), ('"""', "'''")):
        while harmful in plain:
            plain = plain.replace(harmful, harmless)
    return plain


def literal(text: str) -> str:
    r"""String in double quotes, which Python, YAML and TOML read as the text; halves of characters become U+FFFD.

    Examples
    --------
    >>> literal('5"' + chr(0x9B)) == r'"5\"\u009b"'
    True
    """
    quoted = text.replace("\\", r"\\").replace('"', r"\"")
    return f'"{quoted if quoted.isprintable() else _escaped(quoted, _in_literals)}"'


def identifier(text: str) -> str:
    """Name of ASCII letters, digits and underscores, which is no word of C, C++, Python or CasADi.

    Examples
    --------
    >>> identifier("left wheel"), identifier("9 switches!"), identifier("double"), identifier("")
    ('left_wheel', 'model_9_switches', 'model_double', 'model')
    """
    name = re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_")[:60].rstrip("_")
    if name and not name[0].isdigit() and name.lower() not in _RESERVED:
        return name
    return f"model_{name}".rstrip("_")


def cell(text: str) -> str:
    """Text of a cell that no spreadsheet takes for a formula: one that begins like a formula has a ``'`` before it.

    A longer text than spreadsheets read is cut.

    Examples
    --------
    >>> cell("=1+1"), cell("flight 1.csv")
    ("'=1+1", 'flight 1.csv')
    """
    longest = 32_766  # letters, of which one may be a ``'``; Python reads four times as many
    shown = printable(one_line(text[:longest]))[:longest]
    return f"'{shown}" if shown.lstrip().startswith(("=", "+", "-", "@")) else shown


def _escaped(text: str, form: Callable[[str], str]) -> str:
    """The text with another form of each character that is not printable."""
    return "".join(x if x.isprintable() else form(x) for x in text)


def _in_json(character: str) -> str:
    """Escape of JSON; two for a character beyond the basic plane."""
    units = character.encode("utf-16-be", "surrogatepass").hex()
    return "".join(rf"\u{units[k : k + 4]}" for k in range(0, len(units), 4))


def _in_literals(character: str) -> str:
    """Escape of Python, YAML and TOML alike."""
    code = ord(character)
    if 0xD800 <= code < 0xE000:
        return "\N{REPLACEMENT CHARACTER}"
    return rf"\u{code:04x}" if code < 0x10000 else rf"\U{code:08x}"
