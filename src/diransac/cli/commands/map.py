"""The command ``map``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diransac.cli import screen
from diransac.cli.arguments import model_file
from diransac.cli.group import grouped
from diransac.cli.options import JsonFlag, LogFile, ModelName, output_or_stdout
from diransac.cli.outputs import staged
from diransac.cli.robot_options import RobotOptions
from diransac.data.readers import read_fields

__all__ = ["app"]

app = typer.Typer(add_completion=False)


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
            screen.copy(found.toml().encode())
            return
        if output is not None:
            written.write_text(found.toml(), encoding="utf-8")
        screen.show(found, as_json)
