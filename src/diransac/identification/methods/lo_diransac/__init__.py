"""The method lo-diransac: random minimal samples, consensus by simulation, local optimisation.

| file | content |
|---|---|
| `settings.py` | settings, checked |
| `method.py` | `LoDiransac`: the steps in their order |
| `smoothing.py` | screening of samples, and the motion without a model |
| `hypotheses.py` | samples in weak form, consensus |
| `without_equations.py`, `following.py`, `prediction_error.py` | estimates of models that a simulator alone knows |
| `augmented_model.py` | the model with discrepancies |
| `shooting.py` | logs as intervals, each a rollout of the augmented model |
| `mixture.py` | noise: a Gaussian and outliers |
| `normal_equations.py`, `arrowhead.py` | all intervals as one quadratic, and its solution in O(N) |
| `refinement.py`, `gauss_newton.py` | local optimisation, from easy to exact, and its steps |
| `local_search.py` | explanations of a log, of which the likeliest is chosen |
| `recording_errors.py` | delays and biases of sensors, delays of inputs, gains that drift |
| `projection.py` | parameters and covariance |
| `checks.py` | findings of a fit on itself |
| `missing_terms.py`, `term_regression.py`, `term_evidence.py` | terms that the model may lack, and their weights |
"""

from diransac.identification.methods.lo_diransac.method import LoDiransac, configured

__all__ = ["LoDiransac", "configured"]
