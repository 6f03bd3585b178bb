"""Every operation against CasADi's own evaluation, over the whole range of float64."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import special

from diransac.simulation.compiler import compile_map
from rolling import ON_EVERY_TARGET

UNARY = {  # operation: units in the last place by which it may differ from the C library's
    "NEG": 0, "SQ": 0, "TWICE": 0, "INV": 0, "SQRT": 0, "FABS": 0, "FLOOR": 0, "CEIL": 0, "SIGN": 0, "NOT": 0,
    "EXP": 2, "EXPM1": 3, "LOG": 2, "LOG1P": 2, "SIN": 2, "COS": 2, "TAN": 4, "ASIN": 4, "ACOS": 4, "ATAN": 3,
    "SINH": 4, "COSH": 3, "TANH": 4, "ASINH": 4, "ACOSH": 4, "ATANH": 4, "ERF": 0,
}  # fmt: skip
BINARY = {
    "ADD": 0, "SUB": 0, "MUL": 0, "DIV": 0, "LT": 0, "LE": 0, "EQ": 0, "NE": 0, "AND": 0, "OR": 0, "IF_ELSE_ZERO": 0,
    "FMIN": 0, "FMAX": 0, "FMOD": 0, "REMAINDER": 0, "COPYSIGN": 0, "HYPOT": 2, "POW": 2, "ATAN2": 3,
}  # fmt: skip

HARD_FOR_REDUCTION = 6381956970095103 * 2.0**797  # the double nearest to a multiple of pi / 2
EDGES = np.array([
    0.0, 1.0, 0.5, 2.0, 3.0, np.inf, 5e-324, 1e-310, 2.0**-1022, 1.7976931348623157e308, 1e-16, 1 + 2.0**-52,
    1 - 2.0**-53, np.pi, np.pi / 2, np.pi / 4, 0.41421356237309503, 709.78, 709.79, 710.4, 710.47, 710.48, 708.4, 745.1,
    745.2, 2.0**40, 2.0**40 * np.pi / 2, 2.0**52, 2.0**53 + 2, 1e22, 1e300, HARD_FOR_REDUCTION, 36.7, 0.7, 2.0**60,
])  # fmt: skip
EDGES = np.concatenate([EDGES, -EDGES, [np.nan]])


def spread(rng, n):
    """Numbers of every size and sign, and many of ordinary size."""
    return np.concatenate([
        rng.standard_normal(n), rng.uniform(-10, 10, n), rng.uniform(-750, 750, n), rng.uniform(-1e6, 1e6, n),
        1 + rng.uniform(-1e-3, 1e-3, n), rng.choice([-1, 1], n) * np.exp(rng.uniform(-744, 709, n)),
    ])  # fmt: skip


def units_apart(x, y):
    """Distance in units of y's last place; 0 where both are NaN, infinite where one is or an infinity differs."""
    x, y = np.broadcast_arrays(x, y)
    with np.errstate(all="ignore"):
        distance = np.abs(x - y) / np.spacing(np.maximum(np.abs(y), 2.0**-1022))
    distance = np.where((x == y) | (np.isnan(x) & np.isnan(y)), 0.0, distance)
    return np.where(np.isnan(distance), np.inf, distance)


def function_of(name, n_operands):
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    operation = getattr(ca, f"OP_{name}")
    if n_operands == 1:
        return ca.Function(name.lower(), [x], [ca.SX.unary(operation, x)])
    return ca.Function(name.lower(), [x, y], [ca.SX.binary(operation, x, y)])


def by_casadi(function, *arrays):
    return np.array(function.map(len(arrays[0]))(*(array[None] for array in arrays))).ravel()


def by_kernel(function, *arrays, target=None):
    (result,) = compile_map(function, target)(*(array[:, None] for array in arrays))
    return result.ravel()


@pytest.mark.parametrize("name", UNARY)
def test_function_of_one_number_agrees_with_casadi(name):
    x = np.concatenate([EDGES, spread(np.random.default_rng(1), 3000)])
    function = function_of(name, 1)
    found = by_kernel(function, x)
    expected = by_casadi(function, x)
    apart = units_apart(found, expected)
    assert apart.max() <= UNARY[name], (x[apart.argmax()], found[apart.argmax()], expected[apart.argmax()])
    np.testing.assert_array_equal(np.signbit(found[expected == 0]), np.signbit(expected[expected == 0]))


@pytest.mark.parametrize("name", BINARY)
def test_function_of_two_numbers_agrees_with_casadi(name):
    rng = np.random.default_rng(2)
    x, y = (grid.ravel() for grid in np.meshgrid(EDGES, EDGES))
    x, y = (np.concatenate([edges, rng.permutation(spread(rng, 3000))]) for edges in (x, y))
    function = function_of(name, 2)
    found = by_kernel(function, x, y)
    expected = by_casadi(function, x, y)
    apart = units_apart(found, expected)
    k = apart.argmax()
    assert apart[k] <= BINARY[name], (x[k], y[k], found[k], expected[k])
    if name not in ("FMIN", "FMAX"):  # C leaves open which of 0 and -0 is the smaller
        np.testing.assert_array_equal(np.signbit(found[expected == 0]), np.signbit(expected[expected == 0]))


@ON_EVERY_TARGET
@pytest.mark.parametrize("name", [*UNARY, *BINARY])
def test_functions_have_the_same_bits_on_every_target(name, target):
    rng = np.random.default_rng(4)
    function = function_of(name, 1 + (name in BINARY))
    arrays = [np.concatenate([EDGES, rng.permutation(spread(rng, 500))]) for _ in range(function.n_in())]
    np.testing.assert_array_equal(by_kernel(function, *arrays, target=target), by_kernel(function, *arrays))


def test_power_is_accurate_where_its_logarithm_is_stretched_most():
    rng = np.random.default_rng(3)
    x = np.concatenate([np.exp(rng.uniform(-5, 5, 20_000)), rng.uniform(0.99, 1.01, 20_000)])
    y = np.concatenate([rng.uniform(-140, 140, 20_000), rng.uniform(-7e4, 7e4, 20_000)])
    function = function_of("POW", 2)
    assert units_apart(by_kernel(function, x, y), by_casadi(function, x, y)).max() <= 2


@given(st.lists(st.floats(), min_size=1, max_size=20))
@settings(max_examples=30, deadline=None)
@pytest.mark.parametrize("name", ["SIN", "EXP", "LOG", "TANH", "ATAN", "EXPM1"])
def test_any_float_agrees_with_casadi(name, numbers):
    x = np.array(numbers)
    function = function_of(name, 1)
    assert units_apart(by_kernel(function, x), by_casadi(function, x)).max() <= UNARY[name]


@given(st.lists(st.tuples(st.floats(), st.floats()), min_size=1, max_size=20))
@settings(max_examples=30, deadline=None)
@pytest.mark.parametrize("name", ["POW", "ATAN2", "HYPOT"])
def test_any_two_floats_agree_with_casadi(name, pairs):
    x, y = np.array(pairs).T
    function = function_of(name, 2)
    assert units_apart(by_kernel(function, x, y), by_casadi(function, x, y)).max() <= BINARY[name]


def test_inverse_error_function_undoes_the_error_function():
    # CasADi's own is a rough approximation below -0.7 and near 1, so SciPy is the judge.
    x = np.concatenate([np.linspace(-1, 1, 2001), 1 - np.geomspace(1e-16, 1e-3, 50), [1e-300, -0.0, 2.0, np.nan]])
    found = by_kernel(function_of("ERFINV", 1), x)
    assert units_apart(found, special.erfinv(x)).max() <= 4


@ON_EVERY_TARGET
@pytest.mark.parametrize("name", ["SIN", "COS", "TAN"])
def test_a_huge_angle_changes_no_other_lane(name, target):
    function = function_of(name, 1)
    x = np.linspace(-3, 3, 8)
    alone = by_kernel(function, x, target=target)
    for lane in range(8):
        mixed = x.copy()
        mixed[lane] = 1e30
        found = by_kernel(function, mixed, target=target)
        np.testing.assert_array_equal(np.delete(found, lane), np.delete(alone, lane))
        assert units_apart(found[lane], by_casadi(function, np.array([1e30]))) <= UNARY[name]


def test_sine_keeps_its_relative_accuracy_next_to_multiples_of_pi():
    x = np.pi * np.arange(1.0, 20_000.0, 7.0)
    function = function_of("SIN", 1)
    assert units_apart(by_kernel(function, x), by_casadi(function, x)).max() <= 2
