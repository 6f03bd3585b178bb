"""Summary of each log of an identification: rows that count, the weakest window, and unexplained accelerations."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.data.dataset import Dataset
from diransac.data.segment import Segment
from diransac.identification.diagnosis import Diagnosis
from diransac.identification.estimate import Estimate, Evaluation, Prediction
from diransac.identification.evaluation.scoring import as_estimated
from diransac.identification.evaluation.simulation import Simulation


def predictions(estimate: Estimate, evaluation: Evaluation, dataset: Dataset) -> list[Prediction | None]:
    """Agreement of each log with its simulation; None for a log without its initial state."""
    acting = as_estimated(dataset, estimate.diagnosis)
    simulation = Simulation(acting, resolution=estimate.resolution)
    ends = np.cumsum([0, *map(len, dataset.given)])
    summaries: list[Prediction | None] = []
    for i, segment in enumerate(acting.segments):
        rows, shares = slice(int(ends[i]), int(ends[i + 1])), dict[str, float]()
        if estimate.diagnosis is not None:
            diagnosis = estimate.diagnosis.of_log(i, rows)
            modelled = _modelled_accelerations(simulation, i, dataset.layout.of_log(estimate.values, i), diagnosis)
            shares = unexplained(diagnosis.unmodelled_accelerations, modelled, dataset.model.units)
        elif np.isnan(evaluation.fit_errors[i]):
            summaries.append(None)
            continue
        first = segment.first_row_in(dataset.given[i])
        window = _weakest_window(segment, evaluation.inliers[rows][first : first + len(segment)])
        n_excluded = len(segment) - segment.n_rows + segment.offset
        summaries.append(Prediction(shares, segment.n_rows, n_excluded, window))
    return summaries


def _weakest_window(segment: Segment, inliers: BoolArray) -> tuple[float, float, float]:
    """Begin, end, s, and inlier fraction of that of up to 40 windows with the lowest."""
    n, begin = len(segment), float(segment.log.time[segment.offset])
    edges = np.unique(np.linspace(0, n, min(40, max(1, n // 25)) + 1).astype(int))
    agreeing, counting = (np.add.reduceat(x.astype(float), edges[:-1]) for x in (inliers, segment.valid))
    fractions = np.where(counting > 0.0, agreeing / np.maximum(counting, 1.0), np.nan)
    low = int(np.nanargmin(fractions))
    start, stop = (begin + segment.log.dt * float(x) for x in edges[low : low + 2])
    return start, stop, float(fractions[low])


def _modelled_accelerations(
    simulation: Simulation, log: int, parameters: FloatArray, diagnosis: Diagnosis
) -> dict[str, FloatArray]:
    """Accelerations of a log by the model, simulated from about twelve of the smoothed states of a diagnosis."""
    segment, model = simulation.segments[log], simulation.segments[log].model
    every = max(1, round(len(diagnosis.smoothed_time) / 12))
    time = diagnosis.smoothed_time[::every]
    rows = np.round((time - segment.log.time[segment.offset]) / segment.log.dt).astype(int)
    states = np.column_stack([diagnosis.smoothed_states[n][::every] for n in model.state])
    n_rows = int(np.median(np.diff(rows))) if len(rows) > 1 else len(segment)
    series = simulation.trajectories(log, parameters, states, rows, n_rows)
    simulated = rows[:, None] + np.arange(n_rows)
    logged = (simulated < len(segment)) & ~segment.gaps[np.minimum(simulated, len(segment) - 1)]
    return {n: series[logged][:, model.signals.index(n)] for n in model.accelerations}


def unexplained(
    unmodelled: Mapping[str, FloatArray], modelled: Mapping[str, FloatArray], units: Mapping[str, str]
) -> dict[str, float]:
    """Share ``u / (u + m)`` of each acceleration that the model leaves unexplained; u and m are root mean squares.

    Coordinates that are at rest beside another one of the same unit, which accelerates a hundred times as much, are
    left out.
    """
    left = {n: _rms(x) for n, x in unmodelled.items()}
    total = {n: x + _rms(modelled[n]) for n, x in left.items()}
    largest = {units[n]: max(x for m, x in total.items() if units[m] == units[n]) for n in total}
    return {n: left[n] / x for n, x in total.items() if x > 0.01 * largest[units[n]]}


def _rms(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    with np.errstate(over="ignore"):
        return float(np.sqrt(np.mean(np.square(finite)))) if len(finite) else 0.0
