"""Initial states of prediction windows, estimated from the samples about each start; outliers without a model.

The motion of a log is smoothed first without the equations of motion, as lo-diransac begins.  It gives the noise of
each signal, its outliers, and a first state of each window.  The state is then the one whose simulation over the
samples about the start agrees best with them: robust nonlinear least squares, with Geman and McClure's weights, by
Gauss-Newton steps, which are shortened where they do not descend.  Of a model that explains a log without noise, it is
exact.

References
----------
Gasser, Sroka, Jennen-Steinmetz 1986 (noise by pseudo-residuals); Geman, McClure 1987; Ljung 1999, "System
identification", section 16.4 (initial states of a validation).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray, robust_std
from diransac.data.dataset import Dataset
from diransac.errors import LogError
from diransac.identification.diagnosis import Resolution
from diransac.identification.evaluation.simulation import Simulation
from diransac.identification.methods.lo_diransac.method import LoDiransac
from diransac.identification.methods.lo_diransac.mixture import lower_scale
from diransac.identification.methods.lo_diransac.preparation import prepared
from diransac.identification.methods.lo_diransac.unmeasured import unmeasured_states
from diransac.identification.methods.lo_diransac.without_equations import followed

_DIFFERENCE = 1e-6
"""Step of finite differences, over the spread of a state."""
_SOFT = 3.0


@dataclass(frozen=True)
class SmoothedLog:
    """Motion of one log, smoothed without the equations of motion, and its samples about it.

    Parameters
    ----------
    signals : (N, n_signals) array
        All signals of the model; NaN where a state is unmeasured.
    noise : (n_s,) array
        Robust standard deviation of each signal of the dataset about the motion, its unit.  A motion that is smoothed
        over few samples follows their noise: then about the line between neighbours, which adds its curvature.
    outliers : (N, n_s) bool array
        Samples of the dataset's signals that are far from the motion.
    half_width : int
        Samples to either side over which the motion is smoothed.
    samples : (n_s,) array
        Mean number of each signal's samples among these.
    """

    signals: FloatArray
    noise: FloatArray
    outliers: BoolArray
    half_width: int
    samples: FloatArray


def smoothed_log(dataset: Dataset) -> SmoothedLog | None:
    """Smoothed motion of the only log of a dataset; None where the log is too short to be smoothed.

    Parameters
    ----------
    dataset : Dataset
        With one log.
    """
    try:
        intervals, motion, _ = prepared(LoDiransac(), dataset)
    except LogError:
        return None
    (one,), model = dataset.segments, dataset.model
    signals = motion.signals[: len(one)].copy()
    signals[:, [model.signals.index(n) for n in unmeasured_states(intervals)]] = np.nan
    columns = [model.signals.index(n) for n in one.signals]
    distances = one.measured - signals[:, columns]
    known: BoolArray = np.isfinite(distances)
    samples = known.mean(axis=0) * min(2 * intervals.length + 1, len(one))
    of_motion = lower_scale(np.where(known, distances, 0.0), known)
    # Smoothing over 20 samples leaves their noise.
    noise = np.where(samples < 20.0, _of_pseudo_residuals(one.measured), np.nan_to_num(of_motion))
    # Smaller distances are errors of the smoothed motion.
    least = 1e-3 * motion.spread[columns]
    # Outliers are six standard deviations of the noise from the motion.
    outliers = known & (np.abs(np.where(known, distances, 0.0)) > 6.0 * np.maximum(noise, least))
    return SmoothedLog(signals, noise, outliers, intervals.length, samples)


def followed_log(dataset: Dataset, parameters: FloatArray, resolution: Resolution) -> SmoothedLog | None:
    """Motion of the only log of a dataset as a model without equations follows it; None where the log is too short.

    Parameters
    ----------
    dataset : Dataset
        With one log.
    parameters : (n_p,) array
    resolution : Resolution
        With the timing of the inputs.
    """
    try:
        found = followed(LoDiransac(), dataset, parameters, resolution)
    except LogError:
        return None
    (one,), model = dataset.segments, dataset.model
    columns = [model.signals.index(n) for n in one.signals]
    signals = found.signals[: len(one)].copy()
    signals[one.gaps] = np.nan
    samples = np.isfinite(one.measured).mean(axis=0) * found.length
    outliers = found.outliers[: len(one), columns]
    return SmoothedLog(signals, found.noise[columns], outliers, found.length, samples)


def _of_pseudo_residuals(samples: FloatArray) -> FloatArray:
    """Robust noise ``(n_s,)`` of samples about the line between their neighbours; of two, their own deviation."""
    found = []
    for y in samples.T:
        rows = np.flatnonzero(np.isfinite(y))
        if len(rows) < 3:
            found.append(float(np.std(y[rows])) if len(rows) else 0.0)
            continue
        later = (rows[1:-1] - rows[:-2]) / (rows[2:] - rows[:-2])
        known = y[rows]
        residuals = known[1:-1] - (1.0 - later) * known[:-2] - later * known[2:]
        scaled = residuals / np.sqrt(1.0 + np.square(later) + np.square(1.0 - later))
        found.append(float(robust_std(scaled)))
    return np.array(found)


@dataclass(frozen=True)
class WindowStarts:
    """Initial states of K windows, and how uncertain they are.

    Parameters
    ----------
    states : (K, n_x) array
    deviations : (K, n_x, n_x) array
        Independent errors of each state, of one standard deviation, a row each: the square root of its covariance.
    residual : (n_s,) array
        Robust standard deviation of the samples about the simulations: their noise, and what the model lacks.
    """

    states: FloatArray
    deviations: FloatArray
    residual: FloatArray


def window_starts(
    simulation: Simulation,
    parameters: FloatArray,
    states: FloatArray,
    smoothed: SmoothedLog,
    measured: FloatArray,
    stretch: slice,
    rows: IntArray,
) -> WindowStarts:
    """Initial states of windows, estimated from the samples within the smoother's half width.

    Parameters
    ----------
    simulation : Simulation
        Of the one log, with all of its signals.
    parameters : (n_p,) array
    states : (N, n_x) array
        First states, at every row.
    smoothed : SmoothedLog
    measured : (N, n_s) array
        NaN where missing.
    stretch : slice
        Rows of the log between gaps.
    rows : (K,) int array
        First row of each window, in the stretch.

    Returns
    -------
    WindowStarts
        The given states, where their simulation diverges.
    """
    n_rows = min(2 * smoothed.half_width + 1, stretch.stop - stretch.start)
    first = np.clip(rows - smoothed.half_width, stretch.start, stretch.stop - n_rows)
    known: BoolArray = np.asarray(np.isfinite(measured) & ~smoothed.outliers)
    at = first[:, None] + np.arange(n_rows)
    fit = _Fit(simulation, parameters, first, n_rows, np.asarray(known[at]), states)
    found, covariance, residual = fit.solved(states[first], _DIFFERENCE * _width_of_bulk(measured))
    K, n_x = found.shape
    values, vectors = np.linalg.eigh(covariance)
    roots = (vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]).swapaxes(1, 2)
    steps = fit.difference
    lanes = np.concatenate([found[:, None], found[:, None] + steps * np.eye(n_x)], axis=1)
    at_rows = fit.trajectories(lanes)[np.arange(K), :, rows - first]
    finite: BoolArray = np.asarray(np.isfinite(at_rows).all(axis=(1, 2)))
    at_start = np.where(finite[:, None], at_rows[:, 0], states[rows])
    transition = np.nan_to_num((at_rows[:, 1:] - at_rows[:, :1]) / steps[:, None])
    return WindowStarts(at_start, roots @ transition, residual)


def _width_of_bulk(values: FloatArray) -> FloatArray:
    """Range ``(n,)`` of the central 80 % of each column's finite values; 1 where it is 0."""
    found = [np.ptp(np.quantile(x[np.isfinite(x)], [0.1, 0.9])) if np.isfinite(x).any() else 0.0 for x in values.T]
    return np.array([x if x > 0.0 else 1.0 for x in found])


class _Fit:
    """Robust least squares of the initial states of K windows of ``n_rows`` rows, which begin at rows ``first``."""

    def __init__(
        self,
        simulation: Simulation,
        parameters: FloatArray,
        first: IntArray,
        n_rows: int,
        known: BoolArray,
        states: FloatArray,
    ) -> None:
        self._simulation, self._parameters, self._first = simulation, parameters, first
        self._n_rows, self._known = n_rows, known
        self.difference = _DIFFERENCE * _width_of_bulk(states)

    def solved(self, states: FloatArray, least: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """States ``(K, n_x)``, their covariances ``(K, n_x, n_x)``, and the residuals' scale ``(n_s,)``."""
        errors, part = self._errors(states[:, None])[:, 0], np.ones(len(states))
        n_steps = 20
        for step in range(n_steps + 1):
            scale = np.maximum(least, self._scale(errors))
            jacobian = self._jacobian(states, errors)
            weights = self._weights(errors, scale)
            G = np.einsum("krsi,krs,krsj->kij", jacobian, weights, jacobian)
            g = np.einsum(
                "krsi,krs,krs->ki", jacobian, weights, np.where(self._known & np.isfinite(errors), errors, 0.0)
            )
            d = np.sqrt(np.einsum("kii->ki", G)) + 1e-300**0.5
            scaled = G / d[:, :, None] / d[:, None, :] + 1e-12 * np.eye(G.shape[1])
            if step == n_steps:
                break
            moved = states - part[:, None] * np.linalg.solve(scaled, (g / d)[:, :, None])[:, :, 0] / d
            tried = self._errors(moved[:, None])[:, 0]
            old, new = self._loss(errors, scale), self._loss(tried, scale)
            better = new < old * (1.0 - 1e-12)
            states = np.where(better[:, None], moved, states)
            errors = np.where(better[:, None, None], tried, errors)
            part = np.where(better, np.minimum(2.0 * part, 1.0), 0.3 * part)  # friction bends the loss within a step
            if part.max() < 0.05:
                break
        inverse = np.linalg.pinv(scaled, rcond=1e-10, hermitian=True)
        return states, inverse / d[:, :, None] / d[:, None, :], scale

    def _errors(self, states: FloatArray) -> FloatArray:
        """Errors ``(K, m, n_rows, n_s)`` of m states ``(K, m, n_x)`` of each window; infinite after a divergence."""
        K, m, n_x = states.shape
        rows = np.repeat(self._first, m)
        found = self._simulation.errors(0, self._parameters, states.reshape(-1, n_x), rows, self._n_rows)
        return np.where(np.abs(found) < 1e100, found, np.inf).reshape(K, m, self._n_rows, -1)

    def trajectories(self, states: FloatArray) -> FloatArray:
        """States ``(K, m, n_rows, n_x)`` of m simulations of each window."""
        K, m, n_x = states.shape
        rows = np.repeat(self._first, m)
        found = self._simulation.trajectories(0, self._parameters, states.reshape(-1, n_x), rows, self._n_rows)
        return found[:, :, :n_x].reshape(K, m, self._n_rows, n_x)

    def _jacobian(self, states: FloatArray, errors: FloatArray) -> FloatArray:
        """Derivatives ``(K, n_rows, n_s, n_x)`` of the errors by the initial state; 0 where these are not finite."""
        moved = self._errors(states[:, None] + self.difference * np.eye(states.shape[1]))
        with np.errstate(invalid="ignore"):
            found = (moved - errors[:, None]) / self.difference[:, None, None]
        return np.moveaxis(np.where(np.isfinite(found), found, 0.0), 1, -1)

    def _scale(self, errors: FloatArray) -> FloatArray:
        """Robust standard deviation ``(n_s,)`` of the errors of all windows."""
        known = (self._known & np.isfinite(errors)).reshape(-1, errors.shape[2])
        flat = np.where(known, errors.reshape(known.shape), 0.0)
        return np.nan_to_num(lower_scale(flat, known))

    def _weights(self, errors: FloatArray, scale: FloatArray) -> FloatArray:
        with np.errstate(over="ignore"):
            soft = 1.0 + np.square(errors / (_SOFT * scale))
            return np.where(self._known, 1.0 / np.square(soft * scale), 0.0)

    def _loss(self, errors: FloatArray, scale: FloatArray) -> FloatArray:
        """Geman and McClure's loss ``(K,)``; infinite where a simulation diverges."""
        with np.errstate(over="ignore", invalid="ignore"):
            squares = np.square(errors / (_SOFT * scale))
            loss = np.where(self._known, np.where(np.isfinite(squares), squares / (1.0 + squares), np.inf), 0.0)
        return np.asarray(loss.sum(axis=(1, 2)))
