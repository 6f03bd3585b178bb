"""Scales of the unmodelled accelerations and of continuity, from sums over intervals.

The size of the unmodelled accelerations is that of the largest evidence, given sums over the innovations of their
Gauss-Markov process; sums of disjoint intervals add, so that those of intervals that are no longer fitted count, too.

References
----------
MacKay 1992 (evidence updates).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.core.arrowhead import Factored
from diransac.identification.core.fit import Fit, innovation_std, innovations
from diransac.identification.core.windows import Windows

SHRINK = 0.4
"""Largest change of any scale in a step."""
CONTINUITY = 0.03
"""Jumps over the effect of tau in an interval: as small a part of it is exact for practical purposes."""
_UNBROKEN = 0.01
"""Jumps over the standard errors of the states, all jumps together.  Tighter continuity would make the information of a
log smaller than the rounding errors, and the ridge, of the normal equations."""
_CHANCE = 2.0
"""Standard errors by which accelerations must exceed what noise hides."""
_MOST_ALIKE = 0.98
"""Largest correlation of unmodelled accelerations from window to window."""


@dataclass(frozen=True, eq=False, repr=False)
class ProcessSums:
    """Sufficient statistics of the unmodelled accelerations, of all or of each of W intervals.

    Parameters
    ----------
    squares : (n_v,) or (W, n_v) array
        Squares of the innovations, in the unit of tau.
    determined : (n_v,) or (W, n_v) array
        Number of innovations that the measurements determine.
    product, size : (n_v,) or (W, n_v) array
        Products and mean squares of the accelerations of an interval and the one before.
    count : (n_v,) or (W, n_v) array
        Number of innovations.
    weight, surplus : (n_v,) or (W, n_v) array
        Inverse squares of the variances of the innovations that the measurements of an interval alone give, and with
        these weights, squares of these innovations beyond what noise gives them.
    """

    squares: FloatArray
    determined: FloatArray
    product: FloatArray
    size: FloatArray
    count: FloatArray
    weight: FloatArray
    surplus: FloatArray
    cross: FloatArray

    @classmethod
    def none(cls, n_v: int) -> ProcessSums:
        """Sums over no interval."""
        return cls(*np.zeros((8, n_v)))

    def total(self) -> ProcessSums:
        """Sums over the intervals."""
        return ProcessSums(*(x.sum(axis=0) for x in self._all))

    def part(self, intervals: slice) -> ProcessSums:
        """Sums of some intervals."""
        return ProcessSums(*(x[intervals] for x in self._all))

    def plus(self, other: ProcessSums, weight: float = 1.0) -> ProcessSums:
        """These sums and others, with a weight of the latter."""
        return ProcessSums(*(x + weight * y for x, y in zip(self._all, other._all, strict=True)))

    @property
    def _all(self) -> tuple[FloatArray, ...]:
        return self.squares, self.determined, self.product, self.size, self.count, self.weight, self.surplus, self.cross

    def most_probable_size(self, expected: FloatArray, now: FloatArray) -> FloatArray:
        """Size ``(n_v,)`` of the innovations; see `most_probable_size`."""
        return most_probable_size(self.squares, self.determined.clip(0.0), expected, now)

    def likeliest_size(self, now: FloatArray) -> FloatArray:
        """Size ``(n_v,)`` of the innovations without a prior, 0 as long as noise may be all of it.

        The measurements of an interval alone give its innovation with a variance v.  The size is that of all of these
        innovations beyond their variances, each weighted by the inverse square of ``v + tau^2``; of what noise hides,
        it must exceed two standard errors.

        Parameters
        ----------
        now : (n_v,) array
            Present size, from which it changes by no more than a scale does in a step.
        """
        weight = np.maximum(self.weight, np.finfo(float).tiny)
        hidden = 1.0 - np.square(now) * np.sqrt(weight / np.maximum(self.count, 1.0))
        alike = np.minimum(self.cross, _MOST_ALIKE * weight) / weight
        chance = np.sqrt(2.0 / weight * (1.0 + alike) / (1.0 - alike))
        size = self.surplus / weight - _CHANCE * hidden.clip(0.0) * chance
        return np.asarray(np.clip(np.sqrt(size.clip(0.0)), SHRINK * now, now / SHRINK))

    def correlation(self, expected: FloatArray) -> FloatArray:
        """Correlation ``(n_v,)`` from interval to interval; accelerations of an expected size have none beforehand."""
        return np.asarray((self.product / (self.size + np.square(expected))).clip(0.0, _MOST_ALIKE))


def process_sums(intervals: Windows, fit: Fit, solved: Factored) -> ProcessSums:
    """Sums of each interval.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
    solved : Factored
        Of the normal equations at the fit, or one step before.

    Returns
    -------
    ProcessSums
        Arrays ``(W, n_v)``.
    """
    n_x, linked, std = fit.x.shape[1], intervals.linked[:, None], innovation_std(intervals, fit)
    variance, common = solved.var_z[:, n_x:], solved.var_below[:, n_x:]
    spread = variance.copy()
    spread[1:] += np.where(linked, fit.rho * (fit.rho * variance[:-1] - 2.0 * common), 0.0)
    determined = np.where(np.isfinite(std), 1.0 - spread / np.square(std), 0.0)
    second = np.square(fit.d) + variance
    product, size = np.zeros_like(second), np.zeros_like(second)
    product[1:] = np.where(linked, fit.d[1:] * fit.d[:-1] + common, 0.0)
    size[1:] = np.where(linked, 0.5 * (second[1:] + second[:-1]), 0.0)
    tau2, squares, share = np.square(fit.tau), np.square(innovations(intervals, fit)), determined.clip(0.0)
    cross = np.zeros_like(second)
    cross[1:] = np.where(linked, np.square(common / np.square(tau2)), 0.0)
    return ProcessSums(
        squares=tau2 * squares,
        determined=determined,
        product=product,
        size=size,
        count=np.isfinite(std).astype(float),
        weight=np.square(share / tau2),
        surplus=(squares - share + np.square(share)) / tau2,
        cross=cross,
    )


def most_probable_size(
    squares: FloatArray, determined: FloatArray, expected: float | FloatArray, now: FloatArray
) -> FloatArray:
    """Size of discrepancies, with a prior that has the weight of one of them.

    Parameters
    ----------
    squares : (n,) array
        Sums of their squares.
    determined : (n,) array
        Number of them that the measurements determine.
    expected : float or (n,) array
        Prior size.
    now : (n,) array
        Present size, from which it changes by no more than a scale does in a step.

    Returns
    -------
    (n,) array
    """
    size = np.sqrt((squares + np.square(expected)) / (determined + 1.0))
    return np.asarray(np.clip(size, SHRINK * now, now / SHRINK))


def negligible_jumps(intervals: Windows, tau: FloatArray) -> FloatArray:
    """Jumps ``(n_x,)`` that are negligible beside the effect of unmodelled accelerations on the state.

    Parameters
    ----------
    intervals : Windows
    tau : (n_v,) array
        Size of the unmodelled accelerations.

    Returns
    -------
    (n_x,) array
    """
    return CONTINUITY * effect_on_state(intervals, tau)


def effect_on_state(intervals: Windows, acceleration: FloatArray) -> FloatArray:
    """Size of the change ``(n_x,)`` of the state by accelerations ``(n_v,)`` over an interval.

    Parameters
    ----------
    intervals : Windows
    acceleration : (n_v,) array

    Returns
    -------
    (n_x,) array
    """
    velocity = acceleration * intervals.duration
    n_q, derived = intervals.model.n_q, intervals.model.kinematics is None
    coordinate = (velocity[:n_q] if derived else np.full(n_q, velocity.max())) * intervals.duration
    return np.concatenate([coordinate, velocity])


def unbroken_jumps(fit: Fit, solved: Factored) -> FloatArray:
    """Jumps ``(n_x,)`` that are negligible beside the uncertainty of the states, over all intervals together.

    Parameters
    ----------
    fit : Fit
    solved : Factored

    Returns
    -------
    (n_x,) array
    """
    variance = solved.var_z[:, : fit.x.shape[1]]
    return np.asarray(_UNBROKEN * np.sqrt(np.median(variance, axis=0).clip(0.0) / len(fit.x)))
