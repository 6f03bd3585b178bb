"""Simulation of each log by an estimate, row by row, and its agreement with the log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray, runs
from diransac.data.dataset import Dataset
from diransac.data.segment import Segment
from diransac.errors import LogError
from diransac.identification.diagnosis import Diagnosis
from diransac.identification.estimate import Estimate, Evaluation, Prediction
from diransac.identification.evaluation.scoring import Scoring, as_estimated
from diransac.identification.evaluation.simulation import Simulation
from diransac.identification.settings import Settings

# ---------------------------------------------------------------------- simulations


@dataclass(frozen=True, eq=False, repr=False)
class Restarts:
    """States of a log from which its simulation starts: equidistant ones, and those after gaps.

    Parameters
    ----------
    rows : (K,) int array
        Row of each state, ascending.
    states : (K, n_x) array
        States.
    n_rows : int
        Number of rows between two states without a gap.
    """

    rows: IntArray
    states: FloatArray
    n_rows: int


def restart_rows(observations: Segment, n_rows: int, known: IntArray) -> IntArray:
    """Rows from which the simulation of a log restarts.

    Parameters
    ----------
    observations : Segment
    n_rows : int
        Number of rows between two of them without a gap.
    known : (n,) int array
        Rows whose state is known, ascending.

    Returns
    -------
    (K,) int array
        Every ``n_rows``-th row of the log outside of its gaps, and the first one of ``known`` after each gap.
    """
    parts = []
    for x in runs(~observations.gaps):
        after = known[np.searchsorted(known, x.start) :]
        begin = int(after[0]) if x.start and len(after) else x.start
        parts += [np.arange(begin, min(begin + 1, x.stop)), np.arange(begin - begin % -n_rows, x.stop, n_rows)]
    return np.unique(np.concatenate(parts))


def restarts_of(diagnosis: Diagnosis, observations: Segment) -> Restarts | None:
    """About twelve smoothed states of a log, and one after each gap; None where the diagnosis lacks a state."""
    time, names = diagnosis.smoothed_time, observations.model.state
    if not set(names) <= set(diagnosis.smoothed_states):
        return None
    every = max(1, round(len(time) / 12))
    dt, start = observations.log.dt, observations.log.time[observations.offset]
    n_rows = max(1, every * round(float(time[1] - time[0]) / dt)) if len(time) > 1 else len(observations)
    rows = restart_rows(observations, n_rows, np.round((time - start) / dt).astype(int))
    at = start + dt * rows
    return Restarts(rows, np.column_stack([np.interp(at, time, diagnosis.smoothed_states[n]) for n in names]), n_rows)


def simulated_rows(
    simulation: Simulation, log: int, parameters: FloatArray, observations: Segment, restarts: Restarts | None = None
) -> FloatArray:
    """All signals of the model ``(N, n_signals)``, simulated over one log; NaN in gaps.

    Parameters
    ----------
    simulation : Simulation
    log : int
        Index of the log in the simulation's dataset.
    parameters : (n_p,) array
        Parameters of the model in this log.
    observations : Segment
        The log.
    restarts : Restarts, optional
        States to start from; None: the initial state of the log, and those after gaps.

    Raises
    ------
    LogError
        The log lacks its initial state, and no other is given.
    """
    if restarts is None:
        begins = simulation.starts[log]
        rows, states = np.array([x.start for x, _ in begins], int), np.array([state for _, state in begins])
    else:
        rows, states = restarts.rows, restarts.states
    outside = np.flatnonzero(np.append(observations.gaps, True))
    sizes = np.minimum(outside[np.searchsorted(outside, rows)], np.append(rows[1:], len(observations))) - rows
    series = np.full((len(observations), len(observations.model.signals)), np.nan)
    for size in np.unique(sizes).tolist():
        alike = sizes == size
        found = simulation.trajectories(log, parameters, states[alike], rows[alike], size)
        series[rows[alike][:, None] + np.arange(size)] = found
    return series


@dataclass(frozen=True, kw_only=True)
class SimulatedLog:
    """Simulation of one log beside its measured signals.

    Parameters
    ----------
    observations : Segment
        The model over the log, N rows.
    simulated : (N, n_s) array
        The observations' signals as simulated; NaN in gaps, and after a divergence.
    accelerations : mapping of str to (N,) array
        Simulated accelerations, measured or not; NaN in gaps.
    restart_period : float
        Time after which the simulation restarts, s; infinite: never.
    thresholds : (n_s,) array
        Inlier thresholds; 0 for a signal without one.
    inliers : (N,) bool array
        Rows that agree with one simulation of the whole log.
    noise : mapping of str to float
        Standard deviation of the noise of each signal, as far as it is known, its unit.
    outliers : mapping of str to (N,) bool array
        Diagnosed outliers of each of the observations' signals.
    """

    observations: Segment
    simulated: FloatArray
    accelerations: Mapping[str, FloatArray]
    restart_period: float
    thresholds: FloatArray
    inliers: BoolArray
    noise: Mapping[str, float]
    outliers: Mapping[str, BoolArray]

    @cached_property
    def errors(self) -> FloatArray:
        """Simulated less measured signals ``(N, n_s)``, NaN where either is missing."""
        return _nearest_signs(self.simulated, self.observations) - self.observations.measured

    @property
    def inlier_fraction(self) -> float:
        """Inliers over the rows that count."""
        return float(self.inliers.sum() / self.observations.n_rows)

    @property
    def n_excluded(self) -> int:
        """Number of rows in which a required signal is missing, or that no simulation covers."""
        return len(self.observations) - self.observations.n_rows + self.observations.offset

    @cached_property
    def regular_errors(self) -> dict[str, FloatArray]:
        """Absolute errors of each signal over the rows that count, without outliers; infinite after a divergence."""
        return {n: self._absolute_errors(n, ~self.outliers[n]) for n in self.observations.signals}

    def _absolute_errors(self, name: str, rows: BoolArray) -> FloatArray:
        """Absolute errors of a signal in those of some rows that count and are measured."""
        column = self.observations.signals.index(name)
        errors = np.where(np.isnan(self.simulated[:, column]), np.inf, np.abs(self.errors[:, column]))
        return errors[self.observations.valid & rows & np.isfinite(self.observations.measured[:, column])]

    @cached_property
    def median_errors(self) -> dict[str, float]:
        """Median of the regular errors of each signal, in its unit; NaN without samples."""
        return {n: float(np.median(x)) if len(x) else np.nan for n, x in self.regular_errors.items()}

    @cached_property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Range of each measured signal: of its bulk, and of samples close to the simulation."""
        found = {}
        columns = zip(self.observations.measured.T, self.errors.T, self.observations.ranges, strict=True)
        for name, (measured, error, (low, high)) in zip(self.observations.signals, columns, strict=True):
            # Samples close to the simulation belong to the range, too.
            met = measured[np.abs(error) <= 0.5 * (high - low)]
            found[name] = float(met.min(initial=low)), float(met.max(initial=high))
        return found

    def windows(self) -> tuple[IntArray, FloatArray]:
        """Edges ``(n + 1,)`` of up to 40 windows over the rows, and their inlier fractions ``(n,)``."""
        n, valid = len(self.observations), self.observations.valid
        edges = np.unique(np.linspace(0, n, min(40, max(1, n // 25)) + 1).astype(int))
        inliers, counting = (np.add.reduceat(x.astype(float), edges[:-1]) for x in (self.inliers, valid))
        return edges, np.where(counting > 0.0, inliers / np.maximum(counting, 1.0), np.nan)

    def summary(self, diagnosis: Diagnosis | None) -> Prediction:
        """Agreement in figures; the diagnosis of this log has its unmodelled accelerations."""
        edges, fractions = self.windows()
        low = int(np.nanargmin(fractions))
        begin, end = (self._time(0) + self.observations.log.dt * float(x) for x in edges[low : low + 2])
        return Prediction(
            unexplained={} if diagnosis is None else unexplained(diagnosis, self),
            n_rows=self.observations.n_rows,
            n_excluded=self.n_excluded,
            weakest_window=(begin, end, float(fractions[low])),
        )

    def _time(self, row: int) -> float:
        return float(self.observations.log.time[self.observations.offset + row])


def _nearest_signs(simulated: FloatArray, observations: Segment) -> FloatArray:
    """Simulated signals ``(N, n_s)``; a quaternion that is measured whole has the sign that is nearer to it."""
    model, signed = observations.model, simulated
    for four in model.quaternions:
        names = [model.signals[k] for k in four]
        if set(names) <= set(observations.signals):
            columns = [observations.signals.index(n) for n in names]
            nearness = np.nansum(simulated[:, columns] * observations.measured[:, columns], axis=1, keepdims=True)
            signed = signed.copy()
            signed[:, columns] *= np.where(nearness < 0.0, -1.0, 1.0)
    return signed


def unexplained(diagnosis: Diagnosis, simulated: SimulatedLog) -> dict[str, float]:
    """Share of each acceleration that the model leaves unexplained: ``u / (u + m)``.

    Parameters
    ----------
    diagnosis : Diagnosis
        Unmodelled accelerations of this log, of RMS ``u``.
    simulated : SimulatedLog
        The log with the model's accelerations, of RMS ``m``.

    Returns
    -------
    dict of str to float
        Without coordinates that are at rest beside another one of the same unit.
    """
    units = simulated.observations.model.units
    left = {n: _rms(x) for n, x in diagnosis.unmodelled_accelerations.items()}
    total = {n: x + _rms(simulated.accelerations[n]) for n, x in left.items()}
    largest = {unit: max(x for n, x in total.items() if units[n] == unit) for unit in {units[n] for n in total}}
    # A coordinate is at rest beside one that accelerates a hundred times as much.
    return {n: left[n] / x for n, x in total.items() if x > 0.01 * largest[units[n]]}


def _rms(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    with np.errstate(over="ignore"):
        return float(np.sqrt(np.mean(np.square(finite)))) if len(finite) else 0.0


# ---------------------------------------------------------------------- predictions of an identification


def predictions(
    estimate: Estimate, evaluation: Evaluation, dataset: Dataset, scoring: Scoring, settings: Settings
) -> list[Prediction | None]:
    """Agreement of the simulation of each log with the log; None for a log without its initial state.

    With a diagnosis, the simulation restarts from smoothed states, so that the effect of unmodelled forces does not
    accumulate.

    Parameters
    ----------
    estimate : Estimate
    evaluation : Evaluation
        Inliers and thresholds.
    dataset : Dataset
    scoring : Scoring
        Signals that are compared.
    settings : Settings
        Rule of the initial states, and threads.
    """
    acting, stretches = as_estimated(dataset, estimate.diagnosis, settings)
    simulation = Simulation(acting, scoring.judged, estimate.resolution, stretches, settings.threads)
    ends = np.cumsum([0, *map(len, dataset.given)])
    found: list[Prediction | None] = []
    for i, one in enumerate(acting.segments):
        rows = slice(int(ends[i]), int(ends[i + 1]))
        diagnosis = None if estimate.diagnosis is None else estimate.diagnosis.of_log(i, rows)
        parameters = dataset.layout.of_log(estimate.values, i)
        restarts = None if diagnosis is None else restarts_of(diagnosis, one)
        try:
            series = simulated_rows(simulation, i, parameters, one, restarts)
        except LogError:
            found.append(None)
            continue
        first = one.first_row_in(dataset.given[i])
        thresholds = np.array([evaluation.thresholds.get(name, 0.0) for name in one.signals])
        simulated = SimulatedLog(
            **simulated_parts(one, series, restarts),
            **diagnosed_parts(one, diagnosis, first),
            thresholds=thresholds,
            inliers=evaluation.inliers[rows][first : first + len(one)],
        )
        found.append(simulated.summary(diagnosis))
    return found


def simulated_parts(observations: Segment, series: FloatArray, restarts: Restarts | None) -> dict[str, Any]:
    """Fields of a `SimulatedLog` that come from its simulation, by name.

    Parameters
    ----------
    observations : Segment
    series : (N, n_signals) array
        As `simulated_rows` returns them.
    restarts : Restarts, optional
        As they were given to `simulated_rows`.
    """
    model = observations.model
    return {
        "observations": observations if restarts is None else _restarted(observations, restarts),
        "simulated": series[:, [model.signals.index(name) for name in observations.signals]],
        "accelerations": {name: series[:, model.signals.index(name)] for name in model.accelerations},
        "restart_period": np.inf if restarts is None else restarts.n_rows * observations.log.dt,
    }


def _restarted(observations: Segment, restarts: Restarts) -> Segment:
    """The observations, in which rows between a gap and the next restart are those of the gap."""
    gaps = observations.gaps.copy()
    for x in runs(~gaps):
        later = restarts.rows[np.searchsorted(restarts.rows, x.start) :]
        gaps[x.start : min(x.stop, int(later[0]) if len(later) else x.stop)] = True
    return replace(observations, gaps=gaps, valid=observations.valid & ~gaps)


def diagnosed_parts(observations: Segment, diagnosis: Diagnosis | None, first_row: int) -> dict[str, Any]:
    """Fields of a `SimulatedLog` that come from the diagnosis of its log, by name.

    Parameters
    ----------
    observations : Segment
    diagnosis : Diagnosis, optional
        Of this log alone; None: neither noise nor outliers are known.
    first_row : int
        Row of the log that is the first one of the observations.
    """
    known = {} if diagnosis is None else diagnosis.outliers
    rows, none = slice(first_row, first_row + len(observations)), np.zeros(len(observations), bool)
    return {
        "noise": {} if diagnosis is None else diagnosis.noise_std,
        "outliers": {n: known[n][rows] if n in known else none for n in observations.signals},
    }
