"""`identify`: a `Result` from a model and logs, by dataset, method, estimate and evaluation."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from diransac.data import preprocessing
from diransac.data.dataset import Dataset, distinct_logs, usable_sensors
from diransac.data.log import Log
from diransac.errors import DiransacError, IdentificationError, LogError, SettingsError, TimeLimitError
from diransac.identification.estimate import Disagreement, Estimate, Evaluation, LogSummary, Prediction
from diransac.identification.evaluation.agreement import disagreements
from diransac.identification.evaluation.findings import noticed_disagreements
from diransac.identification.evaluation.prediction import predictions
from diransac.identification.evaluation.scoring import choose_scoring, evaluate, judged_signals
from diransac.identification.finding import NEAR, Finding
from diransac.identification.method import Callback, Method, fit, numerical_failures, report, within
from diransac.identification.methods import DEFAULT, METHODS, WITH_ESTIMATOR, estimator_named, factory
from diransac.identification.result import Result
from diransac.identification.settings import Settings
from diransac.identification.structure.columns import Mistake, contradictions, mistakes_of_columns, wraps
from diransac.identification.structure.known_parameters import KnownParameters
from diransac.identification.structure.lacking_terms import with_terms
from diransac.identification.structure.refusal import check_motion
from diransac.model import Model
from diransac.process import single_threaded
from diransac.simulation import HOLDS
from diransac.time_limit import check_time, time_limited, time_unlimited


def identify(
    model: Model,
    logs: Log | Iterable[Log],
    method: str | Method = DEFAULT,
    *,
    seed: int = 0,
    settings: Settings | None = None,
    estimator: object = None,
    differentiate: bool = False,
    bandwidth: float | None = None,
    input_hold: str | None = None,
    fixed: Mapping[str, float | None] | Iterable[str] | None = None,
    priors: Mapping[str, tuple[float, float]] | None = None,
    start: Mapping[str, float] | None = None,
    horizon: float | None = None,
    compare_logs: bool = True,
    with_suggestions: bool | Iterable[str] = False,
    time_limit: float | None = None,
    progress: Callback | None = None,
) -> Result:
    """Parameters of a model from one log, or from several logs of one machine.

    Parameters
    ----------
    model : Model
        Equations with the parameters to be estimated.
    logs : Log or iterable of Log
        One log, or several.  Logs share all parameters except those with ``Parameter.per_log``; each log has an initial
        state of its own.
    method : str or Method, optional
        Name or object.  "lo-diransac" (default) needs no tuning and returns full diagnostics; "ols", "tls", "nls" are
        least squares of all rows (ordinary, total, nonlinear); "diransac" and "i-diransac" are the paper's.  An object,
        such as ``dr.LoDiransac(substeps=10)``, carries its own settings.
    seed : int, optional
        Seed of all random numbers; sample k of a search depends on (seed, k) alone.
    settings : Settings, optional
        Settings of a method that is given by name; a setting that the method does not use is refused.
    estimator : object, optional
        Estimator inside "diransac" and "i-diransac": "ols" or `OrdinaryLeastSquares` (default; "nls" or
        `NonlinearLeastSquares` where the model is not affine in its parameters), "tls" or `TotalLeastSquares`, or any
        scikit-learn linear regressor.
    differentiate : bool, optional
        Whether to derive the velocities and accelerations that a log lacks, and to filter both sides of the equations
        alike; the identification is then repeated at half and at twice the bandwidth, for
        ``result.bandwidth_sensitivity``.  The regressions need it for a log of positions; lo-diransac fits what is
        measured, with or without it.
    bandwidth : float, optional
        Bandwidth of the differentiating filter, Hz; None: chosen from each log.
    input_hold : str, optional
        Inputs between samples in every simulation: "zero-order", held, as those of a digital controller are; "linear"
        or "smooth", interpolated, for continuous inputs such as those of a sensor.  None: "zero-order"; lo-diransac
        chooses the likeliest.
    fixed : mapping of str to float, or iterable of str, optional
        Value of each parameter that is not to be identified, in its unit; None, or a name alone, for its nominal
        value (``Parameter.value``).  The result has it, with a standard error of zero, and names it in ``fixed``.
    priors : mapping of str to (float, float), optional
        Mean and standard deviation of a Gaussian prior of a parameter, in its unit; for a per-log parameter, of the
        value in each log.  A prior has the weight that the noise of the log gives it: see `docs/identifiability.md`.
    start : mapping of str to float, optional
        Rough values of some parameters, in their units, from which lo-diransac starts a search by simulation error in
        addition; no more than a start, unlike a prior.
    horizon : float, optional
        Time over which the model is to predict, s: lo-diransac compares estimates by predictions of this length.  None:
        several, from the time scales of the motion.
    compare_logs : bool, optional
        Whether each of several logs is also identified alone, so that logs that disagree with the others are named.
    with_suggestions : bool or iterable of str, optional
        Whether to identify again with the terms that the first identification suggests (`Result.suggestions`), and to
        return that result, whose model has them as further parameters; for lo-diransac.  Names of such parameters:
        with these alone, in steps where a term is suggested only once another one is there.
    time_limit : float, optional
        Time after which the search ends, s; the result is then the best that was found, and a finding says so.  What
        follows the search - intervals, evaluation - takes its time in addition.
    progress : callable, optional
        Called with a `Progress` at every stage.

    Returns
    -------
    Result
        Parameters, covariance, evaluation and provenance.

    Raises
    ------
    LogError
        A log lacks a signal, cannot be used, or is given twice.
    SettingsError
        An argument is out of range, or a setting is not used by the method.
    ModelError
        A linear method is given a model that is not affine in its parameters.
    IdentificationError
        A parameter is not identifiable from the logs, or no hypothesis was accepted.
    TimeLimitError
        The time limit was reached before there was an estimate.

    References
    ----------
    Dimmig et al. 2023, Algorithm 1.
    """
    chosen = _with_options(method_object(method, settings, estimator), start=start, horizon=horizon)
    given = distinct_logs(logs)
    _check_arguments(model, seed)
    hold = checked_hold(input_hold)
    filtered = differentiate and chosen.needs_all_signals
    if bandwidth is not None and not filtered:
        raise SettingsError(
            "bandwidth is given without differentiate=True, which alone uses it (and lo-diransac does not)"
        )
    if with_suggestions and not (getattr(chosen, "suggestions", False) and model.has_equations):
        without = f"method {chosen.name}" if model.has_equations else "a model without equations"
        raise SettingsError(f"with_suggestions=True needs suggestions, which {without} does not give")
    known = KnownParameters.of(model, fixed, priors)
    task = _Task(known, given, chosen, int(seed), hold, compares=compare_logs and len(given) > 1)
    with time_limited(time_limit), numerical_failures(given):
        if with_suggestions:
            return task.with_suggestions(None if with_suggestions is True else set(with_suggestions), progress)
        if not filtered:
            return task.run(given, progress)
        derived = tuple(preprocessing.differentiate(log, model, bandwidth) for log in given)
        result = task.run(derived, within(progress, 0.0, 0.4))
        return task.with_sensitivity(result, derived, progress)


def method_object(method: object, settings: object, estimator: object) -> Method:
    """The method object itself, or that of a name, with the settings and the estimator that are given beside it.

    Parameters
    ----------
    method : str or Method
    settings : Settings or None
    estimator : str, Estimator or None

    Raises
    ------
    SettingsError
        There is no such method or estimator, or the method has no use for what is given beside it.
    """
    if settings is not None and not isinstance(settings, Settings):
        raise SettingsError(f"settings is {settings!r}; give a dr.Settings, such as dr.Settings(sample_size=75)")
    if not isinstance(method, str):
        if isinstance(method, type) or not all(hasattr(method, x) for x in ("fit", "criteria", "options")):
            raise SettingsError(f"method is {method!r}; give a name ({', '.join(METHODS)}) or an object")
        if settings is not None or estimator is not None:
            raise SettingsError("settings and estimator belong to a method's name; a method object has its own")
        return method  # type: ignore[return-value]
    make, of_search = factory(method), {}
    if estimator is not None:
        if method not in WITH_ESTIMATOR:
            raise SettingsError(f'estimator serves the RANSAC methods; method "{method}" is an estimator itself')
        of_search["estimator"] = estimator_named(estimator) if isinstance(estimator, str) else estimator
    return make(settings or Settings(), **of_search)


def _with_options(method: Method, **options: object) -> Method:
    """The method with options that are given beside it.  Raises SettingsError: it has no use for one."""
    given = {name: value for name, value in options.items() if value is not None}
    for name in given:
        if not hasattr(method, name):
            raise SettingsError(f"{name} is given, for which method {method.name} has no use; leave it out")
    return dataclasses.replace(method, **given) if given else method  # type: ignore[type-var]


def checked_hold(name: object) -> str | None:
    """The hold of the inputs itself, None included.

    Raises
    ------
    SettingsError
        There is no hold of that name.
    """
    if name is None or (isinstance(name, str) and name in HOLDS):
        return name
    raise SettingsError(f"input_hold is {name!r}; choose {', '.join(HOLDS)}, or None")


def _check_arguments(model: object, seed: object) -> None:
    if not isinstance(model, Model):
        raise SettingsError(f"model is {model!r}; give a dr.Model, such as dr.models.planar_rotorcraft()")
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer):
        raise SettingsError(f"seed is {seed!r}; give a whole number")


class Identification:
    """Identification of a model from the same logs by one method after another.

    Each result is that of `identify` without predictions and tests of columns, which take several times as long as
    least squares.
    Methods share what does not depend on them: the logs bound to the model, sums of the regression, and random samples
    with their scores.

    Parameters
    ----------
    model : Model
        Equations with the parameters to be estimated.
    logs : Log or iterable of Log
        One log, or several.

    Raises
    ------
    LogError
        A log is given twice.
    SettingsError
        An argument is none of these.
    """

    def __init__(self, model: Model, logs: Log | Iterable[Log]) -> None:
        self._given, self._known = distinct_logs(logs), KnownParameters.of(model, None, None)
        self._datasets: list[tuple[object, Dataset]] = []

    def by(self, method: Method, seed: int = 0) -> Result:
        """The result of a method.  Raises as `identify` does."""
        _check_arguments(self._known.model, seed)
        task = _Task(self._known, self._given, method, int(seed), None, len(self._given) > 1, self._datasets)
        with numerical_failures(self._given):
            return task.fitted(self._given)[0]


def _moving_dataset(*arguments: Any, **options: Any) -> Dataset:
    """`Dataset.of` these arguments.  Raises IdentificationError: nothing moves in the logs, or a counter wraps."""
    dataset = Dataset.of(*arguments, **options)
    check_motion(dataset)
    if mistakes := wraps(dataset.model, dataset.given):
        raise IdentificationError(f"{dataset.source}: {'; '.join(f'{x.claim}; {x.action}' for x in mistakes)}")
    return dataset


@dataclass(frozen=True)
class _Task:
    """One identification, apart from the preparation of its logs."""

    known: KnownParameters
    given: tuple[Log, ...]
    method: Method
    seed: int
    input_hold: str | None
    compares: bool
    datasets: list[tuple[object, Dataset]] | None = None
    """Those of earlier methods with all that they were made of, which this one's is taken from and added to."""

    @single_threaded()  # matrices are small: more threads would only wait for one another
    def run(self, logs: Sequence[Log], progress: Callback | None = None) -> Result:
        """The result from prepared logs, with findings on mistakes of their columns."""
        result, dataset = self.fitted(logs, progress)
        return _with_tested_columns(_with_predictions(result, self.given), dataset)

    @single_threaded()
    def fitted(self, logs: Sequence[Log], progress: Callback | None = None) -> tuple[Result, Dataset]:
        """The result from prepared logs, without predictions and findings on mistakes of columns, and the dataset."""
        logs = logs if self.method.needs_all_signals else [log.measured for log in logs]
        required = set(self.known.model.required_signals)
        pointwise = self.method.needs_all_signals or all(required <= set(log.signals) for log in logs)
        known, unused = self._observed(logs)
        criteria, model = self.method.criteria, known.free()
        judged = judged_signals(model, logs, criteria)
        options = {"given": self.given, "input_hold": self.input_hold, "priors": known.priors_of_fit}
        make = partial(_moving_dataset, model, logs, judged, pointwise=pointwise, **options)
        made_of, others = (make.args, make.keywords), [] if self.datasets is None else self.datasets
        dataset = next((x for key, x in others if key == made_of), None) or make()
        others.append((made_of, dataset))
        fitted = 0.5 if self.compares else 0.95
        estimate = _explained(dataset, lambda: fit(self.method, dataset, self.seed, within(progress, 0.0, fitted)))
        report(progress, "evaluating", fitted)
        scoring = choose_scoring(dataset, criteria)
        evaluation = evaluate(estimate, dataset, scoring, criteria)
        named, incomparable = list[Disagreement](), list[str]()
        if self.compares:
            named, incomparable = disagreements(self.method, dataset, self.seed, within(progress, fitted, 1.0))
        report(progress, "done", 1.0)
        result = Result(
            model=known.model,
            method=self.method.name,
            seed=self.seed,
            settings=criteria,
            options=dict(self.method.options()),
            estimate=known.completed(
                dataclasses.replace(estimate, disagreements=(*estimate.disagreements, *named)), len(logs)
            ),
            evaluation=evaluation,
            logs=_summaries(dataset, evaluation, named, predictions(estimate, evaluation, dataset)),
            notes=(*known.model.notes, *unused, *dataset.notes, *estimate.notes, *scoring.notes, *incomparable),
            fixed=tuple(n for n in known.model.parameters if n in known.fixed),
            priors=dict(known.priors),
        )
        return result, dataset

    def _observed(self, logs: Sequence[Log]) -> tuple[KnownParameters, tuple[str, ...]]:
        """The known parameters of the model with the sensors that the method can use, and notes on the others."""
        free = self.known.free()
        used, notes = usable_sensors(free, logs, regression=self.method.regresses(free))
        return self.known.of_model(self.known.model.with_sensors(used)), notes

    def with_suggestions(self, wanted: set[str] | None, progress: Callback | None) -> Result:
        """The result of the model with wanted terms that identifications suggest, of the first one's all for None.

        Its notes name them.
        """
        found, task, done, notes = self.run(self.given, within(progress, 0.0, 0.5)), self, 0.5, list[str]()
        while chosen := [x for x in found.suggestions if wanted is None or x.parameter in wanted]:
            terms = "; ".join(x.text for x in chosen)
            wanted = (wanted or set()) - {x.parameter for x in chosen}
            task = dataclasses.replace(task, known=task.known.of_model(with_terms(found.model, chosen)))
            begin, done = done, 0.5 * (1.0 + done) if wanted else 1.0
            try:
                other = task.run(self.given, within(progress, begin, done, "with suggested terms: "))
            except TimeLimitError:
                notes.append(f"the time limit was reached before suggested terms could be added: {terms}")
                break
            except IdentificationError as error:
                notes.append(f"suggested terms were not added, since identification fails with them ({error}): {terms}")
                break
            if not _predicts_as_well(other, found):
                notes.append(f"suggested terms were not added, since predictions are worse with them: {terms}")
                break
            found = other
            notes.append(f"terms were added to the model as suggested: {terms}")
        if wanted:
            notes.append(f"nothing suggests the terms {', '.join(sorted(wanted))}, which were not added")
        elif not notes:
            notes.append("no terms were suggested; the model is the given one")
        return dataclasses.replace(found, notes=(*notes, *found.notes))

    def with_sensitivity(self, result: Result, derived: Sequence[Log], progress: Callback | None) -> Result:
        """The result with each parameter's relative change at half and twice the bandwidth of every log."""
        chosen, changes = [log.filter.bandwidth for log in derived if log.filter is not None], list[dict[str, float]]()
        for k, factor in enumerate((0.5, 2.0)):
            part = within(progress, 0.4 + 0.3 * k, 0.7 + 0.3 * k, f"{factor:g} x bandwidth: ")
            try:
                pairs = zip(self.given, chosen, strict=True)
                logs = [preprocessing.differentiate(log, self.known.model, factor * x) for log, x in pairs]
                other = dataclasses.replace(self, compares=False).fitted(logs, part)[0].parameters
                check_time()
            except TimeLimitError:
                note = "the time limit was reached before the bandwidth of the filter was varied"
                return dataclasses.replace(result, notes=(*result.notes, note))
            except DiransacError:  # nothing was identified there
                other = dict.fromkeys(result.parameters, np.nan)
            changes.append({n: (other[n] - x) / abs(x) if x else np.inf for n, x in result.parameters.items()})
        report(progress, "done", 1.0)
        sensitivity = {n: (changes[0][n], changes[1][n]) for n in result.parameters if n not in result.fixed}
        return dataclasses.replace(result, bandwidth_sensitivity=sensitivity)


def _mistakes(dataset: Dataset, *, delays: bool = True) -> tuple[list[Mistake], int]:
    """Mistakes of columns that explain the logs, and the number of those tested; none without equations."""
    if not dataset.model.has_equations:
        return [], 0

    def found() -> tuple[list[Mistake], int]:
        with np.errstate(all="ignore"):  # a correction that overflows explains nothing
            return mistakes_of_columns(dataset, delays=delays)

    try:
        return dataset.kept(("mistakes of columns", delays), found)
    except TimeLimitError:
        return [], 0


def _explained(dataset: Dataset, fitted: Callable[[], Estimate]) -> Estimate:
    """The estimate of a method.  Raises IdentificationError: as the method does; a mistake of a column is named."""
    try:
        return fitted()
    except IdentificationError as error:
        mistakes, _ = _mistakes(dataset)
        if not mistakes:
            raise
        named = "; ".join(f"{x.claim}; {x.action}" for x in mistakes)
        explains = any(x.explains for x in mistakes)
        raise IdentificationError(f"{dataset.source}: {named}" if explains else f"{error}. {named}") from error


def _with_tested_columns(result: Result, dataset: Dataset) -> Result:
    """The result with findings on mistakes of columns: contradictions, and what explains a bad answer.

    An answer is doubtful, too, where much is unexplained, or a parameter that must not be zero may be if a term lacks.
    """
    if not dataset.model.has_equations:
        return result
    left = (x for one in result.logs if one.prediction for x in one.prediction.unexplained.values())
    is_bad, n_tested, parameters = result.verdict == "do not rely on this", 0, result.model.parameters
    intervals = result.structural_intervals() if result.has_structure else result.intervals()
    lost = any(low <= 0.0 <= high and not parameters[n].admits(0.0) for n, (low, high) in intervals.items())
    # A quarter of an acceleration that is unexplained is a reason to test columns.
    is_doubtful = result.verdict != "usable" or lost or max(left, default=0.0) > 0.25
    if is_doubtful:
        mistakes, n_tested = _mistakes(dataset, delays=not result.separates_forces)
    else:
        mistakes = contradictions(dataset.model, dataset.given)
    found = [Finding("bad" if is_bad or (is_doubtful and x.explains) else "care", x.claim, x.action) for x in mistakes]
    if not (found or n_tested):
        return result
    estimate = dataclasses.replace(result.estimate, mistakes=tuple(found), n_columns_tested=0 if found else n_tested)
    return dataclasses.replace(result, estimate=estimate)


def _predicts_as_well(other: Result, found: Result) -> bool:
    """True if a result with further terms predicts no worse: held-out blocks, and the logs over the same horizons.

    A result without competition predicts the logs within their noise, so that there are no held-out blocks.
    """
    both = [() if x.competition is None else x.competition.competitors for x in (other, found)]
    if all(both) and min(x.score for x in both[0]) > min(x.score for x in both[1]):
        return False
    if other.predictions is None or found.predictions is None:
        return found.predictions is None
    with_terms, without = (
        np.median([max(x.relative_error.values(), default=0.0) for x in scored.horizons])
        for scored in (other.predictions, found.predictions)
    )
    return bool(with_terms <= max(without, NEAR))


def _with_predictions(result: Result, logs: Sequence[Log]) -> Result:
    """The result with open-loop predictions of the logs as they were given, as `validate` scores them.

    Disagreements that nobody would notice are left out.
    """
    from diransac.identification.prediction.horizons import effect_of, predictions_of  # which needs all of lo-diransac

    own, resolution = [result.parameters_in(log) for log in logs], result.estimate.resolution
    noise = None if result.diagnosis is None else result.diagnosis.noise_std
    try:
        with time_unlimited(), np.errstate(all="ignore"):  # it completes an answer; what overflows predicts nothing
            dataset = Dataset.of(result.model, logs, pointwise=False)
            loops, found = predictions_of(dataset, own, resolution, result.options.get("horizon"), noise=noise)
            effects = [effect_of(x, loops, found.judged.horizon) for x in result.estimate.disagreements]
    except LogError:
        return result
    pairs = zip(result.estimate.disagreements, effects, strict=True)
    known = tuple(dataclasses.replace(x, effect=effect) for x, effect in pairs)
    estimate = dataclasses.replace(result.estimate, disagreements=known)
    noticed = tuple(x for x, _ in noticed_disagreements(dataclasses.replace(result, estimate=estimate)))
    claims = [x.claim for x in noticed]
    return dataclasses.replace(
        result,
        predictions=found,
        estimate=dataclasses.replace(estimate, disagreements=noticed),
        logs=tuple(x if x.remark in claims else dataclasses.replace(x, remark="") for x in result.logs),
    )


def _summaries(
    dataset: Dataset,
    evaluation: Evaluation,
    named: Sequence[Disagreement],
    predicted: Sequence[Prediction | None],
) -> tuple[LogSummary, ...]:
    claims = {x.log: x.claim for x in named}
    return tuple(
        LogSummary(
            source=log.source,
            fingerprint=log.fingerprint,
            start=float(log.time[0]),
            dt=log.dt,
            n_rows=len(log),
            preparation=tuple(dict(step) for step in dataset.segments[i].log.history),
            fit_error=float(evaluation.fit_errors[i]),
            inlier_fraction=float(evaluation.inlier_fractions[i]),
            remark=claims.get(i, ""),
            prepared_fingerprint=dataset.segments[i].log.fingerprint,
            prediction=predicted[i],
        )
        for i, log in enumerate(dataset.given)
    )
