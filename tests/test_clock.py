"""Logs on their own grid: planted losses, jitter, drift, repeated and swapped stamps, and what has no grid."""

import numpy as np
import pytest

from diransac.data.clock import on_own_grid, runs_freely
from diransac.errors import LogError

N, DT = 3000, 0.002


def gridded(stamps, values=None):
    values = np.arange(len(stamps), dtype=float) if values is None else values
    return on_own_grid(np.asarray(stamps, float), {"x": np.asarray(values, float)}, "log")


@pytest.mark.parametrize("jitter", [0.0, 0.03, 0.15, 0.33])
@pytest.mark.parametrize("drift", [0.0, 2e-4])
@pytest.mark.parametrize("seed", range(3))
def test_planted_losses_are_found_exactly_whatever_jitter_and_drift(seed, jitter, drift):
    rng = np.random.default_rng(seed)
    k = np.arange(N)
    t = 17.0 + DT * (k + 0.5 * drift * k * k / N + rng.uniform(-jitter, jitter, N))
    lost = np.sort(rng.choice(np.arange(1, N - 1), 12, replace=False))
    found = gridded(np.delete(t, lost), np.delete(k, lost))
    assert found.steps[0]["missing"] == 12
    np.testing.assert_array_equal(np.flatnonzero(~found.recorded), lost)
    np.testing.assert_array_equal(found.signals["x"][found.recorded], np.delete(k, lost))
    np.testing.assert_allclose(np.diff(found.time), found.time[1] - found.time[0], rtol=1e-6)
    assert np.abs(found.time - t).max() < DT


def test_an_even_time_is_left_as_it_is():
    t = DT * (np.arange(N) + np.random.default_rng(0).uniform(-0.05, 0.05, N))
    found = gridded(t)
    assert found.time is t
    assert (found.steps, found.notes) == ((), ())


def test_a_hiccup_of_less_than_two_samples_shifts_what_follows_by_less_than_one():
    t = DT * np.arange(5000.0)
    t[2500:] += 0.0014  # an interval of 3.4 ms
    found = gridded(t)
    assert len(found.time) == 5001
    assert np.flatnonzero(~found.recorded).tolist() == [2500]
    assert found.notes == (
        "time is read onto its own grid of 500 Hz: 1 row is missing in 1 gap, the longest 0.0034 s after t = 4.998 s",
    )


def test_late_swapped_and_repeated_stamps_have_one_note():
    t, k = DT * np.arange(float(N)), np.arange(N)
    t[100] += 0.6 * DT  # late by more than half a sample
    rows = np.r_[0:200, 201, 200, 202:300, 299, 300:N]
    found = gridded(t[rows], k[rows])
    np.testing.assert_array_equal(found.signals["x"], k)
    assert (found.steps[0]["missing"], found.steps[0]["swapped"], found.steps[0]["repeated"]) == (0, 1, 1)
    (note,) = found.notes
    assert note.endswith("1 row without a place left out, 1 row put in the order of time")


@pytest.mark.parametrize("seed", range(5))
def test_intervals_of_any_length_have_no_grid(seed):
    t = np.cumsum(np.random.default_rng(seed).exponential(DT, N))
    with pytest.raises(LogError, match="time is not uniform"):
        gridded(t)
    assert not runs_freely(t)


def test_a_loop_without_a_grid_runs_freely():
    assert runs_freely(np.cumsum(np.random.default_rng(0).uniform(0.8 * DT, 1.3 * DT, N)))


@pytest.mark.parametrize(
    ("time", "message"),
    [
        (np.r_[0.0:9.0, 0.0:9.0], "time runs backwards at row 9"),
        (np.repeat(np.arange(9.0), 2), r"time 0 s repeats at row 1 \(and 8 more like it\)"),
        (np.zeros(4), "repeats at row 1"),
        (np.r_[0.0:99.0, 1e9], "1 gap"),
    ],
)
def test_what_has_no_grid_is_refused_with_the_place(time, message):
    with pytest.raises(LogError, match=message):
        gridded(time)
