"""The main job, start to finish: a flight with outliers, identified by every method, and a page that shows it.

A planar rotorcraft (Table I of Dimmig et al. 2023) wiggles through the air for 25 s; one in ten values of every signal
is then hit by an outlier of up to 80 units.  Run it with ``make demo``; it writes ``out/demo/report.html``.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

import diransac as dr
from diransac.simulate import rollouts

TRUE = {"mass": 0.249, "inertia": 0.004, "drag": 0.025}
ARM_LENGTH, GRAVITY = 0.177, 9.81
DT, N_ROWS = 0.01, 2500


def fly(model: dr.Model) -> dr.Log:
    """An open-loop flight whose inputs follow from a smooth wiggle of the attitude and of the height.

    The attitude theta(t) and the height z(t) are sums of sines; the moment is I theta'' / L and the thrust
    m (g + z'') / cos(theta), taken in the middle of the sample over which they are held.
    """
    t = np.arange(N_ROWS) * DT
    theta, theta_dot, theta_ddot = _wiggle(t + DT / 2, {0.35: 0.4, 0.9: 0.15, 2.1: 0.06})
    _, _, z_ddot = _wiggle(t + DT / 2, {0.2: 1.0, 0.55: 0.3})
    thrust = TRUE["mass"] * (GRAVITY + z_ddot) / np.cos(theta)
    moment = TRUE["inertia"] * theta_ddot / ARM_LENGTH
    inputs = np.column_stack([thrust, moment])
    start = np.array([0.0, 0.0, 0.0, 0.0, 0.0, theta_dot[0]])
    flown = rollouts(model).trajectories(np.array([list(TRUE.values())]), start, inputs, DT)[0]
    signals = dict(zip(model.signals, flown.T, strict=True))
    return dr.Log.from_arrays(
        t, {**signals, "thrust": thrust, "moment": moment}, units=model.units, source="demo flight"
    )


def _wiggle(t: np.ndarray, amplitudes: dict[float, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A sum of sines by frequency (Hz), with its first and second derivative."""
    total = np.zeros((3, len(t)))
    for frequency, amplitude in amplitudes.items():
        w = 2 * np.pi * frequency
        total += amplitude * np.array([np.sin(w * t), w * np.cos(w * t), -(w**2) * np.sin(w * t)])
    return total[0], total[1], total[2]


def spoil(log: dr.Log, model: dr.Model, probability: float = 0.1, magnitude: float = 80.0, seed: int = 1) -> dr.Log:
    """The log with uniform outliers on every signal of every row but the first (Table III); inputs stay as they are."""
    rng = np.random.default_rng(seed)
    signals = {n: log[n].copy() for n in log.names}
    for name in model.signals:
        hit = rng.random(len(log)) < probability
        hit[0] = False
        signals[name] += np.where(hit, rng.uniform(-magnitude, magnitude, len(log)), 0.0)
    return dr.Log.from_arrays(log.time, signals, units=log.units, source="demo flight with outliers")


def main(folder: Path) -> None:
    """Identify by every method, print the table, write the page."""
    model = dr.models.planar_rotorcraft()
    clean = fly(model)
    log = spoil(clean, model)
    print(f"{len(log)} rows at {1 / log.dt:.0f} Hz; one value in ten of each signal is an outlier of up to 80\n")
    print(f"{'method':12}{'mass':>10}{'inertia':>10}{'drag':>10}   fit error  inliers     time")
    print(f"{'true':12}" + "".join(f"{x:10.5f}" for x in TRUE.values()))
    results = {}
    for method in ("ols", "tls", "nls", "diransac", "i-diransac"):
        begin = time.perf_counter()
        results[method] = dr.identify(model, log, method, seed=0)
        seconds = time.perf_counter() - begin
        found = results[method]
        estimates = "".join(f"{x:10.5f}" for x in found.parameters.values())
        print(f"{method:12}{estimates}{found.fit_error:12.3g}{100 * found.inlier_fraction:8.1f} %{seconds:7.2f} s")
    page = folder / "report.html"
    folder.mkdir(parents=True, exist_ok=True)
    dr.write_report(results, log, page)
    prediction = dr.validate(results["i-diransac"], clean, horizon=2.0)
    print(f"\nHow i-diransac's model predicts the flight without outliers:\n{prediction}")
    print(f"\nThe page: {page}")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("out/demo"))
