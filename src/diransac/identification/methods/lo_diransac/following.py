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
from diransac.identification.methods.lo_diransac.interval_effects import batch_sums
from diransac.identification.methods.lo_diransac.mixture import Mixture
from diransac.simulation import LinearizedErrors, Measurements, RolloutBatch, default_threads, rollouts
from diransac.time_limit import check_time

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
    from diransac.simulation.mujoco import MujocoRollouts

_FIRST = 5
"""Samples of which the median is a first state."""
_UNSURE = {"m": 0.05, "rad": 0.3, "1": 0.05}
"""Standard deviation at the start of coordinates that nothing measures; of velocities, in a second, ten times that."""
_LACKS = 0.3
"""Change of a velocity in an interval that the model lacks at first, of the change that it predicts."""
_SMALL = 1e-3
"""Least change of a velocity of which the model lacks a part, over its size."""
_FIRST_NOISE, _LEAST_NOISE, _TINY = 3.0, 1e-3, 1e-12
"""Noise of a signal before anything is fitted, over that of its bends; at least, over its spread."""
_LOST, _ROUNDING = 1e4, 1e-12
_FOLLOWED = 0.5
"""Part of the samples that must agree: if fewer do in two intervals, the motion begins anew with the samples."""
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
        the inputs last if it is estimated; with bounded influence.
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
            worst = np.argmax(np.where(beyond, np.abs(step - held) / (bounds[1] - bounds[0] + _TINY), -1.0))
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
        more = np.sqrt(np.maximum(1.0, scatter / (np.diag(white) + _TINY**2)))
        return np.asarray(white * np.outer(more, more))


def _inverse(information: FloatArray) -> FloatArray:
    """Inverse in columns of unit size; 0 of what there is no information about."""
    d = np.sqrt(np.maximum(np.diag(information), 0.0))
    scale = np.divide(1.0, d, out=np.zeros_like(d), where=d > _TINY)
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
        weights = np.minimum(1.0, most / np.maximum(told, _TINY))
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
    """

    intervals: ShootingIntervals
    noise: Mixture
    lacks: float = _LACKS
    delay: float = 0.0
    free_delay: bool = True

    @classmethod
    def of(cls, intervals: ShootingIntervals, *, outliers: bool, free_delay: bool) -> Predictor:
        """A predictor with noise by the bends of each signal."""
        n = len(intervals.model.signals)
        spread, noise = np.ones(n), np.ones(n)
        low, high = np.zeros(n), np.ones(n)
        seen: BoolArray = np.asarray(intervals.known.any(axis=0))
        for j in np.flatnonzero(seen):
            y = intervals.measured[intervals.known[:, j], j]
            low[j], high[j] = y.min(), max(y.max(), y.min() + _TINY)
            spread[j] = float(robust_std(y - np.median(y))) or np.ptp(y) or 1.0
            bends = float(robust_std(np.diff(y, 2))) if len(y) > _FIRST else 0.0
            noise[j] = max(_FIRST_NOISE * bends / np.sqrt(6.0), 10.0 * _LEAST_NOISE * spread[j], _TINY)
        pi = np.full(n, 0.1 if outliers else 0.0)
        floor = np.maximum(1e-2 * _LEAST_NOISE * spread, _TINY)
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
        one, inputs, home = self.intervals, self.acting(self.delay), self.intervals.model.home
        later = self.acting(self.delay + _DELAY_STEP) if self.free_delay else None
        run = _Run(self, p, inputs, later)
        state, belief = self.first_state(0, home), _Belief.begin(self.unsure, run.n)
        for w in range(len(one)):
            if w and (run.is_lost or not one.following[w]):
                rest = home if one.log_of[w] != one.log_of[w - 1] else state
                state, belief = self.first_state(w, rest), _Belief.begin(self.unsure, run.n)
            state, belief = run.interval(w, state, belief)
        return run.result()

    def trajectories(self, p: FloatArray, states: FloatArray) -> FloatArray:
        """All signals ``(N, n_signals)`` of the intervals from states ``(W, n_x)`` at their starts."""
        one = self.intervals
        parameters = np.broadcast_to(one.parameters_of(p, one.log_of), (len(one), one.model.n_p))
        lanes = (one.dt, one.starts, one.length, one.first_of_log)
        batch = RolloutBatch(parameters, states, self.acting(self.delay), *lanes)
        return self._simulator.trajectories(batch, threads=one.threads).reshape(len(one.measured), -1)


@dataclass(frozen=True)
class _Belief:
    """Covariance of a state, and the change of its mean with the parameters."""

    covariance: FloatArray
    slopes: FloatArray

    @classmethod
    def begin(cls, unsure: FloatArray, n: int) -> _Belief:
        return cls(np.diag(np.square(unsure)), np.zeros((len(unsure), n)))


class _Run:
    """One pass."""

    def __init__(self, predictor: Predictor, p: FloatArray, inputs: FloatArray, later: FloatArray | None) -> None:
        self.predictor, self.p, self.inputs, self.later = predictor, p, inputs, later
        one = predictor.intervals
        self.n = len(p) + (later is not None)
        self.states = np.empty((len(one), one.model.n_q + one.model.n_v))
        self.jumps, self.scores = np.zeros_like(self.states), np.zeros((len(one), self.n))
        self.information, self.losses, self.lost = np.zeros((len(one), self.n, self.n)), *np.zeros((2, len(one)))
        self.residuals, self.errors, self.expected = np.zeros((3, *one.measured.shape))
        self.surprise, self.age, self.is_lost, self.contradicts = list[FloatArray](), 0, False, False
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
        parameters = one.parameters_of(self.p, one.log_of[w : w + 1])
        lane = parameters if parameters.ndim == 2 else parameters[None]
        return RolloutBatch(lane, state[None], inputs, one.dt, one.starts[w : w + 1], one.length, one.first_of_log)

    def linearized(self, w: int, state: FloatArray) -> LinearizedErrors:
        """Errors of an interval and their derivatives with respect to state, parameters and delay."""
        predictor, model = self.predictor, self.predictor.intervals.model
        simulator, measurements = predictor._simulator, predictor._measurements
        names = (*model.state, *model.parameters)
        found = simulator.linearized_errors(
            self.batch(w, state, self.inputs),
            measurements,
            unknowns=names,
            threads=self.threads,
        )
        if self.later is None:
            return found
        late, end = simulator.errors_and_ends(self.batch(w, state, self.later), measurements, threads=1)
        assert found.final_states is not None
        assert found.final_slopes is not None
        of_delay = (late - found.errors) / _DELAY_STEP
        of_end = (end - found.final_states) / _DELAY_STEP
        return replace(
            found,
            jacobian=np.concatenate([found.jacobian, of_delay[..., None]], axis=3),
            final_slopes=np.concatenate([found.final_slopes, of_end[..., None]], axis=2),
        )

    def interval(self, w: int, state: FloatArray, belief: _Belief) -> tuple[FloatArray, _Belief]:
        """State and belief at the end of an interval, after its samples."""
        check_time()
        one, columns, n_x = self.predictor.intervals, self.predictor.columns, len(state)
        rows = slice(int(one.starts[w]), int(one.starts[w]) + one.length)
        known = one.known[rows][:, columns]
        at = self.linearized(w, state)
        assert at.final_states is not None
        assert at.final_slopes is not None
        e, J, F = at.errors[0], at.jacobian[0], at.final_slopes[0]
        self.is_lost = not (np.isfinite(J).all() and np.isfinite(F).all() and np.abs(at.final_states).max() < _LOST)
        if self.is_lost:
            self.states[w], self.lost[w] = state, 10.0 * float(known.sum())
            return state, belief
        noise = self._noise
        expected = np.einsum("rsi,ij,rsj->rs", J[..., :n_x], belief.covariance, J[..., :n_x])
        wide = np.sqrt(1.0 + expected / np.square(noise.sigma))
        inlying = noise.inlying(e / wide, known)
        weights, before = inlying / np.square(noise.sigma), self.contradicts and bool(one.following[w])
        self.contradicts = bool(inlying.sum() < _FOLLOWED * known.sum())
        self.is_lost = self.contradicts and before
        self.losses[w] = float((noise.negative_log_likelihood(e / wide, known) + known * np.log(wide)).sum())
        update, ends = self._tempered(w, state, belief, (e, J, weights, at.final_states[0]))
        self._count(w, update, belief)
        self.states[w] = state + update.moved
        self.errors[rows, columns] = np.where(known, e, 0.0)
        self.expected[rows, columns] = expected
        self.residuals[rows, columns] = np.where(known, e + J[..., :n_x] @ update.moved, 0.0)
        return self._propagated(w, state, update, (at.final_states[0], F, ends))

    def _tempered(
        self, w: int, state: FloatArray, belief: _Belief, at: tuple[FloatArray, FloatArray, FloatArray, FloatArray]
    ) -> tuple[_Update, FloatArray]:
        """Update by an interval's samples with as much weight as their linear model deserves, and the end after it.

        Where a contact changes, a full step may lead to a motion that agrees less.
        """
        e, J, weights, end = at
        predictor, known = self.predictor, weights > 0.0
        before = float((weights * np.square(e)).sum())
        for share in _SHARES:
            update = _Update.of(belief, (e, J, share * weights))
            found, ends = predictor._simulator.errors_and_ends(
                self.batch(w, state + update.moved, self.inputs), predictor._measurements, threads=1
            )
            after = float(np.where(known, weights * np.square(found[0]), 0.0).sum())
            if np.abs(ends[0]).max() < _LOST and share * after + update.prior <= share * before * (1.0 + _TINY):
                return update, ends[0]
        return _Update.of(belief, (e, J, 0.0 * weights)), end

    def _count(self, w: int, update: _Update, belief: _Belief) -> None:
        """Add an interval's contributions."""
        n_q = self.predictor.intervals.model.n_q
        self.age = self.age + 1 if self.predictor.intervals.following[w] and not self.is_lost else 0
        self.information[w] = update.information
        self.scores[w] = update.score
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

    def _propagated(
        self, w: int, state: FloatArray, update: _Update, at: tuple[FloatArray, FloatArray, FloatArray]
    ) -> tuple[FloatArray, _Belief]:
        """State at the end of an interval, and what is known of it."""
        predictor, belief, (end, F, ends) = self.predictor, update.belief, at
        n_q, n_x = predictor.intervals.model.n_q, len(state)
        nonlinear = ends - end - F[:, :n_x] @ update.moved
        change = np.abs(ends - state - update.moved)
        lacks = predictor.lacks * (change + _SMALL * predictor.unsure)[n_q:]
        # A change of velocity on the way moves coordinates by half of what one at the start does.
        effect = np.vstack([0.5 * F[:n_q, n_q:n_x], np.eye(n_x - n_q)])
        spread = (effect * np.square(lacks)) @ effect.T + np.diag(np.square(nonlinear))
        covariance = F[:, :n_x] @ belief.covariance @ F[:, :n_x].T + spread
        slopes = F[:, n_x:] + F[:, :n_x] @ belief.slopes
        return ends, _Belief(0.5 * (covariance + covariance.T), slopes)


@dataclass(frozen=True)
class _Update:
    """Effect of the samples of an interval.

    Parameters
    ----------
    moved : (n_x,) array
        Change of the state at its start.
    belief : _Belief
        After it.
    prior : float
        Twice the cost of the change by what was known before.
    information, score : (n, n) and (n,) array
        Contributions to those of the parameters.
    """

    moved: FloatArray
    belief: _Belief
    prior: float
    information: FloatArray
    score: FloatArray

    @classmethod
    def of(cls, belief: _Belief, samples: tuple[FloatArray, FloatArray, FloatArray]) -> _Update:
        """Update by errors, their derivatives and weights of an interval's samples."""
        errors, jacobian, of_samples = samples
        e, weights, n_x = errors.ravel(), of_samples.ravel(), len(belief.slopes)
        J: FloatArray = jacobian.reshape(len(e), -1)
        of_x, of_p = J[:, :n_x], J[:, n_x:] + J[:, :n_x] @ belief.slopes
        own, scale = np.diag(belief.covariance), np.sqrt(weights)[:, None]
        root = np.linalg.cholesky(belief.covariance + np.diag(_ROUNDING * own + _TINY**2))
        # Rows of samples, and of what is known beforehand, in units of its root.
        above = np.hstack([scale * of_x @ root, scale * of_p, -scale * e[:, None]])
        R: FloatArray = np.asarray(np.linalg.qr(np.vstack([above, np.eye(n_x, above.shape[1])]), mode="r"))
        of_state, left = R[:n_x], R[n_x:, n_x:]
        solved = np.linalg.solve(of_state[:, :n_x], np.column_stack([of_state[:, n_x:], np.eye(n_x)]))
        slopes, moved, inverse = np.split(solved, [of_p.shape[1], of_p.shape[1] + 1], axis=1)
        half = root @ inverse
        return cls(
            root @ moved[:, 0],
            _Belief(half @ half.T, belief.slopes - root @ slopes),
            float(np.square(moved).sum()),
            left[:, :-1].T @ left[:, :-1],
            left[:, :-1].T @ left[:, -1],
        )
