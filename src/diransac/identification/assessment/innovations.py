"""One-step innovations of a log: what a Kalman filter of the model did not predict of each sample.

The filter is linear about the smoothed states.  Its noise is that of the log, without outliers; unmodelled forces act
as white noise on the velocities, of the size at which the innovations are most likely.  Of a model that explains the
log, normalised innovations are white and of unit variance.

References
----------
Mehra 1970, "On the identification of variances and adaptive Kalman filtering"; Ljung, Box 1978, "On a measure of lack
of fit in time series models"; Bar-Shalom, Li, Kirubarajan 2001, section 5.4 (consistency of filters).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.prediction.open_loop import OpenLoop

_SIZES = np.array([0.0, 1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0])
"""Sizes of unmodelled forces that are tried, over the RMS change of a velocity from sample to sample."""
_N_LAGS, _SETTLED = 20, 0.1
"""Lags of the autocorrelation; part of the rows in which the filter settles, which does not count."""


@dataclass(frozen=True)
class Innovations:
    """Normalised one-step innovations of one log, in the rows that were filtered.

    Parameters
    ----------
    source : str
        Name of the log.
    dt : float
        Sampling time, s.
    normalized : mapping of str to (N,) array
        Innovations of each signal over their predicted standard deviation; NaN where there is no sample, and outliers.
    unmodelled : float
        Most likely size of unmodelled forces: RMS change of a velocity from sample to sample by them, over that of all
        forces.
    """

    source: str
    dt: float
    normalized: Mapping[str, FloatArray]
    unmodelled: float

    @cached_property
    def standard_deviation(self) -> dict[str, float]:
        """Standard deviation of each signal's normalised innovations: 1, if noise and model are right."""
        return {n: float(np.sqrt(np.nanmean(np.square(x)))) for n, x in self.normalized.items()}

    @cached_property
    def autocorrelation(self) -> dict[str, FloatArray]:
        """Autocorrelation ``(20,)`` of each signal's innovations at lags of 1 to 20 samples."""
        return {n: _autocorrelation(x) for n, x in self.normalized.items()}

    @cached_property
    def whiteness(self) -> dict[str, float]:
        """Probability of so much autocorrelation in white innovations, of each signal (Ljung and Box)."""
        found = {}
        for name, x in self.normalized.items():
            n = int(np.isfinite(x).sum())
            lags = np.arange(1, _N_LAGS + 1)
            statistic = n * (n + 2) * np.sum(np.square(self.autocorrelation[name]) / np.maximum(n - lags, 1))
            # Chi squared has an even number of degrees of freedom, and its tail is a sum (its module takes a second).
            terms = [(0.5 * statistic) ** k / math.factorial(k) for k in range(_N_LAGS // 2)]
            found[name] = float(np.exp(-0.5 * statistic) * sum(terms))
        return found

    @cached_property
    def coloured(self) -> dict[str, float]:
        """Largest autocorrelation of the signals whose innovations are clearly not white."""
        largest = {n: float(x[np.argmax(np.abs(x))]) for n, x in self.autocorrelation.items()}
        # Up to 0.2 innovations are nearly white, however many they are.
        return {n: x for n, x in largest.items() if abs(x) > 0.2 and self.whiteness[n] < 1e-3}

    def to_dict(self) -> dict[str, Any]:
        """Figures, ready for JSON."""
        return {
            "log": self.source,
            "unmodelled": self.unmodelled,
            "standard_deviation": self.standard_deviation,
            "whiteness": self.whiteness,
            "autocorrelation": {n: x.tolist() for n, x in self.autocorrelation.items()},
        }


def _autocorrelation(x: FloatArray) -> FloatArray:
    known = np.isfinite(x)
    centred = np.where(known, x - np.nanmean(x), 0.0)
    variance = np.square(centred).sum() / max(known.sum(), 1)
    if not variance > 0.0:
        return np.zeros(_N_LAGS)
    pairs = [(np.sum(centred[k:] * centred[:-k]), (known[k:] & known[:-k]).sum()) for k in range(1, _N_LAGS + 1)]
    return np.array([product / max(n, 1) / variance for product, n in pairs])


def innovations(one: OpenLoop) -> Innovations | None:
    """Innovations of the longest stretch of a log; None where nothing is smoothed, or the model diverges.

    Parameters
    ----------
    one : OpenLoop
        With smoothed states.  At most 3000 rows are filtered, and at least 50.
    """
    if one.smoothed is None:
        return None
    stretch = max(one.stretches, key=lambda x: x.stop - x.start)
    rows = slice(stretch.start, min(stretch.stop, stretch.start + 3000))
    segment, n = one.segment, rows.stop - rows.start
    states, spread = one.filled_states()[rows], np.maximum(np.nanstd(segment.measured, axis=0), 1e-300)
    measured = np.where(one.outliers, np.nan, segment.measured)[rows]
    counted = measured[int(_SETTLED * (n - 1)) : -1]
    seen = [i for i, x in enumerate(counted.T) if np.isfinite(x).sum() > _N_LAGS]
    if n < 50 or not seen:
        return None
    columns = [segment.model.signals.index(segment.signals[i]) for i in seen]
    steps = 1e-6 * np.maximum(np.std(states, axis=0), 1e-6)
    moved = np.concatenate([states[:, None], states[:, None] + steps * np.eye(states.shape[1])], axis=1)
    begins = np.repeat(np.arange(rows.start, rows.stop - 1), moved.shape[1])
    found = one.simulation.trajectories(0, one.parameters, moved[:-1].reshape(len(begins), -1), begins, 2)
    found = found.reshape(n - 1, moved.shape[1], 2, -1)
    following, now = found[:, :, 1, : states.shape[1]], found[:, :, 0][:, :, columns]
    if not (np.isfinite(following).all() and np.isfinite(now).all()):
        return None
    noise = np.maximum(one.noise, 1e-4 * spread)[seen]
    F, H = (np.moveaxis(x[:, 1:] - x[:, :1], 1, 2) / steps for x in (following, now))
    residuals = measured[:-1][:, seen] - now[:, 0]
    change = np.std(np.diff(states, axis=0), axis=0) * (np.arange(states.shape[1]) >= segment.model.n_q)
    start = np.square(0.1 * np.std(states, axis=0) + 1e-12)
    drift = following[:, 0] - states[1:]
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            normalized, size = _filtered(F, H, drift, residuals, np.square(noise), np.square(change), start)
    except np.linalg.LinAlgError:  # the model diverges within a sample
        return None
    names = [segment.signals[i] for i in seen]
    return Innovations(segment.log.source, segment.log.dt, dict(zip(names, normalized.T, strict=True)), size)


def _filtered(
    F: FloatArray,
    H: FloatArray,
    drift: FloatArray,
    residuals: FloatArray,
    noise: FloatArray,
    change: FloatArray,
    start: FloatArray,
) -> tuple[FloatArray, float]:
    """Normalised innovations ``(N, n_s)`` at the most likely size of unmodelled forces, and that size.

    Filters of all sizes run side by side.

    Parameters
    ----------
    F, H : (N, n_x, n_x) and (N, n_s, n_x) array
        Derivatives of the next state and of the signals.
    drift : (N, n_x) array
        Predicted less smoothed next state.
    residuals : (N, n_s) array
        Measured signals less those of the smoothed state; NaN where there is none.
    noise, change, start : (n_s,), (n_x,) and (n_x,) array
        Variances of signals, of unmodelled changes of size 1, and of the first state.
    """
    n_sizes, n_x = len(_SIZES), F.shape[1]
    z, P = np.zeros((n_sizes, n_x)), np.tile(np.diag(start), (n_sizes, 1, 1))
    Q = np.square(_SIZES)[:, None, None] * np.diag(change)
    found, likelihood = np.full((*residuals.shape, n_sizes), np.nan), np.zeros(n_sizes)
    settled = int(_SETTLED * len(F))
    for k in range(len(F)):
        known = np.isfinite(residuals[k])
        if known.any():
            h = H[k][known]
            PH = P @ h.T
            S = h @ PH + np.diag(noise[known])
            nu = residuals[k][known] - z @ h.T
            gain = np.linalg.solve(S, PH.swapaxes(1, 2))
            if k >= settled:
                found[k][known] = (nu / np.sqrt(np.einsum("kii->ki", S))).T
                distance = np.einsum("ki,ki->k", nu, np.linalg.solve(S, nu[:, :, None])[:, :, 0])
                likelihood -= 0.5 * (np.linalg.slogdet(S)[1] + distance)
            z = z + np.einsum("ki,kij->kj", nu, gain)
            P = P - PH @ gain
        z = z @ F[k].T + drift[k]
        P = F[k] @ P @ F[k].T + Q
        P = 0.5 * (P + P.swapaxes(1, 2))
    best = int(np.argmax(np.where(np.isfinite(likelihood), likelihood, -np.inf)))
    return found[settled:, :, best], float(_SIZES[best])
