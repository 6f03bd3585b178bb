"""Machines that are steered along trajectories, and a plain Riccati sweep: what the tests of controllers share."""

import casadi as ca
import numpy as np

import diransac as dr
from diransac.flight.trajectory import Trajectory
from diransac.model.plant import Plant
from diransac.simulation import RolloutBatch, rollouts
from rolling import BODY, normalised

ROTORCRAFT = Plant(dr.models.planar_rotorcraft(), {"mass": 0.249, "inertia": 0.004, "drag": 0.025})
SERVO = Plant(dr.models.servo_axis(), {"mass": 2.0, "viscous_friction": 0.6, "dry_friction": 0.0, "offset": -1.5})
PENDULUM = Plant(
    dr.models.double_pendulum(),
    {
        "inertia1": 0.05, "moment1": 0.12, "inertia2": 0.015, "moment2": 0.05, "rotor_inertia": 5e-5,
        "viscous_friction1": 0.005, "dry_friction1": 0.02, "viscous_friction2": 0.005, "dry_friction2": 0.02,
    },
)  # fmt: skip
SATELLITE = Plant(BODY, {"p0": 1.0, "p1": 1.4, "p2": 0.7})
PLANTS = {"rotorcraft": ROTORCRAFT, "servo": SERVO, "pendulum": PENDULUM, "satellite": SATELLITE}
HOVER = {"rotorcraft": [0.249 * 9.81, 0.0], "servo": [-1.5], "pendulum": [0.0, 0.0], "satellite": [0.0, 0.0, 0.0]}
"""Inputs that hold each machine at rest: the rotorcraft in the air, the pendulum upright."""


def rest_state(plant):
    """The state in which the inputs of `HOVER` hold a machine."""
    x = np.zeros(len(plant.model.state))
    for four in plant.model.quaternions:
        x[four[0]] = 1.0
    if plant is PENDULUM:
        x[0] = np.pi
    return x


def resting(name, n_rows, dt=0.01, limits=None):
    """The trajectory that stays at rest."""
    model = PLANTS[name].model
    states, inputs = np.tile(rest_state(PLANTS[name]), (n_rows, 1)), np.tile(HOVER[name], (n_rows, 1))
    return Trajectory(dt * np.arange(n_rows), states, inputs, model.state, tuple(model.inputs), limits or {})


def moving(name, n_rows, dt=0.01, seed=0):
    """What smooth inputs around those of rest make of a machine."""
    plant, rng = PLANTS[name], np.random.default_rng(seed)
    model, time = plant.model, dt * np.arange(n_rows)
    waves = np.sin(time[:, None] * rng.uniform(2, 9, model.n_u) + rng.uniform(0, 6, model.n_u))
    inputs = np.array(HOVER[name]) + 0.1 * waves
    start = normalised(model, rest_state(plant) + 0.1 * rng.standard_normal(len(model.state)))
    signals = rollouts(model).trajectories(RolloutBatch([list(plant.parameters.values())], start, inputs, dt))[0]
    return Trajectory(time, signals[:, : len(start)], inputs, model.state, tuple(model.inputs))


def plain_jacobians(plant, trajectory):
    """A and B of every row: CasADi differentiates a Runge-Kutta step that is written out here, and evaluates it."""
    model, h = plant.model, trajectory.dt
    x, u, p = ca.SX.sym("x", len(model.state)), ca.SX.sym("u", model.n_u), np.array(list(plant.parameters.values()))
    rates = [model.dynamics(x, u, p)[0]]
    for share in (0.5, 0.5, 1.0):
        rates.append(model.dynamics(x + share * h * rates[-1], u, p)[0])
    after = x + h * (rates[0] + 2 * rates[1] + 2 * rates[2] + rates[3]) / 6
    for four in model.quaternions:
        length = ca.norm_2(ca.vertcat(*(after[k] for k in four)))
        for k in four:
            after[k] = after[k] / length
    f = ca.Function("jacobians", [x, u], [ca.jacobian(after, x), ca.jacobian(after, u)])
    pairs = [f(*row) for row in zip(trajectory.states, trajectory.inputs, strict=True)]
    return [[M.full() for M in pair] for pair in pairs]


def plain_sweep(jacobians, Q, R, Qf, dt):
    """Gains of every row and S of the first, by the textbook's recursion."""
    S, gains = Qf, []
    for A, B in reversed(jacobians):
        K = np.linalg.solve(R * dt + B.T @ S @ B, B.T @ S @ A)
        S = Q * dt + A.T @ S @ (A - B @ K)
        gains.append(K)
    return np.array(gains[::-1]), S


def random_weights(plant, seed=0):
    """Q, R and Qf without structure."""
    rng = np.random.default_rng(seed)
    factors = [rng.standard_normal((n, n)) for n in (len(plant.model.state), plant.model.n_u, len(plant.model.state))]
    return [factor @ factor.T + 0.1 * np.eye(len(factor)) for factor in factors]
