"""`plan`: from waypoints or a reference to a trajectory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import PlanningError, SettingsError
from diransac.flight.planning.diagnosis import why_not
from diransac.flight.planning.problem import (
    Path,
    Task,
    first_path,
    fixed_program,
    free_program,
    path_of,
    trajectory_of,
    unknowns_of,
)
from diransac.flight.planning.request import (
    Limits,
    Reference,
    Signal,
    Waypoint,
    limits_of,
    named_values,
    rows_of,
    waypoints_of,
    weights_of,
)
from diransac.flight.planning.solvers import TIME_LIMIT, Manner, Outcome, SearchLimits, interior_point
from diransac.flight.planning.trim import trim_of
from diransac.flight.trajectory import Trajectory

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from diransac.flight.planning.transcription import Program
    from diransac.model import Model
    from diransac.model.plant import ModelWithParameters


__all__ = ["SOLVERS", "TIME_STEP", "plan"]

TIME_STEP = 0.01
"""s, from row to row of a plan: flights are simulated and controlled at 100 Hz."""

SOLVERS = ("ipopt", "fatrop", "snopt")

_FIRST_ATTEMPTS = 0.4
"""Share of the iterations that an attempt gets which is not the last: most plans take a tenth of them."""

_MORE_ROWS = (0, 1, 2, 4, 8)
"""Rows that a free duration is lengthened by, one after the other, until the rounded plan can be flown on the grid."""


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
    solver: str = "ipopt",
    max_iterations: int = 200,
    time_limit: float = 30.0,
) -> Trajectory:
    """The cheapest trajectory through waypoints or along a reference, by direct transcription.

    What it costs: the integral of ``sum_i input_weight_i ((u_i - trim_i) / half_range_i)^2``, half the range of
    the input's limits (1 where it has none), plus ``sum_j state_weight_j (x_j - reference_j)^2``; where time is free,
    plus `time_weight` for every second: by default a second costs what an input does that is fully used for a second.

    Inputs are held over intervals of 0.1 s or a little less, each a whole number of rows. From row to row goes one
    Runge-Kutta step, as in a simulation: the rows of a plan are what a simulation gives. Waypoints and state limits
    hold at the ends of intervals.

    Parameters
    ----------
    plant : `Plant`, `Result` or anything else with a model and parameters
    waypoints : states by name, the first the start and the last the end; what they don't name is free between them
    times : s, of each waypoint, rounded to rows; None where the durations of the segments are to be found
    reference : state -> function of time (s from the start, an array), or samples evenly spread over the duration
    duration : s, of a plan along a reference without waypoints: it starts and ends on the reference
    input_limits, state_limits : name -> (lowest, highest), each input's or state's unit
    input_limit_fraction : share of the way from trim to each of an input's limits that the plan uses; feedback keeps
        the rest
    input_weights : input -> weight, per s; 1 by default
    state_weights : state -> weight of its squared distance from the reference, one over its unit squared and s;
        1 by default
    time_weight : per s, where time is free
    trim : input -> value that costs nothing, 0 where not named; by default what holds the plant at rest at the start
    start_end_at_rest : what the first and the last waypoint don't name is zero there; otherwise free
    guess : a trajectory of the same model to start the search from
    solver : ``ipopt``; ``fatrop``, which takes two thirds of the time, but now and then searches for ever, beyond the
        reach of time_limit and Ctrl-C, where parameters are far off; or ``snopt``, with ``pip install diransac[snopt]``
    max_iterations : of the last attempt; those before it, from the guess, or more carefully, get two fifths of them;
        five of SNOPT's count as one
    time_limit : s; to find out why there is no plan may take as long again

    Returns
    -------
    Trajectory at 100 Hz; its `input_limits` are the whole ones

    Raises SettingsError: arguments that make no sense, by name.
    Raises PlanningError: the plant cannot rest at the start; or there is no such trajectory, and it says why.

    References: Betts 2010, "Practical Methods for Optimal Control and Estimation", chapter 4; Dimmig et al. 2023, V-A.
    """
    if solver not in SOLVERS:
        raise SettingsError(f'solver "{solver}" is unknown; choose one of {", ".join(SOLVERS)}')
    model, limits = plant.model, limits_of("input", input_limits, tuple(plant.model.inputs))
    way = _way(model, waypoints, times, reference, duration, start_end_at_rest)
    _check_weights(state_weights, way, input_limit_fraction)
    _check_search(time_weight, max_iterations, time_limit)
    parameters = model.parameter_vector(plant.parameters)
    at_rest = _trim(model, parameters, way.waypoints[0], limits, trim)
    states = limits_of("state", state_limits, model.state)
    _check_within(model, way.waypoints, states)
    task = Task(
        model=model,
        parameters=parameters,
        waypoints=way.waypoints,
        reference=way.reference,
        state_weights=_state_weights(model, way.reference, state_weights),
        input_weights=weights_of("input_weights", "input", input_weights, tuple(model.inputs), np.ones(model.n_u))
        / limits.half_ranges**2,
        trim=at_rest,
        time_weight=float(time_weight) if way.rows is None else 0.0,
        inputs=limits.around(at_rest, input_limit_fraction),
        states=states,
        dt=TIME_STEP,
    )
    search = _Search(task, solver, SearchLimits(int(max_iterations), float(time_limit)), way.start, limits)
    path = None if guess is None else _path(model, guess)
    return search.free(path) if way.rows is None else search.fixed(way.rows, path)


# Arguments -----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class _Way:
    """Where to be when: waypoints, the rows between them (None: free), the time of the first, and what is followed."""

    waypoints: tuple[Waypoint, ...]
    rows: tuple[int, ...] | None
    start: float
    reference: Reference


def _way(
    model: Model,
    waypoints: Sequence[Mapping[str, float]] | None,
    times: Sequence[float] | None,
    reference: Mapping[str, Signal | ArrayLike] | None,
    duration: float | None,
    start_end_at_rest: bool,
) -> _Way:
    followed = Reference(dict(reference or {}))
    unknown = [name for name in followed.signals if name not in model.state]
    if unknown:
        raise SettingsError(f'reference: there is no state "{unknown[0]}"; there are {", ".join(model.state)}')
    if waypoints is None:
        if reference is None:
            raise SettingsError("a plan needs waypoints=, or reference= with duration=")
        if duration is None or times is not None or not np.isfinite(duration):
            raise SettingsError("a reference without waypoints needs duration=, in s, and no times=")
        rows = rows_of((0.0, duration), 2, TIME_STEP)
        ends = followed.at(np.array([0.0, rows[0] * TIME_STEP]))
        places = [{name: float(values[k]) for name, values in ends.items()} for k in (0, 1)]
        return _Way(waypoints_of(model, places, start_end_at_rest), rows, 0.0, followed)
    if duration is not None:
        raise SettingsError("waypoints have times=; duration= belongs to a reference without waypoints")
    if times is None and reference is not None:
        raise SettingsError("a reference is a function of time: waypoints that are to lie on it need times=")
    places_ = waypoints_of(model, waypoints, start_end_at_rest)
    if times is None:
        return _Way(places_, None, 0.0, followed)
    return _Way(places_, rows_of(times, len(places_), TIME_STEP), float(times[0]), followed)


def _check_weights(state_weights: Mapping[str, float] | None, way: _Way, input_limit_fraction: float) -> None:
    stray = [name for name in state_weights or {} if name not in way.reference.signals]
    if stray:
        raise SettingsError(f'state_weights: "{stray[0]}" has no reference; give one, or leave its weight out')
    if not 0.0 < input_limit_fraction <= 1.0:
        raise SettingsError(f"input_limit_fraction is {input_limit_fraction}; it must be above 0 and at most 1")


def _check_search(time_weight: float, max_iterations: int, time_limit: float) -> None:
    if not (np.isfinite(time_weight) and time_weight >= 0.0):
        raise SettingsError(f"time_weight is {time_weight}; it must be a finite number of at least 0")
    if not max_iterations >= 1 or not time_limit >= 0.0:
        raise SettingsError(
            f"max_iterations is {max_iterations} and time_limit {time_limit} s; give at least 1 iteration and 0 s"
        )


def _check_within(model: Model, waypoints: Sequence[Waypoint], limits: Limits) -> None:
    for k, waypoint in enumerate(waypoints):
        for j, value in zip(waypoint.states, waypoint.values, strict=True):
            if not limits.lower[j] <= value <= limits.upper[j]:
                raise SettingsError(
                    f"waypoint {k} wants {model.state[j]} = {value:g}, but its limits are {limits.lower[j]:g} to "
                    f"{limits.upper[j]:g}; move the waypoint or the limits"
                )


def _state_weights(model: Model, reference: Reference, weights: Mapping[str, float] | None) -> FloatArray:
    default = np.array([1.0 if name in reference.signals else 0.0 for name in model.state])
    return weights_of("state_weights", "state", weights, model.state, default)


def _trim(
    model: Model, parameters: FloatArray, start: Waypoint, limits: Limits, given: Mapping[str, float] | None
) -> FloatArray:
    if given is not None:
        values = named_values("trim", "input", given, tuple(model.inputs))
        return np.array([values.get(name, 0.0) for name in model.inputs])
    coordinates = np.zeros(model.n_q)
    for j, value in zip(start.states, start.values, strict=True):
        if j < model.n_q:
            coordinates[j] = value
    return trim_of(model, parameters, coordinates, limits.lower, limits.upper)


def _path(model: Model, guess: Trajectory) -> Path:
    if guess.state_names != model.state or guess.input_names != tuple(model.inputs):
        raise SettingsError(
            f"guess= is a trajectory of {', '.join((*guess.state_names, *guess.input_names))}, but model "
            f'"{model.name}" has {", ".join((*model.state, *model.inputs))}'
        )
    return Path(guess.time - guess.time[0], guess.states, guess.inputs)


# Search --------------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class _Search:
    """One task, and who is to solve it for how long."""

    task: Task
    solver: str
    search_limits: SearchLimits
    start: float
    limits: Limits

    def fixed(self, rows: tuple[int, ...], path: Path | None) -> Trajectory:
        """A plan whose segments last so many rows."""
        program = fixed_program(self.task, rows)
        outcome = self._solved(program, rows, path)
        if not outcome.success:
            raise PlanningError(why_not(self.task, rows, outcome, self.search_limits))
        return self._trajectory(program, outcome)

    def free(self, path: Path | None) -> Trajectory:
        """A plan whose segments last as long as is best: first any durations, then the next ones of whole rows."""
        task, program = self.task, free_program(self.task)
        n = len(program.layout.intervals)
        durations = None if path is None else np.full(n, path.time[-1] / n)
        straight = first_path(task, np.ones(n) if durations is None else durations)
        manner: Manner = "careful" if path is None else "near"
        outcome = self._search(program, unknowns_of(program, path or straight, durations), manner)
        if not outcome.success:
            raise PlanningError(
                f"no durations were found for which the plan works: {outcome.words}; "
                "give times=, which lets the error say what stands in the way"
            )
        found = program.split(outcome.unknowns)[0][program.layout.waypoint_knots[:-1], -1]
        shortest = np.maximum(np.ceil(found / task.dt - 1e-6), 1).astype(int)
        for more in _MORE_ROWS:
            rows = tuple(int(k) + more for k in shortest)
            whole = fixed_program(task, rows)
            along = path_of(program, outcome.unknowns, task.dt * np.array(rows))
            rounded = self._search(whole, unknowns_of(whole, along), "near")
            if rounded.success:
                return self._trajectory(whole, rounded)
        raise PlanningError(why_not(task, rows, rounded, self.search_limits))

    def _solved(self, program: Program, rows: tuple[int, ...], path: Path | None) -> Outcome:
        """From the guess, if there is one, then from the straight way, at last with bolder steps.

        Parameters that are far off, such as an inertia a fiftieth of the true one, make the constraints so curved that
        a search along each step creeps; whole steps get there.
        """
        straight = unknowns_of(program, first_path(self.task, self.task.dt * np.array(rows)))
        attempts: list[tuple[FloatArray, Manner]] = [] if path is None else [(unknowns_of(program, path), "near")]
        attempts.append((straight, "careful"))
        if self.solver == "ipopt":
            attempts.append((straight, "bold"))
        whole = self.search_limits
        short = replace(whole, iterations=max(1, round(_FIRST_ATTEMPTS * whole.iterations)))
        for k, (unknowns, manner) in enumerate(attempts, start=1):
            outcome = self._search(program, unknowns, manner, whole if k == len(attempts) else short)
            if outcome.success or outcome.status == TIME_LIMIT:
                break
        return outcome

    def _search(
        self, program: Program, unknowns: FloatArray, manner: Manner, limits: SearchLimits | None = None
    ) -> Outcome:
        """Solve by the solver that was chosen."""
        limits = limits or self.search_limits
        if self.solver == "snopt":
            from diransac.flight.planning.snopt import active_set

            return active_set(program, unknowns, limits)
        return interior_point(self.solver, program, unknowns, limits, manner)

    def _trajectory(self, program: Program, outcome: Outcome) -> Trajectory:
        kept = np.clip(outcome.unknowns, program.numbers.lower, program.numbers.upper)
        return trajectory_of(self.task, program, kept, self.start, self.limits, outcome.solver)
