"""Figures of flights and studies. Matplotlib is imported when the first figure is drawn.

In come logs, or a store; out comes a figure, and a file that is the same byte for byte each time.  Begin with
`figure.py`, which all others draw with.

| file | content |
|---|---|
| `figure.py` | colours, panels, heading, files |
| `flight.py` | `plot_flight`: path, states and inputs of flights; simulated signals beside measured ones |
| `study.py`, `estimates.py`, `paths.py` | tracking errors and failures, parameter errors, and flown paths of a study |
| `fleet.py`, `tracking.py` | parameters of a fleet, and of a machine over time |
"""

from diransac.plots.flight import plot_flight

__all__ = ["plot_flight"]
