"""Closed-loop simulation: a controller designed with a model steers a plant with disturbances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from diransac.arrays import FloatArray
from diransac.data.log import Log
from diransac.errors import SettingsError, check_known
from diransac.model.plant import ModelWithParameters, Plant, as_plant
from diransac.simulation import LinearFeedback, RolloutBatch, Simulator, default_threads, rollouts

if TYPE_CHECKING:
    from diransac.flight.trajectory import Trajectory
    from diransac.flight.tvlqr import Controller


def fly(
    plant: ModelWithParameters,
    trajectory: Trajectory,
    controller: Controller,
    *,
    initial_state: Mapping[str, float] | None = None,
    dt: float | None = None,
    substeps: int | None = None,
    seed: int = 0,
) -> Log:
    """Log of a simulated flight under ``u_k = clip(u_ref - K (x - x_ref))``, held from each sample to the next.

    Parameters
    ----------
    plant : Plant or Result
        The simulated plant, with its disturbances.
    trajectory : Trajectory
        The reference; it gives duration and initial state.
    controller : Controller
        The feedback law.
    initial_state : mapping of str to float, optional
        States by name that differ from the start of the trajectory.
    dt : float, optional
        Sampling time of the controller, s; the trajectory's by default. A controller on another time grid has the
        reference and gains of its last row.
    substeps : int, optional
        Integration steps (RK4) per sample; by default as many as the plant's disturbances need.
    seed : int
        Of the initial states of disturbances that are drawn from a range.

    Returns
    -------
    Log
        Every state and acceleration of the model and the applied inputs, without noise; `corrupt` adds it. After a
        divergence values are NaN, and a note gives its time.

    Raises
    ------
    SettingsError
        Plant, trajectory and controller do not match, or an argument has no meaning.

    Notes
    -----
    The controller measures the true state. It does not depend on the disturbances.
    """
    plant = as_plant(plant)
    start = _start(plant, trajectory, initial_state or {})
    if dt is not None and not 0.0 < dt < np.inf:
        raise SettingsError(f"dt is {dt}; give positive seconds")
    time = trajectory.time
    if dt is not None:
        time = time[0] + dt * np.arange(round((time[-1] - time[0]) / dt) + 1)
    return fly_batch([plant], [controller.at(time)], start[None], substeps=substeps, seeds=[seed], threads=1)[0]


def fly_batch(
    plants: Sequence[ModelWithParameters],
    controllers: Sequence[Controller],
    initial_states: npt.ArrayLike | None = None,
    *,
    substeps: int | None = None,
    seeds: Sequence[int] | None = None,
    threads: int | None = None,
) -> list[Log]:
    """Logs of many flights, each identical to that of `fly`: eight per vector, vectors on several threads.

    Parameters
    ----------
    plants : sequence of Plant or Result
        One per flight, of one model and the same disturbances; parameters and constants may differ.
    controllers : sequence of Controller
        One per flight, of equal length.
    initial_states : (n_flights, n_x) array, optional
        By default the first row of each controller.
    substeps : int, optional
        As in `fly`.
    seeds : sequence of int, optional
        One per flight, as in `fly`.
    threads : int, optional
        Number of vectors simulated at once; the number of cores by default. It changes no result.

    Raises
    ------
    SettingsError
        Plants of different equations, or controllers of different lengths or for other states.
    """
    flown = [as_plant(plant) for plant in plants]
    seeds = seeds or [0] * len(flown)
    if not flown or len(controllers) != len(flown) or len(seeds) != len(flown):
        raise SettingsError(
            f"{len(flown)} plants, {len(controllers)} controllers and {len(seeds)} seeds do not match; "
            "give one of each per flight"
        )
    _check_names(flown, controllers)
    starts = [one.states[0] for one in controllers] if initial_states is None else np.asarray(initial_states)
    states = [plant.initial_state(x, seed) for plant, x, seed in zip(flown, starts, seeds, strict=True)]
    steps = np.array([substeps or plant.substeps(one.dt) for plant, one in zip(flown, controllers, strict=True)])
    logs: dict[int, Log] = {}
    for n in np.unique(steps):
        lanes = np.flatnonzero(steps == n).tolist()
        some = _flown_with(
            [flown[k] for k in lanes], [controllers[k] for k in lanes], [states[k] for k in lanes], int(n),
            threads or default_threads(),
        )  # fmt: skip
        logs |= zip(lanes, some, strict=True)
    return [logs[k] for k in range(len(flown))]


def _flown_with(
    plants: list[Plant], controllers: list[Controller], states: list[FloatArray], substeps: int, threads: int
) -> list[Log]:
    """Logs of flights with the same number of integration steps per sample."""
    engine, n_x = _engine(plants, substeps), len(plants[0].model.state)
    feedback, feedback_of_lane = _feedback(controllers, len(states[0]))
    constants = np.array([plant.constants for plant in plants])
    lanes = RolloutBatch(constants, np.array(states), feedback.u_ref[0], controllers[0].dt)
    batch = engine.fly(lanes, feedback, feedback_of_lane=feedback_of_lane, threads=threads)
    signals = np.delete(batch.signals, np.s_[n_x : len(states[0])], axis=-1)
    return [
        _log(plant, controller, x, u, substeps)
        for plant, controller, x, u in zip(plants, controllers, signals, batch.inputs, strict=True)
    ]


def tracking_error(trajectory: Trajectory, log: Log) -> dict[str, float]:
    """RMS of ``flown - reference`` for each state, in its unit; infinite where the flight diverged.

    Parameters
    ----------
    trajectory : Trajectory
        The reference, with names of its states.
    log : Log
        The flight. Rows before the start and after the end of the trajectory are ignored; between rows of the
        trajectory the reference is interpolated.

    Raises
    ------
    LogError
        The log lacks a state.
    SettingsError
        Log and trajectory do not overlap in time, or the trajectory has no names.

    References
    ----------
    Dimmig et al. 2023, section V: "RMS error between the generated reference trajectory and the extended plant's true
    path".
    """
    slack = 1e-6 * trajectory.dt  # within which two moments are the same
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
    """Initial state (n_x,): the trajectory's, with changes by name."""
    names = plant.model.state
    check_known(changes, names, "initial_state names", "states are")
    if trajectory.states.shape[1] != len(names):
        raise SettingsError(
            f"the trajectory has {trajectory.states.shape[1]} states; the plant has {len(names)}: {', '.join(names)}"
        )
    start = np.array([changes.get(name, x) for name, x in zip(names, trajectory.states[0], strict=True)], np.float64)
    if not np.isfinite(start).all():
        raise SettingsError("initial_state holds a NaN or an infinity; give finite numbers")
    return start


def _engine(plants: Sequence[Plant], substeps: int) -> Simulator:
    """Rollouts of the equations that all plants share."""
    different = {id(plant): plant for plant in plants}.values()
    engines = {rollouts(plant.simulated, substeps=substeps) for plant in different}
    if len(engines) > 1:
        raise SettingsError(
            "the plants' equations differ; call fly_batch with plants of one model and the same disturbances"
        )
    return engines.pop()


def _check_names(plants: Sequence[Plant], controllers: Sequence[Controller]) -> None:
    """Raise SettingsError if a controller is for other states or inputs than its plant's."""
    for plant, controller in zip(plants, controllers, strict=True):
        has, wanted = (controller.state_names, controller.input_names), (plant.model.state, tuple(plant.model.inputs))
        if has != wanted:
            raise SettingsError(
                f'the controller is for {", ".join(has[0] + has[1])}, but the plant "{plant.model.name}" has '
                f"{', '.join(wanted[0] + wanted[1])}"
            )


def _feedback(controllers: Sequence[Controller], n_x: int) -> tuple[LinearFeedback, npt.NDArray[np.int64]]:
    """Table of the distinct feedback laws, and the law of each lane; gains on disturbances' states are zero."""
    different = list({id(controller): controller for controller in controllers}.values())
    first = different[0]
    for other in different[1:]:
        same = (len(other.time), other.u_min.tolist(), other.u_max.tolist()) == (
            len(first.time), first.u_min.tolist(), first.u_max.tolist()
        ) and np.isclose(other.dt, first.dt)  # fmt: skip
        if not same:
            raise SettingsError(
                "the controllers differ in length, time step or limits; call fly_batch for each kind, or fly for each"
            )
    hidden = n_x - first.states.shape[1]
    u_ref, x_ref, K = (np.array([getattr(one, name) for one in different]) for name in ("inputs", "states", "gains"))
    x_ref, K = (np.pad(array, [(0, 0)] * (array.ndim - 1) + [(0, hidden)]) for array in (x_ref, K))
    place = {id(controller): k for k, controller in enumerate(different)}
    feedback = LinearFeedback(u_ref, x_ref, K, first.u_min, first.u_max)
    return feedback, np.array([place[id(one)] for one in controllers])


def _log(plant: Plant, controller: Controller, signals: FloatArray, inputs: FloatArray, substeps: int) -> Log:
    """Log of a simulated flight."""
    model = plant.model
    columns = dict(zip((*model.signals, *model.inputs), (*signals.T, *inputs.T), strict=True))
    step = {"step": "fly", "plant": plant.simulated.name, "substeps": substeps}
    ended = ~np.isfinite(signals).all(axis=1)
    notes = (f"the flight diverged at t = {controller.time[int(np.argmax(ended))]:.6g} s",) if ended.any() else ()
    return Log(controller.time, columns, model.units, f'flight of "{plant.simulated.name}"', (step,), notes)
