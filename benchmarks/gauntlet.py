"""The gauntlet with other people's methods: vehicles x scenarios x seeds x methods.

Run it as ``python benchmarks/gauntlet.py [--vehicle pendulum] [--scenario clean,bursts] [--methods ols,tls]``;
The logs are those of the studies that the package brings, ``diransac study run gauntlet``, trial by trial;
docs/benchmarks.md says what the tables mean, and how a method or a scenario is added.
"""

import argparse
import dataclasses
import json
import math
import multiprocessing
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from statistics import median

from gauntlet_judging import Record, Trial, run
from gauntlet_methods import METHODS
from gauntlet_studies import DRAWN, VEHICLES, flights_of, scenarios_of


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables, or JSON."""
    chosen = _parsed(arguments)
    trials = list(_trials(chosen))
    records = sorted(_run_all(trials, chosen.methods, chosen.jobs), key=_place)
    text = _as_json(records) if chosen.json else "\n\n".join(_tables(records)) + "\n"
    if chosen.output:
        chosen.output.write_text(text)
    sys.stdout.write(text)


def _parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    flights = dict.fromkeys(name for vehicle in VEHICLES for name in flights_of(vehicle))
    scenarios = dict.fromkeys(name for vehicle in VEHICLES for name in scenarios_of(vehicle))
    for option, known in (("vehicle", VEHICLES), ("flight", flights), ("scenario", scenarios), ("methods", METHODS)):
        parser.add_argument(f"--{option}", type=_names_of(known), metavar="A,B", help=f"of {', '.join(known)}")
    parser.add_argument("--seeds", type=int, default=1, help="logs of each flight and scenario (1)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes, of one thread each")
    parser.add_argument("-o", "--output", type=Path, help="a file to write the same to")
    parser.add_argument("--json", action="store_true", help="every record instead of tables")
    chosen = parser.parse_args(arguments)
    chosen.methods = chosen.methods or list(METHODS)
    if not list(_trials(chosen)):
        parser.error("nothing to run: no vehicle chosen has such a flight and scenario")
    return chosen


def _names_of(known: Iterable[str]) -> Callable[[str], list[str]]:
    """A parser of names, separated by commas, in the order in which they are known."""

    def names(text: str) -> list[str]:
        given = text.split(",")
        unknown = [name for name in given if name not in known]
        if unknown:
            raise argparse.ArgumentTypeError(f'there is no "{unknown[0]}"; there are {", ".join(known)}')
        return [name for name in known if name in given]

    return names


# ---------------------------------------------------------------------- the loop


def _trials(chosen: argparse.Namespace) -> Iterable[Trial]:
    """Every log that is asked for; flights that others have tuned on only by name."""
    for vehicle in chosen.vehicle or VEHICLES:
        for flight in chosen.flight or [DRAWN]:
            for scenario in scenarios_of(vehicle):
                if flight in flights_of(vehicle) and (not chosen.scenario or scenario in chosen.scenario):
                    yield from (Trial(vehicle, flight, scenario, seed) for seed in range(chosen.seeds))


def _run_all(trials: Sequence[Trial], methods: Sequence[str], jobs: int) -> list[Record]:
    """Every method on every log, in processes of one thread each; says on stderr how far it is."""
    one_thread = ("DIRANSAC_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    os.environ.update(dict.fromkeys(one_thread, "1"))
    records = list[Record]()
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        waiting = [pool.submit(run, trial, methods) for trial in trials]
        try:
            for k, done in enumerate(as_completed(waiting), start=1):
                records += done.result()
                trial = records[-1].trial
                print(
                    f"{k}/{len(trials)} {trial.vehicle}, {trial.flight}, {trial.scenario}", file=sys.stderr, flush=True
                )
        except BaseException:
            pool.shutdown(cancel_futures=True)  # a method that breaks ends the run now, not after the other logs
            raise
    return records


def _place(record: Record) -> tuple[int, ...]:
    """Where a record stands, whenever it was finished."""
    trial = record.trial
    scenario, flight = scenarios_of(trial.vehicle).index(trial.scenario), flights_of(trial.vehicle).index(trial.flight)
    order = (list(VEHICLES).index(trial.vehicle), scenario, flight)
    return (*order, trial.seed, list(METHODS).index(record.method))


# ---------------------------------------------------------------------- what is shown


def _tables(records: Sequence[Record]) -> Iterable[str]:
    """Markdown: errors and flights of each vehicle, then what each method costs, and how far it can be trusted."""
    for vehicle in dict.fromkeys(one.trial.vehicle for one in records):
        some = [one for one in records if one.trial.vehicle == vehicle]
        flights = ", ".join(dict.fromkeys(one.trial.flight for one in some))
        yield f"### {vehicle} ({flights}): error of the worst parameter, %, median [worst]"
        yield _by_scenario(some, ("bound, %", _bound), _error_rows)
        if any(not math.isnan(one.tracking) for one in some):
            yield f"### {vehicle} ({flights}): distance from the mission flown with what was identified, RMS, cm"
            yield _by_scenario(some, ("with the truth", _tracking_of_truth), _tracking_row)
    yield "### Methods: share of 95 % intervals that hold the best parameter; seconds a log"
    yield _of_methods(records)


Rows = Callable[[Sequence[Sequence[Record]]], Iterable[tuple[str, list[str]]]]


def _by_scenario(
    records: Sequence[Record], reference: tuple[str, Callable[[Sequence[Record]], str]], rows_of: Rows
) -> str:
    """A row, or some, a scenario; a column a method."""
    methods = list(dict.fromkeys(one.method for one in records))
    rows = [["scenario", reference[0], *methods]]
    for scenario in dict.fromkeys(one.trial.scenario for one in records):
        some = [one for one in records if one.trial.scenario == scenario]
        for suffix, cells in rows_of([[one for one in some if one.method == method] for method in methods]):
            rows.append([scenario + suffix, reference[1](some), *cells])
    return _markdown(rows)


def _error_rows(by_method: Sequence[Sequence[Record]]) -> Iterable[tuple[str, list[str]]]:
    yield "", [_spread([100.0 * one.worst for one in some]) for some in by_method]
    if any(one.differs for some in by_method for one in some):
        yield ", against the truth", [_spread([100.0 * one.worst_of_truth for one in some]) for some in by_method]


def _tracking_row(by_method: Sequence[Sequence[Record]]) -> Iterable[tuple[str, list[str]]]:
    yield "", [_spread([100.0 * one.tracking for one in some]) for some in by_method]


def _bound(records: Sequence[Record]) -> str:
    """Cramer-Rao's standard deviation of the worst parameter."""
    bounds = [100.0 * max(one.bound.values()) for one in records if one.bound]
    return f"{median(bounds):.2g}" if bounds else ""


def _tracking_of_truth(records: Sequence[Record]) -> str:
    return _number(100.0 * median(one.tracking_of_truth for one in records))


def _of_methods(records: Sequence[Record]) -> str:
    rows = [["method", "as the model says", "with what it doesn't know", "median s", "largest s", "no estimate"]]
    for method in dict.fromkeys(one.method for one in records):
        some = [one for one in records if one.method == method]
        seconds = [one.seconds for one in some if not one.refusal]
        cells = [_coverage([one for one in some if one.mismatch == mismatch]) for mismatch in (False, True)]
        times = [f"{x:.2f}" for x in (median(seconds), max(seconds))] if seconds else ["–", "–"]
        rows.append([method, *cells, *times, f"{sum(bool(one.refusal) for one in some)}/{len(some)}"])
    return _markdown(rows)


def _coverage(records: Sequence[Record]) -> str:
    covered = [holds for one in records for holds in one.covered.values()]
    return f"{sum(covered) / len(covered):.2f} of {len(covered)}" if covered else ""


def _spread(values: Sequence[float]) -> str:
    """Median [worst]."""
    return f"{_number(median(values))} [{_number(max(values))}]"


def _number(x: float) -> str:
    """Two figures; 0 below 0.001, a dash where there is none."""
    if not math.isfinite(x):
        return "–"
    if x < 0.001:
        return "0"
    return f"{x:.2g}" if x < 9.95 else f"{x:.0f}" if x < 999.5 else f"{x:.0e}"


def _markdown(rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])


def _as_json(records: Sequence[Record]) -> str:
    """Every record; null where a number is not finite."""

    def plain(value: object) -> object:
        if isinstance(value, dict):
            return {name: plain(x) for name, x in value.items()}
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps([plain(dataclasses.asdict(one)) for one in records], indent=1, allow_nan=False) + "\n"


if __name__ == "__main__":
    main()
