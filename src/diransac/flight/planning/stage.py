"""Stage of a plan: state after an interval, cost of the interval, and first and second derivatives of both, compiled.

An interval is a few Runge-Kutta steps with the input held, the same as in a simulation. One step and its derivatives
are compiled, and evaluated for all stages of a plan at once, step after step: second derivatives through ten steps
take no longer to compile than those of one step.

Symbols of a stage: ``s`` its state, ``u`` its input, ``z = [s; u]``; ``Z = ds/dz`` from the start of the interval on.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray
from diransac.simulation.compiler import Map, Scan, compile_map, compile_scan
from diransac.simulation.integrators import INTEGRATORS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from diransac.model import Model


__all__ = ["Costs", "Interval", "Stage", "stage_of"]


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


@dataclass(frozen=True)
class Interval:
    """Integrated intervals of a plan, with derivatives.

    Parameters
    ----------
    states : (n_steps + 1, N, n_s)   at the start of each step, and at the end
    transitions : (n_steps + 1, N, n_z, n_s)   Z transposed, at the same moments
    """

    states: FloatArray
    transitions: FloatArray


@dataclass(frozen=True, eq=False)
class Stage:
    """Compiled steps, costs and derivatives of one model, from `stage_of`.

    Shapes: N stages, n_s states (with free time the duration of the segment is the last), n_z = n_s + n_u, M steps.
    """

    n_s: int
    n_u: int
    _step: Scan
    _sensitivities: Scan
    _adjoint: Scan
    _curvature: Map
    _cost: Map

    @property
    def n_z(self) -> int:
        """States and inputs of a stage."""
        return self.n_s + self.n_u

    def advance(self, states: FloatArray, inputs: FloatArray, parameters: FloatArray, steps: FloatArray) -> FloatArray:
        """States (M + 1, N, n_s) before each step and after the last; steps (N, M) in s, or shares of the duration."""
        after = self._step(states, steps[:, :, None], _constants(inputs, parameters))
        return np.concatenate([states[None], after.swapaxes(0, 1)])

    def linearize(self, states: FloatArray, inputs: FloatArray, parameters: FloatArray, steps: FloatArray) -> Interval:
        """Intervals: the states of `advance` with their derivatives."""
        identity = np.broadcast_to(np.eye(self.n_z, self.n_s).ravel(), (len(states), self.n_z * self.n_s))
        start = np.hstack([states, identity])
        after = self._sensitivities(start, steps[:, :, None], _constants(inputs, parameters))
        moments = np.concatenate([start[None], after.swapaxes(0, 1)])
        transitions = moments[..., self.n_s :].reshape(*moments.shape[:2], self.n_z, self.n_s)
        return Interval(np.ascontiguousarray(moments[..., : self.n_s]), transitions)

    def curvature(
        self, interval: Interval, inputs: FloatArray, parameters: FloatArray, steps: FloatArray, multipliers: FloatArray
    ) -> FloatArray:
        """Second derivatives (N, n_z, n_z) of ``multipliers . state after the interval``; multipliers (N, n_s)."""
        n_steps, n_stages = steps.shape[1], len(steps)
        adjoints = np.empty((n_steps, n_stages, self.n_s))
        adjoints[-1] = multipliers
        if n_steps > 1:
            backward = np.concatenate([steps[:, :0:-1, None], interval.states[-2:0:-1].swapaxes(0, 1)], axis=-1)
            before = self._adjoint(multipliers, backward, _constants(inputs, parameters))
            adjoints[-2::-1] = before.swapaxes(0, 1)
        rows = n_steps * n_stages
        (blocks,) = self._curvature(
            interval.states[:-1].reshape(rows, self.n_s),
            np.tile(inputs, (n_steps, 1)),
            parameters,
            np.ascontiguousarray(steps.T).reshape(rows, 1),
            adjoints.reshape(rows, self.n_s),
            interval.transitions[:-1].reshape(rows, -1),
        )
        triangle: FloatArray = blocks.reshape(n_steps, n_stages, self.n_z, self.n_z).sum(axis=0)
        return triangle + triangle.transpose(0, 2, 1) - triangle * np.eye(self.n_z)

    def cost(
        self, states: FloatArray, inputs: FloatArray, lengths: FloatArray, costs: Costs
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Cost (n_knots,), its gradient (n_knots, n_z) and its second derivatives (n_knots, n_z, n_z).

        Parameters
        ----------
        lengths : (n_knots,)   of each knot's interval: s, or a share of the duration where time is free
        """
        values, gradients, curvatures = self._cost(
            states, inputs, _column(lengths), costs.reference, costs.weights, costs.input_weights, costs.trim,
            np.array([costs.time]),
        )  # fmt: skip
        return values[:, 0], gradients, curvatures.reshape(-1, self.n_z, self.n_z)


@lru_cache(maxsize=32)
def stage_of(model: Model, free_time: bool) -> Stage:
    """Compiled stage of a model; the same one again for an equal model."""
    n_s = len(model.state) + free_time
    s, u, p, c = (ca.SX.sym(n, size) for n, size in (("s", n_s), ("u", model.n_u), ("p", model.n_p), ("c", 1)))
    arguments = [s, u, p, c]
    z = ca.vertcat(s, u)
    after = _stepped(model, s, u, p, c, free_time)
    jacobian = ca.jacobian(after, z)
    multipliers = ca.SX.sym("l", n_s)
    Z = ca.SX.sym("Z", n_s, z.numel())
    whole = ca.vertcat(Z, ca.horzcat(ca.SX(model.n_u, n_s), ca.SX.eye(model.n_u)))
    curved = ca.hessian(ca.dot(multipliers, after), z)[0]
    constants = ca.vertcat(u, p)
    moved = ca.vertcat(after, ca.vec(ca.densify(jacobian @ whole)))
    before = jacobian[:, :n_s].T @ multipliers
    scans = {
        "step": ([s, c, constants], after),
        "sensitivities": ([ca.vertcat(s, ca.vec(Z)), c, constants], moved),
        "adjoint": ([multipliers, ca.vertcat(c, s), constants], before),
    }
    maps = {
        "curvature": ([*arguments, multipliers, Z], [ca.triu(whole.T @ (curved @ whole))]),
        "cost": _cost_of(len(model.state), s, u, free_time),
    }
    step, sensitivities, adjoint = (
        compile_scan(_function(name, parts, [result, result])) for name, (parts, result) in scans.items()
    )
    curvature, cost = (compile_map(_function(name, *parts)) for name, parts in maps.items())
    return Stage(n_s, model.n_u, step, sensitivities, adjoint, curvature, cost)


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
    return [s, u, length, reference, weights, input_weights, trim, time], [cost, gradient, curved]


def _function(name: str, arguments: Sequence[ca.SX], results: Sequence[ca.SX]) -> ca.Function:
    return ca.Function(name, list(arguments), ca.cse([ca.densify(result) for result in results]))


def _constants(inputs: FloatArray, parameters: FloatArray) -> FloatArray:
    """Constants of a stage over its steps: input and parameters (N, n_u + n_p)."""
    return np.hstack([inputs, np.broadcast_to(parameters, (len(inputs), len(parameters)))])


def _column(values: FloatArray) -> FloatArray:
    return np.ascontiguousarray(values).reshape(-1, 1)
