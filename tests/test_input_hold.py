"""Identification under inputs that are interpolated between samples: a pendulum at 20 Hz under a continuous torque."""

import json
import re
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import odeint

import diransac as dr
from command_line import run
from diransac.data.dataset import Dataset, ParameterLayout
from diransac.errors import SettingsError
from diransac.identification.core.windows import Windows
from diransac.identification.diagnosis import Resolution
from diransac.model import Model, Parameter
from diransac.simulation import RolloutBatch, rollouts

TRUE = {"inertia": 0.5, "damping": 0.4, "weight": 4.0}
PENDULUM = Model(
    "torque-pendulum",
    {"angle": "rad"},
    {"torque": "N m"},
    {
        "inertia": Parameter("kg m^2", positive=True),
        "damping": Parameter("N m s", lower=0.0),
        "weight": Parameter("N m"),
    },
    lambda q, v, a, u, p: [p.inertia * a.angle + p.damping * v.angle + p.weight * ca.sin(q.angle) - u.torque],
)
METHODS = ["ols", "i-diransac", "lo-diransac"]
EVERY_METHOD = pytest.mark.parametrize("method", METHODS)


def torque(t, phase=0.0):
    return 1.2 * np.sin(2.1 * t + phase) + 0.9 * np.sin(5.3 * t + 1.0) + 0.6 * np.sin(7.9 * t)


def pendulum_log(phase=0.0, duration=30.0, noise=1e-3):
    """A log at 20 Hz of the pendulum under the torque at every instant."""
    t = np.arange(0.0, duration, 0.05)

    def acceleration(t, x):
        return (torque(t, phase) - TRUE["damping"] * x[1] - TRUE["weight"] * np.sin(x[0])) / TRUE["inertia"]

    path = odeint(lambda x, t: [x[1], acceleration(t, x)], [0.2, 0.0], t, rtol=1e-11, atol=1e-12).T
    signals = {"angle": path[0], "angle_dot": path[1], "angle_ddot": acceleration(t, path)}
    rng = np.random.default_rng(0)
    noisy = {name: x + noise * rng.standard_normal(len(t)) for name, x in signals.items()}
    return dr.Log.from_arrays(t, {**noisy, "torque": torque(t, phase)}, source=f"phase {phase:g}")


LOG, OTHER = pendulum_log(), pendulum_log(2.0)


@pytest.fixture(scope="module")
def found():
    """Results by method and hold."""
    return {
        (method, hold): dr.identify(PENDULUM, LOG, method, input_hold=hold)
        for method in METHODS
        for hold in ("zero-order", "linear", "smooth")
    }


# Accuracy ------------------------------------------------------------------------------------------------------------
@EVERY_METHOD
def test_interpolated_inputs_predict_a_continuous_motion_better(found, method):
    held, interpolated = (found[method, hold] for hold in ("zero-order", "linear"))
    errors = [dr.validate(result, OTHER).rmse["angle"] for result in (held, interpolated)]
    if method == "lo-diransac":  # which takes the half sample out as a delay, with either hold
        assert max(errors) < 0.003
    else:
        assert interpolated.fit_error < 0.1 * held.fit_error
        assert errors[1] < 0.1 * errors[0]


def largest_error(result):
    return max(abs(x / TRUE[name] - 1.0) for name, x in result.parameters.items())


@pytest.mark.parametrize(("hold", "error"), [("linear", 0.003), ("smooth", 0.0005)])
def test_lo_diransac_finds_the_parameters_of_a_continuous_motion_without_a_delay(found, hold, error):
    assert largest_error(found["lo-diransac", hold]) < error
    assert abs(found["lo-diransac", hold].diagnosis.input_delay) < 0.001


def test_lo_diransac_finds_half_a_sample_of_delay_where_continuous_inputs_are_held(found):
    held = found["lo-diransac", "zero-order"]
    assert held.diagnosis.input_delay == pytest.approx(-0.5 * LOG.dt, abs=0.001)
    assert largest_error(found["lo-diransac", "linear"]) < largest_error(held) < 0.01


def test_lo_diransac_interpolates_continuous_inputs_where_no_hold_is_requested():
    result = dr.identify(PENDULUM, LOG)
    assert result.estimate.resolution.hold == "smooth"
    assert abs(result.diagnosis.input_delay) < 0.001
    assert largest_error(result) < 0.0005
    assert "Inputs that vary smoothly between samples" in " ".join(map(str, result.findings))


def test_least_squares_of_the_equations_do_not_depend_on_the_hold(found):
    assert found["ols", "linear"].parameters == found["ols", "zero-order"].parameters


# One hold from the request to every simulation -----------------------------------------------------------------------
@EVERY_METHOD
def test_the_evaluation_is_a_simulation_under_the_hold_of_the_fit(found, method):
    result = found[method, "linear"]
    resolution = result.estimate.resolution
    assert resolution.hold == "linear"
    engine = rollouts(PENDULUM, substeps=resolution.substeps, hold="linear")
    start = [LOG["angle"][0], LOG["angle_dot"][0]]
    batch = RolloutBatch([list(result.parameters.values())], start, LOG["torque"][:, None], LOG.dt)
    (path,) = engine.trajectories(batch)
    whole = dr.validate(result, LOG, start="measured").rmse
    expected = np.sqrt(np.mean(np.square(path[1:, 0] - LOG["angle"][1:])))
    assert whole["angle"] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("method", ["ols", "i-diransac"])
def test_no_request_is_a_zero_order_hold_except_for_lo_diransac(found, method):
    assert dr.identify(PENDULUM, LOG, method) == found[method, "zero-order"]


def test_hypotheses_of_a_search_are_simulated_under_the_hold(found):
    """The search ends at the first consensus within thresholds that no simulation under held inputs satisfies."""
    thresholds = {"angle": 0.01, "angle_dot": 0.03}
    settings = dr.Settings(inlier_thresholds=thresholds, min_inlier_signals=2, max_iterations=20, sample_size=30)
    held, interpolated = (
        dr.identify(PENDULUM, LOG, "i-diransac", settings=settings, input_hold=hold)
        for hold in ("zero-order", "linear")
    )
    assert (held.iterations, interpolated.iterations) == (20, 1)
    assert held.inlier_fraction < 0.5 < 0.99 < interpolated.inlier_fraction


def test_validation_takes_the_hold_of_a_result_or_the_one_that_is_given(found):
    result, plant = found["ols", "linear"], dr.Plant(PENDULUM, found["ols", "linear"].parameters)
    assert dr.validate(result, LOG).rmse == dr.validate(plant, LOG, input_hold="linear").rmse
    assert dr.validate(result, LOG, input_hold="zero-order").rmse == dr.validate(plant, LOG).rmse
    assert dr.validate(plant, LOG).rmse != dr.validate(result, LOG).rmse


def test_cross_validation_predicts_under_the_hold_of_the_identification():
    holds, logs = (None, "linear"), [LOG, OTHER]
    rmse = [dr.cross_validate(PENDULUM, logs, "ols", input_hold=hold).rmse["angle"] for hold in holds]
    assert rmse[1] < 0.1 * rmse[0]


def test_a_subset_of_the_logs_has_the_request_of_the_whole():
    dataset = Dataset.of(PENDULUM, [LOG, OTHER], input_hold="linear")
    assert dataset.subset([1]).hold == dataset.hold == "linear"
    assert Dataset.of(PENDULUM, LOG).hold == "zero-order"


@pytest.mark.parametrize("hold", ["linear", "smooth"])
@pytest.mark.parametrize("length", [20, 23])
def test_shooting_intervals_of_a_log_do_not_depend_on_the_next_log(length, hold):
    logs = [
        (np.column_stack([log[n] for n in PENDULUM.signals]), np.ones((200, 3), bool), log["torque"][:, None])
        for log in (pendulum_log(phase, 10.0) for phase in (0.0, 2.0))
    ]
    both = _intervals(logs, length, hold)
    shared = np.append(list(TRUE.values()), np.zeros(both.n_shared - 3))
    x, d = both.measured[both.starts, :2], np.zeros((len(both), 1))
    residuals, ends = both.simulated(shared, x, d)
    for i, rows in enumerate(both.rows_of_logs):
        alone = _intervals(logs[i : i + 1], length, hold)
        own = both.log_of == i
        residuals_alone, ends_alone = alone.simulated(shared, x[own], d[own])
        np.testing.assert_array_equal(residuals[rows], residuals_alone)
        np.testing.assert_array_equal(ends[own][:-1], ends_alone[:-1])


def _intervals(logs, length, hold):
    layout = ParameterLayout(PENDULUM.parameters, len(logs))
    logs = [(*log, np.zeros(len(log[-1]), bool)) for log in logs]
    return Windows.of(PENDULUM, layout, logs, 0.05, length, 5, hold)


# Results -------------------------------------------------------------------------------------------------------------
@EVERY_METHOD
def test_a_result_keeps_its_hold_in_json(found, method, tmp_path):
    result = found[method, "linear"]
    result.save(tmp_path / "model.json")
    again = dr.Result.load(tmp_path / "model.json")
    assert again == result
    assert again.estimate.resolution == Resolution("rk4", result.estimate.resolution.substeps, "linear")
    assert dr.validate(again, LOG).rmse == dr.validate(result, LOG).rmse


def test_a_result_without_a_hold_in_its_json_was_simulated_with_a_zero_order_hold(found):
    data = found["ols", "zero-order"].to_dict()
    del data["resolution"]["hold"]
    assert dr.Result.from_dict(json.loads(json.dumps(data))) == found["ols", "zero-order"]


@EVERY_METHOD
def test_a_printed_result_names_interpolated_inputs(found, method):
    assert "inputs interpolated linearly" in str(found[method, "linear"])
    assert "inputs interpolated smoothly" in str(found[method, "smooth"])
    assert "interpolated" not in str(found[method, "zero-order"])


def test_a_report_simulates_under_the_hold_and_shows_it(found, tmp_path):
    from diransac.report.runs import simulate_on

    result = found["ols", "linear"]
    run_of = {hold: simulate_on("it", replace_hold(result, hold), LOG, None) for hold in ("zero-order", "linear")}
    rms = {hold: np.sqrt(np.mean(np.square(one.errors[:, 0]))) for hold, one in run_of.items()}
    assert rms["linear"] == pytest.approx(dr.validate(result, LOG, start="measured").rmse["angle"], rel=0.01)
    assert rms["linear"] < 0.1 * rms["zero-order"]
    dr.write_report(result, LOG, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert re.search(r"input hold</th><td>(<strong>)?linear", page)


def replace_hold(result, hold):
    resolution = replace(result.estimate.resolution, hold=hold)
    return replace(result, estimate=replace(result.estimate, resolution=resolution))


# Refusals, and the command line --------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["cubic", "", 1, ["linear"]])
def test_an_unknown_hold_is_refused_by_name(name):
    message = "input_hold is .*; choose zero-order, linear, smooth, or None"
    with pytest.raises(SettingsError, match=message):
        dr.identify(PENDULUM, LOG, "ols", input_hold=name)
    with pytest.raises(SettingsError, match=message):
        dr.validate(dr.Plant(PENDULUM, TRUE), LOG, input_hold=name)
    with pytest.raises(SettingsError, match=message):
        dr.cross_validate(PENDULUM, [LOG, OTHER], "ols", input_hold=name)


MODEL_FILE = """
import casadi as ca
from diransac import Model, Parameter
model = Model(
    "torque-pendulum", {"angle": "rad"}, {"torque": "N m"},
    {name: Parameter() for name in ("inertia", "damping", "weight")},
    lambda q, v, a, u, p: [p.inertia * a.angle + p.damping * v.angle + p.weight * ca.sin(q.angle) - u.torque],
)
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pendulum.py").write_text(MODEL_FILE)
    LOG.write("a.csv")
    OTHER.write("b.csv")
    return tmp_path


def test_commands_identify_under_the_named_hold(folder):
    options = ["--model", "pendulum.py", "--input-hold", "linear"]
    done = run("identify", "a.csv", *options, "--method", "ols", "-o", "model.json")
    assert done.exit_code == 0, done.stderr
    assert "inputs interpolated linearly" in done.stdout
    assert dr.Result.load("model.json").estimate.resolution.hold == "linear"
    assert "ols: inputs interpolated linearly" in run("compare", "a.csv", *options, "--methods", "ols").stdout
    folds = [
        json.loads(run("cross-validate", "a.csv", "b.csv", *words, "--method", "ols", "--json").stdout)
        for words in (options, options[:2])
    ]
    assert folds[0]["rmse"]["angle"] < 0.1 * folds[1]["rmse"]["angle"]


@pytest.mark.parametrize("command", ["identify", "compare", "cross-validate"])
def test_a_command_refuses_an_unknown_hold_as_wrong_usage(folder, command):
    before = set(folder.iterdir())
    done = run(command, "a.csv", "b.csv", "--model", "pendulum.py", "--input-hold", "cubic")
    assert done.exit_code == 2
    assert "there is no hold 'cubic'; there are zero-order, linear" in done.stderr
    assert set(folder.iterdir()) == before
