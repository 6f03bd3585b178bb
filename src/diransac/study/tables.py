"""Tables of a study file: their base class, the arguments of functions among them, and changes by dotted path.

Each table is a pydantic model, declared once; `Table` turns a validation error into one `SettingsError` sentence.
"""

from __future__ import annotations

import copy
import inspect
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    ModelWrapValidatorHandler,
    SerializerFunctionWrapHandler,
    StrictBool,
    StrictInt,
    StrictStr,
    ValidationError,
    ValidationInfo,
    model_serializer,
    model_validator,
)
from pydantic_core import CoreSchema, ErrorDetails, core_schema

from diransac.errors import DiransacError, SettingsError
from diransac.limits import MOST_COUNTED

RANDOM = "random"
"""Value of an argument that is drawn anew for each trial."""

# The description of a type is what its error message asks for.
Text = Annotated[StrictStr, Field(description="text")]
Flag = Annotated[StrictBool, Field(description="true or false")]
Whole = Annotated[StrictInt, Field(ge=0, description="a whole number of at least 0")]
Count = Annotated[StrictInt, Field(ge=1, le=MOST_COUNTED, description=f"a whole number from 1 to {MOST_COUNTED:,}")]


class Table(BaseModel):
    """Base of a study's tables: immutable, without conversion of kinds, unknown keys refused.

    Raises
    ------
    SettingsError
        A key is missing, unknown or holds something else. The message names the key, what it holds and what is valid.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    PLACE: ClassVar[str] = ""
    """Dotted path of the table in a study; the validation context may give another as ``place``."""

    @model_validator(mode="wrap")
    @classmethod
    def _in_one_sentence(cls, table: Any, check: ModelWrapValidatorHandler[Self], info: ValidationInfo) -> Self:
        place = (info.context or {}).get("place", cls.PLACE)
        if not isinstance(table, Mapping | cls):
            raise SettingsError(f"{place or 'the study'} is {table!r:.60}; give a table")
        try:
            return check(table)
        except ValidationError as error:
            raise SettingsError(cls._sentence(error.errors()[0], table, place)) from error

    @classmethod
    def _sentence(cls, error: ErrorDetails, table: Any, place: str) -> str:
        """The message of one validation error."""
        key, found = str(error["loc"][0]), error["input"]
        path = f"{place}.{key}" if place else key
        by_key = {field.alias or name: field for name, field in cls.model_fields.items()}
        if error["type"] == "extra_forbidden":
            keys = sorted(by_key, key=lambda name: not by_key[name].is_required())
            return unknown_key(place, key, keys)
        known = [", ".join(one.choices) for one in by_key[key].metadata if isinstance(one, OneOf)]
        wanted = f"one of {known[0]}" if known else by_key[key].description or "a table"
        if error["type"] == "missing":
            there = f"there are {', '.join(table)}" if table else "there is nothing"
            return f'the key "{path}", which is to hold {wanted}, is missing; in {place or "this study"} {there}'
        what_to_do = error["ctx"]["error"] if error["type"] == "value_error" else f"give {wanted}"
        is_element = len(error["loc"]) > 1 and isinstance(error["loc"][1], int)
        return f"{path} {'has' if is_element else 'is'} {found!r:.60}; {what_to_do}"

    @classmethod
    def from_dict(cls, table: object) -> Self:
        """The object that a table of TOML or JSON describes.

        Raises
        ------
        SettingsError
            A key is missing, unknown or holds something else.
        """
        return cls.model_validate(table)

    def to_dict(self) -> dict[str, Any]:
        """The table that `from_dict` takes, defaults included."""
        return self.model_dump(mode="json", by_alias=True)


@contextmanager
def located(place: str, error: type[DiransacError] = SettingsError) -> Iterator[None]:
    """Context that writes a place before the message of an error of a class, and makes it a SettingsError."""
    try:
        yield
    except error as found:
        raise SettingsError(f"{place}{found}") from found


def unknown_key(place: str, key: str, known: Collection[str]) -> str:
    """The sentence that refuses a key of a table."""
    return (
        f'there is no key "{f"{place}." if place else ""}{key}"; in {place or "a study"} there are {", ".join(known)}'
    )


@dataclass(frozen=True)
class OneOf:
    """Annotation of text that is one of some choices."""

    choices: Collection[str]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self._check, handler(source))

    def _check(self, text: str) -> str:
        if text not in self.choices:
            raise ValueError(f"there are {', '.join(self.choices)}")
        return text


class FunctionTable(Table):
    """Base of the tables that choose a function: keys without a field are ``arguments``, the last field."""

    @model_validator(mode="before")
    @classmethod
    def _gather(cls, table: Any) -> Any:
        """The table with its further keys in one, ``arguments``."""
        if not isinstance(table, Mapping):
            return table
        own = cls.model_fields.keys() - {"arguments"}
        given = {key: value for key, value in table.items() if key in own}
        return {**given, "arguments": {key: value for key, value in table.items() if key not in own}}

    @model_serializer(mode="wrap")
    def _spread(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """The table as users write it; what is empty has no key."""
        kept = {key: value for key, value in serialise(self).items() if value not in (None, "")}
        arguments = kept.pop("arguments")
        return {**kept, **arguments}


# Arguments of a function ----------------------------------------------------------------------------------------------
def _named(signature: inspect.Signature) -> list[inspect.Parameter]:
    """Arguments other than ``*more`` and ``**options``."""
    variable = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return [one for one in signature.parameters.values() if one.kind not in variable]


def check_signature(function: Callable[..., Any], name: str) -> None:
    """Raises SettingsError: an argument of a user's function has no default, or one that TOML cannot hold."""
    try:
        parameters = _named(inspect.signature(function))
    except (TypeError, ValueError) as error:
        raise SettingsError(f'"{name}" has no signature that can be read; wrap it in a function') from error
    needed = [one.name for one in parameters if one.default is one.empty]
    if needed:
        raise SettingsError(f'"{name}" needs {", ".join(needed)}; give every argument a default')
    for one in parameters:
        if not _is_writable(one.default):
            raise SettingsError(
                f'"{name}" has {one.name} = {one.default!r:.60} ({type(one.default).__name__}); give a default that '
                "TOML can write: a number, a word, true or false, a tuple of either, a dict of numbers, or None"
            )


def function_arguments(
    function: Callable[..., Any],
    given: Mapping[str, Any],
    place: str,
    keys: Collection[str],
    random: str = "",
    *,
    pairs: bool = False,
) -> dict[str, Any]:
    """Keyword arguments of a function from a table, completed by the function's defaults.

    Parameters
    ----------
    function : an argument whose default is None has no key
    given : the table, without the keys that are not arguments
    place : dotted path of the table
    keys : further keys of the table, for messages
    random : name of the argument that may be the word ``random``
    pairs : accept two numbers in place of one

    Raises
    ------
    SettingsError
        An unknown key, or a value that is not of its default's kind.
    """
    named = _named(inspect.signature(function))
    parameters = {x.name: x for x in named if x.default is not None and x.default is not x.empty}
    for name in given:
        if name not in parameters:
            raise SettingsError(unknown_key(place, name, [*keys, *parameters]))
    found = {}
    for name, one in parameters.items():
        default = _as_written(one.default)
        value = given.get(name, default)
        # Annotations of arguments that are counts; a default of 0 alone may stand for 0.0.
        is_count = one.annotation in (int, "int")
        drawn = name == random and value == RANDOM
        wanted = None if drawn else _unfit(value, default, is_count, pairs)
        if wanted:
            raise SettingsError(f"{place}.{name} is {value!r:.60}; give {wanted}")
        found[name] = value if drawn else _as(value, default)
    return found


def _unfit(value: Any, default: Any, is_count: bool, pairs: bool) -> str:
    """Description of the values that may replace a default, for one that may not; "" for one that may."""
    if isinstance(default, dict):
        fits = isinstance(value, Mapping) and all(isinstance(name, str) and is_number(x) for name, x in value.items())
        return "" if fits else "a table of numbers"
    if isinstance(default, list):
        of_words = not _are_numbers(default)
        fits = isinstance(value, list) and all(isinstance(x, str) if of_words else is_number(x) for x in value)
        return "" if fits else f"a list of {'words' if of_words else 'numbers'}"
    if isinstance(default, bool | str):
        kind = "true or false" if isinstance(default, bool) else "a word"
        return "" if type(value) is type(default) else kind
    if is_count:
        return "" if type(value) is int and value >= 0 else "a whole number from 0"
    is_pair = pairs and isinstance(value, list) and len(value) == 2 and _are_numbers(value)
    return "" if is_number(value) or is_pair else "a number"


def _as(value: Any, default: Any) -> Any:
    """A value as its function takes it: numbers are float64 where the default is no whole number."""
    if isinstance(default, dict):
        return {**default, **{name: float(x) for name, x in value.items()}}
    if isinstance(value, list):
        like = default[0] if isinstance(default, list) and default else default
        return [_as(x, like) for x in value]
    return float(value) if isinstance(default, float) else copy.copy(value)


def takes_options(function: Callable[..., Any]) -> bool:
    """True for a function with ``**options``."""
    return any(one.kind == inspect.Parameter.VAR_KEYWORD for one in inspect.signature(function).parameters.values())


def _is_writable(default: object) -> bool:
    """True for a default that TOML can hold, or None."""
    if isinstance(default, Mapping):
        return all(isinstance(name, str) and is_number(value) for name, value in default.items())
    if isinstance(default, list | tuple):
        return not default or _are_numbers(default) or all(isinstance(one, str) for one in default)
    return default is None or isinstance(default, str | bool) or is_number(default)


def _are_numbers(values: Collection[object]) -> bool:
    return bool(values) and all(map(is_number, values))


def _as_written(default: Any) -> Any:
    """A default as TOML has it."""
    if isinstance(default, Mapping):
        return dict(default)
    return list(default) if isinstance(default, tuple) else default


# Nested tables --------------------------------------------------------------------------------------------------------
def changed(table: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of a table with other values at dotted paths; missing tables on the way are made.

    Raises SettingsError: a path leads through something that is no table.
    """
    whole = copy.deepcopy(dict(table))
    for path, value in changes.items():
        *way, last = path.split(".")
        inner = whole
        for key in way:
            if inner.get(key) is None:  # what has no value yet may become a table
                inner[key] = {}
            inner = inner[key]
            if not isinstance(inner, dict):
                raise SettingsError(f'"{path}" leads nowhere: {key} is {inner!r:.60}, not a table')
        inner[last] = copy.deepcopy(value)
    return whole


def flat(table: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted path and value of everything that is not a table; an empty table is a value."""
    for key, value in table.items():
        here = f"{path}.{key}" if path else str(key)
        if isinstance(value, Mapping) and value:
            yield from flat(value, here)
        else:
            yield here, value


def check_whole(name: str, value: object, least: int) -> None:
    """Raises SettingsError: an argument is no integer, below the least, or beyond sense."""
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= MOST_COUNTED:
        raise SettingsError(f"{name} is {value!r:.60}; give a whole number from {least} to {MOST_COUNTED:,}")


def is_number(value: object) -> bool:
    """True for a finite number that float64 can represent; Booleans are no numbers."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
