"""Evaluation: an estimate against the logs that it was made from.

In: an `Estimate` and its `Dataset`.  Out: `Evaluation` (errors and inliers of one simulation, which methods use, too),
a `Prediction` per log, logs that disagree, and the findings of a result.  Begin with `simulation`.

| file | contents |
|---|---|
| `simulation.py`, `scoring.py` | simulations of a dataset; weights, thresholds, `evaluate` |
| `prediction.py` | rows that count, weakest window and unexplained accelerations of each log |
| `agreement.py` | logs that disagree with the others |
| `findings.py`, `verdict.py` | findings of a result; those of predictions, from which the verdict follows |
"""
