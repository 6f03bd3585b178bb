"""Terms that the model lacks, from the unmodelled forces over the fitted motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.identification.methods.lo_diransac.motion_equations import inertia_slopes, residuals_of_motion
from diransac.identification.methods.lo_diransac.normal_equations import linearize, weights_of
from diransac.identification.methods.lo_diransac.projection import means_of_windows
from diransac.identification.structure.candidate_terms import TermLibrary, candidate_terms
from diransac.identification.structure.term_selection import (
    MeanForces,
    changes_beside,
    select_terms,
    spanned,
    suggestions_of,
)
from diransac.simulation.compiler import compile_map

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.normal_equations import Fit
    from diransac.identification.methods.lo_diransac.projection import ProjectedEstimate
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
    from diransac.identification.structure.candidate_terms import CandidateTerms
    from diransac.identification.structure.lacking_terms import Suggestion
    from diransac.model import Model
    from diransac.simulation.compiler import Map

__all__ = ["MissingTerms", "candidates_of", "missing_terms", "short_windows"]

# Part of the samples of an input that its size bounds.
_MOSTLY = 0.99
# Most intervals over which forces are averaged.
_LONGEST = 4
# Number of rows at which the inertia is compared.
_SOME = 20


@dataclass(frozen=True)
class MissingTerms:
    """Terms that the model lacks.

    Parameters
    ----------
    suggestions : tuple of Suggestion
        The one that explains most first; empty where none is supported by the logs.
    change : (n,) array
        Change of the parameters in a regression that has the terms, too.
    accelerations : (W, n_v) array
        What the suggested terms explain of the unmodelled acceleration of each interval, beside such changes.
    """

    suggestions: tuple[Suggestion, ...]
    change: FloatArray
    accelerations: FloatArray


def missing_terms(
    intervals: ShootingIntervals, fit: Fit, result: ProjectedEstimate, library: TermLibrary | None = None
) -> MissingTerms:
    """Terms that explain the unmodelled forces, each supported by the logs.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
        Most probable motion.
    result : ProjectedEstimate
        With the windows over which forces are averaged.
    library : callable, optional
        The user's candidates.

    Returns
    -------
    MissingTerms
    """
    windows = short_windows(result.windows, len(intervals))
    rows = _Rows(intervals, windows, *residuals_of_motion(intervals, fit, result.parameters))
    candidates, terms = candidates_of(intervals, rows.motion, library)
    means = _mean_forces(rows, fit, candidates, terms)
    selected = select_terms(means)
    helpful = [x for x in selected if x.explained > 0.0]
    forces = rows.of_intervals(rows.own) @ changes_beside(means, helpful)
    forces += terms[:, :, [x.index for x in helpful]] @ np.array([x.value for x in helpful])
    accelerations = -np.einsum("wij,wj->wi", np.linalg.pinv(rows.M[intervals.starts]), forces)
    change = changes_beside(means, selected)[: intervals.n_p]
    return MissingTerms(suggestions_of(candidates, helpful), change, accelerations)


def candidates_of(
    intervals: ShootingIntervals, motion: Sequence[FloatArray], library: TermLibrary | None = None
) -> tuple[CandidateTerms, FloatArray]:
    """Candidate terms of a motion, and their means over intervals.

    Parameters
    ----------
    intervals : ShootingIntervals
    motion : sequence of (N, n) array
        q, v, a, u and p of every row.
    library : callable, optional
        The user's candidates.

    Returns
    -------
    CandidateTerms
    (W, n_v, K) array
        0 where an interval has no row that counts.
    """
    speeds = np.sqrt(np.square(motion[1][intervals.counted]).mean(axis=0))
    inputs = motion[3][intervals.counted]
    sizes = np.stack([np.sqrt(np.square(inputs).mean(axis=0)), np.quantile(np.abs(inputs), _MOSTLY, axis=0)], axis=1)
    candidates = candidate_terms(intervals.model, speeds, sizes, library)
    return candidates, candidates.means(motion, weights_of_rows(intervals), intervals.length)


def weights_of_rows(intervals: ShootingIntervals) -> FloatArray:
    """Weights ``(N,)`` of the rows of each interval in its mean: equal for those that count, 0 for others."""
    counted = intervals.counted.astype(float)
    counts = np.maximum(counted.reshape(len(intervals), -1).sum(axis=1), 1.0)
    return np.asarray(counted / np.repeat(counts, intervals.length))


def short_windows(windows: IntArray, n: int) -> IntArray:
    """Windows over which forces are averaged in the search for terms.

    Windows that attenuate no parameter may be longer than a reversal, and averages hide friction that changes its sign
    in between.  Noise of the accelerations matters less to terms: they are functions of coordinates, velocities and
    inputs.

    Parameters
    ----------
    windows : (n_windows,) int array
        First intervals of those of the parameters.
    n : int
        Number of intervals.

    Returns
    -------
    (at least n_windows,) int array
        First intervals of the same, or of parts of four intervals.
    """
    place = np.arange(n) - np.repeat(windows, np.diff(windows, append=n))
    return np.flatnonzero(place % _LONGEST == 0)


class _Rows:
    """Fitted motion and residuals in the rows of the intervals, and means over those of a window that count."""

    def __init__(
        self,
        intervals: ShootingIntervals,
        windows: IntArray,
        motion: tuple[FloatArray, ...],
        r: FloatArray,
        W: FloatArray,
        M: FloatArray,
    ) -> None:
        self.intervals, self.motion, self.r, self.W, self.M = intervals, motion, r, W, M
        self.weights = weights_of_rows(intervals)
        window = np.searchsorted(windows, np.flatnonzero(intervals.occupied), side="right")
        self.windows = np.flatnonzero(np.diff(window, prepend=-1))

    def of_intervals(self, values: FloatArray) -> FloatArray:
        """Mean of each interval (W, ...)."""
        weighted = values * self.weights.reshape(-1, *(1,) * (values.ndim - 1))
        return np.asarray(weighted.reshape(len(self.intervals), -1, *values.shape[1:]).sum(axis=1))

    def mean(self, values: FloatArray) -> FloatArray:
        """Mean of each window that has any, (n, ...)."""
        return self.over_windows(self.of_intervals(values))

    def over_windows(self, values: FloatArray) -> FloatArray:
        """Means of values of intervals ``(W, ...)``."""
        return means_of_windows(values[self.intervals.occupied], self.windows)

    @cached_property
    def own(self) -> FloatArray:
        """Columns (N, n_v, n + n_u) of the parameters, and of a delay of each input, ``dr/du_j du_j/dt``."""
        later = self.intervals.later_inputs
        delays = _input_slopes(self.intervals.model, self.motion) * later[:, None, :]
        return np.concatenate([self.W, delays], axis=2)


def _mean_forces(rows: _Rows, fit: Fit, candidates: CandidateTerms, terms: FloatArray) -> MeanForces:
    """Means over windows, of the terms from those over intervals ``(W, n_v, K)``."""
    intervals, n_x = rows.intervals, fit.x.shape[1]
    n_p, n_v, n_u = intervals.n_p, intervals.model.n_v, intervals.model.n_u
    quadratic = linearize(intervals, fit, weights_of(intervals, fit))
    found = quadratic.system.solve(quadratic.right_z, quadratic.right_s)
    M, sizes = rows.mean(rows.M), np.diff(rows.windows, append=intervals.occupied.sum())
    of_force = np.einsum("wij,wjk,wik->wi", M, rows.over_windows(found.alone[:, n_x:, n_x:]), M) / sizes[:, None]
    inertial = np.einsum("nij,nj->ni", rows.M, rows.motion[2])[intervals.counted]
    force = rows.mean(rows.r)
    own = rows.mean(rows.own)
    level = rows.mean(np.hstack([np.ones((len(rows.r), 1)), intervals.inputs]))
    discrepancies = _discrepancies(force, own, level)
    place = slice(n_p, n_p + n_v * (n_u + 1))
    some = np.unique(np.linspace(0, len(rows.windows) - 1, _SOME).astype(int))
    at = intervals.starts[intervals.occupied][rows.windows[some]]
    slopes = inertia_slopes(intervals, rows.motion, at)
    return MeanForces(
        force=force,
        noise=np.sqrt(np.maximum(of_force, 0.0).mean(axis=0)),
        inertial=np.sqrt(np.square(inertial).mean(axis=0)),
        own=own,
        inertia=rows.M[at],
        inertia_slopes=np.pad(slopes, [(0, 0)] * 3 + [(0, own.shape[2] - slopes.shape[3])]),
        discrepancies=discrepancies,
        discrepancy_covariance=found.var_p[place, place],
        terms=rows.over_windows(terms),
        is_input_gain=candidates.is_input_gain,
        bounds=candidates.bounds,
        groups=candidates.groups,
        log_of=intervals.log_of[intervals.occupied][rows.windows],
    )


def _input_slopes(model: Model, motion: tuple[FloatArray, ...]) -> FloatArray:
    """``dr/du`` (N, n_v, n_u) over a motion."""
    (columns,) = _input_slope_map(model)(*motion)
    return np.asarray(columns.reshape(-1, model.n_u, model.n_v).swapaxes(1, 2))


@lru_cache(maxsize=64)
def _input_slope_map(model: Model) -> Map:
    """Derivatives of the residuals with respect to the inputs, column by column."""
    symbols = [ca.SX.sym(n, model.residual.size1_in(i)) for i, n in enumerate("qvaup")]
    slopes = ca.densify(ca.jacobian(model.residual(*symbols), symbols[3]))
    return compile_map(ca.Function("input_slopes", symbols, [slopes]))


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
