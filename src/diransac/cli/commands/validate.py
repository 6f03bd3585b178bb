"""The command ``validate``."""

from __future__ import annotations

from typing import Annotated

import typer

from diransac.cli import screen
from diransac.cli.group import grouped
from diransac.cli.options import Derivation, JsonFlag, LogFiles, Preparation, Report, ResultFile, StrictFlag
from diransac.cli.outputs import PAGE, check_ending, staged
from diransac.identification.assessment.validation import validate
from diransac.identification.result import Result

__all__ = ["app"]

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
