"""Flights for data: they move all that a model has, and each seed gives another one.

Nothing that is tuned on one of them has been tuned on the next.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from scipy.ndimage import uniform_filter1d

from diransac.arrays import FloatArray
from diransac.errors import SettingsError
from diransac.flight.planning.flights import Limits, check_plane, through
from diransac.flight.planning.planner import TIME_STEP
from diransac.flight.trajectory import Trajectory

if TYPE_CHECKING:
    from diransac.model import Model
    from diransac.model.plant import ModelWithParameters


__all__ = ["LONGEST", "check_fully_actuated", "multisine", "random_waypoints"]

LONGEST = 3600.0
"""s: 360 000 rows; a longer flight is a slip of the pen, and would only fill the memory."""

SHORTEST_LEG = 1.0
"""s: from rest, a rotorcraft must turn before it moves sideways."""

SMOOTHED_ROWS = 11
"""Rows over which inputs are averaged: a plan holds them for ten, and would hardly show that they arrive late."""

_SINES = 5
"""Of each coordinate."""


def random_waypoints(
    plant: ModelWithParameters,
    *,
    seed: int = 0,
    speed: float = 1.6,
    reach: float = 2.0,
    duration: float = 25.0,
    input_limits: Limits | None = None,
    **options: Any,
) -> Trajectory:
    """From rest at the origin through random places in the plane of x and z, to rest at the last of them.

    Parameters
    ----------
    plant : with coordinates x and z, m
    seed : of the places, which are uniform in a square; 0 or more
    speed : mean speed along the straight way from each place to the next, m/s
    reach : half a side of that square, m
    duration : s, an hour at most; the flight ends at the last place that is reached before
    input_limits, options : as those of `square`

    The plan's inputs are smoothed over 0.1 s, so that they move in every row; the states are still the plan's, from
    which the paper's rotorcraft strays by less than a millimetre under feedback. A place less than 1 s away is passed
    over: it could hardly be reached from rest.

    Raises SettingsError: a model without coordinates x and z, a number out of its range, places too near or too far.
    Raises PlanningError: no such trajectory; it says why.
    """
    check_plane(plant.model)
    _check(seed, duration, speed=speed, reach=reach)
    way, times = _random_way(seed, speed, reach, duration)
    planned = through(plant, way, times, input_limits, options)
    return replace(planned, inputs=uniform_filter1d(planned.inputs, SMOOTHED_ROWS, axis=0, mode="nearest"))


def _random_way(seed: int, speed: float, reach: float, duration: float) -> tuple[list[tuple[float, float]], FloatArray]:
    """Places, m, and when they are reached (K,), s.  Raises SettingsError: there are none of that distance."""
    if reach < speed * SHORTEST_LEG:
        raise SettingsError(
            f"places within a reach of {reach:g} m are too near for a speed of {speed:g} m/s: each is to be at least "
            f"{SHORTEST_LEG:g} s from the one before; give a reach of {speed * SHORTEST_LEG:g} m or more"
        )
    rng = np.random.default_rng(seed)
    way, times = [(0.0, 0.0)], [0.0]
    while True:
        x, z = rng.uniform(-reach, reach, 2).tolist()
        leg = math.hypot(x - way[-1][0], z - way[-1][1]) / speed
        if times[-1] + leg >= duration:
            break
        if leg >= SHORTEST_LEG:
            way.append((x, z))
            times.append(times[-1] + leg)
    if len(way) < 2:
        raise SettingsError(
            f"the first place is {leg:.3g} s away at {speed:g} m/s, and the flight lasts {duration:g} s; "
            "give more duration or speed, or less reach"
        )
    return way, TIME_STEP * np.rint(np.array(times) / TIME_STEP)


def multisine(
    plant: ModelWithParameters, *, seed: int = 0, amplitude: float = 0.5, frequency: float = 1.0, duration: float = 25.0
) -> Trajectory:
    """Every coordinate a sum of five sines, with the inputs that inverse dynamics gives: a multisine.

    Parameters
    ----------
    plant : fully actuated: as many inputs as coordinates, which the inputs can push at will
    seed : of frequencies, sizes and phases, which are uniform; 0 or more
    amplitude : each sine's is 0.2 to 0.6 of it, each coordinate's unit; together they come to about 0.66 of it, RMS
    frequency : Hz; each sine's is 0.2 to 1.0 of it
    duration : s, an hour at most

    Nothing is searched for, and no limit is kept to. The flight starts in motion. An input, held from row to row, is
    that of the moment between them.

    Raises SettingsError: a model that is not fully actuated, or a number out of its range.

    References: Swevers et al. 1997, "Optimal robot excitation and identification", IEEE Trans. Robotics and Automation
    13(5), for sums of sines; theirs are optimised, these are drawn.
    """
    model = plant.model
    inverse_dynamics = _inverse_dynamics(model)
    _check(seed, duration, amplitude=amplitude, frequency=frequency)
    rng = np.random.default_rng(seed)
    time = np.arange(round(duration / TIME_STEP) + 1, dtype=np.float64) * TIME_STEP
    shape = (_SINES, model.n_q, 1)
    w, phase = 2 * np.pi * frequency * rng.uniform(0.2, 1.0, shape), rng.uniform(0.0, 2 * np.pi, shape)
    size = amplitude * rng.uniform(0.2, 0.6, shape)

    def motion(t: FloatArray) -> list[FloatArray]:
        """q, v and a (n_q, K): a derivative is a factor w and a quarter turn."""
        return [np.sum(size * w**k * np.sin(w * t + phase + k * np.pi / 2), axis=0) for k in range(3)]

    inputs = np.array(inverse_dynamics(*motion(time + TIME_STEP / 2), model.parameter_vector(plant.parameters)))
    return Trajectory(time, np.vstack(motion(time)[:2]).T, inputs.T, model.state, tuple(model.inputs))


def check_fully_actuated(model: Model) -> None:
    """Raises SettingsError: inverse dynamics does not give this model's inputs, uniquely, for every acceleration."""
    _inverse_dynamics(model)


def _inverse_dynamics(model: Model) -> ca.Function:
    """Inputs (n_u, K) from q, v, a (n_v, K) and p.  Raises SettingsError: as `check_fully_actuated`."""
    sizes = model.n_q, model.n_v, model.n_v, model.n_u, model.n_p
    q, v, a, u, p = (ca.SX.sym(name, size) for name, size in zip("qvaup", sizes, strict=True))
    r = model.residual(q, v, a, u, p)
    push = ca.jacobian(r, u)
    square = model.kinematics is None and model.n_u == model.n_v
    if not square or ca.depends_on(push, u) or ca.sprank(push) < model.n_v:
        raise SettingsError(
            f'model "{model.name}" is not fully actuated: its inputs ({", ".join(model.inputs)}) do not push each of '
            f"its coordinates ({', '.join(model.coordinates)}) at will and linearly; plan a flight with diransac.plan"
        )
    inputs = -ca.solve(ca.densify(push), ca.densify(ca.substitute(r, u, 0)))
    return ca.Function("inverse_dynamics", [q, v, a, p], [inputs])


def _check(seed: object, duration: float, **values: float) -> None:
    """Raises SettingsError: no seed, no duration from a row to an hour, or a value that isn't finite and above 0."""
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise SettingsError(f"seed is {seed!r:.60}; give a whole number of at least 0")
    if not TIME_STEP <= duration <= LONGEST:
        raise SettingsError(f"duration is {duration!r:.60}; give {TIME_STEP:g} to {LONGEST:g} s")
    for name, value in values.items():
        if not 0.0 < value < np.inf:
            raise SettingsError(f"{name} is {value!r:.60}; give a finite number above 0")
