"""The compiled recurrence over rows, against a plain loop."""

import casadi as ca
import numpy as np
import pytest

from diransac.errors import ModelError, SettingsError
from diransac.simulation.compiler import compile_scan
from rolling import ON_EVERY_TARGET

carry, row, constants = ca.SX.sym("c", 2), ca.SX.sym("r", 3), ca.SX.sym("k", 2)
ROTATING = ca.Function(
    "rotating",
    [carry, row, constants],
    [
        ca.vertcat(ca.cos(row[0]) * carry[0] - constants[0] * carry[1], ca.tanh(carry[0] + row[1]) / constants[1]),
        ca.vertcat(carry[1] * row[2], ca.exp(-(carry[0] ** 2)), constants[0], row[0]),
    ],
)
total, number, factor = ca.SX.sym("c"), ca.SX.sym("r"), ca.SX.sym("k")
grown = total + factor * number
SUM = ca.Function("sum", [total, number, factor], [grown, ca.vertcat(total, grown)])


def task_of(n_lanes, n_rows, seed=0):
    """Carry, rows and constants of some lanes."""
    rng = np.random.default_rng(seed)
    return (
        rng.standard_normal((n_lanes, 2)),
        rng.standard_normal((n_lanes, n_rows, 3)),
        rng.uniform(0.5, 2.0, (n_lanes, 2)),
    )


def plain_scan(function, start, rows, constant):
    """Outputs of one lane, by CasADi's own evaluation."""
    outputs, at = [], start
    for one in rows:
        at, output = function(at, one, constant)
        outputs.append(np.array(output).ravel())
    return np.array(outputs)


@pytest.mark.parametrize("n_lanes", [1, 3, 8, 13])
def test_a_scan_agrees_with_a_plain_loop(n_lanes):
    start, rows, constant = task_of(n_lanes, 40)
    found = compile_scan(ROTATING)(start, rows, constant)
    assert found.shape == (n_lanes, 40, 4)
    for lane in range(n_lanes):
        expected = plain_scan(ROTATING, start[lane], rows[lane], constant[lane])
        np.testing.assert_allclose(found[lane], expected, rtol=1e-13, atol=1e-13)


def test_a_sum_is_exact_and_an_output_may_be_the_last_carry():
    rows = np.arange(1.0, 101.0)[None, :, None]
    found = compile_scan(SUM)([[7.0]], rows, [[2.0]])
    np.testing.assert_array_equal(found[0, :, 1], 7.0 + 2.0 * np.cumsum(rows))
    np.testing.assert_array_equal(found[0, 1:, 0], found[0, :-1, 1])
    assert found[0, 0, 0] == 7.0


@pytest.mark.parametrize("n_lanes", [1, 11])
def test_rows_that_all_lanes_share_are_given_once(n_lanes):
    start, rows, constant = task_of(n_lanes, 25)
    scan = compile_scan(ROTATING)
    expected = scan(start, np.repeat(rows[:1], n_lanes, axis=0), constant)
    np.testing.assert_array_equal(scan(start, rows[0], constant), expected)


@ON_EVERY_TARGET
def test_a_scan_has_the_same_bits_for_any_number_of_lanes_threads_and_target(target):
    start, rows, constant = task_of(37, 30)
    expected = compile_scan(ROTATING)(start, rows, constant)
    scan = compile_scan(ROTATING, target)
    np.testing.assert_array_equal(scan(start, rows, constant, threads=3), expected)
    for part in (slice(0, 1), slice(7, 8), slice(5, 20)):
        np.testing.assert_array_equal(scan(start[part], rows[part], constant[part]), expected[part])


def test_a_lane_is_nan_from_its_first_output_that_is_not_finite_and_the_others_are_not():
    start, rows, constant = task_of(9, 12)
    scan = compile_scan(ROTATING)
    expected = scan(start, rows, constant)
    rows[4, 5, 2] = np.inf
    found = scan(start, rows, constant)
    assert np.isnan(found[4, 5:]).all()
    np.testing.assert_array_equal(found[4, :5], expected[4, :5])
    others = np.arange(9) != 4
    np.testing.assert_array_equal(found[others], expected[others])


def test_no_lane_gives_no_outputs():
    assert compile_scan(ROTATING)(np.empty((0, 2)), np.empty((0, 5, 3)), np.empty((0, 2))).shape == (0, 5, 4)


@pytest.mark.parametrize("n_lanes", [1, 8, 13])
def test_every_run_of_a_prepared_scan_has_the_bits_of_a_call(n_lanes):
    scan = compile_scan(ROTATING)
    prepared = scan.prepare(n_lanes, 6)
    for seed in range(2):
        start, rows, constant = task_of(n_lanes, 6, seed)
        prepared.rows[:] = rows
        prepared.set_carry(start)
        prepared.set_constants(constant[:, :1])
        prepared.set_constants(constant[:, 1:], 1)
        np.testing.assert_array_equal(prepared.run(), scan(start, rows, constant))


@pytest.mark.parametrize("n_lanes", [1, 8, 13])
def test_a_prepared_scan_gives_the_last_carry(n_lanes):
    start, rows, constant = task_of(n_lanes, 1)
    prepared = compile_scan(SUM).prepare(n_lanes, 50)
    prepared.rows[:] = rows[:, :, :1]
    prepared.set_carry(start[:, :1])
    prepared.set_constants(constant[:, :1])
    np.testing.assert_array_equal(prepared.run()[:, -1, 1:], prepared.last_carry())


def test_an_equal_recurrence_is_compiled_once():
    again = ca.Function.deserialize(ROTATING.serialize())
    assert compile_scan(again) is compile_scan(ROTATING)


def test_a_scan_leaves_its_arrays_alone():
    arrays = task_of(3, 10)
    for array in arrays:
        array.flags.writeable = False
    compile_scan(ROTATING)(*arrays)
    for array, fresh in zip(arrays, task_of(3, 10), strict=True):
        np.testing.assert_array_equal(array, fresh)


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        (((4, 3), (4, 9, 3), (4, 2)), r"carry \(n_lanes, 2\).*found \(4, 3\), \(4, 9, 3\) and \(4, 2\)"),
        (((4, 2), (4, 9, 2), (4, 2)), r"rows \(n_lanes, n_rows, 3\) or \(n_rows, 3\)"),
        (((4, 2), (3, 9, 3), (4, 2)), "found"),
        (((4, 2), (4, 9, 3), (2,)), r"constants \(n_lanes, 2\)"),
        (((4, 2), (4, 0, 3), (4, 2)), "at least one row"),
        (((2,), (9, 3), (2,)), "found"),
    ],
)
def test_a_scan_says_which_shapes_it_wants(shapes, message):
    with pytest.raises(SettingsError, match=message):
        compile_scan(ROTATING)(*map(np.zeros, shapes))


def test_what_is_no_recurrence_of_symbols_is_refused():
    c, r, k = map(ca.SX.sym, "crk")
    with pytest.raises(ModelError, match=r"'grows' is not a recurrence"):
        compile_scan(ca.Function("grows", [c, r, k], [ca.vertcat(c, r), c]))
    with pytest.raises(ModelError, match="is not a recurrence"):
        compile_scan(ca.Function("two", [c, r], [c, c]))
    arguments = [ca.MX.sym(name) for name in "crk"]
    with pytest.raises(ModelError, match="not made of SX symbols"):
        compile_scan(ca.Function("matrices", arguments, arguments[:2]))
