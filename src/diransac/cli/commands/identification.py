"""The commands ``identify``, ``compare`` and ``cross-validate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diransac.cli import screen
from diransac.cli.arguments import model_file, names, preparation_of, start_values
from diransac.cli.comparison import compare_methods
from diransac.cli.group import grouped
from diransac.cli.options import (
    Derivation,
    JsonFlag,
    LogFiles,
    MethodName,
    ModelName,
    Output,
    Preparation,
    Report,
    Search,
    StrictFlag,
    known_methods,
)
from diransac.cli.outputs import PAGE, RESULT, STDOUT, check_ending, checked, staged
from diransac.cli.robot_options import LimbResults, RobotOptions, of_limb
from diransac.cli.rows import FleetOptions
from diransac.identification.identify import identify
from diransac.identification.methods import DEFAULT, METHODS
from diransac.identification.result import Result
from diransac.time_limit import time_limited

app = typer.Typer(add_completion=False)


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
    add_terms: Annotated[
        str | None,
        typer.Option(metavar="NAME,...", help="The same with these alone of the terms, by their parameters."),
    ] = None,
    rough: Annotated[
        str | None,
        typer.Option(
            "--start", metavar="NAME=VALUE,...", help="Rough values from which lo-diransac starts, too: mass=0.3."
        ),
    ] = None,
    horizon: Annotated[
        float | None,
        typer.Option(metavar="S", help="Time over which the model is to predict; estimates are compared over it."),
    ] = None,
    _config: Annotated[
        Path | None,
        typer.Option(
            "--config", metavar="FILE.toml", help="A project: logs, model and options; those given besides it win."
        ),
    ] = None,
    output: Output = None,
    report: Report = None,
    as_json: JsonFlag = False,
    strict: StrictFlag = False,
) -> None:
    """Identify the parameters of a model from one log, from several logs of one machine, or from each by itself."""
    (chosen,), derived = search.methods([method]), preparation.completed(derivation).arguments()
    terms = names(add_terms or "") or with_suggestions
    aims = {"start": start_values("--start", rough), "horizon": horizon, "with_suggestions": terms}
    read = [*files, model_file(model), search.settings]
    if each.asked():
        if output or strict:
            raise typer.BadParameter("--each keeps its results in --store; -o and --strict are of one result")
        arguments = search.arguments() | derived | aims
        each.run(
            files,
            robot.load(model),
            chosen,
            preparation,
            preparation_of(model),
            report,
            arguments,
            search.time_limit,
            as_json,
        )
        return
    checked([output, report], read)
    check_ending(output, RESULT)
    check_ending(report, PAGE)
    limbs, results = robot.load_limbs(model), dict[str, Result]()
    if len(limbs) > 1 and output == STDOUT:
        raise typer.BadParameter("-o - holds one result; this robot has several limbs, give a file")
    outputs = [of_limb(path, limb) for limb in limbs for path in (output, report)]
    with staged(outputs, read) as drafts:
        logs = preparation.read_all(files, preparation_of(model))
        for k, (limb, plant) in enumerate(limbs.items()):
            saved, page = drafts[2 * k : 2 * k + 2]
            with screen.bar(f"{method} {limb}".rstrip()) as progress:
                arguments = search.arguments() | derived | aims | {"time_limit": search.time_limit}
                found = identify(plant, logs, chosen, progress=progress, **arguments)
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
        plant, logs = robot.load(model), preparation.read_all(files, preparation_of(model))
        with time_limited(search.time_limit):
            comparison = compare_methods(plant, logs, wanted, arguments)
        if report:
            from diransac.report import write_report

            write_report(comparison.results, logs, page, command=screen.command())
        screen.show(comparison, as_json)


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
    from diransac.identification.assessment.cross_validation import cross_validate

    (chosen,), derived = search.methods([method]), preparation.completed(derivation).arguments()
    plant, logs = robot.load(model), preparation.read_all(files, preparation_of(model))
    arguments = search.arguments() | derived | {"time_limit": search.time_limit}
    with screen.bar(f"{method}, leaving one log out") as progress:
        found = cross_validate(plant, logs, chosen, horizon=horizon, progress=progress, **arguments)
    screen.show(found, as_json)
