"""The benchmark of real records: its simulations, judge, output error and tables."""

import json

import numpy as np
import pytest
import real
import real_records as records
import real_robots as robots
import real_simulation as simulation
from real_simulation import Inputs, Motion

import diransac as dr

RNG = np.random.default_rng(0)
AXIS = np.array([90.0, 200.0, 15.0, -3.0])
MACHINES = {
    "pendulum": (dr.models.double_pendulum(upper_length=0.2), records.double_pendulum(0.2)),
    "axis": (dr.models.servo_axis(), records.servo_axis),
    "silverbox": (records.silverbox_model(with_offset=True), records.oscillator),
}


def moved_axis(n=1500, dt=0.002):
    """A motion of the axis without noise, and its simulator."""
    t = dt * np.arange(n)
    u = (150.0 * np.sin(5.0 * t) + 80.0 * np.sin(13.0 * t))[:, None]
    simulator = simulation.Simulator(records.servo_axis)
    x = simulator(AXIS[:, None], np.zeros((2, 1)), Inputs().between(u, dt, 2), np.array([0]), n - 1, dt)
    return Motion(x[:, :1, 0], u, dt), simulator


@pytest.mark.parametrize("name", MACHINES)
def test_rates_are_those_of_the_models_equations(name):
    model, rates = MACHINES[name]
    q, v, u = (RNG.normal(size=(n, 7)) for n in (model.n_q, model.n_v, model.n_u))
    p = np.repeat(RNG.uniform(0.5, 1.5, (model.n_p, 1)), 7, axis=1)
    x = np.concatenate([q, v])
    np.testing.assert_allclose(rates(x, u, p), np.array(model.dynamics.map(7)(x, u, p)[0]), rtol=1e-9)


def test_the_judge_finds_no_error_of_true_parameters_and_some_of_others():
    log, simulator = moved_axis()
    windows = simulation.Windows(simulator, [log], np.std(log.y, axis=0), (0.1, 0.3), 5)
    right, wrong = (simulation.overall(windows(AXIS * [x, 1, 1, 1], Inputs())) for x in (1.0, 1.05))
    assert right < 1e-3 * simulation.overall(windows.at_rest())
    assert wrong > 20.0 * right


def test_output_error_finds_parameters_and_hold_from_positions(monkeypatch):
    monkeypatch.setattr(simulation, "STARTS", 2)
    log, simulator = moved_axis(600)
    low = records.low_bounds(dr.models.servo_axis())
    problem = simulation.OutputError(simulator, [log], low, np.std(log.y, axis=0), 0.5, 5)
    values, inputs = problem(np.array([100.0, 100.0, 10.0, -1.0]), None)
    np.testing.assert_allclose(values, AXIS, rtol=1e-3)
    assert inputs.hold == "zero-order"


def test_a_robust_error_leaves_out_one_window_in_twenty():
    errors = np.ones((10, 2, 40))
    errors[:, 0, :2] = 1e9
    np.testing.assert_allclose(simulation.robust_errors(errors, np.array([1.0, 2.0])), [1.0, 0.5])
    errors[:, 0, :4] = np.inf
    assert 1.0 < simulation.robust_errors(errors, np.ones(2))[0] < simulation.CAP


def test_inputs_are_held_delayed_interpolated_and_lagged():
    u, dt = np.arange(6.0)[:, None], 0.1
    np.testing.assert_allclose(Inputs().between(u, dt, 1)[2, :, 0], [2, 2, 2], atol=1e-6)
    np.testing.assert_allclose(Inputs(delay=0.15).between(u, dt, 1)[2, :, 0], [0, 1, 1], atol=1e-6)
    for hold in ("linear", "smooth"):
        np.testing.assert_allclose(Inputs(hold).between(u, dt, 1)[2, :, 0], [2, 2.5, 3], atol=1e-6)
    step = np.repeat([[0.0], [1.0]], [1, 5], axis=0)
    lagged = Inputs(lag=0.2).between(step, dt, 1)[:, 0, 0]
    np.testing.assert_allclose(lagged[1:], 1.0 - np.exp(-dt / 0.2 * np.arange(4)), atol=1e-9)


def test_the_accelerometer_of_a_constant_thrust_shows_it():
    log = dr.Log.from_arrays(0.01 * np.arange(50), {name: np.full(50, 0.6) for name in robots.MOTORS})
    expected = 4.0 * (0.1 * 0.6 + 0.05 * 0.36) / robots.MASS
    np.testing.assert_allclose(robots.reading(log, 0.1, 0.05, 0.06, Inputs()), expected)


def row(record, method, error, **more):
    return {"record": record, "method": method, "error": error, "unit": "mV", "verdict": "", "seconds": 1.0, **more}


def test_measured_rows_replace_earlier_ones_and_ratios_refer_to_the_best_other():
    earlier = [row("a", "default", 9.0), row("a", "ols", 2.0), row("a", "published", 0.1), row("b", "nls", 1.0)]
    rows = real.joined([row("a", "default", 4.0), row("b", "default", 0.5)], earlier, ["a", "b"])
    assert [one["error"] for one in rows] == [4.0, 2.0, 0.1, 0.5, 1.0]
    assert real.ratio(rows, "a") == (2.0, "ols")
    assert "2 records: geometric mean 1.00, worst 2.00 (a)" in real.summary(rows)


def test_a_refusal_has_the_score_of_no_model():
    model = dr.models.servo_axis()
    still = dr.Log.from_arrays(0.01 * np.arange(500), {"position": np.zeros(500), "force": np.zeros(500)})
    record = records.Record("still", model, [still], lambda p, inputs: None, records.Score(3.0, {}))
    (found,) = real.rows_of(record, ["ols"])
    assert found["error"] == 3.0
    assert found["verdict"].startswith("refused: ")
    assert "still" in real.table([{**found, "published": {}}])


def test_a_missing_folder_is_named_in_one_sentence(tmp_path):
    with pytest.raises(SystemExit, match="is missing: name it by --data"):
        real.main(["--data", str(tmp_path / "none")])
    with pytest.raises(SystemExit, match="no record begins so"):
        real.main(["--only", "nothing"])


def test_published_parameters_of_the_axis_predict_its_second_half(shared_data, tmp_path, capsys):
    out = tmp_path / "rows.jsonl"
    real.main(["--data", str(shared_data), "--only", "emps", "--methods", "ols,published", "--out", str(out)])
    rows = [json.loads(line) for line in out.read_text("utf-8").splitlines()]
    assert [one["method"] for one in rows] == ["ols", "published"]
    assert all(one["error"] < 0.05 * one["no_model"] for one in rows)
    assert "| mass | 95.11 |" in capsys.readouterr().out


def test_training_and_held_out_logs_of_every_machine_are_read(shared_data):
    found = {name: make(shared_data) for name, make in real.RECORDS.items() if not name.startswith("go2")}
    assert all(one.name == name for name, one in found.items())
    assert [name for name, one in found.items() if one.judge is None] == [
        "px4-log_small",
        "px4-appended_multiple",
        "px4-roll",
    ]


@pytest.mark.skipif(not (real.DATA / "silverbox").is_dir(), reason=f"the real records are not in {real.DATA}")
def test_the_terms_that_silverbox_lacks_are_suggested_and_added():
    """A constant and a quadratic spring, by which the simulated arrow comes to a tenth of the error."""
    bare, full = (records.RECORDS[name](real.DATA) for name in ("silverbox", "silverbox-offset"))
    found = dr.identify(bare.model, bare.train[0], differentiate=True, with_suggestions=True)
    parameters = dict(found.parameters) | {"c": found.parameters["bias_y"]}
    parameters["k2"] = found.parameters["quadratic_stiffness_y"]
    resolution = found.estimate.resolution
    assert full.judge(parameters, Inputs(resolution.hold)).error < 1.0  # mV
