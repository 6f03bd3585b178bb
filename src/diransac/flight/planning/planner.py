"""Trajectory optimisation: `plan`, the search for a solution, and the explanation where there is none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import PlanningError
from diransac.flight.planning.problem import (
    InitialGuess,
    Task,
    fixed_program,
    free_program,
    guess_along,
    straight_guess,
    stretched_guess,
    trajectory_of,
    unknowns_of,
)
from diransac.flight.planning.request import (
    TIME_STEP,
    Limits,
    Signal,
    Waypoint,
    check_search,
    check_weights,
    check_within,
    limits_of,
    reference_weights,
    route_of,
    start_at_rest,
    trim_at,
    weights_of,
)
from diransac.flight.planning.solvers import TIME_LIMIT, SearchLimits, Solution, Strategy, interior_point
from diransac.flight.planning.transcription import Program
from diransac.flight.trajectory import Trajectory

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from diransac.model.plant import ModelWithParameters

__all__ = ["plan"]


def plan(
    plant: ModelWithParameters,
    *,
    waypoints: Sequence[Mapping[str, float]] | None = None,
    times: Sequence[float] | None = None,
    reference: Mapping[str, Signal | ArrayLike] | None = None,
    duration: float | None = None,
    input_limits: Mapping[str, tuple[float, float]] | None = None,
    input_limit_fraction: float = 1.0,
    state_limits: Mapping[str, tuple[float, float]] | None = None,
    input_weights: Mapping[str, float] | None = None,
    state_weights: Mapping[str, float] | None = None,
    time_weight: float = 1.0,
    trim: Mapping[str, float] | None = None,
    start_end_at_rest: bool = True,
    guess: Trajectory | None = None,
    max_iterations: int = 200,
    time_limit: float = 30.0,
) -> Trajectory:
    """Trajectory of least cost through waypoints or along a reference, by direct transcription.

    The cost is the integral of ``sum_i r_i ((u_i - trim_i) / h_i)^2 + sum_j w_j (x_j - reference_j)^2``, with input
    weights r, state weights w and h half the range of an input's limits (1 without limits); where time is free, plus
    ``time_weight`` times the duration.

    Parameters
    ----------
    plant : Plant or Result
        Model and parameters.
    waypoints : sequence of mappings of str to float, optional
        States by name, from the start to the end; states that are not named are free between both.
    times : sequence of float, optional
        Time of each waypoint, s, rounded to rows. None: the durations of the segments are optimised.
    reference : mapping of str to callable or (n,) array, optional
        Function of time (array, s from the start) for each state, or samples evenly spaced over the duration.
    duration : float, optional
        s, of a plan along a reference without waypoints, whose first and last values it starts and ends with.
    input_limits, state_limits : mapping of str to (float, float), optional
        Smallest and largest value, in the unit of the input or state.
    input_limit_fraction : float
        Fraction of the range from trim to each input limit that the plan uses; the rest remains for feedback.
    input_weights : mapping of str to float, optional
        r, 1/s; 1 by default.
    state_weights : mapping of str to float, optional
        w, one over the state's unit squared and s; 1 by default for each state with a reference.
    time_weight : float
        1/s, where time is free. With 1, a second costs as much as full use of an input for a second.
    trim : mapping of str to float, optional
        Inputs of zero cost, 0 where not named. By default those that hold the plant at rest at the start.
    start_end_at_rest : bool
        Whether states that the first and last waypoint do not name are zero there; states of first order are at rest
        under the inputs of zero cost in the first, and free in the last. False: they are all free.
    guess : Trajectory, optional
        Starting point of the search, of the same model.
    max_iterations : int
        Of the last attempt; earlier ones get two fifths of it.
    time_limit : float
        s. Explaining why there is no plan may take the same time again.

    Returns
    -------
    Trajectory
        At 100 Hz; its ``input_limits`` are the full ones.

    Raises
    ------
    SettingsError
        An argument has no meaning; the message names it.
    PlanningError
        The plant cannot rest at the start, or there is no such trajectory; the message gives the reason.

    Notes
    -----
    Inputs are held over intervals of 0.1 s or slightly less, each a whole number of rows. One Runge-Kutta step leads
    from row to row, so that a simulation reproduces the rows of a plan. Waypoints and state limits hold at the ends of
    intervals.

    References
    ----------
    Betts 2010, "Practical Methods for Optimal Control and Estimation", chapter 4; Dimmig et al. 2023, section V-A.
    """
    model, limits = plant.model, limits_of("input", input_limits, tuple(plant.model.inputs))
    route = route_of(model, waypoints, times, reference, duration, start_end_at_rest)
    check_weights(state_weights, route, input_limit_fraction)
    check_search(time_weight, max_iterations, time_limit)
    parameters = model.parameter_vector(plant.parameters)
    trim_inputs = trim_at(model, parameters, route.waypoints[0], limits, trim)
    if start_end_at_rest and model.first_order:
        begin = start_at_rest(model, parameters, route.waypoints[0], trim_inputs)
        route = replace(route, waypoints=(begin, *route.waypoints[1:]))
    states = limits_of("state", state_limits, model.state)
    check_within(model, route.waypoints, states)
    task = Task(
        model=model,
        parameters=parameters,
        waypoints=route.waypoints,
        reference=route.reference,
        state_weights=reference_weights(model, route.reference, state_weights),
        input_weights=weights_of("input_weights", "input", input_weights, tuple(model.inputs), np.ones(model.n_u))
        / limits.half_ranges**2,
        trim=trim_inputs,
        time_weight=float(time_weight) if route.rows is None else 0.0,
        inputs=limits.around(trim_inputs, input_limit_fraction),
        states=states,
        dt=TIME_STEP,
    )
    search = _Search(task, SearchLimits(int(max_iterations), float(time_limit)), route.start, limits)
    initial = None if guess is None else guess_along(model, guess)
    return search.free(initial) if route.rows is None else search.fixed(route.rows, initial)


# Search --------------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class _Search:
    """Search for the solution of one task."""

    task: Task
    search_limits: SearchLimits
    start: float
    limits: Limits

    def fixed(self, rows: tuple[int, ...], guess: InitialGuess | None) -> Trajectory:
        """Plan whose segments have these numbers of rows."""
        program = fixed_program(self.task, rows)
        solution = self._solved(program, rows, guess)
        if not solution.success:
            raise PlanningError(_explanation(self.task, rows, solution, self.search_limits))
        return self._trajectory(program, solution)

    def free(self, guess: InitialGuess | None) -> Trajectory:
        """Plan of optimal durations, rounded up to whole rows for which there is a plan, too."""
        task, program = self.task, free_program(self.task)
        n = len(program.layout.intervals)
        durations = None if guess is None else np.full(n, guess.time[-1] / n)
        straight = straight_guess(task, np.ones(n) if durations is None else durations)
        strategy: Strategy = "line search" if guess is None else "warm start"
        unknowns = unknowns_of(program, guess or straight, durations)
        solution = interior_point(program, unknowns, self.search_limits, strategy)
        if not solution.success:
            raise PlanningError(
                f"no durations were found for which the plan works: {solution.summary}; "
                "give times=, for which the message names the binding limits"
            )
        found = program.split(solution.unknowns)[0][program.layout.waypoint_knots[:-1], -1]
        shortest = np.maximum(np.ceil(found / task.dt - 1e-6), 1).astype(int)
        # Rows added to optimal durations in turn until there is a plan on the grid of the inputs.
        for more in (0, 1, 2, 4, 8):
            rows = tuple(int(k) + more for k in shortest)
            whole = fixed_program(task, rows)
            along = stretched_guess(program, solution.unknowns, task.dt * np.array(rows))
            rounded = interior_point(whole, unknowns_of(whole, along), self.search_limits, "warm start")
            if rounded.success:
                return self._trajectory(whole, rounded)
        raise PlanningError(_explanation(task, rows, rounded, self.search_limits))

    def _solved(self, program: Program, rows: tuple[int, ...], guess: InitialGuess | None) -> Solution:
        """Solution from the guess, if there is one, else from straight lines, else by full Newton steps.

        Parameters far from plausible ones, such as an inertia of a fiftieth of the true one, make the constraints so
        curved that line searches stall; full steps converge.
        """
        straight = unknowns_of(program, straight_guess(self.task, self.task.dt * np.array(rows)))
        attempts: list[tuple[FloatArray, Strategy]] = [(straight, "line search")]
        if guess is not None:
            attempts.insert(0, (unknowns_of(program, guess), "warm start"))
        attempts.append((straight, "full steps"))
        whole = self.search_limits
        # Fraction of the iterations for every attempt but the last: most plans take a tenth of them.
        short = replace(whole, iterations=max(1, round(0.4 * whole.iterations)))
        for k, (unknowns, strategy) in enumerate(attempts, start=1):
            solution = interior_point(program, unknowns, whole if k == len(attempts) else short, strategy)
            if solution.success or solution.status == TIME_LIMIT:
                break
        return solution

    def _trajectory(self, program: Program, solution: Solution) -> Trajectory:
        kept = np.clip(solution.unknowns, program.numbers.lower, program.numbers.upper)
        return trajectory_of(self.task, program, kept, self.start, self.limits)


# Infeasible plans ----------------------------------------------------------------------------------------------------


def _explanation(task: Task, rows: tuple[int, ...], solution: Solution, limits: SearchLimits) -> str:
    """Sentence on the waypoint that is missed by most, the limits that bind, and what to relax.

    It describes the plan nearest to a feasible one: the start and all limits hold, and the squared distances from the
    later waypoints are least.
    """
    if solution.status == TIME_LIMIT:
        return f"no plan was found within {limits.seconds:g} s; raise time_limit=, or give a guess="
    program = _relaxed(task, rows)
    guess = unknowns_of(program, straight_guess(task, task.dt * np.array(rows)))
    nearest = interior_point(program, guess, SearchLimits(500, limits.seconds))
    if not nearest.success:
        return (
            f"there is no plan: {solution.summary}, and none was found that may miss its waypoints; "
            "check the parameters, or give more time"
        )
    missed = _largest_miss(task, program, nearest.unknowns)
    binding = _binding(task, program, nearest.unknowns)
    if missed is None:
        remedy = f"relax {binding}" if binding else "give guess= or more max_iterations="
        return (
            f"no plan was found, though one comes near every waypoint: {solution.summary}; "
            f"give slightly more time, or {remedy}"
        )
    remedy = f"raise the limits of {binding}" if binding else "ask for something that the inputs can reach"
    return f"the plan cannot be flown: {missed}; give it more time, or {remedy}"


def _relaxed(task: Task, rows: tuple[int, ...]) -> Program:
    """Program with a penalty on the distance from every waypoint but the first in place of a constraint."""
    free = Waypoint((), np.zeros(0))
    relaxed = replace(
        task,
        waypoints=(task.waypoints[0], *(free for _ in task.waypoints[1:])),
        state_weights=np.zeros_like(task.state_weights),
    )
    program = fixed_program(relaxed, rows)
    costs = program.numbers.costs
    reference, weights = costs.reference.copy(), costs.weights.copy()
    for knot, waypoint in zip(program.layout.waypoint_knots[1:], task.waypoints[1:], strict=True):
        states = list(waypoint.states)
        # Penalty on the distance from a waypoint, one over the state's unit squared.
        reference[knot, states], weights[knot, states] = waypoint.values, 1e4
    numbers = replace(program.numbers, costs=replace(costs, reference=reference, weights=weights))
    return Program(program.stage, program.layout, numbers)


def _largest_miss(task: Task, program: Program, unknowns: FloatArray) -> str | None:
    """Waypoint state that is missed by most; None where every waypoint is reached."""
    states, names = program.split(unknowns)[0], task.model.state
    ends = np.concatenate([[0.0], np.cumsum(program.numbers.steps.sum(axis=1))])
    # Distance within which a waypoint counts as reached, state's unit: the penalty is finite.
    worst, text = 1e-2, None
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
    """Names of the inputs and states that reach a limit."""
    states, inputs = program.split(unknowns)
    names = []
    for values, limits, known in (
        (inputs, task.inputs, tuple(task.model.inputs)),
        (states[1:, : len(task.model.state)], task.states, task.model.state),
    ):
        # Fraction of a range, or of a unit, within which a value is at its limit.
        slack = 1e-3 * limits.half_ranges
        at_limit = np.any((values <= limits.lower + slack) | (values >= limits.upper - slack), axis=0)
        names += [known[j] for j in np.flatnonzero(at_limit)]
    return " and ".join(names)
