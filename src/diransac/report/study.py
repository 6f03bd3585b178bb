"""One HTML page of a study: its figures, the numbers behind them, what failed, and what took its time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from importlib.resources import files
from itertools import compress
from pathlib import Path

import numpy as np
import numpy.typing as npt

from diransac.atomic import write_text
from diransac.errors import ResultError
from diransac.plots.estimates import LEAST, methods_and_errors, plot_estimates
from diransac.plots.paths import levels_with_paths, plot_paths
from diransac.plots.study import axis_label, level_labels, plot_study, title_of
from diransac.plots.writing import svg
from diransac.report.markup import Html, join, number, percent, plural, table, tag
from diransac.study.summary import ParameterErrors, Summary, TrackingErrors, summarise

__all__ = ["write_study_report"]

_POLICY = "default-src 'none'; style-src 'unsafe-inline'"
_STYLE = """
figure svg { width: 100%; height: auto; max-width: 70rem; border-radius: .4rem; }
main td:not(:last-child), main tbody th { white-space: nowrap; }
details { margin: .5rem 0; } summary { cursor: pointer; font-weight: 600; }
"""


def write_study_report(store: str | Path, path: str | Path) -> None:
    """Write a page about a store; it appears whole or not at all, needs nothing else and runs no script.

    The same rows give the same page.
    Raises StudyError: there is no such store, or it has no rows yet; ResultError: the page cannot be written.
    """
    summary = summarise(store)
    figures = [svg(plot_estimates(store, title=""))] if summary.estimates else []
    figures += [svg(plot_study(store, title=""))] if summary.flights else []
    figures += [svg(plot_paths(store, level=level, title="")) for level in levels_with_paths(store)]
    try:
        write_text(path, _page(summary, figures))
    except OSError as error:
        raise ResultError(f"{path}: cannot be written: {error.strerror}") from error


def _page(summary: Summary, figures: Sequence[str]) -> str:
    style = (files("diransac.report") / "page.css").read_text(encoding="utf-8")
    head = [
        tag("meta", charset="utf-8"),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        tag("title", " ".join(title_of(summary).split())),
        tag("style", Html(style + _STYLE)),
    ]
    main = [
        *(tag("figure", _scoped(figure)) for figure in figures),
        *_parameters(summary),
        *_flights(summary),
        tag("h2", "What failed"),
        _failed(summary),
        tag("h2", "What took its time"),
        _seconds(summary),
        tag("p", f"Computed by {'; '.join(summary.versions)}.", class_="how"),
    ]
    about = [tag("p", summary.description, class_="about")]
    about += [tag("p", tag("strong", summary.remark))] if summary.remark else []
    body = [tag("h1", summary.name), *about, tag("main", *main)]
    return f"<!DOCTYPE html>\n{tag('html', tag('head', *head), tag('body', *body), lang='en')}\n"


def _scoped(figure: str) -> Html:
    """A figure whose rules of style hold for figures alone."""
    return Html(figure.replace("*{stroke-linejoin", "svg *{stroke-linejoin"))


# Parameters ----------------------------------------------------------------------------------------------------------
def _parameters(summary: Summary) -> Iterator[Html]:
    """Errors of the worst parameter and, to be opened, of each; how far intervals can be trusted."""
    if summary.estimates is None:
        return
    yield tag("h2", "Error of the worst parameter")
    yield _errors(summary, None, "Error of the worst parameter, %: median over a level’s trials [worst]")
    yield tag(
        "p",
        "Errors are relative to the best parameters that the model can reach in the very flight: least squares without "
        "noise and without vibration. Where these differ from the plant’s own by more than 0.2 %, a second row has the "
        "errors against the latter. 0 is less than 0.001 %; ∞ is no estimate, which is worse than any.",
    )
    for name in summary.estimates.errors:
        inner = _errors(summary, name, f"Error of {name}, %: median [worst]")
        yield tag("details", tag("summary", name), inner)
    yield tag("h2", "Intervals")
    yield _intervals(summary.methods, summary.estimates)


def _errors(summary: Summary, parameter: str | None, caption: str) -> Html:
    """A row a level, or two, a column a method."""
    methods, rows = methods_and_errors(summary, parameter)
    cells = [
        [
            f"… {row.name}" if row.quiet else row.name,
            *(_median_and_worst(*pair) for pair in zip(row.median, row.worst, strict=True)),
        ]
        for row in rows
    ]
    return table([axis_label(summary), *methods], cells, caption)


def _median_and_worst(median: float, worst: float) -> str:
    return "" if math.isnan(median) else f"{_percent(median)} [{_percent(worst)}]"


def _percent(x: float) -> str:
    """Two figures of what is given in %: ``0``, ``0.042``, ``9.1``, ``103``, ``2.1×10³``."""
    whole = 9.95 <= x < 999.5
    return "0" if x < 10.0**LEAST else f"{x:.0f}" if whole else number(x, 2)


def _intervals(methods: Sequence[str], estimates: ParameterErrors) -> Html:
    """Of each method's intervals, which share holds the best parameter."""
    pairs = zip(methods, estimates.coverage(disturbed=False), estimates.coverage(disturbed=True), strict=True)
    rows = [[label, *(_share(*one) for one in both)] for label, *both in pairs if any(n for _, n in both)]
    caption = "Share of the 95 % intervals that hold the best parameter, to a millionth; an infinite interval is none"
    return table(["method", "where the model says all", "where the plant has more to it"], rows, caption)


def _share(held: int, there: int) -> str:
    return f"{held / there:.2f} of {there}" if there else "–"


# Flights -------------------------------------------------------------------------------------------------------------
def _flights(summary: Summary) -> Iterator[Html]:
    """Tracking errors over all levels, and of each."""
    if not summary.flights:
        return
    yield tag("h2", "In short")
    for shape, flights in summary.flights.items():
        yield from _short(summary, shape, flights)
    yield tag("h2", "Every level")
    for shape, flights in summary.flights.items():
        yield from _levels(summary, shape, flights)


def _short(summary: Summary, shape: str, flights: TrackingErrors) -> Iterator[Html]:
    """The least and the largest mean, and median, of each method over all levels."""
    header = ["method", "failed", *(f"{state}, {unit}" for state, unit in summary.units.items())]
    for about, of in (
        ("mean RMS tracking error of the flights there are", flights.mean),
        ("median RMS tracking error of all trials, one that failed having ∞", flights.median),
    ):
        figures = [of(state) for state in summary.units]
        rows = [
            [label, _failures(flights, k), *(_range(one[:, k]) for one in figures)]
            for k, label in enumerate(summary.methods)
        ]
        yield table(header, rows, f"{shape}: {about}, least … largest of all levels")


def _levels(summary: Summary, shape: str, flights: TrackingErrors) -> Iterator[Html]:
    """A table a state, to be opened: mean ± standard deviation, and the median."""
    yield tag("h3", shape)
    for state, unit in summary.units.items():
        mean, deviation, median = flights.mean(state), flights.deviation(state), flights.median(state)
        rows = [
            [label, *(_spread(mean[i, k], deviation[i, k], median[i, k]) for k in range(len(summary.methods)))]
            for i, label in enumerate(level_labels(summary))
        ]
        caption = "mean ± standard deviation of the flights there are (median of all trials, a failure being infinite)"
        inner = table([axis_label(summary), *summary.methods], rows, caption)
        yield tag("details", tag("summary", f"{state}, {unit}"), inner)


def _failed(summary: Summary) -> Html:
    """Every reason, and how often."""
    if not summary.failures:
        return tag("p", "No trial failed.")
    rows = [[method, str(count), why] for (method, why), count in summary.failures.items()]
    about = "A trial without a flight has no error: means leave it out, medians count it as infinite."
    if not summary.flights:
        about = "A trial without an estimate is worse than any: medians count its error as infinite."
    return join([tag("p", about), table(["method", "trials", "why"], rows, "Over all levels and trajectories")])


def _seconds(summary: Summary) -> Html:
    """Seconds of each method by stage, but for those that the study does not have."""
    there = [bool(one.any()) for one in summary.seconds.T]
    of_stages = summary.seconds[:, there]
    rows = [
        [label, *(number(x, 3) for x in seconds), number(float(seconds.sum()), 3)]
        for label, seconds in zip(summary.methods, of_stages, strict=True)
    ]
    total = of_stages.sum(axis=0)
    rows.append(["all", *(number(x, 3) for x in total), number(float(total.sum()), 3)])
    n_rows = int(summary.ran.sum())
    caption = f"Seconds of one process, over {plural(n_rows, 'row')}; what is done for several together is divided"
    return table(["method", *compress(summary.stages, there), "all"], rows, caption)


def _failures(flights: TrackingErrors, k: int) -> str:
    ran, failed = int(flights.ran[:, k].sum()), int(flights.failed[:, k].sum())
    return f"{failed} of {ran} ({percent(failed / ran)})" if failed else "none"


def _range(values: npt.NDArray[np.float64]) -> str:
    there: Iterable[float] = values[~np.isnan(values)]
    found = [number(x, 2) for x in (min(there, default=np.nan), max(there, default=np.nan))]
    return found[0] if found[0] == found[1] else f"{found[0]} … {found[1]}"


def _spread(mean: float, deviation: float, median: float) -> str:
    if np.isnan(mean):
        return "–"
    about = "" if np.isnan(deviation) else f" ± {number(deviation, 2)}"
    return f"{number(mean, 3)}{about} ({number(median, 3)})"
