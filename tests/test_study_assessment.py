"""The best parameters that a model can reach, against what they must be by hand: logs are random rows, by plain NumPy.

Nothing need be flown: each row of a log has a state, inputs, and the accelerations that these make.
"""

from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest

import diransac as dr
from diransac.study.assessment import mean_accelerations, pseudo_true_parameters
from simulated import rotorcraft_acceleration, rotorcraft_regressor

TRUTH = {"mass": 0.249, "inertia": 0.004, "drag": 0.025}
ROTORCRAFT = dr.models.planar_rotorcraft()
N_ROWS = 300


def log_of(model: dr.Model, accelerations: Callable, seed: int = 1) -> dr.Log:
    """Random rows; ``accelerations(k, q, v, u)`` of row k."""
    rng = np.random.default_rng(seed)
    q, v = rng.uniform(-1.0, 1.0, (2, N_ROWS, model.n_q))
    u = rng.uniform(0.5, 3.0, (N_ROWS, model.n_u))
    a = np.array([accelerations(k, *row) for k, row in enumerate(zip(q, v, u, strict=True))])
    columns = dict(zip((*model.signals, *model.inputs), np.hstack([q, v, a, u]).T, strict=True))
    return dr.Log.from_arrays(0.01 * np.arange(N_ROWS), columns, model.units)


def rotorcraft_log(more: Callable = lambda k, q, v, u: np.zeros(3)) -> dr.Log:
    """Rows of the paper's rotorcraft on which further accelerations act."""
    p = tuple(TRUTH.values())
    return log_of(ROTORCRAFT, lambda k, q, v, u: np.array(rotorcraft_acceleration(q, v, u, p)) + more(k, q, v, u))


def shaken(amplitude: float, mean: float = 0.0, state: str = "phase_1") -> dr.Plant:
    """The rotorcraft with a force along z that goes to and fro with a phase, to the third harmonic, about a mean."""
    motor = dr.Disturbance(
        ROTORCRAFT,
        "motor",
        forces=lambda q, v, u, p, d: {"z": mean + amplitude * (ca.cos(d[state]) + ca.sin(3 * d[state]) * u.thrust)},
        states={state: "rad"},
        rates=lambda q, v, u, p, d: {state: 300.0},
    )
    return dr.Plant(ROTORCRAFT, TRUTH, (motor,))


def shaken_log(amplitude: float, mean: float = 0.0) -> dr.Log:
    """Its rows, each at a phase of its own."""
    phases = np.random.default_rng(2).uniform(0.0, 2 * np.pi, N_ROWS)

    def more(k: int, q: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
        force = mean + amplitude * (np.cos(phases[k]) + np.sin(3 * phases[k]) * u[0])
        return np.array([0.0, force / TRUTH["mass"], 0.0])

    return rotorcraft_log(more)


def by_hand(log: dr.Log) -> np.ndarray:
    """Least squares of the paper's equations on the rows as they are."""
    rows = [
        rotorcraft_regressor(*(np.array([log[n][k] for n in names]) for names in (
            ROTORCRAFT.coordinates, ROTORCRAFT.velocities, ROTORCRAFT.accelerations, ROTORCRAFT.inputs,
        )))
        for k in range(len(log))
    ]  # fmt: skip
    W, b = (np.concatenate([row[i] for row in rows]) for i in (0, 1))
    return np.linalg.lstsq(W, b, rcond=None)[0]


def test_without_anything_unknown_the_best_parameters_are_the_plants_own():
    best = pseudo_true_parameters(dr.Plant(ROTORCRAFT, TRUTH), rotorcraft_log())
    assert best == pytest.approx(TRUTH, rel=1e-9)
    assert list(best) == list(ROTORCRAFT.parameters)


def test_an_excess_in_proportion_to_the_thrust_takes_exactly_its_share_of_mass_and_drag():
    excess = 0.07
    push = dr.Disturbance(
        ROTORCRAFT,
        "push",
        forces=lambda q, v, u, p, d: {
            "x": -d.share * u.thrust * ca.sin(q.theta), "z": d.share * u.thrust * ca.cos(q.theta),
        },
        constants={"share": excess},
    )  # fmt: skip

    def more(k: int, q: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
        return excess * u[0] / TRUTH["mass"] * np.array([-np.sin(q[2]), np.cos(q[2]), 0.0])

    best = pseudo_true_parameters(dr.Plant(ROTORCRAFT, TRUTH, (push,)), rotorcraft_log(more))
    smaller = {"mass": TRUTH["mass"] / (1 + excess), "drag": TRUTH["drag"] / (1 + excess)}
    assert best == pytest.approx({**TRUTH, **smaller}, rel=1e-9)


def test_a_force_without_a_mean_over_its_phase_leaves_the_plants_own_parameters():
    log = shaken_log(0.5)
    assert abs(by_hand(log)[0] / TRUTH["mass"] - 1) > 0.01, "the vibration itself would spoil them"
    assert pseudo_true_parameters(shaken(0.5), log) == pytest.approx(TRUTH, rel=1e-9)


def test_the_mean_of_a_vibration_stays():
    best = pseudo_true_parameters(shaken(0.5, mean=0.2), shaken_log(0.5, mean=0.2))
    assert list(best.values()) == pytest.approx(by_hand(shaken_log(0.0, mean=0.2)), rel=1e-9)
    assert abs(best["mass"] / TRUTH["mass"] - 1) > 0.01


def test_what_no_phase_tells_is_judged_as_it_was_recorded():
    plant, log = shaken(0.5, state="slosh"), shaken_log(0.5)
    recorded = np.column_stack([log[name] for name in ROTORCRAFT.accelerations])
    assert np.array_equal(mean_accelerations(plant, log), recorded)
    assert list(pseudo_true_parameters(plant, log).values()) == pytest.approx(by_hand(log), rel=1e-9)


def test_a_model_that_is_not_affine_in_its_parameters_is_judged_by_its_accelerations():
    pendulum = dr.Model(
        "pendulum", {"angle": "rad"}, {"torque": "N m"},
        {"mass": dr.Parameter("kg", positive=True), "length": dr.Parameter("m", positive=True)},
        lambda q, v, a, u, p: [a.angle + 9.81 / p.length * ca.sin(q.angle) - u.torque / (p.mass * p.length**2)],
    )  # fmt: skip
    truth = {"mass": 0.5, "length": 0.6}
    log = log_of(pendulum, lambda k, q, v, u: [-9.81 / 0.6 * np.sin(q[0]) + u[0] / (0.5 * 0.6**2)])
    assert pseudo_true_parameters(dr.Plant(pendulum, truth), log) == pytest.approx(truth, rel=1e-6)


def test_a_flight_that_leaves_a_parameter_open_judges_nothing():
    still = rotorcraft_log()
    at_rest = {name: np.zeros(N_ROWS) for name in ("x_dot", "z_dot", "x_ddot", "z_ddot", "theta")}
    level = {**at_rest, "thrust": np.full(N_ROWS, TRUTH["mass"] * 9.81)}
    log = dr.Log.from_arrays(still.time, {**still.signals, **level}, ROTORCRAFT.units)
    with pytest.raises(dr.IdentificationError, match=r"does not determine drag: .* no pseudo-true parameters"):
        pseudo_true_parameters(dr.Plant(ROTORCRAFT, TRUTH), log)
