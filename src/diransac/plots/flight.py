"""Figures of flights: the path over its reference, states and inputs over time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.log import Log
from diransac.errors import SettingsError
from diransac.flight.trajectory import Trajectory
from diransac.plots.figure import (
    COLOURS,
    DASHES,
    INK,
    MUTED,
    PAPER,
    REFERENCE,
    LegendEntry,
    Range,
    check_ending,
    extent,
    flight_panels,
    inches,
    name_panel,
    round_step,
    write,
)
from diransac.text_table import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot_flight(
    trajectory: Trajectory | Mapping[str, Trajectory],
    log: Log | Mapping[str, Log],
    path: str | Path | None = None,
    *,
    title: str | None = None,
) -> Figure:
    """Figure of one or more flights over their references: the path, states and inputs over time.

    Parameters
    ----------
    trajectory : Trajectory or mapping of str to Trajectory
        Reference of all flights, or of each by label, with names of states and inputs.
    log : Log or mapping of str to Log
        Flights, by label if there are several; with those states and inputs.
    path : str or Path, optional
        ``.png``, ``.svg`` or ``.pdf`` file, written completely or not at all; None writes none.
    title : str, optional
        Title of the figure.

    Returns
    -------
    matplotlib.figure.Figure
        The path in the XZ plane, if there are states x and z; a panel per state; a panel per input, held from row to
        row, with its limits. References are broad and grey, or pale in the flight's colour where each flight has its
        own.

    Raises
    ------
    SettingsError
        Labels that do not match, a trajectory without names, or a file that cannot be written.
    LogError
        A log lacks a state or input of the trajectory.

    Notes
    -----
    The axes cover the references and as much of the flights as lies about as near as the references are large, so that
    a diverging flight leaves the others readable: a triangle marks where it leaves a panel, a cross its last finite
    value. The same flights give the same file, byte for byte. pyplot and its settings are not touched.
    """
    check_ending(path)
    flights = _flights(trajectory, log)
    states, inputs = flights[0].reference.state_names, flights[0].reference.input_names
    entries, box = _legend_entries(flights), _path_box(flights)
    figure, panels, path_panel = flight_panels(states, inputs, box, entries, title)
    for name in states:
        _draw_signal(panels[name], name, flights)
    for name in inputs:
        _draw_signal(panels[name], name, flights, drawstyle="steps-post")
    if path_panel is not None and box is not None:
        _draw_path(path_panel, flights, box)
    return write(figure, path)


# Heading -------------------------------------------------------------------------------------------------------------
def _legend_entries(flights: Sequence[FlightCurve]) -> list[LegendEntry]:
    """Label and style of each entry of the legend."""
    shared = "color" in _reference_style(flights)
    name = "reference" if shared else "references"
    entries = [(name, {"color": MUTED} | _reference_style(flights)), *((f.label, _style(f)) for f in flights)]
    states, inputs = flights[0].reference.state_names, flights[0].reference.input_names
    seen = {name: _visible(name, flights) for name in (*states, *inputs)}
    limits = flights[0].reference.input_limits
    if any(seen[name][0] <= limit <= seen[name][1] for name in inputs for limit in limits.get(name, ())):
        entries.append(("limits", _LIMIT_STYLE))
    marks: dict[str, Any] = {"color": MUTED, "linestyle": "none", "markersize": 6}
    if any(((f.log[name] < low) | (f.log[name] > high)).any() for f in flights for name, (low, high) in seen.items()):
        entries.append(("leaves the panel", {"marker": "^", **marks}))
    if any(_last_finite(f.log[name]) is not None for f in flights for name in seen):
        entries.append(("last finite value", {"marker": "X", **marks}))
    return entries


@dataclass(frozen=True)
class FlightCurve:
    """One flight, its reference, colour and style of line."""

    label: str
    reference: Trajectory
    log: Log
    colour: str
    dashes: Any


def _flights(trajectory: Trajectory | Mapping[str, Trajectory], log: Log | Mapping[str, Log]) -> list[FlightCurve]:
    """Flights by label.

    Raises SettingsError: no flight, labels that do not match, a trajectory without names or with others than the first.
    Raises LogError: a log lacks a state or input.
    """
    logs = dict(log) if isinstance(log, Mapping) else {"flown": log}
    if not logs:
        raise SettingsError("there is no flight to draw; give a log, or a mapping from label to log")
    references = dict(trajectory) if isinstance(trajectory, Mapping) else dict.fromkeys(logs, trajectory)
    if set(references) != set(logs):
        raise SettingsError(
            f"the trajectories have the labels {', '.join(map(str, references))}, "
            f"the logs {', '.join(map(str, logs))}; "
            "give both the same labels, or one trajectory for all"
        )
    for label, flown in logs.items():
        _check(label, references[label], flown)
    first = references[next(iter(logs))]
    for label, other in references.items():
        if (other.state_names, other.input_names) != (first.state_names, first.input_names):
            raise SettingsError(f'the trajectory of "{label}" has other states or inputs; draw it in another figure')
    looks = [(COLOURS[i % len(COLOURS)], DASHES[i % len(DASHES)]) for i in range(len(logs))]
    return [
        FlightCurve(str(label), references[label], flown, *look)
        for (label, flown), look in zip(logs.items(), looks, strict=True)
    ]


def _check(label: str, reference: object, log: object) -> None:
    """Raise an error if a flight cannot be drawn."""
    if not isinstance(reference, Trajectory) or not isinstance(log, Log):
        raise SettingsError(
            f'"{label}" is a {type(reference).__name__} and a {type(log).__name__}; give a Trajectory and a Log'
        )
    if not reference.state_names or not reference.input_names:
        raise SettingsError(
            f'the trajectory of "{label}" does not name its states and inputs; give state_names and input_names'
        )
    for name in (*reference.state_names, *reference.input_names):
        log[name]


# Ranges of axes -----------------------------------------------------------------------------------------------------
def _visible(name: str, flights: Sequence[FlightCurve]) -> Range:
    """Range of the references and of the flights within reach of them, with a margin."""
    planned = np.concatenate([flight.reference[name] for flight in flights])
    flown = [values for flight in flights if len(values := _finite(flight.log[name]))]
    low, high = float(planned.min()), float(planned.max())
    reach = _reach(planned, flown)
    visible = np.clip(np.concatenate([planned, *flown]), low - reach, high + reach)
    low, high = float(visible.min()), float(visible.max())
    width = high - low
    if not width > 1e-9 * max(abs(low), abs(high)):
        width = max(abs(low), abs(high), 1.0)
    return low - 0.06 * width, high + 0.06 * width


def _reach(planned: FloatArray, flown: Sequence[FloatArray]) -> float:
    """Distance beyond the references that a panel shows of the flights: the extent of the references.

    Where these are almost constant, it is the usual distance of the nearest flight, limited to a few times their extent
    unless they are constant but for rounding.
    """
    size = float(np.ptp(planned))
    # Quantile and factor of a flight's usual distance from its reference, its largest widening of an axis, and
    # the ratio below which the extent of the reference is negligible; see `_reach`.
    off = [float(np.quantile(np.abs(values - np.median(planned)), 0.2)) for values in flown]
    usual = 5.0 * min(off, default=0.0)
    return usual if size < 1e-4 * usual else max(size, min(usual, 5.0 * size))


def _path_box(flights: Sequence[FlightCurve]) -> tuple[Range, Range] | None:
    """Least ranges of a path in x and z; None without states x and z."""
    if not {"x", "z"} <= set(flights[0].reference.state_names):
        return None
    x, z = _visible("x", flights), _visible("z", flights)
    least = 0.15 * max(extent(x), extent(z))
    return _around(x, max(extent(x), least)), _around(z, max(extent(z), least))


def _near(values: FloatArray, visible: Range) -> FloatArray:
    """Values clipped far outside of the range, which a canvas cannot draw."""
    reach = 20.0 * extent(visible)
    return np.asarray(np.clip(values, visible[0] - reach, visible[1] + reach))


def _around(visible: Range, width: float) -> Range:
    """Range of this length around the same middle."""
    middle = (visible[0] + visible[1]) / 2.0
    return middle - width / 2.0, middle + width / 2.0


def _finite(values: Iterable[float]) -> FloatArray:
    """Finite values."""
    array = np.asarray(values)
    return np.asarray(array[np.isfinite(array)])


# Ends of curves ----------------------------------------------------------------------------------------------------
def _last_finite(values: FloatArray) -> int | None:
    """Last finite row, if rows follow; otherwise None."""
    finite = np.flatnonzero(np.isfinite(values))
    return int(finite[-1]) if len(finite) and finite[-1] < len(values) - 1 else None


# Panels --------------------------------------------------------------------------------------------------------------

_LIMIT_STYLE: dict[str, Any] = {"color": MUTED, "linewidth": 0.9, "linestyle": (0.0, (1.0, 2.0))}


def _style(flight: FlightCurve) -> dict[str, Any]:
    """Style of a flight's line."""
    return {"color": flight.colour, "linewidth": 1.25, "linestyle": flight.dashes}


def _reference_style(flights: Sequence[FlightCurve]) -> dict[str, Any]:
    """Style of references: broad and grey if shared, else pale in the flight's colour."""
    if _is_shared(flights):
        return {"color": REFERENCE, "linewidth": 2.8, "solid_capstyle": "round"}
    return {"linewidth": 2.6, "alpha": 0.3, "solid_capstyle": "round"}


def _is_shared(flights: Sequence[FlightCurve]) -> bool:
    """True if all flights have the same reference."""
    return all(flight.reference is flights[0].reference for flight in flights)


def _draw_references(axes: Axes, x: str, y: str, flights: Sequence[FlightCurve], **more: Any) -> None:
    """Draw the references."""
    for flight in flights[:1] if _is_shared(flights) else flights:
        horizontal = flight.reference.time if x == "t" else flight.reference[x]
        style = {"color": flight.colour} | _reference_style(flights) | more
        axes.plot(horizontal, flight.reference[y], **style, zorder=1.8)


# Over time -----------------------------------------------------------------------------------------------------------
def _draw_signal(axes: Axes, name: str, flights: Sequence[FlightCurve], **held: Any) -> None:
    """Draw a state or an input over time, each flight over its reference, and limits where they are in the range."""
    visible, unit = _visible(name, flights), _unit(name, flights)
    _draw_references(axes, "t", name, flights, **held)
    for flight in flights:
        time, values = flight.log.time, flight.log[name]
        axes.plot(time, _near(values, visible), **_style(flight), **held, zorder=2.5)
        _mark_end(axes, flight, time, values, ((-np.inf, np.inf), visible))
    limits = flights[0].reference.input_limits.get(name)
    if limits is not None:
        for limit in limits:
            if visible[0] <= limit <= visible[1]:
                axes.axhline(limit, **_LIMIT_STYLE, zorder=2.2)
        unit = f"{unit}, limits {number(limits[0])} to {number(limits[1])}".removeprefix(", ")
    times = [time for flight in flights for time in (flight.reference.time, flight.log.time)]
    axes.set(xlim=(min(float(t[0]) for t in times), max(float(t[-1]) for t in times)), ylim=visible)
    axes.xaxis.set_major_formatter("{x:g} s")
    name_panel(axes, name, unit)


def _mark_end(axes: Axes, flight: FlightCurve, x: FloatArray, y: FloatArray, box: tuple[Range, Range]) -> None:
    """Draw a triangle where a curve first leaves a box, over the edge it exceeds most, else a cross at its end."""
    beyond = np.array([x - box[0][1], box[0][0] - x, y - box[1][1], box[1][0] - y])
    rows = np.flatnonzero((beyond > 0.0).any(axis=0))
    if len(rows):
        row, marker = int(rows[0]), "><^v"[int(np.argmax(beyond[:, rows[0]]))]
        _mark(axes, float(np.clip(x[row], *box[0])), float(np.clip(y[row], *box[1])), marker, flight)
    elif (last := _last_finite(x + y)) is not None:
        _mark(axes, x[last], y[last], "X", flight)


def _mark(axes: Axes, x: float, y: float, marker: str, flight: FlightCurve) -> None:
    edge: dict[str, Any] = {"markeredgecolor": PAPER, "markeredgewidth": 0.6}
    axes.plot([x], [y], marker, color=flight.colour, markersize=6.5, **edge, clip_on=False, zorder=4)


def _unit(name: str, flights: Sequence[FlightCurve]) -> str:
    return next((flight.log.units[name] for flight in flights if name in flight.log.units), "")


# The path ------------------------------------------------------------------------------------------------------------
def _draw_path(axes: Axes, flights: Sequence[FlightCurve], needed: tuple[Range, Range]) -> None:
    """Draw the paths in the XZ plane at equal scale."""
    from matplotlib.ticker import MultipleLocator

    width, height = inches(axes)
    scale = max(extent(needed[0]) / width, extent(needed[1]) / height)
    box = _around(needed[0], scale * width), _around(needed[1], scale * height)
    _draw_references(axes, "x", "z", flights)
    for flight in flights:
        x, z = (_near(flight.log[name], visible) for name, visible in zip(("x", "z"), box, strict=True))
        axes.plot(x, z, **_style(flight), zorder=2.5)
        _mark_end(axes, flight, flight.log["x"], flight.log["z"], box)
    _mark_start(axes, flights[0].reference, box)
    axes.set(xlim=box[0], ylim=box[1], aspect="equal")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MultipleLocator(round_step(0.6 * scale)))
    unit = _unit("x", flights)
    axes.xaxis.set_major_formatter(f"{{x:g}} {unit}" if unit else "{x:g}")
    name_panel(axes, "path", f"z over x, {unit}" if unit else "z over x")


def _mark_start(axes: Axes, reference: Trajectory, box: tuple[Range, Range]) -> None:
    (x0, x1), (z0, z1) = reference["x"][[0, -1]], reference["z"][[0, -1]]
    closed = np.hypot(x1 - x0, z1 - z0) < 0.04 * max(map(extent, box))
    ends = [(x0, z0, "o", "start, end" if closed else "start"), (x1, z1, "s", "" if closed else "end")]
    for x, z, marker, text in ends:
        axes.plot([x], [z], marker, markersize=5, markerfacecolor=PAPER, markeredgecolor=INK, zorder=5)
        side = -1 if x > box[0][1] - 0.03 * extent(box[0]) else 1
        place: dict[str, Any] = {"xytext": (7 * side, -5), "textcoords": "offset points", "va": "top"}
        place["ha"] = "left" if side > 0 else "right"
        axes.annotate(text, (x, z), **place, fontsize=8, color=INK, zorder=5)


# Simulations beside measurements -------------------------------------------------------------------------------------
def plot_prediction(
    simulated: Log, measured: Log, states: Sequence[str], inputs: Sequence[str], path: str | Path | None = None
) -> Figure:
    """Figure of simulated states over the measured ones, and of the inputs, over time.

    Parameters
    ----------
    simulated : Log
        As `diransac.simulate` returns it.
    measured : Log
        The log that was simulated.
    states, inputs : sequence of str
        Signals to draw.
    path : str or Path, optional
        File to be written: .png, .svg or .pdf.

    Raises
    ------
    SettingsError
        The ending is unknown, or the file cannot be written.
    """
    check_ending(path)
    looks: dict[str, dict[str, Any]] = {
        "simulated": {"color": COLOURS[0], "linewidth": 1.3},
        "measured": {"color": REFERENCE, "linestyle": "none", "marker": ".", "markersize": 2.5},
    }
    figure, panels, _ = flight_panels(states, inputs, None, list(looks.items()), None)
    for name, axes in panels.items():
        name_panel(axes, name, simulated.units.get(name, ""))
        if name in inputs:
            axes.plot(simulated.time, simulated[name], color=MUTED, linewidth=1.0)
            continue
        axes.plot(simulated.time, simulated[name], zorder=3, **looks["simulated"])
        low, high = float(np.nanmin(simulated[name])), float(np.nanmax(simulated[name]))
        if name in measured:
            axes.plot(measured.time, measured[name], zorder=2, **looks["measured"])
            finite = _finite(measured[name])
            if len(finite):
                bulk = np.quantile(finite, [0.01, 0.99])
                low, high = min(low, float(bulk[0])), max(high, float(bulk[1]))
        margin = 0.06 * (high - low) or 1.0
        axes.set_ylim(low - margin, high + margin)
    return write(figure, path)
