"""Reasons of refusals and bad answers: mistakes of columns are named, and none where there is none."""

from dataclasses import replace

import numpy as np
import pytest
import reasons
from regime_flights import REGIMES

import diransac as dr
from diransac.data.dataset import Dataset
from diransac.identification.regression.rows import motion_rows, solved
from diransac.identification.structure.column_corrections import Correction, CorrectionTests
from diransac.identification.structure.columns import contradictions, explanations, mistakes_of_columns
from regime_logs import of_table, recorded
from simulated import MACHINES, as_log, flight

SEED = 2000
"""Of no figure that is reported."""
EXACT = {one.machine.name: one for one in REGIMES.values() if one.exact and one.signals is None and one.noise == 1.0}


@pytest.fixture(autouse=True)
def of_few_steps(monkeypatch):
    """Simulate every log of the table once, in fewer steps."""
    monkeypatch.setattr(reasons, "recordings", lambda regime, seeds: [of_table(regime.name, seed) for seed in seeds])


@pytest.mark.parametrize(
    "name",
    [
        "pendulum q deg, ols",
        "pendulum torque reversed, ols",
        "lift pressure bar",
        "underwater time ms",
        "rotor theta_dot deg/s",
        "rotor moment missing",
        "vehicle of two masses, ols",
        "underwater x_dot every 40th row, ols",
        "reactor, degC for K, nls",
        "pendulum at rest",
        "car steering reversed",
    ],
)
def test_the_true_cause_is_named(name):
    found = reasons.told(reasons.CASES[name], SEED)
    assert found.truth == "true", found.shown


@pytest.mark.parametrize("name", EXACT)
def test_columns_without_a_mistake_are_not_accused(name):
    machine = EXACT[name].machine
    one = recorded(replace(EXACT[name], machine=replace(machine, duration=0.3 * machine.duration)), SEED)
    dataset = Dataset.of(machine.model, one.log, pointwise=False)
    assert contradictions(dataset.model, dataset.given) == []
    with np.errstate(all="ignore"):
        assert mistakes_of_columns(dataset)[0] == []


@pytest.mark.parametrize("noise", [0.0, 30.0])
def test_equations_that_leave_most_of_their_terms_accuse_no_sign(noise):
    """Least squares of noise has parameters of any sign, and small errors."""
    machine = MACHINES["planar-rotorcraft"]
    signals, inputs = flight(machine, 1000, 0.01)
    log = as_log(machine, signals, inputs * [-1.0, 1.0], 0.01)
    dataset = Dataset.of(dr.models.planar_rotorcraft(), log, pointwise=True)
    (rows,) = motion_rows(dataset)
    noisy = replace(rows, a=rows.a + noise * np.random.default_rng(0).standard_normal(rows.a.shape))
    found, _ = explanations(CorrectionTests(dataset.model, dataset.layout, [noisy]), dataset.given)
    assert [x.what for x in found] == ([] if noise else ["The sign of thrust is reversed"])


def test_a_mass_that_changes_is_no_wrong_unit():
    log = of_table("rotor payload -30 %", 3000).log
    dataset = Dataset.of(REGIMES["rotor payload -30 %"].machine.model, log, pointwise=False)
    assert mistakes_of_columns(dataset)[0] == []


@pytest.mark.parametrize("low", ["x", "x_dot"])
@pytest.mark.parametrize("outliers", [0.0, 0.2])
def test_a_unit_is_that_of_the_column_by_the_ratio_of_both(low, outliers):
    """Degrees of an angle and of its rate change the ratio in opposite directions, and outliers do not matter."""
    model = dr.Model("m", {"x": "rad"}, {"u": "N m"}, {"J": dr.Parameter("1")}, lambda q, v, a, u, p: [p.J * a.x - u.u])
    rng, t = np.random.default_rng(SEED), 0.01 * np.arange(1000)
    columns = {"x": np.sin(2.0 * t), "x_dot": 2.0 * np.cos(2.0 * t), "u": np.sin(t)}
    columns = {n: np.where(rng.random(1000) < outliers, rng.uniform(-50.0, 50.0, 1000), x) for n, x in columns.items()}
    columns[low] = np.degrees(columns[low])
    (found,) = contradictions(model, [dr.Log.from_arrays(t, columns)])
    assert found.action == f"identify again with --scale {low}=0.0174533"


def test_a_known_unit_is_no_mistake():
    """A header says deg: the log is converted, and nothing contradicts."""
    model = dr.Model("m", {"x": "rad"}, {"u": "N m"}, {"J": dr.Parameter("1")}, lambda q, v, a, u, p: [p.J * a.x - u.u])
    t = 0.01 * np.arange(1000)
    columns = {"x": np.degrees(np.sin(2.0 * t)), "x_dot": 2.0 * np.cos(2.0 * t), "u": np.sin(t)}
    assert contradictions(model, [dr.Log.from_arrays(t, columns, units={"x": "deg"})]) == []


def test_a_unit_that_parameters_take_up_changes_no_residual():
    """An excess of lift, in one equation alone, so that equations contradict each other about the mass."""
    machine = MACHINES["planar-rotorcraft"]

    def lifted(q, v, u, p):
        x, z, theta = machine.acceleration(q, v, u, p)
        return x, z + 0.1 * u[0] / p[0], theta

    signals, inputs = flight(replace(machine, acceleration=lifted), 2500, 0.01)
    hit = np.random.default_rng(0).random(signals.shape) < 0.1
    spoilt = signals + hit * np.random.default_rng(1).uniform(-80.0, 80.0, signals.shape)
    dataset = Dataset.of(dr.models.planar_rotorcraft(), as_log(machine, spoilt, inputs, 0.01), pointwise=True)
    rows, every = motion_rows(dataset), tuple(dataset.model.inputs)
    found = solved(dataset.model, dataset.layout, rows)
    other = solved(
        dataset.model, dataset.layout, [Correction(every, factor=1000.0).of_rows(dataset.model, x) for x in rows]
    )
    np.testing.assert_allclose(other.residuals, found.residuals, rtol=0.02)
    np.testing.assert_allclose(other.parameters, found.parameters * [1000.0, 1000.0, 1.0], rtol=0.02)
    assert mistakes_of_columns(dataset)[0] == []
