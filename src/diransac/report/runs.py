"""A result beside the log it is to be looked at with: simulated, compared, scored."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from diransac import prepare
from diransac.errors import LogError, ResultError, SettingsError
from diransac.evaluation import choose_scoring, judged_signals
from diransac.log import Log
from diransac.observations import Observations, observe
from diransac.result import Result
from diransac.settings import Settings
from diransac.simulate import inlier_mask, rollouts
from diransac.validation import Validation, validate

__all__ = ["Run", "bulk", "labelled", "simulate_on"]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

_MET = 0.5


@dataclass(frozen=True)
class Run:
    """One result simulated over one log.

    Parameters
    ----------
    label : how the page calls it
    held_out : whether the log is another one than the result was made from
    observations : the model over the log, ``N`` rows
    first : row of the log that is row 0 here
    simulated : (N, n_s)   the observations' signals, NaN from a divergence on
    errors : (N, n_s)   simulated less measured, NaN where either is missing
    thresholds : (n_s,)   an error is near below it; 0 where the signal judges nothing
    inliers : (N,)   rows that agree with the simulation
    validation : open-loop scores at several horizons, or why there are none
    """

    label: str
    result: Result
    held_out: bool
    observations: Observations
    first: int
    simulated: FloatArray
    errors: FloatArray
    thresholds: FloatArray
    inliers: BoolArray
    validation: Validation | str

    @property
    def rows(self) -> npt.NDArray[np.int64]:
        """Rows of the log (N,)."""
        return np.arange(self.first, self.first + len(self.observations))

    @property
    def inlier_fraction(self) -> float:
        """Of the rows that count."""
        return float(self.inliers.sum() / self.observations.n_rows)

    @property
    def divergence(self) -> float | None:
        """Log time at which the simulation becomes infinite, s; None if it stays finite."""
        lost = ~np.isfinite(self.simulated).all(axis=1)
        return float(self.observations.log.time[self.observations.offset + np.argmax(lost)]) if lost.any() else None

    @cached_property
    def typical_errors(self) -> dict[str, float]:
        """Median absolute error of each signal over the rows that count, in its unit; infinite after a divergence."""
        error = np.where(np.isnan(self.simulated), np.inf, np.abs(self.errors))[self.observations.valid]
        columns = zip(self.observations.signals, error.T, strict=True)
        return {n: float(np.median(x[~np.isnan(x)])) if (~np.isnan(x)).any() else np.nan for n, x in columns}

    @cached_property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Lowest and highest of each measured signal, of its bulk and of the samples that the simulation meets."""
        found = {}
        for name, measured, error in zip(
            self.observations.signals, self.observations.measured.T, self.errors.T, strict=True
        ):
            low, high = bulk(measured)
            met = measured[np.abs(error) <= _MET * (high - low)]
            found[name] = float(met.min(initial=low)), float(met.max(initial=high))
        return found

    @property
    def relative_errors(self) -> dict[str, float]:
        """Typical errors of the signals that judge, each over the signal's range."""
        widths = {n: high - low for n, (low, high) in self.ranges.items()}
        judging = [n for n, x in zip(self.observations.signals, self.thresholds, strict=True) if x > 0.0]
        return {n: self.typical_errors[n] / widths[n] for n in judging if widths[n] > 0.0}


def bulk(values: FloatArray) -> tuple[float, float]:
    """Lowest and highest of the values that are no further from the central 80 % than its width; (0, 0) of none."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, 0.0
    low, high = np.quantile(finite, [0.1, 0.9])
    width = high - low
    kept = finite[(finite >= low - width) & (finite <= high + width)]
    return float(kept.min()), float(kept.max())


def labelled(results: Result | Sequence[Result] | Mapping[str, Result]) -> dict[str, Result]:
    """The results by a name of their own: their method's, numbered where methods repeat.

    Raises ResultError: there is none, or something else among them.
    """
    if isinstance(results, Mapping):
        pairs: list[tuple[str, object]] = [(str(label), result) for label, result in results.items()]
    else:
        several = results if isinstance(results, list | tuple) else [results]
        pairs = [(getattr(result, "method", ""), result) for result in several]
    named: dict[str, Result] = {}
    for label, result in pairs:
        if not isinstance(result, Result):
            raise ResultError(f"a report shows results of diransac.identify; found a {type(result).__name__}")
        repeats = sum(other.split(" #")[0] == label for other in named)
        named[f"{label} #{repeats + 1}" if repeats else label] = result
    if not named:
        raise ResultError("a report shows results of diransac.identify; found none")
    return named


def simulate_on(label: str, result: Result, log: Log) -> Run:
    """The result simulated over the log, which is prepared as its own was.

    Raises ResultError: the log cannot be simulated by this model; it says why.
    """
    try:
        return _simulate(label, result, _prepared(result, log), log)
    except (LogError, SettingsError) as error:
        raise ResultError(f'no report: model "{result.model.name}" cannot be simulated on this log: {error}') from error


def _prepared(result: Result, log: Log) -> Log:
    """The log with velocities and accelerations derived, where the result's log was and this one is not."""
    derived = _last_step(result.preparation)
    if derived.get("step") != "differentiate" or _last_step(log.history).get("step") == "differentiate":
        return log
    return prepare.differentiate(log, result.model, float(derived["bandwidth"]))


def _last_step(history: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    return history[-1] if history else {}


def _simulate(label: str, result: Result, log: Log, given: Log) -> Run:
    settings, model = result.settings, result.model
    observations = _observations(result, log)
    scoring = choose_scoring(observations, settings)
    engine = rollouts(model, observations.signals, integrator=settings.integrator, substeps=settings.substeps)
    start = observations.initial_state(settings.initial_state)
    parameters = model.parameter_vector(result.parameters)[None]
    everything = engine.trajectories(parameters, start, observations.inputs, log.dt)[0]
    measured, missing = np.nan_to_num(observations.measured), ~np.isfinite(observations.measured)
    all_rows = np.ones(len(observations), dtype=bool)
    errors = engine.errors(parameters, start, observations.inputs, measured, all_rows, log.dt)[0]
    first = round(float(log.time[observations.offset] - given.time[0]) / given.dt)
    held_out = given.fingerprint != result.log.fingerprint
    apart = np.where(missing, np.inf, errors)
    near = inlier_mask(apart, observations.valid, scoring.thresholds, scoring.min_inlier_signals)
    return Run(
        label=label,
        result=result,
        held_out=held_out,
        observations=observations,
        first=first,
        simulated=everything[:, [model.signals.index(n) for n in observations.signals]],
        errors=np.where(missing, np.nan, errors),
        thresholds=scoring.thresholds,
        inliers=near if held_out else result.inliers[first : first + len(observations)],
        validation=_validation(result, log, settings),
    )


def _observations(result: Result, log: Log) -> Observations:
    """As `identify` makes them; from a held-out log that lacks signals, with those that a simulation needs."""
    try:
        return observe(result.model, log, judged_signals(result.model, log, result.settings))
    except LogError:
        return observe(result.model, log, pointwise=False)


def _validation(result: Result, log: Log, settings: Settings) -> Validation | str:
    try:
        return validate(result, log, integrator=settings.integrator, substeps=settings.substeps)
    except (LogError, SettingsError) as error:
        return str(error)
