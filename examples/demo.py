"""Simulation, identification by every method, and closed-loop evaluation of each identified model.

A planar rotorcraft with unbalanced rotors (Dimmig et al. 2023, Tables I and II) flies a star. Its rotors produce more
lift than the model has, and vibrate at 250 Hz, which a log at 100 Hz aliases; one in ten samples of every signal is an
outlier of up to 80; the paper has either of them alone. Every method identifies a model from that log. Each model then
plans a square and a sine and controls the same plant along them; the tracking error measures the quality of the model.
Run it with ``make demo``; it writes ``report.html`` and ``flight.png`` into ``out/demo``.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from pathlib import Path

import diransac as dr

IMBALANCE = 1.4e-6  # m^4, aerodynamic imbalance of the blades: excess thrust in proportion to the thrust
C_T, DIAMETER = 0.06, 0.127  # thrust coefficient and diameter of the propellers, m
PLANT = dr.models.extended_rotorcraft(aerodynamic_imbalance=IMBALANCE, mass_imbalance=1e-4)
NOISE = dr.Noise(outlier_probability=0.1, outlier_magnitude=80.0)
SHAPES = {"square": dr.square, "sine": dr.sine}


def simulate() -> dr.Log:
    """Log of a star flown with the true parameters, with outliers."""
    trajectory = dr.star(PLANT)
    flight = dr.fly(PLANT, trajectory, dr.tvlqr(PLANT, trajectory))
    error = dr.tracking_error(trajectory, flight)
    log = dr.corrupt(flight, NOISE, seed=1)
    n_outliers = sum(int(mask.sum()) for mask in log.fault_mask.values())
    print(
        f"A star: {len(log)} rows at {1 / log.dt:.0f} Hz, "
        f"tracking error {error['x']:.3f} m in x and {error['z']:.3f} m in z;"
    )
    print(f"{n_outliers} samples of its log are outliers of up to {NOISE.outlier_magnitude:.0f}.\n")
    return log


def identify(log: dr.Log) -> dict[str, dr.Result]:
    """Results of every method, printed below the true parameters."""
    print(f"{'method':14}{'mass':>10}{'inertia':>10}{'drag':>10}{'inliers':>11}{'time':>10}")
    print(_row("true", PLANT.parameters))
    print(
        _row("pseudo-true", effective(PLANT.parameters))
        + "   the best fit of any log: 9 % of the lift is not in the model"
    )
    results = {}
    for method in dr.METHODS:
        begin = time.perf_counter()
        found = dr.identify(PLANT.model, log, method, seed=0, settings=dr.Settings.table_iv())
        seconds = time.perf_counter() - begin
        print(f"{_row(method, found.parameters)}{100 * found.inlier_fraction:9.1f} %{seconds:8.2f} s")
        results[method] = found
    print("(Times include compiling the model for a method's first use.)")
    return results


def effective(parameters: Mapping[str, float]) -> dict[str, float]:
    """Pseudo-true parameters, which fit any log best: 9 % of lift that is not in the model appear as 8 % less mass."""
    lift = 1.0 + IMBALANCE / (C_T * DIAMETER**4)
    return {**parameters, "mass": parameters["mass"] / lift}


def _row(name: str, parameters: Mapping[str, float]) -> str:
    """Name and parameters as a row."""
    return f"{name:14}" + "".join(f"{value:10.5f}" for value in parameters.values())


def evaluate(shape: str, known: dict[str, dr.Plant | dr.Result]) -> tuple[dr.Trajectory, dict[str, dr.Log]]:
    """Plan with the true parameters and flight of each model; prints the tracking errors."""
    print(f"\n{shape:14}{'x':>10}{'z':>10}{'theta':>10}   RMS tracking error (m, m, rad)")
    plans, flights = {}, {}
    for name, plant in known.items():
        try:
            plan = SHAPES[shape](plant)
            flight = dr.fly(PLANT, plan, dr.tvlqr(plant, plan))
        except dr.PlanningError as reason:
            print(f"{name:14}   no plan: {str(reason).split(': ', 1)[-1].split(';')[0]}")
            continue
        error = dr.tracking_error(plan, flight)
        note = "".join(f"   {sentence}" for sentence in flight.notes)
        print(f"{name:14}" + "".join(f"{error[state]:10.3f}" for state in ("x", "z", "theta")) + note)
        plans[name], flights[name] = plan, flight
    return plans["true"], flights


def main(folder: Path) -> None:
    """Simulate, identify, evaluate, and write report and figure."""
    folder.mkdir(parents=True, exist_ok=True)
    log = simulate()
    results = identify(log)
    known = {"true": PLANT, **results}
    plan, flights = evaluate("square", known)
    del flights["true"]  # methods then have the same colours as in the report
    evaluate("sine", known)
    dr.write_report(results, log, folder / "report.html")
    dr.plot_flight(plan, flights, folder / "flight.png", title="A square, flown with each identified model")
    print(f"\nReport: {folder / 'report.html'}\nFigure: {folder / 'flight.png'}")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("out/demo"))
