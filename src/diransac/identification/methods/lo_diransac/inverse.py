"""The force that the measured motion needs by an estimate, in blocks that it was not estimated from.

Residuals of the equations at the motion that is smoothed without the model are averaged under bumps of a window's
length, as rows of the weak form are: noise averages out, and little depends on accelerations.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.identification.methods.lo_diransac.hypotheses import bump_of, firsts_of
from diransac.identification.methods.lo_diransac.motion_equations import residuals_of_rows
from diransac.identification.methods.lo_diransac.unmeasured import unmeasured_states

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.forward import Reference
    from diransac.identification.methods.lo_diransac.segments import ActingInputs
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
    from diransac.identification.methods.lo_diransac.sources import Candidate


def forces_left(reference: Reference, candidates: Sequence[Candidate]) -> list[FloatArray]:
    """Mean squares ``(n_equations, n_blocks)`` of the force that is left in each block, over that of the force.

    Each by the candidate's estimate without the block.  The force of an equation is the larger one of inertial force
    and force of the inputs, as the middle of the candidates has it; an equation without any is left out.
    """
    intervals, blocks = reference.intervals, reference.blocks
    equations = equations_of_measured_states(intervals)
    firsts = np.concatenate([firsts_of(intervals, x) for x in intervals.rows_of_logs])
    if not (len(equations) and len(firsts)):
        return [np.empty((0, blocks.n))] * len(candidates)
    block, left, sizes = blocks.of_row[firsts + intervals.length // 2], [], []
    for candidate in candidates:
        with np.errstate(all="ignore"):
            means = _mean_residuals(reference, candidate, firsts, equations)
            sizes.append(np.var([means[0] - means[1], means[0] - means[2]], axis=1).max(axis=0))
            parts = [np.square(means[0, block == k]) for k in range(blocks.n)]
            squares = np.array([x.mean(axis=0) if len(x) else np.full(len(equations), np.nan) for x in parts]).T
        left.append(np.nan_to_num(squares, nan=np.nan, posinf=1e200))
    size = np.median(sizes, axis=0)
    used = np.isfinite(size) & (size > 0.0)
    return [x[used] / size[used, None] for x in left]


def _mean_residuals(reference: Reference, candidate: Candidate, firsts: IntArray, equations: IntArray) -> FloatArray:
    """Means ``(3, K, n_equations)`` of residuals under bumps: as they are, without inertia, and without inputs."""
    intervals, model, u = reference.intervals, reference.intervals.model, _between(candidate.acting)
    q, v, a, _ = reference.motion.parts(model, slice(None))
    p = candidate.without[reference.blocks.of_row]
    if not intervals.layout.is_shared:
        p = np.take_along_axis(p, intervals.layout.index[intervals.log_of_row], axis=1)
    forces = ((a, u), (np.zeros_like(a), u), (a, np.zeros_like(u)))
    rows = np.array([residuals_of_rows(model, q, v, x, w, p)[:, equations] for x, w in forces])
    windows = np.lib.stride_tricks.sliding_window_view(rows, intervals.length, axis=1)
    return np.asarray(windows[:, firsts] @ bump_of(intervals.length))


def _between(acting: ActingInputs) -> FloatArray:
    """Inputs ``(N, n_u)`` around the instant of each row, at which accelerations are those between two held inputs."""
    u = acting.values
    return 0.5 * (u + np.concatenate([u[:1], u[:-1]])) if acting.hold == "zero-order" else u


def equations_of_measured_states(intervals: ShootingIntervals) -> IntArray:
    """Equations in which no unmeasured state enters, nor a derivative of it."""
    model, unmeasured = intervals.model, unmeasured_states(intervals)
    hidden = [name for chain in model.chains if not set(unmeasured).isdisjoint(chain) for name in chain]
    names = (*model.coordinates, *model.velocities, *model.accelerations)
    enters = np.hstack([np.array(ca.DM(model.residual.sparsity_jac(k, 0), 1)) != 0.0 for k in range(3)])
    return np.flatnonzero(~enters[:, np.isin(names, hidden)].any(axis=1))
