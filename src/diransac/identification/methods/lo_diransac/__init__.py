"""The method lo-diransac: random minimal samples, consensus by simulation, local optimisation.

In comes a `Dataset`; out comes an `Estimate` with its `Diagnosis`.  Begin with `method.py`; the fit itself is
`identification/core`.

| file | content |
|---|---|
| `method.py`, `settings.py` | `LoDiransac`: the steps in their order; settings, checked |
| **the logs** | |
| `preparation.py` | logs in intervals; rows that are left out |
| `smoothing.py`, `unmeasured.py` | the motion without a model; states that no signal measures |
| **the search** | |
| `search.py`, `hypotheses.py` | the likeliest explanation; samples in weak form, consensus |
| `local_search.py` | explanations of a log, of which the likeliest is chosen |
| `integration_steps.py` | as few integration steps as leave the fit |
| **errors of recordings** | |
| `recording_errors.py` | search of delays, biases, lags, drifts |
| `input_noise.py` | noise of inputs, as errors that are unknowns of each interval |
| **parameters and findings** | |
| `projection.py`, `interval_effects.py` | parameters and covariance; effects of each interval |
| `motion_equations.py` | residuals and regressors on the motion |
| `diagnosing.py`, `checks.py` | the diagnosis by name; findings of a fit on itself |
| `parts.py`, `logs_alone.py` | parameters of parts of the logs, and of each log |
| `missing_terms.py`, `term_regression.py` | terms that the model may lack, and their weights |
| **comparison with other estimates** | |
| `competition.py`, `sources.py` | estimates by other means, of which one is the answer |
| `judge.py`, `forward.py` | their predictions of held-out blocks: of motion, and of forces |
| `simulation_error.py`, `segments.py` | one of them: simulation error of segments |
| **models without equations** | |
| `without_equations.py`, `prediction_error.py`, `interval_filter.py` | by a simulator alone |
"""

from diransac.identification.methods.lo_diransac.method import LoDiransac, configured

__all__ = ["LoDiransac", "configured"]
