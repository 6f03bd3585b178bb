"""Ablation of lo-diransac: error of the worst parameter with each part left out by its setting.

Errors are relative to the true parameters; under a model error, to the least squares of the log without noise.

Run: ``python benchmarks/ablation.py [number of seeds]``.  Prints the error of the worst parameter, %, median over seeds
[largest], for each scenario and each part that is left out, as a table in Markdown.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import diransac as dr
from diransac.errors import DiransacError
from simulated import MACHINES, as_log, flight

MACHINE, MODEL, DT = MACHINES["planar-rotorcraft"], dr.models.planar_rotorcraft(), 0.01
TRUTH = np.array(list(MACHINE.truth.values()))

Arrays = tuple[np.ndarray, np.ndarray]


# ---------------------------------------------------------------------- scenarios: signals and inputs, seed by seed
def outliers(probability: float, magnitude: float) -> Callable[[int], Arrays]:
    """Outliers in each sample with some probability."""

    def make(seed: int) -> Arrays:
        (signals, inputs), rng = CLEAN, np.random.default_rng(seed)
        hit = rng.random(signals.shape) < probability
        return signals + hit * rng.uniform(-magnitude, magnitude, signals.shape), inputs

    return make


def leverage(seed: int) -> Arrays:
    """One-sided outliers at high thrust, with probability 0.8."""
    (signals, inputs), rng = CLEAN, np.random.default_rng(seed)
    high = np.abs(inputs[:, 0]) > np.quantile(np.abs(inputs[:, 0]), 0.7)
    hit = (rng.random(signals.shape) < 0.8) & high[:, None]
    return signals + hit * rng.uniform(0.0, 80.0, signals.shape), inputs


def noise(seed: int) -> Arrays:
    """Gaussian noise, Table III's maximum: 2.5 m/s^2, 1 rad/s, and both integrated over a sample."""
    (signals, inputs), rng, r = CLEAN, np.random.default_rng(seed), np.sqrt(DT)
    sizes = [2.5 * DT, 2.5 * DT, r, 2.5 * r, 2.5 * r, 1.0, 2.5, 2.5, 1.0 / r]
    return signals + sizes * rng.normal(size=signals.shape), inputs


def stuck(seed: int) -> Arrays:
    """Stuck samples in a fifth of the rows, outliers in a tenth, little noise."""
    signals, inputs = outliers(0.1, 80.0)(seed)
    rng = np.random.default_rng(seed)
    signals = signals + 0.02 * CLEAN[0].std(axis=0) * rng.normal(size=signals.shape)
    for first in rng.choice(np.arange(50, 2400, 50), 10, replace=False):
        signals[first : first + 50] = signals[first - 1]
    return signals, inputs


def delayed(seed: int) -> Arrays:
    """Inputs that act 20 ms late, and outliers."""
    signals, inputs = outliers(0.1, 80.0)(seed)
    return signals, np.vstack([inputs[2:], inputs[-1:], inputs[-1:]])


def lifted_acceleration(q: object, v: object, u: object, p: object) -> tuple[float, ...]:
    """Accelerations of the rotorcraft with an excess of a tenth of its thrust, straight up."""
    x, z, theta = MACHINE.acceleration(q, v, u, p)
    return x, z + 0.1 * u[0] / p[0], theta


def mismatch(seed: int) -> Arrays:
    """An excess of a tenth of the thrust, straight up; noise; outliers."""
    (signals, inputs), rng = LIFTED, np.random.default_rng(seed)
    hit = rng.random(signals.shape) < 0.2
    noisy = signals + 0.05 * signals.std(axis=0) * rng.normal(size=signals.shape)
    return noisy + hit * rng.uniform(-80.0, 80.0, signals.shape), inputs


SCENARIOS: dict[str, Callable[[int], Arrays]] = {
    "outliers .5 x 100": outliers(0.5, 100.0),
    "leverage .8 x 80": leverage,
    "noise, Table III's maximum": noise,
    "stuck": stuck,
    "delay": delayed,
    "mismatch": mismatch,
}


# ---------------------------------------------------------------------- parts that are left out
LEFT_OUT = {
    "nothing": dr.LoDiransac(),
    "random samples": dr.LoDiransac(n_samples=0),
    "local optimisation": dr.LoDiransac(max_steps=0, projection=False),
    "outlier component of the noise": dr.LoDiransac(outliers=False),
    "unmodelled accelerations": dr.LoDiransac(model_error=False),
    "prior of a thousandth": dr.LoDiransac(prior_model_error=1e-5),
    "input gain and bias discrepancy": dr.LoDiransac(prior_discrepancy=1e-6, initial_discrepancy=1e-6),
    "delay": dr.LoDiransac(input_delay=False, input_lag=False, max_delay_shifts=0),
    "delay by whole samples first": dr.LoDiransac(delay_range=(0.0, 0.0)),
    "projection": dr.LoDiransac(projection=False),
    "screening": dr.LoDiransac(stuck_rows=False),
}


def worst_errors(make: Callable[[int], Arrays], method: dr.LoDiransac, n_seeds: int) -> Iterator[float]:
    """Error of the worst parameter, %, seed by seed; infinite where there is no estimate."""
    for seed in range(n_seeds):
        log = as_log(MACHINE, *make(seed), DT)
        try:
            found = np.array(list(dr.identify(MODEL, log, method, seed=seed).parameters.values()))
        except DiransacError:
            yield np.inf
        else:
            yield 100.0 * float(np.abs(found / (PSEUDO_TRUE if make is mismatch else TRUTH) - 1.0).max())


def text(error: float) -> str:
    """An error with two digits."""
    if not np.isfinite(error):
        return "no estimate"
    return "0" if error < 1e-3 else f"{error:.2g}"


def main() -> None:
    """Print the table."""
    n_seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    print("| left out | " + " | ".join(SCENARIOS) + " |\n|---|" + "---|" * len(SCENARIOS))
    for name, method in LEFT_OUT.items():
        cells = [np.array(list(worst_errors(make, method, n_seeds))) for make in SCENARIOS.values()]
        shown = " | ".join(f"{text(np.median(errors))} [{text(errors.max())}]" for errors in cells)
        print(f"| {name} | {shown} |", flush=True)


CLEAN = flight(MACHINE, 2500, DT)
LIFTED = flight(replace(MACHINE, acceleration=lifted_acceleration), 2500, DT)
W, B = MACHINE.rows(*LIFTED)
PSEUDO_TRUE = np.linalg.lstsq(W.reshape(-1, 3), B.ravel())[0]

if __name__ == "__main__":
    main()
