"""Screening of samples and inputs before they are smoothed: stuck rows, leaps, spikes and running medians."""

from __future__ import annotations

import numpy as np

from diransac.arrays import BoolArray, FloatArray, robust_std, runs
from diransac.data import preprocessing
from diransac.data.checks import rows_per_sample
from diransac.data.filters import median_filter

# Samples that a window has at least.
_FEWEST = 5
# Samples of the running medians beside which inputs have spikes: those of two samples at most.  Passes over them.
_SPIKE_WINDOW, _SPIKE_PASSES = 5, 20
# Relative change of a signal that is a rounding error; a leap over the step that follows, where it is fewer than two.
_ROUNDING, _ONE_STEP = 1e-9, 1.5
# Probability of chance at which rows are stuck; standard deviations of noise that a leap may have.
_CHANCE, _SIGMAS = 0.01, 3.0
_TINY = 1e-300


def odd_window(seconds: float, dt: float, most: int) -> int:
    """Number of samples of a window, odd and from 5 to ``most``.

    Parameters
    ----------
    seconds : float
    dt : float
        Sampling time, s.
    most : int

    Returns
    -------
    int
    """
    return max(_FEWEST, min(most, 2 * round(0.5 * (seconds / dt - 1.0)) + 1))


def stuck_rows(measured: FloatArray) -> BoolArray:
    """Rows that repeat the previous row exactly in every signal, and are no standing still: nothing new was measured.

    Rows that repeat more often than the noise of the signals, in steps of their resolution, lets them by chance are
    stuck.  Signals of a coarse resolution repeat at rest.  Rows are at rest if motion then begins from rest in each
    signal, with a step that is no larger than the one that follows, or one of its resolution, within the noise; a
    recorder that was stuck catches up.

    Parameters
    ----------
    measured : (N, n) array

    Returns
    -------
    (N,) bool array
    """
    n, repeated = len(measured), np.zeros(len(measured), bool)
    repeated[1:] = np.all(measured[1:] == measured[:-1], axis=1)
    if not repeated.any():
        return repeated
    resolution, noise = _resolutions(measured), _noise(measured[~repeated])
    # Probability that two samples with noise above the resolution are equal, of all signals; and of runs of them.
    chances = resolution / np.maximum(2.0 * np.sqrt(np.pi) * noise, _TINY)
    equal = np.where(noise > resolution, chances, 1.0).prod()
    stuck, following = np.zeros(n, bool), np.zeros(n, int)
    for run in runs(repeated):
        stuck[run] = n * equal ** (run.stop - run.start) < _CHANCE
        following[run] = min(run.stop, n - 1)
    leaps = np.abs(measured[following] - measured)
    steps = np.abs(measured[np.minimum(following + 1, n - 1)] - measured[following])
    at_rest = np.all(leaps < _ONE_STEP * np.maximum(resolution, steps) + _SIGMAS * noise, axis=1)
    return np.asarray(repeated & (stuck | ~at_rest))


def _resolutions(measured: FloatArray) -> FloatArray:
    """Smallest step ``(n,)`` of each signal that is no rounding error; infinite for a constant one."""
    changes = np.abs(np.diff(measured, axis=0))
    least = _ROUNDING * np.nan_to_num(np.abs(measured)).max(axis=0)
    return np.asarray(np.where(changes > least, changes, np.inf).min(axis=0))


def _noise(measured: FloatArray) -> FloatArray:
    """Standard deviation ``(n,)`` of the noise of signals by differences of fourth order, in which motion is small."""
    fourth = np.diff(measured, 4, axis=0)
    fourth = fourth[np.isfinite(fourth).all(axis=1)]
    # The variance of a difference of fourth order is 1 + 16 + 36 + 16 + 1 times that of a sample.
    return np.asarray(robust_std(fourth, axis=0) / np.sqrt(70.0) if len(fourth) else np.zeros(measured.shape[1]))


def screened_inputs(inputs: FloatArray, window: int, threshold: float) -> tuple[FloatArray, int]:
    """Inputs whose momentary leaps are replaced by the running median (Hampel filter).

    An error of an input persists in the simulated state, so that the noise model cannot absorb it.

    Parameters
    ----------
    inputs : (N, n_u) array
    window : int
        Odd number of samples.
    threshold : float
        Local standard deviations beyond which an input is replaced.

    Returns
    -------
    inputs : (N, n_u) array
    n_leaps : int
        Number of rows with a replaced input.
    """
    if len(inputs) < window or not inputs.shape[1]:
        return inputs, 0
    leaps, median = preprocessing.hampel(inputs, window, threshold, preprocessing.running_deviation)
    return np.where(leaps, median, inputs), int(leaps.any(axis=1).sum())


def without_spikes(inputs: FloatArray, threshold: float) -> tuple[FloatArray, int]:
    """Inputs whose spikes of one or two samples, large beside their noise, are interpolated.

    Spikes of a measured torque that are smaller than its range escape `screened_inputs`.  Those of a controller look
    alike, so that simulations must tell which inputs acted.

    Parameters
    ----------
    inputs : (N, n_u) array
    threshold : float
        Standard deviations of the noise, by second differences, beyond which an input is replaced.  An input without
        noise, which is held or steps, is kept.

    Returns
    -------
    inputs : (N, n_u) array
    n_spikes : int
        Number of rows with a replaced input.
    """
    if len(inputs) < _SPIKE_WINDOW or not inputs.shape[1]:
        return inputs, 0
    columns = [_without_spikes_of_one(u, threshold * _noise_deviation(u)) for u in inputs.T]
    cleaned = np.column_stack(columns)
    return cleaned, int((cleaned != inputs).any(axis=1).sum())


def _without_spikes_of_one(u: FloatArray, limit: float) -> FloatArray:
    """One input ``(N,)``, interpolated where it is further than a limit from others beside it.

    Where spikes are frequent, most samples of a window may be spikes: those found are left out before the next medians,
    and samples that agree with what is interpolated in the end were none.
    """
    rows = np.arange(len(u))
    kept = rows
    for _ in range(_SPIKE_PASSES):
        spikes, _ = preprocessing.hampel(u[kept], _SPIKE_WINDOW, 1.0, lambda *_: np.asarray(limit))
        if not spikes.any() or len(kept) - spikes.sum() < _SPIKE_WINDOW:
            break
        kept = kept[~spikes]
    good = np.abs(u - np.interp(rows, kept, u[kept])) <= limit
    return np.where(good, u, np.interp(rows, rows[good], u[good]))


def _noise_deviation(u: FloatArray) -> float:
    """Standard deviation of white noise by second differences; infinite where most of these are zero."""
    usual = float(robust_std(np.diff(u, 2)))
    return usual / np.sqrt(6.0) if usual > 0.0 else np.inf


# ---------------------------------------------------------------------- smoothing


def running_median(measured: FloatArray, known: BoolArray, window: int) -> FloatArray:
    """Median over a window of rows, of 5 samples at least; missing samples are interpolated linearly between medians.

    Parameters
    ----------
    measured : (N, n) array
    known : (N, n) bool array
        Samples that are measured.
    window : int
        Odd number of rows.

    Returns
    -------
    (N, n) array
        0 in signals without a measured sample.
    """
    rows, medians = np.arange(len(measured)), np.zeros(measured.shape)
    for i in np.flatnonzero(known.any(axis=0)):
        at = rows[known[:, i]]
        size = max(_FEWEST, 2 * (window // rows_per_sample(known[:, i]) // 2) + 1)
        medians[:, i] = np.interp(rows, at, median_filter(measured[at, i], min(size, window)))
    return medians
