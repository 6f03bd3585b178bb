"""How fast plans are made: the paper's square, star and sine.

Times are medians of 15 solves that take turns; `again` starts from the straight way, `near` from the solution for
parameters that are 2 % off.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

import diransac as dr

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


def main() -> None:
    """Print the table."""
    taken = seconds(lambda: dr.square(PLANT))[0]
    print(f"the first plan of a model, which compiles it: {taken:.1f} s\n")
    print(f"{'':<8}{'again, ms':>11}{'near, ms':>11}")
    for name in FLIGHTS:
        compare(name)


if __name__ == "__main__":
    main()
