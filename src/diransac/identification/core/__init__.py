"""The estimator: windows of logs, their unknowns, and the one loop that fits them.

- `rows`: the equations ``W p = b`` of any averaging, and their one solver.
- `windows`: `Windows`, logs as windows, each a rollout of its own; inputs as they act; the augmented model.
- `theta`: the vector of shared unknowns, with bounds, priors and places of each log; errors of recordings in it.
- `noise`: mixture of a Gaussian and outliers of each signal.
- `arrowhead`: block tridiagonal systems with a border, eliminated in O(N).
- `boundary`: what is known from before a window of a log.
- `fit`: `Fit`, a fit as data: states, unmodelled accelerations, theta, scales, residuals.
- `columns`: columns of effects, and score tests of effects that a fit lacks.
- `equations`: Gauss-Newton system at a fit.
- `scales`: sizes of unmodelled accelerations and of jumps, by evidence.
- `minimise`: the loop, its schedules and the evidence of a fit.
"""
