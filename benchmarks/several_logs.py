"""Several logs of one machine: intervals that shrink, cuts that change nothing, a deviating log that is named.

Run: ``python benchmarks/several_logs.py [METHOD ...]`` (default: ols, lo-diransac).  The last table needs the real
double pendulum of ``../shared/data`` and is left out, with a line that says so, where it is missing.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from casadi import cos, fabs, sin

import diransac as dr

REAL = Path(__file__).resolve().parents[2] / "shared" / "data" / "dfki_double_pendulum"
TRUTH = {"mass": 0.249, "inertia": 0.004, "drag": 0.025}
BIASES = (0.003, -0.002, 0.001, 0.004, -0.003)
"""Of the moment, N, one per flight."""


def biased_rotorcraft() -> dr.Model:
    """The planar rotorcraft whose moment has a bias of its own in every flight."""

    def equations(q, v, a, u, p):  # noqa: ANN001, ANN202
        drag = p.drag * fabs(u.thrust)
        return [
            p.mass * a.x + u.thrust * sin(q.theta) + drag * v.x * cos(q.theta),
            p.mass * (a.z + 9.81) - u.thrust * cos(q.theta) + drag * v.z * sin(q.theta),
            p.inertia * a.theta - 0.177 * (u.moment + p.bias),
        ]

    known = dr.models.planar_rotorcraft()
    parameters = {**known.parameters, "bias": dr.Parameter("N", per_log=True)}
    return dr.Model("biased rotorcraft", known.coordinates, known.inputs, parameters, equations)


def flight(model: dr.Model, seed: int, bias: float, mass: float = TRUTH["mass"], duration: float = 25.0) -> dr.Log:
    """A flight among random waypoints with the paper's noise and one outlier in a hundred samples."""
    plant = dr.Plant(model, {**TRUTH, "mass": mass, "bias": bias})
    trajectory = dr.random_waypoints(dr.Plant(dr.models.planar_rotorcraft(), {**TRUTH, "mass": mass}), seed=seed)
    steered = dr.Trajectory(trajectory.time, trajectory.states, trajectory.inputs - [0.0, bias])
    flown = dr.fly(plant, steered, dr.tvlqr(plant, steered), seed=seed)
    noise = dr.Noise(outlier_probability=0.01, outlier_magnitude=20.0, acceleration_std=0.3, rate_std=0.05)
    corrupted = dr.corrupt(flown, noise, seed=seed)
    kept = corrupted.between(corrupted.time[0], corrupted.time[0] + duration)
    return dr.Log.from_arrays(kept.time, kept.signals, kept.units, source=f"flight {seed}")


def row(label: str, result: dr.Result, seconds: float, remarks: str = "") -> None:
    """Print estimates with half the width of their 95 % intervals."""
    cells = [
        f"{name} {result.parameters[name]:.5f} ± {(high - low) / 2:.5f}"
        for name, (low, high) in result.intervals().items()
        if name in TRUTH
    ]
    print(f"  {label:28}" + "  ".join(f"{cell:30}" for cell in cells) + f"{seconds:6.1f} s  {remarks}", flush=True)


def identified(label: str, model: dr.Model, logs: Sequence[dr.Log] | dr.Log, method: str) -> dr.Result:
    """A result, and its row."""
    begin = time.perf_counter()
    result = dr.identify(model, logs, method)
    named = "; ".join(log.remark for log in result.logs if log.remark)
    row(label, result, time.perf_counter() - begin, named)
    return result


def five_flights(method: str) -> None:
    """Five flights together beside each alone, a sixth of a heavier machine, and an unbalanced set."""
    model = biased_rotorcraft()
    logs = [flight(model, k, bias) for k, bias in enumerate(BIASES)]
    alone = [identified(f"flight {k} alone", model, log, method) for k, log in enumerate(logs)]
    together = identified("five flights together", model, logs, method)
    print("    biases found: " + ", ".join(f"{x:.4f}" for x in together.per_log["bias"]) + f"; true: {BIASES}")
    for name in TRUTH:
        errors = np.array([x.standard_errors[name] for x in alone])
        weights = 1.0 / np.square(errors)
        pooled = weights @ [x.parameters[name] for x in alone] / weights.sum()
        ratio = together.standard_errors[name] / np.sqrt(np.mean(np.square(errors)))
        off = (together.parameters[name] - pooled) / together.standard_errors[name]
        wrong = (together.parameters[name] - TRUTH[name]) / together.standard_errors[name]
        print(
            f"    {name}: standard error {ratio:.2f} of one flight's (1/sqrt(5) = 0.45), {off:+.2f} standard errors "
            f"from the mean of single flights, {wrong:+.2f} from the truth"
        )
    identified("with one of mass 0.27", model, [*logs[:4], flight(model, 9, 0.002, mass=0.27)], method)
    short = [flight(model, 20 + k, bias, duration=5.0) for k, bias in enumerate(BIASES[1:])]
    identified("one of 25 s, four of 5 s", model, [logs[0], *short], method)


def one_log_cut(method: str) -> None:
    """One log, whole and cut into five."""
    model = dr.models.planar_rotorcraft()
    log = flight(biased_rotorcraft(), 7, 0.0)
    n = len(log) // 5
    whole = identified("one log", model, log, method)
    cut = identified("cut into five", model, [log[k * n : (k + 1) * n] for k in range(5)], method)
    for name in TRUTH:
        change = (cut.parameters[name] - whole.parameters[name]) / whole.standard_errors[name]
        print(f"    {name}: {change:+.3f} standard errors apart")


def double_pendulum(methods: Sequence[str]) -> None:
    """Nine real runs together, and each predicted by the model of the others."""
    if not REAL.is_dir():
        print(f"  {REAL} is missing: the real runs are left out")
        return
    model = dr.models.double_pendulum()
    columns = {"t": "time", "q1": "pos_meas1", "q2": "pos_meas2", "torque1": "tau_meas1", "torque2": "tau_meas2"}
    logs = [dr.read_log(file, rename=columns, resample=125.0) for file in sorted(REAL.glob("A0_*.parquet"))]
    for method in methods:
        begin = time.perf_counter()
        result = dr.identify(model, logs, method, differentiate=True)
        print(f"\n{method}, nine runs together, {time.perf_counter() - begin:.0f} s\n{result}")
        begin = time.perf_counter()
        found = dr.cross_validate(model, logs, method, horizon=0.5, differentiate=True)
        print(f"\n{method}, one run left out, open loop over 0.5 s, {time.perf_counter() - begin:.0f} s\n{found}")
        print(f"median RMSE: {', '.join(f'{n} {x:.4g}' for n, x in found.rmse.items())}", flush=True)


def main() -> None:
    """Print all tables."""
    methods = sys.argv[1:] or ["ols", "lo-diransac"]
    for method in methods:
        print(f"\nFive flights of one rotorcraft, a bias of the moment in each: {method}")
        five_flights(method)
        print(f"\nOne log, whole and cut: {method}")
        one_log_cut(method)
    print("\nThe real double pendulum")
    double_pendulum(methods)


if __name__ == "__main__":
    main()
