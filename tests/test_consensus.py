"""Eq. (2), eq. (3) and where the two variants differ, by hand."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diransac.identification.methods.consensus import (
    Diransac,
    InlierBiasedDiransac,
    Score,
    mean_squared_error,
    rms_error,
)

SQUARES = np.array([[8.0, 18.0, 2.0], [0.0, 50.0, 32.0]])
WEIGHTS = np.array([1.0, 0.0, 0.5])
FINITE = st.floats(0.0, 1e200)
FRACTIONS = st.integers(0, 100).map(lambda n: n / 100)


def test_rms_error_is_eq_2():
    assert rms_error(SQUARES, 2, WEIGHTS) == pytest.approx([2.0 + 0.5 * 1.0, 0.0 + 0.5 * 4.0], rel=1e-15)


def test_mean_squared_error_is_eq_2_without_the_root():
    assert mean_squared_error(SQUARES, 2, WEIGHTS) == pytest.approx([4.0 + 0.5 * 1.0, 0.5 * 16.0], rel=1e-15)


@pytest.mark.parametrize("error", [rms_error, mean_squared_error])
def test_signal_of_zero_weight_adds_no_zero_times_infinity(error):
    assert error(np.array([[2.0, np.inf]]), 2, np.array([1.0, 0.0])) == [1.0]


@pytest.mark.parametrize("error", [rms_error, mean_squared_error])
def test_divergence_in_a_signal_of_any_weight_is_infinite(error):
    assert error(np.array([[2.0, np.inf]]), 2, np.array([1.0, 1e-12])) == [np.inf]


@pytest.mark.parametrize("error", [rms_error, mean_squared_error])
def test_error_of_a_hypothesis_does_not_depend_on_its_neighbours(error):
    squares = np.random.default_rng(0).uniform(size=(33, 5))
    weights = np.array([1.0, 0.3, 0.0, 0.7, 0.1])
    one_by_one = np.concatenate([error(row[None], 7, weights) for row in squares])
    assert np.array_equal(error(squares, 7, weights), one_by_one)


# ---------------------------------------------------------------------- eq. (3)


@given(e=FINITE, f=FRACTIONS, best_e=FINITE, best_f=FRACTIONS, nu=st.tuples(FINITE, FINITE))
def test_acceptance_is_eq_3_wherever_it_has_a_meaning(e, f, best_e, best_f, nu):
    accepted = InlierBiasedDiransac(nu).accepts(Score(e, f), Score(best_e, best_f))
    with np.errstate(all="ignore"):
        new, best = (
            np.float64(nu[0]) * np.float64(error) ** 2 + np.float64(nu[1]) * np.float64(1.0) / np.float64(part) ** 2
            for error, part in ((e, f), (best_e, best_f))
        )
    if np.isfinite(new) and np.isfinite(best) and abs(new - best) > 1e-9 * max(new, best):
        assert accepted == (new < best)


def test_the_first_hypothesis_is_accepted_over_nothing():
    assert InlierBiasedDiransac((1.0, 0.06)).accepts(Score(1e6, 0.001), Score())


@pytest.mark.parametrize(
    ("nu", "new", "best", "accepted"),
    [
        ((1.0, 0.06), Score(1.0, 0.0), Score(), False),
        ((1.0, 0.0), Score(1.0, 0.0), Score(), True),
        ((0.0, 1.0), Score(math.inf, 0.1), Score(), True),
        ((0.0, 1.0), Score(math.inf, 0.1), Score(1.0, 0.2), False),
        ((0.0, 1.0), Score(1.0, 0.0), Score(), False),
        ((1.0, 0.0), Score(math.inf, 0.9), Score(), False),
        ((1.0, 0.06), Score(math.inf, 0.9), Score(), False),
        ((1.0, 0.06), Score(2.0, 0.5), Score(2.0, 0.5), False),
        ((1.0, 1.0), Score(1.0, 0.5), Score(2.0, 0.5), True),
        ((1.0, 1.0), Score(2.0, 0.9), Score(2.0, 0.5), True),
        ((1.0, 1.0), Score(1.0, 0.1), Score(2.0, 0.5), False),
    ],
)
def test_acceptance_at_its_edges(nu, new, best, accepted):
    assert InlierBiasedDiransac(nu).accepts(new, best) is accepted


@pytest.mark.parametrize("huge", [1e155, 1e200, 1.7e308])
def test_error_whose_square_overflows_is_worse_than_any(huge):
    variant = InlierBiasedDiransac((1.0, 0.06))
    assert not variant.accepts(Score(huge, 0.5), Score(1.0, 0.5))
    assert variant.accepts(Score(1.0, 0.5), Score(huge, 0.5))


# ---------------------------------------------------------------------- the variants


def test_more_inliers_or_less_error_improve_i_diransac():
    variant, best = InlierBiasedDiransac(), Score(1.0, 0.5)
    assert variant.improves(Score(2.0, 0.6), best)
    assert variant.improves(Score(0.9, 0.1), best)
    assert not variant.improves(Score(1.0, 0.5), best)
    assert not variant.improves(Score(2.0, 0.4), best)


def test_less_error_alone_improves_diransac_and_is_stored():
    variant, best = Diransac(), Score(1.0, 0.5)
    assert not variant.improves(Score(2.0, 0.9), best)
    assert variant.improves(Score(0.9, 0.0), best)
    assert variant.accepts(Score(0.9, 0.0), best)
    assert not variant.improves(Score(), Score())


def test_near_misses_are_refitted_by_i_diransac_alone():
    assert InlierBiasedDiransac().refits(stored=False)
    assert not Diransac().refits(stored=False)
    assert Diransac().refits(stored=True)


def test_inlier_fraction_ends_i_diransac_alone():
    assert InlierBiasedDiransac().is_finished(Score(1.0, 0.85), 0.85)
    assert not InlierBiasedDiransac().is_finished(Score(1.0, 0.84), 0.85)
    assert not InlierBiasedDiransac().is_finished(Score(1.0, 1.0), None)
    assert not Diransac().is_finished(Score(1.0, 1.0), 0.85)
