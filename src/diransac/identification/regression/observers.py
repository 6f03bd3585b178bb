"""Observers that follow samples: least squares of simulations for states that nothing measures, and for parameters.

An observer simulates states x of a model with corrections by samples y.  Of a coordinate with a velocity it is
critically damped, ``q' = v + 2 b (y - q)`` and ``v' = a(x, u, p) + b^2 (y - q)``; a measured velocity, or state of
first order, is corrected by ``b (y - v)``.

Those of all states become simulations as their bandwidth b falls: under a high one they follow whatever the parameters
are, and least squares of their errors has few local optima; under a low one they are simulations of the whole log.
Nothing is smoothed, so that a resonance whose frequency smoothing takes for noise has its effect.  `driven_states`
simulate the states that nothing measures alone, driven by samples of the others; errors of the other velocities are
those of their accelerations, low-pass filtered.

Measured sensors are compared with their equations.  Initial values and unknown parameters are those of least squares
from many starts (`multistart`).

References
----------
Ljung 1999, section 7 (prediction errors of observers); Abarbanel, Creveling, Farsian, Kostuk 2009, "Dynamical state and
parameter estimation" (a coupling to the data that is lowered gradually).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray, IntArray, size_or_one
from diransac.data.dataset import ParameterLayout
from diransac.identification.regression.multistart import least_squares
from diransac.identification.regression.nonlinear import ParameterChart
from diransac.model import Model, Parameter
from diransac.model.derivation import Symbols
from diransac.simulation import Measurements, RolloutBatch, Simulator, rollouts

STRETCH = 2000
"""Rows of all logs that are enough to find starts; a quarter of it of each of many logs."""
NUMBERS = 200_000_000
"""Rows times pairs of unknowns times starts at most, which bounds the time of a step."""


@lru_cache(maxsize=32)
def _observer(model: Model, free: tuple[str, ...], observed: tuple[str, ...], sampled: tuple[str, ...]) -> Model:
    """Observers of some states, in this order, as states of first order, corrected by samples, which are inputs.

    Equations take the free ones as they are simulated, and samples of all others.  Sensors are those of the model, with
    the accelerations of its equations.
    """
    simulated = (*free, *observed)
    rows = [model.state.index(n) for n in simulated]
    coordinate_of = {chain[1]: chain[0] for chain in model.chains if chain[0] in model.coordinates and len(chain) > 1}

    def arguments(v: Symbols, u: Symbols, p: Symbols) -> tuple[ca.SX, ca.SX, ca.SX]:
        of_free = dict(zip(free, v, strict=False))
        x = [of_free[n] if n in of_free else u[n] for n in model.state]
        acting, parameters = [u[n] for n in model.inputs], [p[n] for n in model.parameters]
        return ca.vertcat(*x), ca.vertcat(*acting), ca.vertcat(*parameters)

    def correction(name: str, x: Mapping[str, ca.SX], u: Symbols, b: ca.SX) -> ca.SX:
        if name in sampled:
            return (2.0 if name in coordinate_of.values() else 1.0) * b * (u[name] - x[name])
        source = coordinate_of.get(name)
        return b**2 * (u[source] - x[source]) if source in sampled and source in x else ca.SX(0)

    def equations(_q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        states, acting, parameters = arguments(v, u, p)
        rates, x = model.dynamics(states, acting, parameters)[0][rows], dict(zip(simulated, v, strict=True))
        pull = [correction(n, x, u, p.bandwidth_) for n in simulated]
        return list(ca.vertsplit(ca.vertcat(*a) - rates - ca.vertcat(*pull)))

    def of_sensors(_q: Symbols, v: Symbols, _a: Symbols, u: Symbols, p: Symbols) -> list[ca.SX]:
        x, acting, parameters = arguments(v, u, p)
        return [x[: model.n_q], x[model.n_q :], model.dynamics(x, acting, parameters)[1], acting, parameters]

    return Model(
        f"{model.name}, observed",
        {},
        {**{n: model.units[n] for n in sampled}, **model.inputs},
        {**model.parameters, "bandwidth_": Parameter("1/s", positive=True)},
        equations,
        first_order={f"observed_{i}": model.units[n] for i, n in enumerate(simulated)},
        sensors=model.sensors_of(of_sensors),
    )


@dataclass(frozen=True)
class ObserverFit:
    """Least squares of observers of all logs; unknown are parameters, and states at the beginning of every log.

    Parameters
    ----------
    model : Model
    layout : ParameterLayout
        Positions of each log's parameters, which come first among the unknowns.
    free : tuple of str
        States of the model that are simulated; their values at the beginning of every log are unknown.
    observed : tuple of str
        Further velocities with an observer, on which no other state depends; they start at samples.
    sampled : tuple of str
        States that have samples, in the model's order.  Those that are simulated are compared with them.
    samples : (N, n) array
        Of these, in all rows of all logs; where none was taken, or a wrong one, another estimate.
    begin : (n_logs, n_free) array
        States to start from.
    inputs : (N, n_u) array
    readings : (N, n_y) array
        Sensors of the model in all rows; those of weight 0 are not used.
    weights : (N, n + n_y) array
        Of the errors of the states that are compared, in the order of their simulation, then of sensors.
    rows_of_logs : sequence of slice
        Rows of each log.
    dt, bandwidth : float
        s, and 1/s.
    substeps : int, optional
        Integration steps per sample.
    parameters : (n_p,) array, optional
        Known parameters.
    """

    model: Model
    layout: ParameterLayout
    free: tuple[str, ...]
    observed: tuple[str, ...]
    sampled: tuple[str, ...]
    samples: FloatArray
    begin: FloatArray
    inputs: FloatArray
    readings: FloatArray
    weights: FloatArray
    rows_of_logs: Sequence[slice]
    dt: float
    bandwidth: float
    substeps: int = 2
    parameters: FloatArray | None = None

    @cached_property
    def _observer(self) -> Model:
        return _observer(self.model, self.free, self.observed, self.sampled)

    @cached_property
    def _compared(self) -> FloatArray:
        """Samples and readings ``(N, n + n_y)`` with which simulations are compared."""
        columns = [self.sampled.index(n) for n in (*self.free, *self.observed) if n in self.sampled]
        return np.hstack([self.samples[:, columns], self.readings])

    @cached_property
    def _simulator(self) -> Simulator:
        names = zip((*self.free, *self.observed), self._observer.state, strict=True)
        compared = [state for name, state in names if name in self.sampled]
        return rollouts(self._observer, (*compared, *self._observer.sensors), substeps=self.substeps)

    @cached_property
    def _inputs(self) -> FloatArray:
        """Inputs (N, n) of the observer; they are held from row to row, so that means of the samples are taken."""
        means = self.samples.copy()
        for rows in self.rows_of_logs:
            means[rows][:-1] = 0.5 * (self.samples[rows][1:] + self.samples[rows][:-1])
        return np.hstack([means, self.inputs])

    @property
    def _n_parameters(self) -> int:
        return len(self.layout) if self.parameters is None else 0

    def starts(self) -> FloatArray:
        """Unknowns (n_starts, n) to start from: parameters over the bounds or six decades, with one set of states."""
        if self.parameters is not None:
            return self.begin.reshape(1, -1)
        n_rows, n_unknowns = sum(x.stop - x.start for x in self.rows_of_logs), len(self.layout) + self.begin.size
        n = min(4 ** min(len(self.layout), 4), NUMBERS // (n_rows * n_unknowns**2))
        chart = ParameterChart(self.layout.bounds)
        return self._begun(chart.to_parameters(chart.starts(max(16, n))))

    def _begun(self, z: FloatArray) -> FloatArray:
        """Unknowns with the parameters of others, and the states to start from."""
        return np.hstack([z[:, : self._n_parameters], np.tile(self.begin.reshape(1, -1), (len(z), 1))])

    def search(self, stages: Sequence[tuple[float, int, int]]) -> tuple[ObserverFit, FloatArray]:
        """The fit with the last bandwidth, and unknowns ``(k, n)`` that are simulated there, the best first.

        Parameters
        ----------
        stages : sequence of (float, int, int)
            Bandwidth, 1/s, number of steps, and of the starts that go on; the first over a stretch of each long log.
        """
        problem = self.on_stretches()
        z, cost = problem.starts(), np.empty(0)
        for bandwidth, n_steps, n_kept in stages:
            # A start goes on while a step lowers its cost by so much.
            z, cost = least_squares(replace(problem, bandwidth=bandwidth), z, n_steps, 1e-5)
            best = np.argsort(cost, kind="stable")[:n_kept]
            z, cost = z[best] if problem is self else self._begun(z[best]), cost[best]
            problem = self
        return replace(self, bandwidth=stages[-1][0]), z[np.isfinite(cost)]

    def on_stretches(self) -> ObserverFit:
        """The same on a part of each long log, in which its inputs change most; samples are where states start from."""
        n_rows = sum(x.stop - x.start for x in self.rows_of_logs)
        if n_rows <= STRETCH:
            return self
        rows_of_logs, begin, seen = [], self.begin.copy(), np.flatnonzero(self.weights.any(axis=1))
        # Rows of a usual sampling time about a sample that counts.
        apart = int(np.median(np.diff(seen))) if len(seen) > 1 else 1
        near = np.convolve(np.bincount(seen, minlength=len(self.weights)), np.ones(2 * apart + 1), "same") > 0.5
        changes = np.square(np.diff(self.inputs, axis=0) / size_or_one(self.inputs.std(axis=0))).sum(axis=1) * near[1:]
        sampled = [(i, self.sampled.index(n)) for i, n in enumerate(self.free) if n in self.sampled]
        for start, rows in zip(begin, self.rows_of_logs, strict=True):
            length = rows.stop - rows.start
            n = min(length, max(round(length * STRETCH / n_rows), STRETCH // 4))
            total = np.concatenate([[0.0], np.cumsum(changes[rows.start : rows.stop - 1])])
            first = rows.start + int(np.argmax(total[n - 1 :] - total[: length - n + 1]))
            rows_of_logs.append(slice(first, first + n))
            for i, j in sampled:
                start[i] = self.samples[first, j]
        return replace(self, rows_of_logs=rows_of_logs, begin=begin)

    def _places(self, log: int) -> IntArray:
        """Places of a log's parameters and initial states among the unknowns."""
        n = len(self.free)
        own = self.layout.index[log] if self.parameters is None else np.arange(0)
        return np.concatenate([own, self._n_parameters + n * log + np.arange(n)])

    def _batch(self, z: FloatArray, log: int) -> RolloutBatch:
        """Lanes of a log, one per vector of unknowns (n_starts, n); states that are not unknown start at samples."""
        rows, own, n = self.rows_of_logs[log], z[:, self._places(log)], len(self.free)
        parameters = own[:, :-n] if self.parameters is None else np.tile(self.parameters, (len(z), 1))
        bandwidth = np.full((len(z), 1), self.bandwidth)
        samples = self._compared[rows.start][: len(self.observed)]
        states = np.hstack([own[:, -n:], np.tile(samples, (len(z), 1))])
        return RolloutBatch(np.hstack([parameters, bandwidth]), states, self._inputs[rows], self.dt)

    def moved(self, now: FloatArray, step: FloatArray) -> FloatArray:
        """Unknowns (n_starts, n) after a step within the bounds, in which logarithms of positive parameters change."""
        then, most = now + step, np.log(10.0)
        for j, bound in enumerate(self.layout.bounds[: self._n_parameters]):
            if bound.positive:
                then[:, j] = now[:, j] * np.exp(np.clip(step[:, j] / now[:, j], -most, most))
            then[:, j] = np.clip(then[:, j], bound.lower, bound.upper)
        return then

    def linearized(self, z: FloatArray, lanes: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Cost (n_starts,), infinite after a divergence, its gradient / 2 (n_starts, n), and the normal matrix."""
        cost, gradient, matrix = np.zeros(len(z)), np.zeros(z.shape), np.zeros((*z.shape, z.shape[1]))
        free = self.model.parameters if self.parameters is None else ()
        unknowns = (*free, *self._observer.state[: len(self.free)])
        for i, rows in enumerate(self.rows_of_logs):
            places, batch = self._places(i), self._batch(z, i)
            measured = Measurements(self._compared[rows], np.ones(rows.stop - rows.start, bool))
            sums = self._simulator.gauss_newton(batch, measured, self.weights[rows], unknowns=unknowns)
            cost += sums.cost
            gradient[:, places] += sums.gradient
            matrix[:, places[:, None], places] += sums.normal_matrix
        return cost, gradient, matrix

    def trajectories(self, z: FloatArray) -> dict[str, FloatArray]:
        """States and their derivatives (N,) by name, for one vector of unknowns (n,).

        Of unsampled angles that are the same after a whole turn, those that start within half a turn of zero.
        """
        model, n, n_all = self.model, len(self.free), len(self._observer.state)
        logs = range(len(self.rows_of_logs))
        series = np.concatenate([self._simulator.trajectories(self._batch(z[None], i))[0] for i in logs])
        states = dict(zip(self.free, series[:, :n].T.copy(), strict=True))
        for name in _free_of_turns(model).intersection(states).difference(self._observer.inputs):
            for rows in self.rows_of_logs:
                states[name][rows] -= 2.0 * np.pi * np.rint(states[name][rows.start] / (2.0 * np.pi))
        rate_of = dict(zip(model.velocities, model.accelerations, strict=True))
        rates = zip(self.free, series[:, n_all : n_all + n].T, strict=True)
        return {**states, **{rate_of[name]: values for name, values in rates if name in rate_of}}


def driven_states(
    model: Model,
    layout: ParameterLayout,
    hidden: tuple[str, ...],
    states: FloatArray,
    inputs: FloatArray,
    readings: FloatArray,
    weights: FloatArray,
    rows_of_logs: Sequence[slice],
    dt: float,
    bandwidth: float,
    parameters: FloatArray | None = None,
    substeps: int = 2,
) -> ObserverFit:
    """Least squares of states that nothing measures, driven by those of logs.

    Parameters
    ----------
    model, layout, inputs, readings, weights, rows_of_logs, dt, bandwidth, parameters, substeps
        As `ObserverFit`; weights are of the velocities that are not hidden.
    hidden : tuple of str
        States that nothing measures; they start at zero, a quaternion at (1, 0, 0, 0).
    states : (N, n_x) array
        States of the model in all rows of all logs; those that are hidden are not used.
    """
    observed, sampled = (tuple(n for n in names if n not in hidden) for names in (model.velocities, model.state))
    samples, scalars = (
        states[:, [model.state.index(n) for n in sampled]],
        [model.state[x[0]] for x in model.quaternions],
    )
    begin = np.tile([float(n in scalars) for n in hidden], (layout.n_logs, 1))
    shown = (inputs, readings, weights, rows_of_logs, dt, bandwidth, substeps, parameters)
    return ObserverFit(model, layout, hidden, observed, sampled, samples, begin, *shown)


@lru_cache(maxsize=64)
def _free_of_turns(model: Model) -> frozenset[str]:
    """Coordinates in rad that may gain a whole turn with no effect on the equations, tried at random points."""
    symbols = [ca.SX.sym(n, size) for n, size in model.argument_sizes.items()]
    parts = [model.residual(*symbols)]
    if model.kinematics is not None:
        parts.append(model.kinematics(*symbols[:2]))
    if model.measurement is not None:
        parts.append(model.measurement(*symbols))
    equations, rng = ca.Function("equations", symbols, [ca.vertcat(*parts)]), np.random.default_rng(0)
    points = [rng.uniform(0.5, 2.0, (x.numel(), 16)) for x in symbols]
    before = np.array(equations(*points))

    def is_free(k: int) -> bool:
        turned = points[0].copy()
        turned[k] += 2.0 * np.pi
        after = np.array(equations(turned, *points[1:]))
        return np.allclose(before, after, rtol=1e-9, atol=1e-9, equal_nan=True)

    return frozenset(n for k, n in enumerate(model.coordinates) if model.units[n] == "rad" and is_free(k))
