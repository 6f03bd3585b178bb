"""Other parameters with the same signals: time constants that change places where a state is not measured."""

import numpy as np
import pytest

import diransac as dr
from diransac.identification.structure.equivalents import equivalent_parameters
from diransac.identification.structure.structural import structural

POSITIVE = {"positive": True}


def two_lags(**bounds):
    """An actuator with a lag before a plant with one; the transfer function is that of both in either order."""
    seconds = {n: dr.Parameter("s", **POSITIVE, **bounds.get(n, {})) for n in ("actuator", "plant")}
    return dr.Model(
        "two lags",
        {},
        {"u": "V"},
        {**seconds, "gain": dr.Parameter("1", **POSITIVE)},
        lambda q, v, a, u, p: [p.actuator * a.x + v.x - p.gain * u.u, p.plant * a.y + v.y - v.x],
        first_order={"x": "V", "y": "V"},
    )


def motor():
    """A motor whose current nothing measures; the constant of the motor is known."""
    return dr.Model(
        "motor",
        {},
        {"u": "V"},
        {"L": dr.Parameter("H", **POSITIVE), "J": dr.Parameter("kg m^2", **POSITIVE), "b": dr.Parameter("N m s/rad")},
        lambda q, v, a, u, p: [p.L * a.i + v.i + 0.05 * v.w - u.u, p.J * a.w + p.b * v.w - 0.05 * v.i],
        first_order={"i": "A", "w": "rad/s"},
    )


def squared():
    """A lag before a pendulum: gravity tells the lag from the damping."""
    return dr.Model(
        "lagged pendulum",
        {"q": "rad"},
        {"u": "N m"},
        {"lag": dr.Parameter("s", **POSITIVE), "damping": dr.Parameter("1/s", **POSITIVE)},
        lambda q, v, a, u, p: [a.q + p.damping * v.q * abs(v.q) - v.torque, p.lag * a.torque + v.torque - u.u],
        first_order={"torque": "N m"},
    )


def test_two_lags_change_places():
    model = two_lags()
    for lags in ([0.08, 0.4], [0.4, 0.08]):
        (other,) = equivalent_parameters(model, np.array([*lags, 1.5]), ["y"])
        assert other == pytest.approx([*lags[::-1], 1.5], rel=1e-6)


def test_poles_of_a_motor_have_another_inductance_and_inertia():
    """``L J s^2 + (L b + J) s + b + K^2``: product and sum are those of two pairs."""
    L, J, b = 0.05, 2e-4, 2e-3
    (other,) = equivalent_parameters(motor(), np.array([L, J, b]), ["w"])
    assert other == pytest.approx([J / b, L * b, b], rel=1e-6)


@pytest.mark.parametrize(
    ("model", "parameters", "measured"),
    [
        (squared(), [0.2, 0.7], ["q"]),
        (two_lags(), [0.08, 0.4, 1.5], ["x", "y"]),
        (dr.models.flexible_joint(), [0.02, 0.05, 12.0, 0.05, 0.03, 0.02], ["motor"]),
    ],
)
def test_parameters_that_signals_determine_have_no_equivalents(model, parameters, measured):
    assert not structural(model, tuple(measured))
    assert not equivalent_parameters(model, np.array(parameters), measured)


def recorded(n=1500, dt=0.01, friction=0.0):
    """A log of two lags, ``u`` held, and perhaps of a friction that the model lacks."""
    rng = np.random.default_rng(0)
    u, x, y = np.repeat(rng.uniform(-1.0, 1.0, n // 25), 25), 0.0, 0.0
    slow, fast, rows = 0.4, 0.08, []
    for value in u:
        rows.append(y)
        for _ in range(20):
            h = dt / 20
            x, y = x + h * (1.5 * value - x) / slow, y + h * (x - y - friction * np.tanh(50.0 * y)) / fast
    return dr.Log.from_arrays(np.arange(n) * dt, {"y": np.array(rows) + 0.003 * rng.standard_normal(n), "u": u})


def test_a_result_that_another_one_equals_is_not_to_be_relied_on():
    log = recorded()
    found = dr.identify(two_lags(), log, differentiate=True)
    lags = sorted(found.parameters[n] for n in ("actuator", "plant"))
    assert lags == pytest.approx([0.08, 0.4], rel=0.02)
    (said,) = [x for x in found.findings if "explain this log as well" in x]
    assert said.level == "bad"
    assert found.verdict == "do not rely on this"
    bounded = dr.identify(two_lags(plant={"upper": 0.2}), log, differentiate=True)
    assert not [x for x in bounded.findings if "explain this log as well" in x]
    assert bounded.parameters["actuator"] == pytest.approx(0.4, rel=0.02)
    assert bounded.parameters["plant"] == pytest.approx(0.08, rel=0.02)


def test_a_model_that_lacks_a_term_does_not_tell_equal_responses_apart():
    """Unmodelled forces decide between two fits, but not on the machine: predictions are those of both."""
    found = dr.identify(two_lags(), recorded(friction=0.05), differentiate=True)
    (said,) = [x for x in found.findings if "may explain this log as well" in x]
    assert said.level == "bad"
    assert found.parameters["actuator"] == pytest.approx(0.4, rel=0.05)
    assert found.parameters["plant"] == pytest.approx(0.08, rel=0.05)
    assert f"actuator = {found.parameters['plant']:.4g}, plant = {found.parameters['actuator']:.4g} may" in said
