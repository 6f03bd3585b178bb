"""Rows ``W p = b``: one solver with weights, a prior, bounds and a loss, against exact special cases."""

import numpy as np
import pytest

from diransac.identification.core.rows import CAUCHY, GEMAN_MCCLURE, Rows, inclusive_bounds, solve, solve_sets
from diransac.model import Parameter

TRUTH = np.array([2.0, -1.0, 0.5])


def noisy(seed: int = 0, noise: float = 0.1, n: int = 200) -> Rows:
    rng = np.random.default_rng(seed)
    W = rng.normal(size=(n, 2, 3)) * np.array([1.0, 1e3, 1e-3])
    return Rows(W, W @ TRUTH + noise * rng.normal(size=(n, 2)))


def test_prior_and_weights_give_the_posterior_mean_and_its_covariance():
    rows, weights = noisy(), np.random.default_rng(1).uniform(0.5, 2.0, (200, 2))
    mean, std = np.array([1.0, 0.0, 0.0]), np.array([0.01, np.inf, 1e-3])
    solution = solve(rows, weights, prior=(mean, std))
    A, y = (rows.W * weights[:, :, None]).reshape(-1, 3), (rows.b * weights).ravel()
    H = A.T @ A + np.diag(std**-2)
    np.testing.assert_allclose(solution.p, np.linalg.solve(H, A.T @ y + std**-2 * mean), rtol=1e-8)
    np.testing.assert_allclose(solution.inverse, np.linalg.inv(H), rtol=1e-7)


def test_gains_are_derivatives_of_the_parameters_with_respect_to_the_known_sides():
    rows = noisy()
    change = np.random.default_rng(2).normal(size=rows.b.shape)
    moved = solve(Rows(rows.W, rows.b + change)).p - solve(rows).p
    np.testing.assert_allclose(np.einsum("pnr,nr->p", solve(rows).gains, change), moved, rtol=1e-6)


def test_solution_on_a_bound_satisfies_the_conditions_of_optimality():
    rows, lower, upper = noisy(), np.full(3, -np.inf), np.array([1.5, np.inf, np.inf])
    solution = solve(rows, bounds=(lower, upper))
    gradient = np.einsum("nri,nr->i", rows.W, -rows.residuals(solution.p))
    assert solution.held.tolist() == [True, False, False]
    assert solution.p[0] == 1.5
    assert gradient[0] < 0.0
    assert np.abs(gradient[1:] / [1e3, 1e-3]).max() < 1e-9 * abs(gradient[0])
    assert not solution.gains[0].any()


@pytest.mark.parametrize(("loss", "share"), [(CAUCHY, 0.1), (GEMAN_MCCLURE, 0.3)])
def test_loss_resists_outliers(loss, share):
    rows = noisy()
    bad = np.random.default_rng(3).random(rows.b.shape) < share
    spoilt = Rows(rows.W, np.where(bad, rows.b + 300.0, rows.b))
    plain, robust = (np.abs(solve(spoilt, loss=x).p / TRUTH - 1.0)[:2].max() for x in (None, loss))
    assert robust < 0.03 < plain


def test_parameter_without_a_row_is_zero_and_has_no_standard_error():
    rows = noisy()
    solution = solve(Rows(rows.W * np.array([1.0, 1.0, 0.0]), rows.b))
    assert solution.p[2] == 0.0
    assert np.isinf(solution.errors()).tolist() == [False, False, True]


def test_sets_of_rows_are_solved_as_each_by_itself():
    rows, masks = noisy(), np.random.default_rng(4).random((5, 200, 2)) < 0.5
    alone = [solve(rows, mask.astype(float)).p for mask in masks]
    np.testing.assert_allclose(solve_sets(rows, masks), alone, rtol=1e-9)


def test_rows_that_are_not_finite_are_refused():
    rows = noisy()
    with pytest.raises(np.linalg.LinAlgError, match="not finite"):
        solve(Rows(np.where(rows.W > 1.0, np.inf, 0.0), rows.b))


def test_positive_parameters_have_no_lower_bound_or_zero():
    parameters = [Parameter(positive=True), Parameter(lower=-2.0, upper=3.0)]
    assert [x.tolist() for x in inclusive_bounds(parameters)] == [[-np.inf, -2.0], [np.inf, 3.0]]
    assert inclusive_bounds(parameters, zero=True)[0].tolist() == [0.0, -2.0]
