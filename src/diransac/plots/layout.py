"""Where panels stand: rectangles in inches, so that every panel's size is known before anything is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from diransac.plots.flights import Range, extent
from diransac.plots.palette import INK, MUTED, PAPER, RULE, SOFT

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["WIDTH", "inches", "laid_out", "name_panel", "panel"]

WIDTH = 9.0
"""Of every picture, inches."""

# Inches: a row's height; around a panel, for values on its left, its name above and the times below the last one.
_ROW, _VALUES, _NAME, _TIMES, _GAP, _EDGE = 1.12, 0.46, 0.25, 0.24, 0.06, 0.17
# A path beside the states takes this width and rows at most; one above them, for it is so much wider than high, all.
_PATH_WIDTH, _PATH_ROWS, _WIDE, _PATH_HEIGHT = 3.75, 3, 2.2, 2.3
_STEPS = (1, 2, 5, 10)


def laid_out(
    states: Sequence[str], inputs: Sequence[str], box: tuple[Range, Range] | None, header: float
) -> tuple[Figure, dict[str, Axes], Axes | None]:
    """An empty figure, a panel a signal, and one for the path: beside the states, or above them if it is wide.

    Parameters
    ----------
    box : what the path needs in x and z; None for no path
    header : height that is left free at the top, inches
    """
    from matplotlib.figure import Figure

    columns = _columns(states)
    n_rows, n_input_rows = max(map(len, columns)), -(-len(inputs) // 2)
    wide = box is not None and extent(box[0]) > _WIDE * extent(box[1])
    top = header + (_PATH_HEIGHT + _TIMES if wide else 0.0)
    below = top + n_rows * _ROW + _TIMES
    figure = Figure(figsize=(WIDTH, below + n_input_rows * _ROW + _TIMES + _GAP), facecolor=PAPER)

    path = None
    if box is not None:
        rows = min(n_rows, _PATH_ROWS)
        path = panel(figure, 0.0, header, *((WIDTH, _PATH_HEIGHT) if wide else (_PATH_WIDTH, rows * _ROW)))
    left = _PATH_WIDTH if box is not None and not wide else 0.0
    width = (WIDTH - left) / 2.0
    panels = {}
    for column, names in enumerate(columns):
        for row, name in enumerate(names):
            place = (left + column * width, top + row * _ROW, width, _ROW)
            panels[name] = panel(figure, *place, last=row == len(names) - 1)
    for i, name in enumerate(inputs):
        alone = i == len(inputs) - 1 and i % 2 == 0
        place = (i % 2 * WIDTH / 2.0, below + i // 2 * _ROW, WIDTH if alone else WIDTH / 2.0, _ROW)
        panels[name] = panel(figure, *place, last=i >= len(inputs) - 2)
    return figure, panels, path


def _columns(states: Sequence[str]) -> tuple[Sequence[str], Sequence[str]]:
    """Coordinates and velocities, as their names tell; the first and second half where they don't."""
    velocities = [name for name in states if name.endswith("_dot")]
    if not velocities or len(velocities) == len(states):
        half = -(-len(states) // 2)
        return states[:half], states[half:]
    return [name for name in states if name not in velocities], velocities


def panel(figure: Figure, left: float, top: float, width: float, height: float, *, last: bool = True) -> Axes:
    """A calm panel in a rectangle, inches from the figure's top left; only the last of a column names its times."""
    from matplotlib.ticker import MaxNLocator

    full = figure.get_figheight()
    inner_width, inner_height = width - _VALUES - _EDGE, height - _NAME - _GAP
    bottom = full - top - _NAME - inner_height
    place = ((left + _VALUES) / WIDTH, bottom / full, inner_width / WIDTH, inner_height / full)
    axes = figure.add_axes(place, facecolor=SOFT)
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.tick_params(length=0, labelsize=7.5, labelcolor=MUTED, labelbottom=last, pad=3)
    axes.grid(color=RULE, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.yaxis.set_major_locator(MaxNLocator(max(4, round(1.7 * inner_height)), steps=_STEPS))
    axes.xaxis.set_major_locator(MaxNLocator(max(4, round(2.2 * inner_width)), steps=_STEPS))
    return axes


def name_panel(axes: Axes, name: str, detail: str) -> None:
    """A panel's name, and in a quieter colour its unit."""
    axes.set_title(name, loc="left", fontsize=8.5, color=INK, pad=4)
    axes.set_title(detail, loc="right", fontsize=7.5, color=MUTED, pad=4)


def inches(axes: Axes) -> tuple[float, float]:
    """Width and height of a panel."""
    return axes.bbox.width / axes.figure.dpi, axes.bbox.height / axes.figure.dpi
