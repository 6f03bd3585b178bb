"""``W p = b -> p``: estimators as small frozen objects, each bound to the rows of a log before it is used.

An estimator tests whether a set of rows is well-defined, and fits it.  Where a fit needs sums alone, each
observation's block of ``[W b]^T [W b]`` is formed once, and a sample or a set of inliers is a sum of blocks, taken in
the order of its rows: no result depends on how many hypotheses are fitted at a time.

A Gaussian prior ``p_j = m +- s`` is a further row ``(sigma / s) p_j = (sigma / s) m`` of every fit, where sigma is the
standard deviation of the residuals of that fit without priors, so that a prior that contradicts the rows does not make
them noisy.  Residuals of a machine are correlated, and rows then say less than their number: sigma^2 is multiplied by
the ratio of the variance of sums of scores over blocks of time to that of white residuals, where that exceeds one.
With known sigma this is the exact posterior mean of the linear-Gaussian model (Gelman et al. 2013, section 14.8).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Protocol

import numpy as np
import numpy.typing as npt

from diransac.arrays import BoolArray, FloatArray, IntArray, size_or_one
from diransac.data.dataset import Dataset, ParameterLayout
from diransac.errors import IdentificationError
from diransac.identification.regression.rows import NullSpace, null_space, regression
from diransac.identification.regression.uncertainty import rows_without, score_inflation

MIN_EIGENVALUE = 1e-6
"""Eigenvalue of the information of a well-defined set of rows, in columns of unit RMS."""
_LEAST_NOISE = 1e-5
"""Noise of a fit with priors at least, over the RMS of b."""


@dataclass(frozen=True, eq=False, repr=False)
class Selection:
    """Sets of rows, gathered once, to be tested and fitted.

    Parameters
    ----------
    well_defined : () -> (n_sets,) bool array
        Mask of the sets that determine the parameters, by the smallest eigenvalue of the column-scaled ``W^T W``.
    fit : () -> (n_sets, n) array
        Parameters; not finite where a set determines none.
    """

    well_defined: Callable[[], BoolArray]
    fit: Callable[[], FloatArray]


class BoundEstimator(ABC):
    """An estimator over the usable rows of a dataset, which are numbered from 0, log after log.

    Parameters
    ----------
    n_rows : int
    scale : (n,) array
        Size of each column of the information.
    min_eigenvalue : float
        Of the information of a well-defined set of rows.
    prior_std : (n,) array
        Standard deviation of each prior, its parameter's unit; infinite without one.
    """

    def __init__(self, n_rows: int, scale: FloatArray, min_eigenvalue: float, prior_std: FloatArray) -> None:
        self.n_rows, self.scale, self._min_eigenvalue = n_rows, scale, min_eigenvalue
        self._shifts = np.diag(np.where(np.isfinite(prior_std), prior_std, 0.0))[np.isfinite(prior_std)]
        # Each prior is a row of unit size where the rank of rows is tested.
        self._counted = np.diag(np.isfinite(prior_std).astype(float))

    @abstractmethod
    def information(self, row_sets: Sequence[IntArray]) -> FloatArray:
        """Sums ``(n_sets, n, n)`` of ``W^T W`` in columns over their ``scale``."""

    @abstractmethod
    def fit(self, row_sets: Sequence[IntArray], shift: FloatArray | None = None) -> FloatArray:
        """Parameters ``(n_sets, n)``; the means of priors may be shifted ``(n,)``."""

    def select(self, row_sets: Sequence[IntArray]) -> Selection:
        """Sets of rows, to be checked and fitted."""
        return Selection(partial(self._well_defined, self.information(row_sets)), partial(self.fit, row_sets))

    def _well_defined(self, information: FloatArray) -> BoolArray:
        return np.asarray(smallest_eigenvalue(information + self._counted) > self._min_eigenvalue)

    def _of_everything(self) -> FloatArray:
        """Information ``(n, n)`` of the whole dataset, with priors as rows of unit size."""
        return np.asarray(self.information([np.arange(self.n_rows)])[0] + self._counted)

    def null_space(self) -> NullSpace:
        """Directions of the parameters that the whole dataset does not determine."""
        return null_space(self._of_everything(), self.scale, self._min_eigenvalue)

    def correlations(self) -> FloatArray:
        """Correlations ``(n, n)`` of the parameters' errors from the whole dataset, which determines them."""
        return correlations(self._of_everything())

    def fit_without(self, groups: Sequence[IntArray], rows: IntArray) -> FloatArray:
        """Parameters ``(n_groups, n)`` from rows, which ascend, without each of several groups."""
        return self.fit([rows_without(rows, group) for group in groups])

    def prior_shifts(self, rows: IntArray) -> FloatArray:
        """Change ``(n_priors, n)`` of the parameters from rows by a shift of each prior by its standard deviation."""
        shifted = [self.fit([rows], shift)[0] for shift in self._shifts]
        return np.array(shifted).reshape(-1, len(self.scale)) - self.fit([rows])


class Estimator(Protocol):
    """An unbound estimator: its settings, without data."""

    def bind(self, dataset: Dataset) -> BoundEstimator:
        """The estimator over the usable rows of a dataset."""


@dataclass(frozen=True)
class _SumsEstimator:
    """An estimator whose fit depends on a set of rows through the sum of ``[W b]^T [W b]`` alone.

    Parameters
    ----------
    min_eigenvalue : float, optional
        The smallest eigenvalue of ``W^T W`` must exceed it, with the columns of ``W`` divided by their RMS over the
        whole log, so that it has no unit.
    """

    min_eigenvalue: float = MIN_EIGENVALUE

    def fit(self, W: npt.ArrayLike, b: npt.ArrayLike) -> FloatArray:
        """Solution of ``W p = b``.

        Parameters
        ----------
        W : (..., n_p) array_like
        b : (...) array_like

        Returns
        -------
        (n_p,) array

        Raises
        ------
        IdentificationError
            Shapes do not match, or a value is not finite.
        """
        bound = BoundSums(self, *_flat(W, b))
        return np.asarray(bound.select([np.arange(bound.n_rows)]).fit()[0])

    def well_defined(self, W: npt.ArrayLike, b: npt.ArrayLike) -> bool:
        """True if ``W`` and ``b`` determine the parameters, with the columns scaled by their own RMS.

        Parameters
        ----------
        W : (..., n_p) array_like
        b : (...) array_like

        Returns
        -------
        bool

        Raises
        ------
        IdentificationError
            Shapes do not match, or a value is not finite.
        """
        bound = BoundSums(self, *_flat(W, b))
        return bool(bound.select([np.arange(bound.n_rows)]).well_defined()[0])

    def bind(self, dataset: Dataset) -> BoundEstimator:
        """The estimator over the usable rows of a dataset."""
        return BoundSums(self, *regression(dataset), dataset.layout)

    def solve(self, gram: FloatArray, prior: _PriorSums | None = None) -> FloatArray:
        """Parameters ``(..., n_p)`` from sums ``(..., n_p + 1, n_p + 1)`` with columns of unit RMS, and of priors."""
        raise NotImplementedError


@dataclass(frozen=True)
class OrdinaryLeastSquares(_SumsEstimator):
    """``p = (W^T W)^-1 W^T b``: least squares of the equation error.

    Parameters
    ----------
    min_eigenvalue : float, optional
        Threshold of a well-defined set of rows: the smallest eigenvalue of its ``W^T W`` must exceed it, with the
        columns of ``W`` divided by their RMS over the whole log; no unit.

    References
    ----------
    Dimmig et al. 2023, section III.C (whose printed formula lacks the transpose).
    """

    def solve(self, gram: FloatArray, prior: _PriorSums | None = None) -> FloatArray:
        """Normal equations by LDL^T."""
        return _solved(gram[..., :-1, :-1], gram[..., :-1, -1], prior)


@dataclass(frozen=True)
class TotalLeastSquares(_SumsEstimator):
    """The ``p`` of the smallest change of ``W`` and ``b`` that makes ``W p = b`` exact, in columns of unit RMS.

    All columns are assumed to have the same noise relative to their RMS.

    Parameters
    ----------
    min_eigenvalue : float, optional
        As in `OrdinaryLeastSquares`.

    References
    ----------
    Golub and Van Loan 1980, "An analysis of the total least squares problem".
    """

    def solve(self, gram: FloatArray, prior: _PriorSums | None = None) -> FloatArray:
        """Eigenvector of the smallest eigenvalue of ``[W b]^T [W b]``.

        It solves ``(W^T W - l) p = W^T b`` with that eigenvalue l, the normal equations to which a prior adds its sums.
        """
        finite = np.all(np.isfinite(gram), axis=(-2, -1), keepdims=True)
        values, vectors = np.linalg.eigh(np.where(finite, gram, np.eye(gram.shape[-1])))
        if prior is not None:
            least = values[..., :1, None] * np.eye(gram.shape[-1] - 1)
            return _solved(gram[..., :-1, :-1] - least, gram[..., :-1, -1], prior)
        smallest = np.where(finite[..., 0], vectors[..., :, 0], np.nan)
        last = smallest[..., -1:]
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(np.abs(last) > np.finfo(float).eps, -smallest[..., :-1] / last, np.nan)


@dataclass(frozen=True, eq=False, repr=False)
class _PriorSums:
    """Sums that priors add to those of sets of rows, in columns of unit RMS.

    Parameters
    ----------
    weight : (..., n) array
        Variance of the noise over that of the prior; 0 for a parameter without one.
    mean : (n,) array
        Means of the priors.
    """

    weight: FloatArray
    mean: FloatArray


def _solved(A: FloatArray, g: FloatArray, prior: _PriorSums | None) -> FloatArray:
    """``A^-1 g``, with the sums of priors."""
    if prior is None:
        return solve_definite(A, g)
    return solve_definite(A + prior.weight[..., None] * np.eye(A.shape[-1]), g + prior.weight * prior.mean)


class BoundSums(BoundEstimator):
    """Blocks of ``[W b]^T [W b]`` in columns of unit RMS, the upper triangle of each observation's in a row.

    The RMS of each column is 1 of one that is zero.
    """

    def __init__(
        self, estimator: _SumsEstimator, W: FloatArray, b: FloatArray, layout: ParameterLayout | None = None
    ) -> None:
        self._estimator = estimator
        n_rows, self._n_equations, self._n_p = W.shape
        columns = np.concatenate([W, b[:, :, None]], axis=2)
        scale = size_or_one(np.sqrt(np.square(columns.reshape(-1, self._n_p + 1)).mean(axis=0)))
        columns = columns / scale
        self._upper = np.triu_indices(self._n_p + 1)
        i, j = self._upper
        self._blocks = np.zeros((n_rows, len(i)))
        for row in range(W.shape[1]):
            self._blocks += columns[:, row, i] * columns[:, row, j]
        self.known_scale, self._per_unit = scale[-1], scale[:-1] / scale[-1]
        std = np.full(self._n_p, np.inf) if layout is None else layout.prior_std
        self._prior_std = std * self._per_unit
        self._prior_mean = np.zeros(self._n_p) if layout is None else layout.prior_mean * self._per_unit
        super().__init__(n_rows, scale[:-1], estimator.min_eigenvalue, std)

    def information(self, row_sets: Sequence[IntArray]) -> FloatArray:
        """See `BoundEstimator.information`."""
        return self.gram(row_sets)[:, :-1, :-1]

    def select(self, row_sets: Sequence[IntArray]) -> Selection:
        """See `BoundEstimator.select`; the sums are formed once."""
        gram, n_rows = self.gram(row_sets), np.array([len(rows) for rows in row_sets])
        return Selection(partial(self._well_defined, gram[:, :-1, :-1]), partial(self.solve, gram, n_rows))

    def fit(self, row_sets: Sequence[IntArray], shift: FloatArray | None = None) -> FloatArray:
        """See `BoundEstimator.fit`."""
        return self.solve(self.gram(row_sets), np.array([len(rows) for rows in row_sets]), shift)

    def fit_without(self, groups: Sequence[IntArray], rows: IntArray) -> FloatArray:
        """See `BoundEstimator.fit_without`; sums of the groups are taken from those of all rows."""
        left = len(rows) - np.array([len(group) for group in groups])
        return self.solve(self.gram([rows]) - self.gram(groups), left)

    def correlations(self) -> FloatArray:
        """See `BoundEstimator.correlations`; priors have their weights."""
        gram = self.gram([np.arange(self.n_rows)])
        prior = self.prior_sums(gram, np.array([self.n_rows]))
        return correlations(gram[0, :-1, :-1] + (0.0 if prior is None else np.diag(prior.weight[0])))

    def solve(self, gram: FloatArray, n_rows: IntArray, shift: FloatArray | None = None) -> FloatArray:
        """Parameters in their units from sums, over as many rows, in columns of unit RMS; priors may be shifted."""
        prior = self.prior_sums(gram, n_rows, shift)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self._estimator.solve(gram, prior) * self.known_scale / self.scale)

    def prior_sums(self, gram: FloatArray, n_rows: IntArray, shift: FloatArray | None = None) -> _PriorSums | None:
        """Sums of priors beside those of sets of as many rows; None without priors."""
        if not len(self._shifts):
            return None
        noise = self._inflation * self._residual_variance(gram, n_rows)[0]
        mean = self._prior_mean if shift is None else self._prior_mean + shift * self._per_unit
        return _PriorSums(np.maximum(noise, _LEAST_NOISE**2)[:, None] / np.square(self._prior_std), mean)

    def _residual_variance(self, gram: FloatArray, n_rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Variance ``(n_sets,)`` of the residuals of ordinary least squares without priors, and its solutions."""
        G, h = gram[:, :-1, :-1], gram[:, :-1, -1]
        # A ridge makes the sums definite.
        p = solve_definite(G + 1e-10 * n_rows[:, None, None] * np.eye(self._n_p), h)
        left = gram[:, -1, -1] - (h * p).sum(axis=1)
        return left / np.maximum(1, n_rows * self._n_equations - self._n_p), p

    @cached_property
    def _inflation(self) -> float:
        """Variance of sums of scores over blocks of time, over that of white residuals; one at least."""
        gram = self.gram([np.arange(self.n_rows)])
        (variance,), (p,) = self._residual_variance(gram, np.array([self.n_rows]))
        parts = self.gram(list(np.arange(self.n_rows)[:, None]))
        scores = parts[:, :-1, -1] - parts[:, :-1, :-1] @ p
        return score_inflation(scores, gram[0, :-1, :-1], max(float(variance), _LEAST_NOISE**2))

    def gram(self, row_sets: Sequence[IntArray]) -> FloatArray:
        """Sums ``(n_sets, n + 1, n + 1)``, each in the order of its rows."""
        sums, by_length = np.empty((len(row_sets), self._blocks.shape[1])), defaultdict[int, list[int]](list)
        for place, own in enumerate(row_sets):
            by_length[len(own)].append(place)
        for alike in by_length.values():
            rows = np.stack([row_sets[place] for place in alike], axis=1)
            sums[alike] = np.add.reduce(np.take(self._blocks, rows, axis=0), axis=0)
        gram = np.empty((len(row_sets), self._n_p + 1, self._n_p + 1))
        i, j = self._upper
        gram[:, i, j] = gram[:, j, i] = sums
        return gram


def smallest_eigenvalue(gram: FloatArray) -> FloatArray:
    """Smallest eigenvalue of each symmetric matrix.

    Parameters
    ----------
    gram : (..., n, n) array

    Returns
    -------
    (...) array
        -inf where a matrix is not finite.
    """
    finite = np.all(np.isfinite(gram), axis=(-2, -1))
    values = np.linalg.eigvalsh(np.where(finite[..., None, None], gram, 0.0))[..., 0]
    return np.where(finite, values, -np.inf)


def correlations(gram: FloatArray) -> FloatArray:
    """Correlations of estimates whose rows have independent errors.

    Parameters
    ----------
    gram : (n, n) array
        Sum of ``W^T W`` in any scale, positive definite.

    Returns
    -------
    (n, n) array
    """
    covariance = np.linalg.inv(gram)
    errors = np.sqrt(np.diag(covariance))
    return np.asarray(covariance / errors[:, None] / errors)


def solve_definite(A: FloatArray, g: FloatArray) -> FloatArray:
    """``A^-1 g`` of symmetric positive definite ``A``, by LDL^T; NaN where the factorisation breaks down.

    Written out over the leading axes: the same bits for every batch size and machine, which LAPACK does not guarantee.

    Parameters
    ----------
    A : (..., n, n) array
    g : (..., n) array

    Returns
    -------
    (..., n) array
    """
    A, x = A.copy(), g.copy()
    n = A.shape[-1]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for j in range(n):
            pivot = np.where(A[..., j, j] > 0.0, A[..., j, j], np.nan)
            for i in range(j + 1, n):
                factor = A[..., i, j] / pivot
                A[..., i, j:] -= factor[..., None] * A[..., j, j:]
                x[..., i] -= factor * x[..., j]
        for j in reversed(range(n)):
            for i in range(j + 1, n):
                x[..., j] -= A[..., j, i] * x[..., i]
            x[..., j] /= np.where(A[..., j, j] > 0.0, A[..., j, j], np.nan)
    return x


def _flat(W: npt.ArrayLike, b: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """``(n, 1, n_p)`` and ``(n, 1)``.  Raises IdentificationError: shapes do not match, or a value is not finite."""
    W, b = np.asarray(W, dtype=float), np.asarray(b, dtype=float)
    if W.ndim < 2 or W.shape[:-1] != b.shape:
        raise IdentificationError(f"W {W.shape} and b {b.shape} do not match; give W (..., n_p) and b (...)")
    if not (np.isfinite(W).all() and np.isfinite(b).all()):
        raise IdentificationError("W or b holds NaN or infinity; leave those rows out")
    return W.reshape(-1, 1, W.shape[-1]), b.reshape(-1, 1)
