"""Tables and texts of the page: summary, logs, parameters, diagnosis, scores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diransac.data.log import Log
from diransac.identification.diagnosis import Diagnosis
from diransac.identification.evaluation.findings import bounds_text
from diransac.identification.finding import Finding, Level, Verdict, next_line, shown, verdict_of
from diransac.report.figures import Scale, Tick, padded, ticks
from diransac.report.rendering import Table
from diransac.report.runs import Entry, Run
from diransac.text_table import number, percent, plural, telling_digits

# ---------------------------------------------------------------------- summary


def lead(entries: Sequence[Entry], logs: Sequence[Log]) -> str:
    """First sentence of the page: methods, logs and their size."""
    labels = [entry.label for entry in entries]
    methods = f"by {labels[0]}" if len(labels) == 1 else f"in {len(labels)} ways ({', '.join(labels)})"
    text = f"Identified {methods} from {_sources(entries)}"
    runs = [run for entry in entries for run in entry.runs]
    held_out = dict.fromkeys(_name(run) for run in runs if run.held_out)
    if held_out and all(run.held_out for run in runs):
        text = f"Held-out validation. {text}; evaluated on {', '.join(held_out)}, not used for identification"
    elif held_out:
        text = f"{text}; held-out validation on {', '.join(held_out)}"
    return f"{text} ({_size(logs)})."


def _sources(entries: Sequence[Entry]) -> str:
    """Names of the logs of every result, with their times where a log of the page has the same name."""
    held_out = {run.log_name for entry in entries for run in entry.runs if run.held_out}
    groups = dict.fromkeys(
        tuple(
            _with_time(x.source, x.start, x.start + (x.n_rows - 1) * x.dt) if x.source in held_out else x.source
            for x in entry.result.logs
        )
        for entry in entries
    )
    return " and ".join(
        sources[0] if len(sources) == 1 else f"{len(sources)} logs ({', '.join(sources)})" for sources in groups
    )


def _size(logs: Sequence[Log]) -> str:
    rows = plural(sum(len(log) for log in logs), "row")
    seconds = number(sum(log.dt * (len(log) - 1) for log in logs))
    return f"{seconds} s at {number(1.0 / logs[0].dt)} Hz, {rows}" if len(logs) == 1 else f"{seconds} s in all, {rows}"


@dataclass(frozen=True)
class Card:
    """The verdict on one result, the findings behind it, by the log that they are about, and what to do next."""

    label: str
    level: Level
    verdict: Verdict
    groups: tuple[tuple[str, tuple[Finding, ...]], ...]
    n_more: int
    next: str


def card(entry: Entry) -> Card:
    """The verdict on one result: its own findings, or those of `validate` with the held-out logs of the page."""
    held_out, own = [run for run in entry.runs if run.held_out], entry.result.findings
    found = [run.validation.findings for run in held_out]
    groups = [
        (f"Held out, {_name(x)}", tuple(y for y in on if y not in own)) for x, on in zip(held_out, found, strict=True)
    ]
    kept = tuple(x for x in own if all(x in on for on in found))
    groups.append((f"Identification from {_sources([entry])}" if held_out else "", kept))
    every = [finding for _, some in groups for finding in some]
    verdict, (few, n_more) = verdict_of(every), shown(every, good=True)
    listed = [(name, tuple(x for x in few if x in some)) for name, some in groups]
    levels: dict[Verdict, Level] = {"usable": "good", "usable with care": "care", "do not rely on this": "bad"}
    chosen = tuple((name, some) for name, some in listed if some)
    return Card(entry.label, levels[verdict], verdict, chosen, n_more, next_line(every))


def _name(run: Run) -> str:
    """Name of a log, with its time where the result was identified from a log of the same name."""
    time = run.observations.log.time
    same = run.log_name in (one.source for one in run.result.logs)
    return _with_time(run.log_name, float(time[0]), float(time[-1])) if run.held_out and same else run.log_name


def _with_time(name: str, begin: float, end: float) -> str:
    return f"{name} from {number(begin)} to {number(end)} s"


def differences(entries: Sequence[Entry]) -> str:
    """The parameter in which several results differ most; empty for one result."""
    spread = {}
    for name in entries[0].result.parameters:
        values = {entry.label: entry.result.parameters[name] for entry in entries if entry.identifies(name)}
        if not values:
            continue
        low, high = min(values, key=lambda k: values[k]), max(values, key=lambda k: values[k])
        middle = abs(float(np.median(list(values.values()))))
        if middle > 0.0:
            spread[name] = ((values[high] - values[low]) / middle, values[low], low, values[high], high)
    if len(entries) == 1 or not spread:
        return ""
    name = max(spread, key=lambda n: spread[n][0])
    difference, low_value, low, high_value, high = spread[name]
    if difference < 1e-3:
        return "The results agree to 0.1 % in every parameter."
    unit = entries[0].result.units[name]
    return f"Largest difference: {name}, {number(low_value)} {unit} ({low}) to {number(high_value)} {unit} ({high})."


# ---------------------------------------------------------------------- logs


def log_tables(entries: Sequence[Entry], logs: Sequence[Log]) -> list[Table]:
    """Every log with its inliers, fit error and own parameters, a table per result; none for a single log."""
    return [] if len(logs) == 1 else [_log_table(entry, logs, len(entries) > 1) for entry in entries]


def _log_table(entry: Entry, logs: Sequence[Log], several: bool) -> Table:
    own = list(dict.fromkeys(n for run in entry.runs if not run.held_out for n in run.result.per_log))
    remarks = ["held out" if run.view.summary is None else run.view.summary.remark for run in entry.runs]
    header = ["Log", "Duration, s", "Rate, Hz", "Rows", "Inliers", "Fit error"]
    header += [f"{name}, {entry.result.units[name]}" for name in own]
    rows = []
    for log, run in zip(logs, entry.runs, strict=True):
        duration, rate = number(log.dt * (len(log) - 1)), number(1.0 / log.dt)
        fit_error = np.nan if run.view.summary is None else run.view.summary.fit_error
        measures = (percent(run.inlier_fraction), number(fit_error))
        values = ("–" if run.held_out else number(run.view.parameters[name], 6) for name in own)
        rows.append((run.log_name, duration, rate, f"{len(log):,}", *measures, *values))
    if any(remarks):
        header.append("Remark")
        rows = [(*row, remark) for row, remark in zip(rows, remarks, strict=True)]
    caption = "Inliers: fraction of the valid rows that agree with the simulation."
    return Table(header, rows, f"By {entry.label}. {caption}" if several else caption)


# ---------------------------------------------------------------------- parameters


@dataclass(frozen=True)
class Whisker:
    """An estimate and its interval drawn on a scale; positions are CSS percentages."""

    look: str
    forbidden: tuple[tuple[str, str], ...]
    left: str
    right: str
    at: str


@dataclass(frozen=True)
class Estimate:
    """A parameter as one result has it, as text; ``whisker`` is None where it is not identifiable."""

    label: str
    look: str
    value: str = ""
    interval: str = ""
    structural: str = ""
    width: str = ""
    is_outside: bool = False
    whisker: Whisker | None = None


@dataclass(frozen=True)
class ParameterGroup:
    """A parameter by every result."""

    name: str
    about: str
    estimates: tuple[Estimate, ...]
    ticks: tuple[Tick, ...]


def parameters(entries: Sequence[Entry]) -> list[ParameterGroup]:
    """Every parameter by every result that has it."""
    names = dict.fromkeys(name for entry in entries for name in entry.result.parameters)
    return [_group(name, [x for x in enumerate(entries) if name in x[1].result.parameters]) for name in names]


def _group(name: str, having: Sequence[tuple[int, Entry]]) -> ParameterGroup:
    parameter = having[0][1].result.model.parameters[name]
    scale = _parameter_scale(name, [entry for _, entry in having])
    shown = _parameter_ticks(scale) if any(entry.identifies(name) for _, entry in having) else []
    return ParameterGroup(
        name=name,
        about=", ".join(text for text in (parameter.unit, bounds_text(parameter)) if text),
        estimates=tuple(_estimate(name, entry, f"m{i}", scale) for i, entry in having),
        ticks=tuple((_at(x, scale), text) for x, text in shown),
    )


def _parameter_ticks(scale: Scale) -> list[tuple[float, str]]:
    """Ticks; long ones are fewer, with a margin to the edges."""
    found = ticks(scale.low, scale.high, 4)
    if max(len(text) for _, text in found) <= 6:
        return found
    margin = 0.1 * (scale.high - scale.low)
    return [x for x in ticks(scale.low, scale.high, 2) if scale.low + margin < x[0] < scale.high - margin]


def _parameter_scale(name: str, entries: Sequence[Entry]) -> Scale:
    """All estimates, and the intervals up to a multiple of the narrowest."""
    entries = [entry for entry in entries if entry.identifies(name)]
    if not entries:
        return Scale(-1.0, 1.0)
    intervals = np.array([entry.result.intervals()[name] for entry in entries])
    estimates = np.array([entry.result.parameters[name] for entry in entries])
    widths = intervals[:, 1] - intervals[:, 0]
    sharpest = int(np.argmin(np.where(widths > 0.0, widths, np.inf)))  # a fixed value has no interval
    core = np.append(estimates, intervals[sharpest][np.isfinite(intervals[sharpest])])
    low, high = float(core.min()), float(core.max())
    reach = 2.0 * (high - low)
    edges = np.clip(intervals[np.isfinite(intervals)], low - reach, high + reach)
    if high - low <= 1e-9 * abs(high):
        low, high = low - 1e-3 * abs(low), high + 1e-3 * abs(high)
    return padded(float(edges.min(initial=low)), float(edges.max(initial=high)))


def _estimate(name: str, entry: Entry, look: str, scale: Scale) -> Estimate:
    result = entry.result
    if not entry.identifies(name):
        return Estimate(entry.label, look)
    value, (low, high) = result.parameters[name], result.intervals()[name]
    if name in result.fixed:
        at = _whisker(name, entry, look, scale)
        return Estimate(entry.label, look, number(value, 6), "fixed", "fixed", "–", whisker=at)
    known = np.isfinite(high - low)
    width = "includes 0" if low <= 0.0 <= high else percent(0.5 * (high - low) / abs(value))
    return Estimate(
        label=entry.label,
        look=look,
        value=number(value, 6),
        interval=interval_text(low, high),
        structural=interval_text(*result.structural_intervals()[name]) if result.has_structure else "not tested",
        width=width if known else "–",
        is_outside=name in result.violations,
        whisker=_whisker(name, entry, look, scale),
    )


def interval_text(low: float, high: float) -> str:
    """Ends of an interval, with the digits that tell them apart."""
    digits = telling_digits(low, high)
    return f"{number(low, digits)} … {number(high, digits)}" if np.isfinite(high - low) else "unknown"


def _whisker(name: str, entry: Entry, look: str, scale: Scale) -> Whisker:
    bounds, (low, high) = entry.result.model.parameters[name], entry.result.intervals()[name]
    low, high = (low, high) if np.isfinite(high - low) else (-np.inf, np.inf)
    lower = max(bounds.lower, 0.0) if bounds.positive else bounds.lower
    forbidden = [("0%", _at(lower, scale))] if lower > scale.low else []
    if bounds.upper < scale.high:
        forbidden.append((_at(bounds.upper, scale), "100%"))
    cut = " cut-low" * bool(low < scale.low) + " cut-high" * bool(high > scale.high)
    at = _at(entry.result.parameters[name], scale)
    return Whisker(f"{look}{cut}", tuple(forbidden), _at(low, scale), _at(high, scale), at)


def _at(value: float, scale: Scale) -> str:
    """Position on a scale, clipped to its ends, for CSS."""
    return f"{np.clip(100.0 * (value - scale.low) / (scale.high - scale.low), 0.0, 100.0):.2f}%"


# ---------------------------------------------------------------------- diagnosis and scores


def diagnosis(entries: Sequence[Entry]) -> list[tuple[Table, str]]:
    """Noise, outliers and unmodelled acceleration of each signal, and the input delay, by each result that has them."""
    having = [(entry, entry.result.diagnosis) for entry in entries if entry.result.diagnosis is not None]
    return [(_signal_table(entry, found, len(entries) > 1), _delay(entry, found)) for entry, found in having]


def suggestions(entries: Sequence[Entry]) -> list[Table]:
    """Terms that each result suggests, with the change of the model."""
    header = ("Suggested term", "Coefficient", "Unit", "Explained", "Change of the model")
    tables = []
    for entry in entries:
        rows = []
        for x in entry.result.suggestions:
            coefficient = f"{number(x.value)} ± {number(x.standard_error, 2)}"
            rows.append((x.name or f"{x.kind}, {x.equation}", coefficient, x.unit, percent(x.explained), x.change))
        if rows:
            tables.append(Table(header, rows, f"Terms that would explain the unmodelled forces{_by(entry, entries)}"))
    return tables


def competitions(entries: Sequence[Entry]) -> list[Table]:
    """Comparison of estimates by held-out prediction of each result that has one."""
    caption = (
        "Estimates compared by open-loop prediction of parts of the logs that they were not estimated from: error over "
        "that of a trivial prediction: that nothing changes, or the median"
    )
    having = [(entry, entry.result.competition.lines()) for entry in entries if entry.result.competition is not None]
    return [Table(lines[0], lines[1:], f"{caption}{_by(entry, entries)}") for entry, lines in having]


def _by(entry: Entry, entries: Sequence[Entry]) -> str:
    """End of a caption that names a result, where there are several."""
    return f", by {entry.label}" if len(entries) > 1 else ""


def _signal_table(entry: Entry, found: Diagnosis, several: bool) -> Table:
    rows, units = [], entry.result.model.units
    for name in dict.fromkeys((*found.noise_std, *found.unmodelled_accelerations)):
        measured = name in found.noise_std
        noise = number(found.noise_std[name], 2) if measured else "not measured"
        outliers = percent(found.outlier_fraction[name]) if measured else "–"
        values = found.unmodelled_accelerations.get(name)
        unmodelled = "" if values is None else number(float(np.sqrt(np.mean(np.square(values)))), 2)
        rows.append((name, units[name], noise, outliers, unmodelled))
    rows += [(name, units[name], number(std, 2), "–", "") for name, std in found.input_noise.items()]
    caption = f"By {entry.label}" if several else "By signal"
    if any(run.held_out for run in entry.runs):
        caption = f"{caption}, in the identification ({', '.join(s.source for s in entry.result.logs)})"
    return Table(("Signal", "Unit", "Noise", "Outliers", "Unmodelled"), rows, caption)


def _delay(entry: Entry, found: Diagnosis) -> str:
    if not found.input_delay_significant:
        return ""
    delay, error = number(1e3 * found.input_delay, 3), number(1e3 * found.input_delay_error, 2)
    lag = entry.result.estimate.resolution.timing.lag
    what = "First-order lag of the inputs, time constant" if lag else "Input delay"
    return f"{what}: {delay} ± {error} ms (standard error). The estimate and the simulations shown include it."


def scores(run: Run) -> Table:
    """Open-loop scores of one run at every horizon, as `validate` prints them."""
    header, *rows = run.validation.table()
    return Table(header, rows, f"{run.label}; judged by {run.validation.judged.name}")
