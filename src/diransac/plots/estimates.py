"""Figure of parameter errors of a study: the largest per method, a row per level."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from diransac.arrays import FloatArray
from diransac.errors import SettingsError
from diransac.plots.figure import INK, MUTED, WIDTH, check_ending, draw_heading, empty_figure, header_height, write
from diransac.plots.rows import LogAxis, MarkRow, as_marks, draw_rows, name_rows, names_width, row_height
from diransac.plots.study import axis_label, level_labels, method_looks, n_trials, title_of
from diransac.study.method_choice import TRUE
from diransac.study.store import Store, damage
from diransac.study.summary import ParameterErrors, Summary, summarise

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["LEAST", "evaluates_parameters", "methods_and_errors", "plot_estimates"]


LEAST = -3
"""Power of ten, %, below which errors are not resolved."""


# Inches: name of the panel with the values above its rows, values below, a line of the caption.
_ABOVE, _BELOW, _LINE = 0.42, 0.3, 0.155
_CAPTION = (
    "Marks are medians over {trials} of a level, lines end at the largest. Errors are relative to the pseudo-true "
    "parameters, the best of the",
    "model in that flight; where those differ from the true ones, a second row has the errors relative to the latter.",
)


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
    every = as_marks(method_looks(summary.methods))
    looks = {label: every[label] for label in methods}
    entries = list(looks.items())
    scale = LogAxis.of(rows, LEAST)
    caption = _caption(summary, scale)
    header, height = header_height(entries, title), row_height(len(methods)) * len(rows)
    full = header + _ABOVE + height + _BELOW + _LINE * len(caption) + 0.08
    figure = empty_figure(full)
    draw_heading(figure, entries, title)
    heading = axis_label(summary)
    what, left = "Error of the worst parameter, %", names_width([row.name for row in rows], heading)
    figure.text(left / WIDTH, 1.0 - header / full, what, fontsize=9.5, color=INK, va="top")
    top = header + _ABOVE
    name_rows(figure, (left, top), rows, len(methods), heading)
    draw_rows(figure, (left, top, WIDTH - left - 0.12), rows, looks, scale)
    for line, text in enumerate(caption):
        y = 1.0 - (top + height + _BELOW + line * _LINE) / full
        figure.text(0.1 / WIDTH, y, text, fontsize=7.5, color=MUTED, va="top")
    return figure


def _caption(summary: Summary, scale: LogAxis) -> list[str]:
    """Lines of the caption."""
    first, second = _CAPTION
    lines = [
        first.format(trials=n_trials(summary)),
        second + " none: no estimate, counted as an infinite error." * scale.endless,
    ]
    return [*lines, summary.remark] if summary.remark else lines
