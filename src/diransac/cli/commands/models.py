"""The command ``models``."""

from __future__ import annotations

from typing import Annotated

import typer

from diransac.cli import screen
from diransac.cli.group import grouped
from diransac.cli.options import JsonFlag
from diransac.cli.robot_options import RobotOptions
from diransac.cli.views import Equations, ModelList

__all__ = ["app"]

app = typer.Typer(add_completion=False)


@app.command("models")
@grouped
def _models(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME|FILE.py[:NAME]|FILE.xml", help="Show the equations of one.")
    ] = None,
    *,
    robot: RobotOptions,
    as_json: JsonFlag = False,
) -> None:
    """List the built-in models, or show the equations of one."""
    screen.show(ModelList() if name is None else Equations(robot.load(name)), as_json)
