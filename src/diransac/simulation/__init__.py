"""Many rollouts of a model at once: scored against a log, differentiated, or flown under feedback on the way.

Observation `j` is the state at `t_j`; then the input `u_j` is held to `t_{j+1}`; the acceleration at `t_j` is the one
under `u_j`.

| file | what it holds |
|---|---|
| `steps.py` | integrators, and their derivatives, as expressions |
| `engine.py` | `Rollouts`: their compiled form |
| `outcomes.py` | what rollouts give |
| `law.py` | feedback laws |
"""

from diransac.simulation.compiler.machine_code import default_threads
from diransac.simulation.feedback import Law
from diransac.simulation.integrators import INTEGRATORS, linearized_step
from diransac.simulation.outcomes import Flights, GaussNewton, LinearizedErrors, Scores, inlier_mask
from diransac.simulation.rollouts import Rollouts, rollouts

__all__ = [
    "INTEGRATORS",
    "Flights",
    "GaussNewton",
    "Law",
    "LinearizedErrors",
    "Rollouts",
    "Scores",
    "default_threads",
    "inlier_mask",
    "linearized_step",
    "rollouts",
]
