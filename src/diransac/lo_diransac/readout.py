"""Parameters from the most probable motion, and their covariance.

Where the model is right, the parameters of the fit are the parameters.  Where it is not, they share the explanation of
the log with the deviations, in proportions that depend on the noise.  What is wanted is what least squares would give
on noise-free data: the parameters for which the equations hold best, all deviations left over.  ``W p = b`` is solved
again, on the fitted motion, a window's mean at a time, with instruments from which the latent accelerations are
left out: accelerations that noise has shaken would pull inertias towards zero.

The covariance has two parts: the fit's, carried through that solution; and that of the latent forces that the
parameters do not make, as a sample of what acts on the machine: another log would hold others.

References: Plumlee 2017 (discrepancies orthogonal to the model); Janot, Vandanjon, Gautier 2014 (instruments from a
simulated model); White 1982 (inference under a wrong model).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
import numpy.typing as npt

from diransac.kernel import compile_map
from diransac.lo_diransac.normal_equations import linearize
from diransac.lo_diransac.refinement import weights_of

if TYPE_CHECKING:
    from diransac.kernel import Map
    from diransac.lo_diransac.normal_equations import Fit
    from diransac.lo_diransac.smoothing import Motion
    from diransac.lo_diransac.windows import Windows
    from diransac.model import Model

__all__ = ["Readout", "deviation_units", "read_out"]

FloatArray = npt.NDArray[np.float64]

_NEWTON_STEPS = 5
_TINY = 1e-300


@dataclass(frozen=True)
class Readout:
    """Parameters ``(n_p,)``, their covariance ``(n_p, n_p)``, and the standard error of the delay, rows."""

    parameters: FloatArray
    covariance: FloatArray
    delay_error: float


def read_out(windows: Windows, fit: Fit) -> Readout:
    """The parameters for which the equations hold best on the fitted motion."""
    model, n_p, n_s, n_x = windows.model, windows.model.n_p, len(fit.shared), fit.x.shape[1]
    q, v, a, u = _motion(windows, fit)
    quiet = a - np.repeat(fit.d, windows.length, axis=0)
    evaluate, p = _residual_map(model), fit.shared[:n_p].copy()
    for _ in range(_NEWTON_STEPS if model.nonlinear_parameters else 1):
        r, W, _ = (_means(windows, x) for x in evaluate(q, v, a, u, p))
        Z = _means(windows, evaluate(q, v, quiet, u, p)[1])
        gain = _instrumented(_matrices(W, n_p), _matrices(Z, n_p))
        p = p - gain @ r.ravel()
    freely = np.hstack([np.broadcast_to(fit.shared, (len(a), n_s)), np.repeat(fit.d, windows.length, axis=0)])
    slopes = _means(windows, _residual_map(windows.freed.model)(q, v, a, windows.moving_inputs, freely)[1])
    # d p = -gain dr, and dr = -(dr_freed / d(shared, d)): a deviation makes the force that the model lacks.
    effect = np.einsum("pwi,wji->wpj", gain.reshape(n_p, len(windows), -1), slopes.reshape(len(windows), -1, model.n_v))
    of_s, of_z = effect[:, :, :n_s].sum(axis=0).T, np.zeros((len(windows), n_x + model.n_v, n_p))
    of_s[-1] = 0.0  # the delayed inputs stand on both sides
    of_z[:, n_x:] = effect[:, :, n_s:].swapaxes(1, 2)
    at = linearize(windows, fit, weights_of(windows, fit))
    z, s = at.system.functional(of_z, of_s)
    covariance = np.einsum("wkc,wkd->cd", of_z, z) + of_s.T @ s
    latent = (_means(windows, evaluate(q, v, a, u, p)[0]) - _means(windows, evaluate(q, v, quiet, u, p)[0])).ravel()
    left = latent - _matrices(W, n_p) @ (gain @ latent)
    sampled = _batch_sums((gain * left).reshape(n_p, len(windows), -1).sum(axis=2).T)
    delay = at.system.solve(at.right_z, at.right_s).var_p[-1, -1]
    return Readout(p, covariance + sampled.T @ sampled, float(np.sqrt(delay)))


def deviation_units(windows: Windows, motion: Motion, p: FloatArray) -> FloatArray:
    """What each push would have to be to make all of its equation's inertial force; infinite for parameters."""
    force = inertial_forces(windows, motion, p)
    level = np.append(1.0, np.sqrt(np.square(windows.inputs).mean(axis=0)) + _TINY)
    return np.concatenate([np.full(windows.model.n_p, np.inf), (force[:, None] / level).ravel(), [1.0]])


def parameter_units(windows: Windows, motion: Motion, p: FloatArray) -> FloatArray:
    """The change of each parameter ``(n_p,)`` that would make all of some equation's inertial force."""
    model, N = windows.model, len(motion.signals)
    q, v, a = np.split(motion.signals, [model.n_q, model.n_q + model.n_v], axis=1)
    W = _residual_map(model)(q, v, a, windows.inputs[:N], p)[1]
    sizes = np.sqrt(np.square(W.reshape(N, model.n_p, model.n_v)).mean(axis=0))
    return np.asarray((inertial_forces(windows, motion, p) / np.maximum(sizes, _TINY)).min(axis=1))


def inertial_forces(windows: Windows, motion: Motion, p: FloatArray) -> FloatArray:
    """RMS of ``M a`` of each equation, (n_v,)."""
    model, N = windows.model, len(motion.signals)
    q, v, a = np.split(motion.signals, [model.n_q, model.n_q + model.n_v], axis=1)
    M = _residual_map(model)(q, v, a, windows.inputs[:N], p)[2].reshape(N, model.n_v, model.n_v)
    return np.asarray(np.sqrt(np.square(np.einsum("nji,nj->ni", M, a)).mean(axis=0)))


def _motion(windows: Windows, fit: Fit) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Fitted coordinates, velocities and accelerations, and the inputs as they act, each (N, n)."""
    model = windows.model
    series = windows.rollouts.trajectories(
        *windows.lanes(fit.shared, fit.x, fit.d), windows.dt, start_rows=windows.starts, n_rows=windows.length
    ).reshape(len(windows.measured), -1)
    q, v, a = np.split(series, [model.n_q, model.n_q + model.n_v], axis=1)
    return q, v, a, windows.inputs + fit.shared[-1] * windows.moving_inputs[:, model.n_u :]


def _residual_map(model: Model) -> Map:
    """Residuals, and their derivatives with respect to parameters and accelerations, column by column."""
    q, v, a, u, p = (ca.SX.sym(n, model.residual.size1_in(i)) for i, n in enumerate("qvaup"))
    r = model.residual(q, v, a, u, p)
    slopes = [ca.densify(ca.jacobian(r, x)) for x in (p, a)]
    return compile_map(ca.Function("residuals", [q, v, a, u, p], [ca.densify(r), *slopes]))


def _batch_sums(values: FloatArray) -> FloatArray:
    """Sums over about sqrt(W) neighbouring windows each: their squares count what neighbours have in common."""
    return np.add.reduceat(values, np.arange(0, len(values), round(np.sqrt(len(values)))), axis=0)


def _means(windows: Windows, rows: FloatArray) -> FloatArray:
    """Mean of each window, (W, n)."""
    return np.asarray(rows.reshape(len(windows), windows.length, -1).mean(axis=1))


def _matrices(columns: FloatArray, n_p: int) -> FloatArray:
    """Rows of all equations (W r, n_p) from matrices that were stored column by column."""
    W = columns.reshape(len(columns), n_p, -1).swapaxes(1, 2)
    return np.ascontiguousarray(W).reshape(-1, n_p)


def _instrumented(A: FloatArray, Z: FloatArray) -> FloatArray:
    """``(Z'A)^-1 Z'``, columns scaled to one."""
    scale = np.linalg.norm(Z, axis=0) + _TINY
    scaled = Z / scale
    return np.asarray(np.linalg.lstsq(scaled.T @ (A / scale), scaled.T, rcond=None)[0] / scale[:, None])
