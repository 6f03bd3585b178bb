"""Figure of a fleet: each parameter over the vehicles' lives, and by vehicle."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from diransac.plots.figure import (
    COLOURS,
    INK,
    REFERENCE,
    WIDTH,
    LegendEntry,
    check_ending,
    headed_figure,
    name_panel,
    panel,
    write,
)
from diransac.study.fleet_findings import FleetSummary, ParameterInFleet

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot_fleet(summary: FleetSummary, path: str | Path | None = None, *, title: str | None = None) -> Figure:
    """Figure with a row per parameter: estimates over the logs of each vehicle, and values by vehicle.

    Vehicles with a finding have a colour; the band is the fleet's mean with two standard deviations between vehicles.

    Parameters
    ----------
    summary : FleetSummary
    path : str or Path, optional
        ``.png``, ``.svg`` or ``.pdf`` file, written completely or not at all; None writes none.
    title : str, optional
        By default the model's name and the number of vehicles.

    Returns
    -------
    matplotlib.figure.Figure
        Points of vehicles without findings are one image, so that the size of the file does not grow with the fleet.

    Raises
    ------
    SettingsError
        The file cannot be written.
    """
    check_ending(path)
    colours = _colours(summary)
    text = f"{summary.rows.model}: {summary.n_vehicles} vehicles" if title is None else title
    entries: list[LegendEntry] = [("fleet", {"color": REFERENCE, "marker": ".", "linestyle": ""})]
    entries += [(vehicle, {"color": colour, "marker": "."}) for vehicle, colour in colours.items()]
    row = 1.9  # inches
    figure, header = headed_figure(entries, text, row * len(summary.parameters) + 0.35)
    for k, parameter in enumerate(summary.parameters):
        last, top = k == len(summary.parameters) - 1, header + k * row
        over_life = panel(figure, 0.0, top, 0.55 * WIDTH, row, last=last)
        by_vehicle = panel(figure, 0.55 * WIDTH, top, 0.45 * WIDTH, row, last=last)
        name_panel(over_life, parameter.name, parameter.unit)
        name_panel(by_vehicle, f"{parameter.name} by vehicle", parameter.unit)
        _draw_lives(over_life, summary, parameter, colours)
        _draw_vehicles(by_vehicle, parameter, colours)
        if last:
            over_life.set_xlabel("log of the vehicle", fontsize=8, color=INK)
            by_vehicle.set_xlabel("vehicle, sorted by value", fontsize=8, color=INK)
    return write(figure, path)


def _colours(summary: FleetSummary) -> dict[str, str]:
    """Colour of each vehicle with a finding, as far as there are colours."""
    found = sorted(summary.findings, key=lambda x: -x.distance)
    # Vehicles with a colour of their own, those with the largest distances.
    named = list(dict.fromkeys(x.vehicle for x in found))[: len(COLOURS)]
    return dict(zip(named, COLOURS, strict=False))


def _draw_lives(axes: Axes, summary: FleetSummary, parameter: ParameterInFleet, colours: dict[str, str]) -> None:
    """Estimates over the number of the log in the vehicle's life."""
    vehicles, y = summary.rows.vehicles, summary.rows.values[parameter.name]
    begins = np.flatnonzero(np.r_[True, vehicles[1:] != vehicles[:-1]])
    place = np.arange(len(y)) - np.repeat(begins, np.diff(np.r_[begins, len(y)])) + 1
    axes.plot(place, y, ".", color=REFERENCE, markersize=3, rasterized=True)
    bars = 2.0 * summary.rows.standard_errors[parameter.name]
    for vehicle, colour in colours.items():
        own = vehicles == vehicle
        axes.errorbar(place[own], y[own], bars[own], color=colour, marker=".", linewidth=0.9, markersize=4)
    named = y[np.isin(vehicles, list(colours))]
    low, high = np.nanquantile(y, [0.005, 0.995])
    low, high = min(low, *named[np.isfinite(named)], high), max(high, *named[np.isfinite(named)], low)
    # Free part of a panel beyond the central values.
    margin = 0.15 * (high - low or abs(high) or 1.0)
    axes.set_ylim(low - margin, high + margin)


def _draw_vehicles(axes: Axes, parameter: ParameterInFleet, colours: dict[str, str]) -> None:
    """Value of each vehicle at its beginning, with two standard errors."""
    order = np.argsort(parameter.values)
    mean, spread = parameter.mean, 2.0 * parameter.between
    axes.axhspan(mean - spread, mean + spread, color=REFERENCE, alpha=0.25)
    axes.axhline(mean, color=REFERENCE, linewidth=0.9)
    place, y, bars = np.arange(len(order)) + 1, parameter.values[order], 2.0 * parameter.standard_errors[order]
    axes.vlines(place, y - bars, y + bars, color=REFERENCE, linewidth=0.8, rasterized=True)
    axes.plot(place, y, ".", color=REFERENCE, markersize=3, rasterized=True)
    for k, i in enumerate(order):
        colour = colours.get(parameter.vehicles[i])
        if colour is not None:
            axes.errorbar(place[k], y[k], bars[k], color=colour, marker=".", markersize=5)
