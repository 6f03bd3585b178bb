"""Options and progress of commands whose work is kept as rows of a store."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from diransac.cli import screen
from diransac.plain_text import one_line, printable

__all__ = ["Cluster", "Jobs", "running"]

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
