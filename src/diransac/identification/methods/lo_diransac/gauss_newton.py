"""A step of a fit: Gauss-Newton on all unknowns, corrected for the curvature of the rollouts, or damped."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.methods.lo_diransac.joint_equations import JointEquations, JointStep
from diransac.identification.methods.lo_diransac.normal_equations import Fit, cost, with_residuals

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.arrowhead import Factored
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals

_MAX_TRIALS = 8
# Part of what is left of the excess of its cost when a step is corrected for the curvature of the rollouts, at most.
_CORRECTED = 0.3
_FIRST_DAMPING, _LEAST_DAMPING = 1e-7, 1e-9


def linearized(intervals: ShootingIntervals, fit: Fit, weights: FloatArray | None = None) -> JointEquations:
    """Normal equations at a fit, with its own weights unless there are others; see `JointEquations.of`.

    Errors of noisy inputs stay as they are: a delay by a fraction of a sample, or a lag, would average their noise.
    """
    kinds = [x for x in intervals.all_errors.kinds if not (intervals.noisy and x.of_inputs)]
    return JointEquations.of(intervals, fit, kinds, weights)


@dataclass(frozen=True)
class Step:
    """Step of a fit.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
        After the step.
    at : JointEquations
        Before it.
    taken : JointStep or None
        None of a damped one.
    damping : float
        Of the next step.
    of_errors : float
        Largest change of an error of the recordings over its standard error.
    """

    intervals: ShootingIntervals
    fit: Fit
    at: JointEquations
    taken: JointStep | None
    damping: float
    of_errors: float

    @cached_property
    def solved(self) -> Factored:
        """Solution without damping, which is no information: scales and standard errors follow from it."""
        return (self.taken or self.at.step(self.at.right)).of_fit


def gauss_newton_step(at: JointEquations, damping: float) -> Step:
    """One Gauss-Newton step within the bounds, corrected or damped until the cost falls.

    Parameters
    ----------
    at : JointEquations
        Result of `linearized`.
    damping : float

    Returns
    -------
    Step
    """
    intervals, fit, weights = at.intervals, at.fit, at.of_fit.weights
    before = cost(intervals, fit, weights)
    for trials in range(_MAX_TRIALS):
        right, excess = at.right, np.inf
        while True:
            step = at.step(right, damping)
            there = at.moved(step)
            if there is None:
                break
            trial = after_step(there, fit, step.of_fit)
            more = cost(there, trial, intervals.weights_in(there, weights)) - before
            if more <= 1e-9 * before:
                least = damping if trials else damping / 10.0 if damping > _LEAST_DAMPING else 0.0
                of_errors = float((np.abs(step.sizes) / step.std).max(initial=0.0))
                return Step(there, trial, at, None if damping else step, least, of_errors)
            if not more < _CORRECTED * excess:
                break
            right, excess = at.corrected(there, trial, step), more
            del step, trial  # the next ones take as much memory
        damping = max(10.0 * damping, _FIRST_DAMPING)
    return Step(intervals, fit, at, None, damping, 0.0)


def after_step(intervals: ShootingIntervals, fit: Fit, step: Factored) -> Fit:
    """The fit after a step whose shared unknowns stay within their bounds.

    Parameters
    ----------
    intervals : ShootingIntervals
        Over which it is simulated then.
    fit : Fit
    step : Factored

    Returns
    -------
    Fit
    """
    shared, n_x = bounded(intervals, fit.shared, fit.shared + step.step_p), fit.x.shape[1]
    z = step.step_z - step.gain @ (shared - fit.shared - step.step_p)
    x, d = fit.x + z[:, :n_x], fit.d + z[:, n_x:]
    return with_residuals(intervals, replace(fit, shared=shared, x=x, d=d))


def bounded(intervals: ShootingIntervals, now: FloatArray, then: FloatArray) -> FloatArray:
    """Shared unknowns ``(n_s,)``, parameters within their bounds; a positive one at most halves or doubles."""
    then = then.copy()
    for j, bounds in enumerate(intervals.layout.bounds):
        then[j] = np.clip(then[j], bounds.lower, bounds.upper)
        if bounds.positive:
            then[j] = np.clip(then[j], 0.5 * now[j], 2.0 * now[j])
    return then
