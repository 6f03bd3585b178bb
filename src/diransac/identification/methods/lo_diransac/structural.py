"""Terms that the model may lack: their evidence, and what each would change in the parameters.

Every candidate term is tested at the final fit, exact or flexible.  A term ``theta h`` of the equations accelerates
the model by ``-M^-1 h theta``, as the unmodelled accelerations of the fit do, so that its slopes are in the normal
equations (`score_tests`).  One Newton step of all unknowns together gives the estimate of theta and its variance, which
counts what neighbouring intervals have in common, and the change g of the parameters per unit of theta.

The prior is the same for every machine: ``theta ~ N(0, s^2)`` with s such that the RMS force of the term is a tenth of
that of the largest force of its equation; and models that lack a term of one kind at one place are as probable as the
complete one, whatever the number of terms of that kind.
The Bayes factor of a term against the complete model is that of two normal distributions,

    BF = (1 + s^2 / v)^(-1/2) exp(theta^2 s^2 / (2 v (v + s^2)))

A term that the log excludes has a small one, as the prior was much wider than what the log leaves of it (Occam's
factor).  One that the log does not show either way has BF = 1 and the variance of its prior: if it is correlated with a
parameter, that is uncertain.  Terms that parameters equal whatever the motion, as a friction that the model has, are no
candidates; nor are discrepancies of the fit, which stand for the same forces: they are held at zero.

References
----------
Draper 1995 (model uncertainty); Kass, Raftery 1995 (Bayes factors); Wakefield 2009 (from estimates and their errors).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.identification.methods.lo_diransac.interval_effects import batch_sums
from diransac.identification.methods.lo_diransac.missing_terms import candidates_of
from diransac.identification.methods.lo_diransac.motion_equations import (
    equations_of_rows,
    means_of_intervals,
    residuals_of_motion,
)
from diransac.identification.methods.lo_diransac.normal_equations import linearize, weights_of
from diransac.identification.methods.lo_diransac.score_tests import scores_tested, slopes_of_accelerations
from diransac.identification.structure.lacking_terms import PossibleTerm

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.normal_equations import Fit
    from diransac.identification.methods.lo_diransac.projection import ProjectedEstimate
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
    from diransac.identification.structure.candidate_terms import CandidateTerm, CandidateTerms, TermLibrary

__all__ = ["CandidateTests", "candidates_tested", "possible_terms", "weighted"]

# Prior: RMS force of a term over the largest force of its equation; odds of the terms of a kind and place, together.
_RELATIVE, _ODDS = 0.1, 1.0
# Part of the variance of a parameter that a term must add to be kept.
_KEPT = 1e-3
# Part of the information of a term that other unknowns must leave; of its square that the parameters must leave.
_DETERMINED, _EQUIVALENT = 1e-12, 1e-6
# Draws of a motion, and as many per parameter and equation; the seed.
_DRAWS, _PER_PARAMETER, _SEED = 200, 4, 0
# Factor of the prior of discrepancies that holds them at zero; part of the largest force that is none.
_HELD, _NO_FORCE = 1e-3, 1e-9
# Numbers of the slopes that are held at a time.
_NUMBERS_AT_A_TIME = 10_000_000
_HUGE, _TINY = 1e9, 1e-300


@dataclass(frozen=True)
class CandidateTests:
    """Tests of K candidates at a fit, before any prior.

    Parameters
    ----------
    terms : tuple of CandidateTerm
    units : (K,) array
        Coefficients with which the RMS force of a term is that of the largest force of its equation.
    estimates, variances : (K,) array
        Of the coefficients; 0 and infinite where the log does not determine one.
    effects : (n, K) array
        Change of the parameters per unit of each coefficient.
    """

    terms: tuple[CandidateTerm, ...]
    units: FloatArray
    estimates: FloatArray
    variances: FloatArray
    effects: FloatArray


def possible_terms(
    intervals: ShootingIntervals,
    fit: Fit,
    result: ProjectedEstimate,
    covariance: FloatArray,
    library: TermLibrary | None = None,
) -> tuple[PossibleTerm, ...]:
    """Terms that the model may lack and that would change its parameters, the most probable first.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
        Most probable motion.
    result : ProjectedEstimate
    covariance : (n, n) array
        Of the parameters, if the model is complete.
    library : callable, optional
        The user's candidates.

    Returns
    -------
    tuple of PossibleTerm
    """
    tests = candidates_tested(intervals, fit, result, library)
    weights, means, variances = weighted(tests)
    own = np.diag(covariance)
    own = np.where(np.isfinite(own), own, np.inf)
    # With the term, least squares, simulation error and the fit would agree: what the fit has then is the estimate's.
    shifts = tests.effects * means + (result.of_fit - result.parameters)[:, None]
    added = weights * (np.square(tests.effects) * variances + np.square(shifts))
    kept = np.flatnonzero((added > _KEPT * own[:, None]).any(axis=0) & np.isfinite(added).all(axis=0))
    names = intervals.layout.names
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


def weighted(
    tests: CandidateTests, relative: float = _RELATIVE, odds: float = _ODDS
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weights of the terms, and the posterior means and variances of their coefficients.

    Parameters
    ----------
    tests : CandidateTests
    relative : float, optional
        Prior RMS force of a term, over that of the largest force of its equation.
    odds : float, optional
        Prior odds of the terms of one kind and place, together, against a complete model.

    Returns
    -------
    (K,) array, (K,) array, (K,) array
        The complete model has the rest of the weights.
    """
    places = [(x.kind, x.place) for x in tests.terms]
    of_kind = Counter(places)
    prior = np.array([odds / of_kind[x] for x in places])
    ratio = np.square(relative * tests.units) / tests.variances
    shrinkage = ratio / (1.0 + ratio)
    determined = np.isfinite(tests.variances)
    squares = np.square(tests.estimates) / np.where(determined, tests.variances, 1.0)
    logarithms = np.log(prior) - 0.5 * np.log1p(ratio) + 0.5 * squares * shrinkage
    largest = logarithms.max(initial=0.0)
    each, complete = np.exp(logarithms - largest), np.exp(-largest)
    variances = np.square(relative * tests.units) / (1.0 + ratio)
    return each / (complete + each.sum()), tests.estimates * shrinkage, variances


def candidates_tested(
    intervals: ShootingIntervals, fit: Fit, result: ProjectedEstimate, library: TermLibrary | None = None
) -> CandidateTests:
    """Estimates of every candidate's coefficient at a fit, and its effect on the parameters.

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
    CandidateTests
        Of those that act on the logs, and that parameters do not equal whatever the motion.
    """
    motion, r, W, M = residuals_of_motion(intervals, fit, fit.shared[: intervals.n_p])
    candidates, terms = candidates_of(intervals, motion, library)
    relative = _relative_forces(terms[intervals.occupied], _largest_forces(intervals, fit, motion, r, W, M))
    chosen = np.flatnonzero((relative > _NO_FORCE) & ~_replaceable(intervals, motion, candidates))
    at_a_time = max(1, _NUMBERS_AT_A_TIME // (fit.x.size + fit.d.size))
    parts = [chosen[k : k + at_a_time] for k in range(0, len(chosen), at_a_time)]
    M = means_of_intervals(intervals, M)
    found = _tested(intervals, fit, result, (_accelerations(intervals, M, terms[:, :, k]) for k in parts))
    return CandidateTests(tuple(candidates.terms[k] for k in chosen), 1.0 / relative[chosen], *found)


def _accelerations(intervals: ShootingIntervals, M: FloatArray, terms: FloatArray) -> FloatArray:
    """Accelerations (W, n_v, K) by unit coefficients of terms; 0 where an interval has no row that counts."""
    found, some = np.zeros_like(terms), intervals.occupied
    found[some] = -np.linalg.solve(M[some], terms[some])
    return found


def _tested(
    intervals: ShootingIntervals, fit: Fit, result: ProjectedEstimate, parts: Iterable[FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Estimates (K,), variances (K,) and effects (n, K) of terms with accelerations (W, n_v, K), part by part."""
    prior = fit.prior.copy()
    prior[intervals.n_p :] *= _HELD
    at = linearize(intervals, replace(fit, prior=prior), weights_of(intervals, fit))
    found = [(np.zeros(0), np.zeros(0), np.zeros((intervals.n_p, 0)))]
    for accelerations in parts:
        slopes = slopes_of_accelerations(intervals, fit, at, accelerations)
        tests = scores_tested(at, slopes)
        determined = tests.information > _DETERMINED * tests.direct
        information = np.where(determined, tests.information, 1.0)
        scatter = np.square(batch_sums(tests.scores)).sum(axis=0)
        estimates = np.where(determined, -tests.score / information, 0.0)
        variances = np.where(determined, np.maximum(information, scatter) / np.square(information), np.inf)
        effects = -(np.einsum("wkp,wke->pe", result.of_z, tests.z, optimize=True) + result.of_s.T @ tests.s)
        found.append((estimates, variances, effects))
    estimates, variances, effects = (np.concatenate(x, axis=-1) for x in zip(*found, strict=True))
    return estimates, variances, effects


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


def _relative_forces(terms: FloatArray, largest: FloatArray) -> FloatArray:
    """RMS force (K,) of terms (W, n_v, K) per unit, over the largest one of the equation in which that is most."""
    relative = (np.sqrt(np.square(terms).mean(axis=0)) / (largest[:, None] + _TINY)).max(axis=0)
    return np.asarray(np.where(np.isfinite(relative), relative, 0.0))


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
