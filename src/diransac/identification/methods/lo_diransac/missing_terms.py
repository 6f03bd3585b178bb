"""Terms that the model may lack: the probability of every candidate, suggested terms, and structural intervals.

A term ``theta h`` of the equations is a linear regression of what the fit leaves, with all else that is estimated
beside it (`term_regression`): its estimate and its variance, which counts what neighbouring intervals have in common,
are all that the log says about it.  The prior is the same for every machine: ``theta ~ N(0, s^2)`` with s such that the
RMS force of the term is a tenth of that of the largest force of its equation; and models that lack a term of one kind
at one place are as probable as the complete one, whatever the number of terms of that kind.  The Bayes factor of a term
against the complete model is that of two normal distributions,

    BF = (1 + s^2 / v)^(-1/2) exp(theta^2 s^2 / (2 v (v + s^2)))

A term that the log excludes has a small one, as the prior was much wider than what the log leaves of it (Occam's
factor).  One that the log does not show either way has BF = 1 and the variance of its prior: if it is correlated with a
parameter, that is uncertain (`possible_terms`).  Where the model lacks two terms, each may explain nothing alone: pairs
compete with single terms, by the Bayes factor of two coefficients.  A term or a pair whose odds exceed what the choice
among all gives by chance is suggested, and the next is sought beside it (forward selection).  That the model lacks a
term can be certain where its form is not: another term that is about as probable, and that the log does not show beside
the suggested one, is its rival.

Terms that parameters equal whatever the motion, as a friction that the model has, are no candidates; nor are
discrepancies of the fit, which stand for the same forces: they are held at zero.

References
----------
Rao 1948 (score test); Draper 1995 (model uncertainty); Kass, Raftery 1995 (Bayes factors); Wakefield 2009 (from
estimates and their errors).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray, size_or_one
from diransac.identification.core.fit import split
from diransac.identification.methods.lo_diransac.motion_equations import (
    equations_of_rows,
    inertia_slopes,
    means_of_intervals,
    regressors_of_rows,
    residuals_of_motion,
    slopes_of_delays,
)
from diransac.identification.methods.lo_diransac.term_regression import (
    ROUNDING,
    TermRegression,
    parts_of_intervals,
    term_regression,
)
from diransac.identification.methods.lo_diransac.unmeasured import measured_signals, unmeasured_states
from diransac.identification.structure.candidate_terms import RelativeMotion, TermLibrary, candidate_terms
from diransac.identification.structure.lacking_terms import PossibleTerm, with_terms
from diransac.identification.structure.structural import structural

if TYPE_CHECKING:
    from diransac.identification.core.fit import Fit
    from diransac.identification.core.windows import Windows
    from diransac.identification.methods.lo_diransac.projection import ProjectedEstimate
    from diransac.identification.structure.candidate_terms import CandidateTerms
    from diransac.identification.structure.lacking_terms import Suggestion
    from diransac.model import Model

# Logarithm of the odds of a suggested term, after the choice among all: strong evidence (Kass, Raftery).
_EVIDENCE = 3.0
# Difference of such logarithms below which the first of two terms, the simpler one, is taken.
_EQUAL = 0.01
# RMS force of a suggested term over the largest force of its equation, at least.
_SMALLEST = 1e-3
# Fraction of the mean square unmodelled force that a suggested term explains, at least.
_SHARE = 0.2
# Fraction of the variance of a parameter that a possible term adds, at least.
_ADDED = 1e-3
# Fraction of the square of a term that parameters leave on any motion, below which they equal it.
_EQUIVALENT = 1e-6
# Part of the information of a term beside another one that separates both.
_SEPARATE = 1e-9
# Relative residual of a regressor that is linear, and component of a unit vector that is zero.
_RANK = 1e-7


@dataclass(frozen=True, eq=False, repr=False)
class TermSet:
    """A term that the model may lack, or two together.

    Parameters
    ----------
    members : tuple of int
        Indices of the terms.
    log_odds : float
        Logarithm of the posterior odds against the complete model.
    means, covariance : (s,) and (s, s) array
        Of the posterior distribution of the coefficients.
    """

    members: tuple[int, ...]
    log_odds: float
    means: FloatArray
    covariance: FloatArray


@dataclass(frozen=True)
class SelectedTerm:
    """A term that a fit lacks: its index, it and the other one of its pair, and terms that may stand in its place."""

    index: int
    members: tuple[int, ...]
    rivals: tuple[int, ...]


@dataclass(frozen=True, eq=False, repr=False)
class Candidates:
    """K candidate terms at a fit.

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
    relative : float, optional
        Prior RMS force of a term, over that of the largest force of its equation.
    odds : float, optional
        Prior odds of the terms of one kind and place, together, against a complete model.
    """

    library: CandidateTerms
    units: FloatArray
    regression: TermRegression
    inertia: FloatArray
    relative: float = 0.1
    odds: float = 1.0

    def without(self, left_out: Sequence[int]) -> Candidates:
        """All but some of the terms."""
        kept = np.delete(np.arange(len(self.library)), left_out).tolist()
        return replace(
            self,
            library=replace(self.library, terms=tuple(self.library.terms[k] for k in kept)),
            units=self.units[kept],
            regression=self.regression.of([*kept, *self._delays]),
        )

    def beside(self, *chosen: int) -> Candidates:
        """The candidates with some of the effects among all else that is estimated."""
        return replace(self, regression=self.regression.beside(*chosen))

    def beside_delays(self) -> Candidates:
        """The candidates with changes of the delays of the inputs among all else that is estimated."""
        return self.beside(*self._delays)

    @property
    def _delays(self) -> range:
        """Places of the delays in the regression."""
        return range(len(self.library), self.regression.columns.shape[2])

    @property
    def _prior(self) -> tuple[FloatArray, FloatArray]:
        """Logarithms ``(K,)`` of the odds of each term, and the variance of its coefficient."""
        places = [(x.kind, x.place) for x in self.library.terms]
        of_kind = Counter(places)
        return np.log([self.odds / of_kind[x] for x in places]), np.square(self.relative * self.units)

    @property
    def _effects(self) -> IntArray:
        """Number ``(K,)`` of the effect of which each term is a form."""
        return np.unique([x.parameter for x in self.library.terms], return_inverse=True)[1]

    @cached_property
    def _least(self) -> float:
        """Logarithm of the odds that no term has by the choice among all."""
        return _EVIDENCE + float(np.log(max(len(self.library), 1)))

    def alone(self) -> list[TermSet]:
        """Each term alone."""
        (odds, prior), (estimates, variances) = self._prior, (x[: len(self.units)] for x in self.regression.estimates())
        information, values = 1.0 / variances[:, None, None], (estimates / variances)[:, None]
        factors, means, spread = posterior(information, values, prior[:, None])
        return [TermSet((k,), float(odds[k] + factors[k]), means[k], spread[k]) for k in range(len(odds))]

    def sets(self) -> list[TermSet]:
        """Each term alone, then pairs that are clearly more probable than either of their terms, and than by chance."""
        alone, (pairs, white) = self.alone(), self._pairs()
        least = np.array([x.log_odds for x in alone])[pairs].max(axis=1, initial=self._least - _EVIDENCE) + self._least
        # What neighbouring intervals have in common leaves the largest part of its odds to the pair that explains most.
        likely, part, most, fewest = list[TermSet](), 1.0, -np.inf, least.min(initial=np.inf)
        for i in np.argsort(-white, kind="stable"):
            if part * white[i] <= max(fewest, most - self._least):
                break  # nor does one of the others, which explain less
            if part * white[i] > least[i]:
                pair = self._pair(pairs[i])
                part = part if np.isfinite(most) else max(pair.log_odds / white[i], 0.0)
                most = max(most, pair.log_odds)
                if pair.log_odds > least[i]:
                    likely.append(pair)
        return alone + likely

    def _pair(self, pair: IntArray) -> TermSet:
        odds, prior = self._prior
        values, covariance = self.regression.together(pair.tolist())
        information = np.asarray(np.linalg.inv(covariance), float)
        factor, means, spread = posterior(information, information @ values, prior[pair])
        return TermSet(tuple(pair.tolist()), float(odds[pair].sum() + factor), means, spread)

    def _pairs(self) -> tuple[IntArray, FloatArray]:
        """Pairs ``(P, 2)`` of different effects that the log determines, and their log odds if residuals are white."""
        (odds, prior), effects, regression = self._prior, self._effects, self.regression
        columns = regression.columns[:, :, : len(odds)].reshape(regression.residuals.size, len(odds))
        gram, values = (columns.T @ x for x in (columns, -regression.residuals.ravel()))
        a, b = np.triu_indices(len(odds), 1)
        own, separate = np.diag(gram), gram[a, a] - np.square(gram[a, b]) / size_or_one(gram[b, b])
        determined = own > ROUNDING * regression.direct[: len(odds)]
        usable = (effects[a] != effects[b]) & determined[a] & determined[b] & (separate > _SEPARATE * own[a])
        pairs = np.stack([a, b], axis=1)[usable]
        factors = posterior(gram[pairs[:, :, None], pairs[:, None, :]], values[pairs], prior[pairs])[0]
        return pairs, factors + odds[pairs].sum(axis=1)

    def selected(self) -> list[SelectedTerm]:
        """Terms that explain what the fit leaves, the most probable first, each alone or with that of its pair."""
        effects, chosen, allowed, tests = self._effects, list[SelectedTerm](), np.ones(len(self.units), bool), self
        sets = tests.sets()
        while sets := [x for x in sets if x.log_odds >= self._least and allowed[list(x.members)].all()]:
            # A pair counts before a single term where it is as clearly more probable as than either of its own.
            odds = [x.log_odds - self._least * (len(x.members) - 1) for x in sets]
            most = min((x for x, y in zip(sets, odds, strict=True) if y > max(odds) - _EQUAL), key=lambda x: x.members)
            if not all(tests._is_possible(k, most.members) for k in most.members):
                sets.remove(most)
                continue
            alone = tests.alone()
            terms = [SelectedTerm(k, most.members, tests._rivals(k, most.members)) for k in most.members]
            chosen += sorted(terms, key=lambda x: (bool(x.rivals), -alone[x.index].log_odds))
            allowed &= ~np.isin(effects, effects[list(most.members)])
            tests = tests.beside(*most.members)
            sets = tests.sets()
        return chosen

    def _is_possible(self, k: int, members: tuple[int, ...]) -> bool:
        """True for a coefficient within its bounds, and a force that is not negligible."""
        value, (low, high) = self.regression.joint(members)[0][members.index(k)], self.library.terms[k].bounds
        share = self.regression.explained(k, members)
        return bool(low < value < high and abs(value) > _SMALLEST * self.units[k] and share > _SHARE)

    def _rivals(self, k: int, members: tuple[int, ...]) -> tuple[int, ...]:
        """Terms as probable as one beside the rest of its set that the log determines but does not show beside it.

        Of each effect the most probable form, of all of them the most probable first.
        """
        rest, effects, rivals = tuple(x for x in members if x != k), self._effects, dict[int, int]()
        tests = self.beside(*rest)
        beside = tests.beside(k)
        before, after = (np.array([x.log_odds for x in y.alone()]) for y in (tests, beside))
        determined = np.isfinite(beside.regression.estimates()[1][: len(before)])
        alike = np.flatnonzero(determined & (after <= 0.0) & (before > before[k] - _EVIDENCE))
        for j in alike[np.argsort(-before[alike], kind="stable")].tolist():
            if effects[j] not in effects[list(members)] and self._is_possible(j, (*rest, j)):
                rivals.setdefault(int(effects[j]), j)
        return tuple(rivals.values())


def posterior(
    information: FloatArray, values: FloatArray, prior: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Logarithms of Bayes factors of coefficients against their absence; the coefficients' means and covariances.

    Parameters
    ----------
    information : (..., s, s) array
        Inverse covariance of the estimates; zero where the log determines none.
    values : (..., s) array
        Information times the estimates.
    prior : (..., s) array
        Variances; the means are zero.

    Returns
    -------
    (...) array, (..., s) array, (..., s, s) array
    """
    root = np.sqrt(prior)
    roots = root[..., :, None] * root[..., None, :]
    scaled = np.eye(prior.shape[-1]) + information * roots
    covariance = np.linalg.inv(scaled) * roots
    means = (covariance @ values[..., None])[..., 0]
    factors = 0.5 * ((means * values).sum(axis=-1) - np.linalg.slogdet(scaled)[1])
    return np.asarray(factors), means, covariance


def probabilities(sets: Sequence[TermSet]) -> FloatArray:
    """Probabilities of sets of terms; the complete model has the rest."""
    logarithms = np.array([x.log_odds for x in sets])
    largest = logarithms.max(initial=0.0)
    each = np.exp(logarithms - largest)
    return np.asarray(each / (np.exp(-largest) + each.sum()))


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
    intervals: Windows, fit: Fit, result: ProjectedEstimate, library: TermLibrary | None = None
) -> Candidates:
    """Candidate terms of a model, of the user's `library` too, with all that a fit says about them."""
    p = fit.shared[: intervals.n_p]
    motion, r, W, M = residuals_of_motion(intervals, fit, p)
    drawn, largest = _drawn(intervals, motion), _largest_forces(intervals, motion[2], p, r, W, M)
    del r, W
    terms = _library(intervals, motion, drawn[0], library)
    finer, fit = split(intervals, fit, parts_of_intervals(intervals, fit, len(terms)))
    means = terms.means(motion, _weights_of_rows(finer), finer.length)
    means[~finer.occupied] = 0.0
    relative = (np.sqrt(np.square(means).sum(axis=0) / finer.occupied.sum()) / size_or_one(largest)[:, None]).max(
        axis=0
    )
    acting = np.isfinite(relative) & (relative > ROUNDING)
    chosen = np.flatnonzero(acting & ~_replaceable(*drawn, terms))
    means = np.concatenate([means[:, :, chosen], _means(finer, slopes_of_delays(intervals, motion, p))], axis=2)
    inertia, acts = _mean_inertia(intervals, M), (means != 0.0).any(axis=0)
    accelerations = np.asarray(np.linalg.solve(_mean_inertia(finer, M), -means))
    del motion, M, means
    regression = term_regression(finer, fit, result, accelerations, inertia, acts, _inertia_slopes(intervals, drawn[0]))
    terms = replace(terms, terms=tuple(terms.terms[k] for k in chosen))
    candidates = Candidates(terms, 1.0 / relative[chosen], regression, inertia)
    return candidates.without(_never_determined(intervals, candidates))


def missing_terms(candidates: Candidates) -> MissingTerms:
    """Terms that explain the unmodelled forces, each supported by the logs."""
    tests = candidates.beside_delays()
    regression, selected = tests.regression, tests.selected()
    chosen, first = [x.index for x in selected], [x.index for x in selected if x.members == selected[0].members]
    suggestions = []
    for term, value, error in zip(selected, *regression.joint(chosen), strict=True):
        share = regression.explained(term.index, chosen)
        suggestions.append(tests.library.suggestion(term.index, float(value), float(error), share, term.rivals))
    explained = regression.force - regression.beside(*chosen).force
    accelerations = np.linalg.solve(tests.inertia, explained[:, :, None])[:, :, 0]
    change = regression.effects[:, first] @ regression.joint(first)[0]
    return MissingTerms(tuple(suggestions), change, np.asarray(accelerations))


def possible_terms(
    candidates: Candidates, result: ProjectedEstimate, covariance: FloatArray, names: Sequence[str]
) -> tuple[PossibleTerm, ...]:
    """Terms that the model may lack and that would change its parameters, the most probable first.

    Parameters
    ----------
    candidates : Candidates
    result : ProjectedEstimate
    covariance : (n, n) array
        Of the parameters, if the model is complete.
    names : sequence of str
        Of the parameters.
    """
    sets, regression, terms = candidates.sets(), candidates.regression, candidates.library.terms
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
        if (added > _ADDED * own).any() and np.isfinite(added).all():
            # By the square of its effects, over the variances of the parameters, the largest of a pair.
            of_each = np.square(effects) * (np.diag(one.covariance) + np.square(one.means)) / own[:, None]
            k = int(np.argmax(of_each.sum(axis=0)))
            term, variance = terms[one.members[k]], float(one.covariance[k, k])
            named = [term.name, *(terms[x].name for x in one.members if x != one.members[k])]
            per_unit = np.sign(effects[:, k]) * np.sqrt(variances / variance)
            by_name, moved = (dict(zip(names, x.tolist(), strict=True)) for x in (per_unit, shifts))
            formula, name = term.formula if len(named) == 1 else "", " and ".join(named)
            possible.append(PossibleTerm(term.kind, term.place, formula, weight, variance, by_name, moved, name))
    return tuple(sorted(possible, key=lambda x: -x.weight))


def _library(
    intervals: Windows, motion: Sequence[FloatArray], drawn: Sequence[FloatArray], library: TermLibrary | None
) -> CandidateTerms:
    """Candidates with the speeds and inputs of a motion: q, v, a, u and p of every row."""
    velocities, inputs = (x[intervals.counted] for x in (motion[1], motion[3]))
    sizes = np.stack([np.sqrt(np.square(inputs).mean(axis=0)), np.quantile(np.abs(inputs), 0.99, axis=0)], axis=1)
    relative = [
        RelativeMotion(rates, forces, float(np.sqrt(np.square(velocities @ rates).mean())))
        for rates, forces in connections(intervals.model, *drawn)
    ]
    return candidate_terms(intervals.model, np.sqrt(np.square(velocities).mean(axis=0)), sizes, relative, library)


def _weights_of_rows(intervals: Windows) -> FloatArray:
    """Weights ``(N,)`` of the rows of each interval in its mean: equal for those that count, 0 for others."""
    counted = intervals.counted.astype(float)
    counts = np.maximum(counted.reshape(len(intervals), -1).sum(axis=1), 1.0)
    return np.asarray(counted / np.repeat(counts, intervals.length))


def _means(intervals: Windows, values: FloatArray) -> FloatArray:
    """Means ``(W, ...)`` of the rows that count; 0 in intervals without one."""
    weights = _weights_of_rows(intervals)
    weighted = np.where(weights > 0.0, values.T * weights, 0.0).T
    return np.asarray(weighted.reshape(len(intervals), intervals.length, *values.shape[1:]).sum(axis=1))


def _mean_inertia(intervals: Windows, M: FloatArray) -> FloatArray:
    return np.where(intervals.occupied[:, None, None], means_of_intervals(intervals, M), np.eye(M.shape[1]))


def _inertia_slopes(intervals: Windows, drawn: Sequence[FloatArray]) -> FloatArray:
    """Slopes ``(n,)`` of the logarithm of the logs' mean inertia by the parameters of all logs."""
    (q, v, _, u, p), places = drawn, intervals.layout.index
    slopes: FloatArray = np.zeros(intervals.n_p)
    of_model = inertia_slopes(intervals.model, q, v, u, p) / len(places)
    for own in places:
        slopes[own] += of_model
    return slopes


# ---------------------------------------------------------------------- forces, and terms that parameters equal


def _largest_forces(
    intervals: Windows, a: FloatArray, p: FloatArray, r: FloatArray, W: FloatArray, M: FloatArray
) -> FloatArray:
    """RMS (n_v,) of the largest force of each equation: inertial, of a parameter, or without one.

    In steady motion the inertial force is the smallest of all, and no measure of what a model may lack.
    """
    a, r, W, M = (x[intervals.counted] for x in (a, r, W, M))
    inertial, known = np.einsum("nij,nj->in", M, a), (W @ p - r).T
    squares = [
        np.einsum("nij,nij->ji", W, W) * np.square(p)[:, None],
        *(np.square(x).sum(axis=1)[None] for x in (inertial, known)),
    ]
    return np.asarray(np.sqrt(np.concatenate(squares).max(axis=0) / len(a)))


def _drawn(intervals: Windows, motion: Sequence[FloatArray]) -> tuple[tuple[FloatArray, ...], FloatArray]:
    """Motions of the model drawn from the log signal by signal, so that nothing is correlated, and their regressors.

    Velocities and inputs have proportions that they need not have had in the log.

    Raises LinAlgError: parameters are so tiny or huge that no acceleration is finite.
    """
    model, rng = intervals.model, np.random.default_rng(0)
    n = max(200, 4 * model.n_p)
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
    return (q, v, a, u, p), W


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
    W = regressors_of_rows(model, q, v, np.random.default_rng(0).permutation(a), u, p)
    known = np.isfinite(W).all(axis=(1, 2))
    x = np.column_stack([np.ones(len(v)), v, q if model.kinematics is None else q[:, :0]])[known]
    size, W = size_or_one(np.linalg.norm(x, axis=0)), W[known].reshape(int(known.sum()), W[0].size)
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


def _never_determined(intervals: Windows, candidates: Candidates) -> list[int]:
    """Terms that parameters and states that nothing measures equal on any motion."""
    if not unmeasured_states(intervals):
        return []

    def is_ambiguous(k: int) -> bool:
        extended = with_terms(intervals.model, [candidates.library.suggestion(k, 1.0, 1.0, 0.0)])
        ambiguous = structural(extended, measured_signals(intervals))
        return any(candidates.library.terms[k].parameter in x.names for x in ambiguous)

    variances = candidates.regression.estimates()[1][: len(candidates.library)]
    return [k for k in np.flatnonzero(np.isinf(variances)).tolist() if is_ambiguous(k)]


def _replaceable(motion: Sequence[FloatArray], W: FloatArray, terms: CandidateTerms) -> BoolArray:
    """Mask (K,) of terms that changes of the parameters equal on any motion of the model."""
    with np.errstate(all="ignore"):
        h = terms.means(motion, np.ones(len(W)), 1)
        scale = size_or_one(np.linalg.norm(W * motion[4][:, None, :], axis=2, keepdims=True))
        W, h = (x / scale for x in (W, h))
        usable = np.isfinite(W).all(axis=(1, 2)) & np.isfinite(np.square(h).sum(axis=(1, 2)))
    W, h = (x[usable].reshape(-1, x.shape[2]) for x in (W, h))
    W = W / size_or_one(np.linalg.norm(W, axis=0))
    left = h - W @ np.linalg.lstsq(W, h, rcond=_RANK)[0]
    return np.asarray(np.square(left).sum(axis=0) <= _EQUIVALENT * np.square(h).sum(axis=0))
