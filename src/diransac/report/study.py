"""Self-contained HTML page of a study: figures, tables of errors, failures, computing time."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from diransac.plots.estimates import LEAST, methods_and_errors, plot_estimates
from diransac.plots.figure import svg
from diransac.plots.paths import levels_with_paths, plot_paths
from diransac.plots.study import axis_label, level_labels, plot_study, title_of
from diransac.report.rendering import Table, write_page
from diransac.study.summary import ParameterErrors, Summary, TrackingErrors, summarise
from diransac.text_table import number, plural

__all__ = ["write_study_report"]


def write_study_report(store: str | Path, path: str | Path) -> None:
    """Write one HTML page about the rows of a store.

    Parameters
    ----------
    store : file of the store
    path : file of the page, written whole or not at all

    Raises
    ------
    StudyError
        There is no such store, or it has no rows yet.
    ResultError
        The page cannot be written.

    Notes
    -----
    The page loads nothing and runs no script.  The same rows give the same page.
    """
    summary = summarise(store)
    figures = [svg(plot_estimates(store, title=""))] if summary.estimates else []
    figures += [svg(plot_study(store, title=""))] if summary.flights else []
    figures += [svg(plot_paths(store, level=level, title="")) for level in levels_with_paths(store)]
    write_page(path, "study.html", ["page.css", "study.css"], **_content(summary, figures))


def _content(summary: Summary, figures: Sequence[str]) -> dict[str, Any]:
    """Values of the template."""
    return {
        "title": " ".join(title_of(summary).split()),
        "summary": summary,
        "figures": [_scoped(figure) for figure in figures],
        **_parameters(summary),
        "by_level": [(shape, list(_levels(summary, flights))) for shape, flights in summary.flights.items()],
        "failed": _failed(summary),
        "seconds": _seconds(summary),
    }


def _scoped(figure: str) -> str:
    """A figure whose style rules are limited to figures."""
    return figure.replace("*{stroke-linejoin", "svg *{stroke-linejoin")


# Parameters ----------------------------------------------------------------------------------------------------------
def _parameters(summary: Summary) -> dict[str, Any]:
    """Errors of the worst parameter and of each, and the coverage of intervals."""
    if summary.estimates is None:
        return {"worst": None, "by_parameter": [], "intervals": None}
    caption = "Error of the worst parameter, %: median over a level’s trials [worst]"
    return {
        "worst": _errors(summary, None, caption),
        "by_parameter": [
            (name, _errors(summary, name, f"Error of {name}, %: median [worst]")) for name in summary.estimates.errors
        ],
        "intervals": _intervals(summary.methods, summary.estimates),
    }


def _errors(summary: Summary, parameter: str | None, caption: str) -> Table:
    """One or two rows per level, a column per method."""
    methods, rows = methods_and_errors(summary, parameter)
    cells = [
        [
            f"… {row.name}" if row.quiet else row.name,
            *(_median_and_worst(*pair) for pair in zip(row.median, row.worst, strict=True)),
        ]
        for row in rows
    ]
    return Table([axis_label(summary), *methods], cells, caption)


def _median_and_worst(median: float, worst: float) -> str:
    return "" if math.isnan(median) else f"{_percent(median)} [{_percent(worst)}]"


def _percent(x: float) -> str:
    """Two digits of a value in %: ``0``, ``0.042``, ``9.1``, ``103``, ``2.1×10³``."""
    whole = 9.95 <= x < 999.5
    return "0" if x < 10.0**LEAST else f"{x:.0f}" if whole else number(x, 2)


def _intervals(methods: Sequence[str], estimates: ParameterErrors) -> Table:
    """Fraction of each method's intervals that contain the best parameter."""
    pairs = zip(methods, estimates.coverage(disturbed=False), estimates.coverage(disturbed=True), strict=True)
    rows = [[label, *(_share(*one) for one in both)] for label, *both in pairs if any(n for _, n in both)]
    caption = "Fraction of 95 % intervals that contain the best parameter, to 1e-6; infinite intervals are left out"
    return Table(["method", "complete model", "plant with unmodelled forces"], rows, caption)


def _share(contained: int, total: int) -> str:
    return f"{contained / total:.2f} of {total}" if total else "–"


# Flights -------------------------------------------------------------------------------------------------------------
def _levels(summary: Summary, flights: TrackingErrors) -> Iterator[tuple[str, Table]]:
    """A table per state: mean ± standard deviation, and the median."""
    for state, unit in summary.units.items():
        mean, deviation, median = flights.mean(state), flights.deviation(state), flights.median(state)
        rows = [
            [label, *(_spread(mean[i, k], deviation[i, k], median[i, k]) for k in range(len(summary.methods)))]
            for i, label in enumerate(level_labels(summary))
        ]
        caption = "mean ± standard deviation of successful flights (median of all trials, failures counted as ∞)"
        yield f"{state}, {unit}", Table([axis_label(summary), *summary.methods], rows, caption)


def _failed(summary: Summary) -> Table | None:
    """Number of failed trials by method and reason; None without failures."""
    rows = [[method, str(count), reason] for (method, reason), count in summary.failures.items()]
    return Table(["method", "trials", "reason"], rows, "Over all levels and trajectories") if rows else None


def _seconds(summary: Summary) -> Table:
    """Computing time of each method by the stages of the study."""
    there = [bool(one.any()) for one in summary.seconds.T]
    of_stages = summary.seconds[:, there]
    rows = [
        [label, *(number(x, 3) for x in seconds), number(float(seconds.sum()), 3)]
        for label, seconds in zip(summary.methods, of_stages, strict=True)
    ]
    total = of_stages.sum(axis=0)
    rows.append(["all", *(number(x, 3) for x in total), number(float(total.sum()), 3)])
    n_rows = int(summary.ran.sum())
    caption = (
        f"Seconds of one process, over {plural(n_rows, 'row')}; time spent on several methods together is divided, and "
        "random samples that methods share count for the first of them"
    )
    return Table(["method", *compress(summary.stages, there), "all"], rows, caption)


def _spread(mean: float, deviation: float, median: float) -> str:
    if np.isnan(mean):
        return "–"
    about = "" if np.isnan(deviation) else f" ± {number(deviation, 2)}"
    return f"{number(mean, 3)}{about} ({number(median, 3)})"
