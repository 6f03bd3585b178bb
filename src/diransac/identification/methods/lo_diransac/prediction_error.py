"""Parameters of a machine that only a simulator knows, by the errors of one-interval predictions.

Gauss-Newton steps on the sums of `following`, each a pass over the logs, and updates of the noise (a mixture with
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
from diransac.identification.regression.uncertainty import CLEAR

if TYPE_CHECKING:
    from collections.abc import Callable

    from diransac.identification.core.noise import Mixture
    from diransac.identification.methods.lo_diransac.following import Pass, Predictor

_PASSES, _CONVERGED, _LEAST_REACH, _LIKELIER = 30, 0.5, 0.1, 1.0
"""Passes at most; mean step of the parameters, standard errors, over the latest passes, that ends them; part of a step
below which none leads anywhere; difference of losses, nats, that counts."""
_LATEST = 4
"""Passes that tell whether a fit has ended, and how far an estimate wanders from pass to pass."""
_SETTLING = 4
"""Passes in which scales settle with parameters that are given."""
_FASTER, _LEAST_LACKS = 0.75, 1e-4
"""Power of the surprise by which what the model lacks shrinks, and what it lacks at least."""
_SPREAD, _WIDEST, _SMALL = 10.0, 0.25, 0.01
"""Spread of a parameter over which slopes are taken, standard errors; at most, of its size; size at least, its unit."""
_SPREAD_PASSES, _ALIKE = 12, 0.99
"""Passes with slopes over the spread at most; correlation of two parameters in it at most."""
_EARLY, _REACH = 3, {"m": 0.05, "rad": 0.2}
"""Passes before a delay is estimated, for which wrong parameters would stand; step of other parameters at most."""


@dataclass(frozen=True)
class Minimum:
    """Parameters with the likeliest predictions.

    Parameters
    ----------
    predictor : Predictor
    parameters : (n_p,) array
    last : Pass
    converged : bool
    covariance : (n, n) array
        Of the parameters and the delay, if it is estimated.
    """

    predictor: Predictor
    parameters: FloatArray
    last: Pass
    converged: bool
    covariance: FloatArray

    def without_delay(self) -> tuple[FloatArray, FloatArray]:
        """Parameters ``(n_p,)`` that are likeliest where inputs act at once, and their covariance.

        The change by a delay that is not significant counts as an error.
        """
        C, bounds = self.covariance, _bounds_of_step(self.predictor, self.parameters, held=True)
        slope = np.divide(C[:-1, -1], C[-1, -1], out=np.zeros(len(C) - 1), where=C[-1, -1] > 0.0)
        moved = np.clip(-slope * self.predictor.delay, *(x[:-1] for x in bounds))
        return self.parameters + moved, C[:-1, :-1] - np.outer(slope, C[-1, :-1]) + np.outer(moved, moved)


def minimised(
    predictor: Predictor,
    p: FloatArray,
    *,
    outliers: bool,
    progress: Callable[[int, Minimum], None] | None = None,
) -> Minimum:
    """Parameters with the likeliest predictions, with noise and what the model lacks.

    Parameters
    ----------
    predictor : Predictor
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
    known = predictor.intervals.known
    converged, now, reach, latest = False, predictor.over_logs(p), 1.0, _Latest((), (), ())
    for k in range(_PASSES):
        held = predictor.free_delay and k < _EARLY
        precision, pull = _prior(predictor, p)
        following = _with_scales(predictor, now, outliers=outliers)
        step = now.step(precision, pull, _bounds_of_step(predictor, p, held=held))
        latest = latest.and_(step, now.robust_covariance(precision), now.losses)
        if progress is not None:
            progress(k, Minimum(predictor, p, now, False, latest.covariance()))
        is_last = reach < _LEAST_REACH
        converged = not held and latest.are_at_rest(1.0 if is_last else _CONVERGED)
        if converged or is_last:
            break
        then, moved = _moved(following, p, reach * step)
        found = moved.over_logs(then)
        if is_worse(found.losses, now.losses_with(following.noise, known)):
            # What the model lacks has changed, too.
            now = following.over_logs(p)
            if is_worse(found.losses, now.losses):
                predictor, reach = following, 0.5 * reach
                continue
        p, predictor, now, reach = then, moved, found, min(2.0 * reach, 1.0)
    return Minimum(predictor, p, now, converged, latest.covariance())


def over_spread(found: Minimum, *, outliers: bool, progress: Callable[[int, Minimum], None] | None = None) -> Minimum:
    """Parameters with the likeliest predictions by slopes over the spread, if the samples are likelier with these.

    Where contacts chatter, a fit with local slopes ends in one of many small valleys of its loss, which slopes over ten
    standard errors do not see.  The mean of the latest passes counts, or the likeliest of them if their mean loses the
    motion.  A parameter near its local end is no surer than there; the difference is an error of either.

    Parameters
    ----------
    found : Minimum
        With local slopes.
    outliers : bool
        Whether the fraction of outliers is estimated.
    progress : callable, optional
        Called with the number of each pass, and what was found so far.

    Returns
    -------
    Minimum
    """
    p, widths, errors = found.parameters, _widths(found), np.sqrt(np.diag(found.covariance))
    local = _with_delay(found.predictor, p)
    predictor = replace(found.predictor, spread=with_widths(found.covariance, widths))
    passes, latest = list[Minimum](), _Latest((), (), ())
    now, is_at_rest, is_likelier = predictor.over_logs(p), False, False
    if _is_alike(now, found.last) or is_worse(now.losses, found.last.losses):
        return found
    for k in range(_SPREAD_PASSES):
        precision, pull = _prior(predictor, p)
        step, covariance = now.step(precision, pull, _bounds_of_step(predictor, p)), now.robust_covariance(precision)
        is_near = np.abs(_with_delay(predictor, p) - local) <= CLEAR * errors
        covariance = _no_surer(covariance, np.where(is_near, errors, 0.0))
        if k:  # the first is of the local end
            latest = latest.and_(step, covariance, now.losses)
            passes = [*passes, Minimum(predictor, p, now, False, latest.covariance())][-_LATEST:]
            is_at_rest = latest.are_at_rest(_CONVERGED)
            is_likelier = bool(np.median([_loss(x) for x in passes]) < _loss(found))
        if passes and progress is not None:
            progress(k, passes[-1])
        if is_at_rest or (len(passes) == _LATEST and not is_likelier):
            break
        p, predictor = _moved(_with_scales(predictor, now, outliers=outliers), p, step)
        predictor = replace(predictor, spread=with_widths(covariance, widths))
        now = predictor.over_logs(p)
    if not is_likelier:
        return found
    likeliest = min(passes, key=_loss)
    mean = np.mean([_with_delay(x.predictor, x.parameters) for x in passes], axis=0)
    other, covariance = mean - local, latest.covariance()
    p, predictor = likeliest.parameters, likeliest.predictor
    p, predictor = _moved(predictor, p, mean - _with_delay(predictor, p))
    end = Minimum(predictor, p, predictor.over_logs(p), False, covariance)
    return replace(
        end if _loss(end) < _loss(found) else likeliest,
        converged=found.converged and is_at_rest,
        covariance=covariance + 0.25 * np.outer(other, other),
    )


def _prior(predictor: Predictor, p: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Precision ``(n,)`` of the prior of the parameters, and its pull; 0 of a delay."""
    layout, none = predictor.intervals.layout, np.zeros(int(predictor.free_delay))
    precision = np.concatenate([1.0 / np.square(layout.prior_std), none])
    return precision, precision * np.concatenate([layout.prior_mean - p, none])


def _no_surer(covariance: FloatArray, least: FloatArray) -> FloatArray:
    """Covariance with standard deviations that are at least others ``(n,)``."""
    own = np.sqrt(np.diag(covariance))
    more = np.divide(np.maximum(own, least), own, out=np.zeros_like(own), where=own > 0.0)
    return np.asarray(covariance * np.outer(more, more) + np.diag(np.where(own > 0.0, 0.0, np.square(least))))


def _is_alike(now: Pass, before: Pass) -> bool:
    """True if passes differ by less than counts."""
    return bool(np.abs(now.losses - before.losses).sum() < _LIKELIER)


def _loss(found: Minimum) -> float:
    return float(found.last.losses.sum())


def _widths(found: Minimum) -> FloatArray:
    """Standard deviations ``(n,)`` of the parameters, and of a delay, over which slopes are taken."""
    bounds, errors = found.predictor.intervals.layout.bounds, np.sqrt(np.diag(found.covariance))
    sizes = [abs(p) if x.positive and p else max(abs(p), _SMALL) for p, x in zip(found.parameters, bounds, strict=True)]
    widest = _WIDEST * np.array([*sizes, *[1.0] * found.predictor.free_delay])
    return np.where(errors > 0.0, np.minimum(_SPREAD * errors, widest), widest)


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
    correlated = _ALIKE * covariance * np.outer(scale, scale)
    return np.asarray(correlated + np.diag(np.square(widths) - np.diag(correlated)))


def _with_delay(predictor: Predictor, p: FloatArray) -> FloatArray:
    """Parameters, and the delay if it is estimated."""
    return np.append(p, [predictor.delay] * predictor.free_delay)


@dataclass(frozen=True)
class _Latest:
    """The latest passes: where contacts begin a step earlier or later, steps do not end, and information jumps.

    Parameters
    ----------
    steps : tuple of (n,) array
        Whole Gauss-Newton steps.
    covariances : tuple of (n, n) array
    losses : tuple of (W,) array
    """

    steps: tuple[FloatArray, ...]
    covariances: tuple[FloatArray, ...]
    losses: tuple[FloatArray, ...]

    def and_(self, step: FloatArray, covariance: FloatArray, losses: FloatArray) -> _Latest:
        """With another pass."""
        every = (*self.steps, step), (*self.covariances, covariance), (*self.losses, losses)
        return _Latest(*(x[-_LATEST:] for x in every))

    @property
    def errors(self) -> FloatArray:
        """Standard errors ``(n,)`` that half of the passes tell at least."""
        return np.asarray(np.sqrt(np.median([np.diag(x) for x in self.covariances], axis=0)))

    def are_at_rest(self, most: float) -> bool:
        """True if passes become no likelier, and the mean step is at most so many standard errors, but for chance."""
        if len(self.steps) < _LATEST or is_worse(self.losses[0], self.losses[-1], deviations=1.0):
            return False
        mean, scatter = np.abs(np.mean(self.steps, axis=0)), np.std(self.steps, axis=0, ddof=1)
        chance = 2.0 * np.minimum(scatter, self.errors) / np.sqrt(_LATEST)
        return bool((mean <= most * self.errors + chance).all())

    def covariance(self) -> FloatArray:
        """Covariance ``(n, n)``, with how far an estimate wanders from pass to pass."""
        of_last = np.sqrt(np.diag(self.covariances[-1]))
        more = np.divide(self.errors, of_last, out=np.ones_like(of_last), where=of_last > 0.0)
        wander = np.mean(np.square(self.steps), axis=0)
        return np.asarray(self.covariances[-1] * np.outer(more, more) + np.diag(wander))


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
    return bool(more.sum() > max(_LIKELIER, deviations * np.sqrt(np.square(more).sum())))


def settled(predictor: Predictor, p: FloatArray) -> tuple[Predictor, Pass]:
    """The predictor with the noise, and what the model lacks, of given parameters, and its pass.

    Parameters
    ----------
    predictor : Predictor
    p : (n_p,) array
    """
    now = predictor.over_logs(p)
    for _ in range(_SETTLING):
        predictor = _with_scales(predictor, now, outliers=True)
        now = predictor.over_logs(p)
    return predictor, now


def _with_scales(predictor: Predictor, now: Pass, *, outliers: bool) -> Predictor:
    """The predictor with the noise, and what the model lacks, by a pass."""
    noise = _noise_after(predictor, now, outliers=outliers)
    factor = float(np.clip(now.surprise, 0.1, 4.0) ** (_FASTER if now.surprise < 1.0 else 0.5))
    return replace(predictor, noise=noise, lacks=max(predictor.lacks * factor, _LEAST_LACKS))


def _noise_after(predictor: Predictor, now: Pass, *, outliers: bool) -> Mixture:
    """The noise by the residuals of a pass."""
    known = predictor.intervals.known
    return predictor.noise.updated(now.residuals, known, outliers=outliers)


def _bounds_of_step(predictor: Predictor, p: FloatArray, *, held: bool = False) -> tuple[FloatArray, FloatArray]:
    """Least and largest step: within the bounds, positive parameters at most halved or doubled, a delay by a sample."""
    low, high = np.full(len(p), -np.inf), np.full(len(p), np.inf)
    for j, bounds in enumerate(predictor.intervals.layout.bounds):
        low[j], high[j] = bounds.lower - p[j], bounds.upper - p[j]
        if p[j] > 0.0 and (bounds.positive or bounds.lower == 0.0):
            low[j], high[j] = max(low[j], -0.5 * p[j]), min(high[j], p[j])
        elif bounds.unit in _REACH:
            reach = max(_REACH[bounds.unit], abs(p[j]))
            low[j], high[j] = max(low[j], -reach), min(high[j], reach)
    if predictor.free_delay:
        late = 0.0 if held else 1.0
        low, high = np.append(low, -late), np.append(high, late)
    return low, high


def _moved(predictor: Predictor, p: FloatArray, step: FloatArray) -> tuple[FloatArray, Predictor]:
    """Parameters after a step, and the predictor with the delay after it."""
    if not predictor.free_delay:
        return p + step, predictor
    return p + step[:-1], replace(predictor, delay=float(np.clip(predictor.delay + step[-1], -2.0, 50.0)))
