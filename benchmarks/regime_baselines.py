"""What an engineer does without the package: least squares and total least squares on filtered data.

Both know the bandwidth of the machine, and how its inputs are held.  Nothing happens when this file is run.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
from regime_flights import Recording, Regime
from regime_machines import Array, Machine
from scipy.optimize import least_squares
from scipy.signal import butter, sosfiltfilt

import diransac as dr


class NoBaselineError(Exception):
    """The method needs a signal that the log lacks, or does not apply to the model."""


# ---------------------------------------------------------------------- filtered data


@dataclass(frozen=True)
class Filtered:
    """Smoothed arguments of the model's equations, and which rows are to be used.

    Parameters
    ----------
    q, v, a, u : (n, N)
    rows : (N,) whether away from the ends and from gaps
    dt, bandwidth : s and Hz
    """

    q: Array
    v: Array
    a: Array
    u: Array
    rows: Array
    dt: float
    bandwidth: float

    def smoothed(self, values: Array) -> Array:
        """The same filter on the equations' two sides, along the last axis; usable rows, thinned to the bandwidth."""
        step = max(1, int(0.25 / (self.dt * self.bandwidth)))
        return _lowpass(values, self.bandwidth, self.dt)[..., self.rows][..., ::step]


def _lowpass(values: Array, bandwidth: float, dt: float) -> Array:
    """Fourth-order zero-phase Butterworth along the last axis."""
    sections = butter(2, min(2.0 * bandwidth * dt, 0.9), output="sos")
    return np.asarray(sosfiltfilt(sections, values, padlen=min(values.shape[-1] - 1, int(3.0 / (bandwidth * dt)))))


def filtered(regime: Regime, recording: Recording) -> Filtered:
    """Filtered signals; those that are not logged by central differences, coordinates by the rule of rectangles."""
    machine, model = regime.machine, regime.machine.model
    columns, rows = _bridged(recording.columns, round(1.0 / (machine.bandwidth * machine.dt)))
    inputs = np.stack([columns[name] for name in model.inputs])
    if regime.held:  # the filtered response is to the mean of what was held before and is held after the sample
        inputs[:, 1:] = 0.5 * (inputs[:, 1:] + inputs[:, :-1])
    smooth = {name: _lowpass(x, machine.bandwidth, machine.dt) for name, x in columns.items()}
    q, v, a = _motion(machine, smooth)
    return Filtered(q, v, a, inputs, rows, machine.dt, machine.bandwidth)


def _bridged(columns: Mapping[str, Array], margin: int) -> tuple[dict[str, Array], Array]:
    """Gaps filled by straight lines, and the rows more than a margin away from them and from the ends."""
    missing = ~np.all([np.isfinite(x) for x in columns.values()], axis=0)
    missing[[0, -1]] = True
    near = np.convolve(missing, np.ones(2 * margin + 1), mode="same") > 0.5
    index = np.arange(len(missing))
    filled = {}
    for name, x in columns.items():
        known = np.isfinite(x)
        filled[name] = np.interp(index, index[known], x[known])
    return filled, ~near


def _motion(machine: Machine, smooth: Mapping[str, Array]) -> tuple[Array, Array, Array]:
    model, dt = machine.model, machine.dt
    coordinate_of = dict(zip(model.velocities, model.coordinates, strict=False))  # those that are plain derivatives
    q, v, a = dict[str, Array](), dict[str, Array](), dict[str, Array]()
    for name in model.velocities:
        origin = coordinate_of.get(name)
        if name in smooth:
            v[name] = smooth[name]
        elif origin in smooth and _is_derivative(model, name):
            v[name] = np.gradient(smooth[origin], dt)
        else:
            raise NoBaselineError(f"needs {name}")
    for name in model.coordinates:
        origin = next((w for w, x in coordinate_of.items() if x == name), None)
        if name in smooth:
            q[name] = smooth[name]
        elif origin and _is_derivative(model, origin):
            q[name] = np.cumsum(v[origin]) * dt
        else:
            raise NoBaselineError(f"needs {name}")
    for name, velocity in zip(model.accelerations, v.values(), strict=True):
        a[name] = smooth[name] if name in smooth else np.gradient(velocity, dt)
    return tuple(np.stack(list(x.values())) for x in (q, v, a))  # type: ignore[return-value]


def _is_derivative(model: dr.Model, velocity: str) -> bool:
    """Whether a velocity is the derivative of the coordinate of its place, whatever the state."""
    index = list(model.velocities).index(velocity)
    if model.kinematics is None:
        return True
    q, v = ca.SX.sym("q", model.n_q), ca.SX.sym("v", model.n_v)
    return bool(ca.is_equal(model.kinematics(q, v)[index], v[index]))


# ---------------------------------------------------------------------- methods


def ordinary(regime: Regime, recording: Recording) -> dict[str, float]:
    """Least squares of the filtered equations, each weighted by its residual; Gauss-Newton where not affine."""
    machine, data = regime.machine, filtered(regime, recording)
    residual, jacobian = _equations(machine.model, data)
    base = np.array([machine.base[name] for name in machine.model.parameters])
    scale, values = np.abs(base), base
    weight = np.maximum(np.sqrt(np.mean(residual(1.5 * base) ** 2, axis=1)), 1e-12)[:, None]
    for _ in range(4):
        values = least_squares(
            lambda p, w=weight: (residual(p) / w).ravel(),
            values,
            jac=lambda p, w=weight: (jacobian(p) / w[:, None]).transpose(0, 2, 1).reshape(-1, len(p)),
            x_scale=scale,
            xtol=1e-12,
            ftol=1e-12,
        ).x
        weight = np.sqrt(np.mean(residual(values) ** 2, axis=1))[:, None] + 1e-12
    return dict(zip(machine.model.parameters, values.tolist(), strict=True))


def _equations(model: dr.Model, data: Filtered):  # noqa: ANN202
    """Functions of p: filtered residuals (n_v, N) and their derivatives (n_v, n_p, N)."""
    n_rows = data.q.shape[1]
    q, v, a, u, p = (ca.SX.sym(n, k) for n, k in zip("qvaup", (*_sizes(model), model.n_p), strict=True))
    r = model.residual(q, v, a, u, p)
    both = ca.Function("both", [q, v, a, u, p], [r, ca.vec(ca.jacobian(r, p))]).map(n_rows)

    def evaluated(values: Array) -> tuple[Array, Array]:
        parts = both(data.q, data.v, data.a, data.u, np.repeat(values[:, None], n_rows, axis=1))
        r, flat = (np.array(part) for part in parts)
        return r, flat.reshape(model.n_p, model.n_v, n_rows).transpose(1, 0, 2)

    return (lambda p: data.smoothed(evaluated(p)[0])), (lambda p: data.smoothed(evaluated(p)[1]))


def _sizes(model: dr.Model) -> tuple[int, int, int, int]:
    return model.n_q, model.n_v, model.n_v, model.n_u


def total(regime: Regime, recording: Recording) -> dict[str, float]:
    """Total least squares of the filtered equations, columns scaled to equal size."""
    model = regime.machine.model
    if model.nonlinear_parameters:
        raise NoBaselineError("not affine in its parameters")
    residual, jacobian = _equations(model, filtered(regime, recording))
    ordinary_values = np.array(list(ordinary(regime, recording).values()))
    weight = np.sqrt(np.mean(residual(ordinary_values) ** 2, axis=1))[:, None] + 1e-12
    zero = np.zeros(model.n_p)
    W = (jacobian(zero) / weight[:, None]).transpose(0, 2, 1).reshape(-1, model.n_p)
    b = -(residual(zero) / weight).ravel()
    both = np.column_stack([W, b])
    size = np.sqrt(np.mean(both**2, axis=0))
    smallest = np.linalg.svd(both / size, full_matrices=False)[2][-1] / size
    return dict(zip(model.parameters, (-smallest[:-1] / smallest[-1]).tolist(), strict=True))
