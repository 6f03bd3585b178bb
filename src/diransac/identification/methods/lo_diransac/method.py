"""The steps of lo-diransac in their order.

1. `smoothing`: screening of samples; the motion without a model.
2. `hypotheses`: parameters from random samples of the equations in weak form, scored by simulation.
3. `refinement`: the most probable motion and parameters, noise and discrepancies, from the best of them.
4. `instrumental_variables`: parameters of the whole motion, and their covariance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.blas import single_threaded
from diransac.errors import IdentificationError, LogError, ModelError
from diransac.identification.estimate import Diagnosis, Estimate, Resolution
from diransac.identification.method import report, within
from diransac.identification.methods.lo_diransac.hypotheses import find_hypotheses, robust_scores
from diransac.identification.methods.lo_diransac.instrumental_variables import (
    InstrumentalEstimate,
    discrepancy_units,
    estimate_parameters,
    parameter_units,
    unexplained,
)
from diransac.identification.methods.lo_diransac.missing_terms import missing_terms
from diransac.identification.methods.lo_diransac.mixture import BREAKDOWN
from diransac.identification.methods.lo_diransac.normal_equations import with_residuals
from diransac.identification.methods.lo_diransac.refinement import make_prior, refine, start
from diransac.identification.methods.lo_diransac.settings import LoDiransacSettings
from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
from diransac.identification.methods.lo_diransac.smoothing import (
    Motion,
    Samples,
    choose_half_width,
    odd_window,
    running_median,
    screened_inputs,
    smooth,
    stuck_rows,
)

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset
    from diransac.data.segment import Segment
    from diransac.identification.method import Callback
    from diransac.identification.methods.lo_diransac.normal_equations import Fit
    from diransac.identification.methods.lo_diransac.refinement import Prior, Refinement
    from diransac.identification.settings import Settings

__all__ = ["LoDiransac", "configured"]

_FEWEST_INTERVALS = 4
# Half a sample of delay or more is taken up by shifting the inputs.
_WHOLE_SAMPLE = 0.5
# Difference of two fits' losses, nats, below which both are as likely.
_AS_LIKELY = 5.0
_OUTLIER = 0.5
# Delays that are tried at a time, before they are refined to a sample.
_DELAYS_AT_A_TIME = 12
# Fraction of a signal's spread from which on its noise leaves nothing to explain.
_ALL_OF_IT = 0.8
# A significant delay: so many standard errors, and so many samples.
_SIGNIFICANT, _SMALL_DELAY = 3.0, 0.25
# Samples of running medians at most: spikes last for samples, however many of them there are in a second.
_MOST_INPUTS, _MOST_SAMPLES = 15, 31
_GAUSSIAN = 10_000
"""Degrees of freedom of an interval whose covariance is not itself an estimate from few numbers."""


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
        Smallest half width of the smoothing polynomials and length of the shooting intervals, s; at most 25 samples.
        Cross-validation chooses between it and three, nine, ... times its value.
    n_samples, n_nonlinear_samples : int, optional
        Number of random samples of a model that is affine in its parameters, and of others.
    largest_sample : int, optional
        Largest number of rows of each equation in a sample, over the number of parameters.
    n_screening_intervals, n_finalists : int, optional
        Number of intervals on which all hypotheses are scored; number of hypotheses that are scored on all intervals.
    delay_range : (float, float), optional
        Smallest and largest delay of the inputs, s, tried in whole samples before local optimisation.
    max_delay_shifts : int, optional
        Largest number of shifts of the inputs by whole samples after local optimisation.
    substeps : int, optional
        Integration steps per sample; one step is inaccurate by a percent where dry friction changes sign between
        samples or links are light.
    max_starts, max_fits : int, optional
        Largest number of hypotheses that are optimised, and of local optimisations.
    max_steps : int, optional
        Largest number of Gauss-Newton steps of a local optimisation; 0: the best hypothesis is the estimate.
    outliers : bool, optional
        Whether the noise of each signal has outliers; otherwise it is Gaussian.
    neighbouring_starts : bool, optional
        Whether initial states are propagated from neighbouring intervals where that has a higher likelihood.
    gradual_continuity : bool, optional
        Whether the motion is made continuous gradually rather than from the start.
    robust_model_error : bool, optional
        Whether the size of unmodelled accelerations follows the median interval until the first convergence.
    model_error : bool, optional
        Whether the size of unmodelled accelerations is estimated; otherwise they vanish.
    prior_model_error : float, optional
        Prior size of the unmodelled accelerations, over the spread of the accelerations.
    prior_discrepancy, initial_discrepancy : float, optional
        Prior size of input gain and bias discrepancies, over that which equals an equation's inertial force: after, and
        until the first convergence.
    prior_delay : float, optional
        Prior standard deviation of the input delay, s.
    instrumental_variables : bool, optional
        Whether parameters are estimated from the fitted motion by instrumental variables; otherwise they are those of
        the fit.
    prior_inflation : float, optional
        Factor of the prior on model error whose effect on the parameters is added to their covariance.
    suggestions : bool, optional
        Whether terms are searched that would explain the unmodelled forces.
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
        IdentificationError
            No sample gives parameters within their bounds.
        """
        with single_threaded():  # matrices are small: more threads would only add waiting
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


def _fitted(settings: LoDiransacSettings, dataset: Dataset, seed: int, callback: Callback | None) -> Estimate:
    """Parameters of the dataset's model, step by step."""
    report(callback, "smoothing", 0.0)
    intervals, motion, notes = _prepared(settings, dataset)
    report(callback, "drawing hypotheses", 0.1)
    hypotheses = find_hypotheses(settings, intervals, motion, seed, dataset)
    if not len(hypotheses):
        raise IdentificationError(
            f"{dataset.source}: no sample of the log gives parameters within their bounds; check the model, "
            "the signs and units of inputs, and the bounds"
        )
    unit = discrepancy_units(intervals, motion, hypotheses[0])
    search = _LocalSearch(settings, motion, hypotheses, make_prior(settings, intervals, motion, unit), callback)
    delay, refined = search.best_delayed(intervals)
    intervals, refined, later = search.shifted(intervals.delayed(delay), refined)
    report(callback, "estimating parameters", 0.9)
    result = estimate_parameters(intervals, refined.fit, settings.prior_inflation)
    kept = refined.fit.shared[: intervals.n_p]
    if not settings.instrumental_variables:
        result = replace(result, parameters=kept, unexplained=unexplained(intervals, refined.fit, kept))
    elif not intervals.layout.admits(result.parameters[None])[0]:
        # The fit satisfies the bounds; least squares on its motion may violate them.
        result = replace(result, parameters=kept, unexplained=unexplained(intervals, refined.fit, kept))
        notes = (*notes, "a bound of the parameters is reached; they are those of the most probable motion")
    if _explains_nothing(intervals, motion, refined):
        notes = (*notes, "the model explains almost nothing of this log: do not rely on these parameters")
    if not refined.converged and settings.max_steps:
        notes = (*notes, "local optimisation did not converge within its limit of steps")
    found = _Found(dataset, intervals, motion, refined.fit, result, float(delay + later + refined.fit.shared[-1]))
    estimate = _estimate(settings, found, len(hypotheses), refined.converged, notes)
    if not settings.suggestions:
        return estimate
    terms = missing_terms(intervals, refined.fit, result.parameters, settings.candidate_terms)
    return replace(estimate, suggestions=terms)


def _explains_nothing(intervals: ShootingIntervals, motion: Motion, refined: Refinement) -> bool:
    """True if the noise of every signal is as large as the signal."""
    seen = intervals.known.any(axis=0)
    return bool((refined.fit.noise.sigma > _ALL_OF_IT * motion.spread)[seen].all())


# ---------------------------------------------------------------------- preparation


def _prepared(settings: LoDiransacSettings, dataset: Dataset) -> tuple[ShootingIntervals, Motion, tuple[str, ...]]:
    """The logs in intervals of the motion's own time scale, and the motion, row by row of the intervals."""
    model, dt = dataset.model, dataset.dt
    screened = [_screened(settings, one, dt) for one in dataset.segments]
    samples, inputs = [x for x, _, _ in screened], [u for _, u, _ in screened]
    several = len(samples) > 1
    notes = [
        f"{one.log.source}: {note}" if several else note
        for one, (_, _, said) in zip(dataset.segments, screened, strict=True)
        for note in said
    ]
    half = choose_half_width(model, samples, dt, settings.smoothing_half_width)
    n_rows, longest = sum(map(len, dataset.segments)), max(map(len, dataset.segments))
    if n_rows < _FEWEST_INTERVALS * half or longest < half:
        raise LogError(
            f"{dataset.source}: {n_rows} rows are too few; lo-diransac needs at least "
            f"{_FEWEST_INTERVALS * half}. Give a longer log"
        )
    motions = smooth(model, samples, dt, half)
    logs = [(x.measured, x.known, u) for x, u in zip(samples, inputs, strict=True)]
    intervals = ShootingIntervals.of(model, dataset.layout, logs, dt, half, settings.substeps)
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
    return Samples(measured, known, centre), inputs, notes


# ---------------------------------------------------------------------- local search


@dataclass(frozen=True)
class _LocalSearch:
    """Local optimisations from the best hypotheses, and delays of the inputs."""

    settings: LoDiransacSettings
    motion: Motion
    hypotheses: FloatArray
    prior: Prior
    callback: Callback | None

    def best(self, intervals: ShootingIntervals, callback: Callback | None = None) -> Refinement:
        """Local optimisation from the best hypothesis; where it is doubtful, from others; the likeliest of these.

        A fit is doubtful if most samples of an interval are outliers: either sensors failed there, or the fit did.  The
        likeliest fit so far becomes a hypothesis itself; otherwise the next hypothesis is optimised.  The search ends
        with a second fit that is as likely.
        """
        waiting = list(self.hypotheses[: self.settings.max_starts])
        found: list[Refinement] = []
        while waiting and len(found) < self.settings.max_fits:
            share = len(found) / self.settings.max_fits
            report(callback, "local optimisation", share, f"fit {len(found) + 1}")
            begin = start(self.settings, intervals, self.motion, waiting.pop(0), self.prior)
            found.append(refine(self.settings, intervals, begin, self.prior))
            again = any(abs(found[-1].loss - x.loss) < _AS_LIKELY for x in found[:-1])
            if again or not _is_doubtful(intervals, found[-1]):
                break
            if all(found[-1].loss < x.loss for x in found[:-1]):
                waiting.insert(0, found[-1].fit.shared[: intervals.n_p])
        return min(found, key=lambda x: x.loss)

    def best_delayed(self, intervals: ShootingIntervals) -> tuple[int, Refinement]:
        """Delay of the inputs in samples, and the best fit then.

        Where the best hypothesis favours a delay, neighbouring delays are tried as long as the fit becomes likelier,
        because hypotheses were drawn from inputs without a delay.
        """
        report(self.callback, "searching for a delay", 0.25)
        delay = self._likeliest_delay(intervals)
        fits = {delay: self.best(intervals.delayed(delay), self._progress(0))}
        for step in (-1, 1) if delay else ():
            while abs(delay + step) < intervals.length:
                other = self.best(intervals.delayed(delay + step), self._progress(len(fits)))
                fits[delay + step] = other
                if other.loss >= fits[delay].loss:
                    break
                delay += step
        return delay, fits[delay]

    def _progress(self, k: int) -> Callback | None:
        """The callback of the k-th delay, which takes half of what is left: nobody knows how many there will be."""
        return within(self.callback, 0.8 - 0.5 ** (k + 1), 0.8 - 0.5 ** (k + 2))

    def _likeliest_delay(self, intervals: ShootingIntervals) -> int:
        """Delay in samples with which simulations by the best hypothesis agree best with the log.

        Inputs that are held for many samples and then step cause few outliers under a wrong delay, which is a local
        optimum; so the number of whole samples is chosen before local optimisation.
        """
        every, scores = np.arange(len(intervals)), dict[int, float]()
        low, high = (round(x / intervals.dt) for x in self.settings.delay_range)

        def score(rows: int) -> float:
            if rows not in scores:
                delayed = intervals.delayed(rows)
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

    def shifted(self, intervals: ShootingIntervals, refined: Refinement) -> tuple[ShootingIntervals, Refinement, int]:
        """Local optimisation again with the inputs shifted by whole samples, while it finds them delayed."""
        shift = 0
        for k in range(self.settings.max_delay_shifts):
            delay = refined.fit.shared[-1]
            if not _WHOLE_SAMPLE <= abs(delay) < intervals.length:
                break
            report(self.callback, "local optimisation with delayed inputs", 0.8 + 0.03 * k)
            shift += round(delay)
            intervals = intervals.delayed(round(delay))
            shared = np.append(refined.fit.shared[:-1], delay - round(delay))
            sizes = np.append(refined.fit.prior[:-1], self.prior.delay)
            begin = with_residuals(intervals, replace(refined.fit, shared=shared, prior=sizes))
            refined = refine(self.settings, intervals, begin, self.prior)
        return intervals, refined, shift


def _is_doubtful(intervals: ShootingIntervals, refined: Refinement) -> bool:
    """True if an interval has too few inlying samples for a robust scale."""
    fit, n = refined.fit, len(intervals)
    inlying = (fit.noise.inlying(fit.residuals, intervals.known) > _OUTLIER).reshape(n, -1).sum(axis=1)
    return bool((inlying < BREAKDOWN * intervals.known.reshape(n, -1).sum(axis=1)).any())


# ---------------------------------------------------------------------- the estimate


@dataclass(frozen=True)
class _Found:
    """Parts of an estimate; the delay is in samples."""

    dataset: Dataset
    intervals: ShootingIntervals
    motion: Motion
    fit: Fit
    result: InstrumentalEstimate
    delay: float


def _estimate(
    settings: LoDiransacSettings, found: _Found, n_hypotheses: int, converged: bool, notes: tuple[str, ...]
) -> Estimate:
    dataset, intervals, result = found.dataset, found.intervals, found.result
    names = dataset.layout.names
    spans = np.sqrt(np.diag(result.covariance)) * 1.96
    lost = ~(spans < parameter_units(intervals, found.motion, result.parameters))
    covariance = result.covariance.copy()
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
        stop_reason="converged" if converged else "limit of steps",
        resolution=Resolution("rk4", settings.substeps),
        notes=notes,
        diagnosis=_diagnosis(found, tuple(n for n, x in zip(names, lost, strict=True) if x)),
    )


def _diagnosis(found: _Found, unidentifiable: tuple[str, ...]) -> Diagnosis:
    """Noise, faults and unmodelled forces, by name and over the rows of the given logs."""
    dataset, intervals, fit, result = found.dataset, found.intervals, found.fit, found.result
    model, dt = dataset.model, intervals.dt
    columns = {name: model.signals.index(name) for name in dataset.signals}
    seen = intervals.known.any(axis=0)
    sigma, fraction = (np.where(seen, x, np.nan) for x in (fit.noise.sigma, fit.noise.pi))
    inlying = fit.noise.inlying(fit.residuals, intervals.known)
    outliers = intervals.known & (inlying < _OUTLIER)
    begins = np.array([one.log.time[one.offset] for one in dataset.segments])[intervals.log_of]
    place = intervals.starts - intervals.first_of_log[intervals.log_of]
    forces = _unmodelled_forces(intervals, fit, result)
    per_equation: Callable[[FloatArray], dict[str, FloatArray]] = lambda x: dict(  # noqa: E731
        zip(model.accelerations, x.T.copy(), strict=True)
    )
    return Diagnosis(
        noise_std={name: float(sigma[k]) for name, k in columns.items()},
        outlier_fraction={name: float(fraction[k]) for name, k in columns.items()},
        outliers={name: _on_given_logs(dataset, intervals, outliers[:, k]) for name, k in columns.items()},
        window_log=intervals.log_of.copy(),
        unmodelled_time=begins + dt * (place + 0.5 * (intervals.length - 1)),
        unmodelled_accelerations=per_equation(result.unexplained),
        unmodelled_forces={} if forces is None else per_equation(forces),
        smoothed_time=begins + dt * place.astype(float),
        smoothed_states=dict(zip(model.state, fit.x.T.copy(), strict=True)),
        input_delay=float(found.delay * dt),
        input_delay_error=result.delay_error * dt,
        input_delay_significant=abs(found.delay) > max(_SIGNIFICANT * result.delay_error, _SMALL_DELAY),
        unidentifiable=unidentifiable,
    )


def _on_given_logs(dataset: Dataset, intervals: ShootingIntervals, mask: BoolArray) -> BoolArray:
    """A mask over the intervals' rows as one over the rows of the logs."""
    parts = [mask[rows][: len(one)] for rows, one in zip(intervals.rows_of_logs, dataset.segments, strict=True)]
    return dataset.on_given_logs(parts)


def _unmodelled_forces(intervals: ShootingIntervals, fit: Fit, result: InstrumentalEstimate) -> FloatArray | None:
    """Generalised forces (W, n_v) of the unmodelled accelerations at the intervals' starts, or None."""
    model = intervals.model
    try:
        response = model.force_response
    except ModelError:
        return None
    p = np.broadcast_to(intervals.parameters_of(result.parameters, intervals.log_of), (len(fit.x), model.n_p))
    motion = (fit.x[:, : model.n_q].T, fit.x[:, model.n_q :].T, intervals.inputs[intervals.starts].T, p.T)
    columns = [np.array(response(*motion, np.repeat(f[:, None], len(fit.x), axis=1))).T for f in np.eye(model.n_v)]
    return np.asarray(np.linalg.solve(np.stack(columns, axis=-1), result.unexplained[:, :, None])[:, :, 0])
