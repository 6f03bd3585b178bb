"""Pairs of logs of a crane with outliers, gaps and jitter: identified from one, validated on both.

Run: ``python benchmarks/faulty_pairs.py [--pairs 0:100]``.  Headers are those of a recorder, ``time [ms],x [mm],angle
[deg]``, and no option is given.  Printed are the pairs that are not "usable" on both logs, with the findings, and their
number.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

import diransac as dr
from diransac.cli.arguments import load_model

TRUTH = {"cart_mass": 1.2, "pole_mass": 0.3, "friction": 0.8, "damping": 0.004}
LENGTH, GRAVITY, STIFFNESS = 0.4, 9.81, 20.0
DT = 0.01
MODEL = """
from casadi import cos, sin

import diransac as dr

L, g = 0.4, 9.81


def equations(q, v, a, u, p):
    return [
        (p.cart_mass + p.pole_mass) * a.x + p.friction * v.x + 20.0 * q.x - u.force
        + p.pole_mass * L * (cos(q.angle) * a.angle - v.angle**2 * sin(q.angle)),
        p.pole_mass * L * (cos(q.angle) * a.x + L * a.angle + g * sin(q.angle)) + p.damping * v.angle,
    ]


model = dr.Model(
    name="crane",
    coordinates={"x": "m", "angle": "rad"},
    inputs={"force": "N"},
    parameters={
        "cart_mass": dr.Parameter("kg", positive=True),
        "pole_mass": dr.Parameter("kg", positive=True),
        "friction": dr.Parameter("N s/m", lower=0.0),
        "damping": dr.Parameter("N m s/rad", lower=0.0),
    },
    equations=equations,
)
"""


def rates(state: np.ndarray, force: float) -> np.ndarray:
    """Derivative of the state (4,)."""
    x, angle, v, w = state
    m, coupling = TRUTH["pole_mass"], TRUTH["pole_mass"] * LENGTH * np.cos(angle)
    swing = m * LENGTH * w * w * np.sin(angle)
    matrix = np.array([[TRUTH["cart_mass"] + m, coupling], [coupling, m * LENGTH**2]])
    forces = np.array(
        [
            force + swing - TRUTH["friction"] * v - STIFFNESS * x,
            -m * GRAVITY * LENGTH * np.sin(angle) - TRUTH["damping"] * w,
        ]
    )
    return np.concatenate([[v, w], np.linalg.solve(matrix, forces)])


def motion(force: np.ndarray, substeps: int = 4) -> np.ndarray:
    """States ``(N, 4)`` by Runge-Kutta steps, from rest."""
    states, h = np.zeros((len(force), 4)), DT / substeps
    for k in range(len(force) - 1):
        s = states[k]
        for _ in range(substeps):
            k1 = rates(s, force[k])
            k2 = rates(s + 0.5 * h * k1, force[k])
            k3 = rates(s + 0.5 * h * k2, force[k])
            s = s + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rates(s + h * k3, force[k]))
        states[k + 1] = s
    return states


def write_log(
    path: Path, seed: int, n: int = 3000, lost: int = 12, outliers: float = 0.02, jitter: float = 0.3e-3
) -> None:
    """A log with a header ``time [ms],x [mm],angle [deg],force [N]``, and the faults of a recorder."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(n)
    frequencies = np.array([0.3, 0.55, 0.9, 1.3, 1.9, 2.6])
    phases = 2.0 * np.pi * frequencies * t[:, None] + rng.uniform(0.0, 2.0 * np.pi, 6)
    force = np.sin(phases) @ np.array([2.0, 2.0, 1.5, 1.5, 1.2, 1.0])
    states = motion(force)
    x, angle = states[:, 0] + rng.normal(0.0, 2e-4, n), states[:, 1] + rng.normal(0.0, 1.5e-3, n)
    for signal, size in ((x, 0.3), (angle, 1.5)):
        hit = rng.random(n) < outliers
        signal[hit] += rng.uniform(-size, size, int(hit.sum()))
    stamps = 1e3 * (t + rng.uniform(-jitter, jitter, n))
    kept = np.delete(np.arange(n), rng.choice(np.arange(5, n - 5), lost, replace=False))
    columns = np.column_stack([stamps, 1e3 * x, np.rad2deg(angle), force])[kept]
    np.savetxt(path, columns, "%.8g", ",", header="time [ms],x [mm],angle [deg],force [N]", comments="")


def faults(seed: int) -> dict[str, float]:
    """Faults of a pair: 2, 5 or 10 % outliers, 12 or 60 lost rows of 3000, jitter of 3 or 20 % of a sample."""
    return {
        "outliers": (0.02, 0.05, 0.1)[seed % 3],
        "lost": (12, 60)[seed % 2],
        "jitter": (0.3e-3, 2e-3)[seed % 2],
    }


def write_pair(folder: Path, seed: int) -> tuple[Path, Path]:
    """Two logs of a pair."""
    files = folder / "log.csv", folder / "other.csv"
    for file, own in zip(files, (2 * seed, 2 * seed + 1), strict=True):
        write_log(file, 100 + own, **faults(seed))
    return files


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", default="0:100", help="START:END of the seeds")
    start, stop = (int(x) for x in parser.parse_args().pairs.split(":"))
    counts: dict[str, int] = {}
    errors, seconds = [], []
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        (folder / "model.py").write_text(MODEL)
        model = load_model(str(folder / "model.py"))
        for seed in range(start, stop):
            files = write_pair(folder, seed)
            began = time.perf_counter()
            result = dr.identify(model, dr.read_log(files[0]))
            seconds.append(time.perf_counter() - began)
            errors.append([result.parameters[name] / value - 1.0 for name, value in TRUTH.items()])
            logs = [dr.read_log(file, like=result.logs[0].preparation) for file in files]
            found = [dr.validate(result, log) for log in logs]
            verdicts = [x.verdict for x in found]
            worst = next((x for x in verdicts if x != "usable"), "usable")
            counts[worst] = counts.get(worst, 0) + 1
            if worst != "usable":
                off = ", ".join(f"{100 * x:.2g} %" for x in errors[-1])
                print(f"pair {seed}, {faults(seed)}: {' and '.join(verdicts)}; errors {off}")
                for finding in (y for x in found if x.verdict != "usable" for y in x.findings):
                    print(f"  {finding}", flush=True)
    n, rms = stop - start, np.sqrt(np.mean(np.square(errors), axis=0))
    print(f"{n} pairs: " + ", ".join(f"{k} {verdict}" for verdict, k in counts.items()))
    print("RMS errors: " + ", ".join(f"{name} {100 * x:.2g} %" for name, x in zip(TRUTH, rms, strict=True)))
    print(f"identification: {np.median(seconds):.1f} s, median")


if __name__ == "__main__":
    main()
