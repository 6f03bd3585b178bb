"""Fixed parameters and priors: against models with the constants written in, and textbook posteriors."""

import json

import casadi as ca
import numpy as np
import pytest

import diransac as dr
from command_line import run
from diransac.data.dataset import Dataset
from diransac.identification.methods import METHODS, WITH_ESTIMATOR
from diransac.identification.methods.least_squares import bound_to, fitted
from diransac.identification.regression.estimators import OrdinaryLeastSquares
from diransac.identification.regression.nonlinear import NonlinearLeastSquares
from user_models import tumbling

MASS, DRAG, GAIN, DT = 0.25, 0.4, 1.7, 0.02
SOME = {"drag": dr.Parameter("N s/m", lower=0.0), "gain": dr.Parameter("N/V", positive=True)}
EVERY = {"mass": dr.Parameter("kg", positive=True, value=MASS), **SOME}


def cart(parameters=EVERY, mass=None, gain=None):
    """``m a + c v = k u``, with constants where they are given."""

    def equations(q, v, a, u, p):
        m, k = p.mass if mass is None else mass, p.gain if gain is None else gain
        return [m * a.x + p.drag * v.x - k * u.u]

    return dr.Model("cart", {"x": "m"}, {"u": "V"}, parameters, equations)


def cart_log(n=500, seed=0, drag=DRAG, acceleration_noise=0.02, dry=0.0, source="log"):
    """The exact motion of a cart under held inputs, from rest, with noise in every signal."""
    t, rng = DT * np.arange(n), np.random.default_rng(seed)
    u = np.sin(0.9 * t + seed) + 0.7 * np.sin(2.3 * t)
    x, v, a, decay = np.zeros(n), np.zeros(n), np.zeros(n), np.exp(-drag * DT / MASS)
    for k in range(n):
        force = GAIN * u[k] - dry * np.tanh(20.0 * v[k])
        a[k] = (force - drag * v[k]) / MASS
        if k + 1 < n:
            final = force / drag
            v[k + 1] = final + decay * (v[k] - final)
            x[k + 1] = x[k] + final * DT + (v[k] - final) * (1.0 - decay) * MASS / drag
    signals = {
        "x": x + 1e-4 * rng.normal(size=n),
        "x_dot": v + 1e-4 * rng.normal(size=n),
        "x_ddot": a + acceleration_noise * rng.normal(size=n),
        "u": u,
    }
    return dr.Log.from_arrays(t, signals, source=source)


def identify(model, log, method, **arguments):
    settings = dr.Settings(max_iterations=30, sample_size=40) if method in WITH_ESTIMATOR else None
    return dr.identify(model, log, method, settings=settings, **arguments)


# ---------------------------------------------------------------------- fixed


@pytest.mark.parametrize("method", METHODS)
def test_scale_free_model_is_refused_until_one_parameter_is_fixed(method):
    log = cart_log()
    with pytest.raises(
        dr.IdentificationError, match=r'ratios drag/mass, gain/mass.*by fixed=\{"mass": ...\} or --fix m'
    ):
        identify(cart(), log, method)
    result = identify(cart(), log, method, fixed={"mass": MASS})
    assert result.fixed == ("mass",)
    assert list(result.parameters) == ["mass", "drag", "gain"]
    assert result.parameters["mass"] == MASS
    assert result.standard_errors["mass"] == 0.0
    assert result.intervals()["mass"] == (MASS, MASS)
    assert result.parameters["drag"] == pytest.approx(DRAG, rel=0.01)
    assert result.parameters["gain"] == pytest.approx(GAIN, rel=0.01)
    assert 0.0 < result.standard_errors["gain"] < 0.02 * GAIN


@pytest.mark.parametrize("method", ["ols", "i-diransac", "lo-diransac"])
def test_fixed_parameter_is_a_constant_of_the_equations(method):
    log = cart_log(seed=3)
    given, written = identify(cart(), log, method, fixed={"mass": 0.3}), identify(cart(SOME, mass=0.3), log, method)
    for name in written.parameters:
        assert given.parameters[name] == written.parameters[name]
        assert given.standard_errors[name] == written.standard_errors[name]
    assert np.array_equal(given.inliers, written.inliers)
    assert given.verdict == written.verdict


def test_names_alone_fix_nominal_values():
    log = cart_log()
    by_value = dr.identify(cart(), log, "ols", fixed={"mass": MASS})
    assert dr.identify(cart(), log, "ols", fixed=["mass"]) == by_value
    assert dr.identify(cart(), log, "ols", fixed={"mass": None}) == by_value


def test_nominal_values_are_stored_with_the_model_and_must_be_within_bounds():
    stored = dr.Model.from_dict(json.loads(json.dumps(cart().to_dict())))
    assert stored == cart()
    assert stored.parameters["mass"].value == MASS
    assert stored.parameters["drag"].value is None
    for value in (-1.0, np.nan, np.inf):
        with pytest.raises(dr.ModelError, match="outside its bounds"):
            dr.Parameter("kg", positive=True, value=value)


def test_a_result_with_fixed_parameters_is_saved_shown_and_simulated(tmp_path):
    log = cart_log(n=300)
    result = dr.identify(cart(), log, "ols", fixed={"mass": MASS}, priors={"drag": (0.41, 0.05)})
    result.save(tmp_path / "model.json")
    loaded = dr.Result.load(tmp_path / "model.json")
    assert loaded == result
    assert loaded.fixed == ("mass",)
    assert loaded.priors == {"drag": (0.41, 0.05)}
    assert result.to_dict()["fixed"] == ["mass"]
    assert "fixed" in next(line for line in str(result).splitlines() if line.startswith("mass"))
    assert "prior of drag = 0.41 ± 0.05 N s/m" in str(result)
    assert "mass is fixed at 0.25 kg, not identified." in result.findings
    assert min(dr.validate(loaded, log).r_squared.values()) > 0.99
    dr.write_report(result, log, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert '<td class="number">fixed</td>' in page


def test_a_fixed_value_on_a_bound_is_no_stop_of_the_estimator():
    result = dr.identify(cart(), cart_log(), "ols", fixed={"drag": 0.0, "mass": MASS})
    assert result.on_bounds == ()
    assert np.isfinite(result.standard_errors["gain"])


def test_logs_share_a_fixed_parameter_and_keep_their_own_others():
    own = {**EVERY, "drag": dr.Parameter("N s/m", lower=0.0, per_log=True)}
    logs = [cart_log(seed=k, drag=drag, source=f"{drag}") for k, drag in enumerate((0.3, 0.5))]
    result = dr.identify(cart(own), logs, "ols", fixed=["mass"])
    assert result.per_log["drag"] == pytest.approx((0.3, 0.5), rel=0.01)
    assert result.parameters["mass"] == MASS
    assert not any(log.remark for log in result.logs)
    everywhere = dr.identify(cart(own), logs, "ols", fixed={"mass": MASS, "drag": 0.4})
    assert everywhere.parameters["drag"] == pytest.approx(0.4)
    assert "drag" not in everywhere.per_log
    assert dr.Result.from_dict(everywhere.to_dict()) == everywhere


def test_cross_validation_fixes_parameters_in_every_fold():
    found = dr.cross_validate(cart(), [cart_log(seed=k) for k in range(3)], "ols", fixed=["mass"])
    assert [x.parameters["mass"] for x in found.results] == [MASS] * 3
    assert found.rmse["x"] < 0.05


def test_kinematics_and_quaternions_survive_a_fixed_parameter():
    model = tumbling().with_fixed({"Jy": 2.0})
    assert list(model.parameters) == ["Jx", "Jz"]
    assert model.quaternions == ((0, 1, 2, 3),)
    motion = np.random.default_rng(0).normal(size=13)
    q, v, a, u = np.split(motion, [4, 7, 10])
    expected = np.array(tumbling().residual(q, v, a, u, [1.0, 2.0, 3.0]))
    assert np.array(model.residual(q, v, a, u, [1.0, 3.0])) == pytest.approx(expected)


def test_suggested_terms_are_added_to_the_whole_model():
    log = cart_log(n=1000, dry=0.3, acceleration_noise=0.01)
    result = dr.identify(cart(), log, fixed=["mass"], with_suggestions=True)
    assert result.parameters["mass"] == MASS
    assert set(EVERY) < set(result.model.parameters)
    assert result.parameters["gain"] == pytest.approx(GAIN, rel=0.05)


# ---------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"fixed": {"weight": 1.0}}, 'has no parameter "weight"; it has mass, drag, gain'),
        ({"fixed": {"mass": np.nan}}, "the fixed value of mass is nan; give a finite number"),
        ({"fixed": {"mass": "heavy"}}, "the fixed value of mass is 'heavy'"),
        ({"fixed": {"mass": -1.0}}, "the fixed value -1 of mass is outside its bounds"),
        ({"fixed": ["drag"]}, "drag has no nominal value"),
        ({"fixed": "mass"}, "fixed is 'mass'"),
        ({"fixed": {"mass": 1.0, "drag": 1.0, "gain": 1.0}}, "all parameters are fixed"),
        ({"fixed": {"mass": 1.0}, "priors": {"mass": (1.0, 0.1)}}, "mass is fixed and has a prior"),
        ({"priors": {"weight": (1.0, 0.1)}}, 'has no parameter "weight"'),
        ({"priors": {"drag": 0.4}}, "the prior of drag is 0.4; give its mean and standard deviation"),
        ({"priors": {"drag": (0.4, 0.0)}}, "standard deviation of drag is 0; give a positive number, or fix drag"),
        ({"priors": {"drag": (0.4, np.inf)}}, "standard deviation of drag is inf"),
        ({"priors": {"drag": (-0.4, 0.1)}}, "the prior mean -0.4 of drag is outside its bounds"),
        ({"priors": ["drag"]}, "priors is"),
    ],
)
def test_bad_arguments_are_refused_in_a_sentence(arguments, message):
    with pytest.raises(dr.SettingsError) as error:
        dr.identify(cart(), cart_log(n=60), "ols", **arguments)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


# ---------------------------------------------------------------------- priors


def posterior(log, prior_mean, prior_std, noise):
    """Posterior of ``(c, k)`` in ``a = (k u - c v) / m`` with known noise of a, by the textbook's formula."""
    W = np.stack([-log["x_dot"], log["u"]], axis=1) / MASS
    information = W.T @ W / noise**2 + np.diag([prior_std**-2.0, 0.0])
    right = W.T @ log["x_ddot"] / noise**2 + [prior_mean / prior_std**2, 0.0]
    return np.linalg.solve(information, right), np.linalg.inv(information)


@pytest.mark.parametrize(
    ("estimator", "n_runs"), [(OrdinaryLeastSquares(), 60), (NonlinearLeastSquares(n_starts=1, n_followed=1), 20)]
)
def test_least_squares_with_a_prior_is_the_posterior_of_the_linear_gaussian_model(estimator, n_runs):
    """Over many logs and priors drawn about the truth: its mean, its deviation, and the coverage of its intervals."""
    noise, std, rng = 1.0, 0.02, np.random.default_rng(5)
    model, errors, off, inside = cart(SOME, mass=MASS), [], [], 0
    for seed in range(n_runs):
        log = cart_log(n=150, seed=seed, acceleration_noise=noise)
        mean = DRAG + std * rng.normal()
        dataset = Dataset.of(model, log, priors={"drag": (mean, std)})
        bound = bound_to(estimator, dataset)
        rows = np.arange(bound.n_rows)
        found = fitted(bound, dataset, bound.select([rows]).fit()[0], rows, estimator="x")
        exact, covariance = posterior(log, mean, std, noise)
        off.append((found.values - exact)[0] / np.sqrt(covariance[0, 0]))
        errors.append(found.values[0] - DRAG)
        inside += abs(errors[-1]) < 2.26 * np.sqrt(found.covariance[0, 0])  # t, nine degrees of freedom
    assert np.sqrt(np.mean(np.square(off))) < 0.4
    assert np.sqrt(np.mean(np.square(errors))) < 1.3 * np.sqrt(covariance[0, 0])
    assert inside / n_runs >= 0.88


def test_prior_counts_for_more_where_residuals_are_correlated():
    """Noise with the same variance but correlated in time leaves less information in as many rows."""
    rng, model = np.random.default_rng(8), cart(SOME, mass=MASS)
    log = cart_log(n=600, acceleration_noise=0.0)
    white = rng.normal(size=600)
    slow = np.convolve(rng.normal(size=640), np.ones(41) / np.sqrt(41.0), mode="valid")

    def pull(noise):
        noisy = dr.Log.from_arrays(log.time, {n: log[n] + (noise if n == "x_ddot" else 0.0) for n in log.signals})
        free = dr.identify(model, noisy, "ols").parameters["drag"]
        drawn = dr.identify(model, noisy, "ols", priors={"drag": (free + 0.05, 0.05)}).parameters["drag"]
        return (drawn - free) / 0.05

    assert pull(slow) > 4.0 * pull(white) > 0.0


@pytest.mark.parametrize("method", METHODS)
def test_a_narrow_prior_is_the_estimate_and_a_wide_one_has_no_effect(method):
    log, model = cart_log(n=300, acceleration_noise=0.1), cart(SOME, mass=MASS)
    free = identify(model, log, method)
    narrow = identify(model, log, method, priors={"drag": (DRAG, 1e-9)})
    assert narrow.parameters["drag"] == pytest.approx(DRAG, abs=1e-7)
    assert narrow.standard_errors["drag"] == pytest.approx(1e-9, rel=0.05)
    wide = identify(model, log, method, priors={"drag": (DRAG, 1e3)})
    for name, error in free.standard_errors.items():
        assert abs(wide.parameters[name] - free.parameters[name]) < 0.1 * error
        assert wide.standard_errors[name] == pytest.approx(error, rel=0.1)


def test_lo_diransac_combines_log_and_prior_by_their_precision():
    log, model = cart_log(n=400), cart(SOME, mass=MASS)
    free = dr.identify(model, log)
    p, error = free.parameters["drag"], free.standard_errors["drag"]
    result = dr.identify(model, log, priors={"drag": (p + 2.0 * error, error)})
    assert result.parameters["drag"] == pytest.approx(p + error, abs=0.2 * error)
    assert result.standard_errors["drag"] == pytest.approx(error / np.sqrt(2.0), rel=0.1)


@pytest.mark.parametrize("method", ["ols", "tls", "nls", "i-diransac", "lo-diransac"])
def test_a_prior_alone_determines_the_scale_of_homogeneous_equations(method):
    result = identify(cart(), cart_log(), method, priors={"mass": (MASS, 0.01)})
    assert result.parameters["mass"] == MASS
    assert result.parameters["gain"] == pytest.approx(GAIN, rel=0.01)
    for name, x in result.parameters.items():  # the deviation of the mass is that of the scale
        assert result.standard_errors[name] / x == pytest.approx(0.01 / MASS, rel=0.05)
    correlation = result.covariance[0, 2] / (result.standard_errors["mass"] * result.standard_errors["gain"])
    assert correlation > 0.99


def test_several_priors_of_a_scale_are_combined():
    priors = {"mass": (MASS, 0.01), "gain": (1.1 * GAIN, 0.04 * GAIN)}  # of the scale: 1 +- 0.04 and 1.1 +- 0.04
    result = dr.identify(cart(), cart_log(), "ols", priors=priors)
    assert result.parameters["mass"] / MASS == pytest.approx(1.05, abs=0.005)
    assert result.parameters["drag"] / DRAG == pytest.approx(1.05, abs=0.005)
    assert result.standard_errors["mass"] / MASS == pytest.approx(0.04 / np.sqrt(2.0), rel=0.1)


def test_a_prior_separates_parameters_of_which_the_equations_determine_the_sum():
    both = {"mass": EVERY["mass"], "one": dr.Parameter("N s/m"), "other": dr.Parameter("N s/m")}
    model = dr.Model(
        "cart",
        {"x": "m"},
        {"u": "V"},
        both,
        lambda q, v, a, u, p: [p.mass * a.x + (p.one + p.other) * v.x - GAIN * u.u],
    )
    result = dr.identify(model, cart_log(), "ols", priors={"one": (0.1, 0.02)})
    assert result.parameters["other"] == pytest.approx(DRAG - 0.1, rel=0.01)
    assert result.standard_errors["other"] == pytest.approx(0.02, rel=0.01)


def test_a_prior_that_the_log_contradicts_is_a_finding():
    contradicted = dr.identify(cart(SOME, mass=MASS), cart_log(), "ols", priors={"drag": (0.6, 0.05)})
    (finding,) = (x for x in contradicted.findings if "contradicts the prior of drag" in x)
    assert finding.level == "care"
    assert contradicted.verdict == "usable with care"
    agreeing = dr.identify(cart(SOME, mass=MASS), cart_log(), "ols", priors={"drag": (0.45, 0.05)})
    assert "The estimate of drag uses the prior 0.45 ± 0.05." in agreeing.findings


def test_a_prior_of_a_per_log_parameter_is_one_of_each_value():
    own = {**SOME, "drag": dr.Parameter("N s/m", lower=0.0, per_log=True)}
    logs = [cart_log(n=200, seed=k, drag=0.4 + 0.1 * k, source=str(k)) for k in range(2)]
    result = dr.identify(cart(own, mass=MASS), logs, "ols", priors={"drag": (0.42, 1e-9)}, compare_logs=False)
    assert result.per_log["drag"] == pytest.approx((0.42, 0.42), abs=1e-6)


def test_scikit_learn_regressors_take_priors_as_rows():
    from sklearn.linear_model import LinearRegression

    model, log, priors = cart(SOME, mass=MASS), cart_log(n=200, acceleration_noise=0.3), {"drag": (0.5, 0.01)}
    same = [
        dr.identify(model, log, dr.LeastSquares(estimator), priors=priors)
        for estimator in (LinearRegression(), dr.OrdinaryLeastSquares())
    ]
    for name in SOME:
        assert same[0].parameters[name] == pytest.approx(same[1].parameters[name], rel=1e-9)
        assert same[0].standard_errors[name] == pytest.approx(same[1].standard_errors[name], rel=1e-6)


def test_a_prior_of_a_nonlinear_model_is_part_of_its_fit():
    model = dr.Model(
        "bent",
        {"x": "m"},
        {"u": "V"},
        {"rate": dr.Parameter("s/m"), "gain": dr.Parameter("N/V", positive=True)},
        lambda q, v, a, u, p: [MASS * a.x + ca.exp(p.rate * v.x) - 1.0 - p.gain * u.u],
    )
    log = cart_log(n=200)
    free = dr.identify(model, log, "nls").parameters["rate"]
    drawn = dr.identify(model, log, "nls", priors={"rate": (free + 0.1, 1e-8)}).parameters["rate"]
    assert drawn == pytest.approx(free + 0.1, abs=1e-6)


# ---------------------------------------------------------------------- command line

CART = """
from diransac import Model, Parameter
model = Model(
    name="cart", coordinates={"x": "m"}, inputs={"u": "V"},
    parameters={"mass": Parameter("kg", positive=True, value=0.25), "drag": Parameter("N s/m", lower=0),
                "gain": Parameter("N/V", positive=True)},
    equations=lambda q, v, a, u, p: [p.mass * a.x + p.drag * v.x - p.gain * u.u],
)
"""


@pytest.fixture
def command(tmp_path):
    """Words of a command on a log of a cart, with its model."""
    (tmp_path / "cart.py").write_text(CART)
    cart_log().write(tmp_path / "log.csv")
    return lambda name: (name, tmp_path / "log.csv", "--model", tmp_path / "cart.py")


def test_command_line_fixes_parameters_and_takes_priors(command):
    known = ("--method", "ols", "--fix", "mass=0.25", "--prior", "drag=0.4,0.1", "--json")
    found = json.loads(run(*command("identify"), *known).stdout)
    assert found["fixed"] == ["mass"]
    assert found["priors"] == {"drag": [0.4, 0.1]}
    assert found["standard_errors"]["mass"] == 0.0
    nominal = json.loads(run(*command("identify"), *known[:2], "--fix", "mass", *known[4:]).stdout)
    assert nominal["parameters"] == found["parameters"]


def test_command_line_compares_methods_with_a_fixed_parameter(command):
    shown = run(*command("compare"), "--methods", "ols,nls", "--fix", "mass=0.25")
    assert shown.exit_code == 0
    assert shown.stdout.count("0.25 fixed") == 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--fix", "weight=1"), 'has no parameter "weight"'),
        (("--fix", "mass=heavy"), "could not convert"),
        (("--fix", "mass=nan"), "is nan"),
        (("--fix", "drag"), "has no nominal value"),
        (("--fix", "mass,mass=1"), "mass is given twice"),
        (("--fix", "mass=1", "--prior", "mass=1,0.1"), "is fixed and has a prior"),
        (("--prior", "drag=0.4"), "is not name=mean,standard deviation"),
        (("--prior", "drag=0.4,-1"), "is -1; give a positive number"),
        (("--prior", "drag=0.4,1", "--prior", "drag=0.4,1"), "drag is given twice"),
    ],
)
def test_command_line_refuses_bad_values_in_a_sentence(command, options, message):
    refused = run(*command("identify"), "--method", "ols", *options)
    assert refused.exit_code != 0
    text = " ".join(refused.stderr.replace("│", " ").split())
    assert message in text
    assert "Traceback" not in text
