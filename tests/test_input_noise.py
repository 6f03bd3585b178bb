"""Inputs that are measured with noise: it is a scale of the fit, printed beside the noise of signals."""

import json
from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
import regime_flights as flights
from noisy_inputs import MACHINES as NOISY

import diransac as dr
from diransac.data.dataset import Dataset
from diransac.identification.methods.lo_diransac.preparation import prepared
from late_inputs import MACHINES as LATE
from regime_logs import recorded


@cache
def identified(name, seed, noisy=True):
    """The result of a log of the benchmark."""
    return dr.identify(NOISY[name].model, NOISY[name].log(seed, noisy=noisy), seed=0)


def inside(result, truth, structural=False):
    """Number of parameters whose intervals hold the truth."""
    found = result.structural_intervals(0.95) if structural else result.intervals(0.95)
    return sum(found[name][0] <= x <= found[name][1] for name, x in truth.items())


@pytest.mark.parametrize("seed", [0, 2, 3])
def test_noise_of_a_measured_wind_is_found_and_intervals_hold(seed):
    """Intervals of a fit without it held 37 of 55 values; 33 of 33 have one outside with a probability of .82."""
    found, machine = identified("boat", seed), NOISY["boat"]
    for name, std in machine.input_noise.items():
        assert found.noise[name] == pytest.approx(std, rel=0.3)
    assert not {"thrust", "moment"} & set(found.noise)
    assert inside(found, machine.truth) >= 10
    assert inside(found, machine.truth, structural=True) >= 10


def test_noise_of_currents_is_found_to_a_few_per_cent_and_is_no_unexplained_force():
    found = identified("arm", 3)
    assert {n: found.noise[n] for n in ("current1", "current2")} == pytest.approx(NOISY["arm"].input_noise, rel=0.05)
    assert found.noise["q1_dot"] == pytest.approx(2e-3, rel=0.2)
    assert not [x for x in found.findings if "unexplained" in x.claim and x.level != "good"]
    assert [x for x in found.findings if x.level == "bad"] == []
    assert inside(found, NOISY["arm"].truth) >= 6


@pytest.mark.parametrize("name", list(NOISY))
def test_inputs_without_noise_have_none(name):
    found = identified(name, 0, noisy=False)
    assert not set(found.noise) & set(NOISY[name].model.inputs)
    assert set(found.noise) == set(NOISY[name].logged)


def test_noise_of_inputs_is_printed_and_kept(tmp_path):
    found = identified("arm", 3)
    assert ["current1", "0.1", "A"] in [x.split() for x in str(found).splitlines()]
    claim = "current2 is recorded with white noise of 0.1 A (RMS), which the estimate includes."
    assert claim in [x.claim for x in found.findings]
    found.save(tmp_path / "model.json")
    loaded = dr.Result.load(tmp_path / "model.json")
    assert loaded == found
    assert loaded.noise == found.noise
    dr.write_report(found, NOISY["arm"].log(3, noisy=True), tmp_path / "report.html")
    assert "current1" in (tmp_path / "report.html").read_text()


def test_results_from_before_are_read():
    found = identified("arm", 0, noisy=False)
    data = json.loads(json.dumps(found.to_dict()))
    del data["diagnosis"]["input_noise"]
    assert dr.Result.from_dict(data).noise == found.noise


@pytest.mark.parametrize("name", ["motor backlash", "pendulum Coulomb friction", "motor dead band", "arm Stribeck"])
def test_what_a_model_lacks_is_no_noise_of_its_input(name):
    regime = flights.REGIMES[name]
    result = dr.identify(regime.machine.model, recorded(regime, 1002).log, seed=0)
    assert not set(result.noise) & set(regime.machine.model.inputs)


@pytest.mark.parametrize(("name", "late", "noise"), [("wing", "elevator", 0.005), ("cylinder", "valve", 0.04)])
@pytest.mark.parametrize("seed", range(2))
def test_a_noisy_input_that_is_late_has_a_delay_not_a_lag_which_would_average_its_noise(name, late, noise, seed):
    machine, samples = LATE[name], {"wing": 2, "cylinder": 3}[name]
    log, rng = machine.log(seed, {late: samples}), np.random.default_rng(seed)
    columns = {n: np.asarray(log[n]) for n in (*machine.logged, *machine.model.inputs)}
    columns[late] = columns[late] + noise * rng.standard_normal(len(log))
    found = dr.identify(machine.model, dr.Log.from_arrays(log.time, columns), seed=0)
    timing = found.estimate.resolution.timing
    assert timing.own_delays[list(machine.model.inputs).index(late)] == pytest.approx(samples * machine.dt)
    assert not timing.lag
    assert not any(timing.own_lags)
    assert found.noise[late] == pytest.approx(noise, rel=0.25)
    assert inside(found, machine.truth, structural=True) >= 4


def test_errors_of_inputs_act_as_other_inputs_would():
    machine = NOISY["arm"]
    dataset = Dataset.of(machine.model, machine.log(0, noisy=False), pointwise=False)
    intervals = prepared(dr.LoDiransac(), dataset)[0]
    noisy = replace(intervals, noisy=True, discrepancies=False)
    rng = np.random.default_rng(0)
    x, p = 0.1 * rng.standard_normal((len(intervals), 4)), np.array(list(machine.truth.values()))
    e = rng.standard_normal((len(intervals), 2))
    other = replace(intervals, recorded=intervals.recorded + np.repeat(e, intervals.length, axis=0))
    by_errors = noisy.simulated(p, x, e)[1]
    by_inputs = replace(other, discrepancies=False).simulated(p, x, np.zeros_like(e))[1]
    np.testing.assert_allclose(by_errors, by_inputs, rtol=1e-9, atol=1e-12)


def test_a_model_without_inputs_that_something_pushes_is_identified():
    model = dr.Model(
        "free pendulum", {"q": "rad"}, {}, {"k": dr.Parameter("1/s^2"), "d": dr.Parameter("1/s")},
        lambda q, v, a, u, p: [a.q + p.k * ca.sin(q.q) + p.d * v.q],
    )  # fmt: skip
    rng, h, (q, v), states = np.random.default_rng(0), 1e-3, (1.0, 0.0), []
    for _ in range(1500):
        states.append((q, v))
        push = 2.0 * rng.standard_normal()
        for _ in range(10):  # semi-implicit Euler
            v += h * (push - 9.0 * np.sin(q) - 0.2 * v)
            q += h * v
    y = np.array(states) + 1e-3 * rng.standard_normal((1500, 2))
    found = dr.identify(model, dr.Log.from_arrays(0.01 * np.arange(1500), {"q": y[:, 0], "q_dot": y[:, 1]}), seed=0)
    assert found.parameters["k"] == pytest.approx(9.0, rel=0.05)
    assert set(found.noise) == {"q", "q_dot"}
