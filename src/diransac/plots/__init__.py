"""Pictures of flights: the path over its reference, states and inputs over time.

Matplotlib is imported when the first picture is drawn; its figures are made directly, so nothing that other code has
set up with pyplot is touched.  The same flight gives the same file, byte for byte.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from diransac.data.log import Log
from diransac.flight.trajectory import Trajectory
from diransac.plots.flights import Flight, flights_of, last_number, leaves, path_box, shown
from diransac.plots.heading import Entry, draw_heading, header_height
from diransac.plots.layout import laid_out
from diransac.plots.palette import MUTED
from diransac.plots.panels import LIMIT_LOOK, draw_input, draw_path, draw_state, look, reference_look
from diransac.plots.writing import checked_ending, write

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["plot_flight"]


def plot_flight(
    trajectory: Trajectory | Mapping[str, Trajectory],
    log: Log | Mapping[str, Log],
    path: str | Path | None = None,
    *,
    title: str | None = None,
) -> Figure:
    """A flight, or several on one picture, over what was planned.

    Parameters
    ----------
    trajectory : the reference of all flights, or label -> reference of each; with names of its states and inputs
    log : what was flown, or label -> log, such as one a method; with those states and inputs
    path : ``.png``, ``.svg`` or ``.pdf`` to be written, whole or not at all; None writes nothing
    title : of the picture

    Returns a Matplotlib figure: the path in the XZ plane, if there are states x and z, with the attitude of a single
    flight where there is a theta; a panel a state; a panel an input, held from row to row, with its limits.  The
    reference is broad and grey, or pale in its flight's colour where each has its own.

    Axes show the references and as much of the flights as comes about as near as these are large, so one that diverges
    leaves the rest readable: a triangle marks where it leaves a panel, a cross where its numbers end.

    Raises SettingsError: labels that don't match, a trajectory without names, a file that cannot be written.
    LogError: a log lacks one of the trajectory's states or inputs.
    """
    if path is not None:
        checked_ending(Path(path))
    flights = flights_of(trajectory, log)
    states, inputs = flights[0].reference.state_names, flights[0].reference.input_names
    entries, box = _legend_entries(flights), path_box(flights)
    figure, panels, path_panel = laid_out(states, inputs, box, header_height(entries, title))
    for name in states:
        draw_state(panels[name], name, flights)
    for name in inputs:
        draw_input(panels[name], name, flights)
    if path_panel is not None and box is not None:
        draw_path(path_panel, flights, box)
    draw_heading(figure, entries, title)
    if path is not None:
        write(figure, Path(path))
    return figure


# Heading -------------------------------------------------------------------------------------------------------------
def _legend_entries(flights: Sequence[Flight]) -> list[Entry]:
    """Label and look of everything that the legend explains."""
    shared = "color" in reference_look(flights)
    name = "reference" if shared else "their references"
    entries = [(name, {"color": MUTED} | reference_look(flights)), *((f.label, look(f)) for f in flights)]
    states, inputs = flights[0].reference.state_names, flights[0].reference.input_names
    seen = {name: shown(name, flights) for name in (*states, *inputs)}
    limits = flights[0].reference.input_limits
    if any(seen[name][0] <= limit <= seen[name][1] for name in inputs for limit in limits.get(name, ())):
        entries.append(("limits", LIMIT_LOOK))
    marks: dict[str, Any] = {"color": MUTED, "linestyle": "none", "markersize": 6}
    if any(leaves(f.log[name], seen[name]) is not None for f in flights for name in seen):
        entries.append(("leaves the panel", {"marker": "^", **marks}))
    if any(last_number(f.log[name]) is not None for f in flights for name in seen):
        entries.append(("its numbers end", {"marker": "X", **marks}))
    return entries
