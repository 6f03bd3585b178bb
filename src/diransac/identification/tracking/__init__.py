"""Parameters of a machine while it runs.

| file | content |
|---|---|
| `tracker.py` | `Tracker` and `track`: samples in, estimates out |
| `estimates.py` | `TrackedEstimate`, `Change`; their `History` |
| `stream.py` | samples on the grid of their clock; gaps, restarts, late and repeated ones; sensors that stop |
| `starting.py` | the problem, the first window, and a start by the default method |
| `window.py` | the fit of the last intervals, and what remains of those before |
| `changes.py` | steps and drifts of parameters: tested, compared, released, reported |
| `step_tests.py`, `forces.py` | their tests; larger unmodelled forces |
| `search.py`, `stepped_fits.py` | fits of a window with a step, and with larger forces instead |
| `surprise.py` | outliers where a machine may have changed |
"""

from diransac.identification.tracking.estimates import Change, TrackedEstimate
from diransac.identification.tracking.tracker import Tracker, refused_if_none, track

__all__ = ["Change", "TrackedEstimate", "Tracker", "refused_if_none", "track"]
