"""Evidence for terms that a model may lack: probabilities of possible terms, and selection of suggested ones.

A term ``theta h`` of the equations changes what a fit leaves, residual by residual, while all else is estimated with
it: a linear regression of whitened residuals on the coefficients.  Its estimates, and their variances, which count what
neighbouring intervals have in common, are all that the log says about the terms.

The prior is the same for every machine: ``theta ~ N(0, s^2)`` with s such that the RMS force of the term is a tenth of
that of the largest force of its equation; and models that lack a term of one kind at one place are as probable as the
complete one, whatever the number of terms of that kind.  The Bayes factor of a term against the complete model is that
of two normal distributions,

    BF = (1 + s^2 / v)^(-1/2) exp(theta^2 s^2 / (2 v (v + s^2)))

A term that the log excludes has a small one, as the prior was much wider than what the log leaves of it (Occam's
factor).  One that the log does not show either way has BF = 1 and the variance of its prior: if it is correlated with a
parameter, that is uncertain.  Where the model lacks two terms, each may explain nothing alone: pairs compete with
single terms, by the Bayes factor of two coefficients.  A term or a pair whose odds exceed what the choice among all
gives by chance is suggested, and the next is sought beside it (forward selection).  That the model lacks a term can be
certain where its form is not: another term that is about as probable, and that the log does not show beside the
suggested one, is named with it.

References
----------
Draper 1995 (model uncertainty); Kass, Raftery 1995 (Bayes factors); Wakefield 2009 (from estimates and their errors);
Frisch, Waugh 1933 (regression on what other columns leave).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.identification.methods.lo_diransac.interval_effects import batch_sums

if TYPE_CHECKING:
    from diransac.identification.structure.candidate_terms import CandidateTerm

# Prior: RMS force of a term over the largest force of its equation; odds of the terms of a kind and place, together.
_RELATIVE, _ODDS = 0.1, 1.0
# Logarithm of the odds of a suggested term, after the choice among all candidates: strong evidence (Kass, Raftery).  Of
# terms whose logarithms differ by less than the other the first counts.
_EVIDENCE, _EQUAL = 3.0, 0.01
# Smallest force of a suggested term over the largest one of its equation, and part of the force left that it explains.
_SMALLEST, _SHARE = 1e-3, 0.2
# Part of the information of a term that is rounding, and part beside another one that separates both.
_ROUNDING, _SEPARATE, _TINY = 1e-12, 1e-9, 1e-300


@dataclass(frozen=True, eq=False, repr=False)
class TermRegression:
    """Residuals of a fit as linear functions of the coefficients of K effects, all else estimated with them.

    Parameters
    ----------
    effects : (n, K) array
        Change of the parameters per unit of each coefficient.
    direct : (K,) array
        Information of each coefficient, if all else were known.
    residuals : (G, m) array
        Of each interval, or of each group of neighbouring ones, over their standard deviations.
    columns : (G, m, K) array
        Their derivatives with respect to the coefficients.
    force : (W, e) array
        Unmodelled force in each equation, mean of each interval.
    forces : (W, e, K) array
        Its derivatives.
    acts : (e, K) bool array
        Equations in which each effect acts.
    inertia : (n,) array
        Slopes of the logarithm of the inertia by the parameters.
    batch : int, optional
        Rows of a batch of correlated ones, as in `batch_sums`.
    """

    effects: FloatArray
    direct: FloatArray
    residuals: FloatArray
    columns: FloatArray
    force: FloatArray
    forces: FloatArray
    acts: BoolArray
    inertia: FloatArray
    batch: int | None = None

    def estimates(self) -> tuple[FloatArray, FloatArray]:
        """Estimate and variance ``(K,)`` of each coefficient alone; 0 and infinite where the log determines none."""
        by_interval = np.einsum("wmk,wmk->wk", self.columns, self.columns)
        scores = np.einsum("wmk,wm->wk", self.columns, self.residuals)
        information = by_interval.sum(axis=0)
        determined = information > _ROUNDING * self.direct
        information = np.where(determined, information, 1.0)
        found = np.where(determined, -scores.sum(axis=0) / information, 0.0)
        scatter = np.square(batch_sums(scores + by_interval * found, self.batch)).sum(axis=0)
        return found, np.where(determined, np.maximum(information, scatter) / np.square(information), np.inf)

    def of(self, some: Sequence[int] | slice) -> TermRegression:
        """The regression on some of the effects."""
        return replace(
            self,
            effects=self.effects[:, some],
            direct=self.direct[some],
            columns=self.columns[:, :, some],
            forces=self.forces[:, :, some],
            acts=self.acts[:, some],
        )

    def beside(self, *chosen: int) -> TermRegression:
        """The regression with the chosen effects among all else that is estimated."""
        if not chosen:
            return self
        k, *others = chosen
        own = self.columns[:, :, k]
        along = own / (np.square(own).sum() + _TINY)
        shares = np.einsum("wm,wmk->k", along, self.columns)
        value = self._value(k)
        found = replace(
            self,
            effects=self.effects - self.effects[:, k, None] * shares,
            residuals=self.residuals + own * value,
            columns=self.columns - own[:, :, None] * shares,
            force=self.force + self.forces[:, :, k] * value,
            forces=self.forces - self.forces[:, :, k, None] * shares,
        )
        return found.beside(*others)

    def divisor(self, changes: FloatArray) -> FloatArray:
        """Divisor, 1 or more, of coefficients and of the changes ``(n, ...)`` of the parameters with them.

        Accelerations are linear in forces over the inertia, and in its inverse.  Where a term makes the inertia
        smaller, the forces are smaller with it.
        """
        return np.maximum(1.0 - np.tensordot(self.inertia, changes, 1), 1.0)

    def together(self, chosen: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Estimates ``(c,)`` of the chosen coefficients, each beside the others, and their covariance."""
        columns = self.columns[:, :, list(chosen)]
        covariance = np.linalg.inv(np.einsum("wmk,wml->kl", columns, columns))
        values = -covariance @ np.einsum("wmk,wm->k", columns, self.residuals)
        errors = np.einsum("wmk,wm->wk", columns, self.residuals + columns @ values) @ covariance
        wider = np.sqrt(np.maximum(np.square(batch_sums(errors, self.batch)).sum(axis=0) / np.diag(covariance), 1.0))
        return values, covariance * np.outer(wider, wider)

    def joint(self, chosen: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Coefficients ``(c,)`` of the chosen effects, each beside the others, and their standard errors."""
        values, covariance = self.together(chosen)
        divisor = self.divisor(self.effects[:, list(chosen)] @ values)
        return values / divisor, np.sqrt(np.diag(covariance)) / divisor

    def explained(self, k: int) -> float:
        """Fraction of the mean square unmodelled force that effect k explains, in the equations where it acts."""
        acts = self.acts[:, k]
        left = self.force + self.forces[:, :, k] * self._value(k)
        before, after = (np.square(x[:, acts]).mean(axis=0) for x in (self.force, left))
        return float(1.0 - (after / (before + _TINY)).mean())

    def _value(self, k: int) -> float:
        """The coefficient of effect k alone."""
        own = self.columns[:, :, k]
        return -float((own * self.residuals).sum() / (np.square(own).sum() + _TINY))


@dataclass(frozen=True, eq=False, repr=False)
class TermSet:
    """A term that the model may lack, or two together.

    Parameters
    ----------
    members : tuple of int
        Indices of the terms.
    log_odds : float
        Logarithm of the posterior odds against the complete model.
    means : (s,) array
        Of the posterior distribution of the coefficients.
    covariance : (s, s) array
    """

    members: tuple[int, ...]
    log_odds: float
    means: FloatArray
    covariance: FloatArray


@dataclass(frozen=True)
class SelectedTerm:
    """A term that a fit lacks.

    Parameters
    ----------
    index : int
        Index of the term.
    members : tuple of int
        It, and the other one of its pair.
    rivals : tuple of int
        Indices of terms that explain the same in its place.
    """

    index: int
    members: tuple[int, ...]
    rivals: tuple[int, ...]


@dataclass(frozen=True, eq=False, repr=False)
class CandidateTests:
    """Tests of K candidates at a fit.

    Parameters
    ----------
    terms : tuple of CandidateTerm
    units : (K,) array
        Coefficients with which the RMS force of a term is that of the largest force of its equation.
    regression : TermRegression
        On the terms.
    relative : float, optional
        Prior RMS force of a term, over that of the largest force of its equation.
    odds : float, optional
        Prior odds of the terms of one kind and place, together, against a complete model.
    """

    terms: tuple[CandidateTerm, ...]
    units: FloatArray
    regression: TermRegression
    relative: float = _RELATIVE
    odds: float = _ODDS

    def beside(self, *chosen: int) -> CandidateTests:
        """The tests with some of the terms among all else that is estimated."""
        return replace(self, regression=self.regression.beside(*chosen))

    @property
    def least(self) -> float:
        """Logarithm of the odds that no term has by the choice among all."""
        return _EVIDENCE + float(np.log(max(len(self.terms), 1)))

    def alone(self) -> list[TermSet]:
        """Each term alone."""
        (odds, prior), (estimates, variances) = self._prior, self.regression.estimates()
        information, values = 1.0 / variances[:, None, None], (estimates / variances)[:, None]
        factors, means, spread = posterior(information, values, prior[:, None])
        return [TermSet((k,), float(odds[k] + factors[k]), means[k], spread[k]) for k in range(len(self.terms))]

    def sets(self) -> list[TermSet]:
        """Each term alone, then pairs that are clearly more probable than either of their terms, and than by chance."""
        alone, (pairs, white), margin = self.alone(), self._pairs(), self.least
        log_odds = np.array([x.log_odds for x in alone])
        least = log_odds[pairs].max(axis=1, initial=margin - _EVIDENCE) + margin
        # What neighbouring intervals have in common leaves the largest part of its odds to the pair that explains most.
        found, part, most = list[TermSet](), 1.0, -np.inf
        for i in np.argsort(-white, kind="stable"):
            if part * white[i] <= max(least[i], most - margin):
                continue
            one = self._pair(pairs[i])
            part = part if np.isfinite(most) else max(one.log_odds / white[i], 0.0)
            most = max(most, one.log_odds)
            if one.log_odds > least[i]:
                found.append(one)
        return alone + found

    @property
    def _prior(self) -> tuple[FloatArray, FloatArray]:
        """Logarithms ``(K,)`` of the odds of each term, and the variance of its coefficient."""
        places = [(x.kind, x.place) for x in self.terms]
        of_kind = Counter(places)
        log_odds = np.log([self.odds / of_kind[x] for x in places])
        return log_odds, np.square(self.relative * self.units)

    def _pair(self, pair: IntArray) -> TermSet:
        odds, prior = self._prior
        values, covariance = self.regression.together(pair.tolist())
        information = np.asarray(np.linalg.inv(covariance), float)
        factor, means, spread = posterior(information, information @ values, prior[pair])
        return TermSet(tuple(pair.tolist()), float(odds[pair].sum() + factor), means, spread)

    def _pairs(self) -> tuple[IntArray, FloatArray]:
        """Pairs ``(P, 2)`` of different effects that the log determines, and their log odds if residuals are white."""
        odds, prior = self._prior
        columns = self.regression.columns.reshape(self.regression.residuals.size, len(self.terms))
        gram, values = (columns.T @ x for x in (columns, -self.regression.residuals.ravel()))
        a, b = np.triu_indices(len(self.terms), 1)
        effects = np.unique([x.parameter for x in self.terms], return_inverse=True)[1]
        own, separate = np.diag(gram), gram[a, a] - np.square(gram[a, b]) / (gram[b, b] + _TINY)
        determined = own > _ROUNDING * self.regression.direct
        pairs = np.stack([a, b], axis=1)[
            (effects[a] != effects[b]) & determined[a] & determined[b] & (separate > _SEPARATE * own[a])
        ]
        factors = posterior(gram[pairs[:, :, None], pairs[:, None, :]], values[pairs], prior[pairs])[0]
        return pairs, factors + odds[pairs].sum(axis=1)

    def selected(self) -> list[SelectedTerm]:
        """Terms that explain what a fit leaves, the most probable first, each alone or with that of its pair."""
        effects = np.array([x.parameter for x in self.terms])
        chosen, allowed, tests = list[SelectedTerm](), np.ones(len(self.terms), bool), self
        sets = tests.sets()
        while sets := [x for x in sets if x.log_odds >= self.least and allowed[list(x.members)].all()]:
            # A pair counts before a single term where it is as clearly more probable as than either of its own.
            odds = [x.log_odds - self.least * (len(x.members) - 1) for x in sets]
            most = min((x for x, y in zip(sets, odds, strict=True) if y > max(odds) - _EQUAL), key=lambda x: x.members)
            if not all(tests._is_possible(k, most.members) for k in most.members):
                sets.remove(most)
                continue
            alone = {k: x.log_odds for x in tests.alone() for k in x.members}
            found = [SelectedTerm(k, most.members, tests._rivals(k, most.members)) for k in most.members]
            chosen += sorted(found, key=lambda x: (bool(x.rivals), -alone[x.index]))
            allowed &= ~np.isin(effects, effects[list(most.members)])
            tests = tests.beside(*most.members)
            sets = tests.sets()
        return chosen

    def _is_possible(self, k: int, members: tuple[int, ...]) -> bool:
        """True for a coefficient within its bounds, and a force that is not negligible."""
        value, (low, high) = self.regression.joint(members)[0][members.index(k)], self.terms[k].bounds
        share = self.regression.beside(*(x for x in members if x != k)).explained(k)
        return bool(low < value < high and abs(value) > _SMALLEST * self.units[k] and share > _SHARE)

    def _rivals(self, k: int, members: tuple[int, ...]) -> tuple[int, ...]:
        """Terms as probable as one beside the rest of its set that the log determines but does not show beside it.

        Of each effect the most probable form, of all of them the most probable first.
        """
        rest = tuple(x for x in members if x != k)
        tests, own = self.beside(*rest), {self.terms[x].parameter for x in members}
        beside = tests.beside(k)
        before, after = (np.array([x.log_odds for x in y.alone()]) for y in (tests, beside))
        known = np.isfinite(beside.regression.estimates()[1])
        alike = np.flatnonzero(known & (after <= 0.0) & (before > before[k] - _EVIDENCE))
        found = dict[str, int]()
        for j in sorted(alike.tolist(), key=lambda j: -before[j]):
            if self.terms[j].parameter not in own and self._is_possible(j, (*rest, j)):
                found.setdefault(self.terms[j].parameter, j)
        return tuple(found.values())


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
