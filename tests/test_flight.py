"""Closed loops against a plain one, and what is said of them."""

import pickle

import numpy as np
import pytest

import diransac as dr
from diransac.errors import LogError, SettingsError
from diransac.flight.closed_loop import fly, fly_batch, tracking_error
from diransac.flight.trajectory import Trajectory
from diransac.flight.tvlqr import Controller, tvlqr
from diransac.model.library import TABLE_I, extended_rotorcraft, planar_rotorcraft
from diransac.simulation import RolloutBatch, rollouts

MODEL = planar_rotorcraft()
TRUE = dr.Plant(MODEL, TABLE_I)
LIMITS = {"thrust": (0.0, 5.0), "moment": (-1.0, 1.0)}
NAMES = (MODEL.state, tuple(MODEL.inputs))


def wiggle(n_rows=300, dt=0.01, plant=TRUE):
    """A trajectory that the plant's model flies exactly: a rollout of smooth inputs."""
    t = np.arange(n_rows)[:, None] * dt
    inputs = np.hstack([0.249 * 9.81 * (1 + 0.2 * np.sin(2 * t)), 0.02 * np.cos(4 * t)])
    p = [list(plant.parameters.values())]
    states = rollouts(MODEL).trajectories(RolloutBatch(p, np.zeros(6), inputs, dt))[0, :, :6]
    return Trajectory(t[:, 0], states, inputs, *NAMES, LIMITS)


REFERENCE = wiggle()
STEERING = tvlqr(TRUE, REFERENCE)
DISTURBED = extended_rotorcraft(1.4e-6, 1e-4)


def states_of(log):
    return np.column_stack([log[name] for name in MODEL.state])


def test_a_flight_agrees_with_a_plain_closed_loop_that_clips_and_holds():
    n_rows, substeps, dt = 100, 25, 0.01
    start = {"z": -1.5, "theta": 0.8}
    steering = tvlqr(TRUE, wiggle(n_rows), limits={"thrust": (2.0, 3.0), "moment": (-0.1, 0.1)})
    log = fly(DISTURBED, wiggle(n_rows), steering, initial_state=start, substeps=substeps)
    f, p, h = DISTURBED.simulated.dynamics, DISTURBED.constants, dt / substeps
    x = DISTURBED.initial_state([0, -1.5, 0.8, 0, 0, 0])
    clipped = 0
    for row in range(n_rows):
        wanted = steering.inputs[row] - steering.gains[row] @ (x[:6] - steering.states[row])
        u = np.clip(wanted, [2.0, -0.1], [3.0, 0.1])
        clipped += np.any(u != wanted)
        found = [log[name][row] for name in (*MODEL.signals, *MODEL.inputs)]
        accelerations = np.array(f(x, u, p)[1]).ravel()
        np.testing.assert_allclose(found, [*x[:6], *accelerations, *u], rtol=1e-8, atol=1e-8)
        for _ in range(substeps):
            k1 = np.array(f(x, u, p)[0]).ravel()
            k2 = np.array(f(x + h / 2 * k1, u, p)[0]).ravel()
            k3 = np.array(f(x + h / 2 * k2, u, p)[0]).ravel()
            k4 = np.array(f(x + h * k3, u, p)[0]).ravel()
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    assert clipped > 5


def test_a_plant_that_is_as_the_model_says_flies_the_trajectory_itself():
    log = fly(TRUE, REFERENCE, STEERING)
    assert max(tracking_error(REFERENCE, log).values()) < 1e-12
    np.testing.assert_allclose(log["thrust"], REFERENCE["thrust"], rtol=1e-12)
    assert log.units["theta_ddot"] == "rad/s^2"
    assert set(log.names) == {*MODEL.signals, *MODEL.inputs}
    assert len(log) == len(REFERENCE)


def test_feedback_brings_a_plant_back_that_starts_elsewhere_and_open_loop_does_not():
    start = {"x": 0.3, "z": -0.2}
    held = tracking_error(REFERENCE, fly(TRUE, REFERENCE, STEERING, initial_state=start)[200:])
    blind = Controller(
        REFERENCE.time, REFERENCE.states, REFERENCE.inputs, np.zeros((300, 2, 6)), *np.array(list(LIMITS.values())).T,
        *NAMES,
    )  # fmt: skip
    adrift = tracking_error(REFERENCE, fly(TRUE, REFERENCE, blind, initial_state=start)[200:])
    assert held["x"] < 0.2 * adrift["x"]
    assert held["z"] < 0.2 * adrift["z"]


def test_an_identified_model_flies_like_the_plant_it_was_identified_from():
    log = fly(TRUE, REFERENCE, STEERING, initial_state={"x": 0.3})
    result = dr.identify(MODEL, log, "ols")
    again = fly(result, REFERENCE, tvlqr(result, REFERENCE), initial_state={"x": 0.3})
    np.testing.assert_allclose(states_of(again), states_of(log), atol=1e-8)


def test_a_disturbance_is_felt_though_the_controller_does_not_know_it():
    log = fly(DISTURBED, REFERENCE, STEERING)
    error = tracking_error(REFERENCE, log)
    # The excess thrust is 9 % of the weight; a constant force F leaves the deviation F / (K_thrust,z) in the end.
    lift = 1.4e-6 / (0.06 * 0.127**4) * 9.81 * 0.249
    sag = lift / STEERING.gains[0, 0, 1]
    assert 0.5 * sag < error["z"] < 1.5 * sag
    assert np.ptp(log["theta_ddot"] - fly(TRUE, REFERENCE, STEERING)["theta_ddot"]) > 50.0


def test_flights_at_a_time_are_the_same_bits_as_one_by_one():
    plants = [
        extended_rotorcraft(gamma, 1e-4, parameters={**TABLE_I, "mass": m})
        for gamma in (1e-6, 1.8e-6)
        for m in (0.249, 0.4)
    ]
    controllers = [STEERING, tvlqr(dr.Plant(MODEL, {**TABLE_I, "inertia": 0.006}), REFERENCE)]
    pairs = [(plant, controller) for plant in plants for controller in controllers]
    starts = np.random.default_rng(0).uniform(-0.1, 0.1, (8, 6))
    together = fly_batch(*zip(*pairs, strict=True), starts, threads=2)
    for log, (plant, controller), x in zip(together, pairs, starts, strict=True):
        start = dict(zip(MODEL.state, x, strict=True))
        alone = fly(plant, REFERENCE, controller, initial_state=start)
        np.testing.assert_array_equal(states_of(log), states_of(alone))
        np.testing.assert_array_equal(log["theta_ddot"], alone["theta_ddot"])
        assert log.history == alone.history


def test_the_seed_turns_the_rotors_that_start_anywhere_and_nothing_else():
    anywhere = extended_rotorcraft(mass_imbalance=1e-4, rotor_phase=None)
    flights = [fly(anywhere, REFERENCE, STEERING, seed=seed)["theta_ddot"] for seed in (0, 0, 1)]
    np.testing.assert_array_equal(flights[0], flights[1])
    assert np.abs(flights[0] - flights[2]).max() > 1.0
    still = [fly(DISTURBED, REFERENCE, STEERING, seed=seed)["theta_ddot"] for seed in (0, 1)]
    np.testing.assert_array_equal(*still)


def test_a_pickled_plant_and_controller_fly_the_same():
    plant, controller = pickle.loads(pickle.dumps((DISTURBED, STEERING)))
    log, again = fly(DISTURBED, REFERENCE, STEERING), fly(plant, REFERENCE, controller)
    np.testing.assert_array_equal(states_of(log), states_of(again))


def test_a_controller_may_run_at_another_rate():
    slow = wiggle(30, 0.1)
    controller = tvlqr(TRUE, slow)
    held = fly(TRUE, slow, controller, dt=0.01)
    assert len(held) == 291
    assert held.dt == pytest.approx(0.01)
    same = fly(TRUE, slow, controller)
    np.testing.assert_array_equal(same.time, slow.time)


def test_substeps_come_from_the_plant_unless_they_are_given():
    steps = [fly(plant, REFERENCE, STEERING).history[0]["substeps"] for plant in (TRUE, DISTURBED)]
    assert steps == [1, DISTURBED.substeps(0.01)]
    assert fly(TRUE, REFERENCE, STEERING, substeps=3).history[0]["substeps"] == 3


def test_a_flight_that_diverges_says_when_and_has_an_infinite_error():
    runaway = dr.Disturbance(MODEL, "runaway", accelerations=lambda q, v, u, p, d: {"x": 50.0 * v.x**3 + 1.0})
    log = fly(dr.Plant(MODEL, TABLE_I, (runaway,)), REFERENCE, STEERING)
    first = int(np.argmax(np.isnan(log["x"])))
    assert 0 < first < 100
    assert log.notes == (f"the flight diverged at t = {log.time[first]:.6g} s",)
    assert tracking_error(REFERENCE, log)["x"] == np.inf


def test_tracking_error_is_the_rms_of_each_state():
    log = fly(DISTURBED, REFERENCE, STEERING)
    wanted = np.sqrt(np.mean((states_of(log) - REFERENCE.states) ** 2, axis=0))
    assert list(tracking_error(REFERENCE, log)) == list(MODEL.state)
    np.testing.assert_allclose(list(tracking_error(REFERENCE, log).values()), wanted, rtol=1e-12)


def test_tracking_error_interpolates_a_coarser_reference_and_ignores_what_lies_outside_of_it():
    t = np.arange(21) * 0.1
    line = Trajectory(t, np.column_stack([3.0 * t, np.full(21, 3.0)]), np.zeros((21, 1)), ("s", "s_dot"), ("f",))
    fine = np.arange(-50, 300) * 0.01
    log = dr.Log.from_arrays(fine, {"s": 3.0 * fine + 0.25, "s_dot": np.where(fine > 2.005, 99.0, 3.0)})
    errors = tracking_error(line, log)
    assert errors["s"] == pytest.approx(0.25, rel=1e-12)
    assert errors["s_dot"] == 0.0


def test_what_does_not_fit_together_is_refused():
    other = dr.Plant(dr.models.servo_axis(), dict.fromkeys(dr.models.servo_axis().parameters, 1.0))
    with pytest.raises(SettingsError, match="the trajectory has 6 states; the plant has 2"):
        fly(other, REFERENCE, STEERING)
    with pytest.raises(SettingsError, match=r'the controller is for x, z.* but the plant "servo-axis" has'):
        fly_batch([other], [STEERING])
    with pytest.raises(SettingsError, match=r"give a dr.Plant or a dr.Result"):
        fly(MODEL, REFERENCE, STEERING)
    with pytest.raises(SettingsError, match="the plants' equations differ"):
        fly_batch([extended_rotorcraft(phase="instantaneous"), DISTURBED], [STEERING, STEERING])
    with pytest.raises(SettingsError, match="controllers differ in length, time step or limits"):
        fly_batch([TRUE, TRUE], [STEERING, STEERING.at(REFERENCE.time[:100])])
    with pytest.raises(SettingsError, match="2 plants, 1 controllers and 2 seeds do not match"):
        fly_batch([TRUE, TRUE], [STEERING])
    with pytest.raises(SettingsError, match='initial_state names "y"; states are x, z'):
        fly(TRUE, REFERENCE, STEERING, initial_state={"y": 1.0})
    with pytest.raises(SettingsError, match="initial_state holds a NaN"):
        fly(TRUE, REFERENCE, STEERING, initial_state={"x": np.nan})
    with pytest.raises(SettingsError, match=r"dt is 0.0; give positive seconds"):
        fly(TRUE, REFERENCE, STEERING, dt=0.0)


def test_an_error_of_what_was_not_flown_is_refused():
    log = fly(TRUE, REFERENCE, STEERING)
    late = dr.Log.from_arrays(log.time + 100.0, {"x": log["x"]})
    with pytest.raises(SettingsError, match="they have no time in common"):
        tracking_error(REFERENCE, late)
    with pytest.raises(LogError, match='signal "z" is missing'):
        tracking_error(REFERENCE, dr.Log.from_arrays(log.time, {"x": log["x"]}))
    nameless = Trajectory(REFERENCE.time, REFERENCE.states, REFERENCE.inputs)
    with pytest.raises(SettingsError, match="columns have no names"):
        tracking_error(nameless, log)
