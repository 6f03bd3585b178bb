"""Linear regressors of scikit-learn as estimators, and the estimator that a user gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self, cast

import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.data.dataset import Dataset, ParameterLayout
from diransac.errors import SettingsError
from diransac.identification.regression.estimators import (
    MIN_EIGENVALUE,
    BoundEstimator,
    BoundSums,
    Estimator,
    OrdinaryLeastSquares,
)
from diransac.identification.regression.rows import regression


class LinearRegressor(Protocol):
    """Interface of scikit-learn's linear regressors."""

    def fit(self, X: FloatArray, y: FloatArray) -> Self:
        """Fit coefficients."""

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Settings by name."""

    def set_params(self, **params: object) -> Self:
        """Change settings."""


@dataclass(frozen=True)
class ScikitLearnEstimator:
    """Any scikit-learn linear regressor: fitted without intercept, to columns and right-hand side of unit RMS.

    Parameters
    ----------
    regressor : LinearRegressor
        Regressor with ``fit`` and ``coef_`` (or an ``estimator_`` that has it), such as ``HuberRegressor()``.
    min_eigenvalue : float, optional
        As in `OrdinaryLeastSquares`.

    Raises
    ------
    SettingsError
        The regressor cannot be fitted without an intercept.
    """

    regressor: LinearRegressor
    min_eigenvalue: float = MIN_EIGENVALUE

    def __post_init__(self) -> None:
        object.__setattr__(self, "regressor", _without_intercept(self.regressor))

    def bind(self, dataset: Dataset) -> BoundEstimator:
        """The estimator over the usable rows of a dataset."""
        return _BoundScikitLearn(self, *regression(dataset), dataset.layout)


class _BoundScikitLearn(BoundEstimator):
    """Rows of ``W`` and ``b`` for a scikit-learn regressor; their sums decide whether a set is well-defined."""

    def __init__(self, estimator: ScikitLearnEstimator, W: FloatArray, b: FloatArray, layout: ParameterLayout) -> None:
        self._regressor = estimator.regressor
        self._sums = sums = BoundSums(OrdinaryLeastSquares(estimator.min_eigenvalue), W, b, layout)
        super().__init__(len(W), sums.scale, estimator.min_eigenvalue, layout.prior_std)
        self._W, self._b = W / sums.scale, b / sums.known_scale

    def information(self, row_sets: Sequence[IntArray]) -> FloatArray:
        """See `BoundEstimator.information`."""
        return self._sums.information(row_sets)

    def correlations(self) -> FloatArray:
        """See `BoundEstimator.correlations`."""
        return self._sums.correlations()

    def fit(self, row_sets: Sequence[IntArray], shift: FloatArray | None = None) -> FloatArray:
        """See `BoundEstimator.fit`; each prior is a further row, by the square root of its weight."""
        n_rows, n_p = np.array([len(rows) for rows in row_sets]), self._W.shape[2]
        prior = self._sums.prior_sums(self._sums.gram(row_sets), n_rows, shift)
        roots = np.zeros((len(row_sets), n_p)) if prior is None else np.sqrt(prior.weight)
        mean = np.zeros(n_p) if prior is None else prior.mean
        fits = np.array([self._fit_one(rows, root, mean) for rows, root in zip(row_sets, roots, strict=True)])
        return np.asarray(fits.reshape(len(row_sets), -1) * self._sums.known_scale / self.scale)

    def _fit_one(self, rows: IntArray, root: FloatArray, mean: FloatArray) -> FloatArray:
        """Parameters from rows, and from one row for each prior, by the square root of its weight."""
        from sklearn.base import clone

        n_p, of_priors = self._W.shape[2], root > 0.0
        W = np.concatenate([self._W[rows].reshape(-1, n_p), np.diag(root)[of_priors]])
        b = np.concatenate([self._b[rows].reshape(-1), (root * mean)[of_priors]])
        try:
            fitted = clone(self._regressor).fit(W, b)
        except ValueError:
            return np.full(n_p, np.nan)
        holder = getattr(fitted, "estimator_", fitted)
        return np.asarray(holder.coef_, dtype=float).reshape(n_p)


def _without_intercept(regressor: LinearRegressor) -> LinearRegressor:
    """A clone that fits no intercept and draws the same random numbers each time."""
    from sklearn.base import clone
    from sklearn.linear_model import LinearRegression

    fresh = clone(regressor)
    known = fresh.get_params(deep=True)
    changes: dict[str, Any] = {n: False for n in ("fit_intercept", "estimator__fit_intercept") if n in known}
    if not changes and known.get("estimator", "") is None:
        changes["estimator"] = LinearRegression(fit_intercept=False)
    if not changes:
        raise SettingsError(
            f"{type(regressor).__name__} cannot be fitted without an intercept; give a linear regressor"
        )
    if known.get("random_state", 0) is None:
        changes["random_state"] = 0
    return cast("LinearRegressor", fresh.set_params(**changes))


def as_estimator(candidate: object) -> Estimator:
    """The estimator itself, or a scikit-learn regressor wrapped as one.

    Parameters
    ----------
    candidate : object

    Returns
    -------
    Estimator

    Raises
    ------
    SettingsError
        The candidate is neither.
    """
    if not isinstance(candidate, type):
        if hasattr(candidate, "bind"):
            return cast("Estimator", candidate)
        if hasattr(candidate, "fit") and hasattr(candidate, "get_params"):
            return ScikitLearnEstimator(cast("LinearRegressor", candidate))
    raise SettingsError(
        f"estimator is {candidate!r}; give dr.OrdinaryLeastSquares(), dr.TotalLeastSquares(), "
        "dr.NonlinearLeastSquares() or a scikit-learn linear regressor"
    )


def name_of(estimator: Estimator) -> str:
    """Name of an estimator's class, or of the scikit-learn class that it wraps.

    Parameters
    ----------
    estimator : Estimator

    Returns
    -------
    str
    """
    named = estimator.regressor if isinstance(estimator, ScikitLearnEstimator) else estimator
    return type(named).__name__
