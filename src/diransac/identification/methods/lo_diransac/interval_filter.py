"""Kalman filter over the intervals of logs of a machine that only a simulator knows, with slopes of its parameters.

The state at the start of an interval is ``x = m + S (p' - p) + e`` for parameters ``p'`` near p, with a covariance of
e.  An interval's samples and end are linear in state and parameters: by local slopes, or, where contacts chatter and
slopes at a point hold in a tiny range alone, by divided differences over the spread of both.  The samples are
eliminated forward, interval by interval, which gives the gradient and the information of the parameters.

References
----------
Gupta, Mehra 1974 (sensitivities of a filter); Bierman 1977 (square-root information); Norgaard, Poulsen, Ravn 2000
(divided differences); Krasker, Welsch 1982 (bounded influence).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray, robust_std
from diransac.identification.core.noise import Mixture
from diransac.identification.methods.lo_diransac.interval_effects import batch_sums
from diransac.simulation import Measurements, RolloutBatch, Simulator, rollouts
from diransac.time_limit import check_time

if TYPE_CHECKING:
    from diransac.identification.core.windows import Windows

TINY = 1e-12
"""Least scale of anything, its unit: beside rounding errors of what has a size of about one."""
RADIUS = 3.0**0.5
"""Distance of the points of divided differences from the mean, standard deviations: by a Gaussian's kurtosis."""
STEPS = {"state": 1e-7, "parameter": 1e-5, "delay": 1e-6}
"""Local differences, over the size of a state or parameter, samples of a delay: wider ones meet other contacts."""
CURVED = 4.0
"""Mean variance that divided differences leave, over that of the noise: above, local slopes are used."""
SETTLING = 8
"""Intervals after a (new) beginning in which jumps are those of the first state, not of what the model lacks."""
INFLUENCE = 5.0
"""Information of an interval on all parameters at most, over the mean of all."""


@dataclass(frozen=True)
class Belief:
    """Covariance ``(n_x, n_x)`` of a state, and slopes ``(n_x, n)`` of its mean with the parameters."""

    covariance: FloatArray
    slopes: FloatArray

    @cached_property
    def root(self) -> FloatArray:
        """Lower Cholesky factor ``(n_x, n_x)`` of the covariance."""
        ridge = np.diag(TINY * np.diag(self.covariance) + TINY**2)
        return np.asarray(np.linalg.cholesky(self.covariance + ridge), float)

    def directions(self, root: FloatArray) -> FloatArray:
        """Columns ``(n_x + n, n_x + n)``: standard deviations of state and parameters, whose root is ``(n, n)``."""
        return np.block([[self.root, self.slopes @ root], [np.zeros((len(root), len(self.root))), root]])


@dataclass(frozen=True)
class LinearInterval:
    """Errors of an interval's m samples, and its end, as linear functions of its state and of the parameters.

    Parameters
    ----------
    values : (m + n_x,) array
        Simulated less measured samples, then the state after the last row.
    of_unknown : (m + n_x, n_u) array
        Changes per standard deviation of the state, and what divided differences leave as independent noises.
    of_parameters : (m + n_x, n) array
        Changes with the parameters, with which the state's mean moves.
    of_velocities : (n_x, n_v) array
        Change of the end with the velocities at the start.
    """

    values: FloatArray
    of_unknown: FloatArray
    of_parameters: FloatArray
    of_velocities: FloatArray

    @classmethod
    def of(cls, belief: Belief, n_q: int, points: FloatArray, values: FloatArray) -> LinearInterval:
        """By values ``(k, m + n_x)`` at differences ``(k, n_x + n)`` of state and parameters, the first of which is 0.

        Others are local, or pairs of opposite signs at `RADIUS` standard deviations.
        """
        n, n_x = points.shape[1], len(belief.root)
        mean, left = values[0], np.zeros((values.shape[1], 0))
        directions, changes = points[1:], values[1:] - values[0]
        if len(points) > n + 1:
            above, below = np.split(changes, 2)
            bends = (above + below)[:n_x].T / (2.0 * RADIUS**2)
            mean, left = mean + bends.sum(axis=1), np.sqrt(RADIUS**2 - 1.0) * bends
            directions, changes = points[1 : n + 1] - points[n + 1 :], above - below
        slopes = np.linalg.solve(directions, changes).T
        of_state = slopes[:, :n_x]
        of_unknown = np.hstack([of_state @ belief.root, left])
        of_parameters = slopes[:, n_x:] + of_state @ belief.slopes
        return cls(mean, of_unknown, of_parameters, of_state[len(mean) - n_x :, n_q:])

    @property
    def is_local(self) -> bool:
        """True if slopes are those at the state, and leave nothing."""
        return bool(self.of_unknown.shape[1] == len(self.of_velocities))

    def sampled(self, values: FloatArray, n_signals: int) -> FloatArray:
        """The part of an array ``(m + n_x, ...)`` that is of samples, ``(n_rows, n_signals, ...)``."""
        n_x = len(self.of_velocities)
        return values[:-n_x].reshape(-1, n_signals, *values.shape[1:])


@dataclass(frozen=True)
class Update:
    """Effect of the samples of an interval.

    Parameters
    ----------
    moved : (n_x,) array
        Change of the state at its start.
    belief, belief_of_end : Belief
        Of this state, and of that after the last row.
    prior : float
        Twice the cost of the change by what was known before.
    information, score : (n, n) and (n,) array
        Contributions to those of the parameters.
    misfit : float
        Sum of the squares of the whitened errors before it; in the mean, the number of samples.
    values : (m + n_x,) array
        Errors of the samples, and the end, after it.
    """

    moved: FloatArray
    belief: Belief
    belief_of_end: Belief
    prior: float
    information: FloatArray
    score: FloatArray
    misfit: float
    values: FloatArray

    @classmethod
    def of(cls, belief: Belief, linear: LinearInterval, weights: FloatArray) -> Update:
        """Update by an interval's samples with weights ``(n_rows, n_s)``."""
        m, (n_x, n_p), n = weights.size, belief.slopes.shape, linear.of_unknown.shape[1]
        rows = np.column_stack([linear.of_unknown, linear.of_parameters, -linear.values])
        # Rows of samples, and of what is known beforehand, in units of its root.
        known = np.vstack([np.sqrt(weights.ravel())[:, None] * rows[:m], np.eye(n, rows.shape[1])])
        R: FloatArray = np.asarray(np.linalg.qr(known, mode="r"))
        left = R[n:, n:]
        solved = np.linalg.solve(R[:n, :n], np.column_stack([R[:n, n:], np.eye(n)]))
        slopes, moved, inverse = solved[:, :n_p], solved[:, n_p], solved[:, n_p + 1 :]
        half, end_half = belief.root @ inverse[:n_x], linear.of_unknown[m:] @ inverse
        return cls(
            belief.root @ moved[:n_x],
            Belief(half @ half.T, belief.slopes - belief.root @ slopes[:n_x]),
            Belief(end_half @ end_half.T, linear.of_parameters[m:] - linear.of_unknown[m:] @ slopes),
            float(np.square(moved).sum()),
            left[:, :-1].T @ left[:, :-1],
            left[:, :-1].T @ left[:, -1],
            float(np.square(left[:, -1]).sum()),
            linear.values + linear.of_unknown @ moved,
        )

    def share(self, n_samples: float) -> float:
        """Huber's weight of the interval for the parameters, by the number of samples that are no outliers.

        Where a contact is not as slopes tell, all samples are wrong together.  Were the weight to fall faster, an
        interval that contradicts wrong parameters would count for nothing.
        """
        return float(min(1.0, np.sqrt(n_samples / max(self.misfit, TINY))))


@dataclass(frozen=True)
class FilterPass:
    """Predictions of all intervals with one set of parameters.

    Parameters
    ----------
    losses : (W,) array
        Negative log-likelihood of the predicted samples of each interval.
    lost : (W,) bool array
        Intervals in which simulations diverge, whose samples cost ten nats each.
    scores : (W, n) array
        Contribution of each interval to minus the gradient of the loss with respect to the parameters, the delay of
        the inputs last if it is estimated.
    information : (W, n, n) array
    states : (W, n_x) array
        At the intervals' starts, after their samples.
    jumps : (W, n_x) array
        From the ends of the intervals before; 0 where nothing is before.
    residuals : (N, n_s) array
        Simulated from these states less measured.
    surprise : (W,) array
        Mean square of the changes of velocities by samples, over what the filter expects; NaN where they tell nothing.
    """

    losses: FloatArray
    lost: BoolArray
    scores: FloatArray
    information: FloatArray
    states: FloatArray
    jumps: FloatArray
    residuals: FloatArray
    surprise: FloatArray

    @property
    def loss(self) -> float:
        """Negative log-likelihood of all samples."""
        return float(self.losses.sum())

    def step(self, precision: FloatArray, pull: FloatArray, bounds: tuple[FloatArray, FloatArray]) -> FloatArray:
        """Gauss-Newton step ``(n,)`` with priors, within bounds of it; 0 where the logs tell nothing.

        The other parameters follow those that stay at a bound.
        """
        information, right = self.information.sum(axis=0) + np.diag(precision), self.scores.sum(axis=0) + pull
        step, free = np.zeros(len(right)), np.ones(len(right), bool)
        while free.any():
            rest = right[free] - information[np.ix_(free, ~free)] @ step[~free]
            step[free] = inverse(information[np.ix_(free, free)]) @ rest
            held = np.clip(step, *bounds)
            beyond = np.abs(step - held)
            if not beyond.any():
                break
            worst = np.argmax(np.where(beyond > 0.0, beyond / (bounds[1] - bounds[0] + TINY), -1.0))
            step[worst], free[worst] = held[worst], False
        return step

    def covariance(self, precision: FloatArray) -> FloatArray:
        """Covariance ``(n, n)``, larger where scores of neighbouring intervals scatter more than by white noise.

        0 of what the logs tell nothing of.  References: Huber 1967, by batches.
        """
        white = inverse(self.information.sum(axis=0) + np.diag(precision))
        scatter = np.square(batch_sums(self.scores @ white)).sum(axis=0)
        return widened(white, np.sqrt(scatter))


def widened(covariance: FloatArray, errors: FloatArray) -> FloatArray:
    """Covariance ``(n, n)`` with the same correlations, and standard deviations that are at least others ``(n,)``."""
    own = np.sqrt(np.diag(covariance))
    more = np.divide(np.maximum(own, errors), own, out=np.zeros_like(own), where=own > 0.0)
    return np.asarray(covariance * np.outer(more, more) + np.diag(np.where(own > 0.0, 0.0, np.square(errors))))


def inverse(information: FloatArray) -> FloatArray:
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
    """
    n, telling = information.shape[1], np.count_nonzero(information.any(axis=(1, 2)))
    weights, most = np.ones(len(information)), INFLUENCE * n / max(telling, 1)
    for _ in range(20):
        covariance = inverse(np.einsum("w,wij->ij", weights, information))
        told = np.einsum("ij,wji->w", covariance, information)
        weights = np.minimum(1.0, most / np.maximum(told, TINY))
    return weights


@dataclass(frozen=True)
class IntervalFilter:
    """Passes over the intervals of some logs.

    Parameters
    ----------
    intervals : Windows
    noise : Mixture
    lack : float
        Change of a velocity in an interval that the model lacks, over the change that it predicts; at first a third.
    delay : float
        Of the inputs, samples.
    free_delay : bool
        Whether it is estimated.
    spread : (n, n) array, optional
        Covariance of the parameters, and of the delay, over which slopes are taken, those of states over their own;
        None: local ones.
    """

    intervals: Windows
    noise: Mixture
    lack: float = 0.3
    delay: float = 0.0
    free_delay: bool = True
    spread: FloatArray | None = None

    @classmethod
    def of(cls, intervals: Windows, *, outliers: bool, free_delay: bool) -> IntervalFilter:
        """A filter with noise by the second differences of each signal."""
        n = len(intervals.model.signals)
        spread, noise, half = np.ones(n), np.ones(n), np.ones(n)
        seen: BoolArray = np.asarray(intervals.known.any(axis=0))
        for j in np.flatnonzero(seen):
            y = intervals.measured[intervals.known[:, j], j]
            half[j] = max(np.ptp(y), TINY)
            spread[j] = float(robust_std(y - np.median(y))) or np.ptp(y) or 1.0
            bends = float(robust_std(np.diff(y, 2))) / np.sqrt(6.0) if len(y) > 4 else 0.0
            noise[j] = max(3.0 * bends, 1e-2 * spread[j])
        floor = np.maximum(1e-5 * spread, TINY)
        whole = [four for four in intervals.model.quaternions if seen[list(four)].all()]
        for four in whole:
            noise[list(four)], floor[list(four)] = noise[list(four)].max(), floor[list(four)].max()
        pi = np.full(n, 0.1 if outliers else 0.0)
        return cls(intervals, Mixture(noise, pi, half, floor, whole), free_delay=free_delay)

    @cached_property
    def columns(self) -> IntArray:
        """Signals that the logs have."""
        return np.flatnonzero(self.intervals.sampled.any(axis=0))

    @cached_property
    def simulator(self) -> Simulator:
        """Simulator of these signals."""
        model = self.intervals.model
        return rollouts(model, [model.signals[k] for k in self.columns], hold=self.intervals.hold)

    def acting(self, delay: float) -> FloatArray:
        """Inputs ``(N, n_u)`` after a delay, samples."""
        return self.intervals.with_input_error(self.intervals.all_inputs("delay"), delay).inputs

    @cached_property
    def start_std(self) -> FloatArray:
        """Standard deviation ``(n_x,)`` of the first state: 0.3 rad, 5 cm, the range of an input, or a noisy sample's.

        Of a velocity ten times that in a second.
        """
        model, seen = self.intervals.model, np.asarray(self.intervals.known.any(axis=0))
        units = [*model.coordinates.values(), *(x.partition("/")[0] for x in model.velocities.values())]
        std = np.where(np.isin(units, ["m", "1"]), 0.05, 0.3) * np.where(np.arange(len(units)) < model.n_q, 1.0, 10.0)
        driven = np.isin(model.state, list(model.first_order))
        std[driven] = np.maximum(std[driven], np.ptp(self.intervals.recorded, axis=0).max(initial=0.0))
        return np.where(seen[: len(std)], np.minimum(self.noise.sigma[: len(std)] + 0.03 * std, std), std)

    def first_state(self, w: int, rest: FloatArray) -> FloatArray:
        """State at an interval's start: medians of the first five samples, of what nothing measures the rest."""
        state, rows = rest.copy(), self.intervals.starts[w] + np.arange(self.intervals.length)
        for j in range(len(state)):
            known = rows[self.intervals.known[rows, j]][:5]
            if len(known):
                state[j] = np.median(self.intervals.measured[known, j])
        return state

    def over_logs(self, p: FloatArray) -> FilterPass:
        """Predictions with parameters ``(n_p,)``."""
        intervals, home, run = self.intervals, self.intervals.model.home, _Run(self, p)
        state, belief = home, None
        for w in range(len(intervals)):
            if belief is None or not intervals.following[w]:
                rest = home if w == 0 or intervals.log_of[w] != intervals.log_of[w - 1] else state
                state = self.first_state(w, rest)
                belief = Belief(np.diag(np.square(self.start_std)), np.zeros((len(state), run.n)))
                run.age = 0
            state, belief = run.interval(w, state, belief)
        weights = bounded_influence(run.done.information)
        scores, information = weights[:, None] * run.done.scores, weights[:, None, None] * run.done.information
        return replace(run.done, scores=scores, information=information)

    def trajectories(self, p: FloatArray, states: FloatArray) -> FloatArray:
        """All signals ``(N, n_signals)`` of the intervals from states ``(W, n_x)`` at their starts."""
        intervals = self.intervals
        parameters = np.broadcast_to(
            intervals.parameters_of(p, intervals.log_of), (len(intervals), intervals.model.n_p)
        )
        lanes = (intervals.dt, intervals.starts, intervals.length, intervals.first_of_log)
        batch = RolloutBatch(parameters, states, self.acting(self.delay), *lanes)
        return self.simulator.trajectories(batch, threads=intervals.threads).reshape(len(intervals.measured), -1)


class _Run:
    """One pass."""

    def __init__(self, of: IntervalFilter, p: FloatArray) -> None:
        self.of, self.p, intervals = of, p, of.intervals
        self.n, W, n_x = len(p) + of.free_delay, len(intervals), len(intervals.model.state)
        lost, states, residuals = np.zeros(W, bool), np.zeros((W, n_x)), np.zeros(intervals.measured.shape)
        scores, information = np.zeros((W, self.n)), np.zeros((W, self.n, self.n))
        self.done = FilterPass(
            np.zeros(W), lost, scores, information, states, np.zeros((W, n_x)), residuals, np.full(W, np.nan)
        )
        self.age, self.contradicts = 0, False
        noise, k = of.noise, of.columns
        self.noise = Mixture(noise.sigma[k], noise.pi[k], noise.span[k], noise.floor[k])
        self.known = intervals.known[:, k].reshape(W, intervals.length, -1)
        self.root = None
        if of.spread is not None:  # the delay is uncorrelated
            self.root = np.diag(np.sqrt(np.diag(of.spread)))
            self.root[: len(p), : len(p)] = np.linalg.cholesky(of.spread[: len(p), : len(p)])
        sizes = np.array([abs(x.value or 0.0) or 0.01 for x in intervals.layout.bounds])
        self.steps = np.append(STEPS["parameter"] * np.maximum(sizes, np.abs(p)), [STEPS["delay"]] * of.free_delay)
        # Recordings with the delay, a local step more, and the spread of it more and less, one after another.
        reach = 0.0 if self.root is None else RADIUS * self.root[-1, -1]
        delays = (0.0, STEPS["delay"], reach, -reach)[: 1 if not of.free_delay else 4 if reach else 2]
        self.delays, n_rows = np.array(delays), len(intervals.measured)
        self.inputs = np.concatenate([of.acting(of.delay + x) for x in delays])
        measured = np.tile(intervals.measured[:, of.columns], (len(delays), 1))
        self.measurements = Measurements(measured, np.ones(len(measured), bool))
        self.firsts = np.concatenate([intervals.first_of_log + k * n_rows for k in range(len(delays))])

    def simulated(self, w: int, state: FloatArray, points: FloatArray) -> FloatArray:
        """Samples less measured ones, and ends, ``(k, m + n_x)`` at differences ``(k, n_x + n)`` of the unknowns."""
        intervals, n_x, n = self.of.intervals, len(state), len(state) + len(self.p)
        log = intervals.log_of[w : w + 1]
        parameters = np.concatenate([np.atleast_2d(intervals.parameters_of(self.p + x, log)) for x in points[:, n_x:n]])
        late = np.abs(points[:, n:].sum(axis=1)[:, None] - self.delays).argmin(axis=1)
        batch = RolloutBatch(
            parameters,
            state + points[:, :n_x],
            self.inputs,
            intervals.dt,
            intervals.starts[w] + late * len(intervals.measured),
            intervals.length,
            self.firsts,
        )
        errors, ends = self.of.simulator.errors_and_ends(batch, self.measurements, threads=intervals.threads)
        return np.hstack([errors.reshape(len(points), -1), ends])

    def linear(self, w: int, state: FloatArray, belief: Belief) -> LinearInterval | None:
        """An interval's samples and end over the spread, or locally where it is too wide; None: it diverges."""
        n_x, n_q = len(state), self.of.intervals.model.n_q
        if self.root is not None:
            ahead = RADIUS * belief.directions(self.root).T
            points = np.vstack([np.zeros(len(ahead)), ahead, -ahead])
            lower, upper = np.array([(x.lower, x.upper) for x in self.of.intervals.layout.bounds]).T
            of_p = points[:, n_x : n_x + len(self.p)]
            within = np.clip(of_p, lower - self.p, upper - self.p)
            points[:, :n_x] += (within - of_p) @ belief.slopes[:, : len(self.p)].T
            of_p[:] = within
            values = self.simulated(w, state, points)
            if np.isfinite(values).all():
                linear = LinearInterval.of(belief, n_q, points, values)
                left = linear.sampled(np.square(linear.of_unknown[:, n_x:]).sum(axis=1), len(self.of.columns))
                if (left / np.square(self.noise.sigma) * self.known[w]).sum() <= CURVED * self.known[w].sum():
                    return linear
        steps = np.append(STEPS["state"] * np.maximum(1.0, np.abs(state)), self.steps)
        points = np.vstack([np.zeros(len(steps)), np.diag(steps)])
        values = self.simulated(w, state, points)
        return LinearInterval.of(belief, n_q, points, values) if np.isfinite(values).all() else None

    def interval(self, w: int, state: FloatArray, belief: Belief) -> tuple[FloatArray, Belief | None]:
        """State and belief at the end of an interval, after its samples; None: the motion is lost."""
        check_time()
        columns, known, done = self.of.columns, self.known[w], self.done
        linear = self.linear(w, state, belief)
        if linear is None:
            done.states[w], done.losses[w], done.lost[w] = state, 10.0 * float(known.sum()), True
            return state, None
        errors = linear.sampled(linear.values, len(columns))
        expected = linear.sampled(np.square(linear.of_unknown).sum(axis=1), len(columns))
        wide = np.sqrt(1.0 + expected / np.square(self.noise.sigma))
        losses, inlying = self.noise.losses_and_inlying(errors / wide, known)
        done.losses[w] = float((losses + known * np.log(wide)).sum())
        # Too few samples agree, in two intervals: the motion is lost, and begins anew with the samples.
        before, self.contradicts = self.contradicts, bool(inlying.sum() < 0.5 * known.sum())
        update = self.updated(w, state, belief, linear, inlying / np.square(self.noise.sigma))
        self.count(w, update, belief, float(inlying.sum()))
        done.states[w] = state + update.moved
        of_interval = done.residuals.reshape(*self.known.shape[:2], -1)[w]
        of_interval[:, columns] = np.where(known, linear.sampled(update.values, len(columns)), 0.0)
        end = update.values[-len(state) :]
        is_lost = self.contradicts and before and bool(self.of.intervals.following[w])
        return end, None if is_lost else self.lacking(w, update, linear)

    def updated(self, w: int, state: FloatArray, belief: Belief, linear: LinearInterval, weights: FloatArray) -> Update:
        """Update by an interval's samples with as much weight as their linear model deserves.

        Where a contact changes, a full step may lead to a motion that agrees less.  The end is simulated.
        """
        if not linear.is_local:
            return Update.of(belief, linear, weights)
        squares, none = weights.ravel(), np.zeros((1, self.n))
        before = squares @ np.square(linear.values[: len(squares)])
        for share in 0.25 ** np.arange(5):
            update = Update.of(belief, linear, share * weights)
            (values,) = self.simulated(w, state, np.column_stack([update.moved[None], none]))
            after = squares @ np.square(np.where(squares > 0.0, values[: len(squares)], 0.0))
            if np.isfinite(values).all() and share * after + update.prior <= share * before * (1.0 + TINY):
                end = values[len(squares) :]
                update.belief_of_end.covariance.flat[:: len(end) + 1] += np.square(end - update.values[len(squares) :])
                return replace(update, values=np.append(update.values[: len(squares)], end))
        return Update.of(belief, linear, 0.0 * weights)

    def count(self, w: int, update: Update, belief: Belief, n_samples: float) -> None:
        """Add an interval's contributions."""
        done, n_q, share = self.done, self.of.intervals.model.n_q, update.share(n_samples)
        done.information[w], done.scores[w] = share * update.information, share * update.score
        self.age += 1
        if self.age <= SETTLING:
            return
        done.jumps[w] = update.moved
        before, after = (np.diag(x.covariance)[n_q:] for x in (belief, update.belief))
        told = before - after > 0.3 * before
        if told.any():
            surprise = np.square(update.moved[n_q:][told]) / (before - after)[told]
            done.surprise[w] = np.clip(surprise, 0.0, 9.0).mean()

    def lacking(self, w: int, update: Update, linear: LinearInterval) -> Belief:
        """Belief of the state at the end of an interval, with what the model lacks."""
        n_q, n_x = self.of.intervals.model.n_q, len(update.moved)
        change = np.abs(update.values[-n_x:] - self.done.states[w])
        lack = self.of.lack * (change + 1e-3 * self.of.start_std)[n_q:]
        # A change of velocity on the way moves coordinates by half of what one at the start does.
        effect = np.vstack([0.5 * linear.of_velocities[:n_q], np.eye(n_x - n_q)])
        covariance = update.belief_of_end.covariance + (effect * np.square(lack)) @ effect.T
        return Belief(0.5 * (covariance + covariance.T), update.belief_of_end.slopes)
