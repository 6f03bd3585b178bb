"""Studies that judge parameters, each trial by a flight of its own: what rows hold, and what a summary counts."""

import sqlite3
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import diransac as dr
from diransac.study import FlightChoice, export, load, read, status, trial_data, trials
from diransac.study import data as data_module
from diransac.study.data import derived_seed
from diransac.study.store import Store
from diransac.study.summary import summarise
from studies import OWN, OWN_PLANT, row, rows, tiny

NAMES = ("mass", "inertia", "drag")
DRAWN = tiny(
    data={"trajectory": "random-waypoints", "duration": 3.0, "seed": "random", "substeps": 3},
    methods={"true": {}, "ols": {}},
    evaluation={"trajectories": [], "parameters": True},
)


def run(tmp_path: Path, spec: dict = DRAWN, **options: object) -> dict[tuple, dict]:
    """Rows of a run in this process, which plans anew what an earlier run has planned."""
    data_module._steering.cache_clear()
    with ThreadPoolExecutor(1) as here:
        dr.run_study(spec, store=tmp_path / "a.db", executor=here, **options)
    return rows(tmp_path / "a.db")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple, dict]:
    """Rows of a run of all at once."""
    return run(tmp_path_factory.mktemp("whole"))


# Each trial its own flight ------------------------------------------------------------------------------------------
def test_rows_are_those_of_what_users_call(whole: dict):
    plant, seed = load(DRAWN).plant.plant, derived_seed(7, "40", 1)
    flight = dr.random_waypoints(plant, duration=3.0, seed=derived_seed(seed, "data plan"))
    log = dr.fly(plant, flight, dr.tvlqr(plant, flight), substeps=3)
    noise = dr.Noise(outlier_probability=0.1, outlier_magnitude=40.0)
    spoilt = dr.corrupt(log, noise, derived_seed(seed, "noise"), signals=plant.model.signals)
    found, row = dr.identify(plant.model, spoilt, "ols"), whole["40", 1, "ols"]
    for name, (low, high) in found.intervals(0.95).items():
        assert (row[f"parameter_{name}"], row[f"low_{name}"], row[f"high_{name}"]) == (
            found.parameters[name],
            low,
            high,
        )
        assert row[f"pseudo_true_{name}"] == pytest.approx(plant.parameters[name], rel=1e-9)


def test_the_data_of_a_trial_are_to_be_had_alone(whole: dict):
    data, row = trial_data(DRAWN, 40, trial=1), whole["40", 1, "ols"]
    result = dr.identify(dr.models.planar_rotorcraft(), data.log, "ols", settings=load(DRAWN).methods["ols"].settings)
    assert {name: row[f"parameter_{name}"] for name in NAMES} == dict(result.parameters)
    assert {name: row[f"pseudo_true_{name}"] for name in NAMES} == data.pseudo_true
    assert any(samples.any() for samples in data.log.fault_mask.values())
    assert not (data.clean_log["x"] == data.log["x"]).all()
    with pytest.raises(dr.SettingsError, match='no level "some" of outlier magnitude'):
        trial_data(DRAWN, "some")
    for trial in (-1, 1.5, True):
        with pytest.raises(dr.SettingsError, match=f"trial is {trial}; give a whole number from 0 to 10,000,000"):
            trial_data(DRAWN, 40, trial=trial)


def test_trials_fly_different_flights_and_methods_of_a_trial_the_same(whole: dict):
    scores = {key: row["fit_error"] for key, row in whole.items() if key[2] == "ols"}
    assert len(set(scores.values())) == 4
    for level, trial in {key[:2] for key in whole}:
        true, ols = (whole[level, trial, method] for method in ("true", "ols"))
        assert all(true[f"pseudo_true_{name}"] == ols[f"pseudo_true_{name}"] for name in NAMES)
        assert all(true[f"low_{name}"] is None for name in NAMES), "who knows the truth has no intervals"


def test_drawn_flights_are_the_same_in_whatever_company_and_order_and_after_an_end(whole: dict, tmp_path: Path):
    part = run(tmp_path, trials=1, levels=[40], methods=["ols"])
    assert part == {key: whole[key] for key in part}
    assert run(tmp_path, levels=[40, 0], batch_size=1) == whole


def test_a_flight_that_cannot_be_planned_fails_its_own_trial_alone(
    whole: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    unlucky, planned = derived_seed(derived_seed(7, "0", 1), "data plan"), FlightChoice.planned

    def sometimes(self: FlightChoice, plant: dr.Plant, seed: int, **options: object) -> dr.Trajectory:
        if seed == unlucky:
            raise dr.PlanningError("there is no way")
        return planned(self, plant, seed, **options)

    monkeypatch.setattr(FlightChoice, "planned", sometimes)
    found = run(tmp_path)
    lost = {key for key, row in found.items() if row["error"] == "there is no way"}
    assert lost == {("0", 1, "true"), ("0", 1, "ols")}
    assert all(row == whole[key] for key, row in found.items() if key not in lost)


def test_a_method_that_finds_nothing_is_still_judged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def nothing(*arguments: object, **more: object) -> dr.Result:
        raise dr.IdentificationError("nothing was found")

    monkeypatch.setattr(trials.Identification, "by", nothing)
    row = run(tmp_path, trials=1, levels=[0])["0", 0, "ols"]
    assert row["pseudo_true_mass"] == pytest.approx(0.249, rel=1e-9)
    estimates = summarise(tmp_path / "a.db").estimates
    assert estimates.worst.tolist() == [[[pytest.approx(0.0, abs=1e-9)], [np.inf]]]


def test_a_study_that_flies_nothing_has_a_status_and_is_exported(whole: dict, tmp_path: Path):
    run(tmp_path, trials=1, levels=[0])
    assert (status(tmp_path / "a.db").done, summarise(tmp_path / "a.db").flights) == (2, {})
    export(tmp_path / "a.db", tmp_path / "a.csv", "csv")
    assert {f"{kind}_{name}" for kind in ("pseudo_true", "low", "high") for name in NAMES} <= set(
        pl.read_csv(tmp_path / "a.csv").columns
    )


def test_a_study_that_judges_no_parameters_has_no_such_columns(tmp_path: Path):
    with Store(tmp_path / "a.db", load(tiny())) as kept:
        kept.add([row()])
    assert not [name for name in read(tmp_path / "a.db").columns if name.startswith(("pseudo_true", "low", "high"))]
    assert summarise(tmp_path / "a.db").estimates is None


# What a summary counts ----------------------------------------------------------------------------------------------
PUSHED = tiny(
    plant={"kind": "extended-rotorcraft", "parameters": {"mass": 0.25}},
    methods={"true": {}, "ols": {}},
    evaluation={"trajectories": [], "parameters": True},
    trials=3,
    axis={"name": "imbalance", "levels": {"none": {}, "some": {"plant.mass_imbalance": 1e-4}}},
)
BEST = {"none": {"mass": 0.25, "inertia": 0.004, "drag": 0.025}, "some": {"mass": 0.2, "inertia": 0.004, "drag": 0.025}}


def judged(level: str, trial: int, factors: dict[str, float], spread: float | None = None, method: str = "ols") -> dict:
    """A row whose parameters are the pseudo-true ones times factors, with intervals of that relative half-width."""
    best = BEST[level]
    found = {f"parameter_{name}": best[name] * factor for name, factor in factors.items()}
    ends = {} if spread is None else {
        f"{end}_{name}": found[f"parameter_{name}"] + sign * spread * best[name]
        for name in factors for end, sign in (("low", -1), ("high", 1))
    }  # fmt: skip
    return row(level, trial, method, **{f"pseudo_true_{name}": x for name, x in best.items()}, **found, **ends)


@pytest.fixture
def estimates(tmp_path: Path):
    same = {"mass": 1.0, "inertia": 1.0, "drag": 1.0}
    with Store(tmp_path / "a.db", load(PUSHED)) as kept:
        kept.add([judged("none", 0, {**same, "mass": 1.1, "drag": 0.7}, spread=0.2)])
        kept.add([judged("none", 1, {**same, "inertia": 1.02}, spread=0.0)])
        kept.add([judged("none", 2, {}) | {"status": "failed", "error": "no"}])
        kept.add([judged("some", 0, {**same, "mass": 1 + 5e-7}, spread=0.0), row("some", 1, status="failed")])
        kept.add([judged("some", 0, {**same, "mass": 1.25}, method="true")])
    return summarise(tmp_path / "a.db").estimates


def test_errors_are_relative_to_the_best_and_infinite_without_an_estimate(estimates):
    assert estimates.errors["drag"][0, 1] == pytest.approx([0.3, 0.0, np.inf])
    assert estimates.worst[0, 1] == pytest.approx([0.3, 0.02, np.inf])
    assert estimates.median(estimates.worst)[0, 1] == pytest.approx(0.3)
    assert estimates.largest(estimates.worst)[0, 1] == np.inf
    assert estimates.errors["inertia"][1, 1, 0] == pytest.approx(0.0)


def test_of_an_even_number_the_median_is_between_the_middle_two_or_infinite_if_one_of_them_is(estimates):
    errors = np.array([[[1.0, 3.0], [1.0, np.inf], [np.inf, np.inf]]])
    assert estimates.median(errors).tolist() == [[2.0, np.inf, np.inf]]


def test_a_trial_without_data_has_no_estimate_and_one_that_was_not_run_counts_neither_way(estimates):
    assert estimates.worst[1, 1, 1] == np.inf
    assert estimates.worst_to_true[1, 1, 1] == np.inf
    assert np.isnan(estimates.worst[1, 1, 2])
    assert np.isnan(estimates.worst[0, 0]).all(), "that of a method that was not run"
    assert np.isnan(estimates.median(estimates.worst)[0, 0])


def test_against_the_plants_own_it_is_another_error_where_the_best_ones_differ(estimates):
    assert estimates.differs.tolist() == [False, True]
    assert estimates.worst_to_true[1, 1, 0] == pytest.approx(0.2, rel=1e-5)
    assert estimates.worst_to_true[1, 0, 0] == pytest.approx(0.0)
    assert estimates.worst[1, 0, 0] == pytest.approx(0.25)


def test_intervals_are_counted_with_and_without_what_the_model_does_not_know(estimates):
    assert estimates.disturbed.tolist() == [False, True]
    assert estimates.coverage(disturbed=False) == [(0, 0), (4, 6)]
    assert estimates.coverage(disturbed=True) == [(0, 0), (3, 3)], "a millionth is no miss"


def test_a_parameter_that_is_zero_has_no_relative_error(tmp_path: Path):
    spec = tiny(plant={"kind": "planar-rotorcraft", "parameters": {"drag": 0.0}}, evaluation=DRAWN["evaluation"])
    with Store(tmp_path / "a.db", load(spec)) as kept:
        kept.add([judged("none", 0, {"mass": 1.5, "inertia": 1.0, "drag": 7.0}) | {"level": "0"}])
    found = summarise(tmp_path / "a.db").estimates
    assert np.isnan(found.errors["drag"]).all()
    assert found.worst[0, 1, 0] == pytest.approx(0.5)


# Where a user's file is not ------------------------------------------------------------------------------------------
@pytest.fixture
def of_a_users_plant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A store of two levels of a user's plant, asked for one after the other."""
    monkeypatch.chdir(tmp_path)
    Path("own.py").write_text(OWN_PLANT)
    values = {f"{kind}_{name}": 1.0 for kind in ("parameter", "pseudo_true") for name in "Mm"}
    for level in ("calm", "pulled"):
        with Store("a.db", load(OWN).subset(levels=[level])) as kept:
            kept.add([row(level, **values)])
    return tmp_path / "a.db"


@pytest.mark.slow
def test_a_store_is_reported_without_the_file_of_its_plant(of_a_users_plant: Path):
    store = of_a_users_plant
    store.with_name("own.py").unlink()
    command = [sys.executable, "-m", "diransac", "study", "report", store, "-o", "a.html"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=store.parent, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "<summary>M</summary>" in store.with_name("a.html").read_text()


def test_facts_of_a_plants_file_are_kept_and_the_file_is_not_run_for_them(of_a_users_plant: Path):
    noted = summarise(of_a_users_plant)
    assert noted.estimates.disturbed.tolist() == [False, True]
    assert noted.estimates.errors_to_true["M"][:, 0, 0] == pytest.approx([0.0, 0.5 / 1.5])
    assert noted.units == {"s": "m", "s_dot": "m/s"}
    connection = sqlite3.connect(of_a_users_plant)
    with connection:
        assert connection.execute("DELETE FROM about WHERE key = 'plants'").rowcount == 1
    connection.close()
    ran = Path("ran")
    Path("own.py").write_text(f"open({str(ran.absolute())!r}, 'x')\n")
    with pytest.raises(dr.StudyError, match="is damaged: KeyError"):
        summarise(of_a_users_plant)
    assert not ran.exists()
    Path("own.py").write_text(OWN_PLANT)
    for level in ("calm", "pulled"):
        with Store("a.db", load(OWN).subset(levels=[level])):
            pass
    anew = summarise(of_a_users_plant)
    assert (anew.units, anew.estimates.disturbed.tolist()) == (noted.units, [False, True])
