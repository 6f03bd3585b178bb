"""Parameters from the most probable motion, and their covariance.

Where the model is right, the parameters of the fit are the parameters.  Where it is not, they share the explanation of
the log with the deviations, in proportions that depend on the noise.  What is wanted is what least squares would give
on noise-free data: the parameters for which the equations hold best, all deviations left over.  ``W p = b`` is solved
again, on the fitted motion, with instruments from which the latent accelerations are
left out: accelerations that noise has shaken would pull inertias towards zero.

The covariance has three parts: the fit's, carried through that solution; that of the latent forces that the parameters
do not make, as a sample of what acts on the machine, for another log would hold others; and the change of the answer
if the model were believed ten times less, for what deviates from a model in the same way all along is more than chance.

References: Plumlee 2017 (discrepancies orthogonal to the model); Janot, Vandanjon, Gautier 2014 (instruments from a
simulated model); White 1982 (inference under a wrong model); Hausman 1978 (what a less efficient estimate tells).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.methods.lo_diransac.normal_equations import linearize
from diransac.identification.methods.lo_diransac.refinement import weights_of
from diransac.simulation.compiler import compile_map

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.normal_equations import Fit
    from diransac.identification.methods.lo_diransac.smoothing import Motion
    from diransac.identification.methods.lo_diransac.windows import Windows
    from diransac.model import Model
    from diransac.simulation.compiler import Map

__all__ = ["Readout", "deviation_units", "read_out", "unexplained"]


_TINY = 1e-300
_DOUBT = 10.0


@dataclass(frozen=True)
class Readout:
    """What holds for the whole motion.

    Parameters
    ----------
    parameters, covariance : (n_p,), (n_p, n_p)
    unexplained : (W, n_v)   mean of each window's accelerations that the model with these parameters does not make
    delay_error : standard error of the delay, rows
    """

    parameters: FloatArray
    covariance: FloatArray
    unexplained: FloatArray
    delay_error: float


def read_out(windows: Windows, fit: Fit) -> Readout:
    """The parameters for which the equations hold best on the fitted motion, and their covariance."""
    found = _solution(windows, fit)
    change = _solution(windows, _doubting(windows, fit)).parameters - found.parameters
    return replace(found, covariance=found.covariance + np.outer(change, change))


def _doubting(windows: Windows, fit: Fit) -> Fit:
    """The fit, by one step, were the latent accelerations ten times as large as the evidence has them."""
    doubtful, n_x = replace(fit, tau=_DOUBT * fit.tau), fit.x.shape[1]
    at = linearize(windows, doubtful, weights_of(windows, fit))
    step = at.system.solve(at.right_z, at.right_s)
    x, d = fit.x + step.step_z[:, :n_x], fit.d + step.step_z[:, n_x:]
    return replace(doubtful, shared=fit.shared + step.step_p, x=x, d=d)


def _solution(windows: Windows, fit: Fit) -> Readout:
    """Parameters, and the first two parts of their covariance.

    In the fit they hold exactly, with the pushes and the latent accelerations besides: ``r(p) = push + M d``.  What the
    parameters could make of either is given back to them: of the pushes row by row; of the latent accelerations, which
    are constant over a window, by the windows' means.
    """
    model, n_p, n_s, n_x = windows.model, windows.model.n_p, len(fit.shared), fit.x.shape[1]
    by_rows, by_means, push, M = _gains(windows, fit)
    latent = np.einsum("wij,wj->wi", M, fit.d)
    p = fit.shared[:n_p] - np.einsum("pni,ni->p", by_rows, push) - np.einsum("pwi,wi->p", by_means, latent)
    of_s, of_z = np.zeros((n_s, n_p)), np.zeros((len(windows), n_x + model.n_v, n_p))
    level = np.hstack([np.ones((len(push), 1)), windows.inputs])
    of_s[:n_p] = np.eye(n_p)
    of_s[n_p:-1] = -np.einsum("pni,nk->ikp", by_rows, level).reshape(-1, n_p)
    of_z[:, n_x:] = -np.einsum("pwi,wij->wjp", by_means, M)
    at = linearize(windows, fit, weights_of(windows, fit))
    z, s = at.system.functional(of_z, of_s)
    covariance = np.einsum("wkc,wkd->cd", of_z, z) + of_s.T @ s
    sampled = _sampled(windows, fit, by_rows, by_means, push, latent)
    delay = at.system.solve(at.right_z, at.right_s).var_p[-1, -1]
    return Readout(p, covariance + sampled, unexplained(windows, fit, p), float(np.sqrt(delay)))


def _gains(windows: Windows, fit: Fit) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """What rows (n_p, N, n_v) and windows' means (n_p, W, n_v) do to parameters; pushes (N, n_v); mean M (W, n_v, n_v).

    The instruments are the regressors of the motion without its latent accelerations.
    """
    model = windows.model
    evaluate, (q, v, a, u) = _residual_map(model), _motion(windows, fit)
    quiet, p = a - np.repeat(fit.d, windows.length, axis=0), fit.shared[: model.n_p]
    push, Z, M = evaluate(q, v, quiet, u, p)
    W = evaluate(q, v, a, u, p)[1]
    logged = windows.is_logged[:, None]
    W, Z = _matrices(W * logged, model.n_p), _matrices(Z * logged, model.n_p)
    by_means = _instrumented(_means(windows, W), _means(windows, Z))
    return _instrumented(W, Z), by_means, push * logged, _means(windows, _matrices(M, model.n_v))


def _sampled(
    windows: Windows, fit: Fit, by_rows: FloatArray, by_means: FloatArray, push: FloatArray, latent: FloatArray
) -> FloatArray:
    """Covariance of the parameters over logs that hold other unmodelled forces than this one, which it estimates."""
    q, v, a, u = _motion(windows, fit)
    W = _residual_map(windows.model)(q, v, a, u, fit.shared[: windows.model.n_p])[1] * windows.is_logged[:, None]
    W = _matrices(W, windows.model.n_p)
    unmade = latent - _means(windows, W) @ np.einsum("pwi,wi->p", by_means, latent)
    unpushed = push - W @ np.einsum("pni,ni->p", by_rows, push)
    of_rows = np.einsum("pni,ni->np", by_rows, unpushed).reshape(len(windows), windows.length, -1).sum(axis=1)
    sums = _batch_sums(np.einsum("pwi,wi->wp", by_means, unmade) + of_rows)
    return np.asarray(sums.T @ sums)


def unexplained(windows: Windows, fit: Fit, parameters: FloatArray) -> FloatArray:
    """Mean accelerations (W, n_v) of the fitted motion that the model does not make: ``M^-1 r`` of the residuals."""
    residuals, _, M = _residual_map(windows.model)(*_motion(windows, fit), parameters)
    left = np.linalg.solve(_matrices(M, windows.model.n_v), residuals[:, :, None])[:, :, 0]
    logged = windows.is_logged[:, None].astype(float)
    return _means(windows, left * logged) / _means(windows, logged)


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
    series = windows.rollouts.trajectories(windows.lanes(fit.shared, fit.x, fit.d))
    series = series.reshape(len(windows.measured), -1)
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
    """Mean of each window, (W, ...)."""
    return np.asarray(rows.reshape(len(windows), windows.length, *rows.shape[1:]).mean(axis=1))


def _matrices(columns: FloatArray, n_columns: int) -> FloatArray:
    """Matrices (N, r, n_columns) that were stored column by column."""
    return columns.reshape(len(columns), n_columns, -1).swapaxes(1, 2)


def _instrumented(A: FloatArray, Z: FloatArray) -> FloatArray:
    """``(Z'A)^-1 Z'`` of stacked matrices (N, r, n_p), as (n_p, N, r); columns scaled to one."""
    rows, instruments = A.reshape(-1, A.shape[2]), Z.reshape(-1, A.shape[2])
    scale = np.linalg.norm(instruments, axis=0) + _TINY
    instruments = instruments / scale
    solved = np.linalg.lstsq(instruments.T @ (rows / scale), instruments.T, rcond=None)[0] / scale[:, None]
    return np.asarray(solved).reshape(-1, *A.shape[:2])
