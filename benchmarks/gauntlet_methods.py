"""Methods of the gauntlet: functions ``(model, log) -> Estimate``.

A new method is one more such function in `METHODS`.  Where it does not apply, or finds nothing, it raises ValueError or
a `dr.DiransacError`: the table then has a dash.  Nothing happens when this file is run.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Any

import casadi as ca
import numpy as np
from scipy.optimize import least_squares
from sklearn.linear_model import HuberRegressor, LinearRegression, RANSACRegressor, TheilSenRegressor

import diransac as dr
from diransac.data.dataset import Dataset, bind_log
from diransac.identification.regression.rows import regression
from diransac.simulation import Measurements, RolloutBatch, rollouts

Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Estimate:
    """Parameters by name, and their 95 % intervals ``(low, high)`` where a method gives them."""

    parameters: Mapping[str, float]
    intervals: Mapping[str, tuple[float, float]] | None = None


Method = Callable[[dr.Model, dr.Log], Estimate]

FAR = 1e6
"""Spreads of a signal: what a diverged simulation is off by, and nothing is off by more."""


# ---------------------------------------------------------------------- this package's


def identified(method: str, settings: dr.Settings | None, model: dr.Model, log: dr.Log) -> Estimate:
    """What `dr.identify` gives."""
    result = dr.identify(model, log, method, settings=settings)
    return Estimate(result.parameters, result.intervals(0.95))


def least_squares_of(model: dr.Model) -> str:
    """Ordinary where the model is affine in its parameters."""
    return "nls" if model.nonlinear_parameters else "ols"


def hampel_least_squares(model: dr.Model, log: dr.Log) -> Estimate:
    """Spikes replaced by medians of 15 samples, then least squares."""
    return identified(least_squares_of(model), None, model, dr.despike(log, model.signals))


def hampel_i_diransac(model: dr.Model, log: dr.Log) -> Estimate:
    """Spikes replaced by medians of 15 samples, then I-DIRANSAC."""
    return identified("i-diransac", None, model, dr.despike(log, model.signals))


# ---------------------------------------------------------------------- scikit-learn on W p = b


def regressed(regressor: Callable[[], Any], model: dr.Model, log: dr.Log) -> Estimate:
    """A robust regressor on all equations, each divided by its median |b|, with columns of equal size."""
    W, b = regression(Dataset.of(model, log))
    size = np.median(np.abs(b), axis=0)
    W, b = (W / size[:, None]).reshape(-1, model.n_p), (b / size).reshape(-1)
    scale = np.sqrt(np.mean(W**2, axis=0))
    fitted = regressor().fit(W / scale, b)
    coefficients = getattr(fitted, "estimator_", fitted).coef_ / scale
    return Estimate(dict(zip(model.parameters, coefficients.tolist(), strict=True)))


SCIKIT_LEARN = {
    "sklearn RANSAC": lambda: RANSACRegressor(LinearRegression(fit_intercept=False), max_trials=1000, random_state=0),
    "sklearn Huber": lambda: HuberRegressor(fit_intercept=False, max_iter=1000),
    "sklearn Theil-Sen": lambda: TheilSenRegressor(fit_intercept=False, max_subpopulation=1000, random_state=0),
}


# ---------------------------------------------------------------------- SciPy's robust losses


def equation_error(loss: str, model: dr.Model, log: dr.Log) -> Estimate:
    """Robust loss of the residual ``r(q, v, a, u, p)`` in units of its spread at the start, Hampel + least squares."""
    start = np.array(list(hampel_least_squares(model, log).parameters.values()))
    seen = bind_log(model, log)
    rows = [x[seen.valid].T for x in (*seen.state_arrays(), seen.acting_inputs())]
    symbols = [ca.SX.sym(name, *model.residual.size_in(i)) for i, name in enumerate("qvaup")]
    r = model.residual(*symbols)
    outputs = ca.Function("outputs", symbols, [r, ca.densify(ca.jacobian(r, symbols[-1]))])

    def errors(p: Array) -> Array:
        return np.array(outputs(*rows, p)[0]).T / spread

    def jacobian(p: Array) -> Array:
        J = np.array(outputs(*rows, p)[1]).reshape(model.n_v, -1, model.n_p)  # columns: row by row, p by p
        return (J.transpose(1, 0, 2) / spread[:, None]).reshape(-1, model.n_p)

    spread = np.ones(model.n_v)
    spread = 1.4826 * np.median(np.abs(errors(start)), axis=0) + 1e-12
    found = least_squares(lambda p: errors(p).ravel(), start, jacobian, loss=loss, x_scale="jac")
    return Estimate(dict(zip(model.parameters, found.x.tolist(), strict=True)))


def output_error(model: dr.Model, log: dr.Log, max_evaluations: int = 40) -> Estimate:
    """Robust single shooting: simulate the whole log, soft-L1 loss in units of each signal's spread.

    Unknown are the parameters and the initial state; the start is Hampel + least squares, within bounds, and the first
    row.  Evaluations are capped, not seconds: answers do not depend on
    the machine.
    """
    seen, names = bind_log(model, log), (*model.parameters, *model.state)
    low, high = _bounds(model)
    first = np.clip(list(hampel_least_squares(model, log).parameters.values()), low[: model.n_p], high[: model.n_p])
    measured, valid = np.nan_to_num(seen.measured), np.isfinite(seen.measured)
    spread = 1.4826 * np.nanmedian(np.abs(seen.measured - np.nanmedian(seen.measured, axis=0)), axis=0)
    engine, measurements = rollouts(model, seen.signals), Measurements(measured, np.ones(len(seen), bool))

    def batch(z: Array) -> RolloutBatch:
        return RolloutBatch(z[None, : model.n_p], z[model.n_p :], seen.inputs, log.dt)

    def errors(z: Array) -> Array:
        e = engine.errors(batch(z), measurements)[0] / spread
        return np.where(valid, np.clip(np.nan_to_num(e, nan=FAR), -FAR, FAR), 0.0).ravel()

    def jacobian(z: Array) -> Array:
        found = engine.linearized_errors(batch(z), measurements, unknowns=names)
        near = valid & (np.abs(found.errors[0] / spread) < FAR)
        J = found.jacobian[0] / spread[:, None]
        return np.where(near[..., None] & (np.abs(J) < 1e100), J, 0.0).reshape(-1, len(names))

    start = np.concatenate([first, seen.initial_state("robust")])
    found = least_squares(
        errors, start, jacobian, bounds=(low, high), loss="soft_l1", x_scale="jac", max_nfev=max_evaluations
    )
    return Estimate(dict(zip(model.parameters, found.x[: model.n_p].tolist(), strict=True)))


def _bounds(model: dr.Model) -> tuple[Array, Array]:
    """Of the parameters, strictly inside, then of the initial state, which has none."""
    low = [max(x.lower, 1e-9) if x.positive else x.lower - 1e-12 for x in model.parameters.values()]
    high = [x.upper for x in model.parameters.values()]
    free = np.full(len(model.state), np.inf)
    return np.concatenate([low, -free]), np.concatenate([high, free])


def mujoco_sysid(model: dr.Model, log: dr.Log) -> Estimate:
    """MuJoCo's own identification, of the vehicles that MuJoCo has; from Hampel + least squares."""
    from gauntlet_mujoco import fitted

    return Estimate(fitted(model, log, dict(hampel_least_squares(model, log).parameters)))


METHODS: dict[str, Method] = {
    **{name: partial(identified, name, None) for name in dr.METHODS},
    "diransac (Table IV)": partial(identified, "diransac", dr.Settings.table_iv()),
    "i-diransac (Table IV)": partial(identified, "i-diransac", dr.Settings.table_iv()),
    "Hampel + least squares": hampel_least_squares,
    "Hampel + i-diransac": hampel_i_diransac,
    **{name: partial(regressed, regressor) for name, regressor in SCIKIT_LEARN.items()},
    "SciPy soft-L1": partial(equation_error, "soft_l1"),
    "SciPy Cauchy": partial(equation_error, "cauchy"),
    "SciPy output error": output_error,
    **({"mujoco.sysid": mujoco_sysid} if find_spec("mujoco") else {}),
}
