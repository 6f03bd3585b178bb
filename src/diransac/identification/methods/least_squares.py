"""Least squares of the whole dataset: ordinary, total, nonlinear, or any other estimator."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.errors import IdentificationError
from diransac.identification.diagnosis import Resolution
from diransac.identification.estimate import Estimate
from diransac.identification.method import report
from diransac.identification.regression.estimators import BoundEstimator, Estimator, OrdinaryLeastSquares
from diransac.identification.regression.nonlinear import BoundNonlinear, NonlinearLeastSquares
from diransac.identification.regression.rows import motion_rows
from diransac.identification.regression.scikit_learn import as_estimator, name_of
from diransac.identification.regression.uncertainty import N_BLOCKS, jackknife_covariance
from diransac.identification.settings import JUDGING, SIMULATION, Settings, check_used
from diransac.identification.structure.identifiability import in_words, of_log, vague_parameters
from diransac.identification.structure.refusal import cause_of_refusal, check_known_terms
from diransac.identification.structure.structural import check_structure
from diransac.time_limit import time_unlimited

if TYPE_CHECKING:
    from collections.abc import Mapping

    from diransac.data.dataset import Dataset
    from diransac.identification.method import Callback
    from diransac.model import Model


@dataclass(frozen=True)
class LeastSquares:
    """Least squares of every row: methods "ols", "tls" and "nls", by their estimator.

    Parameters
    ----------
    estimator : object, optional
        `OrdinaryLeastSquares` (default), `TotalLeastSquares`, `NonlinearLeastSquares`, or any scikit-learn linear
        regressor.
    criteria : Settings, optional
        Settings of the evaluation; settings of a search are refused.

    Raises
    ------
    SettingsError
        A setting is not used by least squares, or the estimator is not an estimator.
    """

    estimator: object = field(default_factory=OrdinaryLeastSquares)
    criteria: Settings = field(default_factory=Settings)
    needs_all_signals = True
    uses = (*JUDGING, *SIMULATION)

    def __post_init__(self) -> None:
        object.__setattr__(self, "estimator", as_estimator(self.estimator))
        check_used(self.criteria, self.uses, self.name)

    @property
    def name(self) -> str:
        """``"ols"``, ``"tls"``, ``"nls"``, or the name of the estimator's class."""
        names = {"OrdinaryLeastSquares": "ols", "TotalLeastSquares": "tls", "NonlinearLeastSquares": "nls"}
        return names.get(name_of(self._estimator), name_of(self._estimator))

    @property
    def _estimator(self) -> Estimator:
        return self.estimator  # type: ignore[return-value]  # as_estimator made it one

    def regresses(self, model: Model) -> bool:
        """True unless the estimator is nonlinear."""
        return not isinstance(self.estimator, NonlinearLeastSquares)

    def options(self) -> Mapping[str, Any]:
        """An empty mapping: the estimator has the settings."""
        return {}

    def fit(self, dataset: Dataset, seed: int, callback: Callback | None = None) -> Estimate:
        """Parameters by least squares of all rows.

        Parameters
        ----------
        dataset : Dataset
        seed : int
            Not used.
        callback : callable, optional
            Called with a `Progress` at every stage.

        Returns
        -------
        Estimate

        Raises
        ------
        IdentificationError
            A parameter is not identifiable from the dataset, or the solution is not finite.
        """
        report(callback, "fitting", 0.0)
        bound = bound_to(self._estimator, dataset)
        rows = np.arange(bound.n_rows)
        parameters = bound.select([rows]).fit()[0]
        if not np.isfinite(parameters).all():
            raise IdentificationError(f"{dataset.source}: {self.name} finds no finite parameters; try another method")
        report(callback, "uncertainty", 0.5)
        resolution = Resolution(self.criteria.integrator, self.criteria.substeps, dataset.hold)
        return fitted(bound, dataset, parameters, rows, estimator=name_of(self._estimator), resolution=resolution)


def bound_to(estimator: Estimator, dataset: Dataset) -> BoundEstimator:
    """The estimator over a dataset.

    Parameters
    ----------
    estimator : Estimator
    dataset : Dataset

    Returns
    -------
    BoundEstimator

    Raises
    ------
    IdentificationError
        A parameter is not identifiable from the whole dataset; the message names it.
    """
    return dataset.kept((bound_to, estimator), lambda: _checked(estimator, dataset))


def _checked(estimator: Estimator, dataset: Dataset) -> BoundEstimator:
    check_structure(dataset.model, dataset.source, ranges=dataset.ranges)
    check_known_terms(dataset)
    bound = estimator.bind(dataset)
    if bound.select([np.arange(bound.n_rows)]).well_defined()[0]:
        return bound
    if isinstance(estimator, NonlinearLeastSquares):
        # A fit within bounds that exclude the solution runs to a bound, where its Jacobian may be singular.
        if not dataset.model.nonlinear_parameters:
            cause = cause_of_refusal(dataset.model, dataset.layout, motion_rows(dataset))
            raise IdentificationError(f"{dataset.source}: {cause}")
        assert isinstance(bound, BoundNonlinear)
        if bound.is_informed_elsewhere():
            ends = ", ".join(f"{n} = {x:.3g}" for n, x in zip(dataset.layout.names, bound.of_all_rows, strict=True))
            raise IdentificationError(
                f"{dataset.source}: the fit ends at {ends}, where the information matrix is singular, as it is not "
                "elsewhere: the motion excites the parameters, but the model does not follow it; compare its "
                "constants and units with the machine, or give narrower bounds"
            )
    found = of_log(dataset.layout.names, bound.null_space())
    raise IdentificationError(f"{dataset.source}: {in_words(found, len(dataset.segments))}")


def fitted(bound: BoundEstimator, dataset: Dataset, parameters: np.ndarray, rows: np.ndarray, **about: Any) -> Estimate:
    """Estimate of fitted parameters, with its jackknife covariance and, where there are priors, that of their means.

    A parameter on one of its bounds stays there whichever rows are left out: its variance is unknown, and infinite
    here, not zero.

    Parameters
    ----------
    bound : BoundEstimator
    dataset : Dataset
    parameters : (n,) array
        Each in its unit.
    rows : (n_fitted,) int array
        Usable rows that the parameters were fitted to, ascending.
    about : object
        Other fields of the estimate.

    Returns
    -------
    Estimate
    """
    log_sizes = None if dataset.layout.is_shared else [one.n_rows for one in dataset.segments]
    with time_unlimited():
        shifts = bound.prior_shifts(rows)
        covariance = jackknife_covariance(bound, rows, log_sizes) + shifts.T @ shifts
    stuck = dataset.layout.on_bounds(parameters)
    covariance[stuck] = covariance[:, stuck] = np.inf
    vague = vague_parameters(dataset.layout.names, parameters, covariance, bound.correlations())
    return Estimate(
        parameters=dict(zip(dataset.layout.names, parameters.tolist(), strict=True)),
        covariance=covariance,
        degrees_of_freedom=max(1, min(N_BLOCKS, len(rows)) - 1),
        n_fitted=len(rows),
        notes=(in_words(vague, len(dataset.segments)),) if vague else (),
        **about,
    )
