"""`Axis`: the quantity that varies from level to level of a study."""

from __future__ import annotations

import json
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Self

from pydantic import AfterValidator, BeforeValidator, Field, PlainValidator, SerializeAsAny, model_validator

from diransac.errors import SettingsError
from diransac.study.tables import Table, Text, flat, is_number

__all__ = ["AnyAxis", "Axis", "Level", "level_text"]


@dataclass(frozen=True)
class Level:
    """One level of an axis.

    Parameters
    ----------
    text : canonical text, the same for equal values; seeds of trials derive from it
    value : a number or a word
    changes : dotted path in the study -> value at this level
    """

    text: str
    value: float | str
    changes: Mapping[str, Any]


def level_text(value: float | str) -> str:
    """Canonical text of a level: ``80`` for 80 and 80.0, ``1e-06`` for 0.000001."""
    if isinstance(value, str):
        return value
    short = f"{value:g}"
    return short if float(short) == value else repr(float(value))


class Axis(Table):
    """The quantity that varies in a study, the table ``[axis]``: `PathAxis`, `ColumnAxis` or `WordAxis`.

    Each has a ``name`` and a ``unit`` for tables and figures.
    """

    PLACE: ClassVar[str] = "axis"

    name: Text = "level"
    unit: Text = ""

    @property
    @abstractmethod
    def levels(self) -> tuple[Level, ...]:
        """Levels in the order of the file."""

    @abstractmethod
    def _with(self, levels: Sequence[Level]) -> Self:
        """The same axis with other levels."""

    def subset(self, texts: Sequence[str]) -> Self:
        """The same axis at some levels; those of a `PathAxis` may be new.

        Raises
        ------
        SettingsError
            No level is named, or one does not exist.
        """
        known = {level.text: level for level in self.levels}
        if not texts:
            raise SettingsError(f"no level is named; there are {', '.join(known)}")
        # The text itself is looked up first: a word may look like a number, such as 1e3.
        chosen = [known.get(text) or self._level(_number_or_word(text), known) for text in texts]
        return self._with(list({level.text: level for level in chosen}.values()))

    def _level(self, value: float | str, known: Mapping[str, Level]) -> Level:
        """The level of a value.  Raises SettingsError: it does not exist."""
        text = level_text(_level_value(value, "a level"))
        if text not in known:
            raise SettingsError(f'there is no level "{text}" of {self.name}; there are {", ".join(known)}')
        return known[text]


def _level_value(value: object, where: str = "axis.levels") -> float | str:
    """Number or word of a level.  Raises SettingsError: the value is neither."""
    if is_number(value):
        return float(value) + 0.0  # type: ignore[arg-type]  # -0.0 is 0
    if isinstance(value, str) and value.strip() == value and value and "," not in value:
        return value
    raise SettingsError(f"{where} has {json.dumps(value, default=str):.60}; give numbers, or words without commas")


def _different(values: tuple[float | str, ...]) -> tuple[float | str, ...]:
    texts = [level_text(value) for value in values]
    if len(set(texts)) < len(texts):
        raise SettingsError(f"axis.levels has a level twice; found {', '.join(texts)}")
    return values


_Values = Annotated[
    tuple[Annotated[float | str, PlainValidator(_level_value)], ...],
    AfterValidator(_different),
    Field(alias="levels", min_length=1, description="a list of one or more"),
]


class PathAxis(Axis):
    """One key of the study takes the levels as its values.

    Parameters
    ----------
    path : dotted path of the key
    levels : numbers or words
    name : the path by default
    unit : of the levels
    """

    path: Text
    level_values: _Values

    @model_validator(mode="before")
    @classmethod
    def _named(cls, table: Any) -> Any:
        has_path = isinstance(table, Mapping) and isinstance(table.get("path"), str)
        return {"name": table["path"], **table} if has_path else table

    @property
    def levels(self) -> tuple[Level, ...]:
        """Levels in the order of the file."""
        return tuple(map(self._at, self.level_values))

    def _at(self, value: float | str) -> Level:
        """The level of a value; a whole number changes its key to an integer, which some keys require."""
        # Every integer up to this one is a float64.
        whole = isinstance(value, float) and value.is_integer() and abs(value) < 2.0**53
        return Level(level_text(value), value, {self.path: int(value) if whole else value})

    def _with(self, levels: Sequence[Level]) -> Self:
        return self.model_copy(update={"level_values": tuple(level.value for level in levels)})

    def _level(self, value: float | str, known: Mapping[str, Level]) -> Level:
        of_one_kind = isinstance(value, str) == isinstance(self.level_values[0], str)
        new = of_one_kind and level_text(_level_value(value, "a level")) not in known
        return self._at(value) if new else super()._level(value, known)


class ColumnAxis(Axis):
    """Several keys of the study vary together.

    Parameters
    ----------
    levels : numbers or words
    values : dotted path of each key -> list of its values, one per level
    name, unit : of the levels
    """

    level_values: _Values
    columns: dict[str, Any] = Field(alias="values", description="a table")

    @model_validator(mode="after")
    def _columns_match(self) -> Self:
        n_levels, columns = len(self.level_values), dict(flat(self.columns))
        for path, column in columns.items():
            if not isinstance(column, list | tuple) or len(column) != n_levels:
                raise SettingsError(
                    f"axis.values.{path} is {column!r:.60}; give a list of {n_levels} values, one per level"
                )
        if not columns:
            raise SettingsError("axis.values is empty; give a list of values, one per level, for a dotted path")
        return self

    @property
    def levels(self) -> tuple[Level, ...]:
        """Levels in the order of the file."""
        columns = dict(flat(self.columns))
        rows = [{path: column[k] for path, column in columns.items()} for k in range(len(self.level_values))]
        return tuple(Level(level_text(x), x, changes) for x, changes in zip(self.level_values, rows, strict=True))

    def _with(self, levels: Sequence[Level]) -> Self:
        columns = {path: [level.changes[path] for level in levels] for path in dict(flat(self.columns))}
        return self.model_copy(update={"level_values": tuple(level.value for level in levels), "columns": columns})


def _each_a_table(levels: object) -> object:
    """Raises SettingsError: no level, or one that is not a word with a table."""
    if not isinstance(levels, Mapping):
        return levels
    if not levels:
        raise SettingsError("axis.levels is empty; give a table, or a list, of one or more")
    for word, changes in levels.items():
        _level_value(word)
        if not isinstance(changes, Mapping):
            raise SettingsError(
                f'axis.levels."{word}" is {changes!r:.60}; give a table of what it changes, {{}} for nothing'
            )
    return {word: dict(flat(changes)) for word, changes in levels.items()}


class WordAxis(Axis):
    """Each level is a word with a table of what it changes.

    Parameters
    ----------
    levels : word -> changes, nested or by dotted path
    name, unit : of the levels
    """

    tables: Annotated[dict[str, dict[str, Any]], BeforeValidator(_each_a_table)] = Field(
        alias="levels", description="a table"
    )

    @property
    def levels(self) -> tuple[Level, ...]:
        """Levels in the order of the file."""
        return tuple(Level(word, word, changes) for word, changes in self.tables.items())

    def _with(self, levels: Sequence[Level]) -> Self:
        return self.model_copy(update={"tables": {level.text: dict(level.changes) for level in levels}})


def _of_its_form(table: object) -> Axis:
    """The axis of a table, in the form that its keys have."""
    if isinstance(table, Axis):
        return table
    keys = table if isinstance(table, Mapping) else {}
    form = WordAxis if isinstance(keys.get("levels"), Mapping) else ColumnAxis if "values" in keys else PathAxis
    return form.model_validate(table)


AnyAxis = Annotated[SerializeAsAny[Axis], BeforeValidator(_of_its_form), Field(description="a table")]
"""Type of a field that holds any of the three forms."""


def _number_or_word(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text.strip()
