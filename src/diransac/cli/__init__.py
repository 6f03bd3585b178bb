"""The command line: parse, call, print."""

import gc
import os
import sys
from contextlib import suppress
from types import TracebackType

__all__ = ["INTERRUPTED", "main"]

INTERRUPTED = 130
"""Exit code after Ctrl-C."""

_ALLOCATIONS = 10_000
"""New objects between two garbage collections: those of imported modules live as long as the process of a command."""


def main() -> None:
    """Run the command line of this process, and end the process with its exit code."""
    if "--debug" not in sys.argv:
        sys.excepthook = _report_internal_error
    gc.set_threshold(_ALLOCATIONS)
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
        print("interrupted", file=sys.stderr)  # noqa: T201  before there is a command line to print with
        sys.exit(INTERRUPTED)
    print(f"internal error: {kind.__name__}: {error}; --debug shows where. Please report it", file=sys.stderr)  # noqa: T201
