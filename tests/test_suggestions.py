"""Suggested terms: what is planted is found, what is not there is not, and the printed code is the term itself."""

from dataclasses import dataclass, replace
from itertools import pairwise
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

import diransac as dr
from command_line import run
from diransac.identification.methods.lo_diransac.missing_terms import Candidates, _drawn, connections
from diransac.identification.methods.lo_diransac.motion_equations import inertia_slopes
from diransac.identification.methods.lo_diransac.term_regression import TermRegression
from diransac.identification.structure.candidate_terms import (
    CandidateTerm,
    CandidateTerms,
    RelativeMotion,
    candidate_terms,
)
from diransac.identification.structure.lacking_terms import INPUT_CHANGES, with_terms
from user_models import tumbling

RNG = np.random.default_rng(20240607)

# ---------------------------------------------------------------------- selection, on arrays


@dataclass(frozen=True)
class Made:
    """Two equations: a force (n, 2), own columns (n, 2, 2), candidates (n, 2, K) that have nothing to do with it."""

    force: np.ndarray
    own: np.ndarray
    terms: np.ndarray


def made_of(rng, n=120, n_terms=40, force=None):
    terms = np.zeros((n, 2, n_terms))
    for k in range(n_terms):
        terms[:, k % 2, k] = rng.standard_normal(n)
    force = rng.standard_normal((n, 2)) if force is None else force
    return Made(force, rng.standard_normal((n, 2, 2)), terms)


def regression(made):
    """What own columns leave, as a fit would: whitened, and each equation over what is left of it."""
    own = made.own[:, :, made.own.any(axis=(0, 1))]
    scale = np.ones(2)
    for _ in range(3):
        columns = (own / scale[:, None]).reshape(made.force.size, -1)
        found = np.linalg.lstsq(columns, (made.force / scale).ravel(), rcond=None)[0]
        scale = np.sqrt(np.square(made.force - own @ found).mean(axis=0))
    force = (made.force - own @ found) / scale
    rho = (force[1:] * force[:-1]).sum() / np.square(force).sum()
    parts = [x / scale[:, None] for x in (own, made.terms, made.force[:, :, None])]
    whitened = [np.concatenate([x[:1], (x[1:] - rho * x[:-1]) / np.sqrt(1.0 - rho**2)]) for x in parts]
    own, terms, force = (x.reshape(made.force.size, -1) for x in whitened)
    effects = np.linalg.lstsq(own, -terms, rcond=None)[0]
    left, columns = force + own @ np.linalg.lstsq(own, -force, rcond=None)[0], terms + own @ effects
    plain = made.own[:, :, made.own.any(axis=(0, 1))]
    direct, shape = np.square(terms).sum(axis=0), made.terms.shape
    forces = made.terms + plain @ effects
    return TermRegression(
        effects, direct, left.reshape(made.force.shape), columns.reshape(shape), made.force - plain @ found, forces,
        made.terms.any(axis=0), np.zeros(len(effects)),
    )  # fmt: skip


def units_of(made, largest=1.0):
    return largest / np.sqrt(np.square(made.terms).mean(axis=0)).max(axis=0)


def candidates_tested(made, whitened=None, parameters=None, bounds=None, largest=1.0):
    """Tests of terms; each is of its own kind, and any coefficient is possible unless it is said."""
    n_terms = made.terms.shape[2]
    parameters = range(n_terms) if parameters is None else parameters
    bounds = {} if bounds is None else bounds
    terms = [
        CandidateTerm(f"kind {k}", "q", "q", "", "", f"p{x}", "", ca.SX(1), bounds.get(k, (-np.inf, np.inf)))
        for k, x in enumerate(parameters)
    ]
    library = CandidateTerms((), tuple(terms))
    return Candidates(library, units_of(made, largest), whitened or regression(made), np.ones((len(made.force), 1, 1)))


def select(made, *arguments, **options):
    """Indices of the terms that are selected."""
    return [x.index for x in candidates_tested(made, *arguments, **options).selected()]


def autocorrelated(rng, n, rho=0.9):
    """A Gauss-Markov sequence (n, 2) of unit variance."""
    x = rng.standard_normal((n, 2))
    for k in range(1, n):
        x[k] = rho * x[k - 1] + np.sqrt(1 - rho**2) * x[k]
    return x


def test_parameters_change_by_what_a_missing_term_had_biased_them():
    rng = np.random.default_rng(3)
    made = made_of(rng, n=2000, force=0.01 * rng.standard_normal((2000, 2)))
    own = made.own.copy()
    own[:, 0, 0] += made.terms[:, 0, 6]  # of unit variance, as the rest of the column
    own[:, 1, 0] = 0.0
    made = replace(made, own=own, force=made.force - 0.8 * made.terms[:, :, 6])
    assert select(made) == [6]
    found = regression(made)
    change = found.effects[:, [6]] @ found.joint([6])[0]
    assert change[0] == pytest.approx(-0.4, abs=0.05)
    assert abs(change[1]) < 0.05


def test_planted_terms_are_found_with_their_coefficients_within_five_standard_errors():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        made = made_of(rng, force=0.3 * rng.standard_normal((120, 2)))
        force = made.force - 0.8 * made.terms[:, :, 6] + 0.5 * made.terms[:, :, 9] + made.own @ [3.0, -2.0]
        made = replace(made, force=force)
        found = select(made)
        assert sorted(found) == [6, 9]
        for k, value, error in zip(found, *regression(made).joint(found), strict=True):
            assert abs(value - {6: 0.8, 9: -0.5}[k]) < 5.0 * error
        assert 0.6 < regression(made).explained(6) <= 1.0


def test_two_terms_that_hide_each_other_are_found_together():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        made = made_of(rng, force=0.3 * rng.standard_normal((120, 2)))
        terms, differs = made.terms.copy(), rng.standard_normal(120)
        terms[:, 0, 6] = terms[:, 0, 4] + 0.1 * differs
        made = replace(made, terms=terms, force=made.force + 8.0 * (terms[:, :, 4] - terms[:, :, 6]))
        whitened = regression(made)
        assert np.abs(whitened.estimates()[0][[4, 6]]).max() < 0.8
        assert sorted(select(made, largest=80.0)) == [4, 6]
        values, errors = whitened.joint([4, 6])
        assert np.all(np.abs(values - [-8.0, 8.0]) < 5.0 * errors)


def test_a_term_of_which_the_log_hardly_tells_the_form_is_suggested_with_the_other_form_and_others_beside_it():
    """The form cannot be told, but that the model lacks it can; a term in another equation is sought all the same."""
    right = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        made = made_of(rng, force=0.3 * rng.standard_normal((120, 2)))
        terms = made.terms.copy()
        terms[:, 0, 4] = terms[:, 0, 6] + 0.1 * rng.standard_normal(120)
        made = replace(made, terms=terms, force=made.force - 0.8 * terms[:, :, 6] + 0.4 * terms[:, :, 9])
        found = {x.index: x.rivals for x in candidates_tested(made).selected()}
        assert len(found) == 2
        assert found.pop(9) == ()
        ((one, others),) = found.items()
        assert one in (4, 6)
        right += 6 in (one, *others)
    assert right >= 19


def test_a_term_that_the_log_separates_from_all_others_has_no_rival():
    rng = np.random.default_rng(0)
    made = made_of(rng, force=0.3 * rng.standard_normal((120, 2)))
    terms = made.terms.copy()
    terms[:, 0, 4] = terms[:, 0, 6] + 1.5 * rng.standard_normal(120)
    made = replace(made, terms=terms, force=made.force - 0.8 * terms[:, :, 6])
    assert [(x.index, x.rivals) for x in candidates_tested(made).selected()] == [(6, ())]


def test_a_single_term_counts_before_a_pair_that_is_hardly_more_probable():
    more_probable = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        made = made_of(rng, force=0.3 * rng.standard_normal((120, 2)))
        terms, apart = made.terms.copy(), rng.standard_normal(120)
        terms[:, 0, 4], terms[:, 0, 8] = 0.5 * terms[:, 0, 6] + apart, 0.5 * terms[:, 0, 6] - apart
        force = made.force - 0.8 * terms[:, :, 6] - 0.1 * (terms[:, :, 4] - terms[:, :, 8])
        made = replace(made, terms=terms, force=force)
        odds = {x.members: x.log_odds for x in candidates_tested(made, largest=10.0).sets()}
        more_probable += odds.get((4, 8), -np.inf) > odds[6,]
        assert select(made, largest=10.0) == [6]
    assert more_probable > 5


@pytest.mark.parametrize("rho", [0.0, 0.9])
def test_forces_without_a_term_have_at_most_two_suggestions_in_fifty_logs(rho):
    found = 0
    for seed in range(50):
        rng = np.random.default_rng(seed)
        made = made_of(rng, force=autocorrelated(rng, 120, rho))
        slow = np.cumsum(made.terms, axis=0) if rho else made.terms
        found += len(select(replace(made, terms=slow)))
    assert found <= 2


@pytest.mark.parametrize("n_terms", [0, 1])
def test_without_candidates_nothing_is_suggested(n_terms):
    assert not select(made_of(np.random.default_rng(0), n_terms=n_terms))


def test_a_term_that_own_columns_span_is_not_suggested():
    rng = np.random.default_rng(0)
    made = made_of(rng)
    terms = made.terms.copy()
    terms[:, :, 0] = made.own @ [1.0, 2.0]
    force = 0.1 * made.force + 5.0 * terms[:, :, 0]
    assert not select(replace(made, terms=terms, force=force))


def test_a_term_whose_sign_changes_within_the_log_is_not_suggested():
    rng = np.random.default_rng(1)
    made = made_of(rng)
    turning = np.where(np.arange(120) < 84, 1.0, -1.0)[:, None]
    assert not select(replace(made, force=0.1 * made.force + turning * made.terms[:, :, 4]))


def test_a_term_of_less_than_a_thousandth_of_the_largest_force_is_not_suggested():
    rng = np.random.default_rng(2)
    made = made_of(rng)
    made = replace(made, force=0.1 * made.force + made.terms[:, :, 4])
    assert select(made)
    assert not select(made, largest=2000.0)


def test_a_force_that_all_else_of_the_fit_could_explain_is_not_suggested():
    """Least squares on the motion has it, but states and parameters together leave no residual that it explains."""
    made = made_of(np.random.default_rng(3))
    made = replace(made, force=0.01 * made.force + made.terms[:, :, 4])
    whitened = regression(made)
    assert select(made, whitened) == [4]
    columns = whitened.columns.copy()
    columns[:, :, 4] *= 0.01  # uncertain
    assert not select(made, replace(whitened, columns=columns, residuals=0.01 * whitened.residuals))
    columns[:, :, 4] = 0.0  # not determined at all, as the gain of an input of which every parameter is a multiple
    assert not select(made, replace(whitened, columns=columns))


def test_a_coefficient_beyond_its_bounds_is_not_suggested():
    made = made_of(np.random.default_rng(3))
    force = 0.1 * made.force + made.terms[:, :, 4] - made.terms[:, :, 9]  # coefficients -1 and 1
    made = replace(made, force=force)
    assert set(select(made, bounds={4: (-1.5, 0.0)})) == {4, 9}
    assert select(made, bounds={4: (0.0, np.inf)}) == [9]


def test_what_actuators_make_of_inputs_has_bounds_within_which_it_grows_with_the_input():
    model = crane()
    candidates = candidate_terms(model, np.ones(model.n_v), np.full((model.n_u, 2), [0.8, 1.6]))
    u = np.linspace(-1.6, 1.6, 200)
    for term in (x for x in candidates.terms if x.kind in INPUT_CHANGES):
        low, high = term.bounds
        effect = ca.Function("effect", list(candidates.symbols), [term.residuals])
        motion = [np.ones((x.numel(), len(u))) for x in candidates.symbols]
        motion[3][:] = u
        change = -np.array(effect(*motion))[0]  # the force enters the equation of x with a minus
        assert low < 0.0 <= high
        possible = (1.0 / 1.5 * low if np.isfinite(low) else -1.0, min(high, 1.0))
        for coefficient in possible:  # but for an error of the coefficient
            assert (np.diff(u + coefficient * change) > -1e-9).all(), term.kind


def test_of_one_group_only_one_form_is_suggested():
    rng = np.random.default_rng(5)
    made = made_of(rng)
    force = 0.1 * made.force + made.terms[:, :, 4] + made.terms[:, :, 8]
    parameters = [4 if k == 8 else k for k in range(40)]
    assert len(set(select(replace(made, force=force), parameters=parameters)) & {4, 8}) == 1


# ---------------------------------------------------------------------- the library, and its code


def crane(sign=1):
    """A cart with a hanging load and a parameter that has the name of a candidate."""
    return dr.Model(
        "crane",
        {"x": "m", "angle": "rad"},
        {"force": "N"},
        {
            "cart": dr.Parameter("kg", positive=True),
            "load": dr.Parameter("kg", positive=True),
            "coulomb_x": dr.Parameter("N"),
        },
        lambda q, v, a, u, p: [
            sign * ((p.cart + p.load) * a.x + p.load * ca.cos(q.angle) * a.angle + p.coulomb_x - u.force),
            sign * p.load * (ca.cos(q.angle) * a.x + a.angle + 9.81 * ca.sin(q.angle)),
        ],
    )


def all_suggested(model, library=None):
    """Every candidate as a suggestion, between the first and the last velocity, too."""
    ends = np.eye(model.n_v)[0] - 0.25 * np.eye(model.n_v)[-1]
    between = [RelativeMotion(ends, -ends, 1.0)] if model.n_v > 1 else []
    candidates = candidate_terms(model, np.ones(model.n_v), np.full((model.n_u, 2), [0.8, 1.6]), between, library)
    return candidates, [candidates.suggestion(k, 0.5, 0.01, 0.9) for k in range(len(candidates))]


def points(model, n=7):
    """Random q, v, a, u, p, each (n_i, n)."""
    return [RNG.uniform(0.3, 1.5, (model.residual.size1_in(i), n)) for i in range(5)]


@pytest.mark.parametrize("model", [crane(), crane(-1), tumbling(), dr.models.planar_rotorcraft()])
def test_printed_code_is_the_term_that_with_terms_adds(model):
    candidates, suggested = all_suggested(model)
    motion = points(model)
    before = np.array(model.residual(*motion))
    q, v, a, u, p = candidates.symbols
    for term, one in zip(candidates.terms, suggested, strict=True):
        extended = with_terms(model, [one])
        assert list(extended.parameters) == [*model.parameters, one.parameter]
        after = np.array(extended.residual(*motion[:4], np.vstack([motion[4], np.full(7, 0.7)])))
        named = dict(zip("qvau", model.named(q, v, a, u), strict=True))
        coefficient = type("Parameters", (), {one.parameter: ca.SX(0.7)})
        known = {"ca": ca, "p": coefficient, **named}

        def values_of(code, known=known):
            return np.array(ca.Function("written", [q, v, a, u, p], [ca.SX(eval(code, known))])(*motion))

        if term.kind in INPUT_CHANGES:
            changed = motion[3].copy()
            changed[list(model.inputs).index(term.place)] = values_of(one.code)
            np.testing.assert_allclose(after, np.array(model.residual(*motion[:3], changed, motion[4])), rtol=1e-9)
            continue
        lines = {one.equation: one.code, **one.also}
        for k, name in enumerate(model.rate_names):
            values = np.ravel(values_of(f"0 {lines.get(name, '')}"))
            np.testing.assert_allclose((after - before)[k], values, rtol=1e-9, atol=1e-12)


def test_parameters_of_candidates_are_new_names_one_per_effect():
    candidates, _ = all_suggested(crane())
    names = {x.parameter for x in candidates.terms}
    assert "coulomb_x_2" in names
    assert not names & set(crane().parameters)
    stribeck = {x.parameter for x in candidates.terms if x.kind == "Stribeck friction" and x.place == "x"}
    assert stribeck == {"stribeck_x"}
    assert len(names) < len(candidates)


def test_units_of_coefficients_give_forces():
    units = {x.formula: x.unit for x in all_suggested(crane())[0].terms if x.place == "x"}
    assert units["sign(x_dot)"] == "N"
    assert units["x_dot"] == "N s/m"
    assert units["|x_dot| x_dot"] == "N s^2/m^2"
    assert units["sin(angle)"] == "N"
    assert units["x"] == "N/m"


def test_means_of_candidates_are_those_of_numpy():
    model = crane()
    candidates, _ = all_suggested(model)
    motion = [x.T for x in points(model, 60)]
    weights = np.repeat([0.1, 0.0, 0.2], 20) * np.tile([1.0, 0.0], 30)
    found = candidates.means(motion, weights, 20)
    x_dot, angle = motion[1][:, 0], motion[0][:, 1]
    for formula, rows in {"|x_dot| x_dot": x_dot * abs(x_dot), "cos(2 angle)": np.cos(2 * angle)}.items():
        k = next(k for k, t in enumerate(candidates.terms) if t.formula == formula and t.equation == "x")
        expected = (rows * weights).reshape(3, 20).sum(axis=1)
        np.testing.assert_allclose(found[:, 0, k], expected, rtol=1e-12)
        np.testing.assert_array_equal(found[:, 1, k], 0.0)


@pytest.mark.parametrize(
    ("library", "reason"),
    [
        (lambda q, v, u: [v.x], "no mapping"),
        (lambda q, v, u: {"a b": v.x}, "cannot name"),
        (lambda q, v, u: 1 / 0, "Zero"),
    ],
)
def test_a_wrong_library_is_refused_by_its_fault(library, reason):
    with pytest.raises(dr.ModelError, match=reason):
        candidate_terms(crane(), np.ones(2), np.ones((1, 2)), library=library)


# ---------------------------------------------------------------------- from a log to a suggestion


INERTIA, DAMPING, MOMENT, COULOMB = 0.06, 0.04, 1.0, 0.03


def pendulum():
    return dr.Model(
        "pendulum",
        {"q": "rad"},
        {"torque": "N m"},
        {
            "inertia": dr.Parameter("kg m^2", positive=True),
            "damping": dr.Parameter("N m s/rad"),
            "moment": dr.Parameter("N m"),
        },
        lambda q, v, a, u, p: [p.inertia * a.q + p.damping * v.q + p.moment * ca.sin(q.q) - u.torque],
    )


def swing(friction=lambda w: 0.0, actuator=lambda u: u, seed=0, rows=1500, dt=0.01):
    """A log of the pendulum with another friction and its torque by an actuator, by midpoint steps of a millisecond."""
    rng, x = np.random.default_rng(seed), np.zeros((rows + 1, 2))
    t = dt * np.arange(rows)
    torque = sum(0.3 * np.sin(w * t + rng.uniform(0, 6)) for w in rng.uniform(1.0, 9.0, 5))

    def rate(x, u):
        return np.array([x[1], (u - DAMPING * x[1] - friction(x[1]) - MOMENT * np.sin(x[0])) / INERTIA])

    for k, u in enumerate(actuator(torque)):
        y = x[k]
        for begin, end in pairwise(np.linspace(0.0, dt, 11)):
            y = y + (end - begin) * rate(y + 0.5 * (end - begin) * rate(y, u), u)
        x[k + 1] = y
    return dr.Log.from_arrays(t, {"q": x[:-1, 0] + 2e-4 * rng.standard_normal(rows), "torque": torque})


@pytest.fixture(scope="module")
def with_dry_friction():
    return swing(lambda w: COULOMB * np.tanh(w / 0.01))


@pytest.fixture(scope="module")
def result(with_dry_friction):
    return dr.identify(pendulum(), with_dry_friction, differentiate=True)


def test_missing_dry_friction_is_suggested_with_its_size(result):
    (found,) = result.suggestions
    assert (found.kind, found.equation, found.unit) == ("Coulomb friction", "q", "N m")
    assert abs(found.value - COULOMB) < 0.15 * COULOMB
    assert found.explained > 0.8
    assert found.text.startswith("Dry friction of q: 0.0")
    assert "sign(q_dot) explains" in found.text


def test_the_suggested_term_lies_over_the_unmodelled_force_and_the_report_shows_it_and_the_line_to_add(
    with_dry_friction, result, tmp_path
):
    found = result.diagnosis
    force, term = found.unmodelled_forces["q_ddot"], found.suggested_terms["q_ddot"]
    # The answer is a mean of estimates that the friction biases; the suggestion alone explains more.
    assert np.var(force - term) < 0.2 * np.var(force)
    assert np.ptp(term) > 1.5 * COULOMB  # friction steps by twice its size
    again = dr.Result.from_dict(result.to_dict()).diagnosis.suggested_terms
    np.testing.assert_array_equal(again["q_ddot"], term)
    dr.write_report(result, with_dry_friction, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "Dashed: what the suggested terms explain of it." in page
    assert 'class="trace line suggested"' in page
    assert "The model seems to lack a term. Dry friction of q" in page
    assert "add to the equation of q: + p.coulomb_q" in page


def test_suggestions_are_printed_and_survive_json(result):
    (found,) = result.suggestions
    assert found.text in str(result)
    assert found.code in str(result)
    assert found.declaration in str(result)
    assert dr.Result.from_dict(result.to_dict()).suggestions == result.suggestions


def test_the_refit_has_the_parameters_of_the_machine(with_dry_friction):
    refit = dr.identify(pendulum(), with_dry_friction, differentiate=True, with_suggestions=True)
    true = {"inertia": INERTIA, "damping": DAMPING, "moment": MOMENT, "coulomb_q": COULOMB}
    assert refit.parameters == pytest.approx(true, rel=0.05)
    assert "terms were added to the model as suggested: Dry friction of q" in refit.notes[0]
    assert dr.Result.from_dict(refit.to_dict()) == refit
    assert not refit.suggestions


def test_of_an_exact_model_nothing_is_suggested_and_nothing_added():
    found = dr.identify(pendulum(), swing(), differentiate=True, with_suggestions=True)
    assert not found.suggestions
    assert list(found.parameters) == ["inertia", "damping", "moment"]
    assert "no terms were suggested" in found.notes[0]
    assert not found.diagnosis.suggested_terms
    assert not found.diagnosis.of_log(0, slice(None)).suggested_terms


@pytest.mark.parametrize(
    ("name", "actuator"),
    [
        ("Dead band", lambda u: u - 0.08 * np.clip(u / 0.08, -1.0, 1.0)),
        ("Curved gain", lambda u: u * (1.0 + 0.15 * np.abs(u))),
        ("Saturation", lambda u: np.clip(u, -0.6, 0.6)),
    ],
)
def test_what_an_actuator_does_to_its_input_is_suggested(name, actuator):
    found = dr.identify(pendulum(), swing(actuator=actuator), differentiate=True, with_suggestions=True)
    assert f"terms were added to the model as suggested: {name} of torque" in found.notes[0]
    true = {"inertia": INERTIA, "damping": DAMPING, "moment": MOMENT}
    assert {name: found.parameters[name] for name in true} == pytest.approx(true, rel=0.05)


@pytest.mark.parametrize("seed", range(3))
def test_gravity_that_may_be_a_spring_is_suggested_and_both_are_named(seed):
    """Over small angles and three seconds they are nearly the same torque."""
    model = dr.Model(
        "turntable",
        {"q": "rad"},
        {"torque": "N m"},
        {"inertia": dr.Parameter("kg m^2", positive=True), "damping": dr.Parameter("N m s/rad")},
        lambda q, v, a, u, p: [p.inertia * a.q + p.damping * v.q - u.torque],
    )
    result = dr.identify(model, swing(seed=seed, rows=300), differentiate=True)
    (found,) = result.suggestions
    assert {"gravity torque about q", "spring on q"} <= {found.name, *found.rivals}
    assert f"and this log does not exclude {' or '.join(found.rivals)} in its place" in found.text
    assert dr.Result.from_dict(result.to_dict()).suggestions == result.suggestions


def test_a_users_own_term_is_suggested_where_it_explains_more():
    log = swing(lambda w: 0.004 * w * w * w)
    method = dr.LoDiransac(candidate_terms=lambda q, v, u: {"cubic": v.q**3})
    assert dr.identify(pendulum(), log, method, differentiate=True).suggestions[0].kind == "cubic"


def two_masses():
    """A driven mass with a spring and a damper to a second one."""
    return dr.Model(
        "two masses",
        {"x": "m", "y": "m"},
        {"f": "N"},
        {n: dr.Parameter(unit, positive=True) for n, unit in {"m": "kg", "k": "N/m", "c": "N s/m", "n": "kg"}.items()},
        lambda q, v, a, u, p: [
            p.m * a.x + p.k * (q.x - q.y) + p.c * (v.x - v.y) - u.f,
            p.n * a.y - p.k * (q.x - q.y) - p.c * (v.x - v.y),
        ],
    )


@pytest.mark.parametrize("friction", [0.0, 0.05])
def test_dry_friction_between_two_bodies_is_suggested(friction):
    rng, dt, n = np.random.default_rng(5), 0.01, 1500
    t = dt * np.arange(n)
    force = sum(np.sin(w * t + rng.uniform(0, 6)) for w in (2.0, 5.0, 11.0, 19.0))
    x, rows = np.zeros(4), []
    for k in range(n):
        rows.append(x)
        for _ in range(40):
            slip = x[2] - x[3]
            between = 40.0 * (x[0] - x[1]) + 0.6 * slip + friction * np.tanh(slip / 0.001)
            v = x[2:] + 0.00025 * np.array([(force[k] - between) / 1.5, between / 0.5])
            x = np.concatenate([x[:2] + 0.000125 * (x[2:] + v), v])
    measured = np.array(rows).T[:2] + 2e-4 * rng.standard_normal((2, n))
    log = dr.Log.from_arrays(t, {"x": measured[0], "y": measured[1], "f": force})
    found = dr.identify(two_masses(), log, differentiate=True, with_suggestions=True)
    added = set(found.parameters) - set(two_masses().parameters)
    assert added == ({"coulomb_x_y"} if friction else set())
    assert found.parameters.get("coulomb_x_y", 0.0) == pytest.approx(friction, rel=0.03)
    assert found.parameters["c"] == pytest.approx(0.6, rel=0.03)


@pytest.mark.parametrize(
    ("model", "expected"),
    [
        (
            dr.Model(
                "gears",
                {"x": "m", "angle": "rad", "z": "m"},
                {"force": "N"},
                dict.fromkeys(["mass", "damping", "stiffness", "drag"], dr.Parameter()),
                lambda q, v, a, u, p: [
                    p.mass * a.x - p.damping * (0.05 * v.angle - v.x) - u.force,
                    a.angle + 0.05 * p.damping * (0.05 * v.angle - v.x) + p.stiffness * (q.angle - 2.0 * q.z - 1.0),
                    a.z - 2.0 * p.stiffness * (q.angle - 2.0 * q.z - 1.0) + p.drag * v.z,
                ],
            ),
            [([1.0, -0.05, 0.0], [1.0, -0.05, 0.0]), ([0.0, 1.0, -2.0], [0.0, 1.0, -2.0])],
        ),
        (
            dr.Model(
                "rooms",
                {},
                {"heat": "W"},
                dict.fromkeys(["conductance", "loss"], dr.Parameter()),
                lambda q, v, a, u, p: [
                    a.warm + p.conductance * (v.warm - v.cold) / 3.0 - u.heat,
                    a.cold - p.conductance * (v.warm - v.cold) / 6.0 + p.loss * v.cold,
                ],
                first_order={"warm": "K", "cold": "K"},
            ),
            [([1.0, -1.0], [1.0, -0.5])],
        ),
        (dr.models.planar_rotorcraft(), []),
    ],
    ids=lambda x: getattr(x, "name", ""),
)
def test_springs_dampers_and_conductances_connect(model, expected):
    rng = np.random.default_rng(0)
    rows = (rng.standard_normal((200, n)) for n in (model.n_q, model.n_v, model.n_v, model.n_u))
    found = connections(model, *rows, np.ones((200, model.n_p)))
    assert len(found) == len(expected)
    for pair, known in zip(found, expected, strict=True):
        np.testing.assert_allclose(pair, known, atol=1e-9)


def test_terms_of_a_model_without_finite_accelerations_are_not_tested():
    model, rng = two_masses(), np.random.default_rng(0)
    motion = [rng.standard_normal((50, n)) for n in (2, 2, 2, 1)]
    drawn = SimpleNamespace(model=model, counted=np.ones(50, bool))
    with pytest.raises(np.linalg.LinAlgError, match="no finite acceleration"):
        _drawn(drawn, [*motion, np.full((50, 4), [1.0, 1e200, 1.0, 1e200])])


def test_slopes_of_the_inertia_are_those_of_its_logarithm():
    model, rng = crane(), np.random.default_rng(0)
    q, v, u = (rng.standard_normal((50, n)) for n in (2, 2, 1))
    arguments = model.residual.sx_in()
    inertia = ca.Function("inertia", arguments, [ca.jacobian(model.residual(*arguments), arguments[2])])

    def logarithm(p):
        rows = [np.array(inertia(*x, [0.0, 0.0], w, p)) for *x, w in zip(q, v, u, strict=True)]
        return np.mean([np.linalg.slogdet(M)[1] for M in rows]) / 2.0

    p = np.array([3.0, 0.7, 0.2])
    found = inertia_slopes(model, q, v, u, np.broadcast_to(p, (50, 3)))
    for k, step in enumerate(1e-6 * np.eye(3)):
        assert found[k] == pytest.approx((logarithm(p + step) - logarithm(p - step)) / 2e-6, abs=1e-6)


def test_the_same_log_has_the_same_suggestions(with_dry_friction, result):
    again = dr.identify(result.model, with_dry_friction, differentiate=True)
    assert again.suggestions == result.suggestions
    assert again.structure == result.structure


def test_suggestions_can_be_switched_off(with_dry_friction):
    method = dr.LoDiransac(suggestions=False)
    assert not dr.identify(pendulum(), with_dry_friction, method, differentiate=True).suggestions
    with pytest.raises(dr.SettingsError, match="needs suggestions"):
        dr.identify(pendulum(), with_dry_friction, method, differentiate=True, with_suggestions=True)


def test_methods_without_suggestions_refuse_a_refit(with_dry_friction):
    with pytest.raises(dr.SettingsError, match="method ols"):
        dr.identify(pendulum(), with_dry_friction, "ols", differentiate=True, with_suggestions=True)


def test_candidate_terms_must_be_a_function():
    with pytest.raises(dr.SettingsError, match="candidate_terms is 3"):
        dr.LoDiransac(candidate_terms=3)


PENDULUM_FILE = """
import casadi as ca
from diransac import Model, Parameter
model = Model(
    "pendulum", {"q": "rad"}, {"torque": "N m"},
    {"inertia": Parameter("kg m^2", positive=True), "damping": Parameter("N m s/rad"), "moment": Parameter("N m")},
    lambda q, v, a, u, p: [p.inertia * a.q + p.damping * v.q + p.moment * ca.sin(q.q) - u.torque],
)
"""


def test_the_command_line_refits_on_request(with_dry_friction, tmp_path):
    (tmp_path / "pendulum.py").write_text(PENDULUM_FILE)
    with_dry_friction.write(tmp_path / "log.csv")
    words = ["identify", tmp_path / "log.csv", "--model", tmp_path / "pendulum.py", "--differentiate"]
    done = run(*words, "--with-suggestions")
    assert done.exit_code == 0
    assert "pendulum with coulomb_q by lo-diransac" in done.stdout
    assert "terms were added to the model as suggested: Dry friction of q" in done.stdout
