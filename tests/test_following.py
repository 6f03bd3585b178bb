"""Sums of one-interval predictions: what a single interval may tell."""

import numpy as np
import pytest

from diransac.identification.methods.lo_diransac.following import bounded_influence
from diransac.identification.methods.lo_diransac.prediction_error import is_worse


def intervals_of(n: int = 200) -> np.ndarray:
    """Information of intervals on four parameters, of different sizes."""
    rng = np.random.default_rng(0)
    slopes = rng.normal(size=(n, 6, 4)) * [1.0, 10.0, 0.1, 3.0]
    return slopes.swapaxes(1, 2) @ slopes


def test_intervals_that_tell_alike_keep_their_weights():
    assert (bounded_influence(intervals_of()) == 1.0).all()


@pytest.mark.parametrize("steep", [[80], [79, 80]])
def test_a_contact_that_is_about_to_change_does_not_outweigh_the_log(steep: list[int]):
    ordinary = intervals_of()
    information = ordinary.copy()
    information[steep] += 1e6 * np.outer([1.0, -5.0, 0.2, 1.0], [1.0, -5.0, 0.2, 1.0])
    weights = bounded_influence(information)
    assert (weights[steep] < 1e-2).all()
    assert (np.delete(weights, steep) == 1.0).all()
    with_it = np.linalg.inv(np.einsum("w,wij->ij", weights, information))
    without = np.linalg.inv(ordinary.sum(axis=0))
    assert np.sqrt(np.diag(without) / np.diag(with_it)).max() < 1.25
    free = np.linalg.inv(information.sum(axis=0))
    assert np.sqrt(np.diag(without) / np.diag(free)).max() > 1.25


def test_intervals_without_samples_tell_nothing():
    information = intervals_of()
    information[20:40] = 0.0
    assert np.isfinite(bounded_influence(information)).all()


def test_losses_differ_where_most_intervals_agree_that_they_do():
    rng = np.random.default_rng(1)
    jumps = 50.0 * rng.normal(size=200)
    jumps -= jumps.mean()
    assert not is_worse(jumps + 1.0, np.zeros(200))
    assert is_worse(np.full(200, 1.0), np.zeros(200))
    assert not is_worse(np.full(200, 1e-3), np.zeros(200))  # a fifth of a nat
