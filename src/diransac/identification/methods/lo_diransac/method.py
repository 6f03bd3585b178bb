"""The steps of lo-diransac in their order.

1. `smoothing`: screening of samples; the motion without a model.
2. `hypotheses`: parameters from random samples of the equations in weak form, scored by simulation.
3. `refinement`: the most probable motion and parameters, noise and discrepancies, from the best of them.
4. `projection`: parameters of the whole motion, and their covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.data.input_timing import InputTiming
from diransac.data.segment import long_runs, silent_rows
from diransac.errors import IdentificationError, LogError, ModelError, SettingsError, TimeLimitError
from diransac.identification.estimate import (
    TIME_LIMIT,
    Competition,
    Diagnosis,
    Estimate,
    Finding,
    HausmanTest,
    Resolution,
)
from diransac.identification.identifiability import check_structure, unidentifiable
from diransac.identification.method import report, within
from diransac.identification.methods.lo_diransac.checks import compared_parts, findings_of_fit
from diransac.identification.methods.lo_diransac.competition import Contest, is_settled
from diransac.identification.methods.lo_diransac.hypotheses import find_hypotheses, find_spikes
from diransac.identification.methods.lo_diransac.instruments import (
    Instrumented,
    check_set_points,
    instrumented_estimate,
)
from diransac.identification.methods.lo_diransac.local_search import LEAST_LAG, LocalSearch, fewest_parts
from diransac.identification.methods.lo_diransac.projection import (
    ProjectedEstimate,
    discrepancy_units,
    estimate_parameters,
    fitted_parameters,
    parameter_units,
    residuals_of_motion,
)
from diransac.identification.methods.lo_diransac.recording_errors import delays_of_inputs, lags_of_inputs
from diransac.identification.methods.lo_diransac.refinement import make_prior
from diransac.identification.methods.lo_diransac.segments import ActingInputs
from diransac.identification.methods.lo_diransac.settings import LoDiransacSettings
from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
from diransac.identification.methods.lo_diransac.smoothing import (
    Motion,
    Samples,
    choose_half_widths,
    odd_window,
    running_median,
    screened_inputs,
    smooth,
    stuck_rows,
)
from diransac.identification.methods.lo_diransac.structural import possible_terms
from diransac.identification.methods.lo_diransac.unmeasured import (
    measured_signals,
    unmeasured_by_name,
    unmeasured_states,
    with_observed_states,
    with_unmeasured_states,
)
from diransac.identification.refusal import MotionRows, cause_of_refusal, check_signs
from diransac.process import memory_kept, single_threaded
from diransac.simulation import default_threads
from diransac.time_limit import check_time

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset
    from diransac.data.segment import Segment
    from diransac.identification.method import Callback
    from diransac.identification.methods.lo_diransac.checks import Change
    from diransac.identification.methods.lo_diransac.local_search import Explanation
    from diransac.identification.methods.lo_diransac.missing_terms import MissingTerms
    from diransac.identification.methods.lo_diransac.normal_equations import Fit
    from diransac.identification.methods.lo_diransac.refinement import Refinement
    from diransac.identification.settings import Settings

__all__ = ["LoDiransac", "configured", "prepared"]

_FEWEST_INTERVALS = 4
_OUTLIER, _TINY = 0.5, 1e-9
# Fraction of a signal's spread from which on its noise leaves nothing to explain.
_ALL_OF_IT = 0.8
# Unexplained part of an acceleration from which on states that nothing measures are doubtful.
_MUCH = 0.1
# A significant delay: so many standard errors, and so many samples.
_SIGNIFICANT, _SMALL_DELAY = 3.0, 0.25
# Samples of running medians at most: spikes last for samples, however many of them there are in a second.
_MOST_INPUTS, _MOST_SAMPLES = 15, 31
# Samples of the intervals of a second search at most, as far as their number has divisors.
_SHORT = 25
_GAUSSIAN = 10_000
"""Degrees of freedom of an interval whose covariance is not itself an estimate from few numbers."""
_MANY_ROWS = 200_000
"""Rows from which on temporary arrays are so large that the system's allocator gives them back at once."""


@dataclass(frozen=True)
class LoDiransac(LoDiransacSettings):
    """Locally optimised DIRANSAC: random samples, consensus by simulation, one weak-constraint fit of all logs.

    Every default works for any model and any subset of signals.  Windows have at least 5 samples.

    Parameters
    ----------
    criteria : Settings, optional
        Settings of the evaluation: weights, thresholds and initial state, threads.
    stuck_rows : bool, optional
        Whether rows that repeat the row before in every signal are taken as missing.
    input_window : float, optional
        Window of the Hampel filter that replaces momentary leaps of inputs, s; at most 15 samples.
    input_threshold : float, optional
        Threshold of the Hampel filter, in local standard deviations.
    median_window : float, optional
        Window of the running median from which smoothing starts, s; at most 31 samples.
    smoothing_half_width : float, optional
        Usual half width of the smoothing polynomials and length of the shooting intervals, s; at most 25 samples.
        Cross-validation chooses between it and three, nine, ... times its value, for smoothing also a third of it;
        signals that are sampled more slowly have as many samples of their own.
    n_samples, n_nonlinear_samples : int, optional
        Number of random samples of a model that is affine in its parameters, and of others.
    largest_sample : int, optional
        Largest number of rows of each equation in a sample, over the number of parameters.
    n_screening_intervals, n_finalists : int, optional
        Number of intervals on which all hypotheses are scored; number of hypotheses that are scored on all intervals.
    delay_range : (float, float), optional
        Smallest and largest delay of the inputs, s, tried in whole samples before local optimisation; where it is not
        zero, 2 samples at least and 100 at most.
    input_delay, input_lag : bool, optional
        Whether inputs act after a delay, or after a first-order lag of the actuators: True, always; False, never; None,
        where that is the likelier explanation of the log.  Where the model is not exact, an actuator may have a lag of
        its own.
    max_delay_shifts : int, optional
        Rounds in which other delays, a lag and another hold of the inputs are tried after the first optimisations.
    sensor_delays, sensor_biases, gain_drifts : sequence of str, optional
        Signals, or inputs, whose delay is estimated in any case, signals whose bias is, and inputs whose gain drifts;
        that of no other is.  An input's delay is its own, besides that of all.  None: those that the residuals show
        clearly.
    max_sensor_errors : int, optional
        Largest number of unnamed ones of these that are estimated; where the model is exact, only of groups of sensors
        and of those with a measurement equation.
    set_points : sequence of str, optional
        Columns of the logs that disturbances do not change: set-points, or inputs of a machine without feedback.  Where
        the model is not exact, they are instruments: a parameter that feedback biases is estimated from them, and
        named.
    substeps : int, optional
        Integration steps per sample; one step is inaccurate by a percent where dry friction changes sign between
        samples or links are light.
    max_steps : int, optional
        Largest number of Gauss-Newton steps of a local optimisation; 0: the best hypothesis is the estimate.
    outliers : bool, optional
        Whether the noise of each signal has outliers; otherwise it is Gaussian.
    model_error : bool, optional
        Whether the size of unmodelled accelerations is estimated; otherwise they vanish.
    prior_model_error : float, optional
        Prior size of the unmodelled accelerations, over the spread of the accelerations.
    prior_discrepancy, initial_discrepancy : float, optional
        Size of input gain and bias discrepancies, over that which equals an equation's inertial force: of the prior,
        and before the evidence determines it.
    prior_delay : float, optional
        Prior standard deviation of the input delay, s.
    projection : bool, optional
        Whether discrepancies in the column space of the regressor are attributed to the parameters; otherwise these are
        those of the fit.
    prior_inflation : float, optional
        Factor of the prior on model error whose effect on the parameters is added to their covariance.
    suggestions : bool, optional
        Whether terms are searched that would explain the unmodelled forces, and terms that the model may lack are
        weighted for `Result.structural_intervals`.
    candidate_terms : callable, optional
        Further candidates of that search: ``candidate_terms(q, v, u)`` returns expressions by name.

    Raises
    ------
    SettingsError
        A value is out of range, or of another type.
    """

    def fit(self, dataset: Dataset, seed: int, callback: Callback | None = None) -> Estimate:
        """Parameters of the model from the logs, without starting values or thresholds.

        Parameters
        ----------
        dataset : Dataset
        seed : int
            Seed of all random samples.
        callback : callable, optional
            Called with a `Progress` at every stage.

        Returns
        -------
        Estimate

        Raises
        ------
        LogError
            The logs are too short, or sampled at different rates.
        SettingsError
            A signal or an input is named that the logs lack, or a set-point that is no instrument.
        IdentificationError
            No sample gives parameters within their bounds.
        TimeLimitError
            The time limit was reached before the first local optimisation had converged.
        """
        memory = memory_kept() if dataset.n_rows > _MANY_ROWS else nullcontext()
        with single_threaded(), memory:  # matrices are small: more threads would only add waiting
            return _fitted(self, dataset, int(seed), callback)


def configured(settings: Settings, **options: Any) -> LoDiransac:
    """The method with its own options, and criteria of the evaluation.

    Parameters
    ----------
    settings : Settings
        Criteria.
    options : object
        Other fields of `LoDiransac`.

    Returns
    -------
    LoDiransac
    """
    return LoDiransac(settings, **options)


def _fitted(settings: LoDiransac, dataset: Dataset, seed: int, callback: Callback | None) -> Estimate:
    """Parameters of the dataset's model, step by step."""
    _check_sensors(settings, dataset)
    check_set_points(dataset, settings.set_points)
    unknown = [name for name in settings.start or () if name not in dataset.model.parameters]
    if unknown:
        has = ", ".join(dataset.model.parameters)
        raise SettingsError(f'start names "{unknown[0]}", which is not to be identified; these are: {has}')
    allowed = len(dataset.model.parameters) - 1
    check_structure(dataset.model, dataset.source, allowed, ranges=dataset.ranges)
    best = _competed(settings, dataset, seed, callback)
    likeliest, result, intervals, motion = best.likeliest, best.result, best.likeliest.intervals, best.motion
    notes, refined = best.notes, likeliest.refinement
    report(callback, "estimating parameters", 0.9)
    instrumented = Instrumented(result, np.zeros(len(result.parameters)))
    if settings.set_points and settings.projection and not (likeliest.exact or best.impossible):
        instrumented = instrumented_estimate(
            intervals, refined.fit, result, dataset, settings.set_points, settings.prior_inflation
        )
        result = instrumented.result
    if best.impossible or dataset.layout.on_bounds(result.parameters).any():
        check_signs(dataset.model, dataset.layout, _rows_of_logs(intervals, motion), dataset.source)
    parts, lacks = compared_parts(likeliest, result, settings.prior_inflation), None
    if settings.suggestions and not likeliest.exact:
        from diransac.identification.methods.lo_diransac.missing_terms import missing_terms

        lacks = missing_terms(intervals, refined.fit, result, settings.candidate_terms)
    ambiguity = _ambiguity(parts.changes, lacks, instrumented)
    checks = (
        *_checks(settings, intervals, motion, refined),
        *_checks_of_bounds(best),
        *_checks_of_unmeasured(best),
        *instrumented.findings,
        *findings_of_fit(likeliest, motion, replace(result, covariance=result.covariance + ambiguity), parts),
    )
    forced = bool(settings.input_delay or settings.input_lag)
    found = _Found(
        dataset, intervals, motion, refined, result, ambiguity, forced, instrumented.tests, lacks, best.contest
    )
    end = "converged" if refined.converged else "limit of steps"
    end = end if likeliest.complete else TIME_LIMIT
    return _estimate(settings, found, best.n_hypotheses, end, notes, checks)


@dataclass(frozen=True)
class Decided:
    """Outcome of a competition: its summary, and the inputs of the winner unless it is an estimate of the fit."""

    summary: Competition
    acting: ActingInputs | None


@dataclass(frozen=True)
class _Searched:
    """The likeliest explanation of the logs, and the motion that its search began with.

    ``impossible`` names parameters that would violate a strict bound by least squares of the whole motion; the
    result is that of the fit then.
    """

    motion: Motion
    notes: tuple[str, ...]
    n_hypotheses: int
    likeliest: Explanation
    result: ProjectedEstimate
    impossible: tuple[str, ...]
    contest: Decided | None = None

    @property
    def unexplained(self) -> float:
        """Largest RMS acceleration that the model does not explain, over the spread of its motion.

        That of states which nothing measures is the spread of the fit; their motion before it was that of a hypothesis.
        """
        intervals, motion, hidden = self.likeliest.intervals, self.motion, unmeasured_states(self.likeliest.intervals)
        model, first = intervals.model, intervals.model.n_q + intervals.model.n_v
        fitted = residuals_of_motion(intervals, self.likeliest.refinement.fit, self.result.parameters)[0][2]
        measured = np.array([name not in hidden for name in model.velocities])
        spread = np.where(
            measured, motion.spread[first : first + model.n_v], fitted[intervals.counted].std(axis=0) + _TINY
        )
        left = np.sqrt(np.square(self.result.unexplained[intervals.occupied]).mean(axis=0))
        return float((left / spread).max())

    @property
    def is_doubtful(self) -> bool:
        """True if much is unexplained of a motion of which nothing measures a part: either may be anything.

        The unmeasured states may have begun on wrong trajectories, for which a resonance that smoothing takes for noise
        is enough.
        """
        return bool(unmeasured_states(self.likeliest.intervals)) and self.unexplained > _MUCH


def _competed(settings: LoDiransac, dataset: Dataset, seed: int, callback: Callback | None) -> _Searched:
    """The likeliest explanation of the logs, with the estimate that predicts best.

    A search that fails, or whose estimates another one beats, is followed by a second one, from that estimate.
    """
    report(callback, "smoothing", 0.0)
    whole = prepared(settings, dataset)
    refused: Exception | None = None
    try:
        first = _likeliest(settings, dataset, seed, callback, whole)
    except (IdentificationError, np.linalg.LinAlgError) as error:
        first, refused = None, error
    if first is not None and (settings.set_points or is_settled(first.likeliest, first.motion)):
        return first
    contest = Contest(settings, dataset, *whole[:2], seed, callback)
    try:
        found = _decided(settings, contest, first, whole)
    except TimeLimitError:
        if first is None:
            raise
        return replace(first, likeliest=replace(first.likeliest, complete=False))
    if first is None and (found is None or not contest.predicts):
        assert refused is not None
        raise refused
    return found or first  # type: ignore[return-value]  # one of them is there


def _decided(
    settings: LoDiransac,
    contest: Contest,
    first: _Searched | None,
    whole: tuple[ShootingIntervals, Motion, tuple[str, ...]],
) -> _Searched | None:
    """The search whose estimate predicts best; None where nothing could be compared."""
    intervals, dataset = whole[0], contest.dataset
    holds = [dataset.input_hold] if dataset.input_hold else ["zero-order", "linear"]
    actings = [ActingInputs.recorded(intervals, hold) for hold in holds]
    starts = [] if (given := _given_start(settings, dataset)) is None else [given]
    forced = bool(settings.input_delay or settings.input_lag)
    if first is not None:
        fit, own = first.likeliest.refinement.fit, first.likeliest.intervals
        timing = timing_of(own, first.likeliest.refinement, forced=forced)
        contest.add_fit(first.likeliest, timing)
        starts += [first.result.parameters, fit.shared[: own.n_p]]
        if own.delay or own.lag or own.hold not in holds or own.errors is not None:
            actings.append(ActingInputs.of_fit(own, fit, timing))
    contest.add_sources(starts, actings)
    winner = contest.decide(*_noise_of(first, whole))
    if winner is None:
        return None
    origin = contest.origins[winner]
    searches = [] if first is None else [first]
    if isinstance(origin, Motion) and not contest.is_as_good(first):
        second = _second(settings, contest, winner, whole) if "second fit" in settings.sources else None
        if second is not None:
            contest.add_fit(
                second.likeliest, timing_of(second.likeliest.intervals, second.likeliest.refinement, forced=forced)
            )
            searches.insert(0, second)
            winner = contest.decide(*_noise_of(second, whole))
            assert winner is not None
            origin = contest.origins[winner]
    if not searches:
        return None
    of_fit = next((x for x in searches if x.likeliest is origin), None)
    chosen = of_fit or searches[0]
    result = contest.result(winner, chosen.likeliest)
    decided = Decided(contest.summary(winner), None if of_fit else contest.candidates[winner].acting)
    return replace(chosen, result=result, contest=decided, impossible=of_fit.impossible if of_fit else ())


def _noise_of(
    first: _Searched | None, whole: tuple[ShootingIntervals, Motion, tuple[str, ...]]
) -> tuple[BoolArray, FloatArray]:
    """Samples that are no outliers ``(N, n_s)``, and the noise ``(n_s,)`` of each signal."""
    intervals, motion = whole[:2]
    if first is None or _explains_nothing(first.likeliest.intervals, first.motion, first.likeliest.refinement):
        every: BoolArray = np.ones(intervals.measured.shape, bool)
        return every, motion.spread
    own, fit = first.likeliest.intervals, first.likeliest.refinement.fit
    inlying = fit.noise.inlying(fit.residuals, own.known) >= _OUTLIER
    return inlying | ~own.known, fit.noise.sigma


def _second(
    settings: LoDiransac,
    contest: Contest,
    winner: int,
    whole: tuple[ShootingIntervals, Motion, tuple[str, ...]],
) -> _Searched | None:
    """A search from an estimate and its simulated motion; None where it fails."""
    (intervals, _, notes), one, motion = whole, contest.candidates[winner], contest.origins[winner]
    assert isinstance(motion, Motion)
    while intervals.length > _SHORT and (parts := fewest_parts(intervals.length)):
        intervals = intervals.split(parts)
    intervals = replace(intervals, hold=one.acting.hold)
    try:
        return _searched(
            settings, intervals, motion, notes, contest.seed, contest.dataset, within(contest.callback, 0.88, 0.9),
            hypotheses=one.parameters[None],
        )  # fmt: skip
    except (IdentificationError, np.linalg.LinAlgError):
        return None


def _given_start(settings: LoDiransac, dataset: Dataset) -> FloatArray | None:
    """The user's start, means of priors and nominal values, in this order; one where there is none of these.

    None where there is none of any parameter.
    """
    layout, start = dataset.layout, settings.start or {}
    found = []
    for name, bound, mean, std in zip(layout.names, layout.bounds, layout.prior_mean, layout.prior_std, strict=True):
        plain = name.partition("[")[0]
        nominal = mean if np.isfinite(std) else bound.value
        found.append(start.get(plain, nominal))
    known = [x for x in found if x is not None]
    return np.array([1.0 if x is None else x for x in found], float) if known else None


def _likeliest(
    settings: LoDiransac,
    dataset: Dataset,
    seed: int,
    callback: Callback | None,
    whole: tuple[ShootingIntervals, Motion, tuple[str, ...]],
) -> _Searched:
    """The likeliest explanation of the logs.

    Where states that nothing measures are not those of an exact model at once, they may have begun on wrong
    trajectories, for which a resonance that smoothing takes for noise is enough.  A second search begins with the
    motion of observers, and the likelier explanation counts.
    """
    intervals, motion, notes = whole
    if not unmeasured_states(intervals):
        return _searched(settings, intervals, motion, notes, seed, dataset, callback)
    report(callback, "unmeasured states", 0.05)
    allowed, measured = len(dataset.model.parameters) - 1, measured_signals(intervals)
    check_structure(dataset.model, dataset.source, allowed, measured, dataset.ranges)
    try:
        completed = _completed(intervals, motion, dataset)
        first = _searched(settings, intervals, completed, notes, seed, dataset, callback)
    except (IdentificationError, np.linalg.LinAlgError):
        observed = with_observed_states(intervals, motion)
        if observed is None:
            raise
        return _searched(settings, intervals, observed, notes, seed, dataset, within(callback, 0.87, 0.9))
    if first.likeliest.exact:
        return first
    try:
        observed = with_observed_states(intervals, motion)
        if observed is not None:
            further = within(callback, 0.87, 0.9)
            other = _searched(settings, intervals, observed, notes, seed, dataset, further)
            return min(first, other, key=lambda x: x.likeliest.cost)
    except TimeLimitError:
        return replace(first, likeliest=replace(first.likeliest, complete=False))
    except (IdentificationError, np.linalg.LinAlgError):
        pass  # the first search stands
    return first


def _searched(
    settings: LoDiransac,
    intervals: ShootingIntervals,
    motion: Motion,
    notes: tuple[str, ...],
    seed: int,
    dataset: Dataset,
    callback: Callback | None,
    hypotheses: FloatArray | None = None,
) -> _Searched:
    """A search that begins with a motion, and with hypotheses or samples."""
    report(callback, "drawing hypotheses", 0.1)
    check_time()
    n_spikes = 0
    if hypotheses is None:
        hypotheses = _hypotheses(settings, intervals, motion, seed, dataset)
        intervals, hypotheses, n_spikes = find_spikes(settings, intervals, motion, hypotheses, seed, dataset)
    if n_spikes:
        notes += (f"inputs have spikes in {n_spikes} rows, with which simulations fit worse; they are interpolated",)
    unit = discrepancy_units(intervals, motion, hypotheses[0])
    search = LocalSearch(settings, motion, hypotheses, make_prior(settings, intervals, motion, unit), callback)
    likeliest = search.likeliest(intervals, free_hold=dataset.input_hold is None)
    return _Searched(motion, notes, len(hypotheses), likeliest, *_parameters(settings, likeliest))


def _parameters(settings: LoDiransacSettings, likeliest: Explanation) -> tuple[ProjectedEstimate, tuple[str, ...]]:
    """Parameters of an explanation: the fit's where others would violate strict bounds, with the names of these."""
    intervals, fit = likeliest.intervals, likeliest.refinement.fit
    if likeliest.exact or not settings.projection:
        return fitted_parameters(intervals, fit), ()
    result, layout = estimate_parameters(intervals, fit, settings.prior_inflation), intervals.layout
    impossible = layout.violations(result.parameters)
    return (fitted_parameters(intervals, fit) if impossible else result), impossible


def _ambiguity(changes: Sequence[Change], lacks: MissingTerms | None, instrumented: Instrumented) -> FloatArray:
    """Covariance of parameters that change during the log, with terms that the model lacks, or with instruments."""
    found = np.diag(np.square(instrumented.ambiguity))
    if lacks is not None:
        found += np.outer(lacks.change, lacks.change)
    for one in changes:
        found[one.index, one.index] += one.variance
    return found


def _check_sensors(settings: LoDiransacSettings, dataset: Dataset) -> None:
    """Raises SettingsError: a signal or an input is named that the logs lack."""
    inputs = tuple(dataset.model.inputs)
    known = {"sensor_delays": (*dataset.signals, *inputs), "sensor_biases": dataset.signals, "gain_drifts": inputs}
    for setting, names in known.items():
        unknown = [name for name in getattr(settings, setting) or () if name not in names]
        if unknown:
            has = ", ".join(names)
            raise SettingsError(f'{setting} names "{unknown[0]}", which {dataset.source} lacks; it has {has}')


def _completed(intervals: ShootingIntervals, motion: Motion, dataset: Dataset) -> Motion:
    """The motion with its unmeasured states.  Raises IdentificationError: no simulation gives them."""
    found = with_unmeasured_states(intervals, motion)
    if found is None:
        names = unmeasured_by_name(intervals)
        raise IdentificationError(
            f"{dataset.source}: nothing measures {names}, nor a derivative, and every simulation of {names} from the "
            "other signals diverges; measure it, or bound the parameters of its equation"
        )
    return found


def _hypotheses(
    settings: LoDiransacSettings, intervals: ShootingIntervals, motion: Motion, seed: int, dataset: Dataset
) -> FloatArray:
    """Hypotheses, best first.  Raises IdentificationError: there are none, and the message names the cause."""
    found = find_hypotheses(settings, intervals, motion, seed, dataset)
    if len(found):
        return found
    cause = cause_of_refusal(dataset.model, dataset.layout, _rows_of_logs(intervals, motion))
    raise IdentificationError(f"{dataset.source}: no sample gives parameters within their bounds: {cause}")


def _checks(
    settings: LoDiransacSettings, intervals: ShootingIntervals, motion: Motion, refined: Refinement
) -> Iterator[Finding]:
    """Findings on the fit itself."""
    if _explains_nothing(intervals, motion, refined):
        advice = "check its terms, and the signs and units of the log"
        yield Finding("bad", f"The model explains almost nothing of this log: {advice}.")
    if not refined.converged and settings.max_steps:
        yield Finding("care", f"Local optimisation did not converge within its limit of {settings.max_steps} steps.")


def _checks_of_bounds(found: _Searched) -> Iterator[Finding]:
    """A finding where the fitted motion and the bounds contradict each other."""
    if found.impossible:
        names = ", ".join(found.impossible)
        yield Finding(
            "bad",
            f"Least squares of the whole motion leaves the bounds of {names}, which is physically impossible; the "
            "parameters are those of the most probable motion: a term is missing, an input acts late, or a sign or a "
            "unit is wrong.",
        )


def _checks_of_unmeasured(found: _Searched) -> Iterator[Finding]:
    """A finding where a search is doubtful."""
    if found.is_doubtful:
        names, share = unmeasured_by_name(found.likeliest.intervals), 100.0 * found.unexplained
        yield Finding(
            "bad",
            f"Nothing measures {names}, and the model leaves {share:.2g} % of an acceleration unexplained: the log "
            f"does not tell one from the other. Measure {names}.",
        )


def _rows_of_logs(intervals: ShootingIntervals, motion: Motion) -> list[MotionRows]:
    """Rows of the smoothed motion of each log."""
    logged = [np.arange(x.start, x.stop)[intervals.is_logged[x]] for x in intervals.rows_of_logs]
    parts = [motion.parts(intervals.model, rows) for rows in logged]
    return [MotionRows(q, v, a, intervals.inputs[rows], y) for (q, v, a, y), rows in zip(parts, logged, strict=True)]


def _explains_nothing(intervals: ShootingIntervals, motion: Motion, refined: Refinement) -> bool:
    """True if the noise of every signal is as large as the signal."""
    seen = intervals.known.any(axis=0)
    return bool((refined.fit.noise.sigma > _ALL_OF_IT * motion.spread)[seen].all())


# ---------------------------------------------------------------------- preparation


def prepared(settings: LoDiransac, dataset: Dataset) -> tuple[ShootingIntervals, Motion, tuple[str, ...]]:
    """The logs in intervals of the motion's own time scale, and the motion, row by row of them.

    Parameters
    ----------
    settings : LoDiransac
    dataset : Dataset

    Returns
    -------
    intervals : ShootingIntervals
        Inputs are screened, and act as recorded.
    motion : Motion
    notes : tuple of str

    Raises
    ------
    LogError
        The logs are too short.
    """
    model, dt = dataset.model, dataset.dt
    screened = [_screened(settings, one, dt) for one in dataset.segments]
    samples, inputs = [x for x, _, _ in screened], [u for _, u, _ in screened]
    several = len(samples) > 1
    notes = [
        f"{one.log.source}: {note}" if several else note
        for one, (_, _, said) in zip(dataset.segments, screened, strict=True)
        for note in said
    ]
    halves, length = choose_half_widths(model, samples, dt, settings.smoothing_half_width)
    n_rows, longest = sum(map(len, dataset.segments)), max(map(len, dataset.segments))
    if n_rows < _FEWEST_INTERVALS * length or longest < length:
        raise LogError(
            f"{dataset.source}: {n_rows} rows are too few; lo-diransac needs at least "
            f"{_FEWEST_INTERVALS * length}. Give a longer log"
        )
    if not any(long_runs(~x.gaps, length).any() for x in samples):
        raise LogError(
            f"{dataset.source}: no {length} rows in a row are without a gap in the inputs or in all sensors; give a "
            "log with longer stretches"
        )
    motions = smooth(model, samples, dt, halves)
    logs = [(x.measured, x.known, u, x.gaps) for x, u in zip(samples, inputs, strict=True)]
    intervals = ShootingIntervals.of(model, dataset.layout, logs, dt, length, settings.substeps, dataset.hold)
    intervals = replace(intervals, threads=settings.criteria.threads or default_threads())
    rows = zip(motions, intervals.rows_of_logs, strict=True)
    signals = np.concatenate([_to_length(x.signals, r.stop - r.start) for x, r in rows])
    return intervals, Motion(signals, motions[0].spread), tuple(notes)


def _to_length(values: FloatArray, n_rows: int) -> FloatArray:
    return np.pad(values, ((0, n_rows - len(values)), (0, 0)), mode="edge")


def _screened(settings: LoDiransacSettings, one: Segment, dt: float) -> tuple[Samples, FloatArray, list[str]]:
    """Samples and inputs of one log, and findings, a sentence each."""
    model, notes = one.model, []
    measured = np.full((len(one), len(model.signals)), np.nan)
    measured[:, [model.signals.index(n) for n in one.signals]] = one.measured
    present = [one.signals.index(n) for n in one.present]
    stuck = stuck_rows(one.measured[:, present]) if settings.stuck_rows else np.zeros(len(one), bool)
    known = np.isfinite(measured) & ~stuck[:, None]
    measured = np.where(known, measured, 0.0)
    inputs, n_leaps = screened_inputs(
        one.inputs, odd_window(settings.input_window, dt, _MOST_INPUTS), settings.input_threshold
    )
    if stuck.any():
        notes.append(f"{stuck.sum()} rows repeat the row before in every signal, and were taken as missing")
    if n_leaps:
        notes.append(f"inputs leap for a moment in {n_leaps} rows; the running median replaces them")
    centre = running_median(measured, known, odd_window(settings.median_window, dt, _MOST_SAMPLES))
    return Samples(measured, known, centre, one.gaps | silent_rows(known, dt)), inputs, notes


# ---------------------------------------------------------------------- the estimate


@dataclass(frozen=True)
class _Found:
    """Parts of an estimate; a forced delay or lag of the inputs need not be significant.

    ``ambiguity (n, n)`` is a covariance besides that of the result, for what one set of parameters cannot be; ``lacks``
    is None where terms that the model lacks were not sought.
    """

    dataset: Dataset
    intervals: ShootingIntervals
    motion: Motion
    refinement: Refinement
    result: ProjectedEstimate
    ambiguity: FloatArray
    forced: bool
    hausman_tests: tuple[HausmanTest, ...]
    lacks: MissingTerms | None
    contest: Decided | None

    @property
    def late(self) -> float:
        """Delay of the inputs, lag included, samples."""
        return _late(self.intervals, self.refinement)

    @property
    def is_late(self) -> bool:
        """True for a significant delay or lag that all inputs have."""
        return _is_late(self.intervals, self.refinement) and (self.contest is None or self.contest.acting is None)

    @property
    def resolution(self) -> Resolution:
        """Simulation of the estimate."""
        acting, substeps = None if self.contest is None else self.contest.acting, self.intervals.substeps
        if acting is not None:
            return Resolution("rk4", substeps, acting.hold, acting.timing)
        timing = timing_of(self.intervals, self.refinement, forced=self.forced)
        return Resolution("rk4", substeps, self.intervals.hold, timing)


def _late(intervals: ShootingIntervals, refinement: Refinement) -> float:
    """Delay of the inputs, lag included, samples."""
    return float(intervals.delay + intervals.lag + refinement.fit.shared[-1])


def _is_late(intervals: ShootingIntervals, refinement: Refinement) -> bool:
    """True for a significant delay or lag that all inputs have."""
    errors = intervals.all_errors
    clear = abs(_late(intervals, refinement)) > max(_SIGNIFICANT * refinement.delay_error, _SMALL_DELAY)
    own = errors.input_lag if intervals.lag else errors.input_delay
    return clear and not own.any()


def timing_of(intervals: ShootingIntervals, refinement: Refinement, *, forced: bool) -> InputTiming:
    """Delay or lag of the inputs where it is significant, or forced, and the inputs' own errors."""
    fit, errors = refinement.fit, intervals.all_errors
    late, counts = _late(intervals, refinement), _is_late(intervals, refinement) or forced
    delays, lags = np.zeros((2, intervals.model.n_u))
    if errors.input_delay.any():
        delays = delays_of_inputs(intervals, fit)
    elif not intervals.lag and counts:
        delays = delays + late
    if errors.input_lag.any():
        lags = lags_of_inputs(intervals, fit)
    elif intervals.lag and counts:
        lags = lags + max(late, LEAST_LAG)
    return InputTiming.of(delays * intervals.dt, lags * intervals.dt, errors.gain_drift)


def _estimate(
    settings: LoDiransacSettings,
    found: _Found,
    n_hypotheses: int,
    end: str,
    notes: tuple[str, ...],
    checks: tuple[Finding, ...],
) -> Estimate:
    dataset, intervals, result = found.dataset, found.intervals, found.result
    names = dataset.layout.names
    spans = np.sqrt(np.diag(result.covariance)) * 1.96
    units = parameter_units(intervals, found.motion, result.parameters)
    lost = ~((spans < units) | (spans < np.abs(result.parameters)))
    measured = measured_signals(intervals) if unmeasured_states(intervals) else None
    lost, combinations = unidentifiable(
        dataset.model, dataset.layout, result.parameters, result.covariance, lost, measured, dataset.ranges
    )
    covariance = result.covariance + found.ambiguity
    covariance[lost] = covariance[:, lost] = np.inf
    nonlinear = bool(dataset.model.nonlinear_parameters)
    return Estimate(
        parameters=dict(zip(names, result.parameters.tolist(), strict=True)),
        covariance=covariance,
        degrees_of_freedom=_GAUSSIAN,
        n_fitted=sum(int(np.isfinite(one.measured).any(axis=1).sum()) for one in dataset.segments),
        estimator="multiple shooting",
        iterations=settings.n_nonlinear_samples if nonlinear else settings.n_samples,
        n_hypotheses=n_hypotheses,
        stop_reason=end,
        resolution=found.resolution,
        notes=notes,
        diagnosis=_diagnosis(found, tuple(n for n, x in zip(names, lost, strict=True) if x), combinations),
        checks=checks,
        suggestions=found.lacks.suggestions if found.lacks else (),
        competition=None if found.contest is None else found.contest.summary,
        possible_terms=possible_terms(intervals, found.refinement.fit, result, covariance, settings.candidate_terms)
        if settings.suggestions
        else None,
    )


def _diagnosis(found: _Found, lost: tuple[str, ...], combinations: tuple[str, ...]) -> Diagnosis:
    """Noise, faults and unmodelled forces, by name and over the rows of the given logs."""
    dataset, intervals, fit, result = found.dataset, found.intervals, found.refinement.fit, found.result
    model, dt = dataset.model, intervals.dt
    columns = {name: model.signals.index(name) for name in dataset.signals}
    seen = intervals.known.any(axis=0)
    sigma, fraction = (np.where(seen, x, np.nan) for x in (fit.noise.sigma, fit.noise.pi))
    inlying = fit.noise.inlying(fit.residuals, intervals.known)
    outliers = intervals.known & (inlying < _OUTLIER)
    counted = outliers.sum(axis=0) / np.maximum(intervals.known.sum(axis=0), 1)
    fraction = np.where(fit.noise.has_outliers, fraction, np.where(seen, counted, np.nan))
    shown = intervals.is_logged[intervals.starts]
    window_log = intervals.log_of[shown]
    begins = np.array([one.log.time[one.offset] for one in dataset.segments])[window_log]
    place = intervals.starts[shown] - intervals.first_of_log[window_log]
    accelerations = [result.unexplained]
    if found.lacks and found.lacks.suggestions:
        accelerations.append(found.lacks.accelerations)
    forces = _forces_of(intervals, fit, result.parameters, accelerations)
    per_equation: Callable[[FloatArray], dict[str, FloatArray]] = lambda x: dict(  # noqa: E731
        zip(model.accelerations, x[shown].T.copy(), strict=True)
    )
    return Diagnosis(
        noise_std={name: float(sigma[k]) for name, k in columns.items()},
        outlier_fraction={name: float(fraction[k]) for name, k in columns.items()},
        outliers={name: _on_given_logs(dataset, intervals, outliers[:, k]) for name, k in columns.items()},
        window_log=window_log,
        unmodelled_time=begins + dt * (place + 0.5 * (intervals.length - 1)),
        unmodelled_accelerations=per_equation(result.unexplained),
        unmodelled_forces=per_equation(forces[0]) if forces else {},
        smoothed_time=begins + dt * place.astype(float),
        smoothed_states=dict(zip(model.state, fit.x[shown].T.copy(), strict=True)),
        input_delay=found.late * dt,
        input_delay_error=found.refinement.delay_error * dt,
        input_delay_significant=found.is_late,
        unidentifiable=lost,
        combinations=combinations,
        hausman_tests=found.hausman_tests,
        suggested_terms=per_equation((forces or accelerations)[1]) if len(accelerations) > 1 else {},
    )


def _on_given_logs(dataset: Dataset, intervals: ShootingIntervals, mask: BoolArray) -> BoolArray:
    """A mask over the intervals' rows as one over the rows of the logs."""
    parts = [mask[rows][: len(one)] for rows, one in zip(intervals.rows_of_logs, dataset.segments, strict=True)]
    return dataset.on_given_logs(parts)


def _forces_of(
    intervals: ShootingIntervals, fit: Fit, parameters: FloatArray, accelerations: Sequence[FloatArray]
) -> list[FloatArray]:
    """Generalised forces (W, n_v) of accelerations at the intervals' starts; none if nothing is a balance of forces."""
    model = intervals.model
    try:
        response = model.force_response
    except ModelError:
        return []
    p = np.broadcast_to(intervals.parameters_of(parameters, intervals.log_of), (len(fit.x), model.n_p))
    motion = (fit.x[:, : model.n_q].T, fit.x[:, model.n_q :].T, intervals.inputs[intervals.starts].T, p.T)
    columns = [np.array(response(*motion, np.repeat(f[:, None], len(fit.x), axis=1))).T for f in np.eye(model.n_v)]
    return list(np.linalg.solve(np.stack(columns, axis=-1), np.stack(accelerations)[..., None])[..., 0])
