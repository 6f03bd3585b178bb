"""Rollouts under linear feedback against a plain closed loop."""

import numpy as np
import pytest

from diransac.errors import SettingsError
from diransac.simulation import LinearFeedback, RolloutBatch, rollouts
from rolling import (
    BODY,
    EXPLOSIVE,
    INTEGRATORS,
    ON_EVERY_TARGET,
    PENDULUM,
    ROTORCRAFT,
    assert_same,
    batch_of,
    log_of,
    plain_step,
    signals_at,
)

EVERY_MODEL = pytest.mark.parametrize("model", [ROTORCRAFT, PENDULUM, BODY], ids=lambda model: model.name)


def law_of(model, n_rows, n_laws=None, seed=0, limit=0.8):
    """A weak random law around random references."""
    rng = np.random.default_rng(seed)
    shape = (n_rows,) if n_laws is None else (n_laws, n_rows)
    n_x, n_u = len(model.state), model.n_u
    return LinearFeedback(
        rng.standard_normal((*shape, n_u)),
        rng.standard_normal((*shape, n_x)),
        0.3 * rng.standard_normal((*shape, n_u, n_x)),
        np.full(n_u, -limit),
        np.linspace(limit, 2 * limit, n_u),
    )


def plain_flight(model, p, x, law, dt, integrator="rk4", substeps=1):
    """Signals and inputs row by row, in plain Python."""
    signals, inputs = [], []
    for u_ref, x_ref, K in zip(law.u_ref, law.x_ref, law.gains, strict=True):
        seen = x.copy()
        for four in model.quaternions:
            if seen[list(four)] @ x_ref[list(four)] < 0:
                seen[list(four)] *= -1
        u = np.clip(u_ref - K @ (seen - x_ref), law.u_min, law.u_max)
        signals.append(signals_at(model, p, x, u))
        inputs.append(u)
        x = plain_step(model, p, x, u, dt, integrator, substeps)
    return np.array(signals), np.array(inputs)


def one_of(law, k, rows=slice(None)):
    """One law of a table, or some of its rows."""
    return LinearFeedback(law.u_ref[k, rows], law.x_ref[k, rows], law.gains[k, rows], law.u_min, law.u_max)


@pytest.mark.parametrize("substeps", [1, 3])
@pytest.mark.parametrize("integrator", INTEGRATORS)
@EVERY_MODEL
def test_flights_agree_with_a_plain_closed_loop(model, integrator, substeps):
    task, law = log_of(model, 40), law_of(model, 40)
    engine = rollouts(model, integrator=integrator, substeps=substeps)
    found = engine.fly(batch_of(task, task.parameters[:3]), law)
    assert found.inputs.shape == (3, 40, model.n_u)
    clipped = (found.inputs == law.u_min) | (found.inputs == law.u_max)
    assert 0.05 < clipped.mean() < 0.95
    for lane in range(3):
        p = task.parameters[lane]
        signals, inputs = plain_flight(model, p, task.states, law, task.dt, integrator, substeps)
        np.testing.assert_allclose(found.signals[lane], signals, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(found.inputs[lane], inputs, rtol=1e-11, atol=1e-11)


@EVERY_MODEL
def test_each_lane_flies_its_own_law_of_a_table(model):
    task, table = log_of(model, 30), law_of(model, 30, 21)
    engine = rollouts(model)
    found = engine.fly(batch_of(task), table)
    for lane in (0, 7, 8, 20):
        alone = engine.fly(batch_of(task, task.parameters[lane : lane + 1]), one_of(table, lane))
        np.testing.assert_array_equal(found.signals[lane], alone.signals[0])
        np.testing.assert_array_equal(found.inputs[lane], alone.inputs[0])


def test_lanes_may_share_the_laws_of_a_table_and_start_in_its_midst():
    task, table = log_of(BODY, 60), law_of(BODY, 60, 3)
    rng = np.random.default_rng(4)
    which, starts = rng.integers(0, 3, 21), rng.integers(0, 40, 21)
    engine = rollouts(BODY, substeps=2)
    batch = batch_of(task, start_rows=starts, n_rows=20)
    found = engine.fly(batch, table, feedback_of_lane=which, threads=2)
    for lane, (law, start) in enumerate(zip(which, starts, strict=True)):
        rows = slice(start, start + 20)
        one = RolloutBatch(task.parameters[lane : lane + 1], task.states, task.inputs[rows], task.dt)
        alone = engine.fly(one, one_of(table, law, rows))
        np.testing.assert_array_equal(found.signals[lane], alone.signals[0])
        np.testing.assert_array_equal(found.inputs[lane], alone.inputs[0])


@pytest.mark.parametrize("starts", [np.full(21, 12), np.arange(21)])
def test_one_law_serves_windows_of_it(starts):
    task, law = log_of(PENDULUM, 50), law_of(PENDULUM, 50)
    engine = rollouts(PENDULUM)
    found = engine.fly(batch_of(task, start_rows=starts, n_rows=25), law)
    for lane, start in enumerate(starts):
        cut = slice(start, start + 25)
        part = LinearFeedback(law.u_ref[cut], law.x_ref[cut], law.gains[cut], law.u_min, law.u_max)
        alone = engine.fly(RolloutBatch(task.parameters[lane : lane + 1], task.states, task.inputs[cut], task.dt), part)
        np.testing.assert_array_equal(found.signals[lane], alone.signals[0])


@ON_EVERY_TARGET
@pytest.mark.parametrize("n_laws", [None, 21])
def test_flights_have_the_same_bits_for_any_batch_threads_and_target(target, n_laws):
    task, law = log_of(BODY, 40), law_of(BODY, 40, n_laws)
    expected = rollouts(BODY).fly(batch_of(task), law)
    engine = rollouts(BODY, target=target)
    assert_same(engine.fly(batch_of(task), law, threads=3), expected)
    which = None if n_laws is None else np.arange(7, 12)
    part = engine.fly(batch_of(task, task.parameters[7:12]), law, feedback_of_lane=which)
    np.testing.assert_array_equal(part.signals, expected.signals[7:12])


@EVERY_MODEL
def test_the_applied_inputs_give_the_same_flight_again(model):
    task, law = log_of(model, 80), law_of(model, 80)
    engine = rollouts(model, substeps=2)
    found = engine.fly(batch_of(task, task.parameters[:1]), law)
    again = engine.trajectories(RolloutBatch(task.parameters[:1], task.states, found.inputs[0], task.dt))
    np.testing.assert_array_equal(again, found.signals)


def test_a_quaternion_and_its_opposite_are_steered_alike():
    """The gains belong to the sign that the reference has; the state's own sign is arbitrary."""
    task, law = log_of(BODY, 60), law_of(BODY, 60)
    engine = rollouts(BODY)
    opposite = task.states * np.repeat([-1, 1], [4, 3])
    found, turned = (
        engine.fly(RolloutBatch(task.parameters, x, task.inputs, task.dt), law) for x in (task.states, opposite)
    )
    np.testing.assert_array_equal(found.inputs, turned.inputs)
    np.testing.assert_array_equal(found.signals[..., 4:], turned.signals[..., 4:])


def test_angles_are_not_wrapped():
    law = LinearFeedback(np.zeros((1, 1)), [[10.0, 0.0]], [[[0.01, 0.0]]])
    found = rollouts(PENDULUM).fly(RolloutBatch([[1.0, 0.0]], [0.0, 0.0], law.u_ref, 0.01), law)
    assert found.inputs[0, 0, 0] == pytest.approx(0.1)


def test_a_flight_that_diverges_is_nan_from_there_on():
    n_rows = 400
    law = LinearFeedback(np.ones((n_rows, 1)), np.zeros((n_rows, 4)), np.zeros((n_rows, 1, 4)))
    found = rollouts(EXPLOSIVE).fly(RolloutBatch([[1.0, 0.0], [-1.0, 0.0]], np.zeros(4), law.u_ref, 0.02), law)
    ended = np.isnan(found.signals).all(axis=-1)
    np.testing.assert_array_equal(ended, np.isnan(found.inputs[..., 0]))
    assert ended[0].any()
    assert not ended[0, 0]
    assert not ended[1].any()


def test_a_law_is_left_as_it_is_and_keeps_no_hold_on_what_it_was_made_of():
    u_ref = np.zeros((5, 1))
    law = LinearFeedback(u_ref, np.zeros((5, 2)), np.zeros((5, 1, 2)))
    u_ref[:] = 7.0
    found = rollouts(PENDULUM).fly(RolloutBatch([[0.0, 0.0]], [0.0, 0.0], law.u_ref, 0.01), law)
    assert not found.inputs.any()
    assert not law.u_ref.flags.writeable


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gains": np.zeros((9, 1, 3))}, r"a feedback law needs .*found \(9, 1\), \(9, 2\) and \(9, 1, 3\)"),
        ({"x_ref": np.zeros((8, 2))}, "a feedback law needs"),
        ({"u_ref": np.zeros(9)}, "a feedback law needs"),
        ({"u_ref": np.full((9, 1), np.nan)}, "u_ref holds a NaN"),
        ({"u_min": [1.0], "u_max": [0.0]}, "leave no room"),
        ({"u_min": [np.nan]}, "leave no room"),
        ({"u_min": [0.0, 0.0]}, "u_min and u_max must be 1 numbers each"),
    ],
)
def test_a_law_that_makes_no_sense_is_refused(change, message):
    arrays = {"u_ref": np.zeros((9, 1)), "x_ref": np.zeros((9, 2)), "gains": np.zeros((9, 1, 2)), **change}
    with pytest.raises(SettingsError, match=message):
        LinearFeedback(**arrays)


def test_laws_that_do_not_fit_the_lanes_are_refused():
    task, engine = log_of(PENDULUM, 10), rollouts(PENDULUM)
    with pytest.raises(SettingsError, match="the feedback is for 7 states and 3 inputs, but the model has 2 and 1"):
        engine.fly(batch_of(task), law_of(BODY, 10))
    with pytest.raises(SettingsError, match="the batch's inputs have 10 rows, but the feedback has 9"):
        engine.fly(batch_of(task), law_of(PENDULUM, 9))
    table = law_of(PENDULUM, 10, 3)
    for which in (None, np.zeros(3, int), np.full(21, 3), np.zeros(21)):
        with pytest.raises(SettingsError, match="one integer per lane, 21 in all, from 0 to 2"):
            engine.fly(batch_of(task), table, feedback_of_lane=which)
