"""Pictures of flights: the path over its reference, states and inputs over time.

Matplotlib is imported when the first picture is drawn; its figures are made directly, so nothing that other code has
set up with pyplot is touched.  The same flight gives the same file, byte for byte.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from diransac.atomic import write_with
from diransac.errors import SettingsError
from diransac.log import Log
from diransac.plots.flights import Flight, flights_of, last_number, leaves, path_box, shown
from diransac.plots.layout import WIDTH, laid_out
from diransac.plots.palette import INK, MUTED
from diransac.plots.panels import LIMIT_LOOK, draw_input, draw_path, draw_state, look, reference_look
from diransac.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["plot_flight"]

_DOTS_PER_INCH = 200
_METADATA = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
# Inches: the title, a line of the legend, what is free around them.
_TITLE, _LEGEND_LINE, _FREE = 0.27, 0.19, 0.16
# Inches: in the legend, a letter of a label, and the sample of a line with what is free around it.
_LETTER, _SAMPLE = 0.075, 0.65

_Entry = tuple[str, dict[str, Any]]


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
    ending = None if path is None else _ending(Path(path))
    flights = flights_of(trajectory, log)
    states, inputs = flights[0].reference.state_names, flights[0].reference.input_names
    entries, box = _legend_entries(flights), path_box(flights)
    figure, panels, path_panel = laid_out(states, inputs, box, _header(entries, title))
    for name in states:
        draw_state(panels[name], name, flights)
    for name in inputs:
        draw_input(panels[name], name, flights)
    if path_panel is not None and box is not None:
        draw_path(path_panel, flights, box)
    _draw_heading(figure, entries, title)
    if path is not None and ending is not None:
        _write(figure, Path(path), ending)
    return figure


# Heading -------------------------------------------------------------------------------------------------------------
def _legend_entries(flights: Sequence[Flight]) -> list[_Entry]:
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


def _legend_columns(entries: Sequence[_Entry]) -> int:
    """How many entries a line of the legend holds."""
    widths = [_SAMPLE + _LETTER * len(label) for label, _ in entries]
    return len(entries) if sum(widths) < WIDTH - 0.2 else max(1, int((WIDTH - 0.2) / max(widths)))


def _header(entries: Sequence[_Entry], title: str | None) -> float:
    """Height of title and legend, inches."""
    lines = -(-len(entries) // _legend_columns(entries))
    return _FREE + _LEGEND_LINE * lines + _TITLE * bool(title)


def _draw_heading(figure: Figure, entries: Sequence[_Entry], title: str | None) -> None:
    from matplotlib.lines import Line2D

    inch = 1.0 / figure.get_figheight()
    top = 1.0 - _FREE / 2.0 * inch
    if title:
        figure.text(0.08 / WIDTH, top, title, fontsize=11.5, fontweight="bold", color=INK, va="top")
        top -= _TITLE * inch
    n_columns = _legend_columns(entries)
    in_lines = [entry for column in range(n_columns) for entry in entries[column::n_columns]]
    figure.legend(
        handles=[Line2D([], [], label=label, **style) for label, style in in_lines],
        loc="upper left",
        bbox_to_anchor=(0.06 / WIDTH, top),
        ncols=n_columns,
        frameon=False,
        fontsize=8.5,
        labelcolor=INK,
        borderaxespad=0.0,
        borderpad=0.2,
        handlelength=2.6,
        columnspacing=1.8,
    )


# File ----------------------------------------------------------------------------------------------------------------
def _ending(path: Path) -> str:
    ending = path.suffix.lower()
    if ending not in _METADATA:
        raise SettingsError(f'cannot write "{path}": its ending is not known; use one of {", ".join(_METADATA)}')
    return ending


def _write(figure: Figure, path: Path, ending: str) -> None:
    from matplotlib import rc_context

    def write(temporary: Path) -> None:
        # An SVG names its parts by a hash, whose salt cannot be given in another way; it holds for this call alone.
        with rc_context({"svg.hashsalt": "diransac"}):
            figure.savefig(temporary, format=ending[1:], dpi=_DOTS_PER_INCH, metadata=_METADATA[ending])

    try:
        write_with(path, write)
    except OSError as error:
        raise SettingsError(f'cannot write "{path}": {error.strerror or error}') from error
