"""The main job, start to finish: fly, record, identify by every method, and let each model fly.

A planar rotorcraft with unbalanced rotors (Dimmig et al. 2023, Tables I and II) flies a star. Its rotors lift more than
any model of it knows, and shake it at 250 Hz, which a log at 100 Hz aliases; besides, one in ten values of every signal
is an outlier of up to 80. From that log every method identifies a model. Each model then plans a square and a sine and
steers the same machine along them: how far it strays is what the model is worth. Run it with ``make demo``; it writes
``report.html`` and ``flight.png`` into ``out/demo``.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from pathlib import Path

import diransac as dr

IMBALANCE = 1.4e-6  # m^4, of blades: thrust in excess, in proportion to the thrust
C_T, DIAMETER = 0.06, 0.127  # of its propellers; m
MACHINE = dr.models.extended_rotorcraft(aerodynamic_imbalance=IMBALANCE, mass_imbalance=1e-4)
NOISE = dr.Noise(outlier_probability=0.1, outlier_magnitude=80.0)
SHAPES = {"square": dr.square, "sine": dr.sine}


def record() -> dr.Log:
    """The log of a star, flown by the true parameters, as a bad recorder keeps it."""
    trajectory = dr.star(MACHINE)
    flight = dr.fly(MACHINE, trajectory, dr.tvlqr(MACHINE, trajectory))
    error = dr.tracking_error(trajectory, flight)
    log = dr.corrupt(flight, NOISE, seed=1)
    spoilt = sum(int(mask.sum()) for mask in log.fault_mask.values())
    print(
        f"A star: {len(log)} rows at {1 / log.dt:.0f} Hz, off by {error['x']:.3f} m in x and {error['z']:.3f} m in z;"
    )
    print(f"{spoilt} values of its log are then outliers of up to {NOISE.outlier_magnitude:.0f}.\n")
    return log


def identify(log: dr.Log) -> dict[str, dr.Result]:
    """What every method finds, printed below what is true."""
    print(f"{'method':14}{'mass':>10}{'inertia':>10}{'drag':>10}{'inliers':>11}{'time':>10}")
    print(_row("true", MACHINE.parameters))
    print(_row("effective", effective(MACHINE.parameters)) + "   what a log can show: 9 % of lift is not in the model")
    results = {}
    for method in dr.METHODS:
        begin = time.perf_counter()
        found = dr.identify(MACHINE.model, log, method, seed=0, settings=dr.Settings.table_iv())
        seconds = time.perf_counter() - begin
        print(f"{_row(method, found.parameters)}{100 * found.inlier_fraction:9.1f} %{seconds:8.2f} s")
        results[method] = found
    print("(Times include compiling the model for a method's first use.)")
    return results


def effective(parameters: Mapping[str, float]) -> dict[str, float]:
    """The parameters that a log can show: 9 % of lift that is not in the model is a mass 8 % less."""
    lift = 1.0 + IMBALANCE / (C_T * DIAMETER**4)
    return {**parameters, "mass": parameters["mass"] / lift}


def _row(name: str, parameters: Mapping[str, float]) -> str:
    return f"{name:14}" + "".join(f"{value:10.5f}" for value in parameters.values())


def judge(shape: str, known: dict[str, dr.Plant | dr.Result]) -> tuple[dr.Trajectory, dict[str, dr.Log]]:
    """Let each plan and steer, print how far the machine strays; what is to be flown in truth, and what was flown."""
    print(f"\n{shape:14}{'x':>10}{'z':>10}{'theta':>10}   RMS tracking error (m, m, rad)")
    plans, flights = {}, {}
    for name, plant in known.items():
        try:
            plan = SHAPES[shape](plant)
            flight = dr.fly(MACHINE, plan, dr.tvlqr(plant, plan))
        except dr.PlanningError as reason:
            print(f"{name:14}   no plan: {str(reason).split(': ', 1)[-1].split(';')[0]}")
            continue
        error = dr.tracking_error(plan, flight)
        note = "".join(f"   {sentence}" for sentence in flight.notes)
        print(f"{name:14}" + "".join(f"{error[state]:10.3f}" for state in ("x", "z", "theta")) + note)
        plans[name], flights[name] = plan, flight
    return plans["true"], flights


def main(folder: Path) -> None:
    """Record, identify, judge, and write the page and the picture."""
    folder.mkdir(parents=True, exist_ok=True)
    log = record()
    results = identify(log)
    known = {"true": MACHINE, **results}
    plan, flights = judge("square", known)
    del flights["true"]  # so that methods look as they do on the page
    judge("sine", known)
    dr.write_report(results, log, folder / "report.html")
    dr.plot_flight(plan, flights, folder / "flight.png", title="A square, flown by what each method found")
    print(f"\nThe page: {folder / 'report.html'}\nThe picture: {folder / 'flight.png'}")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("out/demo"))
