"""The commands that use a result: ``validate``, ``predict``, ``view`` and ``export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diransac.cli import screen
from diransac.cli.arguments import numbers
from diransac.cli.commands import grouped
from diransac.cli.flight_options import FlightPicture, LogOutput
from diransac.cli.options import (
    Derivation,
    JsonFlag,
    LogFile,
    LogFiles,
    Preparation,
    Report,
    ResultFile,
    StrictFlag,
    output_file,
    output_or_stdout,
)
from diransac.cli.outputs import PAGE, check_ending, staged
from diransac.errors import SettingsError
from diransac.identification.result import Result

app = typer.Typer(add_completion=False)


@app.command("validate")
@grouped
def _validate(
    model: ResultFile,
    files: LogFiles,
    derivation: Derivation,
    preparation: Preparation,
    horizon: Annotated[float | None, typer.Option(metavar="S", help="Restart the simulation after so long.")] = None,
    report: Report = None,
    as_json: JsonFlag = False,
    strict: StrictFlag = False,
) -> None:
    """Predict other logs with an identified model, open loop."""
    from diransac.identification.assessment.validation import validate

    derivation.check()
    check_ending(report, PAGE)
    with staged([report], [model, *files]) as (page,):
        result = Result.load(model)
        logs = preparation.read_all(files, result.logs[0].preparation)
        found = validate(result, logs, horizon)
        if report:
            from diransac.report import write_report

            write_report(result, logs, page, horizon=horizon, command=screen.command())
        screen.show(found, as_json)
    screen.end(found.verdict, strict)


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
        list[str] | None, typer.Option(metavar="NAME=VALUE,...", help="Initial states: x=0,x_dot=0.")
    ] = None,
    plot: FlightPicture = None,
) -> None:
    """Simulate an identified model over the inputs of a log, and write the simulated signals."""
    from diransac.data.preprocessing import in_units
    from diransac.identification.assessment.open_loop import simulate

    derivation.check()
    start = numbers("--initial", initial) if initial else None
    with staged([output, plot], [model, file]) as (written, picture):
        result = Result.load(model)
        log = preparation.read(file, result.logs[0].preparation)
        simulated = simulate(result, log, initial_state=start, horizon=horizon)
        simulated.write(written)
        if plot:
            from diransac.plots.flight import plot_prediction

            plot_prediction(
                simulated, in_units(log, result.model), result.model.state, tuple(result.model.inputs), picture
            )
        screen.say(f"wrote {output}: {len(simulated)} rows", *simulated.notes)


@app.command("view")
@grouped
def _view(
    model: ResultFile,
    files: LogFiles,
    derivation: Derivation,
    preparation: Preparation,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", parser=output_file, metavar="FILE.rrd", help="Where to write it; else MODEL.rrd."
        ),
    ] = None,
) -> None:
    """Write a result and logs for the Rerun viewer: measured, predicted and unmodelled, over time."""
    from diransac.report.viewer import write_recording

    derivation.check()
    target = model.with_suffix(".rrd") if output is None else output
    check_ending(target, (".rrd",))
    with staged([target], [model, *files]) as (written,):
        result = Result.load(model)
        logs = preparation.read_all(files, result.logs[0].preparation)
        lacking = write_recording(result, logs, written)
        screen.say(f"wrote {target}; look at it with: rerun {target}", *lacking)


@app.command("export")
def _export(
    models: Annotated[list[Path], typer.Argument(metavar="MODEL.json...", help="What identify saved, of each limb.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            parser=output_or_stdout,
            metavar="FILE|-",
            help="Where to write it; the ending, or --to, names the format.",
        ),
    ],
    into: Annotated[
        Path | None, typer.Option(metavar="FILE.xml|FILE.urdf", help="A robot's description to calibrate.")
    ] = None,
    to: Annotated[
        str | None, typer.Option(metavar="c|python|casadi|yaml|mjcf|urdf", help="Format, if not by the ending.")
    ] = None,
    name: Annotated[
        str | None, typer.Option(metavar="NAME", help="Beginning of C's functions, if not the model's name.")
    ] = None,
) -> None:
    """Write an identified model for other programs, or a robot's description with the identified values in it."""
    from diransac.export import format_of

    try:
        chosen = format_of(output, to)
    except SettingsError as error:
        raise typer.BadParameter(str(error)) from error
    if len(models) > 1 and into is None:
        raise typer.BadParameter("several models are limbs of a robot; give its description, --into FILE")
    with staged([output], [*models, into]) as (written,):
        results = [Result.load(path) for path in models]
        left_out = list[str]()
        for k, result in enumerate(results):
            left_out += result.export(written, written if k else into, to=chosen, name=name)
        screen.say(f"wrote {output}")
        if left_out:
            screen.say(f"without {', '.join(left_out)}: not identifiable, or the format has no place for them")
