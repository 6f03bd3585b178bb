"""The force that the measured motion needs by an estimate, in blocks that it was not estimated from.

Residuals of the equations at the motion that is smoothed without the model are averaged under bumps of a window's
length, as rows of the weak form are: noise averages out, and little depends on accelerations.  Equations in which a
state enters that nothing measures are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.identification.methods.lo_diransac.hypotheses import bump_of, firsts_of
from diransac.identification.methods.lo_diransac.motion_equations import residuals_of_rows
from diransac.identification.methods.lo_diransac.unmeasured import unmeasured_states

if TYPE_CHECKING:
    from diransac.identification.core.windows import ShootingIntervals
    from diransac.identification.methods.lo_diransac.segments import ActingInputs
    from diransac.identification.methods.lo_diransac.smoothing import Motion
    from diransac.identification.methods.lo_diransac.sources import Blocks, Candidate
    from diransac.model import Model

_LARGEST = 1e200
"""Mean square in place of one that overflows."""


@dataclass(frozen=True, eq=False, repr=False)
class Inverse:
    """Windows of the logs in which the equations hold in the mean.

    Parameters
    ----------
    intervals : ShootingIntervals
    motion : Motion
        Smoothed without the model.
    blocks : Blocks
    firsts : (K,) int array
        First rows of the windows.
    equations : (n_equations,) int array
        Those of which all states are measured.
    """

    intervals: ShootingIntervals
    motion: Motion
    blocks: Blocks
    firsts: IntArray
    equations: IntArray

    @classmethod
    def of(cls, intervals: ShootingIntervals, motion: Motion, blocks: Blocks) -> Inverse:
        """Overlapping windows that lie within one log each, and outside of gaps."""
        firsts = [firsts_of(intervals, x) for x in intervals.rows_of_logs]
        measured = np.flatnonzero(_of_measured_states(intervals.model, unmeasured_states(intervals)))
        return cls(intervals, motion, blocks, np.concatenate(firsts), measured)

    def forces_left(self, candidates: Sequence[Candidate]) -> list[FloatArray]:
        """Mean squares ``(n_equations, n_blocks)`` of the force that is left in each block, over that of the force.

        Each by the candidate's estimate without the block.  The force of an equation is the larger one of inertial
        force and force of the inputs, as the middle of the candidates has it; an equation without any is left out.

        Parameters
        ----------
        candidates : sequence of Candidate
        """
        if not (len(self.equations) and len(self.firsts)):
            return [np.empty((0, self.blocks.n))] * len(candidates)
        found, sizes = zip(*map(self._of_candidate, candidates), strict=True)
        size = np.median(sizes, axis=0)
        used = np.isfinite(size) & (size > 0.0)
        return [one[used] / size[used, None] for one in found]

    def _of_candidate(self, one: Candidate) -> tuple[FloatArray, FloatArray]:
        """Mean squares of what is left ``(n_equations, n_blocks)``, and of the force ``(n_equations,)``."""
        model, u = self.intervals.model, _between(one.acting)
        q, v, a, _ = self.motion.parts(model, slice(None))
        p = one.without[self.blocks.of_row]
        if not self.intervals.layout.is_shared:
            p = np.take_along_axis(p, self.intervals.layout.index[self.intervals.log_of_row], axis=1)
        with np.errstate(all="ignore"):
            left, without_inertia, without_inputs = (
                self._means(residuals_of_rows(model, q, v, x, w, p))
                for x, w in ((a, u), (np.zeros_like(a), u), (a, np.zeros_like(u)))
            )
            variances = np.var([left - without_inertia, left - without_inputs], axis=1)
            squares, block = np.square(left), self.blocks.of_row[self.firsts + self.intervals.length // 2]
        own = [squares[block == k] for k in range(self.blocks.n)]
        means = [x.mean(axis=0) if len(x) else np.full(squares.shape[1], np.nan) for x in own]
        return np.nan_to_num(np.array(means).T, nan=np.nan, posinf=_LARGEST), variances.max(axis=0)

    def _means(self, rows: FloatArray) -> FloatArray:
        """Means ``(K, n_equations)`` under the bumps of the windows."""
        windows = np.lib.stride_tricks.sliding_window_view(rows[:, self.equations], self.intervals.length, axis=0)
        return np.asarray(windows[self.firsts] @ bump_of(self.intervals.length))


def _between(acting: ActingInputs) -> FloatArray:
    """Inputs ``(N, n_u)`` around the instant of each row, at which accelerations are those between two held inputs."""
    u = acting.values
    return 0.5 * (u + np.concatenate([u[:1], u[:-1]])) if acting.hold == "zero-order" else u


def _of_measured_states(model: Model, unmeasured: Sequence[str]) -> BoolArray:
    """Mask ``(n_v,)`` of the equations in which no unmeasured state enters, nor a derivative of it."""
    lost = {name for chain in model.chains if not set(unmeasured).isdisjoint(chain) for name in chain}
    found = np.ones(model.n_v, bool)
    for k, names in enumerate((model.coordinates, model.velocities, model.accelerations)):
        enters = np.array(ca.DM(model.residual.sparsity_jac(k, 0), 1)) != 0.0
        found &= ~enters[:, [name in lost for name in names]].any(axis=1)
    return found
