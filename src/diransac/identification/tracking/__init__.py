"""Parameters of a machine while it runs.

| file | content |
|---|---|
| `tracker.py` | `Tracker` and `track`: samples in, estimates out |
| `estimates.py` | `TrackedEstimate`, `Change` |
| `stream.py` | samples on the grid of their clock; gaps, restarts, late and repeated ones |
| `setup.py` | the problem, and intervals of a stream |
| `starting.py`, `cold_start.py` | the first window, and a start by the default method |
| `window.py`, `marginal.py` | the fit of the last intervals, and what remains of those before |
| `changes.py` | steps and drifts of parameters: tested, released, reported |
| `step_tests.py`, `forces.py`, `drift.py`, `doubt.py` | their tests; forces; rates; changes that remain possible |
| `surprise.py` | outliers where a machine may have changed |
| `sensors.py` | sensors that stop |
"""

from diransac.identification.tracking.estimates import Change, TrackedEstimate
from diransac.identification.tracking.tracker import Tracker, refused_if_none, track

__all__ = ["Change", "TrackedEstimate", "Tracker", "refused_if_none", "track"]
