"""Structural intervals: mixtures over terms that a model may lack, against brute force, refits and planted terms."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import diransac as dr
from command_line import run_both
from diransac.identification.methods.lo_diransac import term_regression
from diransac.identification.methods.lo_diransac.missing_terms import Candidates, posterior, probabilities
from diransac.identification.methods.lo_diransac.term_regression import TermRegression
from diransac.identification.structure.candidate_terms import CandidateTerms, candidate_terms
from diransac.identification.structure.lacking_terms import PossibleTerm, mixture_intervals

# ---------------------------------------------------------------------- the mixture, by brute force


def line(rng, n=40, noise=0.3):
    """Readings ``y = 2 x + e`` where nearly all x are alike, and two terms that the line may lack."""
    x = 1.0 + 0.05 * rng.standard_normal(n)
    return x, np.stack([np.ones(n), x**2], axis=1), 2.0 * x + 0.1 * x**2 + noise * rng.standard_normal(n), noise


def candidates_of_line(x, terms, y, noise, kinds):
    """What the package is given: whitened columns of each term beside the slope, and residuals."""
    known = candidate_terms(dr.models.underwater_vehicle(), np.ones(1), np.ones((1, 2)))
    chosen = tuple(next(t for t in known.terms if t.kind == kind) for kind in kinds)
    columns = -(terms - np.outer(x, x @ terms) / (x @ x)) / noise
    residuals = (y - x * (x @ y) / (x @ x)) / noise
    forces = np.zeros((len(x), 1, 2))
    regression = TermRegression(
        -(x @ terms)[None, :] / (x @ x), np.square(columns).sum(axis=0), residuals[:, None], columns[:, None, :],
        forces[:, :, 0], forces, np.ones((1, 2), bool), np.zeros(1),
    )  # fmt: skip
    return Candidates(CandidateTerms((), chosen), np.array([2.0, 3.0]), regression, forces, relative=0.2, odds=0.6)


def by_brute_force(x, terms, y, noise, s, prior, probability):
    """Weights and interval of the slope, on a grid of slopes and coefficients."""
    slopes, theta = np.linspace(-1.0, 5.0, 3001), np.linspace(-6.0, 6.0, 1201)
    squares = y @ y - 2.0 * slopes * (x @ y) + slopes**2 * (x @ x)
    least = squares.min()
    masses = [np.exp(-0.5 * (squares - least) / noise**2)]
    for k in range(2):
        h = terms[:, k]
        more = -2.0 * theta * (h @ y) + theta**2 * (h @ h)
        joint = squares[:, None] + more + 2.0 * np.outer(slopes, theta) * (x @ h)
        density = np.exp(-0.5 * (theta / s[k]) ** 2) / (np.sqrt(2.0 * np.pi) * s[k]) * (theta[1] - theta[0])
        masses.append(prior[k] * np.exp(-0.5 * (joint - least) / noise**2) @ density)
    total = np.sum(masses)
    cumulative = np.cumsum(np.sum(masses, axis=0)) / total
    interval = [np.interp(q, cumulative, slopes) for q in (0.5 - 0.5 * probability, 0.5 + 0.5 * probability)]
    return np.array([x.sum() / total for x in masses[1:]]), interval


@pytest.mark.parametrize("kinds", [("constant force", "quadratic drag"), ("Stribeck friction", "Stribeck friction")])
def test_mixture_is_the_posterior_of_a_linear_gaussian_model(kinds, monkeypatch):
    x, terms, y, noise = line(np.random.default_rng(1))
    monkeypatch.setattr(term_regression, "batch_sums", np.zeros_like)  # white noise of a known size
    tests = candidates_of_line(x, terms, y, noise, kinds)
    sets = tests.sets()
    weights = probabilities(sets)
    # Terms of one kind and place share its odds.
    prior = [0.6, 0.6] if len(set(kinds)) == 2 else [0.3, 0.3]
    exact, interval = by_brute_force(x, terms, y, noise, 0.2 * tests.units, prior, 0.9)
    assert np.allclose(weights, exact, rtol=1e-3)
    value, error = np.array([x @ y / (x @ x)]), np.array([noise / np.sqrt(x @ x)])
    effects = tests.regression.effects.T
    means, variances = np.array([one.means for one in sets]), np.array([one.covariance[0] for one in sets])
    found = mixture_intervals(value, error, weights, effects * means, effects**2 * variances, 0.9, 1.6448536269514722)
    assert np.allclose(found[0], interval, atol=4e-3)


def test_bayes_factor_of_two_coefficients_is_their_integral():
    """And means and covariance are those of the posterior density, on a grid."""
    rng = np.random.default_rng(4)
    columns, y, prior = rng.standard_normal((12, 2)), rng.standard_normal(12), np.array([0.3, 0.8])
    columns[:, 1] += columns[:, 0]
    a, b = np.meshgrid(np.linspace(-5.0, 5.0, 1001), np.linspace(-8.0, 8.0, 1601), indexing="ij")
    theta = np.stack([a.ravel(), b.ravel()])
    likelihood = np.exp(-0.5 * (np.square(y[:, None] - columns @ theta).sum(axis=0) - y @ y))
    density = np.exp(-0.5 * (theta**2 / prior[:, None]).sum(axis=0)) / (2.0 * np.pi * np.sqrt(prior.prod()))
    mass = likelihood * density * 1e-4
    factor, means, covariance = posterior(columns.T @ columns, columns.T @ y, prior)
    assert factor == pytest.approx(np.log(mass.sum()), abs=1e-4)
    exact = theta @ mass / mass.sum()
    assert means == pytest.approx(exact, abs=1e-4)
    spread = (theta - exact[:, None]) * mass / mass.sum() @ (theta - exact[:, None]).T
    assert covariance == pytest.approx(spread, abs=1e-4)


def test_interval_without_terms_is_that_of_the_complete_model():
    none = np.zeros((0, 2))
    found = mixture_intervals(np.array([1.0, 2.0]), np.array([0.5, np.inf]), np.zeros(0), none, none, 0.95, 2.0)
    assert found.tolist() == [[0.0, 2.0], [-np.inf, np.inf]]


def test_interval_is_never_narrower_than_that_of_the_complete_model():
    one = np.ones(1)
    found = mixture_intervals(one, one, np.array([0.999]), np.array([[1.5]]), np.array([[0.0]]), 0.95, 1.96)
    assert found[0, 0] == pytest.approx(-0.96)
    assert found[0, 1] == pytest.approx(1.0 + 1.5 + 1.96, rel=2e-3)


# ---------------------------------------------------------------------- a cart in its logs


def cart_equations(q, v, a, u, p):
    return [p.mass * a.x + p.damping * v.x - u.force]


CART = dr.Model(
    "cart",
    coordinates={"x": "m"},
    inputs={"force": "N"},
    parameters={"mass": dr.Parameter("kg", positive=True), "damping": dr.Parameter("N s/m")},
    equations=cart_equations,
)


@cache
def cart_log(seed, *, drag=0.0, mean=3.0, swing=1.0, noise=0.003, n=1500, dt=0.01):
    """A cart of 2 kg with damping .5 N s/m, driven around a force, and perhaps quadratic drag."""
    rng = np.random.default_rng([seed, 5])
    rate, phase = rng.uniform(0.5, 6.0, 5), rng.uniform(0.0, 2.0 * np.pi, 5)
    t, steps = np.arange(n) * dt, 10
    force = mean + swing * np.sin(np.outer(t, rate) + phase).sum(axis=1)
    speed = mean / 0.5 if drag == 0.0 else (-0.5 + np.sqrt(0.25 + 4.0 * drag * mean)) / (2.0 * drag)
    x, v, rows = 0.0, speed, []
    for f in force:
        rows.append((x, v))
        for _ in range(steps):
            k = (f - 0.5 * v - drag * abs(v) * v) / 2.0
            half = v + 0.5 * dt / steps * k
            v_next = v + dt / steps * (f - 0.5 * half - drag * abs(half) * half) / 2.0
            x, v = x + 0.5 * dt / steps * (v + v_next), v_next
    x, v = np.array(rows).T
    columns = {"x": x + noise * rng.standard_normal(n), "x_dot": v + noise * rng.standard_normal(n), "force": force}
    return dr.Log.from_arrays(t, columns)


TRUTH = {"mass": 2.0, "damping": 0.5}


def identified(log, model=CART):
    return dr.identify(model, log, differentiate=True)


def covers(intervals):
    return [low <= TRUTH[name] <= high for name, (low, high) in intervals.items()]


@pytest.fixture(scope="module")
def lacking():
    """Results of a cart with a weak drag that the model lacks, at nearly one speed."""
    return [identified(cart_log(seed, drag=0.01, swing=0.15, noise=0.02)) for seed in range(6)]


def test_interval_holds_what_a_weak_correlated_term_took(lacking):
    assert not any(covers(result.intervals())[1] for result in lacking)
    assert all(all(covers(result.structural_intervals())) for result in lacking)


def test_structure_names_the_term_and_the_motion(lacking):
    for result in lacking:
        found = result.structure["damping"]
        assert found.widening > 2.0
        assert 0.0 < found.weight < 1.0
        assert found.term
        assert found.motion
        said = [str(x) for x in result.findings if "If the model lacks a term" in x]
        assert any("damping may be" in x and found.term in x and found.motion in x for x in said)
        assert result.verdict != "usable"


@pytest.fixture(scope="module")
def complete():
    """Result of an exact model and a log that moves it in every way."""
    return identified(cart_log(0, mean=0.0, swing=2.0))


def test_intervals_of_an_exact_model_hardly_widen_on_a_rich_log(complete):
    ordinary, structural = complete.intervals(), complete.structural_intervals()
    for name, (low, high) in ordinary.items():
        assert structural[name][1] - structural[name][0] < (high - low) * 4.0 / 3.0
    assert all(covers(structural))
    assert complete.verdict == "usable"


def test_tests_agree_with_fits_that_have_the_term(monkeypatch):
    """Estimate, error and effect of a term without a fit are those of a fit with the term as a parameter."""
    from diransac.identification.methods.lo_diransac import method

    kept = []

    def recorded(candidates, *_):
        kept.append(candidates)
        return ()

    monkeypatch.setattr(method, "possible_terms", recorded)
    log = cart_log(3, mean=1.0, swing=1.0)
    plain = identified(log)
    wide = dr.Model(
        "cart with a spring",
        coordinates=CART.coordinates,
        inputs=CART.inputs,
        parameters={**CART.parameters, "stiffness": dr.Parameter("N/m")},
        equations=lambda q, v, a, u, p: [p.mass * a.x + p.damping * v.x + p.stiffness * q.x - u.force],
    )
    full = dr.identify(wide, log, differentiate=True)
    tests = kept[0]
    k = next(i for i, x in enumerate(tests.library.terms) if x.kind == "stiffness")
    estimate, variance = (x[k] for x in tests.regression.estimates())
    assert estimate == pytest.approx(full.parameters["stiffness"], abs=0.1 * full.standard_errors["stiffness"])
    assert np.sqrt(variance) == pytest.approx(full.standard_errors["stiffness"], rel=0.25)
    change = [full.parameters[n] - plain.parameters[n] for n in CART.parameters]
    assert tests.regression.effects[:, k] * estimate == pytest.approx(
        change, abs=0.05 * max(full.standard_errors[n] for n in CART.parameters)
    )
    covariance = full.covariance
    assert tests.regression.effects[:, k] == pytest.approx(covariance[:2, 2] / covariance[2, 2], rel=0.1)


def products_of(regression):
    """Squares and products of all columns and residuals."""
    rows = np.concatenate([regression.columns, regression.residuals[:, :, None]], axis=2)
    rows = rows.reshape(-1, rows.shape[2])
    return rows.T @ rows


@pytest.mark.parametrize("n_sections", [8, 28, 36])
def test_long_logs_are_tested_in_sections_with_the_same_answer(n_sections, monkeypatch):
    """Residuals are gathered: their squares and products are the same, and errors up to their correlation."""
    from diransac.identification.methods.lo_diransac import missing_terms, term_regression

    whole, found = missing_terms.term_regression, []

    def both(intervals, fit, result, accelerations, *more):
        together = whole(intervals, fit, result, accelerations, *more)
        found.append(together)
        n_terms = accelerations.shape[2]
        numbers = len(intervals) * term_regression._numbers(fit, n_terms)
        with monkeypatch.context() as small:
            small.setattr(term_regression, "_NUMBERS", 0.9 * numbers)
            small.setattr(term_regression, "_SECTION", numbers / n_sections)
            found.append(whole(intervals, fit, result, accelerations, *more))
        return together

    monkeypatch.setattr(missing_terms, "term_regression", both)
    logs = [cart_log(3, mean=1.0, swing=1.0), cart_log(4, mean=1.0, n=700)]
    parameters = {**CART.parameters, "mass": dr.Parameter("kg", per_log=True)}
    identified(logs, dr.Model("carts", CART.coordinates, CART.inputs, parameters, cart_equations))
    together, cut = found[:2]
    assert len(cut.residuals) < len(together.residuals)
    expected, products = products_of(together), products_of(cut)
    size = np.sqrt(np.diag(expected))
    assert np.allclose(products / np.outer(size, size), expected / np.outer(size, size), atol=1e-9)
    for name in ("effects", "direct", "force", "forces"):
        own, other = getattr(together, name), getattr(cut, name)
        assert np.allclose(other, own, rtol=1e-6, atol=1e-9 * np.abs(own).max())
    (estimates, variances), (others, other_variances) = (x.estimates() for x in (together, cut))
    determined = np.isfinite(variances)
    assert others[determined] == pytest.approx(estimates[determined], rel=1e-6)
    ratio = other_variances[determined] / variances[determined]
    assert 0.3 < np.median(ratio) < 3.0


def test_terms_that_the_model_has_are_no_candidates(monkeypatch):
    from diransac.identification.methods.lo_diransac import method

    kept = []
    monkeypatch.setattr(method, "possible_terms", lambda candidates, *_: kept.append(candidates) or ())
    identified(cart_log(4))
    kinds = {x.kind for x in kept[0].library.terms}
    # A gain of the only input is one of all parameters: no motion separates them.
    assert not kinds & {"viscous friction", "input gain"}
    assert {"quadratic drag", "constant force", "stiffness"} <= kinds


# ---------------------------------------------------------------------- what is stored and shown


def test_structure_survives_json(lacking):
    data = json.loads(json.dumps(lacking[0].to_dict()))
    again = dr.Result.from_dict(data)
    assert again == lacking[0]
    assert again.structural_intervals(0.8) == lacking[0].structural_intervals(0.8)
    assert again.structure == lacking[0].structure
    assert data["structural_intervals_95"]["damping"] == list(lacking[0].structural_intervals()["damping"])
    assert data["structure"]["damping"]["motion"] == lacking[0].structure["damping"].motion


@pytest.mark.parametrize(
    ("field", "value"),
    [("weight", 1.5), ("weight", -0.1), ("variance", -1.0), ("effects", {"damping": "NaN"}), ("variance", "Infinity")],
)
def test_terms_of_no_distribution_are_refused(lacking, field, value):
    data = json.loads(json.dumps(lacking[0].to_dict()))
    data["possible_terms"][0][field] = value
    with pytest.raises(dr.ResultError, match="possible_terms"):
        dr.Result.from_dict(data)


def test_print_page_and_yaml_show_both_intervals(complete, tmp_path):
    assert "if the model is complete" in str(complete)
    assert "if it may lack a term" in str(complete)
    assert "if it may lack a term" in complete._repr_html_()
    complete.export(tmp_path / "model.yaml")
    assert (tmp_path / "model.yaml").read_text().count("interval_95_if_a_term_is_missing") == 2
    dr.write_report(complete, cart_log(0, mean=0.0, swing=2.0), tmp_path / "page.html")
    assert "if it may lack a term" in (tmp_path / "page.html").read_text()


def test_command_shows_both_intervals(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("cart.py").write_text(
        "import diransac as dr\n"
        'model = dr.Model("cart", coordinates={"x": "m"}, inputs={"force": "N"},\n'
        '    parameters={"mass": dr.Parameter("kg", positive=True), "damping": dr.Parameter("N s/m")},\n'
        "    equations=lambda q, v, a, u, p: [p.mass * a.x + p.damping * v.x - u.force])\n"
    )
    cart_log(0, mean=0.0, swing=2.0).write("log.csv")
    words = ("identify", "log.csv", "--model", "cart.py", "--differentiate", "--seed", 0)
    shown, data = run_both(monkeypatch, *words)
    assert "if the model is complete" in shown
    assert "if it may lack a term" in shown
    assert set(data["structural_intervals_95"]) == set(data["intervals_95"]) == set(TRUTH)


@pytest.mark.parametrize("method", ["ols", dr.LoDiransac(suggestions=False)])
def test_methods_that_test_no_terms_have_no_structural_intervals(method):
    log = cart_log(0, mean=0.0, swing=2.0)
    result = dr.identify(CART, log, method=method, differentiate=True)
    for wanted in (result.structural_intervals, lambda: result.structure):
        with pytest.raises(dr.ResultError, match="has not tested what the model may lack"):
            wanted()
    assert "if it may lack a term" not in str(result)
    assert dr.Result.from_dict(json.loads(json.dumps(result.to_dict()))) == result


def test_level_is_checked(complete):
    with pytest.raises(dr.SettingsError, match="level"):
        complete.structural_intervals(1.0)


@pytest.mark.parametrize(
    ("kind", "motion"),
    [
        ("Coulomb friction", "reversals of x at low speed"),
        ("quadratic drag", "speeds of x over a wider range"),
        ("harmonic 2 of theta", "a wider range of theta"),
        ("coupling to y_dot", "motion in which y_dot and x vary independently"),
        ("rolling", "richer motion of x"),
    ],
)
def test_every_kind_has_its_motion(kind, motion):
    assert PossibleTerm(kind, "x", "", 0.1, 0.0, 1.0, {}).motion == motion
