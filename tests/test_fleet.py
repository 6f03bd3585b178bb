"""Fleets of logs: who differs, changes or drifts, and nobody else; rows that resume, and rows of logs that fail."""

import csv
import json
import os
import sqlite3
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import diransac as dr
from command_line import run
from diransac.errors import SettingsError, StudyError
from diransac.study import FleetRows, FleetStatus, engine, fleet_status, identify_each, read_fleet, summarise_fleet
from diransac.study.fleet import export_fleet

N_VEHICLES, N_LOGS = 20, 10


def fleet(seed: int, **effects: tuple[int, np.ndarray | float]) -> FleetRows:
    """Estimates of a mass: 1 % among vehicles, 1 % from log to log, and errors; `effects` multiply a vehicle's."""
    rng = np.random.default_rng(seed)
    errors = 0.01 * rng.uniform(0.5, 2.0, (N_VEHICLES, N_LOGS))
    y = 1.0 + 0.01 * rng.standard_normal((N_VEHICLES, 1)) + 0.01 * rng.standard_normal((N_VEHICLES, N_LOGS))
    y += errors * rng.standard_normal(y.shape)
    for vehicle, factor in effects.values():
        y[vehicle] *= factor
    n = y.size
    names, vehicles = tuple(f"log {k}" for k in range(n)), np.repeat([f"v{k:02d}" for k in range(N_VEHICLES)], N_LOGS)
    status = FleetStatus(n, 0, 0, {})
    return FleetRows("m", {"mass": "kg"}, names, vehicles, {"mass": y.ravel()}, {"mass": errors.ravel()}, (), status)


STEP, RAMP = np.where(np.arange(N_LOGS) < 5, 1.0, 1.15), np.linspace(1.0, 1.2, N_LOGS)


@pytest.mark.parametrize("seed", range(3))
def test_a_vehicle_that_differs_one_that_changes_and_one_that_drifts_are_found_and_nobody_else(seed: int):
    found = summarise_fleet(fleet(seed, bent=(3, 1.3), heavier=(7, STEP), worn=(11, RAMP)))
    assert [x.vehicle for x in found.outliers] == ["v03"]
    assert [(x.vehicle, abs(x.place - 6) <= 1) for x in found.changes] == [("v07", True)]
    assert [x.vehicle for x in found.drifts] == ["v11"]
    assert found.outliers[0].value / found.outliers[0].fleet_value == pytest.approx(1.3, abs=0.05)


def test_scales_are_those_of_the_fleet_and_a_healthy_one_has_no_findings():
    several = [summarise_fleet(fleet(seed)) for seed in range(12)]
    scales = np.mean([[x.parameters[0].between, x.parameters[0].within] for x in several], axis=0)
    assert scales == pytest.approx([0.01, 0.01], rel=0.3)
    assert sum(bool(x.findings) for x in several) <= 1


def test_a_wild_log_and_an_uncertain_vehicle_accuse_nobody():
    rows = fleet(0, wild=(5, np.r_[np.ones(N_LOGS - 1), 30.0]), uncertain=(9, 1.3))
    rows.standard_errors["mass"][9 * N_LOGS : 10 * N_LOGS] = 0.5
    assert not summarise_fleet(rows).findings


def test_vehicles_that_are_few_are_not_compared():
    rows = fleet(0, bent=(0, 2.0))
    few = {name: getattr(rows, name)[: 3 * N_LOGS] for name in ("logs", "vehicles", "verdicts")}
    values, errors = ({"mass": x["mass"][: 3 * N_LOGS]} for x in (rows.values, rows.standard_errors))
    found = summarise_fleet(
        FleetRows("m", rows.units, values=values, standard_errors=errors, status=rows.status, **few)
    )
    assert not found.outliers
    assert "too few" in str(found)


# Store and engine -----------------------------------------------------------------------------------------------------
@pytest.fixture
def logs(tmp_path: Path) -> list[Path]:
    """Logs of two sledges of 2 and 3 kg, and one that is no log."""
    t = 0.01 * np.arange(300)
    v, a = np.sin(3.0 * t), 3.0 * np.cos(3.0 * t)
    files = [tmp_path / vehicle / f"{flight}.csv" for vehicle in ("a", "b") for flight in (2, 10)]
    for k, (path, mass) in enumerate(zip(files, (2.0, 2.0, 3.0, 3.0), strict=True)):
        path.parent.mkdir(exist_ok=True)
        noise = 0.01 * np.random.default_rng(k).standard_normal(len(t))
        signals = {"s": -np.cos(3.0 * t) / 3.0, "s_dot": v, "s_ddot": a, "force": mass * a + 0.5 * v + noise}
        dr.Log.from_arrays(t, signals).write(path)
    files.append(tmp_path / "b" / "11.csv")
    files[-1].write_text("t,s\nno log\n")
    return files


MODEL = dr.Model(
    "sledge",
    coordinates={"s": "m"},
    inputs={"force": "N"},
    parameters={"mass": dr.Parameter("kg", positive=True), "friction": dr.Parameter("N s/m", lower=0.0)},
    equations=lambda q, v, a, u, p: [p.mass * a.s + p.friction * v.s - u.force],
)
PATTERN = r"(?P<vehicle>[^/]+)/(?P<time>\d+)\.csv"


def test_each_log_is_a_row_a_failed_one_with_its_reason_and_a_store_resumes(logs: list[Path], tmp_path: Path):
    store, counts = tmp_path / "fleet.db", list[tuple[int, int]]()
    with ThreadPoolExecutor(1) as threads:
        options = {"store": store, "vehicle": PATTERN, "executor": threads, "batch_size": 2}
        identify_each(MODEL, logs[1:3], "ols", **options)
        found = identify_each(MODEL, logs[::-1], "ols", progress=lambda *n: counts.append(n), **options)
        with pytest.raises(StudyError, match=r"another configuration: fleet\.arguments is"):
            identify_each(MODEL, logs, "ols", seed=1, **options)
        for pattern in ("(?P<vehicle>z+)", "(?P<vehicle>z*)"):
            with pytest.raises(SettingsError, match="finds no vehicle in log"):
                identify_each(MODEL, logs, "ols", **options | {"vehicle": pattern})
    assert (found.done, found.failed, found.missing) == (4, 1, 0)
    assert counts[0] == (2, 5)
    assert counts[-1] == (5, 5)
    assert "LOG" in next(iter(found.reasons))
    rows = read_fleet(store)
    assert rows.logs == tuple(map(str, logs[:4]))  # by vehicle, and by the number in the name
    assert rows.values["mass"] == pytest.approx([2.0, 2.0, 3.0, 3.0], abs=0.01)
    alone = dr.identify(MODEL, dr.read_log(logs[3]), "ols")
    assert rows.values["mass"][3] == alone.parameters["mass"]
    assert rows.standard_errors["mass"][3] == alone.standard_errors["mass"]


def identified(store: Path, logs: list[Path], method: str = "ols", model: dr.Model = MODEL, **arguments) -> FleetStatus:
    with ThreadPoolExecutor(1) as threads:
        return identify_each(model, logs, method, store=store, executor=threads, **arguments)


@pytest.mark.parametrize(("batch_size", "n_tasks"), [(None, 4), (30, 2), (3, 20)])
def test_batches_of_short_logs_are_joined_unless_their_size_is_given(batch_size, n_tasks, tmp_path, monkeypatch):
    class Counting(ThreadPoolExecutor):
        n_tasks = 0

        def submit(self, *arguments, **named):
            self.n_tasks += 1
            return super().submit(*arguments, **named)

    monkeypatch.setattr(engine, "_SECONDS", 100.0)
    files = [tmp_path / "a" / f"{k}.csv" for k in range(60)]  # that are missing, which takes no time
    with Counting(1) as threads:
        options = {"vehicle": PATTERN, "executor": threads, "tasks": 1, "batch_size": batch_size}
        found = identify_each(MODEL, files, "ols", store=tmp_path / "fleet.db", **options)
    assert (found.failed, threads.n_tasks) == (60, n_tasks)


def test_a_log_that_kills_its_worker_is_tried_again_without_most_of_its_batch(tmp_path, monkeypatch):
    lost = list[int]()

    class Losing(ThreadPoolExecutor):
        def submit(self, function, /, compute, keys):
            if any(name.endswith("13.csv") for (name,) in keys):
                lost.append(len(keys))
                future = Future()
                future.set_exception(BrokenExecutor("it is dead"))
                return future
            return super().submit(function, compute, keys)

    monkeypatch.setattr(engine, "_SECONDS", 100.0)
    monkeypatch.setattr(engine.random.SystemRandom, "sample", lambda _self, batches, _n: list(batches))
    files = [tmp_path / "a" / f"{k}.csv" for k in range(60)]
    with Losing(1) as threads, pytest.raises(StudyError, match="lost 3 times"):
        identify_each(MODEL, files, "ols", vehicle=PATTERN, executor=threads, tasks=1, store=tmp_path / "fleet.db")
    assert lost[0] > 4
    assert lost[1:] == [4, 4]
    assert fleet_status(tmp_path / "fleet.db").failed == 56


def test_a_log_whose_file_has_changed_is_identified_again_and_one_that_was_only_copied_is_not(logs, tmp_path):
    store, counts = tmp_path / "fleet.db", list[tuple[int, int]]()
    identified(store, logs[:3])
    heavier = dr.read_log(logs[0])
    dr.Log.from_arrays(heavier.time, {**heavier.signals, "force": 2.0 * heavier["force"]}).write(logs[0])
    copied = logs[1].read_bytes()
    logs[1].unlink()
    logs[1].write_bytes(copied)
    os.utime(logs[1], (1.0, 1.0))
    logs[2].unlink()
    status = identified(store, logs[:3], progress=lambda *n: counts.append(n))
    assert counts == [(2, 3), (3, 3)]  # a file that is not here is not looked at
    assert status.done == 3
    assert read_fleet(store).values["mass"] == pytest.approx([4.0, 2.0, 3.0], abs=0.02)


def test_logs_that_a_store_lacks_follow_those_it_has_and_all_of_them_together_set_the_order_anew(logs, tmp_path):
    store, everything = tmp_path / "fleet.db", logs[:4]
    for some in (everything[1:2], everything[:1], everything[2:4], everything[:2]):
        identified(store, some)
    assert read_fleet(store).logs == tuple(str(everything[k]) for k in (1, 0, 2, 3))
    identified(store, everything)
    assert read_fleet(store).logs == tuple(map(str, everything))


def test_parameters_that_differ_in_case_alone_have_columns_of_their_own(logs, tmp_path):
    model = dr.Model(
        "sledge",
        coordinates={"s": "m"},
        inputs={"force": "N"},
        parameters={"M": dr.Parameter("kg", positive=True), "m": dr.Parameter("N s/m")},
        equations=lambda q, v, a, u, p: [p.M * a.s + p.m * v.s - u.force],
    )
    store = tmp_path / "fleet.db"
    identified(store, logs[:1], model=model)
    rows, alone = read_fleet(store), dr.identify(model, dr.read_log(logs[0]), "ols")
    assert {name: x[0] for name, x in rows.values.items()} == dict(alone.parameters)
    export_fleet(store, tmp_path / "fleet.csv")
    with (tmp_path / "fleet.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert (float(row["parameter_M"]), float(row["parameter_m"])) == tuple(alone.parameters.values())


def test_a_store_resumes_with_other_threads_and_a_method_by_name_or_as_an_object_but_with_nothing_else(logs, tmp_path):
    store = tmp_path / "fleet.db"
    identified(store, logs[:1], "i-diransac", settings=dr.Settings(max_iterations=20, threads=1), seed=3)
    same = dr.IDiransac(dr.Settings(max_iterations=20, threads=2, batch_size=64))
    assert identified(store, logs[:2], same, seed=3).done == 2
    with pytest.raises(StudyError, match=r"another configuration: fleet\.method is"):
        identified(store, logs[:2], "i-diransac", seed=3)
    with pytest.raises(StudyError, match=r"another configuration: fleet\.preparation is"):
        identified(store, logs[:2], same, seed=3, configuration={"preparation": {}})
    with pytest.raises(TypeError, match="seeed"):
        identified(store, logs[:2], same, seeed=3)
    prepared = tmp_path / "prepared.db"
    identified(prepared, logs[:1], configuration={"preparation": {}})
    with pytest.raises(StudyError, match=r"another configuration: fleet\.preparation is"):
        identified(prepared, logs[:1])


def test_a_store_of_an_earlier_format_is_refused_and_stays_as_it_is(logs, tmp_path):
    store = tmp_path / "fleet.db"
    identified(store, logs[:1])
    with closing(sqlite3.connect(store)) as connection:
        connection.execute("PRAGMA user_version = 1")
    before = store.read_bytes()
    for use in (lambda: identified(store, logs[:1]), lambda: read_fleet(store)):
        with pytest.raises(StudyError, match="has format 1, this version reads 3; begin another"):
            use()
    assert store.read_bytes() == before


@pytest.mark.usefixtures("trials_in_this_process")
def test_the_command_line_identifies_each_log_and_shows_plots_and_writes_the_fleet(logs: list[Path], tmp_path: Path):
    (tmp_path / "sledge.py").write_text(
        "import diransac as dr\nmodel = dr.Model('sledge', coordinates={'s': 'm'}, inputs={'force': 'N'},"
        "parameters={'mass': dr.Parameter('kg', positive=True)},"
        "equations=lambda q, v, a, u, p: [p.mass * a.s - u.force])\n"
    )
    store, page = tmp_path / "fleet.db", tmp_path / "fleet.html"
    words = ["identify", "--each", *logs, "--model", tmp_path / "sledge.py", "--method", "ols", "--vehicle", PATTERN]
    done = run(*words, "--store", store, "--report", page)
    assert done.exit_code == 0, done.stderr
    assert "2 vehicles: 4 logs identified, 1 failed" in done.stdout
    assert "Failed logs" in page.read_text()
    assert str(logs[0]) not in page.read_text()
    assert json.loads(run("fleet", "show", store, "--json").stdout)["vehicles"] == 2
    assert run("fleet", "plot", store, "-o", tmp_path / "fleet.png").exit_code == 0
    assert run("fleet", "export", store, "-o", tmp_path / "fleet.csv").exit_code == 0
    with (tmp_path / "fleet.csv").open() as file:
        assert [row["status"] for row in csv.DictReader(file)] == ["done"] * 4 + ["failed"]
    refused = run("study", "status", store)
    assert (refused.exit_code, "is no store of a study" in refused.stderr) == (1, True)
    assert run(*words[:2], "-", *words[3:], "--store", store).exit_code == 2
    assert run("identify", logs[0], "--model", "servo-axis", "--store", store).exit_code == 2
    assert run(*words).exit_code == 2
    assert fleet_status(store).failed == 1
