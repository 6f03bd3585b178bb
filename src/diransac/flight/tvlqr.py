"""Time-varying LQR: `tvlqr`, and the `Controller` that it returns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from diransac.arrays import FloatArray
from diransac.data.preprocessing import continuous_quaternions
from diransac.errors import SettingsError, check_known
from diransac.flight.riccati import Problem, gains_of
from diransac.flight.trajectory import InputLimits, Trajectory, half_ranges, is_even
from diransac.model import Model
from diransac.model.plant import ModelWithParameters, as_plant
from diransac.simulation import LinearFeedback

Weights: TypeAlias = "npt.ArrayLike | Mapping[str, float]"
"""Matrix, diagonal, one number for the whole diagonal, or diagonal by name."""


# The controller ------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Controller:
    """Feedback law ``u[k] = clip(inputs[k] - gains[k] (x - states[k]), u_min, u_max)``, held from row to row.

    Parameters
    ----------
    time : (K,) array
        s, evenly spaced, at least 2 rows.
    states : (K, n_x) array
        Reference: coordinates, then velocities.
    inputs : (K, n_u) array
        Feed-forward, each input's unit.
    gains : (K, n_u, n_x) array
        Each input's unit over each state's.
    u_min, u_max : (n_u,) array
        Limits of the inputs, infinite where there are none.
    state_names, input_names : tuple of str
        Names of the columns.

    Raises
    ------
    SettingsError
        Arrays that do not fit together, a time that is not evenly spaced, a number that is not finite, or lower limits
        above upper ones.

    Notes
    -----
    The arrays are copies and read-only.
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
        arrays = {"states": law.x_ref, "inputs": law.u_ref, "gains": law.gains, "u_min": law.u_min, "u_max": law.u_max}
        for name, array in {"time": time, **arrays}.items():
            object.__setattr__(self, name, array)

    @property
    def dt(self) -> float:
        """Time from row to row, seconds."""
        return float((self.time[-1] - self.time[0]) / (len(self.time) - 1))

    def __len__(self) -> int:
        return len(self.time)

    def unclipped(self) -> Controller:
        """The same law without limits of its inputs."""
        nowhere = np.full(self.inputs.shape[1], np.inf)
        return replace(self, u_min=-nowhere, u_max=nowhere)

    def law(self) -> LinearFeedback:
        """Feedback law for simulations, row by row."""
        return LinearFeedback(self.inputs, self.states, self.gains, self.u_min, self.u_max)

    def at(self, time: npt.ArrayLike) -> Controller:
        """Controller on another time grid (n_rows,), s, evenly spaced, at least 2 rows: each takes the last row before.

        Raises SettingsError: the time is not evenly spaced.
        """
        wanted = _checked_time(time)
        # Tolerance, as a fraction of dt, within which a time counts as that of a row.
        rows = np.maximum(np.searchsorted(self.time, wanted + 1e-6 * self.dt, side="right") - 1, 0)
        return replace(self, time=wanted, states=self.states[rows], inputs=self.inputs[rows], gains=self.gains[rows])

    def __reduce__(self) -> tuple[object, ...]:
        return (Controller, tuple(getattr(self, x.name) for x in fields(self)))


def _checked_time(time: npt.ArrayLike) -> FloatArray:
    """Read-only copy of the time.

    Raises SettingsError: it is not evenly spaced.
    """
    array = np.array(time, np.float64)
    if array.ndim != 1 or not is_even(array):
        raise SettingsError(
            f"a controller's time must increase evenly, in at least 2 rows; found an array of shape {array.shape}"
        )
    array.flags.writeable = False
    return array


# Design --------------------------------------------------------------------------------------------------------------
def tvlqr(
    plant: ModelWithParameters,
    trajectory: Trajectory,
    Q: Weights | None = None,
    R: Weights | None = None,
    Qf: Weights | None = None,
    *,
    limits: InputLimits | None = None,
) -> Controller:
    """Time-varying LQR: minimum of ``integral of e'Q e + d'R d dt + e_K'Qf e_K`` to first order along a trajectory.

    ``e = x - x[k]`` and ``d = u - u[k]`` are errors of state and input. From ``S[K] = Qf`` back to the first row::

        K[k] = (R dt + B'S B)^-1 B'S A,    S[k] = Q dt + A'S (A - B K[k]),    S = S[k+1]

    with ``A, B = d x[k+1] / d(x[k], u[k])`` of one simulation step from row to row: RK4, the input held, quaternions
    scaled to norm one.

    Parameters
    ----------
    plant : Plant or Result
        Model and parameters; disturbances are ignored.
    trajectory : Trajectory
        The reference.
    Q : (n_x, n_x) or (n_x,) array, float, or mapping of str to float, optional
        Positive semidefinite, 1/s over each state's unit squared; in a mapping 0 where not named.
    R : (n_u, n_u) or (n_u,) array, float, or mapping of str to float, optional
        Positive definite, 1/s over each input's unit squared.
    Qf : as Q, optional
        Weights of the final state, positive semidefinite, one over each state's unit squared.
    limits : mapping of str to (float, float), optional
        Smallest and largest value of each input, to which the law is clipped; the trajectory's by default. The gains do
        not depend on them if R is given.

    Raises
    ------
    SettingsError
        A trajectory of another model; weights or limits of wrong shape, names or definiteness.
    PlanningError
        The model has no finite derivatives on the trajectory, or the recurrence does not stay finite.

    Notes
    -----
    The default weights follow Bryson's rule and are not tuned: an error of 0.5 in a coordinate (m, rad) or of 1 in a
    velocity (m/s, rad/s) costs as much as full use of an input, which is half the range of its limits, or 1 without
    limits. A state of first order has no weight where the model has coordinates, whose motion it serves, and that of a
    velocity otherwise. ``Qf`` is ``Q`` times 1 s by default. An attitude error of 0.5 rad is one of 0.25 in its
    quaternion.

    The controller is optimal at its own rate and converges to the continuous one for dt to 0; the last row counts as
    lasting dt. Errors of a quaternion are in the tangent space of the reference's: the gains are orthogonal to it, and
    act on the vector part of the error quaternion, half the attitude error to first order. Changes of its sign along
    the trajectory are undone before.

    Gains rely on the linearised model. Dry friction written as a steep function, ``atan(100 v)``, is linearised as
    strong viscous friction near ``v = 0``, and the resulting gains destabilise a plant at rest: set its parameter to 0.

    References
    ----------
    Anderson and Moore 1990, "Optimal Control: Linear Quadratic Methods", section 2.4; Bryson and Ho 1975, "Applied
    Optimal Control", section 5.2 (weights); Dimmig et al. 2023, section V.
    """
    return tvlqr_batch([plant], [trajectory], Q, R, Qf, limits=limits)[0]


def tvlqr_batch(
    plants: Sequence[ModelWithParameters],
    trajectories: Sequence[Trajectory],
    Q: Weights | None = None,
    R: Weights | None = None,
    Qf: Weights | None = None,
    *,
    limits: InputLimits | None = None,
    threads: int = 1,
) -> list[Controller]:
    """Controllers of `tvlqr` for many plants of one model, each along its own trajectory, in less time.

    Parameters
    ----------
    plants : sequence of Plant or Result
        One per controller.
    trajectories : sequence of Trajectory
        One per controller; lengths and dt may differ.
    Q, R, Qf, limits
        As in `tvlqr`, for all.
    threads : int
        Number of vectors of eight controllers computed at once. It changes no result.

    Raises
    ------
    SettingsError
        Not as many plants as trajectories, or plants of different models; otherwise as `tvlqr`.
    PlanningError
        As `tvlqr`.
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
    trajectories = [_with_continuous_attitude(model, trajectory) for trajectory in trajectories]
    of_states, of_inputs, at_end = _cost_matrices(model, Q, R, Qf)
    edges = [_limits_of(model, trajectory, limits) for trajectory in trajectories]
    problems = [
        Problem(
            np.array(list(plant.parameters.values())),
            trajectory,
            of_states,
            np.diag(half_ranges(*ends) ** -2.0) if of_inputs is None else of_inputs,  # full use costs 1
            at_end,
        )
        for plant, trajectory, ends in zip(known, trajectories, edges, strict=True)
    ]
    names, gains = (model.state, tuple(model.inputs)), gains_of(model, problems, threads)
    return [
        Controller(reference.time, reference.states, reference.inputs, K, *ends, *names)
        for reference, K, ends in zip(trajectories, gains, edges, strict=True)
    ]


# Arguments -----------------------------------------------------------------------------------------------------------
def check_weights(model: Model, Q: Weights | None, R: Weights | None, Qf: Weights | None) -> None:
    """Raise SettingsError: weights of `tvlqr` of wrong shape, names or definiteness for this model."""
    _cost_matrices(model, Q, R, Qf)


def _check_columns(model: Model, trajectory: Trajectory) -> None:
    """Raise SettingsError if the trajectory is another model's, or the model has no inputs."""
    if not model.inputs:
        raise SettingsError(f'model "{model.name}" has no inputs; a controller needs at least one')
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


def _with_continuous_attitude(model: Model, trajectory: Trajectory) -> Trajectory:
    """The trajectory, whose quaternions have unit norm and no changes of sign, along which gains are derived."""
    states = trajectory.states.copy()
    for four in model.quaternions:
        states[:, list(four)] = continuous_quaternions(states[:, list(four)])
    return trajectory if np.array_equal(states, trajectory.states) else replace(trajectory, states=states)


def _limits_of(model: Model, trajectory: Trajectory, limits: InputLimits | None) -> tuple[FloatArray, FloatArray]:
    """Smallest and largest inputs (n_u,).

    Raises SettingsError: an unknown name, or limits that are not a pair in increasing order.
    """
    limits = trajectory.input_limits if limits is None else limits
    check_known(limits, model.inputs, "limits name", "inputs are")
    pairs = [limits.get(name, (-np.inf, np.inf)) for name in model.inputs]
    if not all(np.shape(pair) == (2,) and pair[0] <= pair[1] for pair in pairs):
        raise SettingsError(f"limits are {dict(limits)}, but each must be (lowest, highest)")
    low, high = np.array(pairs, np.float64).T
    return low, high


def _cost_matrices(
    model: Model, Q: Weights | None, R: Weights | None, Qf: Weights | None
) -> tuple[FloatArray, FloatArray | None, FloatArray]:
    """Matrices Q, R and Qf; R is None by default, where it depends on limits.

    Raises SettingsError: weights of wrong shape, names or definiteness.
    """
    # Default weights, explained in `tvlqr`; they are not tuned to any plant.
    errors = np.repeat([0.5, 1.0], [model.n_q, model.n_v])
    for four in model.quaternions:
        # Error of a quaternion per error of the attitude, 1/rad.
        errors[list(four)] *= 0.5
    weights = errors**-2.0
    if model.n_q:
        weights[len(weights) - len(model.first_order) :] = 0.0
    of_states = _matrix("Q", weights if Q is None else Q, model.state)
    of_inputs = None if R is None else _matrix("R", R, tuple(model.inputs))
    if of_inputs is not None and np.linalg.eigvalsh(of_inputs).min(initial=np.inf) <= 0:
        raise SettingsError(
            f"R must be positive definite: each input needs a positive weight; found {of_inputs.tolist()}"
        )
    return of_states, of_inputs, of_states if Qf is None else _matrix("Qf", Qf, model.state)


def _matrix(name: str, weights: Weights, names: Sequence[str]) -> FloatArray:
    """Weight matrix from any of its forms.

    Raises SettingsError: an unknown name, another shape, not finite, not symmetric, or not positive semidefinite.
    """
    if isinstance(weights, Mapping):
        check_known(weights, names, f"{name} weighs", "there are")
        weights = [weights.get(key, 0.0) for key in names]
    try:
        array, n = np.array(weights, np.float64), len(names)
    except (TypeError, ValueError) as error:
        raise SettingsError(f"{name} is {weights!r:.80}, which is not an array of numbers: {error}") from error
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
        raise SettingsError(f"{name} must be positive semidefinite; its smallest eigenvalue is {lowest:g}")
    return matrix
