"""Least squares and set-points as instruments, where a controller answers forces that the model lacks.

Run it as ``python benchmarks/feedback.py [--regimes "servo gusts fast,arm noisy"] [--seeds 1000:1008]``.  Regimes are
those below, in which disturbances are strong, and those of regime_flights.py.  docs/tables/method.md has figures.
"""

import argparse
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import regime_machines as machines
from regime_flights import REGIMES, Fault, Recording, Regime, gusts, recordings

import diransac as dr

_STRONG = {
    "rotor torque gusts 4x": (machines.ROTOR, (0.0, 0.0, 0.032), 0.05, 3.0),
    "rotor gusts 10x": (machines.ROTOR, (1.0, 1.0, 0.01), 0.05, 3.0),
    "rotor gusts fast": (machines.ROTOR, (1.0, 1.0, 0.02), 0.5, 5.0),
    "quad gusts fast": (machines.QUAD, (0.8, 0.8, 0.8, 0.02, 0.02, 0.01), 0.5, 5.0),
    "servo gusts fast": (machines.SERVO, (100.0,), 0.5, 3.0),
    "motor gusts": (machines.MOTOR, (0.15,), 0.1, 3.0),
    "motor gusts fast": (machines.MOTOR, (0.6,), 0.5, 5.0),
}
FEEDBACK = {
    name: Regime(name, machine, exact=False, fault=Fault(force=gusts(rms, low, high)))
    for name, (machine, rms, low, high) in _STRONG.items()
}
KNOWN = FEEDBACK | REGIMES
CHOSEN = (
    *FEEDBACK,
    *("rotor slight gusts", "rotor torque gusts", "rotor hover with gusts", "underwater waves"),
    *("rotor noise 1x", "motor noisy", "arm noisy", "motor backlash", "arm Stribeck", "rotor battery sag 15 %"),
)
"""Disturbances; exact models; models that lack something else."""


@dataclass(frozen=True)
class Run:
    """One log: errors, %, and whether 95 % intervals hold the truth, without and with set-points."""

    plain: Mapping[str, tuple[float, bool]]
    instrumented: Mapping[str, tuple[float, bool]]
    outcomes: Mapping[str, str]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table, row by row."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--regimes", default=",".join(CHOSEN), metavar="A,B", help="names; those of `CHOSEN` by default"
    )
    parser.add_argument("--seeds", default="1000:1008", metavar="A:B", help="from A to B - 1")
    chosen = parser.parse_args(arguments)
    begin, end = map(int, chosen.seeds.split(":"))
    titles = ["regime", "error %, least squares", "with set-points", "of rejected, least squares", "with set-points"]
    titles += ["coverage, least squares", "with set-points", "rejected", "differ", "passed", "weak"]
    print(f"| {' | '.join(titles)} |\n{'|---' * len(titles)}|")
    for name in chosen.regimes.split(","):
        runs = []
        for one in recordings(KNOWN[name], range(begin, end)):
            runs.append(run(KNOWN[name], one))
            print(name, runs[-1], file=sys.stderr, flush=True)
        print(f"| {' | '.join(row(name, runs))} |", flush=True)


def run(regime: Regime, recording: Recording) -> Run:
    """Both estimates from the log of one seed; they are the same where no test finds a difference."""
    log = dr.Log.from_arrays(recording.time, {**recording.columns, **recording.set_points})
    found = identified(regime, log, tuple(recording.set_points))
    tests = found.diagnosis.hausman_tests if found.diagnosis else ()
    outcomes = {x.parameter: x.outcome for x in tests}
    differs = any(x in ("rejected", "differs") for x in outcomes.values())
    plain = identified(regime, log, ()) if differs else found
    return Run(judged(plain, recording), judged(found, recording), outcomes)


def identified(regime: Regime, log: dr.Log, set_points: tuple[str, ...]) -> dr.Result:
    """Result of the default method."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return dr.identify(regime.machine.model, log, dr.LoDiransac(set_points=set_points), differentiate=True)


def judged(result: dr.Result, recording: Recording) -> dict[str, tuple[float, bool]]:
    """Error, %, of each parameter, and whether its interval holds the truth."""
    intervals = result.intervals(0.95)
    return {
        name: (100.0 * abs(result.parameters[name] / truth - 1.0), intervals[name][0] <= truth <= intervals[name][1])
        for name, truth in recording.truth.items()
    }


def row(name: str, runs: Sequence[Run]) -> list[str]:
    """Median error of all parameters, and of those that Hausman's test rejects; coverage; the tests' outcomes."""
    outcomes = [outcome for x in runs for outcome in x.outcomes.values()]
    every = [[(x.plain[n], x.instrumented[n]) for n in x.plain] for x in runs]
    rejected = [[(x.plain[n], x.instrumented[n]) for n, how in x.outcomes.items() if how == "rejected"] for x in runs]
    errors = [cell for some in (every, rejected) for cell in medians([pair for x in some for pair in x])]
    covered = [np.mean([pair[k][1] for x in every for pair in x]) for k in (0, 1)]
    counts = [str(outcomes.count(x)) for x in ("rejected", "differs", "passed", "weak")]
    return [name, *errors, *(f"{x:.2f}" for x in covered), *counts]


def medians(pairs: Sequence[tuple[tuple[float, bool], tuple[float, bool]]]) -> list[str]:
    """Median error without and with set-points, %."""
    return [f"{np.median([x[k][0] for x in pairs]):.2g}" if pairs else "–" for k in (0, 1)]


if __name__ == "__main__":
    main()
