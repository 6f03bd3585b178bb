"""Parameters of a machine while it runs.

| file | content |
|---|---|
| `tracker.py` | `Tracker` and `track`: samples in, estimates out |
| `estimates.py` | `TrackedEstimate`, `Change`; their `History` |
| `stream.py` | samples on the grid of their clock; gaps, restarts, late and repeated ones; sensors that stop |
| `starting.py` | the problem, the first window, and a start by the default method |
| `window.py` | the fit of the last intervals, and what remains of those before |
| `fits.py` | fits of some intervals, with larger unmodelled forces; what they leave to the intervals after them |
| `steps.py` | steps of parameters: their tests, fits with a step, and the search for the best explanation |
| `changes.py` | steps and drifts of parameters: compared, released, reported |
"""

from diransac.identification.tracking.estimates import Change, TrackedEstimate
from diransac.identification.tracking.tracker import Tracker, refused_if_none, track

__all__ = ["Change", "TrackedEstimate", "Tracker", "refused_if_none", "track"]
