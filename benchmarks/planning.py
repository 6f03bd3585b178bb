"""How fast plans are made, and whether three solvers find the same: the paper's square, star and sine.

Run it as ``python benchmarks/planning.py [--without-snopt]``.  SNOPT comes with ``pip install diransac[snopt]``; where
it is absent its rows are left out, which is said.  Times are medians of 15 solves that take turns, SNOPT's of one;
`again` starts from the straight way, `near` from the solution for parameters that are 2 % off.  The last rows show what
one Runge-Kutta step an interval instead of ten would save, and where its inputs lead in a simulation at 100 Hz.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from typing import Any
from unittest.mock import patch

import numpy as np

import diransac as dr
from diransac.flight.planning import planner, solvers
from diransac.flight.planning.transcription import Program
from diransac.simulation import RolloutBatch, rollouts

FLIGHTS: dict[str, Callable[..., dr.Trajectory]] = {"square": dr.square, "star": dr.star, "sine": dr.sine}
REPETITIONS = 15
LONG = 300.0
PLANT = dr.Plant(dr.models.planar_rotorcraft(), dr.models.TABLE_I)
NEIGHBOUR = dr.Plant(PLANT.model, {name: 1.02 * value for name, value in PLANT.parameters.items()})


def seconds(call: Callable[[], Any]) -> tuple[float, Any]:
    """How long a call takes, and what it gives."""
    start = time.perf_counter()
    value = call()
    return time.perf_counter() - start, value


def medians(calls: dict[str, Callable[[], Any]], repetitions: int) -> dict[str, float]:
    """Median time of each call, s; they take turns, so that a busy machine slows all alike."""
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repetitions):
        for name, call in calls.items():
            taken[name].append(seconds(call)[0])
    return {name: float(np.median(values)) for name, values in taken.items()}


def compare(name: str, snopt: bool) -> None:
    """Print a row for each solver: agreement with IPOPT, and times."""
    flight = FLIGHTS[name]
    names = ("ipopt", "fatrop")
    every = (*names, *["snopt"] * snopt)
    first = {solver: seconds(lambda s=solver: flight(PLANT, solver=s, time_limit=LONG)) for solver in every}
    guess = flight(NEIGHBOUR)
    again = medians({s: lambda s=s: flight(PLANT, solver=s) for s in names}, REPETITIONS)
    near = medians({s: lambda s=s: flight(PLANT, solver=s, guess=guess) for s in names}, REPETITIONS)
    if snopt:
        again["snopt"] = first["snopt"][0]
        near["snopt"] = seconds(lambda: flight(PLANT, solver="snopt", guess=guess, time_limit=LONG))[0]
    best = first["ipopt"][1]
    for solver, (_, found) in first.items():
        print(
            f"{name:<8}{solver:<8}{found.cost / best.cost - 1:>12.1e}{np.abs(found.states - best.states).max():>12.1e}"
            f"{1e3 * again[solver]:>11.0f}{again[solver] / again['ipopt']:>8.2f}"
            f"{1e3 * near[solver]:>11.0f}{near[solver] / near['ipopt']:>8.2f}",
            flush=True,
        )


def coarse(name: str) -> None:
    """Print what one integration step an interval saves, and how far its inputs fly past the last waypoint."""
    with patch.object(planner, "fixed_program", wraps=planner.fixed_program) as built:
        found = FLIGHTS[name](PLANT)
    fine = planner.fixed_program(*built.call_args.args)
    steps = fine.numbers.steps.sum(axis=1, keepdims=True)
    program = Program(fine.stage, fine.layout, replace(fine.numbers, steps=steps))
    guess = np.zeros(program.layout.n_unknowns)
    states, inputs = found.states, found.inputs
    counts = (fine.numbers.steps > 0).sum(axis=1)
    knots = np.concatenate([[0], np.cumsum(counts)])
    guess[program.layout.states], guess[program.layout.inputs] = states[knots], inputs[knots[:-1]]
    calls = {
        "one": lambda: solvers.interior_point("fatrop", program, guess, solvers.SearchLimits(200, 60.0)),
        "ten": lambda: solvers.interior_point("fatrop", fine, guess, solvers.SearchLimits(200, 60.0)),
    }
    outcome = calls["one"]()
    flown_inputs = np.repeat(program.split(outcome.unknowns)[1], counts, axis=0)
    p = np.array([list(PLANT.parameters.values())])
    batch = RolloutBatch(p, states[0], np.concatenate([flown_inputs, flown_inputs[-1:]]), 0.01)
    flown = rollouts(PLANT.model).trajectories(batch)
    taken = medians(calls, REPETITIONS)
    miss = np.abs(np.asarray(flown[0])[-1, :2] - states[-1, :2]).max()
    print(
        f"{name}: one step an interval takes {taken['one'] / taken['ten']:.2f} of the time of ten "
        f"({1e3 * taken['one']:.0f} and {1e3 * taken['ten']:.0f} ms); flown, its inputs end {miss:.1e} m off"
    )


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--without-snopt", action="store_true", help="leave out SNOPT, which takes minutes")
    snopt = not parser.parse_args().without_snopt
    if snopt and find_spec("pydrake") is None:
        print("SNOPT is absent (pip install 'diransac[snopt]'): its rows are left out")
        snopt = False
    taken = seconds(lambda: dr.square(PLANT))[0]
    print(f"the first plan of a model, which compiles it: {taken:.1f} s\n")
    print(f"{'':<8}{'solver':<8}{'cost':>12}{'states':>12}{'again, ms':>11}{'ratio':>8}{'near, ms':>11}{'ratio':>8}")
    for name in FLIGHTS:
        compare(name, snopt)
    print()
    for name in FLIGHTS:
        coarse(name)


if __name__ == "__main__":
    main()
