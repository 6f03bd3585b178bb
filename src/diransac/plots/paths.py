"""Figure of the paths flown in a study, all trials superimposed: Fig. 5 of the paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from diransac.errors import SettingsError
from diransac.plots.figure import (
    INK,
    REFERENCE,
    WIDTH,
    Range,
    axes_at,
    check_ending,
    extent,
    headed_figure,
    round_step,
    write,
    write_at,
)
from diransac.plots.study import method_looks, title_of
from diransac.study.method_choice import TRUE
from diransac.study.reading import paths
from diransac.study.store import Store
from diransac.study.summary import Summary, summarise

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Path2 = npt.NDArray[np.float32]
_Paths = Mapping[str, Mapping[str, list[Path2]]]

_DASHES = (0.0, (4.0, 3.0))


def plot_paths(
    store: str | Path, path: str | Path | None = None, *, level: str | None = None, title: str | None = None
) -> Figure:
    """Figure of the paths of all trials at one level: a row of panels per trajectory, a panel per method.

    Parameters
    ----------
    store : str or Path
        Of a study that keeps paths.
    path : str or Path, optional
        ``.png``, ``.svg`` or ``.pdf`` file, written completely or not at all; None writes none.
    level : str, optional
        Default: the only level with paths.
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
        It has no paths at that level, or the file cannot be written.

    Notes
    -----
    The path flown with the true parameters is broad and grey, if the study has the method ``true``; dashed are the
    references of the flights, which each method planned with what it had identified. The panels cover the true path and
    a margin; below each are the numbers of flights that leave it and of failed trials.
    """
    check_ending(path)
    summary = summarise(store)
    chosen = _chosen(levels_with_paths(store), level)
    flown, planned = (
        {shape: _at(paths(store, shape, planned=which), chosen, summary.methods) for shape in summary.flights}
        for which in (False, True)
    )
    figure = _drawn(summary, chosen, flown, planned, title_of(summary) if title is None else title)
    return write(figure, path)


def levels_with_paths(store: str | Path) -> list[str]:
    """Levels with paths in a store.  Raises StudyError: there is no such store."""
    with Store.existing(store) as kept:
        query = "SELECT DISTINCT level FROM trials JOIN asked USING (level, trial, method) WHERE paths NOT NULL"
        return [level for (level,) in kept.select(query)]


def _chosen(levels: Sequence[str], level: str | None) -> str:
    if not levels:
        raise SettingsError("the store keeps no paths; run the study with evaluation.keep_paths = true")
    if level is None and len(levels) == 1:
        return levels[0]
    if level is None or level not in levels:
        asked = "paths were kept at several levels" if level is None else f'there are no paths at level "{level}"'
        raise SettingsError(f"{asked}; name one of {', '.join(levels)}")
    return level


def _at(found: Mapping[tuple[str, int, str], Path2], level: str, methods: Sequence[str]) -> dict[str, list[Path2]]:
    """Paths of each method at one level."""
    return {m: [path for (at, _, method), path in found.items() if (at, method) == (level, m)] for m in methods}


# Panels --------------------------------------------------------------------------------------------------------------
def _drawn(summary: Summary, level: str, flown: _Paths, planned: _Paths, title: str) -> Figure:
    from matplotlib.ticker import MultipleLocator

    looks = method_looks(summary.methods)
    entries = [("flown with the true parameters", looks[TRUE])] if TRUE in looks else []
    if any(some for by_method in planned.values() for some in by_method.values()):
        entries.append(("reference of the method", {"color": INK, "linestyle": _DASHES, "linewidth": 0.8}))
    # Inches: left of the panels, between them, above a row (trajectory's name), below it (counts), the caption.
    margin, gap, above, under, foot = 0.42, 0.12, 0.24, 0.42, 0.3
    width = (WIDTH - margin - 0.1) / len(looks) - gap
    boxes = {shape: _box(by_method) for shape, by_method in flown.items()}
    heights = {shape: width * extent(box[1]) / extent(box[0]) for shape, box in boxes.items()}
    figure, top = headed_figure(entries, title, sum(above + height + under for height in heights.values()) + foot)
    for shape, by_method in flown.items():
        write_at(figure, 0.1, top + 0.03, shape, fontsize=9.5, color=INK)
        counts = _counts(summary, shape, level)
        below = top + above + heights[shape]
        for k, (label, look) in enumerate(looks.items()):
            left = margin + k * (width + gap)
            axes = axes_at(figure, left, top + above, width, heights[shape])
            _draw_flights(axes, by_method[label], by_method.get(TRUE, []), look["color"], label == TRUE)
            _draw_references(axes, planned[shape][label])
            axes.set(xlim=boxes[shape][0], ylim=boxes[shape][1])
            axes.tick_params(labelleft=k == 0)
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_locator(MultipleLocator(round_step(extent(boxes[shape][0]) / 5.0)))
            write_at(figure, left + width, top + 0.06, label, fontsize=8, color=look["color"], ha="right")
            unseen = _unseen(by_method[label], boxes[shape], *counts[label])
            write_at(figure, left + width, below + 0.17, unseen, fontsize=7, ha="right")
        top = below + under
    caption = f"Every trial's path in the XZ plane, m; {summary.axis} {level} {summary.unit}".rstrip()
    caption += f". {summary.remark}" if summary.remark else ""
    write_at(figure, 0.1, top + 0.06, caption)
    return figure


def _box(by_method: Mapping[str, list[Path2]]) -> tuple[Range, Range]:
    """Ranges of a panel in x and z: median extent of the flights with the true parameters, or of all, with a margin."""
    every = by_method.get(TRUE) or [path for some in by_method.values() for path in some]
    low = np.median([path[:, :2].min(axis=0) for path in every], axis=0)
    high = np.median([path[:, :2].max(axis=0) for path in every], axis=0)
    margin = 0.3 * max(float((high - low).max()), 1e-6)
    return tuple((float(a) - margin, float(b) + margin) for a, b in zip(low, high, strict=True))  # type: ignore[return-value]


def _draw_flights(axes: Axes, flown: Sequence[Path2], true: Sequence[Path2], colour: str, is_true: bool) -> None:
    for reference in true[:1]:
        axes.plot(*_thinned(reference).T, color=REFERENCE, linewidth=2.6, solid_capstyle="round", zorder=1.8)
    if not is_true:
        _draw_lines(axes, flown, colors=colour, linewidths=0.6, zorder=2.5)


def _draw_references(axes: Axes, planned: Sequence[Path2]) -> None:
    """Draw planned paths, equal ones once."""
    different = list({path.tobytes(): path for path in planned}.values())
    _draw_lines(axes, different, colors=INK, linewidths=0.5, linestyles=[_DASHES], zorder=2.7)


def _draw_lines(axes: Axes, paths: Sequence[Path2], **look: Any) -> None:
    """Draw pale lines."""
    from matplotlib.collections import LineCollection

    axes.add_collection(LineCollection([_thinned(path) for path in paths], alpha=0.35, **look), autolim=False)


def _thinned(path: Path2) -> Path2:
    """Every third place of a path in x and z."""
    return path[::3, :2]


# Text ----------------------------------------------------------------------------------------------------------------
def _counts(summary: Summary, shape: str, level: str) -> dict[str, tuple[int, int]]:
    """Trials of each method at the level, and how many failed."""
    flights, row = summary.flights[shape], summary.levels.index(level)
    ran, failed = flights.ran[row].sum(axis=1), flights.failed[row].sum(axis=1)
    return {label: (int(ran[k]), int(failed[k])) for k, label in enumerate(summary.methods)}


def _unseen(flown: Sequence[Path2], box: tuple[Range, Range], ran: int, failed: int) -> str:
    """Number of flights that leave the panel, and of failed trials."""
    low, high = np.transpose(box)
    leaving = sum(bool(((path[:, :2] < low) | (path[:, :2] > high)).any()) for path in flown)
    lines = [f"{leaving} of {ran} leave the panel"] * (leaving > 0) + [f"{failed} of {ran} failed"] * (failed > 0)
    return "\n".join(lines)
