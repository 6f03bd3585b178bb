"""Designed experiments: they keep their limits, rest at their ends, and predict what least squares then shows."""

import pickle

import numpy as np
import pytest
from casadi import cos, sign, sin

import diransac as dr
from planned import ROTORCRAFT, mass

G, LENGTH = 9.81, 0.4


def two_links(q, v, a, u, p):
    """Planar arm in the vertical plane, with two angles from the horizontal, friction in the first joint alone."""
    coupling = p.moment * LENGTH * cos(q.upper - q.lower)
    twist = p.moment * LENGTH * sin(q.upper - q.lower)
    return [
        p.inertia1 * a.upper + coupling * a.lower + twist * v.lower**2 + p.weight * G * cos(q.upper)
        + p.friction * sign(v.upper) - u.upper_torque,
        p.inertia2 * a.lower + coupling * a.upper - twist * v.upper**2 + p.moment * G * cos(q.lower) - u.lower_torque,
    ]  # fmt: skip


UNITS = {"inertia1": "kg m^2", "inertia2": "kg m^2", "moment": "kg m", "weight": "kg m", "friction": "N m"}
TRUTH = {"inertia1": 0.4, "inertia2": 0.1, "moment": 0.3, "weight": 0.9, "friction": 0.4}
ARM = dr.Plant(
    dr.Model(
        "arm",
        {"upper": "rad", "lower": "rad"},
        {"upper_torque": "N m", "lower_torque": "N m"},
        {name: dr.Parameter(unit) for name, unit in UNITS.items()},
        two_links,
    ),
    TRUTH,
)
LIMITS = {
    "upper": (-2.2, 0.3),
    "lower": 2.0,
    "upper_dot": 4.0,
    "lower_dot": 5.0,
    "upper_torque": 14.0,
    "hand": (-0.9, 9.0),
}
NOISE = {"upper_torque": 0.2, "lower_torque": 0.1}


def hand(q, v, a, u, p):
    """Height of the hand, m."""
    return {"hand": LENGTH * sin(q.upper) + 0.3 * sin(q.lower)}


def designed(**changes):
    return dr.design_experiment(
        ARM, **{"limits": LIMITS, "noise": NOISE, "outputs": hand, "duration": 8.0, "harmonics": 6} | changes
    )


@pytest.fixture(scope="module")
def experiment():
    return designed()


def regressor(motion):
    """Equations (2 K, 5) by hand at rows of q, v and a."""
    (q1, q2), (v1, v2), (a1, a2) = motion
    c, s, zero = LENGTH * np.cos(q1 - q2), LENGTH * np.sin(q1 - q2), np.zeros_like(q1)
    first = [a1, zero, c * a2 + s * v2**2, G * np.cos(q1), np.sign(v1)]
    second = [zero, a2, c * a1 - s * v1**2 + G * np.cos(q2), zero, zero]
    return np.vstack([np.array(first).T, np.array(second).T])


def motion_of(trajectory):
    """Positions, velocities and, by the spectrum of these, accelerations (2, K)."""
    v = trajectory.states[:-1, 2:].T
    w = 2j * np.pi * np.fft.fftfreq(v.shape[1], trajectory.dt)
    a = np.fft.ifft(w * np.fft.fft(v, axis=1), axis=1).real
    return trajectory.states[:, :2].T, trajectory.states[:, 2:].T, np.hstack([a, a[:, :1]])


# ---------------------------------------------------------------------- predictions


@pytest.mark.parametrize("which", ["designed", "multisine"])
def test_predicted_standard_errors_are_those_of_weighted_least_squares(experiment, which):
    """With regressors by hand, and accelerations by the spectrum of the velocities."""
    motion = experiment if which == "designed" else experiment.multisine
    predicted = experiment.standard_errors if which == "designed" else experiment.multisine_standard_errors
    W = regressor(motion_of(motion)) / np.repeat(list(NOISE.values()), len(motion))[:, None]
    expected = np.sqrt(np.diag(np.linalg.inv(W.T @ W)))
    np.testing.assert_allclose([predicted[n] for n in TRUTH], expected, rtol=1e-3)


def test_least_squares_from_noisy_torques_scatters_as_predicted(experiment):
    W, sigma = regressor(motion_of(experiment)), np.repeat(list(NOISE.values()), len(experiment))
    rng, n = np.random.default_rng(0), 400
    b = (W @ list(TRUTH.values()) + sigma * rng.standard_normal((n, len(W)))) / sigma
    found = np.linalg.lstsq(W / sigma[:, None], b.T)[0]
    scatter = found.std(axis=1) / list(experiment.standard_errors.values())
    assert np.abs(scatter - 1.0).max() < 5.0 / np.sqrt(2 * n)


def test_the_design_has_more_information_than_the_multisine(experiment):
    """By a factor of 2.5 per parameter."""
    W = [regressor(motion_of(x)) for x in (experiment, experiment.multisine)]
    assert np.diff([np.linalg.slogdet(x.T @ x)[1] for x in W])[0] < -np.log(100.0)
    assert np.exp(np.mean(np.log(list(experiment.ratios.values())))) < 0.7


def test_inputs_are_those_of_the_equations_between_rows():
    found = designed(max_iterations=2, rate=200.0)
    q, v, a = motion_of(found)
    exact = (regressor((q, v, a)) @ list(TRUTH.values())).reshape(2, -1)
    middle = 0.5 * (exact[:, :-1] + exact[:, 1:])
    away = np.abs(v[0]).min() < np.minimum(np.abs(v[0, :-1]), np.abs(v[0, 1:]))  # friction switches at rest
    moving = away & (v[0, :-1] * v[0, 1:] > 0.0)
    np.testing.assert_allclose(found.inputs[:-1][moving].T, middle[:, moving], atol=0.02)


def test_parameters_that_no_motion_shows_have_no_standard_error():
    model = dr.Model(
        "pair",
        {"y": "m"},
        {"push": "N"},
        {n: dr.Parameter("kg") for n in ("cart", "load")} | {"drag": dr.Parameter("N s/m")},
        lambda q, v, a, u, p: [(p.cart + p.load) * a.y + p.drag * v.y - u.push],
    )
    found = dr.design_experiment(
        dr.Plant(model, {"cart": 1.0, "load": 2.0, "drag": 3.0}), limits={"y": 0.5}, max_iterations=9
    )
    assert [np.isfinite(x) for x in found.standard_errors.values()] == [False, False, True]
    assert "not identifiable" in str(found)
    assert found.to_dict()["parameters"]["drag"]["ratio"] == found.ratios["drag"] <= 1.0


def test_noise_of_measured_accelerations_counts_through_the_mass_matrix():
    """The residual has noise of m s, so that the standard error of m is m s over the norm of a."""
    found = dr.design_experiment(mass(2.0), limits={"y": 0.5}, noise={"y_ddot": 0.3}, duration=5.0, max_iterations=3)
    w = 2j * np.pi * np.fft.fftfreq(len(found) - 1, found.dt)
    a = np.fft.ifft(w * np.fft.fft(found["y_dot"][:-1])).real
    assert found.standard_errors["mass"] == pytest.approx(2.0 * 0.3 / np.linalg.norm(a), rel=1e-3)


# ---------------------------------------------------------------------- limits and repetition


@pytest.mark.parametrize("which", ["designed", "multisine"])
def test_limits_hold_between_rows_too(experiment, which):
    """On a grid of 1 kHz, by the spectrum of the rows."""
    motion = experiment if which == "designed" else experiment.multisine
    n = len(motion) - 1
    spectrum = np.fft.fft(motion.states[:-1], axis=0)
    fine = 10 * np.fft.ifft(np.insert(spectrum, n // 2, np.zeros((9 * n, 4)), axis=0), axis=0).real
    w = 2j * np.pi * np.fft.fftfreq(10 * n, motion.dt / 10)[:, None]
    a = np.fft.ifft(w * np.fft.fft(fine[:, 2:], axis=0), axis=0).real
    torques = (regressor((fine[:, :2].T, fine[:, 2:].T, a.T)) @ list(TRUTH.values())).reshape(2, -1)
    height = LENGTH * np.sin(fine[:, 0]) + 0.3 * np.sin(fine[:, 1])
    columns = dict(zip(("upper", "lower", "upper_dot", "lower_dot"), fine.T, strict=True))
    for name, values in (columns | {"upper_torque": torques[0], "hand": height}).items():
        limit = LIMITS[name]
        low, high = limit if isinstance(limit, tuple) else (-limit, limit)
        assert low <= values.min() <= values.max() <= high, name


def test_both_ends_are_at_rest_in_one_place(experiment):
    for motion in (experiment, experiment.multisine):
        q, v, a = motion_of(motion)
        np.testing.assert_allclose(q[:, 0], q[:, -1], atol=1e-9)
        np.testing.assert_allclose(np.hstack([v[:, [0, -1]], a[:, :1]]), 0.0, atol=1e-6)


def test_a_design_repeats_by_its_seed_and_survives_pickling(experiment):
    first, again, other = (designed(seed=seed, max_iterations=10) for seed in (0, 0, 1))
    np.testing.assert_array_equal(again.states, first.states)
    assert np.abs(other.multisine.states - first.multisine.states).max() > 0.01
    copy = pickle.loads(pickle.dumps(experiment))
    assert copy.standard_errors == experiment.standard_errors
    np.testing.assert_array_equal(copy.inputs, experiment.inputs)


def test_the_time_limit_leaves_a_motion_within_limits():
    found = designed(time_limit=1e-6)
    assert found.stop_reason == "the time limit was reached after 0 iterations"
    assert np.abs(found["upper_dot"]).max() < 4.0
    assert max(found.ratios.values()) < 10.0


def test_progress_is_reported_from_nothing_to_the_end():
    seen = []
    designed(max_iterations=3, progress=lambda stage, fraction: seen.append((stage, fraction)))
    assert seen == [("iteration 1", 1 / 3), ("iteration 2", 2 / 3), ("iteration 3", 1.0)]


# ---------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"limits": {"upper": 1.0}}, 'neither "lower" nor "lower_dot" has one'),
        ({"limits": LIMITS | {"elbow": 1.0}}, 'there is no quantity "elbow"; there are upper, lower, upper_dot'),
        ({"limits": LIMITS | {"upper": (1.0, 1.0)}}, r'"upper" is \(1.0, 1.0\); give a positive number, or'),
        ({"limits": LIMITS | {"upper": "wide"}}, "\"upper\" is 'wide'; give a positive number"),
        ({"limits": LIMITS | {"upper": (-1.0, np.inf)}}, "give a coordinate two finite limits, or none"),
        ({"limits": LIMITS | {"upper_dot": (1.0, 2.0)}}, "the motion is at rest at both ends: include zero"),
        ({"noise": {"torque": 1.0}}, 'noise: there is no signal "torque"'),
        ({"noise": {"upper_torque": 0.0}}, 'noise: "upper_torque" is 0.0; give a positive standard deviation'),
        ({"noise": {"upper_torque": 1.0}}, "no signal with noise is in the equation of lower_ddot"),
        ({"duration": 1.0}, "1 s are 1 periods of 1 Hz, the highest frequency; give 2 or more"),
        ({"harmonics": 3}, "harmonics is 3; give a whole number of at least 4"),
        ({"frequency": -1.0}, "frequency is -1.0"),
        ({"outputs": lambda q, v, a, u, p: {"upper": q.upper}}, '"upper" must be one expression, and have a name that'),
        ({"outputs": lambda q, v, a, u, p: [q.upper]}, "return a mapping from names to expressions"),
    ],
)
def test_arguments_without_meaning_are_refused_by_name(changes, message):
    with pytest.raises(dr.SettingsError, match=message):
        designed(**changes)


def test_machines_that_cannot_follow_any_motion_are_refused():
    with pytest.raises(dr.SettingsError, match="not fully actuated"):
        dr.design_experiment(ROTORCRAFT, limits={"x": 1.0, "z": 1.0, "theta": 1.0})


def test_an_arm_too_weak_for_its_weight_is_refused():
    with pytest.raises(dr.PlanningError, match=r"rests within its limits: nearest, at .* upper_torque is"):
        designed(limits=LIMITS | {"upper": (-0.3, 0.3), "upper_torque": 2.0})
