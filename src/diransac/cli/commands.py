"""The commands themselves: parse, call, print."""

from __future__ import annotations

from typing import Annotated

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
)
from diransac.cli.outputs import staged
from diransac.cli.views import CacheState, Equations, ModelList, compare_methods
from diransac.identification.identify import identify
from diransac.identification.inspection import inspect
from diransac.identification.methods import DEFAULT, METHODS
from diransac.identification.result import Result
from diransac.identification.validation import cross_validate, validate
from diransac.simulation.compiler.code_cache import CodeCache
from diransac.time_limit import time_limited

__all__ = ["app"]

app = typer.Typer(
    cls=Group,
    name="diransac",
    help="Turn a messy log of a moving machine into a dynamical model, and say how far it can be trusted.",
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)


@app.callback()
def _diransac(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    _debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error, after any command.")] = False,
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
    method: MethodName = DEFAULT,
    with_suggestions: Annotated[
        bool, typer.Option("--with-suggestions", help="Identify again with the terms that the model seems to lack.")
    ] = False,
    output: Output = None,
    report: Report = None,
    as_json: JsonFlag = False,
    strict: StrictFlag = False,
) -> None:
    """Identify the parameters of a model from one log, or from several logs of one machine."""
    (chosen,), derived = search.methods([method]), derivation.arguments()
    with staged([output, report], [*files, model_file(model), search.settings]) as (saved, page):
        plant, logs = load_model(model), preparation.read_all(files)
        with screen.bar(method) as progress:
            arguments = search.arguments() | derived | {"time_limit": search.time_limit}
            result = identify(plant, logs, chosen, with_suggestions=with_suggestions, progress=progress, **arguments)
        if output:
            result.save(saved)
        if report:
            from diransac.report import write_report

            write_report(result, logs, page)
        screen.show(result, as_json)
    screen.end(result.verdict, strict)


@app.command("compare")
@grouped
def _compare(
    files: LogFiles,
    model: ModelName,
    search: Search,
    derivation: Derivation,
    preparation: Preparation,
    methods: Annotated[str, typer.Option(metavar="NAME,...", help="Which, in this order.")] = ",".join(METHODS),
    report: Report = None,
    as_json: JsonFlag = False,
) -> None:
    """Identify by every method from the same logs, side by side."""
    wanted = search.methods(known_methods(methods))
    arguments = search.arguments() | derivation.arguments()
    with staged([report], [*files, model_file(model), search.settings]) as (page,):
        plant, logs = load_model(model), preparation.read_all(files)
        with time_limited(search.time_limit):
            comparison = compare_methods(plant, logs, wanted, arguments)
        if report:
            from diransac.report import write_report

            write_report(comparison.results, logs, page)
        screen.show(comparison, as_json)


@app.command("validate")
@grouped
def _validate(
    model: ResultFile,
    files: LogFiles,
    derivation: Derivation,
    preparation: Preparation,
    horizon: Annotated[float | None, typer.Option(metavar="S", help="Restart the simulation after so long.")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Predict other logs with an identified model, open loop."""
    result = Result.load(model)
    logs = [derivation.derive(log, result.model) for log in preparation.read_all(files)]
    screen.show(validate(result, logs, horizon), as_json)


@app.command("cross-validate")
@grouped
def _cross_validate(
    files: LogFiles,
    model: ModelName,
    search: Search,
    derivation: Derivation,
    preparation: Preparation,
    method: MethodName = DEFAULT,
    horizon: Annotated[float | None, typer.Option(metavar="S", help="Restart the simulation after so long.")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Identify from all logs but one, and predict that one, for each in turn."""
    (chosen,), derived = search.methods([method]), derivation.arguments()
    plant, logs = load_model(model), preparation.read_all(files)
    arguments = search.arguments() | derived | {"time_limit": search.time_limit}
    with screen.bar(f"{method}, leaving one log out") as progress:
        found = cross_validate(plant, logs, chosen, horizon=horizon, progress=progress, **arguments)
    screen.show(found, as_json)


@app.command("inspect")
@grouped
def _inspect(
    file: LogFile,
    preparation: Preparation,
    model: OptionalModelName = None,
    as_json: JsonFlag = False,
) -> None:
    """Show what a log holds, what is odd about it, and what is missing for a model."""
    plant = None if model is None else load_model(model)
    screen.show(inspect(preparation.read_uneven(file), plant), as_json)


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


@app.command("models")
def _models(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME|FILE.py[:NAME]", help="Show the equations of one.")
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """List the built-in models, or show the equations of one."""
    screen.show(ModelList() if name is None else Equations(load_model(name)), as_json)


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
