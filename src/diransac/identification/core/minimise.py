"""The one loop: Gauss-Newton steps, each followed by an update of every scale by the schedule of the fit.

The scales of `Flexible`:

- the noise of each signal, by EM (`noise`);
- tau, the size of the unmodelled accelerations, by the evidence: with tau large, intervals stand alone; with tau = 0,
  a log is one rollout.  Models of real machines are accurate to a thousandth of the accelerations at best; this prior
  has the weight of one interval, so that tau does not vanish where noise hides the discrepancies;
- the size of the input gain and bias discrepancies, likewise.

All scales decrease gradually from large values, and so does the standard deviation of continuity: far from the solution
intervals are independent problems, near it they are one (graduated non-convexity).

References
----------
MacKay 1992 (evidence updates); Chung et al. 2013 (scales that are kept off zero by a weak prior); Black, Rangarajan
1996 and Yang et al. 2020 (graduated non-convexity).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.identification.core.arrowhead import Factored
from diransac.identification.core.equations import JointEquations, cost, linearized
from diransac.identification.core.fit import Fit, innovation_std, with_residuals
from diransac.identification.core.noise import Mixture, lower_scale
from diransac.identification.core.scales import (
    SHRINK,
    most_probable_size,
    negligible_jumps,
    process_sums,
    unbroken_jumps,
)
from diransac.identification.core.windows import DIVERGED, Windows
from diransac.time_limit import check_time

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.settings import LoDiransacSettings
    from diransac.identification.methods.lo_diransac.smoothing import Motion
    from diransac.model import Model

_MAX_TRIALS = 8
_CORRECTED = 0.3
"""Largest part of the excess of cost that a correction for the curvature of the rollouts may leave."""
_FIRST_DAMPING = 1e-7
"""Damping of the first step that needs one."""
_LEAST_DAMPING = 1e-9
"""Damping below which there is none."""
_ROUNDING = 1e-9
"""Relative change of the cost that is none."""
_TAU_START = 0.3
"""Size of unmodelled accelerations at the start of a fit, in spreads of the accelerations."""
_GUARDED = 0.1
"""Size of discrepancies at the start of a fit, over that of their prior."""
SIGMA_FLOOR = 1e-5
"""Least noise of a signal, over its spread."""
_LEAST_PRIOR = 1e-6
"""Least prior size of unmodelled accelerations, in their spreads: none would make the equations singular."""
_EXACT = 1e-3
"""Unmodelled accelerations of a model that is taken to be exact, over their prior size."""
_OFF = 1e-8
"""Input gain and bias discrepancies that are off, over that which equals an equation's inertial force."""
_NEARLY_EXACT = 10.0
"""Unmodelled accelerations at the start of an exact fit, over their prior size."""
_TIGHTENED = 0.1
"""Factor by which a step lowers the scales of an exact fit."""
_LOOSE = 10.0
"""Change of an error of a recording that ends a fit, over that of a parameter."""
HOPELESS = 0.1
"""Loss of log-likelihood per sample, of errors a tenth larger, from which on a fit is clearly less likely."""


@dataclass(frozen=True)
class Step:
    """Step of a fit.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
        After the step.
    at : JointEquations
        Before it.
    taken : Factored or None
        None of a damped one.
    damping : float
        Of the next step.
    """

    intervals: Windows
    fit: Fit
    at: JointEquations
    taken: Factored | None
    damping: float

    @cached_property
    def solved(self) -> Factored:
        """Solution without damping, which is no information: scales and standard errors follow from it."""
        return self.taken or self.at.solve()

    @property
    def of_errors(self) -> float:
        """Largest change of an error of the recordings over its standard error."""
        sizes, std, _ = self.at.errors_of(self.solved)
        return float((np.abs(sizes) / std).max(initial=0.0))


def gauss_newton_step(at: JointEquations, damping: float) -> Step:
    """One Gauss-Newton step within the bounds, corrected or damped until the cost falls.

    Parameters
    ----------
    at : JointEquations
        Result of `linearized`.
    damping : float

    Returns
    -------
    Step
    """
    intervals, fit, weights = at.intervals, at.fit, at.of_fit.weights
    before = cost(intervals, fit, weights)
    for trials in range(_MAX_TRIALS):
        right, excess = at.right, np.inf
        while True:
            step = at.solve(right, damping)
            there, trial = at.moved(step)
            more = cost(there, trial, intervals.weights_in(there, weights)) - before
            if more <= _ROUNDING * before:
                least = damping if trials else damping / 10.0 if damping > _LEAST_DAMPING else 0.0
                return Step(there, trial, at, None if damping else step, least)
            if not more < _CORRECTED * excess:
                break
            right, excess = at.corrected(there, trial), more
            del step, trial  # the next ones take as much memory
        damping = max(10.0 * damping, _FIRST_DAMPING)
    return Step(intervals, fit, at, None, damping)


@dataclass(frozen=True, eq=False, repr=False)
class Prior:
    """Prior sizes of the discrepancies; each has the weight of one interval.

    Parameters
    ----------
    tau : (n_v,) array
        Unmodelled accelerations.
    unit : (n_s,) array
        Discrepancy that equals an equation's inertial force; infinite for parameters.
    discrepancy : float
        Prior size of the discrepancies in those units.
    guarded : float
        Size with which a fit starts, before the evidence determines it.
    """

    tau: FloatArray
    unit: FloatArray
    discrepancy: float
    guarded: float

    @property
    def exact(self) -> FloatArray:
        """Size ``(n_v,)`` of unmodelled accelerations that vanish for practical purposes."""
        return np.asarray(_EXACT * self.tau)


@dataclass(frozen=True)
class Refinement:
    """Result of local optimisation.

    Parameters
    ----------
    intervals : Windows
        With the most probable errors of the recordings.
    fit : Fit
        Most probable motion and parameters.
    cost : float
        Negative log evidence, the likelihood integrated over all unknowns (Laplace), up to a constant.
    steps : int
        Number of Gauss-Newton steps.
    converged : bool
        Whether the steps ended before the limit.
    """

    intervals: Windows
    fit: Fit
    cost: float
    steps: int
    converged: bool


def make_prior(settings: LoDiransacSettings, intervals: Windows, motion: Motion, unit: FloatArray) -> Prior:
    """Prior in the units of the logs.

    Parameters
    ----------
    settings : LoDiransacSettings
    intervals : Windows
    motion : Motion
    unit : (n_s,) array
        Result of `discrepancy_units`.

    Returns
    -------
    Prior
    """
    return Prior(
        tau=max(settings.prior_model_error, _LEAST_PRIOR) * _accelerations(intervals.model, motion),
        unit=unit,
        discrepancy=settings.prior_discrepancy,
        guarded=max(_GUARDED * settings.prior_discrepancy, _OFF),
    )


def _accelerations(model: Model, motion: Motion) -> FloatArray:
    """Spread ``(n_v,)`` of each acceleration."""
    n_x = model.n_q + model.n_v
    return motion.spread[n_x : n_x + model.n_v]


def start(settings: LoDiransacSettings, intervals: Windows, motion: Motion, p: FloatArray, prior: Prior) -> Fit:
    """Initial fit from a hypothesis and the smoothed motion at the intervals' starts, or their neighbours' ends.

    Parameters
    ----------
    settings : LoDiransacSettings
    intervals : Windows
    motion : Motion
        Smoothed motion over the rows of the intervals.
    p : (n,) array
        Hypothesis.
    prior : Prior

    Returns
    -------
    Fit
    """
    n_x, n_v = intervals.model.n_q + intervals.model.n_v, intervals.model.n_v
    x, d = motion.signals[intervals.starts, :n_x].copy(), np.zeros((len(intervals), n_v))
    shared = np.concatenate([p, np.zeros(intervals.n_shared - len(p))])
    residuals, ends = intervals.simulated(shared, x, d)
    floor = SIGMA_FLOOR * motion.spread
    sigma = 1.5 * np.maximum(np.nan_to_num(lower_scale(residuals, intervals.known), nan=1.0), floor)
    low = np.where(intervals.known, intervals.measured, np.inf).min(axis=0)
    high = np.where(intervals.known, intervals.measured, -np.inf).max(axis=0)
    fraction = np.full(len(sigma), 0.3 if settings.outliers else 0.0)
    seen: BoolArray = np.asarray(intervals.known.any(axis=0))
    whole = [four for four in intervals.model.quaternions if seen[list(four)].all()]
    noise = Mixture(sigma, fraction, np.where(high > low, high - low, 1.0), floor, whole)
    sizes = prior.guarded * prior.unit
    sizes[: len(p)] = intervals.layout.prior_std
    mean = np.concatenate([intervals.layout.prior_mean, np.zeros(len(shared) - len(p))])
    tau = _TAU_START * _accelerations(intervals.model, motion)
    fit = Fit(shared, x, d, residuals, ends, noise, tau, np.zeros(n_v), motion.spread[:n_x].copy(), sizes, mean)
    return _anchored(intervals, fit)


def _anchored(intervals: Windows, fit: Fit) -> Fit:
    """The fit with initial states propagated from neighbouring intervals, where they have a higher likelihood.

    Where outliers are in the majority for longer than an interval, its state follows from its neighbours alone.
    """
    n, losses = len(intervals), _losses(intervals, fit.noise, fit.residuals, fit.ends, np.arange(len(intervals)))
    # States that changed since those of their neighbours were last propagated from them: others give what they gave.
    forward, backward = np.ones(n, bool), np.ones(n, bool)
    for _ in range(n):
        after = 1 + np.flatnonzero(intervals.linked & forward[:-1] & _ends_well(fit.ends)[:-1])
        fit, losses, forward = _better(intervals, fit, losses, after, fit.ends[after - 1])
        backward |= forward
        before = np.flatnonzero(intervals.linked & (backward[:-1] | backward[1:]))
        if len(before):
            found = intervals.origins(fit.shared, fit.x, fit.d, before)
            fit, losses, backward = _better(intervals, fit, losses, before, found)
            forward |= backward
        if not forward.any():
            break
    return fit


def _better(
    intervals: Windows, fit: Fit, losses: FloatArray, chosen: IntArray, states: FloatArray
) -> tuple[Fit, FloatArray, BoolArray]:
    """The fit with other initial states of chosen intervals where they have a higher likelihood, and its losses.

    The last result is the mask ``(W,)`` of the intervals whose states are new.
    """
    changed = np.zeros(len(intervals), bool)
    if not len(chosen):
        return fit, losses, changed
    x, residuals, ends = fit.x.copy(), fit.residuals.copy(), fit.ends.copy()
    x[chosen] = states
    simulated, ended = intervals.simulated(fit.shared, x, fit.d, chosen)
    found = _losses(intervals, fit.noise, simulated, ended, chosen)
    better = found < losses[chosen]
    x[chosen[~better]] = fit.x[chosen[~better]]
    changed[chosen[better]] = True
    residuals[np.repeat(changed, intervals.length)] = simulated[np.repeat(better, intervals.length)]
    ends[changed] = ended[better]
    losses = losses.copy()
    losses[changed] = found[better]
    return replace(fit, x=x, residuals=residuals, ends=ends), losses, changed


def _losses(
    intervals: Windows, noise: Mixture, residuals: FloatArray, ends: FloatArray, chosen: IntArray
) -> FloatArray:
    """Negative log-likelihood ``(n,)`` of the samples of chosen intervals; infinite where a rollout diverges."""
    known = intervals.known if len(chosen) == len(intervals) else intervals.known[intervals.rows_of(chosen)]
    found = noise.negative_log_likelihood(residuals, known).reshape(len(chosen), -1).sum(axis=1)
    return np.where(_ends_well(ends), found, np.inf)


def _ends_well(ends: FloatArray) -> BoolArray:
    """Mask ``(n,)`` of the rollouts that have not diverged, by the states in which they end."""
    return np.asarray((np.abs(ends) < DIVERGED).all(axis=1))


def diverges(fit: Fit) -> bool:
    """True if a rollout diverges, so that the fit has no normal equations."""
    return not _ends_well(fit.ends).all()


class Schedule(Protocol):
    """Rule by which the scales of a fit follow its steps.

    Parameters
    ----------
    settled : float
        Change of a parameter, standard errors, and relative change of the noise that end a fit.
    """

    settled: float

    def after(self, step: Step) -> Fit:
        """The fit after a step, with every scale updated."""
        ...


def minimise(intervals: Windows, fit: Fit, schedule: Schedule, limit: int, rival: float = np.inf) -> Refinement:
    """The fit after Gauss-Newton steps, with an update of every scale after each, until convergence.

    Parameters
    ----------
    intervals : Windows
        Their errors of recordings are estimated, too.
    fit : Fit
        Initial fit, as from `start`.
    schedule : Schedule
    limit : int
        Largest number of steps.
    rival : float, optional
        Negative log-likelihood of the samples in another fit.  This one ends where the gain of its last step in each
        that is left would leave its samples clearly less likely.

    Returns
    -------
    Refinement

    Raises
    ------
    TimeLimitError
        The time limit was reached.
    """
    damping, converged, steps, at = 0.0, False, 0, linearized(intervals, fit)
    loss, hopeless = np.inf, rival + HOPELESS * np.count_nonzero(intervals.known)
    del fit
    while steps < limit and not converged:
        check_time()
        steps += 1
        step = gauss_newton_step(at, damping)
        intervals, damping, updated = step.intervals, step.damping, schedule.after(step)
        errors = np.sqrt(np.diag(step.solved.var_p)[: intervals.n_p])
        converged = step.of_errors < _LOOSE * schedule.settled and _unchanged(at.fit, updated, errors, schedule.settled)
        if hopeless < np.inf:
            before, loss = loss, updated.noise.loss(updated.residuals, intervals.known)
            if loss - (limit - steps) * (before - loss) > hopeless:
                limit = steps
        del at, step  # the next equations take as much memory
        at = linearized(intervals, updated)
    return Refinement(at.intervals, at.fit, _evidence(at), steps, converged)


@dataclass(frozen=True, eq=False, repr=False)
class Flexible:
    """Schedule by evidence: noise by EM, sizes of unmodelled accelerations and of input gain and bias discrepancies."""

    settings: LoDiransacSettings
    prior: Prior
    settled = 0.01

    def after(self, step: Step) -> Fit:
        """The fit with every scale updated from residuals, unmodelled accelerations and discrepancies."""
        intervals, fit, solved, prior = step.intervals, step.fit, step.solved, self.prior
        noise = fit.noise.updated(fit.residuals, intervals.known, outliers=self.settings.outliers)
        sums = process_sums(intervals, fit, solved).total()
        tau, rho = sums.most_probable_size(prior.tau, fit.tau), sums.correlation(prior.tau)
        if not self.settings.model_error:
            tau = np.maximum(SHRINK * fit.tau, prior.exact)
        continuity = np.maximum(negligible_jumps(intervals, tau), SHRINK * fit.continuity_std)
        sizes = _discrepancies(fit, prior, np.diag(solved.var_p)[: len(fit.shared)], intervals.n_p)
        return replace(fit, noise=noise, tau=tau, rho=rho, continuity_std=continuity, prior=sizes)


@dataclass(frozen=True, eq=False, repr=False)
class Exact:
    """Schedule of the model as it is: unmodelled accelerations and jumps are tightened step by step, down to the least.

    Parameters
    ----------
    settings : LoDiransacSettings
    tau : (n_v,) array
        Least unmodelled accelerations.
    jumps : (n_x,) array
        Least jumps.
    """

    settings: LoDiransacSettings
    tau: FloatArray
    jumps: FloatArray
    settled = 0.01

    @classmethod
    def of(cls, settings: LoDiransacSettings, intervals: Windows, fit: Fit, prior: Prior) -> Exact:
        """Schedule from a fit: jumps become negligible beside the uncertainty of its states."""
        at = linearized(intervals, fit)
        unbroken = unbroken_jumps(fit, at.solve())
        least = np.clip(unbroken, negligible_jumps(intervals, prior.exact), fit.continuity_std)
        return cls(settings, prior.exact, least)

    def after(self, step: Step) -> Fit:
        """The fit with its noise updated and other scales lowered."""
        before, fit = step.at.fit, step.fit
        return replace(
            fit,
            noise=fit.noise.updated(fit.residuals, step.intervals.known, outliers=self.settings.outliers),
            tau=np.maximum(self.tau, _TIGHTENED * before.tau),
            continuity_std=np.maximum(self.jumps, _TIGHTENED * before.continuity_std),
        )


@dataclass(frozen=True, kw_only=True)
class SegmentsApart:
    """Schedule of simulation error: windows that nothing ties have no scale but the noise."""

    outliers: bool
    settled = 0.1

    def after(self, step: Step) -> Fit:
        """The fit with its noise updated."""
        fit = step.fit
        noise = fit.noise.updated(fit.residuals, step.intervals.known, outliers=self.outliers)
        return replace(fit, noise=noise)


def refine(settings: LoDiransacSettings, intervals: Windows, fit: Fit, prior: Prior) -> Refinement:
    """Fit of the model with discrepancies, whose sizes are those of the largest evidence; errors as `minimise`."""
    return minimise(intervals, fit, Flexible(settings, prior), settings.max_steps)


def refine_exact(settings: LoDiransacSettings, intervals: Windows, fit: Fit, prior: Prior) -> Refinement:
    """Fit of the model as it is, from one with discrepancies, as from `refine`; errors as `minimise`."""
    shared, sizes, tau = fit.shared.copy(), fit.prior.copy(), _NEARLY_EXACT * prior.tau
    shared[intervals.n_p :], sizes[intervals.n_p :] = 0.0, _OFF * prior.unit[intervals.n_p :]
    fit = replace(fit, shared=shared, d=np.zeros_like(fit.d), tau=tau, rho=np.zeros_like(tau), prior=sizes)
    fit = with_residuals(intervals, replace(fit, continuity_std=negligible_jumps(intervals, tau)))
    return minimise(intervals, fit, Exact.of(settings, intervals, fit, prior), settings.max_steps)


def refine_further(settings: LoDiransacSettings, intervals: Windows, fit: Fit) -> Refinement:
    """Fit of the model as it is, from one as of `refine_exact`, whose scales stay as tight; errors as `minimise`."""
    return minimise(intervals, fit, Exact(settings, fit.tau, fit.continuity_std), settings.max_steps)


def _evidence(at: JointEquations) -> float:
    """Negative log evidence of a fit at its optimum; infinite where a rollout diverges."""
    if diverges(at.fit):
        return np.inf
    return negative_log_evidence(at.intervals, at.fit, at.log_det)


def negative_log_evidence(intervals: Windows, fit: Fit, log_det: float) -> float:
    """Negative logarithm of the probability of the measurements by Laplace's method.

    Up to a constant that fits of the same log have in common, given the scales of a fit at its optimum.  Freedom costs:
    a discrepancy whose prior is wide counts against a fit unless it explains the log better.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
    log_det : float
        Of its normal equations.

    Returns
    -------
    float
        Infinite where a rollout diverges.
    """
    loss = fit.noise.loss(fit.residuals, intervals.known)
    beforehand = cost(intervals, fit, np.broadcast_to(0.0, fit.residuals.shape))
    if not np.isfinite(loss + beforehand):
        return np.inf
    std = innovation_std(intervals, fit)
    scales = intervals.linked.sum() * np.log(fit.continuity_std).sum() + np.log(std[np.isfinite(std)]).sum()
    scales += np.log(fit.prior[np.isfinite(fit.prior)]).sum()
    if fit.boundary is not None:
        scales -= 0.5 * fit.boundary.log_det
    return float(loss + 0.5 * beforehand + 0.5 * log_det + scales)


def _discrepancies(fit: Fit, prior: Prior, variance: FloatArray, n_p: int) -> FloatArray:
    """Prior sizes with those of the input gain and bias discrepancies, which have one in common."""
    sizes, unit, now = fit.prior.copy(), prior.unit[n_p:], fit.prior[n_p:]
    if not len(now):
        return sizes
    squares = np.square(fit.shared[n_p:] / unit).sum()
    determined = (1.0 - variance[n_p:] / np.square(now)).clip(0.0).sum()
    sizes[n_p:] = unit * most_probable_size(squares, determined, prior.discrepancy, now[0] / unit[0])
    return sizes


def _unchanged(old: Fit, new: Fit, errors: FloatArray, settled: float) -> bool:
    """True if no parameter moves by a part of its standard error, nor the noise by as much, and other scales hardly."""
    n_p = len(errors)
    moved = np.abs(new.shared - old.shared)[:n_p] / (errors + 1e-9 * np.abs(old.shared[:n_p]) + 1e-300)
    changes = (
        (moved, settled),
        (np.abs(np.log(new.noise.sigma / old.noise.sigma)), settled),
        (np.abs(np.log(new.tau / old.tau)), 0.05),
        (np.abs(new.rho - old.rho), 0.02),
        (np.abs(np.log(new.continuity_std / old.continuity_std)), 0.05),
        (np.abs(np.log(new.prior[n_p:] / old.prior[n_p:])), 0.1),
    )
    return all(bool((change < limit).all()) for change, limit in changes)
