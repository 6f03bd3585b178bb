"""Random numbers that depend on ``(seed, effect, signal)`` alone.

Each effect on each signal reads a stream of its own, a counter-based generator keyed by a hash of the three.  So an
effect that is switched on, or a signal that is left out, changes nothing in what the others draw.

References: Salmon et al. 2011 (Philox).
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from diransac.arrays import BoolArray, FloatArray

__all__ = ["Draws"]


@dataclass(frozen=True)
class Draws:
    """Random numbers for a log's rows.

    Parameters
    ----------
    seed : any integer
    n_rows : rows that are drawn for
    skipped : rows at the start whose numbers are drawn and left out
    """

    seed: int
    n_rows: int
    skipped: int = 0

    def _stream(self, effect: str, signal: str) -> np.random.Generator:
        key = hashlib.sha256(f"{self.seed}\0{effect}\0{signal}".encode()).digest()[:16]
        return np.random.Generator(np.random.Philox(key=int.from_bytes(key, "little")))

    def uniform(self, effect: str, signal: str) -> FloatArray:
        """Uniform in [0, 1), (rows,)."""
        return self._stream(effect, signal).random(self.n_rows)[self.skipped :]

    def normal(self, effect: str, signal: str) -> FloatArray:
        """Gaussian of mean 0 and variance 1, (rows,)."""
        return self._stream(effect, signal).standard_normal(self.n_rows)[self.skipped :]

    def runs(self, effect: str, signal: str, probability: float, mean_length: float) -> BoolArray:
        """Rows that lie in runs, (rows,): one starts at each row with ``probability``; lengths are geometric."""
        stream = self._stream(effect, signal)
        starts = stream.random(self.n_rows) < probability
        rows = np.arange(self.n_rows)
        ends = np.where(starts, rows + stream.geometric(1.0 / mean_length, self.n_rows), 0)
        return (rows < np.maximum.accumulate(ends))[self.skipped :]
