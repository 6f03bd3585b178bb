"""Commands whose work is kept as rows of a store: options, progress, and ``identify --each``."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from diransac.cli import screen
from diransac.cli.options import Preparation
from diransac.cli.outputs import PAGE, STDOUT, check_ending, checked, staged
from diransac.identification.method import Method
from diransac.model import Model
from diransac.plain_text import one_line, printable

Progress = Callable[[int, int], None]

Jobs = Annotated[int | None, typer.Option(min=1, metavar="N", help="Number of processes; one per core by default.")]
Cluster = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="Dask scheduler whose workers do the work: tcp://host:8786.")
]


@contextmanager
def running(label: str, store: Path, jobs: int | None, cluster: str | None) -> Iterator[dict[str, Any]]:
    """Context with the arguments of `run_study` or `identify_each` that choose workers and show progress.

    Raises typer.BadParameter: both jobs and a cluster; SettingsError, StudyError: as `connected`.
    """
    if cluster is not None and jobs is not None:
        raise typer.BadParameter(
            "--jobs sets the processes of this machine, --cluster runs on others; give one of them"
        )
    with _kept(store) as note, _bar(label) as show:

        def progress(done: int, asked: int) -> None:
            note(done, asked)
            show(done, asked)

        if cluster is None:
            yield {"jobs": jobs, "progress": progress}
            return
        import logging

        from diransac.study.engine import connected

        with connected(cluster) as (executor, tasks):
            for talker in ("distributed", "concurrent.futures"):  # the error itself is one line
                logging.getLogger(talker).setLevel(logging.CRITICAL)
            yield {"executor": executor, "tasks": tasks, "progress": progress}


def _lines(label: str) -> Progress:
    """Progress callback without a terminal; rows of an earlier run do not count for the time left."""
    lines, kept = screen.Lines(label), list[int]()

    def update(done: int, asked: int) -> None:
        kept[:] = kept or [done]
        lines.show(f"{done} of {asked} rows", (done - kept[0]) / max(1, asked - kept[0]))

    return update


@contextmanager
def _kept(store: Path) -> Iterator[Progress]:
    """Callback that counts rows; a run that ends before all are done says how many there are, and how to resume."""
    counts = [0, 0]

    def update(done: int, asked: int) -> None:
        counts[:] = done, asked

    try:
        yield update
    finally:
        done, asked = counts
        if done < asked and isinstance(sys.exception(), KeyboardInterrupt | None):
            screen.note(f"{done} of {asked} rows are kept in {store}; the same command runs the rest")


@contextmanager
def _bar(label: str) -> Iterator[Progress]:
    """Progress callback: a bar with rate and time left if stderr is a terminal, else a line every ten seconds.

    Nothing if quiet.
    """
    if screen.is_quiet():
        yield lambda _done, _asked: None
        return
    if not screen.shows_bars():
        yield _lines(label)
        return
    from rich import progress

    columns = progress.MofNCompleteColumn(), progress.TextColumn("rows, {task.fields[rate]}")
    # The rate is an average since the start, so that it is known from the first rows on.
    with screen.progress_bar(*columns, speed_estimate_period=math.inf) as shown:
        task = shown.add_task(printable(one_line(label)), total=None, rate="starting")

        def update(done: int, asked: int) -> None:
            if shown.tasks[0].total is None:  # rows of an earlier run do not count for the rate
                shown.reset(task, total=asked, completed=done)
                shown.advance(task, 0)
                return
            shown.update(task, completed=done)
            speed = shown.tasks[0].speed
            if speed:
                shown.update(task, rate=f"{speed:.1f}/s" if speed >= 1.0 else f"{60.0 * speed:.1f}/min")

        yield update


# A fleet --------------------------------------------------------------------------------------------------------------
_option = partial(typer.Option, rich_help_panel="A fleet of logs")


@dataclass(frozen=True)
class FleetOptions:
    """Options of a fleet of logs, one result each."""

    each: Annotated[bool, _option("--each", help="Identify from each log by itself, into a store.")] = False
    store: Annotated[
        Path | None, _option(metavar="FILE.db", help="Rows, one per log; those it has are not run again.")
    ] = None
    vehicle: Annotated[
        str | None, _option(metavar="REGEX", help="Vehicle in a log's name: '(?P<vehicle>[^/]+)/(?P<time>.*)'.")
    ] = None
    jobs: Jobs = None
    cluster: Cluster = None

    def asked(self) -> bool:
        """True for a fleet.  Raises typer.BadParameter: options without ``--each``, or no store."""
        if self.each and self.store is None:
            raise typer.BadParameter("--each needs a store for its rows, --store FILE.db")
        given = [name for name in ("store", "vehicle", "jobs", "cluster") if getattr(self, name) is not None]
        if given and not self.each:
            raise typer.BadParameter(f"--{given[0]} belongs to --each, which is not given")
        return self.each

    def run(
        self,
        files: Sequence[Path],
        model: Model,
        method: Method,
        preparation: Preparation,
        like: Sequence[Mapping[str, Any]],
        report: Path | None,
        arguments: Mapping[str, Any],
        time_limit: float | None,
        as_json: bool,
    ) -> None:
        """Identify from each log, show what the fleet is like, and write the page if there is one."""
        from diransac.study.fleet import identify_each
        from diransac.study.fleet_findings import summarise_fleet

        assert self.store is not None
        if STDOUT in files:
            raise typer.BadParameter("--each reads files, not standard input; give their names")
        checked([report], [*files, self.store])
        check_ending(report, PAGE)
        prepared = {name: value for name, value in asdict(preparation).items() if value is not None}
        with running(f"{len(files)} logs", self.store, self.jobs, self.cluster) as how:
            identify_each(
                model,
                files,
                method,
                store=self.store,
                vehicle=self.vehicle,
                read=partial(preparation.read, like=like),
                configuration={"preparation": prepared, **({"like": list(like)} if like else {})},
                time_limit=time_limit,
                **how,
                **arguments,
            )
        summary = summarise_fleet(self.store)
        with staged([report], [*files, self.store]) as (page,):
            if report:
                from diransac.report.stores import write_fleet_report

                write_fleet_report(summary, page)
        screen.show(summary, as_json)
