"""Rows of marks: what each method reached at each level, median and worst, on a logarithmic axis; for long names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.plots.layout import WIDTH
from diransac.plots.palette import INK, MUTED, PAPER, RULE, SOFT

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["Row", "Scale", "as_marks", "draw_rows", "name_rows", "names_width", "row_height"]

Looks = Mapping[str, Mapping[str, Any]]

# Inches: of a row, what each method takes, what is free, and the least in all; decades that have a name each are so far
# apart, and names no nearer.
_METHOD, _FREE, _LEAST = 0.044, 0.075, 0.24
_APART, _NEAR = 0.5, 0.32
# Inches: a letter of a row's name; letters of a line of it.
_LETTER, _LETTERS = 0.059, 40
# Inches: how far the heading of the rows' names is above these, beside the values.
_HEADING = 0.05
# Decades that an axis has at most, and the room beyond its ends, in decades: for too little, too much, none at all.
_DECADES, _ROOM = 6, 0.6
_WORST: dict[str, Any] = {"linewidth": 1.0, "alpha": 0.45, "solid_capstyle": "butt"}
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Row:
    """One row.

    Parameters
    ----------
    name : how it is called
    median, worst : (n_methods,) what is drawn; infinite where a method has nothing, NaN where it was not asked
    quiet : whether it belongs to the row above it
    """

    name: str
    median: FloatArray
    worst: FloatArray
    quiet: bool = False


@dataclass(frozen=True)
class Scale:
    """A logarithmic axis, beyond whose ends stands what is too small or too large for it, or no number at all.

    Parameters
    ----------
    least : the power of ten below which everything is too small
    low, high : powers of ten where the axis begins and ends
    exceeded : whether something is larger
    endless : whether something is infinite
    """

    least: int
    low: int
    high: int
    exceeded: bool
    endless: bool

    @classmethod
    def of(cls, rows: Sequence[Row], least: int) -> Scale:
        """The axis for these rows."""
        values = np.array([[row.median, row.worst] for row in rows])
        seen = values[np.isfinite(values) & (values >= 10.0**least)]
        smallest, largest = (float(seen.min()), float(seen.max())) if len(seen) else (10.0**least, 10.0**least)
        low = int(np.floor(np.log10(smallest)))
        high = min(max(int(np.ceil(np.log10(largest))), low + 1), low + _DECADES)
        return cls(least, low, high, largest > 10.0**high, bool(np.isinf(values).any()))

    @property
    def nothing(self) -> float:
        """Where what is too small stands, in decades."""
        return self.low - _ROOM

    @property
    def most(self) -> float:
        """Where what is too large stands."""
        return self.high + _ROOM

    @property
    def none(self) -> float:
        """Where what is infinite stands."""
        return self.high + (3.6 if self.exceeded else 1.2) * _ROOM

    @property
    def ends(self) -> tuple[float, float]:
        """Of the panel."""
        last = self.none if self.endless else self.most if self.exceeded else self.high
        return self.nothing - 0.6 * _ROOM, last + 0.6 * _ROOM

    def place(self, values: FloatArray) -> FloatArray:
        """Where values stand, in decades; NaN of NaN."""
        with np.errstate(divide="ignore"):
            decades = np.log10(values)
        inside = np.where(decades < self.low, self.nothing, np.where(decades > self.high, self.most, decades))
        return np.where(np.isinf(values), self.none, inside)

    def names(self, width: float) -> dict[float, str]:
        """What stands where along a panel of so many inches; no name is near another."""
        decade = width / (self.ends[1] - self.ends[0])
        name, step = (_decade, 1) if decade > _APART else (_power, 2)
        beyond = {self.nothing: f"<{name(self.least)}"}
        beyond |= {self.most: f">{name(self.high)}"} if self.exceeded else {}
        beyond |= {self.none: "none"} if self.endless else {}
        decades = range(self.low + step - 1, self.high + 1, step)
        return beyond | {float(k): name(k) for k in decades if all(abs(k - x) * decade > _NEAR for x in beyond)}


def as_marks(looks: Looks) -> dict[str, dict[str, Any]]:
    """The looks of methods as marks without lines; what has no mark gets a square."""
    plain = {"marker": "s", "markersize": 4.0}
    return {label: {**plain, **look, "linestyle": "none"} for label, look in looks.items()}


def row_height(n_methods: int) -> float:
    """Height of a row, inches."""
    return max(_LEAST, _METHOD * n_methods + _FREE)


def draw_rows(
    figure: Figure, place: tuple[float, float, float], rows: Sequence[Row], looks: Looks, scale: Scale
) -> None:
    """Draw rows of marks: at the median, from where a line runs to the worst.

    Parameters
    ----------
    place : left, top and width, inches from the figure's top left
    looks : of each method's mark, as `as_marks` has them; within a row the first is uppermost
    """
    left, top, width = place
    full, n_methods = figure.get_figheight(), len(looks)
    height = row_height(n_methods) * len(rows)
    axes = figure.add_axes((left / WIDTH, 1.0 - (top + height) / full, width / WIDTH, height / full), facecolor=PAPER)
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.set(xlim=scale.ends, ylim=(len(rows), 0.0), yticks=[])
    axes.set_xticks(*map(list, zip(*scale.names(width).items(), strict=True)))
    axes.tick_params(length=0, labelsize=7.5, labelcolor=MUTED, pad=3, labeltop=True)
    _shade(axes, rows, scale)
    free = _FREE / row_height(n_methods)
    within = free / 2.0 + (1.0 - free) * (np.arange(n_methods) + 0.5) / n_methods
    for i, row in enumerate(rows):
        medians, ends = scale.place(row.median), scale.place(row.worst)
        for y, x, end, look in zip(i + within, medians, ends, looks.values(), strict=True):
            _mark(axes, x, end, y, look, hollow=x == scale.none)


def _mark(axes: Axes, x: float, end: float, y: float, look: Mapping[str, Any], *, hollow: bool) -> None:
    """A method's mark, and the line to its worst."""
    colour = look["color"]
    axes.plot([x, end], [y, y], color=colour, **_WORST, zorder=2.2)
    face = PAPER if hollow else colour
    axes.plot([x], [y], **{**look, "markerfacecolor": face, "markeredgewidth": 0.8 if hollow else 0.3}, zorder=2.5)


def _shade(axes: Axes, rows: Sequence[Row], scale: Scale) -> None:
    """Bands behind every other level, lines at the decades, dotted ones that set apart what has no place among them."""
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
    """What names of rows and their heading take at the left, with what is free beside them, inches."""
    return 0.25 + _LETTER * max(len(line) for name in (*names, heading) for line in _lines(name))


def name_rows(figure: Figure, place: tuple[float, float], rows: Sequence[Row], n_methods: int, heading: str) -> None:
    """Names of the rows below what they are names of.

    Parameters
    ----------
    place : where their panel begins: left and top, inches from the figure's top left
    heading : such as ``outlier magnitude, m/s²``
    """
    left, top = place
    above: dict[str, Any] = {"fontsize": 7.5, "color": MUTED, "va": "bottom", "ha": "right"}
    y = 1.0 - (top - _HEADING) / figure.get_figheight()
    figure.text((left - 0.1) / WIDTH, y, "\n".join(_lines(heading)), **above)
    for i, row in enumerate(rows):
        y = 1.0 - (top + (i + 0.5) * row_height(n_methods)) / figure.get_figheight()
        look: dict[str, Any] = {"fontsize": 7.5, "color": MUTED} if row.quiet else {"fontsize": 8.0, "color": INK}
        figure.text((left - 0.1) / WIDTH, y, "\n".join(_lines(row.name)), va="center", ha="right", **look)


def _lines(name: str) -> list[str]:
    """A name in lines that are not too long."""
    return wrap(name, _LETTERS) or [name]


def _decade(power: int) -> str:
    """``0.01``, ``1``, ``1,000``."""
    return f"{10.0**power:,.{max(0, -power)}f}"


def _power(power: int) -> str:
    """``0.1``, ``1``, ``10``, and ``10⁻³`` or ``10³`` further out."""
    return _decade(power) if abs(power) < 2 else f"10{str(power).translate(_SUPERSCRIPTS)}"
