"""Observers of all states that follow samples, and become simulations as their bandwidth falls.

A measured coordinate y corrects a critically damped observer, ``q' = v + 2 b (y - q)`` and
``v' = a(q, v, u, p) + b^2 (y - q)``; a measured velocity, or state of first order, is corrected by ``b (y - v)``.
Unmeasured states are simulated.

Under a high bandwidth b the observers follow whatever the parameters are, and least squares of their errors has few
local optima; under a low one they are simulations of the whole log.  Nothing is smoothed, so that a resonance whose
frequency smoothing takes for noise has its effect.

References
----------
Ljung 1999, section 7 (prediction errors of observers); Abarbanel, Creveling, Farsian, Kostuk 2009, "Dynamical state and
parameter estimation" (a coupling to the data that is lowered gradually).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.identification.regression.multistart import SearchOverLogs, held_means, within_half_a_turn
from diransac.identification.regression.nonlinear import ParameterChart
from diransac.model import Model, Parameter
from diransac.simulation import RolloutBatch, Simulator, rollouts

if TYPE_CHECKING:
    from diransac.data.dataset import ParameterLayout
    from diransac.model.derivation import Symbols

__all__ = ["Observers"]

# Starts at most and at least, and numbers of all rows and pairs of unknowns of all starts in between.
_N_STARTS, _FEWEST_STARTS, _NUMBERS = 256, 16, 200_000_000


@lru_cache(maxsize=16)
def _observer_model(model: Model, sampled: tuple[str, ...]) -> Model:
    """All states of a model as states of first order, with corrections; inputs are the samples and its inputs."""
    names = [f"observed_{i}" for i in range(len(model.state))]
    coordinate_of = {chain[1]: chain[0] for chain in model.chains if chain[0] in model.coordinates and len(chain) > 1}
    place = model.state.index

    def arguments(v: Symbols, u: Symbols, p: Symbols) -> tuple[ca.SX, ca.SX, ca.SX]:
        applied, parameters = (
            ca.vertcat(*(z[n] for n in group)) for z, group in ((u, model.inputs), (p, model.parameters))
        )
        return ca.vertcat(*(v[n] for n in names)), applied, parameters

    def correction(name: str, x: ca.SX, u: Symbols, b: ca.SX) -> ca.SX:
        if name in sampled:
            return (2.0 if name in coordinate_of.values() else 1.0) * b * (u[name] - x[place(name)])
        source = coordinate_of.get(name)
        return b**2 * (u[source] - x[place(source)]) if source in sampled else ca.SX(0)

    def equations(_q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        x, applied, parameters = arguments(v, u, p)
        rates = model.dynamics(x, applied, parameters)[0]
        corrections = [correction(n, x, u, p.bandwidth_) for n in model.state]
        return list(ca.vertsplit(ca.vertcat(*a) - rates - ca.vertcat(*corrections)))

    def of_sensors(_q: Symbols, v: Symbols, _a: Symbols, u: Symbols, p: Symbols) -> list[ca.SX]:
        x, applied, parameters = arguments(v, u, p)
        return [x[: model.n_q], x[model.n_q :], model.dynamics(x, applied, parameters)[1], applied, parameters]

    return Model(
        f"{model.name}, observed",
        {},
        {**{n: model.units[n] for n in sampled}, **model.inputs},
        {**model.parameters, "bandwidth_": Parameter("1/s", positive=True)},
        equations,
        first_order={name: model.units[n] for name, n in zip(names, model.state, strict=True)},
        sensors=model.sensors_of(of_sensors),
    )


@dataclass(frozen=True)
class Observers(SearchOverLogs):
    """Least squares of the errors of observers: all states begin anywhere, parameters are unknown.

    Parameters
    ----------
    model : Model
    layout : ParameterLayout
        Positions of each log's parameters.
    sampled : tuple of str
        States that have samples, in the model's order.
    samples : (N, n) array
        Of these, in all rows of all logs; where none was taken, or a wrong one, another estimate.
    inputs : (N, n_u) array
    readings : (N, n_y) array
        Sensors of the model in all rows; those of weight 0 are not used.
    weights : (N, n + n_y) array
        Of the errors of sampled states, then of sensors; one over their unit squared, 0 where no sample was taken.
    begin : (n_logs, n_x) array
        States from which the search starts at the beginning of each log.
    rows_of_logs : sequence of slice
        Rows of each log.
    dt : float
        Sampling time, s.
    bandwidth : float
        1/s.
    substeps : int, optional
        Integration steps per sample.
    """

    model: Model
    layout: ParameterLayout
    sampled: tuple[str, ...]
    samples: FloatArray
    inputs: FloatArray
    readings: FloatArray
    weights: FloatArray
    begin: FloatArray
    rows_of_logs: Sequence[slice]
    dt: float
    bandwidth: float
    substeps: int = 2

    @cached_property
    def _observer(self) -> Model:
        return _observer_model(self.model, self.sampled)

    @cached_property
    def _simulator(self) -> Simulator:
        compared = [self._observer.state[self.model.state.index(n)] for n in self.sampled]
        return rollouts(self._observer, (*compared, *self._observer.sensors), substeps=self.substeps)

    @cached_property
    def _inputs(self) -> FloatArray:
        """Inputs (N, n) of the observers."""
        return np.hstack([held_means(self.samples, self.rows_of_logs), self.inputs])

    @property
    def _n_parameters(self) -> int:
        return len(self.layout)

    @cached_property
    def _unknowns(self) -> tuple[str, ...]:
        return (*self.model.parameters, *self._observer.state)

    @cached_property
    def _compared(self) -> FloatArray:
        return np.hstack([self.samples, self.readings])

    def starts(self) -> FloatArray:
        """Unknowns (n_starts, n) to start from: parameters over the bounds or six decades; fewer of larger problems."""
        chart, n = ParameterChart(self.layout.bounds), len(self.layout) + self.begin.size
        n_starts = int(np.clip(_NUMBERS // (len(self.samples) * n**2), _FEWEST_STARTS, _N_STARTS))
        return np.hstack([chart.to_parameters(chart.starts(n_starts)), np.tile(self.begin.ravel(), (n_starts, 1))])

    def _places(self, log: int) -> IntArray:
        """Places of a log's parameters and initial states among the unknowns."""
        n = len(self.model.state)
        return np.concatenate([self.layout.index[log], len(self.layout) + n * log + np.arange(n)])

    def _batch(self, z: FloatArray, log: int) -> RolloutBatch:
        """Lanes of a log, one per vector of unknowns (n_starts, n)."""
        rows, own, n = self.rows_of_logs[log], z[:, self._places(log)], len(self.model.state)
        parameters = np.hstack([own[:, :-n], np.full((len(z), 1), self.bandwidth)])
        return RolloutBatch(parameters, own[:, -n:], self._inputs[rows], self.dt)

    def trajectories(self, z: FloatArray) -> dict[str, FloatArray]:
        """States and accelerations (N,) by name, for one vector of unknowns (n,).

        Of unsampled angles that are the same after a whole turn, those that start within half a turn of zero.
        """
        model, n, logs = self.model, len(self.model.state), range(len(self.rows_of_logs))
        series = np.concatenate([self._simulator.trajectories(self._batch(z[None], i))[0] for i in logs])
        states = dict(zip(model.state, series[:, :n].T.copy(), strict=True))
        hidden = {name: x for name, x in states.items() if name not in self.sampled}
        within_half_a_turn(model, hidden, self.rows_of_logs)
        rates = dict(zip(model.state, series[:, n : 2 * n].T, strict=True))
        derivatives = zip(model.velocities, model.accelerations, strict=True)
        return {**states, **{a: rates[v] for v, a in derivatives}}
