"""What the tests of the command line share: a command that runs, a log, model files."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

import diransac as dr
from diransac.cli.commands import app

TRUE = {"mass": 50.0, "linear_drag": 12.0, "quadratic_drag": 30.0, "bias": 2.0}
MODEL = ["--model", "underwater-vehicle"]
# A search that takes a few milliseconds.
QUICK = ["--set", "max_iterations=20", "--set", "sample_size=20"]
NONLINEAR = """
from casadi import exp
from diransac import Model, Parameter
model = Model(
    name="bent", coordinates={"x": "m"}, inputs={"thrust": "N"},
    parameters={"mass": Parameter("kg", positive=True), "rate": Parameter("1")},
    equations=lambda q, v, a, u, p: [p.mass * a.x + exp(p.rate * v.x) - u.thrust],
)
other = 3
def make():
    return model
"""
HOVER = """
from diransac import Model, Parameter
model = Model(
    name="hover", coordinates={"x": "m"}, inputs={"thrust": "N"}, parameters={"mass": Parameter("kg", positive=True)},
    equations=lambda q, v, a, u, p: [p.mass * (a.x + 9.81) - u.thrust],
)
"""


def run(*words: object) -> Result:
    """Run a command line; an error that nobody foresaw fails the test."""
    done = CliRunner().invoke(app, [str(word) for word in words], prog_name="diransac", catch_exceptions=False)
    assert done.exit_code == 0 or len(done.stderr.splitlines()) <= 3, done.stderr
    return done


def swim(t: np.ndarray, frequency: float = 1.3) -> dict[str, np.ndarray]:
    """A vehicle that is made to follow x' = sin(w t): the thrust follows from the equation of motion."""
    x_dot, x_ddot = np.sin(frequency * t), frequency * np.cos(frequency * t)
    drag = TRUE["linear_drag"] * x_dot + TRUE["quadratic_drag"] * np.abs(x_dot) * x_dot
    thrust = TRUE["mass"] * x_ddot + drag + TRUE["bias"]
    return {"x": (1.0 - np.cos(frequency * t)) / frequency, "x_dot": x_dot, "x_ddot": x_ddot, "thrust": thrust}


def working_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder as working directory, with ``swim.csv`` and the model file ``bent.py``."""
    monkeypatch.chdir(folder)
    dr.Log.from_arrays(np.arange(600) * 0.01, swim(np.arange(600) * 0.01)).write("swim.csv")
    (folder / "bent.py").write_text(NONLINEAR)
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
