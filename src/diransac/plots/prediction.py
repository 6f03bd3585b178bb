"""Figure of a simulation beside the measured signals."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.log import Log
from diransac.plots.figure import (
    COLOURS,
    MUTED,
    REFERENCE,
    check_ending,
    draw_heading,
    flight_panels,
    header_height,
    name_panel,
    write,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure

__all__ = ["plot_prediction"]

_MEASURED: dict[str, Any] = {"color": REFERENCE, "linestyle": "none", "marker": ".", "markersize": 2.5}
_SIMULATED: dict[str, Any] = {"color": COLOURS[0], "linewidth": 1.3}


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
    entries = [("simulated", _SIMULATED), ("measured", _MEASURED)]
    figure, panels, _ = flight_panels(states, inputs, None, header_height(entries, None))
    draw_heading(figure, entries, None)
    for name, axes in panels.items():
        name_panel(axes, name, simulated.units.get(name, ""))
        if name in inputs:
            axes.plot(simulated.time, simulated[name], color=MUTED, linewidth=1.0)
            continue
        axes.plot(simulated.time, simulated[name], zorder=3, **_SIMULATED)
        low, high = _range(simulated[name])
        if name in measured:
            axes.plot(measured.time, measured[name], zorder=2, **_MEASURED)
            finite = measured[name][np.isfinite(measured[name])]
            if len(finite):
                bulk = np.quantile(finite, [0.01, 0.99])
                low, high = min(low, float(bulk[0])), max(high, float(bulk[1]))
        margin = 0.06 * (high - low) or 1.0
        axes.set_ylim(low - margin, high + margin)
    return write(figure, path)


def _range(values: FloatArray) -> tuple[float, float]:
    """Smallest and largest finite value."""
    return float(np.nanmin(values)), float(np.nanmax(values))
