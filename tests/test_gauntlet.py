"""Parts of the gauntlet: what is flown, what is true, and what is counted."""

import json
import os
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import gauntlet
import gauntlet_judging as judging
import gauntlet_methods as methods
import gauntlet_studies as studies
import numpy as np
import pytest

import diransac as dr
from diransac.study.store import Store
from diransac.study.trials import run_trials

WORST = {"servo-axis": "cogging", "double-pendulum": "ripple", "pendulum": "ripple"}


@cache
def recorded(vehicle, scenario="clean"):
    """A plant, and the data of its first trial."""
    study = studies.study_of(vehicle)
    return study.at(scenario).plant.plant, dr.study.trial_data(study, scenario)


def clean_log(vehicle):
    plant, data = recorded(vehicle)
    return plant, data.log


@pytest.mark.parametrize(("vehicle", "scenario"), [*((name, "clean") for name in studies.VEHICLES), *WORST.items()])
def test_the_best_parameters_are_the_plants_own_where_nothing_is_unknown_or_has_a_mean(vehicle, scenario):
    plant, data = recorded(vehicle, scenario)
    assert max(judging.relative(data.pseudo_true, plant.parameters).values()) < 1e-9
    assert len(data.clean_log) > 1900


@pytest.mark.parametrize(("vehicle", "scenario"), WORST.items())
def test_what_other_vehicles_do_not_know_shows_in_their_accelerations(vehicle, scenario):
    plant, data = recorded(vehicle, scenario)
    columns = [np.array([data.clean_log[name] for name in names]) for names in (plant.model.state, plant.model.inputs)]
    p = np.tile(np.array(list(plant.parameters.values()))[:, None], len(data.clean_log))
    known = np.array(plant.model.dynamics(*columns, p)[1])
    assert np.std(known - [data.clean_log[name] for name in plant.model.accelerations]) > 0.01


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_the_bound_is_that_of_a_parabola_where_the_answer_is_a_parabola(share):
    sledge = dr.Model(
        "sledge", {"s": "m"}, {"force": "N"}, {"mass": dr.Parameter("kg", positive=True)},
        lambda q, v, a, u, p: [p.mass * a.s - u.force],
    )  # fmt: skip
    time, one = np.arange(2000) * 0.01, np.ones(2000)
    columns = {"s": 0.5 * time**2, "s_dot": time, "s_ddot": one, "force": 2.0 * one}
    log = dr.Log.from_arrays(time, columns, sledge.units)
    noise = dr.Noise(acceleration_std=0.5, outlier_probability=share, outlier_magnitude=50.0)
    # Unknown are a, s0 and v0 of s = s0 + v0 t + a t^2 / 2, measured with sigma, sigma dt and sigma dt^2 / 2.
    slopes = [(0.5 * time**2, one, time), (time, 0 * one, one), (one, 0 * one, 0 * one)]
    information = sum(np.array(c) @ np.array(c).T / s**2 for c, s in zip(slopes, (2.5e-5, 5e-3, 0.5), strict=True))
    of_acceleration = np.sqrt(np.linalg.inv(information)[0, 0] / (1 - share))
    assert judging.cramer_rao(dr.Plant(sledge, {"mass": 2.0}), log, noise)["mass"] == pytest.approx(
        of_acceleration, rel=0.05
    )


@pytest.mark.parametrize("method", ["SciPy soft-L1", "SciPy Cauchy", "sklearn Huber", "sklearn RANSAC"])
def test_baselines_recover_a_clean_log(method):
    plant, log = clean_log("double-pendulum")
    found = methods.METHODS[method](plant.model, log).parameters
    assert max(judging.relative(found, plant.parameters).values()) < 1e-6


@pytest.mark.parametrize("method", ["SciPy soft-L1", "SciPy output error"])
def test_scipy_serves_models_that_are_not_affine_in_their_parameters(method):
    plant, log = clean_log("pendulum")
    found = methods.METHODS[method](plant.model, log).parameters
    assert max(judging.relative(found, plant.parameters).values()) < 1e-5


def test_output_error_leaves_out_what_is_missing_and_bears_some_outliers():
    plant = studies.study_of("pendulum").plant.plant
    swinging = dr.multisine(plant, seed=5, amplitude=0.8, frequency=0.7)
    log = dr.fly(plant, swinging, dr.tvlqr(plant, swinging), substeps=20)
    noise = dr.Noise(outlier_probability=0.02, outlier_magnitude=5.0, dropout_probability=0.01)
    spoilt = dr.corrupt(log, noise, 1)
    robust, plain = (methods.METHODS[name](plant.model, spoilt).parameters for name in ("SciPy output error", "nls"))
    assert max(judging.relative(robust, plant.parameters).values()) < 1e-3
    assert max(judging.relative(plain, plant.parameters).values()) > 0.05


def test_a_method_that_does_not_apply_is_counted_and_not_hidden():
    trial = judging.Trial("pendulum", "drawn", "clean", 0)
    record, other = judging.run(trial, ["ols", "nls"])
    assert "not affine" in record.refusal
    assert record.worst == np.inf
    assert other.worst < 1e-6
    assert all(other.covered.values())


def test_a_method_that_breaks_says_where(monkeypatch):
    def broken(model, log):
        raise KeyError("oops")

    monkeypatch.setitem(judging.METHODS, "broken", broken)
    with pytest.raises(KeyError) as caught:
        judging.run(judging.Trial("pendulum", "drawn", "clean", 0), ["broken"])
    assert "broken" in caught.value.__notes__[0]


def test_a_truer_model_flies_nearer_to_the_mission():
    plant, data = recorded("rotorcraft", "aerodynamic (physical)")
    assert judging.tracking("square", plant, data.pseudo_true, 0) < judging.tracking(
        "square", plant, plant.parameters, 0
    )
    assert judging.tracking("square", plant, {**data.pseudo_true, "mass": -1.0}, 0) == np.inf


def test_a_log_is_that_of_the_study():
    study = studies.study_of("servo-axis")
    (found,) = judging.run(judging.Trial("servo-axis", "drawn", "bursts", 2), ["ols"])
    data = dr.study.trial_data(study, "bursts", 2)
    result = dr.identify(dr.models.servo_axis(), data.log, "ols")
    assert found.errors == judging.relative(result.parameters, data.pseudo_true)
    assert not found.mismatch


@pytest.mark.parametrize(
    ("vehicle", "level", "flown"), [("rotorcraft", "aerodynamic (physical)", ["square"]), ("servo-axis", "cogging", [])]
)
def test_the_benchmark_judges_and_flies_what_the_study_does(vehicle, level, flown, tmp_path):
    study = studies.study_of(vehicle).subset(trials=1, levels=[level], methods=["ols", "tls"])
    with Store(tmp_path / "a.db", study) as kept:
        rows = run_trials(json.dumps(study.to_dict()), [(level, 0, label) for label in study.methods])
        kept.add(rows)
    found = dr.study.summarise(tmp_path / "a.db").estimates
    records = judging.run(judging.Trial(vehicle, "drawn", level, 0), study.methods)
    for k, (one, row) in enumerate(zip(records, rows, strict=True)):
        for name, error in one.errors.items():
            of_study = (found.errors[name], found.errors_to_true[name], found.covered[name])
            assert (error, one.errors_of_truth[name], one.covered[name]) == tuple(x[0, k, 0] for x in of_study)
        assert [one.differs, one.mismatch] == [found.differs[0], found.disturbed[0]]
        assert [one.tracking] * len(flown) == [np.hypot(row[f"{shape}_x"], row[f"{shape}_z"]) for shape in flown]


def test_what_has_no_estimate_differs_from_the_truth_like_the_others(monkeypatch):
    def refuse(model, log):
        raise ValueError("no")

    monkeypatch.setitem(judging.METHODS, "refuses", refuse)
    trial = judging.Trial("rotorcraft", "drawn", "aerodynamic (physical)", 0)
    refused, other = judging.run(trial, ["refuses", "ols"], fly=False)
    assert refused.differs
    assert other.differs


def test_a_star_is_flown_where_it_is_asked_for(monkeypatch):
    monkeypatch.setitem(judging.METHODS, "length", lambda model, log: methods.Estimate({"mass": len(log) * 0.249}))
    (found,) = judging.run(judging.Trial("rotorcraft", "star", "clean", 0), ["length"], fly=False)
    assert found.errors == {"mass": pytest.approx(len(dr.star(dr.models.extended_rotorcraft())) - 1)}


def test_names_have_no_commas():
    names = [
        *methods.METHODS,
        *studies.VEHICLES,
        *(name for one in studies.VEHICLES for name in studies.flights_of(one)),
    ]
    assert not any("," in name for name in names)


def test_jobs_find_what_one_trial_at_a_time_finds_and_in_order(monkeypatch, capsys):
    chosen = ["--vehicle", "servo-axis", "--scenario", "clean,outliers .1 x 80", "--methods", "tls,ols"]
    monkeypatch.setattr(gauntlet, "ProcessPoolExecutor", lambda jobs, _: ThreadPoolExecutor(jobs))
    monkeypatch.setattr(gauntlet.os, "environ", dict(os.environ))
    gauntlet.main([*chosen, "--jobs", "2", "--flight", "drawn", "--json"])
    done = capsys.readouterr()
    expected = [
        one for name in ("clean", "outliers .1 x 80")
        for one in judging.run(judging.Trial("servo-axis", "drawn", name, 0), ["ols", "tls"])
    ]  # fmt: skip
    found = json.loads(done.out)
    assert "2/2" in done.err
    assert [(one["trial"]["scenario"], one["method"]) for one in found] == [
        (one.trial.scenario, one.method) for one in expected
    ]
    assert [one["errors"] for one in found] == [one.errors for one in expected]


def record(worst, **changes):
    trial = judging.Trial("servo-axis", "drawn", "cogging", 0)
    errors = {"mass": worst} if np.isfinite(worst) else {}
    values = {
        "covered": {"mass": True},
        "differs": False,
        "tracking": np.nan,
        "tracking_of_truth": np.nan,
        "mismatch": True,
    }
    return judging.Record(trial, "ols", errors, errors, **{**values, "bound": {}, "seconds": 1.0, **changes})


def test_a_cell_is_the_median_and_the_worst_and_a_refusal_is_worse_than_any_number():
    table = "\n".join(gauntlet._tables([record(0.01), record(0.03), record(0.5)]))
    assert "| cogging |  | 3 [50] |" in table
    assert "against the truth" not in table
    refused = "\n".join(gauntlet._tables([record(0.01), record(0.03), record(np.inf, refusal="no", covered={})]))
    assert "| cogging |  | 3 [–] |" in refused
    assert "| ols |  | 1.00 of 2 | 1.00 | 1.00 | 1/3 |" in refused
