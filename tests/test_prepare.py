"""Preparation: every step against what was planted, and derivatives against truth."""

import json
from pathlib import Path

import numpy as np
import pytest
import scipy.ndimage
from hypothesis import given
from hypothesis import strategies as st

from diransac.data import filters
from diransac.data import preprocessing as prepare
from diransac.data.filters import half_length, kernels
from diransac.data.log import Log
from diransac.data.preprocessing.differentiation import choose_bandwidth
from diransac.data.readers import read_log
from diransac.errors import LogError, SettingsError
from diransac.model import Model, Parameter
from diransac.model.library.drives import servo_axis

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
N = 400
T = np.arange(N) * 0.01


def log_of(units=None, **signals):
    n = len(next(iter(signals.values())))
    return Log.from_arrays(np.arange(n) * 0.01, signals, units, 'log "a.csv"')


def added(before, after):
    """The steps that a preparation added to the history, which JSON must hold."""
    steps = after.history[len(before.history) :]
    assert json.loads(json.dumps(steps)) == list(steps)
    return steps


# ---------------------------------------------------------------------- names, factors


def test_rename_moves_signals_and_units():
    log = log_of({"q": "m"}, q=T, u=2 * T)
    new = prepare.rename(log, {"x": "q"})
    assert new.names == ("x", "u")
    assert new.units == {"x": "m"}
    assert np.array_equal(new["x"], T)
    assert added(log, new) == ({"step": "rename", "names": {"x": "q"}},)
    with pytest.raises(LogError, match='no column "y" to call "x"; found q, u'):
        prepare.rename(log, {"x": "y"})
    with pytest.raises(LogError, match="there is a column of that name"):
        prepare.rename(log, {"u": "q"})


def test_scale_multiplies_and_drops_the_unit_that_no_longer_holds():
    log = log_of({"q": "deg", "u": "N"}, q=T, u=T)
    new = prepare.scale(log, {"q": np.pi / 180, "u": -1})
    assert np.allclose(new["q"], np.deg2rad(T), rtol=1e-15)
    assert np.array_equal(new["u"], -T)
    assert new.units == {"u": "N"}
    assert added(log, new) == ({"step": "scale", "factors": {"q": np.pi / 180, "u": -1.0}},)
    with pytest.raises(LogError, match='"y" is missing'):
        prepare.scale(log, {"y": 2.0})
    with pytest.raises(SettingsError, match="finite factor other than 0"):
        prepare.scale(log, {"q": np.nan})


# ---------------------------------------------------------------------- time


@pytest.mark.parametrize("rate", [37.0, 100.0, 250.0, "median"])
def test_resample_is_exact_for_straight_lines(rate):
    log = log_of(x=3 * T - 1)
    new = prepare.resample(log, rate)
    assert np.allclose(new["x"], 3 * new.time - 1, atol=1e-12)
    assert 1 / new.dt == pytest.approx(100.0 if rate == "median" else rate, rel=1e-9)
    assert new.time[-1] <= log.time[-1] + 1e-9
    (step,) = added(log, new)
    assert (step["step"], step["rows"]) == ("resample", [N, len(new)])


def test_resample_at_the_same_rate_keeps_every_sample_and_every_hole():
    x = np.sin(T)
    x[[5, 6, 200]] = np.nan
    new = prepare.resample(log_of(x=x), 100.0)
    assert np.allclose(new["x"], x, atol=1e-12, equal_nan=True)


@pytest.mark.parametrize("rate", [1e7, 1e12, 1e308])
def test_resample_refuses_more_rows_than_fit_before_it_makes_them(rate):
    with pytest.raises(LogError, match=r"would make .* rows; at most 10,000,000 are made: give a lower rate"):
        prepare.resample(log_of(x=T), rate)


def test_resample_says_what_it_folds():
    new = prepare.resample(log_of(x=T), 20.0)
    assert new.notes[-1] == "no filter went before it: motion and noise above 10 Hz now appear below"


@given(st.floats(-0.5, 0.5))
def test_shift_by_any_delay_moves_a_straight_line_exactly(delay):
    log = log_of(u=2 * T + 1, x=T)
    new = prepare.shift(log, {"u": delay})
    assert np.allclose(new["u"], 2 * (new.time - delay) + 1, atol=1e-9)
    assert np.allclose(new["x"], new.time, atol=1e-12)
    assert len(new) >= N - abs(delay) / 0.01 - 1 - 1e-6
    assert added(log, new) == ({"step": "shift", "delays": {"u": delay}},)


def test_shift_by_whole_samples_interpolates_nothing():
    u = np.random.default_rng(0).normal(size=N)
    new = prepare.shift(log_of(u=u), {"u": 0.03})
    assert np.array_equal(new["u"], u[:-3])
    assert new.notes == ("3 rows cut at the ends, which delayed signals do not cover",)


def test_shift_refuses_what_leaves_nothing():
    with pytest.raises(LogError, match="leave no row"):
        prepare.shift(log_of(u=T), {"u": 5.0})
    with pytest.raises(SettingsError, match="give seconds"):
        prepare.shift(log_of(u=T), {"u": np.nan})
    with pytest.raises(LogError, match='"y" is missing'):
        prepare.shift(log_of(u=T), {"y": 0.1})


# ---------------------------------------------------------------------- spikes, angles


def test_despike_finds_the_planted_spikes_and_nothing_else():
    rng = np.random.default_rng(1)
    clean = np.sin(2 * np.pi * T) + 0.01 * rng.normal(size=N)
    planted = np.sort(rng.choice(N, 20, replace=False))
    x = clean.copy()
    x[planted] += rng.choice([-1, 1], 20) * rng.uniform(2.0, 80.0, 20)
    log = log_of(x=x, y=x)
    new = prepare.despike(log, ["x"])
    assert np.array_equal(np.flatnonzero(new["x"] != x), planted)
    assert np.abs(new["x"] - clean)[planted].max() < 0.3
    assert np.array_equal(new["y"], x)
    assert added(log, new) == ({"step": "despike", "window": 15, "threshold": 8.0, "replaced": {"x": 20}},)
    assert new.notes == ('20 of 400 samples of "x" were spikes and are replaced',)


def resting_encoder():
    return 1e-4 * np.round(3 * np.sin(T) + 0.2 * np.random.default_rng(0).normal(size=N))


@pytest.mark.parametrize(
    "x",
    [
        np.zeros(N),
        np.where(T > 2, 5.0, 0.0),
        resting_encoder(),
        4.0 * T,
        np.sign(np.sin(7 * T + 1)),
        np.full(N, np.nan),
    ],
    ids=["rest", "step", "encoder", "ramp", "square wave", "nothing"],
)
def test_despike_leaves_alone_what_has_no_spikes(x):
    assert not prepare.hampel(x)[0].any()


def test_despike_finds_a_spike_in_rest_and_an_infinity_and_skips_holes():
    x = np.full(N, 2.0)
    x[[50, 300]] = 7.0, np.inf
    x[100:130] = np.nan
    new = prepare.despike(log_of(x=x))
    assert np.array_equal(np.isnan(new["x"]), np.isnan(x))
    assert np.array_equal(new["x"][~np.isnan(x)], np.full(N - 30, 2.0))


@pytest.mark.parametrize(("window", "threshold"), [(4, 8.0), (1, 8.0), (15, 0.0), (15, np.nan)])
def test_despike_refuses_a_window_without_a_middle(window, threshold):
    with pytest.raises(SettingsError, match="odd window"):
        prepare.despike(log_of(x=T), window=window, threshold=threshold)


@pytest.mark.parametrize("n", [2, 5, 200])
def test_hampel_gives_the_median_of_every_window_and_takes_signals_one_by_one(n):
    x = np.random.default_rng(n).normal(size=(n, 3)).cumsum(axis=0)
    x[n // 2] += 100.0, 0.0, -100.0
    mask, median = prepare.hampel(x, 5, 8.0)
    padded = np.pad(x, ((2, 2), (0, 0)), mode="reflect") if n > 2 else np.pad(x, ((1, 1), (0, 0)), mode="reflect")
    width = len(padded) - n + 1
    assert np.array_equal(median, [np.median(padded[i : i + width], axis=0) for i in range(n)])
    for k in range(3):
        alone = prepare.hampel(x[:, k], 5, 8.0)
        assert np.array_equal(mask[:, k], alone[0])
        assert np.array_equal(median[:, k], alone[1])
    assert n < 200 or mask[n // 2].tolist() == [True, False, True]


@pytest.mark.parametrize(("turn", "unit"), [(2 * np.pi, "rad"), (360.0, "deg"), (2 * np.pi, None)])
def test_unwrap_gives_back_the_angle_that_was_wrapped(turn, unit):
    angle = turn * (0.3 * T**2 - 0.2)
    wrapped = (angle + turn / 2) % turn - turn / 2
    wrapped[77] = np.nan
    log = log_of({"x": unit} if unit else None, x=wrapped)
    new = prepare.unwrap(log, ["x"])
    kept = np.arange(N) != 77
    assert np.allclose(new["x"][kept], angle[kept], atol=1e-9 * turn)
    assert np.isnan(new["x"][77])
    assert added(log, new)[0]["step"] == "unwrap"


@pytest.mark.parametrize("size", [80.0, 3.3])
def test_unwrap_leaves_outliers_alone(size):
    x = np.sin(T)
    x[[50, 120, 200]] += size * np.array([1, -1, 1])
    log = log_of(x=x)
    assert prepare.unwrap(log, ["x"]) is log


# ---------------------------------------------------------------------- filters


@pytest.mark.parametrize("bandwidth", [0.5, 2.0, 10.0, 33.3])
def test_kernels_are_exact_for_polynomials(bandwidth):
    L = half_length(bandwidth, 0.01)
    t = np.arange(-L, L + 1) * 0.01
    smooth, first, second = kernels(bandwidth, 0.01)
    scale = L * 0.01
    for k, (value, slope, curvature) in enumerate([(1, 0, 0), (0, 1, 0), (None, 0, 2), (None, None, 0)]):
        x = (-t) ** k
        assert value is None or (smooth @ x) / scale**k == pytest.approx(value / scale**k, abs=1e-12)
        assert slope is None or (first @ x) / scale ** (k - 1) == pytest.approx(slope / scale ** (k - 1), abs=1e-9)
        assert (second @ x) / scale ** (k - 2) == pytest.approx(curvature / scale ** (k - 2), abs=1e-9)


def test_kernels_pass_and_stop_what_they_promise():
    response = np.abs(np.fft.rfft(kernels(5.0, 0.01)[0], 4096))
    f = np.fft.rfftfreq(4096, 0.01)
    assert np.abs(response[f < 2.5] - 1).max() < 2e-4
    assert response[f > 7.5].max() < 2e-4
    assert np.interp(5.0, f, response) == pytest.approx(0.5, abs=1e-3)


# ---------------------------------------------------------------------- bandwidth


def noisy_motion(seed=0, n=8000, dt=0.005, noise=1e-4, colour=0.0):
    """Motion to 3 Hz that falls off quickly, and noise whose power falls with frequency to the given power."""
    rng = np.random.default_rng(seed)
    f = np.fft.rfftfreq(n, dt)
    white = rng.normal(size=(2, len(f))) + 1j * rng.normal(size=(2, len(f)))
    motion = np.fft.irfft(white[0] / (1 + (f / 3.0) ** 6), n)
    rest = np.fft.irfft(white[1] / np.maximum(f / f[-1], 1e-3) ** (colour / 2), n)
    return motion / motion.std() + noise * rest / rest.std()


@pytest.mark.parametrize("colour", [0.0, 1.0, 2.0])
def test_bandwidth_lies_where_the_motion_is_a_few_times_its_noise(colour):
    n, dt, noise = 8000, 0.005, 1e-4
    values = [choose_bandwidth([(noisy_motion(seed, colour=colour), 2)], dt).value for seed in range(10)]
    clean = noisy_motion(0, noise=0.0)
    spectrum = np.abs(np.fft.rfft(clean * np.hanning(n))) ** 2
    total = np.abs(np.fft.rfft((noisy_motion(0, noise=noise, colour=colour) - clean) * np.hanning(n))) ** 2
    f = np.fft.rfftfreq(n, dt)

    def signal_to_noise(bandwidth):
        near = (f > bandwidth / 1.2) & (f < bandwidth * 1.2)
        return spectrum[near].sum() / total[near].sum()

    assert np.std(values) < 0.15 * np.mean(values)
    assert 3.0 < signal_to_noise(np.mean(values)) < 1000.0


@given(factor=st.floats(1e-6, 1e6), offset=st.floats(-1e3, 1e3), seconds=st.floats(1e-3, 1e3))
def test_bandwidth_knows_neither_units_nor_clocks(factor, offset, seconds):
    x = noisy_motion(3)
    reference = choose_bandwidth([(x, 2)], 0.005).value
    assert choose_bandwidth([(factor * (x + offset), 2)], 0.005 * seconds).value * seconds == pytest.approx(reference)


def test_bandwidth_of_a_velocity_is_that_of_its_position():
    x = noisy_motion(4, noise=0.0) + 0.0
    v = np.gradient(x, 0.005) + 1e-2 * np.random.default_rng(0).normal(size=len(x))
    position = np.cumsum(v) * 0.005
    found = [choose_bandwidth([(s, k)], 0.005).value for s, k in ((position, 2), (v, 1))]
    assert found[0] == pytest.approx(found[1], rel=0.1)


def test_bandwidth_is_the_lowest_of_the_motions_that_stand_out():
    slow, fast = noisy_motion(0, noise=1e-2), noisy_motion(1, noise=1e-5)
    still, blind = np.zeros(8000), np.random.default_rng(2).normal(size=8000)
    expected = choose_bandwidth([(slow, 2)], 0.005)
    assert choose_bandwidth([(slow, 2), (fast, 2), (still, 2)], 0.005) == expected
    assert expected.value < choose_bandwidth([(fast, 2)], 0.005).value
    assert choose_bandwidth([(still, 2)], 0.005).value == pytest.approx(20.0)
    assert choose_bandwidth([(blind, 2)], 0.005).noise_share > 0.05


# ---------------------------------------------------------------------- derivatives


def axis_log(x, dt=0.01, **more):
    return Log.from_arrays(
        np.arange(len(x)) * dt, {"position": x, "force": np.zeros(len(x)), **more}, {"position": "m"}
    )


@pytest.mark.parametrize("bandwidth", [4.0, 8.0, 16.0, 33.0])
def test_derivatives_of_a_sine_are_the_analytic_ones(bandwidth):
    w, t = 2 * np.pi * 1.3, np.arange(1000) * 0.01
    log = axis_log(5.0 + np.sin(w * t), extra=t)
    new = prepare.differentiate(log, servo_axis(), bandwidth)
    assert np.allclose(new["position"], 5 + np.sin(w * new.time), atol=5e-4)
    assert np.allclose(new["position_dot"], w * np.cos(w * new.time), atol=5e-4 * w)
    assert np.allclose(new["position_ddot"], -(w**2) * np.sin(w * new.time), atol=2e-3 * w**2)
    assert np.array_equal(new["extra"], new.time)
    assert new.units == {"position": "m", "position_dot": "m/s", "position_ddot": "m/s^2"}


def test_differentiate_records_and_says_what_it_did():
    x = np.sin(2 * np.pi * np.arange(1000) * 0.01)
    log = axis_log(x)
    new = prepare.differentiate(log, servo_axis(), 5.0)
    (step,) = added(log, new)
    cut = half_length(20.0, 0.01)
    assert step == {
        "step": "differentiate",
        "bandwidth": 5.0,
        "chosen": False,
        "noise_share": None,
        "derivation_bandwidth": 20.0,
        "row_filter": 5.0,
        "derived": {"position_dot": "position", "position_ddot": "position"},
        "filtered": ["position", "force"],
        "rows_cut": cut,
    }
    assert len(new) == 1000 - 2 * cut
    assert new.time[0] == log.time[cut]
    assert new.notes == ("derived position_dot, position_ddot; filtered at 5 Hz (given), 0.13 s cut at either end",)


def test_differentiate_says_when_noise_is_strong():
    x = noisy_motion(0, n=2000, noise=0.5)
    x[::50] += 40.0
    new = prepare.differentiate(axis_log(x), servo_axis())
    assert "of the accelerations' power" in new.notes[-1]
    assert 0.05 < new.history[-1]["noise_share"] <= 1.0


def test_a_measured_velocity_is_kept_and_gives_the_acceleration():
    t = np.arange(1000) * 0.01
    log = axis_log(np.zeros(1000), position_dot=np.sin(t))
    new = prepare.differentiate(log, servo_axis(), 10.0)
    assert np.allclose(new["position_dot"], np.sin(new.time), atol=1e-3)
    assert np.allclose(new["position_ddot"], np.cos(new.time), atol=1e-3)
    assert new.history[-1]["derived"] == {"position_ddot": "position_dot"}


def test_short_gaps_are_bridged_and_long_ones_stay_holes():
    t = np.arange(2000) * 0.01
    x = np.sin(t)
    x[[300, 700, 701]] = np.nan
    x[1200:1300] = np.nan
    new = prepare.differentiate(axis_log(x), servo_axis(), 8.0)
    reach = half_length(32.0, 0.01)
    hole = (new.time > (1199.5 - reach) * 0.01) & (new.time < (1299.5 + reach) * 0.01)
    assert np.array_equal(np.isnan(new["position_ddot"]), hole)
    assert np.array_equal(np.isnan(new["position"]), hole)
    assert not np.isnan(new["force"]).any()
    assert np.allclose(new["position_dot"][~hole], np.cos(new.time)[~hole], atol=2e-3)


def test_wrapped_angles_are_unwrapped_before_they_are_derived():
    pendulum = Model(
        "pendulum", {"q": "rad"}, {"u": "N m"}, {"J": Parameter("kg m^2")}, lambda *x: [x[4].J * x[2].q - x[3].u]
    )
    t = np.arange(1000) * 0.01
    log = Log.from_arrays(t, {"q": (3 * t + np.pi) % (2 * np.pi) - np.pi, "u": 0 * t})
    new = prepare.differentiate(log, pendulum, 10.0)
    assert np.allclose(new["q_dot"], 3.0, atol=1e-6)
    assert [step["step"] for step in new.history] == ["unwrap", "differentiate"]


def rigid_body():
    """A body that spins about one axis: its velocity is no derivative of a coordinate, and two of these keep a norm."""
    return Model(
        "body",
        {"qw": "1", "qx": "1", "qy": "1", "qz": "1"},
        {"tx": "N m"},
        {"J": Parameter("kg m^2"), "D": Parameter("N m s/rad")},
        lambda q, v, a, u, p: [p.J * a.wx + p.D * v.wx - u.tx + 0 * q.qw],
        velocities={"wx": "rad/s"},
        kinematics=lambda q, v: [-q.qx * v.wx / 2, q.qw * v.wx / 2, q.qz * v.wx / 2, -q.qy * v.wx / 2],
    )


def test_coordinates_that_may_jump_pass_no_filter_and_rates_give_the_acceleration():
    t = np.arange(1000) * 0.01
    attitude = {"qw": np.sign(np.cos(50 * t)), "qx": 0 * t, "qy": 0 * t, "qz": 0 * t}
    log = Log.from_arrays(t, {**attitude, "wx": np.sin(t), "tx": np.cos(t)})
    new = prepare.differentiate(log, rigid_body(), 10.0)
    assert np.allclose(new["wx_dot"], np.cos(new.time), atol=1e-3)
    assert set(np.unique(new["qw"])) <= {-1.0, 0.0, 1.0}


def test_what_cannot_be_derived_is_refused_by_name():
    t = np.arange(1000) * 0.01
    with pytest.raises(
        LogError, match=r'"wx" is missing and cannot be derived: model "body" has velocities .* Give it'
    ):
        prepare.differentiate(Log.from_arrays(t, {"qw": t, "tx": t}), rigid_body())
    with pytest.raises(LogError, match='"position_dot" is missing, and so is "position", its source; found t, force'):
        prepare.differentiate(Log.from_arrays(t, {"force": t}), servo_axis())
    with pytest.raises(LogError, match='"position" is infinite at row 3'):
        prepare.differentiate(axis_log(np.where(np.arange(1000) == 3, np.inf, t)), servo_axis())


@pytest.mark.parametrize("bandwidth", [0.0, -1.0, np.nan, np.inf, 40.0])
def test_a_bandwidth_beyond_the_rate_is_refused(bandwidth):
    with pytest.raises(SettingsError, match=r"has no meaning at 100 Hz; give up to 33.33 Hz"):
        prepare.differentiate(axis_log(np.sin(T)), servo_axis(), bandwidth)


def test_a_log_too_short_for_the_bandwidth_is_refused():
    with pytest.raises(LogError, match=r"4 s are too short to be filtered at 1 Hz, which takes 5 s"):
        prepare.differentiate(axis_log(np.sin(T)), servo_axis(), 1.0)


# ---------------------------------------------------------------------- rows of a regression


def differentiated():
    return prepare.differentiate(axis_log(np.sin(np.arange(1000) * 0.01)), servo_axis(), 5.0)


def test_filtered_rows_of_true_equations_are_true_equations():
    rng = np.random.default_rng(0)
    log = differentiated()
    W, p = rng.normal(size=(len(log), 2, 3)), rng.normal(size=3)
    b = W @ p
    valid = rng.random(len(log)) > 0.1
    W[~valid, 0, 1] = np.nan
    Wf, bf = (prepare.filter_rows(log.filter, log.dt, x, valid) for x in (W, b))
    assert np.allclose((Wf @ p)[valid], bf[valid], atol=1e-12)
    assert np.isnan(bf[~valid]).all()
    assert Wf[valid].std() < 0.5 * W[valid].std()
    assert np.array_equal(prepare.filter_rows(log.filter, log.dt, W), Wf, equal_nan=True)


def test_rows_and_inputs_of_a_log_with_measured_accelerations_are_left_alone():
    log = log_of(x=T)
    W = np.random.default_rng(0).normal(size=(N, 2))
    assert prepare.filter_rows(log.filter, log.dt, W) is W
    assert prepare.acting_inputs(log.filter, W) is W


def test_acting_inputs_are_those_of_a_held_sine_in_the_mean():
    log = differentiated()
    k = np.arange(len(log))
    for f in (0.01, 0.05, 0.1):
        acting = prepare.acting_inputs(log.filter, np.sin(2 * np.pi * f * k)[:, None])[:, 0]
        exact = np.sinc(f) * np.sin(2 * np.pi * f * (k - 0.5))
        assert np.abs(acting - exact)[2:-2].max() < 2.0 * (f * 2 * np.pi) ** 4 / 100.0


# ---------------------------------------------------------------------- the whole chain, truth known


def fit_axis(log, bandwidth=None):
    """Mass, viscous and dry friction and offset by least squares from position and force alone."""
    log = prepare.differentiate(log, servo_axis(), bandwidth)
    v, u = log["position_dot"], prepare.acting_inputs(log.filter, log["force"][:, None])
    W = np.column_stack([log["position_ddot"], v, np.sign(v), np.ones_like(v)])
    rows = prepare.filter_rows(log.filter, log.dt, np.column_stack([W, u]))
    return np.linalg.lstsq(rows[:, :4], rows[:, 4], rcond=None)[0], log.history[-1]["bandwidth"]


TRUE = np.array([95.0, 200.0, 20.0, -3.0])


def drive(dt, count, noise, gain, seconds, n_steps=10):
    """An axis with dry friction that sticks, under a held PD force, its position quantised and noisy."""
    rng = np.random.default_rng(0)
    M, Fv, Fc, F0 = TRUE
    t = np.arange(round(seconds / dt)) * dt
    wave = sum(np.sin(2 * np.pi * f * t + k) for k, f in enumerate((0.2, 0.53, 1.1)))
    reference = np.clip(0.05 * wave, -0.08, 0.08)
    slope = np.gradient(reference, dt)
    x = v = before = 0.0
    position, force, h = np.empty(len(t)), np.empty(len(t)), dt / n_steps
    for k in range(len(t)):
        measured = x + noise * rng.standard_normal()
        measured = count * round(measured / count) if count else measured
        u = 2e4 * gain * (reference[k] - measured) + 2e3 * gain * (slope[k] - (measured - before) / dt)
        position[k], force[k], before = measured, u, measured
        for _ in range(n_steps):
            drag = u - F0 - Fv * v
            new = v + h * (drag - Fc * np.sign(v if v else drag)) / M if v or abs(drag) > Fc else 0.0
            new = 0.0 if v * new < 0.0 else new
            x, v = x + h * (v + new) / 2.0, new
    return Log.from_arrays(t, {"position": position, "force": force})


@pytest.mark.parametrize(
    ("log", "tolerance"),
    [
        ({"dt": 1e-3, "count": 1e-6, "noise": 0.0, "gain": 1.0}, (0.005, 0.01, 0.02)),
        ({"dt": 1e-3, "count": 1e-4, "noise": 0.0, "gain": 0.25}, (0.01, 0.01, 0.03)),
        ({"dt": 1e-3, "count": 0.0, "noise": 1e-5, "gain": 0.5}, (0.01, 0.01, 0.03)),
        ({"dt": 1e-2, "count": 1e-5, "noise": 0.0, "gain": 0.25}, (0.01, 0.02, 0.05)),
    ],
    ids=["fine encoder", "coarse encoder", "noise", "slow sampling"],
)
def test_an_axis_is_identified_from_position_and_force_alone(log, tolerance):
    parameters, _ = fit_axis(drive(**log, seconds=15.0))
    assert (np.abs(parameters / TRUE - 1)[:3] < tolerance).all(), parameters


EMPS = np.array([95.1089, 203.5034, 20.3935, -3.1648])


def test_the_real_axis_agrees_with_what_was_published_at_any_bandwidth():
    path = DATA / "emps" / "DATA_EMPS.csv"
    if not path.exists():
        pytest.skip(f"the real logs are not here: {path} is missing")
    log = read_log(path, rename={"t": "t_s", "position": "q_m", "force": "force_N"})
    _, chosen = fit_axis(log)
    for bandwidth in (0.5 * chosen, chosen, 2.0 * chosen):
        parameters, _ = fit_axis(log, bandwidth)
        assert (np.abs(parameters / EMPS - 1) < (0.01, 0.05, 0.05, 0.05)).all(), (bandwidth, parameters)


@pytest.mark.parametrize("size", [3, 5, 31])
@pytest.mark.parametrize("kind", [float, bool, int])
def test_the_median_filter_is_that_of_scipy_whatever_the_number_of_rows_at_a_time(
    size: int, kind: type, monkeypatch: pytest.MonkeyPatch
):
    values = (3.0 * np.random.default_rng(0).normal(size=(500, 2))).astype(kind)
    expected = scipy.ndimage.median_filter(values, size=(size, 1), mode="mirror")
    monkeypatch.setattr(filters, "_ROWS_AT_A_TIME", 64)
    found = filters.median_filter(values, size)
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)
