"""lo-diransac as a whole: the parameters that a machine has, from logs that break least squares."""

from functools import cache

import numpy as np
import pytest

import diransac as dr
from diransac.data.dataset import Dataset
from diransac.errors import IdentificationError, LogError, SettingsError
from diransac.simulation import RolloutBatch, rollouts
from simulated import MACHINES, as_log, flight, with_outliers
from test_nonlinear import log_of, swing
from user_models import hanging_mass

DT = 0.01
MODELS = {
    "planar-rotorcraft": dr.models.planar_rotorcraft(),
    "servo-axis": dr.models.servo_axis(),
    "double-pendulum": dr.models.double_pendulum(),
    "underwater-vehicle": dr.models.underwater_vehicle(),
}
SMOOTH = [n for n in MODELS if n != "servo-axis"]  # dry friction is a kink, which an integrator meets in mid-step


@cache
def whole_flight(name, n_rows):
    """Integrated more finely than by the method: a log is a machine's."""
    return flight(MACHINES[name], n_rows, DT, substeps=20 if name == "servo-axis" else 5)


def flown(name, n_rows=1500):
    """The first rows of the machine's flight."""
    signals, inputs = whole_flight(name, 2500 if name == "planar-rotorcraft" else 1500)
    assert n_rows <= len(signals)
    return signals[:n_rows], inputs[:n_rows]


def truth(name):
    return np.array(list(MACHINES[name].truth.values()))


def found(name, signals, inputs, seed=0, without=()):
    columns = [n for n in MACHINES[name].signals if n not in without]
    log = as_log(MACHINES[name], signals, inputs, DT)
    log = dr.Log.from_arrays(log.time, {n: log[n] for n in (*columns, *MACHINES[name].inputs)})
    return dr.LoDiransac().fit(Dataset.of(MODELS[name], log, pointwise=False), seed)


def relative_errors(name, estimate):
    return np.abs(estimate.values / truth(name) - 1.0)


@pytest.mark.parametrize("name", SMOOTH)
def test_outliers_in_half_of_all_samples_leave_the_parameters_exact(name):
    signals, inputs = flown(name)
    estimate = found(name, with_outliers(signals, 0.5, 30.0, seed=1, first_row="hit"), inputs)
    assert relative_errors(name, estimate).max() < 1e-3


def test_one_sided_outliers_in_the_liveliest_third_leave_the_parameters_exact():
    signals, inputs = flown("planar-rotorcraft", 2500)
    rng = np.random.default_rng(2)
    lively = inputs[:, 0] > np.quantile(inputs[:, 0], 0.7)
    hit = (rng.random(signals.shape) < 0.5) & lively[:, None]
    estimate = found("planar-rotorcraft", signals + hit * rng.uniform(0.0, 80.0, signals.shape), inputs)
    assert relative_errors("planar-rotorcraft", estimate).max() < 1e-3


@pytest.mark.parametrize("kind", ["missing", "frozen"])
def test_a_fifth_of_the_log_missing_or_frozen_leaves_the_parameters_exact(kind):
    signals, inputs = flown("planar-rotorcraft", 2500)
    spoilt = signals.copy()
    for first in range(100, 2500, 250):
        spoilt[first : first + 50] = np.nan if kind == "missing" else spoilt[first - 1]
    assert relative_errors("planar-rotorcraft", found("planar-rotorcraft", spoilt, inputs)).max() < 1e-3


@pytest.mark.parametrize("name", list(MODELS))
def test_coordinates_alone_are_enough(name):
    signals, inputs = flown(name)
    n = len(MACHINES[name].coordinates)
    noisy = signals + 1e-3 * signals.std(axis=0) * np.random.default_rng(3).normal(size=signals.shape)
    estimate = found(name, noisy, inputs, without=MACHINES[name].signals[n:])
    errors = np.sqrt(np.diag(estimate.covariance)) / np.abs(truth(name))
    assert (relative_errors(name, estimate) < 4.0 * errors).all()
    assert np.median(errors) < 0.02


def test_input_delay_is_found_and_taken_out():
    signals, inputs = flown("planar-rotorcraft")
    late = np.vstack([inputs[3:], np.repeat(inputs[-1:], 3, axis=0)])  # what was recorded acts three rows later
    estimate = found("planar-rotorcraft", with_outliers(signals, 0.1, 30.0, seed=4), late)
    assert estimate.diagnosis.input_delay == pytest.approx(0.03, abs=2e-4)
    assert relative_errors("planar-rotorcraft", estimate).max() < 2e-3


def test_parameters_that_do_not_enter_affinely_are_found():
    log = swing(n=1500)
    signals = np.column_stack([log["angle"], log["angle_dot"], log["angle_ddot"]])
    spoilt = log_of(with_outliers(signals, 0.3, 20.0, seed=5), np.column_stack([log["pivot"], log["torque"]]), DT)
    estimate = dr.LoDiransac().fit(Dataset.of(hanging_mass(), spoilt, pointwise=False), 0)
    assert estimate.values == pytest.approx([0.43, 1.7, 0.06], rel=1e-3)


def test_noise_and_outliers_are_told_apart():
    signals, inputs = flown("planar-rotorcraft", 2500)
    rng, sigma = np.random.default_rng(6), 0.05 * signals.std(axis=0)
    hit = rng.random(signals.shape) < 0.2
    spoilt = signals + sigma * rng.normal(size=signals.shape) + hit * rng.uniform(-30.0, 30.0, signals.shape)
    estimate = found("planar-rotorcraft", spoilt, inputs)
    diagnosis = estimate.diagnosis
    assert list(diagnosis.noise_std.values()) == pytest.approx(sigma, rel=0.06)
    assert list(diagnosis.outlier_fraction.values()) == pytest.approx(hit.mean(axis=0), abs=0.02)
    assert (np.column_stack(list(diagnosis.outliers.values())) == hit).mean() > 0.98


def test_a_gust_is_an_acceleration_that_the_model_does_not_explain_not_a_sensor_fault():
    machine, gust = MACHINES["underwater-vehicle"], np.zeros(2500)
    gust[1000:1100] = 0.5
    pushed, inputs = flight_with(machine, gust)
    estimate = found("underwater-vehicle", pushed, inputs)
    diagnosis = estimate.diagnosis
    inside = (diagnosis.unmodelled_time >= 10.0) & (diagnosis.unmodelled_time < 11.0)
    assert diagnosis.unmodelled_accelerations["x_ddot"][inside] == pytest.approx(0.5, abs=0.1)
    assert np.abs(diagnosis.unmodelled_accelerations["x_ddot"][~inside]).max() < 0.1
    assert np.mean(list(diagnosis.outliers.values())) < 0.02


def flight_with(machine, push):
    """The vehicle's flight under an acceleration of its own besides."""
    p, x = np.array(list(machine.truth.values())), np.array(machine.start)
    signals, inputs = np.empty((len(push), 3)), np.empty((len(push), 1))

    def slope(x, u, extra):
        return np.array([x[1], machine.acceleration(x[:1], x[1:], u, p)[0] + extra])

    for k, extra in enumerate(push):
        inputs[k] = machine.law(k * DT, x[:1], x[1:])
        k1 = slope(x, inputs[k], extra)
        signals[k] = [*x, k1[1]]
        k2 = slope(x + DT / 2 * k1, inputs[k], extra)
        k3 = slope(x + DT / 2 * k2, inputs[k], extra)
        x = x + DT / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + DT * k3, inputs[k], extra))
    return signals, inputs


def test_one_wild_input_does_not_matter():
    signals, inputs = flown("planar-rotorcraft")
    wild = inputs.copy()
    wild[[300, 900], 0] = [4000.0, -700.0]
    estimate = found("planar-rotorcraft", signals, wild)
    assert relative_errors("planar-rotorcraft", estimate).max() < 5e-3


def climb(moment):
    """Up and down on the spot: a log that shows mass, but little or nothing of inertia and drag."""
    t, mass = DT * np.arange(1500), truth("planar-rotorcraft")[0]
    a = np.where(np.sin(1.3 * t) > 0.0, 1.0, -1.0)
    signals = np.zeros((1500, 9))
    signals[:, 7] = a
    signals[1:, 4] = DT * np.cumsum(a)[:-1]
    signals[1:, 1] = np.cumsum(DT * signals[:-1, 4] + 0.5 * DT**2 * a[:-1])
    noise = np.random.default_rng(7).normal(size=signals.shape)
    return signals + 0.02 * noise, np.column_stack([mass * (a + 9.81), moment * np.sin(9.0 * t)])


def test_parameters_that_the_motion_does_not_show_are_named():
    estimate = found("planar-rotorcraft", *climb(moment=1e-6))
    assert estimate.diagnosis.unidentifiable == ("inertia", "drag")
    assert estimate.parameters["mass"] == pytest.approx(truth("planar-rotorcraft")[0], rel=1e-3)


def test_a_log_that_cannot_give_a_parameter_at_all_is_refused():
    with pytest.raises(IdentificationError, match="within their bounds"):
        found("planar-rotorcraft", *climb(moment=0.0))


def test_a_log_of_a_few_rows_is_refused():
    signals, inputs = flown("planar-rotorcraft")
    with pytest.raises(LogError, match="too few"):
        found("planar-rotorcraft", signals[:60], inputs[:60])


def test_intervals_cover_under_noise_and_outliers():
    """The sixteenth part of 240 intervals of 95 % may miss by chance alone with probability below one in a thousand."""
    signals, inputs = flown("underwater-vehicle", 1000)
    sigma, missed = 0.05 * signals.std(axis=0), 0
    for seed in range(30):
        rng = np.random.default_rng(100 + seed)
        noisy = signals + sigma * rng.normal(size=signals.shape)
        estimate = found("underwater-vehicle", with_outliers(noisy, 0.2, 10.0, seed=seed), inputs, seed=seed)
        span = 1.96 * np.sqrt(np.diag(estimate.covariance))
        missed += (np.abs(estimate.values - truth("underwater-vehicle")) > span).sum()
    assert missed <= 15


def held(n_rows, seed=3):
    """A mass with drag under a force that is held for ten rows and then leaps: its log without noise."""
    force = np.repeat(np.random.default_rng(seed).uniform(-30.0, 30.0, n_rows // 10), 10)
    machine = MACHINES["underwater-vehicle"]
    return machine, force[:, None]


def test_a_delay_of_inputs_that_leap_now_and_then_is_found_where_there_is_no_noise():
    """One sample in five of the acceleration could pass for an outlier instead."""
    machine, inputs = held(2000)
    p = np.array(list(machine.truth.values()))
    model = dr.models.underwater_vehicle()
    signals = rollouts(model).trajectories(RolloutBatch([p], np.zeros(2), inputs, 0.01))[0]
    columns = dict(zip(model.signals, signals[:-2].T, strict=True)) | {"thrust": inputs[2:, 0]}
    log = dr.Log.from_arrays(np.arange(len(signals) - 2) * 0.01, columns)
    result = dr.identify(model, log)
    assert result.diagnosis.input_delay == pytest.approx(0.02, abs=1e-4)
    assert result.diagnosis.input_delay_significant
    np.testing.assert_allclose(list(result.parameters.values()), p, rtol=1e-3)


def test_windows_in_which_outliers_are_the_majority_are_carried_by_their_neighbours():
    model, signals, spoilt, bad, inputs = bursts()
    columns = dict(zip(model.signals, spoilt.T, strict=True)) | {"thrust": inputs[:, 0]}
    result = dr.identify(model, dr.Log.from_arrays(np.arange(len(signals)) * 0.01, columns))
    np.testing.assert_allclose(list(result.parameters.values()), truth("underwater-vehicle"), rtol=1e-3)
    found = np.column_stack([result.diagnosis.outliers[name] for name in model.signals])
    large = bad & (np.abs(spoilt - signals) > 1.0)
    assert (found & large).sum() > 0.99 * large.sum()
    assert (found & ~bad).sum() < 0.01 * bad.size


def bursts():
    """Model, clean and spoilt signals, which samples are outliers, and inputs: three bursts of mostly outliers."""
    machine, inputs = held(2000, seed=4)
    p = np.array(list(machine.truth.values()))
    model = dr.models.underwater_vehicle()
    signals = rollouts(model).trajectories(RolloutBatch([p], np.zeros(2), inputs, 0.01))[0]
    rng, bad = np.random.default_rng(0), np.zeros(signals.shape, bool)
    for first in (300, 900, 1500):
        bad[first : first + 120] = rng.random((120, 3)) < 0.8
    return model, signals, np.where(bad, signals + rng.uniform(0.0, 20.0, signals.shape), signals), bad, inputs


def test_progress_never_falls_though_several_delays_are_tried():
    model, _, spoilt, _, inputs = bursts()
    columns = dict(zip(model.signals, spoilt[:-4].T, strict=True)) | {"thrust": inputs[4:, 0]}
    calls = []
    dr.identify(model, dr.Log.from_arrays(np.arange(len(spoilt) - 4) * 0.01, columns), progress=calls.append)
    fractions = [x.fraction for x in calls]
    assert "errors of the recordings" in {x.stage for x in calls}
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0


# ---------------------------------------------------------------------- settings


BAD = {
    "n_samples": (-1, 2.5, True, "many", None),
    "substeps": (0, 1.5, False),
    "max_steps": (-1,),
    "smoothing_half_width": (0.0, -1.0, np.inf, np.nan, "short"),
    "prior_model_error": (-1e-3, np.nan),
    "outliers": (1, None, "yes"),
    "model_error": (0,),
}


@pytest.mark.parametrize(("name", "value"), [(n, x) for n, values in BAD.items() for x in values])
def test_setting_without_meaning_is_refused_by_its_name(name, value):
    with pytest.raises(SettingsError, match=name) as caught:
        dr.LoDiransac(**{name: value})
    assert len(str(caught.value).splitlines()) == 1


def test_criteria_that_lo_diransac_has_no_use_for_are_refused():
    with pytest.raises(SettingsError, match='"lo-diransac" has no use for the setting substeps = 3'):
        dr.LoDiransac(dr.Settings(substeps=3))


def test_settings_are_saved_with_the_result(tmp_path):
    log = as_log(MACHINES["underwater-vehicle"], *flown("underwater-vehicle"), DT)
    method = dr.LoDiransac(substeps=np.int64(3), n_samples=50)
    result = dr.identify(MODELS["underwater-vehicle"], log, method)
    assert result.options == method.options()
    assert result.options["substeps"] == 3
    assert result.iterations == 50
    result.save(tmp_path / "model.json")
    loaded = dr.Result.load(tmp_path / "model.json")
    assert loaded == result
    options = {n: tuple(x) if isinstance(x, list) else x for n, x in loaded.options.items()}
    assert dr.LoDiransac(**options) == method


def test_substeps_of_the_method_are_those_of_the_evaluation():
    log = as_log(MACHINES["servo-axis"], *flight(MACHINES["servo-axis"], 500, DT, substeps=20), DT)
    for substeps in (1, 7):
        estimate = dr.LoDiransac(substeps=substeps).fit(Dataset.of(MODELS["servo-axis"], log, pointwise=False), 0)
        assert estimate.resolution.substeps == substeps


def test_without_outliers_in_the_noise_no_sample_is_an_outlier():
    signals, inputs = flown("underwater-vehicle")
    log = as_log(MACHINES["underwater-vehicle"], with_outliers(signals, 0.1, 30.0, seed=1), inputs, DT)
    estimate = dr.LoDiransac(outliers=False).fit(Dataset.of(MODELS["underwater-vehicle"], log), 0)
    assert not any(mask.any() for mask in estimate.diagnosis.outliers.values())
    assert set(estimate.diagnosis.outlier_fraction.values()) == {0.0}
    assert relative_errors("underwater-vehicle", estimate).max() > 1e-3


LEFT_OUT = [
    {"n_samples": 0},
    {"max_steps": 0},
    {"outliers": False},
    {"model_error": False},
    {"prior_model_error": 1e-5},
    {"prior_discrepancy": 1e-6},
    {"input_delay": False, "input_lag": False},
    {"prior_model_error": 0.0},
    {"prior_discrepancy": 0.0},
]


@pytest.mark.parametrize("changes", LEFT_OUT, ids=lambda x: ", ".join(x))
def test_a_clean_log_needs_no_single_part_of_the_method(changes):
    """Each can be left out by a setting; hypotheses alone are off by what smoothing does to the motion."""
    log = as_log(MACHINES["underwater-vehicle"], *flown("underwater-vehicle"), DT)
    estimate = dr.LoDiransac(**changes).fit(Dataset.of(MODELS["underwater-vehicle"], log), 0)
    assert relative_errors("underwater-vehicle", estimate).max() < (0.2 if "max_steps" in changes else 1e-3)
