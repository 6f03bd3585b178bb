"""The main job, start to finish: fly, record, identify by every method, and let each model fly.

A planar rotorcraft with unbalanced rotors (Dimmig et al. 2023, Tables I and II) flies a star. In its log, one in ten
values of every signal is an outlier of up to 80. From that log every method identifies a model that knows nothing of
the imbalance. Each model then plans a square and a sine and steers the same machine along them: how far it strays is
what the model is worth. Run it with ``make demo``; it writes ``report.html`` and ``flight.png`` into ``out/demo``.

The imbalance acts as the paper prints it, eq. (20). With ``convention="physical"`` its torque is divided by the inertia
and shakes the machine 250 times harder: try it, and see what is left of each method.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import diransac as dr

MACHINE = dr.models.extended_rotorcraft(aerodynamic_imbalance=1.4e-6, convention="printed")
NOISE = dr.Noise(outlier_probability=0.1, outlier_magnitude=80.0)
SHAPES = {"square": dr.square, "sine": dr.sine}


def record() -> dr.Log:
    """The log of a star, flown by the true parameters, as a bad recorder keeps it."""
    trajectory = dr.star(MACHINE)
    flight = dr.fly(MACHINE, trajectory, dr.tvlqr(MACHINE, trajectory))
    error = dr.tracking_error(trajectory, flight)
    log = dr.corrupt(flight, NOISE, seed=1)
    spoilt = sum(int(mask.sum()) for mask in log.planted.values())
    print(
        f"A star: {len(log)} rows at {1 / log.dt:.0f} Hz, off by {error['x']:.3f} m in x and {error['z']:.3f} m in z;"
    )
    print(f"{spoilt} values of its log are then outliers of up to {NOISE.outlier_magnitude:.0f}.\n")
    return log


def identify(log: dr.Log) -> dict[str, dr.Result]:
    """What every method finds, printed below what is true."""
    print(f"{'method':14}{'mass':>10}{'inertia':>10}{'drag':>10}{'inliers':>11}{'time':>10}")
    print(f"{'true':14}" + "".join(f"{value:10.5f}" for value in MACHINE.parameters.values()))
    results = {}
    for method in dr.METHODS:
        begin = time.perf_counter()
        found = dr.identify(MACHINE.model, log, method, seed=0, settings=dr.Settings.table_iv())
        seconds = time.perf_counter() - begin
        estimates = "".join(f"{value:10.5f}" for value in found.parameters.values())
        print(f"{method:14}{estimates}{100 * found.inlier_fraction:9.1f} %{seconds:8.2f} s")
        results[method] = found
    return results


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
    judge("sine", known)
    dr.write_report(results, log, folder / "report.html")
    dr.plot_flight(plan, flights, folder / "flight.png", title="A square, flown by what each method found")
    print(f"\nThe page: {folder / 'report.html'}\nThe picture: {folder / 'flight.png'}")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("out/demo"))
