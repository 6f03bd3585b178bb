"""The compiled kernel against the same loops written by hand in C (`kernel_loops.c`), in one run; medians.

Run it as ``python benchmarks/kernel.py``; it needs gcc. Both compute the same sums and counts, which is checked. The C
loops do less: every row counts, no divergence is looked for, and angles of many thousand radians are wrong.
"""

import ctypes
import re
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

import diransac as dr
from diransac.kernel import Target
from diransac.simulate import rollouts

Array = np.ndarray[Any, Any]
Call = Callable[[], Any]
Problem = tuple[Array, Array, Array, Array, Array, float, Array, int]

SOURCE = Path(__file__).with_name("kernel_loops.c")
FLAGS = ["-O3", "-march=native", "-fno-math-errno", "-Wno-psabi"]
N_ROWS, N_LANES, DT, REPETITIONS = 2500, 1024, 0.01, 15
OPERATIONS = ["sin", "tan", "tanh", "exp", "log", "atan2", "pow"]


def quadrotor() -> SimpleNamespace:
    """A 13-state rigid body with four inputs: `kernel_loops.c` holds the same equations."""
    x, u, p = ca.SX.sym("x", 13), ca.SX.sym("u", 4), ca.SX.sym("p", 5)
    q, v, w = x[3:7], x[7:10], x[10:13]
    inertia = ca.diag(p[1:4])
    spin = ca.vertcat(-ca.dot(q[1:], w), q[0] * w + ca.cross(q[1:], w)) / 2
    up = ca.vertcat(
        2 * (q[1] * q[3] + q[0] * q[2]), 2 * (q[2] * q[3] - q[0] * q[1]), 1 - 2 * (q[1] * q[1] + q[2] * q[2])
    )
    a = ca.vertcat((up * u[0] - p[4] * v) / p[0] - ca.DM([0, 0, 9.81]), (u[1:] - ca.cross(w, inertia @ w)) / p[1:4])
    return SimpleNamespace(
        name="quadrotor", dynamics=ca.Function("dynamics", [x, u, p], [ca.vertcat(v, spin, a), a]),
        signals=tuple(f"s{k}" for k in range(19)), quaternions=((3, 4, 5, 6),), n_q=7, n_v=6, n_u=4, n_p=5,
    )  # fmt: skip


def problem_of(model: Any, parameters: Sequence[float], trim: Sequence[float], n_rows: int = N_ROWS) -> Problem:
    """A log around a trimmed flight, and hypotheses around its parameters."""
    rng = np.random.default_rng(0)
    time_s = DT * np.arange(n_rows)[:, None]
    inputs = np.array(trim) + 0.02 * np.sin(time_s * np.arange(3, 3 + model.n_u))
    state = np.zeros(model.n_q + model.n_v)
    for four in model.quaternions:
        state[four[0]] = 1.0
    truth = np.array([parameters])
    measured = rollouts(model).trajectories(truth, state, inputs, DT)[0]
    measured = measured + 0.01 * rng.standard_normal(measured.shape)
    hypotheses = truth * rng.uniform(0.9, 1.1, (N_LANES, model.n_p))
    n_signals = len(model.signals)
    return hypotheses, state, inputs, measured, np.ones(n_rows, bool), DT, np.full(n_signals, 0.5), 3


def aligned(shape: tuple[int, ...]) -> Array:
    """Array that begins at a multiple of 64 bytes, as the C loops need."""
    size = 8 * int(np.prod(shape))
    memory = np.empty(size + 64, np.uint8)
    start = -memory.ctypes.data % 64
    return memory[start : start + size].view(np.float64).reshape(shape)


class CLoops:
    """The hand-written loops, compiled."""

    def __init__(self, folder: str) -> None:
        library = Path(folder) / "kernel_loops.so"
        subprocess.run(["gcc", *FLAGS, "-shared", "-fPIC", str(SOURCE), "-o", str(library), "-lm"], check=True)
        self.library = ctypes.CDLL(str(library))
        self.library.multiply_adds.restype = ctypes.c_double

    def bound(self, name: str, problem: Problem) -> tuple[Call, Array, Array]:
        """A call without arguments that runs one of the loops, and the sums and counts that it fills."""
        hypotheses, state, inputs, measured, _, dt, thresholds, least = problem
        n = len(hypotheses)
        p, sums = aligned((hypotheses.shape[1], n)), aligned((measured.shape[1], n))
        counts = aligned((n,)).view(np.int64)
        p[:] = hypotheses.T
        loop = getattr(self.library, name)
        array, whole = np.ctypeslib.ndpointer(flags="C"), ctypes.c_long
        loop.argtypes = [whole] * 3 + [array] * 4 + [whole, array, whole, ctypes.c_double, array, array]
        arguments = (n, 0, n, p, state, inputs, measured, len(inputs), thresholds, least, dt, sums, counts)
        return partial(loop, *arguments), sums.T, counts

    def share_of_peak(self, name: str, seconds: float) -> float:
        """Part of the multiply-add ports' time that a loop uses, from its assembly and a loop of nothing else."""
        best = min(timed(lambda: self.library.multiply_adds(ctypes.c_long(1_000_000))) for _ in range(5))
        text = subprocess.run(["gcc", *FLAGS, "-S", str(SOURCE), "-o", "-"], check=True, capture_output=True, text=True)
        body = re.search(rf"^{name}:.*?\.size\s+{name},", text.stdout, re.S | re.M)
        n_products = len(re.findall(r"\tvf?n?m(?:ul|add|sub)\w*pd\t.*%zmm", body[0] if body else ""))
        return n_products * (N_LANES / 8) * N_ROWS * (best / 12e6) / seconds


def timed(call: Call) -> float:
    """Seconds that a call takes."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def medians(calls: dict[str, Call]) -> dict[str, float]:
    """Median seconds of each call, all of them measured in turns."""
    for call in calls.values():
        call()
    rounds = [{name: timed(call) for name, call in calls.items()} for _ in range(REPETITIONS)]
    return {name: float(np.median([seconds[name] for seconds in rounds])) for name in calls}


def show(name: str, seconds: float, over: float | None = None, note: str = "") -> None:
    """Print one row."""
    ratio = f"{seconds / over:8.2f}x" if over else " " * 9
    print(f"{name:<44}{1e3 * seconds:10.2f} ms{ratio}  {note}")


def compare_with_c(loops: CLoops, name: str, model: Any, parameters: Sequence[float], trim: Sequence[float]) -> None:
    """Kernel and C loop on one model."""
    problem = problem_of(model, parameters, trim)
    start = time.perf_counter()
    engine = rollouts(model)
    engine.score(problem[0][:1], *problem[1:])
    compiled = time.perf_counter() - start
    narrow = rollouts(model, target=Target("haswell"))
    by_c, sums, counts = loops.bound(name, problem)
    found = medians({
        "c": by_c, "kernel": lambda: engine.score(*problem), "two": lambda: engine.score(*problem, threads=2),
        "one lane": lambda: engine.score(problem[0][:1], *problem[1:]), "avx2": lambda: narrow.score(*problem),
    })  # fmt: skip
    scores = engine.score(*problem)
    agreement = np.abs(sums / scores.sum_squares - 1).max()
    differing = int((counts != scores.inlier_count).sum())
    share = loops.share_of_peak(name, found["c"])
    show(f"{name}: C by hand", found["c"], note=f"{share:.0%} of what the multiply-add ports can do")
    show(f"{name}: kernel", found["kernel"], found["c"], f"sums agree to {agreement:.0e}, {differing} counts differ")
    show(f"{name}: kernel, 2 threads", found["two"], found["kernel"])
    show(f"{name}: kernel for AVX2", found["avx2"], found["kernel"])
    show(f"{name}: kernel, 1 hypothesis", found["one lane"])
    show(f"{name}: compilation, first one included", compiled)


def compare_lengths(model: Any) -> None:
    """A log ten times as long."""
    problems = {n: problem_of(model, [0.5, 0.003, 0.02], [4.9, 0.0], n) for n in (N_ROWS, 10 * N_ROWS)}
    engine = rollouts(model)
    found = medians({str(n): partial(engine.score, *problem) for n, problem in problems.items()})
    short, long = found.values()
    show("rotorcraft: 25,000 rows over 2,500", long, short)


def operation(name: str, x: ca.SX) -> ca.SX:
    """One more operation on an oscillator's state."""
    if name == "atan2":
        return ca.atan2(x[0], x[1])
    size = x[0] * x[0] + 1
    return size**1.3 if name == "pow" else getattr(ca, name)(size)


def compare_operations() -> None:
    """One more operation in an oscillator's acceleration, over the oscillator alone."""
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p", 2)

    def oscillator(extra: ca.SX) -> SimpleNamespace:
        a = u - p[0] * x[0] - p[1] * x[1] + extra
        return SimpleNamespace(
            name="oscillator", dynamics=ca.Function("dynamics", [x, u, p], [ca.vertcat(x[1], a), a]),
            signals=("q", "v", "a"), quaternions=(), n_q=1, n_v=1, n_u=1, n_p=2,
        )  # fmt: skip

    extras = {"nothing": ca.SX(0)}
    for name in OPERATIONS:
        extras[name] = 0.01 * operation(name, x)
    models = {name: oscillator(extra) for name, extra in extras.items()}
    problem = problem_of(models["nothing"], [4.0, 0.1], [0.0])
    found = medians({name: partial(rollouts(model).score, *problem) for name, model in models.items()})
    show("oscillator", found["nothing"])
    for name in OPERATIONS:
        show(f"oscillator with {name}", found[name], found["nothing"])


def main() -> None:
    """Print the table."""
    print(f"{N_LANES} hypotheses, {N_ROWS} rows, RK4, float64, medians of {REPETITIONS}")
    with tempfile.TemporaryDirectory() as folder:
        loops = CLoops(folder)
        rotorcraft = dr.models.planar_rotorcraft()
        compare_with_c(loops, "rotorcraft", rotorcraft, [0.5, 0.003, 0.02], [4.9, 0.0])
        compare_with_c(loops, "quadrotor", quadrotor(), [1.0, 0.01, 0.012, 0.02, 0.1], [9.81, 0.0, 0.0, 0.0])
    compare_lengths(rotorcraft)
    compare_operations()


if __name__ == "__main__":
    main()
