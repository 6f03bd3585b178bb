"""Expressions of one row of a simulation: integration steps, and their exact derivatives.

Each integrator is written once, for a matrix of columns: the state, and its derivatives with respect to the unknowns.
The dynamics of a column of derivatives are the variational equations, A S + P with A = df/dx and P = df/dp. Every
integrator consists of sums and of the dynamics, so applied to those columns it gives the derivatives of the state after
the step. Derivatives that are always zero or always one are not variables.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Any, TypeAlias

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.simulation.compiler.graph import read_graph

if TYPE_CHECKING:
    from diransac.model import Model
    from diransac.model.plant import DisturbedModel
    from diransac.simulation.compiler.sensitivities import ColumnGroup, DerivativeSpecification
    from diransac.simulation.compiler.stage_function import StageFunction
    from diransac.simulation.compiler.time_loop import LoopSpecification

    SimulatedModel: TypeAlias = Model | DisturbedModel

Dynamics = Callable[[ca.SX, float], ca.SX]
"""(state and its derivatives, in columns; fraction of the step that has elapsed) -> their rates."""


CALLED = "dynamics"
"""Name of the function that stages call."""

_LONG = 400
"""Number of instructions of the dynamics from which on stages call them: code and its compilation are a quarter."""


# Inputs between rows -------------------------------------------------------------------------------------------------
HOLDS = ("zero-order", "linear", "smooth")
"""Inputs from a row to the next: held, interpolated linearly (first-order hold), or by a parabola; the last are held.

The curvature of the parabola is the mean of the second differences at both rows, so that its mean is that of the cubic
polynomial through four rows.
"""


def input_columns(hold: str, inputs: FloatArray, substeps: int, first_rows: IntArray) -> FloatArray:
    """Columns of each row, as the time loop reads them.

    Parameters
    ----------
    hold : str
        One of `HOLDS`.
    inputs : (n_log, n_u) array
    substeps : int
    first_rows : (n,) int array
        First row of each log; of logs that begin or end elsewhere, outside of these rows.

    Returns
    -------
    (n_log, n_u) or (n_log, 3 n_u) array
        The inputs; where these vary, then their first and second differences from sub-step to sub-step.
    """
    if hold == "zero-order":
        return inputs
    columns = np.zeros((len(inputs), 3, inputs.shape[1]))
    first, second = columns[:, 1], columns[:, 2]
    columns[:, 0], first[:-1] = inputs, (inputs[1:] - inputs[:-1]) / substeps
    if hold == "smooth":
        within = first_rows[(first_rows > 0) & (first_rows < len(inputs))]
        for start, end in pairwise([0, *within.tolist(), len(inputs)]):
            if end - start > 2:
                bends = np.diff(inputs[start:end], 2, axis=0)
                second[start], second[end - 2] = bends[0], bends[-1]
                second[start + 1 : end - 2] = 0.5 * (bends[:-1] + bends[1:])
        first -= (substeps - 1) / (2 * substeps**2) * second
        second /= substeps**2
    return columns.reshape(len(inputs), 3 * inputs.shape[1])


def interpolated(u: Any, first: Any, second: Any, fraction: Any) -> Any:
    """Inputs after a fraction of a sub-step, from their differences at its beginning (Newton's interpolation)."""
    return u + fraction * first + 0.5 * fraction * (fraction - 1.0) * second


def _inputs_at(columns: ca.SX, n_u: int, fraction: float) -> ca.SX:
    """Inputs ``(n_u,)`` after a fraction of a sub-step, from the columns at its beginning."""
    if columns.numel() == n_u:
        return columns
    u, first, second = ca.vertsplit(columns, n_u)
    found: ca.SX = interpolated(u, first, second, fraction)
    return found


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
@dataclass(frozen=True, eq=False, repr=False)
class Sensitivities:
    """Structure of the derivatives of the state with respect to the unknowns; made by `sensitivities_of`.

    Attributes
    ----------
    unknowns : tuple of str
        Names of parameters, and of states for their initial values.
    initial : (n_x, n_z)
        Derivatives of the initial state: 1 of a state with respect to itself, else 0.
    driven : (n_x + n_y, n_z)
        Elements of df/dz, and below them of the derivatives of the sensors, that are not always zero.
    present : (n_x, n_z)
        Derivatives of the state that are not always zero.
    """

    unknowns: tuple[str, ...]
    initial: FloatArray
    driven: BoolArray
    present: BoolArray

    @cached_property
    def groups(self) -> list[list[int]]:
        """Unknowns whose columns have their zeros at the same places, each group in order."""
        groups: dict[bytes, list[int]] = {}
        for k in range(len(self.unknowns)):
            groups.setdefault(self.present[:, k].tobytes() + self.driven[:, k].tobytes(), []).append(k)
        return list(groups.values())

    @cached_property
    def entries(self) -> tuple[IntArray, IntArray]:
        """Rows and columns of the derivatives that the time loop stores, group by group and column by column."""
        places = [(i, k) for group in self.groups for k in group for i in np.flatnonzero(self.present[:, k])]
        rows, columns = np.array(places, int).reshape(-1, 2).T
        return rows, columns

    @cached_property
    def places(self) -> IntArray:
        """Places in a lane's arrays of what `GaussNewtonOutput` has in the order of the groups.

        Of e'we and J'we in `first` (1 + n_z), of J'wJ's upper triangle in `matrix` (n_z, n_z) and below its diagonal,
        and of the state and its stored derivatives in `final` (n_x (1 + n_z)).
        """
        n_x, n_z = self.initial.shape
        order, (left, right) = np.array(list(chain(*self.groups))), np.triu_indices(n_z)
        rows, columns = self.entries
        above, below = (n_z * order[i] + order[j] for i, j in ((left, right), (right, left)))
        final = np.r_[np.arange(n_x), n_x + n_z * rows + columns]
        return np.concatenate([[0], 1 + order, above, below, final]).astype(np.int64)


def sensitivities_of(model: SimulatedModel, unknowns: Sequence[str]) -> Sensitivities:
    """Structure of d(state)/d(unknowns): non-zero entries are propagated until no more appear."""
    n_x, n_p, names = len(model.state), model.n_p, (*model.parameters, *model.state)
    columns = [names.index(name) for name in unknowns]
    A, P = (np.array(ca.DM(x.sparsity(), 1)) != 0 for x in _jacobians(model, _symbols(model)))
    A, initial = A[:n_x], np.hstack([np.zeros((n_x, n_p)), np.eye(n_x)])[:, columns]
    driven = np.hstack([P, np.zeros((len(P), n_x), bool)])[:, columns]
    present, before = (initial != 0) | driven[:n_x], None
    while before is None or not np.array_equal(present, before):
        before = present
        present = present | (A.astype(int) @ present > 0)
        for four in model.quaternions:
            present[list(four)] |= present[list(four)].any(axis=0)
    return Sensitivities(tuple(unknowns), initial, driven, present)


# A row ---------------------------------------------------------------------------------------------------------------
def loop_specification(
    model: SimulatedModel,
    signals: Sequence[str],
    integrator: str,
    sensitivities: Sensitivities | None = None,
    *,
    varying: bool,
    divided: bool,
) -> LoopSpecification:
    """Expressions of one row, as graphs.

    Parameters
    ----------
    model : Model or DisturbedModel
        The model to simulate.
    signals : sequence of str
        Signals that are compared with measurements.
    integrator : str
        One of `INTEGRATORS`.
    sensitivities : Sensitivities, optional
        The derivatives to simulate.
    varying : bool
        Whether inputs may vary between rows.
    divided : bool
        Whether there may be several integration steps from one row to the next.
    """
    from diransac.simulation.compiler.time_loop import PARAMETER, STEP, LoopSpecification

    n_changes = 2 * model.n_u if varying else 0
    sizes = {"x": len(model.state), "u": model.n_u + n_changes, "p": model.n_p, "h": 1}
    arguments = [ca.SX.sym(name, n) for name, n in sizes.items()]
    scored = tuple(model.signals.index(name) for name in signals)
    dynamics, results = called_dynamics(model) if calls_dynamics(model) else None, list[ca.SX]()

    def inlined(x: ca.SX, u: ca.SX, p: ca.SX) -> tuple[ca.SX, ca.SX]:
        rates, acceleration = model.dynamics(x, u, p)
        return rates, acceleration

    def called(_x: ca.SX, _u: ca.SX, _p: ca.SX) -> tuple[ca.SX, ca.SX]:
        results.append(ca.SX.sym("r", len(model.state) + model.n_v))
        return results[-1][: len(model.state)], results[-1][len(model.state) :]

    after, simulated, points = _expressions(model, called if dynamics else inlined, integrator, arguments)
    derivatives = _derivatives(model, integrator, scored, sensitivities, points[0].size2()) if sensitivities else None
    outputs = [after, simulated, *(points if sensitivities or dynamics else ())]
    step = ca.Function("step", [*arguments, ca.vertcat(*results)], outputs)
    return LoopSpecification(
        step=read_graph(step, (PARAMETER, STEP), reciprocals=True),
        dynamics=dynamics,
        divided=divided,
        n_states=len(model.state),
        n_inputs=model.n_u + n_changes,
        n_changes=n_changes,
        n_signals=len(model.signals),
        scored=scored,
        quaternions=_scored_quaternions(model, tuple(signals)),
        state_quaternions=tuple(model.quaternions),
        derivatives=derivatives,
    )


def calls_dynamics(model: SimulatedModel) -> bool:
    """True if stages call one function for the dynamics, false if each has their expressions, where these are short."""
    return bool(model.dynamics.n_instructions() >= _LONG)


def called_dynamics(model: SimulatedModel) -> StageFunction:
    """Function of (x, u, p) -> (dx/dt, accelerations) that stages call."""
    from diransac.simulation.compiler.stage_function import StageFunction
    from diransac.simulation.compiler.time_loop import PARAMETER

    graph = read_graph(model.dynamics, (PARAMETER,), reciprocals=True)
    return StageFunction(CALLED, graph, tuple(chain(*graph.outputs)), len(model.state), model.n_u)


def _expressions(
    model: SimulatedModel,
    dynamics: Callable[[ca.SX, ca.SX, ca.SX], tuple[ca.SX, ca.SX]],
    integrator: str,
    arguments: Sequence[ca.SX],
) -> tuple[ca.SX, ca.SX, tuple[ca.SX, ca.SX, ca.SX]]:
    """State after a step, all signals before it, and the points of the step, from dynamics (x, u, p) -> (dx/dt, a).

    The points are the states (n_x, n_stages) and inputs (n_u, n_stages) at which the dynamics are evaluated, and the
    components of the quaternions after the step before they are scaled.
    """
    x, inputs, p, h = arguments
    states, held, accelerations = [], [], []

    def rates(state: ca.SX, fraction: float) -> ca.SX:
        states.append(state)
        held.append(_inputs_at(inputs, model.n_u, fraction))
        found, acceleration = dynamics(state, held[-1], p)
        accelerations.append(acceleration)
        return found

    raw = INTEGRATORS[integrator](rates, x, h, rates(x, 0.0), model.n_q)
    acceleration = accelerations[0]
    sensors = model.readings(x, acceleration, held[0], p)
    quaternions = ca.vertcat(*(raw[k] for four in model.quaternions for k in four))
    points = (ca.horzcat(*states), ca.horzcat(*held), quaternions)
    return _normalised(raw, model.quaternions), ca.vertcat(x, acceleration, sensors), points


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


# Derivatives of a row ------------------------------------------------------------------------------------------------
def _derivatives(
    model: SimulatedModel, integrator: str, scored: Sequence[int], sensitivities: Sensitivities, n_stages: int
) -> DerivativeSpecification:
    """Jacobians of the dynamics, and the integrator's step of each group of columns."""
    from diransac.simulation.compiler.sensitivities import DerivativeSpecification
    from diransac.simulation.compiler.time_loop import PARAMETER

    names, arguments = (*model.parameters, *model.state), _symbols(model)
    A, P = _jacobians(model, arguments)
    driving = ca.horzcat(P, ca.SX(*A.shape))[:, [names.index(name) for name in sensitivities.unknowns]]
    elements = ca.vertcat(ca.SX(0, 1), *(element for element in _elements(A) if not element.is_constant()))
    jacobians = read_graph(
        ca.Function("jacobians", arguments, [elements, ca.densify(driving)]), (PARAMETER,), reciprocals=True
    )
    groups = [_column_group(model, integrator, scored, A, sensitivities, group) for group in sensitivities.groups]
    return DerivativeSpecification(tuple(groups), jacobians, n_stages)


def _symbols(model: SimulatedModel) -> list[ca.SX]:
    """State, inputs and parameters."""
    return [ca.SX.sym(name, n) for name, n in (("x", len(model.state)), ("u", model.n_u), ("p", model.n_p))]


def _jacobians(model: SimulatedModel, arguments: Sequence[ca.SX]) -> tuple[ca.SX, ca.SX]:
    """Derivatives ``(n_x + n_y, n_x)`` and ``(n_x + n_y, n_p)`` of the rates of the state, and below of the sensors.

    Sensors depend on the state and the parameters by way of the accelerations, too.
    """
    A, _, P = model.rate_jacobians(*arguments)
    x, u, p = arguments
    a = model.dynamics(x, u, p)[1]
    symbols = [ca.SX.sym(name, vector.numel()) for name, vector in zip("xaup", (x, a, u, p), strict=True)]
    y = model.readings(*symbols)
    if not y.numel():
        return A, P
    C, D, E = ca.Function("slopes", symbols, [ca.jacobian(y, symbols[k]) for k in (0, 1, 3)])(x, a, u, p)
    accelerations = slice(model.n_q, model.n_q + a.numel())
    return ca.vertcat(A, C + D @ A[accelerations, :]), ca.vertcat(P, D @ P[accelerations, :] + E)


def _slopes_of_signals(model: SimulatedModel, s: ca.SX, moved: ca.SX) -> ca.SX:
    """Derivatives of all signals, from those of the state, and of its rates with the sensors below."""
    n_accelerations = len(model.signals) - moved.numel()
    return ca.vertcat(s, moved[model.n_q : model.n_q + n_accelerations], moved[s.numel() :])


def _column_group(
    model: SimulatedModel,
    integrator: str,
    scored: Sequence[int],
    A: ca.SX,
    sensitivities: Sensitivities,
    unknowns: Sequence[int],
) -> ColumnGroup:
    """The integrator's step of a column of derivatives, s: that of the linear dynamics `A s + P` of each stage.

    Rows of A beyond those of the state are sensors', of which the first stage gives the derivatives.
    """
    from diransac.simulation.compiler.sensitivities import ColumnGroup

    n_rows, n_x = A.shape
    masks = (sensitivities.present, sensitivities.driven)
    present, driven = (np.flatnonzero(mask[:, unknowns[0]]).tolist() for mask in masks)
    column, h = ca.SX.sym("s", len(present)), ca.SX.sym("h")
    shared: list[ca.SX] = []
    driving: list[ca.SX] = []
    slopes_of_stages: list[ca.SX] = []

    def rates(s: ca.SX, _fraction: float) -> ca.SX:
        elements = [e if e.is_constant() else ca.SX.sym("a") for e in _elements(A)]
        shared.extend(e for e in elements if not e.is_constant())
        driving.append(ca.SX.sym("d", len(driven)))
        moved = ca.SX(A.sparsity(), ca.vertcat(ca.SX(0, 1), *elements)) @ s + _placed(driving[-1], driven, n_rows)
        slopes_of_stages.append(moved)
        return moved[:n_x]

    s = _placed(column, present, n_x)
    slope = rates(s, 0.0)
    after = INTEGRATORS[integrator](rates, s, h, slope, model.n_q)
    for four in model.quaternions:
        quaternion = ca.SX.sym("q", 4)
        after = _normalised(ca.horzcat(_placed(quaternion, four, n_x), after), [four])[:, 1]
        shared.append(quaternion)
    slopes = ca.sparsify(_slopes_of_signals(model, s, slopes_of_stages[0])[list(scored)])
    signals = slopes.sparsity().row()
    step = ca.Function(
        "column",
        [column, ca.vertcat(ca.SX(0, 1), *shared), ca.vertcat(*driving), h],
        [after[present], slopes[signals]],
    )
    return ColumnGroup(
        unknowns=tuple(unknowns),
        rows=tuple(present),
        initial=tuple(tuple(sensitivities.initial[present, k].tolist()) for k in unknowns),
        signals=tuple(signals),
        driven=tuple(tuple(i + k * n_rows for i in driven) for k in unknowns),
        step=read_graph(step, (1, 3), reciprocals=True),
    )


def _elements(matrix: ca.SX) -> list[ca.SX]:
    """Structural non-zeros, column by column."""
    return [matrix.nz[k] for k in range(matrix.nnz())]


def _placed(values: ca.SX, rows: Sequence[int], n: int) -> ca.SX:
    """Column (n,) that has values in some rows."""
    column = ca.SX(n, 1)
    for k, row in enumerate(rows):
        column[row] = values[k]
    return column


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
