"""Figures of flights and studies. Matplotlib is imported when the first figure is drawn.

| file | content |
|---|---|
| `flight.py` | `plot_flight`: path, states and inputs of flights |
| `prediction.py` | simulated signals beside the measured ones |
| `study.py` | tracking errors and failures of a study, by level and method |
| `estimates.py` | parameter errors of a study |
| `paths.py` | flown paths of a study |
| `rows.py` | rows of marks on a logarithmic axis, for levels that are words |
| `figure.py` | colours, panels, heading, files |
"""

from diransac.plots.flight import plot_flight

__all__ = ["plot_flight"]
