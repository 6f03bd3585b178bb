"""How flights were tracked at levels that are words: a row a level, a panel a coordinate."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from diransac.plots.layout import WIDTH
from diransac.plots.palette import INK, MUTED
from diransac.plots.rows import Row, Scale, draw_rows, name_rows, names_width, row_height
from diransac.study.summary import TrackingErrors

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_flight_rows", "flight_rows_height"]

_COLUMNS = 3
# Inches: between panels, the name of a panel with the values above its rows, the values below them.
_GAP, _ABOVE, _BELOW = 0.26, 0.42, 0.3
_LEAST = -3
"""Power of ten, m or rad: what is less is shown as nothing."""


def flight_rows_height(flights: TrackingErrors, n_levels: int, n_methods: int) -> float:
    """Height of the panels, inches."""
    return -(-len(_shown(flights.errors)) // _COLUMNS) * (_ABOVE + n_levels * row_height(n_methods) + _BELOW)


def draw_flight_rows(
    figure: Figure,
    top: float,
    flights: TrackingErrors,
    units: Mapping[str, str],
    levels: Sequence[str],
    axis: str,
    looks: Mapping[str, Mapping[str, Any]],
) -> None:
    """Draw median and worst RMS tracking error over all trials, of which one that failed is worse than any.

    Parameters
    ----------
    top : inches from the figure's top
    units : of the states
    levels, axis : what they are called, and what varies from one to another
    looks : of each method
    """
    full, height, beside = figure.get_figheight(), len(levels) * row_height(len(looks)), names_width(levels, axis)
    width = (WIDTH - beside - 0.1) / _COLUMNS
    for i, state in enumerate(_shown(flights.errors)):
        row, column = divmod(i, _COLUMNS)
        left, above = beside + column * width, top + row * (_ABOVE + height + _BELOW)
        medians, worst = flights.median(state), flights.largest(state)
        rows = [Row(name, *pair) for name, *pair in zip(levels, medians, worst, strict=True)]
        y = 1.0 - (above + 0.02) / full
        figure.text(left / WIDTH, y, state, fontsize=8.5, color=INK, va="top")
        figure.text((left + width - _GAP) / WIDTH, y, units[state], fontsize=7.5, color=MUTED, va="top", ha="right")
        if column == 0:
            name_rows(figure, (left, above + _ABOVE), rows, len(looks), axis)
        draw_rows(figure, (left, above + _ABOVE, width - _GAP), rows, looks, Scale.of(rows, _LEAST))


def _shown(states: Iterable[str]) -> list[str]:
    """The coordinates; velocities tell the same once more, and are in tables."""
    names = list(states)
    return [name for name in names if not name.endswith("_dot")] or names
