"""`run_study`: hand out trials, keep what comes back."""

from __future__ import annotations

import json
import random
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from diransac.errors import SettingsError, StudyError
from diransac.study.library import load
from diransac.study.reading import Status, status
from diransac.study.specification import Study
from diransac.study.store import Store
from diransac.study.trials import run_trials
from diransac.study.workers import Workers, workers_of

__all__ = ["BATCH_SIZE", "Progress", "run_study"]

Progress = Callable[[int, int], None]
_Row = tuple[str, int, str]
"""Level, trial and method."""

BATCH_SIZE = 4
"""Trials a task: with a few methods each, their flights fill vectors, and little is lost with a killed process."""

_ATTEMPTS = 3


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
    progress: Progress | None = None,
) -> Status:
    """Run what a store lacks of a study; a row of it is a level, trial and method.

    Trial k of a level depends on (seed, level, k) alone: rows are the same whatever runs them, in whatever company and
    order. They are kept as they come; a process that is killed loses what it had not handed over, and the same call
    runs the rest. Several processes may work on one store. A trial that fails is a row that says why.

    Parameters
    ----------
    spec : the name of a study that the package brings, a TOML file, its tables, or a `Study`
    store : SQLite file; a new one is made where there is none
    executor : what runs the trials, any executor of `concurrent.futures` or one that is like it (Dask's
        ``client.get_executor()``); None: processes of this machine, for which a script needs ``if __name__ ==
        "__main__":``
    jobs : how many of these processes; None: as many as there are cores
    trials, levels, methods : so many trials, at these levels, of these methods; None: those of the study
    batch_size : trials of a level that are run together
    tasks : how many batches are handed out at a time; None: two a process, 64 to an executor
    progress : called with (rows that are there, rows that were asked for) now and whenever there are more

    Returns how far the store is.

    Raises SettingsError: an argument or the study has no meaning. StudyError: the store was made by another
    configuration, workers are lost again and again, or one of them lacks the file of the study's plant.
    KeyboardInterrupt: what is done is kept.
    """
    study = load(spec).narrowed(trials, levels, methods)
    if batch_size < 1:
        raise SettingsError(f"batch_size is {batch_size}; give at least 1")
    workers = workers_of(executor, jobs, tasks)
    with Store(store, study) as kept:
        try:
            _Work(study, kept, batch_size, progress or (lambda _done, _asked: None)).run(workers)
        finally:
            workers.stop()
    return status(store)


@dataclass(frozen=True)
class _Batch:
    """Trials of one level that are run together."""

    level: str
    trials: tuple[int, ...]
    methods: tuple[str, ...]
    attempts: int = 0

    @property
    def rows(self) -> Iterator[_Row]:
        """Level, trial and method of each."""
        return ((self.level, trial, method) for trial in self.trials for method in self.methods)


class _Work:
    """Batches that wait and that run."""

    def __init__(self, study: Study, store: Store, batch_size: int, progress: Progress) -> None:
        self._text, self._store, self._progress = json.dumps(study.to_dict()), store, progress
        asked = [
            (level.text, trial, label)
            for level in study.axis.levels
            for trial in range(study.trials)
            for label in study.methods
        ]
        finished = set[_Row]().union(*(store.finished(x.text, range(study.trials)) for x in study.axis.levels))
        missing = [row for row in asked if row not in finished]
        batches = _batches(missing, batch_size)
        # Another process on the same store takes another order: they seldom run the same batch.
        random.SystemRandom().shuffle(batches)
        self._waiting = deque(batches)
        self._running: dict[Future[Any], _Batch] = {}
        self._n_asked, self._missing = len(asked), set(missing)
        self._note(())

    def run(self, workers: Workers) -> None:
        """Run all.  Raises StudyError: a batch is lost again and again, or a worker cannot run the study."""
        while self._waiting or self._running:
            while self._waiting and len(self._running) < workers.tasks:
                self._hand_out(workers, self._waiting.popleft())
            for future in wait(self._running, return_when=FIRST_COMPLETED).done:
                self._keep(self._running.pop(future), future)

    def _hand_out(self, workers: Workers, batch: _Batch) -> None:
        """Give workers a batch, but for what another process has kept meanwhile."""
        finished = self._store.finished(batch.level, batch.trials)
        if not finished.isdisjoint(self._missing):
            self._note(finished)
        for left in _batches([row for row in batch.rows if row not in finished], len(batch.trials)):
            future = workers.submit(run_trials, self._text, left.level, left.trials, left.methods)
            self._running[future] = replace(left, attempts=batch.attempts)

    def _keep(self, batch: _Batch, future: Future[Any]) -> None:
        """Keep what a batch gave; one whose worker was lost waits again."""
        error = CancelledError("the workers gave it up") if future.cancelled() else future.exception()
        if error is None:
            self._store.add(future.result())
            self._note(batch.rows)
            return
        if isinstance(error, StudyError):  # the worker lives, and would fail again, each time at once
            raise StudyError(f"{error}; all that is done is kept") from error
        if batch.attempts + 1 == _ATTEMPTS:
            which = ", ".join(map(str, batch.trials))
            guard = "" if not isinstance(error, BrokenExecutor) else ' (in a script, under if __name__ == "__main__":)'
            raise StudyError(
                f"trials {which} at level {batch.level} were lost {_ATTEMPTS} times, at last by "
                f"{type(error).__name__}: {error}; all that is done is kept: look at the workers, then run again{guard}"
            ) from error
        self._waiting.append(replace(batch, attempts=batch.attempts + 1))

    def _note(self, finished: Iterable[_Row]) -> None:
        """Say how many rows there are, with these."""
        self._missing.difference_update(finished)
        self._progress(self._n_asked - len(self._missing), self._n_asked)


def _batches(rows: Sequence[_Row], size: int) -> list[_Batch]:
    """Rows in batches of a level and so many trials, those together that lack the same methods."""
    methods_of: dict[tuple[str, int], list[str]] = defaultdict(list)
    for level, trial, method in rows:
        methods_of[level, trial].append(method)
    trials_of: dict[tuple[str, tuple[str, ...]], list[int]] = defaultdict(list)
    for (level, trial), methods in methods_of.items():
        trials_of[level, tuple(methods)].append(trial)
    return [
        _Batch(level, tuple(trials[k : k + size]), methods)
        for (level, methods), trials in trials_of.items()
        for k in range(0, len(trials), size)
    ]
