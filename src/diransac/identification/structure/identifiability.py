"""Identifiability in words: the combinations of parameters that a model or a log determines.

Two kinds of ambiguity have different remedies.  A *structural* one is of the equations: ``dr/dp`` has the same null
space at every motion, and no motion helps (`structural`).  A *practical* one is of the log: the equations distinguish
the parameters, but this motion does not.

References
----------
Belsley, Kuh and Welsch 1980 (collinearity of scaled columns).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray, size_or_one
from diransac.identification.regression.rows import PART_OF_NULL_VECTOR, NullSpace

# Largest difference of equal projectors.
_SAME = 1e-5


@dataclass(frozen=True)
class Ambiguity:
    """Parameters of which only combinations are determined.

    Parameters
    ----------
    names : tuple of str
        Parameters.
    n_determined : int
        Number of combinations that are determined.
    combinations : tuple of str
        The combinations as text, ``a + 2 b`` or ``k/mass``; empty where they depend on the values of the parameters.
    noun : str, optional
        "combination" or "ratio".
    reason : str, optional
        Reason, as a clause that follows a comma; where nothing is determined, the motions for which that holds.
    """

    names: tuple[str, ...]
    n_determined: int
    combinations: tuple[str, ...]
    noun: str = "combination"
    reason: str = ""

    def determined(self) -> str:
        """Clause about what is determined: ``only the combination a + 2 b is determined``."""
        one = self.n_determined == 1
        nouns = self.noun if one else f"{self.noun}s"
        which = f"the {nouns} {', '.join(self.combinations)}"
        unnamed = f"{self.n_determined} {nouns} of them"
        return f"only {which if self.combinations else unnamed} {'is' if one else 'are'} determined"

    def of_equations(self) -> str:
        """Clause about an ambiguity of the equations: what is determined, why, and what to do."""
        if not self.n_determined:
            have, them = ("it has", "it") if len(self.names) == 1 else ("they have", "them")
            if self.reason:
                return (
                    f"{have} no effect in the equations {self.reason}; compare units and constants of the model with it"
                )
            return f"{have} no effect in the equations, whatever the motion; remove {them} from the model"
        reason = f", {self.reason}" if self.reason else ""
        n_free = len(self.names) - self.n_determined
        which = f"one, for example {self.names[0]}," if n_free == 1 else f"{n_free} of them"
        return f"{self.determined()}{reason}; no motion helps: fix {which} at a known value, {self.remedy()}"

    def of_motion(self) -> str:
        """Clause about an ambiguity of a log: what is determined, and what to do."""
        if not self.n_determined:
            them = "it" if len(self.names) == 1 else "them"
            return f"the motion does not excite {them}; record a livelier motion, or fix {them}, {self.remedy()}"
        return f"{self.determined()} by this motion; record a livelier motion, or fix one of them, {self.remedy()}"

    def of_noise(self) -> str:
        """Clause about parameters that the motion excites, but less than forces that are not in the model."""
        it, terms = ("it", "its term") if len(self.names) == 1 else ("them", "their terms")
        what = f"the motion excites {it}, but unmodelled forces and noise are larger than {terms}"
        return f"{what}; correct the model, or fix {it}, {self.remedy()}"

    def remedy(self) -> str:
        """Argument and option that fix the first parameter, for example."""
        first = self.names[0]
        name = first if "/" in first else first.partition("[")[0]  # a mask's index is part of the name
        return f'by fixed={{"{name}": ...}} or --fix {name}=...'

    def sentence(self, clause: str, logs: str = "") -> str:
        """The names, ``is not identifiable``, and a clause."""
        verb = "is" if len(self.names) == 1 else "are"
        return f"{', '.join(self.names)} {verb} not identifiable{logs}: {clause}"


# ---------------------------------------------------------------------- ambiguities of the equations


def equations_in_words(found: Sequence[Ambiguity]) -> str:
    """A sentence on each ambiguity of the equations."""
    return "; ".join(x.sentence(x.of_equations()) for x in found)


def joined(found: Sequence[Ambiguity]) -> tuple[Ambiguity, ...]:
    """Ambiguities, with all parameters that are in no combination as one."""
    alone = tuple(name for x in found if not x.n_determined for name in x.names)
    return (*((Ambiguity(alone, 0, ()),) if alone else ()), *(x for x in found if x.n_determined))


def components(directions: FloatArray, part: float) -> list[IntArray]:
    """Groups of parameters that null vectors ``(d, n)`` connect."""
    projector = np.abs(directions.T @ directions)
    linked = projector > part * projector.max(initial=0.0)
    linked &= np.diag(linked)[:, None] & np.diag(linked)
    groups: list[IntArray] = []
    left = set(np.flatnonzero(np.diag(linked)).tolist())
    while left:
        group, waiting = set[int](), {min(left)}
        while waiting:
            group |= waiting
            waiting = set(np.flatnonzero(linked[sorted(waiting)].any(axis=0)).tolist()) - group
        groups.append(np.array(sorted(group)))
        left -= group
    return groups


def ambiguity_of(names: list[str], spaces: Sequence[NullSpace], vectors: Sequence[FloatArray]) -> Ambiguity:
    """The ambiguity of one group, from its null space at several parameter vectors."""
    first, n_determined = spaces[0], len(names) - len(spaces[0].directions)
    if _all_same([x.in_units_of(first.scale) for x in spaces]):
        return Ambiguity(tuple(names), n_determined, tuple(_sum(names, c) for c in _echelon(first.complement())))
    relative = [x.in_units_of(first.scale * vectors[0] / p) for x, p in zip(spaces, vectors, strict=True)]
    if not _all_same(relative):
        return Ambiguity(tuple(names), n_determined, ())
    exponents = _echelon(first.complement() * vectors[0])
    noun = "ratio" if np.abs(exponents.sum(axis=1)).max(initial=0.0) < 1e-3 else "combination"
    return Ambiguity(tuple(names), n_determined, tuple(_product(names, e) for e in exponents), noun)


def _all_same(projectors: Sequence[FloatArray]) -> bool:
    return all(np.abs(x - projectors[0]).max(initial=0.0) < _SAME for x in projectors)


def _echelon(rows: FloatArray) -> FloatArray:
    """Reduced row echelon form whose pivots are in the last columns, so that the first parameters are shared."""
    if not len(rows):
        return rows
    size = size_or_one(np.abs(rows).max(axis=0))
    A, done = (rows / size)[:, ::-1].copy(), 0
    for column in range(A.shape[1]):
        pivot = done + int(np.argmax(np.abs(A[done:, column])))
        if abs(A[pivot, column]) < _SAME:
            continue
        A[[done, pivot]] = A[[pivot, done]]
        A[done] /= A[done, column]
        others = np.arange(len(A)) != done
        A[others] -= A[others, column][:, None] * A[done]
        done += 1
        if done == len(A):
            break
    return np.asarray(np.where(np.abs(A) < _SAME, 0.0, A)[::-1, ::-1] * size)


def _sum(names: Sequence[str], coefficients: FloatArray) -> str:
    """``a + 2 b``, with normalized coefficients."""
    c, text = _normalized(coefficients), ""
    for i in np.flatnonzero(c).tolist():
        size = f"{abs(c[i]):.3g}"
        sign = ("-" if c[i] < 0.0 else "") if not text else (" - " if c[i] < 0.0 else " + ")
        text += f"{sign}{'' if size == '1' else size + ' '}{names[i]}"
    return text


def _normalized(coefficients: FloatArray) -> FloatArray:
    """Coefficients of which the smallest is one in size, and the first positive."""
    used = coefficients[coefficients != 0.0]
    return np.asarray(coefficients / np.abs(used).min() * np.sign(used[0]))


def _product(names: Sequence[str], exponents: FloatArray) -> str:
    """``a b/c^2``: the smallest exponent is one, the last is positive."""
    e = _normalized(exponents[::-1])[::-1]
    used = np.flatnonzero(e).tolist()
    over, under = (" ".join(_power(names[i], abs(e[i])) for i in used if s * e[i] > 0.0) for s in (1.0, -1.0))
    if not under:
        return over
    return f"{over or '1'}/{f'({under})' if ' ' in under else under}"


def _power(name: str, exponent: float) -> str:
    size = f"{exponent:.3g}"
    return name if size == "1" else f"{name}^{size}"


# ---------------------------------------------------------------------- ambiguities of a log


def of_log(names: Sequence[str], space: NullSpace) -> tuple[Ambiguity, ...]:
    """Parameters that the rows of a log do not determine one by one.

    Parameters
    ----------
    names : sequence of str
        Names of all n parameters.
    space : NullSpace
        Directions in which the rows do not change.

    Returns
    -------
    tuple of Ambiguity
    """
    found = []
    for group in components(space.directions, PART_OF_NULL_VECTOR**2):
        own, part = [names[i] for i in group], space.of(group)
        n_determined = len(own) - len(part.directions)
        sums = tuple(_sum(own, c) for c in _echelon(part.complement())) if n_determined == 1 else ()
        found.append(Ambiguity(tuple(own), n_determined, sums))
    return joined(found)


def in_words(ambiguous: Sequence[Ambiguity], n_logs: int) -> str:
    """Sentences about what logs do not determine, in one line without a stop.

    Parameters
    ----------
    ambiguous : sequence of Ambiguity
        Result of `of_log`.
    n_logs : int

    Returns
    -------
    str
    """
    return "; ".join(x.sentence(x.of_motion(), of_logs(n_logs)) for x in ambiguous)


def of_logs(n_logs: int) -> str:
    """Suffix of a sentence: from this log, or from these logs."""
    return " from this log" if n_logs == 1 else " from these logs"


def collinear(
    names: Sequence[str], values: FloatArray, covariance: FloatArray, uncertain: BoolArray
) -> tuple[Ambiguity, ...]:
    """Uncertain parameters, those together whose errors are correlated so that a combination is determined.

    Parameters
    ----------
    names : sequence of str
        Names of all n parameters.
    values : (n,) array
        Estimates, each in its unit.
    covariance : (n, n) array
    uncertain : (n,) bool array
        Parameters whose error is too large for the estimate to be of use.

    Returns
    -------
    tuple of Ambiguity
        The text of a combination has its value and standard error.
    """
    weak = np.flatnonzero(uncertain & (np.diag(covariance) > 0.0) & np.isfinite(covariance).all(axis=1))
    errors = np.sqrt(np.diag(covariance)[weak])
    sizes, vectors = np.linalg.eigh(covariance[np.ix_(weak, weak)] / errors[:, None] / errors)
    # Small eigenvalues of a correlation matrix are those of collinear parameters.
    determined = vectors[:, sizes < 0.05].T
    determined = np.where(np.abs(determined) > 0.2, determined, 0.0)
    found, left = [], np.flatnonzero(uncertain).tolist()
    for group in components(determined, 0.0):
        own, rows = weak[group].tolist(), determined[determined[:, group].any(axis=1)][:, group]
        texts = tuple(
            _estimated([names[i] for i in own], row / errors[group], values[own], covariance[np.ix_(own, own)])
            for row in rows
        )
        found.append(Ambiguity(tuple(names[i] for i in own), len(rows), texts if len(rows) == 1 else ()))
        left = [i for i in left if i not in own]
    return joined([*found, Ambiguity(tuple(names[i] for i in left), 0, ())])


def vague_parameters(
    names: Sequence[str], values: FloatArray, covariance: FloatArray, correlations: FloatArray
) -> tuple[Ambiguity, ...]:
    """Parameters that do not differ from zero, since their errors are collinear.

    Parameters
    ----------
    names : sequence of str
        Names of all n parameters.
    values : (n,) array
        Estimates, each in its unit.
    covariance : (n, n) array
        Of which the variances are used: a jackknife of few blocks has spurious correlations.
    correlations : (n, n) array
        Of the errors, from the regressor.

    Returns
    -------
    tuple of Ambiguity
    """
    errors = np.sqrt(np.diag(covariance))
    # Zero is in the 95 % interval.
    uncertain = np.isfinite(errors) & (1.96 * errors > np.abs(values))
    errors = np.where(uncertain, errors, 0.0)
    found = collinear(names, values, correlations * errors[:, None] * errors, uncertain)
    return tuple(x for x in found if x.n_determined)


def _estimated(names: Sequence[str], coefficients: FloatArray, values: FloatArray, covariance: FloatArray) -> str:
    """``a + 2 b = 1.23 ± 0.01``: a combination with its estimate and standard error."""
    c = _normalized(coefficients)
    error = np.sqrt(np.maximum(c @ covariance @ c, 0.0))
    return f"{_sum(names, c)} = {c @ values:.4g} ± {error:.2g}"
