"""Flights for data: they go where they say, obey the dynamics, can be flown, and each seed gives another one."""

import numpy as np
import pytest
from casadi import cos

import diransac as dr
from diransac.flight.planning.trajectories import ROTORCRAFT_LIMITS
from planned import ROTORCRAFT, mass
from rolling import BODY

AXIS = dr.Plant(
    dr.models.servo_axis(), {"mass": 95.0, "viscous_friction": 200.0, "dry_friction": 20.0, "offset": -12.0}
)
DOUBLE = dr.Plant(
    dr.models.double_pendulum(),
    {
        "inertia1": 0.09, "moment1": 0.3, "inertia2": 0.025, "moment2": 0.12, "rotor_inertia": 6e-5,
        "viscous_friction1": 0.02, "dry_friction1": 0.08, "viscous_friction2": 0.02, "dry_friction2": 0.05,
    },
)  # fmt: skip


def strayed(plant, trajectory, names):
    """RMS distance from a trajectory in these states, flown under feedback."""
    errors = dr.tracking_error(trajectory, dr.fly(plant, trajectory, dr.tvlqr(plant, trajectory)))
    return np.linalg.norm([errors[name] for name in names])


# ---------------------------------------------------------------------- through random places


@pytest.fixture(scope="module", params=[1, 6])
def random_flight(request):
    return request.param, dr.random_waypoints(ROTORCRAFT, seed=request.param, speed=1.8, reach=3.2)


def test_random_places_are_met_at_the_mean_speed_from_rest_to_rest(random_flight):
    seed, found = random_flight
    drawn = np.random.default_rng(seed).uniform(-3.2, 3.2, (100, 2))
    here, time, met = np.zeros(2), 0.0, 0
    for place in drawn:
        leg = np.hypot(*(place - here)) / 1.8
        if leg < 1.0:
            continue
        here, time = place, time + leg
        if time >= 25.0:
            break
        row = np.argmin(np.abs(found.time - time))
        assert np.hypot(found["x"][row] - place[0], found["z"][row] - place[1]) < 0.05  # a row is up to 5 ms away
        met += 1
    assert 6 <= met <= 24
    assert time - leg < found.time[-1] + 0.01 < 25.02
    np.testing.assert_allclose(found.states[[0, -1], 2:], 0.0, atol=1e-6)
    np.testing.assert_allclose(found.states[0], 0.0, atol=1e-6)


def test_random_flights_keep_their_limits_and_move_their_inputs_in_every_row(random_flight):
    _, found = random_flight
    for name, (low, high) in ROTORCRAFT_LIMITS.items():
        assert low <= found[name].min() <= found[name].max() <= high
        assert np.mean(np.diff(found[name]) == 0.0) < 0.05


def test_feedback_keeps_a_random_flight_on_its_way_though_its_inputs_are_smoothed(random_flight):
    assert strayed(ROTORCRAFT, random_flight[1], "xz") < 1e-3


def test_random_flights_end_in_time_and_differ_by_their_seeds():
    first, second = (dr.random_waypoints(ROTORCRAFT, seed=seed, duration=6.0) for seed in (0, 1))
    assert max(first.time[-1], second.time[-1]) <= 6.0
    assert np.abs(first["x"][200] - second["x"][200]) > 0.05
    np.testing.assert_array_equal(dr.random_waypoints(ROTORCRAFT, seed=0, duration=6.0).states, first.states)


# ---------------------------------------------------------------------- sums of sines


@pytest.mark.parametrize("plant", [AXIS, DOUBLE], ids=["servo-axis", "double-pendulum"])
def test_the_equations_of_motion_hold_along_sines(plant):
    """With velocities and accelerations by differences of the positions alone."""
    found, n = dr.multisine(plant, seed=4, amplitude=0.3, frequency=0.9, duration=4.0), plant.model.n_q
    q, h = found.states[:, :n], found.dt

    def slope(y):
        return (y[:-4] - 8 * y[1:-3] + 8 * y[3:-1] - y[4:]) / (12 * h)

    def between_rows(y):
        return (-y[:-3] + 9 * y[1:-2] + 9 * y[2:-1] - y[3:]) / 16

    v = slope(q)
    np.testing.assert_allclose(found.states[2:-2, n:], v, atol=1e-4 * np.abs(v).max())
    q, v, a = (between_rows(y) for y in (q[4:-4], v[2:-2], slope(v)))
    p = np.array(list(plant.parameters.values()))
    residual = np.array(plant.model.residual(q.T, v.T, a.T, found.inputs[5:-6].T, p)).T
    reversing = (np.abs(v) < 0.02 * np.abs(v).max()).any(axis=1)  # where dry friction changes at once
    assert np.mean(reversing) < 0.2
    assert (np.abs(residual[~reversing]) / np.abs(found.inputs).max(axis=0)).max() < 1e-4


@pytest.mark.parametrize("plant", [AXIS, DOUBLE], ids=["servo-axis", "double-pendulum"])
def test_feedback_keeps_a_plant_on_its_sines(plant):
    found = dr.multisine(plant, seed=4, amplitude=0.3, frequency=0.9, duration=4.0)
    assert strayed(plant, found, plant.model.coordinates) < 0.01 * 0.3


def test_sines_are_as_large_as_they_say_and_keep_below_their_frequency():
    found = [dr.multisine(mass(), seed=seed, amplitude=0.3, frequency=2.0, duration=50.0)["y"] for seed in range(20)]
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(0.66 * 0.3, rel=0.1)
    assert np.abs(found).max() <= 5 * 0.6 * 0.3
    power = np.mean(np.abs(np.fft.rfft(found * np.hanning(len(found[0])), axis=1)) ** 2, axis=0)
    frequency = np.fft.rfftfreq(len(found[0]), 0.01)
    inside = (frequency > 0.35) & (frequency < 2.05)
    assert power[~inside].sum() < 1e-4 * power.sum()


def test_sines_differ_by_their_seeds_and_last_as_long_as_they_should():
    first, second = (dr.multisine(mass(), seed=seed, duration=3.0) for seed in (0, 1))
    assert first.time[-1] == pytest.approx(3.0)
    assert np.abs(first.states - second.states).max() > 0.1


# ---------------------------------------------------------------------- what is refused


def weak(equation):
    return dr.Plant(dr.Model("weak", {"y": "m"}, {"push": "N"}, {"mass": dr.Parameter("kg")}, equation), {"mass": 1.0})


@pytest.mark.parametrize(
    "plant",
    [
        ROTORCRAFT,
        dr.Plant(BODY, {"p0": 1.0, "p1": 1.5, "p2": 2.0}),
        weak(lambda q, v, a, u, p: [p.mass * a.y - u.push**2]),
        weak(lambda q, v, a, u, p: [p.mass * a.y - cos(q.y) + 0 * u.push]),
    ],
    ids=["fewer inputs", "quaternion", "square of an input", "an input of no effect"],
)
def test_sines_are_refused_where_inputs_cannot_push_every_coordinate(plant):
    with pytest.raises(dr.SettingsError, match=r'model ".*" is not fully actuated: its inputs \(.*diransac\.plan'):
        dr.multisine(plant)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"speed": 0.0}, "speed is 0.0; give a finite number above 0"),
        ({"reach": -1.0}, "reach is -1.0"),
        ({"duration": np.inf}, "duration is inf; give 0.01 to 3600 s"),
        ({"seed": -1}, "seed is -1; give a whole number of at least 0"),
        (
            {"duration": 1.0, "seed": 1},
            "first waypoint is 1.* s away at 1.6 m/s, and the trajectory lasts 1 s; give more",
        ),
        ({"reach": 0.5}, "within a reach of 0.5 m are too near for a speed of 1.6 m/s.*give a reach of 1.6 m or more"),
    ],
)
def test_random_flights_that_make_no_sense_are_refused(wrong, message):
    with pytest.raises(dr.SettingsError, match=message):
        dr.random_waypoints(ROTORCRAFT, **wrong)


def test_random_places_are_refused_where_there_is_no_plane():
    with pytest.raises(
        dr.SettingsError, match=r'random_waypoints are planned in x and z; model "mass" has no coordinate x'
    ):
        dr.random_waypoints(mass())


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"amplitude": 0}, "amplitude is 0; give a finite number above 0"),
        ({"seed": -1}, "seed is -1; give a whole number of at least 0"),
        ({"seed": 1.5}, "seed is 1.5; give a whole number"),
        ({"duration": 1e308}, "duration is 1e\\+308; give 0.01 to 3600 s"),
        ({"duration": 3600.1}, "duration is 3600.1; give"),
        ({"duration": 1e-9}, "duration is 1e-09; give"),
    ],
)
def test_sines_that_make_no_sense_are_refused(wrong, message):
    with pytest.raises(dr.SettingsError, match=message):
        dr.multisine(mass(), **wrong)
