"""The arguments of a plan, checked and turned into arrays, and the trim at its start."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.errors import PlanningError, SettingsError, check_known
from diransac.flight.trajectory import InputLimits, half_ranges

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from diransac.model import Model
    from diransac.model.plant import ModelWithParameters

TIME_STEP = 0.01
"""Time from row to row of a plan, s: flights are simulated and controlled at 100 Hz."""

Reference: TypeAlias = "Mapping[str, Callable[[FloatArray], ArrayLike] | ArrayLike]"
"""State -> function of time in s, or samples evenly spaced from start to end."""


@dataclass(frozen=True)
class Waypoint:
    """States fixed at one moment.

    Parameters
    ----------
    states : indices of the states, increasing
    values : (n,)   of these states
    """

    states: tuple[int, ...]
    values: FloatArray

    def text(self, names: Sequence[str]) -> str:
        """Values that are not zero, in words."""
        shown = [(names[j], v) for j, v in zip(self.states, self.values, strict=True) if v != 0.0]
        return ", ".join(f"{n} = {v:g}" for n, v in shown) or "all zero"


@dataclass(frozen=True)
class Limits:
    """Smallest and largest values (n,) of the inputs or the states; infinite without limits."""

    lower: FloatArray
    upper: FloatArray

    def around(self, trim: FloatArray, fraction: float) -> Limits:
        """Limits at this fraction of the range from trim (n,) to each limit; unchanged for a trim beyond it."""
        lower, upper = (trim + fraction * (limit - trim) for limit in (self.lower, self.upper))
        return Limits(np.maximum(self.lower, lower), np.minimum(self.upper, upper))


@dataclass(frozen=True)
class Task:
    """Planning task with checked values, in the model's order.

    Parameters
    ----------
    model, parameters : the plant; parameters (n_p,)
    waypoints : at least a start and an end
    rows : rows of each segment; None: its duration is free
    start : s   time of the first waypoint
    reference, state_weights : reference signals, and the weight (n_x,) of each state's squared error, per s
    input_weights : (n_u,)   cost of an input's squared distance from trim, per s
    trim : (n_u,)   inputs of zero cost
    time_weight : cost of a second; 0 where times are given
    inputs, states : limits that the plan keeps
    input_limits : limits of the machine
    """

    model: Model
    parameters: FloatArray
    waypoints: tuple[Waypoint, ...]
    rows: tuple[int, ...] | None
    start: float
    reference: Reference
    state_weights: FloatArray
    input_weights: FloatArray
    trim: FloatArray
    time_weight: float
    inputs: Limits
    states: Limits
    input_limits: dict[str, tuple[float, float]]


def task_of(
    plant: ModelWithParameters,
    *,
    waypoints: Sequence[Mapping[str, float]] | None,
    times: Sequence[float] | None,
    reference: Reference | None,
    duration: float | None,
    input_limits: InputLimits | None,
    input_limit_fraction: float,
    state_limits: InputLimits | None,
    input_weights: Mapping[str, float] | None,
    state_weights: Mapping[str, float] | None,
    time_weight: float,
    trim: Mapping[str, float] | None,
    start_end_at_rest: bool,
) -> Task:
    """Task from the arguments of `plan`.

    Raises SettingsError: an argument has no meaning.  Raises PlanningError: the plant cannot rest at the start.
    """
    model, limits = plant.model, _limits_of("input", input_limits, tuple(plant.model.inputs))
    points, rows, start = _route(model, waypoints, times, reference, duration, start_end_at_rest)
    unknown = [name for name in state_weights or {} if name not in (reference or {})]
    if unknown:
        raise SettingsError(f'state_weights: "{unknown[0]}" has no reference; give one, or leave its weight out')
    if not 0.0 < input_limit_fraction <= 1.0:
        raise SettingsError(f"input_limit_fraction is {input_limit_fraction}; it must be above 0 and at most 1")
    if not (np.isfinite(time_weight) and time_weight >= 0.0):
        raise SettingsError(f"time_weight is {time_weight}; it must be a finite number of at least 0")
    parameters, states = model.parameter_vector(plant.parameters), _limits_of("state", state_limits, model.state)
    if trim is not None:
        given = _named_values("trim", "input", trim, tuple(model.inputs))
        at_trim = np.array([given.get(name, 0.0) for name in model.inputs])
    else:
        at_trim = _rest_inputs(model, parameters, *_rest_state(model, points[0]), limits)
    if start_end_at_rest and model.first_order:
        points = (_start_at_rest(model, parameters, points[0], at_trim), *points[1:])
    _check_within(model, points, states)
    followed = np.array([1.0 if name in (reference or {}) else 0.0 for name in model.state])
    of_inputs = _weights_of("input_weights", "input", input_weights, tuple(model.inputs), np.ones(model.n_u))
    pairs = zip(limits.lower.tolist(), limits.upper.tolist(), strict=True)
    return Task(
        model=model,
        parameters=parameters,
        waypoints=points,
        rows=rows,
        start=start,
        reference=dict(reference or {}),
        state_weights=_weights_of("state_weights", "state", state_weights, model.state, followed),
        input_weights=of_inputs / half_ranges(limits.lower, limits.upper) ** 2,
        trim=at_trim,
        time_weight=float(time_weight) if rows is None else 0.0,
        inputs=limits.around(at_trim, input_limit_fraction),
        states=states,
        input_limits=dict(zip(model.inputs, pairs, strict=True)),
    )


def sampled(reference: Reference, time: FloatArray) -> dict[str, FloatArray]:
    """Values (n_times,) of a reference by state; time starts at 0 and ends with the plan.

    Raises SettingsError: it does not give a finite number for each time.
    """
    found = {}
    for name, signal in reference.items():
        if callable(signal):
            values = np.asarray(signal(time), np.float64)
        else:
            samples = np.asarray(signal, np.float64)
            if samples.ndim != 1 or len(samples) < 2:
                raise SettingsError(
                    f'the reference of "{name}" must be a function of time, or at least 2 samples (n,); '
                    f"found an array of shape {samples.shape}"
                )
            values = np.interp(time, np.linspace(time[0], time[-1], len(samples)), samples)
        if values.shape not in ((), time.shape) or not np.isfinite(values).all():
            raise SettingsError(
                f'the reference of "{name}" must give a finite number for each of {len(time)} times; '
                f"found shape {values.shape}{'' if np.isfinite(values).all() else ' with a NaN or an infinity'}"
            )
        found[name] = np.broadcast_to(values, time.shape).astype(np.float64)
    return found


# Waypoints and their times -------------------------------------------------------------------------------------------
def _route(
    model: Model,
    waypoints: Sequence[Mapping[str, float]] | None,
    times: Sequence[float] | None,
    reference: Reference | None,
    duration: float | None,
    start_end_at_rest: bool,
) -> tuple[tuple[Waypoint, ...], tuple[int, ...] | None, float]:
    """Waypoints, rows of each segment (None: free), and time of the first waypoint, s.

    Raises SettingsError: arguments that are missing or exclude each other, or values without meaning.
    """
    check_known(reference or {}, model.state, "reference: there is no state", "there are")
    if waypoints is None:
        if reference is None:
            raise SettingsError("a plan needs waypoints=, or reference= with duration=")
        if duration is None or times is not None or not np.isfinite(duration):
            raise SettingsError("a reference without waypoints needs duration=, in s, and no times=")
        rows = _rows_of((0.0, duration), 2)
        ends = sampled(reference, np.array([0.0, rows[0] * TIME_STEP]))
        end_points = [{name: float(values[k]) for name, values in ends.items()} for k in (0, 1)]
        return _waypoints_of(model, end_points, start_end_at_rest), rows, 0.0
    if duration is not None:
        raise SettingsError("waypoints have times=; duration= belongs to a reference without waypoints")
    if times is None and reference is not None:
        raise SettingsError("a reference is a function of time: waypoints along a reference need times=")
    checked = _waypoints_of(model, waypoints, start_end_at_rest)
    if times is None:
        return checked, None, 0.0
    return checked, _rows_of(times, len(checked)), float(times[0])


def _waypoints_of(
    model: Model, waypoints: Sequence[Mapping[str, float]], start_end_at_rest: bool
) -> tuple[Waypoint, ...]:
    """Checked waypoints; with `start_end_at_rest`, states that the first and last do not name are zero.

    Raises SettingsError: fewer than two, an unknown state, a value that is not finite, a quaternion without unit norm.
    """
    if len(waypoints) < 2:
        raise SettingsError(f"a plan needs at least 2 waypoints, a start and an end; found {len(waypoints)}")
    found = []
    for k, waypoint in enumerate(waypoints):
        rests = start_end_at_rest and k in (0, len(waypoints) - 1)
        values = _named_values(f"waypoint {k}", "state", waypoint, model.state)
        for four in model.quaternions:
            values |= _unit_quaternion(k, {model.state[j]: values.get(model.state[j]) for j in four}, rests)
        if rests:
            values = dict.fromkeys((*model.coordinates, *model.velocities_of_motion), 0.0) | values
        states = tuple(j for j, name in enumerate(model.state) if name in values)
        found.append(Waypoint(states, np.array([values[model.state[j]] for j in states])))
    return tuple(found)


def _unit_quaternion(k: int, given: Mapping[str, float | None], all_fixed: bool) -> dict[str, float]:
    """Known elements of a waypoint's quaternion, scaled to norm one if they are complete."""
    known = {name: value for name, value in given.items() if value is not None}
    if len(known) < len(given):
        if all_fixed:
            raise SettingsError(
                f"waypoint {k} leaves the attitude open: name {', '.join(given)}, or pass start_end_at_rest=False"
            )
        return known
    norm = float(np.linalg.norm(list(known.values())))
    # Largest deviation of a given quaternion's norm from one.
    if abs(norm - 1.0) > 1e-3:
        raise SettingsError(f"waypoint {k}: {', '.join(given)} are a quaternion; its norm is {norm:.4g}, not 1")
    return {name: value / norm for name, value in known.items()}


def _rows_of(times: Sequence[float], n_waypoints: int) -> tuple[int, ...]:
    """Number of rows of each segment, of times rounded to the time step.

    Raises SettingsError: not one time per waypoint, or times that increase by less than a time step.
    """
    array = np.asarray(times, np.float64)
    if array.shape != (n_waypoints,) or not np.isfinite(array).all():
        raise SettingsError(
            f"times must be a finite number of seconds for each of the {n_waypoints} waypoints; found {list(times)}"
        )
    steps = np.diff(np.rint((array - array[0]) / TIME_STEP).astype(int))
    if (steps < 1).any():
        k = int(np.argmax(steps < 1))
        raise SettingsError(
            f"times must increase by at least {TIME_STEP:g} s from waypoint to waypoint; "
            f"found {array[k]:g} s for waypoint {k} and {array[k + 1]:g} s for waypoint {k + 1}"
        )
    return tuple(int(n) for n in steps)


def _check_within(model: Model, waypoints: Sequence[Waypoint], limits: Limits) -> None:
    """Raise SettingsError for a waypoint beyond the state limits."""
    for k, waypoint in enumerate(waypoints):
        for j, value in zip(waypoint.states, waypoint.values, strict=True):
            if not limits.lower[j] <= value <= limits.upper[j]:
                raise SettingsError(
                    f"waypoint {k} has {model.state[j]} = {value:g}, but its limits are {limits.lower[j]:g} to "
                    f"{limits.upper[j]:g}; move the waypoint or the limits"
                )


# Values by name ------------------------------------------------------------------------------------------------------
def _limits_of(what: str, limits: InputLimits | None, names: Sequence[str]) -> Limits:
    """Limits (n,) from limits by name.  Raises SettingsError: an unknown name, or no pair in increasing order."""
    lower, upper = np.full(len(names), -np.inf), np.full(len(names), np.inf)
    check_known(limits or {}, names, f"{what}_limits: there is no {what}", "there are")
    for name, pair in (limits or {}).items():
        if np.shape(pair) != (2,) or not pair[0] <= pair[1]:
            raise SettingsError(f'{what}_limits of "{name}" must be (lowest, highest); found {pair!r}')
        lower[names.index(name)], upper[names.index(name)] = pair
    return Limits(lower, upper)


def _weights_of(
    what: str, kind: str, weights: Mapping[str, float] | None, names: Sequence[str], default: FloatArray
) -> FloatArray:
    """Weights (n,) from weights by name.  Raises SettingsError: an unknown name, or a weight below 0 or not finite."""
    values = default.copy()
    for name, weight in _named_values(what, kind, weights or {}, names).items():
        if weight < 0.0:
            raise SettingsError(f'{what} of "{name}" is {weight:g}; a weight is at least 0')
        values[names.index(name)] = weight
    return values


def _named_values(what: str, kind: str, values: Mapping[str, float], names: Sequence[str]) -> dict[str, float]:
    """Values by name as finite floats.  Raises SettingsError: an unknown name, or a value that is no finite number."""
    check_known(values, names, f"{what}: there is no {kind}", "there are")
    found = {}
    for name, value in values.items():
        number = np.asarray(value)
        if number.shape != () or number.dtype.kind not in "fiu" or not np.isfinite(number):
            raise SettingsError(f'{what}: "{name}" is {value!r}; give a finite number')
        found[name] = float(number)
    return found


# Trim ----------------------------------------------------------------------------------------------------------------
def _start_at_rest(model: Model, parameters: FloatArray, start: Waypoint, trim: FloatArray) -> Waypoint:
    """The first waypoint, and in it the states of first order that it leaves free, at rest under inputs (n_u,)."""
    x, free = _rest_state(model, start)
    settled = _least_acceleration(model, parameters, x, free, Limits(trim, trim))[2]
    if not free.any() or not np.isfinite(settled).all():
        return start
    settled[list(start.states)] = start.values
    fixed = np.union1d(start.states, np.flatnonzero(free)).astype(int)
    return Waypoint(tuple(fixed.tolist()), settled[fixed])


def _rest_state(model: Model, start: Waypoint) -> tuple[FloatArray, BoolArray]:
    """State (n_x,) at rest at the first waypoint, and the mask (n_x,) of its states of first order that are free."""
    x, free = np.zeros(len(model.state)), np.isin(model.state, list(model.first_order))
    for j, value in zip(start.states, start.values, strict=True):
        if j < model.n_q or free[j]:
            x[j], free[j] = value, False
    return x, free


def _rest_inputs(model: Model, parameters: FloatArray, x: FloatArray, free: BoolArray, limits: Limits) -> FloatArray:
    """Inputs (n_u,) within their limits of zero acceleration in a state of rest (n_x,), of which some are free.

    Gauss-Newton on the accelerations, each step a bounded linear least-squares problem; exact for a model that is
    affine in its inputs and free states.

    Raises PlanningError: there are none within the limits, or none at all.
    """
    trim, residual, _ = _least_acceleration(model, parameters, x, free, limits)
    tolerance = 1e-6 * (1.0 + np.abs(_accelerations(model, parameters, x, np.zeros(model.n_u))).max())
    if np.abs(residual).max() <= tolerance:
        return trim
    shown = [j for j, n in enumerate(model.state) if n in model.coordinates or (n in model.first_order and not free[j])]
    there = ", ".join(f"{model.state[j]} = {x[j]:g}" for j in shown)
    unlimited = np.full(model.n_u, np.inf)
    needed, left, _ = _least_acceleration(model, parameters, x, free, Limits(-unlimited, unlimited))
    if np.isfinite(left).all() and np.abs(left).max() <= tolerance:
        needs = ", ".join(
            f"{n} would have to be {v:.4g}, but may be {low:.4g} to {high:.4g}"
            for n, v, low, high in zip(model.inputs, needed, limits.lower, limits.upper, strict=True)
            if not low <= v <= high
        )
        raise PlanningError(
            f'model "{model.name}" cannot rest at {there} with these parameters: {needs}; '
            "raise the input limits, or check the parameters"
        )
    worst = int(np.argmax(np.abs(np.nan_to_num(left, nan=np.inf))))
    raise PlanningError(
        f'model "{model.name}" cannot rest at {there}: no inputs make {list(model.accelerations)[worst]} zero; '
        "start elsewhere, or give the inputs of zero cost with trim="
    )


def _least_acceleration(
    model: Model, parameters: FloatArray, x: FloatArray, free: BoolArray, limits: Limits
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Inputs (n_u,) of least squared acceleration, this acceleration (n_v,), and the state (n_x,), free where given."""
    from scipy.optimize import lsq_linear  # slow to import

    x, n_free = x.copy(), int(free.sum())
    lower = np.concatenate([np.full(n_free, -np.inf), limits.lower])
    upper = np.concatenate([np.full(n_free, np.inf), limits.upper])
    z, open_ended = np.clip(np.concatenate([x[free], np.zeros(model.n_u)]), lower, upper), upper > lower
    for _ in range(30):
        x[free], u = z[:n_free], z[n_free:]
        A, B = (np.array(J)[model.n_q :] for J in model.linearization(x, u, parameters))
        J, a = np.hstack([A[:, free], B]), _accelerations(model, parameters, x, u)
        if not (np.isfinite(J).all() and np.isfinite(a).all()):
            return u, np.full(model.n_v, np.nan), np.full(len(x), np.nan)
        new = z.copy()
        if open_ended.any():
            J = J[:, open_ended]
            within = lower[open_ended], upper[open_ended]
            new[open_ended] = lsq_linear(J, J @ z[open_ended] - a, within, method="bvls").x
        converged = np.allclose(new, z, rtol=1e-13, atol=1e-13)
        z = new
        if converged:
            break
    x[free] = z[:n_free]
    return z[n_free:], _accelerations(model, parameters, x, z[n_free:]), x


def _accelerations(model: Model, parameters: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
    """Accelerations (n_v,) in a state x under inputs u."""
    return np.array(model.dynamics(ca.DM(x), ca.DM(u), ca.DM(parameters))[1]).ravel()
