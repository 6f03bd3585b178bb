"""Plants and what disturbs them, against hand calculations and SciPy's integrator."""

import pickle
from math import pi, sin
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import diransac as dr
from diransac.errors import ModelError, SettingsError
from diransac.model.plant import DisturbedModel, as_plant
from diransac.simulation import RolloutBatch, rollouts


def mass(sign=1.0, *, definite=True):
    """A mass with m x'' = F, written with either sign; or, if not definite, with rows that are no balance of forces."""

    def equations(q, v, a, u, p):
        if definite:
            return [sign * (p.m * a.x - u.force), sign * (p.m * a.y)]
        return [p.m * a.x - u.force, a.x + a.y]

    return dr.Model("mass", {"x": "m", "y": "m"}, {"force": "N"}, {"m": dr.Parameter("kg", positive=True)}, equations)


MASS = mass()


def pushed(model=MASS, m=2.0, **disturbance):
    """A plant of 2 kg with one disturbance."""
    return dr.Plant(model, {"m": m}, (dr.Disturbance(model, "push", **disturbance),))


def accelerations(plant, x, u=(0.0,)):
    """Accelerations at one state of what is simulated."""
    return np.array(plant.simulated.dynamics(x, u, plant.constants)[1]).ravel()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_forces_are_divided_by_the_mass_whatever_sign_the_equations_are_written_with(sign):
    plant = pushed(mass(sign), forces=lambda q, v, u, p, d: {"x": 3.0, "y": -1.0})
    np.testing.assert_allclose(accelerations(plant, np.zeros(4), [1.0]), [(1.0 + 3.0) / 2.0, -0.5], rtol=1e-15)


def test_forces_go_through_a_coupled_mass_matrix():
    model = dr.models.double_pendulum()
    rng = np.random.default_rng(0)
    q, v, u, f = (rng.uniform(-1, 1, n) for n in (model.n_q, model.n_v, model.n_u, model.n_v))
    p = dict(zip(model.parameters, rng.uniform(0.5, 1.0, model.n_p), strict=True))
    names = model.rate_names
    shove = dr.Disturbance(model, "shove", forces=lambda *_: dict(zip(names, f, strict=True)))
    plant = dr.Plant(model, p, (shove,))
    values = np.array(list(plant.parameters.values()))
    a = accelerations(plant, np.concatenate([q, v]), u)
    residual = np.array(model.residual(q, v, a, u, values)).ravel()
    mass_matrix = np.array(ca.jacobian(model.residual(q, v, ca.SX.sym("a", 2), u, values), ca.SX.sym("a", 2)).shape)
    assert mass_matrix.tolist() == [2, 2]
    at_rest = np.array(model.residual(q, v, np.zeros(2), u, values)).ravel()
    columns = [np.array(model.residual(q, v, e, u, values)).ravel() - at_rest for e in np.eye(2)]
    M = np.column_stack(columns)
    np.testing.assert_allclose(residual, f * np.sign(np.linalg.eigvalsh((M + M.T) / 2)[0]), rtol=1e-12)


def test_accelerations_are_added_as_they_are():
    plant = pushed(accelerations=lambda q, v, u, p, d: {"y": 3.0 * q.x + u.force})
    np.testing.assert_allclose(accelerations(plant, [0.5, 0, 0, 0], [1.0]), [0.5, 2.5], rtol=1e-15)


def test_several_disturbances_add_up_and_keep_their_own_names():
    one = dr.Disturbance(MASS, "one", forces=lambda q, v, u, p, d: {"x": d.size}, constants={"size": 4.0})
    two = dr.Disturbance(MASS, "two", accelerations=lambda q, v, u, p, d: {"x": d.size}, constants={"size": 0.25})
    plant = dr.Plant(MASS, {"m": 2.0}, (one, two))
    np.testing.assert_allclose(accelerations(plant, np.zeros(4)), [4.0 / 2.0 + 0.25, 0.0], rtol=1e-15)
    assert plant.simulated.parameters == ("m", "one.size", "two.size")
    assert plant.simulated.name == "mass with one and two"


def test_a_force_of_the_time_moves_a_mass_as_its_integral_says():
    plant = pushed(forces=lambda q, v, u, p, d: {"x": ca.sin(3.0 * d.t)})
    engine = rollouts(plant.simulated, substeps=4)
    flown = engine.trajectories(
        RolloutBatch([plant.constants], plant.initial_state(np.zeros(4)), np.zeros((201, 1)), 0.01)
    )[0]
    t = np.arange(201) * 0.01
    np.testing.assert_allclose(flown[:, 0], (t / 3.0 - np.sin(3.0 * t) / 9.0) / 2.0, atol=1e-10)
    np.testing.assert_allclose(flown[:, plant.simulated.signals.index("x_ddot")], np.sin(3.0 * t) / 2.0, atol=1e-13)


def test_states_of_its_own_are_integrated_with_the_plant():
    """A body on a spring whose rest position runs away by itself, nonlinearly."""
    plant = pushed(
        forces=lambda q, v, u, p, d: {"x": d.stiffness * (d.rest - q.x)},
        constants={"stiffness": 8.0},
        states={"rest": "m", "speed": "m/s"},
        rates=lambda q, v, u, p, d: {"rest": d.speed, "speed": -ca.sin(d.rest) - q.x},
        start={"speed": 1.0},
    )
    assert plant.simulated.state == ("x", "y", "x_dot", "y_dot", "push.rest", "push.speed")
    engine = rollouts(plant.simulated, substeps=5)
    flown = engine.trajectories(
        RolloutBatch([plant.constants], plant.initial_state(np.zeros(4)), np.zeros((301, 1)), 0.01)
    )[0]

    def rates(_t, s):
        return [s[1], 8.0 * (s[2] - s[0]) / 2.0, s[3], -sin(s[2]) - s[0]]

    exact = solve_ivp(rates, (0.0, 3.0), [0.0, 0.0, 0.0, 1.0], rtol=1e-11, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(flown[-1, [0, 2, 4, 5]], exact, atol=1e-8)


def test_other_constants_need_no_new_compilation():
    def blown(strength, function=ca.cos):
        return pushed(forces=lambda q, v, u, p, d: {"x": d.strength * function(q.x)}, constants={"strength": strength})

    engines = {rollouts(blown(strength).simulated) for strength in (1.0, 2.0)}
    assert len(engines) == 1
    again = pickle.loads(pickle.dumps(blown(3.0)))
    assert again.simulated == blown(1.0).simulated
    assert rollouts(again.simulated) in engines
    assert blown(1.0, ca.sin).simulated != blown(1.0).simulated
    assert blown(1.0).simulated != MASS
    assert accelerations(blown(2.0), np.zeros(4))[0] == 2.0 * accelerations(blown(1.0), np.zeros(4))[0] == 1.0


@pytest.mark.parametrize("bounds", [tuple, list, np.array])
def test_a_start_in_a_range_is_drawn_with_the_seed(bounds):
    plant = pushed(
        forces=lambda q, v, u, p, d: {"x": ca.cos(d.phase)},
        states={"phase": "rad", "fixed": "rad"},
        rates=lambda q, v, u, p, d: {"phase": 1.0, "fixed": 0.0},
        start={"phase": bounds((0.0, 2.0 * pi)), "fixed": 0.5},
    )
    starts = np.array([plant.initial_state(np.ones(4), seed) for seed in range(200)])
    np.testing.assert_array_equal(starts[3], plant.initial_state(np.ones(4), 3))
    np.testing.assert_array_equal(starts[:, :4], 1.0)
    np.testing.assert_array_equal(starts[:, 5], 0.5)
    # A uniform phase has the mean pi; the standard error of 200 is 2 pi / sqrt(12 * 200).
    assert abs(starts[:, 4].mean() - pi) < 4 * 2 * pi / np.sqrt(12 * 200)
    assert starts[:, 4].min() >= 0.0
    assert starts[:, 4].max() <= 2 * pi


def test_steps_resolve_the_fastest_disturbance():
    slow = dr.Disturbance(MASS, "slow", forces=lambda *_: {"x": 1.0})
    fast = dr.Disturbance(MASS, "fast", forces=lambda *_: {"x": 1.0}, highest_frequency=260.0)
    assert dr.Plant(MASS, {"m": 1.0}).substeps(0.01) == dr.Plant(MASS, {"m": 1.0}, (slow,)).substeps(0.01) == 1
    assert dr.Plant(MASS, {"m": 1.0}, (slow, fast)).substeps(0.01) == 21  # 8 * 2.6 turns, rounded up


def test_derivatives_of_a_disturbed_plant_agree_with_differences():
    plant = pushed(
        forces=lambda q, v, u, p, d: {"x": d.k * ca.sin(d.s) * v.y + p.m * d.t, "y": u.force * q.x},
        constants={"k": 3.0},
        states={"s": "1"},
        rates=lambda q, v, u, p, d: {"s": q.x * v.x},
    )
    model, rng = plant.simulated, np.random.default_rng(1)
    assert isinstance(model, DisturbedModel)
    z = [rng.uniform(0.5, 1.5, n) for n in (len(model.state), model.n_u, model.n_p)]
    for k, jacobian in enumerate(model.rate_jacobians(*z)):
        for j in range(len(z[k])):
            h = np.zeros(len(z[k]))
            h[j] = 1e-6
            ahead, behind = (model.dynamics(*z[:k], z[k] + s * h, *z[k + 1 :])[0] for s in (1, -1))
            np.testing.assert_allclose(np.array(jacobian)[:, j], np.array(ahead - behind)[:, 0] / 2e-6, atol=1e-8)


def test_a_disturbed_plant_goes_through_a_pickle():
    plant = pushed(
        forces=lambda q, v, u, p, d: {"x": d.k * ca.sin(d.s)},
        constants={"k": 3.0},
        states={"s": "rad"},
        rates=lambda q, v, u, p, d: {"s": 5.0},
        start={"s": (0.0, 1.0)},
    )
    again = pickle.loads(pickle.dumps(plant))
    assert again.parameters == plant.parameters
    np.testing.assert_array_equal(again.initial_state(np.zeros(4), 7), plant.initial_state(np.zeros(4), 7))
    x = np.array([1.0, 2.0, 3.0, 4.0, 0.3])
    np.testing.assert_array_equal(accelerations(again, x), accelerations(plant, x))


STATE = {"states": {"s": "m"}, "rates": lambda *_: {"s": 0.0}}


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"forces": lambda q, v, u, p, d: {"w": 1.0}}, 'forces name "w"; there are x, y'),
        ({"forces": lambda q, v, u, p, d: {"x": d.k}}, "constants and states have no 'k'; found t"),
        ({"forces": lambda q, v, u, p, d: {"x": 1.0 if q.x > 0 else 0.0}}, "forces branch on a symbol"),
        ({"forces": lambda q, v, u, p, d: {"x": float("nan")}}, "forces 1 of 2 contains NaN"),
        ({"states": {"s": "m"}}, "states need rates"),
        ({"rates": lambda *_: {}}, "states need rates"),
        ({"start": {"s": 1.0}}, 'start names "s"; states are none'),
        ({**STATE, "start": {"s": [1.0, 2.0, 3.0]}}, r"s is \(1.0, 2.0, 3.0\); give a finite number"),
        ({**STATE, "start": {"s": [2, 1]}}, r"s is \(2, 1\); give the low end of a range first"),
        ({"constants": {"t": 1.0}}, "a name is used twice"),
        ({"constants": {"k": np.inf}}, "k is inf; give a finite number"),
        ({"highest_frequency": -1.0}, "highest_frequency is -1"),
        ({"name": "a b"}, "use letters, digits and hyphens"),
    ],
)
def test_a_disturbance_that_makes_no_sense_is_refused(arguments, says):
    with pytest.raises(ModelError, match=says):
        dr.Disturbance(**{"model": MASS, "name": "push", **arguments})


def test_forces_need_equations_that_are_a_balance_of_forces():
    rows = mass(definite=False)
    with pytest.raises(ModelError, match=r"not symmetric and definite.*give accelerations"):
        dr.Disturbance(rows, "push", forces=lambda *_: {"x": 1.0})
    plant = dr.Plant(rows, {"m": 1.0}, (dr.Disturbance(rows, "push", accelerations=lambda *_: {"x": 1.0}),))
    np.testing.assert_allclose(accelerations(plant, np.zeros(4)), [1.0, 0.0])


def test_disturbances_of_another_model_or_of_one_name_are_refused():
    push = dr.Disturbance(MASS, "push", forces=lambda *_: {"x": 1.0})
    with pytest.raises(ModelError, match='"push" was made for model "mass", not for "planar-rotorcraft"'):
        dr.Plant(dr.models.planar_rotorcraft(), dr.models.TABLE_I, (push,))
    with pytest.raises(ModelError, match='two disturbances have the name "push"'):
        dr.Plant(MASS, {"m": 1.0}, (push, push))


def test_a_result_serves_as_a_plant_and_nothing_else_does():
    result = SimpleNamespace(model=MASS, parameters={"m": 3.0})
    assert as_plant(result) == dr.Plant(MASS, {"m": 3.0})
    for other in (MASS, "model.json", None):
        with pytest.raises(SettingsError, match=r"give a dr.Plant or a dr.Result"):
            as_plant(other)
