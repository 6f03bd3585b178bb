"""examples/, each run as a script, or cell by cell, in an empty folder."""

import json
import runpy
import sys
from pathlib import Path

import pytest

import diransac as dr

EXAMPLES = sorted((Path(__file__).resolve().parents[1] / "examples").glob("*.py"))


@pytest.mark.slow
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.name)
def test_example_runs(example: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The demonstration with two of the methods, which differ by their names alone."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(example)])
    monkeypatch.setattr(dr, "METHODS", ("ols", "lo-diransac"))
    runpy.run_path(str(example), run_name="__main__")


@pytest.mark.slow
def test_notebook_runs_from_its_first_cell_to_its_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    notebook = json.loads((EXAMPLES[0].parent / "first_model.ipynb").read_text())
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {"__name__": "__main__"}
    for k, cell in enumerate(notebook["cells"]):
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"cell {k}", "exec"), namespace)
            assert not cell["outputs"]  # it is kept without them
    assert {x.name for x in tmp_path.iterdir()} == {"report.html", "model.json", "dynamics.c", "dynamics.py"}
