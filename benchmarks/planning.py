"""How fast plans are made: the paper's square, star and sine.

Times are medians of 15 solves that take turns; `again` starts from the straight way, `near` from the solution for
parameters that are 2 % off.  The last rows show what one Runge-Kutta step an interval instead of ten would save, and
where its inputs lead in a simulation at 100 Hz.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np

import diransac as dr
from diransac.flight.planning import planner, solvers
from diransac.flight.planning.transcription import Program
from diransac.simulation import RolloutBatch, rollouts

FLIGHTS: dict[str, Callable[..., dr.Trajectory]] = {"square": dr.square, "star": dr.star, "sine": dr.sine}
REPETITIONS = 15
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


def compare(name: str) -> None:
    """Print times of a plan from scratch, and from the plan for other parameters."""
    flight, guess = FLIGHTS[name], FLIGHTS[name](NEIGHBOUR)
    taken = medians({"again": lambda: flight(PLANT), "near": lambda: flight(PLANT, guess=guess)}, REPETITIONS)
    print(f"{name:<8}{1e3 * taken['again']:>11.0f}{1e3 * taken['near']:>11.0f}", flush=True)


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
        "one": lambda: solvers.interior_point(program, guess, solvers.SearchLimits(200, 60.0)),
        "ten": lambda: solvers.interior_point(fine, guess, solvers.SearchLimits(200, 60.0)),
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
    """Print the table, and what shorter steps cost."""
    taken = seconds(lambda: dr.square(PLANT))[0]
    print(f"the first plan of a model, which compiles it: {taken:.1f} s\n")
    print(f"{'':<8}{'again, ms':>11}{'near, ms':>11}")
    for name in FLIGHTS:
        compare(name)
    print()
    for name in FLIGHTS:
        coarse(name)


if __name__ == "__main__":
    main()
