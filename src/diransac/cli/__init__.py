"""The command line: parse, call, print."""

import sys
from types import TracebackType

__all__ = ["main"]


def main() -> None:
    """Run the command line of this process, and end the process with its exit code."""
    if "--debug" not in sys.argv:
        sys.excepthook = _report_internal_error
    from diransac.cli.commands import app
    from diransac.user_files import leave_stdout

    try:
        app()
    finally:
        leave_stdout()


def _report_internal_error(kind: type[BaseException], error: BaseException, _: TracebackType | None) -> None:
    """Print one line for an unexpected error."""
    if issubclass(kind, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)  # noqa: T201  before there is a command line to print with
        sys.exit(130)
    print(f"internal error: {kind.__name__}: {error}; --debug shows where. Please report it", file=sys.stderr)  # noqa: T201
