"""A log as recorders write it needs no option: ms, mm and degrees in its header, jitter, lost rows, outliers."""

import json
from pathlib import Path

import numpy as np
import pytest

from command_line import run

TRUTH = {"cart_mass": 1.2, "pole_mass": 0.3, "friction": 0.8, "damping": 0.004}
LENGTH, GRAVITY, STIFFNESS = 0.4, 9.81, 20.0
DT = 0.01
MODEL = """
from casadi import cos, sin

import diransac as dr

L, g = 0.4, 9.81


def equations(q, v, a, u, p):
    return [
        (p.cart_mass + p.pole_mass) * a.x + p.friction * v.x + 20.0 * q.x - u.force
        + p.pole_mass * L * (cos(q.angle) * a.angle - v.angle**2 * sin(q.angle)),
        p.pole_mass * L * (cos(q.angle) * a.x + L * a.angle + g * sin(q.angle)) + p.damping * v.angle,
    ]


model = dr.Model(
    name="crane",
    coordinates={"x": "m", "angle": "rad"},
    inputs={"force": "N"},
    parameters={
        "cart_mass": dr.Parameter("kg", positive=True),
        "pole_mass": dr.Parameter("kg", positive=True),
        "friction": dr.Parameter("N s/m", lower=0.0),
        "damping": dr.Parameter("N m s/rad", lower=0.0),
    },
    equations=equations,
)
"""


def rates(state, force):
    x, angle, v, w = state
    m, coupling = TRUTH["pole_mass"], TRUTH["pole_mass"] * LENGTH * np.cos(angle)
    swing = m * LENGTH * w * w * np.sin(angle)
    matrix = np.array([[TRUTH["cart_mass"] + m, coupling], [coupling, m * LENGTH**2]])
    forces = np.array(
        [
            force + swing - TRUTH["friction"] * v - STIFFNESS * x,
            -m * GRAVITY * LENGTH * np.sin(angle) - TRUTH["damping"] * w,
        ]
    )
    return np.concatenate([[v, w], np.linalg.solve(matrix, forces)])


def motion(force, substeps=4):
    """States ``(N, 4)`` by Runge-Kutta steps, from rest."""
    states, h = np.zeros((len(force), 4)), DT / substeps
    for k in range(len(force) - 1):
        s = states[k]
        for _ in range(substeps):
            k1 = rates(s, force[k])
            k2 = rates(s + 0.5 * h * k1, force[k])
            k3 = rates(s + 0.5 * h * k2, force[k])
            s = s + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rates(s + h * k3, force[k]))
        states[k + 1] = s
    return states


def write_log(path: Path, seed: int, n: int = 3000, lost: int = 12, outliers: float = 0.02, jitter: float = 0.3e-3):
    """A log with a header ``time [ms],x [mm],angle [deg],force [N]``, and the faults of a recorder."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(n)
    frequencies = np.array([0.3, 0.55, 0.9, 1.3, 1.9, 2.6])
    phases = 2.0 * np.pi * frequencies * t[:, None] + rng.uniform(0.0, 2.0 * np.pi, 6)
    force = np.sin(phases) @ np.array([2.0, 2.0, 1.5, 1.5, 1.2, 1.0])
    states = motion(force)
    x, angle = states[:, 0] + rng.normal(0.0, 2e-4, n), states[:, 1] + rng.normal(0.0, 1.5e-3, n)
    for signal, size in ((x, 0.3), (angle, 1.5)):
        hit = rng.random(n) < outliers
        signal[hit] += rng.uniform(-size, size, int(hit.sum()))
    stamps = 1e3 * (t + rng.uniform(-jitter, jitter, n))
    kept = np.delete(np.arange(n), rng.choice(np.arange(5, n - 5), lost, replace=False))
    columns = np.column_stack([stamps, 1e3 * x, np.rad2deg(angle), force])[kept]
    np.savetxt(path, columns, "%.8g", ",", header="time [ms],x [mm],angle [deg],force [N]", comments="")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("model.py").write_text(MODEL)
    return tmp_path


def test_a_log_as_it_was_recorded_needs_no_option(folder):
    for name, seed in (("log.csv", 1), ("other.csv", 2)):
        write_log(folder / name, seed)
    found = json.loads(run("identify", "log.csv", "--model", "model.py", "--json", "-o", "result.json").stdout)
    assert found["verdict"] == "usable"
    for name, value in TRUTH.items():
        assert found["parameters"][name] == pytest.approx(value, rel=0.01), name
    for log in ("log.csv", "other.csv"):
        validated = json.loads(run("validate", "result.json", log, "--json").stdout)
        assert validated["verdict"] == "usable", log
        assert set(validated["rmse"]) == {"x", "angle"}
        assert all(fraction < 0.08 for fraction in validated["outlier_fraction"].values())


@pytest.mark.parametrize("options", [["--differentiate"], ["--map", "t=time"], ["--scale", "t=0.001"]])
def test_options_of_earlier_versions_change_nothing(folder, options):
    write_log(folder / "log.csv", 1, n=1000, lost=4)
    run("identify", "log.csv", "--model", "model.py", "-o", "result.json")
    run("identify", "log.csv", "--model", "model.py", *options, "-o", "same.json")
    result, same = (json.loads(Path(name).read_text()) for name in ("result.json", "same.json"))
    assert result["parameters"] == same["parameters"]
    with_options = json.loads(run("validate", "result.json", "log.csv", *options, "--json").stdout)
    assert with_options["rmse"] == json.loads(run("validate", "result.json", "log.csv", "--json").stdout)["rmse"]


@pytest.mark.slow
def test_pairs_of_faulty_logs_are_usable(folder):
    """Of twenty pairs with 2 to 10 % outliers, gaps and jitter, all but one at most are usable on both logs."""
    usable = 0
    for seed in range(20):
        faults = {
            "outliers": (0.02, 0.05, 0.1)[seed % 3],
            "lost": (12, 60)[seed % 2],
            "jitter": (0.3e-3, 2e-3)[seed % 2],
        }
        for name, own in (("log.csv", 2 * seed), ("other.csv", 2 * seed + 1)):
            write_log(folder / name, 100 + own, **faults)
        run("identify", "log.csv", "--model", "model.py", "-o", "result.json")
        validations = (run("validate", "result.json", log, "--json").stdout for log in ("log.csv", "other.csv"))
        usable += all(json.loads(text)["verdict"] == "usable" for text in validations)
    assert usable >= 19
