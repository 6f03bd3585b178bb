"""Why there is no plan: the nearest thing to one, and what it misses."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.flight.planning.problem import Task, first_path, fixed_program, unknowns_of
from diransac.flight.planning.request import Waypoint
from diransac.flight.planning.solvers import TIME_LIMIT, Outcome, SearchLimits, interior_point
from diransac.flight.planning.transcription import Program

if TYPE_CHECKING:
    pass


__all__ = ["why_not"]

_ITERATIONS = 500

_MISS_WEIGHT = 1e4
"""What missing a waypoint by one unit costs, against full use of an input for a second."""

_MET = 1e-2
"""Unit of the state; what the nearest plan misses by less has no reason in the waypoints: the weight isn't infinite."""

_AT_LIMIT = 1e-3
"""Share of a range, or of a unit, within which a value is at its limit."""


def why_not(task: Task, rows: tuple[int, ...], outcome: Outcome, limits: SearchLimits) -> str:
    """A sentence: which waypoint is missed by how much, which limits bind, and what to relax.

    The nearest plan starts where it should, keeps to all limits, and misses the later waypoints as little as it can in
    the sense of least squares. IPOPT finds it.
    """
    if outcome.status == TIME_LIMIT:
        return f"no plan was found within {limits.seconds:g} s; raise time_limit=, or give a guess="
    program = _relaxed(task, rows)
    guess = unknowns_of(program, first_path(task, task.dt * np.array(rows)))
    nearest = interior_point("ipopt", program, guess, SearchLimits(_ITERATIONS, limits.seconds))
    if not nearest.success:
        return (
            f"there is no plan: {outcome.words}, and not even one that misses its waypoints was "
            f"found; check the parameters, or give more time"
        )
    missed = _largest_miss(task, program, nearest.unknowns)
    binding = _binding(task, program, nearest.unknowns)
    if missed is None:
        remedy = f"relax {binding}" if binding else "give guess= or more max_iterations="
        return (
            f"no plan was found, though one comes near every waypoint: {outcome.words}; "
            f"give a little more time, or {remedy}"
        )
    remedy = f"raise the limits of {binding}" if binding else "ask for something that the inputs can reach"
    return f"the plan cannot be flown: {missed}; give it more time, or {remedy}"


def _relaxed(task: Task, rows: tuple[int, ...]) -> Program:
    """The program without waypoints but the first, in which missing the others costs."""
    nowhere = Waypoint((), np.zeros(0))
    relaxed = replace(
        task,
        waypoints=(task.waypoints[0], *(nowhere for _ in task.waypoints[1:])),
        state_weights=np.zeros_like(task.state_weights),
    )
    program = fixed_program(relaxed, rows)
    costs = program.numbers.costs
    reference, weights = costs.reference.copy(), costs.weights.copy()
    for knot, waypoint in zip(program.layout.waypoint_knots[1:], task.waypoints[1:], strict=True):
        states = list(waypoint.states)
        reference[knot, states], weights[knot, states] = waypoint.values, _MISS_WEIGHT
    numbers = replace(program.numbers, costs=replace(costs, reference=reference, weights=weights))
    return Program(program.stage, program.layout, numbers)


def _largest_miss(task: Task, program: Program, unknowns: FloatArray) -> str | None:
    """The waypoint state that is missed by most, in words."""
    states, names = program.split(unknowns)[0], task.model.state
    ends = np.concatenate([[0.0], np.cumsum(program.numbers.steps.sum(axis=1))])
    worst, text = _MET, None
    for k, (knot, waypoint) in enumerate(zip(program.layout.waypoint_knots, task.waypoints, strict=True)):
        misses = np.abs(states[knot, list(waypoint.states)] - waypoint.values)
        if len(misses) and misses.max() > worst:
            worst, name = misses.max(), names[waypoint.states[int(misses.argmax())]]
            text = (
                f"waypoint {k} ({waypoint.text(names)}) at t = {ends[knot]:.2f} s is missed by {worst:.2g} "
                f"{task.model.units[name]} in {name}"
            )
    return text


def _binding(task: Task, program: Program, unknowns: FloatArray) -> str:
    """Names of the inputs and states that are at a limit somewhere."""
    states, inputs = program.split(unknowns)
    names = []
    for values, limits, known in (
        (inputs, task.inputs, tuple(task.model.inputs)),
        (states[1:, : len(task.model.state)], task.states, task.model.state),
    ):
        slack = _AT_LIMIT * limits.half_ranges
        at_limit = np.any((values <= limits.lower + slack) | (values >= limits.upper - slack), axis=0)
        names += [known[j] for j in np.flatnonzero(at_limit)]
    return " and ".join(names)
