"""`Store`: the rows of a study in one SQLite file.

| table | contents |
|---|---|
| ``trials`` | one row per level, trial and method |
| ``cells`` | number of trials asked for, by level and method |
| ``configuration`` | the values that determine rows, as JSON; only studies with the same values may write |
| ``about`` | names and descriptions; properties of each level's plant, so that a user's file need not be present |

The file has a rollback journal: a write-ahead log needs shared memory, which network file systems lack. Every write is
one transaction, so that a killed process leaves all of it or nothing. Values that may differ between equal runs are in
the columns ``seconds`` and ``host`` only.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from diransac.errors import StudyError
from diransac.limits import MOST_COUNTED
from diransac.plain_data import json_data
from diransac.study.assessment import PlantFacts
from diransac.study.database import MOST_LISTED, Database, damage, kept_apart, quoted, word
from diransac.study.specification import Study

__all__ = ["Store", "whole"]

_PLANTS = "plants"
"""Key of the properties of plants, among names."""


class Store(Database):
    """An open store.

    Raises
    ------
    StudyError
        The file is no store, or has another configuration; the message lists the keys that differ.
    """

    KIND, MAKER = "a study", "diransac study run NAME"
    APPLICATION = 0x6469726E  # "dirn"
    ROWS, TABLES = "trials", frozenset({"trials", "cells", "configuration", "about"})

    def __init__(self, path: str | Path, study: Study) -> None:
        with self._begun(path, lambda: _schema(study)):
            self._ask_for(study)

    def finished(self, level: str, trials: Sequence[int]) -> set[tuple[str, int, str]]:
        """Level, trial and method of the rows of these trials that are present."""
        query = "SELECT level, trial, method FROM trials WHERE level = ? AND trial BETWEEN ? AND ?"
        return set(self.select(query, (level, min(trials), max(trials))))

    def finished_in(self, batch: Any) -> set[tuple[str, int, str]]:
        """As `finished`, of a batch with a level and trials."""
        return self.finished(batch.level, batch.trials)

    @property
    def about(self) -> dict[str, Any]:
        """The study's ``name`` and ``description``, the name of its ``axis`` and the ``unit``."""
        rows = self.select("SELECT key, value FROM about WHERE key <> ?", (_PLANTS,))
        with damage(self.path):
            found = {key: json_data(value) for key, value in rows}
            return {key: word(found[key]) for key in ("name", "description", "axis", "unit")}

    @property
    def plants(self) -> dict[str, PlantFacts]:
        """Properties of the plant of each level."""
        rows = self.select("SELECT value FROM about WHERE key = ?", (_PLANTS,))
        with damage(self.path):
            facts = [pair for (value,) in rows for pair in json_data(value).items()]
            return {level: PlantFacts.from_dict(one) for level, one in facts}

    @property
    def configuration(self) -> dict[str, dict[str, Any]]:
        """The values that determine rows, as `Study.configuration` returns them."""
        found: dict[str, dict[str, Any]] = {}
        rows = self.select("SELECT part, key, value FROM configuration")
        with damage(self.path):
            for part, key, value in rows:
                found.setdefault(word(part), {})[word(key)] = json_data(value)
        return found

    @property
    def cells(self) -> list[tuple[str, str, int]]:
        """Level, method and number of trials that were asked for, in order."""
        rows = self.select("SELECT level, method, trials FROM cells ORDER BY rowid")
        with damage(self.path):
            return [(word(level), word(method), whole(trials)) for level, method, trials in rows]

    def _ask_for(self, study: Study) -> None:
        """Add the study's levels, methods and trials.  Raises StudyError: its configuration is another."""
        wanted = json.loads(json.dumps(study.configuration))
        kept = self.configuration
        differences = list(_differences(kept, wanted))
        if differences:
            more = f"; and {len(differences) - MOST_LISTED} more" if len(differences) > MOST_LISTED else ""
            raise StudyError(
                f'store "{self.path}" has another configuration: {"; ".join(differences[:MOST_LISTED])}{more}. '
                "Use another store, or the same values"
            )
        new = [(part, key, json.dumps(x)) for part in wanted if part not in kept for key, x in wanted[part].items()]
        execute = self._connection.executemany
        execute("INSERT INTO configuration VALUES (?, ?, ?)", new)
        execute(
            "INSERT INTO cells VALUES (?, ?, ?) ON CONFLICT DO UPDATE SET trials = max(trials, excluded.trials)",
            [(level.text, label, study.trials) for level in study.axis.levels for label in study.methods],
        )
        about = {"name": study.name, "description": study.description, "axis": study.axis.name, "unit": study.axis.unit}
        facts = {level.text: PlantFacts.of(study.at(level.text).plant.plant) for level in study.axis.levels}
        plants = {level: asdict(one) for level, one in {**self.plants, **facts}.items()}
        noted = {**about, _PLANTS: plants}
        execute("INSERT OR REPLACE INTO about VALUES (?, ?)", [(key, json.dumps(one)) for key, one in noted.items()])


def _differences(kept: Mapping[str, Mapping[str, Any]], wanted: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Sentences on the keys that differ, in the parts that both have; other parts are extensions."""
    for part in wanted:
        if part in kept:
            for key in {**kept[part], **wanted[part]}:
                old, new = (json.dumps(side[part].get(key, "nothing")) for side in (kept, wanted))
                if old != new:
                    name = key if part == "study" else f"{part}.{key}"
                    yield f"{name} is {old} in the store, {new} was asked for"


def whole(value: object) -> int:
    """A number of trials or of one.  Raises TypeError, ValueError: it is none, or beyond sense."""
    if type(value) is not int:
        raise TypeError(f"{value!r:.40} is no whole number")
    if not 0 <= value <= MOST_COUNTED:
        raise ValueError(f"{value} trials")
    return value


def _schema(study: Study) -> tuple[str, ...]:
    """Statements that make the tables of a new store."""
    kinds = _columns(study)
    columns = ", ".join(f"{quoted(name)} {kind}" for name, kind in zip(kept_apart(kinds), kinds.values(), strict=True))
    return (
        f"CREATE TABLE trials ({columns}, PRIMARY KEY (level, trial, method))",
        "CREATE TABLE cells (level TEXT, method TEXT, trials INTEGER NOT NULL, PRIMARY KEY (level, method))",
        "CREATE TABLE configuration (part TEXT, key TEXT, value TEXT NOT NULL, PRIMARY KEY (part, key))",
        "CREATE TABLE about (key TEXT PRIMARY KEY, value TEXT NOT NULL)",
    )


def _columns(study: Study) -> dict[str, str]:
    """SQL type of each column of a row."""
    model = study.plant.plant.model
    kinds = ("parameter", "pseudo_true", "low", "high") if study.evaluate_parameters else ("parameter",)
    parameters = {f"{kind}_{name}": "REAL" for kind in kinds for name in model.parameters}
    errors = {f"{shape}_{state}": "REAL" for shape in study.evaluation.trajectories for state in model.state}
    return {
        "level": "TEXT NOT NULL",
        "trial": "INTEGER NOT NULL",
        "method": "TEXT NOT NULL",
        "status": "TEXT NOT NULL",
        "error": "TEXT",
        "seed": "INTEGER NOT NULL",
        **parameters,
        "fit_error": "REAL",
        "inlier_fraction": "REAL",
        "iterations": "INTEGER",
        "stop_reason": "TEXT",
        **errors,
        "paths": "BLOB",
        "versions": "TEXT NOT NULL",
        "seconds": "TEXT NOT NULL",
        "host": "TEXT NOT NULL",
    }
