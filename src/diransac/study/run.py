"""`run_study` distributes trials to workers and keeps their rows."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from diransac.errors import SettingsError
from diransac.study.engine import Progress, distribute, workers_of
from diransac.study.library import load
from diransac.study.reading import Status, status
from diransac.study.specification import Study
from diransac.study.store import Store
from diransac.study.trials import run_trials
from diransac.time_limit import time_limited

__all__ = ["BATCH_SIZE", "run_study"]

_RowKey = tuple[str, int, str]
"""Level, trial and method."""

BATCH_SIZE = 4
"""Trials per task: enough to fill the vectors of a simulation, few enough that a killed process loses little."""


def run_study(
    spec: Study | Mapping[str, Any] | str | Path,
    *,
    store: str | Path,
    executor: Executor | None = None,
    jobs: int | None = None,
    trials: int | None = None,
    levels: Sequence[str | float] | None = None,
    methods: Sequence[str] | None = None,
    batch_size: int = BATCH_SIZE,
    tasks: int | None = None,
    time_limit: float | None = None,
    progress: Progress | None = None,
) -> Status:
    """Run the rows of a study that a store lacks; a row is a level, trial and method.

    Parameters
    ----------
    spec : name of a built-in study, a TOML file, its tables, or a `Study`
    store : SQLite file; made if it does not exist
    executor : runs the trials; any executor of `concurrent.futures`, or one with its interface (Dask's
        ``client.get_executor()``). None: processes of this machine, for which a script needs ``if __name__ ==
        "__main__":``
    jobs : number of these processes; None: one per core
    trials, levels, methods : number of trials, levels, and labels of methods; None: those of the study
    batch_size : trials of a level that are run together
    tasks : batches handed out at a time; None: two per process, 64 to an executor
    time_limit : time after which the run ends, s; rows that are done are kept, and the same call runs the others
    progress : called with (rows present, rows asked for) at the start and whenever rows are added

    Returns
    -------
    Status
        The number of rows done, failed and missing.

    Raises
    ------
    SettingsError
        An argument or the study has no meaning.
    StudyError
        The store has another configuration, workers are lost repeatedly, or one lacks the file of the study's plant.
    KeyboardInterrupt
        Rows that were done are kept.

    Notes
    -----
    Trial k of a level depends on (seed, level, k) alone: rows do not depend on the executor, the order, or which other
    rows are run. Rows are committed as batches finish; after a process is killed, the same call runs the others.
    Several processes may share a store. A trial that fails is a row with its error.
    """
    study = load(spec).subset(trials, levels, methods)
    if batch_size < 1:
        raise SettingsError(f"batch_size is {batch_size}; give at least 1")
    workers = workers_of(executor, jobs, tasks)
    with Store(store, study) as kept, time_limited(time_limit):
        asked, missing = _missing(study, kept)
        batches = _batches(missing, batch_size, json.dumps(study.to_dict()))
        distribute(batches, kept, workers, asked=asked, progress=progress)
    return status(store)


def _missing(study: Study, store: Store) -> tuple[int, list[_RowKey]]:
    """Number of rows that are asked for, and those that the store lacks."""
    asked = [
        (level.text, trial, label)
        for level in study.axis.levels
        for trial in range(study.trials)
        for label in study.methods
    ]
    finished = set[_RowKey]().union(*(store.finished(x.text, range(study.trials)) for x in study.axis.levels))
    return len(asked), [row for row in asked if row not in finished]


@dataclass(frozen=True)
class _Batch:
    """Trials of one level that are run together."""

    study: str
    level: str
    trials: tuple[int, ...]
    methods: tuple[str, ...]

    @property
    def rows(self) -> Iterator[_RowKey]:
        """Level, trial and method of each row."""
        return ((self.level, trial, method) for trial in self.trials for method in self.methods)

    @property
    def task(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        """The call that runs the trials."""
        return run_trials, (self.study, self.level, self.trials, self.methods)

    def without(self, finished: AbstractSet[_RowKey]) -> list[_Batch]:
        """Batches of the rows that are not finished."""
        return _batches([row for row in self.rows if row not in finished], len(self.trials), self.study)

    def __str__(self) -> str:
        return f"trials {', '.join(map(str, self.trials))} at level {self.level}"


def _batches(rows: Sequence[_RowKey], size: int, study: str) -> list[_Batch]:
    """Rows in batches of one level and one set of methods, of `size` trials at most."""
    methods_of: dict[tuple[str, int], list[str]] = defaultdict(list)
    for level, trial, method in rows:
        methods_of[level, trial].append(method)
    trials_of: dict[tuple[str, tuple[str, ...]], list[int]] = defaultdict(list)
    for (level, trial), methods in methods_of.items():
        trials_of[level, tuple(methods)].append(trial)
    return [
        _Batch(study, level, tuple(trials[k : k + size]), methods)
        for (level, methods), trials in trials_of.items()
        for k in range(0, len(trials), size)
    ]
