"""Rows of motions at which the equations are evaluated: their robust least squares, and what they inform about.

References
----------
Holland and Welsch 1977 (iteratively reweighted least squares).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.identification.identifiability import NullSpace, null_space, residual_slopes
from diransac.identification.regression import regression_rows

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset, ParameterLayout
    from diransac.model import Model

__all__ = ["MotionRows", "Solution", "excited", "motion_rows", "outside_bounds", "solved"]

# Steps of iteratively reweighted least squares, and the residual, in median ones, from which on a row counts less.
_STEPS, _FAR = 10, 3.0
# Rows of a log that are enough to find a cause, and for ranks; size from which on the square of a number overflows.
_ENOUGH_ROWS, _FEW_ROWS, _HUGE, _TINY, _ROUNDING = 5000, 1000, 1e150, 1e-300, 1e-9
# Residual of an equation, over its terms, that is exact.
_EXACT = 1e-6
# Eigenvalue of a log's rows, over their number, below which it is zero.
_RANK_OF_LOG = 1e-9
# Part of a parameter's column that those of the others leave where the equations inform about it.
_INFORMED = 0.1
# Standard errors of an estimate outside of its bounds that are no chance; batches of rows for them.
_CLEARLY, _BATCHES = 3.0, 30


@dataclass(frozen=True)
class MotionRows:
    """Rows of one log at which the equations are evaluated.

    Parameters
    ----------
    q, v, a, u : (N, n_q), (N, n_v), (N, n_v), (N, n_u) array
        Coordinates, velocities, accelerations and inputs, each in its unit.
    y : (N, n_y) array
        Sensors; NaN where one is missing.
    """

    q: FloatArray
    v: FloatArray
    a: FloatArray
    u: FloatArray
    y: FloatArray

    def corrected(self, model: Model, names: Sequence[str], factor: float, offset: float) -> MotionRows:
        """The rows with some inputs, coordinates and states of first order, with their derivatives, in another unit."""
        groups = (model.coordinates, model.rate_names, model.inputs)
        of_q, of_v, of_u = (np.array([n in names for n in group], float) for group in groups)
        own = np.array([n in model.first_order for n in model.rate_names], float) * of_v
        q, v, a, u = (
            x * (1.0 + (factor - 1.0) * of)
            for x, of in zip((self.q, self.v, self.a, self.u), (of_q, of_v, of_v, of_u), strict=True)
        )
        return MotionRows(q + offset * of_q, v + offset * own, a, u + offset * of_u, self.y)


def motion_rows(dataset: Dataset) -> list[MotionRows]:
    """Rows of each log that count; 0 in signals that a log lacks."""
    parts = ((one.valid, (*one.state_arrays(), one.acting_inputs(), one.sensor_samples())) for one in dataset.segments)
    return [MotionRows(*(x[valid] for x in arrays)) for valid, arrays in parts]


@dataclass(frozen=True)
class Solution:
    """Robust least squares of all rows of logs.

    Parameters
    ----------
    parameters, errors : (n,) array
        Each in its unit, whatever its bounds, and standard errors; infinite where the rows do not determine one.
    residuals : (n_eq,) array
        Median size of the residuals of each equation, over the median size of its terms.
    space : NullSpace
        Directions that the rows do not determine.
    has_known_terms : bool
        Whether b differs from zero in any row.
    """

    parameters: FloatArray
    errors: FloatArray
    residuals: FloatArray
    space: NullSpace
    has_known_terms: bool

    @property
    def residual(self) -> float:
        """Product of the residuals of the equations, as in a likelihood: those that nothing changes do not matter."""
        return float(np.prod(self.residuals))


def solved(model: Model, layout: ParameterLayout, logs: Sequence[MotionRows]) -> Solution | None:
    """Solution of ``W p = b`` by iteratively reweighted least squares; None where no row is finite.

    Parameters
    ----------
    model : Model
    layout : ParameterLayout
    logs : sequence of MotionRows

    Returns
    -------
    Solution or None
    """
    rows, n_equations = _equations(model, layout, logs)
    if not len(rows):
        return None
    scale = np.sqrt(np.square(rows).mean(axis=0))
    has_known_terms = bool(scale[-1] > 0.0)
    scale = np.where(scale > 0.0, scale, 1.0)
    rows = rows / scale
    A, y, size = rows[:, :-1], rows[:, -1], np.linalg.norm(rows, axis=1)
    weights = 1.0 / (1.0 + size / (np.median(size) + _TINY))
    for _ in range(_STEPS):
        p = np.linalg.lstsq(A * weights[:, None], y * weights, rcond=None)[0]
        residuals = np.abs(A @ p - y)
        if not np.isfinite(residuals).all():
            return None
        # Each equation has its own residuals: zeros satisfy one without a known term, and would outweigh the others.
        middle = np.median(residuals.reshape(-1, n_equations), axis=0) + _TINY
        weights = 1.0 / (1.0 + np.square(residuals.reshape(-1, n_equations) / (_FAR * middle))).ravel()
    whole = np.abs(A) @ np.abs(p) + np.abs(y)
    sizes = (np.median(x.reshape(-1, n_equations), axis=0) + _TINY for x in (residuals, whole))
    # The information at the solution: rows that are outliers there inform of nothing.
    weighted = A * weights[:, None]
    size = np.sqrt(np.square(weighted).mean(axis=0))
    size = np.where(size > 0.0, size, 1.0)
    units = scale[-1] / scale[:-1]
    return Solution(
        p * units,
        _errors(weighted, weights * (A @ p - y)) * units,
        np.maximum(np.divide(*sizes), _EXACT),
        null_space((weighted / size).T @ (weighted / size), size * scale[:-1], _RANK_OF_LOG * len(A)),
        has_known_terms,
    )


def _errors(A: FloatArray, residuals: FloatArray) -> FloatArray:
    """Standard errors ``(n,)`` of least squares, from sums of scores over batches of rows, in their order."""
    sums = np.add.reduceat(A * residuals[:, None], np.arange(0, len(A), max(1, len(A) // _BATCHES)), axis=0)
    H = A.T @ A
    inverse = np.linalg.pinv(H, hermitian=True)
    found = np.sqrt(np.square(sums @ inverse).sum(axis=0))
    return np.asarray(np.where(np.diag(H) > 0.0, found, np.inf))


def _equations(model: Model, layout: ParameterLayout, logs: Sequence[MotionRows]) -> tuple[FloatArray, int]:
    """Finite rows ``[W b]`` of all logs, ``(n, n_p + 1)``, each equation of unit size; number of equations."""
    parts = []
    for i, one in enumerate(logs):
        every = max(1, len(one.q) // _ENOUGH_ROWS)
        few = (np.ascontiguousarray(x[::every]) for x in (one.q, one.v, one.a, one.u, one.y))
        W, b = regression_rows(model, *few)
        W = layout.scattered(W, i)
        parts.append(np.concatenate([W, b[:, :, None]], axis=2))
    rows = np.concatenate(parts)
    rows = rows[(np.abs(rows) < _HUGE).all(axis=(1, 2))]
    if not len(rows):
        return np.empty((0, rows.shape[2])), rows.shape[1]
    return (rows / _sizes(rows)[:, None]).reshape(-1, rows.shape[2]), rows.shape[1]


def _sizes(rows: FloatArray) -> FloatArray:
    """Size ``(n_eq,)`` of each equation ``[W b]`` ``(n, n_eq, n_p + 1)``: the median of its known terms.

    Parameters take up units of columns, so that these change no weight of one equation against another.  An equation
    without a known term has the size of its other terms, with the parameters that the others give.
    """
    W, b = rows[:, :, :-1], np.abs(rows[:, :, -1])
    size = np.array([np.median(x[x > 0.0]) if x.any() else 0.0 for x in b.T])
    size = np.where(size > _ROUNDING * size.max(), size, 0.0)
    known = size > 0.0
    if known.any() and not known.all():
        A, y = ((x[:, known] / size[known, None]).reshape(-1, x.shape[2]) for x in (W, rows[:, :, -1:]))
        column = np.sqrt(np.square(A).mean(axis=0))
        column = np.where(column > 0.0, column, 1.0)
        p = np.linalg.lstsq(A / column, y[:, 0], rcond=None)[0] / column
        size = np.where(known, size, np.median(np.abs(W) @ np.abs(p), axis=0))
    whole = np.median(np.abs(rows).sum(axis=2), axis=0)
    return np.where(size > 0.0, size, np.where(whole > 0.0, whole, 1.0))


def outside_bounds(layout: ParameterLayout, found: Solution) -> list[str]:
    """Parameters that are outside of their bounds by more than chance.

    Parameters
    ----------
    layout : ParameterLayout
    found : Solution
    """
    lower, upper = np.array([(max(x.lower, 0.0) if x.positive else x.lower, x.upper) for x in layout.bounds]).T
    nearest = np.clip(found.parameters, lower, upper)
    far = np.abs(found.parameters - nearest) > _CLEARLY * found.errors
    outside = set(layout.violations(found.parameters))
    return [n for n, x in zip(layout.names, far, strict=True) if n in outside and x]


def excited(model: Model, layout: ParameterLayout, rows: Sequence[MotionRows], parameters: FloatArray) -> BoolArray:
    """Parameters ``(n,)`` about which the equations inform at an estimate, whatever the others are.

    Parameters
    ----------
    model : Model
    layout : ParameterLayout
    rows : sequence of MotionRows
    parameters : (n,) array
        Estimate, each in its unit.
    """
    slope, parts = residual_slopes(model), []
    for i, one in enumerate(rows):
        every = max(1, len(one.q) // _FEW_ROWS)
        p = layout.of_log(parameters, i)
        motion = (x[::every].T for x in (one.q, one.v, one.a, one.u))
        n = len(one.q[::every])
        J = np.array(ca.densify(slope(*motion, np.repeat(p[:, None], n, axis=1)))).reshape(-1, n, model.n_p)
        parts.append(layout.scattered(J.transpose(1, 0, 2), i))
    J = np.concatenate(parts)
    J = J[np.isfinite(J).all(axis=(1, 2))]
    size = np.median(np.abs(J).max(axis=2), axis=0) if len(J) else np.ones(J.shape[1])
    A = (J / np.where(size > 0.0, size, 1.0)[:, None]).reshape(-1, J.shape[2])
    norms = np.linalg.norm(A, axis=0)
    A = A / np.where(norms > 0.0, norms, 1.0)
    free = [np.linalg.norm(x - others @ np.linalg.lstsq(others, x, rcond=None)[0]) for x, others in _each(A)]
    return np.asarray((norms > 0.0) & (np.array(free) > _INFORMED))


def _each(A: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Each column, and the others."""
    yield from ((A[:, k], np.delete(A, k, axis=1)) for k in range(A.shape[1]))
