"""Python files of users: they are run, and what they define is used."""

from __future__ import annotations

import contextlib
import re
import runpy
import sys
import threading
import traceback
from collections.abc import Iterator, Mapping
from pathlib import Path

from diransac.errors import DiransacError, ModelError
from diransac.silence import silenced

__all__ = ["blaming", "definitions", "file_and_name", "running"]

_ALONE = threading.RLock()
"""Held while users' code runs, which may run more of it: threads share stdout, stderr and the module path."""

_FILE = re.compile(r"([^\0\n]+\.py)(?::(\w+))?")


def file_and_name(text: str, default: str) -> tuple[Path, str] | None:
    """The two parts of ``file.py[:name]``, the default for a name that isn't there; None for text of another form."""
    match = _FILE.fullmatch(text)
    return None if match is None else (Path(match[1]), match[2] or default)


def definitions(file: Path, what: str) -> Mapping[str, object]:
    """What a file defines, by name; it may import its neighbours, and what it prints is not shown.

    Parameters
    ----------
    file : it is run
    what : such as "model": what it is to define

    Raises ModelError: there is no such file, or it cannot be run; it says in which line.
    """
    if not file.is_file():
        raise ModelError(f'{what} file "{file}" does not exist; give a built-in name or file.py[:name]')
    with running(file, what):
        return runpy.run_path(str(file), run_name=f"diransac_{what}_file")


@contextlib.contextmanager
def running(file: Path, what: str) -> Iterator[None]:
    """A file's own code, one thread at a time: it can import its neighbours, nothing is shown, and errors name it."""
    with _ALONE, blaming(file, what), _importable(file.resolve().parent), silenced():
        yield


@contextlib.contextmanager
def blaming(file: Path, what: str) -> Iterator[None]:
    """Whatever is raised meanwhile is a ModelError of one line of text, which names the file and its line."""
    try:
        yield
    except DiransacError as error:
        raise ModelError(f'{what} file "{file}"{_line(error, file)}: {_in_one_line(error)}') from error
    except (Exception, SystemExit) as error:
        found = error.msg if isinstance(error, SyntaxError) else error
        said = f"{type(error).__name__}: {_in_one_line(found)}"
        raise ModelError(f'{what} file "{file}"{_line(error, file)}: {said}') from error


@contextlib.contextmanager
def _importable(folder: Path) -> Iterator[None]:
    """A folder on the module path; no bytecode is left in it."""
    path, keep = list(sys.path), sys.dont_write_bytecode
    sys.path.insert(0, str(folder))
    sys.dont_write_bytecode = True
    try:
        yield
    finally:
        sys.path[:], sys.dont_write_bytecode = path, keep


def _line(error: BaseException, file: Path) -> str:
    """``, line 12``: where in the user's file an error arose; nothing where it did not."""
    if isinstance(error, SyntaxError):
        return f", line {error.lineno}" if error.lineno else ""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(file)]
    return f", line {lines[-1]}" if lines else ""


def _in_one_line(said: object) -> str:
    """Text without line breaks."""
    return " ".join(str(said).split())
