"""Rows of the equations: ``W p = b`` of a dataset, robust least squares of rows of motions, and null spaces of rows.

References
----------
Holland and Welsch 1977 (iteratively reweighted least squares).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray, size_or_one
from diransac.data import preprocessing
from diransac.data.dataset import Dataset, ParameterLayout
from diransac.data.segment import Segment
from diransac.identification.regression.uncertainty import CLEAR
from diransac.model import Model
from diransac.simulation.compiler import compile_map

_TINY = 1e-300


@dataclass(frozen=True, eq=False, repr=False)
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


@dataclass(frozen=True, eq=False, repr=False)
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
    scale = size_or_one(scale)
    rows = rows / scale
    A, y, size = rows[:, :-1], rows[:, -1], np.linalg.norm(rows, axis=1)
    weights = 1.0 / (1.0 + size / (np.median(size) + _TINY))
    for _ in range(10):
        p = np.linalg.lstsq(A * weights[:, None], y * weights, rcond=None)[0]
        residuals = np.abs(A @ p - y)
        if not np.isfinite(residuals).all():
            return None
        # Each equation has its own residuals: zeros satisfy one without a known term, and would outweigh the others.
        middle = np.median(residuals.reshape(-1, n_equations), axis=0) + _TINY
        weights = 1.0 / (1.0 + np.square(residuals.reshape(-1, n_equations) / (3.0 * middle))).ravel()
    whole = np.abs(A) @ np.abs(p) + np.abs(y)
    sizes = (np.median(x.reshape(-1, n_equations), axis=0) + _TINY for x in (residuals, whole))
    # The information at the solution: rows that are outliers there inform of nothing.
    weighted = A * weights[:, None]
    size = size_or_one(np.sqrt(np.square(weighted).mean(axis=0)))
    units = scale[-1] / scale[:-1]
    # A residual of a millionth of the terms is exact.
    return Solution(
        p * units,
        _errors(weighted, weights * (A @ p - y)) * units,
        np.maximum(np.divide(*sizes), 1e-6),
        null_space((weighted / size).T @ (weighted / size), size * scale[:-1], 1e-9 * len(A)),
        has_known_terms,
    )


def lacks_known_terms(model: Model, layout: ParameterLayout, logs: Sequence[MotionRows]) -> bool:
    """True if ``b = 0`` in each finite row of ``W p = b``, so that zero solves it.

    Parameters
    ----------
    model : Model
    layout : ParameterLayout
    logs : sequence of MotionRows
    """
    rows, _ = _equations(model, layout, logs)
    return len(rows) > 0 and not rows[:, -1].any()


def _errors(A: FloatArray, residuals: FloatArray) -> FloatArray:
    """Standard errors ``(n,)`` of least squares, from sums of scores over 30 batches of rows, in their order."""
    sums = np.add.reduceat(A * residuals[:, None], np.arange(0, len(A), max(1, len(A) // 30)), axis=0)
    H = A.T @ A
    inverse = np.linalg.pinv(H, hermitian=True)
    found = np.sqrt(np.square(sums @ inverse).sum(axis=0))
    return np.asarray(np.where(np.diag(H) > 0.0, found, np.inf))


def _equations(model: Model, layout: ParameterLayout, logs: Sequence[MotionRows]) -> tuple[FloatArray, int]:
    """Finite rows ``[W b]`` of all logs, ``(n, n_p + 1)``, each equation of unit size; number of equations."""
    parts = []
    for i, one in enumerate(logs):
        every = max(1, len(one.q) // 5000)  # enough to find a cause
        few = (np.ascontiguousarray(x[::every]) for x in (one.q, one.v, one.a, one.u, one.y))
        W, b = regression_rows(model, *few)
        W = layout.scattered(W, i)
        parts.append(np.concatenate([W, b[:, :, None]], axis=2))
    rows = np.concatenate(parts)
    rows = rows[(np.abs(rows) < 1e150).all(axis=(1, 2))]  # whose squares do not overflow
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
    size = np.where(size > 1e-9 * size.max(), size, 0.0)
    known = size > 0.0
    if known.any() and not known.all():
        A, y = ((x[:, known] / size[known, None]).reshape(-1, x.shape[2]) for x in (W, rows[:, :, -1:]))
        column = size_or_one(np.sqrt(np.square(A).mean(axis=0)))
        p = np.linalg.lstsq(A / column, y[:, 0], rcond=None)[0] / column
        size = np.where(known, size, np.median(np.abs(W) @ np.abs(p), axis=0))
    whole = np.median(np.abs(rows).sum(axis=2), axis=0)
    return np.where(size > 0.0, size, size_or_one(whole))


def outside_bounds(layout: ParameterLayout, found: Solution) -> list[str]:
    """Parameters that are outside of their bounds by more than chance.

    Parameters
    ----------
    layout : ParameterLayout
    found : Solution
    """
    lower, upper = np.array([(max(x.lower, 0.0) if x.positive else x.lower, x.upper) for x in layout.bounds]).T
    nearest = np.clip(found.parameters, lower, upper)
    far = np.abs(found.parameters - nearest) > CLEAR * found.errors
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
        every = max(1, len(one.q) // 1000)  # enough for ranks
        p = layout.of_log(parameters, i)
        motion = (x[::every].T for x in (one.q, one.v, one.a, one.u))
        n = len(one.q[::every])
        J = np.array(ca.densify(slope(*motion, np.repeat(p[:, None], n, axis=1)))).reshape(-1, n, model.n_p)
        parts.append(layout.scattered(J.transpose(1, 0, 2), i))
    J = np.concatenate(parts)
    J = J[np.isfinite(J).all(axis=(1, 2))]
    size = np.median(np.abs(J).max(axis=2), axis=0) if len(J) else np.ones(J.shape[1])
    A = (J / size_or_one(size)[:, None]).reshape(-1, J.shape[2])
    norms = np.linalg.norm(A, axis=0)
    A = A / size_or_one(norms)
    pairs = ((A[:, k], np.delete(A, k, axis=1)) for k in range(A.shape[1]))
    free = [np.linalg.norm(x - others @ np.linalg.lstsq(others, x, rcond=None)[0]) for x, others in pairs]
    # Equations inform about a parameter if the other columns leave a tenth of its own.
    return np.asarray((norms > 0.0) & (np.array(free) > 0.1))


def regression_rows(
    model: Model, q: FloatArray, v: FloatArray, a: FloatArray, u: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """``W`` and ``b`` of the r equations of a model, eqs. (1) and (5), followed by those of its sensors.

    A sensor ``y = S p + c`` gives the row ``S p = y - c``.

    Parameters
    ----------
    model : Model
    q, v, a, u, y : (N, n) array
        Coordinates, velocities, accelerations, inputs and sensors, each in its unit.  A sensor is NaN where it is not
        measured.

    Returns
    -------
    W : (N, r, n_p) array
    b : (N, r) array
        Zero, as in ``W``, in rows of sensors that are not measured, or not affine in the parameters.
    """
    W, b = compile_map(model.regressor)(q, v, a, u)
    W = W.reshape(len(b), model.n_p, model.n_v).transpose(0, 2, 1)
    if not model.sensors:
        return W, b
    S, c = compile_map(model.sensor_regressor)(q, v, a, u)
    S = S.reshape(len(c), model.n_p, -1).transpose(0, 2, 1)
    affine = [n in model.affine_sensors for n in model.sensors]
    used = np.isfinite(y) & affine
    S, known = np.where(used[:, :, None], S, 0.0), np.where(used, y - c, 0.0)
    return np.concatenate([W, S], axis=1), np.concatenate([b, known], axis=1)


def regression(dataset: Dataset) -> tuple[FloatArray, FloatArray]:
    """``W (N, r, n)`` and ``b (N, r)`` of the rows that count, eqs. (1) and (5), log after log.

    Sensors that are affine in the parameters are further equations; their rows are zero where a signal in them is
    missing.  Where a log's signals were derived by a filter, the same filter acts on both sides of the equation.  A
    per-log parameter has a column per log, which is zero in the rows of the others.

    Parameters
    ----------
    dataset : Dataset

    Returns
    -------
    W : (N, r, n) array
        Regressors of the r equations at each row, with respect to n parameters.
    b : (N, r) array
        Right-hand sides.
    """
    parts = [_segment_regression(one) for one in dataset.segments]
    W = [dataset.layout.scattered(W, i) for i, (W, _) in enumerate(parts)]
    if len(parts) == 1:
        return W[0], parts[0][1]
    return np.concatenate(W), np.concatenate([b for _, b in parts])


def _segment_regression(one: Segment) -> tuple[FloatArray, FloatArray]:
    """Rows of one log in its own parameters."""
    log = one.log
    W, b = regression_rows(one.model, *one.state_arrays(), one.acting_inputs(), one.sensor_samples())
    W, b = (preprocessing.filter_rows(log.filter, log.dt, rows, one.valid) for rows in (W, b))
    return np.ascontiguousarray(W[one.valid]), np.ascontiguousarray(b[one.valid])


PART_OF_NULL_VECTOR = 0.1
"""Entry from which on a parameter takes part in a null vector of a log."""


@dataclass(frozen=True, eq=False, repr=False)
class NullSpace:
    """Directions in which parameters can change without an effect on rows ``W p``.

    Parameters
    ----------
    directions : (d, n) array
        Orthonormal, in parameters times ``scale``.
    scale : (n,) array
        Size of each column of W, positive.
    """

    directions: FloatArray
    scale: FloatArray

    def of(self, group: IntArray) -> NullSpace:
        """The part of a group of parameters that are not connected with others."""
        _, sizes, rows = np.linalg.svd(self.directions[:, group])
        return NullSpace(rows[: int((sizes > PART_OF_NULL_VECTOR).sum())], self.scale[group])

    def complement(self) -> FloatArray:
        """Coefficients ``(n - d, n)`` of the combinations that are determined."""
        rows = np.linalg.svd(self.directions)[2][len(self.directions) :]
        return np.asarray(rows * self.scale)

    def in_units_of(self, scale: FloatArray) -> FloatArray:
        """Projector ``(n, n)`` onto the directions in parameters times another scale."""
        rows = np.linalg.svd(self.directions / self.scale * scale, full_matrices=False)[2]
        return np.asarray(rows.T @ rows)


def null_space(gram: FloatArray, scale: FloatArray, threshold: float) -> NullSpace:
    """Null space of rows from the sum of ``W^T W``.

    Parameters
    ----------
    gram : (n, n) array
        The sum, with columns divided by ``scale``.
    scale : (n,) array
        Size of each column; 0 where it is zero.
    threshold : float
        Largest eigenvalue that is zero.

    Returns
    -------
    NullSpace

    Raises
    ------
    LinAlgError
        The sum is not finite, which says nothing of the motion.
    """
    if not np.isfinite(gram).all():
        raise np.linalg.LinAlgError("the information matrix is not finite")
    sizes, vectors = np.linalg.eigh(gram)
    return NullSpace(vectors[:, sizes <= threshold].T, size_or_one(scale))


@lru_cache(maxsize=64)
def residual_slopes(model: Model) -> ca.Function:
    """Function ``(q, v, a, u, p) -> d(r, y)/dp`` of the equations and the sensors.

    Parameters
    ----------
    model : Model
    """
    symbols = [ca.SX.sym(n, size) for n, size in model.argument_sizes.items()]
    outputs = model.residual(*symbols)
    if model.measurement is not None:
        outputs = ca.vertcat(outputs, model.measurement(*symbols))
    return ca.Function("slope", symbols, [ca.jacobian(outputs, symbols[4])])
