"""Designed excitation against plain multisines: predicted and found scatter of estimates over simulated logs.

``python benchmarks/design.py [N]``: OLS from N logs, 20 by default, with noise of the torques alone, and lo-diransac
from half as many, of positions and torques with noise and outliers. A leg whose joints differ from those of its
description follows both motions under feedback that is computed from the description.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from robot_intervals import JOINTS, LEG, TRUTH

import diransac as dr

TORQUE, ENCODER, OUTLIERS = 0.05, 1e-4, 0.02
"""Standard deviations, N m and rad, and share of torques that are outliers of up to 5 N m."""

LIMITS = {"{}": 0.8, "{}_dot": 6.0, "{}_torque": 6.0}


def flown(plant: dr.Plant, nominal: dr.Plant, motion: dr.Trajectory) -> dr.Log:
    """Log of the leg along a motion, without noise."""
    return dr.fly(plant, motion, dr.tvlqr(nominal, motion))


def noisy(log: dr.Log, seed: int, positions_only: bool) -> dr.Log:
    """Log with noise of torques; of positions and torques alone, with noise of both and outliers, if asked for."""
    rng, n = np.random.default_rng(seed), len(log)
    columns = {name: log[name] for name in log.names}
    for name in JOINTS:
        columns[f"{name}_torque"] = log[f"{name}_torque"] + TORQUE * rng.standard_normal(n)
        if positions_only:
            columns[f"{name}_torque"] += np.where(rng.random(n) < OUTLIERS, rng.uniform(-5.0, 5.0, n), 0.0)
            columns[name] = log[name] + ENCODER * rng.standard_normal(n)
    kept = (*JOINTS, *(f"{name}_torque" for name in JOINTS)) if positions_only else log.names
    return dr.Log.from_arrays(log.time, {name: columns[name] for name in kept})


def scatter(model: dr.Model, log: dr.Log, n: int, method: str) -> tuple[dict[str, float], float]:
    """Standard deviation of each estimate over logs with different noise, and share of intervals with the truth."""
    robust, estimates, inside = method != "ols", list[Sequence[float]](), list[bool]()
    for seed in range(n):
        result = dr.identify(model, noisy(log, seed, robust), method=method, differentiate=robust)
        estimates.append(list(result.parameters.values()))
        inside += [low <= truth(name) <= high for name, (low, high) in result.intervals().items()]
    return dict(zip(model.parameters, np.std(estimates, axis=0, ddof=1), strict=True)), float(np.mean(inside))


def truth(name: str) -> float:
    """True value of a parameter."""
    kind, _, joint = name.partition("_")
    return TRUTH[kind][JOINTS.index(joint)]


def main() -> None:
    """Print the design, and a line per method and parameter."""
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "leg.xml"
        path.write_text(LEG)
        model = dr.models.robot(path, joints="{}_joint", unknown=tuple(TRUTH))
    nominal = dr.Plant(model, {name: float(x.value or 0.0) for name, x in model.parameters.items()})
    plant = dr.Plant(model, {name: truth(name) for name in model.parameters})
    begin = time.process_time()
    designed = dr.design_experiment(
        nominal,
        limits={key.format(name): size for key, size in LIMITS.items() for name in JOINTS},
        noise={f"{name}_torque": TORQUE for name in JOINTS},
        frequency=2.0,
    )
    print(f"{designed}\ndesigned in {time.process_time() - begin:.1f} s of processor time", flush=True)
    logs = [flown(plant, nominal, motion) for motion in (designed.multisine, designed)]
    for method, n_logs in (("ols", n), ("lo-diransac", n // 2)):
        found = [scatter(model, log, n_logs, method) for log in logs]
        covered = ", ".join(f"{100.0 * share:.0f} %" for _, share in found)
        print(f"{method}: scatter over {n_logs} logs of multisine and design, their ratio, and the predicted ratio")
        for name, ratio in designed.ratios.items():
            plain, best = (x[name] for x, _ in found)
            predicted = designed.multisine_standard_errors[name], designed.standard_errors[name]
            print(
                f"  {name:15s} {plain:.3g} (predicted {predicted[0]:.3g})  {best:.3g} ({predicted[1]:.3g})  "
                f"{best / plain:.2f} ({ratio:.2f})"
            )
        print(f"  intervals of 95 % that hold the truth: {covered}", flush=True)


if __name__ == "__main__":
    main()
