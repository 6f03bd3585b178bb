"""Prospects of a search, by least squares of all rows of noisy motions of known machines."""

from typing import Any

import numpy as np
import pytest

import diransac as dr
from diransac.data.dataset import Dataset
from diransac.errors import IdentificationError
from diransac.identification.method import Progress
from diransac.identification.regression.rows import motion_rows
from diransac.identification.structure.prospects import Prospects

DT, DAMPING, GAIN = 0.01, 0.8, 1.5


def cart(mass: float | None = 2.0) -> dr.Model:
    """A cart of a known or an unknown mass, pushed by a force in units of its own."""
    masses = {} if mass else {"mass": dr.Parameter("kg", positive=True)}

    def equations(q: Any, v: Any, a: Any, u: Any, p: Any) -> list[Any]:
        gained = p.gain * u.force if mass else u.force
        return [(mass or p.mass) * a.x + p.damping * v.x - gained]

    gains = {"gain": dr.Parameter("1", positive=True)} if mass else {}
    damping = {"damping": dr.Parameter("N s/m", lower=0.0)}
    return dr.Model("cart", {"x": "m"}, {"force": "N"}, masses | damping | gains, equations)


def log_of(sign: float, *, noise: float = 1e-4, size: float = 1.0) -> dr.Log:
    """Positions of the cart, their exact derivatives, and its force in other units, of a sign."""
    t, rng = np.arange(0.0, 20.0, DT), np.random.default_rng(0)
    phases, w = rng.uniform(0.0, 6.0, (5, 1)), np.array([0.7, 1.3, 2.1, 3.4, 5.2])[:, None]
    x, v, a = (
        size * (f(w * t + phases) * w**k).sum(axis=0) for k, f in enumerate((np.sin, np.cos, lambda y: -np.sin(y)))
    )
    force = (2.0 * a + DAMPING * v) / GAIN
    columns = {"x": x, "x_dot": v, "x_ddot": a, "force": sign * force}
    return dr.Log.from_arrays(t, {n: y + noise * rng.standard_normal(len(t)) for n, y in columns.items()})


def prospects(model: dr.Model, log: dr.Log) -> Prospects:
    """Those of the rows of a log."""
    dataset = Dataset.of(model, [log])
    return Prospects(model, dataset.layout, motion_rows(dataset))


def test_a_right_log_has_nothing_to_be_said() -> None:
    found = prospects(cart(), log_of(1.0))
    assert not list(found.sentences())
    assert not found.contradict_bounds


def test_a_reversed_force_is_said_with_the_column_that_its_gain_multiplies() -> None:
    found = prospects(cart(), log_of(-1.0))
    assert found.outside == ["gain"]
    assert found.contradict_bounds
    (sentence,) = found.sentences()
    assert "gain = -1.5" in sentence
    assert "check the signs and units of force, which it multiplies" in sentence


def test_a_parameter_that_the_motion_hardly_shows_is_said_with_its_remedy() -> None:
    sentences = list(prospects(cart(), log_of(1.0, size=1e-3, noise=3e-2)).sentences())
    assert any("hardly excites" in x and "--fix" in x for x in sentences)


def test_a_negative_mass_is_said_to_be_no_simulation() -> None:
    found = prospects(cart(mass=None), log_of(-1.0))
    assert found.impossible_inertia() == 1.0
    assert any("mass matrix that is not positive definite in 100 % of the rows" in x for x in found.sentences())


def test_the_default_method_warns_before_it_searches_and_refuses_at_once() -> None:
    seen = list[Progress]()
    with pytest.raises(IdentificationError, match=r"gain|force"):
        dr.identify(cart(), log_of(-1.0), progress=seen.append)
    stages = [x.stage for x in seen]
    warned = next(k for k, x in enumerate(seen) if "check the signs and units of force" in x.warning)
    assert warned < stages.index("drawing hypotheses")
    assert "simulation error" not in stages
