"""Models by file, and definitions in users' Python files, with the output of their code kept off the terminal.

Stdout is for results and stderr for a few lines; text that a user's own code prints goes to neither.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import runpy
import sys
import threading
import traceback
import types
from collections.abc import Iterator, Mapping
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

from diransac.errors import DiransacError, ModelError

CONFIRMED = "DIRANSAC_CODE_SHA256"
"""Environment variable with the SHA-256 of the only code that may be run, empty for none; any code where it is not set.

The studio sets it for its commands.
"""

_ALONE = threading.RLock()
"""Held without output, and while users' code runs, which may run more of it: threads share stdout and stderr."""

_STDOUT, _STDERR = 1, 2


def file_and_name(text: str, default: str) -> tuple[Path, str] | None:
    """File and name of ``file.py[:name]``, with ``default`` for an absent name; None for text of another form."""
    match = re.fullmatch(r"([^\0\n]+\.py)(?::(\w+))?", text)
    return None if match is None else (Path(match[1]), match[2] or default)


def is_description(text: str) -> bool:
    """True for the name of a robot's description; one in Xacro or SDF is refused with what to do where it is read."""
    return Path(text).suffix.lower() in (".xml", ".mjcf", ".urdf", ".xacro", ".sdf")


def definitions(file: Path, what: str) -> Mapping[str, object]:
    """Objects that a file defines, by name.

    The file is run; it can import its neighbours, and its output is dropped.

    Parameters
    ----------
    file : Path
    what : str
        Kind of object that the file is to define, for messages, such as ``"model"``.

    Raises
    ------
    ModelError
        There is no such file, or it cannot be run; the message names the line.
    """
    if not file.is_file():
        raise ModelError(f'{what} file "{file}" does not exist; give a built-in name or file.py[:name]')
    with running(file, what):
        name, confirmed = f"diransac_{what}_file", os.environ.get(CONFIRMED)
        return runpy.run_path(str(file), run_name=name) if confirmed is None else _confirmed(file, name, confirmed)


def _confirmed(file: Path, name: str, digest: str) -> Mapping[str, object]:
    """Objects that a file defines whose bytes have a digest; those bytes are run, whatever the file has become since.

    Raises ModelError: it has another digest.
    """
    content = file.read_bytes()
    if hashlib.sha256(content).hexdigest() != digest:
        raise ModelError("it is not the program that was confirmed; read and confirm it again")
    module = types.ModuleType(name)
    module.__file__ = str(file)
    before = sys.modules.get(name)
    sys.modules[name] = module  # where pickles and dataclasses look for it
    try:
        exec(compile(content, str(file), "exec", dont_inherit=True), vars(module))  # noqa: S102  # it is confirmed
    finally:
        if before is None:
            del sys.modules[name]
        else:
            sys.modules[name] = before
    return dict(vars(module))


@contextlib.contextmanager
def running(file: Path, what: str) -> Iterator[None]:
    """Context for a file's own code, one thread at a time: neighbours importable, no output, errors name the file."""
    with silenced(), blaming(file, what), _importable(file.resolve().parent):
        yield


@contextlib.contextmanager
def blaming(file: Path, what: str) -> Iterator[None]:
    """Context that turns every error into a ModelError of one line, which names the file and its line."""
    try:
        yield
    except KeyboardInterrupt:
        raise
    except DiransacError as error:
        raise ModelError(f'{what} file "{file}"{_line(error, file)}: {" ".join(str(error).split())}') from error
    except BaseException as error:
        raise ModelError(f'{what} file "{file}"{_line(error, file)}: {in_words(error)}') from error


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
    """``, line 12`` for an error that arose in the user's file; empty otherwise."""
    if isinstance(error, SyntaxError):
        return f", line {error.lineno}" if error.lineno else ""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(file)]
    return f", line {lines[-1]}" if lines else ""


def in_words(error: BaseException) -> str:
    """Class and message of an error of users' code, without line breaks; a class of their own may have no message."""
    try:
        said = str(error.msg if isinstance(error, SyntaxError) else error)
    except Exception:  # noqa: BLE001  # users' code raises anything
        said = "it has no message"
    return f"{type(error).__name__}: {' '.join(said.split())}"


# ---------------------------------------------------------------------- output


@contextlib.contextmanager
def silenced() -> Iterator[None]:
    """Context without output of the process, in whatever language it is written; ``--debug`` sends it to stderr.

    It acts on all threads. One at a time enters it: the later of two would restore the earlier's state.
    """
    with _ALONE, _without_output():
        yield


@contextlib.contextmanager
def _without_output() -> Iterator[None]:
    """Context of `silenced`."""
    _flush()
    kept = {channel: os.dup(channel) for channel in (_STDOUT, _STDERR) if _is_open(channel)}
    sink = os.dup(_STDERR) if "--debug" in sys.argv and _STDERR in kept else os.open(os.devnull, os.O_WRONLY)
    try:
        for channel in kept:
            os.dup2(sink, channel)
        with redirect_stdout(sys.stdout), redirect_stderr(sys.stderr):  # user's code may assign to them
            yield
    finally:
        _flush()
        for channel, copy in kept.items():
            os.dup2(copy, channel)
            os.close(copy)
        os.close(sink)


def leave_stdout() -> None:
    """Drop all later output on stdout, such as that of exit handlers in users' code."""
    sink = os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, _STDOUT)


def _is_open(channel: int) -> bool:
    try:
        os.fstat(channel)
    except OSError:
        return False
    return True


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:  # where a process has none
            stream.flush()
