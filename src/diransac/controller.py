"""`tvlqr`: the feedback that holds a plant to a trajectory, and `Controller`, which it gives.

The sweep runs backward in time: the one compiled recurrence serves hundreds of controllers at once, a lane each.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TypeAlias

import casadi as ca
import numpy as np
import numpy.typing as npt

from diransac.errors import PlanningError, SettingsError
from diransac.kernel import Map, Scan, compile_map, compile_scan
from diransac.model import Model
from diransac.plant import ModelWithParameters, as_plant
from diransac.simulate import Law, linearized_step
from diransac.trajectory import Trajectory

__all__ = ["Controller", "tvlqr", "tvlqr_all"]

Floats = npt.NDArray[np.float64]
Weights: TypeAlias = "npt.ArrayLike | Mapping[str, float]"
"""A matrix, its diagonal, one number for all of the diagonal, or the diagonal by name."""

Limits: TypeAlias = Mapping[str, tuple[float, float]]
"""Name of an input -> its lowest and highest value."""

COORDINATE_ERROR = 0.5
VELOCITY_ERROR = 1.0
UNLIMITED_INPUT = 1.0
FINAL_SECONDS = 1.0
"""The default weights, chosen once for all machines; `tvlqr` says what each means."""

_GRID = 1e-6
"""Of a row's length: by so little a time may lie before a row and still belong to it."""


# The controller ------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Controller:
    """``u[k] = clip(inputs[k] - gains[k] (x - states[k]), u_min, u_max)``, held from each row to the next.

    Parameters
    ----------
    time : (K,)   seconds, evenly spaced, at least 2 rows
    states : (K, n_x)   state to be held: coordinates, then velocities
    inputs : (K, n_u)   feed-forward, each input's unit
    gains : (K, n_u, n_x)   each input's unit over each state's
    u_min, u_max : (n_u,)   limits of the inputs, infinite where there is none
    state_names, input_names : names of the columns

    The arrays are copies and read-only.

    Raises SettingsError: arrays that do not fit together, a time that is not even, a number that isn't finite, or
    limits that leave no room.
    """

    time: Floats
    states: Floats
    inputs: Floats
    gains: Floats
    u_min: Floats
    u_max: Floats
    state_names: tuple[str, ...] = ()
    input_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        law = Law(self.inputs, self.states, self.gains, self.u_min, self.u_max)
        time = _checked_time(self.time)
        if time.shape != law.u_ref.shape[:1]:
            raise SettingsError(
                f"a controller needs time (K,), states (K, n_x), inputs (K, n_u) and gains (K, n_u, n_x); found "
                f"{time.shape}, {law.x_ref.shape}, {law.u_ref.shape} and {law.gains.shape}"
            )
        for name, n in (("state", law.n_x), ("input", law.n_u)):
            names = tuple(getattr(self, f"{name}_names"))
            if names and len(names) != n:
                raise SettingsError(f"the controller has {n} {name}s and {len(names)} {name}_names")
            object.__setattr__(self, f"{name}_names", names)
        time.flags.writeable = False
        arrays = {"states": law.x_ref, "inputs": law.u_ref, "gains": law.gains, "u_min": law.u_min, "u_max": law.u_max}
        for name, array in {"time": time, **arrays}.items():
            object.__setattr__(self, name, array)

    @property
    def dt(self) -> float:
        """Time from row to row, seconds."""
        return float((self.time[-1] - self.time[0]) / (len(self.time) - 1))

    def __len__(self) -> int:
        return len(self.time)

    def law(self) -> Law:
        """The controller as simulations take it, row by row."""
        return Law(self.inputs, self.states, self.gains, self.u_min, self.u_max)

    def at(self, time: npt.ArrayLike, how: str = "hold") -> Controller:
        """The controller on another time grid; before its first row and after its last it stays what it is there.

        Parameters
        ----------
        time : (n_rows,)   seconds, evenly spaced, at least 2 rows
        how : ``"hold"`` holds a row to the next; ``"linear"`` interpolates states and gains. Inputs are held in both

        Raises SettingsError: another word, or a time that is not even.
        """
        if how not in ("hold", "linear"):
            raise SettingsError(f'how is {how!r}; a controller can "hold" its rows, or be "linear" between them')
        wanted = _checked_time(time)
        rows = np.maximum(np.searchsorted(self.time, wanted + _GRID * self.dt, side="right") - 1, 0)
        names = (self.state_names, self.input_names)
        states, gains = self.states[rows], self.gains[rows]
        if how == "linear":
            after = np.minimum(rows + 1, len(self) - 1)
            share = np.clip((wanted - self.time[rows]) / self.dt, 0.0, 1.0)
            states = states + share[:, None] * (self.states[after] - states)
            gains = gains + share[:, None, None] * (self.gains[after] - gains)
        return Controller(wanted, states, self.inputs[rows], gains, self.u_min, self.u_max, *names)

    def __reduce__(self) -> tuple[object, ...]:
        arrays = (self.time, self.states, self.inputs, self.gains, self.u_min, self.u_max)
        return (Controller, (*arrays, self.state_names, self.input_names))


def _checked_time(time: npt.ArrayLike) -> Floats:
    """A copy of the time, read-only.

    Raises SettingsError: it is not even.
    """
    array = np.array(time, np.float64)
    steps = np.diff(array) if array.ndim == 1 else np.zeros(0)
    if not len(steps) or not (steps > 0).all() or np.ptp(steps) > 1e-6 * steps.mean():
        raise SettingsError(
            f"a controller's time must increase evenly, in at least 2 rows; found an array of shape {array.shape}"
        )
    array.flags.writeable = False
    return array


# What users call -----------------------------------------------------------------------------------------------------
def tvlqr(
    plant: ModelWithParameters,
    trajectory: Trajectory,
    Q: Weights | None = None,
    R: Weights | None = None,
    Qf: Weights | None = None,
    *,
    limits: Limits | None = None,
) -> Controller:
    """Time-varying LQR along a trajectory: the least ``integral of e'Q e + d'R d dt + e_K'Qf e_K`` to first order.

    ``e = x - x[k]`` and ``d = u - u[k]`` are errors of state and input. From ``S[K] = Qf`` back to the first row::

        K[k] = (R dt + B'S B)^-1 B'S A,    S[k] = Q dt + A'S (A - B K[k]),    S = S[k+1]

    with ``A, B = d x[k+1] / d(x[k], u[k])`` of the step that a simulation takes from row to row: RK4, the input held,
    quaternions scaled to length one. So the controller is optimal at its own rate, and nears the continuous one as dt
    goes to 0. The last row counts as lasting dt, too.

    Parameters
    ----------
    plant : a `Plant` or `Result`; its model and parameters count, not its disturbances
    trajectory : what is to be held
    Q : (n_x, n_x) or (n_x,), one number, or name -> weight (0 where not named)   positive semidefinite, 1/s over each
        state's unit squared
    R : the same of inputs, (n_u, n_u)   positive definite
    Qf : the same of states at the end, not over time   positive semidefinite
    limits : input's name -> (lowest, highest) that the law clips to; the trajectory's by default. The gains don't know

    The default weights are Bryson's rule, untuned: an error of 0.5 in a coordinate (m, rad) or of 1 in a velocity (m/s,
    rad/s) is worth as much as the full use of an input, which is half the range of its limits, or 1 where it has none.
    ``Qf`` is ``Q`` times 1 s by default. The four numbers of a quaternion are coordinates like others: errors along its
    length, which no input can change, end within a step.

    Raises SettingsError: a trajectory of another model; weights or limits of other shape, names or definiteness.
    Raises PlanningError: the model has no finite derivatives on the trajectory, or the sweep does not stay finite.

    References: Anderson and Moore 1990, "Optimal Control: Linear Quadratic Methods", section 2.4; Bryson and Ho 1975,
    "Applied Optimal Control", section 5.2 (weights); Dimmig et al. 2023, section V.
    """
    return tvlqr_all([plant], [trajectory], Q, R, Qf, limits=limits)[0]


def tvlqr_all(
    plants: Sequence[ModelWithParameters],
    trajectories: Sequence[Trajectory],
    Q: Weights | None = None,
    R: Weights | None = None,
    Qf: Weights | None = None,
    *,
    limits: Limits | None = None,
    threads: int = 1,
) -> list[Controller]:
    """`tvlqr` of many plants that share their model, each along its own trajectory: the same controllers, sooner.

    Parameters
    ----------
    plants, trajectories : one of each a controller; the trajectories may differ in length and dt
    Q, R, Qf, limits : as `tvlqr` has them, for all
    threads : how many blocks of eight controllers are computed at a time; it changes no answer

    Raises SettingsError: not as many plants as trajectories, or plants of different models; else as `tvlqr`.
    """
    if len(plants) != len(trajectories):
        raise SettingsError(
            f"there are {len(plants)} plants and {len(trajectories)} trajectories; give a pair for each"
        )
    if not plants:
        return []
    known = [as_plant(plant) for plant in plants]
    model = known[0].model
    if any(plant.model.fingerprint != model.fingerprint for plant in known):
        raise SettingsError("the plants have different models; call tvlqr_all for each model's own")
    tasks = [
        _task(model, np.array(list(plant.parameters.values())), trajectory, limits)
        for plant, trajectory in zip(known, trajectories, strict=True)
    ]
    weights = [_weights(model, task, Q, R, Qf) for task in tasks]
    gains = _sweep(_Equations(model.fingerprint, model)).gains(tasks, weights, threads)
    return [_controller(model, task, K) for task, K in zip(tasks, gains, strict=True)]


# One of many ---------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class _Task:
    """A controller to be made: parameters (n_p,), trajectory, limits (n_u,) each."""

    parameters: Floats
    trajectory: Trajectory
    u_min: Floats
    u_max: Floats


def _task(model: Model, parameters: Floats, trajectory: Trajectory, limits: Limits | None) -> _Task:
    """Check that a trajectory is the model's, and find its limits."""
    for kind, names, found, array in (
        ("states", model.state, trajectory.state_names, trajectory.states),
        ("inputs", tuple(model.inputs), trajectory.input_names, trajectory.inputs),
    ):
        if array.shape[1] != len(names) or (found and found != names):
            has = ", ".join(found) or f"{array.shape[1]} columns"
            raise SettingsError(
                f'the trajectory\'s {kind} are {has}, but model "{model.name}" has {", ".join(names)}; give a '
                "trajectory of this model"
            )
    given = trajectory.input_limits if limits is None else limits
    unknown = [name for name in given if name not in model.inputs]
    if unknown:
        raise SettingsError(f'limits name "{unknown[0]}"; inputs are {", ".join(model.inputs)}')
    edges = np.array([given.get(name, (-np.inf, np.inf)) for name in model.inputs], np.float64).reshape(-1, 2)
    if not (edges[:, 0] <= edges[:, 1]).all():
        raise SettingsError(f"limits are {dict(given)}, but each must be (lowest, highest)")
    return _Task(parameters, trajectory, edges[:, 0], edges[:, 1])


def _controller(model: Model, task: _Task, gains: Floats) -> Controller:
    """The controller with these gains (K, n_u, n_x).

    Raises PlanningError: some of them are not finite.
    """
    trajectory = task.trajectory
    lost = np.flatnonzero(~np.isfinite(gains).all(axis=(1, 2)))
    if len(lost):
        raise PlanningError(
            f'the Riccati sweep of model "{model.name}" did not stay finite and positive: back from the end it was '
            f"lost at t = {trajectory.time[lost[-1]]:g} s; give R larger or Q and Qf smaller numbers, or a shorter "
            "trajectory"
        )
    names = (model.state, tuple(model.inputs))
    return Controller(trajectory.time, trajectory.states, trajectory.inputs, gains, task.u_min, task.u_max, *names)


# Weights -------------------------------------------------------------------------------------------------------------
def _weights(
    model: Model, task: _Task, Q: Weights | None, R: Weights | None, Qf: Weights | None
) -> tuple[Floats, Floats, Floats]:
    """Matrices Q, R and Qf."""
    inputs, states = tuple(model.inputs), model.state
    errors = np.repeat([COORDINATE_ERROR, VELOCITY_ERROR], [model.n_q, model.n_v])
    half = (task.u_max - task.u_min) / 2
    use = np.where(np.isfinite(half) & (half > 0), half, UNLIMITED_INPUT)
    running = _matrix("Q", errors**-2.0 if Q is None else Q, states)
    effort = _matrix("R", use**-2.0 if R is None else R, inputs)
    if len(inputs) and np.linalg.eigvalsh(effort)[0] <= 0:
        raise SettingsError(f"R must be positive definite, every input with a positive weight; found {effort.tolist()}")
    return running, effort, FINAL_SECONDS * running if Qf is None else _matrix("Qf", Qf, states)


def _matrix(name: str, weights: Weights, names: Sequence[str]) -> Floats:
    """Matrix of weights, from one of the forms that it may have.

    Raises SettingsError: a name that isn't known, another shape, no finite numbers, not symmetric, not semidefinite.
    """
    if isinstance(weights, Mapping):
        unknown = [key for key in weights if key not in names]
        if unknown:
            raise SettingsError(f'{name} weighs "{unknown[0]}", which is none of {", ".join(names)}')
        weights = [weights.get(key, 0.0) for key in names]
    array, n = np.array(weights, np.float64), len(names)
    if array.shape not in ((), (n,), (n, n)):
        raise SettingsError(
            f"{name} must be a matrix ({n}, {n}), its diagonal ({n},), one number, or numbers by name; found shape "
            f"{array.shape}"
        )
    matrix = array if array.ndim == 2 else np.diag(np.broadcast_to(array, n))
    if not np.isfinite(matrix).all() or not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0.0):
        raise SettingsError(f"{name} must be finite and symmetric; found {matrix.tolist()}")
    eigenvalues = np.linalg.eigvalsh(matrix)
    if n and eigenvalues[0] < -1e-12 * np.abs(eigenvalues).max():
        raise SettingsError(
            f"{name} must not be negative in any direction; its smallest eigenvalue is {eigenvalues[0]:g}"
        )
    return matrix


# The sweep -----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class _Equations:
    """A model as a value: equal ones are compiled once."""

    fingerprint: str
    model: Model = field(compare=False, repr=False)


@dataclass(frozen=True)
class _Sweep:
    """Compiled for one model.

    Attributes
    ----------
    name : the model's
    linearize : (x, u, p, h) -> those entries of A and B that vary
    riccati : S, entries, weights -> S a row earlier, gains
    n_x, n_u : sizes
    """

    name: str
    linearize: Map
    riccati: Scan
    n_x: int
    n_u: int

    def gains(
        self, tasks: Sequence[_Task], weights: Sequence[tuple[Floats, Floats, Floats]], threads: int
    ) -> list[Floats]:
        """Gains (K, n_u, n_x) of each task."""
        entries = [self._entries(task, threads) for task in tasks]
        lengths = [len(task.trajectory) for task in tasks]
        # Backward in time, the shorter ones go on with their first row, and what they give then is left.
        rows = [np.pad(e[::-1], ((0, max(lengths) - len(e)), (0, 0)), mode="edge") for e in entries]
        steps = [task.trajectory.dt for task in tasks]
        constants = [
            np.concatenate([_upper(Q) * dt, _upper(R) * dt]) for dt, (Q, R, _) in zip(steps, weights, strict=True)
        ]
        ends = [_upper(Qf) for _, _, Qf in weights]
        found = self.riccati(np.array(ends), np.array(rows), np.array(constants), threads=threads)
        return [
            one[:length][::-1].reshape(length, self.n_x, self.n_u).swapaxes(1, 2)
            for one, length in zip(found, lengths, strict=True)
        ]

    def _entries(self, task: _Task, threads: int) -> Floats:
        """Varying entries of A and B (K, n_entries).

        Raises PlanningError: one is not finite.
        """
        trajectory = task.trajectory
        arrays = (trajectory.states, trajectory.inputs, task.parameters, np.array([trajectory.dt]))
        (entries,) = self.linearize(*arrays, threads=threads)
        lost = np.flatnonzero(~np.isfinite(entries).all(axis=1))
        if len(lost):
            raise PlanningError(
                f'model "{self.name}" has no finite derivatives on the trajectory at '
                f"t = {trajectory.time[lost[0]]:g} s: x = {trajectory.states[lost[0]].tolist()}, "
                f"u = {trajectory.inputs[lost[0]].tolist()}, parameters {task.parameters.tolist()}; check the "
                "parameters, or lead the trajectory around this state"
            )
        return entries


@lru_cache(maxsize=64)
def _sweep(equations: _Equations) -> _Sweep:
    """What is compiled for a model."""
    model = equations.model
    step = linearized_step(model)
    arguments = [ca.SX.sym(name, step.sparsity_in(name)) for name in step.name_in()]
    _, A, B = step(*arguments)
    varying = [e for M in (A, B) for e in ca.vertsplit(M.nz[:]) if not e.is_constant()]
    linearize = compile_map(ca.Function("linearize", arguments, [ca.vertcat(*varying, ca.SX(0, 1))]))
    return _Sweep(model.name, linearize, compile_scan(_riccati_step(A, B)), len(model.state), model.n_u)


def _riccati_step(A: ca.SX, B: ca.SX) -> ca.Function:
    """Recurrence (S, varying entries of A and B, [Q dt; R dt]) -> (S a row earlier, gains column by column).

    Of symmetric matrices there is the upper triangle alone. A pivot of R dt + B'S B that is not positive becomes NaN:
    it would be the end of a sweep that has lost its precision.
    """
    n_x, n_u = B.shape
    entries: list[ca.SX] = []
    A, B = (_with_symbols(M, entries) for M in (A, B))
    S, Q, R = (ca.SX.sym(name, ca.Sparsity.upper(n)) for name, n in (("S", n_x), ("Q", n_x), ("R", n_u)))
    SA, SB = ca.triu2symm(S) @ A, ca.triu2symm(S) @ B
    G = ca.densify(B.T @ SA)
    D, LT, order = ca.ldl(ca.densify(ca.triu2symm(R) + B.T @ SB))
    K = ca.ldl_solve(G, ca.if_else(D > 0, D, np.nan), LT, order)
    before = ca.triu(Q + A.T @ SA - G.T @ K)
    arguments = [S.nz[:], ca.vertcat(*entries, ca.SX(0, 1)), ca.vertcat(Q.nz[:], R.nz[:])]
    return ca.Function("riccati", arguments, [before.nz[:], ca.vec(K)], ["S", "row", "weights"], ["before", "K"])


def _with_symbols(matrix: ca.SX, entries: list[ca.SX]) -> ca.SX:
    """The matrix with a new symbol, added to `entries`, in the place of every entry that isn't constant."""
    values = ca.vertsplit(matrix.nz[:])
    for k, value in enumerate(values):
        if not value.is_constant():
            values[k] = ca.SX.sym(f"e{len(entries)}")
            entries.append(values[k])
    return ca.SX(matrix.sparsity(), ca.vertcat(*values, ca.SX(0, 1)))


def _upper(matrix: Floats) -> Floats:
    """Upper triangle, column by column."""
    return matrix.T[np.tril_indices(len(matrix))]
