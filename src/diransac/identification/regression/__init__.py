"""Regression: parameters from rows of equations, and from simulations that samples drive.

`rows` makes ``W p = b`` from a dataset.  An estimator (`estimators`, `nonlinear`, `scikit_learn`) is bound to it, tests
sets of rows, and fits them; `uncertainty` has their standard errors.  `observers` follow samples, for states that
nothing measures; `multistart` is least squares of simulations from many starts.  Begin with `estimators`.
"""
