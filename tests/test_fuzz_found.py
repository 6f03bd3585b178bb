"""What the fuzzer has found, each as a test of its own."""

import json
import os
import sqlite3
import struct
from contextlib import closing
from functools import cache
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import diransac as dr
from command_line import run, working_folder
from diransac.data.preprocessing.spikes import hampel
from diransac.plain_data import json_data
from diransac.study import load, status
from diransac.study.reading import read
from diransac.study.store import Store
from fuzzing import listing
from rebuilt import built, log
from studies import OWN, OWN_PLANT, TINY, row, tiny

T = 0.05 * np.arange(40)


@cache
def stored() -> str:
    """JSON of a result of lo-diransac."""
    return json.dumps(dr.identify(built(), log()).to_dict())


def written(path: Path, **columns: np.ndarray) -> Path:
    dr.Log.from_arrays(T, columns or {"x": np.sin(T)}).write(path)
    return path


# Logs -----------------------------------------------------------------------------------------------------------------
def test_polars_prints_nothing_where_it_panics(tmp_path, monkeypatch, capfd):
    path = written(tmp_path / "a.parquet")

    def panics(_):
        os.write(2, b"thread 'x' panicked\nstack backtrace\n")
        raise pl.exceptions.PanicException("assertion failed")

    monkeypatch.setattr(pl, "read_parquet_metadata", panics)
    with pytest.raises(dr.LogError, match=r"the Parquet data are damaged; write the file again$"):
        dr.read_log(path)
    assert capfd.readouterr() == ("", "")


def test_a_signalling_nan_is_a_nan(tmp_path):
    x = np.frombuffer(struct.pack("<I", 0x7F800001) * 40, np.float32)
    np.savez(tmp_path / "a.npz", t=T, x=x)
    assert np.isnan(dr.read_log(tmp_path / "a.npz")["x"]).all()


def test_two_rows_have_no_bandwidth(tmp_path):
    (tmp_path / "a.csv").write_text("t,x,thrust\n0,1,0\n1,2,1\n")
    done = run("inspect", tmp_path / "a.csv", "--model", "underwater-vehicle")
    assert done.exit_code in (0, 1)


def test_a_damaged_time_is_not_filled_with_millions_of_rows(tmp_path):
    time = np.r_[T[:-1], 40_000.0]
    np.savez(tmp_path / "a.npz", t=time, x=T)
    with pytest.raises(dr.LogError, match=r"rows of 40: 4e\+04 s pass after t = 1.9 s \(row 38\); split the log there"):
        dr.read_log(tmp_path / "a.npz", resample="median")


@pytest.mark.parametrize("step", [1e-310, 5e-324, 1e-15])
def test_a_time_that_stands_still_is_refused(tmp_path, step):
    np.savez(tmp_path / "a.npz", t=step * np.arange(40), x=T)
    with pytest.raises(dr.LogError, match="s apart, which no clock resolves; pass --scale"):
        dr.read_log(tmp_path / "a.npz")


def test_a_time_in_another_unit_is_scaled_before_it_is_checked(tmp_path):
    np.savez(tmp_path / "a.npz", t=1e-15 * np.arange(40), x=T)
    assert len(dr.read_log(tmp_path / "a.npz", scale={"t": 1e13})) == 40


def test_spikes_of_enormous_signals_are_no_overflow():
    hampel(np.where(np.arange(40) % 3, 1.5e308, -1.5e308))


@pytest.mark.parametrize("value", ["9" * 5000, "[" * 5000])
def test_endless_numbers_and_nests_of_a_mapping_are_refused_in_words(tmp_path, value):
    (tmp_path / "m.toml").write_text(f"resample = {value}")
    with pytest.raises(dr.LogError, match=r"it is not TOML .*(digits|deeply)"):
        dr.read_log(written(tmp_path / "a.csv"), mapping=tmp_path / "m.toml")


# Results and stores ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("text", ['"\\ud800"', '{"a\\uDfff": 1}', '["\\ude00\\ud800"]'])
def test_half_a_character_is_no_text(text):
    with pytest.raises(ValueError, match="half a character"):
        json_data(text)
    assert json_data('"\\ud83d\\ude00"') == "😀"


def test_a_store_with_a_write_ahead_log_is_refused_and_nothing_is_left_beside_it(tmp_path):
    path = tmp_path / "a.db"
    with Store(path, load(TINY)):
        pass
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("UPDATE asked SET place = place + 1")
        connection.commit()
    before = listing(tmp_path)
    assert before.keys() == {"a.db"}
    for use in (lambda: status(path), lambda: Store(path, load(TINY))):
        with pytest.raises(dr.StudyError, match="write-ahead log, which no study makes; PRAGMA journal_mode = DELETE"):
            use()
    assert listing(tmp_path) == before
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")
    assert "tiny" in str(status(path))


@pytest.mark.parametrize("statement", ["DELETE FROM configuration WHERE part = 'study'", "DELETE FROM trials"])
def test_a_store_without_a_study_or_without_rows_is_no_internal_error(tmp_path, statement):
    with Store(tmp_path / "a.db", load(TINY)):
        pass
    with closing(sqlite3.connect(tmp_path / "a.db")) as connection:
        connection.execute(statement)
        connection.commit()
    assert run("study", "export", tmp_path / "a.db", "--to", "parquet", "-o", tmp_path / "a.parquet").exit_code == 0
    assert pl.read_parquet(tmp_path / "a.parquet").is_empty()
    done = run("study", "plot", tmp_path / "a.db", "-o", tmp_path / "a.svg")
    assert (done.exit_code, "damaged: KeyError" in done.stderr) == (1, "part" in statement), done.stderr


def test_times_without_stages_are_refused(tmp_path):
    with Store(tmp_path / "a.db", load(TINY)) as kept:
        kept.add([row(seconds={})])
    with pytest.raises(dr.StudyError, match=r"is damaged: ValueError: seconds are \{\}"):
        read(tmp_path / "a.db")


def test_a_store_of_the_first_format_is_refused(tmp_path):
    path = tmp_path / "a.db"
    with Store(path, load(TINY)):
        pass
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA user_version = 1")
        connection.commit()
    with pytest.raises(dr.StudyError, match="has format 1, this version reads 3; begin another"):
        status(path)


@pytest.mark.parametrize(
    ("covariance", "hold", "says"),
    [
        ([[1.0, 2.0], [2.0, 1.0]], "zero-order", "covariance: it is that of no distribution"),
        ([[-1.0, 0.0], [0.0, 1.0]], "zero-order", "covariance: it is that of no distribution"),
        ([[1.0, 0.5], [0.1, 1.0]], "zero-order", "covariance: it is that of no distribution"),
        ([[1.0, 0.5], [0.5, 1.0]], "zero-/rder", "hold zero-/rder"),
    ],
)
def test_a_covariance_or_a_hold_that_there_is_none_of_is_refused_on_loading(covariance, hold, says):
    data = dr.identify(built(), log(), "ols").to_dict()
    assert data["resolution"]["hold"] == "zero-order"
    whole = np.diag([1.0, 1.0, 1.0])
    whole[:2, :2] = covariance
    changed = {**data, "covariance": whole.tolist(), "resolution": {**data["resolution"], "hold": hold}}
    with pytest.raises(dr.ResultError, match=says):
        dr.Result.from_dict(changed)


@pytest.mark.parametrize("name", ["own_delays", "own_lags", "gain_drifts"])
def test_timing_of_other_than_the_inputs_is_refused_on_loading(name):
    data = json.loads(json.dumps(dr.identify(built(), log(), "ols").to_dict()))
    data["resolution"]["timing"][name] = [0.1, 0.2]
    with pytest.raises(dr.ResultError, match="timing of other than 1 inputs"):
        dr.Result.from_dict(data)


@pytest.mark.parametrize(("name", "value"), [("delay", 1e308), ("lag", "nan"), ("own_delays", [1e308])])
def test_timing_that_overflows_is_refused_on_loading(name, value):
    data = json.loads(stored())
    data["resolution"]["timing"][name] = value
    with pytest.raises(dr.ResultError, match="timing: it is that of no machine"):
        dr.Result.from_dict(data)


@pytest.mark.parametrize("name", ["unmodelled_time", "smoothed_time", "smoothed_states", "unmodelled_accelerations"])
def test_figures_of_other_than_the_windows_are_refused_on_loading(name):
    data = json.loads(stored())
    found = data["diagnosis"][name]
    (found if isinstance(found, list) else next(iter(found.values()))).pop()
    with pytest.raises(dr.ResultError, match=r"figures of other than \d+ windows"):
        dr.Result.from_dict(data)


@pytest.mark.parametrize("value", [1e200, "nan", "-inf"])
def test_figures_of_windows_that_overflow_are_refused_on_loading(value):
    data = json.loads(stored())
    next(iter(data["diagnosis"]["unmodelled_accelerations"].values()))[3] = value
    with pytest.raises(dr.ResultError, match="figures of windows that no machine has"):
        dr.Result.from_dict(data)


# Robots, plants and settings ------------------------------------------------------------------------------------------
def test_names_of_a_robot_that_are_no_text_are_refused(tmp_path):
    pytest.importorskip("mujoco", reason="NOT CHECKED: mujoco is missing")
    inertial = b'<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    body = b'<body name="a"><joint name="elbow\xff" type="hinge" damping="1"/>' + inertial + b"</body>"
    (tmp_path / "a.xml").write_bytes(b"<mujoco><worldbody>" + body + b"</worldbody></mujoco>")
    with pytest.raises(dr.ModelError, match="cannot be read: 'utf-8' codec"):
        dr.models.robot(tmp_path / "a.xml")


IMPOSSIBLE = [
    ({"plant__parameters": {"mass": -1.0}}, "cannot have mass = -1, which is outside its bounds"),
    ({"plant__parameters": {"inertia": 0.0}}, "cannot have inertia = 0"),
    ({"plant__parameters": {"drag": float("nan")}}, "give a table of numbers"),
    ({"axis": {"path": "plant.parameters.mass", "levels": [0.2, -1]}}, "at level -1, plant: .*cannot have mass = -1"),
    ({"plant": {"kind": "servo-axis", "parameters": {"mass": -1.0}}}, "cannot have mass = -1"),
    ({"plant": {"kind": "extended-rotorcraft", "diameter": 0.0}}, "diameter is 0.0; give one number from 1e-06"),
    ({"plant": {"kind": "extended-rotorcraft", "diameter": [0.1, 0.1]}}, "give one number"),
    ({"plant": {"kind": "extended-rotorcraft", "gravity": -9.81}}, "gravity is -9.81; give one number from 0"),
    ({"plant": {"kind": "extended-rotorcraft", "diameter": 1e-5}}, "highest_frequency is .* from 0 to 100000"),
    ({"plant": {"kind": "extended-rotorcraft", "parameters": {"mass": -0.2}}}, "cannot have mass = -0.2"),
    ({"data__substeps": 10_001}, "at most 10000"),
]


@pytest.mark.parametrize(("changes", "says"), IMPOSSIBLE)
def test_a_study_of_a_plant_that_no_machine_can_be_is_refused_before_a_store_is_made(changes, says):
    with pytest.raises(dr.SettingsError, match=says) as caught:
        load(tiny(**changes))
    assert "\n" not in str(caught.value)


def test_a_users_plant_keeps_the_bounds_of_its_model(tmp_path, monkeypatch):
    folder = working_folder(tmp_path, monkeypatch)
    (folder / "own.py").write_text(OWN_PLANT)
    with pytest.raises(dr.SettingsError, match='"sledge" cannot have M = -1, which is outside its bounds'):
        load({**OWN, "plant": {"kind": "own.py", "M": -1.0}})


@pytest.mark.parametrize("make", [dr.Settings, dr.LoDiransac])
def test_integration_steps_beyond_sense_are_refused(make):
    make(substeps=10_000)
    with pytest.raises(dr.SettingsError, match="substeps is 10001; give up to 10000"):
        make(substeps=10_001)
