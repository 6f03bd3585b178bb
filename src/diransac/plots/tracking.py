"""Figure of a tracked run: each parameter with its interval over time, its changes, and fractions of outliers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.tracking.estimates import History
from diransac.plots.figure import (
    COLOURS,
    DASHES,
    INK,
    WIDTH,
    LegendEntry,
    check_ending,
    headed_figure,
    name_panel,
    panel,
    write,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INTERVAL = 1.96
"""Half the width of a 95 % interval, in standard errors."""
_CHANGE: dict[str, Any] = {"color": COLOURS[2], "linewidth": 1.0, "linestyle": DASHES[2]}


def plot_tracking(history: History, path: str | Path | None = None) -> Figure:
    """Figure with a panel per parameter, and one of the fractions of outliers, over time.

    Parameters
    ----------
    history : History
        With an estimate at least.
    path : str or Path, optional
        ``.png``, ``.svg`` or ``.pdf`` file, written completely or not at all; None writes none.

    Returns
    -------
    matplotlib.figure.Figure
        Bands are 95 % intervals, dashed lines the changes of a parameter that were reported.

    Raises
    ------
    SettingsError
        The file cannot be written.
    """
    check_ending(path)
    signals = history.signals
    entries: list[LegendEntry] = [("estimate, 95 % interval", {"color": COLOURS[0]}), ("change", _CHANGE)]
    n_rows = len(history.model.parameters) + bool(signals)
    row, digits = 1.5, 0.3  # inches: room for values with many digits, as a parameter moves in its last ones
    figure, header = headed_figure(entries, history.model.name, row * n_rows + 0.45)
    shown = slice(None, None, -(-len(history.time) // 2000))  # more points than a panel has pixels
    panels = [panel(figure, digits, header + k * row, WIDTH - digits, row, last=k == n_rows - 1) for k in range(n_rows)]
    for axes, (name, parameter) in zip(panels, history.model.parameters.items(), strict=False):
        name_panel(axes, name, parameter.unit)
        _draw_parameter(axes, history, name, shown)
    if signals:
        name_panel(panels[-1], "outliers", "fraction in the window")
        _draw_outliers(panels[-1], history, shown)
    panels[-1].set_xlabel("time, s", fontsize=8, color=INK)
    return write(figure, path)


def _draw_parameter(axes: Axes, history: History, name: str, shown: slice) -> None:
    """Estimates with their intervals, and changes."""
    t, y = history.time[shown], history.values(name)[shown]
    half = INTERVAL * history.standard_errors(name)[shown]
    axes.fill_between(t, y - half, y + half, color=COLOURS[0], alpha=0.2, linewidth=0.0)
    axes.plot(t, y, color=COLOURS[0], linewidth=1.1)
    for change in history.changes:
        if change.parameter == name:
            axes.axvline(change.time, **_CHANGE)
    axes.set_xlim(float(t.min()), float(t.max()) if t.max() > t.min() else float(t.min()) + 1.0)
    low, high = usual_range(y, half)
    margin = 0.15 * (high - low or abs(high) or 1.0)
    axes.set_ylim(low - margin, high + margin)


def usual_range(y: FloatArray, half: FloatArray) -> tuple[float, float]:
    """Range of most values of a parameter (n,), without those of the first seconds, and of its usual interval.

    Parameters
    ----------
    y : (n,)   estimates over time
    half : (n,)   half of the width of each interval
    """
    known = np.isfinite(y)
    if not known.any():
        return 0.0, 1.0
    usual = float(np.median(half[known & np.isfinite(half)])) if (known & np.isfinite(half)).any() else 0.0
    low, high = np.quantile(y[known], [0.02, 0.98])
    return float(low) - usual, float(high) + usual


def _draw_outliers(axes: Axes, history: History, shown: slice) -> None:
    """Fraction of each signal, named by a legend of its own."""
    for k, name in enumerate(history.signals):
        look: dict[str, Any] = {
            "color": COLOURS[k % len(COLOURS)],
            "linestyle": DASHES[k // len(COLOURS) % len(DASHES)],
        }
        axes.plot(history.time[shown], history.outliers(name)[shown], linewidth=0.9, label=name, **look)
    axes.set_ylim(0.0, 1.5 * axes.get_ylim()[1])  # with room for the legend
    axes.set_xlim(*axes.figure.axes[0].get_xlim())
    axes.legend(fontsize=6.5, ncols=5, frameon=False, loc="upper left", labelcolor=INK)
