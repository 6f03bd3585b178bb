"""What Drake offers for the same work, for `flight.py`: plan the square, and build finite-horizon LQR along it.

The rotorcraft is a `SymbolicVectorSystem`, which Drake differentiates without Python.  Everything raises ImportError
where Drake is absent: it comes with ``pip install .[drake]``.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]
ARM_LENGTH, GRAVITY = 0.177, 9.81


@dataclass(frozen=True)
class Square:
    """The plan's problem in numbers: knots of equal steps, quadratic costs of inputs and of places.

    Attributes
    ----------
    step : seconds from knot to knot
    corners : knot -> (x, z)
    route, route_weight : (n_knots, 2) and 1/(m^2 s), places that it is drawn to, and how much
    lowest, highest : (2,)   of the inputs
    half_ranges : (2,)   of the inputs, whose squares over these cost 1/s
    """

    step: float
    corners: dict[int, tuple[float, float]]
    route: Array
    route_weight: float
    lowest: Array
    highest: Array
    half_ranges: Array


def rotorcraft(parameters: Sequence[float], period: float = 0.0) -> Any:
    """Eq. (4), for positive thrust; with a period the discrete system of one Runge-Kutta step."""
    import pydrake.all as drake

    mass, inertia, drag = parameters
    x, u = drake.MakeVectorVariable(6, "x"), drake.MakeVectorVariable(2, "u")

    def rates(x: Any) -> Any:
        s, c = drake.sin(x[2]), drake.cos(x[2])
        along, up = u[0] * s + drag * u[0] * x[3] * c, u[0] * c - drag * u[0] * x[4] * s
        return np.array([*x[3:], -along / mass, up / mass - GRAVITY, ARM_LENGTH * u[1] / inertia])

    if not period:
        return drake.SymbolicVectorSystem(state=x, input=u, dynamics=rates(x))
    with np.errstate(invalid="ignore"):  # NumPy takes Drake's expressions for numbers
        first = rates(x)
        second = rates(x + period / 2 * first)
        third = rates(x + period / 2 * second)
        after = x + period / 6 * (first + 2 * second + 2 * third + rates(x + period * third))
    return drake.SymbolicVectorSystem(state=x, input=u, dynamics=after, time_period=period)


# Planning ------------------------------------------------------------------------------------------------------------
def transcription(square: Square, parameters: Sequence[float]) -> Any:
    """`DirectTranscription` of the discrete system, one Runge-Kutta step from knot to knot, the input held."""
    import pydrake.all as drake

    system = rotorcraft(parameters, square.step)
    program = drake.DirectTranscription(system, system.CreateDefaultContext(), len(square.route))
    _pose(program, square, parameters, np.full(len(square.route) - 1, square.step))
    return program


def collocation(square: Square, parameters: Sequence[float]) -> Any:
    """`DirectCollocation`: cubic states, linear inputs; its steps are unknowns, which bounds fix."""
    import pydrake.all as drake

    n, h = len(square.route), square.step
    system = rotorcraft(parameters)
    program = drake.DirectCollocation(system, system.CreateDefaultContext(), n, h, h)
    _pose(program, square, parameters, h * np.concatenate([[0.5], np.ones(n - 2), [0.5]]))
    return program


def _pose(program: Any, square: Square, parameters: Sequence[float], durations: Array) -> None:
    """Costs and constraints; a duration for each input that is an unknown."""
    prog, n = program.prog(), len(square.route)
    trim = np.array([parameters[0] * GRAVITY, 0.0])
    for k, duration in enumerate(durations):
        prog.AddBoundingBoxConstraint(square.lowest, square.highest, program.input(k))
        prog.AddQuadraticErrorCost(np.diag(duration / square.half_ranges**2), trim, program.input(k))
    for k, place in enumerate(square.route):
        share = 0.5 if k in (0, n - 1) else 1.0
        weight = share * square.step * square.route_weight
        prog.AddQuadraticErrorCost(weight * np.eye(2), place, program.state(k)[:2])
    for k, corner in square.corners.items():
        prog.AddBoundingBoxConstraint(corner, corner, program.state(k)[:2])
    for k in (0, n - 1):
        prog.AddBoundingBoxConstraint(np.zeros(4), np.zeros(4), program.state(k)[2:])


def solved(program: Any, guess: tuple[Array, Array, Array], solver: str, tolerance: float | None) -> float:
    """Cost of the solution that a solver finds from a guess: time (K,), states (K, 6), inputs (K, 2).

    Raises RuntimeError: it finds none.
    """
    import pydrake.all as drake

    time, states, inputs = guess
    hold = drake.PiecewisePolynomial.FirstOrderHold
    program.SetInitialTrajectory(hold(time, inputs.T), hold(time, states.T))
    chosen = {"SNOPT": drake.SnoptSolver, "IPOPT": drake.IpoptSolver}[solver]
    option = {"SNOPT": "Major optimality tolerance", "IPOPT": "tol"}[solver]
    options = drake.SolverOptions()
    if tolerance is not None:
        options.SetOption(chosen.id(), option, tolerance)
    found = chosen().Solve(program.prog(), program.prog().initial_guess(), options)
    if not found.is_success():
        raise RuntimeError(f"Drake's {solver} found no plan: {found.get_solution_result()}")
    return float(found.get_optimal_cost())


# Steering ------------------------------------------------------------------------------------------------------------
def regulator(
    parameters: Sequence[float], rows: tuple[Array, Array, Array], weights: tuple[Array, Array, Array], period: float
) -> Any:
    """`FiniteHorizonLinearQuadraticRegulator` along rows: time (K,), states (K, 6), inputs (K, 2); its gains over time.

    Parameters
    ----------
    weights : Q and R over continuous time, Qf
    period : of the discrete system; 0 for the continuous one
    """
    import pydrake.all as drake

    time, states, inputs = rows
    Q, R, Qf = weights
    system = rotorcraft(parameters, period)
    hold = drake.PiecewisePolynomial.ZeroOrderHold if period else drake.PiecewisePolynomial.FirstOrderHold
    options = drake.FiniteHorizonLinearQuadraticRegulatorOptions()
    options.x0, options.Qf = hold(time, states.T), Qf
    options.u0 = drake.PiecewisePolynomial.ZeroOrderHold(time, inputs.T)
    scale = period or 1.0
    found = drake.FiniteHorizonLinearQuadraticRegulator(
        system, system.CreateDefaultContext(), time[0], time[-1], scale * Q, scale * R, options
    )
    return found.K
