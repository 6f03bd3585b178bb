"""Least prediction errors of a model without equations: parameters, noise, and what the model lacks.

Gauss-Newton steps on the sums of `interval_filter`, each a pass over the logs, and updates of the noise (a mixture with
outliers) and of what the model lacks lead to the estimate.

References
----------
Astrom 1980 (prediction errors); Dempster, Laird, Rubin 1977 (noise).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.methods.lo_diransac.interval_filter import FilterPass, IntervalFilter, widened
from diransac.identification.regression.uncertainty import CLEAR

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    Progress = Callable[[int, "Minimum"], None] | None

PASSES = 30
"""Passes with local slopes at most; over the spread, three times the latest."""
LATEST = 4
"""Passes that decide whether a fit has ended, and how far an estimate wanders; halvings of a step in a row."""
CONVERGED = 0.5
"""Mean step of the latest passes that ends a fit, standard errors."""
LEAST_LACK = 1e-4
"""Change of a velocity that a model lacks at least, of what it predicts: below, integrators differ as much."""
SPREAD = 10.0
"""Spread of a parameter over which slopes are taken, standard errors; a quarter of its size at most."""


@dataclass(frozen=True)
class Minimum:
    """Parameters after a pass.

    Parameters
    ----------
    filter : IntervalFilter
        With noise, delay and what the model lacks.
    parameters : (n_p,) array
    last : FilterPass
        With these.
    covariance : (n, n) array
        Of the parameters and the delay, if it is estimated.
    step : (n,) array
        Gauss-Newton step from here.
    converged : bool
    """

    kalman: IntervalFilter
    parameters: FloatArray
    last: FilterPass
    covariance: FloatArray
    step: FloatArray
    converged: bool = False

    @property
    def unknowns(self) -> FloatArray:
        """Parameters, and the delay if it is estimated."""
        return np.append(self.parameters, [self.kalman.delay] * self.kalman.free_delay)

    def moved(self, step: FloatArray, kalman: IntervalFilter) -> tuple[FloatArray, IntervalFilter]:
        """Parameters after a step, and another filter with the delay after it."""
        p = self.parameters + step[: len(self.parameters)]
        return p, replace(kalman, delay=float(np.clip(self.kalman.delay + step[len(p) :].sum(), -2.0, 50.0)))

    def without_delay(self) -> tuple[FloatArray, FloatArray]:
        """Parameters ``(n_p,)`` that are likeliest where inputs act at once, and their covariance.

        The change by a delay that is not significant counts as an error.
        """
        C, bounds = self.covariance, _bounds_of_step(self.kalman, self.parameters, held=True)
        slope = np.divide(C[:-1, -1], C[-1, -1], out=np.zeros(len(C) - 1), where=C[-1, -1] > 0.0)
        moved = np.clip(-slope * self.kalman.delay, *(x[:-1] for x in bounds))
        return self.parameters + moved, C[:-1, :-1] - np.outer(slope, C[-1, :-1]) + np.outer(moved, moved)


def minimised(kalman: IntervalFilter, p: FloatArray, *, outliers: bool, progress: Progress = None) -> Minimum:
    """Parameters with the likeliest predictions, with noise and what the model lacks, by local slopes.

    Parameters
    ----------
    filter : IntervalFilter
    p : (n_p,) array
        To begin with.
    outliers : bool
        Whether the fraction of outliers is estimated.
    progress : callable, optional
        Called with the number of each pass, and what was found so far.

    Returns
    -------
    Minimum
    """
    latest, now, reach = list[Minimum](), kalman.over_logs(p), 1.0
    for k in range(PASSES):
        held = kalman.free_delay and k < LATEST - 1  # it would stand for wrong parameters
        latest = [*latest, _after(kalman, p, now, held=held)][-LATEST:]
        found = replace(latest[-1], covariance=_covariance(latest))
        if progress is not None:
            progress(k, found)
        is_last = reach <= 0.5**LATEST
        found = replace(found, converged=not held and _has_converged(latest, 1.0 if is_last else CONVERGED))
        if found.converged or is_last:
            break
        following = with_scales(kalman, now, outliers=outliers)
        then, moved = found.moved(reach * found.step, following)
        after = moved.over_logs(then)
        if is_worse(after.losses, now.losses):
            # Noise, and what the model lacks, have changed, too.
            now = following.over_logs(p)
            if is_worse(after.losses, now.losses):
                kalman, reach = following, 0.5 * reach
                continue
        p, kalman, now, reach = then, moved, after, min(2.0 * reach, 1.0)
    return found


def over_spread(local: Minimum, *, outliers: bool, progress: Progress = None) -> Minimum:
    """Parameters with the likeliest predictions by slopes over the spread, if the samples are likelier with these.

    Where contacts chatter, a fit with local slopes ends in one of many small valleys of its loss, which slopes over ten
    standard errors do not see.  The mean of the latest passes counts, or the likeliest of them if their mean loses the
    motion.  A parameter near its local end is no surer than there; the difference is an error of either.

    Parameters
    ----------
    local : Minimum
        With local slopes.
    outliers, progress
        As `minimised`.

    Returns
    -------
    Minimum
    """
    p, widths, errors = local.parameters, _widths(local), np.sqrt(np.diag(local.covariance))
    kalman = replace(local.kalman, spread=with_widths(local.covariance, widths))
    latest, now, is_likelier, converged = list[Minimum](), kalman.over_logs(p), False, False
    if np.abs(now.losses - local.last.losses).sum() < 1.0 or is_worse(now.losses, local.last.losses):
        return local
    for k in range(3 * LATEST):
        end = _after(kalman, p, now)
        is_near = np.abs(end.unknowns - local.unknowns) <= CLEAR * errors
        end = replace(end, covariance=widened(end.covariance, np.where(is_near, errors, 0.0)))
        if k:  # the first is of the local end
            latest = [*latest, end][-LATEST:]
            converged = _has_converged(latest, CONVERGED)
            is_likelier = bool(np.median([x.last.loss for x in latest]) < local.last.loss)
            if progress is not None:
                progress(k, replace(end, covariance=_covariance(latest)))
        if converged or (len(latest) == LATEST and not is_likelier):
            break
        p, kalman = end.moved(end.step, with_scales(kalman, now, outliers=outliers))
        kalman = replace(kalman, spread=with_widths(end.covariance, widths))
        now = kalman.over_logs(p)
    if not is_likelier:
        return local
    likeliest, mean = min(latest, key=lambda x: x.last.loss), np.mean([x.unknowns for x in latest], axis=0)
    p, kalman = likeliest.moved(mean - likeliest.unknowns, likeliest.kalman)
    end = replace(likeliest, parameters=p, kalman=kalman, last=kalman.over_logs(p))
    covariance = _covariance(latest) + 0.25 * np.outer(mean - local.unknowns, mean - local.unknowns)
    best = end if end.last.loss < local.last.loss else likeliest
    return replace(best, converged=local.converged and converged, covariance=covariance)


def _after(kalman: IntervalFilter, p: FloatArray, now: FilterPass, *, held: bool = False) -> Minimum:
    """A pass with its step and covariance, with the priors of the parameters."""
    layout, none = kalman.intervals.layout, np.zeros(int(kalman.free_delay))
    precision = np.concatenate([1.0 / np.square(layout.prior_std), none])
    pull = precision * np.concatenate([layout.prior_mean - p, none])
    step = now.step(precision, pull, _bounds_of_step(kalman, p, held=held))
    return Minimum(kalman, p, now, now.covariance(precision), step)


def _widths(local: Minimum) -> FloatArray:
    """Standard deviations ``(n,)`` of the parameters, and of a delay, over which slopes are taken."""
    bounds, errors = local.kalman.intervals.layout.bounds, np.sqrt(np.diag(local.covariance))
    sizes = [abs(p) if x.positive and p else max(abs(p), 0.01) for p, x in zip(local.parameters, bounds, strict=True)]
    widest = 0.25 * np.append(sizes, [1.0] * local.kalman.free_delay)
    return np.where(errors > 0.0, np.minimum(SPREAD * errors, widest), widest)


def with_widths(covariance: FloatArray, widths: FloatArray) -> FloatArray:
    """Covariance ``(n, n)`` with nearly the correlations of another one, so that every direction has a width.

    Parameters
    ----------
    covariance : (n, n) array
    widths : (n,) array
        Its standard deviations.
    """
    errors = np.sqrt(np.diag(covariance))
    scale = np.divide(widths, errors, out=np.zeros_like(errors), where=errors > 0.0)
    correlated = 0.99 * covariance * np.outer(scale, scale)
    return np.asarray(correlated + np.diag(np.square(widths) - np.diag(correlated)))


def _errors(latest: Sequence[Minimum]) -> FloatArray:
    """Standard errors ``(n,)``, the median of passes: where contacts begin a step later, information jumps."""
    return np.asarray(np.sqrt(np.median([np.diag(x.covariance) for x in latest], axis=0)))


def _has_converged(latest: Sequence[Minimum], most: float) -> bool:
    """True if passes become no likelier, and the mean step is at most so many standard errors, but for chance."""
    if len(latest) < LATEST or is_worse(latest[0].last.losses, latest[-1].last.losses, deviations=1.0):
        return False
    steps, errors = np.array([x.step for x in latest]), _errors(latest)
    chance = 2.0 * np.minimum(np.std(steps, axis=0, ddof=1), errors) / np.sqrt(LATEST)
    return bool((np.abs(np.mean(steps, axis=0)) <= most * errors + chance).all())


def _covariance(latest: Sequence[Minimum]) -> FloatArray:
    """Covariance ``(n, n)``, with how far an estimate wanders from pass to pass."""
    wander = np.mean(np.square([x.step for x in latest]), axis=0)
    return np.asarray(widened(latest[-1].covariance, _errors(latest)) + np.diag(wander))


def is_worse(after: FloatArray, before: FloatArray, *, deviations: float = CLEAR) -> bool:
    """True if losses are larger by more than chance: where a contact begins a step earlier, that of an interval jumps.

    Parameters
    ----------
    after, before : (W,) array
        Of the same intervals, nats.
    deviations : float, optional
        Standard deviations that are no chance.
    """
    more = after - before
    return bool(more.sum() > max(1.0, deviations * np.sqrt(np.square(more).sum())))


def with_scales(kalman: IntervalFilter, now: FilterPass, *, outliers: bool) -> IntervalFilter:
    """The filter with the noise, and what the model lacks, by a pass."""
    noise = kalman.noise.updated(now.residuals, kalman.intervals.known, outliers=outliers)
    surprise = float(np.nanmean(now.surprise)) if np.isfinite(now.surprise).any() else 1.0
    factor = float(np.clip(surprise, 0.1, 4.0) ** (0.75 if surprise < 1.0 else 0.5))
    return replace(kalman, noise=noise, lack=max(kalman.lack * factor, LEAST_LACK))


def settled(kalman: IntervalFilter, p: FloatArray) -> tuple[IntervalFilter, FilterPass]:
    """The filter with the noise, and what the model lacks, of given parameters, and its pass.

    Parameters
    ----------
    filter : IntervalFilter
    p : (n_p,) array
    """
    now = kalman.over_logs(p)
    for _ in range(LATEST):
        kalman = with_scales(kalman, now, outliers=True)
        now = kalman.over_logs(p)
    return kalman, now


def _bounds_of_step(kalman: IntervalFilter, p: FloatArray, *, held: bool = False) -> tuple[FloatArray, FloatArray]:
    """Least and largest step: within the bounds, positive parameters at most halved or doubled, a delay by a sample."""
    low, high = np.array([(x.lower, x.upper) for x in kalman.intervals.layout.bounds]).T - p
    for j, bounds in enumerate(kalman.intervals.layout.bounds):
        if p[j] > 0.0 and (bounds.positive or bounds.lower == 0.0):
            low[j], high[j] = max(low[j], -0.5 * p[j]), min(high[j], p[j])
    late = [0.0 if held else 1.0] * kalman.free_delay
    return np.append(low, np.negative(late)), np.append(high, late)
