"""``diransac inspect``: what it says of a log, and of a log for a model."""

import json
from pathlib import Path

import numpy as np
import pytest

import diransac as dr
from command_line import HOVER, MODEL, TRUE, run, swim, working_folder


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return working_folder(tmp_path, monkeypatch)


def test_inspect_finds_what_was_planted(folder: Path):
    t = np.arange(600) * 0.01
    log = swim(t)
    log["x"][100:105] = np.nan
    log["x_dot"][200:250] = log["x_dot"][200]
    log["thrust"][[300, 400]] = 1e4
    dr.Log.from_arrays(t, log, units={"thrust": "N"}).write("odd.csv")
    found = json.loads(run("inspect", "odd.csv", "--json").stdout)
    signals = found["signals"]
    assert found["rate"] == pytest.approx(100.0)
    assert found["duration"] == pytest.approx(5.99)
    assert signals["x"]["n_missing"] == 5
    assert signals["x_dot"]["frozen"] == pytest.approx(0.5)
    assert signals["thrust"]["n_spikes"] == 2
    assert signals["x_ddot"]["n_spikes"] == signals["x_ddot"]["n_missing"] == 0
    assert signals["x_ddot"]["maximum"] == pytest.approx(1.3, abs=1e-3)
    text = run("inspect", "odd.csv").stdout.splitlines()
    assert text[1].split() == ["signal", "unit", "minimum", "maximum", "std", "Hz", "NaN", "spikes", "frozen", "s"]
    assert next(line for line in text if line.startswith("x_dot ")).split()[-1] == "0.5"


def test_inspect_says_what_is_missing_and_what_can_be_derived(folder: Path):
    t = np.arange(600) * 0.01
    log = swim(t)
    dr.Log.from_arrays(t, {"x": log["x"], "force": log["thrust"]}).write("bare.csv")
    bare = json.loads(run("inspect", "bare.csv", *MODEL, "--json").stdout)["fitness"]
    named = json.loads(run("inspect", "bare.csv", *MODEL, "--map", "thrust=force", "--json").stdout)["fitness"]
    assert set(bare["missing"]) == {"x_dot", "x_ddot", "thrust"}
    assert "thrust" not in bare["derivable"]
    assert set(named["missing"]) == set(named["derivable"]) == {"x_dot", "x_ddot"}
    assert "--differentiate" in run("inspect", "bare.csv", *MODEL, "--map", "thrust=force").stdout


def test_inspect_says_which_parameters_the_motion_shows(folder: Path):
    lively = json.loads(run("inspect", "swim.csv", *MODEL, "--json").stdout)["fitness"]
    t = np.arange(600) * 0.01
    steady = {"x": 0.5 * t, "x_dot": np.full_like(t, 0.5), "x_ddot": 0 * t, "thrust": np.full_like(t, 15.5)}
    dr.Log.from_arrays(t, steady).write("steady.csv")
    dull = json.loads(run("inspect", "steady.csv", *MODEL, "--json").stdout)["fitness"]
    assert lively["verdicts"] == dict.fromkeys(TRUE, "well")
    assert lively["excitation"]["mass"]["estimate"] == pytest.approx(TRUE["mass"], rel=1e-6)
    assert set(dull["verdicts"].values()) == {"not"}
    assert "mass" in dull["verdicts"]
    assert "not identifiable" in dull["reason"]


def test_inspect_doubts_an_estimate_from_a_log_with_spikes(folder: Path):
    t = np.arange(600) * 0.01
    log = swim(t)
    log["thrust"][np.random.default_rng(0).choice(600, 60, replace=False)] += 500.0
    dr.Log.from_arrays(t, log).write("spiky.csv")
    spiky = json.loads(run("inspect", "spiky.csv", *MODEL, "--json").stdout)["fitness"]
    clean = json.loads(run("inspect", "swim.csv", *MODEL, "--json").stdout)["fitness"]
    assert "spikes in thrust" in spiky["caveat"]
    assert spiky["caveat"] in run("inspect", "spiky.csv", *MODEL).stdout
    assert clean["caveat"] == ""


def test_inspect_agrees_with_identify_that_nothing_moves(folder: Path):
    Path("hover.py").write_text(HOVER)
    rest = {"x": np.zeros(600), "x_dot": np.zeros(600), "x_ddot": np.zeros(600), "thrust": np.full(600, 9.81)}
    dr.Log.from_arrays(np.arange(600) * 0.01, rest).write("rest.csv")
    fitness = json.loads(run("inspect", "rest.csv", "--model", "hover.py", "--json").stdout)["fitness"]
    refused = run("identify", "rest.csv", "--model", "hover.py", "--method", "ols")
    assert (fitness["excitation"], refused.exit_code) == ({}, 1)
    assert "nothing moves" in fitness["reason"]
    assert "nothing moves" in refused.stderr


def test_inspect_shows_a_log_whose_clock_is_uneven(folder: Path):
    t = np.arange(600) * 0.01
    t[300:] += 1.0
    dr.Log.from_arrays(np.arange(600) * 0.01, swim(t)).write("even.csv")
    rows = Path("even.csv").read_text().splitlines()
    clock = [f"{now!r},{row.split(',', 1)[1]}" for now, row in zip(t.tolist(), rows[1:], strict=True)]
    Path("gap.csv").write_text("\n".join([rows[0], *clock]) + "\n")
    found = json.loads(run("inspect", "gap.csv", "--json").stdout)
    assert run("identify", "gap.csv", *MODEL).exit_code == 0
    assert sum("gap" in note for note in found["notes"]) == 1
    assert found["signals"]["x"]["n_missing"] > 90


def test_inspect_shows_numbers_whose_squares_overflow(folder: Path):
    t = np.arange(600) * 0.01
    dr.Log.from_arrays(t, {"x": 1e200 * np.sin(t), "y": 0 * t, "z": np.sin(t), "w": 1.7e308 * np.cos(t)}).write(
        "huge.csv"
    )
    signals = json.loads(run("inspect", "huge.csv", "--json").stdout)["signals"]
    assert signals["x"]["standard_deviation"] == pytest.approx(1e200 * np.sin(t).std())
    assert signals["w"]["standard_deviation"] == pytest.approx(1.7e308 * np.cos(t).std())
    assert signals["y"]["standard_deviation"] == 0.0
    assert signals["z"]["standard_deviation"] == pytest.approx(np.sin(t).std())
