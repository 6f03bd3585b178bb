"""Figure of parameter errors of a study: the largest per method, a row per level."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from diransac.arrays import FloatArray
from diransac.errors import SettingsError
from diransac.plots.figure import (
    INK,
    LINE,
    MUTED,
    PAPER,
    RULE,
    SOFT,
    WIDTH,
    axes_at,
    check_ending,
    headed_figure,
    write,
    write_at,
    write_caption,
)
from diransac.plots.study import axis_label, level_labels, method_looks, n_trials, title_of
from diransac.study.method_choice import TRUE
from diransac.study.store import Store, damage
from diransac.study.summary import ParameterErrors, Summary, summarise
from diransac.text_table import superscript

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LEAST = -3
"""Power of ten, %, below which errors are not resolved."""


def plot_estimates(store: str | Path, path: str | Path | None = None, *, title: str | None = None) -> Figure:
    """Figure of the error of the worst parameter: a row per level, a mark per method, on a logarithmic axis in %.

    Parameters
    ----------
    store : str or Path
        Of a study that evaluates parameters.
    path : str or Path, optional
        ``.png``, ``.svg`` or ``.pdf`` file, written completely or not at all; None writes none.
    title : str, optional
        By default the study's name and description.

    Returns
    -------
    matplotlib.figure.Figure
        The same store gives the same file.

    Raises
    ------
    StudyError
        There is no such store, or it has no rows.
    SettingsError
        The study evaluates no parameters, or the file cannot be written.

    Notes
    -----
    Marks are medians over the trials of a level; a line runs from each to the largest value. Errors are relative to the
    pseudo-true parameters, the best of the model in that flight. Where these differ from the true ones by more than
    0.2 %, a second row has the errors relative to the latter. A trial without an estimate has an infinite error. The
    method ``true`` has a mark where its parameters are not the pseudo-true ones.
    """
    check_ending(path)
    summary = summarise(store)
    figure = _drawn(summary, title_of(summary) if title is None else title)
    return write(figure, path)


def evaluates_parameters(store: str | Path) -> bool:
    """True if a store's study evaluates parameters.  Raises StudyError: there is no such store, or it is damaged."""
    with Store.existing(store) as kept, damage(Path(store)):
        return bool(kept.configuration["study"].get("evaluation.parameters"))


def methods_and_errors(summary: Summary, parameter: str | None = None) -> tuple[list[str], list[MarkRow]]:
    """Methods and rows of their errors at each level, %.

    The method ``true`` is left out where its parameters are the pseudo-true ones, unless it is the only one.

    Parameters
    ----------
    parameter : its errors; None: the largest over all parameters

    Raises SettingsError: the study evaluates no parameters.
    """
    estimates = summary.estimates
    if estimates is None:
        raise SettingsError("the study evaluates no parameters; run one with evaluation.parameters = true")
    best = estimates.worst if parameter is None else estimates.errors[parameter]
    own = estimates.worst_to_true if parameter is None else estimates.errors_to_true[parameter]
    shows_true = estimates.differs.any() or summary.methods == (TRUE,)
    kept = [k for k, label in enumerate(summary.methods) if label != TRUE or shows_true]
    is_true = np.array([summary.methods[k] == TRUE for k in kept])
    rows = []
    for i, name in enumerate(level_labels(summary)):
        rows.append(_row(name, best[i, kept], is_true & ~estimates.differs[i]))
        if estimates.differs[i]:
            rows.append(_row("relative to the true ones", own[i, kept], is_true, quiet=True))
    return [summary.methods[k] for k in kept], rows


def _row(name: str, errors: FloatArray, hidden: npt.NDArray[np.bool_], *, quiet: bool = False) -> MarkRow:
    """Row of the errors (n_methods, n_trials) that are not hidden."""
    shown = 100.0 * np.where(hidden[:, None], np.nan, errors)[None]
    return MarkRow(name, ParameterErrors.median(shown)[0], ParameterErrors.largest(shown)[0], quiet)


def _drawn(summary: Summary, title: str) -> Figure:
    methods, rows = methods_and_errors(summary)
    every = _as_marks(method_looks(summary.methods))
    looks = {label: every[label] for label in methods}
    scale, heading = LogAxis.of(rows), axis_label(summary)
    caption = [
        f"Marks are medians over {n_trials(summary)} of a level, lines end at the largest. Errors are relative to the "
        "pseudo-true parameters, the best of the",
        "model in that flight; where those differ from the true ones, a second row has the errors relative to the "
        "latter." + " none: no estimate, counted as an infinite error." * scale.endless,
        *filter(None, [summary.remark]),
    ]
    # Inches: name of the panel with the values above its rows, and values below.
    above, below = 0.42, 0.3
    height = _row_height(len(methods)) * len(rows)
    figure, header = headed_figure(list(looks.items()), title, above + height + below + LINE * len(caption) + 0.08)
    top = header + above
    # The names of rows and their heading with margins, of 0.059 inches a letter.
    left = 0.25 + 0.059 * max(len(line) for name in (*(row.name for row in rows), heading) for line in _lines(name))
    write_at(figure, left, header, "Error of the worst parameter, %", fontsize=9.5, color=INK)
    _name_rows(figure, (left, top), rows, len(methods), heading)
    _draw_rows(figure, (left, top, WIDTH - left - 0.12), rows, looks, scale)
    write_caption(figure, top + height + below, caption)
    return figure


# Rows of marks -------------------------------------------------------------------------------------------------------
Looks = Mapping[str, Mapping[str, Any]]

# Margin of a row, inches.
_FREE = 0.075
# Distance of the places beyond the ends of an axis, in decades.
_ROOM = 0.6


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

    low: int
    high: int
    exceeded: bool
    endless: bool

    @classmethod
    def of(cls, rows: Sequence[MarkRow]) -> LogAxis:
        """Axis for these rows."""
        values = np.array([[row.median, row.worst] for row in rows])
        seen = values[np.isfinite(values) & (values >= 10.0**LEAST)]
        smallest, largest = (float(seen.min()), float(seen.max())) if len(seen) else (10.0**LEAST, 10.0**LEAST)
        low = int(np.floor(np.log10(smallest)))
        high = min(max(int(np.ceil(np.log10(largest))), low + 1), low + 6)
        return cls(low, high, largest > 10.0**high, bool(np.isinf(values).any()))

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
        name, step = (_decade, 1) if decade > 0.5 else (_power, 2)
        beyond = {self.nothing: f"<{name(LEAST)}"}
        beyond |= {self.most: f">{name(self.high)}"} if self.exceeded else {}
        beyond |= {self.none: "none"} if self.endless else {}
        decades = range(self.low + step - 1, self.high + 1, step)
        return beyond | {float(k): name(k) for k in decades if all(abs(k - x) * decade > 0.32 for x in beyond)}


def _as_marks(looks: Looks) -> dict[str, dict[str, Any]]:
    """Styles of methods as marks without lines; the default mark is a square."""
    plain = {"marker": "s", "markersize": 4.0}
    return {label: {**plain, **look, "linestyle": "none"} for label, look in looks.items()}


def _row_height(n_methods: int) -> float:
    """Height of a row, inches."""
    return max(0.24, 0.044 * n_methods + _FREE)


def _draw_rows(
    figure: Figure, place: tuple[float, float, float], rows: Sequence[MarkRow], looks: Looks, scale: LogAxis
) -> None:
    """Draw rows of marks at the medians, with lines to the largest values.

    Parameters
    ----------
    place : left, top and width, inches from the figure's top left
    looks : style of each method's mark, from `_as_marks`; the first is at the top of a row
    """
    left, top, width = place
    n_methods = len(looks)
    axes = axes_at(figure, left, top, width, _row_height(n_methods) * len(rows))
    axes.grid(visible=False)
    axes.set(facecolor=PAPER, xlim=scale.ends, ylim=(len(rows), 0.0), yticks=[])
    axes.set_xticks(*map(list, zip(*scale.names(width).items(), strict=True)))
    axes.tick_params(labeltop=True)
    _shade(axes, rows, scale)
    free = _FREE / _row_height(n_methods)
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
    apart = [scale.none - 0.6 * _ROOM] * scale.endless + [scale.low - 0.4 * _ROOM] * (scale.low > LEAST)
    if apart:
        axes.vlines(apart, 0, len(rows), color=MUTED, linewidth=0.7, linestyle=":", zorder=1.0)


def _name_rows(
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
        middle = top + (i + 0.5) * _row_height(n_methods)
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
