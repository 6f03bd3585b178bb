"""Rows of ``W p = b``: the equations of a model, and its sensors where they are affine in the parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.simulation.compiler import compile_map

if TYPE_CHECKING:
    from diransac.model import Model

__all__ = ["regression_rows"]


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
