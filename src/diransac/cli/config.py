"""Options from a configuration file, ``--config diransac.toml``: defaults of the command line."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from diransac.errors import SettingsError
from diransac.identification.settings import nearest_names
from diransac.plain_data import toml_file

__all__ = ["config_defaults"]

Words = str | bool | list[str]


def config_defaults(file: Path, commands: Mapping[str, Any]) -> dict[str, Any]:
    """Values of a configuration file as defaults of every command's options.

    A key is an option without its dashes, for all commands that have it; in a table with the name of a command, for
    that command alone, as are its arguments: ``log``, ``model``.  A name of
    both, ``map``, is the option.  Values are texts, numbers, true or false; a list for
    what repeats or takes commas; a table for ``name=value`` pairs.

    Parameters
    ----------
    file : Path
    commands : mapping of str to command
        All commands by name; a command that is itself a group has its own as ``commands``.

    Returns
    -------
    dict of str to object
        By command, and name of the parameter.

    Raises
    ------
    SettingsError
        The file cannot be read, no command has an option of that name, or a value is of another type.
    """
    table, found = toml_file(file, "configuration"), dict[str, Any]()
    leaves = dict(_leaves(commands))
    known = {key: None for command in leaves.values() for key in _parameters(command, arguments=False)}
    shared = {key: x for key, x in table.items() if key in known or key not in commands}
    table = {key: x for key, x in table.items() if key not in shared}
    for key in shared:
        if key not in known:
            names = [*known, *commands]
            raise SettingsError(
                f'configuration "{file}": no command has an option "{key}"; {nearest_names(key, names)}'
            )
    for path, command in leaves.items():
        own = _table_of(table, path, file)
        options, everything = (_parameters(command, arguments=x) for x in (False, True))
        for key in own:
            if key not in everything:
                where = " ".join(path)
                raise SettingsError(
                    f'configuration "{file}": {where} has no option "{key}"; {nearest_names(key, list(everything))}'
                )
        place = found
        for name in path:
            place = place.setdefault(name, {})
        for key, value in ({k: x for k, x in shared.items() if k in options} | own).items():
            parameter = everything[key]
            place[parameter.name] = _words(value, parameter, f'configuration "{file}": {key}')
    return found


def _leaves(commands: Mapping[str, Any]) -> list[tuple[tuple[str, ...], Any]]:
    """Commands without further ones, by their path of names."""
    found: list[tuple[tuple[str, ...], Any]] = []
    for name, command in commands.items():
        inner = getattr(command, "commands", None)
        found += [((name, *path), x) for path, x in _leaves(inner)] if inner else [((name,), command)]
    return found


def _table_of(table: Mapping[str, Any], path: tuple[str, ...], file: Path) -> dict[str, Any]:
    """Table of a command; empty without one."""
    for name in path:
        inner = table.get(name, {})
        if not isinstance(inner, dict):
            raise SettingsError(f'configuration "{file}": {name} is {inner!r:.40}; give a table of its options')
        table = inner
    return dict(table)


def _parameters(command: Any, *, arguments: bool) -> dict[str, Any]:
    """Parameters of a command by their key: the long option, or the first word of an argument's metavar."""
    found = {}
    for parameter in command.params:
        long = [x for x in getattr(parameter, "opts", ()) if x.startswith("--")]
        if long:
            found[long[0].removeprefix("--")] = parameter
        elif arguments:
            word = re.match(r"[a-z]+", (parameter.metavar or parameter.name).lower())
            found[word[0] if word else parameter.name] = parameter
    return found


def _words(value: object, parameter: Any, where: str) -> Words:
    """A value as the command line would have it."""
    several = bool(getattr(parameter, "multiple", False)) or parameter.nargs == -1
    if getattr(parameter, "is_flag", False):
        if not isinstance(value, bool):
            raise SettingsError(f"{where} is {value!r:.40}; it is true or false")
        return value
    if isinstance(value, dict):
        items = [f"{name}={_text(x)}" for name, x in _flat(value)]
    elif isinstance(value, list):
        items = [_text(x) for x in value]
    else:
        items = [_text(value)]
    return items if several else ",".join(items)


def _flat(table: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Entries of nested tables, their names joined by dots."""
    found: list[tuple[str, Any]] = []
    for name, x in table.items():
        found += [(f"{name}.{key}", y) for key, y in _flat(x)] if isinstance(x, dict) else [(name, x)]
    return found


def _text(value: object) -> str:
    """A value as it stands in ``name=value``: numbers of a list are separated by commas."""
    if isinstance(value, list):
        return ",".join(map(_text, value))
    return json.dumps(value) if isinstance(value, bool) else str(value)
