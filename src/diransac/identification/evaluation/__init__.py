"""Evaluation: an estimate against the logs that it was made from.

In: an `Estimate` and its `Dataset`.  Out: `Evaluation` (errors and inliers of one simulation, which methods use, too),
a `Prediction` per log, logs that disagree, and the findings of a result.  Begin with `simulation`.

| file | contents |
|---|---|
| `simulation.py`, `scoring.py` | simulations of a dataset; weights, thresholds, `evaluate` |
| `prediction.py` | a simulation of each log, row by row |
| `agreement.py` | logs that disagree with the others |
| `findings.py` | findings of a result; the verdict follows from them |
| `verdict.py` | findings of open-loop predictions, the one rule of `identify` and `validate` |
"""
