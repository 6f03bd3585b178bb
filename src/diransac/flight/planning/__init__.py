"""Trajectory planning: direct transcription for any model, named trajectories, and designed experiments.

In come a `Plant` or `Result` and arguments; out comes a `Trajectory`, or a `PlanningError` that says what to relax.
Begin with `plan` in `planner.py`.

| file | content |
|---|---|
| `planner.py` | `plan`: the search for a solution, and the explanation where there is none |
| `trajectories.py` | square, star, sine, random waypoints, multisine |
| `task.py` | the arguments of a plan, checked; the trim at its start |
| `transcription.py` | the nonlinear program of a task: unknowns, values and exact derivatives |
| `stage.py` | one stage of it, compiled |
| `solver.py` | its solution by IPOPT |
| `experiment.py` | `design_experiment`: excitation within limits that is optimal for identification |
| `excitation.py`, `optimisation.py` | its Fourier series, limits and information; their optimisation |
"""

from diransac.flight.planning.experiment import Experiment, design_experiment
from diransac.flight.planning.planner import plan
from diransac.flight.planning.trajectories import multisine, random_waypoints, sine, square, star

__all__ = ["Experiment", "design_experiment", "multisine", "plan", "random_waypoints", "sine", "square", "star"]
