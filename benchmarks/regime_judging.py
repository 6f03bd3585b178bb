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

    @property
    def worst(self) -> float:
        """Error of the worst parameter, %; infinite without an estimate."""
        return max((abs(x) for x in self.errors.values()), default=np.inf)

    @property
    def off(self) -> bool:
        """Whether a parameter is off by more than `WRONG` and outside its interval."""
        return any(abs(x) > WRONG and not self.inside.get(name, True) for name, x in self.errors.items())

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


def _lo(regime: Regime, seed: int, recording: Recording) -> Record:
    """The default method as a user runs it."""
    begin = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = dr.identify(regime.machine.model, recording.log, differentiate=True)
    except dr.DiransacError as error:
        return Record(regime.name, seed, "lo", refusal=str(error), seconds=time.process_time() - begin)
    except Exception as error:  # noqa: BLE001 a crash is what the benchmark counts
        where = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{type(error).__name__}: {error} (in {where.name})"
        return Record(regime.name, seed, "lo", refusal=text, crashed=True, seconds=time.process_time() - begin)
    seconds = time.process_time() - begin
    intervals, truth = result.intervals(0.95), recording.truth
    inside = {
        name: bool(low <= truth[name] <= high) for name, (low, high) in intervals.items() if np.isfinite(high - low)
    }
    verdict, findings = _said(result)
    errors = _errors(result.parameters, truth)
    return Record(regime.name, seed, "lo", errors, inside, verdict, findings, seconds=seconds)


def _said(result: dr.Result) -> tuple[str, tuple[str, ...]]:
    """Verdict and findings; from what is printed where the result has none."""
    if hasattr(result, "verdict"):
        return str(result.verdict), tuple(map(str, result.findings))
    warned = tuple(line.strip() for line in str(result).splitlines() if line.startswith("!"))
    findings = (*warned, *result.notes)
    if any("do not rely" in text for text in findings):
        return UNRELIABLE, findings
    return ("usable with care" if warned else "usable"), findings


def _errors(found: Mapping[str, float], truth: Mapping[str, float]) -> dict[str, float]:
    return {name: 100.0 * (found[name] - x) / abs(x) for name, x in truth.items()}


def _baseline(
    name: str, method: Callable[[Regime, Recording], Mapping[str, float]]
) -> Callable[[Regime, int, Recording], Record]:
    def judged(regime: Regime, seed: int, recording: Recording) -> Record:
        begin = time.process_time()
        try:
            found = method(regime, recording)
        except (NoBaselineError, np.linalg.LinAlgError, ValueError) as error:
            return Record(regime.name, seed, name, refusal=str(error), seconds=time.process_time() - begin)
        errors = _errors(found, recording.truth)
        return Record(regime.name, seed, name, errors, seconds=time.process_time() - begin)

    return judged


METHODS = {
    "lo": _lo,
    "ols": _baseline("ols", ordinary),
    "tls": _baseline("tls", total),
    "oe": _baseline("oe", output_error),
}
"""``(regime, seed, recording) -> Record`` by name."""
