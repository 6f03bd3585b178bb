"""Processor time of a first fit by the default method: with an empty cache of machine code, from the cache, and again.

Run it as ``python benchmarks/compile_time.py [CASE ...]``.  Every case has two processes of one thread, the first of
which finds an empty cache.  The figures are ratios of processor time, which hold on a machine with other work, too;
seconds are for orientation.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from regime_flights import REGIMES, recordings

import diransac as dr
from diransac.simulation.compiler import machine_code

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))

from robots import panda_like, quadruped

Array = np.ndarray[Any, Any]
Case = tuple[dr.Model, dr.Log, dict[str, Any]]
N_ROWS, DT, SUBSTEPS = 800, 0.01, 5


def chain_model(n: int = 8) -> dr.Model:
    """Masses in a row between two walls, with a spring and a damper before each, and a force on each."""

    def equations(q: Any, v: Any, a: Any, u: Any, p: Any) -> list[Any]:
        (x, speed, acceleration, force), parameters = (list(group) for group in (q, v, a, u)), list(p)
        m, k, c = parameters[:n], parameters[n : 2 * n], parameters[2 * n :]
        before = [
            k[i] * (x[i] - (x[i - 1] if i else 0.0)) + c[i] * (speed[i] - (speed[i - 1] if i else 0.0))
            for i in range(n)
        ]
        after = [*before[1:], -20.0 * x[-1]]
        return [m[i] * acceleration[i] + before[i] - after[i] - force[i] for i in range(n)]

    units = {"m": "kg", "k": "N/m", "c": "N s/m"}
    return dr.Model(
        f"chain of {n} masses",
        {f"x{i}": "m" for i in range(n)},
        {f"f{i}": "N" for i in range(n)},
        {f"{name}{i}": dr.Parameter(unit, positive=True) for name, unit in units.items() for i in range(n)},
        equations,
    )


def simulated(model: dr.Model, truth: Mapping[str, float], rms: float) -> dr.Log:
    """Log of a model under random steps of its inputs, by RK4, with noise of 0.1 % and one outlier in fifty."""
    rng = np.random.default_rng(0)
    p, x, h = np.array([truth[name] for name in model.parameters]), np.zeros(len(model.state)), DT / SUBSTEPS
    inputs = np.repeat(rng.normal(0.0, rms, (N_ROWS // 20, model.n_u)), 20, axis=0)
    signals = np.empty((N_ROWS, len(model.signals)))
    for k, u in enumerate(inputs):

        def rate(state: Array, u: Array = u) -> Array:
            return model.dynamics(state, u, p)[0].full().ravel()

        signals[k] = np.concatenate([x, model.dynamics(x, u, p)[1].full().ravel()])
        for _ in range(SUBSTEPS):
            first = rate(x)
            second = rate(x + h / 2 * first)
            third = rate(x + h / 2 * second)
            x = x + h / 6 * (first + 2 * second + 2 * third + rate(x + h * third))
    scale = signals.std(axis=0)
    signals += rng.normal(0.0, 1e-3 * scale, signals.shape)
    signals += np.where(rng.random(signals.shape) < 0.02, rng.normal(0.0, scale, signals.shape), 0.0)
    columns = dict(zip((*model.signals, *model.inputs), np.hstack([signals, inputs]).T, strict=True))
    return dr.Log.from_arrays(DT * np.arange(N_ROWS), columns)


def _rotorcraft() -> Case:
    model = dr.models.planar_rotorcraft(gravity=0.0)
    return model, simulated(model, {"mass": 0.25, "inertia": 0.004, "drag": 0.02}, 0.02), {}


def _double_pendulum() -> Case:
    model = dr.models.double_pendulum()
    truth = dict.fromkeys(model.parameters, 0.1)
    return model, simulated(model, truth | {"inertia_1": 0.05, "inertia_2": 0.05}, 0.3), {}


def _quadrotor() -> Case:
    regime = next(regime for regime in REGIMES.values() if regime.machine.name == "quadrotor")
    return regime.machine.model, recordings(regime, [0])[0].log, {"differentiate": True}


def _chain() -> Case:
    model = chain_model()
    return model, simulated(model, {n: {"m": 1.0, "k": 20.0, "c": 0.5}[n[0]] for n in model.parameters}, 5.0), {}


def _robot(description: str, rms: float, **options: Any) -> Case:
    """Log of a robot from an MJCF text under random torques, with the armature, damping and friction of its joints."""
    with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
        file.write(description)
        file.flush()
        model = dr.models.robot(file.name, **options)
    truth = {"armature": 0.1, "damping": 0.5, "friction": 0.3}
    return model, simulated(model, {n: truth[n.partition("_")[0]] for n in model.parameters}, rms), {}


def _leg() -> Case:
    joints = ["FL_hip_joint", "FL_thigh_joint", "FL_calf_joint"]
    return _robot(quadruped(), 3.0, joints=joints)


def _arm() -> Case:
    return _robot(panda_like(), 5.0, joints=[f"joint{k}" for k in range(1, 8)])


CASES: dict[str, Callable[[], Case]] = {
    "planar rotorcraft": _rotorcraft,
    "double pendulum": _double_pendulum,
    "quadrotor": _quadrotor,
    "chain of 8 masses, 8 inputs": _chain,
    "leg of 3 joints": _leg,
    "arm of 7 joints, 21 unknown": _arm,
}


def measure(name: str) -> None:
    """Print the processor times of a first and a second fit, and of the compilation in the first, as JSON."""
    model, log, options = CASES[name]()
    compiled, plain = [0.0], machine_code.compile_function

    def timed(compiling: Callable[..., Any], *given: Any) -> Any:
        begin = time.process_time()
        try:
            return compiling(*given)
        finally:
            compiled[0] += time.process_time() - begin

    for module in list(sys.modules.values()):
        if getattr(module, "compile_function", None) is plain:
            vars(module)["compile_function"] = partial(timed, plain)
    times = []
    for _ in range(2):
        begin = time.process_time()
        result = dr.identify(model, log, **options)
        times.append(time.process_time() - begin)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    found = {"first": times[0], "next": times[1], "compiling": compiled[0], "MB": memory}
    print(json.dumps(found | {"parameters": dict(result.parameters)}))


def measured(name: str, folder: str) -> dict[str, float]:
    """What `measure` prints in a process of its own, which finds the modules compiled if one ran before."""
    single = {"DIRANSAC_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "DIRANSAC_CACHE": folder}
    inherited = {k: x for k, x in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    command = [sys.executable, __file__, "--measure", name]
    printed = subprocess.run(command, env=inherited | single, check=True, capture_output=True, text=True).stdout
    found: dict[str, float] = json.loads(printed)
    return found


def main() -> None:
    """Print the table."""
    header = ("first ever / next", "compiling / first", "from cache / next", "first, s", "MB")
    print(" " * 28 + "".join(f"{title:>18}" for title in header))
    for name in sys.argv[1:] or CASES:
        with tempfile.TemporaryDirectory() as folder:
            cold, cached = measured(name, folder), measured(name, folder)
        ratios = (cold["first"] / cold["next"], cold["compiling"] / cold["first"], cached["first"] / cached["next"])
        figures = [*(f"{ratio:.2f}" for ratio in ratios), f"{cold['first']:.1f}", f"{cold['MB']:.0f}"]
        print(f"{name:<28}" + "".join(f"{figure:>18}" for figure in figures), flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--measure"]:
        measure(sys.argv[2])
    else:
        main()
