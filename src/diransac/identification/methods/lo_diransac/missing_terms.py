"""Terms that explain the unmodelled forces over the fitted motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.candidate_terms import TermLibrary, candidate_terms
from diransac.identification.methods.lo_diransac.normal_equations import linearize
from diransac.identification.methods.lo_diransac.projection import residuals_of_motion
from diransac.identification.methods.lo_diransac.refinement import weights_of
from diransac.identification.suggestions import (
    MeanForces,
    Suggestion,
    changes_beside,
    select_terms,
    spanned,
    suggestions_of,
)

if TYPE_CHECKING:
    from diransac.identification.candidate_terms import CandidateTerms
    from diransac.identification.methods.lo_diransac.normal_equations import Fit
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals

__all__ = ["MissingTerms", "missing_terms"]


@dataclass(frozen=True)
class MissingTerms:
    """Terms that the model lacks.

    Parameters
    ----------
    suggestions : tuple of Suggestion
        The one that explains most first; empty where none is supported by the logs.
    change : (n,) array
        Change of the parameters in a regression that has the terms, too.
    """

    suggestions: tuple[Suggestion, ...]
    change: FloatArray


def missing_terms(
    intervals: ShootingIntervals, fit: Fit, parameters: FloatArray, library: TermLibrary | None = None
) -> MissingTerms:
    """Terms that explain the unmodelled forces, each supported by the logs.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
        Most probable motion.
    parameters : (n,) array
        Estimate, per-log parameters of every log included.
    library : callable, optional
        The user's candidates.

    Returns
    -------
    MissingTerms
    """
    rows = _Rows(intervals, *residuals_of_motion(intervals, fit, parameters))
    speeds = np.sqrt(np.square(rows.motion[1][intervals.counted]).mean(axis=0))
    candidates = candidate_terms(intervals.model, speeds, library)
    means = _mean_forces(rows, fit, candidates)
    selected = select_terms(means)
    return MissingTerms(suggestions_of(candidates, selected), changes_beside(means, selected)[: intervals.n_p])


class _Rows:
    """Fitted motion and residuals in the rows of the intervals, and means over those of an interval that count."""

    def __init__(
        self,
        intervals: ShootingIntervals,
        motion: tuple[FloatArray, ...],
        r: FloatArray,
        W: FloatArray,
        M: FloatArray,
    ) -> None:
        self.intervals, self.motion, self.r, self.W, self.M = intervals, motion, r, W, M
        counted = intervals.counted.astype(float)
        counts = np.maximum(counted.reshape(len(intervals), -1).sum(axis=1), 1.0)
        self.weights = counted / np.repeat(counts, intervals.length)

    def mean(self, values: FloatArray) -> FloatArray:
        """Mean of each interval that has any, (n, ...)."""
        weighted = values * self.weights.reshape(-1, *(1,) * (values.ndim - 1))
        sums = weighted.reshape(len(self.intervals), -1, *values.shape[1:]).sum(axis=1)
        return np.asarray(sums[self.intervals.occupied])

    def input_rates(self, candidates: CandidateTerms) -> FloatArray:
        """``dr/du_j du_j/dt`` (N, n_v, n_u): the effect of a delay of each input."""
        model, q, v, a, u, p = self.intervals.model, *candidates.symbols
        slopes = ca.Function("slopes", [q, v, a, u, p], [ca.densify(ca.jacobian(model.residual(q, v, a, u, p), u))])
        found = np.array(slopes(*(x.T for x in self.motion))).reshape(model.n_v, -1, model.n_u).swapaxes(0, 1)
        return np.asarray(found * self.intervals.moving_inputs[:, None, model.n_u :])


def _mean_forces(rows: _Rows, fit: Fit, candidates: CandidateTerms) -> MeanForces:
    intervals, n_x = rows.intervals, fit.x.shape[1]
    n_p, n_v, n_u = intervals.n_p, intervals.model.n_v, intervals.model.n_u
    at = linearize(intervals, fit, weights_of(intervals, fit))
    found = at.system.solve(at.right_z, at.right_s)
    alone = (found.var_z - found.gain @ found.var_p @ found.gain.swapaxes(1, 2))[intervals.occupied]
    M = rows.mean(rows.M)
    of_force = np.einsum("wij,wjk,wik->wi", M, alone[:, n_x:, n_x:], M)
    inertial = np.einsum("nij,nj->ni", rows.M, rows.motion[2])[intervals.counted]
    force = rows.mean(rows.r)
    own = rows.mean(np.concatenate([rows.W, rows.input_rates(candidates)], axis=2))
    level = rows.mean(np.hstack([np.ones((len(rows.r), 1)), intervals.inputs]))
    discrepancies = _discrepancies(force, own, level)
    place = slice(n_p, n_p + n_v * (n_u + 1))
    return MeanForces(
        force=force,
        noise=np.sqrt(np.maximum(of_force, 0.0).mean(axis=0)),
        inertial=np.sqrt(np.square(inertial).mean(axis=0)),
        own=own,
        discrepancies=discrepancies,
        discrepancy_covariance=found.var_p[place, place],
        terms=candidates.means(rows.motion, rows.weights, intervals.length)[intervals.occupied],
        is_input_gain=candidates.is_input_gain,
        groups=candidates.groups,
        log_of=intervals.log_of[intervals.occupied],
    )


def _discrepancies(force: FloatArray, own: FloatArray, level: FloatArray) -> FloatArray:
    """Columns (W, n_v, n_v (n_u + 1)) of bias and input gains in each equation.

    Where parameters and gains together satisfy an equation identically, the gains have no effect of their own: the
    projection takes them to the force itself, and only the fit's prior determined them.
    """
    n, n_v, k = *force.shape, level.shape[1]
    columns = np.zeros((n, n_v, n_v, k))
    for i in range(n_v):
        identical = spanned(force[:, i], own[:, i], level)
        columns[:, i, i] = np.where(identical & (np.arange(k) > 0), 0.0, level)
    return columns.reshape(n, n_v, n_v * k)
