"""Independent parts of a model: equations without a common state or parameter."""

import numpy as np
import pytest

import diransac as dr
from user_models import tumbling


def axes(parameters=("mass_left", "mass_right"), coupling=0.0):
    """Two axes with a mass each, that share an input, and a temperature on the first."""
    left, right = parameters
    return dr.Model(
        "axes",
        coordinates={"left_x": "m", "right_x": "m"},
        first_order={"left_heat": "K"},
        inputs={"force": "N", "power": "W"},
        parameters={n: dr.Parameter("kg", positive=True) for n in dict.fromkeys((left, right))},
        equations=lambda q, v, a, u, p: [
            p[left] * a.left_x + v.left_heat - u.force,
            p[right] * a.right_x - u.force + coupling * q.left_x,
            a.left_heat + v.left_heat * v.left_x - u.power,
        ],
        sensors={
            "scale": dr.Sensor("N", lambda q, v, a, u, p: p[right] * a.right_x + p.zero, {"zero": dr.Parameter("N")})
        },
    )


def test_parts_have_the_equations_and_sensors_of_their_states():
    whole = axes()
    parts = dr.independent_parts(whole)
    assert list(parts) == ["left", "right"]
    left, right = parts.values()
    assert (left.state, right.state) == (("left_x", "left_x_dot", "left_heat"), ("right_x", "right_x_dot"))
    assert (list(left.inputs), list(right.inputs)) == (["force", "power"], ["force"])
    assert (list(left.parameters), list(right.parameters)) == (["mass_left"], ["mass_right", "zero"])
    assert (list(left.sensors), list(right.sensors)) == ([], ["scale"])
    q, v, a, u = np.random.default_rng(0).normal(size=(4, 3))
    together = np.array(whole.residual(q[:2], v, a, u[:2], [2.0, 3.0, 0.1])).ravel()
    of_left = np.array(left.residual(q[0], v[[0, 2]], a[[0, 2]], u[:2], 2.0)).ravel()
    of_right = np.array(right.residual(q[1], v[1], a[1], u[0], [3.0, 0.1])).ravel()
    assert together == pytest.approx([of_left[0], of_right[0], of_left[1]])
    assert float(right.measurement(q[1], v[1], a[1], u[0], [3.0, 0.1])) == pytest.approx(3.0 * a[1] + 0.1)


@pytest.mark.parametrize("joined", [axes(("mass", "mass")), axes(coupling=1.0), tumbling()])
def test_a_model_whose_equations_act_on_each_other_is_one_part(joined):
    assert dr.independent_parts(joined) == {joined.name: joined}
