"""The command line; commands on one subject are a module of this package."""

from __future__ import annotations

from typing import Annotated

import typer

from diransac.cli import screen
from diransac.cli.group import Group

__all__ = ["app"]

app = typer.Typer(
    cls=Group,
    name="diransac",
    help="Turn a messy log of a moving machine into a dynamical model, and say how far it can be trusted.",
    invoke_without_command=True,
    pretty_exceptions_enable=False,
)


@app.callback()
def _diransac(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    _debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error, after any command.")] = False,
    _quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no text; anywhere.")] = False,
    _verbose: Annotated[bool, typer.Option("--verbose", "-v", help="A line for every stage; anywhere.")] = False,
    _programs: Annotated[
        bool, typer.Option("--progress-json", help="Progress as JSON lines, ended by a line stop; anywhere.")
    ] = False,
) -> None:
    if version:
        from importlib.metadata import version as version_of

        screen.copy(f"diransac {version_of('diransac')}\n".encode())
        raise typer.Exit
    if context.invoked_subcommand is None:
        context.fail(f"Give a command: {', '.join(sorted(context.command.list_commands(context)))}.")  # type: ignore[attr-defined]
