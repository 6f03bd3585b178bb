"""The motion, without a model: local polynomials that a coordinate shares with its velocity and acceleration.

In a window about each knot a polynomial of degree 4 is fitted to whatever is measured of a coordinate and its
derivatives.  Weights are Geman and McClure's, the scale of each signal a low quantile of its residuals, so that more
than half of the samples may be wrong; residuals start from a running median, and scales come down slowly, so that the
fit does not settle on the first majority that it meets (graduated non-convexity).

References: Geman, McClure 1987; Black, Rangarajan 1996; Yang, Antonante, Tzoumas, Carlone 2020 (graduated
non-convexity); Cleveland 1979 (robust local regression).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.ndimage import median_filter

from diransac.arrays import BoolArray, FloatArray
from diransac.identification.methods.lo_diransac.mixture import lower_scale

if TYPE_CHECKING:
    from diransac.model import Model

__all__ = ["Motion", "choose_half_width", "running_median", "smooth"]


_DEGREE, _STEPS = 4, 12
_MEDIAN = 31
_SHRINK = 0.3
_FLOOR = 1e-4
_AT_REST = 0.1
_NARROWEST = 25
_TRIALS = 24
# Residuals that a scale is taken from; more would only cost time.
_ENOUGH = 4000


@dataclass(frozen=True)
class Motion:
    """Smoothed signals ``(N, n_signals)``; spread and residual scale of each signal ``(n_signals,)``."""

    signals: FloatArray
    spread: FloatArray
    scale: FloatArray


def _chains(model: Model) -> list[list[int]]:
    """Columns among the model's signals of each quantity and of its derivatives."""
    n_q, n_v = model.n_q, model.n_v
    if model.kinematics is None:
        return [[d, n_q + d, n_q + n_v + d] for d in range(n_q)]
    return [[d] for d in range(n_q)] + [[n_q + d, n_q + n_v + d] for d in range(n_v)]


def smooth(model: Model, measured: FloatArray, known: BoolArray, centre: FloatArray, dt: float, half: int) -> Motion:
    """Smoothed signals of all rows from what is known.

    Parameters
    ----------
    measured, known : (N, n_signals)   in the model's order
    centre : (N, n_signals)   their `running_median`
    half : rows that a polynomial looks at to either side
    """
    N, n = measured.shape
    step = max(1, half // 2)
    rows, inside = _neighbourhoods(np.arange(0, N, step), half, N)
    offsets = np.arange(-half, half + 1)
    basis = _basis(offsets / half, half * dt)
    signals, scale = np.zeros((N, n)), np.zeros(n)
    blend = np.maximum(0.0, 1.0 - np.abs(offsets) / (step + 1.0))
    total = np.bincount(rows[inside], np.broadcast_to(blend, rows.shape)[inside], N)
    for columns in _chains(model):
        values, oks = measured[:, columns][rows], known[:, columns][rows] & inside[:, :, None]
        first = values - centre[:, columns][rows]
        fitted, scale[columns] = _fit(values, oks, first, basis[: len(columns)], _spread(centre[:, columns]))
        for j, column in enumerate(columns):
            signals[:, column] = np.bincount(rows[inside], (fitted[:, :, j] * blend)[inside], N) / total
    middle = np.where(known.any(axis=0), centre, signals)
    return Motion(signals, _spread(middle) + 1e-9, scale)


def choose_half_width(model: Model, measured: FloatArray, known: BoolArray, centre: FloatArray, dt: float) -> int:
    """The half width, of 25, 75, 225, ... rows, whose polynomials best foretell rows that they were not fitted to.

    A narrow window is noisy, a wide one is stiff; every other row is left out and predicted (cross-validation), and the
    error is a low quantile, so that outliers have no say.
    """
    N = len(measured)
    widths = [_NARROWEST * 3**k for k in range(20) if k == 0 or 8 * _NARROWEST * 3**k < N]
    losses = [_prediction_error(model, measured, known, centre, dt, half) for half in widths]
    return int(widths[int(np.argmin(losses))])


def _prediction_error(
    model: Model, measured: FloatArray, known: BoolArray, centre: FloatArray, dt: float, half: int
) -> float:
    """Sum over signals of the log of the left-out rows' robust scale, at knots spread over the log."""
    N, stride = len(measured), max(1, half // _NARROWEST)
    knots = np.linspace(min(half, N // 2), max(N - 1 - half, N // 2), _TRIALS).astype(int)
    offsets = np.arange(-half, half + 1, stride)
    rows = np.clip(knots[:, None] + offsets, 0, N - 1)
    even, near = np.arange(len(offsets)) % 2 == 0, np.abs(offsets) <= half // 2
    basis = _basis(offsets / half, half * dt)
    loss = 0.0
    for columns in _chains(model):
        values, oks = measured[:, columns][rows], known[:, columns][rows]
        first = values - centre[:, columns][rows]
        spread = _spread(centre[:, columns])
        fitted, _ = _fit(values, oks & even[:, None], first, basis[: len(columns)], spread)
        scale = _scale(values - fitted, oks & (near & ~even)[:, None])
        seen = oks.any(axis=(0, 1))
        loss += float(np.log(np.maximum(scale, _FLOOR * spread + 1e-12))[seen].sum())
    return loss


def _neighbourhoods(knots: npt.NDArray[np.int64], half: int, n_rows: int) -> tuple[npt.NDArray[np.int64], BoolArray]:
    """Rows about each knot (K, 2 half + 1), and which of them are in the log."""
    rows = knots[:, None] + np.arange(-half, half + 1)
    return np.clip(rows, 0, n_rows - 1), (rows >= 0) & (rows < n_rows)


def _spread(values: FloatArray) -> FloatArray:
    """Standard deviation of each column by the MAD; where half the samples rest at one value, by the central 80 %."""
    low, median, high = np.quantile(values, [0.1, 0.5, 0.9], axis=0)
    mad, wide = 1.4826 * np.median(np.abs(values - median), axis=0), (high - low) / 2.563
    return np.asarray(np.where(mad > _AT_REST * wide, mad, wide))


def running_median(measured: FloatArray, known: BoolArray) -> FloatArray:
    """Median over 31 rows, gaps bridged by straight lines; 0 for what is not measured."""
    rows, bridged = np.arange(len(measured)), np.zeros(measured.shape)
    for i in np.flatnonzero(known.any(axis=0)):
        bridged[:, i] = np.interp(rows, rows[known[:, i]], measured[known[:, i], i])
    return np.asarray(median_filter(bridged, size=(_MEDIAN, 1), mode="mirror"))


def _basis(t: FloatArray, unit: float) -> FloatArray:
    """Powers of scaled time and their derivatives, (3, n_t, 5)."""
    powers = np.arange(_DEGREE + 1)
    value = t[:, None] ** powers
    first = powers * t[:, None] ** np.maximum(powers - 1, 0) / unit
    second = powers * (powers - 1) * t[:, None] ** np.maximum(powers - 2, 0) / unit**2
    return np.stack([value, first, second])


def _fit(
    values: FloatArray, known: BoolArray, residuals: FloatArray, basis: FloatArray, spread: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Fitted values ``(K, n_t, c)`` and the scale of each of the c signals of one chain."""
    K, n_t, c = values.shape
    seen = known.any(axis=(0, 1))
    floor = _FLOOR * spread + 1e-12
    scale = np.maximum(_scale(residuals, known), floor)
    width = 3.0 * scale
    products = np.einsum("jta,jtb->tjab", basis, basis).reshape(n_t * c, -1)
    flat = basis.swapaxes(0, 1).reshape(n_t * c, -1)
    for _ in range(_STEPS):
        weights = np.where(known, 1.0 / np.square(1.0 + np.square(residuals / width)), 0.0) / np.square(scale)
        G = (weights.reshape(K, -1) @ products).reshape(K, _DEGREE + 1, _DEGREE + 1)
        h = (weights * values).reshape(K, -1) @ flat
        d = np.sqrt(np.einsum("kii->ki", G)) + 1e-12
        G = G / d[:, :, None] / d[:, None, :] + 1e-9 * np.eye(_DEGREE + 1)
        coefficients = np.linalg.solve(G, (h / d)[:, :, None])[:, :, 0] / d
        fitted = (coefficients @ flat.T).reshape(K, n_t, c)
        residuals = values - fitted
        scale = np.maximum(np.maximum(_scale(residuals, known), floor), _SHRINK * scale)
        width = 3.0 * scale
    return fitted, np.where(seen, scale, np.nan)


def _scale(residuals: FloatArray, known: BoolArray) -> FloatArray:
    """One for what is not measured."""
    c = residuals.shape[-1]
    flat, seen = residuals.reshape(-1, c), known.reshape(-1, c)
    every = max(1, len(flat) // _ENOUGH) | 1
    return np.nan_to_num(lower_scale(flat[::every], seen[::every]), nan=1.0)
