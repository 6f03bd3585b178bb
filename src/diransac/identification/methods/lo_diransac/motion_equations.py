"""The equations of a model on a fitted or smoothed motion: residuals, regressors, inertia and sizes of forces."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.identification.core.windows import discrepant_pairs
from diransac.identification.methods.lo_diransac.smoothing import split_signals
from diransac.simulation.compiler import compile_map

if TYPE_CHECKING:
    from diransac.identification.core.fit import Fit
    from diransac.identification.core.windows import Windows
    from diransac.identification.methods.lo_diransac.smoothing import Motion
    from diransac.model import Model
    from diransac.simulation.compiler import Map

_TINY = 1e-300


def unexplained(intervals: Windows, fit: Fit, parameters: FloatArray, *, recorded: bool = False) -> FloatArray:
    """``M^-1 r``: mean over each interval of the fitted accelerations that the model does not explain.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
    parameters : (n,) array
    recorded : bool, optional
        With noisy inputs as they were recorded, not as the fit corrects them.

    Returns
    -------
    (W, n_v) array
        0 where an interval has no row that counts.
    """
    p = _row_parameters(intervals, parameters)
    *motion, inputs = _motion(intervals, fit)
    residuals, _, M = _residual_map(intervals.model)(*motion, intervals.inputs if recorded else inputs, p)
    left = np.linalg.solve(_matrices(M, intervals.model.n_v), residuals[:, :, None])[:, :, 0]
    logged = intervals.counted[:, None].astype(float)
    return means_of_intervals(intervals, left * logged) / np.maximum(means_of_intervals(intervals, logged), _TINY)


def residuals_of_motion(
    intervals: Windows, fit: Fit, parameters: FloatArray
) -> tuple[tuple[FloatArray, ...], FloatArray, FloatArray, FloatArray]:
    """Residuals of the equations on the fitted motion, and their derivatives.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
    parameters : (n,) array

    Returns
    -------
    tuple of (N, ...) array
        q, v, a, the inputs as they act, and the model's parameters in every row.
    (N, n_v) array
        Residuals r.
    (N, n_v, n) array
        dr/dp, columns in the places of each log's parameters.
    (N, n_v, n_v) array
        M = dr/da.
    """
    model, motion, p = intervals.model, _motion(intervals, fit), _row_parameters(intervals, parameters)
    r, W, M = _residual_map(model)(*motion, p)
    rows = np.broadcast_to(p, (len(r), model.n_p))
    return (*motion, rows), r, _regressors(intervals, W), _matrices(M, model.n_v)


def equations_of_rows(
    model: Model, q: FloatArray, v: FloatArray, u: FloatArray, p: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Accelerations of the model at any states and inputs, and its regressors there.

    Parameters
    ----------
    model : Model
    q, v, u, p : (N, n) array
        In every row.

    Returns
    -------
    (N, n_v) array, (N, n_v, n_p) array
        Not finite where the model has no acceleration.
    """
    r, _, M = _residual_map(model)(q, v, np.zeros((len(q), model.n_v)), u, p)
    M = _matrices(M, model.n_v)
    usable = np.flatnonzero(np.isfinite(M).all(axis=(1, 2)) & np.isfinite(r).all(axis=1))
    usable = usable[np.linalg.matrix_rank(M[usable]) == model.n_v]
    a: FloatArray = np.full((len(q), model.n_v), np.nan)
    a[usable] = -np.linalg.solve(M[usable], r[usable, :, None])[:, :, 0]
    return a, regressors_of_rows(model, q, v, a, u, p)


def residuals_of_rows(
    model: Model, q: FloatArray, v: FloatArray, a: FloatArray, u: FloatArray, p: FloatArray
) -> FloatArray:
    """Residuals ``(N, n_v)`` of the model in every row, with any accelerations.

    Parameters
    ----------
    model : Model
    q, v, a, u, p : (N, n) array
    """
    return np.asarray(_residual_map(model)(q, v, a, u, p)[0])


def regressors_of_rows(
    model: Model, q: FloatArray, v: FloatArray, a: FloatArray, u: FloatArray, p: FloatArray
) -> FloatArray:
    """Regressors ``(N, n_v, n_p)`` of the model in every row, with any accelerations.

    Parameters
    ----------
    model : Model
    q, v, a, u, p : (N, n) array
    """
    return np.asarray(_matrices(_residual_map(model)(q, v, a, u, p)[1], model.n_p))


def inertia_slopes(model: Model, q: FloatArray, v: FloatArray, u: FloatArray, p: FloatArray) -> FloatArray:
    """Slopes ``(n_p,)`` of the logarithm of the inertia by each parameter: ``tr(M^-1 dM/dp) / n_v``, mean of rows.

    Parameters
    ----------
    model : Model
    q, v, u, p : (N, n) array
        In every row.
    """
    still = np.zeros((len(q), model.n_v))
    M = _matrices(_residual_map(model)(q, v, still, u, p)[2], model.n_v)
    at_rest = regressors_of_rows(model, q, v, still, u, p)
    columns = [regressors_of_rows(model, q, v, still + one, u, p) - at_rest for one in np.eye(model.n_v)]
    slopes = np.stack(columns, axis=3).transpose(0, 2, 1, 3)
    usable = np.flatnonzero(np.isfinite(M).all(axis=(1, 2)) & np.isfinite(slopes).all(axis=(1, 2, 3)))
    usable = usable[np.linalg.matrix_rank(M[usable]) == model.n_v]
    found = np.einsum("njii->j", np.linalg.solve(M[usable, None], slopes[usable]))
    return np.asarray(found / (max(len(usable), 1) * model.n_v))


def slopes_of_delays(intervals: Windows, motion: Sequence[FloatArray], parameters: FloatArray) -> FloatArray:
    """Changes of the residuals per sample of a delay of each input.

    Parameters
    ----------
    intervals : Windows
    motion : sequence of (N, ...) array
        q, v, a, and the inputs as they act.
    parameters : (n,) array

    Returns
    -------
    (N, n_v, n_u) array
    """
    *state, inputs = motion[:4]
    model, p, later = intervals.model, _row_parameters(intervals, parameters), intervals.later_inputs
    before, found = _residual_map(model)(*state, inputs, p)[0], np.zeros((len(inputs), model.n_v, model.n_u))
    for j, one in enumerate(np.eye(model.n_u)):
        found[:, :, j] = _residual_map(model)(*state, inputs + later * one, p)[0] - before
    return found


def discrepancy_units(intervals: Windows, motion: Motion, p: FloatArray) -> FloatArray:
    """Discrepancies that equal the inertial force of their equation.

    Parameters
    ----------
    intervals : Windows
    motion : Motion
        Smoothed motion over the rows of the intervals.
    p : (n,) array
        Parameters of a hypothesis.

    Returns
    -------
    (n_shared,) array
        Infinite for parameters.
    """
    force = inertial_forces(intervals, motion, p)
    force[force == 0.0] = 1.0  # nor do discrepancies of what is at rest
    level = np.append(1.0, np.sqrt(np.square(intervals.inputs).mean(axis=0)))
    level[level == 0.0] = 1.0  # the gain of an input that never acts stays at its prior
    equations, columns = np.array(discrepant_pairs(intervals.model)).T
    return np.concatenate([np.full(intervals.n_p, np.inf), force[equations] / level[columns]])


def parameter_units(intervals: Windows, motion: Motion, p: FloatArray) -> FloatArray:
    """Change of each parameter that equals the inertial force of an equation, or the spread of a sensor.

    Parameters
    ----------
    intervals : Windows
    motion : Motion
        Smoothed motion over the rows of the intervals.
    p : (n,) array
        Parameters of a hypothesis.

    Returns
    -------
    (n,) array
        The smallest over equations and sensors, each in its parameter's unit; 0 where a parameter never acts.
    """
    model = intervals.model
    W = _residual_map(intervals.model)(*_smoothed(intervals, motion), _row_parameters(intervals, p, logged=True))[1]
    logs = intervals.log_of_row[intervals.counted]
    W, aims = _matrices(W, model.n_p), inertial_forces(intervals, motion, p)
    if model.measurement is not None:
        S = _sensor_slopes(model)(*_smoothed(intervals, motion), _row_parameters(intervals, p, logged=True))[0]
        W = np.concatenate([W, _matrices(S, model.n_p)], axis=1)
        aims = np.concatenate([aims, motion.spread[-len(model.sensors) :]])
    sizes = np.sqrt(np.square(_by_log(intervals, W, logs)).mean(axis=0)).T
    smallest = (aims / np.maximum(sizes, _TINY)).min(axis=1)
    return np.asarray(np.where(sizes.any(axis=1), smallest, 0.0))


def inertial_forces(intervals: Windows, motion: Motion, p: FloatArray) -> FloatArray:
    """RMS of ``M a`` of each equation.

    Parameters
    ----------
    intervals : Windows
    motion : Motion
        Smoothed motion over the rows of the intervals.
    p : (n,) array
        Parameters of a hypothesis.

    Returns
    -------
    (n_v,) array
    """
    q, v, a, u = _smoothed(intervals, motion)
    n_v = intervals.model.n_v
    own = _row_parameters(intervals, p, logged=True)
    M = _residual_map(intervals.model)(q, v, a, u, own)[2].reshape(len(a), n_v, n_v)
    return np.asarray(np.sqrt(np.square(np.einsum("nji,nj->ni", M, a)).mean(axis=0)))


def _smoothed(intervals: Windows, motion: Motion) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Smoothed coordinates, velocities, accelerations and the inputs of all logged rows."""
    model, logged = intervals.model, intervals.counted
    q, v, a, _ = motion.parts(model, logged)
    return q, v, a, intervals.inputs[logged]


def _motion(intervals: Windows, fit: Fit) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Fitted coordinates, velocities, accelerations, and the inputs as they act, without noise, each (N, n)."""
    model = intervals.model
    series = intervals.rollouts.trajectories(intervals.batch(fit.shared, fit.x, fit.d))
    q, v, a, _ = split_signals(model, series.reshape(len(intervals.measured), -1))
    return (
        q,
        v,
        a,
        intervals.inputs + np.repeat(fit.d, intervals.length, axis=0) if intervals.noisy else intervals.inputs,
    )


def _row_parameters(intervals: Windows, values: FloatArray, *, logged: bool = False) -> FloatArray:
    """Parameters of the model: one vector for all rows, or (N, n_p) where logs differ; of logged rows, or all."""
    logs = intervals.log_of_row[intervals.counted] if logged else intervals.log_of_row
    return intervals.parameters_of(values[: intervals.n_p], logs)


def _regressors(intervals: Windows, columns: FloatArray) -> FloatArray:
    """Regressors (N, r, n) from matrices that were stored column by column; zero in other logs' parameters."""
    return _by_log(intervals, _matrices(columns, intervals.model.n_p), intervals.log_of_row)


def _by_log(intervals: Windows, W: FloatArray, logs: IntArray) -> FloatArray:
    """Regressors (N, r, n_p) of rows with their columns in the places of their logs (N, r, n)."""
    if intervals.layout.is_shared:
        return W
    full = np.zeros((*W.shape[:2], intervals.n_p))
    np.put_along_axis(full, np.broadcast_to(intervals.layout.index[logs][:, None, :], W.shape), W, axis=2)
    return full


@lru_cache(maxsize=64)
def _residual_map(model: Model) -> Map:
    """Residuals, and their derivatives with respect to parameters and accelerations, column by column."""
    q, v, a, u, p = (ca.SX.sym(n, model.residual.size1_in(i)) for i, n in enumerate("qvaup"))
    r = model.residual(q, v, a, u, p)
    slopes = [ca.densify(ca.jacobian(r, x)) for x in (p, a)]
    return compile_map(ca.Function("residuals", [q, v, a, u, p], [ca.densify(r), *slopes]))


@lru_cache(maxsize=64)
def _sensor_slopes(model: Model) -> Map:
    """Derivatives of the sensors with respect to parameters, column by column."""
    assert model.measurement is not None
    q, v, a, u, p = (ca.SX.sym(n, model.residual.size1_in(i)) for i, n in enumerate("qvaup"))
    S = ca.densify(ca.jacobian(model.measurement(q, v, a, u, p), p))
    return compile_map(ca.Function("sensor_slopes", [q, v, a, u, p], [S]))


def means_of_intervals(intervals: Windows, rows: FloatArray) -> FloatArray:
    """Mean of each interval.

    Parameters
    ----------
    intervals : Windows
    rows : (N, ...) array

    Returns
    -------
    (W, ...) array
    """
    return np.asarray(rows.reshape(len(intervals), intervals.length, *rows.shape[1:]).mean(axis=1))


def _matrices(columns: FloatArray, n_columns: int) -> FloatArray:
    """Matrices (N, r, n_columns) that were stored column by column."""
    return columns.reshape(len(columns), n_columns, -1).swapaxes(1, 2)
