"""Validation: right and wrong models judged by held-out logs, with and without outliers.

Run: ``python benchmarks/validation.py [--seeds N] [--first SEED]``.  Machines, parameters and sensors are those of
`regime_machines`, whose simulations are independent of the package.  For every machine and seed, one log is predicted
by six models: the true one; the true one with 5 % outliers in the log; with these outliers too, models whose parameters
are each off by a normal deviation of 0.5 %, by 1 % and by 40 %, of random signs; and the last one without outliers.
The table has the worst relative error of a state over the judged horizon, by `Validation.judged`, and the verdicts.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
import regime_machines
from regime_flights import Recording, Regime, recordings

import diransac as dr

MACHINES = ("JOINT", "QUAD", "ROTOR", "CART", "UNDERWATER", "PENDULUM", "MOTOR", "ARM")
OUTLIERS, SPREADS = 0.05, 3.0
"""Fraction of the samples of each signal; standard deviation of outliers, over that of the signal."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a row for every machine, and the verdicts over all."""
    parser = argparse.ArgumentParser(description="Right and wrong models judged by held-out logs.")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=100)
    chosen = parser.parse_args(arguments)
    verdicts: dict[str, Counter[str]] = {}
    for name in MACHINES:
        machine = getattr(regime_machines, name)
        regime = Regime(f"validation of {machine.name}", machine)
        errors: dict[str, list[float]] = {}
        for seed, found in enumerate(recordings(regime, range(chosen.first, chosen.first + chosen.seeds))):
            for label, one in judged(machine.model, found, chosen.first + seed).items():
                errors.setdefault(label, []).append(max(one.judged.relative_error.values(), default=np.inf))
                verdicts.setdefault(label, Counter())[one.verdict] += 1
        cells = [f"{100 * np.median(x):.2g} ({100 * max(x):.2g})" for x in errors.values()]
        if name == MACHINES[0]:
            print("| machine |", " | ".join(errors), "|")
            print("|---|" + "---|" * len(errors))
        print(f"| {machine.name} |", " | ".join(cells), "|", flush=True)
    for label, counts in verdicts.items():
        print(f"{label}:", ", ".join(f"{n} {verdict}" for verdict, n in counts.most_common()))


def judged(model: dr.Model, found: Recording, seed: int) -> Mapping[str, dr.Validation]:
    """Validation of each model, by its name."""
    rng = np.random.default_rng([seed, 17])
    clean, hit = found.log, with_outliers(found, model, rng)
    signs = [rng.choice([-1.0, 1.0], len(found.truth)) for _ in range(2)]
    slightly = changed(found.truth, 0.005 * rng.normal(size=len(found.truth)))
    wrong = changed(found.truth, 0.4 * signs[1])
    cases = {
        "true": (found.truth, clean),
        "true, outliers": (found.truth, hit),
        "0.5 %, outliers": (slightly, hit),
        "1 %, outliers": (changed(found.truth, 0.01 * signs[0]), hit),
        "40 %, outliers": (wrong, hit),
        "40 %": (wrong, clean),
    }
    return {label: dr.validate(dr.Plant(model, parameters), log) for label, (parameters, log) in cases.items()}


def changed(truth: Mapping[str, float], relative: np.ndarray) -> dict[str, float]:
    """Parameters that are off by relative errors."""
    return {name: x * (1.0 + e) for (name, x), e in zip(truth.items(), relative, strict=True)}


def with_outliers(found: Recording, model: dr.Model, rng: np.random.Generator) -> dr.Log:
    """The log with independent outliers in every signal, none in the inputs."""
    columns = {name: np.array(x) for name, x in found.columns.items()}
    for name in columns:
        if name in model.signals:
            rows = rng.random(len(found.time)) < OUTLIERS
            columns[name][rows] += SPREADS * np.nanstd(columns[name]) * rng.normal(size=rows.sum())
    return dr.Log.from_arrays(found.time, columns)


if __name__ == "__main__":
    main()
