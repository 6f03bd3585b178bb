"""Open-loop prediction of a held-out log, recomputed by a plain Runge-Kutta loop."""

import json

import casadi as ca
import numpy as np
import pytest

import diransac as dr
from diransac.data.dataset import Dataset
from diransac.errors import LogError, SettingsError
from diransac.identification.diagnosis import Resolution
from diransac.identification.prediction.open_loop import OpenLoop
from diransac.model.library import builtin
from simulated import MACHINES, as_log, flight, rollout

PLANE, VEHICLE = MACHINES["planar-rotorcraft"], MACHINES["underwater-vehicle"]
TRUE = dr.Plant(builtin("planar-rotorcraft"), PLANE.truth)
WRONG = dr.Plant(builtin("planar-rotorcraft"), {"mass": 0.26, "inertia": 0.0039, "drag": 0.03})
N, DT = 300, 0.01


def noisy_flight(noise=0.01, seed=0):
    signals, inputs = flight(PLANE, N, DT)
    return signals + noise * np.random.default_rng(seed).normal(size=signals.shape), inputs


def by_hand(plant, signals, inputs, steps, starts):
    """RMSE, fit and R^2 of every signal over windows from the measured state, without their first rows."""
    p = list(plant.parameters.values())
    pairs = [
        (rollout(PLANE, p, signals[row, :6], inputs[row : row + steps + 1], DT)[1:], signals[row + 1 : row + steps + 1])
        for row in starts
    ]
    predicted, measured = (np.concatenate(x) for x in zip(*pairs, strict=True))
    used = np.isfinite(measured)
    rmse, fit, r_squared = [], [], []
    for i in range(measured.shape[1]):
        y, error = measured[used[:, i], i], (predicted - measured)[used[:, i], i]
        ratio = np.sum(error**2) / np.sum((y - y.mean()) ** 2)
        rmse.append(np.sqrt(np.mean(error**2)))
        fit.append(100.0 * (1.0 - np.sqrt(ratio)))
        r_squared.append(1.0 - ratio)
    return rmse, fit, r_squared


def assert_scores(scores, expected):
    for found, wanted in zip((scores.rmse, scores.fit_percent, scores.r_squared), expected, strict=True):
        assert list(found) == list(PLANE.signals)
        assert list(found.values()) == pytest.approx(wanted, rel=1e-9, abs=1e-12)


def test_true_plant_predicts_a_clean_flight_exactly():
    validation = dr.validate(TRUE, as_log(PLANE, *flight(PLANE, N, DT), DT))
    for scores in validation.horizons:
        assert max(scores.rmse.values()) < 1e-11
        assert min(scores.fit_percent.values()) == pytest.approx(100.0)
        assert min(scores.r_squared.values()) == pytest.approx(1.0)


@pytest.mark.parametrize("plant", [TRUE, WRONG], ids=["true", "wrong"])
def test_scores_are_those_of_windows_that_start_at_the_measured_state(plant):
    signals, inputs = noisy_flight()
    validation = dr.validate(plant, as_log(PLANE, signals, inputs, DT), 0.25, start="measured")
    windows, whole = validation.horizons
    assert (windows.horizon, windows.windows) == (pytest.approx(0.25), 11)
    assert_scores(windows, by_hand(plant, signals, inputs, 25, range(0, N - 25, 25)))
    assert (whole.horizon, whole.windows) == (np.inf, 1)
    assert_scores(whole, by_hand(plant, signals, inputs, N - 1, [0]))


def test_asked_horizon_is_the_one_on_top():
    validation = dr.validate(WRONG, as_log(PLANE, *noisy_flight(), DT), horizon=0.25)
    assert validation.rmse == validation.horizons[0].rmse
    assert validation.fit_percent == validation.horizons[0].fit_percent
    assert validation.r_squared == validation.horizons[0].r_squared


def test_without_a_horizon_those_that_suit_the_log_and_the_whole_log_are_scored():
    validation = dr.validate(WRONG, as_log(PLANE, *noisy_flight(), DT))
    assert [scores.horizon for scores in validation.horizons] == pytest.approx([0.05, 0.1, 0.2, np.inf])
    assert validation.rmse == validation.judged.rmse


def test_horizon_of_one_sample_is_one_step():
    signals, inputs = noisy_flight()
    log = as_log(PLANE, signals, inputs, DT)
    for horizon in (DT, log.dt, np.nextafter(DT, 0.0)):
        scores = dr.validate(TRUE, log, horizon, start="measured").horizons[0]
        assert_scores(scores, by_hand(TRUE, signals, inputs, 1, range(N - 1)))


@pytest.mark.parametrize("horizon", [0.0, -1.0, 0.001, float("nan")])
def test_horizon_shorter_than_a_sample_is_refused(horizon):
    with pytest.raises(SettingsError, match="horizon"):
        dr.validate(TRUE, as_log(PLANE, *noisy_flight(), DT), horizon=horizon)


@pytest.mark.parametrize(
    ("plant", "log", "horizon", "says"),
    [
        (TRUE, "clean.csv", None, "log is a str; give a dr.Log"),
        ("model.json", None, None, "plant is 'model.json'; give a dr.Plant or a dr.Result"),
        (TRUE.model, None, None, "plant is Model.*; give a dr.Plant or a dr.Result"),
        (TRUE, None, "x", "horizon is 'x'; give seconds"),
    ],
)
def test_argument_of_another_kind_is_refused(plant, log, horizon, says):
    with pytest.raises(SettingsError, match=says):
        dr.validate(plant, log or as_log(PLANE, *flight(PLANE, N, DT), DT), horizon)


def test_horizon_longer_than_the_log_is_the_whole_log():
    validation = dr.validate(TRUE, as_log(PLANE, *noisy_flight(), DT), horizon=1e6)
    assert [scores.horizon for scores in validation.horizons] == [np.inf]


# ---------------------------------------------------------------------- logs with less


def test_missing_samples_are_not_scored_and_windows_that_start_at_one_are_left_out():
    signals, inputs = noisy_flight()
    signals[[30, 31], 8] = np.nan  # an acceleration: not scored there
    signals[50, 3] = np.nan  # a velocity at the start of the third window
    scores = dr.validate(WRONG, as_log(PLANE, signals, inputs, DT), 0.25, start="measured").horizons[0]
    starts = [row for row in range(0, N - 25, 25) if row != 50]
    assert scores.windows == len(starts)
    assert_scores(scores, by_hand(WRONG, signals, inputs, 25, starts))


def test_log_is_scored_from_its_first_complete_state_on():
    signals, inputs = noisy_flight()
    signals[:4, 5] = np.nan
    windows, whole = dr.validate(WRONG, as_log(PLANE, signals, inputs, DT), 0.25, start="measured").horizons
    assert_scores(windows, by_hand(WRONG, signals, inputs, 25, range(4, N - 25, 25)))
    assert_scores(whole, by_hand(WRONG, signals, inputs, N - 5, [4]))


def test_signals_that_the_log_lacks_are_not_scored():
    log = as_log(PLANE, *noisy_flight(), DT)
    columns = {n: log[n] for n in log.names if not n.endswith("ddot") and n != "x"}
    validation = dr.validate(TRUE, dr.Log.from_arrays(log.time, columns))
    assert list(validation.rmse) == ["z", "theta", "x_dot", "z_dot", "theta_dot"]


@pytest.mark.parametrize(
    ("missing", "start", "says"), [("thrust", "smoothed", '"thrust" is missing'), ("theta", "measured", '"theta"')]
)
def test_log_that_cannot_be_simulated_is_refused_by_name(missing, start, says):
    log = as_log(PLANE, *noisy_flight(), DT)
    columns = {n: log[n] for n in log.names if n != missing}
    with pytest.raises(LogError, match=says):
        dr.validate(TRUE, dr.Log.from_arrays(log.time, columns), start=start)


def test_a_state_that_nothing_measures_is_estimated_with_the_model():
    log = as_log(PLANE, *noisy_flight(0.001), DT)
    columns = {n: log[n] for n in log.names if n != "theta" and not n.endswith("ddot")}
    found = dr.validate(TRUE, dr.Log.from_arrays(log.time, columns), 0.25)
    assert found.judged.relative_error["x_dot"] < 0.05


def test_log_without_one_complete_state_is_refused():
    signals, inputs = noisy_flight()
    signals[:-1:2, 4], signals[1:-1:2, 5] = np.nan, np.nan  # the last row, whole, starts nothing
    with pytest.raises(LogError, match="complete state"):
        dr.validate(TRUE, as_log(PLANE, signals, inputs, DT), start="measured")


def test_divergence_is_counted_and_infinitely_bad():
    signals, inputs = flight(VEHICLE, 200, 0.1)
    plant = dr.Plant(
        builtin("underwater-vehicle"), {"mass": 0.1, "linear_drag": 50.0, "quadratic_drag": 500.0, "bias": 0.0}
    )
    validation = dr.validate(plant, as_log(VEHICLE, signals, inputs, 0.1))
    assert validation.horizons[-1].diverged == 1
    assert validation.horizons[-1].rmse["x_dot"] == np.inf
    assert validation.to_dict()["horizons"][-1]["rmse"]["x_dot"] is None
    assert validation.verdict == "do not rely on this"


def test_prediction_whose_square_overflows_is_infinitely_bad():
    signals, inputs = flight(VEHICLE, 20, 0.1)
    plant = dr.Plant(
        builtin("underwater-vehicle"), {"mass": 1e-180, "linear_drag": 0.0, "quadratic_drag": 0.0, "bias": 0.0}
    )
    assert dr.validate(plant, as_log(VEHICLE, signals, inputs, 0.1), start="measured").rmse["x_ddot"] == np.inf


def test_signal_that_never_changes_has_no_fit():

    still = np.zeros((N, 9))
    still[:, 1] = 1.0
    hover = np.column_stack([np.full(N, 0.249 * 9.81), np.zeros(N)])
    validation = dr.validate(TRUE, as_log(PLANE, still, hover, DT))
    data = validation.to_dict()
    assert data["rmse"]["x"] == 0.0
    assert data["r_squared"]["x"] is None
    row = next(line.split() for line in str(validation).splitlines() if line.split()[:3] == ["whole", "log", "x"])
    assert row[8:10] == ["–", "–"]


# ---------------------------------------------------------------------- what is shown


def test_result_serves_as_a_plant():
    log = as_log(PLANE, *noisy_flight(), DT)
    result = dr.identify(TRUE.model, log, "ols")
    plant = dr.Plant(result.model, result.parameters)
    alone, own = dr.validate(plant, log), dr.validate(result, log)
    assert own.predictions == alone.predictions
    assert set(map(str, alone.findings)) <= set(map(str, own.findings))


def test_validation_is_ready_for_json_and_prints_every_signal_with_its_unit():
    validation = dr.validate(WRONG, as_log(PLANE, *noisy_flight(), DT), horizon=0.25)
    data = json.loads(json.dumps(validation.to_dict(), allow_nan=False))
    assert data["rmse"] == validation.rmse
    assert [row["windows"] for row in data["horizons"]] == [10, 1]  # the first of 11 rows of 25 determines a state
    lines = str(validation).splitlines()
    assert lines[0].startswith(validation.verdict)
    table = lines[next(k for k, line in enumerate(lines) if line.startswith("horizon")) + 1 :]
    rows = [line.split() for line in table[: 2 * len(PLANE.signals)]]
    assert [line.split()[2] for line in table[:3]] == ["x", "z", "theta"]
    units = dict(zip(PLANE.signals, ["m", "m", "rad", "m/s", "m/s", "rad/s", "m/s^2", "m/s^2", "rad/s^2"], strict=True))
    assert all(units[row[2]] in row for row in rows)


@pytest.mark.parametrize("stiffness", [None, 400.0], ids=["measured force", "target"])
def test_relative_error_of_the_predicted_force_is_that_of_a_wrong_mass(stiffness):
    dt, mass, damping, wrong = 0.005, 2.0, 5.0, 2.5
    t = np.arange(0.0, 10.0, dt)
    q = 0.3 * np.sin(3.0 * t + 0.3 * t**2)
    v, a = (np.gradient(q, dt, edge_order=2), np.gradient(np.gradient(q, dt, edge_order=2), dt, edge_order=2))
    force = mass * a + damping * v
    column = force if stiffness is None else q + force / stiffness
    unit = "N" if stiffness is None else "m"
    model = dr.Model(
        "axis",
        {"x": "m"},
        {"drive": unit},
        {"mass": dr.Parameter("kg", positive=True)},
        lambda q, v, a, u, p: [
            p.mass * a.x + damping * v.x - (u.drive if stiffness is None else stiffness * (u.drive - q.x))
        ],
    )
    log = dr.Log.from_arrays(t, {"x": q, "x_dot": v, "drive": column})
    validation = dr.validate(dr.Plant(model, {"mass": wrong}), log, input_hold="linear")
    expected = 100.0 * (wrong - mass) * np.linalg.norm(a) / np.linalg.norm(force)
    assert validation.force_error_percent["x"] == pytest.approx(expected, rel=0.02)
    assert "force error" in str(validation)
    assert validation.to_dict()["force_error_percent"]["x"] == validation.force_error_percent["x"]


# ---------------------------------------------------------------------- windows that begin at smoothed states


UNSTABLE = dr.Model(
    "inverted pendulum",
    {"q": "rad"},
    {"u": "N m"},
    {n: dr.Parameter("1", positive=True) for n in ("J", "k")},
    lambda q, v, a, u, p: [p.J * a.q - p.k * q.q - u.u],
)
BALANCED = {"J": 0.05, "k": 0.8}


def balanced(seed, outliers=0.0, noise=2e-4):
    """An unstable machine under a noisy stabilising law, by exact steps of its equation; positions alone."""
    rng, dt, n = np.random.default_rng(seed), 0.01, 1500
    J, k = BALANCED.values()
    w = np.sqrt(k / J)
    c, s = np.cosh(w * dt), np.sinh(w * dt)
    x, q, torque = np.array([0.05, 0.0]), np.zeros(n), np.zeros(n)
    for j in range(n):
        wave = sum(np.sin(f * j * dt + f) for f in (0.9, 2.3, 4.1, 7.7))
        q[j], torque[j] = x[0], -3.0 * x[0] - 0.4 * x[1] + 0.15 * wave
        e = torque[j] / k
        x = np.array([c * (x[0] + e) + s / w * x[1] - e, s * w * (x[0] + e) + c * x[1]])
    measured = q + noise * rng.normal(size=n)
    hit = rng.random(n) < outliers
    measured[hit] += rng.choice([-1.0, 1.0], hit.sum()) * rng.uniform(0.2, 3.0, hit.sum())
    return dr.Log.from_arrays(np.arange(n) * dt, {"q": measured, "u": torque})


def scaled(J=1.0, k=1.0):
    return dr.Plant(UNSTABLE, {"J": J * BALANCED["J"], "k": k * BALANCED["k"]})


def test_outliers_in_the_log_do_not_change_robust_scores_and_one_percent_of_a_parameter_does():
    clean, hit = (dr.validate(scaled(), balanced(1, share), 0.2) for share in (0.0, 0.05))
    assert hit.judged.horizon == clean.judged.horizon
    assert hit.judged.robust_rmse["q"] == pytest.approx(clean.judged.robust_rmse["q"], rel=0.05)
    assert hit.judged.rmse["q"] > 50.0 * hit.judged.robust_rmse["q"]
    assert hit.outlier_fraction["q"] == pytest.approx(0.05, abs=0.015)
    worse = dr.validate(scaled(J=1.01, k=1.01), balanced(1, 0.05), 0.2)
    assert worse.judged.relative_error["q"] > max(0.005, 3.0 * hit.judged.relative_error["q"])


def test_an_unstable_machine_is_judged_over_horizons_at_which_prediction_means_something():
    right, wrong = (dr.validate(plant, balanced(2, 0.05)) for plant in (scaled(), scaled(J=1.4, k=0.6)))
    assert right.verdict == "usable"
    assert wrong.verdict == "do not rely on this"
    assert right.judged.horizon < 2.0
    assert right.horizons[-1].robust_rmse["q"] > 1e6
    assert any("whole log is not judged" in text for text in right.findings)


def test_trivial_predictions_are_scored_beside_the_model():
    t = np.arange(0.0, 10.0, 0.01)
    log = dr.Log.from_arrays(t, {"q": 2.0 * t, "u": -BALANCED["k"] * 2.0 * t})  # uniform motion
    scores = dr.validate(scaled(), log, 0.5, input_hold="linear").judged
    assert scores.constant_velocity["q"] < 1e-6
    assert scores.hold_last["q"] == pytest.approx(np.sqrt(np.mean((2.0 * 0.01 * np.arange(1, 51)) ** 2)), rel=1e-3)


@pytest.mark.parametrize("horizon", [3.0, 6.0])
def test_a_horizon_at_which_prediction_means_nothing_gives_neither_a_good_nor_a_bad_verdict(horizon):
    found = dr.validate(scaled(), balanced(2, 0.05, noise=2e-3), horizon)  # off by 0 at 3 s, by 5600000 at 6 s
    assert found.judged.of_starts["q"] > 10.0
    assert found.verdict == "usable with care"
    assert "tells little of the model" in found.findings[0]


def test_an_error_beyond_what_the_start_can_do_is_bad_at_any_horizon():
    found = dr.validate(scaled(J=1.4, k=0.6), balanced(2, 0.05, noise=2e-3), 3.0)
    assert found.judged.sensitivity["q"] > 5.0
    assert found.verdict == "do not rely on this"


SENSED = dr.Model(
    "sledge with accelerometer",
    {"x": "m"},
    {"u": "N"},
    {"m": dr.Parameter("kg", positive=True), "d": dr.Parameter("N s/m"), "scale": dr.Parameter("1")},
    lambda q, v, a, u, p: [p.m * a.x + p.d * v.x - u.u],
    sensors={"acc": dr.Sensor("m/s^2", lambda q, v, a, u, p: p.scale * a.x)},
)


def sledge_log(n=1000, seed=0):
    """Exact motion of a sledge of 2 kg and 1 N s/m whose force holds between samples, with noise and accelerations."""
    rng, dt = np.random.default_rng(seed), 0.01
    t = dt * np.arange(n)
    u, x, v, decay = 4.0 * np.sin(1.7 * t) + 3.0 * np.sin(5.3 * t), np.zeros(n), np.zeros(n), np.exp(-0.5 * dt)
    for k in range(n - 1):
        v[k + 1] = u[k] + (v[k] - u[k]) * decay
        x[k + 1] = x[k] + u[k] * dt + (v[k] - u[k]) * (1.0 - decay) / 0.5
    noisy = {"x": x + 2e-3 * rng.normal(size=n), "acc": 0.5 * (u - v) + 0.01 * rng.normal(size=n)}
    return dr.Log.from_arrays(t, {**noisy, "u": u}, source=f"{n} rows")


def test_a_wrong_parameter_of_a_sensor_alone_is_not_usable():
    right, wrong = (
        dr.validate(dr.Plant(SENSED, {"m": 2.0, "d": 1.0, "scale": scale}), sledge_log()) for scale in (1.0, 1.4)
    )
    assert right.verdict == "usable", right.findings
    assert wrong.verdict == "usable with care"
    errors, size = wrong.judged, np.sqrt(np.mean(sledge_log()["acc"] ** 2))
    assert errors.robust_rmse["acc"] == pytest.approx(0.4 * size, rel=0.1)
    assert errors.relative_error["acc"] == pytest.approx(errors.robust_rmse["acc"] / errors.hold_last["acc"], rel=0.05)
    assert any("reading of acc is off by" in text for text in wrong.findings)


def test_a_log_that_is_too_short_for_its_noise_to_be_known_convicts_no_model():
    plant = dr.Plant(SENSED, {"m": 2.0, "d": 1.0, "scale": 1.0})
    log = sledge_log(10)
    hit = dr.Log.from_arrays(log.time, {"x": log["x"], "x_dot": log["x"] + 3.0, "u": log["u"]}, source="10 rows")
    found = dr.validate(plant, hit)
    assert max(found.judged.relative_error.values()) > 0.5
    assert found.verdict == "usable with care"
    assert "10 rows" in found.findings[0]
    assert dr.validate(plant, hit, start="measured").verdict == "do not rely on this"


def test_a_log_in_which_nothing_moves_says_so():
    still = dr.Log.from_arrays(0.01 * np.arange(500), {n: np.zeros(500) for n in ("x", "x_dot", "u")})
    found = dr.validate(dr.Plant(SENSED, {"m": 2.0, "d": 1.0, "scale": 1.0}), still)
    assert found.findings[0].startswith("No state moves")


def test_windows_on_an_axis_that_rests_begin_where_it_rests():
    model = dr.Model(
        name="slider",
        coordinates={"x": "m"},
        inputs={"force": "N"},
        parameters={"mass": dr.Parameter("kg"), "dry": dr.Parameter("N")},
        equations=lambda q, v, a, u, p: [p.mass * a.x + p.dry * ca.tanh(v.x / 0.01) - u.force],
    )
    truth = {"mass": 1.0, "dry": 2.0}
    rng, t = np.random.default_rng(4), np.arange(0.0, 8.0, 0.01)
    force = 3.0 * np.where(np.sin(2.4 * t) > 0.6, 1.0, np.where(np.sin(2.4 * t) < -0.6, -1.0, 0.0))
    x, v = np.zeros((2, len(t)))
    for k in range(len(t) - 1):
        x[k + 1], v[k + 1] = x[k], v[k]
        for _ in range(50):
            v[k + 1] += 2e-4 * (force[k] - truth["dry"] * np.tanh(v[k + 1] / 0.01)) / truth["mass"]
            x[k + 1] += 2e-4 * v[k + 1]
    noisy = dr.Log.from_arrays(t, {"x": x + rng.normal(0.0, 1e-3, len(t)), "force": force})
    dataset = Dataset.of(model, [noisy], pointwise=False)
    loop = OpenLoop(dataset, 0, truth, Resolution(substeps=20), "smoothed")
    rows = np.arange(60, 740, 20)
    states, _ = loop.starts(rows)
    np.testing.assert_allclose(states[:, 0], x[rows], atol=0.02)
    np.testing.assert_allclose(states[:, 1], v[rows], atol=0.02)


@pytest.mark.parametrize(("noise", "verdict"), [(0.02, "usable"), (0.7, "usable with care")])
def test_noise_of_a_signal_with_few_samples_is_not_that_of_a_motion_that_follows_them(noise, verdict):
    """Positions once a second: noise of 0.7 m made outliers of 55 %, and the true model not to be relied on."""
    plant = dr.Plant(builtin("underwater-vehicle"), dict(zip(VEHICLE.truth, (120.0, 20.0, 35.0, 3.0), strict=True)))
    t = 0.01 * np.arange(6000)
    inputs = {"thrust": 40.0 * np.sin(0.4 * t) + 25.0 * np.sin(1.3 * t)}
    start = {"x": 0.0, "x_dot": 0.0}
    exact = dr.simulate(plant, dr.Log.from_arrays(t, inputs), initial_state=start, substeps=2)["x"]
    x = np.full(len(t), np.nan)
    x[::100] = (exact + noise * np.random.default_rng(1).normal(size=len(t)))[::100]
    found = dr.validate(plant, dr.Log.from_arrays(t, {**inputs, "x": x}))
    assert found.verdict == verdict
    assert found.outlier_fraction["x"] < 0.1
