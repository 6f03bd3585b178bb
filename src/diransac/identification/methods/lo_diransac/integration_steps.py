"""Integration steps per sample: as few as leave every parameter and the evidence where they are.

Fewer steps change the residuals of a fit and the ends of its intervals.  The Gauss-Newton step that answers this change
tells how far the parameters of the fit would move, and how much its cost would change.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.identification.methods.lo_diransac.normal_equations import data_gradient, linearize, weights_of

if TYPE_CHECKING:
    from diransac.arrays import FloatArray
    from diransac.identification.methods.lo_diransac.normal_equations import Fit, NormalEquations
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals

# Change of a parameter, standard errors, that adds half a per cent to its uncertainty, and of the cost, nats.
_NEGLIGIBLE, _NEGLIGIBLE_COST = 0.1, 0.5
# Numbers of steps that are tried; one would need machine code of its own.
_FEW = (2, 3)


def with_fewest_steps(intervals: ShootingIntervals, fit: Fit, most: int) -> ShootingIntervals:
    """The intervals with the fewest integration steps per sample by which no parameter changes noticeably.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
        At its optimum.
    most : int
        Steps with which others are compared.

    Returns
    -------
    ShootingIntervals
    """
    finest = replace(intervals, substeps=most)
    simulated, at = finest.simulated(fit.shared, fit.x, fit.d), linearize(intervals, fit, weights_of(intervals, fit))
    for n in _FEW:
        if n >= most:
            break
        other = replace(intervals, substeps=n)
        residuals, ends = (a - b for a, b in zip(other.simulated(fit.shared, fit.x, fit.d), simulated, strict=True))
        moved, change = _answer(intervals, fit, at, residuals, ends)
        if (moved < _NEGLIGIBLE).all() and abs(change) < _NEGLIGIBLE_COST:
            return other
    return finest


def _answer(
    intervals: ShootingIntervals, fit: Fit, at: NormalEquations, residuals: FloatArray, ends: FloatArray
) -> tuple[FloatArray, float]:
    """Changes ``(n,)`` of the parameters, standard errors, and of the cost, if residuals and ends change."""
    k, jumps = intervals.n_p, np.where(intervals.linked[:, None], -ends[:-1], 0.0)
    z, s = data_gradient(intervals, fit, at.weights, intervals.measured - residuals)
    by_jumps_z, by_jumps_s = at.by_jumps(intervals, jumps)
    right_z, right_s = z - at.data_z - by_jumps_z, (s - at.data_s).sum(axis=0) - by_jumps_s
    solved = at.system.solve(right_z, right_s)
    change = (at.weights * residuals * (fit.residuals + 0.5 * residuals)).sum()
    change += (at.precision * jumps * (at.jumps + 0.5 * jumps)).sum()
    change -= 0.5 * ((right_z * solved.step_z).sum() + right_s @ solved.step_p)
    return np.abs(solved.step_p[:k]) / np.sqrt(np.diag(solved.var_p)[:k]), float(change)
