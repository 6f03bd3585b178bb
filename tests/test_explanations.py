"""What lo-diransac takes a log to be: exact or not, late, lagging, with gaps, with sensors that err, with a payload."""

from dataclasses import replace

import numpy as np
import pytest
import regime_flights as flights
from regime_judging import METHODS

SEED = 1000


def judged(name, seed=SEED):
    """The record of one log of a regime, made by simulations that are not the package's."""
    return METHODS["lo"](flights.REGIMES[name], seed, flights.recordings(flights.REGIMES[name], [seed])[0])


@pytest.mark.parametrize(
    ("name", "worst"),
    [
        ("car all measured", 2.0),  # no known term in the yaw equation
        ("car gyro and lateral acceleration", 2.0),  # neither angle nor lateral velocity is measured
        ("car continuous input", 2.0),  # half a sample early, if taken as held
        ("viscous cart-pole smooth", 0.5),  # one input, two equations
        ("cart-pole 20 Hz", 1.0),
        ("servo 1 s missing", 0.1),
        ("servo 1 s of sensors missing", 0.1),
    ],
)
def test_an_exact_model_is_found_and_called_usable(name, worst):
    found = judged(name)
    assert found.worst < worst
    assert found.verdict == "usable"


def test_equations_without_a_known_term_do_not_make_all_parameters_vanish():
    found = judged("differential drive all measured")
    assert found.worst < 4.0
    assert not found.off
    assert not any("converge" in x for x in found.findings)  # along the valley of its collinear parameters


def test_velocities_that_are_not_logged_follow_from_the_kinematics():
    found = judged("quad mocap and gyro")
    assert found.worst < 0.5
    assert found.verdict == "usable"


def test_a_load_that_nothing_measures_is_found_though_smoothing_takes_its_resonance_for_noise():
    found = judged("flexible joint motor angle", 1001)
    assert found.verdict == "usable"
    assert all(found.inside.values())


def test_a_lag_of_the_actuators_is_estimated_and_named():
    found = judged("rotor motor lag 50 ms")
    assert found.worst < 0.2
    lags = [x for x in found.findings if "after a first-order lag of the actuators" in x]
    assert len(lags) == 1
    assert float(lags[0].split()[2]) == pytest.approx(50.0, abs=5.0)


def test_late_sensors_are_named():
    found = judged("rotor x and z 10 ms late")
    assert found.worst < 0.1
    assert all(found.inside.values())
    said = [x for x in found.findings if x.startswith("x and z are recorded")]
    assert float(said[0].split("recorded ")[1].split(" ms late")[0]) == pytest.approx(10.0, abs=1.0)


def test_late_positions_beside_timely_velocities_leave_the_parameters_exact():
    arm = flights.REGIMES["arm noisy"]
    machine = replace(arm.machine, noise={**arm.machine.noise, "q1_dot": 2e-3, "q2_dot": 2e-3})
    regime = replace(arm, machine=machine, exact=False, fault=flights.Fault(late={"q1": 0.01, "q2": 0.01}))
    found = METHODS["lo"](regime, SEED + 1, flights.recordings(regime, [SEED + 1])[0])
    assert found.worst < 0.05
    assert all(found.inside.values())
    said = [x for x in found.findings if x.startswith("q1 and q2 are recorded")]
    assert float(said[0].split("recorded ")[1].split(" ms late")[0]) == pytest.approx(10.0, abs=0.5)


def test_a_parameter_that_changes_during_the_log_is_not_relied_on():
    found = judged("rotor payload -30 %")
    assert found.verdict == "do not rely on this"
    assert any("mass changes during the log" in x for x in found.findings)
    assert all(found.inside.values())  # intervals hold the parameters of every part of the log


def test_a_battery_that_sags_is_named_and_leaves_the_parameters_exact():
    found = judged("rotor battery sag 15 %")
    assert found.worst < 0.1
    assert all(found.inside.values())
    assert [x[:40] for x in found.findings if "gain" in x] == [
        "The gain of thrust falls by 15 % during ",
        "The gain of moment falls by 15 % during ",
    ]
    assert found.verdict == "usable with care"


def test_a_controller_that_answers_gusts_is_no_delay():
    found = judged("rotor slight gusts")
    assert found.worst < 5.0
    assert not any("time stamps" in x or "lag of" in x for x in found.findings)


def test_the_seed_does_not_matter():
    import diransac as dr

    regime = flights.REGIMES["cart-pole 40 Hz"]
    log = flights.recordings(regime, [SEED])[0].log
    results = [dr.identify(regime.machine.model, log, differentiate=True, seed=seed) for seed in range(3)]
    for name, error in results[0].standard_errors.items():
        values = [result.parameters[name] for result in results]
        assert np.ptp(values) < 0.2 * error
