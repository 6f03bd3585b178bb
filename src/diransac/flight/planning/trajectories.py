"""Named trajectories: the paper's `square`, `star` and `sine`; `random_waypoints` and `multisine` for identification.

The paper leaves these choices open; they were fixed before any result was computed:

- a segment lasts as long as its length takes at a mean speed of 1.6 m/s, rounded to rows of 0.01 s;
- the plan starts and ends at rest and follows the straight line between waypoints weakly: an error of 1 m costs as much
  as full use of an input (`ROUTE_WEIGHT`). This is a regularisation. Lateral motion costs a rotorcraft almost nothing;
  without the weight several plans have about the same cost, some overshoot by more than 3 m, and the solver and its
  first guess decide which one is found;
- the sine has two periods of 4 m along x, from the origin, in 12 s; an error of 0.1 m costs as much as full use of an
  input;
- the inputs of a rotorcraft stay within `ROTORCRAFT_LIMITS`, of which a plan uses the fraction
  `INPUT_LIMIT_FRACTION`, counted from hover: feedback keeps authority for any identified mass.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import SettingsError
from diransac.flight.planning.planner import plan
from diransac.flight.planning.task import TIME_STEP
from diransac.flight.trajectory import InputLimits, Trajectory

if TYPE_CHECKING:
    from diransac.model import Model
    from diransac.model.plant import ModelWithParameters

CORNERS = ((2.0, 2.0), (2.0, -2.0), (-2.0, -2.0), (-2.0, 2.0))
"""Corners of the square, x and z, m: sides of 4 m around the origin."""

MEAN_SPEED = 1.6
"""m/s: a star takes 25 s, about 2,500 samples at 100 Hz."""

ROTORCRAFT_LIMITS = {"thrust": (0.0, 5.0), "moment": (-1.0, 1.0)}
"""N: twice the weight of the paper's rotorcraft, and the largest difference between its rotors."""

INPUT_LIMIT_FRACTION = 0.8

ROUTE_WEIGHT = 1.0 / 1.0**2
"""1/(m^2 s)."""

MAX_DURATION = 3600.0
"""s, of a trajectory for data: 360 000 rows."""

_SHORTEST_SEGMENT = 1.0
"""s: a rotorcraft at rest must turn before it moves sideways."""


_EQUAL: Mapping[str, float] = MappingProxyType({})


# The paper's evaluation ----------------------------------------------------------------------------------------------
def square(
    plant: ModelWithParameters,
    *,
    speed: float = MEAN_SPEED,
    input_weights: Mapping[str, float] = _EQUAL,
    input_limits: InputLimits | None = None,
    **options: Any,
) -> Trajectory:
    """Trajectory from the origin to the four corners of a square of 4 m and back to the first: 5 segments, 12 s.

    Parameters
    ----------
    plant : Plant or Result
        With coordinates x and z, m.
    speed : float
        Mean speed of each segment, m/s.
    input_weights : mapping of str to float
        Cost of full use of an input, 1/s; 1 where not named.
    input_limits : mapping of str to (float, float), optional
        Smallest and largest value of each input, in its unit. By default thrust 0 to 5 N and moment -1 to 1 N for a
        model with these inputs, none for others.
    **options
        Further arguments of `plan`, such as ``guess``.

    Returns
    -------
    Trajectory
        At 100 Hz, at rest at both ends.

    Raises
    ------
    SettingsError
        The model has no coordinates x and z, or an argument has no meaning.
    PlanningError
        There is no such trajectory.

    Notes
    -----
    The duration of each segment is its length over the speed. The plan uses 80 % of the range from hover
    to each input limit. Deviations from the straight line between waypoints have a weak cost, 1 m as much as full use
    of an input; without it the problem has several minima of about equal cost.

    References
    ----------
    Dimmig et al. 2023, section V-A.
    """
    options = {"input_weights": input_weights, **options}
    return _at_mean_speed(plant, [(0.0, 0.0), *CORNERS, CORNERS[0]], speed, input_limits, options)


def star(
    plant: ModelWithParameters,
    *,
    speed: float = MEAN_SPEED,
    input_weights: Mapping[str, float] = _EQUAL,
    input_limits: InputLimits | None = None,
    **options: Any,
) -> Trajectory:
    """Trajectory along the square, back to the origin, and along the square turned by 45 degrees: 11 segments, 25 s.

    Parameters, exceptions and choices are those of `square`.

    References
    ----------
    Dimmig et al. 2023, section V-A.
    """
    half = np.sqrt(0.5)
    turned = [(half * (x - z), half * (x + z)) for x, z in CORNERS]
    first = [(0.0, 0.0), *CORNERS, CORNERS[0], (0.0, 0.0)]
    options = {"input_weights": input_weights, **options}
    return _at_mean_speed(plant, [*first, *turned, turned[0]], speed, input_limits, options)


def sine(
    plant: ModelWithParameters,
    *,
    amplitude: float = 2.0,
    wavelength: float = 4.0,
    periods: float = 2.0,
    duration: float = 12.0,
    input_weights: Mapping[str, float] = _EQUAL,
    input_limits: InputLimits | None = None,
    **options: Any,
) -> Trajectory:
    """Trajectory along ``z = 2 sin(2 pi x / 4 m)`` over two periods in x, from rest to rest in 12 s.

    Parameters
    ----------
    plant, input_weights, input_limits, **options
        As for `square`.
    amplitude, wavelength : float
        m.
    periods : float
        Number of wavelengths.
    duration : float
        s.

    Returns
    -------
    Trajectory
        At 100 Hz, at rest at both ends.

    Raises
    ------
    SettingsError, PlanningError
        As `square`.

    Notes
    -----
    The reference moves along x at constant speed; an error of 0.1 m in x or z costs as much as full use of an input.
    The plan uses 80 % of the range from hover to each input limit.

    References
    ----------
    Dimmig et al. 2023, section V-A.
    """
    check_plane(plant.model)
    _check_positive(amplitude=amplitude, wavelength=wavelength, periods=periods, duration=duration)
    speed = periods * wavelength / duration

    def along(time: FloatArray) -> FloatArray:
        return speed * time

    def height(time: FloatArray) -> FloatArray:
        return amplitude * np.sin(2.0 * np.pi * speed * time / wavelength)

    fixed: dict[str, Any] = {
        "reference": {"x": along, "z": height},
        "duration": duration,
        "state_weights": dict.fromkeys("xz", 1.0 / 0.1**2),  # 1/(m^2 s)
        "input_weights": input_weights,
    }
    return plan(plant, **fixed, **_limits(plant.model, input_limits), **options)


def _at_mean_speed(
    plant: ModelWithParameters,
    points: Sequence[tuple[float, float]],
    speed: float,
    input_limits: InputLimits | None,
    options: Mapping[str, Any],
) -> Trajectory:
    """Plan through points in the plane at a mean speed, m/s, in each segment."""
    _check_positive(speed=speed)
    lengths = np.linalg.norm(np.diff(np.array(points), axis=0), axis=1)
    rows = np.rint(lengths / speed / TIME_STEP)
    return _through(plant, points, TIME_STEP * np.concatenate([[0.0], np.cumsum(rows)]), input_limits, options)


def _through(
    plant: ModelWithParameters,
    points: Sequence[tuple[float, float]],
    times: FloatArray,
    input_limits: InputLimits | None,
    options: Mapping[str, Any],
) -> Trajectory:
    """Plan through points in the plane of x and z (m) at given times (s), from rest to rest."""
    check_plane(plant.model)
    fixed: dict[str, Any] = {
        "waypoints": [{"x": float(x), "z": float(z)} for x, z in points],
        "times": times.tolist(),
        "reference": {
            name: partial(np.interp, xp=times, fp=list(x))
            for name, x in zip("xz", zip(*points, strict=True), strict=True)
        },
        "state_weights": dict.fromkeys("xz", ROUTE_WEIGHT),
    }
    return plan(plant, **fixed, **_limits(plant.model, input_limits), **options)


def _limits(model: Model, given: InputLimits | None) -> dict[str, Any]:
    """Input limits and the fraction of them that a plan uses."""
    if given is None:
        given = ROTORCRAFT_LIMITS if set(ROTORCRAFT_LIMITS) <= set(model.inputs) else {}
    return {"input_limits": given, "input_limit_fraction": INPUT_LIMIT_FRACTION}


def check_plane(model: Model) -> None:
    """Raise SettingsError if the model has no coordinates x and z."""
    missing = [name for name in ("x", "z") if name not in model.coordinates]
    if missing:
        raise SettingsError(
            "square, star, sine and random_waypoints are planned in x and z; "
            f'model "{model.name}" has no coordinate {missing[0]}: '
            f"it has {', '.join(model.coordinates)}. Use plan(plant, waypoints=...)"
        )


# Excitation for data -------------------------------------------------------------------------------------------------
def random_waypoints(
    plant: ModelWithParameters,
    *,
    seed: int = 0,
    speed: float = 1.6,
    reach: float = 2.0,
    duration: float = 25.0,
    input_limits: InputLimits | None = None,
    **options: Any,
) -> Trajectory:
    """Trajectory from rest at the origin through random waypoints in x and z to rest at the last of them.

    Parameters
    ----------
    plant : Plant or Result
        With coordinates x and z, m.
    seed : int
        Of the waypoints, at least 0.
    speed : float
        Mean speed along the straight line between waypoints, m/s.
    reach : float
        Waypoints are uniform in a square around the origin with sides of twice this length, m.
    duration : float
        s, 3600 at most. The trajectory ends at the last waypoint that is reached before.
    input_limits, **options
        As in `square`.

    Returns
    -------
    Trajectory
        At 100 Hz.

    Raises
    ------
    SettingsError
        The model has no coordinates x and z, a number is out of range, or waypoints are too close or too far.
    PlanningError
        There is no such trajectory.

    Notes
    -----
    Planned inputs are smoothed by a moving average over 0.11 s, so that they vary in every row; the states remain those
    of the plan, from which the paper's rotorcraft deviates by less than 1 mm under feedback. A waypoint less than 1 s
    away is skipped: it cannot be reached from rest.
    """
    check_plane(plant.model)
    check_numbers(seed, duration, speed=speed, reach=reach)
    points, times = _random_points(seed, speed, reach, duration)
    from scipy.ndimage import uniform_filter1d  # slow to import

    planned = _through(plant, points, times, input_limits, options)
    # Length of the moving average over planned inputs, rows: piecewise constant inputs hide a delay.
    return replace(planned, inputs=uniform_filter1d(planned.inputs, 11, axis=0, mode="nearest"))


def _random_points(
    seed: int, speed: float, reach: float, duration: float
) -> tuple[list[tuple[float, float]], FloatArray]:
    """Random points, m, and their times (K,), s."""
    if reach < speed * _SHORTEST_SEGMENT:
        raise SettingsError(
            f"waypoints within a reach of {reach:g} m are too near for a speed of {speed:g} m/s: each segment takes at "
            f"least {_SHORTEST_SEGMENT:g} s; give a reach of {speed * _SHORTEST_SEGMENT:g} m or more"
        )
    rng = np.random.default_rng(seed)
    points, times = [(0.0, 0.0)], [0.0]
    while True:
        x, z = rng.uniform(-reach, reach, 2).tolist()
        segment = math.hypot(x - points[-1][0], z - points[-1][1]) / speed
        if times[-1] + segment >= duration:
            break
        if segment >= _SHORTEST_SEGMENT:
            points.append((x, z))
            times.append(times[-1] + segment)
    if len(points) < 2:
        raise SettingsError(
            f"the first waypoint is {segment:.3g} s away at {speed:g} m/s, and the trajectory lasts {duration:g} s; "
            "give more duration or speed, or less reach"
        )
    return points, TIME_STEP * np.rint(np.array(times) / TIME_STEP)


def multisine(
    plant: ModelWithParameters, *, seed: int = 0, amplitude: float = 0.5, frequency: float = 1.0, duration: float = 25.0
) -> Trajectory:
    """Trajectory on which each coordinate is a sum of five sines; inverse dynamics gives the inputs.

    Parameters
    ----------
    plant : Plant or Result
        Fully actuated: as many inputs as coordinates, linear in the equations, with a regular input matrix.
    seed : int
        Of frequencies, amplitudes and phases, which are uniform; at least 0.
    amplitude : float
        In each coordinate's unit. The amplitude of each sine is 0.2 to 0.6 of it; the RMS of their sum is about 0.66
        of it.
    frequency : float
        Hz. The frequency of each sine is 0.2 to 1.0 of it.
    duration : float
        s, 3600 at most.

    Returns
    -------
    Trajectory
        At 100 Hz, in motion at the start.

    Raises
    ------
    SettingsError
        The model is not fully actuated, or a number is out of range.

    Notes
    -----
    The trajectory is not optimised and has no limits. An input, held from row to row, is that of inverse dynamics in
    the middle between both rows.

    References
    ----------
    Swevers et al. 1997, "Optimal robot excitation and identification", IEEE Trans. Robotics and Automation 13(5), for
    multisine excitation; there it is optimised, here it is drawn.
    """
    model = plant.model
    to_inputs = inverse_dynamics(model)
    check_numbers(seed, duration, amplitude=amplitude, frequency=frequency)
    rng = np.random.default_rng(seed)
    time = np.arange(round(duration / TIME_STEP) + 1, dtype=np.float64) * TIME_STEP
    # Sines per coordinate.
    shape = (5, model.n_q, 1)
    w, phase = 2 * np.pi * frequency * rng.uniform(0.2, 1.0, shape), rng.uniform(0.0, 2 * np.pi, shape)
    size = amplitude * rng.uniform(0.2, 0.6, shape)

    def motion(t: FloatArray) -> list[FloatArray]:
        """q, v and a (n_q, K): a derivative is a factor w and a quarter turn."""
        return [np.sum(size * w**k * np.sin(w * t + phase + k * np.pi / 2), axis=0) for k in range(3)]

    inputs = np.array(to_inputs(*motion(time + TIME_STEP / 2), model.parameter_vector(plant.parameters)))
    return Trajectory(time, np.vstack(motion(time)[:2]).T, inputs.T, model.state, tuple(model.inputs))


def check_fully_actuated(model: Model) -> None:
    """Raise SettingsError if inverse dynamics does not give unique inputs for every acceleration of this model."""
    inverse_dynamics(model)


def inverse_dynamics(model: Model) -> ca.Function:
    """Function ``(q, v, a, p) -> u`` that solves the equations of motion for the inputs.

    Raises SettingsError: they do not determine the inputs linearly and uniquely.
    """
    q, v, a, u, p = (ca.SX.sym(n, size) for n, size in model.argument_sizes.items())
    r = model.residual(q, v, a, u, p)
    input_matrix = ca.jacobian(r, u)
    is_square = model.kinematics is None and model.n_u == model.n_v and not model.first_order
    if not is_square or ca.depends_on(input_matrix, u) or ca.sprank(input_matrix) < model.n_v:
        raise SettingsError(
            f'model "{model.name}" is not fully actuated: its inputs ({", ".join(model.inputs)}) do not determine the '
            f"accelerations of all coordinates ({', '.join(model.coordinates)}) linearly; use diransac.plan"
        )
    inputs = -ca.solve(ca.densify(input_matrix), ca.densify(ca.substitute(r, u, 0)))
    return ca.Function("inverse_dynamics", [q, v, a, p], [inputs])


def check_numbers(seed: object, duration: float, **values: float) -> None:
    """Raise SettingsError unless seed, duration and values (finite, above 0) are in range."""
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise SettingsError(f"seed is {seed!r:.60}; give a whole number of at least 0")
    if not TIME_STEP <= duration <= MAX_DURATION:
        raise SettingsError(f"duration is {duration!r:.60}; give {TIME_STEP:g} to {MAX_DURATION:g} s")
    _check_positive(**values)


def _check_positive(**values: float) -> None:
    """Raise SettingsError unless values are finite and above 0."""
    for name, value in values.items():
        if not 0.0 < value < np.inf:
            raise SettingsError(f"{name} is {value!r:.60}; give a finite number above 0")
