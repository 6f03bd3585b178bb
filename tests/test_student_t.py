"""Student's t quantiles against SciPy's, and against what is known of them."""

import pytest
from scipy.special import stdtrit

from diransac.student_t import student_t_quantile


@pytest.mark.parametrize("degrees_of_freedom", [1, 2, 3, 4, 9, 14, 29, 100, 1001])
@pytest.mark.parametrize("probability", [0.5001, 0.6, 0.9, 0.975, 0.995, 0.9999, 0.025, 0.3])
def test_quantiles_are_those_of_scipy(degrees_of_freedom: int, probability: float):
    expected = float(stdtrit(degrees_of_freedom, probability))
    assert student_t_quantile(probability, degrees_of_freedom) == pytest.approx(expected, rel=1e-10)


def test_median_is_zero():
    assert student_t_quantile(0.5, 7) == pytest.approx(0.0, abs=1e-15)
