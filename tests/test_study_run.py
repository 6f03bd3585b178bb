"""Studies as they run: the same rows whatever runs them, whatever is killed, and in whatever company."""

import dataclasses
import multiprocessing
import os
import platform
import re
import signal
import subprocess
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import diransac as dr
from diransac.study import connected, load, paths, status, trials
from diransac.study import data as data_module
from diransac.study.data import derived_seed
from diransac.study.specification import Missions
from diransac.study.store import Store
from studies import TINY, TINY_TOML, command, rows, tiny

PLANT = load(TINY).plant.plant
STATES = PLANT.model.state
MOMENT = 0.05
"""s between two looks at something that is waited for."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple, dict]:
    """Rows of an uninterrupted run in this process."""
    store = tmp_path_factory.mktemp("whole") / "a.db"
    with ThreadPoolExecutor(1) as here:
        assert dr.run_study(TINY, store=store, executor=here).missing == 0
    return rows(store)


def run(tmp_path: Path, spec: dict = TINY, **options: object) -> dict[tuple, dict]:
    """Rows of a run in this process, unless the options say otherwise."""
    with ThreadPoolExecutor(1) as here:
        where = {} if {"jobs", "executor"} & options.keys() else {"executor": here}
        dr.run_study(spec, store=tmp_path / "a.db", **where, **options)
    return rows(tmp_path / "a.db")


def errors_of(row: dict) -> dict[str, float]:
    return {name: row[f"square_{name}"] for name in STATES}


# What a trial is ------------------------------------------------------------------------------------------------------
def flown_alone(parameters: dict[str, float]) -> dict[str, float]:
    """Tracking error of one flight at a time, by what users call."""
    known = dr.Plant(PLANT.model, parameters)
    trajectory = dr.square(known)
    return dr.tracking_error(trajectory, dr.fly(PLANT, trajectory, dr.tvlqr(known, trajectory)))


def test_control_missions_and_estimators_are_those_of_the_study(tmp_path: Path):
    spec = tiny(
        control={"Q": 1.0, "R": {"thrust": 2.0, "moment": 1.0}, "clip": False},
        missions__square={"speed": 2.0, "input_weights": {"moment": 0.2}},
        methods__quick__estimator="tls",
    )
    row = run(tmp_path, spec, levels=[40], methods=["quick"], trials=1)["40", 0, "quick"]
    parameters = {name: row[f"parameter_{name}"] for name in PLANT.parameters}
    known = dr.Plant(PLANT.model, parameters)
    trajectory = dr.square(known, speed=2.0, input_weights={"moment": 0.2})
    free = dr.tvlqr(known, trajectory, Q=1.0, R={"thrust": 2.0, "moment": 1.0}).unclipped()
    assert errors_of(row) == dr.tracking_error(trajectory, dr.fly(PLANT, trajectory, free))

    log = data_module.trial_data(spec, 40).log
    method = load(spec).methods["quick"]
    seed = derived_seed(row["seed"], "identify")
    settings = dataclasses.replace(method.settings, threads=1)
    found = dr.identify(PLANT.model, log, method.method, settings=settings, estimator="tls", seed=seed)
    assert found.parameters == parameters


def test_every_row_is_there_and_done(whole: dict):
    assert set(whole) == {(level, k, m) for level in ("0", "40") for k in (0, 1) for m in ("true", "ols", "quick")}
    assert {row["status"] for row in whole.values()} == {"done"}


def test_tracking_errors_are_those_of_flights_by_the_rows_own_parameters(whole: dict):
    for key in (("0", 0, "true"), ("40", 0, "ols"), ("40", 1, "quick")):
        parameters = {name: whole[key][f"parameter_{name}"] for name in PLANT.parameters}
        assert errors_of(whole[key]) == flown_alone(parameters)


def test_what_was_identified_is_what_the_spoilt_record_gives(whole: dict):
    seed = derived_seed(7, "40", 1)
    flight = dr.square(PLANT)
    log = dr.fly(PLANT, flight, dr.tvlqr(PLANT, flight))
    noise = dr.Noise(outlier_probability=0.1, outlier_magnitude=40.0)
    spoilt = dr.corrupt(log, noise, derived_seed(seed, "noise"), signals=PLANT.model.signals)
    found = dr.identify(PLANT.model, spoilt, "ols", settings=dr.Settings.table_iv())
    row = whole["40", 1, "ols"]
    assert {name: row[f"parameter_{name}"] for name in found.parameters} == found.parameters
    assert (row["seed"], row["fit_error"], row["inlier_fraction"]) == (seed, found.fit_error, found.inlier_fraction)


def test_without_noise_the_parameters_are_found_and_the_reference_is_flown(whole: dict):
    for key, row in whole.items():
        if key[0] == "0":
            assert row["parameter_inertia"] == pytest.approx(PLANT.parameters["inertia"], rel=1e-9)
            assert max(errors_of(row).values()) < 1e-6


def test_exact_estimates_share_the_plan_of_the_plants_own_parameters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    plain, planned = Missions.planned, []

    def counted(self: Missions, mission: str, plant: dr.Plant, **options: object) -> dr.Trajectory:
        planned.append(dict(plant.parameters))
        return plain(self, mission, plant, **options)

    monkeypatch.setattr(Missions, "planned", counted)
    found = run(tmp_path, tiny(seed=8), levels=[0], methods=["true", "ols"])
    exact = {tuple(row[f"parameter_{name}"] for name in PLANT.model.parameters) for row in found.values()}
    assert len(exact) > 1
    assert planned == [dict(PLANT.parameters)]


def test_the_true_method_identifies_nothing(whole: dict):
    row = whole["40", 0, "true"]
    assert {name: row[f"parameter_{name}"] for name in PLANT.parameters} == PLANT.parameters
    assert row["fit_error"] is row["iterations"] is row["stop_reason"] is None


def test_seconds_are_split_by_stage_and_the_host_is_named(tmp_path: Path):
    run(tmp_path, trials=1, levels=[40])
    frame = dr.study.read(tmp_path / "a.db")
    seconds = frame["seconds"].struct.unnest()
    assert tuple(seconds.columns) == trials.STAGES
    assert (seconds.min_horizontal() >= 0).all()
    assert (seconds["fly"] > 0).all()
    assert frame["host"].n_unique() == 1


def test_paths_are_kept_where_they_are_asked_for(tmp_path: Path):
    run(tmp_path, tiny(evaluation__keep_paths=True), trials=1, levels=[40], methods=["true"])
    trajectory = dr.square(PLANT)
    flown = paths(tmp_path / "a.db", "square")["40", 0, "true"]
    assert flown.shape == (len(trajectory), 3)
    assert np.abs(flown - trajectory.columns(["x", "z", "theta"])).max() < 1e-5
    planned = paths(tmp_path / "a.db", "square", planned=True)["40", 0, "true"]
    np.testing.assert_array_equal(planned, trajectory.columns(["x", "z", "theta"]).astype(np.float32))


# In whatever company --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "choice",
    [{"trials": 1}, {"levels": ["40"]}, {"methods": ["quick"]}, {"batch_size": 1}, {"levels": [40, 0], "trials": 1}],
)
def test_a_part_of_a_study_gives_the_rows_that_the_whole_gives(choice: dict, whole: dict, tmp_path: Path):
    found = run(tmp_path, **choice)
    assert found == {key: whole[key] for key in found}
    assert len(found) >= 4


def test_rows_do_not_depend_on_what_a_study_is_called_or_which_other_methods_it_has(whole: dict, tmp_path: Path):
    other = tiny(name="b", axis__levels=[40, 7], methods={"tls": {}, "quick": TINY["methods"]["quick"]})
    found = run(tmp_path, other, levels=[40], methods=["quick"])
    assert found == {key: whole[key] for key in found}


def test_trials_draw_their_own_rotor_phases_whatever_the_batch(tmp_path: Path):
    plant = {"kind": "extended-rotorcraft", "mass_imbalance": 1e-4, "rotor_phase": "random"}
    shaken = tiny(plant=plant, axis={"path": "noise.outlier_magnitude", "levels": [0]})
    together = run(tmp_path, shaken, trials=3, methods=["true"])
    (tmp_path / "alone").mkdir()
    alone = run(tmp_path / "alone", shaken, trials=3, methods=["true"], batch_size=1)
    assert alone == together
    assert len({row["square_theta_dot"] for row in together.values()}) == 3


def test_threads_of_one_process_give_the_same_rows(whole: dict, tmp_path: Path):
    with ThreadPoolExecutor(2) as pool:
        assert run(tmp_path, executor=pool, batch_size=1) == whole


def test_more_of_the_same_is_added_to_what_is_there(whole: dict, tmp_path: Path):
    run(tmp_path, trials=1, levels=[40], methods=["ols"])
    counts = []
    assert run(tmp_path, progress=lambda done, asked: counts.append((done, asked))) == whole
    assert counts[0] == (1, 12)
    assert counts[-1] == (12, 12)
    assert counts == sorted(counts)


def test_a_finished_study_starts_no_worker(whole: dict, tmp_path: Path):
    run(tmp_path, trials=1, levels=[0], methods=["true"])

    class Refuses(ThreadPoolExecutor):
        def submit(self, *arguments: object, **more: object) -> Future:
            raise AssertionError("there is nothing to do")

    with Refuses(1) as pool:
        run(tmp_path, trials=1, levels=[0], methods=["true"], executor=pool)


# What fails -----------------------------------------------------------------------------------------------------------
def test_a_plan_that_cannot_be_is_a_row_that_says_so(tmp_path: Path):
    found = run(tmp_path, tiny(noise__outlier_probability=0.5), levels=[1000], trials=1)
    row = found["1000", 0, "ols"]
    assert row["status"] == "failed"
    assert row["error"].startswith("square: ")
    assert row["parameter_mass"] is not None
    assert set(errors_of(row).values()) == {None}
    assert found["1000", 0, "true"]["status"] == "done"


def test_a_search_that_accepts_nothing_is_a_row_without_figures(tmp_path: Path):
    hopeless = {"method": "i-diransac", "preset": "table-iv", "settings": {"max_iterations": 1, "sample_size": 3}}
    spec = tiny(noise__outlier_probability=0.6, methods={"hopeless": hopeless, "true": {}})
    found = run(tmp_path, spec, levels=[1e6], trials=2)
    lost = [row for row in found.values() if row["status"] == "failed"]
    assert any("no hypothesis was accepted" in row["error"] for row in lost)
    assert {row["method"] for row in lost} == {"hopeless"}
    assert all(row["parameter_mass"] is None and row["square_x"] is None for row in lost)
    found_status = status(tmp_path / "a.db")
    assert (found_status.failed, found_status.missing) == (len(lost), 0)


def test_an_error_that_nobody_foresaw_ends_one_trial_and_says_what_it_was(
    whole: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    by = trials.Identification.by

    def breaks(self: trials.Identification, method: object, seed: int) -> dr.Result:
        if method.name == "i-diransac":
            raise ZeroDivisionError("by accident")
        return by(self, method, seed)

    monkeypatch.setattr(trials.Identification, "by", breaks)
    found = run(tmp_path)
    broken = [row["error"] for key, row in found.items() if key[2] == "quick"]
    assert broken == ["internal error: ZeroDivisionError: by accident"] * 4
    assert all(row == whole[key] for key, row in found.items() if key[2] != "quick")


@pytest.mark.parametrize("purpose", ["data flight", "square"])
def test_a_flight_that_ends_in_an_error_that_nobody_foresaw_takes_no_other_with_it(
    purpose: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    spec = tiny(plant={"kind": "extended-rotorcraft", "rotor_phase": "random"})
    fly_batch, struck = dr.fly_batch, derived_seed(data_module.trial_seed(load(spec), "40", 1), purpose)

    def breaks(plants: list, controllers: list, **more: object) -> list:
        if struck in more["seeds"]:
            raise ZeroDivisionError("by accident")
        return fly_batch(plants, controllers, **more)

    monkeypatch.setattr(data_module, "fly_batch", breaks)
    found = run(tmp_path, spec, levels=[40], methods=["ols"], batch_size=2)
    assert found["40", 0, "ols"]["status"] == "done"
    assert found["40", 1, "ols"]["error"] == "internal error: ZeroDivisionError: by accident"


def test_a_controller_that_cannot_be_takes_no_other_with_it(
    whole: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    bad = whole["40", 0, "ols"]["parameter_mass"]

    def alone(plant: dr.Plant, trajectory: dr.Trajectory, **_weights: object) -> dr.Controller:
        if plant.parameters["mass"] == bad:
            raise dr.PlanningError("no controller")
        return dr.tvlqr(plant, trajectory)

    def together(plants: list, trajectories: list, **more: object) -> list:
        return [alone(*pair) for pair in zip(plants, trajectories, strict=True)]

    monkeypatch.setattr(trials, "tvlqr_batch", together)
    found = run(tmp_path)
    assert found["40", 0, "ols"]["error"] == "no controller"
    assert all(row == whole[key] for key, row in found.items() if key != ("40", 0, "ols"))


def test_a_flight_that_diverges_is_a_row_that_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def runaway(plants: list, controllers: list, **more: object) -> list:
        logs = dr.fly_batch(plants, controllers, **more)
        return [
            dr.Log(log.time, {n: log[n] for n in log.names}, notes=("the flight diverged at t = 1 s",)) for log in logs
        ]

    monkeypatch.setattr(data_module, "fly_batch", runaway)
    found = run(tmp_path, trials=1, levels=[40])
    assert {row["error"] for row in found.values()} == {"the flight diverged at t = 1 s"}


def test_an_infeasible_data_flight_fails_every_trial_of_its_level(tmp_path: Path):
    heavy = tiny(axis={"path": "plant.parameters.mass", "levels": [0.249, 3.0]})
    found = run(tmp_path, heavy, trials=1)
    assert {row["status"] for key, row in found.items() if key[0] == "0.249"} == {"done"}
    assert all("cannot rest" in row["error"] for key, row in found.items() if key[0] == "3")


def test_a_data_flight_that_diverges_fails_its_own_trial_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    fly_batch, flown = dr.fly_batch, []

    def one_runs_away(plants: list, controllers: list, **more: object) -> list:
        logs = fly_batch(plants, controllers, **more)
        flown.append(len(logs))
        if len(flown) == 1:
            lost = logs[1]
            logs[1] = dr.Log(lost.time, {n: lost[n] for n in lost.names}, notes=("the flight diverged at t = 1 s",))
        return logs

    monkeypatch.setattr(data_module, "fly_batch", one_runs_away)
    plant = {"kind": "extended-rotorcraft", "rotor_phase": "random"}
    found = run(tmp_path, tiny(plant=plant), levels=[40], methods=["ols"], batch_size=2)
    assert flown == [2, 1]
    assert found["40", 0, "ols"]["status"] == "done"
    assert found["40", 1, "ols"]["error"] == "the flight diverged at t = 1 s"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"jobs": 0}, "jobs is 0; give at least 1"),
        ({"batch_size": 0}, "batch_size is 0; give at least 1"),
        ({"tasks": 0}, "tasks is 0; give at least 1"),
        ({"executor": ThreadPoolExecutor(1), "jobs": 1}, "an executor is given; give one of them"),
    ],
)
def test_arguments_without_meaning_are_refused(options: dict, message: str, tmp_path: Path):
    with pytest.raises(dr.SettingsError, match=message):
        run(tmp_path, **options)
    assert not list(tmp_path.iterdir())


# What is killed -------------------------------------------------------------------------------------------------------
def killed_in_mid_run(store: Path, jobs: int) -> int:
    """Kill a process that runs the study, with a signal that nothing can hold back; how many rows it had kept."""
    process = subprocess.Popen(**command(store, jobs), stdout=subprocess.PIPE, text=True)
    for line in process.stdout:
        if not line.startswith("0 "):
            break
    process.kill()
    process.stdout.read()  # ends when all that may still write to it have ended: its workers, too
    assert process.wait() == -signal.SIGKILL
    process.stdout.close()
    return len(rows(store))


@pytest.mark.slow
def test_a_killed_run_goes_on_where_it_was_and_ends_as_an_uninterrupted_one(whole: dict, tmp_path: Path):
    kept = killed_in_mid_run(tmp_path / "a.db", jobs=2)
    assert 0 < kept < len(whole)
    assert status(tmp_path / "a.db").missing == len(whole) - kept
    assert run(tmp_path) == whole


@pytest.mark.slow
def test_two_processes_share_a_store_and_give_the_rows_of_one(whole: dict, tmp_path: Path):
    store = tmp_path / "a.db"
    both = [subprocess.Popen(**command(store, None), stdout=subprocess.PIPE, text=True) for _ in range(2)]
    said = [process.communicate()[0] for process in both]
    assert [process.returncode for process in both] == [0, 0]
    assert rows(store) == whole
    assert any(text.endswith("12 12\n") for text in said)


class KillsItsWorkers(ThreadPoolExecutor):
    """An executor whose first tasks are lost with their worker: cancelled, or with an error."""

    def __init__(self, lost: int) -> None:
        super().__init__(1)
        self.lost = lost

    def submit(self, function: object, *arguments: object) -> Future:
        """Lose a task, or run it."""
        if self.lost == 0:
            return super().submit(function, *arguments)
        self.lost -= 1
        future: Future = Future()
        if self.lost % 2:
            future.cancel()
            future.set_running_or_notify_cancel()
        else:
            future.set_exception(ConnectionError("the worker is gone"))
        return future


def test_lost_batches_are_run_again(whole: dict, tmp_path: Path):
    with KillsItsWorkers(lost=3) as pool:
        assert run(tmp_path, executor=pool, batch_size=1) == whole


def test_a_batch_that_is_lost_again_and_again_ends_the_run_and_keeps_the_rest(tmp_path: Path):
    with (
        KillsItsWorkers(lost=99) as pool,
        pytest.raises(dr.StudyError, match=r"lost 3 times, at last by (Connection|Cancelled)Error"),
    ):
        run(tmp_path, executor=pool)
    assert status(tmp_path / "a.db").missing == 12


def test_a_worker_without_the_users_file_ends_the_run_at_once_and_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    file, handed_out = tmp_path / "own.py", []
    file.write_text(
        "import diransac as dr\ndef plant(): return dr.Plant(dr.models.planar_rotorcraft(), dr.models.TABLE_I)"
    )
    monkeypatch.chdir(tmp_path)

    class Elsewhere(ThreadPoolExecutor):
        def submit(self, function: object, *arguments: object) -> Future:
            file.unlink(missing_ok=True)
            handed_out.append(arguments)
            return super().submit(function, *arguments)

    here = re.escape(platform.node())
    message = rf'a worker on {here} cannot run .* "own.py" cannot be read: .*; finished rows are kept$'
    with Elsewhere(1) as pool, pytest.raises(dr.StudyError, match=message):
        run(tmp_path, tiny(plant={"kind": "own.py"}), executor=pool, tasks=1)
    assert len(handed_out) == 1


@pytest.mark.slow
def test_processes_give_the_same_rows_though_one_of_them_is_killed(whole: dict, tmp_path: Path):
    victims = []

    def kill_one(done: int, asked: int) -> None:
        if done and not victims:
            victims.extend(process.pid for process in multiprocessing.active_children()[:1])
            os.kill(victims[0], signal.SIGKILL)

    assert run(tmp_path, jobs=2, batch_size=1, progress=kill_one) == whole
    assert victims


@pytest.mark.slow
def test_a_script_that_begins_itself_again_in_each_worker_is_told_what_it_lacks(tmp_path: Path):
    words = command(tmp_path / "a.db", jobs=1)["args"]
    script = Path(words[1])
    script.write_text(script.read_text().replace('if __name__ == "__main__":', "if True:"))
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert last.startswith("diransac.errors.StudyError: ")
    assert last.endswith('run again (in a script, under if __name__ == "__main__":)')


def has_rows(store: Path) -> bool:
    """Whether a store that another process may be about to create has rows."""
    with suppress(dr.StudyError):
        return store.exists() and status(store).done > 0
    return False


@pytest.mark.slow
def test_ctrl_c_ends_a_run_at_once_and_says_how_to_go_on(tmp_path: Path):
    (tmp_path / "tiny.toml").write_text(TINY_TOML)
    words = ["-m", "diransac", "study", "run", "tiny.toml", "--store", "a.db", "--trials", "2000", "--jobs", "2"]
    process = subprocess.Popen(
        [*command(tmp_path / "a.db", 1)["args"][:1], *words],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # which a shell's background jobs ignore
    )  # fmt: skip
    try:
        while not has_rows(tmp_path / "a.db") and process.poll() is None:
            with suppress(subprocess.TimeoutExpired):
                process.wait(MOMENT)
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=10)
    finally:
        with suppress(ProcessLookupError):  # it ended, as it should
            os.killpg(process.pid, signal.SIGKILL)
    kept = len(rows(tmp_path / "a.db"))
    assert status(tmp_path / "a.db").failed == 0
    assert (process.returncode, out) == (130, "")
    *progress, counts, end = err.splitlines()
    assert counts == f"{kept} of 8000 rows are kept in a.db; the same command runs the rest"
    assert end == "interrupted"
    assert all(re.match(r"tiny: \d+ of 8000 rows, 0% after \d+ s", line) for line in progress)


def test_rows_are_counted_that_were_kept_as_ctrl_c_came(tmp_path: Path, monkeypatch):
    add, counts = Store.add, []

    def interrupted(store: Store, new: list) -> int:
        add(store, new)
        raise KeyboardInterrupt

    monkeypatch.setattr(Store, "add", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, progress=lambda done, _asked: counts.append(done))
    assert counts[-1] == len(rows(tmp_path / "a.db")) > 0


# On a cluster ---------------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_a_cluster_whose_worker_is_killed_gives_the_same_rows(whole: dict, tmp_path: Path):
    distributed = pytest.importorskip("distributed")
    victims = []
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster, connected(cluster.scheduler_address) as (executor, tasks):
        with distributed.Client(cluster, set_as_default=False) as client:
            workers = list(client.run(os.getpid).values())

        def kill_one(done: int, asked: int) -> None:
            if done and not victims:
                victims.append(workers[0])
                os.kill(workers[0], signal.SIGKILL)

        found = run(tmp_path, executor=executor, tasks=tasks, batch_size=1, progress=kill_one)
    assert victims
    assert found == whole


def test_a_scheduler_that_is_not_there_is_an_error(monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("diransac.study.engine._CONNECTION_TIMEOUT", "0.2s")
    with (
        pytest.raises(dr.StudyError, match=r"no scheduler at tcp://127.0.0.1:9: .*dask scheduler"),
        connected("tcp://127.0.0.1:9"),
    ):
        pass
