"""Nanoseconds of a Runge-Kutta step of exported models: C that gcc compiled, and Python over many states.

Run it as ``python benchmarks/exported_step.py [NAME ...]``.  The C loop steps one state a million times, each
step from the last one; NumPy steps 10,000 states at once.  Both are the least of five repetitions.
"""

import ctypes
import runpy
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from diransac.export import PortableModel, write_model
from diransac.model.library import builtin

N_STEPS, N_STATES, DT = 1_000_000, 10_000, 1e-4
LOOP = """
void many(double x[], const double u[], int n)
{{
    int i;
    for (i = 0; i < n; ++i) {name}_step(x, u, {dt}, x);
}}
"""


def main() -> None:
    """Print a row per model."""
    for name in sys.argv[1:] or ["planar-rotorcraft", "quadrotor"]:
        model = builtin(name)
        values = dict.fromkeys(model.parameters, 1.0)
        portable = PortableModel(model, values, dict.fromkeys(values, 0.1), np.eye(model.n_p))
        x, u = np.full(len(model.state), 0.1), np.full(model.n_u, 0.5)
        with tempfile.TemporaryDirectory() as folder:
            print(f"{name}: C {in_c(portable, x, u, Path(folder))}, NumPy {in_numpy(portable, x, u, Path(folder))}")


def in_c(portable: PortableModel, x: np.ndarray, u: np.ndarray, folder: Path) -> str:
    """Time of a step in C."""
    compiler = shutil.which("gcc")
    if compiler is None:
        return "not measured: there is no gcc"
    source = folder / "dynamics.c"
    write_model(portable, source, "c")
    source.write_text(source.read_text() + LOOP.format(name=portable.identifier, dt=DT))
    library = folder / "dynamics.so"
    flags = ["-std=c99", "-O2", "-march=native", "-shared", "-fPIC"]
    subprocess.run([compiler, *flags, "-o", library, source, "-lm"], check=True)
    many, pointer = ctypes.CDLL(str(library)).many, ctypes.POINTER(ctypes.c_double)

    def run() -> None:
        state = x.copy()
        many(state.ctypes.data_as(pointer), u.ctypes.data_as(pointer), N_STEPS)
        assert np.isfinite(state).all(), "the simulation diverged: its time is not that of an ordinary step"

    return f"{least(run) / N_STEPS * 1e9:.0f} ns"


def in_numpy(portable: PortableModel, x: np.ndarray, u: np.ndarray, folder: Path) -> str:
    """Time of a step in NumPy, per state."""
    write_model(portable, folder / "dynamics.py", "python")
    step = runpy.run_path(str(folder / "dynamics.py"))["step"]
    states, inputs = np.tile(x, (N_STATES, 1)), np.tile(u, (N_STATES, 1))
    return f"{least(lambda: step(states, inputs, DT)) / N_STATES * 1e9:.0f} ns per state"


def least(run: Callable[[], object]) -> float:
    """Processor time of the quickest of five repetitions, s."""
    seconds = []
    for _ in range(5):
        begin = time.process_time()
        run()
        seconds.append(time.process_time() - begin)
    return min(seconds)


if __name__ == "__main__":
    main()
