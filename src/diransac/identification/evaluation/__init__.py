"""Evaluation: an estimate against the logs that it was made from.

In: an `Estimate` and its `Dataset`.  Out: `Evaluation` (errors and inliers of one simulation, which methods use, too),
a `Prediction` per log, logs that disagree, and the findings of a result.  Begin with `simulation`.
"""
