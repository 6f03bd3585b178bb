"""Local optimisations from the best hypotheses, and what else explains a log: the likeliest explanation wins.

An explanation is a fit with its freedom: whether the model has discrepancies, how fast unmodelled accelerations vary,
and how inputs act after they are recorded.  Explanations are compared by their evidence, in which freedom costs, so
that an exact model without delay is the estimate wherever it explains the log as well.

References
----------
MacKay 1992; Schwarz 1978 (the price of a scale).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.method import report, within
from diransac.identification.methods.lo_diransac.hypotheses import robust_scores
from diransac.identification.methods.lo_diransac.instrumental_variables import estimate_parameters
from diransac.identification.methods.lo_diransac.mixture import BREAKDOWN
from diransac.identification.methods.lo_diransac.normal_equations import with_residuals
from diransac.identification.methods.lo_diransac.refinement import refine, refine_exact, start

if TYPE_CHECKING:
    from diransac.identification.method import Callback
    from diransac.identification.methods.lo_diransac.refinement import Prior, Refinement
    from diransac.identification.methods.lo_diransac.settings import LoDiransacSettings
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
    from diransac.identification.methods.lo_diransac.smoothing import Motion

__all__ = ["Explanation", "LocalSearch"]

# Difference of two fits' evidence, nats, below which both are as likely.
_AS_LIKELY = 5.0
_OUTLIER = 0.5
# Delays that are tried at a time, before they are refined to a sample.
_DELAYS_AT_A_TIME = 12
# Shortest interval, samples, and the factor by which intervals are shortened at a time.
_SHORTEST, _PARTS = 3, 2
# A delay that is worth an explanation: so many standard errors, and so many samples.
_SIGNIFICANT, _SMALL_DELAY = 3.0, 0.1
# Half a sample of delay or more is taken up by shifting the inputs.
_WHOLE_SAMPLE = 0.5
# Inputs that vary linearly between samples act half a sample before held ones.
_LINEAR = (-0.75, -0.25)


@dataclass(frozen=True)
class Explanation:
    """A fit with its freedom.

    Parameters
    ----------
    intervals : ShootingIntervals
        With the timing of the inputs.
    refinement : Refinement
    exact : bool
        Whether the fit is one of the model as it is.
    """

    intervals: ShootingIntervals
    refinement: Refinement
    exact: bool

    @property
    def cost(self) -> float:
        """Negative log evidence, with half the logarithm of the number of rows for each scale of a discrepancy."""
        n_scales = 0 if self.exact else 2 * self.intervals.model.n_v + 1
        return self.refinement.cost + 0.5 * n_scales * float(np.log(self.intervals.is_logged.sum()))


@dataclass(frozen=True)
class LocalSearch:
    """Local optimisations of one dataset.

    Parameters
    ----------
    settings : LoDiransacSettings
    motion : Motion
        Smoothed motion over the rows of the intervals.
    hypotheses : (n, n_p) array
        Best first.
    prior : Prior
    callback : callable or None
    """

    settings: LoDiransacSettings
    motion: Motion
    hypotheses: FloatArray
    prior: Prior
    callback: Callback | None

    def likeliest(self, intervals: ShootingIntervals, *, free_hold: bool) -> Explanation:
        """The likeliest explanation of the log.

        Parameters
        ----------
        intervals : ShootingIntervals
            With inputs as recorded.
        free_hold : bool
            Whether another hold of the inputs may be an explanation.

        Returns
        -------
        Explanation
        """
        report(self.callback, "searching for a delay", 0.1)
        delay = self._likeliest_delay(intervals)
        shifted = [intervals, *([replace(intervals, delay=delay)] if delay else [])]
        found = [self._from_hypotheses(x, k) for k, x in enumerate(shifted)]
        best = min(found, key=lambda x: x.cost)
        for k in range(self.settings.max_delay_shifts):
            report(self.callback, "timing of the inputs", 0.6 + 0.1 * k)
            others = [self._refitted(best, timing) for timing in self._timings(best, free_hold=free_hold)]
            likelier = min([best, *others], key=lambda x: x.cost)
            if likelier.cost > best.cost - _AS_LIKELY:
                break
            best = likelier
        return best

    def _from_hypotheses(self, intervals: ShootingIntervals, k: int) -> Explanation:
        """The likeliest explanation with this timing of the inputs."""
        part = within(self.callback, 0.1 + 0.25 * k, 0.35 + 0.25 * k)
        return self._simplest(Explanation(intervals, self.best(intervals, part), exact=False))

    def best(self, intervals: ShootingIntervals, callback: Callback | None = None) -> Refinement:
        """Local optimisation from the best hypothesis; where it is doubtful, from others; the likeliest of these.

        A fit is doubtful if most samples of an interval are outliers: either sensors failed there, or the fit did.  The
        likeliest fit so far becomes a hypothesis itself; otherwise the next hypothesis is optimised.  The search ends
        with a second fit that is as likely.

        Parameters
        ----------
        intervals : ShootingIntervals
        callback : callable, optional

        Returns
        -------
        Refinement
        """
        waiting = list(self.hypotheses[: self.settings.max_starts])
        found: list[Refinement] = []
        while waiting and len(found) < self.settings.max_fits:
            share = len(found) / self.settings.max_fits
            report(callback, "local optimisation", share, f"fit {len(found) + 1}")
            begin = start(self.settings, intervals, self.motion, waiting.pop(0), self.prior)
            found.append(refine(self.settings, intervals, begin, self.prior))
            again = any(abs(found[-1].cost - x.cost) < _AS_LIKELY for x in found[:-1])
            if again or not _is_doubtful(intervals, found[-1]):
                break
            if all(found[-1].cost < x.cost for x in found[:-1]):
                waiting.insert(0, found[-1].fit.shared[: intervals.n_p])
        return min(found, key=lambda x: x.cost)

    def _simplest(self, flexible: Explanation) -> Explanation:
        """The exact model, if it is as likely; otherwise unmodelled accelerations that vary as fast as is likely."""
        intervals, fit = flexible.intervals, flexible.refinement.fit
        p = estimate_parameters(intervals, fit, self.settings.prior_inflation).parameters
        if intervals.layout.admits(p[None])[0]:
            fit = with_residuals(intervals, replace(fit, shared=np.concatenate([p, fit.shared[intervals.n_p :]])))
        exact = Explanation(intervals, refine_exact(self.settings, intervals, fit, self.prior), exact=True)
        if exact.cost < flexible.cost:
            return exact
        while self.settings.model_error and flexible.intervals.length >= _PARTS * _SHORTEST:
            finer = self._split(flexible)
            if finer.cost > flexible.cost - _AS_LIKELY:
                break
            flexible = finer
        return flexible

    def _split(self, coarse: Explanation) -> Explanation:
        """The fit with unmodelled accelerations that vary faster."""
        parts = next(k for k in range(_PARTS, coarse.intervals.length + 1) if coarse.intervals.length % k == 0)
        fit, intervals = coarse.refinement.fit, coarse.intervals.split(parts)
        n_x = fit.x.shape[1]
        series = coarse.intervals.rollouts.trajectories(coarse.intervals.batch(fit.shared, fit.x, fit.d))
        x = series[:, :: intervals.length, :n_x].reshape(-1, n_x)
        rho = fit.rho ** (1.0 / parts)
        begin = with_residuals(intervals, replace(fit, x=x, d=np.repeat(fit.d, parts, axis=0), rho=rho))
        return Explanation(intervals, refine(self.settings, intervals, begin, self.prior, settled=True), exact=False)

    def _timings(self, now: Explanation, *, free_hold: bool) -> list[ShootingIntervals]:
        """Other timings of the inputs that the fit suggests: whole samples of delay, a lag, or another hold."""
        intervals, fit = now.intervals, now.refinement.fit
        local, error = fit.shared[-1], estimate_parameters(intervals, fit, 1.0).delay_error
        late = intervals.delay + intervals.lag + local
        if abs(local) < max(_SIGNIFICANT * error, _SMALL_DELAY) and late == local:
            return []
        timings = []
        if intervals.lag:
            return [replace(intervals, lag=max(late, 0.1))]
        if abs(local) >= _WHOLE_SAMPLE:
            timings.append(replace(intervals, delay=intervals.delay + round(local)))
        if free_hold and intervals.hold == "zero-order":
            if late > _WHOLE_SAMPLE:
                timings.append(replace(intervals, delay=0, lag=float(late), hold="linear"))
            if _LINEAR[0] < late < _LINEAR[1]:
                timings.append(replace(intervals, delay=0, hold="linear"))
        return timings

    def _refitted(self, now: Explanation, intervals: ShootingIntervals) -> Explanation:
        """The likeliest explanation with another timing, from the fit of this one."""
        fit, old = now.refinement.fit, now.intervals
        left = old.delay + old.lag + fit.shared[-1] - intervals.delay - intervals.lag
        if intervals.hold != old.hold:
            left = 0.0
        sizes = np.append(fit.prior[:-1], self.prior.delay)
        begin = with_residuals(intervals, replace(fit, shared=np.append(fit.shared[:-1], left), prior=sizes))
        if now.exact:
            return Explanation(intervals, refine_exact(self.settings, intervals, begin, self.prior), exact=True)
        return self._simplest(
            Explanation(intervals, refine(self.settings, intervals, begin, self.prior, settled=True), exact=False)
        )

    def _likeliest_delay(self, intervals: ShootingIntervals) -> int:
        """Delay in samples with which simulations by the best hypothesis agree best with the log.

        Inputs that are held for many samples and then step cause few outliers under a wrong delay, which is a local
        optimum; so the number of whole samples is chosen before local optimisation.
        """
        every, scores = np.arange(len(intervals)), dict[int, float]()
        low, high = (round(x / intervals.dt) for x in self.settings.delay_range)

        def score(rows: int) -> float:
            if rows not in scores:
                delayed = replace(intervals, delay=rows)
                scores[rows] = float(robust_scores(delayed, self.motion, self.hypotheses[:1], every)[0])
            return scores[rows]

        step = max(1, (high - low) // (_DELAYS_AT_A_TIME - 1))
        tried = range(-(-low // step) * step, high + 1, step)
        best = min(tried, key=lambda rows: (score(rows), abs(rows)))
        while step > 1:
            step = max(1, step // 2)
            near = [x for x in (best - step, best, best + step) if low <= x <= high]
            best = min(near, key=lambda rows: (score(rows), abs(rows)))
        return best


def _is_doubtful(intervals: ShootingIntervals, refined: Refinement) -> bool:
    """True if an interval has too few inlying samples for a robust scale."""
    fit, n = refined.fit, len(intervals)
    inlying = (fit.noise.inlying(fit.residuals, intervals.known) > _OUTLIER).reshape(n, -1).sum(axis=1)
    return bool((inlying < BREAKDOWN * intervals.known.reshape(n, -1).sum(axis=1)).any())
