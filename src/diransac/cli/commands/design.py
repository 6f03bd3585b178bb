"""The command ``design``."""

from __future__ import annotations

import typer

from diransac.cli import screen
from diransac.cli.design import DesignedModel, DesignOptions, designed, source_of
from diransac.cli.flight_options import FlightPicture, LogOutput
from diransac.cli.group import grouped
from diransac.cli.options import JsonFlag
from diransac.cli.outputs import staged
from diransac.cli.robot_options import RobotOptions

app = typer.Typer(add_completion=False)


@app.command("design")
@grouped
def _design(
    model: DesignedModel,
    robot: RobotOptions,
    options: DesignOptions,
    output: LogOutput,
    plot: FlightPicture = None,
    as_json: JsonFlag = False,
) -> None:
    """Design a motion within limits from which parameters are identified best, and predict their standard errors."""
    with staged([output, plot], [source_of(model)]) as (written, picture):
        designs = designed(model, robot, options)
        designs.log(designs.motion).write(written)
        if plot:
            designs.draw(picture)
        screen.show(designs, as_json)
