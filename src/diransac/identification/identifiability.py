"""Identifiability in words: the combinations of parameters that a model or a log determines.

Two kinds of ambiguity have different remedies.  A *structural* one is of the equations: ``dr/dp`` has the same null
space at every motion, and no motion helps.  A *practical* one is of the log: the equations distinguish the parameters,
but this motion does not.

References
----------
Bellman and Astrom 1970 (structural identifiability); Gautier and Khalil 1990 (base parameters); Stigter and Molenaar
2015 (rank of sensitivities); Belsley, Kuh and Welsch 1980 (collinearity of scaled columns).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.errors import IdentificationError

if TYPE_CHECKING:
    from diransac.data.dataset import ParameterLayout
    from diransac.model import Model, Parameter

__all__ = [
    "Ambiguity",
    "NullSpace",
    "Ranges",
    "check_structure",
    "collinear",
    "in_words",
    "null_space",
    "of_log",
    "residual_slopes",
    "structural",
    "structural_slopes",
    "unidentifiable",
    "vague_parameters",
]

# Parameter vectors at which dr/dp is evaluated; random motions for each, at least and per parameter; the decades below
# half a range that they cover, and half the range of a signal of which no log shows it.
_N_VECTORS, _N_MOTIONS, _PER_PARAMETER, _DECADES, _HALF_RANGE = 3, 60, 4, 3.0, 10.0
# Random motions of which some signals are measured, their steps per unknown, and a step over the fastest time constant.
_N_TRAJECTORIES, _STEPS_PER_UNKNOWN, _STEP = 4, 2, 0.2
# Singular value over the largest below which it is zero, of dr/dp and of sensitivities, whose sizes differ by decades;
# entry of a null vector that is not zero; equal projectors.
_RANK, _RANK_OF_OUTPUTS, _PART, _SAME = 1e-9, 1e-12, 1e-5, 1e-5
# Entry from which on a parameter takes part in a null vector of a log.
_PART_OF_LOG = 0.1
# Eigenvalue of a correlation matrix below which parameters are collinear, and entry that takes part.
_COLLINEAR, _PART_OF_CORRELATION = 0.05, 0.2
# Standard errors of a 95 % interval to either side.
_TWO_SIDED = 1.96
Ranges = tuple[tuple[str, float, float], ...]
"""Smallest and largest value of states and inputs, by name."""

_UNMEASURED = "since not all states are measured"
_HOMOGENEOUS = "since each term has one of them as a factor (b = 0 in W p = b)"


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
        name = self.names[0].partition("[")[0]
        return f'by fixed={{"{name}": ...}} or --fix {name}=...'

    def sentence(self, clause: str, logs: str = "") -> str:
        """The names, ``is not identifiable``, and a clause."""
        verb = "is" if len(self.names) == 1 else "are"
        return f"{', '.join(self.names)} {verb} not identifiable{logs}: {clause}"


# ---------------------------------------------------------------------- ambiguities of the equations


@lru_cache(maxsize=64)
def structural(
    model: Model, measured: tuple[str, ...] | None = None, ranges: Ranges | None = None
) -> tuple[Ambiguity, ...]:
    """Parameters that no log determines one by one, from the null space of ``dr/dp`` at random motions.

    Where states are not measured, it is the null space of the sensitivities of the measured signals, for any initial
    state, in short random motions.

    Accelerations satisfy the equations, so that the scale of homogeneous equations is in the null space.  A null space
    that does not depend on the parameters leaves sums, one of ``dp/p`` that does not leaves products and ratios.  A
    parameter whose bounds coincide is known.

    Random motions are of several magnitudes.  A term may vanish at all of them, as a rate ``exp(-E/T)`` does at a few
    kelvin: with the ranges of a log, an ambiguity is also one of motions in these ranges.

    Parameters
    ----------
    model : Model
    measured : tuple of str, optional
        Signals that are measured; None: all.
    ranges : tuple of (str, float, float), optional
        Of states and inputs, in which a log's motion is.

    Returns
    -------
    tuple of Ambiguity
        Empty where each parameter is identifiable from these signals, random motions give no finite equations, or the
        number of ambiguities depends on the parameters.
    """
    if ranges is not None and not structural(model, measured):
        return ()
    rng = np.random.default_rng(20240607)
    bounds = list(model.parameters.values())
    free = np.flatnonzero([x.lower < x.upper for x in bounds])
    vectors = [_random_parameters(bounds, rng) for _ in range(_N_VECTORS)]

    def jacobian(p: FloatArray, ranges: Ranges) -> FloatArray:
        if measured is None:
            return _random_jacobian(model, p, rng, ranges)
        return _output_jacobian(model, p, rng, measured, ranges)

    jacobians = [np.concatenate([jacobian(p, x) for x in ((), ranges) if x is not None])[:, free] for p in vectors]
    if not len(free) or min(map(len, jacobians)) < len(free):
        return ()
    spaces = [_null_space(J, _RANK if measured is None else _RANK_OF_OUTPUTS) for J in jacobians]
    if len({len(x.directions) for x in spaces}) > 1:
        return ()
    names = np.array(list(model.parameters))[free]
    found = []
    for group in _components(spaces[0].directions, _PART):
        parts = [x.of(group) for x in spaces]
        found.append(_ambiguity(names[group].tolist(), parts, [p[free][group] for p in vectors]))
    if measured is not None:
        found = [replace(x, reason=_UNMEASURED if x.n_determined else "") for x in found]
    elif not model.nonlinear_parameters:
        found = [replace(x, reason=_HOMOGENEOUS) if x.noun == "ratio" else x for x in found]
    joined = _joined(found)
    if any(not x.n_determined and _in_equations(model) & set(x.names) for x in joined):
        where = "at random motions" if ranges is None else "at any motion in the ranges of the log"
        joined = tuple(replace(x, reason=x.reason if x.n_determined else where) for x in joined)
    return joined


def _in_equations(model: Model) -> set[str]:
    """Parameters that are in the equations or in a sensor, whatever their values."""
    columns = residual_slopes(model).sparsity_out(0).get_triplet()[1]
    return {list(model.parameters)[k] for k in columns}


def check_structure(
    model: Model,
    source: str,
    allow: int = 0,
    measured: tuple[str, ...] | None = None,
    ranges: Ranges | None = None,
) -> None:
    """Raise IdentificationError for parameters that the equations do not determine, whatever the motion.

    Parameters
    ----------
    model : Model
    source : str
        Name of the logs in the message.
    allow : int, optional
        Number of such parameters that the caller can do with.
    measured : tuple of str, optional
        Signals that are measured; None: all.
    ranges : tuple of (str, float, float), optional
        As `structural`.
    """
    found = structural(model, measured, ranges)
    if sum(len(x.names) for x in found) > allow:
        raise IdentificationError(f"{source}: {'; '.join(x.sentence(x.of_equations()) for x in found)}")


def structural_slopes(model: Model, parameters: FloatArray, given: IntArray) -> FloatArray:
    """Changes of the parameters that leave every motion as it is, per change of some of them.

    Parameters
    ----------
    model : Model
        Whose equations do not determine all parameters.
    parameters : (n_p,) array
        Each in its unit.
    given : (k,) int array
        Positions of parameters which, if they were known, would make the others identifiable.

    Returns
    -------
    (n_p, k) array
        1 and 0 in the rows of the given ones.
    """
    space = _null_space(_random_jacobian(model, parameters, np.random.default_rng(20240607), ()), _RANK)
    directions = space.directions / space.scale
    return np.asarray((np.linalg.pinv(directions[:, given]) @ directions).T)


def _random_parameters(bounds: Sequence[Parameter], rng: np.random.Generator) -> FloatArray:
    """A vector ``(n_p,)`` within the bounds, of order one where they are open."""
    lower = np.array([max(x.lower, 0.0) if x.positive else x.lower for x in bounds])
    upper = np.array([x.upper for x in bounds])
    draw, sign = rng.uniform(0.5, 2.5, len(bounds)), rng.choice([-1.0, 1.0], len(bounds))
    has_lower, has_upper = np.isfinite(lower), np.isfinite(upper)
    low, high = np.where(has_lower, lower, 0.0), np.where(has_upper, upper, 0.0)
    open_ended = np.where(has_lower, low + draw, np.where(has_upper, high - draw, sign * draw))
    return np.where(has_lower & has_upper, low + draw / 3.0 * (high - low), open_ended)


def _centres(model: Model, ranges: Ranges) -> tuple[FloatArray, FloatArray]:
    """Middle and half width ``(n_x + n_u,)`` of the range of each state and input."""
    found = {name: (0.5 * (low + high), 0.5 * (high - low)) for name, low, high in ranges}
    pairs = [found.get(name, (0.0, 0.0)) for name in (*model.state, *model.inputs)]
    middle, half = np.array(pairs).reshape(-1, 2).T
    return middle, np.where(half > 0.0, half, _HALF_RANGE)


def _random_jacobian(model: Model, p: FloatArray, rng: np.random.Generator, ranges: Ranges) -> FloatArray:
    """Rows ``(n, n_p)`` of ``dr/dp`` and ``dy/dp`` at random motions that satisfy the equations, each of unit size."""
    n = max(_N_MOTIONS, _PER_PARAMETER * model.n_p)
    middle, half = (x[:, None] for x in _centres(model, ranges))
    sizes = (model.n_q, model.n_v, model.n_u)
    drawn = middle + half * np.concatenate([_random_numbers((size, n), rng) for size in sizes])
    q, v, u = np.split(drawn, np.cumsum(sizes)[:2])
    for four in model.quaternions:
        q[list(four)] /= np.linalg.norm(q[list(four)], axis=0)
    repeated = np.repeat(p[:, None], n, axis=1)
    a = np.array(model.dynamics(np.vstack([q, v]), u, repeated)[1])
    slope = residual_slopes(model)
    J = np.array(ca.densify(slope(q, v, a, u, repeated))).reshape(-1, model.n_p)
    size = np.abs(J).max(axis=1)
    usable = np.isfinite(size) & (size > 0.0) & (size < 1e100)
    return np.asarray(J[usable] / size[usable, None])


@lru_cache(maxsize=64)
def residual_slopes(model: Model) -> ca.Function:
    """Function ``(q, v, a, u, p) -> d(r, y)/dp`` of the equations and the sensors.

    Parameters
    ----------
    model : Model
    """
    symbols = [ca.SX.sym(name, model.residual.size1_in(i)) for i, name in enumerate("qvaup")]
    outputs = model.residual(*symbols)
    if model.measurement is not None:
        outputs = ca.vertcat(outputs, model.measurement(*symbols))
    return ca.Function("slope", symbols, [ca.jacobian(outputs, symbols[4])])


def _output_jacobian(
    model: Model, p: FloatArray, rng: np.random.Generator, measured: Sequence[str], ranges: Ranges
) -> FloatArray:
    """Derivatives ``(n, n_p)`` of measured signals in random motions, without what initial states can explain.

    Motions are sequences of Euler's steps, which have the symmetries of the equations.
    """
    n_x, n_q, sensor_slopes = len(model.state), model.n_q, _sensor_slopes(model)
    middle, half = _centres(model, ranges)
    half = half / (1.0 if ranges else _HALF_RANGE)
    rows, blocks = [model.signals.index(n) for n in measured], []
    for _ in range(_N_TRAJECTORIES):
        x, step = middle[:n_x] + half[:n_x] * rng.normal(size=n_x), 0.0
        of_x, of_p, seen_x, seen_p = np.eye(n_x), np.zeros((n_x, model.n_p)), list[FloatArray](), list[FloatArray]()
        for _ in range(_STEPS_PER_UNKNOWN * (n_x + model.n_p)):
            for four in model.quaternions:
                x[list(four)] /= np.linalg.norm(x[list(four)])
            u = middle[n_x:] + half[n_x:] * rng.normal(size=model.n_u)
            A, _, P = (np.array(ca.DM(J)) for J in model.rate_jacobians(x, u, p))
            step = step or _STEP / max(1.0, float(np.linalg.norm(A)))
            moved_x, moved_p = A @ of_x, A @ of_p + P
            x_dot, a = (np.array(value).ravel() for value in model.dynamics(x, u, p))
            C, D, S = (np.array(ca.DM(J)) for J in sensor_slopes(x, a, u, p))
            seen_x.append(np.vstack([of_x, moved_x[n_q:], C @ of_x + D @ moved_x[n_q:]])[rows])
            seen_p.append(np.vstack([of_p, moved_p[n_q:], C @ of_p + D @ moved_p[n_q:] + S])[rows])
            x = x + step * x_dot
            of_x, of_p = of_x + step * moved_x, of_p + step * moved_p
        J_x, J_p = np.concatenate(seen_x), np.concatenate(seen_p)
        if np.isfinite(J_x).all() and np.isfinite(J_p).all():
            U, sizes, _ = np.linalg.svd(J_x, full_matrices=False)
            U = U[:, sizes > _RANK_OF_OUTPUTS * sizes[0]]
            blocks.append(J_p - U @ (U.T @ J_p))
    return np.concatenate(blocks) if blocks else np.zeros((0, model.n_p))


def _sensor_slopes(model: Model) -> ca.Function:
    """Function ``(x, a, u, p) -> dy/d(x, a, p)`` of the sensors, three matrices."""
    sizes = {"x": len(model.state), "a": model.n_v, "u": model.n_u, "p": model.n_p}
    x, a, u, p = (ca.SX.sym(name, n) for name, n in sizes.items())
    y = model.readings(x, a, u, p)
    return ca.Function("sensor_slopes", [x, a, u, p], [ca.jacobian(y, z) for z in (x, a, p)])


def _random_numbers(shape: tuple[int, int], rng: np.random.Generator) -> FloatArray:
    """Numbers of both signs, up to 1 and of several magnitudes: a saturation is neither always on nor never."""
    return np.asarray(rng.choice([-1.0, 1.0], shape) * 10.0 ** rng.uniform(-_DECADES, 0.0, shape))


@dataclass(frozen=True)
class NullSpace:
    """Directions in which parameters can change without an effect on rows ``W p``.

    Parameters
    ----------
    directions : (d, n) array
        Orthonormal, in parameters times ``scale``.
    scale : (n,) array
        Size of each column of W, positive.
    """

    directions: FloatArray
    scale: FloatArray

    def of(self, group: IntArray) -> NullSpace:
        """The part of a group of parameters that are not connected with others."""
        _, sizes, rows = np.linalg.svd(self.directions[:, group])
        return NullSpace(rows[: int((sizes > _PART_OF_LOG).sum())], self.scale[group])

    def complement(self) -> FloatArray:
        """Coefficients ``(n - d, n)`` of the combinations that are determined."""
        rows = np.linalg.svd(self.directions)[2][len(self.directions) :]
        return np.asarray(rows * self.scale)

    def in_units_of(self, scale: FloatArray) -> FloatArray:
        """Projector ``(n, n)`` onto the directions in parameters times another scale."""
        rows = np.linalg.svd(self.directions / self.scale * scale, full_matrices=False)[2]
        return np.asarray(rows.T @ rows)


def _null_space(J: FloatArray, rank: float) -> NullSpace:
    """Null space of the rows of J, with columns of unit norm; singular values below ``rank`` are zero."""
    norms = np.linalg.norm(J, axis=0)
    scale = np.where(norms > 0.0, norms, 1.0)
    _, sizes, rows = np.linalg.svd(J / scale, full_matrices=False)
    return NullSpace(rows[sizes <= rank * sizes.max(initial=0.0)], scale)


def _joined(found: Sequence[Ambiguity]) -> tuple[Ambiguity, ...]:
    """Ambiguities, with all parameters that are in no combination as one."""
    alone = tuple(name for x in found if not x.n_determined for name in x.names)
    return (*((Ambiguity(alone, 0, ()),) if alone else ()), *(x for x in found if x.n_determined))


def _components(directions: FloatArray, part: float) -> list[IntArray]:
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


def _ambiguity(names: list[str], spaces: Sequence[NullSpace], vectors: Sequence[FloatArray]) -> Ambiguity:
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
    size = np.abs(rows).max(axis=0)
    size = np.where(size > 0.0, size, 1.0)
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


def null_space(gram: FloatArray, scale: FloatArray, threshold: float) -> NullSpace:
    """Null space of rows from the sum of ``W^T W``.

    Parameters
    ----------
    gram : (n, n) array
        The sum, with columns divided by ``scale``.
    scale : (n,) array
        Size of each column; 0 where it is zero.
    threshold : float
        Largest eigenvalue that is zero.

    Returns
    -------
    NullSpace

    Raises
    ------
    LinAlgError
        The sum is not finite, which says nothing of the motion.
    """
    if not np.isfinite(gram).all():
        raise np.linalg.LinAlgError("the information matrix is not finite")
    sizes, vectors = np.linalg.eigh(gram)
    return NullSpace(vectors[:, sizes <= threshold].T, np.where(scale > 0.0, scale, 1.0))


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
    for group in _components(space.directions, _PART_OF_LOG**2):
        own, part = [names[i] for i in group], space.of(group)
        n_determined = len(own) - len(part.directions)
        sums = tuple(_sum(own, c) for c in _echelon(part.complement())) if n_determined == 1 else ()
        found.append(Ambiguity(tuple(own), n_determined, sums))
    return _joined(found)


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
    return "; ".join(x.sentence(x.of_motion(), _of_logs(n_logs)) for x in ambiguous)


def _of_logs(n_logs: int) -> str:
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
    determined = vectors[:, sizes < _COLLINEAR].T
    determined = np.where(np.abs(determined) > _PART_OF_CORRELATION, determined, 0.0)
    found, left = [], np.flatnonzero(uncertain).tolist()
    for group in _components(determined, 0.0):
        own, rows = weak[group].tolist(), determined[determined[:, group].any(axis=1)][:, group]
        texts = tuple(
            _estimated([names[i] for i in own], row / errors[group], values[own], covariance[np.ix_(own, own)])
            for row in rows
        )
        found.append(Ambiguity(tuple(names[i] for i in own), len(rows), texts if len(rows) == 1 else ()))
        left = [i for i in left if i not in own]
    return _joined([*found, Ambiguity(tuple(names[i] for i in left), 0, ())])


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
    uncertain = np.isfinite(errors) & (_TWO_SIDED * errors > np.abs(values))
    errors = np.where(uncertain, errors, 0.0)
    found = collinear(names, values, correlations * errors[:, None] * errors, uncertain)
    return tuple(x for x in found if x.n_determined)


def unidentifiable(
    model: Model,
    layout: ParameterLayout,
    values: FloatArray,
    covariance: FloatArray,
    uncertain: BoolArray,
    measured: tuple[str, ...] | None = None,
    ranges: Ranges | None = None,
    excited: BoolArray | None = None,
) -> tuple[BoolArray, tuple[str, ...]]:
    """Parameters of an estimate that are not identifiable, by the equations or from the log.

    Parameters
    ----------
    model : Model
    layout : ParameterLayout
        Of the n parameters, per-log ones of every log included.
    values : (n,) array
        Estimates, each in its unit.
    covariance : (n, n) array
    uncertain : (n,) bool array
        Parameters whose error is too large for the estimate to be of use.
    measured : tuple of str, optional
        Signals that are measured; None: all.
    ranges : tuple of (str, float, float), optional
        As `structural`.
    excited : (n,) bool array, optional
        Parameters about which the motion informs at the estimate; None: it is not known of any.

    Returns
    -------
    mask : (n,) bool array
        The uncertain parameters, and those that the equations do not determine.
    sentences : tuple of str
        The names, the combinations that are determined, and what to do.
    """
    of_model = structural(model, measured, ranges)
    ambiguous = {name for x in of_model for name in x.names}
    by_equations = np.array([name.partition("[")[0] in ambiguous for name in layout.names])
    from_log = collinear(layout.names, values, covariance, uncertain & ~by_equations)
    sentences = [x.sentence(x.of_equations()) for x in of_model]
    sentences += [in_words([x], layout.n_logs) for x in from_log if x.n_determined]
    alone = [n for x in from_log if not x.n_determined for n in x.names]
    seen = dict(zip(layout.names, np.zeros(len(uncertain), bool) if excited is None else excited, strict=True))
    for is_seen in (False, True):
        names = tuple(n for n in alone if seen[n] == is_seen)
        if names:
            x = Ambiguity(names, 0, ())
            sentences.append(x.sentence(x.of_noise() if is_seen else x.of_motion(), _of_logs(layout.n_logs)))
    return uncertain | by_equations, tuple(sentences)


def _estimated(names: Sequence[str], coefficients: FloatArray, values: FloatArray, covariance: FloatArray) -> str:
    """``a + 2 b = 1.23 ± 0.01``: a combination with its estimate and standard error."""
    c = _normalized(coefficients)
    error = np.sqrt(np.maximum(c @ covariance @ c, 0.0))
    return f"{_sum(names, c)} = {c @ values:.4g} ± {error:.2g}"
