"""The command line: parse, call, print.

In come words; out come lines, files and an exit code.  Begin with `commands/`, which has the commands by subject.

| file | contents |
|---|---|
| `commands/` | the commands |
| `options.py`, `robot_options.py`, `flight_options.py` | options that several commands share |
| `arguments.py` | models, methods and settings from text |
| `screen.py`, `outputs.py` | what is printed; files that are written |
| `rows.py`, `tracking.py` | work that is kept as rows of a store; the tracker over a file |
| `attached.py` | the command line for as long as another process lives |
"""

import gc
import os
import sys
import warnings
from contextlib import suppress
from types import TracebackType
from typing import TextIO

from diransac.plain_text import printable

__all__ = ["INTERRUPTED", "main"]

INTERRUPTED = 130
"""Exit code after Ctrl-C."""


def main() -> None:
    """Run the command line of this process, and end the process with its exit code."""
    sys.excepthook = _show_traceback if "--debug" in sys.argv else _report_internal_error
    warnings.showwarning = _show_warning
    # New objects between two garbage collections: those of imported modules live as long as the process of a
    # command.
    gc.set_threshold(100_000)
    from diransac.cli.commands import app
    from diransac.user_files import leave_stdout

    try:
        app()
    except SystemExit as end:
        if end.code == INTERRUPTED:
            _end_now()
        raise
    finally:
        leave_stdout()
        gc.freeze()  # the memory of a process that ends needs no garbage collection


def _end_now() -> None:
    """End the process without waiting for threads in LLVM or in compiled loops, which no signal reaches."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, OSError, ValueError):  # absent, broken or closed
            stream.flush()
    os._exit(INTERRUPTED)


def _report_internal_error(kind: type[BaseException], error: BaseException, _: TracebackType | None) -> None:
    """Print one line for an unexpected error."""
    if issubclass(kind, KeyboardInterrupt):
        _print("interrupted")
        sys.exit(INTERRUPTED)
    _print(f"internal error: {kind.__name__}: {error}; --debug shows where. Please report it")


def _show_traceback(kind: type[BaseException], error: BaseException, where: TracebackType | None) -> None:
    """Print all of an error."""
    import traceback

    _print("".join(traceback.format_exception(kind, error, where)).rstrip())


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,  # noqa: ARG001  as Python calls it
    line: str | None = None,
) -> None:
    """Print a warning of a library."""
    _print(warnings.formatwarning(message, category, filename, lineno, line).rstrip())


def _print(text: str) -> None:
    """Print on stderr, also before there is a command line to print with."""
    print(printable(text), file=sys.stderr)  # noqa: T201
