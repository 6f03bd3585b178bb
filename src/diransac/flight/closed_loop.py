"""Closed loops: a controller that knows a model steers a plant that has more to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from diransac.arrays import FloatArray
from diransac.data.log import Log
from diransac.errors import SettingsError
from diransac.model.plant import ModelWithParameters, Plant, as_plant
from diransac.simulation import LinearFeedback, RolloutBatch, Rollouts, default_threads, rollouts

if TYPE_CHECKING:
    from diransac.flight.trajectory import Trajectory
    from diransac.flight.tvlqr import Controller

__all__ = ["fly", "fly_batch", "tracking_error"]


_SAME_INSTANT = 1e-6


def fly(
    plant: ModelWithParameters,
    trajectory: Trajectory,
    controller: Controller,
    *,
    initial_state: Mapping[str, float] | None = None,
    dt: float | None = None,
    gains: str = "hold",
    substeps: int | None = None,
    seed: int = 0,
) -> Log:
    """The log of a flight: ``u_k = clip(u_ref - K (x - x_ref))`` at every sample, held to the next.

    The feedback sees the true state, disturbances act on the plant without the controller's knowing, and what is logged
    is the truth: every state and acceleration of the model, and the inputs that were applied.  `corrupt` spoils it.

    Parameters
    ----------
    plant : what flies, a `Plant` with its disturbances, or a `Result`
    trajectory : what is to be flown; it says how long, and where the flight starts
    controller : what steers
    initial_state : state name -> value, of states that start elsewhere
    dt : s between samples of the controller; the trajectory's by default
    gains : of a controller on another time grid: `hold` the last, or `linear`, interpolated
    substeps : integration steps (RK4) a sample; by default as many as the plant's disturbances need
    seed : of disturbances that start anywhere

    From a divergence on the log has NaN, and a note says when it was.

    Raises SettingsError: plant, trajectory and controller do not fit together, or an argument has no meaning.
    """
    plant = as_plant(plant)
    start = _start(plant, trajectory, initial_state or {})
    if dt is not None:
        n_steps = round((trajectory.time[-1] - trajectory.time[0]) / _positive("dt", dt))
        steering = controller.at(trajectory.time[0] + dt * np.arange(n_steps + 1), how=gains)
    elif _same_instants(controller.time, trajectory.time):
        steering = controller
    else:
        steering = controller.at(trajectory.time, how=gains)
    return fly_batch([plant], [steering], start[None], substeps=substeps, seeds=[seed], threads=1)[0]


def fly_batch(
    plants: Sequence[ModelWithParameters],
    controllers: Sequence[Controller],
    initial_states: npt.ArrayLike | None = None,
    *,
    substeps: int | None = None,
    seeds: Sequence[int] | None = None,
    threads: int | None = None,
) -> list[Log]:
    """Logs of many flights at a time, each as `fly` gives it: eight of them to a vector, vectors on several threads.

    Parameters
    ----------
    plants : one a flight, of one model and the same disturbances, whose parameters and constants may differ
    controllers : one a flight, of equally many rows
    initial_states : (n_flights, n_x)   by default each controller's first
    substeps, seeds : as `fly` has them, one seed a flight
    threads : how many vectors fly at a time; as many as there are cores by default

    Raises SettingsError: plants of different equations, controllers of different lengths or for other states.
    """
    flown = [as_plant(plant) for plant in plants]
    if not flown or len(controllers) != len(flown) or len(seeds or flown) != len(flown):
        raise SettingsError(
            f"{len(flown)} plants, {len(controllers)} controllers and {len(seeds or flown)} seeds do not make flights; "
            "give one of each a flight"
        )
    _check_names(flown, controllers)
    starts = [one.states[0] for one in controllers] if initial_states is None else np.asarray(initial_states)
    states = [
        plant.initial_state(x, seed) for plant, x, seed in zip(flown, starts, seeds or [0] * len(flown), strict=True)
    ]
    steps = np.array([substeps or plant.substeps(one.dt) for plant, one in zip(flown, controllers, strict=True)])
    logs: dict[int, Log] = {}
    for n in np.unique(steps):
        lanes = np.flatnonzero(steps == n).tolist()
        together = _flown_together(
            [flown[k] for k in lanes], [controllers[k] for k in lanes], [states[k] for k in lanes], int(n),
            threads or default_threads(),
        )  # fmt: skip
        logs |= zip(lanes, together, strict=True)
    return [logs[k] for k in range(len(flown))]


def _flown_together(
    plants: list[Plant], controllers: list[Controller], states: list[FloatArray], substeps: int, threads: int
) -> list[Log]:
    """Logs of flights with equally many integration steps a sample."""
    engine, n_x = _engine(plants, substeps), len(plants[0].model.state)
    feedback, feedback_of_lane = _feedback(controllers, len(states[0]))
    constants = np.array([plant.constants for plant in plants])
    batch = RolloutBatch(constants, np.array(states), feedback.u_ref[0], controllers[0].dt)
    flights = engine.fly(batch, feedback, feedback_of_lane=feedback_of_lane, threads=threads)
    signals = np.delete(flights.signals, np.s_[n_x : len(states[0])], axis=-1)
    return [
        _log(plant, controller, x, u, substeps)
        for plant, controller, x, u in zip(plants, controllers, signals, flights.inputs, strict=True)
    ]


def tracking_error(trajectory: Trajectory, log: Log) -> dict[str, float]:
    """RMS of ``flown - reference`` over a flight, by state, each state's unit; infinite where the flight diverged.

    Rows of the log before the trajectory's start and after its end do not count; between its rows the reference is
    interpolated.

    Raises LogError: the log lacks a state.  Raises SettingsError: they have no time in common, or the trajectory's
    columns have no names.

    References: Dimmig et al. 2023, section V: "RMS error between the generated reference trajectory and the extended
    plant's true path".
    """
    slack = _SAME_INSTANT * trajectory.dt
    common = (log.time >= trajectory.time[0] - slack) & (log.time <= trajectory.time[-1] + slack)
    if not common.any():
        raise SettingsError(
            f"{log.source} runs from {log.time[0]:.6g} to {log.time[-1]:.6g} s, the trajectory from "
            f"{trajectory.time[0]:.6g} to {trajectory.time[-1]:.6g} s: they have no time in common"
        )
    errors = {}
    for name in trajectory.state_names:
        reference = np.interp(log.time[common], trajectory.time, trajectory[name])
        mean_square = np.mean(np.square(log[name][common] - reference))
        errors[name] = float(np.sqrt(mean_square)) if np.isfinite(mean_square) else np.inf
    if not errors:
        raise SettingsError("the trajectory's columns have no names; give state_names and input_names")
    return errors


def _start(plant: Plant, trajectory: Trajectory, changes: Mapping[str, float]) -> FloatArray:
    """Initial state (n_x,): the trajectory's, but for some."""
    names = plant.model.state
    unknown = [name for name in changes if name not in names]
    if unknown:
        raise SettingsError(f'initial_state names "{unknown[0]}"; states are {", ".join(names)}')
    if trajectory.states.shape[1] != len(names):
        raise SettingsError(
            f"the trajectory has {trajectory.states.shape[1]} states; the plant has {len(names)}: {', '.join(names)}"
        )
    start = np.array([changes.get(name, x) for name, x in zip(names, trajectory.states[0], strict=True)], np.float64)
    if not np.isfinite(start).all():
        raise SettingsError("initial_state holds a NaN or an infinity; give finite numbers")
    return start


def _positive(name: str, value: float) -> float:
    """The value itself.  Raises SettingsError: it is no positive number."""
    if not (np.isfinite(value) and value > 0):
        raise SettingsError(f"{name} is {value}; give positive seconds")
    return value


def _same_instants(a: FloatArray, b: FloatArray) -> bool:
    """Whether two time grids are one."""
    return len(a) == len(b) and bool(np.allclose(a, b, rtol=0.0, atol=_SAME_INSTANT * (b[1] - b[0])))


def _engine(plants: Sequence[Plant], substeps: int) -> Rollouts:
    """Rollouts of what they all are."""
    different = {id(plant): plant for plant in plants}.values()
    engines = {rollouts(plant.simulated, substeps=substeps) for plant in different}
    if len(engines) > 1:
        raise SettingsError("the plants' equations differ; fly plants of one model and the same disturbances together")
    return engines.pop()


def _check_names(plants: Sequence[Plant], controllers: Sequence[Controller]) -> None:
    """Raises SettingsError: a controller is for other states or inputs than its plant's."""
    for plant, controller in zip(plants, controllers, strict=True):
        has, wanted = (controller.state_names, controller.input_names), (plant.model.state, tuple(plant.model.inputs))
        if has != wanted:
            raise SettingsError(
                f'the controller is for {", ".join(has[0] + has[1])}, but the plant "{plant.model.name}" has '
                f"{', '.join(wanted[0] + wanted[1])}"
            )


def _feedback(controllers: Sequence[Controller], n_x: int) -> tuple[LinearFeedback, npt.NDArray[np.int64]]:
    """Feedback laws of different controllers as a table, and each lane's index; disturbances' states have no gain."""
    different = list({id(controller): controller for controller in controllers}.values())
    first = different[0]
    for other in different[1:]:
        same = (len(other.time), other.u_min.tolist(), other.u_max.tolist()) == (
            len(first.time), first.u_min.tolist(), first.u_max.tolist()
        ) and np.isclose(other.dt, first.dt)  # fmt: skip
        if not same:
            raise SettingsError("controllers of different lengths, steps or limits cannot steer flights together")
    hidden = n_x - first.states.shape[1]
    u_ref, x_ref, K = (np.array([getattr(one, name) for one in different]) for name in ("inputs", "states", "gains"))
    x_ref, K = (np.pad(array, [(0, 0)] * (array.ndim - 1) + [(0, hidden)]) for array in (x_ref, K))
    place = {id(controller): k for k, controller in enumerate(different)}
    feedback = LinearFeedback(u_ref, x_ref, K, first.u_min, first.u_max)
    return feedback, np.array([place[id(one)] for one in controllers])


def _log(plant: Plant, controller: Controller, signals: FloatArray, inputs: FloatArray, substeps: int) -> Log:
    """A flight as a log."""
    model = plant.model
    columns = dict(zip((*model.signals, *model.inputs), (*signals.T, *inputs.T), strict=True))
    step = {"step": "fly", "plant": plant.simulated.name, "substeps": substeps}
    ended = ~np.isfinite(signals).all(axis=1)
    notes = (f"the flight diverged at t = {controller.time[int(np.argmax(ended))]:.6g} s",) if ended.any() else ()
    return Log(controller.time, columns, model.units, f'flight of "{plant.simulated.name}"', (step,), notes)
