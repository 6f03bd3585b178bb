"""The picture of a study that judges parameters: how far off the worst of them is, a row a level, a mark a method."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from diransac.arrays import FloatArray
from diransac.errors import SettingsError
from diransac.plots.heading import draw_heading, header_height
from diransac.plots.layout import WIDTH
from diransac.plots.palette import INK, MUTED, PAPER
from diransac.plots.rows import Row, Scale, as_marks, draw_rows, name_rows, names_width, row_height
from diransac.plots.study import axis_label, level_labels, method_looks, n_trials, title_of
from diransac.plots.writing import checked_ending, write
from diransac.study.specification import TRUE
from diransac.study.store import Store
from diransac.study.summary import ParameterErrors, Summary, summarise

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["LEAST", "evaluates_parameters", "methods_and_errors", "plot_estimates"]


LEAST = -3
"""Power of ten, %: what is less is shown as nothing."""

OF_OWN = "against the plant’s own"

# Inches: what names the picture with the values above the rows, values below, a line of the caption.
_ABOVE, _BELOW, _LINE = 0.42, 0.3, 0.155
_CAPTION = (
    "Marks are medians over {trials} of a level, lines end at the worst. Errors are relative to the best "
    "parameters that the model can reach in the",
    "very flight; where those differ from the plant’s own, a second row has the errors against the latter.",
)
_NONE = " none: no estimate, which is worse than any."


def plot_estimates(store: str | Path, path: str | Path | None = None, *, title: str | None = None) -> Figure:
    """Error of the worst parameter: a row a level, a mark a method, on a logarithmic axis in %.

    Parameters
    ----------
    store : of a study that judges parameters
    path : ``.png``, ``.svg`` or ``.pdf`` to be written, whole or not at all; None writes nothing
    title : None: the study's name and description

    Marks are medians over the trials of a level, from which a line runs to the worst of them.  Errors are relative to
    the best parameters that the model can reach in the very flight.  Where these differ from the plant's own by more
    than 0.2 %, a second row has the errors against the plant's own.  A trial without an estimate counts as worse than
    any.  The method ``true`` has a mark where its parameters are not the best ones.

    Returns a Matplotlib figure. The same rows give the same file.
    Raises StudyError: there is no such store, or it has no rows; SettingsError: its study judges no parameters, or the
    file cannot be written.
    """
    if path is not None:
        checked_ending(Path(path))
    summary = summarise(store)
    figure = _drawn(summary, title_of(summary) if title is None else title)
    if path is not None:
        write(figure, Path(path))
    return figure


def evaluates_parameters(store: str | Path) -> bool:
    """Whether a store's study judges parameters.  Raises StudyError: there is no such store."""
    with Store.existing(store) as kept:
        return bool(kept.configuration["study"].get("evaluation.parameters"))


def methods_and_errors(summary: Summary, parameter: str | None = None) -> tuple[list[str], list[Row]]:
    """The methods that have errors worth showing, and their errors at each level, in %.

    What ``true`` has found is no news but where the best parameters are others; where it is alone, nothing is shown.

    Parameters
    ----------
    parameter : whose errors; None: of the worst

    Raises SettingsError: the study judges no parameters.
    """
    estimates = summary.estimates
    if estimates is None:
        raise SettingsError("the study judges no parameters; run one with evaluation.parameters = true")
    best = estimates.worst if parameter is None else estimates.errors[parameter]
    own = estimates.worst_to_true if parameter is None else estimates.errors_to_true[parameter]
    is_news = estimates.differs.any() or summary.methods == (TRUE,)
    kept = [k for k, label in enumerate(summary.methods) if label != TRUE or is_news]
    is_true = np.array([summary.methods[k] == TRUE for k in kept])
    rows = []
    for i, name in enumerate(level_labels(summary)):
        rows.append(_row(name, best[i, kept], is_true & ~estimates.differs[i]))
        if estimates.differs[i]:
            rows.append(_row(OF_OWN, own[i, kept], is_true, quiet=True))
    return [summary.methods[k] for k in kept], rows


def _row(name: str, errors: FloatArray, hidden: npt.NDArray[np.bool_], *, quiet: bool = False) -> Row:
    """A row of the errors (n_methods, n_trials) that are not hidden."""
    shown = 100.0 * np.where(hidden[:, None], np.nan, errors)[None]
    return Row(name, ParameterErrors.median(shown)[0], ParameterErrors.largest(shown)[0], quiet)


def _drawn(summary: Summary, title: str) -> Figure:
    from matplotlib.figure import Figure

    methods, rows = methods_and_errors(summary)
    every = as_marks(method_looks(summary.methods))
    looks = {label: every[label] for label in methods}
    entries = list(looks.items())
    scale = Scale.of(rows, LEAST)
    caption = _caption(summary, scale)
    header, height = header_height(entries, title), row_height(len(methods)) * len(rows)
    full = header + _ABOVE + height + _BELOW + _LINE * len(caption) + 0.08
    figure = Figure(figsize=(WIDTH, full), facecolor=PAPER)
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


def _caption(summary: Summary, scale: Scale) -> list[str]:
    """Lines that say what is drawn, and what is missing."""
    first, second = _CAPTION
    lines = [first.format(trials=n_trials(summary)), second + _NONE * scale.endless]
    return [*lines, summary.remark] if summary.remark else lines
