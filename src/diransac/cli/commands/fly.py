"""The command ``fly``."""

from __future__ import annotations

import typer

from diransac.cli import screen
from diransac.cli.flight_options import FlightPicture, FlightSeed, OptionalLogOutput, PlantOptions, TrajectoryOption
from diransac.cli.group import grouped
from diransac.cli.options import JsonFlag, ResultFile
from diransac.cli.outputs import staged
from diransac.identification.result import Result

__all__ = ["app"]

app = typer.Typer(add_completion=False)


@app.command("fly")
@grouped
def _fly(
    model: ResultFile,
    shape: TrajectoryOption,
    plant: PlantOptions,
    output: OptionalLogOutput = None,
    plot: FlightPicture = None,
    seed: FlightSeed = 0,
    as_json: JsonFlag = False,
) -> None:
    """Plan and control with an identified model, fly the true plant, and show the tracking error."""
    from diransac.cli.flight_runs import fly_identified

    with staged([output, plot], [model]) as (written, picture):
        result = Result.load(model)
        test = fly_identified(shape, result, plant.of(result.model), seed)
        if output:
            test.flight.log.write(written)
        if plot:
            test.flight.draw(picture)
        screen.show(test, as_json)
