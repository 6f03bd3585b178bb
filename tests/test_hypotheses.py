"""Hypotheses of lo-diransac: equations without known terms."""

import numpy as np
import pytest

from diransac.identification.methods.lo_diransac.hypotheses import WeakForm, equation_scales

TRUTH = np.array([9e-3, 1.8e-3, 2.6e-3, 4e-3, 3e-4])


def noisy_rows(seed: int, noise: float = 0.1, n: int = 400) -> WeakForm:
    """Rows of ``p0 x0 + p1 x1 + p2 x2 + p3 x3 = u`` and of ``p1 y1 + p2 y2 + p4 y4 = 0``, with noise in every number.

    In the first equation, p0 explains all but a few percent of u by itself.
    """
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(2, n, 5))
    x[:, 1:3] = 0.3 * x[:, 1:3] + x[:, :1] * (1.0, -1.0)
    y[:, 1] = -(TRUTH[2] * y[:, 2] + TRUTH[4] * y[:, 4]) / TRUTH[1]
    W = np.stack([x * (1, 1, 1, 1, 0), y * (0, 1, 1, 0, 1)], axis=1)
    b = np.column_stack([W[:, 0] @ TRUTH, np.zeros(n)])
    return WeakForm(
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
    scaled = WeakForm(rows.W / scale[:, None], rows.b / scale)
    (found,) = scaled.solve_sized(np.ones((1, *rows.b.shape), bool))
    np.testing.assert_allclose(found[:4], TRUTH[:4], rtol=0.25)


def test_exact_rows_give_exact_parameters_in_any_unit_of_the_equations():
    rows = noisy_rows(0, noise=0.0)
    units = np.array([1e6, 1e-6])
    (found,) = WeakForm(rows.W * units[:, None], rows.b * units).solve_sized(np.ones((1, *rows.b.shape), bool))
    np.testing.assert_allclose(found, TRUTH, rtol=1e-5)
