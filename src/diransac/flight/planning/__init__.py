"""Trajectories for any model: through waypoints at given or free times, or along a reference.

| file | what it holds |
|---|---|
| `planner.py` | `plan`, the one entry |
| `flights.py` | the paper's square, star and sine |
| `excitations.py` | flights for data, another with every seed: through random places, sums of sines |
| `request.py`, `trim.py` | what is asked for, checked; the inputs that hold a plant at rest |
| `problem.py` | from a task to a nonlinear program, and from its solution to a trajectory |
| `transcription.py` | the program: where each unknown stands, values and exact derivatives |
| `stage.py` | one stage of it, compiled |
| `solvers.py`, `snopt.py` | who solves it |
| `diagnosis.py` | why there is no plan |
"""

from diransac.flight.planning.excitations import multisine, random_waypoints
from diransac.flight.planning.flights import sine, square, star
from diransac.flight.planning.planner import plan

__all__ = ["multisine", "plan", "random_waypoints", "sine", "square", "star"]
