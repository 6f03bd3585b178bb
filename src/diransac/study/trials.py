"""`run_study`; trials of one level: data, identification, and evaluation by planned, controlled, simulated flights.

Flights of many trials are lanes of one simulation, their controllers columns of one sweep. Neither changes a bit of any
of them, and each plan starts from the same guess, so that the rows of a trial do not depend on other trials.
"""

from __future__ import annotations

import io
import json
import platform
import time
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from importlib.metadata import version
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from diransac.data.log import Log
from diransac.errors import DiransacError, PlanningError, StudyError
from diransac.flight.closed_loop import tracking_error
from diransac.flight.trajectory import Trajectory
from diransac.flight.tvlqr import Controller, tvlqr_batch
from diransac.identification.identify import Identification
from diransac.model.plant import Plant
from diransac.process import single_threaded
from diransac.study.data import (
    PLANNING_TIME_LIMIT,
    TrialData,
    check_ended,
    derived_seed,
    flown,
    together,
    trial_data_batch,
    trial_seed,
)
from diransac.study.engine import Progress, run_work
from diransac.study.library import load
from diransac.study.method_choice import TRUE
from diransac.study.reading import Status, status
from diransac.study.specification import ControlChoice, Study, planned_path
from diransac.study.store import Key

STAGES = ("record", "identify", "plan", "steer", "fly")
"""Stages that `seconds` is divided by."""


def run_study(
    spec: Study | Mapping[str, Any] | str | Path,
    *,
    store: str | Path,
    executor: Executor | None = None,
    jobs: int | None = None,
    trials: int | None = None,
    levels: Sequence[str | float] | None = None,
    methods: Sequence[str] | None = None,
    batch_size: int = 4,
    tasks: int | None = None,
    time_limit: float | None = None,
    progress: Progress | None = None,
) -> Status:
    """Run the rows of a study that a store lacks; a row is a level, trial and method.

    Parameters
    ----------
    spec : name of a built-in study, a TOML file, its tables, or a `Study`
    store : SQLite file; made if it does not exist
    executor : runs the trials; any executor of `concurrent.futures`, or one with its interface (Dask's
        ``client.get_executor()``). None: processes of this machine, for which a script needs ``if __name__ ==
        "__main__":``
    jobs : number of these processes; None: one per core
    trials, levels, methods : number of trials, levels, and labels of methods; None: those of the study
    batch_size : trials of a level that are run together
    tasks : batches handed out at a time; None: two per process, 64 to an executor
    time_limit : time after which the run ends, s; rows that are done are kept, and the same call runs the others
    progress : called with (rows present, rows asked for) at the start and whenever rows are added

    Returns
    -------
    Status
        The number of rows done, failed and missing.

    Raises
    ------
    SettingsError
        An argument or the study has no meaning.
    StudyError
        The store has another configuration, workers are lost repeatedly, or one lacks the file of the study's plant.
    KeyboardInterrupt
        Rows that were done are kept.

    Notes
    -----
    Trial k of a level depends on (seed, level, k) alone: rows do not depend on the executor, the order, or which other
    rows are run. Rows are committed as batches finish; after a process is killed, the same call runs the others.
    Several processes may share a store. A trial that fails is a row with its error.
    """
    study = load(spec).subset(trials, levels, methods)
    run_work(
        study,
        partial(run_trials, json.dumps(study.to_dict())),
        store=store,
        executor=executor,
        jobs=jobs,
        batch_size=batch_size,
        tasks=tasks,
        time_limit=time_limit,
        progress=progress,
    )
    return status(store)


# Worker --------------------------------------------------------------------------------------------------------------
def run_trials(study: str, keys: Sequence[Key]) -> list[dict[str, Any]]:
    """Rows by column of the store, the same whatever the other keys.

    Values are plain, so that rows may come from another process or machine; None is not known. A trial that fails is a
    row with the error.

    Parameters
    ----------
    study : the JSON of `Study.to_dict`
    keys : level, trial and method of each row, of one level

    Raises
    ------
    StudyError
        This machine cannot run the study at all, such as without the file of its plant.
    """
    try:
        point = _point(study, keys[0][0])
    except DiransacError as error:
        raise StudyError(f"a worker on {platform.node()} cannot run the study: {error}") from error
    cases = [_Case(point, trial, label) for _, trial, label in keys]
    with single_threaded():  # all cores run trials
        point.record(cases)
        for _, of_log in groupby(cases, key=lambda x: None if x.log is None else x.log.fingerprint):
            _identify(list(of_log))
        for shape in point.study.evaluation.trajectories:
            _evaluate(point, [case for case in cases if case.found], shape)
    return [case.row() for case in cases]


# A level and its cases -----------------------------------------------------------------------------------------------
@lru_cache(maxsize=8)
def _point(study: str, level: str) -> _Point:
    return _Point(_study(study).at(level), level)


@lru_cache(maxsize=1)
def _study(text: str) -> Study:
    """The study of a JSON text; reading it checks every level."""
    return load(json.loads(text))


class _Point:
    """A study at one level."""

    def __init__(self, study: Study, level: str) -> None:
        self.study, self.level = study, level

    @property
    def plant(self) -> Plant:
        """The plant that flies."""
        return self.study.plant.plant

    def record(self, cases: Sequence[_Case]) -> None:
        """Give each case the data of its trial."""
        by_trial: dict[int, list[_Case]] = defaultdict(list)
        for case in cases:
            by_trial[case.trial].append(case)
        with _timed(cases, "record"):
            found = trial_data_batch(self.study, self.level, list(by_trial))
            for some, data in zip(by_trial.values(), found, strict=True):
                for case in some:
                    case.receive(data)


@contextmanager
def _timed(cases: Collection[_Case], stage: str) -> Iterator[None]:
    """Divide the time of the block equally among cases."""
    begin = time.perf_counter()
    yield
    for case in cases:
        case.seconds[stage] += (time.perf_counter() - begin) / len(cases)


@dataclass(eq=False)
class _Case:
    """One method in one trial."""

    point: _Point
    trial: int
    label: str
    log: Log | None = None
    found: Plant | None = None
    figures: dict[str, Any] = field(default_factory=dict)
    paths: dict[str, Any] = field(default_factory=dict)
    errors: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STAGES, 0.0))

    @cached_property
    def seed(self) -> int:
        """Seed of everything random in the trial, the same for all methods."""
        return trial_seed(self.point.study, self.point.level, self.trial)

    @contextmanager
    def attempt(self, stage: str) -> Iterator[None]:
        """Add the time of the block to a stage, and its error to the row; other cases go on."""
        with _timed([self], stage):
            try:
                yield
            except Exception as error:  # noqa: BLE001  one failed trial must not end a long study; its row says it
                self.fail(error)

    def fail(self, error: Exception) -> None:
        """Add an error to the row."""
        known = isinstance(error, DiransacError)
        self.errors.append(str(error) if known else f"internal error: {type(error).__name__}: {error}")

    def receive(self, data: TrialData | Exception) -> None:
        """Take the trial's data, or the error that prevented them."""
        if isinstance(data, Exception):
            self.fail(data)
        else:
            self.log = data.log
            self.figures |= {f"pseudo_true_{name}": value for name, value in data.pseudo_true.items()}

    def identify(self, identification: Identification) -> None:
        """Identify parameters from the log.  Raises DiransacError: there is no estimate."""
        plant, method = self.point.plant, self.point.study.methods[self.label]
        if method.method == TRUE:
            self.found = Plant(plant.model, plant.parameters)
        else:
            seed = derived_seed(self.seed, "identify")
            result = identification.by(method.object(), seed)
            self.found = Plant(plant.model, result.parameters)
            # Level of the intervals that are kept where parameters are evaluated.
            self.figures |= _ends(result.intervals(0.95)) if self.point.study.evaluate_parameters else {}
            self.figures |= {
                "fit_error": result.fit_error,
                "inlier_fraction": result.inlier_fraction,
                "iterations": result.iterations,
                "stop_reason": result.stop_reason,
            }
        self.figures |= {f"parameter_{name}": value for name, value in self.found.parameters.items()}

    def assess(self, shape: str, trajectory: Trajectory, log: Log | Exception) -> None:
        """Add the tracking error of a flight to the row.  Raises PlanningError: it diverged; or the flight's error."""
        if isinstance(log, Exception):
            raise log
        try:
            check_ended(log)
        except PlanningError as error:
            raise PlanningError(f"{shape}: {error}") from error
        self.figures |= {f"{shape}_{name}": error for name, error in tracking_error(trajectory, log).items()}
        if self.point.study.evaluation.keep_paths:
            names = list(self.point.plant.model.coordinates)
            self.paths[shape] = np.column_stack([log[name] for name in names])
            self.paths[planned_path(shape)] = trajectory.columns(names)

    def row(self) -> dict[str, Any]:
        """The row of the case, by column of the store."""
        return {
            "level": self.point.level,
            "trial": self.trial,
            "method": self.label,
            "status": "failed" if self.errors else "done",
            "error": "; ".join(self.errors) or None,
            "seed": self.seed,
            **{name: _plain(value) for name, value in self.figures.items()},
            "paths": _packed(self.paths) if self.paths else None,
            "versions": versions(),
            "seconds": dict(self.seconds),
            "host": platform.node(),
        }


def _identify(cases: Sequence[_Case]) -> None:
    """Identify parameters from the log that all cases have, and share what depends on neither method nor seed."""
    log = cases[0].log
    if log is None:
        return
    identification = Identification(cases[0].point.plant.model, log)
    for case in cases:
        with case.attempt("identify"):
            case.identify(identification)


# Evaluation ----------------------------------------------------------------------------------------------------------
def _evaluate(point: _Point, cases: Sequence[_Case], shape: str) -> None:
    """Plan a trajectory with the parameters of each case, and fly it on the plant under feedback."""
    plans = _plans(cases, shape)
    controllers = _controllers(plans, point.study.control)
    with _timed(controllers, "fly"):
        seeds = [derived_seed(case.seed, shape) for case in controllers]
        logs = flown(point.plant, list(controllers.values()), seeds)
    for case, log in zip(controllers, logs, strict=True):
        with case.attempt("fly"):
            case.assess(shape, plans[case], log)


def _plans(cases: Sequence[_Case], shape: str) -> dict[_Case, Trajectory]:
    """Trajectory of each case that has a plan."""
    plans = {}
    for case in cases:
        assert case.found is not None
        with case.attempt("plan"):
            plan = _planned(case.point, shape, _to_plan_with(case.found, case.point.plant))
            if isinstance(plan, DiransacError):
                raise PlanningError(f"{shape}: {plan}")
            plans[case] = plan
    return plans


def _to_plan_with(found: Plant, plant: Plant) -> tuple[float, ...]:
    """Parameters of a case in the model's order; the plant's own where the difference is rounding.

    Without noise most estimates are exact but for rounding, each in its own way, and then their plans are, too.
    """
    estimates, own = (tuple(one.parameters[name] for name in plant.model.parameters) for one in (found, plant))
    # Relative difference of parameters below which they have the same plan, to about 1e-12 in states and inputs.
    return own if np.allclose(estimates, own, rtol=1e-10, atol=0.0) else estimates


@lru_cache(maxsize=64)
def _planned(point: _Point, shape: str, parameters: tuple[float, ...]) -> Trajectory | DiransacError:
    """The plan for these parameters from the planner's own first guess, or its error.

    Plans are shared: the plant's own parameters are the same in every trial, and so are estimates from equal logs.
    """
    model = point.plant.model
    plant = Plant(model, dict(zip(model.parameters, parameters, strict=True)))
    try:
        return point.study.missions.planned(shape, plant, time_limit=PLANNING_TIME_LIMIT)
    except DiransacError as error:
        return error


def _controllers(plans: Mapping[_Case, Trajectory], control: ControlChoice) -> dict[_Case, Controller]:
    """Controller of each case that has one."""
    with _timed(plans, "steer"):
        steer = partial(tvlqr_batch, **control.weights, threads=1)
        steering = together(steer, [case.found for case in plans], list(plans.values()))
    found = {}
    for case, one in zip(plans, steering, strict=True):
        if isinstance(one, Exception):
            case.fail(one)
        else:
            found[case] = control.limited(one)
    return found


# Values of a row ----------------------------------------------------------------------------------------------------
def _ends(intervals: Mapping[str, tuple[float, float]]) -> dict[str, float]:
    """Columns of the intervals with two finite ends."""
    found: dict[str, float] = {}
    for name, (low, high) in intervals.items():
        if np.isfinite([low, high]).all():
            found |= {f"low_{name}": low, f"high_{name}": high}
    return found


def _plain(value: Any) -> float | int | str | None:
    """A number or text; None for NaN."""
    if isinstance(value, str | int):
        return value
    return None if np.isnan(value) else float(value)


def _packed(paths: dict[str, Any]) -> bytes:
    """Paths by flight, (K, n_q) in single precision: the bytes of an .npz file."""
    memory = io.BytesIO()
    np.savez_compressed(memory, **{name: path.astype(np.float32) for name, path in paths.items()})
    return memory.getvalue()


@lru_cache(maxsize=1)
def versions() -> str:
    """Versions of Python and of the packages that results depend on."""
    packages = ("diransac", "casadi", "llvmlite", "numpy", "scipy")
    return " ".join([f"python {platform.python_version()}", *(f"{name} {version(name)}" for name in packages)])
