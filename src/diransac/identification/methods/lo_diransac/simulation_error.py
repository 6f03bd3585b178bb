"""Simulation error (output error): parameters and initial states of segments, fitted to the samples together.

It neither smooths nor differentiates.  Short segments have few local minima, long ones the information: a search from
many starts over the shortest segments is followed by fits over segments three times as long, up to a block, and on to a
whole log as far as it can be simulated at once.

Initial states have a Gaussian prior, the measured or smoothed state within the spread of the motion: few samples of a
segment may not determine them.  Samples are a mixture with outliers, and so are those of a segment that diverges.

References
----------
Ljung 1999, section 5.1 (output error); Ribeiro et al. 2020 (segments that grow); Dempster, Laird, Rubin 1977 (noise).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.identification.estimate import LogEstimate
from diransac.identification.methods.lo_diransac.mixture import Mixture, NoiseSums, lower_scale
from diransac.identification.methods.lo_diransac.segments import (
    ActingInputs,
    Segments,
    inlying_samples,
    prior_states,
    stretches,
    whole_stretches,
)
from diransac.identification.methods.lo_diransac.sources import Blocks, Candidate, jackknife
from diransac.time_limit import check_time

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
    from diransac.identification.methods.lo_diransac.smoothing import Motion

_SHORTEST, _GROWTH = 8, 3
"""Rows of the shortest segments at least, and the factor by which they grow, up to the length of a block."""
_N_RANDOM, _DECADES = 16, 1.0
"""Number of random starts, and how far from known parameters they are."""
_SCREENED, _FOLLOWED = 16, 2
"""Segments on which all starts are scored, and the number of starts that are followed."""
_ROWS_OF_SEARCH, _MOST_ROWS = 3_000, 50_000
"""Rows of the fits from several starts, and of others, at most."""
_WHOLE_ROW = 1.0 / 12.0
"""Variance of a number that is rounded to a whole one."""
_STEPS, _FEW_STEPS, _CONVERGED, _NOISE_MOVES = 25, 3, 0.1, 0.03
"""Steps at most, and of a solution that is close to another; change of parameters, standard errors, and relative change
of the noise that end them."""
_SIMULATED = 0.5
"""Robust scale of the errors over the spread of a signal, up to which a simulation follows it."""
_HOPELESS = 0.1
"""Loss of log-likelihood per sample, of errors a tenth larger, from which on a solution is not followed to its end."""
_DAMPING, _DAMPING_BOUNDS = 1e-6, (1e-12, 1e6)
_RIDGE, _FLOOR, _TINY = 1e-10, 1e-5, 1e-150


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
        Starts are compared with the first; the others follow from its result.  Over short segments the likeliest is
        taken; the others follow again over the longest ones, and count unless samples are much less likely with them.
    seed : int
    blocks : Blocks
    outliers : bool, optional
        Whether samples may be outliers.

    Returns
    -------
    list of (Candidate, Motion)
        The longest segments, which inform most, first; empty where the logs are too short.
    """
    starts, lengths = np.vstack([starts, _random_starts(intervals, starts, seed)]), _lengths(intervals, blocks)
    first = _from_starts(intervals, motion, starts, actings[0], lengths[0], outliers=outliers)
    if first is None:
        return []
    chain = [reduce(_Solution.likelier, (first.with_inputs(x) for x in actings[1:]), first)]
    for length in lengths:
        chain.append(chain[-1].grown(length).descended())
    for length in _whole_lengths(intervals, lengths[-1]):
        longer = chain[-1].grown(length)
        if not longer.is_simulated:
            break
        chain.append(longer.descended())
    last, taken = chain[-1], chain[-1].segments.acting
    others = [last.with_inputs(x).descended(rival=last.cost) for x in actings if x is not taken]
    found = [*(x for x in others if x.cost < x.hopeless(last.cost)), *chain[1:]]
    return [(x.candidate(blocks), x.simulated) for x in reversed(found)]


def _lengths(intervals: ShootingIntervals, blocks: Blocks) -> list[int]:
    """Rows of the segments: those of a block, a third of them, and so on, the shortest first."""
    block = int(intervals.counted.sum()) // (1 + np.count_nonzero(np.diff(blocks.of_row)))
    longest = int(np.clip(block, 1, max((int(x.stop - x.start) for x in stretches(intervals)), default=1)))
    n = max(0, int(np.log(longest / _SHORTEST) / np.log(_GROWTH)))
    return [max(_SHORTEST, longest // _GROWTH**k) for k in range(n, -1, -1)]


def _whole_lengths(intervals: ShootingIntervals, block: int) -> list[int]:
    """Rows of longer segments than a block: three times as many, and those of whole logs."""
    whole = min((x.stop - x.start for x in whole_stretches(intervals)), default=0)
    return [x for x in (_GROWTH * block, whole) if block < x <= min(whole, _MOST_ROWS)]


def estimates_of_logs(one: Candidate, motion: Motion, n_rows: int, *, outliers: bool = True) -> list[LogEstimate]:
    """Estimates of each log alone, by simulation error from an estimate of all of them.

    Parameters
    ----------
    one : Candidate
    motion : Motion
        From which states start that nothing measures.
    n_rows : int
        Rows of a segment; fewer where a log would have less than two segments per block.
    outliers : bool, optional
        Whether samples may be outliers.

    Returns
    -------
    list of LogEstimate
        With infinite standard errors where a log has fewer segments than blocks.
    """
    intervals, found = one.intervals, []
    blocks, names, n = Blocks.of(intervals, each=True), intervals.layout.names, len(one.parameters)
    for i, rows in enumerate(intervals.rows_of_logs):
        length = max(_SHORTEST, min(n_rows, (rows.stop - rows.start) // (2 * blocks.n)))
        every = _segments(intervals, one.acting, length, _MOST_ROWS)
        own = replace(every, starts=every.starts[intervals.log_of_row[every.starts] == i])
        parameters, errors, late, late_error = one.parameters, np.full(n, np.inf), 0, np.inf
        if len(own) >= blocks.n:
            noise = _first_noise(own, motion.spread, outliers=outliers)
            fitted = _Solution.begin(own, motion, one.parameters, noise).descended()
            fitted, late, late_error = fitted.with_own_timing(blocks)
            fitted = fitted.descended() if late else fitted
            parameters, errors = fitted.parameters, fitted.standard_errors(blocks)
        values, spans = (dict(zip(names, x.tolist(), strict=True)) for x in (parameters, errors))
        found.append(LogEstimate(values, spans, late * intervals.dt, late_error * intervals.dt))
    return found


def _random_starts(intervals: ShootingIntervals, known: FloatArray, seed: int) -> FloatArray:
    """Parameters within a decade of known ones, log-uniform; within the bounds where both are given."""
    bounds = intervals.layout.bounds
    lower, upper = np.array([[x.lower, x.upper] for x in bounds]).T
    both, found = np.isfinite(lower) & np.isfinite(upper), []
    for k in range(_N_RANDOM):
        rng = np.random.default_rng([abs(seed), int(seed < 0), k])
        about = known[k % len(known)] * 10.0 ** rng.uniform(-_DECADES, _DECADES, len(bounds))
        inside = rng.uniform(np.where(both, lower, 0.0), np.where(both, upper, 1.0))
        found.append(np.clip(np.where(both, inside, about), lower, upper))
    return np.array(found)


def _segments(intervals: ShootingIntervals, acting: ActingInputs, length: int, most_rows: int) -> Segments:
    """Segments one after another in all stretches; every so-manieth one where there are too many rows."""
    parts = [np.arange(x.start, x.stop - length + 1, length) for x in stretches(intervals)]
    starts = np.concatenate([np.arange(0), *parts])
    return Segments(intervals, acting, starts[:: max(1, -(-len(starts) * length // most_rows))], length)


def _from_starts(
    intervals: ShootingIntervals,
    motion: Motion,
    starts: FloatArray,
    acting: ActingInputs,
    length: int,
    *,
    outliers: bool,
) -> _Solution | None:
    """The likeliest solution over some of the shortest segments; None where the logs are too short."""
    some = _segments(intervals, acting, length, _ROWS_OF_SEARCH)
    if not len(some):
        return None
    noise = _first_noise(some, motion.spread, outliers=outliers)
    order = np.argsort(_scores(some, motion, starts, noise), kind="stable")[:_FOLLOWED]
    first, *others = (_Solution.begin(some, motion, starts[k], noise) for k in order)
    return reduce(_Solution.likelier, others, first.descended())


def _first_noise(segments: Segments, spread: FloatArray, *, outliers: bool) -> Mixture:
    """Noise before anything is known: a tenth of the spread of each signal."""
    intervals, columns = segments.intervals, segments.columns
    low = np.where(intervals.sampled, intervals.measured, np.inf).min(axis=0)[columns]
    high = np.where(intervals.sampled, intervals.measured, -np.inf).max(axis=0)[columns]
    span = np.where(high > low, high - low, 1.0)
    sizes, place = spread[columns], {int(c): k for k, c in enumerate(columns)}
    whole = [(place[a], place[b], place[c], place[d]) for a, b, c, d in intervals.model.quaternions if a in place]
    return Mixture(0.1 * sizes, np.full(len(columns), 0.1 * outliers), span, _FLOOR * sizes, whole)


def _scores(segments: Segments, motion: Motion, starts: FloatArray, noise: Mixture) -> FloatArray:
    """Sum ``(m,)`` over signals of the logarithm of a robust scale of the errors over a few segments."""
    few = replace(segments, starts=segments.starts[:: max(1, len(segments) // _SCREENED)])
    lanes = np.repeat(starts[:, None], len(few), axis=1)
    errors = few.errors(lanes, _first_states(few, motion, lanes, noise)[0])
    known = few.known.reshape(-1, errors.shape[3])
    scale = lower_scale(errors.reshape(len(starts), *known.shape), known)
    return np.asarray(np.log(np.nan_to_num(scale) + noise.floor).sum(axis=1))


def _first_states(
    segments: Segments, motion: Motion, lanes: FloatArray, noise: Mixture
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Initial states ``(m, K, n_x)`` for parameters ``(m, K, n)``, means ``(K, n_x)`` and deviations of their prior.

    Samples far from the smoothed motion do not count.
    """
    inlying = inlying_samples(segments.intervals, motion)
    mean, spread = prior_states(segments.intervals, motion, inlying, segments.starts)
    states = np.repeat(mean[None], len(lanes), axis=0)
    counted = segments.known & inlying[segments.rows][:, :, segments.columns]
    weights = segments.weights(counted / np.square(noise.sigma))
    return segments.estimated_states(lanes, states, spread, weights), mean, spread


@dataclass(frozen=True, eq=False, repr=False)
class _Solution:
    """Parameters with the initial states of all segments.

    Parameters
    ----------
    segments : Segments
    motion : Motion
        Smoothed.
    parameters : (n,) array
    noise : Mixture
        Of the compared signals.
    states, mean, spread : (K, n_x), (K, n_x) and (n_x,) array
        Initial states, and means and standard deviations of their prior.
    errors : (K n_rows, n_s) array
        Simulated less measured samples.
    """

    segments: Segments
    motion: Motion
    parameters: FloatArray
    noise: Mixture
    states: FloatArray
    mean: FloatArray
    spread: FloatArray
    errors: FloatArray

    @classmethod
    def begin(cls, segments: Segments, motion: Motion, parameters: FloatArray, noise: Mixture) -> _Solution:
        """The solution with states that agree best with the samples of their segments."""
        lanes = np.repeat(parameters[None, None], len(segments), axis=1)
        states, mean, spread = _first_states(segments, motion, lanes, noise)
        errors = _errors(segments, parameters, states[0])
        return cls(segments, motion, parameters, noise, states[0], mean, spread, errors)

    def _at(self, segments: Segments, parameters: FloatArray, states: FloatArray) -> _Solution:
        """The solution with other segments, parameters and states."""
        errors = _errors(segments, parameters, states)
        return replace(self, segments=segments, parameters=parameters, states=states, errors=errors)

    @cached_property
    def _known(self) -> BoolArray:
        return self.segments.known.reshape(self.errors.shape)

    @cached_property
    def _losses_and_inlying(self) -> tuple[FloatArray, FloatArray]:
        """Loss of each sample, and the probability that it is no outlier."""
        return self.noise.losses_and_inlying(self.errors, self._known)

    @cached_property
    def cost(self) -> float:
        """Negative logarithm of the probability of samples and states."""
        of_states = 0.5 * np.square((self.states - self.mean) / self.spread).sum()
        return float(self._losses_and_inlying[0].sum() + of_states)

    @cached_property
    def _equations(self) -> tuple[FloatArray, FloatArray]:
        """Gauss-Newton matrix and gradient of each segment's state and of all parameters; zero after a divergence."""
        return self._equations_of(np.ones(len(self.segments.intervals.measured), bool))

    def _equations_of(self, rows: BoolArray) -> tuple[FloatArray, FloatArray]:
        """The same with samples in some rows (N,) alone."""
        segments, n_x = self.segments, self.states.shape[1]
        weights = segments.weights(self._losses_and_inlying[1] / np.square(self.noise.sigma)) * rows[:, None]
        sums = segments.gauss_newton(*_lanes(segments, self.parameters, self.states), weights)
        H, g = sums.normal_matrix, sums.gradient
        if not segments.intervals.layout.is_shared:
            H, g = self._spread_out(H, g)
        H[:, :n_x, :n_x] += np.diag(self.spread**-2.0)
        g[:, :n_x] += (self.states - self.mean) / np.square(self.spread)
        return H, g

    def _spread_out(self, H: FloatArray, g: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Matrix and gradient of states and all parameters, from those of the parameters of each segment's log."""
        segments, (K, n_x) = self.segments, self.states.shape
        own = segments.intervals.layout.index[segments.intervals.log_of_row[segments.starts]]
        at, n = np.hstack([np.tile(np.arange(n_x), (K, 1)), n_x + own]), n_x + len(self.parameters)
        matrix, gradient, k = np.zeros((K, n, n)), np.zeros((K, n)), np.arange(K)
        matrix[k[:, None, None], at[:, :, None], at[:, None, :]], gradient[k[:, None], at] = H, g
        return matrix, gradient

    def _reduced(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """Equations of the parameters without the states, as `_eliminated`."""
        return _eliminated(*self._equations, self.states.shape[1], damping)

    def hopeless(self, rival: float) -> float:
        """Cost from which on the samples are clearly less likely than a rival leaves them."""
        return rival + _HOPELESS * np.count_nonzero(self._known)

    def likelier(self, other: _Solution) -> _Solution:
        """The likelier of this solution and another one, which descends as long as it may become so."""
        found = other.descended(rival=self.cost)
        return found if found.cost < self.cost else self

    def descended(self, steps: int = _STEPS, rival: float = np.inf) -> _Solution:
        """The solution after some steps of Levenberg and Marquardt, each with an update of the noise (EM).

        They end where as much gain in all others would leave the samples clearly less likely than a rival does.
        """
        now, damping, hopeless = self, _DAMPING, self.hopeless(rival)
        for left in reversed(range(steps)):
            check_time()
            cost = now.cost
            sums = NoiseSums.of(now.errors, now._known, now._losses_and_inlying[1])
            noise = now.noise.of_sums(sums, outliers=bool(now.noise.pi.any()))
            is_steady = bool((np.abs(np.log(noise.sigma / now.noise.sigma)) < _NOISE_MOVES).all())
            now = replace(now, noise=noise)
            then, change, damping = now._stepped(damping)
            if then is None:
                break
            now = then
            if (change < _CONVERGED and is_steady) or now.cost - left * (cost - now.cost) > hopeless:
                break
        return now

    def _stepped(self, damping: float) -> tuple[_Solution | None, float, float]:
        """The solution after a step that lowers the cost, or None; its change, standard errors; the next damping."""
        intervals, least = self.segments.intervals, max(0.1 * damping, _DAMPING_BOUNDS[0])
        while damping <= _DAMPING_BOUNDS[1]:
            parts, following = self._reduced(damping)
            matrix, gradient = _with_priors(intervals, self.parameters, parts)
            p = _moved(intervals, self.parameters, -_solved(matrix, gradient, damping))
            change = p - self.parameters
            then = self._at(self.segments, p, self.states - following @ np.append(change, 1.0))
            if then.cost < self.cost:
                sizes = np.abs(change) * np.sqrt(np.maximum(np.diag(matrix), 0.0))
                return then, float(sizes.max()), least
            damping = least = 10.0 * damping
        return None, 0.0, damping

    def grown(self, length: int) -> _Solution:
        """The solution over all segments of a length, of which states and noise are their own."""
        longer = _segments(self.segments.intervals, self.segments.acting, length, _MOST_ROWS)
        found = _Solution.begin(longer, self.motion, self.parameters, self.noise)
        scale = np.nan_to_num(lower_scale(found.errors, found._known), nan=1.0)
        return replace(found, noise=replace(self.noise, sigma=np.maximum(scale, self.noise.floor)))

    @property
    def is_simulated(self) -> bool:
        """True if the errors are clearly less than the spread of their signals: the simulation is not lost."""
        spread = self.motion.spread[self.segments.columns]
        return bool((self.noise.sigma < _SIMULATED * spread).all())

    def with_inputs(self, acting: ActingInputs) -> _Solution:
        """The solution with inputs that act otherwise, at the same parameters and states."""
        return self._at(replace(self.segments, acting=acting), self.parameters, self.states)

    def candidate(self, blocks: Blocks) -> Candidate:
        """The estimate, and what it is without each block by one Newton step."""
        segments, intervals, without = self.segments, self.segments.intervals, []
        for parts in self._parts_without(blocks):
            step = -_solved(*_with_priors(intervals, self.parameters, parts), 0.0)
            without.append(_moved(intervals, self.parameters, step))
        name = f"simulation error, {segments.n_rows * intervals.dt:.2g} s, {segments.acting.sentence}"
        return Candidate(name, self.parameters, np.array(without), segments.acting, intervals)

    def _parts_without(self, blocks: Blocks) -> Iterator[FloatArray]:
        """Equations ``(K, n, n + 1)`` without each block: without its segments, or without its rows of longer ones."""
        of_row, segments = blocks.of_row, self.segments
        longer = segments.n_rows > np.bincount(of_row, minlength=blocks.n).min()
        block, parts = of_row[segments.starts + segments.n_rows // 2], None if longer else self._reduced(0.0)[0]
        for k in range(blocks.n):
            yield parts[block != k] if parts is not None else self._parts_of(of_row != k)

    def _parts_of(self, rows: BoolArray) -> FloatArray:
        """Equations of the parameters from samples in some rows (N,) alone."""
        return _eliminated(*self._equations_of(rows), self.states.shape[1], 0.0)[0]

    def standard_errors(self, blocks: Blocks) -> FloatArray:
        """Standard errors ``(n,)`` of the parameters, by the jackknife over blocks; those by white noise at least."""
        matrix, _ = _with_priors(self.segments.intervals, self.parameters, self._reduced(0.0)[0])
        d = np.sqrt(np.maximum(np.diag(matrix), 0.0)) + _TINY
        white = np.diag(np.linalg.inv(matrix / np.outer(d, d) + _RIDGE * np.eye(len(d)))) / np.square(d)
        return np.asarray(np.sqrt(np.maximum(np.diag(jackknife(self.candidate(blocks).without)), white)))

    def with_own_timing(self, blocks: Blocks) -> tuple[_Solution, int, float]:
        """The solution with inputs that act earlier or later by the likeliest number of rows; that number, its error.

        A pattern search: steps double while they help.  The error is that of the vertex of a parabola, by the jackknife
        over blocks, and of rounding.
        """
        tried, one, at, step = {0: self}, self.segments, 0, 1
        while step:
            for x in (at - step, at + step):
                if x not in tried and abs(x) < one.n_rows:
                    tried[x] = self.with_inputs(one.acting.shifted(one.intervals, x)).descended(_FEW_STEPS)
            best = min(tried, key=lambda x: tried[x].cost)
            at, step = best, (2 * step if best != at else step // 2)
        if not {at - 1, at + 1} <= tried.keys():
            return tried[at], at, np.inf
        before, now, after = (tried[at + x].costs_without(blocks) for x in (-1, 0, 1))
        vertex = 0.5 * (before - after) / np.maximum(before - 2.0 * now + after, _TINY)
        return tried[at], at, float(np.sqrt(_WHOLE_ROW + jackknife(np.clip(vertex, -1.0, 1.0)[:, None])[0, 0]))

    def costs_without(self, blocks: Blocks) -> FloatArray:
        """Negative log-likelihood of the samples without each block."""
        each = self._losses_and_inlying[0].reshape(len(self.segments), -1).sum(axis=1)
        block = blocks.of_row[self.segments.starts + self.segments.n_rows // 2]
        return np.array([each[block != k].sum() for k in range(blocks.n)])

    @property
    def simulated(self) -> Motion:
        """The motion of the segments; the smoothed one in rows that none covers."""
        lanes, signals = _lanes(self.segments, self.parameters, self.states), self.motion.signals.copy()
        series = self.segments.trajectories(*lanes)[0]
        finite = np.isfinite(series).all(axis=(1, 2))
        signals[self.segments.rows[finite]] = series[finite]
        return replace(self.motion, signals=signals)


def _eliminated(H: FloatArray, g: FloatArray, n_x: int, damping: float) -> tuple[FloatArray, FloatArray]:
    """Equations ``(K, n, n + 1)`` of the parameters, the gradient last, without the states.

    After a step dp of the parameters, these change by ``-following (dp, 1)``, with ``following (K, n_x, n + 1)``.
    """
    d = np.sqrt(np.einsum("kii->ki", H[:, :n_x, :n_x])) + _TINY
    scaled = H[:, :n_x, :n_x] / d[:, :, None] / d[:, None, :] + (damping + _RIDGE) * np.eye(n_x)
    right = np.concatenate([H[:, :, n_x:], g[:, :, None]], axis=2)
    following = np.linalg.solve(scaled, right[:, :n_x] / d[:, :, None]) / d[:, :, None]
    return right[:, n_x:] - H[:, n_x:, :n_x] @ following, following


def _lanes(segments: Segments, parameters: FloatArray, states: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Parameters and states of the lanes of one batch, from those that all segments share, and ``(K, n_x)``."""
    return np.repeat(parameters[None, None], len(segments), axis=1), states[None]


def _errors(segments: Segments, parameters: FloatArray, states: FloatArray) -> FloatArray:
    """Simulated less measured samples ``(K n_rows, n_s)``; arguments as of `_lanes`."""
    errors = segments.errors(*_lanes(segments, parameters, states))[0]
    return np.asarray(errors.reshape(-1, len(segments.columns)))


def _with_priors(intervals: ShootingIntervals, p: FloatArray, parts: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Matrix and gradient of the parameters, of segments' parts ``(K, n, n + 1)`` and of priors."""
    precision, total = 1.0 / np.square(intervals.layout.prior_std), parts.sum(axis=0)
    away = np.where(precision > 0.0, p - intervals.layout.prior_mean, 0.0)
    return total[:, :-1] + np.diag(precision), total[:, -1] + precision * away


def _solved(matrix: FloatArray, gradient: FloatArray, damping: float) -> FloatArray:
    """Solution of damped normal equations in columns of unit size; least squares where they are singular."""
    d = np.sqrt(np.maximum(np.diag(matrix), 0.0)) + _TINY
    scaled = matrix / d[:, None] / d[None, :] + (damping + _RIDGE) * np.eye(len(matrix))
    return np.asarray(np.linalg.lstsq(scaled, gradient / d, rcond=None)[0] / d)


def _moved(intervals: ShootingIntervals, now: FloatArray, step: FloatArray) -> FloatArray:
    """Parameters after a step within the bounds; a positive one changes by a factor of two at most."""
    bounds = intervals.layout.bounds
    positive = np.array([x.positive for x in bounds])
    lower, upper = np.array([[x.lower, x.upper] for x in bounds]).T
    then = np.clip(now + step, lower, upper)
    return np.where(positive, np.clip(then, 0.5 * now, 2.0 * now), then)
