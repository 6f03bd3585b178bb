"""`Axis`: what varies from point to point of a study."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from diransac.errors import SettingsError
from diransac.study.tables import Reader, flat, is_number

__all__ = ["Axis", "Level", "level_text"]


_EXACT = 2.0**53
"""Up to here floats hold every whole number."""


@dataclass(frozen=True)
class Level:
    """One point of the axis.

    Parameters
    ----------
    text : how it is written, the same for equal values; a trial's randomness depends on it
    value : a number, or a word
    changes : dotted path into the study -> value there
    """

    text: str
    value: float | str
    changes: Mapping[str, Any]


@dataclass(frozen=True)
class Axis:
    """What varies, and its levels.

    Parameters
    ----------
    name, unit : for people
    levels : in order
    path : dotted path of what takes the level as its value; "" where a level stands for a value at each of some paths
    """

    name: str
    unit: str
    levels: tuple[Level, ...]
    path: str = ""

    @classmethod
    def from_dict(cls, table: object) -> Axis:
        """The axis of a study's table.

        It has ``path`` and a list of ``levels``; or a list of ``levels`` and ``values.<path>``, a list each; or a table
        of ``levels``, which are words, each with a table of what it changes.

        Raises SettingsError: a key is missing, unknown or holds something else.
        """
        reader = Reader(table, "axis")
        path = ""
        if reader.holds_table("levels"):
            levels = _named_levels(reader)
        elif reader.has("values"):
            levels = _levels(reader, lambda values: _changes(reader.table("values"), len(values)))
        else:
            path = reader.text("path")
            levels = _levels(reader, lambda values: [{path: _as_number(value)} for value in values])
        found = cls(reader.text("name", path or "level"), reader.text("unit", ""), levels, path)
        reader.end()
        return found

    def to_dict(self) -> dict[str, Any]:
        """The table that `from_dict` takes."""
        about = {"name": self.name, "unit": self.unit}
        values = [level.value for level in self.levels]
        if self.path:
            return {**about, "levels": values, "path": self.path}
        if all(isinstance(value, str) for value in values):
            return {**about, "levels": {level.text: dict(level.changes) for level in self.levels}}
        paths = self.levels[0].changes
        columns = {path: [level.changes[path] for level in self.levels] for path in paths}
        return {**about, "levels": values, "values": columns}

    def narrowed(self, texts: Sequence[str]) -> Axis:
        """The same axis with these levels; one that takes its level as a value may get new ones.

        Raises SettingsError: there is no such level.
        """
        known = {level.text: level for level in self.levels}
        chosen = [known.get(text) or self._level(_value_of(text), known) for text in texts]  # a word may look like 1e3
        if not chosen:
            raise SettingsError(f"no level is named; there are {', '.join(known)}")
        return replace(self, levels=tuple({level.text: level for level in chosen}.values()))

    def _level(self, value: float | str, known: Mapping[str, Level]) -> Level:
        text = level_text(_checked("a level", value))
        if text in known:
            return known[text]
        same_kind = isinstance(value, str) == isinstance(self.levels[0].value, str)
        if self.path and same_kind:
            return Level(text, value, {self.path: _as_number(value)})
        raise SettingsError(f'there is no level "{text}" of {self.name}; there are {", ".join(known)}')


def level_text(value: float | str) -> str:
    """A level as text: ``80`` for 80 and 80.0, ``1e-06`` for 0.000001."""
    if isinstance(value, str):
        return value
    short = f"{value:g}"
    return short if float(short) == value else repr(float(value))


def _as_number(value: float | str) -> float | str:
    """A whole number as such: some keys take nothing else."""
    whole = isinstance(value, float) and value.is_integer() and abs(value) < _EXACT
    return int(value) if whole else value


def _value_of(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text.strip()


def _checked(where: str, value: object) -> float | str:
    if is_number(value):
        return float(value) + 0.0  # type: ignore[arg-type]  # -0.0 is 0
    if isinstance(value, str) and value.strip() == value and value and "," not in value:
        return value
    raise SettingsError(f"{where} has {json.dumps(value, default=str):.60}; give numbers, or words without commas")


def _levels(reader: Reader, changes_of: Callable[[list[float | str]], list[dict[str, Any]]]) -> tuple[Level, ...]:
    """Levels that are a list, with the changes that belong to their values."""
    values = [_checked(reader.path("levels"), value) for value in reader.listed("levels")]
    levels = tuple(Level(level_text(v), v, change) for v, change in zip(values, changes_of(values), strict=True))
    texts = [level.text for level in levels]
    if len(set(texts)) < len(texts):
        raise SettingsError(f"axis.levels has a level twice; found {', '.join(texts)}")
    return levels


def _named_levels(reader: Reader) -> tuple[Level, ...]:
    """Levels that are a table of words, each with its own changes."""
    found, path = reader.table("levels"), reader.path("levels")
    if not found:
        raise SettingsError(f"{path} is empty; give a table, or a list, of one or more")
    for word, changes in found.items():
        _checked(path, word)
        if not isinstance(changes, Mapping):
            raise SettingsError(
                f'{path}."{word}" is {changes!r:.60}; give a table of what it changes, {{}} for nothing'
            )
    return tuple(Level(word, word, dict(flat(changes))) for word, changes in found.items())


def _changes(values: Mapping[str, Any], n_levels: int) -> list[dict[str, Any]]:
    """The changes of each level, from a list of values a path."""
    columns = dict(flat(values))
    for path, column in columns.items():
        if not isinstance(column, list | tuple) or len(column) != n_levels:
            raise SettingsError(f"axis.values.{path} is {column!r:.60}; give a list of {n_levels} values, one a level")
    if not columns:
        raise SettingsError("axis.values is empty; give a list of values, one a level, for a dotted path")
    return [{path: column[k] for path, column in columns.items()} for k in range(n_levels)]
