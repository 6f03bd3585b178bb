"""Support for tests of studies: a study that takes a second, and the comparison of rows."""

import copy
import os
import sqlite3
import sys
from pathlib import Path

from diransac.study import load
from diransac.study.store import Store
from diransac.study.tables import changed

TINY = {
    "name": "tiny",
    "description": "as small as can be",
    "trials": 2,
    "seed": 7,
    "plant": {"kind": "planar-rotorcraft"},
    "data": {"trajectory": "square"},
    "noise": {"outlier_probability": 0.1},
    "methods": {
        "true": {},
        "ols": {"preset": "table-iv"},
        "quick": {"method": "i-diransac", "preset": "table-iv", "settings": {"max_iterations": 20, "sample_size": 30}},
    },
    "evaluation": {"trajectories": ["square"]},
    "axis": {"name": "outlier magnitude", "path": "noise.outlier_magnitude", "levels": [0, 40]},
}
TINY_TOML = """
name = "tiny"
trials = 2
[plant]
kind = "planar-rotorcraft"
[data]
trajectory = "square"
[noise]
outlier_probability = 0.1
[methods.true]
[methods.ols]
[evaluation]
trajectories = ["square"]
[axis]
path = "noise.outlier_magnitude"
levels = [0, 40]
"""
OWN_PLANT = """
import diransac as dr

parameters = {"M": dr.Parameter("kg", positive=True), "m": dr.Parameter("N s/m")}
model = dr.Model("sledge", {"s": "m"}, {"force": "N"}, parameters,
                 lambda q, v, a, u, p: [p.M * a.s + p.m * v.s - u.force])

def plant(pull=0.0, M=1.0):
    hook = dr.Disturbance(model, "hook", forces=lambda q, v, u, p, d: {"s": d.pull}, constants={"pull": pull})
    return dr.Plant(model, {"M": M, "m": 0.5}, (hook,))
"""
"""A user's file, with parameters that differ in case alone."""

OWN = {
    "name": "own",
    "trials": 2,
    "plant": {"kind": "own.py"},
    "data": {"trajectory": "multisine", "duration": 2.0},
    "methods": {"ols": {}},
    "evaluation": {"trajectories": [], "parameters": True},
    "axis": {"levels": {"calm": {}, "pulled": {"plant.pull": 2.0, "plant.M": 1.5}}},
}
"""A study of it."""

MAY_DIFFER = ("seconds", "host")


def tiny(**changes: object) -> dict:
    """The study with other values at dotted paths, written with __ for the dots."""
    return changed(copy.deepcopy(TINY), {path.replace("__", "."): value for path, value in changes.items()})


def rows(store: Path) -> dict[tuple, dict]:
    """Every row by level, trial and method, without what may differ, read past the package."""
    connection = sqlite3.connect(store)
    connection.row_factory = sqlite3.Row
    found = [dict(row) for row in connection.execute("SELECT * FROM trials")]
    connection.close()
    kept = [{name: value for name, value in row.items() if name not in MAY_DIFFER} for row in found]
    by_key = {(row["level"], row["trial"], row["method"]): row for row in kept}
    assert len(by_key) == len(found)
    return by_key


def command(store: Path, jobs: int | None) -> dict:
    """Arguments of `subprocess.Popen` for a process that runs the study and prints its number of rows, line by line.

    The trials run in that many processes of its own; None: in a thread of it.
    """
    where = "executor=ThreadPoolExecutor(1)" if jobs is None else f"jobs={jobs}"
    script = store.parent / "runner.py"
    script.write_text(f"""
from concurrent.futures import ThreadPoolExecutor
import diransac as dr

def progress(done, asked):
    print(done, asked, flush=True)

if __name__ == "__main__":
    dr.run_study({TINY!r}, store={str(store)!r}, {where}, batch_size=1, progress=progress)
""")
    return {"args": [sys.executable, str(script)]}


SECONDS = {"record": 0.5, "identify": 0.25, "plan": 0.0, "steer": 0.0, "fly": 0.0}


def row(level="0", trial=0, method="ols", **more):
    """A row as workers send it."""
    fixed = {"level": level, "trial": trial, "method": method, "status": "done", "error": None, "seed": 3}
    return {**fixed, "versions": "made up", "seconds": SECONDS, "host": "here", **more}


def write_rows(path: Path, first: int) -> None:
    """Keep made-up rows of 60 trials of two methods, trial by trial."""
    with Store(path, load(tiny(trials=400))) as kept:
        for trial in range(first, first + 60):
            kept.add([row(trial=trial, host=str(os.getpid())), row(trial=trial, method="true")])
