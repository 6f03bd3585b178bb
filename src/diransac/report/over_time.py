"""Figures over time of one log: measured and simulated signals, residuals, unmodelled forces."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from diransac import arrays
from diransac.arrays import BoolArray, FloatArray, IntArray, bulk_range
from diransac.data.log import Log
from diransac.identification.diagnosis import Diagnosis
from diransac.model import Model
from diransac.report.figures import Figure, Plot, Scale, Timeline, Trace, padded, time_axis, time_plot
from diransac.report.runs import Run
from diransac.text_table import number, percent, plural, share, some

_VISIBLE = 0.01


@dataclass(frozen=True)
class LogFigures:
    """Everything over time of one log.

    Parameters
    ----------
    name, size : of the log
    method : description of the simulations
    legend : ``(CSS class, text)`` of each series
    signals : a figure per signal
    unmodelled_about, unmodelled : description and figures of unmodelled forces; empty without a diagnosis
    """

    name: str
    size: str
    method: str
    legend: tuple[tuple[str, str], ...]
    signals: tuple[Figure, ...]
    unmodelled_about: str
    unmodelled: tuple[Figure, ...]


def figures_of(log: Log, runs: Sequence[Run], n_logs: int) -> LogFigures:
    """Figures of one log.

    Parameters
    ----------
    log : the log
    runs : every result of the page over this log
    n_logs : number of logs on the page
    """
    cells = max(110, 500 // (len(runs) * n_logs))  # fewer on a page of many results, which keeps it small
    timeline = Timeline(len(log), float(log.time[0]), log.dt, cells)
    marking = max(runs, key=lambda run: run.inlier_fraction)
    names = dict.fromkeys(name for run in runs for name in run.observations.signals)
    diagnosed = [(i, run, run.view.diagnosis) for i, run in enumerate(runs) if run.view.diagnosis is not None]
    return LogFigures(
        name=runs[0].log_name,
        size=f"{number(log.dt * (len(log) - 1))} s at {number(1.0 / log.dt)} Hz, {plural(len(log), 'row')}",
        method=" ".join([_method(runs), *_left_out_text(log, marking, timeline)]),
        legend=tuple(_legend(runs, marking, log, timeline)),
        signals=tuple(_signal(name, runs, marking, log, timeline) for name in names),
        unmodelled_about=_unmodelled_about(diagnosed[0][2]) if diagnosed else "",
        unmodelled=tuple(figure for i, run, found in diagnosed for figure in _unmodelled(run, found, i, log, timeline)),
    )


# ---------------------------------------------------------------------- measured and simulated


def _method(runs: Sequence[Run]) -> str:
    """Starting points of the simulations."""
    about = "Each simulation depends on the inputs alone, and starts from a state that is estimated with the model"
    periods = dict.fromkeys(number(run.restart_period) for run in runs if np.isfinite(run.restart_period))
    if not periods:
        return f"{about}, from the first samples."
    text = f"{about} from the samples before: it restarts every {' or '.join(periods)} s, the judged horizon."
    return text if len(runs) > 1 else f"{text} The faint line is one simulation of the whole log."


def _legend(runs: Sequence[Run], marking: Run, log: Log, timeline: Timeline) -> list[tuple[str, str]]:
    keys = [("measured", "measured")]
    if marking.screened:
        of = f" of {marking.label}" if len(runs) > 1 else ""
        which = "simulation" if marking.held_out else "whole-log simulation"
        keys += [("fault", "outlier"), ("outlier", f"row that disagrees with the {which}{of}")]
    else:
        of = f" with {marking.label}" if len(runs) > 1 else ""
        keys.append(("outlier", f"row that disagrees{of} (outlier)"))
    keys += [(f"m{i}", f"simulated, {run.label}") for i, run in enumerate(runs)]
    if _shows_both(runs):
        keys.append(("long", "whole-log simulation"))
    shown = [_bands(run, log, timeline) for run in runs]
    return [*keys, *((look, text) for look, text in _BANDS.items() if any(x[look].any() for x in shown))]


def _shows_both(runs: Sequence[Run]) -> bool:
    """True if the whole-log simulation is drawn too, which is readable for a single result only."""
    return len(runs) == 1 and bool(np.isfinite(runs[0].restart_period))


def _signal(name: str, runs: Sequence[Run], marking: Run, log: Log, timeline: Timeline) -> Figure:
    """Figure of one signal and its residuals."""
    having = [(i, run) for i, run in enumerate(runs) if name in run.observations.signals]
    shown = marking if name in marking.observations.signals else having[0][1]
    unit = shown.observations.model.units[name]
    scale = _signal_scale(name, shown, [run for _, run in having])
    traces = _signal_traces(name, having, shown)
    if _shows_both(runs):
        whole = _column(shown.open_loop, shown, name)
        traces.append(Trace("whole-log simulation", "m0 long", "line", shown.rows, whole))
    facts = [_median_error(name, run, unit, label=f"{run.label} " * (len(runs) > 1)) for _, run in having]
    measured = shown.observations.column(name)
    beyond, is_measured = _beyond(measured, scale), bool(np.isfinite(measured).any())
    what = "measured and simulated" if is_measured else "simulated"
    about = f"{name} in {unit}, {what} over {number(timeline.dt * (timeline.n_rows - 1))} s"
    bands = _bands(shown, log, timeline)
    plot = time_plot(traces, scale, timeline, about, full=beyond and beyond[:2], bands=bands)
    return Figure(
        title=name,
        unit=unit,
        facts=(f"median error{':' * (len(runs) > 1)} {'; '.join(facts)}" if is_measured else "not measured",),
        plots=(plot, _residuals(name, having, shown, timeline)) if is_measured else (plot,),
        time_ticks=time_axis(timeline),
        beyond=_beyond_text(beyond),
    )


def _median_error(name: str, run: Run, unit: str, label: str) -> str:
    error, (low, high) = run.median_errors[name], run.ranges[name]
    part = f" ({share(error / (high - low), 'its range')})" if high > low and np.isfinite(error) else ""
    return f"{label}{number(error, 3)} {unit}{part}"


def _signal_traces(name: str, having: Sequence[tuple[int, Run]], shown: Run) -> list[Trace]:
    measured, outliers = shown.observations.column(name), shown.outliers[name]
    disagreeing = shown.observations.valid & ~shown.inliers & ~outliers
    rejected = "measured (row disagrees)" if shown.screened else "measured (outlier)"
    return [
        _dots("measured", "measured", shown, measured, ~disagreeing & ~outliers),
        _dots(rejected, "outlier", shown, measured, disagreeing),
        _dots("measured (outlier)", "fault", shown, measured, outliers),
        *(Trace(run.label, f"m{i}", "line", run.rows, _column(run.simulated, run, name)) for i, run in having),
    ]


def _dots(name: str, look: str, run: Run, values: FloatArray, chosen: BoolArray) -> Trace:
    return Trace(name, look, "dots", run.rows[chosen], values[chosen])


def _column(values: FloatArray, run: Run, name: str) -> FloatArray:
    return values[:, run.observations.signals.index(name)]


def _signal_scale(name: str, shown: Run, runs: Sequence[Run]) -> Scale:
    """The measured range, widened by simulations up to a limit."""
    low, high = shown.ranges[name]
    reach = 0.4 * (high - low)
    for run in runs:
        simulated = _column(run.simulated, run, name)
        near = np.clip(simulated[np.isfinite(simulated)], low - reach, high + reach)
        if reach > 0.0 and len(near):
            low, high = min(low, float(near.min())), max(high, float(near.max()))
    return padded(low, high)


def _beyond(measured: FloatArray, scale: Scale) -> tuple[float, float, int] | None:
    """Lowest and highest sample, and the number outside of the scale; None if none is."""
    finite = measured[np.isfinite(measured)]
    n_beyond = int(((finite < scale.low) | (finite > scale.high)).sum())
    return (float(finite.min()), float(finite.max()), n_beyond) if n_beyond else None


def _beyond_text(beyond: tuple[float, float, int] | None) -> str:
    if beyond is None:
        return ""
    low, high, n_beyond = beyond
    return f"{plural(n_beyond, 'sample')} outside of this range, from {number(low)} to {number(high)}"


# ---------------------------------------------------------------------- stretches that are left out, or not described


_BANDS = {"left-out": "left out", "departed": "the model does not hold"}
"""CSS class of each kind of band -> what it shows."""


def _bands(run: Run, log: Log, timeline: Timeline) -> dict[str, BoolArray]:
    """Rows of the log ``(n_rows,)`` that each kind of band shades."""
    departed = np.zeros(timeline.n_rows, bool)
    for stretch in run.view.departures:
        departed |= (log.time >= stretch.start) & (log.time <= stretch.stop)
    return {"left-out": _left_out(run, log, timeline), "departed": departed}


def _left_out(run: Run, log: Log, timeline: Timeline) -> BoolArray:
    """Rows of the log ``(n_rows,)`` in gaps, which no simulation covers, and where an event does not hold."""
    rows = np.zeros(timeline.n_rows, bool)
    rows[run.rows] = run.observations.gaps
    for start, stop, _ in _not_held(log):
        rows |= (log.time >= start) & (log.time <= stop)
    return rows


def _not_held(log: Log) -> list[tuple[float, float, str]]:
    """Start and end, s, and the reason, of the stretches that the preparation of the log has left out."""
    why = {"keep_while": "not {}", "leave_out": "as asked"}
    return [
        (start, stop, why[step["step"]].format(" and ".join(step.get("events", ()))))
        for step in log.history
        if step.get("step") in why
        for start, stop in step["left_out"]
    ]


def _left_out_text(log: Log, run: Run, timeline: Timeline) -> list[str]:
    """A sentence about the stretches that are left out, with their reasons; none where nothing is."""
    found = _not_held(log)
    for gap in arrays.runs(_left_out(run, log, timeline)):
        start, stop = float(log.time[gap.start]), float(log.time[gap.stop - 1])
        if not any(a <= stop and start <= b for a, b, _ in found):
            found.append((start, stop, "samples are missing"))
    if not found:
        return []
    listed = some((f"{number(a, 4)} to {number(b, 4)} s ({why})" for a, b, why in sorted(found)), 6)
    return [f"Left out: {listed}."]


# ---------------------------------------------------------------------- residuals


def _residuals(name: str, having: Sequence[tuple[int, Run]], shown: Run, timeline: Timeline) -> Plot:
    """Simulated minus measured, with the inlier threshold, or with three standard deviations of the noise."""
    traces, ranges = [], []
    for i, run in having:
        errors = _column(run.errors, run, name)
        look, apart = _set_apart(name, run, is_shown=run is shown)
        if run is shown:
            traces.append(_dots(f"{run.label} (outlier)", look, run, errors, apart))
        traces.append(_dots(run.label, f"m{i}", run, errors, ~apart))
        ranges.append(bulk_range(errors[~apart] if np.mean(apart) < 0.5 else errors))
    level, meaning = _level(name, shown)
    levels = (-level, level) if level > 0.0 else ()
    low, high = shown.ranges[name]
    scale = _residual_scale(ranges, [run is shown for _, run in having], _VISIBLE * (high - low))
    note = f"; dashed: {meaning}, ±{number(level, 3)}" if levels else ""
    label = f"Residuals of {name}, simulated minus measured{note}"
    heading = f"simulated − measured{note}"
    return time_plot(traces, scale, timeline, label, heading=heading, look="residual", levels=levels)


def _set_apart(name: str, run: Run, *, is_shown: bool) -> tuple[str, BoolArray]:
    """CSS class and mask (N,) of marked residuals: diagnosed outliers if known, else rows that disagree."""
    if run.screened:
        return "fault", run.outliers[name]
    return "outlier", run.observations.valid & ~run.inliers & is_shown


def _level(name: str, run: Run) -> tuple[float, str]:
    """Reference value of the residuals, 0 without one, and its name."""
    if run.screened:
        return 3.0 * run.noise.get(name, 0.0), "three standard deviations of the noise"
    return run.thresholds.get(name, 0.0), "the inlier threshold"


def _residual_scale(ranges: Sequence[tuple[float, float]], is_shown: Sequence[bool], visible: float) -> Scale:
    """The marking run's range, widened by the other runs' up to twice its width or to ``visible``."""
    low, high = ranges[is_shown.index(True)]
    reach = max(2.0 * (high - low), visible)
    lowest, highest = min(a for a, _ in ranges), max(b for _, b in ranges)
    return padded(max(lowest, low - reach), min(highest, high + reach))


# ---------------------------------------------------------------------- unmodelled forces


def _unmodelled_about(found: Diagnosis) -> str:
    """Description of the figures."""
    time = found.smoothed_time
    window = f"{number(float(time[1] - time[0]), 3)} s" if len(time) > 1 else "the log"
    what = "Unmodelled generalised forces" if found.unmodelled_forces else "Unmodelled accelerations"
    text = f"{what}: zero where the model explains the motion. Each step is the mean over {window}."
    return f"{text} Dashed: what the suggested terms explain of it." if found.suggested_terms else text


def _unmodelled(run: Run, found: Diagnosis, i: int, log: Log, timeline: Timeline) -> Iterator[Figure]:
    """A figure of each unmodelled force, or of each acceleration if the model has no balance of forces."""
    bands = _bands(run, log, timeline)
    for name, values in (found.unmodelled_forces or found.unmodelled_accelerations).items():
        what, unit = _name_and_unit(run.result.model, name, is_force=bool(found.unmodelled_forces))
        rms, summary = float(np.sqrt(np.mean(np.square(values)))), run.view.summary
        shares = summary.prediction.unexplained if summary and summary.prediction else {}
        fraction = shares.get(name)
        relative = "no motion" if fraction is None else f"{percent(fraction)} of the acceleration"
        least = _VISIBLE * rms / fraction if fraction else 0.0
        scale = padded(min(-least, float(values.min())), max(least, float(values.max())))
        traces = [Trace(what, f"m{i}", "line", *_steps(found, values, timeline))]
        if np.any(found.suggested_terms.get(name, 0.0)):
            explained = _steps(found, found.suggested_terms[name], timeline)
            traces.append(Trace("suggested terms", "suggested", "line", *explained))
        label = f"Unmodelled {what}{f' in {unit}' if unit else ''}"
        plot = time_plot(traces, scale, timeline, label, levels=(0.0,), bands=bands)
        facts = (f"RMS {number(rms, 2)} {unit}".strip() + f", {relative}",)
        yield Figure(what, unit, facts, (plot,), time_axis(timeline))


def _name_and_unit(model: Model, acceleration: str, *, is_force: bool) -> tuple[str, str]:
    """Name and unit of an unmodelled acceleration, of its force, or of the term of a state of first order."""
    unit, coordinate = model.units[acceleration], model.rate_names[list(model.accelerations).index(acceleration)]
    if not is_force:
        return acceleration, unit
    if coordinate in model.first_order:
        return f"term of {coordinate}", ""
    return f"force on {coordinate}", {"m/s^2": "N", "rad/s^2": "N m"}.get(unit, "")


def _steps(found: Diagnosis, values: FloatArray, timeline: Timeline) -> tuple[IntArray, FloatArray]:
    """Rows and values of a line that is constant over each window."""
    begins = np.rint((found.smoothed_time - timeline.start) / timeline.dt).astype(np.int64)
    ends = np.append(begins[1:] - 1, timeline.n_rows - 1)
    return np.column_stack([begins, ends]).ravel(), np.repeat(values, 2)
