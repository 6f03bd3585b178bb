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

A store may come from anyone: it is opened for reading without the right to write, its tables must be tables, queries
have a time limit, every value is checked, and none of them names code that reading would run.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from diransac.errors import StudyError
from diransac.limits import MOST_COUNTED
from diransac.plain_data import json_data
from diransac.study.assessment import PlantFacts
from diransac.study.database import (
    AGAIN,
    Database,
    check_plain,
    connected_to,
    copied,
    damage,
    is_empty,
    kept_apart,
    quoted,
    transaction,
    word,
)
from diransac.study.specification import Study

__all__ = ["Store", "whole"]

_APPLICATION = 0x6469726E
"""SQLite's application id: "dirn"."""

_FORMAT = 2
_TABLES = {"trials", "cells", "configuration", "about"}
_RENAMED_KEYS = {
    "noise.freeze_probability": "noise.stuck_probability",
    "noise.freeze_length": "noise.stuck_length",
    "noise.runs": "noise.correlated",
}
_RENAMED_VALUES = {
    ("data.trajectory", "places"): "random-waypoints",
    ("data.trajectory", "sines"): "multisine",
    ("data.seed", "any"): "random",
    ("plant.rotor_phase", "any"): "random",
    ("noise.runs", "independent"): False,
    ("noise.runs", "together"): True,
    ("noise.first_row", "hit"): "corrupted",
}
"""Keys and values of format 1, and what they are in format 2."""

_PLANTS = "plants"
"""Key of the properties of plants, among names."""

_MANY = 6
"""Differences that an error message lists; it counts the others."""


class Store(Database):
    """An open store.

    Parameters
    ----------
    path : of the file, which is made if it does not exist
    study : its levels, methods and trials are added to those that the store was asked for

    Raises
    ------
    StudyError
        The file is no store, or has another configuration; the message lists the keys that differ.
    """

    MAKER = "diransac study run NAME"

    def __init__(self, path: str | Path, study: Study) -> None:
        self.path = Path(path)
        self._connection = connected_to(self.path, "rwc")
        try:
            with transaction(self._connection, self.path):
                if is_empty(self._connection):
                    _create(self._connection, study)
                else:
                    _format(self._connection, self.path)
                    check_plain(self._connection, self.path, _TABLES)
                _upgrade(self._connection, self.path)
                self._ask_for(study)
        except BaseException:
            self._connection.close()
            raise

    def check(self) -> None:
        """Raises StudyError: the file is no store that this version reads; one of an earlier format is upgraded."""
        number = _format(self._connection, self.path)
        check_plain(self._connection, self.path, _TABLES)
        if number != _FORMAT:
            self._connection = copied(self._connection)
            _upgrade(self._connection, self.path)

    def finished(self, level: str, trials: Sequence[int]) -> set[tuple[str, int, str]]:
        """Level, trial and method of the rows of these trials that are present."""
        query = "SELECT level, trial, method FROM trials WHERE level = ? AND trial BETWEEN ? AND ?"
        return set(self.select(query, (level, min(trials), max(trials))))

    def finished_in(self, batch: Any) -> set[tuple[str, int, str]]:
        """As `finished`, of a batch with a level and trials."""
        return self.finished(batch.level, batch.trials)

    def add(self, rows: Sequence[Mapping[str, Any]]) -> int:
        """Number of new rows, written in one transaction; rows that are present stay as they are."""
        before = self._connection.total_changes
        columns = {name: column for name, (column, _) in self.columns.items()}
        with transaction(self._connection, self.path):
            for row in rows:
                names = ", ".join(quoted(columns.get(name, name)) for name in row)
                marks = ", ".join("?" * len(row))
                values = [json.dumps(value) if isinstance(value, Mapping) else value for value in row.values()]
                self._connection.execute(f"INSERT OR IGNORE INTO trials ({names}) VALUES ({marks})", values)
        return self._connection.total_changes - before

    @property
    def columns(self) -> dict[str, tuple[str, str]]:
        """Name in a row -> column and its SQL type."""
        found = self.select("PRAGMA table_info(trials)")
        return {column.rstrip(AGAIN): (column, kind) for _, column, kind, *_ in found}

    @property
    def about(self) -> dict[str, Any]:
        """The study's ``name`` and ``description``, the name of its ``axis`` and the ``unit``."""
        rows = self.select("SELECT key, value FROM about WHERE key <> ?", (_PLANTS,))
        with damage(self.path):
            found = {key: json_data(value) for key, value in rows}
            return {key: word(found[key]) for key in ("name", "description", "axis", "unit")}

    @property
    def plants(self) -> dict[str, PlantFacts]:
        """Properties of the plant of each level; absent in old stores until they are written to again."""
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
            more = f"; and {len(differences) - _MANY} more" if len(differences) > _MANY else ""
            raise StudyError(
                f'store "{self.path}" has another configuration: {"; ".join(differences[:_MANY])}{more}. '
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


def _format(connection: sqlite3.Connection, path: Path) -> int:
    """Format of the store.  Raises StudyError: the file is no store, or of an unknown format."""
    application = connection.execute("PRAGMA application_id").fetchone()[0]
    number = int(connection.execute("PRAGMA user_version").fetchone()[0])
    if application != _APPLICATION:
        raise StudyError(f'"{path}" is no store of a study; give a file that diransac study made, or a new one')
    if not 1 <= number <= _FORMAT:
        raise StudyError(f'store "{path}" has format {number}, this version reads 1 to {_FORMAT}; run the study again')
    return number


def _upgrade(connection: sqlite3.Connection, path: Path) -> None:
    """Give a store of format 1 the names of format 2.  Raises StudyError: as `_format`."""
    if _format(connection, path) == _FORMAT:
        return
    for _, column, *_ in connection.execute("PRAGMA table_info(trials)").fetchall():
        if column.startswith("best_"):
            new = "pseudo_true_" + column.removeprefix("best_")
            connection.execute(f"ALTER TABLE trials RENAME COLUMN {quoted(column)} TO {quoted(new)}")
    for part, key, text in connection.execute("SELECT part, key, value FROM configuration").fetchall():
        with damage(path):
            value = json_data(text)
        renamed = _RENAMED_VALUES.get((key, value), value) if isinstance(value, str) else value
        connection.execute(
            "UPDATE configuration SET key = ?, value = ? WHERE part = ? AND key = ?",
            (_RENAMED_KEYS.get(key, key), json.dumps(renamed), part, key),
        )
    connection.execute(f"PRAGMA user_version = {_FORMAT}")


def _create(connection: sqlite3.Connection, study: Study) -> None:
    """Make the tables of a new store."""
    kinds = _columns(study)
    columns = ", ".join(f"{quoted(name)} {kind}" for name, kind in zip(kept_apart(kinds), kinds.values(), strict=True))
    for statement in (
        f"PRAGMA application_id = {_APPLICATION}",
        f"PRAGMA user_version = {_FORMAT}",
        f"CREATE TABLE trials ({columns}, PRIMARY KEY (level, trial, method))",
        "CREATE TABLE cells (level TEXT, method TEXT, trials INTEGER NOT NULL, PRIMARY KEY (level, method))",
        "CREATE TABLE configuration (part TEXT, key TEXT, value TEXT NOT NULL, PRIMARY KEY (part, key))",
        "CREATE TABLE about (key TEXT PRIMARY KEY, value TEXT NOT NULL)",
    ):
        connection.execute(statement)


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
