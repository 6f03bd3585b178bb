"""How a random machine is judged: what intervals hold, and whether an answer is wrong without a warning.

Off, causes and "confidently wrong" are those of the benchmark of regimes (`benchmarks/regime_judging.py`), so that
shares compare: a parameter is more than 5 % off and outside its ordinary interval of 95 %, the verdict is not "do not
rely on this", and no finding against the result names a cause.  The reference is the machine's own parameters.
"""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from math import comb

import numpy as np

import diransac as dr
from acceptance.random_machines import log_of, machine, model_of

OFF = 5.0
"""Error of a parameter, %."""
CAUSES = re.compile(
    r"delay|earlier|later|\blate\b|\blag|drift|unmodelled force|unexplained|not identifiable|friction|payload|"
    r"do not rely|backlash|feedback|changes? (over|during|within) the log|disagree|on its bound|outside its bounds",
    re.IGNORECASE,
)
LONG_RUN = {"ordinary": 0.90, "structural": 0.93, "exact": 0.01, "wrong": 0.05}
"""Shares over 200 machines: least of values inside intervals, greatest of confident wrong answers."""


@dataclass(frozen=True)
class Judged:
    """What came of a machine.

    Parameters
    ----------
    seed, wrong : of the machine; "" where the model is exact
    verdict : of the result, "refused" or "crashed", with `told` the reason
    inside, structural : of parameters with finite intervals, whether they hold the value
    worst : parameters that are off and outside their ordinary interval, with their errors, %
    against : findings that oppose the result
    seconds : of the processor
    """

    seed: int
    wrong: str
    verdict: str
    inside: tuple[bool, ...] = ()
    structural: tuple[bool, ...] = ()
    worst: tuple[tuple[str, float], ...] = ()
    against: tuple[str, ...] = ()
    told: str = ""
    seconds: float = 0.0

    @property
    def names_cause(self) -> bool:
        """Whether a finding names a cause; a false alarm where the model is exact."""
        return any(CAUSES.search(text) for text in self.against)

    @property
    def confidently_wrong(self) -> bool:
        """Whether a parameter is off without a warning or a cause."""
        return bool(self.worst) and self.verdict != "do not rely on this" and not self.names_cause


def judged(seed: int) -> Judged:
    """Identify the machine of a seed by the default method, as a user does."""
    one = machine(seed)
    model, log = model_of(one), log_of(one)
    begin = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = dr.identify(model, log, differentiate=True)
    except dr.DiransacError as error:
        return Judged(seed, one.wrong, "refused", told=str(error), seconds=time.process_time() - begin)
    except Exception as error:  # noqa: BLE001 crashes are counted
        told = f"{type(error).__name__}: {error}"
        return Judged(seed, one.wrong, "crashed", told=told, seconds=time.process_time() - begin)
    seconds, truth = time.process_time() - begin, one.truth
    intervals = {name: ends for name, ends in result.intervals(0.95).items() if np.isfinite(ends).all()}
    wider = result.structural_intervals(0.95)
    inside = {name: bool(low <= truth[name] <= high) for name, (low, high) in intervals.items()}
    errors = {name: 100.0 * (result.parameters[name] / x - 1.0) for name, x in truth.items()}
    return Judged(
        seed, one.wrong, result.verdict, tuple(inside.values()),
        tuple(bool(wider[name][0] <= truth[name] <= wider[name][1]) for name in intervals),
        tuple((name, errors[name]) for name, held in inside.items() if not held and abs(errors[name]) > OFF),
        tuple(str(x) for x in result.findings if x.level in ("care", "bad")), seconds=seconds,
    )  # fmt: skip


@dataclass(frozen=True)
class Shares:
    """Values inside intervals, of how many, and confident wrong answers, of how many."""

    ordinary: tuple[int, int]
    structural: tuple[int, int]
    exact: tuple[int, int]
    wrong: tuple[int, int]

    @classmethod
    def of(cls, found: Sequence[Judged]) -> Shares:
        """Ordinary intervals count where the model is exact, structural ones everywhere."""
        exact, wrong = ([x for x in found if bool(x.wrong) == which] for which in (False, True))
        ordinary, structural = [i for x in exact for i in x.inside], [i for x in found for i in x.structural]
        return cls(
            (sum(ordinary), len(ordinary)), (sum(structural), len(structural)),
            (sum(x.confidently_wrong for x in exact), len(exact)),
            (sum(x.confidently_wrong for x in wrong), len(wrong)),
        )  # fmt: skip


def most(n: int, share: float, surely: float = 0.99) -> int:
    """Greatest number of n that a method with a true share exceeds once in a hundred times (binomial)."""
    below = 0.0
    for k in range(n + 1):
        below += comb(n, k) * share**k * (1.0 - share) ** (n - k)
        if below >= surely:
            return k
    return n
