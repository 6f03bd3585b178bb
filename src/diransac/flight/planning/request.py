"""The arguments of a plan, checked and turned into arrays, and the trim at its start."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.errors import PlanningError, SettingsError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from diransac.model import Model

__all__ = [
    "TIME_STEP",
    "Limits",
    "Reference",
    "Route",
    "Signal",
    "Waypoint",
    "check_search",
    "check_weights",
    "check_within",
    "limits_of",
    "reference_weights",
    "route_of",
    "start_at_rest",
    "trim_at",
    "weights_of",
]

TIME_STEP = 0.01
"""Time from row to row of a plan, s: flights are simulated and controlled at 100 Hz."""


Signal = Callable[["FloatArray"], "ArrayLike"]


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

    @property
    def half_ranges(self) -> FloatArray:
        """Half the range between the limits (n,); 1 where it is zero or infinite."""
        half = 0.5 * (self.upper - self.lower)
        return np.where(np.isfinite(half) & (half > 0.0), half, 1.0)

    def by_name(self, names: Iterable[str]) -> dict[str, tuple[float, float]]:
        """Name -> (lowest, highest)."""
        return {n: (float(a), float(b)) for n, a, b in zip(names, self.lower, self.upper, strict=True)}


@dataclass(frozen=True)
class Reference:
    """Reference signals of a plan.

    Parameters
    ----------
    signals : state -> function of time in s, or samples evenly spaced from start to end
    """

    signals: Mapping[str, Signal | ArrayLike]

    def at(self, time: FloatArray) -> dict[str, FloatArray]:
        """Values (n_times,) by state; time starts at 0 and ends with the plan.

        Raises SettingsError: a function does not give a finite number for each time.
        """
        return {name: _sampled(name, signal, time) for name, signal in self.signals.items()}


def _sampled(name: str, signal: Signal | ArrayLike, time: FloatArray) -> FloatArray:
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
    return np.broadcast_to(values, time.shape).astype(np.float64)


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
        at_end = k in (0, len(waypoints) - 1)
        values = _named_values(f"waypoint {k}", "state", waypoint, model.state)
        _check_quaternions(model, k, values, start_end_at_rest and at_end)
        if start_end_at_rest and at_end:
            values = dict.fromkeys((*model.coordinates, *model.velocities_of_motion), 0.0) | values
        states = tuple(j for j, name in enumerate(model.state) if name in values)
        found.append(Waypoint(states, _normalised(model, states, values)))
    return tuple(found)


def _check_quaternions(model: Model, k: int, values: Mapping[str, float], all_fixed: bool) -> None:
    for four in model.quaternions:
        names = [model.state[j] for j in four]
        given = [values[n] for n in names if n in values]
        if all_fixed and len(given) < 4:
            raise SettingsError(
                f"waypoint {k} leaves the attitude open: name {', '.join(names)}, or pass start_end_at_rest=False"
            )
        # Largest deviation of a given quaternion's norm from one.
        if len(given) == 4 and abs(np.linalg.norm(given) - 1.0) > 1e-3:
            raise SettingsError(
                f"waypoint {k}: {', '.join(names)} are a quaternion; its norm is {np.linalg.norm(given):.4g}, not 1"
            )


def _normalised(model: Model, states: tuple[int, ...], values: Mapping[str, float]) -> FloatArray:
    """Values in the model's order, complete quaternions scaled to norm one."""
    array = np.array([values[model.state[j]] for j in states])
    for four in model.quaternions:
        if set(four) <= set(states):
            rows = [states.index(j) for j in four]
            array[rows] /= np.linalg.norm(array[rows])
    return array


def limits_of(what: str, limits: Mapping[str, tuple[float, float]] | None, names: Sequence[str]) -> Limits:
    """Limits (n,) from limits by name.

    Raises SettingsError: an unknown name, or no pair in increasing order.
    """
    lower, upper = np.full(len(names), -np.inf), np.full(len(names), np.inf)
    for name, pair in (limits or {}).items():
        _check_known(f"{what}_limits", what, name, names)
        if np.shape(pair) != (2,) or not pair[0] <= pair[1]:
            raise SettingsError(f'{what}_limits of "{name}" must be (lowest, highest); found {pair!r}')
        lower[names.index(name)], upper[names.index(name)] = pair
    return Limits(lower, upper)


def weights_of(
    what: str, kind: str, weights: Mapping[str, float] | None, names: Sequence[str], default: FloatArray
) -> FloatArray:
    """Weights (n,) from weights by name.

    Raises SettingsError: an unknown name, or a weight that is negative or not finite.
    """
    values = default.copy()
    for name, weight in _named_values(what, kind, weights or {}, names).items():
        if weight < 0.0:
            raise SettingsError(f'{what} of "{name}" is {weight:g}; a weight is at least 0')
        values[names.index(name)] = weight
    return values


def _rows_of(times: Sequence[float], n_waypoints: int, dt: float) -> tuple[int, ...]:
    """Number of rows of each segment, of times rounded to the time step.

    Raises SettingsError: not one time per waypoint, or times that increase by less than a time step.
    """
    array = np.asarray(times, np.float64)
    if array.shape != (n_waypoints,) or not np.isfinite(array).all():
        raise SettingsError(
            f"times must be a finite number of seconds for each of the {n_waypoints} waypoints; found {list(times)}"
        )
    steps = np.diff(np.rint((array - array[0]) / dt).astype(int))
    if (steps < 1).any():
        k = int(np.argmax(steps < 1))
        raise SettingsError(
            f"times must increase by at least {dt:g} s from waypoint to waypoint; "
            f"found {array[k]:g} s for waypoint {k} and {array[k + 1]:g} s for waypoint {k + 1}"
        )
    return tuple(int(n) for n in steps)


def _named_values(what: str, kind: str, values: Mapping[str, float], names: Sequence[str]) -> dict[str, float]:
    """Values by name as finite floats.

    Raises SettingsError: an unknown name, or a value that is not a finite number.
    """
    found = {}
    for name, value in values.items():
        _check_known(what, kind, name, names)
        number = np.asarray(value)
        if number.shape != () or number.dtype.kind not in "fiu" or not np.isfinite(number):
            raise SettingsError(f'{what}: "{name}" is {value!r}; give a finite number')
        found[name] = float(number)
    return found


def _check_known(what: str, kind: str, name: str, names: Sequence[str]) -> None:
    if name not in names:
        raise SettingsError(f'{what}: there is no {kind} "{name}"; there are {", ".join(names)}')


# Route and checks ----------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Route:
    """Waypoints, rows of each segment (None: free), time of the first waypoint (s), and reference."""

    waypoints: tuple[Waypoint, ...]
    rows: tuple[int, ...] | None
    start: float
    reference: Reference


def route_of(
    model: Model,
    waypoints: Sequence[Mapping[str, float]] | None,
    times: Sequence[float] | None,
    reference: Mapping[str, Signal | ArrayLike] | None,
    duration: float | None,
    start_end_at_rest: bool,
) -> Route:
    """Route from the arguments of a plan.

    Raises SettingsError: arguments that are missing or exclude each other, or values without meaning.
    """
    followed = Reference(dict(reference or {}))
    unknown = [name for name in followed.signals if name not in model.state]
    if unknown:
        raise SettingsError(f'reference: there is no state "{unknown[0]}"; there are {", ".join(model.state)}')
    if waypoints is None:
        if reference is None:
            raise SettingsError("a plan needs waypoints=, or reference= with duration=")
        if duration is None or times is not None or not np.isfinite(duration):
            raise SettingsError("a reference without waypoints needs duration=, in s, and no times=")
        rows = _rows_of((0.0, duration), 2, TIME_STEP)
        ends = followed.at(np.array([0.0, rows[0] * TIME_STEP]))
        end_points = [{name: float(values[k]) for name, values in ends.items()} for k in (0, 1)]
        return Route(_waypoints_of(model, end_points, start_end_at_rest), rows, 0.0, followed)
    if duration is not None:
        raise SettingsError("waypoints have times=; duration= belongs to a reference without waypoints")
    if times is None and reference is not None:
        raise SettingsError("a reference is a function of time: waypoints along a reference need times=")
    checked = _waypoints_of(model, waypoints, start_end_at_rest)
    if times is None:
        return Route(checked, None, 0.0, followed)
    return Route(checked, _rows_of(times, len(checked), TIME_STEP), float(times[0]), followed)


def check_weights(state_weights: Mapping[str, float] | None, route: Route, input_limit_fraction: float) -> None:
    """Raise SettingsError for a weight without reference, or an input_limit_fraction that is not in (0, 1]."""
    unknown = [name for name in state_weights or {} if name not in route.reference.signals]
    if unknown:
        raise SettingsError(f'state_weights: "{unknown[0]}" has no reference; give one, or leave its weight out')
    if not 0.0 < input_limit_fraction <= 1.0:
        raise SettingsError(f"input_limit_fraction is {input_limit_fraction}; it must be above 0 and at most 1")


def check_search(time_weight: float, max_iterations: int, time_limit: float) -> None:
    """Raise SettingsError for a value that is out of range."""
    if not (np.isfinite(time_weight) and time_weight >= 0.0):
        raise SettingsError(f"time_weight is {time_weight}; it must be a finite number of at least 0")
    if not max_iterations >= 1 or not time_limit >= 0.0:
        raise SettingsError(
            f"max_iterations is {max_iterations} and time_limit {time_limit} s; give at least 1 iteration and 0 s"
        )


def check_within(model: Model, waypoints: Sequence[Waypoint], limits: Limits) -> None:
    """Raise SettingsError for a waypoint beyond the state limits."""
    for k, waypoint in enumerate(waypoints):
        for j, value in zip(waypoint.states, waypoint.values, strict=True):
            if not limits.lower[j] <= value <= limits.upper[j]:
                raise SettingsError(
                    f"waypoint {k} has {model.state[j]} = {value:g}, but its limits are {limits.lower[j]:g} to "
                    f"{limits.upper[j]:g}; move the waypoint or the limits"
                )


def reference_weights(model: Model, reference: Reference, weights: Mapping[str, float] | None) -> FloatArray:
    """Weight (n_x,) of each state's squared error; 1 by default for states with a reference, else 0."""
    default = np.array([1.0 if name in reference.signals else 0.0 for name in model.state])
    return weights_of("state_weights", "state", weights, model.state, default)


def trim_at(
    model: Model, parameters: FloatArray, start: Waypoint, limits: Limits, given: Mapping[str, float] | None
) -> FloatArray:
    """Inputs (n_u,) of zero cost: the given ones, else those that hold the plant at rest at the first waypoint.

    Raises PlanningError: as `_rest_inputs`.
    """
    if given is not None:
        values = _named_values("trim", "input", given, tuple(model.inputs))
        return np.array([values.get(name, 0.0) for name in model.inputs])
    return _rest_inputs(model, parameters, *_rest_state(model, start), limits)


def start_at_rest(model: Model, parameters: FloatArray, start: Waypoint, trim: FloatArray) -> Waypoint:
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


# Trim ----------------------------------------------------------------------------------------------------------------

_TRIM_TOLERANCE = 1e-6


def _rest_inputs(model: Model, parameters: FloatArray, x: FloatArray, free: BoolArray, limits: Limits) -> FloatArray:
    """Inputs (n_u,) within their limits of zero acceleration in a state of rest (n_x,), of which some are free.

    Gauss-Newton on the accelerations, each step a bounded linear least-squares problem; exact for a model that is
    affine in its inputs and free states.

    Raises PlanningError: there are none within the limits, or none at all.
    """
    lower, upper = limits.lower, limits.upper
    unlimited = np.full(model.n_u, np.inf)
    trim, residual, _ = _least_acceleration(model, parameters, x, free, limits)
    scale = 1.0 + np.abs(_accelerations(model, parameters, x, np.zeros(model.n_u))).max()
    if np.abs(residual).max() <= _TRIM_TOLERANCE * scale:
        return trim
    shown = [j for j, n in enumerate(model.state) if n in model.coordinates or (n in model.first_order and not free[j])]
    state_text = ", ".join(f"{model.state[j]} = {x[j]:g}" for j in shown)
    unlimited_trim, left, _ = _least_acceleration(model, parameters, x, free, Limits(-unlimited, unlimited))
    if np.isfinite(left).all() and np.abs(left).max() <= _TRIM_TOLERANCE * scale:
        needs = ", ".join(
            f"{n} would have to be {v:.4g}, but may be {low:.4g} to {high:.4g}"
            for n, v, low, high in zip(model.inputs, unlimited_trim, lower, upper, strict=True)
            if not low <= v <= high
        )
        raise PlanningError(
            f'model "{model.name}" cannot rest at {state_text} with these parameters: {needs}; '
            "raise the input limits, or check the parameters"
        )
    worst = int(np.argmax(np.abs(np.nan_to_num(left, nan=np.inf))))
    name = list(model.accelerations)[worst]
    raise PlanningError(
        f'model "{model.name}" cannot rest at {state_text}: no inputs make {name} zero; '
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
        target = J[:, open_ended] @ z[open_ended] - a
        new = z.copy()
        if open_ended.any():
            within = lower[open_ended], upper[open_ended]
            new[open_ended] = lsq_linear(J[:, open_ended], target, within, method="bvls").x
        converged = np.allclose(new, z, rtol=1e-13, atol=1e-13)
        z = new
        if converged:
            break
    x[free] = z[:n_free]
    return z[n_free:], _accelerations(model, parameters, x, z[n_free:]), x


def _accelerations(model: Model, parameters: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
    """Accelerations (n_v,) in a state x under inputs u."""
    return np.array(model.dynamics(ca.DM(x), ca.DM(u), ca.DM(parameters))[1]).ravel()
