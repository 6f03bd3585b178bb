"""The nonlinear program's derivatives against central differences, and where its unknowns stand."""

from dataclasses import replace

import numpy as np
import pytest

import diransac as dr
from diransac.flight.planning.task import task_of
from diransac.flight.planning.transcription import Program
from planned import ROTORCRAFT
from rolling import BODY

QUATERNION = dr.Plant(BODY, {"p0": 1.0, "p1": 1.5, "p2": 2.0})
CASES = {"fixed times": (ROTORCRAFT, False), "free times": (ROTORCRAFT, True), "quaternion": (QUATERNION, False)}


def dense(entries, values, shape):
    """The matrix of sparse entries."""
    matrix = np.zeros(shape)
    np.add.at(matrix, entries, values)
    return matrix


@pytest.fixture(params=CASES.values(), ids=CASES)
def problem(request):
    """A small program with uneven intervals and every kind of cost, and a point that solves nothing."""
    plant, free_time = request.param
    rng, model = np.random.default_rng(1), plant.model
    first = dict.fromkeys(model.state, 0.0) | {model.state[four[0]]: 1.0 for four in model.quaternions}
    waypoints = [first, {model.state[0]: 1.0}, {model.state[-1]: 2.0}]
    reference = {name: rng.standard_normal(9) for name in model.state[:2]}
    task = task_of(
        plant, waypoints=waypoints, times=None if free_time else [0.0, 0.14, 0.37], duration=None,
        reference=None if free_time else reference, input_limits=None, input_limit_fraction=1.0, state_limits=None,
        input_weights=dict(zip(model.inputs, rng.uniform(0.5, 2, model.n_u), strict=True)), state_weights=None,
        time_weight=0.7, trim=dict(zip(model.inputs, rng.standard_normal(model.n_u), strict=True)),
        start_end_at_rest=False,
    )  # fmt: skip
    program = Program(replace(task, parameters=rng.uniform(0.5, 2.0, model.n_p)), task.rows)
    return program, rng.uniform(0.5, 1.5, program.n_unknowns), rng


def differences(function, at, step=1e-6):
    """Derivatives by central differences, a column an unknown."""
    columns = []
    for k in range(len(at)):
        move = np.zeros_like(at)
        move[k] = step
        columns.append((np.asarray(function(at + move)) - np.asarray(function(at - move))) / (2 * step))
    return np.stack(columns, axis=-1)


def test_first_derivatives_are_those_of_the_values(problem):
    program, at, _ = problem
    jacobian = dense(program.jacobian_entries, program.jacobian(at), (program.n_constraints, program.n_unknowns))
    np.testing.assert_allclose(jacobian, differences(program.constraints, at), atol=1e-7)
    np.testing.assert_allclose(program.gradient(at), differences(program.objective, at), atol=1e-6)


def test_second_derivatives_are_those_of_the_first(problem):
    program, at, rng = problem
    n, factor = program.n_unknowns, 0.6
    multipliers = rng.standard_normal(program.n_constraints)

    def gradient(x):
        jacobian = dense(program.jacobian_entries, program.jacobian(x), (len(multipliers), n))
        return factor * program.gradient(x) + multipliers @ jacobian

    triangle = dense(program.hessian_entries, program.hessian(at, factor, multipliers), (n, n))
    np.testing.assert_array_equal(triangle, np.triu(triangle))
    np.testing.assert_allclose(triangle, np.triu(differences(gradient, at)), atol=1e-6)


def test_every_unknown_stands_in_one_place(problem):
    program = problem[0]
    unknowns = np.concatenate([program.states.ravel(), program.inputs.ravel(), program.durations])
    np.testing.assert_array_equal(np.sort(unknowns), np.arange(program.n_unknowns))


def test_states_of_waypoints_are_fixed_and_no_others(problem):
    program = problem[0]
    fixed = np.flatnonzero(program.lower == program.upper)
    knots, waypoints = program.knots, program.task.waypoints
    expected = [program.states[k, list(waypoint.states)] for k, waypoint in zip(knots, waypoints, strict=True)]
    np.testing.assert_array_equal(fixed, np.sort(np.concatenate(expected)))
