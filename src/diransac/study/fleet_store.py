"""`FleetStore`: the rows of a fleet in one SQLite file.

| table | contents |
|---|---|
| ``logs`` | one row per log that was identified, or failed, with the file's size, time and hash |
| ``asked`` | logs that were asked for, with vehicle and order |
| ``configuration`` | the values that determine rows, as JSON; only the same values may add rows |
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

from diransac.errors import StudyError
from diransac.limits import check_ordinary
from diransac.model import Model
from diransac.plain_data import json_data
from diransac.study.database import MOST_LISTED, Database, damage, kept_apart, quoted, transaction, word

__all__ = ["ERROR", "FleetStore", "columns_of", "marks_of"]

ERROR, _ABOUT = "standard_error", ("model_name", "units")
"""Beginning of a column; keys of the configuration on which no row depends."""


class FleetStore(Database):
    """An open store of a fleet.

    Raises
    ------
    StudyError
        The file is no store of a fleet, or has another configuration.
    """

    KIND, MAKER = "a fleet", "diransac identify --each"
    APPLICATION = 0x64697266  # "dirf"
    ROWS, TABLES = "logs", frozenset({"logs", "asked", "configuration"})

    def __init__(self, path: str | Path, model: Model, wanted: Mapping[str, Any]) -> None:
        about = {"model_name": model.name, "units": {name: x.unit for name, x in model.parameters.items()}}
        is_new = False

        def schema() -> tuple[str, ...]:
            nonlocal is_new
            is_new = True
            return _schema(model)

        with self._begun(path, schema):
            if is_new:
                values = [(key, json.dumps(value)) for key, value in {**wanted, **about}.items()]
                self._connection.executemany("INSERT INTO configuration VALUES (?, ?)", values)
            self._compare(json_data(json.dumps(wanted)))

    @property
    def configuration(self) -> dict[str, Any]:
        """Values that determine rows, and the units of the parameters."""
        rows = self.select("SELECT key, value FROM configuration")
        with damage(self.path):
            return {word(key): json_data(value) for key, value in rows}

    def ask_for(self, logs: Iterable[tuple[str, int, str | None, str | None]]) -> None:
        """Add logs after those that are known, or give all known ones another order; each has a vehicle and time."""
        rows = sorted(logs, key=lambda row: row[1])
        with transaction(self._connection, self.path):
            known = dict(self._connection.execute("SELECT log, place FROM asked").fetchall())
            if known.keys() <= {name for name, *_ in rows}:
                places = {name: k for k, (name, *_) in enumerate(rows)}
            else:
                new = [name for name, *_ in rows if name not in known]
                places = known | {name: k for k, name in enumerate(new, max(known.values()) + 1)}
            placed = [(name, places[name], vehicle, moment) for name, _, vehicle, moment in rows]
            self._connection.executemany("INSERT OR REPLACE INTO asked VALUES (?, ?, ?, ?)", placed)

    def forget_changed(self, logs: Iterable[str]) -> None:
        """Delete the rows of logs whose files differ from those that were read; files that are not here stay."""
        rows = self.select("SELECT log, file_stamp, file_hash FROM logs")
        kept = {name: (stamp, content) for name, stamp, content in rows}
        changed = [(name,) for name in logs if name in kept and _differs(Path(name), *kept[name])]
        with transaction(self._connection, self.path):
            self._connection.executemany("DELETE FROM logs WHERE log = ?", changed)

    def finished(self) -> set[str]:
        """Names of the logs whose rows are present."""
        return {name for (name,) in self.select("SELECT log FROM logs")}

    def finished_in(self, batch: Any) -> set[str]:
        """Names of the logs of a batch, ``batch.logs``, whose rows are present."""
        marks = ", ".join("?" * len(batch.logs))
        return {name for (name,) in self.select(f"SELECT log FROM logs WHERE log IN ({marks})", batch.logs)}

    def _compare(self, wanted: Mapping[str, Any]) -> None:
        """Raises StudyError: the store has another configuration."""
        kept = {key: value for key, value in self.configuration.items() if key not in _ABOUT}
        differing = [key for key in {**wanted, **kept} if kept.get(key) != wanted.get(key)]
        if differing:
            raise StudyError(
                f'store "{self.path}" has another {", ".join(differing[:MOST_LISTED])}: give the same, or another store'
            )


def _differs(path: Path, stamp: str | None, content: str | None) -> bool:
    """True if a file is here and is not the one with these marks."""
    try:
        return path.exists() and _stamp(path) != stamp and _hash(path) != content
    except OSError:
        return False


def columns_of(parameters: Iterable[str]) -> dict[str, str]:
    """Columns of the parameters and of their standard errors, by name."""
    names = [f"{kind}_{name}" for name in parameters for kind in ("parameter", ERROR)]
    return dict(zip(names, kept_apart(names), strict=True))


def _schema(model: Model) -> tuple[str, ...]:
    """Statements that make the tables of a new store."""
    of_parameters = [f"{quoted(column)} REAL" for column in columns_of(model.parameters).values()]
    return (
        "CREATE TABLE logs (log TEXT PRIMARY KEY, own_vehicle TEXT, status TEXT NOT NULL, error TEXT, verdict TEXT, "
        f"findings TEXT, duration REAL, {', '.join(of_parameters)}, fit_error REAL, inlier_fraction REAL, "
        "stop_reason TEXT, file_stamp TEXT, file_hash TEXT, "
        "versions TEXT NOT NULL, seconds REAL NOT NULL, host TEXT NOT NULL)",
        "CREATE TABLE asked (log TEXT PRIMARY KEY, place INTEGER NOT NULL, vehicle TEXT, time TEXT)",
        "CREATE TABLE configuration (key TEXT PRIMARY KEY, value TEXT NOT NULL)",
    )


# Files -------------------------------------------------------------------------------------------------------------
def marks_of(path: Path) -> dict[str, str | None]:
    """Marks of a file, or of a folder with all of its files: of sizes and times, and of contents; None without it."""
    try:
        return {"file_stamp": _stamp(path), "file_hash": _hash(path)}
    except OSError:
        return {"file_stamp": None, "file_hash": None}


def _stamp(path: Path) -> str:
    """Sizes and times of the files of a log.  Raises OSError: it cannot be read."""
    about = [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in _files(path)]
    return sha256(repr(about).encode()).hexdigest()


def _hash(path: Path) -> str:
    """Contents of the files of a log.  Raises OSError: it cannot be read."""
    found = sha256()
    for file in _files(path):
        found.update(repr((file.name, file.stat().st_size)).encode())
        check_ordinary(file)
        with file.open("rb") as data:
            while block := data.read(2**20):
                found.update(block)
    return found.hexdigest()


def _files(path: Path) -> list[Path]:
    return sorted(x for x in path.rglob("*") if x.is_file()) if path.is_dir() else [path]
