"""What recording and transmission do to samples: steps of a converter, stuck values, outliers, dropouts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray

if TYPE_CHECKING:
    from diransac.data.log import Log
    from diransac.flight.corruption.draws import Draws
    from diransac.flight.corruption.specification import Noise

__all__ = ["leverage_rows", "quantised", "with_faults"]

_STREAMS = {"stuck": "freeze"}
"""Fault -> key of its random stream where that is not its name: another key gives other numbers for the same seed."""


def quantised(values: FloatArray, name: str, noise: Noise) -> FloatArray:
    """Samples (N,) rounded to multiples of the signal's step; as they are where there is none."""
    if isinstance(noise.quantisation, float):
        finite = values[np.isfinite(values)]
        step = noise.quantisation * float(np.ptp(finite)) if len(finite) else 0.0
    else:
        step = noise.quantisation.get(name, 0.0)
    return np.rint(values / step) * step if step > 0.0 else values


def leverage_rows(log: Log, noise: Noise) -> BoolArray:
    """Rows (N,) in which the signal that decides on one-sided offsets is largest.

    Raises LogError: the log has no such signal, or it is NaN throughout.
    """
    if noise.leverage_signal is None:
        return np.zeros(len(log), dtype=bool)
    log.check([noise.leverage_signal])
    size = np.abs(log[noise.leverage_signal])
    return np.asarray(size > np.nanquantile(size, noise.leverage_quantile))


def with_faults(values: FloatArray, name: str, noise: Noise, draws: Draws, strong: BoolArray) -> FloatArray:
    """Samples (N,) with stuck runs, outliers, one-sided offsets in ``strong`` rows and dropouts, in this order."""
    spared = np.arange(len(values)) < (noise.first_row == "clean")
    stuck = _runs("stuck", name, noise, draws) & ~spared
    recorded = values[np.maximum.accumulate(np.where(stuck, 0, np.arange(len(values))))]

    hit = draws.uniform("outlier", name) < noise.outlier_probability
    hit |= _runs("burst", name, noise, draws)
    outliers = noise.outlier_magnitude * (2.0 * draws.uniform("outlier size", name) - 1.0)
    recorded = np.where(hit & ~spared, recorded + outliers, recorded)

    pushed = strong & (draws.uniform("leverage", name) < noise.leverage_probability)
    offsets = noise.leverage_offset * draws.uniform("leverage size", name)
    recorded = np.where(pushed & ~spared, recorded + offsets, recorded)

    return np.where(_runs("dropout", name, noise, draws) & ~spared, np.nan, recorded)


def _runs(fault: str, name: str, noise: Noise, draws: Draws) -> BoolArray:
    """Rows (N,) in runs of a fault: burst, stuck or dropout."""
    stream = _STREAMS.get(fault, fault)
    signal = "" if noise.correlated else name
    return draws.runs(stream, signal, getattr(noise, f"{fault}_probability"), getattr(noise, f"{fault}_length"))
