"""Pictures of studies: tracking errors over the axis, and the paths that were flown."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import SettingsError
from diransac.plots.failures import draw_failures, failures_height
from diransac.plots.flight_rows import draw_flight_rows, flight_rows_height
from diransac.plots.heading import draw_heading, header_height
from diransac.plots.layout import WIDTH, name_panel, panel
from diransac.plots.palette import COLOURS, INK, MUTED, PAPER, REFERENCE
from diransac.plots.rows import as_marks
from diransac.plots.writing import checked_ending, write
from diransac.study.specification import TRUE
from diransac.study.summary import Summary, TrackingErrors, summarise

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["axis_label", "level_labels", "method_looks", "n_trials", "plot_study", "title_of"]


# Inches: a row of panels, what names a trajectory, the axis below the panels, a line of the caption.
_ROW, _NAME, _AXIS, _LINE = 1.5, 0.24, 0.36, 0.155
_COLUMNS = 3
# Methods stand side by side within this share of the least distance between levels.
_SPREAD = 0.5
# Means this many times the median mean call for a logarithmic scale, of so many decades above a linear beginning.
_MANY, _DECADES = 20.0, 3
# Letters of a title's line; lines of one title differ by so many at most.
_LETTERS, _RAGGED = 92, 12

# The palette's fifth colour is too near the first where lines cross.
_COLOURS = (*COLOURS[:4], INK, COLOURS[5], "#d55e00")
_MARKERS = ("o", "s", "^", "v", "D", "P", "X")
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_CAPTION = (
    "Mean of the RMS tracking error and one standard deviation, over {trials}; a dash is the median, for which "
    "a failed trial",
    "has an infinite error. Without a flight (no plan, or one that diverged) a trial has failed: means leave it out, "
    "and are then hollow.",
)
_CAPTION_OF_ROWS = ("Marks are medians of the RMS tracking error over {trials} of a level, lines end at the worst.",)
_NONE = "none: no flight (no plan, or one that diverged), which is worse than any."


def plot_study(store: str | Path, path: str | Path | None = None, *, title: str | None = None) -> Figure:
    """Tracking errors over a study's axis, as in Figs. 2 to 4 of the paper: a panel a state, a line a method.

    Parameters
    ----------
    store : of a study
    path : ``.png``, ``.svg`` or ``.pdf`` to be written, whole or not at all; None writes nothing
    title : None: the study's name and description

    Points are means over the flights there are, bars one standard deviation to either side (errors are not negative:
    they end at 0), dashes medians over all trials.  A trial that has no flight fails and has no error: below the panels
    stands which share of the trials that is, and a mean that leaves some out is hollow, for these are the worst.
    Where means differ by orders of magnitude the scale is linear up to a first decade, and logarithmic from there.
    Levels that are words are rows, with a panel a coordinate on a logarithmic axis: marks are medians over all trials,
    lines end at the worst.

    Returns a Matplotlib figure. The same rows give the same file.
    Raises StudyError: there is no such store, or it has no rows; SettingsError: its study flies nothing with what was
    identified, or the file cannot be written.
    """
    if path is not None:
        checked_ending(Path(path))
    summary = summarise(store)
    if not summary.flights:
        raise SettingsError(
            "the study has no trajectories to evaluate; draw its parameters, as study plot --parameters does"
        )
    figure = _drawn(summary, title_of(summary) if title is None else title)
    if path is not None:
        write(figure, Path(path))
    return figure


def _drawn(summary: Summary, title: str) -> Figure:
    from matplotlib.figure import Figure

    looks = _looks(summary)
    entries = list(looks.items())
    header = header_height(entries, title)
    heights = [_block_height(summary, flights) for flights in summary.flights.values()]
    words = _caption(summary)
    caption = _LINE * len(words) + 0.14
    figure = Figure(figsize=(WIDTH, header + sum(heights) + caption), facecolor=PAPER)
    top = header
    for (shape, flights), height in zip(summary.flights.items(), heights, strict=True):
        _draw_block(figure, summary, shape, flights, top)
        top += height
    draw_heading(figure, entries, title)
    for row, line in enumerate(words):
        y = (caption - 0.04 - row * _LINE) / figure.get_figheight()
        figure.text(0.1 / WIDTH, y, line, fontsize=7.5, color=MUTED, va="top")
    return figure


def _caption(summary: Summary) -> list[str]:
    """Lines that say what is drawn, and what is missing."""
    some_failed = any(flights.failed.any() for flights in summary.flights.values())
    of_rows = [*_CAPTION_OF_ROWS, _NONE if some_failed else ""]
    lines = [*(_CAPTION if summary.is_numeric else of_rows), summary.remark]
    return [line.format(trials=n_trials(summary)) for line in lines if line]


# A trajectory: panels, and what failed ------------------------------------------------------------------------------
def _looks(summary: Summary) -> dict[str, dict[str, Any]]:
    """Lines, or marks where levels are words, which no line joins: they are rows."""
    looks = method_looks(summary.methods)
    return looks if summary.is_numeric else as_marks(looks)


def _block_height(summary: Summary, flights: TrackingErrors) -> float:
    if not summary.is_numeric:
        return _NAME + flight_rows_height(flights, len(summary.levels), len(summary.methods))
    n_rows = -(-len(summary.units) // _COLUMNS)
    return _NAME + n_rows * _ROW + _AXIS + failures_height(flights.failure_share)


def _draw_block(figure: Figure, summary: Summary, shape: str, flights: TrackingErrors, top: float) -> None:
    full = figure.get_figheight()
    figure.text(0.1 / WIDTH, 1.0 - (top + 0.05) / full, f"Flown: {shape}", fontsize=9.5, color=INK, va="top")
    if not summary.is_numeric:
        names = level_labels(summary), axis_label(summary)
        draw_flight_rows(figure, top + _NAME, flights, summary.units, *names, _looks(summary))
        return
    width, states = WIDTH / _COLUMNS, list(summary.units)
    for i, state in enumerate(states):
        row, column = divmod(i, _COLUMNS)
        last = i + _COLUMNS >= len(states)
        axes = panel(figure, column * width, top + _NAME + row * _ROW, width, _ROW, last=last)
        _draw_state(axes, summary, flights, state, _spans_decades(flights))
        name_panel(axes, state, summary.units[state])
    below = top + _NAME + -(-len(states) // _COLUMNS) * _ROW
    figure.text(0.5, 1.0 - (below + 0.2) / full, axis_label(summary), fontsize=8.5, color=INK, va="top", ha="center")
    rows = [(label, look["color"]) for label, look in method_looks(summary.methods).items()]
    draw_failures(figure, below + _AXIS, rows, level_labels(summary), flights.failure_share)


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
        axes.plot(x, y, **{**look, "marker": ""}, zorder=2.3 + k / 9)
        for is_hollow in (False, True):
            chosen = hollow[:, k] == is_hollow
            face = PAPER if is_hollow else colour
            style = {**look, "linestyle": "none", "markerfacecolor": face, "markeredgewidth": 0.9}
            axes.plot(x[chosen], y[chosen], **style, zorder=2.4 + k / 9)
        dashes: dict[str, Any] = {
            "linestyle": "none",
            "marker": "_",
            "markersize": 7,
            "markeredgewidth": 1.1,
            "alpha": 0.75,
        }
        axes.plot(x, np.where(np.isfinite(median[:, k]), median[:, k], np.nan), color=colour, **dashes, zorder=2.1)
    highest = np.fmax(mean + spread, np.where(np.isfinite(median), median, np.nan))
    _scale(axes, mean, highest, logarithmic)
    _name_levels(axes, summary)


def _spans_decades(flights: TrackingErrors) -> bool:
    """Whether the means of some state differ so much that a linear scale shows the largest alone."""
    seen = [mean[np.isfinite(mean)] for mean in map(flights.mean, flights.errors)]
    return any(len(x) and float(x.max()) > _MANY * float(np.median(x)) for x in seen)


# Axes ----------------------------------------------------------------------------------------------------------------
def _placed(summary: Summary) -> FloatArray:
    """Where each point stands, (n_levels, n_methods): methods side by side, so that their bars can be told apart."""
    positions, _ = _positions(summary)
    least = float(np.diff(positions).min()) if len(positions) > 1 else 1.0
    others = [label for label in summary.methods if label != TRUE]
    beside = {label: (i / (len(others) - 1) - 0.5) if len(others) > 1 else 0.0 for i, label in enumerate(others)}
    return np.asarray(positions[:, None] + _SPREAD * least * np.array([beside.get(m, 0.0) for m in summary.methods]))


def _positions(summary: Summary) -> tuple[FloatArray, int]:
    """Positions of the levels, and the power of ten by which they are divided."""
    positions = summary.positions
    largest = float(np.abs(positions).max())
    exponent = int(np.floor(np.log10(largest))) if largest > 0.0 and not 1e-3 <= largest < 1e5 else 0
    return positions / 10.0**exponent, exponent


def _name_levels(axes: Axes, summary: Summary) -> None:
    from matplotlib.ticker import MaxNLocator

    positions, _ = _positions(summary)
    margin = 0.6 * (float(np.diff(positions).min()) if len(positions) > 1 else 1.0)
    axes.set_xlim(positions[0] - margin, positions[-1] + margin)
    if len(positions) <= _COLUMNS * 2:
        axes.set_xticks(positions, level_labels(summary))
    else:
        axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))


def _scale(axes: Axes, mean: FloatArray, highest: FloatArray, logarithmic: bool) -> None:
    """Linear from 0, or only up to a first decade and logarithmic from there."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    largest = float(mean[np.isfinite(mean)].max(initial=0.0))
    top = max(largest, float(np.nan_to_num(highest).max(initial=0.0)))
    if not largest > 0.0:
        axes.set_ylim(-0.04, 1.0)
        return
    axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: _tick(y)))
    if not logarithmic:
        axes.set_ylim(-0.04 * top, 1.06 * top)
        return
    first = int(np.floor(np.log10(largest))) - _DECADES
    axes.set_yscale("symlog", linthresh=10.0**first, linscale=0.5)
    decades = 10.0 ** np.arange(first, np.floor(np.log10(top)) + 1)
    axes.yaxis.set_major_locator(FixedLocator([0.0, *decades]))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_ylim(-0.35 * 10.0**first, 1.6 * top)


def _tick(y: float) -> str:
    """``0.01``, ``5×10⁻⁵``, ``10⁶``."""
    mantissa, _, exponent = f"{y:.6g}".partition("e")
    power = f"10{str(int(exponent)).translate(_SUPERSCRIPTS)}" if exponent else ""
    return mantissa.replace("-", "−") if not power else power if mantissa == "1" else f"{mantissa}×{power}"


# Words and looks -----------------------------------------------------------------------------------------------------
def title_of(summary: Summary) -> str:
    """The study's name and what it is about, in as many lines as it needs."""
    text = f"{summary.name}: {summary.description}".removesuffix(": ")
    n_lines = -(-len(text) // _LETTERS)
    return "\n".join(wrap(text, min(_LETTERS, len(text) // n_lines + _RAGGED)))


def method_looks(methods: Sequence[str]) -> dict[str, dict[str, Any]]:
    """How each method's line looks: its own colour and mark; broad and grey of the true parameters."""
    others = [label for label in methods if label != TRUE]
    looks: dict[str, dict[str, Any]] = {TRUE: {"color": REFERENCE, "linewidth": 2.8, "solid_capstyle": "round"}}
    for i, label in enumerate(others):
        mark = {"marker": _MARKERS[i % len(_MARKERS)], "markersize": 4.0}
        looks[label] = {"color": _COLOURS[i % len(_COLOURS)], "linewidth": 0.9, **mark}
    return {label: looks[label] for label in methods}


def axis_label(summary: Summary) -> str:
    """The axis with its unit, ``mass imbalance, 10⁻⁵ kg``."""
    _, exponent = _positions(summary)
    power = f"10{str(exponent).translate(_SUPERSCRIPTS)}" if exponent else ""
    unit = re.sub(r"\^(-?\d+)", lambda found: found[1].translate(_SUPERSCRIPTS), summary.unit)
    return f"{summary.axis}, {power} {unit}".rstrip(" ,").replace(",  ", ", ")


def level_labels(summary: Summary) -> list[str]:
    """What the levels are called beside that label."""
    positions, _ = _positions(summary)
    return [f"{x:.6g}".replace("-", "−") for x in positions] if summary.is_numeric else list(summary.levels)


def n_trials(summary: Summary) -> str:
    """How many trials a point has: ``50 trials``, ``2 to 50 trials`` where some are yet to run."""
    counts = summary.ran.sum(axis=2)
    least, most = int(counts.min()), int(counts.max())
    return f"{least} to {most} trials" if least < most else f"{most} trial{'s' * (most != 1)}"
