"""Hypotheses of lo-diransac: equations without known terms, and samples that depend on seed and index alone."""

import numpy as np
import pytest

import diransac as dr
from diransac.identification.core.rows import Rows, solve_sized
from diransac.identification.methods.lo_diransac.hypotheses import equation_scales, random_sets

TRUTH = np.array([9e-3, 1.8e-3, 2.6e-3, 4e-3, 3e-4])


def noisy_rows(seed: int, noise: float = 0.1, n: int = 400) -> Rows:
    """Rows of ``p0 x0 + p1 x1 + p2 x2 + p3 x3 = u`` and of ``p1 y1 + p2 y2 + p4 y4 = 0``, with noise in every number.

    In the first equation, p0 explains all but a few percent of u by itself.
    """
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(2, n, 5))
    x[:, 1:3] = 0.3 * x[:, 1:3] + x[:, :1] * (1.0, -1.0)
    y[:, 1] = -(TRUTH[2] * y[:, 2] + TRUTH[4] * y[:, 4]) / TRUTH[1]
    W = np.stack([x * (1, 1, 1, 1, 0), y * (0, 1, 1, 0, 1)], axis=1)
    b = np.column_stack([W[:, 0] @ TRUTH, np.zeros(n)])
    return Rows(
        W * (1.0 + noise * rng.normal(size=W.shape)),
        b + np.array([1.0, 0.0]) * noise * b[:, :1].std() * rng.normal(size=b.shape),
    )


@pytest.mark.parametrize("seed", range(3))
def test_scale_of_an_equation_without_a_known_term_is_that_of_its_residuals_at_the_truth(seed):
    rows = noisy_rows(seed)
    residuals = np.median(np.abs(rows.W @ TRUTH - rows.b), axis=0)
    np.testing.assert_allclose(equation_scales(rows), residuals, rtol=0.5)


@pytest.mark.parametrize("seed", range(3))
def test_noise_in_an_equation_without_a_known_term_does_not_shrink_the_parameters(seed):
    rows = noisy_rows(seed)
    scale = equation_scales(rows)
    (found,) = solve_sized(rows.over(scale), np.ones((1, *rows.b.shape), bool))
    np.testing.assert_allclose(found[:4], TRUTH[:4], rtol=0.25)


def test_exact_rows_give_exact_parameters_in_any_unit_of_the_equations():
    rows = noisy_rows(0, noise=0.0)
    units = np.array([1e6, 1e-6])
    (found,) = solve_sized(rows.over(1.0 / units), np.ones((1, *rows.b.shape), bool))
    np.testing.assert_allclose(found, TRUTH, rtol=1e-5)


def test_sample_k_depends_on_seed_and_k_alone():
    rows = noisy_rows(0)
    few, more, other = (random_sets(dr.LoDiransac(n_samples=n), rows, seed) for n, seed in ((50, 3), (51, 3), (50, 4)))
    np.testing.assert_array_equal(few, more[:51])
    assert not (few[1:] == other[1:]).all(axis=(1, 2)).any()


def test_random_sets_have_as_many_rows_of_each_equation_and_up_to_the_largest_sample():
    rows, settings = noisy_rows(0), dr.LoDiransac(n_samples=300)
    every, *sets = random_sets(settings, rows, 0)
    counts = np.array([one.sum(axis=0) for one in sets])
    assert every.all()
    np.testing.assert_array_equal(counts[:, 0], counts[:, 1])
    assert (counts.min(), counts.max()) == (5, 20)
    assert not np.array_equal(sets[0][:, 0], sets[0][:, 1])
    # Each row is drawn as often as chance has it: a mean of 300 samples of 12.5 of 400 rows, within 6 standard errors.
    share = np.mean(sets, axis=(0, 2))
    assert np.abs(share - 12.5 / 400).max() < 6.0 * np.sqrt(12.5 / 400 / 600)
