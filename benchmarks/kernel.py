"""The compiled kernel against the same loops written by hand in C (`kernel_loops.c`), in one run; medians.

Run it as ``python benchmarks/kernel.py``; without gcc it leaves C out. Both compute the same sums and counts, which is
checked. The C loops do less: every row counts, no divergence is looked for, and angles of many thousand radians are
wrong.
"""

import ctypes
import re
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

import diransac as dr
from diransac.simulation import Measurements, RolloutBatch, Rollouts, ScoreBatch, rollouts
from diransac.simulation.compiler import Target

Array = np.ndarray[Any, Any]
Call = Callable[[], Any]
Problem = tuple[Array, Array, Array, Array, Array, float, Array, int]

SOURCE = Path(__file__).with_name("kernel_loops.c")
FLAGS = ["-O3", "-march=native", "-fno-math-errno", "-Wno-psabi"]
N_ROWS, N_LANES, DT, REPETITIONS = 2500, 1024, 0.01, 15
ROTORCRAFT = [0.5, 0.003, 0.02], [4.9, 0.0]
QUADROTOR = [1.0, 0.01, 0.012, 0.02, 0.1], [9.81, 0.0, 0.0, 0.0]
"""Parameters, and the inputs of a trimmed flight."""
OPERATIONS = ["sin", "tan", "tanh", "exp", "log", "atan2", "pow"]


def quadrotor() -> dr.Model:
    """A 13-state rigid body with four inputs: `kernel_loops.c` holds the same equations."""

    def equations(q: Any, v: Any, a: Any, u: Any, p: Any) -> list[Any]:
        w, x, y, z = (q[n] for n in ("qw", "qx", "qy", "qz"))
        up = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
        moved = [p.mass * a[n] - f * u.thrust + p.drag * v[n] for n, f in zip(("vx", "vy", "vz"), up, strict=True)]
        moved[2] += p.mass * 9.81
        turned = [
            p.ix * a.wx - u.mx + (p.iz - p.iy) * v.wy * v.wz,
            p.iy * a.wy - u.my + (p.ix - p.iz) * v.wz * v.wx,
            p.iz * a.wz - u.mz + (p.iy - p.ix) * v.wx * v.wy,
        ]
        return [*moved, *turned]

    return dr.Model(
        "quadrotor",
        coordinates={**dict.fromkeys(("x", "y", "z"), "m"), **dict.fromkeys(("qw", "qx", "qy", "qz"), "1")},
        velocities={**dict.fromkeys(("vx", "vy", "vz"), "m/s"), **dict.fromkeys(("wx", "wy", "wz"), "rad/s")},
        inputs={"thrust": "N", "mx": "N m", "my": "N m", "mz": "N m"},
        parameters={
            "mass": dr.Parameter("kg", positive=True),
            **{n: dr.Parameter("kg m^2", positive=True) for n in ("ix", "iy", "iz")},
            "drag": dr.Parameter("N s/m"),
        },
        equations=equations,
        kinematics=lambda q, v: [
            v.vx, v.vy, v.vz,
            -(q.qx * v.wx + q.qy * v.wy + q.qz * v.wz) / 2, (q.qw * v.wx + q.qy * v.wz - q.qz * v.wy) / 2,
            (q.qw * v.wy + q.qz * v.wx - q.qx * v.wz) / 2, (q.qw * v.wz + q.qx * v.wy - q.qy * v.wx) / 2,
        ],
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
    measured = rollouts(model).trajectories(RolloutBatch(truth, state, inputs, DT))[0]
    measured = measured + 0.01 * rng.standard_normal(measured.shape)
    hypotheses = truth * rng.uniform(0.9, 1.1, (N_LANES, model.n_p))
    n_signals = len(model.signals)
    return hypotheses, state, inputs, measured, np.ones(n_rows, bool), DT, np.full(n_signals, 0.5), 3


def score(engine: Rollouts, problem: Problem, n_lanes: int | None = None, threads: int = 1) -> ScoreBatch:
    """Scores of the hypotheses, or of the first few."""
    hypotheses, state, inputs, measured, valid, dt, thresholds, least = problem
    batch = RolloutBatch(hypotheses[:n_lanes], state, inputs, dt)
    return engine.score(batch, Measurements(measured, valid), thresholds, least, threads=threads)


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


def timed(call: Call, clock: Callable[[], float] = time.perf_counter) -> float:
    """Seconds that a call takes."""
    start = clock()
    call()
    return clock() - start


def medians(calls: dict[str, Call], clock: Callable[[], float] = time.perf_counter) -> dict[str, float]:
    """Median seconds of each call, all of them measured in turns."""
    for call in calls.values():
        call()
    rounds = [{name: timed(call, clock) for name, call in calls.items()} for _ in range(REPETITIONS)]
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
    score(engine, problem, 1)
    compiled = time.perf_counter() - start
    narrow = rollouts(model, target=Target("haswell"))
    by_c, sums, counts = loops.bound(name, problem)
    found = medians({
        "c": by_c, "kernel": lambda: score(engine, problem), "two": lambda: score(engine, problem, threads=2),
        "one lane": lambda: score(engine, problem, 1), "avx2": lambda: score(narrow, problem),
    })  # fmt: skip
    scores = score(engine, problem)
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
    problems = {n: problem_of(model, *ROTORCRAFT, n) for n in (N_ROWS, 10 * N_ROWS)}
    engine = rollouts(model)
    found = medians({str(n): partial(score, engine, problem) for n, problem in problems.items()})
    short, long = found.values()
    show("rotorcraft: 25,000 rows over 2,500", long, short)


def operation(name: str, q: Any, v: Any) -> Any:
    """One more operation on an oscillator's state."""
    if name == "atan2":
        return ca.atan2(q, v)
    size = q * q + 1
    return size**1.3 if name == "pow" else getattr(ca, name)(size)


def oscillator(name: str) -> dr.Model:
    """An oscillator with one more operation in its acceleration, or with nothing."""

    def equations(q: Any, v: Any, a: Any, u: Any, p: Any) -> list[Any]:
        extra = 0.0 if name == "nothing" else 0.01 * operation(name, q.q, v.q)
        return [a.q - u.force + p.stiffness * q.q + p.damping * v.q - extra]

    parameters = {"stiffness": dr.Parameter("1/s^2"), "damping": dr.Parameter("1/s")}
    return dr.Model("oscillator", {"q": "m"}, {"force": "N/kg"}, parameters, equations)


def compare_operations() -> None:
    """One more operation in an oscillator's acceleration, over the oscillator alone."""
    models = {name: oscillator(name) for name in ("nothing", *OPERATIONS)}
    problem = problem_of(models["nothing"], [4.0, 0.1], [0.0])
    found = medians({name: partial(score, rollouts(model), problem) for name, model in models.items()})
    show("oscillator", found["nothing"])
    for name in OPERATIONS:
        show(f"oscillator with {name}", found[name], found["nothing"])


def compare_sensitivities(model: dr.Model, parameters: Sequence[float], trim: Sequence[float]) -> None:
    """Gauss-Newton sums over scores: the price of derivatives in rollouts."""
    problem = problem_of(model, parameters, trim)
    engine, weights = rollouts(model), np.ones(len(model.signals))
    hypotheses, state, inputs, measured, valid, dt, _, _ = problem
    batch, measurements = RolloutBatch(hypotheses, state, inputs, dt), Measurements(measured, valid)
    choices = {"parameters": tuple(model.parameters), "initial states": model.state, "both": None}
    calls: dict[str, Call] = {"score": partial(score, engine, problem)}
    for name, unknowns in choices.items():
        calls[name] = partial(engine.gauss_newton, batch, measurements, weights, unknowns=unknowns)
    compiled = {name: timed(call) for name, call in calls.items()}
    found = medians(calls)
    for name in choices:
        note = f"compiled in {1e3 * (compiled[name] - found[name]):.0f} ms"
        show(f"{model.name}: Gauss-Newton sums, {name}", found[name], found["score"], note)


def main() -> None:
    """Print the table."""
    print(f"{N_LANES} hypotheses, {N_ROWS} rows, RK4, float64, medians of {REPETITIONS}")
    with tempfile.TemporaryDirectory() as folder:
        rotorcraft = dr.models.planar_rotorcraft()
        try:
            loops = CLoops(folder)
        except OSError as missing:
            print(f"the loops in C are left out: no C compiler ({missing})")
        else:
            compare_with_c(loops, "rotorcraft", rotorcraft, *ROTORCRAFT)
            compare_with_c(loops, "quadrotor", quadrotor(), *QUADROTOR)
    compare_lengths(rotorcraft)
    compare_sensitivities(rotorcraft, *ROTORCRAFT)
    compare_sensitivities(quadrotor(), *QUADROTOR)
    compare_operations()


if __name__ == "__main__":
    main()
