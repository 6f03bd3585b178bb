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

from diransac.arrays import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from diransac.identification.tracking.window import Linearization


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
    of_steps : (A, n, n) array
        Information of steps of all parameters at once.
    """

    ages: IntArray
    size: FloatArray
    information: FloatArray
    of_steps: FloatArray

    @property
    def ratio(self) -> FloatArray:
        """Sizes over their standard errors, (2, A, n)."""
        return self.size * np.sqrt(self.information)

    def gain(self, values: FloatArray, scatter: FloatArray | float = 1.0) -> FloatArray:
        """Logarithms of the Bayes factors of changes as large as the parameters, as eq. (8) of `docs/method.md`.

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
        return _gain(self.size * information, information, np.square(values))

    def steps_at_once(self, values: FloatArray, scatter: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Steps of several parameters at the same time: one after the other is added as long as the evidence grows.

        Parameters
        ----------
        values : (n,) array
            Parameters.
        scatter : (A, n) array
            Variance of the ratios where nothing changes.

        Returns
        -------
        (A,) array
            Logarithm of the Bayes factor.
        (A, n) bool array
            Parameters that change.
        """
        ages, prior = np.arange(len(self.ages)), np.square(values)
        M, own, score = self.of_steps, self.information[0], self.size[0] * self.information[0]
        total, chosen = np.zeros(len(ages)), np.zeros(score.shape, bool)
        for k in range(len(values)):
            left = np.maximum(np.einsum("ajj->aj", M), 0.0)
            # Those before must leave some of the information of another parameter, which must add clear evidence.
            more = np.where(left > 1e-3 * own, _gain(score, left, prior) / scatter, -np.inf)
            j = np.argmax(more, axis=1)
            grows = more[ages, j] > (10.0 if k else 0.0)
            if not grows.any():
                break
            column = M[ages, :, j] * grows[:, None]
            pivot = left[ages, j] + 1.0 / np.maximum(prior[j], 1e-300)
            total += np.where(grows, more[ages, j], 0.0)
            chosen[ages[grows], j[grows]] = True
            score = score - column * (score[ages, j] / pivot)[:, None]
            M = M - column[:, :, None] * column[:, None, :] / pivot[:, None, None]
        return total, chosen

    def sizes(self, age: int, chosen: BoolArray) -> FloatArray:
        """Sizes ``(m,)`` of steps of some parameters ``(n,)`` at once, at the age of a place."""
        score = (self.size[0, age] * self.information[0, age])[chosen]
        return np.asarray(np.linalg.lstsq(self.of_steps[age][np.ix_(chosen, chosen)], score)[0])


def _gain(score: FloatArray, information: FloatArray, prior: FloatArray) -> FloatArray:
    """Logarithms of the Bayes factors of changes with a Gaussian prior of some variance."""
    known = prior * information
    return np.asarray(0.5 * prior * np.square(score) / (1.0 + known) - 0.5 * np.log1p(known))


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
    """Ages of changes that are compared in a window of n intervals: all from the second one on, and ever fewer before.

    Parameters
    ----------
    n : int

    Returns
    -------
    (A,) int array
    """
    powers = 1.2 ** np.arange(3, 1 + np.ceil(np.log(n) / np.log(1.2)))
    return np.unique(np.minimum(np.round([*powers, n]), n)).astype(np.int64)


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
    A, W, n_x, k = len(ages), len(fit.x), fit.x.shape[1], at.right_z.shape[1]
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
    of_steps = np.einsum("cw,wjl->cjl", np.square(c[:A]), at.corners) - np.einsum("icj,icl->cjl", of_s[:, :A], s[:, :A])
    of_steps -= np.einsum("wkcj,wkcl->cjl", of_z[:, :, :A], z[:, :, :A], optimize=True)
    score += np.einsum("wk,wkcj->cj", at.right_z, z) + np.einsum("i,icj->cj", at.right_s, s)
    # The other unknowns must leave some of the information of a change.
    information = np.where(information > 1e-9 * direct, information, 0.0)
    size = np.divide(-score, information, out=np.zeros_like(score), where=information > 0.0)
    shape = (2, A, n)
    known = (information[:A] > 0.0).astype(float)
    of_steps *= known[:, :, None] * known[:, None, :]
    return ChangeTests(ages, size.reshape(shape), information.reshape(shape), of_steps)


def _weights(ages: IntArray, W: int) -> FloatArray:
    """Change in each interval of a step and of a ramp that rises by one until the end of the window, (2, A, W)."""
    since = np.arange(W) - (W - ages[:, None]) + 0.5
    return np.stack([since > 0.0, np.maximum(since, 0.0) / ages[:, None]]).astype(float)
