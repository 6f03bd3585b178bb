"""Independence of lanes, and arguments that are refused."""

import pickle
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from diransac.errors import ModelError, SettingsError
from diransac.model import Model
from diransac.simulation import Measurements, RolloutBatch, rollouts
from rolling import (
    BODY,
    ON_EVERY_TARGET,
    PENDULUM,
    ROTORCRAFT,
    assert_same,
    batch_of,
    log_of,
    measurements_of,
    score_of,
)


# Windows -------------------------------------------------------------------------------------------------------------
def test_a_window_is_a_log_of_its_own():
    task = log_of(BODY, 120)
    rng = np.random.default_rng(5)
    starts = rng.integers(0, 100, 21)
    states = rng.standard_normal((21, 7))
    engine = rollouts(BODY, substeps=2)
    batch = RolloutBatch(task.parameters, states, task.inputs, task.dt, starts, 20)
    found = engine.score(batch, measurements_of(engine, task), np.full(10, 0.7), 2)
    errors = engine.errors(batch, measurements_of(engine, task))
    for lane, start in enumerate(starts):
        rows = slice(start, start + 20)
        one = RolloutBatch(task.parameters[lane : lane + 1], states[lane], task.inputs[rows], task.dt)
        seen = Measurements(task.measured[rows], task.valid[rows])
        alone = engine.score(one, seen, np.full(10, 0.7), 2)
        np.testing.assert_array_equal(found.sum_squares[lane], alone.sum_squares[0])
        assert found.inlier_count[lane] == alone.inlier_count[0]
        np.testing.assert_array_equal(errors[lane], engine.errors(one, seen)[0])


def test_lanes_with_a_common_window_are_those_of_the_cut_log():
    task = log_of(ROTORCRAFT, 90)
    engine = rollouts(ROTORCRAFT)
    found = score_of(engine, task, start_rows=np.full(21, 30), n_rows=40)
    cut = SimpleNamespace(**{**vars(task), **{k: getattr(task, k)[30:70] for k in ("inputs", "measured", "valid")}})
    assert_same(found, score_of(engine, cut))
    assert_same(score_of(engine, task, n_rows=40), score_of(engine, task, start_rows=np.zeros(21, int), n_rows=40))


# The same bits -------------------------------------------------------------------------------------------------------
@ON_EVERY_TARGET
@pytest.mark.parametrize("model", [ROTORCRAFT, BODY], ids=lambda model: model.name)
def test_scores_have_the_same_bits_for_any_batch_threads_and_target(model, target):
    task = log_of(model, 150)
    expected = score_of(rollouts(model), task)
    engine = rollouts(model, target=target)
    assert_same(score_of(engine, task, threads=3), expected)
    for first, end in ((0, 1), (7, 9), (4, 21), (20, 21)):
        part = score_of(engine, task, task.parameters[first:end])
        np.testing.assert_array_equal(part.sum_squares, expected.sum_squares[first:end])
        np.testing.assert_array_equal(part.inlier_count, expected.inlier_count[first:end])


@ON_EVERY_TARGET
def test_series_have_the_same_bits_for_any_batch_threads_and_target(target):
    task = log_of(BODY, 50)
    expected = rollouts(BODY).trajectories(batch_of(task))
    engine = rollouts(BODY, ("q0", "v2_dot"), target=target)
    np.testing.assert_array_equal(engine.trajectories(batch_of(task), threads=2), expected)
    np.testing.assert_array_equal(engine.trajectories(batch_of(task, task.parameters[11:13])), expected[11:13])


def test_what_is_scored_does_not_change_what_is_simulated():
    task = log_of(ROTORCRAFT, 80)
    everything = score_of(rollouts(ROTORCRAFT), task)
    first_two = score_of(rollouts(ROTORCRAFT, ("q0", "q1")), task)
    np.testing.assert_array_equal(first_two.sum_squares, everything.sum_squares[:, :2])


def test_callers_in_several_threads_get_the_same_scores():
    task = log_of(PENDULUM, 100)
    engine = rollouts(PENDULUM, integrator="euler", substeps=2)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: score_of(engine, task, threads=2), range(8)))
    for scores in found:
        assert_same(scores, found[0])


# What users meet -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("copy", [lambda x: Model.from_dict(x.to_dict()), lambda x: pickle.loads(pickle.dumps(x))])
def test_rollouts_of_equal_models_are_compiled_once(copy):
    again = copy(PENDULUM)
    assert again is not PENDULUM
    assert rollouts(again) is rollouts(PENDULUM)
    assert rollouts(PENDULUM, ("q0",)) is not rollouts(PENDULUM)
    assert rollouts(PENDULUM, substeps=2) is not rollouts(PENDULUM)


def test_scores_keep_their_batch():
    task = log_of(PENDULUM, 10)
    scores = score_of(rollouts(PENDULUM), task, n_rows=5)
    np.testing.assert_array_equal(scores.batch.parameters, task.parameters)
    assert scores.inliers(20).shape == (scores.batch.rows_per_lane,) == (5,)


def test_no_lanes_give_empty_scores():
    task = log_of(PENDULUM, 10)
    scores = score_of(rollouts(PENDULUM), task, np.empty((0, 2)))
    assert scores.sum_squares.shape == (0, 3)
    assert scores.inlier_count.shape == scores.diverged.shape == (0,)


def test_arrays_are_left_as_they_are():
    task = log_of(BODY, 30)
    before = {name: np.array(value) for name, value in vars(task).items()}
    for value in vars(task).values():
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
    score_of(rollouts(BODY), task, start_rows=np.arange(21) % 5, n_rows=20)
    for name, value in vars(task).items():
        np.testing.assert_array_equal(value, before[name])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parameters": np.ones((5, 3))}, r"parameters has shape \(5, 3\), but \(any, 2\) is needed"),
        ({"states": np.ones(3)}, r"initial_states has shape \(3,\)"),
        ({"states": np.ones((4, 2))}, r"initial_states has shape \(4, 2\), but \(21, any\)"),
        ({"inputs": np.ones(20)}, "inputs has shape"),
        ({"measured": np.ones((19, 3))}, "valid must be 19 Booleans"),
        ({"measured": np.full((20, 3), np.nan)}, "NaN or an infinity in a valid row"),
        ({"measured": np.ones((19, 3)), "valid": np.ones(19, bool)}, r"values has shape \(19, 3\), but \(20, 3\)"),
        ({"valid": np.ones(20)}, "20 Booleans"),
        ({"dt": 0.0}, "dt is 0.0"),
        ({"start_rows": np.zeros(21, int)}, "start_rows is given without n_rows"),
        ({"start_rows": np.zeros(3, int), "n_rows": 5}, "one integer per lane, 21 in all"),
        ({"start_rows": np.full(21, 16), "n_rows": 5}, "do not lie within the log's 20 rows"),
        ({"n_rows": 21}, "n_rows is 21, but the log has 20 rows"),
        ({"threads": 0}, "threads is 0"),
        ({"thresholds": -1.0}, "each must be 0"),
    ],
)
def test_what_cannot_be_run_is_refused_with_what_was_found(change, message):
    task = log_of(PENDULUM, 20)
    options = {k: change.pop(k) for k in list(change) if k in ("start_rows", "n_rows", "threads", "thresholds")}
    task = SimpleNamespace(**{**vars(task), **change})
    with pytest.raises(SettingsError, match=message):
        score_of(rollouts(PENDULUM), task, **options)


def test_unknown_names_are_refused():
    with pytest.raises(SettingsError, match=r"altitude.*it has q0, v0, v0_dot"):
        rollouts(PENDULUM, ("q0", "altitude"))
    with pytest.raises(SettingsError, match="once"):
        rollouts(PENDULUM, ("q0", "q0"))
    with pytest.raises(SettingsError, match="'rk5' is unknown; choose one of rk4"):
        rollouts(PENDULUM, integrator="rk5")
    with pytest.raises(SettingsError, match="substeps is 0"):
        rollouts(PENDULUM, substeps=0)


def test_dynamics_that_cannot_be_compiled_are_refused():
    x = ca.MX.sym("x", 2)
    u, p = ca.MX.sym("u"), ca.MX.sym("p", 2)
    mx = SimpleNamespace(name="pendulum", signals=PENDULUM.signals, dynamics=ca.Function("d", [x, u, p], [x, x[1]]))
    with pytest.raises(ModelError, match="'pendulum' are not made of SX symbols"):
        rollouts(mx)
