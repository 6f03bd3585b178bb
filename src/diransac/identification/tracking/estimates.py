"""Values of a tracker: `TrackedEstimate`, one a step, `Change`, which is reported once, and their `History`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING, Literal

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.regression.uncertainty import two_sided
from diransac.text_table import number

if TYPE_CHECKING:
    from diransac.model import Model

_MOST = 20_000
"""Estimates that are kept: a figure has fewer cells than a tenth of it."""


@dataclass(frozen=True)
class Change:
    """Change of a parameter of a machine while it runs.

    Parameters
    ----------
    time : float
        Most probable time of a step, s; of a drift, when it began to exceed its standard error.
    parameter : str
    before, after : float
        Value before it and after it, in the parameter's unit.
    kind : "step", "drift" or "return"
        A return is a step or a drift to a value from before an earlier change.
    detected : float
        Time of the estimate that reports it, s.
    before_error, after_error : float
        Standard errors of both values.
    """

    time: float
    parameter: str
    before: float
    after: float
    kind: Literal["step", "drift", "return"] = "step"
    detected: float = float("nan")
    before_error: float = float("nan")
    after_error: float = float("nan")


@dataclass(frozen=True, eq=False)
class TrackedEstimate:
    """Parameters of a machine at one moment of its run.

    Parameters
    ----------
    time : float
        Of the last sample that counts, s of the stream's clock.
    parameters, standard_errors : mapping of str to float
        Of each parameter, in its unit.
    covariance : (n_p, n_p) array
        Of the parameters in their order.
    changes : tuple of Change
        Those found since the estimate before.
    outliers : mapping of str to float
        Fraction of outliers of each measured signal, in the window.
    noise : mapping of str to float
        Standard deviation of the noise of each measured signal, its unit.
    state : mapping of str to float
        Most probable state at `time`.
    notes : tuple of str
        Findings since the estimate before, a sentence each: gaps, a clock that restarts, a sensor that stops.
    """

    time: float
    parameters: Mapping[str, float]
    standard_errors: Mapping[str, float]
    covariance: FloatArray
    changes: tuple[Change, ...]
    outliers: Mapping[str, float]
    noise: Mapping[str, float]
    state: Mapping[str, float]
    notes: tuple[str, ...] = ()

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Credible interval of each parameter.

        Parameters
        ----------
        level : float, optional
            Probability, between 0 and 1.

        Returns
        -------
        dict of str to (float, float)
            Lower and upper limit in the parameter's unit.

        Raises
        ------
        SettingsError
            The level is not between 0 and 1.
        """
        return two_sided(level, NormalDist().inv_cdf, self.parameters, self.standard_errors)


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
        # Five hundred findings are more than anyone reads.
        self.notes += [(now.time, note) for note in now.notes][: 500 - len(self.notes)]

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
