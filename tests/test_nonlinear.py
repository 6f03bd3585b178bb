"""Nonlinear least squares: models that are not affine in their parameters, with no starting values."""

from dataclasses import replace

import numpy as np
import pytest

import diransac as dr
from diransac.data.dataset import Dataset
from diransac.errors import IdentificationError, ModelError
from diransac.identification.regression.multistart import least_squares
from diransac.model import Parameter
from diransac.model.library import builtin
from simulated import MACHINES, as_log, flight, with_outliers
from user_models import hanging_mass

TRUTH = {"l": 0.43, "m": 1.7, "c": 0.06}


def swing(n=400, dt=0.01, truth=TRUTH, noise=0.0, seed=0):
    """A log of the hanging mass, stepped by a plain Runge-Kutta loop."""
    length, mass, drag = truth["l"], truth["m"], truth["c"]
    inertia = mass * length**2

    def acceleration(x, u):
        return -(9.81 * np.sin(x[0]) + u[0] * np.cos(x[0])) / length - (drag * x[1] - u[1]) / inertia

    def rate(x, u):
        return np.array([x[1], acceleration(x, u)])

    x, rows, inputs = np.array([0.5, 0.0]), [], []
    for k in range(n):
        t = k * dt
        u = np.array([3.0 * np.sin(4.0 * t) + np.sin(9.0 * t), 1.2 * np.sin(2.7 * t + 1.0)])
        rows.append([*x, acceleration(x, u)])
        inputs.append(u)
        k1 = rate(x, u)
        k2 = rate(x + dt / 2 * k1, u)
        k3 = rate(x + dt / 2 * k2, u)
        x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + dt * k3, u))
    signals = np.array(rows)
    signals = signals + noise * signals.std(axis=0) * np.random.default_rng(seed).normal(size=signals.shape)
    return log_of(signals, np.array(inputs), dt)


def log_of(signals, inputs, dt):
    columns = {"angle": signals[:, 0], "angle_dot": signals[:, 1], "angle_ddot": signals[:, 2]}
    return dr.Log.from_arrays(np.arange(len(signals)) * dt, columns | {"pivot": inputs[:, 0], "torque": inputs[:, 1]})


@pytest.mark.parametrize(
    "truth",
    [TRUTH, {"l": 12.0, "m": 0.03, "c": 0.001}, {"l": 0.05, "m": 40.0, "c": 2.0}, {"l": 0.43, "m": 1.7, "c": 0.0}],
    ids=str,
)
def test_length_that_enters_as_1_over_l_and_its_square_is_found_from_no_starting_value(truth):
    result = dr.identify(hanging_mass(), swing(truth=truth), "nls")
    assert result.parameters == pytest.approx(truth, rel=1e-8, abs=1e-9)


@pytest.mark.parametrize("method", ["diransac", "i-diransac"])
def test_search_falls_back_on_nonlinear_least_squares(method):
    settings = dr.Settings(sample_size=10, max_iterations=5)
    result = dr.identify(hanging_mass(), swing(), method, settings=settings)
    assert result.estimator == "NonlinearLeastSquares"
    assert result.parameters == pytest.approx(TRUTH, rel=1e-8)


@pytest.mark.parametrize("method", ["ols", "tls"])
def test_linear_method_refuses_with_the_parameters_names(method):
    with pytest.raises(ModelError, match="not affine in l, m, c"):
        dr.identify(hanging_mass(), swing(), method)


def test_search_with_outliers_finds_what_a_fit_of_the_whole_log_misses():
    log = swing(n=600)
    spoilt = with_outliers(np.column_stack([log[n] for n in ("angle", "angle_dot", "angle_ddot")]), 0.1, 30.0, 4)
    log = log_of(spoilt, np.column_stack([log["pivot"], log["torque"]]), log.dt)
    settings = dr.Settings(sample_size=8, max_iterations=40)
    searched = dr.identify(hanging_mass(), log, "i-diransac", settings=settings).parameters["l"]
    fitted = dr.identify(hanging_mass(), log, "nls").parameters["l"]
    assert abs(searched / TRUTH["l"] - 1.0) < 1e-6 < 0.1 < abs(fitted / TRUTH["l"] - 1.0)


@pytest.mark.parametrize("name", MACHINES)
def test_affine_model_gets_the_answer_of_linear_regression(name):
    """Noise-free: both find the truth, over parameters from 6e-5 to 95."""
    machine = MACHINES[name]
    signals, inputs = flight(machine, 300, 0.02)
    result = dr.identify(builtin(name), as_log(machine, signals, inputs, 0.02), "nls")
    assert result.parameters == pytest.approx(machine.truth, rel=1e-8)


def test_errors_are_those_of_accelerations_not_of_the_equation():
    """Only the acceleration is noisy: its least squares is unbiased, that of ``m a`` shrinks the mass."""
    machine, rng = MACHINES["underwater-vehicle"], np.random.default_rng(0)
    signals, inputs = flight(machine, 4000, 0.05)
    signals[:, 2] += 0.5 * signals[:, 2].std() * rng.normal(size=4000)
    log = as_log(machine, signals, inputs, 0.05)
    masses = {m: dr.identify(builtin("underwater-vehicle"), log, m).parameters["mass"] for m in ("nls", "ols")}
    assert masses["nls"] == pytest.approx(60.0, rel=0.03)
    assert masses["ols"] < 0.9 * 60.0


@pytest.mark.parametrize("bounds", [{"lower": 0.5}, {"upper": 0.4}, {"lower": 0.5, "upper": 2.0}])
def test_estimate_stays_within_bounds_that_the_truth_violates(bounds):
    parameters = {"l": Parameter("m", positive=True, **bounds), "m": Parameter("kg", positive=True), "c": Parameter()}
    result = dr.identify(hanging_mass(parameters=parameters), swing(), "nls")
    assert result.parameters["l"] == pytest.approx(bounds.get("lower", bounds.get("upper")))
    assert result.violations == ()


@pytest.mark.parametrize("bounds", [{"lower": 0.2, "upper": 0.6}, {"upper": 5.0}, {"lower": 1e-3}])
def test_bounds_around_the_truth_do_not_disturb(bounds):
    parameters = {"l": Parameter("m", positive=True, **bounds), "m": Parameter("kg", positive=True, upper=9.0)}
    parameters["c"] = Parameter(lower=0.0)
    result = dr.identify(hanging_mass(parameters=parameters), swing(), "nls")
    assert result.parameters == pytest.approx(TRUTH, rel=1e-8)


def test_undetermined_parameters_are_named():
    """Without torque and drag, a pendulum's mass never shows."""
    log = swing(n=300)
    inputs = np.column_stack([log["pivot"], np.zeros(300)])
    still = log_of(still_swing(inputs, log.dt), inputs, log.dt)
    with pytest.raises(IdentificationError, match="m, c are not identifiable from this log:"):
        dr.identify(hanging_mass(), still, "nls")


def still_swing(inputs, dt):
    """The undamped pendulum under its pivot alone, by small Euler steps: accelerations are exact all the same."""
    x, v, rows = 0.5, 0.0, []
    for pivot, _ in inputs:
        a = -(9.81 * np.sin(x) + pivot * np.cos(x)) / TRUTH["l"]
        rows.append([x, v, a])
        x, v = x + dt * v, v + dt * a
    return np.array(rows)


def test_fits_do_not_depend_on_how_many_are_made_at_a_time():
    bound = dr.NonlinearLeastSquares().bind(Dataset.of(hanging_mass(), swing(noise=0.05)))
    rng = np.random.default_rng(0)
    sets = [rng.permutation(400)[:n] for n in (8, 8, 8, 30, 8, 200)]
    one_by_one = np.concatenate([bound.select([rows]).fit() for rows in sets])
    assert bound.select(sets).fit().tobytes() == one_by_one.tobytes()
    assert bound.select(sets[:4]).fit().tobytes() == one_by_one[:4].tobytes()


def test_search_gives_the_same_bits_for_every_batch_size():
    log = swing(noise=0.05)
    settings = dr.Settings(sample_size=8, max_iterations=6, stop_inlier_fraction=None)
    sizes = (settings.batch_size, 1, 3, 64)
    usual, *others = (
        dr.identify(hanging_mass(), log, "i-diransac", settings=replace(settings, batch_size=n)) for n in sizes
    )
    for batch_size, other in zip(sizes[1:], others, strict=True):
        assert other.parameters == usual.parameters, batch_size
        assert (other.fit_error, other.n_hypotheses) == (usual.fit_error, usual.n_hypotheses), batch_size


def test_leaving_rows_out_is_fitting_the_others():
    bound = dr.NonlinearLeastSquares().bind(Dataset.of(hanging_mass(), swing(noise=0.02)))
    rows = np.arange(400)
    groups = np.array_split(rows, 5)
    others = bound.select([np.setdiff1d(rows, group) for group in groups]).fit()
    assert bound.fit_without(groups, rows) == pytest.approx(others, rel=1e-6)


@pytest.mark.parametrize("priors", [{}, {"l": (0.5, 0.1)}], ids=["no prior", "a prior"])
def test_one_step_leaves_rows_out_to_first_order(priors):
    """What a group changes is small; the step is right but for the square of it."""
    bound = dr.NonlinearLeastSquares().bind(Dataset.of(hanging_mass(), swing(noise=0.02), priors=priors))
    rows = np.arange(400)
    groups = np.array_split(rows, 10)
    whole = bound.select([rows]).fit()[0]
    exact, stepped = (
        bound.fit_without(groups, rows) / whole - 1.0,
        bound.steps_without(groups, rows, whole) / whole - 1.0,
    )
    assert np.abs(stepped - exact).max() < 0.1 * np.abs(exact).max()


def test_estimate_on_its_bound_is_named_and_has_no_interval(tmp_path):
    """A block against which the fit stops says nothing of how well the value is known."""
    bounded = hanging_mass(parameters=hanging_mass().parameters | {"c": Parameter("N m s", lower=0.2)})
    result = dr.identify(bounded, swing(noise=0.02), "nls")
    assert result.parameters["c"] == 0.2
    assert result.on_bounds == ("c",)
    assert not np.isfinite(result.intervals()["c"]).any()
    assert np.isfinite([result.intervals()[name] for name in ("l", "m")]).all()
    assert "! c = 0.2 is on its bound" in str(result)
    assert "too few" not in str(result)
    result.save(tmp_path / "result.json")
    assert dr.Result.load(tmp_path / "result.json") == result


def test_value_fixed_by_equal_bounds_is_not_on_a_bound():
    fixed = hanging_mass(parameters=hanging_mass().parameters | {"c": Parameter("N m s", lower=0.06, upper=0.06)})
    assert dr.identify(fixed, swing(), "nls").on_bounds == ()


class Parabolas:
    """Lanes with minima at whole numbers, of a cost that rounds."""

    def __init__(self):
        self.tried = []

    def moved(self, now, step):
        """Unknowns after a step."""
        return now + step

    def linearized(self, z, lanes):
        """Cost, half of its gradient, and half of its curvature; which lanes asked is kept."""
        self.tried.append(lanes.tolist())
        away = z - lanes[:, None]
        return 1.0 + np.square(away).sum(axis=1), away, np.tile(np.eye(2), (len(z), 1, 1))


def test_lanes_end_where_a_step_promises_nothing():
    problem, begin = Parabolas(), np.arange(3.0)[:, None] + [[0.0, 0.0], [3.0, -1.0], [0.0, 1e-6]]
    found, cost = least_squares(problem, begin, 15)
    assert problem.tried[:2] == [[0, 1, 2], [1]]
    assert len(problem.tried) < 8
    np.testing.assert_allclose(found, np.arange(3.0)[:, None] + np.zeros(2), atol=1e-5)
    assert cost == pytest.approx(1.0, abs=1e-9)
