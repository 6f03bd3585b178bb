"""Samples: distinct rows, a beginning that does not change when read on, nothing but (seed, k), no row preferred."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from diransac.identification.methods.samples import sample_rows

SEEDS = st.integers(-(2**70), 2**70)
SIZES = st.integers(1, 300)


def whole(seed, k, n_rows):
    return sample_rows(seed, [k], n_rows, 0, n_rows)[0]


@given(seed=SEEDS, k=st.integers(0, 10**12), n_rows=SIZES)
def test_every_row_comes_exactly_once(seed, k, n_rows):
    assert sorted(whole(seed, k, n_rows).tolist()) == list(range(n_rows))


@pytest.mark.parametrize("n_rows", [1, 2, 3, 4, 5, 16, 17, 64, 65, 1023, 1024, 1025, 2500, 4097, 16385])
def test_every_row_comes_exactly_once_at_the_edges_of_powers_of_two(n_rows):
    assert np.array_equal(np.sort(whole(7, 3, n_rows)), np.arange(n_rows))


@given(seed=SEEDS, n_rows=SIZES, cuts=st.tuples(st.floats(0, 1), st.floats(0, 1)))
def test_reading_on_continues_the_same_sample(seed, n_rows, cuts):
    start, stop = sorted(round(x * n_rows) for x in cuts)
    parts = [sample_rows(seed, [5], n_rows, a, b)[0] for a, b in ((0, start), (start, stop), (stop, n_rows))]
    assert np.array_equal(np.concatenate(parts), whole(seed, 5, n_rows))


def test_sample_depends_on_seed_and_k_alone():
    together = sample_rows(3, np.arange(100), 500, 0, 20)
    assert np.array_equal(together[[40, 7]], sample_rows(3, [40, 7], 500, 0, 20))
    assert np.array_equal(together[63:64], sample_rows(3, [63], 500, 0, 20))


def test_seeds_and_iterations_give_different_samples():
    samples = {tuple(x) for seed in (-1, 0, 1, 2**63) for x in sample_rows(seed, np.arange(200), 1000, 0, 10)}
    assert len(samples) == 800


def test_seed_may_be_numpys():
    assert np.array_equal(sample_rows(np.int64(-1), [0], 100, 0, 9), sample_rows(-1, [0], 100, 0, 9))


def test_seed_and_k_are_no_sum():
    """A sample of (seed, k + 1) is not that of (seed + 1, k)."""
    assert not np.array_equal(sample_rows(0, [1], 1000, 0, 10), sample_rows(1, [0], 1000, 0, 10))


@pytest.mark.parametrize(("n_rows", "size"), [(5, 2), (12, 3), (30, 5), (33, 10), (100, 10), (1000, 75), (2500, 75)])
def test_every_row_is_drawn_equally_often(n_rows, size):
    n = 40_000 * 5 // size
    counts = np.bincount(sample_rows(1, np.arange(n), n_rows, 0, size).ravel(), minlength=n_rows)
    assert chi_square(counts, n * size / n_rows, 1 - size / n_rows) < chi2.ppf(0.9999, n_rows - 1)


@pytest.mark.parametrize("n_rows", [3, 4, 5, 7, 12, 16, 31, 40, 100])
@pytest.mark.parametrize("place", [1, -1])
def test_every_pair_of_rows_is_drawn_equally_often(n_rows, place):
    """First row and another place: every ordered pair of different rows."""
    n = 20 * n_rows * n_rows
    first, other = (sample_rows(2, np.arange(n), n_rows, x, x + 1)[:, 0] for x in (0, place % n_rows))
    pairs = np.bincount(first * n_rows + other, minlength=n_rows**2).reshape(n_rows, n_rows)
    off = pairs[~np.eye(n_rows, dtype=bool)]
    assert np.trace(pairs) == 0
    assert chi_square(off, n / len(off)) < chi2.ppf(0.9999, len(off) - 1)


def test_consecutive_samples_share_rows_as_often_as_chance_has_it():
    """Overlap of samples k and k + 1: hypergeometric, mean s^2 / N; its mean over 4000 pairs within 4.5 errors."""
    s, n_rows = 75, 2500
    rows = sample_rows(0, np.arange(4001), n_rows, 0, s)
    shared = [len(np.intersect1d(a, b)) for a, b in pairwise(rows)]
    mean = s * s / n_rows
    spread = np.sqrt(mean * (1 - s / n_rows) * (n_rows - s) / (n_rows - 1) / len(shared))
    assert abs(np.mean(shared) - mean) < 4.5 * spread


def chi_square(counts, expected, shrink=1.0):
    """Pearson's statistic; ``shrink`` is how much drawing without replacement reduces the spread of a count."""
    return ((counts - expected) ** 2).sum() / expected / shrink
