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

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from diransac.identification.methods.lo_diransac.following import Pass, Predictor
    from diransac.identification.methods.lo_diransac.mixture import Mixture

_PASSES, _CONVERGED, _SETTLED, _HALVINGS = 24, 0.7, 0.05, 3
"""Passes at most; step of the parameters, standard errors, and relative change of the noise that end them; steps that
are halved."""
_NO_WORSE = 1e-4
"""Part of the loss by which a step may raise it: contacts that begin a step earlier make it jump."""
_LATEST = 3
"""Steps that tell how far an estimate wanders from pass to pass."""
_SETTLING = 4
"""Passes in which scales settle with parameters that are given."""
_FASTER, _LEAST_LACKS = 0.75, 1e-4
"""Power of the surprise by which what the model lacks shrinks, and what it lacks at least."""
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
    wander : (n,) array
        Root mean square of the last few Gauss-Newton steps, the delay's last: where contacts begin a step earlier or
        later, they do not end.
    """

    predictor: Predictor
    parameters: FloatArray
    last: Pass
    converged: bool
    wander: FloatArray


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
    layout, known = predictor.intervals.layout, predictor.intervals.known
    converged, stuck, now, steps = False, False, predictor.over_logs(p), list[FloatArray]()
    for k in range(_PASSES):
        held = predictor.free_delay and k < _EARLY
        none = np.zeros(int(predictor.free_delay))
        precision = np.concatenate([1.0 / np.square(layout.prior_std), none])
        pull = precision * np.concatenate([layout.prior_mean - p, none])
        following = _with_scales(predictor, now, outliers=outliers)
        noise = following.noise
        step = now.step(precision, pull, _bounds_of_step(predictor, p, held=held))
        steps.append(step)
        if progress is not None:
            progress(k, Minimum(predictor, p, now, False, _wander(steps)))
        steady = np.abs(np.log(noise.sigma / predictor.noise.sigma)[predictor.columns]).max() < _SETTLED
        errors = np.sqrt(np.diag(now.robust_covariance(precision)))
        if steady and not held and (np.abs(step) <= _CONVERGED * errors).all():
            converged = True
            break
        before = now.loss_with(noise, known)
        for _ in range(_HALVINGS):
            then, predictor = _moved(following, p, step)
            found = predictor.over_logs(then)
            if found.loss < before + _NO_WORSE * abs(before):
                break
            step = 0.5 * step
        else:  # no step leads anywhere, unless the scales still move
            predictor, then = following, p
            found = predictor.over_logs(p)
            if stuck:
                converged = bool((np.abs(step) <= errors).all())
                now = found
                break
        stuck = bool(np.array_equal(then, p))
        p, now = then, found
    return Minimum(predictor, p, now, converged, _wander(steps))


def _wander(steps: Sequence[FloatArray]) -> FloatArray:
    """Root mean square ``(n,)`` of the last few steps."""
    return np.asarray(np.sqrt(np.mean(np.square(steps[-_LATEST:]), axis=0)))


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
    inlying = predictor.noise.inlying(now.residuals, known)
    return predictor.noise.updated(now.residuals, known, inlying, outliers=outliers)


def _bounds_of_step(predictor: Predictor, p: FloatArray, *, held: bool) -> tuple[FloatArray, FloatArray]:
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
