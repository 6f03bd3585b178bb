"""A picture's heading: its title, and a legend in as many lines as it needs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from diransac.plots.layout import WIDTH
from diransac.plots.palette import INK

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Entry", "draw_heading", "header_height"]

# Inches: the title, a line of the legend, what is free around them.
_TITLE, _LEGEND_LINE, _FREE = 0.27, 0.19, 0.16
# Inches: in the legend, a letter of a label, and the sample of a line with what is free around it.
_LETTER, _SAMPLE = 0.075, 0.65

Entry = tuple[str, dict[str, Any]]
"""A label, and the look of its line."""


def _columns(entries: Sequence[Entry]) -> int:
    """How many entries a line of the legend holds."""
    widths = [_SAMPLE + _LETTER * len(label) for label, _ in entries]
    return len(entries) if sum(widths) < WIDTH - 0.2 else max(1, int((WIDTH - 0.2) / max(widths)))


def header_height(entries: Sequence[Entry], title: str | None) -> float:
    """Height of title and legend, inches."""
    lines = -(-len(entries) // _columns(entries))
    return _FREE + _LEGEND_LINE * lines + _title_height(title)


def _title_height(title: str | None) -> float:
    return _TITLE * len(title.splitlines()) if title else 0.0


def draw_heading(figure: Figure, entries: Sequence[Entry], title: str | None) -> None:
    """Title and legend at the top of a figure, in the height that `header_height` says."""
    from matplotlib.lines import Line2D

    inch = 1.0 / figure.get_figheight()
    top = 1.0 - _FREE / 2.0 * inch
    if title:
        figure.text(0.08 / WIDTH, top, title, fontsize=11.5, fontweight="bold", color=INK, va="top")
        top -= _title_height(title) * inch
    n_columns = _columns(entries)
    in_lines = [entry for column in range(n_columns) for entry in entries[column::n_columns]]
    figure.legend(
        handles=[Line2D([], [], label=label, **style) for label, style in in_lines],
        loc="upper left",
        bbox_to_anchor=(0.06 / WIDTH, top),
        ncols=n_columns,
        frameon=False,
        fontsize=8.5,
        labelcolor=INK,
        borderaxespad=0.0,
        borderpad=0.2,
        handlelength=2.6,
        columnspacing=1.8,
    )
