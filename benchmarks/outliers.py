"""Outliers on every signal of a rotorcraft flight: what each method recovers, over many seeds.

Run it as ``python benchmarks/outliers.py [--seeds 20] [--magnitude 80] [--probability 0.1]``.  A lively flight of
25 s at 100 Hz; each sample of all nine signals is hit with the given probability by uniform(-magnitude, magnitude); no
other noise; settings of Table IV.  Once the first row, at which the paper starts its simulation, is spared, once not.

Columns: median relative error of each parameter and of the worst of the three; median open-loop error on the clean
flight (eq. (2) with Table IV's weights); runs in which all three parameters are within 5 %; median seconds.
"""

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import diransac as dr

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
from simulated import ROTORCRAFT, as_log, flight, rollout, with_outliers

N_ROWS, DT = 2500, 0.01
TABLE_IV = dr.Settings.table_iv()
METHODS = {
    "i-diransac": ("i-diransac", TABLE_IV),
    "i-diransac, all 1000": ("i-diransac", replace(TABLE_IV, stop_inlier_fraction=None)),
    "i-diransac, robust start": ("i-diransac", replace(TABLE_IV, initial_state="robust")),
    "diransac": ("diransac", TABLE_IV),
    "diransac, no refits": ("diransac", replace(TABLE_IV, refit="none")),
    "ols": ("ols", TABLE_IV),
    "tls": ("tls", TABLE_IV),
}
HEADER = ("first row", "method", "mass", "inertia", "drag", "worst", "open loop", "recovered", "seconds")
WIDTHS = (10, 25, 9, 9, 9, 9, 10, 10, 8)


@dataclass(frozen=True)
class Study:
    """How the flight is spoilt, and how often."""

    seeds: int
    magnitude: float
    probability: float

    def rows(self) -> Iterator[tuple[str, ...]]:
        """One row of the table for each method, with the first row spared and hit."""
        clean, inputs = flight(ROTORCRAFT, N_ROWS, DT)
        for first_row in ("clean", "hit"):
            for name, (method, settings) in METHODS.items():
                yield (first_row, name, *self._figures(method, settings, clean, inputs, first_row))

    def _figures(
        self, method: str, settings: dr.Settings, clean: np.ndarray, inputs: np.ndarray, first_row: str
    ) -> Iterator[str]:
        errors, open_loop, seconds = [], [], []
        for seed in range(self.seeds):
            spoilt = with_outliers(clean, self.probability, self.magnitude, seed, first_row=first_row)
            log = as_log(ROTORCRAFT, spoilt, inputs, DT)
            start = time.perf_counter()
            result = dr.identify(dr.models.planar_rotorcraft(), log, method, seed=seed, settings=settings)
            seconds.append(time.perf_counter() - start)
            errors.append([abs(result.parameters[n] / x - 1.0) for n, x in ROTORCRAFT.truth.items()])
            open_loop.append(clean_error(list(result.parameters.values()), clean, inputs))
        worst = np.max(errors, axis=1)
        yield from (f"{x:.1e}" for x in (*np.median(errors, axis=0), np.median(worst), np.median(open_loop)))
        yield f"{int((worst < 0.05).sum())}/{self.seeds}"
        yield f"{np.median(seconds):.3f}"


def clean_error(parameters: list[float], clean: np.ndarray, inputs: np.ndarray) -> float:
    """Eq. (2) of a simulation from the true start against the flight without outliers."""
    predicted = rollout(ROTORCRAFT, parameters, clean[0, :6], inputs, DT)
    weights = np.array([TABLE_IV.error_weights.get(name, 0.0) for name in ROTORCRAFT.signals])
    rms = np.sqrt(np.mean((predicted - clean) ** 2, axis=0))
    return float(weights @ np.nan_to_num(rms, nan=np.inf))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--magnitude", type=float, default=80.0)
    parser.add_argument("--probability", type=float, default=0.1)
    study = Study(**vars(parser.parse_args()))
    print(f"magnitude {study.magnitude:g}, probability {study.probability:g}, {study.seeds} seeds, {N_ROWS} rows")
    for row in (HEADER, *study.rows()):
        print("".join(cell.ljust(width) for cell, width in zip(row, WIDTHS, strict=True)).rstrip(), flush=True)


if __name__ == "__main__":
    main()
