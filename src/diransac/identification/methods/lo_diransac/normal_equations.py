"""The quadratic model of all windows together: measurements, continuity, and what is believed beforehand.

Unknowns are what all windows share (parameters, pushes, delay), and at the start of each window w the state x_w and
a latent acceleration d_w that acts over the window.  With ``F`` the rollout of a window, twice the cost is

    sum W |y - y(x_w, s, d_w)|^2 + sum |x_{w+1} - F(x_w, s, d_w)|^2 / slack^2 + sum |d_w|^2 / tau^2 + |s|^2 / prior^2

References: Bock 1987 (multiple shooting); Tremolet 2006 (weak-constraint 4D-Var).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from diransac.arrays import FloatArray
from diransac.identification.methods.lo_diransac.arrowhead import Arrowhead

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.mixture import Mixture
    from diransac.identification.methods.lo_diransac.windows import Windows

__all__ = ["Fit", "NormalEquations", "cost", "linearize"]


@dataclass(frozen=True)
class Fit:
    """A motion with its parameters, and the scales that say how far each part is believed.

    Parameters
    ----------
    shared : (n_s,)   parameters, pushes, input delay in rows
    x, d : (W, n_x), (W, n_v)   states at the windows' starts, latent accelerations
    residuals : (N, n_signals)   simulated less measured
    noise : of each signal
    tau : (n_v,)   size of the latent accelerations
    slack : (n_x,)   size of the jumps from window to window
    prior : (n_s,)   size of the pushes and of the delay; infinite for the parameters
    """

    shared: FloatArray
    x: FloatArray
    d: FloatArray
    residuals: FloatArray
    noise: Mixture
    tau: FloatArray
    slack: FloatArray
    prior: FloatArray


@dataclass(frozen=True)
class NormalEquations:
    """Blocks of the system at a fit, and its right-hand side: minus the gradient."""

    system: Arrowhead
    right_z: FloatArray
    right_s: FloatArray


def linearize(windows: Windows, fit: Fit, weights: FloatArray) -> NormalEquations:
    """Gauss and Newton's normal equations; ``weights (N, n_signals)`` are those of the measurements."""
    n_x, k = fit.x.shape[1], fit.x.shape[1] + fit.d.shape[1]
    sums = windows.rollouts.gauss_newton(windows.lanes(fit.shared, fit.x, fit.d), windows.measurements, weights)
    order = _order(len(fit.shared), n_x, k)
    H, g = sums.normal_matrix[:, order][:, :, order], -sums.gradient[:, order]
    F = sums.final_slopes[:-1][:, :, order]
    jumps = fit.x[1:] - sums.final_states[:-1]
    precision = 1.0 / np.square(fit.slack)
    FP = F.swapaxes(1, 2) * precision
    H[:-1] += FP @ F
    g[:-1] += np.einsum("wij,wj->wi", FP, jumps)
    state, latent, own = np.arange(n_x), np.arange(n_x, k), 1.0 / np.square(fit.tau)
    H[1:, state, state] += precision
    H[1:, :n_x, k:] -= precision[:, None] * F[:, :, k:]
    g[1:, :n_x] -= precision * jumps
    H[:, latent, latent] += own
    g[:, n_x:k] -= own * fit.d
    E = np.zeros((len(H) - 1, k, k))
    E[:, :n_x] = -precision[:, None] * F[:, :, :k]
    beforehand = 1.0 / np.square(fit.prior)
    corner = H[:, k:, k:].sum(axis=0) + np.diag(beforehand)
    system = Arrowhead(H[:, :k, :k], E, H[:, :k, k:], corner)
    return NormalEquations(system, g[:, :k], g[:, k:].sum(axis=0) - beforehand * fit.shared)


def _order(n_s: int, n_x: int, k: int) -> npt.NDArray[np.int64]:
    """Places of (x, d, s) among the rollouts' unknowns, which are (s, d, x)."""
    n_v = k - n_x
    return np.concatenate([np.arange(n_s + n_v, n_s + k), np.arange(n_s, n_s + n_v), np.arange(n_s)])


def cost(windows: Windows, fit: Fit, weights: FloatArray) -> float:
    """Twice the cost with the weights held; infinite where a rollout diverges."""
    ends = windows.ends(fit.shared, fit.x, fit.d)
    terms = (
        (weights * np.square(fit.residuals)).sum(),
        np.square((fit.x[1:] - ends) / fit.slack).sum(),
        np.square(fit.d / fit.tau).sum(),
        np.square(fit.shared / fit.prior).sum(),
    )
    total = float(sum(terms))
    return total if np.isfinite(total) else np.inf
