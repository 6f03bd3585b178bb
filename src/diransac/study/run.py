"""`run_study` distributes trials to workers and keeps their rows.

Workers are processes of this machine or those of an executor. Trials never run in the process that receives Ctrl-C:
solvers swallow the interrupt and report that there is no plan.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import random
import signal
import threading
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing.context import SpawnContext, SpawnProcess
from pathlib import Path
from typing import Any, Protocol

from diransac.errors import SettingsError, StudyError
from diransac.simulation import default_threads
from diransac.study.library import load
from diransac.study.reading import Status, status
from diransac.study.specification import Study
from diransac.study.store import Store
from diransac.study.trials import run_trials
from diransac.time_limit import time_left, time_limited

__all__ = ["BATCH_SIZE", "Progress", "connected", "run_study"]

Progress = Callable[[int, int], None]
_RowKey = tuple[str, int, str]
"""Level, trial and method."""

BATCH_SIZE = 4
"""Trials per task: enough to fill the vectors of a simulation, few enough that a killed process loses little."""

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
    with Store(store, study) as kept:
        try:
            with time_limited(time_limit):
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
    def rows(self) -> Iterator[_RowKey]:
        """Level, trial and method of each row."""
        return ((self.level, trial, method) for trial in self.trials for method in self.methods)


class _Work:
    """Batches that wait and batches that run."""

    def __init__(self, study: Study, store: Store, batch_size: int, progress: Progress) -> None:
        self._text, self._store, self._progress = json.dumps(study.to_dict()), store, progress
        asked = [
            (level.text, trial, label)
            for level in study.axis.levels
            for trial in range(study.trials)
            for label in study.methods
        ]
        finished = set[_RowKey]().union(*(store.finished(x.text, range(study.trials)) for x in study.axis.levels))
        missing = [row for row in asked if row not in finished]
        batches = _batches(missing, batch_size)
        # Another process on the same store has another order, so that both seldom run the same batch.
        random.SystemRandom().shuffle(batches)
        self._waiting = deque(batches)
        self._running: dict[Future[Any], _Batch] = {}
        self._n_asked, self._missing = len(asked), set(missing)
        self._note(())

    def run(self, workers: Workers) -> None:
        """Run all batches, or those that end within the time limit.

        Raises StudyError: a batch is lost repeatedly, or a worker cannot run the study.
        """
        while (self._waiting or self._running) and (left := time_left()) > 0.0:
            while self._waiting and len(self._running) < workers.tasks:
                self._hand_out(workers, self._waiting.popleft())
            timeout = left if math.isfinite(left) else None
            for future in wait(self._running, timeout, return_when=FIRST_COMPLETED).done:
                self._keep(self._running.pop(future), future)

    def _hand_out(self, workers: Workers, batch: _Batch) -> None:
        """Submit a batch, without rows that another process has kept meanwhile."""
        finished = self._store.finished(batch.level, batch.trials)
        if not finished.isdisjoint(self._missing):
            self._note(finished)
        for left in _batches([row for row in batch.rows if row not in finished], len(batch.trials)):
            future = workers.submit(run_trials, self._text, left.level, left.trials, left.methods)
            self._running[future] = replace(left, attempts=batch.attempts)

    def _keep(self, batch: _Batch, future: Future[Any]) -> None:
        """Keep the rows of a batch, or queue it again if its worker was lost."""
        error = CancelledError("the executor cancelled it") if future.cancelled() else future.exception()
        if error is None:
            self._store.add(future.result())
            self._note(batch.rows)
            return
        if isinstance(error, StudyError):  # the worker is alive and would fail again
            raise StudyError(f"{error}; finished rows are kept") from error
        if batch.attempts + 1 == _ATTEMPTS:
            which = ", ".join(map(str, batch.trials))
            guard = "" if not isinstance(error, BrokenExecutor) else ' (in a script, under if __name__ == "__main__":)'
            raise StudyError(
                f"trials {which} at level {batch.level} were lost {_ATTEMPTS} times, at last by "
                f"{type(error).__name__}: {error}; finished rows are kept: look at the workers, then run again{guard}"
            ) from error
        self._waiting.append(replace(batch, attempts=batch.attempts + 1))

    def _note(self, finished: Iterable[_RowKey]) -> None:
        """Report the number of rows, these included."""
        self._missing.difference_update(finished)
        self._progress(self._n_asked - len(self._missing), self._n_asked)


def _batches(rows: Sequence[_RowKey], size: int) -> list[_Batch]:
    """Rows in batches of one level and one set of methods, of `size` trials at most."""
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


# Workers --------------------------------------------------------------------------------------------------------------
_AHEAD = 2
"""Tasks per worker that are handed out: one that runs and one that waits."""

_AHEAD_OF_OTHERS = 64
"""Tasks that are handed to an executor of unknown size."""


class Workers(Protocol):
    """Runs tasks; `stop` drops those that are not done."""

    tasks: int
    """Number of tasks handed out at a time."""

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Future of a task."""

    def stop(self) -> None:
        """Drop the tasks that run or wait."""


def workers_of(executor: Executor | None, jobs: int | None, tasks: int | None) -> Workers:
    """Workers of an executor, or processes of this machine.

    Raises SettingsError: both an executor and a number of jobs, or numbers below one.
    """
    for name, number in (("jobs", jobs), ("tasks", tasks)):
        if number is not None and number < 1:
            raise SettingsError(f"{name} is {number}; give at least 1")
    if executor is not None:
        if jobs is not None:
            raise SettingsError(
                "jobs is the number of processes on this machine, but an executor is given; give one of them"
            )
        return Given(executor, tasks or _AHEAD_OF_OTHERS)
    jobs = default_threads() if jobs is None else jobs
    return Processes(jobs, tasks or _AHEAD * jobs)


class Given:
    """An executor of the caller, who also shuts it down."""

    def __init__(self, executor: Executor, tasks: int) -> None:
        self.tasks, self._executor = tasks, executor
        self._futures: set[Future[Any]] = set()

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Future of a task in the executor."""
        future = self._executor.submit(function, *arguments)
        self._futures.add(future)
        future.add_done_callback(self._futures.discard)
        return future

    def stop(self) -> None:
        """Cancel tasks that have not begun."""
        for future in list(self._futures):
            future.cancel()


class Processes:
    """Processes of this machine; those that die are replaced."""

    def __init__(self, jobs: int, tasks: int) -> None:
        self.tasks, self._jobs = tasks, jobs
        self._pool = self._new_pool()

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Future of a task in a process; a pool with a dead process is replaced, as it takes no more tasks."""
        with _interrupts_held():
            try:
                return self._pool.submit(function, *arguments)
            except BrokenExecutor:
                self._pool.shutdown(wait=True)
                self._pool = self._new_pool()
                return self._pool.submit(function, *arguments)

    def stop(self) -> None:
        """Terminate the processes."""
        for process in self._begun.processes:
            if process.pid is not None:  # it was started
                process.terminate()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _new_pool(self) -> ProcessPoolExecutor:
        self._begun = _Begun()
        return ProcessPoolExecutor(self._jobs, self._begun, initializer=_begin)


class _Begun(SpawnContext):
    """Context that lists the processes of a pool; spawned, as threads and solvers do not survive a fork."""

    def __init__(self) -> None:
        super().__init__()
        self.processes: list[SpawnProcess] = []

    def Process(self, *arguments: Any, **more: Any) -> SpawnProcess:  # type: ignore[override]
        """A new process, which is added to the list."""
        self.processes.append(SpawnProcess(*arguments, **more))
        return self.processes[-1]


def _begin() -> None:
    """Set up a worker process: it ignores Ctrl-C and ends with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Hold Ctrl-C back: a process that starts meanwhile would end with a traceback before it can ignore the signal."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


# Cluster --------------------------------------------------------------------------------------------------------------
_CONNECTION_TIMEOUT = "10s"


@contextmanager
def connected(address: str) -> Iterator[tuple[Executor, int]]:
    """Executor of a Dask cluster, and the number of tasks that keeps its workers busy.

    Parameters
    ----------
    address : of the scheduler, such as ``tcp://host:8786``

    Raises
    ------
    SettingsError
        Dask is not installed.
    StudyError
        There is no scheduler at the address, or it was lost.
    """
    try:
        from distributed.client import Client, ClosedClientError
    except ModuleNotFoundError as error:
        raise SettingsError("a cluster needs Dask, which is not installed; pip install 'diransac[cluster]'") from error
    try:
        client = Client(address, timeout=_CONNECTION_TIMEOUT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise StudyError(f"no scheduler at {address}: {error}; start one with dask scheduler") from error
    with client:
        try:
            yield client.get_executor(), 2 * max(32, sum(client.nthreads().values()))
        except ClosedClientError as error:
            raise StudyError(
                f"the scheduler at {address} was lost; finished rows are kept: start another, then run the study again"
            ) from error
