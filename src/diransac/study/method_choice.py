"""`MethodChoice`: a method of a study with its settings, and the table ``[methods]`` by label."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

from pydantic import Field

from diransac.errors import SettingsError, check_known
from diransac.identification.method import Method
from diransac.identification.methods import (
    ESTIMATORS,
    METHODS,
    WITH_ESTIMATOR,
    default_options,
    estimator_named,
    factory,
)
from diransac.identification.settings import Settings
from diransac.study.tables import OneOf, Table, Text, located

TRUE = "true"
"""Method that identifies nothing: its parameters are the plant's own."""

PRESETS = {"default": Settings, "table-iv": Settings.table_iv}

_OWN_ESTIMATOR = "default"
"""Word for the estimator that a method chooses."""


@dataclass(frozen=True)
class MethodChoice:
    """A method of identification with its settings.

    Parameters
    ----------
    method : one of `diransac.METHODS`, or ``true``
    settings : of the search and the evaluation
    options : the method's own settings that differ from their defaults, such as those of `diransac.LoDiransac`
    estimator : of the samples of a RANSAC method, one of `ESTIMATORS`, or ``default``
    """

    method: str
    settings: Settings
    options: Mapping[str, Any] = field(default_factory=dict)
    estimator: str = _OWN_ESTIMATOR

    def __post_init__(self) -> None:
        if self.method != TRUE:
            self.object()

    def object(self) -> Method:
        """The method with its settings, on one thread.

        Raises
        ------
        SettingsError
            The method has no such setting, or a value has no meaning.
        """
        own = default_options(self.method)
        check_known(self.options, own, "there is no option", "there are")
        inside = {}
        if self.estimator != _OWN_ESTIMATOR:
            if self.method not in WITH_ESTIMATOR:
                raise SettingsError(f"estimator serves {', '.join(WITH_ESTIMATOR)}, not {self.method}")
            inside["estimator"] = estimator_named(self.estimator)
        return factory(self.method)(replace(self.settings, threads=1), **self.options, **inside)

    def to_dict(self) -> dict[str, Any]:
        """The table of the method in a study file, with all of its settings and no preset."""
        options = {"options": dict(self.options)} if self.options else {}
        inside = {} if self.estimator == _OWN_ESTIMATOR else {"estimator": self.estimator}
        return {"method": self.method, "settings": self.settings.to_dict(), **options, **inside}


class _MethodTable(Table):
    """A table of ``[methods]``: ``settings`` are laid over those of ``preset``."""

    method: Annotated[Text, OneOf((TRUE, *METHODS))]
    preset: Annotated[Text, OneOf(PRESETS)] = "default"
    settings: dict[str, Any] = Field({}, description="a table")
    options: dict[str, Any] = Field({}, description="a table")
    estimator: Annotated[Text, OneOf((_OWN_ESTIMATOR, *ESTIMATORS))] = _OWN_ESTIMATOR


def methods_of(tables: object) -> object:
    """The methods of a study by label, which is the default of ``method``."""
    if not isinstance(tables, Mapping):
        return tables
    if not tables:
        raise SettingsError(f"methods is empty; there are {TRUE}, {', '.join(METHODS)}")
    return {label: _method(label, table) for label, table in tables.items()}


def _method(label: str, table: object) -> MethodChoice:
    if isinstance(table, MethodChoice):
        return table
    place = f"methods.{label}"
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9 _+()/-]*", label):
        raise SettingsError(f'methods: the label "{label}" has other characters than letters, digits and _ + - ( ) /')
    named = {"method": label, **table} if isinstance(table, Mapping) else table
    found = _MethodTable.model_validate(named, context={"place": place})
    # TOML has no None; "none" is a value of refit itself.
    given = {name: None if x == "none" and name != "refit" else x for name, x in found.settings.items()}
    with located(f"{place}.settings: "):
        settings = Settings.from_dict({**PRESETS[found.preset]().to_dict(), **given})
    with located(f"{place}: "):
        return MethodChoice(found.method, settings, found.options, found.estimator)
