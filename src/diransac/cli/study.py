"""The commands of ``diransac study``."""

from __future__ import annotations

import logging
import math
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from diransac.cli import screen
from diransac.cli.arguments import names, toml_value
from diransac.cli.options import JsonFlag
from diransac.cli.outputs import staged
from diransac.errors import SettingsError
from diransac.identification.identify import METHODS
from diransac.study import Status, Study, builtin_names, connected, export, load, run_study, status, template
from diransac.study.run import Progress
from diransac.study.specification import TRUE
from diransac.text_table import aligned

__all__ = ["study"]

study = typer.Typer(name="study", help="Run grids of Monte-Carlo trials, such as the paper's figures.")

StoreArgument = Annotated[Path, typer.Argument(metavar="STORE", help="What study run made.")]


def _listed(option: str, text: str | None) -> list[str] | None:
    """``a,b`` as a list; None stays None.  Raises typer.BadParameter: nothing is named."""
    if text is None:
        return None
    found = names(text)
    if not found:
        raise typer.BadParameter(f"{option}: nothing is named; give names, separated by commas")
    return found


def _changes(assignments: Sequence[str]) -> dict[str, Any]:
    """``path.to.key=value`` pairs by path.  Raises typer.BadParameter: one is none."""
    found = {}
    for text in assignments:
        path, equals, value = (part.strip() for part in text.partition("="))
        if not equals or not all(path.split(".")):
            raise typer.BadParameter(f"--set: {text!r} is not key=value, such as plant.convention=printed")
        found[path] = toml_value(value)
    return found


@study.command("run")
def _run(
    source: Annotated[
        str, typer.Argument(metavar="NAME|FILE.toml", help=f"{', '.join(builtin_names())}, or one of yours.")
    ],
    store: Annotated[
        Path, typer.Option(metavar="FILE.db", help="Where rows are kept; what is there is not run again.")
    ],
    trials: Annotated[int | None, typer.Option(min=1, metavar="N", help="So many at each level.")] = None,
    levels: Annotated[str | None, typer.Option(metavar="A,B,...", help="At these levels alone: 0,80.")] = None,
    methods: Annotated[str | None, typer.Option(metavar="A,B,...", help="Of these methods alone, by label.")] = None,
    assignments: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Another value: plant.convention=printed; repeatable."),
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Processes; as many as cores if not given.")
    ] = None,
    cluster: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Dask scheduler whose workers run it: tcp://host:8786.")
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Run what a store lacks of a study: the same command again runs the rest."""
    if cluster is not None and jobs is not None:
        raise typer.BadParameter("--jobs counts processes of this machine, --cluster runs on others; give one of them")
    wanted = load(source, _changes(assignments or ()))
    wanted = wanted.subset(trials, _listed("--levels", levels), _listed("--methods", methods))
    with _kept(store) as note, _bar(wanted.name) as show:

        def progress(done: int, asked: int) -> None:
            note(done, asked)
            show(done, asked)

        found = _everywhere(wanted, store, jobs, cluster, progress)
    screen.show(found, as_json)


def _everywhere(wanted: Study, store: Path, jobs: int | None, cluster: str | None, progress: Progress) -> Status:
    """Run on this machine or on a cluster."""
    if cluster is None:
        return run_study(wanted, store=store, jobs=jobs, progress=progress)
    with connected(cluster) as (executor, tasks):
        for talker in ("distributed", "concurrent.futures"):  # an error says in a line what they say in many
            logging.getLogger(talker).setLevel(logging.CRITICAL)
        return run_study(wanted, store=store, executor=executor, tasks=tasks, progress=progress)


@study.command("new")
def _new(
    file: Annotated[Path, typer.Argument(metavar="FILE.toml", help="Where to write it; there must be none yet.")],
) -> None:
    """Write a study with a comment at every key, to start one's own from."""
    if file.suffix != ".toml":
        raise typer.BadParameter(f'"{file}" does not end in .toml; give the name of a TOML file')
    try:
        with file.open("x", encoding="utf-8") as new:
            new.write(template())
    except FileExistsError as error:
        raise SettingsError(f'"{file}" is there already; give another name') from error
    typer.echo(f"{file}: change it, then run it with diransac study run {file} --store {file.with_suffix('.db')}")


@study.command("status")
def _status(store: StoreArgument, as_json: JsonFlag = False) -> None:
    """Show how many trials of each level and method are done, failed or missing."""
    screen.show(status(store), as_json)


@study.command("export")
def _export(
    store: StoreArgument,
    kind: Annotated[str, typer.Option("--to", metavar="parquet|csv", help="What kind of file.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="Where to write it.")],
) -> None:
    """Write a store's rows as a table, one a level, trial and method."""
    if kind not in ("parquet", "csv"):
        raise typer.BadParameter(f"--to: {kind!r} is not one of parquet, csv")
    with staged([output], [store]) as (written,):
        export(store, written, kind)


@study.command("plot")
def _plot(
    store: StoreArgument,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="Where to draw it: .png, .svg or .pdf.")
    ],
    flown: Annotated[
        bool | None,
        typer.Option(
            "--paths/--errors", help="Flown paths at one level, or how flights were tracked.", show_default=False
        ),
    ] = None,
    parameters: Annotated[
        bool, typer.Option("--parameters", help="Errors of the parameters, if the study judges these.")
    ] = False,
    level: Annotated[str | None, typer.Option(metavar="A", help="Whose paths are drawn.")] = None,
    title: Annotated[str | None, typer.Option(metavar="TEXT", help="In place of the study's name.")] = None,
) -> None:
    """Draw a store: errors of the parameters if its study judges them, else of the flights, or, at one level, paths."""
    from diransac.plots.estimates import judges_parameters, plot_estimates
    from diransac.plots.paths import levels_with_paths, plot_paths
    from diransac.plots.study import plot_study
    from diransac.plots.writing import checked_ending

    if level is not None and flown is False:
        raise typer.BadParameter("--level chooses whose paths are drawn, --errors draws none; give one of them")
    if parameters and (flown is not None or level is not None):
        raise typer.BadParameter("--parameters, --errors and --paths are pictures of their own; give one of them")
    checked_ending(output)
    with staged([output], [store]) as (written,):
        if flown is None and level is None and not parameters:
            parameters = judges_parameters(store)
        if flown is None:
            flown = level is not None or len(levels_with_paths(store)) == 1
        if parameters:
            plot_estimates(store, written, title=title)
        elif flown:
            plot_paths(store, written, level=level, title=title)
        else:
            plot_study(store, written, title=title)


@study.command("report")
def _report(
    store: StoreArgument,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE.html", help="Where to write it.")],
) -> None:
    """Write a store as one HTML page: figures, the numbers behind them, what failed and what took its time."""
    from diransac.report.study import write_study_report

    with staged([output], [store]) as (written,):
        write_study_report(store, written)


@study.command("list")
def _list(as_json: JsonFlag = False) -> None:
    """List the studies that are built in, and the methods there are."""
    screen.show(_Studies(), as_json)


@dataclass(frozen=True)
class _Studies:
    """Every built-in study, a few lines each."""

    def to_dict(self) -> dict[str, Any]:
        """Studies by name, and methods."""
        return {"studies": {name: load(name).to_dict() for name in builtin_names()}, "methods": [TRUE, *METHODS]}

    def __str__(self) -> str:
        rows = [["study", "varies", "levels", "judged by", "trials", "about"]]
        for name in builtin_names():
            one = load(name)
            levels = [level.text for level in one.axis.levels]
            span = levels[0] if len(levels) == 1 else f"{levels[0]} .. {levels[-1]} ({len(levels)})"
            judges = [*(["parameters"] if one.evaluate_parameters else []), *one.evaluation.trajectories]
            rows.append([name, one.axis.name, span, ", ".join(judges), str(one.trials), one.description])
        return "\n".join([*aligned(rows), "", *self._methods()])

    def _methods(self) -> Iterator[str]:
        """The methods of each study, one line for those that have the same, and all that there are."""
        studies: dict[tuple[str, ...], list[str]] = {}
        for name in builtin_names():
            studies.setdefault(tuple(load(name).methods), []).append(name)
        yield from (f"methods of {', '.join(names)}: {', '.join(labels)}" for labels, names in studies.items())
        yield f"methods there are: {', '.join((TRUE, *METHODS))}"


# What is shown meanwhile ---------------------------------------------------------------------------------------------
@contextmanager
def _kept(store: Path) -> Iterator[Progress]:
    """What notes how far a study is, and says it after Ctrl-C, with how to go on."""
    counts = [0, 0]

    def update(done: int, asked: int) -> None:
        counts[:] = done, asked

    try:
        yield update
    except KeyboardInterrupt:
        typer.echo(f"{counts[0]} of {counts[1]} rows are kept in {store}; the same command runs the rest", err=True)
        raise


@contextmanager
def _bar(label: str) -> Iterator[Progress]:
    """What a study reports its progress to: a bar with rate and time left on a terminal's stderr, nothing elsewhere."""
    if sys.stderr is None or not (sys.stderr.isatty() or os.environ.get("FORCE_COLOR")):
        yield lambda _done, _asked: None
        return
    from rich import progress
    from rich.console import Console

    columns = (
        progress.TextColumn("{task.description}"),
        progress.BarColumn(),
        progress.MofNCompleteColumn(),
        progress.TextColumn("rows, {task.fields[rate]}"),
        progress.TimeRemainingColumn(),
    )
    # However rarely rows come, the first of them tell a rate: since the start, which counts as a row of nothing.
    options: dict[str, Any] = {"console": Console(stderr=True), "transient": True, "speed_estimate_period": math.inf}
    with progress.Progress(*columns, **options) as shown:
        task = shown.add_task(label, total=None, rate="starting")

        def update(done: int, asked: int) -> None:
            if shown.tasks[0].total is None:  # what an earlier run kept says nothing about the rate
                shown.reset(task, total=asked, completed=done)
                shown.advance(task, 0)
                return
            shown.update(task, completed=done)
            speed = shown.tasks[0].speed
            if speed:
                shown.update(task, rate=f"{speed:.1f}/s" if speed >= 1.0 else f"{60.0 * speed:.1f}/min")

        yield update
