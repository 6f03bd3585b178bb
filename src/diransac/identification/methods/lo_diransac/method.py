"""The steps of lo-diransac in their order.

1. `preparation`, `smoothing`: logs in windows; the motion without a model.
2. `hypotheses`: parameters from random samples of the equations in weak form, scored by simulation.
3. `local_search`: the most probable motion and parameters, noise and discrepancies, from the best of them (`core`).
4. `projection`, `competition`: parameters of the whole motion; the estimate that predicts best.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import ModelError, SettingsError
from diransac.identification.core.windows import Windows
from diransac.identification.diagnosis import Diagnosis, Resolution
from diransac.identification.estimate import TIME_LIMIT, Estimate
from diransac.identification.finding import Finding
from diransac.identification.method import report
from diransac.identification.methods.lo_diransac.checks import findings_of_fit
from diransac.identification.methods.lo_diransac.competition import compete
from diransac.identification.methods.lo_diransac.diagnosing import by_acceleration, diagnosis_of
from diransac.identification.methods.lo_diransac.hypotheses import n_samples
from diransac.identification.methods.lo_diransac.input_noise import with_accelerations
from diransac.identification.methods.lo_diransac.logs_alone import estimates_alone
from diransac.identification.methods.lo_diransac.missing_terms import candidates_of_fit, missing_terms, possible_terms
from diransac.identification.methods.lo_diransac.motion_equations import parameter_units, unexplained
from diransac.identification.methods.lo_diransac.parts import compared_parts
from diransac.identification.methods.lo_diransac.preparation import prepared
from diransac.identification.methods.lo_diransac.projection import ProjectedEstimate
from diransac.identification.methods.lo_diransac.search import Searched, rows_of_logs
from diransac.identification.methods.lo_diransac.segments import ActingInputs
from diransac.identification.methods.lo_diransac.settings import LoDiransacSettings
from diransac.identification.methods.lo_diransac.simulation_error import explains_as_well
from diransac.identification.methods.lo_diransac.unmeasured import (
    measured_signals,
    unmeasured_by_name,
    unmeasured_states,
)
from diransac.identification.regression.rows import excited
from diransac.identification.structure.columns import FITTED_MOTION
from diransac.identification.structure.equivalents import equivalent_parameters, is_close
from diransac.identification.structure.free_units import KnownUpTo, known_up_to_units
from diransac.identification.structure.refusal import check_drives, check_signs
from diransac.identification.structure.structural import check_structure, structural, unidentifiable
from diransac.process import memory_kept

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset
    from diransac.identification.core.fit import Fit
    from diransac.identification.estimate import LogEstimate
    from diransac.identification.method import Callback
    from diransac.identification.methods.lo_diransac.missing_terms import Candidates, MissingTerms
    from diransac.identification.settings import Settings

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
    smoothing_half_width : float, optional
        Usual half width of the smoothing polynomials and length of the shooting intervals, s; at most 25 samples.
        Cross-validation chooses between it and three, nine, ... times its value, for smoothing also a third of it;
        signals that are sampled more slowly have as many samples of their own.
    n_samples : int, optional
        Number of random samples of a model that is affine in its parameters; half of it, of others.
    input_delay, input_lag : bool, optional
        Whether inputs act after a delay, or after a first-order lag of the actuators: True, always; False, never; None,
        where that is the likelier explanation of the log.  Where the model is not exact, an actuator may have a lag of
        its own.
    sensor_delays, sensor_biases, gain_drifts : sequence of str, optional
        Signals, or inputs, whose delay is estimated in any case, signals whose bias is, and inputs whose gain drifts;
        that of no other is.  An input's delay is its own, besides that of all.  None: those that the residuals show
        clearly.
    substeps : int, optional
        Integration steps per sample at most: fewer where these change no parameter by a tenth of its standard error.
        One step is inaccurate by a percent where dry friction changes sign between samples or links are light.
    max_steps : int, optional
        Largest number of Gauss-Newton steps of a local optimisation; 0: the best hypothesis is the estimate.
    outliers : bool, optional
        Whether the noise of each signal has outliers; otherwise it is Gaussian.
    model_error : bool, optional
        Whether the size of unmodelled accelerations is estimated; otherwise they vanish.
    prior_model_error : float, optional
        Prior size of the unmodelled accelerations, over the spread of the accelerations.
    prior_discrepancy : float, optional
        Prior size of input gain and bias discrepancies, over that which equals an equation's inertial force.
    start : mapping of str to float, optional
        Values of parameters, each in its unit, from which simulation error starts, too.
    horizon : float, optional
        Horizon of the predictions that decide between estimates, s; None: several, from the time scales of the motion.
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
            A signal or an input is named that the logs lack.
        IdentificationError
            No sample gives parameters within their bounds.
        TimeLimitError
            The time limit was reached before the first local optimisation had converged.
        """
        if not dataset.model.has_equations:
            from diransac.identification.methods.lo_diransac.without_equations import estimated_by_simulation

            return estimated_by_simulation(self, dataset, int(seed), callback)
        with memory_kept():
            return _fitted(self, dataset, int(seed), callback)

    def estimates_of_logs(self, dataset: Dataset, seed: int, callback: Callback | None = None) -> list[LogEstimate]:
        """Estimates of each of several logs alone, after `fit` of all of them.

        Parameters
        ----------
        dataset : Dataset
        seed : int
        callback : callable, optional
            Arguments of `fit`.

        Returns
        -------
        list of LogEstimate
            With infinite standard errors of logs that tell too little.

        Raises
        ------
        TimeLimitError
            The time limit was reached.
        """
        nothing: Searched | None = None
        best = dataset.kept(_key(self, seed), lambda: nothing)
        if best is None:  # the model has no equations
            return []
        with np.errstate(all="ignore"):  # as in the fit of all
            return estimates_alone(self, dataset, best, callback)


def _key(settings: LoDiransac, seed: int) -> tuple[object, ...]:
    """Key under which a dataset of several logs keeps the search of all of them."""
    return "search of all logs", settings, int(seed)


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
    _check_names(settings, dataset)
    allowed = len(dataset.model.parameters) - 1
    check_structure(dataset.model, dataset.source, allowed, ranges=dataset.ranges)
    check_drives(dataset)
    report(callback, "smoothing", 0.0)
    whole = prepared(settings, dataset)
    if unmeasured_states(whole[0]):
        check_structure(dataset.model, dataset.source, allowed, measured_signals(whole[0]), dataset.ranges)
    best = compete(settings, dataset, whole, seed, callback)
    if len(dataset.segments) > 1:
        dataset.keep(_key(settings, seed), best)
    likeliest, result, intervals, motion = best.likeliest, best.result, best.likeliest.intervals, best.motion
    refined = likeliest.refinement
    report(callback, "estimating parameters", 0.9)
    predicts = best.decided is None or best.decided.summary.predicts
    rows = rows_of_logs(intervals, motion)
    dataset.keep(FITTED_MOTION, rows)
    if best.impossible or not predicts or dataset.layout.on_bounds(result.parameters).any():
        check_signs(dataset, rows)
    parts, candidates, lacks = compared_parts(likeliest, result), None, None
    if settings.suggestions:
        with suppress(np.linalg.LinAlgError):  # squares of tiny or huge numbers, of which no term can be tested
            moved = with_accelerations(intervals, refined.fit, result)
            candidates = candidates_of_fit(*moved, settings.candidate_terms)
            lacks = None if likeliest.exact else missing_terms(candidates)
    ambiguity = np.diag(parts.variances)
    if lacks is not None:
        ambiguity = ambiguity + np.outer(lacks.change, lacks.change)
    checks = (
        *_checks(settings, best),
        *_checks_of_bounds(best),
        *_checks_of_unmeasured(settings, dataset, best),
        *findings_of_fit(likeliest, best.decided.acting if best.decided else None),
        *parts.findings,
    )
    found = _Found(dataset, best, result, ambiguity, candidates, lacks)
    end = "converged" if refined.converged else "limit of steps"
    end = end if likeliest.complete else TIME_LIMIT
    return replace(_estimate(settings, found, end, checks), disagreements=parts.disagreements)


def _check_names(settings: LoDiransacSettings, dataset: Dataset) -> None:
    """Raises SettingsError: a signal or an input is named that the logs lack, or a parameter that is not sought."""
    unknown = [name for name in settings.start or () if name not in dataset.model.parameters]
    if unknown:
        has = ", ".join(dataset.model.parameters)
        raise SettingsError(f'start names "{unknown[0]}", which is not to be identified; these are: {has}')
    inputs = tuple(dataset.model.inputs)
    known = {"sensor_delays": (*dataset.signals, *inputs), "sensor_biases": dataset.signals, "gain_drifts": inputs}
    for setting, names in known.items():
        unknown = [name for name in getattr(settings, setting) or () if name not in names]
        if unknown:
            has = ", ".join(names)
            raise SettingsError(f'{setting} names "{unknown[0]}", which {dataset.source} lacks; it has {has}')


def _checks(settings: LoDiransacSettings, found: Searched) -> Iterator[Finding]:
    """Findings on the fit itself."""
    if found.explains_nothing:
        advice = "compare its terms and constants with the machine"
        yield Finding("bad", "The model explains almost nothing of this log", advice)
    elif found.decided is not None and not found.decided.summary.predicts:
        claim = "No estimate predicts parts of the log that it was not made from much better than no change would"
        yield Finding("bad", claim, "compare the terms and constants of the model with the machine")
    if not found.likeliest.refinement.converged and settings.max_steps:
        claim = f"Local optimisation did not converge within its limit of {settings.max_steps} steps"
        yield Finding("care", claim, f"give it more: --set max_steps={2 * settings.max_steps}")


def _checks_of_bounds(found: Searched) -> Iterator[Finding]:
    """A finding where the fitted motion and the bounds contradict each other."""
    if found.impossible:
        names = ", ".join(found.impossible)
        yield Finding(
            "bad",
            f"Least squares of the whole motion leaves the bounds of {names}, which is physically impossible; the "
            "parameters are those of the most probable motion",
            "compare the terms and constants of the model with the machine",
        )


def _checks_of_unmeasured(settings: LoDiransacSettings, dataset: Dataset, found: Searched) -> Iterator[Finding]:
    """Findings where nothing measures a state, so that a search is doubtful, or other parameters are as good."""
    intervals, p = found.likeliest.intervals, found.result.parameters
    names = unmeasured_by_name(intervals)
    if found.is_doubtful:
        share = 100.0 * found.unexplained
        yield Finding(
            "bad",
            f"Nothing measures {names}, and the model leaves {share:.2g} % of an acceleration unexplained, and the log "
            "does not tell them apart",
            f"measure {names}",
        )
    timing = found.timing(forced=settings.forces_timing)
    acting = ActingInputs(intervals.inputs, intervals.hold, timing)
    exact = found.likeliest.exact
    for other in _equivalents(dataset, intervals, p):
        if explains_as_well(intervals, found.motion, acting, p, other, exact=exact, outliers=settings.outliers):
            pairs = zip(dataset.layout.names, other.tolist(), is_close(other, p), strict=True)
            changed = {name: x for name, x, close in pairs if not close}
            values = ", ".join(f"{name} = {x:.4g}" for name, x in changed.items())
            yield Finding(
                "bad",
                f"Since nothing measures {names}, {values} {'explain' if exact else 'may explain'} this log as well",
                f"bound {' or '.join(changed)}, or measure {names}",
            )
            return


def _equivalents(dataset: Dataset, intervals: Windows, parameters: FloatArray) -> list[FloatArray]:
    """Other admissible parameters that have the transfer function of given ones.

    Where all states are measured, equations of motion determine the parameters, and there are none.
    """
    model, layout, signals = dataset.model, dataset.layout, measured_signals(intervals)
    if not unmeasured_states(intervals) or not layout.is_shared or structural(model, signals, dataset.ranges):
        return []
    found = equivalent_parameters(model, parameters, signals, dataset.ranges)
    return [p for p in found if layout.admits(p[None])[0]]


# ---------------------------------------------------------------------- the estimate


@dataclass(frozen=True, eq=False, repr=False)
class _Found:
    """Parts of an estimate.

    ``ambiguity (n, n)`` is a covariance besides that of the result, for what one set of parameters cannot be;
    ``candidates`` is None where terms that the model lacks were not sought, ``lacks`` also where it is exact.
    """

    dataset: Dataset
    best: Searched
    result: ProjectedEstimate
    ambiguity: FloatArray
    candidates: Candidates | None
    lacks: MissingTerms | None

    @property
    def is_late(self) -> bool:
        """True for a significant delay or lag that all inputs have."""
        return self.best.is_late and (self.best.decided is None or self.best.decided.acting is None)

    def resolution(self, *, forced: bool) -> Resolution:
        """Simulation of the estimate; a forced delay of the inputs need not be significant."""
        intervals, decided = self.best.likeliest.intervals, self.best.decided
        if decided is not None and decided.acting is not None:
            return Resolution("rk4", intervals.substeps, decided.acting.hold, decided.acting.timing)
        return Resolution("rk4", intervals.substeps, intervals.hold, self.best.timing(forced=forced))


def _estimate(settings: LoDiransac, found: _Found, end: str, checks: tuple[Finding, ...]) -> Estimate:
    dataset, best, result = found.dataset, found.best, found.result
    intervals, names = best.likeliest.intervals, dataset.layout.names
    spans = np.sqrt(np.diag(result.covariance)) * 1.96
    units = parameter_units(intervals, best.motion, result.parameters)
    lost = ~((spans < units) | (spans < np.abs(result.parameters)))
    lost |= (units == 0.0) & np.isinf(dataset.layout.prior_std)  # a limit that never acts may be anything
    measured = measured_signals(intervals) if unmeasured_states(intervals) else None
    rows, hidden = rows_of_logs(intervals, best.motion), unmeasured_states(intervals)
    informed = excited(dataset.model, dataset.layout, rows, result.parameters) if lost.any() else None
    free = known_up_to_units(
        dataset.model, dataset.layout, rows, result.parameters, hidden, measured_signals(intervals)
    )
    lost, combinations, known = unidentifiable(
        dataset.model, dataset.layout, result.parameters, result.covariance, lost, measured, dataset.ranges, informed,
        free,
    )  # fmt: skip
    covariance = result.covariance + found.ambiguity
    covariance[lost] = covariance[:, lost] = np.inf
    return Estimate(
        parameters=dict(zip(names, result.parameters.tolist(), strict=True)),
        covariance=covariance,
        degrees_of_freedom=_GAUSSIAN,
        n_fitted=sum(int(np.isfinite(one.measured).any(axis=1).sum()) for one in dataset.segments),
        estimator="multiple shooting",
        iterations=n_samples(settings, dataset.model),
        n_hypotheses=best.n_hypotheses,
        stop_reason=end,
        resolution=found.resolution(forced=settings.forces_timing),
        notes=best.notes,
        diagnosis=_diagnosis(found, tuple(n for n, x in zip(names, lost, strict=True) if x), combinations, known),
        checks=checks,
        suggestions=found.lacks.suggestions if found.lacks else (),
        competition=None if best.decided is None else best.decided.summary,
        possible_terms=possible_terms(found.candidates, result, covariance, names) if found.candidates else None,
    )


def _diagnosis(
    found: _Found, lost: tuple[str, ...], combinations: tuple[str, ...], known: tuple[KnownUpTo, ...]
) -> Diagnosis:
    """Noise, faults and unmodelled forces, by name and over the rows of the given logs."""
    best, result = found.best, found.result
    intervals, fit = best.likeliest.intervals, best.likeliest.refinement.fit
    accelerations = [result.unexplained]
    if found.lacks and found.lacks.suggestions:
        # Parameters of the fit leave other forces than those of the answer, which change with the terms.
        apart = result.unexplained - unexplained(intervals, fit, result.of_fit)
        accelerations.append(found.lacks.accelerations + apart * (result.of_fit != result.parameters).any())
    forces = _forces_of(intervals, fit, result.parameters, accelerations)
    fitted, late = (fit.noise, fit.residuals, fit.x), best.common_timing
    input_noise = zip(intervals.model.inputs, best.likeliest.noise_of_inputs.tolist(), strict=True)
    return replace(
        diagnosis_of(found.dataset, intervals, fitted, result.unexplained, (lost, combinations)),
        unmodelled_forces=by_acceleration(intervals, forces[0]) if forces else {},
        input_delay=late.size * intervals.dt if late else 0.0,
        input_delay_error=late.std * intervals.dt if late else np.inf,
        input_delay_significant=found.is_late,
        known_up_to=known,
        input_noise={name: std for name, std in input_noise if std},
        suggested_terms=by_acceleration(intervals, (forces or accelerations)[1]) if len(accelerations) > 1 else {},
    )


def _forces_of(
    intervals: Windows, fit: Fit, parameters: FloatArray, accelerations: Sequence[FloatArray]
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
