"""Standard errors: an exact special case, Monte-Carlo coverage, and infinity where a log cannot tell."""

from functools import cache

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom
from scipy.stats import t as student

import diransac as dr
from diransac.data.dataset import Dataset
from diransac.identification.regression.uncertainty import (
    N_BLOCKS,
    jackknife_covariance,
    student_quantile,
    students_draws,
)
from diransac.model.library import builtin
from simulated import MACHINES, as_log, flight

TRIALS = 150


def level(**changes):
    """A model whose one parameter is the mean acceleration."""
    return dr.Model(
        name="level",
        coordinates={"x": "m"},
        inputs={},
        parameters={"c": dr.Parameter("m/s^2")},
        equations=lambda q, v, a, u, p: [a.x - p.c],
    )


def autoregressive(rng, n, memory):
    """Noise of unit variance whose correlation falls by ``memory`` from one sample to the next."""
    white = rng.normal(size=n + 1000)
    return lfilter([np.sqrt(1.0 - memory**2)], [1.0, -memory], white)[1000:]


@cache
def clean(name, n, dt):
    return flight(MACHINES[name], n, dt)


def covered(name, memory, n=2500):
    """How often the 95 % interval of each parameter holds the truth, with noise in the equation of every row."""
    model, machine, dt = builtin(name), MACHINES[name], 0.02 if name == "underwater-vehicle" else 0.01
    signals, inputs = clean(name, n, dt)
    truth, hits = list(machine.truth.values()), np.zeros(len(machine.truth))
    for trial in range(TRIALS):
        rng = np.random.default_rng([7, trial])
        noise = np.column_stack([autoregressive(rng, n, memory) for _ in inputs.T])
        log = as_log(machine, signals, inputs + 0.2 * inputs.std(axis=0) * noise, dt)
        found = dr.LeastSquares().fit(Dataset.of(model, log), seed=0)  # without the tests of columns of `identify`
        width = student_quantile(found.degrees_of_freedom, 0.975) * np.sqrt(np.diag(found.covariance))
        hits += np.abs(np.array(list(found.parameters.values())) - truth) <= width
    return hits / TRIALS


@pytest.mark.parametrize(
    ("name", "memory"),
    [("underwater-vehicle", 0.0), ("underwater-vehicle", 0.95), ("planar-rotorcraft", 0.95)],
    ids=["white", "autocorrelated", "autocorrelated, in two inputs"],
)
def test_95_percent_intervals_hold_the_truth_95_times_in_100(name, memory):
    """Autocorrelated: over 20 samples, where the textbook's standard errors would be 6 times too small."""
    share = covered(name, memory)
    assert share.min() >= 0.90
    assert share.max() <= 0.99


def test_intervals_of_nonlinear_least_squares_hold_the_truth_as_often():
    machine, trials = MACHINES["underwater-vehicle"], 40
    signals, inputs = clean("underwater-vehicle", 200, 0.05)
    truth, hits = np.array(list(machine.truth.values())), np.zeros(4)
    quick, model = dr.NonlinearLeastSquares(n_starts=5, n_followed=1), builtin("underwater-vehicle")
    width = student.ppf(0.975, N_BLOCKS - 1)
    for trial in range(trials):
        noisy = signals.copy()
        noisy[:, 2] += 0.1 * np.random.default_rng([3, trial]).normal(size=200)
        bound = quick.bind(Dataset.of(model, as_log(machine, noisy, inputs, 0.05)))
        rows = np.arange(200)
        errors = np.sqrt(np.diag(jackknife_covariance(bound, rows)))
        hits += np.abs(bound.select([rows]).fit()[0] - truth) <= width * errors
    lowest, highest = binom.ppf([0.001, 0.999], trials, 0.95)
    assert hits.min() >= lowest
    assert hits.max() <= highest


def test_standard_error_of_a_mean_is_that_of_the_means_of_stretches():
    """With stretches of one length: ``sqrt(var(means) / n)``, exactly."""
    rng = np.random.default_rng(0)
    a = rng.normal(3.0, 1.0, 40 * N_BLOCKS)
    log = dr.Log.from_arrays(np.arange(len(a)) * 0.01, {"x_ddot": a})
    result = dr.identify(level(), log, "ols")
    means = a.reshape(N_BLOCKS, -1).mean(axis=1)
    assert result.parameters["c"] == pytest.approx(a.mean())
    assert result.standard_errors["c"] == pytest.approx(means.std(ddof=1) / np.sqrt(N_BLOCKS), rel=1e-9)
    assert result.degrees_of_freedom == N_BLOCKS - 1


def test_covariance_is_symmetric_and_not_negative():
    signals, inputs = clean("planar-rotorcraft", 400, 0.01)
    machine = MACHINES["planar-rotorcraft"]
    noisy = inputs + 0.1 * np.random.default_rng(0).normal(size=inputs.shape)
    covariance = dr.identify(builtin("planar-rotorcraft"), as_log(machine, signals, noisy, 0.01), "ols").covariance
    assert np.array_equal(covariance, covariance.T)
    assert (np.linalg.eigvalsh(covariance) > -1e-18).all()


def test_variance_is_infinite_where_one_stretch_alone_determines_a_parameter():
    """The axis turns back in one short stretch: without it, dry friction and offset are one force."""
    rng, n = np.random.default_rng(0), 1000
    v = 1.0 + 0.5 * rng.random(n)
    v[320:340] *= -1.0
    a = rng.normal(size=n)
    force = 95.0 * a + 200.0 * v + 20.0 * np.sign(v) - 3.0 + rng.normal(size=n)
    columns = {"position": 0.01 * np.cumsum(v), "position_dot": v, "position_ddot": a, "force": force}
    result = dr.identify(builtin("servo-axis"), dr.Log.from_arrays(np.arange(n) * 0.01, columns), "ols")
    assert np.isinf(list(result.standard_errors.values())).all()
    assert "unknown" in str(result)


@pytest.mark.parametrize("n", [2, 7])
def test_fewer_rows_than_stretches_leave_out_one_row_at_a_time(n):
    a = np.random.default_rng(1).normal(size=n)
    bound = dr.OrdinaryLeastSquares().bind(Dataset.of(level(), dr.Log.from_arrays(np.arange(n) * 0.1, {"x_ddot": a})))
    expected = a.var(ddof=1) / n
    assert jackknife_covariance(bound, np.arange(n)) == pytest.approx(np.array([[expected]]), rel=1e-9)


def test_single_row_has_no_standard_error():
    bound = dr.OrdinaryLeastSquares().bind(Dataset.of(level(), dr.Log.from_arrays([0.0, 0.1], {"x_ddot": [1.0, 2.0]})))
    assert np.isinf(jackknife_covariance(bound, np.array([0]))).all()


def test_draws_have_the_joint_distribution_within_bounds():
    covariance = np.array([[4.0, 1.2], [1.2, 1.0]])
    free = [dr.Parameter(), dr.Parameter()]
    draws = students_draws(np.array([3.0, -1.0]), covariance, 40, free, 40_000, 0)
    # The variance of Student's t is n / (n - 2) times the squared scale.
    assert np.cov(draws) == pytest.approx(covariance * 40 / 38, rel=0.04)
    assert draws.mean(axis=1) == pytest.approx([3.0, -1.0], abs=0.05)
    bounded = students_draws(np.array([3.0, -1.0]), covariance, 40, [dr.Parameter(lower=4.0), free[1]], 5_000, 0)
    assert bounded.shape == (2, 5_000)
    assert bounded[0].min() >= 4.0
    assert bounded[1].mean() > -1.0  # moves with the other
    with pytest.raises(dr.ResultError, match="0 of 1000 draws are within the bounds"):
        students_draws(np.array([3.0, -1.0]), covariance, 40, [dr.Parameter(lower=90.0), free[1]], 3, 0)


@pytest.mark.parametrize("degrees_of_freedom", [1, 2, 3, 9, 100, 10_000])
@pytest.mark.parametrize("probability", [0.5, 0.6, 0.841, 0.975, 0.9999])
def test_quantiles_of_students_t_are_those_of_scipy(degrees_of_freedom: int, probability: float):
    expected = student(degrees_of_freedom).ppf(probability)
    assert student_quantile(degrees_of_freedom, probability) == pytest.approx(expected, rel=1e-11, abs=1e-12)
