"""`Store`: the rows of a study or of a fleet in one SQLite file, opened without trust, written in whole transactions.

| table | contents |
|---|---|
| ``trials`` | one row per trial: of a study per level, trial and method, of a fleet per log |
| ``asked`` | the rows that were asked for, in order; of a fleet with vehicle and time |
| ``configuration`` | the values that determine rows, as JSON; only the same values may add rows |
| ``about`` | names, descriptions, units; properties of each level's plant, so that a user's file need not be present |

The file has a rollback journal: a write-ahead log needs shared memory, which network file systems lack. Every write is
one transaction, so that a killed process leaves all of it or nothing. Values that may differ between equal runs are in
the columns ``seconds`` and ``host`` only.

A file may come from anyone: it is opened for reading without the right to write, its tables must be tables, queries
have a time limit, every value is checked, and none of them names code that reading would run.
"""

from __future__ import annotations

import json
import sqlite3
import time
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

from diransac.errors import StudyError
from diransac.plain_data import json_data
from diransac.plain_text import one_line

Key = tuple[Any, ...]
"""Values of the columns that name a row."""

AGAIN = "~"
"""Mark of a column whose name another one has in other case."""

LARGEST = 1e150
"""Of a number in a row: statistics have its square."""

_FORMAT = 3
"""SQLite's user version."""

_TIMEOUT = 120.0
"""s to wait while another process writes, and that one query may take."""


@dataclass(frozen=True)
class Kind:
    """A kind of store: its subject, the command that makes it, SQLite's application id.

    Parameters
    ----------
    key : columns that name a row, by SQL type
    more : further columns of what is asked for
    """

    subject: str
    maker: str
    application: int
    key: Mapping[str, str]
    more: tuple[str, ...] = ()


STUDY = Kind(
    "a study",
    "diransac study run NAME",
    0x6469726E,  # "dirn"
    {"level": "TEXT NOT NULL", "trial": "INTEGER NOT NULL", "method": "TEXT NOT NULL"},
)
FLEET = Kind("a fleet", "diransac identify --each", 0x64697266, {"log": "TEXT NOT NULL"}, ("vehicle", "time"))  # "dirf"


class Work(Protocol):
    """Rows to be computed: a study, or a fleet of logs."""

    @property
    def kind(self) -> Kind:
        """Kind of the store."""

    @property
    def columns(self) -> Mapping[str, str]:
        """SQL type of each column of a row that not every kind has."""

    @property
    def configuration(self) -> Mapping[str, Mapping[str, Any]]:
        """The values that determine rows, by part and key; a store may have further parts."""

    @property
    def about(self) -> Mapping[str, Any]:
        """Further values ready for JSON; a mapping extends the one that a store has."""

    @property
    def asked(self) -> Mapping[Key, Sequence[str | None]]:
        """Rows in order, with the values of the columns `Kind.more`."""


class Store:
    """An open store, to which the rows of a work may be added; a context that closes it.

    Raises
    ------
    StudyError
        The file is no store, or has another configuration; the message lists the keys that differ.
    """

    def __init__(self, path: str | Path, work: Work) -> None:
        with self._opened(path, work.kind, "rwc"), self._transaction():
            # A file without tables is new, or the process that made it was killed at once.
            if not self._connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
                for statement in _schema(work):
                    self._connection.execute(statement)
            self._check()
            self._ask_for(work)

    @classmethod
    def existing(cls, path: str | Path, kind: Kind = STUDY) -> Self:
        """An existing store, for reading alone.  Raises StudyError: there is none, or it is none of this kind."""
        store, path = cls.__new__(cls), Path(path)
        if not path.is_file():
            raise StudyError(f'store "{path}" does not exist; make one with {kind.maker} --store {path}')
        _roll_back(path)
        with store._opened(path, kind, "ro"), _reported(path):
            store._check()
        return store

    @contextmanager
    def _opened(self, path: str | Path, kind: Kind, mode: str) -> Iterator[None]:
        """Context in which a connection, which stays open, is closed by an error."""
        self.path, self.kind = Path(path), kind
        self._connection = _connected_to(self.path, mode)
        try:
            yield
        except BaseException:
            self._connection.close()
            raise

    def _check(self) -> None:
        """Raises StudyError: the file is no store that this version reads, or has what runs when it is read."""
        select = self._connection.execute
        if select("PRAGMA application_id").fetchone()[0] != self.kind.application:
            raise StudyError(
                f'"{self.path}" is no store of {self.kind.subject}; give one of {self.kind.maker}, or a new one'
            )
        number = select("PRAGMA user_version").fetchone()[0]
        if number != _FORMAT:
            raise StudyError(f'store "{self.path}" has format {number}, this version reads {_FORMAT}; begin another')
        tables = set()
        for kind, name, sql in select("SELECT type, name, sql FROM sqlite_master").fetchall():
            is_plain = kind == "table" and str(sql).upper().startswith("CREATE TABLE ")
            if not is_plain and (kind != "index" or sql is not None):
                raise StudyError(
                    f'store "{self.path}" has {kind} "{name!s:.40}", which diransac never makes; give another'
                )
            if is_plain:
                tables.add(name)
        missing = sorted({"trials", "asked", "configuration", "about"} - tables)
        if missing:
            raise StudyError(f'store "{self.path}" is damaged: it has no {", ".join(missing)}; begin a new one')

    def _ask_for(self, work: Work) -> None:
        """Add what is asked for.  Raises StudyError: the configuration is another."""
        wanted, kept = json_data(json.dumps(work.configuration)), self.configuration
        differences = list(_differences(kept, wanted))
        if differences:
            more = f"; and {len(differences) - 6} more" if len(differences) > 6 else ""
            raise StudyError(
                f'store "{self.path}" has another configuration: {"; ".join(differences[:6])}{more}. '
                "Use another store, or the same values"
            )
        new = [(part, key, json.dumps(x)) for part in wanted if part not in kept for key, x in wanted[part].items()]
        self._connection.executemany("INSERT INTO configuration VALUES (?, ?, ?)", new)
        noted = self.about
        for key, value in work.about.items():
            whole = {**noted.get(key, {}), **value} if isinstance(value, Mapping) else value
            self._connection.execute("INSERT OR REPLACE INTO about VALUES (?, ?)", (key, json.dumps(whole)))
        # What a store lacks follows what it has, whose order only a call that names all of it changes.
        known = self.select(f"SELECT {', '.join(self.kind.key)} FROM asked ORDER BY place")
        asked = work.asked
        order = dict.fromkeys([*asked] if asked.keys() >= set(known) else [*known, *asked])
        place = {key: k for k, key in enumerate(order)}
        marks = ", ".join("?" * (len(self.kind.key) + 1 + len(self.kind.more)))
        placed = ((*key, place[key], *more) for key, more in asked.items())
        self._connection.executemany(f"INSERT OR REPLACE INTO asked VALUES ({marks})", placed)

    @property
    def configuration(self) -> dict[str, dict[str, Any]]:
        """The values that determine rows, by part and key."""
        found: dict[str, dict[str, Any]] = {}
        rows = self.select("SELECT part, key, value FROM configuration")
        with damage(self.path):
            for part, key, value in rows:
                found.setdefault(word(part), {})[word(key)] = json_data(value)
        return found

    @property
    def about(self) -> dict[str, Any]:
        """Names and other values, as `Work.about` has them."""
        rows = self.select("SELECT key, value FROM about")
        with damage(self.path):
            return {word(key): json_data(value) for key, value in rows}

    @property
    def columns(self) -> dict[str, tuple[str, str]]:
        """Name in a row -> column and its SQL type."""
        found = self.select("PRAGMA table_info(trials)")
        return {column.rstrip(AGAIN): (column, kind) for _, column, kind, *_ in found}

    def finished(self, keys: Iterable[Key] | None = None) -> set[Key]:
        """Those of some rows, or of all, that are present."""
        query = f"SELECT {', '.join(self.kind.key)} FROM trials"
        if keys is None:
            return set(self.select(query))
        return {found for key in keys for found in self.select(f"{query} {self._of_key}", key)}

    def forget(self, keys: Iterable[Key]) -> None:
        """Delete rows, which are then computed anew."""
        with self._transaction():
            self._connection.executemany(f"DELETE FROM trials {self._of_key}", list(keys))

    @property
    def _of_key(self) -> str:
        """Clause for the row of a key."""
        return f"WHERE {' AND '.join(f'{name} = ?' for name in self.kind.key)}"

    def add(self, rows: Sequence[Mapping[str, Any]]) -> int:
        """Number of new rows, written in one transaction; rows that are present stay as they are."""
        before = self._connection.total_changes
        columns = {name: column for name, (column, _) in self.columns.items()}
        with self._transaction():
            for row in rows:
                names = ", ".join(quoted(columns.get(name, name)) for name in row)
                marks = ", ".join("?" * len(row))
                values = [json.dumps(value) if isinstance(value, Mapping) else value for value in row.values()]
                self._connection.execute(f"INSERT OR IGNORE INTO trials ({names}) VALUES ({marks})", values)
        return self._connection.total_changes - before

    def select(self, query: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """Rows of a query."""
        end = time.monotonic() + _TIMEOUT
        self._connection.set_progress_handler(lambda: time.monotonic() > end, 100_000)
        with _reported(self.path):
            return self._connection.execute(query, values).fetchall()

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        """One transaction, with the file locked for other writers."""
        with _reported(self.path):
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._connection.execute("COMMIT")
            except BaseException:
                if self._connection.in_transaction:  # SQLite itself ends some that have failed
                    self._connection.execute("ROLLBACK")
                raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._connection.close()


def _differences(kept: Mapping[str, Mapping[str, Any]], wanted: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Sentences on the keys that differ, in the parts that both have; other parts are extensions."""
    for part in wanted:
        if part in kept:
            for key in {**kept[part], **wanted[part]}:
                old, new = (json.dumps(side[part].get(key, "nothing")) for side in (kept, wanted))
                if old != new:
                    name = key if part == "study" else f"{part}.{key}"
                    yield f"{name} is {old:.200} in the store, {new:.200} was asked for"


def _schema(work: Work) -> Iterator[str]:
    """Statements that make the tables of a new store."""
    kind, key = work.kind, ", ".join(work.kind.key)
    kinds = {**kind.key, "status": "TEXT NOT NULL", "error": "TEXT", **work.columns}
    kinds |= {"versions": "TEXT NOT NULL", "host": "TEXT NOT NULL"}
    columns = ", ".join(f"{quoted(name)} {sql}" for name, sql in zip(_kept_apart(kinds), kinds.values(), strict=True))
    asked = ", ".join(f"{name} {sql}" for name, sql in kind.key.items())
    more = "".join(f", {name} TEXT" for name in kind.more)
    yield f"PRAGMA application_id = {kind.application}"
    yield f"PRAGMA user_version = {_FORMAT}"
    yield f"CREATE TABLE trials ({columns}, PRIMARY KEY ({key}))"
    yield f"CREATE TABLE asked ({asked}, place INTEGER NOT NULL{more}, PRIMARY KEY ({key}))"
    yield "CREATE TABLE configuration (part TEXT, key TEXT, value TEXT NOT NULL, PRIMARY KEY (part, key))"
    yield "CREATE TABLE about (key TEXT PRIMARY KEY, value TEXT NOT NULL)"


# Values --------------------------------------------------------------------------------------------------------------
@contextmanager
def damage(path: Path) -> Iterator[None]:
    """Context in which values of a store are used.  Raises StudyError: one is none that diransac writes."""
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError, EOFError,
            NotImplementedError, zipfile.BadZipFile, zlib.error) as error:  # fmt: skip
        reason = f"{type(error).__name__}: {error}".partition("\n")[0]
        raise StudyError(f'store "{path}" is damaged: {reason:.200}; begin a new one') from error


def word(value: object) -> str:
    """A text of one line.  Raises TypeError: the value is no text."""
    if not isinstance(value, str):
        raise TypeError(f"{value!r:.40} is no text")
    return one_line(value)


def _kept_apart(names: Iterable[str]) -> list[str]:
    """Column names that SQLite, which ignores case, keeps apart: without the marks at their ends, the names."""
    before, found = Counter[str](), list[str]()
    for name in names:
        found.append(name + AGAIN * before[name.lower()])
        before[name.lower()] += 1
    return found


def quoted(name: str) -> str:
    """An identifier of SQL."""
    return '"' + name.replace('"', '""') + '"'


# SQLite --------------------------------------------------------------------------------------------------------------
def _connected_to(path: Path, mode: str) -> sqlite3.Connection:
    """A connection without implicit transactions.

    Raises StudyError: the file cannot be opened, or has a write-ahead log, which makes two further files when read.
    """
    if _has_write_ahead_log(path):
        raise StudyError(
            f'store "{path}" has a write-ahead log, which no study makes; PRAGMA journal_mode = DELETE takes it out'
        )
    if not path.parent.is_dir():  # SQLite takes a/../b for b, also where there is no a
        raise StudyError(f'store "{path}" cannot be opened: the folder "{path.parent}" does not exist; make it first')
    try:
        uri = f"{path.absolute().as_uri()}?mode={mode}"
        connection = sqlite3.connect(uri, timeout=_TIMEOUT, isolation_level=None, uri=True)
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, 64 * 2**20)
        connection.execute("PRAGMA trusted_schema = OFF")
        connection.execute("PRAGMA cell_size_check = ON")
        return connection
    except sqlite3.Error as error:
        raise StudyError(
            f'store "{path}" cannot be opened: {error}; does its folder exist, may you write there?'
        ) from error


def _has_write_ahead_log(path: Path) -> bool:
    """True for a database in this mode; False also for a file that is missing or cannot be read."""
    try:
        with path.open("rb") as file:
            header = file.read(20)
    except OSError:
        return False
    # Its last two bytes are 1 with a rollback journal.
    return header.startswith(b"SQLite format 3\0") and 2 in header[18:]


@contextmanager
def _reported(path: Path) -> Iterator[None]:
    """Raises StudyError in place of SQLite's errors."""
    try:
        yield
    except (sqlite3.Error, UnicodeError) as error:
        is_full = getattr(error, "sqlite_errorname", "").startswith(("SQLITE_FULL", "SQLITE_IOERR"))
        advice = "is the disk full? Rows that it has are kept" if is_full else "give a store of diransac, or a new file"
        raise StudyError(f'store "{path}": {error}; {advice}') from error


def _roll_back(path: Path) -> None:
    """Undo what a killed process has left half written, which needs the right to write.

    Raises StudyError: the journal names a further file, which diransac's never does and SQLite would delete.
    """
    journal = path.with_name(f"{path.name}-journal")
    if not journal.is_file():
        return
    with closing(_connected_to(path, "ro")) as connection:
        try:
            connection.execute("SELECT count(*) FROM sqlite_master")
            return
        except sqlite3.Error as error:
            if error.sqlite_errorname != "SQLITE_READONLY_ROLLBACK":
                return  # said when the store is read
    # Last bytes of a journal of several databases, which names a file that is deleted when it is rolled back.
    if journal.read_bytes().endswith(bytes.fromhex("d9d505f920a163d7")):
        raise StudyError(f'store "{path}" has a journal that diransac does not write; give the store without it')
    with closing(_connected_to(path, "rw")) as connection, _reported(path):
        connection.execute("SELECT count(*) FROM sqlite_master")
