"""Every CSV file that a command writes: its first line is the header, other tools read it, and logs read back."""

import csv
import json
from contextlib import chdir
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import polars as pl
import pytest

import diransac as dr
from command_line import MODEL, QUICK, run, working_folder
from diransac.cli.commands import _MODULES
from diransac.data.files import place_of_metadata
from studies import TINY_TOML

LOGS = {
    "simulate": ["simulate", "square", "--outliers", "0.1", "--magnitude", "20", "-o", "out.csv"],
    "simulate, packed": ["simulate", "square", "-o", "out.csv.gz"],
    "fly": ["fly", "rotor.json", "--trajectory", "square", "-o", "out.csv"],
    "predict": ["predict", "swim.json", "swim.csv", "-o", "out.csv"],
    "design": ["design", "swim.json", "--limit", "x=-3:3", "--limit", "thrust=80", "--duration", "4", "-o", "out.csv"],
}
TABLES = {
    "track": ["track", "swim.csv", "--model", "swim.json", "--window", "1", "-o", "out.csv"],
    "study export": ["study", "export", "a.db", "--to", "csv", "-o", "out.csv"],
    "fleet export": ["fleet", "export", "fleet.db", "-o", "out.csv"],
}
OTHERS = {
    *("identify", "compare", "validate", "cross-validate", "inspect", "map", "export", "models", "cache", "view"),
    "studio",
}
"""Commands that write no CSV."""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with results and stores."""
    folder = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patched:
        working_folder(folder, patched)
        run("identify", "swim.csv", *MODEL, "--method", "ols", "-o", "swim.json")
        run("simulate", "square", "-o", "rotor.csv")
        run("identify", "rotor.csv", "--model", "planar-rotorcraft", "--method", "ols", "-o", "rotor.json")
        Path("tiny.toml").write_text(TINY_TOML)
        run("study", "run", "tiny.toml", "--store", "a.db", "--trials", "1", "--methods", "ols", "--jobs", "1")
        run("identify", "swim.csv", *MODEL, *QUICK, "--each", "--store", "fleet.db", "--jobs", "1")
    return folder


@pytest.fixture(scope="module")
def path_of(made):
    """Function that returns the file of a case, which is written once."""

    @cache
    def path(case):
        *words, name = {**LOGS, **TABLES}[case]
        file = made / f"{case.replace(' ', '-')}-{name}"
        with chdir(made):
            done = run(*words, file)
        assert done.exit_code == 0, done.stderr
        return file

    return path


def test_every_command_is_among_those_that_are_run():
    assert {words[0] for words in (*LOGS.values(), *TABLES.values())} | OTHERS == set(_MODULES)


def first_line(path: Path) -> list[str]:
    opened = pd.io.common.get_handle(path, "r", compression="infer")
    with opened as file:
        return next(csv.reader([file.handle.readline()]))


@pytest.mark.parametrize("case", [*LOGS, *TABLES])
def test_the_first_line_is_the_header_for_every_reader(path_of, case):
    path = path_of(case)
    header = first_line(path)
    assert all(header)
    assert not header[0].startswith("#")
    assert list(pd.read_csv(path).columns) == header
    assert pl.read_csv(path, infer_schema_length=None).columns == header
    assert len(pd.read_csv(path)) == len(pl.read_csv(path, infer_schema_length=None)) > 0


@pytest.mark.parametrize("case", LOGS)
def test_bits_units_and_history_of_a_log_read_back(path_of, case, tmp_path):
    path = path_of(case)
    log = dr.read_log(path)
    exact = pd.read_csv(path, dtype=str).map(float)
    fast = pl.read_csv(path, infer_schema_length=None)
    for name in log.names:
        np.testing.assert_array_equal(log[name], exact[name])
        np.testing.assert_array_equal(log[name], fast[name].cast(pl.Float64).fill_null(np.nan).to_numpy())
    np.testing.assert_array_equal(log.time, exact["t"])
    again = tmp_path / path.name
    log.write(again)
    second = dr.read_log(again)
    assert (second.units, second.history, second.notes, second.filter) == (
        log.units,
        log.history,
        log.notes,
        log.filter,
    )
    for name in ("t", *log.names):
        assert second[name].tobytes() == log[name].tobytes(), name
    assert set(log.units) >= {name for name in log.names if "thrust" in name or name == "x"}
    described = json.loads(place_of_metadata(path).read_text())
    assert [x["titles"] for x in described["tableSchema"]["columns"]] == first_line(path)


def test_odd_numbers_keep_their_bits(tmp_path):
    values = np.array([0.1, -0.0, 5e-324, 1.7976931348623157e308, np.nan, 1.0 / 3.0, 2.0**53 + 2.0])
    log = dr.Log.from_arrays(0.1 * np.arange(7), {"x": values, "a,b": values, 'c "d"': values}, {"x": "m"})
    log.write(tmp_path / "a.csv")
    again = dr.read_log(tmp_path / "a.csv")
    for name in log.names:
        assert again[name].tobytes() == log[name].tobytes()
    assert list(pd.read_csv(tmp_path / "a.csv").columns) == ["t", "x", "a,b", 'c "d"']
