"""`identify`: a `Result` from a model and logs, by dataset, method, estimate and evaluation."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from diransac.data import preprocessing
from diransac.data.dataset import Dataset, as_logs
from diransac.data.log import Log
from diransac.errors import DiransacError, SettingsError
from diransac.identification.estimate import Estimate, Evaluation, LogSummary
from diransac.identification.evaluation import choose_scoring, evaluate, judged_signals
from diransac.identification.method import Callback, Method, report, within
from diransac.identification.methods import DEFAULT, METHODS, WITH_ESTIMATOR, factory
from diransac.identification.result import Result
from diransac.identification.settings import Settings
from diransac.model import Model

__all__ = ["METHODS", "identify"]

_LEVEL = 1e-3
"""Probability, over all logs together, of naming a log that agrees."""

_NEGLIGIBLE = 1e-3
"""Relative difference that is none, however narrow the intervals are."""


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
        Estimator inside "diransac" and "i-diransac": `OrdinaryLeastSquares` (default; `NonlinearLeastSquares` where the
        model is not affine in its parameters), `TotalLeastSquares`, or any scikit-learn linear regressor.
    differentiate : bool, optional
        Whether to derive the velocities and accelerations that a log lacks, and to filter both sides of the equations
        alike; the identification is then repeated at half and at twice the bandwidth, for
        ``result.bandwidth_sensitivity``.  lo-diransac estimates missing signals without a filter.
    bandwidth : float, optional
        Bandwidth of the differentiating filter, Hz; None: chosen from the logs.
    progress : callable, optional
        Called with a `Progress` at every stage.

    Returns
    -------
    Result
        Parameters, covariance, evaluation and provenance.

    Raises
    ------
    LogError
        A log lacks a signal, or cannot be used.
    SettingsError
        An argument is out of range, or a setting is not used by the method.
    ModelError
        A linear method is given a model that is not affine in its parameters.
    IdentificationError
        A parameter is not identifiable from the logs, or no hypothesis was accepted.

    References
    ----------
    Dimmig et al. 2023, Algorithm 1.
    """
    chosen = _method(method, settings, estimator)
    given = as_logs(logs)
    _check_arguments(model, seed)
    filtered = differentiate and chosen.needs_all_signals
    if bandwidth is not None and not filtered:
        raise SettingsError(
            "bandwidth is given without differentiate=True, which alone uses it (and lo-diransac does not)"
        )
    task = _Task(model, given, chosen, int(seed), pointwise=chosen.needs_all_signals or not differentiate)
    if not filtered:
        return task.run(given, progress)
    derived = _derived(model, given, bandwidth)
    result = task.run(derived, within(progress, 0.0, 0.4))
    return task.with_sensitivity(result, derived, progress)


def _method(method: object, settings: object, estimator: object) -> Method:
    """The method object, with the settings that are given beside its name."""
    if settings is not None and not isinstance(settings, Settings):
        raise SettingsError(f"settings is {settings!r}; give a dr.Settings, such as dr.Settings(sample_size=75)")
    if not isinstance(method, str):
        if not hasattr(method, "fit") or isinstance(method, type):
            raise SettingsError(f"method is {method!r}; give a name ({', '.join(METHODS)}) or an object")
        if settings is not None or estimator is not None:
            raise SettingsError("settings and estimator belong to a method's name; a method object has its own")
        return method  # type: ignore[return-value]
    make, of_search = factory(method), {}
    if estimator is not None:
        if method not in WITH_ESTIMATOR:
            raise SettingsError(f'estimator serves the RANSAC methods; method "{method}" is an estimator itself')
        of_search["estimator"] = estimator
    return make(settings or Settings(), **of_search)


def _check_arguments(model: object, seed: object) -> None:
    if not isinstance(model, Model):
        raise SettingsError(f"model is {model!r}; give a dr.Model, such as dr.models.planar_rotorcraft()")
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer):
        raise SettingsError(f"seed is {seed!r}; give a whole number")


def _derived(model: Model, logs: Sequence[Log], bandwidth: float | None) -> tuple[Log, ...]:
    """The logs with derived signals, all filtered with one bandwidth: the lowest of those chosen for each log."""
    found = [preprocessing.differentiate(log, model, bandwidth) for log in logs]
    chosen = [log.filter.bandwidth for log in found if log.filter is not None]
    lowest = min(chosen)
    again = [
        x if used == lowest else preprocessing.differentiate(log, model, lowest)
        for x, used, log in zip(found, chosen, logs, strict=True)
    ]
    return tuple(again)


@dataclass(frozen=True)
class _Task:
    """One identification, apart from the preparation of its logs."""

    model: Model
    given: tuple[Log, ...]
    method: Method
    seed: int
    pointwise: bool

    def run(self, logs: Sequence[Log], progress: Callback | None = None) -> Result:
        """Identify from prepared logs."""
        criteria = self.method.criteria
        judged = judged_signals(self.model, logs, criteria)
        dataset = Dataset.of(self.model, logs, judged, pointwise=self.pointwise, given=self.given)
        several = len(logs) > 1
        estimate = self.method.fit(dataset, self.seed, within(progress, 0.0, 0.5 if several else 0.95))
        report(progress, "evaluating", 0.5 if several else 0.95)
        scoring = choose_scoring(dataset, criteria)
        evaluation = evaluate(estimate, dataset, scoring, criteria)
        remarks = _disagreements(self.method, dataset, self.seed, within(progress, 0.5, 1.0))
        report(progress, "done", 1.0)
        return Result(
            model=self.model,
            method=self.method.name,
            seed=self.seed,
            settings=criteria,
            options=dict(self.method.options()),
            estimate=estimate,
            evaluation=evaluation,
            logs=_summaries(dataset, evaluation, remarks),
            notes=(*dataset.notes, *estimate.notes, *scoring.notes, *(x for x in remarks if x)),
        )

    def with_sensitivity(self, result: Result, derived: Sequence[Log], progress: Callback | None) -> Result:
        """The result with each parameter's relative change at half and twice the differentiating bandwidth."""
        chosen = derived[0].filter
        assert chosen is not None
        changes = []
        for k, factor in enumerate((0.5, 2.0)):
            part = within(progress, 0.4 + 0.3 * k, 0.7 + 0.3 * k, f"{factor:g} x bandwidth: ")
            changes.append(self._change(result, chosen.bandwidth * factor, part))
        pairs = {n: (changes[0][n], changes[1][n]) for n in result.parameters}
        return dataclasses.replace(result, bandwidth_sensitivity=pairs)

    def _change(self, result: Result, bandwidth: float, progress: Callback | None) -> dict[str, float]:
        """Relative change of each parameter at another bandwidth; NaN where nothing was identified there."""
        try:
            other = self.run(_derived(self.model, self.given, bandwidth), progress).parameters
        except DiransacError:
            return dict.fromkeys(result.parameters, np.nan)
        return {n: (other[n] - x) / abs(x) if x else np.inf for n, x in result.parameters.items()}


def _summaries(dataset: Dataset, evaluation: Evaluation, remarks: Sequence[str]) -> tuple[LogSummary, ...]:
    scores = zip(evaluation.fit_errors.tolist(), evaluation.inlier_fractions.tolist(), strict=True)
    parts = zip(dataset.given, dataset.segments, scores, remarks, strict=True)
    return tuple(
        LogSummary(
            log.source,
            log.fingerprint,
            float(log.time[0]),
            log.dt,
            len(log),
            tuple(dict(step) for step in one.log.history),
            error,
            fraction,
            remark,
        )
        for log, one, (error, fraction), remark in parts
    )


# ---------------------------------------------------------------------- agreement of several logs


def _disagreements(method: Method, dataset: Dataset, seed: int, callback: Callback | None = None) -> tuple[str, ...]:
    """One remark per log: a sentence where its own estimate disagrees with those of the others, else empty.

    Each log is identified alone.  A shared parameter of log ``i`` is compared with the precision-weighted mean of the
    other logs: ``|p_i - p| > t sqrt(B (C_i + C))``, with Student's ``t`` at the level shared among all comparisons and
    the Birge ratio ``B >= 1`` of the others' scatter to their intervals.  The worst log is set aside and the others are
    compared again, so that one deviating log does not make the rest disagree.

    References
    ----------
    Birge 1932, "The calculation of errors by the method of least squares"; Cochran 1954, "The combination of estimates
    from different experiments"; Hadi and Simonoff 1993 (backward removal).
    """
    n, remarks = len(dataset.segments), [""] * len(dataset.segments)
    if n == 1:
        return ("",)
    found = {}
    for i in range(n):
        estimate = _alone(method, dataset, i, seed, within(callback, i / n, (i + 1) / n, f"log {i + 1} alone: "))
        if estimate is not None:
            found[i] = estimate
    shared = [name for name, x in dataset.model.parameters.items() if not x.per_log]
    level = _LEVEL / max(1, 2 * len(shared) * n)
    while len(found) > 1:
        tests = {i: _worst(found, i, shared, level) for i in found}
        worst = max(found, key=lambda i: tests[i][0])
        if tests[worst][0] <= 1.0:
            break
        named = list(found) if len(found) == 2 else [worst]
        for i in named:
            remarks[i] = f"{dataset.given[i].source} disagrees with the other logs: {tests[i][1]}"
            del found[i]
    return tuple(remarks)


def _alone(method: Method, dataset: Dataset, i: int, seed: int, callback: Callback | None) -> Estimate | None:
    """Estimate from one log, or None where that log alone is insufficient."""
    try:
        return method.fit(dataset.subset([i]), seed, callback)
    except DiransacError:
        return None


def _worst(found: Mapping[int, Estimate], i: int, names: Sequence[str], level: float) -> tuple[float, str]:
    """Largest difference of log ``i`` from the others over what is allowed, and a sentence on it."""
    from scipy.special import stdtrit

    worst, sentence = 0.0, ""
    t = float(stdtrit(min(x.degrees_of_freedom for x in found.values()), 1.0 - level))
    for name in names:
        own, variance = _marginal(found[i], name)
        others = [_marginal(x, name) for j, x in found.items() if j != i]
        others = [(p, v) for p, v in others if np.isfinite(v)]
        if not np.isfinite(variance) or not others:
            continue
        mean, spread, ratio = _combined(others)
        allowed = max(t * np.sqrt(ratio * (variance + spread)), _NEGLIGIBLE * abs(mean))
        surprise = abs(own - mean) / allowed if allowed > 0.0 else 0.0
        if surprise > worst:
            worst = float(surprise)
            sentence = (
                f"{name} {own:.4g} ± {np.sqrt(variance):.2g} here, {mean:.4g} ± {np.sqrt(ratio * spread):.2g} there"
            )
    return worst, sentence


def _marginal(estimate: Estimate, name: str) -> tuple[float, float]:
    """A parameter and its variance."""
    k = list(estimate.parameters).index(name)
    return estimate.parameters[name], float(estimate.covariance[k, k])


def _combined(values: Sequence[tuple[float, float]]) -> tuple[float, float, float]:
    """Precision-weighted mean of (value, variance) pairs, its variance, and the Birge ratio, at least 1."""
    p, v = np.array(values).T
    weights = 1.0 / np.maximum(v, np.finfo(float).tiny)
    mean = float(weights @ p / weights.sum())
    chi_squared = float(weights @ np.square(p - mean)) / max(1, len(p) - 1)
    return mean, float(1.0 / weights.sum()), max(1.0, chi_squared)
