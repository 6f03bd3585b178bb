"""Ten logs of machines that are simulated here, by the default method without any setting."""

import ast
from pathlib import Path

import pytest

from acceptance.judging import cases_of, failure
from acceptance.machines import MACHINES
from acceptance.records import RECORDS
from acceptance.table import RECORDS as RECORD_ROWS
from acceptance.table import SIMULATED

pytest.importorskip("mujoco", reason="CONTACTS AND ROBOTS NOT CHECKED: mujoco is missing")


@pytest.mark.parametrize(("row", "aspect"), cases_of(SIMULATED))
def test_a_simulated_log_is_answered_as_its_row_says(row, aspect):
    assert not failure(row, aspect)


def test_each_log_has_a_row_and_each_open_aspect_is_one_that_its_row_has():
    assert [row.log for row in SIMULATED] == list(MACHINES)
    assert [row.log for row in RECORD_ROWS] == list(RECORDS)
    assert all(set(row.open) <= set(row.aspects) for row in (*SIMULATED, *RECORD_ROWS))


@pytest.mark.parametrize("file", sorted(Path(__file__).parent.glob("*.py")), ids=lambda file: file.name)
def test_the_package_is_used_as_users_do(file):
    """Nothing of it is imported but ``import diransac as dr``."""
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom):
            assert not (node.module or "").startswith("diransac"), node.module
        if isinstance(node, ast.Import):
            names = {(one.name, one.asname) for one in node.names if one.name.startswith("diransac")}
            assert names <= {("diransac", "dr")}
