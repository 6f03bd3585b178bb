"""The command line as a process of its own: what reaches its stdout and stderr, and nothing else."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import diransac as dr

QUIET_MODEL = """
import numpy as np
from diransac import Model, Parameter
model = Model(
    name="chatty", coordinates={"x": "m"}, inputs={"thrust": "N"},
    parameters={"mass": Parameter("kg", positive=True)},
    equations=lambda q, v, a, u, p: [p.mass * a.x + np.sin(q.x) - u.thrust],
)
"""
CHATTER = """
import atexit, os, subprocess, sys, warnings
print("printed")
sys.stdout.write("left in the buffer")
os.write(1, b"written past Python\\n")
subprocess.run(["echo", "said by a child"])
warnings.warn("careful")
for line in range(20):
    print("a line", file=sys.stderr)
atexit.register(print, "printed at exit")
"""


def run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "diransac", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_what_a_model_file_prints_reaches_neither_stdout_nor_stderr(tmp_path: Path):
    (tmp_path / "chatty.py").write_text(CHATTER + QUIET_MODEL)
    done = run(tmp_path, "models", "chatty.py", "--json")
    assert json.loads(done.stdout)["name"] == "chatty"
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("content", [CHATTER + "1 / 0", CHATTER + QUIET_MODEL])
def test_a_failing_command_says_its_own_lines_alone(tmp_path: Path, content: str):
    (tmp_path / "chatty.py").write_text(content)
    done = run(tmp_path, "identify", "absent.csv", "--model", "chatty.py")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("error: ")
    assert len(done.stderr.splitlines()) == 1


def test_debug_shows_what_a_model_file_prints_on_stderr(tmp_path: Path):
    (tmp_path / "chatty.py").write_text(CHATTER + QUIET_MODEL)
    done = run(tmp_path, "models", "chatty.py", "--json", "--debug")
    assert json.loads(done.stdout)["name"] == "chatty"
    for text in ("printed\n", "left in the buffer", "written past Python", "said by a child", "careful", "a line"):
        assert text in done.stderr


def test_commands_import_no_more_than_they_need(tmp_path: Path):
    """Large libraries take longer to import than a log to be identified, and parts of the package as long."""
    t, model = np.arange(300) * 0.01, dr.models.underwater_vehicle()
    inputs = dr.Log.from_arrays(t, {**dict.fromkeys(model.signals, 0.0 * t), "thrust": 90.0 * np.cos(3.0 * t)})
    plant = dr.Plant(model, dict(zip(model.parameters, (120.0, 20.0, 35.0, 3.0), strict=True)))
    dr.simulate(plant, inputs, initial_state={"x": 0.0, "x_dot": 0.0}).write(tmp_path / "log.csv")
    code = """
import sys
from diransac.cli import main
from diransac.cli.commands import app

def show(modules):
    print("loaded:", *(modules & sys.modules.keys()), file=sys.__stderr__)

def end_of(command):
    try:
        command()
    except SystemExit as end:
        print(end.code, file=sys.__stderr__)

libraries = {"scipy", "polars", "pydantic", "rich"}
unused = {f"diransac.{part}" for part in ("data.mapping", "export", "model.robots", "report")}
others = {f"diransac.{part}" for part in ("cli.commands.stores", "cli.commands.results", "flight", "study")}
rare = {"regression.observers", "regression.nonlinear", "assessment.validation"}
rare = {f"diransac.identification.{part}" for part in rare}
show(libraries | unused | {"diransac.flight.planning", "diransac.identification.methods.lo_diransac", "diransac.study"})
end_of(main)
show(libraries | unused | others | rare)
end_of(lambda: app(["--help"]))
show(unused)
"""
    words = ["identify", "log.csv", "--model", "underwater-vehicle", "--seed", "3"]
    command = [sys.executable, "-c", code, *words]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    said = [line for line in done.stderr.splitlines() if "% after" not in line]  # progress, on a slow machine
    assert said == ["loaded:", "0", "loaded:", "0", "loaded:"]


@pytest.mark.parametrize(("words", "said"), [(["--seed", "x"], "--seed"), (["--from", "now"], "--from"), ([], "LOG")])
def test_wrong_values_of_options_are_named(tmp_path: Path, words: list[str], said: str):
    files = ["log.csv"] if words else []
    done = run(tmp_path, "identify", *files, "--model", "underwater-vehicle", *words)
    assert (done.returncode, done.stdout) == (2, "")
    assert said in done.stderr
