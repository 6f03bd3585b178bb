"""Output files: checked before the work, and either complete or absent after it."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence, Set
from contextlib import ExitStack, contextmanager
from pathlib import Path

from diransac.atomic import draft
from diransac.cli.screen import copy, stdout_taken
from diransac.data.files import put_in_place
from diransac.errors import DiransacError, ResultError

STDOUT = Path("-")
"""Name of stdout among outputs, and of stdin among logs."""
PAGE = (".html", ".htm")
"""Endings of pages."""


def checked(outputs: Sequence[Path | None], inputs: Sequence[Path | None] = ()) -> list[Path | None]:
    """The outputs' places, where each can be written.

    Parameters
    ----------
    outputs : sequence of Path or None
        Files to write; None where an output is not requested.
    inputs : sequence of Path or None, optional
        Files that the command reads, none of which may be an output.

    Returns
    -------
    list of Path or None

    Raises
    ------
    ResultError
        An output's folder is missing or not writable, or an output is not an ordinary file, or is an input.
    """
    sources = {_followed(path) for path in inputs if path is not None}
    targets = [None if path is None else _place(path, sources) for path in outputs]
    named = [path for path in targets if path is not None]
    if len(set(named)) < len(named):
        raise ResultError(f'two outputs go to "{named[0]}"; give each a file of its own')
    return targets


def check_ending(output: Path | None, endings: Sequence[str]) -> None:
    """Raise ResultError: the ending of an output is not that of the format in which it is written.

    Parameters
    ----------
    output : Path or None
    endings : sequence of str
        Of this format.
    """
    if output is not None and output != STDOUT and output.suffix.lower() not in endings:
        raise ResultError(f'output "{output}" does not end in {" or ".join(endings)}, the format that is written')


@contextmanager
def staged(outputs: Sequence[Path | None], inputs: Sequence[Path | None] = ()) -> Iterator[list[Path]]:
    """Context with temporary files beside the outputs, which they replace together when the block succeeds.

    Parameters
    ----------
    outputs : sequence of Path or None
        Files to write; None where an output is not requested.
    inputs : sequence of Path or None, optional
        Files that the command reads, none of which may be an output.

    Yields
    ------
    list of Path
        Temporary file of each output; an empty path where it is not requested.

    Raises
    ------
    ResultError
        As `checked`.
    """
    targets = checked(outputs, inputs)
    with ExitStack() as folders:
        if STDOUT in outputs:
            folders.enter_context(stdout_taken())
        drafts = [Path() if path is None else _made(path, folders) for path in targets]
        with _naming(dict(zip(drafts, outputs, strict=True))):
            yield drafts
        for written, target in zip(drafts, targets, strict=True):
            if target == STDOUT:
                copy(written.read_bytes())
            elif target is not None:
                if target.exists():
                    written.chmod(target.stat().st_mode)
                put_in_place(written, target)


@contextmanager
def _naming(outputs: Mapping[Path, Path | None]) -> Iterator[None]:
    """Context whose errors name the outputs in place of their drafts."""
    try:
        yield
    except DiransacError as error:
        message = str(error)
        for written, output in outputs.items():
            if output is not None:
                message = message.replace(str(written), str(output))
        if message == str(error):
            raise
        raise type(error)(message) from error


def _made(target: Path, folders: ExitStack) -> Path:
    """The draft of a file, empty; of stdout, one that ends as a log of text does."""
    if target == STDOUT:
        return Path(folders.enter_context(tempfile.TemporaryDirectory())) / "stdout.csv"
    try:
        found = folders.enter_context(draft(target))
        found.touch()
    except OSError as error:
        raise ResultError(f'output "{target}" cannot be written: {error.strerror}; choose another place') from error
    return found


def _followed(path: Path) -> Path:
    """The place to which symbolic links lead; one of them where they lead round in a loop."""
    return Path(os.path.realpath(path))


def _place(path: Path, sources: Set[Path]) -> Path:
    if path == STDOUT:
        return path
    target = _followed(path)
    if target.is_symlink():
        raise ResultError(f'output "{path}" is a loop of symbolic links; remove it, or choose another place')
    if target.exists() and not target.is_file():
        raise ResultError(f'output "{path}" is not an ordinary file; give the name of a file')
    for folder in (path.parent, target.parent):  # a/../b is b, also where there is no a
        if not folder.is_dir():
            raise ResultError(f'output "{path}": the folder "{folder}" does not exist; make it first')
    if not os.access(target.parent, os.W_OK | os.X_OK) or (target.exists() and not os.access(target, os.W_OK)):
        raise ResultError(f'output "{path}" cannot be written: permission denied; choose another folder')
    if target in sources:
        raise ResultError(f'output "{path}" is a file that this command reads; give it another name')
    return target
