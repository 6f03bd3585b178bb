"""Several logs of one machine: shared and per-log parameters, agreement, validation, rates, progress."""

import math
from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest

import diransac as dr
from diransac.data.dataset import Dataset, ParameterLayout
from diransac.errors import LogError, SettingsError
from diransac.identification.diagnosis import Resolution
from diransac.identification.prediction.open_loop import OpenLoop
from diransac.model.library import builtin
from diransac.simulation import RolloutBatch, rollouts
from simulated import MACHINES, flight, rollout

VEHICLE, PLANE = MACHINES["underwater-vehicle"], MACHINES["planar-rotorcraft"]
DT = 0.02
BIASES = (4.0, -12.0, 25.0)
STARTS = ((0.0, 0.2), (1.0, -0.4), (-2.0, 0.6))
QUICK = dr.Settings(sample_size=30, max_iterations=40)
SHARED = {n: x for n, x in VEHICLE.truth.items() if n != "bias"}


def settings_of(method):
    return QUICK if method in ("diransac", "i-diransac") else None


def named_log(machine, signals, inputs, name, dt=DT, without=(), late=0.0):
    columns = dict(zip(machine.signals, signals.T, strict=True)) | dict(zip(machine.inputs, inputs.T, strict=True))
    kept = {n: x for n, x in columns.items() if n not in without}
    return dr.Log.from_arrays(late + dt * np.arange(len(signals)), kept, source=name)


def pieces(machine, signals, inputs, n, dt=DT):
    """Logs of consecutive stretches of one flight."""
    parts = zip(np.array_split(signals, n), np.array_split(inputs, n), strict=True)
    return [named_log(machine, y, u, f"part {i}", dt) for i, (y, u) in enumerate(parts)]


def affine(q, v, a, u, p):
    return [p.mass * a.x + p.linear_drag * v.x + p.quadratic_drag * ca.fabs(v.x) * v.x + p.bias - u.thrust]


def vehicle(equations=affine):
    """The vehicle whose constant force is another one in every log."""
    units = {"linear_drag": "N s/m", "quadratic_drag": "N s^2/m^2"}
    drags = {name: dr.Parameter(unit) for name, unit in units.items()}
    parameters = {"mass": dr.Parameter("kg", positive=True), **drags, "bias": dr.Parameter("N", per_log=True)}
    return dr.Model("vehicle", {"x": "m"}, {"thrust": "N"}, parameters, equations)


@cache
def sailed(bias, start, n_rows=500, dt=DT, mass=60.0):
    """Signals and inputs of the vehicle with such a bias, from such a state."""
    truth = dict(VEHICLE.truth) | {"bias": bias, "mass": mass}
    return flight(replace(VEHICLE, start=start), n_rows, dt, truth, substeps=4)


def biased_logs(noise=0.0, biases=BIASES, masses=(60.0,) * 9, **options):
    """One log per bias, from another state each."""
    logs = []
    for i, bias in enumerate(biases):
        signals, inputs = sailed(bias, STARTS[i % len(STARTS)], mass=masses[i])
        white = np.random.default_rng([5, i]).normal(size=signals.shape)
        logs.append(named_log(VEHICLE, signals + noise * signals.std(axis=0) * white, inputs, f"dive {i}", **options))
    return logs


@cache
def of_noisy_logs(method):
    """Result of logs with noise and a bias each, and the reports on the way to it."""
    calls = []
    logs, settings = biased_logs(noise=0.01), settings_of(method)
    return dr.identify(vehicle(), logs, method, settings=settings, progress=calls.append), calls


# ---------------------------------------------------------------------- the vector of all parameters


def test_layout_holds_shared_parameters_once_and_per_log_ones_once_per_log():
    layout = ParameterLayout(vehicle().parameters, 3)
    assert layout.names == ("mass", "linear_drag", "quadratic_drag", "bias[0]", "bias[1]", "bias[2]")
    values = np.array([60.0, 35.0, 55.0, 1.0, 2.0, 3.0])
    assert [layout.of_log(values, i).tolist() for i in range(3)] == [[60.0, 35.0, 55.0, x] for x in (1.0, 2.0, 3.0)]
    assert layout.mean_map @ values == pytest.approx([60.0, 35.0, 55.0, 2.0])
    assert layout.scattered(np.array([[1.0, 2.0, 3.0, 4.0]]), 1).tolist() == [[1.0, 2.0, 3.0, 0.0, 4.0, 0.0]]


def test_layout_of_one_log_is_the_models():
    layout = ParameterLayout(vehicle().parameters, 1)
    assert layout.is_shared
    assert layout.names == tuple(vehicle().parameters)


def test_layout_checks_the_bounds_of_every_log():
    layout = ParameterLayout({"k": dr.Parameter(lower=0.0, per_log=True), "c": dr.Parameter(positive=True)}, 2)
    vectors = np.array([[0.0, 1.0, 1.0], [-1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, 0.0]])
    assert layout.admits(vectors).tolist() == [True, False, False, False]
    assert layout.violations(np.array([1.0, -1.0, 0.0])) == ("k[1]", "c")


# ---------------------------------------------------------------------- logs of one machine


def test_least_squares_of_a_log_in_five_pieces_is_that_of_the_rows_written_by_hand():
    signals, inputs = flight(PLANE, 503, DT)
    signals = signals + 0.05 * signals.std(axis=0) * np.random.default_rng(0).normal(size=signals.shape)
    result = dr.identify(builtin("planar-rotorcraft"), pieces(PLANE, signals, inputs, 5), "ols")
    W, b = PLANE.rows(signals, inputs)
    expected = np.linalg.lstsq(W.reshape(-1, 3), b.ravel(), rcond=None)[0]
    assert list(result.parameters.values()) == pytest.approx(expected, rel=1e-9)
    whole = dr.identify(builtin("planar-rotorcraft"), pieces(PLANE, signals, inputs, 1), "ols")
    assert result.covariance == pytest.approx(whole.covariance, rel=1e-6)
    assert (result.n_fitted, [x.n_rows for x in result.logs]) == (503, [101, 101, 101, 100, 100])


def test_fit_error_and_inliers_of_several_logs_are_those_of_simulations_that_start_anew_in_each():
    signals, inputs = flight(PLANE, 300, DT)
    signals = signals + 0.02 * signals.std(axis=0) * np.random.default_rng(1).normal(size=signals.shape)
    settings = replace(dr.Settings.table_iv(), sample_size=75, max_iterations=1000, stop_inlier_fraction=0.85)
    judging = dr.Settings(
        error_weights=settings.error_weights,
        inlier_thresholds=settings.inlier_thresholds,
        min_inlier_signals=settings.min_inlier_signals,
    )
    logs = pieces(PLANE, signals, inputs, 3)
    result = dr.identify(builtin("planar-rotorcraft"), logs, "ols", settings=judging)
    p = list(result.parameters.values())
    parts = list(zip(np.array_split(signals, 3), np.array_split(inputs, 3), strict=True))
    differences = [rollout(PLANE, p, y[0, :6], u, DT) - y for y, u in parts]
    weights = np.array([settings.error_weights.get(n, 0.0) for n in PLANE.signals])
    limits = np.array([settings.inlier_thresholds.get(n, 0.0) for n in PLANE.signals])

    def error(rows):
        return float(weights @ np.sqrt(np.mean(rows**2, axis=0)))

    near = (np.abs(np.concatenate(differences)) < limits).sum(axis=1) >= 3
    assert result.fit_error == pytest.approx(error(np.concatenate(differences)), rel=1e-9)
    assert [x.fit_error for x in result.logs] == pytest.approx([error(rows) for rows in differences], rel=1e-9)
    assert np.array_equal(result.inliers, near)
    assert [x.inlier_fraction for x in result.logs] == [x.mean() for x in np.array_split(near, 3)]
    assert np.array_equal(result.inliers[result.log_rows(1)], near[100:200])


@pytest.mark.parametrize("method", dr.METHODS)
def test_every_method_returns_the_truth_from_clean_logs(method):
    signals, inputs = flight(PLANE, 900, 0.01, substeps=4)
    logs = pieces(PLANE, signals, inputs, 3, 0.01)
    result = dr.identify(builtin("planar-rotorcraft"), logs, method, settings=settings_of(method))
    assert result.parameters == pytest.approx(PLANE.truth, rel=1e-6)
    assert result.inliers.all()
    assert len(result.inliers) == 900
    assert [x.source for x in result.logs] == ["part 0", "part 1", "part 2"]
    assert "3 logs" in str(result)


@pytest.mark.parametrize("method", ["i-diransac", "lo-diransac"])
def test_outliers_in_several_logs_leave_the_parameters_exact(method):
    signals, inputs = flight(PLANE, 1500, 0.01, substeps=4)
    rng = np.random.default_rng(3)
    hit = rng.random(signals.shape) < 0.1
    hit[[0, 500, 1000]] = False
    logs = pieces(PLANE, signals + hit * rng.uniform(-30.0, 30.0, signals.shape), inputs, 3, 0.01)
    whole_rows = dr.Settings(sample_size=5, max_iterations=300, min_inlier_signals=6, stop_inlier_fraction=None)
    settings = whole_rows if method == "i-diransac" else None
    result = dr.identify(builtin("planar-rotorcraft"), logs, method, settings=settings)
    assert result.parameters == pytest.approx(PLANE.truth, rel=1e-3)


@pytest.mark.parametrize("method", dr.METHODS)
def test_same_seed_gives_the_same_result(method):
    again = dr.identify(vehicle(), biased_logs(noise=0.01), method, settings=settings_of(method))
    assert again == of_noisy_logs(method)[0]


@pytest.mark.parametrize("method", ["diransac", "i-diransac"])
def test_batch_size_and_threads_never_change_an_answer(method):
    logs = biased_logs(noise=0.02)
    usual = dr.identify(vehicle(), logs, method, settings=QUICK)
    for changes in ({"batch_size": 1, "threads": 1}, {"batch_size": 7, "threads": 2}):
        other = dr.identify(vehicle(), logs, method, settings=replace(QUICK, **changes))
        assert replace(other, settings=usual.settings) == usual


def test_one_log_in_a_sequence_is_that_log():
    (log,) = biased_logs(biases=(4.0,))
    assert dr.identify(vehicle(), [log], "ols") == dr.identify(vehicle(), log, "ols")


def test_logs_keep_their_times():
    signals, inputs = sailed(4.0, STARTS[0])
    logs = [named_log(VEHICLE, signals, inputs, name, late=late) for name, late in (("a", 3.0), ("b", 100.0))]
    result = dr.identify(builtin("underwater-vehicle"), logs)
    assert [x.start for x in result.logs] == [3.0, 100.0]
    found = result.diagnosis
    assert set(found.window_log.tolist()) == {0, 1}
    for i, late in enumerate((3.0, 100.0)):
        own = found.windows_of(i)
        assert found.smoothed_time[own[0]] == pytest.approx(late)
        assert (np.diff(found.smoothed_time[own]) > 0).all()
        rows = np.rint((found.smoothed_time[own] - late) / DT).astype(int)
        assert found.smoothed_states["x_dot"][own] == pytest.approx(signals[rows, 1], abs=1e-3)
    assert result.inlier_times.max() == pytest.approx(100.0 + DT * 499)


# ---------------------------------------------------------------------- parameters of each log


@pytest.mark.parametrize("method", dr.METHODS)
def test_bias_of_each_log_is_found_beside_shared_parameters(method):
    result = dr.identify(vehicle(), biased_logs(), method, settings=settings_of(method))
    assert result.per_log == {"bias": pytest.approx(BIASES, rel=1e-3)}
    assert result.parameters == pytest.approx(SHARED | {"bias": np.mean(BIASES)}, rel=1e-3)
    assert result.covariance.shape == (4, 4)
    assert result.estimate.covariance.shape == (6, 6)
    assert tuple(result.estimate.parameters)[3:] == ("bias[0]", "bias[1]", "bias[2]")
    assert list(result.standard_errors) == list(result.intervals()) == list(result.parameters)


@pytest.mark.parametrize("method", ["nls", "i-diransac", "lo-diransac"])
def test_bias_of_each_log_is_found_by_a_model_that_is_not_affine(method):
    model = vehicle(lambda q, v, a, u, p: [a.x + (affine(q, v, a, u, p)[0] - p.mass * a.x) / p.mass])
    assert model.nonlinear_parameters
    settings = dr.Settings(sample_size=30, max_iterations=5) if method == "i-diransac" else None
    result = dr.identify(model, biased_logs(), method, settings=settings)
    assert result.per_log == {"bias": pytest.approx(BIASES, rel=1e-3)}
    assert result.parameters == pytest.approx(SHARED | {"bias": np.mean(BIASES)}, rel=1e-3)


@pytest.mark.parametrize("method", ["ols", "i-diransac", "lo-diransac"])
def test_intervals_of_per_log_parameters_hold_the_truth(method):
    result = of_noisy_logs(method)[0]
    errors = np.sqrt(np.diag(result.estimate.covariance))
    off = np.abs(result.estimate.values - [*SHARED.values(), *BIASES])
    assert (off < 5.0 * errors).all()
    # The mean over logs has the variance of a mean.
    weights = np.r_[0.0, 0.0, 0.0, np.full(3, 1.0 / 3.0)]
    assert result.covariance[3, 3] == pytest.approx(weights @ result.estimate.covariance @ weights)


def test_least_squares_with_a_bias_per_log_is_that_of_a_column_per_log():
    result = dr.identify(vehicle(), biased_logs(noise=0.02), "ols")
    wide, right = np.zeros((3 * 500, 6)), np.zeros(3 * 500)
    for i, log in enumerate(biased_logs(noise=0.02)):
        rows, signals = slice(500 * i, 500 * (i + 1)), np.column_stack([log[n] for n in VEHICLE.signals])
        W, b = VEHICLE.rows(signals, log["thrust"][:, None])
        wide[rows, [0, 1, 2, 3 + i]], right[rows] = W[:, 0], b[:, 0]
    expected = np.linalg.lstsq(wide, right, rcond=None)[0]
    assert result.estimate.values == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("method", ["ols", "i-diransac", "lo-diransac"])
def test_result_of_several_logs_is_loaded_as_it_was_saved(method, tmp_path):
    result = of_noisy_logs(method)[0]
    result.save(tmp_path / "model.json")
    loaded = dr.Result.load(tmp_path / "model.json")
    assert loaded == result
    assert str(loaded) == str(result)
    assert loaded.per_log == result.per_log
    assert loaded.logs == result.logs
    assert np.array_equal(loaded.covariance, result.covariance)


def test_result_prints_a_row_per_log_with_its_own_parameters():
    result = dr.identify(vehicle(), biased_logs(), "ols")
    lines = str(result).splitlines()
    assert any("bias ± standard error [N]" in line for line in lines)
    assert any(line.startswith("bias (mean of logs)") for line in lines)
    for i, bias in enumerate(BIASES):
        (line,) = [x for x in lines if x.startswith(f"dive {i} ")]
        assert f" {bias:.5g}" in line


def test_per_log_parameter_of_one_log_is_an_ordinary_one():
    (log,) = biased_logs(biases=(4.0,))
    result = dr.identify(vehicle(), log, "ols")
    assert result.parameters == pytest.approx(VEHICLE.truth, rel=1e-6)
    assert result.per_log == {"bias": (pytest.approx(4.0, rel=1e-6),)}


def test_parameter_that_one_log_does_not_determine_is_named_with_its_log():
    """A sensor's gain that multiplies an input, which is zero in the second log."""
    model = dr.Model(
        "two thrusters",
        {"x": "m"},
        {"thrust": "N", "aid": "N"},
        {"mass": dr.Parameter("kg", positive=True), "gain": dr.Parameter("1", per_log=True)},
        lambda q, v, a, u, p: [p.mass * a.x - u.thrust - p.gain * u.aid],
    )
    rng, logs = np.random.default_rng(0), []
    for i, size in enumerate((1.0, 0.0)):
        thrust, aid = rng.normal(size=200), size * rng.normal(size=200)
        columns = {"x_ddot": (thrust + 0.5 * aid) / 3.0, "thrust": thrust, "aid": aid}
        logs.append(dr.Log.from_arrays(0.01 * np.arange(200), columns, source=f"log {i}"))
    with pytest.raises(dr.IdentificationError, match=r"gain\[1\] is not identifiable"):
        dr.identify(model, logs, "ols")


@pytest.mark.parametrize("call", [dr.identify, dr.cross_validate])
def test_a_log_that_is_given_twice_is_refused(call):
    """Its copy is no further evidence, though it would narrow every interval."""
    first, second = biased_logs(biases=(4.0, 1.0))
    copy = dr.Log.from_arrays(first.time, dict(first.signals), source="copy")
    with pytest.raises(
        dr.LogError, match=f"{first.source} and copy have the same time and samples; give each log once"
    ):
        call(vehicle(), [first, second, copy], "ols")
    with pytest.raises(dr.LogError, match=f"{second.source} is given twice"):
        call(vehicle(), [first, second, second], "ols")


# ---------------------------------------------------------------------- agreement


METHODS_THAT_COMPARE = ("ols", "i-diransac", "lo-diransac")


@pytest.mark.parametrize("method", METHODS_THAT_COMPARE)
def test_log_of_another_machine_is_named_and_no_other(method):
    logs = biased_logs(noise=0.01, biases=(4.0,) * 4, masses=(60.0, 60.0, 75.0, 60.0))
    result = dr.identify(builtin("underwater-vehicle"), logs, method, settings=settings_of(method))
    assert [bool(x.remark) for x in result.logs] == [False, False, True, False]
    assert "dive 2" in result.logs[2].remark
    assert "mass 7" in result.logs[2].remark
    assert any(x.startswith(result.logs[2].remark) for x in result.findings)


@pytest.mark.parametrize("method", METHODS_THAT_COMPARE)
def test_no_log_is_named_where_all_agree(method):
    logs = biased_logs(noise=0.01, biases=(4.0,) * 4)
    result = dr.identify(builtin("underwater-vehicle"), logs, method, settings=settings_of(method))
    assert [x.remark for x in result.logs] == [""] * 4
    assert not any("disagrees" in note for note in result.notes)


@pytest.mark.parametrize("method", METHODS_THAT_COMPARE)
def test_difference_in_a_per_log_parameter_is_no_disagreement(method):
    assert [x.remark for x in of_noisy_logs(method)[0].logs] == [""] * 3


@pytest.mark.parametrize("method", METHODS_THAT_COMPARE)
def test_of_two_logs_that_disagree_the_one_is_named_that_the_answer_is_not_of(method):
    logs = biased_logs(noise=0.01, biases=(4.0,) * 2, masses=(60.0, 75.0))
    result = dr.identify(builtin("underwater-vehicle"), logs, method, settings=settings_of(method))
    far = [abs(result.parameters["mass"] - mass) > 5.0 for mass in (60.0, 75.0)]
    assert any(far)
    assert all("mass" in x.remark for x, is_far in zip(result.logs, far, strict=True) if is_far)


def rubbing(k: int, mass: float) -> dr.Log:
    """A slider with dry friction that `SLIDER` lacks, pushed by gusts that it does not know."""
    rng, dt, n = np.random.default_rng([11, k]), 0.02, 900
    force = np.cumsum(rng.normal(size=n))
    force = 6.0 * (force - force.mean()) / np.abs(force).max() + 3.0 * np.sin(0.05 * np.arange(n))
    s, v, gust, found = 0.0, 0.0, 0.0, []
    for i in range(n):
        found.append((s, v))
        gust += 0.5 * rng.normal() - 0.2 * gust
        for _ in range(10):
            v += 0.1 * dt * (force[i] - 0.5 * v - 0.8 * np.tanh(50.0 * v) + 0.3 * gust) / mass
            s += 0.1 * dt * v
    s, v = np.array(found).T + rng.normal(size=(2, n)) * [[0.001], [0.005]]
    columns = {"s": s, "s_dot": v, "force": force}
    return dr.Log.from_arrays(dt * np.arange(n), columns, source=f"slide {k}")


def test_logs_of_a_machine_that_the_model_does_not_describe_agree_unless_one_has_another_mass():
    alike, other = (
        dr.identify(SLIDER, [rubbing(k, x) for k, x in enumerate(masses)], differentiate=True)
        for masses in ((2.0, 2.0, 2.0), (2.0, 4.0, 2.0))
    )
    assert [x.remark for x in alike.logs] == [""] * 3
    assert [bool(x.remark) for x in other.logs] == [False, True, False]
    assert "mass" in other.logs[1].remark


def test_logs_that_agree_are_named_once_in_a_thousand_at_most():
    """Forty sets of three clean logs under white noise in the input: none is named by chance."""
    named = 0
    for trial in range(40):
        rng, logs = np.random.default_rng([9, trial]), []
        for i in range(3):
            signals, inputs = sailed(4.0, STARTS[i])
            noisy = inputs + 5.0 * rng.normal(size=inputs.shape)
            logs.append(named_log(VEHICLE, signals, noisy, f"dive {i}"))
        result = dr.identify(builtin("underwater-vehicle"), logs, "ols", settings=dr.Settings(threads=1))
        named += any(x.remark for x in result.logs)
    assert named <= 1


# ---------------------------------------------------------------------- prediction


def test_validation_pools_the_errors_of_several_logs():
    plant = dr.Plant(builtin("underwater-vehicle"), dict(VEHICLE.truth) | {"mass": 66.0})
    logs = biased_logs(noise=0.01, biases=(4.0, 4.0))
    logs[1] = named_log(VEHICLE, *(x[:300] for x in sailed(4.0, STARTS[1])), "short dive")
    both = dr.validate(plant, logs, horizon=0.5)
    alone = [dr.validate(plant, log, horizon=0.5) for log in logs]
    for k in range(2):
        windows = [x.horizons[k].windows for x in alone]
        assert both.horizons[k].windows == sum(windows)
        whole = [OpenLoop(Dataset.of(plant.model, [x]), 0, plant.parameters, Resolution()).steps(np.inf) for x in logs]
        rows = [25 * n for n in windows] if k == 0 else whole
        for name in VEHICLE.signals:
            squares = [n * x.horizons[k].rmse[name] ** 2 for n, x in zip(rows, alone, strict=True)]
            assert both.horizons[k].rmse[name] == pytest.approx(math.sqrt(sum(squares) / sum(rows)), rel=1e-9)
    assert both.source == "dive 0, short dive"


def test_validation_predicts_with_the_integration_steps_that_fitted():
    """Dry friction: one step per sample and five differ."""
    machine = MACHINES["servo-axis"]
    signals, inputs = flight(machine, 400, 0.02, substeps=5)
    log = named_log(machine, signals, inputs, "axis")
    result = dr.identify(builtin("servo-axis"), log)
    plant = dr.Plant(result.model, result.parameters)
    as_fitted = dr.validate(result, log, 0.5).rmse
    assert as_fitted == dr.validate(plant, log, 0.5, substeps=5).rmse
    assert as_fitted != dr.validate(plant, log, 0.5).rmse
    assert dr.validate(result, log, 0.5, substeps=1).rmse == dr.validate(plant, log, 0.5).rmse
    euler = dr.identify(builtin("servo-axis"), log, "ols", settings=dr.Settings(integrator="euler", substeps=3))
    assert (
        dr.validate(euler, log).rmse
        == dr.validate(dr.Plant(euler.model, euler.parameters), log, integrator="euler", substeps=3).rmse
    )


def test_cross_validation_leaves_out_one_log_at_a_time():
    model, logs = builtin("underwater-vehicle"), biased_logs(noise=0.02, biases=(4.0,) * 3)
    found = dr.cross_validate(model, logs, "ols", horizon=0.5)
    assert found.sources == ("dive 0", "dive 1", "dive 2")
    for i, log in enumerate(logs):
        others = dr.identify(model, [x for x in logs if x is not log], "ols")
        assert found.results[i] == others
        assert found.validations[i].to_dict() == dr.validate(others, log, 0.5).to_dict()
    middle = np.median([x.rmse["x_dot"] for x in found.validations])
    assert found.rmse["x_dot"] == pytest.approx(middle)
    assert len(found.to_dict()["folds"]) == 3
    assert [line.split()[0] for line in str(found).splitlines()[1:]] == ["dive"] * 3


def test_cross_validation_needs_two_logs():
    with pytest.raises(SettingsError, match="at least two logs"):
        dr.cross_validate(builtin("underwater-vehicle"), biased_logs(biases=(4.0,)))


def test_cross_validation_says_why_a_fold_has_no_answer():
    still = dr.Log.from_arrays(
        DT * np.arange(200), dict.fromkeys((*VEHICLE.signals, "thrust"), np.zeros(200)), source="at rest"
    )
    found = dr.cross_validate(builtin("underwater-vehicle"), [*biased_logs(biases=(4.0,)), still], "ols")
    assert isinstance(found.results[0], str)
    assert "at rest" in found.results[0]
    assert found.validations[0] == "no model of the other logs"
    assert found.rmse["x_dot"] == np.inf
    assert found.to_dict()["rmse"]["x_dot"] is None


# ---------------------------------------------------------------------- logs that differ


@pytest.mark.parametrize("method", ["ols", "tls", "nls", "diransac", "i-diransac"])
def test_logs_of_different_rates_serve_methods_that_need_no_common_one(method):
    fast, inputs = flight(VEHICLE, 600, 0.01)
    slow, slow_inputs = flight(replace(VEHICLE, start=STARTS[1]), 400, 0.025)
    logs = [named_log(VEHICLE, fast, inputs, "fast", 0.01), named_log(VEHICLE, slow, slow_inputs, "slow", 0.025)]
    result = dr.identify(builtin("underwater-vehicle"), logs, method, settings=settings_of(method))
    assert result.parameters == pytest.approx(VEHICLE.truth, rel=1e-6)
    assert result.inliers.all()
    assert [x.dt for x in result.logs] == pytest.approx([0.01, 0.025])


def test_logs_of_different_rates_are_refused_where_one_is_needed():
    logs = [
        named_log(VEHICLE, *sailed(4.0, STARTS[0]), "fast", DT),
        named_log(VEHICLE, *sailed(4.0, STARTS[1]), "slow", 2 * DT),
    ]
    with pytest.raises(LogError, match=r"fast is sampled at 50 Hz, slow at 25 Hz; resample") as caught:
        dr.identify(builtin("underwater-vehicle"), logs)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize("method", dr.METHODS)
def test_signal_that_one_log_lacks_and_no_equation_names_may_be_missing(method):
    logs = biased_logs(biases=(4.0,) * 3)
    logs[1] = named_log(VEHICLE, *sailed(4.0, STARTS[1]), "dive 1", without=("x",))
    result = dr.identify(builtin("underwater-vehicle"), logs, method, settings=settings_of(method))
    assert result.parameters == pytest.approx(VEHICLE.truth, rel=1e-3)
    assert result.inliers.all()
    assert [x.remark for x in result.logs] == [""] * 3


@pytest.mark.parametrize("lacking", [("x_ddot",), ("x_dot", "x_ddot"), ("x", "x_ddot")])
def test_lo_diransac_estimates_what_one_of_its_logs_lacks(lacking):
    logs = biased_logs(noise=0.002, biases=(4.0,) * 3)
    logs[1] = named_log(VEHICLE, *sailed(4.0, STARTS[1]), "dive 1", without=lacking)
    result = dr.identify(builtin("underwater-vehicle"), logs, differentiate=True)
    assert result.parameters == pytest.approx(VEHICLE.truth, rel=0.02)
    assert not result.diagnosis.outliers[lacking[0]][500:1000].any()


@pytest.mark.parametrize("method", ["ols", "i-diransac"])
def test_signal_of_the_equations_that_one_log_lacks_is_named_with_its_log(method):
    logs = biased_logs(biases=(4.0,) * 2)
    logs[1] = named_log(VEHICLE, *sailed(4.0, STARTS[1]), "dive 1", without=("x_ddot",))
    with pytest.raises(LogError, match='dive 1: signal "x_ddot" is missing'):
        dr.identify(builtin("underwater-vehicle"), logs, method)


def test_setting_that_names_a_signal_that_one_log_lacks_is_refused_with_its_name():
    logs = biased_logs(biases=(4.0,) * 2)
    logs[1] = named_log(VEHICLE, *sailed(4.0, STARTS[1]), "dive 1", without=("x",))
    settings = dr.Settings(error_weights={"x": 1.0})
    with pytest.raises(SettingsError, match='dive 1: a setting names "x", which the log lacks'):
        dr.identify(builtin("underwater-vehicle"), logs, "ols", settings=settings)


@pytest.mark.parametrize("method", ["ols", "i-diransac"])
def test_velocities_and_accelerations_of_several_logs_are_derived(method):
    without = ("x_dot", "x_ddot")
    logs = [
        named_log(VEHICLE, *sailed(4.0, STARTS[0], 1500, 0.01), "long", 0.01, without),
        named_log(VEHICLE, *sailed(4.0, STARTS[1], 800, 0.01), "short", 0.01, without),
    ]
    result = dr.identify(builtin("underwater-vehicle"), logs, method, settings=settings_of(method), differentiate=True)
    assert result.parameters == pytest.approx(VEHICLE.truth, rel=0.1)
    assert len(result.inliers) == 2300
    assert set(result.bandwidth_sensitivity) == set(result.parameters)


def test_logs_with_and_without_derivatives_are_differentiated_alike():
    logs = biased_logs(biases=(4.0,) * 2)
    logs[1] = named_log(VEHICLE, *sailed(4.0, STARTS[1]), "dive 1", without=("x_ddot",))
    result = dr.identify(builtin("underwater-vehicle"), logs, "ols", differentiate=True)
    assert result.parameters == pytest.approx(VEHICLE.truth, rel=0.1)


def test_dataset_of_some_of_the_logs_is_the_dataset_of_those():
    logs = biased_logs(biases=(4.0,) * 3)
    logs[1] = named_log(VEHICLE, *sailed(4.0, STARTS[1]), "dive 1", without=("x",))
    whole = Dataset.of(vehicle(), logs)
    assert whole.common_signals == ("x_dot", "x_ddot")
    some, alone = whole.subset([1]), Dataset.of(vehicle(), logs[1])
    assert some.signals == alone.signals == ("x_dot", "x_ddot")
    assert some.layout.names == alone.layout.names
    assert np.array_equal(some.segments[0].measured, alone.segments[0].measured)


def test_rows_before_the_first_whole_one_are_no_inliers_of_their_log():
    logs = []
    for i in range(2):
        signals, inputs = (x.copy() for x in sailed(4.0, STARTS[i]))
        signals[: 3 + 4 * i, 1] = np.nan
        logs.append(named_log(VEHICLE, signals, inputs, f"dive {i}"))
    result = dr.identify(builtin("underwater-vehicle"), logs, "ols")
    assert np.flatnonzero(~result.inliers).tolist() == [0, 1, 2, *range(500, 507)]
    assert result.inlier_fraction == 1.0
    assert any(note.startswith("dive 1: 7 of 500 rows were skipped") for note in result.notes)


def test_scale_of_a_signal_is_its_spread_over_all_logs():
    """Two logs that rest at different speeds move together."""
    rng = np.random.default_rng(0)
    rest = {"x_ddot": np.zeros(1000), "thrust": np.ones(1000)}
    speeds = [at + 1e-3 * rng.normal(size=1000) for at in (-1.0, 1.0)]
    logs = [dr.Log.from_arrays(DT * np.arange(1000), {"x_dot": speed} | rest) for speed in speeds]
    assert Dataset.of(vehicle(), logs).scales["x_dot"] == pytest.approx(1.48, rel=0.1)


# ---------------------------------------------------------------------- progress


@pytest.mark.parametrize("method", dr.METHODS)
def test_progress_never_falls_and_ends_at_one(method):
    fractions = [x.fraction for x in of_noisy_logs(method)[1]]
    assert fractions == sorted(fractions)
    assert fractions[0] >= 0.0
    assert fractions[-1] == 1.0


# ---------------------------------------------------------------------- logs of very different length


def sliding(seed, n_rows, bias, delay=0):
    """A log of a mass with drag, whose force sensor has a bias of its own."""
    t = 0.01 * np.arange(n_rows)
    rng = np.random.default_rng(seed)
    force = 3.0 * np.sin(2.1 * t + rng.uniform(0, 6)) + 2.0 * np.sin(5.3 * t + rng.uniform(0, 6))
    batch = RolloutBatch([[2.0, 0.5, bias]], np.zeros(2), force[:, None], 0.01)
    x, v, a = rollouts(SLIDER, substeps=5).trajectories(batch)[0].T
    noise = rng.normal(size=(3, n_rows)) * np.array([[1e-3], [1e-2], [3e-2]])
    signals = dict(zip(("s", "s_dot", "s_ddot"), np.array([x, v, a]) + noise, strict=True))
    return dr.Log.from_arrays(t, {**signals, "force": np.roll(force, -delay)}, source=f"slide {seed}")


SLIDER = dr.Model(
    "slider",
    {"s": "m"},
    {"force": "N"},
    {"mass": dr.Parameter("kg", positive=True), "drag": dr.Parameter("N s/m"), "bias": dr.Parameter("N", per_log=True)},
    lambda q, v, a, u, p: [p.mass * a.s + p.drag * v.s - u.force - p.bias],
)


@pytest.mark.parametrize("method", ["ols", "i-diransac"])
def test_short_logs_beside_a_long_one_leave_intervals_finite(method):
    logs = [sliding(0, 4000, 0.3), *(sliding(k, 300, 0.1 * k) for k in (1, 2, 3))]
    settings = dr.Settings(sample_size=400, max_iterations=20) if method == "i-diransac" else None
    result = dr.identify(SLIDER, logs, method, settings=settings)
    assert np.isfinite(list(result.standard_errors.values())).all()
    assert np.isfinite(result.per_log_standard_errors["bias"]).all()
    assert result.per_log["bias"] == pytest.approx([0.3, 0.1, 0.2, 0.3], abs=0.05)


def test_where_a_log_begins_is_no_noise():
    """A coordinate that begins 1 km further away has the same noise, and the same answer."""
    near = [sliding(k, 800, 0.0) for k in range(2)]
    far = dr.Log.from_arrays(near[1].time, {**near[1].signals, "s": near[1]["s"] + 1000.0}, source="far")
    found, moved = (dr.identify(SLIDER, logs) for logs in (near, [near[0], far]))
    assert moved.parameters["mass"] == pytest.approx(found.parameters["mass"], rel=1e-3)
    assert moved.diagnosis.noise_std["s"] == pytest.approx(found.diagnosis.noise_std["s"], rel=0.1)


def test_a_log_whose_inputs_act_at_another_time_is_named():
    logs = [sliding(k, 800, 0.0) for k in range(2)] + [sliding(3, 800, 0.0, delay=6)]
    result = dr.identify(SLIDER, logs)
    assert "input delay" in result.logs[2].remark
    assert [bool(x.remark) for x in result.logs] == [False, False, True]


def test_estimates_of_logs_are_those_of_each_identified_alone():
    logs = [sliding(0, 800, 0.2), sliding(1, 600, 0.0), sliding(2, 1000, -0.1)]
    method, dataset = dr.LoDiransac(), Dataset.of(SLIDER, logs)
    method.fit(dataset, 0)
    for own, log in zip(method.estimates_of_logs(dataset, 0), logs, strict=True):
        alone = dr.identify(SLIDER, log)
        for name, error in alone.standard_errors.items():
            assert own.parameters[name] == pytest.approx(alone.parameters[name], abs=0.3 * error)
            assert own.standard_errors[name] == pytest.approx(error, rel=0.3)


def test_a_dataset_keeps_the_last_value_of_a_key():
    dataset = Dataset.of(SLIDER, [sliding(0, 400, 0.0)])
    dataset.keep("key", 1)
    dataset.keep("key", 2)
    assert dataset.kept("key", int) == 2


def test_a_log_that_is_too_short_to_be_compared_is_named():
    logs = [sliding(0, 800, 0.0), sliding(1, 800, 0.0), sliding(2, 40, 0.0)]
    result = dr.identify(SLIDER, logs)
    assert any(note.startswith("slide 2 could not be compared with the other logs") for note in result.notes)


def test_json_has_parameters_by_their_names_and_those_of_every_log():
    result = dr.identify(SLIDER, [sliding(0, 600, 0.3), sliding(1, 600, 0.1)], "ols")
    data = result.to_dict()
    assert list(data["parameters"]) == list(data["standard_errors"]) == ["mass", "drag", "bias"]
    assert data["per_log"]["bias"] == list(result.per_log["bias"])
    assert dr.Result.from_dict(data) == result


def test_a_derived_log_has_the_per_log_values_of_the_log_that_it_comes_from():
    bare = [
        dr.Log.from_arrays(log.time, {n: log[n] for n in ("s", "force")}, source=log.source)
        for log in (sliding(0, 1500, 0.3), sliding(1, 1500, 0.1))
    ]
    result = dr.identify(SLIDER, bare, "ols", differentiate=True)
    derived = dr.differentiate(bare[0], SLIDER)
    assert result.parameters_in(derived) == result.parameters_in(bare[0])
    assert result.parameters_in(bare[0])["bias"] == result.per_log["bias"][0]
    with pytest.raises(SettingsError, match=r"log is 0; give a dr.Log \(result.per_log has the parameters by index\)"):
        result.parameters_in(0)
