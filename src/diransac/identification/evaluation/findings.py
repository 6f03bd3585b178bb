"""Findings for and against a result, in sentences, and the verdict that follows from them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from diransac.identification.diagnosis import departures
from diransac.identification.estimate import TIME_LIMIT
from diransac.identification.evaluation.verdict import findings_of_predictions, level_of_disagreement
from diransac.identification.finding import FAR, NEAR, VALIDATE, Finding, Level, by_seriousness, graded
from diransac.identification.regression.uncertainty import CLEAR
from diransac.model.parameter import parameter_of
from diransac.text_table import duration, number, percent, plural

if TYPE_CHECKING:
    from diransac.identification.diagnosis import Diagnosis
    from diransac.identification.estimate import Disagreement, LogSummary, Prediction, Predictions
    from diransac.identification.result import Result
    from diransac.identification.structure.lacking_terms import Suggestion
    from diransac.model import Parameter

_LISTED = 3
"""Stretches that a sentence names; parameters that a term may change of which there is a finding."""
_OTHER_BANDWIDTH = "choose another bandwidth (--bandwidth), or identify with --method lo-diransac"


def findings_of(result: Result, predictions: Predictions | None = None, action: str = "") -> tuple[Finding, ...]:
    """Findings on a result, the most serious first.

    They depend on what the result contains alone: parameters and intervals, the predictions of its logs, its
    diagnosis. Those that need the logs or the fit itself are made with it, and stored: `Estimate.checks` and
    `Estimate.mistakes`. Where a mistake of a column explains what is bad, all findings have its action.

    Parameters
    ----------
    result : Result
    predictions : Predictions, optional
        Of other logs, in place of those of its own.
    action : str, optional
        What to do about predictions that are off; by default, what the identification says of the causes.
    """
    mistakes = result.estimate.mistakes
    found = by_seriousness(
        (
            *mistakes,
            *result.estimate.checks,
            *_logs(result),
            *_lacking(result, predicted := (*_predictions(result, predictions or result.predictions, action),)),
            *_bounds(result),
            *_diagnosis(result),
            *_bodies(result),
            *_known(result),
            *predicted,
            *_inliers(result),
            *_uncertainty(result),
            *_structure(result),
            *_bandwidth(result),
            *_search(result),
        )
    )
    cause = next((x for x in mistakes if x.level == "bad"), None)
    if cause is None:
        return found
    return tuple(Finding(x.level, x.claim, cause.action) if x.action else x for x in found)


def _lacking(result: Result, predicted: Sequence[Finding]) -> Iterator[Finding]:
    """Terms that the model seems to lack: each as serious as the predictions that it would mend."""
    bad = {x.action for x in predicted if x.level == "bad"}
    for one in result.suggestions:
        action = _added(one)
        yield Finding("bad" if action in bad else "care", f"The model seems to lack a term. {one.text}", action)


# ---------------------------------------------------------------------- bounds


def _bounds(result: Result) -> Iterator[Finding]:
    """Parameters outside of their bounds, and on one of them.

    A bound that a parameter may have is no contradiction where the logs are predicted well with it; then nothing
    changes if it is fixed there.  Where they are not, the bound hides what the model lacks.
    """
    parameters, predicted = result.model.parameters, result.predictions
    good = predicted is not None and max(predicted.judged.relative_error.values(), default=np.inf) <= NEAR
    for name in (*result.violations, *result.on_bounds):
        own, x = parameters[parameter_of(name, parameters)], result.estimate.parameters[name]
        claim = f"{name} = {number(x)} is on its bound, where the fit was stopped, so that its interval is unknown"
        if name in result.violations:
            bounds = f"outside its bounds ({bounds_text(own)}), which is physically impossible"
            yield Finding("bad", f"{name} = {number(x)} {own.unit} is {bounds}", _remedy(result, "bad"))
        elif not good:
            yield Finding("bad", claim, _remedy(result, "bad"))
        elif own.admits(x):
            kept = f"fix it, which changes no prediction: --fix {name.partition('[')[0]}={number(x)}"
            yield Finding("note", f"{claim}; predictions are good with it; {kept}.")
        else:
            yield Finding("care", claim, "widen the bound")
    bounded = any(bounds_text(x) for n, x in parameters.items() if n not in result.fixed)
    if bounded and not (result.violations or result.on_bounds):
        yield Finding("note", "Every parameter is within its bounds.")


def _bodies(result: Result) -> Iterator[Finding]:
    """Base parameters of a robot that are those of no possible bodies, beyond their uncertainty."""
    parameters = result.model.parameters
    if not any(x.combination for x in parameters.values()):
        return
    from diransac.model.robots.calibration import impossible_changes

    values = np.array([result.parameters[n] for n in parameters])
    changes = impossible_changes(parameters, values, result.covariance)
    name = max(changes, key=lambda n: abs(changes[n]), default="")
    # Of many base parameters, the largest of differences by chance is up to four standard errors.
    if name and abs(changes[name]) > 4.0:
        claim = (
            "No possible bodies (of positive mass, with inertias that satisfy the triangle inequality) have these base "
            f"parameters, the nearest of which differ by {number(abs(changes[name]), 2)} standard errors of {name}; an "
            "exported description has these"
        )
        yield Finding("care", claim, "add the term that the model lacks, or record a longer log")


def _known(result: Result) -> Iterator[Finding]:
    """Fixed parameters, priors, and priors that the logs contradict."""
    for name in result.fixed:
        value = f"{number(result.parameters[name])} {result.units[name]}".rstrip()
        yield Finding("note", f"{name} is fixed at {value}, not identified.")
    for name, x in result.estimate.parameters.items():
        mean, std = result.priors.get(parameter_of(name, result.model.parameters), (np.nan, np.nan))
        away = abs(x - mean) / std
        if away > CLEAR:
            logs = "These logs contradict" if len(result.logs) > 1 else "This log contradicts"
            far = f"{number(x)} lies {number(away, 2)} prior standard deviations from its mean {number(mean)}"
            claim = f"{logs} the prior of {name}, since the estimate {far}"
            yield Finding("care", claim, f"check the prior of {name}")
        elif np.isfinite(away):
            yield Finding("note", f"The estimate of {name} uses the prior {number(mean)} ± {number(std, 2)}.")


def bounds_text(parameter: Parameter) -> str:
    """Bounds as text: ``> 0``, ``≥ 0``, ``0 to 2``; empty without bounds."""
    positive = parameter.positive and parameter.lower <= 0.0
    lower = "> 0" if positive else "" if np.isinf(parameter.lower) else f"≥ {number(parameter.lower)}"
    upper = "" if np.isinf(parameter.upper) else f"≤ {number(parameter.upper)}"
    if lower and upper and not positive:
        return f"{number(parameter.lower)} to {number(parameter.upper)}"
    return ", ".join(filter(None, (lower, upper)))


# ---------------------------------------------------------------------- simulation and inliers


def _remedy(result: Result, level: Level = "care") -> str:
    """Action for an answer that is off throughout, by the causes that were tested."""
    if result.suggestions:
        return _added(result.suggestions[0])
    compare = "compare the terms and constants of the model with the machine"
    if result.estimate.n_columns_tested:
        tested = f"{result.estimate.n_columns_tested} other signs and units of columns explain the log no better"
        return f"{compare} ({tested})"
    checked = "check the signs and units of the log, which could not be tested, and the terms of the model"
    return checked if level == "bad" else compare


def _added(suggestion: Suggestion) -> str:
    """The action that adds a suggested term, or makes a constant a parameter."""
    if suggestion.option:
        return f"make the {suggestion.name} a parameter: identify again with {suggestion.option}"
    return f"add the {suggestion.name or suggestion.kind}: identify again with --with-suggestions"


def _predictions(result: Result, found: Predictions | None, action: str) -> Iterator[Finding]:
    """Findings on open-loop predictions of the logs."""
    if found is None:
        yield Finding("care", "No prediction is compared with the log", VALIDATE)
        return
    worst = max(found.judged.relative_error.values(), default=0.0)
    yield from findings_of_predictions(found, action or _remedy(result, graded(worst, NEAR, FAR)))
    if found is result.predictions:
        which = "the logs" if len(result.logs) > 1 else "the log"
        yield Finding("note", f"Evaluated on {which} of the identification; held-out data are a stricter test.")


def _predicted(logs: Sequence[LogSummary]) -> list[tuple[LogSummary, Prediction]]:
    return [(one, one.prediction) for one in logs if one.prediction is not None]


def _worst_of(one: LogSummary, logs: Sequence[LogSummary]) -> str:
    """The log's name as a suffix, if there are several."""
    return f" ({one.source}, the worst of {plural(len(logs), 'log')})" if len(logs) > 1 else ""


def _inliers(result: Result) -> Iterator[Finding]:
    """The inlier fraction of all logs, and the window with the fewest inliers."""
    logs, fraction, predicted = result.logs, result.inlier_fraction, _predicted(result.logs)
    if not np.isfinite(fraction):
        return
    n_rows = sum(found.n_rows for _, found in predicted) or sum(one.n_rows for one in logs)
    text = f"{percent(fraction)} of {plural(n_rows, 'row')} agree with"
    if result.separates_forces:
        yield Finding(
            "note",
            f"{text} an open-loop simulation of the whole log, in which effects of unmodelled forces and errors of its "
            "start add up, and grow where the machine is unstable.",
        )
        return
    if fraction < 0.5:
        claim = f"{text} the simulation, which is less than half of the log"
        yield Finding("care", claim, f"identify with --method lo-diransac, or {_remedy(result, 'bad')}")
        return
    yield Finding.of(
        "good" if fraction >= 0.7 else "care", f"{text} the simulation", "identify with --method lo-diransac"
    )
    for one, found in predicted:
        begin, end, lowest = found.weakest_window
        if lowest < 0.5 * fraction:
            between = f"Between {number(begin)} and {number(end)} s{f' of {one.source}' if len(logs) > 1 else ''}"
            claim = f"{between} only {percent(lowest)} of the rows agree with the simulation"
            yield Finding("care", claim, f"look at it, or leave it out: --leave-out={begin:.4g}:{end:.4g}")


# ---------------------------------------------------------------------- diagnosis and uncertainty


def _diagnosis(result: Result) -> Iterator[Finding]:
    """Outliers, unexplained accelerations, input delay and parameters that are not identifiable."""
    found = result.diagnosis
    if found is None:
        return
    name = max(found.outlier_fraction, key=lambda n: found.outlier_fraction[n])
    most = found.outlier_fraction[name]
    text = f"Up to {percent(most)} of the samples of a signal ({name}) are outliers"
    if most > 2.0 / 3.0:  # the estimate of lo-diransac is arbitrary
        yield Finding("bad", text, f"leave {name} out of the log, or {_remedy(result, 'bad')}")
    elif most > 0.5:
        yield Finding("care", f"{text}, which the estimate down-weights", f"look at {name}, or leave it out")
    elif most > 0.01:
        yield Finding("note", f"{text}; the estimate down-weights them.")
    yield from _departures(result.logs, found)
    yield from _unexplained(result)
    if found.input_delay_significant:
        late = (
            f"act {duration(abs(found.input_delay))} {'later' if found.input_delay > 0.0 else 'earlier'} than recorded"
        )
        what = "lag" if result.estimate.resolution.timing.lag else "delay"
        if what == "lag":
            late = f"act after a first-order lag of the actuators of {duration(abs(found.input_delay))} (time constant)"
        yield Finding("care", f"Inputs {late}, which the estimate includes", f"give other simulations this {what}, too")
    if len(result.unidentifiable) == len(result.parameters) - len(result.fixed):
        yield Finding("bad", f"No parameter is identifiable from {_these(result.logs)}", _remedy(result, "bad"))
    for sentence in found.unidentifiable_sentences():
        claim, _, action = sentence.rpartition("; ")
        yield Finding("care", claim or sentence, action)


def _departures(logs: Sequence[LogSummary], found: Diagnosis) -> Iterator[Finding]:
    """Stretches in which the model does not hold."""
    for i, one in enumerate(logs):
        stretches = departures(found, i, {} if one.prediction is None else one.prediction.unexplained)
        if stretches:
            listed = ", ".join(f"{number(x.start, 3)} to {number(x.stop, 3)} s" for x in stretches[:_LISTED])
            more = f" and {len(stretches) - _LISTED} more" if len(stretches) > _LISTED else ""
            claim = (
                f"The model does not hold from {listed}{more}{_worst_of(one, logs)}: forces that it lacks are up to "
                f"{number(max(x.ratio for x in stretches), 2)} times as large there as elsewhere, as on the ground, in "
                "the hand, at a stop or at a limit of the inputs"
            )
            option = ",".join(f"{x.start:.4g}:{x.stop:.4g}" for x in stretches)
            yield Finding("care", claim, f"leave it out, unless a term explains it: --leave-out={option}")


def _unexplained(result: Result) -> Iterator[Finding]:
    """The largest share of an acceleration that the model leaves unexplained."""
    having = [(one, found) for one, found in _predicted(result.logs) if found.unexplained]
    if not having:
        return
    one, found = max(having, key=lambda x: max(x[1].unexplained.values()))
    name = max(found.unexplained, key=lambda n: found.unexplained[n])
    left = found.unexplained[name]
    others = ", less of the others" if len(found.unexplained) > 1 else ""
    text = f"The model leaves {percent(left)} of {name} unexplained (RMS){others}{_worst_of(one, result.logs)}"
    # Forces that predictions do not show, as those of vibrations, need care at worst.
    shown = result.predictions is None or max(result.predictions.judged.relative_error.values(), default=np.inf) > FAR
    level = graded(left, 0.05, 0.5 if shown else np.inf)
    yield Finding.of(level, text, _remedy(result, level))


def _these(logs: Sequence[LogSummary]) -> str:
    return "these logs" if len(logs) > 1 else "this log"


def _uncertainty(result: Result) -> Iterator[Finding]:
    """Widths of the confidence intervals."""
    parameters = result.model.parameters
    intervals = {n: x for n, x in result.intervals().items() if n not in result.fixed}
    unknown = [name for name, (low, high) in intervals.items() if not np.isfinite(high - low)]
    stuck = {parameter_of(name, parameters) for name in result.on_bounds}
    lost = [name for name in unknown if name not in stuck]
    if lost and not result.separates_forces:
        rows = plural(result.n_fitted, "fitted row")
        claim = f"The uncertainty of {', '.join(lost)} is unknown: {rows} are too few, or do not excite it"
        yield Finding("care", claim, "give a longer log")
    # The mean of a per-log parameter is of no machine: the table of the logs has its values.
    varying = [n for n, x in parameters.items() if x.per_log and not result.layout.is_shared]
    known = {n: x for n, x in intervals.items() if n not in (*unknown, *varying)}
    zero = [n for n, (low, high) in known.items() if low <= 0.0 <= high]
    for possible in (True, False):
        names = [n for n in zero if parameters[n].admits(0.0) == possible]
        verb = "does" if len(names) == 1 else "do"
        claim = f"{', '.join(names)} {verb} not differ significantly from zero: 0 is in the 95 % interval"
        if names:
            yield Finding("note", f"{claim}.") if possible else Finding("care", claim, _more_of(result, names))
    widths = {n: 0.5 * (x[1] - x[0]) / abs(result.parameters[n]) for n, x in known.items() if n not in zero}
    ordered = sorted(widths, key=lambda n: -widths[n])
    wide = [n for n in ordered if widths[n] > 0.5]
    if wide:
        listed = ", ".join(f"{n} by ±{percent(widths[n])}" for n in wide)
        yield Finding("care", f"Uncertain by more than half (95 % interval): {listed}", _more_of(result, wide))
    elif widths:
        what = f"{ordered[0]} is" if len(widths) == 1 else f"The least certain parameter is {ordered[0]},"
        yield Finding("good", f"{what} uncertain by ±{percent(widths[ordered[0]])} (95 % interval).")


def _more_of(result: Result, names: Sequence[str]) -> str:
    """Action for uncertain parameters: a motion that moves their terms more, or a value from elsewhere."""
    one = parameter_of(names[0], result.model.parameters)
    if any(x.prediction and max(x.prediction.unexplained.values(), default=0.0) > 0.5 for x in result.logs):
        return _remedy(result)
    return f"record a log in which the term of {one} is larger, or fix it: --fix {one}=VALUE"


def _structure(result: Result) -> Iterator[Finding]:
    """The parameters that are most uncertain because the model may lack a term."""
    if not result.has_structure:
        return
    intervals, widths = result.structural_intervals(), dict[str, float]()
    for name, found in result.structure.items():
        half, value = 0.5 * (intervals[name][1] - intervals[name][0]), abs(result.parameters[name])
        if found.widening > 2.0 and half > 0.1 * value and name not in result.unidentifiable:
            widths[name] = half / value if value > 0.0 else np.inf
    for name in sorted(widths, key=lambda n: -widths[n])[:_LISTED]:
        found, (low, high) = result.structure[name], (number(x, 3) for x in intervals[name])
        yield Finding(
            "care",
            f"If the model lacks a term, {name} may be anywhere from {low} to {high}, an interval that is "
            f"{number(found.widening, 2)} times as wide, since {_these(result.logs)} cannot exclude {found.term}",
            f"record {found.motion}",
        )


def _bandwidth(result: Result) -> Iterator[Finding]:
    """Sensitivity of the parameters to the bandwidth of the differentiating filter."""
    changes = result.bandwidth_sensitivity
    if not changes:
        return
    if any(np.isnan(pair).any() for pair in changes.values()):
        yield Finding("care", "Identification failed at half or twice the filter's bandwidth", _OTHER_BANDWIDTH)
        return
    name = max(changes, key=lambda n: max(map(abs, changes[n])))
    change = max(map(abs, changes[name]))
    level = graded(change, 0.05, 0.2)
    text = f"At half or twice the filter's bandwidth no parameter changes by more than {percent(change)} ({name})"
    if level != "good":
        text = f"{name} changes by {percent(change)} at half or twice the filter's bandwidth"
    yield Finding.of(level, text, _OTHER_BANDWIDTH)


# ---------------------------------------------------------------------- search and logs


def noticed_disagreements(result: Result) -> list[tuple[Disagreement, Level]]:
    """Parts of the logs that give other parameters, with their levels, as far as a user would notice."""
    intervals = result.structural_intervals() if result.has_structure else result.intervals()
    found = []
    for one in result.estimate.disagreements:
        low, high = intervals.get(one.name, (0.0, np.inf))
        moved = abs(one.parameters[one.name] - result.parameters[one.name]) if one.name in intervals else 0.0
        if level := level_of_disagreement(one, moved, high - low):
            found.append((one, level))
    return found


def _search(result: Result) -> Iterator[Finding]:
    if result.stop_reason == TIME_LIMIT:
        yield Finding("care", "The time limit ended the search; parameters are the best so far", "give a longer limit")
        return
    wanted = result.settings.stop_inlier_fraction
    if wanted is None or result.separates_forces or not result.iterations:
        return
    if result.inlier_fraction < wanted:
        samples = plural(result.iterations, "sample")
        yield Finding("note", f"The search ended after {samples}, short of the {percent(wanted)} inliers to stop at.")


def _logs(result: Result) -> Iterator[Finding]:
    """Parts of the logs and logs that disagree with the others, and excluded rows."""
    for one, level in noticed_disagreements(result):
        effect = "" if np.isnan(one.effect) else f", which changes predictions by {percent(one.effect)} of the motion"
        yield Finding(level, f"{one.claim}{effect}", one.action)
    n_excluded = sum(found.n_excluded for _, found in _predicted(result.logs))
    if n_excluded:
        total = plural(sum(one.n_rows for one in result.logs), "row")
        yield Finding("note", f"{n_excluded:,} of {total} are excluded: a required signal is missing there.")
