"""The twenty logs of `tests/acceptance`: what the default method answers, beside each row's bounds.

``python benchmarks/twenty_logs.py [--only arm,tanks] [--short]``

Records need ``../shared/data``; ``--short`` leaves out those that take more than 15 s of a processor.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from acceptance.judging import answer, failure  # after its folder is known
from acceptance.records import DATA
from acceptance.table import RECORDS, SIMULATED, Row

HEAD = ("log", "error", "bound", "verdict", "inside", "structural", "time / ols", "bound", "fails", "open")


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table as Markdown, row by row."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", help="beginnings of the logs' names, separated by commas")
    parser.add_argument("--short", action="store_true", help="leave out what takes more than 15 s of a processor")
    chosen = parser.parse_args(arguments)
    rows = [*SIMULATED, *(RECORDS if DATA.is_dir() else ())]
    begins = tuple(chosen.only.split(",")) if chosen.only else ("",)
    print(f"| {' | '.join(HEAD)} |\n{'|---' * len(HEAD)}|")
    for row in rows:
        if row.log.startswith(begins) and not (chosen.short and row.long):
            print(line(row), flush=True)


def line(row: Row) -> str:
    """Row of the table."""
    found = answer(row)
    fails = [aspect for aspect in row.aspects if failure(row, aspect)]
    cells = [row.log, f"{found.error:.3g}", row.error, found.verdict, found.inside, found.structural]
    cells += [f"{found.ratio:.1f}", row.ratio, ", ".join(fails), ", ".join(row.open)]
    return f"| {' | '.join('' if x is None else str(x) for x in cells)} |"


if __name__ == "__main__":
    main()
