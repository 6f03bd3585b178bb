"""Real records: the default method beside what an engineer would use instead, judged by held-out prediction.

``python benchmarks/real.py [--data ../shared/data] [--only silverbox,emps] [--methods default] [--out rows.jsonl]``

Every record is split into a training and a held-out part (`real_records` has the list).  The methods:

- ``default``: ``dr.identify(model, logs, differentiate=True)``, no setting;
- ``ols``, ``nls``: the package's least squares of filtered derivatives;
- ``output error``: SciPy's ``least_squares`` over simulated segments with free first states, a soft-L1 loss, eight
  starts and the hold of the inputs that fits better (`real_simulation`);
- ``mujoco.sysid``: on the servo axis and the legs.  MuJoCo has no arctangent friction and no rotor that acts across two
  joints, so that the double pendulum is left out; ``pip install 'mujoco[sysid]'``;
- ``published``: the literature's parameters; they are judged, but are not among the others that ratios refer to.

One judge for all, which shares no code with the package: held-out logs are predicted open loop over 0.1, 0.3 and 1 s
from windows that start at smoothed states, with the delay, the lag and the hold that a result states.  The score is the
root mean square over horizons and signals of the robust RMSE (the worst 5 % of windows left out) in the signal's
standard deviation over all logs.  The Silverbox is judged by the RMSE of a simulation from rest, mV; the Crazyflie by
the accelerometer in flight; the legs in MuJoCo.  A refusal has the score of no model: positions that stay.

Rows that were measured before are joined: ``--methods default --compare rows.jsonl`` runs the default alone beside the
methods of that file.  ``--table FILE`` writes the tables as Markdown.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from real_records import RECORDS as MACHINES
from real_records import Found, Record
from real_robots import RECORDS as ROBOTS
from real_simulation import Inputs

import diransac as dr

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
LEAST_SQUARES = ("ols", "nls")
OTHERS = (*LEAST_SQUARES, "output error", "mujoco.sysid", "without lag")
METHODS = ("default", *OTHERS, "published")
FAILURES = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError, np.linalg.LinAlgError)
"""Of a method that neither answers nor refuses."""
Row = dict[str, Any]
RECORDS = {**MACHINES, **ROBOTS}


# ---------------------------------------------------------------------- rows


def rows_of(record: Record, methods: Sequence[str]) -> Iterable[Row]:
    """A row for each of the methods that applies to a record."""
    for method in methods:
        identified = _method(record, method)
        if identified is not None:
            yield _row(record, method, identified)


def _method(record: Record, method: str) -> Callable[[], Found | dr.Result] | None:
    """Call that identifies; None where the method does not apply."""
    if method == "default":
        return lambda: dr.identify(record.model, _logs(record), differentiate=True)
    if method in LEAST_SQUARES:
        return lambda: dr.identify(record.model, _logs(record), method, differentiate=True)
    if method == "published":
        return (lambda: (record.published, Inputs())) if set(record.published) == set(record.model.parameters) else None
    return record.baselines.get(method)


def _logs(record: Record) -> dr.Log | list[dr.Log]:
    return record.train[0] if len(record.train) == 1 else list(record.train)


def _row(record: Record, method: str, identified: Callable[[], Found | dr.Result]) -> Row:
    """Estimates, held-out score and verdict of a method; of one that fails, the score of no model and its message."""
    row: Row = {"record": record.name, "method": method, "unit": record.unit, "published": dict(record.published)}
    begin = time.perf_counter()
    try:
        found = identified()
    except dr.DiransacError as error:
        row |= {"verdict": f"refused: {error}"}
    except ImportError as error:
        return row | {"verdict": f"not run: {error}", "seconds": 0.0, "error": None}
    except FAILURES as error:
        row |= {"verdict": f"failed: {type(error).__name__}: {error}"}
    else:
        row |= _estimates(found)
    row["seconds"] = time.perf_counter() - begin
    return row | _scores(record, row)


def _estimates(found: Found | dr.Result) -> Row:
    """Parameters, inputs, intervals and verdict."""
    if not isinstance(found, dr.Result):
        parameters, inputs = found
        return {"parameters": dict(parameters), "inputs": vars(inputs), "verdict": ""}
    resolution, row = found.estimate.resolution, {"parameters": dict(found.parameters), "verdict": found.verdict}
    timing = resolution.timing
    row["inputs"] = vars(Inputs(resolution.hold, timing.delay, timing.lag))
    row["intervals"] = _finite(found.intervals())
    if hasattr(found, "structural_intervals"):
        given = found.structural_intervals
        row["structural_intervals"] = _finite(given() if callable(given) else given)
    if hasattr(found, "competition"):
        row["competition"] = str(found.competition)
    row["findings"] = [str(x) for x in found.findings]
    return row


def _finite(intervals: Mapping[str, Sequence[float]] | None) -> dict[str, list[float | None]]:
    return {name: [float(x) if np.isfinite(x) else None for x in ends] for name, ends in (intervals or {}).items()}


def _scores(record: Record, row: Row) -> Row:
    """Held-out error and its parts."""
    if record.judge is None or record.reference is None:
        return {"error": None}
    parameters = row.get("parameters", {})
    known = set(record.model.parameters) <= set(parameters)
    score = record.judge(parameters, Inputs(**row["inputs"])) if known else record.reference
    return {"error": score.error, "parts": dict(score.parts), "no_model": record.reference.error}


# ---------------------------------------------------------------------- tables


def table(rows: Sequence[Row]) -> str:
    """Markdown: scores and verdicts, then parameters beside published ones."""
    lines = [
        "| record | method | held-out error | by horizon | default / best other | verdict | s |",
        "|---|---|--:|---|--:|---|--:|",
    ]
    for row in rows:
        parts = ", ".join(f"{x:.3g}" for x in row.get("parts", {}).values())
        at = f" of {row['no_model']:.3g}" if row["method"] == "default" and row.get("no_model") else ""
        error = "" if row["error"] is None else f"{row['error']:.3g}{at} {row['unit']}"
        found = ratio(rows, row["record"]) if row["method"] == "default" else None
        verdict = _short(row["verdict"])
        cell = "" if found is None else f"{found[0]:.2f} ({found[1]})"
        lines.append(
            f"| {row['record']} | {row['method']} | {error} | {parts} | {cell} | {verdict} | {row['seconds']:.1f} |"
        )
    for record in dict.fromkeys(row["record"] for row in rows):
        lines += ["", *_parameters([row for row in rows if row["record"] == record])]
    return "\n".join(lines)


def _short(text: str, length: int = 90) -> str:
    return " ".join((text if len(text) <= length else text[:length] + " ...").replace("|", "/").split())


def _parameters(rows: Sequence[Row]) -> list[str]:
    """Table of a record's parameters: one row for each, one column for each method, intervals in brackets."""
    rows = [row for row in rows if row.get("parameters") and row["method"] != "published"]
    if not rows:
        return []
    published = rows[0]["published"]
    names = list(rows[0]["parameters"])
    lines = [f"| {rows[0]['record']} | published | {' | '.join(row['method'] for row in rows)} |"]
    lines += ["|---|" + "--:|" * (1 + len(rows))]
    for name in names:
        cells = [f"{published[name]:.4g}" if name in published else "", *(_cell(row, name) for row in rows)]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def _cell(row: Row, name: str) -> str:
    """Estimate, its interval in brackets, and the structural one in braces."""
    if name not in row["parameters"]:
        return ""
    cell = f"{row['parameters'][name]:.4g}"
    for kind, brackets in (("intervals", "[]"), ("structural_intervals", "{}")):
        if ends := row.get(kind, {}).get(name):
            low, high = ("?" if x is None else f"{x:.3g}" for x in ends)
            cell += f" {brackets[0]}{low}, {high}{brackets[1]}"
    return cell


def ratio(rows: Sequence[Row], record: str) -> tuple[float, str] | None:
    """The default's error over the least of the others, and whose that is."""
    errors = {row["method"]: row["error"] for row in rows if row["record"] == record and row["error"] is not None}
    others = {name: x for name, x in errors.items() if name in OTHERS}
    if "default" not in errors or not others:
        return None
    best = min(others, key=others.__getitem__)
    return errors["default"] / others[best], best


def summary(rows: Sequence[Row]) -> str:
    """Geometric mean and worst of the default's ratios to the best other."""
    ratios = {record: ratio(rows, record) for record in dict.fromkeys(row["record"] for row in rows)}
    known = {record: found[0] for record, found in ratios.items() if found is not None}
    if not known:
        return "No record has both the default and another method."
    mean, worst = float(np.exp(np.mean(np.log(list(known.values()))))), max(known, key=known.__getitem__)
    return (
        f"Held-out error of the default over that of the best other, {len(known)} records: geometric mean {mean:.2f}, "
        f"worst {known[worst]:.2f} ({worst})."
    )


# ---------------------------------------------------------------------- command


def joined(measured: Sequence[Row], before: Sequence[Row], records: Sequence[str]) -> list[Row]:
    """Rows of these records in order; where both have one, the measured one."""
    known = {(row["record"], row["method"]): row for row in (*before, *measured)}
    return [known[record, method] for record in records for method in METHODS if (record, method) in known]


def chosen_records(only: str | None) -> list[str]:
    """Names of the records that begin with one of the given texts; all without any."""
    texts = tuple(only.split(",")) if only else ("",)
    found = [name for name in RECORDS if name.startswith(texts)]
    if not found:
        sys.exit(f"--only {only}: no record begins so; there are {', '.join(RECORDS)}.")
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables, and write rows as they are measured."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the records")
    parser.add_argument("--only", help="beginnings of the records' names, separated by commas")
    parser.add_argument("--methods", default=",".join(METHODS), help="names of the methods, separated by commas")
    parser.add_argument("--out", type=Path, help="file for the measured rows, JSON lines")
    parser.add_argument("--compare", type=Path, help="rows of an earlier run, for what is not measured now")
    parser.add_argument("--table", type=Path, help="file for the tables, Markdown")
    chosen = parser.parse_args(arguments)
    records, methods = chosen_records(chosen.only), chosen.methods.split(",")
    if unknown := set(methods) - set(METHODS):
        sys.exit(f"--methods: {', '.join(sorted(unknown))} unknown; there are {', '.join(METHODS)}.")
    if not chosen.data.is_dir():
        sys.exit(f"The real records are not part of the repository, and {chosen.data} is missing: name it by --data.")
    before = [json.loads(line) for line in chosen.compare.read_text("utf-8").splitlines()] if chosen.compare else []
    measured: list[Row] = []
    if chosen.out:
        chosen.out.write_text("", encoding="utf-8")
    for name in records:
        for row in rows_of(RECORDS[name](chosen.data), methods):
            measured.append(row)
            error = "-" if row["error"] is None else f"{row['error']:.4g} {row['unit']}"
            print(f"{name:22}{row['method']:14}{error:18}{row['seconds']:7.1f} s  {_short(row['verdict'])}", flush=True)
            if chosen.out:
                with chosen.out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
    rows = joined(measured, before, records)
    text = f"{table(rows)}\n\n{summary(rows)}"
    print(f"\n{text}")
    if chosen.table:
        chosen.table.write_text(f"{text}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
