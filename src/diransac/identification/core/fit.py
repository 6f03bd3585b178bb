"""A fit of windows: motion, shared unknowns, and the scale of every term of the cost.

References
----------
Bock 1987 (multiple shooting); Tremolet 2006 (weak-constraint 4D-Var).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.core.boundary import BoundaryPrior
from diransac.identification.core.noise import Mixture
from diransac.identification.core.windows import Windows

if TYPE_CHECKING:
    pass


@dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """A motion with its parameters, and the scales of every term of the cost.

    Parameters
    ----------
    shared : (n_s,) array
        Parameters and discrepancies.
    x : (W, n_x) array
        States at the intervals' starts.
    d : (W, n_v) array
        Unmodelled accelerations.
    residuals : (N, n_signals) array
        Simulated less measured signals.
    ends : (W, n_x) array
        States in which the intervals end.
    noise : Mixture
        Noise of each signal.
    tau : (n_v,) array
        Size of the unmodelled accelerations.
    rho : (n_v,) array
        Their correlation from interval to interval.
    continuity_std : (n_x,) array
        Size of the jumps from interval to interval.
    prior : (n_s,) array
        Size of the discrepancies; prior standard deviation of the parameters, infinite without one.
    prior_mean : (n_s,) array
        Prior means of the parameters; zero for the others.
    boundary : BoundaryPrior, optional
        What is known from before the first interval; None where nothing is.
    x_mean : (W, n_x) or (1, n_x) array
    x_std : (n_x,) array
        Gaussian prior of the states; infinite deviations without one.
    """

    shared: FloatArray
    x: FloatArray
    d: FloatArray
    residuals: FloatArray
    ends: FloatArray
    noise: Mixture
    tau: FloatArray
    rho: FloatArray
    continuity_std: FloatArray
    prior: FloatArray
    prior_mean: FloatArray
    boundary: BoundaryPrior | None = None
    x_mean: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))
    x_std: FloatArray = field(default_factory=lambda: np.full(1, np.inf))

    @property
    def at_boundary(self) -> FloatArray:
        """State and unmodelled accelerations at the start, and the shared unknowns, as one vector ``(n,)``."""
        return np.concatenate([self.x[0], self.d[0], self.shared])

    def jumps(self, intervals: Windows) -> FloatArray:
        """States at the intervals' starts less the ends of the intervals before, (W - 1, n_x); 0 where unlinked."""
        return np.where(intervals.linked[:, None], self.x[1:] - self.ends[:-1], 0.0)


def with_residuals(intervals: Windows, fit: Fit) -> Fit:
    """The fit with its residuals and ends over the given intervals.

    Parameters
    ----------
    intervals : Windows
    fit : Fit

    Returns
    -------
    Fit
    """
    residuals, ends = intervals.simulated(fit.shared, fit.x, fit.d)
    return replace(fit, residuals=residuals, ends=ends)


def split(intervals: Windows, fit: Fit, parts: int) -> tuple[Windows, Fit]:
    """The same motion in shorter intervals, whose unmodelled accelerations vary as much, and as slowly.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
    parts : int
        Of each interval.

    Returns
    -------
    Windows, Fit
    """
    # The sum of correlations over time, (1 + rho) / (1 - rho) intervals, stays.
    slow = parts * (1.0 + fit.rho)
    fit = replace(fit, rho=(slow - 1.0 + fit.rho) / (slow + 1.0 - fit.rho))
    if parts == 1:
        return intervals, fit
    finer, n_x = intervals.split(parts), fit.x.shape[1]
    series = intervals.rollouts.trajectories(intervals.batch(fit.shared, fit.x, fit.d))
    x = series[:, :: finer.length, :n_x].reshape(-1, n_x).copy()  # a view would keep all rows
    return finer, with_residuals(finer, replace(fit, x=x, d=np.repeat(fit.d, parts, axis=0)))


def innovation_std(intervals: Windows, fit: Fit) -> FloatArray:
    """Standard deviation ``(W, n_v)`` of the unmodelled accelerations, given those of the interval before.

    Parameters
    ----------
    intervals : Windows
    fit : Fit

    Returns
    -------
    (W, n_v) array
        Infinite of those whose prior is that of the boundary.
    """
    std = np.where(intervals.following[:, None], fit.tau * np.sqrt(1.0 - np.square(fit.rho)), fit.tau)
    if fit.boundary is not None:
        std[0] = np.inf
    return std


def innovations(intervals: Windows, fit: Fit) -> FloatArray:
    """Unmodelled accelerations less those expected from the interval before, over their standard deviation.

    Parameters
    ----------
    intervals : Windows
    fit : Fit

    Returns
    -------
    (W, n_v) array
    """
    found = fit.d.copy()
    found[1:] -= np.where(intervals.linked[:, None], fit.rho, 0.0) * found[:-1]
    return np.asarray(found / innovation_std(intervals, fit))


def weights_of(intervals: Windows, fit: Fit) -> FloatArray:
    """Weight of each measurement: the probability that it is not an outlier, over its variance.

    Parameters
    ----------
    intervals : Windows
    fit : Fit

    Returns
    -------
    (N, n_signals) array
    """
    found = fit.noise.inlying(fit.residuals, intervals.known)
    found /= np.square(fit.noise.sigma)
    return found


def innovation_terms(intervals: Windows, fit: Fit) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Terms of the innovations in the normal equations: diagonals of D and E, and right-hand side.

    Parameters
    ----------
    intervals : Windows
    fit : Fit

    Returns
    -------
    (W, n_v) array, (W - 1, n_v) array, (W, n_v) array
    """
    std, rho = innovation_std(intervals, fit), np.where(intervals.following[1:, None], fit.rho, 0.0)
    own, deviation = np.square(1.0 / std), innovations(intervals, fit) / std
    diagonal, right, below = own.copy(), -deviation, -rho * own[1:]
    diagonal[:-1] += np.square(rho) * own[1:]
    right[:-1] += rho * deviation[1:]
    return diagonal, below, right
