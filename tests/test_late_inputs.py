"""Where the model is exact, errors of single inputs are tested, too: one is late, and a common delay stands for it."""

from dataclasses import replace

import pytest

import diransac as dr
from late_inputs import MACHINES


def identified(name, seed, late, noise=1.0):
    """The result of a log, with sensors whose noise is several times as large."""
    machine = MACHINES[name]
    louder = replace(machine, logged={n: (k, noise * std) for n, (k, std) in machine.logged.items()})
    return dr.identify(louder.model, louder.log(seed, late), seed=0)


def inside(result, truth, intervals):
    """Names of parameters whose intervals hold the truth."""
    return {name for name, x in truth.items() if intervals[name][0] <= x <= intervals[name][1]}


@pytest.mark.parametrize("noise", [4.0, 8.0])
@pytest.mark.parametrize("seed", range(4))
def test_an_input_that_is_late_alone_is_named_alone(seed, noise):
    """A delay of all inputs makes this model exact within the noise, and lift and stiffness 3 % off."""
    found, truth = identified("wing", seed, {"elevator": 2}, noise), MACHINES["wing"].truth
    said = [x.claim for x in found.findings if "than recorded" in x.claim]
    assert len(said) == 1
    assert said[0].startswith("elevator acts")
    assert float(said[0].split("acts ")[1].split(" ms later")[0]) == pytest.approx(40.0, abs=1.0 * noise)
    assert all(abs(found.parameters[name] / x - 1.0) < 0.005 * noise for name, x in truth.items())
    assert inside(found, truth, found.structural_intervals(0.95)) == set(truth)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", ["valve", "load"])
def test_a_late_input_of_a_cylinder_is_named(name, seed):
    found, truth = identified("cylinder", seed, {name: 3}), MACHINES["cylinder"].truth
    said = [x.claim for x in found.findings if "than recorded" in x.claim]
    assert [x[: len(name) + 5] for x in said] == [f"{name} acts"]
    assert all(abs(found.parameters[n] / x - 1.0) < 0.003 for n, x in truth.items())


def test_inputs_that_are_late_together_are_so():
    found = identified("wing", 0, {"elevator": 2, "thrust": 2}, 4.0)
    assert [x.claim[:11] for x in found.findings if "than recorded" in x.claim] == ["Inputs act "]


@pytest.mark.parametrize("name", ["wing", "cylinder"])
@pytest.mark.parametrize("seed", range(4))
def test_punctual_inputs_have_no_errors(name, seed):
    found = identified(name, seed, None)
    assert found.verdict == "usable"
    assert not [x.claim for x in found.findings if "than recorded" in x.claim or "gain" in x.claim]
