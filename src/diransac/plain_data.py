"""Text, JSON and TOML of files from anyone, bounded in size, depth and digits; and JSON for programs."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from diransac.errors import SettingsError
from diransac.limits import LARGEST_RESULT, LARGEST_TABLE, beyond, read_bytes
from diransac.plain_text import literal


def read_text(path: str | Path, largest: int = LARGEST_RESULT) -> str:
    """Text of a file.

    Parameters
    ----------
    path : str or Path
    largest : int, optional
        Bytes that are read at most.

    Raises
    ------
    OSError
        The file cannot be read, or is not an ordinary one.
    ValueError
        It is larger, or not UTF-8; the message is a part of a sentence.
    """
    try:
        return read_bytes(path, largest).decode("utf-8-sig")
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
        _check_depth(found)
        # One half of a character in JSON's escapes; only pairs of them are text.
        if re.search(r"\\u[dD][89a-fA-F]", text if isinstance(text, str) else text.decode("latin-1")):
            _check_encodable(found)
        return found


def json_text(data: object, indent: int | None = None) -> str:
    """Data as JSON, on one line without an indent; numbers that are not finite are null."""
    return json.dumps(_finite(data), indent=indent, ensure_ascii=False, allow_nan=False)


def _finite(data: object) -> object:
    if isinstance(data, float):
        return data if math.isfinite(data) else None
    if isinstance(data, Mapping):
        return {str(key): _finite(value) for key, value in data.items()}
    return [_finite(value) for value in data] if isinstance(data, list | tuple) else data


def _check_depth(found: object) -> None:
    """Raises ValueError: lists and mappings are nested so deeply that what walks over them may not."""
    level: list[Any] = [found]
    depth, most = 0, 100
    while level:
        if (depth := depth + 1) > most:
            raise ValueError(f"it is nested too deeply: it has {beyond(most, 'levels')}")
        inner = (x.values() if type(x) is dict else x for x in level if type(x) in (dict, list))
        level = [y for x in inner for y in x if type(y) in (dict, list)]


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
    # Dots in a key of TOML.
    if any(key.count(".") > 64 and "," not in key for key in keys):  # tomllib takes their number squared
        raise ValueError("it is nested too deeply")
    with _bounded():
        found = tomllib.loads(text)
    _check_depth(found)
    return found


def toml_text(value: object) -> str:
    """A text, a number, a flag or a list of them in TOML."""
    if isinstance(value, list):
        return f"[{', '.join(map(toml_text, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    return literal(value) if isinstance(value, str) else repr(value)


def toml_file(path: Path, what: str) -> dict[str, Any]:
    """Table of a TOML file.  Raises SettingsError: it cannot be read, or is none; ``what`` begins the sentence."""
    try:
        return toml_table(read_text(path, LARGEST_TABLE))
    except OSError as error:
        raise SettingsError(f'{what} "{path}" cannot be read: {error.strerror}') from error
    except ValueError as error:
        raise SettingsError(f'{what} "{path}" is not TOML: {error}') from error


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
