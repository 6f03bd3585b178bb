"""Intervals in which the state that nothing measures is at a wrong optimum.

A thrust that is the same for either sense of rotation leaves the sense of a rotor to the first samples of a log, most
of which then pass for outliers.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import diransac as dr
from diransac.data.dataset import ParameterLayout
from diransac.identification.methods.lo_diransac.lost_intervals import with_lost_intervals_restarted
from diransac.identification.methods.lo_diransac.mixture import Mixture
from diransac.identification.methods.lo_diransac.normal_equations import Fit, with_residuals
from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
from diransac.model import Model, Parameter

DT, LENGTH, NOISE = 0.01, 25, 1e-3
GAIN, LAG = 1e-5, 0.1
ROTOR = Model(
    name="rotor",
    coordinates={"z": "m"},
    first_order={"speed": "rad/s"},
    inputs={"command": "rad/s"},
    parameters={"gain": Parameter("m", positive=True), "lag": Parameter("s", positive=True)},
    equations=lambda _q, v, a, u, p: [a.z - p.gain * v.speed**2 + 9.81, p.lag * a.speed + v.speed - u.command],
)


@pytest.fixture(scope="module")
def flight():
    """Intervals of a log in which height and its rate are measured, and the true states at their starts."""
    t = np.arange(200) * DT
    command = 1000.0 + 150.0 * np.sign(np.sin(9.0 * t) + 0.4)

    def rates(_t, x, u):
        return [x[1], GAIN * x[2] ** 2 - 9.81, (u - x[2]) / LAG]

    states = [np.array([0.0, 0.0, 900.0])]
    for u in command[:-1]:
        states.append(solve_ivp(rates, (0.0, DT), states[-1], args=(u,), rtol=1e-10, atol=1e-10).y[:, -1])
    true, signals, names = np.array(states), np.zeros((len(t), len(ROTOR.signals))), list(ROTOR.signals)
    measured, known = [names.index("z"), names.index("z_dot")], np.zeros(signals.shape, bool)
    rng = np.random.default_rng(1)
    signals[:, measured] = true[:, :2] + NOISE * rng.normal(size=(len(t), 2))
    signals[rng.random(len(t)) < 0.05, measured[0]] += 5.0
    known[:, measured] = True
    log = (signals, known, command[:, None], np.zeros(len(t), bool))
    intervals = ShootingIntervals.of(ROTOR, ParameterLayout(ROTOR.parameters), [log], DT, LENGTH, 5)
    return intervals, true[intervals.starts]


def fit_of(intervals, x):
    """A fit with the true parameters from initial states."""
    n, n_s = intervals.n_shared, len(ROTOR.signals)
    noise = Mixture(np.full(n_s, NOISE), np.full(n_s, 0.05), np.full(n_s, 10.0), np.full(n_s, 1e-6))
    sizes = (np.full(2, 1e-3), np.zeros(2), np.full(3, 1e-3), np.ones(n), np.zeros(n))
    shared = np.append([GAIN, LAG], np.zeros(n - 2))
    fit = Fit(shared, x, np.zeros((len(x), 2)), np.zeros((len(intervals.measured), n_s)), x, noise, *sizes)
    return with_residuals(intervals, fit)


@pytest.mark.parametrize("lost", [0, 3])
def test_a_rotor_that_turns_the_wrong_way_turns_the_right_way_again(flight, lost):
    intervals, true = flight
    wrong = true.copy()
    wrong[lost, 2] *= -1.0
    found = with_lost_intervals_restarted(intervals, fit_of(intervals, wrong))
    assert found is not None
    assert np.abs(found.x[lost] - true[lost]) == pytest.approx([0.0, 0.0, 0.0], abs=5.0)
    others = np.arange(len(true)) != lost
    assert np.array_equal(found.x[others], true[others])
    assert np.isfinite(found.ends[lost]).all()


def test_intervals_at_their_optimum_are_left_as_they_are(flight):
    intervals, true = flight
    assert with_lost_intervals_restarted(intervals, fit_of(intervals, true)) is None


def test_states_that_are_measured_have_no_other_optimum(flight):
    intervals, true = flight
    signals = np.ones(intervals.known.shape, bool)
    everything = replace(intervals, sampled=signals)
    wrong = true.copy()
    wrong[0, 2] *= -1.0
    assert with_lost_intervals_restarted(everything, fit_of(everything, wrong)) is None


def test_a_rotor_behind_a_lag_is_identified_from_its_height(flight):
    """Whole: the sense of rotation is not measured, and the log begins far from the command."""
    intervals, true = flight
    t = np.arange(len(intervals.measured)) * DT
    columns = {n: intervals.measured[:, ROTOR.signals.index(n)] for n in ("z", "z_dot")}
    log = dr.Log.from_arrays(t, {**columns, "command": intervals.inputs[:, 0]})
    result = dr.identify(ROTOR, log, differentiate=True)
    assert result.parameters["gain"] == pytest.approx(GAIN, rel=0.01)
    assert result.parameters["lag"] == pytest.approx(LAG, rel=0.05)
    assert result.diagnosis.smoothed_states["speed"][0] == pytest.approx(true[0, 2], rel=0.05)
