"""The data of a trial: the flight, its corrupted log, and the pseudo-true parameters of the flight."""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from diransac.data.log import Log
from diransac.errors import PlanningError
from diransac.flight.closed_loop import fly_batch
from diransac.flight.corruption import corrupt
from diransac.flight.tvlqr import Controller, tvlqr
from diransac.model.plant import Plant
from diransac.process import single_threaded
from diransac.study.assessment import pseudo_true_parameters
from diransac.study.library import load
from diransac.study.plants import PlantChoice
from diransac.study.specification import ControlChoice, FlightChoice, Study
from diransac.study.tables import check_whole

PLANNING_TIME_LIMIT = 600.0
"""s per plan: long enough for a solver's limit of iterations to end it first on any machine."""


def derived_seed(*key: str | int) -> int:
    """A seed of 63 bits that depends on the key alone and is the same on every machine."""
    digest = hashlib.blake2b(json.dumps(key).encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big") >> 1


def trial_seed(study: Study, level: str, trial: int) -> int:
    """Seed of everything random in a trial, the same for all methods."""
    return derived_seed(study.seed, level, trial)


@dataclass(frozen=True)
class TrialData:
    """The data of a trial.

    Parameters
    ----------
    clean_log : the flight without noise
    log : the same with the study's noise; methods receive this log and the model
    pseudo_true : pseudo-true parameters of the flight by name; empty in a study that does not evaluate parameters
    """

    clean_log: Log
    log: Log
    pseudo_true: Mapping[str, float]


def trial_data(study: Study | Mapping[str, Any] | str | Path, level: str | float, trial: int = 0) -> TrialData:
    """The data of one trial, as `run_study` passes them to every method.

    Parameters
    ----------
    study : a built-in study's name, a TOML file, its tables, or a `Study`
    level : of the study
    trial : from 0, whatever number of trials the study asks for

    Raises
    ------
    SettingsError
        There is no such study or level, or the trial is not a whole number from 0.
    DiransacError
        The trial has no data: there is no plan, or the flight diverged. Unexpected errors are raised as they are.
    """
    known = load(study)
    (text,) = known.axis.subset([str(level)]).levels
    check_whole("trial", trial, least=0)
    (found,) = trial_data_batch(known.at(text), text, [trial])
    if isinstance(found, Exception):
        raise found
    return found


def trial_data_batch(study: Study, level: str, trials: Sequence[int]) -> list[TrialData | Exception]:
    """The data of each trial at a level, or the error that prevented them."""
    seeds = [trial_seed(study, level, trial) for trial in trials]
    found: list[TrialData | Exception] = []
    with single_threaded():  # the same sums within a study's run and outside
        for seed, flight in zip(seeds, _flights(study, seeds), strict=True):
            try:
                found.append(_corrupted(study, flight, seed))
            except Exception as error:  # noqa: BLE001  the rows of the trial say what it was
                found.append(error)
    return found


def _flights(study: Study, seeds: Sequence[int]) -> list[Log | Exception]:
    """The recorded flight of each trial, or its error; all trials share one where nothing is drawn."""
    data, plant = study.data, study.plant.plant
    different = seeds if data.is_drawn or study.plant.is_drawn else seeds[:1]
    key = json.dumps(study.plant.to_dict()), json.dumps(data.to_dict()), json.dumps(study.control.to_dict())
    steering = [_steering(*key, derived_seed(seed, "data plan") if data.is_drawn else 0) for seed in different]
    steered = {k: one for k, one in enumerate(steering) if isinstance(one, Controller)}
    drawn = [derived_seed(different[k], "data flight") for k in steered]
    logs = iter(flown(plant, list(steered.values()), drawn, data.substeps))
    found = [one if isinstance(one, Exception) else next(logs) for one in steering]
    return found if len(found) == len(seeds) else found * len(seeds)


@lru_cache(maxsize=64)
def _steering(plant: str, data: str, control: str, seed: int) -> Controller | Exception:
    """The controller of the recorded flight, or its error; trials and levels with the same plan share it."""
    known, flight = PlantChoice.from_dict(json.loads(plant)).plant, FlightChoice.from_dict(json.loads(data))
    steering = ControlChoice.from_dict(json.loads(control))
    try:
        plan = flight.planned(known, seed, time_limit=PLANNING_TIME_LIMIT)
        return steering.limited(tvlqr(known, plan, **steering.weights))
    except Exception as error:  # noqa: BLE001  the rows of every trial that needs it say what it was
        return error


def flown(
    plant: Plant, controllers: Sequence[Controller], seeds: Sequence[int], least_substeps: int | None = None
) -> list[Log | Exception]:
    """The flight of each controller, or its error; flights of one length are lanes of one simulation.

    Parameters
    ----------
    plant : that flies
    controllers, seeds : one per flight
    least_substeps : integration steps per sample, at least; None: as many as the plant requires
    """
    groups = defaultdict(list)
    for k, controller in enumerate(controllers):
        groups[len(controller)].append(k)
    logs: dict[int, Log | Exception] = {}
    for some in groups.values():
        steering, drawn = [controllers[k] for k in some], [seeds[k] for k in some]
        substeps = max(least_substeps, plant.substeps(steering[0].dt)) if least_substeps else None
        fly = partial(_lanes, plant, substeps)
        logs |= zip(some, together(fly, steering, drawn), strict=True)
    return [logs[k] for k in range(len(controllers))]


def _lanes(
    plant: Plant, substeps: int | None, controllers: Sequence[Controller], seeds: Sequence[int]
) -> Sequence[Log]:
    """Flights of one length in one simulation."""
    return fly_batch([plant] * len(controllers), controllers, substeps=substeps, seeds=seeds, threads=1)


def together(compute: Callable[..., Sequence[Any]], *columns: Sequence[Any]) -> Sequence[Any]:
    """Results of all rows in one call, or if it fails, of each row by itself, or its error."""
    try:
        return compute(*columns)
    except Exception as error:  # noqa: BLE001  its row says what it was; other flights go on
        if len(columns[0]) == 1:
            return [error]
        return [together(compute, *([one] for one in row))[0] for row in zip(*columns, strict=True)]


def _corrupted(study: Study, flight: Log | Exception, seed: int) -> TrialData:
    """The data of a flight.  Raises the error of the flight, or why there are no pseudo-true parameters."""
    if isinstance(flight, Exception):
        raise flight
    check_ended(flight)
    plant = study.plant.plant
    log = corrupt(flight, study.noise, derived_seed(seed, "noise"), signals=plant.model.signals)
    return TrialData(flight, log, pseudo_true_parameters(plant, flight) if study.evaluate_parameters else {})


def check_ended(log: Log) -> None:
    """Raises PlanningError: the flight diverged."""
    diverged = [note for note in log.notes if "diverged" in note]
    if diverged:
        raise PlanningError(diverged[0])
