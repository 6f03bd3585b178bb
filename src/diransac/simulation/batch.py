"""Arrays that a simulator takes and returns; a lane is one rollout of a batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.errors import SettingsError
from diransac.simulation.compiler.lanes import checked_array, squared_thresholds
from diransac.simulation.compiler.machine_code import LANES


# Arguments -----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class RolloutBatch:
    """Lanes of one call: each a rollout with its own parameters, initial state and, with `start_rows`, rows of the log.

    Parameters
    ----------
    parameters : (n_lanes, n_p)
        Each parameter's unit.
    initial_states : (n_x,) or (n_lanes, n_x)
        Coordinates, then velocities; one state for all lanes, or one per lane.
    inputs : (n_log, n_u)
        Held from each row to the next, or interpolated, as the simulator is made. `Simulator.fly` uses their number of
        rows only.
    dt : float
        Time from row to row, s.
    start_rows : (n_lanes,), optional
        Row at which each lane starts; row 0 by default.
    n_rows : int, optional
        Rows that a lane simulates; the whole log by default, required with `start_rows`.
    first_rows : (n,), optional
        First row of each log where the rows are those of several logs, in order; smooth inputs of one log do not depend
        on those of another.  Row 0 by default.

    Raises
    ------
    SettingsError
        An array has another shape, a lane ends outside the log, or the time step is not positive.
    """

    parameters: FloatArray
    initial_states: FloatArray
    inputs: FloatArray
    dt: float
    start_rows: IntArray | None = None
    n_rows: int | None = None
    first_rows: IntArray | None = None

    def __post_init__(self) -> None:
        parameters = checked_array("parameters", self.parameters, (None, None))
        states = np.asarray(self.initial_states, np.float64)
        if states.ndim != 1:
            states = checked_array("initial_states", states, (len(parameters), None))
        arrays = {
            "parameters": parameters,
            "initial_states": states,
            "inputs": checked_array("inputs", self.inputs, (None, None)),
            "start_rows": None if self.start_rows is None else np.asarray(self.start_rows),
        }
        for name, array in arrays.items():
            object.__setattr__(self, name, array)
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise SettingsError(f"dt is {self.dt}, but the time from row to row must be positive seconds.")
        self._check_rows()

    def _check_rows(self) -> None:
        """Raise where a lane's rows are not rows of the log."""
        starts, length = self.start_rows, self.rows_per_lane
        if not 1 <= length <= self.n_log:
            raise SettingsError(f"n_rows is {length}, but the log has {self.n_log} rows.")
        if starts is None:
            return
        if self.n_rows is None:
            raise SettingsError("start_rows is given without n_rows; give the number of rows per lane.")
        if starts.shape != (self.n_lanes,) or starts.dtype.kind not in "iu":
            raise SettingsError(
                f"start_rows must be one integer per lane, {self.n_lanes} in all; found shape {starts.shape}."
            )
        if self.n_lanes and (starts.min() < 0 or starts.max() + length > self.n_log):
            raise SettingsError(
                f"lanes of {length} rows that start at rows {starts.min()} to {starts.max()} do not lie within the "
                f"log's {self.n_log} rows."
            )

    @property
    def n_lanes(self) -> int:
        """Number of rollouts."""
        return len(self.parameters)

    @property
    def n_log(self) -> int:
        """Number of rows of the log."""
        return len(self.inputs)

    @property
    def logs(self) -> IntArray:
        """First row of each log."""
        return np.zeros(1, np.int64) if self.first_rows is None else self.first_rows

    @property
    def rows_per_lane(self) -> int:
        """Number of rows that each lane simulates."""
        return self.n_log if self.n_rows is None else int(self.n_rows)


@dataclass(frozen=True, eq=False)
class Measurements:
    """Measured signals of a log, and the rows that count.

    Parameters
    ----------
    values : (n_log, n_s)
        In the order of the simulator's `signals`, each signal's unit; NaN is allowed where `valid` is false, and where
        `Simulator.gauss_newton` has no weight.
    valid : (n_log,)
        Rows that count; the others are simulated, but not compared.

    Raises
    ------
    SettingsError
        An array has another shape or type.
    """

    values: FloatArray
    valid: BoolArray

    def __post_init__(self) -> None:
        values, valid = checked_array("values", self.values, (None, None)), np.ascontiguousarray(self.valid)
        if valid.shape != (len(values),) or valid.dtype != np.bool_:
            raise SettingsError(
                f"valid must be {len(values)} Booleans, one a row; found {valid.shape} of {valid.dtype}."
            )
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "valid", valid)


@dataclass(frozen=True, init=False, eq=False)
class LinearFeedback:
    """`u[k] = clip(u_ref[k] - K[k] (x - x_ref[k]), u_min, u_max)` from the state at row k, held to the next row.

    One feedback law, or a table of them: then every array but the limits has a leading axis of n_laws. Errors are plain
    differences: angles are not wrapped. A quaternion first takes the sign that is nearer to the reference's.

    Parameters
    ----------
    u_ref : (n_rows, n_u) or (n_laws, n_rows, n_u)
        Feed-forward inputs.
    x_ref : (n_rows, n_x) or (n_laws, n_rows, n_x)
        Reference states.
    gains : (n_rows, n_u, n_x) or (n_laws, n_rows, n_u, n_x)
        K, each input's unit over each state's.
    u_min, u_max : (n_u,) or float
        Limits of the inputs, infinite by default.

    Raises
    ------
    SettingsError
        An array has another shape, a number is not finite, or a lower limit exceeds its upper limit.
    """

    u_ref: FloatArray
    x_ref: FloatArray
    gains: FloatArray
    u_min: FloatArray
    u_max: FloatArray

    def __init__(
        self,
        u_ref: ArrayLike,
        x_ref: ArrayLike,
        gains: ArrayLike,
        u_min: ArrayLike = -np.inf,
        u_max: ArrayLike = np.inf,
    ) -> None:
        u, x, K = (np.array(array, np.float64) for array in (u_ref, x_ref, gains))
        fits = u.ndim in (2, 3) and x.ndim == u.ndim and x.shape[:-1] == u.shape[:-1]
        if not fits or K.shape != (*u.shape, x.shape[-1]):
            raise SettingsError(
                f"a feedback law needs u_ref (n_rows, n_u), x_ref (n_rows, n_x) and gains (n_rows, n_u, n_x), or all "
                f"of them with a leading axis of n_laws; found {u.shape}, {x.shape} and {K.shape}."
            )
        low, high = _limits(u.shape[-1], u_min, u_max)
        for name, array in {"u_ref": u, "x_ref": x, "gains": K, "u_min": low, "u_max": high}.items():
            if not (name.startswith("u_m") or np.isfinite(array).all()):
                raise SettingsError(f"the feedback's {name} holds a NaN or an infinity.")
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    @property
    def n_rows(self) -> int:
        """Number of rows of each law."""
        return int(self.u_ref.shape[-2])

    @property
    def n_u(self) -> int:
        """Number of inputs."""
        return int(self.u_ref.shape[-1])

    @property
    def n_x(self) -> int:
        """Number of states."""
        return int(self.x_ref.shape[-1])

    @property
    def n_laws(self) -> int | None:
        """Number of laws of a table; None for a single law."""
        return self.u_ref.shape[0] if self.u_ref.ndim == 3 else None

    def table(self) -> FloatArray:
        """All numbers of a row side by side, (n_laws, n_rows, n_u + n_x + n_u n_x)."""
        gains = self.gains.reshape(*self.gains.shape[:-2], -1)
        rows = np.concatenate([self.u_ref, self.x_ref, gains], axis=-1)
        return np.ascontiguousarray(rows.reshape(-1, *rows.shape[-2:]))


def _limits(n_u: int, u_min: ArrayLike, u_max: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Smallest and largest inputs (n_u,)."""
    try:
        low, high = (np.broadcast_to(np.array(limit, np.float64), (n_u,)).copy() for limit in (u_min, u_max))
    except ValueError as error:
        raise SettingsError(f"u_min and u_max must be {n_u} numbers each: {error}.") from error
    if not (low <= high).all():
        raise SettingsError(f"the feedback's limits leave no room: u_min {low.tolist()}, u_max {high.tolist()}.")
    return low, high


# Results -------------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class ScoreBatch:
    """Agreement of each rollout with the measurements.

    Attributes
    ----------
    batch : RolloutBatch
        The lanes that were scored.
    sum_squares : (n_lanes, n_s)
        Sum over valid rows of squared errors, each signal's unit squared; infinite in every signal of a lane that
        diverged.
    inlier_count : (n_lanes,)
        Number of inliers: valid rows before any divergence in which enough signals are near.
    diverged : (n_lanes,)
        Lanes in which a state or an acceleration became infinite or NaN.
    inlier_bits : (ceil(n_lanes / 8), n_rows)
        Inliers, one bit per lane; `inliers` unpacks them.
    """

    batch: RolloutBatch = field(repr=False)
    sum_squares: FloatArray
    inlier_count: IntArray
    diverged: BoolArray
    inlier_bits: NDArray[np.uint8] = field(repr=False)

    def inliers(self, lane: int) -> BoolArray:
        """Inlier mask ``(n_rows,)`` of one lane."""
        block, place = divmod(lane, LANES)
        return np.asarray(self.inlier_bits[block] & (1 << place) != 0)


@dataclass(frozen=True, eq=False)
class GaussNewtonBatch:
    """Least-squares sums of each rollout, for a Gauss-Newton step d z = -(J' W J)^-1 J' W e in its unknowns z.

    Attributes
    ----------
    unknowns : tuple of str
        Names of z: parameters, and states for their initial values.
    cost : (n_lanes,)
        e' W e, without a factor of one half; infinite in a lane that diverged.
    gradient : (n_lanes, n_z)
        J' W e; zero in a lane that diverged.
    normal_matrix : (n_lanes, n_z, n_z), or (0, n_z, n_z) where it is left out
        J' W J; zero in a lane that diverged.
    final_states : (n_lanes, n_x)
        State one row after the last; NaN in a lane that diverged.
    final_slopes : (n_lanes, n_x, n_z)
        d(final state)/dz; NaN in a lane that diverged.
    diverged : (n_lanes,)
        Lanes in which a signal, a derivative of the final state or a sum became infinite or NaN.
    along : (n_lanes, n_directions, 1 + n_z)
        e' W d and J' W d of each direction d; zero in a lane that diverged.
    """

    unknowns: tuple[str, ...]
    cost: FloatArray
    gradient: FloatArray
    normal_matrix: FloatArray
    final_states: FloatArray
    final_slopes: FloatArray
    diverged: BoolArray
    along: FloatArray


@dataclass(frozen=True, eq=False)
class LinearizedErrors:
    """Errors of each rollout and their derivatives, row by row; NaN from a divergence on.

    Attributes
    ----------
    unknowns : tuple of str
        Names of z, as `GaussNewtonBatch` has them.
    errors : (n_lanes, n_rows, n_s)
        Simulated less measured, each signal's unit.
    jacobian : (n_lanes, n_rows, n_s, n_z)
        Derivatives of the errors.
    final_states, final_slopes : (n_lanes, n_x) and (n_lanes, n_x, n_z), optional
        State one row after the last, and its derivatives, by a back end that has them without further simulations.
    """

    unknowns: tuple[str, ...]
    errors: FloatArray
    jacobian: FloatArray
    final_states: FloatArray | None = None
    final_slopes: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class ClosedLoopBatch:
    """Rollouts under feedback, row by row; NaN from a divergence on.

    Attributes
    ----------
    signals : (n_lanes, n_rows, n_signals)
        States and accelerations.
    inputs : (n_lanes, n_rows, n_u)
        Inputs that were applied from each row to the next.
    """

    signals: FloatArray
    inputs: FloatArray


def inlier_mask(errors: FloatArray, valid: BoolArray, thresholds: ArrayLike, min_inlier_signals: int) -> BoolArray:
    """Inliers (n_lanes, n_rows) that `Simulator.score` counts, from the errors of `Simulator.errors`.

    Parameters
    ----------
    errors : (n_lanes, n_rows, n_s)
        Each signal's unit.
    valid : (n_rows,) or (n_lanes, n_rows)
        Rows that count.
    thresholds : (n_s,)
        Each signal's unit; 0 switches a signal off.
    min_inlier_signals : int
        Number of near signals that make a row an inlier.
    """
    with np.errstate(over="ignore", under="ignore"):
        near = np.square(errors) < squared_thresholds(thresholds, errors.shape[-1])
    diverged = np.isnan(errors).any(axis=-1)
    return np.asarray((near.sum(axis=-1) >= min_inlier_signals) & ~diverged & valid)


# The interface -------------------------------------------------------------------------------------------------------
class Simulator(Protocol):
    """Batches of rollouts of one model: the interface of a simulation back end. `Rollouts` implements it on the CPU.

    The results of a lane depend on its own data only, not on the other lanes, on their number, or on `threads`, the
    number of blocks of lanes that run at a time. Every method raises SettingsError where arrays do not fit the model or
    each other.

    Attributes
    ----------
    signals : tuple of str
        Signals that are compared with measurements, in the order of their columns.
    """

    signals: tuple[str, ...]

    def score(
        self,
        batch: RolloutBatch,
        measurements: Measurements,
        thresholds: ArrayLike,
        min_inlier_signals: int,
        *,
        threads: int = 1,
    ) -> ScoreBatch:
        """Sums of squared errors and inliers of every lane.

        The squares are added row after row, so `errors` reproduces the sums exactly.

        Parameters
        ----------
        batch : RolloutBatch
            Lanes to simulate.
        measurements : Measurements
            The log that they are compared with.
        thresholds : (n_s,)
            A signal is near where `|error| < threshold`, each signal's unit; 0 switches it off.
        min_inlier_signals : int
            Number of near signals that make a row an inlier.
        threads : int
            Number of threads.
        """

    def errors(self, batch: RolloutBatch, measurements: Measurements, *, threads: int = 1) -> FloatArray:
        """Simulated less measured, (n_lanes, n_rows, n_s), NaN from a divergence on.

        The sign of a quaternion is ignored: its four simulated components change sign where that is nearer.
        """
        return self.errors_and_ends(batch, measurements, threads=threads)[0]

    def errors_and_ends(
        self, batch: RolloutBatch, measurements: Measurements, *, threads: int = 1
    ) -> tuple[FloatArray, FloatArray]:
        """Errors as of `errors`, and the states (n_lanes, n_x) one row after the last, NaN in a lane that diverged."""

    def trajectories(self, batch: RolloutBatch, *, threads: int = 1) -> FloatArray:
        """All signals of the model, (n_lanes, n_rows, n_signals): states, accelerations; NaN from a divergence on."""

    def gauss_newton(
        self,
        batch: RolloutBatch,
        measurements: Measurements,
        weights: ArrayLike,
        *,
        unknowns: Sequence[str] | None = None,
        normal_matrix: bool = True,
        directions: ArrayLike | None = None,
        threads: int = 1,
    ) -> GaussNewtonBatch:
        """Sums e' W e, J' W e and J' W J of every lane, J the exact derivative of the errors that `errors` returns.

        A kink (`fabs`, `if_else`) has the derivative of the branch that is taken; at the kink itself, CasADi's choice.

        Parameters
        ----------
        batch : RolloutBatch
            Lanes to simulate.
        measurements : Measurements
            The log that they are compared with; NaN is allowed where the weight is 0.
        weights : (n_s,) or (n_log, n_s)
            W, inverse of each signal's unit squared: 1 / sigma^2, possibly scaled by robust reweighting.
        unknowns : sequence of str, optional
            Names of parameters, and of states for their initial values; by default all parameters, then all states.
        normal_matrix : bool, optional
            False leaves out J' W J, which takes most of the time.
        directions : (n_log, n_directions, n_s), optional
            d of e' W d and J' W d.
        threads : int
            Number of threads.
        """

    def linearized_errors(
        self,
        batch: RolloutBatch,
        measurements: Measurements,
        *,
        unknowns: Sequence[str] | None = None,
        threads: int = 1,
    ) -> LinearizedErrors:
        """Errors and Jacobian row by row, of which `gauss_newton` returns sums; for small batches, as all is stored."""

    def fly(
        self,
        batch: RolloutBatch,
        feedback: LinearFeedback,
        *,
        feedback_of_lane: ArrayLike | None = None,
        threads: int = 1,
    ) -> ClosedLoopBatch:
        """Signals of closed loops, and the inputs that were applied.

        Parameters
        ----------
        batch : RolloutBatch
            Lanes to simulate; of its inputs only the number of rows counts, that of the feedback.
        feedback : LinearFeedback
            Law of the inputs, or a table of laws.
        feedback_of_lane : (n_lanes,), optional
            Index of each lane's law in a table; by default lane k has law k.
        threads : int
            Number of threads.
        """
