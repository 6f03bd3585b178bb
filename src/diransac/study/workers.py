"""Where trials run: in processes of this machine, or wherever an executor takes them.

Never where Ctrl-C arrives: solvers swallow it, and say that there is no plan.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any, Protocol

from diransac.errors import SettingsError
from diransac.simulation import default_threads

__all__ = ["Given", "Processes", "Workers", "workers_of"]

_AHEAD = 2
"""Tasks a worker that are handed out: one to do, one to go on with."""

_AHEAD_OF_OTHERS = 64
"""Tasks that an executor of unknown size is handed."""


class Workers(Protocol):
    """What runs tasks; `stop` drops those that are not done."""

    tasks: int
    """How many tasks it is given at a time."""

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """A task's future."""

    def stop(self) -> None:
        """Drop what runs and what waits."""


def workers_of(executor: Executor | None, jobs: int | None, tasks: int | None) -> Workers:
    """What runs the trials.

    Parameters
    ----------
    executor : any executor; None: processes of this machine
    jobs : how many processes; None: as many as there are cores
    tasks : how many tasks to hand out at a time; None: enough to keep the workers busy

    Raises SettingsError: both an executor and jobs, or numbers below one.
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
    """An executor that somebody else made, and will shut down."""

    def __init__(self, executor: Executor, tasks: int) -> None:
        self.tasks, self._executor = tasks, executor
        self._futures: set[Future[Any]] = set()

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Hand it on."""
        future = self._executor.submit(function, *arguments)
        self._futures.add(future)
        future.add_done_callback(self._futures.discard)
        return future

    def stop(self) -> None:
        """Cancel what has not begun."""
        for future in list(self._futures):
            future.cancel()


class Processes:
    """Processes of this machine; those that die are replaced."""

    def __init__(self, jobs: int, tasks: int) -> None:
        self.tasks, self._jobs = tasks, jobs
        self._pool = self._new_pool()

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Hand it to a process; a new one, if one has died: the pool then takes no more tasks."""
        with _interrupts_held():
            try:
                return self._pool.submit(function, *arguments)
            except BrokenExecutor:
                self._pool.shutdown(wait=True)
                self._pool = self._new_pool()
                return self._pool.submit(function, *arguments)

    def stop(self) -> None:
        """End the processes, whatever they do."""
        for process in self._begun.processes:
            if process.pid is not None:  # it did begin
                process.terminate()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _new_pool(self) -> ProcessPoolExecutor:
        self._begun = _Begun()
        return ProcessPoolExecutor(self._jobs, self._begun, initializer=_begin)


class _Begun(SpawnContext):
    """How a pool begins processes, and which it has begun; spawned, for threads and solvers don't survive a fork."""

    def __init__(self) -> None:
        super().__init__()
        self.processes: list[SpawnProcess] = []

    def Process(self, *arguments: Any, **more: Any) -> SpawnProcess:  # type: ignore[override]
        """A process, noted."""
        self.processes.append(SpawnProcess(*arguments, **more))
        return self.processes[-1]


def _begin() -> None:
    """What a process does first: leave Ctrl-C to the one that began it, and end when that one does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Let Ctrl-C wait: a process that begins meanwhile would die of it, with a traceback, before it can ignore it."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
