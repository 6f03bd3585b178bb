"""What recording and transmission do to samples: steps of a converter, frozen values, outliers, dropouts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray

if TYPE_CHECKING:
    from diransac.data.log import Log
    from diransac.flight.corruption.draws import Draws
    from diransac.flight.corruption.specification import Noise

__all__ = ["leverage_rows", "quantised", "with_faults"]


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
    """Samples (N,) with frozen runs, outliers, one-sided offsets in ``strong`` rows and dropouts, in this order."""
    spared = np.arange(len(values)) < (noise.first_row == "clean")
    frozen = _runs("freeze", name, noise, draws) & ~spared
    recorded = values[np.maximum.accumulate(np.where(frozen, 0, np.arange(len(values))))]

    hit = draws.uniform("outlier", name) < noise.outlier_probability
    hit |= _runs("burst", name, noise, draws)
    outliers = noise.outlier_magnitude * (2.0 * draws.uniform("outlier size", name) - 1.0)
    recorded = np.where(hit & ~spared, recorded + outliers, recorded)

    pushed = strong & (draws.uniform("leverage", name) < noise.leverage_probability)
    offsets = noise.leverage_offset * draws.uniform("leverage size", name)
    recorded = np.where(pushed & ~spared, recorded + offsets, recorded)

    return np.where(_runs("dropout", name, noise, draws) & ~spared, np.nan, recorded)


def _runs(effect: str, name: str, noise: Noise, draws: Draws) -> BoolArray:
    signal = name if noise.runs == "independent" else ""
    return draws.runs(effect, signal, getattr(noise, f"{effect}_probability"), getattr(noise, f"{effect}_length"))
