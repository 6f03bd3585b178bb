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
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.core.equations import linearize, without_windows
from diransac.identification.core.fit import Fit, weights_of, with_residuals
from diransac.identification.core.minimise import HOPELESS, SIGMA_FLOOR, SegmentsApart, minimise
from diransac.identification.core.noise import Mixture, lower_scale
from diransac.identification.core.theta import bounded
from diransac.identification.estimate import LogEstimate
from diransac.identification.methods.lo_diransac.segments import (
    ActingInputs,
    Segments,
    inlying_samples,
    prior_states,
    stretches,
    whole_stretches,
)
from diransac.identification.methods.lo_diransac.sources import Blocks, Candidate, jackknife
from diransac.identification.structure.equivalents import is_close

if TYPE_CHECKING:
    from diransac.arrays import IntArray
    from diransac.identification.core.windows import Windows
    from diransac.identification.methods.lo_diransac.smoothing import Motion

_SHORTEST = 8
"""Least rows of the shortest segments."""
_GROWTH = 3
"""Factor by which segments grow, up to the length of a block."""
_FEW = 16
"""Number of random starts, and of segments on which all starts are scored."""
_FOLLOWED = 2
"""Number of starts that are followed."""
_ROWS_OF_SEARCH = 3_000
"""Largest number of rows of fits from several starts."""
_MOST_ROWS = 50_000
"""Largest number of rows of other fits."""
_STEPS = 25
"""Largest number of steps."""
_FEW_STEPS = 3
"""Steps of a solution that is close to another."""
_AS_LIKELY = 5.0
"""Difference of log-likelihoods, nats, below which two estimates are as likely."""
_SIMULATED = 0.5
"""Robust scale of the errors over the spread of a signal, up to which a simulation follows it."""
_RIDGE = 1e-10
"""Part of the largest singular value below which a direction of the parameters is undetermined."""
_TINY = 1e-150
"""A parameter's unit where it has no effect."""


def simulation_error_candidates(
    intervals: Windows,
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
    intervals : Windows
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
    others = [last.with_inputs(x).descended(rival=last.loss) for x in actings if x is not taken]
    hopeless = last.cost + HOPELESS * np.count_nonzero(last.windows.known)
    found = [*(x for x in others if x.cost < hopeless), *chain[1:]]
    return [(x.candidate(blocks), x.simulated) for x in reversed(found)]


def explains_as_well(
    intervals: Windows,
    motion: Motion,
    acting: ActingInputs,
    parameters: FloatArray,
    other: FloatArray,
    *,
    exact: bool,
    outliers: bool = True,
) -> bool:
    """True if other parameters simulate whole logs as well, and stay apart from given ones in a fit.

    Where the model is not exact, what it lacks does not tell estimates apart whose errors differ by a tenth.

    Parameters
    ----------
    intervals : Windows
    motion : Motion
        From which states start that nothing measures.
    acting : ActingInputs
    parameters, other : (n,) array
    exact : bool
        Whether the model is.
    outliers : bool, optional
        Whether samples may be outliers.
    """
    length = min((x.stop - x.start for x in whole_stretches(intervals)), default=0)
    segments = _segments(intervals, acting, min(length, _MOST_ROWS), _MOST_ROWS)
    if not len(segments):
        return False
    noise = _first_noise(segments, motion.spread, outliers=outliers)
    own, found = (_Solution.begin(segments, motion, p, noise).descended() for p in (parameters, other))
    worse = _AS_LIKELY if exact else HOPELESS * np.count_nonzero(own.windows.known)
    return found.loss < own.loss + worse and not is_close(found.parameters, own.parameters).all()


def _lengths(intervals: Windows, blocks: Blocks) -> list[int]:
    """Rows of the segments: those of a block, a third of them, and so on, the shortest first."""
    block = int(intervals.counted.sum()) // (1 + np.count_nonzero(np.diff(blocks.of_row)))
    longest = int(np.clip(block, 1, max((int(x.stop - x.start) for x in stretches(intervals)), default=1)))
    n = max(0, int(np.log(longest / _SHORTEST) / np.log(_GROWTH)))
    return [max(_SHORTEST, longest // _GROWTH**k) for k in range(n, -1, -1)]


def _whole_lengths(intervals: Windows, block: int) -> list[int]:
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


def _random_starts(intervals: Windows, known: FloatArray, seed: int) -> FloatArray:
    """Parameters within a decade of known ones, log-uniform; within the bounds where both are given."""
    bounds = intervals.layout.bounds
    lower, upper = np.array([[x.lower, x.upper] for x in bounds]).T
    both, found = np.isfinite(lower) & np.isfinite(upper), []
    for k in range(_FEW):
        rng = np.random.default_rng([abs(seed), int(seed < 0), k])
        about = known[k % len(known)] * 10.0 ** rng.uniform(-1.0, 1.0, len(bounds))
        inside = rng.uniform(np.where(both, lower, 0.0), np.where(both, upper, 1.0))
        found.append(np.clip(np.where(both, inside, about), lower, upper))
    return np.array(found)


def _segments(intervals: Windows, acting: ActingInputs, length: int, most_rows: int) -> Segments:
    """Segments one after another in all stretches; every k-th one where there are too many rows."""
    parts = [np.arange(x.start, x.stop - length + 1, length) for x in stretches(intervals)]
    starts = np.concatenate([np.arange(0), *parts])
    return Segments(intervals, acting, starts[:: max(1, -(-len(starts) * length // most_rows))], length)


def _from_starts(
    intervals: Windows,
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
    intervals = segments.intervals
    low = np.where(intervals.sampled, intervals.measured, np.inf).min(axis=0)
    high = np.where(intervals.sampled, intervals.measured, -np.inf).max(axis=0)
    span, columns = np.where(high > low, high - low, 1.0), set(segments.columns.tolist())
    whole = [four for four in intervals.model.quaternions if columns.issuperset(four)]
    return Mixture(0.1 * spread, np.full(len(spread), 0.1 * outliers), span, SIGMA_FLOOR * spread, whole)


def _scores(segments: Segments, motion: Motion, starts: FloatArray, noise: Mixture) -> FloatArray:
    """Sum ``(m,)`` over signals of the logarithm of a robust scale of the errors over a few segments."""
    few = replace(segments, starts=segments.starts[:: max(1, len(segments) // _FEW)])
    lanes = np.repeat(starts[:, None], len(few), axis=1)
    errors = few.errors(lanes, _first_states(few, motion, lanes, noise)[0])
    known = few.known.reshape(-1, errors.shape[3])
    scale = lower_scale(errors.reshape(len(starts), *known.shape), known)
    return np.asarray(np.log(np.nan_to_num(scale) + noise.floor[few.columns]).sum(axis=1))


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
    weights = segments.weights(counted / np.square(noise.sigma[segments.columns]))
    return segments.estimated_states(lanes, states, spread, weights), mean, spread


@dataclass(frozen=True, eq=False, repr=False)
class _Solution:
    """Parameters with the initial states of all segments: a fit of windows that nothing ties.

    Parameters
    ----------
    segments : Segments
    motion : Motion
        Smoothed.
    windows : Windows
        The segments.
    fit : Fit
    """

    segments: Segments
    motion: Motion
    windows: Windows
    fit: Fit

    @classmethod
    def begin(cls, segments: Segments, motion: Motion, parameters: FloatArray, noise: Mixture) -> _Solution:
        """The solution with states that agree best with the samples of their segments."""
        lanes, layout = np.repeat(parameters[None, None], len(segments), axis=1), segments.intervals.layout
        states, mean, std = _first_states(segments, motion, lanes, noise)
        windows, nothing, x = _windows(segments), np.zeros(0), states[0]
        fit = Fit(
            parameters, x, np.zeros((len(x), 0)), nothing, nothing, noise, nothing, nothing, np.ones(x.shape[1]),
            layout.prior_std, layout.prior_mean, x_mean=mean, x_std=std,
        )  # fmt: skip
        return cls(segments, motion, windows, with_residuals(windows, fit))

    @property
    def parameters(self) -> FloatArray:
        """Parameters ``(n,)``."""
        return self.fit.shared

    @cached_property
    def _losses(self) -> FloatArray:
        """Negative log-likelihood ``(K,)`` of the samples of each segment."""
        losses = self.fit.noise.negative_log_likelihood(self.fit.residuals, self.windows.known)
        return np.asarray(losses.reshape(len(self.windows), -1).sum(axis=1))

    @property
    def loss(self) -> float:
        """Negative log-likelihood of all samples."""
        return float(self._losses.sum())

    @cached_property
    def cost(self) -> float:
        """Negative logarithm of the probability of samples and states."""
        away = (self.fit.x - self.fit.x_mean) / self.fit.x_std
        return self.loss + 0.5 * float(np.square(away).sum())

    def likelier(self, other: _Solution) -> _Solution:
        """The likelier of this solution and another one, after its descent."""
        found = other.descended(rival=self.loss)
        return found if found.cost < self.cost else self

    def descended(self, limit: int = _STEPS, rival: float = np.inf) -> _Solution:
        """The solution after some steps, each with an update of the noise (EM); a rival as of `minimise`.

        It stays as it is where squares of its derivatives overflow.
        """
        schedule = SegmentsApart(outliers=bool(self.fit.noise.pi.any()))
        with suppress(np.linalg.LinAlgError):
            return replace(self, fit=minimise(self.windows, self.fit, schedule, limit, rival).fit)
        return self

    def grown(self, length: int) -> _Solution:
        """The solution over all segments of a length, of which states and noise are their own."""
        longer = _segments(self.segments.intervals, self.segments.acting, length, _MOST_ROWS)
        found, noise = _Solution.begin(longer, self.motion, self.parameters, self.fit.noise), self.fit.noise
        scale = np.nan_to_num(lower_scale(found.fit.residuals, found.windows.known), nan=1.0)
        noise = replace(noise, sigma=np.maximum(scale, noise.floor))
        return replace(found, fit=replace(found.fit, noise=noise))

    @property
    def is_simulated(self) -> bool:
        """True if the errors are clearly less than the spread of their signals: the simulation is not lost."""
        columns = self.segments.columns
        return bool((self.fit.noise.sigma < _SIMULATED * self.motion.spread)[columns].all())

    def with_inputs(self, acting: ActingInputs) -> _Solution:
        """The solution with inputs that act otherwise, at the same parameters and states."""
        segments = replace(self.segments, acting=acting)
        windows = _windows(segments)
        return replace(self, segments=segments, windows=windows, fit=with_residuals(windows, self.fit))

    def candidate(self, blocks: Blocks) -> Candidate:
        """The estimate, and what it is without each block by one Newton step."""
        segments, intervals = self.segments, self.segments.intervals
        without = np.array([bounded(intervals, self.parameters, self.parameters + x) for x in self._steps(blocks)])
        name = f"simulation error, {segments.n_rows * intervals.dt:.2g} s, {segments.acting.sentence}"
        return Candidate(name, self.parameters, without, segments.acting, intervals)

    def _steps(self, blocks: Blocks) -> Iterator[FloatArray]:
        """Newton steps ``(n,)`` of the parameters without each block: its segments, or its rows of longer ones."""
        of_row, segments, windows, weights = blocks.of_row, self.segments, self.windows, self._weights
        if segments.n_rows > np.bincount(of_row, minlength=blocks.n).min():
            own = of_row[segments.rows.ravel()]
            for k in range(blocks.n):
                at = linearize(windows, self.fit, np.where((own != k)[:, None], weights, 0.0))
                yield at.system.solve(at.right_z, at.right_s).step_p
            return
        parts, prior = without_windows(windows, self.fit, linearize(windows, self.fit, weights))
        for k in range(blocks.n):
            left = parts[self._block(blocks) != k].sum(axis=0) + prior
            yield _solved(left[:, :-1], left[:, -1])

    @property
    def _weights(self) -> FloatArray:
        return weights_of(self.windows, self.fit)

    def _block(self, blocks: Blocks) -> IntArray:
        """Block ``(K,)`` of the middle of each segment."""
        return blocks.of_row[self.segments.starts + self.segments.n_rows // 2]

    def standard_errors(self, blocks: Blocks) -> FloatArray:
        """Standard errors ``(n,)`` of the parameters, by the jackknife over blocks; those by white noise at least."""
        at = linearize(self.windows, self.fit, self._weights)
        white = np.diag(at.system.solve(at.right_z, at.right_s).var_p)
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
        return tried[at], at, float(np.sqrt(1.0 / 12.0 + jackknife(np.clip(vertex, -1.0, 1.0)[:, None])[0, 0]))

    def costs_without(self, blocks: Blocks) -> FloatArray:
        """Negative log-likelihood of the samples without each block."""
        block = self._block(blocks)
        return np.array([self._losses[block != k].sum() for k in range(blocks.n)])

    @property
    def simulated(self) -> Motion:
        """The motion of the segments; the smoothed one in rows that none covers."""
        fit, windows, signals = self.fit, self.windows, self.motion.signals.copy()
        series = windows.rollouts.trajectories(windows.batch(fit.shared, fit.x, fit.d))
        finite = np.isfinite(series).all(axis=(1, 2))
        signals[self.segments.rows[finite]] = series[finite]
        return replace(self.motion, signals=signals)


def _windows(segments: Segments) -> Windows:
    """The segments as windows that nothing ties."""
    acting = segments.acting
    return segments.intervals.parts_apart(acting.values, acting.hold, segments.starts, segments.n_rows)


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solution of normal equations in columns of unit size; least squares where they are singular."""
    d = np.sqrt(np.maximum(np.diag(matrix), 0.0)) + _TINY
    return np.asarray(np.linalg.lstsq(matrix / np.outer(d, d), right / d, rcond=_RIDGE)[0] / d)
