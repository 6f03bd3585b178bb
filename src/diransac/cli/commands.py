"""The commands themselves: parse, call, print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diransac.cli import screen
from diransac.cli.arguments import load_model, model_file, numbers
from diransac.cli.design import DesignedModel, DesignOptions, designed, source_of
from diransac.cli.fleet_options import FleetOptions
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
from diransac.cli.group import Group, grouped
from diransac.cli.options import (
    Derivation,
    JsonFlag,
    LogFile,
    LogFiles,
    MethodName,
    ModelName,
    OptionalModelName,
    Output,
    Preparation,
    Report,
    ResultFile,
    Search,
    StrictFlag,
    known_methods,
    output_or_stdout,
)
from diransac.cli.outputs import PAGE, RESULT, STDOUT, check_ending, checked, staged
from diransac.cli.robot_options import LimbResults, RobotOptions, of_limb
from diransac.cli.views import CacheState, Equations, ModelList, Recorded, compare_methods
from diransac.data.readers import read_fields, read_topics
from diransac.errors import SettingsError
from diransac.identification.cross_validation import cross_validate
from diransac.identification.identify import identify
from diransac.identification.inspection import inspect
from diransac.identification.methods import DEFAULT, METHODS
from diransac.identification.result import Result
from diransac.identification.validation import validate
from diransac.simulation.compiler.code_cache import CodeCache
from diransac.time_limit import time_limited

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
    _config: Annotated[
        Path | None,
        typer.Option("--config", metavar="FILE.toml", help="Options by name, anywhere; those that are given win."),
    ] = None,
    _quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no text; anywhere.")] = False,
    _verbose: Annotated[bool, typer.Option("--verbose", "-v", help="A line for every stage; anywhere.")] = False,
) -> None:
    if version:
        from importlib.metadata import version as version_of

        typer.echo(f"diransac {version_of('diransac')}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        context.fail(f"Give a command: {', '.join(sorted(context.command.list_commands(context)))}.")  # type: ignore[attr-defined]


@app.command("identify")
@grouped
def _identify(
    files: LogFiles,
    model: ModelName,
    search: Search,
    derivation: Derivation,
    preparation: Preparation,
    robot: RobotOptions,
    each: FleetOptions,
    method: MethodName = DEFAULT,
    with_suggestions: Annotated[
        bool, typer.Option("--with-suggestions", help="Identify again with the terms that the model seems to lack.")
    ] = False,
    output: Output = None,
    report: Report = None,
    as_json: JsonFlag = False,
    strict: StrictFlag = False,
) -> None:
    """Identify the parameters of a model from one log, from several logs of one machine, or from each by itself."""
    (chosen,), derived = search.methods([method]), preparation.completed(derivation).arguments()
    read = [*files, model_file(model), search.settings]
    if each.asked():
        if output or strict:
            raise typer.BadParameter("--each keeps its results in --store; -o and --strict are of one result")
        arguments = search.arguments() | derived | {"with_suggestions": with_suggestions}
        each.run(files, robot.load(model), chosen, preparation, report, arguments, search.time_limit, as_json)
        return
    checked([output, report], read)
    check_ending(output, RESULT)
    check_ending(report, PAGE)
    limbs, results = robot.load_limbs(model), dict[str, Result]()
    if len(limbs) > 1 and output == STDOUT:
        raise typer.BadParameter("-o - holds one result; this robot has several limbs, give a file")
    outputs = [of_limb(path, limb) for limb in limbs for path in (output, report)]
    with staged(outputs, read) as drafts:
        logs = preparation.read_all(files)
        for k, (limb, plant) in enumerate(limbs.items()):
            saved, page = drafts[2 * k : 2 * k + 2]
            with screen.bar(f"{method} {limb}".rstrip()) as progress:
                arguments = search.arguments() | derived | {"time_limit": search.time_limit}
                found = identify(plant, logs, chosen, with_suggestions=with_suggestions, progress=progress, **arguments)
            results[limb] = found
            if output:
                found.save(saved)
            if report:
                from diransac.report import write_report

                write_report(found, logs, page, command=screen.command())
        screen.show(LimbResults(results) if len(results) > 1 else results[""], as_json)
    for found in results.values():
        screen.end(found.verdict, strict)


@app.command("compare")
@grouped
def _compare(
    files: LogFiles,
    model: ModelName,
    search: Search,
    derivation: Derivation,
    preparation: Preparation,
    robot: RobotOptions,
    methods: Annotated[str, typer.Option(metavar="NAME,...", help="Which, in this order.")] = ",".join(METHODS),
    report: Report = None,
    as_json: JsonFlag = False,
) -> None:
    """Identify by every method from the same logs, side by side."""
    wanted = search.methods(known_methods(methods))
    arguments = search.arguments() | preparation.completed(derivation).arguments()
    read = [*files, model_file(model), search.settings]
    checked([report], read)
    check_ending(report, PAGE)
    with staged([report], read) as (page,):
        plant, logs = robot.load(model), preparation.read_all(files)
        with time_limited(search.time_limit):
            comparison = compare_methods(plant, logs, wanted, arguments)
        if report:
            from diransac.report import write_report

            write_report(comparison.results, logs, page, command=screen.command())
        screen.show(comparison, as_json)


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
    check_ending(report, PAGE)
    with staged([report], [model, *files]) as (page,):
        result, derivation = Result.load(model), preparation.completed(derivation)
        logs = [derivation.derive(log, result.model) for log in preparation.read_all(files)]
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
        list[str] | None, typer.Option("--initial", metavar="NAME=VALUE,...", help="Initial states: x=0,x_dot=0.")
    ] = None,
    plot: FlightPicture = None,
) -> None:
    """Simulate an identified model over the inputs of a log, and write the simulated signals."""
    from diransac.identification.open_loop import simulate

    start = numbers("--initial", initial) if initial else None
    with staged([output, plot], [model, file]) as (written, picture):
        result = Result.load(model)
        log = derivation.derive(preparation.read(file), result.model)
        simulated = simulate(result, log, initial_state=start, horizon=horizon)
        simulated.write(written)
        if plot:
            from diransac.plots.prediction import plot_prediction

            plot_prediction(simulated, log, result.model.state, tuple(result.model.inputs), picture)
        screen.say("\n".join([f"wrote {output}: {len(simulated)} rows", *simulated.notes]))


@app.command("cross-validate")
@grouped
def _cross_validate(
    files: LogFiles,
    model: ModelName,
    search: Search,
    derivation: Derivation,
    preparation: Preparation,
    robot: RobotOptions,
    method: MethodName = DEFAULT,
    horizon: Annotated[float | None, typer.Option(metavar="S", help="Restart the simulation after so long.")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Identify from all logs but one, and predict that one, for each in turn."""
    (chosen,), derived = search.methods([method]), preparation.completed(derivation).arguments()
    plant, logs = robot.load(model), preparation.read_all(files)
    arguments = search.arguments() | derived | {"time_limit": search.time_limit}
    with screen.bar(f"{method}, leaving one log out") as progress:
        found = cross_validate(plant, logs, chosen, horizon=horizon, progress=progress, **arguments)
    screen.show(found, as_json)


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
    topics = read_topics(file)
    if topics is None or preparation.names_signals:
        screen.show(inspect(preparation.read_uneven(file), plant), as_json)
    else:
        screen.show(Recorded.of(topics, plant), as_json)


@app.command("map")
@grouped
def _map(
    file: LogFile,
    model: ModelName,
    robot: RobotOptions,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", parser=output_or_stdout, metavar="FILE.toml|-", help="Where to write the mapping."
        ),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Write a first guess of a mapping from a log's topics or columns to a model's signals."""
    from diransac.data.suggested_mapping import suggest_mapping

    with staged([output], [file, model_file(model)]) as (written,):
        fields, elements = read_fields(file)
        found = suggest_mapping(fields, elements, robot.load(model), f'log "{file}"')
        if output is None and not as_json:
            typer.echo(found.toml(), nl=False)
            return
        if output is not None:
            written.write_text(found.toml(), encoding="utf-8")
        screen.show(found, as_json)


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
        Path | None, typer.Option("--into", metavar="FILE.xml|FILE.urdf", help="A robot's description to calibrate.")
    ] = None,
    to: Annotated[
        str | None, typer.Option("--to", metavar="c|python|casadi|yaml|mjcf|urdf", help="Format, if not by the ending.")
    ] = None,
    name: Annotated[
        str | None, typer.Option("--name", metavar="NAME", help="Beginning of C's functions, if not the model's name.")
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


@app.command("cache")
def _cache(
    clear: Annotated[bool, typer.Option("--clear", help="Remove all entries.")] = False,
    as_json: JsonFlag = False,
) -> None:
    """Show the folder of compiled machine code, and the number and size of its entries."""
    cache = CodeCache.of_user()
    if clear and cache is not None:
        cache.clear()
    screen.show(CacheState(cache), as_json)
