"""Text, JSON and TOML of files from anyone: bounded in size, depth and digits."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

__all__ = ["LARGEST", "LARGEST_TABLE", "json_data", "read_text", "toml_table"]

LARGEST = 256 * 2**20
"""Bytes of the largest result."""

LARGEST_TABLE = 2**20
"""Bytes of the largest settings or study."""


_DEEPEST_KEY = 64
"""Dots in a key of TOML."""

_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")
"""One half of a character in JSON's escapes; only pairs of them are text."""


def read_text(path: str | Path, largest: int = LARGEST) -> str:
    """Text of a file.

    Parameters
    ----------
    path : str or Path
    largest : int, optional
        Bytes that are read at most.

    Raises
    ------
    OSError
        The file cannot be read.
    ValueError
        It is larger, or not UTF-8; the message is a part of a sentence.
    """
    with Path(path).open("rb") as file:
        content = file.read(largest + 1)
    if len(content) > largest:
        raise ValueError(f"it is larger than {largest // 2**20} MiB")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError("it is not UTF-8 text") from error


def json_data(text: str | bytes) -> Any:
    """Value of a text in JSON.

    Raises
    ------
    ValueError
        It is no JSON, nested too deeply, or has a number of thousands of digits or half a character.
    """
    with _bounded():
        found = json.loads(text, parse_constant=_refused)
        if _SURROGATE.search(text if isinstance(text, str) else text.decode("latin-1")):
            _check_encodable(found)
        return found


def _check_encodable(value: object) -> None:
    """Raises ValueError: a text cannot be written in UTF-8."""
    try:
        json.dumps(value, ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        raise ValueError("a text has half a character") from error


def _refused(word: str) -> NoReturn:
    raise ValueError(f"{word} is no number of JSON")


def toml_table(text: str) -> dict[str, Any]:
    """Table of a text in TOML.

    Raises
    ------
    ValueError
        It is no TOML, nested too deeply, or has a number of thousands of digits.
    """
    import tomllib

    keys = (line.partition("=")[0] for line in text.splitlines())
    if any(key.count(".") > _DEEPEST_KEY and "," not in key for key in keys):  # tomllib takes their number squared
        raise ValueError("it is nested too deeply")
    with _bounded():
        return tomllib.loads(text)


@contextmanager
def _bounded() -> Iterator[None]:
    """Context of a parser.  Raises ValueError: in place of errors that name the interpreter's limits."""
    try:
        yield
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    except ValueError as error:
        if "integer string conversion" in str(error):
            raise ValueError("a number has thousands of digits") from error
        raise
