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
    draw_heading,
    empty_figure,
    header_height,
    name_panel,
    panel,
    write,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["plot_tracking"]

_ROW, _FOOT = 1.5, 0.45
# Room for values with many digits, inches: a parameter moves in its last ones.
_DIGITS = 0.3
# More points than a panel has pixels.
_POINTS = 2000
# Half the width of a 95 % interval, in standard errors.
_INTERVAL = 1.96
_CHANGE: dict[str, Any] = {"color": COLOURS[2], "linewidth": 1.0, "linestyle": (0.0, DASHES[2])}
# Part of the values that may be outside of a panel, as those of the first seconds are, and the free part beyond.
_TAIL, _MARGIN = 0.02, 0.15
# Room for the legend of outliers, over their range.
_LEGEND = 0.5


def plot_tracking(history: History, path: str | Path | None = None, *, title: str | None = None) -> Figure:
    """Figure with a panel per parameter, and one of the fractions of outliers, over time.

    Parameters
    ----------
    history : History
        With an estimate at least.
    path : str or Path, optional
        ``.png``, ``.svg`` or ``.pdf`` file, written completely or not at all; None writes none.
    title : str, optional
        By default the model's name.

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
    text = history.model.name if title is None else title
    entries: list[LegendEntry] = [("estimate, 95 % interval", {"color": COLOURS[0]}), ("change", _CHANGE)]
    header = header_height(entries, text)
    n_rows = len(history.model.parameters) + bool(signals)
    figure = empty_figure(header + _ROW * n_rows + _FOOT)
    draw_heading(figure, entries, text)
    shown = slice(None, None, -(-len(history.time) // _POINTS))
    panels = [
        panel(figure, _DIGITS, header + k * _ROW, WIDTH - _DIGITS, _ROW, last=k == n_rows - 1) for k in range(n_rows)
    ]
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
    half = _INTERVAL * history.standard_errors(name)[shown]
    axes.fill_between(t, y - half, y + half, color=COLOURS[0], alpha=0.2, linewidth=0.0)
    axes.plot(t, y, color=COLOURS[0], linewidth=1.1)
    for change in history.changes:
        if change.parameter == name:
            axes.axvline(change.time, **_CHANGE)
    axes.set_xlim(float(t.min()), float(t.max()) if t.max() > t.min() else float(t.min()) + 1.0)
    axes.set_ylim(*_range(y, half))


def _range(y: FloatArray, half: FloatArray) -> tuple[float, float]:
    """Range of most values and of the usual interval."""
    known = np.isfinite(y)
    if not known.any():
        return 0.0, 1.0
    usual = float(np.median(half[known & np.isfinite(half)])) if (known & np.isfinite(half)).any() else 0.0
    low, high = np.quantile(y[known], [_TAIL, 1.0 - _TAIL])
    low, high = float(low) - usual, float(high) + usual
    margin = _MARGIN * (high - low or abs(high) or 1.0)
    return low - margin, high + margin


def _draw_outliers(axes: Axes, history: History, shown: slice) -> None:
    """Fraction of each signal, named by a legend of its own."""
    for k, name in enumerate(history.signals):
        dashes = DASHES[k // len(COLOURS) % len(DASHES)]
        style: dict[str, Any] = {"color": COLOURS[k % len(COLOURS)], "linestyle": (0.0, dashes) if dashes else "-"}
        axes.plot(history.time[shown], history.outliers(name)[shown], linewidth=0.9, label=name, **style)
    axes.set_ylim(0.0, (1.0 + _LEGEND) * axes.get_ylim()[1])
    axes.set_xlim(*axes.figure.axes[0].get_xlim())
    axes.legend(fontsize=6.5, ncols=5, frameon=False, loc="upper left", labelcolor=INK)
