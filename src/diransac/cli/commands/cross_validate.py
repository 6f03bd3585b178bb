"""The command ``cross-validate``."""

from __future__ import annotations

from typing import Annotated

import typer

from diransac.cli import screen
from diransac.cli.arguments import preparation_of
from diransac.cli.group import grouped
from diransac.cli.options import Derivation, JsonFlag, LogFiles, MethodName, ModelName, Preparation, Search
from diransac.cli.robot_options import RobotOptions
from diransac.identification.assessment.cross_validation import cross_validate
from diransac.identification.methods import DEFAULT

__all__ = ["app"]

app = typer.Typer(add_completion=False)


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
    plant, logs = robot.load(model), preparation.read_all(files, preparation_of(model))
    arguments = search.arguments() | derived | {"time_limit": search.time_limit}
    with screen.bar(f"{method}, leaving one log out") as progress:
        found = cross_validate(plant, logs, chosen, horizon=horizon, progress=progress, **arguments)
    screen.show(found, as_json)
