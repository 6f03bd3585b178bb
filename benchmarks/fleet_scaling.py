"""A fleet of thousands of short logs: rows per second and processor time over numbers of workers, bytes and memory.

``python benchmarks/fleet_scaling.py [--logs 10000] [--workers 1,2] [--method ols]``

Logs have 200 rows, which makes the overhead of a row as visible as it can be.  Efficiency is the processor time of a
row in a loop of one process, `read_log` and `identify`, over that of a row with workers, those of the scheduler and of
the receiving process included.  The loop is measured before and after, as other work makes processors slower.
"""

from __future__ import annotations

import argparse
import logging
import multiprocessing
import os
import pickle
import resource
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
from fleet import PATTERN, write_flight

import diransac as dr
from diransac.study import connected, identify_each

N_ROWS, N_BASES, N_PLAIN = 200, 20, 200
BASE = {"mass": 0.249, "inertia": 0.004, "drag": 0.025, "loss": 0.0}


def write_logs(folder: Path, n: int) -> list[Path]:
    """Parts of a few flights, each with a rounding of its own: no two files are equal."""
    rng, files = np.random.default_rng(5), list[Path]()
    lines = []
    for k in range(N_BASES):
        path = folder / f"base{k}.csv"
        write_flight(path, **BASE, rng=np.random.default_rng(k))
        lines.append(path.read_text().splitlines())
        path.unlink()
    for k in range(n):
        vehicle = folder / f"v{k // 100:04d}"
        vehicle.mkdir(exist_ok=True)
        head, *rows = lines[k % N_BASES]
        first = int(rng.integers(0, len(rows) - N_ROWS))
        part = np.array([[float(x) for x in row.split(",")] for row in rows[first : first + N_ROWS]])
        part[:, 0] -= part[0, 0]
        part[:, 1:] += 1e-6 * rng.standard_normal(part[:, 1:].shape)
        files.append(vehicle / f"{k % 100:02d}.csv")
        np.savetxt(files[-1], part, fmt="%.9g", delimiter=",", header=head, comments="")
    return files


def used() -> float:
    """Processor time of this process and of its children that have ended, s."""
    both = (resource.getrusage(x) for x in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(x.ru_utime + x.ru_stime for x in both)


def timed(run: Callable[[], object]) -> tuple[float, float]:
    """Seconds and processor time of a call, its children included."""
    begin, before = time.perf_counter(), used()
    run()
    return time.perf_counter() - begin, used() - before


def loop(files: Sequence[Path], method: str) -> None:
    """Identify from each file in this process, as a script would."""
    model = dr.models.planar_rotorcraft()
    for file in files:
        dr.identify(model, dr.read_log(file), method)


@contextmanager
def cluster_of(n: int) -> Iterator[tuple[Executor, int]]:
    """Executor of a Dask cluster of so many processes, and the number of tasks that keeps them busy."""
    from distributed import LocalCluster

    quiet = {"dashboard_address": None, "silence_logs": logging.CRITICAL}
    with (
        LocalCluster(n_workers=n, threads_per_worker=1, **quiet) as cluster,
        connected(cluster.scheduler_address) as found,
    ):
        yield found


def in_a_loop(files: Sequence[Path], method: str) -> float:
    """Processor time of a row in a loop, s, which is printed."""
    seconds, work = (x / len(files) for x in timed(lambda: loop(files, method)))
    print(f"a loop: {1 / seconds:.0f} rows/s, {1e3 * work:.1f} ms of processor time a row", flush=True)
    return work


def on_dask(n: int, run: Callable[..., object]) -> None:
    """Call with the executor of a cluster of so many processes."""
    with cluster_of(n) as (executor, tasks):
        run(executor=executor, tasks=tasks)


def empty_tasks(n: int) -> float:
    """Tasks per second of a Dask cluster of two processes, if they do nothing."""
    with cluster_of(2) as (executor, _):
        begin = time.perf_counter()
        list(executor.map(abs, range(n)))
        return n / (time.perf_counter() - begin)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--logs", type=int, default=10_000)
    parser.add_argument("--workers", default="1,2")
    parser.add_argument("--method", default="ols")
    given = parser.parse_args()
    os.environ["DIRANSAC_THREADS"] = "1"
    model, options = dr.models.planar_rotorcraft(), {"vehicle": PATTERN}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files = write_logs(folder, given.logs)
        few = files[:N_PLAIN]
        loop(files[:5], given.method)
        plain = in_a_loop(few, given.method)
        identify_each(model, few[:8], given.method, store=folder / "warm.db", jobs=1, **options)
        for kind in ("processes", "Dask"):
            for n in map(int, given.workers.split(",")):
                store = folder / f"{kind}{n}.db"
                run = partial(identify_each, model, files, given.method, store=store, **options)
                wall, work = timed(partial(run, jobs=n) if kind == "processes" else partial(on_dask, n, run))
                row, stored = work / len(files), store.stat().st_size / len(files)
                print(
                    f"{n} {kind}: {len(files) / wall:.0f} rows/s, {1e3 * row:.1f} ms of processor time a row, "
                    f"efficiency {100 * plain / row:.0f} %; store {stored:.0f} bytes a row"
                )
        in_a_loop(few, given.method)
        size = len(pickle.dumps(model))
        print(f"Dask, tasks that do nothing: {empty_tasks(5000):.0f}/s; the model of a task has {size} bytes")
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        print(f"peak memory of the receiving process: {peak / 1024:.0f} MiB after {len(files)} logs")


if __name__ == "__main__":
    multiprocessing.freeze_support()
    main()
