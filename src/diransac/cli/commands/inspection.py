"""The commands that show contents: of logs, ``inspect`` and ``map``, of models, and of the cache."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from diransac.cli import screen
from diransac.cli.arguments import fixed_parameters, model_file, preparation_of
from diransac.cli.commands import grouped
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
from diransac.data.readers import read_fields, read_topics
from diransac.identification.assessment.inspection import inspect
from diransac.model import Model, Parameter
from diransac.model.library import BUILTIN
from diransac.simulation.compiler.code_cache import CodeCache
from diransac.text_table import aligned

if TYPE_CHECKING:
    from diransac.data.readers.topics import TopicTable
    from diransac.data.suggested_mapping import Coverage

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
        known = fixed_parameters(fixed)
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


# ---------------------------------------------------------------------- what they show


@dataclass(frozen=True)
class ModelList:
    """Every built-in model, a line each."""

    def to_dict(self) -> dict[str, Any]:
        """Names, units, bounds and equations of each model, by name."""
        return {name: Equations(make()).to_dict() for name, make in BUILTIN.items()}

    def __str__(self) -> str:
        rows = [["model", "coordinates", "inputs", "parameters"]]
        for name, make in BUILTIN.items():
            model = make()
            states = (*model.coordinates, *model.first_order)
            rows.append([name, *(", ".join(group) for group in (states, model.inputs, model.parameters))])
        return "\n".join(aligned(rows))


@dataclass(frozen=True)
class Equations:
    """Signals, parameters with their bounds, and equations of a model.

    Parameters
    ----------
    model : Model
    """

    model: Model

    def to_dict(self) -> dict[str, Any]:
        """Names, units, bounds (null: none) and equations."""
        model = self.model
        parameters = {name: vars(parameter).copy() for name, parameter in model.parameters.items()}
        return {
            "name": model.name,
            "signals": {name: model.units[name] for name in model.signals},
            "inputs": model.inputs,
            "parameters": parameters,
            "required": list(model.required_signals),
            "nonlinear": list(model.nonlinear_parameters),
            "equations": list(model.equations_text()),
        }

    def __str__(self) -> str:
        model = self.model
        signals = [["signal", "unit", ""]]
        signals += [
            [name, model.units[name], "sensor" if name in model.sensors else "predicted"] for name in model.signals
        ]
        signals += [[name, unit, "input"] for name, unit in model.inputs.items()]
        rows = [["parameter", "unit", "bounds"]]
        rows += [[name, parameter.unit, _bounds(parameter)] for name, parameter in model.parameters.items()]
        return "\n".join([model.name, *aligned(signals), "", *aligned(rows), "", *model.equations_text()])


@dataclass(frozen=True)
class CacheState:
    """Folder, number and size of the entries of a cache of machine code.

    Parameters
    ----------
    cache : CodeCache or None
        None where it is switched off.
    """

    cache: CodeCache | None

    def to_dict(self) -> dict[str, Any]:
        """Folder (null: none), reason for not using it (empty: it is used), entries, bytes, and their limit."""
        if self.cache is None:
            return {"folder": None, "unused": "DIRANSAC_CACHE is off", "entries": 0, "bytes": 0, "limit": 0}
        sizes = self.cache.sizes()
        return {
            "folder": str(self.cache.folder),
            "unused": self.cache.objection(),
            "entries": len(sizes),
            "bytes": sum(sizes.values()),
            "limit": self.cache.size_limit,
        }

    def __str__(self) -> str:
        state = self.to_dict()
        if self.cache is None:
            return f"no machine code is kept: {state['unused']}"
        unused = f"\nnot used: {state['unused']}" if state["unused"] else ""
        size, limit = (state[name] / 2**20 for name in ("bytes", "limit"))
        return f"{state['folder']}\n{state['entries']} entries, {size:.1f} of at most {limit:.0f} MiB{unused}"


def _bounds(parameter: Parameter) -> str:
    low = "0 <" if parameter.positive else f"{parameter.lower:g} <=" if parameter.lower > -float("inf") else ""
    high = f"<= {parameter.upper:g}" if parameter.upper < float("inf") else ""
    return " ".join(part for part in (low, "value" if low or high else "any", high) if part)


@dataclass(frozen=True)
class Recorded:
    """Topics of a recording, and which of them a model's signals may come from."""

    topics: TopicTable
    coverage: Coverage | None = None

    @classmethod
    def of(cls, topics: TopicTable, model: Model | None) -> Recorded:
        """Topics, and the coverage of a model."""
        if model is None:
            return cls(topics)
        from diransac.data.suggested_mapping import suggest_mapping

        return cls(topics, suggest_mapping(topics.fields, topics.elements, model, topics.source))

    def to_dict(self) -> dict[str, Any]:
        """Both."""
        return self.topics.to_dict() | {"fitness": None if self.coverage is None else self.coverage.to_dict()}

    def __str__(self) -> str:
        return str(self.topics) + ("" if self.coverage is None else f"\n\n{self.coverage}")
