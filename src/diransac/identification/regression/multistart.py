"""Least squares of simulations of all logs from many starts, which are lanes of one batch (Levenberg and Marquardt).

What is simulated, and compared with what, is a subclass: states that others drive, and observers.

References
----------
Marquardt 1963; Boender, Rinnooy Kan 1987 (random starts).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Protocol

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.simulation import Measurements, RolloutBatch, Simulator
from diransac.time_limit import check_time

if TYPE_CHECKING:
    from diransac.data.dataset import ParameterLayout
    from diransac.model import Model

__all__ = ["LeastSquaresProblem", "SearchOverLogs", "held_means", "least_squares", "within_half_a_turn"]

# Largest factor of a positive parameter in a step.
_LARGEST_FACTOR = 10.0
# Points at which equations are compared after a turn, and the difference up to which they are the same.
_TURN, _N_POINTS, _SAME = 2.0 * np.pi, 16, 1e-9
# Damping at the start, its bounds, and its factors after a step down and after one up; the least gain of a step.
_DAMPING, _DAMPING_BOUNDS, _LESS, _MORE, _CONVERGED = 1e-2, (1e-9, 1e9), 0.2, 6.0, 1e-9


class LeastSquaresProblem(Protocol):
    """Sums of squares of many lanes."""

    def moved(self, now: FloatArray, step: FloatArray) -> FloatArray:
        """Unknowns (n_lanes, n) after a step, within their bounds."""

    def linearized(self, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Cost (n_lanes,), infinite after a divergence, its gradient / 2 (n_lanes, n), and the normal matrix."""


class SearchOverLogs(ABC):
    """Least squares of simulations; unknown are parameters, and states at the beginning of every log.

    Attributes
    ----------
    layout : ParameterLayout
        Positions of each log's parameters, which come first among the unknowns.
    weights : (N, n) array
        Of the signals that are compared, in all rows of all logs.
    rows_of_logs : sequence of slice
        Rows of each log.
    """

    layout: ParameterLayout
    weights: FloatArray
    rows_of_logs: Sequence[slice]

    @property
    @abstractmethod
    def _simulator(self) -> Simulator:
        """Of the signals that are compared."""

    @property
    @abstractmethod
    def _unknowns(self) -> tuple[str, ...]:
        """Names of a log's unknowns in the simulator's model."""

    @property
    @abstractmethod
    def _n_parameters(self) -> int:
        """Number of unknown parameters."""

    @property
    @abstractmethod
    def _compared(self) -> FloatArray:
        """Values (N, n) that signals are compared with."""

    @abstractmethod
    def _places(self, log: int) -> IntArray:
        """Places of a log's parameters and initial states among the unknowns."""

    @abstractmethod
    def _batch(self, z: FloatArray, log: int) -> RolloutBatch:
        """Lanes of a log, one per vector of unknowns (n_starts, n)."""

    def moved(self, now: FloatArray, step: FloatArray) -> FloatArray:
        """Unknowns (n_starts, n) after a step within the bounds, in which logarithms of positive parameters change."""
        then, most = now + step, np.log(_LARGEST_FACTOR)
        for j, bound in enumerate(self.layout.bounds[: self._n_parameters]):
            if bound.positive:
                then[:, j] = now[:, j] * np.exp(np.clip(step[:, j] / now[:, j], -most, most))
            then[:, j] = np.clip(then[:, j], bound.lower, bound.upper)
        return then

    def linearized(self, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Cost (n_starts,), infinite after a divergence, its gradient / 2 (n_starts, n), and the normal matrix."""
        cost, gradient, matrix = np.zeros(len(z)), np.zeros(z.shape), np.zeros((*z.shape, z.shape[1]))
        for i, rows in enumerate(self.rows_of_logs):
            compared, places = self._compared[rows], self._places(i)
            measured = Measurements(compared, np.ones(len(compared), bool))
            found = self._simulator.gauss_newton(
                self._batch(z, i), measured, self.weights[rows], unknowns=self._unknowns
            )
            cost += found.cost
            gradient[:, places] += found.gradient
            matrix[:, places[:, None], places] += found.normal_matrix
        return cost, gradient, matrix


def least_squares(problem: LeastSquaresProblem, z: FloatArray, n_steps: int) -> tuple[FloatArray, FloatArray]:
    """Unknowns and their costs after steps of Levenberg and Marquardt from every start.

    Parameters
    ----------
    problem : LeastSquaresProblem
    z : (n_starts, n) array
        Unknowns to start from.
    n_steps : int
        Largest number of steps.

    Returns
    -------
    z : (n_starts, n) array
    cost : (n_starts,) array
        Infinite where every simulation diverges.

    Raises
    ------
    TimeLimitError
        The time limit was reached.
    """
    (cost, gradient, matrix), damping = problem.linearized(z), np.full(len(z), _DAMPING)
    for _ in range(n_steps):
        check_time()
        scale = np.sqrt(np.einsum("kii->ki", matrix)) + 1e-300
        scaled = matrix / scale[:, :, None] / scale[:, None, :] + damping[:, None, None] * np.eye(z.shape[1])
        step = -np.linalg.solve(scaled, (gradient / scale)[:, :, None])[:, :, 0] / scale
        trial = problem.moved(z, step)
        then = problem.linearized(trial)
        better = then[0] < cost
        settled = better & (then[0] > (1.0 - _CONVERGED) * cost) | (damping >= _DAMPING_BOUNDS[1])
        z = np.where(better[:, None], trial, z)
        cost, gradient, matrix = (
            np.where(better.reshape(-1, *(1,) * (x.ndim - 1)), y, x)
            for x, y in zip((cost, gradient, matrix), then, strict=True)
        )
        damping = np.clip(np.where(better, _LESS, _MORE) * damping, *_DAMPING_BOUNDS)
        if settled.all():
            break
    return z, cost


@lru_cache(maxsize=64)
def _free_of_turns(model: Model) -> frozenset[str]:
    """Coordinates in rad that may gain a whole turn with no effect on the equations, tried at random points."""
    symbols = [ca.SX.sym(n, model.residual.size1_in(i)) for i, n in enumerate("qvaup")]
    parts = [model.residual(*symbols)]
    if model.kinematics is not None:
        parts.append(model.kinematics(*symbols[:2]))
    if model.measurement is not None:
        parts.append(model.measurement(*symbols))
    equations, rng = ca.Function("equations", symbols, [ca.vertcat(*parts)]), np.random.default_rng(0)
    points = [rng.uniform(0.5, 2.0, (x.numel(), _N_POINTS)) for x in symbols]
    before = np.array(equations(*points))

    def is_free(k: int) -> bool:
        turned = points[0].copy()
        turned[k] += _TURN
        after = np.array(equations(turned, *points[1:]))
        return np.allclose(before, after, rtol=_SAME, atol=_SAME, equal_nan=True)

    return frozenset(n for k, n in enumerate(model.coordinates) if model.units[n] == "rad" and is_free(k))


def within_half_a_turn(model: Model, states: Mapping[str, FloatArray], rows_of_logs: Sequence[slice]) -> None:
    """Move angles that are the same after a whole turn so that each log starts within half a turn of zero, in place.

    Parameters
    ----------
    model : Model
    states : mapping of str to (N,) array
        In all rows of all logs.
    rows_of_logs : sequence of slice
    """
    for name in _free_of_turns(model).intersection(states):
        for rows in rows_of_logs:
            states[name][rows] -= _TURN * np.rint(states[name][rows.start] / _TURN)


def held_means(values: FloatArray, rows_of_logs: Sequence[slice]) -> FloatArray:
    """Values that are held from row to row as an input is: the means of both rows.

    Parameters
    ----------
    values : (N, n) array
        In all rows of all logs.
    rows_of_logs : sequence of slice

    Returns
    -------
    (N, n) array
    """
    means = values.copy()
    for rows in rows_of_logs:
        means[rows][:-1] = 0.5 * (values[rows][1:] + values[rows][:-1])
    return means
