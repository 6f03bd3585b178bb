"""Gains of time-varying LQR against a plain sweep, the continuous Riccati equation, SciPy and Drake."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import solve_discrete_are

import diransac as dr
from diransac.errors import PlanningError
from diransac.flight.trajectory import Trajectory
from diransac.model.plant import Plant
from diransac.simulation import LinearFeedback, RolloutBatch, linearized_step, rollouts
from rolling import plain_step
from steering import (
    HOVER,
    PLANTS,
    ROTORCRAFT,
    SATELLITE,
    SERVO,
    moving,
    plain_jacobians,
    plain_sweep,
    random_weights,
    rest_state,
    resting,
)

EVERY_PLANT = pytest.mark.parametrize("name", PLANTS)


# The same recursion ---------------------------------------------------------------------------------------------------
@EVERY_PLANT
def test_gains_agree_with_a_plain_sweep_along_a_moving_trajectory(name):
    plant, trajectory = PLANTS[name], moving(name, 150)
    Q, R, Qf = random_weights(plant)
    expected, _ = plain_sweep(plain_jacobians(plant, trajectory), Q, R, Qf, trajectory.dt)
    found = dr.tvlqr(plant, trajectory, Q, R, Qf)
    np.testing.assert_allclose(found.gains, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


@EVERY_PLANT
def test_the_linearised_step_is_the_derivative_of_the_simulated_step(name):
    """By differences over two distances, whose errors of second order cancel."""
    plant, trajectory = PLANTS[name], moving(name, 30)
    x, u, p = trajectory.states[20], trajectory.inputs[20], np.array(list(plant.parameters.values()))
    after, A, B = linearized_step(plant.model)(x, u, p, 0.05)
    np.testing.assert_allclose(after.full().ravel(), plain_step(plant.model, p, x, u, 0.05), rtol=1e-12, atol=1e-12)

    def slope(direction, distance):
        dx, du = np.split(distance * direction, [len(x)])
        ahead, behind = (plain_step(plant.model, p, x + s * dx, u + s * du, 0.05) for s in (1, -1))
        return (ahead - behind) / (2 * distance)

    directions = np.eye(len(x) + len(u))
    expected = np.column_stack([(4 * slope(d, 1e-4) - slope(d, 2e-4)) / 3 for d in directions])
    np.testing.assert_allclose(np.hstack([A.full(), B.full()]), expected, rtol=1e-8, atol=1e-8)


def test_many_controllers_have_the_bits_that_each_has_alone():
    """Lanes of their own parameters, length, time step and limits."""
    rng = np.random.default_rng(3)
    plants, trajectories = [], []
    for k in range(19):
        values = {n: x * rng.uniform(0.9, 1.1) for n, x in ROTORCRAFT.parameters.items()}
        plants.append(Plant(ROTORCRAFT.model, values))
        motion = moving("rotorcraft", 40 + 7 * (k % 5), rng.uniform(0.005, 0.02), seed=k)
        limits = {"thrust": (0.0, rng.uniform(4, 6))}
        arrays = (motion.time, motion.states, motion.inputs, motion.state_names, motion.input_names)
        trajectories.append(Trajectory(*arrays, limits))
    for threads in (1, 2):
        found = dr.tvlqr_batch(plants, trajectories, threads=threads)
        assert len(found) == 19
        for plant, trajectory, controller in zip(plants, trajectories, found, strict=True):
            alone = dr.tvlqr(plant, trajectory)
            np.testing.assert_array_equal(controller.gains, alone.gains)
            np.testing.assert_array_equal(controller.u_max, alone.u_max)
            np.testing.assert_array_equal(controller.time, trajectory.time)


# Exact special cases -------------------------------------------------------------------------------------------------
@EVERY_PLANT
def test_gains_become_those_of_the_infinite_horizon(name):
    plant, trajectory = PLANTS[name], resting(name, 4000)
    A, B = plain_jacobians(plant, resting(name, 2))[0]
    Q, R, Qf = random_weights(plant)
    if plant is SATELLITE:  # SciPy needs the part of the state that can be steered: without the first quaternion number
        A, B, Q = A[1:, 1:], B[1:], Q[1:, 1:]
    S = solve_discrete_are(A, B, Q * trajectory.dt, R * trajectory.dt)
    expected = np.linalg.solve(R * trajectory.dt + B.T @ S @ B, B.T @ S @ A)
    found = dr.tvlqr(plant, trajectory, *random_weights(plant)[:2], Qf).gains[0]
    if plant is SATELLITE:
        np.testing.assert_allclose(found[:, 0], 0.0, atol=1e-12)
        found = found[:, 1:]
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-7)


def smooth_curve(dt, duration):
    """States and inputs of the rotorcraft on analytic curves: what a linearisation needs, flown or not."""
    time = dt * np.arange(round(duration / dt))
    states, inputs = curve_at(time)
    model = ROTORCRAFT.model
    return Trajectory(time, states.T, inputs.T, model.state, tuple(model.inputs))


def curve_at(t):
    """State and inputs at a time, of shape (n, *t.shape)."""
    tilt, turning = 0.5 * np.sin(3 * t), 1.5 * np.cos(3 * t)
    states = np.array([np.sin(t), np.cos(2 * t), tilt, np.cos(t), -2 * np.sin(2 * t), turning])
    return states, np.array([2.5 + np.sin(2 * t), 0.1 * np.cos(5 * t)])


def test_gains_converge_to_the_continuous_riccati_equation_with_order_one():
    duration = 1.6
    Q, R, Qf = random_weights(ROTORCRAFT)
    p = np.array(list(ROTORCRAFT.parameters.values()))

    def rates(tau, S):
        """dS/d(time to go) = Q + A'S + S A - S B R^-1 B'S."""
        S = S.reshape(6, 6)
        A, B = (np.array(M) for M in ROTORCRAFT.model.linearization(*curve_at(duration - tau), p))
        return (Q + A.T @ S + S @ A - S @ B @ np.linalg.solve(R, B.T @ S)).ravel()

    S = solve_ivp(rates, (0, duration), Qf.ravel(), method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1].reshape(6, 6)
    expected = np.linalg.solve(R, np.array(ROTORCRAFT.model.linearization(*curve_at(0.0), p)[1]).T @ S)
    steps = np.array([0.004, 0.002, 0.001, 0.0005])
    gains = [dr.tvlqr(ROTORCRAFT, smooth_curve(dt, duration), Q, R, Qf).gains[0] for dt in steps]
    errors = np.array([np.abs(K - expected).max() for K in gains])
    orders = np.log2(errors[:-1] / errors[1:])
    np.testing.assert_allclose(orders, 1.0, atol=0.1)
    extrapolated = np.abs(2 * gains[-1] - gains[-2] - expected).max()
    assert extrapolated < 0.02 * errors[-1]


def linear_costs(K, starts, Q, R, Qf):
    """Cost of each start under gains K (K, 1, 2), flown by the servo axis, which is linear without dry friction."""
    rest, dt = rest_state(SERVO), 0.01
    padded = np.concatenate([K, np.zeros((1, *K.shape[1:]))])
    law = LinearFeedback(np.tile(HOVER["servo"], (len(padded), 1)), np.tile(rest, (len(padded), 1)), padded)
    parameters = np.tile(list(SERVO.parameters.values()), (len(starts), 1))
    flown = rollouts(SERVO.model).fly(RolloutBatch(parameters, starts, law.u_ref, dt), law)
    x, u = flown.signals[..., :2], flown.inputs[:, :-1] - HOVER["servo"]
    running = np.einsum("lki,ij,lkj->l", x[:, :-1], Q, x[:, :-1]) + np.einsum("lki,ij,lkj->l", u, R, u)
    return dt * running + np.einsum("li,ij,lj->l", x[:, -1], Qf, x[:, -1])


def test_the_flown_cost_of_a_linear_plant_is_what_the_riccati_equation_says_and_no_other_gains_cost_less():
    rng, trajectory = np.random.default_rng(5), resting("servo", 120)
    Q, R, Qf = random_weights(SERVO)
    K = dr.tvlqr(SERVO, trajectory, Q, R, Qf).gains
    starts = rng.standard_normal((20, 2))
    _, S = plain_sweep(plain_jacobians(SERVO, trajectory), Q, R, Qf, trajectory.dt)
    best = linear_costs(K, starts, Q, R, Qf)
    np.testing.assert_allclose(best, np.einsum("li,ij,lj->l", starts, S, starts), rtol=1e-11)
    for size in (1e-3, 1e-2, 0.3):
        other = linear_costs(K * (1 + size * rng.standard_normal(K.shape)), starts, Q, R, Qf)
        assert (other > best).all()


# What the gains do ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("name", "reach"), [("rotorcraft", 0.7), ("servo", 1.0), ("pendulum", 0.3)])
def test_a_machine_returns_to_rest_and_stays_there(name, reach):
    """The pendulum stands upright; it has dry friction, which its controller doesn't know."""
    plant, trajectory = PLANTS[name], resting(name, 1500)
    known = {n: 0.0 if n.startswith("dry") else x for n, x in plant.parameters.items()}
    law = dr.tvlqr(Plant(plant.model, known), trajectory).law()
    starts = rest_state(plant) + reach * np.random.default_rng(1).uniform(-1, 1, (8, law.n_x))
    parameters = np.tile(list(plant.parameters.values()), (8, 1))
    flown = rollouts(plant.model, substeps=5).fly(RolloutBatch(parameters, starts, law.u_ref, trajectory.dt), law)
    errors = np.abs(flown.signals[..., : law.n_x] - rest_state(plant))
    assert errors[:, 0].max() > reach / 2
    assert errors[:, -300:].max() < 2e-3


def test_a_moving_rotorcraft_is_brought_back_to_its_trajectory():
    trajectory = moving("rotorcraft", 600)
    start = trajectory.states[0] + [0.5, -0.5, 0.3, 0.5, -0.5, 0.5]
    batch = RolloutBatch([list(ROTORCRAFT.parameters.values())], start, trajectory.inputs, trajectory.dt)
    held, free = (
        rollouts(ROTORCRAFT.model).fly(batch, law).signals
        for law in (
            dr.tvlqr(ROTORCRAFT, trajectory).law(),
            LinearFeedback(trajectory.inputs, trajectory.states, np.zeros((600, 2, 6))),
        )
    )
    assert np.abs(held[0, -1, :6] - trajectory.states[-1]).max() < 0.01
    assert np.abs(free[0, -1, :6] - trajectory.states[-1]).max() > 1.0


def test_a_quaternion_body_is_stabilised_whichever_sign_its_attitude_has():
    trajectory = moving("satellite", 1200)
    controller = dr.tvlqr(SATELLITE, trajectory)
    rng = np.random.default_rng(2)
    starts = trajectory.states[0] + 0.4 * rng.uniform(-1, 1, (6, 7))
    starts[:, :4] /= np.linalg.norm(starts[:, :4], axis=1, keepdims=True)
    starts[3:, :4] *= -1
    parameters = np.tile(list(SATELLITE.parameters.values()), (6, 1))
    batch = RolloutBatch(parameters, starts, trajectory.inputs, trajectory.dt)
    flown = rollouts(SATELLITE.model).fly(batch, controller.law()).signals
    aligned = np.abs(np.einsum("li,i->l", flown[:, -1, :4], trajectory.states[-1, :4]))
    np.testing.assert_allclose(aligned, 1.0, atol=1e-6)
    np.testing.assert_allclose(flown[:, -1, 4:7], np.tile(trajectory.states[-1, 4:], (6, 1)), atol=1e-3)


def test_no_gain_answers_to_the_length_of_a_quaternion():
    trajectory = moving("satellite", 100)
    gains = dr.tvlqr(SATELLITE, trajectory).gains
    along = np.einsum("kui,ki->ku", gains[..., :4], trajectory.states[:, :4])
    np.testing.assert_allclose(along, 0.0, atol=1e-12 * np.abs(gains).max())


# What cannot be ------------------------------------------------------------------------------------------------------
def test_a_sweep_that_overflows_says_when():
    """Nothing steers y, which grows a hundredfold every 46 ms and pulls x along."""
    pulled = dr.Model(
        "pulled", {"x": "m", "y": "m"}, {"u": "N"}, {"m": dr.Parameter("kg")},
        lambda q, v, a, u, p: [p.m * a.x - u.u - q.y, a.y - 1e4 * q.y],
    )  # fmt: skip
    trajectory = Trajectory(0.01 * np.arange(900), np.zeros((900, 4)), np.zeros((900, 1)))
    with pytest.raises(PlanningError, match=r'"pulled" did not stay finite.*back from t = [12]\.\d+ s; raise R'):
        dr.tvlqr(Plant(pulled, {"m": 1.0}), trajectory)


def test_a_sweep_that_loses_its_precision_says_so():
    """Two inputs that cost next to nothing and one weighted coordinate leave R dt + B'S B singular to rounding."""
    with pytest.raises(PlanningError, match="did not stay finite and positive"):
        dr.tvlqr(PLANTS["pendulum"], resting("pendulum", 50), {"q1": 1.0}, 1e-30, 0.0)


def test_a_trajectory_through_a_state_without_derivatives_is_refused_with_the_state():
    root = dr.Model(
        "root",
        {"x": "m"},
        {"u": "N"},
        {"m": dr.Parameter("kg")},
        lambda q, v, a, u, p: [p.m * a.x - u.u + ca.sqrt(q.x)],
    )
    states = np.column_stack([np.linspace(1.0, 0.0, 11), np.zeros(11)])
    trajectory = Trajectory(0.1 * np.arange(11), states, np.zeros((11, 1)))
    with pytest.raises(PlanningError, match=r"no finite derivatives on the trajectory at t = 1 s: x = \[0.0, 0.0\]"):
        dr.tvlqr(Plant(root, {"m": 1.0}), trajectory)


# Drake ---------------------------------------------------------------------------------------------------------------
def drake_system(period=0.0):
    """The planar rotorcraft's eq. (4) as Drake's symbolic system; with a period, its Runge-Kutta step."""
    pydrake = pytest.importorskip("pydrake.all", reason="DRAKE NOT COMPARED: pip install drake")
    x, u = pydrake.MakeVectorVariable(6, "x"), pydrake.MakeVectorVariable(2, "u")
    mass, inertia, drag = ROTORCRAFT.parameters.values()

    def rates(x):
        s, c, dragged = pydrake.sin(x[2]), pydrake.cos(x[2]), drag * u[0]  # the thrust is positive
        forces = [-u[0] * s - dragged * x[3] * c, u[0] * c - dragged * x[4] * s]
        return np.array([x[3], x[4], x[5], forces[0] / mass, forces[1] / mass - 9.81, 0.177 * u[1] / inertia])

    if not period:
        return pydrake, pydrake.SymbolicVectorSystem(state=x, input=u, dynamics=rates(x))
    with np.errstate(invalid="ignore"):  # NumPy takes Drake's expressions for numbers
        second = rates(x + period / 2 * (first := rates(x)))
        third = rates(x + period / 2 * second)
        after = x + period / 6 * (first + 2 * second + 2 * third + rates(x + period * third))
    return pydrake, pydrake.SymbolicVectorSystem(state=x, input=u, dynamics=after, time_period=period)


def drake_result(pydrake, system, x0, u0, Q, R, Qf, duration):
    """What `FiniteHorizonLinearQuadraticRegulator` gives."""
    options = pydrake.FiniteHorizonLinearQuadraticRegulatorOptions()
    options.x0, options.u0, options.Qf = x0, u0, Qf
    options.simulator_config.accuracy = 1e-7
    return pydrake.FiniteHorizonLinearQuadraticRegulator(
        system, system.CreateDefaultContext(), t0=0.0, tf=duration, Q=Q, R=R, options=options
    )


@pytest.mark.parametrize("kind", ["hovering", "moving"])
def test_gains_agree_with_drakes_of_the_same_discrete_system(kind):
    """Forty rows: Drake does not keep S symmetric, and its rounding errors grow sevenfold every ten rows."""
    trajectory = resting("rotorcraft", 40, 0.02) if kind == "hovering" else moving("rotorcraft", 40, 0.02)
    pydrake, system = drake_system(trajectory.dt)
    Q, R, Qf = random_weights(ROTORCRAFT)
    times = trajectory.dt * np.arange(41)
    x0, u0 = (
        pydrake.PiecewisePolynomial.ZeroOrderHold(times, np.vstack([rows, rows[-1:]]).T)
        for rows in (trajectory.states, trajectory.inputs)
    )
    theirs = drake_result(pydrake, system, x0, u0, trajectory.dt * Q, trajectory.dt * R, Qf, times[-1])
    found = dr.tvlqr(ROTORCRAFT, trajectory, Q, R, Qf).gains
    expected = np.array([theirs.K.value(t) for t in times[:-1]])
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("kind", ["hovering", "moving"])
def test_gains_converge_to_drakes_continuous_ones(kind):
    pydrake, system = drake_system()
    duration = 0.8
    fine = np.linspace(0.0, duration, 801)
    states, inputs = curve_at(fine if kind == "moving" else np.zeros_like(fine))
    x0, u0 = (pydrake.PiecewisePolynomial.CubicShapePreserving(fine, rows, False) for rows in (states, inputs))
    Q, R, Qf = random_weights(ROTORCRAFT)
    expected = drake_result(pydrake, system, x0, u0, Q, R, Qf, duration).K.value(0.0)
    gains = []
    for dt in (0.002, 0.001):
        time = dt * np.arange(round(duration / dt))
        x, u = curve_at(time if kind == "moving" else np.zeros_like(time))
        gains.append(dr.tvlqr(ROTORCRAFT, Trajectory(time, x.T, u.T), Q, R, Qf).gains[0])
    errors = [np.abs(K - expected).max() for K in gains]
    assert errors[0] / errors[1] == pytest.approx(2.0, abs=0.15)
    assert np.abs(2 * gains[1] - gains[0] - expected).max() < 0.05 * errors[1]
