"""The tracker: the batch fit's answer, changes, hostile streams.  Its flights are simulated by plain NumPy."""

import tracemalloc
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import diransac as dr
from diransac.errors import LogError, SettingsError
from diransac.identification.core.arrowhead import Arrowhead
from diransac.identification.tracking.changes import Drift
from diransac.identification.tracking.starting import smoothed_motion
from diransac.identification.tracking.steps import StepTests
from simulated import ROTORCRAFT, VEHICLE, as_log, flight, rotorcraft_acceleration, with_outliers

DT = 0.01
MODEL = dr.models.planar_rotorcraft()
ROUGH = {"mass": 0.3, "inertia": 0.005, "drag": 0.02}
NOISE = np.array([0.005, 0.005, 0.01, 0.02, 0.02, 0.05])


@cache
def flown(n_rows, seed=0, *, outliers=0.1, gust=0.0, gust_from=0.0, change=None, held=True, noise=1.0):
    """Log of a flight: ``change = (time, parameters, factor)``; gusts are Gauss-Markov accelerations of 1 s."""
    rng = np.random.default_rng(seed)
    x, force, states, inputs = np.array(ROTORCRAFT.start), np.zeros(3), np.empty((n_rows, 6)), np.empty((n_rows, 2))
    kept = np.exp(-DT)
    for row in range(n_rows):
        t, truth = row * DT, dict(ROTORCRAFT.truth)
        if change is not None and t >= change[0]:
            truth = {name: x * change[2] if name in change[1] else x for name, x in truth.items()}
        if t >= gust_from:
            force = kept * force + gust * np.sqrt(1.0 - kept**2) * rng.normal(size=3) * [1.0, 1.0, 0.0]
        u, p = np.array(ROTORCRAFT.law(t + seed, x[:3], x[3:])), list(truth.values())

        def rate(x, later, u=u, p=p, force=force, t=t):
            u = u if held else ROTORCRAFT.law(t + later + seed, x[:3], x[3:])
            return np.concatenate([x[3:], np.array(rotorcraft_acceleration(x[:3], x[3:], u, p)) + force])

        states[row], inputs[row] = x, u
        k1 = rate(x, 0.0)
        k2 = rate(x + DT / 2.0 * k1, DT / 2.0)
        k3 = rate(x + DT / 2.0 * k2, DT / 2.0)
        x = x + DT / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rate(x + DT * k3, DT))
    signals = with_outliers(states + rng.normal(size=states.shape) * noise * NOISE, outliers, 5.0, seed + 1)
    columns = dict(zip(ROTORCRAFT.signals, signals.T, strict=False)) | dict(
        zip(ROTORCRAFT.inputs, inputs.T, strict=True)
    )
    return dr.Log.from_arrays(np.arange(n_rows) * DT, columns)


@cache
def tracked(n_rows, seed, **recording):
    """Estimates over such a flight from a rough start."""
    return list(dr.track(MODEL, flown(n_rows, seed, **recording), start=ROUGH))


def columns_of(log):
    return {"t": log.time.copy(), **{name: log[name].copy() for name in log.names}}


def fed(columns, size=10, **options):
    """Estimates of a tracker that is fed some rows at a time."""
    tracker = dr.Tracker(MODEL, background=False, **{"start": ROUGH, **options})
    parts = ({n: x[k : k + size] for n, x in columns.items()} for k in range(0, len(columns["t"]), size))
    return [now for part in parts if (now := tracker.update(part)) is not None]


def ratios(now, truth=ROTORCRAFT.truth):
    """Errors of an estimate over their standard errors."""
    return np.array([(now.parameters[n] - x) / now.standard_errors[n] for n, x in truth.items()])


# ---------------------------------------------------------------------- the batch fit


def test_tracker_ends_with_the_answer_of_the_batch_fit_on_an_exact_log():
    signals, inputs = flight(VEHICLE, 1000, DT, substeps=5)
    rng = np.random.default_rng(0)
    signals = signals + rng.normal(size=signals.shape) * 0.02 * signals.std(axis=0)
    signals[:, 2] = np.nan
    log, model = as_log(VEHICLE, signals, inputs, DT), dr.models.underwater_vehicle()
    log = dr.Log.from_arrays(log.time, {n: log[n] for n in ("x", "x_dot", "thrust")})
    batch = dr.identify(model, log, dr.LoDiransac(suggestions=False))
    start = {"mass": 50.0, "linear_drag": 20.0, "quadratic_drag": 30.0, "bias": 1.0}
    for window in (5.0, 15.0):
        *_, now = dr.track(model, log, window=window, start=start)
        for name, value in batch.parameters.items():
            assert abs(now.parameters[name] - value) < 0.1 * batch.standard_errors[name], (window, name)
            assert now.standard_errors[name] == pytest.approx(batch.standard_errors[name], rel=0.2), (window, name)


def test_windows_that_are_eliminated_leave_their_schur_complement():
    rng, n, k, m = np.random.default_rng(0), 4, 3, 2
    J = rng.normal(size=(60, n * k + m))
    for w in range(n):  # rows of the equations that couple neighbours and the border alone
        J[15 * w : 15 * (w + 1), : w * k] = J[15 * w : 15 * (w + 1), (w + 2) * k : n * k] = 0.0
    A, b, rest = J.T @ J, rng.normal(size=n * k + m), slice((n - 1) * k, None)
    diagonal = np.stack([A[w * k : (w + 1) * k, w * k : (w + 1) * k] for w in range(n)])
    below = np.stack([A[(w + 1) * k : (w + 2) * k, w * k : (w + 1) * k] for w in range(n - 1)])
    system = Arrowhead(diagonal, below, A[: n * k, n * k :].reshape(n, k, m), A[n * k :, n * k :])
    information, right = system.eliminated(b[: n * k].reshape(n, k), b[n * k :])
    inverse = np.linalg.inv(A)
    assert np.allclose(information @ inverse[rest, rest], np.eye(k + m), atol=1e-9)
    assert np.allclose(np.linalg.solve(information, right), (inverse @ b)[rest], rtol=1e-9)


def test_estimates_are_honest_with_outliers_and_noise():
    *_, now = dr.track(MODEL, flown(700, 3), start=ROUGH)
    assert np.abs(ratios(now)).max() < 3.5
    assert all(low < now.parameters[n] < high for n, (low, high) in now.intervals(0.95).items())
    assert now.outliers["x"] == pytest.approx(0.1, abs=0.05)
    assert now.noise["theta_dot"] == pytest.approx(0.05, rel=0.1)
    assert now.time == pytest.approx(6.99)
    assert now.state["z"] == pytest.approx(np.median(flown(700, 3, outliers=0.0)["z"][-3:]), abs=0.02)
    assert np.allclose(np.sqrt(np.diag(now.covariance)), list(now.standard_errors.values()))


def test_rough_start_finds_whether_inputs_are_held():
    found = [
        list(dr.track(MODEL, flown(700, 3, outliers=0.0, held=x, noise=0.3), start=ROUGH))[-1] for x in (True, False)
    ]
    assert max(np.abs(ratios(now)).max() for now in found) < 3.5
    of_held, of_smooth = (np.array(list(now.standard_errors.values())) for now in found)
    assert np.all(of_smooth < 1.5 * of_held)  # no unmodelled forces instead


# ---------------------------------------------------------------------- changes


@pytest.mark.parametrize(
    ("change", "gust", "seed", "delay", "off"),
    [((8.0, ("mass",), 1.3), 0.0, 0, 1.0, 0.15), ((24.04, ("inertia",), 1.3), 0.3, 1, 1.5, 0.2)],
)
def test_step_of_a_parameter_is_reported_once_when_its_value_is_known(change, gust, seed, delay, off):
    changes = [
        x for now in tracked(round(100 * (change[0] + 2.0)), seed, gust=gust, change=change) for x in now.changes
    ]
    assert [(x.parameter, x.kind) for x in changes] == [(*change[1], "step")]
    truth = ROTORCRAFT.truth[changes[0].parameter]
    assert changes[0].time == pytest.approx(change[0], abs=off)
    assert changes[0].detected < change[0] + delay
    assert changes[0].before == pytest.approx(truth, abs=4.0 * changes[0].before_error)
    assert changes[0].after == pytest.approx(change[2] * truth, rel=0.1)


def test_estimate_follows_a_step_at_once():
    *_, now = tracked(1000, 0, gust=0.0, change=(8.0, ("mass",), 1.3))
    assert now.parameters["mass"] == pytest.approx(1.3 * 0.249, rel=2e-3)
    assert now.parameters["inertia"] == pytest.approx(0.004, rel=1e-3)


def test_intervals_hold_the_truth_while_it_is_not_clear_what_else_has_changed():
    log, before = flown(1200, 5, change=(8.0, ("mass", "inertia"), 0.7)), ROTORCRAFT.truth
    after = {name: x if name == "drag" else 0.7 * x for name, x in before.items()}
    found = list(dr.track(MODEL, log, start=ROUGH))
    assert all(np.abs(ratios(now, after)).max() < 5.0 for now in found if now.time > 8.4)
    changes = [x for now in found for x in now.changes]
    assert sorted(x.parameter for x in changes) == ["inertia", "mass"]
    assert all(abs(x.after - after[x.parameter]) < 4.0 * x.after_error for x in changes)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 25])
def test_gusts_and_outliers_are_no_changes(seed):
    log = flown(1800, seed, gust=0.5, gust_from=8.0)
    found = list(dr.track(MODEL, log, start=ROUGH))
    assert [x for now in found for x in now.changes] == []
    assert found[-1].parameters["mass"] == pytest.approx(0.249, rel=1e-3)  # what the calm flight told is kept


def gusty_joint(seed):
    """A joint in gusts, by Euler steps, whose torque follows a command with a lag, and its model without the torque."""
    rng, t, x, gust = np.random.default_rng(seed), np.arange(0.0, 30.0, DT), np.zeros(3), 0.0
    angle, command = np.empty((2, len(t)))
    for k in range(len(t)):
        angle[k], command[k] = x[0], 0.006 * (20.0 * np.sin(2.0 * t[k] + seed) - 20.0 * x[0] - 6.0 * x[1])
        gust = np.exp(-DT) * gust + np.sqrt(1.0 - np.exp(-2.0 * DT)) * rng.normal()
        for _ in range(5):
            x = x + DT / 5.0 * np.array([x[1], x[2] / 0.006 + gust, (command[k] - x[2]) / 0.04])
    model = dr.Model(
        "joint",
        {"angle": "rad"},
        {"command": "N m"},
        {"inertia": dr.Parameter("kg m^2", positive=True), "lag": dr.Parameter("s", positive=True)},
        lambda q, v, a, u, p: [p.inertia * a.angle - v.torque, p.lag * a.torque + v.torque - u.command],
        first_order={"torque": "N m"},
    )
    return model, dr.Log.from_arrays(t, {"angle": angle + 0.001 * rng.normal(size=len(t)), "command": command})


@pytest.mark.parametrize("seed", [1, 2])
def test_gusts_are_no_torques_that_nothing_measures(seed):
    """Such torques would explain them with an inertia that is too small by as much as one likes."""
    model, log = gusty_joint(seed)
    *_, now = dr.track(model, log, start={"inertia": 0.0065, "lag": 0.045})
    assert now.standard_errors["inertia"] < 3e-4
    assert now.parameters["inertia"] == pytest.approx(0.006, abs=2.0 * now.standard_errors["inertia"])


def test_search_that_is_spread_over_updates_finds_the_step(monkeypatch):
    monkeypatch.setattr("diransac.identification.tracking.changes._WORK", 1)
    log = flown(900, 0, change=(6.0, ("mass",), 1.3))
    (found,) = [x for now in fed(columns_of(log), window=3.0) for x in now.changes]
    assert (found.parameter, found.time) == ("mass", pytest.approx(6.0, abs=0.15))
    assert found.detected == pytest.approx(7.5, abs=0.8)  # later than by a search within an update
    assert found.after == pytest.approx(1.3 * 0.249, rel=0.01)


def test_scatter_of_a_test_is_no_evidence_of_steps_of_several_parameters():
    """Nearly collinear parameters, of which one scatters: right-hand sides remain those of the equations."""
    information = np.array([[1.0, 0.9999], [0.9999, 1.0]]) * 1e4
    tests = StepTests(np.array([10]), (information @ [0.1, 0.0])[None], information[None])
    for scatter in ([1.0, 1.0], [1.0, 2.0]):
        place, chosen, sizes = tests.likeliest(np.ones(2), np.array([scatter]))
        assert (place, chosen.tolist()) == (0, [0])
        assert sizes == pytest.approx([0.1])


def test_wrong_hold_of_the_inputs_is_found_while_the_window_fills():
    columns = columns_of(flown(400, 3, outliers=0.0, noise=0.3))
    tracker = dr.Tracker(MODEL, start=ROUGH)
    tracker.update({n: x[:130] for n, x in columns.items()})
    tracker._window.setup = replace(tracker._window.setup, hold="smooth")
    now = tracker.update({n: x[130:] for n, x in columns.items()})
    assert tracker._window.setup.hold == "zero-order"
    assert np.abs(ratios(now)).max() < 3.5


def test_forces_of_the_start_are_not_remembered():
    columns = columns_of(flown(1200, 5, gust=0.5))
    tracker = dr.Tracker(MODEL, start=ROUGH, window=3.0)
    tracker.update({n: x[:500] for n, x in columns.items()})
    assert not tracker._window.is_exact
    assert tracker._window.memory.freedom == 0.0
    tracker.update({n: x[500:] for n, x in columns.items()})
    assert tracker._window.memory.freedom > 10.0


def test_change_since_an_identification_is_reported():
    result = dr.identify(MODEL, flown(800, 9), dr.LoDiransac(suggestions=False))
    log = flown(700, 4, change=(-1.0, ("mass",), 1.3))
    changes = [x for now in dr.track(MODEL, log, start=result) for x in now.changes]
    assert [x.parameter for x in changes] == ["mass"]
    assert changes[0].before == result.parameters["mass"]
    assert changes[0].after == pytest.approx(1.3 * 0.249, rel=0.01)


# ---------------------------------------------------------------------- streams


def test_answer_does_not_depend_on_how_samples_are_handed_over():
    log = flown(400)
    whole = list(dr.track(MODEL, log, start=ROUGH, window=2.0))
    for size in (1, 7, 400):
        parts = fed(columns_of(log), size, window=2.0)
        assert parts[-1].parameters == whole[-1].parameters
        assert (parts[-1].covariance == whole[-1].covariance).all()
    assert [now.time for now in fed(columns_of(log), 1, window=2.0)] == [now.time for now in whole]


def test_drift_that_forces_may_hide_counts_by_its_probability_before_it_is_clear():
    drift, grown = Drift(("mass",), {}), []
    for _ in range(60):  # windows of 5 s, each two standard deviations off what was known
        drift.learn(np.ones(1), np.full(1, 2e-2), np.full(1, 1e4), 5.0, 0.2, exact=False)
        grown.append((5.0 * float(drift.rate[0]) / 1e-4, bool(drift.drifting[0])))
    before = [variance for variance, drifting in grown if not drifting]
    assert len(before) > 3
    assert before[0] < 0.5
    assert (np.diff(before) > 0.0).all()
    assert grown[-1][1]
    assert grown[-1][0] > 3.0


def test_parameter_that_scatters_by_chance_keeps_what_was_known_of_it():
    rng, rates = np.random.default_rng(0), []
    for _ in range(20):
        drift = Drift(("mass",), {})
        for _ in range(100):
            drift.learn(np.ones(1), rng.normal(size=1) * 1e-2, np.full(1, 1e4), 5.0, 0.2, exact=False)
            rates.append(5.0 * float(drift.rate[0]) / 1e-4)
    assert np.mean(rates) < 0.05


def test_missing_late_and_repeated_samples_are_taken():
    rng = np.random.default_rng(0)
    order = np.repeat(np.argsort(np.arange(800) + rng.uniform(0.0, 3.0, 800)), 1 + (rng.random(800) < 0.05))
    columns = {n: x[order] for n, x in columns_of(flown(800)).items()}
    for name in ("x", "theta", "z_dot"):
        columns[name][rng.random(len(order)) < 0.3] = np.nan
    end = fed(columns)[-1]
    assert np.abs(ratios(end)).max() < 4.0
    assert end.time == pytest.approx(7.95, abs=0.06)


def test_sensor_that_comes_a_second_late_counts():
    columns = columns_of(flown(600, outliers=0.0))
    tracker, last = dr.Tracker(MODEL, start=ROUGH), None
    for k in range(600):
        last = tracker.update({n: x[k] for n, x in columns.items() if n != "x"}) or last
        if k >= 100:
            last = tracker.update({"t": columns["t"][k - 100], "x": columns["x"][k - 100]}) or last
    assert last.noise["x"] == pytest.approx(0.005, rel=0.15)
    assert np.abs(ratios(last)).max() < 4.0


def test_gap_and_restart_of_the_clock_are_said_and_change_nothing():
    columns = columns_of(flown(900))
    kept = (columns["t"] < 3.0) | (columns["t"] > 5.0)
    gap = fed({n: x[kept] for n, x in columns.items()})
    assert [x for now in gap for x in now.notes] == ["a gap of 2.02 s after t = 2.99 s"]
    assert np.abs(ratios(gap[-1])).max() < 4.0
    columns["t"][500:] -= columns["t"][500]
    restarted = fed(columns)
    assert [x for now in restarted for x in now.notes] == ["the clock restarts at t = 0 s, after t = 4.99 s"]
    assert np.abs(ratios(restarted[-1])).max() < 4.0
    assert restarted[-1].time == pytest.approx(3.99, abs=0.1)


def test_gap_waits_for_as_many_samples_as_the_smoother_needs(monkeypatch):
    def demanding(setup, stream, first, n_rows):
        if n_rows < 150:
            raise LogError(f"{n_rows} rows are too few")
        return smoothed_motion(setup, stream, first, n_rows)

    monkeypatch.setattr("diransac.identification.tracking.tracker.smoothed_motion", demanding)
    columns = columns_of(flown(900, 3))
    kept = (columns["t"] < 6.0) | (columns["t"] >= 6.5)
    found = fed({name: x[kept] for name, x in columns.items()})
    assert found[-1].time == pytest.approx(8.99)
    assert np.abs(ratios(found[-1])).max() < 3.5


def test_single_wrong_stamp_is_left_out():
    columns = columns_of(flown(500))
    columns["t"][300] = 1e9
    found = fed(columns)
    assert [x for now in found for x in now.notes] == []
    assert found[-1].time == pytest.approx(4.99)


def test_sensor_that_stops_is_said():
    columns = columns_of(flown(700))
    columns["x"][300:550] = np.nan
    notes = [x for now in fed(columns) for x in now.notes]
    assert [x.partition(",")[0] for x in notes] == ["x is not measured any more", "x is measured again"]


def test_jittered_clock_keeps_its_rate():
    columns = columns_of(flown(900, outliers=0.0))
    columns["t"] += np.random.default_rng(0).uniform(-0.1, 0.1, 900) * DT
    assert np.abs(ratios(fed(columns)[-1])).max() < 5.0


# ---------------------------------------------------------------------- starts


@pytest.mark.slow
def test_cold_start_and_recovery_from_a_wrong_start_end_alike():
    log = flown(900)
    cold = list(dr.track(MODEL, log))
    wrong = list(dr.track(MODEL, log, start={"mass": 0.01, "inertia": 1e-5, "drag": 5.0}))
    assert "identified" in cold[0].notes[0]
    assert any("identified anew" in x for now in wrong for x in now.notes)
    for now in (cold[-1], wrong[-1]):
        assert np.abs(ratios(now)).max() < 4.0


def test_memory_does_not_grow():
    columns = columns_of(flown(700))
    tracker = dr.Tracker(MODEL, start=ROUGH, window=1.0)
    tracker.update({n: x[:400] for n, x in columns.items()})
    tracemalloc.start()
    tracker.update({n: x[400:500] for n, x in columns.items()})
    before = tracemalloc.get_traced_memory()[0]
    tracker.update({n: x[500:] for n, x in columns.items()})
    after = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert after < before + 50_000


# ---------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"window": 0.0}, "window is 0.0; give a number above 0"),
        ({"step": float("nan")}, "step is nan"),
        ({"window": 0.1}, "at least two steps"),
        ({"false_alarms_per_hour": "often"}, "false_alarms_per_hour is 'often'"),
        ({"start": {"weight": 1.0}}, 'start names "weight"; the parameters are mass, inertia, drag'),
        ({"start": {"mass": 1.0}}, 'start lacks "inertia"'),
        ({"start": {"mass": float("inf")}}, 'start of "mass" is inf'),
        ({"drift": {"weight": 1.0}}, 'drift names "weight"'),
    ],
)
def test_bad_argument_is_refused_in_one_sentence(options, message):
    with pytest.raises(SettingsError, match=message):
        dr.Tracker(MODEL, **options)


def test_log_without_any_estimate_says_why():
    log = flown(700, 3)
    still = dr.Log.from_arrays(log.time[:300], {name: log[name][:300] for name in log.names})
    with pytest.raises(LogError, match="no estimate: there are fewer than 5 s of rows; give rough values as start"):
        list(dr.track(MODEL, still))
    with pytest.raises(LogError, match=r"no estimate: .*too few"):
        list(dr.track(MODEL, still.between(0.0, 0.5), start=ROUGH))
    tracker = dr.Tracker(MODEL, start=ROUGH)
    tracker.update(columns_of(still))
    assert not tracker.missing


@pytest.mark.parametrize(
    ("samples", "message"),
    [
        ({"x": 1.0}, 'samples have no time; give their column "t" in seconds'),
        ({"t": np.nan}, "is not finite"),
        ({"t": [0.0, 0.1], "x": [1.0]}, '"x" has 1 samples, the time has 2'),
        ({"t": 0.0, "x": "far"}, '"x" of the samples is .far.; give numbers'),
        ({"t": [[0.0]]}, "the shape"),
        (3.0, "samples are a float"),
        ({"t": np.arange(100.0)}, "too slow for a step of 0.1 s"),
        ({"t": np.zeros(2000)}, "stands still"),
    ],
)
def test_bad_samples_are_refused_in_one_sentence(samples, message):
    with pytest.raises(LogError, match=message):
        dr.Tracker(MODEL, start=ROUGH).update(samples)
