"""Integration steps per sample: as few as leave every estimate where it is.

Errors delta of a fit's residuals and of the ends of its intervals change a linear function of its unknowns by at most
|delta| of its standard errors, with delta in units of the noise and of continuity (Cauchy and Schwarz).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.identification.methods.lo_diransac.normal_equations import weights_of

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.normal_equations import Fit
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals

# Change of a parameter, standard errors, that adds half a per cent to its uncertainty.
_NEGLIGIBLE = 0.1
# Numbers of steps that are tried; one would need machine code of its own.
_FEW = (2, 3)


def with_fewest_steps(intervals: ShootingIntervals, fit: Fit, most: int) -> ShootingIntervals:
    """The intervals with the fewest integration steps per sample by which no parameter changes noticeably.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
    most : int
        Steps with which others are compared.

    Returns
    -------
    ShootingIntervals
    """
    weights = weights_of(intervals, fit)

    def simulated(n: int) -> tuple[ShootingIntervals, np.ndarray, np.ndarray]:
        other = replace(intervals, substeps=n)
        return other, *other.simulated(fit.shared, fit.x, fit.d)

    finest, residuals, ends = simulated(most)
    for n in _FEW:
        if n >= most:
            break
        other, changed, ended = simulated(n)
        of_jumps = ((ended - ends)[:-1] / fit.continuity_std)[intervals.linked]
        error = np.einsum("ns,ns->", weights, np.square(changed - residuals)) + np.square(of_jumps).sum()
        if error <= _NEGLIGIBLE**2:
            return other
    return finest
