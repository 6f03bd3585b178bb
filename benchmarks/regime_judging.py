"""How a regime is judged: one log, one method, its errors, and what a user was told.

Nothing happens when this file is run.
"""

import re
import time
import traceback
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from regime_baselines import NoBaselineError, ordinary, total
from regime_flights import REGIMES, Recording, Regime, recordings
from regime_output_error import output_error

import diransac as dr

WRONG = 5.0
"""Error of a parameter, %, from which a result that says nothing is confidently wrong."""
UNRELIABLE = "do not rely on this"
CAUSES = re.compile(
    r"delay|earlier|later|\blate\b|\blag|drift|unmodelled force|unexplained|not identifiable|friction|payload|"
    r"do not rely|backlash|feedback|changes? (over|during|within) the log|disagree|on its bound|outside its bounds",
    re.IGNORECASE,
)
"""Words of findings that name a cause."""


@dataclass(frozen=True)
class Record:
    """What one method made of one log.

    Parameters
    ----------
    regime, seed, method : which
    errors : by parameter, %, signed; empty without an estimate
    inside : by parameter, whether its 95 % interval holds the truth; empty without intervals
    verdict : of three; empty of baselines
    findings : sentences that a user is told
    refusal : why there is no estimate
    crashed : whether it ended in an error that is not the package's own
    seconds : of the processor
    inside_structural : by parameter, whether the interval of a model that may lack a term holds the truth
    widening : by parameter, width of that interval over the 95 % interval
    """

    regime: str
    seed: int
    method: str
    errors: Mapping[str, float] = field(default_factory=dict)
    inside: Mapping[str, bool] = field(default_factory=dict)
    verdict: str = ""
    findings: tuple[str, ...] = ()
    refusal: str = ""
    crashed: bool = False
    seconds: float = 0.0
    inside_structural: Mapping[str, bool] = field(default_factory=dict)
    widening: Mapping[str, float] = field(default_factory=dict)

    @property
    def worst(self) -> float:
        """Error of the worst parameter, %; infinite without an estimate."""
        return max((abs(x) for x in self.errors.values()), default=np.inf)

    @property
    def off(self) -> bool:
        """Whether a parameter is off by more than `WRONG` and outside its interval."""
        return self._outside(self.inside)

    @property
    def off_structurally(self) -> bool:
        """Whether a parameter is off by more than `WRONG` and outside the interval of a model that may lack a term."""
        return self._outside(self.inside_structural)

    def _outside(self, inside: Mapping[str, bool]) -> bool:
        return any(not abs(x) <= WRONG and not inside.get(name, True) for name, x in self.errors.items())

    @property
    def names_cause(self) -> bool:
        """Whether a finding names a cause; a false alarm where the model is exact."""
        return any(CAUSES.search(text) for text in self.findings)

    @property
    def confidently_wrong(self) -> bool:
        """Whether the result is off, its verdict does not warn of it, and no cause is named."""
        return self.off and self.verdict != UNRELIABLE and not self.names_cause


def judge(regime: str, seed: int, seeds: Sequence[int], methods: Sequence[str]) -> list[Record]:
    """Let every method at the log of one seed; those of all seeds are simulated at once, and kept for the next call."""
    chosen = REGIMES[regime]
    log = _recordings(regime, tuple(seeds))[seeds.index(seed)]
    return [METHODS[method](chosen, seed, log) for method in methods]


@lru_cache(maxsize=1)
def _recordings(regime: str, seeds: tuple[int, ...]) -> list[Recording]:
    return recordings(REGIMES[regime], seeds)


Method = Callable[[Regime, Recording], dict[str, Any]]
"""Fields of a `Record` that an estimate has."""


def _judged(name: str, method: Method) -> Callable[[Regime, int, Recording], Record]:
    """A method whose refusals and crashes are recorded, as is its time."""

    def judged(regime: Regime, seed: int, recording: Recording) -> Record:
        begin = time.process_time()
        try:
            outcome = method(regime, recording)
        except (dr.DiransacError, NoBaselineError) as error:
            outcome = {"refusal": str(error)}
        except Exception as error:  # noqa: BLE001 crashes are counted
            where = traceback.extract_tb(error.__traceback__)[-1].name
            outcome = {"refusal": f"{type(error).__name__}: {error} (in {where})", "crashed": True}
        return Record(regime.name, seed, name, seconds=time.process_time() - begin, **outcome)

    return judged


def _lo(regime: Regime, recording: Recording) -> dict[str, Any]:
    """The default method as a user runs it, and what it says."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = dr.identify(regime.machine.model, recording.log, differentiate=True)
    truth, intervals = recording.truth, result.intervals(0.95)
    finite = {name: pair for name, pair in intervals.items() if np.isfinite(pair).all()}
    structural = {name: pair for name, pair in result.structural_intervals(0.95).items() if name in finite}
    verdict, findings = _said(result)
    return {
        "errors": _errors(result.parameters, truth),
        "inside": _inside(finite, truth),
        "inside_structural": _inside(structural, truth),
        "widening": {n: (high - low) / (finite[n][1] - finite[n][0]) for n, (low, high) in structural.items()},
        "verdict": verdict,
        "findings": findings,
    }


def _inside(intervals: Mapping[str, tuple[float, float]], truth: Mapping[str, float]) -> dict[str, bool]:
    return {name: bool(low <= truth[name] <= high) for name, (low, high) in intervals.items()}


def _said(result: dr.Result) -> tuple[str, tuple[str, ...]]:
    """Verdict, and the findings against the result: a sentence in its favour names no cause."""
    return result.verdict, tuple(str(x) for x in result.findings if x.level in ("care", "bad"))


def _errors(found: Mapping[str, float], truth: Mapping[str, float]) -> dict[str, float]:
    return {name: 100.0 * (found[name] - x) / abs(x) for name, x in truth.items()}


def _baseline(method: Callable[[Regime, Recording], Mapping[str, float]]) -> Method:
    return lambda regime, recording: {"errors": _errors(method(regime, recording), recording.truth)}


METHODS = {
    name: _judged(name, method)
    for name, method in {
        "lo": _lo,
        "ols": _baseline(ordinary),
        "tls": _baseline(total),
        "oe": _baseline(output_error),
    }.items()
}
"""``(regime, seed, recording) -> Record`` by name."""
