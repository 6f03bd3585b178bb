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
    """The first two pairs of `benchmarks/faulty_pairs.py`, with 2 to 10 % outliers, gaps and jitter."""
    for seed in range(2):
        write_pair(folder, seed)
        run("identify", "log.csv", "--model", "model.py", "-o", "result.json")
        for log in ("log.csv", "other.csv"):
            validated = json.loads(run("validate", "result.json", log, "--json").stdout)
            assert validated["verdict"] == "usable", (seed, log)
