"""How far lo-diransac can be trusted on machines that it was not developed on: regimes x seeds x methods.

Run it as ``python benchmarks/regimes.py [--regimes "car all measured,rotor noise"] [--seeds 0:20]``.  Reported
figures are of seeds 0 to 19; whoever develops a method uses seeds from 1000 on, so that those stay unseen.
docs/tables/regimes.md says what the table means.
"""

import argparse
import dataclasses
import json
import math
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from statistics import median

from regime_flights import REGIMES
from regime_judging import METHODS, Record, judge

ONE_THREAD = ("DIRANSAC_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
JUDGED = ("off", "off_structurally", "confidently_wrong", "names_cause")
VERDICTS = ("usable", "usable with care", "do not rely on this")


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table, or JSON; an interrupted run shows what it has."""
    chosen = _parsed(arguments)
    if chosen.list:
        print("\n".join(chosen.regimes))
        return
    records = sorted(_run_all(chosen.regimes, chosen.seeds, chosen.methods, chosen.jobs), key=_place)
    text = _as_json(records) if chosen.json else "\n\n".join(_tables(records, chosen.methods)) + "\n"
    if chosen.output:
        chosen.output.write_text(text)
    sys.stdout.write(text)


def _parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--regimes",
        type=_regimes,
        default=list(REGIMES),
        metavar="A,B",
        help="names or parts of names; all by default",
    )
    parser.add_argument(
        "--methods", type=_methods, default=list(METHODS), metavar="A,B", help=f"of {', '.join(METHODS)}"
    )
    parser.add_argument(
        "--seeds", type=_seeds, default=range(20), metavar="A:B", help="from A to B - 1 (0:20, those reported)"
    )
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes, of one thread each")
    parser.add_argument("-o", "--output", type=Path, help="a file to write the same to")
    parser.add_argument("--json", action="store_true", help="every record instead of the table")
    parser.add_argument("--list", action="store_true", help="print the names of the regimes")
    return parser.parse_args(arguments)


def _regimes(text: str) -> list[str]:
    parts = [part.strip() for part in text.split(",")]
    unknown = [part for part in parts if not any(part in name for name in REGIMES)]
    if unknown:
        raise argparse.ArgumentTypeError(f'no regime is called "{unknown[0]}"; see --list')
    return [name for name in REGIMES if name in parts or any(p not in REGIMES and p in name for p in parts)]


def _methods(text: str) -> list[str]:
    unknown = [name for name in text.split(",") if name not in METHODS]
    if unknown:
        raise argparse.ArgumentTypeError(f'there is no method "{unknown[0]}"; there are {", ".join(METHODS)}')
    return [name for name in METHODS if name in text.split(",")]


def _seeds(text: str) -> range:
    begin, _, end = text.rpartition(":")
    try:
        return range(int(begin or 0), int(end))
    except ValueError:
        raise argparse.ArgumentTypeError(f'seeds are "A:B" or "B", not "{text}"') from None


# ---------------------------------------------------------------------- the loop


def _run_all(regimes: Sequence[str], seeds: range, methods: Sequence[str], jobs: int) -> list[Record]:
    """Every method on every log, in processes of one thread each; says on stderr how far it is."""
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    records, n_logs = list[Record](), len(regimes) * len(seeds)
    dies = (signal.SIGINT, signal.SIG_DFL)  # processes end with the run that is interrupted
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, spawn, initializer=signal.signal, initargs=dies) as pool:
        waiting = [pool.submit(judge, regime, seed, seeds, methods) for regime in regimes for seed in seeds]
        try:
            for k, done in enumerate(as_completed(waiting), start=1):
                records += done.result()
                print(f"{k}/{n_logs} {records[-1].regime}, seed {records[-1].seed}", file=sys.stderr, flush=True)
        except (KeyboardInterrupt, BrokenProcessPool) as reason:
            print(f"ended early: {type(reason).__name__}", file=sys.stderr)
            pool.shutdown(wait=False, cancel_futures=True)
    return records


def _place(record: Record) -> tuple[int, ...]:
    return list(REGIMES).index(record.regime), record.seed, list(METHODS).index(record.method)


# ---------------------------------------------------------------------- what is shown


def _tables(records: Sequence[Record], methods: Sequence[str]) -> Iterable[str]:
    """Markdown: a row a regime, and the totals of exact and of mismatched regimes."""
    baselines = [name for name in methods if name != "lo"]
    titles = ["regime", "exact", "error %", "coverage", "structural", "widening", "usable / care / not"]
    titles += ["off", "structurally", "wrong", "cause", "refused", "s"]
    rows = [[*titles, *(f"{name} %" for name in baselines)]]
    for name in dict.fromkeys(record.regime for record in records):
        rows.append(_row(name, [record for record in records if record.regime == name], baselines))
    yield _markdown(rows)
    yield from _totals([record for record in records if record.method == "lo"])


def _row(regime: str, records: Sequence[Record], baselines: Sequence[str]) -> list[str]:
    own = [record for record in records if record.method == "lo"]
    cells = [regime, "yes" if REGIMES[regime].exact else "no", _spread(own), _coverage(own)]
    cells += [_coverage(own, "inside_structural"), _widening(own), _verdicts(own)]
    cells += [str(sum(getattr(record, name) for record in own)) for name in JUDGED]
    cells += [_refusals(own), f"{median(record.seconds for record in own):.1f}" if own else ""]
    return [*cells, *(_spread([record for record in records if record.method == name]) for name in baselines)]


def _verdicts(records: Sequence[Record]) -> str:
    return "/".join(str(sum(record.verdict == one for record in records)) for one in VERDICTS)


def _refusals(records: Sequence[Record]) -> str:
    refused = sum(bool(record.refusal) for record in records)
    crashed = sum(record.crashed for record in records)
    return f"{refused - crashed}, {crashed} crashed" if crashed else str(refused)


def _spread(records: Sequence[Record]) -> str:
    """Median and worst of the worst parameter's error."""
    errors = [record.worst for record in records if record.errors]
    return f"{_number(median(errors))} / {_number(max(errors))}" if errors else "–"


def _coverage(records: Sequence[Record], which: str = "inside") -> str:
    inside = [x for record in records for x in getattr(record, which).values()]
    return f"{sum(inside) / len(inside):.2f}" if inside else "–"


def _widening(records: Sequence[Record]) -> str:
    """Median width of the structural intervals, over that of the others."""
    ratios = [x for record in records for x in record.widening.values() if math.isfinite(x)]
    return f"{median(ratios):.2f}" if ratios else "–"


def _totals(records: Sequence[Record]) -> Iterable[str]:
    """A sentence about all regimes with exact models, and one about the others."""
    for exact in (True, False):
        some = [record for record in records if REGIMES[record.regime].exact == exact]
        if some:
            wrong, named = sum(one.confidently_wrong for one in some), sum(one.names_cause for one in some)
            yield (
                f"{'Exact' if exact else 'Mismatched'} models, {len(some)} runs: {sum(one.off for one in some)} off, "
                f"{wrong} confidently wrong ({100.0 * wrong / len(some):.1f} %), {named} name a cause, "
                f"refused {_refusals(some)}, coverage {_coverage(some)}; if the model may lack a term: "
                f"{sum(one.off_structurally for one in some)} off, coverage {_coverage(some, 'inside_structural')}, "
                f"intervals {_widening(some)} times as wide."
            )


def _number(x: float) -> str:
    """Two figures."""
    if not math.isfinite(x):
        return "–"
    return f"{x:.2g}" if x < 99.5 else f"{x:.0f}" if x < 9999.5 else f"{x:.0e}"


def _markdown(rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])


def _as_json(records: Sequence[Record]) -> str:
    """Every record; null where a number is not finite."""

    def plain(value: object) -> object:
        if isinstance(value, dict):
            return {name: plain(x) for name, x in value.items()}
        return None if isinstance(value, float) and not math.isfinite(value) else value

    found = [plain(dataclasses.asdict(one) | {name: getattr(one, name) for name in JUDGED}) for one in records]
    return json.dumps(found, indent=1, allow_nan=False) + "\n"


if __name__ == "__main__":
    main()
