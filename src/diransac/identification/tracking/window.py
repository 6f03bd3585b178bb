"""The sliding window: the joint fit of the last intervals, given what those before them have told."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.methods.lo_diransac.mixture import NoiseSums
from diransac.identification.methods.lo_diransac.refinement import gauss_newton_step, linearized
from diransac.identification.methods.lo_diransac.scales import (
    ProcessSums,
    negligible_jumps,
    process_sums,
    unbroken_jumps,
)
from diransac.identification.tracking.marginal import marginal

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.arrowhead import Factored
    from diransac.identification.methods.lo_diransac.normal_equations import Fit, NormalEquations
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
    from diransac.identification.tracking.setup import Setup
    from diransac.identification.tracking.stream import Stream

__all__ = ["Linearization", "Window"]

# Steps at most with another interval; one that moves no parameter by more than so many standard errors is the last.
_MOST_STEPS, _SETTLED = 3, 0.1
# Time over which noise and unmodelled accelerations are remembered after the window, s: a minute of a sensor at 1 Hz
# still gives its noise to 10 %.
_MEMORY = 60.0


@dataclass(frozen=True)
class Linearization:
    """Normal equations of a window, the fit that they are of, and their solution.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
    at : NormalEquations
    solved : Factored
    """

    intervals: ShootingIntervals
    fit: Fit
    at: NormalEquations
    solved: Factored


class Window:
    """Fit of the intervals of a window; changes as it moves on.

    Parameters
    ----------
    setup : Setup
    stream : Stream
        Holds the rows of the window.
    first : int
        First row of the window.
    fit : Fit
        Of its intervals.
    least : (n_v,) array
        Smallest size of the unmodelled accelerations.
    """

    def __init__(self, setup: Setup, stream: Stream, first: int, fit: Fit, least: FloatArray) -> None:
        self.setup, self.stream, self.first, self.fit, self.least = setup, stream, first, fit, least
        n = len(fit.x)
        self.length = stream.length // setup.parts
        self.times = stream.time(first) + self.length * stream.dt * np.arange(n)
        none = np.zeros_like(fit.noise.sigma)
        self.noise = NoiseSums(none, none, none)
        self.process = ProcessSums(*np.zeros((4, len(fit.tau))))
        self.kept = float(np.exp(-self.length * stream.dt / _MEMORY))
        self.damping = 0.0
        self.last: Linearization | None = None

    def __len__(self) -> int:
        return len(self.fit.x)

    @property
    def end(self) -> int:
        """Row after the last one of the window."""
        return self.first + len(self) * self.length

    def intervals(self) -> ShootingIntervals:
        """The intervals with their rows as they are now."""
        return self.setup.intervals(self.stream, self.first, len(self))

    # ------------------------------------------------------------------ moving on

    def extend(self, n: int) -> None:
        """Add intervals that continue the last one."""
        for _ in range(n):
            fit = self.fit
            x, d = np.vstack([fit.x, fit.ends[-1:]]), np.vstack([fit.d, fit.rho * fit.d[-1:]])
            self._append(replace(fit, x=x, d=d), 1)

    def join(self, x: FloatArray) -> None:
        """Add intervals of a new stretch that begin with given states ``(n, n_x)``."""
        fit = self.fit
        d = np.zeros((len(x), fit.d.shape[1]))
        self._append(replace(fit, x=np.vstack([fit.x, x]), d=np.vstack([fit.d, d])), len(x))

    def _append(self, fit: Fit, n: int) -> None:
        """The fit with n more intervals, whose residuals are simulated."""
        self.times = np.append(self.times, self.stream.time(self.end) + self.length * self.stream.dt * np.arange(n))
        self.fit = fit
        residuals, ends = self.intervals().simulated(fit.shared, fit.x, fit.d, np.arange(len(fit.x) - n, len(fit.x)))
        self.fit = replace(fit, residuals=np.vstack([fit.residuals, residuals]), ends=np.vstack([fit.ends, ends]))

    def leave(self, n: int) -> None:
        """Marginalise the first n intervals; their sums of noise and unmodelled accelerations are remembered."""
        assert self.last is not None
        intervals, now, at = self.last.intervals, self.last.fit, self.last.at
        boundary = marginal(at, intervals, now, n)
        rows = n * self.length
        self._remember(intervals, now, n)
        fit = self.fit
        kept = {name: getattr(fit, name)[n:] for name in ("x", "d", "ends")}
        self.fit = replace(fit, residuals=fit.residuals[rows:], boundary=boundary, **kept)
        self.first, self.times = self.first + rows, self.times[n:]

    def diffuse(self, std: FloatArray) -> None:
        """Random changes of the parameters, of given standard deviations ``(n_p,)``, before the window."""
        changing = np.flatnonzero(std)
        if self.fit.boundary is not None and len(changing):
            root = np.zeros((len(std), len(changing)))
            root[changing, np.arange(len(changing))] = std[changing]
            self.fit = replace(self.fit, boundary=self.fit.boundary.diffused(root))

    # ------------------------------------------------------------------ the fit

    def optimise(self) -> Linearization:
        """Steps of the fit and of its scales from the state of the window; the first linearisation."""
        intervals = self.intervals()
        first: Linearization | None = None
        for _ in range(_MOST_STEPS):
            at = linearized(intervals, self.fit)
            before = self.fit
            taken = gauss_newton_step(intervals, before, at, self.damping)
            self.last = Linearization(intervals, before, at.of_fit, taken.solved)
            self.damping = taken.damping
            self.fit = self._with_scales(intervals, taken.fit, taken.solved)
            first = first or self.last
            moved = np.abs(taken.fit.shared - before.shared)
            if (moved <= _SETTLED * np.sqrt(np.diag(taken.solved.var_p))).all():
                break
        assert first is not None
        return first

    def _with_scales(self, intervals: ShootingIntervals, fit: Fit, solved: Factored) -> Fit:
        """The fit with its scales, from the window and what is remembered."""
        inlying = fit.noise.inlying(fit.residuals, intervals.known)
        noise = fit.noise.of_sums(NoiseSums.of(fit.residuals, intervals.known, inlying).plus(self.noise))
        process = process_sums(intervals, fit, solved).total().plus(self.process)
        tau = np.maximum(process.most_probable_size(self.least, fit.tau), self.least)
        continuity = np.maximum(negligible_jumps(intervals, tau), unbroken_jumps(fit, solved))
        return replace(fit, noise=noise, tau=tau, rho=process.correlation(self.least), continuity_std=continuity)

    def _remember(self, intervals: ShootingIntervals, fit: Fit, n: int) -> None:
        """Add the sums of the first n intervals to those that are remembered, which fade."""
        assert self.last is not None
        rows = slice(n * self.length)
        residuals, known = fit.residuals[rows], intervals.known[rows]
        faded = self.kept**n
        sums = NoiseSums.of(residuals, known, fit.noise.inlying(residuals, known))
        self.noise = sums.plus(self.noise, faded)
        process = process_sums(intervals, fit, self.last.solved).part(slice(1, n + 1)).total()
        self.process = process.plus(self.process, faded)

    # ------------------------------------------------------------------ what it tells

    def outliers(self, signals: list[tuple[str, int]]) -> dict[str, float]:
        """Fraction of the samples of some signals, by name and column, that are outliers."""
        assert self.last is not None
        known = self.last.intervals.known
        inlying = self.fit.noise.inlying(self.fit.residuals, known).sum(axis=0)
        return {name: float(1.0 - inlying[k] / known[:, k].sum()) for name, k in signals}

    def last_state(self) -> dict[str, float]:
        """Most probable state in the last row."""
        assert self.last is not None
        intervals, fit, last = self.last.intervals, self.fit, np.array([len(self) - 1])
        series = intervals.rollouts.trajectories(intervals.batch(fit.shared, fit.x, fit.d, last))
        state = self.setup.model.state
        return dict(zip(state, series[0, -1, : len(state)].tolist(), strict=True))
