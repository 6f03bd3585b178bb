"""Nonlinear least squares of the accelerations, for models that are not affine in their parameters.

The error is that of the predicted acceleration, not that of the equation: equations can be multiplied by any function
of the parameters, and their error vanishes wherever that function does; an acceleration's cannot.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from diransac.estimators import BoundEstimator, loose_parameters, smallest_eigenvalue, solve_definite
from diransac.model import Model, Parameter
from diransac.observations import Observations

__all__ = ["NonlinearLeastSquares"]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

_START_DECADES = 3.0
_DAMPING = (1e-3, 1e-12, 1e12)


@dataclass(frozen=True)
class NonlinearLeastSquares:
    """Least squares of ``(a - a_model(q, v, u, p)) / rms(a)`` within the parameters' bounds.

    No starting value is asked for: ``n_starts`` points spread over six decades, or over the bounds, are evaluated on
    the rows to be fitted, and the best few are followed by Levenberg and Marquardt's method.

    Parameters
    ----------
    n_starts : starting points evaluated
    n_followed : of them, those that are followed
    max_steps : steps of each
    min_eigenvalue : as in `OrdinaryLeastSquares`, for the Jacobian at the fit of the whole log

    References: Levenberg 1944; Marquardt 1963; Transtrum and Sethna 2012 for the damping.
    """

    n_starts: int = 200
    n_followed: int = 3
    max_steps: int = 60
    min_eigenvalue: float = 1e-6

    def bind(self, observations: Observations) -> BoundEstimator:
        """The estimator over the usable rows of a log."""
        return _BoundNonlinear(self, observations)


class _BoundNonlinear:
    """Accelerations of the usable rows, and the model that predicts them."""

    def __init__(self, settings: NonlinearLeastSquares, observations: Observations) -> None:
        self._settings = settings
        model = observations.model
        q, v, a = (x[observations.valid] for x in observations.state_arrays())
        known = [i for i, n in enumerate(model.accelerations) if n in observations.signals]
        self._state, self._inputs = np.hstack([q, v]), observations.inputs[observations.valid]
        self._accelerations = a[:, known]
        self._scale = np.sqrt(np.square(self._accelerations).mean(axis=0))
        self._scale[self._scale == 0.0] = 1.0
        self._chart = _Chart(tuple(model.parameters.values()))
        self._evaluate = _compiled(model, known)
        self.n_rows = len(self._state)
        everything = np.arange(self.n_rows)
        self._whole = self._fit_one(everything[:: max(1, self.n_rows // 2000)])
        _, J = self._errors(everything[None], self._chart.to_free(self._whole)[None])
        J = J[0].reshape(self.n_rows, len(known), -1)
        scale = np.sqrt(np.square(J).mean(axis=(0, 1)))
        J = J / np.where(scale > 0.0, scale, 1.0)
        self._blocks = np.einsum("nri,nrj->nij", J, J)

    def well_defined(self, row_sets: Sequence[IntArray]) -> BoolArray:
        gram = np.array([self._blocks[rows].sum(axis=0) for rows in row_sets])
        return smallest_eigenvalue(gram) > self._settings.min_eigenvalue

    def undetermined(self) -> tuple[int, ...]:
        return loose_parameters(self._blocks.sum(axis=0), self._settings.min_eigenvalue)

    def fit(self, row_sets: Sequence[IntArray]) -> FloatArray:
        return np.array([self._fit_one(rows) for rows in row_sets]).reshape(len(row_sets), -1)

    def fit_without(self, groups: Sequence[IntArray], rows: IntArray) -> FloatArray:
        return self.fit([np.setdiff1d(rows, group) for group in groups])

    def _fit_one(self, rows: IntArray) -> FloatArray:
        """Parameters ``(n_p,)`` from one set of rows: the best of the followed starts."""
        starts = self._chart.starts(self._settings.n_starts)
        if hasattr(self, "_whole"):
            starts = np.vstack([self._chart.to_free(self._whole), starts])
        few = rows[:: max(1, len(rows) // 100)]
        costs = self._costs(np.broadcast_to(few, (len(starts), len(few))), starts)
        best = np.argsort(costs, kind="stable")[: self._settings.n_followed]
        lanes = np.broadcast_to(rows, (len(best), len(rows)))
        free, costs = self._descend(lanes, starts[best])
        return self._chart.to_parameters(free[int(np.argmin(costs))])

    def _descend(self, rows: IntArray, free: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Levenberg-Marquardt on every lane at once; a lane that gains nothing more stays where it is."""
        damping = np.full(len(free), _DAMPING[0])
        errors, J = self._errors(rows, free)
        costs = np.square(errors).sum(axis=1)
        for _ in range(self._settings.max_steps):
            H = np.einsum("bni,bnj->bij", J, J)
            slope = np.einsum("bni,bn->bi", J, errors)
            diagonal = np.einsum("bii->bi", H)
            H = H + (damping[:, None] * (diagonal + 1e-12))[:, :, None] * np.eye(free.shape[1])
            trial = self._chart.clip(free - np.nan_to_num(solve_definite(H, slope)))
            trial_errors, trial_J = self._errors(rows, trial)
            trial_costs = np.square(trial_errors).sum(axis=1)
            gained = trial_costs < costs
            stalled = np.where(gained, costs - trial_costs <= 1e-14 * costs, damping >= _DAMPING[2])
            free = np.where(gained[:, None], trial, free)
            errors = np.where(gained[:, None], trial_errors, errors)
            J = np.where(gained[:, None, None], trial_J, J)
            costs = np.where(gained, trial_costs, costs)
            damping = np.clip(np.where(gained, damping / 10.0, damping * 4.0), *_DAMPING[1:])
            if stalled.all():
                break
        return free, costs

    def _costs(self, rows: IntArray, free: FloatArray) -> FloatArray:
        """Sum of squares ``(B,)``, infinite where it is not finite."""
        return np.square(self._errors(rows, free)[0]).sum(axis=1)

    def _errors(self, rows: IntArray, free: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Scaled errors ``(B, n r)`` and their Jacobian ``(B, n r, n_p)`` in the free coordinates."""
        n_lanes, n = rows.shape
        p, slope = self._chart.to_parameters(free), self._chart.slope(free)
        flat = rows.reshape(-1)
        a, da = self._evaluate(self._state[flat], self._inputs[flat], np.repeat(p, n, axis=0))
        errors = ((a - self._accelerations[flat]) / self._scale).reshape(n_lanes, -1)
        da = da.reshape(len(flat), len(slope[0]), len(self._scale)).transpose(0, 2, 1) / self._scale[:, None]
        J = da.reshape(n_lanes, -1, len(slope[0])) * slope[:, None, :]
        bad = ~(np.isfinite(errors).all(axis=1) & np.isfinite(J).all(axis=(1, 2)))
        errors[bad], J[bad] = np.inf, 0.0
        return errors, J


class _Chart:
    """Free coordinates of bounded parameters: the logarithm where a parameter is positive, itself elsewhere."""

    def __init__(self, parameters: Sequence[Parameter]) -> None:
        self._log = np.array([x.positive for x in parameters])
        lower = np.array([x.lower for x in parameters])
        upper = np.array([x.upper for x in parameters])
        with np.errstate(divide="ignore"):
            self._lower = np.where(self._log, np.log(np.maximum(lower, 1e-300)), lower)
            self._upper = np.where(self._log, np.log(np.maximum(upper, 1e-300)), upper)

    def to_parameters(self, free: FloatArray) -> FloatArray:
        return np.where(self._log, np.exp(np.where(self._log, free, 0.0)), free)

    def to_free(self, parameters: FloatArray) -> FloatArray:
        return np.where(self._log, np.log(np.where(self._log, np.maximum(parameters, 1e-300), 1.0)), parameters)

    def slope(self, free: FloatArray) -> FloatArray:
        """``dp / d free``."""
        return np.where(self._log, self.to_parameters(free), 1.0)

    def clip(self, free: FloatArray) -> FloatArray:
        return np.clip(free, self._lower, self._upper)

    def starts(self, n: int) -> FloatArray:
        """Points ``(n, n_p)``: six decades about 1 where a side is open, the bounds where both are given."""
        rng = np.random.default_rng(20231003)
        shape = (n, len(self._log))
        decades = _START_DECADES * np.log(10.0) * rng.uniform(-1.0, 1.0, shape)
        sizes, signs = np.exp(decades), rng.choice([-1.0, 1.0], shape)
        lower, upper = np.isfinite(self._lower), np.isfinite(self._upper)
        points = np.where(lower, self._lower + sizes, np.where(upper, self._upper - sizes, signs * sizes))
        points = np.where(self._log, decades, points)
        both = lower & upper
        span = np.where(both, self._upper, 1.0) - np.where(both, self._lower, 0.0)
        inside = np.where(both, self._lower, 0.0) + rng.uniform(0.0, 1.0, shape) * span
        return self.clip(np.where(both, inside, points))


def _compiled(model: Model, known: Sequence[int]) -> Callable[..., tuple[FloatArray, FloatArray]]:
    """Accelerations ``(N, r)`` and ``da/dp (N, n_p r)``, column by column, of rows of (x, u, p)."""
    from diransac.kernel import compile_map

    x, u, p = (ca.SX.sym(n, model.dynamics.size1_in(i)) for i, n in enumerate("xup"))
    a = model.dynamics(x, u, p)[1][list(known)]
    function = ca.Function("accelerations", [x, u, p], ca.cse([a, ca.densify(ca.jacobian(a, p))]))
    return compile_map(function)  # type: ignore[no-any-return]
