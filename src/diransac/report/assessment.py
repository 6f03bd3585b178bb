"""Findings for and against a result, in sentences."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.model.parameter import Parameter
from diransac.report.rendering import number, percent, plural, share
from diransac.report.runs import Run

__all__ = ["Finding", "Level", "bounds_text", "findings", "verdict", "windows", "worst"]

Level = Literal["note", "good", "care", "bad"]
_ORDER: tuple[Level, ...] = ("note", "good", "care", "bad")

_NEAR, _FAR = 0.05, 0.25
_MANY, _HALF, _FEW = 0.7, 0.5, 0.01
_UNCERTAIN = 0.5
_STEADY, _UNSTEADY = 0.05, 0.2
_N_WINDOWS = 40


@dataclass(frozen=True)
class Finding:
    """One fact with its level: ``good`` supports the result, ``care`` and ``bad`` oppose it, a ``note`` is neutral."""

    level: Level
    text: str


def findings(runs: Sequence[Run]) -> list[Finding]:
    """Findings on one result, the most serious first.

    Parameters
    ----------
    runs : the result's simulations, one per log; of what differs between logs, the worst log is reported
    """
    run = runs[0]
    everything = [
        *_bounds(run),
        *_simulation(runs),
        *_inliers(runs),
        *_diagnosis(runs),
        *_uncertainty(run),
        *_bandwidth(run),
        *_search(run),
        *_logs(runs),
    ]
    return sorted(everything, key=lambda finding: _ORDER[::-1].index(finding.level))


def worst(found: Sequence[Finding]) -> Level:
    """The most serious level."""
    return max((finding.level for finding in found), key=_ORDER.index)


def verdict(level: Level) -> str:
    """The most serious level as a sentence."""
    return {
        "note": "Not assessed: this log gives no evidence for or against the model.",
        "good": "Usable: nothing in this log contradicts the model.",
        "care": "Usable with care.",
        "bad": "Do not rely on this model.",
    }[level]


def _graded(value: float, good: float, care: float) -> Level:
    """Level of a value of which less is better."""
    return "good" if value <= good else "care" if value <= care else "bad"


def _where(run: Run, runs: Sequence[Run]) -> str:
    """The log's name as a suffix, if there are several."""
    return f" ({run.log_name}, the worst of {plural(len(runs), 'log')})" if len(runs) > 1 else ""


# ---------------------------------------------------------------------- bounds


def _bounds(run: Run) -> Iterator[Finding]:
    result = run.result
    for name in result.violations:
        value, unit = number(result.parameters[name]), result.units[name]
        allowed = bounds_text(result.model.parameters[name])
        yield Finding("bad", f"{name} = {value} {unit} is outside its bounds ({allowed}): physically impossible.")
    for name in result.on_bounds:
        value = number(result.estimate.parameters[name])
        yield Finding("bad", f"{name} = {value} is on its bound, where the fit was stopped: its interval is unknown.")
    if not (result.violations or result.on_bounds) and any(bounds_text(x) for x in result.model.parameters.values()):
        yield Finding("good", "Every parameter is within its bounds.")


def bounds_text(parameter: Parameter) -> str:
    """Bounds as text: ``> 0``, ``≥ 0``, ``0 to 2``; empty without bounds."""
    if parameter.positive and parameter.lower <= 0.0:
        return "> 0" if np.isinf(parameter.upper) else f"> 0, ≤ {number(parameter.upper)}"
    if np.isinf(parameter.lower) and np.isinf(parameter.upper):
        return ""
    if np.isinf(parameter.upper):
        return f"≥ {number(parameter.lower)}"
    if np.isinf(parameter.lower):
        return f"≤ {number(parameter.upper)}"
    return f"{number(parameter.lower)} to {number(parameter.upper)}"


# ---------------------------------------------------------------------- simulation and inliers


def _simulation(runs: Sequence[Run]) -> Iterator[Finding]:
    """Simulation errors relative to the signals' ranges."""
    for run in runs:
        if run.divergence is not None:
            where = f" in {run.log_name}" if len(runs) > 1 else ""
            yield Finding("bad", f"The simulation diverges at t = {number(run.divergence)} s{where}.")
    scored = [run for run in runs if run.divergence is None and run.relative_errors]
    if not scored:
        return
    run = max(scored, key=lambda run: max(run.relative_errors.values()))
    errors = run.relative_errors
    name = max(errors, key=lambda n: errors[n])
    if np.isfinite(run.restart_period):
        method = f"simulations restarted from the smoothed state every {number(run.restart_period)} s"
        what = f"{share(errors[name], 'its range')} in excess of the noise"
    else:
        seconds = number((len(run.observations) - 1) * run.observations.log.dt)
        method = f"the simulation of all {seconds} s from the first state"
        what = share(errors[name], "its range")
    others = "the other scored signals are closer" if len(errors) > 1 else "no other signal is scored"
    text = f"Median error of {method}: {name} is off by {what}; {others}{_where(run, runs)}."
    if np.isfinite(run.restart_period) and not errors[name]:
        text = f"Median error of {method}: within the noise, in every signal."
    yield Finding(_graded(errors[name], _NEAR, _FAR), text)


def _inliers(runs: Sequence[Run]) -> Iterator[Finding]:
    """The inlier fraction over all logs, and intervals with few inliers."""
    n_rows = sum(run.observations.n_rows for run in runs)
    fraction = float(sum(run.inliers.sum() for run in runs) / n_rows)
    if runs[0].result.diagnosis is not None:
        text = "agree with an open-loop simulation of the whole log, in which unmodelled forces accumulate."
        yield Finding("note", f"{percent(fraction)} of {plural(n_rows, 'row')} {text}")
        return
    level: Level = "good" if fraction >= _MANY else "care" if fraction >= _HALF else "bad"
    yield Finding(level, f"{percent(fraction)} of {plural(n_rows, 'row')} agree with the simulation.")
    if level == "bad":
        return
    for run in runs:
        edges, fractions = windows(run)
        low = int(np.nanargmin(fractions))
        if fractions[low] < _HALF * fraction:
            log = run.observations.log
            start = float(log.time[run.observations.offset])
            begin, end = (number(start + log.dt * float(edges[low + i])) for i in (0, 1))
            where = f" of {run.log_name}" if len(runs) > 1 else ""
            text = f"Between {begin} and {end} s{where} only {percent(fractions[low])} of the rows agree: inspect it."
            yield Finding("care", text)


def windows(run: Run) -> tuple[IntArray, FloatArray]:
    """Edges ``(n + 1,)`` of windows over the observations, and the inlier fraction ``(n,)`` of the valid rows."""
    n = len(run.observations)
    edges = np.unique(np.linspace(0, n, min(_N_WINDOWS, max(1, n // 25)) + 1).astype(int))
    inliers = np.add.reduceat(run.inliers.astype(float), edges[:-1])
    counting = np.add.reduceat(run.observations.valid.astype(float), edges[:-1])
    return edges, np.where(counting > 0.0, inliers / np.maximum(counting, 1.0), np.nan)


# ---------------------------------------------------------------------- diagnosis and uncertainty


def _diagnosis(runs: Sequence[Run]) -> Iterator[Finding]:
    """Outliers, unmodelled accelerations, input delay and parameters that are not identifiable."""
    found = runs[0].result.diagnosis
    if found is None:
        return
    name = max(found.outlier_fraction, key=lambda n: found.outlier_fraction[n])
    most = found.outlier_fraction[name]
    if most > _FEW:
        text = (
            f"Up to {percent(most)} of the samples of a signal ({name}) are outliers; the estimate down-weights them."
        )
        yield Finding("note" if most <= _HALF else "care", text)
    having = [run for run in runs if run.unmodelled_fraction]
    if having:
        run = max(having, key=lambda run: max(run.unmodelled_fraction.values()))
        name = max(run.unmodelled_fraction, key=lambda n: run.unmodelled_fraction[n])
        left = run.unmodelled_fraction[name]
        others = ", less in the others" if len(run.unmodelled_fraction) > 1 else ""
        text = f"The RMS unmodelled acceleration is {percent(left)} of the modelled one in {name}{others}"
        yield Finding("good" if left <= _NEAR else "care", f"{text}{_where(run, runs)}.")
    for suggestion in runs[0].result.suggestions:
        yield Finding("care", f"The model seems to lack a term. {suggestion.text}.")
    if found.input_delay_significant:
        late = f"Inputs act {number(1e3 * found.input_delay, 3)} ms after their time stamps"
        yield Finding(
            "care", f"{late}: the estimate includes this delay; simulations of the model must include it, too."
        )
    if found.unidentifiable:
        names, several = ", ".join(found.unidentifiable), len(found.unidentifiable) > 1
        what = f"{names} {'are' if several else 'is'} not identifiable from {_these(runs)}"
        yield Finding("care", f"{what}; excite {'them' if several else 'it'}.")


def _these(runs: Sequence[Run]) -> str:
    return "these logs" if len(runs) > 1 else "this log"


def _uncertainty(run: Run) -> Iterator[Finding]:
    """Widths of the confidence intervals."""
    result, widths = run.result, {}
    intervals = result.intervals()
    unknown = [name for name, (low, high) in intervals.items() if not np.isfinite(high - low)]
    stuck = {name.partition("[")[0] for name in result.on_bounds}
    unexplained = [name for name in unknown if name not in stuck]
    if unexplained and result.diagnosis is None:
        rows = plural(result.n_fitted, "fitted row")
        text = f"The uncertainty of {', '.join(unexplained)} is unknown: {rows} are too few, or do not excite it."
        yield Finding("care", text)
    for name, (low, high) in intervals.items():
        # The mean of a per-log parameter is of no machine: the table of the logs has its values.
        if name in unknown or (result.model.parameters[name].per_log and not result.layout.is_shared):
            continue
        if low <= 0.0 <= high:
            possible = result.model.parameters[name].admits(0.0)
            text = f"{name} does not differ significantly from zero: its 95 % interval includes zero."
            yield Finding("note" if possible else "care", text)
        else:
            widths[name] = 0.5 * (high - low) / abs(result.parameters[name])
    for name, width in widths.items():
        if width > _UNCERTAIN:
            yield Finding("care", f"{name} is uncertain by ±{percent(width)} (95 % interval): excite it more.")
    if widths and max(widths.values()) <= _UNCERTAIN:
        name = max(widths, key=lambda n: widths[n])
        what = f"{name} is" if len(widths) == 1 else f"The least certain parameter is {name},"
        yield Finding("good", f"{what} uncertain by ±{percent(widths[name])} (95 % interval).")


def _bandwidth(run: Run) -> Iterator[Finding]:
    """Sensitivity of the parameters to the bandwidth of the differentiating filter."""
    changes = run.result.bandwidth_sensitivity
    if not changes:
        return
    if any(np.isnan(pair).any() for pair in changes.values()):
        yield Finding("care", "Identification failed at half or twice the filter's bandwidth.")
        return
    name = max(changes, key=lambda n: max(map(abs, changes[n])))
    change = max(map(abs, changes[name]))
    text = f"At half or twice the filter's bandwidth no parameter changes by more than {percent(change)} ({name})."
    if change > _STEADY:
        text = f"{name} changes by {percent(change)} at half or twice the filter's bandwidth: choose it with care."
    yield Finding(_graded(change, _STEADY, _UNSTEADY), text)


# ---------------------------------------------------------------------- search and logs


def _search(run: Run) -> Iterator[Finding]:
    result, wanted = run.result, run.result.settings.stop_inlier_fraction
    if result.iterations and result.diagnosis is None and wanted is not None and result.inlier_fraction < wanted:
        samples = plural(result.iterations, "sample")
        yield Finding(
            "note", f"The search ended after {samples}, below the inlier fraction of {percent(wanted)} to stop at."
        )


def _logs(runs: Sequence[Run]) -> Iterator[Finding]:
    """Logs that disagree with the others, excluded rows, and the relation of the logs to the identification."""
    for run in runs:
        if run.view.remark:
            yield Finding("bad", f"{run.view.remark}. One set of parameters does not describe all logs.")
    missing = sum(run.n_excluded for run in runs)
    if missing:
        total = plural(sum(len(run.observations) + run.observations.offset for run in runs), "row")
        yield Finding("note", f"{missing:,} of {total} are excluded: a required signal is missing there.")
    held_out = [run.log_name for run in runs if run.held_out]
    if len(held_out) == len(runs):
        yield Finding("note", f"Evaluated on {_these(runs)}, not used for identification: a held-out validation.")
    elif held_out:
        yield Finding("note", f"Not used for identification (held-out validation): {', '.join(held_out)}.")
    else:
        text = f"Evaluated on {_these(runs)}, used for identification; held-out data are a stricter test."
        yield Finding("note", text)
