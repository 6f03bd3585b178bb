"""Integration steps per sample: as few as leave every parameter of a fit, and the evidence, where they are.

Fewer steps change the residuals of a fit and the ends of its intervals.  The Gauss-Newton step that answers this change
has the changes of the parameters and of the cost, and leads to the optimum with fewer steps.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import row_blocks
from diransac.identification.core.equations import linearize
from diransac.identification.core.fit import weights_of, with_residuals
from diransac.identification.core.theta import bounded

if TYPE_CHECKING:
    from diransac.identification.core.arrowhead import Factored
    from diransac.identification.core.equations import NormalEquations
    from diransac.identification.core.fit import Fit
    from diransac.identification.core.windows import Windows

_NEGLIGIBLE = 0.1
"""Change of a parameter, standard errors, that adds half a per cent to its uncertainty."""
_NEGLIGIBLE_COST = 0.5
"""Change of the cost, nats."""
_FEW = (2, 3)
"""Numbers of steps that are tried; one would need machine code of its own."""


def with_fewest_steps(intervals: Windows, fit: Fit, most: int) -> tuple[Windows, Fit]:
    """The intervals with the fewest integration steps per sample by which no parameter of the fit changes noticeably.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
        At its optimum.
    most : int
        Steps with which others are compared.

    Returns
    -------
    Windows, Fit
        The fit is at its optimum with these steps; only simulated again with `most` of them.
    """
    finest = replace(intervals, substeps=most)
    accurate = fit if intervals.substeps == most else with_residuals(finest, fit)
    at = linearize(intervals, fit, weights_of(intervals, fit))
    for n in (x for x in _FEW if x < most):
        other = replace(intervals, substeps=n)
        step, cost = answer(intervals, at, accurate, other)
        change = np.abs(step.step_p) / np.sqrt(np.diag(step.var_p))
        if (change[: intervals.n_p] < _NEGLIGIBLE).all() and abs(cost) < _NEGLIGIBLE_COST:
            return other, _after_step(other, fit, step)
    return finest, accurate


def _after_step(intervals: Windows, fit: Fit, step: Factored) -> Fit:
    """The fit after a step within the bounds, simulated over some intervals."""
    shared, n_x = bounded(intervals, fit.shared, fit.shared + step.step_p), fit.x.shape[1]
    z = step.step_z - step.gain @ (shared - fit.shared - step.step_p)
    return with_residuals(intervals, replace(fit, shared=shared, x=fit.x + z[:, :n_x], d=fit.d + z[:, n_x:]))


def answer(intervals: Windows, at: NormalEquations, fit: Fit, other: Windows) -> tuple[Factored, float]:
    """Gauss-Newton step for other residuals and ends of a fit, and how the cost changes with both, nats.

    Parameters
    ----------
    intervals : Windows
    at : NormalEquations
    fit : Fit
        At its optimum.
    other : Windows
        Those that simulate the other residuals and ends.

    Returns
    -------
    Factored, float
    """
    own, ends = other.simulated(fit.shared, fit.x, fit.d)
    own -= fit.residuals
    jumps = np.where(intervals.linked[:, None], fit.ends[:-1] - ends[:-1], 0.0)
    sums = intervals.gauss_newton(fit.shared, fit.x, fit.d, at.weights, directions=[own], normal_matrix=False)
    z, s = at.by_residuals(intervals, sums.along[:, 0])
    by_jumps_z, by_jumps_s = at.by_jumps(intervals, jumps)
    right_z, right_s = -z - by_jumps_z, -s - by_jumps_s
    cost = sum((at.weights[k] * own[k] * (fit.residuals[k] + 0.5 * own[k])).sum() for k in row_blocks(len(own)))
    del own
    step = at.system.solve(right_z, right_s)
    cost += (at.precision * jumps * (at.jumps + 0.5 * jumps)).sum()
    cost -= 0.5 * ((right_z * step.step_z).sum() + right_s @ step.step_p)
    return step, float(cost)
