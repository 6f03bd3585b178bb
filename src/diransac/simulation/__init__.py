"""Batches of rollouts of a model: scored against a log, differentiated, or under feedback.

In come a model and arrays of lanes (`RolloutBatch`); out come scores, Gauss-Newton sums, errors or signals of each.
Begin with `batch.py`, then `Rollouts` in `rollouts.py`.

Observation `j` is the state at `t_j`; then the input `u_j` is held to `t_{j+1}`, or interpolated linearly to `u_{j+1}`;
the acceleration at `t_j` is the one under `u_j`.

| file | contents |
|---|---|
| `batch.py` | arguments and results, and `Simulator`, the interface of a back end |
| `integrators.py` | integration steps and their derivatives as expressions |
| `rollouts.py` | `rollouts`, and `Rollouts`, the compiled simulator |
| `mujoco.py` | `MujocoRollouts`, by MuJoCo |
| `compiler/` | expression graph to machine code |
"""

from diransac.simulation.batch import (
    ClosedLoopBatch,
    GaussNewtonBatch,
    LinearFeedback,
    LinearizedErrors,
    Measurements,
    RolloutBatch,
    ScoreBatch,
    Simulator,
    inlier_mask,
)
from diransac.simulation.compiler.machine_code import default_threads
from diransac.simulation.integrators import HOLDS, INTEGRATORS, linearized_step
from diransac.simulation.rollouts import Rollouts, rollouts

__all__ = [
    "HOLDS",
    "INTEGRATORS",
    "ClosedLoopBatch",
    "GaussNewtonBatch",
    "LinearFeedback",
    "LinearizedErrors",
    "Measurements",
    "RolloutBatch",
    "Rollouts",
    "ScoreBatch",
    "Simulator",
    "default_threads",
    "inlier_mask",
    "linearized_step",
    "rollouts",
]
