"""Vehicles of the gauntlet: a model with its truth, flights to record it on, and what the model does not know of it.

A new vehicle is one more `Vehicle` in `VEHICLES`.  Nothing happens when this file is run.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
from casadi import cos, pi, sin
from scipy.ndimage import uniform_filter1d

import diransac as dr
from diransac.planning.flights import PLANNED_SHARE, ROTORCRAFT_LIMITS

Array = np.ndarray[Any, Any]
DT, DURATION = 0.01, 25.0
SUBSTEPS = 20
"""Integration steps from row to row, at least: a log is of the machine, not of an identifier's own discretisation."""

RIPPLES = 126
"""Of a motor's torque in a turn of its joint: 21 pairs of poles behind a gear of 6."""


@dataclass(frozen=True)
class Vehicle:
    """What is identified.

    Parameters
    ----------
    plant : gives the true plant; its options are what the model does not know, all zero by default
    flights : name -> trajectory that is flown while the log is recorded, for the true plant
    lever : the signal or input in whose largest rows one-sided outliers strike
    mission : the trajectory that an identified model plans and flies to be judged by; None where it isn't
    shown_apart : flights that others have tuned on, which only run when they are asked for
    """

    plant: Callable[..., dr.Plant]
    flights: Mapping[str, Callable[[dr.Plant], dr.Trajectory]]
    lever: str
    mission: Callable[..., dr.Trajectory] | None = None
    shown_apart: tuple[str, ...] = field(default=())


# ---------------------------------------------------------------------- what is recorded, and what is true


@cache
def _steered(vehicle: str, flight: str) -> tuple[dr.Trajectory, dr.Controller]:
    """A flight and what holds it, both made with the true parameters; dry friction is no help to feedback."""
    true = VEHICLES[vehicle].plant()
    trajectory = VEHICLES[vehicle].flights[flight](true)
    known = {name: 0.0 if name.startswith("dry_friction") else x for name, x in true.parameters.items()}
    return trajectory, dr.tvlqr(dr.Plant(true.model, known), trajectory)


def recorded(vehicle: str, flight: str, plant: dr.Plant, seed: int) -> dr.Log:
    """The log of a flight as a perfect recorder writes it; the seed draws the phases of what vibrates."""
    trajectory, controller = _steered(vehicle, flight)
    return dr.fly(plant, trajectory, controller, substeps=max(SUBSTEPS, plant.substeps(DT)), seed=seed)


def effective_parameters(plant: dr.Plant, log: dr.Log) -> dict[str, float]:
    """The best parameters that the model can reach: least squares on the clean, vibration-free log of the flight.

    Vibration is taken away by averaging accelerations over the phases of the disturbances at each state flown.
    """
    columns = dict(zip(plant.model.accelerations, mean_accelerations(plant, log).T, strict=True))
    calm = dr.Log.from_arrays(log.time, {**log.signals, **columns}, log.units, source="vibration-free log")
    method = "nls" if plant.model.nonlinear_parameters else "ols"
    return dict(dr.identify(plant.model, calm, method).parameters)


def mean_accelerations(plant: dr.Plant, log: dr.Log, n_phases: int = 8) -> Array:
    """Accelerations (N, n_v) in each row of a log, averaged over every ``phase...`` state of the disturbances."""
    own = plant.simulated.state[len(plant.model.state) :]
    is_phase = [name.rpartition(".")[2].startswith("phase") for name in own]
    x, u = (np.array([log[name] for name in names]) for names in (plant.model.state, plant.model.inputs))
    constants = np.tile(plant.constants[:, None], len(log))
    total = 0.0
    for angle in 2.0 * np.pi * np.arange(n_phases) / n_phases:
        hidden = np.where(is_phase, angle, 0.0)[:, None] * np.ones(len(log))
        total += np.array(plant.simulated.dynamics(np.vstack([x, hidden]), u, constants)[1])
    return (total / n_phases).T


# ---------------------------------------------------------------------- flights


def through_places(seed: int, speed: float, reach: float) -> Callable[[dr.Plant], dr.Trajectory]:
    """From place to random place in the plane of x and z, at a mean speed (m/s), for 25 s; `reach` in m.

    A plan holds its inputs for 0.1 s, and a delay would hardly show; they are smoothed, and feedback does the rest.
    """
    places = np.vstack([[0.0, 0.0], np.random.default_rng(seed).uniform(-reach, reach, (100, 2))])
    legs = np.linalg.norm(np.diff(places, axis=0), axis=1) / speed
    n = int(np.searchsorted(np.cumsum(legs), DURATION))
    times = np.round(np.concatenate([[0.0], np.cumsum(legs[:n])]), 2).tolist()
    waypoints = [{"x": float(x), "z": float(z)} for x, z in places[: n + 1]]

    def planned(true: dr.Plant) -> dr.Trajectory:
        route = {"x": [w["x"] for w in waypoints], "z": [w["z"] for w in waypoints]}
        reference = {k: (lambda t, way=way: np.interp(t, times, way)) for k, way in route.items()}
        plan = dr.plan(
            true, waypoints=waypoints, times=times, reference=reference, tracking={"x": 1.0, "z": 1.0},
            input_limits=ROTORCRAFT_LIMITS, input_share=PLANNED_SHARE,
        )  # fmt: skip
        return replace(plan, inputs=uniform_filter1d(plan.inputs, 11, axis=0, mode="nearest"))

    return planned


def swinging(seed: int, amplitude: float, frequency: float) -> Callable[[dr.Plant], dr.Trajectory]:
    """Every coordinate a sum of five sines up to a frequency (Hz), with the inputs that inverse dynamics gives."""

    def planned(true: dr.Plant) -> dr.Trajectory:
        model, rng = true.model, np.random.default_rng(seed)
        time = np.arange(round(DURATION / DT) + 1) * DT
        shape = (5, model.n_q, 1)
        w, phase = 2 * np.pi * frequency * rng.uniform(0.2, 1.0, shape), rng.uniform(0.0, 2 * np.pi, shape)
        angle, size = w * time + phase, amplitude * rng.uniform(0.2, 0.6, shape)
        q, v, a = (
            np.sum(size * w**order * np.sin(angle + order * np.pi / 2), axis=0) for order in range(3)
        )  # a derivative is a factor w and a quarter turn
        inputs = np.array(_inverse_dynamics(model)(q, v, a, list(true.parameters.values())))
        names = model.state, tuple(model.inputs)
        return dr.Trajectory(time, np.vstack([q, v]).T, inputs.T, *names)

    return planned


def _inverse_dynamics(model: dr.Model) -> ca.Function:
    """Inputs of a fully actuated model, whose residual is affine in them."""
    q, v, a, u, p = (ca.SX.sym(n, k) for n, k in zip("qvaup", _sizes(model), strict=True))
    r = model.residual(q, v, a, u, p)
    inputs = -ca.solve(ca.densify(ca.jacobian(r, u)), ca.densify(ca.substitute(r, u, 0)))
    return ca.Function("inverse_dynamics", [q, v, a, p], [inputs])


def _sizes(model: dr.Model) -> tuple[int, ...]:
    return model.n_q, model.n_v, model.n_v, model.n_u, model.n_p


# ---------------------------------------------------------------------- plants


def servo_axis(cogging: float = 0.0) -> dr.Plant:
    """A servo axis of EMPS's size; its magnets pull it by `cogging` (N) to and fro, every 24 mm."""
    model = dr.models.servo_axis()
    truth = {"mass": 95.0, "viscous_friction": 200.0, "dry_friction": 20.0, "offset": -12.0}
    magnets = dr.Disturbance(
        model,
        "magnets",
        forces=lambda q, v, u, p, d: {"position": d.amplitude * cos(2 * pi * q.position / 0.024 + d.phase)},
        constants={"amplitude": cogging},
        **_anywhere("phase"),
        highest_frequency=40.0,
    )
    return dr.Plant(model, truth, (magnets,))


def double_pendulum(ripple: float = 0.0) -> dr.Plant:
    """A double pendulum whose motors ripple by so many N m."""
    model = dr.models.double_pendulum()
    truth = {
        "inertia1": 0.09, "moment1": 0.3, "inertia2": 0.025, "moment2": 0.12, "rotor_inertia": 6e-5,
        "viscous_friction1": 0.02, "dry_friction1": 0.08, "viscous_friction2": 0.02, "dry_friction2": 0.05,
    }  # fmt: skip
    motors = dr.Disturbance(
        model,
        "motors",
        forces=lambda q, v, u, p, d: {
            "q1": d.ripple * cos(RIPPLES * q.q1 + d.phase_1),
            "q2": d.ripple * cos(RIPPLES * q.q2 + d.phase_2),
        },
        constants={"ripple": ripple},
        **_anywhere("phase_1", "phase_2"),
        highest_frequency=200.0,
    )
    return dr.Plant(model, truth, (motors,))


def pendulum(ripple: float = 0.0) -> dr.Plant:
    """``a = -g/l sin(q) - (c v - torque) / (m l^2)``: a mass on a rod of unknown length; its motor ripples (N m)."""
    model = dr.Model(
        "pendulum",
        coordinates={"angle": "rad"},
        inputs={"torque": "N m"},
        parameters={
            "mass": dr.Parameter("kg", positive=True),
            "length": dr.Parameter("m", positive=True),
            "friction": dr.Parameter("N m s/rad", lower=0.0),
        },
        equations=lambda q, v, a, u, p: [
            a.angle + 9.81 / p.length * sin(q.angle) + (p.friction * v.angle - u.torque) / (p.mass * p.length**2)
        ],
    )
    motor = dr.Disturbance(
        model,
        "motor",
        accelerations=lambda q, v, u, p, d: {
            "angle": d.ripple * cos(RIPPLES * q.angle + d.phase) / (p.mass * p.length**2)
        },
        constants={"ripple": ripple},
        **_anywhere("phase"),
        highest_frequency=200.0,
    )
    return dr.Plant(model, {"mass": 0.5, "length": 0.6, "friction": 0.05}, (motor,))


def rotorcraft(**imbalances: Any) -> dr.Plant:
    """The paper's rotorcraft; its rotors start anywhere, drawn with the flight's seed."""
    return dr.models.extended_rotorcraft(rotor_phase=None, **imbalances)


def _anywhere(*phases: str) -> dict[str, Any]:
    """States of a disturbance that stay where the flight's seed puts them."""
    return {
        "states": dict.fromkeys(phases, "rad"),
        "rates": lambda q, v, u, p, d: dict.fromkeys(phases, 0.0),
        "start": dict.fromkeys(phases, (0.0, 2 * np.pi)),
    }


VEHICLES = {
    "rotorcraft": Vehicle(
        rotorcraft,
        {
            "wander": through_places(seed=1, speed=1.5, reach=2.5),
            "rush": through_places(seed=2, speed=2.2, reach=4.0),
            "star": dr.star,
        },
        "thrust",
        mission=dr.square,
        shown_apart=("star",),
    ),
    "servo-axis": Vehicle(servo_axis, {"wander": swinging(1, 0.15, 0.6), "rush": swinging(2, 0.1, 1.2)}, "force"),
    "double-pendulum": Vehicle(
        double_pendulum, {"wander": swinging(3, 0.8, 0.7), "rush": swinging(4, 0.5, 1.4)}, "torque1"
    ),
    "pendulum": Vehicle(pendulum, {"wander": swinging(5, 0.8, 0.7), "rush": swinging(6, 0.5, 1.4)}, "torque"),
}
