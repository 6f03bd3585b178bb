"""What an engineer does without the package: least squares and total least squares on filtered data.

Both know the bandwidth of the machine, and how its inputs are held.  Nothing happens when this file is run.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
from regime_flights import Recording, Regime
from regime_machines import Array, Machine
from scipy.interpolate import make_interp_spline
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
    """Zero-phase Butterworth of order four, there and back, along the last axis."""
    sections = butter(4, min(2.0 * bandwidth * dt, 0.9), output="sos")
    return np.asarray(sosfiltfilt(sections, values, padlen=min(values.shape[-1] - 1, int(3.0 / (bandwidth * dt)))))


def filtered(regime: Regime, recording: Recording) -> Filtered:
    """Filtered signals; those that are not logged are derived or integrated."""
    machine, model = regime.machine, regime.machine.model
    columns, rows = bridged(recording.columns, round(1.0 / (machine.bandwidth * machine.dt)))
    inputs = np.stack([columns[name] for name in model.inputs])
    if regime.held:  # the filtered response is to the mean of what was held before and is held after the sample
        inputs[:, 1:] = 0.5 * (inputs[:, 1:] + inputs[:, :-1])
    smooth = {name: _lowpass(x, machine.bandwidth, machine.dt) for name, x in columns.items()}
    q, v, a = motion(machine, smooth)
    return Filtered(q, v, a, inputs, rows, machine.dt, machine.bandwidth)


def bridged(columns: Mapping[str, Array], margin: int) -> tuple[dict[str, Array], Array]:
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


def motion(machine: Machine, smooth: Mapping[str, Array], *, rough: bool = False) -> tuple[Array, Array, Array]:
    """Coordinates, velocities and accelerations (n, N); rough: 0 for those that cannot be derived.

    Raises
    ------
    NoBaselineError
        One of them can neither be found among the signals nor be derived from them.
    """
    model, dt = machine.model, machine.dt
    none = np.zeros_like(next(iter(smooth.values())))
    q, v = list[Array](), list[Array]()
    for i, name in enumerate(model.velocities):
        origin = _derivative_of(model, i)
        if name in smooth:
            v.append(smooth[name])
        elif origin in smooth:
            v.append(_differentiated(smooth[origin], dt))
        elif rough:
            v.append(none)
        else:
            raise NoBaselineError(f"needs {name}")
    for i, name in enumerate(model.coordinates):
        if name in smooth:
            q.append(smooth[name])
        elif i < model.n_v and _derivative_of(model, i) == name:
            q.append(np.cumsum(v[i]) * dt)
        else:
            raise NoBaselineError(f"needs {name}")
    a = [smooth[x] if x in smooth else _differentiated(w, dt) for x, w in zip(model.accelerations, v, strict=True)]
    return np.stack(q), np.stack(v), np.stack(a)


def _differentiated(values: Array, dt: float) -> Array:
    """Derivative of the interpolating spline of fifth degree."""
    time = dt * np.arange(len(values))
    return np.asarray(make_interp_spline(time, values, k=5).derivative()(time))


def _derivative_of(model: dr.Model, index: int) -> str | None:
    """Name of the coordinate whose derivative a velocity is, whatever the state; None where there is none."""
    if model.kinematics is None:
        return list(model.coordinates)[index]
    q, v = ca.SX.sym("q", model.n_q), ca.SX.sym("v", model.n_v)
    rates = model.kinematics(q, v)
    return next((name for i, name in enumerate(model.coordinates) if ca.is_equal(rates[i], v[index])), None)


# ---------------------------------------------------------------------- methods


def ordinary(regime: Regime, recording: Recording) -> dict[str, float]:
    """Least squares of the filtered equations, weighted by their terms, then once by their residuals.

    More rounds would let an equation without a known term vanish, with all of its parameters 0.
    """
    machine = regime.machine
    residual, jacobian = _equations(machine.model, filtered(regime, recording))
    values = base = np.array([machine.base[name] for name in machine.model.parameters])
    size = _rms(np.abs(jacobian(base) * base[:, None]).sum(axis=1))
    for equal in (True, False):
        weight = size if equal else np.maximum(_rms(residual(values)), 1e-6 * size)
        values = least_squares(
            lambda p, w=weight: (residual(p) / w[:, None]).ravel(),
            values,
            jac=lambda p, w=weight: _stacked(jacobian(p), w),
            x_scale=np.abs(base),
            xtol=1e-12,
            ftol=1e-12,
        ).x
    return dict(zip(machine.model.parameters, values.tolist(), strict=True))


def _rms(values: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(values**2, axis=-1)))


def _stacked(jacobian: Array, weight: Array) -> Array:
    """Rows of all equations (n_v N, n_p) of (n_v, n_p, N), each over its weight."""
    rows = (jacobian / weight[:, None, None]).transpose(0, 2, 1)
    return rows.reshape(-1, rows.shape[-1])


def _equations(model: dr.Model, data: Filtered) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
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
    zero, found = np.zeros(model.n_p), np.array(list(ordinary(regime, recording).values()))
    weight = _rms(residual(found))
    W, b = _stacked(jacobian(zero), weight), -(residual(zero) / weight[:, None]).ravel()
    both = np.column_stack([W, b])
    size = np.sqrt(np.mean(both**2, axis=0))
    smallest = np.linalg.svd(both / size, full_matrices=False)[2][-1] / size
    return dict(zip(model.parameters, (-smallest[:-1] / smallest[-1]).tolist(), strict=True))
