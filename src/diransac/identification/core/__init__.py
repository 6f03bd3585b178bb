"""Core: the estimator's own problems, below every method.

`rows` has the equations ``W p = b`` of any averaging, and their one solver.
"""
