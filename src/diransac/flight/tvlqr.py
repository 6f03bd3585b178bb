"""`tvlqr`: the feedback that holds a plant to a trajectory, and `Controller`, which it gives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from diransac.arrays import FloatArray
from diransac.errors import SettingsError
from diransac.flight.riccati import Problem, gains_of
from diransac.flight.trajectory import Trajectory
from diransac.model import Model
from diransac.model.plant import ModelWithParameters, as_plant
from diransac.simulation import LinearFeedback

__all__ = ["Controller", "tvlqr", "tvlqr_batch"]

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

    time: FloatArray
    states: FloatArray
    inputs: FloatArray
    gains: FloatArray
    u_min: FloatArray
    u_max: FloatArray
    state_names: tuple[str, ...] = ()
    input_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        law = LinearFeedback(self.inputs, self.states, self.gains, self.u_min, self.u_max)
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

    def law(self) -> LinearFeedback:
        """The controller as simulations take it, row by row."""
        return LinearFeedback(self.inputs, self.states, self.gains, self.u_min, self.u_max)

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


def _checked_time(time: npt.ArrayLike) -> FloatArray:
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

    Gains know the model as it is near the trajectory. Dry friction as a steep function, ``atan(100 v)``, is viscous and
    strong near ``v = 0``, and gains that rely on it destabilise a machine at rest: give its parameter as 0 here.

    Raises SettingsError: a trajectory of another model; weights or limits of other shape, names or definiteness.
    Raises PlanningError: the model has no finite derivatives on the trajectory, or the sweep does not stay finite.

    References: Anderson and Moore 1990, "Optimal Control: Linear Quadratic Methods", section 2.4; Bryson and Ho 1975,
    "Applied Optimal Control", section 5.2 (weights); Dimmig et al. 2023, section V.
    """
    return tvlqr_batch([plant], [trajectory], Q, R, Qf, limits=limits)[0]


def tvlqr_batch(
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
        raise SettingsError("the plants have different models; call tvlqr_batch for each model's own")
    for trajectory in trajectories:
        _check_columns(model, trajectory)
    weights = _Weights(model, Q, R, Qf)
    edges = [_edges(model, trajectory, limits) for trajectory in trajectories]
    problems = [
        Problem(np.array(list(plant.parameters.values())), trajectory, weights.Q, weights.effort(low, high), weights.Qf)
        for plant, trajectory, (low, high) in zip(known, trajectories, edges, strict=True)
    ]
    names = (model.state, tuple(model.inputs))
    return [
        Controller(reference.time, reference.states, reference.inputs, K, low, high, *names)
        for reference, K, (low, high) in zip(trajectories, gains_of(model, problems, threads), edges, strict=True)
    ]


# What is asked for --------------------------------------------------------------------------------------------------
def _check_columns(model: Model, trajectory: Trajectory) -> None:
    """Raises SettingsError: the trajectory is another model's, or the model has no inputs."""
    if not model.inputs:
        raise SettingsError(f'model "{model.name}" has no inputs; there is nothing to steer it with')
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


def _edges(model: Model, trajectory: Trajectory, limits: Limits | None) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest inputs (n_u,).

    Raises SettingsError: a name that isn't an input's, or limits that are no pair in order.
    """
    limits = trajectory.input_limits if limits is None else limits
    unknown = [name for name in limits if name not in model.inputs]
    if unknown:
        raise SettingsError(f'limits name "{unknown[0]}"; inputs are {", ".join(model.inputs)}')
    pairs = [limits.get(name, (-np.inf, np.inf)) for name in model.inputs]
    if not all(np.shape(pair) == (2,) and pair[0] <= pair[1] for pair in pairs):
        raise SettingsError(f"limits are {dict(limits)}, but each must be (lowest, highest)")
    low, high = np.array(pairs, np.float64).T
    return low, high


class _Weights:
    """Matrices Q and Qf, and R where it is given."""

    def __init__(self, model: Model, Q: Weights | None, R: Weights | None, Qf: Weights | None) -> None:
        errors = np.repeat([COORDINATE_ERROR, VELOCITY_ERROR], [model.n_q, model.n_v])
        self.Q = _matrix("Q", errors**-2.0 if Q is None else Q, model.state)
        self.Qf = FINAL_SECONDS * self.Q if Qf is None else _matrix("Qf", Qf, model.state)
        self._R = None if R is None else _matrix("R", R, tuple(model.inputs))
        if self._R is not None and np.linalg.eigvalsh(self._R).min(initial=np.inf) <= 0:
            found = self._R.tolist()
            raise SettingsError(f"R must be positive definite: each input needs a positive weight; found {found}")

    def effort(self, low: FloatArray, high: FloatArray) -> FloatArray:
        """R; if none is given, that for which the full use of each input within these limits is worth 1."""
        half = (high - low) / 2
        use = np.where(np.isfinite(half) & (half > 0), half, UNLIMITED_INPUT)
        return np.diag(use**-2.0) if self._R is None else self._R


def _matrix(name: str, weights: Weights, names: Sequence[str]) -> FloatArray:
    """Matrix of weights, from one of the forms that it may have.

    Raises SettingsError: a name that isn't known, another shape, no finite numbers, not symmetric, not semidefinite.
    """
    if isinstance(weights, Mapping):
        unknown = [key for key in weights if key not in names]
        if unknown:
            raise SettingsError(f'{name} weighs "{unknown[0]}", which is none of {", ".join(names)}')
        weights = [weights.get(key, 0.0) for key in names]
    try:
        array, n = np.array(weights, np.float64), len(names)
    except (TypeError, ValueError) as error:
        raise SettingsError(f"{name} is {weights!r:.80}, which is no array of numbers: {error}") from error
    if array.shape not in ((), (n,), (n, n)):
        raise SettingsError(
            f"{name} must be a matrix ({n}, {n}), its diagonal ({n},), one number, or numbers by name; found shape "
            f"{array.shape}"
        )
    matrix = array if array.ndim == 2 else np.diag(np.broadcast_to(array, n))
    largest = np.abs(matrix).max(initial=0.0)
    if not np.isfinite(largest) or (np.abs(matrix - matrix.T) > 1e-9 * largest).any():
        raise SettingsError(f"{name} must be finite and symmetric; found {matrix.tolist()}")
    lowest = np.linalg.eigvalsh(matrix)[0] if array.ndim == 2 else array.min(initial=0.0)
    if lowest < -1e-12 * largest:
        raise SettingsError(f"{name} must weigh no direction negatively; its smallest eigenvalue is {lowest:g}")
    return matrix
