"""`Axis`: the quantity that varies from level to level of a study."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self

from pydantic import Field, model_serializer, model_validator

from diransac.errors import SettingsError
from diransac.study.tables import Table, Text, flat, is_number, unknown_key


class Axis(Table):
    """The quantity that varies in a study, the table ``[axis]``.

    A file has a ``path``, whose key takes each of a list of ``levels``, or a table of ``levels`` with their changes.

    Parameters
    ----------
    name, unit : for tables and figures; the name is the path by default
    path : dotted path of the key that takes the levels, of the first form
    levels : canonical text of each level, from which seeds of trials derive -> changes by dotted path, in order
    """

    PLACE: ClassVar[str] = "axis"

    name: Text = "level"
    unit: Text = ""
    path: Text = ""
    levels: dict[str, dict[str, Any]] = Field(description="a list of one or more")

    @model_validator(mode="before")
    @classmethod
    def _by_level(cls, table: Any) -> Any:
        if not isinstance(table, Mapping) or "levels" not in table:
            return table
        levels, path = table["levels"], table.get("path")
        if isinstance(levels, Mapping):
            if "path" in table:
                raise SettingsError(unknown_key("axis", "path", ["levels", "name", "unit"]))
            return {**table, "levels": _of_words(levels)}
        if not isinstance(levels, list | tuple) or not levels:
            raise SettingsError(f"axis.levels is {levels!r:.60}; give a list of one or more")
        values = [_level_value(level) for level in levels]
        texts = [_level_text(value) for value in values]
        if len(set(texts)) < len(texts):
            raise SettingsError(f"axis.levels has a level twice; found {', '.join(texts)}")
        if not isinstance(path, str):
            found = "is missing" if path is None else f"is {path!r:.60}"
            raise SettingsError(f"axis.path {found}; give the dotted path of the key that takes the levels")
        changes = [{path: _as_whole(value)} for value in values]
        return {"name": path, **table, "levels": dict(zip(texts, changes, strict=True))}

    @model_serializer
    def _as_written(self) -> dict[str, Any]:
        own = {"path": self.path} if self.path else {}
        levels = [changes[self.path] for changes in self.levels.values()] if self.path else self.levels
        return {"name": self.name, "unit": self.unit, **own, "levels": levels}

    def subset(self, texts: Sequence[str]) -> Self:
        """The same axis at some levels; those of a path may be new.

        Raises
        ------
        SettingsError
            No level is named, or one does not exist.
        """
        if not texts:
            raise SettingsError(f"no level is named; there are {', '.join(self.levels)}")
        return self.model_copy(update={"levels": dict(map(self._level, texts))})

    def _level(self, given: str) -> tuple[str, dict[str, Any]]:
        """Text and changes of a level.  Raises SettingsError: it does not exist."""
        if given in self.levels:  # the text itself: a word may look like a number, such as 1e3
            return given, self.levels[given]
        value = _level_value(_number_or_word(given), "a level")
        text = _level_text(value)
        if text in self.levels:
            return text, self.levels[text]
        first = next(iter(self.levels.values()))
        if self.path and isinstance(value, str) == isinstance(first[self.path], str):
            return text, {self.path: _as_whole(value)}
        raise SettingsError(f'there is no level "{text}" of {self.name}; there are {", ".join(self.levels)}')


def _of_words(levels: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Changes by word.  Raises SettingsError: no level, or one that is not a word with a table."""
    if not levels:
        raise SettingsError("axis.levels is empty; give a table, or a list, of one or more")
    for word, changes in levels.items():
        _level_value(word)
        if not isinstance(changes, Mapping):
            raise SettingsError(
                f'axis.levels."{word}" is {changes!r:.60}; give a table of what it changes, {{}} for nothing'
            )
    return {word: dict(flat(changes)) for word, changes in levels.items()}


def _level_value(value: object, where: str = "axis.levels") -> float | str:
    """Number or word of a level.  Raises SettingsError: the value is neither."""
    if is_number(value):
        return float(value) + 0.0  # type: ignore[arg-type]  # -0.0 is 0
    if isinstance(value, str) and value.strip() == value and value and "," not in value:
        return value
    raise SettingsError(f"{where} has {json.dumps(value, default=str):.60}; give numbers, or words without commas")


def _level_text(value: float | str) -> str:
    """Canonical text of a level: ``80`` for 80 and 80.0, ``1e-06`` for 0.000001."""
    if isinstance(value, str):
        return value
    short = f"{value:g}"
    return short if float(short) == value else repr(float(value))


def _as_whole(value: float | str) -> float | int | str:
    """A whole number as an integer, which some keys require; every integer up to 2^53 is a float64."""
    whole = isinstance(value, float) and value.is_integer() and abs(value) < 2.0**53
    return int(value) if whole else value


def _number_or_word(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text.strip()
