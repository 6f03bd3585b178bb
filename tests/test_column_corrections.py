"""Corrections of columns by the equations, wraps of counters, and standing still."""

import accusations
import numpy as np
import pytest
from accusation_machines import SCARA, slider, turret

import diransac as dr
from diransac.data.preprocessing import wrap_period
from diransac.identification.methods.lo_diransac.preparation import stuck_rows
from diransac.identification.structure.column_corrections import Correction, with_factor_inside

T = 0.01 * np.arange(4000)
MISTAKES = {x.name: x for x in accusations.mistakes()}
CLEAN = {x.name: x for x in accusations.clean()}
SEED = 1


@pytest.mark.parametrize(
    "name",
    [
        "turret yaw deg",
        "gantry x mm",
        "scara t1, t2 reversed",
        "scara q1, q2 exchanged",
        "turret motor 40 ms late",
        "turret 12 bits",
        "boat compass",
    ],
)
def test_a_planted_mistake_is_named_with_its_option(name):
    told = accusations.told(MISTAKES[name], SEED)
    assert told.is_right, told.texts


@pytest.mark.parametrize(
    "name",
    ["turret, slip 5 for 0.05 0", "slider, corner 5 for 0.05 0", "slider, wave 8e-5 for 0.08 0", "scara, outliers 0"],
)
def test_a_scale_inside_a_nonlinear_term_accuses_no_unit(name):
    told = accusations.told(CLEAN[name], SEED)
    assert told.is_right, told.matching


@pytest.mark.parametrize("bits", [8, 12, 16, 24, 32])
def test_the_period_of_a_counter_is_found_from_its_resolution(bits):
    ticks = np.round(2.0**bits * (2.0 * np.sin(0.5 * T) + np.sin(1.3 * T)))
    wrapped = np.mod(ticks, 2**bits) * 0.25
    assert wrap_period(wrapped) == pytest.approx(0.25 * 2**bits, rel=1e-3)
    log = dr.unwrap(dr.Log.from_arrays(T, {"x": wrapped}), {"x": 0.25 * 2**bits})
    np.testing.assert_allclose(log["x"] - log["x"][0], 0.25 * (ticks - ticks[0]), rtol=0.0, atol=1e-6 * 2**bits)


@pytest.mark.parametrize(
    "values",
    [
        np.sin(T),
        np.sign(np.sin(T)),
        0.5 * (1.0 - np.cos(np.pi * np.mod(T, 5.0) / 5.0)),
        np.where(np.random.default_rng(0).random(len(T)) < 0.1, 9.0, np.sin(T)),
    ],
    ids=["sine", "square", "runs from rest", "outliers"],
)
def test_leaps_that_are_no_wraps_have_no_period(values):
    assert wrap_period(values) is None


def test_an_angle_in_degrees_that_wraps_has_the_turn_as_its_period():
    assert wrap_period(np.mod(40.0 * T, 360.0), (360.0,)) == 360.0


def test_a_period_must_be_positive():
    with pytest.raises(dr.SettingsError, match=r"the period of \"x\" is 0"):
        dr.unwrap(dr.Log.from_arrays(T, {"x": T}), {"x": 0.0})


def test_rest_until_a_step_of_the_command_is_not_stuck_and_a_recorder_that_catches_up_is():
    moving = np.clip(T - 10.0, 0.0, None) ** 2
    coarse = 0.05 * np.round(np.column_stack([moving, 2.0 * moving]) / 0.05)
    assert (np.diff(coarse, axis=0) == 0.0).all(axis=1).sum() > 1000
    assert not stuck_rows(coarse).any()
    frozen = coarse.copy()
    frozen[3000:3040] = frozen[2999]
    assert np.flatnonzero(stuck_rows(frozen)).tolist() == list(range(3000, 3040))


def test_a_factor_inside_of_nonlinear_functions_is_another_constant_there():
    """tanh(v / .05) with v a hundred times as large inside is tanh(v / .0005), and every other term is the same."""
    rng = np.random.default_rng(0)
    inside = with_factor_inside(turret(), Correction(("yaw",), factor=100.0))
    values = [rng.normal(size=(n, 20)) for n in (1, 1, 1, 1, 4)]
    np.testing.assert_allclose(inside.residual(*values), turret(0.0005).residual(*values), rtol=1e-12)
    inside = with_factor_inside(slider(), Correction(("s",), factor=10.0))
    np.testing.assert_allclose(inside.residual(*values), slider(0.005, 0.008).residual(*values), rtol=1e-12)


def test_exchanged_signals_change_places_in_all_of_their_derivatives():
    from diransac.identification.regression.rows import MotionRows

    x = np.arange(20.0).reshape(10, 2)
    rows = MotionRows(x, x + 100.0, x + 200.0, x + 300.0, np.empty((10, 0)))
    found = Correction(("q1", "q2"), exchanged=True).of_rows(SCARA.model, rows)
    for before, after in ((rows.q, found.q), (rows.v, found.v), (rows.a, found.a)):
        np.testing.assert_array_equal(after, before[:, ::-1])
    np.testing.assert_array_equal(found.u, rows.u)
    late = Correction(("t2",), delay=3).of_rows(SCARA.model, rows)
    np.testing.assert_array_equal(late.u[3:, 1], rows.u[:-3, 1])
    np.testing.assert_array_equal(late.u[:, 0], rows.u[:, 0])
