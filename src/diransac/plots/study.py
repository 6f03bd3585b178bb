"""Figures of studies: tracking errors and failures over the axis."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import SettingsError
from diransac.plain_text import printable
from diransac.plots.figure import (
    COLOURS,
    INK,
    LINE,
    PAPER,
    REFERENCE,
    SOFT,
    WIDTH,
    axes_at,
    check_ending,
    headed_figure,
    name_panel,
    panel,
    write,
    write_at,
    write_caption,
)
from diransac.study.method_choice import TRUE
from diransac.study.summary import Summary, TrackingErrors, summarise
from diransac.text_table import number, superscript

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Inches: height of a row of panels, of a trajectory's name, of the axis below the panels, of a row of failures.
_ROW, _NAME, _AXIS, _CELL = 1.5, 0.24, 0.36, 0.19
_COLUMNS = 3


def plot_study(store: str | Path, path: str | Path | None = None, *, title: str | None = None) -> Figure:
    """Figure of tracking errors over a study's axis: a panel per state, a line per method; Figs. 2 to 4 of the paper.

    Parameters
    ----------
    store : str or Path
        Of a study.
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
        The study has no trajectories to evaluate, or the file cannot be written.

    Notes
    -----
    Points are means over the flights, bars one standard deviation to either side (clipped at 0), dashes medians over
    all trials. A trial without a flight has failed: the fraction of such trials is shown below the panels, and a mean
    that excludes some is hollow. Where means differ by orders of magnitude the scale is linear up to a first decade and
    logarithmic above. No line joins levels that are words.
    """
    check_ending(path)
    summary = summarise(store)
    if not summary.flights:
        raise SettingsError(
            "the study has no trajectories to evaluate; draw its parameter errors with study plot --parameters"
        )
    figure = _drawn(summary, title_of(summary) if title is None else title)
    return write(figure, path)


def _drawn(summary: Summary, title: str) -> Figure:
    caption = [
        f"Mean of the RMS tracking error and one standard deviation, over {n_trials(summary)}; a dash is the median, "
        "for which a failed trial",
        "has an infinite error. A trial without a flight (no plan, or one that diverged) has failed: means exclude it, "
        "and are then hollow.",
        *filter(None, [summary.remark]),
    ]
    names = 0.0 if summary.is_numeric else 0.06 * max(map(len, summary.levels))
    n_rows = -(-len(summary.units) // _COLUMNS)
    heights = {
        shape: _NAME + n_rows * _ROW + _AXIS + 0.31 + 2.0 * names + _CELL * len(_failing(flights.failure_share))
        for shape, flights in summary.flights.items()
    }
    entries = list(method_looks(summary.methods).items())
    figure, top = headed_figure(entries, title, sum(heights.values()) + LINE * len(caption) + 0.14)
    for shape, flights in summary.flights.items():
        _draw_block(figure, summary, shape, flights, top, names)
        top += heights[shape]
    write_caption(figure, top + 0.1, caption)
    return figure


# Panels of one trajectory ------------------------------------------------------------------------------------------
def _draw_block(
    figure: Figure, summary: Summary, shape: str, flights: TrackingErrors, top: float, names: float
) -> None:
    """Draw the panels of a trajectory, whose levels' names have this height, inches, and its failures."""
    write_at(figure, 0.1, top + 0.05, f"Flown: {shape}", fontsize=9.5, color=INK)
    width, states = WIDTH / _COLUMNS, list(summary.units)
    for i, state in enumerate(states):
        row, column = divmod(i, _COLUMNS)
        last = i + _COLUMNS >= len(states)
        axes = panel(figure, column * width, top + _NAME + row * _ROW, width, _ROW, last=last)
        _draw_state(axes, summary, flights, state, _spans_decades(flights))
        name_panel(axes, state, summary.units[state])
    below = top + _NAME + -(-len(states) // _COLUMNS) * _ROW + names
    write_at(figure, WIDTH / 2.0, below + 0.2, axis_label(summary), fontsize=8.5, color=INK, ha="center")
    _draw_failures(figure, below + _AXIS, summary, flights.failure_share, names)


def _draw_state(axes: Axes, summary: Summary, flights: TrackingErrors, state: str, logarithmic: bool) -> None:
    mean, deviation, median = flights.mean(state), flights.deviation(state), flights.median(state)
    spread, hollow = np.nan_to_num(deviation), flights.failure_share > 0.0
    at = _placed(summary)
    for k, (label, look) in enumerate(method_looks(summary.methods).items()):
        x, y, colour = at[:, k], mean[:, k], look["color"]
        if label == TRUE:
            axes.plot(x, y, **look, zorder=1.8)
            continue
        bars = np.vstack([np.minimum(spread[:, k], y), spread[:, k]])
        axes.errorbar(
            x, y, bars, fmt="none", ecolor=colour, elinewidth=0.8, capsize=1.6, capthick=0.8, zorder=2.2 + k / 9
        )
        if summary.is_numeric:
            axes.plot(x, y, **{**look, "marker": ""}, zorder=2.3 + k / 9)
        for is_hollow in (False, True):
            chosen = hollow[:, k] == is_hollow
            face = PAPER if is_hollow else colour
            style = {**look, "linestyle": "none", "markerfacecolor": face, "markeredgewidth": 0.9}
            axes.plot(x[chosen], y[chosen], **style, zorder=2.4 + k / 9)
        dashes: dict[str, Any] = {"linestyle": "none", "marker": "_", "markersize": 7, "markeredgewidth": 1.1}
        finite = np.where(np.isfinite(median[:, k]), median[:, k], np.nan)
        axes.plot(x, finite, color=colour, alpha=0.75, **dashes, zorder=2.1)
    highest = np.fmax(mean + spread, np.where(np.isfinite(median), median, np.nan))
    _scale(axes, mean, highest, logarithmic)
    _name_levels(axes, summary)


def _spans_decades(flights: TrackingErrors) -> bool:
    """True if the means of a state differ so much that a linear scale shows the largest alone."""
    seen = [mean[np.isfinite(mean)] for mean in map(flights.mean, flights.errors)]
    # Ratio of the largest to the median mean above which the scale is logarithmic; its decades above a linear
    # part.
    return any(len(x) and float(x.max()) > 20.0 * float(np.median(x)) for x in seen)


# Axes ----------------------------------------------------------------------------------------------------------------
def _placed(summary: Summary) -> FloatArray:
    """Abscissa of each point (n_levels, n_methods), methods side by side."""
    positions, _ = _positions(summary)
    least = float(np.diff(positions).min()) if len(positions) > 1 else 1.0
    others = [label for label in summary.methods if label != TRUE]
    beside = {label: (i / (len(others) - 1) - 0.5) if len(others) > 1 else 0.0 for i, label in enumerate(others)}
    # Methods are side by side within this fraction of the least distance between levels.
    return np.asarray(positions[:, None] + 0.5 * least * np.array([beside.get(m, 0.0) for m in summary.methods]))


def _positions(summary: Summary) -> tuple[FloatArray, int]:
    """Positions of the levels, and the power of ten by which they are divided."""
    positions = summary.positions
    largest = float(np.abs(positions).max())
    exponent = int(np.floor(np.log10(largest))) if largest > 0.0 and not 1e-3 <= largest < 1e5 else 0
    return positions / 10.0**exponent, exponent


def _name_levels(axes: Axes, summary: Summary) -> None:
    from matplotlib.ticker import MaxNLocator

    positions, labels = _positions(summary)[0], [printable(label) for label in level_labels(summary)]
    margin = 0.6 * (float(np.diff(positions).min()) if len(positions) > 1 else 1.0)
    axes.set_xlim(positions[0] - margin, positions[-1] + margin)
    if not summary.is_numeric:
        axes.set_xticks(positions, labels, rotation=90)
    elif len(positions) <= _COLUMNS * 2:
        axes.set_xticks(positions, labels)
    else:
        axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))


def _scale(axes: Axes, mean: FloatArray, highest: FloatArray, logarithmic: bool) -> None:
    """Set a linear scale from 0, or one that is linear up to a first decade and logarithmic above."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    largest = float(mean[np.isfinite(mean)].max(initial=0.0))
    # Largest value on an axis; Matplotlib adds margins.
    top = min(max(largest, float(np.nan_to_num(highest).max(initial=0.0))), 1e300)
    if not largest > 0.0:
        axes.set_ylim(-0.04, 1.0)
        return
    if logarithmic:
        first = int(np.floor(np.log10(largest))) - 3
        axes.set_yscale("symlog", linthresh=10.0**first, linscale=0.5)
        decades = 10.0 ** np.arange(first, np.floor(np.log10(top)) + 1)
        axes.yaxis.set_major_locator(FixedLocator([0.0, *decades]))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.set_ylim(-0.35 * 10.0**first, 1.6 * top)
    else:
        axes.set_ylim(-0.04 * top, 1.06 * top)
    # 0.01, 5×10⁻⁵, 10⁶; a scale brings a format of its own.
    axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: number(y, 6).removeprefix("1×")))


# Labels and styles ---------------------------------------------------------------------------------------------------
def title_of(summary: Summary) -> str:
    """Name and description of the study, wrapped."""
    text = f"{summary.name}: {summary.description}".removesuffix(": ")
    most = 92  # letters per line
    n_lines = -(-len(text) // most)
    return "\n".join(wrap(text, min(most, len(text) // n_lines + 12)))


def method_looks(methods: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Style of each method's line: its own colour and mark; broad and grey for the true parameters."""
    # The fifth colour is too close to the first where lines cross.
    colours, markers = (*COLOURS[:4], INK, COLOURS[5], "#d55e00"), ("o", "s", "^", "v", "D", "P", "X")
    others = [label for label in methods if label != TRUE]
    looks: dict[str, dict[str, Any]] = {TRUE: {"color": REFERENCE, "linewidth": 2.8, "solid_capstyle": "round"}}
    for i, label in enumerate(others):
        mark = {"marker": markers[i % len(markers)], "markersize": 4.0}
        looks[label] = {"color": colours[i % len(colours)], "linewidth": 0.9, **mark}
    return {label: looks[label] for label in methods}


def axis_label(summary: Summary) -> str:
    """Name of the axis with its unit, ``mass imbalance, 10⁻⁵ kg``."""
    _, exponent = _positions(summary)
    power = f"10{superscript(exponent)}" if exponent else ""
    unit = re.sub(r"\^(-?\d+)", lambda found: superscript(found[1]), summary.unit)
    return f"{summary.axis}, {power} {unit}".rstrip(" ,").replace(",  ", ", ")


def level_labels(summary: Summary) -> list[str]:
    """Labels of the levels for that axis."""
    positions, _ = _positions(summary)
    return [number(x, 6) for x in positions] if summary.is_numeric else list(summary.levels)


def n_trials(summary: Summary) -> str:
    """Number of trials per point: ``50 trials``, or ``2 to 50 trials`` for an unfinished study."""
    counts = summary.ran.sum(axis=2)
    least, most = int(counts.min()), int(counts.max())
    return f"{least} to {most} trials" if least < most else f"{most} trial{'s' * (most != 1)}"


# Failed trials -------------------------------------------------------------------------------------------------------


def _draw_failures(figure: Figure, top: float, summary: Summary, share: FloatArray, names: float) -> None:
    """Draw a table of the fraction of trials without a flight, by method and level, the darker the more there are.

    Parameters
    ----------
    top : inches from the figure's top
    share : (n_levels, n_methods)   fraction of the trials; NaN without trials
    names : height of the names of levels, inches
    """
    from matplotlib.colors import LinearSegmentedColormap

    failing, looks = _failing(share), method_looks(summary.methods)
    if not failing:
        write_at(figure, 0.1, top + 0.05, "No trial failed.", color=INK)
        return
    write_at(figure, 0.1, top + 0.05, "Trials that failed, %", color=INK)
    axes = axes_at(figure, 1.75, top + 0.21 + names, 7.08, _CELL * len(failing))
    shown = np.nan_to_num(share[:, failing].T)
    edges = [np.arange(n + 1) - 0.5 for n in shown.T.shape]
    colours = LinearSegmentedColormap.from_list("failures", [SOFT, "#b42318"])  # of an empty cell, and of failures
    darkness = np.where(shown > 0.0, 0.12 + 0.6 * shown, 0.0)
    axes.pcolormesh(*edges, darkness, cmap=colours, vmin=0.0, vmax=1.0, edgecolors=PAPER, linewidth=1.4)
    axes.grid(visible=False)
    axes.invert_yaxis()
    axes.tick_params(labeltop=True, labelbottom=False)
    axes.set_xticks(range(len(share)), level_labels(summary), rotation=0 if summary.is_numeric else 90)
    axes.set_yticks([])
    for row, k in enumerate(failing):
        label = summary.methods[k]
        write_at(figure, 0.1, top + 0.24 + names + row * _CELL, label, color=looks[label]["color"])
        for level in np.flatnonzero(shown[row] > 0.0).tolist():
            # Whole percent; 0 and 100 only if exact.
            percent = 100 if shown[row, level] == 1.0 else min(99, max(1, round(100.0 * shown[row, level])))
            ink = PAPER if shown[row, level] > 0.5 else INK
            axes.text(level, row, str(percent), fontsize=7.5, color=ink, ha="center", va="center")


def _failing(share: FloatArray) -> list[int]:
    """Indices of the methods with failures."""
    return [int(k) for k in np.flatnonzero((np.nan_to_num(share) > 0.0).any(axis=0))]
