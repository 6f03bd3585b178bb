"""Arguments of a function by name, as a table of TOML gives them: each is of its default's kind."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

from diransac.errors import SettingsError
from diransac.study.tables import Reader, is_number

__all__ = ["ANY", "check_signature", "given_arguments", "takes_options"]

ANY = "any"
"""The word for a value that is drawn anew for each trial."""

_VARIABLE = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
_WHOLE = (int, "int")
"""An annotation of arguments that are counts; ``bump=0`` alone may well mean 0.0."""


def check_signature(function: Callable[..., Any], name: str) -> None:
    """Refuse a user's function whose arguments `given_arguments` cannot give.

    Raises SettingsError: an argument has no default, or one that TOML could not write; or nobody can tell which it has.
    """
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError) as error:
        raise SettingsError(f'"{name}" does not tell which arguments it takes; wrap it in a function') from error
    parameters = [one for one in signature.parameters.values() if one.kind not in _VARIABLE]
    needed = [one.name for one in parameters if one.default is one.empty]
    if needed:
        raise SettingsError(f'"{name}" needs {", ".join(needed)}; give every argument a default')
    for one in parameters:
        if not _is_writable(one.default):
            raise SettingsError(
                f'"{name}" has {one.name} = {one.default!r:.60} ({type(one.default).__name__}); give a default that '
                "TOML can write: a number, a word, true or false, a tuple of either, a dict of numbers, or None"
            )


def _is_writable(default: object) -> bool:
    """Whether a default is of a kind that a table can hold; None is no table's business."""
    if isinstance(default, Mapping):
        return all(isinstance(name, str) and is_number(value) for name, value in default.items())
    if isinstance(default, list | tuple):
        return _are_numbers(default) or _are_words(default)
    return default is None or isinstance(default, str | bool) or is_number(default)


def _are_numbers(values: object) -> bool:
    return isinstance(values, list | tuple) and all(map(is_number, values))


def _are_words(values: object) -> bool:
    return isinstance(values, list | tuple) and all(isinstance(one, str) for one in values)


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
        if parameter.kind in _VARIABLE or parameter.default is None or parameter.default is parameter.empty:
            continue
        default = _as_written(parameter.default)
        given = reader.has(name)
        value = table[name] if given else default
        if given and not (name == drawn and value == ANY):
            whole = parameter.annotation in _WHOLE
            value = _checked(reader.path(name), value, default, pairs=pairs, whole=whole)
        found[name] = value
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


def _checked(path: str, value: Any, default: Any, *, pairs: bool, whole: bool) -> Any:
    """The value, if it is of its default's kind.  Raises SettingsError: it isn't."""
    if isinstance(default, dict):
        fits, wanted = isinstance(value, Mapping) and _are_numbers(list(value.values())), "a table of numbers"
        value = {**default, **{name: float(x) for name, x in value.items()}} if fits else value
    elif isinstance(default, list) and default and _are_numbers(default):
        fits, wanted = _are_numbers(value), "a list of numbers"
    elif isinstance(default, list):
        fits, wanted = _are_words(value), "a list of words"
    elif isinstance(default, str):
        fits, wanted = isinstance(value, str), "a word"
    elif isinstance(default, bool):
        fits, wanted = isinstance(value, bool), "true or false"
    elif whole:
        fits, wanted = isinstance(value, int) and not isinstance(value, bool) and value >= 0, "a whole number from 0"
    else:
        fits, wanted = is_number(value) or (pairs and _are_numbers(value) and len(value) == 2), "a number"
    if not fits:
        raise SettingsError(f"{path} is {value!r:.60}; give {wanted}")
    return _as_kept(value, default)


def _as_kept(value: Any, default: Any) -> Any:
    """A tuple as a list, and 2 as 2.0, unless the default shows that whole numbers stay whole."""
    if isinstance(value, list | tuple):
        like = default[0] if isinstance(default, list) and default else default
        return [_as_kept(one, like) for one in value]
    return value if isinstance(default, int) or not is_number(value) else float(value)
