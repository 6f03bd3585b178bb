"""Stretches in which a model does not hold: found, left out, and not seen where there are none."""

import casadi as ca
import numpy as np
import pytest

import diransac as dr
from command_line import run
from diransac.errors import LogError, SettingsError

MODEL = dr.Model(
    name="pushed-arm",
    coordinates={"q": "rad"},
    inputs={"torque": "N m"},
    parameters={
        "inertia": dr.Parameter("kg m^2", positive=True),
        "viscous": dr.Parameter("N m s/rad", lower=0),
        "weight": dr.Parameter("N m"),
    },
    equations=lambda q, v, a, u, p: [p.inertia * a.q + p.viscous * v.q + p.weight * ca.sin(q.q) - u.torque],
)
TRUTH = {"inertia": 0.05, "viscous": 0.08, "weight": 0.4}
HELD = ((3.0, 4.2), (11.0, 11.9))


def arm(held, seed=0):
    """Log of an arm that somebody holds in some stretches, with a slight unmodelled force and noise."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 16.0, 0.01)
    torque = 0.5 * np.sin(2.1 * t + seed) + 0.35 * np.sin(5.3 * t) + 0.2 * np.sin(0.7 * t)
    draught = 0.005 * np.sin(0.9 * t + seed)
    q, v = np.zeros((2, len(t)))
    for k in range(len(t) - 1):
        q[k + 1], v[k + 1] = q[k], v[k]
        grasped = any(start <= t[k] < stop for start, stop in held)
        for _ in range(20):
            hand = 6.0 * (0.5 - q[k + 1]) - 0.5 * v[k + 1] if grasped else 0.0
            force = torque[k] + draught[k] + hand - TRUTH["viscous"] * v[k + 1] - TRUTH["weight"] * np.sin(q[k + 1])
            v[k + 1] += 0.0005 * force / TRUTH["inertia"]
            q[k + 1] += 0.0005 * v[k + 1]
    return dr.Log.from_arrays(t, {"q": q + rng.normal(0.0, 5e-4, len(t)), "torque": torque})


def said(result):
    return [str(finding) for finding in result.findings if "does not hold" in finding]


def worst(result):
    return max(abs(result.parameters[name] / TRUTH[name] - 1.0) for name in TRUTH)


def test_an_arm_in_the_hand_is_found_and_right_once_that_is_left_out(tmp_path):
    log = arm(HELD)
    first = dr.identify(MODEL, log, differentiate=True)
    (finding,) = said(first)
    option = finding.split("--leave-out=")[1].rstrip(".")
    found = [tuple(map(float, part.split(":"))) for part in option.split(",")]
    assert len(found) == len(HELD)
    np.testing.assert_allclose(found, HELD, atol=0.35)
    page = tmp_path / "arm.html"
    dr.write_report(first, log, page)
    assert 'class="swatch departed"></span>the model does not hold' in page.read_text()
    assert page.read_text().count('class="band departed" d="M') >= 2
    log.write(tmp_path / "arm.csv")
    rest = dr.leave_out(log, found)
    second = dr.identify(MODEL, rest, differentiate=True)
    assert not said(second)
    assert worst(second) < 0.005
    done = run("inspect", tmp_path / "arm.csv", f"--leave-out={option}")
    assert "rows are left out, as asked" in done.stdout


def test_an_arm_that_nobody_holds_has_no_such_finding():
    assert not said(dr.identify(MODEL, arm((), 1), differentiate=True))


def test_a_stretch_is_left_out_with_its_extent():
    log = dr.Log.from_arrays(np.arange(10) / 10.0, {"q": np.arange(10.0)})
    kept = dr.leave_out(log, [(-1.0, 0.15), (0.4, 0.5)])
    np.testing.assert_array_equal(kept["q"], [2.0, 3.0, np.nan, np.nan, 6.0, 7.0, 8.0, 9.0])
    assert kept.history[-1] == {"step": "leave_out", "left_out": [[0.0, 0.1], [0.4, 0.5]]}
    assert kept.notes == ("4 of 10 rows are left out, as asked: 0 to 0.1 s, 0.4 to 0.5 s",)
    with pytest.raises(SettingsError, match="give START:END"):
        dr.leave_out(log, [(0.5, 0.4)])
    with pytest.raises(LogError, match="all but 0 are to be left out"):
        dr.leave_out(log, [(0.0, 1.0)])


def test_a_stretch_that_is_none_is_refused(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t,q\n0,1\n1,2\n2,3\n")
    done = run("inspect", path, "--leave-out", "3")
    assert done.exit_code == 2
    assert "'3' is no stretch; give START:END in seconds" in done.output.replace("\n", " ").replace("│ ", "")
