"""`Controller` and the arguments of `tvlqr`: forms of weights, limits, time grids, what is refused."""

import pickle
from types import SimpleNamespace

import numpy as np
import pytest

import diransac as dr
from diransac.errors import ModelError, SettingsError
from diransac.model.plant import Plant
from diransac.simulation import RolloutBatch, rollouts
from steering import PENDULUM, ROTORCRAFT, moving, resting

LIMITS = {"thrust": (0.0, 6.0), "moment": (-0.5, 0.5)}
STATES = ROTORCRAFT.model.state


def controller_of(n_rows=50, dt=0.01):
    return dr.tvlqr(ROTORCRAFT, moving("rotorcraft", n_rows, dt))


def parts(controller):
    """What a controller is made from, as keyword arguments."""
    return {name: getattr(controller, name) for name in controller.__dataclass_fields__}


# The controller ------------------------------------------------------------------------------------------------------
def test_a_controller_has_the_trajectorys_rows_and_a_gain_for_each():
    trajectory = moving("rotorcraft", 50)
    controller = dr.tvlqr(ROTORCRAFT, trajectory)
    for name in ("time", "states", "inputs"):
        np.testing.assert_array_equal(getattr(controller, name), getattr(trajectory, name))
    assert controller.gains.shape == (50, 2, 6)
    assert (controller.state_names, controller.input_names) == (STATES, ("thrust", "moment"))
    assert (len(controller), controller.dt) == (50, pytest.approx(0.01))


def test_a_controller_survives_pickling_and_its_arrays_cannot_be_written():
    controller = controller_of()
    again = pickle.loads(pickle.dumps(controller))
    for name, value in parts(controller).items():
        np.testing.assert_array_equal(getattr(again, name), value)
    for array in (controller.gains, again.gains, again.time, again.u_min):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0


def test_the_law_is_the_clipped_feedback_of_every_row():
    controller = dr.tvlqr(ROTORCRAFT, moving("rotorcraft", 200), limits=LIMITS)
    start = controller.states[0] + [1.0, -1.0, 0.5, 0.0, 0.0, 0.0]
    engine = rollouts(ROTORCRAFT.model)
    batch = RolloutBatch([list(ROTORCRAFT.parameters.values())], start, controller.inputs, controller.dt)
    flown = engine.fly(batch, controller.law())
    errors = flown.signals[0, :, :6] - controller.states
    wanted = controller.inputs - np.einsum("kui,ki->ku", controller.gains, errors)
    expected = np.clip(wanted, [0.0, -0.5], [6.0, 0.5])
    assert (expected != wanted).any(axis=0).all()
    np.testing.assert_allclose(flown.inputs[0], expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"time": np.zeros(50)}, "time must increase evenly"),
        ({"time": np.arange(50.0) ** 2}, "time must increase evenly"),
        ({"time": np.arange(49.0)}, r"a controller needs time \(K,\).*found \(49,\), \(50, 6\), \(50, 2\)"),
        ({"gains": np.zeros((50, 2, 5))}, r"found \(50, 2\), \(50, 6\) and \(50, 2, 5\)"),
        ({"gains": np.full((50, 2, 6), np.nan)}, "gains holds a NaN"),
        ({"u_min": np.full(2, 9.0), "u_max": np.full(2, -9.0)}, "leave no room"),
        ({"state_names": ("x", "z")}, "6 states and 2 state_names"),
        ({"input_names": ("x",)}, "2 inputs and 1 input_names"),
    ],
)
def test_a_controller_of_parts_that_do_not_fit_is_refused(change, message):
    with pytest.raises(SettingsError, match=message):
        dr.Controller(**{**parts(controller_of()), **change})


# Another time grid ---------------------------------------------------------------------------------------------------
def test_a_controller_on_its_own_time_is_itself():
    """Also where that time was summed up in another way, and lies before it by a rounding error."""
    controller = controller_of(300)
    summed = np.cumsum(np.full(300, controller.dt)) - controller.dt
    assert (summed < controller.time).any()
    again = controller.at(summed)
    np.testing.assert_allclose(again.gains, controller.gains, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(again.states, controller.states, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(again.inputs, controller.inputs)


def test_rows_are_held_to_the_next_on_a_finer_grid():
    controller = controller_of()
    fine = controller.at(controller.dt / 4 * np.arange(200))
    for name in ("gains", "states", "inputs"):
        np.testing.assert_array_equal(getattr(fine, name), np.repeat(getattr(controller, name), 4, axis=0))


def test_a_controller_stays_what_it_is_before_its_start_and_after_its_end():
    controller = controller_of()
    wide = controller.at([-1.0, 0.0, 1.0, 2.0])
    rows = [0, 0, 49, 49]
    for name in ("gains", "states", "inputs"):
        np.testing.assert_array_equal(getattr(wide, name), getattr(controller, name)[rows])


def test_a_time_grid_that_makes_no_sense_is_refused():
    controller = controller_of()
    for time in ([0.3, 0.2], [0.0, 0.1, 0.3], [0.1], [[0.0, 0.1]], [0.0, np.nan]):
        with pytest.raises(SettingsError, match="time must increase evenly"):
            controller.at(time)


# Weights -------------------------------------------------------------------------------------------------------------
def test_the_default_weights_are_brysons_rule():
    """Half a metre, half a radian, 1 m/s or 1 rad/s is worth the full use of an input: half its range, or 1."""
    trajectory = resting("rotorcraft", 40, limits={"thrust": (0.0, 6.0)})
    found = dr.tvlqr(ROTORCRAFT, trajectory).gains
    Q = np.diag([4.0, 4.0, 4.0, 1.0, 1.0, 1.0])
    expected = dr.tvlqr(ROTORCRAFT, trajectory, Q, np.diag([1 / 3.0**2, 1.0]), Q).gains
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)


def test_weights_may_be_a_matrix_a_diagonal_a_number_or_go_by_name():
    trajectory = moving("rotorcraft", 40)
    ways = [
        (np.diag([3.0, 0, 0, 0, 0, 2.0]), 0.5 * np.eye(2), np.zeros((6, 6))),
        ([3.0, 0, 0, 0, 0, 2.0], [0.5, 0.5], np.zeros(6)),
        ({"theta_dot": 2.0, "x": 3.0}, 0.5, 0.0),
        ({"theta_dot": 2.0, "x": 3.0}, {"thrust": 0.5, "moment": 0.5}, {}),
    ]
    first, *others = (dr.tvlqr(ROTORCRAFT, trajectory, *weights).gains for weights in ways)
    assert (first != 0).any()
    for other in others:
        np.testing.assert_array_equal(other, first)


def test_the_final_weight_is_a_second_of_the_running_one_by_default():
    trajectory, Q = moving("rotorcraft", 40), {"x": 3.0, "theta": 1.0}
    found, expected = (dr.tvlqr(ROTORCRAFT, trajectory, Q, 1.0, Qf).gains for Qf in (None, Q))
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ({"Q": {"y": 1.0}}, 'Q weighs "y"; there are x, z, theta, x_dot, z_dot, theta_dot'),
        ({"R": {"thrust": 1.0}}, "R must be positive definite: each input needs a positive weight"),
        ({"R": 0.0}, "R must be positive definite"),
        ({"R": [[1.0, 2.0], [2.0, 1.0]]}, "R must be positive semidefinite; its smallest eigenvalue is -1"),
        ({"Q": -1.0}, "Q must be positive semidefinite; its smallest eigenvalue is -1"),
        ({"Qf": [1.0, 1, 1, 1, 1, -0.5]}, "Qf must be positive semidefinite"),
        ({"Q": np.eye(5)}, r"Q must be a matrix \(6, 6\), its diagonal \(6,\), one number.*found shape \(5, 5\)"),
        ({"R": np.ones(3)}, r"R must be a matrix \(2, 2\)"),
        ({"R": [[1.0, 0.5], [0.0, 1.0]]}, "R must be finite and symmetric"),
        ({"Q": np.full(6, np.nan)}, "Q must be finite and symmetric"),
        ({"Q": {"x": np.inf}}, "Q must be finite and symmetric"),
        ({"Q": "heavy"}, "Q is 'heavy', which is not an array of numbers"),
        ({"Q": [[1.0], [1.0, 2.0]]}, "which is not an array of numbers"),
        ({"limits": {"lift": (0.0, 1.0)}}, 'limits name "lift"; inputs are thrust, moment'),
        ({"limits": {"thrust": (2.0, 1.0)}}, r"each must be \(lowest, highest\)"),
        ({"limits": {"thrust": 2.0}}, r"each must be \(lowest, highest\)"),
        ({"limits": {"thrust": (np.nan, 1.0)}}, r"each must be \(lowest, highest\)"),
    ],
)
def test_weights_and_limits_that_make_no_sense_are_refused(weights, message):
    with pytest.raises(SettingsError, match=message):
        dr.tvlqr(ROTORCRAFT, moving("rotorcraft", 10), **weights)


# Limits, plants, trajectories ----------------------------------------------------------------------------------------
def test_limits_are_the_trajectorys_unless_others_are_given():
    trajectory = resting("rotorcraft", 20, limits={"thrust": (0.0, 6.0)})
    controller = dr.tvlqr(ROTORCRAFT, trajectory)
    np.testing.assert_array_equal([controller.u_min, controller.u_max], [[0.0, -np.inf], [6.0, np.inf]])
    controller = dr.tvlqr(ROTORCRAFT, trajectory, limits={"moment": (-1.0, 0.5)})
    np.testing.assert_array_equal([controller.u_min, controller.u_max], [[-np.inf, -1.0], [np.inf, 0.5]])
    assert np.isinf(dr.tvlqr(ROTORCRAFT, trajectory, limits={}).u_max).all()


def test_limits_change_no_gain_where_weights_are_given():
    trajectory = moving("rotorcraft", 20)
    free, limited = (dr.tvlqr(ROTORCRAFT, trajectory, 1.0, 1.0, limits=limits).gains for limits in ({}, LIMITS))
    np.testing.assert_array_equal(free, limited)


def test_the_names_of_parameters_count_not_their_order():
    trajectory = moving("rotorcraft", 20)
    turned = Plant(ROTORCRAFT.model, dict(reversed(ROTORCRAFT.parameters.items())))
    np.testing.assert_array_equal(dr.tvlqr(turned, trajectory).gains, dr.tvlqr(ROTORCRAFT, trajectory).gains)


def test_what_has_a_model_and_parameters_serves_as_a_plant():
    trajectory = moving("rotorcraft", 20)
    result = SimpleNamespace(model=ROTORCRAFT.model, parameters=ROTORCRAFT.parameters)
    np.testing.assert_array_equal(dr.tvlqr(result, trajectory).gains, dr.tvlqr(ROTORCRAFT, trajectory).gains)
    with pytest.raises(SettingsError, match=r"give a dr\.Plant or a dr\.Result"):
        dr.tvlqr(ROTORCRAFT.model, trajectory)


def test_equal_models_are_compiled_once_and_different_ones_do_not_share_a_call():
    trajectory = moving("rotorcraft", 20)
    again = Plant(dr.models.planar_rotorcraft(), ROTORCRAFT.parameters)
    found = dr.tvlqr_batch([ROTORCRAFT, again], [trajectory, trajectory])
    np.testing.assert_array_equal(found[0].gains, found[1].gains)
    longer = Plant(dr.models.planar_rotorcraft(arm_length=0.2), ROTORCRAFT.parameters)
    with pytest.raises(SettingsError, match="the plants have different models"):
        dr.tvlqr_batch([ROTORCRAFT, longer], [trajectory, trajectory])
    assert np.abs(dr.tvlqr(longer, trajectory).gains - found[0].gains).max() > 1e-3


def test_plants_and_trajectories_come_in_pairs():
    assert dr.tvlqr_batch([], []) == []
    with pytest.raises(SettingsError, match="there are 2 plants and 1 trajectories"):
        dr.tvlqr_batch([ROTORCRAFT] * 2, [moving("rotorcraft", 20)])


def test_a_trajectory_of_another_model_is_refused():
    with pytest.raises(
        SettingsError, match='states are q1, q2, q1_dot, q2_dot, but model "planar-rotorcraft" has x, z'
    ):
        dr.tvlqr(ROTORCRAFT, moving("pendulum", 20))
    nameless = dr.Trajectory(np.arange(5), np.zeros((5, 4)), np.zeros((5, 1)))
    with pytest.raises(SettingsError, match=r"inputs are 1 columns, but model .* has torque1, torque2"):
        dr.tvlqr(PENDULUM, nameless)


def test_a_model_without_inputs_cannot_be_steered():
    falling = dr.Model("falling", {"z": "m"}, {}, {"g": dr.Parameter()}, lambda q, v, a, u, p: [a.z + p.g])
    trajectory = dr.Trajectory(np.arange(5), np.zeros((5, 2)), np.zeros((5, 0)))
    with pytest.raises(SettingsError, match='"falling" has no inputs; a controller needs at least one'):
        dr.tvlqr(Plant(falling, {"g": 9.81}), trajectory)


def test_a_plant_without_its_parameters_is_refused():
    with pytest.raises(ModelError, match="parameters are mass, inertia, drag; found mass"):
        dr.tvlqr(SimpleNamespace(model=ROTORCRAFT.model, parameters={"mass": 1.0}), moving("rotorcraft", 10))
