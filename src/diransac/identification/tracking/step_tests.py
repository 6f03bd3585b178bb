"""Score tests of parameters that change within a window: of a step, and of a ramp, that begins with an interval.

A change of a parameter by ``theta c_w`` in interval w, with c = 0 before the change, is one more unknown of the joint
fit.  Its estimate and its variance, given that everything else is estimated anew, follow from one solution of the
normal equations for the derivatives of their right-hand side.  Unmodelled accelerations and what was known before the
window are part of these equations, so that what they explain is no change.

References
----------
Rao 1948 (score test); Willsky and Jones 1976 (generalised likelihood ratio of jumps in linear systems).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray, IntArray

if TYPE_CHECKING:
    from diransac.identification.tracking.window import Linearization

__all__ = ["ChangeTests", "ages_of", "change_tests", "fine_ages_of"]

# Part of the information of a change that the other unknowns must leave, for it to be determined.
_DETERMINED = 1e-9
# Ratio of neighbouring ages of changes that are compared.
_FINELY = 1.2
# Change of a parameter that is expected of a machine, over the parameter.
_USUAL_CHANGE = 1.0


@dataclass(frozen=True)
class ChangeTests:
    """Estimates of changes one by one, for A ages in intervals of n parameters.

    Parameters
    ----------
    ages : (A,) int array
        Intervals since the change.
    size : (2, A, n) array
        Estimated step, and estimated rise of a ramp, of each parameter.
    information : (2, A, n) array
        Inverse variance; 0 where the window does not determine a change.
    shift : (2, A, n, n) array
        Change of all parameters before it, per unit of its size.
    """

    ages: IntArray
    size: FloatArray
    information: FloatArray
    shift: FloatArray

    @property
    def ratio(self) -> FloatArray:
        """Sizes over their standard errors, (2, A, n)."""
        return self.size * np.sqrt(self.information)

    def gain(self, values: FloatArray, scatter: FloatArray | float = 1.0) -> FloatArray:
        """Logarithms of the Bayes factors of the changes, as eq. (8) of `docs/method.md`.

        Parameters
        ----------
        values : (n,) array
            Parameters.
        scatter : (2, A, n) array or float, optional
            Variance of the ratios where nothing changes.

        Returns
        -------
        (2, A, n) array
        """
        information = self.information / scatter
        prior = np.square(_USUAL_CHANGE * values) * information
        ratio = np.square(self.size) * information
        return np.asarray(0.5 * ratio * prior / (1.0 + prior) - 0.5 * np.log1p(prior))


def ages_of(n: int) -> IntArray:
    """Ages of changes that are tested in a window of n intervals: powers of two, and the whole window.

    Parameters
    ----------
    n : int

    Returns
    -------
    (A,) int array
    """
    return np.array([*(2**i for i in range(1, n.bit_length()) if 2**i < n), n])


def fine_ages_of(n: int) -> IntArray:
    """Ages of changes that are compared in a window of n intervals: all of the last ones, and ever fewer before.

    Parameters
    ----------
    n : int

    Returns
    -------
    (A,) int array
    """
    return np.unique(np.minimum(np.round(1.2 ** np.arange(1, 1 + np.ceil(np.log(n) / np.log(1.2)))), n)).astype(
        np.int64
    )


def change_tests(found: Linearization, ages: IntArray) -> ChangeTests:
    """Tests of changes in every parameter at some ages.

    Parameters
    ----------
    found : Linearization
    ages : (A,) int array
        Intervals since the change.

    Returns
    -------
    ChangeTests
    """
    at, fit = found.at, found.fit
    W, n_x, k = len(fit.x), fit.x.shape[1], at.right_z.shape[1]
    weight = _weights(ages, W)
    own, onward = at.system.border.copy(), -at.precision[:, :, None] * at.slopes[:, :, k:]
    own[1:, :n_x] -= onward
    if fit.boundary is not None:
        own[0] -= fit.boundary.information[:k, k:]
    n, c = own.shape[2], weight.reshape(-1, W)
    of_z = np.einsum("cw,wkj->wkcj", c, own)
    of_z[1:, :n_x] += np.einsum("cw,wkj->wkcj", c[:, :-1], onward)
    of_s = np.einsum("cw,wij->icj", c, at.corners)
    direct = np.einsum("cw,wjj->cj", np.square(c), at.corners)
    score = -np.einsum("cw,wj->cj", c, at.rights)
    z, s = at.system.functional(of_z.reshape(W, k, -1), of_s.reshape(n, -1))
    z, s = z.reshape(of_z.shape), s.reshape(of_s.shape)
    information = direct - np.einsum("wkcj,wkcj->cj", of_z, z) - np.einsum("icj,icj->cj", of_s, s)
    score += np.einsum("wk,wkcj->cj", at.right_z, z) + np.einsum("i,icj->cj", at.right_s, s)
    information = np.where(information > _DETERMINED * direct, information, 0.0)
    size = np.divide(-score, information, out=np.zeros_like(score), where=information > 0.0)
    shape = (2, len(ages), n)
    shift = -np.moveaxis(s, 0, -1)
    return ChangeTests(ages, size.reshape(shape), information.reshape(shape), shift.reshape(*shape, n))


def _weights(ages: IntArray, W: int) -> FloatArray:
    """Change in each interval of a step and of a ramp that rises by one until the end of the window, (2, A, W)."""
    since = np.arange(W) - (W - ages[:, None]) + 0.5
    return np.stack([since > 0.0, np.maximum(since, 0.0) / ages[:, None]]).astype(float)
