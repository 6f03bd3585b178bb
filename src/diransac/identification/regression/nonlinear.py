"""Nonlinear least squares of the accelerations and the sensors, for models that are not affine in their parameters.

The error is that of the predicted acceleration, not that of the equation: an equation can be multiplied by any function
of the parameters, and its error vanishes with that function; the error of an acceleration does not.  Sensors are
predicted from the predicted accelerations.

A Gaussian prior ``p_j = m +- s`` is a further error ``(sigma / s) (p_j - m)`` of each fit, with sigma as in
`estimators`: from the errors of that fit without priors, and their correlation in time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray, IntArray, size_or_one
from diransac.data.dataset import Dataset, ParameterLayout
from diransac.data.log import Log
from diransac.data.segment import Segment
from diransac.errors import DiransacError, TimeLimitError
from diransac.identification.core.rows import Rows, solve
from diransac.identification.regression.estimators import (
    BoundEstimator,
    OrdinaryLeastSquares,
    smallest_eigenvalue,
    solve_definite,
)
from diransac.identification.regression.multistart import least_squares
from diransac.identification.regression.rows import MotionRows, NullSpace, RowsSolution, regression
from diransac.identification.regression.uncertainty import rows_without, score_inflation
from diransac.model import Model, Parameter
from diransac.simulation.compiler import Map

_ROWS_FOR_STARTS = 100
"""Rows on which starting points are compared."""
_LOG_BOUND = 27.6
"""Bound of the logarithm of a positive parameter that has none of its own: 1e-12 to 1e12."""


@dataclass(frozen=True)
class NonlinearLeastSquares:
    """Least squares of ``(a - a_model(q, v, u, p)) / rms(a)``, and of sensors over their spread, within the bounds.

    No starting value is required: ``n_starts`` points spread over six decades, or over the bounds, are evaluated on
    the rows to be fitted, and the best few are refined by Levenberg and Marquardt's method.  Where the model is affine
    in its parameters, the solution of the linear regression is refined, too; where only sensors are not, all points
    have the parameters that it determines.

    Parameters
    ----------
    n_starts : int, optional
        Number of starting points that are evaluated.
    n_followed : int, optional
        Number of starting points that are refined.
    max_steps : int, optional
        Largest number of steps of each.
    min_eigenvalue : float, optional
        As in `OrdinaryLeastSquares`, for the Jacobian at the fit of the whole log.

    References
    ----------
    Levenberg 1944; Marquardt 1963; Transtrum and Sethna 2012 for the damping.
    """

    n_starts: int = 200
    n_followed: int = 3
    max_steps: int = 60
    min_eigenvalue: float = 1e-6

    def bind(self, dataset: Dataset) -> BoundNonlinear:
        """The estimator over the usable rows of a dataset."""
        return BoundNonlinear(self, dataset)


def solved_nonlinear(model: Model, layout: ParameterLayout, rows: Sequence[MotionRows]) -> RowsSolution | None:
    """Nonlinear least squares of rows of motions, as `solved` for affine models; None where no row is finite.

    Parameters
    ----------
    model : Model
    layout : ParameterLayout
    rows : sequence of MotionRows

    Returns
    -------
    RowsSolution or None
    """
    names = (model.coordinates, model.velocities, model.accelerations, model.inputs)
    try:
        logs = list[Log]()
        for one in rows:
            columns = dict(zip(chain.from_iterable(names), np.hstack([one.q, one.v, one.a, one.u]).T, strict=True))
            logs.append(Log.from_arrays(np.arange(float(len(one.q))), columns, source=f"log {len(logs)}"))
        bound = NonlinearLeastSquares().bind(Dataset.of(model, logs, pointwise=True))
    except TimeLimitError:
        raise
    except (DiransacError, np.linalg.LinAlgError):
        return None
    nothing = NullSpace(np.zeros((0, len(layout))), np.ones(len(layout)))
    return RowsSolution(bound.of_all_rows, np.zeros(len(layout)), bound.median_errors(), nothing, has_known_terms=True)


class BoundNonlinear(BoundEstimator):
    """Measured accelerations and sensors of the usable rows, and the compiled model of them."""

    def __init__(self, settings: NonlinearLeastSquares, dataset: Dataset) -> None:
        self._settings, self._layout = settings, dataset.layout
        model = dataset.model
        known = [i for i, n in enumerate(model.accelerations) if n in dataset.common_signals]
        shown = [i for i, n in enumerate(model.sensors) if n in dataset.signals]
        parts = [_usable(one, known, shown) for one in dataset.segments]
        self._state, self._inputs, self._measured = (np.concatenate(x) for x in zip(*parts, strict=True))
        self._missing = np.isnan(self._measured)
        self._log_of_row = np.repeat(np.arange(len(parts)), [len(x) for x, _, _ in parts])
        self._scale = np.sqrt(np.square(self._measured[:, : len(known)]).mean(axis=0))
        self._scale = np.append(self._scale, _standard_deviations(self._measured[:, len(known) :]))
        self._scale[self._scale == 0.0] = 1.0
        self.chart = ParameterChart(self._layout.bounds)
        self._evaluate = _compiled(model, known, shown)
        self.n_rows = len(self._state)
        self._n_p = len(self._layout)
        self._starts = self.chart.starts(settings.n_starts)
        self._linear = OrdinaryLeastSquares().bind(dataset) if model.is_affine else None
        if not (model.is_affine or model.nonlinear_parameters):
            # Equations and affine sensors determine the parameters that they contain.
            affine = solve(Rows(*regression(dataset)))
            determined = affine.rows.W.any(axis=(0, 1))
            self._starts[:, determined] = self.chart.clip(self.chart.to_free(affine.p[None]))[:, determined]
        self._inflation = 1.0
        everything = np.arange(self.n_rows)[None]
        whole = self.chart.to_free(self._fit_equal(everything[:, :: max(1, self.n_rows // 2000)]))
        self._starts = np.vstack([whole, self._starts])
        self.of_all_rows = self.chart.to_parameters(whole)[0]
        errors, J = self.errors(everything, whole)
        errors, J = errors.reshape(self.n_rows, len(self._scale)), J.reshape(self.n_rows, len(self._scale), -1)
        scale = np.sqrt(np.square(J).mean(axis=(0, 1)))
        J = J / size_or_one(scale)
        self._blocks = np.einsum("nri,nrj->nij", J, J)
        scale = scale / self.chart.slope(whole)[0]
        super().__init__(self.n_rows, scale, settings.min_eigenvalue, self._layout.prior_std)
        if len(self._layout.with_prior):
            scores = np.einsum("nri,nr->ni", J, np.nan_to_num(errors))
            self._inflation = score_inflation(scores, self._blocks.sum(axis=0), float(np.square(errors).mean()))

    def information(self, row_sets: Sequence[IntArray]) -> FloatArray:
        """See `BoundEstimator.information`: of the Jacobian at the fit of all rows."""
        return np.array([self._blocks[rows].sum(axis=0) for rows in row_sets])

    def median_errors(self) -> FloatArray:
        """Median error ``(r,)`` of the fit of all rows, over the size of each signal."""
        errors, _ = self.errors(np.arange(self.n_rows)[None], self.chart.to_free(self.of_all_rows[None]))
        return np.median(np.abs(errors.reshape(self.n_rows, -1)), axis=0) + np.finfo(float).tiny

    def is_informed_elsewhere(self) -> bool:
        """True if the Jacobian of the rows has full rank at other parameters than those of the fit."""
        rows = np.arange(self.n_rows)[:: max(1, self.n_rows // _ROWS_FOR_STARTS)]
        some = self._starts[1 :: max(1, len(self._starts) // 20)]
        J = self.errors(np.tile(rows, (len(some), 1)), some)[1].reshape(len(some), -1, self._n_p)
        J = J[np.isfinite(J).all(axis=(1, 2))]
        J = J / np.maximum(np.sqrt(np.square(J).mean(axis=1, keepdims=True)), np.finfo(float).tiny)
        gram = np.einsum("bri,brj->bij", J, J)
        return bool((smallest_eigenvalue(gram) > self._settings.min_eigenvalue).any()) if len(J) else False

    def prior_shifts(self, rows: IntArray) -> FloatArray:
        """See `BoundEstimator.prior_shifts`."""
        here = self._fit_equal(rows[None])
        start = self.chart.to_free(here)[:, None]
        shifted = [self._likeliest(rows[None], start, shift)[0] for shift in self._shifts]
        return np.array(shifted).reshape(-1, self._n_p) - here

    def fit(self, row_sets: Sequence[IntArray], shift: FloatArray | None = None) -> FloatArray:
        """See `BoundEstimator.fit`."""
        fits = np.empty((len(row_sets), self._n_p))
        for length in {len(rows) for rows in row_sets}:
            places = [i for i, rows in enumerate(row_sets) if len(rows) == length]
            # Bounds the memory, whatever the number of sets.
            at_a_time = max(1, 300_000 // (len(self._starts) * max(1, length)))
            for first in range(0, len(places), at_a_time):
                some = places[first : first + at_a_time]
                fits[some] = self._fit_equal(np.array([row_sets[i] for i in some]), shift)
        return fits

    def fit_without(self, groups: Sequence[IntArray], rows: IntArray) -> FloatArray:
        """See `BoundEstimator.fit_without`."""
        whole = self._fit_equal(rows[None])[0]
        return np.array([self.fit_from(rows_without(rows, group), whole) for group in groups])

    def fit_from(self, rows: IntArray, p: FloatArray) -> FloatArray:
        """Parameters ``(n,)`` of the optimum of some rows that is nearest to others ``(n,)``."""
        return np.asarray(self._likeliest(rows[None], self.chart.to_free(p[None])[:, None])[0])

    def steps_without(self, groups: Sequence[IntArray], rows: IntArray, p: FloatArray) -> FloatArray:
        """Parameters ``(n_groups, n)`` without each group of positions in the rows, by one step from the fit of all.

        Parameters
        ----------
        groups : sequence of int array
            Positions in ``rows``.
        rows : (n,) int array
        p : (n,) array
            Fit of all rows.
        """
        free, r = self.chart.to_free(p[None]), len(self._scale)
        errors, J = (x[0].reshape(len(rows), r, *x.shape[2:]) for x in self.errors(rows[None], free))
        H, slope = np.einsum("nri,nrj->ij", J, J), np.einsum("nri,nr->i", J, errors)
        if len(self._layout.with_prior):
            prior = self._prior_errors(np.array([np.square(errors).mean()]), None)
            of_prior, slopes = (x[0] for x in prior.errors(p[None], self.chart.slope(free)))
            H, slope = H + slopes.T @ slopes, slope + slopes.T @ of_prior
        left = np.array([H - np.einsum("nri,nrj->ij", J[x], J[x]) for x in groups])
        slopes = np.array([slope - np.einsum("nri,nr->i", J[x], errors[x]) for x in groups])
        left += 1e-12 * np.einsum("kii->ki", left)[:, :, None] * np.eye(self._n_p)
        steps = np.nan_to_num(solve_definite(left, slopes))
        return self.chart.to_parameters(self.chart.clip(free - steps))

    def _fit_equal(self, rows: IntArray, shift: FloatArray | None = None) -> FloatArray:
        """Parameters ``(B, n_p)`` from row sets ``(B, n)``: each from the best of its followed starts."""
        starts, (n_sets, n) = self._starts, rows.shape
        few = rows[:, :: max(1, n // _ROWS_FOR_STARTS)]
        every = np.tile(np.arange(len(starts)), n_sets)
        errors, _ = self.errors(np.repeat(few, len(starts), axis=0), starts[every])
        costs = np.square(errors).sum(axis=1).reshape(n_sets, -1)
        best = np.argsort(costs, axis=1, kind="stable")[:, : self._settings.n_followed]
        followed = starts[best]
        if self._linear is not None:
            solved = self.chart.clip(self.chart.to_free(self._linear.select(list(rows)).fit()))
            followed = np.concatenate([solved[:, None], followed], axis=1)
        return self._likeliest(rows, followed, shift)

    def _likeliest(self, rows: IntArray, starts: FloatArray, shift: FloatArray | None = None) -> FloatArray:
        """Parameters ``(B, n_p)`` from row sets ``(B, n)``, each from the best of its starts ``(B, n_starts, n_p)``.

        The means of priors may be shifted ``(n_p,)``.
        """
        n_sets, n_starts = starts.shape[:2]
        every = np.repeat(rows, n_starts, axis=0)
        free, costs = self._descend(every, starts.reshape(-1, self._n_p))
        if len(self._layout.with_prior):
            least = costs.reshape(n_sets, -1).min(axis=1)
            prior = self._prior_errors(least / max(1, rows.shape[1] * len(self._scale) - self._n_p), shift)
            free, costs = self._descend(every, free, prior.of(np.repeat(np.arange(n_sets), n_starts)))
        winner = np.argmin(costs.reshape(n_sets, -1), axis=1)
        return self.chart.to_parameters(free.reshape(n_sets, -1, self._n_p)[np.arange(n_sets), winner])

    def _prior_errors(self, variance: FloatArray, shift: FloatArray | None) -> _PriorErrors:
        """Errors of the priors where the errors of the rows have a variance ``(n_sets,)``."""
        layout = self._layout
        # The errors have a standard deviation of 1e-5 of the accelerations, at least.
        sigma = np.sqrt(np.maximum(self._inflation * np.nan_to_num(variance), 1e-5**2))
        mean = layout.prior_mean if shift is None else layout.prior_mean + shift
        return _PriorErrors(
            layout.with_prior, mean[layout.with_prior], sigma[:, None] / layout.prior_std[layout.with_prior]
        )

    def _descend(
        self, rows: IntArray, free: FloatArray, prior: _PriorErrors | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Free coordinates ``(B, n_p)`` after steps from each start, and their sums of squares."""
        # Fits converge to rounding.
        return least_squares(_Lanes(self, rows, prior), free, self._settings.max_steps, 1e-14)

    def errors(
        self, rows: IntArray, free: FloatArray, prior: _PriorErrors | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Scaled errors ``(B, n r)`` and their Jacobian ``(B, n r, n_p)`` in free coordinates; those of priors last."""
        n_lanes = len(rows)
        p, slope = self.chart.to_parameters(free), self.chart.slope(free)
        flat = rows.reshape(-1)
        own = self._own(p, rows)
        a, da = self._evaluate(self._state[flat], self._inputs[flat], own)
        da = self._scattered(da.reshape(len(flat), own.shape[1], len(self._scale)).transpose(0, 2, 1), flat)
        with np.errstate(over="ignore", invalid="ignore"):
            errors = ((a - self._measured[flat]) / self._scale).reshape(n_lanes, -1)
            J = (da / self._scale[:, None]).reshape(n_lanes, -1, self._n_p) * slope[:, None, :]
        if self._missing.any():
            missing = self._missing[flat].reshape(n_lanes, -1)
            errors[missing], J[missing] = 0.0, 0.0
        # Squares of such errors overflow in a sum: the lane has diverged.
        bad = ~(np.all(np.abs(errors) < 1e140, axis=1) & np.all(np.abs(J) < 1e140, axis=(1, 2)))
        errors[bad], J[bad] = np.inf, 0.0
        if prior is None:
            return errors, J
        of_prior, slopes = prior.errors(p, slope)
        return np.hstack([errors, of_prior]), np.concatenate([J, slopes], axis=1)

    def _own(self, p: FloatArray, rows: IntArray) -> FloatArray:
        """Parameters of the model ``(B n, n_p)`` at each row of ``(B, n)``, from vectors ``(B, n_all)``."""
        if self._layout.is_shared:
            return np.repeat(p, rows.shape[1], axis=0)
        index = self._layout.index[self._log_of_row[rows]]
        return np.take_along_axis(p[:, None, :], index, axis=2).reshape(rows.size, -1)

    def _scattered(self, J: FloatArray, rows: IntArray) -> FloatArray:
        """Jacobian ``(B n, r, n_all)`` from that of each row's own parameters ``(B n, r, n_p)``."""
        if self._layout.is_shared:
            return J
        full = np.zeros((*J.shape[:2], self._n_p))
        index = np.broadcast_to(self._layout.index[self._log_of_row[rows]][:, None, :], J.shape)
        np.put_along_axis(full, index, J, axis=2)
        return full


@dataclass(frozen=True)
class _Lanes:
    """Fits of row sets ``(B, n)`` with errors of priors: the problem of `least_squares` in free coordinates."""

    bound: BoundNonlinear
    rows: IntArray
    prior: _PriorErrors | None

    def moved(self, now: FloatArray, step: FloatArray) -> FloatArray:
        return self.bound.chart.clip(now + step)

    def linearized(self, z: FloatArray, lanes: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        errors, J = self.bound.errors(self.rows[lanes], z, self.prior and self.prior.of(lanes))
        cost = np.square(errors).sum(axis=1)
        of_finite = np.where(np.isfinite(cost)[:, None], errors, 0.0)
        return cost, np.einsum("bni,bn->bi", J, of_finite), np.einsum("bni,bnj->bij", J, J)


@dataclass(frozen=True)
class _PriorErrors:
    """Errors of k priors in each of B lanes.

    Parameters
    ----------
    places : (k,) int array
        Positions of their parameters.
    mean : (k,) array
    weight : (B, k) array
        Standard deviation of the errors of the rows over that of the prior.
    """

    places: IntArray
    mean: FloatArray
    weight: FloatArray

    def of(self, lanes: IntArray) -> _PriorErrors:
        """The errors of some of the lanes."""
        return replace(self, weight=self.weight[lanes])

    def errors(self, p: FloatArray, slope: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Errors ``(B, k)`` at parameters ``(B, n)``, and their Jacobian ``(B, k, n)`` with ``slope = dp / d free``."""
        J = np.zeros((*self.weight.shape, p.shape[1]))
        J[:, np.arange(len(self.places)), self.places] = self.weight * slope[:, self.places]
        return self.weight * (p[:, self.places] - self.mean), J


def _usable(one: Segment, known: Sequence[int], shown: Sequence[int]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """States, inputs, and known accelerations and sensors of one log's usable rows; sensors may be NaN."""
    q, v, a = (x[one.valid] for x in one.state_arrays())
    measured = a[:, known]
    if shown:
        measured = np.hstack([measured, one.sensor_samples()[one.valid][:, shown]])
    return np.hstack([q, v]), one.acting_inputs()[one.valid], measured


def _standard_deviations(sensors: FloatArray) -> list[float]:
    """Standard deviation of the finite values of each sensor; 0 without any."""
    finite = [x[np.isfinite(x)] for x in sensors.T]
    return [float(x.std()) if len(x) else 0.0 for x in finite]


class ParameterChart:
    """Free coordinates of bounded parameters: the logarithm where a parameter is positive, itself elsewhere."""

    def __init__(self, parameters: Sequence[Parameter]) -> None:
        self._log = np.array([x.positive for x in parameters])
        lower = np.array([x.lower for x in parameters])
        upper = np.array([x.upper for x in parameters])
        with np.errstate(divide="ignore"):
            self._lower = np.where(self._log, np.maximum(np.log(np.maximum(lower, 0.0)), -_LOG_BOUND), lower)
            self._upper = np.where(self._log, np.minimum(np.log(np.maximum(upper, 0.0)), _LOG_BOUND), upper)

    def to_parameters(self, free: FloatArray) -> FloatArray:
        """Parameters ``(..., n_p)`` of free coordinates."""
        return np.where(self._log, np.exp(np.where(self._log, free, 0.0)), free)

    def to_free(self, parameters: FloatArray) -> FloatArray:
        """Free coordinates ``(..., n_p)`` of parameters."""
        return np.where(self._log, np.log(np.where(self._log, np.maximum(parameters, 1e-300), 1.0)), parameters)

    def slope(self, free: FloatArray) -> FloatArray:
        """``dp / d free``."""
        return np.where(self._log, self.to_parameters(free), 1.0)

    def clip(self, free: FloatArray) -> FloatArray:
        """Free coordinates within their bounds."""
        return np.clip(free, self._lower, self._upper)

    def starts(self, n: int) -> FloatArray:
        """Points ``(n, n_p)``: over the bounds where both are given, else over six decades about 1 on the open side."""
        rng = np.random.default_rng(20231003)
        shape = (n, len(self._log))
        spread = 3.0 * np.log(10.0)
        sizes, signs = np.exp(rng.uniform(-spread, spread, shape)), rng.choice([-1.0, 1.0], shape)
        lower, upper = np.isfinite(self._lower), np.isfinite(self._upper)
        points = np.where(lower, self._lower + sizes, np.where(upper, self._upper - sizes, signs * sizes))
        low = np.where(self._log, np.maximum(self._lower, -spread), self._lower)
        high = np.where(self._log, np.minimum(self._upper, spread), self._upper)
        low, high = (np.where(low < high, x, bound) for x, bound in ((low, self._lower), (high, self._upper)))
        both = lower & upper
        low, high = np.where(both, low, 0.0), np.where(both, high, 1.0)
        return self.clip(np.where(both, low + rng.uniform(0.0, 1.0, shape) * (high - low), points))


def _compiled(model: Model, known: Sequence[int], shown: Sequence[int]) -> Map:
    """Accelerations and sensors ``(N, r)`` and their ``d/dp (N, n_p r)``, column by column, of rows of (x, u, p)."""
    from diransac.simulation.compiler import compile_map

    x, u, p = (ca.SX.sym(n, model.dynamics.size1_in(i)) for i, n in enumerate("xup"))
    accelerations = model.dynamics(x, u, p)[1]
    a = accelerations[list(known)]
    if shown:
        a = ca.vertcat(a, model.readings(x, accelerations, u, p)[list(shown)])
    function = ca.Function("accelerations", [x, u, p], ca.cse([a, ca.densify(ca.jacobian(a, p))]))
    return compile_map(function)
