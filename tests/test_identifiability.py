"""Identifiability in words: combinations are those of the equations and logs, and refusals name their planted cause."""

import re

import casadi as ca
import numpy as np
import pytest

import diransac as dr
from diransac.data.dataset import Dataset
from diransac.errors import IdentificationError
from diransac.identification.structure.identifiability import collinear
from diransac.identification.structure.structural import structural
from diransac.model.library import BUILTIN, builtin
from user_models import hanging_mass, tumbling

N, DT = 600, 0.02
MASS, DRAG = 1.5, 2.0
POSITIVE, NOT_NEGATIVE, FREE = dr.Parameter("kg", positive=True), dr.Parameter("N s/m", lower=0.0), dr.Parameter("1")


def model(equation, inputs=("force",), **parameters):
    units = dict.fromkeys(inputs, "N")
    return dr.Model("sledge", {"s": "m"}, units, parameters, lambda q, v, a, u, p: [equation(q, v, a, u, p)])


def sledge(mass=POSITIVE, drag=NOT_NEGATIVE):
    return model(lambda q, v, a, u, p: p.mass * a.s + p.drag * v.s - u.force, mass=mass, drag=drag)


def slide(noise=0.01, **changes):
    """A mass with viscous drag: exact where the force is held, then white noise; changes replace columns."""
    t, rng = DT * np.arange(N), np.random.default_rng(1)
    force = 3.0 * np.sin(1.1 * t) + 2.0 * np.sin(3.7 * t + 0.5) + np.sin(7.9 * t)
    state, decay = np.zeros((N + 1, 2)), np.exp(-DRAG / MASS * DT)
    for k, f in enumerate(force):
        final, gap = f / DRAG, state[k, 1] - f / DRAG
        state[k + 1] = state[k, 0] + final * DT + gap * (1.0 - decay) * MASS / DRAG, final + gap * decay
    s, v = state[:-1].T
    columns = {"s": s, "s_dot": v, "s_ddot": (force - DRAG * v) / MASS}
    columns = {name: x + noise * rng.normal(size=N) for name, x in columns.items()} | {"force": force}
    return dr.Log.from_arrays(t, columns | {n: x(columns) for n, x in changes.items()}, source="slide")


# ---------------------------------------------------------------------- of the equations


@pytest.mark.parametrize(
    ("equation", "parameters", "names", "combinations", "noun"),
    [
        (lambda q, v, a, u, p: p.m * a.s + (p.c + 2.0 * p.d) * v.s - u.force, "mcd", "cd", ("c + 2 d",), "combination"),
        (lambda q, v, a, u, p: p.m * a.s + (p.c - p.d) * v.s - u.force, "mcd", "cd", ("c - d",), "combination"),
        (lambda q, v, a, u, p: p.m * a.s + p.c * v.s - p.k * u.force, "mck", "mck", ("c/m", "k/m"), "ratio"),
        (lambda q, v, a, u, p: a.s + p.c / p.m * v.s - u.force / p.m * p.k, "mck", "mck", ("c/m", "k/m"), "ratio"),
        (lambda q, v, a, u, p: p.m * a.s + p.c * p.d**2 * v.s - u.force, "mcd", "cd", ("c d^2",), "combination"),
        (lambda q, v, a, u, p: p.m * a.s + (p.c + p.d * p.k) * v.s - u.force, "mcdk", "cdk", (), "combination"),
        (lambda q, v, a, u, p: p.m * a.s + 0.0 * p.c - u.force, "mc", "c", (), "combination"),
    ],
)
def test_combinations_are_those_that_the_equations_determine(equation, parameters, names, combinations, noun):
    (found,) = structural(model(equation, **dict.fromkeys(parameters, dr.Parameter("1", positive=True))))
    assert (found.names, found.combinations, found.noun) == (tuple(names), combinations, noun)


@pytest.mark.parametrize("name", BUILTIN)
def test_identifiable_models_have_no_ambiguity(name):
    model = builtin(name)
    scaled = name in {"single-track-vehicle", "quadrotor"}  # no input is a force
    assert structural(model.with_fixed({"mass": 1.0}) if scaled else model) == ()


def test_models_of_users_that_are_identifiable_have_no_ambiguity():
    assert structural(tumbling()) == structural(hanging_mass()) == ()


def test_one_scale_of_a_machine_can_be_ambiguous_while_another_is_not():
    """Nothing known acts along x, so only drag/mass is determined; a known torque determines the inertia."""

    def equations(q, v, a, u, p):
        return [p.mass * a.x + p.drag * v.x, p.inertia * a.angle - u.torque]

    parameters = {"mass": POSITIVE, "drag": NOT_NEGATIVE, "inertia": POSITIVE}
    (found,) = structural(dr.Model("puck", {"x": "m", "angle": "rad"}, {"torque": "N m"}, parameters, equations))
    assert found.combinations == ("drag/mass",)


def test_a_parameter_between_equal_bounds_is_known():
    def equation(q, v, a, u, p):
        return p.mass * a.s + p.drag * v.s - p.k * u.force

    assert structural(model(equation, mass=dr.Parameter("kg", 2.0, 2.0), drag=NOT_NEGATIVE, k=FREE)) == ()


@pytest.mark.parametrize("method", dr.METHODS)
def test_homogeneous_equations_are_refused_with_their_ratios(method):
    def equation(q, v, a, u, p):
        return p.mass * a.s + p.drag * v.s - p.k * u.force

    homogeneous = model(equation, mass=POSITIVE, drag=NOT_NEGATIVE, k=FREE)
    with pytest.raises(
        IdentificationError, match=r"only the ratios drag/mass, k/mass.*b = 0.*fix one, for example mas"
    ):
        dr.identify(homogeneous, slide(), method)


def test_a_sum_is_named_and_no_motion_is_asked_for():
    def equation(q, v, a, u, p):
        return p.mass * a.s + (p.c + p.d) * v.s - u.force

    split = model(equation, mass=POSITIVE, c=FREE, d=FREE)
    with pytest.raises(IdentificationError, match=r"c, d are not identifiable: only the combination c \+ d.*no motion"):
        dr.identify(split, slide(), "ols")
    result = dr.identify(split, slide())
    assert result.unidentifiable == ("c", "d")
    assert result.parameters["mass"] == pytest.approx(MASS, rel=0.01)
    assert "c + d is determined" in str(result)
    assert "livelier" not in str(result)
    assert dr.Result.from_dict(result.to_dict()).diagnosis.combinations == result.diagnosis.combinations


# ---------------------------------------------------------------------- of a log


def test_what_a_steady_log_determines_is_a_combination():
    """At constant speed 0.5 m/s, drag and a constant force are one: drag * 0.5 + bias."""

    def equation(q, v, a, u, p):
        return p.mass * a.s + p.drag * v.s + p.bias - u.force

    rng = np.random.default_rng(0)
    a = rng.normal(size=N)
    columns = {"s": 0.5 * DT * np.arange(N), "s_dot": np.full(N, 0.5), "s_ddot": a, "force": MASS * a + 0.5 * DRAG}
    log = dr.Log.from_arrays(DT * np.arange(N), columns)
    with pytest.raises(
        IdentificationError, match=r"drag, bias are not .* drag \+ 2 bias is determined by this motion; rec"
    ):
        dr.identify(model(equation, mass=POSITIVE, drag=NOT_NEGATIVE, bias=FREE), log, "ols")


def test_an_input_that_never_acts_leaves_its_gain_alone_unidentifiable():
    def equation(q, v, a, u, p):
        return p.mass * a.s + p.drag * v.s - u.force - p.gain * u.aid

    helped = model(equation, ("force", "aid"), mass=POSITIVE, drag=NOT_NEGATIVE, gain=FREE)
    log = slide(aid=lambda x: np.zeros(N))
    with pytest.raises(
        IdentificationError, match="gain is not identifiable from this log: the motion does not excite it"
    ):
        dr.identify(helped, log, "ols")
    result = dr.identify(helped, log)
    assert result.unidentifiable == ("gain",)
    assert result.parameters["drag"] == pytest.approx(DRAG, rel=0.01)


def test_collinear_estimates_are_named_with_the_combination_that_is_determined():
    """Errors of a and b in proportion 1 : -2 leave 2 a + b; c is independent of both, and d is certain."""
    J = np.array([[1.0, -2.0, 0.0, 0.0], [0.0, 0.0, 5.0, 0.0], [0.01, 0.02, 0.0, 0.01]])
    found = collinear("abcd", np.array([3.0, 4.0, 1.0, 1.0]), J.T @ J, np.array([True, True, True, False]))
    assert [x.names for x in found] == [("c",), ("a", "b")]
    assert found[1].combinations == ("2 a + b = 10 ± 0.04",)


@pytest.mark.parametrize("method", ["ols", "tls", "nls", "i-diransac"])
def test_a_log_without_a_known_force_determines_ratios_alone(method):
    """A mass that coasts: m a + c v = 0 is solved by zero."""
    v = 2.0 * np.exp(-DRAG / MASS * DT * np.arange(N))
    columns = {"s": MASS / DRAG * (2.0 - v), "s_dot": v, "s_ddot": -DRAG / MASS * v, "force": np.zeros(N)}
    with pytest.raises(
        IdentificationError, match=r"b = 0 in each row of W p = b, since force is zero throughout: only 1 ra"
    ):
        dr.identify(sledge(), dr.Log.from_arrays(DT * np.arange(N), columns), method)


def test_a_combination_that_two_logs_leave_open_is_that_of_their_own_parameters():
    """A shared offset and one bias per log appear as a sum in each log."""

    def equation(q, v, a, u, p):
        return p.mass * a.s + p.drag * v.s + p.offset + p.bias - u.force

    biased = model(equation, mass=POSITIVE, drag=NOT_NEGATIVE, offset=FREE, bias=dr.Parameter("N", per_log=True))
    logs = [slide(force=lambda x, b=b: x["force"] + b) for b in (0.2, -0.3)]
    result = dr.identify(biased, logs, compare_logs=False)
    assert set(result.diagnosis.unidentifiable) == {"offset", "bias[0]", "bias[1]"}
    assert "only the combination offset + bias is determined" in str(result)
    assert result.parameters["drag"] == pytest.approx(DRAG, rel=0.02)


@pytest.mark.parametrize("method", ["ols", "nls"])
def test_parameters_that_a_log_hardly_tells_apart_are_named_with_their_sum(method):
    """The speed stays within a percent of 0.5 m/s: drag and bias are nearly one force, 0.5 drag + bias = 1.4."""

    def equation(q, v, a, u, p):
        return p.mass * a.s + p.drag * v.s + p.bias - u.force

    rng = np.random.default_rng(6)
    v, a = 0.5 + 0.005 * np.sin(0.7 * DT * np.arange(N)), rng.normal(size=N)
    force = MASS * a + DRAG * v + 0.4 + 0.2 * rng.normal(size=N)
    log = dr.Log.from_arrays(DT * np.arange(N), {"s": np.cumsum(v) * DT, "s_dot": v, "s_ddot": a, "force": force})
    result = dr.identify(model(equation, mass=POSITIVE, drag=dr.Parameter("N s/m"), bias=FREE), log, method)
    (found,) = re.findall(
        r"drag, bias are not .* only the combination drag \+ (\S+) bias = (\S+) ± (\S+) is", str(result)
    )
    share, value, error = map(float, found)
    assert share == pytest.approx(2.0, rel=0.02)
    assert abs(value - DRAG - 0.4 * share) < 3.0 * error < 0.3


def test_certain_parameters_have_no_such_note():
    assert "combination" not in str(dr.identify(sledge(), slide(), "ols"))


# ---------------------------------------------------------------------- causes of a refusal


@pytest.mark.parametrize("method", ["diransac", "i-diransac", "lo-diransac", "nls"])
def test_a_reversed_input_is_named(method):
    log = slide(force=lambda x: -x["force"])
    says = r"The sign of force.* reversed: .*mass = -1\.\d+, drag = -.*--scale force=-1"
    with pytest.raises(IdentificationError, match=says):
        dr.identify(sledge(), log, method)


def test_an_input_in_another_unit_is_named_where_bounds_show_it():
    bounded = sledge(dr.Parameter("kg", 0.1, 10.0), dr.Parameter("N s/m", 0.1, 10.0))
    with pytest.raises(
        IdentificationError, match=r"force is in mN, not in N: .*mass = 1(499|500).* --scale force=0\.001"
    ):
        dr.identify(bounded, slide(force=lambda x: 1000.0 * x["force"]), "i-diransac")


def test_a_bound_that_excludes_the_truth_is_named_without_a_guess():
    with pytest.raises(
        IdentificationError, match=r"gives drag = (2\.0|1\.99)\S* ± \S*, clearly outside its bounds; compare"
    ) as said:
        dr.identify(sledge(drag=dr.Parameter("N s/m", 2.5, 2.6)), slide(), "i-diransac")
    assert not re.search("sign|unit", str(said.value))


@pytest.mark.parametrize("method", dr.METHODS)
@pytest.mark.parametrize("quantum", [0.0, 0.01], ids=["analogue", "quantised"])
def test_a_bench_log_is_refused_because_nothing_moves(method, quantum):
    rng = np.random.default_rng(3)
    noise = {name: 0.02 * rng.normal(size=N) for name in ("s", "s_dot", "s_ddot")}
    if quantum:
        noise = {name: quantum * np.round(x / quantum) for name, x in noise.items()}
    log = dr.Log.from_arrays(DT * np.arange(N), {**noise, "force": np.full(N, 0.3)})
    with pytest.raises(
        IdentificationError, match=r"mass, drag are not identifiable: nothing moves: .* s, s_dot does not"
    ):
        dr.identify(sledge(), log, method)


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_a_motion_with_outliers_and_noise_is_a_motion(noise):
    rng = np.random.default_rng(4)
    hit = lambda x: np.where(rng.random(N) < 0.3, rng.uniform(-50.0, 50.0, N), x)  # noqa: E731
    log = slide(noise, s=lambda x: hit(x["s"]), s_dot=lambda x: hit(x["s_dot"]))
    assert dr.identify(sledge(), log).parameters["mass"] == pytest.approx(MASS, rel=0.2)


def test_a_coordinate_at_rest_says_nothing_of_the_others():
    """A sledge that never leaves its track: the second equation is 0 = 0 on the log."""
    track = dr.Model(
        "tracked sledge",
        {"s": "m", "y": "m"},
        {"force": "N"},
        {"mass": POSITIVE, "drag": NOT_NEGATIVE},
        lambda q, v, a, u, p: [p.mass * a.s + p.drag * v.s - u.force, p.mass * a.y + p.drag * v.y],
    )
    columns = {name: slide()[name] for name in ("s", "s_dot", "force")} | {"y": np.zeros(N), "y_dot": np.zeros(N)}
    found = dr.identify(track, dr.Log.from_arrays(DT * np.arange(N), columns), differentiate=True)
    assert found.parameters == pytest.approx({"mass": MASS, "drag": DRAG}, rel=0.02)


def reactor() -> dr.Model:
    """A rate by Arrhenius' law at a temperature in kelvin: zero at a few kelvin."""
    return dr.Model(
        "reactor",
        {},
        {"heat": "K"},
        {"k": dr.Parameter("1/s", positive=True), "E": dr.Parameter("1e5 K", positive=True), "U": dr.Parameter("1/s")},
        lambda q, v, a, u, p: [a.T + p.U * (v.T - u.heat) - p.k * ca.exp(-1e5 * p.E / ca.sqrt(v.T**2 + 1.0))],
        first_order={"T": "K"},
    )


def test_a_term_that_vanishes_at_every_random_motion_is_determined_in_the_range_of_a_log():
    (found,) = structural(reactor())
    assert (found.names, found.n_determined) == (("k", "E"), 0)
    assert structural(reactor(), None, (("T", 900.0, 1300.0), ("heat", -1.0, 1.0))) == ()
    assert structural(reactor(), ("T",), (("T", 9e4, 13e4), ("heat", -1.0, 1.0))) == ()


def test_ambiguities_of_the_equations_are_those_of_any_range():
    puck = model(lambda q, v, a, u, p: (p.mass + p.k) * a.s - u.force, mass=POSITIVE, k=POSITIVE)
    assert structural(puck) == structural(puck, None, (("s", 300.0, 301.0), ("s_dot", -1e-6, 1e-6)))
    assert len(structural(puck)) == 1


def test_ranges_of_a_dataset_are_those_of_all_logs_without_outliers():
    time = np.linspace(0.0, 10.0, 101)
    logs = [
        dr.Log.from_arrays(
            time, {"T": np.where(time == 5.0, 1e9, low + time), "T_dot": 1.0 + 0 * time, "heat": 0 * time}
        )
        for low in (300.0, 320.0)
    ]
    ranges = {name: (low, high) for name, low, high in Dataset.of(reactor(), logs).ranges}
    assert ranges["T"] == (300.0, 330.0)
    assert ranges["heat"] == (0.0, 0.0)
