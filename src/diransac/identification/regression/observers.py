"""Observers that follow samples: least squares of simulations for states that nothing measures, and for parameters.

`driven_states` are states that no signal measures, simulated from their own equations and driven by all other states.
An observer compares the accelerations that the equations give to the other velocities with their motion,
``e' = a(q, v, u, p) + b (v - e)``: the error ``e - v`` is that of the acceleration, low-pass filtered with bandwidth b.

`observers` are of all states, and become simulations as their bandwidth falls.  A measured coordinate y corrects a
critically damped observer, ``q' = v + 2 b (y - q)`` and ``v' = a(q, v, u, p) + b^2 (y - q)``; a measured velocity, or
state of first order, is corrected by ``b (y - v)``.  Under a high bandwidth b they follow whatever the parameters are,
and least squares of their errors has few local optima; under a low one they are simulations of the whole log.  Nothing
is smoothed, so that a resonance whose frequency smoothing takes for noise has its effect.

Measured sensors are compared with their equations.  Initial values and unknown parameters are those of least squares
from many starts (`multistart`).

References
----------
Ljung 1999, section 7 (prediction errors of observers); Abarbanel, Creveling, Farsian, Kostuk 2009, "Dynamical state and
parameter estimation" (a coupling to the data that is lowered gradually).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
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

_N_STARTS, _OF_ONE = 256, 4
"""Starts at most, and for one parameter: so many to the power of their number."""
# Rows of all logs that are enough to find starts, and of each of many; numbers of all rows and pairs of unknowns of all
# starts at most.
_ENOUGH, _ENOUGH_OF_ONE, _NUMBERS = 2000, 500, 200_000_000
# Relative decrease of the cost in a step from which on a start goes on.
_CREEPING = 1e-5
_TURN = 2.0 * np.pi


def _observer_model(
    model: Model,
    followed: Sequence[str],
    driving: Sequence[str],
    state_of: Callable[[Symbols, Symbols], ca.SX],
    corrections: Callable[[ca.SX, Sequence[ca.SX], Symbols, ca.SX], Sequence[ca.SX]],
) -> Model:
    """Observers of some states of a model as states of first order, in this order, with corrections of their rates.

    Inputs are samples of the driving states, and the model's inputs.  Sensors are those of the model, with the
    accelerations of its equations.
    """
    rows = [model.state.index(n) for n in followed]

    def arguments(v: Symbols, u: Symbols, p: Symbols) -> tuple[ca.SX, ca.SX, ca.SX]:
        applied, parameters = (
            ca.vertcat(*(z[n] for n in group)) for z, group in ((u, model.inputs), (p, model.parameters))
        )
        return state_of(v, u), applied, parameters

    def equations(_q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        x, applied, parameters = arguments(v, u, p)
        rates = model.dynamics(x, applied, parameters)[0][rows]
        pull = corrections(x, list(v), u, p.bandwidth_)
        return list(ca.vertsplit(ca.vertcat(*a) - rates - ca.vertcat(*pull)))

    def of_sensors(_q: Symbols, v: Symbols, _a: Symbols, u: Symbols, p: Symbols) -> list[ca.SX]:
        x, applied, parameters = arguments(v, u, p)
        return [x[: model.n_q], x[model.n_q :], model.dynamics(x, applied, parameters)[1], applied, parameters]

    return Model(
        f"{model.name}, observed",
        {},
        {**{n: model.units[n] for n in driving}, **model.inputs},
        {**model.parameters, "bandwidth_": Parameter("1/s", positive=True)},
        equations,
        first_order={f"observed_{i}": model.units[n] for i, n in enumerate(followed)},
        sensors=model.sensors_of(of_sensors),
    )


@lru_cache(maxsize=16)
def _driven_model(model: Model, hidden: tuple[str, ...], observed: tuple[str, ...]) -> Model:
    """States that obey a model's equations, driven by the other ones, and an observer of each observed velocity."""

    def state_of(v: Symbols, u: Symbols) -> ca.SX:
        of_hidden = dict(zip(hidden, v, strict=False))
        return ca.vertcat(*(of_hidden[n] if n in of_hidden else u[n] for n in model.state))

    def corrections(_x: ca.SX, v: Sequence[ca.SX], u: Symbols, b: ca.SX) -> list[ca.SX]:
        pull = [b * (u[n] - e) for n, e in zip(observed, v[len(hidden) :], strict=True)]
        return [ca.SX(len(hidden), 1), *pull]

    known = [n for n in model.state if n not in hidden]
    return _observer_model(model, (*hidden, *observed), known, state_of, corrections)


@lru_cache(maxsize=16)
def _whole_model(model: Model, sampled: tuple[str, ...]) -> Model:
    """Observers of all states of a model, which samples correct."""
    coordinate_of = {chain[1]: chain[0] for chain in model.chains if chain[0] in model.coordinates and len(chain) > 1}
    place = model.state.index

    def state_of(v: Symbols, _u: Symbols) -> ca.SX:
        return ca.vertcat(*list(v))

    def correction(name: str, x: ca.SX, u: Symbols, b: ca.SX) -> ca.SX:
        if name in sampled:
            return (2.0 if name in coordinate_of.values() else 1.0) * b * (u[name] - x[place(name)])
        source = coordinate_of.get(name)
        return b**2 * (u[source] - x[place(source)]) if source in sampled else ca.SX(0)

    def corrections(x: ca.SX, _v: Sequence[ca.SX], u: Symbols, b: ca.SX) -> list[ca.SX]:
        return [correction(n, x, u, b) for n in model.state]

    return _observer_model(model, model.state, sampled, state_of, corrections)


@dataclass(frozen=True)
class ObserverFit:
    """Least squares of observers of all logs; unknown are parameters, and states at the beginning of every log.

    Made by `driven_states` and `observers`.

    Parameters
    ----------
    model : Model
    layout : ParameterLayout
        Positions of each log's parameters, which come first among the unknowns.
    observer : Model
        The model that is simulated.
    found : tuple of str
        States of the model that its first states are; their values at the beginning of every log are unknown.
    compared : tuple of str
        States of the observer that are compared with samples.
    samples : (N, n) array
        Of these, in all rows of all logs.
    driving : (N, n_d) array
        Samples that are inputs of the observer.
    begin : (n_logs, n_found) array
        States to start from.
    inputs : (N, n_u) array
    readings : (N, n_y) array
        Sensors of the model in all rows; those of weight 0 are not used.
    weights : (N, n + n_y) array
        Of the errors of the observed states, then of sensors.
    rows_of_logs : sequence of slice
        Rows of each log.
    dt, bandwidth : float
        s, and 1/s.
    substeps : int
        Integration steps per sample.
    parameters : (n_p,) array, optional
        Known parameters.
    """

    model: Model
    layout: ParameterLayout
    observer: Model
    found: tuple[str, ...]
    compared: tuple[str, ...]
    samples: FloatArray
    driving: FloatArray
    begin: FloatArray
    inputs: FloatArray
    readings: FloatArray
    weights: FloatArray
    rows_of_logs: Sequence[slice]
    dt: float
    bandwidth: float
    substeps: int
    parameters: FloatArray | None = None

    @cached_property
    def _simulator(self) -> Simulator:
        return rollouts(self.observer, (*self.compared, *self.observer.sensors), substeps=self.substeps)

    @cached_property
    def _inputs(self) -> FloatArray:
        """Inputs (N, n) of the observer; they are held from row to row, so that means of the samples are taken."""
        means = self.driving.copy()
        for rows in self.rows_of_logs:
            means[rows][:-1] = 0.5 * (self.driving[rows][1:] + self.driving[rows][:-1])
        return np.hstack([means, self.inputs])

    @property
    def _n_parameters(self) -> int:
        return len(self.layout) if self.parameters is None else 0

    def starts(self) -> FloatArray:
        """Unknowns (n_starts, n) to start from: parameters over the bounds or six decades, with one set of states."""
        if self.parameters is not None:
            return self.begin.reshape(1, -1)
        # Fewer starts of larger problems.
        n_rows, n_unknowns = sum(x.stop - x.start for x in self.rows_of_logs), len(self.layout) + self.begin.size
        n = min(_N_STARTS, _OF_ONE ** len(self.layout), _NUMBERS // (n_rows * n_unknowns**2))
        chart = ParameterChart(self.layout.bounds)
        return self._begun(chart.to_parameters(chart.starts(max(16, n))))

    def _begun(self, z: FloatArray) -> FloatArray:
        """Unknowns with the parameters of others, and the states to start from."""
        return np.hstack([z[:, : self._n_parameters], np.tile(self.begin.reshape(1, -1), (len(z), 1))])

    def best_starts(self, steps: Sequence[tuple[int, int]]) -> FloatArray:
        """Unknowns ``(k, n)`` after steps from all starts, the best first; over a stretch of each long log.

        Parameters
        ----------
        steps : sequence of (int, int)
            Numbers of steps, and of those that go on from there.
        """
        n_rows = sum(x.stop - x.start for x in self.rows_of_logs)
        some = self if n_rows <= _ENOUGH else self._on_stretches(_ENOUGH / n_rows)
        z = some.starts()
        for n_steps, n_kept in steps:
            z, cost = least_squares(some, z, n_steps, _CREEPING)
            z = z[np.argsort(cost, kind="stable")[:n_kept]]
        return z if some.rows_of_logs == self.rows_of_logs else self._begun(z)

    def _on_stretches(self, part: float) -> ObserverFit:
        """The same on a part of each log, in which its inputs change most; samples are where states start from."""
        rows_of_logs, begin, size = [], self.begin.copy(), self.inputs.std(axis=0)
        steps = np.square(np.diff(self.inputs, axis=0) / size_or_one(size)).sum(axis=1)
        steps *= self._near_samples[1:]
        states = [self.observer.state.index(n) for n in self.compared]
        sampled = [(i, j) for j, i in enumerate(states) if i < len(self.found)]
        for start, rows in zip(begin, self.rows_of_logs, strict=True):
            length = rows.stop - rows.start
            n = min(length, max(round(part * length), _ENOUGH_OF_ONE))
            total = np.concatenate([[0.0], np.cumsum(steps[rows.start : rows.stop - 1])])
            first = rows.start + int(np.argmax(total[n - 1 :] - total[: length - n + 1]))
            rows_of_logs.append(slice(first, first + n))
            for i, j in sampled:
                start[i] = self.samples[first, j]
        return replace(self, rows_of_logs=rows_of_logs, begin=begin)

    @property
    def _near_samples(self) -> FloatArray:
        """1 for rows ``(N,)`` of a usual sampling time about a sample that counts, else 0."""
        seen = np.flatnonzero(self.weights.any(axis=1))
        apart = int(np.median(np.diff(seen))) if len(seen) > 1 else 1
        near = np.zeros(len(self.weights) + 2 * apart)
        for k in range(2 * apart + 1):
            near[seen + k] = 1.0
        return near[apart : len(self.weights) + apart]

    def _places(self, log: int) -> IntArray:
        """Places of a log's parameters and initial states among the unknowns."""
        n = len(self.found)
        own = self.layout.index[log] if self.parameters is None else np.arange(0)
        return np.concatenate([own, self._n_parameters + n * log + np.arange(n)])

    def _batch(self, z: FloatArray, log: int) -> RolloutBatch:
        """Lanes of a log, one per vector of unknowns (n_starts, n); states that are not unknown start at samples."""
        rows, own, n = self.rows_of_logs[log], z[:, self._places(log)], len(self.found)
        parameters = own[:, :-n] if self.parameters is None else np.tile(self.parameters, (len(z), 1))
        bandwidth = np.full((len(z), 1), self.bandwidth)
        samples = self.samples[rows.start][: len(self.observer.state) - n]
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
        unknowns = (*free, *self.observer.state[: len(self.found)])
        for i, rows in enumerate(self.rows_of_logs):
            places, batch = self._places(i), self._batch(z, i)
            compared = np.hstack([self.samples[rows], self.readings[rows]])
            measured = Measurements(compared, np.ones(len(compared), bool))
            found = self._simulator.gauss_newton(batch, measured, self.weights[rows], unknowns=unknowns)
            cost += found.cost
            gradient[:, places] += found.gradient
            matrix[:, places[:, None], places] += found.normal_matrix
        return cost, gradient, matrix

    def trajectories(self, z: FloatArray) -> dict[str, FloatArray]:
        """States and their derivatives (N,) by name, for one vector of unknowns (n,).

        Of unsampled angles that are the same after a whole turn, those that start within half a turn of zero.
        """
        model, n, n_all = self.model, len(self.found), len(self.observer.state)
        logs = range(len(self.rows_of_logs))
        series = np.concatenate([self._simulator.trajectories(self._batch(z[None], i))[0] for i in logs])
        states = dict(zip(self.found, series[:, :n].T.copy(), strict=True))
        sampled = self.observer.inputs
        _within_half_a_turn(model, {name: x for name, x in states.items() if name not in sampled}, self.rows_of_logs)
        rate_of = dict(zip(model.velocities, model.accelerations, strict=True))
        rates = zip(self.found, series[:, n_all : n_all + n].T, strict=True)
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
    observed = tuple(n for n in model.velocities if n not in hidden)
    observer, scalars = _driven_model(model, hidden, observed), [model.state[four[0]] for four in model.quaternions]
    samples = states[:, [model.state.index(n) for n in observed]]
    driving = states[:, [i for i, n in enumerate(model.state) if n not in hidden]]
    begin, compared = np.tile([float(n in scalars) for n in hidden], (layout.n_logs, 1)), observer.state[len(hidden) :]
    shown = (inputs, readings, weights, rows_of_logs, dt, bandwidth, substeps)
    return ObserverFit(model, layout, observer, hidden, compared, samples, driving, begin, *shown, parameters)


def observers(
    model: Model,
    layout: ParameterLayout,
    sampled: tuple[str, ...],
    samples: FloatArray,
    inputs: FloatArray,
    readings: FloatArray,
    weights: FloatArray,
    begin: FloatArray,
    rows_of_logs: Sequence[slice],
    dt: float,
    bandwidth: float,
    substeps: int = 2,
) -> ObserverFit:
    """Least squares of observers of all states, which begin anywhere; parameters are unknown.

    Parameters
    ----------
    model, layout, inputs, readings, weights, rows_of_logs, dt, bandwidth, substeps
        As `ObserverFit`; weights are of the sampled states, 0 where no sample was taken.
    sampled : tuple of str
        States that have samples, in the model's order.
    samples : (N, n) array
        Of these, in all rows of all logs; where none was taken, or a wrong one, another estimate.
    begin : (n_logs, n_x) array
        States from which the search starts at the beginning of each log.
    """
    observer = _whole_model(model, sampled)
    compared = tuple(observer.state[model.state.index(name)] for name in sampled)
    shown = (inputs, readings, weights, rows_of_logs, dt, bandwidth, substeps)
    of_all = (model, layout, observer, model.state, compared, samples, samples, begin)
    return ObserverFit(*of_all, *shown)


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
        turned[k] += _TURN
        after = np.array(equations(turned, *points[1:]))
        return np.allclose(before, after, rtol=1e-9, atol=1e-9, equal_nan=True)

    return frozenset(n for k, n in enumerate(model.coordinates) if model.units[n] == "rad" and is_free(k))


def _within_half_a_turn(model: Model, states: Mapping[str, FloatArray], rows_of_logs: Sequence[slice]) -> None:
    """Move angles that are the same after a whole turn, in place: each log starts within half a turn of zero."""
    for name in _free_of_turns(model).intersection(states):
        for rows in rows_of_logs:
            states[name][rows] -= _TURN * np.rint(states[name][rows.start] / _TURN)
