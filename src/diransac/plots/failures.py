"""The strip below a study's panels: which share of the trials has no flight, by method and level."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.plots.layout import WIDTH
from diransac.plots.palette import INK, MUTED, SOFT

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_failures", "failures_height"]


FAILED = "#b42318"
"""The report's colour of what is bad."""

# Inches: a row of cells, what names the strip, what is free below it; where cells begin and end.
_ROW, _NAME, _FREE, _LEFT, _RIGHT = 0.19, 0.21, 0.1, 1.75, 8.83


def failures_height(share: FloatArray) -> float:
    """Height of the strip, inches: a row a method that failed anywhere, one line if none did."""
    return _NAME + _FREE + _ROW * len(_failing(share))


def draw_failures(
    figure: Figure, top: float, methods: Sequence[tuple[str, str]], levels: Sequence[str], share: FloatArray
) -> None:
    """Draw the strip.

    Parameters
    ----------
    top : inches from the figure's top
    methods : label and colour of each
    levels : what they are called
    share : (n_levels, n_methods) of the trials; NaN where there are none
    """
    rows = _failing(share)
    text = "Trials that failed, %" if rows else "No trial failed."
    _write(figure, 0.1, top + 0.05, text, color=INK, ha="left")
    width = (_RIGHT - _LEFT) / len(levels)
    if rows:
        for i, level in enumerate(levels):
            _write(figure, _LEFT + (i + 0.5) * width, top + 0.05, level, color=MUTED, ha="center")
    for line, k in enumerate(rows):
        y = top + _NAME + line * _ROW
        _write(figure, 0.1, y + 0.03, methods[k][0], color=methods[k][1], ha="left")
        for i, fraction in enumerate(share[:, k]):
            _draw_cell(figure, _LEFT + i * width, y, width, fraction)


def _failing(share: FloatArray) -> list[int]:
    """The methods that failed anywhere."""
    return [int(k) for k in np.flatnonzero((np.nan_to_num(share) > 0.0).any(axis=0))]


def _draw_cell(figure: Figure, left: float, top: float, width: float, fraction: float) -> None:
    """A cell that is the darker the more failed, with the percentage where any did."""
    from matplotlib.patches import Rectangle

    full = figure.get_figheight()
    place = ((left + 0.015) / WIDTH, 1.0 - (top + _ROW - 0.02) / full)
    size = ((width - 0.03) / WIDTH, (_ROW - 0.02) / full)
    look: dict[str, Any] = {"transform": figure.transFigure, "linewidth": 0.0}
    figure.add_artist(Rectangle(place, *size, facecolor=SOFT, **look))
    if not fraction > 0.0:
        return
    figure.add_artist(Rectangle(place, *size, facecolor=FAILED, alpha=0.12 + 0.6 * fraction, **look))
    dark = fraction > 0.5
    _write(figure, left + width / 2.0, top + 0.025, _percent(fraction), color="#ffffff" if dark else INK, ha="center")


def _percent(fraction: float) -> str:
    """Whole percent, never 0 of some and never 100 of not all."""
    return str(100 if fraction == 1.0 else min(99, max(1, round(100.0 * fraction))))


def _write(figure: Figure, x: float, top: float, text: str, **look: Any) -> None:
    figure.text(x / WIDTH, 1.0 - top / figure.get_figheight(), text, fontsize=7.5, va="top", **look)
