"""The command ``export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diransac.cli import screen
from diransac.cli.options import output_or_stdout
from diransac.cli.outputs import staged
from diransac.errors import SettingsError
from diransac.identification.result import Result

__all__ = ["app"]

app = typer.Typer(add_completion=False)


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
