"""Wrapped angles and quaternions of either sign: every path gives what it gives for continuous ones."""

from functools import cache

import casadi as ca
import numpy as np
import pytest

import diransac as dr
from diransac.data import preprocessing as prepare
from diransac.identification.assessment.inspection import inspect
from results import assert_needs_no_care_but_for_terms
from user_models import tumbling

TURN = 2.0 * np.pi
QUATERNION, RATES, TORQUES = ("qw", "qx", "qy", "qz"), ("wx", "wy", "wz"), ("tx", "ty", "tz")
N, DT = 500, 0.01
T = DT * np.arange(N)


# ---------------------------------------------------------------------- angles


def wrapped(angle, turn=TURN, low=-0.5):
    return (angle - low * turn) % turn + low * turn


def with_outliers(rng, values, fraction):
    """The values with some of them displaced by up to three turns either way, and where."""
    hit = rng.random(len(values)) < fraction
    return values + np.where(hit, rng.choice([-1.0, 1.0], len(values)) * rng.uniform(0.5, 20.0, len(values)), 0.0), hit


def unwrapped(values, unit="rad"):
    log = dr.Log.from_arrays(DT * np.arange(len(values)), {"x": values}, {"x": unit})
    return prepare.unwrap(log, ["x"])["x"]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("rate", [0.4, 3.0, 30.0])
@pytest.mark.parametrize(("turn", "unit", "low"), [(TURN, "rad", -0.5), (TURN, "rad", 0.0), (360.0, "deg", -0.5)])
def test_wraps_are_undone_beside_outliers_of_any_size_and_across_gaps(seed, rate, turn, unit, low):
    rng = np.random.default_rng(seed)
    t = DT * np.arange(2000)
    angle = (rate * t + 0.5 * np.sin(2.0 * t) + 2.9 + 0.01 * rng.normal(size=len(t))) * turn / TURN
    measured, hit = with_outliers(rng, wrapped(angle, turn, low), 0.05)
    measured[700:705] = np.nan
    error = (unwrapped(measured, unit) - angle)[~hit & np.isfinite(measured)]
    assert np.ptp(error) < 1e-9 * turn
    assert error[0] / turn == pytest.approx(round(error[0] / turn), abs=1e-9)


@pytest.mark.parametrize("fraction", [0.1, 0.3, 0.4])
@pytest.mark.parametrize("size", [10.0, 30.0])
def test_an_angle_that_is_not_wrapped_is_kept_however_many_outliers_look_like_turns(fraction, size):
    for seed in range(10):
        rng = np.random.default_rng(seed)
        t = DT * np.arange(2500)
        angle = 0.5 * np.sin(rng.uniform(0.5, 2.0) * t) + 0.3 * np.sin(rng.uniform(2.0, 4.0) * t)
        hit = rng.random(len(t)) < fraction
        measured = angle + hit * rng.uniform(-size, size, len(t))
        assert np.array_equal(unwrapped(measured), measured)


@pytest.mark.parametrize("samples_per_turn", [5, 12, 20, 40])
@pytest.mark.parametrize("n", [60, 140])
def test_a_short_spin_between_long_rests_is_unwrapped(samples_per_turn, n):
    """A running median of the wrapped angle has no leap."""
    angle = TURN * (0.1 + np.clip(np.arange(3000) - 1000, 0, n - 1) / samples_per_turn)
    angle += 0.01 * np.random.default_rng(0).standard_normal(3000)
    assert np.allclose(unwrapped(wrapped(angle)), angle)


def test_an_angle_of_few_samples_is_unwrapped_across_those_that_are_missing():
    angle = 4.0 * np.arange(3000) * DT
    sparse = np.where(np.arange(3000) % 10 == 0, wrapped(angle), np.nan)
    found = unwrapped(sparse)
    assert np.array_equal(np.isfinite(found), np.isfinite(sparse))
    assert np.allclose(found[::10], angle[::10])


@pytest.mark.parametrize("seed", range(30))
def test_an_angle_that_is_not_wrapped_keeps_every_sample(seed):
    rng = np.random.default_rng(seed)
    t = DT * np.arange(2000)
    swing = rng.choice([rng.uniform(0.1, 2.9), rng.uniform(3.4, 9.0)]) * np.sin(
        rng.uniform(0.1, 3.0) * t
    ) + 0.005 * rng.normal(size=len(t))
    measured, _ = with_outliers(rng, swing, 0.1)
    assert unwrapped(measured) is not measured
    assert np.array_equal(unwrapped(measured), measured)


def test_a_leap_of_an_angle_within_its_travel_is_no_wrap():
    leaping = np.where(T < 2.5, -2.5, 2.5)
    assert np.array_equal(unwrapped(leaping), leaping)


def test_only_units_of_angles_are_unwrapped():
    model = dr.Model(
        "cart", {"s": "m", "angle": "deg"}, {"u": "N"}, {"m": dr.Parameter("kg")},
        lambda q, v, a, u, p: [p.m * a.s - u.u, a.angle],
    )  # fmt: skip
    angle = 90.0 * T + 100.0
    log = dr.Log.from_arrays(T, {"s": wrapped(3.0 * T), "angle": wrapped(angle, 360.0), "u": 0.0 * T})
    found = prepare.continuous(log, model)
    assert np.array_equal(found["s"], log["s"])
    assert np.allclose(found["angle"], angle)


def pendulum():
    return dr.Model(
        "pendulum", {"angle": "rad"}, {"torque": "N m"},
        {"J": dr.Parameter("kg m^2", positive=True), "c": dr.Parameter("N m s/rad"), "k": dr.Parameter("N m")},
        lambda q, v, a, u, p: [p.J * a.angle + p.c * v.angle + p.k * ca.sin(q.angle) - u.torque],
    )  # fmt: skip


@cache
def whirl():
    """A pendulum over the top and back, plain Runge-Kutta, with 5 % outliers of the angle."""
    t, rng = DT * np.arange(1200), np.random.default_rng(4)
    torque = 1.5 * np.sin(1.1 * t) + 0.8 * np.sin(3.1 * t)

    def rate(x, u):
        return np.array([x[1], (u - 0.08 * x[1] - 0.9 * np.sin(x[0])) / 0.11])

    x, angle = np.array([0.3, 1.0]), []
    for u in torque:
        angle.append(x[0])
        for _ in range(4):
            h = DT / 4
            k1 = rate(x, u)
            k2 = rate(x + h / 2 * k1, u)
            k3 = rate(x + h / 2 * k2, u)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3, u))
    angle = np.array(angle) + 0.003 * rng.normal(size=len(t))
    noisy, hit = with_outliers(rng, angle, 0.05)
    assert np.ptp(angle) > 2.0 * TURN
    return t, angle, torque, np.where(hit, noisy - angle, 0.0)


@pytest.mark.parametrize("method", ["lo-diransac", "ols"])
def test_estimates_are_the_same_for_wrapped_angles(method):
    t, angle, torque, off = whirl()
    off = off if method == "lo-diransac" else 0.0 * off
    results = [
        dr.identify(pendulum(), dr.Log.from_arrays(t, {"angle": x + off, "torque": torque}), method, differentiate=True)
        for x in (angle, wrapped(angle))
    ]
    assert results[1].parameters == pytest.approx(results[0].parameters, rel=1e-7)
    assert results[1].parameters == pytest.approx({"J": 0.11, "c": 0.08, "k": 0.9}, rel=0.02)


# ---------------------------------------------------------------------- quaternions


def product(a, b):
    """Hamilton product of quaternions (..., 4)."""
    scalar = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(axis=-1, keepdims=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])
    return np.concatenate([scalar, vector], axis=-1)


def normed(q):
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


INERTIA = {"Jx": 0.02, "Jy": 0.05, "Jz": 0.04}


@cache
def tumble(seed, outliers=0.05):
    """Attitudes, rates and torques of a body through many turns: noise of 0.01 rad and 0.02 rad/s, outliers in both."""
    rng, J = np.random.default_rng(seed), list(INERTIA.values())
    torques = 0.15 * sum(
        np.sin(TURN * f * T[:, None] + rng.uniform(0.0, TURN, 3)) for f in rng.uniform(0.2, 1.5, (4, 1))
    )

    def rate(x, torque):
        qw, qx, qy, qz, wx, wy, wz = x
        turning = (-qx * wx - qy * wy - qz * wz, qw * wx + qy * wz - qz * wy)
        turning += (qw * wy + qz * wx - qx * wz, qw * wz + qx * wy - qy * wx)
        spinning = (torque[0] - (J[2] - J[1]) * wy * wz) / J[0], (torque[1] - (J[0] - J[2]) * wz * wx) / J[1]
        return np.array([*(0.5 * x for x in turning), *spinning, (torque[2] - (J[1] - J[0]) * wx * wy) / J[2]])

    x, rows = np.array([1.0, 0.0, 0.0, 0.0, 2.0, -1.0, 0.5]), []
    for torque in torques.tolist():
        rows.append(x)
        for _ in range(4):
            h = DT / 4
            k1 = rate(x.tolist(), torque)
            k2 = rate((x + h / 2 * k1).tolist(), torque)
            k3 = rate((x + h / 2 * k2).tolist(), torque)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate((x + h * k3).tolist(), torque))
            x[:4] = normed(x[:4])
    rows = np.array(rows)
    turned = normed(np.column_stack([np.ones(N), 0.005 * rng.normal(size=(N, 3))]))
    q, w = product(rows[:, :4], turned), rows[:, 4:] + 0.02 * rng.normal(size=(N, 3))
    q = np.where(rng.random((N, 1)) < outliers, normed(rng.normal(size=(N, 4))), q)
    w = np.where(rng.random((N, 3)) < outliers, w + 5.0 * rng.normal(size=(N, 3)), w)
    return q, w, torques


def as_log(q, w, torques):
    columns = [*zip(QUATERNION, q.T, strict=True), *zip(RATES, w.T, strict=True), *zip(TORQUES, torques.T, strict=True)]
    return dr.Log.from_arrays(T, dict(columns))


def signs(seed):
    return np.random.default_rng(seed).choice([-1.0, 1.0], (N, 1))


@pytest.mark.parametrize("seed", range(2))
def test_signs_of_quaternions_are_continuous_whatever_they_were(seed):
    q, w, torques = tumble(seed)
    rng = np.random.default_rng(seed)
    q = np.where(rng.random((N, 4)) < 0.02, np.nan, q)
    found = [prepare.continuous(as_log(x, w, torques), tumbling()) for x in (q, -q, q * signs(seed), 1.03 * q)]
    columns = [np.column_stack([log[name] for name in QUATERNION]) for log in found]
    for other in columns[1:]:
        relative = other / columns[0]
        same = np.isfinite(q)
        assert np.ptp(relative[same]) < 0.04  # rows with a missing component are divided by the usual norm
        assert np.ptp(np.sign(relative[same])) == 0.0
    whole = np.isfinite(q).all(axis=1)
    assert np.allclose(np.linalg.norm(columns[3][whole], axis=1), 1.0)


def test_an_outlier_of_one_component_does_not_spread_to_the_others():
    q, w, torques = tumble(0, outliers=0.0)
    hit = q.copy()
    hit[100, 2] += 80.0
    found = prepare.continuous(as_log(hit * signs(1), w, torques), tumbling())
    sign = np.sign(found["qw"][0] * q[0, 0])
    assert sign * found["qw"][100] == pytest.approx(q[100, 0], rel=1e-6)
    assert sign * found["qz"][100] == pytest.approx(q[100, 3], rel=1e-6)


def test_a_continuous_quaternion_is_left_as_it_is():
    q, w, torques = tumble(0, outliers=0.0)
    log = as_log(q, w, torques)
    assert prepare.continuous(log, tumbling()) is log


@cache
def identified(method, turned):
    """Result for attitudes as they are, or of random signs; outliers are left to lo-diransac."""
    q, w, torques = tumble(1, 0.05 if method == "lo-diransac" else 0.0)
    log = as_log(q * (signs(1) if turned else 1.0), w, torques)
    return dr.identify(tumbling(), log, method, differentiate=True)


@pytest.mark.parametrize(("method", "accuracy"), [("lo-diransac", 0.02), ("ols", 0.1)])
def test_estimates_are_the_same_for_either_sign_of_each_sample(method, accuracy):
    one, other = (identified(method, turned) for turned in (False, True))
    assert other.parameters == pytest.approx(one.parameters, rel=1e-7)
    assert other.fit_error == pytest.approx(one.fit_error, rel=1e-6)
    assert one.parameters == pytest.approx(INERTIA, rel=accuracy)


def test_noise_of_an_attitude_is_that_of_its_tangent_space():
    """Noise of 0.01 rad about each axis is one of 0.005 in the quaternion, without the direction of its norm."""
    found = identified("lo-diransac", False).diagnosis.noise_std
    assert [found[name] for name in QUATERNION] == pytest.approx([0.005] * 4, rel=0.1)


def test_validation_is_the_same_for_either_sign_of_each_sample():
    q, w, torques = tumble(1)
    plant = dr.Plant(tumbling(), INERTIA)
    one, other = (dr.validate(plant, as_log(x, w, torques), horizon=0.5) for x in (q, q * signs(3)))
    for name in (*QUATERNION, *RATES):
        assert other.rmse[name] == pytest.approx(one.rmse[name], rel=1e-9)
        assert other.fit_percent[name] == pytest.approx(one.fit_percent[name], rel=1e-9)


def test_changes_of_sign_and_wraps_are_no_spikes():
    q, w, torques = tumble(0, outliers=0.0)
    found = inspect(as_log(q * signs(2), w, torques), tumbling())
    assert all(found.signals[name].n_spikes == 0 for name in QUATERNION)
    log = dr.Log.from_arrays(T, {"angle": wrapped(30.0 * T)}, {"angle": "rad"})
    assert inspect(log).signals["angle"].n_spikes == 0


# ---------------------------------------------------------------------- control


def test_gains_along_a_trajectory_do_not_depend_on_the_signs_of_its_attitude():
    q, w, torques = tumble(2, outliers=0.0)
    plant = dr.Plant(tumbling(), INERTIA)
    smooth = prepare.continuous_quaternions(q)
    one, other = (
        dr.tvlqr(plant, dr.Trajectory(T, np.hstack([x, w]), torques), Q=np.r_[4.0, 1.0, 2.0, 3.0, 1.0, 1.0, 1.0])
        for x in (smooth, smooth * signs(5))
    )
    sign = np.sign(one.states[0, 0] * other.states[0, 0])
    turned = np.r_[sign * np.ones(4), np.ones(3)]
    assert other.states * turned == pytest.approx(one.states, abs=1e-12)
    assert other.gains * turned == pytest.approx(one.gains, rel=1e-9, abs=1e-9)


def test_default_weight_of_an_attitude_is_that_of_an_angle():
    """Half a radian about the axis of a body at rest costs as much as half a radian of a coordinate."""
    body = dr.Plant(tumbling(), INERTIA)
    rest = dr.Trajectory(T, np.tile(np.r_[1.0, np.zeros(6)], (N, 1)), np.zeros((N, 3)))
    axis = dr.Model(
        "axis", {"angle": "rad"}, {"torque": "N m"}, {"J": dr.Parameter("kg m^2")},
        lambda q, v, a, u, p: [p.J * a.angle - u.torque],
    )  # fmt: skip
    still = dr.Trajectory(T, np.zeros((N, 2)), np.zeros((N, 1)))
    one = dr.tvlqr(dr.Plant(axis, {"J": INERTIA["Jx"]}), still).gains[0, 0]
    found = dr.tvlqr(body, rest).gains[0, 0]
    assert found[[1, 4]] == pytest.approx([2.0 * one[0], one[1]], rel=1e-6)


@pytest.mark.parametrize("sensor", [False, True])
def test_rates_alone_are_enough_where_no_force_depends_on_the_attitude(sensor):
    _, w, torques = tumble(0, 0.0)
    sensors = dr.sensors.gyroscope(RATES, bias=False) if sensor else None
    columns = dict(zip([*sensors] if sensor else RATES, w.T, strict=True)) | dict(zip(TORQUES, torques.T, strict=True))
    result = dr.identify(tumbling(sensors=sensors), dr.Log.from_arrays(T, columns), differentiate=True)
    assert dict(result.parameters) == pytest.approx(INERTIA, rel=0.01)
    assert_needs_no_care_but_for_terms(result)


# ---------------------------------------------------------------------- interpolation


@pytest.mark.parametrize(("turn", "low"), [(TURN, -0.5), (TURN, 0.0), (360.0, -0.5)])
def test_resampling_and_shifting_a_wrapped_angle_interpolate_along_the_shorter_way(turn, low):
    def angle(t):
        return turn * (0.7 * t + 0.3 * np.sin(2.0 * t))

    rate, log = 130.0, dr.Log.from_arrays(T, {"x": wrapped(angle(T), turn, low)})
    for found, true in (
        (dr.resample(log, rate), lambda t: angle(t)),
        (dr.shift(log, {"x": 0.4 * DT}), lambda t: angle(t - 0.4 * DT)),
    ):
        off = (found["x"] - true(found.time)) / turn
        np.testing.assert_allclose(off, np.round(off), atol=1e-4)
        assert np.ptp(found["x"]) < 1.02 * turn


def test_resampling_and_shifting_a_quaternion_of_either_sign_interpolate_one_attitude():
    rng, half = np.random.default_rng(3), 0.9 * np.sin(2.0 * T)
    q = np.array([np.cos(half), np.sin(half), np.zeros(N), np.zeros(N)])
    log = dr.Log.from_arrays(T, {"m": np.ones(N), **dict(zip(QUATERNION, q * rng.choice([-1.0, 1.0], N), strict=True))})
    shifted = dr.shift(log, dict.fromkeys(QUATERNION, 0.4 * DT))
    for found, late in ((dr.resample(log, 130.0), 0.0), (shifted, 0.4 * DT)):
        half = 0.9 * np.sin(2.0 * (found.time - late))
        true = np.array([np.cos(half), np.sin(half), 0.0 * half, 0.0 * half])
        same = np.abs((np.array([found[name] for name in QUATERNION]) * true).sum(axis=0))
        np.testing.assert_allclose(same, 1.0, atol=1e-3)


def test_a_leap_that_is_no_wrap_is_interpolated_as_before():
    steps = np.where(T < 2.0, 0.0, 10.0)
    found = dr.resample(dr.Log.from_arrays(T, {"x": steps}), 2.0 / DT)
    assert found["x"][np.searchsorted(found.time, 1.995)] == pytest.approx(5.0)
