"""Solution of a `Program` by SNOPT, the solver of the paper, through Drake: ``pip install diransac[snopt]``.

Drake evaluates constraints in bindings, each with dense derivatives. Each segment of a plan is one binding, a small
program of the same stage.

References: Gill, Murray, Saunders 2005, "SNOPT: An SQP algorithm for large-scale constrained optimization".
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.errors import PlanningError
from diransac.flight.planning.solvers import SearchLimits, Solution
from diransac.flight.planning.transcription import Layout, Program

if TYPE_CHECKING:
    from collections.abc import Callable


__all__ = ["active_set"]

_TOLERANCE = 1e-8

_MAJOR = 5
"""Major iterations of SNOPT per requested iteration: active-set methods need more of them than barrier methods."""


def active_set(program: Program, guess: FloatArray, limits: SearchLimits) -> Solution:
    """Solution by SNOPT.

    Raises PlanningError: Drake is not installed.
    """
    try:
        from pydrake.solvers import MathematicalProgram, SnoptSolver, SolverOptions
    except ImportError as error:
        raise PlanningError(
            "SNOPT comes with the package drake, which is not installed; pip install 'diransac[snopt]', or choose "
            'solver="ipopt"'
        ) from error
    stopped: list[BaseException] = []
    drake, options = MathematicalProgram(), SolverOptions()
    unknowns = _bind(drake, program, stopped)
    for name, value in _options(program, limits).items():
        options.SetOption(SnoptSolver.id(), name, value)
    try:
        found = SnoptSolver().Solve(drake, guess, options)
    except RuntimeError as error:  # Drake wraps whatever a binding raises, interrupts included
        raise (stopped or [error])[0] from None
    solution = np.array(found.GetSolution(unknowns), np.float64)
    success = found.is_success() and bool(np.isfinite(solution).all())
    return Solution(solution, success, f"exit {found.get_solver_details().info}", None, "snopt")


def _options(program: Program, limits: SearchLimits) -> dict[str, float | int]:
    """Options by SNOPT's names; far from the active set it takes many minor iterations."""
    return {
        "Major optimality tolerance": _TOLERANCE,
        "Major feasibility tolerance": _TOLERANCE,
        "Major iterations limit": _MAJOR * limits.iterations,
        "Iterations limit": 100 * limits.iterations * program.layout.n_stages,
        "Time limit": limits.left,
    }


def _bind(drake: Any, program: Program, stopped: list[BaseException]) -> Any:
    """Unknowns as Drake variables; segments and limits are bound to them."""
    unknowns = drake.NewContinuousVariables(program.layout.n_unknowns)
    drake.AddBoundingBoxConstraint(*_limits(program), unknowns)
    for part, chosen in _segments(program):
        drake.AddCost(partial(_value, stopped, part.objective, part.gradient), unknowns[chosen])
        slack = np.zeros(part.layout.n_constraints)
        slack[part.layout.n_constraints - part.layout.free_time :] = np.inf  # the next segment has its own duration
        constraints = partial(_value, stopped, part.constraints, partial(_dense, part))
        bound = drake.AddConstraint(constraints, -slack, slack, unknowns[chosen])
        entries = zip(*(indices.tolist() for indices in part.jacobian_entries), strict=True)
        bound.evaluator().SetGradientSparsityPattern(list(entries))
    _join_durations(drake, unknowns, program.layout)
    return unknowns


def _limits(program: Program) -> tuple[FloatArray, FloatArray]:
    """Limits of the unknowns, equal where a waypoint fixes a value."""
    lower, upper = program.numbers.lower.copy(), program.numbers.upper.copy()
    fixed = program.layout.pinned_unknowns
    lower[fixed] = upper[fixed] = program.numbers.pin_values
    return lower, upper


def _segments(program: Program) -> list[tuple[Program, IntArray]]:
    """Each segment as a program without waypoints, and the indices of its unknowns."""
    layout, numbers = program.layout, program.numbers
    parts = []
    for first, after in zip(layout.waypoint_knots[:-1], layout.waypoint_knots[1:], strict=True):
        alone = Layout(layout.n_x, layout.n_u, (int(after - first),), ((), ()), layout.free_time)
        knots = slice(first, after + 1)
        weights = numbers.costs.weights[knots].copy()
        if after < layout.n_stages:
            weights[-1] = 0.0  # the next segment counts this knot
        costs = replace(numbers.costs, reference=numbers.costs.reference[knots], weights=weights)
        own = replace(numbers, steps=numbers.steps[first:after], pin_values=np.zeros(0), costs=costs)
        stages = np.hstack([layout.states[first:after], layout.inputs[first:after]]).ravel()
        parts.append((Program(program.stage, alone, own), np.concatenate([stages, layout.states[after]])))
    return parts


def _join_durations(drake: Any, unknowns: Any, layout: Layout) -> None:
    """Constrain the input that sets the next segment's duration to that duration."""
    following = layout.states[1:][layout.ends_segment, -1]
    for chooser, duration in zip(layout.next_durations, following, strict=True):
        drake.AddLinearEqualityConstraint(unknowns[chooser] == unknowns[duration])


def _dense(part: Program, unknowns: FloatArray) -> FloatArray:
    """Dense Jacobian (n_constraints, n_unknowns)."""
    whole = np.zeros((part.layout.n_constraints, part.layout.n_unknowns))
    whole[part.jacobian_entries] = part.jacobian(unknowns)
    return whole


def _value(
    stopped: list[BaseException],
    value: Callable[[FloatArray], Any],
    derivative: Callable[[FloatArray], FloatArray],
    unknowns: Any,
) -> Any:
    """Value for Drake, with derivatives for unknowns of type AutoDiffXd; an exception is also kept in `stopped`."""
    from pydrake.autodiffutils import AutoDiffXd, ExtractValue, InitializeAutoDiff

    try:
        if unknowns.dtype != object:
            return value(unknowns)
        at = ExtractValue(unknowns).ravel()
        if np.ndim(found := value(at)) == 0:
            return AutoDiffXd(found, derivative(at))
        return InitializeAutoDiff(found, derivative(at)).ravel()
    except BaseException as error:  # an interrupt too: Drake may hide what is raised in it
        stopped.append(error)
        raise
