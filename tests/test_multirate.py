"""Signals at a fraction of a log's rate: NaN between their samples, and nothing interpolated."""

import numpy as np
import pytest

import diransac as dr
from diransac.data.checks import rows_per_sample
from diransac.data.dataset import Dataset
from diransac.identification.assessment.inspection import inspect
from diransac.identification.evaluation.simulation import Simulation, starts_of
from simulated import MACHINES, flight

PLANE = MACHINES["planar-rotorcraft"]
MODEL = dr.models.planar_rotorcraft()
N, DT, EVERY = 1500, 0.01, 10
POSITIONS, VELOCITIES = ("x", "z", "theta"), ("x_dot", "z_dot", "theta_dot")
NOISE = dict.fromkeys(("x", "z"), 0.002) | {"theta": 0.005} | dict.fromkeys(VELOCITIES, 0.02)
SIGNALS, INPUTS = flight(PLANE, N, DT)


def log(slow, fast=(), shift=0, outliers=0.0, seed=0):
    """A flight with some signals at every tenth row, each of them ``shift`` rows later than the one before."""
    rng, rows, columns = np.random.default_rng(seed), np.arange(N), {}
    for k, name in enumerate((*slow, *fast)):
        clean = SIGNALS[:, PLANE.signals.index(name)]
        hit = rng.random(N) < outliers
        noisy = clean + NOISE[name] * rng.normal(size=N) + np.where(hit, 30.0 * NOISE[name] * rng.normal(size=N), 0.0)
        columns[name] = np.where(rows % EVERY == k * shift % EVERY, noisy, np.nan) if name in slow else noisy
    return dr.Log.from_arrays(DT * rows, columns | dict(zip(("thrust", "moment"), INPUTS.T, strict=True)))


CASES = {
    "slow positions beside velocities": {"slow": POSITIONS, "fast": VELOCITIES},
    "slow positions beside a gyroscope": {"slow": POSITIONS, "fast": VELOCITIES[2:]},
    "all slow": {"slow": (*POSITIONS, *VELOCITIES)},
    "slow positions alone": {"slow": POSITIONS},
    "never in one row": {"slow": POSITIONS, "shift": 3},
    "with outliers": {"slow": POSITIONS, "fast": VELOCITIES[2:], "outliers": 0.05},
}


@pytest.mark.parametrize("case", CASES)
def test_lo_diransac_is_accurate_and_within_its_intervals(case):
    result = dr.identify(MODEL, log(**CASES[case]), differentiate=True)
    for name, truth in PLANE.truth.items():
        assert result.parameters[name] == pytest.approx(truth, rel=2e-3)
        assert abs(result.parameters[name] - truth) < 4.0 * result.standard_errors[name]
    assert result.verdict != "do not rely on this"
    assert np.isfinite(result.fit_error)
    assert not any("NaN" in note for note in result.notes)


def test_least_squares_of_slow_signals_derives_what_it_can():
    """Missing samples are bridged by a cubic, as long as that is short beside the motion."""
    result = dr.identify(MODEL, log(POSITIONS, VELOCITIES[2:]), "ols", differentiate=True)
    assert result.parameters == pytest.approx(PLANE.truth, rel=0.02)


def test_least_squares_refuses_signals_that_are_never_in_one_row_and_says_their_rates():
    rows, own = np.arange(N), list(zip(PLANE.signals, SIGNALS.T, strict=True))
    columns = {n: np.where(rows % 10 == k % 2, x, np.nan) for k, (n, x) in enumerate(own)}
    two = dr.Log.from_arrays(DT * rows, columns | dict(zip(("thrust", "moment"), INPUTS.T, strict=True)))
    with pytest.raises(dr.LogError, match=r'"x_dot" is sampled at 10 Hz.*the log at 100 Hz; use lo-diransac'):
        dr.identify(MODEL, two, "ols")


def test_errors_of_slow_signals_are_those_of_their_samples():
    """Sums and inliers by NumPy; a row needs half of the signals that it has, where half of all must agree."""
    names, parameters = (*POSITIONS, *VELOCITIES), np.array(list(PLANE.truth.values()))
    dataset = Dataset.of(MODEL, log(POSITIONS, VELOCITIES), names, pointwise=False)
    simulation, thresholds = Simulation(dataset), np.repeat([0.2, 0.1], 3)
    one = dataset.segments[0]
    starts = starts_of(one, "first")
    found, ((_, state),) = simulation.score([starts], parameters[None], thresholds, 3), starts
    series = simulation.trajectories(0, parameters, state[None], np.array([0]), len(one))[0]
    errors = series[:, :6] - one.measured
    assert one.n_rows == N
    assert found.sum_squares[0] == pytest.approx(N * np.nanmean(np.square(errors), axis=0), rel=1e-9)
    near = (np.abs(errors) < thresholds).sum(axis=1)
    inliers = near >= np.where(np.isfinite(errors).all(axis=1), 3, 2)
    assert 0 < inliers.sum() < N
    assert np.array_equal(found.inlier_masks(0)[0], inliers)


def test_inspect_says_the_rate_of_each_signal(tmp_path):
    """Read from a file, whose empty cells are missing samples."""
    path = tmp_path / "slow.csv"
    one = log(POSITIONS, VELOCITIES[2:])
    cells = [
        ["t", *one.names],
        *([x if np.isfinite(x) else "" for x in row] for row in np.column_stack([one.time, *one.signals.values()])),
    ]
    path.write_text("\n".join(",".join(map(str, row)) for row in cells))
    found = inspect(dr.read_log(path), MODEL)
    assert [found.signals[n].rate for n in (*POSITIONS, "theta_dot", "thrust")] == pytest.approx(
        [10.0] * 3 + [100.0] * 2
    )
    assert all(facts.n_spikes == 0 for name, facts in found.signals.items() if name in NOISE)
    assert '"x", "z", "theta" are sampled at 10 Hz, one row in 10' in found.notes


def test_rows_per_sample_are_the_usual_ones():
    known = np.arange(100) % 7 == 0
    assert rows_per_sample(known) == 7
    known[[14, 49]] = False
    assert rows_per_sample(known) == 7
    assert rows_per_sample(np.arange(100) % 7 > 0) == 1
