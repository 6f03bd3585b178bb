"""Estimates compete: simulation error without smoothing, held-out prediction, and what a result says of it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import diransac as dr
from diransac.data.dataset import Dataset
from diransac.identification.methods.lo_diransac.forward import Forward, Reference, forward_predictions
from diransac.identification.methods.lo_diransac.judge import (
    Scores,
    Selection,
    equations_of_measured_states,
    forces_left,
    judge,
)
from diransac.identification.methods.lo_diransac.preparation import prepared
from diransac.identification.methods.lo_diransac.segments import ActingInputs, Segments, stretches
from diransac.identification.methods.lo_diransac.simulation_error import simulation_error_candidates
from diransac.identification.methods.lo_diransac.sources import (
    Blocks,
    Candidate,
    jackknife,
    least_squares_candidates,
)

TRUTH = {"m": 5.3e-6, "d": 2.3e-4, "k": 1.0, "c": 4.0}
RATE = 610.35


def oscillator() -> dr.Model:
    return dr.Model(
        name="oscillator",
        coordinates={"y": "V"},
        inputs={"u": "V"},
        parameters={
            "m": dr.Parameter("s^2", positive=True),
            "d": dr.Parameter("s", lower=0.0),
            "k": dr.Parameter("1", positive=True),
            "c": dr.Parameter("V^-2"),
        },
        equations=lambda q, v, a, u, p: [p.m * a.y + p.d * v.y + p.k * q.y + p.c * q.y**3 - u.u],
    )


@cache
def ringing(n: int = 3000, seed: int = 0, lacks: float = 0.0) -> dr.Log:
    """A lightly damped Duffing oscillator at nine samples a period, inputs interpolated; by RK4 with 10 steps a sample.

    ``lacks`` is a constant force that the model lacks, in V.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(n) / RATE
    f = np.arange(1, 60)
    u = (0.05 * np.cos(2 * np.pi * 3.0 * f[:, None] * t + rng.uniform(0, 2 * np.pi, (len(f), 1)))).sum(axis=0) * 0.2
    substeps = 10
    h = 1.0 / RATE / substeps

    def slope(y: float, v: float, force: float) -> tuple[float, float]:
        return v, (force - TRUTH["d"] * v - TRUTH["k"] * y - TRUTH["c"] * y**3) / TRUTH["m"]

    y, v, found = 0.0, 0.0, np.empty(n)
    for i in range(n):
        found[i] = y
        last = u[min(i + 1, n - 1)] - u[i]
        for j in range(substeps):
            s = [u[i] + last * (j + x) / substeps + lacks for x in (0.0, 0.5, 1.0)]
            k1 = slope(y, v, s[0])
            k2 = slope(y + 0.5 * h * k1[0], v + 0.5 * h * k1[1], s[1])
            k3 = slope(y + 0.5 * h * k2[0], v + 0.5 * h * k2[1], s[1])
            k4 = slope(y + h * k3[0], v + h * k3[1], s[2])
            y += h / 6.0 * (k1[0] + 2 * k2[0] + 2 * k3[0] + k4[0])
            v += h / 6.0 * (k1[1] + 2 * k2[1] + 2 * k3[1] + k4[1])
    noise = 2e-4 * rng.standard_normal(n)
    return dr.Log.from_arrays(t, {"y": found + noise, "u": u}, units={"y": "V", "u": "V"})


@pytest.fixture(scope="module")
def bound() -> tuple:
    """Intervals, motion and blocks of a log at nine samples a period."""
    dataset = Dataset.of(oscillator(), ringing(), pointwise=False)
    intervals, motion, _ = prepared(dr.LoDiransac(), dataset)
    return dataset, intervals, motion, Blocks.of(intervals)


def truth() -> np.ndarray:
    return np.array(list(TRUTH.values()))


# ---------------------------------------------------------------------- simulation error


def test_simulation_error_finds_what_smoothing_cannot_see(bound: tuple) -> None:
    _, intervals, motion, blocks = bound
    actings = [ActingInputs.recorded(intervals, hold) for hold in ("zero-order", "linear")]
    far = truth() * np.array([2.0, 0.3, 0.6, 1.5])
    found = simulation_error_candidates(intervals, motion, far[None], actings, 0, blocks)
    assert found[-1][0].acting.hold == "linear"
    last = next(x for x, _ in found if x.acting.hold == "linear")
    np.testing.assert_allclose(last.parameters, truth(), rtol=0.02)


def test_simulation_error_depends_on_the_seed_alone(bound: tuple) -> None:
    _, intervals, motion, blocks = bound
    actings = [ActingInputs.recorded(intervals, "linear")]
    one, two = (
        simulation_error_candidates(replace(intervals, threads=n), motion, truth()[None], actings, 3, blocks)
        for n in (1, 2)
    )
    for (a, _), (b, _) in zip(one, two, strict=True):
        np.testing.assert_array_equal(a.parameters, b.parameters)


def test_states_are_those_of_the_simulation(bound: tuple) -> None:
    _, intervals, _, _ = bound
    segments = Segments(intervals, ActingInputs.recorded(intervals, "linear"), np.array([100, 900]), 30)
    lanes = np.tile(truth(), (1, 2, 1))
    states = np.array([[[0.01, 1.0], [-0.02, 3.0]]])
    exact = segments.trajectories(lanes, states)[0, :, :, 0]
    measured = intervals.measured.copy()
    measured[segments.rows, 0] = exact
    same = Segments(replace(intervals, measured=measured), segments.acting, segments.starts, 30)
    free = np.full(2, np.inf)
    found = same.estimated_states(lanes, np.zeros_like(states), free, np.ones((len(measured), 1)))
    np.testing.assert_allclose(found, states, rtol=1e-6, atol=1e-9)


def test_no_stretch_passes_a_gap(bound: tuple) -> None:
    _, intervals, _, _ = bound
    gaps = intervals.gaps.copy()
    gaps[500:510] = True
    parts = stretches(replace(intervals, gaps=gaps))
    assert [(x.start, x.stop) for x in parts] == [(0, 500), (510, int(intervals.is_logged.sum()))]


def explosive() -> dr.Model:
    """A state that grows beyond all bounds from 1.6 on."""
    return dr.Model(
        name="explosive",
        coordinates={},
        first_order={"x": "1"},
        inputs={"u": "1"},
        parameters={"k": dr.Parameter("1/s", positive=True), "c": dr.Parameter("1/s", positive=True)},
        equations=lambda q, v, a, u, p: [a.x + p.k * v.x - p.c * v.x**3 - u.u],
    )


def settling(outliers: slice, scale: float = 1.0) -> dr.Log:
    """The state near zero, with outliers from which simulations explode."""
    rng, dt, n = np.random.default_rng(0), 0.02, 800
    u = np.repeat(rng.uniform(-1.0, 1.0, n // 20), 20)
    x = np.zeros(n)
    for i in range(n - 1):
        now = x[i]
        for _ in range(20):
            now += dt / 20 * (u[i] - 2.0 * now + 0.8 * now**3)
        x[i + 1] = now
    x += 1e-3 * rng.standard_normal(n)
    x[outliers] += 40.0 + rng.standard_normal(len(x[outliers]))
    return dr.Log.from_arrays(np.arange(n) * dt, {"x": scale * x, "u": u})


@pytest.mark.parametrize("outliers", [slice(400, 425), slice(0, 800, 160)])
def test_outliers_where_segments_begin_do_not_lose_simulation_error(outliers: slice) -> None:
    dataset = Dataset.of(explosive(), settling(outliers), pointwise=False)
    intervals, motion, _ = prepared(dr.LoDiransac(), dataset)
    actings = [ActingInputs.recorded(intervals, "zero-order")]
    found = simulation_error_candidates(intervals, motion, np.ones((1, 2)), actings, 0, Blocks.of(intervals))
    assert found
    np.testing.assert_allclose(found[0][0].parameters, [2.0, 0.8], rtol=0.1)


def test_an_interval_that_diverges_does_not_lose_the_fit() -> None:
    found = dr.identify(explosive(), settling(slice(400, 425)), differentiate=True).parameters
    assert found["k"] == pytest.approx(2.0, rel=0.05)


def test_a_wrong_unit_is_no_failure_of_linear_algebra() -> None:
    found = dr.identify(explosive(), settling(slice(400, 425), 1e3), differentiate=True)
    assert found.verdict == "do not rely on this"


# ---------------------------------------------------------------------- the judge


def candidate(name: str, parameters: np.ndarray, bound: tuple, without: np.ndarray | None = None) -> Candidate:
    _, intervals, _, blocks = bound
    own = np.tile(parameters, (blocks.n, 1)) if without is None else without
    return Candidate(name, parameters, own, ActingInputs.recorded(intervals, "linear"), intervals)


def reference_of(bound: tuple) -> Reference:
    _, intervals, motion, blocks = bound
    return Reference(intervals, motion, blocks, np.ones(intervals.measured.shape, bool), motion.spread)


def predictions_of(bound: tuple) -> list[Forward]:
    return forward_predictions(reference_of(bound), None)


def comparison(candidates: list[Candidate], bound: tuple) -> Selection:
    """Of all samples, those that no candidate predicts included."""
    predictions, forces = predictions_of(bound), forces_left(reference_of(bound), candidates)
    pairs = [[x.scores(one) for x in predictions] for one in candidates]
    parts = [[np.concatenate(x) for x in zip(*own, strict=True)] for own in pairs]
    return Selection.of([Scores(*own, left) for own, left in zip(parts, forces, strict=True)])


def test_better_predictions_win_whatever_their_order(bound: tuple) -> None:
    good, bad = candidate("good", truth(), bound), candidate("bad", truth() * 1.3, bound)
    assert comparison([good, bad], bound).best == 0
    found = comparison([bad, good], bound)
    assert found.best == 1
    assert found.as_good.tolist() == [False, True]
    assert found.weights[1] == 1.0
    assert found.weights[0] < 0.05


def test_equal_predictions_leave_the_first(bound: tuple) -> None:
    found = comparison([candidate("a", truth(), bound), candidate("b", truth(), bound)], bound)
    assert found.best == 0
    assert found.as_good.all()


def test_a_block_is_predicted_without_its_own_estimate(bound: tuple) -> None:
    """An estimate that is right only where a block itself was used predicts badly."""
    cheating = candidate("cheating", truth(), bound, np.tile(truth() * 1.3, (bound[3].n, 1)))
    assert comparison([cheating, candidate("honest", truth() * 1.01, bound)], bound).best == 1


def scores(losses: list[list[float]], errors: list[float], forces: list[list[float]] | None = None) -> Scores:
    """Losses by horizon and block, and mean squares of the forces that are left by equation and block."""
    left = np.empty((0, len(losses[0]))) if forces is None else np.array(forces)
    return Scores(np.array(errors), np.array(losses), left)


def test_horizons_that_nothing_predicts_do_not_count() -> None:
    right = scores([[1e-2, 1.1e-2, 0.9e-2], [0.8, 0.9, 1.0]], [0.1, 3.0])
    dull = scores([[2e-2, 2.1e-2, 1.9e-2], [0.2, 0.3, 0.1]], [0.2, 1.2])
    assert Selection.of([dull, right]).best == 1


def test_weights_are_those_of_a_difference_in_another_log() -> None:
    base = np.array([1e-2, 1.2e-2, 0.8e-2, 1.1e-2])
    factors = np.exp([0.2, 0.4, 0.0, 0.2])
    other = scores([(base * factors).tolist()], [0.1])
    z = (0.2 - 0.02) / (np.std([0.2, 0.4, 0.0, 0.2]) / np.sqrt(3.0))
    found = Selection.of([scores([base.tolist()], [0.1]), other])
    np.testing.assert_allclose(found.weights, [1.0, np.exp(-0.25 * z**2)], rtol=1e-2)


def test_a_difference_of_a_fiftieth_does_not_count() -> None:
    """However often it is the same: estimates that differ by less stay in the intervals of the winner."""
    found = Selection.of([scores([[1e-2] * 4], [0.1]), scores([[1.01e-2] * 4], [0.1])])
    assert found.as_good.all()
    assert found.weights.tolist() == [1.0, 1.0]


def test_a_locked_joint_fails_absurdly() -> None:
    """It predicts rest as well as the right estimate does, and needs a force that is not there."""
    right = scores([[1e-2, 1.2e-2, 1e-2]], [0.1], [[0.01, 0.02, 0.01]])
    locked = scores([[0.9e-2, 1.0e-2, 0.9e-2]], [0.1], [[1e20, 1e20, 1e20]])
    found = Selection.of([locked, right])
    assert found.best == 1
    assert found.weights[0] == 0.0
    assert not found.as_good[0]


def test_equations_decide_where_predictions_are_as_good() -> None:
    left = np.array([0.010, 0.012, 0.011])
    found = Selection.of([scores([[1e-2] * 3], [0.1], [x.tolist()]) for x in (1.5 * left, left)])
    assert found.best == 1


def test_noisy_equations_do_not_decide() -> None:
    """Where every estimate leaves half of the force, the one that leaves least may be attenuated."""
    found = Selection.of([scores([[1e-2] * 3], [0.1], [[x] * 3]) for x in (0.5, 0.3)])
    assert found.best == 0
    assert found.as_good.all()


def test_the_force_that_is_left_is_the_residual_of_the_smoothed_motion(bound: tuple) -> None:
    """Mean squares under bumps by NumPy, over the larger variance of inertial force and force of the input."""
    _, intervals, motion, blocks = bound
    factors = np.array([1.0, 1.0, 1.2, 1.0])
    found = forces_left(reference_of(bound), [candidate("stiff", truth() * factors, bound)])[0]
    n, H = int(intervals.is_logged.sum()), intervals.length
    y, v, a = motion.signals[:n, :3].T
    m, d, k, c = truth() * factors
    u, bump = intervals.recorded[:n, 0], np.sin(np.pi * (np.arange(H) + 0.5) / H) ** 2
    rows = np.stack([m * a + d * v + k * y + c * y**3 - u, m * a, u])
    means = np.lib.stride_tricks.sliding_window_view(rows, H, axis=1)[:, :: H // 5] @ (bump / bump.sum())
    block = blocks.of_row[np.arange(means.shape[1]) * (H // 5) + H // 2]
    expected = [np.square(means[0, block == x]).mean() / means[1:].var(axis=1).max() for x in range(blocks.n)]
    np.testing.assert_allclose(found, [expected], rtol=1e-9)


def test_no_equation_of_an_unmeasured_state_is_compared() -> None:
    model = dr.Model(
        name="two tanks", coordinates={}, first_order={"h1": "V", "h2": "V"}, inputs={"u": "V"},
        parameters={n: dr.Parameter(positive=True) for n in ("k1", "k2", "k3")},
        equations=lambda q, v, a, u, p: [a.h1 + p.k1 * v.h1 - u.u, a.h2 + p.k2 * v.h2 - p.k3 * u.u],
    )  # fmt: skip
    t = 0.1 * np.arange(400)
    log = dr.Log.from_arrays(t, {"h2": np.sin(t), "u": np.cos(t)})
    intervals, _, _ = prepared(dr.LoDiransac(), Dataset.of(model, log, pointwise=False))
    assert equations_of_measured_states(intervals).tolist() == [1]


def test_a_block_of_a_whole_log_is_predicted_without_its_own_estimate(bound: tuple) -> None:
    """Samples of a block alone count in the simulation by the estimate without it."""
    whole = predictions_of(bound)[-1]
    assert whole.steps == (int(bound[1].is_logged.sum()) - bound[1].length,)
    assert whole.left_out.sum(axis=1).tolist() == [1] * bound[3].n
    without = np.tile(truth(), (bound[3].n, 1))
    without[3, 2] *= 1.3
    _, losses = whole.scores(candidate("wrong in block 3", truth(), bound, without))
    assert int(np.argmax(losses[0])) == 3
    assert losses[0, 3] > 100.0 * np.delete(losses[0], 3).max()


def test_a_segment_is_predicted_without_all_blocks_that_it_touches(bound: tuple) -> None:
    short = predictions_of(bound)[0]
    rows = short.segments.rows
    touched = [np.unique(bound[3].of_row[x]) for x in rows]
    assert max(len(x) for x in touched) > 1
    assert all(np.flatnonzero(own).tolist() == x.tolist() for own, x in zip(short.left_out, touched, strict=True))
    apart = np.arange(1.0, bound[3].n + 1.0)[:, None] * 1e-3 * truth()
    one = candidate("one", truth(), bound, truth() + apart)
    expected = truth() + np.array([apart[x].sum(axis=0) for x in touched])
    np.testing.assert_allclose(one.without_blocks(short.left_out), expected, rtol=1e-12)


def test_samples_that_no_good_estimate_predicts_do_not_count(bound: tuple) -> None:
    """A fifth of the samples, in bursts that are taken for inliers, would leave nothing to choose."""
    dataset, intervals, motion, blocks = bound
    rng, burst = np.random.default_rng(3), np.zeros(len(intervals.measured), bool)
    for k in rng.integers(0, len(burst), 15):
        burst[k : k + 40] = True
    measured = intervals.measured.copy()
    measured[burst] += 50.0 * motion.spread * rng.uniform(0.5, 1.0, (burst.sum(), 1))
    with_bursts = (dataset, replace(intervals, measured=measured), motion, blocks)
    competitors = [candidate(str(x), truth() * x, with_bursts) for x in (1.0, 1.3, 30.0)]
    assert comparison(competitors, with_bursts).as_good[1]
    found = judge(reference_of(with_bursts), competitors)
    assert found is not None
    assert found.as_good.tolist() == [True, False, False]
    short = predictions_of(with_bursts)[0]
    short = short.without_lost(short._errors(competitors))
    assert short.lost is not None
    rows = short.segments.rows[:, short.n_before :]
    lost = short.lost[0]
    assert lost[burst[rows]].mean() > 0.9
    assert lost[~burst[rows]].mean() < 0.2


def test_samples_count_where_every_estimate_predicts_badly(bound: tuple) -> None:
    bad = [candidate(str(k), truth() * [1.0, 1.0, k, 1.0], bound) for k in (0.3, 2.5)]
    found = judge(reference_of(bound), bad)
    assert found is not None
    every = comparison(bad, bound)
    assert [x.errors.tolist() for x in found.scores] == [x.errors.tolist() for x in every.scores]


def test_blocks_in_which_the_best_estimate_fails_count_where_another_one_predicts_them(bound: tuple) -> None:
    """Two regimes in a log: one estimate is exact in six of ten blocks, the other one fair in all."""
    failing = np.tile(truth(), (bound[3].n, 1))
    failing[:4, 2] *= 2.0
    one, other = candidate("one", truth(), bound, failing), candidate("other", truth() * 1.1, bound)
    found = judge(reference_of(bound), [one, other])
    assert found is not None
    assert (found.scores[0].errors < 0.5 * found.scores[1].errors).all()
    assert found.losses == pytest.approx(comparison([one, other], bound).losses)


def test_horizon_is_the_one_that_is_asked_for(bound: tuple) -> None:
    found = judge(reference_of(bound), [candidate("right", truth(), bound)], 0.05)
    assert found is not None
    assert found.steps == (round(0.05 * RATE),)


def test_jackknife_is_that_of_a_mean() -> None:
    """Estimates without each of K equal blocks of a mean: the variance of block means over K, times t squared."""
    rng = np.random.default_rng(1)
    means = rng.standard_normal((10, 1))
    without = (means.sum(axis=0) - means) / 9.0
    expected = means.var(ddof=1) / 10.0 * (2.2621571628 / 1.9599639845) ** 2
    assert jackknife(without)[0, 0] == pytest.approx(expected, rel=1e-3)


def test_least_squares_competes_within_the_bounds(bound: tuple) -> None:
    """At nine samples a period smoothing sees no inertia: least squares of all rows stays on its bound."""
    dataset, intervals, _, blocks = bound
    assert [x.name for x in least_squares_candidates(dataset, intervals, blocks)] == ["ols", "nls"]


# ---------------------------------------------------------------------- results


@pytest.fixture(scope="module")
def lacking() -> dr.Result:
    return dr.identify(oscillator(), ringing(lacks=0.01), differentiate=True)


def test_the_result_predicts_as_well_as_every_competitor(lacking: dr.Result) -> None:
    found = lacking.competition
    assert found is not None
    winner = next(x for x in found.competitors if x.name == found.winner)
    assert winner.score <= 1.03 * min(x.score for x in found.competitors)
    assert {x.name.partition(",")[0] for x in found.competitors} >= {"ols", "nls", "simulation error", "joint fit"}


def test_an_answer_where_smoothing_sees_nothing(lacking: dr.Result) -> None:
    assert lacking.parameters["m"] == pytest.approx(TRUTH["m"], rel=0.03)
    assert lacking.estimate.resolution.hold == "linear"


def test_a_fit_that_others_beat_begins_anew_from_them_and_finds_the_missing_force(lacking: dr.Result) -> None:
    assert [x.text.partition(":")[0] for x in lacking.suggestions] == ["Constant force on y"]
    assert lacking.verdict == "usable with care"


def test_the_answer_is_one_of_those_that_were_judged(lacking: dr.Result) -> None:
    winner = next(x for x in lacking.competition.competitors if x.name == lacking.competition.winner)
    assert winner.parameters == lacking.parameters


def test_intervals_cover_those_that_predict_as_well(lacking: dr.Result) -> None:
    good = [x.parameters for x in lacking.competition.competitors if x.as_good]
    assert len(good) > 1
    for name, (low, high) in lacking.intervals().items():
        assert low <= np.median([x[name] for x in good]) <= high


def test_the_competition_is_printed_and_stored(lacking: dr.Result, tmp_path) -> None:
    assert "held-out prediction" in str(lacking)
    lacking.save(tmp_path / "model.json")
    assert dr.Result.load(tmp_path / "model.json").competition == lacking.competition


def test_exact_logs_have_no_competition() -> None:
    model, rng = dr.models.underwater_vehicle(), np.random.default_rng(0)
    t = np.arange(0.0, 60.0, 0.05)
    thrust = 40.0 * np.sin(0.4 * t) + 25.0 * np.sin(1.3 * t)
    values = dict(zip(model.parameters, (120.0, 20.0, 35.0, 3.0), strict=True))
    blank = {name: np.zeros(len(t)) for name in model.signals}
    inputs = dr.Log.from_arrays(t, {**blank, "thrust": thrust})
    log = dr.simulate(dr.Plant(model, values), inputs, initial_state=dict.fromkeys(model.state, 0.0))
    signals = {"x": log["x"] + 1e-3 * rng.standard_normal(len(t)), "thrust": thrust}
    found = dr.identify(model, dr.Log.from_arrays(t, signals), differentiate=True)
    assert found.competition is None
    for name, value in values.items():
        assert found.parameters[name] == pytest.approx(value, rel=0.05)


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"start": {"mass": 0.3}}, "mass"),
        ({"start": {"m": "heavy"}}, "heavy"),
        ({"start": [1.0]}, "start"),
        ({"horizon": -1.0}, "horizon"),
        ({"method": "ols", "horizon": 1.0}, "horizon"),
        ({"method": "ols", "start": {"m": 1.0}}, "start"),
    ],
)
def test_start_and_horizon_are_checked(options: dict, what: str) -> None:
    with pytest.raises(dr.SettingsError, match=what):
        dr.identify(oscillator(), ringing(600), differentiate=True, **options)
