"""The command ``predict``."""

from __future__ import annotations

from typing import Annotated

import typer

from diransac.cli import screen
from diransac.cli.arguments import numbers
from diransac.cli.flight_options import FlightPicture, LogOutput
from diransac.cli.group import grouped
from diransac.cli.options import Derivation, LogFile, Preparation, ResultFile
from diransac.cli.outputs import staged
from diransac.data.preprocessing import in_units
from diransac.identification.result import Result

__all__ = ["app"]

app = typer.Typer(add_completion=False)


@app.command("predict")
@grouped
def _predict(
    model: ResultFile,
    file: LogFile,
    output: LogOutput,
    derivation: Derivation,
    preparation: Preparation,
    horizon: Annotated[
        float | None, typer.Option(metavar="S", help="Restart from the log's states after so long.")
    ] = None,
    initial: Annotated[
        list[str] | None, typer.Option("--initial", metavar="NAME=VALUE,...", help="Initial states: x=0,x_dot=0.")
    ] = None,
    plot: FlightPicture = None,
) -> None:
    """Simulate an identified model over the inputs of a log, and write the simulated signals."""
    from diransac.identification.assessment.open_loop import simulate

    derivation.check()
    start = numbers("--initial", initial) if initial else None
    with staged([output, plot], [model, file]) as (written, picture):
        result = Result.load(model)
        log = preparation.read(file, result.logs[0].preparation)
        simulated = simulate(result, log, initial_state=start, horizon=horizon)
        simulated.write(written)
        if plot:
            from diransac.plots.prediction import plot_prediction

            plot_prediction(
                simulated, in_units(log, result.model), result.model.state, tuple(result.model.inputs), picture
            )
        screen.say(f"wrote {output}: {len(simulated)} rows", *simulated.notes)
