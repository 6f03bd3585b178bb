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
_ADVICE = "leave this log out, or give what differs a value per log"


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
    found: dict[int, LogEstimate] = {}
    try:
        every = _each(method, dataset, seed, callback)
    except TimeLimitError:
        return named, ["the time limit was reached before the logs were compared with each other"]
    for i, own in enumerate(every):
        if not isinstance(own, str) and any(np.isfinite(own.standard_errors[name]) for name in shared):
            found[i] = own
        else:
            reason = own if isinstance(own, str) else "alone it tells too little of the parameters"
            notes.append(f"{dataset.given[i].source} could not be compared with the other logs: {reason}")
    # The probability, over all logs together, of naming a log that agrees is 0.1 %.
    level = 1e-3 / max(1, 2 * len(shared) * n)
    while len(found) > 1:
        tests = {i: _worst(found, i, shared, level, dataset.segments[i].log.dt) for i in found}
        worst = max(found, key=lambda i: tests[i][0])
        if tests[worst][0] <= 1.0:
            break
        for i in list(found) if len(found) == 2 else [worst]:
            _, name, text, late = tests[i]
            alone = {x: found[i].parameters[x] for x in shared if np.isfinite(found[i].standard_errors[x])}
            claim = f"{dataset.given[i].source} disagrees with the other logs: {text}"
            named.append(Disagreement(claim, _ADVICE, "" if name == _DELAY else name, alone, late, i))
            del found[i]
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
    found: Mapping[int, LogEstimate], i: int, parameters: Sequence[str], level: float, dt: float
) -> tuple[float, str, str, float]:
    """Largest difference of log ``i`` from the others over what is allowed, its name and text, and its delay, s."""
    worst, named, text, late = 0.0, "", "", 0.0
    t = student_quantile(min(x.degrees_of_freedom for x in found.values()), 1.0 - level)
    for name in (*parameters, _DELAY):
        own, variance = _marginal(found[i], name)
        others = [_marginal(x, name) for j, x in found.items() if j != i]
        others = [(p, v) for p, v in others if np.isfinite(v)]
        if not np.isfinite(variance) or not others:
            continue
        mean, spread, ratio = _combined(others)
        # A difference of 0.1 %, or of a quarter of a sample, is none, however narrow the intervals are.
        allowed = max(t * np.sqrt(ratio * (variance + spread)), 1e-3 * abs(mean), 0.25 * dt if name == _DELAY else 0.0)
        late = float(own - mean) if name == _DELAY else 0.0
        surprise = abs(own - mean) / allowed if allowed > 0.0 else 0.0
        if surprise > worst:
            worst, named = float(surprise), name
            text = f"{name} {own:.4g} ± {np.sqrt(variance):.2g} here, {mean:.4g} ± {np.sqrt(ratio * spread):.2g} there"
    return worst, named, text, late


def _marginal(found: LogEstimate, name: str) -> tuple[float, float]:
    """A parameter, or the delay of the inputs, and its variance."""
    if name == _DELAY:
        return found.input_delay, found.input_delay_error**2
    return found.parameters[name], found.standard_errors[name] ** 2


def _combined(values: Sequence[tuple[float, float]]) -> tuple[float, float, float]:
    """Precision-weighted mean of (value, variance) pairs, its variance, and the Birge ratio, at least 1."""
    p, v = np.array(values).T
    # Any estimate has an error by rounding.
    v = np.maximum(v, np.square(1e-12 * np.abs(p).max()) + np.finfo(float).tiny)
    least = v.min()
    weights = least / v
    mean = float(weights @ p / weights.sum())
    chi_squared = float(weights @ np.square(p - mean) / least) / max(1, len(p) - 1)
    return mean, float(least / weights.sum()), max(1.0, chi_squared)
