"""Noise: its distributions by Monte-Carlo intervals, its masks exactly, and effects that leave each other alone."""

import dataclasses
import pickle
from itertools import pairwise

import numpy as np
import pytest
from scipy import stats

from diransac.data import preprocessing as prepare
from diransac.data.log import Log
from diransac.data.readers import read_log
from diransac.errors import LogError, SettingsError
from diransac.flight.corruption import CorruptedLog, corrupt
from diransac.flight.noise import Noise
from diransac.model.library import planar_rotorcraft

N, DT = 4000, 0.01
T = np.arange(N) * DT
UNITS = {
    "x": "m",
    "x_dot": "m/s",
    "x_ddot": "m/s^2",
    "theta": "rad",
    "theta_dot": "rad/s",
    "theta_ddot": "rad/s^2",
    "thrust": "N",
}
SIGNALS = tuple(UNITS)[:-1]
OUTLIERS = Noise(outlier_probability=0.1, outlier_magnitude=80.0)
FAULTS = {
    "outliers": OUTLIERS,
    "bursts": Noise(burst_probability=0.01, outlier_magnitude=3.0),
    "frozen": Noise(stuck_probability=0.02),
    "dropouts": Noise(dropout_probability=0.01, dropout_length=5.0),
    "leverage": Noise(leverage_probability=0.5, leverage_offset=4.0, leverage_signal="thrust"),
    "no first row spared": Noise(outlier_probability=0.5, outlier_magnitude=1.0, first_row="corrupted"),
    "all": Noise(
        outlier_probability=0.05,
        outlier_magnitude=10.0,
        burst_probability=0.003,
        stuck_probability=0.003,
        dropout_probability=0.003,
        leverage_probability=0.2,
        leverage_offset=-2.0,
        leverage_signal="thrust",
    ),
}
# Chance of a false alarm of each Monte-Carlo interval; seeds are fixed, so what passes once passes always.
ALPHA = 1e-3


def flight(n=N, units=UNITS):
    t = np.arange(n) * DT
    signals = {
        "x": np.sin(2.0 * t),
        "x_dot": 2.0 * np.cos(2.0 * t),
        "x_ddot": -4.0 * np.sin(2.0 * t),
        "theta": 0.3 * np.sin(3.0 * t),
        "theta_dot": 0.9 * np.cos(3.0 * t),
        "theta_ddot": -2.7 * np.sin(3.0 * t),
        "thrust": 2.5 + np.sin(1.3 * t),
    }
    return Log.from_arrays(t, signals, units, 'log "a.csv"')


def same(a, b):
    return np.array_equal(a, b, equal_nan=True)


def differs(a, b):
    return (a != b) & ~(np.isnan(a) & np.isnan(b))


def errors(log, noise, seed=0, signals=None):
    corrupted = corrupt(log, noise, seed, signals=signals)
    return {name: corrupted[name] - log[name] for name in corrupted.fault_mask}


def in_binomial_interval(count, n, p):
    low, high = stats.binom.interval(1.0 - ALPHA, n, p)
    return low <= count <= high


def has_variance(sample, variance):
    low, high = stats.chi2.interval(1.0 - ALPHA, len(sample))
    return low <= np.sum(sample**2) / variance <= high


# ---------------------------------------------------------------------- what stays as it is


def test_no_noise_leaves_every_sample_as_it_is():
    log = flight()
    clean = corrupt(log, Noise(), seed=5)
    assert all(np.array_equal(clean[name], log[name]) for name in log.names)
    assert np.array_equal(clean.time, log.time)
    assert set(clean.fault_mask) == set(SIGNALS)
    assert not any(mask.any() for mask in clean.fault_mask.values())
    assert clean.notes == log.notes


def test_the_log_that_is_given_stays_as_it_is():
    log = flight()
    before = log.fingerprint
    corrupt(log, FAULTS["all"])
    assert dataclasses.replace(log).fingerprint == before
    assert log.history == ()


@pytest.mark.parametrize("noise", FAULTS.values(), ids=FAULTS)
def test_inputs_and_time_are_never_touched(noise):
    log = flight()
    corrupted = corrupt(log, noise)
    assert np.array_equal(corrupted["thrust"], log["thrust"])
    assert np.array_equal(corrupted.time, log.time)
    assert "thrust" not in corrupted.fault_mask


def test_history_and_notes_tell_what_was_done():
    corrupted = corrupt(flight(), OUTLIERS, seed=3)
    (step,) = corrupted.history
    assert step["step"] == "corrupt"
    assert step["seed"] == 3
    assert step["noise"] == {"outlier_probability": 0.1, "outlier_magnitude": 80.0}
    assert step["signals"] == list(SIGNALS)
    assert step["faults"]["x"] == corrupted.fault_mask["x"].sum()
    total = sum(int(mask.sum()) for mask in corrupted.fault_mask.values())
    assert corrupted.notes[-1] == f"corrupted by simulation (seed 3): {total} of {6 * N} samples have faults"


# ---------------------------------------------------------------------- which signals


def test_signals_are_told_from_inputs_by_their_names():
    columns = {"qw": T, "wx": T, "wx_dot": T, "x": T, "x_ddot": T, "z_dot": T, "torque": T, "rotor_speed": T}
    corrupted = corrupt(Log.from_arrays(T, columns), OUTLIERS)
    assert set(corrupted.fault_mask) == {"wx", "wx_dot", "x", "x_ddot", "z_dot"}


def test_signals_can_be_named():
    log = flight()
    corrupted = corrupt(log, OUTLIERS, signals=["thrust", "x"])
    assert set(corrupted.fault_mask) == {"thrust", "x"}
    assert corrupted.fault_mask["thrust"].any()
    assert np.array_equal(corrupted["x_dot"], log["x_dot"])


def test_a_log_without_derivatives_asks_for_names():
    log = Log.from_arrays(T, {"position": T, "force": T}, source="log 7")
    with pytest.raises(LogError, match=r"log 7: no name ends in _dot .* found position, force; .* signals="):
        corrupt(log, OUTLIERS)
    assert set(corrupt(log, OUTLIERS, signals=["position"]).fault_mask) == {"position"}


# ---------------------------------------------------------------------- Gaussian noise


@pytest.mark.parametrize("dt", [0.01, 0.002])
def test_gaussian_noise_has_the_stated_variance_at_every_order(dt):
    n = 20_000
    zero = Log.from_arrays(np.arange(n) * dt, dict.fromkeys(UNITS, np.zeros(n)), UNITS)
    found = errors(zero, Noise(acceleration_std=2.5, rate_std=0.4, first_row="corrupted"), seed=1)
    stds = {
        "x_ddot": 2.5,
        "x_dot": 2.5 * dt,
        "x": 2.5 * dt**2 / 2.0,
        "theta_dot": 0.4,
        "theta": 0.4 * dt,
        "theta_ddot": 0.4 / dt,
    }
    for name, std in stds.items():
        assert has_variance(found[name], std**2), name
        assert stats.kstest(found[name] / std, "norm").pvalue > ALPHA, name
        # White: neighbours, and signals, know nothing of each other; 3.3 standard errors of a correlation.
        assert abs(np.corrcoef(found[name][1:], found[name][:-1])[0, 1]) < 3.3 / np.sqrt(n), name
    assert abs(np.corrcoef(list(found.values()))[np.triu_indices(6, 1)]).max() < 4.0 / np.sqrt(n)


def test_gaussian_noise_is_no_fault():
    corrupted = corrupt(flight(), Noise(acceleration_std=1.0, rate_std=1.0, quantisation=0.01))
    assert not any(mask.any() for mask in corrupted.fault_mask.values())


def test_acceleration_and_rate_noise_keep_to_their_signals():
    only_linear = errors(flight(), Noise(acceleration_std=1.0))
    assert {name for name, error in only_linear.items() if error.any()} == {"x", "x_dot", "x_ddot"}
    only_angular = errors(flight(), Noise(rate_std=1.0))
    assert {name for name, error in only_angular.items() if error.any()} == {"theta", "theta_dot", "theta_ddot"}
    no_angular_acceleration = errors(flight(), Noise(rate_std=1.0, angular_acceleration_std=0.0))
    assert {name for name, error in no_angular_acceleration.items() if error.any()} == {"theta", "theta_dot"}
    given = errors(flight(), Noise(angular_acceleration_std=3.0, first_row="corrupted"))
    assert {name for name, error in given.items() if error.any()} == {"theta_ddot"}
    assert has_variance(given["theta_ddot"], 9.0)


def test_gaussian_noise_is_converted_to_each_signals_unit():
    degrees = flight(units={**UNITS, "theta_dot": "deg/s", "x_ddot": "g"})
    noise = Noise(acceleration_std=1.0, rate_std=0.5)
    in_degrees, in_radians = errors(degrees, noise), errors(flight(), noise)
    assert np.allclose(in_degrees["theta_dot"], np.rad2deg(in_radians["theta_dot"]), rtol=1e-9, atol=1e-12)
    assert np.allclose(in_degrees["x_ddot"] * 9.80665, in_radians["x_ddot"], rtol=1e-9, atol=1e-12)


def test_gaussian_noise_needs_units_and_says_where_from():
    log = flight(units={})
    with pytest.raises(LogError, match=r'log "a.csv": signal "x" has no unit.*units=model.units'):
        corrupt(log, Noise(acceleration_std=1.0))
    with pytest.raises(LogError, match='"x" has the unit "V"'):
        corrupt(flight(units={**UNITS, "x": "V"}), Noise(rate_std=1.0))
    with_units = dataclasses.replace(log, units=planar_rotorcraft().units)
    assert errors(with_units, Noise(acceleration_std=1.0))["x_ddot"].any()
    assert corrupt(log, OUTLIERS).fault_mask["x"].any()  # outliers need none


def test_random_walk_integrates_the_very_errors_of_the_acceleration():
    log = Log.from_arrays(T, dict.fromkeys(UNITS, np.zeros(N)), UNITS)
    found = errors(
        log, Noise(acceleration_std=2.0, rate_std=0.3, integrated="random-walk", first_row="corrupted"), seed=2
    )
    walked = np.zeros((N, 3))
    v, x, angle = 0.0, 0.0, 0.0
    for k in range(N):
        walked[k] = v, x, angle
        x += DT * v + DT**2 / 2.0 * found["x_ddot"][k]
        v += DT * found["x_ddot"][k]
        angle += DT * found["theta_dot"][k]
    for name, values in zip(("x_dot", "x", "theta"), walked.T, strict=True):
        assert np.allclose(found[name], values, rtol=1e-9, atol=1e-13), name


def test_random_walk_spreads_with_the_square_root_of_time():
    log = Log.from_arrays(T[:401], dict.fromkeys(UNITS, np.zeros(401)), UNITS)
    noise = Noise(acceleration_std=2.0, integrated="random-walk")
    ends = np.array([errors(log, noise, seed, signals=["x_dot"])["x_dot"][[100, 400]] for seed in range(300)])
    for k, sample in zip((100, 400), ends.T, strict=True):
        # The first row's error is spared where it is recorded, not where it is integrated.
        assert has_variance(sample, (2.0 * DT) ** 2 * k)


# ---------------------------------------------------------------------- faults


@pytest.mark.parametrize("noise", FAULTS.values(), ids=FAULTS)
def test_the_fault_mask_is_exactly_where_the_log_differs_from_the_clean_one(noise):
    log = flight()
    corrupted = corrupt(log, noise, seed=11)
    for name in SIGNALS:
        assert np.array_equal(corrupted.fault_mask[name], differs(corrupted[name], log[name])), name
        assert corrupted.fault_mask[name].any(), name


def test_the_fault_mask_compares_with_what_would_have_been_recorded_without_faults():
    measuring = Noise(acceleration_std=0.3, rate_std=0.1, quantisation=0.001, delay=0.025)
    faults = dataclasses.asdict(FAULTS["all"])
    both = dataclasses.replace(FAULTS["all"], **measuring.changed)
    assert {**faults, **measuring.changed} == dataclasses.asdict(both)
    without, with_faults = corrupt(flight(), measuring), corrupt(flight(), both)
    for name in SIGNALS:
        assert np.array_equal(with_faults.fault_mask[name], differs(with_faults[name], without[name]))


@pytest.mark.parametrize("probability", [0.05, 0.1, 0.5])
def test_outliers_strike_each_sample_with_the_stated_probability(probability):
    corrupted = corrupt(flight(), Noise(outlier_probability=probability, outlier_magnitude=80.0), seed=4)
    masks = np.array([corrupted.fault_mask[name] for name in SIGNALS])
    for mask in masks:
        assert in_binomial_interval(mask[1:].sum(), N - 1, probability)
        assert in_binomial_interval((mask[1:-1] & mask[2:]).sum(), N - 2, probability**2)
    for a, b in pairwise(masks):
        assert in_binomial_interval((a & b)[1:].sum(), N - 1, probability**2)


def test_outliers_by_rows_strike_all_signals_of_a_row_each_by_its_own_size():
    by_row = Noise(outlier_probability=0.1, outlier_magnitude=80.0, outliers="rows")
    log, corrupted = flight(), corrupt(flight(), by_row, seed=4)
    masks = np.column_stack(list(corrupted.fault_mask.values()))
    assert (masks == masks[:, :1]).all()
    assert masks[:, 0].mean() == pytest.approx(0.1, abs=0.02)
    errors = [(corrupted[name] - log[name])[masks[:, 0]] for name in corrupted.fault_mask]
    assert np.abs(np.corrcoef(errors)[~np.eye(len(errors), dtype=bool)]).max() < 0.3


def test_outliers_are_uniform_between_plus_and_minus_the_magnitude():
    log = flight(20_000)
    corrupted = corrupt(log, OUTLIERS, seed=6)
    for name in SIGNALS:
        added = (corrupted[name] - log[name])[corrupted.fault_mask[name]]
        assert stats.kstest(added, stats.uniform(-80.0, 160.0).cdf).pvalue > ALPHA


def test_outliers_of_no_size_are_no_faults():
    corrupted = corrupt(flight(), Noise(outlier_probability=0.5, outlier_magnitude=0.0))
    assert not any(mask.any() for mask in corrupted.fault_mask.values())


def in_a_run(probability, length, row):
    """The chance that row lies in a run: one minus that of no start, as far back as the log reaches, lasting to it."""
    ago = np.arange(row + 1)
    return 1.0 - np.prod(1.0 - probability * (1.0 - 1.0 / length) ** ago)


@pytest.mark.parametrize(("probability", "length"), [(0.01, 1.0), (0.01, 10.0), (0.002, 100.0)])
def test_runs_start_and_last_as_stated(probability, length):
    noise = Noise(dropout_probability=probability, dropout_length=length)
    rows = [300, 1200, 2100, 3000]
    log = flight()
    hits = np.array([corrupt(log, noise, seed, signals=["x"]).fault_mask["x"] for seed in range(150)])
    assert not hits[:, 0].any()
    # Rows that far apart share no run but by a chance of exp(-9).
    for row in rows:
        assert in_binomial_interval(hits[:, row].sum(), len(hits), in_a_run(probability, length, row))
    # A start after a free row begins a run that is seen; every one of those rows is a trial of its own.
    free = ~hits[:, 1:-1]
    assert in_binomial_interval((free & hits[:, 2:]).sum(), free.sum(), probability)
    # A run goes on unless it ends and none starts.
    busy = hits[:, 1:-1]
    goes_on = 1.0 - (1.0 - probability) / length
    if length == 1.0:
        assert in_binomial_interval((busy & hits[:, 2:]).sum(), busy.sum(), goes_on)
    else:
        assert (busy & hits[:, 2:]).sum() / busy.sum() == pytest.approx(goes_on, abs=0.02)


def test_bursts_are_runs_of_outliers_each_of_its_own_size():
    log = flight(20_000)
    corrupted = corrupt(log, Noise(burst_probability=0.002, burst_length=30.0, outlier_magnitude=5.0), seed=1)
    mask = corrupted.fault_mask["x"]
    added = (corrupted["x"] - log["x"])[mask]
    assert mask.sum() > 500
    assert stats.kstest(added, stats.uniform(-5.0, 10.0).cdf).pvalue > ALPHA
    assert abs(np.corrcoef(added[1:], added[:-1])[0, 1]) < 3.3 / np.sqrt(len(added))


def test_frozen_samples_repeat_the_last_good_one():
    log = flight()
    corrupted = corrupt(log, Noise(stuck_probability=0.02, stuck_length=8.0))
    values, mask = corrupted["x"], corrupted.fault_mask["x"]
    last = log["x"][0]
    for k in range(N):
        if not mask[k]:
            last = log["x"][k]
        assert values[k] == last
    assert mask.sum() > 200


def test_a_frozen_sample_of_a_signal_that_rests_is_right_and_unmarked():
    staircase = np.floor(T)
    log = Log.from_arrays(T, {"x_dot": staircase})
    corrupted = corrupt(log, Noise(stuck_probability=0.05, stuck_length=20.0))
    mask = corrupted.fault_mask["x_dot"]
    assert np.array_equal(mask, corrupted["x_dot"] != staircase)
    assert 0 < mask.sum() < 0.3 * N  # of the rows, 63 % lie in runs


def test_dropouts_are_nan_and_those_that_were_missing_already_are_no_faults():
    holes = np.where(np.arange(N) % 10 == 3, np.nan, T)
    corrupted = corrupt(Log.from_arrays(T, {"x_dot": holes}), Noise(dropout_probability=0.02))
    mask = corrupted.fault_mask["x_dot"]
    assert mask.any()
    assert np.array_equal(np.isnan(corrupted["x_dot"]), np.isnan(holes) | mask)
    assert not (mask & np.isnan(holes)).any()


def test_runs_are_correlated_or_each_signal_has_its_own():
    noise = Noise(dropout_probability=0.01)
    apart = corrupt(flight(), noise).fault_mask
    together = corrupt(flight(), dataclasses.replace(noise, correlated=True)).fault_mask
    assert all(np.array_equal(together[name], together["x"]) for name in SIGNALS)
    assert len({apart[name].tobytes() for name in SIGNALS}) == len(SIGNALS)


@pytest.mark.parametrize("offset", [4.0, -4.0])
def test_leverage_strikes_high_inputs_only_and_to_one_side(offset):
    log = flight(20_000)
    noise = Noise(
        leverage_probability=0.5,
        leverage_offset=offset,
        leverage_signal="thrust",
        leverage_quantile=0.8,
        first_row="corrupted",
    )
    corrupted = corrupt(log, noise)
    high = log["thrust"] > np.sort(log["thrust"])[int(0.8 * 20_000)]
    for name in SIGNALS:
        mask = corrupted.fault_mask[name]
        assert not mask[log["thrust"] < np.sort(log["thrust"])[int(0.8 * 20_000) - 1]].any()
        assert in_binomial_interval(mask[high].sum(), high.sum(), 0.5)
        share = (corrupted[name] - log[name])[mask] / offset
        assert stats.kstest(share, "uniform").pvalue > ALPHA
        assert share.min() >= 0.0


def test_leverage_counts_an_input_by_its_size():
    log = Log.from_arrays(T, {"x_dot": T, "moment": np.where(np.arange(N) % 2, -3.0, 1.0) + T / 1000.0})
    mask = corrupt(log, Noise(leverage_probability=1.0, leverage_offset=1.0, leverage_signal="moment")).fault_mask[
        "x_dot"
    ]
    assert mask.any()
    assert (log["moment"][mask] < 0.0).all()


# ---------------------------------------------------------------------- the first row


def test_a_clean_first_row_is_spared_and_a_corrupted_one_is_not():
    everything = FAULTS["all"].changed | {
        "outlier_probability": 0.9,
        "acceleration_std": 1.0,
        "rate_std": 1.0,
        "leverage_quantile": 0.0,
    }
    log = flight(50)
    for seed in range(20):
        corrupted = corrupt(log, Noise(**everything, first_row="clean"), seed)
        assert all(corrupted[name][0] == log[name][0] for name in SIGNALS)
        assert not any(corrupted.fault_mask[name][0] for name in SIGNALS)
    first = [
        corrupt(log, Noise(outlier_probability=0.5, outlier_magnitude=1.0, first_row="corrupted"), seed)
        for seed in range(200)
    ]
    assert in_binomial_interval(sum(log.fault_mask["x"][0] for log in first), 200, 0.5)


def test_the_first_row_rule_changes_no_other_row():
    noise = dataclasses.replace(FAULTS["all"], acceleration_std=1.0, rate_std=0.1, stuck_probability=0.0)
    clean = corrupt(flight(), noise)
    hit = corrupt(flight(), dataclasses.replace(noise, first_row="corrupted"))
    assert all(same(clean[name][1:], hit[name][1:]) for name in SIGNALS)


# ---------------------------------------------------------------------- delay and quantisation


@pytest.mark.parametrize("delay", [0.02, 0.03, 0.035, 0.0149])
def test_delayed_signals_are_the_sine_of_an_earlier_time(delay):
    log = flight()
    late = corrupt(log, Noise(delay=delay))
    assert len(late) == N - int(np.ceil(delay / DT - 1e-9))
    # Linear interpolation of sin(2 t) errs by dt^2/8 max|x''| at most; none at whole samples.
    whole = abs(delay / DT - round(delay / DT)) < 1e-9
    assert abs(late["x"] - np.sin(2.0 * (late.time - delay))).max() < (1e-12 if whole else 4.0 * DT**2 / 8.0)
    assert np.array_equal(late["thrust"], log["thrust"][-len(late) :])
    assert not any(mask.any() for mask in late.fault_mask.values())


def test_a_delay_longer_than_the_log_says_so():
    with pytest.raises(LogError, match="leave no row"):
        corrupt(flight(), Noise(delay=100.0))


def test_quantisation_errs_by_half_a_step_at_most_and_leaves_what_is_not_named():
    log = flight()
    corrupted = corrupt(log, Noise(quantisation={"x": 0.05, "theta": 0.01}))
    for name, step in (("x", 0.05), ("theta", 0.01)):
        error = corrupted[name] - log[name]
        assert step / 2.0 * 0.9 < abs(error).max() <= step / 2.0 * (1.0 + 1e-12)
        assert np.allclose(corrupted[name] / step, np.rint(corrupted[name] / step), atol=1e-9)
    assert np.array_equal(corrupted["x_dot"], log["x_dot"])


def test_quantisation_by_one_number_is_a_fraction_of_each_range():
    log = flight()
    corrupted = corrupt(log, Noise(quantisation=2.0**-6))
    for name in SIGNALS:
        steps = np.diff(np.unique(corrupted[name]))
        assert np.allclose(steps, np.ptp(log[name]) * 2.0**-6, rtol=1e-9)


def test_outliers_come_after_quantisation():
    corrupted = corrupt(flight(), Noise(quantisation={"x": 0.1}, outlier_probability=0.2, outlier_magnitude=1.0))
    on_step = np.isclose(corrupted["x"] / 0.1, np.rint(corrupted["x"] / 0.1), atol=1e-9)
    assert on_step[~corrupted.fault_mask["x"]].all()
    assert not on_step[corrupted.fault_mask["x"]].any()


# ---------------------------------------------------------------------- seeds


def test_same_seed_same_log_other_seed_other_log():
    for noise in FAULTS.values():
        first, again, other = (corrupt(flight(), noise, seed) for seed in (7, 7, 8))
        assert first.fingerprint == again.fingerprint != other.fingerprint


def test_an_effect_that_is_switched_on_leaves_the_others_draws_alone():
    alone = corrupt(flight(), OUTLIERS)
    added = {name: alone[name] - flight()[name] for name in SIGNALS}
    for other in (
        Noise(acceleration_std=1e-3, rate_std=1e-3),
        Noise(stuck_probability=0.01),
        Noise(dropout_probability=0.01),
        Noise(burst_probability=0.01, outlier_magnitude=80.0),
        Noise(leverage_probability=0.5, leverage_offset=1.0, leverage_signal="thrust"),
        Noise(quantisation=1e-3),
    ):
        without = corrupt(flight(), other)
        both = corrupt(flight(), dataclasses.replace(other, **OUTLIERS.changed))
        for name in SIGNALS:
            untouched = ~without.fault_mask[name]
            difference = (both[name] - without[name])[untouched]
            assert np.allclose(difference, added[name][untouched], rtol=1e-9, atol=1e-12), (other, name)


def test_a_delay_leaves_the_draws_of_every_moment_alone():
    late, late_and_hit = corrupt(flight(), Noise(delay=0.05)), corrupt(flight(), Noise(delay=0.05, **OUTLIERS.changed))
    hit = corrupt(flight(), OUTLIERS)
    for name in SIGNALS:
        added = (hit[name] - flight()[name])[6:]
        assert np.allclose((late_and_hit[name] - late[name])[1:], added, rtol=1e-9, atol=1e-12)


def test_a_signal_that_is_left_out_leaves_the_others_draws_alone():
    noise = dataclasses.replace(FAULTS["all"], acceleration_std=1.0, rate_std=1.0)
    every, few = corrupt(flight(), noise), corrupt(flight(), noise, signals=["theta_dot", "x"])
    assert same(every["theta_dot"], few["theta_dot"])
    assert same(every["x"], few["x"])


# ---------------------------------------------------------------------- the log with its masks


def test_parts_of_the_log_have_the_masks_of_their_rows():
    corrupted = corrupt(flight(), OUTLIERS)
    for part, rows in (
        (corrupted[100:300], slice(100, 300)),
        (corrupted[::2], slice(None, None, 2)),
        (corrupted.between(1.0, 2.0), slice(100, 201)),
        (corrupted.split(0.25)[1], slice(1000, None)),
    ):
        assert isinstance(part, CorruptedLog)
        assert all(np.array_equal(part.fault_mask[name], corrupted.fault_mask[name][rows]) for name in SIGNALS)


def test_a_mask_follows_its_samples_through_preparation():
    corrupted = corrupt(flight(), OUTLIERS)
    scaled = prepare.scale(corrupted, {"x": 2.0})
    assert isinstance(scaled, CorruptedLog)
    assert set(scaled.fault_mask) == set(SIGNALS) - {"x"}
    swapped = prepare.rename(corrupted, {"x": "theta", "theta": "x", "q": "x_dot"})
    assert isinstance(swapped, CorruptedLog)
    for new, old in (("x", "theta"), ("theta", "x"), ("q", "x_dot")):
        assert np.array_equal(swapped.fault_mask[new], corrupted.fault_mask[old])
    for other_rows in (prepare.resample(corrupted, 50.0), prepare.shift(corrupted, {"thrust": 0.02})):
        assert type(other_rows) is Log
    assert type(prepare.despike(corrupted, SIGNALS)) is Log
    assert corrupted.history[0] in prepare.resample(corrupted, 50.0).history


def test_the_masks_are_read_only_copies():
    corrupted = corrupt(flight(), OUTLIERS)
    with pytest.raises(ValueError, match="read-only"):
        corrupted.fault_mask["x"][0] = True
    with pytest.raises(TypeError):
        corrupted.fault_mask["x"] = np.zeros(N, dtype=bool)


def test_masks_that_fit_no_signal_are_refused():
    log = flight()
    for fault_mask in ({"y": np.zeros(N, bool)}, {"x": np.zeros(3, bool)}, {"x": np.zeros(N)}):
        with pytest.raises(LogError, match='the mask "'):
            CorruptedLog.of(log, fault_mask)


def test_pickling_keeps_everything():
    corrupted = corrupt(flight(), FAULTS["all"])
    again = pickle.loads(pickle.dumps(corrupted))
    assert isinstance(again, CorruptedLog)
    assert again.fingerprint == corrupted.fingerprint
    assert (again.history, again.notes, dict(again.units)) == (
        corrupted.history,
        corrupted.notes,
        dict(corrupted.units),
    )
    assert all(np.array_equal(again.fault_mask[name], corrupted.fault_mask[name]) for name in SIGNALS)


def test_writing_writes_what_a_recorder_would_have(tmp_path):
    corrupted = corrupt(flight(), FAULTS["all"])
    corrupted.write(tmp_path / "a.csv")
    again = read_log(tmp_path / "a.csv")
    assert again.names == corrupted.names
    assert again.fingerprint == corrupted.fingerprint


def test_corrupting_again_joins_the_masks():
    once = corrupt(flight(), OUTLIERS, seed=1, signals=["x"])
    twice = corrupt(once, Noise(dropout_probability=0.01), seed=2, signals=["x", "x_dot"])
    assert np.array_equal(twice.fault_mask["x"], differs(twice["x"], flight()["x"]))
    assert np.array_equal(twice.fault_mask["x_dot"], differs(twice["x_dot"], flight()["x_dot"]))
    assert [step["seed"] for step in twice.history] == [1, 2]


def test_a_delay_carries_masks_along_and_spreads_them_where_it_mixes_samples():
    once = corrupt(flight(), OUTLIERS, signals=["x", "theta"])
    whole = corrupt(once, Noise(delay=0.03), signals=["x"])
    assert np.array_equal(whole.fault_mask["x"], once.fault_mask["x"][:-3])
    assert np.array_equal(whole.fault_mask["theta"], once.fault_mask["theta"][3:])
    half = corrupt(once, Noise(delay=0.025), signals=["x"])
    mask = once.fault_mask["x"]
    assert np.array_equal(half.fault_mask["x"], mask[1:-2] | mask[:-3])


# ---------------------------------------------------------------------- senseless arguments


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"outlier_probability": 1.1}, "outlier_probability is 1.1; give a number from 0 to 1"),
        ({"burst_probability": -0.1}, "burst_probability is -0.1"),
        ({"leverage_quantile": np.nan}, "leverage_quantile is nan"),
        ({"outlier_magnitude": -1.0}, "outlier_magnitude is -1.0; give a finite number from 0"),
        ({"acceleration_std": -0.1}, "acceleration_std is -0.1"),
        ({"rate_std": np.nan}, "rate_std is nan"),
        ({"rate_std": 10**400}, "rate_std is 1000"),
        ({"leverage_offset": -np.inf}, "leverage_offset is -inf"),
        ({"rate_std": "0.1"}, "rate_std is '0.1'"),
        ({"outlier_probability": True}, "outlier_probability is True"),
        ({"outliers": "columns"}, "outliers is 'columns'; choose 'signals' or 'rows'"),
        ({"angular_acceleration_std": np.inf}, "angular_acceleration_std is inf"),
        ({"stuck_length": 0.5}, "stuck_length is 0.5; give a finite number from 1, samples"),
        ({"delay": -0.01}, "delay is -0.01"),
        ({"quantisation": -1.0}, "quantisation is -1.0"),
        ({"quantisation": {"x": -1.0}}, "quantisation of 'x' is -1.0"),
        ({"first_row": "spared"}, "first_row is 'spared'; choose 'clean' or 'corrupted'"),
        ({"integrated": "pink"}, "integrated is 'pink'; choose 'white' or 'random-walk'"),
        ({"correlated": "both"}, "correlated is 'both'; give True or False"),
        ({"leverage_probability": 0.1}, "no leverage_signal is named"),
        ({"leverage_signal": 3}, "leverage_signal is 3"),
    ],
)
def test_noise_without_meaning_is_refused(wrong, message):
    with pytest.raises(SettingsError, match=message):
        Noise(**wrong)


def test_arguments_without_meaning_are_refused():
    log = flight()
    with pytest.raises(LogError, match='signal "y" is missing; found t, x'):
        corrupt(log, OUTLIERS, signals=["x", "y"])
    with pytest.raises(LogError, match='signal "speed" is missing'):
        corrupt(log, Noise(leverage_probability=0.1, leverage_offset=1.0, leverage_signal="speed"))
    for arguments, message in (
        ((log, OUTLIERS, 1.5), "seed is 1.5; give a whole number"),
        ((log, OUTLIERS, True), "seed is True"),
        ((log, 0.1), "noise is a float; give a Noise"),
        (([1, 2], OUTLIERS), "log is a list; give a Log"),
        ((log, Noise(quantisation={"thrust": 0.1})), 'quantisation names "thrust"'),
    ):
        with pytest.raises(SettingsError, match=message):
            corrupt(*arguments)
    with pytest.raises(SettingsError, match='signals is the text "x"'):
        corrupt(log, OUTLIERS, signals="x")
    with pytest.raises(SettingsError, match='"t", the time'):
        corrupt(log, OUTLIERS, signals=["t"])
