"""Work in batches: handed to workers, kept as rows, and repeated where a worker was lost.

Workers are processes of this machine or those of an executor. Work never runs in the process that receives Ctrl-C:
solvers swallow the interrupt and report that there is no plan.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import random
import signal
import threading
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from collections.abc import Set as AbstractSet
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
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any, Protocol

from diransac.errors import SettingsError, StudyError
from diransac.process import module_path_safe
from diransac.simulation import default_threads
from diransac.time_limit import time_left

__all__ = ["Batch", "Given", "Progress", "Rows", "Workers", "connected", "distribute", "workers_of"]

Progress = Callable[[int, int], None]
"""Called with (rows present, rows asked for)."""

_ATTEMPTS = 3


class Batch(Protocol):
    """Rows that one call in a worker returns."""

    @property
    def rows(self) -> Iterable[Hashable]:
        """Key of each row."""

    @property
    def task(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        """Function of a module, and its arguments, all of which can be pickled; it returns the rows."""

    def without(self, finished: AbstractSet[Any]) -> Sequence[Batch]:
        """Batches of the rows that are not finished."""

    def __str__(self) -> str:
        """Subject of a sentence about the batch, in the plural."""


class Rows(Protocol):
    """A store, as the engine uses it."""

    def finished_in(self, batch: Any) -> AbstractSet[Any]:
        """Keys of the rows of a batch that are present."""

    def add(self, rows: Any) -> int:
        """Number of new rows, written in one transaction."""


def distribute(
    batches: Iterable[Batch], store: Rows, workers: Workers, *, asked: int, progress: Progress | None = None
) -> None:
    """Run batches, or those that end within the time limit of the context, and keep their rows.

    Parameters
    ----------
    batches : of the rows that the store lacks; another process may add some of them meanwhile
    store : takes the rows of a batch as it ends
    workers : run the batches; they are stopped at the end
    asked : rows that the store has or shall have
    progress : called with (rows present, rows asked for) at the start and whenever rows are added

    Raises
    ------
    StudyError
        A batch is lost repeatedly, or a worker cannot do the work at all.
    """
    try:
        _Work(batches, store, asked, progress or (lambda _done, _asked: None)).run(workers)
    finally:
        workers.stop()


class _Work:
    """Batches that wait and batches that run."""

    def __init__(self, batches: Iterable[Batch], store: Rows, asked: int, progress: Progress) -> None:
        self._store, self._progress, self._n_asked = store, progress, asked
        waiting = list(batches)
        self._missing = {row for batch in waiting for row in batch.rows}
        # Another process on the same store has another order, so that both seldom run the same batch.
        random.SystemRandom().shuffle(waiting)
        self._waiting = deque((batch, 0) for batch in waiting)
        self._running: dict[Future[Any], tuple[Batch, int]] = {}
        self._note(())

    def run(self, workers: Workers) -> None:
        """Run all batches, or those that end within the time limit.

        Raises StudyError: a batch is lost repeatedly, or a worker cannot do the work.
        """
        while (self._waiting or self._running) and (left := time_left()) > 0.0:
            while self._waiting and len(self._running) < workers.tasks:
                self._hand_out(workers, *self._waiting.popleft())
            timeout = left if math.isfinite(left) else None
            for future in wait(self._running, timeout, return_when=FIRST_COMPLETED).done:
                self._keep(*self._running.pop(future), future)

    def _hand_out(self, workers: Workers, batch: Batch, attempts: int) -> None:
        """Submit a batch, without rows that another process has kept meanwhile."""
        finished = self._store.finished_in(batch)
        if not self._missing.isdisjoint(finished):
            self._note(finished)
        for left in batch.without(finished):
            function, arguments = left.task
            self._running[workers.submit(function, *arguments)] = left, attempts

    def _keep(self, batch: Batch, attempts: int, future: Future[Any]) -> None:
        """Keep the rows of a batch, or queue it again if its worker was lost."""
        error = CancelledError("the executor cancelled it") if future.cancelled() else future.exception()
        if error is None:
            self._store.add(future.result())
            self._note(batch.rows)
            return
        if isinstance(error, StudyError):  # the worker is alive and would fail again
            raise StudyError(f"{error}; finished rows are kept") from error
        if attempts + 1 == _ATTEMPTS:
            guard = "" if not isinstance(error, BrokenExecutor) else ' (in a script, under if __name__ == "__main__":)'
            raise StudyError(
                f"{batch} were lost {_ATTEMPTS} times, at last by {type(error).__name__}: {error}; "
                f"finished rows are kept: look at the workers, then run again{guard}"
            ) from error
        self._waiting.append((batch, attempts + 1))

    def _note(self, finished: Iterable[Hashable]) -> None:
        """Report the number of rows, these included."""
        self._missing.difference_update(finished)
        self._progress(self._n_asked - len(self._missing), self._n_asked)


# Workers --------------------------------------------------------------------------------------------------------------


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
        # Tasks that are handed to an executor of unknown size.
        return Given(executor, tasks or 64)
    jobs = default_threads() if jobs is None else jobs
    # Tasks per worker that are handed out: one that runs and one that waits.
    return Processes(jobs, tasks or 2 * jobs)


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
        with _interrupts_held(), module_path_safe():
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
        with module_path_safe():  # the pool's first lock starts a process that tracks it
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
                f"the scheduler at {address} was lost; finished rows are kept: start another, then run again"
            ) from error
