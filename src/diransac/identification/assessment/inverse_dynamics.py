"""Forces of the inputs as inverse dynamics predict them from the motion of a log.

In each equation ``r(q, v, a, u, p) = 0``, the force of the inputs is ``F = r(u_0) - r(u)``, where ``u_0`` are inputs
that exert none: zero, and the position itself where an input is its target.  The equation predicts ``F + r(u)``, with
the error r.  Motions are smoothed without the model, as lo-diransac begins with them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray, robust_std
from diransac.data.dataset import Dataset
from diransac.data.filters import median_filter
from diransac.errors import LogError
from diransac.identification.diagnosis import Resolution
from diransac.identification.methods.lo_diransac.method import LoDiransac
from diransac.identification.methods.lo_diransac.preparation import prepared
from diransac.identification.methods.lo_diransac.unmeasured import unmeasured_states
from diransac.model import Model


@dataclass(frozen=True)
class PredictedForces:
    """Forces of the inputs over one log.

    Parameters
    ----------
    velocities : (N, n_v) array
        Smoothed.
    forces : (N, n_v) array
        Of the inputs in each equation.
    errors : (N, n_v) array
        Predicted less these.
    counted : (N,) bool array
        Rows on which no spike of an input acts, and outside of gaps.
    """

    velocities: FloatArray
    forces: FloatArray
    errors: FloatArray
    counted: BoolArray


def force_errors(
    dataset: Dataset, parameters: Sequence[Mapping[str, float]], resolution: Resolution
) -> dict[str, float]:
    """Relative error of the predicted force of the inputs in each equation: RMS error over the RMS of the force, %.

    Rows on which a spike of an input acts do not count.

    Parameters
    ----------
    dataset : Dataset
        Held-out logs.
    parameters : sequence of mapping of str to float
        Those of each log.
    resolution : Resolution
        With the timing of the inputs.

    Returns
    -------
    dict of str to float
        By the coordinate or velocity of the equation; without equations in which no input acts.  Empty where nothing
        measures a state, or the logs are too short to be smoothed.
    """
    squares = list[FloatArray]()
    for one in predicted_forces(dataset, parameters, resolution):
        squares.append(np.array([np.square(x[one.counted]).sum(axis=0) for x in (one.forces, one.errors)]))
    if not squares:
        return {}
    of_force, of_error = np.sum(squares, axis=0)
    names = dataset.model.rate_names
    # Inputs exert no force in an equation where theirs is this small beside the largest.
    acting = of_force > 1e-9**2 * of_force.max(initial=0.0)
    return {n: float(100.0 * np.sqrt(e / f)) for n, f, e, x in zip(names, of_force, of_error, acting, strict=True) if x}


def predicted_forces(
    dataset: Dataset, parameters: Sequence[Mapping[str, float]], resolution: Resolution
) -> list[PredictedForces]:
    """Forces of the inputs, and as inverse dynamics predict them, of each log; arguments as `force_errors`."""
    if not dataset.model.has_equations:
        return []
    try:
        intervals, motion, _ = prepared(LoDiransac(), dataset)
    except LogError:
        return []
    if unmeasured_states(intervals):
        return []
    model, found = dataset.model, []
    for one, rows, own in zip(dataset.segments, intervals.rows_of_logs, parameters, strict=True):
        logged = np.arange(rows.start, rows.start + len(one))
        q, v, a, _ = motion.parts(model, logged)
        recorded = intervals.recorded[logged]
        u = _acting(recorded, resolution, one.log.dt)
        commanded = _without_spikes(recorded)
        clean = np.isclose(u, _acting(commanded, resolution, one.log.dt)).all(axis=1)
        p = np.repeat(model.parameter_vector(own)[:, None], len(one), axis=1)
        rest, errors = (np.array(model.residual(q.T, v.T, a.T, x.T, p)).T for x in (_without_force(model, q, v, u), u))
        found.append(PredictedForces(v, rest - errors, errors, clean & intervals.counted[logged]))
    return found


def _without_spikes(inputs: FloatArray) -> FloatArray:
    """Inputs ``(N, n_u)`` whose spikes of one or two samples are medians of five, where they have noise at all.

    The noise is white in second differences; a median of five differs from the middle by eight of it at a spike alone.
    """
    if len(inputs) < 5:
        return inputs
    noise, median = robust_std(np.diff(inputs, 2, axis=0), axis=0) / np.sqrt(6.0), median_filter(inputs, 5)
    return np.where((noise > 0.0) & (np.abs(inputs - median) > 8.0 * noise), median, inputs)


def _acting(inputs: FloatArray, resolution: Resolution, dt: float) -> FloatArray:
    """Inputs (N, n_u) that act around the instant of each row."""
    u = resolution.timing.acting(inputs, dt, resolution.hold)
    # Accelerations at a row are those between two inputs that are held.
    return 0.5 * (u + np.concatenate([u[:1], u[:-1]])) if resolution.hold == "zero-order" else u


def _without_force(model: Model, q: FloatArray, v: FloatArray, u: FloatArray) -> FloatArray:
    """Inputs (N, n_u) that exert no force: zero; of a target, the state itself.

    A target has the unit of a position or velocity, in whose equation alone it acts.
    """
    found = np.zeros_like(u)
    if model.kinematics is not None:
        return found
    acts = np.array(ca.DM(model.residual.sparsity_jac(3, 0), 1)) != 0.0
    for j, unit in enumerate(model.inputs.values()):
        (equations,) = np.nonzero(acts[:, j])
        if len(equations) != 1:
            continue
        for states, units in ((q, model.coordinates), (v, model.velocities)):
            if equations[0] < len(units) and list(units.values())[equations[0]] == unit:
                found[:, j] = states[:, equations[0]]
    return found
