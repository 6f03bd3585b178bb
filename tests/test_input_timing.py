"""Inputs that act late or after a lag, gaps, and settings that force or forbid what explains a log.

The machine is a pendulum under a held command, simulated by small steps of its own: the command reaches it after a
delay or a first-order lag, which are exact at a tenth of a sample.
"""

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from scipy.signal import lfilter

import diransac as dr
from diransac.data.dataset import Dataset
from diransac.data.input_timing import InputTiming, acting_inputs
from diransac.errors import SettingsError
from diransac.identification.methods.lo_diransac import local_search
from diransac.identification.methods.lo_diransac.preparation import prepared
from diransac.identification.methods.lo_diransac.search import searched

DT, FINE = 0.01, 10
TRUE = {"inertia": 0.5, "damping": 0.4, "weight": 4.0}
NOISE = {"angle": 1e-3, "angle_dot": 5e-3, "angle_ddot": 5e-2}
MODEL = dr.Model(
    "pendulum",
    {"angle": "rad"},
    {"torque": "N m"},
    {
        "inertia": dr.Parameter("kg m^2", positive=True),
        "damping": dr.Parameter("N m s"),
        "weight": dr.Parameter("N m"),
    },
    lambda q, v, a, u, p: [p.inertia * a.angle + p.damping * v.angle + p.weight * ca.sin(q.angle) - u.torque],
)


def commands(n_rows, seed=0):
    """Sines of a digital controller."""
    time, rng = DT * np.arange(n_rows), np.random.default_rng(seed)
    return sum(1.2 * np.sin(w * time + phase) for w, phase in zip((2.0, 5.1, 11.3), rng.uniform(0, 6, 3), strict=True))


def pendulum_log(delay=0.0, lag=0.0, n_rows=1500, seed=0, biases=None, gaps=()):
    """A log of the pendulum; gaps are (first row, last row, signals)."""
    recorded, h = commands(n_rows, seed), DT / FINE
    torque = np.repeat(recorded, FINE)
    shift = round(delay / h)
    torque = np.r_[np.full(shift, torque[0]), torque[: len(torque) - shift]]
    if lag:
        decay = np.exp(-h / lag)
        torque = lfilter([0.0, 1.0 - decay], [1.0, -decay], torque, zi=torque[:1])[0]

    def acceleration(angle, rate, u):
        return (u - TRUE["damping"] * rate - TRUE["weight"] * np.sin(angle)) / TRUE["inertia"]

    angle, rate, states = 0.2, 0.0, []
    for u in torque:  # the midpoint rule
        a = acceleration(angle, rate, u)
        states.append((angle, rate, a))
        middle = angle + 0.5 * h * rate, rate + 0.5 * h * a
        angle, rate = angle + h * middle[1], rate + h * acceleration(*middle, u)
    rng = np.random.default_rng(seed + 100)
    columns = {
        name: x + NOISE[name] * rng.standard_normal(n_rows) + (biases or {}).get(name, 0.0)
        for name, x in zip(NOISE, np.array(states)[::FINE].T, strict=True)
    }
    columns["torque"] = recorded
    for first, last, names in gaps:
        for name in names:
            columns[name][first:last] = np.nan
    return dr.Log.from_arrays(DT * np.arange(n_rows), columns, source=f"seed {seed}")


# ---------------------------------------------------------------------- acting inputs


def test_inputs_without_delay_and_lag_are_the_recorded_ones():
    recorded = np.random.default_rng(0).standard_normal((50, 2))
    assert InputTiming().acting(recorded, DT, "zero-order") is recorded


@pytest.mark.parametrize("delay", [-7, -1, 3, 60])
def test_whole_samples_of_delay_shift_the_inputs_whose_ends_continue(delay):
    recorded = np.random.default_rng(0).standard_normal((50, 2))
    rows = np.clip(np.arange(50) - delay, 0, 49)
    np.testing.assert_array_equal(acting_inputs(recorded, np.full(2, delay), np.zeros(2), np.zeros(2)), recorded[rows])


@pytest.mark.parametrize("delay", [0.3, 2.7, -1.6])
def test_a_fraction_of_delay_is_the_mean_of_the_held_signal_over_each_sample(delay):
    recorded, fine = np.random.default_rng(0).standard_normal((40, 1)), 10
    held = np.repeat(recorded, fine, axis=0)
    late = held[np.clip(np.arange(len(held)) - round(delay * fine), 0, len(held) - 1)]
    mean = late.reshape(40, fine, 1).mean(axis=1)
    found = acting_inputs(recorded, np.array([delay]), np.zeros(1), np.zeros(1))
    np.testing.assert_allclose(found[4:-4], mean[4:-4], rtol=1e-12, atol=1e-14)


def test_a_ramp_is_delayed_exactly():
    ramp = np.arange(30.0)[:, None]
    np.testing.assert_allclose(InputTiming(0.0123).acting(ramp, DT, "linear")[2:], ramp[2:] - 1.23, rtol=1e-12)


@pytest.mark.parametrize("hold", ["zero-order", "linear"])
def test_a_lag_has_the_mean_of_its_exponential_response_over_each_sample(hold):
    rows, constants, fine = np.arange(200), np.array([0.03, 0.08]), 1000
    recorded = np.column_stack([np.sin(0.05 * rows), np.cos(0.08 * rows)])
    response, means = np.array([0.0, 1.0]), []
    for u in recorded:
        decays = np.exp(-(DT / fine * (np.arange(fine) + 0.5))[:, None] / constants)
        means.append((u + (response - u) * decays).mean(axis=0))
        response = u + (response - u) * np.exp(-DT / constants)
    acting = InputTiming(0.0, 0.02, own_lags=(0.01, 0.06)).acting(recorded, DT, hold)
    found = acting if hold == "zero-order" else 0.5 * (acting[:-1] + acting[1:])
    np.testing.assert_allclose(found[2:-2], means[2 : len(found) - 2], atol=1e-8 if hold == "zero-order" else 4e-5)


def test_inputs_have_delays_of_their_own_besides_the_common_one():
    recorded = np.random.default_rng(0).standard_normal((50, 2))
    found = acting_inputs(recorded, np.array([2, 5]), np.zeros(2), np.zeros(2))
    np.testing.assert_array_equal(found[5:], np.column_stack([recorded[3:-2, 0], recorded[:-5, 1]]))
    own = InputTiming(0.5, own_delays=(0.5, 1.0)).acting(recorded, 0.25, "zero-order")
    np.testing.assert_array_equal(own, InputTiming(own_delays=(1.0, 1.5)).acting(recorded, 0.25, "zero-order"))


def test_a_gain_drifts_in_proportion_to_time_and_no_further_than_the_log():
    recorded = np.ones((8, 2))
    found = acting_inputs(recorded, np.zeros(2), np.zeros(2), np.array([-0.4, 0.0]), n_rows=4)
    np.testing.assert_allclose(found[:, 0], [0.95, 0.85, 0.75, 0.65, 0.6, 0.6, 0.6, 0.6], rtol=1e-12)
    np.testing.assert_array_equal(found[:, 1], 1.0)


# ---------------------------------------------------------------------- delay and lag in evaluation and validation


@pytest.fixture(scope="module")
def late():
    """Results of a log whose inputs act late, by what makes them late."""
    return {
        "delay": dr.identify(MODEL, pendulum_log(delay=0.04), differentiate=True),
        "lag": dr.identify(MODEL, pendulum_log(lag=0.04), differentiate=True),
    }


@pytest.mark.parametrize("what", ["delay", "lag"])
def test_the_timing_of_a_result_is_that_of_its_machine(late, what):
    timing = late[what].estimate.resolution.timing
    other = "lag" if what == "delay" else "delay"
    assert getattr(timing, what) == pytest.approx(0.04, abs=0.002)
    assert getattr(timing, other) == 0.0


@pytest.mark.parametrize("what", ["delay", "lag"])
def test_evaluation_and_validation_of_late_inputs_leave_the_noise_alone(late, what, tmp_path):
    result = late[what]
    assert result.inlier_fraction > 0.99
    late[what].save(tmp_path / "model.json")
    loaded = dr.Result.load(tmp_path / "model.json")
    assert loaded == result
    other = pendulum_log(**{what: 0.04}, seed=5)
    errors = dr.validate(loaded, other).rmse
    assert errors["angle"] < 2.0 * NOISE["angle"]
    assert errors["angle_dot"] < 2.0 * NOISE["angle_dot"]
    as_recorded = dr.validate(dr.Plant(MODEL, result.parameters), other)
    assert as_recorded.rmse["angle_dot"] > 5.0 * errors["angle_dot"]


def test_print_and_page_say_once_that_inputs_act_late(late, tmp_path):
    headings = {"delay": "Input delay: ", "lag": "First-order lag of the inputs, time constant: "}
    for what, words in (
        ("delay", "Inputs act 4"),
        ("lag", "Inputs act after a first-order lag of the actuators"),
    ):
        assert str(late[what]).count(words) == str(late[what]).count("Inputs act") == 1
        page = tmp_path / f"{what}.html"
        dr.write_report({"lo": late[what]}, [pendulum_log(**{what: 0.04})], page)
        assert headings[what] in page.read_text()
        assert page.read_text().count("Inputs act") == 1


# ---------------------------------------------------------------------- errors of single inputs

GIMBAL_TRUE = {"inertia": 0.5, "damping": 0.4, "weight": 4.0, "mass": 2.0, "drag": 1.5}
GIMBAL = dr.Model(
    "pendulum on a slide of its own",
    {"angle": "rad", "slide": "m"},
    {"torque": "N m", "force": "N"},
    {name: dr.Parameter("1", positive=True) for name in GIMBAL_TRUE},
    lambda q, v, a, u, p: [
        p.inertia * a.angle + p.damping * v.angle + p.weight * ca.sin(q.angle) - u.torque,
        p.mass * a.slide + p.drag * v.slide - u.force,
    ],
)


def gimbal_log(late=0, drift=0.0, lag=0.0, seed=0, n_rows=1000):
    """A log of both, whose force acts so many rows late or after a lag, and whose torque loses a part of its gain."""
    rng, p = np.random.default_rng(seed), GIMBAL_TRUE
    recorded = np.column_stack([commands(n_rows, seed), 3.0 * commands(n_rows, seed + 50)])
    gain = 1.0 + drift * (np.arange(n_rows * FINE) + 0.5) / (n_rows * FINE)
    force = recorded[np.maximum(np.arange(n_rows) - late, 0), 1]
    states, x, acting_force = [], np.array([0.2, 0.0, 0.0, 0.0]), force[0]

    def slope(x, torque, force):
        turn = (torque - p["damping"] * x[2] - p["weight"] * np.sin(x[0])) / p["inertia"]
        return np.array([x[2], x[3], turn, (force - p["drag"] * x[3]) / p["mass"]])

    for k, u in enumerate(np.repeat(np.column_stack([recorded[:, 0], force]), FINE, axis=0)):  # the midpoint rule
        h = DT / FINE
        decay = np.exp(-h / lag) if lag else 0.0
        mean = u[1] + (acting_force - u[1]) * (1.0 - decay) * lag / h
        acting_force = u[1] + (acting_force - u[1]) * decay
        acting = (gain[k] * u[0], mean)
        if k % FINE == 0:
            states.append(x)
        x = x + h * slope(x + 0.5 * h * slope(x, *acting), *acting)
    measured = np.array(states) + np.array([1e-3, 1e-3, 5e-3, 5e-3]) * rng.standard_normal((n_rows, 4))
    columns = dict(zip(("angle", "slide", "angle_dot", "slide_dot"), measured.T, strict=True))
    columns |= {"torque": recorded[:, 0], "force": recorded[:, 1]}
    return dr.Log.from_arrays(DT * np.arange(n_rows), columns)


def identified(log, **options):
    return dr.identify(GIMBAL, log, dr.LoDiransac(suggestions=False, **options), differentiate=True)


def assert_right(result):
    for name, true in GIMBAL_TRUE.items():
        error = abs(result.parameters[name] - true)
        assert error < 4.0 * result.standard_errors[name], name
        assert error < 0.01 * true, name


def test_an_input_that_is_later_than_the_other_is_found_and_named(tmp_path):
    result = identified(gimbal_log(late=4))
    timing = result.estimate.resolution.timing
    np.testing.assert_allclose(timing.own_delays, [0.0, 0.04], atol=5e-4)
    assert timing.delay == 0.0
    assert_right(result)
    (said,) = [x for x in result.findings if "acts" in x]
    assert said.startswith("force acts")
    assert float(said.split()[2]) == pytest.approx(40.0, abs=0.5)
    result.save(tmp_path / "result.json")
    assert dr.Result.load(tmp_path / "result.json").estimate.resolution.timing == timing
    held_out, undelayed = gimbal_log(late=4, seed=1), dr.Plant(GIMBAL, result.parameters)
    assert dr.validate(result, held_out).rmse["slide_dot"] < 0.3 * dr.validate(undelayed, held_out).rmse["slide_dot"]


def test_a_lag_of_one_actuator_is_found_and_named(tmp_path):
    result = identified(gimbal_log(lag=0.05))
    timing = result.estimate.resolution.timing
    np.testing.assert_allclose(timing.lags, [0.0, 0.05], atol=1e-3)
    assert timing.delay == 0.0
    assert timing.own_delays == ()
    assert_right(result)
    (said,) = [x for x in result.findings if "acts" in x]
    assert said.startswith("force acts after a first-order lag of ")
    assert float(said.split()[7]) == pytest.approx(50.0, abs=1.0)
    result.save(tmp_path / "result.json")
    assert dr.Result.load(tmp_path / "result.json").estimate.resolution.timing == timing
    held_out, at_once = gimbal_log(lag=0.05, seed=1), dr.Plant(GIMBAL, result.parameters)
    assert dr.validate(result, held_out).rmse["slide_dot"] < 0.3 * dr.validate(at_once, held_out).rmse["slide_dot"]


def test_a_gain_that_drifts_is_found_and_named():
    result = identified(gimbal_log(drift=-0.15))
    np.testing.assert_allclose(result.estimate.resolution.timing.gain_drifts, [-0.15, 0.0], atol=0.004)
    assert_right(result)
    said = [x for x in result.findings if "gain" in x]
    assert len(said) == 1
    assert said[0].startswith("The gain of torque falls by 15 % during the log")
    assert result.verdict == "usable with care"


def test_inputs_without_errors_have_none():
    assert identified(gimbal_log(seed=2)).estimate.resolution.timing == InputTiming()


def test_errors_of_inputs_can_be_named_or_forbidden():
    named = identified(gimbal_log(), sensor_delays=("force",), gain_drifts=("torque",)).estimate.resolution.timing
    assert named.own_delays[1] == pytest.approx(0.0, abs=1e-3)
    assert 0.0 < abs(named.gain_drifts[0]) < 0.01
    assert named.gain_drifts[1] == 0.0
    forbidden = identified(gimbal_log(drift=-0.15), gain_drifts=())
    assert forbidden.estimate.resolution.timing.gain_drifts == ()
    # Predictions change by 4 % of the motion between the halves, and intervals are as wide as the drift.
    assert any(x.startswith("inertia changes during the log") and x.level == "note" for x in forbidden.findings)
    low, high = forbidden.intervals()["inertia"]
    assert high - low > 0.15 * forbidden.parameters["inertia"]


# ---------------------------------------------------------------------- gaps


@cache
def of_gap(method, lost):
    """A log that lacks some columns in rows 500 to 639, and its result."""
    log = pendulum_log(gaps=[(500, 640, lost)])
    return log, dr.identify(MODEL, log, method)


@pytest.mark.parametrize("method", ["ols", "i-diransac", "lo-diransac"])
@pytest.mark.parametrize("lost", [("torque",), tuple(NOISE)], ids=["inputs", "sensors"])
def test_no_simulation_passes_through_a_gap(method, lost):
    log, result = of_gap(method, lost)
    assert not result.inliers[500:640].any()
    assert result.inlier_fraction > 0.99
    assert result.inliers[680:].mean() > 0.99
    found = dr.validate(result, log)
    assert found.horizons[-1].windows == 2
    assert found.rmse["angle_dot"] < 6.0 * NOISE["angle_dot"]
    assert all(x.diverged == 0 for x in result.predictions.horizons)


def test_a_page_of_a_log_with_gaps_is_written(tmp_path):
    found = {method: of_gap(method, ("torque",)) for method in ("lo-diransac", "i-diransac")}
    results, log = {method: result for method, (_, result) in found.items()}, found["i-diransac"][0]
    dr.write_report(results, [log, pendulum_log(seed=3, gaps=[(200, 300, ("torque",))])], tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    assert "1 gap" in text
    assert "diverge" not in text


def test_windows_of_a_validation_restart_after_a_gap_and_do_not_score_it():
    plant, rows = dr.Plant(MODEL, TRUE), (700, 800)
    whole = dr.validate(plant, pendulum_log(), 0.5)
    gapped = dr.validate(plant, pendulum_log(gaps=[(*rows, ("torque",))]), 0.5)
    assert whole.horizons[0].windows == 29
    assert gapped.horizons[0].windows == 26  # 13 before row 700, 13 from row 800 on


# ---------------------------------------------------------------------- settings


def estimate(log, **options):
    return dr.LoDiransac(suggestions=False, **options).fit(Dataset.of(MODEL, log, pointwise=False), 0)


@pytest.mark.parametrize(("kind", "time"), [("delay", 0.04), ("delay", 0.0), ("lag", 0.04)])
def test_a_forbidden_delay_or_lag_is_not_estimated(kind, time):
    found = estimate(pendulum_log(**{kind: time}), input_delay=False, input_lag=False).resolution.timing
    assert found == InputTiming()


def test_without_a_lag_a_lagging_machine_has_a_delay_and_the_reverse():
    log = pendulum_log(lag=0.04)
    delayed, lagging = estimate(log, input_lag=False), estimate(log, input_delay=False)
    assert delayed.resolution.timing.lag == 0.0
    assert 0.02 < delayed.resolution.timing.delay < 0.06
    assert lagging.resolution.timing.delay == 0.0
    assert lagging.resolution.timing.lag == pytest.approx(0.04, abs=0.002)


def test_a_required_delay_is_estimated_though_no_evidence_asks_for_it():
    found = estimate(pendulum_log(), input_delay=True)
    assert found.resolution.timing.delay != 0.0
    assert found.resolution.timing.delay == pytest.approx(0.0, abs=0.001)


def test_a_required_lag_is_estimated_where_a_delay_is_likelier():
    """Without delays of sensors, which would make up for a part of the input's."""
    timing = estimate(pendulum_log(delay=0.04), input_lag=True, sensor_delays=()).resolution.timing
    assert timing.delay == 0.0
    assert 0.02 < timing.lag < 0.06


def test_a_named_bias_is_estimated_and_no_other():
    log = pendulum_log(biases={"angle_dot": 0.05, "angle_ddot": 0.5})
    found = estimate(log, sensor_biases="angle_dot", sensor_delays=())
    said = [x for x in found.checks if "sensor" in x]
    assert len(said) == 1
    assert said[0].startswith("angle_dot has a sensor bias of 0.05")


def test_errors_of_sensors_can_be_forbidden():
    log = pendulum_log(biases={"angle_dot": 0.05})
    found = estimate(log, sensor_biases=(), sensor_delays=())
    assert not any("sensor" in x for x in found.checks)


def test_a_required_delay_of_a_sensor_is_estimated():
    log = pendulum_log()
    columns = {name: np.array(log[name]) for name in log.names}
    columns["angle"][3:] = columns["angle"][:-3].copy()
    found = estimate(dr.Log.from_arrays(log.time, columns), sensor_delays=["angle"])
    said = next(x for x in found.checks if x.startswith("angle is recorded"))
    assert float(said.split()[3]) == pytest.approx(30.0, abs=0.3)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"input_delay": True, "input_lag": True}, "both True"),
        ({"input_lag": "yes"}, "input_lag is 'yes'; give True, False, or None"),
        ({"sensor_biases": 3}, "sensor_biases is 3; give names"),
    ],
)
def test_switches_without_meaning_are_refused(options, says):
    with pytest.raises(SettingsError, match=says):
        dr.LoDiransac(**options)


def test_a_sensor_that_the_log_lacks_is_refused_by_name():
    with pytest.raises(SettingsError, match=r'sensor_biases names "x", which .* lacks; it has angle, angle_dot'):
        estimate(pendulum_log(), sensor_biases=("x",))
    with pytest.raises(SettingsError, match=r'gain_drifts names "angle", which .* lacks; it has torque'):
        estimate(pendulum_log(), gain_drifts=("angle",))


def test_a_search_ends_where_the_freedom_of_another_makes_it_less_likely_or_leads_to_the_same_parameters(monkeypatch):
    log = pendulum_log()
    unmodelled = log["torque"] + 0.1 * np.sin(2.0 * log.time)
    late = {"angle_ddot": np.r_[np.full(3, np.nan), log["angle_ddot"][:-3]], "torque": unmodelled}
    signals = {name: log[name] for name in ("angle", "angle_dot")} | late
    dataset = Dataset.of(MODEL, dr.Log.from_arrays(log.time, signals), pointwise=False)
    settings = dr.LoDiransac(sensor_delays="angle_ddot")
    whole = prepared(settings, dataset)
    found = searched(settings, *whole, 0, dataset, None).likeliest
    assert not found.exact
    assert [x.what for x in found.intervals.all_errors.kinds] == ["delay"]

    def beside(rival):
        return searched(settings, *whole, 0, dataset, None, rival=rival).likeliest

    def costing(more, of=found):
        return replace(of, refinement=replace(of.refinement, cost=of.cost + more))

    ahead, behind = costing(-100.0), costing(100.0)
    assert beside(ahead) is ahead
    ended = beside(behind)  # it has the rival's freedom
    assert ended.cost < found.cost + 1.0
    assert ended.cost != found.cost
    assert ended.intervals.all_errors.kinds == found.intervals.all_errors.kinds
    # With other parameters, an exact rival or one of other intervals, the search goes on.
    fit, intervals = found.refinement.fit, found.intervals
    moved = replace(behind, refinement=replace(behind.refinement, fit=replace(fit, shared=1.5 * fit.shared)))
    first = whole[0].length + 1
    longer = replace(behind, refinement=replace(behind.refinement, intervals=replace(intervals, length=first)))
    for rival in (moved, replace(behind, exact=True), longer):
        assert beside(rival).cost == found.cost

    def fails(*_):
        raise np.linalg.LinAlgError

    monkeypatch.setattr(local_search, "fitted_parameters", fails)
    assert beside(behind).cost == found.cost
