"""Page of a tracked run: parameters with their intervals over time, changes, outliers, findings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.identification.tracking.estimates import History
from diransac.plots.tracking import INTERVAL, usual_range
from diransac.report import provenance
from diransac.report.figures import Figure, Plot, Timeline, Trace, padded, time_axis, time_plot
from diransac.report.rendering import Table, write_page
from diransac.text_table import number, percent, plural


def write_tracking_report(history: History, path: str | Path, *, command: str = "") -> None:
    """Write one HTML page about a tracked run.

    Parameters
    ----------
    history : History
        With an estimate at least.
    path : str or Path
        File of the page, written whole or not at all.
    command : str, optional
        Shell command that writes the page, to be shown on it.

    Raises
    ------
    ResultError
        The page cannot be written.

    Notes
    -----
    The page loads nothing, and runs its own script only.  The same estimates give the same page.
    """
    axis = _Axis(history.time)
    model = history.model
    write_page(
        path,
        "tracking.html",
        script="page.js",
        title=f"{model.name}, tracked",
        heading=model.name,
        about=model.description,
        lead=_lead(history, axis),
        parameters=_parameters(history),
        changes=_changes(history),
        contents=[_parameter_figure(history, name, axis) for name in model.parameters],
        outliers=_signal_figures(history, axis),
        notes=[f"t = {number(t, 6)} s: {note}" for t, note in history.notes],
        command=command,
        versions=provenance.versions(),
    )


class _Axis:
    """Place of each estimate on the axis of the figures.

    Parameters
    ----------
    time : (n,) array
        s; a clock may have been set back.
    """

    def __init__(self, time: FloatArray) -> None:
        steps = np.diff(time)
        dt = float(np.median(steps)) if len(steps) else 1.0
        most_rows = 1_000_000  # where a gap makes more of them, estimates are numbered instead
        self.is_time = bool(len(steps) == 0 or (steps.min() > 0.0 and time[-1] - time[0] < most_rows * dt))
        start, dt = (float(time[0]), dt) if self.is_time else (0.0, 1.0)
        self.rows: IntArray = np.rint((time - start) / dt).astype(np.int64) if self.is_time else np.arange(len(time))
        self.timeline = Timeline(int(self.rows[-1]) + 1, start, dt)
        self._time = time

    def trace(self, name: str, look: str, values: FloatArray) -> Trace:
        """A line through the estimates, broken where they are further apart than usual."""
        gaps = np.flatnonzero(np.diff(self.rows) > 1.5) + 1
        rows = np.insert(self.rows, gaps, self.rows[gaps] - 1)
        return Trace(name, look, "line", rows, np.insert(values.astype(float), gaps, np.nan))

    def marked(self, times: Sequence[float]) -> BoolArray:
        """Rows (n_rows,) about some times."""
        n = self.timeline.n_rows
        marks, half = np.zeros(n, bool), max(1, round(0.003 * n))
        for t in times:
            row = int(self.rows[np.abs(self._time - t).argmin()])
            marks[max(0, row - half) : row + half] = True
        return marks


def _lead(history: History, axis: _Axis) -> str:
    """A sentence on the run."""
    first, last = float(history.time[0]), float(history.time[-1])
    found = plural(len(history.changes), "change") if history.changes else "no change"
    span = f"from t = {number(first, 6)} to {number(last, 6)} s"
    text = f"{plural(history.n_steps, 'estimate')} {span}; {found} reported."
    return text if axis.is_time else f"{text} The axis counts estimates, because the clock was set back."


def _parameters(history: History) -> Table:
    """The last estimate, and the range of all."""
    assert history.last is not None
    rows = []
    for name, parameter in history.model.parameters.items():
        value, error = history.last.parameters[name], history.last.standard_errors[name]
        low, high = (number(value + side * INTERVAL * error) for side in (-1.0, 1.0))
        y = history.values(name)
        over_run = f"{number(float(y.min()))} to {number(float(y.max()))}"
        rows.append([name, number(value, 5), f"{low} to {high}", over_run, parameter.unit])
    header = ["parameter", "at the end", "95 % interval", "range over the run", "unit"]
    return Table(header, rows, "The last estimate, and the smallest and largest one of the run")


def _changes(history: History) -> Table | None:
    """Changes in the order of their reports; None without any."""
    if not history.changes:
        return None
    rows = [
        [
            f"{number(x.time, 5)} s",
            x.parameter,
            x.kind,
            f"{number(x.before)} ± {number(x.before_error, 1)}",
            f"{number(x.after)} ± {number(x.after_error, 1)}",
            history.model.parameters[x.parameter].unit,
            f"{number(x.detected - x.time, 2)} s",
        ]
        for x in history.changes
    ]
    header = ["time", "parameter", "kind", "before", "after", "unit", "found after"]
    return Table(header, rows, "Changes that were reported; ±: standard errors")


def _parameter_figure(history: History, name: str, axis: _Axis) -> Figure:
    """A parameter with its interval, and its changes as bands."""
    y, half = history.values(name), INTERVAL * history.standard_errors(name)
    traces = [
        axis.trace("95 % interval, from", "long m0", y - half),
        axis.trace("95 % interval, to", "long m0", y + half),
        axis.trace(name, "m0", y),
    ]
    changes = [x for x in history.changes if x.parameter == name]
    bands = {"departed": axis.marked([x.time for x in changes])} if changes else None
    unit = history.model.parameters[name].unit
    label = f"{name} in {unit or '1'} over time, with its 95 % interval"
    plot = time_plot(traces, padded(*usual_range(y, half)), axis.timeline, label, bands=bands)
    facts = (plural(len(changes), "change"),) if changes else ()
    return _figure(name, unit, facts, [plot], axis)


def _signal_figures(history: History, axis: _Axis) -> list[Figure]:
    """Fraction of outliers and noise of each signal."""
    units, figures = history.model.units, []
    for name in history.signals:
        share, noise = history.outliers(name), history.noise(name)
        plots = []
        for values, heading, unit in ((share, "fraction of outliers", ""), (noise, "noise", units[name])):
            known = values[np.isfinite(values)]
            scale = padded(0.0, float(known.max(initial=0.0)) or 1.0)
            text = f"{heading} of {name}{f' in {unit}' * bool(unit)} over time"
            above, trace = f"{heading}{f', {unit}' * bool(unit)}", axis.trace(heading, "m0", values)
            plots.append(time_plot([trace], scale, axis.timeline, text, heading=above, look="residual"))
        at_end = f"at the end {percent(float(share[-1]))}, noise {number(float(noise[-1]), 2)} {units[name]}".rstrip()
        figures.append(_figure(name, units[name], (at_end,), plots, axis))
    return figures


def _figure(title: str, unit: str, facts: tuple[str, ...], plots: Sequence[Plot], axis: _Axis) -> Figure:
    """Plots on the axis of the run."""
    label = "" if axis.is_time else "estimate"
    return Figure(title, unit, facts, tuple(plots), time_axis(axis.timeline), x_label=label)
