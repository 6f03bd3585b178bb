"""Fits of some intervals whatever the machine does there: with larger unmodelled forces, and weights that allow for it.

A machine that changes contradicts the model, and a mixture takes samples that contradict a model for outliers: the
change would hide itself.  Where the last intervals have more outliers than their signals usually have, outliers are
those of a motion that follows the samples instead, with unmodelled accelerations as large as the accelerations
themselves.  Real outliers contradict this motion, too.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.core.boundary import BoundaryPrior
from diransac.identification.core.equations import linearize, linearized
from diransac.identification.core.fit import innovation_std, innovation_terms, innovations, weights_of
from diransac.identification.core.minimise import gauss_newton_step, negative_log_evidence

if TYPE_CHECKING:
    from diransac.identification.core.equations import JointEquations
    from diransac.identification.core.fit import Fit
    from diransac.identification.core.windows import Windows

_GUST = 0.9
"""Correlation from interval to interval of unmodelled accelerations that are larger than usual."""


@dataclass(frozen=True, eq=False)
class Forces:
    """Unmodelled accelerations.

    Parameters
    ----------
    tau : (n_v,) or (W, n_v) array
        Their size.
    rho : (n_v,) array
        Their correlation from interval to interval.
    """

    tau: FloatArray
    rho: FloatArray

    def acting(self, fit: Fit) -> Fit:
        """A fit with these as its unmodelled accelerations."""
        return replace(fit, tau=self.tau, rho=self.rho)

    def until(self, age: int, larger: Forces) -> Forces:
        """These, and larger ones in some intervals at the end."""
        now = np.arange(len(self.tau)) >= len(self.tau) - age
        return Forces(np.where(now[:, None], larger.tau, self.tau), larger.rho)


def part(fit: Fit, first: int, end: int | None = None) -> Fit:
    """The fit of some of its intervals, whose boundary is that of all."""
    n_rows = len(fit.residuals) // len(fit.x)
    chosen = slice(first, len(fit.x) if end is None else end)
    motion = {name: getattr(fit, name)[chosen] for name in ("x", "d", "ends")}
    tau = fit.tau if fit.tau.ndim == 1 else fit.tau[chosen]
    return replace(fit, tau=tau, residuals=fit.residuals[chosen.start * n_rows : chosen.stop * n_rows], **motion)


def followed(intervals: Windows, fit: Fit) -> tuple[Fit, float]:
    """A fit after some steps, with noise as large as the residuals of each at first: none starts as an outlier.

    Parameters
    ----------
    intervals : Windows
    fit : Fit

    Returns
    -------
    Fit
        With the noise that was given.
    float
        Evidence, nats.
    """
    usual, damping = fit.noise, 0.0
    for _ in range(6):
        samples = zip(np.abs(fit.residuals).T, intervals.known.T, strict=True)
        # Three quarters of the samples are no outliers; of a standard normal x, this quantile of |x| is 1.15.
        scale = [np.quantile(x[k], 0.75) / 1.15 if k.any() else 0.0 for x, k in samples]
        fit = replace(fit, noise=replace(usual, sigma=np.maximum(usual.sigma, scale)))
        step = gauss_newton_step(linearized(intervals, fit), damping)
        moved = np.abs(step.fit.x - fit.x)
        fit, damping = step.fit, step.damping
        if (moved <= 0.1 * np.sqrt(step.solved.var_z[:, : moved.shape[1]])).all():
            break
    fit = replace(fit, noise=usual)
    return fit, -negative_log_evidence(intervals, fit, step.solved.log_det)


def free_motion(intervals: Windows, fit: Fit, largest: FloatArray) -> Fit:
    """Fit that follows the samples, whatever the parameters, with unmodelled accelerations ``(n_v,)`` of some size."""
    held = 1e-6 * (np.abs(fit.shared) + 1e-6)
    free = replace(fit, tau=largest, rho=np.zeros_like(fit.rho), prior=held, prior_mean=fit.shared, boundary=None)
    return followed(intervals, free)[0]


def is_surprised(intervals: Windows, fit: Fit) -> bool:
    """True if intervals have more outliers than chance gives them: by four deviations."""
    known = intervals.known
    n_outliers = (known - fit.noise.inlying(fit.residuals, known)).sum()
    expected, variance = (known * fit.noise.pi).sum(), (known * fit.noise.pi * (1.0 - fit.noise.pi)).sum()
    return bool(n_outliers > expected + 4.0 * np.sqrt(variance + 1.0))


def left_by(intervals: Windows, fit: Fit, weights: FloatArray | None = None) -> BoundaryPrior:
    """Boundary prior that all intervals but the last leave where that begins, linearised at a fit.

    Parameters
    ----------
    intervals : Windows
        All with the same parameters.
    fit : Fit
    weights : (N, n_signals) array, optional
        Weights of the measurements; those of the fit where none are given.
    """
    weights = weights_of(intervals, fit) if weights is None else weights.copy()
    weights[-intervals.length :] = 0.0
    equations = linearize(intervals, fit, weights)
    point = np.concatenate([fit.x[-1], fit.d[-1], fit.shared])
    return BoundaryPrior.of_information(point, *equations.system.eliminated(equations.right_z, equations.right_s))


# ---------------------------------------------------------------------- other forces at a linearised window


def with_forces(equations: JointEquations, forces: Forces) -> JointEquations:
    """Equations of a window with other scales of the unmodelled accelerations."""
    fit, n_x = forces.acting(equations.fit), equations.fit.x.shape[1]
    old, new = (innovation_terms(equations.intervals, x) for x in (equations.fit, fit))
    diagonal, below, right = (b - a for a, b in zip(old, new, strict=True))
    system = replace(equations.system, diagonal=equations.system.diagonal.copy(), below=equations.system.below.copy())
    np.einsum("wii->wi", system.diagonal)[:, n_x:] += diagonal
    np.einsum("wii->wi", system.below)[:, n_x:] += below
    right_z = equations.of_fit.right_z.copy()
    right_z[:, n_x:] += right
    of_fit = replace(equations.of_fit, system=system, right_z=right_z)
    return replace(equations, fit=fit, of_fit=of_fit, system=system, right=(right_z, equations.of_fit.right_s))


def likeliest(equations: JointEquations, trials: Sequence[Forces]) -> tuple[Forces, float]:
    """Those of some unmodelled accelerations with the largest evidence at a linearised window, and that."""
    return max(((x, _evidence(with_forces(equations, x))) for x in trials), key=lambda x: x[1])


def _evidence(equations: JointEquations) -> float:
    """Logarithm of the evidence of a linearised window, up to terms that do not depend on unmodelled accelerations."""
    solved, std = equations.solve(), innovation_std(equations.intervals, equations.fit)
    gained = (equations.right[0] * solved.step_z).sum() + equations.right[1] @ solved.step_p
    cost = np.square(innovations(equations.intervals, equations.fit)).sum()
    return float(0.5 * (gained - cost - solved.log_det) - np.log(std[np.isfinite(std)]).sum())


def gain_of_freedom(equations: JointEquations, least: FloatArray, expected: FloatArray, most: FloatArray) -> float:
    """Evidence, nats, that unmodelled accelerations gain over a model that is exact.

    Parameters
    ----------
    equations : JointEquations
    least, expected : (n_v,) array
        Sizes of the unmodelled accelerations of an exact model, and those that are expected of any other.
    most : (n_v,) array
        The largest ones.

    Returns
    -------
    float
        The larger one of the sizes of the fit, where they are larger than the least, and of some others.
    """
    none = np.zeros_like(least)
    others = [Forces(expected, none), Forces(np.minimum(30.0 * expected, most), none + _GUST)]
    if (equations.fit.tau > least).any():
        others = [Forces(equations.fit.tau, equations.fit.rho)]
    return likeliest(equations, others)[1] - likeliest(equations, [Forces(least, none)])[1]


def likeliest_forces(equations: JointEquations, least: FloatArray, most: FloatArray, ages: Iterable[int]) -> Forces:
    """Unmodelled accelerations that explain a linearised window best: its own, or larger ones from a time on.

    Parameters
    ----------
    equations : JointEquations
    least, most : (n_v,) array
        Sizes between which they are sought, where its own are not larger.
    ages : iterable of int
        Intervals at the end of the window in which they may be larger.
    """
    usual = Forces(np.broadcast_to(equations.fit.tau, equations.fit.d.shape), equations.fit.rho)
    low, rho = np.maximum(usual.tau, least), np.maximum(usual.rho, _GUST)
    shares = np.linspace(0.0, 1.0, 5)
    larger = likeliest(equations, [Forces(low * (np.maximum(most, low) / low) ** x, rho) for x in shares])[0]
    return likeliest(equations, [usual, *(usual.until(age, larger) for age in ages)])[0]
