"""Hypotheses over one log: bounds, simulation, error and inliers, as a search asks for them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.errors import LogError, SettingsError
from diransac.identification.methods.consensus import Score, Variant
from diransac.simulation import Measurements, RolloutBatch, ScoreBatch, default_threads, rollouts

if TYPE_CHECKING:
    from collections.abc import Mapping

    from diransac.data.dataset import Observations
    from diransac.data.log import Log
    from diransac.identification.diagnosis import Diagnosis
    from diransac.identification.settings import Settings
    from diransac.model import Model

__all__ = ["Scoring", "Simulation", "as_diagnosed", "choose_scoring", "judged_signals"]


_THRESHOLD_IN_SPREADS = 0.2
_ACCELERATION_WEIGHT = 0.1


@dataclass(frozen=True)
class Scoring:
    """Which signals judge a simulation: error weights and inlier thresholds ``(n_s,)``, and how many make an inlier."""

    weights: FloatArray
    thresholds: FloatArray
    min_inlier_signals: int
    notes: tuple[str, ...] = ()


def judged_signals(model: Model, log: Log, settings: Settings) -> tuple[str, ...]:
    """Names of the signals that the settings let judge a simulation; by default rates, and coordinates without one."""
    named = {**(settings.error_weights or {}), **(settings.inlier_thresholds or {})}
    chosen = {n for n, x in named.items() if x > 0.0}
    if settings.error_weights is None or settings.inlier_thresholds is None:
        chosen.update(_judged_by_default(model, log))
    return tuple(n for n in model.signals if n in chosen)


def _judged_by_default(model: Model, log: Log) -> tuple[str, ...]:
    rates = [n for n in (*model.velocities, *model.accelerations) if n in log]
    if model.kinematics is not None:
        bare = [] if any(n in log for n in model.velocities) else [q for q in model.coordinates if q in log]
    else:
        pairs = zip(model.coordinates, model.velocities, strict=True)
        bare = [q for q, v in pairs if q in log and v not in log]
    return (*bare, *rates)


def choose_scoring(observations: Observations, settings: Settings) -> Scoring:
    """Weights and thresholds from the settings, or from each signal's spread in the log where they are None.

    Raises SettingsError: they name a signal that is not there, or leave nothing to judge by; LogError: every signal is
    constant.
    """
    by_default = _judged_by_default(observations.model, observations.log)
    scales = {n: observations.scales[n] for n in by_default}
    constant = [n for n, scale in scales.items() if scale == 0.0]
    weights, thresholds = settings.error_weights, settings.inlier_thresholds
    if weights is None or thresholds is None:
        if len(constant) == len(scales):
            raise LogError(f"{observations.log.source}: {', '.join(scales)} are constant; nothing moves in this log")
        moving = {n: scale for n, scale in scales.items() if scale > 0.0}
        slow = observations.model.accelerations
        if weights is None:
            weights = {n: (_ACCELERATION_WEIGHT if n in slow else 1.0) / x for n, x in moving.items()}
        if thresholds is None:
            thresholds = {n: _THRESHOLD_IN_SPREADS * x for n, x in moving.items()}
    w, eps = observations.by_signal(weights), observations.by_signal(thresholds)
    if not (w > 0.0).any():
        raise SettingsError("every error weight is zero; give one signal a positive weight")
    n_signals = int((eps > 0.0).sum())
    needed = settings.min_inlier_signals or max(1, -(-n_signals // 2))
    if needed > n_signals:
        raise SettingsError(
            f"min_inlier_signals = {needed}, but {n_signals} signals have an inlier threshold: nothing can be an inlier"
        )
    judging = ", ".join(n for n, x in zip(observations.signals, eps, strict=True) if x > 0.0)
    notes = [f"{n} is constant and judges nothing" for n in constant]
    notes.append(f"a row is an inlier if {needed} of its {n_signals} judging signals are near: {judging}")
    return Scoring(w, eps, needed, tuple(notes))


def as_diagnosed(observations: Observations, settings: Settings, diagnosis: Diagnosis) -> tuple[Observations, Settings]:
    """The log with its inputs acting as late as they do, and settings that start where the machine was.

    That is the first sample, as by default, but for samples that are missing or outliers.
    """
    if diagnosis.input_delay_significant:
        time = observations.log.dt * np.arange(len(observations))
        columns = [np.interp(time - diagnosis.input_delay, time, column) for column in observations.inputs.T]
        observations = replace(observations, inputs=np.column_stack(columns))
    return observations, replace(settings, initial_state=_start(observations, settings, diagnosis))


def _start(observations: Observations, settings: Settings, diagnosis: Diagnosis) -> str | Mapping[str, float]:
    if settings.initial_state != "first":
        return settings.initial_state
    start = {name: float(motion[0]) for name, motion in diagnosis.smoothed_states.items()}
    for name in start:
        if name in diagnosis.outliers and not diagnosis.outliers[name][observations.offset]:
            first = float(observations.column(name)[0])
            start[name] = first if np.isfinite(first) else start[name]
    return start


class Simulation:
    """Simulates hypotheses of one model over one log and judges them.

    Raises LogError: the initial state is missing.
    """

    def __init__(self, observations: Observations, scoring: Scoring, settings: Settings, variant: Variant) -> None:
        judged = (scoring.weights > 0.0) | (scoring.thresholds > 0.0)
        names = [n for n, j in zip(observations.signals, judged, strict=True) if j]
        self._observations, self._variant, self._scoring = observations, variant, scoring
        self._weights, self._thresholds = scoring.weights[judged], scoring.thresholds[judged]
        self._rollouts = rollouts(observations.model, names, integrator=settings.integrator, substeps=settings.substeps)
        self._start = observations.initial_state(settings.initial_state)
        self._measurements = Measurements(observations.measured[:, judged], observations.valid)
        self._threads = settings.threads or default_threads()
        self._latest: dict[bytes, tuple[ScoreBatch, int]] = {}

    def admits(self, parameters: FloatArray) -> BoolArray:
        """Preliminary test of ``(n, n_p)`` parameters: every one within its bounds."""
        bounds = self._observations.model.parameters.values()
        return np.asarray(np.all([x.admits(parameters[:, i]) for i, x in enumerate(bounds)], axis=0))

    def scores(self, parameters: FloatArray) -> list[Score]:
        """Error and inlier fraction of every hypothesis ``(n, n_p)``."""
        found = self._rollouts.score(
            RolloutBatch(parameters, self._start, self._observations.inputs, self._observations.log.dt),
            self._measurements,
            self._thresholds,
            self._scoring.min_inlier_signals,
            threads=self._threads,
        )
        self._latest = {p.tobytes(): (found, lane) for lane, p in enumerate(parameters)}
        n_rows = self._observations.n_rows
        errors = self._variant.errors(found.sum_squares, n_rows, self._weights)
        fractions = found.inlier_count / n_rows
        return [Score(e, f) for e, f in zip(errors.tolist(), fractions.tolist(), strict=True)]

    def inlier_mask(self, parameters: FloatArray) -> BoolArray:
        """Inliers ``(N,)`` of one hypothesis over all rows; a row that does not count is none (section III.D).

        The latest `scores` found those of its hypotheses on the way; any other is simulated.
        """
        if parameters.tobytes() not in self._latest:
            self.scores(parameters[None])
        found, lane = self._latest[parameters.tobytes()]
        return found.inliers(lane)

    def inliers(self, parameters: FloatArray) -> IntArray:
        """Usable rows that are inliers of one hypothesis ``(n_p,)``, ascending."""
        return np.flatnonzero(self.inlier_mask(parameters)[self._observations.valid])
