"""The data of a trial: what is flown, what a recorder makes of it, and what can be made of the flight at best."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from diransac.blas import single_threaded
from diransac.data.log import Log
from diransac.errors import PlanningError
from diransac.flight.closed_loop import fly_batch
from diransac.flight.corruption import corrupt
from diransac.flight.tvlqr import Controller, tvlqr
from diransac.model.plant import Plant
from diransac.study.flights import Flight
from diransac.study.judging import best_parameters
from diransac.study.library import load
from diransac.study.plants import PlantChoice
from diransac.study.seeds import derived_seed
from diransac.study.specification import Study
from diransac.study.tables import Reader

__all__ = ["PATIENCE", "Recording", "check_ended", "flown", "record", "record_all", "trial_seed"]

PATIENCE = 600.0
"""s that a plan may take: so many that a solver's limit of iterations ends it first, however slow a machine is."""


@dataclass(frozen=True)
class Recording:
    """What the methods of a trial are given, and what is known about it.

    Parameters
    ----------
    flight : the log as a perfect recorder writes it
    log : the same with the study's noise: all that a method is given, beside the model
    best : the best parameters that the model can reach in that flight, by name; empty where a study does not judge by
        them
    """

    flight: Log
    log: Log
    best: Mapping[str, float]


def record(study: Study | Mapping[str, Any] | str | Path, level: str | float, trial: int = 0) -> Recording:
    """The data of one trial, as `run_study` gives them to every method: to look at, or to try a method of one's own on.

    Parameters
    ----------
    study : what `load` takes: a built-in study's name, a TOML file, its tables
    level, trial : which; trials count from 0, and any number is one, whatever the study asks for

    Raises SettingsError: there is no such study or level, or the trial is no whole number from 0.
    Raises DiransacError: the trial has no data; it says why. An error that nobody foresaw is raised as it is.
    """
    known = load(study)
    (point,) = known.axis.narrowed([str(level)]).levels
    number = Reader({"trial": trial}).whole("trial", 0)
    (found,) = record_all(known.at(point.text), point.text, [number])
    if isinstance(found, Exception):
        raise found
    return found


def record_all(study: Study, level: str, trials: Sequence[int]) -> list[Recording | Exception]:
    """The data of each trial at a level, or why there are none.

    Parameters
    ----------
    study : as it is at that level
    level : its text
    """
    seeds = [trial_seed(study, level, trial) for trial in trials]
    found: list[Recording | Exception] = []
    with single_threaded():  # in or out of a study's run, the same sums
        for seed, flight in zip(seeds, _flights(study, seeds), strict=True):
            try:
                found.append(_recording(study, flight, seed))
            except Exception as error:  # noqa: BLE001  its rows say what it was
                found.append(error)
    return found


def trial_seed(study: Study, level: str, trial: int) -> int:
    """Of all that is random in a trial, whatever the method."""
    return derived_seed(study.seed, level, trial)


def _flights(study: Study, seeds: Sequence[int]) -> list[Log | Exception]:
    """The flight that is recorded in each trial, or why there is none; one serves all where nothing is drawn."""
    data, plant = study.data, study.plant.plant
    different = seeds if data.is_drawn or study.plant.is_drawn else seeds[:1]
    key = json.dumps(study.plant.to_dict()), json.dumps(data.to_dict())
    steering = [_steering(*key, derived_seed(seed, "data plan") if data.is_drawn else 0) for seed in different]
    steered = {k: one for k, one in enumerate(steering) if isinstance(one, Controller)}
    drawn = [derived_seed(different[k], "data flight") for k in steered]
    logs = iter(flown(plant, list(steered.values()), drawn, data.substeps))
    found = [one if isinstance(one, Exception) else next(logs) for one in steering]
    return found if len(found) == len(seeds) else found * len(seeds)


@lru_cache(maxsize=64)
def _steering(plant: str, data: str, seed: int) -> Controller | Exception:
    """What steers the flight that is recorded, or why there is none; trials and levels with the same plan share it."""
    known, flight = PlantChoice.from_dict(json.loads(plant)).plant, Flight.from_dict(json.loads(data))
    try:
        return tvlqr(known, flight.planned(known, seed, time_limit=PATIENCE))
    except Exception as error:  # noqa: BLE001  rows of every trial that needs it say what it was
        return error


def flown(
    plant: Plant, controllers: Sequence[Controller], seeds: Sequence[int], least_substeps: int | None = None
) -> list[Log | Exception]:
    """A flight by each controller, or why there is none; those of one length are lanes of one simulation.

    Parameters
    ----------
    seeds : of each flight
    least_substeps : from row to row; None: as many as the plant asks for
    """
    groups = defaultdict(list)
    for k, controller in enumerate(controllers):
        groups[len(controller)].append(k)
    logs: dict[int, Log | Exception] = {}
    for some in groups.values():
        steering, drawn = [controllers[k] for k in some], [seeds[k] for k in some]
        substeps = max(least_substeps, plant.substeps(steering[0].dt)) if least_substeps else None
        logs |= zip(some, _lanes(plant, steering, drawn, substeps), strict=True)
    return [logs[k] for k in range(len(controllers))]


def _lanes(
    plant: Plant, controllers: Sequence[Controller], seeds: Sequence[int], substeps: int | None
) -> Sequence[Log | Exception]:
    """Flights of one length: all in one simulation, or each on its own where one of them cannot be."""
    try:
        return fly_batch([plant] * len(controllers), controllers, substeps=substeps, seeds=seeds, threads=1)
    except Exception as error:  # noqa: BLE001  its row says what it was, and it ends no other flight
        if len(controllers) == 1:
            return [error]
        return [_lanes(plant, [one], [seed], substeps)[0] for one, seed in zip(controllers, seeds, strict=True)]


def _recording(study: Study, flight: Log | Exception, seed: int) -> Recording:
    """The recording of a flight.  Raises whatever there is no flight for, or why nothing can be made of it."""
    if isinstance(flight, Exception):
        raise flight
    check_ended(flight)
    plant = study.plant.plant
    log = corrupt(flight, study.noise, derived_seed(seed, "noise"), signals=plant.model.signals)
    return Recording(flight, log, best_parameters(plant, flight) if study.judges_parameters else {})


def check_ended(log: Log) -> None:
    """Raises PlanningError: the flight diverged."""
    diverged = [note for note in log.notes if "diverged" in note]
    if diverged:
        raise PlanningError(diverged[0])
