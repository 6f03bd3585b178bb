"""Printed output: results on stdout, progress and errors on stderr; all of it without control characters."""

from __future__ import annotations

import os
import shlex
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol, TextIO

import typer

from diransac.identification.method import Callback, Progress
from diransac.plain_data import json_text
from diransac.plain_text import one_line, printable
from diransac.time_limit import end_search

_FIRST_LINE = 5.0
"""Seconds until the first line of progress without a terminal."""


@dataclass
class _State:
    """Of the command that this process runs: its words, and what `begin` sets; the outputs that are on stdout."""

    words: Sequence[str] = ()
    verbosity: int = 0
    for_programs: bool = False
    taken: int = 0


_STATE = _State()


def begin(words: Sequence[str] = (), verbosity: int = 0, *, for_programs: bool = False) -> None:
    """Set what is printed of a command, and how much.

    Parameters
    ----------
    words : sequence of str
        After the program's name.
    verbosity : int
        -1: results that are asked for as JSON, and errors; 0: results and progress; 1: a line for every stage.
    for_programs : bool
        Whether progress is written as JSON lines on stderr, and a line ``stop`` on stdin ends a search.
    """
    _STATE.words, _STATE.verbosity, _STATE.for_programs = words, verbosity, for_programs


class Showable(Protocol):
    """An object that prints as text and as JSON."""

    def to_dict(self) -> dict[str, Any]:
        """The contents of the text."""

    def __str__(self) -> str: ...


def show(shown: Showable, as_json: bool) -> None:
    """Print on stdout.

    Parameters
    ----------
    shown : Showable
    as_json : bool
        Whether to print JSON, in which numbers that are not finite are null.
    """
    if not as_json:
        say(*str(shown).split("\n"))
        return
    if _STATE.taken:
        raise typer.BadParameter("-o - and --json both write to stdout; give one")
    typer.echo(printable(json_text(shown.to_dict(), indent=1)))


def emit(data: Mapping[str, Any]) -> None:
    """Print JSON on one line of stdout, at once; numbers that are not finite are null.

    Parameters
    ----------
    data : mapping
    """
    typer.echo(printable(json_text(data)))
    sys.stdout.flush()


def say(*lines: str) -> None:
    """Print lines on stdout; on stderr where an output is written to stdout; nowhere if quiet.

    Parameters
    ----------
    *lines : str
        A line break within one is no other line.
    """
    if not is_quiet():
        typer.echo(printable("\n".join(map(one_line, lines))), err=bool(_STATE.taken))


def note(*lines: str) -> None:
    """Print lines on stderr.

    Parameters
    ----------
    *lines : str
        As in `say`.
    """
    typer.echo(printable("\n".join(map(one_line, lines))), err=True)


def copy(content: bytes) -> None:
    """Write an output to stdout as it is; to a terminal as printable text.

    Parameters
    ----------
    content : bytes
    """
    typer.echo(printable(content.decode(errors="replace")) if is_terminal(sys.stdout) else content, nl=False)


def is_terminal(stream: TextIO | None) -> bool:
    """True for a stream that a terminal shows.

    Parameters
    ----------
    stream : text stream, optional
        None: a process without it.
    """
    return stream is not None and stream.isatty()


def command() -> str:
    """The command that this process runs, as a shell takes it."""
    return shlex.join(["diransac", *_STATE.words])


def is_quiet() -> bool:
    """True if there is no progress and no text."""
    return _STATE.verbosity < 0


@contextmanager
def stdout_taken() -> Iterator[None]:
    """Context in which an output is written to stdout, and all text goes to stderr."""
    _STATE.taken += 1
    try:
        yield
    finally:
        _STATE.taken -= 1


def end(verdict: str, strict: bool) -> None:
    """End a command, after all of its output, with exit code 3 if it is strict and the verdict is the worst.

    Parameters
    ----------
    verdict : str
        As `Result.verdict`.
    strict : bool
        Whether a verdict has an exit code of its own.
    """
    if strict and verdict == "do not rely on this":
        raise typer.Exit(3)


@contextmanager
def bar(label: str) -> Iterator[Callback]:
    """Context with a callback for progress: a bar on a terminal's stderr, a line every ten seconds elsewhere.

    Parameters
    ----------
    label : str
        Name of the work.

    Yields
    ------
    callable
        Takes a `Progress`.
    """
    with _bar(label) as show:

        def warned(found: Progress) -> None:
            if found.warning and not (_STATE.for_programs or is_quiet()):
                note(f"{label}: {found.warning}")
            show(found)

        yield warned


@contextmanager
def _bar(label: str) -> Iterator[Callback]:
    """As `bar`, without warnings."""
    if _STATE.for_programs:
        threading.Thread(target=_heed_stop, daemon=True).start()
        yield lambda found: note(json_text({"label": label, **vars(found)}))
        return
    if is_quiet():
        yield lambda _: None
        return
    if _STATE.verbosity > 0:
        yield Stages(label).show
        return
    if not shows_bars():
        lines = Lines(label)
        yield lambda found: lines.show(found.stage, found.fraction)
        return
    from rich import progress

    with progress_bar(progress.TaskProgressColumn()) as shown:
        task = shown.add_task(printable(one_line(label)), total=1.0)

        def update(found: Progress) -> None:
            about = f" ({found.note})" if found.note else ""
            shown.update(
                task, completed=found.fraction, description=printable(one_line(f"{label}: {found.stage}{about}"))
            )

        yield update


def _heed_stop() -> None:
    """End the search at a line ``stop`` on stdin."""
    for line in sys.stdin or ():
        if line.strip() == "stop":
            end_search()


@contextmanager
def live() -> Iterator[Callable[[str], None]]:
    """Context with a callback that replaces a line on a terminal's stderr; without a terminal it shows nothing.

    Yields
    ------
    callable
        Takes the line.
    """
    if is_quiet() or not shows_bars():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    with Live(Text(""), console=Console(stderr=True), transient=True, auto_refresh=False) as shown:
        yield lambda line: shown.update(
            Text(printable(one_line(line)), no_wrap=True, overflow="ellipsis"), refresh=True
        )


def shows_bars() -> bool:
    """True where stderr is a terminal, or ``FORCE_COLOR`` says so."""
    return is_terminal(sys.stderr) or (sys.stderr is not None and bool(os.environ.get("FORCE_COLOR")))


def progress_bar(*columns: Any, **options: Any) -> Any:
    """Bar of Rich on stderr, a context: a description, which is no markup, the bar, columns, and the time left.

    Parameters
    ----------
    *columns : rich.progress.ProgressColumn
    **options
        Of `rich.progress.Progress`.

    Returns
    -------
    rich.progress.Progress
    """
    from rich import progress
    from rich.console import Console

    first = progress.TextColumn("{task.description}", markup=False), progress.BarColumn()
    last = progress.TimeRemainingColumn()
    return progress.Progress(*first, *columns, last, console=Console(stderr=True), transient=True, **options)


class Stages:
    """Progress as a line on stderr for every stage.

    Parameters
    ----------
    label : str
        Name of the work.
    """

    def __init__(self, label: str) -> None:
        self._label, self._begin, self._last = label, time.monotonic(), ""

    def show(self, found: Progress) -> None:
        """Print a line if the stage is another one.

        Parameters
        ----------
        found : Progress
        """
        if found.stage != self._last:
            self._last = found.stage
            elapsed = time.monotonic() - self._begin
            note(f"{self._label}: {elapsed:7.2f} s  {found.fraction:4.0%}  {found.stage}")


class Lines:
    """Progress without a terminal: nothing for the first five seconds, then a line on stderr every ten seconds.

    Parameters
    ----------
    label : str
        Name of the work.
    """

    def __init__(self, label: str) -> None:
        self._label, self._begin = label, time.monotonic()
        self._next = _FIRST_LINE

    def show(self, stage: str, fraction: float) -> None:
        """Print a line if it is time.

        Parameters
        ----------
        stage : str
            What is done, or how much.
        fraction : float
            Completed fraction of the whole work.
        """
        elapsed = time.monotonic() - self._begin
        if elapsed < self._next or sys.stderr is None:
            return
        self._next = elapsed + 10.0
        left = f", about {elapsed * (1.0 / fraction - 1.0):.0f} s left" if fraction > 0.0 else ""
        note(f"{self._label}: {stage}, {fraction:.0%} after {elapsed:.0f} s{left}")
