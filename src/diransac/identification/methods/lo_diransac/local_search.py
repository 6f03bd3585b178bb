"""Local optimisations from the best hypothesis, and what else explains a log: the likeliest explanation wins.

An explanation is a fit with its freedom: whether the model has discrepancies, how fast unmodelled accelerations vary,
and which errors its recordings have.  Explanations are compared by their evidence, in which freedom costs, so
that an exact model without delay is the estimate wherever it explains the log as well.

References
----------
MacKay 1992; Schwarz 1978 (the price of a scale).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import TimeLimitError
from diransac.identification.core.equations import linearized
from diransac.identification.core.fit import split, with_residuals
from diransac.identification.core.minimise import refine, refine_exact, refine_further, start
from diransac.identification.core.theta import EffectKind
from diransac.identification.core.windows import SHORTEST_LAG, Windows
from diransac.identification.method import report
from diransac.identification.methods.lo_diransac.input_noise import (
    averaged_noise,
    explains_all,
    may_explain,
    noise_of_inputs,
    refine_noisy,
    simpler_timings,
)
from diransac.identification.methods.lo_diransac.integration_steps import answer, with_fewest_steps
from diransac.identification.methods.lo_diransac.motion_equations import unexplained
from diransac.identification.methods.lo_diransac.projection import fitted_parameters, projected_parameters
from diransac.identification.methods.lo_diransac.recording_errors import (
    RecordingError,
    clear_errors,
    errors_of_inputs,
    errors_of_signals,
    with_errors,
)
from diransac.simulation import HOLDS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from diransac.identification.core.fit import Fit
    from diransac.identification.core.minimise import Prior, Refinement
    from diransac.identification.method import Callback
    from diransac.identification.methods.lo_diransac.settings import LoDiransacSettings
    from diransac.identification.methods.lo_diransac.smoothing import Motion

LATE: tuple[Literal["delay", "lag"], ...] = ("delay", "lag")
"""Errors by which inputs act late."""
AS_LIKELY = 5.0
"""Difference of two fits' evidence, nats, below which both are as likely."""

_SHORTEST = 3
"""Shortest interval, samples."""
_MOST_ERRORS = 8
"""Errors of recordings that the settings do not name, at most."""
_EXPLAINS = float(np.log(1.25))
"""Log of the factor by which an error of a recording must lower unmodelled accelerations."""
_EXPLAINS_DRIFT = float(np.log(4.0))
"""The same of a drift."""
_LABORIOUS = 1e6
"""Rows, times integration steps and unknowns, of a fit from which on its steps take a large part of a second each."""
_CONTINUOUS = (-0.9, -0.1)
"""Delays, samples, of held inputs that vary between samples."""


@dataclass(frozen=True)
class Explanation:
    """A fit with its freedom.

    Parameters
    ----------
    refinement : Refinement
    exact : bool
        Whether the fit is one of the model as it is.
    complete : bool, optional
        False if the time limit ended the search for a likelier one.
    """

    refinement: Refinement
    exact: bool
    complete: bool = True

    @property
    def intervals(self) -> Windows:
        """The logs, with the most probable errors of the recordings."""
        return self.refinement.intervals

    @property
    def is_comparable(self) -> bool:
        """False for a fit that has not converged, of so large a log that fits beside it would take minutes.

        Its evidence is not that of an optimum, and decides nothing between explanations.
        """
        intervals = self.intervals
        n_unknowns = len(intervals.augmented.unknowns)
        return self.refinement.converged or len(intervals.measured) * intervals.substeps * n_unknowns < _LABORIOUS

    @cached_property
    def cost(self) -> float:
        """Negative log evidence, with half the logarithm of the number of rows for each scale and each error."""
        intervals = self.intervals
        n_scales = int((self.noise_of_inputs > 0.0).sum()) if self.exact else 2 * intervals.model.n_v + 1
        n_scales += len(intervals.all_errors.kinds)
        cost = self.refinement.cost + averaged_noise(intervals, self.refinement.fit)
        return cost + 0.5 * n_scales * float(np.log(intervals.is_logged.sum()))

    @cached_property
    def noise_of_inputs(self) -> FloatArray:
        """Standard deviation ``(n_u,)`` of the noise of each input; 0 where there is none."""
        return noise_of_inputs(self.intervals, self.refinement.fit)

    @cached_property
    def projected(self) -> FloatArray:
        """Parameters ``(n,)`` that solve the equations on the fitted motion."""
        return projected_parameters(self.intervals, self.refinement.fit)

    @cached_property
    def unexplained(self) -> FloatArray:
        """Log of the RMS acceleration ``(n_v,)`` that the model does not explain."""
        left = unexplained(self.intervals, self.refinement.fit, self.projected)[self.intervals.occupied]
        return np.asarray(np.log(np.sqrt(np.square(left).mean(axis=0)) + 1e-300))


@dataclass(frozen=True, eq=False, repr=False)
class LocalSearch:
    """Local optimisations of one dataset.

    Parameters
    ----------
    settings : LoDiransacSettings
    motion : Motion
        Smoothed motion over the rows of the intervals.
    hypothesis : (n_p,) array
        The best one.
    prior : Prior
    callback : callable or None
    """

    settings: LoDiransacSettings
    motion: Motion
    hypothesis: FloatArray
    prior: Prior
    callback: Callback | None

    def likeliest(self, intervals: Windows, *, free_hold: bool, rival: Explanation | None = None) -> Explanation:
        """The likeliest explanation of the log.

        Parameters
        ----------
        intervals : Windows
            With inputs as recorded.
        free_hold : bool
            Whether another hold of the inputs may be an explanation.
        rival : Explanation, optional
            Outcome of another search.  A fit with its freedom decides whether this search is needed: it ends there
            if it is less likely, or leads to the same parameters.

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
            for found in self._ever_likelier(intervals, rival, free_hold=free_hold):
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

    def _ever_likelier(
        self, intervals: Windows, rival: Explanation | None, *, free_hold: bool
    ) -> Iterator[Explanation]:
        """The likeliest explanation so far after each stage of the search."""
        flexible = self._accurate(self._from_hypothesis(intervals))
        yield self._shown(flexible, 0.35)
        if not flexible.is_comparable:
            return
        if rival is not None and (ended := self._ended_by(rival, flexible)) is not None:
            yield self._shown(ended, 0.6)
            return
        best = self._accurate(self._simplest(flexible))
        yield self._shown(best, 0.6)
        named = self._named(intervals)
        if named:
            best = self._accurate(self._simplified(self._moved(best, best.intervals.with_errors(named))))
            yield best
        for k, found in enumerate(self._with_more_errors(best, free_hold=free_hold)):
            best = found
            yield self._shown(best, 0.6 + 0.03 * k)
        yield self._shown(self._with_noise(best, free_hold=free_hold), 0.85)

    def _ended_by(self, rival: Explanation, flexible: Explanation) -> Explanation | None:
        """Outcome that ends a search beside a rival; None where it may find another explanation as likely.

        A fit with the rival's freedom, where this is not exact and its intervals are parts of these, tells: the rival
        stays where that is less likely, and the likelier of both where their parameters agree.
        """
        parts, rest = divmod(flexible.intervals.length, rival.intervals.length)
        if rival.exact or rest or flexible.cost < rival.cost:
            return None
        intervals, own = replace(rival.intervals, hold=flexible.intervals.hold), rival.refinement.fit
        try:
            _, begin = split(flexible.intervals, flexible.refinement.fit, parts)
            found = self._accurate(self._optimised(rival, intervals, with_residuals(intervals, begin)))
            if found.cost > rival.cost + AS_LIKELY:
                return rival
            n, estimate = intervals.n_p, fitted_parameters(rival.intervals, own)
        except np.linalg.LinAlgError:
            return None
        errors, moved = np.sqrt(np.diag(estimate.covariance)), found.refinement.fit.shared[:n] - own.shared[:n]
        return min(rival, found, key=lambda x: x.cost) if (np.abs(moved) <= errors).all() else None

    def _with_more_errors(self, best: Explanation, *, free_hold: bool) -> Iterator[Explanation]:
        """Ever likelier explanations with further errors of recordings, or another hold of the inputs."""
        for k in range(_MOST_ERRORS):
            report(self.callback, "errors of the recordings", 0.6 + 0.03 * k)
            found = [self._simplified(x) for x in self._with_another_error(best, free_hold=free_hold)]
            if not found:
                break
            best = self._accurate(self._without_superfluous(min(found, key=lambda x: x.cost)))
            yield best

    def _without_superfluous(self, found: Explanation) -> Explanation:
        """The explanation with a timing of some inputs instead of one of all and another of the others, if it will do.

        That of all inputs is found first where one is late; those that are not then seem early by as much.
        """
        intervals, fewer = found.intervals, list[Windows]()
        sizes, sought = intervals.all_errors.sizes, self._sought(found)
        for common in (x for x in map(intervals.all_inputs, LATE) if x in sizes and x in sought):
            alone = intervals.without_error(common)
            for own in (x for x in sizes if x.of_inputs and x.what == common.what and x != common):
                rest = replace(common, columns=tuple(x for x in common.columns if x not in own.columns))
                fewer += [alone, alone.without_error(own).with_input_error(rest, sizes[common])]
        leanest = min((self._moved(found, x) for x in fewer), key=lambda x: x.cost, default=found)
        return leanest if leanest.cost < found.cost + AS_LIKELY else found

    def continued(self, intervals: Windows, fit: Fit, begin: Explanation) -> Explanation:
        """The likeliest explanation of a part of some logs, from a fit of that part with the freedom of all.

        Parameters
        ----------
        intervals : Windows
            Of the part, with the errors of all.
        fit : Fit
            Of the part.
        begin : Explanation
            Of all; inputs are held as there.

        Returns
        -------
        Explanation
        """
        best = self._optimised(begin, intervals, with_residuals(intervals, fit))
        for other in self._with_more_errors(best, free_hold=False):
            best = other
        return best

    def _shown(self, found: Explanation, fraction: float) -> Explanation:
        """The explanation itself, which is reported as the best so far."""
        intervals, fit = found.intervals, found.refinement.fit
        names, known = intervals.layout.names, np.atleast_1d(intervals.known.any(axis=0))
        measured = zip(intervals.model.signals, fit.noise.sigma.tolist(), known, strict=True)
        report(
            self.callback,
            "local optimisation",
            fraction,
            parameters=dict(zip(names, fit.shared[: len(names)].tolist(), strict=True)),
            residuals={n: x for n, x, known in measured if known},
        )
        return found

    def _named(self, intervals: Windows) -> list[EffectKind]:
        """Errors of recordings that the settings name, or require of all inputs."""
        model, settings = intervals.model, self.settings
        required = {"delay": settings.input_delay, "lag": settings.input_lag}
        signals, inputs = model.signals.index, list(model.inputs).index
        delays = settings.sensor_delays or ()
        named = [intervals.all_inputs(what) for what in LATE if required[what]]
        named += [EffectKind((signals(x),), "delay") for x in delays if x not in model.inputs]
        named += [EffectKind((inputs(x),), "delay", of_inputs=True) for x in delays if x in model.inputs]
        named += [EffectKind((signals(x),), "bias") for x in settings.sensor_biases or ()]
        return [*named, *(EffectKind((inputs(x),), "drift", of_inputs=True) for x in settings.gain_drifts or ())]

    def _sought(self, best: Explanation) -> list[EffectKind]:
        """Errors of recordings that the settings leave to the evidence.

        Where the model is exact, inputs, groups of signals and single signals of its measurement equations are tested:
        nothing else depends on the latter, so that the motion is as likely whatever their delay.
        """
        intervals, settings = best.intervals, self.settings
        model, alone = intervals.model, np.full(len(intervals.model.signals), not best.exact)
        alone[len(model.signals) - len(model.sensors) :] = True
        late = {intervals.all_inputs(what) for what in LATE}
        switches = {"delay": settings.input_delay, "lag": settings.input_lag}
        own = {"delay": settings.sensor_delays, "lag": settings.sensor_delays, "bias": settings.sensor_biases}
        own["drift"] = settings.gain_drifts

        def admits(kind: EffectKind) -> bool:
            if kind in late and not intervals.noisy:
                other = settings.input_lag if kind.what == "delay" else settings.input_delay
                return switches[kind.what] is not False and not other
            if kind.of_inputs and (intervals.noisy or switches.get(kind.what) is False):
                return False
            return own[kind.what] is None

        return [x for x in (*errors_of_signals(intervals, alone), *errors_of_inputs(intervals)) if admits(x)]

    def _with_another_error(self, best: Explanation, *, free_hold: bool) -> list[Explanation]:
        """Likelier explanations with another error of a recording, or another hold of the inputs."""
        sought, timings = self._sought(best), [best.intervals.all_inputs(what) for what in LATE]
        # A lag shows as a delay, and is tried where one does.
        tested = [x for x in sought if x.what != "lag" or replace(x, what="delay") not in sought]
        errors = clear_errors(best.intervals, best.refinement.fit, tested, worth=AS_LIKELY)
        common = max((x for x in errors if x.kind in timings), key=lambda x: x.gain, default=None)
        others = [self._moved(best, x) for x in self._timings(best, common, sought, free_hold=free_hold)]
        # Which hold is the likelier shows once its errors are at their optimum.
        found = [self._better(best, [x for x in others if x.intervals.hold == hold]) for hold in HOLDS]
        for error in errors:
            if error.kind not in timings:
                share = _EXPLAINS_DRIFT if error.kind.what == "drift" else _EXPLAINS
                lag = replace(error, kind=replace(error.kind, what="lag"))
                tried = [error, lag] if lag.kind in sought and error.size > SHORTEST_LAG else [error]
                moved = [self._moved(best, with_errors(best.intervals, best.refinement.fit, [x])) for x in tried]
                found += [self._better(best, [x], share, of_one=True) for x in moved]
        return [x for x in found if x is not best]

    def _timings(
        self, best: Explanation, error: RecordingError | None, sought: Sequence[EffectKind], *, free_hold: bool
    ) -> list[Windows]:
        """Other timings of all inputs: what an error suggests, a lag instead of a delay, or another hold."""
        intervals, (delay, lag) = best.intervals, (best.intervals.all_inputs(what) for what in LATE)
        sizes, others = intervals.all_errors.sizes, []
        now = sizes.get(delay, 0.0)
        late = now + sizes.get(lag, 0.0) + (error.size if error else 0.0)
        free_hold &= intervals.hold == "zero-order"
        if delay in sought and round(late) != now:
            others.append(intervals.with_input_error(delay, round(late) - now))
        punctual = intervals.without_error(delay)
        if lag in sought and lag not in sizes and late > SHORTEST_LAG:
            hold = "linear" if free_hold else intervals.hold
            others.append(replace(punctual.with_input_error(lag, late), hold=hold))
        if free_hold and _CONTINUOUS[0] < late < _CONTINUOUS[1]:
            others += [replace(punctual, hold=hold) for hold in ("linear", "smooth")]
        found = [intervals.with_input_error(error.kind, error.size)] if error else []
        return found + (self._promising(best, others) if others and {delay, lag} & sizes.keys() else others)

    def _promising(self, now: Explanation, others: Sequence[Windows]) -> list[Windows]:
        """Other timings but those with which a fit is less likely than with its own, at the optimum of which it is.

        To first order, after the step that answers the change of the simulations.
        """
        own, fit, at = now.intervals, now.refinement.fit, linearized(now.intervals, now.refinement.fit).of_fit

        def change(other: Windows) -> float:
            step, cost = answer(own, at, fit, other)
            return float(cost - (at.right_z * step.step_z).sum() - at.right_s @ step.step_p)

        return [x for x in others if not change(x) > AS_LIKELY]

    def _moved(self, now: Explanation, intervals: Windows) -> Explanation:
        """The explanation with other inputs, and the same freedom."""
        return self._optimised(now, intervals, with_residuals(intervals, now.refinement.fit))

    def _optimised(self, now: Explanation, intervals: Windows, begin: Fit) -> Explanation:
        """The explanation of other intervals with the same freedom."""
        if not now.exact:
            return replace(now, refinement=refine(self.settings, intervals, begin, self.prior))
        if intervals.noisy:
            return replace(now, refinement=refine_noisy(self.settings, intervals, begin, self.prior))
        kept = set(intervals.all_errors.kinds) >= set(now.intervals.all_errors.kinds)
        if kept and intervals.hold == now.intervals.hold:
            return replace(now, refinement=refine_further(self.settings, intervals, begin))
        # Inputs that act otherwise move the motion by far more than its scales.
        return replace(now, refinement=refine_exact(self.settings, intervals, begin, self.prior))

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

        others = [x for x in others if x.cost < now.cost - AS_LIKELY and (x.exact or explains(x))]
        return min(others, key=lambda x: x.cost, default=now)

    def _from_hypothesis(self, intervals: Windows) -> Explanation:
        """Local optimisation from the best hypothesis, with unmodelled accelerations."""
        report(self.callback, "local optimisation", 0.1)
        settings, prior = self.settings, self.prior
        begun = refine(settings, intervals, start(settings, intervals, self.motion, self.hypothesis, prior), prior)
        return Explanation(begun, exact=False)

    def _accurate(self, found: Explanation) -> Explanation:
        """The explanation with the fewest integration steps that it admits; fitted again if these are more."""
        intervals, fit = found.intervals, found.refinement.fit
        other, moved = with_fewest_steps(intervals, fit, self.settings.substeps)
        if other.substeps == intervals.substeps:
            return found
        if other.substeps > intervals.substeps:
            return self._optimised(found, other, moved)
        return replace(found, refinement=replace(found.refinement, intervals=other, fit=moved))

    def _simplified(self, found: Explanation) -> Explanation:
        """The explanation without the freedom that is no longer likely."""
        return found if found.exact else self._simplest(found)

    def _simplest(self, flexible: Explanation) -> Explanation:
        """The exact model, if it is as likely; otherwise unmodelled accelerations that vary as fast as is likely."""
        exact = self._likeliest_exact(flexible)
        if exact is not None and exact.cost < flexible.cost:
            return exact
        while self.settings.model_error and (parts := fewest_parts(flexible.intervals.length)):
            finer = self._optimised(flexible, *split(flexible.intervals, flexible.refinement.fit, parts))
            if finer.cost > flexible.cost - AS_LIKELY:
                break
            flexible = finer
        return flexible

    def _likeliest_exact(self, flexible: Explanation) -> Explanation | None:
        """The exact model from the parameters of a fit; None if these are impossible.

        One that is less likely may be so for a delay of all inputs, for which unmodelled accelerations stand.
        """
        intervals, fit, late = flexible.intervals, flexible.refinement.fit, flexible.intervals.all_inputs("delay")
        if not intervals.layout.admits(flexible.projected[None])[0]:
            return None
        begin = replace(fit, shared=np.concatenate([flexible.projected, fit.shared[intervals.n_p :]]))
        exact = self._exact(intervals, begin, flexible)
        if exact is None or exact.cost <= flexible.cost or late in exact.intervals.all_errors.kinds:
            return exact
        also = self._exact(intervals.with_errors([late]), begin, flexible) if late in self._sought(exact) else None
        return exact if also is None else min(exact, also, key=lambda x: x.cost)

    def _with_noise(self, found: Explanation, *, free_hold: bool) -> Explanation:
        """The exact model with noise of its inputs, if that explains the log: better, or where no exact model does.

        Unmodelled accelerations may be more probable than noise that is there: they have the smoothness of the motion.
        Noise took place if nothing but white noise is left.  Errors of inputs that stood for it are left out: drifts,
        fractions of samples and lags, which average it.
        """
        own = None if found.exact else found.projected
        if not (self.settings.max_steps and may_explain(found.intervals, found.refinement.fit, self.prior, own)):
            return found
        best = self._noisy(found, found.intervals)
        if not self._named(found.intervals) and (best or found.intervals.all_errors.input_lag.any()):
            for other in simpler_timings(found.intervals, free_hold=free_hold):
                noisy = self._noisy(found, other)
                if noisy and (best is None or noisy.cost < best.cost + AS_LIKELY):
                    best = noisy
        return found if best is None or (found.exact and best.cost > found.cost - AS_LIKELY) else best

    def _noisy(self, found: Explanation, intervals: Windows) -> Explanation | None:
        """The exact model with noise of its inputs over intervals; None where it is not noise that is left."""
        fit, p = found.refinement.fit, found.refinement.fit.shared[: intervals.n_p]
        p = p if found.exact else found.projected
        if not intervals.layout.admits(p[None])[0]:
            return None
        begin = with_residuals(intervals, replace(fit, shared=np.concatenate([p, fit.shared[intervals.n_p :]])))
        try:
            refined = refine_noisy(self.settings, intervals, begin, self.prior)
            is_noise = explains_all(
                refined.intervals, refined.fit, self.settings.candidate_terms, instead_of_exact=found.exact
            )
        except np.linalg.LinAlgError:
            return None
        return replace(found, refinement=refined, exact=True) if is_noise else None

    def _exact(self, intervals: Windows, begin: Fit, rival: Explanation) -> Explanation | None:
        """The exact model from a motion, with all integration steps: it is one simulation of the whole log.

        None if simulations overflow from there.
        """
        intervals = replace(intervals, substeps=self.settings.substeps)
        try:
            refined = refine_exact(self.settings, intervals, begin, self.prior)
        except np.linalg.LinAlgError:
            return None
        return replace(rival, refinement=refined, exact=True)


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
