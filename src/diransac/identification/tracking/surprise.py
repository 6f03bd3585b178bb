"""Weights of samples that a window does not expect.

A machine that changes contradicts the model, and a mixture takes samples that contradict a model for outliers: the
change would hide itself.  Where the last intervals have more outliers than their signals usually have, outliers are
those of a motion that follows the samples instead, with unmodelled accelerations as large as the accelerations
themselves.  Real outliers contradict this motion, too.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.methods.lo_diransac.gauss_newton import gauss_newton_step
from diransac.identification.methods.lo_diransac.joint_equations import linearized
from diransac.identification.methods.lo_diransac.normal_equations import weights_of

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.arrowhead import Factored
    from diransac.identification.methods.lo_diransac.normal_equations import Fit
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
    from diransac.identification.tracking.window import Window

# Standard deviation of parameters that are held, over their values.
_HELD = 1e-6
_STEPS = 6


def is_surprised(window: Window) -> bool:
    """True if the last two intervals of a window have more outliers than chance gives them: by four deviations."""
    rows = slice(-2 * window.length, None)
    intervals, fit = window.intervals(), window.fit
    known = intervals.known[rows]
    found = (known - fit.noise.inlying(fit.residuals[rows], known)).sum()
    expected = (known * fit.noise.pi).sum()
    variance = (known * fit.noise.pi * (1.0 - fit.noise.pi)).sum()
    return bool(found > expected + 4.0 * np.sqrt(variance + 1.0))


def weights_of_free_motion(window: Window) -> FloatArray:
    """Weights ``(N, n_s)`` of all samples of a window, those of the last second by a motion that follows them.

    Parameters
    ----------
    window : Window

    Returns
    -------
    (N, n_s) array
    """
    n = min(len(window), round(1.0 / (window.length * window.stream.dt)))
    rows = slice(-n * window.length, None)
    intervals = window.setup.intervals(window.stream, window.end - n * window.length, n)
    weights = weights_of(window.intervals(), window.fit)
    weights[rows] = weights_of(intervals, free_motion(window, intervals, n))
    return weights


def free_motion(window: Window, intervals: ShootingIntervals, n: int) -> Fit:
    """Fit of the last n intervals of a window that follows their samples, whatever the parameters.

    Parameters
    ----------
    window : Window
    intervals : ShootingIntervals
        The last n.
    n : int

    Returns
    -------
    Fit
    """
    whole = window.fit
    fit = replace(
        whole,
        x=whole.x[-n:],
        d=whole.d[-n:],
        residuals=whole.residuals[-n * window.length :],
        ends=whole.ends[-n:],
        tau=window.largest,
        rho=np.zeros_like(whole.rho),
        prior=_HELD * np.maximum(np.abs(whole.shared), _HELD),
        prior_mean=whole.shared,
        boundary=None,
    )
    return followed(intervals, fit)[0]


def followed(intervals: ShootingIntervals, fit: Fit) -> tuple[Fit, Factored]:
    """The fit after some steps, with noise as large as the residuals of each at first: none starts as an outlier.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit

    Returns
    -------
    Fit
        With the noise that was given.
    Factored
        Solution of the last step.
    """
    usual, damping = fit.noise, 0.0
    for _ in range(_STEPS):
        samples = zip(np.abs(fit.residuals).T, intervals.known.T, strict=True)
        # Three quarters of the samples are no outliers; of a standard normal x, this quantile of |x| is 1.15.
        scale = [np.quantile(x[k], 0.75) / 1.15 if k.any() else 0.0 for x, k in samples]
        fit = replace(fit, noise=replace(usual, sigma=np.maximum(usual.sigma, scale)))
        taken = gauss_newton_step(linearized(intervals, fit), damping)
        moved = np.abs(taken.fit.x - fit.x)
        fit, damping = taken.fit, taken.damping
        if (moved <= 0.1 * np.sqrt(taken.solved.var_z[:, : moved.shape[1]])).all():
            break
    return replace(fit, noise=usual), taken.solved
