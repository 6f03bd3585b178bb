"""The command ``simulate``."""

from __future__ import annotations

import typer

from diransac.cli import screen
from diransac.cli.arguments import load_model, model_file
from diransac.cli.flight_options import (
    FlightPicture,
    FlightSeed,
    LogOutput,
    NoiseOptions,
    PlantOptions,
    TrajectoryArgument,
)
from diransac.cli.group import grouped
from diransac.cli.options import JsonFlag, ModelName
from diransac.cli.outputs import staged

__all__ = ["app"]

app = typer.Typer(add_completion=False)


@app.command("simulate")
@grouped
def _simulate(
    shape: TrajectoryArgument,
    plant: PlantOptions,
    noise_options: NoiseOptions,
    output: LogOutput,
    model: ModelName = "planar-rotorcraft",
    plot: FlightPicture = None,
    seed: FlightSeed = 0,
    as_json: JsonFlag = False,
) -> None:
    """Plan and fly a trajectory, and write its log with noise and faults."""
    from diransac.cli.flight_runs import simulate_flight

    noise = noise_options.noise()
    with staged([output, plot], [model_file(model)]) as (written, picture):
        known = load_model(model)
        simulated = simulate_flight(shape, known, plant.of(known), noise, seed)
        simulated.log.write(written)
        if plot:
            simulated.flight.draw(picture)
        screen.show(simulated, as_json)
