"""Judges of held-out records in NumPy, apart from the package: prediction by windows, one simulation, torques."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import diransac as dr

Array = np.ndarray[Any, Any]
Rates = Callable[[Array, Array, Array], Array]
"""``(x, u, p) -> dx/dt`` of lanes: states (n_x, L), inputs (n_u, L), parameters (n_p,)."""
CAP, KEPT = 10.0, 0.95
"""Largest error of a window, spreads, so that one that diverges counts; part of the windows that a score keeps."""


def slopes(x: Array, dt: float, width: int) -> tuple[Array, Array]:
    """Cubic polynomials through an odd number of rows of (N, n): value and derivative in the middle of each."""
    t = (np.arange(width) - width // 2) * dt
    value, slope = np.linalg.pinv(np.vander(t, 4, increasing=True))[:2]
    padded = np.pad(x, ((width // 2, width // 2), (0, 0)), mode="edge")
    rows = np.lib.stride_tricks.sliding_window_view(padded, width, axis=0)
    return rows @ value, rows @ slope


@dataclass(frozen=True)
class Acting:
    """Inputs (N, n_u) between rows, as a result states that they act: held or interpolated, late, with a lag."""

    u: Array
    dt: float
    hold: str = "zero-order"
    delay: float = 0.0
    lag: float = 0.0

    @classmethod
    def of(cls, result: dr.Result, u: Array, dt: float) -> Acting:
        """As the estimate has it."""
        resolution = result.estimate.resolution
        return cls(u, dt, resolution.hold, resolution.timing.delay, resolution.timing.lag)

    def stages(self, substeps: int) -> Array:
        """Inputs (N - 1, 2 substeps + 1, n_u) at the stages of Runge-Kutta from each row to the next."""
        rows, between = np.arange(len(self.u)), np.linspace(1e-9, 1.0 - 1e-9, 2 * substeps + 1)
        at = np.clip(rows[:-1, None] + between - self.delay / self.dt, 0.0, rows[-1])
        if self.hold == "zero-order":
            found = self.u[at.astype(int)]
        elif self.hold == "linear":
            found = np.stack([np.interp(at, rows, one) for one in self.u.T], axis=-1)
        else:
            found = _smooth(self.u, at)
        return self._lagged(found) if self.lag > 0.0 else found

    def _lagged(self, u: Array) -> Array:
        keep = np.exp(-self.dt / (u.shape[1] - 1) / self.lag)
        x, found = u[0, 0], np.empty_like(u)
        for k, row in enumerate(u):
            for i, one in enumerate(row):
                found[k, i] = x
                x = x if i == len(row) - 1 else keep * x + (1.0 - keep) * one
        return found


def _smooth(u: Array, at: Array) -> Array:
    """Cubic interpolation through four rows of (N, n_u), at fractions of rows."""
    begin = np.clip(at.astype(int), 1, len(u) - 3)
    s = (at - begin)[..., None]
    a, b, c, d = (u[begin + k] for k in range(-1, 3))
    return (
        -s * (s - 1) * (s - 2) / 6 * a + (s + 1) * (s - 1) * (s - 2) / 2 * b
        - (s + 1) * s * (s - 2) / 2 * c + (s + 1) * s * (s - 1) / 6 * d
    )  # fmt: skip


def rolled(rates: Rates, p: Array, x: Array, stages: Array, begins: Array, steps: int, dt: float) -> Array:
    """States (steps + 1, n_x, L) from x (n_x, L), lane l beginning at row begins[l]."""
    substeps = (stages.shape[1] - 1) // 2
    h, found = dt / substeps, np.empty((steps + 1, *x.shape))
    found[0] = x
    with np.errstate(all="ignore"):
        for k in range(steps):
            u = stages[begins + k].transpose(1, 2, 0)
            for i in range(0, 2 * substeps, 2):
                k1 = rates(x, u[i], p)
                k2 = rates(x + h / 2 * k1, u[i + 1], p)
                k3 = rates(x + h / 2 * k2, u[i + 1], p)
                x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rates(x + h * k3, u[i + 2], p))
            found[k + 1] = x
    return np.nan_to_num(found, nan=1e6, posinf=1e6, neginf=-1e6)


@dataclass(frozen=True)
class Windows:
    """Open-loop prediction of held-out logs from states that polynomials smooth.

    Parameters
    ----------
    model : whose coordinates are measured
    rates : of its coordinates and their velocities
    logs : held out
    horizons : s, ascending
    width : rows of the polynomials, odd
    """

    model: dr.Model
    rates: Rates
    logs: Sequence[dr.Log]
    horizons: tuple[float, ...]
    width: int

    def __call__(self, result: dr.Result) -> float:
        """Root mean square over horizons and coordinates of robust errors, in each coordinate's standard deviation."""
        spread = np.std(np.concatenate([self._columns(log, self.model.coordinates) for log in self.logs]), axis=0)
        p = np.array([result.parameters[name] for name in self.model.parameters])
        errors = [self._errors(result, p, log, spread) for log in self.logs]
        return float(np.sqrt(np.mean([robust(np.concatenate(one, axis=1)) for one in zip(*errors, strict=True)])))

    def _errors(self, result: dr.Result, p: Array, log: dr.Log, spread: Array) -> list[Array]:
        """Mean squares (n_q, windows) of a log at each horizon."""
        y, u = self._columns(log, self.model.coordinates), self._columns(log, self.model.inputs)
        steps = round(self.horizons[-1] / log.dt)
        begins = np.arange(self.width, len(y) - steps - self.width, round(self.horizons[0] / log.dt))
        start = np.concatenate(slopes(y, log.dt, self.width), axis=1)[begins].T
        x = rolled(self.rates, p, start, Acting.of(result, u, log.dt).stages(2), begins, steps, log.dt)
        off = (x[:, : len(spread)] - y[begins + np.arange(steps + 1)[:, None]].transpose(0, 2, 1)) / spread[:, None]
        squares = np.minimum(np.abs(off), CAP) ** 2
        return [squares[1 : round(h / log.dt) + 1].mean(axis=0) for h in self.horizons]

    @staticmethod
    def _columns(log: dr.Log, names: Sequence[str]) -> Array:
        """Columns (N, n), with short gaps interpolated."""
        seen = [np.isfinite(log[name]) for name in names]
        bridged = [np.interp(log.time, log.time[k], log[n][k]) for n, k in zip(names, seen, strict=True)]
        return np.column_stack(bridged)


def robust(squares: Array) -> Array:
    """Mean (n,) of squares (n, windows) without the largest of each row."""
    return np.sort(squares, axis=1)[:, : max(1, int(np.ceil(KEPT * squares.shape[1])))].mean(axis=1)


def torque_error(result: dr.Result, logs: Sequence[dr.Log], width: int) -> float:
    """Torque that held-out motion needs, by the equations: RMS error over RMS, %, geometric mean over joints and logs.

    Positions, velocities and torques are smoothed by the same polynomials, and accelerations are the velocities'
    slopes.
    """
    model, errors = result.model, []
    p = [result.parameters[name] for name in model.parameters]
    for log in logs:
        q, v, u = (
            np.column_stack([log[name] for name in names])
            for names in (model.coordinates, [f"{name}_dot" for name in model.coordinates], model.inputs)
        )
        (q, _), (v, a), (u, _) = (slopes(x, log.dt, width) for x in (q, v, u))
        W, b = (np.array(x) for x in model.regressor.map(len(q))(q.T, v.T, a.T, u.T))
        n_q = q.shape[1]
        W = W.reshape(n_q, len(q), -1) if W.shape[1] == len(q) * len(p) else W
        off = W @ np.array(p) - b
        errors.append(np.sqrt(np.mean(off**2, axis=1) / np.mean(u**2, axis=0)))
    return 100.0 * float(np.exp(np.mean(np.log(errors))))
