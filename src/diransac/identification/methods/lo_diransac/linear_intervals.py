"""An interval's samples and end as linear functions of its state and of the parameters, and the update by its samples.

Where contacts chatter, slopes at a point hold in a tiny range alone.  Slopes over the spread of what is known hold
there; what they leave of the state's effect is a noise that all samples and the end share.

References
----------
Norgaard, Poulsen, Ravn 2000 (divided differences over the spread); Bierman 1977 (square-root information).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from diransac.arrays import FloatArray

TINY = 1e-12
_ROUNDING = 1e-12
RADIUS = 3.0**0.5
"""Distance of the points from the mean, standard deviations, by a Gaussian's kurtosis."""


@dataclass(frozen=True)
class Belief:
    """Covariance of a state, and the change of its mean with the parameters.

    Parameters
    ----------
    covariance : (n_x, n_x) array
    slopes : (n_x, n) array
    """

    covariance: FloatArray
    slopes: FloatArray

    @classmethod
    def begin(cls, unsure: FloatArray, n: int) -> Belief:
        """Of a state with standard deviations ``(n_x,)`` that does not depend on n parameters."""
        return cls(np.diag(np.square(unsure)), np.zeros((len(unsure), n)))

    @cached_property
    def root(self) -> FloatArray:
        """Lower Cholesky factor ``(n_x, n_x)`` of the covariance."""
        own = np.diag(self.covariance)
        return np.asarray(np.linalg.cholesky(self.covariance + np.diag(_ROUNDING * own + TINY**2)), float)

    def points(self, root: FloatArray) -> FloatArray:
        """Differences ``(1 + 2 (n_x + n), n_x + n)`` of state and parameters: none, those of one sign, of the other.

        Parameters
        ----------
        root : (n, n) array
            Of the covariance of the parameters.
        """
        whole = np.block([[self.root, self.slopes @ root], [np.zeros((len(root), len(self.root))), root]])
        return RADIUS * np.vstack([np.zeros(len(whole)), whole.T, -whole.T])


@dataclass(frozen=True)
class LinearInterval:
    """Errors of an interval's samples and its end, linear in the state at its start and in the parameters.

    Parameters
    ----------
    errors : (n_rows, n_s) array
        Simulated less measured.
    of_state, of_parameters, left : (n_rows, n_s, n_x), (n_rows, n_s, n) and (n_rows, n_s, n_x or 0) arrays
        Changes with the state, per unit of its root, and with the parameters, with which the state's mean moves; what
        slopes leave, per standard deviation of noises that are independent.
    end : (n_x,) array
        State after the last row.
    end_of_state, end_of_parameters, end_left : (n_x, n_x), (n_x, n) and (n_x, n_x or 0) arrays
    end_of_velocities : (n_x, n_v) array
        Change of the end with the velocities at the start, per unit of these.
    """

    errors: FloatArray
    of_state: FloatArray
    of_parameters: FloatArray
    left: FloatArray
    end: FloatArray
    end_of_state: FloatArray
    end_of_parameters: FloatArray
    end_left: FloatArray
    end_of_velocities: FloatArray

    @classmethod
    def local(
        cls, belief: Belief, n_q: int, samples: tuple[FloatArray, FloatArray], ends: tuple[FloatArray, FloatArray]
    ) -> LinearInterval:
        """By slopes at the state.

        Parameters
        ----------
        belief : Belief
        n_q : int
        samples : ((n_rows, n_s) array, (n_rows, n_s, n_x + n) array)
            Errors and their derivatives.
        ends : ((n_x,) array, (n_x, n_x + n) array)
        """
        (errors, J), (end, F), n_x = samples, ends, len(belief.slopes)
        of_x, end_of_x, none = J[..., :n_x], F[:, :n_x], np.zeros((*errors.shape, 0))
        of_samples = of_x @ belief.root, J[..., n_x:] + of_x @ belief.slopes, none
        of_end = end_of_x @ belief.root, F[:, n_x:] + end_of_x @ belief.slopes, none[0, :0].reshape(n_x, 0)
        return cls(errors, *of_samples, end, *of_end, end_of_x[:, n_q:])

    @classmethod
    def over_spread(
        cls, belief: Belief, n_q: int, root: FloatArray, errors: FloatArray, ends: FloatArray
    ) -> LinearInterval:
        """By divided differences over the spread of the state and of the parameters.

        Parameters
        ----------
        belief : Belief
        n_q : int
        root : (n, n) array
            Of the covariance of the parameters.
        errors : (1 + 2 (n_x + n), n_rows, n_s) array
            At `Belief.points`.
        ends : (1 + 2 (n_x + n), n_x) array
        """
        n_x, per_unit = len(belief.slopes), np.linalg.inv(root)
        mean, slopes, left = _differences(errors, n_x)
        end, end_slopes, end_left = _differences(ends, n_x)
        of_samples = slopes[..., :n_x], slopes[..., n_x:] @ per_unit, left
        of_end = end_slopes[:, :n_x], end_slopes[:, n_x:] @ per_unit, end_left
        of_velocities = (end_slopes[:, :n_x] @ np.linalg.pinv(belief.root))[:, n_q:]
        return cls(mean, *of_samples, end, *of_end, of_velocities)

    @property
    def is_local(self) -> bool:
        """True if slopes are those at the state, and leave nothing."""
        return not self.left.size

    @property
    def variance(self) -> FloatArray:
        """Variance ``(n_rows, n_s)`` of the predicted samples, but for their own noise."""
        return np.asarray(np.square(self.of_state).sum(axis=-1) + np.square(self.left).sum(axis=-1))


def _differences(values: FloatArray, n_x: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean, slopes in a last axis, and what these leave of the first n_x, of values at `Belief.points`."""
    n = (len(values) - 1) // 2
    above, below = values[1 : n + 1], values[n + 1 :]
    bends = np.moveaxis((above + below - 2.0 * values[0])[:n_x], 0, -1)
    slopes = np.moveaxis((above - below) / (2.0 * RADIUS), 0, -1)
    mean = values[0] + bends.sum(axis=-1) / (2.0 * RADIUS**2)
    return mean, slopes, np.sqrt(RADIUS**2 - 1.0) / (2.0 * RADIUS**2) * bends


@dataclass(frozen=True)
class Update:
    """Effect of the samples of an interval.

    Parameters
    ----------
    moved : (n_x,) array
        Change of the state at its start.
    belief : Belief
        After it.
    prior : float
        Twice the cost of the change by what was known before.
    information, score : (n, n) and (n,) array
        Contributions to those of the parameters.
    misfit : float
        Sum of the squares of the whitened errors before it; in the mean, the number of samples.
    residuals : (n_rows, n_s) array
        Errors after it.
    end : (n_x,) array
        State after the last row.
    belief_of_end : Belief
    """

    moved: FloatArray
    belief: Belief
    prior: float
    information: FloatArray
    score: FloatArray
    misfit: float
    residuals: FloatArray
    end: FloatArray
    belief_of_end: Belief

    @classmethod
    def of(cls, belief: Belief, linear: LinearInterval, weights: FloatArray) -> Update:
        """Update by an interval's samples with weights ``(n_rows, n_s)``."""
        e, scale = linear.errors.ravel(), np.sqrt(weights.ravel())[:, None]
        of_unknown = np.concatenate([linear.of_state, linear.left], axis=-1).reshape(len(e), -1)
        of_p = linear.of_parameters.reshape(len(e), -1)
        n, n_x = of_unknown.shape[1], len(belief.slopes)
        # Rows of samples, and of what is known beforehand, in units of its root.
        above = np.hstack([scale * of_unknown, scale * of_p, -scale * e[:, None]])
        R: FloatArray = np.asarray(np.linalg.qr(np.vstack([above, np.eye(n, above.shape[1])]), mode="r"))
        of_state, left = R[:n], R[n:, n:]
        solved = np.linalg.solve(of_state[:, :n], np.column_stack([of_state[:, n:], np.eye(n)]))
        slopes, moved, inverse = np.split(solved, [of_p.shape[1], of_p.shape[1] + 1], axis=1)
        half, end_of_unknown = belief.root @ inverse[:n_x], np.hstack([linear.end_of_state, linear.end_left])
        end_half = end_of_unknown @ inverse
        return cls(
            belief.root @ moved[:n_x, 0],
            Belief(half @ half.T, belief.slopes - belief.root @ slopes[:n_x]),
            float(np.square(moved).sum()),
            left[:, :-1].T @ left[:, :-1],
            left[:, :-1].T @ left[:, -1],
            float(np.square(left[:, -1]).sum()),
            linear.errors + (of_unknown @ moved[:, 0]).reshape(linear.errors.shape),
            linear.end + end_of_unknown @ moved[:, 0],
            Belief(end_half @ end_half.T, linear.end_of_parameters - end_of_unknown @ slopes),
        )

    def share(self, n_samples: float) -> float:
        """Weight of the interval for the parameters.

        Where a contact is not as slopes tell, all samples are wrong together.  Were the weight to fall faster, an
        interval that contradicts wrong parameters would count for nothing.

        Parameters
        ----------
        n_samples : float
            Number of samples that are no outliers.

        References
        ----------
        Huber 1964.
        """
        return float(min(1.0, np.sqrt(n_samples / max(self.misfit, TINY))))
