"""Estimators: NumPy's answers, no dependence on units, and refusals of what a log cannot tell."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.linear_model import (
    HuberRegressor,
    Lasso,
    LinearRegression,
    QuantileRegressor,
    RANSACRegressor,
    Ridge,
    TheilSenRegressor,
)
from sklearn.neighbors import KNeighborsRegressor
from sklearn.svm import LinearSVR

import diransac as dr
from diransac.data.dataset import Dataset
from diransac.errors import IdentificationError, SettingsError
from diransac.identification.regression.estimators import solve_definite
from diransac.identification.regression.scikit_learn import as_estimator
from diransac.model.library import builtin
from simulated import MACHINES, as_log, flight

OURS = [dr.OrdinaryLeastSquares(), dr.TotalLeastSquares()]
SEEDS = st.integers(0, 2**32 - 1)


def random_problem(seed, n=40, r=2, n_p=3, noise=0.1):
    rng = np.random.default_rng(seed)
    W = rng.normal(size=(n, r, n_p))
    return W, W @ rng.normal(size=n_p) + noise * rng.normal(size=(n, r))


def total_least_squares(W, b):
    """Golub and Van Loan: by the singular vector of ``[W b]`` in columns of unit RMS."""
    columns = np.column_stack([W.reshape(-1, W.shape[-1]), b.ravel()])
    scale = np.sqrt((columns**2).mean(axis=0))
    last = np.linalg.svd(columns / scale)[2][-1]
    return -last[:-1] / last[-1] * scale[-1] / scale[:-1]


def bound(estimator, name="planar-rotorcraft", n_rows=300):
    machine = MACHINES[name]
    signals, inputs = flight(machine, n_rows, 0.02)
    noisy = signals + 0.05 * signals.std(axis=0) * np.random.default_rng(0).normal(size=signals.shape)
    dataset = Dataset.of(builtin(name), as_log(machine, noisy, inputs, 0.02))
    return estimator.bind(dataset), *machine.rows(noisy, inputs)


# ---------------------------------------------------------------------- ours


@given(seed=SEEDS)
def test_ordinary_least_squares_is_numpys(seed):
    W, b = random_problem(seed)
    expected = np.linalg.lstsq(W.reshape(-1, 3), b.ravel(), rcond=None)[0]
    assert dr.OrdinaryLeastSquares().fit(W, b) == pytest.approx(expected, rel=1e-9, abs=1e-12)


@given(seed=SEEDS)
def test_total_least_squares_is_that_of_the_singular_values(seed):
    W, b = random_problem(seed)
    assert dr.TotalLeastSquares().fit(W, b) == pytest.approx(total_least_squares(W, b), rel=1e-7, abs=1e-9)


def test_total_least_squares_sees_through_noise_in_the_regressors():
    """Noise of one size, relative to its RMS, in every column: OLS shrinks, TLS does not (20,000 rows)."""
    rng = np.random.default_rng(3)
    clean = rng.normal(size=(20_000, 1, 1))
    W = clean + 0.3 * rng.normal(size=clean.shape)
    b = (2.0 * clean + 0.6 * rng.normal(size=clean.shape))[:, :, 0]
    assert dr.TotalLeastSquares().fit(W, b) == pytest.approx([2.0], rel=0.02)
    assert dr.OrdinaryLeastSquares().fit(W, b) == pytest.approx([2.0 / 1.09], rel=0.02)


@pytest.mark.parametrize("estimator", OURS)
@given(seed=SEEDS, powers=st.lists(st.integers(-12, 12), min_size=4, max_size=4))
def test_units_change_the_numbers_of_an_estimate_and_nothing_else(estimator, seed, powers):
    W, b = random_problem(seed)
    units = 10.0 ** np.array(powers)
    rescaled = estimator.fit(W * units[:3], b * units[3])
    assert rescaled * units[:3] / units[3] == pytest.approx(estimator.fit(W, b), rel=1e-9)
    assert estimator.well_defined(W * units[:3], b * units[3])


@pytest.mark.parametrize("estimator", OURS)
@given(powers=st.lists(st.integers(-12, 12), min_size=4, max_size=4), near=st.sampled_from([1e-2, 1e-3, 1e-5, 0.0]))
def test_units_never_decide_whether_a_solution_is_well_defined(estimator, powers, near):
    W, b = random_problem(0)
    W[..., 2] = W[..., 1] + near * W[..., 2]
    units = 10.0 ** np.array(powers)
    assert estimator.well_defined(W * units[:3], b * units[3]) == estimator.well_defined(W, b)


@pytest.mark.parametrize("estimator", OURS)
@pytest.mark.parametrize("spoil", ["zero column", "twin columns", "too few rows"])
def test_parameters_that_the_rows_do_not_determine_are_not_well_defined(estimator, spoil):
    W, b = random_problem(1, n=1 if spoil == "too few rows" else 40)
    if spoil == "zero column":
        W[..., 1] = 0.0
    if spoil == "twin columns":
        W[..., 1] = 3.0 * W[..., 0]
    assert not estimator.well_defined(W, b)


@pytest.mark.parametrize("estimator", OURS)
@pytest.mark.parametrize(
    ("W", "b"),
    [
        (np.ones((4, 2)), np.ones(3)),
        (np.ones(4), np.ones(4)),
        (np.full((4, 2), np.nan), np.ones(4)),
        (np.ones((4, 2)), np.full(4, np.inf)),
    ],
    ids=["lengths", "dimensions", "NaN", "infinity"],
)
def test_arrays_that_do_not_fit_are_refused(estimator, W, b):
    with pytest.raises(IdentificationError):
        estimator.fit(W, b)


@pytest.mark.parametrize("estimator", OURS)
def test_input_arrays_are_left_alone(estimator):
    W, b = random_problem(2)
    W.flags.writeable = b.flags.writeable = False
    estimator.fit(W, b)


# ---------------------------------------------------------------------- bound to a log


@pytest.mark.parametrize("estimator", OURS)
def test_bound_estimator_fits_each_set_of_rows_as_if_it_were_alone(estimator):
    it, W, b = bound(estimator)
    rng = np.random.default_rng(5)
    sets = [rng.permutation(it.n_rows)[:n] for n in (4, 40, 75, 300)]
    alone = {dr.OrdinaryLeastSquares: lambda W, b: np.linalg.lstsq(W.reshape(-1, 3), b.ravel(), rcond=None)[0]}
    if type(estimator) in alone:
        expected = [alone[type(estimator)](W[rows], b[rows]) for rows in sets]
        assert it.select(sets).fit() == pytest.approx(np.array(expected), rel=1e-8)
    one_by_one = np.concatenate([it.select([rows]).fit() for rows in sets])
    assert np.array_equal(it.select(sets).fit(), one_by_one)


def test_bound_total_least_squares_scales_columns_by_the_whole_log():
    """Every column counts as noisy as any other over the log, not over the few rows of a sample."""
    it, W, b = bound(dr.TotalLeastSquares())
    columns = np.concatenate([W, b[:, :, None]], axis=2)
    scale = np.sqrt((columns**2).mean(axis=(0, 1)))
    rows = np.arange(0, 300, 7)
    last = np.linalg.svd((columns[rows] / scale).reshape(-1, 4))[2][-1]
    assert it.select([rows]).fit()[0] == pytest.approx(-last[:-1] / last[-1] * scale[-1] / scale[:-1], rel=1e-8)


@pytest.mark.parametrize("estimator", [*OURS, dr.ScikitLearnEstimator(LinearRegression())])
def test_leaving_rows_out_is_fitting_the_others(estimator):
    it, _, _ = bound(estimator)
    rows = np.arange(20, 280)
    groups = np.array_split(rows, 7)
    others = [np.setdiff1d(rows, group) for group in groups]
    assert it.fit_without(groups, rows) == pytest.approx(it.select(others).fit(), rel=1e-9)


def test_rows_whose_regressor_is_tiny_against_the_log_are_not_well_defined():
    """Scaled by its own columns, a set whose drag column is 1e-34 would pass."""
    machine = MACHINES["planar-rotorcraft"]
    signals, inputs = flight(machine, 200, 0.02)
    signals[:5, 3:5] = 1e-34
    it = dr.OrdinaryLeastSquares().bind(
        Dataset.of(builtin("planar-rotorcraft"), as_log(machine, signals, inputs, 0.02))
    )
    sets = [np.arange(5), np.arange(5, 10), np.array([], dtype=int)]
    assert it.select(sets).well_defined().tolist() == [False, True, False]


def test_undetermined_parameters_are_named_and_no_others():
    """A rotorcraft that never turns shows no inertia; one that never moves shows no drag either."""
    machine, model = MACHINES["planar-rotorcraft"], builtin("planar-rotorcraft")
    signals, inputs = flight(machine, 200, 0.02)
    still, moments = signals.copy(), inputs.copy()
    still[:, 8], moments[:, 1] = 0.0, 0.0
    hovering = still.copy()
    hovering[:, 3:5] = 0.0
    for changed, names in ((still, "inertia"), (hovering, "inertia, drag")):
        with pytest.raises(IdentificationError, match=f"{names} (is|are) not identifiable from this log:"):
            dr.identify(model, as_log(machine, changed, moments, 0.02), "ols")


def test_parameters_that_move_together_are_all_named():
    """At constant speed, linear and quadratic drag and a bias are one force."""
    machine, model = MACHINES["underwater-vehicle"], builtin("underwater-vehicle")
    rng = np.random.default_rng(0)
    signals = np.column_stack([0.5 * np.arange(200) * 0.1, np.full(200, 0.5), rng.normal(size=200)])
    inputs = (60.0 * signals[:, 2] + 40.0)[:, None]
    with pytest.raises(IdentificationError, match="linear_drag, quadratic_drag, bias"):
        dr.identify(model, as_log(machine, signals, inputs, 0.1), "ols")


# ---------------------------------------------------------------------- the solver


@given(seed=SEEDS, n=st.integers(1, 9))
def test_solver_of_definite_systems_is_numpys(seed, n):
    rng = np.random.default_rng(seed)
    J, g = rng.normal(size=(5, 3 * n, n)), rng.normal(size=(5, n))
    A = J.transpose(0, 2, 1) @ J
    assert solve_definite(A, g) == pytest.approx(np.linalg.solve(A, g[..., None])[..., 0], rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("A", [np.zeros((2, 2)), np.diag([1.0, -1.0]), np.ones((2, 2)), np.full((2, 2), np.nan)])
def test_solver_gives_nan_where_the_matrix_is_not_definite(A):
    assert np.isnan(solve_definite(A, np.ones(2))).all()


# ---------------------------------------------------------------------- scikit-learn's


def test_scikit_learns_least_squares_is_ours():
    theirs, _, _ = bound(dr.ScikitLearnEstimator(LinearRegression()))
    ours, _, _ = bound(dr.OrdinaryLeastSquares())
    rows = np.arange(0, 300, 3)
    assert theirs.select([rows]).fit() == pytest.approx(ours.select([rows]).fit(), rel=1e-9)
    assert theirs.select([rows]).well_defined().tolist() == [True]


@pytest.mark.parametrize(
    ("regressor", "tolerance"),
    [
        (LinearRegression(), 1e-9),
        (Ridge(alpha=1e-6), 1e-6),
        (Lasso(alpha=1e-7), 1e-4),
        (HuberRegressor(), 1e-4),
        (TheilSenRegressor(max_subpopulation=300), 0.2),
        (RANSACRegressor(), 1e-9),
        (RANSACRegressor(estimator=Ridge(alpha=1e-6), min_samples=10), 1e-4),
        (QuantileRegressor(alpha=0.0), 1e-6),
        (LinearSVR(max_iter=100_000, epsilon=0.0, C=100.0), 1e-2),
    ],
    ids=lambda x: re.sub(r"\W+", " ", repr(x)) if hasattr(x, "fit") else "",
)
def test_any_linear_regressor_serves_inside_a_search(regressor, tolerance):
    machine = MACHINES["planar-rotorcraft"]
    signals, inputs = flight(machine, 100, 0.02)
    settings = dr.Settings(sample_size=40, max_iterations=2)
    before = repr(regressor)
    model, log = builtin("planar-rotorcraft"), as_log(machine, signals, inputs, 0.02)
    result = dr.identify(model, log, "i-diransac", estimator=regressor, settings=settings)
    assert result.parameters == pytest.approx(machine.truth, rel=tolerance)
    assert result.estimator == type(regressor).__name__
    assert repr(regressor) == before
    again = dr.identify(model, log, "i-diransac", estimator=regressor, settings=settings)
    assert again.parameters == result.parameters


@pytest.mark.parametrize(
    "candidate",
    [dr.OrdinaryLeastSquares, LinearRegression, "ols", KNeighborsRegressor(), 3],
    ids=["our class", "their class", "a name", "no linear regressor", "a number"],
)
def test_what_is_no_estimator_is_refused(candidate):
    with pytest.raises(SettingsError):
        as_estimator(candidate)


def test_our_estimators_pass_as_they_are():
    for estimator in (*OURS, dr.NonlinearLeastSquares(), dr.ScikitLearnEstimator(Ridge())):
        assert as_estimator(estimator) is estimator
