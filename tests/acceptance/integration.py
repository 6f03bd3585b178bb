"""Runge-Kutta of machines in NumPy, apart from the package: what simulates, and what judges, a log."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]
Rates = Callable[[float, Array, Array], Array]
"""``(t, x, u) -> dx/dt``."""


def step(rates: Rates, t: float, x: Array, u: Array, h: float) -> Array:
    """State after h seconds under a constant input, by the classical fourth-order method."""
    k1 = rates(t, x, u)
    k2 = rates(t + h / 2, x + h / 2 * k1, u)
    k3 = rates(t + h / 2, x + h / 2 * k2, u)
    k4 = rates(t + h, x + h * k3, u)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def simulated(
    rates: Rates,
    start: Sequence[float],
    control: Callable[[float, Array], Sequence[float]],
    rows: int,
    dt: float,
    substeps: int = 10,
    delay: float = 0.0,
) -> tuple[Array, Array, Array]:
    """Time (rows,), states (rows, n_x) and commanded inputs (rows, n_u), which are held from row to row.

    Parameters
    ----------
    rates : ``(t, x, u) -> dx/dt``
    start : state at row 0
    control : ``(t, x) -> u``
    rows, dt, substeps : of the log, s, and steps of integration per row
    delay : s, a whole number of integration steps, after which a command acts
    """
    x, h, late = np.array(start, dtype=float), dt / substeps, round(delay * substeps / dt)
    states, inputs = [], []
    for k in range(rows):
        states.append(x)
        inputs.append(np.asarray(control(k * dt, x), dtype=float))
        for i in range(substeps):
            acting = inputs[max(0, (k * substeps + i - late) // substeps)]
            x = step(rates, k * dt + i * h, x, acting, h)
    return dt * np.arange(rows), np.array(states), np.array(inputs)


def multisine(rng: np.random.Generator, rms: float, low: float, high: float, n: int = 6) -> Callable[[float], float]:
    """Sum of sines of log-uniform frequencies, Hz, and random phases."""
    rates = 2.0 * np.pi * np.exp(rng.uniform(np.log(low), np.log(high), n))
    phases = rng.uniform(0.0, 2.0 * np.pi, n)
    return lambda t: float(rms * np.sqrt(2.0 / n) * np.sin(rates * t + phases).sum())


def coloured(rng: np.random.Generator, rms: float, time: float, rows: int, dt: float) -> Array:
    """Gauss-Markov noise (rows,) of a correlation time, s."""
    keep = np.exp(-dt / time)
    x = np.empty(rows)
    x[0] = rms * rng.standard_normal()
    for k, kick in enumerate(rng.standard_normal(rows - 1)):
        x[k + 1] = keep * x[k] + rms * np.sqrt(1.0 - keep**2) * kick
    return x
