"""Terms that the model may lack: tests of all candidates at a fit, suggested terms, and possible ones.

Every candidate term is tested at the final fit, exact or flexible.  A term ``theta h`` of the equations accelerates
the model by ``-M^-1 h theta``, as the unmodelled accelerations of the fit do, so that its slopes are in the normal
equations.  One solution of these for all candidates gives what each changes in the states, the parameters and the
unmodelled accelerations, and so in every residual of the fit: of the measurements, of continuity, and of the
unmodelled accelerations from their prior.  The evidence follows from these (`term_evidence`): terms that the log shows
are suggested; those that it cannot exclude widen the intervals of the parameters.

Terms that parameters equal whatever the motion, as a friction that the model has, are no candidates; nor are
discrepancies of the fit, which stand for the same forces: they are held at zero.

References
----------
Rao 1948 (score test).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.identification.methods.lo_diransac.motion_equations import (
    equations_of_rows,
    inertia_of_motion,
    means_of_intervals,
    residuals_of_motion,
    slopes_of_delays,
)
from diransac.identification.methods.lo_diransac.normal_equations import (
    innovations,
    linearize,
    of_logs,
    sum_in_places,
    weights_of,
)
from diransac.identification.methods.lo_diransac.term_evidence import (
    CandidateTests,
    MeanForces,
    TermRegression,
    select_terms,
    weighted,
)
from diransac.identification.structure.candidate_terms import TermLibrary, candidate_terms
from diransac.identification.structure.lacking_terms import PossibleTerm

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.normal_equations import Fit
    from diransac.identification.methods.lo_diransac.projection import ProjectedEstimate
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
    from diransac.identification.structure.candidate_terms import CandidateTerms
    from diransac.identification.structure.lacking_terms import Suggestion

# Part of the samples of an input that its size bounds.
_MOSTLY = 0.99
# Part of the variance of a parameter that a term must add to be kept.
_KEPT = 1e-3
# Part of the square of a term that parameters must leave on any motion.
_EQUIVALENT = 1e-6
# Draws of a motion, and as many per parameter and equation; the seed.
_DRAWS, _PER_PARAMETER, _SEED = 200, 4, 0
# Factor of the prior of discrepancies that holds them at zero.
_HELD = 1e-3
# Part of the information of an interval, and of the largest force, that is rounding.
_ROUNDING = 1e-12
_HUGE, _TINY = 1e9, 1e-300


@dataclass(frozen=True)
class Candidates:
    """Candidate terms at a fit.

    Parameters
    ----------
    library : CandidateTerms
        Those that act on the logs, and that parameters do not equal whatever the motion.
    units : (K,) array
        Coefficients with which the RMS force of a term is that of the largest force of its equation.
    regression : TermRegression
        On these, and on a delay of each input.
    forces : MeanForces
        Of these; 0 in intervals without a row that counts.
    inertia : (W, n_v, n_v) array
        Mean of each interval.
    """

    library: CandidateTerms
    units: FloatArray
    regression: TermRegression
    forces: MeanForces
    inertia: FloatArray

    @property
    def tests(self) -> CandidateTests:
        """Tests of the terms one by one, at the delays of the fit."""
        alone = self.regression.of(range(len(self.library)))
        return CandidateTests(self.library.terms, self.units, *alone.estimates(), alone.effects)


@dataclass(frozen=True)
class MissingTerms:
    """Terms that the model lacks.

    Parameters
    ----------
    suggestions : tuple of Suggestion
        The most probable one first; empty where none is supported by the logs.
    change : (n,) array
        Change of the parameters in a regression that has the terms, too.
    accelerations : (W, n_v) array
        What the suggested terms explain of the unmodelled acceleration of each interval, beside such changes.
    """

    suggestions: tuple[Suggestion, ...]
    change: FloatArray
    accelerations: FloatArray


def candidates_of_fit(
    intervals: ShootingIntervals, fit: Fit, result: ProjectedEstimate, library: TermLibrary | None = None
) -> Candidates:
    """Candidate terms with all that a fit says about them.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
        Most probable motion.
    result : ProjectedEstimate
    library : callable, optional
        The user's candidates.

    Returns
    -------
    Candidates
    """
    p, counted = fit.shared[: intervals.n_p], intervals.occupied
    motion, r, W, M = residuals_of_motion(intervals, fit, p)
    candidates, largest = _library(intervals, motion, library), _largest_forces(intervals, fit, motion, r, W, M)
    weights = _weights_of_rows(intervals)
    means = np.where(counted[:, None, None], candidates.means(motion, weights, intervals.length), 0.0)
    relative = (np.sqrt(np.square(means).sum(axis=0) / counted.sum()) / (largest[:, None] + _TINY)).max(axis=0)
    acting = np.isfinite(relative) & (relative > _ROUNDING)
    chosen = np.flatnonzero(acting & ~_replaceable(intervals, motion, candidates))
    means = means[:, :, chosen]
    rows = (r, W, slopes_of_delays(intervals, motion, p))
    r, W, delays = (_means(intervals, weights, x) for x in rows)
    inertia = np.where(counted[:, None, None], means_of_intervals(intervals, M), np.eye(len(largest)))
    accelerations = -np.linalg.solve(inertia, np.concatenate([means, delays], axis=2))

    def inertia_of(changes: FloatArray) -> FloatArray:
        return inertia_of_motion(intervals, motion, p + changes[: intervals.n_p])[intervals.counted]

    return Candidates(
        replace(candidates, terms=tuple(candidates.terms[k] for k in chosen)),
        1.0 / relative[chosen],
        _regression(intervals, fit, result, accelerations),
        MeanForces(r, np.concatenate([W, delays], axis=2), means, largest, inertia_of),
        inertia,
    )


def missing_terms(found: Candidates) -> MissingTerms:
    """Terms that explain the unmodelled forces, each supported by the logs.

    Parameters
    ----------
    found : Candidates

    Returns
    -------
    MissingTerms
    """
    terms, forces = found.library.terms, found.forces
    beside_delays = found.regression
    for k in range(len(terms), found.regression.columns.shape[2]):
        beside_delays = beside_delays.beside(k)
    regression = beside_delays.of(range(len(terms)))
    chosen = select_terms(terms, found.units, regression, forces)
    changes, values = forces.changes(chosen)
    suggestions = tuple(
        found.library.suggestion(k, float(value), regression.error(k, chosen), forces.explained(chosen[:i], k))
        for i, (k, value) in enumerate(zip(chosen, values, strict=True))
    )
    explained = forces.own @ changes + forces.terms[:, :, chosen] @ values
    accelerations = -np.linalg.solve(found.inertia, explained[:, :, None])[:, :, 0]
    return MissingTerms(suggestions, changes[: len(found.regression.effects)], np.asarray(accelerations))


def possible_terms(
    found: Candidates, result: ProjectedEstimate, covariance: FloatArray, names: Sequence[str]
) -> tuple[PossibleTerm, ...]:
    """Terms that the model may lack and that would change its parameters, the most probable first.

    Parameters
    ----------
    found : Candidates
    result : ProjectedEstimate
    covariance : (n, n) array
        Of the parameters, if the model is complete.
    names : sequence of str
        Of the parameters.

    Returns
    -------
    tuple of PossibleTerm
    """
    tests = found.tests
    weights, means, variances = weighted(tests)
    own = np.diag(covariance)
    own = np.where(np.isfinite(own), own, np.inf)
    # With the term, least squares, simulation error and the fit would agree: what the fit has then is the estimate's.
    shifts = tests.effects * means + (result.of_fit - result.parameters)[:, None]
    added = weights * (np.square(tests.effects) * variances + np.square(shifts))
    kept = np.flatnonzero((added > _KEPT * own[:, None]).any(axis=0) & np.isfinite(added).all(axis=0))
    return tuple(
        PossibleTerm(
            (term := tests.terms[k]).kind,
            term.place,
            term.formula,
            float(weights[k]),
            float(variances[k]),
            dict(zip(names, tests.effects[:, k].tolist(), strict=True)),
            dict(zip(names, shifts[:, k].tolist(), strict=True)),
            term.name,
        )
        for k in kept[np.argsort(-weights[kept], kind="stable")]
    )


def _library(intervals: ShootingIntervals, motion: Sequence[FloatArray], library: TermLibrary | None) -> CandidateTerms:
    """Candidates with the speeds and inputs of a motion: q, v, a, u and p of every row."""
    speeds = np.sqrt(np.square(motion[1][intervals.counted]).mean(axis=0))
    inputs = motion[3][intervals.counted]
    sizes = np.stack([np.sqrt(np.square(inputs).mean(axis=0)), np.quantile(np.abs(inputs), _MOSTLY, axis=0)], axis=1)
    return candidate_terms(intervals.model, speeds, sizes, library)


def _weights_of_rows(intervals: ShootingIntervals) -> FloatArray:
    """Weights ``(N,)`` of the rows of each interval in its mean: equal for those that count, 0 for others."""
    counted = intervals.counted.astype(float)
    counts = np.maximum(counted.reshape(len(intervals), -1).sum(axis=1), 1.0)
    return np.asarray(counted / np.repeat(counts, intervals.length))


def _means(intervals: ShootingIntervals, weights: FloatArray, values: FloatArray) -> FloatArray:
    """Weighted means ``(W, ...)`` of rows; 0 in intervals without a row that counts."""
    weighted = np.where(weights > 0.0, values.T * weights, 0.0).T
    return np.asarray(weighted.reshape(len(intervals), -1, *values.shape[1:]).sum(axis=1))


# ---------------------------------------------------------------------- what each term changes in a fit


def _regression(
    intervals: ShootingIntervals, fit: Fit, result: ProjectedEstimate, accelerations: FloatArray
) -> TermRegression:
    """The regression on effects that accelerate the model, constantly over each interval: (W, n_v, K) per unit."""
    prior = fit.prior.copy()
    prior[intervals.n_p :] *= _HELD
    at, n_x = linearize(intervals, replace(fit, prior=prior), weights_of(intervals, fit)), fit.x.shape[1]
    sums, k = intervals.gauss_newton(fit.shared, fit.x, fit.d, at.weights), n_x + fit.d.shape[1]
    pushed, precision = sums.normal_matrix[:, :, n_x:k] @ accelerations, at.precision[:, :, None]
    jumps = -at.slopes[:, :, n_x:k] @ accelerations[:-1]
    direct = (accelerations * pushed[:, n_x:k]).sum(axis=(0, 1)) + (precision * np.square(jumps)).sum(axis=(0, 1))
    of_z, of_s = at.by_jumps(intervals, jumps)
    of_z, of_s = of_z + pushed[:, :k], of_s + sum_in_places(intervals, pushed[:, k:])
    # The last column is the step of all else: what an unfinished fit, or one without discrepancies, gives up.
    z, s = at.system.functional(
        np.concatenate([-of_z, at.right_z[:, :, None]], axis=2), np.concatenate([-of_s, at.right_s[:, None]], axis=1)
    )
    effects = np.einsum("wkp,wke->pe", result.of_z, z[:, :, :-1], optimize=True) + result.of_s.T @ s[:, :-1]
    moved = np.concatenate([z, of_logs(intervals, s)], axis=1)
    moved[:, n_x:k, :-1] += accelerations
    measured = _of_measurements(sums.normal_matrix, sums.gradient, moved)
    ahead = np.concatenate([z[1:, :n_x] - at.slopes @ moved[:-1], at.jumps[:, :, None]], axis=2) * np.sqrt(precision)
    driven = [innovations(intervals, replace(fit, d=d)) for d in (*np.moveaxis(z[:, n_x:k], 2, 0), fit.d)]
    rows = np.concatenate([measured, np.pad(ahead, ((0, 1), (0, 0), (0, 0))), np.stack(driven, axis=2)], axis=1)
    beforehand = np.column_stack([s, fit.shared - fit.prior_mean]) / prior[:, None]
    more = np.pad(beforehand, ((0, -len(beforehand) % rows.shape[1]), (0, 0)))
    rows = np.concatenate([rows, more.reshape(-1, *rows.shape[1:])])
    return TermRegression(effects, direct, rows[:, :, -1] + rows[:, :, -2], rows[:, :, :-2])


def _of_measurements(H: FloatArray, gradient: FloatArray, moved: FloatArray) -> FloatArray:
    """Changes of whitened measurements by changes of an interval's unknowns (W, n, K), and residuals: (W, n, K + 1).

    As many rows as there are unknowns say all of the measurements: a square root of their information (W, n, n), and
    the residuals (W, n, 1) that have their gradient.
    """
    size = np.sqrt(np.einsum("wii->wi", H))
    size[size == 0.0] = 1.0
    values, vectors = np.linalg.eigh(H / (size[:, :, None] * size[:, None, :]))
    known = values > _ROUNDING * values[:, -1:]
    root = np.sqrt(np.where(known, values, 0.0))
    columns = np.ascontiguousarray((vectors * size[:, :, None] * root[:, None, :]).swapaxes(1, 2)) @ moved
    left = np.einsum("wji,wj->wi", vectors, gradient / size) / np.where(known, root, np.inf)
    return np.concatenate([columns, left[:, :, None]], axis=2)


# ---------------------------------------------------------------------- forces, and terms that parameters equal


def _largest_forces(
    intervals: ShootingIntervals,
    fit: Fit,
    motion: Sequence[FloatArray],
    r: FloatArray,
    W: FloatArray,
    M: FloatArray,
) -> FloatArray:
    """RMS (n_v,) of the largest force of each equation: inertial, of a parameter, or without one.

    In steady motion the inertial force is the smallest of all, and no measure of what a model may lack.
    """
    of_parameters = W * fit.shared[: intervals.n_p]
    inertial, known = np.einsum("nij,nj->ni", M, motion[2]), of_parameters.sum(axis=2) - r
    forces = np.concatenate([of_parameters, inertial[:, :, None], known[:, :, None]], axis=2)[intervals.counted]
    return np.asarray(np.sqrt(np.square(forces).mean(axis=0)).max(axis=1))


def _replaceable(intervals: ShootingIntervals, motion: Sequence[FloatArray], candidates: CandidateTerms) -> BoolArray:
    """Mask (K,) of terms that changes of the parameters equal on any motion of the model.

    Motions are drawn from the log, signal by signal, so that nothing is correlated, and velocities and inputs in
    proportions that they need not have had.
    """
    model, rng = intervals.model, np.random.default_rng(_SEED)
    n = max(_DRAWS, _PER_PARAMETER * model.n_p)
    rows, fixed = np.flatnonzero(intervals.counted), [i for four in model.quaternions for i in four]
    first_order = np.array([x in model.first_order for x in model.rate_names])

    def drawn(values: FloatArray, low: FloatArray | float, *, whole: bool = False) -> FloatArray:
        places = rng.choice(rows, (n, 1 if whole else values.shape[1]))
        return np.asarray(values[places, np.arange(values.shape[1])] * rng.uniform(low, 2.0, (n, values.shape[1])))

    coordinates, velocities, _, inputs, parameters = motion
    q = drawn(coordinates, 0.5, whole=bool(fixed))
    q[:, fixed] = coordinates[rng.choice(rows, n)][:, fixed]
    v, u = drawn(velocities, np.where(first_order, 0.5, -2.0)), drawn(inputs, -2.0)
    p = parameters[rng.choice(rows, n)]
    with np.errstate(all="ignore"):
        a, W = equations_of_rows(model, q, v, u, p)
        h = candidates.means((q, v, a, u, p), np.ones(n), 1)
        scale = np.sqrt(np.square(W * p[:, None, :]).sum(axis=2, keepdims=True)) + _TINY
        W, h = (x / scale for x in (W, h))
    known = np.isfinite(W).all(axis=(1, 2)) & (np.abs(h) < _HUGE).all(axis=(1, 2))
    W, h = (x[known].reshape(-1, x.shape[2]) for x in (W, h))
    W = W / (np.linalg.norm(W, axis=0) + _TINY)
    U, sizes, _ = np.linalg.svd(W, full_matrices=False)
    U = U[:, sizes > 1e-9 * sizes.max(initial=0.0)]
    left = h - U @ (U.T @ h)
    return np.asarray(np.square(left).sum(axis=0) <= _EQUIVALENT * np.square(h).sum(axis=0))
