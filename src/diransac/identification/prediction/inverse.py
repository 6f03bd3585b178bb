"""Inverse prediction: the forces of the inputs, from the smoothed motion of a log.

In each equation ``r(q, v, a, u, p) = 0``, the force of the inputs is ``F = r(u_0) - r(u)``, where ``u_0`` are inputs
that exert none: zero, and the position itself where an input is its target.  The equation predicts ``F + r(u)``, with
the error r.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.prediction.open_loop import OpenLoop
from diransac.model import Model


def force_errors(loops: Sequence[OpenLoop]) -> dict[str, float]:
    """RMS error of the predicted force of the inputs over the RMS of the force, %, by the name of the equation.

    Equations in which no input acts are left out.  Empty where nothing measures a state, or a log is too short to be
    smoothed.
    """
    model = loops[0].segment.model
    if not model.has_equations:
        return {}
    of_force, of_error = np.sum([_squares(model, x) for x in loops], axis=0)
    acting = of_force > np.square(1e-9) * of_force.max(initial=0.0)  # beyond rounding
    shares = 100.0 * np.sqrt(of_error[acting] / of_force[acting])
    return dict(zip(np.array(model.rate_names)[acting].tolist(), shares.tolist(), strict=True))


def _squares(model: Model, loop: OpenLoop) -> FloatArray:
    """Sums of squares ``(2, n_v)`` of the forces of the inputs, and of the errors of predicted ones."""
    if loop.smoothed is None:
        return np.zeros((2, model.n_v))
    q, v, a, _ = np.split(loop.smoothed.signals, np.cumsum([model.n_q, model.n_v, model.n_v]), axis=1)
    hold, log = loop.resolution.hold, loop.segment.log
    u = loop.resolution.timing.acting(loop.segment.inputs, log.dt, hold)
    if hold == "zero-order":  # accelerations at a row are those between two inputs that are held
        u = 0.5 * (u + np.concatenate([u[:1], u[:-1]]))
    p = np.repeat(loop.parameters[:, None], len(u), axis=1)
    rest, errors = (np.array(model.residual(q.T, v.T, a.T, x.T, p)).T for x in (_without_force(model, q, v, u), u))
    counted = np.isfinite(errors).all(axis=1) & ~loop.segment.gaps
    return np.asarray(np.square([rest - errors, errors])[:, counted].sum(axis=1))


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
        for states, units in ((q, model.coordinates), (v, model.velocities)):
            if len(equations) == 1 and list(units.values())[equations[0] : equations[0] + 1] == [unit]:
                found[:, j] = states[:, equations[0]]
    return found
