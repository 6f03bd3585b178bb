"""Figures as SVG: every vertex is a sample, x is the log's row, y thousandths of the range that is shown.

A long signal keeps the smallest and the largest sample of each of some hundred stretches, so no peak is lost, and where
it is drawn as dots every n-th one, so that it looks as dense as it is.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from diransac.arrays import FloatArray, IntArray
from diransac.report.markup import Html, tag

__all__ = [
    "Scale",
    "Timeline",
    "Trace",
    "extremes",
    "padded",
    "path_data",
    "strip",
    "ticks",
    "time_axis",
    "time_plot",
]


_HEIGHT = 1000
_FARTHEST = 10**6
_STRIP_CELLS = 3000
_MARGIN = 0.06


@dataclass(frozen=True)
class Timeline:
    """The log's rows in time.

    Parameters
    ----------
    n_rows : how many
    start, dt : time of the first, and from one to the next, s
    cells : stretches of which a figure keeps the extremes
    """

    n_rows: int
    start: float
    dt: float
    cells: int = 700


@dataclass(frozen=True)
class Scale:
    """The range of values that a plot shows."""

    low: float
    high: float

    def height(self, values: npt.ArrayLike) -> IntArray:
        """Thousandths of the range from its top, as the figures count; what is far outside is brought nearer."""
        part = (self.high - np.asarray(values, dtype=float)) / (self.high - self.low)
        return np.rint(np.clip(_HEIGHT * part, -_FARTHEST, _FARTHEST)).astype(np.int64)


@dataclass(frozen=True)
class Trace:
    """A series in a plot.

    Parameters
    ----------
    name : what the reader is told at the pointer
    look : CSS classes
    kind : ``line`` joins neighbouring rows, ``dots`` does not
    rows : (n,)   rows of the log, increasing
    values : (n,)   NaN is left out
    """

    name: str
    look: str
    kind: Literal["line", "dots"]
    rows: IntArray
    values: FloatArray


# ---------------------------------------------------------------------- ranges and ticks


def padded(low: float, high: float) -> Scale:
    """The scale that shows a range with a margin; a range of no width gets one."""
    width = high - low
    if not width > 1e-12 * max(abs(low), abs(high), 1e-300):
        width = max(abs(low), abs(high), 1e-12)
    return Scale(low - _MARGIN * width, high + _MARGIN * width)


def ticks(low: float, high: float, about: int = 4) -> list[tuple[float, str]]:
    """Round values within a range and how they are written, about so many."""
    step = (high - low) / about
    decade = 10.0 ** math.floor(math.log10(step))
    step = next(x * decade for x in (1.0, 2.0, 5.0, 10.0) if x * decade >= step * 0.7)
    values = [step * k for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]
    return [(x, tick_text(x, step)) for x in values]


def tick_text(x: float, step: float) -> str:
    """A tick's value to the digits that its step needs."""
    magnitude = math.floor(math.log10(step) + 1e-9)
    if magnitude >= -4 and abs(x) < 1e5:
        return f"{x:.{max(0, -magnitude)}f}".replace("-", "−")
    if not x:
        return "0"
    digits = max(0, math.floor(math.log10(abs(x)) + 1e-9) - magnitude)
    mantissa, exponent = f"{x:.{digits}e}".split("e")
    return f"{mantissa}e{int(exponent)}".replace("-", "−")


# ---------------------------------------------------------------------- paths


def extremes(values: FloatArray, cells: IntArray) -> IntArray:
    """Indices, ascending, of the smallest and the largest value in each cell; ``cells (n,)`` numbers them."""
    order = np.lexsort((values, cells))
    ends = np.append(np.flatnonzero(np.diff(cells[order])), len(order) - 1)
    return np.unique(np.concatenate([order[np.append(0, ends[:-1] + 1)], order[ends]]))


def _kept(trace: Trace, timeline: Timeline) -> IntArray:
    """Indices of the samples that are drawn: all if few, else each cell's extremes, of dots some more."""
    finite = np.flatnonzero(np.isfinite(trace.values))
    if len(finite) <= 2 * timeline.cells:
        return finite
    kept = finite[extremes(trace.values[finite], trace.rows[finite] * timeline.cells // timeline.n_rows)]
    if trace.kind == "line":
        return kept
    return np.union1d(kept, finite[:: -(-len(finite) // timeline.cells)])


def path_data(trace: Trace, scale: Scale, timeline: Timeline) -> str:
    """The ``d`` of a path: a relative line or move from each sample to the next, ``h0`` making a dot after a move."""
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


def time_plot(
    traces: Iterable[Trace],
    scale: Scale,
    timeline: Timeline,
    label: str,
    *,
    look: str = "",
    levels: Sequence[float] = (),
    full: tuple[float, float] | None = None,
) -> Html:
    """A plot over time that page.js lets zoom and read.

    Parameters
    ----------
    label : what it shows, for those who cannot see it
    look : CSS classes of the panel
    levels : values to mark by a horizontal line
    full : the range of everything that was measured, where it is more than the scale shows
    """
    marks = ticks(scale.low, scale.high)
    heights = [int(y) for y in scale.height([x for x, _ in marks])]
    names = [
        tag("span", text, class_="tick y", style=f"top:{y / 10:.1f}%")
        for y, (_, text) in zip(heights, marks, strict=True)
    ]
    width = max(1, timeline.n_rows - 1)
    lines = [tag("path", class_="grid", d="".join(f"M0 {y}h{width}" for y in heights))]
    if levels:
        lines.append(tag("path", class_="level", d="".join(f"M0 {y}h{width}" for y in scale.height(levels))))
    drawn = [(trace, path_data(trace, scale, timeline)) for trace in traces]
    lines += [tag("path", class_=f"trace {t.kind} {t.look}", data_name=t.name, d=d) for t, d in drawn if d]
    reach = None if full is None else " ".join(str(y) for y in scale.height([full[1], full[0]]))
    svg = _svg(lines, timeline, label, data_low=scale.low, data_high=scale.high, data_full=reach)
    return tag("div", tag("div", *names, class_="ticks"), svg, class_=f"panel {look}".strip())


def _svg(lines: list[Html], timeline: Timeline, label: str, **attributes: str | float | None) -> Html:
    return tag(
        "svg",
        *lines,
        class_="plot",
        viewBox=f"0 0 {max(1, timeline.n_rows - 1)} {_HEIGHT}",
        preserveAspectRatio="none",
        role="img",
        aria_label=label,
        tabindex="0",
        data_start=timeline.start,
        data_dt=timeline.dt,
        **attributes,
    )


def strip(layers: Iterable[tuple[FloatArray, str]], timeline: Timeline, label: str) -> Html:
    """A strip over time, each layer ``(fractions (n_rows,), CSS classes)`` filled to each row's fraction from below.

    Of a long log, a bar stands for a stretch of rows.
    """
    bars = [tag("path", class_=look, d=_bars(fractions)) for fractions, look in layers if fractions.any()]
    return tag("div", tag("div", class_="ticks"), _svg(bars, timeline, label), class_="panel strip")


def _bars(fractions: FloatArray) -> str:
    """The ``d`` of bars as high as the fractions, neighbours of one height joined."""
    edges = np.unique(np.linspace(0, len(fractions), min(len(fractions), _STRIP_CELLS) + 1).astype(int))
    heights = np.rint(_HEIGHT * np.add.reduceat(fractions, edges[:-1]) / np.diff(edges)).astype(int)
    changes = np.concatenate([[0], np.flatnonzero(np.diff(heights)) + 1, [len(heights)]])
    begins, ends = edges[changes[:-1]].tolist(), edges[changes[1:]].tolist()
    bars = zip(begins, ends, heights[changes[:-1]].tolist(), strict=True)
    return "".join(f"M{x} {_HEIGHT}v-{height}h{end - x}v{height}z" for x, end, height in bars if height)


def time_axis(timeline: Timeline) -> Html:
    """The names of the times below a plot."""
    span = timeline.dt * max(1, timeline.n_rows - 1)
    marks = ticks(timeline.start, timeline.start + span, 5)
    names = [
        tag("span", text, class_="tick x", style=f"left:{100.0 * (t - timeline.start) / span:.2f}%")
        for t, text in marks
    ]
    return tag("div", tag("div", *names, class_="times"), class_="axis", aria_hidden="true")
