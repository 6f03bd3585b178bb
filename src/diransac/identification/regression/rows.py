"""Rows of the equations: ``W p = b`` of a dataset, robust least squares of rows of motions, and null spaces of rows."""

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
from diransac.identification.core.rows import GEMAN_MCCLURE, Rows, Solution, inclusive_bounds, solve
from diransac.identification.regression.uncertainty import CLEAR
from diransac.model import Model
from diransac.simulation.compiler import compile_map

EXACT = 1e-6
"""Residual over the size of terms that is exact."""


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


def motion_rows(dataset: Dataset) -> list[MotionRows]:
    """Rows of each log that count; 0 in signals that a log lacks."""
    parts = ((one.valid, (*one.state_arrays(), one.acting_inputs(), one.sensor_samples())) for one in dataset.segments)
    return [MotionRows(*(x[valid] for x in arrays)) for valid, arrays in parts]


@dataclass(frozen=True, eq=False, repr=False)
class RowsSolution:
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


def solved(model: Model, layout: ParameterLayout, logs: Sequence[MotionRows]) -> RowsSolution | None:
    """Solution of ``W p = b`` by iteratively reweighted least squares; None where no row is finite.

    Parameters
    ----------
    model : Model
    layout : ParameterLayout
    logs : sequence of MotionRows

    Returns
    -------
    RowsSolution or None
    """
    rows, _ = scaled_equations(model, layout, logs)
    found = robust_fit(rows) if len(rows.b) else None
    if found is None:
        return None
    sizes = np.abs(rows.residuals(found.p)), np.abs(rows.W) @ np.abs(found.p) + np.abs(rows.b)
    ratios = np.divide(*(np.median(x, axis=0) + np.finfo(float).tiny for x in sizes))
    # The information at the solution: rows that are outliers there inform of nothing.
    A = (rows.W * found.weights[:, :, None]).reshape(-1, rows.W.shape[2])
    size = np.sqrt(np.square(A).mean(axis=0))
    unit = A / size_or_one(size)
    space = null_space(unit.T @ unit, size_or_one(size), 1e-9 * len(A))
    return RowsSolution(found.p, found.errors(), np.maximum(ratios, EXACT), space, bool(rows.b.any()))


def robust_fit(rows: Rows, bounds: tuple[FloatArray, FloatArray] | None = None) -> Solution | None:
    """Robust least squares of scaled equations, of which many rows may be outliers; None if it overflows.

    Parameters
    ----------
    rows : Rows
        As from `scaled_equations`.
    bounds : pair of (n,) array, optional
        Lower and upper.
    """
    try:
        found = solve(rows, bounds=bounds, loss=GEMAN_MCCLURE)
    except np.linalg.LinAlgError:
        return None
    return found if np.isfinite(rows.residuals(found.p)).all() else None


def lacks_known_terms(model: Model, layout: ParameterLayout, logs: Sequence[MotionRows]) -> bool:
    """True if ``b = 0`` in each finite row of ``W p = b``, so that zero solves it.

    Parameters
    ----------
    model : Model
    layout : ParameterLayout
    logs : sequence of MotionRows
    """
    rows, _ = scaled_equations(model, layout, logs)
    return len(rows.b) > 0 and not rows.b.any()


def scaled_equations(model: Model, layout: ParameterLayout, logs: Sequence[MotionRows]) -> tuple[Rows, BoolArray]:
    """Finite rows of all logs, each equation of unit size; mask ``(N,)`` of these rows.

    Parameters
    ----------
    model : Model
    layout : ParameterLayout
    logs : sequence of MotionRows
        Of which 5,000 rows each are enough to find a cause, and more are left out.
    """
    parts = []
    for i, one in enumerate(logs):
        every = max(1, len(one.q) // 5000)
        few = [np.ascontiguousarray(x[::every]) for x in (one.q, one.v, one.a, one.u, one.y)]
        W, b = regression_rows(model, *few)
        parts.append((layout.scattered(W, i), b, _known_sizes(model, few, b)))
    W, b, sizes = map(np.concatenate, zip(*parts, strict=True))
    columns = np.concatenate([W, b[:, :, None], sizes[:, :, None]], axis=2)
    finite = (np.abs(columns) < 1e150).all(axis=(1, 2))  # whose squares do not overflow
    rows = Rows(W[finite], b[finite])
    return (rows.over(_sizes(rows, sizes[finite])) if finite.any() else rows), finite


def _known_sizes(model: Model, motion: Sequence[FloatArray], b: FloatArray) -> FloatArray:
    """Sizes ``(n, n_eq)`` of the known terms of equations, which may cancel in ``b``; of sensors, that of ``b``."""
    (sizes,) = compile_map(_known_terms(model))(*motion[:4])
    return np.concatenate([sizes, np.abs(b[:, sizes.shape[1] :])], axis=1)


@lru_cache(maxsize=64)
def _known_terms(model: Model) -> ca.Function:
    """Function ``(q, v, a, u) -> sum of |known terms|``: of each acceleration, each input, and the rest."""
    q, v, a, u = (ca.SX.sym(n, size) for n, size in list(model.argument_sizes.items())[:4])
    r = model.residual(q, v, a, u, ca.DM.zeros(model.n_p))
    moving = ca.vertcat(a, u)
    rest = ca.substitute(r, moving, ca.DM.zeros(moving.shape))
    sizes = ca.fabs(ca.jacobian(r, moving)) @ ca.fabs(moving) + ca.fabs(rest)
    return ca.Function("known", [q, v, a, u], [ca.densify(sizes)])


def _sizes(rows: Rows, known_terms: FloatArray) -> FloatArray:
    """Size ``(n_eq,)`` of each equation: the median of its known terms ``(n, n_eq)``.

    Parameters take up units of columns, so that these change no weight of one equation against another.  An equation
    without a known term has the size of its other terms, with the parameters that the others give.
    """
    size = np.array([np.median(x[x > 0.0]) if x.any() else 0.0 for x in known_terms.T])
    size = np.where(size > 1e-9 * size.max(), size, 0.0)
    known = size > 0.0
    if known.any() and not known.all():
        p = solve(Rows(rows.W[:, known], rows.b[:, known]), 1.0 / size[known]).p
        size = np.where(known, size, np.median(np.abs(rows.W) @ np.abs(p), axis=0))
    whole = np.median(np.abs(rows.W).sum(axis=2) + np.abs(rows.b), axis=0)
    return np.where(size > 0.0, size, size_or_one(whole))


def outside_bounds(layout: ParameterLayout, parameters: FloatArray, errors: FloatArray) -> list[str]:
    """Parameters that are outside of their bounds by more than chance.

    Parameters
    ----------
    layout : ParameterLayout
    parameters, errors : (n,) array
        Estimate with standard errors, each in its unit.
    """
    nearest = np.clip(parameters, *inclusive_bounds(layout.bounds, zero=True))
    far = np.abs(parameters - nearest) > CLEAR * errors
    outside = set(layout.violations(parameters))
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
    # Part of a column that the others leave, for which equations inform about a parameter.
    free = 1.0 / np.sqrt(np.diag(np.linalg.inv(A.T @ A + EXACT**2 * np.eye(A.shape[1]))))
    return np.asarray((norms > 0.0) & (free > 0.1))


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
