"""Rows of marks: median and largest error of each method at each level, on a logarithmic axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.plots.figure import INK, MUTED, PAPER, RULE, SOFT, axes_at, write_at
from diransac.text_table import superscript

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "LogAxis",
    "MarkRow",
    "as_marks",
    "draw_rows",
    "name_rows",
    "names_width",
    "row_height",
]

Looks = Mapping[str, Mapping[str, Any]]

# Inches: height of a row per method, its margin, its least height; least distances of labelled decades and of labels.
_METHOD, _FREE, _LEAST = 0.044, 0.075, 0.24
_APART, _NEAR = 0.5, 0.32
# Largest number of decades of an axis, and the distance of the places beyond its ends, in decades.
_DECADES, _ROOM = 6, 0.6


@dataclass(frozen=True)
class MarkRow:
    """Marks of one level.

    Parameters
    ----------
    name : of the level
    median, worst : (n_methods,)   infinite where a method has no result, NaN where it was not run
    quiet : whether it is a second row of the level above
    """

    name: str
    median: FloatArray
    worst: FloatArray
    quiet: bool = False


@dataclass(frozen=True)
class LogAxis:
    """Logarithmic axis with places beyond its ends for values that are too small, too large or infinite."""

    least: int
    low: int
    high: int
    exceeded: bool
    endless: bool

    @classmethod
    def of(cls, rows: Sequence[MarkRow], least: int) -> LogAxis:
        """Axis for these rows."""
        values = np.array([[row.median, row.worst] for row in rows])
        seen = values[np.isfinite(values) & (values >= 10.0**least)]
        smallest, largest = (float(seen.min()), float(seen.max())) if len(seen) else (10.0**least, 10.0**least)
        low = int(np.floor(np.log10(smallest)))
        high = min(max(int(np.ceil(np.log10(largest))), low + 1), low + _DECADES)
        return cls(least, low, high, largest > 10.0**high, bool(np.isinf(values).any()))

    @property
    def nothing(self) -> float:
        """Place of values that are too small, in decades."""
        return self.low - _ROOM

    @property
    def most(self) -> float:
        """Place of values that are too large."""
        return self.high + _ROOM

    @property
    def none(self) -> float:
        """Place of infinite values."""
        return self.high + (3.6 if self.exceeded else 1.2) * _ROOM

    @property
    def ends(self) -> tuple[float, float]:
        """Ends of the panel."""
        last = self.none if self.endless else self.most if self.exceeded else self.high
        return self.nothing - 0.6 * _ROOM, last + 0.6 * _ROOM

    def place(self, values: FloatArray) -> FloatArray:
        """Places of values, in decades; NaN for NaN."""
        with np.errstate(divide="ignore"):
            decades = np.log10(values)
        inside = np.where(decades < self.low, self.nothing, np.where(decades > self.high, self.most, decades))
        return np.where(np.isinf(values), self.none, inside)

    def names(self, width: float) -> dict[float, str]:
        """Labels by place along a panel of this width, inches; labels do not overlap."""
        decade = width / (self.ends[1] - self.ends[0])
        name, step = (_decade, 1) if decade > _APART else (_power, 2)
        beyond = {self.nothing: f"<{name(self.least)}"}
        beyond |= {self.most: f">{name(self.high)}"} if self.exceeded else {}
        beyond |= {self.none: "none"} if self.endless else {}
        decades = range(self.low + step - 1, self.high + 1, step)
        return beyond | {float(k): name(k) for k in decades if all(abs(k - x) * decade > _NEAR for x in beyond)}


def as_marks(looks: Looks) -> dict[str, dict[str, Any]]:
    """Styles of methods as marks without lines; the default mark is a square."""
    plain = {"marker": "s", "markersize": 4.0}
    return {label: {**plain, **look, "linestyle": "none"} for label, look in looks.items()}


def row_height(n_methods: int) -> float:
    """Height of a row, inches."""
    return max(_LEAST, _METHOD * n_methods + _FREE)


def draw_rows(
    figure: Figure, place: tuple[float, float, float], rows: Sequence[MarkRow], looks: Looks, scale: LogAxis
) -> None:
    """Draw rows of marks at the medians, with lines to the largest values.

    Parameters
    ----------
    place : left, top and width, inches from the figure's top left
    looks : style of each method's mark, from `as_marks`; the first is at the top of a row
    """
    left, top, width = place
    n_methods = len(looks)
    axes = axes_at(figure, left, top, width, row_height(n_methods) * len(rows))
    axes.grid(visible=False)
    axes.set(facecolor=PAPER, xlim=scale.ends, ylim=(len(rows), 0.0), yticks=[])
    axes.set_xticks(*map(list, zip(*scale.names(width).items(), strict=True)))
    axes.tick_params(labeltop=True)
    _shade(axes, rows, scale)
    free = _FREE / row_height(n_methods)
    within = free / 2.0 + (1.0 - free) * (np.arange(n_methods) + 0.5) / n_methods
    for i, row in enumerate(rows):
        medians, ends = scale.place(row.median), scale.place(row.worst)
        for y, x, end, look in zip(i + within, medians, ends, looks.values(), strict=True):
            _mark(axes, x, end, y, look, hollow=x == scale.none)


def _mark(axes: Axes, x: float, end: float, y: float, look: Mapping[str, Any], *, hollow: bool) -> None:
    """Draw a method's mark, and the line to its largest value."""
    colour = look["color"]
    axes.plot([x, end], [y, y], color=colour, linewidth=1.0, alpha=0.45, solid_capstyle="butt", zorder=2.2)
    face = PAPER if hollow else colour
    axes.plot([x], [y], **{**look, "markerfacecolor": face, "markeredgewidth": 0.8 if hollow else 0.3}, zorder=2.5)


def _shade(axes: Axes, rows: Sequence[MarkRow], scale: LogAxis) -> None:
    """Draw bands behind every other level, lines at the decades, and dotted lines before the places beyond the ends."""
    band = 0
    for i, row in enumerate(rows):
        band += not row.quiet
        if band % 2:
            axes.axhspan(i, i + 1, color=SOFT, linewidth=0.0, zorder=0.5)
    axes.vlines(np.arange(scale.low, scale.high + 1), 0, len(rows), color=RULE, linewidth=0.7, zorder=1.0)
    apart = [scale.none - 0.6 * _ROOM] * scale.endless + [scale.low - 0.4 * _ROOM] * (scale.least < scale.low)
    if apart:
        axes.vlines(apart, 0, len(rows), color=MUTED, linewidth=0.7, linestyle=":", zorder=1.0)


def names_width(names: Sequence[str], heading: str) -> float:
    """Width of the names of rows and their heading with margins, inches."""
    # Width of a letter of a row's name, inches; letters per line.
    return 0.25 + 0.059 * max(len(line) for name in (*names, heading) for line in _lines(name))


def name_rows(
    figure: Figure, place: tuple[float, float], rows: Sequence[MarkRow], n_methods: int, heading: str
) -> None:
    """Write the names of the rows below their heading.

    Parameters
    ----------
    place : left and top of their panel, inches from the figure's top left
    heading : such as ``outlier magnitude, m/s²``
    """
    left, top = place
    # Inches: distance of the heading above the rows' names.
    write_at(figure, left - 0.1, top - 0.05, "\n".join(_lines(heading)), va="bottom", ha="right")
    for i, row in enumerate(rows):
        look: dict[str, Any] = {} if row.quiet else {"fontsize": 8.0, "color": INK}
        middle = top + (i + 0.5) * row_height(n_methods)
        write_at(figure, left - 0.1, middle, "\n".join(_lines(row.name)), va="center", ha="right", **look)


def _lines(name: str) -> list[str]:
    """Name wrapped into lines."""
    return wrap(name, 40) or [name]


def _decade(power: int) -> str:
    """``0.01``, ``1``, ``1,000``."""
    return f"{10.0**power:,.{max(0, -power)}f}"


def _power(power: int) -> str:
    """``0.1``, ``1``, ``10``, and ``10⁻³`` or ``10³`` further out."""
    return _decade(power) if abs(power) < 2 else f"10{superscript(power)}"
