"""Set-points as instruments: a machine whose controller answers gusts that the model lacks.

A mass on a rail follows a set-point by a proportional-derivative controller, simulated by small steps of its own.
Gusts within the controller's bandwidth move it against the force that answers them, so that least squares of the true
motion is biased, whatever the sensors.
"""

import json

import numpy as np
import pytest
from scipy import stats

import diransac as dr
from diransac.data.dataset import Dataset
from diransac.errors import SettingsError
from diransac.identification.estimate import Estimate
from diransac.identification.methods.lo_diransac.instruments import _cross_fitted
from diransac.identification.methods.lo_diransac.projection import Contrast, _instrumented_gains, least_squares_gains
from diransac.identification.serialization import dump, load

DT, FINE, N_ROWS = 0.02, 10, 1000
TRUE = {"mass": 2.0, "viscous": 3.0}
MODEL = dr.Model(
    "rail",
    {"x": "m"},
    {"force": "N"},
    {"mass": dr.Parameter("kg", positive=True), "viscous": dr.Parameter("N s/m")},
    lambda q, v, a, u, p: [p.mass * a.x + p.viscous * v.x - u.force],
)


def sines(t, rng, n, low, high):
    """Sum of sines of a standard deviation of one."""
    rates, phases = 2.0 * np.pi * np.geomspace(low, high, n), rng.uniform(0.0, 6.3, n)
    return np.sin(np.outer(t, rates) + phases).sum(axis=1) * np.sqrt(2.0 / n)


def rail_log(gusts, seed=0):
    """A log with the set-point, in which gusts have a standard deviation in N."""
    rng, t, h = np.random.default_rng(seed), DT * np.arange(N_ROWS), DT / FINE
    wanted = 0.3 * sines(t, rng, 6, 0.1, 0.8)
    gust = gusts * sines(h * np.arange(N_ROWS * FINE), rng, 20, 0.7, 2.0)
    x, v, rows = wanted[0], 0.0, []
    for k in range(N_ROWS):
        force = 20.0 * (wanted[k] - x) - 2.0 * v
        rows.append((x, v, force))
        for i in range(FINE):
            a = (force + gust[FINE * k + i] - TRUE["viscous"] * v) / TRUE["mass"]
            middle = v + 0.5 * h * a  # the midpoint rule
            x, v = x + h * middle, v + h * (force + gust[FINE * k + i] - TRUE["viscous"] * middle) / TRUE["mass"]
    x, v, force = np.array(rows).T
    noisy = {"x": x + 1e-4 * rng.standard_normal(N_ROWS), "x_dot": v + 1e-3 * rng.standard_normal(N_ROWS)}
    columns = {
        **noisy,
        "force": force,
        "x_ref": wanted,
        "other": rng.standard_normal(N_ROWS).cumsum(),
        "mode": np.ones(N_ROWS),
    }
    return dr.Log.from_arrays(t, columns)


PLAIN = {"suggestions": False, "input_delay": False, "input_lag": False, "max_recording_errors": 0, "n_samples": 30}


def estimate(log, **options):
    return dr.LoDiransac(**PLAIN, **options).fit(Dataset.of(MODEL, log, pointwise=False), 0)


def covers(found, name):
    k = list(found.parameters).index(name)
    return abs(found.parameters[name] - TRUE[name]) < 1.96 * np.sqrt(found.covariance[k, k])


@pytest.fixture(scope="module")
def gusty():
    return rail_log(gusts=4.0)


@pytest.fixture(scope="module")
def weak(gusty):
    """With set-points that say nothing: least squares on the fitted motion stays."""
    return estimate(gusty, set_points=("other", "mode"))


def test_set_points_correct_an_estimate_that_feedback_biases(gusty, weak):
    found = estimate(gusty, set_points="x_ref")
    (mass, *_), tests = found.parameters.values(), {x.parameter: x for x in found.diagnosis.hausman_tests}
    assert not covers(weak, "mass")
    assert covers(found, "mass")
    assert abs(mass - TRUE["mass"]) < abs(weak.parameters["mass"] - TRUE["mass"]) / 3.0
    assert tests["mass"].outcome == "rejected"
    assert (tests["mass"].plain, tests["mass"].instrumented) == pytest.approx((weak.parameters["mass"], mass))
    assert load(Estimate, json.loads(json.dumps(dump(found)))).diagnosis.hausman_tests == tuple(tests.values())
    said = next(x for x in found.checks if "with the set-points x_ref as instruments" in x)
    assert said.level == "care"
    assert said.startswith("Unmodelled forces are correlated with the motion: mass is ")


def test_weak_instruments_change_nothing_and_are_named(weak):
    assert {x.outcome for x in weak.diagnosis.hausman_tests} == {"weak"}
    assert weak.parameters == pytest.approx({x.parameter: x.plain for x in weak.diagnosis.hausman_tests})
    said = next(x for x in weak.checks if x.startswith("Set-points are weak instruments for mass and viscous"))
    assert said.level == "note"


def test_an_exact_model_needs_no_instruments():
    found = estimate(rail_log(gusts=0.0), set_points="x_ref")
    assert found.diagnosis.hausman_tests == ()
    assert not any("instruments" in x for x in found.checks)


@pytest.mark.parametrize(
    ("names", "says"),
    [
        ("y_ref", r'set_points names "y_ref", which .* lacks; it has x, x_dot, force, x_ref, other, mode, cut'),
        ("x_dot", 'set_points names "x_dot", which is measured and answers disturbances'),
        ("cut", 'set_points names "cut", which has no value in 3 rows'),
        ("mode", "set_points names mode: constant in"),
        (None, "set_points is None; give names of columns"),
    ],
)
def test_columns_that_are_no_instruments_are_refused(gusty, names, says):
    cut = np.where(np.arange(N_ROWS) < 3, np.nan, gusty["x_ref"])
    log = dr.Log.from_arrays(gusty.time, {**gusty.signals, "cut": cut})
    with pytest.raises(SettingsError, match=says):
        estimate(log, set_points=names)


def test_instruments_that_are_the_regressors_are_least_squares():
    rng = np.random.default_rng(0)
    W, weights = rng.normal(size=(20, 2, 3)), rng.uniform(0.5, 2.0, (20, 2))
    np.testing.assert_allclose(_instrumented_gains(W, W, weights), least_squares_gains(W, weights), atol=1e-12)
    b = W @ [1.0, 2.0, 3.0]
    exact = np.einsum("pwi,wi->p", _instrumented_gains(W, rng.normal(size=W.shape), weights), b)
    np.testing.assert_allclose(exact, [1.0, 2.0, 3.0])


def test_predictions_of_a_tenth_of_a_log_do_not_depend_on_it():
    rng = np.random.default_rng(0)
    columns, signals, folds = rng.normal(size=(200, 3)), rng.normal(size=(200, 2)), np.arange(200) // 20
    changed = np.where((folds == 4)[:, None], 100.0 * signals, signals)
    both = [_cross_fitted(columns, x, folds, ridges=np.array([1e-6])) for x in (signals, changed)]
    np.testing.assert_array_equal(*(x[folds == 4] for x in both))
    exact = columns @ rng.normal(size=(3, 2)) + 5.0
    np.testing.assert_allclose(_cross_fitted(columns, exact, folds), exact, atol=1e-9)


def test_set_points_that_are_constant_but_in_one_tenth_of_a_log_predict_the_mean():
    signals, folds = np.random.default_rng(0).normal(size=(100, 2)), np.arange(100) // 10
    found = _cross_fitted((folds == 9)[:, None].astype(float), signals, folds)
    np.testing.assert_allclose(found[90:], np.tile(signals[:90].mean(axis=0), (10, 1)))


@pytest.mark.parametrize("n_batches", [6, 20])
def test_critical_values_are_those_of_students_t(n_batches):
    none = np.zeros(1)
    contrast = Contrast(none, none, np.eye(1), n_batches, none, np.eye(1, dtype=bool))
    quantiles = stats.t(n_batches - 1).ppf([0.975, 0.9995])
    assert contrast.critical(0.05) == pytest.approx(1.959963984540054)
    assert contrast.critical(0.001) == pytest.approx(1.959963984540054 * quantiles[1] / quantiles[0])
