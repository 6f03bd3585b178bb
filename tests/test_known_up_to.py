"""Parameters that are known up to a factor: units of states that nothing measures, and limits that never act."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import diransac as dr

TRUTH = {"k1": 0.12, "k2": 0.05, "k3": 0.06, "k4": 0.3}


def tanks(*, read: bool = False) -> dr.Model:
    """Two tanks in a cascade; a sensor may read the upper level."""
    return dr.Model(
        name="tanks",
        coordinates={},
        first_order={"h1": "V", "h2": "V"},
        inputs={"pump": "V"},
        parameters={name: dr.Parameter(positive=True) for name in TRUTH},
        equations=lambda q, v, a, u, p: [
            a.h1 + p.k1 * ca.sqrt(ca.fmax(v.h1, 1e-3)) - p.k4 * u.pump,
            a.h2 - p.k2 * ca.sqrt(ca.fmax(v.h1, 1e-3)) + p.k3 * ca.sqrt(ca.fmax(v.h2, 1e-3)),
        ],
        sensors={"float": dr.Sensor("V", lambda q, v, a, u, p: 2.0 * v.h1)} if read else {},
    )


def record(n: int = 900, dt: float = 2.0) -> dr.Log:
    """Levels by Euler steps of a fortieth of a sample; the lower one and a float in the upper tank are measured."""
    rng, steps = np.random.default_rng(3), 40
    pump = np.repeat(rng.uniform(1.0, 4.0, n // 15), 15)
    h1, h2, found = 40.0, 8.0, np.empty((n, 2))
    for k in range(n):
        found[k] = h1, h2
        for _ in range(steps):
            root = np.sqrt(h1)
            h1, h2 = (
                h1 + dt / steps * (TRUTH["k4"] * pump[k] - TRUTH["k1"] * root),
                h2 + dt / steps * (TRUTH["k2"] * root - TRUTH["k3"] * np.sqrt(h2)),
            )
    noise = 5e-3 * rng.standard_normal((2, n))
    columns = {"h2": found[:, 1] + noise[0], "float": 2.0 * found[:, 0] + noise[1], "pump": pump}
    return dr.Log.from_arrays(dt * np.arange(n), columns)


@pytest.fixture(scope="module")
def unread() -> dr.Result:
    log = record()
    return dr.identify(tanks(), dr.Log.from_arrays(log.time, {n: log[n] for n in ("h2", "pump")}))


def test_parameters_in_the_unit_of_an_unmeasured_state_are_known_up_to_a_factor(unread: dr.Result) -> None:
    ((names, sentence),) = unread.known_up_to
    assert names == ("k1", "k2", "k4")
    assert "nothing measures h1" in sentence
    assert "k1 as c^0.5, k2 as c^−0.5 where k4 changes by c" in sentence
    assert all(not np.isfinite(unread.intervals()[n]).any() for n in names)
    assert np.isfinite(unread.intervals()["k3"]).all()


def test_what_does_not_depend_on_the_unit_is_right(unread: dr.Result) -> None:
    """``k3``, and the products in which the unit cancels: ``k1 k2`` and ``k2^2 k4``."""
    p = unread.parameters
    assert p["k3"] == pytest.approx(TRUTH["k3"], rel=0.05)
    assert p["k1"] * p["k2"] == pytest.approx(TRUTH["k1"] * TRUTH["k2"], rel=0.05)
    assert p["k2"] ** 2 * p["k4"] == pytest.approx(TRUTH["k2"] ** 2 * TRUTH["k4"], rel=0.05)


def test_known_up_to_is_stored(unread: dr.Result, tmp_path) -> None:
    unread.save(tmp_path / "model.json")
    assert dr.Result.load(tmp_path / "model.json").known_up_to == unread.known_up_to


def test_a_sensor_that_reads_the_state_fixes_its_unit() -> None:
    found = dr.identify(tanks(read=True), record())
    assert found.known_up_to == []
    for name, value in TRUTH.items():
        assert found.parameters[name] == pytest.approx(value, rel=0.05)


def test_a_fixed_parameter_fixes_the_unit() -> None:
    log = record()
    two = dr.Log.from_arrays(log.time, {n: log[n] for n in ("h2", "pump")})
    found = dr.identify(tanks(), two, fixed={"k4": TRUTH["k4"]})
    assert found.known_up_to == []
    for name, value in TRUTH.items():
        assert found.parameters[name] == pytest.approx(value, rel=0.05)


def test_a_limit_that_never_acts_is_not_identifiable() -> None:
    model = dr.Model(
        name="limited",
        coordinates={"x": "m"},
        inputs={"f": "N"},
        parameters={"m": dr.Parameter("kg", positive=True), "top": dr.Parameter("N", positive=True)},
        equations=lambda q, v, a, u, p: [p.m * a.x + 2.0 * v.x - ca.fmin(u.f, p.top)],
    )
    t, rng = 0.01 * np.arange(1500), np.random.default_rng(0)
    f = np.sin(2.0 * t) + 0.5 * np.sin(5.3 * t)
    x, v, found = 0.0, 0.0, []
    for force in f:
        found.append(x)
        for _ in range(10):
            x, v = x + 1e-3 * v, v + 1e-3 * (force - 2.0 * v) / 0.7
    result = dr.identify(
        model, dr.Log.from_arrays(t, {"x": np.array(found) + 1e-4 * rng.standard_normal(1500), "f": f})
    )
    assert result.unidentifiable == ("top",)
    assert result.parameters["m"] == pytest.approx(0.7, rel=0.02)
