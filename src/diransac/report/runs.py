"""A result beside the log it is to be looked at with: simulated, compared, scored."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from diransac.arrays import BoolArray, FloatArray
from diransac.data import preprocessing
from diransac.data.dataset import Observations, observe
from diransac.data.log import Log
from diransac.errors import LogError, ResultError, SettingsError
from diransac.identification.diagnosis import Diagnosis
from diransac.identification.evaluation import as_diagnosed, choose_scoring, judged_signals
from diransac.identification.result import Result
from diransac.identification.settings import Settings
from diransac.identification.validation import Validation, validate
from diransac.simulation import Measurements, RolloutBatch, Rollouts, inlier_mask, rollouts

__all__ = ["Run", "bulk", "diagnosis_of", "labelled", "simulate_on"]


_MET = 0.5
_N_RESTARTS = 12
_MEDIAN = 0.6745  # of the absolute value of Gaussian noise, in standard deviations


@dataclass(frozen=True)
class Run:
    """One result simulated over one log.

    Parameters
    ----------
    label : how the page calls it
    held_out : whether the log is another one than the result was made from
    observations : the model over the log, ``N`` rows
    first : row of the log that is row 0 here
    diagnosis : what is known of this log, by whichever result of the page found it; None if none did
    period : s after which the shown simulation begins anew, where the machine most probably was; infinite: never
    simulated : (N, n_s)   the observations' signals, NaN from a divergence on
    errors : (N, n_s)   simulated less measured, NaN where either is missing
    throughout : (N, n_s)   simulated through the whole log from its first row, which decides on inliers
    accelerations : acceleration -> (N,)   simulated, measured or not
    thresholds : (n_s,)   an error is near below it; 0 where the signal judges nothing
    inliers : (N,)   rows that agree with the simulation
    validation : open-loop scores at several horizons, or why there are none
    """

    label: str
    result: Result
    held_out: bool
    observations: Observations
    first: int
    diagnosis: Diagnosis | None
    period: float
    simulated: FloatArray
    errors: FloatArray
    throughout: FloatArray
    accelerations: Mapping[str, FloatArray]
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

    def tells(self, name: str) -> bool:
        """Whether the result has a parameter, and its log could tell it."""
        diagnosis = self.result.diagnosis
        return name in self.result.parameters and (diagnosis is None or name not in diagnosis.unidentifiable)

    @property
    def divergence(self) -> float | None:
        """Log time at which the simulation becomes infinite, s; None if it stays finite."""
        lost = ~np.isfinite(self.simulated).all(axis=1)
        return float(self.observations.log.time[self.observations.offset + np.argmax(lost)]) if lost.any() else None

    @cached_property
    def faults(self) -> dict[str, BoolArray]:
        """Samples (N,) of each signal that are known to be outliers."""
        known = {} if self.diagnosis is None else self.diagnosis.outliers
        none = np.zeros(len(self.observations), dtype=bool)
        return {n: known[n][self.rows] if n in known else none for n in self.observations.signals}

    @cached_property
    def sound_errors(self) -> dict[str, FloatArray]:
        """Absolute errors of each signal, but for faults, in rows that count; infinite after a divergence."""
        error = np.where(np.isnan(self.simulated), np.inf, np.abs(self.errors))
        columns = zip(self.faults.items(), error.T, strict=True)
        return {n: x[self.observations.valid & ~faults & ~np.isnan(x)] for (n, faults), x in columns}

    @cached_property
    def typical_errors(self) -> dict[str, float]:
        """Median of those of each signal, in its unit; NaN of none."""
        return {n: float(np.median(x)) if len(x) else np.nan for n, x in self.sound_errors.items()}

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
        """Typical errors of the signals that judge, less what noise makes if it is known, over the signal's range."""
        widths = {n: high - low for n, (low, high) in self.ranges.items()}
        judging = [n for n, x in zip(self.observations.signals, self.thresholds, strict=True) if x > 0.0]
        noise = {} if self.diagnosis is None else self.diagnosis.noise_std
        excess = {n: max(0.0, self.typical_errors[n] - _MEDIAN * noise.get(n, 0.0)) for n in judging}
        return {n: excess[n] / widths[n] for n in judging if widths[n] > 0.0}

    @property
    def unexplained(self) -> dict[str, float]:
        """RMS of what the model does not explain of each acceleration, over the RMS of what it does; {} if unknown."""
        if self.result.diagnosis is None or self.held_out:
            return {}
        latent = {n: _rms(x) for n, x in self.result.diagnosis.unmodelled_accelerations.items()}
        explained = {n: _rms(x[np.isfinite(x)]) for n, x in self.accelerations.items()}
        return {n: x / explained[n] for n, x in latent.items() if explained[n] > 0.0}


def bulk(values: FloatArray) -> tuple[float, float]:
    """Lowest and highest of the values that are no further from the central 80 % than its width; (0, 0) of none."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, 0.0
    low, high = np.quantile(finite, [0.1, 0.9])
    width = high - low
    kept = finite[(finite >= low - width) & (finite <= high + width)]
    return float(kept.min()), float(kept.max())


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0


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


def diagnosis_of(results: Mapping[str, Result], log: Log) -> Diagnosis | None:
    """The first diagnosis of this log among the results; it is the log's and the machine's, not a method's."""
    own = (result.diagnosis for result in results.values() if result.log.fingerprint == log.fingerprint)
    return next((diagnosis for diagnosis in own if diagnosis is not None), None)


def simulate_on(label: str, result: Result, log: Log, diagnosis: Diagnosis | None = None) -> Run:
    """The result simulated over the log, which is prepared as its own was.

    Parameters
    ----------
    diagnosis : of this log; with it, simulations begin anew every now and then where the machine most probably was, so
        that what acts on it unknown to the model does not add up

    Raises ResultError: the log cannot be simulated by this model; it says why.
    """
    try:
        return _simulate(label, result, _prepared(result, log), log, diagnosis)
    except (LogError, SettingsError) as error:
        raise ResultError(f'no report: model "{result.model.name}" cannot be simulated on this log: {error}') from error


def _prepared(result: Result, log: Log) -> Log:
    """The log with velocities and accelerations derived, where the result's log was and this one is not."""
    derived = _last_step(result.preparation)
    if derived.get("step") != "differentiate" or _last_step(log.history).get("step") == "differentiate":
        return log
    return preprocessing.differentiate(log, result.model, float(derived["bandwidth"]))


def _last_step(history: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    return history[-1] if history else {}


def _simulate(label: str, result: Result, log: Log, given: Log, diagnosis: Diagnosis | None) -> Run:
    settings, model = result.settings, result.model
    held_out = given.fingerprint != result.log.fingerprint
    observations = _observations(result, log)
    scoring = choose_scoring(observations, settings)
    if result.diagnosis is not None and not held_out:
        observations, settings = as_diagnosed(observations, settings, result.diagnosis)
    engine = rollouts(model, observations.signals, integrator=settings.integrator, substeps=settings.substeps)
    start = observations.initial_state(settings.initial_state)[None]
    first = round(float(log.time[observations.offset] - given.time[0]) / given.dt)
    throughout, errors = _simulated(engine, result, observations, start, len(observations))
    apart = np.where(np.isnan(errors), np.inf, errors)
    near = inlier_mask(apart, observations.valid, scoring.thresholds, scoring.min_inlier_signals)
    simulated, period = throughout, np.inf
    if diagnosis is not None and set(model.state) <= set(diagnosis.smoothed_states):
        states, n_rows = _restarts(diagnosis, observations)
        simulated, errors = _simulated(engine, result, observations, states, n_rows)
        period = n_rows * log.dt
    columns = [model.signals.index(name) for name in observations.signals]
    return Run(
        label=label,
        result=result,
        held_out=held_out,
        observations=observations,
        first=first,
        diagnosis=diagnosis,
        period=period,
        simulated=simulated[:, columns],
        errors=errors,
        throughout=throughout[:, columns],
        accelerations=dict(zip(model.accelerations, simulated[:, len(model.state) :].T, strict=True)),
        thresholds=scoring.thresholds,
        inliers=near if held_out else result.inliers[first : first + len(observations)],
        validation=_validation(result, log, result.settings),
    )


def _restarts(diagnosis: Diagnosis, observations: Observations) -> tuple[FloatArray, int]:
    """States (K, n_x) from which simulations begin anew, and the rows between them."""
    time, names = diagnosis.smoothed_time, observations.model.state
    every = max(1, round(len(time) / _N_RESTARTS))
    dt, start = observations.log.dt, observations.log.time[observations.offset]
    n_rows = max(1, every * round(float(time[1] - time[0]) / dt)) if len(time) > 1 else len(observations)
    at = start + dt * np.arange(0, len(observations), n_rows)
    return np.column_stack([np.interp(at, time, diagnosis.smoothed_states[n]) for n in names]), n_rows


def _simulated(
    engine: Rollouts, result: Result, observations: Observations, states: FloatArray, n_rows: int
) -> tuple[FloatArray, FloatArray]:
    """All signals simulated (N, n), and that less measured (N, n_s), begun in each state for so many rows."""
    model, n = result.model, len(observations)
    more = ((0, len(states) * n_rows - n), (0, 0))
    inputs, measured = (np.pad(x, more, mode="edge") for x in (observations.inputs, observations.measured))
    parameters = np.tile(model.parameter_vector(result.parameters), (len(states), 1))
    rows, dt, every = n_rows * np.arange(len(states)), observations.log.dt, np.ones(len(inputs), dtype=bool)
    batch = RolloutBatch(parameters, states, inputs, dt, start_rows=rows, n_rows=n_rows)
    everything = engine.trajectories(batch)
    errors = engine.errors(batch, Measurements(np.nan_to_num(measured), every))
    missing = ~np.isfinite(observations.measured)
    return everything.reshape(len(inputs), -1)[:n], np.where(missing, np.nan, errors.reshape(len(inputs), -1)[:n])


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
