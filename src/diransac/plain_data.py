"""Text, JSON and TOML of files from anyone: bounded in size, depth and digits."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any, NoReturn

__all__ = ["LARGEST", "json_data", "read_text", "toml_table"]

LARGEST = 256 * 2**20
"""Bytes of the largest file that is read as text."""


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
        It is no JSON, nested too deeply, or has a number of thousands of digits.
    """
    try:
        return json.loads(text, parse_constant=_refused)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def _refused(word: str) -> NoReturn:
    raise ValueError(f"{word} is no number of JSON")


def toml_table(text: str) -> dict[str, Any]:
    """Table of a text in TOML.

    Raises
    ------
    ValueError
        It is no TOML, nested too deeply, or has a number of thousands of digits.
    """
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
