"""Selection of the terms that explain the unmodelled forces of a model.

Over every interval of a log the equations leave a mean force r.  A missing term ``theta h`` appears in it as
``r = -theta h``, up to what the model's parameters take up by moving.  Terms are therefore compared after the columns
that the fit could use instead, the parameters' own and the inputs' rates (a delay), are projected out of both sides
(Frisch-Waugh-Lovell).

Terms are added one at a time, the one with the largest gain of the likelihood of the accelerations first: a sum over
equations of logarithms of residual variances, and of the logarithm of the determinant of the inertia that goes with the
term.  Without it, a term that takes from an input explains forces by making all of them smaller.  One is accepted if

- the gain exceeds what the choice among all candidates gives by chance, with as many independent intervals as the
  residuals' autocorrelation leaves;
- it explains a fifth of the unmodelled force that was left, and more than a thousandth of the inertial force;
- its coefficient is significant under autocorrelated residuals, and has one sign in five parts of the log.

References
----------
Schwarz 1978 (BIC); Newey, West 1987 (covariance under autocorrelation); Meinshausen, Buehlmann 2010 (stability
selection); Brunton, Proctor, Kutz 2016 (sparse identification).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.identification.structure.lacking_terms import Suggestion
from diransac.model import expressions

if TYPE_CHECKING:
    from diransac.identification.structure.candidate_terms import CandidateTerm, CandidateTerms

__all__ = ["MeanForces", "SelectedTerm", "changes_beside", "select_terms", "spanned", "suggestions_of"]

# Smallest gain of the log-likelihood beyond its penalties, nats; smallest share of the remaining force; smallest force
# over the inertial one; smallest coefficient over its standard error.
_EVIDENCE, _SHARE, _RELATIVE, _SIGNIFICANT = 3.0, 0.2, 1e-3, 4.0
# Part of a column's square that own columns must leave; part of the force that inputs must leave unexplained.
_INDEPENDENT, _IDENTITY = 1e-2, 1e-8
# Weights of neighbouring intervals in the regression for coefficients; smallest number of intervals of a block.
_KERNEL, _LEAST_BLOCK = (1 / 9, 2 / 9, 3 / 9, 2 / 9, 1 / 9), 5
# Parts of the log; part of the information that a part must have to count; smallest number of such parts.
_PARTS, _INFORMED, _FEWEST_PARTS = 5, 0.03, 3
_RANK, _TINY = 1e-8, 1e-300


@dataclass(frozen=True)
class MeanForces:
    """Means over n intervals of what the equations leave, and of what could explain it.

    Parameters
    ----------
    force : (n, e) array
        Residuals r of the equations at the estimate.
    noise : (e,) array
        Standard deviation of r by the fit's uncertainty.
    inertial : (e,) array
        RMS of the inertial force of each equation.
    own : (n, e, m) array
        Columns that explain r at no price: derivatives with respect to parameters, and inputs' rates.
    inertia : (r, e, e) array
        Derivatives of the equations with respect to the accelerations, in some rows.
    inertia_slopes : (r, e, e, m) array
        Their derivatives with respect to the coefficients of the own columns.
    discrepancies : (n, e, k) array
        Columns of the forces that the fit attributes to discrepancies, whose coefficients have an error.
    discrepancy_covariance : (k, k) array
        Of that error.
    terms : (n, e, K) array
        Candidates.
    is_input_gain : (K,) bool array
    bounds : (K, 2) array
        Smallest and largest coefficient of each candidate that is possible.
    groups : (K,) int array
        Candidates of one group are forms of one effect, of which at most one is accepted.
    log_of : (n,) int array
        Log of each interval.
    """

    force: FloatArray
    noise: FloatArray
    inertial: FloatArray
    own: FloatArray
    inertia: FloatArray
    inertia_slopes: FloatArray
    discrepancies: FloatArray
    discrepancy_covariance: FloatArray
    terms: FloatArray
    is_input_gain: BoolArray
    bounds: FloatArray
    groups: IntArray
    log_of: IntArray


@dataclass(frozen=True)
class SelectedTerm:
    """A candidate that was accepted.

    Parameters
    ----------
    index : int
        Index among the candidates.
    value, standard_error : float
        Coefficient theta of ``r + theta h = 0``.
    explained : float
        Fraction of the mean square of the unmodelled force that it explains, when it was accepted.
    """

    index: int
    value: float
    standard_error: float
    explained: float


def select_terms(means: MeanForces) -> tuple[SelectedTerm, ...]:
    """Terms that explain the unmodelled forces, in the order in which they were accepted; empty if none does.

    Parameters
    ----------
    means : MeanForces

    Returns
    -------
    tuple of SelectedTerm
    """
    allowed = ~_equivalent_to_the_model(means)
    chosen: list[int] = []
    while len(chosen) < 5:
        found = _Step.of(means, chosen).best(allowed)
        if found is None:
            break
        chosen.append(found)
        allowed &= means.groups != means.groups[found]
    chosen = _significant(means, chosen)
    slopes, errors = _Step.together(_averaged(means), chosen).regression(chosen)
    parts = zip(chosen, slopes, errors, _shares(means, chosen), strict=True)
    return tuple(SelectedTerm(k, -float(x), float(s), share) for k, x, s, share in parts)


def changes_beside(means: MeanForces, selected: Sequence[SelectedTerm]) -> FloatArray:
    """Changes of the coefficients of the own columns when selected terms join them.

    Parameters
    ----------
    means : MeanForces
    selected : sequence of SelectedTerm

    Returns
    -------
    (m,) array
        0 without terms.
    """
    m, chosen = means.own.shape[2], [x.index for x in selected]
    scale = _scale(means, chosen)
    force = _rows(-means.force[:, :, None], scale)[:, 0]
    beside, alone = (
        _slopes(_rows(np.concatenate([means.own, means.terms[:, :, terms]], axis=2), scale), force)[:m]
        for terms in (chosen, [])
    )
    return np.asarray(beside - alone)


def _slopes(A: FloatArray, b: FloatArray) -> FloatArray:
    """Coefficients of least squares of b on the columns of A; 0 for columns of zeros."""
    norm = np.linalg.norm(A, axis=0)
    norm[norm == 0.0] = 1.0
    found = np.linalg.lstsq(A / norm, b, rcond=_RANK)[0]
    return np.asarray(found / norm.reshape(-1, *(1,) * (b.ndim - 1)))


def _averaged(means: MeanForces) -> MeanForces:
    """Weighted means over five neighbouring intervals of one log, for coefficients.

    Accelerations that are constant over an interval overshoot beside a step of the force, as partial sums of a Fourier
    series do, by a tenth of friction that changes sign.  Overshoots cancel over neighbours.
    """
    reach = len(_KERNEL) // 2

    def averaged(values: FloatArray) -> FloatArray:
        found = np.empty_like(values)
        for log in np.unique(means.log_of):
            own = np.flatnonzero(means.log_of == log)
            padded = np.pad(values[own], [(reach, reach)] + [(0, 0)] * (values.ndim - 1), mode="edge")
            found[own] = sum(w * padded[k : k + len(own)] for k, w in enumerate(_KERNEL))
        return found

    return replace(
        means,
        force=averaged(means.force),
        own=averaged(means.own),
        discrepancies=averaged(means.discrepancies),
        terms=averaged(means.terms),
    )


def _significant(means: MeanForces, chosen: list[int]) -> list[int]:
    """The chosen terms without those that the others make superfluous, the least significant first."""
    while chosen:
        slopes, errors = _Step.together(means, chosen).regression(chosen)
        ratios = np.abs(slopes) / (errors + _TINY)
        if ratios.min() > _SIGNIFICANT:
            break
        chosen = [k for i, k in enumerate(chosen) if i != np.argmin(ratios)]
    return chosen


def _shares(means: MeanForces, chosen: Sequence[int]) -> list[float]:
    """Fraction of the mean square of the unmodelled force that each term explains after those before it."""
    shares, acting = list[float](), np.square(means.terms).sum(axis=0) > 0.0
    whole = _left_over(means, [])
    for i, k in enumerate(chosen):
        before, after = _left_over(means, chosen[:i]), _left_over(means, chosen[: i + 1])
        weights = acting[:, k] / (whole + _TINY)
        shares.append(min(1.0, float((weights @ (before - after)) / (weights @ whole))))
    return shares


def _left_over(means: MeanForces, chosen: Sequence[int]) -> FloatArray:
    """Mean square (e,) of the force that own columns and chosen terms leave."""
    step = _Step.of(means, chosen)
    return np.asarray(np.square(step._by_equation(step.force)).mean(axis=0) * np.square(step.scale))


@dataclass(frozen=True)
class _Step:
    """Force and candidates after the projection, in units of each equation's remaining force.

    Parameters
    ----------
    means : MeanForces
    scale : (e,) array
        RMS of the remaining force.
    force : (n e,) array
        Interval after interval.
    terms : (n e, K) array
    discrepancies : (n e, k) array
    inertia : (r, e, e) array
        With the own columns' coefficients that fit best.
    beside : (m, K) array
        Coefficients of the own columns in a regression of each term on what was projected out.
    independent : (K,) bool array
        Candidates that the columns which were projected out do not span.
    """

    means: MeanForces
    scale: FloatArray
    force: FloatArray
    terms: FloatArray
    discrepancies: FloatArray
    inertia: FloatArray
    beside: FloatArray
    independent: BoolArray

    @classmethod
    def of(cls, means: MeanForces, chosen: Sequence[int]) -> _Step:
        """The step after some terms were accepted, which are projected out."""
        return cls._projected(means, [*chosen], _scale(means, chosen))

    @classmethod
    def together(cls, means: MeanForces, chosen: Sequence[int]) -> _Step:
        """All chosen terms among the candidates, weighted by the force that they leave together."""
        return cls._projected(means, [], _scale(means, chosen))

    @classmethod
    def _projected(cls, means: MeanForces, out: Sequence[int], scale: FloatArray) -> _Step:
        columns, m = np.concatenate([means.own, means.terms[:, :, out]], axis=2), means.own.shape[2]
        basis = _basis(columns, scale)
        whole, force = _rows(means.terms, scale), _rows(means.force[:, :, None], scale)
        terms = _left(basis, whole)
        independent = np.square(terms).sum(axis=0) > _INDEPENDENT * np.square(whole).sum(axis=0) + _TINY
        discrepancies = _left(basis, _rows(means.discrepancies, scale))
        beside = _slopes(_rows(columns, scale), np.hstack([-force, whole]))[:m]
        inertia = means.inertia + means.inertia_slopes @ beside[:, 0]
        return cls(means, scale, _left(basis, force)[:, 0], terms, discrepancies, inertia, beside[:, 1:], independent)

    def _by_equation(self, rows: FloatArray) -> FloatArray:
        """Rows (n e, ...) as (n, e, ...)."""
        return rows.reshape(*self.means.force.shape, *rows.shape[1:])

    def _after(self, k: int) -> FloatArray:
        """The force (n, e) that a candidate leaves, over what its inertia is of that without it."""
        h = self.terms[:, k]
        slope = h @ self.force / (h @ h)
        return self._by_equation(self.force - h * slope) / self._shrinkage(np.array([k]), np.array([slope]))

    def _shrinkage(self, candidates: IntArray, slopes: FloatArray) -> FloatArray:
        """Geometric mean (K,) of the factors by which the inertia changes with candidates, of all its directions."""
        changed = self.means.inertia_slopes @ (self.beside[:, candidates] * slopes)
        after = np.moveaxis(self.inertia[..., None] + changed, 3, 0)
        before, e = np.abs(np.linalg.det(self.inertia)), self.inertia.shape[1]
        logarithms = np.log((np.abs(np.linalg.det(after)) + _TINY) / (before + _TINY))
        return np.asarray(np.exp(logarithms.mean(axis=1) / e))

    @property
    def _noise(self) -> FloatArray:
        """Mean square (e,) of the force's error: of the fit, and of its discrepancies."""
        of_discrepancies = (self.discrepancies @ self.means.discrepancy_covariance * self.discrepancies).sum(axis=1)
        return np.asarray(np.square(self.means.noise / self.scale) + self._by_equation(of_discrepancies).mean(axis=0))

    def best(self, allowed: BoolArray) -> int | None:
        """The candidate with the largest gain, if it is accepted, or else the next of its group that is."""
        usable = np.flatnonzero(allowed & self.independent)
        if not len(usable):
            return None
        h = self.terms[:, usable]
        slopes = (h.T @ self.force) / np.square(h).sum(axis=0)
        lowest, highest = self.means.bounds[usable].T
        possible = (lowest < -slopes) & (-slopes < highest)
        squares = np.square(self._by_equation(self.force[:, None] - h * slopes)).sum(axis=0)
        squares = squares / np.square(self._shrinkage(usable, slopes))
        gains = np.where(possible, self._gain(squares), -np.inf)
        groups = self.means.groups[usable]
        order = np.argsort(-gains, kind="stable")
        tried = (i for i in order if groups[i] == groups[order[0]])
        return next((int(usable[i]) for i in tried if self._is_accepted(usable[i], gains[i], len(usable))), None)

    def _gain(self, squares: FloatArray) -> FloatArray:
        """Gain of the log-likelihood of independent intervals (K,), by squares (e, K) of what candidates leave.

        The noise of the force bounds it: what is below the noise counts as explained already.
        """
        n = len(self.means.force)
        before, noise = np.square(self._by_equation(self.force)).sum(axis=0), n * self._noise
        gain = 0.5 * n * np.log((before + noise)[:, None] / (squares + noise[:, None]))
        return np.asarray(gain.sum(axis=0))

    def _is_accepted(self, k: int, gain: float, n_candidates: int) -> bool:
        """True if a candidate's effect is likely, large, significant and stable."""
        n_independent = self._independent_intervals(k)
        penalty = 0.5 * np.log(n_independent) + np.log(n_candidates)
        if gain * n_independent / len(self.means.force) < penalty + _EVIDENCE or self.explained(k) < _SHARE:
            return False
        h = self.terms[:, k]
        force = self._by_equation(h * (h @ self.force / (h @ h))) * self.scale
        if (np.sqrt(np.square(force).mean(axis=0)) < _RELATIVE * self.means.inertial).all():
            return False
        value, error = self.regression([k])
        return bool(abs(value[0]) > _SIGNIFICANT * error[0]) and self._is_stable(k)

    def _independent_intervals(self, k: int) -> float:
        """Number of intervals, less what the autocorrelation of the remaining force leaves of it."""
        left = self._after(k)
        e = np.argmax(np.square(self._by_equation(self.terms[:, k])).sum(axis=0))
        linked = self.means.log_of[1:] == self.means.log_of[:-1]
        lagged = (left[1:, e] * left[:-1, e])[linked].sum() / (np.square(left[:, e]).sum() + _TINY)
        rho = float(np.clip(lagged, 0.0, 0.95))
        return len(left) * (1.0 - rho) / (1.0 + rho)

    def explained(self, k: int) -> float:
        """Fraction of the remaining mean square force that a candidate explains in the equations where it acts."""
        acts = np.square(self.means.terms[:, :, k]).sum(axis=0) > 0.0
        before = np.square(self._by_equation(self.force)[:, acts]).sum()
        return float(1.0 - np.square(self._after(k)[:, acts]).sum() / (before + _TINY))

    def _is_stable(self, k: int) -> bool:
        """True if the coefficient has one sign in all contiguous parts of the log that inform of it, but for one."""
        h, force = self._by_equation(self.terms[:, k]), self._by_equation(self.force)
        pairs = np.stack([(h * force).sum(axis=1), np.square(h).sum(axis=1)])
        products, information = np.array([x.sum(axis=1) for x in np.array_split(pairs, _PARTS, axis=1)]).T
        informed = information > _INFORMED * information.sum()
        agreeing = np.sign(products[informed]) == np.sign(products.sum())
        return bool(informed.sum() >= _FEWEST_PARTS and agreeing.sum() >= informed.sum() - 1)

    def regression(self, chosen: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Slopes of the force on some terms, and standard errors.

        Their covariance is that of sums of scores over about sqrt(n) neighbouring intervals each, which counts what
        neighbours have in common, and that of the discrepancies.
        """
        C = self.terms[:, list(chosen)]
        inverse = np.linalg.pinv(C.T @ C)
        slopes = inverse @ (C.T @ self.force)
        scores = self._by_equation(C * (self.force - C @ slopes)[:, None]).sum(axis=1)
        n = len(scores)
        sums = np.add.reduceat(scores, np.arange(0, n, max(_LEAST_BLOCK, round(np.sqrt(n)))), axis=0)
        common = C.T @ self.discrepancies
        inner = sums.T @ sums + common @ self.means.discrepancy_covariance @ common.T
        return slopes, np.sqrt(np.diag(inverse @ inner @ inverse))


def _scale(means: MeanForces, chosen: Sequence[int]) -> FloatArray:
    """RMS (e,) of the force that own columns and chosen terms leave, or of its noise, by weighted least squares."""
    least = np.maximum(means.noise, _RANK * means.inertial) + _TINY
    scale = np.maximum(np.sqrt(np.square(means.force).mean(axis=0)), least)
    columns = np.concatenate([means.own, means.terms[:, :, list(chosen)]], axis=2)
    for _ in range(2):
        left = _left(_basis(columns, scale), _rows(means.force[:, :, None], scale)).reshape(means.force.shape)
        scale = np.maximum(scale * np.sqrt(np.square(left).mean(axis=0)), least)
    return np.asarray(scale)


def _rows(columns: FloatArray, scale: FloatArray) -> FloatArray:
    """Columns (n, e, c) over the scales as (n e, c)."""
    n, e, c = columns.shape
    return np.asarray((columns / scale[:, None]).reshape(n * e, c))


def _basis(columns: FloatArray, scale: FloatArray) -> FloatArray:
    """Orthonormal basis (n e, rank) of columns (n, e, c)."""
    A = _rows(columns, scale)
    U, values, _ = np.linalg.svd(A / (np.linalg.norm(A, axis=0) + _TINY), full_matrices=False)
    return np.asarray(U[:, values > _RANK * values[0]])


def _left(basis: FloatArray, columns: FloatArray) -> FloatArray:
    """Columns without their components in the basis."""
    return np.asarray(columns - basis @ (basis.T @ columns))


def _equivalent_to_the_model(means: MeanForces) -> BoolArray:
    """Mask (K,) of input gains that, with the parameters, reproduce an equation whatever the forces.

    If every term of an equation has a parameter or is an input, parameters that vanish and a gain of -1 satisfy it.
    """
    gains = np.flatnonzero(means.is_input_gain)
    found = np.zeros(means.terms.shape[2], bool)
    for i in range(means.force.shape[1]):
        acting = gains[np.square(means.terms[:, i, gains]).sum(axis=0) > 0.0]
        found[acting] |= spanned(means.force[:, i], means.own[:, i], means.terms[:, i, acting])
    return found


def spanned(force: FloatArray, own: FloatArray, others: FloatArray) -> bool:
    """True if other columns explain all of the force that own columns leave, to rounding.

    Parameters
    ----------
    force : (n,) array
    own, others : (n, m) array

    Returns
    -------
    bool
    """
    left, whole = (np.square(_residual_of(A, force)).sum() for A in (np.hstack([own, others]), own))
    return bool(left <= _IDENTITY * whole)


def _residual_of(A: FloatArray, b: FloatArray) -> FloatArray:
    """Residual of least squares of b on the columns of A."""
    scaled = A / (np.linalg.norm(A, axis=0) + _TINY)
    return np.asarray(b - scaled @ np.linalg.lstsq(scaled, b, rcond=None)[0])


# ---------------------------------------------------------------------- wording


def suggestions_of(candidates: CandidateTerms, selected: Sequence[SelectedTerm]) -> tuple[Suggestion, ...]:
    """Accepted terms in words and as lines of model code.

    Parameters
    ----------
    candidates : CandidateTerms
    selected : sequence of SelectedTerm

    Returns
    -------
    tuple of Suggestion
    """
    return tuple(_suggestion(candidates, candidates.terms[x.index], x) for x in selected)


def _suggestion(candidates: CandidateTerms, term: CandidateTerm, found: SelectedTerm) -> Suggestion:
    digits = max(0, 1 - int(np.floor(np.log10(found.standard_error)))) if found.standard_error > 0.0 else 3
    value, error = (f"{x:.{digits}f}" if digits < 6 else f"{x:.3g}" for x in (found.value, found.standard_error))
    unit = f" {term.unit}" if term.unit not in ("", "1") else ""
    share = f"explains {100.0 * found.explained:.0f} % of the unmodelled force"
    if term.is_input_gain:
        text = f"Gain of {term.place}: an error of {value} ± {error} {share}"
    else:
        formula = f" {term.formula}" if term.formula else ""
        text = f"{term.name[0].upper()}{term.name[1:]}: {value} ± {error}{unit}{formula} {share}"
    h = ca.Function("term", list(candidates.symbols), [ca.densify(term.residuals)], list("qvaup"), ["h"])
    return Suggestion(
        term.kind, term.place, text, term.parameter, found.value, found.standard_error, term.unit, found.explained,
        term.code, expressions.stored(f"term {term.parameter}", h), term.name,
    )  # fmt: skip
