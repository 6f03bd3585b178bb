"""The built-in quadrotor against a rigid body with rotors, integrated as a rotation matrix in NumPy."""

import runpy
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import diransac as dr

G, ARM = 9.81, 0.16
TRUTH = {
    "mass": 0.9,
    "inertia_x": 0.006,
    "inertia_y": 0.007,
    "inertia_z": 0.011,
    "thrust_coefficient": 1.4e-6,
    "torque_coefficient": 2.1e-8,
    "drag": 0.3,
}
LAG, BIASES = 0.04, {"acc": (0.3, -0.2, 0.15), "gyro": (0.02, -0.03, 0.01)}
FRAMES = {  # angle of each arm from forward, counterclockwise, in degrees, and the rotor's direction of rotation
    "x": ((-45.0, 1), (135.0, 1), (45.0, -1), (-135.0, -1)),
    "+": ((-90.0, 1), (90.0, 1), (0.0, -1), (180.0, -1)),
}
STATES = ("x", "y", "z", "vx", "vy", "vz", "wx", "wy", "wz")
QUATERNION = ("qw", "qx", "qy", "qz")
MOTORS = ("motor1", "motor2", "motor3", "motor4")


@cache
def rotors(frame):
    """Positions (4, 3), m, and directions (4,)."""
    angles, spins = np.array(FRAMES[frame]).T
    along = np.radians(angles)
    return ARM * np.column_stack([np.cos(along), np.sin(along), np.zeros(4)]), spins


def accelerations(R, v, w, speeds, frame):
    """Newton and Euler, with the moment of each rotor about the centre of gravity."""
    positions, spins = rotors(frame)
    thrusts = TRUTH["thrust_coefficient"] * speeds**2
    in_body = R.T @ v
    force = R @ (np.array([0.0, 0.0, thrusts.sum()]) - TRUTH["drag"] * np.array([in_body[0], in_body[1], 0.0]))
    Jx, Jy, Jz = TRUTH["inertia_x"], TRUTH["inertia_y"], TRUTH["inertia_z"]
    turning = -TRUTH["torque_coefficient"] * (spins * speeds**2).sum()
    roll, pitch, yaw = positions[:, 1] @ thrusts, -positions[:, 0] @ thrusts, turning
    wx, wy, wz = w
    alpha = [(roll + (Jy - Jz) * wy * wz) / Jx, (pitch + (Jz - Jx) * wz * wx) / Jy, (yaw + (Jx - Jy) * wx * wy) / Jz]
    return force / TRUTH["mass"] - [0.0, 0.0, G], np.array(alpha)


def slope(x, commands, frame, lag):
    """Derivative of position, velocity, angular velocity, rotation matrix and speeds of the rotors."""
    v, w, R = x[3:6], x[6:9], x[9:18].reshape(3, 3)
    a, alpha = accelerations(R, v, w, x[18:] if lag else commands, frame)
    W = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    return np.concatenate([v, a, alpha, (R @ W).ravel(), (commands - x[18:]) / lag if lag else np.zeros(4)])


def pilot(t, x, frame):
    """Speeds of the rotors that follow a curve, with a yaw of more than a turn."""
    p, v, w, R = x[:3], x[3:6], x[6:9], x[9:18].reshape(3, 3)
    size, rate, phase = np.array([1.5, 1.3, 0.5]), np.array([1.5, 1.9, 1.2]), np.array([0.0, 1.0, 2.0])
    aim, speed = size * np.sin(rate * t + phase), size * rate * np.cos(rate * t + phase)
    wanted = 5.0 * (aim - p) + 3.5 * (speed - v) - aim * rate**2 + [0.0, 0.0, G]
    up = wanted / np.linalg.norm(wanted)
    yaw = 0.5 * t + 0.6 * np.sin(1.1 * t)
    left = np.cross(up, [np.cos(yaw), np.sin(yaw), 0.0])
    left /= np.linalg.norm(left)
    E = np.column_stack([np.cross(left, up), left, up]).T @ R
    error = 0.5 * np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]])
    dither = 0.02 * np.array([np.sin(13.0 * t), np.sin(17.0 * t), 0.3 * np.sin(11.0 * t)])
    moment = -np.array([0.5, 0.5, 0.2]) * error - np.array([0.08, 0.08, 0.08]) * w + dither
    positions, spins = rotors(frame)
    ratio = TRUTH["torque_coefficient"] / TRUTH["thrust_coefficient"]
    mixer = np.vstack([np.ones(4), positions[:, 1], -positions[:, 0], -spins * ratio])
    thrusts = np.linalg.solve(mixer, [TRUTH["mass"] * wanted @ R[:, 2], *moment])
    return np.sqrt(np.clip(thrusts, 0.1, 6.0) / TRUTH["thrust_coefficient"])


def quaternion(R):
    """Unit quaternion with a scalar part that is not negative."""
    w = 0.5 * np.sqrt(max(1.0 + np.trace(R), 1e-12))
    return np.array([w, *(np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4.0 * w))])


@cache
def flight(frame="x", lag=0.0, n_rows=1000, dt=0.01, substeps=3):
    """Time, and every signal and input by name."""
    hover = np.full(4, np.sqrt(TRUTH["mass"] * G / 4 / TRUTH["thrust_coefficient"]))
    x, h, rows = np.concatenate([np.zeros(9), np.eye(3).ravel(), hover]), dt / substeps, []
    for k in range(n_rows):
        commands = pilot(k * dt, x, frame)
        rows.append(np.concatenate([x, slope(x, commands, frame, lag), commands]))
        for _ in range(substeps):
            k1 = slope(x, commands, frame, lag)
            k2 = slope(x + h / 2 * k1, commands, frame, lag)
            k3 = slope(x + h / 2 * k2, commands, frame, lag)
            k4 = slope(x + h * k3, commands, frame, lag)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    rows = np.array(rows)
    state, rates, commands = rows[:, :22], rows[:, 22:44], rows[:, 44:]
    attitude = np.array([quaternion(R) for R in state[:, 9:18].reshape(-1, 3, 3)])
    signals = dict(zip((*STATES, *QUATERNION), [*state[:, :9].T, *attitude.T], strict=True))
    signals |= {f"{name}_dot": rates[:, 3 + i] for i, name in enumerate(STATES[3:])}
    readings = {
        "acc": np.einsum("nji,nj->ni", state[:, 9:18].reshape(-1, 3, 3), rates[:, 3:6] + [0.0, 0.0, G]),
        "gyro": state[:, 6:9],
    }
    for sensor, values in readings.items():
        signals |= {f"{sensor}_{axis}": values[:, i] + BIASES[sensor][i] for i, axis in enumerate("xyz")}
    if lag:
        signals |= {f"speed{i + 1}": state[:, 18 + i] for i in range(4)}
        signals |= {f"speed{i + 1}_dot": rates[:, 18 + i] for i in range(4)}
    return np.arange(n_rows) * dt, signals | dict(zip(MOTORS, commands.T, strict=True))


def recorded(frame="x", lag=0.0):
    """Log of a flight without noise."""
    time, columns = flight(frame, lag, n_rows=300)
    return dr.Log.from_arrays(time, columns)


MASS = {"mass": TRUTH["mass"]}


@pytest.mark.parametrize("frame", FRAMES)
def test_equations_are_those_of_a_rigid_body_with_rotors(frame):
    result = dr.identify(dr.models.quadrotor(frame, arm_length=ARM), recorded(frame), "ols", fixed=MASS)
    assert dict(result.parameters) == pytest.approx(TRUTH, rel=1e-6)
    assert result.inlier_fraction == 1.0


def test_rotors_at_given_places_are_those_of_the_named_layout():
    places, spins = rotors("x")
    given = [(x, y, int(spin)) for (x, y, _), spin in zip(places, spins, strict=True)]
    result = dr.identify(dr.models.quadrotor(given), recorded(), "ols", fixed=MASS)
    assert dict(result.parameters) == pytest.approx(TRUTH, rel=1e-6)


def test_an_imu_has_its_biases_and_motors_have_their_lag():
    model = dr.models.quadrotor(arm_length=ARM, motor_lag=True, imu=True)
    result = dr.identify(model, recorded(lag=LAG), "ols", fixed=MASS)
    biases = {
        f"{sensor}_bias_{axis}": x for sensor, values in BIASES.items() for axis, x in zip("xyz", values, strict=True)
    }
    truth = {**TRUTH, **biases, "motor_time_constant": LAG}
    assert dict(result.parameters) == pytest.approx(truth, rel=1e-6)


def test_throttle_has_coefficients_in_newton_and_newton_metres():
    units = {n: x.unit for n, x in dr.models.quadrotor(speed_unit="1").parameters.items()}
    assert (units["thrust_coefficient"], units["torque_coefficient"]) == ("N", "N m")
    assert dr.models.quadrotor().parameters["thrust_coefficient"].unit == "N/(rad/s)^2"


@pytest.mark.parametrize(
    ("rotors", "said"),
    [
        ("y", 'rotors = \'y\'; choose "x", "\\+"'),
        ([(0.1, 0.1, 2)], "counterclockwise"),
        ([(np.nan, 0.1, 1)], "position"),
    ],
)
def test_rotors_without_a_meaning_are_refused(rotors, said):
    with pytest.raises(dr.ModelError, match=said):
        dr.models.quadrotor(rotors)


@pytest.mark.slow
def test_parameters_are_within_their_intervals_with_noise_and_outliers():
    """Motion capture and gyroscope, without velocities; the quaternion's sign changes once a turn."""
    time, columns = flight()
    rng = np.random.default_rng(1)
    noise = {**dict.fromkeys("xyz", 0.002), **dict.fromkeys(QUATERNION, 0.003), **dict.fromkeys(STATES[6:], 0.03)}
    measured = {name: columns[name] for name in MOTORS}
    for name, scale in noise.items():
        y, hit = columns[name], rng.random(len(time)) < 0.05
        wild = 5.0 * y.std() * rng.uniform(-1.0, 1.0, len(time))
        measured[name] = y + scale * rng.standard_normal(len(time)) + hit * wild
    log = dr.Log.from_arrays(time, measured)
    result = dr.identify(dr.models.quadrotor(arm_length=ARM), log, fixed=MASS, differentiate=True)
    assert result.verdict == "usable"
    for name, value in result.parameters.items():
        error = abs(value - TRUTH[name])
        assert error <= 0.01 * TRUTH[name], name
        assert error <= 4.0 * result.standard_errors[name], name


@pytest.mark.slow
def test_imu_and_attitude_determine_all_parameters_without_a_position():
    """The rotors' drag is what the accelerometer sees of the velocity, which nothing measures."""
    time, columns = flight("x", 0.0, n_rows=300)
    rng = np.random.default_rng(2)
    readings = [f"{sensor}_{axis}" for sensor in BIASES for axis in "xyz"]
    noise = {
        **dict.fromkeys(QUATERNION, 0.002),
        **dict.fromkeys(readings[:3], 0.1),
        **dict.fromkeys(readings[3:], 0.02),
    }
    measured = {name: columns[name] for name in MOTORS}
    for name, scale in noise.items():
        hit = rng.random(len(time)) < 0.05
        measured[name] = columns[name] + rng.normal(0.0, scale, len(time)) + hit * 50.0 * scale * rng.uniform(-1, 1)
    log = dr.Log.from_arrays(time, measured)
    result = dr.identify(dr.models.quadrotor(arm_length=ARM, imu=True), log, fixed=MASS, differentiate=True)
    assert result.verdict != "do not rely on this"
    assert not result.diagnosis.unidentifiable
    for name, true in TRUTH.items():
        assert result.parameters[name] == pytest.approx(true, rel=0.1), name
        assert abs(result.parameters[name] - true) <= 4.0 * result.standard_errors[name], name
    ratio = result.parameters["inertia_x"] / result.parameters["thrust_coefficient"]
    assert ratio == pytest.approx(TRUTH["inertia_x"] / TRUTH["thrust_coefficient"], rel=0.02)


def test_the_example_has_the_dynamics_of_the_built_in_quadrotor():
    own = runpy.run_path(str(Path(__file__).parents[1] / "examples" / "my_quadrotor.py"))["model"]
    builtin = dr.models.quadrotor("x", arm_length=0.12, speed_unit="rad/s", motor_lag=True)
    renamed = {"thrust_coefficient": "kT", "torque_coefficient": "kQ"} | {f"inertia_{x}": f"J{x}" for x in "xyz"}
    truth = {renamed.get(name, name): value for name, value in TRUTH.items()} | {"lag": LAG}
    biases = {name: 0.0 for name in own.parameters if name not in truth}
    state = np.array([0.1, 0.2, 0.3, 0.8, 0.0, 0.6, 0.0, 1.0, -2.0, 0.5, 0.3, -0.4, 0.2, 900.0, 950.0, 1000.0, 870.0])
    commands = np.array([910.0, 940.0, 990.0, 900.0])
    found = own.dynamics(state, commands, own.parameter_vector({**truth, **biases}))[0].full()
    expected = builtin.dynamics(state, commands, builtin.parameter_vector({**TRUTH, "motor_time_constant": LAG}))[0]
    np.testing.assert_allclose(found, expected.full(), rtol=1e-12, atol=1e-12)
