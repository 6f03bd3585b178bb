"""States that no signal measures, simulated from their own equations and driven by all other states.

An observer compares the accelerations that the equations give to the other velocities with their motion,
``e' = a(q, v, u, p) + b (v - e)``: the error ``e - v`` is that of the acceleration, low-pass filtered with bandwidth b.
Measured sensors are compared with their equations.  Initial values, and parameters where these are unknown, are those
of least squares (Levenberg-Marquardt), from many starts, which are lanes of one batch.

References
----------
Ljung 1999, section 7 (prediction errors of observers); Marquardt 1963; Boender, Rinnooy Kan 1987 (random starts).
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

__all__ = ["DrivenStates"]

_N_STARTS = 256


@lru_cache(maxsize=16)
def _driven_model(model: Model, hidden: tuple[str, ...], observed: tuple[str, ...]) -> Model:
    """States that obey a model's equations, driven by the other ones, and an observer of each observed velocity.

    All are states of first order, in this order; inputs are the other states of the model, and its inputs.  Sensors are
    those of the model, with the accelerations of its equations.
    """
    names = [f"driven_{i}" for i in range(len(hidden) + len(observed))]
    known = {n: model.units[n] for n in model.state if n not in hidden}
    rows = [model.state.index(n) for n in (*hidden, *observed)]

    def arguments(v: Symbols, u: Symbols, p: Symbols) -> tuple[ca.SX, ca.SX, ca.SX]:
        of_hidden = dict(zip(hidden, v, strict=False))
        x = ca.vertcat(*(of_hidden[n] if n in of_hidden else u[n] for n in model.state))
        applied, parameters = (
            ca.vertcat(*(z[n] for n in group)) for z, group in ((u, model.inputs), (p, model.parameters))
        )
        return x, applied, parameters

    def equations(_q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        rates = model.dynamics(*arguments(v, u, p))[0][rows]
        pull = [p.bandwidth_ * (u[n] - e) for n, e in zip(observed, list(v)[len(hidden) :], strict=True)]
        return list(ca.vertsplit(ca.vertcat(*a) - rates - ca.vertcat(ca.SX(len(hidden), 1), *pull)))

    def of_sensors(_q: Symbols, v: Symbols, _a: Symbols, u: Symbols, p: Symbols) -> list[ca.SX]:
        x, applied, parameters = arguments(v, u, p)
        accelerations = model.dynamics(x, applied, parameters)[1]
        return [x[: model.n_q], x[model.n_q :], accelerations, applied, parameters]

    return Model(
        f"{model.name}, driven by its measured motion",
        {},
        {**known, **model.inputs},
        {**model.parameters, "bandwidth_": Parameter("1/s", positive=True)},
        equations,
        first_order={name: model.units[n] for name, n in zip(names, (*hidden, *observed), strict=True)},
        sensors=model.sensors_of(of_sensors),
    )


@dataclass(frozen=True)
class DrivenStates(SearchOverLogs):
    """Least squares of the errors of observers and sensors: states that nothing measures, driven by those of logs.

    Unknown are the parameters, if they are not given, and the unmeasured states at the beginning of every log.

    Parameters
    ----------
    model : Model
    layout : ParameterLayout
        Positions of each log's parameters.
    hidden : tuple of str
        States that nothing measures.
    states : (N, n_x) array
        States of the model in all rows of all logs; those that are hidden are not used.
    inputs : (N, n_u) array
    readings : (N, n_y) array
        Sensors of the model in all rows; those of weight 0 are not used.
    weights : (N, n + n_y) array
        Weight of the error of each velocity that is not hidden, then of each sensor; one over its unit squared.
    rows_of_logs : sequence of slice
        Rows of each log.
    dt : float
        Sampling time, s.
    bandwidth : float
        Bandwidth of the observers, 1/s.
    parameters : (n_p,) array, optional
        Known parameters.
    substeps : int, optional
        Integration steps per sample.
    """

    model: Model
    layout: ParameterLayout
    hidden: tuple[str, ...]
    states: FloatArray
    inputs: FloatArray
    readings: FloatArray
    weights: FloatArray
    rows_of_logs: Sequence[slice]
    dt: float
    bandwidth: float
    parameters: FloatArray | None = None
    substeps: int = 2

    @cached_property
    def _observed(self) -> tuple[str, ...]:
        return tuple(n for n in self.model.velocities if n not in self.hidden)

    @cached_property
    def _driven(self) -> Model:
        return _driven_model(self.model, self.hidden, self._observed)

    @cached_property
    def _simulator(self) -> Simulator:
        compared = (*self._driven.state[len(self.hidden) :], *self._driven.sensors)
        return rollouts(self._driven, compared, substeps=self.substeps)

    @cached_property
    def _inputs(self) -> FloatArray:
        """Inputs (N, n) of the driven model; they are held from row to row, so that means of the states are taken."""
        known = [i for i, n in enumerate(self.model.state) if n not in self.hidden]
        return np.hstack([held_means(self.states, self.rows_of_logs)[:, known], self.inputs])

    @cached_property
    def _velocities(self) -> FloatArray:
        """Velocities (N, n) that are observed."""
        return self.states[:, [self.model.state.index(n) for n in self._observed]]

    @property
    def _n_parameters(self) -> int:
        return len(self.layout) if self.parameters is None else 0

    @cached_property
    def _unknowns(self) -> tuple[str, ...]:
        free = self.model.parameters if self.parameters is None else ()
        return (*free, *self._driven.state[: len(self.hidden)])

    @cached_property
    def _compared(self) -> FloatArray:
        return np.hstack([self._velocities, self.readings])

    def starts(self) -> FloatArray:
        """Unknowns (n_starts, n) to start from: parameters over the bounds or six decades, states zero.

        A quaternion starts at (1, 0, 0, 0).
        """
        scalars = [self.model.state[four[0]] for four in self.model.quaternions]
        states = np.tile([float(name in scalars) for name in self.hidden], self.layout.n_logs)
        if self.parameters is not None:
            return states[None]
        chart = ParameterChart(self.layout.bounds)
        return np.hstack([chart.to_parameters(chart.starts(_N_STARTS)), np.tile(states, (_N_STARTS, 1))])

    def _places(self, log: int) -> IntArray:
        """Places of a log's parameters and initial states among the unknowns."""
        n = len(self.hidden)
        own = self.layout.index[log] if self.parameters is None else np.arange(0)
        return np.concatenate([own, self._n_parameters + n * log + np.arange(n)])

    def _batch(self, z: FloatArray, log: int) -> RolloutBatch:
        """Lanes of a log, one per vector of unknowns (n_starts, n)."""
        rows, own, n = self.rows_of_logs[log], z[:, self._places(log)], len(self.hidden)
        parameters = own[:, :-n] if self.parameters is None else np.tile(self.parameters, (len(z), 1))
        bandwidth = np.full((len(z), 1), self.bandwidth)
        observed = np.tile(self._velocities[rows.start], (len(z), 1))
        states = np.hstack([own[:, -n:], observed])
        return RolloutBatch(np.hstack([parameters, bandwidth]), states, self._inputs[rows], self.dt)

    def trajectories(self, z: FloatArray) -> dict[str, FloatArray]:
        """Unmeasured states and their derivatives (N,) by name, for one vector of unknowns (n,).

        Of angles that are the same after a whole turn, those that start within half a turn of zero.
        """
        model, n, n_driven = self.model, len(self.hidden), len(self._driven.state)
        logs = range(len(self.rows_of_logs))
        series = np.concatenate([self._simulator.trajectories(self._batch(z[None], i))[0] for i in logs])
        rate_of = dict(zip(model.velocities, model.accelerations, strict=True))
        states = dict(zip(self.hidden, series[:, :n].T.copy(), strict=True))
        within_half_a_turn(model, states, self.rows_of_logs)
        rates = zip(self.hidden, series[:, n_driven : n_driven + n].T, strict=True)
        return {**states, **{rate_of[name]: values for name, values in rates if name in rate_of}}
