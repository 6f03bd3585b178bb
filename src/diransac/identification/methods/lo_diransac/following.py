"""States of a machine that only a simulator knows, followed from interval to interval, with their sensitivities.

Contacts settle as they do in the simulator, and what nothing measures, such as the pose of a base that walks, follows
from all sensors.  With the parameters at p, a state is ``x = m + M (p' - p) + e`` for other parameters p', with a
covariance of e: a Kalman filter that carries the sensitivity M of its mean.  The samples of an interval contribute to
the gradient and to the information of the parameters, as those of the joint fit do after its states are eliminated.

References
----------
Gupta, Mehra 1974 (sensitivities of the filter); Bierman 1977 (square-root information).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray, robust_std
from diransac.data.input_timing import acting_inputs
from diransac.identification.core.noise import Mixture
from diransac.identification.methods.lo_diransac.interval_effects import batch_sums
from diransac.identification.methods.lo_diransac.linear_intervals import (
    RADIUS,
    TINY,
    Belief,
    LinearInterval,
    Update,
)
from diransac.simulation import Measurements, RolloutBatch, default_threads, rollouts
from diransac.time_limit import check_time

if TYPE_CHECKING:
    from diransac.identification.core.windows import ShootingIntervals
    from diransac.simulation.mujoco import MujocoRollouts

_FIRST = 5
"""Samples of which the median is a first state."""
_UNSURE = {"m": 0.05, "rad": 0.3, "1": 0.05}
"""Standard deviation at the start of coordinates that nothing measures; of velocities, in a second, ten times that."""
_LACKS = 0.3
"""Change of a velocity in an interval that the model lacks at first, of the change that it predicts."""
_SMALL = 1e-3
"""Least change of a velocity of which the model lacks a part, over its size."""
_FIRST_NOISE, _LEAST_NOISE = 3.0, 1e-3
"""Noise of a signal before anything is fitted, over that of its bends; at least, over its spread."""
_LOST = 1e4
_FOLLOWED = 0.5
"""Part of the samples that must agree: if fewer do in two intervals, the motion begins anew with the samples."""
_LEFT = 4.0
"""Mean variance that slopes over the spread leave, over that of the noise, at most."""
_SHARES = (1.0, 0.25, 0.06, 0.015, 0.004)
"""Weights of an interval's samples that are tried."""
_TOLD = 0.3
"""Part of the variance of a velocity that samples must take away to tell what the model lacks."""
_BEGINNING = 8
"""Intervals after the beginning of a log, or a gap, in which what changes a state is the beginning's."""
_INFLUENCE, _ROUNDS = 5.0, 20
"""Influence of an interval on all parameters at most, over the mean of all; rounds until the weights are known."""
_DELAY_STEP = 1e-6
"""Difference of a delay, samples: a wider one meets contacts that begin a step later, which tell nothing of it."""


@dataclass(frozen=True)
class Pass:
    """Predictions of all intervals with one set of parameters.

    Parameters
    ----------
    losses, lost : (W,) array
        Negative log-likelihood of the predicted samples of each interval; that of intervals in which simulations
        diverge, 0 of others.
    scores : (W, n) array
        Contribution of each interval to minus the gradient of the loss with respect to the parameters, the delay of
        the inputs last if it is estimated; with bounded influence, and less where all samples are wrong.
    information : (n, n) array
    states : (W, n_x) array
        At the intervals' starts, after their samples.
    jumps : (W, n_x) array
        From the ends of the intervals before; 0 where nothing is before.
    residuals : (N, n_s) array
        Simulated from these states less measured.
    surprise : float
        Mean square of the changes of velocities by samples, over what the filter expects.
    errors, expected : (N, n_s) array
        Predicted less measured, and the variance of the prediction.
    """

    losses: FloatArray
    lost: FloatArray
    scores: FloatArray
    information: FloatArray
    states: FloatArray
    jumps: FloatArray
    residuals: FloatArray
    surprise: float
    errors: FloatArray
    expected: FloatArray

    def losses_with(self, noise: Mixture, known: BoolArray) -> FloatArray:
        """The losses ``(W,)`` with another noise, and states as uncertain as they were."""
        wide = np.sqrt(1.0 + self.expected / np.square(noise.sigma))
        own = noise.negative_log_likelihood(self.errors / wide, known) + known * np.log(wide)
        return np.asarray(own.reshape(len(self.lost), -1).sum(axis=1) + self.lost)

    def step(
        self, precision: FloatArray, pull: FloatArray, bounds: tuple[FloatArray, FloatArray] | None = None
    ) -> FloatArray:
        """Gauss-Newton step ``(n,)`` with priors, within bounds of it; 0 where the logs tell nothing.

        The other parameters follow those that stay at a bound.
        """
        information, right = self.information + np.diag(precision), self.scores.sum(axis=0) + pull
        step, free = np.zeros(len(right)), np.ones(len(right), bool)
        for _ in range(len(right)):
            left = right[free] - information[np.ix_(free, ~free)] @ step[~free]
            step[free] = _inverse(information[np.ix_(free, free)]) @ left
            if bounds is None:
                break
            held = np.clip(step, *bounds)
            beyond = free & (held != step)
            if not beyond.any():
                break
            worst = np.argmax(np.where(beyond, np.abs(step - held) / (bounds[1] - bounds[0] + TINY), -1.0))
            step[worst], free[worst] = held[worst], False
        return step

    def covariance(self, precision: FloatArray) -> FloatArray:
        """Covariance ``(n, n)`` by the noise; 0 of what the logs tell nothing of."""
        return _inverse(self.information + np.diag(precision))

    def robust_covariance(self, precision: FloatArray) -> FloatArray:
        """Covariance ``(n, n)``, larger where scores of neighbouring intervals scatter more than by white noise.

        References
        ----------
        Huber 1967, by batches.
        """
        white = self.covariance(precision)
        scatter = np.square(batch_sums(self.scores @ white)).sum(axis=0)
        more = np.sqrt(np.maximum(1.0, scatter / (np.diag(white) + TINY**2)))
        return np.asarray(white * np.outer(more, more))


def _inverse(information: FloatArray) -> FloatArray:
    """Inverse in columns of unit size; 0 of what there is no information about."""
    d = np.sqrt(np.maximum(np.diag(information), 0.0))
    scale = np.divide(1.0, d, out=np.zeros_like(d), where=d > TINY)
    return np.asarray(scale[:, None] * np.linalg.pinv(information * np.outer(scale, scale), 1e-10, True) * scale)


def bounded_influence(information: FloatArray) -> FloatArray:
    """Weights ``(W,)`` with which no interval tells more than a few times its share of all parameters.

    Where a contact is about to begin or to slip, slopes hold in a tiny range alone: they are so steep that one interval
    would outweigh all others.

    Parameters
    ----------
    information : (W, n, n) array

    References
    ----------
    Krasker, Welsch 1982 (bounded influence).
    """
    n, telling = information.shape[1], np.count_nonzero(information.any(axis=(1, 2)))
    weights, most = np.ones(len(information)), _INFLUENCE * n / max(telling, 1)
    for _ in range(_ROUNDS):
        covariance = _inverse(np.einsum("w,wij->ij", weights, information))
        told = np.einsum("ij,wji->w", covariance, information)
        weights = np.minimum(1.0, most / np.maximum(told, TINY))
    return weights


@dataclass(frozen=True)
class Predictor:
    """Passes over the intervals of some logs.

    Parameters
    ----------
    intervals : ShootingIntervals
    noise : Mixture
    lacks : float
        Change of a velocity in an interval that the model lacks, of the change that it predicts.
    delay : float
        Of the inputs, samples.
    free_delay : bool
        Whether it is estimated.
    spread : (n, n) array, optional
        Covariance of the parameters, and of the delay, over which slopes are taken, those of states over their own;
        None: local ones.
    """

    intervals: ShootingIntervals
    noise: Mixture
    lacks: float = _LACKS
    delay: float = 0.0
    free_delay: bool = True
    spread: FloatArray | None = None

    @classmethod
    def of(cls, intervals: ShootingIntervals, *, outliers: bool, free_delay: bool) -> Predictor:
        """A predictor with noise by the bends of each signal."""
        n = len(intervals.model.signals)
        spread, noise = np.ones(n), np.ones(n)
        low, high = np.zeros(n), np.ones(n)
        seen: BoolArray = np.asarray(intervals.known.any(axis=0))
        for j in np.flatnonzero(seen):
            y = intervals.measured[intervals.known[:, j], j]
            low[j], high[j] = y.min(), max(y.max(), y.min() + TINY)
            spread[j] = float(robust_std(y - np.median(y))) or np.ptp(y) or 1.0
            bends = float(robust_std(np.diff(y, 2))) if len(y) > _FIRST else 0.0
            noise[j] = max(_FIRST_NOISE * bends / np.sqrt(6.0), 10.0 * _LEAST_NOISE * spread[j], TINY)
        pi = np.full(n, 0.1 if outliers else 0.0)
        floor = np.maximum(1e-2 * _LEAST_NOISE * spread, TINY)
        whole = [four for four in intervals.model.quaternions if seen[list(four)].all()]
        for four in whole:
            noise[list(four)], floor[list(four)] = noise[list(four)].max(), floor[list(four)].max()
        return cls(intervals, Mixture(noise, pi, high - low, floor, whole), free_delay=free_delay)

    @cached_property
    def columns(self) -> IntArray:
        """Signals that the logs have."""
        return np.flatnonzero(self.intervals.sampled.any(axis=0))

    @cached_property
    def _simulator(self) -> MujocoRollouts:
        from diransac.simulation.mujoco import MujocoRollouts

        model = self.intervals.model
        found = rollouts(model, [model.signals[k] for k in self.columns], hold=self.intervals.hold)
        assert isinstance(found, MujocoRollouts)
        return found

    @cached_property
    def _measurements(self) -> Measurements:
        values = np.ascontiguousarray(self.intervals.measured[:, self.columns])
        return Measurements(values, np.ones(len(values), bool))

    def acting(self, delay: float) -> FloatArray:
        """Inputs ``(N, n_u)`` after a delay, samples."""
        one = self.intervals
        late, none = np.full(one.recorded.shape[1], delay), np.zeros(one.recorded.shape[1])
        parts = [
            acting_inputs(one.recorded[rows], late, none, none, one.hold, int(one.is_logged[rows].sum()))
            for rows in one.rows_of_logs
        ]
        return np.concatenate(parts)

    @cached_property
    def unsure(self) -> FloatArray:
        """Standard deviation ``(n_x,)`` of the first state."""
        model, n_x = self.intervals.model, self.intervals.model.n_q + self.intervals.model.n_v
        units = [*model.coordinates.values(), *(x.partition("/")[0] for x in model.velocities.values())]
        unsure = np.array([_UNSURE.get(x, 0.3) for x in units])
        unsure[model.n_q :] *= 10.0
        seen: BoolArray = np.asarray(self.intervals.known.any(axis=0))
        driven = np.isin(model.state, list(model.first_order))
        unsure[driven] = np.maximum(unsure[driven], np.ptp(self.intervals.recorded, axis=0).max(initial=0.0))
        return np.where(seen[:n_x], np.minimum(self.noise.sigma[:n_x] + 0.03 * unsure, unsure), unsure)

    def first_state(self, w: int, rest: FloatArray) -> FloatArray:
        """State at an interval's start: medians of the first samples, of what nothing measures the rest."""
        state, rows = rest.copy(), self.intervals.starts[w] + np.arange(self.intervals.length)
        for j in range(len(state)):
            known = rows[self.intervals.known[rows, j]][:_FIRST]
            if len(known):
                state[j] = np.median(self.intervals.measured[known, j])
        return state

    def over_logs(self, p: FloatArray) -> Pass:
        """Predictions with parameters ``(n_p,)``."""
        one, home = self.intervals, self.intervals.model.home
        run = _Run(self, p) if self.spread is None else _SpreadRun(self, p)
        state, belief = self.first_state(0, home), Belief.begin(self.unsure, run.n)
        for w in range(len(one)):
            if w and (run.is_lost or not one.following[w]):
                rest = home if one.log_of[w] != one.log_of[w - 1] else state
                state, belief = self.first_state(w, rest), Belief.begin(self.unsure, run.n)
            state, belief = run.interval(w, state, belief)
        return run.result()

    def trajectories(self, p: FloatArray, states: FloatArray) -> FloatArray:
        """All signals ``(N, n_signals)`` of the intervals from states ``(W, n_x)`` at their starts."""
        one = self.intervals
        parameters = np.broadcast_to(one.parameters_of(p, one.log_of), (len(one), one.model.n_p))
        lanes = (one.dt, one.starts, one.length, one.first_of_log)
        batch = RolloutBatch(parameters, states, self.acting(self.delay), *lanes)
        return self._simulator.trajectories(batch, threads=one.threads).reshape(len(one.measured), -1)


class _Run:
    """One pass, with local slopes."""

    def __init__(self, predictor: Predictor, p: FloatArray) -> None:
        self.predictor, self.p, self.inputs = predictor, p, predictor.acting(predictor.delay)
        one = predictor.intervals
        self.n = len(p) + predictor.free_delay
        self.states = np.empty((len(one), one.model.n_q + one.model.n_v))
        self.jumps, self.scores = np.zeros_like(self.states), np.zeros((len(one), self.n))
        self.information, self.losses, self.lost = np.zeros((len(one), self.n, self.n)), *np.zeros((2, len(one)))
        self.residuals, self.errors, self.expected = np.zeros((3, *one.measured.shape))
        self.surprise, self.age, self.is_lost = list[FloatArray](), 0, False
        self.contradicts = np.zeros(1, bool)
        self.threads = one.threads if one.threads > 1 else default_threads()

    def result(self) -> Pass:
        """Sums of all intervals."""
        surprise = float(np.mean(self.surprise)) if self.surprise else 1.0
        weights = bounded_influence(self.information)
        scores = weights[:, None] * self.scores
        information = np.einsum("w,wij->ij", weights, self.information)
        kept = (self.states, self.jumps, self.residuals, surprise, self.errors, self.expected)
        return Pass(self.losses + self.lost, self.lost, scores, information, *kept)

    def batch(self, w: int, state: FloatArray, inputs: FloatArray) -> RolloutBatch:
        """One lane over an interval."""
        one = self.predictor.intervals
        parameters = np.atleast_2d(one.parameters_of(self.p, one.log_of[w : w + 1]))
        return RolloutBatch(
            parameters, state[None], inputs, one.dt, one.starts[w : w + 1], one.length, one.first_of_log
        )

    @cached_property
    def later(self) -> FloatArray:
        """Inputs with a delay that is a little longer."""
        return self.predictor.acting(self.predictor.delay + _DELAY_STEP)

    def linear(self, w: int, state: FloatArray, belief: Belief) -> LinearInterval | None:
        """An interval's samples and end by slopes with respect to state, parameters and delay; None: it diverges."""
        predictor, model = self.predictor, self.predictor.intervals.model
        simulator, measurements = predictor._simulator, predictor._measurements
        names, now = (*model.state, *model.parameters), self.batch(w, state, self.inputs)
        found = simulator.linearized_errors(now, measurements, unknowns=names, threads=self.threads)
        assert found.final_states is not None
        assert found.final_slopes is not None
        e, J, end, F = found.errors[0], found.jacobian[0], found.final_states[0], found.final_slopes[0]
        if predictor.free_delay:
            late, late_end = simulator.errors_and_ends(self.batch(w, state, self.later), measurements, threads=1)
            J = np.concatenate([J, ((late[0] - e) / _DELAY_STEP)[..., None]], axis=2)
            F = np.column_stack([F, (late_end[0] - end) / _DELAY_STEP])
        if not (np.isfinite(J).all() and np.isfinite(F).all() and np.abs(end).max() < _LOST):
            return None
        return LinearInterval.local(belief, model.n_q, (e, J), (end, F))

    def interval(self, w: int, state: FloatArray, belief: Belief) -> tuple[FloatArray, Belief]:
        """State and belief at the end of an interval, after its samples."""
        check_time()
        one, columns = self.predictor.intervals, self.predictor.columns
        rows = slice(int(one.starts[w]), int(one.starts[w]) + one.length)
        known = one.known[rows][:, columns]
        linear = self.linear(w, state, belief)
        self.is_lost = linear is None
        if linear is None:
            self.states[w], self.lost[w] = state, 10.0 * float(known.sum())
            return state, belief
        noise, e, expected = self._noise, linear.errors, linear.variance
        wide = np.sqrt(1.0 + expected / np.square(noise.sigma))
        inlying = noise.inlying(e / wide, known)
        weights, n_samples = inlying / np.square(noise.sigma), float(inlying.sum())
        before = self.contradicts & bool(one.following[w])
        self.contradicts = self.contradicting(inlying, known)
        self.is_lost = bool((self.contradicts & before).any())
        self.losses[w] = float((noise.negative_log_likelihood(e / wide, known) + known * np.log(wide)).sum())
        update = self.updated(w, state, belief, linear, weights)
        self._count(w, update, belief, n_samples)
        self.states[w] = state + update.moved
        self.errors[rows, columns] = np.where(known, e, 0.0)
        self.expected[rows, columns] = expected
        self.residuals[rows, columns] = np.where(known, update.residuals, 0.0)
        self.is_lost |= bool(np.abs(update.end).max() > _LOST)
        return update.end, self._lacking(w, update, linear)

    def contradicting(self, inlying: FloatArray, known: BoolArray) -> BoolArray:
        """Mask of signals of which too few samples agree; all of them if too few of all do.

        An update may lose a state alone.  It counts if it was followed, is not an outlier mostly, and if all
        coordinates are measured, so that nothing is forgotten.
        """
        columns, n_q = self.predictor.columns, self.predictor.intervals.model.n_q
        few = inlying.sum(axis=0) < _FOLLOWED * known.sum(axis=0)
        alone = (columns < self.states.shape[1]) & (self._noise.pi <= _FOLLOWED) & (np.sum(columns < n_q) == n_q)
        return np.asarray((few & alone & (self.age >= _BEGINNING)) | (inlying.sum() < _FOLLOWED * known.sum()))

    def updated(self, w: int, state: FloatArray, belief: Belief, linear: LinearInterval, weights: FloatArray) -> Update:
        """Update by an interval's samples with as much weight as their linear model deserves.

        Where a contact changes, a full step may lead to a motion that agrees less.  The end is simulated.
        """
        predictor, known = self.predictor, weights > 0.0
        before = float((weights * np.square(linear.errors)).sum())
        for share in _SHARES:
            update = Update.of(belief, linear, share * weights)
            found, ends = predictor._simulator.errors_and_ends(
                self.batch(w, state + update.moved, self.inputs), predictor._measurements, threads=1
            )
            after = float(np.where(known, weights * np.square(found[0]), 0.0).sum())
            if np.abs(ends[0]).max() < _LOST and share * after + update.prior <= share * before * (1.0 + TINY):
                nonlinear = np.diag(np.square(ends[0] - update.end))
                wider = replace(update.belief_of_end, covariance=update.belief_of_end.covariance + nonlinear)
                return replace(update, end=ends[0], belief_of_end=wider)
        return Update.of(belief, linear, 0.0 * weights)

    def _count(self, w: int, update: Update, belief: Belief, n_samples: float) -> None:
        """Add an interval's contributions."""
        n_q = self.predictor.intervals.model.n_q
        self.age = self.age + 1 if self.predictor.intervals.following[w] and not self.is_lost else 0
        share = update.share(n_samples)
        self.information[w] = share * update.information
        self.scores[w] = share * update.score
        if self.age < _BEGINNING:
            return
        self.jumps[w] = update.moved
        own = np.diag(belief.covariance)[n_q:]
        less = own - np.diag(update.belief.covariance)[n_q:]
        told = less > _TOLD * own
        if told.any():
            self.surprise.append(np.clip(np.square(update.moved[n_q:][told]) / less[told], 0.0, 9.0).mean())

    @cached_property
    def _noise(self) -> Mixture:
        noise, k = self.predictor.noise, self.predictor.columns
        return Mixture(noise.sigma[k], noise.pi[k], noise.span[k], noise.floor[k])

    def _lacking(self, w: int, update: Update, linear: LinearInterval) -> Belief:
        """Belief of the state at the end of an interval, with what the model lacks."""
        predictor, n_q, n_x = self.predictor, self.predictor.intervals.model.n_q, len(update.end)
        change = np.abs(update.end - self.states[w])
        lacks = predictor.lacks * (change + _SMALL * predictor.unsure)[n_q:]
        # A change of velocity on the way moves coordinates by half of what one at the start does.
        effect = np.vstack([0.5 * linear.end_of_velocities[:n_q], np.eye(n_x - n_q)])
        covariance = update.belief_of_end.covariance + (effect * np.square(lacks)) @ effect.T
        return Belief(0.5 * (covariance + covariance.T), update.belief_of_end.slopes)


class _SpreadRun(_Run):
    """One pass, with slopes over the spread of the states and of the parameters."""

    @cached_property
    def root(self) -> FloatArray:
        """Root ``(n, n)`` of the covariance of the parameters, and of the delay, which is uncorrelated."""
        spread, n = self.predictor.spread, len(self.p)
        assert spread is not None
        root = np.diag(np.sqrt(np.diag(spread)))
        root[:n, :n] = np.linalg.cholesky(spread[:n, :n])
        return np.asarray(root)

    @cached_property
    def recordings(self) -> tuple[FloatArray, Measurements, IntArray]:
        """Inputs, measurements and first rows of logs, one after another: the delay, a longer and a shorter one."""
        predictor, reach = self.predictor, RADIUS * self.root[-1, -1]
        delays = (0.0, reach, -reach) if predictor.free_delay else (0.0,)
        inputs = np.concatenate([predictor.acting(predictor.delay + x) for x in delays])
        measured = np.tile(predictor._measurements.values, (len(delays), 1))
        firsts = [predictor.intervals.first_of_log + k * len(self.inputs) for k in range(len(delays))]
        return inputs, Measurements(measured, np.ones(len(measured), bool)), np.concatenate(firsts)

    def linear(self, w: int, state: FloatArray, belief: Belief) -> LinearInterval | None:
        """An interval's samples and end by differences over the spread; by local slopes where it is too wide."""
        predictor, one, points = self.predictor, self.predictor.intervals, belief.points(self.root)
        n_x, n = len(state), len(state) + len(self.p)
        lower, upper = np.array([(x.lower, x.upper) for x in one.layout.bounds]).T
        values = np.clip(self.p + points[:, n_x:n], lower, upper)
        within = values - self.p - points[:, n_x:n]
        points += np.hstack([within @ belief.slopes[:, : len(self.p)].T, within, np.zeros_like(points[:, n:])])
        above, below = np.split(points[1:], 2)
        root = (above - below)[n_x:, n_x:].T / (2.0 * RADIUS)
        parameters = np.concatenate([np.atleast_2d(one.parameters_of(x, one.log_of[w : w + 1])) for x in values])
        inputs, measurements, firsts = self.recordings
        is_later, is_earlier = (points[:, n:] > 0.0).any(axis=1), (points[:, n:] < 0.0).any(axis=1)
        rows = one.starts[w] + len(self.inputs) * (is_later + 2 * is_earlier)
        batch = RolloutBatch(parameters, state + points[:, :n_x], inputs, one.dt, rows, one.length, firsts)
        errors, ends = predictor._simulator.errors_and_ends(batch, measurements, threads=self.threads)
        if np.isfinite(errors).all() and np.isfinite(ends).all():
            linear = LinearInterval.over_spread(belief, one.model.n_q, root, errors, ends)
            if self._holds(w, linear):
                return linear
        return super().linear(w, state, belief)

    def _holds(self, w: int, linear: LinearInterval) -> bool:
        """True unless the state may be anywhere, so that what slopes leave is far more than the noise."""
        one = self.predictor.intervals
        known = one.known[one.starts[w] : one.starts[w] + one.length][:, self.predictor.columns]
        left = np.square(linear.left / self._noise.sigma[:, None]).sum(axis=-1)
        return bool((left * known).sum() <= _LEFT * known.sum() and np.abs(linear.end).max() < _LOST)

    def updated(self, w: int, state: FloatArray, belief: Belief, linear: LinearInterval, weights: FloatArray) -> Update:
        """Update by an interval's samples."""
        if linear.is_local:
            return super().updated(w, state, belief, linear, weights)
        return Update.of(belief, linear, weights)
