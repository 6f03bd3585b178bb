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

from diransac.arrays import BoolArray, FloatArray, row_blocks
from diransac.identification.core.fit import split
from diransac.identification.methods.lo_diransac.motion_equations import (
    equations_of_rows,
    inertia_slopes,
    means_of_intervals,
    regressors_of_rows,
    residuals_of_motion,
    slopes_of_delays,
)
from diransac.identification.methods.lo_diransac.term_evidence import CandidateTests, TermRegression, probabilities
from diransac.identification.methods.lo_diransac.term_regression import parts_of_intervals, term_regression
from diransac.identification.methods.lo_diransac.unmeasured import measured_signals, unmeasured_states
from diransac.identification.structure.candidate_terms import RelativeMotion, TermLibrary, candidate_terms
from diransac.identification.structure.lacking_terms import PossibleTerm, name_of_term, with_terms
from diransac.identification.structure.structural import structural

if TYPE_CHECKING:
    from diransac.identification.core.fit import Fit
    from diransac.identification.core.windows import ShootingIntervals
    from diransac.identification.methods.lo_diransac.projection import ProjectedEstimate
    from diransac.identification.structure.candidate_terms import CandidateTerm, CandidateTerms
    from diransac.identification.structure.lacking_terms import Suggestion
    from diransac.model import Model

# Part of the samples of an input that its size bounds.
_MOSTLY = 0.99
# Part of the variance of a parameter that a term must add to be kept.
_KEPT = 1e-3
# Part of the square of a term that parameters must leave on any motion.
_EQUIVALENT = 1e-6
# Draws of a motion, and as many per parameter and equation; the seed.
_DRAWS, _PER_PARAMETER, _SEED = 200, 4, 0
# Relative residual up to which a regressor is linear; component of a unit vector that is rounding.
_RANK = 1e-7
# Part of the largest force that is rounding.
_ROUNDING = 1e-12
_HUGE, _TINY = 1e9, 1e-300


@dataclass(frozen=True, eq=False, repr=False)
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
    inertia : (W, n_v, n_v) array
        Mean of each interval.
    """

    library: CandidateTerms
    units: FloatArray
    regression: TermRegression
    inertia: FloatArray

    def without(self, left_out: Sequence[int]) -> Candidates:
        """All but some of the terms."""
        if not left_out:
            return self
        kept = np.delete(np.arange(len(self.library)), left_out).tolist()
        return Candidates(
            replace(self.library, terms=tuple(self.library.terms[k] for k in kept)),
            self.units[kept],
            self.regression.of([*kept, *range(len(self.library), self.regression.columns.shape[2])]),
            self.inertia,
        )

    def tests(self, *, beside_delays: bool = False) -> CandidateTests:
        """Tests of the terms at the delays of the fit, or beside changes of them."""
        regression, n = self.regression, len(self.library)
        if beside_delays:
            regression = regression.beside(*range(n, regression.columns.shape[2]))
        return CandidateTests(self.library.terms, self.units, regression.of(slice(n)))


@dataclass(frozen=True, eq=False, repr=False)
class MissingTerms:
    """Terms that the model lacks.

    Parameters
    ----------
    suggestions : tuple of Suggestion
        The most probable one first; empty where none is supported by the logs.
    change : (n,) array
        Change of the parameters with the first suggestion.
    accelerations : (W, n_v) array
        What the suggested terms explain of the unmodelled acceleration of each interval.
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
    p = fit.shared[: intervals.n_p]
    motion, r, W, M = residuals_of_motion(intervals, fit, p)
    drawn, largest = _drawn(intervals, motion), _largest_forces(intervals, fit, motion, r, W, M)
    del r, W
    candidates = _library(intervals, motion, drawn, library)
    finer, fit = split(intervals, fit, parts_of_intervals(intervals, fit, len(candidates)))
    means = candidates.means(motion, _weights_of_rows(finer), finer.length)
    means[~finer.occupied] = 0.0
    relative = (np.sqrt(np.square(means).sum(axis=0) / finer.occupied.sum()) / (largest[:, None] + _TINY)).max(axis=0)
    acting = np.isfinite(relative) & (relative > _ROUNDING)
    chosen = np.flatnonzero(acting & ~_replaceable(drawn, candidates))
    means = np.concatenate([means[:, :, chosen], _means(finer, slopes_of_delays(intervals, motion, p))], axis=2)
    inertia, acts = _mean_inertia(intervals, M), (means != 0.0).any(axis=0)
    accelerations = np.asarray(np.linalg.solve(_mean_inertia(finer, M), means))
    np.negative(accelerations, out=accelerations)
    del motion, M, means
    regression = term_regression(finer, fit, result, accelerations, inertia, acts, _inertia_slopes(intervals, drawn))
    found = Candidates(
        replace(candidates, terms=tuple(candidates.terms[k] for k in chosen)),
        1.0 / relative[chosen],
        regression,
        inertia,
    )
    return found.without(_never_determined(intervals, found))


def missing_terms(found: Candidates) -> MissingTerms:
    """Terms that explain the unmodelled forces, each supported by the logs.

    Parameters
    ----------
    found : Candidates

    Returns
    -------
    MissingTerms
    """
    tests = found.tests(beside_delays=True)
    regression, selected = tests.regression, tests.selected()
    chosen, first = [x.index for x in selected], [x.index for x in selected if x.members == selected[0].members]
    values, errors = regression.joint(chosen)
    suggestions = []
    for i, (one, value, error) in enumerate(zip(selected, values.tolist(), errors.tolist(), strict=True)):
        share = regression.beside(*chosen[:i], *chosen[i + 1 :]).explained(one.index)
        suggestions.append(found.library.suggestion(one.index, value, error, share, one.rivals))
    explained = regression.force - regression.beside(*chosen).force
    accelerations = np.linalg.solve(found.inertia, explained[:, :, None])[:, :, 0]
    change = regression.effects[:, first] @ regression.joint(first)[0]
    return MissingTerms(tuple(suggestions), change, np.asarray(accelerations))


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
    tests = found.tests()
    sets, regression = tests.sets(), tests.regression
    own = np.diag(covariance)
    own = np.where(np.isfinite(own), own, np.inf)
    possible = list[PossibleTerm]()
    for one, weight in zip(sets, probabilities(sets).tolist(), strict=True):
        effects = regression.effects[:, list(one.members)]
        change = effects @ one.means
        # With the terms, least squares, simulation error and the fit would agree: what the fit has is the estimate's.
        shifts = change / regression.divisor(change) + result.of_fit - result.parameters
        variances = np.einsum("nk,kl,nl->n", effects, one.covariance, effects)
        added = weight * (variances + np.square(shifts))
        if (added > _KEPT * own).any() and np.isfinite(added).all():
            # By the square of its effects, over the variances of the parameters, the largest of a pair.
            of_each = np.square(effects) * (np.diag(one.covariance) + np.square(one.means)) / own[:, None]
            k = int(np.argmax(of_each.sum(axis=0)))
            term, variance = tests.terms[one.members[k]], float(one.covariance[k, k])
            beside = [tests.terms[x] for x in one.members if x != one.members[k]]
            per_unit = np.sign(effects[:, k]) * np.sqrt(variances / variance)
            possible.append(
                PossibleTerm(
                    term.kind,
                    term.place,
                    "" if beside else term.formula,
                    weight,
                    variance,
                    dict(zip(names, per_unit.tolist(), strict=True)),
                    dict(zip(names, shifts.tolist(), strict=True)),
                    " and ".join(_name(x) for x in (term, *beside)) if beside else term.name,
                )
            )
    return tuple(sorted(possible, key=lambda x: -x.weight))


def _name(term: CandidateTerm) -> str:
    return term.name or name_of_term(term.kind, term.place, term.formula, "")


def _library(
    intervals: ShootingIntervals, motion: Sequence[FloatArray], drawn: _DrawnMotion, library: TermLibrary | None
) -> CandidateTerms:
    """Candidates with the speeds and inputs of a motion: q, v, a, u and p of every row."""
    velocities, inputs = (x[intervals.counted] for x in (motion[1], motion[3]))
    sizes = np.stack([np.sqrt(np.square(inputs).mean(axis=0)), np.quantile(np.abs(inputs), _MOSTLY, axis=0)], axis=1)
    relative = [
        RelativeMotion(rates, forces, float(np.sqrt(np.square(velocities @ rates).mean())))
        for rates, forces in connections(intervals.model, *drawn.motion)
    ]
    return candidate_terms(intervals.model, np.sqrt(np.square(velocities).mean(axis=0)), sizes, relative, library)


def _weights_of_rows(intervals: ShootingIntervals) -> FloatArray:
    """Weights ``(N,)`` of the rows of each interval in its mean: equal for those that count, 0 for others."""
    counted = intervals.counted.astype(float)
    counts = np.maximum(counted.reshape(len(intervals), -1).sum(axis=1), 1.0)
    return np.asarray(counted / np.repeat(counts, intervals.length))


def _means(intervals: ShootingIntervals, values: FloatArray) -> FloatArray:
    """Means ``(W, ...)`` of the rows that count; 0 in intervals without one."""
    weights = _weights_of_rows(intervals)
    weighted = np.where(weights > 0.0, values.T * weights, 0.0).T
    return np.asarray(weighted.reshape(len(intervals), intervals.length, *values.shape[1:]).sum(axis=1))


def _mean_inertia(intervals: ShootingIntervals, M: FloatArray) -> FloatArray:
    return np.where(intervals.occupied[:, None, None], means_of_intervals(intervals, M), np.eye(M.shape[1]))


def _inertia_slopes(intervals: ShootingIntervals, drawn: _DrawnMotion) -> FloatArray:
    """Slopes ``(n,)`` of the logarithm of the logs' mean inertia by the parameters of all logs."""
    q, v, _, u, p = drawn.motion
    places, slopes = intervals.layout.index, inertia_slopes(intervals.model, q, v, u, p)
    found: FloatArray = np.zeros(intervals.n_p)
    for one in places:
        found[one] += slopes / len(places)
    return found


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
    squares = 0.0
    for k in row_blocks(len(r)):
        of_parameters = W[k] * fit.shared[: intervals.n_p]
        inertial, known = np.einsum("nij,nj->ni", M[k], motion[2][k]), of_parameters.sum(axis=2) - r[k]
        forces = np.concatenate([of_parameters, inertial[:, :, None], known[:, :, None]], axis=2)
        squares = squares + np.square(forces[intervals.counted[k]]).sum(axis=0)
    return np.asarray(np.sqrt(squares / intervals.counted.sum()).max(axis=1))


@dataclass(frozen=True, eq=False, repr=False)
class _DrawnMotion:
    """Motions drawn from the log, signal by signal, so that nothing is correlated; their regressors (n, n_v, n_p)."""

    motion: tuple[FloatArray, ...]
    W: FloatArray


def _drawn(intervals: ShootingIntervals, motion: Sequence[FloatArray]) -> _DrawnMotion:
    """Motions of the model, with velocities and inputs in proportions that they need not have had in the log.

    Raises LinAlgError: parameters are so tiny or huge that no acceleration is finite.
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
    if not np.isfinite(W).all(axis=(1, 2)).any():
        raise np.linalg.LinAlgError("the model has no finite acceleration with these parameters")
    return _DrawnMotion((q, v, a, u, p), W)


def connections(
    model: Model, q: FloatArray, v: FloatArray, a: FloatArray, u: FloatArray, p: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    """Relative motions on which terms of the model depend linearly, and the equations that they drive: (n_v,) each.

    A spring or a damper between two bodies, or a conductance, has a regressor ``(g' x + constant) f`` of constant g and
    f, where x are the velocities, or coordinates of which they are the derivatives.

    Parameters
    ----------
    model : Model
    q, v, a, u, p : (N, n) array
        Rows in which nothing is correlated.

    Returns
    -------
    list of ((n_v,) array, (n_v,) array)
        The first component of g is 1, that of f 1 or -1.
    """
    n, first_order = model.n_v, np.array([x in model.first_order for x in model.rate_names])
    W = regressors_of_rows(model, q, v, np.random.default_rng(_SEED).permutation(a), u, p)
    known = np.isfinite(W).all(axis=(1, 2))
    x = np.column_stack([np.ones(len(v)), v, q if model.kinematics is None else q[:, :0]])[known]
    size, W = np.linalg.norm(x, axis=0) + _TINY, W[known].reshape(int(known.sum()), W[0].size)
    slopes = np.linalg.lstsq(x / size, W, rcond=_RANK)[0]
    linear = np.linalg.norm(W - x / size @ slopes, axis=0) <= _RANK * np.linalg.norm(W, axis=0)
    slopes = np.where(np.abs(slopes) > _RANK * np.abs(slopes).max(axis=0), slopes, 0.0)
    slopes = slopes.reshape(len(size), n, -1)[:, :, linear.reshape(n, -1).all(axis=0)]
    found = dict[tuple[float, ...], tuple[FloatArray, FloatArray]]()
    for part in (slice(1, 1 + n), slice(1 + n, len(size))):
        for column in np.moveaxis(slopes[part], 2, 0):
            u, s, vt = np.linalg.svd(column)
            if not column.any() or (s[1:] > _RANK * s[0]).any():
                continue
            moving = np.flatnonzero(np.abs(u[:, 0]) > _RANK)
            if len(moving) > 1 and len(set(first_order[moving])) == 1:
                g, f = _over_first(u[:, 0], size[part]), _over_first(vt[0], np.ones(n))
                g = np.pad(g, (0, n - len(g)))
                found[*g, *f] = g, f * np.sign(column[column != 0.0][0])
    return list(found.values())


def _over_first(unit: FloatArray, scale: FloatArray) -> FloatArray:
    """Components of a unit vector, each over its scale, over the first of them; without what is rounding."""
    found = np.where(np.abs(unit) > _RANK, unit / scale, 0.0)
    return np.array([float(f"{x:.9g}") for x in found / found[found != 0.0][0]])


def _never_determined(intervals: ShootingIntervals, found: Candidates) -> list[int]:
    """Terms that parameters and states that nothing measures equal on any motion."""
    if not unmeasured_states(intervals):
        return []

    def is_ambiguous(k: int) -> bool:
        extended = with_terms(intervals.model, [found.library.suggestion(k, 1.0, 1.0, 0.0)])
        ambiguous = structural(extended, measured_signals(intervals))
        return any(found.library.terms[k].parameter in x.names for x in ambiguous)

    _, variances = found.tests().regression.estimates()
    return [k for k in np.flatnonzero(np.isinf(variances)).tolist() if is_ambiguous(k)]


def _replaceable(drawn: _DrawnMotion, candidates: CandidateTerms) -> BoolArray:
    """Mask (K,) of terms that changes of the parameters equal on any motion of the model."""
    W, p = drawn.W, drawn.motion[4]
    with np.errstate(all="ignore"):
        h = candidates.means(drawn.motion, np.ones(len(W)), 1)
        scale = np.sqrt(np.square(W * p[:, None, :]).sum(axis=2, keepdims=True)) + _TINY
        W, h = (x / scale for x in (W, h))
    known = np.isfinite(W).all(axis=(1, 2)) & (np.abs(h) < _HUGE).all(axis=(1, 2))
    W, h = (x[known].reshape(-1, x.shape[2]) for x in (W, h))
    W = W / (np.linalg.norm(W, axis=0) + _TINY)
    U, sizes, _ = np.linalg.svd(W, full_matrices=False)
    U = U[:, sizes > 1e-9 * sizes.max(initial=0.0)]
    left = h - U @ (U.T @ h)
    return np.asarray(np.square(left).sum(axis=0) <= _EQUIVALENT * np.square(h).sum(axis=0))
