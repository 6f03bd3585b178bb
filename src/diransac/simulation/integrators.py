"""Expressions of one row of a simulation: integration steps, and their exact derivatives.

Each integrator is written once, for a matrix of columns: the state, and its derivatives with respect to the unknowns.
The dynamics of a column of derivatives are the variational equations, A S + P with A = df/dx and P = df/dp. Every
integrator consists of sums and of the dynamics, so applied to those columns it gives the derivatives of the state after
the step. Derivatives that are always zero or always one are not variables.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, TypeAlias

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.simulation.compiler.graph import read_graph

if TYPE_CHECKING:
    from diransac.model import Model
    from diransac.model.plant import DisturbedModel
    from diransac.simulation.compiler.time_loop import LoopSpecification

    SimulatedModel: TypeAlias = Model | DisturbedModel

__all__ = ["HOLDS", "INTEGRATORS", "Hold", "Sensitivities", "linearized_step", "loop_specification", "sensitivities_of"]

Dynamics = Callable[[ca.SX, float], ca.SX]
"""(state and its derivatives, in columns; fraction of the step that has elapsed) -> their rates."""


# Inputs between rows -------------------------------------------------------------------------------------------------
class Hold(Protocol):
    """Inputs from one row to the next, as the time loop reads and the integration steps evaluate them."""

    def columns(self, inputs: FloatArray, substeps: int) -> FloatArray:
        """Columns of each row (n_log, n_columns) from its inputs (n_log, n_u)."""

    def n_changes(self, n_u: int) -> int:
        """Number of trailing columns that the leading ones change by with each sub-step."""

    def at(self, columns: ca.SX, fraction: float) -> ca.SX:
        """Inputs (n_u,) after a fraction of a sub-step, from the columns at its beginning."""


class _ZeroOrderHold:
    """Inputs of a row until the next."""

    def columns(self, inputs: FloatArray, _substeps: int) -> FloatArray:
        """The inputs."""
        return inputs

    def n_changes(self, _n_u: int) -> int:
        """No column changes."""
        return 0

    def at(self, columns: ca.SX, _fraction: float) -> ca.SX:
        """The inputs."""
        return columns


class _LinearHold:
    """Linear interpolation between the inputs of a row and of the next; those of the last row are held."""

    def columns(self, inputs: FloatArray, substeps: int) -> FloatArray:
        """The inputs, then their changes in a sub-step."""
        return np.hstack([inputs, np.diff(inputs, axis=0, append=inputs[-1:]) / substeps])

    def n_changes(self, n_u: int) -> int:
        """Every input changes."""
        return n_u

    def at(self, columns: ca.SX, fraction: float) -> ca.SX:
        """Inputs at the beginning, and the fraction of their change."""
        n_u = columns.numel() // 2
        return columns[:n_u] + fraction * columns[n_u:]


HOLDS: dict[str, Hold] = {"zero-order": _ZeroOrderHold(), "linear": _LinearHold()}
"""Inputs between rows: held, or interpolated linearly (first-order hold)."""


# Integrators ---------------------------------------------------------------------------------------------------------
def _euler(_dynamics: Dynamics, x: ca.SX, h: ca.SX, slope: ca.SX, _n_q: int) -> ca.SX:
    """Explicit Euler: x + h dx/dt, order 1."""
    return x + h * slope


def _semi_implicit_euler(dynamics: Dynamics, x: ca.SX, h: ca.SX, slope: ca.SX, n_q: int) -> ca.SX:
    """v+ = v + h a(q, v), q+ = q + h dq/dt(q, v+), order 1."""
    v = x[n_q:, :] + h * slope[n_q:, :]
    return ca.vertcat(x[:n_q, :] + h * dynamics(ca.vertcat(x[:n_q, :], v), 1.0)[:n_q, :], v)


def _rk4(dynamics: Dynamics, x: ca.SX, h: ca.SX, slope: ca.SX, _n_q: int) -> ca.SX:
    """The classical Runge-Kutta step, order 4."""
    second = dynamics(x + h / 2 * slope, 0.5)
    third = dynamics(x + h / 2 * second, 0.5)
    fourth = dynamics(x + h * third, 1.0)
    return x + h / 6 * (slope + fourth + 2 * (second + third))


INTEGRATORS = {"rk4": _rk4, "euler": _euler, "semi-implicit-euler": _semi_implicit_euler}
"""One step of each integrator: (dynamics, x, h, dx/dt at x, n_q) -> x after h seconds; x may have further columns."""


# Sensitivities -------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Sensitivities:
    """Structure of the derivatives of the state with respect to the unknowns; made by `sensitivities_of`.

    Attributes
    ----------
    unknowns : tuple of str
        Names of parameters, and of states for their initial values.
    initial : (n_x, n_z)
        Derivatives of the initial state: 1 of a state with respect to itself, else 0.
    varying : (n_x, n_z)
        Entries that change during a rollout; the others keep their initial value.
    """

    unknowns: tuple[str, ...]
    initial: FloatArray
    varying: BoolArray

    @property
    def entries(self) -> list[tuple[int, int]]:
        """Row and column of each varying entry, in the order in which they follow the state."""
        return [(int(i), int(j)) for i, j in np.argwhere(self.varying)]

    def appended(self, states: FloatArray) -> FloatArray:
        """Initial states (n_x, n), and below them the initial values of the varying entries."""
        values = self.initial[self.varying]
        return np.concatenate([states, np.repeat(values[:, None], states.shape[1], axis=1)])

    def matrix(self, values: FloatArray) -> FloatArray:
        """Whole matrices (n, n_x, n_z) from the varying entries (n, n_varying)."""
        whole = np.repeat(self.initial[None], len(values), axis=0)
        whole[:, self.varying] = values
        return whole


def sensitivities_of(model: SimulatedModel, unknowns: Sequence[str]) -> Sensitivities:
    """Structure of d(state)/d(unknowns): non-zero entries are propagated until no more appear."""
    n_x, n_p, names = len(model.state), model.n_p, (*model.parameters, *model.state)
    if not unknowns:
        return Sensitivities((), np.zeros((n_x, 0)), np.zeros((n_x, 0), bool))
    columns = [names.index(name) for name in unknowns]
    jacobians = model.rate_jacobians
    A, P = (np.array(ca.DM(jacobians.sparsity_out(k), 1)) != 0 for k in ("dx", "dp"))
    initial = np.hstack([np.zeros((n_x, n_p)), np.eye(n_x)])[:, columns]
    driven = np.hstack([P, np.zeros((n_x, n_x), bool)])[:, columns]
    varying, before = np.zeros_like(driven), None
    while before is None or not np.array_equal(varying, before):
        before = varying
        present = varying | (initial != 0)
        varying = varying | driven | (A.astype(int) @ present > 0)
        for four in model.quaternions:
            varying[list(four)] |= present[list(four)].any(axis=0)
    return Sensitivities(tuple(unknowns), initial, varying)


def _variables(sensitivities: Sensitivities, values: ca.SX) -> ca.SX:
    """Sparse matrix (n_x, n_z) of the derivatives, from its varying entries."""
    S = ca.SX(*sensitivities.initial.shape)
    for i, j in zip(*np.nonzero(sensitivities.initial), strict=True):
        S[int(i), int(j)] = 1
    for k, (i, j) in enumerate(sensitivities.entries):
        S[i, j] = values[k]
    return S


def _driving(model: SimulatedModel, unknowns: Sequence[str], P: ca.SX) -> ca.SX:
    """P = df/dp, as columns of the unknowns; those of initial states are zero."""
    columns = ca.horzcat(P, ca.SX(P.size1(), len(model.state)))
    names = (*model.parameters, *model.state)
    return columns[:, [names.index(name) for name in unknowns]]


# A row ---------------------------------------------------------------------------------------------------------------
def loop_specification(
    model: SimulatedModel,
    signals: Sequence[str],
    sensitivities: Sensitivities,
    integrator: str,
    substeps: int,
    hold: str,
) -> LoopSpecification:
    """Expressions of one row, as graphs.

    Parameters
    ----------
    model : Model or DisturbedModel
        The model to simulate.
    signals : sequence of str
        Signals that are compared with measurements.
    sensitivities : Sensitivities
        The derivatives to simulate.
    integrator : str
        One of `INTEGRATORS`.
    substeps : int
        Integration steps from one row to the next.
    hold : str
        One of `HOLDS`.
    """
    from diransac.simulation.compiler.time_loop import PARAMETER, STEP, LoopSpecification

    n_states, n_changes = len(model.state) + len(sensitivities.entries), HOLDS[hold].n_changes(model.n_u)
    sizes = {"x": n_states, "u": model.n_u + n_changes, "p": model.n_p, "h": 1}
    arguments = [ca.SX.sym(name, n) for name, n in sizes.items()]
    scored = tuple(model.signals.index(name) for name in signals)
    after, simulated, slopes = _expressions(model, sensitivities, integrator, HOLDS[hold], arguments)
    step, further_step = (
        read_graph(ca.Function("step", arguments, results), (PARAMETER, STEP), reciprocals=True)
        for results in ([after, simulated, slopes[list(scored), :]], [after])
    )
    return LoopSpecification(
        step=step,
        further_step=further_step,
        substeps=substeps,
        n_states=n_states,
        n_inputs=model.n_u + n_changes,
        n_changes=n_changes,
        n_signals=len(model.signals),
        n_unknowns=slopes.size2(),
        scored=scored,
        quaternions=_scored_quaternions(model, tuple(signals)),
        state_quaternions=tuple(model.quaternions),
    )


def _expressions(
    model: SimulatedModel, sensitivities: Sensitivities, integrator: str, hold: Hold, arguments: Sequence[ca.SX]
) -> tuple[ca.SX, ca.SX, ca.SX]:
    """State after a step with the varying derivatives, all signals before it, and the derivatives of these."""
    n_x, n_q = len(model.state), model.n_q
    states, inputs, p, h = arguments
    S = _variables(sensitivities, states[n_x:])

    def rates(columns: ca.SX, fraction: float) -> ca.SX:
        x, u = columns[:, 0], hold.at(inputs, fraction)
        rate = model.dynamics(x, u, p)[0]
        if not sensitivities.unknowns:
            return rate
        A, _, P = model.rate_jacobians(x, u, p)
        return ca.horzcat(rate, A @ columns[:, 1:] + _driving(model, sensitivities.unknowns, P))

    columns = ca.horzcat(states[:n_x], S)
    slope = rates(columns, 0.0)
    after = INTEGRATORS[integrator](rates, columns, h, slope, n_q)
    after = _normalised(after, model.quaternions)
    moved = [after[i, 1 + j] for i, j in sensitivities.entries]
    x, u = states[:n_x], hold.at(inputs, 0.0)
    acceleration, of_acceleration = model.dynamics(x, u, p)[1], slope[n_q:, 1:]
    sensors, of_sensors = _readings(model, sensitivities.unknowns, (x, acceleration, u, p), (S, of_acceleration))
    return (
        ca.vertcat(after[:, 0], *moved),
        ca.vertcat(x, acceleration, sensors),
        ca.vertcat(S, of_acceleration, of_sensors),
    )


def _readings(
    model: SimulatedModel, unknowns: Sequence[str], at: Sequence[ca.SX], slopes: Sequence[ca.SX]
) -> tuple[ca.SX, ca.SX]:
    """Sensors at ``(x, a, u, p)``, and their derivatives from those of state and accelerations; empty without any."""
    x, a, u, p = (ca.SX.sym(name, vector.numel()) for name, vector in zip("xaup", at, strict=True))
    y = model.readings(x, a, u, p)
    if not y.numel():
        return ca.SX(0, 1), ca.SX(0, len(unknowns))
    jacobians = ca.Function("jacobians", [x, a, u, p], [ca.jacobian(y, z) for z in (x, a, p)])
    C, D, P = jacobians(*at)
    of_x, of_a = slopes
    # States of disturbances follow the accelerations in the rates of the state; no sensor depends on them.
    chained = C @ of_x + D @ of_a[: a.numel(), :] if unknowns else ca.SX(y.numel(), 0)
    return model.readings(*at), chained + _driving(model, unknowns, P)


def _normalised(columns: ca.SX, quaternions: Sequence[Sequence[int]]) -> ca.SX:
    """State with every quaternion scaled to length one, and the derivatives of the scaled state."""
    rows = ca.vertsplit(columns)
    for four in quaternions:
        values = ca.vertcat(*(rows[k] for k in four))
        scale = 1 / ca.sqrt(ca.sumsqr(values[:, 0]))
        unit, slopes = values[:, 0] * scale, values[:, 1:]
        slopes = (slopes - unit @ (unit.T @ slopes)) * scale
        for k, row in zip(four, ca.vertsplit(ca.horzcat(unit, slopes)), strict=True):
            rows[k] = row
    return ca.vertcat(*rows)


def _scored_quaternions(model: SimulatedModel, signals: tuple[str, ...]) -> tuple[tuple[int, ...], ...]:
    """Positions among the scored signals of the quaternions that are scored whole."""
    named = [[model.signals[k] for k in four] for four in model.quaternions]
    return tuple(tuple(signals.index(name) for name in four) for four in named if set(four) <= set(signals))


# A step alone --------------------------------------------------------------------------------------------------------
def linearized_step(model: Model, integrator: str = "rk4") -> ca.Function:
    """Function (x, u, p, h) -> (x after h seconds, A = d(x after)/dx, B = d(x after)/du), the matrices sparse.

    It is the step of a simulation, with u held and quaternions scaled to length one, and its exact derivatives.
    """
    n_x, n_u = len(model.state), model.n_u
    x, u, p, h = (ca.SX.sym(name, n) for name, n in (("x", n_x), ("u", n_u), ("p", model.n_p), ("h", 1)))

    def rates(columns: ca.SX, _fraction: float) -> ca.SX:
        A, B, _ = model.rate_jacobians(columns[:, 0], u, p)
        driving = ca.horzcat(ca.SX(n_x, n_x), B)
        return ca.horzcat(model.dynamics(columns[:, 0], u, p)[0], A @ columns[:, 1:] + driving)

    columns = ca.horzcat(x, ca.SX.eye(n_x), ca.SX(n_x, n_u))
    after = INTEGRATORS[integrator](rates, columns, h, rates(columns, 0.0), model.n_q)
    results = ca.cse(ca.horzsplit(_normalised(after, model.quaternions), [0, 1, 1 + n_x, 1 + n_x + n_u]))
    return ca.Function("linearized_step", [x, u, p, h], results, ["x", "u", "p", "h"], ["after", "A", "B"])
