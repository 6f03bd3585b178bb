"""`run_work`: rows computed in batches by workers, kept in a store, and computed again where a worker was lost.

Workers are processes of this machine or those of an executor. Work never runs in the process that receives Ctrl-C:
solvers swallow the interrupt and report that there is no plan.
"""

from __future__ import annotations

import math
import random
import signal
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager, suppress
from itertools import chain
from multiprocessing.context import SpawnContext, SpawnProcess
from pathlib import Path
from typing import Any

from diransac.errors import SettingsError, StudyError
from diransac.process import end_with_parent, module_path_safe
from diransac.simulation import default_threads
from diransac.study.store import Key, Store, Work
from diransac.time_limit import time_left, time_limited

# Logs of a batch, and work of joined ones at most, s: what is lost with a worker, and far more than a task's price.
_LOGS, _SECONDS = 4, 1.0

Progress = Callable[[int, int], None]
"""Called with (rows present, rows asked for)."""

Computation = Callable[[Sequence[Key]], Sequence[dict[str, Any]]]
"""Rows of some keys, which differ in one trial or log; called in a worker, to which it is pickled."""


def run_work(
    work: Work,
    compute: Computation,
    *,
    store: str | Path,
    executor: Executor | None,
    jobs: int | None,
    batch_size: int | None,
    tasks: int | None,
    time_limit: float | None,
    progress: Progress | None,
    stale: Callable[[Store, Iterable[Key]], Iterable[Key]] = lambda *_: (),
) -> None:
    """Compute the rows of a work that a store lacks.

    Parameters
    ----------
    work : study or fleet
    compute : of a batch of rows; a row that fails says so, an error ends the run
    batch_size : trials or logs of a batch; None: logs, four or as many as take about a second
    store, executor, jobs, tasks, time_limit, progress : as in `run_study`
    stale : those of some rows of the store that are to be computed again

    Raises
    ------
    SettingsError
        Both an executor and a number of jobs, or numbers below one.
    StudyError
        The store has another configuration, a batch is lost repeatedly, or a worker cannot do the work at all.
    """
    for name, number in (("jobs", jobs), ("batch_size", batch_size), ("tasks", tasks)):
        if number is not None and number < 1:
            raise SettingsError(f"{name} is {number}; give at least 1")
    if executor is not None and jobs is not None:
        raise SettingsError(
            "jobs is the number of processes on this machine, but an executor is given; give one of them"
        )
    jobs = default_threads() if jobs is None else jobs
    # Tasks handed out: to an executor of unknown size 64, to a process one that runs and one that waits.
    tasks = tasks or (64 if executor else 2 * jobs)
    with Store(store, work) as kept, time_limited(time_limit):
        asked = work.asked
        kept.forget(stale(kept, asked))
        finished = kept.finished()
        missing = [key for key in asked if key not in finished]
        note = progress or (lambda _done, _asked: None)
        run = _Run(compute, _batches(missing, batch_size or _LOGS), kept, len(asked), note, joins=batch_size is None)
        if executor is not None:
            run.on(executor, tasks)
            return
        processes = Processes(jobs)
        try:
            run.on(processes, tasks)
        finally:
            processes.shutdown()


def _batches(keys: Iterable[Key], size: int) -> list[tuple[Key, ...]]:
    """Keys in batches of one level and `size` trials at most; a log is a trial."""
    levels: dict[Key, dict[Key, list[Key]]] = defaultdict(lambda: defaultdict(list))
    for key in keys:
        levels[key[:1] if len(key) > 1 else ()][key[:2]].append(key)
    of_trials = [list(trials.values()) for trials in levels.values()]
    return [tuple(chain(*some[k : k + size])) for some in of_trials for k in range(0, len(some), size)]


def _timed(compute: Computation, keys: Sequence[Key]) -> tuple[Sequence[dict[str, Any]], float]:
    """Rows of a batch, and the seconds that they took a worker."""
    begin = time.perf_counter()
    return compute(keys), time.perf_counter() - begin


class _Run:
    """Batches that wait and batches that run."""

    def __init__(
        self,
        compute: Computation,
        batches: Sequence[tuple[Key, ...]],
        store: Store,
        asked: int,
        progress: Progress,
        *,
        joins: bool,
    ) -> None:
        self._compute, self._store, self._progress, self._n_asked = compute, store, progress, asked
        self._joins, self._most, self._n_timed, self._seconds = joins, 0, 0, 0.0
        self._missing = set(chain(*batches))
        # Another process on the same store has another order, so that both seldom run the same batch.
        self._waiting = deque((batch, 0) for batch in random.SystemRandom().sample(batches, len(batches)))
        self._running: dict[Future[Any], tuple[tuple[Key, ...], int]] = {}
        self._note(())

    def on(self, executor: Executor, tasks: int) -> None:
        """Run all batches, or those that end within the time limit of the context; others are cancelled.

        Raises StudyError: a batch is lost repeatedly, or a worker cannot do the work.
        """
        try:
            while (self._waiting or self._running) and (left := time_left()) > 0.0:
                while self._waiting and len(self._running) < tasks:
                    self._hand_out(executor, *self._next())
                timeout = left if math.isfinite(left) else None
                for future in wait(self._running, timeout, return_when=FIRST_COMPLETED).done:
                    self._keep(*self._running.pop(future), future)
        except KeyboardInterrupt:
            with suppress(StudyError):  # it may have come between keeping rows and counting them
                self._note(self._store.finished())
            raise
        finally:
            for future in self._running:
                future.cancel()

    def _next(self) -> tuple[tuple[Key, ...], int]:
        """The next batch, joined with those behind it while they are short: a task has its price.

        Those that end first are the short ones: joined batches at most double.
        """
        batch, attempts = self._waiting.popleft()
        each = self._seconds / self._n_timed if self._n_timed else math.inf
        while self._joins and self._waiting and not attempts:
            more, lost = self._waiting[0]
            n = len(batch) + len(more)
            if lost or n > self._most or n * each > _SECONDS:
                break
            batch += self._waiting.popleft()[0]
        return batch, attempts

    def _hand_out(self, executor: Executor, batch: tuple[Key, ...], attempts: int) -> None:
        """Submit a batch, without rows that another process has kept meanwhile."""
        finished = self._store.finished(batch)
        if finished:
            self._note(finished)
        left = tuple(key for key in batch if key not in finished)
        if left:
            self._running[executor.submit(_timed, self._compute, left)] = left, attempts

    def _keep(self, batch: tuple[Key, ...], attempts: int, future: Future[Any]) -> None:
        """Keep the rows of a batch, or queue it again if its worker was lost."""
        error = CancelledError("the executor cancelled it") if future.cancelled() else future.exception()
        if error is None:
            rows, seconds = future.result()
            self._seconds, self._n_timed = self._seconds + seconds, self._n_timed + len(batch)
            self._most = max(self._most, 2 * len(batch))
            self._store.add(rows)
            self._note(batch)
            return
        if isinstance(error, StudyError):  # the worker is alive and would fail again
            raise StudyError(f"{error}; finished rows are kept") from error
        most = 3
        if attempts + 1 == most:
            guard = "" if not isinstance(error, BrokenExecutor) else ' (in a script, under if __name__ == "__main__":)'
            rows = ", ".join(" ".join(map(str, key)) for key in batch)
            raise StudyError(
                f"rows {rows} were lost {most} times, at last by {type(error).__name__}: {error}; "
                f"finished rows are kept: look at the workers, then run again{guard}"
            ) from error
        size = _LOGS if self._joins else len(batch)
        self._waiting.extend((batch[k : k + size], attempts + 1) for k in range(0, len(batch), size))

    def _note(self, finished: Iterable[Key]) -> None:
        """Report the number of rows, these included."""
        self._missing.difference_update(finished)
        self._progress(self._n_asked - len(self._missing), self._n_asked)


# Processes of this machine --------------------------------------------------------------------------------------------
class Processes(Executor):
    """Processes of this machine; those that die are replaced."""

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._pool = self._new_pool()

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        """Future of a task in a process; a pool with a dead process is replaced, as it takes no more tasks."""
        with _interrupts_held(), module_path_safe():
            try:
                return self._pool.submit(function, *arguments, **named)
            except BrokenExecutor:
                self._pool.shutdown(wait=True)
                self._pool = self._new_pool()
                return self._pool.submit(function, *arguments, **named)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = True) -> None:
        """Terminate the processes."""
        for process in self._begun.processes:
            if process.pid is not None:  # it was started
                process.terminate()
        self._pool.shutdown(wait=wait, cancel_futures=cancel_futures)

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
    end_with_parent()


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
