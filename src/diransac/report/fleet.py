"""Self-contained HTML page of a fleet: findings, figures, tables of parameters, failures."""

from __future__ import annotations

from pathlib import Path

from diransac.plots.figure import svg
from diransac.plots.fleet import plot_fleet
from diransac.report.rendering import Table, write_page
from diransac.study.fleet_findings import FleetSummary
from diransac.text_table import number

__all__ = ["write_fleet_report"]

_MOST = 200
"""Rows of a table, findings and vehicles alike; the page says how many there are more."""


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
    figure = svg(plot_fleet(summary, title="")).replace("*{stroke-linejoin", "svg *{stroke-linejoin")
    kinds = {
        "Vehicles that differ from the others": summary.outliers,
        "Changes in the life of a vehicle": summary.changes,
        "Drifts over the life of a vehicle": summary.drifts,
    }
    found = [(kind, [str(x) for x in some[:_MOST]], max(0, len(some) - _MOST)) for kind, some in kinds.items()]
    failures = [[str(count), reason] for reason, count in summary.status.reasons.items()]
    write_page(
        path,
        "fleet.html",
        ["page.css", "study.css"],
        title=f"{summary.rows.model}: a fleet of {summary.n_vehicles} vehicles",
        summary=summary,
        found=found,
        figure=figure if summary.parameters else "",
        parameters=_parameters(summary),
        unreliable=_unreliable(summary),
        failures=Table(["logs", "reason"], failures, "Logs without a result, by reason") if failures else None,
    )


def _parameters(summary: FleetSummary) -> Table:
    """Mean and scales of each parameter."""
    rows = [
        [x.name, number(x.mean), *(number(y, 3) for y in (x.standard_error, x.between, x.within)), x.unit]
        for x in summary.parameters
    ]
    header = ["parameter", "fleet", "standard error", "between vehicles", "within a vehicle", "unit"]
    return Table(header, rows, "Huber’s mean, and standard deviations beyond the standard errors of the results")


def _unreliable(summary: FleetSummary) -> Table | None:
    """Vehicles with results that are not to be relied on."""
    worst = sorted(summary.unreliable.items(), key=lambda item: -item[1][0] / item[1][1])[:_MOST]
    rows = [[vehicle, f"{count} of {n}"] for vehicle, (count, n) in worst]
    return Table(["vehicle", "logs"], rows, "Logs with the verdict “do not rely on this”") if rows else None
