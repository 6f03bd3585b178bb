"""Hypotheses from random minimal samples of the equations in weak form, and their consensus by simulation.

An equation that holds at every moment also holds for any weighted average.  Rows ``W p = b`` of the smoothed motion are
averaged under a bump of a window's length: vibration and noise average out, and since the bump vanishes at its ends,
little depends on the accelerations (integration by parts).  A sample of few averages of each equation gives a
hypothesis, and every hypothesis is scored by simulation.

References
----------
Fischler, Bolles 1981 (RANSAC); Messenger, Bortz 2021 (weak form); Nister 2005 (preemptive scoring);
Torr, Zisserman 2000.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray, row_blocks
from diransac.identification.core.noise import lower_scale
from diransac.identification.core.rows import Rows, inclusive_bounds, solve, solve_sized
from diransac.identification.methods.samples import sample_rows
from diransac.identification.regression.rows import regression_rows
from diransac.simulation import RolloutBatch, rollouts

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset
    from diransac.identification.core.windows import Windows
    from diransac.identification.methods.lo_diransac.settings import LoDiransacSettings
    from diransac.identification.methods.lo_diransac.smoothing import Motion
    from diransac.identification.regression.estimators import BoundEstimator
    from diransac.model import Model

_OVERLAP = 5
"""Averages that overlap at a row."""
_N_SCREENED = 12
"""Intervals on which all hypotheses are scored, and hypotheses that are scored on all intervals."""
_LARGEST_SAMPLE = 4
"""Rows of each equation in the largest sample, over the number of parameters."""
_NUMBERS_AT_A_TIME = 1_000_000
"""Numbers that are held at a time for several hypotheses: bounds the memory, whatever the length of the logs."""
_SMALL_RESIDUAL = 0.01
"""Least residual of an equation over its terms: smoothing is not exact."""


def find_hypotheses(
    settings: LoDiransacSettings, intervals: Windows, motion: Motion, seed: int, dataset: Dataset
) -> FloatArray:
    """Hypotheses within the parameter bounds, best first.

    Samples are scored on a few intervals, the best of them on all.

    Parameters
    ----------
    settings : LoDiransacSettings
    intervals : Windows
    motion : Motion
        Smoothed motion over the rows of the intervals.
    seed : int
    dataset : Dataset

    Returns
    -------
    (n_hypotheses, n) array
        Each parameter in its unit; empty where no sample is within the bounds.
    """
    if intervals.model.nonlinear_parameters:
        finalists = _nonlinear(settings, intervals, motion, seed, dataset)
    else:
        finalists = _linear(settings, intervals, motion, seed, dataset)
    if not len(finalists):
        return finalists
    scores = robust_scores(intervals, motion, finalists, np.arange(len(intervals)))
    return finalists[np.argsort(scores, kind="stable")[: np.isfinite(scores).sum()]]


def _linear(
    settings: LoDiransacSettings, intervals: Windows, motion: Motion, seed: int, dataset: Dataset
) -> FloatArray:
    """Finalists of a model that is affine in its parameters: the best of least squares of random averages.

    Parameters that only sensors depend on, but not as affine functions, are those of nonlinear least squares.  Where
    no log has such a sensor, they are 1 if positive and 0 otherwise, and their variance will be infinite.
    """
    weak, layout = weak_form(intervals, motion), dataset.layout
    n = len(intervals)
    few = np.unique(np.linspace(0, n - 1, min(_N_SCREENED, n)).astype(int))
    prior = layout.prior_mean, layout.prior_std
    samples = solve_sized(weak, random_sets(settings, weak, seed), prior)
    missing = _in_sensors_alone(dataset) & ~weak.W.any(axis=(0, 1)) & np.isinf(layout.prior_std)
    if missing.any() and dataset.model.is_affine:
        samples[:, missing] = [1.0 if x.positive else 0.0 for x, m in zip(layout.bounds, missing, strict=True) if m]
    elif missing.any():
        bound = _of_smoothed_motion(intervals, motion, dataset)
        samples[:, missing] = bound.select([np.arange(bound.n_rows)]).fit()[0][missing]
    samples = _admitted(intervals, samples)
    if not len(samples):
        return samples
    order = np.argsort(robust_scores(intervals, motion, samples, few), kind="stable")
    return samples[order[:_N_SCREENED]]


def n_samples(settings: LoDiransacSettings, model: Model) -> int:
    """Number of random samples, of which nonlinear least squares has half as many.

    Parameters
    ----------
    settings : LoDiransacSettings
    model : Model
    """
    return settings.n_samples // 2 if model.nonlinear_parameters else settings.n_samples


def _in_sensors_alone(dataset: Dataset) -> BoolArray:
    """Mask ``(n,)`` of the parameters that no equation of motion depends on."""
    alone = dataset.model.sensor_parameters
    return np.array([name in alone for name in dataset.layout.owners], bool)


def _nonlinear(
    settings: LoDiransacSettings, intervals: Windows, motion: Motion, seed: int, dataset: Dataset
) -> FloatArray:
    """Finalists of any model: nonlinear least squares of all and of random rows of the smoothed motion."""
    bound = _of_smoothed_motion(intervals, motion, dataset)
    n, n_p, k = bound.n_rows, intervals.n_p, np.arange(n_samples(settings, intervals.model))
    rows = sample_rows(seed, k, n, 0, min(n, _LARGEST_SAMPLE * n_p))
    samples = [np.sort(some[:size]) for some, size in zip(rows, _sizes(seed, k, n, n_p), strict=True)]
    return bound.select([np.arange(n), *samples]).fit()


def _of_smoothed_motion(intervals: Windows, motion: Motion, dataset: Dataset) -> BoundEstimator:
    """Nonlinear least squares over the dataset with smoothed signals, of which every row counts."""
    from diransac.identification.regression.nonlinear import NonlinearLeastSquares

    segments = tuple(
        replace(
            one,
            signals=tuple(dataset.model.signals),
            measured=motion.signals[rows][: len(one)],
            valid=np.ones(len(one), bool),
        )
        for one, rows in zip(dataset.segments, intervals.rows_of_logs, strict=True)
    )
    return NonlinearLeastSquares().bind(replace(dataset, segments=segments))


def random_sets(settings: LoDiransacSettings, weak: Rows, seed: int) -> BoolArray:
    """All rows, and random sets of n to 4 n rows of each equation, with n parameters.

    Parameters
    ----------
    settings : LoDiransacSettings
    weak : Rows
    seed : int
        Set k depends on the seed and k alone.

    Returns
    -------
    (1 + n_samples, n_rows, r) bool array
    """
    n, r, n_p = weak.W.shape
    k = np.arange(settings.n_samples)
    sizes = _sizes(seed, k, n, n_p)
    draws = r * k[:, None] + np.arange(r)
    most = min(_LARGEST_SAMPLE * n_p, n)
    rows = sample_rows(seed, draws.ravel(), n, 0, most).reshape(len(k), r, most)
    inside = np.broadcast_to(np.arange(rows.shape[2]) < sizes[:, None, None], rows.shape)
    sample, equation, _ = np.nonzero(inside)
    chosen = np.zeros((1 + len(k), n, r), bool)
    chosen[0] = True
    chosen[1 + sample, rows[inside], equation] = True
    return chosen


def _sizes(seed: int, k: IntArray, n: int, n_p: int) -> IntArray:
    """Number of rows of samples k: n_p to 4 n_p, of n rows; keys from the end are no sample's."""
    drawn = sample_rows(seed, ~k.astype(np.uint64), (_LARGEST_SAMPLE - 1) * n_p + 1, 0, 1)[:, 0]
    return np.asarray(np.minimum(n_p + drawn, n))


def weak_form(intervals: Windows, motion: Motion) -> Rows:
    """Rows of the smoothed motion, averaged under overlapping bumps that lie within one log each.

    Parameters
    ----------
    intervals : Windows
    motion : Motion
        Smoothed motion over the rows of the intervals.

    Returns
    -------
    Rows
    """
    model, H, layout = intervals.model, intervals.length, intervals.layout
    n_p = model.n_p
    bump = bump_of(H)
    Ws, bs = [], []
    for i, rows in enumerate(intervals.rows_of_logs):
        firsts = firsts_of(intervals, rows) - rows.start
        if not len(firsts):
            continue
        logged = slice(rows.start, rows.start + int(intervals.is_logged[rows].sum()))
        q, v, a, y = motion.parts(model, logged)
        W, b = regression_rows(model, q, v, a, intervals.inputs[logged], y)
        r = b.shape[1]
        both = np.concatenate([W.swapaxes(1, 2).reshape(len(b), -1), b], axis=1)
        del q, v, a, y, W
        windows = np.lib.stride_tricks.sliding_window_view(both, H, axis=0)
        at_a_time = max(1, _NUMBERS_AT_A_TIME // windows[0].size)
        means = np.concatenate([windows[firsts[k]] @ bump for k in row_blocks(len(firsts), at_a_time)])
        Ws.append(layout.scattered(means[:, : n_p * r].reshape(-1, n_p, r).swapaxes(1, 2), i))
        bs.append(means[:, n_p * r :])
    return _scaled(Rows(np.ascontiguousarray(np.concatenate(Ws)), np.concatenate(bs)), model.n_v)


def bump_of(n_rows: int) -> FloatArray:
    """Weights ``(n_rows,)`` of the rows of an average, which vanish towards its ends; their sum is 1.

    Parameters
    ----------
    n_rows : int
    """
    bump = np.sin(np.pi * (np.arange(n_rows) + 0.5) / n_rows) ** 2
    return np.asarray(bump / bump.sum())


def firsts_of(intervals: Windows, rows: slice) -> IntArray:
    """First rows of overlapping averages of an interval's length, within one log and outside of its gaps.

    Parameters
    ----------
    intervals : Windows
    rows : slice
        Those of the log.
    """
    H, n_logged = intervals.length, int(intervals.is_logged[rows].sum())
    firsts = np.arange(0, n_logged - H + 1, max(1, H // _OVERLAP))
    gaps = np.concatenate([[0], np.cumsum(intervals.gaps[rows][:n_logged])])
    return np.asarray(rows.start + firsts[gaps[firsts + H] == gaps[firsts]])


def _scaled(weak: Rows, n_v: int) -> Rows:
    """The rows in units of the scales of the n_v equations, and of the sensors after them."""
    scale = equation_scales(Rows(weak.W[:, :n_v], weak.b[:, :n_v]))
    sensors = [_sensor_scale(weak.W[:, k], weak.b[:, k]) for k in range(n_v, weak.b.shape[1])]
    scale = np.concatenate([scale, sensors])
    return weak.over(scale)


def _sensor_scale(W: FloatArray, b: FloatArray) -> float:
    """Scale of a sensor's rows: the median residual of their own least squares, a hundredth of their terms at least."""
    used = (b != 0.0) | W.any(axis=1)
    if not used.any():
        return 1.0
    W, b = W[used], b[used]
    terms = W * solve(Rows(W[:, None], b[:, None])).p
    size = np.median(np.sqrt(np.square(terms).sum(axis=1) + np.square(b)))
    return float(max(np.median(np.abs(terms.sum(axis=1) - b)), _SMALL_RESIDUAL * size)) or 1.0


def equation_scales(rows: Rows) -> FloatArray:
    """Scale of each equation: the median of its residuals, and a hundredth of its terms at least.

    Sizes of the terms of equations without a known term (``b = 0``) are those of `solve_sized`: parameters
    that such an equation shrinks would shrink its scale, and a smaller scale the parameters.

    Parameters
    ----------
    rows : Rows
        Rows in the units of the equations.

    Returns
    -------
    (r,) array
        1 for an equation whose size no other one determines.
    """
    everything = np.ones((1, *rows.b.shape), bool)
    scale = _median_size(rows.b - np.median(rows.b, axis=0))
    scale = np.where(scale > 0.0, scale, np.abs(rows.b).max(axis=0)) * rows.has_known_terms
    for residuals in (False, False, False, True, True):
        scale = np.where(scale > 0.0, scale, np.inf)
        terms = rows.W * solve_sized(rows.over(scale), everything)[0]
        scale = _median_size(np.sqrt(np.square(terms).sum(axis=2) + np.square(rows.b)))
        if residuals:
            scale = np.maximum(_median_size(terms.sum(axis=2) - rows.b), _SMALL_RESIDUAL * scale)
    return np.where(scale > 0.0, scale, 1.0)


def _median_size(values: FloatArray) -> FloatArray:
    return np.asarray(np.median(np.abs(values), axis=0))


def _admitted(intervals: Windows, p: FloatArray) -> FloatArray:
    """Hypotheses clipped to inclusive bounds, without those that violate a strict one."""
    p = np.clip(p, *inclusive_bounds(intervals.layout.bounds))
    return p[intervals.layout.admits(p)]


def robust_scores(intervals: Windows, motion: Motion, parameters: FloatArray, chosen: IntArray) -> FloatArray:
    """Sum over signals of the log of the 35 % quantile of ``|residual|``, by simulation from the smoothed states.

    The score needs no threshold, and its order does not depend on units.

    Parameters
    ----------
    intervals : Windows
    motion : Motion
        Smoothed motion over the rows of the intervals.
    parameters : (n_hypotheses, n) array
    chosen : (n_chosen,) int array
        Indices of the intervals that are simulated.

    Returns
    -------
    (n_hypotheses,) array
        Lower is better; infinite where the simulation diverges on most samples.
    """
    at_a_time = max(1, _NUMBERS_AT_A_TIME // (len(chosen) * intervals.length * len(intervals.model.signals)))
    parts = [parameters[k : k + at_a_time] for k in range(0, len(parameters), at_a_time)]
    return np.concatenate([_scores(intervals, motion, part, chosen) for part in parts])


def _scores(intervals: Windows, motion: Motion, parameters: FloatArray, chosen: IntArray) -> FloatArray:
    """Scores of hypotheses, as `robust_scores`, all at a time."""
    n, n_x = len(parameters), intervals.model.n_q + intervals.model.n_v
    starts, logs = intervals.starts[chosen], np.tile(intervals.log_of[chosen], n)
    seen: BoolArray = np.asarray(intervals.known.any(axis=0))
    names = [s for s, k in zip(intervals.model.signals, seen, strict=True) if k]
    own = np.repeat(parameters, len(starts), axis=0)
    if not intervals.layout.is_shared:
        own = np.take_along_axis(own, intervals.layout.index[logs], axis=1)
    batch = RolloutBatch(
        own, np.tile(motion.signals[starts, :n_x], (n, 1)), intervals.inputs, intervals.dt, np.tile(starts, n),
        intervals.length, intervals.first_of_log,
    )  # fmt: skip
    compared = intervals.measurements(columns=slice(None) if seen.all() else np.flatnonzero(seen))
    simulator = rollouts(intervals.model, names, substeps=intervals.substeps, hold=intervals.hold)
    errors = simulator.errors(batch, compared).reshape(n, -1, len(names))
    known = intervals.known[intervals.rows_of(chosen)][:, seen]
    scale = lower_scale(np.nan_to_num(errors, copy=False, nan=np.inf), known)
    return np.asarray(np.log(np.maximum(scale, 1e-4 * motion.spread[seen])).sum(axis=1))
