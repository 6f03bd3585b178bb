"""Evidence for terms that a model may lack: weights of possible terms, and selection of suggested ones.

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
parameter, that is uncertain.  One whose odds exceed what the choice among all terms gives by chance is suggested, and
the next is sought beside it (forward selection).

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

from diransac.arrays import BoolArray, FloatArray
from diransac.identification.methods.lo_diransac.interval_effects import batch_sums

if TYPE_CHECKING:
    from diransac.identification.structure.candidate_terms import CandidateTerm

# Prior: RMS force of a term over the largest force of its equation; odds of the terms of a kind and place, together.
_RELATIVE, _ODDS = 0.1, 1.0
# Logarithm of the odds of a suggested term, after the choice among all candidates: strong evidence (Kass, Raftery).
_EVIDENCE = 3.0
# Smallest force of a suggested term over the largest one of its equation, and part of the force left that it explains.
_SMALLEST, _SHARE = 1e-3, 0.2
# Part of the information of a term that is rounding.
_ROUNDING, _TINY = 1e-12, 1e-300


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

    def log_odds(self, relative: float = _RELATIVE, odds: float = _ODDS) -> FloatArray:
        """Logarithms ``(K,)`` of the posterior odds of each term against the complete model."""
        places = [(x.kind, x.place) for x in self.terms]
        of_kind = Counter(places)
        prior = np.log([odds / of_kind[x] for x in places])
        ratio = np.square(relative * self.units) / self.variances
        z = np.square(self.estimates) / np.where(np.isfinite(self.variances), self.variances, 1.0)
        return np.asarray(prior - 0.5 * np.log1p(ratio) + 0.5 * z * ratio / (1.0 + ratio))


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
    logarithms = tests.log_odds(relative, odds)
    largest = logarithms.max(initial=0.0)
    each, complete = np.exp(logarithms - largest), np.exp(-largest)
    prior = np.square(relative * tests.units)
    ratio = prior / tests.variances
    return each / (complete + each.sum()), tests.estimates * ratio / (1.0 + ratio), prior / (1.0 + ratio)


@dataclass(frozen=True)
class TermRegression:
    """Residuals of a fit as linear functions of the coefficients of K effects, all else estimated with them.

    Parameters
    ----------
    effects : (n, K) array
        Change of the parameters per unit of each coefficient.
    direct : (K,) array
        Information of each coefficient, if all else were known.
    residuals : (W, m) array
        Of each interval, over their standard deviations.
    columns : (W, m, K) array
        Their derivatives with respect to the coefficients.
    force : (W, e) array
        Unmodelled force in each equation, mean of each interval.
    forces : (W, e, K) array
        Its derivatives.
    acts : (e, K) bool array
        Equations in which each effect acts.
    inertia : (n,) array
        Slopes of the logarithm of the inertia by the parameters.
    """

    effects: FloatArray
    direct: FloatArray
    residuals: FloatArray
    columns: FloatArray
    force: FloatArray
    forces: FloatArray
    acts: BoolArray
    inertia: FloatArray

    def estimates(self) -> tuple[FloatArray, FloatArray]:
        """Estimate and variance ``(K,)`` of each coefficient alone; 0 and infinite where the log determines none."""
        by_interval = np.einsum("wmk,wmk->wk", self.columns, self.columns)
        scores = np.einsum("wmk,wm->wk", self.columns, self.residuals)
        information = by_interval.sum(axis=0)
        determined = information > _ROUNDING * self.direct
        information = np.where(determined, information, 1.0)
        found = np.where(determined, -scores.sum(axis=0) / information, 0.0)
        scatter = np.square(batch_sums(scores + by_interval * found)).sum(axis=0)
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

    def beside(self, k: int) -> TermRegression:
        """The regression with effect k among all else that is estimated."""
        own = self.columns[:, :, k]
        along = own / (np.square(own).sum() + _TINY)
        shares = np.einsum("wm,wmk->k", along, self.columns)
        value = self._value(k)
        return replace(
            self,
            effects=self.effects - self.effects[:, k, None] * shares,
            residuals=self.residuals + own * value,
            columns=self.columns - own[:, :, None] * shares,
            force=self.force + self.forces[:, :, k] * value,
            forces=self.forces - self.forces[:, :, k, None] * shares,
        )

    def divisor(self, changes: FloatArray) -> FloatArray:
        """Divisor, 1 or more, of coefficients and of the changes ``(n, ...)`` of the parameters with them.

        Accelerations are linear in forces over the inertia, and in its inverse.  Where a term makes the inertia
        smaller, the forces are smaller with it.
        """
        return np.maximum(1.0 - np.tensordot(self.inertia, changes, 1), 1.0)

    def joint(self, chosen: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Estimates and standard errors ``(c,)`` of the coefficients of the chosen effects, each beside the others."""
        found = []
        for k in chosen:
            regression = self.of([k, *(x for x in chosen if x != k)])
            for i in range(1, len(chosen)):
                regression = regression.beside(i)
            value, variance = regression.estimates()
            found.append((value[0], np.sqrt(variance[0])))
        values, errors = np.reshape(found, (-1, 2)).T
        divisor = self.divisor(self.effects[:, list(chosen)] @ values)
        return values / divisor, errors / divisor

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


def select_terms(
    terms: Sequence[CandidateTerm], units: FloatArray, regression: TermRegression
) -> tuple[list[int], list[float]]:
    """Terms that explain what a fit leaves, the most probable first, and the share that each explains.

    Parameters
    ----------
    terms : sequence of CandidateTerm
    units : (K,) array
        Coefficients with which the RMS force of a term is that of the largest force of its equation.
    regression : TermRegression

    Returns
    -------
    list of int, list of float
        Share of the mean square unmodelled force that earlier terms left, in the equations where the term acts.
    """
    parameters = np.array([x.parameter for x in terms])
    least = _EVIDENCE + np.log(max(len(terms), 1))
    chosen, shares, allowed = list[int](), list[float](), np.ones(len(terms), bool)
    tests = _tests(terms, units, regression)
    while allowed.any():
        odds = tests.log_odds()
        k = int(np.argmax(np.where(allowed, odds, -np.inf)))
        if odds[k] < least:
            break
        allowed[k] = False
        value, (low, high), share = float(regression.joint([k])[0][0]), terms[k].bounds, regression.explained(k)
        if not (low < value < high and abs(value) > _SMALLEST * units[k] and share > _SHARE):
            continue
        beside = regression.beside(k)
        then, others = _tests(terms, units, beside), parameters != parameters[k]
        # Another term that the log still determines, but does not show any more, explains the same.
        replaced = np.isfinite(then.variances) & (then.log_odds() <= 0.0)
        if not (others & replaced & (odds > odds[k] - _EVIDENCE)).any():
            chosen.append(k)
            shares.append(share)
            allowed, tests, regression = allowed & others, then, beside
    return chosen, shares


def _tests(terms: Sequence[CandidateTerm], units: FloatArray, regression: TermRegression) -> CandidateTests:
    return CandidateTests(tuple(terms), units, *regression.estimates(), regression.effects)
