"""The store: rows all or none, written once, of one configuration; what reads it."""

import json
import multiprocessing
import signal
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import diransac as dr
from diransac.study import about, export, load, paths, read, status
from diransac.study.store import Store
from studies import OWN, OWN_PLANT, SECONDS, TINY, row, rows, tiny, write_rows

STUDY = load(TINY)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A store with three of twelve rows, one of them failed."""
    path = tmp_path / "a.db"
    with Store(path, STUDY) as kept:
        kept.add([row(square_x=0.25, parameter_mass=0.3), row(method="true")])
        kept.add([row("40", 1, status="failed", error="it fell")])
    return path


# Writing --------------------------------------------------------------------------------------------------------------
def test_a_row_that_is_there_stays_as_it_is(store: Path):
    with Store(store, STUDY) as kept:
        assert kept.add([row(square_x=9.0), row(trial=1)]) == 1
        assert kept.finished([("0", 0, "ols"), ("0", 1, "quick")]) == {("0", 0, "ols")}
    assert rows(store)["0", 0, "ols"]["square_x"] == 0.25


def test_rows_that_come_together_are_kept_together(store: Path):
    before = rows(store)
    with Store(store, STUDY) as kept, pytest.raises(dr.StudyError, match="no column named wings"):
        kept.add([row(trial=1), row(trial=0, method="quick", wings=2)])
    assert rows(store) == before


def test_a_process_that_is_killed_while_it_writes_leaves_what_was_there(store: Path):
    before = rows(store)
    code = f"""
import os, signal, sqlite3
connection = sqlite3.connect({str(store)!r}, isolation_level=None)
connection.execute("PRAGMA cache_size = 1")
connection.execute("BEGIN IMMEDIATE")
connection.execute("UPDATE trials SET error = hex(randomblob(100000))")
os.kill(os.getpid(), signal.SIGKILL)
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -signal.SIGKILL
    assert store.with_name("a.db-journal").stat().st_size > 0  # it was in the middle of it
    assert status(store).done == 2
    assert rows(store) == before


def test_a_store_whose_maker_was_killed_at_once_is_new(tmp_path: Path):
    (tmp_path / "a.db").touch()
    with Store(tmp_path / "a.db", STUDY) as kept:
        assert kept.finished() == set()


@pytest.mark.slow
def test_processes_that_write_at_once_lose_nothing_and_repeat_nothing(tmp_path: Path):
    store = tmp_path / "a.db"
    workers = [multiprocessing.get_context("spawn").Process(target=write_rows, args=(store, 30 * k)) for k in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert [worker.exitcode for worker in workers] == [0, 0]
    assert set(rows(store)) == {("0", trial, method) for trial in range(90) for method in ("ols", "true")}


def test_parameters_that_differ_in_case_alone_are_kept_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    Path("own.py").write_text(OWN_PLANT)
    values = {"parameter_M": 1.0, "parameter_m": 2.0, "pseudo_true_M": 3.0, "pseudo_true_m": 4.0}
    with Store("a.db", load(OWN)) as kept:
        kept.add([row("calm", **values)])
    with Store("a.db", load(OWN)) as kept:
        kept.add([row("calm", 1, **{name: 10 * value for name, value in values.items()})])
    found = read("a.db").select(list(values))
    assert found.rows(named=True) == [values, {name: 10 * value for name, value in values.items()}]
    export("a.db", "a.csv", "csv")
    assert pl.read_csv("a.csv").select(list(values)).equals(found)


# One configuration ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"noise.outlier_probability": 0.2}, "noise.outlier_probability is 0.1 in the store, 0.2 was asked for"),
        ({"seed": 8}, "seed is 7 in the store, 8 was asked for"),
        ({"plant.parameters.mass": 0.3}, "plant.parameters.mass is 0.249 in the store, 0.3 was asked for"),
        ({"plant.kind": "extended-rotorcraft"}, 'plant.kind is "planar.*plant.convention is "nothing" in the store'),
        ({"evaluation.trajectories": ["sine"]}, r'evaluation.trajectories is \["square"\] in the store, \["sine"\]'),
        ({"methods.ols.preset": "default"}, "methods.ols.settings.inlier_thresholds.* in the store"),
        ({"axis.path": "noise.burst_length", "axis.levels": [40]}, "levels.40.noise.outlier_magnitude is 40 in the"),
    ],
)
def test_another_configuration_is_refused_key_by_key(store: Path, changes: dict, message: str):
    before = store.read_bytes()
    with pytest.raises(dr.StudyError, match=message):
        Store(store, load(TINY, changes))
    assert store.read_bytes() == before


def test_many_differences_are_counted_rather_than_listed(store: Path):
    with pytest.raises(dr.StudyError, match=r"; and \d+ more\. Use another store") as caught:
        Store(store, load(TINY, {"plant.kind": "extended-rotorcraft"}))
    assert str(caught.value).count(" in the store, ") == 6


def test_more_trials_levels_and_methods_extend_a_store(store: Path):
    more = load(tiny(trials=3, axis__levels=[40, 80], methods={"tls": {}, "ols": TINY["methods"]["ols"]}))
    with Store(store, more):
        pass
    cells = {key: cell.asked for key, cell in status(store).cells.items()}
    assert cells == {
        **{("0", method): 2 for method in ("true", "ols", "quick")},
        ("40", "true"): 2,
        ("40", "ols"): 3,
        ("40", "quick"): 2,
        ("40", "tls"): 3,
        ("80", "tls"): 3,
        ("80", "ols"): 3,
    }


def test_fewer_trials_take_nothing_away(store: Path):
    with Store(store, STUDY.subset(trials=1, levels=[0])):
        pass
    assert (status(store).asked, len(rows(store))) == (12, 3)


# What is no store -----------------------------------------------------------------------------------------------------
def test_a_file_that_is_no_database_is_refused_and_stays(tmp_path: Path):
    (tmp_path / "a.db").write_text("a note to myself " * 100)
    for use in (lambda path: Store(path, STUDY), status):
        with pytest.raises(dr.StudyError, match="file is not a database"):
            use(tmp_path / "a.db")
    assert (tmp_path / "a.db").read_text().startswith("a note")


def test_a_database_of_somebody_else_is_refused_and_stays(tmp_path: Path):
    path = tmp_path / "a.db"
    connection = sqlite3.connect(path)
    connection.execute("CREATE TABLE friends (name TEXT)")
    connection.close()
    for use in (lambda path: Store(path, STUDY), status):
        with pytest.raises(dr.StudyError, match="is no store of a study"):
            use(path)
    assert sqlite3.connect(path).execute("SELECT name FROM sqlite_master").fetchall() == [("friends",)]


def test_a_store_of_another_format_is_refused(store: Path):
    connection = sqlite3.connect(store)
    connection.execute("PRAGMA user_version = 1")
    connection.close()
    with pytest.raises(dr.StudyError, match="has format 1, this version reads 3; begin another"):
        read(store)


@pytest.mark.parametrize("use", [status, read, about, lambda path: paths(path, "square")])
def test_reading_makes_no_store(use, tmp_path: Path):
    with pytest.raises(dr.StudyError, match="does not exist; make one with diransac study run"):
        use(tmp_path / "a.db")
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_missing_is_an_error(tmp_path: Path):
    with pytest.raises(dr.StudyError, match="cannot be opened"):
        Store(tmp_path / "none" / "a.db", STUDY)


# Reading --------------------------------------------------------------------------------------------------------------
def test_rows_come_back_as_columns_in_the_order_asked_for(store: Path):
    with Store(store, STUDY) as kept:
        kept.add([row("40"), row("0", 1, "true")])
    frame = read(store)
    assert frame.select("level", "trial", "method").rows() == [
        ("0", 0, "true"), ("0", 0, "ols"), ("0", 1, "true"), ("40", 0, "ols"), ("40", 1, "ols"),
    ]  # fmt: skip
    assert frame["square_x"].to_list() == [None, 0.25, None, None, None]
    assert frame["parameter_mass"].dtype == pl.Float64
    assert frame["seconds"].struct.field("identify").sum() == 5 * 0.25
    assert about(store) == {
        "name": "tiny",
        "description": "as small as can be",
        "axis": "outlier magnitude",
        "unit": "",
    }


def test_an_empty_store_has_the_columns(tmp_path: Path):
    with Store(tmp_path / "a.db", STUDY):
        pass
    frame = read(tmp_path / "a.db")
    assert len(frame) == 0
    assert {"level", "parameter_drag", "square_theta_dot", "seconds", "host"} <= set(frame.columns)


def test_paths_come_back_by_trajectory(store: Path, tmp_path: Path):
    from diransac.study.trials import _packed

    flown = np.arange(12.0).reshape(4, 3)
    with Store(store, STUDY) as kept:
        kept.add([row(trial=1, paths=_packed({"square": flown}))])
    found = paths(store, "square")
    assert list(found) == [("0", 1, "ols")]
    assert np.array_equal(found["0", 1, "ols"], flown)
    assert paths(store, "sine") == {}


def test_an_export_holds_the_same_rows(store: Path, tmp_path: Path):
    export(store, tmp_path / "a.parquet", "parquet")
    assert pl.read_parquet(tmp_path / "a.parquet").equals(read(store))
    export(store, tmp_path / "a.csv", "csv")
    table = pl.read_csv(tmp_path / "a.csv", schema_overrides={"level": pl.String})
    same = [name for name in table.columns if name != "seconds"]
    assert table.select(same).rows() == read(store).select(same).rows()
    assert json.loads(table["seconds"][0]) == SECONDS
    with pytest.raises(dr.SettingsError, match='no kind "xls"; there are parquet, csv'):
        export(store, tmp_path / "a.xls", "xls")


def test_the_status_counts_and_says_why_trials_failed(store: Path):
    found = status(store)
    assert (found.asked, found.done, found.failed, found.missing) == (12, 2, 1, 9)
    assert found.cells["40", "ols"] == (2, 0, 1, "it fell")
    text = str(found)
    assert "2 done, 1 failed, 9 missing of 12 rows" in text
    assert "40     0 done, 2 missing  0 done, 1 failed, 1 missing  0 done, 2 missing" in text
    assert text.endswith("! ols failed, as at level 40: it fell")
    assert json.loads(json.dumps(found.to_dict()))["cells"][4]["failed"] == 1
