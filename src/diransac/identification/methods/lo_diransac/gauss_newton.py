"""A step of a fit: Gauss-Newton on all unknowns, corrected for the curvature of the rollouts, or damped."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from diransac.identification.methods.lo_diransac.normal_equations import Fit, cost

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.arrowhead import Factored
    from diransac.identification.methods.lo_diransac.joint_equations import JointEquations
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals

_MAX_TRIALS = 8
_CORRECTED = 0.3
"""Largest part of the excess of cost that a correction for the curvature of the rollouts may leave."""
_FIRST_DAMPING = 1e-7
"""Damping of the first step that needs one."""
_LEAST_DAMPING = 1e-9
"""Damping below which there is none."""
_ROUNDING = 1e-9
"""Relative change of the cost that is none."""


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
    taken : Factored or None
        None of a damped one.
    damping : float
        Of the next step.
    """

    intervals: ShootingIntervals
    fit: Fit
    at: JointEquations
    taken: Factored | None
    damping: float

    @cached_property
    def solved(self) -> Factored:
        """Solution without damping, which is no information: scales and standard errors follow from it."""
        return self.taken or self.at.solve()

    @property
    def of_errors(self) -> float:
        """Largest change of an error of the recordings over its standard error."""
        sizes, std, _ = self.at.errors_of(self.solved)
        return float((np.abs(sizes) / std).max(initial=0.0))


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
            step = at.solve(right, damping)
            there, trial = at.moved(step)
            more = cost(there, trial, intervals.weights_in(there, weights)) - before
            if more <= _ROUNDING * before:
                least = damping if trials else damping / 10.0 if damping > _LEAST_DAMPING else 0.0
                return Step(there, trial, at, None if damping else step, least)
            if not more < _CORRECTED * excess:
                break
            right, excess = at.corrected(there, trial), more
            del step, trial  # the next ones take as much memory
        damping = max(10.0 * damping, _FIRST_DAMPING)
    return Step(intervals, fit, at, None, damping)
