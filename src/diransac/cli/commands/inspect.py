"""The command ``inspect``."""

from __future__ import annotations

import typer

from diransac.cli import screen
from diransac.cli.arguments import preparation_of
from diransac.cli.group import grouped
from diransac.cli.options import JsonFlag, LogFile, OptionalModelName, Preparation
from diransac.cli.robot_options import RobotOptions
from diransac.cli.views import Recorded
from diransac.data.readers import read_topics
from diransac.identification.assessment.inspection import inspect

__all__ = ["app"]

app = typer.Typer(add_completion=False)


@app.command("inspect")
@grouped
def _inspect(
    file: LogFile,
    preparation: Preparation,
    robot: RobotOptions,
    model: OptionalModelName = None,
    as_json: JsonFlag = False,
) -> None:
    """Show what a log holds, what is odd about it, and what is missing for a model."""
    plant = None if model is None else robot.load(model)
    like = preparation_of(model)
    topics = read_topics(file)
    if topics is None or preparation.names_signals or any(step["step"] == "map" for step in like):
        screen.show(inspect(preparation.read_uneven(file, like), plant), as_json)
    else:
        screen.show(Recorded.of(topics, plant), as_json)
