"""What is shown over time: measured against simulated, residuals, inliers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from diransac.arrays import FloatArray
from diransac.report.figures import Scale, Timeline, Trace, padded, strip, time_axis, time_plot
from diransac.report.judgement import windows
from diransac.report.markup import Html, number, plural, share, tag
from diransac.report.runs import Run, bulk

__all__ = ["inliers_over_time", "signals_over_time"]


_BEYOND_MEASURED = 0.4
_BEYOND_REFERENCE = 2.0
_VISIBLE = 0.01
_MOST = 0.5
_NOISE = 3.0
_HOW_TO_ZOOM = (
    "Drag across a figure to zoom into all of them, drag a box to zoom into one, double-click to see everything again; "
    "keys ←, →, +, −, 0."
)


def signals_over_time(runs: Sequence[Run], timeline: Timeline) -> Html:
    """Every measured signal against every simulation, and the residuals below it."""
    marking = max(runs, key=lambda run: run.inlier_fraction)
    names = dict.fromkeys(name for run in runs for name in run.observations.signals)
    figures = [_signal(name, runs, marking, timeline) for name in names]
    return tag(
        "section",
        tag("h2", "Measured against simulated"),
        tag("p", f"{_how_simulated(runs)} {_HOW_TO_ZOOM}", class_="how"),
        _legend(runs, marking),
        tag("div", *figures, class_="figures"),
        id="signals",
    )


def _how_simulated(runs: Sequence[Run]) -> str:
    """Where the simulations that are drawn begin."""
    periods = [run.period for run in runs if np.isfinite(run.period)]
    if not periods:
        return "Each simulation starts at the first row and sees the inputs alone."
    text = (
        f"Each simulation sees the inputs alone, and begins anew every {number(periods[0])} s where the machine most "
        "probably was: forces that the model lacks would otherwise add up over the log."
    )
    if len(runs) > 1:
        return text
    return f"{text} The faint line is one simulation of the whole log, which decides on the rows that agree."


def _legend(runs: Sequence[Run], marking: Run) -> Html:
    of = f" with {marking.label}" if len(runs) > 1 else ""
    marks = [_key("outlier", f"in a row that does not agree{of} (outlier)")]
    if marking.diagnosis is not None:
        whole = f" of {marking.label}" if len(runs) > 1 else ""
        marks = [
            _key("fault", "outlier: a sensor's fault"),
            _key("outlier", f"in a row that does not agree with the whole log's simulation{whole}"),
        ]
    keys = [
        _key("measured", "measured"),
        *marks,
        *(_key(f"m{i}", f"simulated, {run.label}") for i, run in enumerate(runs)),
    ]
    if _shows_both(runs):
        keys.append(_key("long", "through the whole log"))
    reset = tag("button", "Show all of the log", type="button", id="reset", hidden=True)
    return tag("div", *keys, reset, class_="legend")


def _key(look: str, text: str) -> Html:
    box = tag("input", type="checkbox", checked=True, data_shows=look, hidden=True)
    return tag("label", box, tag("span", class_=f"swatch {look}"), text)


def _signal(name: str, runs: Sequence[Run], marking: Run, timeline: Timeline) -> Html:
    """The figure of one signal."""
    having = [(i, run) for i, run in enumerate(runs) if name in run.observations.signals]
    shown = marking if name in marking.observations.signals else having[0][1]
    unit = shown.observations.model.units[name]
    measured = shown.observations.column(name)
    scale = _signal_scale(name, shown, [run for _, run in having])
    beyond = _beyond(measured, scale)
    traces = _signal_traces(name, having, shown)
    if _shows_both(runs):
        whole = _column(shown.throughout, shown, name)
        traces.append(Trace("through the whole log", "m0 long", "line", shown.rows, whole))
    about = f"{name} in {unit}, measured and simulated over {number(timeline.dt * (timeline.n_rows - 1))} s"
    facts = [_typical_error(name, run, unit, label=f"{run.label} " * (len(runs) > 1)) for _, run in having]
    caption = [
        tag("h3", name, " ", tag("span", unit, class_="unit")),
        tag("p", f"typical error{':' * (len(runs) > 1)} {'; '.join(facts)}"),
    ]
    if beyond is not None:
        low, high, n_beyond = beyond
        where = f"{plural(n_beyond, 'sample')} beyond, from {number(low)} to {number(high)} "
        caption.append(
            tag("p", where, tag("button", "Show", type="button", class_="full", hidden=True), class_="beyond")
        )
    return tag(
        "figure",
        tag("figcaption", *caption),
        time_plot(traces, scale, timeline, about, full=beyond and beyond[:2]),
        _residuals(name, having, shown, timeline),
        time_axis(timeline),
    )


def _typical_error(name: str, run: Run, unit: str, label: str) -> str:
    error, (low, high) = run.typical_errors[name], run.ranges[name]
    part = f" ({share(error / (high - low), 'its range')})" if high > low and np.isfinite(error) else ""
    return f"{label}{number(error, 3)} {unit}{part}"


def _signal_traces(name: str, having: Sequence[tuple[int, Run]], shown: Run) -> list[Trace]:
    measured, faulty = shown.observations.column(name), shown.faults[name]
    outlying = shown.observations.valid & ~shown.inliers & ~faulty
    rejected = "measured (row does not agree)" if shown.diagnosis is not None else "measured (outlier)"
    return [
        _dots("measured", "measured", shown, measured, ~outlying & ~faulty),
        _dots(rejected, "outlier", shown, measured, outlying),
        _dots("measured (outlier)", "fault", shown, measured, faulty),
        *(Trace(run.label, f"m{i}", "line", run.rows, _column(run.simulated, run, name)) for i, run in having),
    ]


def _shows_both(runs: Sequence[Run]) -> bool:
    """Whether the simulation of the whole log is drawn besides: of several results that would be too many lines."""
    return len(runs) == 1 and np.isfinite(runs[0].period)


def _dots(name: str, look: str, run: Run, values: FloatArray, chosen: npt.NDArray[np.bool_]) -> Trace:
    return Trace(name, look, "dots", run.rows[chosen], values[chosen])


def _column(values: FloatArray, run: Run, name: str) -> FloatArray:
    return values[:, run.observations.signals.index(name)]


def _signal_scale(name: str, shown: Run, runs: Sequence[Run]) -> Scale:
    """The measured range, and of the simulations what does not dwarf it."""
    low, high = shown.ranges[name]
    reach = _BEYOND_MEASURED * (high - low)
    for run in runs:
        simulated = _column(run.simulated, run, name)
        near = np.clip(simulated[np.isfinite(simulated)], low - reach, high + reach)
        if reach > 0.0 and len(near):
            low, high = min(low, float(near.min())), max(high, float(near.max()))
    return padded(low, high)


def _beyond(measured: FloatArray, scale: Scale) -> tuple[float, float, int] | None:
    """Lowest and highest sample, and how many lie outside the scale; None if none does."""
    finite = measured[np.isfinite(measured)]
    n_beyond = int(((finite < scale.low) | (finite > scale.high)).sum())
    return (float(finite.min()), float(finite.max()), n_beyond) if n_beyond else None


def _residuals(name: str, having: Sequence[tuple[int, Run]], shown: Run, timeline: Timeline) -> Html:
    """Simulated less measured, with the inlier threshold, or with the noise where it is known."""
    traces, ranges = [], []
    for i, run in having:
        errors = _column(run.errors, run, name)
        look, apart = _set_apart(name, run, is_shown=run is shown)
        if run is shown:
            traces.append(_dots(f"{run.label} (outlier)", look, run, errors, apart))
        traces.append(_dots(run.label, f"m{i}", run, errors, ~apart))
        ranges.append(bulk(errors[~apart] if np.mean(apart) < _MOST else errors))
    level, meaning = _level(name, shown)
    levels = (-level, level) if level > 0.0 else ()
    low, high = shown.ranges[name]
    scale = _residual_scale(ranges, [run is shown for _, run in having], _VISIBLE * (high - low))
    note = f"; the dashed lines are {meaning}, {number(level, 3)}" if levels else ""
    label = f"Residuals of {name}, simulated less measured{note}"
    heading = tag("p", f"simulated − measured{note}", class_="residual-title")
    return tag("div", heading, time_plot(traces, scale, timeline, label, look="residual", levels=levels))


def _set_apart(name: str, run: Run, *, is_shown: bool) -> tuple[str, npt.NDArray[np.bool_]]:
    """How residuals (N,) that are marked look, and which are: faults if they are known, else rows that don't agree."""
    if run.diagnosis is not None:
        return "fault", run.faults[name]
    return "outlier", run.observations.valid & ~run.inliers & is_shown


def _level(name: str, run: Run) -> tuple[float, str]:
    """What residuals are to be measured by, 0 if nothing is, and what it is."""
    if run.diagnosis is not None:
        return _NOISE * run.diagnosis.noise_std.get(name, 0.0), "three times the noise"
    return float(run.thresholds[run.observations.signals.index(name)]), "the inlier threshold"


def _residual_scale(ranges: Sequence[tuple[float, float]], is_shown: Sequence[bool], visible: float) -> Scale:
    """The marking run's range, and the others' as far as they do not dwarf it, or are no larger than ``visible``."""
    low, high = ranges[is_shown.index(True)]
    reach = max(_BEYOND_REFERENCE * (high - low), visible)
    lowest, highest = min(a for a, _ in ranges), max(b for _, b in ranges)
    return padded(max(lowest, low - reach), min(highest, high + reach))


# ---------------------------------------------------------------------- inliers


def inliers_over_time(runs: Sequence[Run], timeline: Timeline) -> Html:
    """How many rows agree with each simulation, and which do not."""
    traces = [_fraction_trace(run, i) for i, run in enumerate(runs)]
    label = "Percentage of rows that agree with the simulation, in windows over the log"
    strips = [_rejected(run, i, timeline) for i, run in enumerate(runs)]
    caption = tag(
        "figcaption",
        tag("h3", "Rows that agree ", tag("span", "%", class_="unit")),
        tag(
            "p", "Below: the rows that do not, one strip a simulation; grey rows do not count, for a signal is missing."
        ),
    )
    fractions = time_plot(traces, Scale(-3.0, 103.0), timeline, label)
    return tag(
        "section",
        tag("h2", "Inliers over time"),
        tag("figure", caption, fractions, *strips, time_axis(timeline)),
        id="inliers",
    )


def _fraction_trace(run: Run, i: int) -> Trace:
    """The inlier fraction as steps over the log's rows."""
    edges, fractions = windows(run)
    rows = run.first + np.column_stack([edges[:-1], edges[1:] - 1]).ravel()
    return Trace(run.label, f"m{i}", "line", rows, np.repeat(100.0 * fractions, 2))


def _rejected(run: Run, i: int, timeline: Timeline) -> Html:
    rejected, uncounted = np.zeros(timeline.n_rows), np.zeros(timeline.n_rows)
    rejected[run.rows] = run.observations.valid & ~run.inliers
    uncounted[run.rows] = ~run.observations.valid
    uncounted[: run.first] = 1.0
    uncounted[run.rows[-1] + 1 :] = 1.0
    n_rejected = int(rejected.sum())
    text = f"{run.label}: {plural(n_rejected, 'row')} of {run.observations.n_rows:,} do not agree"
    bars = strip([(rejected, f"bar m{i}"), (uncounted, "bar uncounted")], timeline, text)
    return tag("div", tag("p", text, class_="residual-title"), bars)
