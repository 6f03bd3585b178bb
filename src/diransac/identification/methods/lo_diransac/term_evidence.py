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
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.methods.lo_diransac.interval_effects import batch_sums

if TYPE_CHECKING:
    from diransac.identification.structure.candidate_terms import CandidateTerm

# Prior: RMS force of a term over the largest force of its equation; odds of the terms of a kind and place, together.
_RELATIVE, _ODDS = 0.1, 1.0
# Logarithm of the odds of a suggested term, after the choice among all candidates: strong evidence (Kass, Raftery).
_EVIDENCE = 3.0
# Smallest force of a suggested term over the largest one of its equation, and part of the force left that it explains.
_SMALLEST, _SHARE = 1e-3, 0.2
# Steps of reweighting; part of the information of a term, and of the largest force, that is rounding; rank of columns.
_REWEIGHTED, _ROUNDING, _RANK = 3, 1e-12, 1e-8
_TINY = 1e-300


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
    """

    effects: FloatArray
    direct: FloatArray
    residuals: FloatArray
    columns: FloatArray

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

    def of(self, chosen: Sequence[int]) -> TermRegression:
        """The regression on some of the effects."""
        some = list(chosen)
        return TermRegression(self.effects[:, some], self.direct[some], self.residuals, self.columns[:, :, some])

    def beside(self, k: int) -> TermRegression:
        """The regression with effect k among all else that is estimated."""
        own = self.columns[:, :, k]
        along = own / (np.square(own).sum() + _TINY)
        shares = np.einsum("wm,wmk->k", along, self.columns)
        left = self.residuals - own * (along * self.residuals).sum()
        effects = self.effects - self.effects[:, k, None] * shares
        return TermRegression(effects, self.direct, left, self.columns - own[:, :, None] * shares)

    def error(self, k: int, chosen: Sequence[int]) -> float:
        """Standard error of the coefficient of one of the chosen effects, beside the others."""
        regression = self.of([k, *(x for x in chosen if x != k)])
        for i in range(1, len(chosen)):
            regression = regression.beside(i)
        return float(np.sqrt(regression.estimates()[1][0]))


@dataclass(frozen=True)
class MeanForces:
    """Means over n intervals of what the equations leave on a fitted motion, and of what could explain it.

    The regression is linear where a model is affine in its parameters, however far a missing term has biased them.

    Parameters
    ----------
    force : (n, e) array
        Residuals r of the equations.
    own : (n, e, m) array
        Columns that explain r at no price: derivatives with respect to parameters, and to delays of inputs.
    terms : (n, e, K) array
        Candidates.
    largest : (e,) array
        RMS of the largest force of each equation.
    inertia : callable
        Derivatives (..., e, e) of the equations with respect to the accelerations, by changes (m,) of the coefficients
        of the own columns.
    """

    force: FloatArray
    own: FloatArray
    terms: FloatArray
    largest: FloatArray
    inertia: Callable[[FloatArray], FloatArray]

    def coefficients(self, chosen: Sequence[int], left: FloatArray) -> FloatArray:
        """Least-squares coefficients ``(m + c,)`` of own columns and terms; ``left (e,)`` is the weights' inverse."""
        columns = self._columns(chosen) / (left[:, None] + _TINY)
        columns = columns.reshape(self.force.size, -1)
        size = np.linalg.norm(columns, axis=0)
        size[size == 0.0] = 1.0
        return np.asarray(
            np.linalg.lstsq(columns / size, -(self.force / (left + _TINY)).ravel(), rcond=_RANK)[0] / size
        )

    def left(self, chosen: Sequence[int]) -> FloatArray:
        """RMS ``(e,)`` of the force that own columns and terms leave; equations are weighted by it."""
        found = np.sqrt(np.square(self.force).mean(axis=0))
        for _ in range(_REWEIGHTED):
            found = np.maximum(found, _ROUNDING * self.largest)
            rest = self.force + self._columns(chosen) @ self.coefficients(chosen, found)
            found = np.sqrt(np.square(rest).mean(axis=0))
        return np.asarray(np.maximum(found, _ROUNDING * self.largest))

    def _columns(self, chosen: Sequence[int]) -> FloatArray:
        return np.concatenate([self.own, self.terms[:, :, list(chosen)]], axis=2)

    def changes(self, chosen: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Changes ``(m,)`` of the coefficients of own columns with the terms, and coefficients ``(c,)`` of these."""
        left, m = self.left(chosen), self.own.shape[2]
        found = self.coefficients(chosen, left)
        return found[:m] - self.coefficients([], left), found[m:]

    def explained(self, chosen: Sequence[int], k: int) -> float:
        """Fraction of the mean square force that term k explains after those chosen, in the equations where it acts.

        A term that takes from an input would explain forces by making all of them smaller, inertia included: what is
        left counts over the geometric mean of the factors by which the inertia changes.
        """
        acts, m = self.terms[:, :, k].any(axis=0), self.own.shape[2]
        before, after = self.left(chosen), self.left([*chosen, k])
        own = [self.coefficients(*x)[:m] for x in ((chosen, before), ([*chosen, k], after))]
        determinants = [np.linalg.slogdet(self.inertia(x))[1].mean() for x in own]
        shrunk = np.exp((determinants[1] - determinants[0]) / len(before))
        ratio = after[acts] / (before[acts] * shrunk + _TINY)
        return float(1.0 - np.square(ratio).mean())


def select_terms(
    terms: Sequence[CandidateTerm], units: FloatArray, regression: TermRegression, forces: MeanForces
) -> list[int]:
    """Terms that explain what a fit leaves, the most probable first; empty if none does.

    Parameters
    ----------
    terms : sequence of CandidateTerm
    units : (K,) array
        Coefficients with which the RMS force of a term is that of the largest force of its equation.
    regression : TermRegression
    forces : MeanForces

    Returns
    -------
    list of int
    """
    parameters = np.array([x.parameter for x in terms])
    least = _EVIDENCE + np.log(max(len(terms), 1))
    chosen, allowed = list[int](), np.ones(len(terms), bool)
    tests = _tests(terms, units, regression)
    while allowed.any():
        odds = tests.log_odds()
        k = int(np.argmax(np.where(allowed, odds, -np.inf)))
        if odds[k] < least:
            break
        allowed[k] = False
        if not _is_supported(tests, forces, chosen, k, least):
            continue
        beside = regression.beside(k)
        then, others = _tests(terms, units, beside), parameters != parameters[k]
        # Another term that the log still determines, but does not show any more, explains the same.
        replaced = np.isfinite(then.variances) & (then.log_odds() <= 0.0)
        if not (others & replaced & (odds > odds[k] - _EVIDENCE)).any():
            chosen.append(k)
            allowed, tests, regression = allowed & others, then, beside
    return chosen


def _tests(terms: Sequence[CandidateTerm], units: FloatArray, regression: TermRegression) -> CandidateTests:
    return CandidateTests(tuple(terms), units, *regression.estimates(), regression.effects)


def _is_supported(tests: CandidateTests, forces: MeanForces, chosen: Sequence[int], k: int, least: float) -> bool:
    """True if least squares on the fitted motion agrees that a term is there, possible and large."""
    value = forces.changes([*chosen, k])[1][-1]
    low, high = tests.terms[k].bounds
    there = replace(tests, estimates=np.full(len(tests.terms), value)).log_odds()[k] > least
    large = abs(value) > _SMALLEST * tests.units[k] and forces.explained(chosen, k) > _SHARE
    return bool(low < value < high and there and large)
