"""The tracker over real records, replayed as they were recorded, beside the batch method on the whole record.

``python benchmarks/tracking_real.py [--only emps,crazyflie-log15] [--out rows.jsonl]``

``emps``
    a servo axis, 24 s at 1 kHz: nothing changes;
``emps-spliced``
    the same twice, with a recorded force that is divided by 1.3 from the middle of the second time on, as after a
    change of a drive's gain: every parameter drops by 23 %;
``crazyflie-log15``, ``crazyflie-log16``
    thrust and lag of the rotors, from the accelerometer and the motor commands of a flight of a minute.

On the servo axis the tracker starts cold, by the batch method on its first seconds; on the flights by rough values,
since the batch method says "do not rely on this" there, and a cold start refuses it.  Rows have parameters and standard
errors at the end, those of the batch method, all reports, and times as in `tracking`.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from real import DATA
from real_robots import rotors, thrust_model

import diransac as dr

Row = dict[str, Any]
Replayed = tuple[dr.Model, dr.Log, Mapping[str, float] | None]
STEP, WINDOW = 0.1, 5.0
FACTOR = 1.3
TAKE_OFF = 5.0
"""Seconds."""


def emps() -> Replayed:
    """The servo axis."""
    names = {"t": "t_s", "position": "q_m", "force": "force_N"}
    return dr.models.servo_axis(), dr.read_log(DATA / "emps" / "DATA_EMPS.csv", rename=names), None


def emps_spliced() -> Replayed:
    """The servo axis twice, with another gain of its drive from the middle of the second time on."""
    model, log, start = emps()
    duration = log.time[-1] - log.time[0] + log.dt
    time = np.concatenate([log.time, log.time + duration])
    force = np.tile(log["force"], 2) / np.where(time - time[0] < 1.5 * duration, 1.0, FACTOR)
    return model, dr.Log.from_arrays(time, {"position": np.tile(log["position"], 2), "force": force}), start


def crazyflie(name: str) -> Replayed:
    """Thrust and lag of the rotors, from the accelerometer of a flight after its first seconds in the air."""
    log = rotors(DATA, name)
    in_the_air = log.time[np.isfinite(log["acc"])][0] + TAKE_OFF
    return thrust_model(), log.between(in_the_air, log.time[-1]), {"k1": 0.05, "k2": 0.05, "lag": 0.05}


REPLAYS: Mapping[str, Callable[[], Replayed]] = {
    "emps": emps,
    "emps-spliced": emps_spliced,
    "crazyflie-log15": lambda: crazyflie("log15"),
    "crazyflie-log16": lambda: crazyflie("log16"),
}


def row_of(name: str) -> Row:
    """What is measured of one record."""
    model, log, start = REPLAYS[name]()
    row: Row = {"record": name, "seconds": float(log.time[-1] - log.time[0]), "rate of rows": 1.0 / log.dt}
    batch = dr.identify(model, log, differentiate=True)
    row["batch"] = {n: [batch.parameters[n], batch.standard_errors[n]] for n in batch.parameters}
    row["batch verdict"] = batch.verdict
    begin, reports, notes, seconds, last = time.process_time(), [], [], [], None
    for last in dr.track(model, log, window=WINDOW, step=STEP, start=start):
        seconds.append(time.process_time() - begin)
        reports += [[x.time, x.parameter, x.kind, x.before, x.after, x.detected] for x in last.changes]
        notes += [f"{last.time:.2f} s: {note}" for note in last.notes]
        begin = time.process_time()
    assert last is not None
    row["tracked"] = {n: [last.parameters[n], last.standard_errors[n]] for n in last.parameters}
    times = {"rate": len(seconds) / sum(seconds[1:]), "latency": float(np.quantile(seconds[1:], 0.95))}
    return row | {"reports": reports, "notes": notes, "updates": len(seconds), "start": seconds[0]} | times


def table(rows: list[Row]) -> str:
    """Markdown: a row for each record."""
    lines = ["| record | tracked, at the end | batch | reports | rate, /s | latency, ms |", "|---|---|---|---|--:|--:|"]
    for row in rows:
        tracked, batch = (_listed(row[kind]) for kind in ("tracked", "batch"))
        said = "; ".join(f"{kind} of {n} at {t:.2f} s (found at {at:.2f})" for t, n, kind, _, _, at in row["reports"])
        cells = [row["record"], tracked, batch, said or "none", f"{row['rate']:.0f}", f"{1e3 * row['latency']:.0f}"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _listed(values: Mapping[str, tuple[float, float]]) -> str:
    return ", ".join(f"{name} {value:.4g} ± {error:.1g}" for name, (value, error) in values.items())


def main() -> None:
    """Replay what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default=",".join(REPLAYS), help="records, by name")
    parser.add_argument("--out", type=Path, help="rows, as JSON lines, from which a run goes on")
    chosen = parser.parse_args()
    if not DATA.is_dir():
        raise SystemExit(f"{DATA} is missing: nothing was replayed")
    warnings.simplefilter("ignore")
    rows = [json.loads(x) for x in chosen.out.read_text().splitlines()] if chosen.out and chosen.out.exists() else []
    done = {row["record"] for row in rows}
    for name in chosen.only.split(","):
        if name not in done:
            rows.append(row_of(name))
            if chosen.out:
                with chosen.out.open("a") as file:
                    file.write(json.dumps(rows[-1]) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
