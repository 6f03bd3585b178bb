"""Velocities and accelerations that a log lacks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from diransac.prepare.filters import convolve, kernels

if TYPE_CHECKING:
    from diransac.log import Log
    from diransac.model import Model

FloatArray = npt.NDArray[np.float64]


def differentiate(log: Log, model: Model, bandwidth: float | None = None) -> Log:
    """The log with the velocities and accelerations that the model names and the log lacks."""
    B = bandwidth or 20.0
    k = kernels(4 * B, log.dt)
    L = k.shape[1] // 2
    signals = {n: convolve(x - x.mean(), k[0]) + x.mean() for n, x in log.signals.items()}
    for q, v, a in zip(model.coordinates, model.velocities, model.accelerations, strict=True):
        x = log[q] - log[q].mean()
        signals.setdefault(v, convolve(x, k[1]))
        signals.setdefault(a, convolve(x, k[2]))
    rows = slice(L, len(log) - L)
    step = {"step": "differentiate", "bandwidth": B, "row_filter": B}
    return log.with_step(step, time=log.time[rows], signals={n: x[rows] for n, x in signals.items()})


def filter_rows(log: Log, array: npt.NDArray[Any]) -> FloatArray:
    """The regression's rows (N, ...), filtered as `differentiate` recorded; as they are where it was not used."""
    steps = [step for step in log.history if "row_filter" in step]
    if not steps:
        return array
    return convolve(np.nan_to_num(array), kernels(steps[-1]["row_filter"], log.dt)[0])
