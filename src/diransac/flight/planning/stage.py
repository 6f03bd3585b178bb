"""Stage of a plan: state after an interval, cost of the interval, and first and second derivatives of both, compiled.

An interval is a few Runge-Kutta steps with the input held, the same as in a simulation. One step and its derivatives
are compiled, and evaluated for all stages of a plan at once, step after step: second derivatives through ten steps
take no longer to compile than those of one step.

Symbols of a stage: ``s`` its state, ``u`` its input, ``z = [s; u]``; ``Z = ds/dz`` from the start of the interval on.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.simulation.compiler import Map, Scan, compile_map, compile_scan
from diransac.simulation.integrators import INTEGRATORS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from diransac.model import Model


@dataclass(frozen=True)
class Costs:
    """Cost of knots and intervals: ``tau (w_t + sum_i e_i (u_i - trim_i)^2) + sum_j w_j (x_j - ref_j)^2``.

    Parameters
    ----------
    reference, weights : (n_knots, n_x)   ref, and w times the duration that a knot represents
    input_weights : (n_u,)   e, one over each input's unit squared
    trim : (n_u,)   inputs of zero cost
    time : w_t, one over seconds
    """

    reference: FloatArray
    weights: FloatArray
    input_weights: FloatArray
    trim: FloatArray
    time: float


@dataclass(frozen=True, eq=False)
class Stage:
    """Compiled step, cost and derivatives of one model, from `stage_of`; `Stages` evaluates them.

    Second derivatives are upper triangles (n_z (n_z + 1) / 2,), column by column.

    Parameters
    ----------
    n_s, n_u : number of states, of which the last is the duration of the segment with free time, and of inputs
    step : recurrence over the steps of an interval; carries [s; Z], and outputs it before each step
    adjoint : recurrence from the last step to the first; carries the derivatives by s of multipliers times the state
        after the interval, and outputs them after each step
    curvature : a step's share of the second derivatives by z of multipliers times the state after the interval
    cost : cost of a knot and its interval, gradient, second derivatives
    """

    n_s: int
    n_u: int
    step: Scan
    adjoint: Scan
    curvature: Map
    cost: Map

    @property
    def n_z(self) -> int:
        """States and inputs of a stage."""
        return self.n_s + self.n_u

    @cached_property
    def triangle(self) -> tuple[IntArray, IntArray]:
        """Row and column of every entry of an upper triangle, column by column."""
        columns, rows = np.tril_indices(self.n_z)
        return rows, columns


class Stages:
    """Values and derivatives of the N stages of a plan, each of M steps, at one point after the other.

    Arrays are made once; a result is overwritten when it is computed at the next point.

    Parameters
    ----------
    parameters : (n_p,)   each parameter's unit
    steps : (N, M)   s, or shares of the duration of the segment where time is free
    costs : the objective
    """

    def __init__(self, stage: Stage, parameters: FloatArray, steps: FloatArray, costs: Costs) -> None:
        n_stages, n_steps = steps.shape
        n_s, n_z, n_u = stage.n_s, stage.n_z, stage.n_u
        self._sizes = n_stages, n_steps, n_z, n_s
        self._step, self._adjoint = (scan.prepare(n_stages, n_steps) for scan in (stage.step, stage.adjoint))
        self._step.set_carry(_each(np.eye(n_z, n_s).ravel(), n_stages), n_s)
        self._step.rows[..., 0], self._adjoint.rows[..., 0] = steps, steps[:, ::-1]
        for scan in (self._step, self._adjoint):
            scan.set_constants(_each(parameters, n_stages), n_u)
        self._inputs_of_steps, self._adjoints = (np.zeros((n_stages, n_steps, n)) for n in (n_u, n_s))
        arrays = self._step.outputs, self._inputs_of_steps, steps, self._adjoints
        moved, inputs, lengths, adjoints = (array.reshape(n_stages * n_steps, -1) for array in arrays)
        self._curvature = stage.curvature.prepare(moved, inputs, parameters, lengths, adjoints)
        self._states, self._inputs = np.zeros((n_stages + 1, n_s)), _each(costs.trim, n_stages + 1).copy()
        self._cost = stage.cost.prepare(
            self._states, self._inputs, np.append(steps.sum(axis=1), 0.0)[:, None], costs.reference, costs.weights,
            costs.input_weights, costs.trim, np.array([costs.time]),
        )  # fmt: skip

    def move(self, states: FloatArray, inputs: FloatArray) -> None:
        """Move to the point with these states (N + 1, n_s) of the knots and inputs (N, n_u) of the intervals."""
        self._states[:], self._inputs[:-1] = states, inputs
        self._step.set_carry(states[:-1])
        self._inputs_of_steps[:] = inputs[:, None]
        for scan in (self._step, self._adjoint):
            scan.set_constants(inputs)

    def integrate(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """States (N, M, n_s) before each step; states (N, n_s) and Z transposed (N, n_z, n_s) after the last one."""
        n_stages, _, n_z, n_s = self._sizes
        before, after = self._step.run(), self._step.last_carry()
        return before[..., :n_s], after[:, :n_s], after[:, n_s:].reshape(n_stages, n_z, n_s)

    def curvature(self, multipliers: FloatArray) -> FloatArray:
        """Second derivatives (N, n_z (n_z + 1) / 2) of multipliers times the state after the interval.

        Only after `integrate` at the same point.

        Parameters
        ----------
        multipliers : (N, n_s)
        """
        n_stages, n_steps, _, n_s = self._sizes
        self._adjoint.rows[..., 1:] = self._step.outputs[:, ::-1, :n_s]
        self._adjoint.set_carry(multipliers)
        self._adjoints[:] = self._adjoint.run()[:, ::-1]
        (shares,) = self._curvature.run()
        triangles: FloatArray = shares.reshape(n_stages, n_steps, -1).sum(axis=1)
        return triangles

    def cost(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Cost (N + 1,) of each knot and its interval, gradient (N + 1, n_z), second derivatives.

        There is no interval after the last knot.
        """
        values, gradients, triangles = self._cost.run()
        return values[:, 0], gradients, triangles


@lru_cache(maxsize=32)
def stage_of(model: Model, free_time: bool) -> Stage:
    """Compiled stage of a model; the same one again for an equal model."""
    n_s = len(model.state) + free_time
    s, u, p, c = (ca.SX.sym(n, size) for n, size in (("s", n_s), ("u", model.n_u), ("p", model.n_p), ("c", 1)))
    z, constants = ca.vertcat(s, u), ca.vertcat(u, p)
    after = _stepped(model, s, u, p, c, free_time)
    jacobian = ca.jacobian(after, z)
    multipliers, Z = ca.SX.sym("l", n_s), ca.SX.sym("Z", n_s, z.numel())
    whole = ca.vertcat(Z, ca.horzcat(ca.SX(model.n_u, n_s), ca.SX.eye(model.n_u)))
    curved = ca.hessian(ca.dot(multipliers, after), z)[0]
    start, end = ca.vertcat(s, ca.vec(Z)), ca.vertcat(after, ca.vec(ca.densify(jacobian @ whole)))
    step = [start, c, constants], [end, start]
    adjoint = [multipliers, ca.vertcat(c, s), constants], [jacobian[:, :n_s].T @ multipliers, multipliers]
    curvature = [start, u, p, c, multipliers], [_upper(whole.T @ (curved @ whole))]
    return Stage(
        n_s,
        model.n_u,
        compile_scan(_function("step", *step)),
        compile_scan(_function("adjoint", *adjoint)),
        compile_map(_function("curvature", *curvature)),
        compile_map(_function("cost", *_cost_of(len(model.state), s, u, free_time))),
    )


def _stepped(model: Model, s: ca.SX, u: ca.SX, p: ca.SX, c: ca.SX, free_time: bool) -> ca.SX:
    """State one Runge-Kutta step later; the duration, where it is a state, is constant."""
    n_x = len(model.state)
    x, h = s[:n_x], c * s[n_x] if free_time else c

    def rates(x: ca.SX, _fraction: float) -> ca.SX:
        return model.dynamics(x, u, p)[0]

    after = INTEGRATORS["rk4"](rates, x, h, rates(x, 0.0), model.n_q)
    for four in model.quaternions:
        rows = list(four)
        after[rows] = after[rows] / ca.norm_2(after[rows])
    return ca.vertcat(after, s[n_x:, 0])


def _cost_of(n_x: int, s: ca.SX, u: ca.SX, free_time: bool) -> tuple[list[ca.SX], list[ca.SX]]:
    """Arguments and results of the cost of a knot and its interval."""
    length, time = ca.SX.sym("tau"), ca.SX.sym("w_t")
    reference, weights = ca.SX.sym("ref", n_x), ca.SX.sym("w", n_x)
    input_weights, trim = ca.SX.sym("e", u.numel()), ca.SX.sym("trim", u.numel())
    tau = length * s[n_x] if free_time else length
    x = s[:n_x]
    cost = tau * (time + ca.dot(input_weights, (u - trim) ** 2)) + ca.dot(weights, (x - reference) ** 2)
    curved, gradient = ca.hessian(cost, ca.vertcat(s, u))
    return [s, u, length, reference, weights, input_weights, trim, time], [cost, gradient, _upper(curved)]


def _upper(matrix: ca.SX) -> ca.SX:
    """Upper triangle of a matrix, column by column."""
    return ca.triu(ca.densify(matrix)).nz[:]


def _function(name: str, arguments: Sequence[ca.SX], results: Sequence[ca.SX]) -> ca.Function:
    return ca.Function(name, list(arguments), ca.cse([ca.densify(result) for result in results]))


def _each(values: FloatArray, n: int) -> FloatArray:
    """Row of values, n times."""
    return np.broadcast_to(values, (n, len(values)))
