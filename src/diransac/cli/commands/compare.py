"""The command ``compare``."""

from __future__ import annotations

from typing import Annotated

import typer

from diransac.cli import screen
from diransac.cli.arguments import model_file, preparation_of
from diransac.cli.group import grouped
from diransac.cli.options import Derivation, JsonFlag, LogFiles, ModelName, Preparation, Report, Search, known_methods
from diransac.cli.outputs import PAGE, check_ending, checked, staged
from diransac.cli.robot_options import RobotOptions
from diransac.cli.views import compare_methods
from diransac.identification.methods import METHODS
from diransac.time_limit import time_limited

__all__ = ["app"]

app = typer.Typer(add_completion=False)


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
