"""The commands of ``diransac fleet``: what a store of ``identify --each`` holds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diransac.cli import screen
from diransac.cli.options import JsonFlag
from diransac.cli.outputs import PAGE, check_ending, checked, staged
from diransac.study.fleet import export_fleet, fleet_status
from diransac.study.fleet_findings import summarise_fleet

__all__ = ["app"]

app = typer.Typer(
    name="fleet", add_completion=False, help="Parameters over vehicles and time, from a store of identify --each."
)

StoreArgument = Annotated[Path, typer.Argument(metavar="STORE", help="Store of identify --each.")]


@app.command("show")
def _show(store: StoreArgument, as_json: JsonFlag = False) -> None:
    """Show the parameters of the fleet, and the vehicles that differ, change or drift."""
    screen.show(summarise_fleet(store), as_json)


@app.command("status")
def _status(store: StoreArgument, as_json: JsonFlag = False) -> None:
    """Show the numbers of logs identified, failed and missing, and the reasons."""
    screen.show(fleet_status(store), as_json)


@app.command("export")
def _export(
    store: StoreArgument,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE.csv", help="File to write.")],
) -> None:
    """Write the rows of a store as a table, one per log."""
    check_ending(output, (".csv",))
    with staged([output], [store]) as (written,):
        export_fleet(store, written)


@app.command("plot")
def _plot(
    store: StoreArgument,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="Figure to write: .png, .svg or .pdf.")
    ],
) -> None:
    """Plot each parameter over the vehicles' lives, and by vehicle."""
    from diransac.plots import figure
    from diransac.plots.fleet import plot_fleet

    figure.check_ending(output)
    with staged([output], [store]) as (written,):
        plot_fleet(summarise_fleet(store), written)


@app.command("report")
def _report(
    store: StoreArgument,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE.html", help="File to write.")],
) -> None:
    """Write a store as one HTML page: findings, figures, tables and failures."""
    from diransac.report.stores import write_fleet_report

    checked([output], [store])
    check_ending(output, PAGE)
    with staged([output], [store]) as (written,):
        write_fleet_report(summarise_fleet(store), written)
