"""How fast identification is: the whole table in one run, each row as a ratio of medians that were measured in turns.

Run it as ``python benchmarks/speed.py [--without-hour]``.  The log is a lively rotorcraft flight of 25 s at 100 Hz with
one value in ten an outlier of up to 80; settings of Table IV, with all 1,000 iterations forced; 2 threads.  gcc and the
packages of ``pip install .[bench]`` are compared with where they are there; what is absent is said.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import others
from kernel import QUADROTOR, REPETITIONS, CLoops, medians, problem_of, quadrotor, score, timed

import diransac as dr
from diransac.data.dataset import Dataset, bind_log
from diransac.identification.methods.samples import sample_rows
from diransac.identification.regression.rows import regression
from diransac.simulation import LinearFeedback, RolloutBatch, rollouts

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))

from algorithm1 import Choices, algorithm1
from algorithm1 import Problem as Listing
from simulated import ROTORCRAFT, as_log, flight, rollout, with_outliers

Array = np.ndarray[Any, Any]
SETTINGS = replace(dr.Settings.table_iv(), stop_inlier_fraction=None, threads=2)
DURATION, N_ROWS, N_HYPOTHESES = 25.0, 2500, 1024
ITERATIONS_OF_LISTING, TRIALS, ROWS_OF_SCIPY = 30, 30, 250
HOUR_ROWS, HOUR_DT = 3_600_000, 0.001
ATTITUDE, HEIGHT = {0.35: 0.4, 0.9: 0.15, 2.1: 0.06}, {0.2: 1.0, 0.55: 0.3}
"""Amplitudes of the sines of the long flight, rad and m, by frequency (Hz)."""


@dataclass(frozen=True)
class Bench:
    """The log that everything is measured on, and who simulates it."""

    model: dr.Model
    log: dr.Log
    problem: others.Problem
    loops: CLoops | None

    def identify(self, **changes: Any) -> dr.Result:
        """Identify with all iterations."""
        return dr.identify(self.model, self.log, "i-diransac", settings=replace(SETTINGS, **changes))


@cache
def spoilt_log(n_rows: int) -> dr.Log:
    """The flight sampled so often, with outliers."""
    signals, inputs = flight(ROTORCRAFT, n_rows, DURATION / n_rows)
    return as_log(ROTORCRAFT, with_outliers(signals, 0.1, 80.0, 0), inputs, DURATION / n_rows)


def bench_of(loops: CLoops | None) -> Bench:
    """The problem that every simulator gets: hypotheses around the truth, all nine signals scored."""
    model, log = dr.models.planar_rotorcraft(), spoilt_log(N_ROWS)
    seen = bind_log(model, log)
    factors = np.random.default_rng(0).uniform(0.9, 1.1, (N_HYPOTHESES, model.n_p))
    hypotheses = np.array(list(ROTORCRAFT.truth.values())) * factors
    state, thresholds = seen.initial_state("first"), np.full(len(seen.signals), 0.5)
    problem = (hypotheses, state, seen.inputs, seen.measured, seen.valid, log.dt, thresholds, 3)
    return Bench(model, log, problem, loops)


def row(name: str, ratio: float | None, bound: str = "", note: str = "") -> None:
    """Print one row: a ratio, at most and aim, and what was measured."""
    shown = "" if not ratio else f"{ratio:.2f}" if ratio >= 0.01 else f"1/{1 / ratio:,.0f}"
    print(f"{name:<66}{shown:>10}  {bound:<16}{note}", flush=True)


def milliseconds(**seconds: float) -> str:
    """Absolute times, for the reader's orientation."""
    return ", ".join(f"{name.replace('_', ' ')} {1e3 * x:.3g} ms" for name, x in seconds.items())


# Scoring and identifying ---------------------------------------------------------------------------------------------
def on_two_threads(call: Any) -> Callable[[], None]:
    """One of the C loops, half of its lanes on each of two threads."""
    n, _, _, *rest = call.args

    def run() -> None:
        halves = [Thread(target=call.func, args=(n, k * n // 2, (k + 1) * n // 2, *rest)) for k in range(2)]
        for half in halves:
            half.start()
        for half in halves:
            half.join()

    return run


def compare_identification(bench: Bench) -> float:
    """Rows (a), (b), (d); returns the seconds of one identification."""
    engine = rollouts(bench.model)
    calls: dict[str, Callable[[], Any]] = {
        "one": partial(score, engine, bench.problem),
        "two": partial(score, engine, bench.problem, threads=2),
        "table iv": bench.identify,
        "defaults": lambda: dr.identify(
            bench.model, bench.log, "i-diransac", settings=dr.Settings(stop_inlier_fraction=None, threads=2)
        ),
    }
    agreement = ""
    if bench.loops:
        calls["c"], sums, _ = bench.loops.bound("rotorcraft", bench.problem)
        calls["c two"] = on_two_threads(calls["c"])
        calls["c"]()
        agreement = f"; sums agree to {np.abs(sums / score(engine, bench.problem).sum_squares - 1).max():.0e}"
    found = medians(calls)
    if bench.loops:
        share = bench.loops.share_of_peak("rotorcraft", found["c"])
        c, c_two = found["c"], found["c two"]
        times = milliseconds(kernel=found["one"], C=c)
        row("(a) score 1,024 hypotheses / C loop", found["one"] / c, "1.3, aim 1.0", times + agreement)
        row("    the C loop's share of what its multiply-add ports could do", share, "at least 0.6")
        for name in ("table iv", "defaults"):
            times = milliseconds(identify=found[name], C_on_2_threads=c_two)
            row(f"(b) identify, 1,000 iterations, {name} / C loop on 2 threads", found[name] / c_two, "5, aim 3", times)
    row("(d) score on two threads / one", found["two"] / found["one"], "0.6, aim 0.5", milliseconds(two=found["two"]))
    return found["table iv"]


def compare_with_listing(bench: Bench, seconds: float) -> None:
    """Row (c): the literal Algorithm 1 of the tests, some iterations of it, by the hypothesis."""
    settings, signals = SETTINGS, np.column_stack([bench.log[n] for n in bench.model.signals])
    inputs = np.column_stack([bench.log[n] for n in bench.model.inputs])
    W, b = ROTORCRAFT.rows(signals, inputs)
    listing = Listing(
        W, b, signals, np.ones(len(W), bool), np.array([0, 0, 0]), np.full(3, np.inf), np.array([True, True, False]),
        sampler=lambda seed, k, n: sample_rows(seed, [k], n, 0, n)[0],
        simulator=lambda p: rollout(ROTORCRAFT, p, bench.problem[1], inputs, bench.log.dt),
    )  # fmt: skip
    by_name = [
        np.array([values.get(n, 0.0) for n in bench.model.signals])
        for values in (settings.inlier_thresholds or {}, settings.error_weights or {})
    ]
    choices = Choices("i-diransac", settings.sample_size, ITERATIONS_OF_LISTING, None, by_name[0], 3, by_name[1])
    stories: list[Any] = []
    taken = timed(lambda: stories.append(algorithm1(listing, choices)))
    best = bench.identify(max_iterations=ITERATIONS_OF_LISTING)
    agreement = np.abs(stories[0].best.parameters / np.array(list(best.parameters.values())) - 1).max()
    whole = taken * SETTINGS.max_iterations / ITERATIONS_OF_LISTING
    note = f"{whole:.0f} s, scaled from {ITERATIONS_OF_LISTING} iterations; parameters agree to {agreement:.0e}"
    row("(c) identify / plain Python and NumPy Algorithm 1", seconds / whole, "1/500, aim 1/1500", note)


def compare_lengths(bench: Bench) -> None:
    """Row (e): the same flight sampled ten times as often, with the same number of hypotheses."""
    long = replace(bench, log=spoilt_log(10 * N_ROWS))
    calls = {
        "short": partial(bench.identify, refit="none"), "short refits": bench.identify,
        "long": partial(long.identify, refit="none"), "long refits": long.identify,
    }  # fmt: skip
    found = medians(calls)
    times = milliseconds(short=found["short"], long=found["long"])
    row("(e) identify N = 25,000 / N = 2,500, no refits", found["long"] / found["short"], "11, aim 10", times)
    evaluated = [calls[n]().n_hypotheses for n in ("short refits", "long refits")]
    note = f"{evaluated[0]} and {evaluated[1]} hypotheses"
    row("    with refits", found["long refits"] / found["short refits"], "", note)


def hour_log(n_rows: int = HOUR_ROWS) -> dr.Log:
    """A wiggle of attitude and height, whose inputs follow from the equations and from a controller, with outliers.

    Without a controller the attitude drifts, and the induced drag then accelerates the rotorcraft without bounds.
    """
    model, true, laws = dr.models.planar_rotorcraft(), dr.models.TABLE_I, 60_000
    state, parts = np.zeros((1, 6)), []
    gains = np.zeros((2, 6))
    gains[0, [1, 4]] = true["mass"] * np.array([4.0, 4.0])
    gains[1, [2, 5]] = true["inertia"] / 0.177 * np.array([25.0, 10.0])
    for first in range(0, n_rows, laws):
        t = HOUR_DT * np.arange(first, min(first + laws, n_rows) + 1)
        reference = np.zeros((len(t), 6))
        for k, sines in ((1, HEIGHT), (2, ATTITUDE)):
            reference[:, k], reference[:, k + 3], _ = _sines(t, sines)
        theta, _, theta_ddot = _sines(t + HOUR_DT / 2, ATTITUDE)
        _, _, z_ddot = _sines(t + HOUR_DT / 2, HEIGHT)
        thrust = true["mass"] * (9.81 + z_ddot) / np.cos(theta)
        feed_forward = np.column_stack([thrust, true["inertia"] * theta_ddot / 0.177])
        feedback = LinearFeedback(feed_forward, reference, np.broadcast_to(gains, (len(t), 2, 6)))
        start = state if first else reference[:1]
        batch = RolloutBatch(np.array([list(true.values())]), start, feed_forward, HOUR_DT)
        flown = rollouts(model).fly(batch, feedback)
        state = flown.signals[:, -1, :6]
        parts.append(np.hstack([flown.signals[0, :-1], flown.inputs[0, :-1]]))
    signals = np.concatenate(parts)
    columns = dict(zip((*model.signals, *model.inputs), signals.T, strict=True))
    noise = dr.Noise(outlier_probability=0.1, outlier_magnitude=80.0)
    return dr.corrupt(dr.Log.from_arrays(HOUR_DT * np.arange(n_rows), columns), noise, seed=1, signals=model.signals)


def _sines(t: Array, amplitudes: dict[float, float]) -> Array:
    """A sum of sines by frequency (Hz), with its first and second derivative."""
    total = np.zeros((3, len(t)))
    for frequency, amplitude in amplitudes.items():
        w = 2 * np.pi * frequency
        total += amplitude * np.array([np.sin(w * t), w * np.cos(w * t), -(w**2) * np.sin(w * t)])
    return total


def measure_hour() -> None:
    """Row (e) again: an hour at 1 kHz, read from a file and identified in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "hour.parquet"
        hour_log().write(path)
        code = (
            "import json, resource, sys, time, diransac as dr; log = dr.read_log(sys.argv[1]); begin = time.time();"
            "result = dr.identify(dr.models.planar_rotorcraft(), log, 'i-diransac');"
            "used = resource.getrusage(resource.RUSAGE_SELF);"
            "print(json.dumps([time.time() - begin, used.ru_maxrss, result.n_hypotheses]))"
        )
        done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True)
    seconds, kibibytes, evaluated = json.loads(done.stdout)
    per_row = 1024 * kibibytes / HOUR_ROWS
    note = f"{seconds:.0f} s, {evaluated} hypotheses; {per_row:.0f} bytes a row"
    row("(e) peak memory of 1 h at 1 kHz, 3.6 M rows, GiB", kibibytes / 2**20, "4", note)


# Processes -----------------------------------------------------------------------------------------------------------
def compare_processes(bench: Bench) -> None:
    """Rows (f), (g): whole processes; modules are compiled beforehand, as an installation does."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flight.csv"
        bench.log.write(path)
        environment = {k: x for k, x in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
        environment["PYTHONPYCACHEPREFIX"] = str(Path(folder) / "compiled")
        command = ["-m", "diransac", "identify", str(path), "--model", "planar-rotorcraft", "--method", "i-diransac"]
        run = partial(subprocess.run, env=environment, stdout=subprocess.DEVNULL, check=True)
        found = medians({
            "numpy, casadi": lambda: run([sys.executable, "-c", "import numpy, casadi"]),
            "numpy, casadi, polars": lambda: run([sys.executable, "-c", "import numpy, casadi, polars"]),
            "diransac": lambda: run([sys.executable, "-c", "import diransac"]),
            "identify": lambda: run([sys.executable, *command]),
        })  # fmt: skip
    times = milliseconds(**{"import diransac": found["diransac"], "import numpy, casadi": found["numpy, casadi"]})
    row("(f) import diransac / import numpy, casadi", found["diransac"] / found["numpy, casadi"], "1.4, aim 1.1", times)
    ratio = found["identify"] / found["numpy, casadi, polars"]
    row(
        "(g) cold diransac identify / import numpy, casadi, polars",
        ratio,
        "2.5, aim 1.7",
        milliseconds(g=found["identify"]),
    )


# Others --------------------------------------------------------------------------------------------------------------
def compare_quadrotor(loops: CLoops) -> None:
    """Row (h)."""
    model = quadrotor()
    problem = problem_of(model, *QUADROTOR)
    engine = rollouts(model)
    by_c, sums, _ = loops.bound("quadrotor", problem)
    found = medians({"c": by_c, "kernel": partial(score, engine, problem)})
    agreement = np.abs(sums / score(engine, problem).sum_squares - 1).max()
    note = f"{milliseconds(kernel=found['kernel'], C=found['c'])}; sums agree to {agreement:.0e}"
    row("(h) score a 13-state quadrotor / C loop", found["kernel"] / found["c"], "1.4, aim 1.1", note)


def compare_others(bench: Bench, seconds: float) -> None:
    """What else there is, over the kernel on two threads or over a whole identification."""
    ours = partial(score, rollouts(bench.model), bench.problem, threads=2)
    exact = ours().sum_squares
    for name, simulate in (
        ("JAX, vmap and scan", others.jax_scan),
        ("diffrax, Tsit5 in a scan", others.diffrax_steps),
        ("Numba, scalar loops, one thread", others.numba_scalar),
    ):
        try:
            call = simulate(bench.problem)
            error = np.abs(call() / exact - 1).max()
        except ImportError as absent:
            row(f"    {name}", None, note=f"{absent.name} is not installed: pip install .[bench]")
            continue
        found = medians({"ours": ours, "theirs": call})
        note = f"{milliseconds(theirs=found['theirs'], ours=found['ours'])}; sums agree to {error:.0e}"
        row(f"    score: {name} / ours on 2 threads", found["theirs"] / found["ours"], note=note)
    short = tuple(x[:ROWS_OF_SCIPY] if i in (2, 3, 4) else x for i, x in enumerate(bench.problem))
    taken = timed(others.scipy_segments((short[0][:1], *short[1:]))) * N_ROWS / ROWS_OF_SCIPY * N_HYPOTHESES
    found = medians({"ours": ours})
    note = f"{taken:.0f} s, scaled from 1 hypothesis and {ROWS_OF_SCIPY} rows"
    row("    score: SciPy, solve_ivp a row / ours on 2 threads", taken / found["ours"], note=note)
    try:
        fit = others.scikit_learn_ransac(*regression(Dataset.of(bench.model, bench.log)), TRIALS)
        theirs = medians({"theirs": fit})["theirs"] / TRIALS
    except ImportError as absent:
        row("    scikit-learn", None, note=f"{absent.name} is not installed: pip install .[bench]")
        return
    note = f"{milliseconds(trial=theirs, ours=seconds / SETTINGS.max_iterations)}; theirs simulates nothing"
    row("    a trial of RANSACRegressor / one of ours", theirs / seconds * SETTINGS.max_iterations, note=note)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--without-hour", action="store_true", help="leave out the log of an hour")
    without_hour = parser.parse_args().without_hour
    print(f"medians of {REPETITIONS} repetitions in turns; load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores\n")
    print(f"{'':<66}{'ratio':>10}  {'at most':<16}measured")
    with tempfile.TemporaryDirectory() as folder:
        try:
            loops = CLoops(folder)
        except OSError as missing:
            loops = None
            row("(a), (b), (h)", None, note=f"left out: no C compiler ({missing})")
        bench = bench_of(loops)
        seconds = compare_identification(bench)
        compare_with_listing(bench, seconds)
        compare_lengths(bench)
        if not without_hour:
            measure_hour()
        compare_processes(bench)
        if loops:
            compare_quadrotor(loops)
        compare_others(bench, seconds)


if __name__ == "__main__":
    main()
