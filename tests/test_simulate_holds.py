"""Rollouts under inputs that are interpolated between rows, against slow, independent integrators."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from diransac.errors import SettingsError
from diransac.model import Model, Parameter
from diransac.simulation import LinearFeedback, RolloutBatch, rollouts
from rolling import (
    BODY,
    INTEGRATORS,
    ON_EVERY_TARGET,
    PENDULUM,
    ROTORCRAFT,
    assert_same,
    batch_of,
    log_of,
    measurements_of,
    normalised,
    score_of,
    signals_at,
)

EVERY_MODEL = pytest.mark.parametrize("model", [ROTORCRAFT, PENDULUM, BODY], ids=lambda model: model.name)
EVERY_INTEGRATOR = pytest.mark.parametrize("integrator", INTEGRATORS)


EVERY_HOLD = pytest.mark.parametrize("hold", ["linear", "smooth"])


def interpolated(task, t, hold="linear"):
    """Inputs at a time; after the last row, those of the last row."""
    times = task.dt * np.arange(len(task.inputs))
    if hold == "linear" or t >= times[-1]:
        return np.array([np.interp(t, times, column) for column in task.inputs.T])
    row = min(int(t / task.dt + 1e-9), len(times) - 2)
    firsts = [first for first in (row - 1, row) if 0 <= first <= len(times) - 3]
    parabolas = [lagrange(task.inputs[k : k + 3], t / task.dt - k) for k in firsts]
    return np.mean(parabolas, axis=0)


def lagrange(points, s):
    """The parabola through three points at 0, 1 and 2."""
    return (s - 1) * (s - 2) / 2 * points[0] - s * (s - 2) * points[1] + s * (s - 1) / 2 * points[2]


def plain_trajectory(model, task, p, integrator, substeps, hold):
    """Signals row by row, each stage of each step with the inputs at its own time."""

    def slope(x, t):
        return np.array(model.dynamics(x, interpolated(task, t, hold), p)[0]).ravel()

    n_q, h, x, rows = model.n_q, task.dt / substeps, task.states, []
    for row, u in enumerate(task.inputs):
        rows.append(signals_at(model, p, x, u))
        for t in task.dt * row + h * np.arange(substeps):
            k = slope(x, t)
            if integrator == "euler":
                x = x + h * k
            elif integrator == "semi-implicit-euler":
                v = x[n_q:] + h * k[n_q:]
                x = np.concatenate([x[:n_q] + h * slope(np.concatenate([x[:n_q], v]), t + h)[:n_q], v])
            else:
                k2 = slope(x + h / 2 * k, t + h / 2)
                k3 = slope(x + h / 2 * k2, t + h / 2)
                x = x + h / 6 * (k + 2 * k2 + 2 * k3 + slope(x + h * k3, t + h))
            x = normalised(model, x)
    return np.array(rows)


@EVERY_HOLD
@pytest.mark.parametrize("substeps", [1, 4])
@EVERY_INTEGRATOR
@EVERY_MODEL
def test_trajectories_agree_with_a_plain_loop(model, integrator, substeps, hold):
    task = log_of(model, 40)
    engine = rollouts(model, integrator=integrator, substeps=substeps, hold=hold)
    found = engine.trajectories(batch_of(task, task.parameters[:2]))
    for p, signals in zip(task.parameters, found, strict=False):
        expected = plain_trajectory(model, task, p, integrator, substeps, hold)
        np.testing.assert_allclose(signals, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("substeps", [5, 20])
@EVERY_MODEL
def test_steps_agree_with_scipy_under_interpolated_inputs(model, substeps):
    task = log_of(model, 30)
    task.inputs += 3.0  # the rotorcraft's |thrust| has no kink then
    p, x, n_x = task.parameters[0], task.states, len(task.states)
    (found,) = rollouts(model, substeps=substeps, hold="linear").trajectories(batch_of(task, p[None]))

    def slope(t, state):
        return np.array(model.dynamics(state, interpolated(task, t), p)[0]).ravel()

    for row in range(len(task.inputs)):  # a kink of the inputs at each row
        np.testing.assert_allclose(found[row, :n_x], x, rtol=0, atol=1e-8)
        span = task.dt * np.array([row, row + 1])
        x = solve_ivp(slope, span, x, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]


def test_continuous_inputs_are_followed_to_the_order_of_each_hold():
    p, errors = np.array([[1.5, 0.4]]), {}
    exact = solve_ivp(
        lambda t, x: np.array(PENDULUM.dynamics(x, [np.sin(3 * t)], p[0])[0]).ravel(), (0, 2), [0.3, 0.0],
        "DOP853", rtol=1e-12, atol=1e-13,
    ).y[:, -1]  # fmt: skip
    for hold in ("zero-order", "linear", "smooth"):
        for n in (40, 80):
            inputs = np.sin(3 * np.linspace(0, 2, n + 1))[:, None]
            batch = RolloutBatch(p, [0.3, 0.0], inputs, 2 / n)
            (end,) = rollouts(PENDULUM, substeps=4, hold=hold).trajectories(batch)[:, -1, :2]
            errors[hold, n] = np.linalg.norm(end - exact)
    assert errors["zero-order", 40] / errors["zero-order", 80] == pytest.approx(2, rel=0.1)
    assert errors["linear", 40] / errors["linear", 80] == pytest.approx(4, rel=0.1)
    assert errors["smooth", 40] / errors["smooth", 80] > 8 * 0.9
    assert errors["smooth", 40] < 0.03 * errors["linear", 40]


@pytest.mark.parametrize("substeps", [1, 3])
def test_constant_inputs_are_the_same_under_every_hold(substeps):
    task = log_of(BODY, 30)
    task.inputs[:] = task.inputs[0]
    held, *others = [
        rollouts(BODY, substeps=substeps, hold=hold).trajectories(batch_of(task))
        for hold in ("zero-order", "linear", "smooth")
    ]
    for one in others:
        np.testing.assert_allclose(held, one, rtol=1e-13, atol=1e-13)


# The last row, and windows -------------------------------------------------------------------------------------------
def final_states(engine, task, **rows):
    weights = np.ones(len(engine.signals))
    return engine.gauss_newton(batch_of(task, **rows), measurements_of(engine, task), weights).final_states


def test_smooth_inputs_of_a_log_do_not_depend_on_those_of_its_neighbours():
    first, second = log_of(ROTORCRAFT, 20), log_of(ROTORCRAFT, 30, seed=1)
    engine, p, inputs = rollouts(ROTORCRAFT, substeps=2, hold="smooth"), first.parameters[:1], first.inputs
    together = np.vstack([inputs, second.inputs])
    for rows in (slice(0, 20), slice(20, 50)):
        lane = {"start_rows": np.array([rows.start]), "n_rows": rows.stop - rows.start}
        among = RolloutBatch(p, first.states, together, 0.01, **lane, first_rows=np.array([0, 20]))
        alone = RolloutBatch(p, first.states, together[rows], 0.01)
        np.testing.assert_array_equal(engine.trajectories(among), engine.trajectories(alone))
        outside = RolloutBatch(p, first.states, together[rows], 0.01, first_rows=np.array([-7, 0, 90]))
        np.testing.assert_array_equal(engine.trajectories(outside), engine.trajectories(alone))


@pytest.mark.parametrize("substeps", [1, 3])
def test_the_last_row_of_the_log_is_held(substeps):
    task, engine = log_of(ROTORCRAFT, 20), rollouts(ROTORCRAFT, substeps=substeps, hold="linear")
    held = log_of(ROTORCRAFT, 20)
    held.inputs = np.vstack([task.inputs, task.inputs[-1:]])
    held.measured, held.valid = np.zeros((21, 9)), np.ones(21, bool)
    expected = engine.trajectories(batch_of(held))[:, -1, :6]
    np.testing.assert_array_equal(final_states(engine, task), expected)


@pytest.mark.parametrize("starts", [np.arange(21) * 2, np.full(21, 7)], ids=["own rows", "shared rows"])
@pytest.mark.parametrize("substeps", [1, 3])
def test_a_window_ends_towards_the_inputs_of_the_row_after_it(substeps, starts):
    task, engine = log_of(BODY, 61), rollouts(BODY, substeps=substeps, hold="linear")
    window = {"start_rows": starts, "n_rows": 20}
    path, longer = (engine.trajectories(batch_of(task, start_rows=starts, n_rows=n_rows)) for n_rows in (20, 21))
    np.testing.assert_array_equal(path, longer[:, :20])
    np.testing.assert_array_equal(final_states(engine, task, **window), longer[:, -1, :7])
    for lane in (0, 8, 20):
        rows = slice(starts[lane], starts[lane] + 20)
        alone = RolloutBatch(task.parameters[lane : lane + 1], task.states, task.inputs[rows], task.dt)
        np.testing.assert_array_equal(path[lane], engine.trajectories(alone)[0])


# Outputs -------------------------------------------------------------------------------------------------------------
@ON_EVERY_TARGET
def test_scores_errors_and_sums_are_of_one_simulation(target):
    task = log_of(BODY, 50)
    task.valid[:] = True
    engine = rollouts(BODY, substeps=2, hold="linear", target=target)
    window = {"start_rows": np.arange(21), "n_rows": 25}
    errors = engine.errors(batch_of(task, **window), measurements_of(engine, task))
    scores = score_of(engine, task, **window)
    np.testing.assert_allclose(scores.sum_squares, np.square(errors).sum(axis=1), rtol=1e-12)
    linear = engine.linearized_errors(batch_of(task, **window), measurements_of(engine, task))
    np.testing.assert_allclose(linear.errors, errors, rtol=1e-12, atol=1e-12)
    weights = np.linspace(0.5, 2.0, len(engine.signals))
    sums = engine.gauss_newton(batch_of(task, **window), measurements_of(engine, task), weights)
    np.testing.assert_allclose(sums.cost, np.square(errors).sum(axis=1) @ weights, rtol=1e-11)
    gradient = np.einsum("lrsz,s,lrs->lz", linear.jacobian, weights, errors)
    np.testing.assert_allclose(sums.gradient, gradient, rtol=1e-9, atol=1e-9)
    assert_same(score_of(engine, task, threads=2, **window), scores)


@EVERY_HOLD
@EVERY_INTEGRATOR
@EVERY_MODEL
def test_the_jacobian_is_that_of_central_differences(model, integrator, hold):
    task = log_of(model, 25)
    task.measured[:] = 0.0  # so that no quaternion changes its sign
    engine = rollouts(model, integrator=integrator, substeps=3, hold=hold)
    p, n_p = task.parameters[0], model.n_p
    found = engine.linearized_errors(batch_of(task, p[None]), measurements_of(engine, task)).jacobian[0]
    z = np.concatenate([p, task.states])
    steps = 1e-6 * np.maximum(1.0, np.abs(z)) * np.eye(len(z))
    lanes = np.concatenate([z + steps, z - steps])
    up, down = np.split(engine.trajectories(RolloutBatch(lanes[:, :n_p], lanes[:, n_p:], task.inputs, task.dt)), 2)
    expected = np.moveaxis((up - down) / (2 * np.diag(steps))[:, None, None], 0, -1)
    scale = np.abs(expected).max(axis=(0, 1)).clip(1.0)
    np.testing.assert_allclose(found / scale, expected / scale, rtol=0, atol=1e-6)


# Interface -----------------------------------------------------------------------------------------------------------
def test_a_model_without_inputs_has_nothing_to_interpolate():
    swing = Model(
        "swing", {"angle": "rad"}, {}, {"k": Parameter("1/s^2")}, lambda q, v, a, u, p: [a.angle + p.k * q.angle]
    )
    batch = RolloutBatch([[2.0]], [0.5, 0.0], np.zeros((30, 0)), 0.05)
    held, *others = [
        rollouts(swing, substeps=2, hold=x).trajectories(batch) for x in ("zero-order", "linear", "smooth")
    ]
    for one in others:
        np.testing.assert_array_equal(held, one)


def test_equal_holds_are_one_simulator_and_others_another():
    assert rollouts(PENDULUM) is rollouts(PENDULUM, hold="zero-order")
    assert rollouts(PENDULUM, hold="linear") is rollouts(PENDULUM, hold="linear") is not rollouts(PENDULUM)


def test_an_unknown_hold_is_refused_by_name():
    with pytest.raises(SettingsError, match="hold 'cubic' is unknown; choose one of zero-order, linear, smooth"):
        rollouts(PENDULUM, hold="cubic")


def test_a_closed_loop_refuses_interpolated_inputs():
    law = LinearFeedback(np.zeros((10, 1)), np.zeros((10, 2)), np.zeros((10, 1, 2)))
    with pytest.raises(SettingsError, match="a closed loop holds its inputs"):
        rollouts(PENDULUM, hold="linear").fly(batch_of(log_of(PENDULUM, 10)), law)


def test_inputs_of_another_width_are_refused_by_their_own_shape():
    task = log_of(ROTORCRAFT, 10)
    task.inputs = np.hstack([task.inputs, task.inputs])
    with pytest.raises(SettingsError, match=r"inputs has shape \(10, 4\), but \(any, 2\) is needed"):
        rollouts(ROTORCRAFT, hold="linear").trajectories(batch_of(task))
