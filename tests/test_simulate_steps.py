"""Rollouts against slow, independent integrators."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from diransac.simulation import RolloutBatch, rollouts
from rolling import BODY, INTEGRATORS, PENDULUM, ROTORCRAFT, batch_of, log_of, normalised, plain_trajectory


@pytest.mark.parametrize("substeps", [1, 3])
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("model", [ROTORCRAFT, PENDULUM, BODY], ids=lambda model: model.name)
def test_trajectories_agree_with_a_plain_loop(model, integrator, substeps):
    task = log_of(model, 60)
    engine = rollouts(model, integrator=integrator, substeps=substeps)
    found = engine.trajectories(batch_of(task, task.parameters[:3]))
    for p, signals in zip(task.parameters, found, strict=False):
        expected = plain_trajectory(model, p, task.states, task.inputs, task.dt, integrator, substeps)
        np.testing.assert_allclose(signals, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("model", [ROTORCRAFT, PENDULUM, BODY], ids=lambda model: model.name)
def test_fine_steps_agree_with_scipy_a_segment_per_row(model):
    task = log_of(model, 30)
    p, x = task.parameters[0], task.states
    (found,) = rollouts(model, substeps=20).trajectories(batch_of(task, p[None]))
    for row, u in enumerate(task.inputs):
        np.testing.assert_allclose(found[row, : len(x)], x, rtol=0, atol=1e-10)
        slope = lambda _, state, u=u: np.array(model.dynamics(state, u, p)[0]).ravel()  # noqa: E731
        x = solve_ivp(slope, (0, task.dt), x, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]


def test_a_step_is_the_one_of_casadis_integrator():
    x, u, p = (ca.SX.sym(name, n) for name, n in (("x", 7), ("u", 3), ("p", 3)))
    rate = BODY.dynamics(x, u, p)[0]
    scheme = {"number_of_finite_elements": 1, "simplify": True}
    step = ca.integrator("step", "rk", {"x": x, "p": ca.vertcat(u, p), "ode": rate}, 0, 0.01, scheme)
    task = log_of(BODY, 2)
    (found,) = rollouts(BODY).trajectories(batch_of(task, task.parameters[:1]))
    expected = np.array(step(x0=task.states, p=np.concatenate([task.inputs[0], task.parameters[0]]))["xf"]).ravel()
    np.testing.assert_allclose(found[1, :7], normalised(BODY, expected), rtol=1e-13)


@pytest.mark.parametrize("model", [ROTORCRAFT, PENDULUM, BODY], ids=lambda model: model.name)
def test_fine_steps_agree_with_casadis_cvodes_a_segment_per_row(model):
    n_x, n_u = len(model.state), model.n_u
    x, u, p = (ca.SX.sym(name, n) for name, n in (("x", n_x), ("u", n_u), ("p", model.n_p)))
    problem = {"x": x, "p": ca.vertcat(u, p), "ode": model.dynamics(x, u, p)[0]}
    segment = ca.integrator("segment", "cvodes", problem, 0, 0.01, {"abstol": 1e-12, "reltol": 1e-12})
    task = log_of(model, 30)
    held = np.vstack([task.inputs.T, np.repeat(task.parameters[0][:, None], 30, axis=1)])
    path = segment.mapaccum(30)(x0=task.states, p=held)["xf"]
    (found,) = rollouts(model, substeps=20).trajectories(batch_of(task, task.parameters[:1]))
    np.testing.assert_allclose(found[1:, :n_x], np.array(path).T[:-1], rtol=0, atol=1e-8)


@pytest.mark.parametrize(("integrator", "order"), INTEGRATORS.items())
def test_integrators_converge_at_their_order(integrator, order):
    task = log_of(BODY, 40)
    problem = RolloutBatch(task.parameters[:1], task.states, task.inputs, 0.1)
    exact = rollouts(BODY, substeps=256).trajectories(problem)[0, -1, :7]
    coarse, fine = (
        np.linalg.norm(rollouts(BODY, integrator=integrator, substeps=n).trajectories(problem)[0, -1, :7] - exact)
        for n in (4, 8)
    )
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.25)


def test_semi_implicit_euler_keeps_the_energy_that_euler_gains():
    def energy(x):
        return x[..., 1] ** 2 / 2 - np.cos(x[..., 0])

    grown = {}
    for integrator in ("euler", "semi-implicit-euler"):
        engine = rollouts(PENDULUM, integrator=integrator)
        batch = RolloutBatch([[1.0, 0.0]], [1.0, 0.0], np.zeros((5000, 1)), 0.01)
        path = energy(engine.trajectories(batch)[0])
        grown[integrator] = np.ptp(path)
    assert grown["semi-implicit-euler"] < 0.01 < 0.1 < grown["euler"]


def test_the_acceleration_of_a_row_is_the_one_under_its_own_input():
    inputs = np.array([[0.0], [5.0], [0.0]])
    (found,) = rollouts(PENDULUM).trajectories(RolloutBatch([[0.0, 0.0]], [0.0, 0.0], inputs, 0.01))
    np.testing.assert_allclose(found[:, 2], [0.0, 5.0, 0.0])
    np.testing.assert_allclose(found[:, 1], [0.0, 0.0, 0.05])


def test_quaternions_stay_of_length_one():
    task = log_of(BODY, 3000)
    found = rollouts(BODY, integrator="euler").trajectories(batch_of(task, task.parameters[:2]))
    np.testing.assert_allclose(np.linalg.norm(found[..., :4], axis=-1), 1.0, rtol=1e-15)
