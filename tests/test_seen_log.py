"""A log as recorders write it needs no option: ms, mm and degrees in its header, jitter, lost rows, outliers."""

import json
from pathlib import Path

import pytest
from faulty_pairs import MODEL, TRUTH, write_log, write_pair

from command_line import run


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


def test_options_of_earlier_versions_change_nothing(folder):
    write_log(folder / "log.csv", 1, n=1000, lost=4)
    found = []
    for options in ([], ["--differentiate"], ["--map", "t=time"], ["--scale", "t=0.001"]):
        run("identify", "log.csv", "--model", "model.py", *options, "-o", "result.json")
        validated = json.loads(run("validate", "result.json", "log.csv", *options, "--json").stdout)
        found.append((json.loads(Path("result.json").read_text())["parameters"], validated["rmse"]))
    assert found == [found[0]] * 4


@pytest.mark.slow
def test_a_pair_of_faulty_logs_is_usable(folder):
    """The first pair of `benchmarks/faulty_pairs.py`, with 2 to 10 % outliers, gaps and jitter."""
    write_pair(folder, 0)
    run("identify", "log.csv", "--model", "model.py", "-o", "result.json")
    for log in ("log.csv", "other.csv"):
        assert json.loads(run("validate", "result.json", log, "--json").stdout)["verdict"] == "usable", log
