"""Ablation of lo-diransac: what each part contributes, on real records, regimes, further machines, and a flight.

``python benchmarks/ablation.py [--parts observers,"least squares+simulation error"] [--seeds 1000:1001]
[--records emps,go2-RL] [--out rows.jsonl] [--table FILE]``

Every run is repeated without one part at a time, or without several that `+` joins: by a setting where there is one,
else by a patch of the function that does the part's work. Rows are written as they are measured, and a run that is
repeated with the same ``--out`` goes on from them. The table has, for each part, the geometric mean of the ratio of
errors without and with it, and the runs whose error changes by more than a tenth, better or worse. Errors are
held-out ones of real records (`real`), and those of the worst parameter elsewhere: relative to the truth in regimes and
for the machines of ``../shared/cases`` (`machines`), to least squares of the noise-free flight in the corrupted ones.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from gauntlet_studies import study_of
from real import DATA, RECORDS, Record, logs_of, scores_of
from regime_flights import REGIMES, recordings

import diransac as dr
from diransac.study import trial_data
from simulated import MACHINES, as_log, flight

METHOD = "diransac.identification.methods.lo_diransac"
CORE, IN_CORE = "diransac.identification.core", ("minimise._CORRECTED",)
DEFAULT = dr.LoDiransac()
REAL = "pendulum-A0-one-run,emps,silverbox,crazyflie-log15,go2-RL,go2-RR"
CHANGED, LEAST = 0.1, 1e-4
Arrays = tuple[np.ndarray, np.ndarray]
Row = dict[str, Any]


@dataclass(frozen=True)
class Part:
    """What is left out: by the settings of the method, and by patches of functions and constants."""

    settings: dr.LoDiransac = DEFAULT
    patches: tuple[tuple[str, object], ...] = ()

    def left_out(self) -> list[AbstractContextManager[object]]:
        """Contexts in which the part is missing."""
        places = {name: f"{CORE if name in IN_CORE else METHOD}.{name}" for name, _ in self.patches}
        return [patch(places[name], value) for name, value in self.patches]

    def __add__(self, other: Part) -> Part:
        """Both parts left out."""
        values = ((x.name, getattr(other.settings, x.name)) for x in fields(DEFAULT))
        changed = {name: value for name, value in values if value != getattr(DEFAULT, name)}
        return Part(replace(self.settings, **changed), self.patches + other.patches)


def _parts() -> dict[str, Part]:
    least_squares = Part(patches=(("competition.least_squares_candidates", lambda *_: ()),))
    simulation_error = Part(patches=(("competition.simulation_error_candidates", lambda *_, **__: []),))
    off = {"input_delay": False, "input_lag": False, "sensor_delays": (), "sensor_biases": (), "gain_drifts": ()}
    return {
        "nothing": Part(),
        "random samples": Part(replace(DEFAULT, n_samples=0)),
        "outlier component of the noise": Part(replace(DEFAULT, outliers=False)),
        "unmodelled accelerations": Part(replace(DEFAULT, model_error=False)),
        "input gain and bias discrepancy": Part(replace(DEFAULT, prior_discrepancy=1e-6)),
        "finer intervals": Part(patches=(("local_search.fewest_parts", lambda _: 0),)),
        "errors of recordings": Part(replace(DEFAULT, **off)),
        "errors must explain forces": Part(
            patches=(
                ("local_search._EXPLAINS", -np.inf),
                ("local_search._EXPLAINS_DRIFT", -np.inf),
            )
        ),
        "screening": Part(patches=(("preparation.stuck_rows", lambda x: np.zeros(len(x), bool)),)),
        "robust loss of the projection": Part(patches=(("projection.CAUCHY", None),)),
        "observers": Part(patches=(("search.with_observed_states", lambda *_: None),)),
        "least squares": least_squares,
        "simulation error": simulation_error,
        "second fit": Part(patches=(("competition.Contest.is_challenged", lambda *_: False),)),
        "competition": least_squares + simulation_error,
        "outliers by predictions": Part(
            patches=(("forward.Forward.without_lost", lambda x, _: replace(x, lost=x.outliers_of_fit)),)
        ),
        "prediction of forces": Part(patches=(("judge._EXPLAINED", 0.0),)),
        "prediction of whole logs": Part(patches=(("forward._LONGEST", 0),)),
        "second-order correction of steps": Part(patches=(("minimise._CORRECTED", 0.0),)),
        "fewer integration steps": Part(patches=(("integration_steps._FEW", ()),)),
    }


# ---------------------------------------------------------------------- runs: a name, and an identification's error
Run = Callable[[dr.LoDiransac], float]


def real_runs(names: Sequence[str]) -> Iterator[tuple[str, Run]]:
    """Real records by held-out error; none where they are missing."""
    if not DATA.is_dir():
        print(f"{DATA} is missing: no real records", file=sys.stderr)
        return
    for name in names:
        yield f"real/{name}", partial(_real, RECORDS[name](DATA))


def _real(record: Record, method: dr.LoDiransac) -> float:
    """Held-out error of a real record."""
    found = dr.identify(record.model, logs_of(record), method, differentiate=True)
    resolution = found.estimate.resolution
    inputs = {"hold": resolution.hold, "delay": resolution.timing.delay, "lag": resolution.timing.lag}
    return float(scores_of(record, {"parameters": found.parameters, "inputs": inputs})["error"])


def regime_runs(seeds: Sequence[int]) -> Iterator[tuple[str, Run]]:
    """Regimes by the error of the worst parameter."""
    for name, regime in REGIMES.items():
        for seed, recording in zip(seeds, recordings(regime, list(seeds)), strict=True):
            kind = "exact" if regime.exact else "mismatched"
            yield f"{kind}/{name}/{seed}", partial(_error, regime.machine.model, recording.log, recording.truth)


def _error(model: dr.Model, log: dr.Log | list[dr.Log], truth: Mapping[str, float], method: dr.LoDiransac) -> float:
    """Relative error of the worst parameter."""
    found = dr.identify(model, log, method, differentiate=True).parameters
    return max(abs(found.get(name, np.inf) / x - 1.0) for name, x in truth.items())


def machine_runs(seeds: Sequence[int]) -> Iterator[tuple[str, Run]]:
    """Machines that nothing was developed on by the error of the worst parameter; none where they are missing."""
    cases = DATA.parent / "cases"
    if not cases.is_dir():
        print(f"{cases} is missing: no further machines", file=sys.stderr)
        return
    sys.path.insert(0, str(cases))
    from four_machines_run import MACHINES as FURTHER
    from four_machines_run import REGIMES as FAULTS
    from four_machines_run import recorded

    for name, faults in FAULTS.items():
        machine = FURTHER[name]
        for label, fault in faults.items():
            constants = {k: x * fault["wrong"].get(k, 1.0) for k, x in machine.constants.items()}
            for seed in seeds:
                logs, truth = [], {}
                for k in range(len(machine.logs)):
                    flown, columns = recorded(machine, fault, seed, k)
                    inputs = dict(zip(machine.inputs, flown.u.T, strict=True))
                    logs.append(dr.Log.from_arrays(flown.t, {**columns, **inputs}))
                    truth |= {x: flown.p[x] for x in machine.truth if x not in machine.per_log}
                run = partial(_error, machine.model(constants), logs, truth)
                yield f"machines/{name}/{label}/{seed}", run


def corrupted_runs(seeds: Sequence[int]) -> Iterator[tuple[str, Run]]:
    """A flight of the planar rotorcraft with outliers, leverage, the noise of Table III, stuck samples, and a lift.

    Leverage of a double pendulum is that of the robustness benchmark (`gauntlet`): a fit follows outliers there.
    """
    machine, model, dt = MACHINES["planar-rotorcraft"], dr.models.planar_rotorcraft(), 0.01
    clean, lifted = (flight(x, 2500, dt) for x in (machine, replace(machine, acceleration=_lifted)))
    regressors, known = machine.rows(*lifted)
    least_squares = np.linalg.lstsq(regressors.reshape(-1, 3), known.ravel())[0]
    pseudo_true = dict(zip(machine.truth, least_squares.tolist(), strict=True))
    for name, corrupt in CORRUPTIONS.items():
        for seed in seeds:
            signals, inputs = corrupt(*(lifted if name == "lift" else clean), np.random.default_rng(seed))
            truth = pseudo_true if name == "lift" else machine.truth
            log = as_log(machine, signals, inputs, dt)
            yield f"corrupted/{name}/{seed}", partial(_error, model, log, truth)
    pendulum = study_of("double-pendulum")
    for seed in seeds:
        data = trial_data(pendulum, "leverage", seed)
        run = partial(_error, pendulum.plant.plant.model, data.log, data.pseudo_true)
        yield f"corrupted/double pendulum, leverage/{seed}", run


def _lifted(q: object, v: object, u: object, p: object) -> tuple[float, ...]:
    """Accelerations of the rotorcraft with an excess of a tenth of its thrust, straight up."""
    x, z, theta = MACHINES["planar-rotorcraft"].acceleration(q, v, u, p)
    return x, z + 0.1 * u[0] / p[0], theta


def _outliers(signals: np.ndarray, inputs: np.ndarray, rng: np.random.Generator) -> Arrays:
    hit = rng.random(signals.shape) < 0.5
    return signals + hit * rng.uniform(-100.0, 100.0, signals.shape), inputs


def _leverage(signals: np.ndarray, inputs: np.ndarray, rng: np.random.Generator) -> Arrays:
    """One-sided outliers at high thrust, with probability .8."""
    high = np.abs(inputs[:, 0]) > np.quantile(np.abs(inputs[:, 0]), 0.7)
    hit = (rng.random(signals.shape) < 0.8) & high[:, None]
    return signals + hit * rng.uniform(0.0, 80.0, signals.shape), inputs


def _noise(signals: np.ndarray, inputs: np.ndarray, rng: np.random.Generator) -> Arrays:
    """Gaussian noise, Table III's maximum: 2.5 m/s^2, 1 rad/s, and both integrated over a sample."""
    dt, r = 0.01, 0.1
    sizes = [2.5 * dt, 2.5 * dt, r, 2.5 * r, 2.5 * r, 1.0, 2.5, 2.5, 1.0 / r]
    return signals + sizes * rng.normal(size=signals.shape), inputs


def _stuck(signals: np.ndarray, inputs: np.ndarray, rng: np.random.Generator) -> Arrays:
    """Stuck samples in a fifth of the rows, outliers in a tenth, little noise."""
    signals = signals + 0.02 * signals.std(axis=0) * rng.normal(size=signals.shape)
    signals = signals + (rng.random(signals.shape) < 0.1) * rng.uniform(-80.0, 80.0, signals.shape)
    for first in rng.choice(np.arange(50, 2400, 50), 10, replace=False):
        signals[first : first + 50] = signals[first - 1]
    return signals, inputs


def _late(signals: np.ndarray, inputs: np.ndarray, rng: np.random.Generator) -> Arrays:
    """Inputs that act 20 ms late, and outliers."""
    hit = rng.random(signals.shape) < 0.1
    return signals + hit * rng.uniform(-80.0, 80.0, signals.shape), np.vstack([inputs[2:], inputs[-1:], inputs[-1:]])


def _lift(signals: np.ndarray, inputs: np.ndarray, rng: np.random.Generator) -> Arrays:
    """Noise and outliers."""
    hit = rng.random(signals.shape) < 0.2
    noisy = signals + 0.05 * signals.std(axis=0) * rng.normal(size=signals.shape)
    return noisy + hit * rng.uniform(-80.0, 80.0, signals.shape), inputs


CORRUPTIONS: dict[str, Callable[[np.ndarray, np.ndarray, np.random.Generator], Arrays]] = {
    "outliers .5 x 100": _outliers,
    "leverage .8 x 80": _leverage,
    "noise, Table III's maximum": _noise,
    "stuck": _stuck,
    "late inputs": _late,
    "lift": _lift,
}


# ---------------------------------------------------------------------- rows and table
def measured(part: str, name: str, run: Run) -> Row:
    """Error and processor time of a run without a part; an error of infinity where it is refused."""
    begin, missing = time.process_time(), sum((PARTS[x] for x in part.split("+")), Part())
    with ExitStack() as stack:
        for context in missing.left_out():
            stack.enter_context(context)
        try:
            error = run(missing.settings)
        except dr.DiransacError:
            error = np.inf
    return {"part": part, "run": name, "error": error, "seconds": time.process_time() - begin}


def table(rows: Sequence[Row]) -> str:
    """Markdown: a row for each part, a column for each group of runs."""
    whole = {row["run"]: row for row in rows if row["part"] == "nothing"}
    groups = list(dict.fromkeys(name.partition("/")[0] for name in whole))
    lines = ["| without | " + " | ".join(groups) + " | time |", "|---|" + "---|" * (len(groups) + 1)]
    for part in [x for x in dict.fromkeys(row["part"] for row in rows) if x != "nothing"]:
        own = [row for row in rows if row["part"] == part and row["run"] in whole]
        cells = [_cell([row for row in own if row["run"].startswith(f"{group}/")], whole) for group in groups]
        seconds = sum(row["seconds"] for row in own) / sum(whole[row["run"]]["seconds"] for row in own)
        lines.append(f"| {part} | {' | '.join(cells)} | {seconds:.2f} |")
    return "\n".join(lines)


def _cell(rows: Sequence[Row], whole: dict[str, Row]) -> str:
    """Geometric mean of the ratios of the runs with an error, numbers of worse and better runs, and refusals."""
    ratios = np.array([max(row["error"], LEAST) / max(whole[row["run"]]["error"], LEAST) for row in rows])
    known = ratios[np.isfinite(ratios) & (ratios > 0.0)]
    if not len(known):
        return "-"
    worse, better = int((known > 1.0 + CHANGED).sum()), int((known < 1.0 / (1.0 + CHANGED)).sum())
    refused = int(np.isinf(ratios).sum())
    counts = [f"{n} {what}" for n, what in ((worse, "worse"), (better, "better"), (refused, "refused")) if n]
    return f"{np.exp(np.log(known).mean()):.2f}" + (f" ({', '.join(counts)} of {len(rows)})" if counts else "")


def main() -> None:
    """Measure what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", help="names, joined by + if left out together; each part by default")
    parser.add_argument(
        "--seeds", default="1000:1001", help="of the regimes and the corrupted flights, from A to B - 1"
    )
    parser.add_argument("--records", default=REAL, help="real records")
    parser.add_argument("--out", type=Path, help="rows, as JSON lines, from which a run goes on")
    parser.add_argument("--table", type=Path, help="a file to write the table to")
    chosen = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = [json.loads(x) for x in chosen.out.read_text().splitlines()] if chosen.out and chosen.out.exists() else []
    done = {(row["part"], row["run"]) for row in rows}
    first, last = map(int, chosen.seeds.split(":"))
    seeds = range(first, last)
    records = chosen.records.split(",")
    runs = [*corrupted_runs(seeds), *regime_runs(seeds), *machine_runs(seeds), *real_runs(records)]
    for part in ("nothing", *(chosen.parts.split(",") if chosen.parts else [x for x in PARTS if x != "nothing"])):
        for name, run in runs:
            if (part, name) not in done:
                rows.append(measured(part, name, run))
                print(f"{part}: {name} {rows[-1]['error']:.3g}", file=sys.stderr, flush=True)
                if chosen.out:
                    with chosen.out.open("a") as file:
                        file.write(json.dumps(rows[-1]) + "\n")
    print(table(rows))
    if chosen.table:
        chosen.table.write_text(table(rows) + "\n")


PARTS = _parts()

if __name__ == "__main__":
    main()
