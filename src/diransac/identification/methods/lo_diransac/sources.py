"""Estimates that need no joint fit: least squares of all rows at several bandwidths, and simulation error.

Simulation error (output error) neither smooths nor differentiates: the initial states of short segments and the
parameters are fitted to the samples together, from starts within the bounds, over segments that grow.  Short segments
have few local minima, long ones the information.

References
----------
Ljung 1999, section 5.1 (output error); Ribeiro et al. 2020 (segments that grow); Holland, Welsch 1977 (reweighting).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.errors import IdentificationError, LogError, SettingsError
from diransac.identification.methods.lo_diransac.mixture import Mixture, lower_scale
from diransac.identification.methods.lo_diransac.segments import ActingInputs, Segments, first_states, stretches
from diransac.identification.estimators import regression
from diransac.identification.uncertainty import student_quantile
from diransac.time_limit import check_time

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset
    from diransac.data.log import Log
    from diransac.identification.methods.lo_diransac.projection import ProjectedEstimate
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
    from diransac.identification.methods.lo_diransac.smoothing import Motion
    from diransac.model import Model, Parameter

__all__ = ["Blocks", "Candidate", "jackknife", "least_squares_candidates", "simulation_error_candidates"]

N_BLOCKS = 10
_BANDWIDTHS = (0.5, 1.0, 2.0, 4.0)
"""Of filtered least squares, over the bandwidth that the package chooses for a log."""
_N_RANDOM, _N_FOLLOWED, _DECADE = 16, 3, 1.0
_SHORTEST, _GROWTH, _FEWEST_SEGMENTS = 8, 3, 12
_ROWS_OF_SEARCH, _MOST_ROWS, _SCREENED = 3000, 50_000, 16
_STEPS, _CONVERGED = 25, 0.1
"""Steps at most, and the change of the parameters, standard errors, that ends them."""
_NOISE_MOVES = 0.03
_DAMPING, _LARGEST_DAMPING = 1e-6, 1e6
_FLOOR = 1e-5
_LOST = 2.0
_TINY = 1e-300


@dataclass(frozen=True)
class Blocks:
    """Stretches of time of about equal length, each of which is left out in turn.

    Parameters
    ----------
    of_row : (N,) int array
        Block of each row of the intervals.
    n : int
    """

    of_row: IntArray
    n: int

    @classmethod
    def of(cls, intervals: ShootingIntervals) -> Blocks:
        """Blocks of the rows that count, as one log; of every log, where logs have parameters of their own."""
        found = np.zeros(len(intervals.is_logged), int)
        parts = intervals.rows_of_logs if not intervals.layout.is_shared else [slice(None)]
        for rows in parts:
            counted = np.cumsum(intervals.counted[rows]) - 1
            found[rows] = np.clip(N_BLOCKS * counted // max(counted[-1] + 1, 1), 0, N_BLOCKS - 1)
        return cls(found, N_BLOCKS)


@dataclass(frozen=True)
class Candidate:
    """An estimate of the parameters, and what it is without each block of the logs.

    Parameters
    ----------
    name : str
        Source and variant.
    parameters : (n,) array
    without : (n_blocks, n) array
    acting : ActingInputs
        Inputs with which it was estimated.
    intervals : ShootingIntervals
        The logs, corrected of the errors of their sensors with which it was estimated.
    estimate : callable, optional
        The estimate with its covariance; None: that of the jackknife over blocks.
    """

    name: str
    parameters: FloatArray
    without: FloatArray
    acting: ActingInputs
    intervals: ShootingIntervals
    estimate: Callable[[], ProjectedEstimate] | None = None


def jackknife(without: FloatArray) -> FloatArray:
    """Covariance ``(n, n)`` from estimates without each block, increased by Student's t for their number."""
    K = len(without)
    apart = without - without.mean(axis=0)
    more = student_quantile(K - 1, 0.975) / student_quantile(10_000, 0.975)
    return np.asarray(more**2 * (K - 1.0) / K * apart.T @ apart)


# ---------------------------------------------------------------------- least squares of all rows


def least_squares_candidates(dataset: Dataset, intervals: ShootingIntervals, blocks: Blocks) -> Iterator[Candidate]:
    """Least squares of all rows, of signals as they were recorded and as they are filtered at several bandwidths.

    Parameters
    ----------
    dataset : Dataset
    intervals : ShootingIntervals
        Of the same logs.
    blocks : Blocks

    Yields
    ------
    Candidate
        Those that the logs and the model admit.
    """
    from diransac.data.dataset import Dataset
    from diransac.data.preprocessing.differentiation import differentiate
    from diransac.identification.estimators import OrdinaryLeastSquares
    from diransac.identification.nonlinear import NonlinearLeastSquares

    from diransac.data.dataset import Dataset

    model = dataset.model.with_sensors(())
    acting, whole = ActingInputs.recorded(intervals, dataset.hold), _filtered(dataset, model)
    for k, (label, logs) in enumerate(whole):
        try:
            own = replace(Dataset.of(model, logs), layout=dataset.layout)
        except LogError:
            continue
        block = _blocks_of_rows(own, dataset, intervals, blocks)
        kinds = [_ordinary] if model.is_affine else []
        kinds += [_nonlinear] if k == len(whole) // 2 else []
        for kind in kinds:
            check_time()
            try:
                parameters, without = kind(own, block, blocks.n)
            except (IdentificationError, np.linalg.LinAlgError):
                continue
            if np.isfinite(parameters).all() and dataset.layout.admits(parameters[None])[0]:
                name = f"{'ols' if kind is _ordinary else 'nls'}{label}"
                yield Candidate(name, parameters, without, acting, intervals)


def _filtered(dataset: Dataset, model: Model) -> list[tuple[str, list[Log]]]:
    """Logs as they are where all signals are measured, and filtered at several bandwidths; with labels."""
    from diransac.data.preprocessing.differentiation import differentiate

    logs = [one.log for one in dataset.segments]
    needed = (*model.coordinates, *model.velocities, *model.accelerations)
    found = [("", logs)] if all(name in log for log in logs for name in needed) else []
    try:
        usual = [differentiate(log, model) for log in logs]
    except (LogError, SettingsError):
        return found
    for factor in _BANDWIDTHS:
        try:
            bands = [factor * one.filter.bandwidth for one in usual if one.filter is not None]
            some = usual if factor == 1.0 else [differentiate(x, model, f) for x, f in zip(logs, bands, strict=True)]
        except (LogError, SettingsError):
            continue
        found.append((f", {float(np.median(bands)):.3g} Hz", some))
    return found


def _blocks_of_rows(own: Dataset, dataset: Dataset, intervals: ShootingIntervals, blocks: Blocks) -> IntArray:
    """Block of each usable row of prepared logs."""
    places = []
    for one, given, rows in zip(own.segments, dataset.segments, intervals.rows_of_logs, strict=True):
        time = one.log.time[one.offset : one.offset + len(one)][one.valid]
        place = rows.start + np.round((time - given.log.time[given.offset]) / given.log.dt).astype(int)
        places.append(np.clip(place, rows.start, rows.stop - 1))
    return np.asarray(blocks.of_row[np.concatenate(places)])


def _ordinary(own: Dataset, block: IntArray, n_blocks: int) -> tuple[FloatArray, FloatArray]:
    """Ordinary least squares within the bounds, of all rows and without each block."""
    W, b = regression(own)
    columns = np.concatenate([W, b[:, :, None]], axis=2)
    scale = np.sqrt(np.square(columns).mean(axis=(0, 1)))
    columns = columns / np.where(scale > 0.0, scale, 1.0)
    sums = np.array([np.einsum("nri,nrj->ij", x, x) for x in (columns[block == k] for k in range(n_blocks))])
    gram = sums.sum(axis=0)
    unit = scale[-1] / np.where(scale > 0.0, scale, 1.0)[:-1]
    precision = unit**2 / np.square(own.layout.prior_std)
    if precision.any():
        p = np.linalg.lstsq(gram[:-1, :-1], gram[:-1, -1], rcond=None)[0]
        variance = (gram[-1, -1] - p @ gram[:-1, -1]) / b.size
        gram[:-1, :-1] += variance * np.diag(precision)
        gram[:-1, -1] += variance * precision * own.layout.prior_mean / unit
    every = [gram, *(gram - x for x in sums)]
    found = np.array([_within_bounds(G, unit, own.layout.bounds) for G in every])
    return found[0], found[1:]


def _within_bounds(gram: FloatArray, unit: FloatArray, bounds: Sequence[Parameter]) -> FloatArray:
    """Least squares ``(n,)`` from sums with the right-hand side as last column; those that leave a bound stay on it."""
    p, stuck = np.zeros(len(unit)), np.zeros(len(unit), bool)
    lower, upper = (np.array([getattr(x, name) for x in bounds]) / unit for name in ("lower", "upper"))
    for _ in range(len(unit)):
        free = ~stuck
        right = gram[:-1, -1] - gram[:-1, :-1][:, stuck] @ p[stuck]
        p[free] = np.linalg.lstsq(gram[:-1, :-1][np.ix_(free, free)], right[free], rcond=1e-12)[0]
        outside = free & ((p < lower) | (p > upper))
        if not outside.any():
            break
        p, stuck = np.clip(p, lower, upper), stuck | outside
    return np.asarray(p * unit)


def _nonlinear(own: Dataset, block: IntArray, n_blocks: int) -> tuple[FloatArray, FloatArray]:
    """Least squares of the accelerations, of all rows and without each block."""
    from diransac.identification.nonlinear import NonlinearLeastSquares

    bound = NonlinearLeastSquares().bind(own)
    rows = np.arange(0, bound.n_rows, max(1, bound.n_rows // _ROWS_OF_SEARCH))
    groups = [rows[block[rows] == k] for k in range(n_blocks)]
    return bound.select([rows]).fit()[0], bound.fit_without(groups, rows)


# ---------------------------------------------------------------------- simulation error


@dataclass(frozen=True)
class _Solution:
    """Parameters with the initial states of all segments.

    Parameters
    ----------
    segments : Segments
    parameters : (n,) array
    states : (K, n_x) array
    noise : Mixture
        Of the compared signals.
    cost : float
        Negative log-likelihood per known sample.
    """

    segments: Segments
    parameters: FloatArray
    states: FloatArray
    noise: Mixture
    cost: float


def simulation_error_candidates(
    intervals: ShootingIntervals,
    motion: Motion,
    starts: FloatArray,
    actings: Sequence[ActingInputs],
    seed: int,
    blocks: Blocks,
    *,
    outliers: bool = True,
) -> list[tuple[Candidate, Motion]]:
    """Estimates by simulation error over segments that grow, each with its simulated motion.

    Parameters
    ----------
    intervals : ShootingIntervals
    motion : Motion
        From which states start that nothing measures.
    starts : (m, n) array
        Parameters to start from, within the bounds; further ones are random about them.
    actings : sequence of ActingInputs
        Of which the likeliest is taken.
    seed : int
    blocks : Blocks
    outliers : bool, optional
        Whether samples may be outliers.

    Returns
    -------
    list of (Candidate, Motion)
        The shortest segments first; empty where every simulation diverges.
    """
    longest = max((x.stop - x.start for x in stretches(intervals)), default=0)
    starts = np.vstack([starts, _random_starts(intervals, starts, seed)])
    length, found, best = min(_SHORTEST, longest), [], None
    while length >= _SHORTEST and length <= longest:
        check_time()
        if best is None:
            tried = [_from_starts(intervals, motion, starts, acting, length, outliers) for acting in actings]
            tried = [x for x in tried if x is not None]
            best = min(tried, key=lambda x: x.cost, default=None)
            if best is None:
                return []
        else:
            best = _grown(best, length)
        found.append((_candidate(best, blocks), _simulated(best, motion)))
        n_segments = len(best.segments)
        if n_segments <= _FEWEST_SEGMENTS:
            break
        length *= _GROWTH
    return found


def _random_starts(intervals: ShootingIntervals, known: FloatArray, seed: int) -> FloatArray:
    """Parameters within a decade of known ones, log-uniform; within the bounds where both are given."""
    layout, found = intervals.layout, []
    for k in range(_N_RANDOM):
        rng = np.random.default_rng([abs(seed), int(seed < 0), k])
        p = known[k % len(known)] * 10.0 ** rng.uniform(-_DECADE, _DECADE, len(layout))
        inside = rng.uniform(0.0, 1.0, len(layout))
        for j, bound in enumerate(layout.bounds):
            if np.isfinite(bound.lower) and np.isfinite(bound.upper):
                p[j] = bound.lower + inside[j] * (bound.upper - bound.lower)
            p[j] = np.clip(p[j], bound.lower, bound.upper)
        found.append(p)
    return np.array(found)


def _segments(intervals: ShootingIntervals, acting: ActingInputs, length: int, most_rows: int = _MOST_ROWS) -> Segments:
    """Segments one after another in all stretches; every so-manieth one where there are too many rows."""
    starts = np.concatenate(
        [np.arange(x.start, x.stop - length + 1, length) for x in stretches(intervals)] or [np.arange(0)]
    )
    every = max(1, int(np.ceil(len(starts) * length / most_rows)))
    return Segments(intervals, acting, starts[::every], length)


def _known(segments: Segments) -> BoolArray:
    """Measured samples ``(K, n_rows, n_s)`` of the compared signals."""
    return segments.intervals.sampled[segments.rows][:, :, segments.columns]


def _first_noise(segments: Segments, spread: FloatArray, *, outliers: bool) -> Mixture:
    """Noise before anything is known: a tenth of the spread."""
    intervals, columns = segments.intervals, segments.columns
    low = np.where(intervals.sampled, intervals.measured, np.inf).min(axis=0)[columns]
    high = np.where(intervals.sampled, intervals.measured, -np.inf).max(axis=0)[columns]
    span = np.where(high > low, high - low, 1.0)
    sizes = np.where(spread[columns] > 0.0, spread[columns], span)
    places = {int(c): k for k, c in enumerate(columns)}
    whole = [tuple(places[i] for i in four) for four in intervals.model.quaternions if four[0] in places]
    fraction = np.full(len(columns), 0.1 if outliers else 0.0)
    return Mixture(0.1 * sizes, fraction, span, _FLOOR * sizes, whole)  # type: ignore[arg-type]


def _weights(segments: Segments, noise: Mixture, inlying: FloatArray) -> FloatArray:
    """Weights ``(N, n_s)`` in all rows, from those of the segments' samples ``(K, n_rows, n_s)``."""
    found = np.zeros((len(segments.intervals.measured), inlying.shape[2]))
    found[segments.rows.ravel()] = (inlying / np.square(noise.sigma)).reshape(-1, inlying.shape[2])
    return found


def _flat(values):
    return values.reshape(-1, values.shape[-1])


def _from_starts(intervals, motion, starts, acting, length, outliers) -> _Solution | None:
    """The likeliest solution over short segments from many starts, of which the best few are followed."""
    some = _segments(intervals, acting, length, _ROWS_OF_SEARCH)
    if not len(some):
        return None
    noise = _first_noise(some, motion.spread, outliers=outliers)
    known = _known(some)
    sampled: BoolArray = np.ones_like(intervals.known)
    x0 = first_states(intervals, motion.signals, sampled, some.starts)
    # every start, on few segments, with states of their own
    few = replace(some, starts=some.starts[:: max(1, len(some) // _SCREENED)])
    at = np.isin(some.starts, few.starts)
    lanes = np.repeat(starts[:, None], len(few), axis=1)
    weights = _weights(few, noise, known[at].astype(float))
    states = few.estimated_states(lanes, np.broadcast_to(x0[at], (len(starts), *x0[at].shape)).copy(), weights)
    errors = few.errors(lanes, states)
    scale = lower_scale(errors.reshape(len(starts), -1, errors.shape[3]), _flat(known[at]))
    scores = np.log(np.nan_to_num(scale, nan=_TINY) + noise.floor).sum(axis=1)
    order = np.argsort(scores, kind="stable")[:_N_FOLLOWED]
    found = []
    for k in order:
        states = some.estimated_states(
            np.repeat(starts[k][None, None], len(some), axis=1), x0[None].copy(), _weights(some, noise, known.astype(float))
        )[0]
        found.append(_descended(_Solution(some, starts[k], states, noise, np.inf)))
    best = min(found, key=lambda x: x.cost)
    if not np.isfinite(best.cost):
        return None
    every = _segments(intervals, acting, length)
    if len(every) == len(some):
        return best
    x0 = first_states(intervals, motion.signals, sampled, every.starts)
    lanes = np.repeat(best.parameters[None, None], len(every), axis=1)
    weights = _weights(every, best.noise, _known(every).astype(float))
    return _descended(_Solution(every, best.parameters, every.estimated_states(lanes, x0[None], weights)[0], best.noise, np.inf))


def _grown(now: _Solution, length: int) -> _Solution:
    """The solution over longer segments, whose states are those of the shorter ones."""
    longer = _segments(now.segments.intervals, now.segments.acting, length)
    nearest = np.clip(np.searchsorted(now.segments.starts, longer.starts, side="right") - 1, 0, None)
    series = now.segments.trajectories(
        np.repeat(now.parameters[None, None], len(now.segments), axis=1), now.states[None]
    )[0]
    n_x = now.states.shape[1]
    offset = np.clip(longer.starts - now.segments.starts[nearest], 0, now.segments.n_rows - 1)
    states = np.nan_to_num(series[nearest, offset, :n_x])
    errors = longer.errors(np.repeat(now.parameters[None, None], len(longer), axis=1), states[None])
    scale = np.nan_to_num(lower_scale(_flat(errors[0]), _flat(_known(longer))), nan=1.0)
    noise = replace(now.noise, sigma=np.maximum(scale, now.noise.floor))
    return _descended(_Solution(longer, now.parameters, states, noise, np.inf))


def _normal_equations(now: _Solution, weights: FloatArray):
    """Sums of each segment with the states eliminated: blocks H_xx, H_xp, gradients, and H_pp, g_p, in all parameters' places."""
    segments, intervals = now.segments, now.segments.intervals
    lanes = np.repeat(now.parameters[None, None], len(segments), axis=1)
    sums = segments.gauss_newton(lanes, now.states[None], weights, parameters_too=True)
    n_x, n = now.states.shape[1], len(now.parameters)
    H, g = sums.normal_matrix, sums.gradient
    logs = intervals.log_of_row[segments.starts]
    index = intervals.layout.index[logs]
    H_xp, g_p = np.zeros((len(H), n_x, n)), np.zeros((len(H), n))
    H_pp = np.zeros((len(H), n, n))
    k = np.arange(len(H))
    H_xp[k[:, None, None], np.arange(n_x)[None, :, None], index[:, None, :]] = H[:, :n_x, n_x:]
    H_pp[k[:, None, None], index[:, :, None], index[:, None, :]] = H[:, n_x:, n_x:]
    g_p[k[:, None], index] = g[:, n_x:]
    return H[:, :n_x, :n_x], H_xp, H_pp, g[:, :n_x], g_p


def _reduced(blocks, damping: float):
    """Each segment's part ``(K, n, n)``, ``(K, n)`` of the parameters' equations, and what its state follows with."""
    H_xx, H_xp, H_pp, g_x, g_p = blocks
    d = np.sqrt(np.einsum("kii->ki", H_xx)) + 1e-150
    scaled = H_xx / d[:, :, None] / d[:, None, :] + (damping + 1e-12) * np.eye(H_xx.shape[1])
    solved = np.linalg.solve(scaled, np.concatenate([H_xp, g_x[:, :, None]], axis=2) / d[:, :, None]) / d[:, :, None]
    follow, own = solved[:, :, :-1], solved[:, :, -1]
    S = H_pp - np.einsum("kxi,kxj->kij", H_xp, follow)
    r = g_p - np.einsum("kxi,kx->ki", H_xp, own)
    return S, r, follow, own


def _solved(S, r, damping):
    d = np.sqrt(np.maximum(np.diag(S), 0.0)) + 1e-150
    scaled = S / d[:, None] / d[None, :] + (damping + 1e-10) * np.eye(len(S))
    return np.linalg.lstsq(scaled, r / d, rcond=None)[0] / d


def _with_prior(intervals, p, S, r):
    precision = 1.0 / np.square(intervals.layout.prior_std)
    return S + np.diag(precision), r + precision * np.where(precision > 0.0, p - intervals.layout.prior_mean, 0.0)


def _moved(intervals, now: FloatArray, step: FloatArray) -> FloatArray:
    """Parameters after a step within the bounds; a positive one changes by a factor of two at most."""
    then = now + step
    for j, bound in enumerate(intervals.layout.bounds):
        then[j] = np.clip(then[j], bound.lower, bound.upper)
        if bound.positive:
            then[j] = np.clip(then[j], 0.5 * now[j], 2.0 * now[j])
    return then


def _descended(now: _Solution) -> _Solution:
    """Levenberg and Marquardt's steps of parameters and states, reweighted by the noise."""
    segments, intervals, damping = now.segments, now.segments.intervals, _DAMPING
    known = _known(segments)
    flat_known, K = _flat(known), len(segments)

    def residuals(p, x):
        return _flat(segments.errors(np.repeat(p[None, None], K, axis=1), x[None])[0])

    n_known = max(int(known.sum()), 1)
    p, x, noise = now.parameters, now.states, now.noise
    e = residuals(p, x)
    for _ in range(_STEPS):
        check_time()
        old, inlying = noise.sigma, noise.inlying(e, flat_known)
        noise = noise.updated(e, flat_known, inlying, outliers=bool(noise.pi.any()))
        noise_moves = bool((np.abs(np.log(noise.sigma / old)) > _NOISE_MOVES).any())
        inlying = noise.inlying(e, flat_known)
        cost = float(noise.negative_log_likelihood(e, flat_known).sum())
        weights = _weights(segments, noise, inlying.reshape(known.shape))
        blocks = _normal_equations(replace(now, parameters=p, states=x), weights)
        if not all(np.isfinite(b).all() for b in blocks):
            break
        moved = False
        while damping <= _LARGEST_DAMPING:
            S, r, follow, own = _reduced(blocks, damping)
            S_all, r_all = _with_prior(intervals, p, S.sum(axis=0), r.sum(axis=0))
            then = _moved(intervals, p, -_solved(S_all, r_all, damping))
            x_then = x - own - follow @ (then - p)
            e_then = residuals(then, x_then)
            if noise.negative_log_likelihood(e_then, flat_known).sum() < cost:
                changed = np.abs(then - p) * np.sqrt(np.diag(S_all))
                p, x, e, moved, damping = then, x_then, e_then, True, max(0.1 * damping, 1e-12)
                break
            damping *= 10.0
        if not moved or (changed.max() < _CONVERGED and not noise_moves):
            break
    cost = float(noise.negative_log_likelihood(e, flat_known).sum()) / n_known
    return _Solution(segments, p, x, noise, cost if np.abs(e).max(initial=0.0) < 1e6 else np.inf)


def _candidate(found: _Solution, blocks: Blocks) -> Candidate:
    """The estimate, and by one Newton step what it is without each block."""
    segments, intervals = found.segments, found.segments.intervals
    known = _known(segments)
    K = len(segments)
    e = _flat(segments.errors(np.repeat(found.parameters[None, None], K, axis=1), found.states[None])[0])
    inlying = found.noise.inlying(e, _flat(known)).reshape(known.shape)
    S, r, _, _ = _reduced(_normal_equations(found, _weights(segments, found.noise, inlying)), 0.0)
    block = blocks.of_row[segments.starts + segments.n_rows // 2]
    without = []
    for k in range(blocks.n):
        left = block != k
        S_k, r_k = _with_prior(intervals, found.parameters, S[left].sum(axis=0), r[left].sum(axis=0))
        without.append(_moved(intervals, found.parameters, -_solved(S_k, r_k, 0.0)))
    seconds = segments.n_rows * intervals.dt
    return Candidate(
        f"simulation error, {seconds:.2g} s", found.parameters, np.array(without), segments.acting, intervals
    )


def _simulated(found: _Solution, motion: Motion) -> Motion:
    """The motion of the segments; the given one in rows that none covers."""
    segments, signals = found.segments, motion.signals.copy()
    lanes = np.repeat(found.parameters[None, None], len(segments), axis=1)
    series = segments.trajectories(lanes, found.states[None])[0]
    finite = np.isfinite(series).all(axis=(1, 2))
    signals[segments.rows[finite].ravel()] = _flat(series[finite])
    return replace(motion, signals=signals)
