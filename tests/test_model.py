"""Models: what is refused where the model is made, and what is derived against hand, chance and finite differences."""

import copy
import json
import math
import pickle

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from diransac.errors import ModelError, ResultError
from diransac.model import Model, Parameter
from diransac.model.expressions import printed
from diransac.model.library import BUILTIN, builtin
from diransac.model.plant import Plant
from simulated import MACHINES
from user_models import tumbling

SEEDS = st.integers(0, 2**32 - 1)
FEW = settings(max_examples=30)


def one_axis(equations, **changes):
    """A model of one coordinate x, input f, parameters m > 0 and k."""
    parts = {
        "coordinates": {"x": "m"},
        "inputs": {"f": "N"},
        "parameters": {"m": Parameter("kg", positive=True), "k": Parameter("N s/m")},
    }
    return Model(name="axis", equations=equations, **(parts | changes))


def two_axes(equations):
    return one_axis(equations, coordinates={"x": "m", "y": "m"})


def plain(q, v, a, u, p):
    return [p.m * a.x + p.k * v.x - u.f]


def random_arguments(model, seed):
    """Random q, v, a, u and parameters that are within their bounds."""
    rng = np.random.default_rng(seed)
    q, v, a, u = (rng.uniform(-2.0, 2.0, n) for n in (model.n_q, model.n_v, model.n_v, model.n_u))
    return q, v, a, u, rng.uniform(0.2, 3.0, model.n_p)


MODELS = [*(BUILTIN[name]() for name in BUILTIN), tumbling()]
EVERY_MODEL = pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)


# ---------------------------------------------------------------------- what is refused


REFUSED = {
    "unknown parameter": (lambda q, v, a, u, p: [p.mass * a.x], "parameters have no 'mass'; found m, k"),
    "unknown coordinate": (lambda q, v, a, u, p: [p.m * a.x + q.z], "coordinates have no 'z'"),
    "unknown item": (lambda q, v, a, u, p: [p.m * a.x + u["force"]], "inputs have no 'force'; found f"),
    "two residuals": (lambda q, v, a, u, p: [p.m * a.x, u.f], "return 2 residuals, but there are 1 acc"),
    "no residuals": (lambda q, v, a, u, p: [], "return 0 residuals"),
    "nothing": (lambda q, v, a, u, p: None, "return None; return a list"),
    "text": (lambda q, v, a, u, p: ["m a = f"], "return a list of expressions"),
    "math.sin": (lambda q, v, a, u, p: [p.m * a.x + p.k * math.sin(q.x)], "contains NaN.*math"),
    "NaN": (lambda q, v, a, u, p: [p.m * a.x + p.k * float("nan")], "contains NaN"),
    "infinity": (lambda q, v, a, u, p: [p.m * a.x + p.k * float("inf")], "not finite"),
    "a root of less than nothing": (lambda q, v, a, u, p: [p.m * a.x + ca.sqrt(-1 - q.x**2)], "not finite"),
    "if": (lambda q, v, a, u, p: [p.m * a.x + (p.k if v.x > 0 else 0)], "branch on a symbol.*if_else"),
    "max": (lambda q, v, a, u, p: [p.m * a.x + p.k * max(v.x, 0)], "branch on a symbol.*fmax"),
    "and": (lambda q, v, a, u, p: [p.m * a.x + (v.x and p.k)], "branch on a symbol"),
    "int": (lambda q, v, a, u, p: [p.m * a.x + int(v.x) * p.k], "failed"),
    "too few arguments": (lambda q, v, a: [a.x], "failed: TypeError"),
    "no such method": (lambda q, v, a, u, p: [p.m * a.x.flux], "failed: AttributeError"),
    "division by zero": (lambda q, v, a, u, p: [p.m * a.x + 1 / 0], "failed: ZeroDivisionError"),
    "a symbol from elsewhere": (lambda q, v, a, u, p: [p.m * a.x + ca.SX.sym("g")], "hold a symbol g"),
    "its namesake": (lambda q, v, a, u, p: [p.m * a.x + ca.SX.sym("k")], "hold a symbol k"),
    "a squared": (lambda q, v, a, u, p: [p.m * a.x**2 + p.k], "not affine in the accelerations x_ddot"),
    "sign of a": (lambda q, v, a, u, p: [p.m * a.x + p.k * ca.sign(a.x)], "not affine in the accelerations"),
    "no a": (lambda q, v, a, u, p: [p.m * v.x + p.k], "singular.*do not determine x_ddot"),
    "a away": (lambda q, v, a, u, p: [(q.x - q.x) * a.x + p.k * v.x + p.m], "singular"),
    "a away by value": (
        lambda q, v, a, u, p: [(ca.sin(q.x) ** 2 + ca.cos(q.x) ** 2 - 1) * a.x + p.k * v.x + p.m],
        "singular",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("equations", "says"), REFUSED.values(), ids=REFUSED)
def test_equations_that_cannot_serve_are_refused_by_name(equations, says):
    with pytest.raises(ModelError, match=says) as caught:
        one_axis(equations)
    assert str(caught.value).startswith('model "axis": ')
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("equations", "loose"),
    [
        (lambda q, v, a, u, p: [p.m * a.x - u.f, p.k * a.x + p.m], "y_ddot"),
        (lambda q, v, a, u, p: [p.m * (a.x + a.y) - u.f, p.k * (a.x + a.y)], "x_ddot, y_ddot"),
        (
            lambda q, v, a, u, p: [
                a.x * ca.cos(q.x) + a.y * ca.sin(q.x) - u.f,
                (a.x * ca.cos(q.x) + a.y * ca.sin(q.x)) * p.m + p.k,
            ],
            "x_ddot, y_ddot",
        ),
    ],
    ids=["structurally", "by constants", "by values"],
)
def test_singular_mass_matrix_is_refused_with_the_accelerations_it_leaves_open(equations, loose):
    with pytest.raises(ModelError, match=f"singular; the equations do not determine {loose}$"):
        two_axes(equations)


def test_mass_matrix_of_uneven_units_is_not_taken_for_singular():
    model = two_axes(lambda q, v, a, u, p: [1e-9 * p.m * a.x - u.f, 1e9 * a.y + p.k])
    assert np.array(model.dynamics([0] * 4, [1], [1, 1])[1]).ravel() == pytest.approx([1e9, -1e-9])


def test_a_mass_matrix_that_is_symmetric_but_for_rounding_is_solved():
    rounding = 1e-17
    model = two_axes(lambda q, v, a, u, p: [2.0 * a.x + rounding * ca.cos(q.x) * a.y - u.f, p.m * a.y + p.k])
    assert np.array(model.dynamics([0] * 4, [1], [1, 1])[1]).ravel() == pytest.approx([0.5, -1.0])


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"coordinates": {"x": "m", "x_dot": "m"}}, "'x_dot' is used twice"),
        ({"inputs": {"x": "N"}}, "'x' is used twice"),
        ({"inputs": {"x_ddot": "N"}}, "'x_ddot' is used twice"),
        ({"parameters": {"f": Parameter()}}, "'f' is used twice"),
        ({"coordinates": {"t": "s"}}, '"t" is reserved for time'),
        ({"coordinates": {"my x": "m"}}, "'my x' cannot name"),
        ({"coordinates": {"class": "m"}}, "'class' cannot name"),
        ({"coordinates": {"__x": "m"}}, "cannot name"),
        ({"coordinates": {3: "m"}}, "3 cannot name"),
        ({"coordinates": {}}, "no coordinates"),
        ({"parameters": {}}, "no parameters"),
        ({"coordinates": ["x"]}, "mapping from name to unit"),
        ({"inputs": None}, "mapping from name to unit"),
        ({"inputs": {"f": 1.0}}, "the unit of 'f' is 1.0"),
        ({"parameters": {"m": "kg"}}, "parameter 'm' is 'kg'; give dr.Parameter"),
        ({"parameters": ["m"]}, "mapping from name to dr.Parameter"),
        ({"velocities": {"w": "m/s"}}, "velocities without kinematics"),
        ({"kinematics": lambda q, v: [v.x]}, "kinematics without velocities"),
    ],
)
def test_names_that_cannot_serve_are_refused(changes, says):
    with pytest.raises(ModelError, match=says):
        one_axis(plain, **changes)


@pytest.mark.parametrize(
    ("kinematics", "says"),
    [
        (lambda q, v: [v.wx], "return 1 rates; return one for each of 4"),
        (lambda q, v: [v.wx, v.wy, v.wz, math.cos(q.qw)], "kinematics 4 of 4 contains NaN"),
        (lambda q, v: [v.x] * 4, "velocities have no 'x'"),
        (lambda q, v: [v.wx if q.qw > 0 else v.wy] * 4, "kinematics branch"),
    ],
)
def test_kinematics_that_cannot_serve_are_refused(kinematics, says):
    with pytest.raises(ModelError, match=says):
        tumbling(kinematics=kinematics)


@pytest.mark.parametrize(
    "bounds",
    [
        {"lower": 2.0, "upper": 1.0},
        {"lower": math.nan},
        {"upper": math.nan},
        {"positive": True, "upper": 0.0},
    ],
)
def test_bounds_that_leave_no_room_are_refused(bounds):
    with pytest.raises(ModelError, match="leave no room"):
        Parameter("kg", **bounds)


def test_parameter_admits_what_lies_within_its_bounds():
    values = [-1.0, 0.0, 1e-300, 2.0, 3.0, math.nan, math.inf]
    assert Parameter(lower=0.0, upper=2.0).admits(values).tolist() == [False, True, True, True, False, False, False]
    assert Parameter(positive=True).admits(values).tolist() == [False, False, True, True, True, False, False]
    assert Parameter().admits(values).tolist() == [True, True, True, True, True, False, False]


@pytest.mark.parametrize(
    ("parameters", "says"),
    [
        ({"m": 1.0}, "parameters are m, k; found m"),
        ({"m": 1.0, "k": 2.0, "c": 3.0}, "found m, k, c"),
        ({"m": math.nan, "k": 2.0}, "parameter m is nan"),
        ({"m": 1.0, "k": math.inf}, "parameter k is inf"),
    ],
)
def test_plant_without_a_finite_value_for_each_parameter_is_refused(parameters, says):
    with pytest.raises(ModelError, match=says):
        Plant(one_axis(plain), parameters)


def test_plant_has_its_parameters_in_the_models_order():
    assert list(Plant(one_axis(plain), {"k": 2, "m": 1}).parameters.items()) == [("m", 1.0), ("k", 2.0)]


# ---------------------------------------------------------------------- affine in the parameters, or not


@pytest.mark.parametrize(
    ("equations", "names"),
    [
        (plain, ()),
        (lambda q, v, a, u, p: [p.m * (a.x + p.k / p.m * v.x) - u.f], ()),
        (lambda q, v, a, u, p: [(p.m**2 - p.k**2) / (p.m + p.k) * a.x + p.k * v.x - u.f], ()),
        (lambda q, v, a, u, p: [p.m * a.x + ca.sign(p.k * v.x)], ("k",)),
        (lambda q, v, a, u, p: [p.m * a.x + ca.fabs(p.k) * v.x], ("k",)),
        (lambda q, v, a, u, p: [p.m * a.x + ca.floor(p.k) * v.x], ("k",)),
        (lambda q, v, a, u, p: [p.m * a.x + ca.if_else(p.k > 1, p.k, 2) * v.x], ("k",)),
        (lambda q, v, a, u, p: [p.m * a.x + p.m * p.k * v.x - u.f], ("m", "k")),
        (lambda q, v, a, u, p: [p.m * a.x + p.k**2 * v.x - u.f], ("k",)),
        (lambda q, v, a, u, p: [p.m * a.x + v.x / p.k - u.f], ("k",)),
        (lambda q, v, a, u, p: [a.x + p.k / p.m * v.x - u.f], ("m", "k")),
    ],
    ids=[
        "as written",
        "by cancelling",
        "by the binomial formula",
        "sign",
        "modulus of what may be negative",
        "floor",
        "if_else",
        "product",
        "square",
        "reciprocal",
        "quotient",
    ],
)
def test_nonlinear_parameters_are_found_by_evaluation(equations, names):
    model = one_axis(equations)
    assert model.nonlinear_parameters == names
    if names:
        with pytest.raises(ModelError, match=f"not affine in {', '.join(names)}"):
            model.regressor  # noqa: B018
    else:
        q, v, a, u, p = random_arguments(model, 3)
        W, b = (np.array(x) for x in model.regressor(q, v, a, u))
        assert W @ p - b.ravel() == pytest.approx(np.array(model.residual(q, v, a, u, p)).ravel(), abs=1e-9)


def test_affinity_in_accelerations_is_found_by_evaluation():
    """``(a^2 - 1) / (a - 1)`` does not look affine, and is."""
    model = one_axis(lambda q, v, a, u, p: [p.m * (a.x**2 - 1) / (a.x - 1) + p.k * v.x - u.f])
    acceleration = float(model.dynamics([0.0, 2.0], [5.0], [2.0, 0.5])[1])
    assert acceleration == pytest.approx((5.0 - 1.0) / 2.0 - 1.0)


def test_modulus_of_a_parameter_with_a_sign_is_still_not_affine():
    """What holds within the bounds alone is not relied on: an estimate may leave them."""
    model = one_axis(lambda q, v, a, u, p: [ca.fabs(p.m) * a.x + p.k * v.x - u.f])
    assert model.nonlinear_parameters == ("m",)


# ---------------------------------------------------------------------- what is derived


@st.composite
def affine_models(draw):
    """Two axes whose residuals are random sums of parameter times function of motion, with a coupled mass matrix."""
    atoms = {
        "x": lambda q, v, a, u: q.x,
        "sin": lambda q, v, a, u: ca.sin(q.y),
        "v|v|": lambda q, v, a, u: v.x * ca.fabs(v.x),
        "sign": lambda q, v, a, u: ca.sign(v.y),
        "vv": lambda q, v, a, u: v.x * v.y,
        "u": lambda q, v, a, u: u.f * ca.cos(q.x),
        "a": lambda q, v, a, u: a.x * ca.cos(q.y),
        "1": lambda q, v, a, u: 1.0,
    }
    names = [f"p{i}" for i in range(draw(st.integers(1, 4)))]
    factor = st.floats(-3.0, 3.0).filter(lambda x: abs(x) > 0.1)
    terms = [
        [(draw(st.sampled_from([*names, None])), draw(st.sampled_from(list(atoms))), draw(factor)) for _ in range(4)]
        for _ in range(2)
    ]

    def equations(q, v, a, u, p):
        rest = [sum((p[n] if n else 1.0) * atoms[atom](q, v, a, u) * c for n, atom, c in row) for row in terms]
        return [40.0 * a.x + 3.0 * a.y + rest[0], -2.0 * a.x + 50.0 * a.y + rest[1]]

    return two_axes_with(names, equations)


def two_axes_with(names, equations):
    return one_axis(equations, coordinates={"x": "m", "y": "rad"}, parameters=dict.fromkeys(names, Parameter("1")))


@FEW
@given(model=affine_models(), seed=SEEDS)
def test_regression_holds_on_every_solution_of_an_affine_model(model, seed):
    q, v, _, u, p = random_arguments(model, seed)
    a = np.array(model.dynamics(np.concatenate([q, v]), u, p)[1]).ravel()
    W, b = (np.array(x) for x in model.regressor(q, v, a, u))
    assert (W.shape, b.shape) == ((2, model.n_p), (2, 1))
    assert W @ p == pytest.approx(b.ravel(), abs=1e-10 * (1.0 + np.abs(W).max() * np.abs(p).max()))


@FEW
@given(model=affine_models(), seed=SEEDS)
def test_forward_acceleration_makes_the_residual_of_a_random_model_vanish(model, seed):
    q, v, _, u, p = random_arguments(model, seed)
    a = model.dynamics(np.concatenate([q, v]), u, p)[1]
    assert np.abs(np.array(model.residual(q, v, a, u, p))).max() < 1e-10


@EVERY_MODEL
@pytest.mark.parametrize("seed", range(5))
def test_forward_acceleration_makes_the_residual_vanish(model, seed):
    q, v, _, u, p = random_arguments(model, seed)
    rate, a = model.dynamics(np.concatenate([q, v]), u, p)
    assert np.abs(np.array(model.residual(q, v, a, u, p))).max() < 1e-9
    q_dot = v[: model.n_q] if model.kinematics is None else model.kinematics(q, v)
    assert np.array_equal(np.array(rate), np.array(ca.vertcat(q_dot, a)))


@EVERY_MODEL
@pytest.mark.parametrize("seed", range(5))
def test_linearisation_is_that_of_finite_differences(model, seed):
    q, v, _, u, p = random_arguments(model, seed)
    if model.name == "double-pendulum":
        v = np.sign(v) * (1.0 + np.abs(v))  # off the steep middle of its dry friction
    x, h = np.concatenate([q, v]), 1e-6
    A, B = (np.array(part) for part in model.linearization(x, u, p))

    def rate(x, u):
        return np.array(model.dynamics(x, u, p)[0]).ravel()

    def slopes(f, at):
        steps = h * np.eye(len(at))
        return np.column_stack([(f(at + s) - f(at - s)) / (2 * h) for s in steps])

    assert pytest.approx(slopes(lambda z: rate(z, u), x), rel=1e-6, abs=1e-6 * max(1.0, np.abs(A).max())) == A
    assert pytest.approx(slopes(lambda z: rate(x, z), u), rel=1e-6, abs=1e-6 * max(1.0, np.abs(B).max())) == B


@pytest.mark.parametrize("name", MACHINES)
def test_built_in_models_are_the_equations_written_by_hand(name):
    machine, model = MACHINES[name], builtin(name)
    assert model.signals == machine.signals
    assert list(model.parameters) == list(machine.truth)
    rng = np.random.default_rng(0)
    p = np.array(list(machine.truth.values()))
    for _ in range(20):
        q, v, a, u = (rng.uniform(-2.0, 2.0, n) for n in (model.n_q, model.n_v, model.n_v, model.n_u))
        forward = np.array(model.dynamics(np.concatenate([q, v]), u, p)[1]).ravel()
        assert forward == pytest.approx(machine.acceleration(q, v, u, p), rel=1e-9, abs=1e-9)
        W, b = (np.array(x) for x in model.regressor(q, v, a, u))
        by_hand = [np.array(x) for x in machine.regressor(q, v, a, u)]
        assert pytest.approx(by_hand[0], rel=1e-12, abs=1e-12) == W
        assert b.ravel() == pytest.approx(by_hand[1], rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_every_way_of_solving_for_accelerations_agrees(seed):
    """The same physics with a positive definite, a negative definite and an asymmetric mass matrix."""

    def written(first, second, mixed):
        def equations(q, v, a, u, p):
            r1 = (p.m + 2) * a.x + ca.cos(q.y) * a.y + p.k * v.x - u.f
            r2 = ca.cos(q.y) * a.x + 3 * a.y + q.x
            return [first * r1 + mixed * r2, second * r2]

        return two_axes(equations)

    forms = {1: written(1, 1, 0), -1: written(-1, -1, 0), 0: written(1, 1, 0.5)}
    assert {sign: model.force_sign for sign, model in forms.items()} == {1: 1, -1: -1, 0: 0}
    q, v, _, u, p = random_arguments(forms[1], seed)
    x = np.concatenate([q, v])
    by_form = [np.array(model.dynamics(x, u, p)[1]) for model in forms.values()]
    assert by_form[1] == pytest.approx(by_form[0], rel=1e-12)
    assert by_form[2] == pytest.approx(by_form[0], rel=1e-12)
    A, B = ([np.array(model.linearization(x, u, p)[i]) for model in forms.values()] for i in (0, 1))
    for matrices in (A, B):
        assert matrices[1] == pytest.approx(matrices[0], rel=1e-12, abs=1e-14)
        assert matrices[2] == pytest.approx(matrices[0], rel=1e-12, abs=1e-14)


def test_model_without_inputs_is_fine():
    model = one_axis(lambda q, v, a, u, p: [p.m * a.x + p.k * q.x], inputs={})
    assert float(model.dynamics([2.0, 0.0], [], [4.0, 3.0])[1]) == pytest.approx(-1.5)
    assert model.linearization([2.0, 0.0], [], [4.0, 3.0])[1].shape == (2, 0)


@pytest.mark.parametrize(
    ("unit", "velocity", "acceleration"),
    [("m", "m/s", "m/s^2"), ("rad", "rad/s", "rad/s^2"), ("m/s", "m/s^2", "m/s^3"), ("1", "1/s", "1/s^2")],
)
def test_velocities_and_accelerations_have_their_units(unit, velocity, acceleration):
    model = one_axis(plain, coordinates={"x": unit})
    assert (model.velocities, model.accelerations) == ({"x_dot": velocity}, {"x_ddot": acceleration})


def test_required_signals_are_those_that_the_equations_depend_on():
    assert builtin("planar-rotorcraft").required_signals == (
        "theta",
        "x_dot",
        "z_dot",
        "x_ddot",
        "z_ddot",
        "theta_ddot",
        "thrust",
        "moment",
    )


def test_states_behind_a_signal_are_those_whose_start_changes_it():
    model = builtin("planar-rotorcraft")
    assert model.states_behind(["theta_ddot"]) == ()
    assert model.states_behind(["theta_dot"]) == ("theta_dot",)
    assert model.states_behind(["z_ddot"]) == ("theta", "z_dot", "theta_dot")
    assert model.states_behind(["x"]) == ("x", "theta", "x_dot", "theta_dot")


def test_equations_read_in_the_models_names():
    (text,) = one_axis(plain).equations_text()
    assert text.startswith("0 = ")
    assert all(name in text for name in ("m", "x_ddot", "k", "x_dot", "f"))


# ---------------------------------------------------------------------- quaternions


def rates_of(rows):
    """Kinematics of six coordinates c0..c5 under rates w0..w2."""
    names = [f"c{i}" for i in range(6)]
    return Model(
        name="six",
        coordinates=dict.fromkeys(names, "1"),
        velocities=dict.fromkeys(("w0", "w1", "w2"), "rad/s"),
        inputs={},
        parameters={"J": Parameter(positive=True)},
        equations=lambda q, v, a, u, p: [p.J * x + y for x, y in zip(a, v, strict=True)],
        kinematics=lambda q, v: rows(*q, *v),
    )


def turn(w, x, y, z, w0, w1, w2):
    return [-x * w0 - y * w1 - z * w2, w * w0 + y * w2 - z * w1, w * w1 + z * w0 - x * w2, w * w2 + x * w1 - y * w0]


def scattered(a, b, c, d, e, f, *w):
    rates = turn(a, b, d, f, *w)
    return [*rates[:2], w[0], rates[2], w[1], rates[3]]


def growing(a, b, c, d, e, f, *w):
    rates = turn(a, b, c, d, *w)
    return [*(rate + 0.1 * x for rate, x in zip(rates, (a, b, c, d), strict=True)), *w[:2]]


def unit_vector(a, b, c, d, e, f, *w):
    return [b * w[2] - c * w[1], c * w[0] - a * w[2], a * w[1] - b * w[0], 0, *w[:2]]


@pytest.mark.parametrize(
    ("rows", "found"),
    [
        (lambda a, b, c, d, e, f, *w: [*turn(a, b, c, d, *w), *w[:2]], ((0, 1, 2, 3),)),
        (lambda a, b, c, d, e, f, *w: [w[0], *turn(b, c, d, e, *w), w[1]], ((1, 2, 3, 4),)),
        (scattered, ()),
        (growing, ()),
        (lambda a, b, c, d, e, f, *w: [-b * w[0], a * w[0], -d * w[1], c * w[1], w[2], w[0]], ()),
        (unit_vector, ()),
        (lambda a, b, c, d, e, f, *w: [0, 0, 0, 0, *w[:2]], ()),
    ],
    ids=["first four", "middle four", "not consecutive", "growing", "two circles", "unit vector", "constant"],
)
def test_quaternions_are_four_consecutive_coordinates_whose_norm_alone_is_conserved(rows, found):
    assert rates_of(rows).quaternions == found


def test_model_without_kinematics_has_no_quaternions():
    assert builtin("double-pendulum").quaternions == ()


def test_velocities_of_their_own_name_their_accelerations():
    model = tumbling()
    assert model.accelerations == {"wx_dot": "rad/s^2", "wy_dot": "rad/s^2", "wz_dot": "rad/s^2"}
    assert model.quaternions == ((0, 1, 2, 3),)
    assert model.signals[-3:] == ("wx_dot", "wy_dot", "wz_dot")


# ---------------------------------------------------------------------- storage


@EVERY_MODEL
def test_pickling_drops_closures_and_keeps_the_fingerprint(model):
    twin = pickle.loads(pickle.dumps(model))  # its functions are local: closures would not pickle
    assert twin.fingerprint == model.fingerprint
    assert twin == model
    assert hash(twin) == hash(model)
    q, v, a, u, p = random_arguments(model, 1)
    assert np.array_equal(np.array(twin.residual(q, v, a, u, p)), np.array(model.residual(q, v, a, u, p)))
    assert twin.quaternions == model.quaternions
    assert twin.parameters == model.parameters


@EVERY_MODEL
def test_model_survives_json(model):
    twin = Model.from_dict(json.loads(json.dumps(model.to_dict())))
    assert twin.to_dict() == model.to_dict()


def test_models_are_equal_where_names_units_bounds_and_equations_are():
    models = [
        one_axis(plain),
        one_axis(lambda q, v, a, u, p: [p.m * a.x + 2 * p.k * v.x - u.f]),
        one_axis(plain, coordinates={"x": "mm"}),
        one_axis(plain, parameters={"m": Parameter("kg"), "k": Parameter("N s/m")}),
    ]
    assert len(set(models)) == len({model.fingerprint for model in models}) == len(models)
    assert one_axis(plain) == models[0]
    assert one_axis(plain).fingerprint == models[0].fingerprint
    assert models[0] != "one axis"


def damage(path, value):
    """The stored tumbling body with one thing changed or, for None, removed."""
    data = copy.deepcopy(tumbling().to_dict())
    holder = data
    for key in path[:-1]:
        holder = holder[key]
    if value is None:
        del holder[path[-1]]
    else:
        holder[path[-1]] = value
    return data


@pytest.mark.parametrize(
    "data",
    [
        damage(["residual"], None),
        damage(["checksum"], None),
        damage(["residual"], "jhpnnagiieahaaaadaaaaaaa"),
        damage(["kinematics"], "nonsense"),
        damage(["coordinates", "qw"], None),
        damage(["inputs", "extra"], "N"),
        damage(["parameters", "Jx", "positive"], False),
        damage(["parameters"], 3),
        {},
        [],
        "model",
    ],
    ids=str,
)
def test_damaged_model_is_refused(data):
    with pytest.raises(ResultError):
        Model.from_dict(data)


@pytest.mark.parametrize(
    "path_and_value",
    [
        (["inputs", "extra"], "N"),
        (["coordinates", "more"], "m"),
        (["parameters", "Jw"], {"unit": "1", "lower": None, "upper": None, "positive": False}),
        (["parameters", "Jx"], {"unit": "1"}),
        (["residual"], "nonsense"),
        (["residual"], 5),
        (["kinematics"], ""),
        (["inputs"], {"qw": "N", "b": "N", "c": "N"}),
    ],
    ids=str,
)
def test_damaged_model_with_a_right_checksum_is_refused_too(path_and_value, monkeypatch):
    monkeypatch.setattr("diransac.model.model._checksum", lambda data: tumbling_checksum)
    with pytest.raises(ResultError):
        Model.from_dict(damage(*path_and_value))


tumbling_checksum = tumbling().to_dict()["checksum"]


def test_an_expression_that_reports_its_value_is_printed_as_itself():
    x = ca.SX.sym("x")
    function = ca.Function("f", [x], [ca.sin(x.printme(1))], ["x"], ["r"])
    assert printed(function, {"x": ["x"]}) == ([], ["sin(x)"])
