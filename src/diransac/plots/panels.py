"""What is drawn in a panel: a state or an input over time, or the path."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.plots.flights import Flight, Range, around, extent, last_number, leaves, near, shown
from diransac.plots.layout import inches, name_panel
from diransac.plots.palette import INK, MUTED, PAPER, REFERENCE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from diransac.flight.trajectory import Trajectory

__all__ = ["LIMIT_LOOK", "draw_input", "draw_path", "draw_state", "look", "reference_look"]


LIMIT_LOOK: dict[str, Any] = {"color": MUTED, "linewidth": 0.9, "linestyle": (0.0, (1.0, 2.0))}
# How many attitudes are drawn; inches: how long each arm of a bar is, and what lies between lines of the path's grid.
_ATTITUDES, _ARM, _GRID = 20, 0.085, 0.6


def look(flight: Flight) -> dict[str, Any]:
    """How a flight's line looks."""
    style: Any = (0.0, flight.dashes) if flight.dashes else "-"
    return {"color": flight.colour, "linewidth": 1.25, "linestyle": style}


def reference_look(flights: Sequence[Flight]) -> dict[str, Any]:
    """How references look: one for all is broad and grey, one's own is thin and as its flight is coloured."""
    if _is_shared(flights):
        return {"color": REFERENCE, "linewidth": 2.8, "solid_capstyle": "round"}
    return {"linewidth": 2.6, "alpha": 0.3, "solid_capstyle": "round"}


def _is_shared(flights: Sequence[Flight]) -> bool:
    return all(flight.reference is flights[0].reference for flight in flights)


def _draw_references(axes: Axes, x: str, y: str, flights: Sequence[Flight], **more: Any) -> None:
    for flight in flights[:1] if _is_shared(flights) else flights:
        horizontal = flight.reference.time if x == "t" else flight.reference[x]
        style = {"color": flight.colour} | reference_look(flights) | more
        axes.plot(horizontal, flight.reference[y], **style, zorder=1.8)


# Over time -----------------------------------------------------------------------------------------------------------
def draw_state(axes: Axes, name: str, flights: Sequence[Flight]) -> None:
    """A state over time, each flight's over its reference."""
    visible = shown(name, flights)
    _draw_references(axes, "t", name, flights)
    for flight in flights:
        axes.plot(flight.log.time, near(flight.log[name], visible), **look(flight), zorder=2.5)
        _mark_end(axes, flight, flight.log[name], visible)
    _frame(axes, name, _unit(name, flights), visible, flights)


def draw_input(axes: Axes, name: str, flights: Sequence[Flight]) -> None:
    """An input over time, held from row to row, and its limits where they come into view."""
    visible = shown(name, flights)
    _draw_references(axes, "t", name, flights, drawstyle="steps-post")
    for flight in flights:
        values = near(flight.log[name], visible)
        axes.plot(flight.log.time, values, drawstyle="steps-post", **look(flight), zorder=2.5)
        _mark_end(axes, flight, flight.log[name], visible)
    detail = _unit(name, flights)
    limits = flights[0].reference.input_limits.get(name)
    if limits is not None:
        for limit in limits:
            if visible[0] <= limit <= visible[1]:
                axes.axhline(limit, **LIMIT_LOOK, zorder=2.2)
        detail = f"{detail}, limits {_number(limits[0])} to {_number(limits[1])}".removeprefix(", ")
    _frame(axes, name, detail, visible, flights)


def _frame(axes: Axes, name: str, detail: str, visible: Range, flights: Sequence[Flight]) -> None:
    times = [time for flight in flights for time in (flight.reference.time, flight.log.time)]
    axes.set(xlim=(min(float(t[0]) for t in times), max(float(t[-1]) for t in times)), ylim=visible)
    axes.xaxis.set_major_formatter("{x:g} s")
    name_panel(axes, name, detail)


def _mark_end(axes: Axes, flight: Flight, values: FloatArray, visible: Range) -> None:
    """A triangle where a flight first leaves the panel, else a cross where its numbers end."""
    time = flight.log.time
    if (row := leaves(values, visible)) is not None:
        above = values[row] > visible[1]
        _mark(axes, time[row], visible[1] if above else visible[0], "^" if above else "v", flight)
    elif (row := last_number(values)) is not None:
        _mark(axes, time[row], values[row], "X", flight)


def _mark(axes: Axes, x: float, y: float, marker: str, flight: Flight) -> None:
    edge: dict[str, Any] = {"markeredgecolor": PAPER, "markeredgewidth": 0.6}
    axes.plot([x], [y], marker, color=flight.colour, markersize=6.5, **edge, clip_on=False, zorder=4)


def _unit(name: str, flights: Sequence[Flight]) -> str:
    return next((flight.log.units[name] for flight in flights if name in flight.log.units), "")


def _number(x: float) -> str:
    return f"{x:.4g}".replace("-", "−")


# The path ------------------------------------------------------------------------------------------------------------
def draw_path(axes: Axes, flights: Sequence[Flight], needed: tuple[Range, Range]) -> None:
    """The paths in the XZ plane, x and z to one scale; the attitude of a single flight that has a theta."""
    from matplotlib.ticker import MultipleLocator

    width, height = inches(axes)
    scale = max(extent(needed[0]) / width, extent(needed[1]) / height)
    box = around(needed[0], scale * width), around(needed[1], scale * height)
    _draw_references(axes, "x", "z", flights)
    for flight in flights:
        x, z = (near(flight.log[name], visible) for name, visible in zip(("x", "z"), box, strict=True))
        axes.plot(x, z, **look(flight), zorder=2.5)
        _mark_path_end(axes, flight, box)
    if len(flights) == 1 and "theta" in flights[0].reference.state_names:
        _draw_attitudes(axes, flights[0], box, reach=_ARM * scale)
    _mark_start(axes, flights[0].reference, box)
    axes.set(xlim=box[0], ylim=box[1], aspect="equal")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MultipleLocator(_round_step(_GRID * scale)))
    unit = _unit("x", flights)
    axes.xaxis.set_major_formatter(f"{{x:g}} {unit}" if unit else "{x:g}")
    name_panel(axes, "path", f"z over x, {unit}" if unit else "z over x")


def _round_step(least: float) -> float:
    """The smallest of 1, 2 and 5 times a power of ten that is no less."""
    decade = 10.0 ** np.floor(np.log10(least))
    return float(min(step for step in (1.0, 2.0, 5.0, 10.0) if step * decade >= least) * decade)


def _mark_start(axes: Axes, reference: Trajectory, box: tuple[Range, Range]) -> None:
    (x0, x1), (z0, z1) = reference["x"][[0, -1]], reference["z"][[0, -1]]
    together = np.hypot(x1 - x0, z1 - z0) < 0.04 * max(map(extent, box))
    places = [(x0, z0, "o", "start, end" if together else "start"), (x1, z1, "s", "" if together else "end")]
    for x, z, marker, text in places:
        axes.plot([x], [z], marker, markersize=5, markerfacecolor=PAPER, markeredgecolor=INK, zorder=5)
        side = -1 if x > box[0][1] - 0.03 * extent(box[0]) else 1
        place: dict[str, Any] = {"xytext": (7 * side, -5), "textcoords": "offset points", "va": "top"}
        place["ha"] = "left" if side > 0 else "right"
        axes.annotate(text, (x, z), **place, fontsize=8, color=INK, zorder=5)


def _mark_path_end(axes: Axes, flight: Flight, box: tuple[Range, Range]) -> None:
    """As over time, the triangle pointing over the edge that the flight is farthest beyond."""
    x, z = flight.log["x"], flight.log["z"]
    beyond = np.array([x - box[0][1], box[0][0] - x, z - box[1][1], box[1][0] - z])
    rows = np.flatnonzero((beyond > 0.0).any(axis=0))
    if len(rows):
        row = int(rows[0])
        marker = "><^v"[int(np.argmax(beyond[:, row]))]
        _mark(axes, float(np.clip(x[row], *box[0])), float(np.clip(z[row], *box[1])), marker, flight)
    elif (last := last_number(x + z)) is not None:
        _mark(axes, x[last], z[last], "X", flight)


def _draw_attitudes(axes: Axes, flight: Flight, box: tuple[Range, Range], reach: float) -> None:
    """The body's axis x as a bar and its axis z as a tick, theta from x towards z, every so many seconds."""
    from matplotlib.collections import LineCollection

    rows = np.linspace(0, len(flight.log) - 1, _ATTITUDES).astype(int)
    x, z, theta = (flight.log[name][rows] for name in ("x", "z", "theta"))
    seen = (x > box[0][0]) & (x < box[0][1]) & (z > box[1][0]) & (z < box[1][1]) & np.isfinite(theta)
    centre = np.column_stack([x, z])[seen]
    along = np.column_stack([np.cos(theta), np.sin(theta)])[seen] * reach
    up = 0.7 * np.column_stack([-along[:, 1], along[:, 0]])
    bars, ticks = np.stack([centre - along, centre + along], axis=1), np.stack([centre, centre + up], axis=1)
    for lines, width in ((bars, 1.4), (ticks, 0.9)):
        axes.add_collection(LineCollection(list(lines), colors=INK, linewidths=width, zorder=3), autolim=False)
