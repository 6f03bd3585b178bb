"""Planning, steering and flying, each against Drake's fastest way to do the same work: the whole table in one run.

Run it as ``python benchmarks/flight.py [--repetitions N]``.  Drake comes with ``pip install .[drake]``; without it its
rows are left out, and that is said.  A row is a ratio of medians of repetitions that took turns; every repetition plans
for a new parameter vector, from the plan for the nominal one.  The square is the package's, but for its corners' times
on whole tenths of a second, because Drake's `DirectTranscription` has one step for all intervals.
"""

import argparse
import os
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import drake_ways
import numpy as np
from kernel import timed

import diransac as dr
from diransac.flight.planning.trajectories import (
    CORNERS,
    INPUT_LIMIT_FRACTION,
    MEAN_SPEED,
    ROTORCRAFT_LIMITS,
    ROUTE_WEIGHT,
)
from diransac.simulation import LinearFeedback, RolloutBatch, rollouts

Array = np.ndarray[Any, Any]
MODEL = dr.models.planar_rotorcraft()
NOMINAL = dr.Plant(MODEL, dr.models.TABLE_I)
STEP, N_LANES = 0.1, 64
PLANES = [(0.0, 0.0), *CORNERS, CORNERS[0]]
SLOW = 2.0
"""s: what takes longer is repeated once alone."""


def row(name: str, ratio: float | None, bound: str = "", note: str = "") -> None:
    """Print one row."""
    shown = "" if ratio is None else f"{ratio:,.3g}" if ratio < 1000 else f"{ratio:,.0f}"
    print(f"{name:<72}{shown:>10}  {bound:<16}{note}", flush=True)


def in_turns(calls: dict[str, Callable[[], Any]], repetitions: int) -> dict[str, float]:
    """Median seconds of each call, measured in turns; what is slow takes part in the first turn alone."""
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(repetitions):
        for name, call in calls.items():
            if turn == 0 or seconds[name][0] < SLOW:
                seconds[name].append(timed(call))
    return {name: float(np.median(taken)) for name, taken in seconds.items()}


# Planning ------------------------------------------------------------------------------------------------------------
def corner_times() -> Array:
    """Times of the square's waypoints, on whole tenths."""
    lengths = np.linalg.norm(np.diff(PLANES, axis=0), axis=1)
    return STEP * np.concatenate([[0.0], np.cumsum(np.rint(lengths / MEAN_SPEED / STEP))])


def plan(plant: dr.Plant, guess: dr.Trajectory | None = None) -> dr.Trajectory:
    """The square."""
    times = corner_times()
    route = {name: partial(np.interp, xp=times, fp=[place[j] for place in PLANES]) for j, name in enumerate(("x", "z"))}
    return dr.plan(
        plant, waypoints=[{"x": x, "z": z} for x, z in PLANES], times=times.tolist(), reference=route,
        state_weights={"x": ROUTE_WEIGHT, "z": ROUTE_WEIGHT}, input_limits=ROTORCRAFT_LIMITS,
        input_limit_fraction=INPUT_LIMIT_FRACTION, guess=guess,
    )  # fmt: skip


def square_in_numbers() -> drake_ways.Square:
    """The same for Drake."""
    times = corner_times()
    knots = STEP * np.arange(1 + round(times[-1] / STEP))
    low, high = np.array(list(ROTORCRAFT_LIMITS.values())).T
    middle, half = (low + high) / 2, (high - low) / 2
    usable = INPUT_LIMIT_FRACTION * half
    return drake_ways.Square(
        step=STEP,
        corners={round(t / STEP): place for t, place in zip(times, PLANES, strict=True)},
        route=np.column_stack([np.interp(knots, times, column) for column in np.transpose(PLANES)]),
        route_weight=ROUTE_WEIGHT,
        lowest=middle - usable,
        highest=middle + usable,
        half_ranges=half,
    )


def parameter_vectors(seed: int) -> Iterator[Array]:
    """New parameters within 10 % of the nominal ones, without end."""
    rng = np.random.default_rng(seed)
    while True:
        yield np.array(list(NOMINAL.parameters.values())) * rng.uniform(0.9, 1.1, MODEL.n_p)


def plant_of(parameters: Array) -> dr.Plant:
    """The model with other parameters."""
    return dr.Plant(MODEL, dict(zip(MODEL.parameters, parameters, strict=True)))


def ways_of_drake(guess: dr.Trajectory) -> dict[str, Callable[[Array], float]]:
    """What an expert would try; each gives a plan's cost, solvers at their own tolerance, or at one that is enough."""
    square, start = square_in_numbers(), (guess.time, guess.states, guess.inputs)

    def way(program: Callable[..., Any], solver: str, tolerance: float | None, parameters: Array) -> float:
        return drake_ways.solved(program(square, parameters), start, solver, tolerance)

    return {
        "DirectTranscription, SNOPT": partial(way, drake_ways.transcription, "SNOPT", None),
        "DirectTranscription, SNOPT to 1e-4": partial(way, drake_ways.transcription, "SNOPT", 1e-4),
        "DirectTranscription, IPOPT to 1e-4": partial(way, drake_ways.transcription, "IPOPT", 1e-4),
        "DirectCollocation, SNOPT to 1e-4": partial(way, drake_ways.collocation, "SNOPT", 1e-4),
    }


def compare_planning(nominal: dr.Trajectory, repetitions: int) -> None:
    """Row (a)."""

    def ours(parameters: Array) -> float:
        return float(plan(plant_of(parameters), nominal).cost or 0.0)

    try:
        import pydrake.all  # noqa: F401
    except ImportError:
        vectors = parameter_vectors(0)
        found = in_turns({"ours": lambda: ours(next(vectors))}, repetitions)
        row(
            "(a) plan a square, warm",
            None,
            note=f"{1e3 * found['ours']:.3g} ms; Drake is left out: pip install .[drake]",
        )
        return
    ways = {"ours": ours, **ways_of_drake(nominal)}
    exact = ours(first := next(parameter_vectors(1)))
    agreement = {name: abs(way(first) / exact - 1) for name, way in ways.items()}
    streams = {name: parameter_vectors(0) for name in ways}
    found = in_turns({n: lambda n=n, way=way: way(next(streams[n])) for n, way in ways.items()}, repetitions)
    fastest = min(list(ways)[1:], key=found.__getitem__)
    note = f"{1e3 * found['ours']:.3g} ms; the fastest is {fastest}"
    row("(a) plan a square for new parameters, warm: Drake's fastest / ours", found[fastest] / found["ours"], "", note)
    for name in list(ways)[1:]:
        note = f"{1e3 * found[name]:.3g} ms; costs agree to {agreement[name]:.0e}"
        row(f"    {name} / ours", found[name] / found["ours"], "", note)


# Steering ------------------------------------------------------------------------------------------------------------
def default_weights() -> tuple[Array, Array, Array]:
    """Q, R and Qf that `tvlqr` takes by itself."""
    Q = np.diag([4.0, 4.0, 4.0, 1.0, 1.0, 1.0])
    half = np.ptp(np.array(list(ROTORCRAFT_LIMITS.values())), axis=1) / 2
    return Q, np.diag(half**-2.0), Q


def first_gain_at_rate(trajectory: dr.Trajectory, rows_between: int) -> Array:
    """The first row's gain on a finer grid: states linear between rows, inputs held, up to the last row."""
    time = np.linspace(trajectory.time[0], trajectory.time[-1], (len(trajectory) - 1) * rows_between + 1)[:-1]
    states = np.column_stack([np.interp(time, trajectory.time, column) for column in trajectory.states.T])
    inputs = np.repeat(trajectory.inputs[:-1], rows_between, axis=0)
    return dr.tvlqr(NOMINAL, dr.Trajectory(time, states, inputs), *default_weights()).gains[0]


def compare_steering(nominal: dr.Trajectory, repetitions: int) -> None:
    """Row (b)."""
    plants = [plant_of(parameters) for parameters, _ in zip(parameter_vectors(2), range(N_LANES), strict=False)]
    parameters = list(NOMINAL.parameters.values())
    rows = (nominal.time, nominal.states, nominal.inputs)
    calls: dict[str, Callable[[], Any]] = {
        "ours": partial(dr.tvlqr, NOMINAL, nominal),
        "ours, many": partial(dr.tvlqr_batch, plants, [nominal] * N_LANES),
        "continuous": partial(drake_ways.regulator, parameters, rows, default_weights(), 0.0),
        "discrete": partial(drake_ways.regulator, parameters, rows, default_weights(), nominal.dt),
    }
    try:
        theirs = {name: calls[name]().value(nominal.time[0]) for name in ("continuous", "discrete")}
    except ImportError:
        calls = {name: call for name, call in calls.items() if name.startswith("ours")}
        found = in_turns(calls, repetitions)
        row("(b) TVLQR on it", None, note=f"{1e3 * found['ours']:.3g} ms; Drake is left out: pip install .[drake]")
    else:
        exact = 2 * first_gain_at_rate(nominal, 20) - first_gain_at_rate(nominal, 10)
        own = dr.tvlqr(NOMINAL, nominal).gains[0]
        found = in_turns(calls, repetitions)
        error = np.abs(theirs["continuous"] - exact).max() / np.abs(exact).max()
        note = f"{1e3 * found['ours']:.3g} ms; gains agree to {error:.0e} as dt -> 0"
        row("(b) TVLQR on it: Drake, continuous / ours", found["continuous"] / found["ours"], "", note)
        error = np.abs(theirs["discrete"] - own).max() / np.abs(own).max()
        note = f"its gains differ by {error:.0%}: Drake does not keep S symmetric, rounding errors grow"
        row("    Drake, of the same discrete system / ours", found["discrete"] / found["ours"], "", note)
    note = f"{1e6 * found['ours, many'] / N_LANES:.0f} us each, one thread"
    row(f"    one alone / one of {N_LANES} at once", found["ours"] * N_LANES / found["ours, many"], "", note)


# Flying --------------------------------------------------------------------------------------------------------------
def compare_flying(nominal: dr.Trajectory, repetitions: int) -> None:
    """Row (c): closed loops of the extended plant, one thread."""
    from diransac.flight.closed_loop import fly_batch

    plant = dr.models.extended_rotorcraft(aerodynamic_imbalance=1.4e-6, mass_imbalance=1e-4)
    vectors = parameter_vectors(3)
    controllers = dr.tvlqr_batch([plant_of(next(vectors)) for _ in range(N_LANES)], [nominal] * N_LANES)
    seeds, substeps = list(range(N_LANES)), plant.substeps(nominal.dt)
    starts = np.array([plant.initial_state(nominal.states[0], seed) for seed in seeds])
    hidden = [(0, starts.shape[1] - len(MODEL.state))]
    x_ref, gains = (np.pad(a, [(0, 0)] * (a.ndim - 1) + hidden) for a in (nominal.states, controllers[0].gains))
    feedback = LinearFeedback(nominal.inputs, x_ref, gains, controllers[0].u_min, controllers[0].u_max)
    engine, constants = rollouts(plant.simulated, substeps=substeps), np.tile(plant.constants, (N_LANES, 1))
    logs = fly_batch([plant] * N_LANES, controllers, seeds=seeds, threads=1)
    found = in_turns(
        {
            "logs": partial(fly_batch, [plant] * N_LANES, controllers, seeds=seeds, threads=1),
            "rollouts": partial(engine.fly, RolloutBatch(constants, starts, nominal.inputs, nominal.dt), feedback),
        },
        repetitions,
    )
    flown = N_LANES * (nominal.time[-1] - nominal.time[0])
    errors = [dr.tracking_error(nominal, log) for log in logs]
    worst = max(np.hypot(error["x"], error["z"]) for error in errors)
    note = f"{1e3 * found['logs']:.3g} ms, {substeps} steps a row; within {worst:.2f} m RMS of the square"
    row(
        f"(c) {N_LANES} flights of the extended plant, logs included, times real time",
        flown / found["logs"],
        "10,000",
        note,
    )
    note = f"{1e3 * found['rollouts']:.3g} ms"
    row(
        "    without logs, one controller for all: the compiled loop with its arrays",
        flown / found["rollouts"],
        "10,000",
        note,
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repetitions", type=int, default=7)
    repetitions = parser.parse_args().repetitions
    print(f"medians of {repetitions} repetitions in turns; load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores\n")
    print(f"{'':<72}{'ratio':>10}  {'at least':<16}measured")
    nominal = plan(NOMINAL)
    compare_planning(nominal, repetitions)
    compare_steering(nominal, repetitions)
    compare_flying(nominal, repetitions)


if __name__ == "__main__":
    main()
