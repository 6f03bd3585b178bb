"""Steps of parameters within a window: their score tests, fits with a step, and the search for the best explanation.

A step of a parameter by ``theta`` where an interval begins is one more unknown of the joint fit.  Its estimate and its
information, given that everything else is estimated anew, follow from one solution of the normal equations.  Unmodelled
accelerations and what was known before the window are part of these equations, so that what they explain is no step.

In a fit with a step, the intervals before it are fitted alone, and leave a Gaussian of the unknowns where it happens;
those after it are fitted given this Gaussian, in which the parameters that change are free.  Its evidence is that of
both parts, by Laplace's method.  All fits start from a motion that follows the samples: no test of a change at a fit
that the change has distorted tells how large it is, or what else it may be.

A search takes as long as many updates and is spread over some, while the window moves on: it has a copy of the window.

References
----------
Rao 1948 (score test); Willsky and Jones 1976 (generalised likelihood ratio of jumps in linear systems).
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.identification.core.equations import linearized
from diransac.identification.core.fit import with_residuals
from diransac.identification.core.minimise import diverges
from diransac.identification.core.noise import NoiseSums
from diransac.identification.core.theta import bounded
from diransac.identification.tracking.fits import (
    Forces,
    followed,
    free_motion,
    left_by,
    likeliest_forces,
    part,
    with_forces,
)
from diransac.identification.tracking.window import AS_LIKELY

if TYPE_CHECKING:
    from diransac.identification.core.boundary import BoundaryPrior
    from diransac.identification.core.equations import JointEquations
    from diransac.identification.core.fit import Fit
    from diransac.identification.tracking.window import Window

# ---------------------------------------------------------------------- tests


@dataclass(frozen=True)
class StepTests:
    """Estimates of steps of n parameters, for A ages in intervals.

    Parameters
    ----------
    ages : (A,) int array
        Intervals since the step.
    score : (A, n) array
        Derivatives of the log-likelihood with respect to the steps.
    information : (A, n, n) array
        Of steps of all parameters at once; 0 where the window does not determine one.
    """

    ages: IntArray
    score: FloatArray
    information: FloatArray

    @property
    def precision(self) -> FloatArray:
        """Inverse variances ``(A, n)`` of steps one by one."""
        return np.asarray(np.einsum("ajj->aj", self.information))

    @property
    def sizes(self) -> FloatArray:
        """Estimated steps ``(A, n)`` one by one."""
        return np.divide(self.score, self.precision, out=np.zeros_like(self.score), where=self.precision > 0.0)

    def gain(self, values: FloatArray, scatter: FloatArray | float = 1.0) -> FloatArray:
        """Logarithms of the Bayes factors of steps as large as the parameters, as eq. (8) of `docs/method.md`.

        Parameters
        ----------
        values : (n,) array
            Parameters.
        scatter : (A, n) array or float, optional
            Variance of the ratios of sizes and standard errors where nothing changes.

        Returns
        -------
        (A, n) array
        """
        return _gain(self.score / scatter, self.precision / scatter, np.square(values))

    def likeliest(self, values: FloatArray, scatter: FloatArray) -> tuple[int, IntArray, FloatArray]:
        """Place of the age of the likeliest steps at once, their parameters ``(m,)`` and sizes ``(m,)``.

        Arguments as of `gain`.
        """
        trials = [self._together(place, np.square(values), scatter[place]) for place in range(len(self.ages))]
        place = int(np.argmax([gain for gain, _ in trials]))
        chosen = np.array(sorted(trials[place][1]), dtype=np.int64)
        information = self.information[place][np.ix_(chosen, chosen)]
        return place, chosen, np.linalg.lstsq(information, self.score[place, chosen])[0]

    def _together(self, place: int, prior: FloatArray, scatter: FloatArray) -> tuple[float, list[int]]:
        """Evidence, nats, and parameters of a step: one after the other is added as long as it grows."""
        M, score, precision = self.information[place].copy(), self.score[place].copy(), self.precision[place]
        total, chosen = 0.0, list[int]()
        while len(chosen) < len(precision):
            # Those before must leave some of the information of another parameter, which must add clear evidence.
            left = np.diag(M).clip(0.0)
            more = np.where(left > 1e-3 * precision, _gain(score, left, prior) / scatter, -np.inf)
            j = int(np.argmax(more))
            if more[j] <= 2.0 * AS_LIKELY * bool(chosen) or j in chosen:
                break
            column, total = M[:, j] / (left[j] + 1.0 / prior[j]), total + float(more[j])
            score, M = score - column * score[j], M - np.outer(column, M[j])
            chosen.append(j)
        return total, chosen


def _gain(score: FloatArray, information: FloatArray, prior: FloatArray) -> FloatArray:
    """Logarithms of the Bayes factors of changes with a Gaussian prior of some variance."""
    known = prior * information
    return np.asarray(0.5 * prior * np.square(score) / (1.0 + known) - 0.5 * np.log1p(known))


def ages_of(n: int) -> IntArray:
    """Ages ``(A,)`` of steps that are tested in a window of n intervals: powers of two, and the whole window."""
    return np.array([*(2**i for i in range(1, n.bit_length()) if 2**i < n), n])


def fine_ages_of(n: int) -> IntArray:
    """Ages ``(A,)`` of steps that are compared: all from the second one on, and ever fewer before."""
    powers = 1.2 ** np.arange(3, 1 + np.ceil(np.log(n) / np.log(1.2)))
    return np.unique(np.minimum(np.round([*powers, n]), n)).astype(np.int64)


def step_tests(equations: JointEquations, ages: IntArray) -> StepTests:
    """Tests of steps of every parameter at some ages ``(A,)``, in intervals.

    Parameters
    ----------
    equations : JointEquations
    ages : (A,) int array
    """
    at, fit = equations.of_fit, equations.fit
    (W, n_x), k, n = fit.x.shape, at.right_z.shape[1], len(fit.shared)
    since = (np.arange(W) >= W - ages[:, None]).astype(float)
    border, onward = at.system.border.copy(), -at.precision[:, :, None] * at.slopes[:, :, k:]
    border[1:, :n_x] -= onward
    if fit.boundary is not None:
        border[0] -= fit.boundary.information[:k, k:]
    of_z = np.einsum("aw,wkj->wkaj", since, border)
    of_z[1:, :n_x] += np.einsum("aw,wkj->wkaj", since[:, :-1], onward)
    direct = np.einsum("aw,wij->aij", since, at.corners)
    of_s = direct.swapaxes(0, 1)
    z, s = at.system.functional(of_z.reshape(W, k, -1), of_s.reshape(n, -1))
    z, s = z.reshape(of_z.shape), s.reshape(of_s.shape)
    information = direct - np.einsum("iaj,ial->ajl", of_s, s)
    information -= np.einsum("wkaj,wkal->ajl", of_z, z, optimize=True)
    score = np.einsum("aw,wj->aj", since, at.rights)
    score -= np.einsum("wk,wkaj->aj", at.right_z, z) + np.einsum("i,iaj->aj", at.right_s, s)
    # The other unknowns must leave some of the information of a step.
    known = np.einsum("ajj->aj", information) > 1e-9 * np.einsum("ajj->aj", direct)
    return StepTests(ages, score * known, information * (known[:, :, None] & known[:, None, :]))


# ---------------------------------------------------------------------- fits


@dataclass(frozen=True)
class SteppedFit:
    """Fit of a window whose parameters change where one of its intervals begins.

    Parameters
    ----------
    first : int
        The interval.
    changed : (m,) int array
        Parameters that change.
    forces : Forces
        Unmodelled accelerations of the window.
    fit : Fit
        Of the intervals from then on, whose boundary is what those before tell.
    before : (n_p, 2) array
        Each parameter before it, and its standard error.
    kept : BoundaryPrior
        Boundary of the fit if no parameter has changed.
    evidence : float
        nats
    """

    first: int
    changed: IntArray
    forces: Forces
    fit: Fit
    before: FloatArray
    kept: BoundaryPrior
    evidence: float

    @property
    def sizes(self) -> FloatArray:
        """Sizes ``(m,)`` of the changes."""
        return np.asarray(self.fit.shared[self.changed] - self.before[self.changed, 0])


def stepped(window: Window, start: Fit, first: int, changed: IntArray, sizes: FloatArray, forces: Forces) -> SteppedFit:
    """Fit of a window with a step.

    Parameters
    ----------
    window : Window
    start : Fit
        Follows the samples.
    first : int
        Interval with which the step begins.
    changed : (m,) int array
        Parameters that change.
    sizes : (m,) array
        Rough sizes of the changes.
    forces : Forces
        Unmodelled accelerations.
    """
    intervals, spread, start = window.intervals(first), window.spread, forces.acting(start)
    beforehand, evidence = _before(window, start, first)
    mean, covariance = beforehand.moments
    before = np.column_stack([mean, np.sqrt(np.diag(covariance))])[-len(start.shared) :]
    shared = before[:, 0].copy()
    shared[changed] += sizes
    shared = bounded(intervals, before[:, 0], shared)
    # The change is at any time within the interval before or after, whose motion is then that of neither.
    brief = 12.0**-0.5 * np.concatenate([intervals.duration * spread, (1.0 - forces.rho) * spread])
    free = np.concatenate([np.zeros(intervals.model.n_q), brief, np.zeros_like(shared)])
    kept = beforehand.diffused(np.diag(free)[:, free > 0.0])
    free[-len(shared) :][changed] = np.maximum(np.abs(before[changed, 0]), np.abs(sizes))
    boundary = beforehand.diffused(np.diag(free)[:, free > 0.0])
    fit = with_residuals(intervals, replace(part(start, first), shared=shared, boundary=boundary))
    fit, gained = (fit, -np.inf) if diverges(fit) else followed(intervals, fit)
    return SteppedFit(first, changed, forces, fit, before, kept, evidence + gained)


def _before(window: Window, start: Fit, first: int) -> tuple[BoundaryPrior, float]:
    """Boundary prior that the intervals before one leave, and their evidence, nats."""
    if not first:
        assert start.boundary is not None
        return start.boundary, 0.0
    intervals = window.intervals(0, first + 1)
    is_before = np.arange(len(intervals.measured)) < first * intervals.length
    intervals = replace(intervals, sampled=intervals.sampled & is_before[:, None])
    fit, evidence = followed(intervals, with_residuals(intervals, part(start, 0, first + 1)))
    return left_by(intervals, fit), evidence


# ---------------------------------------------------------------------- search


@dataclass(frozen=True)
class Explanation:
    """Likeliest step of a window, and its rivals.

    Parameters
    ----------
    step : SteppedFit
    known : (m,) array
        Inverse variances of its sizes.
    scatter : float
        Variance of the ratios of its tests where nothing changes.
    larger : Forces
        Unmodelled accelerations that may explain the window instead.
    without : Fit
        With those.
    over_usual, over_rivals : float
        Evidence, nats, by which the step is likelier than the usual unmodelled accelerations, and than any.
    """

    step: SteppedFit
    known: FloatArray
    scatter: float
    larger: Forces
    without: Fit
    over_usual: float
    over_rivals: float


def sought(
    window: Window, usual: Forces, kept: BoundaryPrior | None, ages: IntArray, scatter: FloatArray
) -> Generator[None, None, tuple[int, Explanation | None]]:
    """Search of a window.

    Parameters
    ----------
    window : Window
        That does not move on.
    usual : Forces
        Unmodelled accelerations from before the window.
    kept : BoundaryPrior, optional
        What was known before the window, where it begins with a change.
    ages : (A,) int array
        Intervals since the changes that are compared.
    scatter : (A, n_p) array
        Variance of the ratios of their tests where nothing changes.

    Returns
    -------
    generator
        Yields after each fit, and returns the age of the likeliest change with the explanation; None if no parameter
        has changed.
    """
    intervals, fit, n = window.intervals(), window.fit, len(window)
    free = free_motion(intervals, fit, window.largest)
    yield
    known = NoiseSums.of(free.residuals, intervals.known, fit.noise.inlying(free.residuals, intervals.known))
    noise, boundary = fit.noise.of_sums(known.plus(window.memory.noise)), kept or fit.boundary
    motion = {name: getattr(free, name) for name in ("x", "d", "residuals", "ends")}
    start = replace(fit, noise=noise, boundary=boundary, **motion)
    calm = with_forces(linearized(intervals, start), usual)
    larger = likeliest_forces(calm, window.expected, window.largest, ages_of(n))
    yield
    best = followed(intervals, larger.acting(start))[0]
    yield
    start = replace(best, shared=fit.shared)
    tests = step_tests(with_forces(linearized(intervals, start), usual), ages)
    place, chosen, sizes = tests.likeliest(fit.shared, scatter)
    age = int(ages[place])
    if not len(chosen):
        return age, None
    rivals = [usual, larger]
    if (usual.tau > window.expected).any():
        # A change may have been taken for forces until it is found: the model may be exact with it.
        rivals.append(Forces(np.broadcast_to(window.least, fit.d.shape), np.zeros_like(window.least)))
    steps, others = [], []
    for forces in rivals:
        steps.append(stepped(window, start, n - age, chosen, sizes, forces))
        yield
        others.append(followed(intervals, forces.acting(start)))
        yield
    step, without = max(steps, key=lambda x: x.evidence), max(evidence for _, evidence in others)
    for direction in (-1, 1):
        while 0 <= (first := step.first + direction) <= n - 2:
            other = stepped(window, start, first, chosen, step.sizes, step.forces)
            yield
            if other.evidence <= step.evidence:
                break
            step = other
    known_of, of_step = tests.precision[place, chosen], float(scatter[place, chosen].max())
    over = step.evidence - others[0][1], step.evidence - without
    return age, Explanation(step, known_of, of_step, larger, others[1][0], *over)
