"""The method lo-diransac: random minimal samples, consensus by simulation, local optimisation.

| file | what it holds |
|---|---|
| `method.py` | the steps in their order, and what they find |
| `gate.py` | what is not to be used at all |
| `smoothing.py` | the motion without a model |
| `hypotheses.py` | samples in weak form, consensus |
| `freed.py` | the model with what it may lack |
| `windows.py` | the log as rollouts of that |
| `mixture.py` | noise: a Gaussian and outliers |
| `normal_equations.py`, `arrowhead.py` | all windows as one quadratic, and its solution in O(N) |
| `refinement.py` | local optimisation, from easy to exact |
| `readout.py` | parameters and covariance |
"""

from diransac.identification.methods.lo_diransac.method import Findings, find

__all__ = ["Findings", "find"]
