"""Dynamics that the stages of a step call, for long expressions, against the same ones in every stage."""

from itertools import product

import casadi as ca
import numpy as np
import pytest

from diransac.simulation import Measurements, integrators
from diransac.simulation.compiler.outputs import ScoreOutput
from diransac.simulation.compiler.time_loop import emit_time_loop, inputs_from_log
from diransac.simulation.integrators import loop_specification
from diransac.simulation.rollouts import Rollouts
from rolling import BODY, INTEGRATORS, PENDULUM, ROTORCRAFT, batch_of, log_of, machine, measurements_of

MODELS = pytest.mark.parametrize("model", [ROTORCRAFT, PENDULUM, BODY], ids=lambda model: model.name)


def engine_of(model, integrator="rk4", substeps=2, hold="zero-order"):
    """Rollouts that no other test shares."""
    return Rollouts(model, tuple(model.signals), integrator, substeps, hold, None)


def results(engine, task, threads=1, **rows):
    """What each variant of the loop returns."""
    batch, measurements = batch_of(task, **rows), measurements_of(engine, task)
    series, final = engine.errors_and_ends(batch, measurements, threads=threads)
    sums = engine.gauss_newton(batch, measurements, np.ones(len(engine.signals)), threads=threads)
    return {
        "series": series,
        "final": final,
        "trajectories": engine.trajectories(batch, threads=threads),
        "cost": sums.cost,
        "gradient": sums.gradient,
        "normal": sums.normal_matrix,
        "slopes": sums.final_slopes,
    }


@pytest.mark.parametrize(("integrator", "hold"), [*product(INTEGRATORS, ["zero-order"]), ("rk4", "smooth")])
@MODELS
def test_called_dynamics_give_what_expressions_in_every_stage_do(monkeypatch, model, integrator, hold):
    task = log_of(model, 60)
    inlined = results(engine_of(model, integrator, hold=hold), task)
    monkeypatch.setattr(integrators, "_LONG", 0)
    called = results(engine_of(model, integrator, hold=hold), task)
    for name, expected in inlined.items():
        scale = np.abs(expected).max()
        np.testing.assert_allclose(called[name], expected, rtol=0.0, atol=1e-11 * scale, err_msg=name)


@MODELS
def test_lanes_and_threads_agree_to_the_bit_where_dynamics_are_called(monkeypatch, model):
    monkeypatch.setattr(integrators, "_LONG", 0)
    task, engine = log_of(model, 40), engine_of(model)
    whole = results(engine, task)
    for name, values in results(engine, task, threads=3).items():
        np.testing.assert_array_equal(values, whole[name], err_msg=name)
    batch = batch_of(task, task.parameters[3:5])
    ones = np.ones(len(engine.signals))
    measurements = Measurements(task.measured, np.ones(len(task.measured), bool))
    some = engine.gauss_newton(batch, measurements, ones)
    every = engine.gauss_newton(batch_of(task), measurements, ones)
    np.testing.assert_array_equal(some.normal_matrix, every.normal_matrix[3:5])


def test_the_code_of_a_loop_does_not_grow_with_the_dynamics_that_it_calls():
    def lines(n):
        @machine("series", 1, 1, 1, 1)
        def series(q, v, u, p):
            return [v[0]], [u[0] - p[0] * sum(ca.sin((k + 1) * q[0]) for k in range(n))]

        row = loop_specification(series, series.signals, "rk4", varying=False, divided=False)
        assert (row.dynamics is not None) == (n > 10)
        return str(emit_time_loop(row, ScoreOutput, inputs_from_log, windows=True)).count("\n")

    assert lines(200) == lines(400) < 0.5 * lines(10)


def test_variants_of_a_loop_share_the_machine_code_of_the_dynamics(monkeypatch, tmp_path):
    monkeypatch.setattr(integrators, "_LONG", 0)
    monkeypatch.setenv("DIRANSAC_CACHE", str(tmp_path))
    task = log_of(PENDULUM, 20)

    def kept():
        return sum(path.is_file() for path in tmp_path.rglob("*"))

    engine_of(PENDULUM).trajectories(batch_of(task))
    assert kept() == 2  # the loop, and the dynamics
    engine_of(PENDULUM, substeps=3).trajectories(batch_of(task))
    assert kept() == 2  # any number of sub-steps
    engine_of(PENDULUM, hold="linear").trajectories(batch_of(task))
    assert kept() == 3


def test_a_diverged_lane_leaves_the_others_as_they_are_where_dynamics_are_called(monkeypatch):
    monkeypatch.setattr(integrators, "_LONG", 0)
    task, engine = log_of(ROTORCRAFT, 40), engine_of(ROTORCRAFT)
    p = np.tile(task.parameters[:1], (9, 1))
    p[4] = np.nan
    found = engine.trajectories(batch_of(task, p))
    assert np.isnan(found[4, 1:]).any(axis=1).all()
    np.testing.assert_array_equal(np.delete(found, 4, axis=0), np.repeat(found[:1], 8, axis=0))
