"""The commands ``study`` and ``fleet``, whose work and results are rows of a store."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from diransac.cli import screen
from diransac.cli.arguments import assigned, names
from diransac.cli.options import JsonFlag
from diransac.cli.outputs import PAGE, check_ending, staged
from diransac.cli.rows import Cluster, Jobs, running
from diransac.errors import SettingsError
from diransac.identification.methods import METHODS
from diransac.study import builtin_names, export, fleet_status, load, run_study, status, summarise_fleet, template
from diransac.study.fleet import export_fleet
from diransac.study.method_choice import TRUE
from diransac.text_table import aligned

app, study, fleet = (typer.Typer(add_completion=False) for _ in range(3))
app.add_typer(study, name="study", help="Run grids of Monte-Carlo trials, such as the paper's figures.")
app.add_typer(fleet, name="fleet", help="Parameters over vehicles and time, from a store of identify --each.")

StoreArgument = Annotated[Path, typer.Argument(metavar="STORE", help="Store of study run, or of identify --each.")]
Picture = Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="Figure to write: .png, .svg or .pdf.")]
Page = Annotated[Path, typer.Option("--output", "-o", metavar="FILE.html", help="File to write.")]


def _listed(option: str, text: str | None) -> list[str] | None:
    """The names of ``a,b``; None for None.  Raises typer.BadParameter: there are none."""
    if text is None:
        return None
    found = names(text)
    if not found:
        raise typer.BadParameter(f"{option}: nothing is named; give names separated by commas")
    return found


@study.command("run")
def _run(
    source: Annotated[str, typer.Argument(metavar="NAME|FILE.toml", help=f"{', '.join(builtin_names())}, or a file.")],
    store: Annotated[
        Path, typer.Option(metavar="FILE.db", help="File for the rows; those that it has are not run again.")
    ],
    trials: Annotated[int | None, typer.Option(min=1, metavar="N", help="Trials at each level.")] = None,
    levels: Annotated[str | None, typer.Option(metavar="A,B,...", help="Only these levels: 0,80.")] = None,
    methods: Annotated[str | None, typer.Option(metavar="A,B,...", help="Only these methods, by label.")] = None,
    assignments: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change a value: plant.convention=printed; repeatable."),
    ] = None,
    jobs: Jobs = None,
    cluster: Cluster = None,
    time_limit: Annotated[float | None, typer.Option(metavar="S", help="End the run after so many seconds.")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Run the trials that a store lacks; after an interruption, the same command runs the rest."""
    changes = {".".join(keys): value for keys, value in assigned(assignments or (), "plant.convention=printed")}
    wanted = load(source, changes)
    wanted = wanted.subset(trials, _listed("--levels", levels), _listed("--methods", methods))
    with running(wanted.name, store, jobs, cluster) as how:
        found = run_study(wanted, store=store, time_limit=time_limit, **how)
    screen.show(found, as_json)


@study.command("new")
def _new(
    file: Annotated[Path, typer.Argument(metavar="FILE.toml", help="File to write; it must not exist.")],
) -> None:
    """Write a study file with a comment at every key."""
    if file.suffix != ".toml":
        raise typer.BadParameter(f'"{file}" does not end in .toml; give the name of a TOML file')
    if os.path.lexists(file):
        raise SettingsError(f'"{file}" is there already; give another name')
    with staged([file]) as (written,):
        written.write_text(template(), encoding="utf-8")
    screen.say(f"{file}: edit it, then run diransac study run {file} --store {file.with_suffix('.db')}")


@study.command("status")
def _status(store: StoreArgument, as_json: JsonFlag = False) -> None:
    """Show the numbers of trials done, failed and missing, by level and method."""
    screen.show(status(store), as_json)


@study.command("export")
def _export(
    store: StoreArgument,
    kind: Annotated[str, typer.Option("--to", metavar="parquet|csv", help="Format of the file.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="File to write.")],
) -> None:
    """Write the rows of a store as a table, one per level, trial and method."""
    if kind not in ("parquet", "csv"):
        raise typer.BadParameter(f"--to: {kind!r} is not one of parquet, csv")
    with staged([output], [store]) as (written,):
        export(store, written, kind)


@study.command("plot")
def _plot(
    store: StoreArgument,
    output: Picture,
    flown: Annotated[
        bool | None,
        typer.Option("--paths/--errors", help="Flown paths at one level, or tracking errors.", show_default=False),
    ] = None,
    parameters: Annotated[
        bool, typer.Option("--parameters", help="Parameter errors, if the study evaluates parameters.")
    ] = False,
    level: Annotated[str | None, typer.Option(metavar="A", help="Level whose paths are drawn.")] = None,
    title: Annotated[str | None, typer.Option(metavar="TEXT", help="Title in place of the study's name.")] = None,
) -> None:
    """Plot a store: parameter errors if the study evaluates parameters, else tracking errors, or paths of one level."""
    from diransac.plots.estimates import evaluates_parameters, plot_estimates
    from diransac.plots.figure import check_ending
    from diransac.plots.paths import levels_with_paths, plot_paths
    from diransac.plots.study import plot_study

    if level is not None and flown is False:
        raise typer.BadParameter("--level chooses whose paths are drawn, --errors draws none; give one of them")
    if parameters and (flown is not None or level is not None):
        raise typer.BadParameter("--parameters, --errors and --paths choose different figures; give one of them")
    check_ending(output)
    with staged([output], [store]) as (written,):
        if flown is None and level is None and not parameters:
            parameters = evaluates_parameters(store)
        if flown is None:
            flown = level is not None or len(levels_with_paths(store)) == 1
        if parameters:
            plot_estimates(store, written, title=title)
        elif flown:
            plot_paths(store, written, level=level, title=title)
        else:
            plot_study(store, written, title=title)


@study.command("report")
def _report(store: StoreArgument, output: Page) -> None:
    """Write a store as one HTML page: figures, tables, failures and run times."""
    from diransac.report.stores import write_study_report

    check_ending(output, PAGE)
    with staged([output], [store]) as (written,):
        write_study_report(store, written)


@study.command("list")
def _list(as_json: JsonFlag = False) -> None:
    """List the built-in studies and the methods."""
    screen.show(_Studies(), as_json)


@dataclass(frozen=True)
class _Studies:
    """Built-in studies and methods."""

    def to_dict(self) -> dict[str, Any]:
        """Studies by name, and the methods."""
        return {"studies": {name: load(name).to_dict() for name in builtin_names()}, "methods": [TRUE, *METHODS]}

    def __str__(self) -> str:
        rows = [["study", "varies", "levels", "evaluated by", "trials", "about"]]
        for name in builtin_names():
            one = load(name)
            levels = list(one.axis.levels)
            span = levels[0] if len(levels) == 1 else f"{levels[0]} .. {levels[-1]} ({len(levels)})"
            criteria = [*(["parameters"] if one.evaluate_parameters else []), *one.evaluation.trajectories]
            rows.append([name, one.axis.name, span, ", ".join(criteria), str(one.trials), one.description])
        return "\n".join([*aligned(rows), "", *self._methods()])

    def _methods(self) -> Iterator[str]:
        """Lines with the methods of each study, studies with the same methods together, and with all methods."""
        studies: dict[tuple[str, ...], list[str]] = {}
        for name in builtin_names():
            studies.setdefault(tuple(load(name).methods), []).append(name)
        yield from (f"methods of {', '.join(names)}: {', '.join(labels)}" for labels, names in studies.items())
        yield f"methods there are: {', '.join((TRUE, *METHODS))}"


# Fleets ---------------------------------------------------------------------------------------------------------------
@fleet.command("show")
def _fleet_show(store: StoreArgument, as_json: JsonFlag = False) -> None:
    """Show the parameters of the fleet, and the vehicles that differ, change or drift."""
    screen.show(summarise_fleet(store), as_json)


@fleet.command("status")
def _fleet_status(store: StoreArgument, as_json: JsonFlag = False) -> None:
    """Show the numbers of logs identified, failed and missing, and the reasons."""
    screen.show(fleet_status(store), as_json)


@fleet.command("export")
def _fleet_export(
    store: StoreArgument,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE.csv", help="File to write.")],
) -> None:
    """Write the rows of a store as a table, one per log."""
    check_ending(output, (".csv",))
    with staged([output], [store]) as (written,):
        export_fleet(store, written)


@fleet.command("plot")
def _fleet_plot(store: StoreArgument, output: Picture) -> None:
    """Plot each parameter over the vehicles' lives, and by vehicle."""
    from diransac.plots import figure
    from diransac.plots.fleet import plot_fleet

    figure.check_ending(output)
    with staged([output], [store]) as (written,):
        plot_fleet(summarise_fleet(store), written)


@fleet.command("report")
def _fleet_report(store: StoreArgument, output: Page) -> None:
    """Write a store as one HTML page: findings, figures, tables and failures."""
    from diransac.report.stores import write_fleet_report

    check_ending(output, PAGE)
    with staged([output], [store]) as (written,):
        write_fleet_report(summarise_fleet(store), written)
