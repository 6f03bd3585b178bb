"""Equations ``W p = b`` of any averaging, and their one solver: weights, priors, bounds and a robust loss.

Weak form, least squares on a fitted motion, of all rows, of a part of the logs and without a block differ in which rows
are averaged and which are left out alone.

References
----------
Holland and Welsch 1977 (iteratively reweighted least squares).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from diransac.arrays import BoolArray, FloatArray, robust_std, size_or_one
from diransac.model import Parameter

_ROUNDING = 1e-9
"""Residual over the scale of its equation, and known terms over those of another one, that are rounding errors."""
_SINGULAR = 1e-10
"""Eigenvalue of the information in columns of unit size, over their number, of a direction without information."""
_CONVERGED = 1e-4
"""Relative change of a parameter from which on reweighting goes on."""
_NUMBERS_AT_A_TIME = 1_000_000
"""Numbers that are held at a time for several sets of rows: bounds the memory, whatever the length of the logs."""

Gaussian = tuple[FloatArray, FloatArray]
"""Mean and standard deviation ``(m,)`` of each parameter; infinite for one without a prior."""


@dataclass(frozen=True)
class Loss:
    """Loss whose weights are ``(1 + z^2)^-power``, with residuals z over ``width`` robust standard deviations.

    Parameters
    ----------
    power, width : float
    steps : int
        Largest number of reweightings.
    leverage : bool, optional
        Whether rows that are larger than the median count less in the first step.
    """

    power: float
    width: float
    steps: int
    leverage: bool = False

    def weights(self, residuals: FloatArray, used: BoolArray) -> FloatArray:
        """Square roots of the weights ``(n, r)`` of residuals in units of each equation's scale.

        Each equation has its own deviation: zeros satisfy one without a known term, and would outweigh the others.
        """
        spread = np.array([robust_std(x[k]) if k.any() else 1.0 for x, k in zip(residuals.T, used.T, strict=True)])
        z = residuals / (self.width * np.maximum(spread, _ROUNDING))
        return np.asarray((1.0 + np.square(z)) ** (-0.5 * self.power))


CAUCHY = Loss(1.0, 2.385, 4)
"""95 % efficient for normal residuals."""
GEMAN_MCCLURE = Loss(2.0, 2.0235, 10, leverage=True)
"""For rows of which many are outliers: three median residuals are its width."""


@dataclass(frozen=True, eq=False, repr=False)
class Rows:
    """Equations ``W p = b``.

    Parameters
    ----------
    W : (n, r, m) array
    b : (n, r) array
    """

    W: FloatArray
    b: FloatArray

    @cached_property
    def has_known_terms(self) -> BoolArray:
        """Mask ``(r,)`` of the equations in which b is more than a rounding error beside that of another one."""
        largest = np.abs(self.b).max(axis=0)
        return np.asarray(largest > _ROUNDING * largest.max())

    def over(self, scale: FloatArray) -> Rows:
        """The equations in units of a scale ``(r,)``."""
        return Rows(self.W / scale[:, None], self.b / scale)

    def residuals(self, p: FloatArray) -> FloatArray:
        """``b - W p`` ``(n, r)``."""
        return np.asarray(self.b - self.W @ p)


@dataclass(frozen=True, eq=False, repr=False)
class Solution:
    """Weighted least squares of rows.

    Parameters
    ----------
    p : (m,) array
    rows : Rows
    weights : (n, r) array
        Square roots of the weights, those of the loss included.
    inverse : (m, m) array
        Of the information; zero for parameters that are held.
    held : (m,) bool array
        Parameters on a bound.
    """

    p: FloatArray
    rows: Rows
    weights: FloatArray
    inverse: FloatArray
    held: BoolArray

    @cached_property
    def gains(self) -> FloatArray:
        """``dp / db`` ``(m, n, r)``: the effect of each row of each equation on the parameters."""
        return np.asarray(np.einsum("ij,nrj->inr", self.inverse, self.rows.W) * np.square(self.weights))

    def errors(self, n_batches: int = 30) -> FloatArray:
        """Standard errors ``(m,)``, from sums of scores over batches of rows; infinite without information."""
        scores = np.einsum("nrj,nr->nj", self.rows.W, np.square(self.weights) * self.rows.residuals(self.p))
        sums = np.add.reduceat(scores, np.arange(0, len(scores), max(1, len(scores) // n_batches)), axis=0)
        errors = np.sqrt(np.square(sums @ self.inverse).sum(axis=0))
        return np.where((self.rows.W * self.weights[:, :, None]).any(axis=(0, 1)), errors, np.inf)


def solve(
    rows: Rows,
    weights: FloatArray | None = None,
    prior: Gaussian | None = None,
    bounds: tuple[FloatArray, FloatArray] | None = None,
    loss: Loss | None = None,
) -> Solution:
    """Minimum of ``sum rho(w (b - W p)) + sum ((p - mean) / std)^2`` within inclusive bounds.

    Parameters that leave a bound are held there, and the others solved again.

    Parameters
    ----------
    rows : Rows
    weights : (n, r) or (r,) array, optional
        Square roots of the weights, over each equation's scale: 0 for a row that does not count.
    prior : pair of (m,) array, optional
        Mean and standard deviation.
    bounds : pair of (m,) array, optional
        Lower and upper.
    loss : Loss, optional
        None: squares.

    Returns
    -------
    Solution

    Raises
    ------
    LinAlgError
        The rows are not finite.
    """
    m = rows.W.shape[2]
    weights = np.broadcast_to(np.ones(1) if weights is None else weights, rows.b.shape)
    lower, upper = bounds or (np.full(m, -np.inf), np.full(m, np.inf))
    mean, std = prior or (np.zeros(m), np.full(m, np.inf))
    p, held, inverse = np.zeros(m), np.zeros(m, bool), np.zeros((m, m))
    for _ in range(m + 1):
        free = ~held
        left = Rows(rows.W[:, :, free], rows.b - rows.W[:, :, held] @ p[held])
        p[free], inner, used = _reweighted(left, weights, (mean[free], std[free]), loss)
        outside = (p < lower) | (p > upper)
        if not outside.any():
            inverse[np.ix_(free, free)] = inner
            break
        p, held = np.clip(p, lower, upper), held | outside
    return Solution(p, rows, used, inverse, held)


def solve_sets(rows: Rows, masks: BoolArray, prior: Gaussian | None = None) -> FloatArray:
    """Parameters ``(n_sets, m)`` of sets of rows ``(n_sets, n, r)``; NaN where they are not finite.

    Parameters
    ----------
    rows : Rows
        With residuals of order one, beside which priors count.
    masks : (n_sets, n, r) bool array
    prior : pair of (m,) array, optional
    """
    return _solution(*_information(rows, masks, prior))[0]


def solve_sized(rows: Rows, masks: BoolArray, prior: Gaussian | None = None) -> FloatArray:
    """Parameters as by `solve_sets`, which noise in equations without a known term (``b = 0``) does not shrink.

    Zeros solve such an equation, too: it determines ratios of the parameters that it connects.  Given the ratios, the
    size of each group of connected parameters is that of least squares of the other equations.

    Parameters
    ----------
    rows : Rows
    masks : (n_sets, n, r) bool array
    prior : pair of (m,) array, optional
    """
    p, known = solve_sets(rows, masks, prior), rows.has_known_terms
    if known.all() or not known.any():
        return p
    sized = Rows(np.ascontiguousarray(rows.W[:, known]), rows.b[:, known])
    G, h = _information(sized, masks[:, :, known], prior)
    ratios = p[:, :, None] * _connected(rows.W[:, ~known])
    transposed = ratios.swapaxes(1, 2)
    sizes, _ = _solution(transposed @ G @ ratios, (transposed @ h[:, :, None])[:, :, 0])
    return np.asarray((ratios @ sizes[:, :, None])[:, :, 0])


def inclusive_bounds(parameters: Sequence[Parameter], *, zero: bool = False) -> tuple[FloatArray, FloatArray]:
    """Lower and upper bounds ``(m,)``; positive parameters have none below, or zero.

    Parameters
    ----------
    parameters : sequence of Parameter
    zero : bool, optional
        Whether positive parameters may be zero.
    """
    lower = [(max(x.lower, 0.0) if zero else -np.inf) if x.positive else x.lower for x in parameters]
    return np.array(lower), np.array([x.upper for x in parameters])


def _reweighted(
    rows: Rows, weights: FloatArray, prior: Gaussian, loss: Loss | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Parameters, the inverse of the information, and the weights, those of the loss included."""
    precision = 1.0 / np.square(prior[1])
    used, factor = weights > 0.0, np.ones(weights.shape)
    if loss and loss.leverage:
        columns = np.concatenate([rows.W, rows.b[:, :, None]], axis=2)
        size = np.linalg.norm(columns / size_or_one(np.sqrt(np.square(columns).mean(axis=(0, 1)))), axis=2)
        factor = 1.0 / (1.0 + size / (np.median(size) + np.finfo(float).tiny))
    p = np.zeros(rows.W.shape[2])
    for left in range(loss.steps if loss else 0, -1, -1):
        before, square = p, np.square(weights * factor)
        weighted = rows.W * square[:, :, None]
        with np.errstate(over="ignore", invalid="ignore"):
            G = np.tensordot(weighted, rows.W, axes=([0, 1], [0, 1])) + np.diag(precision)
            h = np.tensordot(weighted, rows.b, axes=([0, 1], [0, 1])) + precision * prior[0]
        if not (np.isfinite(G).all() and np.isfinite(h).all()):
            raise np.linalg.LinAlgError("rows of the equations are not finite")
        (p,), (inverse,) = _solution(G[None], h[None])
        if loss is None or left == 0 or (np.abs(p - before) <= _CONVERGED * np.abs(p)).all():
            break
        factor = loss.weights(rows.residuals(p) * weights, used)
    return p, inverse, weights * factor


def _information(rows: Rows, masks: BoolArray, prior: Gaussian | None) -> tuple[FloatArray, FloatArray]:
    """Sums ``(n_sets, m, m)`` of ``W^T W`` and ``(n_sets, m)`` of ``W^T b`` over sets of rows, and of the prior."""
    n, r, m = rows.W.shape
    products = np.einsum("nri,nrj->nrij", rows.W, rows.W).reshape(n * r, -1)
    known = (rows.W * rows.b[:, :, None]).reshape(n * r, -1)
    G, h = np.empty((len(masks), m, m)), np.empty((len(masks), m))
    at_a_time = max(1, _NUMBERS_AT_A_TIME // (n * r))
    for first in range(0, len(masks), at_a_time):
        some = slice(first, first + at_a_time)
        chosen = masks[some].reshape(-1, n * r).astype(np.float64)
        G[some], h[some] = (chosen @ products).reshape(-1, m, m), chosen @ known
    if prior is not None:
        precision = 1.0 / np.square(prior[1])
        G, h = G + np.diag(precision), h + precision * prior[0]
    return G, h


def _solution(G: FloatArray, h: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Solutions ``(n_sets, m)`` of normal equations, and inverses; 0 along directions without information."""
    finite = np.asarray(np.isfinite(G).all(axis=(1, 2)) & np.isfinite(h).all(axis=1))
    G = np.where(finite[:, None, None], G, 0.0)
    d = size_or_one(np.sqrt(np.einsum("kii->ki", G)))
    inverse = np.linalg.pinv(G / d[:, :, None] / d[:, None, :], rcond=_SINGULAR, hermitian=True)
    z = (inverse @ (h / d)[:, :, None])[:, :, 0]
    z[np.abs(z) < np.finfo(float).eps * np.abs(z).max(axis=1, initial=0.0, keepdims=True)] = 0.0  # rounding of none
    p = np.where(finite[:, None], z / d, np.nan)
    return p, inverse / d[:, :, None] / d[:, None, :]


def _connected(W: FloatArray) -> BoolArray:
    """Mask ``(m, n_groups)`` of the parameters that some equations ``(n, r, m)`` connect; others are alone."""
    used = W.any(axis=0).astype(int)
    joined = (used.T @ used > 0) | np.eye(used.shape[1], dtype=bool)
    for _ in range(used.shape[1].bit_length()):
        joined = joined.astype(int) @ joined > 0
    return np.asarray(np.unique(joined, axis=0).T)
