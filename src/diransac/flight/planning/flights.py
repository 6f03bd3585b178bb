"""The flights that the paper judges identified models by: square, star and sine in the plane of x and z.

Fixed choices, made once, before any figure was looked at, because the paper doesn't give them:

- segments last as long as their length takes at a mean speed of `MEAN_SPEED`, rounded to rows of 0.01 s;
- from rest to rest, and weakly drawn to the straight way between the waypoints: an error of 1 m costs as much as full
  use of an input (`ROUTE_WEIGHT`). This is a regularisation. Sideways motion costs a rotorcraft next to nothing, so
  that without it several plans through the corners cost about the same, some of them overshoot by more than 3 m, and
  which of them is found depends on the solver and its first guess;
- the sine is two periods of `WAVELENGTH` along x, from the origin, in `SINE_DURATION`, and an error of 0.1 m costs as
  much as full use of an input (`POSITION_WEIGHT`);
- a rotorcraft's inputs keep to `ROTORCRAFT_LIMITS`; a plan uses the share `PLANNED_SHARE` of the way from hovering to
  each of them, so that feedback keeps some authority whatever mass was identified.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import SettingsError
from diransac.flight.planning.planner import TIME_STEP, plan

if TYPE_CHECKING:
    from diransac.flight.trajectory import Trajectory
    from diransac.model import Model
    from diransac.model.plant import ModelWithParameters


__all__ = [
    "MEAN_SPEED",
    "PLANNED_SHARE",
    "ROTORCRAFT_LIMITS",
    "Limits",
    "check_plane",
    "sine",
    "square",
    "star",
    "through",
]

CORNERS = ((2.0, 2.0), (2.0, -2.0), (-2.0, -2.0), (-2.0, 2.0))
"""m, x and z: 4 m a side, all as far from the origin."""

MEAN_SPEED = 1.6
"""m/s: a star takes 25 s, about 2,500 observations at 100 Hz."""

ROTORCRAFT_LIMITS = {"thrust": (0.0, 5.0), "moment": (-1.0, 1.0)}
"""N: twice the weight of the paper's rotorcraft, and as much as its rotors may differ by."""

PLANNED_SHARE = 0.8

AMPLITUDE = 2.0
"""m."""

WAVELENGTH = 4.0
"""m."""

PERIODS = 2

SINE_DURATION = 12.0
"""s."""

POSITION_WEIGHT = 1.0 / 0.1**2
"""1/(m^2 s)."""

ROUTE_WEIGHT = 1.0 / 1.0**2
"""1/(m^2 s)."""

Limits = Mapping[str, tuple[float, float]]


def square(plant: ModelWithParameters, *, input_limits: Limits | None = None, **options: Any) -> Trajectory:
    """From rest at the origin to the four corners of a square of 4 m, and on to rest at the first: 5 segments, 12 s.

    Parameters
    ----------
    plant : with coordinates x and z, m
    input_limits : name -> (lowest, highest); 0 to 5 N of thrust and -1 to 1 N of moment for a model with these inputs
    options : of `plan`, such as solver or guess

    Segments take their length at a mean speed of 1.6 m/s; the plan uses 80 % of the way from hovering to the limits. It
    is weakly drawn to the straight way, 1 m off which costs as much as full use of an input: without that there are
    several minima of about the same cost, some with an overshoot of 3 m.

    Raises SettingsError: a model without coordinates x and z.
    Raises PlanningError: no such trajectory; it says why.

    References: Dimmig et al. 2023, section V-A.
    """
    return _at_mean_speed(plant, [(0.0, 0.0), *CORNERS, CORNERS[0]], input_limits, options)


def star(plant: ModelWithParameters, *, input_limits: Limits | None = None, **options: Any) -> Trajectory:
    """The square, back to the origin, and the square turned by 45 degrees: 11 segments, 25 s.

    Parameters, choices and errors are those of `square`.

    References: Dimmig et al. 2023, section V-A.
    """
    half = np.sqrt(0.5)
    turned = [(half * (x - z), half * (x + z)) for x, z in CORNERS]
    first = [(0.0, 0.0), *CORNERS, CORNERS[0], (0.0, 0.0)]
    return _at_mean_speed(plant, [*first, *turned, turned[0]], input_limits, options)


def sine(plant: ModelWithParameters, *, input_limits: Limits | None = None, **options: Any) -> Trajectory:
    """As near as can be to z = 2 sin(2 pi x / 4 m) along two periods of x, from rest to rest in 12 s.

    Parameters and errors are those of `square`. The reference moves along x evenly; an error of 0.1 m in x or z costs
    as much as full use of an input; the plan uses 80 % of the way from hovering to the limits.

    References: Dimmig et al. 2023, section V-A.
    """
    check_plane(plant.model)
    speed = PERIODS * WAVELENGTH / SINE_DURATION

    def along(time: FloatArray) -> FloatArray:
        return speed * time

    def height(time: FloatArray) -> FloatArray:
        return AMPLITUDE * np.sin(2.0 * np.pi * speed * time / WAVELENGTH)

    fixed: dict[str, Any] = {
        "reference": {"x": along, "z": height},
        "duration": SINE_DURATION,
        "state_weights": {"x": POSITION_WEIGHT, "z": POSITION_WEIGHT},
    }
    return plan(plant, **fixed, **_limits(plant.model, input_limits), **options)


def _at_mean_speed(
    plant: ModelWithParameters,
    places: Sequence[tuple[float, float]],
    input_limits: Limits | None,
    options: Mapping[str, Any],
) -> Trajectory:
    """Through places in the plane, each segment as long as its length takes."""
    lengths = np.linalg.norm(np.diff(np.array(places), axis=0), axis=1)
    rows = np.rint(lengths / MEAN_SPEED / TIME_STEP)
    return through(plant, places, TIME_STEP * np.concatenate([[0.0], np.cumsum(rows)]), input_limits, options)


def through(
    plant: ModelWithParameters,
    places: Sequence[tuple[float, float]],
    times: FloatArray,
    input_limits: Limits | None,
    options: Mapping[str, Any],
) -> Trajectory:
    """Through places in the plane of x and z at given times (s), rest to rest, with the choices of this file.

    Raises SettingsError: the model has no coordinates x and z.
    Raises PlanningError: no such trajectory.
    """
    check_plane(plant.model)
    fixed: dict[str, Any] = {
        "waypoints": [{"x": float(x), "z": float(z)} for x, z in places],
        "times": times.tolist(),
        "reference": {name: _route(times, [place[j] for place in places]) for j, name in enumerate(("x", "z"))},
        "state_weights": {"x": ROUTE_WEIGHT, "z": ROUTE_WEIGHT},
    }
    return plan(plant, **fixed, **_limits(plant.model, input_limits), **options)


def _route(times: FloatArray, values: Sequence[float]) -> Callable[[FloatArray], FloatArray]:
    """Straight from each waypoint to the next, at the mean speed."""

    def along(time: FloatArray) -> FloatArray:
        return np.interp(time, times, values)

    return along


def _limits(model: Model, given: Limits | None) -> dict[str, Any]:
    if given is None:
        given = ROTORCRAFT_LIMITS if set(ROTORCRAFT_LIMITS) <= set(model.inputs) else {}
    return {"input_limits": given, "input_limit_fraction": PLANNED_SHARE}


def check_plane(model: Model) -> None:
    """Raises SettingsError: the model has no coordinates x and z."""
    missing = [name for name in ("x", "z") if name not in model.coordinates]
    if missing:
        raise SettingsError(
            "square, star, sine and random_waypoints are flown in x and z; "
            f'model "{model.name}" has no coordinate {missing[0]}: '
            f"it has {', '.join(model.coordinates)}. Use plan(plant, waypoints=...)"
        )
