"""The input that holds a plant at rest."""

from __future__ import annotations

from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import PlanningError

if TYPE_CHECKING:
    from diransac.model import Model


__all__ = ["trim_of"]

_ITERATIONS = 30
_TOLERANCE = 1e-6


def trim_of(
    model: Model, parameters: FloatArray, coordinates: FloatArray, lower: FloatArray, upper: FloatArray
) -> FloatArray:
    """Inputs (n_u,) within their limits under which nothing accelerates at rest at these coordinates (n_q,).

    Gauss-Newton on the accelerations, each step a bounded linear least-squares problem; exact for a model that is
    affine in its inputs.

    Raises PlanningError: there are none within the limits, or none at all; it says which input would have to do what.
    """
    x = np.concatenate([coordinates, np.zeros(model.n_v)])
    unlimited = np.full(model.n_u, np.inf)
    trim, residual = _least_acceleration(model, parameters, x, lower, upper)
    scale = 1.0 + np.abs(_accelerations(model, parameters, x, np.zeros(model.n_u))).max()
    if np.abs(residual).max() <= _TOLERANCE * scale:
        return trim
    place = ", ".join(f"{n} = {v:g}" for n, v in zip(model.coordinates, coordinates, strict=True))
    free, left = _least_acceleration(model, parameters, x, -unlimited, unlimited)
    if np.isfinite(left).all() and np.abs(left).max() <= _TOLERANCE * scale:
        needs = ", ".join(
            f"{n} would have to be {v:.4g}, but may be {low:.4g} to {high:.4g}"
            for n, v, low, high in zip(model.inputs, free, lower, upper, strict=True)
            if not low <= v <= high
        )
        raise PlanningError(
            f'model "{model.name}" cannot rest at {place} with these parameters: {needs}; '
            "raise the input limits, or check the parameters"
        )
    worst = int(np.argmax(np.abs(np.nan_to_num(left, nan=np.inf))))
    name = list(model.accelerations)[worst]
    raise PlanningError(
        f'model "{model.name}" cannot rest at {place}: no inputs make {name} zero; '
        "start elsewhere, or say with trim= which inputs cost nothing"
    )


def _least_acceleration(
    model: Model, parameters: FloatArray, x: FloatArray, lower: FloatArray, upper: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Inputs with the smallest accelerations, and these."""
    from scipy.optimize import lsq_linear  # takes longer to import than all of planning

    u = np.clip(np.zeros(model.n_u), lower, upper)
    roomy = upper > lower
    for _ in range(_ITERATIONS):
        B = np.array(model.linearization(x, u, parameters)[1])[model.n_q :]
        a = _accelerations(model, parameters, x, u)
        if not (np.isfinite(B).all() and np.isfinite(a).all()):
            return u, np.full(model.n_v, np.nan)
        target = B[:, roomy] @ u[roomy] - a
        moved = u.copy()
        if roomy.any():
            moved[roomy] = lsq_linear(B[:, roomy], target, (lower[roomy], upper[roomy]), method="bvls").x
        close = np.allclose(moved, u, rtol=1e-13, atol=1e-13)
        u = moved
        if close:
            break
    return u, _accelerations(model, parameters, x, u)


def _accelerations(model: Model, parameters: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
    return np.array(model.dynamics(ca.DM(x), ca.DM(u), ca.DM(parameters))[1]).ravel()
