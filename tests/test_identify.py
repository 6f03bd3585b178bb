"""The one entry: the truth from clean logs, the claims of the paper from spoilt ones, refusals in one sentence."""

import gc
import json
import weakref
from dataclasses import replace

import numpy as np
import pytest

import diransac as dr
from diransac.data.dataset import Dataset
from diransac.errors import IdentificationError, LogError, ModelError, SettingsError
from diransac.identification.identify import Identification
from diransac.model.library import builtin
from simulated import MACHINES, as_log, flight, rollout, with_outliers
from user_models import tumbling

PLANE = MACHINES["planar-rotorcraft"]
MODEL = builtin("planar-rotorcraft")
SEARCHES = ("diransac", "i-diransac")
QUICK = dr.Settings(sample_size=30, max_iterations=40, stop_inlier_fraction=None)
TABLE_IV = replace(dr.Settings.table_iv(), sample_size=30, max_iterations=60, stop_inlier_fraction=None)
OF_SEARCH = ("sample_size", "max_iterations", "stop_inlier_fraction", "refit", "acceptance_weights")


def given_to(method, settings):
    """The settings, of which those of a search are given to searches alone: other methods refuse them."""
    if method in SEARCHES:
        return settings
    return replace(settings, **{name: getattr(dr.Settings(), name) for name in OF_SEARCH})


def spoilt(n_rows=300, dt=0.02, probability=0.1, magnitude=80.0, seed=0, first_row="clean", gaps=()):
    """Signals and inputs of a flight with outliers, and rows of NaN in a signal in use."""
    signals, inputs = flight(PLANE, n_rows, dt)
    signals = with_outliers(signals, probability, magnitude, seed, first_row=first_row)
    for row, name in gaps:
        signals[row, PLANE.signals.index(name)] = np.nan
    return signals, inputs


# ---------------------------------------------------------------------- the truth from clean logs


@pytest.mark.parametrize("method", dr.METHODS)
@pytest.mark.parametrize("name", MACHINES)
def test_every_method_returns_the_truth_from_a_clean_log(name, method):
    """But for what dry friction, which switches within a step, leaves to an integrator, and lo-diransac integrates."""
    machine = MACHINES[name]
    signals, inputs = flight(machine, 400, 0.01, substeps=20)
    result = dr.identify(
        builtin(name), as_log(machine, signals, inputs, 0.01), method, settings=given_to(method, QUICK)
    )
    switches = method == "lo-diransac" and "dry" in " ".join(machine.truth)
    assert result.parameters == pytest.approx(machine.truth, rel=1e-3 if switches else 1e-8)
    assert result.inliers.all()
    assert result.inlier_fraction == 1.0
    assert result.violations == ()


def test_attitude_as_a_quaternion_is_identified_whatever_its_sign():
    model, rng = tumbling(), np.random.default_rng(0)
    truth = {"Jx": 0.02, "Jy": 0.05, "Jz": 0.04}
    n, dt = 400, 0.01
    t = np.arange(n) * dt
    torques = 0.02 * np.column_stack([np.sin(3 * t), np.cos(2.3 * t), np.sin(5.1 * t + 1.0)])
    columns = tumble(truth, torques, dt)
    flips = np.where(rng.random(n) < 0.3, -1.0, 1.0)
    for name in ("qw", "qx", "qy", "qz"):
        columns[name] = columns[name] * flips
    log = dr.Log.from_arrays(t, columns | dict(zip(("tx", "ty", "tz"), torques.T, strict=True)))
    weights = {"qw": 1.0, "qx": 1.0, "qy": 1.0, "qz": 1.0, "wx": 0.1}
    thresholds = dict.fromkeys(("qw", "qx", "qy", "qz"), 0.01)
    settings = replace(QUICK, error_weights=weights, inlier_thresholds=thresholds, min_inlier_signals=4)
    result = dr.identify(model, log, "i-diransac", settings=settings)
    assert result.parameters == pytest.approx(truth, rel=1e-8)
    assert result.fit_error < 1e-9
    assert result.inliers.all()


def test_attitude_that_nothing_measured_depends_on_need_not_be_in_the_log():
    truth, t = {"Jx": 0.02, "Jy": 0.05, "Jz": 0.04}, np.arange(400) * 0.01
    torques = 0.02 * np.column_stack([np.sin(3 * t), np.cos(2.3 * t), np.sin(5.1 * t + 1.0)])
    columns = {n: x for n, x in tumble(truth, torques, 0.01).items() if not n.startswith("q")}
    log = dr.Log.from_arrays(t, columns | dict(zip(("tx", "ty", "tz"), torques.T, strict=True)))
    result = dr.identify(tumbling(), log, "i-diransac", settings=QUICK)
    assert result.parameters == pytest.approx(truth, rel=1e-8)
    assert result.inliers.all()


def tumble(truth, torques, dt):
    """Columns of a body that turns under held torques: plain Runge-Kutta, its quaternion normalised each step."""
    J = np.array(list(truth.values()))

    def rate(x, torque):
        (w, a, b, c), omega = x[:4], x[4:]
        p, q, r = omega
        turn = 0.5 * np.array(
            [-a * p - b * q - c * r, w * p + b * r - c * q, w * q + c * p - a * r, w * r + a * q - b * p]
        )
        return np.concatenate([turn, (torque - np.cross(omega, J * omega)) / J])

    x, rows = np.array([1.0, 0, 0, 0, 0.5, -0.3, 0.2]), []
    for torque in torques:
        k1 = rate(x, torque)
        k2 = rate(x + dt / 2 * k1, torque)
        k3 = rate(x + dt / 2 * k2, torque)
        rows.append(np.concatenate([x, k1[4:]]))
        x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + dt * k3, torque))
        x[:4] /= np.linalg.norm(x[:4])
    names = ("qw", "qx", "qy", "qz", "wx", "wy", "wz", "wx_dot", "wy_dot", "wz_dot")
    return dict(zip(names, np.array(rows).T, strict=True))


# ---------------------------------------------------------------------- methods in company


def methods_of_a_trial():
    """Methods that share samples, and one with other samples."""
    others = given_to("ols", TABLE_IV)
    return [
        dr.LeastSquares(criteria=others),
        dr.Diransac(TABLE_IV),
        dr.Diransac(replace(TABLE_IV, refit="none", batch_size=7)),
        dr.IDiransac(replace(TABLE_IV, stop_inlier_fraction=0.85)),
        dr.IDiransac(replace(TABLE_IV, sample_size=20)),
        dr.IDiransac(TABLE_IV),
    ]


def test_results_do_not_depend_on_earlier_methods_of_the_same_logs():
    logs, (*methods, last) = [as_log(PLANE, *spoilt(seed=k), 0.02) for k in (0, 1)], methods_of_a_trial()
    for some, seeds, trial in (
        (logs[:1], (4, 5), [*methods, last]),
        (logs, (4,), [*methods, dr.LoDiransac(), last]),  # whose samples are no other method's
    ):
        together = Identification(MODEL, some)
        for method in trial:
            for seed in seeds:
                alone = dr.identify(MODEL, some, method, seed=seed)
                found = together.by(method, seed)
                # Predictions, and with them the effects of disagreements, are of the whole identification alone.
                tested = {"mistakes": (), "n_columns_tested": 0, "disagreements": found.estimate.disagreements}
                logs_too = [replace(x, remark=y.remark) for x, y in zip(alone.logs, found.logs, strict=True)]
                estimate = replace(alone.estimate, **tested)
                untested = replace(alone, estimate=estimate, predictions=None, logs=tuple(logs_too))
                assert json.dumps(found.to_dict()) == json.dumps(untested.to_dict())


def test_what_methods_share_is_freed_with_the_dataset():
    log = as_log(PLANE, *spoilt(), 0.02)
    dataset = Dataset.of(MODEL, log)
    dr.IDiransac(TABLE_IV).fit(dataset, 0)
    watched = weakref.ref(dataset)
    gc.disable()
    try:
        del dataset
        assert watched() is None
    finally:
        gc.enable()


# ---------------------------------------------------------------------- fit error and inliers, by other code


@pytest.mark.parametrize("method", dr.METHODS)
@pytest.mark.parametrize(
    ("settings", "gaps"),
    [
        (TABLE_IV, ()),
        (TABLE_IV, ((4, "x_dot"), (77, "theta"), (78, "theta"), (299, "z_ddot"))),
        (replace(TABLE_IV, error_weights={"x": 2.0, "theta_dot": 0.5}, min_inlier_signals=5), ()),
    ],
    ids=["whole", "gaps", "other weights"],
)
def test_fit_error_and_inliers_are_those_of_eq_2_and_section_3d(method, settings, gaps):
    signals, inputs = spoilt(probability=0.05, magnitude=20.0, gaps=gaps)
    log = as_log(PLANE, signals, inputs, 0.02)
    result = dr.identify(MODEL, log, method, settings=given_to(method, settings))
    substeps = dr.LoDiransac().substeps if method == "lo-diransac" else 1
    predicted = rollout(PLANE, list(result.parameters.values()), signals[0, :6], inputs, 0.02, substeps)
    usable = np.ones(len(signals), dtype=bool)
    usable[[row for row, _ in gaps]] = False
    error, inliers = 0.0, np.zeros(len(signals), dtype=int)
    for i, name in enumerate(PLANE.signals):
        difference = predicted[usable, i] - signals[usable, i]
        mean = np.mean(difference**2)
        error += settings.error_weights.get(name, 0.0) * (mean if method == "diransac" else np.sqrt(mean))
        inliers[usable] += np.abs(difference) < settings.inlier_thresholds.get(name, 0.0)
    is_inlier = inliers >= settings.min_inlier_signals
    assert result.fit_error == pytest.approx(error, rel=1e-9)
    assert np.array_equal(result.inliers, is_inlier)
    assert result.inlier_fraction == is_inlier.sum() / usable.sum()


def test_inliers_are_marked_on_the_log_that_was_given():
    """Rows before the first whole one are no part of the search, and no inliers."""
    signals, inputs = flight(PLANE, 200, 0.02)
    signals[:7, 3] = np.nan
    signals[50, 4] = np.nan
    log = as_log(PLANE, signals, inputs, 0.02)
    result = dr.identify(MODEL, log, "i-diransac", settings=QUICK)
    assert np.flatnonzero(~result.inliers).tolist() == [*range(7), 50]
    assert result.inlier_fraction == 1.0
    assert any("8 of 200 rows were skipped" in note for note in result.notes)
    assert result.inlier_times[0] == pytest.approx(log.time[7])


def test_settings_default_to_the_spread_of_each_signal():
    """A log in other units of length and force gives the same inliers."""
    signals, inputs = flight(MACHINES["servo-axis"], 300, 0.01)
    model, machine = builtin("servo-axis"), MACHINES["servo-axis"]
    spoiled = with_outliers(signals, 0.1, 3.0, 0)
    small = as_log(machine, 1e-3 * spoiled, 1e-3 * inputs, 0.01)
    usual = as_log(machine, spoiled, inputs, 0.01)
    ours, theirs = (dr.identify(model, log, "i-diransac", settings=QUICK) for log in (usual, small))
    assert np.array_equal(ours.inliers, theirs.inliers)
    assert ours.fit_error == pytest.approx(theirs.fit_error, rel=1e-6)


# ---------------------------------------------------------------------- the same question, the same answer


@pytest.mark.parametrize("method", dr.METHODS)
def test_same_seed_gives_the_same_result(method):
    log = as_log(PLANE, *spoilt(), 0.02)
    first, second = (dr.identify(MODEL, log, method, seed=11, settings=given_to(method, TABLE_IV)) for _ in range(2))
    assert first == second


@pytest.mark.parametrize("method", SEARCHES)
def test_batch_size_and_threads_never_change_an_answer(method):
    log = as_log(PLANE, *spoilt(), 0.02)
    usual = dr.identify(MODEL, log, method, seed=4, settings=TABLE_IV)
    for changes in ({"batch_size": 1, "threads": 1}, {"batch_size": 37, "threads": 2}, {"threads": 5}):
        other = dr.identify(MODEL, log, method, seed=4, settings=replace(TABLE_IV, **changes))
        assert replace(other, settings=usual.settings) == usual


def test_systems_that_do_not_say_which_cores_are_ours_serve_too(monkeypatch):
    """MacOS and Windows know no affinity."""
    monkeypatch.delattr("os.sched_getaffinity", raising=False)
    log = as_log(PLANE, *spoilt(), 0.02)
    assert dr.identify(MODEL, log, "i-diransac", settings=QUICK).iterations == 40


@pytest.mark.parametrize("seed", [-1, 2**80, np.int64(3)])
def test_any_whole_number_is_a_seed(seed):
    assert dr.identify(MODEL, as_log(PLANE, *spoilt(), 0.02), "i-diransac", seed=seed, settings=QUICK).seed == int(seed)


def test_pickled_model_gives_the_same_result():
    import pickle

    log = as_log(PLANE, *spoilt(), 0.02)
    twin = pickle.loads(pickle.dumps(MODEL))
    ours, theirs = (dr.identify(model, log, "i-diransac", settings=TABLE_IV) for model in (MODEL, twin))
    assert ours == theirs


# ---------------------------------------------------------------------- outliers


def clean_error(parameters, signals, inputs):
    """Open-loop error on the clean flight, eq. (2) with Table IV's weights."""
    predicted = rollout(PLANE, list(parameters.values()), signals[0, :6], inputs, 0.01)
    weights = np.array([0.0, 0, 0, 1, 1, 1, 0.1, 0.1, 0.1])
    return float(weights @ np.sqrt(np.mean((predicted - signals) ** 2, axis=0)))


def test_with_outliers_i_diransac_beats_diransac_beats_least_squares():
    """Magnitude 80 at probability 0.1 on all signals; benchmarks/outliers.py has the whole study."""
    signals, inputs = flight(PLANE, 2500, 0.01)
    medians = {}
    for method in ("i-diransac", "diransac", "ols"):
        worst, errors = [], []
        for seed in range(3):
            log = as_log(PLANE, with_outliers(signals, 0.1, 80.0, seed), inputs, 0.01)
            result = dr.identify(MODEL, log, method, seed=seed, settings=given_to(method, dr.Settings.table_iv()))
            worst.append(max(abs(result.parameters[n] / x - 1.0) for n, x in PLANE.truth.items()))
            errors.append(clean_error(result.parameters, signals, inputs))
        medians[method] = np.median(worst), np.median(errors)
    assert medians["i-diransac"][0] < 1e-6 < medians["diransac"][0] < medians["ols"][0]
    assert medians["i-diransac"][1] < 1e-6 < medians["diransac"][1] < medians["ols"][1]


def test_robust_start_saves_what_an_outlier_in_the_first_row_spoils():
    machine, model = MACHINES["underwater-vehicle"], builtin("underwater-vehicle")
    signals, inputs = flight(machine, 600, 0.01)
    signals = with_outliers(signals, 0.1, 5.0, 3)
    signals[0, 1] += 4.0
    log = as_log(machine, signals, inputs, 0.01)
    settings = dr.Settings(sample_size=20, max_iterations=200, stop_inlier_fraction=None)
    robust = dr.identify(model, log, "i-diransac", settings=replace(settings, initial_state="robust"))
    faithful = dr.identify(model, log, "i-diransac", settings=settings)
    assert robust.inlier_fraction > 0.85 > 0.75 > faithful.inlier_fraction
    assert robust.fit_error < faithful.fit_error


@pytest.mark.parametrize("method", SEARCHES)
def test_searches_never_return_what_violates_a_bound(method):
    log = as_log(PLANE, *spoilt(probability=0.3), 0.02)
    result = dr.identify(MODEL, log, method, settings=TABLE_IV)
    assert result.violations == ()
    assert all(bounds.admits(result.parameters[n]) for n, bounds in MODEL.parameters.items())


def test_least_squares_returns_what_violates_a_bound_and_says_so():
    signals, inputs = flight(PLANE, 200, 0.02)
    log = as_log(PLANE, signals, inputs * [1.0, -1.0], 0.02)
    result = dr.identify(MODEL, log, "ols")
    assert result.violations == ("inertia",)
    assert result.parameters["inertia"] == pytest.approx(-0.004)
    assert "inertia" in str(result).split("!", 1)[1]


# ---------------------------------------------------------------------- what is told on the way


@pytest.mark.parametrize("differentiate", [False, True])
@pytest.mark.parametrize("method", dr.METHODS)
def test_progress_never_falls_and_ends_at_one(method, differentiate):
    calls = []
    log = as_log(PLANE, *spoilt(), 0.02)
    dr.identify(
        MODEL, log, method, settings=given_to(method, TABLE_IV), differentiate=differentiate, progress=calls.append
    )
    fractions = [x.fraction for x in calls]
    assert fractions == sorted(fractions)
    assert fractions[0] >= 0.0
    assert fractions[-1] == 1.0
    assert all(isinstance(x, dr.Progress) and x.stage for x in calls)


def test_progress_of_a_search_notes_the_inliers_that_it_has_found():
    calls = []
    log = as_log(PLANE, *spoilt(), 0.02)
    result = dr.identify(MODEL, log, "i-diransac", settings=TABLE_IV, progress=calls.append)
    assert [x.note for x in calls if x.stage == "searching"][-1] == f"{result.inlier_fraction:.0%} inliers"


def test_least_squares_says_that_it_fitted_everything():
    result = dr.identify(MODEL, as_log(PLANE, *spoilt(), 0.02), "ols")
    assert (result.stop_reason, result.iterations, result.n_hypotheses) == ("whole log fitted", 0, 1)
    assert result.estimator == "OrdinaryLeastSquares"


def test_result_knows_its_log():
    log = as_log(PLANE, *spoilt(), 0.02)
    result = dr.identify(MODEL, log, "ols")
    (of_log,) = result.logs
    assert (of_log.fingerprint, of_log.n_rows, of_log.dt, of_log.remark) == (log.fingerprint, 300, log.dt, "")
    assert (of_log.fit_error, of_log.inlier_fraction) == (result.fit_error, result.inlier_fraction)


# ---------------------------------------------------------------------- logs that can do less


def test_log_of_accelerations_and_inputs_alone_serves_pointwise_methods():
    """A thrust curve from an IMU and motor commands."""
    model = dr.Model(
        name="thrust-curve",
        coordinates={"z": "m"},
        inputs={"command": "1"},
        parameters={"linear": dr.Parameter("m/s^2"), "square": dr.Parameter("m/s^2")},
        equations=lambda q, v, a, u, p: [a.z - p.linear * u.command - p.square * u.command**2],
    )
    rng = np.random.default_rng(0)
    command = rng.uniform(0.2, 0.9, 500)
    measured = 7.0 * command + 11.0 * command**2 + 0.1 * rng.normal(size=500)
    log = dr.Log.from_arrays(np.arange(500) * 0.001, {"z_ddot": measured, "command": command})
    for method in dr.METHODS:
        result = dr.identify(model, log, method, settings=given_to(method, QUICK))
        assert result.parameters == pytest.approx({"linear": 7.0, "square": 11.0}, abs=0.5)
        assert result.fit_error > 0.0


def test_search_without_an_initial_state_says_which_and_what_to_try():
    log = as_log(PLANE, *flight(PLANE, 300, 0.02), 0.02)
    columns = {n: log[n] for n in log.names if n != "theta_dot"}
    partial = dr.Log.from_arrays(log.time, columns, source='log "imu.csv"')
    with pytest.raises(LogError, match=r'"imu.csv".*"theta_dot".*initial_state') as caught:
        dr.identify(MODEL, partial, "i-diransac", settings=QUICK)
    assert len(str(caught.value).splitlines()) == 1
    weights = {n: x for n, x in TABLE_IV.error_weights.items() if n != "theta_dot"}
    thresholds = {n: x for n, x in TABLE_IV.inlier_thresholds.items() if n != "theta_dot"}
    given = replace(TABLE_IV, error_weights=weights, inlier_thresholds=thresholds, initial_state={"theta_dot": 0.1})
    result = dr.identify(MODEL, partial, "i-diransac", settings=given)
    assert result.parameters == pytest.approx(PLANE.truth, rel=1e-8)
    assert result.fit_error < 1e-9


def test_fewer_rows_than_a_sample_are_refused():
    log = as_log(PLANE, *spoilt(n_rows=50), 0.02)
    with pytest.raises(LogError, match="50 usable rows are fewer than sample_size = 75"):
        dr.identify(MODEL, log, "i-diransac")
    assert dr.identify(MODEL, log, "ols").n_fitted == 50


@pytest.mark.parametrize("method", dr.METHODS)
def test_log_in_which_nothing_moves_is_refused(method):
    columns = dict.fromkeys((*PLANE.signals, *PLANE.inputs), np.zeros(200))
    with pytest.raises(IdentificationError, match=r"not identifiable|within their bounds"):
        dr.identify(MODEL, dr.Log.from_arrays(np.arange(200) * 0.01, columns), method)


def test_estimate_that_is_not_finite_is_refused():
    """Total least squares of a right-hand side at right angles to every column has no solution."""
    model = dr.Model(
        name="right-angles",
        coordinates={"x": "m"},
        inputs={"f": "N"},
        parameters={"m": dr.Parameter("kg"), "c": dr.Parameter("N s/m")},
        equations=lambda q, v, a, u, p: [p.m * a.x + p.c * v.x - u.f],
    )
    a = np.tile([1.0, 1.0, -1.0, -1.0], 50)
    f = np.tile([1.0, -1.0, 1.0, -1.0], 50)
    v = a + 0.2 * np.tile([1.0, -1.0, -1.0, 1.0], 50)
    log = dr.Log.from_arrays(np.arange(200) * 0.01, {"x": np.zeros(200), "x_dot": v, "x_ddot": a, "f": f})
    with pytest.raises(IdentificationError, match="tls finds no finite parameters"):
        dr.identify(model, log, "tls")
    assert dr.identify(model, log, "ols").parameters == pytest.approx({"m": 0.0, "c": 0.0}, abs=1e-12)


def test_nothing_accepted_says_how_many_failed_at_which_step():
    """Where the signs of the inputs are the cause, they are said in place of the count, which is the error before."""
    signals, inputs = flight(PLANE, 300, 0.02)
    log = as_log(PLANE, signals, -inputs, 0.02)
    with pytest.raises(IdentificationError, match=r"signs of thrust and moment .*--scale thrust=-1,moment=-1") as said:
        dr.identify(MODEL, log, "i-diransac", settings=QUICK)
    assert "in 40 samples (40 out of bounds): " in str(said.value.__cause__)


# ---------------------------------------------------------------------- arguments without meaning


@pytest.mark.parametrize(
    ("changes", "error", "says"),
    [
        ({"model": "planar-rotorcraft"}, SettingsError, "give a dr.Model"),
        ({"logs": "flight.csv"}, SettingsError, "give a dr.Log"),
        ({"method": "ransac"}, SettingsError, '"ransac"; there are ols, tls, nls'),
        ({"seed": 1.5}, SettingsError, "seed is 1.5"),
        ({"seed": True}, SettingsError, "seed is True"),
        ({"settings": {"sample_size": 30}}, SettingsError, "settings"),
        (
            {"method": "ols", "settings": None, "estimator": dr.TotalLeastSquares()},
            SettingsError,
            '"ols" is an estimator itself',
        ),
        ({"method": "i-diransac", "estimator": "huber"}, SettingsError, "estimator is 'huber'"),
        ({"bandwidth": 5.0}, SettingsError, "without differentiate"),
        (
            {"method": "lo-diransac", "settings": None, "bandwidth": 5.0, "differentiate": True},
            SettingsError,
            "lo-diransac",
        ),
        ({"method": dr.LoDiransac}, SettingsError, "method is .*give a name"),
        ({"method": dr.LoDiransac()}, SettingsError, "a method object has its own"),
        ({"logs": []}, SettingsError, "dr.Log"),
        ({"settings": replace(QUICK, error_weights={"y": 1.0})}, SettingsError, 'no signal "y"'),
        ({"settings": replace(QUICK, error_weights={"x_dot": 0.0})}, SettingsError, "every error weight is zero"),
        ({"settings": replace(QUICK, min_inlier_signals=7)}, SettingsError, "min_inlier_signals = 7, but 6"),
        ({"settings": replace(QUICK, inlier_thresholds={})}, SettingsError, "min_inlier_signals"),
    ],
    ids=lambda x: str(x)[:40] if not isinstance(x, type) else "",
)
def test_arguments_without_meaning_are_refused(changes, error, says):
    arguments = {
        "model": MODEL,
        "logs": as_log(PLANE, *spoilt(), 0.02),
        "method": "i-diransac",
        "settings": QUICK,
    } | changes
    with pytest.raises(error, match=says):
        dr.identify(**arguments)


def test_linear_estimator_in_a_search_refuses_a_nonlinear_model():
    model = dr.Model(
        name="square",
        coordinates={"x": "m"},
        inputs={"thrust": "N"},
        parameters={"m": dr.Parameter(positive=True), "k": dr.Parameter()},
        equations=lambda q, v, a, u, p: [p.m * a.x + p.k**2 * v.x - u.thrust],
    )
    machine = MACHINES["underwater-vehicle"]
    log = as_log(machine, *flight(machine, 200, 0.05), 0.05)
    with pytest.raises(ModelError, match="not affine in k"):
        dr.identify(model, log, "i-diransac", estimator=dr.OrdinaryLeastSquares(), settings=QUICK)


# ---------------------------------------------------------------------- settings without a use


JUDGING = (("inlier_thresholds", {"x_dot": 0.5}), ("min_inlier_signals", 2), ("error_weights", {"x_dot": 1.0}))
SIMULATION = (("integrator", "euler"), ("substeps", 3))
EVERY_SETTING = (
    ("sample_size", 30),
    ("max_iterations", 7),
    ("stop_inlier_fraction", 0.5),
    ("acceptance_weights", (1.0, 0.0)),
    ("refit", "none"),
    *JUDGING,
    *SIMULATION,
    ("initial_state", "robust"),
    ("threads", 1),
    ("batch_size", 3),
)
FOR_ALL = ("initial_state", "threads", "batch_size", *(name for name, _ in JUDGING))
USED = {
    **{name: {*FOR_ALL, "integrator", "substeps"} for name in ("ols", "tls", "nls")},
    "diransac": {*FOR_ALL, "integrator", "substeps", "sample_size", "max_iterations", "refit"},
    "i-diransac": {name for name, _ in EVERY_SETTING},
    "lo-diransac": set(FOR_ALL),
}


@pytest.mark.parametrize(("name", "value"), EVERY_SETTING)
@pytest.mark.parametrize("method", dr.METHODS)
def test_setting_that_a_method_has_no_use_for_is_refused_and_others_are_not(method, name, value):
    log, settings = as_log(PLANE, *flight(PLANE, 200, 0.02), 0.02), dr.Settings(**{name: value})
    if name in USED[method]:
        assert dr.identify(MODEL, log, method, settings=settings).settings == settings
        return
    with pytest.raises(SettingsError, match=f'"{method}" has no use for the setting {name} = ') as caught:
        dr.identify(MODEL, log, method, settings=settings)
    assert len(str(caught.value).splitlines()) == 1


def test_diransac_takes_no_early_stop_for_an_answer_because_it_never_stops_early():
    log = as_log(PLANE, *spoilt(), 0.02)
    settings = dr.Settings(sample_size=30, max_iterations=40)
    usual = dr.identify(MODEL, log, "diransac", settings=settings)
    never = dr.identify(MODEL, log, "diransac", settings=replace(settings, stop_inlier_fraction=None))
    assert (never.parameters, never.iterations) == (usual.parameters, 40)


def test_method_object_gives_what_its_name_gives():
    log = as_log(PLANE, *spoilt(), 0.02)
    pairs = (
        (dr.IDiransac(QUICK), "i-diransac", QUICK),
        (dr.Diransac(QUICK), "diransac", QUICK),
        (dr.LeastSquares(), "ols", None),
        (dr.LeastSquares(dr.TotalLeastSquares()), "tls", None),
        (dr.LoDiransac(), "lo-diransac", None),
    )
    for method, name, settings in pairs:
        assert dr.identify(MODEL, log, method) == dr.identify(MODEL, log, name, settings=settings)


def test_failure_of_linear_algebra_is_not_blamed_on_a_motion_whose_rates_the_log_lacks():
    class Failing(dr.LoDiransac):
        def fit(self, *_):
            raise np.linalg.LinAlgError("Eigenvalues did not converge")

    t = 0.01 * np.arange(500)
    log = dr.Log.from_arrays(t, {"x": np.sin(3.0 * t), "f": -9.0 * np.sin(3.0 * t)})
    parameters = {"m": dr.Parameter("kg", positive=True)}
    model = dr.Model("mass", {"x": "m"}, {"f": "N"}, parameters, lambda q, v, a, u, p: [p.m * a.x - u.f])
    with pytest.raises(
        IdentificationError, match=r"not finite \(Eigenvalues did not converge\): the fit diverges"
    ) as raised:
        dr.identify(model, log, Failing(), differentiate=True)
    assert "excite" not in str(raised.value)
