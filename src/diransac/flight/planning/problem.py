"""Nonlinear program of a planning task, a first guess of its solution, and the trajectory of a solution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.errors import SettingsError
from diransac.flight.planning.request import Limits, Reference, Waypoint
from diransac.flight.planning.stage import Costs, stage_of
from diransac.flight.planning.transcription import Layout, Numbers, Program
from diransac.flight.trajectory import Trajectory

if TYPE_CHECKING:
    from diransac.model import Model


__all__ = [
    "InitialGuess",
    "Task",
    "fixed_program",
    "free_program",
    "guess_along",
    "straight_guess",
    "stretched_guess",
    "trajectory_of",
    "unknowns_of",
]

INTERVAL_STEPS = 10
"""Integration steps of a full interval, over which inputs are held."""

FREE_INTERVALS = 20
"""Intervals of a segment of free duration; even, so that an input may switch in the middle."""

_DIGITS = 9
"""Decimals of a time in s, within which equal moments computed in different ways agree."""


@dataclass(frozen=True)
class Task:
    """Planning task with checked values, in the model's order.

    Parameters
    ----------
    model, parameters : the plant; parameters (n_p,)
    waypoints : at least a start and an end
    reference, state_weights : reference signals, and the weight (n_x,) of each state's squared error, per s
    input_weights : (n_u,)   cost of an input's squared distance from trim, per s
    trim : (n_u,)   inputs of zero cost
    time_weight : cost of a second; 0 where times are given
    inputs, states : their limits
    dt : s   from row to row
    """

    model: Model
    parameters: FloatArray
    waypoints: tuple[Waypoint, ...]
    reference: Reference
    state_weights: FloatArray
    input_weights: FloatArray
    trim: FloatArray
    time_weight: float
    inputs: Limits
    states: Limits
    dt: float


@dataclass(frozen=True)
class InitialGuess:
    """Approximate trajectory from which a search starts.

    Parameters
    ----------
    time : (K,)   s from the start
    states : (K, n_x)   at these times
    inputs : (K, n_u)   held from each time on
    """

    time: FloatArray
    states: FloatArray
    inputs: FloatArray

    def at(self, time: FloatArray) -> tuple[FloatArray, FloatArray]:
        """States and inputs at other times."""
        states = np.column_stack([np.interp(time, self.time, column) for column in self.states.T])
        held = np.clip(np.searchsorted(self.time, time + 1e-9, side="right") - 1, 0, len(self.time) - 1)
        return states, self.inputs[held]


# Programs ------------------------------------------------------------------------------------------------------------
def fixed_program(task: Task, rows: tuple[int, ...]) -> Program:
    """Program of segments with these numbers of rows; each integration step leads from row to row."""
    intervals = tuple(-(-n // INTERVAL_STEPS) for n in rows)
    counts = np.concatenate([_spread(n, k) for n, k in zip(rows, intervals, strict=True)])
    steps = np.where(np.arange(INTERVAL_STEPS) < counts[:, None], task.dt, 0.0)
    lengths = task.dt * counts
    time = np.concatenate([[0.0], np.cumsum(lengths)])
    weights = np.outer(np.append(lengths, 0.0) + np.append(0.0, lengths), 0.5 * task.state_weights)
    return _program(task, intervals, steps, _reference(task, time), weights, free_time=False)


def free_program(task: Task) -> Program:
    """Program of segments of free duration."""
    intervals = (FREE_INTERVALS,) * (len(task.waypoints) - 1)
    shares = np.full((sum(intervals), INTERVAL_STEPS), 1.0 / (FREE_INTERVALS * INTERVAL_STEPS))
    nothing = np.zeros((len(shares) + 1, len(task.model.state)))
    return _program(task, intervals, shares, nothing, nothing, free_time=True)


def _program(
    task: Task,
    intervals: tuple[int, ...],
    steps: FloatArray,
    reference: FloatArray,
    weights: FloatArray,
    *,
    free_time: bool,
) -> Program:
    model = task.model
    pinned = tuple(waypoint.states for waypoint in task.waypoints)
    layout = Layout(len(model.state), model.n_u, intervals, pinned, free_time)
    costs = Costs(reference, weights, task.input_weights, task.trim, task.time_weight)
    lower, upper = (np.full(layout.n_unknowns, end) for end in (-np.inf, np.inf))
    lower[layout.inputs], upper[layout.inputs] = task.inputs.lower, task.inputs.upper
    knots = layout.states[:, : layout.n_x]
    lower[knots], upper[knots] = task.states.lower, task.states.upper
    lower[layout.states[:, layout.n_x :]] = task.dt
    lower[layout.next_durations] = task.dt
    values = np.concatenate([waypoint.values for waypoint in task.waypoints])
    return Program(stage_of(model, free_time), layout, Numbers(task.parameters, steps, values, costs, lower, upper))


def _spread(total: int, parts: int) -> IntArray:
    """Whole numbers with this sum that differ by 1 at most."""
    return np.diff(np.arange(parts + 1) * total // parts)


def _reference(task: Task, time: FloatArray) -> FloatArray:
    """Reference (n_knots, n_x); zero for states without one."""
    reference = np.zeros((len(time), len(task.model.state)))
    for name, values in task.reference.at(time).items():
        reference[:, task.model.state.index(name)] = values
    return reference


# Guesses -------------------------------------------------------------------------------------------------------------
def straight_guess(task: Task, durations: FloatArray) -> InitialGuess:
    """Guess of straight lines between waypoints, or along the reference, with trim inputs.

    Velocities are slopes of the coordinates where neither a waypoint nor the reference gives them.
    """
    at_waypoints = np.round(np.concatenate([[0.0], np.cumsum(durations)]), _DIGITS)
    rows = np.linspace(0.0, at_waypoints[-1], 1 + int(np.rint(at_waypoints[-1] / task.dt)))
    time = np.union1d(np.round(rows, _DIGITS), at_waypoints)
    fixed = [_fixed(task, at_waypoints, j) for j in range(len(task.model.state))]
    states = np.column_stack([np.interp(time, *known) if len(known[0]) else np.zeros(len(time)) for known in fixed])
    followed = {task.model.state.index(name): samples for name, samples in task.reference.at(time).items()}
    for j, samples in followed.items():
        states[:, j] = samples
    if task.model.kinematics is None:
        slopes = np.gradient(states[:, : task.model.n_q], time, axis=0)
        for j in set(range(task.model.n_q, 2 * task.model.n_q)) - set(followed):
            states[:, j] = slopes[:, j - task.model.n_q]
            states[np.searchsorted(time, fixed[j][0]), j] = fixed[j][1]
    for four in task.model.quaternions:
        lengths = np.linalg.norm(states[:, list(four)], axis=1, keepdims=True)
        states[:, list(four)] /= np.where(lengths > 0.0, lengths, 1.0)
    return InitialGuess(time, states, np.broadcast_to(task.trim, (len(time), len(task.trim))))


def guess_along(model: Model, guess: Trajectory) -> InitialGuess:
    """Guess along a trajectory of the same model.

    Raises SettingsError: the trajectory has other states or inputs.
    """
    if guess.state_names != model.state or guess.input_names != tuple(model.inputs):
        raise SettingsError(
            f"guess= is a trajectory of {', '.join((*guess.state_names, *guess.input_names))}, but model "
            f'"{model.name}" has {", ".join((*model.state, *model.inputs))}'
        )
    return InitialGuess(guess.time - guess.time[0], guess.states, guess.inputs)


def _fixed(task: Task, at_waypoints: FloatArray, j: int) -> tuple[FloatArray, FloatArray]:
    """Times and values at which waypoints fix a state."""
    there = [k for k, waypoint in enumerate(task.waypoints) if j in waypoint.states]
    values = [task.waypoints[k].values[task.waypoints[k].states.index(j)] for k in there]
    return at_waypoints[there], np.array(values)


def unknowns_of(program: Program, guess: InitialGuess, durations: FloatArray | None = None) -> FloatArray:
    """Unknowns along a guess, clipped to the limits; with free time also the durations of the segments."""
    layout, numbers = program.layout, program.numbers
    lengths = numbers.steps.sum(axis=1)
    unknowns = np.zeros(layout.n_unknowns)
    if layout.free_time:
        # First guess of a segment's duration, s.
        guessed = np.full(len(layout.intervals), 1.0) if durations is None else durations
        lengths = lengths * guessed[layout.segment_of]
        unknowns[layout.states[:, -1]] = np.append(guessed[layout.segment_of], guessed[-1])
        unknowns[layout.next_durations] = guessed[1:]
    states, inputs = guess.at(np.concatenate([[0.0], np.cumsum(lengths)]))
    unknowns[layout.states[:, : layout.n_x]] = states
    unknowns[layout.inputs] = inputs[:-1]
    return np.clip(unknowns, numbers.lower, numbers.upper)


def stretched_guess(program: Program, unknowns: FloatArray, durations: FloatArray) -> InitialGuess:
    """Guess from a solution, with its segments stretched to other durations."""
    layout = program.layout
    lengths = (durations / np.array(layout.intervals))[layout.segment_of]
    states, inputs = program.split(unknowns)
    time = np.concatenate([[0.0], np.cumsum(lengths)])
    return InitialGuess(time, states[:, : layout.n_x], np.concatenate([inputs, inputs[-1:]]))


# Solutions -----------------------------------------------------------------------------------------------------------
def trajectory_of(task: Task, program: Program, unknowns: FloatArray, start: float, limits: Limits) -> Trajectory:
    """Trajectory of a solution at fixed times, each interval integrated from its knot; the last input is repeated."""
    steps, layout = program.numbers.steps, program.layout
    states, inputs = program.split(unknowns)
    rows = np.concatenate([program.steps(unknowns)[steps > 0.0], states[-1:]])
    held = np.repeat(inputs, (steps > 0.0).sum(axis=1), axis=0)
    return Trajectory(
        start + task.dt * np.arange(len(rows), dtype=np.float64),
        rows[:, : layout.n_x],
        np.concatenate([held, inputs[-1:]]),
        task.model.state,
        tuple(task.model.inputs),
        limits.by_name(task.model.inputs),
        cost=program.objective(unknowns),
    )
