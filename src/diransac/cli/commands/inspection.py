"""The commands that show contents: of logs, ``inspect`` and ``map``, of models, and of the cache."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diransac.cli import screen
from diransac.cli.arguments import fixed_parameters, model_file, preparation_of
from diransac.cli.group import grouped
from diransac.cli.options import (
    FixedParameters,
    JsonFlag,
    LogFile,
    LogFiles,
    ModelName,
    OptionalModelName,
    Preparation,
    output_or_stdout,
)
from diransac.cli.outputs import staged
from diransac.cli.robot_options import RobotOptions
from diransac.cli.views import CacheState, Equations, ModelList, Recorded
from diransac.data.readers import read_fields, read_topics
from diransac.identification.assessment.inspection import inspect
from diransac.simulation.compiler.code_cache import CodeCache

app = typer.Typer(add_completion=False)


@app.command("inspect")
@grouped
def _inspect(
    files: LogFiles,
    preparation: Preparation,
    robot: RobotOptions,
    model: OptionalModelName = None,
    fixed: FixedParameters = None,
    as_json: JsonFlag = False,
) -> None:
    """Show what logs hold, what is odd about them, and what is missing for a model."""
    plant = None if model is None else robot.load(model)
    like = preparation_of(model)
    topics = next(filter(None, map(read_topics, files)), None)
    if topics is None or preparation.names_signals or any(step["step"] == "map" for step in like):
        known = fixed_parameters("--fix", fixed or ())
        logs = [preparation.read_uneven(file, like) for file in files]
        screen.show(inspect(logs, plant, fixed=known), as_json)
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
            screen.copy(found.toml().encode())
            return
        if output is not None:
            written.write_text(found.toml(), encoding="utf-8")
        screen.show(found, as_json)


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
