"""Arguments of a function by name, as a table of TOML gives them: each is of its default's kind."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

from diransac.errors import SettingsError
from diransac.study.tables import Reader, is_number

__all__ = ["ANY", "given_arguments", "takes_options"]

ANY = "any"
"""The word for a value that is drawn anew for each trial."""

_VARIABLE = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


def given_arguments(
    function: Callable[..., Any], table: Mapping[str, Any], reader: Reader, drawn: str = "", *, pairs: bool = False
) -> dict[str, Any]:
    """Every argument of a function that a table may give, those that it doesn't give by their defaults.

    Parameters
    ----------
    function : whose keyword arguments; one whose default is None is no table's business
    table, reader : where they stand
    drawn : the argument that may be the word ``any``
    pairs : whether two numbers may stand for one

    Raises SettingsError: a value is not of its default's kind; it says at which key.
    """
    found = {}
    for name, parameter in inspect.signature(function).parameters.items():
        if parameter.kind in _VARIABLE or parameter.default in (None, inspect.Parameter.empty):
            continue
        default = _as_written(parameter.default)
        given = reader.has(name)
        value = table[name] if given else default
        is_word = name == drawn and value == ANY
        found[name] = _checked(reader.path(name), value, default, pairs) if given and not is_word else value
    return found


def takes_options(function: Callable[..., Any]) -> bool:
    """Whether a function takes keyword arguments that it doesn't name."""
    parameters = inspect.signature(function).parameters.values()
    return any(one.kind == inspect.Parameter.VAR_KEYWORD for one in parameters)


def _as_written(default: Any) -> Any:
    """A default as TOML would have it."""
    if isinstance(default, Mapping):
        return dict(default)
    return list(default) if isinstance(default, tuple) else default


def _checked(path: str, value: Any, default: Any, pairs: bool) -> Any:
    """The value, if it is of its default's kind.  Raises SettingsError: it isn't."""
    if isinstance(default, dict):
        fits, wanted = isinstance(value, Mapping) and all(map(is_number, value.values())), "a table of numbers"
        value = {**default, **{name: float(x) for name, x in value.items()}} if fits else value
    elif isinstance(default, list):
        fits = isinstance(value, list | tuple) and all(isinstance(x, str) for x in value)
        wanted, value = "a list of words", list(value) if fits else value
    elif isinstance(default, str):
        fits, wanted = isinstance(value, str), "a word"
    elif isinstance(default, bool):
        fits, wanted = isinstance(value, bool), "true or false"
    elif isinstance(default, int):
        fits, wanted = isinstance(value, int) and not isinstance(value, bool) and value >= 0, "a whole number from 0"
    else:
        pair = pairs and isinstance(value, list | tuple) and len(value) == 2 and all(map(is_number, value))
        fits, wanted = is_number(value) or pair, "a number"
        value = [float(x) for x in value] if pair else float(value) if is_number(value) else value
    if not fits:
        raise SettingsError(f"{path} is {value!r:.60}; give {wanted}")
    return value
