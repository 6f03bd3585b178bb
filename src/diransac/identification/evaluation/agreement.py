"""Agreement of several logs: the logs whose own estimate differs from the others' by more than both are uncertain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from diransac.data.dataset import Dataset
from diransac.errors import DiransacError, TimeLimitError
from diransac.identification.estimate import Disagreement, LogEstimate
from diransac.identification.method import Callback, Method, fit, within
from diransac.identification.regression.uncertainty import student_quantile
from diransac.time_limit import check_time

_DELAY = "input delay [s]"
"""Name of the delay of the inputs in a sentence."""


@runtime_checkable
class ComparesLogs(Protocol):
    """A method whose fit of several logs gives estimates of each of them."""

    def estimates_of_logs(self, dataset: Dataset, seed: int, callback: Callback | None = None) -> list[LogEstimate]:
        """Estimates of each log alone, after `Method.fit` of all; empty where that gives none."""


def disagreements(
    method: Method, dataset: Dataset, seed: int, callback: Callback | None = None
) -> tuple[list[Disagreement], list[str]]:
    """Logs whose own estimate disagrees with those of the others.

    The second list has a sentence on every log that cannot be compared, because alone it gives no estimate.

    Each log's own estimate is the method's (`ComparesLogs`), where it has one; otherwise the log is identified alone.
    A shared parameter of log ``i`` is compared with the precision-weighted mean of the other logs, ``|p_i - p| > t
    sqrt(B (C_i + C))``, with Student's ``t`` at the level shared among all comparisons and the Birge ratio ``B >= 1``
    of the others' scatter to their intervals.  The worst log is set aside and the others are compared again, so that
    one deviating log does not make the rest disagree.  Input delays are compared likewise.

    References
    ----------
    Birge 1932, "The calculation of errors by the method of least squares"; Cochran 1954, "The combination of estimates
    from different experiments"; Hadi and Simonoff 1993 (backward removal).
    """
    n, named, notes = len(dataset.segments), list[Disagreement](), list[str]()
    shared = [name for name, x in dataset.model.parameters.items() if not x.per_log]
    estimates: dict[int, LogEstimate] = {}
    try:
        every = _each(method, dataset, seed, callback)
    except TimeLimitError:
        return named, ["the time limit was reached before the logs were compared with each other"]
    for i, own in enumerate(every):
        if not isinstance(own, str) and any(np.isfinite(own.standard_errors[name]) for name in shared):
            estimates[i] = own
        else:
            reason = own if isinstance(own, str) else "alone it tells too little of the parameters"
            notes.append(f"{dataset.given[i].source} could not be compared with the other logs: {reason}")
    # The probability, over all logs together, of naming a log that agrees is 0.1 %.
    level = 1e-3 / max(1, 2 * len(shared) * n)
    while len(estimates) > 1:
        tests = {i: _worst(estimates, i, shared, level, dataset.segments[i].log.dt) for i in estimates}
        worst = max(estimates, key=lambda i: tests[i][0])
        if tests[worst][0] <= 1.0:
            break
        for i in list(estimates) if len(estimates) == 2 else [worst]:
            _, name, text, late = tests[i]
            own = estimates.pop(i)
            alone = {x: own.parameters[x] for x in shared if np.isfinite(own.standard_errors[x])}
            claim = f"{dataset.given[i].source} disagrees with the other logs: {text}"
            advice = "leave this log out, or give what differs a value per log"
            named.append(Disagreement(claim, advice, "" if name == _DELAY else name, alone, late, i))
    return named, notes


def _each(method: Method, dataset: Dataset, seed: int, callback: Callback | None) -> Sequence[LogEstimate | str]:
    """The estimate of each log, or the reason why that log alone gives none."""
    if isinstance(method, ComparesLogs) and (every := method.estimates_of_logs(dataset, seed, callback)):
        return every
    n = len(dataset.segments)
    parts = [within(callback, i / n, (i + 1) / n, f"log {i + 1} alone: ") for i in range(n)]
    return [_alone(method, dataset, i, seed, part) for i, part in enumerate(parts)]


def _alone(method: Method, dataset: Dataset, i: int, seed: int, callback: Callback | None) -> LogEstimate | str:
    """The estimate of one log, or the reason why that log alone gives none.

    Raises TimeLimitError: the time limit was reached.
    """
    try:
        found = fit(method, dataset.subset([i]), seed, callback)
        check_time()
    except TimeLimitError:
        raise
    except (DiransacError, np.linalg.LinAlgError) as error:
        return str(error)
    errors = dict(zip(found.parameters, np.sqrt(np.diag(found.covariance)).tolist(), strict=True))
    delay, spread = 0.0, np.inf
    if found.diagnosis is not None:
        delay, spread = found.diagnosis.input_delay, found.diagnosis.input_delay_error
    return LogEstimate(found.parameters, errors, delay, spread, found.degrees_of_freedom)


def _worst(
    estimates: Mapping[int, LogEstimate], i: int, parameters: Sequence[str], level: float, dt: float
) -> tuple[float, str, str, float]:
    """Largest difference of log ``i`` from the others over what is allowed, its name and text, and its delay, s."""
    names = (*parameters, _DELAY)
    values, variances = np.array([_marginals(x, parameters) for x in estimates.values()]).swapaxes(0, 1)
    # Any estimate has an error by rounding.
    variances = np.maximum(variances, np.square(1e-12 * np.abs(values).max(axis=0)) + np.finfo(float).tiny)
    own = np.array(list(estimates)) == i
    (value,), (variance,), others, spreads = values[own], variances[own], values[~own], variances[~own]
    least = spreads.min(axis=0)
    with np.errstate(invalid="ignore"):  # infinite variances of what no other log tells
        weights = np.nan_to_num(least / spreads)
        mean = (weights * others).sum(axis=0) / weights.sum(axis=0)
        scatter = (weights * np.square(others - mean)).sum(axis=0) / least
        birge = np.maximum(1.0, scatter / np.maximum(np.isfinite(spreads).sum(axis=0) - 1, 1))
        spread = least / weights.sum(axis=0)
        t = student_quantile(min(x.degrees_of_freedom for x in estimates.values()), 1.0 - level)
        # A difference of 0.1 %, or of a quarter of a sample, is none, however narrow the intervals are.
        least_allowed = np.append(1e-3 * np.abs(mean[:-1]), max(1e-3 * abs(mean[-1]), 0.25 * dt))
        allowed = np.maximum(t * np.sqrt(birge * (variance + spread)), least_allowed)
        surprise = np.nan_to_num(np.abs(value - mean) / allowed)
    k = int(np.argmax(surprise))
    here, there = f"{value[k]:.4g} ± {np.sqrt(variance[k]):.2g}", f"{mean[k]:.4g} ± {np.sqrt(birge[k] * spread[k]):.2g}"
    late = float(value[k] - mean[k]) if names[k] == _DELAY else 0.0
    return float(surprise[k]), names[k], f"{names[k]} {here} here, {there} there", late


def _marginals(estimate: LogEstimate, parameters: Sequence[str]) -> tuple[list[float], list[float]]:
    """Parameters and the delay of the inputs, and their variances."""
    values = [estimate.parameters[n] for n in parameters]
    errors = [estimate.standard_errors[n] for n in parameters]
    return [*values, estimate.input_delay], np.square([*errors, estimate.input_delay_error]).tolist()
