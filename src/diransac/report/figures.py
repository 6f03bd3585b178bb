"""Geometry of the SVG figures: every vertex is a sample, x is the log's row, y is in thousandths of the shown range.

A long signal is reduced to the smallest and largest sample of each of several hundred cells, so that no peak is lost;
dots additionally keep every n-th sample, so that their density is preserved.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from diransac.arrays import BoolArray, FloatArray, IntArray, runs

Tick = tuple[str, str]
"""Position in percent of an axis, and text."""

_HEIGHT = 1000
_MARGIN = 0.06


@dataclass(frozen=True)
class Timeline:
    """Time axis of a log.

    Parameters
    ----------
    n_rows : number of rows
    start, dt : time of the first row and sampling time, s
    cells : number of cells of which a figure keeps the extremes
    """

    n_rows: int
    start: float
    dt: float
    cells: int = 700


@dataclass(frozen=True)
class Scale:
    """Range of values of a plot."""

    low: float
    high: float

    def height(self, values: npt.ArrayLike) -> IntArray:
        """Thousandths of the range from its top; values far outside are clipped."""
        part = (self.high - np.asarray(values, dtype=float)) / (self.high - self.low)
        return np.rint(np.clip(_HEIGHT * part, -(10**6), 10**6)).astype(np.int64)


@dataclass(frozen=True)
class Trace:
    """One series of a plot.

    Parameters
    ----------
    name : shown beside the value under the pointer
    look : CSS classes
    kind : ``line`` joins neighbouring rows, ``dots`` does not
    rows : (n,)   rows of the log, increasing
    values : (n,)   NaN is omitted
    """

    name: str
    look: str
    kind: Literal["line", "dots"]
    rows: IntArray
    values: FloatArray


# ---------------------------------------------------------------------- ranges and ticks


def padded(low: float, high: float) -> Scale:
    """Scale of a range with a margin; a range of zero width is widened."""
    width = high - low
    if not width > 1e-12 * max(abs(low), abs(high), 1e-300):
        width = max(abs(low), abs(high), 1e-12)
    return Scale(low - _MARGIN * width, high + _MARGIN * width)


def ticks(low: float, high: float, about: int = 4) -> list[tuple[float, str]]:
    """Round values within a range, about as many as requested, and their texts."""
    step = (high - low) / about
    decade = 10.0 ** math.floor(math.log10(step))
    step = next(x * decade for x in (1.0, 2.0, 5.0, 10.0) if x * decade >= step * 0.7)
    values = [step * k for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]
    return [(x, tick_text(x, step)) for x in values]


def tick_text(x: float, step: float) -> str:
    """Value of a tick with the digits that resolve the step."""
    magnitude = math.floor(math.log10(step) + 1e-9)
    if magnitude >= -6 and abs(x) < 1e5:
        return f"{x:.{max(0, -magnitude)}f}".replace("-", "−")
    if not x:
        return "0"
    digits = max(0, math.floor(math.log10(abs(x)) + 1e-9) - magnitude)
    mantissa, exponent = f"{x:.{digits}e}".split("e")
    return f"{mantissa}e{int(exponent)}".replace("-", "−")


# ---------------------------------------------------------------------- paths


def extremes(values: FloatArray, cells: IntArray) -> IntArray:
    """Ascending indices of the smallest and largest value of each cell; ``cells (n,)`` holds cell numbers."""
    order = np.lexsort((values, cells))
    ends = np.append(np.flatnonzero(np.diff(cells[order])), len(order) - 1)
    return np.unique(np.concatenate([order[np.append(0, ends[:-1] + 1)], order[ends]]))


def _kept(trace: Trace, timeline: Timeline) -> IntArray:
    """Indices of the drawn samples: all if few, else the extremes of each cell, and for dots every n-th sample."""
    finite = np.flatnonzero(np.isfinite(trace.values))
    if len(finite) <= 2 * timeline.cells:
        return finite
    kept = finite[extremes(trace.values[finite], trace.rows[finite] * timeline.cells // timeline.n_rows)]
    if trace.kind == "line":
        return kept
    return np.union1d(kept, finite[:: -(-len(finite) // timeline.cells)])


def path_data(trace: Trace, scale: Scale, timeline: Timeline) -> str:
    """Attribute ``d`` of a path: a relative line or move from sample to sample, and ``h0`` after a move for a dot."""
    kept = _kept(trace, timeline)
    if not len(kept):
        return ""
    gaps = np.cumsum(~np.isfinite(trace.values))[kept]
    joined = (np.diff(gaps) == 0) & (trace.kind == "line")
    x, y = trace.rows[kept].tolist(), scale.height(trace.values[kept]).tolist()
    moves = zip(np.diff(x).tolist(), np.diff(y).tolist(), joined.tolist(), strict=True)
    return f"M{x[0]} {y[0]}h0" + "".join(
        f"{'l' if join else 'm'}{dx}{' ' if dy >= 0 else ''}{dy}{'' if join else 'h0'}" for dx, dy, join in moves
    )


# ---------------------------------------------------------------------- plots


@dataclass(frozen=True)
class Plot:
    """One SVG plot over time; the script of the page zooms and reads it.

    Parameters
    ----------
    label : description for readers who cannot see the plot
    look : CSS classes of its panel
    width : x of the last row
    start, dt : time of the first row and sampling time, s
    paths : ``(CSS classes, name, d)`` of each path; the name is empty for paths without values
    scale : range of values
    y_ticks : texts of the values
    full : y of the highest and lowest measured sample, if outside of the scale
    still : True if its x axis is no time, so that it does not zoom with plots of the log
    heading : text above it
    """

    label: str
    look: str
    width: int
    start: float
    dt: float
    paths: tuple[tuple[str, str, str], ...]
    scale: Scale
    y_ticks: tuple[Tick, ...]
    full: str = ""
    still: bool = False
    heading: str = ""


@dataclass(frozen=True)
class Figure:
    """Plots one above the other on one time axis.

    Parameters
    ----------
    title, unit : heading
    facts : captions
    plots : from top to bottom
    time_ticks : texts of the times
    beyond : caption about samples outside of the scale, empty if there are none
    x_label : quantity on the x axis and its unit; empty for time
    """

    title: str
    unit: str
    facts: tuple[str, ...]
    plots: tuple[Plot, ...]
    time_ticks: tuple[Tick, ...]
    beyond: str = ""
    x_label: str = ""


def time_plot(
    traces: Iterable[Trace],
    scale: Scale,
    timeline: Timeline,
    label: str,
    *,
    heading: str = "",
    look: str = "",
    levels: Sequence[float] = (),
    full: tuple[float, float] | None = None,
    still: bool = False,
    bands: Mapping[str, BoolArray] | None = None,
) -> Plot:
    """Plot of several traces over time.

    Parameters
    ----------
    traces, scale, timeline : series and their axes
    label : description for readers who cannot see the plot
    heading : text above the plot
    look : CSS classes of the panel
    levels : values marked by a horizontal line
    full : range of all measured samples, where it exceeds the scale
    still : True if the axis is no time
    bands : CSS classes -> (n_rows,)   rows that are shaded
    """
    marks = ticks(scale.low, scale.high)
    heights = [int(y) for y in scale.height([x for x, _ in marks])]
    width = max(1, timeline.n_rows - 1)
    paths = [
        (f"band {look}", "", "".join(f"M{x.start} 0v{_HEIGHT}h{x.stop - x.start}V0z" for x in runs(rows)))
        for look, rows in (bands or {}).items()
        if rows.any()
    ]
    paths.append(("grid", "", "".join(f"M0 {y}h{width}" for y in heights)))
    if levels:
        paths.append(("level", "", "".join(f"M0 {y}h{width}" for y in scale.height(levels))))
    drawn = [(trace, path_data(trace, scale, timeline)) for trace in traces]
    paths += [(f"trace {trace.kind} {trace.look}", trace.name, d) for trace, d in drawn if d]
    return Plot(
        label=label,
        look=look,
        width=width,
        start=timeline.start,
        dt=timeline.dt,
        paths=tuple(paths),
        scale=scale,
        y_ticks=tuple((f"{y / 10:.1f}%", text) for y, (_, text) in zip(heights, marks, strict=True)),
        full="" if full is None else " ".join(str(y) for y in scale.height([full[1], full[0]])),
        still=still,
        heading=heading,
    )


def time_axis(timeline: Timeline) -> tuple[Tick, ...]:
    """Ticks of a time axis."""
    span = timeline.dt * max(1, timeline.n_rows - 1)
    marks = ticks(timeline.start, timeline.start + span, 5)
    return tuple((f"{100.0 * (t - timeline.start) / span:.2f}%", text) for t, text in marks)
