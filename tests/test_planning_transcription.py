"""The nonlinear program's derivatives against central differences, and where its unknowns stand."""

import numpy as np
import pytest

from diransac.flight.planning.stage import Costs, stage_of
from diransac.flight.planning.transcription import Layout, Numbers, Program
from planned import ROTORCRAFT
from rolling import BODY

CASES = {"fixed times": (ROTORCRAFT.model, False), "free times": (ROTORCRAFT.model, True), "quaternion": (BODY, False)}


def dense(entries, values, shape):
    """The matrix of sparse entries."""
    matrix = np.zeros(shape)
    np.add.at(matrix, entries, values)
    return matrix


@pytest.fixture(params=CASES.values(), ids=CASES)
def problem(request):
    """A small program with uneven intervals and every kind of cost, and a point that solves nothing."""
    model, free_time = request.param
    rng, n_x = np.random.default_rng(1), len(model.state)
    layout = Layout(n_x, model.n_u, (2, 1, 3), (tuple(range(n_x)), (0,), (1, 2), (0, 1)), free_time)
    steps = np.where(np.arange(4) < np.array([4, 3, 2, 4, 4, 1])[:, None], 0.05, 0.0)
    costs = Costs(
        rng.standard_normal((7, n_x)), rng.uniform(0, 2, (7, n_x)), rng.uniform(0.5, 2, model.n_u),
        rng.standard_normal(model.n_u), 0.7,
    )  # fmt: skip
    values = rng.standard_normal(len(layout.pins))
    unlimited = np.full(layout.n_unknowns, np.inf)
    numbers = Numbers(rng.uniform(0.5, 2.0, model.n_p), steps, values, costs, -unlimited, unlimited)
    unknowns = rng.uniform(0.5, 1.5, layout.n_unknowns)
    return Program(stage_of(model, free_time), layout, numbers), unknowns, rng


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
    shape = (program.layout.n_constraints, program.layout.n_unknowns)
    jacobian = dense(program.jacobian_entries, program.jacobian(at), shape)
    np.testing.assert_allclose(jacobian, differences(program.constraints, at), atol=1e-7)
    np.testing.assert_allclose(program.gradient(at), differences(program.objective, at), atol=1e-6)


def test_second_derivatives_are_those_of_the_first(problem):
    program, at, rng = problem
    n, factor = program.layout.n_unknowns, 0.6
    multipliers = rng.standard_normal(program.layout.n_constraints)

    def gradient(x):
        jacobian = dense(program.jacobian_entries, program.jacobian(x), (len(multipliers), n))
        return factor * program.gradient(x) + multipliers @ jacobian

    triangle = dense(program.hessian_entries, program.hessian(at, factor, multipliers), (n, n))
    np.testing.assert_array_equal(triangle, np.triu(triangle))
    np.testing.assert_allclose(triangle, np.triu(differences(gradient, at)), atol=1e-6)


def test_every_unknown_and_constraint_stands_in_one_place(problem):
    layout = problem[0].layout
    unknowns = np.concatenate([layout.states.ravel(), layout.inputs.ravel(), layout.next_durations])
    np.testing.assert_array_equal(np.sort(unknowns), np.arange(layout.n_unknowns))
    constraints = np.concatenate([layout.defects.ravel(), layout.pin_rows])
    np.testing.assert_array_equal(np.sort(constraints), np.arange(layout.n_constraints))


def test_nothing_reaches_beyond_the_next_stage(problem):
    """What makes the program's factorisation cheap: its matrices are banded by stages."""
    program = problem[0]
    rows, columns = program.hessian_entries
    stage_size = program.layout.n_s + program.layout.n_u + 1
    assert np.abs(rows - columns).max() < stage_size
    first_defect = program.layout.defects[:, 0]
    rows, columns = program.jacobian_entries
    stage = np.searchsorted(first_defect, rows, side="right") - 1
    assert np.abs(columns - program.layout.states[stage, 0]).max() < 2 * stage_size
