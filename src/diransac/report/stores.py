"""Self-contained HTML pages of stores, of studies and of fleets: sections of texts, tables and figures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import compress
from pathlib import Path

import numpy as np

from diransac.plots.estimates import LEAST, methods_and_errors, plot_estimates
from diransac.plots.figure import svg
from diransac.plots.fleet import plot_fleet
from diransac.plots.paths import levels_with_paths, plot_paths
from diransac.plots.study import axis_label, level_labels, plot_study, title_of
from diransac.report.rendering import Section, Table, embedded, write_page
from diransac.study.fleet_findings import FleetSummary
from diransac.study.summary import ParameterErrors, Summary, summarise
from diransac.text_table import number, percent, plural

_MOST = 200
"""Rows of a table of a fleet, findings and vehicles alike; the page says how many there are more."""


def _write(path: str | Path, sections: Sequence[Section], **texts: str) -> None:
    """Write a page of sections.  Raises ResultError: it cannot be written."""
    write_page(path, "sections.html", style="study.css", sections=sections, **texts)


# Studies -------------------------------------------------------------------------------------------------------------
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
    figures = [plot_estimates(store, title="")] if summary.estimates else []
    figures += [plot_study(store, title="")] if summary.flights else []
    figures += [plot_paths(store, level=level, title="") for level in levels_with_paths(store)]
    sections = [Section("", [summary.remark, *(embedded(svg(figure)) for figure in figures)])]
    sections += [*_parameter_sections(summary), *_flight_sections(summary)]
    failures = [[method, str(count), reason] for (method, reason), count in summary.failures.items()]
    counted = (
        "A trial without a flight has no error: means omit it, medians count it as infinite."
        if summary.flights
        else "A trial without an estimate counts as an infinite error in medians."
    )
    failed = Table(["method", "trials", "reason"], failures, "Over all levels and trajectories")
    sections.append(Section("Failed trials", [counted, failed] if failures else ["No trial failed."]))
    computed = f"Computed by {'; '.join(summary.versions)}."
    sections.append(Section("Computing time", [_seconds(summary), computed]))
    title = " ".join(title_of(summary).split())
    _write(path, sections, title=title, heading=summary.name, about=summary.description)


def _parameter_sections(summary: Summary) -> Iterator[Section]:
    """Errors of the worst parameter and of each, and the coverage of intervals."""
    estimates = summary.estimates
    if estimates is None:
        return
    worst = _errors(summary, None, "Error of the worst parameter, %: median over a level’s trials [worst]")
    each = {name: _errors(summary, name, f"Error of {name}, %: median [worst]") for name in estimates.errors}
    relative_to = (
        "Errors are relative to the best parameters that the model can reach in the same flight: least squares without "
        "noise and without vibration. Where these differ from the plant’s own by more than 0.2 %, a second row has the "
        "errors relative to the plant’s own. 0 is less than 0.001 %; ∞ is a missing estimate."
    )
    yield Section("Error of the worst parameter", [worst, relative_to, each])
    yield Section("Intervals", [_intervals(summary.methods, estimates)])


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


def _flight_sections(summary: Summary) -> Iterator[Section]:
    """Tracking errors of each state by level: mean ± standard deviation, and the median."""
    caption = "mean ± standard deviation of successful flights (median of all trials, failures counted as ∞)"
    for shape, flights in summary.flights.items():
        tables: dict[str, Table] = {}
        for state, unit in summary.units.items():
            mean, deviation, median = flights.mean(state), flights.deviation(state), flights.median(state)
            rows = [
                [label, *(_spread(mean[i, k], deviation[i, k], median[i, k]) for k in range(len(summary.methods)))]
                for i, label in enumerate(level_labels(summary))
            ]
            tables[f"{state}, {unit}"] = Table([axis_label(summary), *summary.methods], rows, caption)
        yield Section(f"Tracking errors by level: {shape}", [tables])


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


# Fleets --------------------------------------------------------------------------------------------------------------
def write_fleet_report(summary: FleetSummary, path: str | Path) -> None:
    """Write one HTML page about a fleet; it holds no single results, so that its size does not grow with the logs.

    Parameters
    ----------
    summary : FleetSummary
    path : str or Path
        File of the page, written whole or not at all.

    Raises
    ------
    ResultError
        The page cannot be written.
    """
    status, sections = summary.status, []
    for kind, findings in (
        ("Vehicles that differ from the others", summary.outliers),
        ("Changes in the life of a vehicle", summary.changes),
        ("Drifts over the life of a vehicle", summary.drifts),
    ):
        more = f"and {len(findings) - _MOST} more" if len(findings) > _MOST else ""
        sections.append(Section(kind, [[str(x) for x in findings[:_MOST]], more] if findings else ["None."]))
    chance = (
        f"A fleet without any has one with a nominal probability of {percent(summary.level)} for outliers, and the "
        f"same for changes and drifts together.{''.join(f' {remark}.' for remark in summary.remarks)}"
    )
    sections.append(Section("", [chance]))
    figure = [embedded(svg(plot_fleet(summary, title="")))] if summary.parameters else []
    sections.append(Section("Parameters", [_parameters(summary), *figure]))
    if summary.unreliable:
        sections.append(Section("Unreliable results", [_unreliable(summary)]))
    failures = [[str(count), reason] for reason, count in status.reasons.items()]
    failed = Table(["logs", "reason"], failures, "Logs without a result, by reason") if failures else "No log failed."
    sections.append(Section("Failed logs", [failed]))
    title = f"{summary.rows.model}: a fleet of {summary.n_vehicles} vehicles"
    about = f"{status.done} logs identified, {status.failed} failed, {status.missing} missing"
    _write(path, sections, title=title, heading=title, about=about)


def _parameters(summary: FleetSummary) -> Table:
    """Mean and scales of each parameter."""
    rows = [
        [x.name, number(x.mean), *(number(y, 3) for y in (x.standard_error, x.between, x.within)), x.unit]
        for x in summary.parameters
    ]
    header = ["parameter", "fleet", "standard error", "between vehicles", "within a vehicle", "unit"]
    return Table(header, rows, "Huber’s mean, and standard deviations beyond the standard errors of the results")


def _unreliable(summary: FleetSummary) -> Table:
    """Vehicles with results that are not to be relied on."""
    worst = sorted(summary.unreliable.items(), key=lambda item: -item[1][0] / item[1][1])[:_MOST]
    rows = [[vehicle, f"{count} of {n}"] for vehicle, (count, n) in worst]
    return Table(["vehicle", "logs"], rows, "Logs with the verdict “do not rely on this”")
