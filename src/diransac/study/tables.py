"""Nested tables, as TOML and JSON have them: read by name and kind, changed by dotted paths, written flat."""

from __future__ import annotations

import copy
import sys
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from diransac.errors import SettingsError

__all__ = ["Reader", "changed", "flat", "is_number"]


class Reader:
    """A table of which every key is asked for once, by its kind; `end` refuses what nobody asked for.

    Parameters
    ----------
    table : to be read
    path : where it stands, such as ``axis``; "" is the whole

    Every method raises SettingsError: the key is missing or holds something else; it names the key and what was found.
    """

    def __init__(self, table: object, path: str = "") -> None:
        if not isinstance(table, Mapping):
            raise SettingsError(f"{path or 'the study'} is {table!r:.60}; give a table")
        self._table, self._path, self._asked = table, path, dict[str, None]()

    def path(self, key: str) -> str:
        """The dotted path of a key."""
        return f"{self._path}.{key}" if self._path else key

    def has(self, key: str) -> bool:
        """Whether the key is there; it then need not be."""
        self._asked[key] = None
        return key in self._table

    def holds_table(self, key: str) -> bool:
        """Whether the key is there, and holds a table."""
        return self.has(key) and isinstance(self._table[key], Mapping)

    def text(self, key: str, default: str | None = None, choices: Collection[str] = ()) -> str:
        """Text, one of the choices if there are any."""
        value = self._value(key, default, f"one of {', '.join(choices)}" if choices else "text")
        if not isinstance(value, str) or (choices and value not in choices):
            wanted = f"there are {', '.join(choices)}" if choices else "give text"
            raise SettingsError(f"{self.path(key)} is {value!r:.60}; {wanted}")
        return value

    def whole(self, key: str, least: int, default: int | None = None) -> int:
        """A whole number, not below the least."""
        value = self._value(key, default, "a whole number")
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise SettingsError(f"{self.path(key)} is {value!r:.60}; give a whole number of at least {least}")
        return value

    def flag(self, key: str, default: bool) -> bool:
        """True or false."""
        value = self._value(key, default, "true or false")
        if not isinstance(value, bool):
            raise SettingsError(f"{self.path(key)} is {value!r:.60}; give true or false")
        return value

    def listed(self, key: str, least: int = 1) -> list[Any]:
        """A list, of not less than so many."""
        value = self._value(key, None, "a list")
        if not isinstance(value, list | tuple) or len(value) < least:
            raise SettingsError(f"{self.path(key)} is {value!r:.60}; give a list of one or more")
        return list(value)

    def table(self, key: str, *, needed: bool = True) -> Mapping[str, Any]:
        """A table, empty if it isn't there and isn't needed."""
        value = self._value(key, None if needed else {}, "a table")
        if not isinstance(value, Mapping):
            raise SettingsError(f"{self.path(key)} is {value!r:.60}; give a table")
        return value

    def end(self, unnamed: Collection[str] = ()) -> None:
        """Raises SettingsError: there is a key that nobody asked for.

        Parameters
        ----------
        unnamed : keys that people don't write, and are not told about
        """
        unknown = [key for key in self._table if key not in self._asked]
        if unknown:
            there = ", ".join(key for key in self._asked if key not in unnamed)
            where = self._path or "a study"
            raise SettingsError(f'there is no key "{self.path(unknown[0])}"; in {where} there are {there}')

    def _value(self, key: str, default: object, wanted: str) -> object:
        self._asked[key] = None
        if key not in self._table and default is None:
            found = f"there are {', '.join(self._table)}" if self._table else "there is nothing"
            where = self._path or "this study"
            raise SettingsError(
                f'the key "{self.path(key)}", which is to hold {wanted}, is missing; in {where} {found}'
            )
        return self._table.get(key, default)


def changed(table: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """A copy with other values at dotted paths; tables on the way that aren't there are made.

    Raises SettingsError: a path leads through something that is no table.
    """
    whole = copy.deepcopy(dict(table))
    for path, value in changes.items():
        *way, last = path.split(".")
        inner = whole
        for key in way:
            inner = inner.setdefault(key, {})
            if not isinstance(inner, dict):
                raise SettingsError(f'"{path}" leads nowhere: {key} is {inner!r:.60}, not a table')
        inner[last] = copy.deepcopy(value)
    return whole


def flat(table: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted path and value of everything that is no table; an empty table is a value."""
    for key, value in table.items():
        here = f"{path}.{key}" if path else str(key)
        if isinstance(value, Mapping) and value:
            yield from flat(value, here)
        else:
            yield here, value


def is_number(value: object) -> bool:
    """Whether it is a number that a float can hold, finite and not as large as 10**400; true and false are none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
