"""Fits of a window whose parameters, or unmodelled accelerations, change within it.

The intervals before a step are fitted alone, and leave a Gaussian of the unknowns where it happens; those after it are
fitted given this Gaussian, in which the parameters that change are free.  The evidence of a window with a step is that
of both parts, by Laplace's method.  All fits start from a motion that follows the samples: no test of a change at a fit
that the change has distorted tells how large it is, or what else it may be.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.identification.methods.lo_diransac.boundary import BoundaryPrior
from diransac.identification.methods.lo_diransac.joint_equations import bounded, linearized
from diransac.identification.methods.lo_diransac.mixture import NoiseSums
from diransac.identification.methods.lo_diransac.normal_equations import with_residuals
from diransac.identification.methods.lo_diransac.refinement import diverges, negative_log_evidence
from diransac.identification.tracking.forces import Forces, likeliest, likeliest_forces, since, with_forces
from diransac.identification.tracking.step_tests import ages_of
from diransac.identification.tracking.surprise import followed, free_motion
from diransac.identification.tracking.window import AS_LIKELY, Linearization

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.normal_equations import Fit
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
    from diransac.identification.tracking.window import Window

# Standard deviation of a time within an interval, over its duration.
_WITHIN = 12.0**-0.5


@dataclass(frozen=True)
class SteppedFit:
    """Fit of a window whose parameters change where one of its intervals begins.

    Parameters
    ----------
    first : int
        The interval.
    changed : (m,) int array
        Parameters that change.
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
    fit: Fit
    before: FloatArray
    kept: BoundaryPrior
    evidence: float

    @property
    def sizes(self) -> FloatArray:
        """Sizes ``(m,)`` of the changes."""
        return np.asarray(self.fit.shared[self.changed] - self.before[self.changed, 0])


class _Before(NamedTuple):
    """Boundary, parameters with standard errors, and evidence in nats that the intervals before a step leave."""

    boundary: BoundaryPrior
    parameters: FloatArray
    evidence: float


class SteppedFits:
    """Explanations of a window.

    Parameters
    ----------
    window : Window
    start : Fit
        With the motion from which all fits start: that of the larger unmodelled accelerations.
    usual, larger : Forces
        Unmodelled accelerations from before the window, and the likeliest ones.

    Attributes
    ----------
    motion : Linearization
        At this motion.
    """

    def __init__(self, window: Window, start: Fit, usual: Forces, larger: Forces) -> None:
        self._window, self._start, self._usual, self.larger = window, start, usual, larger
        self.motion = _linearization(window.intervals(), self._with(larger))
        self._fits_before: dict[tuple[int, Forces], _Before] = {}

    @classmethod
    def of(cls, window: Window, usual: Forces, boundary: BoundaryPrior | None) -> Generator[None, None, SteppedFits]:
        """Explanations of a window as it is now.

        Parameters
        ----------
        window : Window
            That does not move on.
        usual : Forces
            Unmodelled accelerations from before the window.
        boundary : BoundaryPrior, optional
            What is known from before the window; by default what its fit takes for that.

        Returns
        -------
        generator
            Yields where it may be interrupted, and returns them.
        """
        intervals = window.intervals()
        fit = free_motion(window, intervals, len(window))
        yield
        known = NoiseSums.of(fit.residuals, intervals.known, fit.noise.inlying(fit.residuals, intervals.known))
        noise = fit.noise.of_sums(known.plus(window.memory.noise))
        start = _moved(replace(window.fit, noise=noise, boundary=boundary or window.fit.boundary), fit)
        calm = with_forces(_linearization(intervals, start), usual)
        larger = yield from likeliest_forces(calm, window.expected, window.largest, ages_of(len(window)))
        yield
        fit, _ = followed(intervals, replace(start, tau=larger.tau, rho=larger.rho))
        yield
        return cls(window, _moved(start, fit), usual, larger)

    def unchanged(self, forces: Forces) -> float:
        """Evidence, nats, of a window without a step, and with some unmodelled accelerations."""
        intervals = self.motion.intervals
        fit, solved = followed(intervals, self._with(forces))
        return -negative_log_evidence(intervals, fit, solved.log_det)

    def larger_since(self, age: int) -> Forces:
        """Likeliest unmodelled accelerations that may have become larger with a step, some intervals before the end."""
        last = Forces(self.larger.tau[-1], self.larger.rho)
        return likeliest(self.motion, [self.larger, *(since(self._usual, x, last) for x in (age, age + 1))])[0]

    def nearby(
        self, first: int, changed: IntArray, sizes: FloatArray, forces: Forces
    ) -> Generator[None, None, SteppedFit]:
        """Likeliest of the fits with a step at an interval, and before and after it as long as they become likelier.

        Parameters
        ----------
        first, changed, sizes, forces
            As of `stepped`.

        Returns
        -------
        generator
            Yields after each fit, and returns the likeliest.
        """
        best = self.stepped(first, changed, sizes, forces)
        yield
        for direction in (-1, 1):
            while 0 <= best.first + direction <= len(self._window) - 2:
                other = self.stepped(best.first + direction, changed, best.sizes, forces)
                yield
                if other.evidence <= best.evidence:
                    break
                best = other
        return best

    def simplest(self, step: SteppedFit, forces: Forces) -> Generator[None, None, SteppedFit]:
        """The likeliest fit without those parameters of a step that hardly make it likelier.

        Parameters
        ----------
        step : SteppedFit
        forces : Forces
            Of its fit.

        Returns
        -------
        generator
            Yields after each fit, and returns the simplest.
        """
        best = step
        for k in step.changed:
            few = best.changed != k
            if few.any():
                other = self.stepped(best.first, best.changed[few], best.sizes[few], forces)
                yield
                best = other if other.evidence > best.evidence - AS_LIKELY else best
        return best

    def stepped(self, first: int, changed: IntArray, sizes: FloatArray, forces: Forces) -> SteppedFit:
        """Fit with a step.

        Parameters
        ----------
        first : int
            Interval with which it begins.
        changed : (m,) int array
            Parameters that change.
        sizes : (m,) array
            Rough sizes of the changes.
        forces : Forces
            Unmodelled accelerations.

        Returns
        -------
        SteppedFit
        """
        intervals, spread = self._intervals(first), self._window.spread
        if (first, forces) not in self._fits_before:
            self._fits_before[first, forces] = self._fit_before(first, forces)
        beforehand, before, evidence = self._fits_before[first, forces]
        shared = before[:, 0].copy()
        shared[changed] += sizes
        shared = bounded(intervals, before[:, 0], shared)
        # The change is at any time within the interval before or after, whose motion is then that of neither.
        brief = _WITHIN * intervals.duration * spread, _WITHIN * (1.0 - forces.rho) * spread
        free = np.concatenate([np.zeros(intervals.model.n_q), *brief, np.zeros_like(shared)])
        kept = beforehand.diffused(np.diag(free)[:, free > 0.0])
        free[-len(shared) :][changed] = np.maximum(np.abs(before[changed, 0]), np.abs(sizes))
        boundary = beforehand.diffused(np.diag(free)[:, free > 0.0])
        fit = replace(self._part(slice(first, None), forces), shared=shared, boundary=boundary)
        fit = with_residuals(intervals, fit)
        if diverges(fit):
            return SteppedFit(first, changed, fit, before, kept, -np.inf)
        fit, solved = followed(intervals, fit)
        evidence -= negative_log_evidence(intervals, fit, solved.log_det)
        return SteppedFit(first, changed, fit, before, kept, evidence)

    def linearized(self, step: SteppedFit) -> Linearization:
        """The normal equations of the intervals from a step on."""
        return _linearization(self._intervals(step.first), step.fit)

    def _intervals(self, first: int) -> ShootingIntervals:
        """Intervals of the window from one on."""
        window = self._window
        return window.setup.intervals(window.stream, window.first + first * window.length, len(window) - first)

    def _fit_before(self, first: int, forces: Forces) -> _Before:
        """Fit of the intervals before one of the window."""
        window = self._window
        if not first:
            boundary = self._start.boundary
            assert boundary is not None
            mean, covariance = boundary.moments
            errors = np.sqrt(np.diag(covariance))
            return _Before(boundary, np.column_stack([mean, errors])[-len(self._start.shared) :], 0.0)
        intervals = window.setup.intervals(window.stream, window.first, first + 1)
        is_before = np.arange(len(intervals.measured)) < first * window.length
        intervals = replace(intervals, sampled=intervals.sampled & is_before[:, None])
        fit, solved = followed(intervals, with_residuals(intervals, self._part(slice(first + 1), forces)))
        moved = solved.gain[-1] @ solved.var_p
        of_motion = solved.alone[-1] + moved @ solved.gain[-1].T
        covariance = np.block([[of_motion, -moved], [-moved.T, solved.var_p]])
        boundary = BoundaryPrior.of_covariance(np.concatenate([fit.x[-1], fit.d[-1], fit.shared]), covariance)
        parameters = np.column_stack([fit.shared, np.sqrt(np.diag(solved.var_p))])
        return _Before(boundary, parameters, -negative_log_evidence(intervals, fit, solved.log_det))

    def _part(self, intervals: slice, forces: Forces) -> Fit:
        """Motion of some intervals, with some unmodelled accelerations."""
        whole = self._with(forces)
        return replace(whole, x=whole.x[intervals], d=whole.d[intervals], tau=forces.tau[intervals])

    def _with(self, forces: Forces) -> Fit:
        """Motion from which fits start, with some unmodelled accelerations."""
        return replace(self._start, tau=forces.tau, rho=forces.rho)


def _moved(fit: Fit, motion: Fit) -> Fit:
    """A fit with the motion of another."""
    return replace(fit, x=motion.x, d=motion.d, residuals=motion.residuals, ends=motion.ends)


def _linearization(intervals: ShootingIntervals, fit: Fit) -> Linearization:
    at = linearized(intervals, fit).of_fit
    return Linearization(intervals, fit, at, at.system.solve(at.right_z, at.right_s))
