"""Rollouts against slow, independent integrators, and the promise that a lane's bits depend on nothing but its data."""

from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from diransac.errors import ModelError, SettingsError
from diransac.kernel import Target
from diransac.simulate import inlier_mask, rollouts

TARGETS = {"host": None, "avx2": Target("haswell"), "avx512": Target("skylake-avx512")}
INTEGRATORS = {"rk4": 4, "euler": 1, "semi-implicit-euler": 1}


def stand_in(name, dynamics, n_q, quaternions=()):
    """What `rollouts` needs of a model; `dynamics(q, v, u, p)` gives dq/dt and the accelerations."""
    n_v, n_u, n_p = dynamics.sizes
    x, u, p = ca.SX.sym("x", n_q + n_v), ca.SX.sym("u", n_u), ca.SX.sym("p", n_p)
    rates, accelerations = dynamics(x[:n_q], x[n_q:], u, p)
    function = ca.Function("dynamics", [x, u, p], [ca.vertcat(*rates, *accelerations), ca.vertcat(*accelerations)])
    letters = [f"{kind}{k}" for kind, n in (("q", n_q), ("v", n_v), ("a", n_v)) for k in range(n)]
    return SimpleNamespace(
        name=name,
        dynamics=function,
        signals=tuple(letters),
        quaternions=quaternions,
        parameters=tuple(f"p{k}" for k in range(n_p)),
        n_q=n_q,
        n_v=n_v,
        n_u=n_u,
        n_p=n_p,
    )


def sized(*sizes):
    """Mark a function with its n_v, n_u, n_p."""

    def mark(function):
        function.sizes = sizes
        return function

    return mark


@sized(3, 2, 3)
def rotorcraft_dynamics(q, v, u, p):
    s, c, drag = ca.sin(q[2]), ca.cos(q[2]), p[2] * ca.fabs(u[0])
    return ca.vertsplit(v), [
        -(u[0] * s + drag * v[0] * c) / p[0],
        (u[0] * c - drag * v[1] * s) / p[0] - 9.81,
        0.177 * u[1] / p[1],
    ]


@sized(1, 1, 2)
def pendulum_dynamics(q, v, u, p):
    return [v[0]], [u[0] - p[0] * ca.sin(q[0]) - p[1] * ca.tanh(v[0])]


@sized(3, 3, 3)
def body_dynamics(q, v, u, p):
    w, x, y, z = ca.vertsplit(q)
    a, b, c = ca.vertsplit(v)
    rates = [
        0.5 * (-x * a - y * b - z * c), 0.5 * (w * a + y * c - z * b),
        0.5 * (w * b - x * c + z * a), 0.5 * (w * c + x * b - y * a),
    ]  # fmt: skip
    return rates, [
        (u[0] + (p[1] - p[2]) * b * c) / p[0],
        (u[1] + (p[2] - p[0]) * c * a) / p[1],
        (u[2] + (p[0] - p[1]) * a * b) / p[2],
    ]


@sized(2, 1, 2)
def explosive_dynamics(q, v, u, p):
    return ca.vertsplit(v), [p[0] * q[0] ** 3 + u[0], p[1] * q[1]]


ROTORCRAFT = stand_in("rotorcraft", rotorcraft_dynamics, 3)
PENDULUM = stand_in("pendulum", pendulum_dynamics, 1)
BODY = stand_in("body", body_dynamics, 4, ((0, 1, 2, 3),))
EXPLOSIVE = stand_in("explosive", explosive_dynamics, 2)


def log_of(model, n_rows, seed=0):
    """A problem for a model: parameters of some lanes, an initial state, inputs and measurements."""
    rng = np.random.default_rng(seed)
    time = 0.01 * np.arange(n_rows)[:, None]
    inputs = np.sin(time * rng.uniform(1, 7, model.n_u)) + 0.3 * rng.standard_normal((n_rows, model.n_u))
    states = rng.uniform(-1, 1, model.n_q + model.n_v)
    for four in model.quaternions:
        states[list(four)] /= np.linalg.norm(states[list(four)])
    parameters = rng.uniform(0.5, 2.0, (21, model.n_p))
    measured = rng.standard_normal((n_rows, len(model.signals)))
    return SimpleNamespace(
        parameters=parameters,
        states=states,
        inputs=inputs,
        measured=measured,
        valid=rng.uniform(size=n_rows) < 0.9,
        dt=0.01,
    )


def normalised(model, x):
    for four in model.quaternions:
        x[list(four)] /= np.linalg.norm(x[list(four)])
    return x


def plain_trajectory(model, p, x, inputs, dt, integrator="rk4", substeps=1):
    """Signals row by row, each step written out in NumPy around CasADi's own evaluation of the dynamics."""

    def slope(x, u):
        return np.array(model.dynamics(x, u, p)[0]).ravel()

    n_q, h, rows = model.n_q, dt / substeps, []
    for u in inputs:
        rows.append(np.concatenate([x, np.array(model.dynamics(x, u, p)[1]).ravel()]))
        for _ in range(substeps):
            k = slope(x, u)
            if integrator == "euler":
                x = x + h * k
            elif integrator == "semi-implicit-euler":
                v = x[n_q:] + h * k[n_q:]
                x = np.concatenate([x[:n_q] + h * slope(np.concatenate([x[:n_q], v]), u)[:n_q], v])
            else:
                k2 = slope(x + h / 2 * k, u)
                k3 = slope(x + h / 2 * k2, u)
                k4 = slope(x + h * k3, u)
                x = x + h / 6 * (k + 2 * k2 + 2 * k3 + k4)
            x = normalised(model, x)
    return np.array(rows)


def score_of(engine, task, parameters=None, *, thresholds=0.7, least=2, **options):
    n_signals = len(engine.signals)
    return engine.score(
        task.parameters if parameters is None else parameters, task.states, task.inputs, task.measured[:, :n_signals],
        task.valid, task.dt, np.full(n_signals, thresholds), least, **options,
    )  # fmt: skip


def assert_same(found, expected):
    """Two scores agree bit for bit."""
    np.testing.assert_array_equal(found.sum_squares, expected.sum_squares)
    np.testing.assert_array_equal(found.inlier_count, expected.inlier_count)
    np.testing.assert_array_equal(found.diverged, expected.diverged)


# What is computed ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("substeps", [1, 3])
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("model", [ROTORCRAFT, PENDULUM, BODY], ids=lambda model: model.name)
def test_trajectories_agree_with_a_plain_loop(model, integrator, substeps):
    task = log_of(model, 60)
    engine = rollouts(model, integrator=integrator, substeps=substeps)
    found = engine.trajectories(task.parameters[:3], task.states, task.inputs, task.dt)
    for p, signals in zip(task.parameters, found, strict=False):
        expected = plain_trajectory(model, p, task.states, task.inputs, task.dt, integrator, substeps)
        np.testing.assert_allclose(signals, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("model", [ROTORCRAFT, PENDULUM, BODY], ids=lambda model: model.name)
def test_fine_steps_agree_with_scipy_a_segment_per_row(model):
    task = log_of(model, 30)
    p, x = task.parameters[0], task.states
    (found,) = rollouts(model, substeps=20).trajectories(p[None], x, task.inputs, task.dt)
    for row, u in enumerate(task.inputs):
        np.testing.assert_allclose(found[row, : len(x)], x, rtol=0, atol=1e-10)
        slope = lambda _, state, u=u: np.array(model.dynamics(state, u, p)[0]).ravel()  # noqa: E731
        x = solve_ivp(slope, (0, task.dt), x, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]


def test_a_step_is_the_one_of_casadis_integrator():
    x, u, p = (ca.SX.sym(name, n) for name, n in (("x", 7), ("u", 3), ("p", 3)))
    rate = BODY.dynamics(x, u, p)[0]
    scheme = {"number_of_finite_elements": 1, "simplify": True}
    step = ca.integrator("step", "rk", {"x": x, "p": ca.vertcat(u, p), "ode": rate}, 0, 0.01, scheme)
    task = log_of(BODY, 2)
    (found,) = rollouts(BODY).trajectories(task.parameters[:1], task.states, task.inputs, 0.01)
    expected = np.array(step(x0=task.states, p=np.concatenate([task.inputs[0], task.parameters[0]]))["xf"]).ravel()
    np.testing.assert_allclose(found[1, :7], normalised(BODY, expected), rtol=1e-13)


@pytest.mark.parametrize(("integrator", "order"), INTEGRATORS.items())
def test_integrators_converge_at_their_order(integrator, order):
    task = log_of(BODY, 40)
    problem = (task.parameters[:1], task.states, task.inputs, 0.1)
    exact = rollouts(BODY, substeps=256).trajectories(*problem)[0, -1, :7]
    coarse, fine = (
        np.linalg.norm(rollouts(BODY, integrator=integrator, substeps=n).trajectories(*problem)[0, -1, :7] - exact)
        for n in (4, 8)
    )
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.25)


def test_semi_implicit_euler_keeps_the_energy_that_euler_gains():
    def energy(x):
        return x[..., 1] ** 2 / 2 - np.cos(x[..., 0])

    grown = {}
    for integrator in ("euler", "semi-implicit-euler"):
        engine = rollouts(PENDULUM, integrator=integrator)
        path = energy(engine.trajectories([[1.0, 0.0]], [1.0, 0.0], np.zeros((5000, 1)), 0.01)[0])
        grown[integrator] = np.ptp(path)
    assert grown["semi-implicit-euler"] < 0.01 < 0.1 < grown["euler"]


def test_the_acceleration_of_a_row_is_the_one_under_its_own_input():
    inputs = np.array([[0.0], [5.0], [0.0]])
    (found,) = rollouts(PENDULUM).trajectories([[0.0, 0.0]], [0.0, 0.0], inputs, 0.01)
    np.testing.assert_allclose(found[:, 2], [0.0, 5.0, 0.0])
    np.testing.assert_allclose(found[:, 1], [0.0, 0.0, 0.05])


def test_quaternions_stay_of_length_one():
    task = log_of(BODY, 3000)
    found = rollouts(BODY, integrator="euler").trajectories(task.parameters[:2], task.states, task.inputs, task.dt)
    np.testing.assert_allclose(np.linalg.norm(found[..., :4], axis=-1), 1.0, rtol=1e-15)


# Scores --------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("signals", [None, ("a1", "q0", "v2"), ("q0", "q1", "q2", "q3", "a0")])
def test_scores_are_those_of_the_errors(signals):
    task = log_of(BODY, 200)
    task.measured[~task.valid] = np.nan
    engine = rollouts(BODY, signals)
    measured = task.measured[:, : len(engine.signals)]
    scores = score_of(engine, task, thresholds=0.4)
    errors = engine.errors(task.parameters, task.states, task.inputs, measured, task.valid, task.dt)
    counted = np.where(task.valid[:, None], errors, 0.0)
    np.testing.assert_array_equal(scores.sum_squares, np.cumsum(counted**2, axis=1)[:, -1])
    mask = inlier_mask(errors, task.valid, np.full(len(engine.signals), 0.4), 2)
    np.testing.assert_array_equal(scores.inlier_count, mask.sum(axis=1))
    assert 0 < mask.mean() < 0.9
    assert not scores.diverged.any()


def test_errors_are_simulated_less_measured():
    task = log_of(ROTORCRAFT, 50)
    signals = ("theta_dot", "z")
    model = SimpleNamespace(
        **{**vars(ROTORCRAFT), "signals": ("x", "z", "theta", "x_dot", "z_dot", "theta_dot", *"abc")}
    )
    measured = task.measured[:, :2]
    errors = rollouts(model, signals).errors(task.parameters, task.states, task.inputs, measured, task.valid, task.dt)
    simulated = rollouts(model).trajectories(task.parameters, task.states, task.inputs, task.dt)
    np.testing.assert_array_equal(errors, simulated[..., [5, 1]] - measured)


def test_a_quaternion_is_compared_whatever_its_sign():
    task = log_of(BODY, 100)
    engine = rollouts(BODY)
    (truth,) = engine.trajectories(task.parameters[:1], task.states, task.inputs, task.dt)
    flipped = truth.copy()
    flipped[::3, :4] *= -1
    errors = engine.errors(task.parameters[:1], task.states, task.inputs, flipped, task.valid, task.dt)
    assert np.abs(errors).max() == 0.0
    three = rollouts(BODY, ("q0", "q1", "q2"))  # not the whole quaternion: taken as it is
    errors = three.errors(task.parameters[:1], task.states, task.inputs, flipped[:, :3], task.valid, task.dt)
    np.testing.assert_array_equal(errors[0, ::3], 2 * truth[::3, :3])


def test_thresholds_are_strict_and_zero_switches_a_signal_off():
    engine = rollouts(PENDULUM, ("q0", "v0"))
    problem = ([[0.0, 0.0]], [0.0, 0.0], np.zeros((4, 1)), np.array([[0.5, 0], [0.4, 0], [0, 0], [0, 1]]))
    counts = [
        engine.score(*problem, np.ones(4, bool), 0.01, thresholds, least).inlier_count[0]
        for thresholds, least in (([0.5, 0.1], 2), ([0.5, 0.1], 1), ([0.5, 0.0], 1), ([0.0, 0.0], 1), ([0.0, 0.0], 0))
    ]
    assert counts == [2, 4, 3, 0, 4]


@given(st.floats(1e-150, 1e150), st.integers(-3, 3))
@settings(max_examples=50, deadline=None)
def test_squares_keep_the_order_of_errors_and_thresholds(threshold, steps):
    error = threshold
    for _ in range(abs(steps)):
        error = np.nextafter(error, np.copysign(np.inf, steps))
    scores = rollouts(PENDULUM, ("q0",)).score(
        [[0.0, 0.0]], [0.0, 0.0], np.zeros((1, 1)), [[error]], np.ones(1, bool), 0.01, [threshold], 1
    )
    assert scores.inlier_count[0] == (error < threshold)


# Divergence ----------------------------------------------------------------------------------------------------------
def test_a_divergence_makes_every_sum_infinite_and_all_later_rows_outliers():
    n_rows = 400
    p = np.array([[1.0, 0.0], [-1.0, 0.0], [4.0, 0.0]])
    inputs, valid, measured = np.full((n_rows, 1), 1.0), np.ones(n_rows, bool), np.zeros((n_rows, 1))
    engine = rollouts(EXPLOSIVE, ("q1",))  # the second coordinate never moves; the first, unscored, explodes
    scores = engine.score(p, np.zeros(4), inputs, measured, valid, 0.02, [0.1], 1)
    np.testing.assert_array_equal(scores.diverged, [True, False, True])
    np.testing.assert_array_equal(scores.sum_squares[:, 0], [np.inf, 0.0, np.inf])
    errors = engine.errors(p, np.zeros(4), inputs, measured, valid, 0.02)
    with np.errstate(all="ignore"):
        plain = [plain_trajectory(EXPLOSIVE, row, np.zeros(4), inputs, 0.02) for row in p]
    finite = [np.logical_and.accumulate(np.isfinite(rows).all(axis=1)) for rows in plain]
    np.testing.assert_array_equal(~np.isnan(errors[..., 0]), finite)
    np.testing.assert_array_equal(scores.inlier_count, [rows.sum() for rows in finite])
    assert 0 < scores.inlier_count[0] < n_rows


def test_a_divergence_that_only_an_acceleration_shows_counts():
    engine = rollouts(EXPLOSIVE, ("q1",))
    found = engine.score([[1.0, 0.0]], [1e120, 0, 0, 0], np.zeros((1, 1)), [[0.0]], np.ones(1, bool), 0.01, [1.0], 1)
    assert found.diverged.all()
    assert np.isinf(found.sum_squares).all()
    assert found.inlier_count[0] == 0


def test_a_block_of_diverged_lanes_does_not_disturb_the_others():
    task = log_of(EXPLOSIVE, 300)
    p = np.tile([[2.0, 0.1]], (24, 1))
    p[3], p[20] = [-1.0, 0.1], [-2.0, 0.1]
    engine = rollouts(EXPLOSIVE)
    together = score_of(engine, task, p)
    np.testing.assert_array_equal(np.flatnonzero(~together.diverged), [3, 20])
    for lane in (3, 20, 5):
        alone = score_of(engine, task, p[lane : lane + 1])
        np.testing.assert_array_equal(alone.sum_squares[0], together.sum_squares[lane])
        assert alone.inlier_count[0] == together.inlier_count[lane]


def test_invalid_rows_are_simulated_through_but_not_counted():
    task = log_of(PENDULUM, 100)
    task.measured[~task.valid] = np.nan
    engine = rollouts(PENDULUM)
    scores = score_of(engine, task)
    none = engine.score(
        task.parameters, task.states, task.inputs, task.measured, np.zeros(100, bool), task.dt, np.ones(3), 1
    )
    np.testing.assert_array_equal(none.sum_squares, 0.0)
    np.testing.assert_array_equal(none.inlier_count, 0)
    assert np.isfinite(scores.sum_squares).all()
    measured = np.where(task.valid[:, None], task.measured, 1e9)
    again = engine.score(task.parameters, task.states, task.inputs, measured, task.valid, task.dt, np.full(3, 0.7), 2)
    assert_same(again, scores)


# Windows -------------------------------------------------------------------------------------------------------------
def test_a_window_is_a_log_of_its_own():
    task = log_of(BODY, 120)
    rng = np.random.default_rng(5)
    starts = rng.integers(0, 100, 21)
    states = rng.standard_normal((21, 7))
    engine = rollouts(BODY, substeps=2)
    problem = (task.parameters, states, task.inputs, task.measured, task.valid, task.dt)
    found = engine.score(*problem, np.full(10, 0.7), 2, start_rows=starts, n_rows=20)
    errors = engine.errors(*problem, start_rows=starts, n_rows=20)
    for lane, start in enumerate(starts):
        rows = slice(start, start + 20)
        one = (task.parameters[lane : lane + 1], states[lane], task.inputs[rows], task.measured[rows], task.valid[rows])
        alone = engine.score(*one, task.dt, np.full(10, 0.7), 2)
        np.testing.assert_array_equal(found.sum_squares[lane], alone.sum_squares[0])
        assert found.inlier_count[lane] == alone.inlier_count[0]
        np.testing.assert_array_equal(errors[lane], engine.errors(*one, task.dt)[0])


def test_lanes_with_a_common_window_are_those_of_the_cut_log():
    task = log_of(ROTORCRAFT, 90)
    engine = rollouts(ROTORCRAFT)
    found = score_of(engine, task, start_rows=np.full(21, 30), n_rows=40)
    cut = SimpleNamespace(**{**vars(task), **{k: getattr(task, k)[30:70] for k in ("inputs", "measured", "valid")}})
    assert_same(found, score_of(engine, cut))
    assert_same(score_of(engine, task, n_rows=40), score_of(engine, task, start_rows=np.zeros(21, int), n_rows=40))


# The same bits -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize("model", [ROTORCRAFT, BODY], ids=lambda model: model.name)
def test_scores_have_the_same_bits_for_any_batch_threads_and_target(model, target):
    task = log_of(model, 150)
    expected = score_of(rollouts(model), task)
    engine = rollouts(model, target=TARGETS[target])
    assert_same(score_of(engine, task, threads=3), expected)
    for first, end in ((0, 1), (7, 9), (4, 21), (20, 21)):
        part = score_of(engine, task, task.parameters[first:end])
        np.testing.assert_array_equal(part.sum_squares, expected.sum_squares[first:end])
        np.testing.assert_array_equal(part.inlier_count, expected.inlier_count[first:end])


@pytest.mark.parametrize("target", TARGETS)
def test_series_have_the_same_bits_for_any_batch_threads_and_target(target):
    task = log_of(BODY, 50)
    p, problem = task.parameters, (task.states, task.inputs, task.dt)
    expected = rollouts(BODY).trajectories(p, *problem)
    engine = rollouts(BODY, ("q0", "a2"), target=TARGETS[target])
    np.testing.assert_array_equal(engine.trajectories(p, *problem, threads=2), expected)
    np.testing.assert_array_equal(engine.trajectories(p[11:13], *problem), expected[11:13])


def test_what_is_scored_does_not_change_what_is_simulated():
    task = log_of(ROTORCRAFT, 80)
    everything = score_of(rollouts(ROTORCRAFT), task)
    first_two = score_of(rollouts(ROTORCRAFT, ("q0", "q1")), task)
    np.testing.assert_array_equal(first_two.sum_squares, everything.sum_squares[:, :2])


def test_callers_in_several_threads_get_the_same_scores():
    task = log_of(PENDULUM, 100)
    engine = rollouts(PENDULUM, integrator="euler", substeps=2)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: score_of(engine, task, threads=2), range(8)))
    for scores in found:
        assert_same(scores, found[0])


# What users meet -----------------------------------------------------------------------------------------------------
def test_rollouts_of_equal_equations_are_made_once():
    again = SimpleNamespace(**{**vars(PENDULUM), "name": "the same under another name"})
    assert rollouts(again) is rollouts(PENDULUM)
    assert rollouts(PENDULUM, ("q0",)) is not rollouts(PENDULUM)


def test_no_lanes_give_empty_scores():
    task = log_of(PENDULUM, 10)
    scores = score_of(rollouts(PENDULUM), task, np.empty((0, 2)))
    assert scores.sum_squares.shape == (0, 3)
    assert scores.inlier_count.shape == scores.diverged.shape == (0,)


def test_arrays_are_left_as_they_are():
    task = log_of(BODY, 30)
    before = {name: np.array(value) for name, value in vars(task).items()}
    for value in vars(task).values():
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
    score_of(rollouts(BODY), task, start_rows=np.arange(21) % 5, n_rows=20)
    for name, value in vars(task).items():
        np.testing.assert_array_equal(value, before[name])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parameters": np.ones((5, 3))}, r"parameters has shape \(5, 3\), but \(any, 2\) is needed"),
        ({"states": np.ones(3)}, r"initial_states has shape \(3,\)"),
        ({"states": np.ones((4, 2))}, r"initial_states has shape \(4, 2\), but \(21, 2\)"),
        ({"inputs": np.ones(20)}, "inputs has shape"),
        ({"measured": np.ones((19, 3))}, r"measured has shape \(19, 3\), but \(20, 3\)"),
        ({"measured": np.full((20, 3), np.nan)}, "NaN or an infinity in a valid row"),
        ({"valid": np.ones(20)}, "20 Booleans"),
        ({"dt": 0.0}, "dt is 0.0"),
        ({"start_rows": np.zeros(21, int)}, "start_rows is given without n_rows"),
        ({"start_rows": np.zeros(3, int), "n_rows": 5}, "one integer a lane, 21 in all"),
        ({"start_rows": np.full(21, 16), "n_rows": 5}, "do not lie within the log's 20 rows"),
        ({"n_rows": 21}, "n_rows is 21, but the log has 20 rows"),
        ({"threads": 0}, "threads is 0"),
        ({"thresholds": -1.0}, "each must be 0"),
    ],
)
def test_what_cannot_be_run_is_refused_with_what_was_found(change, message):
    task = log_of(PENDULUM, 20)
    options = {k: change.pop(k) for k in list(change) if k in ("start_rows", "n_rows", "threads", "thresholds")}
    task = SimpleNamespace(**{**vars(task), **change})
    with pytest.raises(SettingsError, match=message):
        score_of(rollouts(PENDULUM), task, **options)


def test_unknown_names_are_refused():
    with pytest.raises(SettingsError, match=r"altitude.*it has q0, v0, a0"):
        rollouts(PENDULUM, ("q0", "altitude"))
    with pytest.raises(SettingsError, match="once"):
        rollouts(PENDULUM, ("q0", "q0"))
    with pytest.raises(SettingsError, match="'rk5' is unknown; choose one of rk4"):
        rollouts(PENDULUM, integrator="rk5")
    with pytest.raises(SettingsError, match="substeps is 0"):
        rollouts(PENDULUM, substeps=0)


def test_dynamics_that_cannot_be_compiled_are_refused():
    x = ca.MX.sym("x", 2)
    u, p = ca.MX.sym("u"), ca.MX.sym("p", 2)
    mx = SimpleNamespace(**{**vars(PENDULUM), "dynamics": ca.Function("d", [x, u, p], [x, x[1]])})
    with pytest.raises(ModelError, match="'pendulum' are not made of SX symbols"):
        rollouts(mx)
