"""Knowledge from before a window of a log: a Gaussian of its first unknowns and of the shared ones.

Intervals that have left a window are marginalised: the Schur complement of their block of the normal equations remains
as a prior of the state and the unmodelled accelerations at the start of the interval that follows, and of the shared
unknowns.  It is kept as a square root of its information, so that it stays positive semidefinite and may know nothing
of some directions, with the point of its linearisation: twice its cost at y = (x_0, d_0, s) is

    |R (y - y_0) - b|^2

References
----------
Sibley, Matthies, Sukhatme 2010 (sliding window filter); Bierman 1977 (square-root information, process noise).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from diransac.arrays import FloatArray

# Part of the largest eigenvalue, of information that is scaled to a diagonal of one, that rounding leaves of none.
_ROUNDING = 1e-14


@dataclass(frozen=True)
class BoundaryPrior:
    """Gaussian of the unknowns at the start of a window.

    Parameters
    ----------
    point : (n,) array
        y_0: state and unmodelled accelerations of the first interval, then the shared unknowns.
    root : (r, n) array
        R, a square root of the information.
    offset : (r,) array
        b.
    """

    point: FloatArray
    root: FloatArray
    offset: FloatArray

    @classmethod
    def of_information(cls, point: FloatArray, information: FloatArray, right: FloatArray) -> BoundaryPrior:
        """The Gaussian with an information matrix and minus the gradient of its cost at a point.

        Parameters
        ----------
        point : (n,) array
        information : (n, n) array
            Symmetric, positive semidefinite up to rounding.
        right : (n,) array
        """
        own = np.diag(information)
        scale = 1.0 / np.sqrt(np.where(own > 0.0, own, 1.0))
        values, vectors = np.linalg.eigh(0.5 * (information + information.T) * np.outer(scale, scale))
        kept = values > _ROUNDING * values[-1]
        roots, columns = np.sqrt(values[kept]), vectors[:, kept]
        return cls(point, (columns * roots).T / scale, columns.T @ (scale * right) / roots)

    @property
    def information(self) -> FloatArray:
        """Information matrix ``(n, n)``."""
        return self.root.T @ self.root

    @property
    def log_det(self) -> float:
        """Logarithm of the determinant of the information, of what is known at all."""
        size = np.linalg.norm(self.root, axis=0)
        values = np.linalg.svd(self.root / np.where(size > 0.0, size, 1.0), compute_uv=False)
        known = values > np.sqrt(_ROUNDING) * values[0]
        return float(2.0 * (np.log(values[known]).sum() + np.log(size[size > 0.0]).sum()))

    @property
    def moments(self) -> tuple[FloatArray, FloatArray]:
        """Mean ``(n,)`` and covariance ``(n, n)``; variances are huge where nothing is known."""
        size = np.linalg.norm(self.root, axis=0)
        scale = 1.0 / np.where(size > 0.0, size, 1.0)
        _, values, rows = np.linalg.svd(self.root * scale, full_matrices=True)
        inverse = np.full(len(size), 1.0 / np.sqrt(_ROUNDING))
        inverse[: len(values)] = 1.0 / np.maximum(values, np.sqrt(_ROUNDING))
        half = (rows * scale).T * inverse
        covariance = half @ half.T
        return self.point + covariance @ (self.root.T @ self.offset), covariance

    def right(self, unknowns: FloatArray) -> FloatArray:
        """Minus half the gradient of twice the cost, ``(n,)``, at some unknowns ``(n,)``."""
        return self.root.T @ self._deviation(unknowns)

    def cost(self, unknowns: FloatArray) -> float:
        """Twice the cost at some unknowns ``(n,)``."""
        return float(np.square(self._deviation(unknowns)).sum())

    def _deviation(self, unknowns: FloatArray) -> FloatArray:
        return self.offset - self.root @ (unknowns - self.point)

    def faded(self, weight: float) -> BoundaryPrior:
        """The Gaussian with its information multiplied by a weight."""
        factor = np.sqrt(weight)
        return replace(self, root=factor * self.root, offset=factor * self.offset)

    def diffused(self, change: FloatArray) -> BoundaryPrior:
        """The Gaussian after random changes of the last unknowns.

        Parameters
        ----------
        change : (m, r) array
            Square root of the covariance of the changes of the last m unknowns: shared ones, which unmodelled
            accelerations may precede.

        Returns
        -------
        BoundaryPrior
        """
        by_change = self.root[:, len(self.point) - len(change) :] @ change
        factor = np.linalg.cholesky(np.eye(len(self.root)) + by_change @ by_change.T)
        solved = np.linalg.solve(factor, np.column_stack([self.root, self.offset]))
        return replace(self, root=solved[:, :-1], offset=solved[:, -1])
