"""What a user waits for: the default method warm, cold, from a model seen before, on long logs and on real records.

Run it as ``python benchmarks/waiting.py [--rows N ...] [--repetitions N] [--without-models] [--records emps,go2-RL]``
for a table of ratios.  Every figure is processor time, or peak memory, of processes of one thread; ratios hold on a
machine with other work, too, and the least of several repetitions in turns is the least disturbed; real records are
identified once.  Figs. 2-5 of the paper take minutes to hours: ``diransac study run fig2 --store fig2.db`` shows its
own time.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import compile_time
from kernel import CLoops, medians, score
from real import DATA, RECORDS, chosen_records, rows_of
from speed import N_ROWS, bench_of, hour_log, row, spoilt_log

import diransac as dr
from diransac.simulation import rollouts

SINGLE = {"DIRANSAC_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
BOUNDS = {N_ROWS: "", 100_000: "1.0, aim 0.5", 3_600_000: "1.0, aim 0.5"}
IMPORTS = "import numpy, casadi, polars"


def processor_time(command: Sequence[str], environment: Mapping[str, str]) -> float:
    """Processor time of a child process, s."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def measured_here(*arguments: str) -> dict[str, float]:
    """What this file prints as JSON in a process of its own."""
    printed = subprocess.run(
        [sys.executable, __file__, *arguments], env=os.environ | SINGLE, check=True, capture_output=True, text=True
    ).stdout
    found: dict[str, float] = json.loads(printed)
    return found


def fit_again(repetitions: int) -> None:
    """Print the least processor time of a fit of the rotorcraft by a process that has fitted it before."""
    model, log = dr.models.planar_rotorcraft(), spoilt_log(N_ROWS)
    times = []
    for _ in range(repetitions + 1):
        begin = time.process_time()
        dr.identify(model, log)
        times.append(time.process_time() - begin)
    print(json.dumps({"seconds": min(times[1:])}))


def fit_long(n_rows: int, repetitions: int) -> None:
    """Print processor time and memory of a fit of a long log at 1 kHz, after that of a short one."""
    model, log = dr.models.planar_rotorcraft(), hour_log(n_rows)
    dr.identify(model, log.between(0.0, 2.0))
    before, times = resident(), []
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew: making the log took memory, too
    for _ in range(repetitions if n_rows <= N_ROWS else 1):
        begin = time.process_time()
        dr.identify(model, log)
        times.append(time.process_time() - begin)
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(json.dumps({"seconds": min(times), "bytes": (1024 * after - before) / n_rows}))


def resident() -> int:
    """Memory of this process that is in use, bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def compare_cold(repetitions: int) -> None:
    """A whole command over the import of its libraries: with an empty cache of machine code, and after that."""
    times: dict[str, list[float]] = {"imports": [], "first": [], "second": []}
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "flight.csv"
        spoilt_log(N_ROWS).write(log)
        identify = [sys.executable, "-m", "diransac", "identify", str(log), "--model", "planar-rotorcraft"]
        compiled = {"PYTHONPYCACHEPREFIX": str(Path(folder) / "bytecode")}
        environment = {k: x for k, x in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"} | SINGLE | compiled
        processor_time(identify, environment | {"DIRANSAC_CACHE": "off"})  # modules are compiled, as by an installation
        for k in range(repetitions):
            environment["DIRANSAC_CACHE"] = str(Path(folder) / str(k))
            times["imports"].append(processor_time([sys.executable, "-c", IMPORTS], environment))
            times["first"].append(processor_time(identify, environment))
            times["second"].append(processor_time(identify, environment))
    least = {name: min(x) for name, x in times.items()}
    for name, bound in (("first", "5, aim 3.5"), ("second", "2.2, aim 1.7")):
        text = f"{name} cold diransac identify / {IMPORTS}"
        row(text, least[name] / least["imports"], bound, f"{least[name]:.2f} s, imports {least['imports']:.2f} s")


def compare_models() -> None:
    """First fits of larger models: ever, and by a new process that finds machine code on disk."""
    bounds = {
        "leg of 3 joints": "5 s, aim 2 s",
        "quadrotor": "8 s, aim 3 s",
        "chain of 8 masses, 8 inputs": "20 s, aim 8 s",
        "arm of 7 joints, 21 unknown": "20 s, aim 8 s",
    }
    largest = 0.0
    for name, bound in bounds.items():
        with tempfile.TemporaryDirectory() as folder:
            cold, cached = (compile_time.measured(name, folder) for _ in range(2))
        row(f"{name}: first fit, model seen before / next", cached["first"] / cached["next"], "1.5, aim 1.2")
        row("    first fit ever / next", cold["first"] / cold["next"], bound, f"{cold['first']:.1f} s")
        largest = max(largest, cold["MB"])
    row("peak memory of the largest of these, GiB", largest / 1024, "1.5, aim 0.8")


def compare_lengths(lengths: Sequence[int], repetitions: int) -> None:
    """Time and memory per row of long logs."""
    short = measured_here("--fit-long", str(N_ROWS), "--repetitions", str(repetitions))["seconds"] / N_ROWS
    for n in lengths:
        found = measured_here("--fit-long", str(n), "--repetitions", "1")
        ratio, note = (
            found["seconds"] / n / short,
            f"{found['seconds']:.1f} s; {1e6 * short:.0f} us per row of {N_ROWS:,}",
        )
        row(f"lo-diransac, {n:,} rows / {N_ROWS:,} rows, per row", ratio, BOUNDS.get(n, ""), note)
        row("    peak memory, kB per row", found["bytes"] / 1000, "2.5, aim 1")


def fit_record(name: str) -> None:
    """Print processor times of the methods that apply to a real record, the default after the others."""
    methods = ("ols", "output error", "mujoco.sysid", "default")
    rows = rows_of(RECORDS[name](DATA), methods)
    print(json.dumps({row["method"]: row["seconds"] for row in rows if row.get("parameters")}))


def compare_records(names: Sequence[str]) -> None:
    """The default over least squares and output error together, or over MuJoCo's where that one stands in."""
    for name in names:
        found = measured_here("--fit-record", name)
        others = [x for x in ("ols", "output error", "mujoco.sysid") if x in found][:2]
        if "default" in found and others:
            note = f"{found['default']:.1f} s; " + ", ".join(f"{x} {found[x]:.1f} s" for x in others)
            row(f"{name}: default / {' + '.join(others)}", found["default"] / sum(found[x] for x in others), "1", note)


def compare_kernel() -> None:
    """Scores of 1,024 rollouts over the loop in C."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            bench = bench_of(CLoops(folder))
        except OSError as missing:
            row("1,024 rollouts / the C loop", None, note=f"left out: no C compiler ({missing})")
            return
        assert bench.loops is not None
        by_c, _, _ = bench.loops.bound("rotorcraft", bench.problem)
        engine = rollouts(bench.model)
        found = medians({"c": by_c, "kernel": lambda: score(engine, bench.problem)}, time.process_time)
        share = bench.loops.share_of_peak("rotorcraft", found["c"])
        note = (
            f"the C loop has {share:.0%} of the peak of its multiply-add ports" if share else "gcc took half the width"
        )
        row("1,024 rollouts / the C loop", found["kernel"] / found["c"], "1.1, aim 1.0", note)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, nargs="*", default=[100_000], help="lengths of the long logs")
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--without-models", action="store_true", help="leave out the larger models")
    parser.add_argument("--records", default=None, help="beginnings of the real records' names, separated by commas")
    parser.add_argument("--fit-again", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--fit-long", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--fit-record", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.fit_again:
        fit_again(given.repetitions)
        return
    if given.fit_long:
        fit_long(given.fit_long, given.repetitions)
        return
    if given.fit_record:
        fit_record(given.fit_record)
        return
    print(f"processor time, least of {given.repetitions}; load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores\n")
    print(f"{'':<66}{'ratio':>10}  {'at most':<16}measured")
    warm = measured_here("--fit-again", "--repetitions", str(given.repetitions))["seconds"]
    row(f"lo-diransac, warm, rotorcraft, {N_ROWS:,} rows, s", warm, "0.25, aim 0.2")
    compare_cold(given.repetitions)
    if not given.without_models:
        compare_models()
    compare_lengths(given.rows, given.repetitions)
    compare_kernel()
    if DATA.is_dir():
        compare_records(chosen_records(given.records))
    else:
        row("real records", None, note=f"left out: {DATA} is missing")


if __name__ == "__main__":
    main()
