"""How the gauntlet judges: one log, every method, and what came of it.  Nothing happens when this file is run."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gauntlet_methods import METHODS, Estimate
from gauntlet_studies import study_of

import diransac as dr
from diransac.simulation import Measurements, RolloutBatch, rollouts
from diransac.study import Study, trial_data
from diransac.study.assessment import covers, differ, is_disturbed, relative_errors
from diransac.study.data import PLANNING_TIME_LIMIT, derived_seed, trial_data_batch, trial_seed
from diransac.study.specification import MISSIONS

Array = np.ndarray[Any, Any]
ErrorsByName = Mapping[str, float]


@dataclass(frozen=True)
class Trial:
    """One log: of a study's vehicle on one of its flights, at the scenario that is its level, in the trial `seed`."""

    vehicle: str
    flight: str
    scenario: str
    seed: int


@dataclass(frozen=True)
class Record:
    """What one method made of one log.

    Parameters
    ----------
    trial, method : which
    errors : by parameter, relative to the best parameters that the model can reach; empty where there is no estimate
    errors_of_truth : relative to the plant's own parameters
    covered : by parameter, whether its 95 % interval holds the best one; empty without finite intervals
    differs : whether the best parameters are not the plant's own
    tracking, tracking_of_truth : RMS distance from the mission, m, flown by what was identified and by the truth;
        infinite where there is no plan or the flight diverges, NaN where none is flown
    mismatch : whether the plant has more to it than the model
    bound : by parameter, Cramer-Rao's relative standard deviation; empty without Gaussian noise
    seconds : that it took
    refusal : why there is no estimate
    """

    trial: Trial
    method: str
    errors: ErrorsByName
    errors_of_truth: ErrorsByName
    covered: Mapping[str, bool]
    differs: bool
    tracking: float
    tracking_of_truth: float
    mismatch: bool
    bound: ErrorsByName
    seconds: float
    refusal: str = ""

    @property
    def worst(self) -> float:
        """Error of the worst parameter; infinite without an estimate."""
        return max(self.errors.values(), default=np.inf)

    @property
    def worst_of_truth(self) -> float:
        """The same against the plant's own parameters."""
        return max(self.errors_of_truth.values(), default=np.inf)


def run(trial: Trial, methods: Sequence[str], *, fly: bool = True) -> list[Record]:
    """Let every method at the log that the study's trial of that number has."""
    study = study_of(trial.vehicle, trial.flight)
    at = study.at(trial.scenario)
    plant, data = at.plant.plant, trial_data(study, trial.scenario, trial.seed)
    bound = cramer_rao(*_as_the_model_says(study, trial), at.noise) if _is_gaussian(at.noise) else {}
    differs = any(differ(x, plant.parameters[name]) for name, x in data.pseudo_true.items())
    of_truth = _flown(at, trial, plant.parameters) if fly else np.nan
    records = []
    for method in methods:
        estimate, seconds, refusal = _estimated(method, plant.model, data.log)
        found = estimate.parameters if estimate else {}
        flown = (_flown(at, trial, found) if fly else np.nan), of_truth
        records.append(
            Record(
                trial, method, relative(found, data.pseudo_true), relative(found, plant.parameters),
                _covered(estimate, data.pseudo_true), differs, *flown, is_disturbed(plant), bound, seconds, refusal,
            )
        )  # fmt: skip
    return records


def _estimated(method: str, model: dr.Model, log: dr.Log) -> tuple[Estimate | None, float, str]:
    start = time.perf_counter()
    try:
        estimate, refusal = METHODS[method](model, log), ""
    except (dr.DiransacError, ValueError, np.linalg.LinAlgError) as error:
        estimate, refusal = None, str(error)
    except Exception as error:
        error.add_note(f"method {method}, {log.source}, {', '.join(log.notes)}")
        raise
    return estimate, time.perf_counter() - start, refusal


def relative(found: ErrorsByName, reference: ErrorsByName) -> dict[str, float]:
    """``|found / reference - 1|`` by name, of what is not 0."""
    errors = {name: float(relative_errors(x, reference[name])) for name, x in found.items()}
    return {name: error for name, error in errors.items() if not np.isnan(error)}


def _covered(estimate: Estimate | None, best: ErrorsByName) -> dict[str, bool]:
    """Whether each finite interval holds the best parameter."""
    intervals = (estimate.intervals or {}) if estimate else {}
    holds = {name: float(covers(low, high, best[name])) for name, (low, high) in intervals.items()}
    return {name: bool(one) for name, one in holds.items() if not np.isnan(one)}


def tracking(mission: str, plant: dr.Plant, parameters: ErrorsByName, seed: int) -> float:
    """RMS distance (m) from the mission that a model with these parameters plans, steers and flies on the plant."""
    if not parameters:
        return np.inf
    try:
        known = dr.Plant(plant.model, parameters)
        trajectory = MISSIONS[mission](known, time_limit=PLANNING_TIME_LIMIT)
        log = dr.fly(plant, trajectory, dr.tvlqr(known, trajectory), seed=seed)
    except dr.DiransacError:
        return np.inf
    errors = dr.tracking_error(trajectory, log)
    return float(np.hypot(errors["x"], errors["z"]))


def _flown(at: Study, trial: Trial, parameters: ErrorsByName) -> float:
    """`tracking` of the mission as the study flies it in this trial; NaN where it flies none."""
    if not at.evaluation.trajectories:
        return np.nan
    mission, seed = at.evaluation.trajectories[0], trial_seed(at, trial.scenario, trial.seed)
    return tracking(mission, at.plant.plant, parameters, derived_seed(seed, mission))


def _is_gaussian(noise: dr.Noise) -> bool:
    """Whether there is Gaussian noise on everything that is measured, so that Cramer-Rao's bound is above zero."""
    return noise.acceleration_std > 0.0 and noise.rate_std > 0.0


def _as_the_model_says(study: Study, trial: Trial) -> tuple[dr.Plant, dr.Log]:
    """The plant without what the model does not know, and its log of the same flight."""
    calm = study.at(trial.scenario).model_copy(update={"plant": study.plant})
    (found,) = trial_data_batch(calm, trial.scenario, [trial.seed])
    if isinstance(found, dr.DiransacError):
        raise found
    return calm.plant.plant, found.clean_log


def cramer_rao(plant: dr.Plant, clean: dr.Log, noise: dr.Noise) -> dict[str, float]:
    """Relative standard deviation of each parameter that no unbiased estimate from the whole log beats.

    Unknown are the parameters and the initial state; known is which samples are faulty, and those tell nothing. Each
    signal's Gaussian noise is as `dr.corrupt` makes it, measured on the others.
    """
    model, p = plant.model, np.array(list(plant.parameters.values()))
    noisy = dr.corrupt(clean, noise, seed=0, signals=model.signals)
    measured = np.column_stack([clean[name] for name in model.signals])
    inputs = np.column_stack([clean[name] for name in model.inputs])
    weights = np.column_stack(
        [_weights(noisy[n] - clean[n], noisy.fault_mask[n], np.std(clean[n])) for n in model.signals]
    )
    sums = rollouts(model, substeps=4).gauss_newton(
        RolloutBatch(p[None], measured[0, : len(model.state)], inputs, clean.dt),
        Measurements(measured, np.ones(len(clean), bool)),
        weights,
    )
    N = sums.normal_matrix[0]
    scale = 1.0 / np.sqrt(np.diag(N))
    covariance = np.linalg.pinv(N * np.outer(scale, scale)) * np.outer(scale, scale)
    return dict(zip(model.parameters, (np.sqrt(np.diag(covariance))[: model.n_p] / np.abs(p)).tolist(), strict=True))


def _weights(errors: Array, faulty: Array, spread: float) -> Array:
    """One over the variance (N,) of samples without fault; a signal without noise is good to a billionth."""
    return np.where(faulty, 0.0, 1.0 / max(np.std(errors[~faulty]), 1e-9 * spread) ** 2)
