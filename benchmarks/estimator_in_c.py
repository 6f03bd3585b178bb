"""Measurements for an estimator in C: how rounding moves a tracker's estimates, and how much code an update runs.

``python benchmarks/estimator_in_c.py`` prints the figures of ``docs/tables/estimator-in-c.md``.  Flights are those of
`tracking`, a planar rotorcraft, seed 1; every sample is changed by 1e-13 of itself.
"""

from __future__ import annotations

import ast
import cProfile
import pstats
from collections import Counter
from pathlib import Path

import numpy as np
from tracking import STEP, WINDOW, _chunks, flown

import diransac as dr

ROUNDING, FIRST, LAST = 1e-13, 100, 600
"""Relative change of the samples; steps of the flight whose code is counted."""
PACKAGE = "/diransac/"


def estimates(scenario: str, change: float) -> np.ndarray:
    """Parameters and standard errors ``(T, 2 n)`` over a flight whose samples are changed at random."""
    flight, rng, found = flown("planar", scenario, 1), np.random.default_rng(0), []
    tracker = dr.Tracker(flight.model, window=WINDOW, step=STEP, start=flight.start, seed=0)
    for rows in _chunks(flight, STEP):
        moved = {n: x if n == "t" else x * (1.0 + change * rng.standard_normal(len(x))) for n, x in rows.items()}
        now = tracker.update(moved)
        if now is not None:
            found.append([*now.parameters.values(), *now.standard_errors.values()])
    return np.array(found)


def lines_of_updates() -> Counter[str]:
    """Lines of the functions that updates run, by folder of the package."""
    flight, profile = flown("planar", "combined", 1), cProfile.Profile()
    tracker = dr.Tracker(flight.model, window=WINDOW, step=STEP, start=flight.start, seed=0)
    for k, rows in enumerate(_chunks(flight, STEP)):
        if k == FIRST:
            profile.enable()
        if k == LAST:
            break
        tracker.update(rows)
    profile.disable()
    called: dict[str, set[tuple[int, str]]] = {}
    for file, line, name in pstats.Stats(profile).stats:  # type: ignore[attr-defined]
        if PACKAGE in file and Path(file).is_file():
            called.setdefault(file, set()).add((line, name))
    found = Counter[str]()
    for file, functions in called.items():
        text = Path(file).read_text(encoding="utf-8").splitlines()
        folder = str(Path(file.rpartition(PACKAGE)[2]).parent)
        for node in ast.walk(ast.parse("\n".join(text))):
            if isinstance(node, ast.FunctionDef):
                first = min([node.lineno, *(x.lineno for x in node.decorator_list)])
                if {(first, node.name), (node.lineno, node.name)} & functions:
                    body = node.body[ast.get_docstring(node) is not None :]
                    lines = {i for x in body for i in range(x.lineno, (x.end_lineno or x.lineno) + 1)}
                    found[folder] += 1 + sum(bool(text[i - 1].partition("#")[0].strip()) for i in lines)
    print(f"{len(called)} files")
    return found


def main() -> None:
    """Print both."""
    for scenario in ("nominal", "10 % outliers", "mass step", "gusts"):
        before, after = (estimates(scenario, x) for x in (0.0, ROUNDING))
        off = np.abs(after / before - 1.0)
        n = off.shape[1] // 2
        largest = off[:, :n].max(axis=1)
        print(f"{scenario}: parameters {np.median(largest):.1g}, {largest.max():.1g}; errors {off[:, n:].max():.1g}")
    found = lines_of_updates()
    print(f"{sum(found.values())} lines: " + ", ".join(f"{folder} {n}" for folder, n in found.most_common()))


if __name__ == "__main__":
    main()
