"""`Store`: one SQLite file that keeps what trials gave.

| table | holds |
|---|---|
| ``trials`` | a row a level, trial and method |
| ``cells`` | how many trials of a level and method were asked for |
| ``configuration`` | what decides the outcome of trials, as JSON; only studies with the same may write |
| ``about`` | the names of things, for people; facts about each level's plant, for whoever has not got a user's file |

It has a rollback journal, not a write-ahead log: the latter needs memory that processes share, which file systems of
clusters don't have.  Whatever is written is written in one transaction, so that a killed process leaves all of it or
nothing.  Columns named ``seconds`` and ``host`` hold all that may differ between equal runs.
"""

from __future__ import annotations

import json
import sqlite3
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from diransac.errors import StudyError
from diransac.study.facts import PlantFacts
from diransac.study.specification import Study

__all__ = ["Store"]

_APPLICATION = 0x6469726E
"""SQLite's field that tells whose file it is: "dirn"."""

_FORMAT = 1
_PATIENCE = 120.0
"""s to wait while another process writes."""

_AGAIN = "~"
"""Follows the name of a column that differs from another in case alone: to SQLite ``m`` and ``M`` are the same."""

_PLANTS = "plants"
"""Key of what is no name of a thing."""

_MANY = 6
"""Differences that a refusal lists; it counts the others."""


class Store:
    """A study's store, open.

    Parameters
    ----------
    path : the file; a new one is made where there is none
    study : what is asked for: its levels, methods and trials are added to those of the store

    Raises StudyError: the file is no store, or one of another configuration; it says in which keys.
    """

    def __init__(self, path: str | Path, study: Study) -> None:
        self.path = Path(path)
        self._connection = _connected(self.path, "rwc")
        try:
            with _transaction(self._connection, self.path):
                if _is_empty(self._connection):
                    _create(self._connection, study)
                _check_format(self._connection, self.path)
                self._ask_for(study)
        except BaseException:
            self._connection.close()
            raise

    @classmethod
    def existing(cls, path: str | Path) -> Self:
        """The store that there is, for reading.  Raises StudyError: there is none."""
        store = cls.__new__(cls)
        store.path = Path(path)
        if not store.path.is_file():
            raise StudyError(f'store "{path}" does not exist; make one with diransac study run NAME --store {path}')
        store._connection = _connected(store.path, "rw")
        try:
            with _reported(store.path):
                _check_format(store._connection, store.path)
        except BaseException:
            store._connection.close()
            raise
        return store

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._connection.close()

    def finished(self, level: str, trials: Sequence[int]) -> set[tuple[str, int, str]]:
        """Level, trial and method of the rows there are of these trials."""
        query = "SELECT level, trial, method FROM trials WHERE level = ? AND trial BETWEEN ? AND ?"
        return set(self.select(query, (level, min(trials), max(trials))))

    def add(self, rows: Sequence[Mapping[str, Any]]) -> int:
        """Keep rows, in one transaction; those that another process kept meanwhile stay.  How many were new."""
        before = self._connection.total_changes
        columns = {name: column for name, (column, _) in self.columns.items()}
        with _transaction(self._connection, self.path):
            for row in rows:
                names = ", ".join(_quoted(columns.get(name, name)) for name in row)
                marks = ", ".join("?" * len(row))
                values = [json.dumps(value) if isinstance(value, Mapping) else value for value in row.values()]
                self._connection.execute(f"INSERT OR IGNORE INTO trials ({names}) VALUES ({marks})", values)
        return self._connection.total_changes - before

    def select(self, query: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """What a query gives."""
        with _reported(self.path):
            return self._connection.execute(query, values).fetchall()

    @property
    def columns(self) -> dict[str, tuple[str, str]]:
        """Column of each name in a row, and its SQL kind."""
        found = self.select("PRAGMA table_info(trials)")
        return {column.rstrip(_AGAIN): (column, kind) for _, column, kind, *_ in found}

    @property
    def about(self) -> dict[str, Any]:
        """Names of things, by key."""
        rows = self.select("SELECT key, value FROM about WHERE key <> ?", (_PLANTS,))
        return {key: json.loads(value) for key, value in rows}

    @property
    def plants(self) -> dict[str, PlantFacts]:
        """Facts about the plant of each level; stores of before have none until they are written to again."""
        rows = self.select("SELECT value FROM about WHERE key = ?", (_PLANTS,))
        return {level: PlantFacts(**facts) for (value,) in rows for level, facts in json.loads(value).items()}

    @property
    def configuration(self) -> dict[str, dict[str, Any]]:
        """What decides a trial's outcome, as `Study.configuration` has it."""
        found: dict[str, dict[str, Any]] = {}
        for part, key, value in self.select("SELECT part, key, value FROM configuration"):
            found.setdefault(part, {})[key] = json.loads(value)
        return found

    def _ask_for(self, study: Study) -> None:
        """Add what the study asks for.  Raises StudyError: its configuration is another."""
        wanted = json.loads(json.dumps(study.configuration))
        kept = self.configuration
        differences = list(_differences(kept, wanted))
        if differences:
            more = f"; and {len(differences) - _MANY} more" if len(differences) > _MANY else ""
            raise StudyError(
                f'store "{self.path}" was made by another configuration: {"; ".join(differences[:_MANY])}{more}. '
                "Take another store, or ask for the same"
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
    """Key by key, in the parts that both have: what is in one alone is an extension."""
    for part in wanted:
        if part in kept:
            for key in {**kept[part], **wanted[part]}:
                old, new = (json.dumps(side[part].get(key, "nothing")) for side in (kept, wanted))
                if old != new:
                    name = key if part == "study" else f"{part}.{key}"
                    yield f"{name} is {old} in the store, {new} was asked for"


# SQLite --------------------------------------------------------------------------------------------------------------
def _connected(path: Path, mode: str) -> sqlite3.Connection:
    """A connection that begins no transaction by itself.  Raises StudyError: the file cannot be opened."""
    try:
        uri = f"{path.absolute().as_uri()}?mode={mode}"
        return sqlite3.connect(uri, timeout=_PATIENCE, isolation_level=None, uri=True)
    except sqlite3.Error as error:
        raise StudyError(
            f'store "{path}" cannot be opened: {error}; does its folder exist, may you write there?'
        ) from error


@contextmanager
def _reported(path: Path) -> Iterator[None]:
    """Raises StudyError instead of SQLite's own errors."""
    try:
        yield
    except sqlite3.Error as error:
        raise StudyError(f'store "{path}": {error}; give a file that diransac study made, or a new one') from error


@contextmanager
def _transaction(connection: sqlite3.Connection, path: Path) -> Iterator[None]:
    """All of it or nothing; nobody else writes meanwhile."""
    with _reported(path):
        connection.execute("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            connection.execute("ROLLBACK")
            raise
        connection.execute("COMMIT")


def _is_empty(connection: sqlite3.Connection) -> bool:
    """Whether the file has nothing in it: it is new, or who made it was killed at once."""
    return not connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]


def _check_format(connection: sqlite3.Connection, path: Path) -> None:
    application = connection.execute("PRAGMA application_id").fetchone()[0]
    number = connection.execute("PRAGMA user_version").fetchone()[0]
    if application != _APPLICATION:
        raise StudyError(f'"{path}" is no store of a study; give a file that diransac study made, or a new one')
    if number != _FORMAT:
        raise StudyError(f'store "{path}" has format {number}, this version reads {_FORMAT}; run the study again')


def _create(connection: sqlite3.Connection, study: Study) -> None:
    """Tables of a new store."""
    kinds = _columns(study)
    columns = ", ".join(f"{_quoted(name)} {kind}" for name, kind in zip(_apart(kinds), kinds.values(), strict=True))
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
    """SQL kind of each column of a row."""
    model = study.plant.plant.model
    kinds = ("parameter", "best", "low", "high") if study.judges_parameters else ("parameter",)
    parameters = {f"{kind}_{name}": "REAL" for kind in kinds for name in model.parameters}
    errors = {f"{shape}_{state}": "REAL" for shape in study.evaluation for state in model.state}
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


def _apart(names: Iterable[str]) -> Iterator[str]:
    """Names that SQLite takes for different ones, too."""
    before = Counter[str]()
    for name in names:
        yield name + _AGAIN * before[name.lower()]
        before[name.lower()] += 1


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'
