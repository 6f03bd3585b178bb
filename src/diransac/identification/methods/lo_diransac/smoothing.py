"""Screening of samples, and the motion without a model.

The motion is local polynomials that a coordinate shares with its velocity and acceleration.  In a window about each
knot a polynomial of degree 4 is fitted to whatever is measured of a coordinate and its derivatives.  Weights are Geman
and McClure's, the scale of each signal a low quantile of its residuals, so that more than half of the samples may be
wrong; residuals start from a running median, and scales come down gradually, so that the fit does not settle on the
first majority that it meets (graduated non-convexity).

References
----------
Hampel 1974; Geman, McClure 1987; Black, Rangarajan 1996; Yang, Antonante, Tzoumas, Carlone 2020 (graduated
non-convexity); Cleveland 1979 (robust local regression).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import median_filter

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.data import preprocessing
from diransac.identification.methods.lo_diransac.mixture import lower_scale

if TYPE_CHECKING:
    from diransac.model import Model

__all__ = [
    "Motion",
    "Samples",
    "choose_half_width",
    "odd_window",
    "running_median",
    "screened_inputs",
    "smooth",
    "stuck_rows",
]

_DEGREE, _STEPS = 4, 12
_SHRINK = 0.3
_FLOOR = 1e-4
_AT_REST = 0.1
_TRIALS = 24
# Samples that a window has at least, and those to either side of a knot that always suffice.
_FEWEST, _ENOUGH_SAMPLES = 5, 25
# Residuals that a scale is taken from; more would only cost time.
_ENOUGH = 4000


@dataclass(frozen=True)
class Samples:
    """Samples of one log: measured, known and running median ``(N, n_signals)``, in the model's order of signals."""

    measured: FloatArray
    known: BoolArray
    centre: FloatArray


@dataclass(frozen=True)
class Motion:
    """Smoothed signals ``(N, n_signals)``, and the spread of each signal ``(n_signals,)``."""

    signals: FloatArray
    spread: FloatArray


# ---------------------------------------------------------------------- screening


def odd_window(seconds: float, dt: float, most: int) -> int:
    """Samples of a window, an odd number from 5 to ``most``."""
    return max(_FEWEST, min(most, 2 * round(0.5 * (seconds / dt - 1.0)) + 1))


def stuck_rows(measured: FloatArray) -> BoolArray:
    """Rows ``(N,)`` that repeat the row before exactly in every signal: nothing new was measured."""
    stuck = np.zeros(len(measured), bool)
    stuck[1:] = np.all(measured[1:] == measured[:-1], axis=1)
    return stuck


def screened_inputs(inputs: FloatArray, window: int, threshold: float) -> tuple[FloatArray, int]:
    """Inputs whose momentary leaps are replaced by the running median, and the number of rows with one (Hampel filter).

    A simulation goes on from a wrong input with a wrong state, so inputs cannot be left to the noise model.
    """
    if len(inputs) < window or not inputs.shape[1]:
        return inputs, 0
    leaps, median = preprocessing.hampel(inputs, window, threshold, preprocessing.running_deviation)
    return np.where(leaps, median, inputs), int(leaps.any(axis=1).sum())


# ---------------------------------------------------------------------- smoothing


def _chains(model: Model) -> list[list[int]]:
    """Columns among the model's signals of each quantity and of its derivatives."""
    n_q, n_v = model.n_q, model.n_v
    if model.kinematics is None:
        return [[d, n_q + d, n_q + n_v + d] for d in range(n_q)]
    return [[d] for d in range(n_q)] + [[n_q + d, n_q + n_v + d] for d in range(n_v)]


def smooth(model: Model, logs: Sequence[Samples], dt: float, half: int) -> list[Motion]:
    """Motion of every log; the spread of each signal is that over all logs.

    Parameters
    ----------
    half : int
        Samples that a polynomial covers to either side of its knot.
    """
    signals = [_smoothed(model, log, dt, half) for log in logs]
    middle = np.concatenate(
        [np.where(log.known.any(axis=0), log.centre, x) for log, x in zip(logs, signals, strict=True)]
    )
    spread = _spread(middle) + 1e-9
    return [Motion(x, spread) for x in signals]


def _smoothed(model: Model, log: Samples, dt: float, half: int) -> FloatArray:
    """Smoothed signals ``(N, n_signals)`` of all rows of one log."""
    measured, known, centre = log.measured, log.known, log.centre
    N, n = measured.shape
    step = max(1, half // 2)
    rows, inside = _neighbourhoods(np.arange(0, N, step), half, N)
    offsets = np.arange(-half, half + 1)
    basis = _basis(offsets / half, half * dt)
    signals = np.zeros((N, n))
    blend = np.maximum(0.0, 1.0 - np.abs(offsets) / (step + 1.0))
    total = np.bincount(rows[inside], np.broadcast_to(blend, rows.shape)[inside], N)
    for columns in _chains(model):
        values, oks = measured[:, columns][rows], known[:, columns][rows] & inside[:, :, None]
        first = values - centre[:, columns][rows]
        fitted = _fit(values, oks, first, basis[: len(columns)], _spread(centre[:, columns]))
        for j, column in enumerate(columns):
            signals[:, column] = np.bincount(rows[inside], (fitted[:, :, j] * blend)[inside], N) / total
    return signals


def choose_half_width(model: Model, logs: Sequence[Samples], dt: float, narrowest: float) -> int:
    """The half width, in samples, whose polynomials best predict samples that they were not fitted to.

    A narrow window is noisy, a wide one is stiff; every other sample is left out and predicted (cross-validation), and
    the error is a low quantile, so that outliers have no influence.

    Parameters
    ----------
    narrowest : float
        s; the first candidate is the shorter of it and 25 samples, others are three times as wide each.
    """
    longest = max(len(log.measured) for log in logs)
    first = max(_FEWEST, min(round(narrowest / dt), _ENOUGH_SAMPLES))
    widths = [first * 3**k for k in range(20) if k == 0 or 8 * first * 3**k < longest]
    losses = [_prediction_error(model, logs, dt, half, max(1, half // first)) for half in widths]
    return int(widths[int(np.argmin(losses))])


def _prediction_error(model: Model, logs: Sequence[Samples], dt: float, half: int, stride: int) -> float:
    """Sum over signals of the log of the left-out samples' robust scale, at knots spread over the logs."""
    offsets = np.arange(-half, half + 1, stride)
    rows = _trial_rows([len(log.measured) for log in logs], half, offsets)
    measured, known, centre = (
        np.concatenate([getattr(log, name) for log in logs]) if len(logs) > 1 else getattr(logs[0], name)
        for name in ("measured", "known", "centre")
    )
    even, near = np.arange(len(offsets)) % 2 == 0, np.abs(offsets) <= half // 2
    basis = _basis(offsets / half, half * dt)
    loss = 0.0
    for columns in _chains(model):
        values, oks = measured[:, columns][rows], known[:, columns][rows]
        first = values - centre[:, columns][rows]
        spread = _spread(centre[:, columns])
        fitted = _fit(values, oks & even[:, None], first, basis[: len(columns)], spread)
        scale = _scale(values - fitted, oks & (near & ~even)[:, None])
        seen = oks.any(axis=(0, 1))
        loss += float(np.log(np.maximum(scale, _FLOOR * spread + 1e-12))[seen].sum())
    return loss


def _trial_rows(sizes: Sequence[int], half: int, offsets: IntArray) -> IntArray:
    """Rows (K, n_offsets) about knots that are spread over logs of so many rows, in proportion to their length."""
    rows, begin = [], 0
    for N in sizes:
        n_trials = max(1, round(_TRIALS * N / sum(sizes)))
        knots = np.linspace(min(half, N // 2), max(N - 1 - half, N // 2), n_trials).astype(int)
        rows.append(begin + np.clip(knots[:, None] + offsets, 0, N - 1))
        begin += N
    return np.concatenate(rows)


def _neighbourhoods(knots: IntArray, half: int, n_rows: int) -> tuple[IntArray, BoolArray]:
    """Rows about each knot (K, 2 half + 1), and which of them are in the log."""
    rows = knots[:, None] + np.arange(-half, half + 1)
    return np.clip(rows, 0, n_rows - 1), (rows >= 0) & (rows < n_rows)


def _spread(values: FloatArray) -> FloatArray:
    """Standard deviation of each column by the MAD; where half the samples rest at one value, by the central 80 %."""
    low, median, high = np.quantile(values, [0.1, 0.5, 0.9], axis=0)
    mad, wide = 1.4826 * np.median(np.abs(values - median), axis=0), (high - low) / 2.563
    return np.asarray(np.where(mad > _AT_REST * wide, mad, wide))


def running_median(measured: FloatArray, known: BoolArray, window: int) -> FloatArray:
    """Median over a window of rows, gaps bridged by straight lines; 0 for what is not measured."""
    rows, bridged = np.arange(len(measured)), np.zeros(measured.shape)
    for i in np.flatnonzero(known.any(axis=0)):
        bridged[:, i] = np.interp(rows, rows[known[:, i]], measured[known[:, i], i])
    return _medians(bridged, window)


def _medians(columns: FloatArray, window: int) -> FloatArray:
    """Running median of each column; one dimension at a time, for which SciPy has the faster algorithm."""
    return np.asarray(np.column_stack([median_filter(x, size=window, mode="mirror") for x in columns.T]))


def _basis(t: FloatArray, unit: float) -> FloatArray:
    """Powers of scaled time and their derivatives, (3, n_t, 5)."""
    powers = np.arange(_DEGREE + 1)
    value = t[:, None] ** powers
    first = powers * t[:, None] ** np.maximum(powers - 1, 0) / unit
    second = powers * (powers - 1) * t[:, None] ** np.maximum(powers - 2, 0) / unit**2
    return np.stack([value, first, second])


def _fit(
    values: FloatArray, known: BoolArray, residuals: FloatArray, basis: FloatArray, spread: FloatArray
) -> FloatArray:
    """Fitted values ``(K, n_t, c)`` of the c signals of one chain."""
    K, n_t, c = values.shape
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
    return np.asarray(fitted)


def _scale(residuals: FloatArray, known: BoolArray) -> FloatArray:
    """One for what is not measured."""
    c = residuals.shape[-1]
    flat, seen = residuals.reshape(-1, c), known.reshape(-1, c)
    every = max(1, len(flat) // _ENOUGH) | 1
    return np.nan_to_num(lower_scale(flat[::every], seen[::every]), nan=1.0)
