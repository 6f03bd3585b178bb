"""Scores and errors of rollouts against a log."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from diransac.simulation import Measurements, RolloutBatch, inlier_mask, rollouts
from rolling import (
    BODY,
    EXPLOSIVE,
    PENDULUM,
    ROTORCRAFT,
    assert_same,
    batch_of,
    log_of,
    measurements_of,
    plain_trajectory,
    score_of,
)


# Scores --------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("signals", [None, ("v1_dot", "q0", "v2"), ("q0", "q1", "q2", "q3", "v0_dot")])
def test_scores_are_those_of_the_errors(signals):
    task = log_of(BODY, 200)
    task.measured[~task.valid] = np.nan
    engine = rollouts(BODY, signals)
    scores = score_of(engine, task, thresholds=0.4)
    errors = engine.errors(batch_of(task), measurements_of(engine, task))
    counted = np.where(task.valid[:, None], errors, 0.0)
    np.testing.assert_array_equal(scores.sum_squares, np.cumsum(counted**2, axis=1)[:, -1])
    mask = inlier_mask(errors, task.valid, np.full(len(engine.signals), 0.4), 2)
    np.testing.assert_array_equal(scores.inlier_count, mask.sum(axis=1))
    np.testing.assert_array_equal([scores.inliers(lane) for lane in range(len(mask))], mask)
    assert 0 < mask.mean() < 0.9
    assert not scores.diverged.any()


def test_errors_are_simulated_less_measured():
    task = log_of(ROTORCRAFT, 50)
    measured = task.measured[:, :2]
    errors = rollouts(ROTORCRAFT, ("v2", "q1")).errors(batch_of(task), Measurements(measured, task.valid))
    simulated = rollouts(ROTORCRAFT).trajectories(batch_of(task))
    np.testing.assert_array_equal(errors, simulated[..., [5, 1]] - measured)


def test_a_quaternion_is_compared_whatever_its_sign():
    task = log_of(BODY, 100)
    engine, batch = rollouts(BODY), batch_of(task, task.parameters[:1])
    (truth,) = engine.trajectories(batch)
    flipped = truth.copy()
    flipped[::3, :4] *= -1
    errors = engine.errors(batch, Measurements(flipped, task.valid))
    assert np.abs(errors).max() == 0.0
    three = rollouts(BODY, ("q0", "q1", "q2"))  # not the whole quaternion: taken as it is
    errors = three.errors(batch, Measurements(flipped[:, :3], task.valid))
    np.testing.assert_array_equal(errors[0, ::3], 2 * truth[::3, :3])


def test_thresholds_are_strict_and_zero_switches_a_signal_off():
    engine = rollouts(PENDULUM, ("q0", "v0"))
    batch = RolloutBatch([[0.0, 0.0]], [0.0, 0.0], np.zeros((4, 1)), 0.01)
    measurements = Measurements([[0.5, 0], [0.4, 0], [0, 0], [0, 1]], np.ones(4, bool))
    counts = [
        engine.score(batch, measurements, thresholds, least).inlier_count[0]
        for thresholds, least in (([0.5, 0.1], 2), ([0.5, 0.1], 1), ([0.5, 0.0], 1), ([0.0, 0.0], 1), ([0.0, 0.0], 0))
    ]
    assert counts == [2, 4, 3, 0, 4]


@given(st.floats(1e-150, 1e150), st.integers(-3, 3))
@settings(max_examples=50, deadline=None)
def test_squares_keep_the_order_of_errors_and_thresholds(threshold, steps):
    error = threshold
    for _ in range(abs(steps)):
        error = np.nextafter(error, np.copysign(np.inf, steps))
    batch = RolloutBatch([[0.0, 0.0]], [0.0, 0.0], np.zeros((1, 1)), 0.01)
    scores = rollouts(PENDULUM, ("q0",)).score(batch, Measurements([[error]], [True]), [threshold], 1)
    assert scores.inlier_count[0] == (error < threshold)


# Divergence ----------------------------------------------------------------------------------------------------------
def test_a_divergence_makes_every_sum_infinite_and_all_later_rows_outliers():
    n_rows = 400
    p = np.array([[1.0, 0.0], [-1.0, 0.0], [4.0, 0.0]])
    inputs, valid, measured = np.full((n_rows, 1), 1.0), np.ones(n_rows, bool), np.zeros((n_rows, 1))
    engine = rollouts(EXPLOSIVE, ("q1",))  # the second coordinate never moves; the first, unscored, explodes
    batch, measurements = RolloutBatch(p, np.zeros(4), inputs, 0.02), Measurements(measured, valid)
    scores = engine.score(batch, measurements, [0.1], 1)
    np.testing.assert_array_equal(scores.diverged, [True, False, True])
    np.testing.assert_array_equal(scores.sum_squares[:, 0], [np.inf, 0.0, np.inf])
    errors = engine.errors(batch, measurements)
    with np.errstate(all="ignore"):
        plain = [plain_trajectory(EXPLOSIVE, row, np.zeros(4), inputs, 0.02) for row in p]
    finite = [np.logical_and.accumulate(np.isfinite(rows).all(axis=1)) for rows in plain]
    np.testing.assert_array_equal(~np.isnan(errors[..., 0]), finite)
    np.testing.assert_array_equal(scores.inlier_count, [rows.sum() for rows in finite])
    assert 0 < scores.inlier_count[0] < n_rows


def test_a_divergence_that_only_an_acceleration_shows_counts():
    engine = rollouts(EXPLOSIVE, ("q1",))
    batch = RolloutBatch([[1.0, 0.0]], [1e120, 0, 0, 0], np.zeros((1, 1)), 0.01)
    found = engine.score(batch, Measurements([[0.0]], [True]), [1.0], 1)
    assert found.diverged.all()
    assert np.isinf(found.sum_squares).all()
    assert found.inlier_count[0] == 0


def test_a_block_of_diverged_lanes_does_not_disturb_the_others():
    task = log_of(EXPLOSIVE, 300)
    p = np.tile([[2.0, 0.1]], (24, 1))
    p[3], p[20] = [-1.0, 0.1], [-2.0, 0.1]
    engine = rollouts(EXPLOSIVE)
    together = score_of(engine, task, p)
    np.testing.assert_array_equal(np.flatnonzero(~together.diverged), [3, 20])
    for lane in (3, 20, 5):
        alone = score_of(engine, task, p[lane : lane + 1])
        np.testing.assert_array_equal(alone.sum_squares[0], together.sum_squares[lane])
        assert alone.inlier_count[0] == together.inlier_count[lane]


def test_invalid_rows_are_simulated_through_but_not_counted():
    task = log_of(PENDULUM, 100)
    task.measured[~task.valid] = np.nan
    engine = rollouts(PENDULUM)
    scores = score_of(engine, task)
    none = engine.score(batch_of(task), Measurements(task.measured, np.zeros(100, bool)), np.ones(3), 1)
    np.testing.assert_array_equal(none.sum_squares, 0.0)
    np.testing.assert_array_equal(none.inlier_count, 0)
    assert np.isfinite(scores.sum_squares).all()
    measured = np.where(task.valid[:, None], task.measured, 1e9)
    again = engine.score(batch_of(task), Measurements(measured, task.valid), np.full(3, 0.7), 2)
    assert_same(again, scores)
