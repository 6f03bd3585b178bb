"""Support for tests of the command line: running a command, a log, model files."""

import io
import json
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

import diransac as dr
from diransac.cli import screen
from diransac.cli.commands import app

TRUE = {"mass": 50.0, "linear_drag": 12.0, "quadratic_drag": 30.0, "bias": 2.0}
MODEL = ["--model", "underwater-vehicle"]
FEW = ["--set", "max_iterations=20", "--set", "sample_size=20"]
"""Settings of a search that takes a few milliseconds, for the methods that draw samples."""

QUICK = ["--method", "i-diransac", *FEW]
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


def run(*words: object, stdin: bytes | None = None) -> Result:
    """Run a command line in this process; an unexpected exception, or a message of more than three lines, fails."""
    texts = [str(word) for word in words]
    done = CliRunner().invoke(app, texts, input=stdin, prog_name="diransac", catch_exceptions=False)
    assert done.exit_code == 0 or len(done.stderr.splitlines()) <= 3, done.stderr
    return done


def run_both(monkeypatch: pytest.MonkeyPatch, *words: object) -> tuple[str, dict[str, Any]]:
    """Text that a command prints, and what it prints with ``--json``, from one run."""
    shown = []
    with monkeypatch.context() as patched:
        patched.setattr("diransac.cli.screen.show", lambda item, as_json: shown.append((item, as_json)))
        done = run(*words)
    assert (done.exit_code, done.stdout, [as_json for _, as_json in shown]) == (0, "", [False]), done.stderr
    text, as_json = (_printed(shown[0][0], as_json) for as_json in (False, True))
    return text, json.loads(as_json)


def _printed(item: screen.Showable, as_json: bool) -> str:
    """What `screen.show` prints."""
    with redirect_stdout(io.StringIO()) as out:
        screen.show(item, as_json)
    return out.getvalue()


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
