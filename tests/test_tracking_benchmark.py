"""What the tracking benchmark compares with: equations, filters and measures."""

import numpy as np
import pytest
import quadrotor_flights as quad
from tracking import _delay, _false_reports, judged
from tracking_baselines import Forgetting, Linearised, Moment, Tuning, Unscented, kalman, least_squares
from tracking_bodies import Planar, Quadrotor, advanced
from tracking_flights import MACHINES, Flight, Scenario, fly_planar

from simulated import ROTORCRAFT, runge_kutta_step


def test_the_bodies_of_the_filters_are_the_plants():
    rng = np.random.default_rng(0)
    x, u, p = rng.normal(size=6), np.array([2.4, 0.1]), ROTORCRAFT.truth
    columns = {name: np.array([value]) for name, value in p.items()}
    _, wanted = runge_kutta_step(ROTORCRAFT, x, u, list(p.values()), 0.01)
    assert advanced(Planar(), x[None], columns, u, 0.01)[0] == pytest.approx(wanted, rel=1e-12)

    p = quad.airframe(rng)
    R, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    R *= np.linalg.det(R)
    q, w, v = quad.quaternions(R[None])[0], rng.normal(size=3), rng.normal(size=3)
    speeds, commands = rng.uniform(800.0, 1500.0, (2, 4))
    slope = quad.slope(np.concatenate([np.zeros(3), v, R.ravel(), w, speeds]), commands, p)
    columns = {name: np.array([value]) for name, value in p.items()}
    body = Quadrotor(p["thrust_coefficient"])
    state = np.concatenate([np.zeros(3), v, q, w, speeds])[None]
    found = body.slope(state, columns, commands)[0]
    kept = [*range(6), *range(10, 17)]
    assert found[kept] == pytest.approx(slope[[*range(6), *range(15, 22)]], rel=1e-9)
    turned = state[:, 6:10] + 1e-6 * found[6:10]
    R_dot = (quad.quaternions(slope[6:15].reshape(1, 3, 3) * 1e-6 + R)[0] - q) / 1e-6
    assert turned[0] == pytest.approx(q + 1e-6 * R_dot, abs=1e-10)
    errors = 1e-3 * rng.normal(size=(1, 16))
    assert body.apart(body.moved(state, errors), state[0])[0] == pytest.approx(errors[0], rel=1e-4)
    readings = body.readings(state, columns, commands)[0]
    force = slope[3:6] + [0.0, 0.0, quad.G]  # noqa: RUF005  a sum
    biases = [p[quad.bias(name)] for name in (*quad.GYRO, *quad.ACC)]
    assert readings[:6] == pytest.approx(np.concatenate([w, R.T @ force]) + biases, rel=1e-9)


@pytest.mark.parametrize(
    "method",
    [
        kalman(Linearised(), Tuning(0.1, 0.02)),
        kalman(Unscented(), Tuning(0.1, 0.02)),
        least_squares(Forgetting(2.0, 4.0)),
    ],
    ids=["ekf", "ukf", "rls"],
)
def test_each_baseline_finds_the_parameters_of_a_flight_with_lost_rows(method):
    flight = fly_planar(Scenario(12.0, gaps=True), 1000)
    last = list(method(flight, 0.1))[-1]
    for name in MACHINES["planar"].judged:
        assert last.values[name] == pytest.approx(flight.truth[name][-1], rel=0.1)
        assert 0.0 < last.errors[name] < 0.2 * last.values[name]


def test_the_delay_ends_when_the_estimate_is_near_for_good():
    t = np.array([29.0, 30.0, 31.0, 32.0, 33.0])
    assert _delay(t, np.array([True, False, True, False, True])) == 3.0
    assert _delay(t, np.array([True, True, True, True, True])) == 0.0
    assert _delay(t, np.array([True, True, True, True, False])) == np.inf


def test_reports_of_what_changed_are_no_false_ones_and_errors_are_those_after_settling():
    scenario = Scenario(60.0, ("mass",))
    t = np.arange(0.0, 60.0, 0.1)
    truth = {"mass": 2.0 * scenario.factor("mass", t), "inertia": np.ones(600), "drag": np.ones(600)}
    flight = Flight({"t": t}, truth, fly_planar(Scenario(1.0), 0).model, {}, {})
    reports = [(12.0, "mass", 11.0), (30.5, "mass", 30.0), (31.0, "mass", 30.0), (31.0, "drag", 30.0)]
    assert _false_reports(flight, reports) == [reports[0], reports[2], reports[3]]
    moments = [
        Moment(at, {"mass": 2.0 if at < 31.05 else 1.4, "inertia": 1.01, "drag": 1.0}, dict.fromkeys(truth, 0.02), 0.01)
        for at in t
    ]
    row = judged(flight, MACHINES["planar"], scenario, moments)
    assert row["errors"] == {"mass": 0.0, "inertia": pytest.approx(0.01), "drag": 0.0}
    assert row["delays"] == {"mass": pytest.approx(1.1)}
    assert row["coverage"] == pytest.approx(1.0 - 11 / 1500)
    assert row["rate"] == pytest.approx(100.0)
