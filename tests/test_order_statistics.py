"""Order statistics of many rows, by bisection in compiled code."""

import numpy as np
import pytest

from diransac.simulation.compiler import order_statistics, padded_rows


@pytest.mark.parametrize("shape", [(1,), (8,), (3, 5), (2, 3, 40), (7, 2532)])
def test_order_statistics_are_those_of_sorted_rows_whatever_their_scale_and_ties(shape):
    rng = np.random.default_rng(0)
    rows = padded_rows(shape)
    values = rows[..., : shape[-1]]
    values[...] = np.abs(rng.normal(size=shape)) * 10.0 ** rng.integers(-300, 300, size=(*shape[:-1], 1))
    values[rng.random(shape) < 0.2] = np.inf
    values[rng.random(shape) < 0.2] = 0.0
    places = rng.integers(0, shape[-1], shape[:-1])
    expected = np.take_along_axis(np.sort(values, axis=-1), places[..., None], axis=-1)[..., 0]
    np.testing.assert_array_equal(order_statistics(rows, places), expected)


def test_a_number_that_is_none_comes_after_infinity():
    rows = padded_rows((5,))
    rows[:5] = [np.inf, np.nan, 2.0, 5e-324, 0.0]
    found = [order_statistics(rows, np.array(k)) for k in range(4)]
    assert found == [0.0, 5e-324, 2.0, np.inf]


def test_a_place_for_all_rows_is_that_of_each():
    rows = padded_rows((4, 9))
    rows[:, :9] = np.arange(36.0).reshape(4, 9)[:, ::-1]
    np.testing.assert_array_equal(order_statistics(rows, np.array(2)), [2.0, 11.0, 20.0, 29.0])
