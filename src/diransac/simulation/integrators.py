"""From equations of motion to the expressions of one row: integration steps, and their exact derivatives.

The integrators are written once, for a matrix of columns: the state, and the derivatives of it that are wanted. The
dynamics of a column of derivatives are the variational equations, A S + P with A = df/dx and P = df/dp; every
integrator here is made of sums and of the dynamics, so what it does to those columns is the derivative of what it does
to the state. Derivatives that are always zero or always one are no variables.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.simulation.compiler.graph import read_graph

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from diransac.model import Model
    from diransac.model.plant import DisturbedModel
    from diransac.simulation.compiler.time_loop import Plan

__all__ = ["INTEGRATORS", "Equations", "Sensitivities", "linearized_step", "plan_of", "sensitivities_of"]

Dynamics = Callable[[ca.SX], ca.SX]
"""State and derivatives of it, in columns -> their rates, with inputs and parameters held."""


@dataclass(frozen=True)
class Equations:
    """A model's equations of motion and how they are integrated, as a value: equal ones are compiled once.

    Attributes
    ----------
    dynamics : (x, u, p) -> (dx/dt, accelerations), serialised
    sizes : of coordinates, velocities, inputs and parameters
    parameters, signals : names of the parameters, and of the states and accelerations
    quaternions : positions in q
    integrator : one of `INTEGRATORS`
    substeps : integration steps from one row to the next
    model : one that has these equations
    """

    dynamics: str
    sizes: tuple[int, int, int, int]
    parameters: tuple[str, ...]
    signals: tuple[str, ...]
    quaternions: tuple[tuple[int, ...], ...]
    integrator: str
    substeps: int
    model: Model | DisturbedModel = field(compare=False, repr=False)

    @property
    def n_x(self) -> int:
        """Number of states."""
        return self.sizes[0] + self.sizes[1]

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states."""
        return self.signals[: self.n_x]


# Integrators ---------------------------------------------------------------------------------------------------------
def _euler(_dynamics: Dynamics, x: ca.SX, h: ca.SX, slope: ca.SX, _n_q: int) -> ca.SX:
    """Explicit Euler: x + h dx/dt, order 1."""
    return x + h * slope


def _semi_implicit_euler(dynamics: Dynamics, x: ca.SX, h: ca.SX, slope: ca.SX, n_q: int) -> ca.SX:
    """v+ = v + h a(q, v), q+ = q + h dq/dt(q, v+), order 1."""
    v = x[n_q:, :] + h * slope[n_q:, :]
    return ca.vertcat(x[:n_q, :] + h * dynamics(ca.vertcat(x[:n_q, :], v))[:n_q, :], v)


def _rk4(dynamics: Dynamics, x: ca.SX, h: ca.SX, slope: ca.SX, _n_q: int) -> ca.SX:
    """The classical Runge-Kutta step, order 4."""
    second = dynamics(x + h / 2 * slope)
    third = dynamics(x + h / 2 * second)
    fourth = dynamics(x + h * third)
    return x + h / 6 * (slope + fourth + 2 * (second + third))


INTEGRATORS = {"rk4": _rk4, "euler": _euler, "semi-implicit-euler": _semi_implicit_euler}
"""One step of each integrator: (dynamics, x, h, dx/dt at x, n_q) -> x after h seconds; x may have further columns."""


# Sensitivities -------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Sensitivities:
    """Which derivatives of the state with respect to the unknowns there are; made by `sensitivities_of`.

    Attributes
    ----------
    unknowns : names of parameters and of states, whose initial values are meant
    initial : (n_x, n_z)   derivatives of the initial state: 1 where a state meets itself
    varying : (n_x, n_z)   which change during a rollout; the others keep their initial value
    """

    unknowns: tuple[str, ...]
    initial: NDArray[np.float64]
    varying: NDArray[np.bool_]

    @property
    def entries(self) -> list[tuple[int, int]]:
        """Row and column of each varying one, in the order in which they follow the state."""
        return [(int(i), int(j)) for i, j in np.argwhere(self.varying)]

    def appended(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Initial states (n_x, n), and below them the initial values of the varying ones."""
        values = self.initial[self.varying]
        return np.concatenate([states, np.repeat(values[:, None], states.shape[1], axis=1)])

    def matrix(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Whole matrices (n, n_x, n_z) from the varying entries (n, n_varying)."""
        whole = np.repeat(self.initial[None], len(values), axis=0)
        whole[:, self.varying] = values
        return whole


def sensitivities_of(equations: Equations, unknowns: Sequence[str]) -> Sensitivities:
    """What can change of d(state)/d(unknowns), by following which entries are not zero until no more appear."""
    if not unknowns:
        return Sensitivities((), np.zeros((equations.n_x, 0)), np.zeros((equations.n_x, 0), bool))
    n_x, names = equations.n_x, (*equations.parameters, *equations.states)
    columns = [names.index(name) for name in unknowns]
    n_p = len(equations.parameters)
    jacobians = equations.model.rate_jacobians
    A, P = (np.array(ca.DM(jacobians.sparsity_out(k), 1)) != 0 for k in ("dx", "dp"))
    initial = np.hstack([np.zeros((n_x, n_p)), np.eye(n_x)])[:, columns]
    driven = np.hstack([P, np.zeros((n_x, n_x), bool)])[:, columns]
    varying, before = np.zeros_like(driven), None
    while before is None or not np.array_equal(varying, before):
        before = varying
        present = varying | (initial != 0)
        varying = varying | driven | (A.astype(int) @ present > 0)
        for four in equations.quaternions:
            varying[list(four)] |= present[list(four)].any(axis=0)
    return Sensitivities(tuple(unknowns), initial, varying)


def _variables(sensitivities: Sensitivities, values: ca.SX) -> ca.SX:
    """Sparse matrix (n_x, n_z) of the derivatives, the varying ones given."""
    S = ca.SX(*sensitivities.initial.shape)
    for i, j in zip(*np.nonzero(sensitivities.initial), strict=True):
        S[int(i), int(j)] = 1
    for k, (i, j) in enumerate(sensitivities.entries):
        S[i, j] = values[k]
    return S


def _driving(equations: Equations, unknowns: Sequence[str], P: ca.SX) -> ca.SX:
    """P = df/dp, as columns of the unknowns; those of initial states are zero."""
    columns = ca.horzcat(P, ca.SX(equations.n_x, equations.n_x))
    names = (*equations.parameters, *equations.states)
    return columns[:, [names.index(name) for name in unknowns]]


# A row ---------------------------------------------------------------------------------------------------------------
def plan_of(equations: Equations, signals: Sequence[str], sensitivities: Sensitivities) -> Plan:
    """Expressions of one row, as graphs.

    Parameters
    ----------
    equations : what is simulated
    signals : those that are scored
    sensitivities : what is differentiated
    """
    from diransac.simulation.compiler.time_loop import PARAMETER, STEP, Plan

    entries = sensitivities.entries
    arguments = [
        ca.SX.sym(name, n)
        for name, n in (
            ("x", equations.n_x + len(entries)), ("u", equations.sizes[2]), ("p", equations.sizes[3]), ("h", 1)
        )
    ]  # fmt: skip
    scored = tuple(equations.signals.index(name) for name in signals)
    after, simulated, slopes = _expressions(equations, sensitivities, arguments)
    step, further_step = (
        read_graph(ca.Function("step", arguments, results), (PARAMETER, STEP), reciprocals=True)
        for results in ([after, simulated, slopes[list(scored), :]], [after])
    )
    return Plan(
        step=step,
        further_step=further_step,
        substeps=equations.substeps,
        n_states=equations.n_x + len(entries),
        n_inputs=equations.sizes[2],
        n_signals=len(equations.signals),
        n_unknowns=slopes.size2(),
        scored=scored,
        quaternions=_scored_quaternions(equations, tuple(signals)),
        state_quaternions=equations.quaternions,
    )


def _expressions(
    equations: Equations, sensitivities: Sensitivities, arguments: Sequence[ca.SX]
) -> tuple[ca.SX, ca.SX, ca.SX]:
    """State after a step with the varying derivatives, all signals before it, and the derivatives of these."""
    function, n_x, n_q = ca.Function.deserialize(equations.dynamics), equations.n_x, equations.sizes[0]
    states, u, p, h = arguments
    S = _variables(sensitivities, states[n_x:])

    def rates(columns: ca.SX) -> ca.SX:
        x = columns[:, 0]
        rate = function(x, u, p)[0]
        if not sensitivities.unknowns:
            return rate
        A, _, P = equations.model.rate_jacobians(x, u, p)
        return ca.horzcat(rate, A @ columns[:, 1:] + _driving(equations, sensitivities.unknowns, P))

    columns = ca.horzcat(states[:n_x], S)
    slope = rates(columns)
    after = INTEGRATORS[equations.integrator](rates, columns, h, slope, n_q)
    after = _normalised(after, equations.quaternions)
    moved = [after[i, 1 + j] for i, j in sensitivities.entries]
    acceleration = function(states[:n_x], u, p)[1]
    return (
        ca.vertcat(after[:, 0], *moved),
        ca.vertcat(states[:n_x], acceleration),
        ca.vertcat(S, slope[n_q:, 1:]),
    )


def _normalised(columns: ca.SX, quaternions: Sequence[Sequence[int]]) -> ca.SX:
    """Return the state with every quaternion scaled to length one, and its derivatives with what this makes of them."""
    rows = ca.vertsplit(columns)
    for four in quaternions:
        values = ca.vertcat(*(rows[k] for k in four))
        scale = 1 / ca.sqrt(ca.sumsqr(values[:, 0]))
        unit, slopes = values[:, 0] * scale, values[:, 1:]
        slopes = (slopes - unit @ (unit.T @ slopes)) * scale
        for k, row in zip(four, ca.vertsplit(ca.horzcat(unit, slopes)), strict=True):
            rows[k] = row
    return ca.vertcat(*rows)


def _scored_quaternions(equations: Equations, signals: tuple[str, ...]) -> tuple[tuple[int, ...], ...]:
    """Positions among the scored signals of the quaternions that are scored whole."""
    named = [[equations.signals[k] for k in four] for four in equations.quaternions]
    return tuple(tuple(signals.index(name) for name in four) for four in named if set(four) <= set(signals))


# A step alone --------------------------------------------------------------------------------------------------------
def linearized_step(model: Model, integrator: str = "rk4") -> ca.Function:
    """Function (x, u, p, h) -> (x after h seconds, A = d(x after)/dx, B = d(x after)/du), the matrices sparse.

    It is the step that a simulation takes, u held and quaternions scaled to length one, and its exact derivatives.
    """
    n_x, n_u = len(model.state), model.n_u
    x, u, p, h = (ca.SX.sym(name, n) for name, n in (("x", n_x), ("u", n_u), ("p", model.n_p), ("h", 1)))

    def rates(columns: ca.SX) -> ca.SX:
        A, B, _ = model.rate_jacobians(columns[:, 0], u, p)
        driving = ca.horzcat(ca.SX(n_x, n_x), B)
        return ca.horzcat(model.dynamics(columns[:, 0], u, p)[0], A @ columns[:, 1:] + driving)

    columns = ca.horzcat(x, ca.SX.eye(n_x), ca.SX(n_x, n_u))
    after = INTEGRATORS[integrator](rates, columns, h, rates(columns), model.n_q)
    results = ca.cse(ca.horzsplit(_normalised(after, model.quaternions), [0, 1, 1 + n_x, 1 + n_x + n_u]))
    return ca.Function("linearized_step", [x, u, p, h], results, ["x", "u", "p", "h"], ["after", "A", "B"])
