"""The command ``view``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diransac.cli import screen
from diransac.cli.group import grouped
from diransac.cli.options import Derivation, LogFiles, Preparation, ResultFile, output_file
from diransac.cli.outputs import check_ending, staged
from diransac.identification.result import Result

__all__ = ["app"]

app = typer.Typer(add_completion=False)


@app.command("view")
@grouped
def _view(
    model: ResultFile,
    files: LogFiles,
    derivation: Derivation,
    preparation: Preparation,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", parser=output_file, metavar="FILE.rrd", help="Where to write it; else MODEL.rrd."
        ),
    ] = None,
) -> None:
    """Write a result and logs for the Rerun viewer: measured, predicted and unmodelled, over time."""
    from diransac.report.viewer import write_recording

    derivation.check()
    target = model.with_suffix(".rrd") if output is None else output
    check_ending(target, (".rrd",))
    with staged([target], [model, *files]) as (written,):
        result = Result.load(model)
        logs = preparation.read_all(files, result.logs[0].preparation)
        lacking = write_recording(result, logs, written)
        screen.say(f"wrote {target}; look at it with: rerun {target}", *lacking)
