"""Estimates of a whole run in bounded memory, for figures, pages and summaries."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.text_table import number

if TYPE_CHECKING:
    from diransac.identification.tracking.estimates import Change, TrackedEstimate
    from diransac.model import Model

__all__ = ["History", "change_text"]

# Estimates that are kept: a figure has fewer cells than a tenth of it.
_MOST = 20_000
# Findings that are kept: more than anyone reads.
_MOST_NOTES = 500


class History:
    """Estimates of a run, every one at first, and every second, fourth, ... of a longer one; all changes.

    Parameters
    ----------
    model : Model

    Attributes
    ----------
    last : TrackedEstimate or None
        The newest estimate.
    n_steps : int
        Estimates there were.
    changes : list of Change
    notes : list of (float, str)
        Time, s, and sentence of the first findings.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        self.last: TrackedEstimate | None = None
        self.n_steps = 0
        self.changes: list[Change] = []
        self.notes: list[tuple[float, str]] = []
        self._kept: list[TrackedEstimate] = []
        self._every = 1

    def add(self, now: TrackedEstimate) -> None:
        """Take the next estimate."""
        if self.n_steps % self._every == 0:
            self._kept.append(now)
            if len(self._kept) > _MOST:
                self._kept = self._kept[::2]
                self._every *= 2
        self.n_steps += 1
        self.last = now
        self.changes += now.changes
        self.notes += [(now.time, note) for note in now.notes][: _MOST_NOTES - len(self.notes)]

    @property
    def time(self) -> FloatArray:
        """Times (n,) of the estimates that are kept, s."""
        return np.array([x.time for x in self._kept])

    @property
    def signals(self) -> tuple[str, ...]:
        """Signals that were measured in any of them."""
        return tuple(dict.fromkeys(name for x in self._kept for name in x.outliers))

    def values(self, parameter: str) -> FloatArray:
        """Estimates (n,) of a parameter, in its unit."""
        return np.array([x.parameters[parameter] for x in self._kept])

    def standard_errors(self, parameter: str) -> FloatArray:
        """Their standard errors (n,)."""
        return np.array([x.standard_errors[parameter] for x in self._kept])

    def outliers(self, signal: str) -> FloatArray:
        """Fractions (n,) of outliers of a signal; NaN where it was not measured."""
        return np.array([x.outliers.get(signal, np.nan) for x in self._kept])

    def noise(self, signal: str) -> FloatArray:
        """Standard deviations (n,) of its noise, in its unit; NaN where it was not measured."""
        return np.array([x.noise.get(signal, np.nan) for x in self._kept])


def change_text(change: Change, unit: str) -> str:
    """A change as a sentence: ``t = 30.02 s: step of mass from 0.249 to 0.174 kg, found 0.4 s later``."""
    late = f", found {change.detected - change.time:.1f} s later" if math.isfinite(change.detected) else ""
    values = f"from {number(change.before)} to {number(change.after)} {unit}".rstrip()
    return f"t = {change.time:.2f} s: {change.kind} of {change.parameter} {values}{late}"
