"""What speaks for a result and what against it, in sentences."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.model.parameter import Parameter
from diransac.report.markup import number, percent, plural, share
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
    """One thing to know: ``good`` speaks for the model, ``care`` and ``bad`` against it, a ``note`` for neither."""

    level: Level
    text: str


def findings(run: Run) -> list[Finding]:
    """Everything to know about a result before it is used, the most serious first."""
    everything = [
        *_bounds(run),
        *_simulation(run),
        *_inliers(run),
        *_diagnosis(run),
        *_certainty(run),
        *_bandwidth(run),
        *_search(run),
        *_rows(run),
    ]
    return sorted(everything, key=lambda finding: _ORDER[::-1].index(finding.level))


def worst(found: list[Finding]) -> Level:
    """The most serious level."""
    return max((finding.level for finding in found), key=_ORDER.index)


def verdict(level: Level) -> str:
    """The level as a sentence for whoever wants to use the model."""
    return {
        "note": "There is nothing to judge this model by.",
        "good": "Nothing in this log speaks against this model.",
        "care": "Usable with care.",
        "bad": "Do not rely on this model.",
    }[level]


def _graded(value: float, good: float, care: float) -> Level:
    """Level of a value that had better be small."""
    return "good" if value <= good else "care" if value <= care else "bad"


def _bounds(run: Run) -> Iterator[Finding]:
    result = run.result
    for name in result.violations:
        value, unit = number(result.parameters[name]), result.units[name]
        allowed = bounds_text(result.model.parameters[name])
        yield Finding("bad", f"{name} = {value} {unit} is outside its bounds ({allowed}): no such machine exists.")
    if not result.violations and any(bounds_text(x) for x in result.model.parameters.values()):
        yield Finding("good", "Every parameter is within its bounds.")


def bounds_text(parameter: Parameter) -> str:
    """``> 0``, ``≥ 0``, ``0 to 2``; empty where there are none."""
    if parameter.positive and parameter.lower <= 0.0:
        return "> 0" if np.isinf(parameter.upper) else f"> 0, ≤ {number(parameter.upper)}"
    if np.isinf(parameter.lower) and np.isinf(parameter.upper):
        return ""
    if np.isinf(parameter.upper):
        return f"≥ {number(parameter.lower)}"
    if np.isinf(parameter.lower):
        return f"≤ {number(parameter.upper)}"
    return f"{number(parameter.lower)} to {number(parameter.upper)}"


def _simulation(run: Run) -> Iterator[Finding]:
    """Whether the simulation stays near what was measured."""
    if run.divergence is not None:
        yield Finding("bad", f"The simulation diverges at t = {number(run.divergence)} s.")
        return
    errors = run.relative_errors
    if not errors:
        return
    name = max(errors, key=lambda n: errors[n])
    seconds = number((len(run.observations) - 1) * run.observations.log.dt)
    others = "the other signals that judge are nearer" if len(errors) > 1 else "it is the signal that judges"
    how, beyond = f"Simulated through all {seconds} s from its first state alone", ""
    if np.isfinite(run.period):
        how, beyond = f"Simulated for {number(run.period)} s at a time from where the machine was", " beyond its noise"
    text = f"{how}, {name} is typically off by {share(errors[name], 'its range')}{beyond}; {others}."
    if np.isfinite(run.period) and not errors[name]:
        text = f"{how}, no signal is typically off by more than its noise."
    yield Finding(_graded(errors[name], _NEAR, _FAR), text)


def _inliers(run: Run) -> Iterator[Finding]:
    fraction, n_rows = run.inlier_fraction, run.observations.n_rows
    if run.result.diagnosis is not None:
        yield Finding(
            "note",
            f"{percent(fraction)} of {plural(n_rows, 'row')} agree with one simulation of the whole log, which drifts "
            "where anything acts that the model lacks, and counts outliers.",
        )
        return
    level: Level = "good" if fraction >= _MANY else "care" if fraction >= _HALF else "bad"
    yield Finding(level, f"{percent(fraction)} of {plural(n_rows, 'row')} agree with the simulation.")
    edges, fractions = windows(run)
    if level == "bad":
        return
    low = int(np.nanargmin(fractions))
    if fractions[low] < _HALF * fraction:
        log = run.observations.log
        start = float(log.time[run.observations.offset])
        begin, end = (number(start + log.dt * float(edges[low + i])) for i in (0, 1))
        yield Finding(
            "care",
            f"Between {begin} and {end} s only {percent(fractions[low])} agree: look there, and at what differs.",
        )


def windows(run: Run) -> tuple[IntArray, FloatArray]:
    """Edges ``(n + 1,)`` of windows over the observations, and the inlier fraction ``(n,)`` of the rows that count."""
    n = len(run.observations)
    edges = np.unique(np.linspace(0, n, min(_N_WINDOWS, max(1, n // 25)) + 1).astype(int))
    inliers = np.add.reduceat(run.inliers.astype(float), edges[:-1])
    counting = np.add.reduceat(run.observations.valid.astype(float), edges[:-1])
    return edges, np.where(counting > 0.0, inliers / np.maximum(counting, 1.0), np.nan)


def _diagnosis(run: Run) -> Iterator[Finding]:
    """What was found wrong with the log and the model."""
    found = run.result.diagnosis
    if found is None:
        return
    name = max(found.outlier_fraction, key=lambda n: found.outlier_fraction[n])
    most = found.outlier_fraction[name]
    if most > _FEW:
        text = f"Up to {percent(most)} of a signal's samples are outliers ({name}): the parameters do not rest on them."
        yield Finding("note" if most <= _HALF else "care", text)
    if run.unexplained:
        name = max(run.unexplained, key=lambda n: run.unexplained[n])
        left = run.unexplained[name]
        text = f"The model leaves out what is worth {percent(left)} of {name}, and less of other accelerations."
        yield Finding("good" if left <= _NEAR else "care", text)
    if found.input_delay_significant:
        late = f"Inputs act {number(1e3 * found.input_delay, 3)} ms later than the log says"
        yield Finding("care", f"{late}: the parameters allow for that, simulations of the model need it, too.")
    if found.unidentifiable:
        names = ", ".join(found.unidentifiable)
        yield Finding("care", f"The log cannot tell {names}: record a motion that depends on it.")


def _certainty(run: Run) -> Iterator[Finding]:
    """What the intervals say."""
    result, widths = run.result, {}
    intervals = result.intervals()
    vague = [name for name, (low, high) in intervals.items() if not np.isfinite(high - low)]
    if vague and result.diagnosis is None:
        rows = plural(result.n_fitted, "row")
        yield Finding("care", f"How certain {', '.join(vague)} is cannot be told: the fit rests on {rows}.")
    for name, (low, high) in intervals.items():
        if name in vague:
            continue
        if low <= 0.0 <= high:
            possible = result.model.parameters[name].admits(0.0)
            yield Finding("note" if possible else "care", f"{name} cannot be told from zero.")
        else:
            widths[name] = 0.5 * (high - low) / abs(result.parameters[name])
    for name, width in widths.items():
        if width > _UNCERTAIN:
            yield Finding("care", f"{name} is known to {percent(width)} only: the motion hardly shows it.")
    if widths and max(widths.values()) <= _UNCERTAIN:
        name = max(widths, key=lambda n: widths[n])
        what = f"{name} is known to" if len(widths) == 1 else f"The least certain parameter, {name}, is known to"
        yield Finding("good", f"{what} {percent(widths[name])} (half its 95 % interval).")


def _bandwidth(run: Run) -> Iterator[Finding]:
    """Whether the filter that derived the rates decided the answer."""
    changes = run.result.bandwidth_sensitivity
    if not changes:
        return
    if any(np.isnan(pair).any() for pair in changes.values()):
        yield Finding("care", "At half or twice the filter's bandwidth nothing was identified.")
        return
    name = max(changes, key=lambda n: max(map(abs, changes[n])))
    change = max(map(abs, changes[name]))
    text = f"At half or twice the filter's bandwidth no parameter changes by more than {percent(change)} ({name})."
    if change > _STEADY:
        text = f"{name} changes by {percent(change)} at half or twice the filter's bandwidth: compare, then choose it."
    yield Finding(_graded(change, _STEADY, _UNSTEADY), text)


def _search(run: Run) -> Iterator[Finding]:
    result, asked = run.result, run.result.settings.stop_inlier_fraction
    if result.iterations and result.diagnosis is None and asked is not None and result.inlier_fraction < asked:
        samples = plural(result.iterations, "sample")
        yield Finding(
            "note", f"The search ended after {samples}, short of the {percent(asked)} inliers it was to reach."
        )


def _rows(run: Run) -> Iterator[Finding]:
    observations = run.observations
    missing = len(observations) - observations.n_rows + observations.offset
    if missing:
        total = plural(len(observations) + observations.offset, "row")
        yield Finding("note", f"{missing:,} of {total} do not count: a signal in use is missing there.")
    if run.held_out:
        yield Finding("note", "This log is not the one that the result was made from: a held-out validation.")
    else:
        yield Finding("note", "Judged on the log it was made from; a log it has not seen judges harder.")
