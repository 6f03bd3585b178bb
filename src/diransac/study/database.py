"""SQLite files of studies and fleets: opened without trust, written in whole transactions.

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
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from contextlib import closing, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Self

from diransac.errors import StudyError
from diransac.plain_text import one_line

__all__ = [
    "AGAIN", "LARGEST", "MOST_LISTED", "Database", "connected_to", "damage", "kept_apart", "quoted", "reported",
    "roll_back", "transaction", "word",
]  # fmt: skip

AGAIN = "~"
"""Mark of a column whose name another one has in other case."""

LARGEST = 1e150
"""Of a number in a row: statistics have its square."""

MOST_LISTED = 6
"""Differences that an error message lists."""

_TIMEOUT = 120.0
"""s to wait while another process writes, and that one query may take."""


_DAMAGE = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError, EOFError,
           NotImplementedError, zipfile.BadZipFile, zlib.error)  # fmt: skip
"""Errors of values that a store of diransac never holds."""


class Database:
    """An open file; a context that closes it."""

    KIND: ClassVar[str]
    MAKER: ClassVar[str]
    """Subject of the file, and command that makes it."""

    APPLICATION: ClassVar[int]
    FORMAT = 2
    """SQLite's application id and user version."""

    ROWS: ClassVar[str]
    TABLES: ClassVar[AbstractSet[str]]
    """Table of the rows, and names of all tables."""

    path: Path
    _connection: sqlite3.Connection

    @classmethod
    def existing(cls, path: str | Path) -> Self:
        """An existing store, for reading alone.  Raises StudyError: there is none, or it is none of this kind."""
        store = cls.__new__(cls)
        store.path = Path(path)
        if not store.path.is_file():
            raise StudyError(f'store "{path}" does not exist; make one with {cls.MAKER} --store {path}')
        roll_back(store.path)
        store._connection = connected_to(store.path, "ro")
        try:
            with reported(store.path):
                store.check()
        except BaseException:
            store._connection.close()
            raise
        return store

    @contextmanager
    def _begun(self, path: str | Path, schema: Callable[[], Iterable[str]]) -> Iterator[None]:
        """Open a file for writing, in one transaction; statements of a schema make the tables of a new one.

        Raises StudyError: the file is no store that this version reads.
        """
        self.path = Path(path)
        self._connection = connected_to(self.path, "rwc")
        try:
            with transaction(self._connection, self.path):
                # A file without tables is new, or the process that made it was killed at once.
                if not self._connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
                    numbers = f"PRAGMA application_id = {self.APPLICATION}", f"PRAGMA user_version = {self.FORMAT}"
                    for statement in (*numbers, *schema()):
                        self._connection.execute(statement)
                self.check()
                yield
        except BaseException:
            self._connection.close()
            raise

    def check(self) -> None:
        """Raises StudyError: the file is no store that this version reads, or has what runs when it is read."""
        select = self._connection.execute
        if select("PRAGMA application_id").fetchone()[0] != self.APPLICATION:
            raise StudyError(f'"{self.path}" is no store of {self.KIND}; give one of {self.MAKER}, or a new one')
        number = select("PRAGMA user_version").fetchone()[0]
        if number != self.FORMAT:
            raise StudyError(
                f'store "{self.path}" has format {number}, this version reads {self.FORMAT}; begin another'
            )
        tables = set()
        for kind, name, sql in select("SELECT type, name, sql FROM sqlite_master").fetchall():
            is_plain = kind == "table" and str(sql).upper().startswith("CREATE TABLE ")
            if not is_plain and (kind != "index" or sql is not None):
                raise StudyError(
                    f'store "{self.path}" has {kind} "{name!s:.40}", which diransac never makes; give another'
                )
            if is_plain:
                tables.add(name)
        if not tables >= self.TABLES:
            missing = ", ".join(sorted(self.TABLES - tables))
            raise StudyError(f'store "{self.path}" is damaged: it has no {missing}; begin a new one')

    @property
    def columns(self) -> dict[str, tuple[str, str]]:
        """Name in a row -> column and its SQL type."""
        found = self.select(f"PRAGMA table_info({self.ROWS})")
        return {column.rstrip(AGAIN): (column, kind) for _, column, kind, *_ in found}

    def add(self, rows: Sequence[Mapping[str, Any]]) -> int:
        """Number of new rows, written in one transaction; rows that are present stay as they are."""
        before = self._connection.total_changes
        columns = {name: column for name, (column, _) in self.columns.items()}
        with transaction(self._connection, self.path):
            for row in rows:
                names = ", ".join(quoted(columns.get(name, name)) for name in row)
                marks = ", ".join("?" * len(row))
                values = [json.dumps(value) if isinstance(value, Mapping) else value for value in row.values()]
                self._connection.execute(f"INSERT OR IGNORE INTO {self.ROWS} ({names}) VALUES ({marks})", values)
        return self._connection.total_changes - before

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._connection.close()

    def select(self, query: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """Rows of a query."""
        end = time.monotonic() + _TIMEOUT
        self._connection.set_progress_handler(lambda: time.monotonic() > end, 100_000)
        with reported(self.path):
            return self._connection.execute(query, values).fetchall()


# Values --------------------------------------------------------------------------------------------------------------
@contextmanager
def damage(path: Path) -> Iterator[None]:
    """Context in which values of a store are used.  Raises StudyError: one is none that diransac writes."""
    try:
        yield
    except _DAMAGE as error:
        reason = f"{type(error).__name__}: {error}".partition("\n")[0]
        raise StudyError(f'store "{path}" is damaged: {reason:.200}; begin a new one') from error


def word(value: object) -> str:
    """A text of one line.  Raises TypeError: the value is no text."""
    if not isinstance(value, str):
        raise TypeError(f"{value!r:.40} is no text")
    return one_line(value)


# SQLite --------------------------------------------------------------------------------------------------------------
def connected_to(path: Path, mode: str) -> sqlite3.Connection:
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
def reported(path: Path) -> Iterator[None]:
    """Raises StudyError in place of SQLite's errors."""
    try:
        yield
    except (sqlite3.Error, UnicodeError) as error:
        is_full = getattr(error, "sqlite_errorname", "").startswith(("SQLITE_FULL", "SQLITE_IOERR"))
        advice = "is the disk full? Rows that it has are kept" if is_full else "give a store of diransac, or a new file"
        raise StudyError(f'store "{path}": {error}; {advice}') from error


@contextmanager
def transaction(connection: sqlite3.Connection, path: Path) -> Iterator[None]:
    """One transaction, with the file locked for other writers."""
    with reported(path):
        connection.execute("BEGIN IMMEDIATE")
        try:
            yield
            connection.execute("COMMIT")
        except BaseException:
            if connection.in_transaction:  # SQLite itself ends some that have failed
                connection.execute("ROLLBACK")
            raise


def roll_back(path: Path) -> None:
    """Undo what a killed process has left half written, which needs the right to write.

    Raises StudyError: the journal names a further file, which diransac's never does and SQLite would delete.
    """
    journal = path.with_name(f"{path.name}-journal")
    if not journal.is_file():
        return
    with closing(connected_to(path, "ro")) as connection:
        try:
            connection.execute("SELECT count(*) FROM sqlite_master")
            return
        except sqlite3.Error as error:
            if error.sqlite_errorname != "SQLITE_READONLY_ROLLBACK":
                return  # said when the store is read
    # Last bytes of a journal of several databases, which names a file that is deleted when it is rolled back.
    if journal.read_bytes().endswith(bytes.fromhex("d9d505f920a163d7")):
        raise StudyError(f'store "{path}" has a journal that diransac does not write; give the store without it')
    with closing(connected_to(path, "rw")) as connection, reported(path):
        connection.execute("SELECT count(*) FROM sqlite_master")


def kept_apart(names: Iterable[str]) -> list[str]:
    """Column names that SQLite, which ignores case, keeps apart: without the marks at their ends, the names."""
    before, found = Counter[str](), list[str]()
    for name in names:
        found.append(name + AGAIN * before[name.lower()])
        before[name.lower()] += 1
    return found


def quoted(name: str) -> str:
    """An identifier of SQL."""
    return '"' + name.replace('"', '""') + '"'
