"""Forty random machines by the default method: intervals hold the truth, and what is wrong is not said with confidence.

Bounds are those that a method with the shares of `random_judging.LONG_RUN` passes 99 times in 100, by the binomial
distribution; values of a machine are correlated, so that intervals are given the nominal 95 % in place of these.
`benchmarks/random_machines.py` holds 200 machines against the shares themselves.
"""

from functools import cache

import numpy as np
import pytest

from acceptance.random_judging import LONG_RUN, Judged, Shares, judged, most
from acceptance.random_machines import REPORTED, RESERVED, exact_rates, log_of, machine, model_of

QUICK = [seed for seed in REPORTED if not machine(seed).hidden][:40]
"""Without those that have a hidden state: each takes up to 40 s of a processor where the model is wrong."""


@cache
def found() -> list[Judged]:
    return [judged(seed) for seed in QUICK]


@pytest.mark.slow
def test_no_machine_ends_in_an_internal_error():
    assert [one.told for one in found() if one.verdict == "crashed"] == []


@pytest.mark.slow
@pytest.mark.parametrize("which", ["ordinary", "structural"])
def test_intervals_hold_the_values_of_machines(which):
    inside, n = getattr(Shares.of(found()), which)
    assert n > 80
    assert n - inside <= most(n, 0.05)


@pytest.mark.slow
@pytest.mark.parametrize("which", ["exact", "wrong"])
def test_wrong_answers_come_with_a_warning(which):
    sure, n = getattr(Shares.of(found()), which)
    assert sure <= most(n, LONG_RUN[which]), [one for one in found() if one.confidently_wrong]


def test_reported_and_reserved_seeds_are_apart_and_half_of_the_machines_have_the_exact_model():
    assert not set(REPORTED) & set(RESERVED)
    assert sum(not machine(seed).wrong for seed in QUICK) in range(15, 26)


def test_a_seed_draws_one_machine_and_one_log_and_each_machine_moves():
    for seed in QUICK[:10]:
        one, log = machine(seed), log_of(machine(seed))
        assert one == machine(seed)
        np.testing.assert_array_equal(log["q1"], log_of(one)["q1"])
        assert np.nanstd(log["q1"]) > 0.02 * one.amplitude


def test_the_models_equations_hold_along_an_exact_machines_motion():
    """Equations of the model and of the simulation, which are written apart, agree."""
    for seed in [x for x in QUICK if not machine(x).wrong][:10]:
        one = machine(seed)
        model, rng = model_of(one), np.random.default_rng(seed)
        x, u = rng.normal(size=2 * one.n), rng.normal(size=one.n)
        expected = np.array(exact_rates(one)([*x, 0.0], [*u], 0)[one.n : 2 * one.n])
        q, v, p = x[: one.n], x[one.n :], np.array(list(one.truth.values()))
        residual = model.regressor(q, v, expected, u)
        np.testing.assert_allclose(np.array(residual[0]) @ p, np.array(residual[1]).ravel(), rtol=1e-9, atol=1e-9)


def test_binomial_bounds():
    assert most(1, 0.5) == 1
    assert most(100, 0.05) == 11  # P(X <= 10) = .989, P(X <= 11) = .996
    assert most(20, 0.01) == 2
