"""Derivatives of rollouts, and the sums of a Gauss-Newton step, against finite differences, CasADi and closed forms."""

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest

from diransac.errors import SettingsError
from diransac.model.library import double_pendulum
from diransac.simulation import Measurements, RolloutBatch, rollouts
from diransac.simulation.compiler.outputs import GaussNewtonOutput
from diransac.simulation.compiler.time_loop import emit_time_loop, inputs_from_log
from diransac.simulation.integrators import loop_specification, sensitivities_of
from rolling import (
    BODY,
    EXPLOSIVE,
    INTEGRATORS,
    ON_EVERY_TARGET,
    PENDULUM,
    ROTORCRAFT,
    assert_same,
    batch_of,
    log_of,
    machine,
    measurements_of,
    score_of,
)

MODELS = [ROTORCRAFT, PENDULUM, BODY, double_pendulum()]
EVERY_MODEL = pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)


@machine("linear", 1, 1, 1, 2)
def LINEAR(q, v, u, p):
    return [v[0]], [u[0] - p[0] * q[0] - p[1] * v[0]]


@machine("kinks", 1, 1, 1, 2)
def KINKS(q, v, u, p):
    spring = ca.if_else(q[0] > 0, p[0] * ca.sqrt(q[0]), -p[1] * ca.log(1 - q[0]))
    return [v[0]], [u[0] - spring - 0.3 * ca.fabs(v[0]) * v[0]]


def linearised(engine, task, parameters=None, *, unknowns=None, threads=1, **rows):
    """Linearised errors of a problem."""
    batch = batch_of(task, parameters, **rows)
    return engine.linearized_errors(batch, measurements_of(engine, task), unknowns=unknowns, threads=threads)


def sums_of(engine, task, parameters=None, weights=None, *, unknowns=None, directions=None, threads=1, **rows):
    """Gauss-Newton sums of a problem."""
    w = np.linspace(0.5, 2.0, len(engine.signals)) if weights is None else weights
    problem, options = (batch_of(task, parameters, **rows), measurements_of(engine, task), w), {"threads": threads}
    return engine.gauss_newton(*problem, unknowns=unknowns, directions=directions, **options)


def differences(engine, model, p, x, inputs, dt, step=1e-6):
    """Central differences of a trajectory, (n_rows, n_signals, n_p + n_x)."""
    z = np.concatenate([p, x])
    steps = step * np.maximum(1.0, np.abs(z)) * np.eye(len(z))
    lanes = np.concatenate([z + steps, z - steps])
    found = engine.trajectories(RolloutBatch(lanes[:, : len(p)], lanes[:, len(p) :], inputs, dt))
    up, down = np.split(found, 2)
    return np.moveaxis((up - down) / (2 * np.diag(steps))[:, None, None], 0, -1)


# Derivatives ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("integrator", "substeps"), [*zip(INTEGRATORS, (1, 1, 3), strict=True), ("rk4", 2)])
@EVERY_MODEL
def test_the_jacobian_is_that_of_central_differences(model, integrator, substeps):
    task = log_of(model, 30)
    task.measured[:] = 0.0  # so that no quaternion changes its sign
    engine = rollouts(model, integrator=integrator, substeps=substeps)
    p = task.parameters[:2]
    found = linearised(engine, task, p)
    assert found.unknowns == (*model.parameters, *model.state)
    for lane in range(2):
        expected = differences(engine, model, p[lane], task.states, task.inputs, task.dt)
        scale = np.abs(expected).max(axis=(0, 1)).clip(1.0)
        np.testing.assert_allclose(found.jacobian[lane] / scale, expected / scale, rtol=0, atol=1e-6)


@EVERY_MODEL
def test_the_jacobian_is_casadis_of_the_same_discrete_map(model):
    x, u, p = (ca.SX.sym(n, size) for n, size in (("x", len(model.state)), ("u", model.n_u), ("p", model.n_p)))
    rate = ca.Function("rate", [x, u, p], [model.dynamics(x, u, p)[0]])
    k = [rate(x, u, p)]
    for part in (0.5, 0.5, 1.0):
        k.append(rate(x + 0.01 * part * k[-1], u, p))
    after = x + 0.01 / 6 * (k[0] + 2 * k[1] + 2 * k[2] + k[3])
    for four in model.quaternions:
        values = after[list(four)]
        after[list(four)] = values / ca.norm_2(values)
    step = ca.Function("step", [x, u, p], [after])
    z = ca.MX.sym("z", model.n_p + len(model.state))
    task = log_of(model, 12)
    task.measured[:] = 0.0  # so that no quaternion changes its sign
    rows, state = [], z[model.n_p :]
    for row in task.inputs:
        rows.append(ca.vertcat(state, model.dynamics(state, row, z[: model.n_p])[1]))
        state = step(state, row, z[: model.n_p])
    slopes = ca.jtimes(ca.vertcat(*rows), z, ca.MX.eye(z.numel()))
    jacobian = ca.Function("jacobian", [z], [slopes, ca.jacobian(state, z)])
    expected, final = (np.array(part) for part in jacobian(np.concatenate([task.parameters[0], task.states])))
    found = linearised(rollouts(model), task, task.parameters[:1]).jacobian[0]
    np.testing.assert_allclose(found, expected.reshape(found.shape), rtol=1e-9, atol=1e-12)
    sums = sums_of(rollouts(model), task, task.parameters[:1])
    np.testing.assert_allclose(sums.final_slopes[0], final, rtol=1e-9, atol=1e-12)


def test_derivatives_of_a_linear_system_are_powers_of_its_step():
    p, h, n = np.array([3.0, 0.4]), 0.05, 40
    A = np.array([[0.0, 1.0], [-p[0], -p[1]]])
    step = sum(np.linalg.matrix_power(h * A, k) / f for k, f in enumerate((1, 1, 2, 6, 24)))
    powers = np.array([np.linalg.matrix_power(step, k) for k in range(n + 1)])
    engine = rollouts(LINEAR, ("q0", "v0"))
    problem = RolloutBatch([p], [1.0, 0.0], np.zeros((n, 1)), h), Measurements(np.zeros((n, 2)), np.ones(n, bool))
    found = engine.linearized_errors(*problem, unknowns=("q0", "v0"))
    np.testing.assert_allclose(found.jacobian[0], powers[:n], rtol=1e-12, atol=1e-13)
    sums = engine.gauss_newton(*problem, np.array([2.0, 3.0]), unknowns=("q0", "v0"))
    expected = np.einsum("kji,j,kjl->il", powers[:n], [2.0, 3.0], powers[:n])
    np.testing.assert_allclose(sums.normal_matrix[0], expected, rtol=1e-12)
    np.testing.assert_allclose(sums.gradient[0], expected @ [1.0, 0.0], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(sums.cost[0], expected[0, 0], rtol=1e-12)
    np.testing.assert_allclose(sums.final_states[0], powers[n] @ [1.0, 0.0], rtol=1e-12)
    np.testing.assert_allclose(sums.final_slopes[0], powers[n], rtol=1e-12)


@pytest.mark.parametrize("start", [[0.5, -0.4], [-3.0, 1.0]])
def test_a_branch_that_is_not_taken_leaves_no_nan_in_the_derivatives(start):
    """Sqrt(q) of a negative q and log(1 - q) of a large one are NaN, and so are their derivatives."""
    engine = rollouts(KINKS)
    p, n = np.array([[2.0, 1.5]]), 400
    inputs = np.full((n, 1), 0.1)
    batch = RolloutBatch(p, start, inputs, 0.01)
    found = engine.linearized_errors(batch, Measurements(np.zeros((n, 3)), np.ones(n, bool))).jacobian[0]
    assert np.isfinite(found).all()
    expected = differences(engine, KINKS, p[0], np.array(start), inputs, 0.01)
    (path,) = engine.trajectories(batch)
    crossing = int(np.argmax(np.sign(path[:, 0]) != np.sign(start[0])))  # a step over the kink has no derivative
    assert crossing > 50
    np.testing.assert_allclose(found[: crossing - 1], expected[: crossing - 1], rtol=1e-5, atol=1e-5)


def test_at_rest_dry_friction_has_a_finite_derivative():
    engine = rollouts(KINKS)
    batch = RolloutBatch([[2.0, 1.5]], [-1.0, 0.0], np.zeros((3, 1)), 0.01)
    found = engine.linearized_errors(batch, Measurements(np.zeros((3, 3)), [True] * 3))
    assert np.isfinite(found.jacobian).all()


def test_the_sign_of_a_quaternion_turns_its_derivatives_too():
    task = log_of(BODY, 40)
    engine = rollouts(BODY)
    p = task.parameters[:1]
    (truth,) = engine.trajectories(batch_of(task, p))
    task.measured = truth + 0.01
    plain, sums = linearised(engine, task, p), sums_of(engine, task, p)
    task.measured = task.measured.copy()
    task.measured[::3, :4] *= -1
    turned = linearised(engine, task, p)
    signs = np.ones((40, 10, 1))
    signs[::3, :4] = -1
    np.testing.assert_array_equal(turned.jacobian[0], plain.jacobian[0] * signs)
    np.testing.assert_allclose(turned.errors[0], plain.errors[0] * signs[..., 0], atol=1e-15)
    again = sums_of(engine, task, p)
    np.testing.assert_allclose(again.gradient, sums.gradient, rtol=1e-12)
    np.testing.assert_allclose(again.normal_matrix, sums.normal_matrix, rtol=1e-12)


# Sums ----------------------------------------------------------------------------------------------------------------
@EVERY_MODEL
def test_linearised_errors_are_the_errors(model):
    task = log_of(model, 60)
    engine = rollouts(model, substeps=2)
    errors = engine.errors(batch_of(task), measurements_of(engine, task))
    np.testing.assert_array_equal(linearised(engine, task).errors, errors)


@pytest.mark.parametrize("signals", [None, ("v2_dot", "q0"), ("q3", "q2", "q1", "q0", "v1")])
def test_sums_are_those_of_the_linearised_errors(signals):
    task = log_of(BODY, 50)
    engine = rollouts(BODY, signals)
    n_s = len(engine.signals)
    rng = np.random.default_rng(1)
    weights, d = rng.uniform(0, 3, (50, n_s)), rng.standard_normal((50, 3, n_s))
    sums, rows = sums_of(engine, task, weights=weights, directions=d), linearised(engine, task)
    W = np.where(task.valid[:, None], weights, 0.0)
    e, J = rows.errors, rows.jacobian
    np.testing.assert_allclose(sums.cost, np.einsum("lrs,rs,lrs->l", e, W, e), rtol=1e-13)
    np.testing.assert_allclose(sums.gradient, np.einsum("lrsi,rs,lrs->li", J, W, e), rtol=1e-10, atol=1e-10)
    expected = np.einsum("lrsi,rs,lrsj->lij", J, W, J)
    np.testing.assert_allclose(sums.normal_matrix, expected, rtol=1e-11, atol=1e-11)
    np.testing.assert_array_equal(sums.normal_matrix, sums.normal_matrix.swapaxes(1, 2))
    along = np.einsum("lrsi,rs,rds->ldi", np.concatenate([e[..., None], J], axis=3), W, d)
    np.testing.assert_allclose(sums.along, along, rtol=1e-10, atol=1e-10)


def test_sums_are_made_of_the_very_bits_of_the_linearised_errors():
    task = log_of(ROTORCRAFT, 25)
    engine = rollouts(ROTORCRAFT)
    weights = np.linspace(0.5, 2.0, 9)
    sums, rows = sums_of(engine, task, task.parameters[:2]), linearised(engine, task, task.parameters[:2])

    def total(lane, left, right, scale_left):
        """Sum in the kernel's order: row by row, signal by signal, each product added with one rounding."""
        result = 0.0
        for row in np.flatnonzero(task.valid):
            for s, w in enumerate(weights):
                x, y = left[lane, row, s], right[lane, row, s]
                x, y = (w * x, y) if scale_left else (x, w * y)
                result = float(Fraction(float(x)) * Fraction(float(y)) + Fraction(result))
        return result

    e, J = rows.errors, rows.jacobian
    for lane in range(2):
        assert sums.cost[lane] == total(lane, e, e, True)
        for i in (0, 2, 5, 7):
            assert sums.gradient[lane, i] == total(lane, J[..., i], e, False)
            assert sums.normal_matrix[lane, i, 8] == total(lane, J[..., i], J[..., 8], False)


@EVERY_MODEL
def test_fewer_unknowns_give_a_part_of_the_sums(model):
    task = log_of(model, 40)
    engine = rollouts(model)
    whole = sums_of(engine, task)
    names = list(whole.unknowns)
    for unknowns in (tuple(model.parameters), model.state, tuple(names[::-2])):
        part = sums_of(engine, task, unknowns=unknowns)
        places = [names.index(name) for name in unknowns]
        np.testing.assert_array_equal(part.cost, whole.cost)
        np.testing.assert_allclose(part.gradient, whole.gradient[:, places], rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(
            part.normal_matrix, whole.normal_matrix[:, places][..., places], rtol=1e-11, atol=1e-12
        )
        np.testing.assert_allclose(part.final_slopes, whole.final_slopes[..., places], rtol=1e-12, atol=1e-13)


@EVERY_MODEL
def test_the_normal_matrix_may_be_left_out_and_nothing_else_changes(model):
    task = log_of(model, 40)
    engine, batch = rollouts(model), batch_of(task)
    whole = sums_of(engine, task)
    weights = np.linspace(0.5, 2.0, len(engine.signals))
    part = engine.gauss_newton(batch, measurements_of(engine, task), weights, normal_matrix=False)
    assert part.normal_matrix.shape == (0, *whole.normal_matrix.shape[1:])
    for name in ("cost", "gradient", "final_states", "final_slopes", "diverged"):
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name), err_msg=name)


def test_a_gauss_newton_step_finds_the_parameters_of_a_clean_log():
    task = log_of(ROTORCRAFT, 200)
    engine = rollouts(ROTORCRAFT)
    truth = np.concatenate([task.parameters[0], task.states])
    task.measured = engine.trajectories(batch_of(task, truth[None, :3]))[0]
    z = truth * 1.05
    for _ in range(8):
        task.states = z[3:]
        sums = sums_of(engine, task, z[None, :3])
        z = z - np.linalg.solve(sums.normal_matrix[0], sums.gradient[0])
    np.testing.assert_allclose(z, truth, rtol=1e-9)


def test_a_measurement_without_weight_may_be_nan():
    task = log_of(PENDULUM, 40)
    engine = rollouts(PENDULUM)
    weights = np.random.default_rng(3).choice([0.0, 1.0, 2.5], (40, 3))
    expected = sums_of(engine, task, weights=weights)
    task.measured = np.where((weights > 0) & task.valid[:, None], task.measured, np.nan)
    assert_same(sums_of(engine, task, weights=weights), expected)
    with pytest.raises(SettingsError, match="a signal that has a weight"):
        sums_of(engine, task, weights=np.ones(3))


# Windows, lanes, bits ------------------------------------------------------------------------------------------------
def test_a_window_is_a_log_of_its_own_and_ends_where_the_next_begins():
    task = log_of(BODY, 100)
    engine = rollouts(BODY, substeps=2)
    p = np.repeat(task.parameters[:1], 4, axis=0)
    weights = np.random.default_rng(2).uniform(0, 1, (100, 10))
    (path,) = engine.trajectories(batch_of(task, p[:1]))
    starts = np.array([0, 25, 50, 75])
    task.states = path[starts, :7]
    found = sums_of(engine, task, p, weights, start_rows=starts, n_rows=25)
    rows = linearised(engine, task, p, start_rows=starts, n_rows=25)
    np.testing.assert_array_equal(found.final_states[:-1], path[starts[1:], :7])
    for lane, start in enumerate(starts):
        cut = slice(start, start + 25)
        one = RolloutBatch(p[lane : lane + 1], path[start, :7], task.inputs[cut], task.dt)
        seen = Measurements(task.measured[cut], task.valid[cut])
        alone = engine.gauss_newton(one, seen, weights[cut])
        for name in ("cost", "gradient", "normal_matrix", "final_states", "final_slopes"):
            np.testing.assert_array_equal(getattr(found, name)[lane], getattr(alone, name)[0], err_msg=name)
        np.testing.assert_array_equal(rows.jacobian[lane], engine.linearized_errors(one, seen).jacobian[0])


def test_final_states_and_slopes_are_those_of_one_row_more():
    task = log_of(ROTORCRAFT, 31)
    engine = rollouts(ROTORCRAFT, ROTORCRAFT.state)
    longer = linearised(engine, task)
    found = sums_of(engine, task, n_rows=30)
    states = engine.trajectories(batch_of(task))[:, 30, :6]
    np.testing.assert_array_equal(found.final_states, states)
    np.testing.assert_array_equal(found.final_slopes, longer.jacobian[:, 30])


@ON_EVERY_TARGET
@pytest.mark.parametrize("model", [ROTORCRAFT, BODY], ids=lambda model: model.name)
def test_sums_have_the_same_bits_for_any_batch_threads_and_target(model, target):
    task = log_of(model, 60)
    expected = sums_of(rollouts(model), task)
    engine = rollouts(model, target=target)
    assert_same(sums_of(engine, task, threads=3), expected)
    for first, end in ((0, 1), (7, 9), (4, 21), (20, 21)):
        part = sums_of(engine, task, task.parameters[first:end])
        for name, value in vars(expected).items():
            wanted = value if name == "unknowns" else value[first:end]
            np.testing.assert_array_equal(getattr(part, name), wanted, err_msg=name)
    rows = linearised(rollouts(model), task)
    assert_same(linearised(engine, task, threads=2), rows)


# Compile time --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("divided", [False, True])
def test_the_code_of_the_sums_grows_in_proportion_to_the_unknowns(divided):
    def lines(n):
        @machine("series", 1, 1, 1, n)
        def series(q, v, u, p):
            return [v[0]], [u[0] - sum(p[k] * ca.sin((k + 1) * q[0]) for k in range(n)) - p[n - 1] * v[0]]

        sensitivities = sensitivities_of(series, (*series.parameters, *series.state))
        row = loop_specification(series, series.signals, "rk4", sensitivities, varying=False, divided=divided)
        return str(emit_time_loop(row, GaussNewtonOutput, inputs_from_log, windows=True)).count("\n")

    few, more, many = lines(6), lines(12), lines(24)
    assert many - more < 2.2 * (more - few)


# Divergence ----------------------------------------------------------------------------------------------------------
def test_a_diverged_lane_costs_infinitely_and_adds_nothing():
    task = log_of(EXPLOSIVE, 300)
    p = np.tile([[2.0, 0.1]], (24, 1))
    p[3], p[20] = [-1.0, 0.1], [-2.0, 0.1]
    engine = rollouts(EXPLOSIVE)
    found = sums_of(engine, task, p, directions=np.ones((300, 1, len(engine.signals))))
    np.testing.assert_array_equal(found.diverged, score_of(engine, task, p).diverged)
    np.testing.assert_array_equal(np.flatnonzero(~found.diverged), [3, 20])
    np.testing.assert_array_equal(np.isinf(found.cost), found.diverged)
    assert not found.gradient[found.diverged].any()
    assert not found.normal_matrix[found.diverged].any()
    assert not found.along[found.diverged].any()
    assert np.isnan(found.final_states[found.diverged]).all()
    assert np.isnan(found.final_slopes[found.diverged]).all()
    for lane in (3, 20):
        alone = sums_of(engine, task, p[lane : lane + 1])
        assert np.isfinite(alone.cost[0])
        np.testing.assert_array_equal(alone.normal_matrix[0], found.normal_matrix[lane])
        np.testing.assert_array_equal(alone.final_slopes[0], found.final_slopes[lane])


def test_a_sum_that_overflows_counts_as_a_divergence():
    task = log_of(PENDULUM, 10)
    found = sums_of(rollouts(PENDULUM), task, weights=np.full(3, 1e308))
    assert found.diverged.all()
    assert not found.normal_matrix.any()


def test_linearised_errors_are_nan_from_a_divergence_on():
    task = log_of(EXPLOSIVE, 300)
    p = np.array([[2.0, 0.1], [-1.0, 0.1]])
    found = linearised(rollouts(EXPLOSIVE), task, p)
    ended = np.isnan(found.errors).any(axis=-1)
    np.testing.assert_array_equal(np.isnan(found.jacobian).all(axis=(-1, -2)), ended)
    assert ended[0].any()
    assert not ended[1].any()


# What users meet -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"unknowns": ("p0", "mass")}, "unknowns are p0, mass, .*there are p0, p1, q0, v0"),
        ({"unknowns": ("p0", "p0")}, "once"),
        ({"unknowns": ()}, "unknowns are none"),
        ({"weights": np.ones(2)}, r"weights has shape \(2,\), but \(20, 3\) is needed"),
        ({"weights": [1.0, -1.0, 1.0]}, "negative or not finite"),
        ({"weights": [1.0, np.nan, 1.0]}, "negative or not finite"),
    ],
)
def test_what_cannot_be_differentiated_is_refused(options, message):
    with pytest.raises(SettingsError, match=message):
        sums_of(rollouts(PENDULUM), log_of(PENDULUM, 20), **options)


def test_no_lanes_give_empty_sums():
    found = sums_of(rollouts(PENDULUM), log_of(PENDULUM, 20), np.empty((0, 2)))
    assert found.cost.shape == (0,)
    assert found.normal_matrix.shape == (0, 4, 4)
    assert found.final_slopes.shape == (0, 2, 4)
