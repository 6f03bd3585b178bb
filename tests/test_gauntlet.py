"""Parts of the gauntlet: what is flown, what is true, and what is counted."""

import json
import subprocess
import sys
from pathlib import Path

import gauntlet
import gauntlet_judging as judging
import gauntlet_methods as methods
import gauntlet_scenarios as scenarios
import gauntlet_vehicles as vehicles
import numpy as np
import pytest

import diransac as dr

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
OTHERS = [name for name in vehicles.VEHICLES if name != "rotorcraft"]


def clean_log(vehicle, flight="wander", **world):
    plant = vehicles.VEHICLES[vehicle].plant(**world)
    return plant, vehicles.recorded(vehicle, flight, plant, seed=3)


@pytest.mark.parametrize("vehicle", vehicles.VEHICLES)
def test_without_anything_unknown_the_best_parameters_are_the_plants_own(vehicle):
    plant, log = clean_log(vehicle)
    best = vehicles.effective_parameters(plant, log)
    assert max(judging.relative(best, plant.parameters).values()) < 1e-9
    assert len(log) > 2000


def test_excess_thrust_along_the_thrust_takes_a_known_share_of_the_best_mass():
    gamma, factor = 1.4e-6, 0.06 * 0.127**4  # C_T D^4
    plant, log = clean_log("rotorcraft", aerodynamic_imbalance=gamma)
    best = vehicles.effective_parameters(plant, log)
    assert best["mass"] == pytest.approx(0.249 / (1 + gamma / factor), rel=0.005)  # it acts along z, not the thrust
    assert best["inertia"] == pytest.approx(0.004, rel=1e-6)


def test_vibration_is_averaged_away_and_its_mean_is_kept():
    plant, log = clean_log("rotorcraft", mass_imbalance=1.4e-4)
    mean = vehicles.mean_accelerations(plant, log)
    model_alone = np.array(
        plant.model.dynamics(
            np.array([log[n] for n in plant.model.state]),
            np.array([log[n] for n in plant.model.inputs]),
            np.tile(np.array(list(plant.parameters.values()))[:, None], len(log)),
        )[1]
    ).T
    np.testing.assert_allclose(mean[:, 2], model_alone[:, 2], atol=1e-9)
    assert np.std(log["theta_ddot"] - mean[:, 2]) > 10.0
    np.testing.assert_allclose(mean[:, 1] - model_alone[:, 1], 2 * 1.4e-4 * 9.81 / 0.249, rtol=1e-6)


@pytest.mark.parametrize("vehicle", OTHERS)
def test_what_other_vehicles_do_not_know_pulls_to_and_fro_and_has_no_mean(vehicle):
    most = next(one for one in scenarios.SCENARIOS[vehicle] if one.world).world
    plant, log = clean_log(vehicle, **most)
    best = vehicles.effective_parameters(plant, log)
    assert max(judging.relative(best, plant.parameters).values()) < 1e-9
    calm = np.hypot.reduce(vehicles.mean_accelerations(plant, log), axis=1)
    assert np.std(calm - np.hypot.reduce([log[n] for n in plant.model.accelerations], axis=0)) > 0.01


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
    plant, log = clean_log("pendulum")
    noise = dr.Noise(outlier_probability=0.02, outlier_magnitude=5.0, dropout_probability=0.01)
    found = methods.METHODS["SciPy output error"](plant.model, dr.corrupt(log, noise, 1)).parameters
    assert max(judging.relative(found, plant.parameters).values()) < 1e-3


def test_a_method_that_does_not_apply_is_counted_and_not_hidden():
    trial = judging.Trial("pendulum", "wander", "clean", 0)
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
        judging.run(judging.Trial("pendulum", "wander", "clean", 0), ["broken"])
    assert "broken" in caught.value.__notes__[0]


def test_a_truer_model_flies_nearer_to_the_mission():
    mission = vehicles.VEHICLES["rotorcraft"].mission
    plant = vehicles.rotorcraft(aerodynamic_imbalance=1.8e-6)
    best = vehicles.effective_parameters(*clean_log("rotorcraft", aerodynamic_imbalance=1.8e-6))
    assert judging.tracking(mission, plant, best, 0) < judging.tracking(mission, plant, plant.parameters, 0)
    assert judging.tracking(mission, plant, {**best, "mass": -1.0}, 0) == np.inf


def test_faults_strike_about_a_fifth_of_the_samples():
    _, log = clean_log("servo-axis")
    for name in ("bursts", "frozen", "missing"):
        noise = next(one.noise for one in scenarios.SCENARIOS["servo-axis"] if one.name == name)
        shares = [np.mean([*dr.corrupt(log, noise, seed).planted.values()]) for seed in range(20)]
        assert np.mean(shares) == pytest.approx(0.2, abs=0.02)


def test_a_scenario_may_be_any_function_that_spoils_a_log(monkeypatch):
    def weak(log, seed):
        return dr.Log.from_arrays(log.time, {**log.signals, "force": log["force"] / 2}, log.units)

    monkeypatch.setitem(scenarios.SCENARIOS, "servo-axis", [scenarios.Scenario("weak", weak)])
    (found,) = judging.run(judging.Trial("servo-axis", "wander", "weak", 0), ["ols"])
    assert list(found.errors.values()) == pytest.approx([0.5] * 4)
    assert not found.bound


def test_names_are_unique_and_have_no_commas():
    names = [*methods.METHODS, *vehicles.VEHICLES]
    for some in scenarios.SCENARIOS.values():
        names += [one.name for one in some]
        assert len({one.name for one in some}) == len(some)
    assert not any("," in name for name in names)


def test_processes_find_what_one_process_finds_and_in_order():
    chosen = ["--vehicle", "servo-axis", "--scenario", "clean,outliers .1 x 80", "--methods", "tls,ols"]
    command = [sys.executable, str(BENCHMARKS / "gauntlet.py"), *chosen, "--jobs", "2", "--flight", "rush", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    expected = [
        one for name in ("clean", "outliers .1 x 80")
        for one in judging.run(judging.Trial("servo-axis", "rush", name, 0), ["ols", "tls"])
    ]  # fmt: skip
    found = json.loads(done.stdout)
    assert "2/2" in done.stderr
    assert [(one["trial"]["scenario"], one["method"]) for one in found] == [
        (one.trial.scenario, one.method) for one in expected
    ]
    assert [one["errors"] for one in found] == [one.errors for one in expected]


def record(worst, **changes):
    trial = judging.Trial("servo-axis", "wander", "cogging", 0)
    errors = {"mass": worst} if np.isfinite(worst) else {}
    values = {"covered": {"mass": True}, "tracking": np.nan, "tracking_of_truth": np.nan, "mismatch": True}
    return judging.Record(trial, "ols", errors, errors, **{**values, "bound": {}, "seconds": 1.0, **changes})


def test_a_cell_is_the_median_and_the_worst_and_a_refusal_is_worse_than_any_number():
    table = "\n".join(gauntlet._tables([record(0.01), record(0.03), record(0.5)]))
    assert "| cogging |  | 3 [50] |" in table
    assert "against the truth" not in table
    refused = "\n".join(gauntlet._tables([record(0.01), record(0.03), record(np.inf, refusal="no", covered={})]))
    assert "| cogging |  | 3 [–] |" in refused
    assert "| ols |  | 1.00 of 2 | 1.00 | 1.00 | 1/3 |" in refused
