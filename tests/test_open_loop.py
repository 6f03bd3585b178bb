"""`dr.simulate` and `diransac predict`: against a plain Runge-Kutta simulation, restarts, refusals, files."""

import numpy as np
import pytest

import diransac as dr
from command_line import run
from diransac.data.input_timing import InputTiming
from diransac.errors import LogError, ResultError, SettingsError
from diransac.identification.diagnosis import Resolution
from results import changed
from simulated import MACHINES, as_log, flight

MACHINE, DT = MACHINES["planar-rotorcraft"], 0.02
STATE = ("x", "z", "theta", "x_dot", "z_dot", "theta_dot")


@pytest.fixture(scope="module")
def log():
    return as_log(MACHINE, *flight(MACHINE, 150, DT), DT)


@pytest.fixture(scope="module")
def result(log):
    return dr.identify(dr.models.planar_rotorcraft(), log, "ols")


@pytest.fixture
def plant():
    return dr.Plant(dr.models.planar_rotorcraft(), MACHINE.truth)


def inputs_alone(log):
    return dr.Log.from_arrays(log.time, {n: log[n] for n in MACHINE.inputs})


def differences(simulated, log, rows=slice(None)):
    return max(float(np.abs(simulated[n] - log[n])[rows].max()) for n in STATE)


def test_simulation_from_the_first_state_is_the_flight(plant, log):
    simulated = dr.simulate(plant, log)
    assert differences(simulated, log) < 1e-9
    assert np.array_equal(simulated["thrust"], log["thrust"])
    assert simulated.units["x_dot"] == "m/s"
    assert simulated.notes[-1] == "simulated from 1 start, inputs held"


def test_inputs_alone_are_enough_with_an_initial_state(plant, log):
    start = {n: float(log[n][0]) for n in STATE}
    simulated = dr.simulate(plant, inputs_alone(log), initial_state=start)
    assert differences(simulated, log) < 1e-9
    moved = dr.simulate(plant, log, initial_state={"x": start["x"] + 2.0})
    assert moved["x"] - log["x"] == pytest.approx(2.0, abs=1e-9)
    with pytest.raises(LogError, match="no initial value of z, theta, x_dot, z_dot, theta_dot; give it"):
        dr.simulate(plant, inputs_alone(log), initial_state={"x": 0.0})


def test_restarts_keep_the_errors_of_a_wrong_model_small_and_pass_over_outliers(log):
    wrong = dr.Plant(dr.models.planar_rotorcraft(), {**MACHINE.truth, "mass": 1.02 * MACHINE.truth["mass"]})
    whole, restarted = dr.simulate(wrong, log), dr.simulate(wrong, log, horizon=0.2)
    assert differences(restarted, log) < 0.1 * differences(whole, log)
    assert restarted.notes[-1] == "simulated from 15 starts, every 0.2 s, inputs held"
    signals = {n: log[n].copy() for n in log.names}
    signals["z"][20] += 50.0
    hit = dr.simulate(wrong, dr.Log.from_arrays(log.time, signals), horizon=0.2)
    assert np.abs(hit["z"] - restarted["z"]).max() < 0.05


def test_a_simulation_begins_again_after_a_gap(plant, log):
    signals = {n: np.where((log.time > 1.0) & (log.time < 1.6), np.nan, log[n]) for n in log.names}
    simulated = dr.simulate(plant, dr.Log.from_arrays(log.time, signals))
    gap = np.isnan(simulated["x"])
    assert 25 <= gap.sum() <= 31
    assert differences(simulated, log, log.time <= 1.0) < 1e-9
    assert differences(simulated, log, ~gap) < 0.05


def test_delay_and_hold_of_the_identification_are_applied(result, log):
    late = changed(result, resolution=Resolution(timing=InputTiming(delay=3 * DT)))
    shifted = {n: np.r_[np.full(3, log[n][0]), log[n][:-3]] for n in MACHINE.inputs}
    start = {n: float(log[n][0]) for n in STATE}
    expected = dr.simulate(result, dr.Log.from_arrays(log.time, shifted), initial_state=start)
    found = dr.simulate(late, inputs_alone(log), initial_state=start)
    assert differences(found, expected) < 1e-12
    assert found.notes[-1] == "simulated from 1 start, inputs held, delayed by 60 ms"
    interpolated = dr.simulate(late, inputs_alone(log), initial_state=start, input_hold="linear")
    assert differences(found, interpolated) > 1e-6


def test_smoothed_states_of_a_diagnosis_are_restarted_from(log):
    found = dr.identify(dr.models.planar_rotorcraft(), log, seed=0)
    signals = {n: log[n].copy() for n in log.names}
    simulated = dr.simulate(found, log, horizon=0.5)
    assert differences(simulated, log) < 1e-3
    assert simulated.notes[-1].startswith("simulated from 6 starts, every 0.5 s")
    assert set(signals) <= set(simulated.names)


def test_divergence_names_the_time():
    model = dr.Model(
        "burst",
        {"x": "m"},
        {"push": "N"},
        {"rate": dr.Parameter("1/(m s^2)")},
        lambda q, v, a, u, p: [a.x - p.rate * q.x**3 - u.push],
    )
    time = np.arange(0.0, 10.0, 0.01)
    log = dr.Log.from_arrays(time, {"push": np.zeros_like(time)})
    with pytest.raises(ResultError, match=r"diverges at t = 1\.\d+ s; restart it"):
        dr.simulate(dr.Plant(model, {"rate": 2.0}), log, initial_state={"x": 1.0, "x_dot": 1.0})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"initial_state": {"y": 1.0}}, 'names "y"; the state is x, z'),
        ({"initial_state": {"x": np.nan}}, "x is nan; give a finite number"),
        ({"initial_state": {"x": 1.0}, "horizon": 1.0}, "give one"),
        ({"initial_state": {"x": "1.0"}}, "x is '1.0'; give a finite number"),
        ({"horizon": 0.001}, "at least one sample, 0.02 s"),
        ({"horizon": "1"}, "horizon is '1'; give a finite number"),
        ({"substeps": 0}, "at least 1 integration step"),
        ({"input_hold": "none"}, "choose zero-order"),
    ],
)
def test_arguments_are_checked(plant, log, arguments, message):
    with pytest.raises(SettingsError, match=message):
        dr.simulate(plant, log, **arguments)


def test_prediction_from_the_command_line(result, log, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result.save("model.json")
    log.write("flight.csv")
    done = run("predict", "model.json", "flight.csv", "-o", "predicted.csv", "--plot", "predicted.png")
    assert (done.exit_code, done.stdout) == (
        0,
        "wrote predicted.csv: 150 rows\nsimulated from 1 start, inputs held\n",
    )
    assert (tmp_path / "predicted.png").stat().st_size > 10_000
    assert differences(dr.read_log("predicted.csv"), dr.simulate(result, log)) < 1e-12
    inputs_alone(log).write("inputs.csv")
    start = ",".join(f"{n}=0" for n in STATE)
    done = run("predict", "model.json", "inputs.csv", "--initial", start, "-o", "predicted.parquet")
    assert done.exit_code == 0
    assert dr.read_log("predicted.parquet")["theta"][0] == 0.0
    assert run("predict", "model.json", "flight.csv", "--horizon", "0.5", "-o", "again.csv").exit_code == 0
    done = run("predict", "model.json", "inputs.csv", "-o", "none.csv")
    assert done.exit_code == 1
    assert run("predict", "model.json", "flight.csv", "-o", "none.txt").exit_code == 2
    assert not list(tmp_path.glob("none*"))


def test_velocities_that_are_no_derivatives_start_from_the_smoothed_motion():
    model = dr.models.differential_drive()
    parameters = {"mass": 20.0, "inertia": 1.0, "moment": 0.2, "viscous_friction": 0.5, "dry_friction": 0.1}
    t = 0.01 * np.arange(1000.0)
    torques = {"left_torque": 2.0 + np.sin(0.7 * t), "right_torque": 2.2 + np.sin(0.9 * t)}
    start = dict.fromkeys(model.state, 0.0) | {"speed": 0.5}
    plant = dr.Plant(model, parameters)
    moved = dr.simulate(plant, dr.Log.from_arrays(t, torques), initial_state=start)
    poses = dr.Log.from_arrays(t, {**{n: moved[n] for n in model.coordinates}, **torques})
    again = dr.simulate(plant, poses, horizon=1.0)
    assert np.abs(again["x"] - moved["x"]).max() < 0.01 * np.ptp(moved["x"])
    assert np.abs(again["yaw"] - moved["yaw"]).max() < 0.01 * np.ptp(moved["yaw"])
