"""Local optimisations from the best hypothesis, and what else explains a log: the likeliest explanation wins.

An explanation is a fit with its freedom: whether the model has discrepancies, how fast unmodelled accelerations vary,
and how inputs act after they are recorded.  Explanations are compared by their evidence, in which freedom costs, so
that an exact model without delay is the estimate wherever it explains the log as well.

References
----------
MacKay 1992; Schwarz 1978 (the price of a scale).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import TimeLimitError
from diransac.identification.method import report
from diransac.identification.methods.lo_diransac.hypotheses import robust_scores
from diransac.identification.methods.lo_diransac.normal_equations import with_residuals
from diransac.identification.methods.lo_diransac.projection import projected_parameters, unexplained
from diransac.identification.methods.lo_diransac.recording_errors import (
    clear_errors,
    errors_of,
    with_errors,
)
from diransac.identification.methods.lo_diransac.refinement import refine, refine_exact, start
from diransac.identification.methods.lo_diransac.shooting import ErrorKind
from diransac.time_limit import check_time

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from diransac.identification.method import Callback
    from diransac.identification.methods.lo_diransac.normal_equations import Fit
    from diransac.identification.methods.lo_diransac.recording_errors import RecordingError
    from diransac.identification.methods.lo_diransac.refinement import Prior, Refinement
    from diransac.identification.methods.lo_diransac.settings import LoDiransacSettings
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
    from diransac.identification.methods.lo_diransac.smoothing import Motion

__all__ = ["LEAST_LAG", "Explanation", "LocalSearch", "fewest_parts"]

LEAST_LAG = 0.1
"""Shortest lag of the inputs, samples."""

# Difference of two fits' evidence, nats, below which both are as likely.
_AS_LIKELY = 5.0
# Delays that are tried at a time, before they are refined to a sample.
_DELAYS_AT_A_TIME = 12
# Samples that the range of delays spans to either side at least, and at most.
_SAMPLES_OF_DELAY = 2, 100
# Lags that are tried where one is required.
_LAGS = 9
# Shortest interval, samples.
_SHORTEST = 3
# A delay that is worth an explanation: so many standard errors, and so many samples.
_SIGNIFICANT, _SMALL_DELAY = 3.0, 0.1
# Half a sample of delay or more is taken up by shifting the inputs.
_WHOLE_SAMPLE = 0.5
# Relative difference of parameters that makes a second start.
_APART = 0.2
# Log of the factor by which a delay, and a drift, must lower unmodelled accelerations.
_EXPLAINS, _EXPLAINS_DRIFT = float(np.log(1.25)), float(np.log(4.0))
# Prior delay of a fit without one.
_FIXED = 1e-6
# Decrease of the log residuals of each signal by which a delay is worth to be tried.
_SMALL_GAIN = 0.03
# Newton steps of the errors of recordings at most; changes over standard errors that end them.
_REFINEMENTS, _REFINED = 4, 0.1
# Inputs that vary between samples act half a sample before held ones.
_CONTINUOUS = (-0.9, -0.1)


@dataclass(frozen=True)
class ExactTrial:
    """A fit of the exact model that was less likely than an explanation with unmodelled accelerations.

    Parameters
    ----------
    behind : float
        Nats between them.
    cost : float
        Of that explanation.
    unexplained : (n_v,) array
        Log of the RMS acceleration that it left to unmodelled accelerations.
    length : int
        Samples of its intervals.
    """

    behind: float
    cost: float
    unexplained: FloatArray
    length: int


@dataclass(frozen=True)
class Explanation:
    """A fit with its freedom.

    Parameters
    ----------
    intervals : ShootingIntervals
        With the timing of the inputs.
    refinement : Refinement
    prior : Prior
        Of the fit; without a delay, where its delay is fixed.
    exact : bool
        Whether the fit is one of the model as it is.
    complete : bool, optional
        False if the time limit ended the search for a likelier one.
    trial : ExactTrial, optional
        The latest, of this explanation or of one that it came from.
    """

    intervals: ShootingIntervals
    refinement: Refinement
    prior: Prior
    exact: bool
    complete: bool = True
    trial: ExactTrial | None = None

    @property
    def cost(self) -> float:
        """Negative log evidence, with half the logarithm of the number of rows for each scale and for a delay."""
        intervals = self.intervals
        late = abs(intervals.delay + self.refinement.fit.shared[-1]) > _SMALL_DELAY or bool(intervals.lag)
        n_scales = (0 if self.exact else 2 * intervals.model.n_v + 1) + late
        return self.refinement.cost + 0.5 * n_scales * float(np.log(intervals.is_logged.sum()))

    @property
    def exact_is_hopeless(self) -> bool:
        """True if the exact model was so far behind that what has changed since cannot make it likelier.

        What it leaves goes with the unmodelled accelerations: if these fall by a factor, so do its residuals, and
        each sample gains the logarithm of it.  It may gain a nat more in every sample, and all that this one has.
        With errors of inputs, unmodelled accelerations stand for what is left of these, and tell nothing.
        """
        trial, intervals = self.trial, self.intervals
        if trial is None or trial.length != intervals.length or any(x.of_inputs for x in intervals.all_errors.kinds):
            return False
        fallen = max(0.0, float((trial.unexplained - self.unexplained).max()))
        return bool(trial.behind > intervals.known.sum() * (1.0 + fallen) + max(trial.cost - self.cost, 0.0))

    @cached_property
    def projected(self) -> FloatArray:
        """Parameters ``(n,)`` that solve the equations on the fitted motion."""
        return projected_parameters(self.intervals, self.refinement.fit)

    @cached_property
    def unexplained(self) -> FloatArray:
        """Log of the RMS acceleration ``(n_v,)`` that the model does not explain."""
        left = unexplained(self.intervals, self.refinement.fit, self.projected)[self.intervals.occupied]
        return np.asarray(np.log(np.sqrt(np.square(left).mean(axis=0)) + 1e-300))


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

        Raises
        ------
        TimeLimitError
            The time limit was reached before the first local optimisation had converged.
        """
        best: Explanation | None = None
        try:
            for found in self._ever_likelier(intervals, free_hold=free_hold):
                best = found
        except TimeLimitError:
            if best is None:
                raise
            return replace(best, complete=False)
        except np.linalg.LinAlgError:  # of another explanation, which is none then
            if best is None:
                raise
        assert best is not None
        return best

    def _ever_likelier(self, intervals: ShootingIntervals, *, free_hold: bool) -> Iterator[Explanation]:
        """The likeliest explanation so far after each stage of the search."""
        report(self.callback, "searching for a delay", 0.1)
        delay = self._likeliest_delay(intervals)
        flexible = self._from_hypothesis(intervals, 0)
        yield flexible
        best = self._simplest(flexible, self._prior_of(intervals))
        yield best
        if delay:
            delayed = replace(intervals, delay=delay)
            other = self._simplest(self._from_hypothesis(delayed, 1), self._prior_of(delayed))
            best = self._better(best, [other])
            yield best
        best = self._with_timing(best, free_hold=free_hold)
        yield best
        found = self._with_errors_of_recordings(self._with_named_errors(best))
        yield found
        if found is best:
            return
        # Inputs are late, or early, with respect to sensors that are so themselves.
        yield self._with_refined_errors(self._with_timing(found, free_hold=free_hold))

    def _with_timing(self, best: Explanation, *, free_hold: bool) -> Explanation:
        """The explanation with another timing of the inputs, where that makes it likelier or is required."""
        settings = self.settings
        forced = bool(settings.input_delay or settings.input_lag)
        for k in range(max(settings.max_delay_shifts, forced)):
            report(self.callback, "timing of the inputs", 0.6 + 0.1 * k)
            # A free delay suggests the others, even where no delay is admitted.
            is_free = k > 0 or (best.exact and settings.input_delay is not False)
            trial = best if is_free else self._refitted(best, best.intervals, self.prior)
            others = [self._refitted(trial, x) for x in self._timings(trial, free_hold=free_hold)]
            if settings.input_delay is not False and not (settings.input_lag and k == 0):
                others.insert(0, trial)
            required = forced and k == 0
            likelier = min(others, key=lambda x: x.cost) if required else self._better(best, others)
            if likelier is best and not required:
                break
            best = likelier
        return best

    def _with_named_errors(self, best: Explanation) -> Explanation:
        """The explanation with the errors of recordings that the settings name."""
        model, settings = best.intervals.model, self.settings
        signals, inputs = model.signals.index, list(model.inputs).index
        delays = settings.sensor_delays or ()
        named = [ErrorKind((signals(x),), "delay") for x in delays if x not in model.inputs]
        named += [ErrorKind((inputs(x),), "delay", of_inputs=True) for x in delays if x in model.inputs]
        named += [ErrorKind((signals(x),), "bias") for x in settings.sensor_biases or ()]
        named += [ErrorKind((inputs(x),), "drift", of_inputs=True) for x in settings.gain_drifts or ()]
        if not named:
            return best
        report(self.callback, "errors of the recordings", 0.8)
        return self._simplified(self._with_refined_errors(best, named))

    def _with_errors_of_recordings(self, best: Explanation) -> Explanation:
        """The explanation with errors of the recordings, one after the other, as long as they make it likelier.

        Where the model is exact, groups are tested, and single signals of its measurement equations: nothing else
        depends on them, so that the motion is as likely whatever their delay.
        """
        model, settings = best.intervals.model, self.settings
        named = {"delay": settings.sensor_delays, "bias": settings.sensor_biases, "drift": settings.gain_drifts}
        kinds = [kind for kind, names in named.items() if names is None]
        if "delay" in kinds and settings.input_lag is not False:
            kinds.append("lag")
        alone = np.full(len(model.signals), not best.exact)
        alone[len(model.signals) - len(model.sensors) :] = True
        for k in range(settings.max_sensor_errors):
            report(self.callback, "errors of the recordings", 0.8 + 0.01 * k)
            fit, likelier = best.refinement.fit, best
            errors = clear_errors(best.intervals, fit, alone, kinds, worth=_AS_LIKELY)
            if not best.exact:
                from diransac.identification.methods.lo_diransac.missing_terms import clear_errors_of_inputs

                errors += clear_errors_of_inputs(best.intervals, fit, best.projected, kinds)
            lag_may_help = True
            for error in errors:
                if error.kind.what == "lag" and not lag_may_help:
                    continue
                trial = self._with_errors(best, [error])
                if error.kind.of_inputs and error.kind.what == "delay":  # which acts much like a lag
                    lag_may_help = trial.cost < best.cost
                share = _EXPLAINS_DRIFT if error.kind.what == "drift" else _EXPLAINS
                if trial.cost < likelier.cost and self._better(best, [trial], share, of_one=True) is trial:
                    likelier = trial
            if likelier is best:
                break
            best = self._settled(likelier)
        return best

    def _settled(self, found: Explanation) -> Explanation:
        """The explanation with its errors at their optimum, and without the freedom that is no longer likely.

        Unmodelled accelerations stand for what is left of an error of inputs until there are none: the exact model
        comes first.
        """
        if any(x.of_inputs for x in found.intervals.all_errors.kinds):
            found = self._simplified(found)
        return found if found.exact else self._simplified(self._with_refined_errors(found))

    def _with_refined_errors(self, best: Explanation, more: Sequence[ErrorKind] = ()) -> Explanation:
        """The explanation at the optimum of its errors of recordings, and of more, with the same freedom."""
        for _ in range(_REFINEMENTS):
            kinds = dict.fromkeys([*best.intervals.all_errors.kinds, *more])
            if not kinds:
                break
            errors = errors_of(best.intervals, best.refinement.fit, tuple(kinds))
            if all(x.ratio < _REFINED for x in errors):
                break
            best = self._with_errors(best, errors)
        return best

    def _with_errors(self, now: Explanation, errors: Sequence[RecordingError]) -> Explanation:
        """The explanation with more errors, with the same freedom."""
        intervals = with_errors(now.intervals, now.refinement.fit, errors)
        return self._optimised(now, intervals, with_residuals(intervals, now.refinement.fit))

    def _optimised(self, now: Explanation, intervals: ShootingIntervals, begin: Fit) -> Explanation:
        """The explanation of other intervals with the same freedom."""
        fitted = refine_exact if now.exact else refine
        return replace(now, intervals=intervals, refinement=fitted(self.settings, intervals, begin, now.prior))

    def _better(
        self,
        now: Explanation,
        others: Sequence[Explanation],
        least: float = _EXPLAINS,
        *,
        of_one: bool = False,
    ) -> Explanation:
        """The likeliest explanation of which another timing, or an error of a recording, is worth to be believed.

        A controller's inputs answer disturbances, so that late inputs predict these, as late sensors do.  Where the
        model is not exact, either must also explain a good part of the accelerations that are otherwise unmodelled:
        of all together, or of one.
        """

        def explains(x: Explanation) -> bool:
            lower = now.unexplained - x.unexplained
            return bool((lower.max() if of_one else lower.sum()) > least)

        others = [x for x in others if x.cost < now.cost - _AS_LIKELY and (x.exact or explains(x))]
        return min(others, key=lambda x: x.cost, default=now)

    def _from_hypothesis(self, intervals: ShootingIntervals, k: int) -> Explanation:
        """Local optimisation from the best hypothesis, with this timing of the inputs and unmodelled accelerations."""
        report(self.callback, "local optimisation", 0.1 + 0.25 * k)
        begin = start(self.settings, intervals, self.motion, self.hypotheses[0], self._undelayed)
        refined = refine(self.settings, intervals, begin, self._undelayed)
        return Explanation(intervals, refined, self._undelayed, exact=False)

    @property
    def _undelayed(self) -> Prior:
        """The prior of a fit without a delay."""
        return replace(self.prior, delay=_FIXED * self.prior.delay)

    def _prior_of(self, intervals: ShootingIntervals) -> Prior:
        """The prior of a fit whose delay or lag is free, as far as the settings admit it."""
        return self._undelayed if self.settings.input_delay is False and not intervals.lag else self.prior

    def _simplified(self, found: Explanation) -> Explanation:
        """The explanation without the freedom that is no longer likely."""
        return found if found.exact else self._simplest(found, self._prior_of(found.intervals))

    def _simplest(self, flexible: Explanation, prior: Prior) -> Explanation:
        """The exact model, if it is as likely; otherwise unmodelled accelerations that vary as fast as is likely.

        The prior is that of the exact model.
        """
        exact = None if flexible.exact_is_hopeless else self._likeliest_exact(flexible, prior)
        if exact is not None and exact.cost < flexible.cost:
            return exact
        while self.settings.model_error and (parts := fewest_parts(flexible.intervals.length)):
            finer = self._split(flexible, parts)
            if finer.cost > flexible.cost - _AS_LIKELY:
                break
            flexible = finer
        if exact is None or not np.isfinite(exact.cost):
            return flexible
        cost, length = flexible.cost, flexible.intervals.length
        return replace(flexible, trial=ExactTrial(exact.cost - cost, cost, flexible.unexplained, length))

    def _likeliest_exact(self, flexible: Explanation, prior: Prior) -> Explanation | None:
        """The exact model from the parameters of a fit, or the best hypothesis; None if both are impossible."""
        intervals, fit = flexible.intervals, flexible.refinement.fit
        projected, found = flexible.projected, list[Explanation]()
        starts = np.array([projected, self.hypotheses[0]])
        starts = starts[: 1 + bool((np.abs(starts[1] - starts[0]) > _APART * np.abs(starts[0])).any())]
        for p in starts[intervals.layout.admits(starts)]:
            begin = with_residuals(intervals, replace(fit, shared=np.concatenate([p, fit.shared[intervals.n_p :]])))
            is_left = any(x.of_inputs for x in intervals.all_errors.kinds)
            try:
                refined = refine_exact(self.settings, intervals, begin, prior, flexible.cost)
            except np.linalg.LinAlgError:  # simulations by the exact model overflow from here: it is no explanation
                continue
            exact = Explanation(intervals, refined, prior, exact=True)
            found.append(self._with_refined_errors(exact) if is_left else exact)
            if found[-1].cost < flexible.cost:
                break
        return min(found, key=lambda x: x.cost, default=None)

    def _split(self, coarse: Explanation, parts: int) -> Explanation:
        """The fit with unmodelled accelerations that vary faster."""
        fit, intervals = coarse.refinement.fit, coarse.intervals.split(parts)
        n_x = fit.x.shape[1]
        series = coarse.intervals.rollouts.trajectories(coarse.intervals.batch(fit.shared, fit.x, fit.d))
        x = series[:, :: intervals.length, :n_x].reshape(-1, n_x)
        rho = fit.rho ** (1.0 / parts)
        begin = with_residuals(intervals, replace(fit, x=x, d=np.repeat(fit.d, parts, axis=0), rho=rho))
        return self._optimised(coarse, intervals, begin)

    def _timings(self, now: Explanation, *, free_hold: bool) -> list[ShootingIntervals]:
        """Other timings of the inputs that the fit suggests: whole samples of delay, a lag, or another hold."""
        settings = self.settings
        intervals, fit = now.intervals, now.refinement.fit
        local, error = fit.shared[-1], now.refinement.delay_error
        late = intervals.delay + intervals.lag + local
        if settings.input_lag and not intervals.lag:
            hold = "linear" if free_hold else intervals.hold
            return [self._with_likeliest_lag(replace(intervals, delay=0, hold=hold))]
        if abs(local) < max(_SIGNIFICANT * error, _SMALL_DELAY) and late == local:
            return []
        timings = []
        if intervals.lag:
            return [replace(intervals, lag=max(late, LEAST_LAG))]
        if abs(local) >= _WHOLE_SAMPLE and settings.input_delay is not False:
            timings.append(replace(intervals, delay=intervals.delay + round(local)))
        if free_hold and intervals.hold == "zero-order":
            if late > _WHOLE_SAMPLE and settings.input_lag is not False and not settings.input_delay:
                timings.append(replace(intervals, delay=0, lag=float(late), hold="linear"))
            if _CONTINUOUS[0] < late < _CONTINUOUS[1]:
                timings += [replace(intervals, delay=0, hold=hold) for hold in ("linear", "smooth")]
        return timings

    def _refitted(self, now: Explanation, intervals: ShootingIntervals, prior: Prior | None = None) -> Explanation:
        """The likeliest explanation with another timing, from the fit of this one.

        The prior is that of the new fit; None: as the settings admit a delay.
        """
        prior = prior or self._prior_of(intervals)
        fit, old = now.refinement.fit, now.intervals
        frees = prior.delay > self._undelayed.delay
        left = old.delay + old.lag + fit.shared[-1] - intervals.delay - intervals.lag
        left = left if frees and intervals.hold == old.hold else 0.0
        # A wide prior that the evidence narrows: a narrow one would never widen where nothing moves.
        is_wide = frees and prior.delay > now.prior.delay
        sizes = np.append(fit.prior[:-1], max(prior.delay, _WHOLE_SAMPLE) if is_wide else prior.delay)
        begin = with_residuals(intervals, replace(fit, shared=np.append(fit.shared[:-1], left), prior=sizes))
        if now.exact:
            refined = refine_exact(self.settings, intervals, begin, prior)
            return Explanation(intervals, refined, prior, exact=True)
        refined = refine(self.settings, intervals, begin, prior)
        return self._simplest(Explanation(intervals, refined, prior, exact=False, trial=now.trial), prior)

    def _with_likeliest_lag(self, intervals: ShootingIntervals) -> ShootingIntervals:
        """The lag, from half a sample to the latest delay, with which simulations by the best hypothesis agree best."""
        longest, every = self.delays(intervals)[1], np.arange(len(intervals))
        lags = np.geomspace(_WHOLE_SAMPLE, max(_WHOLE_SAMPLE, longest), _LAGS)
        tried = [replace(intervals, lag=float(x)) for x in lags]
        return min(tried, key=lambda x: float(robust_scores(x, self.motion, self.hypotheses[:1], every)[0]))

    def delays(self, intervals: ShootingIntervals) -> tuple[int, int]:
        """Earliest and latest delay, samples: those of the settings, but some samples at least and at most.

        A controller's delay is of its own samples, which may be minutes, and microseconds are no reason for thousands.

        Parameters
        ----------
        intervals : ShootingIntervals

        Returns
        -------
        int, int
            0 to a side on which the settings admit none.
        """
        low, high = self.settings.delay_range
        least, most = _SAMPLES_OF_DELAY
        early, late = (min(max(round(x / intervals.dt), least), most) if x > 0.0 else 0 for x in (-low, high))
        return -early, late

    def _likeliest_delay(self, intervals: ShootingIntervals) -> int:
        """Delay in samples with which simulations by the best hypothesis agree best with the log.

        Inputs that are held for many samples and then step cause few outliers under a wrong delay, which is a local
        optimum; so the number of whole samples is chosen before local optimisation.
        """
        every, scores = np.arange(len(intervals)), dict[int, float]()
        low, high = self.delays(intervals)

        def score(rows: int) -> float:
            if rows not in scores:
                check_time()
                delayed = replace(intervals, delay=rows)
                scores[rows] = float(robust_scores(delayed, self.motion, self.hypotheses[:1], every)[0])
            return scores[rows]

        if low == high or self.settings.input_delay is False:
            return 0
        step = max(1, (high - low) // (_DELAYS_AT_A_TIME - 1))
        tried = range(-(-low // step) * step, high + 1, step)
        best = min(tried, key=lambda rows: (score(rows), abs(rows)))
        while step > 1:
            step = max(1, step // 2)
            near = [x for x in (best - step, best, best + step) if low <= x <= high]
            best = min(near, key=lambda rows: (score(rows), abs(rows)))
        gain = score(0) - score(best)
        return best if gain > _SMALL_GAIN * intervals.known.any(axis=0).sum() else 0


def fewest_parts(length: int) -> int:
    """Number of equal parts into which an interval is split.

    Parameters
    ----------
    length : int
        Samples of the interval.

    Returns
    -------
    int
        The smallest above one with parts that are not too short; 0 where there is none.
    """
    return next((k for k in range(2, length // _SHORTEST + 1) if length % k == 0), 0)
