"""Trajectory optimisation: `plan`, the search for a solution, and the explanation where there is none."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.preprocessing.continuity import unit_quaternions
from diransac.errors import PlanningError, SettingsError
from diransac.flight.planning.solver import TIME_LIMIT, Solution, Start, interior_point
from diransac.flight.planning.task import TIME_STEP, Reference, Task, sampled, task_of
from diransac.flight.planning.transcription import Guess, Program
from diransac.flight.trajectory import InputLimits, Trajectory, half_ranges

if TYPE_CHECKING:
    from diransac.model import Model
    from diransac.model.plant import ModelWithParameters


def plan(
    plant: ModelWithParameters,
    *,
    waypoints: Sequence[Mapping[str, float]] | None = None,
    times: Sequence[float] | None = None,
    reference: Reference | None = None,
    duration: float | None = None,
    input_limits: InputLimits | None = None,
    input_limit_fraction: float = 1.0,
    state_limits: InputLimits | None = None,
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
    task = task_of(
        plant,
        waypoints=waypoints,
        times=times,
        reference=reference,
        duration=duration,
        input_limits=input_limits,
        input_limit_fraction=input_limit_fraction,
        state_limits=state_limits,
        input_weights=input_weights,
        state_weights=state_weights,
        time_weight=time_weight,
        trim=trim,
        start_end_at_rest=start_end_at_rest,
    )
    if not max_iterations >= 1 or not time_limit >= 0.0:
        raise SettingsError(
            f"max_iterations is {max_iterations} and time_limit {time_limit} s; give at least 1 iteration and 0 s"
        )
    search = _Search(task, int(max_iterations), float(time_limit), time.monotonic() + time_limit)
    initial = None if guess is None else _along(plant.model, guess)
    return search.free(initial) if task.rows is None else search.fixed(task.rows, initial)


# Search --------------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class _Search:
    """Search for the solution of one task, by one attempt after the other until a deadline."""

    task: Task
    max_iterations: int
    time_limit: float
    deadline: float

    def fixed(self, rows: tuple[int, ...], guess: Guess | None) -> Trajectory:
        """Plan whose segments have these numbers of rows: from a guess, else straight lines, else where these led."""
        program = Program(self.task, rows)
        straight = program.unknowns_of(_straight(self.task, TIME_STEP * np.array(rows)))
        attempts: list[tuple[FloatArray, Start]] = [(straight, "cold")]
        if guess is not None:
            attempts.insert(0, (program.unknowns_of(guess), "warm"))
        # Fraction of the iterations for every attempt but the last: most plans take a tenth of them.
        iterations = max(1, round(0.4 * self.max_iterations))
        for unknowns, start in attempts:
            solution = interior_point(program, unknowns, iterations, self.deadline, start)
            if solution.success or solution.summary == TIME_LIMIT:
                break
        else:
            begin = solution.unknowns if np.isfinite(solution.unknowns).all() else straight
            solution = interior_point(program, begin, self.max_iterations, self.deadline)
        if solution.success:
            return program.trajectory(solution.unknowns)
        raise PlanningError(_explanation(self.task, rows, solution, self.time_limit))

    def free(self, guess: Guess | None) -> Trajectory:
        """Plan of optimal durations, rounded up to whole rows for which there is a plan, too."""
        program = Program(self.task, None)
        n = len(program.intervals)
        durations = np.full(n, 1.0 if guess is None else guess[0][-1] / n)
        unknowns = program.unknowns_of(guess or _straight(self.task, durations), durations)
        start: Start = "cold" if guess is None else "warm"
        solution = interior_point(program, unknowns, self.max_iterations, self.deadline, start)
        if not solution.success:
            raise PlanningError(
                f"no durations were found for which the plan works: {solution.summary}; "
                "give times=, for which the message names the binding limits"
            )
        optimal = solution.unknowns[program.durations]
        shortest = np.maximum(np.ceil(optimal / TIME_STEP - 1e-6), 1).astype(int)
        # Rows added to optimal durations in turn until there is a plan on the grid of the inputs.
        for more in (0, 1, 2, 4, 8):
            rows = tuple(int(k) + more for k in shortest)
            whole = Program(self.task, rows)
            along = whole.unknowns_of(program.stretched(solution.unknowns, TIME_STEP * np.array(rows)))
            rounded = interior_point(whole, along, self.max_iterations, self.deadline, "warm")
            if rounded.success:
                return whole.trajectory(rounded.unknowns)
        raise PlanningError(_explanation(self.task, rows, rounded, self.time_limit))


# Guesses -------------------------------------------------------------------------------------------------------------
def _along(model: Model, guess: Trajectory) -> Guess:
    """Guess along a trajectory.  Raises SettingsError: it has other states or inputs than the model."""
    if guess.state_names != model.state or guess.input_names != tuple(model.inputs):
        raise SettingsError(
            f"guess= is a trajectory of {', '.join((*guess.state_names, *guess.input_names))}, but model "
            f'"{model.name}" has {", ".join((*model.state, *model.inputs))}'
        )
    return guess.time - guess.time[0], guess.states, guess.inputs


def _straight(task: Task, durations: FloatArray) -> Guess:
    """Straight lines between waypoints, or along the reference, with trim inputs.

    Velocities are slopes of the coordinates where neither a waypoint nor the reference gives them.
    """
    model, n_q = task.model, task.model.n_q
    decimals = 9  # of a time in s, within which equal moments computed in different ways agree
    at_waypoints = np.round(np.concatenate([[0.0], np.cumsum(durations)]), decimals)
    rows = np.linspace(0.0, at_waypoints[-1], 1 + int(np.rint(at_waypoints[-1] / TIME_STEP)))
    time = np.union1d(np.round(rows, decimals), at_waypoints)
    states, followed = np.zeros((len(time), len(model.state))), sampled(task.reference, time)
    fixed = np.full((len(at_waypoints), len(model.state)), np.nan)
    for known, waypoint in zip(fixed, task.waypoints, strict=True):
        known[list(waypoint.states)] = waypoint.values
    for j, name in enumerate(model.state):
        known = np.isfinite(fixed[:, j])
        if name in followed:
            states[:, j] = followed[name]
        elif model.kinematics is None and n_q <= j < 2 * n_q:
            states[:, j] = np.gradient(states[:, j - n_q], time)
            states[np.searchsorted(time, at_waypoints[known]), j] = fixed[known, j]
        elif known.any():
            states[:, j] = np.interp(time, at_waypoints[known], fixed[known, j])
    for four in model.quaternions:
        states[:, list(four)] = unit_quaternions(states[:, list(four)])
    return time, states, np.broadcast_to(task.trim, (len(time), len(task.trim)))


# Infeasible plans ----------------------------------------------------------------------------------------------------
def _explanation(task: Task, rows: tuple[int, ...], solution: Solution, time_limit: float) -> str:
    """Sentence on the waypoint that is missed by most, the limits that bind, and what to relax.

    It describes the plan nearest to a feasible one: the start and all limits hold, and the squared distances from the
    later waypoints are least.
    """
    if solution.summary == TIME_LIMIT:
        return f"no plan was found within {time_limit:g} s; raise time_limit=, or give a guess="
    program = Program(task, rows, relaxed=True)
    guess = program.unknowns_of(_straight(task, TIME_STEP * np.array(rows)))
    nearest = interior_point(program, guess, 500, time.monotonic() + time_limit)
    if not nearest.success:
        return (
            f"there is no plan: {solution.summary}, and none was found that may miss its waypoints; "
            "check the parameters, or give more time"
        )
    states, inputs = (nearest.unknowns[places] for places in (program.states, program.inputs))
    missed, binding = _largest_miss(task, program, states), _binding(task, states, inputs)
    if missed is None:
        remedy = f"relax {binding}" if binding else "give guess= or more max_iterations="
        return (
            f"no plan was found, though one comes near every waypoint: {solution.summary}; "
            f"give slightly more time, or {remedy}"
        )
    remedy = f"raise the limits of {binding}" if binding else "ask for something that the inputs can reach"
    return f"the plan cannot be flown: {missed}; give it more time, or {remedy}"


def _largest_miss(task: Task, program: Program, states: FloatArray) -> str | None:
    """Waypoint state that is missed by most; None where every waypoint is reached."""
    ends = np.concatenate([[0.0], np.cumsum(program.steps.sum(axis=1))])
    # Distance within which a waypoint counts as reached, state's unit: the penalty is finite.
    worst, text = 1e-2, None
    for k, (knot, waypoint) in enumerate(zip(program.knots, task.waypoints, strict=True)):
        misses = np.abs(states[knot, list(waypoint.states)] - waypoint.values)
        if len(misses) and misses.max() > worst:
            worst, name = misses.max(), task.model.state[waypoint.states[int(misses.argmax())]]
            text = (
                f"waypoint {k} ({waypoint.text(task.model.state)}) at t = {ends[knot]:.2f} s is missed by {worst:.2g} "
                f"{task.model.units[name]} in {name}"
            )
    return text


def _binding(task: Task, states: FloatArray, inputs: FloatArray) -> str:
    """Names of the inputs and states that reach a limit."""
    names = []
    for values, limits, known in (
        (inputs, task.inputs, tuple(task.model.inputs)),
        (states[1:], task.states, task.model.state),
    ):
        # Fraction of a range, or of a unit, within which a value is at its limit.
        slack = 1e-3 * half_ranges(limits.lower, limits.upper)
        at_limit = np.any((values <= limits.lower + slack) | (values >= limits.upper - slack), axis=0)
        names += [known[j] for j in np.flatnonzero(at_limit)]
    return " and ".join(names)
