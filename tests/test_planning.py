"""Plans: they are optimal where the optimum is known, they obey the dynamics, and they do what was asked for."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import diransac as dr
from diransac.flight.planning.stage import stage_of
from diransac.flight.planning.trajectories import CORNERS, ROTORCRAFT_LIMITS
from diransac.simulation import RolloutBatch, rollouts
from planned import LIMITS, ROTORCRAFT, across, defects, mass, rotorcraft
from rolling import BODY, plain_step
from simulated import ROTORCRAFT as BY_HAND
from simulated import runge_kutta_step

FLIGHTS = {"square": dr.square, "star": dr.star, "sine": dr.sine}


@pytest.fixture(scope="module", params=FLIGHTS)
def flight(request):
    return request.param, FLIGHTS[request.param](ROTORCRAFT)


# ---------------------------------------------------------------------- optimal where the optimum is known


def test_least_effort_of_a_mass_is_the_closed_form():
    distance, duration, kilograms, n = 1.5, 2.0, 2.0, 20
    found = dr.plan(mass(kilograms), waypoints=[{}, {"y": distance}], times=[0.0, duration])
    # Force linear in time: 12 d^2 m^2 / T^3; held over n intervals the midpoints vary by (1 - 1/n^2) T^2 / 12.
    expected = 12 * distance**2 * kilograms**2 / duration**3 / (1 - 1 / n**2)
    assert found.cost == pytest.approx(expected, rel=1e-9)
    share = found.time / duration
    np.testing.assert_allclose(found["y"], distance * share**2 * (3 - 2 * share), atol=distance / n**2)


@pytest.mark.parametrize("distance", [0.3, 1.0, 1.7])
def test_fastest_move_of_a_mass_is_bang_bang(distance):
    kilograms, force = 2.0, 3.0
    found = dr.plan(
        mass(kilograms),
        waypoints=[{}, {"y": distance}],
        input_limits={"force": (-force, force)},
        input_weights={"force": 0.0},
    )
    fastest = 2 * np.sqrt(distance * kilograms / force)
    assert fastest <= found.time[-1] < fastest + 0.0201  # the rounding up to rows, and a row for the grid of the inputs
    assert found.cost == pytest.approx(found.time[-1])
    assert found["y"][-1] == pytest.approx(distance, abs=1e-6)


def test_free_durations_balance_time_with_effort():
    # T + c / T^3 with c = 12 d^2 m^2 is least at (3 c)^(1/4); the rows round it up.
    found = dr.plan(mass(1.0), waypoints=[{}, {"y": 2.0}])
    assert found.time[-1] == pytest.approx((3 * 12 * 2.0**2) ** 0.25, abs=0.0201)


def test_following_a_reference_is_linear_least_squares():
    """Against the plain solution of the same problem for a mass: every matrix written out, one linear solve."""
    duration, n, h, weight = 2.0, 20, 0.1, 7.0

    def wanted(t):
        return np.sin(3.0 * t)

    found = dr.plan(
        mass(1.0),
        reference={"y": wanted},
        duration=duration,
        state_weights={"y": weight},
        input_weights={"force": 0.5},
        start_end_at_rest=False,
    )
    start = np.arange(n + 1) * h
    after = start[:, None] - start[None, :-1]
    pushed = np.clip(after, 0, h)  # how long each force has acted at each knot
    position = np.where(after > 0, pushed**2 / 2 + pushed * np.clip(after - h, 0, None), 0.0)
    quadrature = h * np.r_[0.5, np.ones(n - 1), 0.5]
    design = np.vstack(
        [
            np.sqrt(weight * quadrature)[:, None] * np.column_stack([position, start]),
            np.sqrt(0.5 * h) * np.eye(n, n + 1),
        ]
    )
    target = np.r_[np.sqrt(weight * quadrature) * wanted(start), np.zeros(n)]
    # y starts and ends on the reference; the initial velocity is free.
    end = np.append(position[-1], start[-1])
    system = np.block([[design.T @ design, end[:, None]], [end[None], np.zeros((1, 1))]])
    solution = np.linalg.solve(system, np.append(design.T @ target, wanted(duration)))[:-1]
    np.testing.assert_allclose(found.inputs[:-1:10, 0], solution[:-1], atol=1e-6)
    assert found.cost == pytest.approx(np.sum((design @ solution - target) ** 2), rel=1e-8)


def test_arriving_twice_as_fast_costs_more():
    slow, fast = (across(ROTORCRAFT, times=np.array([0.0, 1.2, 3.2]) / speed) for speed in (1.0, 2.0))
    assert fast.cost > 2 * slow.cost


# ---------------------------------------------------------------------- they obey the dynamics


def test_rows_are_what_a_simulation_gives(flight):
    _, found = flight
    p = np.array(list(BY_HAND.truth.values()))
    assert defects(lambda x, u: runge_kutta_step(BY_HAND, x, u, p, 0.01)[1], found).max() < 1e-9
    flown = rollouts(ROTORCRAFT.model).trajectories(RolloutBatch(p[None], found.states[0], found.inputs, found.dt))[0]
    np.testing.assert_allclose(np.asarray(flown)[:, :6], found.states, atol=1e-5)


def test_quaternions_turn_as_a_simulation_does():
    half, parameters = np.sqrt(0.5), {"p0": 1.0, "p1": 1.5, "p2": 2.0}
    away = {"q0": half, "q1": half, "q2": 0.0, "q3": 0.0}
    home = {"q0": 1.0, "q1": 0.0, "q2": 0.0, "q3": 0.0}
    found = dr.plan(dr.Plant(BODY, parameters), waypoints=[home, away], times=[0.0, 1.5])
    p = np.array(list(parameters.values()))
    assert defects(lambda x, u: plain_step(BODY, p, x, u, 0.01), found).max() < 1e-8
    np.testing.assert_allclose(found.states[-1], [half, half, 0, 0, 0, 0, 0], atol=1e-6)
    # A turn about one main axis is the mass's move with its angle and inertia.
    assert found.cost == pytest.approx(12 * (np.pi / 2) ** 2 / 1.5**3 / (1 - 1 / 15**2), rel=1e-3)


# ---------------------------------------------------------------------- they do what was asked for


def test_waypoints_are_met_and_limits_kept():
    found = across(ROTORCRAFT, state_limits={"x_dot": (-9.0, 1.3), "theta": (-0.4, 0.4)}, input_limit_fraction=0.5)
    np.testing.assert_allclose(found.columns(["x", "z"])[[0, 83, 216]], [[0, 0], [0.7, 1], [2, 1]], atol=1e-6)
    np.testing.assert_allclose(found.states[[0, -1], 2:], 0.0, atol=1e-6)
    assert found["thrust"].min() >= 1.25
    assert found["thrust"].max() <= 3.75
    knots = np.r_[0:83:10, 83:217:10]
    assert found["x_dot"][knots].max() <= 1.3 + 1e-2  # between knots the limit isn't asked for
    assert np.abs(found["theta"]).max() <= 0.4 + 1e-2
    assert across(ROTORCRAFT, input_limit_fraction=0.5)["x_dot"].max() > 1.4
    assert dict(found.input_limits) == LIMITS


def test_effort_on_one_input_saves_that_input():
    plain, saving = across(ROTORCRAFT), across(ROTORCRAFT, input_weights={"moment": 100.0})
    assert np.square(saving["moment"]).sum() < 0.9 * np.square(plain["moment"]).sum()


def test_free_times_pass_every_waypoint():
    found = across(ROTORCRAFT, times=None)
    distance = np.hypot(found["x"] - 0.7, found["z"] - 1.0)
    assert distance.min() < 1e-6
    np.testing.assert_allclose(found.states[-1], [2.0, 1.0, 0, 0, 0, 0], atol=1e-6)
    assert found.cost <= across(ROTORCRAFT).cost + 2.16  # of a given duration, whose every second costs 1


def test_flights_are_those_of_the_paper():
    square, star, sine = (flight(ROTORCRAFT) for flight in FLIGHTS.values())
    assert [len(t) for t in (square, star, sine)] == [1178, 2532, 1201]
    for trajectory in (square, star, sine):
        assert trajectory.dt == pytest.approx(0.01)
        np.testing.assert_allclose(trajectory.states[[0, -1], 2:], 0.0, atol=1e-6)
        assert dict(trajectory.input_limits) == ROTORCRAFT_LIMITS
        hover = 0.249 * 9.81
        assert trajectory["thrust"].min() >= 0.2 * hover - 1e-9
        assert trajectory["thrust"].max() <= hover + 0.8 * (5.0 - hover) + 1e-9
        assert np.abs(trajectory["moment"]).max() <= 0.8 + 1e-9
        assert np.abs(trajectory["theta"]).max() < 1.0
    radius = np.hypot(*CORNERS[0])
    turned = [(0.0, radius), (radius, 0.0), (0.0, -radius), (-radius, 0.0)]
    for corners, trajectory in ((CORNERS, square), ((*CORNERS, *turned), star)):
        for x, z in corners:
            assert np.hypot(trajectory["x"] - x, trajectory["z"] - z).min() < 1e-6
    distance = sine["z"] - 2.0 * np.sin(2 * np.pi * sine.time * (8.0 / 12.0) / 4.0)
    assert np.sqrt(np.mean(distance**2)) < 0.15


def test_a_nearer_plan_costs_more_effort():
    near, far = (dr.sine(ROTORCRAFT), dr.plan(
        ROTORCRAFT,
        reference={"x": np.linspace(0.0, 8.0, 3), "z": lambda t: 2.0 * np.sin(np.pi * t / 3.0)},
        duration=12.0,
        state_weights={"x": 1.0, "z": 1.0},
        input_limits=LIMITS,
    ))  # fmt: skip
    reference = 2.0 * np.sin(np.pi * near.time / 3.0)
    assert np.abs(near["z"] - reference).mean() < 0.5 * np.abs(far["z"] - reference).mean()
    assert np.var(near["moment"]) > np.var(far["moment"])


# ---------------------------------------------------------------------- one model, many numbers


def test_a_model_is_compiled_once_for_many_parameters():
    across(ROTORCRAFT)
    before = stage_of.cache_info().misses
    costs = [across(rotorcraft(mass=m), input_limits=LIMITS, trim={"thrust": 2.4, "moment": 0.0}).cost
             for m in (0.24, 0.25, 0.26)]  # fmt: skip
    assert stage_of.cache_info().misses == before
    assert len(set(costs)) == 3


def test_a_guess_leads_to_the_same_plan():
    found = across(ROTORCRAFT)
    again = across(ROTORCRAFT, guess=found)
    assert again.cost == pytest.approx(found.cost, rel=1e-7)
    np.testing.assert_allclose(again.states, found.states, atol=1e-4)


@pytest.mark.parametrize("share", [1 / 30, 1 / 50])
def test_parameters_that_are_far_off_still_have_their_plan(share):
    """What least squares makes of a log with vibration: it can be flown as well as any, but its dynamics are curved."""
    plan = dr.sine(rotorcraft(inertia=0.004 * share))
    p = np.array(list({**BY_HAND.truth, "inertia": 0.004 * share}.values()))
    assert defects(lambda x, u: runge_kutta_step(BY_HAND, x, u, p, 0.01)[1], plan).max() < 1e-8
    assert plan.cost < 1.05 * dr.sine(rotorcraft()).cost


def test_plans_do_not_depend_on_what_was_planned_before():
    first = across(ROTORCRAFT)
    across(rotorcraft(mass=0.3, inertia=0.006))
    np.testing.assert_array_equal(across(ROTORCRAFT).states, first.states)


def test_threads_plan_alike():
    """Several solves run at a time."""
    tasks = [(rotorcraft(mass=m), [0.0, 0.8, end]) for m in (0.24, 0.25, 0.26) for end in (2.0, 2.6)]

    def planned(task):
        return across(task[0], times=task[1]).states

    alone = [planned(task) for task in tasks]
    with ThreadPoolExecutor(4) as pool:
        for states, expected in zip(pool.map(planned, tasks), alone, strict=True):
            np.testing.assert_array_equal(states, expected)


def test_a_plan_starts_when_its_first_waypoint_says():
    late = across(ROTORCRAFT, times=[5.0, 5.83, 7.16])
    np.testing.assert_allclose(late.time[[0, -1]], [5.0, 7.16])
    np.testing.assert_array_equal(late.states, across(ROTORCRAFT).states)
