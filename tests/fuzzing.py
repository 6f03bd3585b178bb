"""Files of each kind that diransac reads, mutations of them, and the rule that every command keeps over them.

The rule: the exit code is 0, 1 or 2; stderr has at most three lines; no unexpected exception, no warning, no control
character; the file that was read stays as it is; nothing is left behind but an output that was asked for, is complete
and reads back, and as code is what diransac writes alone; no process is started, no library or pickle loaded, no
connection opened, and no file written elsewhere; memory and time are bounded.
"""

import copy
import itertools
import json
import math
import os
import re
import resource
import signal
import sqlite3
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

from typer.testing import CliRunner

from diransac.cli.commands import app
from diransac.model.model import _checksum
from hostile import NAMES, TEXTS
from read_back import check_printed, check_reads_back

_MET: set[tuple[bytes, str]] = set()
"""Undamaged files with the commands that have had them."""
BESIDE = "-metadata.json"
"""Ending of the metadata beside a CSV file."""
MOST_LINES, MOST_SECONDS, MOST_MEMORY = 3, 60, 2**30
"""Lines on stderr, s, and bytes by which the largest size of the process may grow in one command."""

# Outcomes of commands -------------------------------------------------------------------------------------------------
_FORBIDDEN = {
    "os.system", "os.exec", "os.posix_spawn", "os.fork", "os.startfile", "subprocess.Popen", "pty.spawn",
    "pickle.find_class", "socket.connect", "socket.bind", "webbrowser.open", "sqlite3.load_extension",
}  # fmt: skip
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


@dataclass
class _Watch:
    """What an audit hook, which can never be removed, sees while a command runs."""

    folders: tuple[str, ...] = ()
    thread: int = 0
    seen: tuple[str, ...] = ()

    def hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Note an event that no file may cause."""
        if not self.folders:
            return
        if event in _FORBIDDEN or (
            event == "ctypes.dlopen" and str(arguments[0]).startswith((self.folders[0], ".", "@"))
        ):
            self.seen += (f"{event} {arguments!r:.200}",)
        elif event == "open" and isinstance(arguments[0], str | bytes) and arguments[2] & _WRITING:
            name = os.path.abspath(os.fsdecode(arguments[0]))  # noqa: PTH100  no file is looked up in a hook
            if not name.startswith(self.folders) and not name.endswith((".pyc", os.devnull)) and ".pyc." not in name:
                self.seen += (f"wrote {name}",)


_WATCH: list[_Watch] = []


def _watch() -> _Watch:
    """The one watch of this process."""
    if not _WATCH:
        _WATCH.append(_Watch())
        sys.addaudithook(_WATCH[0].hook)
    return _WATCH[0]


class TooSlow(BaseException):
    """A command took longer than `MOST_SECONDS`."""


def _too_slow(*_: object) -> None:
    raise TooSlow


@contextmanager
def _limited() -> Iterator[None]:
    """Context that ends after `MOST_SECONDS`."""
    before = signal.signal(signal.SIGALRM, _too_slow)
    signal.setitimer(signal.ITIMER_REAL, MOST_SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@contextmanager
def _file_of_stderr() -> Iterator[Callable[[], str]]:
    """Context in which descriptor 2, to which libraries write past Python, is a file; its text."""
    sys.stderr.flush()
    kept = os.dup(2)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield lambda: (file.seek(0), file.read().decode(errors="replace"))[1]
        finally:
            os.dup2(kept, 2)
            os.close(kept)


def listing(folder: Path) -> dict[str, tuple[int, int]]:
    """Size and time of change of every file below a folder; (-1, 0) for a folder."""
    found = {}
    for path in folder.rglob("*"):
        about = path.lstat()
        found[str(path.relative_to(folder))] = (-1, 0) if path.is_dir() else (about.st_size, about.st_mtime_ns)
    return found


def outcome(folder: Path, words: Sequence[str], outputs: Sequence[str] = (), memory: int = MOST_MEMORY) -> int:
    """Exit code of a command line in a folder, which keeps the rule.

    Parameters
    ----------
    folder : working directory; the only place, beside the cache of machine code, where files may be written
    words : arguments
    outputs : names of files that the command may write where it succeeds; they are removed again
    memory : bytes by which the largest size of the process may grow

    Raises
    ------
    AssertionError
        The rule is broken; the message says how.
    """
    before, largest = listing(folder), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    watch, here = _watch(), Path.cwd()
    places = (str(folder), tempfile.gettempdir(), os.environ["DIRANSAC_CACHE"])
    os.chdir(folder)
    try:
        with _file_of_stderr() as written, _limited():
            watch.seen, watch.folders = (), places
            try:
                done = CliRunner().invoke(app, list(words), prog_name="diransac")
            finally:
                watch.folders = ()
            beside = written()
    except TooSlow:
        raise AssertionError(f"{words}: longer than {MOST_SECONDS} s") from None
    finally:
        os.chdir(here)
    error, lines = done.exception, (done.stderr + beside).splitlines()
    if error is not None and not isinstance(error, SystemExit):
        raise AssertionError(f"{words}: internal error: {type(error).__name__}: {error}") from error
    assert done.exit_code in (0, 1, 2), f"{words}: exit code {done.exit_code}"
    assert len(lines) <= MOST_LINES, f"{words}: {lines}"
    assert done.exit_code == 0 or lines, f"{words}: exit code {done.exit_code} without a message"
    assert not any(word in line for line in lines for word in ("Traceback", "internal error", "panicked")), lines
    assert not watch.seen, f"{words}: {watch.seen}"
    after = listing(folder)
    made = {name for name in after if after[name] != before.get(name)} | (before.keys() - after.keys())
    described = {f"{name}{BESIDE}" for name in outputs if name.endswith((".csv", ".csv.gz"))}
    allowed = {*outputs, *described} if done.exit_code == 0 else set()
    assert made <= allowed, f"{words}: exit code {done.exit_code} leaves {made - allowed}"
    grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - largest)
    assert grown < memory, f"{words}: {grown / 2**20:.0f} MiB more"
    assert threading.active_count() < 64
    check_printed(words, done.stdout, done.stderr)
    for name in made - described:  # a table with its metadata
        check_reads_back(folder / name)
    for name in made:
        (folder / name).unlink()
    return done.exit_code


# Bytes ----------------------------------------------------------------------------------------------------------------
_NUMBERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 2**40, 2**63 - 1, 2**64 - 1)


def changed_bytes(data: bytes, rng: Random) -> bytes:
    """Data with bits flipped, numbers overwritten, or parts cut off, left out, repeated or inserted."""
    found = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8, 40))):
        at, size = rng.randrange(len(found) + 1), rng.choice((1, 4, 16, 300))
        match rng.randrange(7):
            case 0 | 1 if at < len(found):
                found[at] ^= 1 << rng.randrange(8)
            case 2:
                width = rng.choice((1, 2, 4, 8))
                number = rng.choice(_NUMBERS) % 256**width
                found[at : at + width] = number.to_bytes(width, rng.choice(("little", "big")))
            case 3:
                del found[at : at + size]
            case 4:
                found[at:at] = found[at : at + size] * rng.choice((1, 1, 50))
            case 5:
                found[at:at] = rng.choice((bytes(size), rng.randbytes(size), b"9" * size, b"[" * size, b"\xff\xfe"))
            case _ if rng.random() < 0.2:
                del found[at:]
    return bytes(found)


# JSON -----------------------------------------------------------------------------------------------------------------
_DEEP, _LONG_NUMBER = "@deep@", "@number@"
_ODD = (
    None, True, False, 0, -1, 1, 2, 10**200, -(2**63), 2**63, 1e308, -1e308, 5e-324, math.nan, math.inf, -math.inf, "",
    "nan", "inf", "-1", " ", "\0", "\n", "ü", "\ud800", "<script>", "../../x", "x.py", "file:///etc/passwd", "%s{0}",
    [], {}, [[]], {"": None}, [1, "a"], "9" * 100, "x" * 10_000, _DEEP, _LONG_NUMBER,
)  # fmt: skip


def places(node: Any, way: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Ways to all values of nested lists and mappings."""
    if way:
        yield way
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in items:
        yield from places(value, (*way, key))


def _at(node: Any, way: Sequence[Any]) -> Any:
    for key in way:
        node = node[key]
    return node


def changed_data(data: Any, rng: Random) -> Any:
    """A copy with one to three values replaced, exchanged, left out, renamed or repeated."""
    changed = {"": copy.deepcopy(data)}
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        every = list(places(changed))
        *way, key = _chosen(every, rng)
        node = _at(changed, way)
        match rng.randrange(8):
            case 0 if way:
                del node[key]
            case 1:
                node[key] = copy.deepcopy(_at(changed, _chosen(every, rng)))
            case 2 if isinstance(node, dict) and way:
                node[rng.choice(("", "x", str(key).upper(), "m" * 5000))] = node.pop(key)
            case 3 if isinstance(node, list):
                node[key:key] = [copy.deepcopy(node[key])] * rng.choice((1, 5, 3000))
            case 4 if isinstance(node[key], str):
                node[key] = changed_text(node[key], rng)
            case 5 if type(node[key]) in (int, float):
                node[key] = rng.choice(
                    (-node[key], node[key] * 1e6, node[key] + 1, node[key] / 3, 0, 10**30, str(node[key]))
                )
            case _:
                node[key] = copy.deepcopy(rng.choice(_ODD))
    return changed[""]


def _chosen(every: Sequence[tuple[Any, ...]], rng: Random) -> tuple[Any, ...]:
    """A way, each depth as likely as another: few values near the root decide about all others."""
    depth = rng.choice(sorted({len(way) for way in every}))
    return rng.choice([way for way in every if len(way) == depth])


def changed_text(text: str, rng: Random) -> str:
    """Text with a few characters replaced, a word exchanged, or repeated."""
    k = rng.randrange(len(text) + 1)
    words = text.split(" ")
    match rng.randrange(4):
        case 0:
            words[rng.randrange(len(words))] = rng.choice(
                ("sin", "const", "inf", "1e999", "-1", "p", "call", "0", "sqrt")
            )
            return " ".join(words)
        case 1:
            return text * 2
        case _:
            return text[:k] + rng.choice("0189 =-.epv\n\"'[]{}\0é") + text[k + rng.randrange(3) :]


def as_json(data: Any) -> str:
    """JSON text, with nests and numbers in it that no writer makes."""
    text = json.dumps(data)
    return text.replace(f'"{_DEEP}"', "[" * 20_000).replace(f'"{_LONG_NUMBER}"', "9" * 5000)


def signed(result: Any) -> Any:
    """A result, or part of one, with the checksum of its model that anyone can compute."""
    model = result.get("model") if isinstance(result, dict) else None
    if isinstance(model, dict) and not any(math.isnan(x) for x in _numbers(model)):
        model = {key: value for key, value in model.items() if key != "checksum"}
        return {**result, "model": {**model, "checksum": _checksum(model)}}
    return result


def _numbers(node: Any) -> Iterator[float]:
    yield from (x for way in places(node) if isinstance(x := _at(node, way), float))


def changed_result(data: bytes, rng: Random) -> bytes:
    """A result that is changed as data, three times of four with a checksum that fits, or as bytes."""
    if rng.random() < 0.15:
        return changed_bytes(data, rng)
    return as_json(signed(changed_data(json.loads(data), rng))).encode()


_WORDS = {
    1: ("sqrt", "log", "inv", "erfinv", "exp", "sign", "floor", "not", "acosh", "p", "u", "q", "const"),
    2: (
        "add",
        "mul",
        "div",
        "pow",
        "atan2",
        "fmod",
        "lt",
        "if_else_zero",
        "copysign",
        "hypot",
        "remainder",
        "constpow",
    ),
}
"""Operations by their number of operands, and arguments."""


def changed_graph(data: bytes, rng: Random) -> bytes:
    """A result of which the equations or the names of the model alone are changed, with a checksum that fits."""
    result = json.loads(data)
    model, key = (
        result["model"],
        rng.choice(("residual", "residual", "residual", "parameters", "coordinates", "inputs")),
    )
    lines = model["residual"]["operations"]
    if key == "residual" and rng.random() < 0.6:
        for _ in range(rng.choice((1, 1, 3))):
            k = rng.randrange(1, len(lines))
            number, _, word, *operands = lines[k].split(" ")
            if rng.random() < 0.7:
                word = rng.choice(_WORDS.get(len(operands), (word,)))
            if rng.random() < 0.5:
                operands = [str(rng.choice((0, 1, rng.randrange(k), rng.randrange(k)))) for _ in operands]
            lines[k] = " ".join((number, "=", word, *operands, *("0",) * rng.choice((0, 0, 0, 0, 1))))
    else:
        model[key] = changed_data(model[key], rng)
    return as_json(signed(result)).encode()


# TOML, XML and other text ---------------------------------------------------------------------------------------------
_TOML = (
    "-1", "0", "1", "nan", "inf", "1e308", "1e-308", "99999999999999999999", "true", '""', '"x"', "[]", "{}", "[[1]]",
    '"x.py"', "1979-05-27", "[0, 0]", "[1, 'a']", "{a = 1}", "5" * 5000, "[" * 5000,
)  # fmt: skip


def changed_lines(data: bytes, rng: Random) -> bytes:
    """Text with values behind a sign of equality replaced, and lines left out, repeated or exchanged; or bytes."""
    if rng.random() < 0.15:
        return changed_bytes(data, rng)
    lines = data.decode().split("\n")
    for _ in range(rng.choice((1, 1, 2, 4))):
        i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
        key, equals, value = lines[i].partition("=")
        match rng.randrange(6):
            case 0:
                lines[i], lines[j] = lines[j], lines[i]
            case 1:
                lines.insert(j, lines[i])
            case 2 if len(lines) > 1:
                del lines[i]
            case 3:
                lines[i] = changed_text(lines[i], rng)
            case _ if equals:
                other = lines[j].partition("=")[2] or value
                lines[i] = f"{key}= {rng.choice((*_TOML, other))}"
    return "\n".join(lines).encode()


def changed_table(data: bytes, rng: Random) -> bytes:
    """CSV text with cells replaced, and lines or columns left out, repeated or exchanged; or bytes."""
    if rng.random() < 0.3:
        return changed_bytes(data, rng)
    rows = [line.split(",") for line in data.decode().split("\n")]
    odd = (
        "",
        "nan",
        "inf",
        "-1e308",
        "1e-320",
        "9" * 400,
        "x",
        '"',
        "1;2",
        "0x10",
        "1_0",
        "\0",
        "é",
        "1e999",
        "#",
        "t",
    )
    for _ in range(rng.choice((1, 2, 5, 30))):
        i, j = rng.randrange(len(rows)), rng.randrange(len(rows))
        k = rng.randrange(len(rows[i]))
        match rng.randrange(6):
            case 0 | 1 | 2:
                rows[i][k] = rng.choice(odd)
            case 3:
                rows[i], rows[j] = rows[j], rows[i]
            case 4:
                rows.insert(j, list(rows[i]))
            case _:
                rows[i].insert(k, rng.choice((rows[i][k], *odd)))
    return "\n".join(",".join(row) for row in rows).encode()


# Stores ---------------------------------------------------------------------------------------------------------------
_CELLS = ("NULL", "0", "-1", "9e999", "1e308", "'x'", "''", "9223372036854775807", "x'00ff'", "zeroblob(100000)",
          "'[[[['", "'{}'", "'nan'", "printf('%.*c', 100000, 'x')", "0.5")  # fmt: skip
_ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT * FROM n"


def _statements(tables: dict[str, list[str]], rng: Random) -> list[str]:
    """Statements that change tables, their columns, or the schema."""
    table = rng.choice(list(tables))
    column, other = rng.choice(tables[table]), rng.choice(tables[table])
    cell, some = rng.choice(_CELLS), f"WHERE rowid % {rng.choice((1, 2, 3))} = 0"
    values = ", ".join(rng.choice((rng.choice(_CELLS), f'"{name}"')) for name in tables[table])
    schema = "PRAGMA writable_schema = ON"
    choices = [
        [f'UPDATE OR IGNORE "{table}" SET "{column}" = {cell} {some}'],
        [f'UPDATE OR IGNORE "{table}" SET "{column}" = "{other}" {some}'],
        [f'INSERT OR REPLACE INTO "{table}" SELECT {values} FROM "{table}" LIMIT 3'],
        [f'DELETE FROM "{table}" {some}'],
        [f'DROP TABLE "{table}"'],
        [f'ALTER TABLE "{table}" RENAME TO "{rng.choice(("x", table.upper() + "2"))}"'],
        [f'ALTER TABLE "{table}" RENAME COLUMN "{column}" TO "{rng.choice(("x", "best_x", column + "~", ""))}"'],
        [f'ALTER TABLE "{table}" ADD COLUMN "{rng.choice(("x", "parameter_x", "low_mass", "square"))}" REAL'],
        [f'ALTER TABLE "{table}" ADD COLUMN g AS (randomblob(100000000))'],
        [f'ALTER TABLE "{table}" DROP COLUMN "{column}"'],
        [f'ALTER TABLE "{table}" RENAME TO old', f'CREATE VIEW "{table}" AS SELECT * FROM old'],
        [f'DROP TABLE "{table}"', f'CREATE VIEW "{table}" AS {_ENDLESS}'],
        [f'DROP TABLE "{table}"', f'CREATE TABLE "{table}" AS SELECT 1 AS x'],
        ["CREATE VIEW more AS SELECT 1"],
        [f'CREATE TRIGGER later AFTER INSERT ON "{table}" BEGIN DELETE FROM "{table}"; END'],
        [f'CREATE INDEX fast ON "{table}" ("{column}")'],
        ["CREATE VIRTUAL TABLE words USING fts5(x)"],
        [f"PRAGMA user_version = {rng.choice((-1, 0, 1, 2, 3, 2**31 - 1))}"],
        [f"PRAGMA application_id = {rng.choice((0, 0x6469726E, 0x64697266))}"],
        ["PRAGMA journal_mode = WAL", f'DELETE FROM "{table}" {some}'],
        ["PRAGMA encoding = 'UTF-16'", "VACUUM"],
        ["PRAGMA page_size = 512", "VACUUM"],
        [schema, f"UPDATE sqlite_master SET sql = replace(sql, '\"{column}\"', '\"{other}\"')"],
        [schema, f"UPDATE sqlite_master SET sql = {cell} WHERE name = '{table}'"],
        [schema, f"UPDATE sqlite_master SET rootpage = {rng.choice((0, 1, 2, 99))} WHERE name = '{table}'"],
        [schema, f"UPDATE sqlite_master SET type = '{rng.choice(('view', 'x'))}' WHERE name = '{table}'"],
        [schema, "INSERT INTO sqlite_master VALUES ('table', 'x', 'x', 0, 'CREATE VIRTUAL TABLE x USING csv')"],
    ]
    return rng.choice(choices[:3] * 6 + choices)


def _change_texts(connection: sqlite3.Connection, tables: dict[str, list[str]], rng: Random) -> None:
    """Change the JSON texts and the blobs of a table as data."""
    table = rng.choice(list(tables))
    for column in rng.sample(tables[table], rng.randint(1, len(tables[table]))):
        for number, value in connection.execute(f'SELECT rowid, "{column}" FROM "{table}"').fetchall():
            if isinstance(value, bytes):
                connection.execute(
                    f'UPDATE "{table}" SET "{column}" = ? WHERE rowid = ?', (changed_bytes(value, rng), number)
                )
            elif isinstance(value, str) and rng.random() < 0.5:
                try:
                    changed = as_json(changed_data(json.loads(value), rng))
                except (ValueError, RecursionError):
                    changed = changed_text(value, rng)
                text = changed.encode("utf-8", "replace").decode()
                connection.execute(f'UPDATE OR IGNORE "{table}" SET "{column}" = ? WHERE rowid = ?', (text, number))


def changed_store(data: bytes, rng: Random) -> bytes:
    """A store changed by SQL, by its JSON texts, or as bytes.  Statements that SQLite refuses change nothing."""
    if rng.random() < 0.25:
        return changed_bytes(data, rng)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.db"
        path.write_bytes(data)
        for _ in range(rng.choice((1, 1, 2, 4))):
            _change_store(path, rng)
        return path.read_bytes()


def _change_store(path: Path, rng: Random) -> None:
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        try:
            names = [name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
            tables = {name: [x[1] for x in connection.execute(f'PRAGMA table_info("{name}")')] for name in names}
            tables = {name: columns for name, columns in tables.items() if columns}
            if tables and rng.random() < 0.35:
                _change_texts(connection, tables, rng)
            elif tables:
                for statement in _statements(tables, rng):
                    connection.execute(statement)
        except sqlite3.Error:
            return


# Kinds of files -------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Command:
    """A command line over a file, the names of the files that it writes, and how often it is chosen."""

    words: tuple[str, ...]
    outputs: tuple[str, ...] = ()
    share: int = 1


def command(text: str, outputs: str = "", share: int = 1) -> Command:
    """The command of a text."""
    return Command(tuple(text.split()), tuple(outputs.split()), share)


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Parameters
    ----------
    name : of the file, with its ending
    data : of undamaged files
    changed : a mutation of the data by a random generator
    commands : command lines that read the file
    beside : further files by name
    memory : bytes that a command may take
    """

    name: str
    data: Sequence[bytes]
    changed: Callable[[bytes, Random], bytes]
    commands: Sequence[Command]
    beside: Mapping[str, bytes] = field(default_factory=dict)
    memory: int = MOST_MEMORY

    def place(self, folder: Path, data: bytes) -> None:
        """Write a file of the kind, and those beside it."""
        for name, content in {**self.beside, self.name: data}.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)

    def check(self, folder: Path, rng: Random) -> int:
        """Exit code of one command over one mutation.  Raises AssertionError: the rule is broken."""
        self.place(folder, self.changed(rng.choice(self.data), rng))
        (chosen,) = rng.choices(self.commands, [one.share for one in self.commands])
        return outcome(folder, chosen.words, chosen.outputs, self.memory)

    def undamaged(self, folder: Path) -> Iterator[tuple[Command, int]]:
        """Every command over every undamaged file that it has not had for another kind, and its exit code."""
        for data, one in itertools.product(self.data, self.commands):
            if (data, one.words) in _MET:
                continue
            _MET.add((data, one.words))
            self.place(folder, data)
            yield one, outcome(folder, one.words, one.outputs)


# Names ----------------------------------------------------------------------------------------------------------------
def changed_names(data: bytes, rng: Random) -> bytes:
    """A result in which one to four names, units or other texts are crafted ones, with a checksum that fits."""
    result = json.loads(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        model = result["model"]
        group = rng.choice(("coordinates", "inputs", "parameters"))
        if rng.random() < 0.4:
            result = _renamed(result, rng.choice(list(model[group])), rng.choice(NAMES))
            continue
        texts = [way for way in places(result) if isinstance(_at(result, way), str) and "operations" not in way]
        of_model = [way for way in texts if way[0] == "model"]
        *way, key = rng.choice(of_model if rng.random() < 0.8 else texts)
        _at(result, way)[key] = rng.choice(list(TEXTS.values()))
    return as_json(signed(result)).encode()


def _renamed(result: Any, old: str, new: str) -> Any:
    """A result with another name of a signal, and of its derivatives, wherever it stands alone."""
    quoted, given = json.dumps(old)[1:-1], json.dumps(new)[1:-1]
    text = re.sub(rf'"{re.escape(quoted)}(|_dot|_ddot)"', lambda found: f'"{given}{found[1]}"', json.dumps(result))
    return json.loads(text)
