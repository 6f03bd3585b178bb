"""The commands ``simulate``, which writes a noisy log, and ``fly``, which tests an identified model."""

from __future__ import annotations

import typer

from diransac.cli import screen
from diransac.cli.arguments import load_model, model_file
from diransac.cli.flight_options import (
    FlightPicture,
    FlightSeed,
    LogOutput,
    NoiseOptions,
    OptionalLogOutput,
    PlantOptions,
    TrajectoryArgument,
    TrajectoryOption,
)
from diransac.cli.group import grouped
from diransac.cli.options import JsonFlag, ModelName, ResultFile
from diransac.cli.outputs import staged
from diransac.identification.result import Result

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
