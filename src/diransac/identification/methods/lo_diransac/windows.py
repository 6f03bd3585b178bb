"""A log cut into windows of equal length, each a rollout of its own: the lanes of multiple shooting."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.identification.methods.lo_diransac.freed import Freed, freed
from diransac.simulation import Measurements, RolloutBatch, rollouts

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.normal_equations import Fit
    from diransac.model import Model
    from diransac.simulation import Rollouts

__all__ = ["Windows"]

# Integration steps from row to row: a log is a machine's, and one step is off by a percent where dry friction switches
# or links are light.  They cost little beside what else a fit does.
_SUBSTEPS = 5
_DIVERGED = 1e6
_WELL_CONDITIONED = 1e8


@dataclass(frozen=True)
class Windows:
    """One log as windows of ``length`` rows; the last is filled up with rows in which nothing is known.

    Parameters
    ----------
    model : what is identified
    measured, known : (N, n_s)   every signal of the model, in its order
    inputs : (N, n_u)
    dt : s
    length : rows of a window
    n_logged : rows of the log; all that are given, by default
    """

    model: Model
    measured: FloatArray
    known: BoolArray
    inputs: FloatArray
    dt: float
    length: int
    n_logged: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "n_logged", self.n_logged or len(self.measured))
        missing = -len(self.measured) % self.length
        if missing:
            object.__setattr__(self, "known", np.pad(self.known, ((0, missing), (0, 0))))
            for name in ("measured", "inputs"):
                object.__setattr__(self, name, np.pad(getattr(self, name), ((0, missing), (0, 0)), mode="edge"))

    def __len__(self) -> int:
        return len(self.measured) // self.length

    @cached_property
    def starts(self) -> IntArray:
        """First row of each window."""
        return np.arange(len(self), dtype=np.int64) * self.length

    @cached_property
    def every(self) -> BoolArray:
        """All rows count; what isn't known in them has no weight."""
        return np.ones(len(self.measured), bool)

    @cached_property
    def is_logged(self) -> BoolArray:
        """Which rows ``(N,)`` are the log's."""
        return np.arange(len(self.measured)) < self.n_logged

    @property
    def duration(self) -> float:
        """Of a window, s."""
        return self.length * self.dt

    @cached_property
    def freed(self) -> Freed:
        """The model with what it may lack."""
        return freed(self.model)

    @cached_property
    def rollouts(self) -> Rollouts:
        """Of the freed model."""
        return rollouts(self.freed.model, substeps=_SUBSTEPS)

    @cached_property
    def moving_inputs(self) -> FloatArray:
        """Inputs, and how they change with a row of delay, (N, 2 n_u)."""
        later = np.gradient(self.inputs, axis=0) if len(self.inputs) > 1 else np.zeros_like(self.inputs)
        return np.hstack([self.inputs, -later])

    def delayed(self, rows: int) -> Windows:
        """The same log with its inputs acting some rows later."""
        at = np.clip(np.arange(len(self.inputs)) - rows, 0, len(self.inputs) - 1)
        return replace(self, inputs=self.inputs[at])

    @cached_property
    def measurements(self) -> Measurements:
        """Of every row."""
        return Measurements(self.measured, self.every)

    def lanes(self, shared: FloatArray, x: FloatArray, d: FloatArray) -> RolloutBatch:
        """A rollout for every window."""
        parameters = np.hstack([np.broadcast_to(shared, (len(x), len(shared))), d])
        return RolloutBatch(parameters, x, self.moving_inputs, self.dt, self.starts, self.length)

    def judged(self, fit: Fit) -> Fit:
        """The fit with the residuals that it has here."""
        return replace(fit, residuals=self.residuals(fit.shared, fit.x, fit.d))

    def residuals(self, shared: FloatArray, x: FloatArray, d: FloatArray) -> FloatArray:
        """Simulated less measured, (N, n_s); huge from a divergence on."""
        return np.nan_to_num(self._errors(shared, x, d), nan=_DIVERGED, posinf=_DIVERGED, neginf=-_DIVERGED)

    def ends(self, shared: FloatArray, x: FloatArray, d: FloatArray) -> FloatArray:
        """States (W - 1, n_x) in which the windows end, but for the last: where their successors begin."""
        lanes = self.lanes(shared, x, d)
        series = self.rollouts.trajectories(
            RolloutBatch(lanes.parameters[:-1], x[:-1], lanes.inputs, self.dt, self.starts[:-1], self.length + 1)
        )
        return series[:, -1, : x.shape[1]]

    def origins(self, shared: FloatArray, x: FloatArray, d: FloatArray) -> FloatArray:
        """States (W - 1, n_x) from which the windows, but for the last, would end where their successors begin.

        By one of Newton's steps; states as they are where that has no answer.
        """
        sums = self.rollouts.gauss_newton(self.lanes(shared, x, d), self.measurements, np.zeros(self.measured.shape))
        jumps, slopes = x[1:] - sums.final_states[:-1], sums.final_slopes[:-1, :, -x.shape[1] :]
        finite = np.isfinite(jumps).all(axis=1) & np.isfinite(slopes).all(axis=(1, 2))
        usable = np.flatnonzero(finite)
        usable = usable[np.linalg.cond(slopes[usable]) < _WELL_CONDITIONED]
        found = x[:-1].copy()
        found[usable] += np.linalg.solve(slopes[usable], jumps[usable][:, :, None])[:, :, 0]
        return found

    def _errors(self, shared: FloatArray, x: FloatArray, d: FloatArray) -> FloatArray:
        series = self.rollouts.errors(self.lanes(shared, x, d), self.measurements)
        return series.reshape(self.measured.shape)
