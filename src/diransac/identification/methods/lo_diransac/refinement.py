"""Local optimisation: the most probable motion, parameters and deviations from the model, given the log.

Gauss and Newton's steps on `normal_equations`, each followed by an update of every scale from what the log shows:

- the noise of each signal, by EM (`mixture`);
- tau, the size of the latent accelerations, by the evidence: with tau large, windows stand alone; with tau = 0, the
  whole log is one rollout.  A model of a real machine is right to a thousandth of its accelerations at best, which
  counts like one window's evidence: where noise hides the deviations, their absence is not believed;
- the size of the pushes, and of the delay, likewise.

All come down slowly from large values, and so does the slack in the continuity: far from the truth the problem is many
easy ones, near it a single one that uses every bit of information (graduated non-convexity).  On the way down tau
follows the median window, so that windows that are still astray give way to their neighbours.

References: MacKay 1992 (evidence updates); Chung et al. 2013 (scales that are kept off zero by a weak prior); Black,
Rangarajan 1996 and Yang et al. 2020 (graduated non-convexity).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.methods.lo_diransac.mixture import Mixture, lower_scale
from diransac.identification.methods.lo_diransac.normal_equations import Fit, cost, linearize

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.arrowhead import Factored
    from diransac.identification.methods.lo_diransac.smoothing import Motion
    from diransac.identification.methods.lo_diransac.windows import Windows

__all__ = ["Belief", "Refinement", "believe", "refine", "start", "weights_of"]


# Where tau starts, in spreads of the accelerations; the largest change of any scale in a step.
_TAU_START, _SHRINK = 0.3, 0.4
# Continuity is exact for practical purposes: jumps are as small a part of what latent accelerations do in a window.
_SLACK = 0.03
_SIGMA_FLOOR = 1e-4
# Of the accelerations' spread: what a model may miss without any evidence for it; so many times that on the way down,
# lest noise explain what the model does not.
_BELIEF, _GUARDED = 1e-3, 10.0
_MAX_STEPS, _MAX_TRIALS, _MAX_SWEEPS = 60, 8, 12
_FIRST_DAMPING, _LEAST_DAMPING = 1e-7, 1e-9


@dataclass(frozen=True)
class Belief:
    """How far the model is believed before the log is seen; each counts like one window's evidence.

    Parameters
    ----------
    tau : (n_v,)   latent accelerations, a thousandth of the accelerations' spread
    unit : (n_s,)   a push that makes all of an equation's inertial force; a row of delay; infinite for parameters
    push : of those units, once the fit has settled; ``guarded`` until then
    delay : rows
    """

    tau: FloatArray
    unit: FloatArray
    push: float = 0.1
    guarded: float = 0.01
    delay: float = 0.03


@dataclass(frozen=True)
class Refinement:
    """What local optimisation found.

    Parameters
    ----------
    fit : the most probable motion and parameters
    loss : minus the log of the likelihood of all samples
    steps : Gauss-Newton steps; settled : whether they ended before the limit
    """

    fit: Fit
    loss: float
    steps: int
    settled: bool


def believe(windows: Windows, motion: Motion, unit: FloatArray) -> Belief:
    """Beliefs in the units of this log."""
    return Belief(_BELIEF * motion.spread[-windows.model.n_v :], unit)


def start(windows: Windows, motion: Motion, p: FloatArray, belief: Belief) -> Fit:
    """From a hypothesis, and the smoothed motion at the windows' starts, or what the windows before make of it."""
    n_x, n_v = windows.model.n_q + windows.model.n_v, windows.model.n_v
    x, d = motion.signals[windows.starts, :n_x].copy(), np.zeros((len(windows), n_v))
    shared = np.concatenate([p, np.zeros(windows.freed.n_shared - len(p))])
    residuals = windows.residuals(shared, x, d)
    floor = _SIGMA_FLOOR * motion.spread
    sigma = 1.5 * np.maximum(np.nan_to_num(lower_scale(residuals, windows.known), nan=1.0), floor)
    low = np.where(windows.known, windows.measured, np.inf).min(axis=0)
    high = np.where(windows.known, windows.measured, -np.inf).max(axis=0)
    noise = Mixture(sigma, np.full(len(sigma), 0.3), np.where(high > low, high - low, 1.0), floor)
    prior = belief.unit * np.r_[np.full(len(shared) - 1, belief.guarded), belief.delay]
    tau, slack = _TAU_START * motion.spread[n_x:], motion.spread[:n_x].copy()
    return _anchored(windows, Fit(shared, x, d, residuals, noise, tau, slack, prior))


def _anchored(windows: Windows, fit: Fit) -> Fit:
    """Let windows begin where their neighbours have them begin, as far as that explains them better.

    Where outliers are in the majority for longer than a window, nothing there tells the state; its neighbours do.
    """
    for _ in range(_MAX_SWEEPS):
        before, after = fit.x.copy(), fit.x.copy()
        before[1:] = np.nan_to_num(windows.ends(fit.shared, fit.x, fit.d))
        fit, forward = _better(windows, fit, before)
        after[:-1] = windows.origins(fit.shared, fit.x, fit.d)
        fit, backward = _better(windows, fit, after)
        if not (forward or backward):
            break
    return fit


def _better(windows: Windows, fit: Fit, x: FloatArray) -> tuple[Fit, bool]:
    """The fit with those of other initial states that explain their windows better, and whether there are any."""
    residuals = windows.residuals(fit.shared, x, fit.d)
    found = _loss_by_window(windows, replace(fit, residuals=residuals)) < _loss_by_window(windows, fit)
    rows = np.repeat(found, windows.length)[:, None]
    x, residuals = np.where(found[:, None], x, fit.x), np.where(rows, residuals, fit.residuals)
    return replace(fit, x=x, residuals=residuals), bool(found.any())


def _loss_by_window(windows: Windows, fit: Fit) -> FloatArray:
    """Minus the log of the likelihood of each window's samples, (W,)."""
    losses = fit.noise.negative_log_likelihood(fit.residuals, windows.known)
    return np.asarray(losses.reshape(len(windows), -1).sum(axis=1))


def refine(windows: Windows, fit: Fit, belief: Belief) -> Refinement:
    """Steps and updates until nothing changes, first with a robust tau, then with the evidence's."""
    damping, robust, settled, steps = 0.0, True, False, 0
    while steps < _MAX_STEPS and (robust or not settled):
        steps += 1
        robust = robust and not settled
        moved, solved, damping = _step(windows, fit, damping)
        updated = _update(windows, moved, solved, belief, robust=robust)
        errors = np.sqrt(np.diag(solved.var_p)[: windows.model.n_p])
        settled = _unchanged(fit, updated, errors)
        fit = updated
    loss = float(fit.noise.negative_log_likelihood(fit.residuals, windows.known).sum())
    return Refinement(fit, loss, steps, settled and not robust)


def weights_of(windows: Windows, fit: Fit) -> FloatArray:
    """Of each measurement: the probability that it is no outlier, over its variance."""
    return fit.noise.inlying(fit.residuals, windows.known) / np.square(fit.noise.sigma)


def _step(windows: Windows, fit: Fit, damping: float) -> tuple[Fit, Factored, float]:
    """One step of Gauss and Newton within the bounds, damped until the cost falls; with what damping came next."""
    weights = weights_of(windows, fit)
    at, before = linearize(windows, fit, weights), cost(windows, fit, weights)
    n_x = fit.x.shape[1]
    for _ in range(_MAX_TRIALS):
        solved = at.system.solve(at.right_z, at.right_s, damping)
        shared = _bounded(windows, fit.shared, fit.shared + solved.step_p)
        z = solved.step_z - solved.gain @ (shared - fit.shared - solved.step_p)
        x, d = fit.x + z[:, :n_x], fit.d + z[:, n_x:]
        trial = replace(fit, shared=shared, x=x, d=d, residuals=windows.residuals(shared, x, d))
        if cost(windows, trial, weights) <= before * (1.0 + 1e-9):
            return trial, solved, damping / 10.0 if damping > _LEAST_DAMPING else 0.0
        damping = max(10.0 * damping, _FIRST_DAMPING)
    return fit, solved, damping


def _bounded(windows: Windows, now: FloatArray, then: FloatArray) -> FloatArray:
    """Parameters within their bounds; a positive one at most halves or doubles."""
    then = then.copy()
    for j, bounds in enumerate(windows.model.parameters.values()):
        then[j] = np.clip(then[j], bounds.lower, bounds.upper)
        if bounds.positive:
            then[j] = np.clip(then[j], 0.5 * now[j], 2.0 * now[j])
    return then


def _update(windows: Windows, fit: Fit, solved: Factored, belief: Belief, *, robust: bool) -> Fit:
    """Every scale from the residuals, latent accelerations and deviations as they are now."""
    n_x, n_p = fit.x.shape[1], windows.model.n_p
    inlying = fit.noise.inlying(fit.residuals, windows.known)
    noise = fit.noise.updated(fit.residuals, windows.known, inlying)
    variance = np.einsum("wii->wi", solved.var_z)[:, n_x:]
    squares, believed = np.square(fit.d).sum(axis=0), belief.tau
    if robust:
        squares, believed = len(fit.d) * np.square(1.4826 * np.median(np.abs(fit.d), axis=0)), _GUARDED * belief.tau
    tau = _evidence(believed, fit.tau, squares, (1.0 - variance / np.square(fit.tau)).clip(0.0).sum(axis=0))
    slack = np.maximum(_continuity(windows, tau), _SHRINK * fit.slack)
    prior = fit.prior if robust else _deviations(fit, belief, np.diag(solved.var_p), n_p)
    return replace(fit, noise=noise, tau=tau, slack=slack, prior=prior)


def _evidence(belief: FloatArray, now: FloatArray, squares: FloatArray, determined: FloatArray) -> FloatArray:
    """Size of deviations from the sum of their squares and how many of them the log determines."""
    size = np.sqrt((squares + np.square(belief)) / (determined + 1.0))
    return np.asarray(np.clip(size, _SHRINK * now, now / _SHRINK))


def _deviations(fit: Fit, belief: Belief, variance: FloatArray, n_p: int) -> FloatArray:
    """Sizes of the pushes, which have one in common, and of the delay."""
    prior = fit.prior.copy()
    for members, size in ((slice(n_p, len(prior) - 1), belief.push), (slice(len(prior) - 1, None), belief.delay)):
        unit, now = belief.unit[members], fit.prior[members]
        if len(unit):
            squares = np.square(fit.shared[members] / unit).sum()
            determined = (1.0 - variance[members] / np.square(now)).clip(0.0).sum()
            prior[members] = unit * _evidence(np.array(size), now[0] / unit[0], squares, determined)
    return prior


def _continuity(windows: Windows, tau: FloatArray) -> FloatArray:
    """Jumps ``(n_x,)`` that are negligible beside what latent accelerations do to velocities and coordinates."""
    T = windows.duration
    velocity = _SLACK * tau * T
    coordinate = velocity * T if windows.model.kinematics is None else np.full(windows.model.n_q, velocity.max() * T)
    return np.concatenate([coordinate, velocity])


def _unchanged(old: Fit, new: Fit, errors: FloatArray) -> bool:
    """Whether parameters move by less than a hundredth of their standard errors, and scales by a few hundredths."""
    n_p = len(errors)
    moved = np.abs(new.shared - old.shared)[:n_p] / (errors + 1e-9 * np.abs(old.shared[:n_p]) + 1e-300)
    changes = (
        (np.abs(np.log(new.noise.sigma / old.noise.sigma)), 0.01),
        (np.abs(np.log(new.tau / old.tau)), 0.05),
        (np.abs(np.log(new.slack / old.slack)), 0.05),
        (np.abs(np.log(new.prior[n_p:] / old.prior[n_p:])), 0.1),
    )
    return bool((moved < 0.01).all() and all((change < limit).all() for change, limit in changes))
