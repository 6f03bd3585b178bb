"""States of first order: models without coordinates, states beside coordinates, and states that nothing measures.

Logs are made by LSODA, SciPy's `odeint`, from equations that are written here once more.
"""

import pickle
from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import odeint

import diransac as dr
from diransac.data.dataset import ParameterLayout
from diransac.data.preprocessing import differentiate
from diransac.errors import TimeLimitError
from diransac.identification.assessment.inspection import inspect
from diransac.identification.core.windows import Windows
from diransac.identification.estimate import TIME_LIMIT
from diransac.identification.methods.lo_diransac.unmeasured import measured_velocities
from diransac.identification.regression import observers as search
from diransac.identification.regression.multistart import least_squares
from diransac.identification.regression.observers import ObserverFit
from diransac.identification.structure.structural import structural
from diransac.model import Model, Parameter
from diransac.simulation import RolloutBatch, rollouts
from user_models import dc_motor, flexible_joint, lagged_thrust, oven, tank, tumbling

OVEN = {"capacity": 900.0, "loss": 3.0}
TANK = {"area": 0.2, "outlet": 6e-4}
MOTOR = {"inertia": 2e-3, "friction": 1e-3, "constant": 0.05, "resistance": 0.8, "inductance": 0.02}
THRUST = {"mass": 0.5, "gain": 8.0, "tau": 0.05, "drag": 0.2}
JOINT = {"rotor": 0.02, "inertia": 0.05, "stiffness": 8.0, "damping": 0.02, "friction": 0.05}
STIFF = {"rotor": 0.016, "inertia": 0.085, "stiffness": 75.0, "damping": 0.06, "friction": 0.2}


# ---------------------------------------------------------------------- independent simulations


def excitation(t, seed, highest):
    """Sum of six sines of unit variance, up to a frequency in Hz."""
    rng = np.random.default_rng(seed)
    w, phase, size = (
        2 * np.pi * rng.uniform(0.1, 1.0, 6) * highest,
        rng.uniform(0, 2 * np.pi, 6),
        rng.uniform(0.5, 1, 6),
    )
    return sum(a * np.sin(f * t + c) for a, f, c in zip(size, w, phase, strict=True)) / np.sqrt(0.5 * (size**2).sum())


def held(rates, x, u, dt):
    """State after `dt` seconds of an input that is held."""
    return odeint(lambda x, _: rates(x, u), x, [0.0, dt], rtol=1e-9, atol=1e-12)[-1]


def solved(rates, start, t, inputs):
    """States ``(N, n)`` under inputs that are held from sample to sample, and their derivatives."""
    states = [np.array(start, float)]
    for u in inputs[:-1]:
        states.append(held(rates, states[-1], u, t[1]))
    return np.array(states), np.array([rates(x, u) for x, u in zip(states, inputs, strict=True)])


@cache
def oven_signals():
    t = np.arange(1000) * 1.0
    power, ambient = 400.0 * (excitation(t, 0, 0.02) + 1.2).clip(0.0), 293.0 + 2.0 * np.sin(t / 300.0)
    u = np.column_stack([power, ambient])
    x, rates = solved(lambda x, u: [(u[0] - OVEN["loss"] * (x[0] - u[1])) / OVEN["capacity"]], [293.0], t, u)
    return t, {"temperature": x[:, 0], "temperature_dot": rates[:, 0]}, {"power": power, "ambient": ambient}


@cache
def tank_signals():
    t = np.arange(1000) * 0.5
    inflow = 2e-3 * (excitation(t, 1, 0.05) + 1.5).clip(0.0)

    def rates(x, u):
        return [(u - TANK["outlet"] * np.sqrt(2 * 9.81 * max(x[0], 1e-6))) / TANK["area"]]

    x, dx = solved(rates, [0.4], t, inflow)
    return t, {"level": x[:, 0], "level_dot": dx[:, 0]}, {"inflow": inflow}


@cache
def motor_signals():
    t = np.arange(1600) * 0.005
    voltage = 6.0 * excitation(t, 0, 2.0) + 4.0 * np.sign(excitation(t, 5, 1.0))

    def rates(x, u):
        _, speed, current = x
        torque = MOTOR["constant"] * current - MOTOR["friction"] * speed
        drop = MOTOR["resistance"] * current + MOTOR["constant"] * speed
        return [speed, torque / MOTOR["inertia"], (u - drop) / MOTOR["inductance"]]

    x, dx = solved(rates, [0.0, 0.0, 0.0], t, voltage)
    names = ("angle", "angle_dot", "current", "angle_ddot", "current_dot")
    return t, dict(zip(names, [*x.T, dx[:, 1], dx[:, 2]], strict=True)), {"voltage": voltage}


@cache
def thrust_signals():
    """Hover under a position controller, whose command has a dither."""
    t = np.arange(1600) * 0.01
    target, m = excitation(t, 2, 1.5), THRUST["mass"]

    def rates(x, u):
        lift = (x[2] - THRUST["drag"] * x[1]) / m - 9.81
        return [x[1], lift, (THRUST["gain"] * u - x[2]) / THRUST["tau"]]

    x, states, commands = np.array([0.0, 0.0, m * 9.81]), [], []
    for k in range(len(t)):
        force = m * (9.81 + 4.0 * (target[k] - x[0]) - 2.5 * x[1]) + np.sin(9.0 * t[k])
        states.append(x)
        commands.append(force / THRUST["gain"])
        x = held(rates, x, commands[-1], t[1])
    states = np.array(states)
    return t, dict(zip(("z", "z_dot", "thrust"), states.T, strict=True)), {"command": np.array(commands)}


@cache
def joint_signals():
    t = np.arange(1100) * 0.005
    return motion_of_joint(JOINT, t, 1.5 * excitation(t, 3, 5.0) + 0.5 * np.sign(excitation(t, 9, 2.0)))


@cache
def stiff_joint_signals():
    """A joint with a resonance at 12 Hz that is hardly damped."""
    t = np.arange(1300) * 0.005
    return motion_of_joint(STIFF, t, 0.9 * excitation(t, 34, 9.0))


def motion_of_joint(truth, t, torque):
    def rates(x, u):
        spring = truth["stiffness"] * (x[0] - x[1]) + truth["damping"] * (x[2] - x[3])
        return [x[2], x[3], (u - truth["friction"] * x[2] - spring) / truth["rotor"], spring / truth["inertia"]]

    x, _ = solved(rates, [0.0, 0.0, 0.0, 0.0], t, torque)
    return t, dict(zip(("motor", "load", "motor_dot", "load_dot"), x.T, strict=True)), {"torque": torque}


def recorded(simulation, names, noise=0.0, outliers=0.0, seed=0):
    """Log of some signals, with noise and outliers in units of a signal's standard deviation, and the inputs."""
    rng, (t, signals, inputs) = np.random.default_rng(seed), simulation
    columns = {}
    for name in names:
        x, size = signals[name], signals[name].std()
        hit = rng.random(len(x)) < outliers
        columns[name] = x + size * (noise * rng.standard_normal(len(x)) + hit * rng.uniform(-5.0, 5.0, len(x)))
    return dr.Log.from_arrays(t, {**columns, **inputs})


@cache
def identified(make, simulate, names, noise=0.0, outliers=0.0):
    """Result of lo-diransac; what several tests ask for is identified once."""
    return dr.identify(make(), recorded(simulate(), names, noise, outliers), differentiate=True)


def assert_exact(result, truth, tolerance=1e-4):
    for name, value in result.parameters.items():
        assert value == pytest.approx(truth[name], rel=tolerance), name


def assert_right(result, truth, largest):
    """The errors are below a limit, and below four standard errors."""
    for name, value in result.parameters.items():
        error = abs(value - truth[name])
        assert error < largest * truth[name], (name, value)
        assert error < 4.0 * result.standard_errors[name], (name, value, result.standard_errors[name])


# ---------------------------------------------------------------------- models


def test_a_state_of_first_order_has_one_derivative():
    model = dc_motor()
    assert model.state == ("angle", "angle_dot", "current")
    assert model.signals[3:] == ("angle_ddot", "current_dot")
    assert (model.units["current"], model.units["current_dot"]) == ("A", "A/s")
    assert model.rate_names == ("angle", "current")
    assert model.chains == (("angle", "angle_dot", "angle_ddot"), ("current", "current_dot"))


def test_kinematics_and_states_of_first_order_go_together():
    rigid = tumbling()

    def equations(q, v, a, u, p):
        turning = rigid.residual(
            *(_stacked(x, n) for x, n in ((q, rigid.coordinates), (v, rigid.velocities))),
            _stacked(a, rigid.velocities),
            _stacked(u, rigid.inputs),
            _stacked(p, rigid.parameters),
        )
        return [turning[0] + u.tx - v.rotor, turning[1], turning[2], p.tau * a.rotor + v.rotor - u.tx]

    model = tumbling(
        equations=equations, first_order={"rotor": "N m"}, parameters={**rigid.parameters, "tau": Parameter("s")}
    )
    assert model.quaternions == ((0, 1, 2, 3),)
    assert model.velocities_of_motion == rigid.velocities
    assert model.chains[-2:] == (("wz", "wz_dot"), ("rotor", "rotor_dot"))
    assert Model.from_dict(model.to_dict()) == model


def _stacked(symbols, names):
    return ca.vertcat(*(symbols[n] for n in names))


def test_models_with_states_of_first_order_are_stored_whole():
    for model in (oven(), dc_motor()):
        assert Model.from_dict(model.to_dict()) == model
        assert pickle.loads(pickle.dumps(model)).first_order == model.first_order


def test_a_model_needs_a_state_and_distinct_names():
    with pytest.raises(dr.ModelError, match="no coordinates or first_order states"):
        Model("nothing", {}, {}, {"k": Parameter("1")}, lambda q, v, a, u, p: [])
    with pytest.raises(dr.ModelError, match=r"motor_dot.*twice"):
        Model("twice", {"motor": "m"}, {}, {"k": Parameter("1")}, lambda *_: [0, 0], first_order={"motor_dot": "m"})


def test_simulation_agrees_with_lsoda():
    for model, parameters, (_, signals, inputs), dt in (
        (tank(), TANK, tank_signals(), 0.5),
        (dc_motor(), MOTOR, motor_signals(), 0.005),
    ):
        start = np.array([signals[n][0] for n in model.state])
        u = np.column_stack(list(inputs.values()))
        batch = RolloutBatch(model.parameter_vector(parameters)[None], start, u, dt)
        series = rollouts(model, substeps=4).trajectories(batch)[0]
        for name, column in zip(model.signals, series.T, strict=True):
            np.testing.assert_allclose(column, signals[name], atol=1e-6 * np.abs(signals[name]).max(), err_msg=name)


# ---------------------------------------------------------------------- measured states


@pytest.mark.parametrize("method", ["ols", "tls", "nls", "diransac", "i-diransac"])
def test_every_method_is_exact_on_clean_logs(method):
    settings = dr.Settings(max_iterations=20) if method.endswith("diransac") else None
    for model, truth, simulation in ((oven(), OVEN, oven_signals()), (dc_motor(), MOTOR, motor_signals())):
        log = recorded(simulation, simulation[1])
        assert_exact(dr.identify(model, log, method=method, settings=settings), truth, 1e-5)


@pytest.mark.parametrize(
    ("make", "truth", "simulate", "names"),
    [
        (oven, OVEN, oven_signals, ("temperature",)),
        (tank, TANK, tank_signals, ("level",)),
        (dc_motor, MOTOR, motor_signals, ("angle", "current")),
    ],
)
def test_lo_diransac_needs_the_states_alone(make, truth, simulate, names):
    exact = identified(make, simulate, names)
    assert_exact(exact, truth)
    assert exact.verdict == "usable"
    assert_right(identified(make, simulate, names, 0.01, 0.1), truth, 0.02)


def test_differentiation_derives_the_rate_of_a_state():
    t, signals, _ = tank_signals()
    derived = differentiate(recorded(tank_signals(), ["level"]), tank())
    inside = (t >= derived.time[0] - 1e-9) & (t <= derived.time[-1] + 1e-9)
    error = derived["level_dot"] - signals["level_dot"][inside]
    assert np.sqrt(np.mean(error**2)) < 0.1 * signals["level_dot"].std()


def test_a_result_is_stored_validated_and_reported(tmp_path):
    log = recorded(oven_signals(), ["temperature"], 0.002)
    result = dr.identify(oven(), log, differentiate=True)
    result.save(tmp_path / "oven.json")
    loaded = dr.Result.load(tmp_path / "oven.json")
    assert loaded.model == oven()
    assert dr.validate(loaded, log).fit_percent["temperature"] > 98.0
    dr.write_report(result, log, tmp_path / "oven.html")
    assert "states of first order temperature (K)" in (tmp_path / "oven.html").read_text()


def test_inspection_names_what_excites_a_model_without_coordinates():
    found = inspect(recorded(oven_signals(), ["temperature"], 0.001), oven()).fitness
    assert found.derivable == ("temperature_dot",)
    assert {x.verdict for x in found.excitation.values()} == {"well"}


def test_inspection_names_the_method_that_needs_no_other_signal():
    assert "lo-diransac estimates them" in inspect(recorded(thrust_signals(), ["z"]), lagged_thrust()).fitness.reason


# ---------------------------------------------------------------------- states that nothing measures

KNOWN = {"inertia": MOTOR["inertia"], "friction": MOTOR["friction"]}


@pytest.mark.parametrize(
    ("make", "truth", "simulate", "names", "largest"),
    [
        (lagged_thrust, THRUST, thrust_signals, ("z",), 0.03),
        (lambda: dc_motor(**KNOWN), MOTOR, motor_signals, ("angle_dot",), 0.05),
        (flexible_joint, JOINT, joint_signals, ("motor",), 0.05),
    ],
    ids=["thrust behind a lag", "current of a motor", "load behind a spring"],
)
def test_a_state_that_nothing_measures_is_estimated(make, truth, simulate, names, largest):
    exact = identified(make, simulate, names)
    assert_exact(exact, truth)
    assert exact.verdict == "usable"
    assert_right(identified(make, simulate, names, 0.005, 0.1), truth, largest)


@pytest.mark.parametrize(
    ("make", "simulate", "name", "hidden"),
    [(lagged_thrust, thrust_signals, "z", "thrust"), (flexible_joint, joint_signals, "motor", "load")],
    ids=["thrust behind a lag", "load behind a spring"],
)
def test_a_state_that_nothing_measures_is_simulated_and_drawn(make, simulate, name, hidden, tmp_path):
    result, log = identified(make, simulate, (name,)), recorded(simulate(), [name])
    t, signals, _ = simulate()
    simulated = dr.simulate(result, log)
    expected = np.interp(simulated.time, t, signals[hidden])
    assert np.abs(simulated[hidden] - expected).max() < 0.05 * np.ptp(expected)
    dr.write_report(result, log, tmp_path / "page.html")
    assert f'aria-label="{hidden} in {result.model.units[hidden]}, simulated over' in (
        tmp_path / "page.html"
    ).read_text(encoding="utf-8")


def test_a_resonance_that_smoothing_takes_for_noise_is_found():
    """A search that begins with the smoothed motion ends at rotors that are three times as heavy."""
    found = dr.identify(flexible_joint(), recorded(stiff_joint_signals(), ["motor"], 0.01), differentiate=True)
    # At this noise, dry friction between the rotors could be a part of the damping, and of nothing else.
    (care,) = [str(x) for x in found.findings if x.level in ("care", "bad")]
    assert care.startswith("If the model lacks a term, damping may be")
    assert "dry friction of motor - load" in care
    for name in ("rotor", "inertia", "stiffness"):
        assert found.parameters[name] == pytest.approx(STIFF[name], rel=0.03)
    assert all(abs(x - STIFF[n]) < 4.0 * found.standard_errors[n] for n, x in found.parameters.items())


def test_a_time_limit_in_the_search_that_begins_with_observers_is_said(monkeypatch):
    def late(*_):
        raise TimeLimitError("the time limit was reached")

    monkeypatch.setattr("diransac.identification.methods.lo_diransac.search.with_observed_states", late)
    found = dr.identify(flexible_joint(), recorded(stiff_joint_signals(), ["motor"], 0.01), differentiate=True)
    assert found.stop_reason == TIME_LIMIT
    assert found.verdict != "usable"
    assert any("time limit" in x for x in found.findings)


def observers_of_joint(bandwidth):
    """Observers of the joint by its motor's angle, with parameters that are not quite right, and the true states."""
    t, signals, inputs = joint_signals()
    model, states = flexible_joint(), np.column_stack([joint_signals()[1][n] for n in flexible_joint().state])
    layout = ParameterLayout(model.parameters)
    sampled, weights = signals["motor"][:, None], np.full((len(t), 1), 1e4 / len(t))
    given = (states[:1], inputs["torque"][:, None], np.zeros((len(t), 0)), weights, [slice(0, len(t))], t[1])
    problem = ObserverFit(model, layout, model.state, (), ("motor",), sampled, *given, bandwidth)
    z = np.concatenate([[1.1 * x for x in JOINT.values()], states[0]])[None]
    return problem, z, signals


def test_observers_follow_samples_by_their_bandwidth_and_simulate_without():
    apart = []
    for bandwidth in (100.0, 10.0, 1.0):
        problem, z, signals = observers_of_joint(bandwidth)
        apart.append(np.abs(problem.trajectories(z[0])["motor"] - signals["motor"]).max())
    assert apart[0] < 0.2 * apart[1] < 0.2 * apart[2]
    problem, z, signals = observers_of_joint(1e-9)
    exact = np.concatenate([list(JOINT.values()), z[0, 5:]])
    found = problem.trajectories(exact)
    assert set(found) == {"motor", "load", "motor_dot", "load_dot", "motor_ddot", "load_ddot"}
    for name in ("motor", "load", "load_dot"):
        np.testing.assert_allclose(found[name], signals[name], atol=1e-4 * np.abs(signals[name]).max())


def test_gradients_of_observers_are_those_of_their_cost():
    problem, z, _ = observers_of_joint(8.0)
    lanes = np.arange(len(z))
    gradient = problem.linearized(z, lanes)[1][0]
    for j in range(z.shape[1]):
        change = np.zeros_like(z)
        change[0, j] = 1e-6 * max(1e-2, abs(z[0, j]))
        above, below = (problem.linearized(x, lanes)[0] for x in (z + change, z - change))
        slope = (above - below) / (4.0 * change[0, j])
        assert gradient[j] == pytest.approx(slope[0], rel=1e-4, abs=1e-7 * np.abs(gradient).max())


def test_observers_find_a_joint_from_anywhere():
    """Up to the samples' hold between rows; parameters that have a sign keep it on every step."""
    problem, _, _ = observers_of_joint(10.0)
    starts = problem.starts()
    assert (starts[:, :3] > 0.0).all()
    found, cost = least_squares(problem, starts, 60)
    assert (found[:, :3] > 0.0).all()
    best = found[np.argmin(cost)]
    assert best[:5] == pytest.approx(list(JOINT.values()), rel=0.03)


def test_observers_of_long_logs_start_from_their_liveliest_stretch(monkeypatch):
    """Parameters come from there, and states are those of the beginning of the log."""
    problem, _, _ = observers_of_joint(10.0)
    monkeypatch.setattr(search, "STRETCH", len(problem.samples) // 2)
    fit, found = problem.search([(10.0, 60, 5)])
    assert fit.rows_of_logs == problem.rows_of_logs
    assert found[0, :5] == pytest.approx(list(JOINT.values()), rel=0.05)
    np.testing.assert_array_equal(found[:, 5:], np.tile(problem.begin, (5, 1)))


def test_the_liveliest_stretch_is_where_inputs_change_and_samples_count(monkeypatch):
    problem, _, _ = observers_of_joint(10.0)
    n, rows = len(problem.samples), np.arange(len(problem.samples))
    monkeypatch.setattr(search, "STRETCH", n // 2)
    still = np.where(np.abs(rows - 0.35 * n) < 0.1 * n, problem.inputs[:, 0], problem.inputs[0, 0])
    still[9 * n // 10 :] += 1e3
    known = np.where(np.abs(rows - 0.9 * n)[:, None] < 3.0, 0.0, problem.weights)
    logs = [slice(0, n // 2), slice(n // 2, n)]
    begin = np.tile(problem.begin, (2, 1))
    two = replace(problem, inputs=still[:, None], weights=known, rows_of_logs=logs, begin=begin)
    stretches = two.on_stretches()
    first, second = stretches.rows_of_logs
    assert first.stop - first.start == second.stop - second.start == n // 4
    assert first.start <= 0.25 * n + 1
    assert first.stop >= 0.45 * n - 1
    assert second.start == n // 2  # the step is where nothing was sampled
    assert stretches.begin[0, 0] == problem.samples[first.start, 0]
    slow = replace(two, weights=np.where(rows[:, None] % 10 == 0, known, 0.0)).on_stretches().rows_of_logs
    assert slow[0] == first  # samples that are slower than inputs
    monkeypatch.setattr(search, "STRETCH", n // 4)
    five = [slice(k * n // 5, (k + 1) * n // 5) for k in range(5)]
    short = replace(two, rows_of_logs=five, begin=np.tile(problem.begin, (5, 1))).on_stretches().rows_of_logs[1]
    assert short.stop - short.start == n // 4 // 4  # enough of each log


def test_larger_problems_have_fewer_starts():
    problem, _, _ = observers_of_joint(8.0)
    assert len(problem.starts()) == 256
    many = replace(problem, rows_of_logs=60 * problem.rows_of_logs)
    assert 16 <= len(many.starts()) < 64


def test_a_hidden_motion_beside_forces_that_the_model_lacks_is_not_relied_on():
    """A torque on the motor that is not recorded: the load, which nothing measures, could explain it as well."""
    t, signals, inputs = joint_signals()
    unrecorded = excitation(t, 21, 3.0)
    log = recorded((t, signals, {"torque": inputs["torque"] - unrecorded}), ["motor"], 0.001)
    method = dr.LoDiransac(input_delay=False, input_lag=False, sensor_delays=(), sensor_biases=())
    found = dr.identify(flexible_joint(), log, method, differentiate=True)
    assert found.verdict == "do not rely on this"
    assert any(x.startswith("Nothing measures load, and the model leaves") for x in found.findings)


def test_the_estimated_state_is_the_true_one():
    t, signals, _ = thrust_signals()
    found = identified(lagged_thrust, thrust_signals, ("z",)).diagnosis
    expected = np.interp(found.smoothed_time, t, signals["thrust"])
    np.testing.assert_allclose(found.smoothed_states["thrust"], expected, atol=1e-3 * signals["thrust"].max())


def test_the_same_seed_gives_the_same_estimate_of_an_unmeasured_state():
    again = dr.identify(lagged_thrust(), recorded(thrust_signals(), ["z"], 0.005, 0.1), differentiate=True)
    assert again.parameters == identified(lagged_thrust, thrust_signals, ("z",), 0.005, 0.1).parameters


@pytest.mark.parametrize(
    ("signals", "velocities"),
    [
        (("x", "qw", "qx", "qy", "qz"), {"vx", "wx", "wy", "wz"}),
        (("gyro_x", "speed1"), {"wx", "speed1"}),
        (("acc_z",), {"vx", "vy", "vz", "wx", "wy", "wz"}),
    ],
)
def test_signals_and_sensors_measure_velocities(signals, velocities):
    model, n = dr.models.quadrotor(motor_lag=True, imu=True), 8
    known = np.tile([name in signals for name in model.signals], (n, 1))
    log = np.zeros(known.shape), known, np.zeros((n, model.n_u)), np.zeros(n, bool)
    intervals = Windows.of(model, ParameterLayout(model.parameters), [log], 0.01, 4, 1)
    names = np.array(list(model.velocities))
    assert set(names[measured_velocities(intervals)]) == velocities


def test_a_free_scale_is_named_and_no_number_is_given_for_it():
    result = dr.identify(lagged_thrust(mass=None), recorded(thrust_signals(), ["z"]), differentiate=True)
    assert set(result.diagnosis.unidentifiable) == {"mass", "gain", "drag"}
    assert result.parameters["tau"] == pytest.approx(THRUST["tau"], rel=1e-3)
    assert "gain/mass, drag/mass" in result.diagnosis.combinations[0]
    assert "not all states are measured" in result.diagnosis.combinations[0]


def test_a_motor_without_any_known_constant_is_refused():
    with pytest.raises(dr.IdentificationError, match="only 3 combinations of them are determined"):
        dr.identify(dc_motor(), recorded(motor_signals(), ["angle"]), differentiate=True)


def test_structure_depends_on_what_is_measured():
    model = lagged_thrust(mass=None)
    assert structural(model) == ()
    assert structural(lagged_thrust()) == structural(lagged_thrust(), ("z",)) == ()
    assert structural(flexible_joint(), ("motor",)) == ()
    (ambiguity,) = structural(model, ("z",))
    assert ambiguity.combinations == ("gain/mass", "drag/mass")


@pytest.mark.parametrize("differentiated", [True, False])
def test_linear_methods_refuse_an_unmeasured_state_in_a_sentence(differentiated):
    log = recorded(thrust_signals(), ["z", "z_dot"])
    with pytest.raises(dr.LogError, match=r'"(thrust|z_ddot)" is missing'):
        dr.identify(lagged_thrust(), log, method="ols", differentiate=differentiated)


def test_validation_starts_from_an_estimated_state():
    t, signals, inputs = thrust_signals()
    plant = dr.Plant(lagged_thrust(), {n: x for n, x in THRUST.items() if n != "mass"})
    late = {n: x[400:] for n, x in {**signals, **inputs}.items() if n != "thrust"}
    scores = dr.validate(plant, dr.Log.from_arrays(t[400:], late), substeps=4)
    assert scores.rmse["z"] < 1e-3 * signals["z"].std()
    raw = dr.Log.from_arrays(t, {"z": signals["z"], **inputs})
    with pytest.raises(dr.LogError, match=r'"z_dot"'):
        dr.validate(plant, raw, start="measured")
    for log in (raw, differentiate(raw, lagged_thrust())):
        assert dr.validate(plant, log).fit_percent["z"] > 90.0


# ---------------------------------------------------------------------- flight


def test_a_plan_needs_no_coordinates():
    plant = dr.Plant(tank(), TANK)
    plan = dr.plan(plant, waypoints=[{"level": 0.3}, {"level": 0.5}], input_limits={"inflow": (0.0, 8e-3)})
    log = dr.fly(plant, plan, dr.tvlqr(plant, plan))
    assert log["level"][[0, -1]] == pytest.approx([0.3, 0.5], abs=1e-6)


def test_a_plan_begins_with_its_actuators_at_rest():
    plant = dr.Plant(lagged_thrust(), {n: x for n, x in THRUST.items() if n != "mass"})
    plan = dr.plan(plant, waypoints=[{"z": 0.0}, {"z": 1.0}], input_limits={"command": (0.0, 1.2)})
    start = dict(zip(plan.state_names, plan.states[0], strict=True))
    assert start == pytest.approx({"z": 0.0, "z_dot": 0.0, "thrust": THRUST["mass"] * 9.81})
    log = dr.fly(plant, plan, dr.tvlqr(plant, plan))
    assert log["z"][-1] == pytest.approx(1.0, abs=1e-6)


def test_a_plan_names_the_inputs_that_rest_would_take():
    plant = dr.Plant(lagged_thrust(), {n: x for n, x in THRUST.items() if n != "mass"})
    with pytest.raises(dr.PlanningError, match=r"command would have to be 0\.6131"):
        dr.plan(plant, waypoints=[{"z": 0.0}, {"z": 1.0}], input_limits={"command": (0.0, 0.5)})


# ---------------------------------------------------------------------- states that only a sensor shows

WEIGHED = {"linear": 0.28, "square": 0.24, "tau": 0.07, "sensor_tau": 0.25}


def weighed_thrust(sensor_lag=True):
    """Thrust behind a lag, shown by an accelerometer alone, which may have a lag of its own."""
    names = [n for n in WEIGHED if sensor_lag or n != "sensor_tau"]

    def equations(q, v, a, u, p):
        follows = [p.tau * a.thrust + v.thrust - p.linear * u.command - p.square * u.command**2]
        return [*follows, p.sensor_tau * a.felt + v.felt - v.thrust] if sensor_lag else follows

    return Model(
        "weighed thrust",
        {},
        {"command": "1"},
        {n: Parameter("s", positive=True) if n.endswith("tau") else Parameter("N") for n in names},
        equations,
        first_order={"thrust": "N", **({"felt": "N"} if sensor_lag else {})},
        sensors={"acc": dr.Sensor("m/s^2", lambda q, v, a, u, p: (v.felt if sensor_lag else v.thrust) / 0.03)},
    )


def weighed_log(seed, noise, outliers, *, sensor_lag=True, correlated=0.0):
    """Accelerometer of a thrust whose response to held commands is exact: eigenvectors of one or two lags."""
    rng, n, dt = np.random.default_rng(seed), 2500, 0.008
    t = dt * np.arange(n)
    command = 0.64 + 0.06 * excitation(t, 31, 3.0) + 0.04 * np.sign(np.sin(12.0 * t))
    static = WEIGHED["linear"] * command + WEIGHED["square"] * command**2
    tau, late = WEIGHED["tau"], WEIGHED["sensor_tau"]
    thrust = felt = static[0]
    acc = np.empty(n)
    for k in range(n):
        acc[k] = (felt if sensor_lag else thrust) / 0.03
        target = static[k]
        faster = (thrust - target) * tau / (tau - late)
        felt = target + faster * np.exp(-dt / tau) + (felt - target - faster) * np.exp(-dt / late)
        thrust = target + (thrust - target) * np.exp(-dt / tau)
    drift = np.zeros(n)
    for k in range(1, n):
        drift[k] = 0.9 * drift[k - 1] + correlated * np.sqrt(0.19) * rng.standard_normal()
    wild = (rng.random(n) < outliers) * rng.uniform(-30.0, 30.0, n)
    return dr.Log.from_arrays(t, {"acc": acc + noise * rng.standard_normal(n) + drift + wild, "command": command})


def test_an_accelerometer_alone_shows_two_lags():
    """Nothing but the sensor gives the search of the unmeasured states a direction."""
    found = dr.identify(weighed_thrust(), weighed_log(0, 0.1, 0.1), differentiate=True)
    lags = sorted(found.parameters[n] for n in ("tau", "sensor_tau"))  # they may be exchanged
    assert [*(found.parameters[n] for n in ("linear", "square")), *lags] == pytest.approx([*WEIGHED.values()], rel=0.15)
    (said,) = [x for x in found.findings if x.level == "bad"]
    assert "explain this log as well" in said
    assert "sensor_tau = " in said
    others = [x for x in found.findings if x.level == "care"]
    assert all("If the model lacks a term" in x for x in others)  # commands vary by a tenth of their mean


def test_correlated_errors_of_a_sensor_do_not_attenuate_a_lag():
    """They look like forces on the state: a regression on its rate, which contains these, would shorten the lag."""
    log = weighed_log(0, 0.1, 0.02, sensor_lag=False, correlated=0.2)
    found = dr.identify(weighed_thrust(sensor_lag=False), log, differentiate=True)
    assert found.parameters["tau"] == pytest.approx(WEIGHED["tau"], rel=0.15)
    assert found.verdict == "do not rely on this"


def test_validation_starts_a_state_that_only_a_sensor_shows_from_its_samples():
    log = weighed_log(3, 0.0, 0.0, sensor_lag=False)
    plant = dr.Plant(weighed_thrust(sensor_lag=False), {n: WEIGHED[n] for n in ("linear", "square", "tau")})
    assert dr.validate(plant, log, horizon=2.0).rmse["acc"] < 1e-3 * log["acc"].std()


@pytest.mark.parametrize("lost", [slice(0, 0), slice(200, 260)])
def test_a_rotor_whose_sense_of_rotation_nothing_measures_is_identified_from_its_height(lost):
    """The log begins far from the command, and in a gap nothing says which way the rotor turns."""
    gain, lag, n, dt = 1e-5, 0.1, 400, 0.01
    model = Model(
        "rotor",
        {"z": "m"},
        {"command": "rad/s"},
        {"gain": Parameter("m", positive=True), "lag": Parameter("s", positive=True)},
        lambda q, v, a, u, p: [a.z - p.gain * v.speed**2 + 9.81, p.lag * a.speed + v.speed - u.command],
        first_order={"speed": "rad/s"},
    )
    command, states = 1000.0 + 150.0 * np.sign(np.sin(0.09 * np.arange(n)) + 0.4), [np.array([0.0, 0.0, 900.0])]
    for u in command[:-1]:
        rates = lambda x, _t, u=u: [x[1], gain * x[2] ** 2 - 9.81, (u - x[2]) / lag]  # noqa: E731
        states.append(odeint(rates, states[-1], [0.0, dt], rtol=1e-10, atol=1e-10)[-1])
    rng = np.random.default_rng(1)
    measured = np.array(states)[:, :2] + 1e-3 * rng.normal(size=(n, 2))
    measured[rng.random(n) < 0.05, 0] += 5.0
    measured[lost] = np.nan
    columns = {"z": measured[:, 0], "z_dot": measured[:, 1], "command": command}
    result = dr.identify(model, dr.Log.from_arrays(dt * np.arange(n), columns))
    assert result.parameters["gain"] == pytest.approx(gain, rel=0.01)
    assert result.parameters["lag"] == pytest.approx(lag, rel=0.05)
    assert result.diagnosis.smoothed_states["speed"][0] == pytest.approx(900.0, rel=0.05)
