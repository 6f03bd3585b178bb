"""Trajectories of states that no signal measures, such as the thrust behind the lag of a motor.

Their equations are simulated over whole logs, driven by the inputs and by the smoothed motion of all other states.  An
observer compares the other accelerations that the equations then give with the motion, ``e' = a(q, v, u, p) +
b (v - e)``: the error ``e - v`` is that of the acceleration, low-pass filtered.  Parameters and initial values of the
unmeasured states are found by least squares (Levenberg-Marquardt) from many random starts, which are lanes of one
batch.  The best of them simulates the shooting intervals best, by the scores of hypotheses.  Its trajectories take the
place of smoothed signals until shooting estimates these states with all others.

References
----------
Ljung 1999, section 7 (prediction errors of observers); Marquardt 1963; Boender, Rinnooy Kan 1987 (random starts).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.identification.methods.lo_diransac.hypotheses import robust_scores
from diransac.identification.methods.lo_diransac.smoothing import Motion
from diransac.identification.nonlinear import ParameterChart
from diransac.model import Model, Parameter
from diransac.simulation import Measurements, RolloutBatch, Simulator, rollouts

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
    from diransac.model.derivation import Symbols

__all__ = ["measured_signals", "unmeasured_states", "with_unmeasured_states"]

# Random starts and their steps; the number of those that go on, and their further steps.
_N_STARTS, _N_STEPS, _N_FINALISTS, _N_FURTHER_STEPS = 256, 15, 12, 60
# Largest factor of a positive parameter in a step.
_LARGEST_FACTOR = 10.0
# Memory of the observers, in shooting intervals, over which errors of the smoothed motion average out; integration
# steps per sample.
_MEMORY, _SUBSTEPS = 4.0, 2
# Damping at the start, its bounds, and its factors after a step down and after one up; the least gain of a step.
_TINY = 1e-9
_DAMPING, _DAMPING_BOUNDS, _LESS, _MORE, _CONVERGED = 1e-2, (1e-9, 1e9), 0.2, 6.0, 1e-9


def unmeasured_states(intervals: ShootingIntervals) -> tuple[str, ...]:
    """Names of the states of which no signal, and no derivative of one, is measured.

    Velocities of a model with kinematics follow from its coordinates, where any of these is measured.

    Parameters
    ----------
    intervals : ShootingIntervals

    Returns
    -------
    tuple of str
        In the order of the model's states.
    """
    model = intervals.model
    seen = set(measured_signals(intervals))
    lost = {name for chain in model.chains if seen.isdisjoint(chain) for name in chain}
    if model.kinematics is not None:
        inferred = () if seen.isdisjoint(model.coordinates) else model.velocities_of_motion
        lost -= {*model.coordinates, *inferred}
    return tuple(n for n in model.state if n in lost)


def measured_signals(intervals: ShootingIntervals) -> tuple[str, ...]:
    """Names of the signals with a sample.

    Parameters
    ----------
    intervals : ShootingIntervals

    Returns
    -------
    tuple of str
        In the order of the model's signals.
    """
    seen = np.flatnonzero(intervals.known.any(axis=0))
    return tuple(intervals.model.signals[i] for i in seen)


def with_unmeasured_states(intervals: ShootingIntervals, motion: Motion) -> Motion | None:
    """The motion with trajectories of the unmeasured states and of their derivatives.

    Parameters
    ----------
    intervals : ShootingIntervals
    motion : Motion
        Smoothed motion over the rows of the intervals.

    Returns
    -------
    Motion or None
        None if every simulation diverges.
    """
    problem = _DrivenStates(intervals, motion, unmeasured_states(intervals))
    z, cost = _least_squares(problem, problem.starts(), _N_STEPS)
    z, cost = _least_squares(problem, z[np.argsort(cost, kind="stable")[:_N_FINALISTS]], _N_FURTHER_STEPS)
    n, every = len(intervals.layout), np.arange(len(intervals))
    completed = [_completed(problem, one) for one in z[np.isfinite(cost)]]
    scores = [
        robust_scores(intervals, one, p[None, :n], every)[0]
        for one, p in zip(completed, z[np.isfinite(cost)], strict=True)
    ]
    return completed[int(np.argmin(scores))] if np.isfinite(scores).any() else None


def _completed(problem: _DrivenStates, z: FloatArray) -> Motion:
    """The motion with the unmeasured states and their derivatives that unknowns (n,) give."""
    signals, spread = problem.motion.signals.copy(), problem.motion.spread.copy()
    for name, values in problem.trajectories(z).items():
        column = problem.intervals.model.signals.index(name)
        signals[:, column], spread[column] = values, values.std() + _TINY
    return Motion(signals, spread)


@lru_cache(maxsize=16)
def _driven_model(model: Model, hidden: tuple[str, ...], observed: tuple[str, ...]) -> Model:
    """States that obey a model's equations, driven by the other ones, and an observer of each observed velocity.

    All are states of first order, in this order; inputs are the other states of the model, and its inputs.
    """
    names = [f"driven_{i}" for i in range(len(hidden) + len(observed))]
    known = {n: model.units[n] for n in model.state if n not in hidden}
    rows = [model.state.index(n) for n in (*hidden, *observed)]

    def equations(_q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        of_hidden = dict(zip(hidden, v, strict=False))
        x = ca.vertcat(*(of_hidden[n] if n in of_hidden else u[n] for n in model.state))
        applied, parameters = (
            ca.vertcat(*(z[n] for n in group)) for z, group in ((u, model.inputs), (p, model.parameters))
        )
        rates = model.dynamics(x, applied, parameters)[0][rows]
        pull = [p.bandwidth_ * (u[n] - e) for n, e in zip(observed, list(v)[len(hidden) :], strict=True)]
        return list(ca.vertsplit(ca.vertcat(*a) - rates - ca.vertcat(ca.SX(len(hidden), 1), *pull)))

    return Model(
        f"{model.name}, driven by its measured motion",
        {},
        {**known, **model.inputs},
        {**model.parameters, "bandwidth_": Parameter("1/s", positive=True)},
        equations,
        first_order={name: model.units[n] for name, n in zip(names, (*hidden, *observed), strict=True)},
    )


@dataclass(frozen=True)
class _DrivenStates:
    """Least squares of the observers' errors; unknown are the parameters, and the initial states of every log.

    Parameters
    ----------
    intervals : ShootingIntervals
    motion : Motion
    hidden : tuple of str
        Unmeasured states.
    """

    intervals: ShootingIntervals
    motion: Motion
    hidden: tuple[str, ...]

    @cached_property
    def _observed(self) -> tuple[str, ...]:
        return tuple(n for n in self.intervals.model.velocities if n not in self.hidden)

    @cached_property
    def _driven(self) -> Model:
        return _driven_model(self.intervals.model, self.hidden, self._observed)

    @cached_property
    def _simulator(self) -> Simulator:
        return rollouts(self._driven, self._driven.state[len(self.hidden) :], substeps=_SUBSTEPS)

    @property
    def _bandwidth(self) -> float:
        """Bandwidth of the observers, 1/s."""
        return 1.0 / (_MEMORY * self.intervals.duration)

    @cached_property
    def _inputs(self) -> FloatArray:
        """Inputs (N, n) of the driven model; they are held from row to row, so that the motion's means are taken."""
        model, signals = self.intervals.model, self.motion.signals
        means = signals.copy()
        for rows in self.intervals.rows_of_logs:
            means[rows][:-1] = 0.5 * (signals[rows][1:] + signals[rows][:-1])
        known = [i for i, n in enumerate(model.state) if n not in self.hidden]
        return np.hstack([means[:, known], self.intervals.inputs])

    @cached_property
    def _velocities(self) -> FloatArray:
        """Velocities (N, n) that are observed."""
        return self.motion.signals[:, [self.intervals.model.signals.index(n) for n in self._observed]]

    @cached_property
    def _weights(self) -> FloatArray:
        """Weights (N, n): one over the squared spread of the accelerations, as the observers filter them."""
        model = self.intervals.model
        rate_of = dict(zip(model.velocities, model.accelerations, strict=True))
        spread = self.motion.spread[[model.signals.index(rate_of[n]) for n in self._observed]]
        return np.where(self.intervals.counted[:, None], np.square(self._bandwidth / spread), 0.0)

    def starts(self) -> FloatArray:
        """Unknowns (n_starts, n) to start from: parameters over the bounds or six decades, states zero."""
        layout = self.intervals.layout
        chart = ParameterChart(layout.bounds)
        parameters = chart.to_parameters(chart.starts(_N_STARTS))
        return np.hstack([parameters, np.zeros((_N_STARTS, layout.n_logs * len(self.hidden)))])

    def moved(self, now: FloatArray, step: FloatArray) -> FloatArray:
        """Unknowns (n_starts, n) after a step within the bounds, in which positive parameters change by a factor."""
        then = now + step
        for j, bound in enumerate(self.intervals.layout.bounds):
            then[:, j] = np.clip(then[:, j], bound.lower, bound.upper)
            if bound.positive:
                then[:, j] = np.clip(then[:, j], now[:, j] / _LARGEST_FACTOR, now[:, j] * _LARGEST_FACTOR)
        return then

    def _places(self, log: int) -> IntArray:
        """Places of a log's parameters and initial states among the unknowns."""
        layout, n = self.intervals.layout, len(self.hidden)
        return np.concatenate([layout.index[log], len(layout) + n * log + np.arange(n)])

    def _batch(self, z: FloatArray, log: int) -> RolloutBatch:
        """Lanes of a log, one per vector of unknowns (n_starts, n)."""
        rows, own = self.intervals.rows_of_logs[log], z[:, self._places(log)]
        parameters, states = np.split(own, [self.intervals.model.n_p], axis=1)
        bandwidth = np.full((len(z), 1), self._bandwidth)
        observed = np.tile(self._velocities[rows.start], (len(z), 1))
        return RolloutBatch(
            np.hstack([parameters, bandwidth]), np.hstack([states, observed]), self._inputs[rows], self.intervals.dt
        )

    def linearized(self, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Cost (n_starts,), infinite after a divergence, its gradient / 2 (n_starts, n), and the normal matrix."""
        cost, gradient, matrix = np.zeros(len(z)), np.zeros(z.shape), np.zeros((*z.shape, z.shape[1]))
        unknowns = (*self.intervals.model.parameters, *self._driven.state[: len(self.hidden)])
        for i, rows in enumerate(self.intervals.rows_of_logs):
            measured = Measurements(self._velocities[rows], np.ones(rows.stop - rows.start, bool))
            found = self._simulator.gauss_newton(self._batch(z, i), measured, self._weights[rows], unknowns=unknowns)
            places = self._places(i)
            cost += found.cost
            gradient[:, places] += found.gradient
            matrix[:, places[:, None], places] += found.normal_matrix
        return cost, gradient, matrix

    def trajectories(self, z: FloatArray) -> dict[str, FloatArray]:
        """Unmeasured states and their derivatives (N,) by name, for one vector of unknowns (n,)."""
        model, n, n_driven = self.intervals.model, len(self.hidden), len(self._driven.state)
        logs = range(self.intervals.layout.n_logs)
        series = np.concatenate([self._simulator.trajectories(self._batch(z[None], i))[0] for i in logs])
        rate_of = dict(zip(model.velocities, model.accelerations, strict=True))
        states = dict(zip(self.hidden, series[:, :n].T, strict=True))
        rates = zip(self.hidden, series[:, n_driven : n_driven + n].T, strict=True)
        return {**states, **{rate_of[name]: values for name, values in rates if name in rate_of}}


def _least_squares(problem: _DrivenStates, z: FloatArray, n_steps: int) -> tuple[FloatArray, FloatArray]:
    """Unknowns (n_starts, n) and costs (n_starts,) after steps of Levenberg and Marquardt from every start."""
    (cost, gradient, matrix), damping = problem.linearized(z), np.full(len(z), _DAMPING)
    for _ in range(n_steps):
        scale = np.sqrt(np.einsum("kii->ki", matrix)) + 1e-300
        scaled = matrix / scale[:, :, None] / scale[:, None, :] + damping[:, None, None] * np.eye(z.shape[1])
        step = -np.linalg.solve(scaled, (gradient / scale)[:, :, None])[:, :, 0] / scale
        trial = problem.moved(z, step)
        then = problem.linearized(trial)
        better = then[0] < cost
        settled = better & (cost - then[0] < _CONVERGED * cost) | (damping >= _DAMPING_BOUNDS[1])
        z = np.where(better[:, None], trial, z)
        cost, gradient, matrix = (
            np.where(better.reshape(-1, *(1,) * (x.ndim - 1)), y, x)
            for x, y in zip((cost, gradient, matrix), then, strict=True)
        )
        damping = np.clip(np.where(better, _LESS, _MORE) * damping, *_DAMPING_BOUNDS)
        if settled.all():
            break
    return z, cost
